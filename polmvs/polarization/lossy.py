"""Traces of lossy compression in a mosaic, and its noise in the Stokes images.

A JPEG rounds the coefficients of each 8x8 block of samples to multiples of a step. The polarization
of a mosaic is at the highest frequencies (the difference of neighbouring samples), where the steps
are largest. The redundancy of the four samples shrinks as well, so it shows too little noise.
Therefore polmvs finds the steps and computes the variance of s1 and s2 that rounding to them adds:
the error of each coefficient is uniform within its step.

The steps of a JPEG are in its file. In samples that were stored without loss *after* a JPEG, they
are the spacing of the coefficients' values: for a step q, ``mean cos(2 pi c / q)`` over the
coefficients that are not zero is near one only where they are multiples of q (J. Fan and
R. de Queiroz, Identification of bitmap compression history, IEEE TIP 12(2), 2003).
"""

from __future__ import annotations

from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.fft import dctn

from polmvs.config import CaptureOptions
from polmvs.polarization.mosaic import split_mosaic

BLOCK = 8
MAX_BLOCKS = 1500  # blocks that are used, evenly spread
MIN_BLOCKS = 64
MAX_STEP = 64
MIN_STEP = 3  # rounding to whole samples blurs smaller ones (derived: deviation 0.29 of a step)
MIN_MAGNITUDE = 1.0  # coefficients above this are not only the rounding of samples
MIN_NONZERO = 24  # least number of coefficients of one frequency for a spacing
MIN_COMB = 0.6  # comb strength of a step; unrounded coefficients reach 0.3 with so few (simulated)
MIN_RHYTHMIC = 6  # least number of frequencies with a comb for samples to count as lossy


def find_quantization(raw: NDArray[Any]) -> NDArray[np.float64] | None:
    """Steps of the JPEG from which 8-bit samples were decoded, or None.

    Parameters
    ----------
    raw : (H, W) uint8, blocks counted from its corner.

    Returns
    -------
    (8, 8) float64, the steps, rows for vertical frequencies. Where all coefficients are zero: twice
    the largest coefficient that they may have had, the least step that would hide it.
    """
    steps, rhythmic, silent = _rhythm(_blocks(raw))
    if rhythmic < MIN_RHYTHMIC:
        return None
    # Samples with a rhythm of their own (rendered, without noise) have it on every grid.
    if 2 * _rhythm(_blocks(raw[BLOCK // 2 :, BLOCK // 2 :]))[1] > rhythmic:
        return None
    # Whatever a step removed was below half of it; steps grow with the frequency.
    known = steps[steps > 1.0].max()
    steps[silent & (steps == 1.0)] = known
    return steps


def _rhythm(
    blocks: NDArray[np.float32],
) -> tuple[NDArray[np.float64], int, NDArray[np.bool_]]:
    """Steps (8, 8), 1 where none is seen; at how many frequencies; and where all is zero."""
    steps = np.ones((BLOCK, BLOCK))
    silent = np.zeros((BLOCK, BLOCK), np.bool_)
    rhythmic = 0
    if len(blocks) < MIN_BLOCKS:
        return steps, rhythmic, silent
    coefficients = dctn(blocks.astype(np.float64) - 128, axes=(1, 2), norm="ortho")
    for v in range(BLOCK):
        for u in range(BLOCK):
            values = np.sort(np.abs(coefficients[:, v, u])).astype(np.float32)
            step = _comb_step(values)
            if step is not None:
                rhythmic += v + u > 0
                steps[v, u] = step
            silent[v, u] = np.mean(values > MIN_MAGNITUDE) < 0.02
    return steps, rhythmic, silent


def lossy_variance(steps: NDArray[np.float64], *, scale: float) -> float:
    """Variance of s1 and s2 (mean of the two) by rounding the coefficients to steps.

    Parameters
    ----------
    steps : (8, 8), of samples 0 to 255.
    scale : intensity of one sample step, share of full scale.
    """
    return float((np.square(steps) / 12.0 * _stokes_gains()).sum() * scale**2)


def lossy_mean_variance(
    steps: NDArray[np.float64], analyzers: NDArray[np.float64], *, scale: float
) -> float:
    """Variance of the mean s1 and s2 (the larger of the two) of a block of separate angle images.

    Each angle's image is compressed separately, so the redundancy shows the rounding of single
    pixels. The pixels of a block share the rounding of its mean. Measured on a public capture of
    30 views, JPEG with steps of 8 to 61, against the redundancy averaged over 17x17 px: a deviation
    of 0.0020 of s0, where this gives 0.0014 for a block and the steps of all frequencies 0.0155.

    Parameters
    ----------
    steps : (8, 8), of samples 0 to 255.
    analyzers : (n, 3), of the images; see :func:`polmvs.polarization.stokes.ideal_analyzers`.
    scale : intensity of one sample step, share of full scale.
    """
    inverse = np.linalg.pinv(analyzers)[1:]
    gain = float(np.square(inverse).sum(axis=1).max())
    return float(gain * (steps[0, 0] / BLOCK) ** 2 / 12.0 * scale**2)


@cache
def _stokes_gains() -> NDArray[np.float64]:
    """Mean square of s1 and s2 for a unit coefficient of each frequency (8, 8)."""
    gains = np.zeros((BLOCK, BLOCK))
    for v in range(BLOCK):
        for u in range(BLOCK):
            unit = np.zeros((BLOCK, BLOCK), np.float32)
            unit[v, u] = 1.0
            # A single block amid silent ones; the filters reach into the next.
            raw = np.zeros((3 * BLOCK, 3 * BLOCK), np.float32)
            raw[BLOCK : 2 * BLOCK, BLOCK : 2 * BLOCK] = cv2.idct(unit)
            # Any order has the same variances, averaged over s1 and s2.
            i0, i45, i90, i135 = split_mosaic(raw, CaptureOptions.pattern)
            total = np.square(i0 - i90).sum() + np.square(i45 - i135).sum()
            gains[v, u] = 0.5 * float(total) / (BLOCK // 2) ** 2
    return gains


def _blocks(raw: NDArray[Any]) -> NDArray[np.float32]:
    """Whole blocks (N, 8, 8), evenly spread, that neither clip nor are flat."""
    rows, cols = raw.shape[0] // BLOCK, raw.shape[1] // BLOCK
    tiles = raw[: rows * BLOCK, : cols * BLOCK].reshape(rows, BLOCK, cols, BLOCK)
    step = max(1, int(np.sqrt(rows * cols / MAX_BLOCKS)))
    blocks = tiles[::step, :, ::step].transpose(0, 2, 1, 3).reshape(-1, BLOCK, BLOCK)
    low, high = blocks.min(axis=(1, 2)), blocks.max(axis=(1, 2))
    return np.asarray(blocks[(low > 0) & (high < 255) & (low < high)], np.float32)


def _comb_step(values: NDArray[np.float32]) -> int | None:
    """The largest step that magnitudes, in ascending order, are multiples of; None if of none."""
    steps = np.arange(MIN_STEP, MAX_STEP + 1, dtype=np.float32)
    # Half a step too: a multiple of the true step leaves the odd ones between.
    first = np.searchsorted(values, np.maximum(MIN_MAGNITUDE, 0.3 * steps), side="right")
    enough = np.flatnonzero(len(values) - first >= MIN_NONZERO)
    if not len(enough):
        return None
    values, steps, first = values[first[0] :], steps[enough], first[enough] - first[0]
    turns = values / steps[:, None]
    waves = np.cos(np.float32(2 * np.pi) * (turns - np.rint(turns)))
    sums = np.array([own[start:].sum() for own, start in zip(waves, first, strict=True)])
    combs = np.flatnonzero(sums / (len(values) - first) > MIN_COMB)
    return int(steps[combs[-1]]) if len(combs) else None
