"""The points of the depth maps that COLMAP itself made, where no polarised surface was found."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.colmap.dense_workspace import DenseWorkspace, WorkspaceView
from polmvs.colmap.maps import map_pixel_xy
from polmvs.surface.fusion import FusedCloud, concatenate, merge, no_points

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

STRIDE_PX = 2
MIN_VIEWS = 2  # with a point in the same voxel of AGREEMENT_PX, in footprints of a pixel
AGREEMENT_PX = 2.0
# Share of the points: COLMAP keeps what other views confirm, so that most have a second view, and
# hardly one by chance where the maps are of another unit or frame than the poses.
MIN_AGREEMENT = 0.1
VOXEL_PX = 1.0  # edge of the merging voxel, in footprints of a pixel
DEPTH_SIGMA_PX = 0.5  # of COLMAP's depth, in footprints: it matches to about half a pixel
NORMAL_SIGMA_DEG = 10.0  # that COLMAP's fusion allows between views
MIN_COSINE = 0.1
CLEARANCE_PX = 6.0  # from the polarised surface, in footprints


def kept_cloud(workspace: DenseWorkspace, surface_points: Array) -> FusedCloud:
    """Fuse the maps of a workspace, leaving out what lies on a polarised surface.

    Parameters
    ----------
    workspace : with maps of some views; one view is in memory at a time.
    surface_points : (N, 3), world, of the polarised surfaces, which have their own points.

    Returns
    -------
    Points that two views or more put into one voxel.
    """
    clouds, footprints = [], []
    for item in workspace.views:
        cloud, footprint = _view_cloud(item)
        if len(cloud.points):
            clouds.append(cloud)
            footprints.append(footprint)
    if not clouds:
        return no_points()
    cloud, footprint = concatenate(clouds), float(np.median(footprints))
    owner = np.repeat(np.arange(len(clouds)), [len(part.points) for part in clouds])
    num_views = _views_in_voxel(cloud.points, owner, AGREEMENT_PX * footprint)
    cloud = replace(cloud, num_views=num_views)
    keep = num_views >= MIN_VIEWS
    if keep.mean() < MIN_AGREEMENT:
        logger.warning(
            "%s: two views agree on %.2g %% of the points of its depth maps. Are they of its own "
            "model?",
            workspace.folder,
            100 * keep.mean(),
        )
    if len(surface_points):
        reach = CLEARANCE_PX * footprint
        distance = cKDTree(surface_points).query(cloud.points, distance_upper_bound=reach)[0]
        keep &= ~np.isfinite(distance)
    return merge(cloud[keep], VOXEL_PX * footprint)


def _views_in_voxel(points: Array, owner: NDArray[np.int64], voxel: float) -> NDArray[np.int32]:
    """How many owners have a point in each point's voxel."""
    cells = np.floor((points - points.min(axis=0)) / voxel).astype(np.int64)
    cell = np.unique(cells, axis=0, return_inverse=True)[1].reshape(-1)
    pairs = np.unique(np.stack([cell, owner], axis=1), axis=0)
    return np.bincount(pairs[:, 0])[cell].astype(np.int32)


def _view_cloud(item: WorkspaceView) -> tuple[FusedCloud, float]:
    """Points of one view's maps, and the footprint of a pixel there."""
    maps = item.load_maps()
    if maps is None or not (maps.depth > 0).any():
        return no_points(), 0.0
    view, camera = item.view, item.camera
    depth = maps.depth[::STRIDE_PX, ::STRIDE_PX].astype(np.float64)
    normals = maps.normals[::STRIDE_PX, ::STRIDE_PX].astype(np.float64)
    rays = camera.rays(map_pixel_xy(camera.width, camera.height)[::STRIDE_PX, ::STRIDE_PX])
    facing = -(normals * rays).sum(axis=-1)
    known = (depth > 0) & (facing > MIN_COSINE)
    distance = depth[known] / rays[known][:, 2]
    world_from_cam = view.cam_from_world.inverse()
    intensity = item.load_image()[::STRIDE_PX, ::STRIDE_PX][known] / 255
    num = int(known.sum())
    cloud = FusedCloud(
        points=world_from_cam * (rays[known] * distance[:, None]),
        normals=normals[known] @ world_from_cam.rotation.T,
        intensity=intensity.astype(np.float32),
        num_views=np.ones(num, np.int32),
        sigma_deg=np.full(num, NORMAL_SIGMA_DEG, np.float32),
        sigma=(DEPTH_SIGMA_PX * distance / camera.mean_focal_px).astype(np.float32),
    )
    return cloud, float(np.median(distance)) / camera.mean_focal_px if num else 0.0
