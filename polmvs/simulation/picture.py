"""One view: rays until the noise is low enough, and the samples of the sensor."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.config import BayerOrder
from polmvs.scene import View
from polmvs.simulation.options import SensorKind, SensorOptions, Simulation
from polmvs.simulation.scalar import render_stokes
from polmvs.simulation.scene import MitsubaScene
from polmvs.simulation.sensor import (
    Channels,
    expose,
    polarizer_images,
    sample_angles,
    sample_centers,
    stated_sigma,
    vignette,
)
from polmvs.simulation.transport import RAYS, Lens, Samples, trace

BAND_ROWS = 128  # of samples at a time, where they need much memory
# Gaussian responses of a colour sensor's filters: centre and standard deviation, nm. A guess at
# the published curves of a Sony IMX250MYR.
FILTERS_NM = {"r": (610.0, 35.0), "g": (535.0, 35.0), "b": (460.0, 30.0)}


@dataclass(frozen=True, kw_only=True, eq=False)
class Picture:
    """Rendering of a view, without the sensor's noise.

    Attributes
    ----------
    stokes : (H, W, 3), mean over each sample's area, in the rays' transverse planes.
    diffuse : (H, W, 2), s1, s2 of the part's diffuse light; None if unknown.
    sigma : (H, W), standard deviation of the rendering behind the sample's polarizer.
    rays : (H, W), number of rays of each sample.
    """

    stokes: Array
    diffuse: Array | None
    sigma: Array
    rays: NDArray[np.int64]


def render_picture(
    scene: MitsubaScene,
    view: View,
    lens: Lens,
    options: Simulation,
    channels: Channels,
    exposure: float,
    *,
    seed: int,
    step: int = 1,
) -> Picture:
    """Render a view: passes over its samples until their noise is below the sensor's.

    Parameters
    ----------
    exposure : full scales for each unit of radiance; infinite for one pass without a target.
    step : stride of the rendered samples, row by row; the others stay 0.
    """
    sensor, rendering, bounces = options.sensor, options.rendering, options.lighting.bounces
    rows, cols = lens.shape
    num = rows * cols
    if scene.renderer.is_scalar:
        rays = rendering.max_samples if np.isfinite(exposure) else RAYS
        return _scalar_picture(scene, view, lens, sensor, rays, bounces, seed)
    which = _which_angle(sensor, (rows, cols)).ravel()
    angles = np.radians(np.array(channels.angles_deg))[which].astype(np.float32)
    stokes, diffuse = np.zeros((num, 3)), np.zeros((num, 2))
    variance, passes = np.zeros(num), np.zeros(num, np.int64)
    left = np.arange(0, num, step)
    colours = None if sensor.colour is None else _filter_of(sensor.colour, (rows, cols)).ravel()
    for index in range(max(1, rendering.max_samples // RAYS)):
        wavelengths = None
        if colours is not None:
            wavelengths = _wavelengths(colours[left], np.random.default_rng([seed, index, 5]))
        samples = Samples(places=left, angles=angles[left], wavelengths=wavelengths)
        parts = trace(
            scene, lens, view.cam_from_world, samples, bounces=bounces, seed=seed * 4099 + index
        )
        for part, traced in parts:
            stokes[left[part]] += traced.stokes
            diffuse[left[part]] += traced.diffuse
            variance[left[part]] += traced.variance
        passes[left] += 1
        if not np.isfinite(exposure):
            break
        light = 0.5 * stokes[left, 0] / passes[left]
        wanted = rendering.noise * stated_sigma(light, sensor, exposure)
        of_mean = _local_mean(variance / np.maximum(passes, 1) ** 2 / RAYS, (rows, cols))[left]
        left = left[of_mean > wanted**2]
        if not len(left):
            break
    share = 1 / np.maximum(passes, 1)
    return Picture(
        stokes=(stokes * share[:, None]).reshape(rows, cols, 3),
        diffuse=(diffuse * share[:, None]).reshape(rows, cols, 2),
        sigma=np.sqrt(variance * share**2 / RAYS).reshape(rows, cols),
        rays=(RAYS * passes).reshape(rows, cols),
    )


def _scalar_picture(
    scene: MitsubaScene,
    view: View,
    lens: Lens,
    sensor: SensorOptions,
    rays: int,
    bounces: int,
    seed: int,
) -> Picture:
    """A view rendered one ray at a time, the same number for each sample."""
    stokes, sigma = render_stokes(scene, view, lens, rays=rays, bounces=bounces, seed=seed)
    shape = lens.shape
    if sensor.colour is None:
        chosen = stokes[:, :, 0]
    else:
        filters = _filter_of(sensor.colour, shape)
        chosen = np.take_along_axis(stokes, filters[..., None, None], axis=2)[:, :, 0]
    return Picture(
        stokes=chosen,
        diffuse=None,
        sigma=0.5 * sigma,
        rays=np.full(shape, rays, np.int64),
    )


def expose_picture(
    picture: Picture,
    view: View,
    sensor: SensorOptions,
    channels: Channels,
    exposure: float,
    rng: np.random.Generator,
) -> list[NDArray[np.unsignedinteger]]:
    """The view's files: one mosaic, or four images in the order of ``ANGLES_DEG``."""
    shape = picture.stokes.shape[:2]
    centers = sample_centers(view.camera, sensor.sensor)

    def behind(angles: Array) -> Array:
        """Light (H, W) behind polarizers at angles (H, W), computed some rows at a time."""
        light = np.empty(shape)
        for first in range(0, shape[0], BAND_ROWS):
            rows = np.s_[first : first + BAND_ROWS]
            bright = picture.stokes[rows]
            bright = bright * vignette(sensor, view.camera, centers[rows])[..., None]
            rays = view.camera.rays(centers[rows])
            light[rows] = polarizer_images(
                bright, rays, angles[rows], sensor.optics, channels.diattenuation
            )
        return light

    if sensor.sensor is SensorKind.MOSAIC:
        which = _which_angle(sensor, shape)
        light = behind(np.array(channels.angles_deg)[which]) * np.array(channels.gains)[which]
        return [expose(light, sensor, exposure, rng)]
    files = []
    for angle, gain in zip(channels.angles_deg, channels.gains, strict=True):
        drifted = gain * (1 + sensor.drift * rng.normal())
        files.append(expose(behind(np.full(shape, angle)) * drifted, sensor, exposure, rng))
    return files


def _which_angle(sensor: SensorOptions, shape: tuple[int, ...]) -> NDArray[np.intp]:
    """Index of the polarizer of each sample; a filter's images are rendered once for all."""
    if sensor.sensor is SensorKind.FILTER:
        return np.zeros(shape, np.intp)
    return sample_angles(sensor, (shape[0], shape[1]))


def _local_mean(values: Array, shape: tuple[int, int]) -> Array:
    """Mean over 3 x 3 samples: a variance of a few rays is itself uncertain."""
    padded = np.pad(values.reshape(shape), 1, mode="edge")
    rows = padded[:-2] + padded[1:-1] + padded[2:]
    return np.asarray((rows[:, :-2] + rows[:, 1:-1] + rows[:, 2:]).ravel() / 9)


def _filter_of(order: BayerOrder, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Index in ``rgb`` of each sample's colour filter: 2x2 samples have one."""
    block = np.array(["rgb".index(colour) for colour in order]).reshape(2, 2)
    cell = np.kron(block, np.ones((2, 2), np.intp))
    return np.tile(cell, (shape[0] // 4, shape[1] // 4))


def _wavelengths(colours: NDArray[np.intp], rng: np.random.Generator) -> NDArray[np.float32]:
    """Four wavelengths, nm, for each sample, drawn from its filter's response in strata."""
    centers = np.array([FILTERS_NM[c][0] for c in "rgb"])[colours]
    widths = np.array([FILTERS_NM[c][1] for c in "rgb"])[colours]
    share = (np.arange(4) + rng.uniform(size=(len(colours), 4))) / 4
    # Quantiles of a Gaussian, close enough (Tukey's lambda), within its 2.5 deviations.
    share = np.clip(share, 0.006, 0.994)
    quantile = 4.91 * (share**0.14 - (1 - share) ** 0.14)
    return np.asarray(np.clip(centers[:, None] + widths[:, None] * quantile, 390, 790), np.float32)
