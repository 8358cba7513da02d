"""Estimate of the encoding gamma of a mosaic from its polarized light.

The intensity behind an analyzer at ``a`` is ``I = s0 / 2 (1 + q cos 2a + u sin 2a)``. The
redundancy ``r = (I0 + I90 - I45 - I135) / s0`` is *linear* in ``q, u`` at each image position, for
any gains, angles, extinction ratios and tilts of the four analyzers. An encoding ``I ** p`` adds
``(p - 1) / (2 p) (q^2 - u^2)`` to it, to second order, with q and u as measured. A regression
separates the two and gives the exponent without any knowledge of the scene.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.fitting import BEYOND_CHANCE, cauchy_weights, robust_deviation
from polmvs.polarization.mosaic import clipped_cells, split_mosaic
from polmvs.polarization.stokes import patch_means


@dataclass(frozen=True, kw_only=True)
class LinearityTolerances:
    """Tolerances of the estimate of an encoding, and of its contradiction to the given one.

    Attributes
    ----------
    min_level : of a patch's mean, share of full scale. Guess: where samples near zero are cut
        off, darker ones look encoded.
    max_contrast : deviation of the intensity within a patch over its mean. Guess.
    min_patches : Guess.
    min_quadratic : least deviation of ``q^2 - u^2`` over the patches for an estimate. Guess: that
        of light polarized by 7 % in all directions.
    num_rounds : of weights and exponents; the exponent converges quadratically.
    num_groups : groups of neighbouring patches. Each group and each image is left out once
        (jackknife).
    min_ratio : least ratio of the two gammas for a contradiction, at any certainty. Guess: the
        degree of polarization is off by as much. Real sensors are linear to some percent.
    max_log_sigma : largest deviation of the gamma's logarithm for an estimate. Guess.
    """

    min_level: float = 0.02
    max_contrast: float = 0.1
    min_patches: int = 200
    min_quadratic: float = 0.0035
    num_rounds: int = 4
    num_groups: int = 8
    min_ratio: float = 1.25
    max_log_sigma: float = 0.15


TOL = LinearityTolerances()


@dataclass(frozen=True, kw_only=True)
class LinearityCheck:
    """The encoding gamma that the samples show.

    Attributes
    ----------
    given : gamma with which the samples are decoded.
    found : gamma that they show; None if there is too little polarized light.
    log_sigma : standard deviation of its logarithm.
    fits : whether the two agree; None if unknown.
    """

    given: float
    found: float | None
    log_sigma: float
    fits: bool | None

    @property
    def message(self) -> str:
        """One line for the user."""
        if self.fits is None or self.found is None:
            return (
                "too little polarized light, or images that show different things, to check "
                f"`capture.gamma` {self.given:g}"
            )
        if self.fits:
            return f"`capture.gamma` {self.given:g} fits"
        likely = _round_gamma(self.found, self.log_sigma)
        return (
            f"`capture.gamma` {self.given:g} does not fit: the sums of perpendicular samples show "
            f"an encoding gamma of {self.found:.2f} +- {self.found * self.log_sigma:.1g}. Give "
            f"`capture.gamma` {likely:g}"
        )


def check_linearity(
    mosaics: Sequence[NDArray[Any]],
    pattern: tuple[int, int, int, int],
    clip: float,
    gamma: float,
) -> LinearityCheck:
    """Compare the given gamma of mosaics with the gamma that their samples show.

    Parameters
    ----------
    mosaics : (H, W), samples as stored, shares of full scale.
    pattern : polarizer angles of a cell, row by row, degrees.
    clip : share from which a sample is clipped.
    gamma : given by the user: linear = sample ** (1 / gamma).
    """
    unknown = LinearityCheck(given=gamma, found=None, log_sigma=np.inf, fits=None)
    log_gamma, sigma = 0.0, np.inf
    for _ in range(TOL.num_rounds):
        decoded = [_patches(raw, pattern, clip, np.exp(-log_gamma)) for raw in mosaics]
        if not decoded or sum(len(rows) for rows, _ in decoded) < TOL.min_patches:
            return unknown
        slope, sigma = _quadratic_part(decoded)
        # slope = (p - 1) / (2 p); far from p = 1 the step is cut short, the next rounds go on.
        step = -np.log(1.0 - 2.0 * min(slope, 0.3))
        log_gamma += float(step)
        sigma *= 2.0
        if abs(step) < 0.1 * sigma:
            break
    if not sigma < TOL.max_log_sigma or not abs(log_gamma) < np.log(10.0):
        return unknown
    apart = abs(log_gamma - np.log(gamma))
    fits = bool(apart < max(BEYOND_CHANCE * sigma, np.log(TOL.min_ratio)))
    return LinearityCheck(
        given=gamma, found=float(np.exp(log_gamma)), log_sigma=float(sigma), fits=fits
    )


def _patches(
    raw: NDArray[Any],
    pattern: tuple[int, int, int, int],
    clip: float,
    exponent: float,
) -> tuple[Array, NDArray[np.int64]]:
    """Rows ``(N, 6)`` of smooth patches: s0, q, u, r, and place x, y; and their groups ``(N,)``."""
    images = split_mosaic(raw, pattern)
    usable = (~clipped_cells(raw, clip)).astype(np.float32)
    intensity = 0.25 * images.sum(axis=0)
    # Cells that see texture differ, the means of patches do not.
    mean = patch_means(intensity)
    spread = patch_means(np.square(intensity)) - np.square(mean)
    level = np.maximum(mean, 1e-6)
    good = (patch_means(usable) > 0.999) & (spread < np.square(TOL.max_contrast * level))
    # By the sum of all four: a choice by single ones would depend on the angle.
    good &= level > TOL.min_level
    if exponent != 1.0:
        images = np.power(np.maximum(images, 0), np.float32(exponent))
    i0, i45, i90, i135 = (patch_means(image) for image in images)
    s0 = np.maximum(0.5 * (i0 + i45 + i90 + i135), 1e-9)
    rows, cols = np.indices(s0.shape)
    x, y = cols / s0.shape[1] - 0.5, (rows - 0.5 * s0.shape[0]) / s0.shape[1]
    stack = np.stack([s0, (i0 - i90) / s0, (i45 - i135) / s0, (i0 + i90 - i45 - i135) / s0, x, y])
    group = (rows * 8 // s0.shape[0] * 3 + cols * 8 // s0.shape[1]) % TOL.num_groups
    return np.asarray(stack[:, good].T, np.float64), group[good]


def _quadratic_part(parts: Sequence[tuple[Array, NDArray[np.int64]]]) -> tuple[float, float]:
    """Slope of r over ``q^2 - u^2`` beside all that is linear in q and u, and its deviation."""
    s0, q, u, r, x, y = np.concatenate([rows for rows, _ in parts]).T
    group = np.concatenate([groups for _, groups in parts])
    place = (np.ones_like(x), x, y, x * x, x * y, y * y)
    if not np.std(q * q - u * u) > TOL.min_quadratic:
        return 0.0, np.inf
    columns = [q * q - u * u, *(a * b for a in place for b in (np.ones_like(q), q, u))]
    # r is relative: the fewer photons, the less it says.
    weight = np.sqrt(s0 / s0.max())
    design, right = np.stack(columns, axis=1) * weight[:, None], r * weight
    loss = np.ones_like(r)
    solution = np.zeros(design.shape[1])
    for _ in range(TOL.num_rounds):
        solution = _solve(*_sums(design, right, loss))
        residual = right - design @ solution
        loss = cauchy_weights(np.square(residual / max(robust_deviation(residual), 1e-9)))
    image = np.repeat(np.arange(len(parts)), [len(rows) for rows, _ in parts])
    deviations = []
    for index in (group, image):
        sums = [_sums(*(a[index == k] for a in (design, right, loss))) for k in np.unique(index)]
        matrix, vector = (np.sum(one, axis=0) for one in zip(*sums, strict=True))
        num = len(sums)
        left_out = [_solve(matrix - m, vector - v)[0] for m, v in (sums if num > 1 else ())]
        spread = np.square(np.subtract(left_out, np.mean(left_out or 0.0))).sum()
        deviations.append(np.sqrt((num - 1) / num * spread))
    # Images of different scenes may each show something else: all together say little then.
    return float(solution[0]), float(max(deviations))


def _sums(design: Array, right: Array, loss: Array) -> tuple[Array, Array]:
    """Matrix (M, M) and right side (M,) of the normal equations of some rows, which are sums."""
    weighted = design * loss[:, None]
    return weighted.T @ design, weighted.T @ right


def _solve(matrix: Array, vector: Array) -> Array:
    ridge = 1e-9 * np.trace(matrix) * np.eye(len(matrix))
    return np.asarray(np.linalg.solve(matrix + ridge, vector), np.float64)


def _round_gamma(found: float, log_sigma: float) -> float:
    """The usual gamma that is meant, if one is near; else the one found."""
    usual = (1 / 2.2, 0.5, 1.0, 2.0, 2.2)
    nearest = min(usual, key=lambda value: abs(np.log(value / found)))
    near = abs(np.log(nearest / found)) < max(3 * log_sigma, 0.1)
    return round(nearest if near else found, 2)
