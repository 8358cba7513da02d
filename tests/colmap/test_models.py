"""COLMAP's cameras and models: agreement with pycolmap, round trips, bad files."""

import logging
import os
import pickle
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import numpy as np
import pycolmap
import pytest

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.colmap.cameras import (
    ColmapCamera,
    camera_from_colmap,
    camera_to_colmap,
    quiet_colmap,
)
from polmvs.colmap.models import (
    find_model,
    match_model_to_capture,
    model_from_reconstruction,
    read_model,
    read_views,
    write_model,
)
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform
from polmvs.scene import SparseModel, Tracks, View

WIDTH, HEIGHT = 160, 120
OPENCV = ColmapCamera(
    model="OPENCV",
    width=WIDTH,
    height=HEIGHT,
    params=(130.0, 131.0, 79.0, 61.0, -0.2, 0.05, 0.001, -0.002),
)
FISHEYE = ColmapCamera(
    model="OPENCV_FISHEYE",
    width=WIDTH,
    height=HEIGHT,
    params=(90.0, 91.0, 79.0, 61.0, 0.02, -0.003, 0.001, 0.0),
)


def synthetic(**options):
    pycolmap.set_random_seed(0)
    settings = pycolmap.SyntheticDatasetOptions()
    settings.num_rigs, settings.num_frames_per_rig, settings.num_points3D = 1, 5, 40
    settings.camera_width, settings.camera_height = WIDTH, HEIGHT
    settings.camera_params = [200.0, 80.0, 60.0, 0.05]
    for name, value in options.items():
        setattr(settings, name, value)
    return pycolmap.synthesize_dataset(settings)


@pytest.fixture
def reconstruction():
    return synthetic()


def assert_same_views(first, second) -> None:
    assert [view.name for view in first] == [view.name for view in second]
    for one, two in zip(first, second, strict=True):
        assert one.camera == two.camera
        for part in ("rotation", "translation"):
            a, b = getattr(one.cam_from_world, part), getattr(two.cam_from_world, part)
            np.testing.assert_allclose(a, b, rtol=0, atol=1e-12)


def assert_same_model(first: SparseModel, second: SparseModel) -> None:
    assert_same_views(first.views, second.views)
    for name in Tracks.__dataclass_fields__:
        np.testing.assert_allclose(getattr(first.tracks, name), getattr(second.tracks, name))
    assert first.tracks.point3D_ids.dtype == second.tracks.point3D_ids.dtype == np.int64


def test_pinhole_agrees_with_pycolmap_to_the_half_pixel():
    camera = PinholeCamera(width=WIDTH, height=HEIGHT, fx=130.0, fy=131.0, cx=79.0, cy=61.0)
    colmap = camera_to_colmap(camera)
    xy = pixel_centers(WIDTH, HEIGHT).reshape(-1, 2)
    plane = np.asarray(colmap.cam_from_img(xy))
    rays = camera.rays(xy)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane, atol=1e-12)
    np.testing.assert_allclose(camera.project(3 * rays), xy, atol=1e-9)
    np.testing.assert_allclose(np.asarray(colmap.img_from_cam(3 * rays)), xy, atol=1e-9)
    assert camera_from_colmap(colmap) == camera


@pytest.mark.parametrize("camera", [OPENCV, FISHEYE], ids=lambda camera: camera.model)
@pytest.mark.parametrize("shape", [(1,), (7,), (2, 3)])
def test_colmap_camera_round_trip(camera, shape):
    xy = np.random.default_rng(0).uniform((0, 0), (WIDTH, HEIGHT), (*shape, 2))
    rays = camera.rays(xy)
    assert rays.shape == (*shape, 3)
    assert (rays[..., 2] > 0).all()
    np.testing.assert_allclose(np.linalg.norm(rays, axis=-1), 1, atol=1e-12)
    np.testing.assert_allclose(camera.project(5 * rays), xy, atol=1e-6)


@pytest.mark.parametrize("camera", [OPENCV, FISHEYE], ids=lambda camera: camera.model)
def test_colmap_camera_edges(camera):
    assert camera.rays(np.empty((0, 2))).shape == (0, 3)
    assert camera.project(np.empty((0, 3))).shape == (0, 2)
    behind = np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0], [np.nan, 0.0, 1.0]])
    assert np.isnan(camera.project(behind)).all()
    assert np.isnan(camera.rays(np.array([[np.nan, 1.0]]))).all()
    assert pickle.loads(pickle.dumps(camera)) == camera
    assert camera_from_colmap(camera_to_colmap(camera)) == camera
    assert camera.mean_focal_px == np.mean(camera.params[:2])


def test_distortion_does_not_fold_points_into_the_image():
    folding = ColmapCamera(
        model="SIMPLE_RADIAL", width=WIDTH, height=HEIGHT, params=(130.0, 80.0, 60.0, -0.3)
    )
    far = np.array([1.8, 0.0, 1.0])  # 61 degrees off the axis; the image ends at 35
    raw = np.asarray(camera_to_colmap(folding).img_from_cam(far[None]))[0]
    assert 0 < raw[0] < WIDTH  # the polynomial brings it back
    assert np.isnan(folding.project(far)).all()
    np.testing.assert_allclose(folding.project(np.array([0.3, 0.0, 1.0])), [117.947, 60], atol=1e-3)


@pytest.mark.parametrize(
    ("model", "params", "fast"),
    [
        ("SIMPLE_PINHOLE", [130.0, 80.0, 60.0], True),
        ("SIMPLE_RADIAL", [130.0, 80.0, 60.0, 0.0], True),
        ("OPENCV", [130.0, 130.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0], True),
        ("SIMPLE_RADIAL", [130.0, 80.0, 60.0, 0.01], False),
        ("OPENCV_FISHEYE", [130.0, 130.0, 80.0, 60.0, 0.0, 0.0, 0.0, 0.0], False),
        ("FOV", [130.0, 130.0, 80.0, 60.0, 0.5], False),
    ],
)
def test_fast_camera_only_without_distortion(model, params, fast):
    colmap = pycolmap.Camera(model=model, width=WIDTH, height=HEIGHT, params=np.array(params))
    camera = camera_from_colmap(colmap)
    assert isinstance(camera, PinholeCamera) == fast
    xy = np.array([[10.5, 20.5], [80.0, 60.0]])
    plane = np.asarray(colmap.cam_from_img(xy))
    rays = camera.rays(xy)
    np.testing.assert_allclose(rays[:, :2] / rays[:, 2:], plane, atol=1e-6)


GUARD = """
import io, sys, zlib
import polmvs, polmvs.colmap.models
import cv2, numpy as np
noise = np.random.default_rng(0).integers(0, 255, (300, 300)).astype(np.uint8)
np.savez_compressed(io.BytesIO(), noise=noise)
assert zlib.decompress(zlib.compress(noise.tobytes())) == noise.tobytes()
assert cv2.imencode(".png", noise)[0]
"""


@pytest.mark.parametrize("first", ["", "import polmvs.colmap.models\n"])
def test_compression_survives_pycolmap(first):
    run = subprocess.run(
        [sys.executable, "-c", first + GUARD], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize("suffix", [".bin", ".txt"])
@pytest.mark.parametrize("files", [3, 5])
@pytest.mark.parametrize("parent", ["", "0", "sparse", "sparse/0"])
def test_read_model(tmp_path, reconstruction, suffix, files, parent):
    folder = tmp_path / parent
    folder.mkdir(parents=True, exist_ok=True)
    write = reconstruction.write_binary if suffix == ".bin" else reconstruction.write_text
    write(str(folder))
    if files == 3:
        for name in ("rigs", "frames"):
            (folder / f"{name}{suffix}").unlink()
    before = {path: path.read_bytes() for path in folder.iterdir()}
    model = read_model(tmp_path)
    assert_same_model(model, model_from_reconstruction(reconstruction))
    assert_same_views(read_views(tmp_path), model.views)
    assert find_model(tmp_path) == folder
    assert before == {path: path.read_bytes() for path in folder.iterdir()}


def test_model_agrees_with_the_reconstruction(reconstruction):
    model = model_from_reconstruction(reconstruction, ["extra.png"])
    assert model.unregistered == ("extra.png",)
    assert [view.name for view in model.views] == sorted(view.name for view in model.views)
    tracks = model.tracks
    assert len(tracks.obs_track) == reconstruction.compute_num_observations()
    for view_index, view in enumerate(model.views):
        image = reconstruction.find_image_with_name(view.name)
        np.testing.assert_allclose(view.center_in_world, image.projection_center(), atol=1e-12)
        own = tracks.obs_view == view_index
        points = tracks.points_in_world[tracks.obs_track[own]]
        projected = view.camera.project(view.cam_from_world * points)
        np.testing.assert_allclose(projected, tracks.obs_xy[own], atol=1e-6)


def test_keypoints_without_a_point_are_passed_over(tmp_path):
    reconstruction = synthetic(num_points2D_without_point3D=7)
    assert any(not p.has_point3D() for p in reconstruction.image(1).points2D)
    reconstruction.write_binary(str(tmp_path))
    assert_same_model(read_model(tmp_path), model_from_reconstruction(reconstruction))


@pytest.mark.parametrize("name", ["cameras", "rigs", "frames", "images", "points3D"])
@pytest.mark.parametrize("share", [0.0, 0.5, 0.93])
def test_truncated_binary(tmp_path, reconstruction, name, share):
    reconstruction.write_binary(str(tmp_path))
    path = tmp_path / f"{name}.bin"
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * share)])
    with pytest.raises(DataError, match="truncated") as caught:
        read_model(tmp_path)
    assert caught.value.path == path


@pytest.mark.parametrize("name", ["images", "points3D"])
def test_truncated_text(tmp_path, reconstruction, name):
    reconstruction.write_text(str(tmp_path))
    path = tmp_path / f"{name}.txt"
    path.write_bytes(path.read_bytes()[: int(path.stat().st_size * 0.5)])
    with pytest.raises(DataError, match="no sound COLMAP model") as caught:
        read_model(tmp_path)
    assert "\n" not in str(caught.value)


def test_missing_models(tmp_path, reconstruction):
    with pytest.raises(DataError, match="no such folder"):
        read_model(tmp_path / "none")
    with pytest.raises(DataError, match="holds no COLMAP model"):
        read_model(tmp_path)
    reconstruction.write_binary(str(tmp_path))
    (tmp_path / "points3D.bin").unlink()
    with pytest.raises(DataError, match="holds no COLMAP model"):
        read_model(tmp_path)
    file = tmp_path / "cameras.bin"
    with pytest.raises(DataError, match="is no folder"):
        read_model(file)


def test_model_without_registered_images(tmp_path):
    empty = tmp_path / "empty"
    empty.mkdir()
    pycolmap.Reconstruction().write_binary(str(empty))
    with pytest.raises(DataError, match="no registered image"):
        read_model(empty)


def test_write_model(tmp_path, reconstruction):
    model = model_from_reconstruction(reconstruction)
    target = tmp_path / "out" / "sparse"
    target.mkdir(parents=True)
    (target / "old").touch()
    write_model(model, target)
    assert sorted(path.name for path in target.parent.iterdir()) == ["sparse"]
    assert not (target / "old").exists()
    assert_same_model(read_model(target), model)
    back = pycolmap.Reconstruction(str(target))
    back.update_point_3d_errors()
    assert back.compute_mean_reprojection_error() < 1e-6
    assert back.num_cameras() == 1
    if os.name == "posix":  # readable by whoever may read its parent
        assert target.stat().st_mode == target.parent.stat().st_mode


def test_failed_write_leaves_the_old_model(tmp_path, reconstruction, monkeypatch):
    model = model_from_reconstruction(reconstruction)
    target = tmp_path / "sparse"
    write_model(model, target)
    monkeypatch.setattr(Path, "rename", _refuse_once(Path.rename))
    with pytest.raises(DataError, match="cannot be written: refused"):
        write_model(model, target)
    assert [path.name for path in tmp_path.iterdir()] == ["sparse"]
    assert_same_model(read_model(target), model)


def _refuse_once(function):
    calls = []

    def wrapper(*args, **kwargs):
        calls.append(args)
        if len(calls) == 1:
            raise OSError("refused")
        return function(*args, **kwargs)

    return wrapper


def small_model(camera) -> SparseModel:
    """Three views a.png, b.png, c.png; point 5 seen by all, 7 by a and b, 9 by c only."""
    views = tuple(
        View(
            name=f"{letter}.png",
            camera=camera,
            cam_from_world=RigidTransform(np.eye(3), np.array([index, 0.0, 4.0])),
        )
        for index, letter in enumerate("abc")
    )
    tracks = Tracks(
        point3D_ids=np.array([5, 7, 9], np.int64),
        points_in_world=np.arange(9.0).reshape(3, 3),
        colors=np.full((3, 3), 128, np.uint8),
        errors=np.array([0.1, 0.2, 0.3]),
        obs_track=np.array([0, 1, 0, 1, 0, 2]),
        obs_view=np.array([0, 0, 1, 1, 2, 2]),
        obs_xy=np.arange(12.0).reshape(6, 2),
    )
    return SparseModel(views=views, tracks=tracks, unregistered=())


PINHOLE = PinholeCamera(width=WIDTH, height=HEIGHT, fx=130.0, fy=131.0, cx=79.0, cy=61.0)


def test_match_same_capture():
    model = small_model(PINHOLE)
    matched = match_model_to_capture(model, ["c.png", "b.png", "a.png", "d.png"], WIDTH, HEIGHT)
    assert matched.unregistered == ("d.png",)
    assert_same_model(matched, model)


def test_match_drops_views_that_the_capture_lacks(caplog):
    with caplog.at_level(logging.WARNING):
        matched = match_model_to_capture(small_model(PINHOLE), ["a.png", "b.png"], WIDTH, HEIGHT)
    assert "1 views are not in the capture" in caplog.text
    assert "c.png" in caplog.text
    assert [view.name for view in matched.views] == ["a.png", "b.png"]
    assert matched.tracks.point3D_ids.tolist() == [5, 7]
    assert matched.tracks.obs_track.tolist() == [0, 1, 0, 1]
    assert matched.tracks.obs_view.tolist() == [0, 0, 1, 1]


def test_match_by_stem(caplog):
    names = ["raw/c.tif", "raw/a.tif", "raw/b.tif"]
    with caplog.at_level(logging.WARNING):
        matched = match_model_to_capture(small_model(PINHOLE), names, WIDTH, HEIGHT)
    assert "without folder and suffix" in caplog.text
    assert [view.name for view in matched.views] == sorted(names)


def test_ambiguous_stems_do_not_match():
    names = ["left/a.tif", "right/a.tif", "left/b.tif"]
    matched = match_model_to_capture(small_model(PINHOLE), names, WIDTH, HEIGHT)
    assert [view.name for view in matched.views] == ["left/b.tif"]


def test_no_name_matches():
    with pytest.raises(DataError, match=r"like 'a.png' but the capture's like '000.png'"):
        match_model_to_capture(small_model(PINHOLE), ["001.png", "000.png"], WIDTH, HEIGHT)


@pytest.mark.parametrize("camera", [PINHOLE, OPENCV, FISHEYE])
def test_match_model_of_the_raw_mosaic(camera):
    """Twice the size: K / 2 exactly, and everything else in step."""
    model = small_model(camera)
    names = ["a.png", "b.png", "c.png"]
    matched = match_model_to_capture(model, names, WIDTH // 2, HEIGHT // 2)
    half = matched.views[0].camera
    assert (half.width, half.height) == (WIDTH // 2, HEIGHT // 2)
    if isinstance(half, PinholeCamera):
        np.testing.assert_array_equal(half.K[:2], camera.K[:2] / 2)
    else:
        assert half.params == (*np.array(camera.params[:4]) / 2, *camera.params[4:])
    xy = np.array([[3.0, 5.0], [70.0, 50.0]])
    np.testing.assert_allclose(half.rays(xy / 2), camera.rays(xy), atol=1e-9)
    np.testing.assert_array_equal(matched.tracks.obs_xy, model.tracks.obs_xy / 2)
    np.testing.assert_array_equal(matched.tracks.errors, model.tracks.errors / 2)


def test_match_rounded_size():
    matched = match_model_to_capture(small_model(PINHOLE), ["a.png"], 107, 80)
    camera = matched.views[0].camera
    assert (camera.width, camera.height) == (107, 80)
    np.testing.assert_allclose(camera.cx / 107, PINHOLE.cx / WIDTH)


def test_match_another_aspect_ratio():
    with pytest.raises(DataError, match="160x120 px, the polarization images are 160x100 px"):
        match_model_to_capture(small_model(PINHOLE), ["a.png"], 160, 100)


def test_rig_of_two_cameras_is_read(tmp_path):
    rig = synthetic(num_cameras_per_rig=2)
    rig.write_binary(str(tmp_path))
    model = read_model(tmp_path)
    assert len(model.views) == 10
    write_model(model, tmp_path / "flat")
    assert_same_model(read_model(tmp_path / "flat"), model)


def test_importing_leaves_colmaps_log_as_it_was():
    code = (
        "import pycolmap\n"
        "before = pycolmap.logging.minloglevel\n"
        "import polmvs.colmap.sfm\n"
        "assert pycolmap.logging.minloglevel == before\n"
        "from polmvs.colmap.cameras import quiet_colmap\n"
        "with quiet_colmap():\n"
        "    assert pycolmap.logging.minloglevel == 3\n"
        "assert pycolmap.logging.minloglevel == before\n"
    )
    run = subprocess.run(
        [sys.executable, "-c", "import zlib\n" + code], capture_output=True, text=True, check=False
    )
    assert run.returncode == 0, run.stderr


@pytest.mark.parametrize("level", [0, 2])
def test_an_interrupt_leaves_colmaps_log_as_the_user_has_it(level, monkeypatch):
    monkeypatch.setattr(pycolmap.logging, "minloglevel", level)
    with suppress(KeyboardInterrupt), quiet_colmap():
        assert pycolmap.logging.minloglevel == 3
        raise KeyboardInterrupt
    assert pycolmap.logging.minloglevel == level
