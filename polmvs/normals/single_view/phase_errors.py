"""Phase errors of one normal over many pixels, and their normal equations: the inner loop of M1.

With ``x, y`` the ray over its z component and ``p = (x n_z - n_x, y n_z - n_y)`` the phase of a
normal n is ``-atan2(p_y, p_x)`` (paper, eq. phi_persp), and its gradient on n is minus the
predicted row ``(p_y, -p_x, p_x y - p_y x)`` over ``|p|^2``. All of it works on doubled angles, so
that neither the axial ambiguity nor trigonometry comes in. Under OPA ``x = y = 0``.

Samples of pixels are one array (5, N): cosine and sine of the doubled phase, x, y, and the
precision ``1 / sigma^2`` of the phase.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import NDArray

from polmvs.config import AngleModel
from polmvs.normals.estimator import CAUCHY_SCALE

Floats: TypeAlias = NDArray[np.floating[Any]]
Array: TypeAlias = NDArray[np.float64]

CHUNK = 8192  # pixels worked on at a time: the temporaries stay in the cache
TINY = 1e-12


class NormalEquations(NamedTuple):
    """Sums at a normal over weighted phase errors; r the rows, w the weights.

    Attributes
    ----------
    matrix : (3, 3), sum of ``w r r^T``.
    noise : (3, 3), covariance of the sum of ``w r error`` that the pixels' sigma explains.
    scores : (R, 3), sum of ``w r error`` over each run of pixels.
    errors : (N,), measured minus predicted phase, rad.
    """

    matrix: Array
    noise: Array
    scores: Array
    errors: Floats


def stack_samples(model: AngleModel, axial: Floats, rays: Floats, sigma: Floats) -> Floats:
    """Samples (5, N) of the pixels that count: polarised, finite, with a sigma.

    Parameters
    ----------
    model : OPA, PPA or tilted.
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
    xy = np.zeros_like(rays[:2]) if model is AngleModel.OPA else rays[:2] / rays[2]
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
    scale : of the Cauchy loss, in units of sigma; None: the paper's weights, all unit rows alike.
    run_length : pixels that share a score.
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
    """Gradient (3, N) of the phase errors of samples (5, N) on the normal, rad."""
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
    # 1 - cos is 2 sin^2 of the error.
    return precision / (1 + (1 - cos) * precision * (0.5 / (CAUCHY_SCALE * scale) ** 2))


def _products(left: Sequence[Floats], right: Sequence[Floats]) -> Array:
    """Symmetric product ``left @ right.T`` of two (3, N); for so few rows dots beat a gemm."""
    (a, b, c), (x, y, z) = left, right
    ay, az, bz = a @ y, a @ z, b @ z
    return np.array([[a @ x, ay, az], [ay, b @ y, bz], [az, bz, c @ z]], np.float64)
