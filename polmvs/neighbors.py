"""Voxels of large clouds, thinning to them, spacings, and nearest neighbours."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.arrays import Array

_AXIS_BITS = 21
NUM_NEIGHBORS = 8  # neighbours from which the density about a point is estimated; a guess
LONE_SPACINGS = 4.0  # of the usual spacing: a point with a larger one is an outlier; a guess
_SHIFT = 0.37  # surfaces often have round coordinates: shifted voxels do not split them in two


def voxel_of_each(points: Array, side: float) -> NDArray[np.intp]:
    """Index ``(N,)`` of the occupied voxel that each point lies in, counted from 0 without gaps.

    Parameters
    ----------
    points : (N, 3), finite
    side : of a voxel, in the unit of the points.
    """
    keys = _cell_keys(np.floor(points / side + _SHIFT))
    return np.asarray(np.unique(keys, return_inverse=True)[1].reshape(-1), np.intp)


def voxel_representatives(points: Array, side: float) -> NDArray[np.intp]:
    """Indices of the point nearest to the centre of each occupied voxel, in ascending order.

    Parameters
    ----------
    points : (N, 3), finite
    side : side of a voxel, in the unit of the points.
    """
    if len(points) == 0:
        return np.zeros(0, np.intp)
    scaled = points / side + _SHIFT
    cells = np.floor(scaled)
    keys, distance = _cell_keys(cells), ((scaled - cells - 0.5) ** 2).sum(axis=1)
    order = np.argsort(keys)
    starts = np.flatnonzero(np.diff(keys[order], prepend=keys[order[0]] - 1))
    counts = np.diff(starts, append=len(points))
    least = np.repeat(np.minimum.reduceat(distance[order], starts), counts)
    # Of points equally near, the first one counts.
    candidates = np.where(distance[order] == least, order, len(points))
    return np.sort(np.minimum.reduceat(candidates, starts))


def point_spacings(points: Array) -> Array:
    """Spacing ``(N,)`` of points ``(N, 3)`` of a surface, from their local density.

    It is the side of the square that each point has to itself. The distance to the nearest
    neighbour would be too small where noise brings two points together.
    """
    k = min(NUM_NEIGHBORS, len(points) - 1)
    radius = cKDTree(points).query(points, k=[k + 1], workers=-1)[0][:, 0]
    # The disc up to the k-th neighbour holds half of it, k - 1 others and the point itself.
    return np.asarray(radius * np.sqrt(np.pi / (k + 0.5)), np.float64)


def are_usual(spacings: Array) -> NDArray[np.bool_]:
    """Whether points ``(N,)`` are near their neighbours, compared with the usual spacing."""
    return np.asarray(spacings <= LONE_SPACINGS * np.median(spacings), np.bool_)


def in_cells_beside(points: Array, others: Array, side: float) -> NDArray[np.bool_]:
    """Whether the cell of a point, or one of its 26 neighbours, holds one of the others.

    True within ``side`` of one of the others and False beyond ``2 sqrt(3) side``, for ``(N, 3)``
    points and ``(M, 3)`` others.
    """
    occupied = others[voxel_representatives(others, side)]
    steps = np.stack(np.meshgrid(*3 * [np.arange(-1.0, 2.0)]), axis=-1).reshape(-1, 1, 3)
    cells = np.floor(occupied / side + _SHIFT) + steps
    grown = np.unique(_cell_keys(cells.reshape(-1, 3)))
    keys = _cell_keys(np.floor(points / side + _SHIFT))
    found = np.searchsorted(grown, keys)
    return np.asarray(np.append(grown, -1)[found] == keys, np.bool_)


def nearest_points(points: Array, queries: Array, *, far: float) -> tuple[Array, NDArray[np.intp]]:
    """Nearest point of each query; exact within ``far``, beyond it among a thinned sampling.

    An exact search from far away visits a large part of the surface, since all of it is about
    equally near. A few far outliers would take most of the time.

    Parameters
    ----------
    points : (N, 3)
    queries : (M, 3)
    far : distance beyond which the search is coarse, among points about ``far / 5`` apart. There
        the distance is too long by at most ``0.35 far``, and by ``0.02 far`` for a point above a
        surface.

    Returns
    -------
    distances : (M,) float64; inf where there are no points.
    indices : (M,) of the nearest points; 0 where there are no points.
    """
    if len(points) == 0 or len(queries) == 0:
        return np.full(len(queries), np.inf), np.zeros(len(queries), np.intp)
    distances, indices = _query(points, queries, far)
    distant = np.flatnonzero(~np.isfinite(distances))
    if len(distant) > 0:
        kept = voxel_representatives(points, far / 5.0)
        distances[distant], among_kept = _query(points[kept], queries[distant], np.inf)
        indices[distant] = kept[among_kept]
    return distances, indices


def _query(points: Array, queries: Array, bound: float) -> tuple[Array, NDArray[np.intp]]:
    # Consecutive neighbours visit the same leaves, which are in the cache: 3 times faster.
    cell = max(float(np.median(np.ptp(points, axis=0))), 1e-12) / 100.0
    order = np.argsort(_cell_keys(np.floor(queries * (1.0 / cell))))
    # The sliding midpoint tree is built several times faster than the balanced one.
    tree = cKDTree(points, leafsize=32, balanced_tree=False)
    distances, indices = np.empty(len(queries)), np.empty(len(queries), np.intp)
    distances[order], indices[order] = tree.query(
        queries[order], distance_upper_bound=bound, workers=-1
    )
    return distances, indices


def _cell_keys(cells: Array) -> NDArray[np.int64]:
    """One integer per integral cell ``(N, 3)``; cells more than 2**21 apart may share one."""
    x, y, z = (cells.astype(np.int64) & ((1 << _AXIS_BITS) - 1)).T
    return np.asarray((x << (2 * _AXIS_BITS)) | (y << _AXIS_BITS) | z, np.int64)
