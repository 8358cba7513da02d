"""Fusion: the points on which views agree, each at the mean position of these views."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import depth_buffer, in_image, sample_image
from polmvs.config import FusionOptions, PropagationOptions
from polmvs.geometry import points_on_rays, unit_or_zero
from polmvs.neighbors import are_usual, point_spacings, voxel_of_each
from polmvs.normals.rows import OCCLUSION_TOLERANCE
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_FACING_COSINE, View
from polmvs.surface.dense_view import DenseView

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

MAX_DEVIATIONS = 3.0  # between views at one point: 0.3 % of correct ones differ by more


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


@dataclass(frozen=True)
class Sighting:
    """Surface of another view at N points of a view.

    Attributes
    ----------
    place : (N,) distance along the first view's rays to the other's surface; NaN: none.
    sigma : (N,) its standard deviation.
    normals : (N, 3) its normal there, zero if it has none.
    cosine : (N,) between that normal and the point's own.
    excess : (N,) distance of its surface behind the point, along its own ray; NaN: none.
    facing : (N,) cosine between the point's normal and the direction to the other camera.
    outside : (N,) its image contains the point but shows no polarized surface there.
    """

    place: Array
    sigma: Array
    normals: Array
    cosine: Array
    excess: Array
    facing: Array
    outside: Mask


def sight(
    phase_map: PhaseMap,
    dense: DenseView,
    center: Floats,
    rays: Floats,
    distance: Floats,
    normals: Floats,
) -> Sighting:
    """Look up a view's points in another dense view.

    Parameters
    ----------
    phase_map, dense : of the other view.
    center, rays, distance, normals : of the first view's points: camera centre (3,), unit rays
        (N, 3), distances (N,) and unit normals (N, 3), world frame.
    """
    view = phase_map.view
    points = points_on_rays(center, rays, distance)
    in_cam = view.cam_from_world * points
    own_range = np.linalg.norm(in_cam, axis=-1)
    xy = view.camera.project(in_cam)
    lattice_xy = xy / dense.stride_px
    seen = sample_image(dense.range_map, lattice_xy, nearest=True).astype(np.float64)
    seen_normals = sample_image(dense.normals_in_world, lattice_xy, nearest=True)
    seen_normals = np.where(seen[:, None] > 0, seen_normals.astype(np.float64), np.nan)
    # The other's surface element at the nearest lattice point, and the chord from there to the
    # point: perpendicular to the mean of both normals, exactly so on planes and spheres. The
    # element's own plane would lie outside of every convex surface.
    nearest_xy = (np.floor(np.nan_to_num(lattice_xy)) + 0.5) * dense.stride_px
    other_rays = view.rays_in_world(nearest_xy)
    elements = points_on_rays(view.center_in_world, other_rays, seen)
    slant = (rays * seen_normals).sum(-1)
    mean = seen_normals + normals
    with np.errstate(divide="ignore", invalid="ignore"):
        place = ((elements - center) * mean).sum(-1) / (rays * mean).sum(-1)
        # An error along the other's ray moves the surface along its normal, by less where it looks
        # at a grazing angle; but there its rows come from farther off, so that it is not trusted
        # more.
        seen_sigma = sample_image(dense.sigma, lattice_xy, nearest=True)
        sigma = seen_sigma / np.abs(slant)
        facing = view.facing_cosines(points, normals)
    excess = np.where(seen > 0, seen - own_range, np.nan)
    cosine = (seen_normals * normals).sum(axis=-1)
    outside = _shows_background(phase_map, xy)
    return Sighting(place, sigma, np.nan_to_num(seen_normals), cosine, excess, facing, outside)


def hidden_by(dense: DenseView, view: View, points: Floats, normals: Floats) -> Mask:
    """Which lattice points (h, w) of a view lie behind a surface that faces it.

    Views may agree on a surface that this view cannot see and that its phase does not contradict.

    Parameters
    ----------
    dense, view : of the view.
    points, normals : (N, 3), world, of the surfaces of all views.
    """
    xy = view.project(points) / dense.stride_px
    height, width = dense.range_map.shape
    with np.errstate(invalid="ignore"):
        shown = view.faces(points, normals) & ((xy >= 0) & (xy < [width, height])).all(axis=-1)
    nearest, _ = depth_buffer(xy[shown], view.ranges(points[shown]), width, height)
    return np.asarray(dense.range_map > (1 + OCCLUSION_TOLERANCE) * nearest)


def _shows_background(phase_map: PhaseMap, xy: Floats) -> Mask:
    """Which points lie in the image but outside its region."""
    return np.asarray(in_image(phase_map.view.camera, xy) & ~phase_map.shows_surface(xy))
