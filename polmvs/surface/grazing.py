"""Bias of outlines that are found by brightness.

At grazing incidence a smooth surface mirrors the background directly behind it. The share of a
pixel's light that differs from the background is

    a = (1 - F(theta)) * coverage,     sin(theta) = 1 - d / r

with the Fresnel reflectance F, the distance d from the outline, the radius of curvature r of the
surface along the line of sight, and coverage 1 on the object and 0 beside it. The share falls to 0
at the outline, for any colour of surface and background. So the detected outline lies within the
true one.
"""

from __future__ import annotations

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from polmvs.surface.matting import MattingTolerances

Array = NDArray[np.float64]
Floats = NDArray[np.floating]

INDEX = 1.5  # refractive index; 1.4 and 1.7 change the bias by 5 %
BLUR_PX = 0.8  # deviation of the blur of optics, demosaicing and the smoothing before an edge
STEP_PX = 0.02
REACH_PX = 12.0
RADII_PX = np.geomspace(0.5, 1000, 24)
DISTANCE = np.arange(-REACH_PX, REACH_PX, STEP_PX)  # outside of the outline


def outline_bias(radius_px: Floats, *, matted: bool) -> Array:
    """Largest distance (K,), px, by which outlines lie within the true ones.

    It holds where the surface mirrors a background as bright as the one beside it, and is smaller
    elsewhere, such as beside a shadow.

    Parameters
    ----------
    radius_px : (K,) radius of curvature of the surface along the line of sight.
    matted : of outlines from matting (:mod:`polmvs.surface.matting`); else of those where the
        brightness changes most, as masks of photographs have them.
    """
    radii = np.log(np.clip(radius_px, RADII_PX[0], RADII_PX[-1]))
    biases = _matting_biases() if matted else _edge_biases()
    return np.asarray(np.interp(radii, np.log(RADII_PX), biases))


@cache
def _edge_biases() -> Array:
    """Bias for each of ``RADII_PX``: how far inside the brightness changes most."""
    steepest = [ndimage.gaussian_filter1d(_share(r), BLUR_PX / STEP_PX, order=1) for r in RADII_PX]
    return np.array([-DISTANCE[np.argmin(slope)] for slope in steepest])


@cache
def _matting_biases() -> Array:
    """Bias for each of ``RADII_PX``: what the integral of alpha lacks."""
    tol = MattingTolerances()
    weight = np.exp(-0.5 * (DISTANCE / tol.blend_px) ** 2) * (tol.core_px < -DISTANCE)
    near = (DISTANCE < 0) & (tol.reach_px > -DISTANCE)
    found = []
    for radius in RADII_PX:
        share = _share(radius)
        slope, level = np.polyfit(DISTANCE, share, 1, w=np.sqrt(weight))
        alpha = share / (level + slope * DISTANCE)
        found.append(STEP_PX * (1 - np.clip(alpha[near], 0, 1)).sum())
    return np.array(found)


def _share(radius_px: float) -> Array:
    """Share of a pixel's light that differs from the background, at each of ``DISTANCE``."""
    sine = np.clip(1 + DISTANCE / radius_px, 0, 1)
    return np.asarray(np.where(DISTANCE < 0, 1 - _reflectance(sine), 0.0))


def _reflectance(sine: Array) -> Array:
    """Reflectance for unpolarized light, by the sine of the angle of incidence (Fresnel)."""
    cosine, refracted = np.sqrt(1 - sine**2), np.sqrt(1 - (sine / INDEX) ** 2)
    across = (cosine - INDEX * refracted) / (cosine + INDEX * refracted)
    within = (INDEX * cosine - refracted) / (INDEX * cosine + refracted)
    return np.asarray(0.5 * (across**2 + within**2))
