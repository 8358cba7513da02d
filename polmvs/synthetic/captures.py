"""Analytic captures for tests, examples and experiments: exact phase, depth, normals and noise.

Planes, spheres and cylinders under a uniform sky. The rendering has the geometry of the light, not
its radiance: every visible point has the same ``s0``, and its polarization follows Fresnel's
equations, so each quantity has a closed form. There are three sensors: ``ppa`` and ``opa`` obey the
models of :mod:`polmvs.polarization.angle_models` exactly; ``tilted`` is a polarizer in the image
plane that absorbs the field along the projection of its absorbing axis on the plane transverse to
the ray.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from polmvs.arrays import Array
from polmvs.camera import Camera, pixel_centers
from polmvs.config import CaptureOptions
from polmvs.geometry import RigidTransform, unit
from polmvs.polarization.fresnel import fresnel_dolp
from polmvs.polarization.mosaic import ANGLES_DEG
from polmvs.polarization.stokes import wrap_axial
from polmvs.scene import View
from polmvs.synthetic.surfaces import Surface

LIGHTS = ("specular", "diffuse")
SENSORS = ("ppa", "opa", "tilted")


@dataclass(frozen=True, kw_only=True, eq=False)
class SyntheticView:
    """One rendered view; (H, W) float64 at the pixel centres, NaN off the surface.

    Attributes
    ----------
    view : camera and pose.
    depth, range : z, and distance from the camera's centre, of the point seen.
    normals_in_cam : (H, W, 3), unit, facing the camera.
    mask : (H, W) bool, True on the surface.
    phase, aolp : rad in [0, pi), as the sensor measures them without noise; also NaN where the
        light is unpolarized (the ray is parallel to the normal).
    dolp : of the light before the sensor, by Fresnel.
    intensities : (4, H, W), behind polarizers at 0, 45, 90, 135 degrees, share of full scale;
        half of ``background`` off the surface.
    """

    view: View
    depth: Array
    range: Array
    normals_in_cam: Array
    mask: NDArray[np.bool_]
    phase: Array
    aolp: Array
    dolp: Array
    intensities: Array


def render_view(
    view: View,
    surface: Surface,
    *,
    light: str = "specular",
    sensor: str = "ppa",
    ior: float = 1.5,
    s0: float = 0.8,
    background: float = 0.0,
    xy: Array | None = None,
) -> SyntheticView:
    """Render a surface at the pixel centres of a view, or at other places.

    Parameters
    ----------
    light : kind of light: "specular" is polarized across the plane of incidence, "diffuse" in it.
    sensor : "ppa", "opa" or "tilted".
    ior : refractive index of the surface; sets the degree of polarization.
    s0, background : ``I0 + I90`` of the surface and of the unpolarized rest, in full scales.
    xy : (H, W, 2), image coordinates; None: the pixel centres.
    """
    if light not in LIGHTS or sensor not in SENSORS:
        raise ValueError(f"{light=}, {sensor=} but expected one of {LIGHTS} and of {SENSORS}.")
    if xy is None:
        xy = pixel_centers(view.camera.width, view.camera.height)
    rays = view.camera.rays(xy)
    rotation = view.cam_from_world.rotation
    distance, normals = surface.intersect(view.center_in_world, rays @ rotation)
    mask = np.isfinite(distance)
    distance = np.where(mask, distance, np.nan)
    normals = normals @ rotation.T
    dolp = fresnel_dolp(-(rays * normals).sum(axis=-1), light, ior)
    across = unit(np.cross(rays, normals))  # the light's polarization if it is specular
    axis = across if light == "specular" else np.cross(rays, across)
    if sensor == "tilted":
        intensities = _tilted_intensities(rays, axis, dolp, s0)
        s1, s2 = intensities[0] - intensities[2], intensities[1] - intensities[3]
        aolp = 0.5 * np.arctan2(s2, s1)
    else:
        # Paper, eq. model: z x (v x n) lies along d = (cos, -sin, 0).
        v = rays if sensor == "ppa" else np.broadcast_to([0.0, 0.0, 1.0], rays.shape)
        plane_normal = np.cross(v, normals)
        phase = np.arctan2(-plane_normal[..., 0], -plane_normal[..., 1])
        aolp = phase + (np.pi / 2 if light == "specular" else 0.0)
        angles = np.radians(ANGLES_DEG)[:, None, None]
        intensities = 0.5 * s0 * (1 + dolp * np.cos(2 * (angles - aolp)))
    polarized = mask & np.isfinite(across[..., 0]) & (dolp > 0)
    intensities = np.where(polarized, intensities, 0.5 * np.where(mask, s0, background))
    aolp = np.where(polarized, aolp, np.nan)
    return SyntheticView(
        view=view,
        depth=distance * rays[..., 2],
        range=distance,
        normals_in_cam=normals,
        mask=mask,
        phase=wrap_axial(aolp - (np.pi / 2 if light == "specular" else 0.0)),
        aolp=wrap_axial(aolp),
        dolp=dolp,
        intensities=intensities,
    )


def render_mosaic(
    view: View,
    surface: Surface,
    *,
    pattern: tuple[int, int, int, int] = CaptureOptions.pattern,
    **appearance: Any,
) -> Array:
    """Render a raw mosaic ``(2 H, 2 W)``, every sample at its own position and polarizer.

    ``view`` is of the half-size image, ``pattern`` the angles of a cell in degrees, row by row;
    ``appearance`` as in :func:`render_view`. Share of full scale, not rounded.
    """
    mosaic = np.empty((2 * view.camera.height, 2 * view.camera.width))
    centers = pixel_centers(view.camera.width, view.camera.height)
    for cell, index in enumerate(_pattern_indices(pattern)):
        row, col = divmod(cell, 2)
        # Samples of a cell lie a quarter of a half-size pixel about its centre.
        xy = centers + np.array([0.5 * col - 0.25, 0.5 * row - 0.25])
        rendered = render_view(view, surface, xy=xy, **appearance)
        mosaic[row::2, col::2] = rendered.intensities[index]
    return mosaic


def quantize(values: NDArray[np.floating], bits: int = 8) -> NDArray[np.unsignedinteger[Any]]:
    """Convert shares of full scale to integers, clipped: uint8 for up to 8 bits, uint16 above."""
    largest = 2**bits - 1
    rounded = np.rint(np.clip(values, 0.0, 1.0) * largest)
    return np.asarray(rounded, np.uint8) if bits <= 8 else np.asarray(rounded, np.uint16)


def add_noise(
    intensities: NDArray[np.floating],
    *,
    full_well: float = 10_000.0,
    read_noise: float = 2.5,
    rng: np.random.Generator,
) -> Array:
    """Add photon and read noise: variance ``I / full_well + (read_noise / full_well)^2``.

    Parameters
    ----------
    intensities : (...), share of full scale, not negative.
    full_well, read_noise : electrons at full scale, and deviation of the read noise in electrons.

    Returns
    -------
    (...) float64, share of full scale, neither rounded nor clipped.
    """
    electrons = rng.poisson(np.asarray(intensities, np.float64) * full_well).astype(np.float64)
    electrons += rng.normal(0.0, read_noise, electrons.shape)
    return electrons / full_well


def look_at(center: ArrayLike, target: ArrayLike, up: ArrayLike = (0, 0, 1)) -> RigidTransform:
    """``cam_from_world`` of a camera at ``center`` that looks at ``target``; ``up`` is upwards."""
    position = np.asarray(center, np.float64)
    forward = unit(np.asarray(target, np.float64) - position)
    right = np.cross(forward, np.asarray(up, np.float64))
    if not np.linalg.norm(right) > 1e-9:
        raise ValueError(f"{up=} lies along the viewing direction, or the camera in its target.")
    right = unit(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    return RigidTransform(rotation, -rotation @ position)


def ring_of_views(
    num_views: int,
    camera: Camera,
    *,
    target: ArrayLike = (0.0, 0.0, 0.0),
    distance: float = 0.5,
    elevation_deg: float = 45.0,
    roll_deg: float = 0.0,
) -> list[View]:
    """Views all around a target, names ``000.png`` on; elevation is relative to the x-y plane."""
    elevation, roll = np.radians([elevation_deg, roll_deg])
    views = []
    for i, azimuth in enumerate(np.arange(num_views) * (2 * np.pi / num_views)):
        center = np.asarray(target, np.float64) + distance * direction(azimuth, elevation)
        pose = rolled(look_at(center, target), roll)
        views.append(View(name=f"{i:03d}.png", camera=camera, cam_from_world=pose))
    return views


def direction(azimuth: float, elevation: float) -> Array:
    """Unit vector (3,) of two angles in rad; elevation is relative to the x-y plane."""
    across = np.cos(elevation)
    return np.array([across * np.cos(azimuth), across * np.sin(azimuth), np.sin(elevation)])


def rolled(pose: RigidTransform, roll: float) -> RigidTransform:
    """The pose of a camera after a rotation about its optical axis by an angle in rad."""
    cos, sin = np.cos(roll), np.sin(roll)
    turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
    return RigidTransform(turn @ pose.rotation, turn @ pose.translation)


def _tilted_intensities(rays: Array, axis: Array, dolp: Array, s0: float) -> Array:
    """Intensities (4, ...) behind polarizers in the image plane: ``I = tr J - a' J a``.

    J is the coherency of light of degree ``dolp`` along ``axis``, a the absorbing axis projected
    on the plane transverse to the ray.
    """
    intensities = []
    for angle in np.radians(ANGLES_DEG):
        absorbing = np.array([np.sin(angle), np.cos(angle), 0.0])
        absorbing = unit(absorbing - (rays @ absorbing)[..., None] * rays)
        absorbed = 0.5 * (1 - dolp) + dolp * (absorbing * axis).sum(axis=-1) ** 2
        intensities.append(s0 * (1 - absorbed))
    return np.stack(intensities)


def _pattern_indices(pattern: tuple[int, int, int, int]) -> list[int]:
    """Index among the four angle images of each sample of a cell, row by row."""
    if sorted(pattern) != list(ANGLES_DEG):
        raise ValueError(f"{pattern=} but expected each of {ANGLES_DEG} once.")
    return [ANGLES_DEG.index(angle) for angle in pattern]
