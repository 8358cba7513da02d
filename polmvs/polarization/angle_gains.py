"""Gains between the polarizer angles, found where light is unpolarized.

The polarizers of a sensor differ in gain, by some percent. A camera that exposes each image anew,
or a filter that is turned by hand, makes one image of a view brighter than another. Both look like
the same polarization everywhere, next to which that of a grey or white surface (2 to 5 %) is lost.

Where light is unpolarized, the ratios of the images are those of the gains, the same at all pixels
(and, for the filters of a sensor, in all views). On polarized surfaces the ratios vary. So the most
frequent ratios are those of the gains (:func:`find_angle_gains`), and their spread over views or
over the parts of a view is the error (:func:`capture_gains`).

Four or more angles separate a gain from uniformly polarized light: linear images fit three Stokes
parameters, images of different gains do not. The misfit tells how large the gains can be.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import fdtri

from polmvs.arrays import Array, Image, Mask
from polmvs.fitting import robust_deviation
from polmvs.polarization.stokes import (
    deviation_of_gains,
    ideal_analyzers,
    null_space,
    patch_means,
)

# Deviation of s1 / s0 and of s2 / s0 by the gains of a sensor: 1.7 % of spread over sqrt(2), from
# the misfits of three frames and a capture of real sensors (1.1, 2.1, 1.1 and 2.1 %).
SENSOR_SPREAD = 0.012


@dataclass(frozen=True, kw_only=True)
class GainTolerances:
    """Tolerances of the gains, and of the test whether the images of a view differ in exposure.

    Attributes
    ----------
    bin_log : width of a bin of logarithms of ratios. Guess: wider than the noise of a patch.
    radius_log : of the patches about the mode whose median is its first estimate. Guess.
    min_support : share of the patches that have these ratios. Guess.
    min_ratio : of the largest gain to the smallest; light that is polarized by 10 % everywhere
        has 1.2. Derived from that.
    max_misfit_share : share of the misfit to three Stokes parameters that may remain after division
        by the gains. Guess.
    """

    bin_log: float = 0.05
    radius_log: float = 0.1
    min_support: float = 0.1
    min_ratio: float = 1.25
    max_misfit_share: float = 0.5


TOL = GainTolerances()
MIN_PATCHES = 40  # of light that counts as unpolarized: 1 % of an image of 612x512 px


@dataclass(frozen=True, kw_only=True)
class AngleGains:
    """Gains of the images of a view.

    Attributes
    ----------
    gains : of each image, their mean logarithm 0.
    parts : (P, K) logarithms of the gains that each quarter of the view shows; P = 0 if unknown.
    support : share of the patches whose ratios are these.
    differ : whether the images differ in exposure.
    """

    gains: tuple[float, ...]
    parts: Array
    support: float
    differ: bool

    @property
    def ratio(self) -> float:
        """Ratio of the largest gain to the smallest."""
        return max(self.gains) / min(self.gains)


@dataclass(frozen=True)
class ChannelGains:
    """Gains to divide the images of a view by, and what is left of their error.

    Attributes
    ----------
    gains : (K,), their mean logarithm 0.
    sigma : deviation of ``s1 / s0`` and of ``s2 / s0`` after the division; None: as the misfit to
        three Stokes parameters shows it.
    """

    gains: tuple[float, ...]
    sigma: float | None


def find_angle_gains(images: Image, angles_deg: Sequence[float], usable: Mask) -> AngleGains:
    """Gains between images of one view behind a polarizer.

    Parameters
    ----------
    images : (K, H, W) linear intensities.
    angles_deg : of the polarizer, one for each image.
    usable : (H, W), neither clipped nor dark in any of them.

    Returns
    -------
    Gains of 1 if too few pixels are usable.
    """
    num = len(images)
    whole = patch_means(usable.astype(np.float32)) == 1
    means = np.stack([patch_means(np.asarray(image, np.float32)) for image in images])
    known = whole & (means > 0).all(axis=0)
    samples = means[:, known].astype(np.float64)
    alike = AngleGains(gains=(1.0,) * num, parts=np.empty((0, num)), support=0.0, differ=False)
    if samples.shape[1] < MIN_PATCHES:
        return alike
    ratios = np.log(samples) - np.log(samples).mean(axis=0)
    bins = np.floor(ratios / TOL.bin_log).astype(np.int64)
    _, inverse, counts = np.unique(bins, axis=1, return_inverse=True, return_counts=True)
    first = np.median(ratios[:, inverse.ravel() == int(np.argmax(counts))], axis=1)
    # The median in windows that shrink to the noise: differences between neighbours along a row.
    noise = robust_deviation(np.diff(ratios, axis=1)) / np.sqrt(2)
    center = _mode(ratios, first, noise, MIN_PATCHES)
    if center is None:
        return alike
    support = float((np.abs(ratios - center[:, None]) < TOL.radius_log).all(axis=0).mean())
    gains = np.exp(center - center.mean())
    differ = bool(gains.max() > TOL.min_ratio * gains.min() and support >= TOL.min_support)
    if differ and num > 3:
        before = _misfit(samples, angles_deg)
        after = _misfit(samples / gains[:, None], angles_deg)
        differ = after < TOL.max_misfit_share * before
    rows, columns = np.nonzero(known)
    quarter = 2 * (2 * rows >= known.shape[0]) + (2 * columns >= known.shape[1])
    of_parts = [
        _mode(ratios[:, quarter == part], center, noise, MIN_PATCHES // 4) for part in range(4)
    ]
    parts = np.array([part for part in of_parts if part is not None]).reshape(-1, num)
    return AngleGains(gains=tuple(map(float, gains)), parts=parts, support=support, differ=differ)


def _mode(ratios: Array, center: Array, noise: float, least: int) -> Array | None:
    """Mode (K,) of ratios (K, N) near a first estimate; None if fewer than ``least`` lie there."""
    radius = TOL.radius_log
    while True:
        for _ in range(3):  # the window moves with its median
            near = (np.abs(ratios - center[:, None]) < radius).all(axis=0)
            if near.sum() < least:
                return None
            center = np.median(ratios[:, near], axis=1)
        if radius <= 3 * noise:
            return center
        radius = max(0.5 * radius, 3 * noise)


@dataclass(frozen=True)
class CaptureGains:
    """Gains of a capture's polarizer angles.

    Attributes
    ----------
    angles_deg : (K,) of the polarizer.
    prior : deviation of ``s1 / s0`` and of ``s2 / s0`` by gains, as the misfit of unpolarized light
        to three Stokes parameters shows it.
    limit : DoLP that such gains feign at most; above it light is polarized.
    common : of all views; None: each view has its own.
    """

    angles_deg: tuple[float, ...]
    prior: float
    limit: float
    common: ChannelGains | None

    @property
    def message(self) -> str | None:
        """What was found, as a clause; None without clear differences."""
        if self.common is None:
            if self.prior < 5e-4:
                return None
            what = f"from view to view, which feigns polarization of {100 * self.prior:.1f} %"
        else:
            ratio = max(self.common.gains) / min(self.common.gains) - 1
            if ratio < 1e-3:
                return None
            of_angles = ", ".join(
                f"{angle:g} deg {gain:.3f}"
                for angle, gain in zip(self.angles_deg, self.common.gains, strict=True)
            )
            what = f"by {100 * ratio:.1f} % ({of_angles})"
        return f"gains of the polarizer angles differ {what}; divided by those of unpolarized light"

    def of(self, view: AngleGains) -> ChannelGains | None:
        """Gains of a view of its own; None if it does not show them."""
        if view.ratio > TOL.min_ratio or not len(view.parts):
            return None
        return _estimate(view.parts, self)


def capture_gains(
    views: Sequence[AngleGains], angles_deg: Sequence[float], *, constant: bool
) -> CaptureGains | None:
    """Gains of a capture, from some of its views.

    They are those of unpolarized light as far as the misfit to three Stokes parameters, which
    polarized light does not have, allows gains: a Gaussian prior whose deviation is the one of
    :func:`polmvs.polarization.stokes.deviation_of_gains`.

    Parameters
    ----------
    views : gains that they show.
    angles_deg : (K,) of the polarizer.
    constant : the gains are a sensor's, the same in all views. Otherwise they are if views agree
        better than the parts of a view.

    Returns
    -------
    None if the views show none clearly. Three angles have no misfit; with them only views that
    disagree while the parts of each agree tell gains.
    """
    # Larger ratios are exposures, which the user is asked about.
    known = [view for view in views if len(view.parts) and view.ratio <= TOL.min_ratio]
    if not known:
        return None
    logs = np.log([view.gains for view in known])
    images = np.exp(logs)
    analyzers = ideal_analyzers(angles_deg)
    s0 = images @ np.linalg.pinv(analyzers)[0]
    shares = null_space(analyzers) @ images.T / s0  # (K - 3, V)
    of_parts = float(np.median([_spread(view.parts, angles_deg) for view in known]))
    of_views = _spread(logs, angles_deg)
    own = not constant and of_views > of_parts
    if not len(shares):
        limit = 4 * max(of_views, SENSOR_SPREAD)
        return CaptureGains(tuple(angles_deg), of_views, limit, None) if own else None
    known_shares = shares.ravel() if own else np.median(shares, axis=1)
    prior = deviation_of_gains(known_shares)
    limit = 4 * max(prior, SENSOR_SPREAD)
    if not own:
        # The ratio of the squares has the F distribution: one sensor may happen to have no misfit.
        ratio = float(fdtri(2, known_shares.size, 0.99))
        limit = min(limit, float(np.sqrt(ratio * np.mean(np.square(known_shares)))))
    found = CaptureGains(tuple(angles_deg), prior, limit, None)
    if own:
        return found
    few = len(known) < 3
    common = _estimate(np.concatenate([view.parts for view in known]) if few else logs, found)
    return None if common is None else replace(found, common=common)


def _estimate(logs: Array, capture: CaptureGains) -> ChannelGains | None:
    """The mean of the gains' distribution, given measured logarithms (N, K).

    None if they are not clearly other than 0, or if light is polarized alike.
    """
    middle = np.median(logs, axis=0)
    spread = _spread(logs, capture.angles_deg)
    error = np.sqrt(np.pi / 2 / len(logs)) * spread  # of a median
    if not 3 * error < float(np.hypot(*_axial(middle, capture.angles_deg))) < capture.limit:
        return None
    share = capture.prior**2 / max(capture.prior**2 + spread**2, 1e-30)
    gains = np.exp(share * (middle - middle.mean()))
    return ChannelGains(tuple(map(float, gains)), float(np.sqrt(share) * spread))


def _axial(logs: Array, angles_deg: Sequence[float]) -> Array:
    """``s1 / s0`` and ``s2 / s0`` (..., 2) that logarithms of gains (..., K) feign."""
    stokes = np.exp(logs) @ np.linalg.pinv(ideal_analyzers(angles_deg)).T
    return np.asarray(stokes[..., 1:] / stokes[..., :1])


def _spread(logs: Array, angles_deg: Sequence[float]) -> float:
    """Robust deviation of what logarithms of gains (N, K) feign, the larger of both components."""
    axial = _axial(logs, angles_deg)
    return max(robust_deviation(own - np.median(own)) for own in axial.T)


def _misfit(samples: Array, angles_deg: Sequence[float]) -> float:
    """RMS residual of (K, N) samples from three Stokes parameters, share of the samples."""
    analyzers = ideal_analyzers(angles_deg)
    left = samples - analyzers @ (np.linalg.pinv(analyzers) @ samples)
    return float(np.sqrt(np.mean(np.square(left / samples.mean(axis=0)))))
