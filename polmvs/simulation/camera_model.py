"""The camera: its lens, the rays of the file's samples, and their blur."""

from __future__ import annotations

import numpy as np

from polmvs.arrays import Array
from polmvs.camera import Camera, PinholeCamera
from polmvs.colmap.cameras import ColmapCamera
from polmvs.errors import OptionError
from polmvs.io.intrinsics import Intrinsics, read_intrinsics
from polmvs.scene import View
from polmvs.simulation.options import SensorKind, SensorOptions
from polmvs.simulation.transport import Lens

FOCAL_LENGTH_M = 0.008  # of the lens that has an f-number


def polarization_intrinsics(options: SensorOptions) -> Intrinsics:
    """Camera of the polarization images: half a mosaic's size, full size for a rotating filter.

    Raises
    ------
    OptionError, DataError
        The camera's file is unreadable or for images of another aspect ratio.
    """
    width, height = options.image_size
    if options.sensor is SensorKind.MOSAIC:
        width, height = width // 2, height // 2
    if options.camera_file is not None:
        given = read_intrinsics(options.camera_file)
        try:
            return given.scaled_to(width, height)
        except ValueError as error:
            raise OptionError(
                f"{options.camera_file} does not fit: {error}.", field="sensor.image_size"
            ) from error
    focal = 0.5 * width / np.tan(np.radians(options.field_of_view / 2))
    params = (focal, focal, 0.5 * width, 0.5 * height)
    if options.lens is None:
        return Intrinsics(model="PINHOLE", width=width, height=height, params=params)
    return Intrinsics(model="OPENCV", width=width, height=height, params=(*params, *options.lens))


def camera_of(intrinsics: Intrinsics) -> Camera:
    """The camera that has these intrinsics."""
    if intrinsics.model in ("PINHOLE", "SIMPLE_PINHOLE"):
        return intrinsics.pinhole
    return ColmapCamera(
        model=intrinsics.model,
        width=intrinsics.width,
        height=intrinsics.height,
        params=intrinsics.params,
    )


def pinhole_of(camera: Camera) -> PinholeCamera:
    """The camera without distortion."""
    if isinstance(camera, PinholeCamera):
        return camera
    assert isinstance(camera, ColmapCamera)
    return Intrinsics(
        model=camera.model, width=camera.width, height=camera.height, params=camera.params
    ).pinhole


def lens_of(options: SensorOptions, camera: Camera, distance: float, seed: int) -> Lens:
    """Rays of the file's samples, with defocus and motion.

    Parameters
    ----------
    camera : of the polarization images.
    distance : to the object's centre, which is in focus, metres.
    seed : of the direction of the motion.

    Raises
    ------
    OptionError
        The distortion has no inverse in the image.
    """
    scale = 2 if options.sensor is SensorKind.MOSAIC else 1
    grid = np.stack(
        np.meshgrid(np.arange(scale * camera.width + 1), np.arange(scale * camera.height + 1)),
        axis=-1,
    )
    rays = camera.rays(grid / scale)
    if not np.isfinite(rays).all():
        raise OptionError(
            "has no inverse up to the image's corners; give weaker distortion.",
            field="sensor.lens" if options.camera_file is None else "sensor.camera_file",
        )
    aperture = 0.0 if options.f_number is None else 0.5 * FOCAL_LENGTH_M / options.f_number
    motion = (0.0, 0.0, 0.0)
    if options.motion_blur > 0:
        turn = np.random.default_rng([seed, 4]).uniform(0, 2 * np.pi)
        length = options.motion_blur * distance / (scale * camera.mean_focal_px)
        motion = (float(length * np.cos(turn)), float(length * np.sin(turn)), 0.0)
    return Lens(
        corners=np.asarray(rays[..., :2] / rays[..., 2:], np.float32),
        aperture=aperture,
        focus=distance,
        motion=motion,
    )


def object_distance(view: View, target: Array) -> float:
    """Depth of the object's centre in a view, metres."""
    return float((view.cam_from_world * target)[2])
