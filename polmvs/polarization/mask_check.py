"""Check that a user's mask ends where the polarized surface ends, not within it.

A mask of only the top of a part excludes the sides, which are also polarized. The surface of all
views is closed, so it has sides, where the masks allow none. It then bends and frays along the edge
of the top.
"""

from __future__ import annotations

import cv2
import numpy as np

from polmvs.arrays import Mask
from polmvs.polarization.region import RegionTolerances, smooth
from polmvs.polarization.stokes import Stokes

# Width of the band outside of the mask: polarization leaks by twice the smoothing's width.
BAND_SIGMAS = (2.0, 3.0)
# Measured, means over views of true masks: 0.000 to 0.001 of `dome`, `mug`, `step` and eight
# simulated domes and mugs; 0.08 and 0.17 where they hold the top of a slab alone. The limit is a
# guess in the gap.
MAX_CUT_SHARE = 0.03


def cut_share(stokes: Stokes, mask: Mask, *, min_dolp: float) -> float:
    """Share of the band around a mask that is polarized like a surface; NaN without a band.

    Parameters
    ----------
    stokes : of the view.
    mask : (H, W) bool
    min_dolp : as of :func:`polmvs.polarization.region.find_region`.
    """
    width_px = RegionTolerances.smoothing_px
    inner, outer = (sigmas * width_px for sigmas in BAND_SIGMAS)
    distance = cv2.distanceTransform((~mask).astype(np.uint8), cv2.DIST_L2, 5)
    band = (distance > inner) & (distance <= outer)
    if not mask.any() or not band.any():
        return float("nan")
    intensity = np.maximum(smooth(stokes.s0, width_px), 1e-6)
    axial = smooth(np.dstack([stokes.s1, stokes.s2]), width_px)
    polarized = np.hypot(axial[..., 0], axial[..., 1]) > min_dolp * intensity
    return float((polarized & stokes.valid)[band].mean())
