"""Frames for polarizer calibration on disk: dark, unpolarized and polarized frames.

The folder holds ``unpolarized/`` (a uniform unpolarized source: an integrating sphere, or a
diffuser before the lens), ``polarized/`` (the same behind a linear polarizer, files named by its
transmission angle in degrees, ``045.png`` or ``045_01.png``, three angles or more) and ``dark/``
(lens cap on, same exposure). Any may be missing, except one of the first two.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Image
from polmvs.config import CaptureKind, CaptureOptions
from polmvs.errors import DataError
from polmvs.polarization.calibration import (
    PolarizerResponse,
    measure_colour_response,
    measure_response,
)
from polmvs.polarization.capture import Capture, open_capture

POLARIZED, UNPOLARIZED, DARK = "polarized", "unpolarized", "dark"
MAX_CLIPPED = 0.001  # share of a frame's samples that may be clipped: dust and hot samples


def calibrate_polarizers(
    folder: Path, options: CaptureOptions, *, per_sample: bool
) -> PolarizerResponse:
    """Measure a sensor's response from the frames of a folder.

    Parameters
    ----------
    folder : see the module's docstring.
    options : how to read its mosaics.
    per_sample : a value for each sample instead of each channel.

    Raises
    ------
    DataError
        Frames are missing, misnamed, clipped, or do not fit the pattern.
    """
    chosen = replace(options, kind=CaptureKind.MOSAIC, calibration=None)
    measure: Callable[..., PolarizerResponse] = measure_response
    if chosen.bayer is not None:
        measure = partial(measure_colour_response, bayer=chosen.bayer)
    captures: dict[str, Capture] = {}
    for name in (POLARIZED, UNPOLARIZED, DARK):
        if (folder / name).is_dir():
            captures[name] = open_capture(folder / name, chosen)
            # The brightest frames decide for all what full scale is.
            chosen = replace(chosen, full_scale=captures[name].full_scale)
    if POLARIZED not in captures and UNPOLARIZED not in captures:
        raise DataError(folder, f"holds neither {POLARIZED}/ nor {UNPOLARIZED}/.")
    frames = {name: _means(capture) for name, capture in captures.items()}
    polarized: list[tuple[float, Image]] = []
    for name, frame in frames.get(POLARIZED, []):
        match = re.match(r"\d{1,3}(?:\.\d+)?", name)
        if match is None:
            raise DataError(folder / POLARIZED / name, "its name does not begin with the angle.")
        polarized.append((float(match[0]), frame))
    try:
        response = measure(
            chosen.pattern,
            unpolarized=[frame for _, frame in frames.get(UNPOLARIZED, [])],
            polarized=polarized,
            dark=[frame for _, frame in frames.get(DARK, [])],
            per_sample=per_sample,
        )
    except ValueError as error:
        raise DataError(folder, str(error)) from error
    return replace(response, full_scale=next(iter(captures.values())).full_scale)


def _means(capture: Capture) -> Sequence[tuple[str, Image]]:
    """Mean frames of a folder by the start of their names, ``045`` of ``045_01.png``."""
    limit = np.float32(capture.options.saturation)
    groups: dict[str, tuple[NDArray[np.float64], int]] = {}
    for name in capture.names:
        frame = capture.load_mosaic(name)
        if np.mean(frame >= limit) > MAX_CLIPPED:
            raise DataError(capture.folder / name, "is clipped. Record calibrations darker.")
        key = re.split(r"[_-]", Path(name).stem)[0] if capture.folder.name == POLARIZED else ""
        total, count = groups.get(key, (np.zeros(frame.shape), 0))
        groups[key] = (total + frame, count + 1)
    return [(key, np.asarray(total / n, np.float32)) for key, (total, n) in groups.items()]
