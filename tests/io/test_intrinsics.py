"""Calibration files of other programs, written as they write them; half a pixel apart."""

import json

import cv2
import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.intrinsics import (
    MAX_BYTES,
    Intrinsics,
    from_opencv_matrix,
    read_intrinsics,
    write_intrinsics,
)

K = [[890.5, 0, 611.25], [0, 891.75, 511.5], [0, 0, 1]]
D = [-0.21, 0.09, 0.001, -0.0005, 0.0]
SIZE = (1224, 1024)
OPENCV = ("OPENCV", (890.5, 891.75, 611.75, 512.0, -0.21, 0.09, 0.001, -0.0005))


def saved(tmp_path, text, name="camera.yaml"):
    path = tmp_path / name
    path.write_text(text)
    return path


def opencv_yaml(tmp_path):
    path = tmp_path / "opencv.yaml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", SIZE[0])
    storage.write("image_height", SIZE[1])
    storage.write("camera_matrix", np.array(K))
    storage.write("distortion_coefficients", np.array([D]))
    storage.release()
    return path


def opencv_json(tmp_path):
    content = {"camera_matrix": K, "dist_coeffs": [D], "image_size": list(SIZE)}
    return saved(tmp_path, json.dumps(content), "camera.json")


def ros(tmp_path):
    flat = [v for row in K for v in row]
    return saved(
        tmp_path,
        f"""image_width: {SIZE[0]}
image_height: {SIZE[1]}
camera_name: left
camera_matrix:
  rows: 3
  cols: 3
  data: {flat}
distortion_model: plumb_bob
distortion_coefficients:
  rows: 1
  cols: 5
  data: {D}
""",
    )


def kalibr(tmp_path, lens="radtan", k=D[:4], model="pinhole"):
    return saved(
        tmp_path,
        f"""cam0:
  cam_overlaps: []
  camera_model: {model}
  distortion_coeffs: {k}
  distortion_model: {lens}
  intrinsics: [890.5, 891.75, 611.25, 511.5]
  resolution: [{SIZE[0]}, {SIZE[1]}]
  rostopic: /cam0/image_raw
""",
    )


@pytest.mark.parametrize("write", [opencv_yaml, opencv_json, ros, kalibr])
def test_all_dialects_give_the_same_camera(tmp_path, write):
    camera = read_intrinsics(write(tmp_path))
    assert (camera.width, camera.height) == SIZE
    assert camera.model == OPENCV[0]
    np.testing.assert_allclose(camera.params, OPENCV[1], rtol=1e-12)


def test_the_older_head_of_opencv_is_no_yaml(tmp_path):
    """OpenCV 4 and before write ``%YAML:1.0``, which no parser of YAML takes."""
    text = opencv_yaml(tmp_path).read_text()
    body = text.partition("\n")[2]
    assert text.startswith("%YAML")
    assert "---" in body
    found = read_intrinsics(saved(tmp_path, "%YAML:1.0\n" + body))
    assert (found.model, found.params) == OPENCV


def test_opencv_projects_the_same_point(tmp_path):
    """Half a pixel more than OpenCV, by its own projection."""
    point = np.array([[0.2, -0.15, 1.0]])
    xy, _ = cv2.projectPoints(point, np.zeros(3), np.zeros(3), np.array(K), np.array(D))
    pycolmap = pytest.importorskip("pycolmap")
    read = read_intrinsics(opencv_yaml(tmp_path))
    camera = pycolmap.Camera(
        model=read.model, width=read.width, height=read.height, params=read.params
    )
    np.testing.assert_allclose(camera.img_from_cam(point)[0], xy.ravel() + 0.5, atol=1e-9)


def test_models_of_more_coefficients(tmp_path):
    content = {"K": K, "D": [*D[:4], 0.02, 0.1], "width": SIZE[0], "height": SIZE[1]}
    camera = read_intrinsics(saved(tmp_path, json.dumps(content)))
    assert camera.model == "FULL_OPENCV"
    assert camera.params[4:] == (-0.21, 0.09, 0.001, -0.0005, 0.02, 0.1, 0, 0)
    content["D"] = []
    assert read_intrinsics(saved(tmp_path, json.dumps(content))).model == "PINHOLE"
    fisheye = read_intrinsics(kalibr(tmp_path, "equidistant", [0.1, 0.2, 0.3, 0.4]))
    assert fisheye.model == "OPENCV_FISHEYE"
    assert fisheye.params[4:] == (0.1, 0.2, 0.3, 0.4)
    assert read_intrinsics(kalibr(tmp_path, "fov", [0.9])).params[4:] == (0.9,)


@pytest.mark.parametrize(
    "text",
    [
        "OPENCV 1224 1024 890.5 891.75 611.75 512 -0.21 0.09 0.001 -0.0005",
        "3 OPENCV 1224 1024 890.5 891.75 611.75 512 -0.21 0.09 0.001 -0.0005\n",
        "# Camera list\n# Number of cameras: 1\n"
        "1 OPENCV 1224 1024 890.5 891.75 611.75 512 -0.21 0.09 0.001 -0.0005\n",
    ],
)
def test_colmap_lines_are_taken_as_they_are(tmp_path, text):
    camera = read_intrinsics(saved(tmp_path, text, "cameras.txt"))
    assert (camera.model, camera.params) == OPENCV


def test_written_cameras_are_read_back(tmp_path):
    camera = Intrinsics(model="OPENCV", width=1224, height=1024, params=OPENCV[1])
    write_intrinsics(tmp_path / "c.txt", camera, "by a test\nof two lines")
    assert read_intrinsics(tmp_path / "c.txt") == camera


def test_scaling_keeps_rays():
    camera = Intrinsics(model="OPENCV", width=1224, height=1024, params=OPENCV[1])
    half = camera.scaled_to(612, 512)
    assert half.params == (445.25, 445.875, 305.875, 256.0, *OPENCV[1][4:])
    with pytest.raises(ValueError, match="1224x1024"):
        camera.scaled_to(600, 600)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "no camera"),
        ("hello", "no camera"),
        ("a: [1, 2", "neither JSON nor YAML"),
        ("{", "neither"),
        ("[" * 5000, "neither"),
        ("image_width: 10", "lacks 'camera_matrix'"),
        (json.dumps({"K": K}), "lacks 'image_width'"),
        (json.dumps({"K": K[:2], "width": 9, "height": 9}), "9 numbers"),
        (json.dumps({"K": "abc", "width": 9, "height": 9}), "no camera that"),
        (json.dumps({"K": K, "width": 100, "height": 100}), "outside of"),
        (json.dumps({"K": np.diag([-1, 1, 1]).tolist(), "width": 9, "height": 9}), "positive"),
        (json.dumps({"K": K, "D": [1] * 14, "width": 1224, "height": 1024}), "more than"),
        (json.dumps({"K": [[9, 2, 4], [0, 9, 4], [0, 0, 1]], "width": 9, "height": 9}), "skewed"),
        ("OPENCV 1224 1024 1 2 3", "8 parameters"),
        ("1 PINHOLE 4 4 1 1 2 2\n2 PINHOLE 4 4 1 1 2 2\n", "2 camera lines"),
        ("PINHOLE a b", "camera line"),
    ],
)
def test_bad_files_are_named(tmp_path, text, words):
    path = saved(tmp_path, text)
    with pytest.raises(DataError, match=words) as caught:
        read_intrinsics(path)
    assert str(path) in str(caught.value)


def test_lenses_that_colmap_lacks(tmp_path):
    for path in (kalibr(tmp_path, model="omni"), kalibr(tmp_path, lens="radtan8")):
        with pytest.raises(DataError, match="none of COLMAP"):
            read_intrinsics(path)
    with pytest.raises(DataError, match="cannot be read"):
        read_intrinsics(tmp_path / "gone.yaml")


@pytest.mark.parametrize(
    ("camera", "focal"),
    [
        (
            Intrinsics(model="SIMPLE_RADIAL", width=80, height=60, params=(50, 40, 30, 0.1)),
            (50, 50),
        ),
        (Intrinsics(model="PINHOLE", width=80, height=60, params=(50, 52, 40, 30)), (50, 52)),
    ],
)
def test_the_camera_without_its_distortion(camera, focal):
    pinhole = camera.pinhole
    assert (pinhole.width, pinhole.height) == (80, 60)
    assert (pinhole.fx, pinhole.fy, pinhole.cx, pinhole.cy) == (*focal, 40, 30)


@pytest.mark.parametrize(
    ("distortion", "fisheye", "model", "kept"),
    [
        ([], False, "PINHOLE", ()),
        ([0, 0, 0, 0, 0], False, "PINHOLE", ()),
        ([0.1, 0.0], False, "OPENCV", (0.1, 0, 0, 0)),
        ([0, 0, 0, 0.2, 0], False, "OPENCV", (0, 0, 0, 0.2)),
        ([0, 0, 0, 0, 0.3], False, "FULL_OPENCV", (0, 0, 0, 0, 0.3, 0, 0, 0)),
        ([0.1] * 8, False, "FULL_OPENCV", (0.1,) * 8),
        ([0.1] * 8 + [0.0] * 4, False, "FULL_OPENCV", (0.1,) * 8),
        ([0.1, 0.2], True, "OPENCV_FISHEYE", (0.1, 0.2, 0, 0)),
    ],
)
def test_the_smallest_model_that_holds_all_coefficients(distortion, fisheye, model, kept):
    found = from_opencv_matrix(K, distortion, *SIZE, fisheye=fisheye)
    assert found.model == model
    assert found.params == (890.5, 891.75, 611.75, 512.0, *kept)


def matrix_of(cx, cy, skew=0.0, fx=100.0):
    return [[fx, skew, cx], [0, 100.0, cy], [0, 0, 1]]


@pytest.mark.parametrize(
    ("matrix", "distortion", "words"),
    [
        (matrix_of(40, 30, skew=1e-6), [], "skewed"),
        (matrix_of(40, 30), [0.1] * 9, "9 distortion coefficients"),
        (matrix_of(40, 30, fx=0.0), [], "focal lengths must be positive"),
        (matrix_of(-0.6, 30), [], "principal point -0.1,30.5 lies outside"),
        (matrix_of(40, -0.6), [], "lies outside"),
        (matrix_of(79.6, 30), [], "lies outside"),
        (matrix_of(40, 59.6), [], "lies outside"),
        (matrix_of(40, np.nan), [], "not finite"),
    ],
)
def test_cameras_that_are_none(matrix, distortion, words):
    with pytest.raises(ValueError, match=words):
        from_opencv_matrix(matrix, distortion, 80, 60)


@pytest.mark.parametrize("corner", [(-0.5, -0.5), (79.5, -0.5), (-0.5, 59.5), (79.5, 59.5)])
def test_principal_points_may_lie_in_the_corners(corner):
    assert from_opencv_matrix(matrix_of(*corner, skew=1e-8), [], 80, 60).model == "PINHOLE"


@pytest.mark.parametrize("size", [(0, 60), (80, 0), (1 << 16, 60), (80, 1 << 16)])
def test_sizes_that_are_none(size):
    with pytest.raises(ValueError, match="its size is none"):
        from_opencv_matrix(matrix_of(0, 0), [], *size)


@pytest.mark.parametrize("depth", [0, 3])
def test_matrices_may_be_nested_and_not_without_end(tmp_path, depth):
    matrix = "[" * depth + "1,0,2,0,1,2,0,0,1" + "]" * depth
    path = saved(tmp_path, f"image_size: [5, 5]\ncamera_matrix: [{matrix}]\n")
    assert read_intrinsics(path).params == (1, 1, 2.5, 2.5)
    path = saved(tmp_path, "image_size: [5, 5]\ncamera_matrix: &a [*a]\n")
    with pytest.raises(DataError, match="nested too deeply"):
        read_intrinsics(path)


def test_files_of_a_size_that_no_calibration_has_are_not_read(tmp_path):
    line = "PINHOLE 80 60 50 50 40 30"
    path = saved(tmp_path, "#" + "x" * (MAX_BYTES - len(line) - 2) + f"\n{line}")
    assert path.stat().st_size == MAX_BYTES
    assert read_intrinsics(path).params == (50, 50, 40, 30)
    path.write_text(path.read_text() + "\n")
    with pytest.raises(DataError, match="too large for a calibration file"):
        read_intrinsics(path)
