"""Normal of a plane from the phase angles of one view (paper, M1, eq. coeff).

The paper's estimator is the eigenvector of ``M^T M`` over all pixels. The robust estimator is the
maximum likelihood of the phase angles: Gauss-Newton steps on the sphere minimize a Cauchy loss of
phase error over sigma. It is as fast, and it has no bias. The eigenvector is biased, because the
noise of the rows enters ``M^T M`` (at 5 degrees of noise and a fifth of outliers 0.1 instead of
0.004 degrees for the same weights).

Let ``x, y`` be the ray over its z component and ``p = (x n_z - n_x, y n_z - n_y)``. The phase of a
normal n is ``-atan2(p_y, p_x)`` (paper, eq. phi_persp). Its gradient with respect to n is minus the
predicted row ``(p_y, -p_x, p_x y - p_y x)`` over ``|p|^2``. All computations use doubled angles,
which avoids the axial ambiguity and trigonometric functions. Under OPA ``x = y = 0``.

Arrays are component first, ``(3, N)``, the pixels in raster order: the covariance comes from the
scatter of runs of neighbouring pixels, whose errors may have a common cause. Samples of pixels are
one array (5, N): cosine and sine of the doubled phase, x, y, and the precision
``1 / sigma^2`` of the phase.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from polmvs.arrays import Array, Floats
from polmvs.fitting import BEYOND_CHANCE, CAUCHY_SCALE, annealed_scales, robust_deviation
from polmvs.normals.estimator import EstimatorTolerances, smallest_eigenvectors
from polmvs.polarization.kinds import AngleModel

CHUNK = 8192  # pixels processed at a time: the temporaries stay in the cache
TINY = 1e-12
EXACT = float(np.finfo(np.float32).eps)  # of angles: what their rounding leaves


@dataclass(frozen=True, kw_only=True)
class PlaneTolerances:
    """Tolerances of the normal of a plane.

    Attributes
    ----------
    some_pixels : least number of evenly spread pixels for the first rounds, medians and the search
        for a focal length; time only.
    coarse_rounds : rounds on these. Derived: those of normals from many views.
    fine_rounds : over all pixels. Guess.
    num_runs : least number of runs of pixels for a covariance. Guess.
    min_conditioning : ratio of singular values below which rows have rank 1. Derived: that of
        normals from many views.
    max_step : rad, of a Gauss-Newton step. Guess.
    """

    some_pixels: int = 20_000
    coarse_rounds: int = EstimatorTolerances.num_rounds
    fine_rounds: int = 2
    num_runs: int = 32
    min_conditioning: float = EstimatorTolerances.min_conditioning
    max_step: float = 0.3


TOL = PlaneTolerances()


@dataclass(frozen=True, kw_only=True)
class PlaneEstimate:
    """Normal of a plane seen in one view.

    Attributes
    ----------
    normal : (3,) float64, unit, camera frame, facing the camera. If not ``valid``, it has the least
        residual but is not unique: under OPA, whose rows have rank 1, it is the direction in the
        image plane. NaN for fewer than two pixels.
    valid : the rows determine a single normal.
    conditioning : ratio of the middle to the largest singular value of the weighted predicted
        rows; 0 for rows of rank 1, at most 1.
    covariance : (3, 3) float64, of the normal, rad^2, camera frame; across the normal, of rank 2.
        It is that of the pixels' sigma or, if larger, the scatter of runs of pixels. NaN if not
        valid. It does not include an error that is common to the whole view.
    sigma_deg : standard deviation along the larger axis of the covariance, degrees; infinite
        where not valid.
    rmse_deg, median_deg : root mean square, and median of the absolute, phase residual (measured
        minus predicted by ``normal``), degrees.
    num_pixels : pixels used, outliers included.
    outlier_share : share of the pixels with a residual larger than chance explains.
    """

    normal: Array
    valid: bool
    conditioning: float = 0.0
    covariance: Array = field(default_factory=lambda: np.full((3, 3), np.nan))
    sigma_deg: float = np.inf
    rmse_deg: float = np.nan
    median_deg: float = np.nan
    num_pixels: int
    outlier_share: float = np.nan


def plane_normal(
    angle_model: AngleModel,
    axial: Floats,
    rays: Floats,
    sigma: Floats,
    *,
    robust: bool = True,
    initial_normal: Floats | None = None,
) -> PlaneEstimate:
    """Common normal of pixels of one view (paper, "Single-view Normal Estimation").

    Parameters
    ----------
    angle_model : OPA, PPA, or tilted (then ``axial`` is of corrected images,
    :mod:`polmvs.polarization.angle_models`).
    axial : (2, N), ``(cos 2 phase, sin 2 phase)`` times any positive number.
    rays : (3, N), camera frame, of any length.
    sigma : (N,), standard deviation of the phase, rad.
    robust : maximum likelihood with a Cauchy loss, whose scale comes from the residuals; else the
        paper's eigenvector with equal weights.
    initial_normal : (3,), start of the robust estimator; None: the paper's eigenvector.

    Returns
    -------
    Not valid for fewer than two pixels, or if their rows have rank 1. Pixels that are not finite or
    have no polarization are ignored.
    """
    samples = stack_samples(angle_model, axial, rays, sigma)
    num = samples.shape[1]
    if num < 2:
        return PlaneEstimate(normal=np.full(3, np.nan), valid=False, num_pixels=num)
    if not robust:
        normal = _facing(_eigenvector(angle_model, samples), samples)
        return _describe(normal, samples, None)
    coarse = np.ascontiguousarray(samples[:, :: max(1, num // TOL.some_pixels)])
    normal = _eigenvector(angle_model, coarse)
    if initial_normal is not None:
        normal = np.array(initial_normal, np.float64)
    scale = CAUCHY_SCALE
    for loss_scale in annealed_scales(TOL.coarse_rounds):
        scale = residual_scale(phase_errors(normal, coarse) * np.sqrt(coarse[4])) * loss_scale
        normal = _improve(normal, normal_equations(normal, coarse, scale))
    for _ in range(TOL.fine_rounds):
        normal = _improve(normal, normal_equations(normal, samples, scale))
    return _describe(_facing(normal, samples), samples, scale)


def phase_residuals(angle_model: AngleModel, normal: Floats, axial: Floats, rays: Floats) -> Floats:
    """Measured phase minus that of a normal, rad in [-pi/2, pi/2].

    Parameters
    ----------
    angle_model : OPA, PPA or tilted.
    normal : (3,), camera frame.
    axial : (2, N), ``(cos 2 phase, sin 2 phase)`` times any positive number.
    rays : (3, N), camera frame, of any length.

    Returns
    -------
    (N,), NaN where nothing was measured.
    """
    measured = (np.abs(axial[0]) + np.abs(axial[1]) > 0) & np.isfinite(rays).all(axis=0)
    residuals = np.full(measured.shape, np.nan, np.result_type(axial, rays))
    some = stack_samples(
        angle_model, axial[:, measured], rays[:, measured], np.ones_like(axial[0, measured])
    )
    residuals[measured] = phase_errors(normal, some)
    return residuals


def _eigenvector(angle_model: AngleModel, samples: Floats) -> Array:
    """Eigenvector of the smallest eigenvalue of ``M^T M`` (paper, eq. coeff), ``(3,)``."""
    entries = row_products(samples)
    # Under OPA no row has a z component: only the direction in the image counts.
    if angle_model is AngleModel.OPA:
        entries[2] = entries[:2].sum()
    return smallest_eigenvectors(entries[:, None])[1][:, 0]


def residual_scale(normalized_errors: Floats) -> float:
    """Deviation of errors, from their median absolute value; for exact data, that of rounding."""
    return max(robust_deviation(normalized_errors), EXACT)


def _improve(normal: Array, equations: NormalEquations) -> Array:
    """Gauss-Newton step on the sphere, none along a direction of which nothing is known."""
    basis = tangents(normal)
    matrix = basis @ equations.matrix @ basis.T
    gradient = basis @ equations.scores.sum(axis=0)
    step = -np.linalg.pinv(matrix, rcond=TOL.min_conditioning**2, hermitian=True) @ gradient
    step *= min(1.0, TOL.max_step / max(float(np.linalg.norm(step)), TINY))
    moved = normal + step @ basis
    return np.asarray(moved / np.linalg.norm(moved))


def tangents(normal: Array) -> Array:
    """Two unit vectors, rows (2, 3), perpendicular to the normal and to each other."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _facing(normal: Array, samples: Floats) -> Array:
    """The normal with the sign that faces the camera on average."""
    x, y = samples[2:4].mean(axis=1, dtype=np.float64)
    return -normal if float(np.array([x, y, 1.0]) @ normal) > 0 else normal


def _describe(normal: Array, samples: Floats, scale: float | None) -> PlaneEstimate:
    """Quality of a normal on the pixels that it was made from."""
    num = samples.shape[1]
    run_length = min(CHUNK, max(1, num // TOL.num_runs))
    equations = normal_equations(normal, samples, scale, run_length=run_length)
    basis = tangents(normal)
    eigenvalues, axes = np.linalg.eigh(basis @ equations.matrix @ basis.T)
    conditioning = float(np.sqrt(max(eigenvalues[0], 0) / max(eigenvalues[1], TINY)))
    valid = conditioning >= TOL.min_conditioning
    covariance, sigma = np.full((3, 3), np.nan), np.inf
    if valid:
        across = axes.T @ basis
        in_plane = _covariance(equations, across / eigenvalues[:, None])
        covariance = across.T @ in_plane @ across
        sigma = float(np.sqrt(np.linalg.eigvalsh(in_plane)[-1]))
    step = max(1, num // TOL.some_pixels)
    some = np.abs(equations.errors[::step])
    normalized = some * np.sqrt(samples[4, ::step])
    limit = BEYOND_CHANCE * residual_scale(normalized)
    return PlaneEstimate(
        normal=normal,
        valid=valid,
        conditioning=conditioning,
        covariance=covariance,
        sigma_deg=float(np.degrees(sigma)),
        rmse_deg=float(np.degrees(np.sqrt(equations.errors @ equations.errors / num))),
        median_deg=float(np.degrees(np.median(some))),
        num_pixels=num,
        outlier_share=float((normalized > limit).mean()),
    )


def _covariance(equations: NormalEquations, solver: Array) -> Array:
    """Covariance (2, 2) of a step, rad^2; ``solver`` (2, 3) takes scores to steps."""
    influence = equations.scores @ solver.T
    num = len(influence)
    scatter = influence.T @ influence * (num / max(num - 2, 1))
    known = np.asarray(solver @ equations.noise @ solver.T)
    larger: Array = max(scatter, known, key=lambda matrix: float(np.linalg.eigvalsh(matrix)[-1]))
    return larger


class NormalEquations(NamedTuple):
    """Sums at a normal over weighted phase errors; r the rows, w the weights.

    Attributes
    ----------
    matrix : (3, 3), sum of ``w r r^T``.
    noise : (3, 3), covariance of the sum of ``w r error`` by the pixels' sigma.
    scores : (R, 3), sum of ``w r error`` over each run of pixels.
    errors : (N,), measured minus predicted phase, rad.
    """

    matrix: Array
    noise: Array
    scores: Array
    errors: Floats


def stack_samples(angle_model: AngleModel, axial: Floats, rays: Floats, sigma: Floats) -> Floats:
    """Samples (5, N) of the usable pixels: polarized, finite, with a sigma.

    Parameters
    ----------
    angle_model : OPA, PPA or tilted.
    axial : (2, N), ``(cos 2 phase, sin 2 phase)`` times any positive number.
    rays : (3, N), camera frame, of any length.
    sigma : (N,), standard deviation of the phase, rad.
    """
    if axial.shape != (2, *sigma.shape) or rays.shape != (3, *sigma.shape) or sigma.ndim != 1:
        raise ValueError(
            f"{axial.shape=}, {rays.shape=}, {sigma.shape=} but expected (2, N), (3, N), (N,)."
        )
    length = np.sqrt(axial[0] * axial[0] + axial[1] * axial[1])
    usable = (length > 0) & (sigma > 0) & (length + sigma < np.inf)  # NaN compares False
    if not usable.all():
        axial, rays = axial[:, usable], rays[:, usable]
        sigma, length = sigma[usable], length[usable]
    xy = np.zeros_like(rays[:2]) if angle_model is AngleModel.OPA else rays[:2] / rays[2]
    return np.stack([*(axial / length), *xy, 1 / (sigma * sigma)])


def phase_errors(normal: Floats, samples: Floats) -> Floats:
    """Measured minus predicted phase (N,) of samples (5, N), rad in [-pi/2, pi/2]."""
    parts = [_compare(normal, run) for run in _runs(samples, CHUNK)]
    return np.concatenate([0.5 * np.arctan2(sin, cos) for cos, sin, _ in parts])


def normal_equations(
    normal: Array, samples: Floats, scale: float | None, *, run_length: int = CHUNK
) -> NormalEquations:
    """Normal equations of the phase errors of a normal.

    Parameters
    ----------
    normal : (3,), camera frame.
    samples : (5, N).
    scale : of the Cauchy loss, in units of sigma; None: the paper's weights, equal for unit rows.
    run_length : number of pixels that share a score.
    """
    matrix, noise = np.zeros((3, 3)), np.zeros((3, 3))
    scores, errors = [], []
    for run in _runs(samples, run_length):
        cos, sin, p = _compare(normal, run)
        rows, inverse = _rows(p, run)
        weights = _weights(rows, cos * inverse, run[4], scale)
        weighted = [row * weights for row in rows]
        pull = 0.5 * sin * inverse  # half the sine of the doubled error: outliers pull less
        matrix += _products(weighted, rows)
        if scale is None:
            noise += _products([row * (weights / run[4]) for row in weighted], rows)
        scores.append([float(row @ pull) for row in weighted])
        errors.append(0.5 * np.arctan2(sin, cos))
    # Weights that are precisions make the two the same.
    noise = noise if scale is None else matrix
    return NormalEquations(matrix, noise, np.array(scores), np.concatenate(errors))


def error_gradients(normal: Floats, samples: Floats) -> Floats:
    """Gradient (3, N) of the phase errors of samples (5, N) with respect to the normal, rad."""
    return np.stack(_rows(_compare(normal, samples)[2], samples)[0])


def row_products(samples: Floats) -> Array:
    """Sums (6,) of the entries xx, yy, zz, xy, xz, yz of ``m m^T`` over the measured unit rows m.

    Twice the product of a row ``(sin, cos, -x sin - y cos)`` of the phase with itself is linear in
    the cosine and sine of the doubled phase, so that no row needs to be formed.
    """
    entries = np.zeros(6)
    for cos2, sin2, x, y, _ in _runs(samples, CHUNK):
        first, second = x * (1 - cos2) + y * sin2, x * sin2 + y * (1 + cos2)
        last = x * first + y * second
        weights = 1 / (2 + last)  # the row's length to one
        products = (1 - cos2, 1 + cos2, last, sin2, -first, -second)
        entries += [float(weights @ product) for product in products]
    return entries


def _runs(samples: Floats, length: int) -> list[Floats]:
    """Cut samples (5, N) into runs of neighbouring pixels."""
    return [samples[:, start : start + length] for start in range(0, samples.shape[1], length)]


def _compare(normal: Floats, samples: Floats) -> tuple[Floats, Floats, Floats]:
    """Cosine and sine of twice the phase error times ``|p|^2``, and p, (2, N)."""
    cos2, sin2, x, y, _ = samples
    n = np.asarray(normal, samples.dtype)
    p = np.stack([x * n[2] - n[0], y * n[2] - n[1]])
    difference, product = p[0] * p[0] - p[1] * p[1], 2 * p[0] * p[1]
    return cos2 * difference - sin2 * product, sin2 * difference + cos2 * product, p


def _rows(p: Floats, samples: Floats) -> tuple[list[Floats], Floats]:
    """Predicted rows over ``|p|^2``, minus the gradient of the phase on n; and ``1 / |p|^2``."""
    inverse = 1 / np.maximum(p[0] * p[0] + p[1] * p[1], TINY)
    across, down = p[0] * inverse, p[1] * inverse
    return [down, -across, across * samples[3] - down * samples[2]], inverse


def _weights(rows: list[Floats], cos: Floats, precision: Floats, scale: float | None) -> Floats:
    """Weights of the squared phase errors; ``cos`` is that of twice the error."""
    if scale is None:  # rows of unit length weigh alike
        return 1 / (rows[0] * rows[0] + rows[1] * rows[1] + rows[2] * rows[2])
    # 1 - cos is 2 sin^2 of the error; rounding can make it negative.
    return precision / (1 + np.maximum(1 - cos, 0) * precision * (0.5 / scale**2))


def _products(left: Sequence[Floats], right: Sequence[Floats]) -> Array:
    """Symmetric product ``left @ right.T`` of two (3, N); for so few rows dots beat a gemm."""
    (a, b, c), (x, y, z) = left, right
    ay, az, bz = a @ y, a @ z, b @ z
    return np.array([[a @ x, ay, az], [ay, b @ y, bz], [az, bz, c @ z]], np.float64)
