"""Statistics of errors that are gathered view by view, and the same for any list of errors."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Counts = NDArray[np.int64]

BIN_DEG = 0.01  # of the histogram that percentiles are read from
NUM_BINS = round(90 / BIN_DEG)


@dataclass(frozen=True, kw_only=True)
class SignedStats:
    """Statistics of signed errors; NaN where there are none.

    Attributes
    ----------
    mean_deg : of the signed errors, as in the paper.
    mean_abs_deg, rmse_deg, median_deg, p95_deg : of their absolute values; the last two to 0.01.
    num_pixels : how many.
    """

    mean_deg: float
    mean_abs_deg: float
    rmse_deg: float
    median_deg: float
    p95_deg: float
    num_pixels: int


@dataclass(frozen=True)
class ErrorTally:
    """Sums of signed axial errors, from which their statistics follow; tallies add up.

    Attributes
    ----------
    sums : (3,), of the errors, their absolute values and their squares, degrees.
    counts : (9000,), errors in bins of 0.01 degrees of their absolute value.
    """

    sums: NDArray[np.float64]
    counts: Counts

    @classmethod
    def of(cls, errors_deg: Floats) -> ErrorTally:
        """Tally of errors of any shape, -90 to 90 degrees; NaN are left out."""
        errors = np.asarray(errors_deg, np.float64).ravel()
        errors = errors[np.isfinite(errors)]
        sizes = np.abs(errors)
        bins = np.minimum((sizes / BIN_DEG).astype(np.int64), NUM_BINS - 1)
        sums = np.array([errors.sum(), sizes.sum(), (errors**2).sum()])
        return cls(sums, np.bincount(bins, minlength=NUM_BINS))

    def __add__(self, other: ErrorTally) -> ErrorTally:
        """Tally of both sets of errors."""
        return ErrorTally(self.sums + other.sums, self.counts + other.counts)

    def stats(self) -> SignedStats:
        """Statistics of all errors tallied."""
        num = int(self.counts.sum())
        mean, mean_abs, mean_square = self.sums / num if num else np.full(3, np.nan)
        return SignedStats(
            mean_deg=float(mean),
            mean_abs_deg=float(mean_abs),
            rmse_deg=float(np.sqrt(mean_square)),
            median_deg=self._quantile(0.5),
            p95_deg=self._quantile(0.95),
            num_pixels=num,
        )

    def _quantile(self, share: float) -> float:
        """Absolute error that a share of all errors stays under, linear within a bin."""
        cumulative = np.cumsum(self.counts)
        if cumulative[-1] == 0:
            return float("nan")
        target = share * cumulative[-1]
        index = int(np.searchsorted(cumulative, target))
        before = cumulative[index - 1] if index else 0
        return float(BIN_DEG * (index + (target - before) / max(self.counts[index], 1)))


def ratio(numerator: float, denominator: float) -> float:
    """Quotient, NaN where the denominator is 0 or unknown."""
    return numerator / denominator if denominator > 0 else float("nan")
