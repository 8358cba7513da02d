from dataclasses import replace

import numpy as np
import pytest
from analytic_objects import (
    DOLP,
    box,
    extracted,
    looking_at,
    phase_maps_of,
    ring_of_views,
    sphere,
    trace,
    union,
)

from polmvs.camera import pixel_centers
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.region import Region
from polmvs.scene import Seeds
from polmvs.surface.global_surface import (
    SparsePoints,
    Undetermined,
    num_surface_steps,
    reconstruct_surface,
    render_view,
    supported_mesh,
    surface_points,
)
from polmvs.surface.mesh_geometry import RayScene
from polmvs.surface.observations import Looking
from polmvs.surface.offsets import find_patches, patch_groups, patch_scene, stepped_patches
from polmvs.surface.silhouettes import find_silhouette
from polmvs.surface.solver import Level, SolverTolerances
from polmvs.surface.surface_quality import (
    Contradictions,
    loses_silhouettes,
    outline_mismatch,
    points_deny,
)
from polmvs.surface.surface_view import Silhouette, surface_view
from polmvs.surface.terms import KnownPoints
from polmvs.surface.visual_hull import visual_hull

PPA = AngleModel.PPA
LOOKING = Looking(angle_model=PPA)
NOTHING = SparsePoints(Seeds(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0)), np.zeros((0, 3)))
GSD = 5 / 150
QUICK = SolverTolerances(
    levels=(
        Level(edge_px=5.0, num_steps=8, loss_scale=12.0, gate_px=25.0),
        Level(edge_px=2.5, num_steps=5, loss_scale=4.0, gate_px=4.0),
    )
)
VIEWS = ring_of_views(12, elevations=(10.0, 45.0))


@pytest.fixture(scope="module")
def maps():
    return phase_maps_of(sphere(), VIEWS, noise=np.radians(0.5))


def seen_in(maps, *, masks_given=False):
    return [surface_view(one, find_silhouette(one, mask_given=masks_given)) for one in maps]


def reconstruct(maps, *, tolerances=QUICK, masks_given=False, **kwargs):
    views = seen_in(maps, masks_given=masks_given)
    return reconstruct_surface(LOOKING, views, NOTHING, tolerances=tolerances, **kwargs)


@pytest.fixture(scope="module")
def surface(maps):
    found = reconstruct(maps)
    assert not isinstance(found, Undetermined)
    return found


def test_the_cloud_lies_on_the_object_with_its_normals(surface, maps):
    found = surface_points(surface, maps, 0.5 * GSD)
    cloud = found.cloud
    radii = np.linalg.norm(cloud.points, axis=1)
    assert not found.inferred.any()
    specular, diffuse, dolp = found.light
    assert np.median(specular) > 0.9 > 0.1 > np.median(diffuse)
    assert np.median(dolp) == pytest.approx(DOLP, rel=0.05)
    assert np.quantile(np.abs(radii - 1), 0.95) < GSD
    angle = np.degrees(np.arccos(np.clip((cloud.normals * cloud.points).sum(1) / radii, -1, 1)))
    assert np.mean(angle) < 1.6
    assert cloud.num_views.min() >= 2
    assert np.median(cloud.intensity) == pytest.approx(0.1, abs=0.02)


def test_deviations_hold(surface, maps):
    cloud = surface_points(surface, maps, 0.5 * GSD).cloud
    known = np.isfinite(cloud.sigma)
    error = np.abs(np.linalg.norm(cloud.points, axis=1) - 1)
    assert known.mean() > 0.9
    assert np.mean(error[known] < 2 * cloud.sigma[known]) > 0.9
    assert np.median(cloud.sigma[known]) < 2 * GSD  # and says something


def test_sparse_points_correct_the_bias_of_phases_where_they_are(maps, surface):
    """Points that all lie 1.5 px below the phases' surface on one side of a ball."""
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(400, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 0] > 0.5]
    places = (1 - 1.5 * GSD + rng.normal(0, 0.3 * GSD, len(normals)))[:, None] * normals
    seeds = Seeds(places, normals, np.full(len(normals), 0.3 * GSD))
    found = reconstruct_surface(
        LOOKING, seen_in(maps), SparsePoints(seeds, NOTHING.surroundings), tolerances=QUICK
    )

    def height(of, towards):
        vertices = of.mesh.vertices
        own = (vertices @ [towards, 0, 0] > 0.7) & (vertices[:, 2] > -0.3)
        return np.median(np.linalg.norm(vertices[own], axis=1) - 1) / GSD

    assert height(surface, 1) == pytest.approx(0, abs=0.3)
    assert height(found, 1) == pytest.approx(-1.5, abs=0.4)
    assert height(found, -1) == pytest.approx(height(surface, -1), abs=0.2)
    beyond = found.sigma[found.mesh.vertices[:, 0] < -0.8]
    within = found.sigma[found.mesh.vertices[:, 0] > 0.8]
    assert np.median(beyond) > np.median(within)


def lid_height(radius):
    """A lid that is round, so that it is no planar patch, below the rim at 0.5."""
    return 0.2 + 0.15 * (1 - (radius / 0.8) ** 2)


def sunk_lid(p):
    """A cylinder of radius 1 with the lid in its top."""
    radius = np.hypot(p[..., 0], p[..., 1])
    outside = np.maximum(radius - 1, np.abs(p[..., 2]) - 0.5)
    return 0.7 * np.maximum(outside, -np.maximum(radius - 0.8, lid_height(radius) - p[..., 2]))


@pytest.mark.slow
@pytest.mark.parametrize("num_points", [0, 60])
def test_a_lid_that_no_outline_shows_lies_on_its_sparse_points(num_points):
    """Neither phases nor silhouettes give its height: only the points know it."""
    views = seen_in(phase_maps_of(sunk_lid, ring_of_views(12, elevations=(30.0, 55.0))))
    rng = np.random.default_rng(0)
    angle, radius = 2 * np.pi * rng.random(num_points), 0.7 * np.sqrt(rng.random(num_points))
    height = lid_height(radius) + rng.normal(0, 0.2 * GSD, num_points)
    points = np.column_stack([radius * np.cos(angle), radius * np.sin(angle), height])
    normals = np.column_stack([0.3 / 0.64 * points[:, :2], np.ones(num_points)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    seeds = Seeds(points, normals, np.full(num_points, 0.3 * GSD))
    found = reconstruct_surface(LOOKING, views, SparsePoints(seeds, NOTHING.surroundings))
    vertices = found.mesh.vertices
    radius = np.hypot(*vertices.T[:2])
    lid = (radius < 0.6) & (vertices[:, 2] > 0)
    error_px = np.median(np.abs(vertices[lid, 2] - lid_height(radius[lid]))) / GSD
    assert error_px < 0.5 if num_points else error_px > 4


def test_what_no_view_sees_is_left_out(surface):
    """All cameras look down: the lowest part of the ball faces none of them."""
    heights = surface.mesh.centers[:, 2]
    assert not surface.supported[heights < -0.97].any()
    assert surface.supported[heights > 0].mean() > 0.98
    mesh = supported_mesh(surface)
    assert mesh.vertices[:, 2].min() > -0.99
    assert np.linalg.norm(mesh.normals, axis=1) == pytest.approx(1)


def test_rendered_depth_is_the_objects(surface):
    dense = render_view(surface, RayScene(surface.mesh), VIEWS[3], 2)
    assert dense is not None
    ranges, _ = trace(sphere(), VIEWS[3])
    # Lattice points lie on corners of pixels: the four about them bracket the range.
    smooth = ranges[1:-1:2, 1:-1:2]
    found = dense.range_map[: smooth.shape[0], : smooth.shape[1]]
    both = (found > 0) & np.isfinite(smooth) & (smooth < 4.5)
    assert both.sum() > 300
    assert np.median(np.abs(found - smooth)[both]) < GSD
    assert (dense.range_map > 0).sum() == dense.known.sum()


def test_the_faces_of_a_box_are_not_drawn_outwards_by_its_edges():
    """A mesh rounds edges; outlines must not make up for it by a larger box."""
    half = np.array([0.8, 0.6, 0.5])
    maps = phase_maps_of(box(half), VIEWS, noise=np.radians(0.5))
    found = reconstruct(maps, tolerances=None)
    cloud = surface_points(found, maps, 0.5 * GSD).cloud
    beyond = np.abs(cloud.points) - half
    side = beyond.argmax(axis=1)
    inner = np.sort(beyond, axis=1)[:, 1] < -3 * GSD
    for axis in range(3):
        offset = beyond[inner & (side == axis), axis] / GSD
        assert abs(np.median(offset)) < 0.2, axis


def test_points_deny_what_is_farther_from_them(surface):
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(60, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    ball = surface.mesh.moved(
        (1 / np.linalg.norm(surface.mesh.vertices, axis=1) - 1)[:, None] * surface.mesh.vertices
    )
    larger = ball.moved(0.3 * GSD * ball.vertices)
    noise = 1 + 0.3 * GSD * rng.standard_normal((60, 1))
    known = KnownPoints(noise * directions, np.full(60, GSD))
    assert points_deny(larger, ball, known, GSD)
    assert not points_deny(ball, larger, known, GSD)
    few = KnownPoints(known.points[:6], known.sigma[:6])
    assert not points_deny(larger, ball, few, GSD)


def test_a_view_that_sees_nothing_has_no_depth(surface):
    away = looking_at((5.0, 0, 1.0), target=(10.0, 0, 1.0))
    assert render_view(surface, RayScene(surface.mesh), away, 2) is None


def test_one_wrong_mask_and_one_wrong_pose_do_no_harm(maps):
    empty = np.zeros_like(maps[0].region.inside)
    corner = empty.copy()
    corner[:20, :20] = True
    wrong_mask = replace(maps[0], region=Region(corner, corner, empty))
    turned = looking_at(maps[5].view.center_in_world + np.array([0.0, 0.0, 0.4]), name="005.png")
    wrong_pose = replace(maps[5], view=turned)
    found = reconstruct([wrong_mask, *maps[1:5], wrong_pose, *maps[6:]])
    assert not isinstance(found, Undetermined)
    radii = np.linalg.norm(found.mesh.centers[found.supported], axis=1)
    assert np.median(np.abs(radii - 1)) < 1.5 * GSD
    assert found.left_out[0]


def test_views_that_contradict_the_others_are_named_and_left_out(caplog):
    """One with the pose of another, one with the mask of something else."""
    half = np.array([0.8, 0.6, 0.5])
    maps = phase_maps_of(box(half), VIEWS, noise=np.radians(0.5))
    exchanged = replace(VIEWS[3], cam_from_world=VIEWS[4].cam_from_world)
    corner = np.zeros_like(maps[9].region.inside)
    corner[:20, :20] = True
    maps[3] = replace(maps[3], view=exchanged)
    maps[9] = replace(maps[9], region=Region(corner, corner, np.zeros_like(corner)))
    found = reconstruct(maps)
    assert np.flatnonzero(found.left_out).tolist() == [3, 9]
    told = [record.message for record in caplog.records if "is inconsistent" in record.message]
    assert [VIEWS[index].name in told[place] for place, index in enumerate((3, 9))] == [True, True]
    cloud = surface_points(found, [maps[0], maps[6]], 0.5 * GSD).cloud
    off = np.abs(box(half)(cloud.points))
    assert np.quantile(off, 0.9) < 2 * GSD


def test_views_that_agree_are_all_kept(surface):
    assert not surface.left_out.any()


def half_unpolarized(phase_map):
    """The phase map of a view that shows half of the object only, and nothing wrong."""
    inside = phase_map.region.inside.copy()
    inside[:, inside.shape[1] // 2 :] = False
    return replace(phase_map, region=Region(inside, inside, np.zeros_like(inside)))


def test_a_view_that_shows_half_of_the_object_takes_no_half_away(maps):
    found = reconstruct([*maps[:7], half_unpolarized(maps[7]), *maps[8:]], masks_given=True)
    assert not found.left_out.any()
    assert np.ptp(found.mesh.vertices, axis=0).min() > 1.8


def test_outlines_are_held_against_a_mesh(maps):
    views = seen_in(maps[:3], masks_given=True)
    views[1] = surface_view(
        half_unpolarized(maps[1]), find_silhouette(half_unpolarized(maps[1]), mask_given=True)
    )
    ball = extracted(sphere(), step=0.05)
    whole, half, also_whole = outline_mismatch(ball, views)
    assert half == pytest.approx(0.5, abs=0.08)  # as much as a column of those asked
    assert max(whole, also_whole) < 0.06  # a pixel of its border, asked every fourth
    away = ball.moved(np.broadcast_to([0.0, 0.0, 5.0], ball.vertices.shape))
    assert (outline_mismatch(away, views) == 1).all()


@pytest.mark.parametrize(("top", "loses"), [(0.5, True), (0.9, False)])
def test_what_is_carved_keeps_the_silhouettes(top, loses):
    """The views see a ball cut at half its radius as lower by 15 px, at a tenth by 3 px."""
    views = seen_in(phase_maps_of(sphere(), VIEWS), masks_given=True)
    ball = extracted(sphere(), step=0.05)
    cut = extracted(lambda p: np.maximum(sphere()(p), p[..., 2] - top), step=0.05)
    assert loses_silhouettes(ball, cut, views, margin_px=4.0) is loses
    few = [replace(view, silhouette=nothing_in(view)) for view in views[:7]]
    assert not loses_silhouettes(ball, cut, [*few, *views[7:]], margin_px=4.0)


def nothing_in(view):
    return Silhouette(*np.zeros((2, *view.silhouette.certain.shape), bool))


def test_several_objects():
    pair = union(sphere(0.45, (0.75, 0, 0)), sphere(0.45, (-0.75, 0, 0)))
    found = reconstruct(phase_maps_of(pair, VIEWS))
    assert not isinstance(found, Undetermined)
    assert len(set(found.mesh.face_components)) == 2
    assert np.median(np.abs(pair(found.mesh.vertices))) < GSD


def dish(radius=1.6, wall=0.07, rim=0.2):
    """A part of a ball's shell, its lowest point 0.3 below the origin; walls of two pixels."""

    def distance(p):
        shell = np.linalg.norm(p - [0, 0, radius - 0.3], axis=-1) - radius + wall / 2
        return np.maximum(np.abs(shell) - wall / 2, p[..., 2] - rim)

    return distance


@pytest.mark.slow
def test_walls_thinner_than_coarse_edges_are_kept():
    """Edges of 10 px jump over a wall of two; it is widened until edges are short enough."""
    maps = phase_maps_of(dish(), ring_of_views(16, elevations=(25.0, 50.0)))
    steps = []
    found = reconstruct(maps, tolerances=None, on_progress=steps.append)
    assert not isinstance(found, Undetermined)
    assert found.contradictions.uncovered_share < 0.1
    assert sum(steps) <= num_surface_steps(len(maps))
    x, y = np.meshgrid([-0.4, 0.0, 0.4], [-0.4, 0.0, 0.4])
    inner = np.stack([x, y, 1.3 - np.sqrt(1.53**2 - x**2 - y**2)], axis=-1).reshape(-1, 3)
    place, _, _ = RayScene(found.mesh.only(found.supported)).closest(inner)
    assert np.linalg.norm(place - inner, axis=1).max() < 1.5 * GSD


def tumbler(radius=0.9, wall=5 * GSD, half_height=0.9):
    """A vessel as deep as wide, whose floor is twice as thick as its wall."""

    def distance(p):
        from_axis, height = np.hypot(p[..., 0], p[..., 1]), p[..., 2]
        inside = np.maximum(from_axis - radius + wall, 2 * wall - half_height - height)
        return np.maximum(np.maximum(from_axis - radius, np.abs(height) - half_height), -inside)

    return distance


def test_the_inside_of_a_wall_of_five_pixels_is_found():
    """A mesh with cells of four pixels has holes in it, and the wall seems thicker."""
    views = ring_of_views(12, elevations=(30.0, 60.0))
    maps = phase_maps_of(tumbler(), views, noise=np.radians(0.5))
    found = reconstruct(maps, masks_given=True)
    assert not isinstance(found, Undetermined)
    centers = found.mesh.centers[found.supported]
    # The wall of the holed mesh is half a pixel too thick; on the top edges, phases are mixed.
    assert np.percentile(np.abs(tumbler()(centers)), 75) < 0.25 * GSD
    on_wall = np.abs(np.hypot(centers[:, 0], centers[:, 1]) - 0.9 + 5 * GSD) < 0.25 * GSD
    assert on_wall.mean() > 0.25


def tumbler_with_round_rim(p, radius=0.9, wall=8 * GSD, half_height=0.9):
    """The vessel with a half circle on its wall."""
    from_axis, height = np.hypot(p[..., 0], p[..., 1]), p[..., 2]
    across, above = from_axis - radius + 0.5 * wall, height - half_height + 0.5 * wall
    side = np.where(above > 0, np.hypot(across, above), np.abs(across)) - 0.5 * wall
    floor = np.maximum(from_axis - radius, height + half_height - 2 * wall)
    return np.maximum(np.minimum(side, floor), -half_height - height)


def test_walls_that_the_rim_shows_are_inferred_where_phases_deny_them():
    """Light in a vessel was reflected several times: here its phases are those of no surface."""
    views, maps = ring_of_views(12, elevations=(30.0, 60.0)), []
    turns = np.random.default_rng(0).uniform(0, 2 * np.pi, len(views))
    made = phase_maps_of(tumbler_with_round_rim, views, noise=np.radians(0.5))
    for one, turn in zip(made, turns, strict=True):
        ranges, _ = trace(tumbler_with_round_rim, one.view)
        xy = pixel_centers(one.view.camera.width, one.view.camera.height)
        rays = one.view.rays_in_world(xy)
        x, y, z = np.moveaxis(
            one.view.center_in_world + np.nan_to_num(ranges, posinf=0.0)[..., None] * rays, -1, 0
        )
        inside = (np.hypot(x, y) < 0.9 - 7.9 * GSD) & (z < 0.9 - 4 * GSD) & np.isfinite(ranges)
        turned = one.polarization.copy()
        cosine, sine = np.cos(turn), np.sin(turn)
        turned[inside, :2] = turned[inside, :2] @ np.array([[cosine, sine], [-sine, cosine]])
        maps.append(one.changed(polarization=turned))
    found = reconstruct(maps, masks_given=True)
    assert not isinstance(found, Undetermined)
    centers = found.mesh.centers
    from_axis = np.hypot(centers[:, 0], centers[:, 1])
    on_wall = (np.abs(from_axis - 0.9 + 8 * GSD) < GSD) & (np.abs(centers[:, 2] - 0.2) < 0.3)
    assert on_wall.sum() > 500
    assert found.inferred[on_wall].mean() > 0.8
    assert not found.contradicted[on_wall].any()


def drum(points):
    beside = np.hypot(points[..., 0], points[..., 1]) - 1
    return np.maximum(beside, np.abs(points[..., 2]) - 0.5)


@pytest.mark.parametrize(
    ("distance", "height", "is_flat"), [(drum, 0.5, True), (sphere(), 0.97, False)]
)
def test_a_plane_carves_a_flat_top_and_not_a_round_one(distance, height, is_flat):
    """The hull has a cap above either; points of a tangent plane look like those of a flat top."""
    maps = phase_maps_of(distance, VIEWS)
    hull = visual_hull(seen_in(maps, masks_given=True))
    around = np.linspace(0, 2 * np.pi, 6, endpoint=False)
    points = np.column_stack([0.2 * np.cos(around), 0.2 * np.sin(around), np.full(6, height)])
    seeds = Seeds(points, np.tile([0, 0, 1.0], (6, 1)), np.full(6, 1e-3))
    (patch,) = find_patches(seeds)
    groups = patch_groups([patch], seeds, patch_scene(maps, PPA))
    steps = stepped_patches(groups, surface=RayScene(hull.mesh))
    above = np.random.default_rng(0).uniform([-0.8, -0.8, 0], [0.8, 0.8, 0.2], (500, 3))
    above = above[np.hypot(*above.T[:2]) < 0.8] + [0, 0, height + GSD]
    free = [(group.values(above) > 0).mean() for group in steps]
    assert (min(free) > 0.95) if is_flat else not any(free)


def with_regions(maps, inside):
    none = np.zeros(inside.shape, bool)
    return [replace(m, region=Region(inside, inside, none)) for m in maps]


def test_undetermined_is_said(maps):
    none = np.zeros_like(maps[0].region.inside)
    assert "no view shows" in reconstruct(with_regions(maps, none)).reason
    assert "fills the images" in reconstruct(with_regions(maps, ~none)).reason or "outline" in (
        reconstruct(with_regions(maps, ~none)).reason
    )
    assert "of 3 needed" in reconstruct(maps[:2]).reason
    corner = none.copy()
    corner[:9, :9] = True
    assert "no common object" in reconstruct(with_regions(maps, corner)).reason


def test_inferred_faces_can_be_left_out(surface, maps):
    """Neither mesh nor cloud then has them."""
    upper = surface.mesh.centers[:, 2] > 0
    guessed = replace(surface, inferred=surface.supported & upper)
    assert surface_points(guessed, maps, 0.5 * GSD).inferred.any()
    shown = guessed.shown()
    assert supported_mesh(shown).vertices[:, 2].max() < supported_mesh(guessed).vertices[:, 2].max()
    assert len(supported_mesh(shown).triangles) == (surface.supported & ~upper).sum()
    cloud = surface_points(shown, maps, 0.5 * GSD)
    assert not cloud.inferred.any()
    assert cloud.cloud.points[:, 2].max() < 2.5 * GSD  # an edge of a face


def test_contradicted_faces_have_neither_points_nor_depths(surface, maps):
    upper = surface.mesh.centers[:, 2] > 0
    doubted = replace(surface, contradicted=upper)
    assert len(supported_mesh(doubted).triangles) == surface.supported.sum()
    cloud = surface_points(doubted, maps, 0.5 * GSD).cloud
    assert len(cloud.points)
    assert cloud.points[:, 2].max() < 2.5 * GSD  # an edge of a face
    scene = RayScene(surface.mesh)
    whole = render_view(surface, scene, maps[0].view, 2)
    part = render_view(doubted, scene, maps[0].view, 2)
    assert 0 < (part.range_map > 0).sum() < (whole.range_map > 0).sum()


def test_progress_is_within_what_is_announced(maps):
    steps = []
    reconstruct(maps[:4], on_progress=steps.append)
    assert 0 < sum(steps) <= num_surface_steps(4)


def test_the_surface_is_shown_as_it_refines(maps):
    """First the hull, then the mesh after each level; the last is near the result."""
    surface = reconstruct(maps)
    shown = surface.levels
    assert len(shown) == 1 + len(QUICK.levels)
    sizes = [float(np.ptp(mesh.vertices, axis=0).max()) for mesh in shown]
    assert sizes[-1] == pytest.approx(float(np.ptp(surface.mesh.vertices, axis=0).max()), rel=0.05)
    assert sizes[0] >= sizes[-1]


def test_contradictions_are_put_in_words():
    fine = Contradictions(
        phase_sine=0.01, contradicted_share=0.02, denied_share=0.0, uncovered_share=0.03
    )
    assert fine.warnings() == []
    bad = replace(fine, contradicted_share=0.4, denied_share=0.2, uncovered_share=0.5)
    assert [w.split()[0] for w in bad.warnings()] == ["on", "20%", "50%"]
    assert replace(fine, point_offset_px=1.2, point_offset_sigmas=2.0).warnings() == []
    (shifted,) = replace(fine, point_offset_px=-1.2, point_offset_sigmas=-4.0).warnings()
    assert "1.2 px inside of the sparse points" in shifted
