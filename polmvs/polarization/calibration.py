"""Polarizer calibration: gain, angle and diattenuation of each sample of a sensor.

A sample of gain g behind a polarizer of angle a and extinction ratio E measures
``I = g / 2 (s0 + d (cos 2a s1 + sin 2a s2))`` with the diattenuation ``d = (E - 1) / (E + 1)``.
The gain is that for unpolarized light, so frames of a uniform unpolarized source (the flat field)
give it. Frames of a linear polarizer at known angles give a and d: behind a polarizer at t the
sample's value is ``A + B cos 2t + C sin 2t`` with ``tan 2a = C / B`` and ``d = hypot(B, C) / A``.
Each of the three is one number per channel (0, 45, 90, 135 degrees), or an array with a value for
each sample.

Each of the four 2x2 blocks of a colour sensor's 4x4 cell is calibrated as a separate sensor, so
one number per channel becomes one per channel and block. The mean gain of a block is 1, since the
colour of the lamp is not a property of the sensor.

Estimates of extinction ratios are unstable near d = 1, so the diattenuation is fitted and stored
(N. Hagen, S. Shibata, Y. Otani, Calibration and performance assessment of
microgrid polarization cameras, Opt. Eng. 58(8), 2019).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Image
from polmvs.config import BayerOrder, CaptureOptions
from polmvs.errors import DataError, as_data_error
from polmvs.io.arrays import map_array, save_array
from polmvs.io.images import write_bytes
from polmvs.io.plain_files import parse_toml, read_text
from polmvs.polarization.mosaic import (
    ANGLES_DEG,
    split_colour_mosaic,
    split_mosaic,
    split_mosaic_full,
)

Pattern = tuple[int, int, int, int]

VERSION = 1
MAX_ANGLE_ERROR_DEG = 20.0  # of a channel; more is another pattern, or angles of another direction
MIN_DIATTENUATION = 0.3  # of a channel; sensors have 0.9 and more
MIN_LIGHT = 0.01  # mean of a frame, share of full scale
LEVEL_ROUNDS = 300  # at most, of brightness against response
LEVEL_CHANGE = 1e-10  # of the brightness in one round, at which they agree


@dataclass(frozen=True, kw_only=True, eq=False)
class PolarizerCalibration:
    """Response of a sensor's samples; arrays are stored as files and mapped when used.

    Attributes
    ----------
    pattern : polarizer angles of a 2x2 cell of the sensor, row by row, degrees.
    gains : (4,), response to unpolarized light of the channels 0, 45, 90, 135 degrees, mean 1;
        ones if a flat field has the gains. Colour sensor: (16,), for each 2x2 block of its cell,
        row by row.
    angles_deg : (4,) or (16,), true angles of the channels, as displayed.
    diattenuations : (4,) or (16,), ``(E - 1) / (E + 1)``.
    dark : file of (H, W) float32, value of each sample without light, share of full scale.
    flat : file of (H, W) float32, response of each sample to unpolarized light, mean 1.
    angle_map, diattenuation_map : files of (H, W) float32, of each sample; in place of
        ``angles_deg`` and ``diattenuations``.
    full_scale : value of a saturated sample of the frames, the unit of the dark frame.
    bayer : colours of the 2x2 blocks of a colour sensor, row by row; None if monochrome.
    """

    pattern: Pattern
    gains: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    angles_deg: tuple[float, ...] = tuple(map(float, ANGLES_DEG))
    diattenuations: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    dark: Path | None = None
    flat: Path | None = None
    angle_map: Path | None = None
    diattenuation_map: Path | None = None
    full_scale: float | None = None
    bayer: BayerOrder | None = None

    @property
    def extinction_ratios(self) -> tuple[float, ...]:
        """Extinction ratio of each channel; infinite for an ideal one."""
        return tuple((1 + d) / (1 - d) if d < 1 else np.inf for d in self.diattenuations)

    def correct(self, linear: Image) -> Image:
        """Subtract the dark frame from a mosaic (H, W) and divide by the flat field.

        Raises
        ------
        DataError
            The arrays are of another size.
        """
        if self.dark is not None:
            linear = linear - _map_of(self.dark, linear.shape)
        if self.flat is not None:
            linear = linear / _map_of(self.flat, linear.shape)
        return np.asarray(linear, np.float32)

    def analyzers(self, shape: tuple[int, ...], *, full: bool = False) -> NDArray[np.floating[Any]]:
        """Rows of the four angle images of a mosaic of this shape.

        Returns
        -------
        (4, 3); or, if each sample has its own, (4, 3, H/2, W/2), in full resolution (4, 3, H, W).
        They are interpolated like the samples, so they are exact where the light is uniform. A
        colour sensor has one for red, green and blue each: (3, 4, 3) and so on.
        """
        if self.angle_map is None and self.diattenuation_map is None:
            twice = 2.0 * np.radians(np.asarray(self.angles_deg))
            d = np.asarray(self.diattenuations)
            rows = np.stack([np.ones_like(d), d * np.cos(twice), d * np.sin(twice)], axis=1)
            rows = 0.5 * np.asarray(self.gains)[:, None] * rows
            if self.bayer is None:
                return np.asarray(rows)
            blocks, colours = rows.reshape(4, 4, 3), np.array(list(self.bayer))
            # An image of green is the mean of two blocks.
            return np.stack([blocks[colours == colour].mean(axis=0) for colour in "rgb"])
        gains = _per_sample(self.gains, self.pattern, shape)
        angle = _per_sample(self.angles_deg, self.pattern, shape)
        strength = _per_sample(self.diattenuations, self.pattern, shape)
        if self.angle_map is not None:
            angle = _map_of(self.angle_map, shape)
        if self.diattenuation_map is not None:
            strength = _map_of(self.diattenuation_map, shape)
        twice = 2.0 * np.radians(angle)
        columns = [gains, gains * strength * np.cos(twice), gains * strength * np.sin(twice)]
        if self.bayer is not None:
            colour = [
                0.5 * split_colour_mosaic(column, self.pattern, self.bayer, full=full)
                for column in columns
            ]
            return np.stack(colour, axis=2)
        split = split_mosaic_full if full else split_mosaic
        return np.stack([0.5 * split(column, self.pattern) for column in columns], axis=1)


@dataclass(frozen=True, kw_only=True, eq=False)
class PolarizerResponse:
    """Response of a sensor, measured from frames of a source, before it is stored.

    Attributes
    ----------
    pattern : polarizer angles of a 2x2 cell, row by row.
    gains, angles_deg, diattenuations : (4,) or (16,), see :class:`PolarizerCalibration`.
    dark, flat, angle_map, diattenuation_map : (H, W) float32, or None.
    residual : rms of the fit to the frames of the polarizer, share of their mean.
    full_scale : value of a saturated sample of the frames, if known.
    bayer : of a colour sensor.
    """

    pattern: Pattern
    gains: Array
    angles_deg: Array
    diattenuations: Array
    dark: Image | None
    flat: Image | None
    angle_map: Image | None
    diattenuation_map: Image | None
    residual: float
    full_scale: float | None = None
    bayer: BayerOrder | None = None


def measure_response(
    pattern: Pattern,
    *,
    unpolarized: Sequence[Image] = (),
    polarized: Sequence[tuple[float, Image]] = (),
    dark: Sequence[Image] = (),
    per_sample: bool = False,
) -> PolarizerResponse:
    """Gains, angles and diattenuations of a sensor from frames of known light.

    Parameters
    ----------
    pattern : nominal polarizer angles of a 2x2 cell, row by row, degrees.
    unpolarized : mosaics (H, W) of a uniform unpolarized source, linear, shares of full scale.
    polarized : mosaics of that source behind a linear polarizer, each with the polarizer's
        transmission angle in degrees, anticlockwise from +x as displayed; three or more angles.
        The source's brightness may change between them.
    dark : mosaics without light.
    per_sample : a value for each sample instead of each channel; needs ten or more frames against
        noise.

    Raises
    ------
    ValueError
        No frame of light, fewer than three angles, frames of different or odd sizes, dark frames,
        or angles that do not fit the pattern.
    """
    frames = [*unpolarized, *(frame for _, frame in polarized), *dark]
    shapes = {frame.shape for frame in frames}
    if not unpolarized and not polarized:
        raise ValueError("no frames of a source; give unpolarized ones, polarized ones or both.")
    if len(shapes) != 1 or any(side % 2 for side in next(iter(shapes))):
        raise ValueError(f"frames of {sorted(shapes)}; expected one even size.")
    dark_mean = _mean(dark) if dark else None
    base = np.float32(0) if dark_mean is None else dark_mean
    gains, flat = np.ones(4), None
    if unpolarized:
        mean = _mean(unpolarized) - base
        if mean.mean() < MIN_LIGHT:
            raise ValueError("the frames of the unpolarized source are dark.")
        levels = _channel_means(mean, pattern)
        gains = levels / levels.mean()
        if per_sample:
            flat, gains = (mean / mean.mean()).astype(np.float32), np.ones(4)
    angles, strengths, residual = np.array(ANGLES_DEG, np.float64), np.ones(4), 0.0
    angle_map = strength_map = None
    if polarized:
        lit = [(angle, frame - base) for angle, frame in polarized]
        if min(frame.mean() for _, frame in lit) < MIN_LIGHT:
            raise ValueError("a frame of the polarized source is dark.")
        tilt = np.radians([angle for angle, _ in lit])
        values = np.stack([_channel_means(frame, pattern) for _, frame in lit])
        brightness, fitted, residual = _fit_polarizer(tilt, values)
        angles = _near_nominal(0.5 * np.degrees(np.arctan2(fitted[2], fitted[1])))
        strengths = np.minimum(np.hypot(fitted[1], fitted[2]) / fitted[0], 1.0)
        if strengths.min() < MIN_DIATTENUATION:
            raise ValueError(
                f"the samples hardly follow the polarizer (contrast {strengths.min():.2f}); are "
                "its angles right and is the source behind it?"
            )
        if not unpolarized:
            gains = fitted[0] / fitted[0].mean()
        if per_sample:
            angle_map, strength_map = _fit_samples(tilt, brightness, lit, pattern)
    return PolarizerResponse(
        pattern=pattern,
        gains=gains,
        angles_deg=angles,
        diattenuations=strengths,
        dark=dark_mean,
        flat=flat,
        angle_map=angle_map,
        diattenuation_map=strength_map,
        residual=residual,
    )


def measure_colour_response(
    pattern: Pattern,
    bayer: BayerOrder,
    *,
    unpolarized: Sequence[Image] = (),
    polarized: Sequence[tuple[float, Image]] = (),
    dark: Sequence[Image] = (),
    per_sample: bool = False,
) -> PolarizerResponse:
    """As :func:`measure_response`, of a sensor whose 2x2 cells lie under a Bayer pattern.

    Parameters
    ----------
    bayer : colours of the 2x2 blocks, row by row.

    Raises
    ------
    ValueError
        As there; or a side is not a multiple of 4.
    """
    frames = [*unpolarized, *(frame for _, frame in polarized), *dark]
    if any(side % 4 for frame in frames for side in frame.shape):
        raise ValueError("frames of a colour sensor have sides that are multiples of 4.")
    blocks = [
        measure_response(
            pattern,
            unpolarized=[_block(frame, k) for frame in unpolarized],
            polarized=[(angle, _block(frame, k)) for angle, frame in polarized],
            dark=[_block(frame, k) for frame in dark],
            per_sample=per_sample,
        )
        for k in range(4)
    ]
    return PolarizerResponse(
        pattern=pattern,
        gains=np.concatenate([block.gains for block in blocks]),
        angles_deg=np.concatenate([block.angles_deg for block in blocks]),
        diattenuations=np.concatenate([block.diattenuations for block in blocks]),
        dark=_joined([block.dark for block in blocks]),
        flat=_joined([block.flat for block in blocks]),
        angle_map=_joined([block.angle_map for block in blocks]),
        diattenuation_map=_joined([block.diattenuation_map for block in blocks]),
        residual=float(np.sqrt(np.mean([block.residual**2 for block in blocks]))),
        bayer=bayer,
    )


def _block(mosaic: Image, index: int) -> Image:
    """The mosaic (H/2, W/2) of one of the four 2x2 blocks of a 4x4 cell."""
    height, width = mosaic.shape
    row, col = 2 * (index // 2), 2 * (index % 2)
    cells = mosaic.reshape(height // 4, 4, width // 4, 4)[:, row : row + 2, :, col : col + 2]
    return np.ascontiguousarray(cells.reshape(height // 2, width // 2))


def _joined(blocks: Sequence[Image | None]) -> Image | None:
    """The mosaic (H, W) of four blocks' mosaics; None where they have none."""
    known = [block for block in blocks if block is not None]
    if len(known) < 4:
        return None
    height, width = known[0].shape
    cells = np.empty((height // 2, 4, width // 2, 4), np.float32)
    for k, block in enumerate(known):
        row, col = 2 * (k // 2), 2 * (k % 2)
        split = block.reshape(height // 2, 2, width // 2, 2)
        cells[:, row : row + 2, :, col : col + 2] = split
    return cells.reshape(2 * height, 2 * width)


def write_calibration(path: Path, response: PolarizerResponse) -> PolarizerCalibration:
    """Write a calibration as TOML with its arrays beside it, ``STEM_flat.npy`` and so on.

    Raises
    ------
    DataError
        The system refuses.
    """
    lines = [
        f"# Polarizer calibration of polmvs; residual {100 * response.residual:.2f} % of the mean.",
        f"version = {VERSION}",
        f"pattern = {list(response.pattern)}  # degrees, row by row",
        "# Channels 0, 45, 90, 135 degrees.",
        *([] if response.bayer is None else [f'bayer = "{response.bayer}"  # four of each block']),
        f"gains = {_numbers(response.gains)}",
        f"angles_deg = {_numbers(response.angles_deg)}",
        f"diattenuations = {_numbers(response.diattenuations)}",
    ]
    if response.full_scale is not None:
        lines.append(f"full_scale = {response.full_scale!r}")
    for name in ("dark", "flat", "angle_map", "diattenuation_map"):
        array = getattr(response, name)
        if array is not None:
            file = path.with_name(f"{path.stem}_{name}.npy")
            save_array(file, np.asarray(array, np.float32))
            lines.append(f'{name} = "{file.name}"')
    write_bytes(path, ("\n".join(lines) + "\n").encode())
    return read_calibration(path)


def read_calibration(path: Path) -> PolarizerCalibration:
    """Read a calibration file.

    Raises
    ------
    DataError
        The file or one of its arrays is missing, damaged, or has impossible values.
    """
    try:
        with as_data_error(path, "read"):
            content = parse_toml(read_text(path))
    except ValueError as error:
        raise DataError(path, "is no TOML file of a calibration.") from error
    known = {"version", "pattern", "bayer", "gains", "angles_deg", "diattenuations", "full_scale"}
    arrays = ("dark", "flat", "angle_map", "diattenuation_map")
    unknown = set(content) - known - set(arrays)
    if unknown or content.get("version") != VERSION:
        raise DataError(
            path,
            f"unknown key {min(unknown)!r}." if unknown else f"is not of version {VERSION}.",
        )
    pattern = _numbers_of(path, content, "pattern", CaptureOptions.pattern, 1)
    if sorted(pattern) != list(ANGLES_DEG):
        raise DataError(path, "pattern must hold 0, 45, 90 and 135 once each.")
    bayer = content.get("bayer")
    if bayer is not None and bayer not in list(BayerOrder):
        raise DataError(path, f"bayer must be one of {', '.join(BayerOrder)}.")
    blocks = 1 if bayer is None else 4
    values = {
        "gains": _numbers_of(path, content, "gains", (1,) * 4, blocks),
        "angles_deg": _numbers_of(path, content, "angles_deg", ANGLES_DEG, blocks),
        "diattenuations": _numbers_of(path, content, "diattenuations", (1,) * 4, blocks),
    }
    if min(values["gains"]) <= 0.1 or not all(0 < d <= 1 for d in values["diattenuations"]):
        raise DataError(path, "gains must be positive and diattenuations lie in 0 to 1.")
    try:
        for angles in np.reshape(values["angles_deg"], (-1, 4)):
            _near_nominal(angles)
    except ValueError as error:
        raise DataError(
            path, "angles_deg are those of the channels 0, 45, 90, 135, in this order."
        ) from error
    scale = content.get("full_scale")
    if scale is not None and not (type(scale) in (int, float) and 0 < scale < np.inf):
        raise DataError(path, "full_scale must be a positive number.")
    files: dict[str, Any] = {}
    for name in arrays:
        if name in content:
            if not isinstance(content[name], str):
                raise DataError(path, f"{name} must be the name of a file.")
            files[name] = path.parent / content[name]
            _check_map(files[name])
    first = [int(angle) for angle in pattern]
    return PolarizerCalibration(
        pattern=(first[0], first[1], first[2], first[3]),
        gains=values["gains"],
        angles_deg=values["angles_deg"],
        diattenuations=values["diattenuations"],
        **files,
        full_scale=None if scale is None else float(scale),
        bayer=None if bayer is None else BayerOrder(bayer),
    )


def _numbers_of(
    path: Path, content: dict[str, Any], key: str, default: Sequence[float], blocks: int
) -> tuple[float, ...]:
    """Four finite numbers for each of some blocks."""
    value = content.get(key, list(default) * blocks)
    good = isinstance(value, list) and len(value) == 4 * blocks
    # Integers of TOML may have any length.
    if not good or not all(type(v) in (int, float) and -1e300 < v < 1e300 for v in value):
        each = "" if blocks == 1 else ", for each of the four 2x2 blocks"
        raise DataError(path, f"{key} needs four numbers, of the channels 0, 45, 90, 135{each}.")
    return tuple(map(float, value))


def _check_map(path: Path) -> NDArray[Any]:
    """A plane of finite numbers."""
    array = map_array(path)
    if array.ndim != 2 or array.dtype.kind != "f" or not np.isfinite(array).all():
        raise DataError(path, "must hold (H, W) finite floats.")
    return array


def _map_of(path: Path, shape: tuple[int, ...]) -> Image:
    """An array of a mosaic's size."""
    array = map_array(path)
    if array.shape != tuple(shape):
        raise DataError(
            path,
            f"is {array.shape[1]}x{array.shape[0]} px, the mosaic {shape[1]}x{shape[0]} px. "
            "Calibrate at the capture's region of interest.",
        )
    return np.asarray(array, np.float32)


def _per_sample(values: Sequence[float], pattern: Pattern, shape: tuple[int, ...]) -> Image:
    """Values of the channels 0, 45, 90, 135, of one block or of four, at each sample's place."""
    out = np.empty(shape, np.float32)
    blocks = np.reshape(values, (-1, 4))
    period = 2 if len(blocks) == 1 else 4
    for block, own in enumerate(blocks):
        for cell, angle in enumerate(pattern):
            row, col = 2 * (block // 2) + cell // 2, 2 * (block % 2) + cell % 2
            out[row::period, col::period] = own[ANGLES_DEG.index(angle)]
    return out


def _mean(frames: Sequence[Image]) -> Image:
    """Mean of frames without holding more than one sum."""
    total = np.zeros(frames[0].shape)
    for frame in frames:
        total += frame
    return np.asarray(total / len(frames), np.float32)


def _channel_means(mosaic: Image, pattern: Pattern) -> Array:
    """Mean of the samples of 0, 45, 90 and 135 degrees."""
    means = np.empty(4)
    for cell, angle in enumerate(pattern):
        means[ANGLES_DEG.index(angle)] = mosaic[cell // 2 :: 2, cell % 2 :: 2].mean()
    return means


def _fit_polarizer(tilt: Array, values: Array) -> tuple[Array, Array, float]:
    """Brightness of each frame, ``A, B, C`` of each channel (3, 4), and rms residual.

    Brightness and response are fitted in turns: a frame's brightness is that which explains its
    four values best.
    """
    design = np.stack([np.ones_like(tilt), np.cos(2 * tilt), np.sin(2 * tilt)], axis=1)
    if len(tilt) < 3 or np.linalg.matrix_rank(design, tol=1e-2) < 3:
        raise ValueError("three or more different angles of the polarizer are needed.")
    brightness = values.mean(axis=1) / values.mean()
    for _ in range(LEVEL_ROUNDS):
        fitted, *_ = np.linalg.lstsq(design * brightness[:, None], values, rcond=None)
        response = design @ fitted
        before = brightness
        brightness = (values * response).sum(axis=1) / np.square(response).sum(axis=1)
        brightness /= brightness.mean()
        if np.abs(brightness - before).max() < LEVEL_CHANGE:
            break
    residual = values - brightness[:, None] * response
    return brightness, fitted, float(np.sqrt(np.mean(residual**2)) / values.mean())


def _fit_samples(
    tilt: Array, brightness: Array, frames: Sequence[tuple[float, Image]], pattern: Pattern
) -> tuple[Image, Image]:
    """True angle in degrees and diattenuation of every sample, (H, W) each."""
    design = np.stack([np.ones_like(tilt), np.cos(2 * tilt), np.sin(2 * tilt)], axis=1)
    inverse = np.linalg.pinv(design * brightness[:, None])
    a, b, c = (
        np.sum([w * frame for w, (_, frame) in zip(row, frames, strict=True)], axis=0)
        for row in inverse
    )
    nominal = _per_sample([float(angle) for angle in ANGLES_DEG], pattern, a.shape)
    angle = 0.5 * np.degrees(np.arctan2(c, b))
    angle = nominal + (angle - nominal + 90.0) % 180.0 - 90.0
    with np.errstate(divide="ignore", invalid="ignore"):
        strength = np.clip(np.hypot(b, c) / a, MIN_DIATTENUATION, 1.0)
    return angle.astype(np.float32), np.nan_to_num(strength, nan=1.0).astype(np.float32)


def _near_nominal(angles_deg: Array) -> Array:
    """Axial angles brought next to the nominal ones of their channels.

    Raises
    ------
    ValueError
        One is too far from it to be it.
    """
    nominal = np.array(ANGLES_DEG, np.float64)
    near = nominal + (angles_deg - nominal + 90.0) % 180.0 - 90.0
    if np.abs(near - nominal).max() > MAX_ANGLE_ERROR_DEG:
        found = ", ".join(f"{angle % 180:.1f}" for angle in angles_deg)
        raise ValueError(
            f"the channels 0, 45, 90, 135 are found at {found} degrees; check `capture.pattern`, "
            "and that the polarizer's angles count anticlockwise from +x as displayed."
        )
    return near


def _numbers(values: Array) -> str:
    return "[" + ", ".join(f"{value:.8g}" for value in values) + "]"
