"""The ground on which the objects stand: a plane with relief, from sparse points.

A table is a plane; a cloth, a lawn or a pile of paper is not. The relief is a field of heights over
the plane, from the heights of the sparse points: robust means in Gaussian windows, from wide to
narrow, down to the width at which half of the points predict the other half best (cross-validation,
Stone 1974). If no width predicts them better than the plane, the relief is 0.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from polmvs.camera import sample_image
from polmvs.fitting import OUTLIER_RATIO, geman_mcclure_weights, robust_deviation
from polmvs.geometry import lengths
from polmvs.scene import View

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

NUM_STEPS = 5  # along a ray: each leaves a share of the error, the ground's slope over the ray's


@dataclass(frozen=True, kw_only=True)
class GroundTolerances:
    """Tolerances of the ground.

    Those of the relief were measured on six uneven grounds, by the deviation of points that it is
    not fitted to (0.12 to 0.82 px; from the plane 2.3 to 5.2). Half and twice of most change it by
    at most 0.12 px, half of ``relief`` by up to 0.8, coarser windows or grids by up to 0.7.

    Attributes
    ----------
    distance : of inliers to the supporting plane, as a share of the cameras' distance. Measured,
        0.005: Chamfer of an analytic torus 0.31 -> 0.34 mm.
    min_share : of the sparse points of the surroundings that lie in a supporting plane. Measured
        with ``distance`` on an analytic vase: both factors of two within 0.01 points of F at 1 mm.
    below_share : number of points below a plane, over that in it, up to which the ground is flat.
        Guess, between 0.003 to 0.065 on 40 flat tables and 0.145 to 0.76 on nine cloths, lawns,
        rugs and plinths.
    factors : of ``distance``, for a ground with relief.
    relief : largest height of the relief, in the distances of the plane's inliers.
    num_cells : of the relief's grid, along its side.
    widest : deviation of the widest window, sides of the grid.
    narrowest : deviation of the narrowest window, cells: below it the grid distorts the window.
    narrowing : ratio of the deviations of one window and the next.
    num_rounds : of robust weights in each window.
    prior_points : number of points of height 0 that are added to a window.
    """

    distance: float = 0.004
    min_share: float = 0.25
    below_share: float = 0.1
    factors: tuple[int, ...] = (1, 2, 4)
    relief: float = 4.0
    num_cells: int = 128
    widest: float = 0.25
    narrowest: float = 1.0
    narrowing: float = 1.5
    num_rounds: int = 3
    prior_points: float = 4.0


TOL = GroundTolerances()


@dataclass(frozen=True)
class SupportingPlane:
    """Points x with ``normal . x = offset``; free space has ``normal . x > offset``.

    Attributes
    ----------
    normal : (3,) unit.
    offset : world units.
    tolerance : distance of its inliers.
    """

    normal: Array
    offset: float
    tolerance: float = 0.0

    def height(self, points: Floats) -> Array:
        """Signed distance ``(N,)`` of points ``(N, 3)``."""
        return np.asarray(points @ self.normal - self.offset)

    @property
    def axes(self) -> Array:
        """Unit vectors along it, rows (2, 3)."""
        along = np.cross(self.normal, np.eye(3)[np.argmin(np.abs(self.normal))])
        along /= lengths(along)
        return np.stack([along, np.cross(self.normal, along)])


def supporting_plane(
    surroundings: Floats,
    centers: Array,
    *,
    num_trials: int = 400,
    seed: int = 0,
) -> SupportingPlane | None:
    """The plane on which the objects stand, if the points around them show one.

    Parameters
    ----------
    surroundings : (N, 3), sparse points beside the objects.
    centers : (C, 3), of the cameras; they lie on the free side.
    num_trials : random triples of points.
    seed : of the random numbers.

    Returns
    -------
    None if fewer than ``min_share`` of the points lie in one plane, or cameras are on both sides.
    """
    num = len(surroundings)
    if num < 20:
        return None
    middle = np.median(surroundings, axis=0)
    limit = TOL.distance * float(np.median(lengths(centers - middle)))
    # The tops of blocks may have more points in one plane than uneven ground below them.
    trials = ((1, None, TOL.below_share), *((factor, centers, np.inf) for factor in TOL.factors))
    for factor, above, below_share in trials:
        found = largest_plane(
            surroundings, factor * limit, above=above, num_trials=num_trials, seed=seed
        )
        if found is None:
            continue
        normal, offset, inliers = found
        if np.median(centers @ normal) < offset:
            normal, offset = -normal, -offset
        num_below = np.count_nonzero(surroundings @ normal < offset - factor * limit)
        enough = TOL.min_share * num <= inliers.sum() and num_below <= below_share * inliers.sum()
        if enough and (centers @ normal > offset).all():
            return SupportingPlane(normal, offset, factor * limit)
    return None


def largest_plane(
    points: Floats,
    limit: float,
    *,
    above: Floats | None = None,
    num_trials: int = 400,
    seed: int = 0,
) -> tuple[Array, float, Mask] | None:
    """The plane ``normal . x = offset`` with the most points: RANSAC, then least squares.

    Parameters
    ----------
    points : (N, 3)
    limit : distance of inliers.
    above : (C, 3), places above the plane, most of them; points below it then count against it.
    num_trials : random triples of points.
    seed : of the random numbers.

    Returns
    -------
    Unit normal (3,), offset and inliers (N,); None if there is no plane.
    """
    num = len(points)
    if num < 3:
        return None
    rng = np.random.default_rng(seed)
    picks = rng.integers(0, num, (num_trials, 3))
    a, b, c = (points[picks[:, i]] for i in range(3))
    normals = np.cross(b - a, c - a)
    length = lengths(normals)
    usable = length > 1e-12
    if not usable.any():
        return None
    normals, a = normals[usable] / length[usable, None], a[usable]
    offsets = (a * normals).sum(axis=1)
    tested = points[rng.permutation(num)[:2000]]
    heights = tested @ normals.T - offsets
    scores = (np.abs(heights) < limit).sum(axis=0)
    if above is not None:
        side = np.sign(np.median(above @ normals.T - offsets, axis=0))
        scores = scores - (heights * side < -limit).sum(axis=0)
    best = int(scores.argmax())
    normal, offset = normals[best], float(offsets[best])
    for _ in range(3):
        inside = np.abs(points @ normal - offset) < limit
        if inside.sum() < 3:
            return None
        center = points[inside].mean(axis=0)
        normal = np.linalg.svd(points[inside] - center, full_matrices=False)[2][2]
        offset = float(center @ normal)
    return normal, offset, inside


@dataclass(frozen=True)
class Ground:
    """A plane with relief.

    Attributes
    ----------
    plane : on which the objects stand.
    low : (2,), place of the grid's first cell along the plane's axes.
    step : of the grid, world units.
    relief : (n, n) float32, heights over the plane; rows along the second axis.
    """

    plane: SupportingPlane
    low: Array
    step: float
    relief: NDArray[np.float32]

    @property
    def is_flat(self) -> bool:
        """Whether the ground is the plane."""
        return not self.relief.any()

    def height(self, points: Floats) -> Array:
        """Heights ``(...)`` of the ground over the plane at points ``(..., 3)``."""
        cells = (points @ self.plane.axes.T - self.low) / self.step
        inside = np.clip(np.nan_to_num(cells), 0, np.array(self.relief.shape[::-1]) - 1.0)
        return np.asarray(sample_image(self.relief, inside + 0.5), np.float64)

    def seen_at(self, view: View, xy: Floats) -> Array:
        """Where the rays of a view's image coordinates ``(..., 2)`` meet it; NaN where they do not.

        Along a ray, the height of the ground below the last place is that of the next one. This
        converges where the ground is less steep than the ray.
        """
        rays, center = view.rays_in_world(xy), view.center_in_world
        down = rays @ self.plane.normal
        height, places = np.zeros(rays.shape[:-1]), rays
        for _ in range(NUM_STEPS):
            with np.errstate(divide="ignore", invalid="ignore"):
                ranges = (height - self.plane.height(center)) / down
            places = center + np.where(ranges > 0, ranges, np.nan)[..., None] * rays
            if self.is_flat:
                break
            height = self.height(places)
        return np.asarray(places)


def find_ground(points: Floats, plane: SupportingPlane) -> Ground:
    """The relief of the ground.

    Parameters
    ----------
    points : (N, 3), sparse points of the scene.
    plane : on which the objects stand; points far from it are not of the ground.
    """
    num = TOL.num_cells
    heights = plane.height(points)
    near = np.abs(heights) < TOL.relief * plane.tolerance
    if not near.any():
        return Ground(plane, np.zeros(2), 1.0, np.zeros((1, 1), np.float32))
    places, heights = points[near] @ plane.axes.T, heights[near]
    # The farthest points are few, and most of the outliers.
    low, high = np.percentile(places, (1, 99), axis=0)
    step = max(float((high - low).max()) / (num - 1), 1e-12)
    cells = np.rint((places - low) / step).astype(np.int64)
    inside = ((cells >= 0) & (cells < num)).all(axis=1)
    given = _Heights(cells[inside], heights[inside])
    relief = _likeliest_relief(given, TOL.relief * plane.tolerance)
    logger.info(
        "relief of the ground: %.4f, of the points above it %.4f (robust deviations).",
        robust_deviation(given.over(np.zeros_like(relief))),
        robust_deviation(given.over(relief)),
    )
    return Ground(plane, low, step, relief.astype(np.float32))


@dataclass(frozen=True)
class _Heights:
    """Heights (N,) of points over the plane, in cells (N, 2) of the relief's grid."""

    cells: NDArray[np.int64]
    heights: Array

    def of(self, chosen: Mask) -> _Heights:
        return _Heights(self.cells[chosen], self.heights[chosen])

    def over(self, relief: Array) -> Array:
        """Heights (N,) over a relief."""
        return self.heights - relief[self.cells[:, 1], self.cells[:, 0]]

    def summed(self, values: Array, sigma: float) -> Array:
        """Sums (n, n) of values (N,) in a window about each cell, 1 in its middle."""
        num = TOL.num_cells
        total = np.zeros((num, num))
        np.add.at(total, (self.cells[:, 1], self.cells[:, 0]), values)
        window = ndimage.gaussian_filter(total, sigma, mode="constant")
        return np.asarray(2 * np.pi * sigma**2 * window)

    def fitted(self, relief: Array, sigma: float, width: float) -> Array:
        """A relief with the mean in a window of what it leaves; ``width`` is that of the loss."""
        relief = relief.copy()
        for _ in range(TOL.num_rounds):
            left = self.over(relief)
            weights = geman_mcclure_weights(left, width**2)
            total = self.summed(weights, sigma) + TOL.prior_points
            relief += self.summed(weights * left, sigma) / total
        return relief


def _likeliest_relief(given: _Heights, largest: float) -> Array:
    """The relief (n, n) that predicts points best which it is not fitted to."""
    num, width = len(given.heights), largest
    is_first = np.random.default_rng(0).permutation(num) < num // 2
    halves = given.of(is_first), given.of(~is_first)
    relief = best = np.zeros((TOL.num_cells, TOL.num_cells))
    of_halves = best_of_halves = [relief, relief]
    sigma = TOL.widest * TOL.num_cells
    while sigma >= TOL.narrowest:
        of_halves = [
            half.fitted(before, sigma, width)
            for half, before in zip(halves, of_halves, strict=True)
        ]
        relief = given.fitted(relief, sigma, width)
        gains = _weights_of_others(halves, of_halves, width)
        gains -= _weights_of_others(halves, best_of_halves, width)
        if gains.mean() > 2 * gains.std() / np.sqrt(max(num, 1)):
            best, best_of_halves = relief, of_halves
        width = min(width, OUTLIER_RATIO * robust_deviation(given.over(relief)))
        sigma /= TOL.narrowing
    return best


def _weights_of_others(halves: Sequence[_Heights], reliefs: Sequence[Array], width: float) -> Array:
    """Robust weights (N,) of each half of the points over the relief of the other half."""
    left = [half.over(relief) for half, relief in zip(halves, reliefs[::-1], strict=True)]
    return geman_mcclure_weights(np.concatenate(left), width**2)
