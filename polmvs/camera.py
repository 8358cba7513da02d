"""Cameras: rays, projection, and the conversion to OpenCV's pixel origin.

OpenCV counts pixels from their centres, COLMAP from the corner of the image. This is the only
file that converts between the two; all other code uses COLMAP's and calls
:func:`xy_to_opencv` at the border.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array

MAX_OPENCV_COORDINATE = 32000.0  # of cv2.remap, px
MAX_SIDE = 1 << 16  # largest side of an image, px, as in a JPEG; a larger value is damage
OUTSIDE = np.float32(-10.0)


def xy_to_opencv(xy: NDArray[np.floating]) -> NDArray[np.floating]:
    """COLMAP image coordinates (corner origin) to OpenCV's (first pixel centre at 0, 0)."""
    return xy - 0.5


def xy_from_opencv(xy: NDArray[np.floating]) -> NDArray[np.floating]:
    """OpenCV image coordinates (first pixel centre at 0, 0) to COLMAP's (corner origin)."""
    return xy + 0.5


def pixel_centers(width: int, height: int) -> Array:
    """Image coordinates of all pixel centres, ``(height, width, 2)``, COLMAP's convention."""
    return np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)


def sample_image(
    image: NDArray[np.float32], xy: NDArray[np.floating], *, nearest: bool = False
) -> NDArray[np.float32]:
    """Sample an image at image coordinates, bilinearly or at the nearest pixel.

    Parameters
    ----------
    image : (H, W) or (H, W, C) float32
    xy : (..., 2), COLMAP convention, px. NaN and coordinates outside the image give 0.
    nearest : sample the nearest pixel instead of interpolating.

    Returns
    -------
    (...) or (..., C) float32
    """
    maps = xy_to_opencv(np.asarray(xy, np.float32)).reshape(-1, 2)
    num, side = len(maps), 4096
    if num > side:  # OpenCV's maps are limited to 32767 a side: fold a long list
        maps = np.concatenate([maps, np.full((-num % side, 2), OUTSIDE, np.float32)])
    # NaN has no defined conversion to fixed point inside remap; comparisons with it are False.
    maps = np.where(np.abs(maps) < MAX_OPENCV_COORDINATE, maps, OUTSIDE)
    maps = maps.reshape(-1, min(side, max(num, 1)), 2) if num else np.full((1, 1, 2), OUTSIDE)
    sampled = cv2.remap(  # type: ignore[call-overload]
        image if image.flags.c_contiguous else np.ascontiguousarray(image),
        maps.astype(np.float32, copy=False),
        None,
        cv2.INTER_NEAREST if nearest else cv2.INTER_LINEAR,
        borderMode=cv2.BORDER_CONSTANT,
        borderValue=0,
    )
    channels = image.shape[2:]
    flat = sampled.reshape(-1, *channels)[:num]
    return np.asarray(flat.reshape(*xy.shape[:-1], *channels), np.float32)


def depth_buffer(
    xy: NDArray[np.floating],
    distances: NDArray[np.floating],
    width: int,
    height: int,
    *,
    cell_px: int = 1,
) -> tuple[Array, Array]:
    """Smallest distance in each cell of an image, and that of each point's own cell.

    Parameters
    ----------
    xy : (N, 2), image coordinates within the image, COLMAP convention, px.
    distances : (N,) from the camera.
    width, height : of the image, px.
    cell_px : side of a square cell, px; those of the right and lower border may be cut.

    Returns
    -------
    nearest : (rows, cols) float64, inf in cells that no point falls into.
    own : (N,) float64, ``nearest`` of the cell of each point.
    """
    shape = -(-height // cell_px), -(-width // cell_px)
    cols, rows = np.floor(np.asarray(xy, np.float64) / cell_px).astype(np.intp).T
    nearest = np.full(shape, np.inf)
    np.minimum.at(nearest, (rows, cols), distances)
    return nearest, nearest[rows, cols]


class Camera(Protocol):
    """Interface of a camera: rays of pixels and pixels of points."""

    @property
    def width(self) -> int:
        """Image width, px."""

    @property
    def height(self) -> int:
        """Image height, px."""

    @property
    def mean_focal_px(self) -> float:
        """Focal length, px; the mean of the two axes."""

    def rays(self, xy: NDArray[np.floating]) -> Array:
        """Unit rays ``(..., 3)`` in the camera frame of image coordinates ``(..., 2)``."""

    def project(self, points_in_cam: NDArray[np.floating]) -> NDArray[np.floating]:
        """Image coordinates ``(..., 2)`` of camera-frame points; NaN behind the camera."""


def in_image(camera: Camera, xy: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether image coordinates ``(..., 2)`` lie in the camera's image; not where NaN."""
    x, y = xy[..., 0], xy[..., 1]
    return np.asarray((x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height), np.bool_)


def in_frame(
    xy: NDArray[np.number[Any]], width: int, height: int, margin_px: float = 0.0
) -> NDArray[np.bool_]:
    """Whether coordinates ``(..., 2)`` lie in an image, its border included; not where NaN.

    It tests column by column, ten times as fast as row by row.

    Parameters
    ----------
    margin_px : width of a margin to exclude on each side.
    """
    x, y = xy[..., 0], xy[..., 1]
    across = (x >= margin_px) & (x <= width - margin_px)
    return np.asarray(across & (y >= margin_px) & (y <= height - margin_px), np.bool_)


@dataclass(frozen=True, kw_only=True)
class PinholeCamera:
    """A camera without distortion; the fast path in plain NumPy.

    ``fx, fy, cx, cy`` in px, COLMAP's convention (a centred principal point is ``width / 2``).
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def mean_focal_px(self) -> float:
        """Mean of the two focal lengths, px."""
        return 0.5 * (self.fx + self.fy)

    @property
    def K(self) -> Array:
        """Calibration matrix ``(3, 3)``."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    def rays(self, xy: NDArray[np.floating]) -> Array:
        """Unit rays ``(..., 3)`` in the camera frame of image coordinates ``(..., 2)``."""
        x = (np.asarray(xy[..., 0], np.float64) - self.cx) / self.fx
        y = (np.asarray(xy[..., 1], np.float64) - self.cy) / self.fy
        inverse_norm = 1.0 / np.sqrt(x * x + y * y + 1.0)
        return np.stack([x * inverse_norm, y * inverse_norm, inverse_norm], axis=-1)

    def project(self, points_in_cam: NDArray[np.floating]) -> NDArray[np.floating]:
        """Image coordinates ``(..., 2)`` of camera-frame points; NaN behind the camera."""
        z = np.where(points_in_cam[..., 2] > 0, points_in_cam[..., 2], np.nan)
        return np.stack(
            [
                self.fx * points_in_cam[..., 0] / z + self.cx,
                self.fy * points_in_cam[..., 1] / z + self.cy,
            ],
            axis=-1,
        )
