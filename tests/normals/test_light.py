"""The quarter turn between specular and diffuse light, and maps corrected for tilted polarizers."""

from dataclasses import replace

import analytic_objects as objects
import numpy as np
import pytest
from scenes import CAMERA, Scene, board_scene, phase_map_of, tracks_at

from polmvs.config import NormalOptions
from polmvs.evaluation.comparison import Consistency, best_fitting_model
from polmvs.evaluation.metrics import AngleStats
from polmvs.normals import light as light_module
from polmvs.normals.light import (
    _place_pixels,
    diffuse_pixels,
    find_diffuse_parts,
)
from polmvs.normals.rows import gather_rows
from polmvs.normals.tracks import track_normals
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.phase_map import as_tilted, open_phase_map, store_phase_map, turned
from polmvs.scene import some_tracks
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Group, Plane, Sphere


@pytest.fixture(scope="module")
def board():
    return board_scene(6)


def dome_scene(light: str) -> Scene:
    """A ball, whose light is polarized all round its rim under either kind of reflection."""
    views = board_scene(6).views
    ball = Sphere(center=np.zeros(3), radius=0.2)
    rendered = [
        render_view(v, ball, light=light, sensor="ppa", s0=0.3, background=0.9) for v in views
    ]
    # As the program begins: under the assumption of specular light.
    return Scene(ball, views, rendered, [phase_map_of(r) for r in rendered])


def floor_scene(light: Light, sensor: str = "tilted") -> Scene:
    """A floor that fills most of views with oblique rays."""
    floor = Plane(point=np.zeros(3), normal=np.array([0.05, 0.1, 1.0]), extent=(0.5, 0.5))
    views = ring_of_views(6, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=30)
    rendered = [
        render_view(v, floor, light=light.value, sensor=sensor, s0=0.2, background=0.6)
        for v in views
    ]
    return Scene(floor, views, rendered, [phase_map_of(r, light) for r in rendered])


def diffuse_masks(tracks, maps):
    return [
        diffuse_pixels(*pair) for pair in zip(maps, find_diffuse_parts(tracks, maps), strict=True)
    ]


def diffuse_share(scene, tracks):
    masks = diffuse_masks(tracks, scene.maps)
    inside = sum(int(m.region.inside.sum()) for m in scene.maps)
    return sum(int(mask.sum()) for mask in masks) / inside


def test_a_glossy_black_board_is_specular(board):
    points, _ = board.surface_points(25)
    assert diffuse_share(board, tracks_at(board, points)) == 0


@pytest.mark.parametrize("light", ["specular", "diffuse"])
def test_the_light_of_a_curved_thing_is_told(light):
    scene = dome_scene(light)
    points, _ = scene.surface_points(40)
    expected = 1.0 if light == "diffuse" else 0.0
    assert diffuse_share(scene, tracks_at(scene, points)) == pytest.approx(expected, abs=0.05)


def test_without_points_strong_polarization_means_specular(board):
    none = tracks_at(board, np.zeros((0, 3)))
    assert not any(mask.any() for mask in diffuse_masks(none, board.maps))


@pytest.mark.parametrize("light", ["specular", "diffuse"])
def test_a_part_without_points_is_told_by_its_own_phases(light):
    """Weak polarization, which alone would pass for diffuse, on a thing without sparse points."""
    scene = dome_scene(light)
    weak = [replace(m, samples=m.samples * np.float32([0.3, 0.3, 1])) for m in scene.maps]
    assert max(np.linalg.norm(m.samples[..., :2], axis=-1).max() for m in weak) < 0.4
    corners = np.array([[x, y, -0.2] for x in (-0.3, 0.3) for y in (-0.3, 0.3)])
    about = tracks_at(scene, corners)  # on the ground beside it
    masks = diffuse_masks(about, weak)
    share = sum(int(m.sum()) for m in masks) / sum(int(m.region.inside.sum()) for m in weak)
    assert share == pytest.approx(1.0 if light == "diffuse" else 0.0, abs=0.05)


def test_what_one_view_says_of_a_thing_yields_to_the_others_that_show_it():
    """Two balls of different light, one view wrong of either: each is decided by its own views."""
    places = np.array([[-0.12, 0.0, 0.0], [0.12, 0.0, 0.0]])
    balls = [Sphere(center=place, radius=0.06) for place in places]
    views = ring_of_views(8, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=70)
    rendered = [render_view(v, Group(balls), sensor="ppa", s0=0.3, background=0.9) for v in views]
    maps = [phase_map_of(r) for r in rendered]
    votes, of_balls = [], []
    for index, phase_map in enumerate(maps):
        labels = light_module._parts_of(phase_map)
        xy = phase_map.view.project(places)
        own = labels[xy[:, 1].astype(int), xy[:, 0].astype(int)]
        assert (own > 0).all()
        assert own[0] != own[1]
        of_view = np.full(labels.max() + 1, np.nan)
        of_view[own] = (30.0, -30.0) if index != 3 else (-40.0, 40.0)
        votes.append(of_view)
        of_balls.append(own)
    votes[5][of_balls[5]] = np.nan  # which says nothing itself
    surroundings = np.array([[x, y, -0.06] for x in (-0.2, 0.2) for y in (-0.2, 0.2)])
    slots = light_module._place_pixels(maps, surroundings)
    pooled = light_module._pooled_votes(slots, votes, maps)
    for found, own in zip(pooled, of_balls, strict=True):
        assert found[own[0]] > 60
        assert found[own[1]] < -60


def test_pixels_are_tried_from_the_near_to_the_far_side_of_the_hull(board):
    """As many views show the first and the last depth of a pixel, and none more than these."""
    points, _ = board.surface_points(60)
    slots = _place_pixels(board.maps, points)
    shown = np.sum([m.shows_surface(m.view.project(slots.points)) for m in board.maps], axis=0)
    num_tried = light_module.TOL.num_ranges
    per_view = np.bincount(slots.view, minlength=len(board.maps)) // num_tried
    begin = 0
    for num, phase_map in zip(per_view, board.maps, strict=True):
        here = slice(begin, begin + num * num_tried)
        support = shown[here].reshape(num_tried, num)
        np.testing.assert_array_equal(support[0], support[-1])
        assert (support[0] >= support.max(axis=0) - 1).all()
        offsets = slots.points[here] - phase_map.view.center_in_world
        distances = np.linalg.norm(offsets, axis=-1).reshape(num_tried, num)
        assert (np.diff(distances, axis=0) >= -1e-12).all()
        begin += num * num_tried
    assert begin == len(slots.points)


def test_turning_twice_changes_nothing(board):
    phase_map = board.maps[0]
    half = np.zeros(phase_map.region.inside.shape, bool)
    half[:60] = True
    once = turned(phase_map, half)
    assert once.diffuse[:60].all()
    assert not once.diffuse[60:].any()
    np.testing.assert_array_equal(once.samples[:60, :, :2], -phase_map.samples[:60, :, :2])
    again = turned(once, half)
    np.testing.assert_allclose(again.samples, phase_map.samples, rtol=1e-5, atol=1e-7)
    assert not again.diffuse.any()


def test_the_kind_of_light_is_stored(board, tmp_path):
    phase_map = board.maps[0]
    half = np.zeros(phase_map.region.inside.shape, bool)
    half[:60] = True
    store_phase_map(turned(phase_map, half), tmp_path)
    np.testing.assert_array_equal(open_phase_map(board.views[0], tmp_path).diffuse, half)


@pytest.mark.parametrize("light", list(Light))
def test_rows_of_a_tilted_sensor_are_exact_once_corrected(light):
    scene = floor_scene(light)
    points, truth = scene.surface_points(40)
    maps = scene.maps
    error = {}
    for model, used in ((AngleModel.PPA, maps), (AngleModel.TILTED, [as_tilted(m) for m in maps])):
        rows = gather_rows(model, points, used)
        residual = np.einsum("ikn,ni->kn", rows.rows, truth)[np.isfinite(rows.sigma)]
        error[model] = np.degrees(np.sqrt((residual**2).mean()))
    assert error[AngleModel.TILTED] < 0.2
    assert error[AngleModel.PPA] > 3 * error[AngleModel.TILTED]


def test_tilted_normals_of_a_tilted_sensor_are_nearer_to_the_truth():
    scene = floor_scene(Light.SPECULAR)
    points, truth = scene.surface_points(40)
    tracks = tracks_at(scene, points)
    mean = {}
    for model, used in (
        (AngleModel.PPA, scene.maps),
        (AngleModel.TILTED, [as_tilted(m) for m in scene.maps]),
    ):
        found = track_normals(model, tracks, used, NormalOptions(window_px=5))
        cosine = np.clip((found.normals * truth).sum(axis=-1), -1, 1)
        mean[model] = np.degrees(np.arccos(cosine)).mean()
    assert mean[AngleModel.TILTED] < 0.5 * mean[AngleModel.PPA]


def test_a_stored_tilted_map_shares_its_region(board, tmp_path):
    import pickle

    base = store_phase_map(board.maps[0], tmp_path)
    stored = store_phase_map(as_tilted(base), tmp_path)
    assert stored.tilted
    again = pickle.loads(pickle.dumps(stored))
    np.testing.assert_array_equal(again.samples, stored.samples)
    np.testing.assert_array_equal(open_phase_map(base.view, tmp_path).samples, base.samples)


@pytest.mark.parametrize("sensor", ["ppa", "tilted"])
def test_the_residuals_tell_which_model_a_sensor_follows(sensor, tmp_path):
    """Wide rays over a floor, behind polarizers of either kind."""
    scene = floor_scene(Light.SPECULAR, sensor)
    points, _ = scene.surface_points(40)
    tracks = tracks_at(scene, points)
    found = {}
    for model, used in (
        (AngleModel.OPA, scene.maps),
        (AngleModel.PPA, scene.maps),
        (AngleModel.TILTED, [as_tilted(m) for m in scene.maps]),
    ):
        estimate = track_normals(model, tracks, used, NormalOptions(window_px=5))
        residual = float(np.degrees(np.arcsin(np.nanmedian(estimate.residual))))
        none = AngleStats.from_degrees(np.zeros(0))
        found[model] = Consistency(
            num_points=0,
            phase_residual=none,
            coverage=0.0,
            agreement=0.0,
            track_residual_median_deg=residual,
        )
    assert best_fitting_model(found) is AngleModel(sensor)


def test_without_points_no_model_fits_best():
    none = Consistency(
        num_points=0,
        phase_residual=AngleStats.from_degrees(np.zeros(0)),
        coverage=float("nan"),
        agreement=float("nan"),
        track_residual_median_deg=float("nan"),
    )
    assert best_fitting_model({AngleModel.PPA: none}) is None


@pytest.mark.parametrize("light", [Light.SPECULAR, Light.DIFFUSE])
def test_few_misled_points_do_not_decide_against_all_pixels(light):
    """What lies in the air before a thing, or is mirrored in it, votes by chance."""
    rng = np.random.default_rng(0)
    views = objects.ring_of_views(10)
    maps = objects.phase_maps_of(objects.torus(), views, noise=0.02, rng=rng)
    if light is Light.DIFFUSE:
        maps = [turned(m, m.region.inside) for m in maps]
        maps = [m.changed(diffuse=np.zeros_like(m.diffuse)) for m in maps]
    points = rng.uniform(-1.0, 1.0, (300, 3))
    tracks = tracks_at(Scene(None, views, [], maps), points)
    votes, _ = light_module.track_votes(tracks, maps, max_rows=10**6)
    wrong = votes * (1 if light is Light.SPECULAR else -1)
    misled = np.isin(np.arange(len(points)), np.argsort(wrong)[:5])
    assert wrong[misled].sum() < 10  # of some 25 each that are right
    masks = diffuse_masks(some_tracks(tracks, misled), maps)
    for phase_map, mask in zip(maps, masks, strict=True):
        expected = phase_map.region.inside if light is Light.DIFFUSE else np.zeros_like(mask)
        np.testing.assert_array_equal(mask, expected)
