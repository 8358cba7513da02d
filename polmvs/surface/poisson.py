"""A mesh of the polarized surface: Poisson reconstruction, trimmed to the support of the points.

Poisson reconstruction closes every surface: it extrapolates beyond the last point and across holes.
Parts without support are cut off, so the mesh ends where the cloud ends and holes of the cloud stay
holes. Holes that are not wider than the scatter of the points are closed.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.errors import DataError
from polmvs.geometry import dots, unit_or_zero
from polmvs.io.clouds import Cloud, Mesh, solve_poisson
from polmvs.neighbors import are_usual, point_spacings
from polmvs.scene import PointKind
from polmvs.surface.dense_view import NUM_NEAREST
from polmvs.surface.mesh_geometry import TriangleMesh

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

logger = logging.getLogger(__name__)

MIN_POINTS = 100
KIND = "kind"


@dataclass(frozen=True, kw_only=True)
class MeshTolerances:
    """Tolerances of the support of a mesh; lengths in spacings of the points.

    Attributes
    ----------
    support : vertices farther than this from any point are removed. Derived: points scattered at
        random leave a void of this radius with probability exp(-pi 2.5^2) = 3e-9.
    min_island : side of a square; separate pieces of a smaller area are removed. Guess.
    min_depth : of the octree, that Open3D accepts.
    max_depth : of the octree, for any spacing of the points: 1024 cells a side, about 2 GB for a
        surface that fills them.
    cube_scale : of Poisson's cube over the cloud's extent; Open3D's default.
    """

    support: float = 2.5
    min_island: float = 20.0
    min_depth: int = 2
    max_depth: int = 10
    cube_scale: float = 1.1


TOL = MeshTolerances()


def poisson_mesh(
    cloud: Cloud,
    *,
    kinds: Collection[int] = (PointKind.SURFACE,),
    source: str | PathLike[str] = "cloud",
) -> Mesh:
    """Poisson mesh of a cloud's oriented points, where the points support it.

    The octree's cells are at least as wide as the spacing of the points. The mesh reaches half a
    spacing beyond the outermost points; holes of the cloud narrower than twice the support are
    closed. Its normals are those of the nearest points: measured normals are better than those of
    the triangles.

    Parameters
    ----------
    cloud : with normals that point away from the surface; if it has a scalar ``kind``, only
        points of the given kinds are used. Points and normals that are not finite are ignored.
    kinds : of points to use, see :class:`polmvs.scene.PointKind`.
    source : origin of the cloud, for messages.

    Returns
    -------
    Mesh, in the cloud's frame, with colours if the cloud has them. It may be empty. The same cloud
    gives the same mesh.

    Raises
    ------
    DataError
        The cloud has no normals or too few usable points, or most of them coincide.
    """
    points, normals, colors = _usable(cloud, kinds, source)
    spacings = point_spacings(points)
    usual = are_usual(spacings)
    points, normals = points[usual], normals[usual]
    colors = None if colors is None else colors[usual]
    spacing = float(np.median(spacings[usual]))
    if not spacing > 0:
        raise DataError(source, "has most of its points in the same places; merge them first.")
    depth = octree_depth(points, spacing)
    vertices, triangles = solve_poisson(points, normals, depth=depth, scale=TOL.cube_scale)
    logger.debug("Poisson: depth %d, spacing %.3g, %d vertices", depth, spacing, len(vertices))
    surface = TriangleMesh(vertices, triangles.astype(np.int64))
    tree = cKDTree(points)
    distance, nearest = tree.query(vertices, k=NUM_NEAREST, workers=-1)
    near_normals = unit_or_zero(normals[nearest].sum(axis=1))
    # A vertex that faces away from the nearest points belongs to the other side of a sheet.
    supported = dots(surface.vertex_normals, near_normals) > 0
    supported &= distance[:, 0] <= TOL.support * spacing
    # A point represents its cell, which ends half-way to the next one.
    supported = _without_rim(surface, supported, (TOL.support - 0.5) * spacing)
    islands = TriangleMesh(vertices, surface.faces[supported[surface.faces].all(axis=1)])
    areas = np.bincount(islands.face_components, islands.face_areas)
    kept = areas[islands.face_components] >= (TOL.min_island * spacing) ** 2
    used, final = np.unique(islands.faces[kept], return_inverse=True)
    return Mesh(
        vertices=vertices[used],
        normals=near_normals[used],
        colors=None if colors is None else colors[nearest[used, 0]],
        triangles=final.reshape(-1, 3).astype(np.int32),
    )


def _usable(
    cloud: Cloud, kinds: Collection[int], source: str | PathLike[str]
) -> tuple[Array, Array, NDArray[np.uint8] | None]:
    """Points of the kinds, their unit normals and colours."""
    if cloud.normals is None:
        raise DataError(source, "has no normals; Poisson reconstruction needs them.")
    length = np.linalg.norm(cloud.normals, axis=-1)
    used = np.isfinite(cloud.points).all(axis=-1) & np.isfinite(length) & (length > 0)
    if KIND in cloud.scalars:
        used &= np.isin(cloud.scalars[KIND], list(kinds))
    if used.sum() < MIN_POINTS:
        raise DataError(
            source,
            f"has {int(used.sum())} points of the surface with normals; a mesh needs "
            f"{MIN_POINTS} or more. Give a dense cloud.",
        )
    normals = cloud.normals[used] / length[used, None]
    return cloud.points[used], normals, None if cloud.colors is None else cloud.colors[used]


def octree_depth(points: Array, spacing: float) -> int:
    """The greatest depth at which Poisson's cells are no narrower than the spacing."""
    side = TOL.cube_scale * float(np.ptp(points, axis=0).max())
    depth = np.floor(np.log2(side / spacing))
    return int(np.clip(depth, TOL.min_depth, TOL.max_depth))


def _without_rim(surface: TriangleMesh, supported: Mask, width: float) -> Mask:
    """Trim what extends beyond the points by more than ``width`` from the mesh's edges.

    Together with the support this closes narrow holes and leaves the outline, and that of wide
    holes, where the points end (a morphological closing).
    """
    num_supported = supported[surface.faces].sum(axis=1)
    cut = np.unique(surface.faces[(num_supported > 0) & (num_supported < 3)])
    beyond = cut[~supported[cut]]
    if not len(beyond) or not supported.any():
        return supported
    tree = cKDTree(surface.vertices[beyond])
    gap = tree.query(surface.vertices, distance_upper_bound=width, workers=-1)[0]
    return np.asarray(supported & ~np.isfinite(gap))
