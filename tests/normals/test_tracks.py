from dataclasses import replace

import numpy as np
import pytest
from scenes import board_scene, tracks_at

from polmvs.config import Estimator, NormalOptions
from polmvs.normals.rows import gather_rows
from polmvs.normals.tracks import dolp_shares, seen_shares, select_seeds, track_normals
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import open_phase_map, store_phase_map
from polmvs.scene import point_sigmas


@pytest.fixture(scope="module")
def scene():
    return board_scene(6)


def marked(maps):
    """The maps as if a mark were printed on every point."""
    return [replace(m, lowest_dolp=np.zeros_like(m.lowest_dolp)) for m in maps]


def errors_deg(normals, truth):
    return np.degrees(np.arccos(np.clip((normals * truth).sum(-1), -1, 1)))


@pytest.mark.parametrize("estimator", list(Estimator))
def test_ppa_recovers_the_normals_of_a_perspective_view_and_opa_does_not(scene, estimator):
    points, truth = scene.surface_points(60)
    tracks = tracks_at(scene, points)
    options = NormalOptions(estimator=estimator, window_px=5)
    ppa = track_normals(AngleModel.PPA, tracks, scene.maps, options)
    opa = track_normals(AngleModel.OPA, tracks, scene.maps, options)
    assert ppa.valid.all()
    assert errors_deg(ppa.normals, truth).mean() < 0.4
    assert np.nanmean(errors_deg(opa.normals, truth)) > 3
    assert (ppa.num_rows >= 3).all()


def test_the_estimator_that_is_chosen_is_used(scene):
    """The algebraic one weighs rows alike: its normals are others where rows err unlike."""
    tracks, options = tracks_at(scene, scene.surface_points(60)[0]), NormalOptions(window_px=5)
    found = {
        estimator: track_normals(
            AngleModel.OPA, tracks, scene.maps, replace(options, estimator=estimator)
        )
        for estimator in Estimator
    }
    both = found[Estimator.ALGEBRAIC].valid & found[Estimator.ROBUST].valid
    assert both.any()
    normals = [one.normals[both] for one in found.values()]
    assert np.abs(normals[0] - normals[1]).max() > 1e-3


def test_rows_of_a_true_point_are_perpendicular_to_its_normal(scene):
    points, truth = scene.surface_points(40)
    rows = gather_rows(AngleModel.PPA, points, scene.maps)
    residual = np.einsum("ikn,ni->kn", rows.rows, truth)
    counted = np.isfinite(rows.sigma)
    assert counted.mean() > 0.8
    # The smoothed phase of a plane is its own but for the border; sine of under half a degree.
    assert np.percentile(np.abs(residual[counted]), 90) < 0.008


def test_an_occluded_point_gets_no_row(scene):
    points, _ = scene.surface_points(20)
    nearer = []
    for view, rendered in zip(scene.views, scene.rendered, strict=True):
        del view
        nearer.append(np.full(rendered.depth.shape, 0.1, np.float32))
    rows = gather_rows(AngleModel.PPA, points, scene.maps, nearer)
    assert not np.isfinite(rows.sigma).any()
    unknown = [np.zeros_like(n) for n in nearer]
    assert np.isfinite(gather_rows(AngleModel.PPA, points, scene.maps, unknown).sigma).any()


def test_a_point_off_every_region_has_no_normal(scene):
    tracks = tracks_at(scene, np.array([[0.4, 0.4, 0.0], [0.0, 0.0, 3.0]]))
    estimate = track_normals(AngleModel.PPA, tracks, scene.maps, NormalOptions())
    assert not estimate.valid.any()
    assert np.isnan(estimate.normals).all()
    assert not select_seeds(tracks, estimate, scene.maps)[1].any()


def test_seeds_lie_on_the_part_only(scene):
    on, _ = scene.surface_points(30)
    off = on + np.array([0.5, 0.0, 0.0])
    tracks = tracks_at(scene, np.concatenate([on, off]))
    estimate = track_normals(AngleModel.PPA, tracks, scene.maps, NormalOptions(window_px=5))
    seeds, chosen = select_seeds(tracks, estimate, marked(scene.maps))
    assert chosen[:30].mean() > 0.5  # those near the border of a view are left out
    assert not chosen[30:].any()
    assert len(seeds.points_in_world) == chosen.sum()


def test_sigma_of_a_point_is_that_of_its_triangulation(scene):
    """Reprojected with half a pixel of noise, the least-squares point scatters by its sigma."""
    points, _ = scene.surface_points(1)
    tracks = tracks_at(scene, points)
    sigma = point_sigmas(tracks, scene.views)[0]
    rng = np.random.default_rng(0)
    jacobian, noise = [], []
    for view in scene.views:
        in_cam = view.cam_from_world * points[0]
        base = view.camera.project(in_cam)
        step = 1e-6
        jacobian.append(
            np.array(
                [
                    (view.camera.project(view.cam_from_world * (points[0] + step * axis)) - base)
                    / step
                    for axis in np.eye(3)
                ]
            ).T
        )
        noise.append(rng.normal(scale=0.5, size=(4000, 2)))
    design = np.concatenate(jacobian)
    solved = np.linalg.lstsq(design, np.concatenate(noise, axis=1).T, rcond=None)[0].T
    largest = np.sqrt(np.linalg.eigvalsh(np.cov(solved.T))[-1])
    # Off-axis pixels are nearer together than on-axis ones: a few percent.
    assert sigma == pytest.approx(largest, rel=0.15)


def test_a_stored_phase_map_comes_back_and_travels_as_its_path(scene, tmp_path):
    import pickle

    stored = store_phase_map(scene.maps[0], tmp_path)
    again = open_phase_map(scene.views[0], tmp_path)
    np.testing.assert_array_equal(again.samples, scene.maps[0].samples)
    np.testing.assert_array_equal(again.region.edges, scene.maps[0].region.edges)
    pickled = pickle.dumps(stored)
    assert len(pickled) < 3000
    np.testing.assert_array_equal(pickle.loads(pickled).samples, stored.samples)


def test_a_damaged_phase_map_is_named(scene, tmp_path):
    from polmvs.errors import DataError

    store_phase_map(scene.maps[0], tmp_path)
    path = tmp_path / f"{scene.views[0].name}.samples.npy"
    path.write_bytes(path.read_bytes()[:40])
    with pytest.raises(DataError, match=r"samples\.npy"):
        open_phase_map(scene.views[0], tmp_path)


def test_a_mirror_image_behind_the_surface_is_no_seed(scene):
    """Points well behind a board, as its mirror shows them, match the board's phases."""
    on, normals = scene.surface_points(30)
    behind = on - 0.12 * normals
    # They are seen in the board in the views that look along the way to them.
    tracks = tracks_at(scene, behind)
    estimate = track_normals(AngleModel.PPA, tracks, scene.maps, NormalOptions(window_px=5))
    shares = seen_shares(behind, np.nan_to_num(estimate.normals), scene.maps)
    assert np.median(seen_shares(on, normals, scene.maps)) > 0.9
    assert np.median(shares) < 0.7
    assert select_seeds(tracks, estimate, marked(scene.maps))[1].sum() < 6


def test_what_is_polarized_like_the_surface_about_it_is_no_mark(scene):
    points, _ = scene.surface_points(20)
    tracks = tracks_at(scene, points)
    assert np.median(dolp_shares(tracks, scene.maps)) > 0.9
    assert np.nanmax(dolp_shares(tracks, marked(scene.maps))) == 0
    nowhere = tracks_at(scene, points + np.array([0.5, 0.0, 0.0]))
    assert np.isnan(dolp_shares(nowhere, scene.maps)).all()


def test_views_that_a_point_does_not_face_do_not_count(scene):
    """The ring sees the board from above: of its normals laid flat some half of the views."""
    points, normals = scene.surface_points(60)
    inner = seen_shares(points, normals, scene.maps) == 1  # the others lie at a region's border
    assert inner.sum() > 20
    points, normals = points[inner], normals[inner]
    np.testing.assert_array_equal(seen_shares(points, -normals, scene.maps), 0)
    flat = np.tile([1.0, 0.0, 0.0], (len(points), 1))
    facing = np.array([view.faces(points, flat) for view in scene.views])
    assert (facing.sum(axis=0) == 3).all()
    np.testing.assert_array_equal(seen_shares(points, flat, scene.maps), 1)
    # A view without a region counts where it is faced, and nowhere else.
    first = scene.maps[0]
    empty = replace(first.region, inside=np.zeros_like(first.region.inside))
    found = seen_shares(points, flat, [first.changed(region=empty), *scene.maps[1:]])
    np.testing.assert_allclose(found, 1 - facing[0] / facing.sum(axis=0))
    assert len(set(facing[0].tolist())) == 1


def test_all_views_that_show_a_point_count_not_only_those_that_match_it(scene):
    """A point of a weak mark matches in two views; the phases about it are seen in six."""
    points, truth = scene.surface_points(30)
    options = NormalOptions(window_px=5)
    some = track_normals(AngleModel.PPA, tracks_at(scene, points, [0, 1]), scene.maps, options)
    every = track_normals(AngleModel.PPA, tracks_at(scene, points), scene.maps, options)
    assert some.valid.all()
    assert (some.num_rows > 2).all()
    np.testing.assert_array_equal(some.num_rows, every.num_rows)
    assert errors_deg(some.normals, truth).mean() < 0.4
