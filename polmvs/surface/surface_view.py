"""One view for the surface of all views: its silhouette, phase map and camera."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from functools import cached_property
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import in_frame
from polmvs.io.arrays import StoredArray, kept_array
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import View

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

REFERENCE_FOCAL_PX = 445.0  # focal length of the images for which lengths were chosen
FIELD_SMOOTHING_PX = 0.8  # of the distance to a silhouette; it smooths its pixel staircase
NORMAL_SMOOTHING_PX = 2.0  # of the distance before its gradient
FAR_PX = 1000.0  # distance to a missing silhouette


class OutlineSource(Enum):
    """How an outline was found.

    ``MASK``: the border of pixels; ``EDGE``: the greatest change of brightness; ``MATTING``: see
    :mod:`polmvs.surface.matting`.
    """

    MASK = "mask"
    EDGE = "edge"
    MATTING = "matting"


@dataclass(frozen=True)
class Silhouette:
    """Silhouette of the polarized objects in one view, with unknown pixels.

    Attributes
    ----------
    certain : (H, W) bool, on an object.
    possible : (H, W) bool, on an object or unknown; includes ``certain``.
    inner_shift, outer_shift : (H, W) float32, px, distance of the outlines of the two outside of
        the borders of their pixels; None: 0.
    """

    certain: Mask
    possible: Mask
    inner_shift: Image | StoredArray | None = None
    outer_shift: Image | StoredArray | None = None

    @cached_property
    def inner(self) -> Image:
        """(H, W): signed distance to the outline of ``certain``, px, negative inside."""
        return _distance_field(self.certain, self.inner_shift)

    @cached_property
    def outer(self) -> Image:
        """(H, W): as ``inner``, of ``possible``."""
        return self.inner if self.is_sharp else _distance_field(self.possible, self.outer_shift)

    @cached_property
    def is_sharp(self) -> bool:
        """Whether no pixel is unknown."""
        return bool((self.certain == self.possible).all())


class _StoredSilhouette(Silhouette):
    """A silhouette whose arrays are on disk and mapped when they are used."""

    def __init__(self, made: Silhouette, folder: Path, name: str) -> None:
        names = ("certain", "possible", "inner") + (() if made.is_sharp else ("outer",))
        arrays = {n: kept_array(getattr(made, n), folder / f"{name}.{n}.npy") for n in names}
        vars(self).update(is_sharp=made.is_sharp, arrays=arrays)

    certain = property(lambda self: np.asarray(self.arrays["certain"]))
    possible = property(lambda self: np.asarray(self.arrays["possible"]))
    inner = property(lambda self: np.asarray(self.arrays["inner"]))
    outer = property(lambda self: np.asarray(self.arrays["inner" if self.is_sharp else "outer"]))


def signed_distance_px(mask: Mask) -> Image:
    """Distance (H, W) to the border of a mask, px, negative inside."""
    pixels = mask.astype(np.uint8)
    if not mask.any():
        return np.full(mask.shape, FAR_PX, np.float32)
    if mask.all():
        return np.full(mask.shape, -FAR_PX, np.float32)
    outside, inside = _distance_px(1 - pixels), _distance_px(pixels)
    # The border runs half a pixel from the centres beside it.
    return np.where(mask, 0.5 - inside, outside - 0.5).astype(np.float32)


def _distance_px(pixels: NDArray[np.uint8]) -> Image:
    """Distance (H, W) to the nearest pixel that is 0, px, the same in every run."""
    # IPP's rounding depends on memory alignment; OpenCV's own code is as fast.
    used = cv2.ipp.useIPP()
    cv2.ipp.setUseIPP(False)
    try:
        distance = cv2.distanceTransform(pixels, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
        return np.asarray(distance, np.float32)
    finally:
        cv2.ipp.setUseIPP(used)


def smoothed_distance(distance: Image, sigma_px: float) -> Image:
    """A signed distance (H, W), blurred."""
    blurred = cv2.GaussianBlur(distance, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, np.float32)


def smooth_distance_px(mask: Mask) -> Image:
    """:func:`signed_distance_px` without the staircase of the pixels."""
    return smoothed_distance(signed_distance_px(mask), FIELD_SMOOTHING_PX)


def border_pixels(mask: Mask) -> Mask:
    """Pixels (H, W) of a mask with a pixel outside of it beside them."""
    pixels = mask.astype(np.uint8)
    return np.asarray(mask & (cv2.erode(pixels, np.ones((3, 3), np.uint8)) == 0), np.bool_)


def outward_normals(distance: Image, where: Mask) -> Image:
    """Outward normals (N, 2) of the level lines of a signed distance at some pixels."""
    smooth = smoothed_distance(distance, NORMAL_SMOOTHING_PX)
    slopes = [cv2.Sobel(smooth, cv2.CV_32F, dx, 1 - dx) for dx in (1, 0)]
    outwards = np.stack(slopes, axis=-1)[where]
    lengths = np.linalg.norm(outwards, axis=1, keepdims=True)
    return np.asarray(outwards / np.maximum(lengths, 1e-6), np.float32)


def _distance_field(mask: Mask, shift: Image | StoredArray | None) -> Image:
    distance = smooth_distance_px(mask)
    if shift is not None:
        distance = distance - np.asarray(shift)
    return np.asarray(distance, np.float32)


@dataclass(frozen=True)
class SurfaceView:
    """One posed view for the surface of all views.

    Attributes
    ----------
    phase_map : its phase; read anew each time, as it may be on disk.
    silhouette : of the objects.
    has_outline : whether the silhouette may carve and pull: it has pixels on and off the objects.
    outline_source : how its outline was found.
    """

    phase_map: PhaseMap
    silhouette: Silhouette
    has_outline: bool = True
    outline_source: OutlineSource = OutlineSource.MASK

    @property
    def view(self) -> View:
        """Name, camera and pose."""
        return self.phase_map.view

    @property
    def width(self) -> int:
        """Image width, px."""
        return self.view.camera.width

    @property
    def height(self) -> int:
        """Image height, px."""
        return self.view.camera.height

    @cached_property
    def center(self) -> Array:
        """Camera centre ``(3,)`` in the world."""
        return self.view.center_in_world

    def to_camera(self, points: Floats) -> Array:
        """World points ``(N, 3)`` in the camera frame."""
        return np.asarray(self.view.cam_from_world * np.asarray(points, np.float64))

    def project(self, points: Floats) -> tuple[Array, Array]:
        """Image coordinates ``(N, 2)``, NaN behind the camera, and depths z ``(N,)``."""
        in_cam = self.to_camera(points)
        return np.asarray(self.view.camera.project(in_cam)), in_cam[:, 2]

    def in_image(self, xy: Floats, margin_px: float = 0.0) -> Mask:
        """Which image coordinates ``(N, 2)`` lie in the image; not those that are NaN."""
        return in_frame(xy, self.width, self.height, margin_px)

    def gsd(self, points: Floats) -> Array:
        """Ground sampling distance ``(N,)`` at points, perpendicular to the optical axis."""
        return np.abs(self.to_camera(points)[:, 2]) / self.view.camera.mean_focal_px


def surface_view(
    phase_map: PhaseMap, silhouette: Silhouette, *, folder: Path | None = None
) -> SurfaceView:
    """The record of a view from its phase map and silhouette.

    Parameters
    ----------
    phase_map : of the view.
    silhouette : of the objects in this view.
    folder : for the derived arrays; None: in memory, some 30 bytes a pixel.
    """
    name = phase_map.view.name
    source = OutlineSource.MASK if silhouette.inner_shift is None else OutlineSource.EDGE
    return SurfaceView(
        phase_map=phase_map,
        silhouette=silhouette if folder is None else _StoredSilhouette(silhouette, folder, name),
        has_outline=bool(silhouette.certain.any() and not silhouette.possible.all()),
        outline_source=source if phase_map.outline_shift is None else OutlineSource.MATTING,
    )
