"""Borders of regions on a grid, as closed curves that are fitted to intensity edges across them.

A labelled region ends at whole cells, and at a random place where no edge shows its border. A curve
can lie between cells. It is fitted to the intensity edges found on lines across it. Elsewhere it is
as straight as these edges allow: its penalty is the sum of its turning angles. That sum is the same
for all convex closed curves, so neither a corner nor a round border shrinks.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.linalg import spsolve
from scipy.spatial import cKDTree

from polmvs.fitting import geman_mcclure_weights, robust_deviation
from polmvs.geometry import dots, lengths, unit_or_zero

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Across = Callable[[Array, Array], tuple[Array, Array]]

MIN_POINTS = 8  # points of a curve: with fewer it has no direction
BEYOND = 12  # cells: farther than edges are searched
SUBDIVISIONS = 8  # of a curve's pieces, for distances to it
FRACTION_BITS = 8  # of coordinates in OpenCV's polygons
LEAST_TURN = 1e-4  # radians, of the reweighting: straight for all that is seen


@dataclass(frozen=True, kw_only=True)
class BorderTolerances:
    """Tolerances of the curves; lengths are in cells, which are about a pixel.

    Attributes
    ----------
    turn : turning angle of a curve at a point, radians, that costs as much as an edge one deviation
        away. Measured on the box of `step`, slope of its walls against the true ones: 1.4, 1.2, 0.9
        deg with twice this, this and its half; a round border becomes a polygon of longer sides.
    sigma : least deviation of the edges' positions. Those of an analytic box are 0.06 px off, and
        poses add to it. Measured likewise: 0.8, 1.2, 1.5 deg with twice, once, half.
    sigmas : deviations beyond which an edge counts as false. Measured likewise: 1.3 and 1.0 deg
        with twice and half.
    fit_decay : the penalty is quadratic below a turning angle, which shrinks by this factor in each
        round. Measured: with its square root those walls turn by less than 0.1 deg.
    at_rest : displacement below which the curve has converged: below the deviation.
    max_passes : searches for edges across the moved curve. Measured likewise: 1.2 and 1.1
        deg with 3 and 10.
    """

    turn: float = 0.05
    sigma: float = 0.1
    sigmas: float = 3.0
    fit_decay: float = 0.7
    at_rest: float = 0.05
    max_passes: int = 5


TOL = BorderTolerances()


def cells_beside(inside: Mask) -> Array:
    """Signed distance (H, W) in cells to the border of a set of cells, negative inside."""
    far = float(max(inside.shape))
    if not inside.any():
        return np.full(inside.shape, far)
    outwards = ndimage.distance_transform_edt(~inside)
    inwards = ndimage.distance_transform_edt(inside) if not inside.all() else far
    return np.where(inside, 0.5 - inwards, outwards - 0.5)


def smoothly_beside(inside: Mask) -> Array:
    """As :func:`cells_beside`, without the corners of single cells."""
    return np.asarray(ndimage.gaussian_filter(cells_beside(inside), 1.0, mode="nearest"))


def drawn_border(inside: Mask, across: Across) -> Array:
    """Signed distance (H, W) in cells to the border of a region, fitted to edges, negative inside.

    Parameters
    ----------
    inside : (H, W) bool, the region by labels of cells.
    across : takes points ``(P, 2)``, rows and columns, of a curve and its outward unit normals
        ``(P, 2)``; gives the distance ``(P,)`` of the edge outside of the curve, in cells, and its
        weight ``(P,)`` in [0, 1]; NaN where the border may not move. Points may lie beyond the
        grid.
    """
    if inside.all() or not inside.any():
        return smoothly_beside(inside)
    # Regions continue beyond the grid and close there: the grid's edge is not their border.
    inside = np.pad(np.pad(inside, BEYOND - 1, mode="edge"), 1)
    on_grid = (slice(BEYOND, -BEYOND),) * 2
    distance = smoothly_beside(inside)
    slope = _slope(distance)

    def across_padded(curve: Array, normals: Array) -> tuple[Array, Array]:
        return across(curve - BEYOND, normals)

    curves = [_drawn(curve, slope, across_padded) for curve in _outlines(inside, distance, slope)]
    return (_distance_to(curves, slope) if curves else distance)[on_grid]


def _outlines(inside: Mask, distance: Array, slope: Array) -> list[Array]:
    """Closed curves (P, 2) about the regions and their holes, points a cell apart."""
    found = cv2.findContours(inside.astype(np.uint8), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)[0]
    curves = []
    for contour in found:
        cells = contour[:, 0, ::-1]
        if len(cells) < MIN_POINTS:
            continue
        at = tuple(cells.T)
        foot = cells - distance[at][:, None] * unit_or_zero(slope[at])
        curves.append(_evenly(ndimage.gaussian_filter1d(foot, 1.0, axis=0, mode="wrap")))
    return curves


def _evenly(curve: Array) -> Array:
    """A closed curve with points about a cell apart."""
    closed = np.concatenate([curve, curve[:1]])
    pieces = lengths(np.diff(closed, axis=0))
    along = np.concatenate([[0.0], np.cumsum(pieces)])
    kept = np.concatenate([[True], pieces > 0])
    num = max(round(along[-1]), MIN_POINTS)
    places = np.linspace(0, along[-1], num, endpoint=False)
    columns = [np.interp(places, along[kept], column[kept]) for column in closed.T]
    return np.stack(columns, axis=1)


def _drawn(curve: Array, slope: Array, across: Across) -> Array:
    """A closed curve, moved along its normals until it has converged."""
    for _ in range(TOL.max_passes):
        normals = _normals(curve, slope)
        step, weight = across(curve, normals)
        if not (weight > 0).any():
            return curve
        moved = _straightened(curve, normals, step, weight)
        curve = _evenly(curve + moved[:, None] * normals)
        if np.abs(moved).max() < TOL.at_rest:
            break
    return curve


def _normals(curve: Array, slope: Array) -> Array:
    """Unit normals (P, 2) of a closed curve, up the slope (H, W, 2)."""
    along = np.roll(curve, -1, axis=0) - np.roll(curve, 1, axis=0)
    along = ndimage.gaussian_filter1d(along, 2.0, axis=0, mode="wrap")
    normals = unit_or_zero(np.stack([-along[:, 1], along[:, 0]], axis=1))
    columns = np.moveaxis(slope, -1, 0)
    up = [ndimage.map_coordinates(one, curve.T, order=1, mode="nearest") for one in columns]
    return np.asarray(normals * np.sign(dots(normals, np.stack(up, axis=1)).sum()))


def _straightened(curve: Array, normals: Array, step: Array, weight: Array) -> Array:
    """By how much (P,) the points of a closed curve move along their normals.

    The least sum of squared distances to the steps, under a robust loss, and of the amounts of the
    turns between its pieces, by reweighting.
    """
    num = len(curve)
    index = np.arange(num)
    around = [np.roll(index, side) for side in (-1, 0, 1)]
    turns = sparse.csr_array(
        (np.repeat([1.0, -2.0, 1.0], num), (np.tile(index, 3), np.concatenate(around)))
    )
    by_move = [turns @ sparse.diags_array(column) for column in normals.T]
    given = turns @ curve
    is_free = np.isfinite(weight)
    step, weight = np.where(weight > 0, step, 0.0), np.where(is_free, weight, 0.0)
    used = weight > 0
    moved, turned = np.zeros(num), 1.0
    while turned > LEAST_TURN:
        off = moved - step
        sigma = max(robust_deviation(off[used]), TOL.sigma)
        certain = weight / sigma**2 * geman_mcclure_weights(off, (TOL.sigmas * sigma) ** 2)
        certain = np.where(is_free, certain + 1e-6, TOL.sigma**-4)
        now = np.stack([one @ moved for one in by_move], axis=1) + given
        amount = np.sqrt((now**2).sum(axis=1) + turned**2)
        stiff = 1 / (TOL.turn * amount)
        normal, right = sparse.csc_array(sparse.diags_array(certain)), certain * step
        for one, column in zip(by_move, given.T, strict=True):
            normal = normal + one.T @ sparse.diags_array(stiff) @ one
            right = right - one.T @ (stiff * column)
        moved = spsolve(normal.tocsc(), right)
        turned *= TOL.fit_decay
    return np.asarray(moved)


def _distance_to(curves: Sequence[Array], slope: Array) -> Array:
    """Signed distance (H, W) to closed curves, positive up the slope (H, W, 2)."""
    shape = slope.shape[:2]
    places, outwards = [], []
    for curve in curves:
        ahead = np.roll(curve, -1, axis=0) - curve
        normals = unit_or_zero(np.stack([-ahead[:, 1], ahead[:, 0]], axis=1))
        at = np.clip(np.rint(curve), 0, np.array(shape) - 1).astype(np.int64)
        normals *= np.sign(dots(normals, slope[tuple(at.T)]).sum())
        # At a corner the mean of its sides tells in from out.
        corners = unit_or_zero(normals + np.roll(normals, 1, axis=0))
        for k in range(SUBDIVISIONS):
            places.append(curve + k / SUBDIVISIONS * ahead)
            outwards.append(normals if k else corners)
    nodes, normals = np.concatenate(places), np.concatenate(outwards)
    cells = np.moveaxis(np.indices(shape), 0, -1).reshape(-1, 2).astype(np.float64)
    far, nearest = cKDTree(nodes).query(cells)
    height = dots(cells - nodes[nearest], normals[nearest])
    beside = np.sqrt(np.maximum(far**2 - height**2, 0))
    near = np.where(beside <= 1 / SUBDIVISIONS, height, np.copysign(far, height))
    # At a kink the nearest normal may look to the wrong side: it tells only the nearest cells.
    outside = 1.0 - 2 * _filled(curves, shape).ravel()
    return np.asarray(np.where(far < 1, near, far * outside).reshape(shape))


def _filled(curves: Sequence[Array], shape: tuple[int, ...]) -> Mask:
    """Cells (H, W) within closed curves, without their holes. Those on a curve may be either."""
    image = np.zeros(shape, np.uint8)
    corners = [np.rint(curve[:, ::-1] * 2**FRACTION_BITS).astype(np.int32) for curve in curves]
    cv2.fillPoly(image, corners, 1, shift=FRACTION_BITS)
    return np.asarray(image == 1)


def _slope(image: Array) -> Array:
    """Gradient (H, W, 2), along rows and along columns."""
    down, right = np.gradient(image)
    return np.stack([down, right], axis=-1)
