"""How far a surface's outlines are from those that views see, and what this says of its range."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

# Outlines err by half a pixel. A crease that is missed puts one some pixels outside, always to the
# same side: a wider loss would be drawn there.
FINE_SCALE_PX = 1.0
OUTLINE_BIAS_PX = 0.5  # all outlines may lie this much too far outside


@dataclass(frozen=True)
class Misfit:
    """Distances of the points of a surface's outlines from those of the pieces that show it.

    Attributes
    ----------
    error : (P,) px, signed, positive outside the piece.
    slope : (P,) px per unit of log range.
    weight : (P,), points of a sparse sampling count for several.
    view, stretch : (P,), view that the point is seen in; part of the outline that it belongs to.
    matched : (K,), index of the piece in each view that shows the surface; -1: none.
    """

    error: Array
    slope: Array
    weight: Array
    view: Indices
    stretch: Indices
    matched: Indices

    def balancing_step(self) -> float:
        """Step of the log-range at which the reweighted errors balance."""
        weight = self._robust_weight()
        information = (weight * self.slope**2).sum()
        pull = (weight * self.slope * self.error).sum()
        return float(-pull / information) if information > 0 else 0.0

    def sigma(self) -> float:
        """Standard deviation of the log-range at which the errors balance.

        Errors of one view's outline are alike, and so are those of a stretch of the piece's own
        outline in all views: the variance is that of sums over either, not over points. Added is
        what a common bias of all outlines does: on a surface seen whole, little.
        """
        weight = self._robust_weight()
        information = (weight * self.slope**2).sum()
        if not information > 0:
            return float(np.inf)
        pull = weight * self.slope * self.error
        variance = 0.0
        for groups in (self.view, self.stretch):
            sums = np.bincount(np.unique(groups, return_inverse=True)[1], pull)
            variance += float((sums**2).sum() * len(sums) / max(len(sums) - 1, 1))
        bias = OUTLINE_BIAS_PX * (weight * self.slope).sum()
        return float(np.sqrt(variance + bias**2) / information)

    def _robust_weight(self) -> Array:
        return np.asarray(self.weight / (1 + (self.error / FINE_SCALE_PX) ** 2) ** 2)

    def support(self, scale_px: float) -> float:
        """Number of points that meet an outline, softly counted."""
        return float(self.weight.sum() * (1 - self.cost(scale_px)))

    def cost(self, scale_px: float) -> float:
        """Mean of the bounded loss ``e^2 / (e^2 + scale^2)``; 1 where there is no point."""
        total = self.weight.sum()
        loss = self.error**2 / (self.error**2 + scale_px**2)
        return float((self.weight * loss).sum() / total) if total > 0 else 1.0
