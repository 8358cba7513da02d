"""Export of dense views to a COLMAP dense workspace: depth and normals at its map pixels."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from os import PathLike
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import Camera, PinholeCamera, in_frame, pixel_centers
from polmvs.colmap.dense_workspace import ImageLoader, write_dense_workspace
from polmvs.colmap.maps import DepthNormals, map_pixel_xy
from polmvs.config import FusionOptions
from polmvs.geometry import dots, unit_or_zero
from polmvs.scene import MIN_FACING_COSINE, SparseModel, View
from polmvs.surface.dense_view import DenseView
from polmvs.surface.log_range import log_range_increment

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
DenseLoader = Callable[[str], DenseView | None]

BAND_ROWS = 128  # processed at once, to bound the memory
CORNERS = ((0, 0), (0, 1), (1, 0), (1, 1))
# From a ray to the nearest known point, strides: a lattice point stands for its cell, up to the
# corners.
REACH = float(np.sqrt(0.5))
# Angle of a surface between neighbouring lattice points, rad; the fusion of clouds takes more for
# two surfaces.
MAX_TURN = float(np.radians(FusionOptions.max_normal_difference_deg))


def export_dense_workspace(
    folder: str | PathLike[str],
    sparse_model: SparseModel,
    load_image: ImageLoader,
    load_dense: DenseLoader,
    *,
    blank_pixels: float = 0.0,
    max_image_size: int | None = None,
) -> None:
    """Write a COLMAP dense workspace, whole or not at all; one view is in memory at a time.

    Parameters
    ----------
    load_dense : gives an image's dense result by name, or None; a view without has no maps and is
        not in ``fusion.cfg``.
    folder, sparse_model, load_image, blank_pixels, max_image_size : see
        :func:`polmvs.colmap.dense_workspace.write_dense_workspace`.

    Raises
    ------
    DataError
        The folder is in use or cannot be written, or an image's name leads out of it.
    """

    def load_maps(view: View, target: PinholeCamera) -> DepthNormals | None:
        dense = load_dense(view.name)
        return None if dense is None else warp_dense_view(dense, view, target)

    write_dense_workspace(
        folder,
        sparse_model,
        load_image,
        load_maps,
        blank_pixels=blank_pixels,
        max_image_size=max_image_size,
    )


def warp_dense_view(dense: DenseView, view: View, target: PinholeCamera) -> DepthNormals:
    """Depth and normals of a dense view at the map pixels of an undistorted camera.

    Every known lattice point next to a pixel's ray extends its plane to that ray. Points that agree
    with the nearest one are averaged bilinearly; across a depth edge or a crease only the nearest
    one is used. A ray farther than ``REACH`` from every known point has no depth.

    Parameters
    ----------
    dense : of the view, on a lattice of the sensor's pixels.
    view : camera and pose; the target has the same pose.
    target : camera of the maps.
    """
    return _maps_at(map_pixel_xy(target.width, target.height), target, dense, view)


def sensor_maps(dense: DenseView, view: View) -> DepthNormals:
    """Depth and normals of a dense view at the centres of the sensor's own pixels.

    Parameters
    ----------
    dense, view : see :func:`warp_dense_view`; the camera may have any distortion.
    """
    camera = view.camera
    return _maps_at(pixel_centers(camera.width, camera.height), camera, dense, view)


def _maps_at(xy: Array, camera: Camera, dense: DenseView, view: View) -> DepthNormals:
    """Depth and normals at image coordinates ``(H, W, 2)`` of a camera at the view's pose."""
    depth = np.zeros(xy.shape[:2], np.float32)
    normals = np.zeros((*xy.shape[:2], 3), np.float32)
    for rows in _bands(len(xy)):
        rays = camera.rays(xy[rows])
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
    x, y = position[..., 0], position[..., 1]
    hit = np.asarray((x > -1) & (x < width) & (y > -1) & (y < height))
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
    """Whether any corner of a lattice square (h + 1, w + 1) is known, border squares included."""
    padded = np.pad(known, 1)
    return np.asarray(padded[:-1, :-1] | padded[:-1, 1:] | padded[1:, :-1] | padded[1:, 1:])


def _neighbour(
    dense: DenseView, view: View, rays: Array, position: Array, index: NDArray[np.int64]
) -> _Neighbours:
    """What the lattice points ``index`` (N, 2), (col, row), say of the rays (N, 3)."""
    height, width = dense.range_map.shape
    inside = in_frame(index, width - 1, height - 1)
    col, row = np.where(inside[:, None], index, 0).T
    lattice_rays = view.camera.rays((index + 0.5) * dense.stride_px)
    ranges = np.asarray(dense.range_map[row, col], np.float64)
    in_world = np.asarray(dense.normals_in_world[row, col], np.float64)
    normals = in_world @ view.cam_from_world.rotation.T
    # Comparisons with NaN are False: unknown normals and rays drop out here.
    known: Mask = inside & (ranges > 0)
    for direction in (rays, lattice_rays):
        known &= dots(normals, direction) < -MIN_FACING_COSINE
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
    # Of two surfaces the one seen less obliquely sets the bound: a limb must not hide an edge.
    cosine = -dots(normals, np.broadcast_to(rays, normals.shape))
    cosine = np.maximum(np.maximum(cosine, cosine[nearest]), MIN_FACING_COSINE)
    same: Mask = np.abs(log_range - log_range[nearest]) <= MAX_TURN * stride / cosine**2
    same &= dots(normals, np.broadcast_to(normals[nearest], normals.shape)) >= np.cos(MAX_TURN)
    share = np.where(same & np.isfinite(distance), weight, 0)
    share[nearest] += 1e-9  # no division by zero where nothing is known
    share /= share.sum(axis=0)
    normal = unit_or_zero(np.einsum("kn,knc->nc", share, normals))
    normal = np.where(known[:, None], normal, 0)
    return np.where(known, np.exp((share * log_range).sum(axis=0)), 0), normal
