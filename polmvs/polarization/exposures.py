"""Several exposures of one view, merged by their noise."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Image, Mask

# Variance of the read noise over that of the photons at full scale. A full well of 10,000
# electrons with a read noise of 2.5 (IMX250), measured in neither file; wrong by ten it costs a few
# percent of noise in dark pixels.
READ_VARIANCE = 6e-4


def merge_exposures(
    images: Sequence[Image], clipped: Sequence[Mask], exposures_s: Sequence[float]
) -> tuple[Image, Mask]:
    """Radiance of one view in full scales of its longest exposure.

    Each exposure ``x_k`` measures ``L = x_k t_max / t_k`` with photon and read noise. Unclipped
    exposures are averaged with their inverse variance. The photon noise is that of the pooled
    samples: that of single samples would give low values too much weight.

    Parameters
    ----------
    images : of (H, W) float32 or (H, W, 3), linear, units of full scale.
    clipped : as the images, True for samples that are only a lower bound.
    exposures_s : exposure times, any unit.

    Returns
    -------
    merged : as the images; the shortest exposure where all are clipped.
    clipped : True where all are clipped.
    """
    times = np.asarray(exposures_s, np.float64)
    if not len(images) == len(clipped) == len(times) > 0 or not (times > 0).all():
        raise ValueError(f"{len(images)=}, {len(clipped)=}, {exposures_s=} but expected as many.")
    shares = (times / times.max()).astype(np.float32)
    usable: list[NDArray[Any]] = [(~mask).astype(np.float32) for mask in clipped]
    time = sum(u * t for u, t in zip(usable, shares, strict=True))
    light = sum(u * x for u, x in zip(usable, images, strict=True))
    pooled = np.maximum(light, 0) / np.maximum(time, np.float32(1e-9))
    total = np.zeros_like(images[0], np.float32)
    weights = np.zeros_like(total)
    for image, share, use in zip(images, shares, usable, strict=True):
        # Variance of x / share, in that of the photons at full scale:
        # (pooled * share + read) / share^2.
        weight = use * share**2 / (pooled * share + READ_VARIANCE)
        total += weight * image / share
        weights += weight
    nowhere = weights == 0
    shortest = int(np.argmin(shares))
    merged = np.where(
        nowhere, images[shortest] / shares[shortest], total / np.where(nowhere, 1, weights)
    )
    return merged.astype(np.float32), nowhere
