"""The object's mesh: a built-in shape or a file, in metres, standing on the plane z = 0.

Shading follows the normals of a mesh, ground truth its triangles: with normals interpolated over
coarse triangles, the shading would belong to another surface than the depths. So a file is rendered
with the normals of its facets, or as a fine subdivision surface (Loop) whose facets and normals
agree to a fraction of a millimetre; the difference is measured and reported. Large facets are
halved: light is computed at vertices, so a shadow on a facet without any would be lost.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.errors import DataError, OptionError
from polmvs.geometry import lengths, unit
from polmvs.io.clouds import Mesh
from polmvs.io.mesh_files import linear_of_display
from polmvs.simulation.options import Facets, ObjectOptions
from polmvs.synthetic.shapes import named_shape, shape_names

logger = logging.getLogger(__name__)


DEFAULT_SIZE = 0.2  # metres
SUFFIXES = (".ply", ".obj", ".stl", ".glb", ".gltf", ".off")
METRIC_SUFFIXES = (".glb", ".gltf")  # whose format says metres
MAX_TRIANGLES = 1_500_000  # 2 GB at the most
PLACES = 30  # vertices along the object at which light is computed, or more
FINE_TRIANGLES = 200_000  # limit of a subdivision
FINE_SAG = 2e-4  # of the size, between facets and their normals: 40 um at 0.2 m
LARGEST_M, SMALLEST_M = 20.0, 0.002  # beyond which a file's unit is doubtful


@dataclass(frozen=True, kw_only=True, eq=False)
class ObjectMesh:
    """The object.

    Attributes
    ----------
    source : its file or name.
    mesh : metres, on the plane z = 0 over the origin; its normals are those of the shading.
    vertex_albedo : (V, 3) float32, linear, of a file with colours; else None.
    """

    source: str
    mesh: Mesh
    vertex_albedo: NDArray[np.float32] | None = None


def object_mesh(source: str | Path | Mesh, options: ObjectOptions) -> ObjectMesh:
    """The object of a file, a built-in shape's name, or arrays in metres.

    Raises
    ------
    DataError
        The file is missing, unreadable, has no faces or far too many, or no size.
    OptionError
        An option is for another kind of object.
    """
    if isinstance(source, Mesh):
        return _placed("a mesh", source, None, options, 1.0)
    if str(source) in shape_names():
        if options.unit is not None:
            raise OptionError("is of a file; give `object.size`.", field="object.unit")
        shape = named_shape(str(source))
        size = options.size or DEFAULT_SIZE
        mesh = Mesh(shape.vertices * size, shape.normals, shape.triangles)
        return ObjectMesh(source=str(source), mesh=mesh)
    path = Path(source)
    if not path.is_file():
        shapes = ", ".join(shape_names())
        raise DataError(path, f"no such file, and no built-in shape; these are {shapes}.")
    if path.suffix.lower() not in SUFFIXES:
        raise DataError(path, f"is no mesh that is read; give {', '.join(SUFFIXES)}.")
    vertices, triangles, colours = _read(path)
    mesh, colours = _surface(path, vertices, triangles, colours, options)
    unit_m = options.unit if options.unit is not None else _unit_of(path, mesh, options)
    return _placed(str(path), mesh, colours, options, unit_m)


def surface_sag(mesh: Mesh) -> float:
    """Largest distance between facets and the surface of interpolated normals, metres.

    Along an edge of length l whose normals turn by an angle t, the surface bulges by ``l tan(t / 2)
    / 4`` (a circular arc).
    """
    edges = mesh.triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    first, second = mesh.vertices[edges[:, 0]], mesh.vertices[edges[:, 1]]
    length = np.linalg.norm(second - first, axis=1)
    along = (second - first) / np.maximum(length, 1e-300)[:, None]
    tilt = (along * (mesh.normals[edges[:, 1]] - mesh.normals[edges[:, 0]])).sum(axis=1)
    turn = 2 * np.arcsin(np.clip(0.5 * np.abs(tilt), 0, 1))
    return float((length * np.tan(0.5 * turn) / 4).max(initial=0.0))


def _read(path: Path) -> tuple[Array, NDArray[np.int64], NDArray[np.float32] | None]:
    """Vertices, triangles and linear colours of a file, in its unit."""
    trimesh = _import_trimesh()
    try:
        loaded = trimesh.load(path, force="mesh", process=False)
        vertices = np.asarray(loaded.vertices, np.float64)
        triangles = np.asarray(getattr(loaded, "faces", np.zeros((0, 3))), np.int64)
    except Exception as error:  # whatever a reader stumbles over
        reason = " ".join(str(error).split())[:120]
        raise DataError(path, f"cannot be read as a mesh ({reason}). Export it again.") from error
    if len(triangles) == 0:
        raise DataError(
            path, "has no faces: it is a cloud of points, or damaged. Mesh it, or export it again."
        )
    if len(triangles) > MAX_TRIANGLES:
        raise DataError(
            path, f"has {len(triangles):,} faces, over {MAX_TRIANGLES:,}; simplify it first."
        )
    if not np.isfinite(vertices).all() or triangles.min() < 0 or triangles.max() >= len(vertices):
        raise DataError(path, "has vertices that are not finite, or faces without them.")
    return vertices, triangles, _colours(loaded, len(vertices))


def _colours(loaded: Any, num: int) -> NDArray[np.float32] | None:
    """Linear colours of the vertices, from their own or from a texture; None without any."""
    visual = getattr(loaded, "visual", None)
    if visual is None or not getattr(visual, "defined", False):
        return None
    try:
        if visual.kind == "texture":
            visual = visual.to_color()
        colours = np.asarray(visual.vertex_colors)[:, :3]
    except Exception:  # an image that is missing or damaged: the material's own colour serves
        logger.warning("the mesh's texture cannot be read; it is rendered without")
        return None
    if colours.shape != (num, 3):
        return None
    return linear_of_display(colours)


def _surface(
    path: Path,
    vertices: Array,
    triangles: NDArray[np.int64],
    colours: NDArray[np.float32] | None,
    options: ObjectOptions,
) -> tuple[Mesh, NDArray[np.float32] | None]:
    """The surface that is rendered: flat facets, or smooth between them."""
    trimesh = _import_trimesh()
    mesh = trimesh.Trimesh(vertices, triangles, process=False)
    mesh.merge_vertices(merge_norm=True, merge_tex=True)
    keep = mesh.nondegenerate_faces() & mesh.unique_faces()
    mesh.update_faces(keep)
    if len(mesh.faces) == 0:
        raise DataError(path, "has no face with an area.")
    _warn_of_topology(path, mesh)
    if not mesh.is_winding_consistent or (mesh.is_watertight and mesh.volume < 0):
        trimesh.repair.fix_normals(mesh, multibody=True)
    if options.facets is Facets.SMOOTH:
        return _subdivided(path, mesh, vertices, colours)
    corners = np.asarray(mesh.vertices, np.float64)[mesh.faces]
    if colours is not None:
        own = _nearest(vertices, colours, corners.reshape(-1, 3))
        corners = np.concatenate([corners, own.reshape(-1, 3, own.shape[1])], axis=2)
    corners = _halved(corners, float(np.ptp(mesh.vertices, axis=0).max()) / PLACES)
    places = corners[..., :3]
    normals = unit(np.cross(places[:, 1] - places[:, 0], places[:, 2] - places[:, 0]))
    flat = Mesh(
        places.reshape(-1, 3).copy(),
        np.repeat(normals, 3, axis=0),
        np.arange(3 * len(places), dtype=np.int32).reshape(-1, 3),
    )
    return flat, None if colours is None else corners[..., 3:].reshape(-1, 3).astype(np.float32)


def _halved(corners: Array, longest: float) -> Array:
    """Facets (F, 3, 3 + C), positions and C colours, halved until no edge is longer."""
    done = []
    while len(corners):
        places = corners[..., :3]
        edges = lengths(np.roll(places, -1, axis=1) - places)
        is_short = edges.max(axis=1) <= longest
        done.append(corners[is_short])
        turned = (edges[~is_short].argmax(axis=1)[:, None] + np.arange(3)) % 3
        corners = np.take_along_axis(corners[~is_short], turned[..., None], axis=1)
        start, end, apex = np.moveaxis(corners, 1, 0)
        middle = 0.5 * (start + end)
        halves = (start, middle, apex), (middle, end, apex)
        corners = np.concatenate([np.stack(half, axis=1) for half in halves])
    return np.concatenate(done)


def _subdivided(
    path: Path, mesh: Any, vertices: Array, colours: NDArray[np.float32] | None
) -> tuple[Mesh, NDArray[np.float32] | None]:
    """Loop's subdivision until facets are small and agree with normals, or there are many."""
    size = float(np.ptp(np.asarray(mesh.vertices), axis=0).max())
    while True:
        smooth = Mesh(
            np.asarray(mesh.vertices, np.float64),
            unit(np.asarray(mesh.vertex_normals, np.float64)),
            np.asarray(mesh.faces, np.int32),
        )
        sag = surface_sag(smooth)
        is_fine = sag <= FINE_SAG * size and float(mesh.edges_unique_length.max()) <= size / PLACES
        if is_fine or 4 * len(mesh.faces) > FINE_TRIANGLES:
            break
        mesh = mesh.subdivide_loop(iterations=1)
    kept = None if colours is None else _nearest(vertices, colours, smooth.vertices)
    if not np.isfinite(smooth.normals).all():
        raise DataError(path, "has vertices without a normal; give `object.facets` flat.")
    return smooth, kept


def _nearest(vertices: Array, colours: NDArray[np.float32], places: Array) -> NDArray[np.float32]:
    from scipy.spatial import cKDTree

    return np.asarray(colours[cKDTree(vertices).query(places)[1]], np.float32)


def _warn_of_topology(path: Path, mesh: Any) -> None:
    if mesh.is_watertight:
        return
    counts = np.bincount(np.asarray(mesh.edges_unique_inverse))
    faults = []
    if (counts == 1).any():
        faults.append("holes, through which its inside is black")
    if (counts > 2).any():
        faults.append(f"{int((counts > 2).sum()):,} edges of more than two faces")
    if faults:
        logger.warning("%s: the mesh has %s", path, " and ".join(faults))


def _unit_of(path: Path, mesh: Mesh, options: ObjectOptions) -> float:
    """Metres of a file's unit."""
    if options.size is not None or path.suffix.lower() in METRIC_SUFFIXES:
        return 1.0
    size = float(np.ptp(mesh.vertices, axis=0).max())
    if SMALLEST_M <= size <= LARGEST_M:
        return 1.0
    if SMALLEST_M <= 1e-3 * size <= LARGEST_M:
        logger.warning(
            "%s: is %.3g units large, taken as millimetres; `object.unit` or `object.size` say "
            "otherwise",
            path,
            size,
        )
        return 1e-3
    raise DataError(path, f"is {size:.3g} units large; give `object.size` or `object.unit`.")


def _placed(
    source: str,
    mesh: Mesh,
    colours: NDArray[np.float32] | None,
    options: ObjectOptions,
    unit_m: float,
) -> ObjectMesh:
    """The mesh in metres, its lowest point on the plane z = 0, its middle over the origin."""
    if options.size is not None and options.unit is not None:
        raise OptionError("and `object.unit` exclude each other.", field="object.size")
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    extent = float((high - low).max())
    if not extent > 0:
        raise DataError(source, "has no size.")
    scale = unit_m if options.size is None else options.size / extent
    origin = np.array([*(0.5 * (low + high))[:2], low[2]])
    placed = Mesh((mesh.vertices - origin) * scale, mesh.normals, mesh.triangles)
    logger.info(
        "%s: %s triangles, %.4g m; facets and normals differ by %.3g mm at most",
        source,
        f"{len(mesh.triangles):,}",
        extent * scale,
        1e3 * surface_sag(placed),
    )
    return ObjectMesh(source=source, mesh=placed, vertex_albedo=colours)


def _import_trimesh() -> Any:
    try:
        import trimesh
    except ImportError as error:
        raise OptionError(
            "trimesh is not installed, which reads meshes; install the extra: "
            "pip install '.[simulate]'."
        ) from error
    return trimesh
