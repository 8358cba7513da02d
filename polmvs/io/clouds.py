"""Point clouds and meshes as files, by Open3D."""

from __future__ import annotations

import os
import re
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.errors import DataError, PolmvsError
from polmvs.io.images import write_bytes
from polmvs.io.open3d_import import import_open3d

Array = NDArray[np.float64]

PLY_BYTES = {
    "char": 1, "uchar": 1, "int8": 1, "uint8": 1, "short": 2, "ushort": 2, "int16": 2, "uint16": 2,
    "int": 4, "uint": 4, "int32": 4, "uint32": 4, "float": 4, "float32": 4,
    "double": 8, "float64": 8,
}  # fmt: skip


@dataclass(frozen=True)
class Cloud:
    """A point cloud as arrays.

    Attributes
    ----------
    points : (N, 3) float64
    normals : (N, 3) float64, unit, or None
    colors : (N, 3) uint8 or None
    scalars : further per-point values by name, each (N,)
    """

    points: Array
    normals: Array | None = None
    colors: NDArray[np.uint8] | None = None
    scalars: Mapping[str, NDArray[Any]] = field(default_factory=dict)

    def only(self, kept: NDArray[np.bool_]) -> Cloud:
        """The ``kept`` (N,) points as a cloud of their own."""
        return Cloud(
            points=self.points[kept],
            normals=None if self.normals is None else self.normals[kept],
            colors=None if self.colors is None else self.colors[kept],
            scalars={name: values[kept] for name, values in self.scalars.items()},
        )


@dataclass(frozen=True)
class Mesh:
    """A triangle mesh as arrays.

    Attributes
    ----------
    vertices : (V, 3) float64
    normals : (V, 3) float64, unit, outwards
    triangles : (F, 3) int32, indices of vertices, anticlockwise seen from outside
    colors : (V, 3) uint8 or None
    """

    vertices: Array
    normals: Array
    triangles: NDArray[np.int32]
    colors: NDArray[np.uint8] | None = None


def preload() -> None:
    """Begin to import Open3D beside other work, such as that of COLMAP's mapper on one core."""

    def load() -> None:
        with suppress(PolmvsError):  # said when a cloud is written
            import_open3d()

    threading.Thread(target=load, name="preload-open3d").start()


def to_open3d(cloud: Cloud) -> Any:
    """Make an ``open3d.t.geometry.PointCloud``; points, normals and scalars as float32."""
    o3d = import_open3d()
    points = np.ascontiguousarray(cloud.points, np.float32)
    result = o3d.t.geometry.PointCloud(o3d.core.Tensor(points))
    if cloud.normals is not None:
        result.point.normals = o3d.core.Tensor(np.ascontiguousarray(cloud.normals, np.float32))
    if cloud.colors is not None:
        result.point.colors = o3d.core.Tensor(np.ascontiguousarray(cloud.colors, np.uint8))
    for name, values in cloud.scalars.items():
        column = np.ascontiguousarray(values, np.float32).reshape(-1, 1)
        result.point[name] = o3d.core.Tensor(column)
    return result


def mesh_to_open3d(mesh: Mesh) -> Any:
    """Make an ``open3d.geometry.TriangleMesh`` with vertex normals."""
    o3d = import_open3d()
    result = o3d.geometry.TriangleMesh(
        o3d.utility.Vector3dVector(mesh.vertices), o3d.utility.Vector3iVector(mesh.triangles)
    )
    result.vertex_normals = o3d.utility.Vector3dVector(mesh.normals)
    if mesh.colors is not None:
        result.vertex_colors = o3d.utility.Vector3dVector(mesh.colors / 255)
    return result


def write_cloud(path: str | Path, cloud: Cloud) -> None:
    """Write a binary PLY that Open3D, MeshLab and CloudCompare open, whole or not at all.

    Raises
    ------
    DataError
        If the file cannot be written.
    """
    target = Path(path)
    temporary = target.with_name(f".{target.stem}.{os.getpid()}.tmp.ply")
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        if len(cloud.points):
            written = import_open3d().t.io.write_point_cloud(str(temporary), to_open3d(cloud))
            if not written:
                raise DataError(target, "cannot be written; is the disk full or read-only?")
        else:  # Open3D refuses clouds without points
            temporary.write_bytes(_empty_ply(cloud))
        os.replace(temporary, target)
    except OSError as error:
        raise DataError(target, f"cannot be written: {error.strerror or error}.") from error
    finally:
        temporary.unlink(missing_ok=True)


def _empty_ply(cloud: Cloud) -> bytes:
    """A PLY of no points with the columns of the cloud."""
    columns = ["float x", "float y", "float z", "float nx", "float ny", "float nz"]
    columns += ["uchar red", "uchar green", "uchar blue"]
    columns += [f"float {name}" for name in cloud.scalars]
    lines = ["ply", "format binary_little_endian 1.0", "element vertex 0"]
    lines += [f"property {c}" for c in columns]
    return ("\n".join([*lines, "end_header"]) + "\n").encode()


def read_cloud(path: str | Path) -> Cloud:
    """Read a PLY with whatever columns it has.

    Raises
    ------
    DataError
        If the file is missing or no point cloud.
    """
    source = Path(path)
    num_points = _checked_header(source)
    if num_points == 0:
        return Cloud(np.zeros((0, 3)))
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        loaded = o3d.t.io.read_point_cloud(str(source))
    if "positions" not in loaded.point or len(loaded.point.positions) != num_points:
        raise DataError(source, "cannot be read as a point cloud; is it truncated?")
    columns = {name: loaded.point[name].numpy() for name in loaded.point}
    normals = columns.pop("normals", None)
    return Cloud(
        points=columns.pop("positions").astype(np.float64),
        normals=None if normals is None else normals.astype(np.float64),
        colors=columns.pop("colors", None),
        scalars={name: values.reshape(-1) for name, values in columns.items()},
    )


def has_triangles(path: str | Path) -> bool:
    """Whether a PLY is a mesh.

    Raises
    ------
    DataError
        The file is missing or no PLY.
    """
    lines, _ = _header(Path(path))
    return any(line[:2] == ["element", "face"] and line[-1] != "0" for line in lines)


def show_in_viewer(paths: Sequence[str | Path]) -> None:
    """Open Open3D's viewer on clouds and meshes; returns when its window is closed.

    Raises
    ------
    DataError
        A file is unusable.
    PolmvsError
        There is no window to be had.
    """
    o3d = import_open3d()
    shown = [
        {
            "name": Path(path).stem,
            "geometry": mesh_to_open3d(read_mesh(path))
            if has_triangles(path)
            else to_open3d(read_cloud(path)),
        }
        for path in paths
    ]
    try:
        o3d.visualization.draw(shown, show_ui=True)
    except RuntimeError as error:
        raise PolmvsError(f"Open3D opens no window here ({error}).") from error


def _header(source: Path) -> tuple[list[list[str]], int]:
    """Words of the lines of a PLY's header, and where that ends."""
    if not source.is_file():
        raise DataError(source, "no such file; give a PLY point cloud.")
    with source.open("rb") as file:
        head = file.read(65536)
    end = head.find(b"end_header")
    if not head.startswith(b"ply") or end < 0:
        raise DataError(source, "is no PLY file; give a PLY point cloud.")
    return [line.split() for line in head[:end].decode("ascii", "replace").splitlines()], end


def _checked_header(source: Path) -> int:
    """Number of points that a PLY promises, once the file is known to be long enough.

    Open3D fills a truncated file up with zeros.
    """
    lines, end = _header(source)
    elements = [line for line in lines if line[:1] == ["element"]]
    if not elements or elements[0][1:2] != ["vertex"] or not elements[0][-1].isdigit():
        raise DataError(source, "holds no vertices; give a PLY point cloud.")
    num_points = int(elements[0][-1])
    start = lines.index(elements[0]) + 1
    stop = lines.index(elements[1]) if len(elements) > 1 else len(lines)
    types = [line[1] for line in lines[start:stop] if line[:1] == ["property"]]
    ascii_format = ["format", "ascii", "1.0"] in lines
    # An ASCII value takes two bytes at the least.
    row_bytes = sum(2 if ascii_format else PLY_BYTES.get(name, 1) for name in types)
    if source.stat().st_size < end + num_points * row_bytes:
        raise DataError(source, "is truncated; write or copy it again.")
    return num_points


def solve_poisson(
    points: Array, normals: Array, *, depth: int, scale: float
) -> tuple[Array, NDArray[np.int32]]:
    """Vertices ``(V, 3)`` and triangles ``(F, 3)`` of the closed Poisson surface of a cloud.

    On one thread: with several the result depends on which is first.

    Parameters
    ----------
    points, normals : (N, 3), normals unit and outwards.
    depth : of the octree; a cell is ``scale * extent / 2**depth`` wide.
    scale : side of the octree's cube over the points' extent.
    """
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh, _ = o3d.geometry.TriangleMesh.create_from_point_cloud_poisson(
            cloud, depth=depth, scale=scale, n_threads=1
        )
    return np.array(mesh.vertices, np.float64), np.array(mesh.triangles, np.int32)


def write_mesh(path: str | Path, mesh: Mesh) -> None:
    """Write a binary PLY that Open3D, MeshLab and Blender open, whole or not at all.

    Raises
    ------
    DataError
        If the file cannot be written.
    """
    columns = [("float", "<f4", name) for name in ("x", "y", "z", "nx", "ny", "nz")]
    values = [*mesh.vertices.T, *mesh.normals.T]
    if mesh.colors is not None:
        columns += [("uchar", "u1", name) for name in ("red", "green", "blue")]
        values += [*mesh.colors.T]
    vertices = np.empty(len(mesh.vertices), [(name, code) for _, code, name in columns])
    for (_, _, name), column in zip(columns, values, strict=True):
        vertices[name] = column
    faces = np.empty(len(mesh.triangles), [("count", "u1"), ("index", "<i4", 3)])
    faces["count"], faces["index"] = 3, mesh.triangles
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {len(vertices)}"]
    lines += [f"property {kind} {name}" for kind, _, name in columns]
    lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
    header = ("\n".join([*lines, "end_header"]) + "\n").encode()
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(target, f"cannot be written: {error.strerror or error}.") from error
    write_bytes(target, header + vertices.tobytes() + faces.tobytes())


def read_mesh(path: str | Path) -> Mesh:
    """Read a PLY mesh; normals that it lacks are computed.

    Raises
    ------
    DataError
        If the file is missing, truncated or no mesh.
    """
    source = Path(path)
    if not source.is_file():
        raise DataError(source, "no such file; give a PLY mesh.")
    num_vertices = _checked_header(source)
    with source.open("rb") as file:
        found = re.search(rb"^element face (\d+)", file.read(65536), re.MULTILINE)
    if found is None:
        raise DataError(source, "holds no faces; give a PLY mesh.")
    if num_vertices == 0:
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    o3d = import_open3d()
    with o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error):
        mesh = o3d.io.read_triangle_mesh(str(source))
    vertices, triangles = np.array(mesh.vertices), np.array(mesh.triangles, np.int32)
    if len(vertices) != num_vertices or len(triangles) < int(found[1]):
        raise DataError(source, "cannot be read as a mesh; is it truncated?")
    if not mesh.has_vertex_normals():
        mesh.compute_vertex_normals()
    colors = np.rint(255 * np.array(mesh.vertex_colors)).astype(np.uint8)
    normals = np.array(mesh.vertex_normals)
    return Mesh(vertices, normals, triangles.reshape(-1, 3), colors if len(colors) else None)
