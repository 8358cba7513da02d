"""What becomes of points that views agree on, see through, or show nothing at."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import board_scene

from polmvs.config import FusionOptions
from polmvs.surface.dense_view import DenseView
from polmvs.surface.fusion import FusedCloud, fuse, merge
from polmvs.synthetic.surfaces import Plane

STRIDE = 2
NUM_VIEWS = 6
UP = np.array([0.1, -0.05, 1.0])
# A patch that hovers above the middle of the board, towards all cameras.
FLOATER = Plane(point=np.array([0.0, 0.0, 0.04]), normal=UP, extent=(0.02, 0.02))


@pytest.fixture(scope="module")
def scene():
    return board_scene(NUM_VIEWS)


def seen_by(scene, k, *surfaces) -> DenseView:
    """What a view would see exactly: the nearest of the surfaces."""
    view = scene.views[k]
    size = (view.camera.height // STRIDE, view.camera.width // STRIDE)
    grid = np.stack(np.meshgrid(np.arange(size[1]), np.arange(size[0])), axis=-1)
    rays = view.camera.rays((grid + 0.5) * STRIDE) @ view.cam_from_world.rotation
    nearest, normals = np.full(size, np.inf), np.full((*size, 3), np.nan)
    for surface in surfaces:
        distance, its_normals = surface.intersect(view.center_in_world, rays.reshape(-1, 3))
        distance, its_normals = distance.reshape(size), its_normals.reshape(*size, 3)
        closer = np.nan_to_num(distance, nan=np.inf) < nearest
        nearest = np.where(closer, distance, nearest)
        normals = np.where(closer[..., None], its_normals, normals)
    known = np.isfinite(nearest)
    flat = np.where(known, np.float32(1), np.float32(0))
    return DenseView(
        stride_px=STRIDE,
        range_map=np.where(known, nearest, 0).astype(np.float32),
        normals_in_world=normals.astype(np.float32),
        sigma_deg=flat,
        sigma=1e-4 * flat,
        confidence=flat,
    )


def heights(cloud) -> np.ndarray:
    """Of the points above the board, m."""
    return cloud.points @ UP / np.linalg.norm(UP)


def fused_with_floater(scene, num_that_see_it: int):
    dense = [
        seen_by(scene, k, scene.surface, *([FLOATER] if k < num_that_see_it else []))
        for k in range(NUM_VIEWS)
    ]
    return fuse(scene.maps, dense, FusionOptions(min_views=2))


def test_the_true_surface_stays_where_it_is(scene) -> None:
    cloud = fused_with_floater(scene, 0)
    assert len(cloud.points) > 1000
    np.testing.assert_allclose(heights(cloud), 0, atol=1e-4)
    assert (cloud.num_views >= 2).all()


def test_what_most_views_see_through_goes_though_enough_agree_on_it(scene) -> None:
    """Two of six views agree on a patch in the air; the others see the board behind it."""
    assert np.abs(heights(fused_with_floater(scene, 2))).max() < 0.01


def test_what_all_views_see_in_the_air_stays(scene) -> None:
    """The twin: the same patch, and nobody sees through it."""
    floating = heights(fused_with_floater(scene, NUM_VIEWS)) > 0.03
    assert floating.sum() > 50


def test_what_one_view_sees_alone_goes(scene) -> None:
    assert np.abs(heights(fused_with_floater(scene, 1))).max() < 0.01


def test_places_are_means_by_certainty(scene) -> None:
    """Of two ranges that differ by less than what they admit the surer one counts for more."""
    dense = [seen_by(scene, k, scene.surface) for k in range(NUM_VIEWS)]
    shift = np.float32(2e-4)
    near = replace(dense[0], range_map=np.where(dense[0].known, dense[0].range_map - shift, 0))
    sure = replace(near, sigma=near.sigma / 4)
    unsure = replace(near, sigma=near.sigma * 4)
    means = [
        np.abs(heights(fuse(scene.maps, [first, *dense[1:]], FusionOptions()))).mean()
        for first in (sure, near, unsure)
    ]
    assert means[0] > means[1] > means[2]


def test_the_deviation_of_a_point_is_not_narrowed_by_the_number_of_views(scene) -> None:
    """Views err alike: six that state a tenth of a millimetre place a point no better than one."""
    dense = [seen_by(scene, k, scene.surface) for k in range(NUM_VIEWS)]
    options = FusionOptions(voxel=0.0)
    two, six = (fuse(scene.maps[:n], dense[:n], options) for n in (2, NUM_VIEWS))
    assert six.num_views.max() == NUM_VIEWS
    for cloud in (two, six):
        # Along the ray a place is less certain the more obliquely it is seen.
        assert np.median(cloud.sigma) == pytest.approx(1e-4, rel=0.15)


def test_what_others_see_no_part_at_goes(scene) -> None:
    """Two views see a patch beside the board, where the regions of the four others are empty."""
    beside = Plane(point=np.array([0.0, 0.2, 0.0]), normal=UP, extent=(0.02, 0.02))
    others = range(2, NUM_VIEWS)
    seen = [seen_by(scene, k, scene.surface, *([beside] * (k < 2))) for k in range(NUM_VIEWS)]
    # Of the others only their regions tell: without a range there they see through nothing.
    alone = fuse(scene.maps[:2], seen[:2], FusionOptions())
    cloud = fuse(scene.maps, seen, FusionOptions())
    far = [int((one.points[:, 1] > 0.175).sum()) for one in (alone, cloud)]
    assert far[0] > 50
    assert far[1] == 0
    assert all(
        not scene.maps[k].shows_surface(scene.views[k].project(beside.point[None])).any()
        for k in others
    )


def test_merged_points_weigh_by_views_and_certainty() -> None:
    cloud = FusedCloud(
        points=np.array([[0.1, 0.1, 0.1], [0.3, 0.1, 0.1], [5.1, 0.1, 0.1]]),
        normals=np.array([[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]),
        intensity=np.array([0.0, 1.0, 0.5], np.float32),
        num_views=np.array([2, 4, 3], np.int32),
        sigma_deg=np.array([1.0, 4.0, 2.0], np.float32),
        sigma=np.array([0.1, 0.2, 0.1], np.float32),
    )
    merged = merge(cloud, 1.0)
    order = np.argsort(merged.points[:, 0])
    # 2 / 0.01 against 4 / 0.04: twice as much.
    np.testing.assert_allclose(merged.points[order, 0], [0.5 / 3, 5.1], rtol=1e-6)
    np.testing.assert_allclose(merged.normals[order[0]], np.array([0, 1, 2]) / np.sqrt(5))
    np.testing.assert_allclose(merged.intensity[order], [1 / 3, 0.5], rtol=1e-6)
    np.testing.assert_allclose(merged.sigma_deg[order], [2, 2], rtol=1e-6)
    assert merged.num_views[order].tolist() == [4, 3]
    assert merge(cloud, 0.0) is cloud
