"""Check that the order of the polarizers in a mosaic's cell fits its samples.

Intensities behind perpendicular polarizers sum to the whole intensity, so ``I0 + I90 = I45 + I135``
for any light. There are three ways to divide the four samples of a cell into two pairs. Where light
is polarized, the sums agree only for the correct pairs. Of the 24 orders, 8 have these pairs; they
are turned and mirrored versions of each other. One image cannot distinguish them: their angles of
polarization differ, their sums do not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import permutations
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.config import CaptureOptions
from polmvs.polarization.mosaic import ANGLES_DEG, clipped_cells, split_mosaic, turned_pattern

Pattern = tuple[int, int, int, int]

# Pairs of places of a cell (row by row) that may be perpendicular.
PAIRINGS = (((0, 3), (1, 2)), ((0, 1), (2, 3)), ((0, 2), (1, 3)))
PAIRING_NAMES = ("diagonals", "rows", "columns")
SMOOTHING_PX = 9
MIN_LIGHT = 0.02  # share of the brightest
MIN_PIXELS = 500  # polarized ones
# With a wrong pairing polarized light makes several times the disagreement of the right one.
# Between this ratio and its inverse the check is undecided (guess; right patterns of rendered and
# real captures have 0.1 to 0.4, a swapped one the inverse).
CLEAR_RATIO = 0.5
POLARIZED_SHARE = 0.05  # of s0, beyond which the sums of the best pairing count as polarized


@dataclass(frozen=True, kw_only=True)
class PatternCheck:
    """Result of the check of a pattern.

    Attributes
    ----------
    pattern : the checked pattern.
    disagreement : of the sums under the three pairings, median over polarized pixels, share of
        s0; in the order of ``PAIRING_NAMES``.
    num_pixels : number of polarized pixels used.
    fits : None if too little light is polarized.
    fitting : the eight patterns that fit, the sensor's own and turned ones first; empty if unknown.
    """

    pattern: Pattern
    disagreement: tuple[float, float, float]
    num_pixels: int
    fits: bool | None
    fitting: tuple[Pattern, ...]

    @property
    def message(self) -> str:
        """One line for the user."""
        text = ",".join(map(str, self.pattern))
        if self.fits is None:
            return f"too little polarized light to check `capture.pattern` {text}"
        if self.fits:
            return f"`capture.pattern` {text} fits, or a turned or mirrored one"
        likely = ",".join(map(str, self.fitting[0]))
        pairs = PAIRING_NAMES[int(np.argmin(self.disagreement))]
        return (
            f"`capture.pattern` {text} does not fit: its perpendicular samples do not sum alike. "
            f"Those on the {pairs} of a cell do, as in `capture.pattern` {likely}"
        )


def check_pattern(mosaics: Sequence[NDArray[Any]], pattern: Pattern, clip: float) -> PatternCheck:
    """Check a pattern against linear mosaics of one camera.

    Parameters
    ----------
    mosaics : (H, W), linear.
    pattern : polarizer angles of a cell, row by row, degrees.
    clip : value from which a sample is clipped.
    """
    parts = [_differences(raw, clip) for raw in mosaics]
    s0, *apart = np.concatenate(parts, axis=1) if parts else np.zeros((4, 0), np.float32)
    lit = s0 > MIN_LIGHT * (float(s0.max()) if s0.size else 0.0)
    s0, differences = s0[lit], np.abs(np.stack(apart)[:, lit])
    polarized = differences.max(axis=0) > POLARIZED_SHARE * s0
    num = int(np.count_nonzero(polarized))
    own = _pairing_of(pattern)
    if num < MIN_PIXELS:
        return PatternCheck(
            pattern=pattern, disagreement=(0.0, 0.0, 0.0), num_pixels=num, fits=None, fitting=()
        )
    shares = np.median(differences[:, polarized] / s0[polarized], axis=1)
    best, second = np.argsort(shares)[:2]
    told = shares[best] < CLEAR_RATIO * shares[second]
    fits = bool(own == best) if told else None
    return PatternCheck(
        pattern=pattern,
        disagreement=(float(shares[0]), float(shares[1]), float(shares[2])),
        num_pixels=num,
        fits=fits,
        fitting=_patterns_of(int(best)) if told else (),
    )


def _differences(raw: NDArray[Any], clip: float) -> NDArray[np.float32]:
    """Intensity s0 and the signed disagreement of the three pairings, (4, N), smoothed.

    Texture disagrees with changing sign, polarized light with the same one.
    """
    images = split_mosaic(raw, ANGLES_DEG)  # places instead of angles: the image of place k
    inside = ~clipped_cells(raw, clip)
    inside[[0, -1]] = False
    inside[:, [0, -1]] = False
    stack = [0.5 * images.sum(axis=0)]
    stack += [images[list(a)].sum(axis=0) - images[list(b)].sum(axis=0) for a, b in PAIRINGS]
    size = (SMOOTHING_PX, SMOOTHING_PX)
    whole = cv2.erode(inside.astype(np.uint8), np.ones(size, np.uint8)) > 0
    return np.stack([cv2.blur(image, size)[whole] for image in stack]).astype(np.float32)


def _pairing_of(pattern: Pattern) -> int:
    """Index of the pairing whose pairs are perpendicular."""
    for index, pairs in enumerate(PAIRINGS):
        if all(abs(pattern[a] - pattern[b]) == 90 for a, b in pairs):
            return index
    raise ValueError(f"{pattern=} but expected each of {ANGLES_DEG} once.")


def _patterns_of(pairing: int) -> tuple[Pattern, ...]:
    """Patterns of a pairing: that of the sensors sold and its turned images first, if theirs."""
    turned = [turned_pattern(CaptureOptions.pattern, orientation) for orientation in range(1, 9)]
    every = [(a, b, c, d) for a, b, c, d in permutations(ANGLES_DEG)]
    order = [*turned, *every]
    return tuple(dict.fromkeys(p for p in order if _pairing_of(p) == pairing))
