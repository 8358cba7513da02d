"""Undistorted cameras and warps: against COLMAP, exact planes, edges."""

import numpy as np
import pycolmap
import pytest
from dense_scenes import (
    BOARD,
    FISHEYE,
    NORMAL,
    OPENCV,
    PINHOLE,
    DenseScene,
    board_points,
    board_scene,
    image_shift,
    parallel_views,
    scene_of,
)
from scipy.ndimage import binary_erosion

from polmvs.camera import pixel_centers
from polmvs.colmap.cameras import camera_to_colmap
from polmvs.colmap.maps import map_pixel_xy
from polmvs.colmap.undistort import undistort_xy, undistorted_camera, undistorted_model, warp_image
from polmvs.surface.map_export import warp_dense_view
from polmvs.synthetic.surfaces import Group, Plane, Sphere

CAMERAS = pytest.mark.parametrize(
    "camera", [PINHOLE, OPENCV, FISHEYE], ids=["pinhole", "opencv", "fisheye"]
)


def test_a_pinhole_camera_stays_itself():
    assert undistorted_camera(PINHOLE) == PINHOLE
    assert undistorted_camera(PINHOLE, blank_pixels=1.0) == PINHOLE


def test_size_limit_and_blank_pixels():
    small = undistorted_camera(OPENCV, max_image_size=100)
    assert max(small.width, small.height) <= 100
    whole, inner = undistorted_camera(OPENCV, blank_pixels=1.0), undistorted_camera(OPENCV)
    assert whole.width > inner.width
    _, seen = warp_image(np.ones((128, 160), np.uint8), OPENCV, inner)
    assert seen.mean() > 0.99
    corners = undistort_xy(np.array([[0, 0], [160, 128.0]]), OPENCV, whole)
    assert (corners > -2).all()
    assert (corners < (whole.width + 2, whole.height + 2)).all()


@CAMERAS
def test_xy_follow_the_ray(camera):
    target = undistorted_camera(camera)
    xy = np.random.default_rng(0).uniform((5, 5), (155, 123), (7, 2))
    moved = undistort_xy(xy, camera, target)
    np.testing.assert_allclose(target.rays(moved), camera.rays(xy), atol=1e-9)


@CAMERAS
def test_warp_of_a_smooth_image(camera):
    """A function of the ray, linear in the target's pixels, is the same after the warp."""
    target = undistorted_camera(camera, blank_pixels=0.5)
    xy = undistort_xy(pixel_centers(160, 128), camera, target)
    image = (xy @ [0.3, 0.7]).astype(np.float32)
    warped, mask = warp_image(image, camera, target)
    expected = pixel_centers(target.width, target.height) @ [0.3, 0.7]
    inner = binary_erosion(mask, iterations=2)
    # remap's coordinates have steps of 1/32 px; second differences of the lens are smaller. The
    # rounding of OpenCV 4.9 is coarser than that of 5.0 by a fifth.
    assert np.abs(warped - expected)[inner].max() < 1.2 * (0.3 + 0.7) / 32
    assert abs((warped - expected)[inner].mean()) < 0.01


def test_warp_without_distortion_is_the_identity_to_the_border():
    image = np.random.default_rng(0).integers(0, 256, (128, 160, 3)).astype(np.uint8)
    warped, mask = warp_image(image, PINHOLE, PINHOLE)
    assert mask.all()
    np.testing.assert_allclose(warped, image, atol=1e-3)


def test_pixels_beside_the_sensor_are_masked():
    target = undistorted_camera(OPENCV, blank_pixels=1.0)
    warped, mask = warp_image(np.full((128, 160), 7, np.uint8), OPENCV, target)
    assert 0.5 < mask.mean() < 0.999
    np.testing.assert_allclose(warped[mask], 7, rtol=1e-6)
    assert not warped[~mask].any()


def test_polarization_is_warped_as_stokes_images():
    """The angle between 175 and 5 degrees is 0, not 90, and its value is not turned."""
    angle = np.radians(np.where(np.arange(160) % 2, 175.0, 5.0))
    stokes = np.broadcast_to(
        np.stack([np.ones(160), np.cos(2 * angle), np.sin(2 * angle)], axis=-1), (128, 160, 3)
    )
    warped, mask = warp_image(stokes, OPENCV, undistorted_camera(OPENCV))
    aolp = np.degrees(0.5 * np.arctan2(warped[..., 2], warped[..., 1]))
    assert np.abs(aolp[mask]).max() < 5.01


def test_warp_needs_the_sensors_size():
    with pytest.raises(ValueError, match="expected 128x160"):
        warp_image(np.zeros((64, 80)), OPENCV, PINHOLE)


@CAMERAS
@pytest.mark.parametrize("stride", [1, 2, 5])
def test_a_plane_is_exact_at_the_map_pixels(camera, stride):
    scene = scene_of(parallel_views(camera), BOARD, board_points())
    view = scene.views[0]
    target = undistorted_camera(camera)
    maps = warp_dense_view(scene.dense(view.name, stride), view, target)
    rays = target.rays(map_pixel_xy(target.width, target.height))
    points = maps.depth[..., None] * (rays / rays[..., 2:])
    known = maps.depth > 0
    assert known[5:-5, 5:-5].all()
    in_world = view.cam_from_world.inverse() * points[known].astype(np.float64)
    assert np.abs(in_world @ NORMAL).max() < 1e-6  # float32 of half a metre is 6e-8
    expected = NORMAL @ view.cam_from_world.rotation.T
    np.testing.assert_allclose(
        maps.normals[known], np.broadcast_to(expected, in_world.shape), atol=1e-6
    )
    assert not maps.normals[~known].any()
    assert (maps.normals[known] * rays[known]).sum(axis=-1).max() < 0


@pytest.mark.parametrize("stride", [2, 4])
def test_a_sphere_is_second_order(stride):
    radius = 0.1
    surface = Sphere(center=np.zeros(3), radius=radius)
    scene = board_scene()
    scene = DenseScene(surface, scene.model)
    view = scene.views[0]
    target = undistorted_camera(OPENCV)
    maps = warp_dense_view(scene.dense(view.name, stride), view, target)
    rays = target.rays(map_pixel_xy(target.width, target.height))
    points = maps.depth[..., None] * (rays / rays[..., 2:])
    center = view.cam_from_world * np.zeros(3)
    offset = points - center
    cosine = -(maps.normals * rays).sum(axis=-1)
    frontal = (maps.depth > 0) & (cosine > 0.5)
    assert frontal.sum() > 500
    # A tangent plane leaves the sphere by d^2 / 2R, at most 0.75 strides from its point.
    step = 0.75 * stride * (0.5 / 120) / 0.5
    error = np.abs(np.linalg.norm(offset, axis=-1) - radius)[frontal]
    assert error.max() < step**2 / (2 * radius)
    true = offset / np.linalg.norm(offset, axis=-1, keepdims=True)
    angle = np.degrees(np.arccos(np.clip((true * maps.normals).sum(axis=-1)[frontal], -1, 1)))
    assert angle.max() < np.degrees(step / radius)
    assert np.median(angle) < 0.5


def two_planes(gap):
    near = Plane(point=np.array([0.03, 0.0, gap]), normal=[0, 0, 1.0], extent=(0.03, 1.0))
    return Group([near, Plane(point=np.zeros(3), normal=[0, 0, 1.0])])


@pytest.mark.parametrize("gap", [0.02, 0.1])
@pytest.mark.parametrize("stride", [1, 2, 3])
def test_depth_edges_are_not_mixed(gap, stride):
    scene = scene_of(parallel_views(OPENCV), two_planes(gap), board_points())
    view, target = scene.views[0], undistorted_camera(OPENCV)
    depth = warp_dense_view(scene.dense(view.name, stride), view, target).depth
    levels = np.array([0.5, 0.5 - gap])
    nearest = np.abs(depth[..., None] - levels).min(axis=-1)[depth > 0]
    assert nearest.max() < 1e-6
    assert all((np.abs(depth - level) < 1e-6).mean() > 0.05 for level in levels)


def test_outlines_hardly_grow_and_holes_stay():
    scene = board_scene(extent=(0.05, 0.06))
    view, target = scene.views[0], undistorted_camera(OPENCV)
    stride = 4
    dense = scene.dense(view.name, stride)
    dense.range_map[16, 20] = 0
    depth = warp_dense_view(dense, view, target).depth
    xy = undistort_xy(dense.lattice_xy()[16, 20], OPENCV, target)
    col, row = np.rint(xy).astype(int)
    assert depth[row, col] == 0
    # Known pixels lie within 0.75 strides of a known lattice point.
    known = undistort_xy(dense.lattice_xy()[dense.range_map > 0], OPENCV, target)
    rows, cols = np.nonzero(depth)
    for r, c in zip(rows, cols, strict=True):
        assert np.hypot(*(known - (c, r)).T).min() < 0.75 * stride * 1.1  # 10 % of distortion


def test_a_view_without_points_has_empty_maps():
    scene = board_scene()
    dense = scene.dense("000.png")
    dense.range_map[:] = 0
    maps = warp_dense_view(dense, scene.views[0], undistorted_camera(OPENCV))
    assert not maps.depth.any()
    assert not maps.normals.any()


def test_model_is_undistorted_as_colmap_does():
    scene = board_scene()
    model = undistorted_model(scene.model)
    assert all(view.camera == undistorted_camera(OPENCV) for view in model.views)
    assert len(model.tracks.obs_xy) == len(scene.model.tracks.obs_xy)
    for index, view in enumerate(model.views):
        own = model.tracks.obs_view == index
        points = model.tracks.points_in_world[model.tracks.obs_track[own]]
        expected = view.camera.project(view.cam_from_world * points)
        np.testing.assert_allclose(model.tracks.obs_xy[own], expected, atol=1e-6)


def test_observations_without_a_ray_are_dropped():
    scene = board_scene()
    tracks = scene.model.tracks
    tracks.obs_xy[tracks.obs_track == 3] = np.nan  # what a lens without an inverse gives
    tracks.obs_xy[0] = np.nan
    first = tracks.obs_track[0]
    model = undistorted_model(scene.model)
    assert np.isfinite(model.tracks.obs_xy).all()
    assert 4 not in model.tracks.point3D_ids
    assert first + 1 in model.tracks.point3D_ids
    assert model.tracks.obs_track.max() == len(model.tracks.point3D_ids) - 1


def test_images_are_warped_as_colmap_does():
    image = board_scene().image("000.png")
    target = undistorted_camera(OPENCV)
    ours, mask = warp_image(image, OPENCV, target)
    theirs, camera = pycolmap.undistort_image(
        pycolmap.UndistortCameraOptions(),
        pycolmap.Bitmap.from_array(image),
        camera_to_colmap(OPENCV),
    )
    assert (camera.width, camera.height) == (target.width, target.height)
    theirs = np.asarray(theirs.to_array()).squeeze()
    inner = binary_erosion(mask, iterations=2)
    # COLMAP 4.0 interpolates more coarsely than 4.2, about the same places.
    assert np.abs(image_shift(ours, theirs, inner)).max() < 0.02
    assert np.abs(ours - theirs)[inner].mean() < 0.7
