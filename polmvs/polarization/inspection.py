"""Inspection of a capture: what its files are and how well they are exposed.

:func:`inspect_capture` gives numbers, :func:`contact_sheet` a picture of some views: intensity,
AoLP as hue with its wheel, DoLP.
"""

from __future__ import annotations

import textwrap
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Image
from polmvs.config import CaptureKind, RegionOptions, Resolution
from polmvs.errors import printable
from polmvs.parallel import OnProgress, no_progress
from polmvs.polarization.capture import Capture, intensity_image_8bit
from polmvs.polarization.region import find_region
from polmvs.polarization.stokes import Stokes
from polmvs.scene import MIN_VIEWS, evenly_spread, short_list

Picture = NDArray[np.uint8]

SHOWN_DOLP = 0.5  # DoLP that is shown white, and AoLP in full colour
SHEET_VIEWS = 8
TILE_PX = 320  # width of one picture
MARGIN_PX = 6
HEADER_PX = 96
LINE_PX, CHARACTER_PX = 22, 8
WHITE, GRAY, ORANGE = (255, 255, 255), (160, 160, 160), (60, 160, 255)  # BGR


@dataclass(frozen=True, kw_only=True)
class InspectionLimits:
    """Limits beyond which a warning is given; all are guesses of what still works.

    Attributes
    ----------
    saturated : share of the part's pixels that are clipped, in a view.
    noisy_deg : deviation of the AoLP on the part, median over the views.
    few_views : number of views below which a surface has little support.
    dark_white : brightest 0.5 % of the capture, share of full scale.
    polarized : share of the capture's pixels that are polarized.
    edge_px : width of the sharpest edges of a view.
    uneven : ratio of the brightest to the darkest view's median intensity.
    colour : difference in brightness of the four 2x2 blocks of a colour sensor, share.
    """

    saturated: float = 0.1
    noisy_deg: float = 15.0
    few_views: int = 10
    dark_white: float = 0.2
    polarized: float = 0.01
    edge_px: float = 6.0
    uneven: float = 4.0
    colour: float = 0.06


@dataclass(frozen=True, kw_only=True)
class ViewFigures:
    """One view in numbers.

    Attributes
    ----------
    name : of the view.
    median_intensity : of s0 / 2, share of full scale.
    saturated : share of pixels that a clipped sample contributes to, or that are not finite.
    part : share of all pixels that lie on the polarized part.
    part_saturated : share of the part's pixels that are clipped; NaN without a part.
    dark : share of pixels below the darkness threshold.
    polarized : share of all pixels that are valid and have a DoLP of 0.1 and more.
    median_dolp : of the valid pixels.
    sigma_aolp_deg : median over the polarized pixels; NaN without any.
    gain_sigma : see :class:`polmvs.polarization.stokes.Stokes`.
    edge_px : width of the sharpest edges, px: contrast over slope. 2 is perfect, 5 blurred.
    """

    name: str
    median_intensity: float
    saturated: float
    part: float
    part_saturated: float
    dark: float
    polarized: float
    median_dolp: float
    sigma_aolp_deg: float
    gain_sigma: float
    edge_px: float


@dataclass(frozen=True, kw_only=True)
class Inspection:
    """A capture in numbers.

    Attributes
    ----------
    capture : the opened capture, with what was recognized and decided.
    white : s0 / 2 of the brightest 0.5 % of pixels, share of full scale.
    views : figures of each view.
    warnings : what a user should check, one line each.
    obstacles : reasons why the capture is unusable, as clauses.
    """

    capture: Capture
    white: float
    views: tuple[ViewFigures, ...]
    warnings: tuple[str, ...] = field(default=())
    obstacles: tuple[str, ...] = field(default=())

    @property
    def verdict(self) -> str:
        """One sentence: whether the capture is usable."""
        if self.obstacles:
            return f"This capture will not do, because {'; and '.join(self.obstacles)}."
        if self.warnings:
            count = len(self.warnings)
            said = "the warning" if count == 1 else f"the {count} warnings"
            return f"This capture will do, but {said} above should be looked at."
        return "This capture will do."

    @property
    def lines(self) -> tuple[str, ...]:
        """The inspection as lines of text: the format, a table of the views, warnings."""
        header = (
            f"{'view':<24} {'intensity':>9} {'part':>6} {'clipped':>8} {'dark':>7} "
            f"{'polarized':>9} {'DoLP':>6} {'sigma AoLP':>10} {'edge':>7}"
        )
        rows = [
            f"{printable(v.name)[-24:]:<24} {100 * v.median_intensity:>7.1f} % "
            f"{100 * v.part:>4.0f} % "
            f"{100 * v.part_saturated:>6.1f} % {100 * v.dark:>5.1f} % {100 * v.polarized:>7.1f} % "
            f"{v.median_dolp:>6.3f} {v.sigma_aolp_deg:>6.2f} deg {v.edge_px:>4.1f} px"
            for v in self.views
        ]
        size = f"polarization images of {self.capture.width}x{self.capture.height} px"
        warned = [f"warning: {text}" for text in self.warnings]
        told = "clipped: share of the part, where the light is polarized"
        return (*self.capture.notes, size, header, *rows, told, *warned, self.verdict)


def inspect_capture(
    capture: Capture,
    *,
    limits: InspectionLimits = InspectionLimits(),
    on_progress: OnProgress = no_progress,
) -> Inspection:
    """Inspect every view of a capture.

    Parameters
    ----------
    limits : limits of the warnings.
    on_progress : called with 1 after each view.

    Raises
    ------
    DataError
        A view cannot be read.
    """
    white = 0.5 * capture.exposure()
    figures: list[ViewFigures] = []
    colour = 0.0
    for name in capture.names:
        stokes = capture.load(name)
        if not figures:
            colour = _block_differences(capture, stokes)
        figures.append(_figures_of(name, stokes, capture.options.darkness))
        on_progress(1)
    return Inspection(
        capture=capture,
        white=white,
        views=tuple(figures),
        warnings=tuple(_warnings(capture, white, figures, colour, limits)),
        obstacles=tuple(_obstacles(capture, figures, limits)),
    )


def contact_sheet(capture: Capture, worded: Callable[[str], str] = str) -> Picture:
    """Pictures of eight views in two columns; each row is intensity, AoLP and DoLP of one view.

    Parameters
    ----------
    worded : turns a line that names options by their paths into the shown text.

    Returns
    -------
    (H, W, 3) uint8, BGR. Clipped pixels are red in the intensity. The hue is the AoLP, paler and
    darker where the DoLP is below 0.5.
    """
    white = capture.exposure()
    tiles = []
    for name in [capture.names[k] for k in evenly_spread(len(capture.names), SHEET_VIEWS)]:
        stokes = capture.load(name)
        shown = (intensity_picture(stokes, white), aolp_picture(stokes), dolp_picture(stokes))
        captions = (f"{name}  intensity", "AoLP", f"DoLP, white: {SHOWN_DOLP:g}")
        tiles.append(np.hstack([_tile(*pair) for pair in zip(shown, captions, strict=True)]))
    columns = 2 if len(tiles) > 2 else 1
    if len(tiles) % columns:
        tiles.append(np.zeros_like(tiles[0]))
    rows = [np.hstack(tiles[k : k + columns]) for k in range(0, len(tiles), columns)]
    body = np.vstack(rows)
    return np.vstack([_header(capture, body.shape[1], worded), body])


def intensity_picture(stokes: Stokes, white: float) -> Picture:
    """Intensity as a picture (H, W, 3), BGR; bright pixels that are not valid are red."""
    gray = intensity_image_8bit(stokes, white)
    picture = np.dstack([gray, gray, gray])
    picture[~stokes.valid & (stokes.s0 > 0.1 * white)] = (40, 40, 255)
    return picture


def aolp_picture(stokes: Stokes) -> Picture:
    """AoLP as hue (H, W, 3), BGR: red 0, and once around the circle in 180 degrees."""
    return _hue_picture(stokes.aolp, np.clip(stokes.dolp / SHOWN_DOLP, 0, 1))


def dolp_picture(stokes: Stokes) -> Picture:
    """DoLP as grey (H, W, 3), white from 0.5."""
    gray = np.rint(255 * np.clip(stokes.dolp / SHOWN_DOLP, 0, 1)).astype(np.uint8)
    return np.dstack([gray, gray, gray])


def _hue_picture(aolp: Image, strength: Image) -> Picture:
    """Axial angles in rad as colours; OpenCV's hue has 180 steps."""
    hue = np.mod(np.rint(aolp * (180 / np.pi)), 180).astype(np.uint8)
    # A root keeps weakly polarized surfaces visible.
    value = np.rint(255 * np.sqrt(np.clip(strength, 0, 1))).astype(np.uint8)
    hsv = np.dstack([hue, value, value])
    return np.asarray(cv2.cvtColor(hsv, cv2.COLOR_HSV2BGR), np.uint8)


def _wheel(size: int) -> Picture:
    """Colours of the AoLP's directions: each colour lies along its angle."""
    y, x = np.mgrid[0:size, 0:size] - (size - 1) / 2
    radius = np.hypot(x, y)
    angle = np.mod(np.arctan2(-y, x), np.pi).astype(np.float32)
    inside = (radius < size / 2 - 1) & (radius > size / 6)
    return _hue_picture(angle, inside.astype(np.float32))


def _tile(picture: Picture, caption: str) -> Picture:
    """A picture of the tiles' width with its caption and a margin."""
    height = round(picture.shape[0] * TILE_PX / picture.shape[1])
    small = cv2.resize(picture, (TILE_PX, height), interpolation=cv2.INTER_AREA)
    tile = np.zeros((height + LINE_PX + MARGIN_PX, TILE_PX + MARGIN_PX, 3), np.uint8)
    tile[LINE_PX : LINE_PX + height, :TILE_PX] = small
    _write(tile, caption, (2, LINE_PX - 7), WHITE)
    return tile


def _header(capture: Capture, width: int, worded: Callable[[str], str]) -> Picture:
    """The wheel and what the capture is."""
    wheel = _wheel(HEADER_PX - 12)
    left = wheel.shape[1] + 14
    room = (width - left) // CHARACTER_PX
    lines = [(str(capture.folder), WHITE)]
    for note in capture.notes:  # whole: what a warning says to do stands at its end
        colour = ORANGE if note in capture.warnings else GRAY
        lines += [(line, colour) for line in textwrap.wrap(worded(note), room)]
    height = max(HEADER_PX, LINE_PX * len(lines) + 8)
    header = np.zeros((height, width, 3), np.uint8)
    header[6 : 6 + wheel.shape[0], 6 : 6 + wheel.shape[1]] = wheel
    for k, (line, colour) in enumerate(lines):
        _write(header, line, (left, 18 + LINE_PX * k), colour)
    return header


def _write(picture: Picture, text: str, at: tuple[int, int], colour: tuple[int, int, int]) -> None:
    plain = text.encode("ascii", "replace").decode()
    cv2.putText(picture, plain, at, cv2.FONT_HERSHEY_SIMPLEX, 0.42, colour, 1, cv2.LINE_AA)


def _figures_of(name: str, stokes: Stokes, darkness: float) -> ViewFigures:
    valid, s0 = stokes.valid, stokes.s0
    dolp = stokes.dolp
    dark = ~valid & (s0 < 2.0 * darkness)
    polarized = valid & (dolp >= RegionOptions.min_dolp)
    sigma = np.degrees(np.median(stokes.sigma_aolp[polarized])) if polarized.any() else np.nan
    clipped = ~valid & ~dark
    part = _part(stokes, clipped)
    return ViewFigures(
        name=name,
        median_intensity=0.5 * float(np.median(s0)),
        saturated=float(np.mean(clipped)),
        part=float(np.mean(part)),
        part_saturated=float(np.mean(clipped[part])) if part.any() else float("nan"),
        dark=float(np.mean(dark)),
        polarized=float(np.mean(polarized)),
        median_dolp=float(np.median(dolp[valid])) if valid.any() else 0.0,
        sigma_aolp_deg=float(sigma),
        gain_sigma=stokes.gain_sigma,
        edge_px=_edge_width(s0),
    )


def _part(stokes: Stokes, clipped: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Polarized pixels (H, W), and clipped spots with more than half of their border polarized."""
    region = find_region(
        stokes.s0, stokes.s1, stokes.s2, stokes.valid, min_dolp=RegionOptions.min_dolp
    ).inside
    count, labels = cv2.connectedComponents(clipped.astype(np.uint8), connectivity=8)
    rim, inner = np.zeros(count), np.zeros(count)
    for axis in (0, 1):
        for step in (1, -1):
            # A neighbour beyond the border of the image is the pixel itself.
            place = np.clip(np.arange(clipped.shape[axis]) + step, 0, clipped.shape[axis] - 1)
            outside = clipped & ~np.take(clipped, place, axis=axis)
            rim += np.bincount(labels[outside], minlength=count)
            inner += np.bincount(
                labels[outside & np.take(region, place, axis=axis)], minlength=count
            )
    of_part = inner > 0.5 * rim
    of_part[0] = False
    return np.asarray(region | of_part[labels])


def _edge_width(s0: Image) -> float:
    """Contrast over slope at the steepest 0.5 % of pixels, px; NaN in an even image."""
    gx = cv2.Sobel(s0, cv2.CV_32F, 1, 0, scale=0.125)
    gy = cv2.Sobel(s0, cv2.CV_32F, 0, 1, scale=0.125)
    slope = np.hypot(gx, gy)
    kernel = np.ones((9, 9), np.uint8)
    contrast = cv2.dilate(s0, kernel) - cv2.erode(s0, kernel)
    steep = slope >= np.quantile(slope, 0.995)
    if not slope[steep].max(initial=0) > 0:
        return float("nan")
    return float(np.median(contrast[steep] / np.maximum(slope[steep], 1e-12)))


def _block_differences(capture: Capture, stokes: Stokes) -> float:
    """Relative difference of brightness in blocks of 2x2 cells, as a Bayer pattern makes it."""
    options = capture.options
    half = options.resolution is Resolution.HALF
    if capture.files.kind is not CaptureKind.MOSAIC or options.bayer is not None or not half:
        return 0.0
    rows, cols = (side // 2 * 2 for side in stokes.shape)
    blocks: NDArray[Any] = stokes.s0[:rows, :cols].reshape(rows // 2, 2, cols // 2, 2)
    mean = blocks.mean(axis=(1, 3))
    lit = mean > 2 * options.darkness
    if not lit.any():
        return 0.0
    shares = [float(np.median(blocks[:, i, :, j][lit] / mean[lit])) for i in (0, 1) for j in (0, 1)]
    return max(shares) - min(shares)


def _obstacles(
    capture: Capture, views: Sequence[ViewFigures], limits: InspectionLimits
) -> list[str]:
    """Reasons why a capture is unusable, as clauses after "because"."""
    lines = []
    if len(views) < MIN_VIEWS:
        lines.append(
            f"it has {len(views)} view{'s' * (len(views) != 1)}: a surface takes three or more"
        )
    polarized = float(np.mean([v.polarized for v in views]))
    if polarized < limits.polarized:
        lines.append(
            f"{100 * polarized:.1f} % of its pixels are polarized (DoLP "
            f"{RegionOptions.min_dolp:g}); is it a polarization camera's raw format, and is the "
            "part glossy?"
        )
    sigma = [v.sigma_aolp_deg for v in views if np.isfinite(v.sigma_aolp_deg)]
    if sigma and float(np.median(sigma)) > limits.noisy_deg:
        lines.append(
            f"noise turns the angles by {np.median(sigma):.0f} deg (median of the polarized "
            "pixels); expose more"
        )
    if capture.unequal_exposure is not None and not capture.options.equalize:
        lines.append(
            "the exposures of its polarizer angles differ, which looks like polarization "
            "everywhere; give `capture.equalize`"
        )
    return lines


def _warnings(
    capture: Capture,
    white: float,
    views: Sequence[ViewFigures],
    colour: float,
    limits: InspectionLimits,
) -> list[str]:
    """Warnings for the user."""
    lines = list(capture.warnings)
    if colour > limits.colour:
        lines.append(
            f"neighbouring cells differ by {100 * colour:.0f} % in a 2x2 rhythm, as those of a "
            "colour sensor do; give `capture.bayer`"
        )
    spoiled = [v.name for v in views if v.part_saturated > limits.saturated]
    if spoiled:
        lines.append(
            f"more than {100 * limits.saturated:.0f} % of the part is clipped in "
            f"{short_list(spoiled)}; expose less"
        )
    if white < limits.dark_white:
        lines.append(f"the brightest 0.5 % are at {100 * white:.0f} % of full scale; expose more")
    if MIN_VIEWS <= len(views) < limits.few_views:
        lines.append(f"{len(views)} views carry little; record ten or more, from all around")
    blurred = [v.name for v in views if v.edge_px > limits.edge_px]
    if blurred:
        lines.append(f"no sharp edge in {short_list(blurred)}: out of focus or moved")
    levels = [v.median_intensity for v in views if v.median_intensity > 0]
    if levels and max(levels) > limits.uneven * min(levels):
        lines.append(
            f"the views' intensities differ by a factor of {max(levels) / min(levels):.1f}; was "
            "automatic exposure on?"
        )
    return lines
