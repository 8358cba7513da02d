"""Conversion of COLMAP's cameras, and its log level.

The rest of the package uses :class:`polmvs.camera.Camera` and no type of pycolmap.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import pycolmap
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.camera import Camera, PinholeCamera

# Models that are pinhole cameras if all their distortion is zero. Fisheye models are not.
PERSPECTIVE_MODELS = frozenset(
    {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"}
)
# Distortion polynomials fold far points back into the image; beyond the border's widest ray
# times this they are declared invisible. A guess: wide enough for a point half a pixel outside.
FIELD_MARGIN = 1.05
BORDER_SAMPLES = 64  # along each side of the image


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Limit COLMAP's log to fatal errors in this block: it prints every step by default."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


@dataclass(frozen=True, kw_only=True)
class ColmapCamera:
    """A camera of any COLMAP model; implements :class:`polmvs.camera.Camera`.

    Attributes
    ----------
    model : name of the COLMAP model, such as ``OPENCV_FISHEYE``.
    width, height : px
    params : in COLMAP's order, COLMAP's pixel convention.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def mean_focal_px(self) -> float:
        """Mean of the focal lengths, px."""
        return float(_pycolmap_camera(self).mean_focal_length())

    def rays(self, xy: NDArray[np.floating]) -> Array:
        """Unit rays ``(..., 3)`` in the camera frame of image coordinates ``(..., 2)``.

        NaN where the distortion has no inverse and for rays that point sideways or backwards.
        """
        xy = np.asarray(xy, np.float64)
        camera = _pycolmap_camera(self)
        flat = np.ascontiguousarray(xy.reshape(-1, 2))
        if hasattr(camera, "cam_ray_from_img"):
            rays = np.asarray(camera.cam_ray_from_img(flat), np.float64)
        else:  # pycolmap 4.0
            plane = np.asarray(camera.cam_from_img(flat), np.float64)
            rays = np.column_stack([plane, np.ones(len(plane))])
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        rays[~(rays[:, 2] > 0)] = np.nan
        return np.asarray(rays.reshape(*xy.shape[:-1], 3), np.float64)

    def project(self, points_in_cam: NDArray[np.floating]) -> NDArray[np.floating]:
        """Image coordinates ``(..., 2)`` of camera-frame points.

        NaN behind the camera and more than 5 % farther from the axis than the widest ray.
        """
        points = np.asarray(points_in_cam, np.float64)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        angle = np.arctan2(np.hypot(flat[:, 0], flat[:, 1]), flat[:, 2])
        seen = (flat[:, 2] > 0) & (angle <= _widest_angle(self))
        xy = np.full((len(flat), 2), np.nan)
        if seen.any():
            xy[seen] = _pycolmap_camera(self).img_from_cam(flat[seen])
        return xy.reshape(*points.shape[:-1], 2)


def camera_to_colmap(camera: Camera) -> pycolmap.Camera:
    """A fresh ``pycolmap.Camera``."""
    if isinstance(camera, PinholeCamera):
        model = "PINHOLE"
        params: tuple[float, ...] = (camera.fx, camera.fy, camera.cx, camera.cy)
    elif isinstance(camera, ColmapCamera):
        model, params = camera.model, camera.params
    else:
        raise TypeError(f"{type(camera).__name__} has no counterpart in COLMAP.")
    return pycolmap.Camera(
        model=model, width=camera.width, height=camera.height, params=np.array(params)
    )


@lru_cache(maxsize=4096)
def _pycolmap_camera(camera: ColmapCamera) -> pycolmap.Camera:
    """The wrapped camera, never modified; outside the dataclass so that that one pickles."""
    return camera_to_colmap(camera)


@lru_cache(maxsize=4096)
def _widest_angle(camera: ColmapCamera) -> float:
    """Angle from the optical axis of the widest ray of the image's border, with margin, rad."""
    along = np.linspace(0, 1, BORDER_SAMPLES)
    share = [np.stack([along, np.full_like(along, side)], axis=-1) for side in (0, 1)]
    border = np.concatenate([*share, *(pair[:, ::-1] for pair in share)])
    z = camera.rays(border * (camera.width, camera.height))[:, 2]
    inside = z[np.isfinite(z)]
    # Where the border reaches beyond the fold, the last rays before it are the bound themselves.
    margin = FIELD_MARGIN if len(inside) == len(z) else 1.0
    return float(margin * np.arccos(inside.min(initial=1.0) if len(inside) else 0.0))


def camera_from_colmap(camera: pycolmap.Camera) -> Camera:
    """A ``pycolmap.Camera`` as a camera of this package; the fast pinhole if it is one."""
    model = str(camera.model_name)
    if model in PERSPECTIVE_MODELS and camera.is_undistorted():
        return PinholeCamera(
            width=int(camera.width),
            height=int(camera.height),
            fx=float(camera.focal_length_x),
            fy=float(camera.focal_length_y),
            cx=float(camera.principal_point_x),
            cy=float(camera.principal_point_y),
        )
    return ColmapCamera(
        model=model,
        width=int(camera.width),
        height=int(camera.height),
        params=tuple(map(float, camera.params)),
    )


def rescaled_camera(camera: Camera, width: int, height: int) -> Camera:
    """The same camera with its images resized to ``width`` x ``height`` px."""
    resized = camera_to_colmap(camera)
    resized.rescale(width, height)
    return camera_from_colmap(resized)
