"""One round of one view: its nodes' normals and ranges, and how certain they are."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, board_scene, phase_map_of
from true_views import BALL, BOARD, scene_of, true_samples

from polmvs.camera import pixel_centers
from polmvs.normals.rows import gather_rows
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import as_tilted, turned
from polmvs.scene import Seeds
from polmvs.surface.pixel_graph import Nodes, tie_seeds
from polmvs.surface.propagation import open_lattice, relax, spread_nodes, surface_at_seeds
from polmvs.synthetic.captures import render_view, ring_of_views

STRIDE = 4


@pytest.fixture(scope="module")
def board():
    return board_scene(6)


def lattice_edges(wanted):
    """Pairs of neighbours in rows and columns of the wanted (h, w) points of a lattice."""
    index = np.where(wanted, np.cumsum(wanted).reshape(wanted.shape) - 1, -1)
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    tail = np.concatenate([a[(a >= 0) & (b >= 0)] for a, b in pairs])
    head = np.concatenate([b[(a >= 0) & (b >= 0)] for a, b in pairs])
    return tail, head


def nodes_of(scene, k=0, stride=STRIDE):
    """True nodes of a view on the lattice of its region, joined to their neighbours."""
    samples, hit = true_samples(scene, k, stride)
    inside = scene.maps[k].shows_surface(samples.xy)
    hit[hit] = inside
    tail, head = lattice_edges(hit)
    surface = samples[inside]
    return Nodes(
        surface=surface,
        ray_z=scene.views[k].camera.rays(surface.xy)[:, 2],
        spacing_px=float(stride),
        focal_px=scene.views[k].camera.mean_focal_px,
        tail=tail,
        head=head,
        on_contour=np.zeros(len(tail), bool),
    )


def test_seeds_are_tied_along_chords_of_a_sphere():
    """A tangent plane would put the nodes about a seed outside of the sphere."""
    scene = scene_of(BALL)
    nodes = nodes_of(scene, stride=8)
    view = scene.views[0]
    samples, _ = true_samples(scene, 0, 2)
    slant = -(samples.rays_in_world * samples.normals).sum(axis=-1)
    some = samples[np.flatnonzero(slant > 0.6)[::37]]
    points = view.center_in_world + np.exp(some.log_range)[:, None] * some.rays_in_world
    seeds = Seeds(points, some.normals, np.full(len(points), 1e-4))
    ties = tie_seeds(scene.maps[0], nodes, seeds)
    assert len(ties.node) > 2 * len(points) // 2
    np.testing.assert_allclose(ties.value, nodes.surface.log_range[ties.node], atol=1e-9)


def test_the_first_guess_is_the_median_of_near_seeds(board):
    seeds = board.seeds(9)
    view, points = board.views[0], seeds.points_in_world.copy()
    center = view.center_in_world
    points[0] = center + 0.7 * (points[0] - center)
    one_wrong = replace(seeds, points_in_world=points)
    xy = view.camera.project(view.cam_from_world * points)[:1]  # next to the wrong one
    guess = surface_at_seeds(board.maps[0], one_wrong, xy)
    distance = np.linalg.norm(seeds.points_in_world - board.views[0].center_in_world, axis=-1)
    assert (np.exp(guess.log_range) >= distance.min()).all()
    assert (np.exp(guess.log_range) <= distance.max()).all()
    np.testing.assert_allclose(np.linalg.norm(guess.normals, axis=-1), 1)
    assert (guess.confidence == 0).all()


def test_no_visible_seed_no_guess(board):
    xy = np.array([[80.0, 64.0]])
    seeds = board.seeds(5)
    behind = replace(seeds, normals_in_world=-seeds.normals_in_world)
    assert surface_at_seeds(board.maps[0], behind, xy) is None
    assert surface_at_seeds(board.maps[0], seeds, np.zeros((0, 2))) is None


def relaxed(scene, maps, nodes=None, dense=None, **options):
    nodes = nodes_of(scene) if nodes is None else nodes
    dense = [None] * len(maps) if dense is None else dense
    options = {"bending": 0.002, **options}
    return relax(AngleModel.PPA, maps, dense, nodes, scene.seeds(12), **options)


def test_a_round_leaves_the_true_surface_where_it_is(board):
    before = nodes_of(board).surface
    after = relaxed(board, board.maps).surface
    error = np.exp(after.log_range) - np.exp(before.log_range)
    assert np.sqrt((error**2).mean()) < 0.04 * 0.5 / 120  # GSDs; seeds are tied to 0.02
    turn = np.degrees(np.arccos(np.clip((after.normals * before.normals).sum(-1), -1, 1)))
    assert np.median(turn) < 0.1
    assert turn.max() < 3  # the phase is smoothed up to the region's edge
    assert np.isfinite(after.log_range_sigma).all()


def with_wrong_phase(board, index):
    """The maps with one view's phase 45 degrees off."""
    wrong = board.maps[index]
    cos, sin, precision = np.moveaxis(wrong.samples, -1, 0)
    turned = replace(wrong, samples=np.dstack([-sin, cos, precision]), folder=None)
    return [turned if m is wrong else m for m in board.maps]


def test_confidence_is_the_share_of_views_that_agree(board):
    """One where all do; a view whose phase is off is one of six, or of those facing."""
    clean = relaxed(board, board.maps).surface.confidence
    assert (clean == 1).mean() > 0.99
    one_off = relaxed(board, with_wrong_phase(board, 3)).surface.confidence
    assert np.median(one_off) == pytest.approx(5 / 6)


def test_what_a_views_own_phase_denies_has_no_confidence(board):
    """The others outvote it, on a surface that it does not see."""
    own_off = relaxed(board, with_wrong_phase(board, 0)).surface.confidence
    assert (own_off == 0).mean() > 0.99


def test_nodes_of_unknown_place_take_no_rows(board):
    """Other views may well show this one's camera: no row is read there."""
    nodes = nodes_of(board)
    lost = np.arange(len(nodes.surface.xy)) % 50 == 7
    log_range = np.where(lost, np.nan, nodes.surface.log_range)
    nodes = replace(nodes, surface=replace(nodes.surface, log_range=log_range))
    above = ring_of_views(
        5, CAMERA, target=board.views[0].center_in_world, distance=0.4, elevation_deg=60
    )
    watching = [_polarized(board.maps[0], view) for view in above]
    surface = relaxed(board, [*board.maps, *watching], nodes).surface
    assert (surface.confidence[lost] == 0).all()
    assert (surface.normal_sigma[lost] > 0.05).all()  # filled from the neighbours
    # Which put it in its place.
    assert (surface.normals[lost] * nodes.surface.normals[lost]).sum(-1).min() > 0.99


def _polarized(phase_map, view):
    """Map of a view whose image shows polarized light all over."""
    everywhere = np.ones_like(phase_map.region.inside)
    # Planes of incidence that hold the vertical: all views agree on it as a normal.
    samples = np.dstack([-0.3 * everywhere, 0.0 * everywhere, 1e4 * everywhere])
    region = replace(phase_map.region, inside=everywhere)
    return replace(phase_map, view=view, region=region, samples=samples.astype(np.float32))


def test_the_origin_may_be_far(board):
    """A world of national coordinates: a metre is lost in single precision at 10,000 km."""
    shift = np.array([4e5, -5e6, 100.0])

    def there(phase_map):
        view, pose = phase_map.view, phase_map.view.cam_from_world
        far = replace(pose, translation=pose.translation - pose.rotation @ shift)
        return replace(phase_map, view=replace(view, cam_from_world=far))

    seeds = board.seeds(12)
    far_seeds = replace(seeds, points_in_world=seeds.points_in_world + shift)
    nodes, none = nodes_of(board), [None] * 6
    here = relax(AngleModel.PPA, board.maps, none, nodes, seeds, bending=0.0)
    far_maps = [there(m) for m in board.maps]
    away = relax(AngleModel.PPA, far_maps, none, nodes, far_seeds, bending=0.0)
    np.testing.assert_allclose(away.surface.log_range, here.surface.log_range, atol=1e-5)


def test_the_lattice_leaves_out_edges(board):
    phase_map = board.maps[0]
    inside = np.zeros_like(phase_map.region.inside)
    inside[20:60, 30:90] = True
    edges = np.zeros_like(inside)
    edges[40:44] = True
    region = replace(phase_map.region, inside=inside, edges=edges)
    wanted = open_lattice(replace(phase_map, region=region), 4)
    expected = np.zeros((32, 40), bool)
    expected[5:15, 8:22] = True  # centres at 4 i + 2
    expected[10] = False
    np.testing.assert_array_equal(wanted[:, 8:22], expected[:, 8:22])
    assert not wanted[:, 23:].any()
    assert not wanted[:, :7].any()


def test_nodes_are_spread_over_the_lattice(board):
    nodes = nodes_of(board)
    dense = spread_nodes(board.maps[0], nodes, 2)
    truth, hit = true_samples(board, 0, 2)
    known = dense.known & hit
    assert known.sum() > 0.9 * open_lattice(board.maps[0], 2).sum()
    ranges = np.zeros(hit.shape)
    ranges[hit] = np.exp(truth.log_range)
    np.testing.assert_allclose(dense.range_map[known], ranges[known], rtol=1e-5)
    lost = replace(nodes.surface, log_range=np.full(len(nodes.surface.xy), np.nan))
    assert spread_nodes(board.maps[0], replace(nodes, surface=lost), 2) is None


@pytest.fixture(scope="module")
def oblique():
    """A map of a wide lens whose polarizers are tilted: its phases turn by degrees."""
    camera = replace(CAMERA, fx=80.0, fy=80.0)
    board = replace(BOARD, extent=(0.3, 0.35))
    view = ring_of_views(1, camera, target=np.zeros(3), distance=0.4, elevation_deg=50)[0]
    return phase_map_of(render_view(view, board, sensor="tilted", s0=0.2, background=0.6))


def sigma_at_own_pixels(phase_map, model=AngleModel.PPA, **options):
    """Deviation (H, W) of the rows of a plane of points that the map's view sees."""
    view = phase_map.view
    xy = pixel_centers(view.camera.width, view.camera.height)
    points = view.cam_from_world.inverse() * view.camera.rays(xy).reshape(-1, 3)
    rows = gather_rows(model, points, [phase_map], **options)
    return rows.sigma.reshape(xy.shape[:2])


def test_oblique_rays_count_less(oblique):
    """By the square of the turn that a tilt would give them; frontal ones stay as they are."""
    aware = sigma_at_own_pixels(oblique)
    pure = sigma_at_own_pixels(oblique, tilt_aware=False)
    some = np.isfinite(aware)
    np.testing.assert_array_equal(some, np.isfinite(pure))
    gain = np.where(some, aware / np.where(some, pure, 1), np.nan) ** 2
    assert np.nanmax(gain) > 3
    assert gain[60:68, 76:84].max() < 1.1
    assert np.nanmin(gain) >= 1 - 1e-4


def test_pure_rows_take_their_weight_from_the_map_alone(oblique):
    """OPA's rows turn as their phases do; the map holds what noise and mixture leave."""
    pure = sigma_at_own_pixels(oblique, AngleModel.OPA, tilt_aware=False)
    precision = oblique.samples[..., 2]
    some = precision > 0
    np.testing.assert_allclose(pure[some], precision[some] ** -0.5, rtol=2e-3)


def test_opa_doubts_its_rows_by_their_angle_to_those_of_ppa(oblique):
    view = oblique.view
    xy = pixel_centers(view.camera.width, view.camera.height).reshape(-1, 2)
    points = view.points_at(xy, np.ones(len(xy)))
    models = (AngleModel.OPA, AngleModel.PPA)
    opa, ppa = (gather_rows(m, points, [oblique]) for m in models)
    pure_opa, pure_ppa = (gather_rows(m, points, [oblique], tilt_aware=False) for m in models)
    some = np.isfinite(opa.sigma[0])
    squares = [r.sigma[0, some].astype(float) ** 2 for r in (opa, pure_opa, ppa, pure_ppa)]
    tilt = (squares[2] - squares[3]) * squares[1] / squares[3]  # of the phase
    sine = np.linalg.norm(np.cross(opa.rows[:, 0, some].T, ppa.rows[:, 0, some].T), axis=-1)
    assert sine.max() > np.sin(np.radians(20))
    np.testing.assert_allclose(squares[0], squares[1] + tilt + sine**2, rtol=1e-3)


def test_the_tilted_model_knows_no_such_doubt(oblique):
    """Its rows are as certain as noise and mixture leave them, at the image's corners too."""
    tilted, plain = as_tilted(oblique), sigma_at_own_pixels(oblique, tilt_aware=False)
    aware = sigma_at_own_pixels(tilted, AngleModel.TILTED)
    some = np.isfinite(plain) & (oblique.samples[..., 2] > 0)
    np.testing.assert_array_equal(
        aware, sigma_at_own_pixels(tilted, AngleModel.TILTED, tilt_aware=False)
    )
    # The row turns about its ray as the direction of polarization does, whose phase was measured.
    np.testing.assert_allclose(aware[some], oblique.samples[..., 2][some] ** -0.5, rtol=2e-2)


def test_turned_twice_is_as_before(oblique):
    everywhere = np.ones_like(oblique.diffuse)
    before = oblique.samples.copy()
    once = turned(oblique, everywhere)
    np.testing.assert_array_equal(once.samples[..., :2], -before[..., :2])
    np.testing.assert_array_equal(oblique.samples, before)
    assert once.diffuse.all()
    twice = turned(once, everywhere)
    np.testing.assert_array_equal(twice.samples, before)
    assert not twice.diffuse.any()
