"""From Stokes vectors to the samples of a file: polarizers, exposure, noise, levels.

A polarizer in the image plane is tilted for an oblique ray: it absorbs the field along the
projection ``a = normalise(A - (A . v) v)`` of its absorbing axis A on the ray's transverse plane,
so that ``I = (S0 - d (cos 2 psi S1 + sin 2 psi S2)) / 2`` with the angle psi of a in the basis of
that plane and the diattenuation d. Behind an image-side telecentric lens each ray meets the sensor
perpendicularly, and psi is the angle of A.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.camera import Camera, pixel_centers
from polmvs.geometry import unit
from polmvs.polarization.mosaic import ANGLES_DEG
from polmvs.simulation.options import Optics, SensorKind, SensorOptions
from polmvs.synthetic.captures import add_noise, quantize

MOST_WELLS = 1e3  # of light on a sample: far over what it holds


@dataclass(frozen=True, kw_only=True, eq=False)
class Channels:
    """Errors of the polarizers, by nominal angle 0, 45, 90, 135 degrees.

    Attributes
    ----------
    angles_deg : (4,), true angles of the transmission axes.
    gains : (4,), relative to the mean channel.
    diattenuation : of all, ``(r - 1) / (r + 1)`` of the extinction ratio r.
    """

    angles_deg: tuple[float, ...]
    gains: tuple[float, ...]
    diattenuation: float


def draw_channels(options: SensorOptions, seed: int) -> Channels:
    """The polarizers of one camera."""
    rng = np.random.default_rng([seed, 1])
    errors = options.angle_errors * rng.normal(size=4)
    gains = 1 + options.gain_errors * rng.normal(size=4)
    ratio = options.extinction
    return Channels(
        angles_deg=tuple(float(a + e) for a, e in zip(ANGLES_DEG, errors, strict=True)),
        gains=tuple(float(g) for g in gains / gains.mean()),
        diattenuation=1.0 if ratio is None else (ratio - 1) / (ratio + 1),
    )


def polarizer_images(
    stokes: Array,
    rays: Array,
    angles_deg: NDArray[np.floating],
    optics: Optics,
    diattenuation: float,
) -> Array:
    """Light behind polarizers, (...), of Stokes vectors in the rays' own transverse planes.

    Parameters
    ----------
    stokes : (..., 3), in the basis of :mod:`polmvs.simulation.transport`.
    rays : (..., 3), unit, camera frame.
    angles_deg : (...), of the transmission axes, anticlockwise from +x as displayed.
    optics : how rays meet the polarizers.
    diattenuation : of the polarizers.
    """
    cos2, sin2 = transmitted_axis(rays, np.radians(angles_deg), optics)
    polarized = cos2 * stokes[..., 1] + sin2 * stokes[..., 2]
    return np.asarray(0.5 * (stokes[..., 0] + diattenuation * polarized))


def transmitted_axis(rays: Array, angles: Array, optics: Optics) -> tuple[Array, Array]:
    """Cosine and sine of twice the angle of the transmitted direction in the transverse plane."""
    if optics is Optics.TELECENTRIC:
        return np.cos(2 * angles), np.sin(2 * angles)
    # Across the projected absorbing axis, which is (sin, cos, 0) of the transmission axis' angle.
    absorbing = np.stack([np.sin(angles), np.cos(angles), np.zeros_like(angles)], axis=-1)
    return across(absorbing, rays)


def across(axis: Array, rays: Array) -> tuple[Array, Array]:
    """Cosine and sine of twice the angle of the direction across an axis, transverse plane.

    Angles are from the image's x, turned by the shortest rotation from the optical axis to the ray.
    """
    x, y, z = rays[..., 0], rays[..., 1], rays[..., 2]
    axis = unit(axis - (axis * rays).sum(axis=-1, keepdims=True) * rays)
    scale = 1 / (1 + z)
    along = np.stack([1 - x * x * scale, -x * y * scale, -x], axis=-1)
    up = np.stack([x * y * scale, y * y * scale - 1, y], axis=-1)
    cos, sin = (axis * along).sum(axis=-1), (axis * up).sum(axis=-1)
    return sin * sin - cos * cos, -2 * sin * cos


def sample_angles(options: SensorOptions, shape: tuple[int, int]) -> NDArray[np.intp]:
    """Index of the nominal angle, (H, W), of each sample of a mosaic."""
    cell = np.array([ANGLES_DEG.index(angle) for angle in options.pattern]).reshape(2, 2)
    return np.tile(cell, (shape[0] // 2, shape[1] // 2))


def vignette(options: SensorOptions, camera: Camera, xy: Array) -> Array:
    """Share of the light that reaches each point (..., 2); 1 on the axis."""
    if options.vignetting == 0:
        return np.ones(xy.shape[:-1])
    center = 0.5 * np.array([camera.width, camera.height])
    radius = np.linalg.norm((xy - center) / np.linalg.norm(center), axis=-1)
    return np.asarray(1 - options.vignetting * radius**2)


def expose(
    light: Array, options: SensorOptions, exposure: float, rng: np.random.Generator
) -> NDArray[np.unsignedinteger]:
    """Samples of a file from light, with photon and read noise, black level and clipping.

    Parameters
    ----------
    light : (...), in units of radiance, behind the polarizers.
    exposure : full wells for each unit of radiance.
    """
    wells = np.clip(light * exposure, 0, MOST_WELLS)
    noisy = add_noise(wells, full_well=options.full_well, read_noise=options.read_noise, rng=rng)
    # A full well holds no more, and what overflows it has no noise.
    return quantize(np.minimum(noisy, 1.0) * options.gain + options.black_level, options.bits)


def stated_sigma(light: Array, options: SensorOptions, exposure: float) -> Array:
    """Standard deviation of the sensor's noise, quantization included, in units of radiance."""
    wells = np.clip(light * exposure, 0, 1)
    step = 1 / (2**options.bits - 1) / options.gain
    read = options.read_noise / options.full_well
    return np.asarray(np.sqrt(wells / options.full_well + read**2 + step**2 / 12) / exposure)


def sample_centers(camera: Camera, kind: SensorKind) -> Array:
    """Places (H, W, 2) of the file's samples in the polarization image, px."""
    if kind is SensorKind.FILTER:
        return pixel_centers(camera.width, camera.height)
    return 0.5 * pixel_centers(2 * camera.width, 2 * camera.height)
