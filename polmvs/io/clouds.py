"""Point clouds and meshes: files, and conversion to Open3D, which takes seconds to import."""

from __future__ import annotations

import logging
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Mask
from polmvs.errors import DataError, PolmvsError, as_data_error
from polmvs.io.open3d_import import import_open3d
from polmvs.io.ply import read_ply, read_ply_header, write_ply
from polmvs.scene import MAX_COORDINATE, PointKind
from polmvs.unprinted import unprinted

logger = logging.getLogger(__name__)

NORMALS = ("nx", "ny", "nz")
COLORS = ("red", "green", "blue")


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
        """The ``kept`` (N,) points as a new cloud."""
        return Cloud(
            points=self.points[kept],
            normals=None if self.normals is None else self.normals[kept],
            colors=None if self.colors is None else self.colors[kept],
            scalars={name: values[kept] for name, values in self.scalars.items()},
        )

    def are(self, *kinds: PointKind) -> Mask:
        """Mask (N,) of the points of these kinds; all points if the cloud has no kinds."""
        if "kind" not in self.scalars:
            return np.ones(len(self.points), np.bool_)
        return np.isin(self.scalars["kind"], kinds)


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

    def only(self, kept: NDArray[np.bool_]) -> Mesh:
        """The triangles whose three vertices are all ``kept`` (V,), and their vertices."""
        triangles = self.triangles[kept[self.triangles].all(axis=1)]
        used = np.unique(triangles)
        index = np.zeros(len(self.vertices), np.int32)
        index[used] = np.arange(len(used))
        return Mesh(
            vertices=self.vertices[used],
            normals=self.normals[used],
            triangles=index[triangles],
            colors=None if self.colors is None else self.colors[used],
        )


def preload() -> threading.Thread:
    """Start to import Open3D in parallel with other work, such as COLMAP's mapper on one core.

    Join the thread before an array is read: in CPython 3.11 parsing sometimes fails (SystemError)
    in two threads, here the import and NumPy's reader of headers.
    """

    def load() -> None:
        # A missing library is reported when it is needed; a program that ends stops the import.
        with suppress(Exception):
            import_open3d()

    thread = threading.Thread(target=load, name="preload-open3d")
    thread.start()
    return thread


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
    num = len(cloud.points)
    columns = dict(zip("xyz", np.asarray(cloud.points).T, strict=True))
    if cloud.normals is not None or num == 0:  # other programs look for these
        normals = np.zeros((0, 3)) if cloud.normals is None else cloud.normals
        columns |= dict(zip(NORMALS, normals.T, strict=True))
    if cloud.colors is not None or num == 0:
        colors = np.zeros((0, 3)) if cloud.colors is None else cloud.colors
        columns |= dict(zip(COLORS, colors.astype(np.uint8).T, strict=True))
    scalars = {name: np.asarray(values, np.float32) for name, values in cloud.scalars.items()}
    write_ply(Path(path), {**columns, **scalars})


def read_cloud(path: str | Path) -> Cloud:
    """Read a PLY with whatever columns it has.

    Raises
    ------
    DataError
        The file is missing, truncated, not a point cloud, or has points that are not finite.
    """
    source = Path(path)
    columns = dict(read_ply(source).vertices)
    points = _points(source, columns)
    normals, colors = _taken(columns, NORMALS), _taken(columns, COLORS)
    return Cloud(
        points=points,
        normals=None if normals is None else normals.astype(np.float64),
        colors=None if colors is None else _as_bytes(colors),
        scalars=columns,
    )


def _points(source: Path, columns: dict[str, NDArray[Any]]) -> Array:
    """The places (N, 3) of the vertices; their columns are taken out."""
    points = _taken(columns, tuple("xyz"))
    if points is None:
        raise DataError(source, "holds no x, y and z; give a PLY point cloud.")
    # Not where one is not a number.
    if not (np.abs(points) <= MAX_COORDINATE).all():
        raise DataError(
            source, f"has points that are not finite or beyond {MAX_COORDINATE:.0e}. Take them out."
        )
    return points.astype(np.float64)


def _taken(columns: dict[str, NDArray[Any]], names: Sequence[str]) -> NDArray[Any] | None:
    """Columns side by side (N, C), taken out of the others; None where one is missing."""
    if not all(name in columns for name in names):
        return None
    return np.stack([columns.pop(name) for name in names], axis=-1)


def _as_bytes(colors: NDArray[Any]) -> NDArray[np.uint8]:
    """Colours of any type as 0 to 255: floats are from 0 to 1, wider integers over their range."""
    if colors.dtype == np.uint8:
        return colors
    largest = 1.0 if colors.dtype.kind == "f" else float(np.iinfo(colors.dtype).max)
    shares = np.nan_to_num(colors / largest, nan=0.0, posinf=1.0, neginf=0.0)
    return np.asarray(np.rint(255 * np.clip(shares, 0, 1)), np.uint8)


def has_triangles(path: str | Path) -> bool:
    """Whether a PLY is a mesh.

    Raises
    ------
    DataError
        The file is missing or not a PLY.
    """
    faces = read_ply_header(Path(path)).find("face")
    return faces is not None and faces.num > 0


def show_in_viewer(paths: Sequence[str | Path]) -> None:
    """Open Open3D's viewer on clouds and meshes; returns when its window is closed.

    Raises
    ------
    DataError
        A file is unusable.
    PolmvsError
        No window can be opened.
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


def solve_poisson(
    points: Array, normals: Array, *, depth: int, scale: float
) -> tuple[Array, NDArray[np.int32]]:
    """Vertices ``(V, 3)`` and triangles ``(F, 3)`` of the closed Poisson surface of a cloud.

    It runs on one thread: with several the result depends on their timing.

    Parameters
    ----------
    points, normals : (N, 3), normals unit and outwards.
    depth : of the octree; a cell is ``scale * extent / 2**depth`` wide.
    scale : side of the octree's cube over the points' extent.
    """
    o3d = import_open3d()
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    cloud.normals = o3d.utility.Vector3dVector(normals)
    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    with quiet, unprinted("Open3D"):
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
    columns = dict(zip("xyz", mesh.vertices.T, strict=True))
    columns |= dict(zip(NORMALS, mesh.normals.T, strict=True))
    if mesh.colors is not None:
        columns |= dict(zip(COLORS, mesh.colors.T, strict=True))
    write_ply(Path(path), columns, mesh.triangles)


FOREIGN_MESHES = frozenset({".stl", ".obj", ".glb", ".gltf", ".off"})


def read_any_mesh(path: str | Path) -> Mesh:
    """Read a mesh of another program: STL, OBJ, GLB, OFF, or PLY; equal corners are joined.

    Raises
    ------
    DataError
        The file is missing, of another type, damaged, or has no faces.
    """
    source = Path(path)
    if source.suffix.lower() == ".ply":
        return read_mesh(source)
    if source.suffix.lower() not in FOREIGN_MESHES:
        raise DataError(source, f"is no mesh: .ply, {', '.join(sorted(FOREIGN_MESHES))} are read.")
    with as_data_error(source, "read"):
        empty = source.stat().st_size == 0
    o3d = import_open3d()
    quiet = o3d.utility.VerbosityContextManager(o3d.utility.VerbosityLevel.Error)
    with quiet, unprinted("Open3D"):
        found = o3d.geometry.TriangleMesh() if empty else o3d.io.read_triangle_mesh(str(source))
    if not len(found.triangles):
        raise DataError(source, "holds no faces that can be read. Export it again.")
    found.remove_duplicated_vertices()
    found.compute_vertex_normals()
    vertices = np.array(found.vertices, np.float64)
    if not (np.abs(vertices) <= MAX_COORDINATE).all():
        raise DataError(source, "has vertices that are not finite. Export it again.")
    return Mesh(
        vertices=vertices,
        normals=np.array(found.vertex_normals, np.float64),
        triangles=np.array(found.triangles, np.int32),
    )


def read_mesh(path: str | Path) -> Mesh:
    """Read a PLY mesh; missing normals are computed.

    Raises
    ------
    DataError
        The file is missing, truncated or not a mesh.
    """
    source = Path(path)
    content = read_ply(source, faces=True)
    if content.triangles is None:
        raise DataError(source, "holds no faces; give a PLY mesh.")
    columns = dict(content.vertices)
    vertices = _points(source, columns)
    normals, colors = _taken(columns, NORMALS), _taken(columns, COLORS)
    mesh = Mesh(
        vertices=vertices,
        normals=np.zeros_like(vertices) if normals is None else normals.astype(np.float64),
        triangles=content.triangles.astype(np.int32),
        colors=None if colors is None else _as_bytes(colors),
    )
    if normals is None and len(vertices):
        computed = mesh_to_open3d(mesh)
        computed.compute_vertex_normals()
        mesh = replace(mesh, normals=np.array(computed.vertex_normals))
    return mesh
