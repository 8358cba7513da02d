"""The authors' demo layout, against files written by hand here."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.config import RegionOptions
from polmvs.errors import DataError
from polmvs.experiments.contours import PlaneSurface, open_surface
from polmvs.experiments.data import open_author_capture, open_scene
from polmvs.experiments.phase import measure_phase
from polmvs.io.layouts import is_author_layout, read_camera_text
from polmvs.parallel import Workers
from polmvs.synthetic.captures import render_mosaic, render_view, ring_of_views
from polmvs.synthetic.surfaces import Plane

# Half-size image; a centred principal point would be (80, 64).
CAMERA = PinholeCamera(width=160, height=128, fx=120.0, fy=121.0, cx=82.5, cy=63.25)
NORMAL = np.array([0.0, 0.0, 1.0])
HALF = (0.12, 0.15)
CORNERS = np.array([[-1, -1, 0], [1, 1, 0], [1, -1, 0], [-1, 1, 0]]) * [*HALF, 0.0]
NUM_VIEWS = 3


def camera_text(view):
    """The text form of MVSNet: OpenCV's pixel centres, so half a pixel less."""
    transform = view.cam_from_world
    pose = np.vstack([np.column_stack([transform.rotation, transform.translation]), [0, 0, 0, 1]])
    K = [[CAMERA.fx, 0, CAMERA.cx - 0.5], [0, CAMERA.fy, CAMERA.cy - 0.5], [0, 0, 1]]
    rows = ["extrinsic", *(" ".join(map(repr, map(float, row))) for row in pose), ""]
    rows += ["intrinsic", *(" ".join(map(repr, map(float, row))) for row in K), ""]
    return "\n".join([*rows, "0.2 0.01 100 1.2", ""])


@pytest.fixture
def demo(tmp_path):
    """A board of 0.24 x 0.3 in the layout that the authors published."""
    folder = tmp_path / "demo"
    (folder / "images").mkdir(parents=True)
    (folder / "cams").mkdir()
    surface = Plane(point=np.zeros(3), normal=NORMAL, extent=HALF)
    views = ring_of_views(NUM_VIEWS, CAMERA, distance=0.5, elevation_deg=50, roll_deg=20)
    for index, view in enumerate(views):
        linear = render_mosaic(view, surface, s0=0.5, background=0.3)
        encoded = np.rint(255 * np.sqrt(np.clip(linear, 0, 1))).astype(np.uint8)
        cv2.imwrite(str(folder / "images" / f"{index:08d}.png"), encoded)
        text = camera_text(view)
        (folder / "cams" / f"{index:08d}_cam.txt").write_text(text, encoding="ascii")
    np.save(folder / "normal_w.npy", -2 * NORMAL[:, None])  # neither unit nor facing
    np.save(folder / "pts_3d_corners_w.npy", CORNERS)
    return folder, surface, views


def test_reads_cameras_images_and_board(demo):
    folder, surface, views = demo
    assert is_author_layout(folder)
    capture, truth = open_author_capture(folder)
    assert capture.names == tuple(truth.views)
    np.testing.assert_allclose(truth.normal, NORMAL, atol=1e-12)
    for name, view in zip(capture.names, views, strict=True):
        read = truth.views[name]
        np.testing.assert_allclose(read.camera.K, CAMERA.K, rtol=1e-12)
        np.testing.assert_allclose(
            read.cam_from_world.rotation, view.cam_from_world.rotation, atol=1e-12
        )
        rendered = render_view(view, surface)
        np.testing.assert_array_equal(truth.mask(name), rendered.mask)
        inside = rendered.mask
        np.testing.assert_allclose(truth.depth(name)[inside], rendered.depth[inside], rtol=1e-6)
        np.testing.assert_allclose(
            truth.normals(name)[inside], rendered.normals_in_cam[inside], atol=1e-6
        )


def test_gamma_order_and_phase_are_the_authors(demo):
    folder, _, views = demo
    capture, truth = open_author_capture(folder)
    scene = open_scene(capture, truth, RegionOptions(), blur_px=0.0)
    with Workers(1) as workers:
        result = measure_phase(scene, workers)
    # Eight bits with a gamma; a wrong order, gamma, half pixel or phase would give degrees.
    assert result.all_pixels["ppa"].median_deg < 0.4
    assert result.all_pixels["opa"].median_deg > 5
    surface = open_surface(truth)
    assert isinstance(surface, PlaneSurface)
    np.testing.assert_allclose(surface.heights(np.array([[0.1, 0.2, 0.03]])), 0.03, atol=1e-12)
    assert capture.width == views[0].camera.width


def test_missing_and_malformed_files_are_named(demo):
    folder, _, _ = demo
    text = folder / "cams" / "00000001_cam.txt"
    content = text.read_text()
    text.write_text(content.replace("intrinsic", "internal"))
    with pytest.raises(DataError, match="00000001_cam"):
        open_author_capture(folder)
    text.write_text(content.replace("1.0\n", "7.0\n", 1).replace("extrinsic\n", "extrinsic\n9 "))
    with pytest.raises(DataError, match="rigid motion"):
        read_camera_text(text, "a", 4, 4)
    text.unlink()
    with pytest.raises(DataError, match="each image needs one"):
        open_author_capture(folder)
    text.write_text(content)
    np.save(folder / "pts_3d_corners_w.npy", CORNERS + 0.1 * np.eye(4, 3)[[2, 3, 3, 3]])
    with pytest.raises(DataError, match="plane"):
        open_author_capture(folder)
    np.save(folder / "pts_3d_corners_w.npy", CORNERS[:3])
    with pytest.raises(DataError, match="12 numbers"):
        open_author_capture(folder)


def test_normal_from_behind_still_faces(demo):
    _, truth = open_author_capture(demo[0])
    turned = replace(truth, normal=-truth.normal)
    name = next(iter(truth.views))
    np.testing.assert_array_equal(turned.normals(name), truth.normals(name))
