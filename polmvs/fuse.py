"""Fusion: the points on which views agree, each placed by all views that see it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.camera import sample_image
from polmvs.config import FusionOptions
from polmvs.dense import DenseView
from polmvs.parallel import Workers
from polmvs.phasemap import PhaseMap

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

MAX_CONFLICT_SHARE = 0.5  # of the views that could see a point and see something else there
MIN_VISIBLE_COSINE = 0.1  # between normal and viewing direction, for a view to have a say
OUTLIER_NEIGHBORS = 8
OUTLIER_SPACINGS = 4.0  # a point this many spacings from its neighbours is alone


@dataclass(frozen=True)
class FusedCloud:
    """Points of the surface in the world.

    Attributes
    ----------
    points, normals : (N, 3) float64, world frame; normals are unit and face the cameras.
    intensity : (N,) float32, s0 in units of full scale.
    num_views : (N,) int32, views that agree on the point.
    sigma_deg : (N,) float32, standard deviation of the normal.
    """

    points: Array
    normals: Array
    intensity: NDArray[np.float32]
    num_views: NDArray[np.int32]
    sigma_deg: NDArray[np.float32]

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> FusedCloud:
        """Some of the points."""
        return FusedCloud(
            self.points[index],
            self.normals[index],
            self.intensity[index],
            self.num_views[index],
            self.sigma_deg[index],
        )


def fuse(
    maps: Sequence[PhaseMap],
    dense: Sequence[DenseView | None],
    options: FusionOptions,
    *,
    max_neighbors: int = 15,
    workers: Workers | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> FusedCloud:
    """Fuse the dense views into one cloud.

    A point stays if enough views agree with it in distance and normal and if not most of the
    views that should see it see through it or show no polarised surface there. It moves along
    its ray to the mean of the places that the agreeing views give it. Points closer than the
    merging voxel become one; lone points go.

    Parameters
    ----------
    maps : phase maps of the views.
    dense : per view its dense result.
    options : thresholds, in footprints of a pixel.
    max_neighbors : other views that are asked about a view's points, nearest first.
    workers : processes to share the views among; None: this one.
    on_progress : called with the number of views done.
    """
    workers = workers or Workers(1)
    used = [k for k, d in enumerate(dense) if d is not None]
    centers = np.array([maps[k].view.center_in_world for k in used]).reshape(-1, 3)
    tasks = []
    for i, k in enumerate(used):
        order = np.argsort(((centers - centers[i]) ** 2).sum(axis=-1), kind="stable")
        near = [used[j] for j in order if j != i][:max_neighbors]
        tasks.append([(maps[j], dense[j]) for j in [k, *near]])
    parts = []
    for part in workers.map(partial(_confirm, options), tasks):
        parts.append(part)
        if on_progress is not None:
            on_progress(1)
    cloud = _concatenate([p[0] for p in parts])
    if not len(cloud.points):
        return cloud
    footprint = float(np.median(np.concatenate([p[1] for p in parts])))
    return _without_lone_points(_merge(cloud, options.voxel_px * footprint))


def _confirm(
    options: FusionOptions, views: Sequence[tuple[PhaseMap, DenseView]]
) -> tuple[FusedCloud, NDArray[np.float32]]:
    """Points of the first view that enough of the others confirm, and their pixels' footprints."""
    phase_map, dense = views[0]
    view = phase_map.view
    known = (dense.range_map > 0) & np.isfinite(dense.normals_in_world).all(axis=-1)
    xy = dense.lattice_xy()[known]
    distance = dense.range_map[known].astype(np.float64)
    normals = dense.normals_in_world[known].astype(np.float64)
    rays = view.camera.rays(xy) @ view.cam_from_world.rotation
    center = view.center_in_world
    footprint = distance / view.camera.mean_focal_px
    place, normal = distance.copy(), normals.copy()
    votes, conflicts = np.ones(len(distance), np.int32), np.zeros(len(distance), np.int32)
    min_cosine = np.cos(np.radians(options.max_normal_difference_deg))
    for other_map, other in views[1:]:
        opinion = _opinion(other_map, other, center, rays, distance, normals)
        close = np.abs(opinion.place - distance) < options.max_range_difference_px * footprint
        agrees = close & (opinion.cosine > min_cosine)
        votes += agrees
        behind = opinion.excess > 2 * options.max_range_difference_px * footprint
        conflicts += (behind | opinion.outside) & (opinion.facing > MIN_VISIBLE_COSINE)
        place += np.where(agrees, opinion.place, 0)
        normal += np.where(agrees[:, None], opinion.normals, 0)
    place /= votes
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    keep = (votes >= options.min_views) & (conflicts <= MAX_CONFLICT_SHARE * (votes + conflicts))
    cloud = FusedCloud(
        center + place[:, None] * rays,
        normal,
        sample_image(phase_map.intensity, xy),
        votes,
        dense.sigma_deg[known],
    )
    return cloud[keep], footprint[keep].astype(np.float32)


@dataclass(frozen=True)
class _Opinion:
    """What another view says of a view's points.

    ``place``: distance along the first view's rays at which the other's surface is met (NaN:
    none). ``normals``, ``cosine``: its normal and the cosine to the point's own. ``excess``: how
    much farther than the point its surface lies, along its own ray (NaN: it has none there).
    ``facing``: cosine between the point's normal and the direction to the other camera.
    ``outside``: it shows the point's place and no polarised surface there.
    """

    place: Array
    normals: Array
    cosine: Array
    excess: Array
    facing: Array
    outside: Mask


def _opinion(
    phase_map: PhaseMap,
    dense: DenseView,
    center: Array,
    rays: Array,
    distance: Array,
    normals: Array,
) -> _Opinion:
    """Look a view's points up in another dense view."""
    view = phase_map.view
    points = center + distance[:, None] * rays
    in_cam = view.cam_from_world * points
    own_range = np.linalg.norm(in_cam, axis=-1)
    xy = view.camera.project(in_cam)
    lattice_xy = xy / dense.stride_px
    seen = sample_image(dense.range_map, lattice_xy, nearest=True).astype(np.float64)
    seen_normals = sample_image(dense.normals_in_world, lattice_xy, nearest=True)
    seen_normals = np.where(seen[:, None] > 0, seen_normals.astype(np.float64), np.nan)
    other_center = view.center_in_world
    # The other's surface element at the nearest lattice point: a plane through its point.
    nearest_xy = (np.floor(np.nan_to_num(lattice_xy)) + 0.5) * dense.stride_px
    other_rays = view.camera.rays(nearest_xy) @ view.cam_from_world.rotation
    elements = other_center + seen[:, None] * other_rays
    with np.errstate(divide="ignore", invalid="ignore"):
        place = ((elements - center) * seen_normals).sum(-1) / (rays * seen_normals).sum(-1)
        to_camera = other_center - points
        facing = (to_camera * normals).sum(-1) / own_range
    excess = np.where(seen > 0, seen - own_range, np.nan)
    cosine = (seen_normals * normals).sum(axis=-1)
    outside = _shows_background(phase_map, xy)
    return _Opinion(place, np.nan_to_num(seen_normals), cosine, excess, facing, outside)


def _shows_background(phase_map: PhaseMap, xy: Floats) -> Mask:
    """Which places lie in the image but outside its region."""
    camera = phase_map.view.camera
    in_image = ((xy >= 0) & (xy < [camera.width, camera.height])).all(axis=-1)
    return np.asarray(in_image & ~phase_map.shows_surface(xy))


def _concatenate(clouds: Sequence[FusedCloud]) -> FusedCloud:
    """All points of some clouds."""
    empty = FusedCloud(
        np.zeros((0, 3)),
        np.zeros((0, 3)),
        np.zeros(0, np.float32),
        np.zeros(0, np.int32),
        np.zeros(0, np.float32),
    )
    clouds = [empty, *clouds]
    return FusedCloud(
        np.concatenate([c.points for c in clouds]),
        np.concatenate([c.normals for c in clouds]),
        np.concatenate([c.intensity for c in clouds]),
        np.concatenate([c.num_views for c in clouds]),
        np.concatenate([c.sigma_deg for c in clouds]),
    )


def _merge(cloud: FusedCloud, voxel: float) -> FusedCloud:
    """One point per voxel: means weighted by the number of agreeing views."""
    if voxel <= 0:
        return cloud
    cells = np.floor((cloud.points - cloud.points.min(axis=0)) / voxel).astype(np.int64)
    extent = cells.max(axis=0) + 1
    key = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    unique, inverse = np.unique(key, return_inverse=True)
    num = len(unique)
    weight = cloud.num_views.astype(np.float64)
    total = np.bincount(inverse, weight, num)

    def mean(values: Floats) -> Array:
        return np.bincount(inverse, weight * values, num) / total

    points = np.stack([mean(cloud.points[:, i]) for i in range(3)], axis=-1)
    normals = np.stack([mean(cloud.normals[:, i]) for i in range(3)], axis=-1)
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    views = np.zeros(num, np.int32)
    np.maximum.at(views, inverse, cloud.num_views)
    return FusedCloud(
        points,
        normals,
        mean(cloud.intensity).astype(np.float32),
        views,
        mean(cloud.sigma_deg).astype(np.float32),
    )


def _without_lone_points(cloud: FusedCloud) -> FusedCloud:
    """Remove points far from their neighbours, by the spacing that is usual in the cloud."""
    k = min(OUTLIER_NEIGHBORS + 1, len(cloud.points))
    if k < 2:
        return cloud
    gaps = cKDTree(cloud.points).query(cloud.points, k=k, workers=-1)[0][:, -1]
    return cloud[gaps <= OUTLIER_SPACINGS * np.median(gaps)]
