"""A capture: a folder of one camera's polarization images, checked as a whole, loaded one by one.

File names give the files of each view (:mod:`polmvs.io.capture_files`); the samples of all files
give the meaning of their values (:mod:`polmvs.polarization.bit_depth`). :class:`Capture` holds
these decisions; its ``notes`` describe them.
"""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Image, Mask
from polmvs.config import CaptureKind, CaptureOptions, Channel, Resolution, default_num_workers
from polmvs.errors import DataError, OptionError
from polmvs.io.capture_files import CaptureFiles, ViewFiles, find_capture
from polmvs.io.raw_formats import (
    FLOAT_SUFFIXES,
    UPRIGHT,
    DumpSize,
    RawHeader,
    RawImage,
    probe_raw,
    read_raw,
)
from polmvs.polarization.angle_gains import (
    AngleGains,
    CaptureGains,
    ChannelGains,
    capture_gains,
    find_angle_gains,
)
from polmvs.polarization.bit_depth import CONTAINER_BITS, LevelCounts, Levels, decide_levels
from polmvs.polarization.calibration import PolarizerCalibration, read_calibration
from polmvs.polarization.exposures import merge_exposures
from polmvs.polarization.linearity import LinearityCheck, check_linearity
from polmvs.polarization.lossy import BLOCK, find_quantization, lossy_mean_variance, lossy_variance
from polmvs.polarization.mosaic import (
    ANGLES_DEG,
    clipped_cells,
    linearize,
    noise_area_px,
    split_colour_mosaic,
    split_mosaic,
    split_mosaic_full,
)
from polmvs.polarization.pattern_check import PatternCheck, check_pattern
from polmvs.polarization.stokes import (
    Stokes,
    combine,
    ideal_analyzers,
    stokes_by_least_squares,
    stokes_from_intensities,
    stokes_from_maps,
    turned_axes,
)

logger = logging.getLogger(__name__)

T = TypeVar("T")

_scratch = threading.local()

DISPLAY_GAMMA = 2.2
WHITE_PERCENTILE = 99.5
WHITE_IMAGES = 32  # images from which the white level is taken, evenly spread over the capture
WHITE_SAMPLES = 20_000  # cells of each
# That are looked at for lossy compression, the pattern and the gamma, evenly spread. Fewer do not
# tell the gamma: in one image the scene's own change of polarization passes for one, found 0.46 to
# 1.29 in single linear images of the shared captures, 1.00 to 1.03 in whole captures.
CHECKED_IMAGES = 3
GAIN_VIEWS = 8  # whose gains are looked at, evenly spread: a median and a spread of them
MOST_PIXELS, MAX_DOLP = 0.9, 1.5  # a map of which a tenth exceeds this holds something else
# A camera that records 16 bits hardly needs 1/65536 to tell its levels apart; floats say nothing.
FLOAT_QUANTUM = 2.0**-CONTAINER_BITS
EVEN = "Set the camera's region of interest to even offsets and sizes."


@dataclass(frozen=True, kw_only=True)
class Capture:
    """Polarization images of one camera at one setting; the pixels are not held in memory.

    Attributes
    ----------
    folder : as given by the user.
    files : its views and the content of their files.
    header : size and type of each file's samples.
    width, height : of the polarization images, px.
    levels : meaning of the sample values.
    options : how to make polarization images of the samples.
    calibration : of the polarizers, if there is one.
    lossy_steps : (64,) steps of the JPEG of the samples, row by row; None without one.
    orientations : TIFF orientations that occur; the samples are as stored.
    pattern_check, linearity_check : of a monochrome mosaic's pattern and gamma; None for others.
    angle_gains : of the checked views of an ``ANGLES`` capture; empty for others.
    gains : of the polarizer angles, for each colour of a mosaic; empty if they are not known.
    """

    folder: Path
    files: CaptureFiles
    header: RawHeader
    width: int
    height: int
    levels: Levels
    options: CaptureOptions
    calibration: PolarizerCalibration | None = None
    lossy_steps: tuple[float, ...] | None = None
    orientations: tuple[int, ...] = (UPRIGHT,)
    pattern_check: PatternCheck | None = None
    linearity_check: LinearityCheck | None = None
    angle_gains: tuple[AngleGains, ...] = ()
    gains: tuple[CaptureGains, ...] = ()

    @property
    def paths(self) -> tuple[Path, ...]:
        """All files, view by view."""
        return self.files.paths

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the views; for single mosaics their file names."""
        return tuple(view.name for view in self.files.views)

    @property
    def has_colors(self) -> bool:
        """Whether its files are from a colour camera."""
        return self.options.bayer is not None or (
            self.files.kind is not CaptureKind.AOLP
            and self.header.channels == 3
            and not (self.files.kind is CaptureKind.STOKES and len(self.files.views[0].files) == 1)
        )

    @property
    def full_scale(self) -> float:
        """Value of a saturated sample."""
        return self.levels.full_scale

    @property
    def notes(self) -> tuple[str, ...]:
        """Recognized files and decisions, one line each."""
        files, header = self.files, self.header
        what = {
            CaptureKind.MOSAIC: "raw mosaics",
            CaptureKind.ANGLES: "an image for each polarizer angle "
            + ", ".join(f"{angle:g}" for angle in files.angles_deg),
            CaptureKind.STOKES: "Stokes images",
            CaptureKind.AOLP: "maps of angle and degree of polarization",
        }[files.kind]
        if self.options.bayer is not None:
            what = f"colour mosaics ({self.options.bayer}, {self.options.channel})"
        lines = [
            f"{len(files.views)} views, {what}; files of {header.width}x{header.height} px, "
            f"{header.dtype}",
            self.levels.reason,
        ]
        if len(files.exposures_s) > 1:
            times = ", ".join(f"{1e3 * time:g}" for time in files.exposures_s)
            lines.append(f"{len(files.exposures_s)} exposures a view, {times} ms, are merged")
        lines.extend(self.warnings)
        if self.pattern_check is not None:
            lines.append(self.pattern_check.message)
        if self.linearity_check is not None and self.linearity_check.fits is not False:
            lines.append(self.linearity_check.message)
        lines.extend(gains.message for gains in self.gains if gains.message is not None)
        return tuple(lines)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The notes that a user should act on."""
        lines = []
        if self.orientations != (UPRIGHT,):
            tags = ", ".join(map(str, self.orientations))
            lines.append(
                f"TIFF orientation {tags} is not applied: polarization images stay as the sensor "
                "recorded them"
            )
        if self.lossy_steps is not None:
            lines.append(
                "compressed with loss (JPEG), which blurs the polarizers into each other; the "
                "stated noise is widened by it. Record PNG or TIFF"
            )
        if self.linearity_check is not None and self.linearity_check.fits is False:
            lines.append(self.linearity_check.message)
        if self.unequal_exposure is not None and not self.options.equalize:
            lines.append(self.unequal_exposure)
        return tuple(lines)

    @property
    def unequal_exposure(self) -> str | None:
        """A message if the polarizer angles differ in exposure, else None."""
        differing = [found for found in self.angle_gains if found.differ]
        if not differing:
            return None
        worst = max(differing, key=lambda found: found.ratio)
        gains = ", ".join(
            f"{angle:g} deg {gain / max(worst.gains):.2g}"
            for angle, gain in zip(self.files.angles_deg, worst.gains, strict=True)
        )
        return (
            f"the images of a view differ in exposure by up to a factor of {worst.ratio:.1f} "
            f"({gains}), in {len(differing)} of {len(self.angle_gains)} views looked at: automatic "
            "exposure, or a filter turned by hand? Record them at one exposure, or give "
            "`capture.equalize`, which divides them by the gains found over unpolarized places"
        )

    def load(self, name: str) -> Stokes:
        """Read a view and convert it to Stokes images ``(height, width)``.

        Raises
        ------
        DataError
            A file is missing, damaged or has changed since the capture was opened.
        """
        view = self._view(name)
        match self.files.kind:
            case CaptureKind.MOSAIC:
                stokes = self._from_mosaic(view)
            case CaptureKind.ANGLES:
                stokes = self._from_angles(view)
            case CaptureKind.STOKES:
                stokes = self._from_stokes(view)
            case CaptureKind.AOLP:
                stokes = self._from_maps(view)
        options = self.options
        mosaic = self.files.kind is CaptureKind.MOSAIC
        if self.lossy_steps is not None and not (mosaic and options.resolution is Resolution.HALF):
            stokes = replace(stokes, lossy_block_px=float(BLOCK))
        if mosaic:
            area = noise_area_px(
                colour=options.bayer is not None, full=options.resolution is Resolution.FULL
            )
            stokes = replace(stokes, noise_area_px=area)
        return turned_axes(stokes, zero_deg=options.zero_deg, clockwise=options.clockwise)

    def load_mosaic(self, name: str) -> Image:
        """Linear samples of a view's mosaic (H, W), shares of full scale, exposures merged.

        Raises
        ------
        DataError
            As :meth:`load`; or the capture holds no mosaics.
        """
        if self.files.kind is not CaptureKind.MOSAIC:
            raise DataError(self.folder, f"holds {self.files.kind} images, no mosaics.")
        return self._linear(self._view(name).files[0])[0]

    def exposure(self) -> float:
        """White level of s0 for the whole capture, units of full scale: its 99.5 percentile.

        It is taken from at most 32 images, evenly spread, and 20,000 cells of each.

        Raises
        ------
        DataError
            The images are black.
        """
        views = self.files.views
        step = -(-len(views) // WHITE_IMAGES)
        samples = [self._intensity_samples(view) for view in views[::step]]
        white = float(np.percentile(np.concatenate(samples), WHITE_PERCENTILE))
        if not white > 0:
            raise DataError(self.folder, "the images are black. Check exposure and lens cap.")
        return white

    def _view(self, name: str) -> ViewFiles:
        for view in self.files.views:
            if view.name == name:
                return view
        raise ValueError(f"{name=} is not an image of {self.folder}.")

    def _read(self, path: Path) -> NDArray[Any]:
        """Samples of the size and type that the capture was opened with."""
        raw = read_raw(path, _dump_size(self.options), max_pixels=self.options.max_pixels)
        if raw.header != self.header and self.files.kind is not CaptureKind.AOLP:
            raise DataError(path, "has changed since the run began. Start the run again.")
        return raw.samples

    def _linear(self, paths: Sequence[Path]) -> tuple[Image, NDArray[Any], float]:
        """Linear samples, and an array of samples with the value from which they are clipped."""
        threshold = self._threshold
        images, raws = [], []
        for path in paths:
            raw = self._read(path)
            linear = linearize(raw, gamma=self.options.gamma, full_scale=self.full_scale)
            if self.calibration is not None:
                linear = self.calibration.correct(linear)
            images.append(linear)
            raws.append(raw)
        if len(paths) == 1:
            return images[0], raws[0], threshold
        clipped = [raw >= threshold for raw in raws]
        merged, nowhere = merge_exposures(images, clipped, self.files.exposures_s)
        return merged, nowhere.astype(np.uint8), 1.0

    def _from_mosaic(self, view: ViewFiles) -> Stokes:
        colours, clipped = self._split(view)
        return self._one_colour(
            [self._stokes(images, clipped, index) for index, images in enumerate(colours)]
        )

    def _split(self, view: ViewFiles) -> tuple[list[Image], Mask]:
        """Four angle images (4, H, W) of each colour of a mosaic, and where one is clipped."""
        options = self.options
        if self._is_plain and len(view.paths) == 1:
            samples = self._read(view.paths[0])
            images = split_mosaic(
                samples,
                options.pattern,
                scale=1.0 / self.full_scale,
                out=_angle_images(self.height, self.width),
            )
            return [images], clipped_cells(samples, self._threshold)
        linear, raw, threshold = self._linear(view.files[0])
        full = options.resolution is Resolution.FULL
        clipped = clipped_cells(raw, threshold, colour=options.bayer is not None, full=full)
        if options.bayer is not None:
            colours = split_colour_mosaic(linear, options.pattern, options.bayer, full=full)
            return list(colours), clipped
        split = split_mosaic_full if full else split_mosaic
        return [split(linear, options.pattern)], clipped

    def _stokes(self, images: Image, clipped: Mask, colour: int) -> Stokes:
        """Stokes images of a mosaic's four angle images, of one colour or of a monochrome one."""
        darkness, quantum, lossy = self.options.darkness, self._quantum, self._lossy_variance
        if self.calibration is None:
            gains = self.gains[colour].common if self.gains else None
            if gains is not None:
                images /= np.array(gains.gains, np.float32)[:, None, None]
            return stokes_from_intensities(
                images,
                clipped,
                darkness=darkness,
                quantum=quantum,
                lossy_variance=lossy,
                gain_sigma=None if gains is None else gains.sigma,
            )
        shape = (self.header.height, self.header.width)
        full = self.options.resolution is Resolution.FULL
        analyzers = self.calibration.analyzers(shape, full=full)
        try:
            return stokes_by_least_squares(
                images,
                analyzers if self.options.bayer is None else analyzers[colour],
                clipped,
                darkness=darkness,
                quantum=quantum,
                interpolated=True,
                lossy_variance=lossy,
                gain_sigma=0.0,
            )
        except ValueError as error:
            file = self.options.calibration
            assert file is not None
            raise DataError(file, f"is of no polarization camera: {error}") from error

    def _angle_stack(self, view: ViewFiles) -> tuple[Image, Mask]:
        """Linear images (K, H, W) or (K, H, W, 3) of a view, and where any of them is clipped."""
        linear, clipped = [], []
        for paths in view.files:
            image, raw, threshold = self._linear(paths)
            linear.append(image)
            clipped.append(raw >= threshold)
        stack, spoiled = np.stack(linear), np.logical_or.reduce(clipped)
        return stack, spoiled.any(axis=-1) if spoiled.ndim == 3 else spoiled

    def find_gains(self, name: str) -> tuple[AngleGains, ...]:
        """Gains between the images of a view: of each colour of a mosaic, or of files together.

        Raises
        ------
        DataError
            As :meth:`load`.
        """
        view = self._view(name)
        if self.files.kind is CaptureKind.MOSAIC:
            colours, clipped = self._split(view)
            return tuple(self._gains_of(images, clipped) for images in colours)
        return (self._gains_of(*self._angle_stack(view)),)

    def _gains_of(self, stack: Image, spoiled: Mask) -> AngleGains:
        gray = stack if stack.ndim == 3 else stack.mean(axis=-1)
        usable = ~spoiled & (gray.min(axis=0) >= self.options.darkness)
        return find_angle_gains(gray, self._angles_deg, usable)

    @property
    def _angles_deg(self) -> tuple[float, ...]:
        mosaic = self.files.kind is CaptureKind.MOSAIC
        return tuple(map(float, ANGLES_DEG)) if mosaic else self.files.angles_deg

    def _from_angles(self, view: ViewFiles) -> Stokes:
        stack, spoiled = self._angle_stack(view)
        gains: ChannelGains | None = None
        if self.options.equalize:
            gains = ChannelGains(self._gains_of(stack, spoiled).gains, None)
        elif self.gains:
            gains = self.gains[0].common or self.gains[0].of(self._gains_of(stack, spoiled))
        if gains is not None:
            factors = np.array(gains.gains, np.float32)
            stack /= factors.reshape(-1, *(1,) * (stack.ndim - 1))
        planes = [stack] if stack.ndim == 3 else [stack[..., c] for c in range(stack.shape[3])]
        return self._one_colour(
            [
                stokes_by_least_squares(
                    np.ascontiguousarray(plane),
                    ideal_analyzers(self.files.angles_deg),
                    spoiled,
                    darkness=self.options.darkness,
                    quantum=self._quantum,
                    lossy_variance=self._lossy_variance,
                    gain_sigma=None if gains is None else gains.sigma,
                )
                for plane in planes
            ]
        )

    def _from_stokes(self, view: ViewFiles) -> Stokes:
        arrays = [self._read(role[0]) for role in view.files]
        if len(arrays) == 1:
            arrays = list(_planes_of_stokes(view.paths[0], arrays[0]))
        s0, s1, s2 = (array.astype(np.float32) / np.float32(self.full_scale) for array in arrays)
        colours = [(s0, s1, s2)]
        if s0.ndim == 3:
            colours = [(s0[..., c], s1[..., c], s2[..., c]) for c in range(s0.shape[2])]
        return self._one_colour([self._given_stokes(*planes) for planes in colours])

    def _from_maps(self, view: ViewFiles) -> Stokes:
        intensity, aolp, dolp = (self._read(r[0]) if r else None for r in view.files)
        path = view.files[1][0]
        if aolp is None or aolp.ndim != 2:
            raise DataError(path, "an AoLP map has one channel.")
        angle, step = _angle_of(path, aolp)
        degree = np.ones(angle.shape, np.float32) if dolp is None else _share(view, 2, dolp)
        s0 = np.ones(angle.shape, np.float32) if intensity is None else _share(view, 0, intensity)
        for other, role in ((degree, 2), (s0, 0)):
            if other.shape != angle.shape:
                raise DataError(view.files[role][0], f"is not of the size of {path.name}.")
        polarized = s0 * degree
        quantum = 2.0 * step * float(np.nanmean(polarized)) if step else FLOAT_QUANTUM
        return self._given_stokes(
            s0, polarized * np.cos(2 * angle), polarized * np.sin(2 * angle), quantum=quantum
        )

    def _given_stokes(self, s0: Image, s1: Image, s2: Image, quantum: float = 0.0) -> Stokes:
        """Stokes images of given maps, invalid where dark, clipped or not finite."""
        finite = np.isfinite(s0) & np.isfinite(s1) & np.isfinite(s2)
        # What one channel clips does not show; where all do, s0 is the largest of the capture.
        clipped = s0 >= self.options.saturation * self.levels.clip_level / self.full_scale
        valid = finite & (s0 >= 2.0 * self.options.darkness) & ~clipped
        clean = [np.where(finite, image, 0).astype(np.float32) for image in (s0, s1, s2)]
        quantum = max(quantum, self._quantum)
        return stokes_from_maps(clean[0], clean[1], clean[2], valid, quantum=quantum)

    def _one_colour(self, colours: list[Stokes]) -> Stokes:
        if len(colours) == 1:
            return colours[0]
        if self.options.channel is Channel.COMBINED:
            return combine(colours)
        return colours[[Channel.RED, Channel.GREEN, Channel.BLUE].index(self.options.channel)]

    @property
    def _is_plain(self) -> bool:
        """Whether samples become angle images by nothing but interpolation and a factor."""
        options = self.options
        return (
            options.gamma == 1.0
            and options.bayer is None
            and options.resolution is Resolution.HALF
            and self.calibration is None
        )

    @property
    def _threshold(self) -> float:
        """Value from which a sample is clipped."""
        if self.levels.clip_level == math.inf:
            return math.inf
        return self.options.saturation * min(self.levels.full_scale, self.levels.clip_level)

    @property
    def _quantum(self) -> float:
        return self.levels.quantum if self.levels.step else FLOAT_QUANTUM

    @property
    def _lossy_variance(self) -> float:
        if self.lossy_steps is None:
            return 0.0
        steps = np.array(self.lossy_steps).reshape(8, 8)
        if self.files.kind is CaptureKind.MOSAIC:
            return lossy_variance(steps, scale=self._quantum)
        return lossy_mean_variance(
            steps, ideal_analyzers(self.files.angles_deg), scale=self._quantum
        )

    def _intensity_samples(self, view: ViewFiles) -> NDArray[np.float32]:
        """Intensity s0 of evenly spread cells of one image, ``(N,)``."""
        step = max(1, int(np.sqrt(self.width * self.height / WHITE_SAMPLES)))
        options = self.options
        plain = options.bayer is None and options.resolution is Resolution.HALF
        if self.files.kind is not CaptureKind.MOSAIC or not plain or len(view.paths) > 1:
            s0 = self.load(view.name).s0[step // 2 :: step, step // 2 :: step]
            return np.asarray(s0.ravel(), np.float32)
        raw = self._read(view.paths[0])
        rows = np.arange(step // 2, self.height, step) * 2
        cols = np.arange(step // 2, self.width, step) * 2
        sites = [np.ix_(rows + i, cols + j) for i in (0, 1) for j in (0, 1)]
        cells: NDArray[Any] = np.stack([raw[site] for site in sites])
        linear = linearize(cells, gamma=options.gamma, full_scale=self.full_scale)
        return np.asarray(0.5 * linear.sum(axis=0).ravel(), np.float32)


def open_capture(folder: str | PathLike[str], options: CaptureOptions | None = None) -> Capture:
    """Recognize the content of a folder, check every file, and describe the capture.

    8-bit PNGs are checked without decoding, except three; all other files are decoded, one at a
    time, to find the meaning of their values.

    Parameters
    ----------
    folder : see :mod:`polmvs.io.capture_files`.
    options : None for the defaults.

    Raises
    ------
    DataError
        There is no image, one is unusable, two differ in size or type, or a view lacks an image.
    OptionError
        An option contradicts the files, such as a pattern that does not fit.
    """
    chosen = CaptureOptions() if options is None else options
    files = find_capture(Path(folder), kind=chosen.kind, naming=chosen.naming, angles=chosen.angles)
    return _open(files, chosen)


def open_image(path: Path, options: CaptureOptions | None = None) -> Capture:
    """A capture of one raw mosaic.

    Raises
    ------
    DataError
        The file is missing, damaged or not a monochrome mosaic.
    """
    view = ViewFiles(name=path.name, files=((path,),))
    files = CaptureFiles(
        folder=path.parent,
        kind=CaptureKind.MOSAIC,
        angles_deg=(),
        exposures_s=(1.0,),
        views=(view,),
    )
    return _open(files, CaptureOptions() if options is None else options)


def _open(files: CaptureFiles, options: CaptureOptions) -> Capture:
    _require_fitting_options(files, options)
    calibration = None
    full_scale = options.full_scale
    if options.calibration is not None:
        calibration = read_calibration(options.calibration)
        if calibration.pattern != options.pattern:
            raise OptionError(
                f"is of the pattern {calibration.pattern}, `capture.pattern` is {options.pattern}.",
                field="capture.calibration",
            )
        if calibration.bayer is not options.bayer:
            of = "a monochrome sensor" if calibration.bayer is None else calibration.bayer
            raise OptionError(
                f"is of {of}, `capture.bayer` is {options.bayer or 'not given'}.",
                field="capture.calibration",
            )
        full_scale = full_scale if full_scale is not None else calibration.full_scale
    header, levels, orientations, sampled = _survey(files, options, full_scale)
    mosaic = files.kind is CaptureKind.MOSAIC
    divisor = 2 if mosaic and options.resolution is Resolution.HALF else 1
    pattern_check = linearity_check = None
    if mosaic and options.bayer is None:
        samples = [raw.samples for raw in sampled]
        pattern_check = _check_pattern(files, options, levels, samples)
        linearity_check = _check_linearity(options, levels, samples)
    capture = Capture(
        folder=files.folder,
        files=files,
        header=header,
        width=header.width // divisor,
        height=header.height // divisor,
        levels=levels,
        options=options,
        calibration=calibration,
        lossy_steps=_lossy_steps(sampled),
        orientations=orientations,
        pattern_check=pattern_check,
        linearity_check=linearity_check,
    )
    if files.kind is CaptureKind.ANGLES or (mosaic and calibration is None):
        capture = _with_gains(capture)
    for warning in capture.warnings:
        logger.warning("%s: %s.", files.folder, warning)
    logger.info("%s: %s", files.folder, "; ".join(capture.notes))
    return capture


def intensity_image_8bit(stokes: Stokes, white: float) -> NDArray[np.uint8]:
    """8-bit intensity for COLMAP: one exposure for all views, gamma 2.2.

    Parameters
    ----------
    stokes : of one view.
    white : s0 that becomes 255, units of full scale; see :meth:`Capture.exposure`.

    Returns
    -------
    (H, W) uint8
    """
    if not white > 0:
        raise ValueError(f"{white=} but expected a positive number.")
    share = np.clip(stokes.s0 / np.float32(white), 0, 1)
    encoded = np.power(share, np.float32(1 / DISPLAY_GAMMA))
    return np.asarray(np.rint(np.float32(255) * encoded), np.uint8)


def _angle_images(height: int, width: int) -> Image:
    """Four angle images of this thread, which no result refers to.

    New memory for them would take a third of the time that a frame of 5 Mpx takes.
    """
    images: Image | None = getattr(_scratch, "images", None)
    if images is None or images.shape[1:] != (height, width):
        images = _scratch.images = np.empty((4, height, width), np.float32)
    return images


def _dump_size(options: CaptureOptions) -> DumpSize:
    return DumpSize(options.width, options.height, options.packing)


def _require_fitting_options(files: CaptureFiles, options: CaptureOptions) -> None:
    """Raise OptionError for options that do not apply to this kind of files."""
    if options.equalize and files.kind is not CaptureKind.ANGLES:
        raise OptionError(
            f"is of an image for each polarizer angle; {files.folder} holds {files.kind} images.",
            field="capture.equalize",
        )
    if files.kind is CaptureKind.MOSAIC:
        return
    defaults = CaptureOptions()
    for name in ("pattern", "bayer", "resolution", "calibration"):
        if getattr(options, name) != getattr(defaults, name):
            raise OptionError(
                f"`capture.{name}` is of raw mosaics; {files.folder} holds {files.kind} images."
            )


def _survey(
    files: CaptureFiles, options: CaptureOptions, full_scale: float | None
) -> tuple[RawHeader, Levels, tuple[int, ...], list[RawImage]]:
    """Header and levels of all files, their orientations, and a few of them decoded."""
    counts = LevelCounts()
    orientations: set[int] = set()
    looked_at = _evenly_chosen(files.paths)
    first: tuple[Path, RawHeader] | None = None
    sampled = []
    for view in files.views:
        for role, paths in enumerate(view.files):
            for path in paths:
                header, raw = probe_raw(path, max_pixels=options.max_pixels), None
                if header is None or header.dtype != "uint8" or path in looked_at:
                    raw = read_raw(path, _dump_size(options), max_pixels=options.max_pixels)
                    header = raw.header
                _require_usable(files.kind, path, header, options)
                if first is None:
                    first = (path, header)
                elif files.kind is not CaptureKind.AOLP or header[:2] != first[1][:2]:
                    _require_same(*first, path, header)
                if raw is None:
                    continue
                orientations.add(raw.orientation)
                # Of Stokes images s0 has the scale; the maps have each their own.
                has_scale = role == 0 or files.kind is not CaptureKind.STOKES
                if files.kind is not CaptureKind.AOLP and has_scale:
                    counts.add(raw.samples, raw.declared_bits)
                if path in looked_at:
                    sampled.append(raw)
    if first is None:
        raise DataError(files.folder, "holds no views.")
    levels = decide_levels(counts, full_scale)
    if files.kind is CaptureKind.AOLP:
        levels = Levels(
            bit_depth=0,
            full_scale=1.0,
            clip_level=math.inf,
            step=0.0,
            reason="maps of polarization",
        )
    return first[1], levels, tuple(sorted(orientations)) or (UPRIGHT,), sampled


def _with_gains(capture: Capture) -> Capture:
    """With the gains of its polarizer angles."""
    looked_at = _evenly_chosen(capture.names, GAIN_VIEWS)
    # Threads, as decoding releases Python's lock.
    with ThreadPoolExecutor(default_num_workers()) as pool:
        of_colours = list(zip(*pool.map(capture.find_gains, looked_at), strict=True))
    constant = capture.files.kind is CaptureKind.MOSAIC
    found = [capture_gains(views, capture._angles_deg, constant=constant) for views in of_colours]
    known = tuple(gains for gains in found if gains is not None)
    return replace(
        capture,
        angle_gains=() if constant else of_colours[0],
        gains=known if len(known) == len(found) else (),
    )


def _evenly_chosen(things: Sequence[T], num: int = CHECKED_IMAGES) -> list[T]:
    """Those that are looked at closely."""
    places = np.linspace(0, len(things) - 1, min(num, len(things)))
    return [things[int(place)] for place in places]


def _require_usable(
    kind: CaptureKind, path: Path, header: RawHeader, options: CaptureOptions
) -> None:
    """Raise an error if a file cannot belong to this kind of capture."""
    if kind is CaptureKind.MOSAIC:
        if header.dtype == "float32" and (header.channels in (3, 4) or header.height in (3, 4)):
            raise DataError(
                path,
                "holds three or more planes of floats, as Stokes images do. Give `capture.kind` "
                "stokes.",
            )
        if header.channels != 1:
            raise DataError(
                path,
                f"has {header.channels} channels; a monochrome polarizer mosaic is expected. "
                "Record the camera's raw format (Mono8 to Mono16), not a colour or processed one.",
            )
        cell = 2 if options.bayer is None else 4
        if header.width % cell or header.height % cell or not header.width or not header.height:
            what = "an even width and height" if cell == 2 else "sides that are multiples of 4"
            raise DataError(
                path,
                f"is {header.width}x{header.height} px; a polarizer mosaic has {what}. {EVEN}",
            )
        if header.dtype == "float32" and path.suffix.lower() not in FLOAT_SUFFIXES | {".npy"}:
            raise DataError(
                path, "has float32 samples; export the raw mosaic as 8- or 16-bit integers."
            )
    if kind is CaptureKind.STOKES and header.dtype != "float32":
        raise DataError(path, f"has {header.dtype} samples; files of kind stokes hold floats.")


def _require_same(first_path: Path, first: RawHeader, path: Path, header: RawHeader) -> None:
    """All files of a capture come from one camera at one setting."""
    if header[:2] != first[:2]:
        raise DataError(
            path,
            f"is {header.width}x{header.height} px but {first_path.name} is "
            f"{first.width}x{first.height} px. A capture holds images of one size.",
        )
    if header != first:
        raise DataError(
            path,
            f"has {_type_text(header)} but {first_path.name} has {_type_text(first)}. "
            "A capture holds images of one type.",
        )


def _type_text(header: RawHeader) -> str:
    bits = {"uint8": "8 bits a sample", "uint16": "16 bits a sample"}.get(header.dtype, "floats")
    return bits if header.channels == 1 else f"{header.channels} channels of {bits}"


def _lossy_steps(sampled: Sequence[RawImage]) -> tuple[float, ...] | None:
    """Steps of a JPEG in the samples that were looked at, the largest of all; None if none."""
    found: NDArray[np.float64] | None = None
    for raw in sampled:
        steps = raw.quantization
        if steps is None and raw.samples.dtype == np.uint8 and raw.samples.ndim == 2:
            steps = find_quantization(raw.samples)
        if steps is None and raw.lossy:  # a JPEG in a TIFF whose steps stay unknown: quality 50
            steps = np.full((8, 8), 64.0)
        if steps is not None:
            found = steps if found is None else np.maximum(found, steps)
    return None if found is None else tuple(map(float, found.ravel()))


def _check_pattern(
    files: CaptureFiles, options: CaptureOptions, levels: Levels, sampled: Sequence[NDArray[Any]]
) -> PatternCheck:
    """Check the pattern of a monochrome mosaic; one that does not fit is refused."""
    linear = [linearize(s, gamma=options.gamma, full_scale=levels.full_scale) for s in sampled]
    check = check_pattern(linear, options.pattern, clip=options.saturation)
    if check.fits is False:
        raise OptionError(f"{files.folder}: {check.message}.")
    return check


def _check_linearity(
    options: CaptureOptions, levels: Levels, sampled: Sequence[NDArray[Any]]
) -> LinearityCheck | None:
    """Check the gamma of a monochrome mosaic; None for too few images."""
    if len(sampled) < CHECKED_IMAGES:
        return None
    shares = [linearize(s, gamma=1.0, full_scale=levels.full_scale) for s in sampled]
    return check_linearity(shares, options.pattern, options.saturation, options.gamma)


def _planes_of_stokes(path: Path, array: NDArray[Any]) -> NDArray[Any]:
    """The planes (3, H, W) of an array (H, W, 3) or (3, H, W)."""
    if array.ndim == 3 and array.shape[0] in (3, 4) and array.shape[2] not in (3, 4):
        return array[:3]
    if array.ndim == 3 and array.shape[2] in (3, 4):
        return np.moveaxis(array[..., :3], -1, 0)
    raise DataError(path, f"is {array.shape}; Stokes images are (3, H, W) or (H, W, 3).")


def _angle_of(path: Path, values: NDArray[Any]) -> tuple[Image, float]:
    """An AoLP map in rad, and its step: integers cover half a turn, floats are rad or degrees."""
    if values.dtype.kind == "u":
        step = math.pi / np.iinfo(values.dtype).max
        return np.asarray(values * step, np.float32), step
    largest = float(np.nanmax(np.abs(values))) if values.size else 0.0
    if largest <= math.pi + 1e-3:
        return np.asarray(values, np.float32), 0.0
    if largest <= 180.5:
        return np.asarray(np.radians(values), np.float32), 0.0
    raise DataError(path, f"has angles up to {largest:g}, neither rad nor degrees of half a turn.")


def _share(view: ViewFiles, role: int, values: NDArray[Any]) -> Image:
    """A map of 0 to 1: integers of their largest, the mean of colours."""
    scale = 1.0 if values.dtype.kind == "f" else float(np.iinfo(values.dtype).max)
    plane = values if values.ndim == 2 else values.mean(axis=-1)
    share = np.asarray(plane / scale, np.float32)
    # Noise in dark pixels exceeds 1 without bound.
    if role == 2 and np.nanquantile(share, MOST_PIXELS) > MAX_DOLP:
        raise DataError(view.files[role][0], "has a degree of polarization far above 1.")
    return share
