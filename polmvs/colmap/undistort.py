"""Undistortion of models and images to a pinhole camera.

Both cameras share centre and axes, so a warp needs only rays. Polarization is warped as Stokes
images or as the four intensities, never as angles: an angle is axial and cannot be interpolated.
The warp does not change the values: the polarizers are fixed to the sensor and angles are relative
to its x axis, so moving pixels does not turn them.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pycolmap
from numpy.typing import NDArray

from polmvs.arrays import Array, Image, Mask
from polmvs.camera import Camera, PinholeCamera, in_frame, pixel_centers, sample_image
from polmvs.colmap.cameras import camera_from_colmap, camera_to_colmap
from polmvs.scene import SparseModel, some_tracks


def undistorted_camera(
    camera: Camera, *, blank_pixels: float = 0.0, max_image_size: int | None = None
) -> PinholeCamera:
    """The pinhole camera of COLMAP's image undistorter for a camera.

    Parameters
    ----------
    camera : of any COLMAP model; one without distortion is returned unchanged.
    blank_pixels : 0: no pixel is blank; 1: no pixel of the sensor is lost.
    max_image_size : longest side, px; None for no limit.
    """
    options = pycolmap.UndistortCameraOptions()
    options.blank_pixels = blank_pixels
    options.max_image_size = -1 if max_image_size is None else max_image_size
    undistorted = camera_from_colmap(pycolmap.undistort_camera(options, camera_to_colmap(camera)))
    if not isinstance(undistorted, PinholeCamera):
        raise TypeError(f"COLMAP did not undistort {camera}.")
    return undistorted


def undistort_xy(xy: NDArray[np.floating], source: Camera, target: PinholeCamera) -> Array:
    """Image coordinates ``(..., 2)`` of the source converted to the target, COLMAP's convention.

    NaN where the distortion has no inverse; they may be outside the target's image.
    """
    return np.asarray(target.project(source.rays(xy)), np.float64)


def undistorted_model(
    sparse_model: SparseModel, *, blank_pixels: float = 0.0, max_image_size: int | None = None
) -> SparseModel:
    """The model with undistorted cameras and its observations moved to their pixels.

    Observations whose distortion has no inverse are dropped, and tracks without any other.
    """
    cameras = {
        camera: undistorted_camera(camera, blank_pixels=blank_pixels, max_image_size=max_image_size)
        for camera in {view.camera for view in sparse_model.views}
    }
    views = tuple(replace(view, camera=cameras[view.camera]) for view in sparse_model.views)
    tracks, obs_xy = sparse_model.tracks, np.full(sparse_model.tracks.obs_xy.shape, np.nan)
    for view, own in zip(sparse_model.views, tracks.of_views(len(views)), strict=True):
        obs_xy[own] = undistort_xy(tracks.obs_xy[own], view.camera, cameras[view.camera])
    kept = np.isfinite(obs_xy).all(axis=-1)
    tracks = replace(
        tracks,
        obs_track=tracks.obs_track[kept],
        obs_view=tracks.obs_view[kept],
        obs_xy=obs_xy[kept],
    )
    seen = np.bincount(tracks.obs_track, minlength=len(tracks.point3D_ids)) > 0
    return replace(sparse_model, views=views, tracks=some_tracks(tracks, seen))


def warp_image(
    image: NDArray[np.generic], source: Camera, target: PinholeCamera
) -> tuple[Image, Mask]:
    """Warp an image of the source to the pixels of the target, bilinearly.

    Parameters
    ----------
    image : (H, W) or (H, W, C), C <= 4; intensities or Stokes images, no angles.
    source, target : of the image and of the result.

    Returns
    -------
    warped : (h, w) or (h, w, C) float32; 0 where the mask is False.
    mask : (h, w) bool, whether the ray of the pixel's centre hits the sensor.
    """
    if image.shape[:2] != (source.height, source.width):
        raise ValueError(f"{image.shape=} but expected {source.height}x{source.width} pixels.")
    if source == target:
        return np.asarray(image, np.float32), np.ones(image.shape[:2], np.bool_)
    rays = target.rays(pixel_centers(target.width, target.height))
    xy = np.asarray(source.project(rays), np.float64)
    size = np.array([source.width, source.height])
    mask = in_frame(xy, source.width, source.height)
    # Within half a pixel of the border there is nothing to interpolate with beyond it.
    inner = np.clip(xy, 0.5, size - 0.5)
    warped = sample_image(np.asarray(image, np.float32), np.where(mask[..., None], inner, np.nan))
    return warped, mask
