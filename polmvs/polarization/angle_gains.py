"""Gains between the images of one view behind a polarizer at several angles.

A camera that exposes each image anew, or a filter that is turned by hand, makes one image of a view
brighter than another. This looks like strong polarization everywhere. Where the light is
unpolarized, the ratios of the images are those of the gains, the same at all pixels. On polarized
surfaces the ratios vary. So the most frequent ratios are those of the gains.

Four or more angles separate a gain from uniformly polarized light: linear images fit three Stokes
parameters, images of different gains do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.polarization.stokes import ideal_analyzers


@dataclass(frozen=True, kw_only=True)
class GainTolerances:
    """Tolerances of the test whether the images of a view differ in exposure.

    Attributes
    ----------
    num_samples : number of pixels used.
    bin_log : width of a bin of logarithms of ratios. Guess: wider than the noise of a pixel.
    radius_log : of the pixels about the mode whose median is the gain. Guess.
    min_support : share of the pixels that have these ratios. Guess.
    min_ratio : of the largest gain to the smallest; light that is polarized by 10 % everywhere
        has 1.2. Derived from that.
    max_misfit_share : share of the misfit to three Stokes parameters that may remain after division
        by the gains. Guess.
    """

    num_samples: int = 40_000
    bin_log: float = 0.05
    radius_log: float = 0.1
    min_support: float = 0.1
    min_ratio: float = 1.25
    max_misfit_share: float = 0.5


TOL = GainTolerances()


@dataclass(frozen=True, kw_only=True)
class AngleGains:
    """Gains of the images of a view.

    Attributes
    ----------
    gains : of each image, their mean logarithm 0.
    support : share of the pixels whose ratios are these.
    differ : whether the images differ in exposure.
    """

    gains: tuple[float, ...]
    support: float
    differ: bool

    @property
    def ratio(self) -> float:
        """Ratio of the largest gain to the smallest."""
        return max(self.gains) / min(self.gains)


def find_angle_gains(
    images: NDArray[np.floating],
    angles_deg: Sequence[float],
    usable: NDArray[np.bool_],
) -> AngleGains:
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
    samples = np.asarray(images, np.float64)[:, usable & (images > 0).all(axis=0)]
    samples = samples[:, :: max(1, samples.shape[1] // TOL.num_samples)]
    alike = AngleGains(gains=(1.0,) * num, support=0.0, differ=False)
    if samples.shape[1] < 100:
        return alike
    ratios = np.log(samples) - np.log(samples).mean(axis=0)
    bins = np.floor(ratios / TOL.bin_log).astype(np.int64)
    _, inverse, counts = np.unique(bins, axis=1, return_inverse=True, return_counts=True)
    center = np.median(ratios[:, inverse.ravel() == int(np.argmax(counts))], axis=1)
    near = np.zeros(samples.shape[1], np.bool_)
    for _ in range(3):  # the bin's border may cut the mode in two
        near = (np.abs(ratios - center[:, None]) < TOL.radius_log).all(axis=0)
        if not near.any():
            return alike
        center = np.median(ratios[:, near], axis=1)
    gains = np.exp(center - center.mean())
    support = float(near.mean())
    differ = bool(gains.max() > TOL.min_ratio * gains.min() and support >= TOL.min_support)
    if differ and num > 3:
        before = _misfit(samples, angles_deg)
        after = _misfit(samples / gains[:, None], angles_deg)
        differ = after < TOL.max_misfit_share * before
    return AngleGains(gains=tuple(map(float, gains)), support=support, differ=differ)


def _misfit(samples: Array, angles_deg: Sequence[float]) -> float:
    """RMS residual of (K, N) samples from three Stokes parameters, share of the samples."""
    analyzers = ideal_analyzers(angles_deg)
    left = samples - analyzers @ (np.linalg.pinv(analyzers) @ samples)
    return float(np.sqrt(np.mean(np.square(left / samples.mean(axis=0)))))
