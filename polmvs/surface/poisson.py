"""A mesh of the polarised surface: Poisson reconstruction, cut back to where points support it.

Poisson reconstruction closes every surface: beyond the last point and across holes it makes one
up. What no point supports is cut off again, so that the mesh ends where the cloud ends and holes
of the cloud stay holes, while those that are no wider than the scatter of its points are closed.
"""

from __future__ import annotations

import logging
from collections.abc import Collection
from dataclasses import dataclass
from os import PathLike

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from polmvs.errors import DataError
from polmvs.io.clouds import Cloud, Mesh, solve_poisson
from polmvs.scene import PointKind

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Triangles = NDArray[np.int32]

logger = logging.getLogger(__name__)

MIN_POINTS = 100
# Points scattered at random leave a void of this radius with probability exp(-pi 2.5^2) = 3e-9.
SUPPORT_SPACINGS = 2.5
MIN_ISLAND_SPACINGS = 20.0  # side of the square whose area an island must have
MAX_DEPTH = 10  # of the octree: 1024 cells a side, about 2 GB for a surface that fills them
KIND = "kind"


@dataclass(frozen=True, kw_only=True)
class MeshTolerances:
    """Where the points of a cloud support a mesh; lengths in spacings of the points.

    Attributes
    ----------
    num_neighbors : by which the density about a point is told. Guess.
    num_smoothed : points whose normals a vertex takes. Guess.
    lone_spacings : a point whose neighbours are this much farther than usual is an outlier.
        Guess.
    border_spacings : a point stands for its cell, which ends half-way to the next one.
        Derived.
    min_facing_cosine : between a vertex's normal and its nearest point's. Derived: the other
        side of the sheet.
    min_depth : of the octree, that Open3D takes.
    cube_scale : of Poisson's cube over the cloud's extent; Open3D's own.
    """

    num_neighbors: int = 8
    num_smoothed: int = 4
    lone_spacings: float = 4.0
    border_spacings: float = 0.5
    min_facing_cosine: float = 0.0
    min_depth: int = 2
    cube_scale: float = 1.1


def poisson_mesh(
    cloud: Cloud,
    *,
    kinds: Collection[int] = (PointKind.SURFACE,),
    max_depth: int = MAX_DEPTH,
    support_spacings: float = SUPPORT_SPACINGS,
    min_island_spacings: float = MIN_ISLAND_SPACINGS,
    source: str | PathLike[str] = "cloud",
    tolerances: MeshTolerances = MeshTolerances(),
) -> Mesh:
    """Poisson mesh of a cloud's oriented points, where the points support it.

    The octree's cells are at least as wide as the points are apart. The mesh reaches half a
    spacing beyond the outermost points; holes of the cloud narrower than twice the support are
    closed. Its normals are those of the nearest points: they were measured, and are better than
    what the triangles' slopes make of the points' places.

    Parameters
    ----------
    cloud : with normals that point away from the surface; if it has a scalar ``kind``, only
        points of the given kinds count. Points and normals that are not finite do not.
    kinds : of points to use, see :class:`polmvs.surface.surroundings.PointKind`.
    max_depth : of the octree, whatever the points' spacing; bounds memory.
    support_spacings : vertices farther than this from any point go, in spacings of the points.
    min_island_spacings : side of a square, in spacings; separate pieces of a smaller area go.
    source : where the cloud came from, for messages.
    tolerances : of this step.

    Returns
    -------
    Mesh, in the cloud's frame, with colours where the cloud has them. It may be empty. The same
    cloud gives the same mesh.

    Raises
    ------
    DataError
        If the cloud has no normals, fewer than 100 usable points, or most of them coincide.
    """
    points, normals, colors = _usable(cloud, kinds, source)
    spacings = point_spacings(points, tolerances=tolerances)
    usual = spacings <= tolerances.lone_spacings * np.median(spacings)
    points, normals = points[usual], normals[usual]
    colors = None if colors is None else colors[usual]
    spacing = float(np.median(spacings[usual]))
    if not spacing > 0:
        raise DataError(source, "has most of its points in the same places; merge them first.")
    depth = octree_depth(points, spacing, max_depth, tolerances=tolerances)
    vertices, triangles = solve_poisson(points, normals, depth=depth, scale=tolerances.cube_scale)
    logger.debug("Poisson: depth %d, spacing %.3g, %d vertices", depth, spacing, len(vertices))
    tree = cKDTree(points)
    distance, nearest = tree.query(vertices, k=tolerances.num_smoothed, workers=-1)
    near_normals = _mean_normals(normals[nearest])
    facing = (vertex_normals(vertices, triangles) * near_normals).sum(axis=-1)
    supported = (distance[:, 0] <= support_spacings * spacing) & (
        facing > tolerances.min_facing_cosine
    )
    supported = _without_rim(
        vertices, triangles, supported, (support_spacings - tolerances.border_spacings) * spacing
    )
    kept = np.flatnonzero(supported[triangles].all(axis=1))
    kept = kept[_large_islands(vertices, triangles[kept], (min_island_spacings * spacing) ** 2)]
    used = np.unique(triangles[kept])
    index = np.full(len(vertices), -1, np.int32)
    index[used] = np.arange(len(used))
    final = index[triangles[kept]]
    return Mesh(
        vertices=vertices[used],
        normals=near_normals[used],
        colors=None if colors is None else colors[nearest[used, 0]],
        triangles=final,
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


def point_spacings(points: Array, *, tolerances: MeshTolerances = MeshTolerances()) -> Array:
    """Distance between points ``(N, 3)`` of a surface as their density about each tells.

    The side of the square that each point would have to itself; the nearest neighbour alone
    would be that of a pair that noise has brought together.
    """
    k = min(tolerances.num_neighbors, len(points) - 1)
    radius = cKDTree(points).query(points, k=k + 1, workers=-1)[0][:, -1]
    # The disc to the k-th neighbour holds it by half, k - 1 others and the point itself.
    return np.asarray(radius * np.sqrt(np.pi / (k + 0.5)), np.float64)


def octree_depth(
    points: Array,
    spacing: float,
    max_depth: int = MAX_DEPTH,
    *,
    tolerances: MeshTolerances = MeshTolerances(),
) -> int:
    """The greatest depth at which Poisson's cells are no narrower than the spacing."""
    side = tolerances.cube_scale * float(np.ptp(points, axis=0).max())
    if not (side > 0 and spacing > 0):
        return tolerances.min_depth
    return int(np.clip(np.floor(np.log2(side / spacing)), tolerances.min_depth, max_depth))


def triangle_areas(vertices: Array, triangles: Triangles) -> Array:
    """Areas ``(F,)``."""
    return np.asarray(0.5 * np.linalg.norm(_crosses(vertices, triangles), axis=-1))


def vertex_normals(vertices: Array, triangles: Triangles) -> Array:
    """Unit normals ``(V, 3)``, means of the triangles' weighted by area; 0 without any."""
    crosses = _crosses(vertices, triangles)
    total = np.stack(
        [
            np.bincount(triangles.ravel(), np.repeat(crosses[:, i], 3), len(vertices))
            for i in range(3)
        ],
        axis=-1,
    )
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    return np.asarray(total / np.where(length > 0, length, 1))


def boundary_edges(triangles: Triangles) -> NDArray[np.int32]:
    """Edges ``(E, 2)`` that belong to one triangle only, lower vertex first."""
    edges = np.sort(triangles[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, count = np.unique(edges, axis=0, return_counts=True)
    return np.asarray(unique[count == 1], np.int32)


def _crosses(vertices: Array, triangles: Triangles) -> Array:
    """Normals of the triangles, twice their areas long."""
    a, b, c = (vertices[triangles[:, i]] for i in range(3))
    return np.asarray(np.cross(b - a, c - a))


def _mean_normals(normals: Array) -> Array:
    """Unit mean ``(V, 3)`` of normals ``(V, K, 3)``; 0 where they cancel."""
    total = normals.sum(axis=1)
    length = np.linalg.norm(total, axis=-1, keepdims=True)
    return np.asarray(total / np.where(length > 0, length, 1))


def _without_rim(vertices: Array, triangles: Triangles, supported: Mask, width: float) -> Mask:
    """Take back by ``width`` from its edges what reached beyond the points by more than that.

    Together with the support this closes narrow holes and leaves the outline, and that of wide
    holes, where the points end (a morphological closing).
    """
    num_supported = supported[triangles].sum(axis=1)
    cut = np.unique(triangles[(num_supported > 0) & (num_supported < 3)])
    beyond = cut[~supported[cut]]
    if not len(beyond) or not supported.any():
        return supported
    gap = cKDTree(vertices[beyond]).query(vertices, distance_upper_bound=width, workers=-1)[0]
    return np.asarray(supported & ~np.isfinite(gap))


def _large_islands(vertices: Array, triangles: Triangles, min_area: float) -> Mask:
    """Which triangles ``(F,)`` belong to a connected piece of at least this area."""
    if not len(triangles):
        return np.zeros(0, bool)
    tail, head = triangles[:, [0, 1]].ravel(), triangles[:, [1, 2]].ravel()
    ones = np.ones(len(tail), np.int8)
    graph = sparse.coo_matrix((ones, (tail, head)), shape=2 * (len(vertices),))
    label = connected_components(graph, directed=False)[1][triangles[:, 0]]
    area = np.bincount(label, triangle_areas(vertices, triangles))
    return np.asarray(area[label] >= min_area)
