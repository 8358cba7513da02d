"""From the sensor's pixels to an undistorted pinhole camera: images, and depth with normals.

Both cameras share centre and axes, so a warp needs rays only. Polarization is warped as Stokes
images or as the four intensities, never as angles: an angle is axial and does not interpolate.
The values are the same after the warp: the polarizers are fixed to the sensor and an angle is
counted from its x axis, so moving pixels does not turn it.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import Camera, PinholeCamera, pixel_centers, sample_image
from polmvs.colmap.maps import DepthNormals, map_pixel_xy
from polmvs.colmap.models import camera_from_colmap, camera_to_colmap, pycolmap
from polmvs.scene import SparseModel, View, some_tracks
from polmvs.surface.dense_view import DenseView
from polmvs.surface.log_range import MAX_GRAZING, log_range_increment

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

# A lattice point stands for its cell, whose corners are 0.71 strides away: outlines hardly grow.
REACH = 0.75
# Between neighbouring lattice points a surface turns by less, else there is an edge between
# them; about what the fusion of clouds takes for two surfaces.
MAX_TURN = np.radians(15.0)
BAND_ROWS = 128  # worked on at once: what bounds the memory
CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))


def undistorted_camera(
    camera: Camera, *, blank_pixels: float = 0.0, max_image_size: int | None = None
) -> PinholeCamera:
    """The pinhole camera that COLMAP's image undistorter makes of a camera.

    Parameters
    ----------
    camera : of any model of COLMAP's; one without distortion comes back unchanged.
    blank_pixels : 0 leaves no pixel blank, 1 loses no pixel of the sensor.
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
    """Image coordinates ``(..., 2)`` in the target of those in the source, COLMAP's convention.

    NaN where the distortion has no inverse; they may lie outside the target's image.
    """
    return np.asarray(target.project(source.rays(xy)), np.float64)


def undistorted_model(
    model: SparseModel, *, blank_pixels: float = 0.0, max_image_size: int | None = None
) -> SparseModel:
    """The model with undistorted cameras and its observations moved to their pixels.

    Observations whose distortion has no inverse are dropped, and tracks without any other.
    """
    cameras = {
        camera: undistorted_camera(camera, blank_pixels=blank_pixels, max_image_size=max_image_size)
        for camera in {view.camera for view in model.views}
    }
    views = tuple(replace(view, camera=cameras[view.camera]) for view in model.views)
    tracks, obs_xy = model.tracks, np.full(model.tracks.obs_xy.shape, np.nan)
    for index, view in enumerate(model.views):
        own = tracks.obs_view == index
        obs_xy[own] = undistort_xy(tracks.obs_xy[own], view.camera, cameras[view.camera])
    kept = np.isfinite(obs_xy).all(axis=-1)
    tracks = replace(
        tracks,
        obs_track=tracks.obs_track[kept],
        obs_view=tracks.obs_view[kept],
        obs_xy=obs_xy[kept],
    )
    seen = np.bincount(tracks.obs_track, minlength=len(tracks.point3D_ids)) > 0
    return replace(model, views=views, tracks=some_tracks(tracks, seen))


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
    mask : (h, w) bool, whether the ray of the pixel's centre meets the sensor.
    """
    if image.shape[:2] != (source.height, source.width):
        raise ValueError(f"{image.shape=} but expected {source.height}x{source.width} pixels.")
    rays = target.rays(pixel_centers(target.width, target.height))
    xy = np.asarray(source.project(rays), np.float64)
    size = np.array([source.width, source.height])
    mask = np.asarray(((xy >= 0) & (xy <= size)).all(axis=-1))
    # Within half a pixel of the border there is nothing to interpolate with beyond it.
    inner = np.clip(xy, 0.5, size - 0.5)
    warped = sample_image(np.asarray(image, np.float32), np.where(mask[..., None], inner, np.nan))
    return warped, mask


def warp_dense_view(dense: DenseView, view: View, target: PinholeCamera) -> DepthNormals:
    """Depth and normals of a dense view at the map pixels of an undistorted camera.

    Every known lattice point beside a pixel's ray extends its plane to that ray. Those that agree
    with the nearest one are averaged bilinearly; across a depth edge or a crease the nearest one
    decides. A ray further than ``REACH`` strides from every known point has no depth.

    Parameters
    ----------
    dense : of the view, on a lattice of the sensor's pixels.
    view : camera and pose; the target has the same pose.
    target : camera of the maps.
    """
    depth = np.zeros((target.height, target.width), np.float32)
    normals = np.zeros((target.height, target.width, 3), np.float32)
    xy = map_pixel_xy(target.width, target.height)
    for rows in _bands(target.height):
        rays = target.rays(xy[rows])
        position = np.asarray(view.camera.project(rays), np.float64) / dense.stride_px - 0.5
        ranges, normals[rows] = _extend(dense, view, rays, position)
        depth[rows] = ranges * rays[..., 2]
    return DepthNormals(depth, normals)


def _bands(height: int) -> Iterator[slice]:
    for start in range(0, height, BAND_ROWS):
        yield slice(start, min(start + BAND_ROWS, height))


class _Neighbours(NamedTuple):
    """What lattice points say of N rays; a leading axis counts the neighbours of a ray.

    ``log_range`` (..., N); ``normals`` (..., N, 3), camera frame; ``distance`` (..., N) from the
    ray in strides, inf where the point says nothing; ``weight`` (..., N), bilinear.
    """

    log_range: Array
    normals: Array
    distance: Array
    weight: Array


def _extend(dense: DenseView, view: View, rays: Array, position: Array) -> tuple[Array, Array]:
    """Ranges (h, w) and camera-frame normals (h, w, 3) of rays; 0 where unknown.

    ``position`` (h, w, 2) is where the rays meet the lattice, in units of its points.
    """
    ranges, normals = np.zeros(rays.shape[:2]), np.zeros(rays.shape)
    height, width = dense.range_map.shape
    # Comparisons with NaN are False.
    hit = np.asarray(((position > -1) & (position < (width, height))).all(axis=-1))
    col, row = np.floor(position[hit]).astype(np.int64).T
    hit[hit] = _some_known(dense.range_map > 0)[row + 1, col + 1]
    if not hit.any():
        return ranges, normals
    first = np.floor(position[hit]).astype(np.int64)
    corners = [
        _neighbour(dense, view, rays[hit], position[hit], first + np.array(step))
        for step in CORNERS
    ]
    neighbours = _Neighbours(*(np.stack(part) for part in zip(*corners, strict=True)))
    stride = dense.stride_px / view.camera.mean_focal_px
    ranges[hit], normals[hit] = _blend(neighbours, rays[hit], stride)
    return ranges, normals


def _some_known(known: Mask) -> Mask:
    """Whether any corner of a lattice square (h + 1, w + 1) is known, those of the rim included."""
    padded = np.pad(known, 1)
    return np.asarray(padded[:-1, :-1] | padded[:-1, 1:] | padded[1:, :-1] | padded[1:, 1:])


def _neighbour(
    dense: DenseView, view: View, rays: Array, position: Array, index: NDArray[np.int64]
) -> _Neighbours:
    """What the lattice points ``index`` (N, 2), (col, row), say of the rays (N, 3)."""
    height, width = dense.range_map.shape
    inside = np.asarray(((index >= 0) & (index < (width, height))).all(axis=-1))
    col, row = np.where(inside[:, None], index, 0).T
    lattice_rays = view.camera.rays((index + 0.5) * dense.stride_px)
    ranges = np.asarray(dense.range_map[row, col], np.float64)
    in_world = np.asarray(dense.normals_in_world[row, col], np.float64)
    normals = in_world @ view.cam_from_world.rotation.T
    # Comparisons with NaN are False: unknown normals and rays drop out here.
    known: Mask = inside & (ranges > 0)
    for direction in (rays, lattice_rays):
        known &= (normals * direction).sum(axis=-1) < -MAX_GRAZING
    normals = np.where(known[:, None], normals, 0)
    log_range = np.log(np.where(known, ranges, 1))
    log_range += np.where(known, log_range_increment(normals, lattice_rays, rays), 0)
    offset = np.abs(position - index)
    return _Neighbours(
        log_range=log_range,
        normals=normals,
        distance=np.where(known, np.hypot(*offset.T), np.inf),
        weight=np.where(known, (1 - offset).clip(0).prod(axis=-1), 0),
    )


def _blend(neighbours: _Neighbours, rays: Array, stride: float) -> tuple[Array, Array]:
    """Average the neighbours (4, N) that show the same surface as the nearest one.

    On a surface that turns by ``t`` over one stride (radians of ray), the planes through its
    points disagree by ``t stride / cos^2`` of the range at most, of the angle of incidence.
    Returns ranges (N,) and normals (N, 3); 0 where the nearest point is out of reach.
    """
    log_range, normals, distance, weight = neighbours
    nearest = distance.argmin(axis=0), np.arange(len(rays))
    known = distance[nearest] <= REACH
    # Of two surfaces the one seen more steeply sets the bound: a limb must not hide an edge.
    cosine = -(normals * rays).sum(axis=-1)
    cosine = np.maximum(np.maximum(cosine, cosine[nearest]), MAX_GRAZING)
    same: Mask = np.abs(log_range - log_range[nearest]) <= MAX_TURN * stride / cosine**2
    same &= (normals * normals[nearest]).sum(axis=-1) >= np.cos(MAX_TURN)
    share = np.where(same & np.isfinite(distance), weight, 0)
    share[nearest] += 1e-9  # no division by zero where nothing is known
    share /= share.sum(axis=0)
    normal = np.einsum("kn,knc->nc", share, normals)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    normal = np.where(known[:, None], normal / np.where(length > 0, length, 1), 0)
    return np.where(known, np.exp((share * log_range).sum(axis=0)), 0), normal
