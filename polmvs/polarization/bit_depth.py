"""Full scale, clipping and quantization step of samples, decided from all files of a capture.

Cameras write 10, 12 and 14 bits into 16, at the lower end (right-aligned), at the upper end, or
scaled. No file says which. The samples of a whole capture show it:

- the *low bits* are zero in every sample of data shifted to the left;
- the *gaps* between occupied levels are 16 or 17 if 12 bits were scaled to 16;
- a *pile* of samples at the highest level shows that the sensor clips there. If this level is the
  largest value of a bit depth, it decides the depth; otherwise it gives only the clipping level.

Without a pile nothing is clipped, and the depth matters only as the unit of the darkness
threshold. It is 12 bits if they suffice (no polarization sensor has fewer in a 16-bit format by
its own choice), else 14 or 16. So a dark 12-bit capture does not pass for a 10-bit one.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

CONTAINER_BITS = 16
DEPTHS = (8, 10, 12, 14, 16)  # bits that cameras use
DEFAULT_DEPTHS = (12, 14, 16)  # bits without a pile
# A pile has more samples, by this factor, than each of so many levels below it, which must exist:
# a tail that ends by chance does not double at its last level (derived: a tail falls).
PILE_FACTOR = 2.0
PILE_NEIGHBORS = 16
MIN_PILE = 3  # samples; one or two at the top of a tail are chance
# Sensors that clip before their converter do so in its upper part; a pile below is a bright
# surface of one level (guess).
MIN_CLIP_SHARE = 0.85
MIN_LEVELS = 64  # occupied, before gaps between them mean anything
_POWERS = frozenset(1 << depth for depth in DEPTHS)
SCALED_GAP = 3  # least gap of scaled samples: 14 bits scaled to 16 leave 4 and 5


@dataclass(frozen=True, kw_only=True)
class Levels:
    """Meaning of a capture's sample values, and the reason.

    Attributes
    ----------
    bit_depth : of the samples; 0 for floats.
    full_scale : value of a saturated sample; the unit of all intensities.
    clip_level : value at which samples are clipped; infinite where no sample is.
    step : between neighbouring levels; 0 for floats.
    reason : one line for the user.
    """

    bit_depth: int
    full_scale: float
    clip_level: float
    step: float
    reason: str

    @property
    def quantum(self) -> float:
        """Quantization step of a sample, share of full scale."""
        return self.step / self.full_scale


class LevelCounts:
    """Histogram of the levels in the files read so far."""

    def __init__(self) -> None:
        self.counts: NDArray[np.int64] = np.zeros(0, np.int64)
        self.highest_float = -np.inf
        self.num_at_highest = 0
        self.declared_bits: int | None = None
        self.is_float = False

    def add(self, samples: NDArray[Any], declared_bits: int | None = None) -> None:
        """Count a file's samples, uint8, uint16 or float32, of any shape."""
        if declared_bits is not None:
            self.declared_bits = max(declared_bits, self.declared_bits or 0)
        if samples.dtype.kind == "f":
            self.is_float = True
            finite = samples[np.isfinite(samples)]
            highest = float(finite.max()) if finite.size else 0.0
            count = int(np.count_nonzero(finite == highest))
            if highest > self.highest_float:
                self.highest_float, self.num_at_highest = highest, count
            elif highest == self.highest_float:
                self.num_at_highest += count
            return
        if self.counts.size == 0:
            self.counts = np.zeros(1 << (8 * samples.dtype.itemsize), np.int64)
        self.counts += np.bincount(samples.ravel(), minlength=len(self.counts))

    def pile(self, step: float) -> int | None:
        """The highest level, if samples pile up there; ``step`` is the spacing of the levels.

        At the largest value of a bit depth a single sample is a pile: a tail does not end exactly
        there with nothing close below it.
        """
        occupied = np.flatnonzero(self.counts)
        if len(occupied) == 0 or occupied[-1] == 0:
            return None
        top = int(occupied[-1])
        near = self.counts[max(0, top - round(PILE_NEIGHBORS * step)) : top]
        if self.counts[top] < PILE_FACTOR * near.max(initial=0):
            return None
        filled = top | (round(step) - 1 if step.is_integer() else 0)
        if filled + 1 in _POWERS:
            return top
        crowd = int(self.counts[occupied[-1 - PILE_NEIGHBORS : -1]].max(initial=0))
        enough = self.counts[top] >= max(MIN_PILE, PILE_FACTOR * crowd)
        return top if enough and len(occupied) >= PILE_NEIGHBORS else None


def decide_levels(counts: LevelCounts, full_scale: float | None = None) -> Levels:
    """Full scale, clipping and step of a capture.

    Parameters
    ----------
    counts : of all its samples; empty for 8-bit files, which need no decision.
    full_scale : given by the user; it takes precedence.
    """
    if counts.is_float:
        return _of_floats(counts, full_scale)
    if len(counts.counts) <= 1 << 8:
        scale = 255.0 if full_scale is None else full_scale
        why = "8-bit samples" if full_scale is None else f"full scale {scale:g} as given"
        return Levels(bit_depth=8, full_scale=scale, clip_level=scale, step=1.0, reason=why)
    occupied = np.flatnonzero(counts.counts)
    step, shift = _step(occupied)
    pile = counts.pile(step)
    highest = int(occupied[-1]) if len(occupied) else 0
    if full_scale is not None:
        clip = min(full_scale, pile) if pile is not None else full_scale
        return Levels(
            bit_depth=CONTAINER_BITS,
            full_scale=full_scale,
            clip_level=clip,
            step=step,
            reason=f"full scale {full_scale:g} as given; the highest sample is {highest}",
        )
    if shift == 0 and step > 1:  # scaled to the whole container
        bits = round(np.log2((1 << CONTAINER_BITS) / step))
        return _levels(bits, 65535.0, step, pile, highest, f"{bits} bits scaled to 16")
    if counts.declared_bits is not None and highest < 1 << counts.declared_bits:
        bits = counts.declared_bits
        return _levels(bits, (1 << bits) - 1, step, pile, highest, f"{bits} bits by the file")
    tops = {depth: (1 << depth) - (1 << shift) for depth in DEPTHS if depth > shift}
    for depth, top in tops.items():
        if pile == top:
            return _levels(depth - shift, top, step, pile, highest, _how(depth, shift))
    if shift > 0:  # to the upper end, as SDKs shift
        fits = [CONTAINER_BITS]
    else:
        fits = [depth for depth in DEFAULT_DEPTHS if tops[depth] >= highest]
    return _levels(fits[0] - shift, tops[fits[0]], step, pile, highest, _how(fits[0], shift))


def _levels(
    bits: int, scale: float, step: float, pile: int | None, highest: int, how: str
) -> Levels:
    """The decision; clipping begins at a pile in the upper part, or never."""
    if pile is not None and pile < MIN_CLIP_SHARE * scale:
        pile = None
    if pile is None:
        seen = f"no sample is clipped, the highest is {highest}"
    elif pile >= scale:
        seen = f"clipped at {pile}"
    else:
        seen = f"clipped at {pile} already"
    clip = np.inf if pile is None else float(pile)
    return Levels(
        bit_depth=bits,
        full_scale=float(scale),
        clip_level=clip,
        step=float(step),
        reason=f"{how}, full scale {scale:g}; {seen}",
    )


def _how(depth: int, shift: int) -> str:
    if shift:
        return f"{depth - shift} bits shifted to the left by {shift}"
    return f"{depth} bits right-aligned" if depth < CONTAINER_BITS else "16 bits"


def _step(occupied: NDArray[np.intp]) -> tuple[float, int]:
    """Step between levels, and by how many bits they are shifted to the left."""
    lit = occupied[occupied > 0]
    if len(lit) == 0:
        return 1.0, 0
    every = int(np.bitwise_or.reduce(lit))
    shift = (every & -every).bit_length() - 1
    # A shift that no camera makes: levels that are multiples of it by chance.
    known = [CONTAINER_BITS - depth for depth in DEPTHS if depth < CONTAINER_BITS] + [0]
    shift = max(k for k in known if k <= shift)
    if shift == 0 and len(lit) >= MIN_LEVELS:
        gap = int(np.diff(occupied).min())
        if gap >= SCALED_GAP:
            spread = np.diff(occupied).astype(np.float64)
            return float(np.median(spread[spread <= gap + 1])), 0
    return float(1 << shift), shift


def _of_floats(counts: LevelCounts, full_scale: float | None) -> Levels:
    """Linear floats: 1 is full scale, unless a sample exceeds it; a pile at the top is clipped."""
    highest = counts.highest_float
    scale = full_scale if full_scale is not None else max(1.0, highest)
    clipped = counts.num_at_highest >= MIN_PILE and highest > 0
    seen = f"clipped at {highest:g}" if clipped else f"the highest sample is {highest:g}"
    return Levels(
        bit_depth=0,
        full_scale=float(scale),
        clip_level=highest if clipped else np.inf,
        step=0.0,
        reason=f"floats, full scale {scale:g}; {seen}",
    )
