"""Triangulation of a few points that the same views show, such as a marker's corners."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from polmvs.scene import View

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_PAIRS = 200
OUTLIER_RATIO = 5.0  # a view this many times the median residual off shows something else
OUTLIER_FLOOR_PX = 1.0  # ... but never for less: the error of a good pose
MAX_RESIDUAL_PX = 4.0  # ... and surely for more; COLMAP too drops observations beyond this
HUBER_PX = 0.5  # beyond the noise of a refined corner (0.1 px) and of a usual pose (0.3 px)
MIN_SIGMA_PX = 0.05  # few residuals can be small by chance
ROUNDS = 8
DIFFERENCE = 1e-6  # step of numerical derivatives, as a share of the depth


@dataclass(frozen=True)
class Triangulation:
    """Points seen together by several views.

    Attributes
    ----------
    points : (K, 3) float64, world.
    covariances : (K, 3, 3) float64, of the points, world units squared; errors of the poses count
        as far as they show in the residuals.
    used : (V,) bool, views that agree.
    rms_px : RMS distance between the points' projections and where the used views show them.
    """

    points: Array
    covariances: Array
    used: Mask
    rms_px: float


def intersect_rays(centers: Array, rays: Array) -> Array:
    """Points nearest to rays in the least-squares sense.

    Parameters
    ----------
    centers : (..., V, 3), where the rays begin.
    rays : (..., V, 3), unit.

    Returns
    -------
    (..., 3) float64
        NaN where the rays are parallel.
    """
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    matrix = across.sum(axis=-3)
    target = np.einsum("...vij,...vj->...i", across, centers)
    parallel = np.linalg.eigvalsh(matrix)[..., 0] < 1e-12
    matrix = np.where(parallel[..., None, None], np.eye(3), matrix)
    points = np.linalg.solve(matrix, target[..., None])[..., 0]
    return np.where(parallel[..., None], np.nan, points)


def triangulate_together(views: Sequence[View], xy: Array) -> Triangulation | None:
    """Triangulate points from the majority of views that agree on all of them.

    The start is the pair of views whose intersection the majority confirms best; least squares
    on pixels follows, with a robust loss.

    Parameters
    ----------
    views : V views.
    xy : (V, K, 2), image coordinates of K points in each.

    Returns
    -------
    Triangulation or None
        None where fewer than two views, or no majority of them, agree.
    """
    num = len(views)
    if xy.ndim != 3 or len(xy) != num or xy.shape[2] != 2:
        raise ValueError(f"{xy.shape=} but expected ({num}, K, 2).")
    start = _best_pair(views, xy) if num >= 2 else None
    if start is None:
        return None
    points, used = start, _agreeing(_errors(views, start, xy))
    for _ in range(ROUNDS):
        if used.sum() < 2 or 2 * used.sum() <= num:
            return None
        points = _refine(views, points, xy, used)
        again = _agreeing(_errors(views, points, xy))
        if np.array_equal(again, used):
            break
        used = again
    if used.sum() < 2 or 2 * used.sum() <= num:
        return None
    return _with_uncertainty(views, points, xy, used)


def _best_pair(views: Sequence[View], xy: Array) -> Array | None:
    """Points ``(K, 3)`` from the two views that the majority agrees with best."""
    centers = np.array([view.center_in_world for view in views])
    rays = np.array(
        [v.camera.rays(p) @ v.cam_from_world.rotation for v, p in zip(views, xy, strict=True)]
    )
    pairs = np.array(list(combinations(range(len(views)), 2)))
    if len(pairs) > MAX_PAIRS:
        pairs = np.random.default_rng(0).choice(pairs, MAX_PAIRS, replace=False)
    pair_rays = rays[pairs].swapaxes(1, 2)  # (P, K, 2, 3)
    pair_centers = np.broadcast_to(centers[pairs][:, None], pair_rays.shape)
    points = intersect_rays(pair_centers, pair_rays)  # (P, K, 3)
    errors = np.array([_errors(views, candidate, xy) for candidate in points])
    majority = max(len(views) // 2 + 1, 2)
    scores = np.partition(errors, majority - 1, axis=1)[:, majority - 1]
    best = int(scores.argmin())
    return points[best] if np.isfinite(scores[best]) else None


def _errors(views: Sequence[View], points: Array, xy: Array) -> Array:
    """RMS distance ``(V,)`` of the points' projections, px; infinite where one is not visible."""
    offsets = (
        np.array([v.camera.project(v.cam_from_world * points) for v in views], np.float64) - xy
    )
    rms = np.sqrt(np.square(offsets).sum(axis=-1).mean(axis=-1))
    return np.where(np.isfinite(rms), rms, np.inf)


def _agreeing(errors: Array) -> Mask:
    """Views whose error is like that of most."""
    limit = np.clip(OUTLIER_RATIO * np.median(errors), OUTLIER_FLOOR_PX, MAX_RESIDUAL_PX)
    return np.asarray(errors <= limit, np.bool_)


def _refine(views: Sequence[View], points: Array, xy: Array, used: Mask) -> Array:
    """A few rounds of Gauss-Newton on the pixels of the used views."""
    for _ in range(ROUNDS):
        information, gradient, _ = _normal_equations(views, points, xy, used)
        points = points - np.linalg.solve(information, gradient[..., None])[..., 0]
    return points


def _normal_equations(
    views: Sequence[View], points: Array, xy: Array, used: Mask
) -> tuple[Array, Array, Array]:
    """Information ``(K, 3, 3)``, gradient ``(K, 3)`` and squared errors ``(V, K)``, weighted."""
    information = np.zeros((len(points), 3, 3))
    gradient = np.zeros((len(points), 3))
    squared = np.zeros(xy.shape[:2])
    for k in map(int, np.flatnonzero(used)):
        residuals, jacobian = _residuals(views[k], points, xy[k])
        error = np.linalg.norm(residuals, axis=-1)
        weight = HUBER_PX / np.maximum(error, HUBER_PX)
        information += np.einsum("k,kai,kaj->kij", weight, jacobian, jacobian)
        gradient += np.einsum("k,kai,ka->ki", weight, jacobian, residuals)
        squared[k] = weight * error**2
    # Rays nearly parallel: a touch of damping keeps the solution finite, the covariance tells.
    trace = np.trace(information, axis1=1, axis2=2)
    return information + 1e-12 * trace[:, None, None] * np.eye(3), gradient, squared


def _residuals(view: View, points: Array, xy: Array) -> tuple[Array, Array]:
    """Errors ``(K, 2)``, px, and their derivatives ``(K, 2, 3)`` by the points in the world."""
    in_cam = np.asarray(view.cam_from_world * points)
    step = DIFFERENCE * np.abs(in_cam[:, 2])
    shifts = step[:, None, None] * np.eye(3)
    ahead = view.camera.project(in_cam[:, None] + shifts)
    behind = view.camera.project(in_cam[:, None] - shifts)
    by_cam = ((ahead - behind) / (2 * step[:, None, None])).swapaxes(1, 2)
    residuals = np.asarray(view.camera.project(in_cam) - xy, np.float64)
    return residuals, np.asarray(by_cam @ view.cam_from_world.rotation, np.float64)


def _with_uncertainty(views: Sequence[View], points: Array, xy: Array, used: Mask) -> Triangulation:
    information, _, squared = _normal_equations(views, points, xy, used)
    num_free = 2 * int(used.sum()) * len(points) - 3 * len(points)
    sigma = max(float(np.sqrt(squared.sum() / num_free)), MIN_SIGMA_PX)
    errors = _errors(views, points, xy)[used]
    return Triangulation(
        points=points,
        covariances=np.asarray(sigma**2 * np.linalg.inv(information), np.float64),
        used=used,
        rms_px=float(np.sqrt((errors**2).mean())),
    )
