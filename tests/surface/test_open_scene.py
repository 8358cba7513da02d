"""A desk: things on a ground that fills the images, so that silhouettes bound nothing."""

import numpy as np
import pytest
from analytic_objects import box, extracted, phase_maps_of, ring_of_views, sphere, trace, union

from polmvs.geometry import dots
from polmvs.neighbors import point_spacings
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import Seeds
from polmvs.surface.global_surface import SparsePoints, reconstruct_surface, surface_points
from polmvs.surface.held_out import HeldOutTolerances, predict_left_out
from polmvs.surface.mesh_geometry import RayScene
from polmvs.surface.observations import Looking
from polmvs.surface.open_scene import OpenScene, open_scene
from polmvs.surface.poisson import MIN_POINTS, MeshTolerances
from polmvs.surface.solver import Level, SolverTolerances
from polmvs.surface.surface_view import Silhouette, SurfaceView, surface_view

LOOKING = Looking(angle_model=AngleModel.PPA)
NO_SEEDS = Seeds(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
GSD = 5 / 150
QUICK = SolverTolerances(
    levels=(
        Level(edge_px=5.0, num_steps=8, loss_scale=12.0, gate_px=25.0),
        Level(edge_px=2.5, num_steps=5, loss_scale=4.0, gate_px=4.0),
    )
)
COARSE = HeldOutTolerances(levels=QUICK.levels[:1], careful_levels=QUICK.levels[:1])
GROUND_M = -0.4


def desk(points: np.ndarray) -> np.ndarray:
    ground = box((6.0, 6.0, 0.2))(points - (0, 0, GROUND_M - 0.2))
    return np.minimum(
        ground, union(sphere(0.55, (0.45, 0.2, 0.0)), sphere(0.4, (-0.6, -0.4, -0.1)))(points)
    )


@pytest.fixture(scope="module")
def views() -> list[SurfaceView]:
    """Silhouettes are what happens to be polarized: a disc somewhere else in each view."""
    rng = np.random.default_rng(0)
    found = []
    for one in phase_maps_of(desk, ring_of_views(8, elevations=(50.0, 70.0)), noise=0.01):
        rows, cols = np.indices(one.intensity.shape)
        middle = rng.uniform(0.25, 0.75, 2) * one.intensity.shape
        disc = (rows - middle[0]) ** 2 + (cols - middle[1]) ** 2 < 15**2
        found.append(surface_view(one, Silhouette(disc, disc)))
    return found


@pytest.fixture(scope="module")
def points(views) -> Seeds:
    """Sparse points where views see the desk, two thirds with a normal."""
    rng = np.random.default_rng(1)
    places = []
    for view in views:
        ranges, _ = trace(desk, view.view)
        rows, cols = np.nonzero(np.isfinite(ranges))
        chosen = rng.choice(len(rows), 60, replace=False)
        rows, cols = rows[chosen], cols[chosen]
        rays = view.view.rays_in_world(np.column_stack([cols, rows]) + 0.5)
        places.append(view.center + ranges[rows, cols, None] * rays)
    place = np.concatenate(places)
    step = 1e-5 * np.eye(3)
    normals = np.stack([desk(place + e) - desk(place - e) for e in step], axis=1)
    normals += 0.1 * np.linalg.norm(normals, axis=1, keepdims=True) * rng.normal(size=place.shape)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals[::3] = np.nan
    place += 0.3 * GSD * rng.normal(size=place.shape)
    return Seeds(place, normals, np.full(len(place), 0.3 * GSD))


@pytest.fixture(scope="module")
def surface(views, points):
    return reconstruct_surface(
        LOOKING, views, SparsePoints(NO_SEEDS, np.zeros((0, 3)), points), tolerances=QUICK
    )


def test_the_surface_is_the_desk(surface, views) -> None:
    assert not surface.is_bounded
    cloud = surface_points(surface, [view.phase_map for view in views], 0.5 * GSD).cloud
    assert len(cloud.points) > 5000
    assert np.median(np.abs(desk(cloud.points))) < 0.2 * GSD
    assert np.quantile(np.abs(desk(cloud.points)), 0.95) < GSD
    true = RayScene(extracted(desk, half=3.0, step=0.05))
    _, face, _ = true.closest(cloud.points)
    angle = np.degrees(np.arccos(np.clip(dots(true.mesh.face_normals[face], cloud.normals), -1, 1)))
    assert np.median(angle) < 2.5
    # The ground about the things, and their tops.
    height = cloud.points[:, 2]
    assert (np.abs(height - GROUND_M) < GSD).mean() > 0.3
    assert height.max() == pytest.approx(0.55, abs=GSD)


def test_what_closes_the_surface_is_not_in_the_result(surface) -> None:
    """The first surface has walls about the points and a bottom; no view supports them."""
    kept = surface.mesh.centers[surface.measured]
    assert (np.abs(desk(kept)) < 2 * GSD).mean() > 0.97


def test_silhouettes_that_are_certain_stay(views, points) -> None:
    """A user's masks bound the object, also where they contradict each other."""
    found = reconstruct_surface(
        LOOKING, views, SparsePoints(NO_SEEDS, np.zeros((0, 3))), tolerances=QUICK
    )
    assert getattr(found, "is_bounded", True)


def test_few_points_make_no_scene(views, points) -> None:
    few = np.flatnonzero(np.isfinite(points.normals_in_world).all(axis=1))[: MIN_POINTS - 1]
    some = Seeds(points.points_in_world[few], points.normals_in_world[few], points.sigma[few])
    assert open_scene(some, views) is None


def test_an_object_among_unpolarized_things_is_no_scene(views, points) -> None:
    normals = points.normals_in_world.copy()
    normals[: len(normals) // 3] = np.nan
    some = Seeds(points.points_in_world, normals, points.sigma)
    assert open_scene(points, views) is not None
    assert np.isfinite(normals).all(axis=1).sum() > MIN_POINTS
    assert open_scene(some, views) is None


def test_held_out_views_are_predicted(views, points) -> None:
    scene = open_scene(points, views)
    assert isinstance(scene, OpenScene)
    assert not any(view.has_outline for view in scene.views)
    found = predict_left_out(
        scene.views, None, LOOKING, scene.known, scene=scene, tolerances=COARSE
    )
    assert found is not None
    assert found.error_deg < 3
    turned = np.roll(points.points_in_world, 1, axis=1)  # another scene
    wrong = open_scene(
        Seeds(turned, np.roll(points.normals_in_world, 1, axis=1), points.sigma), views
    )
    found = predict_left_out(
        wrong.views, None, LOOKING, wrong.known, scene=wrong, tolerances=COARSE
    )
    assert found is None or not found.error_deg < 8


def test_the_scene_is_shown_where_its_points_are(views, points) -> None:
    """Half of the desk has points: views show that half alone."""
    left = points.points_in_world[:, 0] < 0
    half = Seeds(points.points_in_world[left], points.normals_in_world[left], points.sigma[left])
    scene = open_scene(half, views)
    view = scene.views[0]
    rows, cols = np.nonzero(view.silhouette.certain)
    rays = view.view.rays_in_world(np.column_stack([cols, rows]) + 0.5)
    ranges = trace(desk, view.view)[0][rows, cols]
    seen = np.isfinite(ranges)
    shown = view.center + ranges[seen, None] * rays[seen]
    assert seen.mean() > 0.95
    usable = half.points_in_world[np.isfinite(half.normals_in_world).all(axis=1)]
    reach = MeshTolerances.support * np.median(point_spacings(usable))
    assert (shown[:, 0] < 1.1 * reach).mean() > 0.95  # oblique rays pass farther
    assert (shown[:, 0] < 0).sum() > 500
