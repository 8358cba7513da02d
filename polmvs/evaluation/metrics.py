"""Metrics of normals, phase angles and clouds against ground truth.

Definitions of the cloud's metrics (all distances in metres, all surfaces of the scene sampled):

on the part
    A cloud point whose nearest true point, of all surfaces, lies on the part. So an outlier near
    the part counts against it, and a point of the table beside it does not.
distance of a cloud point
    To the tangent plane of its nearest true point if that has a normal and the offset along the
    plane is below 1.5 times the sampling's spacing (the sampling is not the surface), else to the
    point itself.
accuracy at t
    Share of the cloud points on the part within t of the true surface.
completeness at t
    Share of the true points of the part that have a cloud point within t, plain Euclidean.
F-score at t
    Harmonic mean of the two; 0 where both are 0.
chamfer
    Mean of the mean distance of the cloud points on the part and the mean distance of the true
    points of the part to the cloud. Nothing is clipped: outliers count with their full distance.
normal error
    Angle between the normals of a cloud point on the part and of its nearest true point, 0 to
    180 degrees: a normal that points into the part is 180 degrees wrong.
off-surface share
    Share of all cloud points, on the part or not, farther than 5 mm from every true surface.

Nearest points farther than 20 mm are searched among points about 4 mm apart. This may lengthen such
a distance by about a millimetre, which does not affect a threshold below 20 mm.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats
from polmvs.config import RegionOptions
from polmvs.io.ground_truth import PART_SPACING_M
from polmvs.neighbors import nearest_points
from polmvs.polarization.stokes import axial_difference

# These define the figures; they are no tolerances of an algorithm.
THRESHOLDS_M = (0.001, 0.002, 0.005)
FAR_M = 0.02
TANGENT_REACH = 1.5  # in spacings of the true points
MIN_DOLP = RegionOptions.min_dolp  # least DoLP of pixels whose phase is compared
MAX_QUERIES = 2_000_000  # the accuracy of a larger cloud is that of a random subset of this size


@dataclass(frozen=True, kw_only=True)
class AngleStats:
    """Statistics of absolute errors in degrees; NaN where there are none.

    Attributes
    ----------
    mean_deg, rmse_deg, median_deg, p95_deg : degrees; the last is the 95th percentile.
    count : number of finite errors.
    """

    mean_deg: float
    rmse_deg: float
    median_deg: float
    p95_deg: float
    count: int

    @classmethod
    def from_degrees(cls, errors_deg: Floats) -> AngleStats:
        """Statistics of errors of any shape, degrees; NaN and signs are ignored."""
        errors = np.abs(np.asarray(errors_deg, np.float64).ravel())
        errors = errors[np.isfinite(errors)]
        if len(errors) == 0:
            return cls(mean_deg=np.nan, rmse_deg=np.nan, median_deg=np.nan, p95_deg=np.nan, count=0)
        median, p95 = np.percentile(errors, (50, 95))
        return cls(
            mean_deg=float(errors.mean()),
            rmse_deg=float(np.sqrt((errors**2).mean())),
            median_deg=float(median),
            p95_deg=float(p95),
            count=len(errors),
        )


@dataclass(frozen=True, kw_only=True)
class CloudMetrics:
    """Metrics of a cloud against ground truth; the module's docstring defines them.

    Attributes
    ----------
    thresholds_m : (T,) distances at which the shares are taken, m
    accuracy, completeness, f_score : (T,) shares from 0 to 1; 0 for a cloud without points
    accuracy_mean_m, accuracy_median_m : distance to ground truth of cloud points on the part, m
    completeness_mean_m, completeness_median_m : distance of true points of the part to the cloud, m
    chamfer_m : mean of the two means, m
    normal_mean_deg, normal_median_deg : normal error, degrees
    num_points : finite points of the cloud
    num_on_part : those of them on the part
    off_surface_share : share of all points farther than 5 mm from every true surface
        Distances, angles and this share are NaN where no point defines them.
    """

    thresholds_m: tuple[float, ...]
    accuracy: tuple[float, ...]
    completeness: tuple[float, ...]
    f_score: tuple[float, ...]
    accuracy_mean_m: float
    accuracy_median_m: float
    completeness_mean_m: float
    completeness_median_m: float
    chamfer_m: float
    normal_mean_deg: float
    normal_median_deg: float
    num_points: int
    num_on_part: int
    off_surface_share: float


def angular_errors_deg(normals: Floats, truth: Floats) -> Array:
    """Angles between vectors, 0 to 180 degrees; opposite ones are 180 apart.

    Parameters
    ----------
    normals, truth : (..., 3), same frame, of any length.

    Returns
    -------
    (...) float64, degrees; NaN where a vector is zero or not finite.
    """
    a, b = np.broadcast_arrays(np.asarray(normals, np.float64), np.asarray(truth, np.float64))
    usable = np.isfinite(a).all(axis=-1) & np.isfinite(b).all(axis=-1)
    usable &= (a != 0).any(axis=-1) & (b != 0).any(axis=-1)
    errors = np.full(usable.shape, np.nan)
    a, b = a[usable], b[usable]
    sines = np.linalg.norm(np.cross(a, b), axis=-1)
    errors[usable] = np.degrees(np.arctan2(sines, np.einsum("ij,ij->i", a, b)))
    return errors


def axial_errors_deg(phases: Floats, truth: Floats) -> Array:
    """Absolute differences of axial angles (modulo pi), 0 to 90 degrees.

    Parameters
    ----------
    phases, truth : (...), radians; NaN gives NaN.
    """
    phases, truth = np.asarray(phases, np.float64), np.asarray(truth, np.float64)
    finite = np.isfinite(phases) & np.isfinite(truth)
    difference = axial_difference(np.where(finite, phases, np.nan), np.where(finite, truth, np.nan))
    return np.degrees(np.abs(difference))


def evaluate_cloud(
    points: Floats,
    normals: Floats | None,
    truth_points: Floats,
    truth_normals: Floats,
    truth_is_part: NDArray[np.bool_],
    thresholds_m: tuple[float, ...] = THRESHOLDS_M,
    *,
    spacing_m: float = PART_SPACING_M,
) -> CloudMetrics:
    """Compare a cloud with sampled true surfaces; definitions in the module's docstring.

    Parameters
    ----------
    points : (N, 3), true frame, m; rows that are not finite are ignored. N may be 0.
    normals : (N, 3) or None, true frame; NaN rows have no normal.
    truth_points : (M, 3), finite, m, all surfaces of the scene
    truth_normals : (M, 3), NaN where unknown
    truth_is_part : (M,) bool, at least one true
    thresholds_m : (T,) m
    spacing_m : distance between neighbouring true points of the part, m.

    Raises
    ------
    ValueError
        The shapes of arrays do not fit, or there are no true points of the part.
    """
    _check_shapes(points, normals, truth_points, truth_normals, truth_is_part)
    finite = np.isfinite(points).all(axis=1)
    cloud = np.asarray(points[finite], np.float64)
    cloud_normals = None if normals is None else np.asarray(normals[finite], np.float64)
    true_points = np.asarray(truth_points, np.float64)
    queries, queried_normals = _subset(cloud, cloud_normals)
    distances, nearest = nearest_points(true_points, queries, far=FAR_M)
    on_part = truth_is_part[nearest]
    on_nearest = nearest[on_part]
    to_truth = _to_tangent_planes(
        queries[on_part] - true_points[on_nearest],
        np.asarray(truth_normals[on_nearest], np.float64),
        TANGENT_REACH * spacing_m,
    )
    to_cloud, _ = nearest_points(cloud, true_points[truth_is_part], far=FAR_M)
    angles = AngleStats.from_degrees(
        np.zeros(0)
        if queried_normals is None
        else angular_errors_deg(queried_normals[on_part], truth_normals[on_nearest])
    )
    accuracy = tuple(_share(to_truth <= t) for t in thresholds_m)
    completeness = tuple(_share(to_cloud <= t) for t in thresholds_m)
    share_on_part = _mean(on_part)
    return CloudMetrics(
        thresholds_m=tuple(thresholds_m),
        accuracy=accuracy,
        completeness=completeness,
        f_score=tuple(map(_harmonic_mean, accuracy, completeness)),
        accuracy_mean_m=_mean(to_truth),
        accuracy_median_m=_median(to_truth),
        completeness_mean_m=_mean(to_cloud),
        completeness_median_m=_median(to_cloud),
        chamfer_m=0.5 * (_mean(to_truth) + _mean(to_cloud)),
        normal_mean_deg=angles.mean_deg,
        normal_median_deg=angles.median_deg,
        num_points=len(cloud),
        num_on_part=round(share_on_part * len(cloud)) if len(cloud) else 0,
        off_surface_share=_mean(distances > THRESHOLDS_M[-1]),
    )


def _check_shapes(
    points: Floats,
    normals: Floats | None,
    truth_points: Floats,
    truth_normals: Floats,
    truth_is_part: NDArray[np.bool_],
) -> None:
    if points.ndim != 2 or points.shape[1] != 3:
        raise ValueError(f"{points.shape=} but expected (N, 3).")
    if normals is not None and normals.shape != points.shape:
        raise ValueError(f"{normals.shape=} but expected {points.shape}.")
    if truth_points.ndim != 2 or truth_points.shape[1] != 3:
        raise ValueError(f"{truth_points.shape=} but expected (M, 3).")
    if truth_normals.shape != truth_points.shape:
        raise ValueError(f"{truth_normals.shape=} but expected {truth_points.shape}.")
    if truth_is_part.shape != truth_points.shape[:1] or truth_is_part.dtype != np.bool_:
        raise ValueError(f"{truth_is_part.shape=} but expected bool {truth_points.shape[:1]}.")
    if not truth_is_part.any():
        raise ValueError("the truth has no point of the part.")


def _subset(cloud: Array, normals: Array | None) -> tuple[Array, Array | None]:
    """The cloud, or a random subset of a very large one."""
    if len(cloud) <= MAX_QUERIES:
        return cloud, normals
    chosen = np.random.default_rng(0).choice(len(cloud), MAX_QUERIES, replace=False)
    chosen.sort()
    return cloud[chosen], None if normals is None else normals[chosen]


def _to_tangent_planes(offsets: Array, normals: Array, reach: float) -> Array:
    """Length of offsets ``(N, 3)``, along the normal only where they end within reach of it."""
    lengths = np.linalg.norm(offsets, axis=1)
    heights = np.abs(np.einsum("ij,ij->i", offsets, normals))
    tangential = np.sqrt(np.maximum(lengths**2 - heights**2, 0.0))
    # A comparison with NaN (no normal) is false: the plain distance stays.
    return np.asarray(np.where(tangential < reach, heights, lengths))


def _harmonic_mean(a: float, b: float) -> float:
    return 2.0 * a * b / (a + b) if a + b > 0 else 0.0


def _share(holds: NDArray[np.bool_]) -> float:
    return float(holds.mean()) if len(holds) else 0.0


def _mean(values: NDArray[np.floating] | NDArray[np.bool_]) -> float:
    return float(values.mean()) if len(values) and np.isfinite(values).all() else float("nan")


def _median(values: Array) -> float:
    return float(np.median(values)) if len(values) and np.isfinite(values).all() else float("nan")
