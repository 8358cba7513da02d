"""Unpolarized light: presets and files as environments at infinity.

An environment is an equirectangular image of radiances: rows from the zenith down, columns by
azimuth. A ring light is not an environment: it moves with the camera.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from polmvs.arrays import Image
from polmvs.errors import DataError, OptionError
from polmvs.io.raw_formats import read_radiance
from polmvs.simulation.options import LightingOptions, LightName

HEIGHT = 256  # rows of a preset's image, 0.7 degrees each
RING_DIM = 0.05  # radiance of the room about a ring light
# Of the ring at the camera, in shares of the camera's distance.
RING_RADII = (0.12, 0.2)


def environment(options: LightingOptions) -> Image:
    """The light from infinity, (H, 2 H, 3) float32, radiance red, green, blue.

    Row r is at the elevation ``90 - 180 (r + 0.5) / H`` degrees, column c at the azimuth
    ``360 (c + 0.5) / (2 H)`` from the world's x towards its y.

    Raises
    ------
    OptionError, DataError
        A file is missing, not given or not an environment.
    """
    is_file = options.light is LightName.FILE
    if is_file != (options.environment is not None):
        raise OptionError(
            "needs `lighting.light` file."
            if not is_file
            else "is needed by `lighting.light` file.",
            field="lighting.environment",
        )
    if options.environment is not None:
        image = _read(options.environment)
    else:
        elevation, azimuth = _directions()
        image = _PRESETS[options.light](elevation, azimuth)
    if options.contrast is not None:
        image = _with_contrast(image, options.contrast)
    return np.asarray(image if image.ndim == 3 else np.repeat(image[..., None], 3, -1), np.float32)


def _directions() -> tuple[Image, Image]:
    """Elevation and azimuth, degrees, of a preset's pixels (H, 2 H)."""
    elevation = 90 - 180 * (np.arange(HEIGHT) + 0.5) / HEIGHT
    azimuth = 360 * (np.arange(2 * HEIGHT) + 0.5) / (2 * HEIGHT)
    grid = np.meshgrid(elevation, azimuth, indexing="ij")
    return np.asarray(grid[0], np.float32), np.asarray(grid[1], np.float32)


def _even(elevation: Image, azimuth: Image) -> Image:
    return np.ones_like(elevation)


def _overcast(elevation: Image, azimuth: Image) -> Image:
    """Moon and Spencer's sky: three times as bright above as at the horizon; a dim ground."""
    sky = (1 + 2 * np.sin(np.radians(elevation))) / 3
    return np.asarray(np.where(elevation > 0, sky, 0.15), np.float32)


def _studio(elevation: Image, azimuth: Image) -> Image:
    """A dim room with a bright ceiling, three lamps and two windows."""
    light = 0.12 + 0.25 * np.clip(elevation / 90, 0, 1)
    for center, up, across, along, radiance in (
        (35, 60, 26, 16, 3.0),
        (155, 45, 20, 14, 2.5),
        (275, 66, 30, 14, 2.8),
        (95, 22, 34, 22, 1.2),
        (215, 20, 28, 26, 1.0),
    ):
        light = np.maximum(light, radiance * _panel(elevation, azimuth, center, up, across, along))
    return np.asarray(np.where(elevation < 0, 0.08, light), np.float32)


def _softbox(elevation: Image, azimuth: Image) -> Image:
    """One large softbox high at one side of a dark room."""
    box = _panel(elevation, azimuth, 60, 52, 60, 40)
    return np.asarray(np.maximum(0.06, 4.0 * box), np.float32)


def _ring(elevation: Image, azimuth: Image) -> Image:
    """The dim room about a ring light."""
    return np.full_like(elevation, RING_DIM)


def _panel(
    elevation: Image, azimuth: Image, center: float, up: float, across: float, along: float
) -> Image:
    """1 in a panel of these angular sides, degrees, 0 beside it, over a soft edge of 2 degrees."""
    turned = (azimuth - center + 180) % 360 - 180
    sideways = np.abs(turned) * np.cos(np.radians(elevation))
    outside = np.maximum(sideways - across / 2, np.abs(elevation - up) - along / 2)
    return np.asarray(np.clip(0.5 - outside / 2, 0, 1), np.float32)


_PRESETS = {
    LightName.EVEN: _even,
    LightName.OVERCAST: _overcast,
    LightName.STUDIO: _studio,
    LightName.SOFTBOX: _softbox,
    LightName.RING: _ring,
}


def _with_contrast(image: Image, contrast: float) -> Image:
    """Radiances between the same brightest one and another darkest one, evenly in logarithms."""
    brightness = image if image.ndim == 2 else image.mean(axis=-1)
    floor = float(brightness.max()) * 1e-6
    logs = np.log(np.maximum(brightness, floor))
    low, high = np.percentile(logs, 1), logs.max()
    if high - low < 1e-6:
        return image
    wanted = high + (np.maximum(logs, low) - high) * (np.log(contrast) / (high - low))
    scale = np.exp(wanted - logs)
    return np.asarray(image * (scale if image.ndim == 2 else scale[..., None]), np.float32)


def _read(path: Path) -> Image:
    """An equirectangular image of a file, its first column along the world's x."""
    image = read_radiance(path)
    if image.shape[1] != 2 * image.shape[0] or image.shape[0] < 2:
        raise DataError(
            path,
            f"is {image.shape[1]}x{image.shape[0]} px; an environment is twice as wide as high.",
        )
    if not np.isfinite(image).all() or image.min() < 0 or not image.max() > 0:
        raise DataError(path, "has radiances that are negative, not finite, or all 0.")
    return image
