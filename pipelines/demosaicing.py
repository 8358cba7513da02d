"""Ways to interpolate a polarizer mosaic, compared in error and time on captures with truth.

    python pipelines/demosaicing.py board/ dome/

Of each way, at half and at full resolution: the error of the AoLP on the part against the light
that the true normals reflect (tilted polarizers), single pixels, DoLP above 0.1; the degree of
polarization that edges of the unpolarized surroundings seem to have; and the time of a frame.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Image, Mask
from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import (
    CaptureOptions,
    OptionGroup,
    RegionOptions,
    option,
)
from polmvs.evaluation.tables import format_table
from polmvs.geometry import unit
from polmvs.io.ground_truth import GroundTruth, open_ground_truth
from polmvs.polarization.angle_models import correct_stokes, phase_from_normal
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.mosaic import ANGLES_DEG, split_mosaic, split_mosaic_full
from polmvs.polarization.stokes import Stokes, axial_difference, stokes_from_intensities
from polmvs.scene import evenly_spread

Way = Callable[[Image], Image]

PATTERN = CaptureOptions.pattern
MIN_DOLP = RegionOptions.min_dolp
EDGE_SLOPE = 0.1  # of the intensity, relative, per half-size px: texture
CUBIC = (-0.0703125, 0.8671875, 0.2265625, -0.0234375)  # Catmull-Rom at a quarter
NUM_VIEWS = 4  # of a capture, evenly spread
REPEATS = 3


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    captures: tuple[Path, ...] = option(
        MISSING, "captures with ground truth in gt/", positional=True
    )


def sliced(raw: Image) -> Image:
    """Each angle's samples as they are, up to half a pixel beside the cell's centre."""
    sites = {angle: raw[cell // 2 :: 2, cell % 2 :: 2] for cell, angle in enumerate(PATTERN)}
    return np.stack([sites[angle] for angle in ANGLES_DEG]).astype(np.float32)


def cubic(raw: Image) -> Image:
    """Four taps along each axis."""
    images = np.empty((4, raw.shape[0] // 2, raw.shape[1] // 2), np.float32)
    for cell, angle in enumerate(PATTERN):
        row, col = divmod(cell, 2)
        site = np.ascontiguousarray(raw[row::2, col::2])
        cv2.sepFilter2D(
            site,
            cv2.CV_32F,
            _taps(col),
            _taps(row),
            dst=images[ANGLES_DEG.index(angle)],
            borderType=cv2.BORDER_REPLICATE,
        )
    return images


def _taps(side: int) -> Image:
    """Five weights about a sample that lies on side 0 or 1 of its cell."""
    ahead = np.array([0.0, *CUBIC], np.float32)  # previous two, own, next two
    return ahead if side == 0 else ahead[::-1].copy()


def guided(raw: Image) -> Image:
    """Bilinear on the ratio to a local mean of all four, which follows edges of intensity."""
    return _guided(raw, split_mosaic)


def full_guided(raw: Image) -> Image:
    """The same at the mosaic's own pixels."""
    return _guided(raw, split_mosaic_full)


def _guided(raw: Image, split: Callable[..., Image]) -> Image:
    kernel = np.array([0.25, 0.5, 0.25], np.float32)
    mean = cv2.sepFilter2D(raw, cv2.CV_32F, kernel, kernel, borderType=cv2.BORDER_REFLECT_101)
    mean = np.maximum(mean, 1e-4)
    at_place = mean
    if split is split_mosaic:  # of the cell: the mean of its four
        at_place = cv2.resize(
            mean, (raw.shape[1] // 2, raw.shape[0] // 2), interpolation=cv2.INTER_AREA
        )
    return np.asarray(split(raw / mean, PATTERN) * at_place, np.float32)


HALF: dict[str, Way] = {
    "sliced": sliced,
    "bilinear (used)": lambda raw: split_mosaic(raw, PATTERN),
    "cubic": cubic,
    "guided by the mean": guided,
}
FULL: dict[str, Way] = {
    "full, bilinear (used)": lambda raw: split_mosaic_full(raw, PATTERN),
    "full, guided by the mean": full_guided,
}


@dataclass(frozen=True, kw_only=True)
class Figures:
    """Of one way over some views.

    Attributes
    ----------
    median_deg, rmse_deg : of the AoLP on the part.
    false_median, false_p95 : DoLP at edges of the surroundings.
    seconds : of a frame, the least of a few.
    """

    median_deg: float
    rmse_deg: float
    false_median: float
    false_p95: float
    seconds: float


def measure(folder: Path) -> dict[str, Figures]:
    """Figures of all ways on a capture."""
    capture, truth = open_capture(folder), open_ground_truth(folder)
    chosen = [truth.names[k] for k in evenly_spread(len(truth.names), NUM_VIEWS)]
    frames = [capture.load_mosaic(name) for name in chosen]
    return {name: _figures(way, frames, chosen, truth) for name, way in {**HALF, **FULL}.items()}


def _figures(
    way: Way, frames: Sequence[Image], names: Sequence[str], truth: GroundTruth
) -> Figures:
    errors, false, seconds = [np.zeros(0)], [np.zeros(0)], []
    for raw, name in zip(frames, names, strict=True):
        for _ in range(REPEATS):
            start = time.perf_counter()
            images = way(raw)
            seconds.append(time.perf_counter() - start)
        stokes = stokes_from_intensities(images, np.zeros(images.shape[1:], np.bool_))
        scale = images.shape[1] // (raw.shape[0] // 2)
        clear = _unclipped(raw, scale)
        errors.append(_part_errors(stokes, truth, name, scale, clear))
        false.append(_false_dolp(stokes, truth, name, scale, clear))
    error, dolp = np.concatenate(errors), np.concatenate(false)
    return Figures(
        median_deg=float(np.median(np.abs(error))),
        rmse_deg=float(np.sqrt(np.mean(np.square(error)))),
        false_median=float(np.median(dolp)),
        false_p95=float(np.percentile(dolp, 95)),
        seconds=min(seconds),
    )


def _unclipped(raw: Image, scale: int) -> Mask:
    """Pixels that no clipped sample of any way reaches."""
    reached = cv2.dilate((raw >= 0.98).astype(np.uint8), np.ones((9, 9), np.uint8))
    return np.asarray((reached if scale == 2 else reached[::2, ::2]) == 0)


def _grown(image: NDArray[np.generic], scale: int) -> NDArray[np.generic]:
    """A half-size map at the pixels of a resolution."""
    return image if scale == 1 else np.repeat(np.repeat(image, scale, axis=0), scale, axis=1)


def _part_errors(
    stokes: Stokes, truth: GroundTruth, name: str, scale: int, clear: Mask
) -> NDArray[np.float64]:
    """Errors of the AoLP (N,) within the part, degrees."""
    camera = truth.views[name].camera
    assert isinstance(camera, PinholeCamera)
    xy = pixel_centers(scale * camera.width, scale * camera.height) / scale
    rays = camera.rays(xy).astype(np.float32)
    inside = cv2.erode(truth.mask(name).astype(np.uint8), np.ones((7, 7), np.uint8)) > 0
    normals = np.asarray(_grown(truth.normals(name), scale), np.float64)
    predicted = phase_from_normal(AngleModel.PPA, np.nan_to_num(unit(normals)), rays)
    measured = correct_stokes(stokes, rays, diffuse=False).phase()
    counted = np.asarray(_grown(inside, scale), np.bool_) & clear & (stokes.dolp > MIN_DOLP)
    counted &= np.isfinite(predicted) & np.isfinite(normals).all(axis=-1)
    return np.degrees(axial_difference(measured, np.nan_to_num(predicted))[counted])


def _false_dolp(
    stokes: Stokes, truth: GroundTruth, name: str, scale: int, clear: Mask
) -> NDArray[np.float64]:
    """DoLP (N,) at edges well beside the part, where the light is not polarized."""
    s0 = stokes.s0
    dx, dy = (
        cv2.Sobel(s0, cv2.CV_32F, i, 1 - i, scale=1 / 8) * scale / np.maximum(s0, 1e-3)
        for i in (1, 0)
    )
    beside = cv2.dilate(truth.mask(name).astype(np.uint8), np.ones((31, 31), np.uint8)) == 0
    edge = np.asarray(_grown(beside, scale), np.bool_) & clear & (np.hypot(dx, dy) > EDGE_SLOPE)
    return np.asarray(stokes.dolp[edge], np.float64)


def _demosaicing(call: Call, terminal: Terminal) -> int:
    found = {folder.name: measure(folder) for folder in call.get(Arguments).captures}
    header = ["capture", "way", "AoLP median / RMSE, deg", "DoLP at edges, median / 95 %", "ms"]
    rows = [
        [
            capture,
            way,
            f"{f.median_deg:.2f} / {f.rmse_deg:.2f}",
            f"{f.false_median:.3f} / {f.false_p95:.3f}",
            f"{1e3 * f.seconds:.1f}",
        ]
        for capture, ways in found.items()
        for way, f in ways.items()
    ]
    terminal.show(format_table(header, rows), found)
    return 0


main = script(__file__, __doc__, _demosaicing, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
