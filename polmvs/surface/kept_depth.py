"""Points of COLMAP's own depth maps where no polarized surface was found."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.colmap.dense_workspace import FUSED_NORMAL_DEG, DenseWorkspace, WorkspaceView
from polmvs.colmap.maps import map_pixel_xy
from polmvs.config import PropagationOptions
from polmvs.neighbors import voxel_of_each
from polmvs.scene import KEYPOINT_SIGMA_PX
from polmvs.surface.fusion import FusedCloud, concatenate, merge, no_points

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class KeptDepthTolerances:
    """Tolerances of the points of COLMAP's depth maps that are kept; lengths in GSD.

    Attributes
    ----------
    stride_px : stride of the used pixels, and side of the voxel in which a second view must have a
        point. Derived: as dense as the polarized surface.
    min_agreement : share of the points with a second view below which the maps are doubtful; a
        guess: COLMAP keeps points that other views confirm, so most have one. If unit or frame of
        the maps and poses differ, hardly any has one.
    normal_sigma_deg : difference that COLMAP's fusion allows between views. Derived: its default.
    clearance_px : distance from the polarized surface; a guess.
    """

    stride_px: int = PropagationOptions.stride_px
    min_agreement: float = 0.1
    normal_sigma_deg: float = FUSED_NORMAL_DEG
    clearance_px: float = 6.0


TOL = KeptDepthTolerances()


def kept_cloud(
    workspace: DenseWorkspace,
    surface_points: Array,
) -> FusedCloud:
    """Fuse the maps of a workspace without the points on polarized surfaces.

    Parameters
    ----------
    workspace : with maps of some views; one view is in memory at a time.
    surface_points : (N, 3), world, of the polarized surfaces.

    Returns
    -------
    Points of voxels that two views or more have points in.
    """
    clouds, gsds = [], []
    for item in workspace.views:
        cloud, gsd = _view_cloud(item)
        if len(cloud.points):
            clouds.append(cloud)
            gsds.append(gsd)
    if not clouds:
        return no_points()
    cloud, gsd = concatenate(clouds), float(np.median(gsds))
    owner = np.repeat(np.arange(len(clouds)), [len(part.points) for part in clouds])
    num_views = _views_in_voxel(cloud.points, owner, TOL.stride_px * gsd)
    cloud = replace(cloud, num_views=num_views)
    keep = num_views > 1
    if keep.mean() < TOL.min_agreement:
        logger.warning(
            "%s: two views agree on %.2g %% of the points of its depth maps. Are they of its own "
            "model?",
            workspace.folder,
            100 * keep.mean(),
        )
    if len(surface_points):
        reach = TOL.clearance_px * gsd
        distance = cKDTree(surface_points).query(cloud.points, distance_upper_bound=reach)[0]
        keep &= ~np.isfinite(distance)
    return merge(cloud[keep], gsd)


def _views_in_voxel(points: Array, owner: NDArray[np.int64], voxel: float) -> NDArray[np.int32]:
    """How many owners have a point in each point's voxel."""
    cell = voxel_of_each(points, voxel)
    pairs = np.unique(np.stack([cell, owner], axis=1), axis=0)
    return np.bincount(pairs[:, 0])[cell].astype(np.int32)


def _view_cloud(item: WorkspaceView) -> tuple[FusedCloud, float]:
    """Points of one view's maps, and the gsd of a pixel there."""
    maps = item.load_maps()
    if maps is None or not (maps.depth > 0).any():
        return no_points(), 0.0
    view, camera = item.view, item.camera
    lattice = (slice(None, None, TOL.stride_px),) * 2
    depth, normals_in_cam = maps.depth[lattice], maps.normals[lattice]
    xy = map_pixel_xy(camera.width, camera.height)[lattice]
    known = (depth > 0) & (normals_in_cam != 0).any(axis=-1)
    ranges = depth[known].astype(np.float64) / camera.rays(xy[known])[:, 2]
    points = view.points_at(xy[known], ranges)
    normals = normals_in_cam[known].astype(np.float64) @ view.cam_from_world.rotation
    facing = view.faces(points, normals)
    num, ranges = int(facing.sum()), ranges[facing]
    cloud = FusedCloud(
        points=points[facing],
        normals=normals[facing],
        intensity=(item.load_image()[lattice][known][facing] / 255).astype(np.float32),
        num_views=np.ones(num, np.int32),
        sigma_deg=np.full(num, TOL.normal_sigma_deg, np.float32),
        # COLMAP matches patches about as well as keypoints.
        sigma=(KEYPOINT_SIGMA_PX * ranges / camera.mean_focal_px).astype(np.float32),
    )
    return cloud, float(np.median(ranges)) / camera.mean_focal_px if num else 0.0
