"""Where pictures are taken from: paths about an object, and given poses."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polmvs.camera import PinholeCamera
from polmvs.errors import DataError
from polmvs.simulation.camera_path import camera_views, given_views
from polmvs.simulation.options import PathName, PathOptions

CAMERA = PinholeCamera(width=64, height=48, fx=60.0, fy=60.0, cx=32.0, cy=24.0)
TARGET = np.array([0.01, -0.02, 0.1])


def placed(options):
    """Distances, azimuths and elevations (degrees) about the target, and the views."""
    views = camera_views(options, CAMERA, TARGET, 0.5, seed=3)
    away = np.array([view.center_in_world for view in views]) - TARGET
    length = np.linalg.norm(away, axis=1)
    azimuth = np.degrees(np.arctan2(away[:, 1], away[:, 0])) % 360
    return length, azimuth, np.degrees(np.arcsin(away[:, 2] / length)), views


@pytest.mark.parametrize("path", list(PathName))
def test_paths_keep_to_their_range_and_look_at_the_object(path):
    options = PathOptions(path=path, views=11, elevation=(20, 50), azimuth=(10, 130))
    length, azimuth, elevation, views = placed(options)
    assert [view.name for view in views[:2]] == ["000.png", "001.png"]
    assert elevation.min() >= 20 - 1e-9
    assert elevation.max() <= 50 + 1e-9
    for view in views:
        seen = view.cam_from_world * TARGET
        assert seen[:2] == pytest.approx([0, 0], abs=1e-12)
        assert view.cam_from_world.rotation[1, 2] < 0  # upright: the image's y goes down
    if path is PathName.RANDOM:
        assert np.ptp(length) > 0.02
    else:
        assert length == pytest.approx(0.5)
    match path:
        case PathName.RING:
            assert elevation == pytest.approx(35)
            assert azimuth == pytest.approx(360 * np.arange(11) / 11)
        case PathName.ARC:
            assert azimuth == pytest.approx(np.linspace(10, 130, 11))
        case PathName.SPIRAL:
            assert (np.diff(elevation) > 0).all()
            assert np.unwrap(azimuth, period=360)[-1] == pytest.approx(720 * 10 / 11)
        case PathName.DOME:
            assert np.ptp(elevation) > 20
            assert azimuth == pytest.approx(360 * np.arange(11) / 11)


def test_roll_turns_cameras_about_their_axes():
    _, _, _, plain = placed(PathOptions(views=400))
    _, _, _, turned = placed(PathOptions(views=400, roll=10.0))
    angles = []
    for first, second in zip(plain, turned, strict=True):
        about = second.cam_from_world.rotation @ first.cam_from_world.rotation.T
        assert about[2, 2] == pytest.approx(1)
        angles.append(np.degrees(np.arctan2(about[1, 0], about[0, 0])))
    assert np.std(angles) == pytest.approx(10, rel=0.1)


def test_poses_of_a_colmap_model_and_of_a_text_file_are_the_same(tmp_path):
    views = camera_views(PathOptions(views=4, roll=20.0), CAMERA, TARGET, 0.5, seed=0)
    model = tmp_path / "model"
    model.mkdir()
    lines = []
    for number, view in enumerate(views, 1):
        x, y, z, w = Rotation.from_matrix(view.cam_from_world.rotation).as_quat()
        numbers = " ".join(f"{v:.15g}" for v in (w, x, y, z, *view.cam_from_world.translation))
        lines.append((number, numbers, f"{view.name[:-4]}.jpg"))
    (model / "cameras.txt").write_text("1 PINHOLE 64 48 60 60 32 24\n")
    (model / "images.txt").write_text("".join(f"{k} {p} 1 {name}\n\n" for k, p, name in lines))
    (model / "points3D.txt").write_text("")
    text = tmp_path / "poses.txt"
    text.write_text("# name and pose\n" + "".join(f"{name} {p}\n" for _, p, name in lines))
    for source in (model, text):
        found = given_views(source, CAMERA)
        assert [view.name for view in found] == [view.name for view in views]
        for one, other in zip(found, views, strict=True):
            pose, true = one.cam_from_world, other.cam_from_world
            assert pose.rotation == pytest.approx(true.rotation, abs=1e-12)
            assert pose.translation == pytest.approx(true.translation, abs=1e-12)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("", "no poses"),
        ("a 1 0 0 0 0 0\n", "line 1 needs"),
        ("a 1 0 0 0 0 0 1\na 1 0 0 0 0 0 2\n", "two poses of a"),
        ("a 0 0 0 0 0 0 1\n", "line 1 needs"),
        ("a 1 0 0 0 nan 0 1\n", "line 1 needs"),
        ("a.png 1 0 0 0 0 0 1\na.jpg 1 0 0 0 0 0 2\n", r"two poses of a\.png"),
    ],
)
def test_damaged_poses_are_named(tmp_path, content, message):
    (tmp_path / "poses.txt").write_text(content)
    with pytest.raises(DataError, match=message):
        given_views(tmp_path / "poses.txt", CAMERA)
