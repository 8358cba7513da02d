"""Stokes images with their noise, and arithmetic of axial angles.

Noise
-----
The four intensities are redundant: ``r = I0 + I90 - I45 - I135`` is zero but for noise and for
what the four filters see differently. All four are interpolated by the same weights, so
``var(r) = var(s1) + var(s2)``; with a variance linear in the intensity (read and quantisation
noise, and photons) the two are equal: ``var(s1) = var(s2) = a + b s0 = var(r) / 2``, the noise
reduction of the interpolation included. ``a`` and ``b`` are read from the image itself:

1. the variance of r within patches, of which the low quantile of each intensity class is kept
   (smooth patches; texture only adds),
2. the highest line ``a + b s0``, ``a, b >= 0``, under all classes (a textured class only adds).

Where r is larger than such noise explains (edges, texture finer than a cell), s1 and s2 are
wrong by as much, and sigma grows with the local mean of ``r^2 / 2``. Measured on ``board`` against
the phase of the true normals (tilted polarizers, DoLP > 0.1): the median of |error| / sigma_aolp
is 1.06 of a normal distribution's without that term, 0.92 with it, and the share of errors beyond
5 sigma falls from 1.6 % to 0.3 %.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.polarization.mosaic import INTERPOLATION_NOISE_GAIN

Image: TypeAlias = NDArray[np.float32]
Mask: TypeAlias = NDArray[np.bool_]
Angles: TypeAlias = NDArray[np.floating[Any]]

UNIFORM_SIGMA = np.pi / np.sqrt(12.0)  # deviation of an axial angle of which nothing is known, rad
PATCH_PX = 8
PATCH_QUANTILE = 0.1
# The quantile of the variance of 8x8 px of bilinearly interpolated white noise, over the true
# variance (simulated with 65,000 patches).
PATCH_QUANTILE_OF_NOISE = 0.721
MIN_PATCHES = 40
TINY = 1e-20  # keeps noise-free black images from a division by zero
MAX_CLASSES = 12
MISMATCH_WINDOW_PX = 5
# Local mean of r^2 over its expectation from which it is not noise: exceeded by chance at 0.7 %.
MISMATCH_RATIO = 2.0


@dataclass(frozen=True, kw_only=True, eq=False)
class Stokes:
    """Linear Stokes images of one view; intensities in units of full scale.

    Attributes
    ----------
    s0 : (H, W) float32, total intensity, half the sum of the four angle images: 0 to 2.
    s1, s2 : (H, W) float32, ``I0 - I90`` and ``I45 - I135``.
    sigma : (H, W) float32, standard deviation of s1 and of s2. The errors of neighbouring pixels
        correlate (0.3 at a distance of one), as interpolation makes them.
    valid : (H, W) bool, False where a contributing sample is clipped or the pixel is dark.
    """

    s0: Image
    s1: Image
    s2: Image
    sigma: Image
    valid: Mask

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.s0.shape[0], self.s0.shape[1]

    @property
    def aolp(self) -> Image:
        """Angle of linear polarization (H, W), rad in [0, pi), anticlockwise from +x as shown."""
        return np.asarray(_wrap(0.5 * np.arctan2(self.s2, self.s1)), np.float32)

    @property
    def dolp(self) -> Image:
        """Degree of linear polarization (H, W), 0 where s0 is; noise can push it above 1."""
        polarized = np.hypot(self.s1, self.s2)
        return np.divide(polarized, self.s0, out=np.zeros_like(self.s0), where=self.s0 > 0)

    @property
    def sigma_aolp(self) -> Image:
        """Standard deviation of the angle (H, W), rad, at most that of a uniform axial angle."""
        twice = 2.0 * np.hypot(self.s1, self.s2)
        unknown = np.full_like(self.sigma, UNIFORM_SIGMA)
        sigma = np.divide(self.sigma, twice, out=unknown, where=twice > 0)
        return np.minimum(sigma, np.float32(UNIFORM_SIGMA))


class NoiseModel(NamedTuple):
    """Variance of s1 and of s2 in smooth areas: ``constant + slope * s0``."""

    constant: float
    slope: float

    def variance(self, s0: Image) -> Image:
        """Variance (H, W) at the intensities ``s0``."""
        return np.asarray(self.constant + self.slope * np.maximum(s0, 0), np.float32)


def stokes_from_intensities(
    intensities: Image, clipped: Mask, *, darkness: float = 0.004, quantum: float = 1 / 255
) -> Stokes:
    """Stokes images and their noise from four angle images.

    Parameters
    ----------
    intensities : (4, H, W) float32, linear, units of full scale; 0, 45, 90, 135 degrees, as
        :func:`polmvs.polarization.mosaic.split_mosaic` makes them.
    clipped : (H, W) bool, True where a clipped sample contributes.
    darkness : mean of the four under which a pixel counts as dark, share of full scale.
    quantum : step of a raw sample, share of full scale; the noise is at least its rounding.
    """
    if intensities.ndim != 3 or intensities.shape[0] != 4:
        raise ValueError(f"{intensities.shape=} but expected (4, H, W).")
    if clipped.shape != intensities.shape[1:]:
        raise ValueError(f"{clipped.shape=} but expected {intensities.shape[1:]}.")
    i0, i45, i90, i135 = np.asarray(intensities, np.float32)
    even, odd = i0 + i90, i45 + i135
    s0 = np.float32(0.5) * (even + odd)
    valid = ~clipped & (s0 >= 2.0 * darkness)
    redundancy = even - odd
    noise = estimate_noise(s0, redundancy, valid, quantum=quantum)
    variance = noise.variance(s0)
    variance += _mismatch_variance(s0, redundancy, valid, variance)
    return Stokes(s0=s0, s1=i0 - i90, s2=i45 - i135, sigma=np.sqrt(variance), valid=valid)


def estimate_noise(s0: Image, redundancy: Image, valid: Mask, *, quantum: float) -> NoiseModel:
    """Noise of s1 and s2 from the redundancy of one image; see the head of this module.

    Parameters
    ----------
    s0, redundancy : (H, W) float32, ``redundancy = I0 + I90 - I45 - I135``.
    valid : (H, W) bool, pixels to learn from. With fewer than 40 patches of 8x8 px of them only
        the rounding of the samples is known, and returned.
    quantum : step of a raw sample, share of full scale.
    """
    floor = 2.0 * INTERPOLATION_NOISE_GAIN * quantum**2 / 12.0
    usable = _patches(valid).all(axis=(1, 3))
    if np.count_nonzero(usable) < MIN_PATCHES:
        return NoiseModel(floor, 0.0)
    level = _patches(s0).mean(axis=(1, 3))[usable]
    spread = _patches(redundancy).var(axis=(1, 3), dtype=np.float64)[usable]
    order = np.argsort(level)
    classes = np.array_split(order, min(MAX_CLASSES, len(order) // MIN_PATCHES))
    levels = np.array([level[members].mean() for members in classes], np.float64)
    quantiles = np.array([np.quantile(spread[members], PATCH_QUANTILE) for members in classes])
    variances = np.maximum(quantiles / (2.0 * PATCH_QUANTILE_OF_NOISE), max(floor, TINY))
    constant, slope = _highest_line_under(np.maximum(levels, TINY), variances)
    return NoiseModel(max(constant, floor), slope)


def axial_difference(a: Angles, b: Angles) -> NDArray[np.float64]:
    """Signed difference ``a - b`` of axial angles, rad in [-pi/2, pi/2); shapes broadcast."""
    difference = np.subtract(a, b, dtype=np.float64)
    return np.asarray(_wrap(difference + 0.5 * np.pi) - 0.5 * np.pi)


def axial_mean(
    angles: Angles, weights: Angles | None = None, axis: int | tuple[int, ...] | None = None
) -> NDArray[np.float64]:
    """Mean of axial angles through ``(cos 2x, sin 2x)``.

    Parameters
    ----------
    angles : (...), rad
    weights : as ``angles`` or broadcastable, not negative; None weighs all alike.
    axis : averaged axes, all where it is None.

    Returns
    -------
    Angles in [0, pi), rad, without the averaged axes; NaN where the angles cancel out or no
    weight is left.
    """
    doubled = 2.0 * np.asarray(angles, np.float64)
    weight = np.ones(()) if weights is None else np.asarray(weights, np.float64)
    weight = np.broadcast_to(weight, doubled.shape)
    x = np.sum(weight * np.cos(doubled), axis=axis)
    y = np.sum(weight * np.sin(doubled), axis=axis)
    known = np.hypot(x, y) > 1e-12 * np.sum(weight, axis=axis)
    return np.where(known, _wrap(0.5 * np.arctan2(y, x)), np.nan)


def _wrap(angle: Any) -> Any:
    """An axial angle to [0, pi), in its own precision."""
    wrapped = np.mod(angle, np.pi)
    # A tiny negative angle rounds to pi itself.
    return np.where(wrapped >= np.pi, 0, wrapped)


def _patches(image: NDArray[Any]) -> NDArray[Any]:
    """View an image as (rows, PATCH_PX, cols, PATCH_PX), the rest at its far sides left out."""
    rows, cols = image.shape[0] // PATCH_PX, image.shape[1] // PATCH_PX
    whole = image[: rows * PATCH_PX, : cols * PATCH_PX]
    return whole.reshape(rows, PATCH_PX, cols, PATCH_PX)


def _highest_line_under(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float]:
    """Line ``a + b x``, ``a, b >= 0``, that nowhere exceeds y and relative to it is highest.

    The optimum of that linear program touches two of the points or of the bounds on a and b.
    """
    lines = [(float(y.min()), 0.0), (0.0, float((y / x).min()))]
    for i, j in combinations(range(len(x)), 2):
        if x[i] != x[j]:
            slope = (y[j] - y[i]) / (x[j] - x[i])
            lines.append((float(y[i] - slope * x[i]), float(slope)))
    candidates = np.array([line for line in lines if min(line) >= 0])
    relative = (candidates[:, :1] + candidates[:, 1:] * x) / y
    under = np.all(relative <= 1.0 + 1e-9, axis=1)
    best = np.argmax(np.where(under, relative.sum(axis=1), -1.0))
    return float(candidates[best, 0]), float(candidates[best, 1])


def _mismatch_variance(s0: Image, redundancy: Image, valid: Mask, noise: Image) -> Image:
    """Variance of s1 and s2 beyond the noise, from the redundancy about each pixel (H, W).

    The share of s0 by which the four filters disagree over the whole image (gains, 2 % on real
    sensors) is taken out first: it is no error of this pixel.
    """
    offset = 0.0
    # One pixel in four is plenty for a median.
    sample = (slice(None, None, 2), slice(None, None, 2))
    lit = valid[sample] & (s0[sample] > 0)
    if lit.any():
        offset = float(np.median(redundancy[sample][lit] / s0[sample][lit]))
    squared = np.square(redundancy - np.float32(offset) * s0)
    local = cv2.blur(squared, (MISMATCH_WINDOW_PX, MISMATCH_WINDOW_PX))
    return np.maximum(np.float32(0.5) * local - np.float32(MISMATCH_RATIO) * noise, 0)
