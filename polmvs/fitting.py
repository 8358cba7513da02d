"""Robust weights and thresholds that several fits use."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from polmvs.arrays import Array, Floats, Mask

CAUCHY_SCALE = 2.385  # deviations; 95 % efficiency on normal residuals (Holland & Welsch 1977)
FINAL_ROUNDS = 3  # of an annealed fit, at its final scale
MEDIAN_OF_NORMAL = 0.6745  # median of |x|, x normal of unit deviation
# Of an outlier's residual over the median one. Of normal residuals in one, two and three dimensions
# 5 medians are 3.4, 5.9 and 7.7 deviations.
OUTLIER_RATIO = 5.0
# Deviations of a normal distribution that are not by chance: one of 16,000 is farther, to one side
# one of 30,000.
BEYOND_CHANCE = 4.0


def cauchy_weights(squares: Floats, scale: float | Floats = CAUCHY_SCALE) -> Floats:
    """Least-squares weights of a Cauchy loss, 1 at 0.

    Parameters
    ----------
    squares : squares of residuals over their deviation.
    scale : of the loss, deviations; broadcasts.
    """
    return np.asarray(1.0 / (1.0 + squares / np.square(scale)))


def geman_mcclure_weights(residuals: Floats, square: float | Floats) -> Array:
    """Least-squares weights of the loss of Geman and McClure (1985), 1 at 0.

    Parameters
    ----------
    residuals : in any unit.
    square : of the loss's width, in that unit's square; broadcasts.
    """
    return np.asarray((square / (square + residuals**2)) ** 2)


def annealed_scales(num_rounds: int) -> Iterator[float]:
    """Scales of a Cauchy loss for the rounds of a fit: wide first, halved to ``CAUCHY_SCALE``.

    A wide loss is nearly convex, so the fit finds the minimum on which most data agree.

    Parameters
    ----------
    num_rounds : scales to give; the last ``FINAL_ROUNDS`` are the final one.
    """
    for index in range(num_rounds):
        yield CAUCHY_SCALE * 2.0 ** max(num_rounds - FINAL_ROUNDS - index, 0)


def robust_deviation(residuals: Floats) -> float:
    """Standard deviation of residuals about 0, from their median absolute value; NaN of none."""
    return float(np.median(np.abs(residuals))) / MEDIAN_OF_NORMAL if len(residuals) else np.nan


def like_most(residuals: Floats, *, floor: float, ceiling: float = np.inf) -> Mask:
    """Whether residuals ``(N,)``, none negative, are like those of the majority.

    Parameters
    ----------
    floor, ceiling : a residual below ``floor`` always is, one above ``ceiling`` never is.
    """
    limit = np.clip(OUTLIER_RATIO * np.median(residuals), floor, ceiling)
    return np.asarray(residuals <= limit, np.bool_)
