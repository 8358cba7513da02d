"""Point clouds as files of other programs: PLY, XYZ, LAS and LAZ."""

from __future__ import annotations

import io
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.errors import DataError, PolmvsError
from polmvs.io.clouds import NORMALS, Cloud, write_cloud
from polmvs.io.images import write_bytes

LAS_STEPS = 2**30  # of the coordinates' range: LAS holds them as 32-bit integers
POINT_FORMAT, LAS_VERSION = 2, "1.2"  # with colours; the version that everything reads


def write_cloud_file(path: Path, cloud: Cloud, form: str) -> None:
    """Write a cloud.

    Parameters
    ----------
    form : one of :data:`CLOUD_FORMATS`.

    Raises
    ------
    DataError
        The file cannot be written.
    PolmvsError
        The library for LAS is not installed.
    """
    CLOUD_FORMATS[form](path, cloud)


def _write_xyz(path: Path, cloud: Cloud) -> None:
    """A line for each point: place, normal, colour 0 to 255; 0 where there is none."""
    normals = np.zeros_like(cloud.points) if cloud.normals is None else cloud.normals
    lines = io.StringIO()
    np.savetxt(
        lines,
        np.column_stack([cloud.points, np.nan_to_num(normals), _colors(cloud)]),
        fmt="%.9g %.9g %.9g %.5f %.5f %.5f %d %d %d",
    )
    write_bytes(path, lines.getvalue().encode())


def _write_las(path: Path, cloud: Cloud, *, compressed: bool) -> None:
    """LAS 1.2 with colours; further values of the points as extra dimensions."""
    try:
        import laspy
    except ImportError as error:
        raise PolmvsError(
            f"{path}: LAS and LAZ need a library, in the clone: pip install '.[las]'."
        ) from error
    header = laspy.LasHeader(version=LAS_VERSION, point_format=POINT_FORMAT)
    low = cloud.points.min(axis=0) if len(cloud.points) else np.zeros(3)
    high = cloud.points.max(axis=0) if len(cloud.points) else np.ones(3)
    header.offsets = low
    header.scales = np.full(3, max(float((high - low).max()), 1e-9) / LAS_STEPS)
    extra: dict[str, NDArray[np.float32]] = {
        name: np.asarray(values, np.float32) for name, values in cloud.scalars.items()
    }
    if cloud.normals is not None:
        extra |= dict(zip(NORMALS, cloud.normals.T.astype(np.float32), strict=True))
    header.add_extra_dims([laspy.ExtraBytesParams(name=n, type=np.float32) for n in extra])
    las = laspy.LasData(header)
    las.x, las.y, las.z = cloud.points.T
    las.red, las.green, las.blue = 257 * _colors(cloud).T.astype(np.uint16)  # 16 bits, whole range
    for name, values in extra.items():
        las[name] = values
    stream = io.BytesIO()
    try:
        las.write(stream, do_compress=compressed)
    except laspy.errors.LaspyException as error:  # without a library for LAZ
        raise DataError(path, f"cannot be written: {error}.") from error
    write_bytes(path, stream.getvalue())


def _colors(cloud: Cloud) -> NDArray[np.uint8]:
    return np.zeros((len(cloud.points), 3), np.uint8) if cloud.colors is None else cloud.colors


CLOUD_FORMATS: Mapping[str, Callable[[Path, Cloud], None]] = {
    "ply": write_cloud,
    "xyz": _write_xyz,
    "las": partial(_write_las, compressed=False),
    "laz": partial(_write_las, compressed=True),
}
