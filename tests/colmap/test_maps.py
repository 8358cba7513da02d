"""COLMAP's map files: bytes, round trips, the order of memory, bad files."""

import struct

import numpy as np
import pycolmap
import pytest
from dense_scenes import PINHOLE

from polmvs.camera import PinholeCamera
from polmvs.colmap.maps import (
    check_depth_map,
    map_pixel_xy,
    read_depth_map,
    read_normal_map,
    write_depth_map,
    write_normal_map,
)
from polmvs.errors import DataError

SMALL = PinholeCamera(width=3, height=2, fx=4.0, fy=4.0, cx=1.5, cy=1.0)


def facing_normals(camera, seed=0):
    """Random unit normals that face the camera, a tenth of them unknown."""
    rng = np.random.default_rng(seed)
    shape = (camera.height, camera.width)
    normals = rng.normal(size=(*shape, 3))
    normals /= np.linalg.norm(normals, axis=-1, keepdims=True)
    rays = camera.rays(map_pixel_xy(camera.width, camera.height))
    normals *= -np.sign((normals * rays).sum(axis=-1, keepdims=True))
    normals[rng.random(shape) < 0.1] = 0
    return normals.astype(np.float32)


def plane_normals(camera):
    normal = np.array([0.6, 0.0, -0.8], np.float32)
    return np.broadcast_to(normal, (camera.height, camera.width, 3))


def write_interleaved(path, normals):
    height, width, _ = normals.shape
    path.write_bytes(f"{width}&{height}&3&".encode() + normals.astype("<f4").tobytes())


def test_map_pixels_lie_at_integers():
    xy = map_pixel_xy(4, 3)
    assert xy.shape == (3, 4, 2)
    np.testing.assert_array_equal(xy[2, 1], [1, 2])


def test_depth_map_byte_for_byte(tmp_path):
    path = tmp_path / "a.bin"
    write_depth_map(path, np.array([[1, 2, np.nan], [-1, 0, 3]], np.float32))
    assert path.read_bytes() == b"3&2&1&" + struct.pack("<6f", 1, 2, 0, 0, 0, 3)


def test_normal_map_byte_for_byte_is_planar(tmp_path):
    path = tmp_path / "a.bin"
    normals = np.zeros((1, 2, 3), np.float32)
    normals[0, 0], normals[0, 1] = (0.6, 0, -0.8), (0, 0.8, -0.6)
    write_normal_map(path, normals)
    assert path.read_bytes() == b"2&1&3&" + struct.pack("<6f", 0.6, 0, 0, 0.8, -0.8, -0.6)


def test_round_trip(tmp_path):
    depth = np.random.default_rng(0).uniform(-1, 3, (128, 160)).astype(np.float32)
    normals = facing_normals(PINHOLE)
    write_depth_map(tmp_path / "d.bin", depth)
    write_normal_map(tmp_path / "n.bin", normals)
    np.testing.assert_array_equal(
        read_depth_map(tmp_path / "d.bin", PINHOLE), np.where(depth > 0, depth, 0)
    )
    np.testing.assert_array_equal(read_normal_map(tmp_path / "n.bin", PINHOLE), normals)


def test_unknown_normals_are_written_as_zero(tmp_path):
    normals = np.full((2, 3, 3), np.nan, np.float32)
    normals[0, 0] = 0, 0, -1
    write_normal_map(tmp_path / "n.bin", normals)
    back = read_normal_map(tmp_path / "n.bin", SMALL)
    np.testing.assert_array_equal(back[0, 0], [0, 0, -1])
    assert not back.reshape(-1, 3)[1:].any()


def test_colmap_reads_our_files(tmp_path):
    """pycolmap's memory is the file's; ``to_array`` gives it the wrong shape."""
    normals, depth = facing_normals(PINHOLE), np.ones((128, 160), np.float32)
    write_normal_map(tmp_path / "n.bin", normals)
    write_depth_map(tmp_path / "d.bin", depth)
    theirs, theirs_depth = pycolmap.NormalMap(), pycolmap.DepthMap()
    theirs.read(str(tmp_path / "n.bin"))
    theirs_depth.read(str(tmp_path / "d.bin"))
    planes = np.asarray(theirs.to_array()).reshape(3, 128, 160)
    np.testing.assert_array_equal(np.moveaxis(planes, 0, -1), normals)
    np.testing.assert_array_equal(np.asarray(theirs_depth.to_array()).squeeze(), depth)


@pytest.mark.parametrize("make", [facing_normals, plane_normals])
@pytest.mark.parametrize("width", [160, 161, 162])
def test_interleaved_normals_are_refused(tmp_path, make, width):
    camera = PinholeCamera(width=width, height=127, fx=120.0, fy=121.0, cx=79.0, cy=63.0)
    write_interleaved(tmp_path / "n.bin", make(camera))
    with pytest.raises(DataError, match="all x, all y, all z"):
        read_normal_map(tmp_path / "n.bin", camera)
    write_normal_map(tmp_path / "n.bin", make(camera))
    np.testing.assert_array_equal(read_normal_map(tmp_path / "n.bin", camera), make(camera))


def test_an_empty_map_is_fine(tmp_path):
    write_normal_map(tmp_path / "n.bin", np.zeros((2, 3, 3), np.float32))
    assert not read_normal_map(tmp_path / "n.bin", SMALL).any()


SIX = struct.pack("<6f", *range(6))


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "no map of COLMAP's"),
        (b"ply\nformat", "no map of COLMAP's"),
        (b"3&2&", "no map of COLMAP's"),
        (b"3&2&1&" + SIX[:-1], "is damaged: 29 bytes"),
        (b"3&2&1&" + SIX + b"\0", "is damaged: 31 bytes"),
        (b"3&2&1&", "is damaged: 6 bytes"),
        (b"999999999&999999999&1&", "999999999x999999999 px but its camera 3x2"),
        (b"2&3&1&" + SIX, "is 2x3 px but its camera 3x2"),
        (b"3&2&3&" + 3 * SIX, "a normal map where a depth map is expected"),
        (b"3&2&2&" + 2 * SIX, "a 2-channel map where a depth map is expected"),
        (b"3&2&1&" + struct.pack("<6f", 1, 2, 3, 4, 5, np.nan), "not finite"),
        (b"3&2&1&" + struct.pack("<6f", 1, 2, 3, 4, 5, np.inf), "not finite"),
    ],
)
def test_bad_depth_maps(tmp_path, content, words):
    path = tmp_path / "bad.bin"
    path.write_bytes(content)
    with pytest.raises(DataError, match=words) as caught:
        read_depth_map(path, SMALL)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_missing_map(tmp_path):
    with pytest.raises(DataError, match="no such file"):
        check_depth_map(tmp_path / "none.bin", SMALL)
    with pytest.raises(DataError, match="cannot be read"):
        check_depth_map(tmp_path, SMALL)


def test_depth_map_is_no_normal_map(tmp_path):
    write_depth_map(tmp_path / "d.bin", np.ones((2, 3), np.float32))
    with pytest.raises(DataError, match="a depth map where a normal map is expected"):
        read_normal_map(tmp_path / "d.bin", SMALL)


def test_callers_mistakes(tmp_path):
    with pytest.raises(ValueError, match="shape"):
        write_depth_map(tmp_path / "d.bin", np.ones((2, 3, 1), np.float32))
    with pytest.raises(ValueError, match="infinities"):
        write_depth_map(tmp_path / "d.bin", np.full((2, 3), np.inf, np.float32))
    with pytest.raises(ValueError, match="shape"):
        write_normal_map(tmp_path / "n.bin", np.ones((3, 2, 2), np.float32))
    with pytest.raises(ValueError, match="not unit"):
        write_normal_map(tmp_path / "n.bin", np.ones((2, 3, 3), np.float32))
    assert not list(tmp_path.iterdir())
