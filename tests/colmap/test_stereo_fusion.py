"""What COLMAP's fusion makes of our workspaces: half a pixel, surfaces, the order of normals."""

import numpy as np
import pytest
from dense_scenes import (
    BOARD,
    FISHEYE,
    NORMAL,
    OPENCV,
    PINHOLE,
    board_points,
    board_scene,
    fuse,
    parallel_views,
    scene_of,
)

from polmvs.colmap.dense_workspace import open_dense_workspace, write_maps
from polmvs.synthetic.captures import ring_of_views
from polmvs.synthetic.surfaces import Sphere

CAMERAS = pytest.mark.parametrize(
    "camera", [PINHOLE, OPENCV, FISHEYE], ids=["pinhole", "opencv", "fisheye"]
)


def angles_deg(normals, expected):
    return np.degrees(np.arccos(np.clip((normals * expected).sum(axis=-1), -1, 1)))


@CAMERAS
def test_half_a_pixel_of_a_plane_after_fusion(camera, tmp_path):
    """All views look the same way, so that a shift of their pixels shifts the cloud."""
    scene = scene_of(parallel_views(camera), BOARD, board_points())
    folder = scene.write(tmp_path / "workspace")
    cloud = fuse(folder)
    distance = cloud.points @ NORMAL
    workspace = open_dense_workspace(folder)
    pinhole = workspace.views[0].camera
    depth = 0.5 - cloud.points[:, 2]
    # World y points against the image's.
    moved = depth[:, None] * [0.5 / pinhole.fx, -0.5 / pinhole.fy, 0.0]
    shift = np.abs((moved @ NORMAL).mean())
    assert len(cloud.points) > 10_000
    assert abs(distance.mean()) < shift / 1000
    assert np.sqrt((distance**2).mean()) < shift / 20
    for item in workspace.views:
        write_maps(workspace.stereo, item.view.name, scene.exact_maps(item.view, 0.5))
    other = np.abs((fuse(folder).points @ NORMAL).mean())
    assert other == pytest.approx(shift, rel=0.01)


@CAMERAS
def test_fusion_of_a_board_and_a_sphere(camera, tmp_path):
    gsd = 0.5 / 120
    board = board_scene(camera)
    cloud = fuse(board.write(tmp_path / "board"), min_num_pixels=3)
    assert len(cloud.points) > 500
    assert np.abs(cloud.points @ NORMAL).max() < gsd / 2
    assert angles_deg(cloud.normals, NORMAL).max() < 0.1
    radius = 0.1
    views = ring_of_views(8, camera, distance=0.5, elevation_deg=50)
    points = np.random.default_rng(0).normal((0, 0, 1.5), size=(60, 3))
    points *= radius / np.linalg.norm(points, axis=1, keepdims=True)
    sphere = scene_of(views, Sphere(center=np.zeros(3), radius=radius), points)
    cloud = fuse(sphere.write(tmp_path / "sphere"), min_num_pixels=3)
    length = np.linalg.norm(cloud.points, axis=1)
    assert len(cloud.points) > 300
    # Fusion takes medians over pixels up to 2 px apart, which lie on an arc.
    sagitta = (2 * gsd) ** 2 / (2 * radius)
    assert np.abs(length - radius).max() < gsd
    assert np.median(np.abs(length - radius)) < sagitta
    assert np.median(angles_deg(cloud.normals, cloud.points / length[:, None])) < 1.0


def test_interleaved_normals_spoil_the_fusion(tmp_path):
    """Guards the order of memory by what COLMAP makes of it."""
    folder = board_scene().write(tmp_path / "workspace")
    good = fuse(folder)
    for item in open_dense_workspace(folder).views:
        maps = item.load_maps()
        height, width, _ = maps.normals.shape
        header = f"{width}&{height}&3&".encode()
        item.normals.write_bytes(header + maps.normals.astype("<f4").tobytes())
    bad = fuse(folder)
    share = [(angles_deg(c.normals, NORMAL) < 1).mean() for c in (good, bad)]
    assert share[0] == 1
    assert share[1] < 0.5
