"""Parts without seeds: outlines of pieces, placement by them, and agreement of the views."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, Scene, board_scene, phase_map_of

from polmvs.config import AngleModel
from polmvs.geometry import RigidTransform
from polmvs.parallel import Workers
from polmvs.polarization.phase_map import store_phase_map
from polmvs.polarization.region import Region
from polmvs.scene import Seeds
from polmvs.surface.outlines import (
    FAR_PX,
    OutlineErrors,
    Reference,
    find_pieces,
    piece_nodes,
)
from polmvs.surface.parts import (
    Placement,
    _nowhere,
    _Search,
    contradicted,
    find_part_seeds,
    join_seeds,
    most_agreeing,
)
from polmvs.surface.pixel_graph import visible_seeds
from polmvs.synthetic.captures import Plane, render_view, ring_of_views
from polmvs.synthetic.surfaces import Group, Sphere

NO_SEEDS = Seeds(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
# Points about a scene, as SfM would find on the table: they bound the range, no more.
ABOUT = np.random.default_rng(0).uniform(-0.2, 0.2, (200, 3))
FOOTPRINT = 0.5 / CAMERA.fx  # of a pixel, at the scenes' distance


@pytest.fixture(scope="module")
def board():
    return board_scene(6)


@pytest.fixture(scope="module")
def board_result(board):
    return find_part_seeds(AngleModel.PPA, board.maps, NO_SEEDS, ABOUT)


def heights(surface: Plane, points):
    normal = surface.normal / np.linalg.norm(surface.normal)
    return (points - surface.point) @ normal


def region_of(inside, edges=None):
    edges = np.zeros_like(inside) if edges is None else edges
    return Region(inside, inside.copy(), edges)


def disc(radius, center=(60.3, 50.7), size=(100, 120)):
    rows, cols = np.mgrid[: size[0], : size[1]] + 0.5
    return np.hypot(cols - center[0], rows - center[1]) < radius


def test_distances_from_a_disc_are_those_from_its_circle():
    inside = disc(30.0)
    (piece,) = find_pieces(region_of(inside), np.where(inside, 0.1, 0.6).astype(np.float32))
    angle = np.linspace(0, 2 * np.pi, 50)
    around = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    for radius, bias in ((20.0, 0.4), (28.0, 0.2), (30.0, 0.1), (32.0, 0.2), (45.0, 0.4)):
        distance = piece.signed_distance(np.array([60.3, 50.7]) + radius * around)
        # The pixels' steps are up to half a pixel high and cancel at the boundary; from afar one
        # sees the nearer ones.
        assert abs(distance.mean() - (radius - 30.0)) < bias
        np.testing.assert_allclose(distance, radius - 30.0, atol=0.7)
    on_circle = np.linalg.norm(piece.outline - [60.3, 50.7], axis=-1)
    np.testing.assert_allclose(on_circle, 30.0, atol=0.6)
    assert piece.signed_distance(np.array([[500.0, -20.0], [np.nan, 3.0]])) == pytest.approx(FAR_PX)


def test_an_outline_goes_to_the_step_of_the_intensity():
    """A region that stops short of the surface's end, as one does on a frontal surface."""
    image = np.where(disc(30.0), 0.1, 0.6).astype(np.float32)
    (piece,) = find_pieces(region_of(disc(28.0)), image)
    on_circle = np.linalg.norm(piece.outline - [60.3, 50.7], axis=-1)
    # The steps of a disc of pixels leave a part of half a pixel.
    assert abs(on_circle.mean() - 30.0) < 0.3


def test_a_crease_parts_two_pieces_even_if_it_has_a_gap():
    inside = np.zeros((80, 100), bool)
    inside[10:70, 10:90] = True
    edges = np.zeros_like(inside)
    edges[38:41, 10:50] = edges[38:41, 54:90] = True
    top, bottom = find_pieces(region_of(inside, edges), np.full(inside.shape, 0.3, np.float32))
    middle = np.array([[50.0, 39.5], [30.0, 39.5]])
    np.testing.assert_allclose(top.signed_distance(middle), 0, atol=1.0)
    np.testing.assert_allclose(bottom.signed_distance(middle), 0, atol=1.0)
    assert top.num_px + bottom.num_px == inside.sum()


def test_where_the_image_ends_is_no_outline():
    inside = np.zeros((80, 100), bool)
    inside[20:, :60] = True
    (piece,) = find_pieces(region_of(inside), np.where(inside, 0.1, 0.6).astype(np.float32))
    assert 0.4 < piece.cut_share < 0.6
    assert (piece.outline[:, 0] > 3).all()
    assert (piece.outline[:, 1] < 77).all()
    assert piece.signed_distance(np.array([[5.0, 78.0]]))[0] < -30


def test_nothing_and_specks_are_no_pieces():
    empty = np.zeros((40, 50), bool)
    speck = empty.copy()
    speck[10:20, 10:20] = True
    for inside in (empty, speck):
        assert find_pieces(region_of(inside), np.ones((40, 50), np.float32)) == []


def misfit_of(error, slope, view, stretch):
    none = np.zeros(0, np.int64)
    ones = np.ones(len(error))
    return OutlineErrors(np.array(error), np.array(slope), ones, view, stretch, none)


def test_the_deviation_of_a_balance_does_not_shrink_with_copies_of_its_points():
    rng = np.random.default_rng(0)
    view, stretch = np.repeat(np.arange(6), 10), np.tile(np.arange(10), 6)
    error, slope = rng.normal(0, 0.4, 60), rng.choice([-300.0, 300.0], 60)
    once = misfit_of(error, slope, view, stretch)
    often = misfit_of(*(np.repeat(a, 9) for a in (error, slope, view, stretch)))
    assert often.sigma() == pytest.approx(once.sigma(), rel=1e-9)
    assert 0.4 / 300 / np.sqrt(60) < once.sigma() < 3 * 0.6 / 300
    assert misfit_of(error, 0 * slope, view, stretch).sigma() == np.inf


def test_a_bias_of_all_outlines_counts_where_it_does_not_cancel():
    view, stretch = np.arange(8), np.arange(8)
    none = np.zeros(8)
    one_sided = misfit_of(none, np.full(8, 300.0), view, stretch)
    both = misfit_of(none, np.tile([-300.0, 300.0], 4), view, stretch)
    assert one_sided.sigma() == pytest.approx(0.5 / 300)
    assert both.sigma() == pytest.approx(0, abs=1e-12)


def test_a_board_without_seeds_is_found_within_a_fraction_of_a_pixel(board, board_result):
    seeds, reports = board_result
    (report,) = reports
    assert report.doubt == ""
    assert report.num_views == 6
    assert report.num_agreeing >= 3
    error = heights(board.surface, seeds.points_in_world)
    # Two views a right angle apart move the outline a pixel per footprint of height; outlines
    # are known to about half a pixel, and half of that is left of several views.
    assert np.abs(np.median(error)) < 0.5 * FOOTPRINT
    assert np.abs(error).max() < FOOTPRINT
    assert np.abs(np.median(error)) < 3 * report.sigma < 3 * FOOTPRINT
    normal = board.surface.normal / np.linalg.norm(board.surface.normal)
    assert np.degrees(np.arccos((seeds.normals_in_world @ normal).min())) < 1.0
    assert np.all(seeds.sigma == report.sigma)
    assert 20 < len(seeds.sigma) < 100


def test_workers_give_the_same_result_as_one_process(board, board_result, tmp_path):
    stored = [store_phase_map(m, tmp_path) for m in board.maps]
    with Workers(2) as workers:
        seeds, reports = find_part_seeds(AngleModel.PPA, stored, NO_SEEDS, ABOUT, workers=workers)
    expected, (report,) = board_result
    np.testing.assert_allclose(seeds.points_in_world, expected.points_in_world, atol=1e-8)
    assert [r.num_agreeing for r in reports] == [report.num_agreeing]


def test_the_seeds_of_a_part_serve_the_dense_stage(board, board_result):
    """They are visible seeds, on the region, in the views that show the part."""
    seeds, _ = board_result
    for phase_map in board.maps:
        assert visible_seeds(phase_map, seeds)[0].mean() > 0.9


def test_a_sphere_is_found_by_where_it_turns_away():
    sphere = Sphere(center=np.array([0.0, 0.0, 0.0]), radius=0.13)
    views = ring_of_views(8, CAMERA, distance=0.5, elevation_deg=40)
    rendered = [render_view(v, sphere, s0=0.2, background=0.6) for v in views]
    maps = [phase_map_of(r) for r in rendered]
    seeds, reports = find_part_seeds(AngleModel.PPA, maps, NO_SEEDS, ABOUT)
    assert [r.doubt for r in reports] == [""]
    error = np.linalg.norm(seeds.points_in_world, axis=-1) - 0.13
    assert np.abs(np.median(error)) < min(0.75 * FOOTPRINT, 3 * reports[0].sigma)


def test_a_plane_that_fills_all_views_has_no_place():
    """Every depth explains it: undetermined, not invented."""
    plane = Plane(point=np.zeros(3), normal=np.array([0.05, 0.0, 1.0]))
    views = ring_of_views(6, CAMERA, distance=0.5, elevation_deg=55)
    maps = [phase_map_of(render_view(v, plane, s0=0.2)) for v in views]
    assert all(m.region.inside.mean() > 0.9 for m in maps)
    seeds, reports = find_part_seeds(AngleModel.PPA, maps, NO_SEEDS, ABOUT)
    assert len(seeds.sigma) == 0
    assert reports
    assert all(report.doubt for report in reports)


def test_two_views_are_not_enough(board):
    seeds, reports = find_part_seeds(AngleModel.PPA, board.maps[:2], NO_SEEDS, ABOUT)
    assert len(seeds.sigma) == 0
    assert reports
    assert all("fewer than 3 views" in report.doubt for report in reports)


def test_a_part_with_seeds_is_left_alone(board):
    """Even where only some of the views show the seeds."""
    seeds = board.seeds(3)
    found, reports = find_part_seeds(AngleModel.PPA, board.maps, seeds, ABOUT)
    assert len(found.sigma) == 0
    assert reports == []


def test_a_part_that_one_view_shows_without_its_seeds_is_left_alone(board):
    hidden = board.maps[0]
    away = replace(hidden, view=replace(hidden.view, name="away.png"))
    first = np.array([0, 0, 0])  # in one place, so that one disc hides them
    seeds = Seeds(*(a[first] for a in _fields(board.seeds(30))))
    # A seed outside the region of one view only: its mark is outshone there.
    region = hidden.region
    xy = away.view.camera.project(away.view.cam_from_world * seeds.points_in_world)[0]
    inside = region.inside & ~disc(9.0, tuple(xy), region.inside.shape)
    away = replace(away, region=replace(region, inside=inside, reliable=region.reliable & inside))
    maps = [away, *board.maps[1:]]
    found, reports = find_part_seeds(AngleModel.PPA, maps, seeds, ABOUT)
    assert len(found.sigma) == 0
    assert reports == []


@pytest.mark.parametrize("offset", [0.0, 0.02])
def test_a_lone_seed_is_held_against_the_outlines(board, offset):
    true = board.seeds(1)
    lone = replace(true, points_in_world=true.points_in_world + offset * true.normals_in_world)
    found, reports = find_part_seeds(AngleModel.PPA, board.maps, lone, ABOUT)
    assert [report.doubt for report in reports] == [""]
    assert contradicted(lone, found).tolist() == [offset > 0]
    shift = np.array([0.5, 0.0, 0.0])
    beside = replace(lone, points_in_world=lone.points_in_world + shift)
    assert not contradicted(beside, found).any()


def test_nothing_contradicts_without_outlines(board):
    assert not contradicted(board.seeds(4), NO_SEEDS).any()


def _fields(seeds: Seeds):
    return seeds.points_in_world, seeds.normals_in_world, seeds.sigma


def test_views_without_a_region_have_no_parts(board):
    nothing = np.zeros(board.maps[0].region.inside.shape, bool)
    maps = [replace(m, region=Region(nothing, nothing, nothing)) for m in board.maps]
    seeds, reports = find_part_seeds(AngleModel.PPA, maps, NO_SEEDS, ABOUT)
    assert len(seeds.sigma) == 0
    assert reports == []


def test_the_frame_and_scale_of_the_world_do_not_matter(board, board_result):
    rotation = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
    rotation *= np.sign(np.linalg.det(rotation))
    shift, scale = np.array([3.0, -2.0, 1.0]), 7.0

    def moved(view):
        pose = view.cam_from_world
        turned = pose.rotation @ rotation.T
        return replace(
            view,
            cam_from_world=RigidTransform(turned, scale * pose.translation - turned @ shift),
        )

    maps = [replace(m, view=moved(m.view)) for m in board.maps]
    about = scale * ABOUT @ rotation.T + shift
    seeds, reports = find_part_seeds(AngleModel.PPA, maps, NO_SEEDS, about)
    _, (report,) = board_result
    assert reports[0].range == pytest.approx(scale * report.range, rel=1e-3)
    assert reports[0].sigma == pytest.approx(scale * report.sigma, rel=0.1)
    back = (seeds.points_in_world - shift) @ rotation / scale
    assert abs(np.median(heights(board.surface, back))) < 0.5 * FOOTPRINT


def test_a_scene_without_points_has_no_bounds(board):
    with pytest.raises(ValueError, match="no bounds"):
        find_part_seeds(AngleModel.PPA, board.maps, NO_SEEDS, np.zeros((0, 3)))


def test_the_search_is_bounded_and_says_so(board, monkeypatch):
    """Weak polarisation breaks a scene into hundreds of pieces; each costs half a second."""
    placed, told = [], []

    def nowhere(model, reference, bounds):
        placed.append(reference.index)
        matched = np.full(len(reference.maps), -1)
        matched[0] = reference.index
        nodes = piece_nodes(reference.maps[0], reference.piece)
        surface = nodes.surface[np.zeros(0, int)]
        return Placement(surface, np.zeros(3), np.nan, np.inf, matched, np.nan, np.nan, "lost")

    found = {id(m): find_pieces(m.region, m.intensity) for m in board.maps}
    monkeypatch.setattr(
        "polmvs.surface.parts._pieces_of", lambda phase_map: 40 * found[id(phase_map)]
    )
    monkeypatch.setattr("polmvs.surface.parts.place_piece", nowhere)
    seeds, reports = find_part_seeds(
        AngleModel.PPA, board.maps, NO_SEEDS, ABOUT, placements_per_view=3, on_progress=told.append
    )
    assert len(seeds.sigma) == 0
    assert len(placed) == 3 * len(board.maps)
    assert "not tried" in reports[-1].doubt
    assert told == [1] * len(board.maps)


def test_no_placements_agree_on_nothing():
    assert most_agreeing([], []) == []
    assert len(join_seeds([]).sigma) == 0


def test_two_boards_are_two_parts():
    boards = [
        Plane(np.array([x, 0.0, z]), np.array([x, 0.1, 1.0]), extent=(0.07, 0.1))
        for x, z in ((-0.1, 0.0), (0.1, 0.04))
    ]
    views = ring_of_views(6, CAMERA, distance=0.5, elevation_deg=60)
    rendered = [render_view(v, Group(boards), s0=0.2, background=0.6) for v in views]
    scene = Scene(None, views, rendered, [phase_map_of(r) for r in rendered])
    seeds, reports = find_part_seeds(AngleModel.PPA, scene.maps, NO_SEEDS, ABOUT)
    assert [report.doubt for report in reports] == ["", ""]
    left = seeds.points_in_world[:, 0] < 0
    assert 0 < left.sum() < len(left)
    for board, mine in zip(boards, (left, ~left), strict=True):
        error = heights(board, seeds.points_in_world[mine])
        assert np.abs(np.median(error)) < 0.5 * FOOTPRINT


def test_a_surface_without_places_gives_no_middle_to_look_about(board):
    """Another view of such a piece is searched within the scene's bounds, not within NaN's."""
    pieces_of_views = [
        find_pieces(phase_map.region, phase_map.intensity) for phase_map in board.maps
    ]
    search = _Search(AngleModel.PPA, board.maps, pieces_of_views, set(), ABOUT, 3, Workers())
    reference = Reference(board.maps, pieces_of_views, 0, True)
    nodes = piece_nodes(board.maps[0], pieces_of_views[0][0])
    nowhere = _nowhere(reference, nodes)
    unplaced = replace(
        nowhere, surface=replace(nodes.surface, log_range=np.full(len(nodes.surface.xy), np.nan))
    )
    assert search._middle((1, 0), unplaced) is None
    placed = replace(
        nowhere, surface=replace(nodes.surface, log_range=np.zeros(len(nodes.surface.xy)))
    )
    assert np.isfinite(search._middle((1, 0), placed))
