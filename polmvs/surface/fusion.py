"""Fusion: the points on which views agree, each at the mean position of these views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.config import FusionOptions, PropagationOptions
from polmvs.geometry import points_on_rays, unit_or_zero
from polmvs.neighbors import are_usual, point_spacings, voxel_of_each
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_FACING_COSINE
from polmvs.surface.consensus import MAX_DEVIATIONS, sight
from polmvs.surface.dense_view import DenseView

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class FusionTolerances:
    """Tolerances of the agreement of views, in addition to the options.

    Attributes
    ----------
    min_tolerance : least share of the tolerance, for views of any certainty. Guess.
    min_sigma_px : least deviation of a range, GSD. Guess.
    """

    min_tolerance: float = 0.5
    min_sigma_px: float = 0.02


TOL = FusionTolerances()


@dataclass(frozen=True)
class FusedCloud:
    """Points of the surface in the world.

    Attributes
    ----------
    points, normals : (N, 3) float64, world frame; normals are unit and face the cameras.
    intensity : (N,) float32, s0 in units of full scale.
    num_views : (N,) int32, views that agree on the point.
    sigma_deg : (N,) float32, standard deviation of the normal.
    sigma : (N,) float32, standard deviation of the position along the normal, world units. The
        errors of views are correlated, so their number does not reduce it.
    """

    points: Array
    normals: Array
    intensity: NDArray[np.float32]
    num_views: NDArray[np.int32]
    sigma_deg: NDArray[np.float32]
    sigma: NDArray[np.float32]

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> FusedCloud:
        """Some of the points."""
        return FusedCloud(*(getattr(self, name)[index] for name in COLUMNS))


COLUMNS = tuple(column.name for column in fields(FusedCloud))


def fuse(
    maps: Sequence[PhaseMap],
    dense: Sequence[DenseView | None],
    options: FusionOptions,
    *,
    max_neighbors: int = PropagationOptions.max_neighbors,
    workers: Workers | None = None,
    on_progress: OnProgress = no_progress,
    on_confirmed: Callable[[int, Mask], None] = lambda index, confirmed: None,
) -> FusedCloud:
    """Fuse the dense views into one cloud.

    A point is kept if enough views agree with it in distance and normal, and unless most of the
    views that should see it see through it or show no polarized surface there. Distances may differ
    within their deviations, at most by the GSDs of the options and at least by half of that. The
    point moves along its ray to the mean position of the agreeing views, weighted by their inverse
    variances. Points within one merging voxel become one; isolated points are removed.

    Parameters
    ----------
    maps : phase maps of the views.
    dense : per view its dense result.
    options : thresholds, in GSD.
    max_neighbors : number of other views with which a view's points are compared, nearest first.
    workers : processes for the views; None: this process.
    on_progress : called with the number of views done.
    on_confirmed : called with the index of each view that has a result and with the points
        (h, w) of its lattice on which the others agree.
    """
    workers = workers or Workers(1)
    used = [k for k, d in enumerate(dense) if d is not None]
    centers = np.array([maps[k].view.center_in_world for k in used]).reshape(-1, 3)
    tasks = []
    for i, k in enumerate(used):
        order = np.argsort(((centers - centers[i]) ** 2).sum(axis=-1), kind="stable")
        near = [used[j] for j in order if j != i][:max_neighbors]
        tasks.append([(maps[j], dense[j]) for j in [k, *near]])
    clouds, gsds = [], []
    for k, part in zip(used, workers.map(partial(_confirm, options), tasks), strict=True):
        clouds.append(part.cloud)
        gsds.append(part.gsd)
        on_confirmed(k, part.confirmed)
        on_progress(1)
    cloud = concatenate(clouds)
    if not len(cloud.points):
        return cloud
    gsd = float(np.median(np.concatenate(gsds)))
    voxel = options.voxel if options.voxel is not None else options.voxel_px * gsd
    cloud = merge(cloud, voxel)
    return cloud[are_usual(point_spacings(cloud.points))]


@dataclass(frozen=True)
class _Confirmed:
    """Confirmed points of a view, their pixels' GSDs, and where (h, w) they lie in it."""

    cloud: FusedCloud
    gsd: NDArray[np.float32]
    confirmed: Mask


def _confirm(
    options: FusionOptions,
    views: Sequence[tuple[PhaseMap, DenseView]],
) -> _Confirmed:
    """Points of the first view that enough of the others confirm."""
    phase_map, dense = views[0]
    view = phase_map.view
    known = dense.known & (dense.confidence > 0)
    xy = dense.lattice_xy()[known]
    distance = dense.range_map[known].astype(np.float64)
    normals = dense.normals_in_world[known].astype(np.float64)
    rays = view.rays_in_world(xy)
    center = view.center_in_world
    gsd = distance / view.camera.mean_focal_px
    # As the others' deviations: grazing sight counts less.
    cosine = np.maximum(np.abs((rays * normals).sum(axis=-1)), MIN_FACING_COSINE)
    sigma = _finite_sigma(dense.sigma[known] / cosine, gsd)
    tolerance = options.max_range_difference_px * gsd
    total = 1 / sigma**2
    place, normal = total * distance, total[:, None] * normals
    votes, conflicts = np.ones(len(distance), np.int32), np.zeros(len(distance), np.int32)
    min_cosine = np.cos(np.radians(options.max_normal_difference_deg))
    for other_map, other in views[1:]:
        seen = sight(other_map, other, center, rays, distance, normals)
        other_sigma = _finite_sigma(seen.sigma, gsd)
        explained = MAX_DEVIATIONS * np.hypot(sigma, other_sigma)
        allowed = np.clip(explained, TOL.min_tolerance * tolerance, tolerance)
        agrees = (np.abs(seen.place - distance) < allowed) & (seen.cosine > min_cosine)
        votes += agrees
        behind = seen.excess > 2 * allowed
        conflicts += (behind | seen.outside) & (seen.facing > MIN_FACING_COSINE)
        weight = np.where(agrees, 1 / other_sigma**2, 0)
        total += weight
        place += weight * np.where(agrees, seen.place, 0)
        normal += weight[:, None] * seen.normals
    normal /= np.linalg.norm(normal, axis=-1, keepdims=True)
    keep = (votes >= options.min_views) & (conflicts <= votes)
    cloud = FusedCloud(
        points=points_on_rays(center, rays, place / total),
        normals=normal,
        intensity=sample_image(phase_map.intensity, xy),
        num_views=votes,
        sigma_deg=dense.sigma_deg[known],
        sigma=np.sqrt(votes / total) * np.abs((rays * normal).sum(axis=-1)),
    )
    confirmed = known.copy()
    confirmed[known] = keep
    return _Confirmed(cloud[keep], gsd[keep].astype(np.float32), confirmed)


def _finite_sigma(sigma: Floats, gsd: Array) -> Array:
    """Deviations of ranges, no smaller than a share of the gsd; large where unknown."""
    known = np.isfinite(sigma)
    return np.where(known, np.maximum(sigma, TOL.min_sigma_px * gsd), gsd)


def concatenate(clouds: Sequence[FusedCloud]) -> FusedCloud:
    """All points of some clouds."""
    parts = [no_points(), *clouds]
    return FusedCloud(*(np.concatenate([getattr(c, name) for c in parts]) for name in COLUMNS))


def no_points() -> FusedCloud:
    """A cloud without points."""
    vectors, numbers = np.zeros((0, 3)), np.zeros(0, np.float32)
    return FusedCloud(vectors, vectors, numbers, np.zeros(0, np.int32), numbers, numbers)


def merge(cloud: FusedCloud, voxel: float) -> FusedCloud:
    """One point per voxel (world units; 0: no merging): means weighted by views and certainty."""
    if voxel <= 0 or not len(cloud.points):
        return cloud
    inverse = voxel_of_each(cloud.points, voxel)
    num = int(inverse.max()) + 1
    weight = cloud.num_views / np.maximum(cloud.sigma.astype(np.float64), 1e-3 * voxel) ** 2
    total = np.bincount(inverse, weight, num)

    def mean(values: Floats) -> Array:
        return np.bincount(inverse, weight * values, num) / total

    points = np.stack([mean(cloud.points[:, i]) for i in range(3)], axis=-1)
    normals = np.stack([mean(cloud.normals[:, i]) for i in range(3)], axis=-1)
    views = np.zeros(num, np.int32)
    np.maximum.at(views, inverse, cloud.num_views)
    return FusedCloud(
        points=points,
        normals=unit_or_zero(normals),
        intensity=mean(cloud.intensity).astype(np.float32),
        num_views=views,
        sigma_deg=mean(cloud.sigma_deg).astype(np.float32),
        sigma=mean(cloud.sigma).astype(np.float32),
    )
