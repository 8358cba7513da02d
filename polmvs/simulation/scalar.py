"""Rendering without LLVM: Mitsuba's own path tracer, one ray at a time, on all cores.

A picture is a film of Mitsuba's ``stokes`` integrator about the optical axis, wide enough for all
samples and at their resolution. The samples are interpolated from it. Its noise follows from the
number of rays. Marks, defocus and motion are not rendered; a message says so.
"""

from __future__ import annotations

import logging
from typing import Any

import numpy as np

from polmvs.arrays import Array
from polmvs.camera import sample_image
from polmvs.errors import OptionError
from polmvs.geometry import unit
from polmvs.scene import View
from polmvs.simulation.scene import MitsubaScene
from polmvs.simulation.sensor import across
from polmvs.simulation.transport import Lens

logger = logging.getLogger(__name__)


MAX_FILM = 8192  # px along a side


def render_stokes(
    scene: MitsubaScene, view: View, lens: Lens, *, rays: int, bounces: int, seed: int
) -> tuple[Array, Array]:
    """Stokes vectors (H, W, C, 3) of the samples of a file, and the deviation of s0 (H, W).

    C is 1, or red, green and blue of a scene with colours. The basis is that of
    :mod:`polmvs.simulation.transport`. The rays are rendered in two halves, whose difference gives
    the deviation.

    Raises
    ------
    OptionError
        The lens blurs, or is too wide for one film.
    """
    if lens.aperture > 0 or any(lens.motion):
        raise OptionError(
            "and `sensor.motion_blur` need LLVM's library, which was not found.",
            field="sensor.f_number",
        )
    if len(scene.description.marks.centers):
        logger.warning("printed marks are left out: they need LLVM's library")
    centers = 0.25 * (
        lens.corners[:-1, :-1]
        + lens.corners[1:, :-1]
        + lens.corners[:-1, 1:]
        + lens.corners[1:, 1:]
    ).astype(np.float64)
    reach = np.abs(lens.corners).max(axis=(0, 1)).astype(np.float64)
    steps = np.array(
        [
            np.median(np.abs(np.diff(lens.corners[..., 0], axis=1))),
            np.median(np.abs(np.diff(lens.corners[..., 1], axis=0))),
        ]
    )
    step = float(steps.min())
    width, height = (int(n) for n in np.ceil(2 * reach / step - 1e-3))
    if max(width, height) > MAX_FILM:
        raise OptionError("is too wide to render without LLVM.", field="sensor.field_of_view")
    halves = [
        _film(scene, view, width, height, step, max(1, rays // 2), bounces, 2 * seed + half)
        for half in (0, 1)
    ]
    # Film pixel coordinates of the samples; y grows downwards as rows do.
    xy = centers / step + 0.5 * np.array([width, height])
    sampled = [_interpolated(film, xy) for film in halves]
    mean = 0.5 * (sampled[0] + sampled[1])
    deviation = 0.5 * np.abs(sampled[0] - sampled[1])[..., 0].mean(axis=-1)
    return mean, deviation


def _film(
    scene: MitsubaScene,
    view: View,
    width: int,
    height: int,
    step: float,
    rays: int,
    bounces: int,
    seed: int,
) -> Array:
    """Stokes vectors (H, W, C, 3) of a film about the optical axis, in the image's basis."""
    mi = scene.renderer.mi
    world_from_cam = view.cam_from_world.inverse()
    origin = world_from_cam.translation
    _, down, forward = world_from_cam.rotation.T
    target = mi.ScalarTransform4f().look_at(
        origin=origin.tolist(), target=(origin + forward).tolist(), up=(-down).tolist()
    )
    sensor: Any = mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(0.5 * width * step))),
            "fov_axis": "x",
            "near_clip": 1e-4,
            "to_world": target,
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "rgb",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": rays},
        }
    )
    integrator = mi.load_dict(
        {"type": "stokes", "nested": {"type": "path", "max_depth": bounces + 1, "rr_depth": 64}}
    )
    image = np.asarray(
        mi.render(scene.scene, sensor=sensor, integrator=integrator, spp=rays, seed=seed)
    ).astype(np.float64)
    # Colour and then s0 to s3, each in three colours.
    parameters = image[..., 3:15].reshape(height, width, 4, 3)[:, :, :3]
    grid = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    plane = (grid - 0.5 * np.array([width, height])) * step
    rays_in_cam = unit(np.concatenate([plane, np.ones((height, width, 1))], axis=-1))
    turned = _to_image_basis(parameters, rays_in_cam)
    if not scene.description.colour:
        turned = turned.mean(axis=-1, keepdims=True)
    return np.asarray(np.moveaxis(turned, 2, 3))


def _to_image_basis(parameters: Array, rays: Array) -> Array:
    """Rotate Stokes parameters (H, W, 3, C) from the basis of Mitsuba's integrator to the image's.

    The integrator's first axis lies across the sensor's upward axis in the transverse plane.
    """
    cos2, sin2 = (part[..., None] for part in across(np.array([0.0, -1.0, 0.0]), rays))
    s0, s1, s2 = np.moveaxis(parameters, 2, 0)
    return np.stack([s0, cos2 * s1 - sin2 * s2, sin2 * s1 + cos2 * s2], axis=2)


def _interpolated(film: Array, xy: Array) -> Array:
    """A film (H, W, C, 3) at image coordinates (h, w, 2)."""
    height, width = film.shape[:2]
    inside = np.clip(xy, 0.5, np.array([width, height]) - 0.5)
    flat = film.reshape(height, width, -1).astype(np.float32)
    found = [sample_image(np.ascontiguousarray(flat[..., k]), inside) for k in range(flat.shape[2])]
    stacked = np.stack(found, axis=-1).astype(np.float64)
    return np.asarray(stacked.reshape(*xy.shape[:2], *film.shape[2:]))
