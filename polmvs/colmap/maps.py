"""COLMAP's depth and normal maps: files of a dense workspace, and the coordinates of their pixels.

A file is ``W&H&C&`` in ASCII and then little-endian float32, channel after channel: all x of the
normals, then all y, then all z. ``pycolmap.NormalMap.from_array`` and ``to_array`` interleave the
channels of each pixel instead, so they are not used.

Half a pixel
------------
COLMAP's intrinsics put the centre of the first pixel at ``(0.5, 0.5)``. But its PatchMatch and its
fusion use pixel ``(row, col)`` of a map with the same intrinsics as ``xy = (col, row)``. A map
therefore holds the depth along that ray: only :func:`map_pixel_xy` has this convention.
"""

from __future__ import annotations

import re
from os import PathLike
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Image
from polmvs.camera import PinholeCamera
from polmvs.errors import DataError, as_data_error
from polmvs.geometry import dots, lengths
from polmvs.io.images import write_bytes
from polmvs.io.plain_files import read_head

PathArg = str | PathLike[str]

HEADER = re.compile(rb"(\d{1,9})&(\d{1,9})&(\d{1,9})&")
HEADER_BYTES = 3 * len("999999999&")
SAMPLE = np.dtype("<f4")
CHANNELS = {"depth": 1, "normal": 3}
MAX_LENGTH_ERROR = 0.01  # of a unit normal; a guess, far above float32's rounding
# COLMAP writes no normal that is not unit or looks away from the camera. Of normals in another
# order of memory at least a third are, those of a single plane included: between, a guess.
MAX_ODD_NORMALS = 0.1
AGAIN = "Run the stereo stage that wrote it again."


class DepthNormals(NamedTuple):
    """Maps of one view.

    Attributes
    ----------
    depth : (H, W) float32, z in the camera frame, world units; 0 where unknown.
    normals : (H, W, 3) float32, camera frame, unit, facing the camera; 0 where unknown.
    """

    depth: Image
    normals: Image


def map_pixel_xy(width: int, height: int) -> NDArray[np.float64]:
    """Image coordinates ``(height, width, 2)`` of the pixels of a map: (col, row).

    They are half a pixel up and left of the pixels' centres; see the module's docstring.
    """
    grid = np.meshgrid(np.arange(width), np.arange(height))
    return np.stack(grid, axis=-1).astype(np.float64)


def write_depth_map(path: PathArg, depth: Image) -> None:
    """Write a depth map whole or not at all.

    Parameters
    ----------
    path : file to write or replace; its folder must exist.
    depth : (H, W), z in the camera frame; values that are not positive (or NaN) are written as 0.

    Raises
    ------
    DataError
        The system refuses.
    """
    if depth.ndim != 2 or np.isposinf(depth).any():
        raise ValueError(f"{depth.shape=} but expected (H, W) without infinities.")
    _write(path, np.where(depth > 0, depth, 0)[None])


def write_normal_map(path: PathArg, normals: Image) -> None:
    """Write a normal map whole or not at all.

    Parameters
    ----------
    path : file to write or replace; its folder must exist.
    normals : (H, W, 3), camera frame, unit; 0 or NaN where unknown, written as 0.

    Raises
    ------
    DataError
        The system refuses.
    """
    if normals.ndim != 3 or normals.shape[2] != 3:
        raise ValueError(f"{normals.shape=} but expected (H, W, 3).")
    known = np.logical_and.reduce([np.isfinite(normals[..., i]) for i in range(3)])
    normals = np.where(known[..., None], normals, 0)
    length = lengths(normals)
    if (np.abs(length - 1)[length > 0] > MAX_LENGTH_ERROR).any():
        raise ValueError("normals are not unit.")
    _write(path, np.moveaxis(normals, -1, 0))


def read_depth_map(path: PathArg, camera: PinholeCamera) -> Image:
    """Read a depth map of a camera, ``(H, W)`` float32; 0 where the depth is unknown.

    Raises
    ------
    DataError
        The file is missing, truncated, not a depth map, of another size or not finite.
    """
    check_depth_map(path, camera)
    depth = _read(path)[0]
    return np.where(depth > 0, depth, np.float32(0))


def read_normal_map(path: PathArg, camera: PinholeCamera) -> Image:
    """Read a normal map of a camera, ``(H, W, 3)`` float32; 0 where the normal is unknown.

    Raises
    ------
    DataError
        The file is missing, truncated, not a normal map, of another size or not finite, or its
        values are not unit normals that face the camera.
    """
    check_normal_map(path, camera)
    normals = np.ascontiguousarray(np.moveaxis(_read(path), 0, -1))
    length = lengths(normals)
    rays = camera.rays(map_pixel_xy(camera.width, camera.height))
    odd = (np.abs(length - 1) > MAX_LENGTH_ERROR) | (dots(normals, rays) > 0)
    known = length > 0
    if np.count_nonzero(odd & known) > MAX_ODD_NORMALS * np.count_nonzero(known):
        raise DataError(
            path,
            "does not hold unit normals that face the camera. They must be in the camera's frame "
            "and in the order of all x, all y, all z (which pycolmap's from_array is not).",
        )
    return normals


def check_depth_map(path: PathArg, camera: PinholeCamera) -> None:
    """Check header and length of a depth map without reading it.

    Raises
    ------
    DataError
        The file is missing, truncated, not a depth map or of another size.
    """
    _check(path, camera, "depth")


def check_normal_map(path: PathArg, camera: PinholeCamera) -> None:
    """As :func:`check_depth_map`, for a normal map."""
    _check(path, camera, "normal")


def _write(path: PathArg, channels: NDArray[np.floating]) -> None:
    """Write ``(C, H, W)``."""
    depth, height, width = channels.shape
    header = f"{width}&{height}&{depth}&".encode("ascii")
    write_bytes(path, header + np.ascontiguousarray(channels, SAMPLE).tobytes())


def _check(path: PathArg, camera: PinholeCamera, kind: str) -> None:
    """Whether a file announces and holds a map of this kind and of the camera's size."""
    (width, height, channels), start, num_bytes = _read_header(path)
    if channels != CHANNELS[kind]:
        kinds = {number: name for name, number in CHANNELS.items()}
        found = kinds.get(channels, f"{channels}-channel")
        raise DataError(
            path,
            f"is a {found} map where a {kind} map is expected. Put the files of "
            "depth_maps and normal_maps back into their own folders.",
        )
    if (width, height) != (camera.width, camera.height):
        raise DataError(
            path,
            f"is {width}x{height} px but its camera {camera.width}x{camera.height} px. "
            "Limit the size in COLMAP's image_undistorter, not in patch_match_stereo.",
        )
    if num_bytes != start + width * height * channels * SAMPLE.itemsize:
        raise DataError(
            path,
            f"is damaged: {num_bytes} bytes do not make {width}x{height}x{channels} samples. "
            f"{AGAIN}",
        )


def _read_header(path: PathArg) -> tuple[tuple[int, int, int], int, int]:
    """Width, height and channels; where the samples start; length of the file in bytes."""
    with as_data_error(path, "read", missing=f"no such file. {AGAIN}"):
        head, num_bytes = read_head(path, HEADER_BYTES)
    match = HEADER.match(head)
    if match is None:
        raise DataError(path, f"is no map of COLMAP's: W&H&C& is expected at its start. {AGAIN}")
    width, height, channels = (int(number) for number in match.groups())
    return (width, height, channels), match.end(), num_bytes


def _read(path: PathArg) -> Image:
    """Samples ``(C, H, W)`` of a file that was checked."""
    (width, height, channels), start, _ = _read_header(path)
    with as_data_error(path, "read"):
        samples = np.fromfile(path, SAMPLE, offset=start)
    if not np.isfinite(samples).all():
        raise DataError(path, f"holds numbers that are not finite. {AGAIN}")
    return samples.reshape(channels, height, width).astype(np.float32, copy=False)
