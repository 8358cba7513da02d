"""COLMAP models with counts that no file has, and with numbers that are finite and absurd."""

import struct
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from dense_scenes import OPENCV, PINHOLE, board_scene

from polmvs.colmap.models import check_binary_model, read_model, write_model
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform, intersect_rays
from polmvs.scene import MAX_COORDINATE, SparseModel, point_sigmas

COUNTS = (2**63, 2**64 - 1, 2**63 - 1, 2**61, 2**32)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_model(board_scene(OPENCV, 3).model, tmp_path / "sparse")
    return tmp_path / "sparse"


def put(path: Path, position: int, value: int) -> None:
    data = bytearray(path.read_bytes())
    struct.pack_into("<Q", data, position, value)
    path.write_bytes(data)


@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("name", ["cameras", "images", "points3D", "rigs", "frames"])
def test_counts_of_records_beyond_all_files(folder: Path, name: str, count: int) -> None:
    put(folder / f"{name}.bin", 0, count)
    with pytest.raises(DataError, match=rf"{name}\.bin: is truncated or no file of COLMAP's"):
        check_binary_model(folder)
    with pytest.raises(DataError, match=rf"{name}\.bin"):
        read_model(folder)


@pytest.mark.parametrize("count", COUNTS)
def test_counts_of_keypoints_and_tracks_beyond_all_files(folder: Path, count: int) -> None:
    data = (folder / "images.bin").read_bytes()
    after_name = data.index(b"\0", 8 + 4 + 56 + 4) + 1
    put(folder / "images.bin", after_name, count)
    with pytest.raises(DataError, match=r"images\.bin: is truncated"):
        read_model(folder)
    (folder / "images.bin").write_bytes(data)
    put(folder / "points3D.bin", 8 + 8 + 24 + 3 + 8, count)
    with pytest.raises(DataError, match=r"points3D\.bin: is truncated"):
        read_model(folder)


def written(tmp_path: Path, model: SparseModel) -> Path:
    write_model(model, tmp_path / "absurd")
    return tmp_path / "absurd"


@pytest.mark.parametrize("value", [1e13, -1e300, np.nan, np.inf])
def test_places_that_are_absurd(tmp_path: Path, value: float) -> None:
    model = board_scene(PINHOLE, 3).model
    pose = model.views[1].cam_from_world
    far = replace(
        model.views[1], cam_from_world=RigidTransform(pose.rotation, np.array([0, value, 0]))
    )
    views = (model.views[0], far, model.views[2])
    with pytest.raises(DataError, match=r"absurd: is no sound COLMAP model \(the place of 001"):
        read_model(written(tmp_path, replace(model, views=views)))
    points = model.tracks.points_in_world.copy()
    points[3, 1] = value
    tracks = replace(model.tracks, points_in_world=points)
    with pytest.raises(DataError, match=r"\(a point is not finite or absurd\)"):
        read_model(written(tmp_path, replace(model, tracks=tracks)))
    xy = model.tracks.obs_xy.copy()
    xy[0, 0] = value
    tracks = replace(model.tracks, obs_xy=xy)
    with pytest.raises(DataError, match=r"\(a keypoint is not finite"):
        read_model(written(tmp_path, replace(model, tracks=tracks)))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"fx": 1e300}, "the camera of 000"),
        ({"fx": np.nan}, "the camera of 000"),
        ({"fx": -1.0, "fy": -1.0}, "the camera of 000"),
        ({"cx": np.inf}, "the camera of 000"),
        ({"width": 2**40}, rf"the camera of 000\.png is {2**40}x128 px"),
        ({"height": 0}, r"the camera of 000\.png is 160x0 px"),
    ],
)
def test_cameras_that_are_none(tmp_path: Path, changes: dict, message: str) -> None:
    model = board_scene(PINHOLE, 3).model
    camera = replace(PINHOLE, **changes)
    views = tuple(replace(view, camera=camera) for view in model.views)
    with pytest.raises(DataError, match=rf"is no sound COLMAP model \({message}"):
        read_model(written(tmp_path, replace(model, views=views)))


def test_what_is_just_bearable_is_computed_with(tmp_path: Path) -> None:
    """At the limit nothing overflows: deviations and points stay numbers, or NaN where unknown."""
    model = board_scene(PINHOLE, 3).model
    points = model.tracks.points_in_world.copy()
    points[0] = MAX_COORDINATE
    points[1] = model.views[0].center_in_world  # in a camera that sees it
    tracks = replace(model.tracks, points_in_world=points)
    again = read_model(written(tmp_path, replace(model, tracks=tracks)))
    assert np.isfinite(point_sigmas(again.tracks, again.views)).all()


def test_rays_that_are_not_known_meet_nowhere() -> None:
    rays = np.array([[[0, 0, 1.0], [0, 1.0, 0]], [[0, 0, 1.0], [np.nan] * 3]])
    centers = np.array([[[0, 0, 0.0], [0, -1.0, 2.0]]] * 2)
    points = intersect_rays(centers, rays)
    np.testing.assert_allclose(points[0], [0, 0, 2])
    assert np.isnan(points[1]).all()
