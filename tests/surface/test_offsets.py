"""Patches and their borders on analytic plates with steps and recesses."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
import trimesh
from scenes import phase_map_of

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import Seeds
from polmvs.surface.borders import smoothly_beside
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh
from polmvs.surface.offsets import (
    Patch,
    PatchGrid,
    SteppedPatches,
    find_patches,
    free_spaces,
    patch_groups,
    patch_scene,
    snapped_border,
    stepped_patches,
)
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Group, Plane, Sphere

CAMERA = PinholeCamera(width=320, height=256, fx=270.0, fy=270.0, cx=160.0, cy=128.0)
PLATE, BOX = 0.14, 0.055  # half sides, m
GSD = 0.6 / 270
SIGMA = 2e-4


def unit(vector):
    return np.asarray(vector, float) / np.linalg.norm(vector)


def tilted(deg):
    return np.array([np.sin(np.radians(deg)), 0.0, np.cos(np.radians(deg))])


def walls(half, top_normal, top_point, low):
    """Sides of a box from a (tilted) top down to height ``low``, each as one upright rectangle."""
    # Uprights of constant height would stick out of a tilted top: strips of the height under it.
    strips = []
    num = 1 if abs(top_normal[0]) < 1e-9 else 24
    edges = np.linspace(-half, half, num + 1)
    height = top_point[2] - top_normal[0] / top_normal[2] * (edges - top_point[0])
    for sign in (-1, 1):
        for a, b, h in zip(edges[:-1], edges[1:], 0.5 * (height[:-1] + height[1:]), strict=True):
            middle = [0.5 * (a + b), sign * half, 0.5 * (h + low)]
            extent = (0.5 * (b - a), 0.5 * abs(h - low))
            strips.append(Plane(middle, [0.0, 1.0, 0.0], extent))
        h = height[0] if sign < 0 else height[-1]
        extent = (half, 0.5 * abs(h - low))
        strips.append(Plane([sign * half, 0.0, 0.5 * (h + low)], [1.0, 0.0, 0.0], extent))
    return strips


@dataclass(frozen=True)
class Scene:
    maps: list
    seeds: Seeds
    true_height: object  # of (N, 2)


def step_scene(height, tilt_deg=0.0, num_views=9, noise=SIGMA, top_gain=1.0, diffuse_dolp=None):
    """A plate with a box on it (or a recess in it), ten and nine points on the two patches.

    The box's top is brighter by ``top_gain``. With ``diffuse_dolp``, the plate shows diffuse light
    of that DoLP beside the box, where it mirrors the dark walls.
    """
    normal = tilted(tilt_deg)
    lift = BOX * np.tan(np.radians(tilt_deg))  # so that the lower edge of the top is at height
    top = np.array([0.0, 0.0, height + np.sign(height) * lift])
    side = BOX / normal[2]
    surfaces = [Plane(top, normal, (side, BOX)), *walls(BOX, normal, top, 0.0)]
    if height > 0:
        surfaces.append(Plane([0, 0, 0], [0, 0, 1], (PLATE, PLATE)))
    else:
        wide, middle = 0.5 * (PLATE - BOX), 0.5 * (PLATE + BOX)
        for sign in (-1, 1):
            surfaces.append(Plane([sign * middle, 0, 0], [0, 0, 1], (wide, PLATE)))
            surfaces.append(Plane([0, sign * middle, 0], [0, 0, 1], (BOX, wide)))
    views = ring_of_views(num_views, CAMERA, distance=0.6, elevation_deg=50, roll_deg=10)
    maps = []
    for view in views:
        seen = render_view(view, Group(surfaces), s0=0.2, background=0.6)
        rays = view.rays_in_world(pixel_centers(CAMERA.width, CAMERA.height))
        points = view.center_in_world + np.where(seen.mask, seen.range, 0)[..., None] * rays
        on_top = seen.mask & (np.abs((points - top) @ normal) < 1e-6)
        gain = np.where(on_top, top_gain, 1.0)
        intensities = gain * seen.intensities
        if diffuse_dolp is not None:
            beside = seen.mask & (np.abs(points[..., 2]) < 1e-6)
            beside &= np.abs(points[..., :2]).max(axis=-1) < 1.4 * BOX
            mean = intensities.mean(axis=0)
            swing = intensities - mean
            dolp = np.sqrt(2 * np.mean(swing**2, axis=0)) / np.maximum(mean, 1e-9)
            turned = mean - diffuse_dolp / np.maximum(dolp, 1e-3) * swing
            intensities = np.where(beside, turned, intensities)
        maps.append(phase_map_of(replace(seen, intensities=intensities)))
    rng = np.random.default_rng(1)
    grid = np.stack(np.meshgrid([-0.6, 0.0, 0.6], [-0.6, 0.0, 0.6]), axis=-1).reshape(-1, 2)
    on_top = BOX * grid
    ring = np.linspace(0, 2 * np.pi, 10, endpoint=False)
    on_plate = 0.097 * np.stack([np.cos(ring), np.sin(ring)], axis=1)
    rise = top[2] - normal[0] / normal[2] * on_top[:, 0]
    points = np.concatenate([np.column_stack([on_top, rise]), np.pad(on_plate, ((0, 0), (0, 1)))])
    normals = np.concatenate([np.tile(normal, (9, 1)), np.tile([0.0, 0.0, 1.0], (10, 1))])
    points += rng.normal(0, noise, points.shape)
    normals = unit_rows(normals + rng.normal(0, 0.003, normals.shape))

    def true_height(xy):
        inside = (np.abs(xy) < BOX).all(axis=-1)
        return np.where(inside, top[2] - normal[0] / normal[2] * xy[..., 0], 0.0)

    return Scene(maps, Seeds(points, normals, np.full(len(points), SIGMA)), true_height)


def unit_rows(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)


def column_points(num=4000, seed=0):
    """Points above and below the plate and the box, off the borders by three GSDs."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(-1, 1, (num, 3)) * [0.9 * PLATE, 0.9 * PLATE, 0.06]
    from_wall = np.abs(np.abs(points[:, :2]).max(axis=1) - BOX)
    return points[from_wall > 3 * GSD]


@pytest.mark.parametrize(
    ("height", "tilt_deg"),
    [(0.03, 0.0), (0.01, 0.0), pytest.param(0.03, 15.0, marks=pytest.mark.slow), (-0.02, 0.0)],
)
def test_space_above_the_faces_of_a_step_is_free(height, tilt_deg):
    scene = step_scene(height, tilt_deg)
    patches = find_patches(scene.seeds)
    assert sorted(len(patch.members) for patch in patches) == [9, 10]
    (group,) = steps_of(scene.seeds, scene.maps)
    points = column_points()
    above = points[:, 2] - scene.true_height(points[:, :2])
    clear = np.abs(above) > 1e-3
    free = group.values(points) > 0
    assert np.mean(free[clear] == (above[clear] > 0)) > 0.99
    # Near a patch its distance is the value itself, to a fraction of a millimetre.
    near = (np.abs(above) < 3e-3) & (np.abs(np.abs(points[:, :2]).max(axis=1) - BOX) > 0.015)
    cosine = np.where(np.abs(points[near, :2]).max(axis=1) < BOX, np.cos(np.radians(tilt_deg)), 1)
    assert np.quantile(np.abs(group.values(points[near]) - above[near] * cosine), 0.95) < 5e-4


def steps_of(seeds, maps, **given):
    groups = patch_groups(find_patches(seeds), seeds, patch_scene(maps, AngleModel.PPA))
    return stepped_patches(groups, **given)


def free_share(scene):
    """Share of the points above the plate beside the box that are free, and of those in the box."""
    (group,) = steps_of(scene.seeds, scene.maps)
    points = column_points()
    outside = np.abs(points[:, :2]).max(axis=1)
    free = group.values(points) > 0
    above = points[:, 2] > 1e-3
    beside = above & (outside > BOX) & (outside < 1.4 * BOX)
    within = above & (outside < BOX) & (points[:, 2] < 0.029)
    return free[beside].mean(), free[within].mean()


def test_diffuse_light_beside_a_wall_is_no_obstacle():
    """Specular light of that strength is: its plane of incidence is another."""
    free, in_box = free_share(step_scene(0.03, diffuse_dolp=0.05))
    assert free > 0.99
    assert in_box < 0.01
    free, _ = free_share(step_scene(0.03, diffuse_dolp=0.4))
    assert free < 0.7


@pytest.mark.parametrize(("top_gain", "most"), [(1.2, 0.12), (1.0, 0.6)])
def test_walls_stand_where_the_intensity_steps(top_gain, most):
    """To a tenth of a pixel; without a step, the labels' cells end at most half of one beside it.

    Polarization alone shows the border then, whose steps the regions' smoothing widens.
    """
    scene = step_scene(0.03, top_gain=top_gain)
    (group,) = steps_of(scene.seeds, scene.maps)
    along = np.linspace(-0.7, 0.7, 41) * BOX
    beside = np.arange(-3, 3.05, 0.1) * GSD
    medians, squares = [], []
    for axis in (0, 1):
        for sign in (-1, 1):
            points = np.full((len(beside), len(along), 3), 0.015)
            points[..., axis] = sign * (BOX + beside[:, None])
            points[..., 1 - axis] = along
            free = group.values(points.reshape(-1, 3)).reshape(points.shape[:2]) > 0
            off = beside[free.argmax(axis=0)] / GSD - 0.05
            medians.append(np.median(off))
            squares.append(np.mean(off**2))
    assert np.abs(medians).max() < most
    assert np.sqrt(np.mean(squares)) < most


def height_field(height) -> RayScene:
    """The surface at ``height(xy)`` (N, 2) over the plate."""
    num = 141
    side = np.linspace(-PLATE, PLATE, num)
    xy = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    first = np.arange(num * num).reshape(num, num)[:-1, :-1].ravel()
    lower = np.stack([first, first + num, first + num + 1], axis=1)
    upper = np.stack([first, first + num + 1, first + 1], axis=1)
    return RayScene(TriangleMesh(np.column_stack([xy, height(xy)]), np.concatenate([lower, upper])))


def test_a_surface_that_explains_all_phases_is_left_alone():
    scene = step_scene(0.03, num_views=3)
    (group,) = steps_of(
        scene.seeds,
        scene.maps,
        surface=height_field(scene.true_height),
        is_refined=True,
    )
    points = column_points()
    depth = scene.true_height(points[:, :2]) - points[:, 2]
    assert not (group.values(points[depth > 1e-3]) > 0).any()


def test_a_recess_ends_at_its_walls_where_its_rim_has_no_points():
    """The phases of its floor are those of the rim; only views of its walls contradict either."""
    scene = step_scene(-0.02, top_gain=1.0)
    of_floor = (scene.seeds.points_in_world[:9], scene.seeds.normals_in_world[:9])
    floor = Seeds(*of_floor, scene.seeds.sigma[:9])
    (group,) = steps_of(
        floor,
        scene.maps,
        surface=height_field(lambda xy: np.zeros(len(xy))),
        is_refined=True,
    )
    points = column_points()
    points = points[(points[:, 2] < -1e-3) & (points[:, 2] > -0.019)]
    inside = (np.abs(points[:, :2]) < BOX).all(axis=1)
    free = group.values(points) > 0
    assert free[inside].mean() > 0.98
    assert free[~inside].mean() < 0.02


@pytest.mark.parametrize("knows_the_ball", [False, True])
def test_what_stands_on_a_face_is_not_carved(knows_the_ball):
    radius, center = 0.04, np.array([0.0, 0.0, 0.03])
    ball = Sphere(center, radius)
    surface = Group([Plane([0, 0, 0], [0, 0, 1], (PLATE, PLATE)), ball])
    views = ring_of_views(9, CAMERA, distance=0.6, elevation_deg=50, roll_deg=10)
    maps = [phase_map_of(render_view(view, surface, s0=0.2, background=0.6)) for view in views]
    ring = np.linspace(0, 2 * np.pi, 12, endpoint=False)
    points = 0.1 * np.stack([np.cos(ring), np.sin(ring), np.zeros(12)], axis=1)
    seeds = Seeds(points, np.tile([0.0, 0.0, 1.0], (12, 1)), np.full(12, SIGMA))
    given = None
    if knows_the_ball:
        sphere = trimesh.creation.icosphere(subdivisions=5, radius=radius)
        given = RayScene(
            TriangleMesh(np.asarray(sphere.vertices) + center, np.asarray(sphere.faces, np.int64))
        )
    (group,) = steps_of(seeds, maps, surface=given)
    rng = np.random.default_rng(0)
    inside = rng.normal(size=(500, 3))
    inside = center + 0.8 * radius * inside / np.linalg.norm(inside, axis=1, keepdims=True)
    inside = inside[inside[:, 2] > 0.004]
    assert np.mean(group.values(inside) > 0) < 0.01
    assert (group.values(points + np.array([0, 0, 0.01])) > 0.005).all()


def test_false_matches_among_the_points_of_a_face_are_no_face():
    rng = np.random.default_rng(0)
    points = np.column_stack([rng.uniform(-0.1, 0.1, (40, 2)), np.zeros(40)])
    points[30:, 2] = -0.004  # mirror images, all at one depth
    normals = unit_rows(np.array([0.0, 0.0, 1.0]) + rng.normal(0, 0.003, (40, 3)))
    points += rng.normal(0, SIGMA, points.shape)
    (patch,) = find_patches(Seeds(points, normals, np.full(40, SIGMA)))
    assert set(patch.members) <= set(range(30))
    assert len(patch.members) >= 28
    assert abs(patch.offset) < SIGMA
    np.testing.assert_allclose(patch.normal, [0, 0, 1], atol=2e-3)


def test_points_of_a_curved_surface_or_too_few_make_no_large_face():
    rng = np.random.default_rng(0)
    normals = unit_rows(rng.normal(size=(60, 3)) + np.array([0, 0, 2]))
    ball = Seeds(0.05 * normals, normals, np.full(60, SIGMA))
    # Neighbours that share a tangent plane by chance, at most.
    assert all(len(patch.members) < 8 for patch in find_patches(ball))
    flat = np.column_stack([rng.uniform(size=(3, 2)), np.zeros(3)])
    few = Seeds(flat, np.tile([0.0, 0.0, 1.0], (3, 1)), np.full(3, SIGMA))
    assert find_patches(few) == ()
    unknown = Seeds(0.05 * normals, np.full((60, 3), np.nan), np.full(60, SIGMA))
    assert find_patches(unknown) == ()
    assert steps_of(few, []) == ()


def face_seeds(xy, height):
    """Seeds at places (N, 2) of a level patch."""
    points = np.column_stack([xy, np.full(len(xy), height)])
    return Seeds(points, np.tile([0.0, 0.0, 1.0], (len(xy), 1)), np.full(len(xy), SIGMA))


@pytest.mark.parametrize("below", [0.03, -0.03])
def test_few_points_around_many_of_another_face_are_a_face(below):
    """Their nearest neighbours are the other's; around it, or above, no mirror image lies."""
    rng = np.random.default_rng(0)
    many = rng.uniform(-0.05, 0.05, (40, 2))
    angles = np.arange(7) * 2 * np.pi / 7
    around = (0.09 if below > 0 else 0.04) * np.column_stack([np.cos(angles), np.sin(angles)])
    parts = [face_seeds(many, below), face_seeds(around, 0.0)]
    seeds = Seeds(
        *(
            np.concatenate([getattr(part, name) for part in parts])
            for name in ("points_in_world", "normals_in_world", "sigma")
        )
    )
    assert sorted(len(patch.members) for patch in find_patches(seeds)) == [7, 40]


def test_a_border_follows_its_lines_around_corners():
    """A turned square, drawn too small and without its corners; noise stands for texture."""
    rows, cols = np.indices((160, 160))
    turn = np.radians(35.0)
    u = np.cos(turn) * (cols - 80) + np.sin(turn) * (rows - 80)
    v = -np.sin(turn) * (cols - 80) + np.cos(turn) * (rows - 80)
    beside = np.maximum(np.abs(u), np.abs(v)) - 40  # distance to the square, negative inside
    jump = 10 * np.exp(-0.5 * beside**2) + np.abs(np.random.default_rng(0).standard_normal(u.shape))
    octagon = np.maximum(beside + 4, (np.abs(u) + np.abs(v)) / np.sqrt(2) - 44)
    found = snapped_border(np.where(octagon < 0, 1, 0), 1, jump, 12.0, 4.0) == 1
    wrong = found != (beside < 0)
    assert np.abs(beside[wrong]).max() < 1.5
    corners = (np.abs(u) > 33) & (np.abs(v) > 33) & (beside < -1.5)
    assert found[corners].all()


def test_what_stands_on_the_lowest_face_is_solid():
    scene = step_scene(0.03, 0.0)
    (group,) = steps_of(scene.seeds, scene.maps)
    points = column_points()
    inside = (np.abs(points[:, :2]) < BOX).all(axis=1) & (points[:, 2] > 0) & (points[:, 2] < 0.03)
    clear = np.minimum(np.abs(points[:, 2]), np.abs(points[:, 2] - 0.03)) > 1e-3
    assert np.mean((group.solid(points) < 0)[clear] == inside[clear]) > 0.99
    assert np.isinf(group.solid(np.array([[0.9 * PLATE, 0.0, 0.01]]))).all()


def whole_patch(normal, first, shown):
    """A patch through the origin that the cells of a grid show, 1 mm each, (0, 0) in the middle."""
    second = np.cross(normal, first)
    origin = -1e-3 * (np.array(shown.shape) // 2) @ np.stack([first, second])
    grid = PatchGrid(origin, first, second, np.asarray(normal), 1e-3, shown.shape)
    patch = Patch(np.asarray(normal), 0.0, np.zeros(0, np.int64))
    beside = smoothly_beside(shown)[None].astype(np.float32)
    return SteppedPatches((patch,), grid, np.where(shown, 0, -1), shown, beside)


def test_a_wall_whose_border_is_too_low_cuts_no_groove():
    """A floor z = 0 reaches from a wall x = 0 to x = 40 mm; the wall's border lies 3 mm too low."""
    x, y, z = np.eye(3)
    rows, cols = np.indices((101, 101)) - 50
    floor = whole_patch(z, x, (rows > 0) & (rows < 40) & (abs(cols) < 40))
    wall = whole_patch(x, y, (cols > -3) & (cols < 40) & (abs(rows) < 40))
    rng = np.random.default_rng(0)
    points = rng.uniform((5e-3, -0.03, -2.5e-3), (0.035, 0.03, -0.5e-3), (500, 3))
    assert (wall.values(points) > 0).all()  # the groove
    over = points * (1, 1, -1)
    free = np.max([one(points) for one in free_spaces([floor, wall])], axis=0)
    assert (free < 0).all()
    np.testing.assert_allclose(free, points[:, 2], atol=1e-4)  # the floor's own distance
    assert (np.max([one(over) for one in free_spaces([floor, wall])], axis=0) > 0).all()
    # The floor shows nothing of what lies far below it.
    deep = points - (0, 0, 0.03)
    np.testing.assert_array_equal(free_spaces([floor, wall])[1](deep), wall.values(deep))
