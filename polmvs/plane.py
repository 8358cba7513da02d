"""Normal of a plane from the phase angles of one view (paper, M1, eq. coeff).

The paper's estimator is the eigenvector of ``M^T M`` over all pixels. The robust one is the
maximum likelihood of the phase angles themselves: with ``p = v n_z - v_z n`` the predicted phase
is ``-atan2(p_y, p_x)`` (paper, eq. phi_persp), its gradient on n is minus the predicted row over
``|p|``, and Gauss-Newton steps on the sphere minimise a Cauchy loss of phase error over sigma. It
is free of the bias of an eigenvector, whose rows carry their noise into ``M^T M``.

Arrays are component first, ``(3, N)``, the pixels in raster order: the covariance is taken from
the scatter of runs of neighbouring pixels, whose errors may have a common cause.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from polmvs.config import Model
from polmvs.normals import CAUCHY_SCALE, smallest_eigenvectors

Floats: TypeAlias = NDArray[np.floating[Any]]
Array: TypeAlias = NDArray[np.float64]

CHUNK = 16384  # pixels worked on at a time: the temporaries stay in the cache
COARSE_PIXELS = 16384  # that the first rounds take
COARSE_ROUNDS = 6
FINE_ROUNDS = 2  # over all pixels
NUM_RUNS = 32  # runs of pixels from whose scatter the covariance is taken, at least
MIN_CONDITIONING = 0.01
MAX_STEP = 0.3  # rad
MEDIAN_OF_NORMAL = 0.6745  # median of |x|, x of unit deviation
MIN_SCALE = 0.01  # of the errors in units of sigma: keeps exact data from a division by zero
MEDIAN_PIXELS = 32768  # of which a median is taken, at least
OUTLIER = 4.0  # robust deviations
TINY = 1e-12


@dataclass(frozen=True, kw_only=True)
class PlaneEstimate:
    """Normal of a plane seen in one view.

    Attributes
    ----------
    normal : (3,) float64, unit, camera frame, facing the camera. Where not ``valid`` it still is
        one that leaves the least residual, but not the only one: under OPA, whose rows have rank
        1, it is the direction in the image plane. NaN where there are fewer than two pixels.
    valid : the rows determine a single normal.
    conditioning : ratio of the middle to the largest singular value of the weighted predicted
        rows; 0 for rows of rank 1, at most 1.
    sigma_deg : standard deviation along the larger axis of the covariance, degrees: what the
        pixels' sigma explains or, where it is larger, the scatter of runs of pixels. Infinite
        where not valid. An error that is common to the whole view is not in it.
    rmse_deg, median_deg : root mean square, and median of the absolute, phase residual (measured
        minus predicted by ``normal``), degrees.
    num_pixels : pixels used, outliers included.
    outlier_share : share of the pixels with a residual beyond 4 robust deviations.
    """

    normal: Array
    valid: bool
    conditioning: float
    sigma_deg: float
    rmse_deg: float
    median_deg: float
    num_pixels: int
    outlier_share: float


class _Sums(NamedTuple):
    """Normal equations of the phase errors at a normal, r the rows, w the weights.

    ``matrix`` (3, 3) is the sum of ``w r r^T``, ``scores`` (B, 3) that of ``w r error`` over each
    run of pixels, and ``noise`` the covariance of its total that sigma explains.
    """

    matrix: Array
    noise: Array
    scores: Array


def plane_normal(
    model: Model, axial: Floats, rays: Floats, sigma: Floats, *, robust: bool = True
) -> PlaneEstimate:
    """Normal that the pixels of one view share (paper, "Single-view Normal Estimation").

    Parameters
    ----------
    model : OPA, PPA, or tilted (then ``axial`` is of corrected images, :mod:`polmvs.tilted`).
    axial : (2, N), ``(cos 2 phase, sin 2 phase)`` times any positive number.
    rays : (3, N), unit, camera frame.
    sigma : (N,), standard deviation of the phase, rad.
    robust : maximum likelihood with a Cauchy loss whose scale is the residuals' own, or the
        paper's eigenvector, which weighs all pixels alike.

    Returns
    -------
    Not valid for fewer than two pixels, or where their rows have rank 1. Pixels that are not
    finite or have no polarisation are left out.
    """
    samples = _usable(model, axial, rays, sigma)
    num = samples.shape[1]
    if num < 2:
        return _no_estimate(num)
    coarse = np.ascontiguousarray(samples[:, :: max(1, num // COARSE_PIXELS)])
    normal = _eigenvector(model, coarse if robust else samples)
    scale = None
    if robust:
        for round_index in range(COARSE_ROUNDS):
            # Anneal: a wide loss first, so that a poor start does not reject the good pixels.
            scale = _deviation(normal, coarse) * 2.0 ** max(2 - round_index, 0)
            normal = _improve(normal, _sums(normal, coarse, scale))
        for _ in range(FINE_ROUNDS):
            normal = _improve(normal, _sums(normal, samples, scale))
    return _describe(_facing(normal, rays), samples, scale)


def phase_residuals(model: Model, normal: Floats, axial: Floats, rays: Floats) -> Floats:
    """Measured phase minus that of a normal, rad in [-pi/2, pi/2].

    Parameters
    ----------
    model : OPA, PPA or tilted.
    normal : (3,), camera frame.
    axial : (2, N), ``(cos 2 phase, sin 2 phase)`` times any positive number.
    rays : (3, N), unit, camera frame.

    Returns
    -------
    (N,), NaN where the normal lies along the ray or nothing is measured.
    """
    cos, sin, p = _compare(normal, _stack(model, axial, rays, np.ones_like(axial[0])))
    known = (np.abs(cos) + np.abs(sin) > 0) & ((p * p).sum(axis=0) > 0)
    return np.where(known, 0.5 * np.arctan2(sin, cos), np.nan)


def _stack(model: Model, axial: Floats, rays: Floats, precision: Floats) -> Floats:
    """Samples (5, N): axial pair, ray over its z as the model sees it, precision."""
    xy = np.zeros_like(rays[:2]) if model is Model.OPA else rays[:2] / rays[2]
    return np.stack([*axial, *xy, precision])


def _usable(model: Model, axial: Floats, rays: Floats, sigma: Floats) -> Floats:
    """Samples (5, N) of the pixels that count, their axial pairs of unit length."""
    if axial.shape != (2, *sigma.shape) or rays.shape != (3, *sigma.shape) or sigma.ndim != 1:
        raise ValueError(
            f"{axial.shape=}, {rays.shape=}, {sigma.shape=} but expected (2, N), (3, N), (N,)."
        )
    length = np.sqrt(axial[0] * axial[0] + axial[1] * axial[1])
    usable = (length > 0) & (sigma > 0) & (length + sigma < np.inf)  # NaN compares False
    if not usable.all():
        axial, rays = axial[:, usable], rays[:, usable]
        sigma, length = sigma[usable], length[usable]
    return _stack(model, axial / length, rays, 1 / (sigma * sigma))


def _runs(samples: Floats, size: int = CHUNK) -> list[Floats]:
    """Cut samples (5, N) into runs of neighbouring pixels."""
    return [samples[:, start : start + size] for start in range(0, samples.shape[1], size)]


def _eigenvector(model: Model, samples: Floats) -> Array:
    """Eigenvector of the smallest eigenvalue of ``M^T M`` (paper, eq. coeff), ``(3,)``.

    Twice the product ``m^T m`` of a row ``(sin, cos, -x sin - y cos)`` of the phase is linear in
    cosine and sine of the doubled phase, so that no row needs to be formed.
    """
    entries = np.zeros(6)
    for cos2, sin2, x, y, _ in _runs(samples):
        first, second = x * (1 - cos2) + y * sin2, x * sin2 + y * (1 + cos2)
        last = x * first + y * second
        weights = 1 / (2 + last)  # of the unit row
        products = (1 - cos2, 1 + cos2, last, sin2, -first, -second)
        entries += [float(weights @ product) for product in products]
    if model is Model.OPA:  # no row has a z component: only the direction in the image counts
        entries[2] = entries[:2].sum()
    return smallest_eigenvectors(entries[:, None])[1][:, 0]


def _compare(normal: Floats, samples: Floats) -> tuple[Floats, Floats, Floats]:
    """Cosine and sine of twice the phase error times ``|p|^2``, and p (2, N), of the rays' size."""
    cos2, sin2, x, y, _ = samples
    n = np.asarray(normal, samples.dtype)
    p = np.stack([x * n[2] - n[0], y * n[2] - n[1]])
    difference, product = p[0] * p[0] - p[1] * p[1], 2 * p[0] * p[1]
    return cos2 * difference - sin2 * product, sin2 * difference + cos2 * product, p


def _sums(normal: Array, samples: Floats, scale: float | None, size: int = CHUNK) -> _Sums:
    """Normal equations with the weights of a Cauchy loss, or the paper's where scale is None."""
    matrix, noise, scores = np.zeros((3, 3)), np.zeros((3, 3)), []
    for run in _runs(samples, size):
        cos, sin, p = _compare(normal, run)
        rows, inverse = _rows(p, run)
        weights = _weights(rows, cos * inverse, run[4], scale)
        weighted = [row * weights for row in rows]
        error = 0.5 * sin * inverse  # half the sine of the doubled angle: outliers pull less
        matrix += _products(weighted, rows)
        if scale is None:
            noise += _products([row * (weights / run[4]) for row in weighted], rows)
        scores.append([float(row @ error) for row in weighted])
    # Weights that are precisions make the two the same.
    return _Sums(matrix, noise if scale is None else matrix, np.array(scores))


def _rows(p: Floats, samples: Floats) -> tuple[list[Floats], Floats]:
    """Predicted rows over ``|p|``, minus the gradient of the phase on n; and ``1 / |p|^2``."""
    inverse = 1 / np.maximum(p[0] * p[0] + p[1] * p[1], TINY)
    across, down = p[0] * inverse, p[1] * inverse
    return [down, -across, across * samples[3] - down * samples[2]], inverse


def _weights(rows: list[Floats], cos: Floats, precision: Floats, scale: float | None) -> Floats:
    """Weights of the squared phase errors, ``cos`` that of twice the error."""
    if scale is None:  # rows of unit length weigh alike
        return 1 / (rows[0] * rows[0] + rows[1] * rows[1] + rows[2] * rows[2])
    # 1 - cos is 2 sin^2 of the error.
    return precision / (1 + (1 - cos) * precision * (0.5 / (CAUCHY_SCALE * scale) ** 2))


def _products(left: Sequence[Floats], right: Sequence[Floats]) -> Array:
    """Symmetric product ``left @ right.T`` of two (3, N); for so few rows dots beat a gemm."""
    (a, b, c), (x, y, z) = left, right
    ay, az, bz = a @ y, a @ z, b @ z
    return np.array([[a @ x, ay, az], [ay, b @ y, bz], [az, bz, c @ z]], np.float64)


def _deviation(normal: Array, samples: Floats) -> float:
    """Robust deviation of the phase errors, in units of their sigma."""
    error = np.abs(_errors(normal, samples)) * np.sqrt(samples[4])
    return max(float(np.median(error)) / MEDIAN_OF_NORMAL, MIN_SCALE)


def _errors(normal: Array, samples: Floats) -> Floats:
    """Phase errors (N,), rad."""
    parts = [_compare(normal, run)[:2] for run in _runs(samples)]
    return np.concatenate([0.5 * np.arctan2(sin, cos) for cos, sin in parts])


def _some(values: Floats) -> Floats:
    """Evenly spaced values for a median, of which more cost time and change nothing."""
    return values[..., :: max(1, values.shape[-1] // MEDIAN_PIXELS)]


def _improve(normal: Array, sums: _Sums) -> Array:
    """Gauss-Newton step on the sphere, none along a direction of which nothing is known."""
    tangents = _tangents(normal)
    matrix = tangents @ sums.matrix @ tangents.T
    gradient = tangents @ sums.scores.sum(axis=0)
    step = -np.linalg.pinv(matrix, rcond=MIN_CONDITIONING**2, hermitian=True) @ gradient
    step *= min(1.0, MAX_STEP / max(float(np.linalg.norm(step)), TINY))
    moved = normal + step @ tangents
    return np.asarray(moved / np.linalg.norm(moved))


def _tangents(normal: Array) -> Array:
    """Two unit vectors, rows (2, 3), perpendicular to the normal and to each other."""
    first = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(normal, first)])


def _facing(normal: Array, rays: Floats) -> Array:
    """The normal with the sign that faces the camera on average."""
    return -normal if float(np.nansum(rays, axis=1, dtype=np.float64) @ normal) > 0 else normal


def _describe(normal: Array, samples: Floats, scale: float | None) -> PlaneEstimate:
    """Quality of a normal on the pixels that it was made from."""
    num = samples.shape[1]
    sums = _sums(normal, samples, scale, min(CHUNK, max(1, -(-num // NUM_RUNS))))
    tangents = _tangents(normal)
    eigenvalues, axes = np.linalg.eigh(tangents @ sums.matrix @ tangents.T)
    conditioning = float(np.sqrt(max(eigenvalues[0], 0) / max(eigenvalues[1], TINY)))
    valid = conditioning >= MIN_CONDITIONING
    sigma = _sigma(sums, axes.T @ tangents / eigenvalues[:, None]) if valid else np.inf
    error = _errors(normal, samples)
    some = _some(samples)
    normalized = np.abs(_errors(normal, some)) * np.sqrt(some[4])
    limit = OUTLIER * np.median(normalized) / MEDIAN_OF_NORMAL
    return PlaneEstimate(
        normal=normal,
        valid=valid,
        conditioning=conditioning,
        sigma_deg=float(np.degrees(sigma)),
        rmse_deg=float(np.degrees(np.sqrt(error @ error / num))),
        median_deg=float(np.degrees(np.median(np.abs(_some(error))))),
        num_pixels=num,
        outlier_share=float((normalized > limit).mean()),
    )


def _sigma(sums: _Sums, solver: Array) -> float:
    """Deviation along the larger axis, rad; ``solver`` (2, 3) takes scores to steps."""
    influence = sums.scores @ solver.T
    num = len(influence)
    scatter = influence.T @ influence * (num / max(num - 2, 1))
    known = solver @ sums.noise @ solver.T
    return float(np.sqrt(max(np.linalg.eigvalsh(scatter)[-1], np.linalg.eigvalsh(known)[-1])))


def _no_estimate(num: int) -> PlaneEstimate:
    return PlaneEstimate(
        normal=np.full(3, np.nan),
        valid=False,
        conditioning=0.0,
        sigma_deg=np.inf,
        rmse_deg=np.nan,
        median_deg=np.nan,
        num_pixels=num,
        outlier_share=np.nan,
    )
