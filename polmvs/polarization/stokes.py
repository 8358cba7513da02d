"""Stokes images with their noise, and arithmetic of axial angles.

Noise
-----
The four intensities are redundant: ``r = I0 + I90 - I45 - I135`` is zero except for noise and for
differences between the scene points of the four samples. All four are interpolated with the same
weights, so ``var(r) = var(s1) + var(s2)``; with a variance linear in the intensity (read and
quantisation noise, and photons) the two are equal: ``var(s1) = var(s2) = a + b s0 = var(r) / 2``,
the noise reduction of the interpolation included. ``a`` and ``b`` are estimated from the image:

1. take the variance of r within patches, and of each intensity class a low quantile of it (smooth
   patches: texture only adds variance),
2. take the highest line ``a + b s0``, ``a, b >= 0``, below the values of all classes (texture only
   adds variance).

Where r exceeds this noise (edges, texture finer than a cell), s1 and s2 have errors of the same
size, and sigma grows with the local mean of ``r^2 / 2``. Measured on ``board`` against
the phase of the true normals (tilted polarizers, DoLP > 0.1): the median of
``|error| / sigma_aolp`` is 1.06 times that of a normal distribution without this term and 0.92
times with it, and the share of errors beyond 5 sigma falls from 1.6 % to 0.3 %.

n images through polarizers at known angles leave n - 3 redundant combinations, which are used in
the same way. Three images, or Stokes images made elsewhere, leave none; their noise is estimated
from second differences of pixels two apart: neighbours that were interpolated from a mosaic share
samples, and differ by only 0.36 of the variance.

Images that are not from a mosaic may have ``r = 0`` at an edge and still mix the light of its two
sides, as may images that were interpolated from a mosaic. There sigma grows with the component of
the second differences that is perpendicular to ``(s1, s2)``, because a mere change of brightness
does not turn the phase. With this, a capture has the same weights in every format
(`tests/compare_formats.py`); without it, OPA's Chamfer distance on the demo differs by 5 to 13 %.

Gains
-----
Polarizer channels differ in gain, by some percent on real sensors. A capture divides by those that
unpolarized light shows (``polmvs.polarization.angle_gains``). All pixels share the error that
is left and no smoothing reduces it, so it is separate from ``sigma``: ``gain_sigma``. If no light
is clearly unpolarized, the misfit tells how large the gains may be: ``1 + e_k`` of equal spread
make ``r / s0 = (e0 + e90 - e45 - e135) / 2`` in unpolarized light, and independent of it
``(e0 - e90) / 2`` and ``(e45 - e135) / 2`` of s0 in s1 and s2, each with the spread of r / s0 over
sqrt(2). With one (n - 3) such known value, the error has Student's distribution. Polarized light
would show a second combination of gains. It is not used, because oblique rays in the polarizers
have the same effect. Measured with gains of 2 % spread on rendered
captures: without this term the error of the AoLP is within one sigma for 33 % of the pixels; the
test ``test_sigma_covers_gain_errors`` has the value with it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any, NamedTuple, TypeAlias

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.special import stdtrit

from polmvs.arrays import Image, Mask
from polmvs.config import CaptureOptions, RegionOptions
from polmvs.polarization.kinds import Light
from polmvs.polarization.lossy import BLOCK
from polmvs.polarization.mosaic import INTERPOLATION_NOISE_GAIN
from polmvs.polarization.rounding import shared_rounding

Angles: TypeAlias = NDArray[np.floating[Any]]

UNIFORM_SIGMA = np.pi / np.sqrt(12.0)  # deviation of a uniformly distributed axial angle, rad
PATCH_PX = 8
PATCH_QUANTILE = 0.1
# The quantile of the variance of 8x8 px of bilinearly interpolated white noise, over the true
# variance (simulated with 65,000 patches).
PATCH_QUANTILE_OF_NOISE = 0.721
PATCH_QUANTILE_OF_WHITE = 0.768  # the same of white noise
# The same of its second differences along both axes, of two images together.
PATCH_QUANTILE_OF_CURVATURE = 0.74
CURVATURE_SPACING_PX = 2  # distance at which pixels share no samples of a mosaic
ONE_SIGMA = 0.8413  # one-sided probability of one standard deviation
MIN_SAMPLES = 40  # patches of a class, or pixels, for their quantile or median to be one
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
    sigma : (H, W) float32, standard deviation of s1 and of s2. Interpolation correlates the errors
        of neighbouring pixels (0.3 at a distance of one).
    valid : (H, W) bool, False where a contributing sample is clipped or the pixel is dark.
    gain_sigma : standard deviation of s1 and of s2 by different gains of the polarizer channels,
        which all pixels share, share of s0.
    lossy_sigma : the part of ``sigma`` by lossy compression, which the pixels of a block share.
    lossy_block_px : side of such a block, px; by default at half the resolution of the samples.
    rounding : (H, W) float32, variance of s1 and of s2 by rounding that neighbours share, in
        addition to ``sigma`` (see ``polmvs.polarization.rounding``); None: noise dithers it.
    noise_area_px : pixels that share the rest of the noise, by interpolation; see
        :func:`polmvs.polarization.mosaic.noise_area_px`.
    """

    s0: Image
    s1: Image
    s2: Image
    sigma: Image
    valid: Mask
    gain_sigma: float = 0.0
    lossy_sigma: float = 0.0
    lossy_block_px: float = BLOCK / 2
    noise_area_px: float = 1.0
    rounding: Image | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return self.s0.shape[0], self.s0.shape[1]

    @property
    def aolp(self) -> Image:
        """Angle of linear polarization (H, W), rad in [0, pi), anticlockwise from +x as shown."""
        return np.asarray(wrap_axial(0.5 * np.arctan2(self.s2, self.s1)), np.float32)

    def phase(self, light: Light | str = Light.SPECULAR) -> Image:
        """Direction in which the plane of incidence cuts the image (H, W), rad in [0, pi).

        Parameters
        ----------
        light : dominant kind of light; specular light turns the phase by pi/2 from the AoLP.
        """
        turn = np.float32(0.5 * np.pi if Light(light) is Light.SPECULAR else 0.0)
        return np.asarray(wrap_axial(self.aolp + turn), np.float32)

    @property
    def dolp(self) -> Image:
        """Degree of linear polarization (H, W), 0 where s0 is; noise can push it above 1."""
        polarized = np.hypot(self.s1, self.s2)
        return np.divide(polarized, self.s0, out=np.zeros_like(self.s0), where=self.s0 > 0)

    @property
    def sigma_aolp(self) -> Image:
        """Standard deviation of the AoLP (H, W), rad, at most that of a uniform axial angle."""
        twice = 2.0 * np.hypot(self.s1, self.s2)
        unknown = np.full_like(self.sigma, UNIFORM_SIGMA)
        total = self.sigma
        if self.gain_sigma > 0:
            total = np.hypot(self.sigma, np.float32(self.gain_sigma) * self.s0)
        sigma = np.divide(total, twice, out=unknown, where=twice > 0)
        return np.minimum(sigma, np.float32(UNIFORM_SIGMA))


class NoiseModel(NamedTuple):
    """Variance of s1 and of s2 in smooth areas: ``constant + slope * s0``.

    ``raised`` is the increase of the constant to the variance of rounding.
    """

    constant: float
    slope: float
    raised: float = 0.0

    def variance(self, s0: Image) -> Image:
        """Variance (H, W) at the intensities ``s0``."""
        variance = np.maximum(s0, np.float32(0))
        variance *= np.float32(self.slope)
        variance += np.float32(self.constant)
        return np.asarray(variance, np.float32)


def stokes_from_intensities(
    intensities: Image,
    clipped: Mask,
    *,
    darkness: float = CaptureOptions.darkness,
    quantum: float = 1 / 255,
    lossy_variance: float = 0.0,
    gain_sigma: float | None = None,
) -> Stokes:
    """Stokes images and their noise from four angle images.

    Parameters
    ----------
    intensities : (4, H, W) float32, linear, units of full scale; 0, 45, 90, 135 degrees, as
        :func:`polmvs.polarization.mosaic.split_mosaic` makes them.
    clipped : (H, W) bool, True where a clipped sample contributes.
    darkness : mean of the four below which a pixel counts as dark, share of full scale.
    quantum : step of a raw sample, share of full scale; the noise is at least its rounding.
    lossy_variance : of s1 and s2 by lossy compression, which the redundancy does not show.
    gain_sigma : deviation of s1 and of s2 by different gains, share of s0; None: as the redundancy
        shows it.
    """
    if intensities.ndim != 3 or intensities.shape[0] != 4:
        raise ValueError(f"{intensities.shape=} but expected (4, H, W).")
    if clipped.shape != intensities.shape[1:]:
        raise ValueError(f"{clipped.shape=} but expected {intensities.shape[1:]}.")
    i0, i45, i90, i135 = np.asarray(intensities, np.float32)
    # Memory for new arrays takes half of the time of a frame, so arrays are reused.
    even, odd = i0 + i90, i45 + i135
    redundancy = even - odd
    even += odd
    s0 = np.multiply(even, np.float32(0.5), out=even)
    s1, s2 = np.subtract(i0, i90, out=odd), i45 - i135
    valid = s0 >= np.float32(2.0 * darkness)
    valid &= ~clipped
    # Of s1 and s2, two samples each, by rounding alone.
    floor = 2.0 * INTERPOLATION_NOISE_GAIN * quantum**2 / 12.0
    noise = estimate_noise(s0, redundancy, valid, floor=floor)
    if gain_sigma is None:
        gain_sigma = _gain_sigma(s0, s1, s2, redundancy[None], valid)
    variance = noise.variance(s0)
    variance += _mismatch_variance(s0, redundancy, valid, variance)
    if lossy_variance > 0:
        variance += np.float32(lossy_variance)
    sigma = np.sqrt(variance, out=variance)
    return Stokes(
        s0=s0,
        s1=s1,
        s2=s2,
        sigma=sigma,
        valid=valid,
        gain_sigma=gain_sigma,
        lossy_sigma=float(np.sqrt(lossy_variance)),
        rounding=_shared_rounding(
            intensities, valid, noise, quantum, gain=2.0, interpolation=INTERPOLATION_NOISE_GAIN
        ),
    )


def ideal_analyzers(angles_deg: ArrayLike) -> NDArray[np.float64]:
    """Rows ``(n, 3)`` of ideal polarizers: ``I = row . (s0, s1, s2)``, by Malus' law."""
    twice = 2.0 * np.radians(np.asarray(angles_deg, np.float64))
    return 0.5 * np.stack([np.ones_like(twice), np.cos(twice), np.sin(twice)], axis=-1)


def stokes_by_least_squares(
    intensities: Image,
    analyzers: NDArray[np.floating[Any]],
    clipped: Mask,
    *,
    darkness: float = CaptureOptions.darkness,
    quantum: float = 1 / 255,
    interpolated: bool = False,
    lossy_variance: float = 0.0,
    gain_sigma: float | None = None,
) -> Stokes:
    """Stokes images and their noise from images behind any three or more analyzers.

    Parameters
    ----------
    intensities : (n, H, W) float32, linear, units of full scale.
    analyzers : (n, 3), or (n, 3, H, W) where they differ from pixel to pixel; see
        :func:`ideal_analyzers`.
    clipped : (H, W) bool, True where a clipped sample contributes.
    darkness, quantum, lossy_variance, gain_sigma : see :func:`stokes_from_intensities`.
    interpolated : the images are bilinear interpolations of a mosaic.

    Raises
    ------
    ValueError
        The analyzers do not determine the Stokes parameters.
    """
    num = len(intensities)
    if intensities.ndim != 3 or analyzers.shape[:2] != (num, 3) or num < 3:
        raise ValueError(f"{intensities.shape=}, {analyzers.shape=} but expected (n, H, W), (n, 3)")
    mean = analyzers if analyzers.ndim == 2 else analyzers.mean(axis=(2, 3))
    values = np.linalg.svd(np.asarray(mean, np.float64), compute_uv=False)
    if values[2] < 1e-3 * values[0]:
        raise ValueError("the analyzers do not determine the Stokes parameters.")
    inverse = np.linalg.pinv(mean)
    gain = _noise_gain(inverse)
    flat = np.asarray(intensities, np.float32).reshape(num, -1)
    shape = intensities.shape[1:]
    residual = flat
    if analyzers.ndim == 2:
        s0, s1, s2 = (inverse.astype(np.float32) @ flat).reshape(3, *shape)
    else:
        rows = np.moveaxis(np.asarray(analyzers, np.float32).reshape(num, 3, -1), -1, 0)
        normal = np.swapaxes(rows, 1, 2) @ rows
        right = np.swapaxes(rows, 1, 2) @ flat.T[..., None]
        solved = np.linalg.solve(normal, right)
        residual = flat - (rows @ solved)[..., 0].T
        s0, s1, s2 = np.ascontiguousarray(solved[..., 0].T).reshape(3, *shape)
    valid = ~clipped & (s0 >= 2.0 * darkness) & np.isfinite(s0)
    redundancy = (null_space(mean).astype(np.float32) @ residual).reshape(num - 3, *shape)
    interpolation = INTERPOLATION_NOISE_GAIN if interpolated else 1.0
    floor = gain * interpolation * quantum**2 / 12.0
    noise, variance = _variance(s0, s1, s2, redundancy, valid, floor, interpolated=interpolated)
    if gain_sigma is None:
        gain_sigma = _gain_sigma(s0, s1, s2, redundancy, valid)
    sigma = np.sqrt(variance + np.float32(lossy_variance))
    return Stokes(
        s0=s0,
        s1=s1,
        s2=s2,
        sigma=sigma,
        valid=valid,
        gain_sigma=gain_sigma,
        lossy_sigma=float(np.sqrt(lossy_variance)),
        rounding=_shared_rounding(
            intensities, valid, noise, quantum, gain=gain, interpolation=interpolation
        ),
    )


def null_space(analyzers: NDArray[np.floating[Any]]) -> NDArray[np.float64]:
    """Combinations (n - 3, n) of n images that are 0 whatever the light.

    Scaled so that their variance is twice that of s1 and s2, as ``I0 + I90 - I45 - I135`` is.
    """
    u = np.linalg.svd(np.asarray(analyzers, np.float64))[0]
    return np.asarray(np.sqrt(2.0 * _noise_gain(np.linalg.pinv(analyzers))) * u[:, 3:].T)


def _noise_gain(inverse: NDArray[np.floating[Any]]) -> float:
    """Variance of s1 and s2 over that of the images, which an inverse (3, n) combines."""
    return float(np.linalg.eigvalsh(inverse[1:] @ inverse[1:].T)[-1])


def _shared_rounding(
    intensities: Image,
    valid: Mask,
    noise: NoiseModel,
    quantum: float,
    *,
    gain: float,
    interpolation: float,
) -> Image | None:
    """Variance of s1 and s2 by rounding that neighbours share, from that of s1 and s2 in all."""
    scale = gain * interpolation
    found = shared_rounding(
        intensities,
        valid,
        constant=(noise.constant - noise.raised) / scale - quantum**2 / 12.0,
        slope=2.0 * noise.slope / scale,
        quantum=quantum,
    )
    return None if found is None else np.float32(gain) * found


def stokes_from_maps(
    s0: Image, s1: Image, s2: Image, valid: Mask, *, quantum: float = 0.0
) -> Stokes:
    """Stokes images that were made elsewhere, with noise estimated from them.

    Parameters
    ----------
    s0, s1, s2 : (H, W) float32, linear, units of full scale.
    valid : (H, W) bool
    quantum : step of their values, share of full scale.
    """
    images = [np.asarray(image, np.float32) for image in (s0, s1, s2)]
    none = np.empty((0, *images[0].shape), np.float32)
    planes = (images[0], images[1], images[2])
    _, variance = _variance(*planes, none, valid, quantum**2 / 12.0, interpolated=False)
    return Stokes(s0=planes[0], s1=planes[1], s2=planes[2], sigma=np.sqrt(variance), valid=valid)


def turned_axes(stokes: Stokes, *, zero_deg: float = 0.0, clockwise: bool = False) -> Stokes:
    """Convert Stokes images whose angles have another zero direction or sense.

    Parameters
    ----------
    zero_deg : their zero direction, anticlockwise from +x as displayed.
    clockwise : their angles are clockwise as displayed.
    """
    if not clockwise and zero_deg == 0:
        return stokes
    s2 = -stokes.s2 if clockwise else stokes.s2
    cos, sin = (np.float32(f(2 * np.radians(zero_deg))) for f in (np.cos, np.sin))
    return replace(stokes, s1=cos * stokes.s1 - sin * s2, s2=sin * stokes.s1 + cos * s2)


def combine(images: list[Stokes]) -> Stokes:
    """Sum of the Stokes images of several colours, weighted by their polarized intensity and noise.

    Each colour has one weight for the whole image, so that s0 stays an intensity: polarized
    intensity over variance, which maximizes the ratio of the two in the sum (matched filter). The
    weights sum to one. A pixel is valid if it is valid in every colour with weight. Noise is
    independent between colours; the mixed light of edges is common to them, and the sum shows it.
    """
    strengths = []
    for stokes in images:
        used = stokes.valid
        if not used.any():
            strengths.append(0.0)
            continue
        polarized = float(np.mean(np.hypot(stokes.s1[used], stokes.s2[used])))
        strengths.append(polarized / max(float(np.mean(np.square(stokes.sigma[used]))), TINY))
    total = sum(strengths)
    weights = [s / total if total > 0 else 1 / len(images) for s in strengths]
    used_images = [(w, image) for w, image in zip(weights, images, strict=True) if w > 0]

    def summed(name: str) -> Image:
        return np.asarray(sum(np.float32(w) * getattr(s, name) for w, s in used_images), np.float32)

    s0, s1, s2 = summed("s0"), summed("s1"), summed("s2")
    valid = np.logical_and.reduce([s.valid for _, s in used_images])
    own = sum(np.float32(w) ** 2 * np.square(s.sigma) for w, s in used_images)
    none = np.empty((0, *s0.shape), np.float32)
    _, shown = _variance(s0, s1, s2, none, valid, 0.0, interpolated=False)
    variance = np.maximum(np.asarray(own, np.float32), shown)
    return Stokes(
        s0=s0,
        s1=s1,
        s2=s2,
        sigma=np.sqrt(variance),
        valid=valid,
        gain_sigma=float(np.sqrt(sum((w * s.gain_sigma) ** 2 for w, s in used_images))),
        # A file's colours are rounded together, as one luminance.
        lossy_sigma=float(sum(w * s.lossy_sigma for w, s in used_images)),
        lossy_block_px=images[0].lossy_block_px,
        noise_area_px=images[0].noise_area_px,
        rounding=_rounding_of_sum(used_images),
    )


def _rounding_of_sum(images: list[tuple[float, Stokes]]) -> Image | None:
    known = [w * w * s.rounding for w, s in images if s.rounding is not None]
    return np.asarray(sum(known), np.float32) if known else None


def estimate_noise(
    s0: Image,
    redundancy: Image,
    valid: Mask,
    *,
    floor: float,
    quantile_of_noise: float = PATCH_QUANTILE_OF_NOISE,
) -> NoiseModel:
    """Noise of s1 and s2 from the redundancy of one image; see the module's docstring.

    Parameters
    ----------
    s0, redundancy : (H, W) float32, ``redundancy = I0 + I90 - I45 - I135``; or (k, H, W), several
        combinations with that variance.
    valid : (H, W) bool, pixels to use. With fewer than 40 patches of 8x8 px of them, only the
        rounding of the samples is known; it is then returned.
    floor : the least variance of s1 and s2.
    quantile_of_noise : of the variance of a patch, over the variance; of interpolated noise.
    """
    usable = patch_means(valid.astype(np.float32)) > 1.0 - 0.5 / PATCH_PX**2
    if np.count_nonzero(usable) < MIN_SAMPLES:
        return NoiseModel(floor, 0.0)
    level = patch_means(s0)[usable]
    stack = redundancy if redundancy.ndim == 3 else redundancy[None]
    spread = np.zeros(len(level))
    for image in stack:
        mean = patch_means(image)[usable].astype(np.float64)
        square = patch_means(np.square(image))[usable].astype(np.float64)
        spread += np.maximum(square - mean * mean, 0.0) / len(stack)
    order = np.argsort(level)
    classes = np.array_split(order, min(MAX_CLASSES, len(order) // MIN_SAMPLES))
    levels = np.array([level[members].mean() for members in classes], np.float64)
    quantiles = np.array([np.quantile(spread[members], PATCH_QUANTILE) for members in classes])
    variances = np.maximum(quantiles / (2.0 * quantile_of_noise), max(floor, TINY))
    constant, slope = _highest_line_under(np.maximum(levels, TINY), variances)
    return NoiseModel(max(constant, floor), slope, max(floor - constant, 0.0))


def _variance(
    s0: Image,
    s1: Image,
    s2: Image,
    redundancy: Image,
    valid: Mask,
    floor: float,
    *,
    interpolated: bool,
) -> tuple[NoiseModel, Image]:
    """Noise, and variance of s1 and s2 (H, W), with what edges mix.

    By their redundancy (k, H, W), or their curvature if k = 0.
    """
    if interpolated:
        noise = estimate_noise(s0, redundancy, valid, floor=floor)
        variance = noise.variance(s0)
        return noise, variance + _redundant_mismatch(s0, redundancy, valid, variance)
    known, quantile = redundancy, PATCH_QUANTILE_OF_WHITE
    if len(redundancy) == 0:
        known = np.stack([_curvature(s1), _curvature(s2)])
        quantile = PATCH_QUANTILE_OF_CURVATURE
    noise = estimate_noise(s0, known, valid, floor=floor, quantile_of_noise=quantile)
    variance = noise.variance(s0)
    mixed = _mixed_variance(s0, s1, s2, valid, variance)
    mixed = np.maximum(mixed, _redundant_mismatch(s0, redundancy, valid, variance))
    return noise, variance + mixed


def _redundant_mismatch(s0: Image, redundancy: Image, valid: Mask, variance: Image) -> Image:
    """Mean variance beyond the noise (H, W) of redundant combinations (k, H, W); 0 of none."""
    extra = np.zeros_like(variance)
    for image in redundancy:
        extra += _mismatch_variance(s0, image, valid, variance) / np.float32(len(redundancy))
    return extra


def _curvature(image: Image) -> Image:
    """Second differences along both axes, scaled to twice the variance of white noise."""
    kernel = np.zeros(2 * CURVATURE_SPACING_PX + 1, np.float32)
    kernel[::CURVATURE_SPACING_PX] = [1.0, -2.0, 1.0]
    kernel *= np.float32(2.0**0.25 / np.sqrt(6.0))
    return np.asarray(cv2.sepFilter2D(np.ascontiguousarray(image), cv2.CV_32F, kernel, kernel))


def _mixed_variance(s0: Image, s1: Image, s2: Image, valid: Mask, noise: Image) -> Image:
    """Variance beyond the noise that light of unlike phases mixed at edges makes (H, W).

    From the second differences across the direction of (s1, s2), along rows and along columns: what
    is only brighter beside it has none.
    """
    kernel = np.array([1.0, -2.0, 1.0], np.float32) / np.float32(np.sqrt(3.0))
    one = np.ones(1, np.float32)
    length = np.maximum(np.hypot(s1, s2), TINY)
    found = np.zeros_like(noise)
    for along in ((kernel, one), (one, kernel)):
        bends = [cv2.sepFilter2D(image, cv2.CV_32F, *along) for image in (s1, s2)]
        across = np.asarray((s1 * bends[1] - s2 * bends[0]) / length, np.float32)
        np.maximum(found, _mismatch_variance(s0, across, valid, noise), out=found)
    return found


def _gain_sigma(s0: Image, s1: Image, s2: Image, redundancy: Image, valid: Mask) -> float:
    """Deviation of s1 and s2 by differing gains, share of s0; see the head of this module."""
    sample = (slice(None, None, 4), slice(None, None, 4))
    lit = valid[sample] & (s0[sample] > 0)
    level = s0[sample][lit]
    if len(redundancy) == 0 or level.size == 0:
        return 0.0
    # Of light that counts as unpolarized.
    weak = np.hypot(s1[sample][lit], s2[sample][lit]) < RegionOptions.min_dolp * level
    if np.count_nonzero(weak) < MIN_SAMPLES:
        weak[:] = True
    shares = [np.median(image[sample][lit][weak] / level[weak]) for image in redundancy]
    return deviation_of_gains(shares)


def deviation_of_gains(shares: ArrayLike) -> float:
    """Deviation of s1 / s0 and of s2 / s0 by gains that make these redundancies, shares of s0."""
    known = np.asarray(shares, np.float64)
    student = float(stdtrit(known.size, ONE_SIGMA))
    return float(student * np.sqrt(np.mean(np.square(known)) / 2.0))


def axial_difference(a: Angles, b: Angles) -> NDArray[np.float64]:
    """Signed difference ``a - b`` of axial angles, rad in [-pi/2, pi/2); shapes broadcast."""
    difference = np.subtract(a, b, dtype=np.float64)
    return np.asarray(wrap_axial(difference + 0.5 * np.pi) - 0.5 * np.pi)


def wrap_axial(angle: Any) -> Any:
    """An axial angle wrapped to [0, pi), in its own precision."""
    wrapped = np.mod(angle, np.pi)
    # A tiny negative angle rounds to pi itself.
    return np.where(wrapped >= np.pi, 0, wrapped)


def patch_means(image: Image) -> Image:
    """Means over squares of PATCH_PX; the remainder at the right and lower border is left out."""
    rows, cols = image.shape[0] // PATCH_PX, image.shape[1] // PATCH_PX
    if not rows or not cols:
        return np.zeros((rows, cols), np.float32)
    whole = image[: rows * PATCH_PX, : cols * PATCH_PX]
    return np.asarray(cv2.resize(whole, (cols, rows), interpolation=cv2.INTER_AREA))


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
    rest = cv2.addWeighted(redundancy, 1.0, s0, -offset, 0.0)
    squared = np.square(rest, out=rest)
    local = cv2.blur(squared, (MISMATCH_WINDOW_PX, MISMATCH_WINDOW_PX))
    excess = cv2.addWeighted(local, 0.5, noise, -MISMATCH_RATIO, 0.0, dst=squared)
    return np.asarray(np.maximum(excess, 0, out=excess))
