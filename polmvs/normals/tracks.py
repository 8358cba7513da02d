"""Normals of sparse points from the phases of all views, and the seeds among them.

SfM features lie on printed marks and edges, where the light is mixed, so the phase at a keypoint is
unreliable. Rows therefore come from the reliable pixels in a window about the projected point, in
every view that sees it and not only in the views that matched it.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields, replace

import cv2
import numpy as np

from polmvs.arrays import Array, Mask
from polmvs.camera import in_image, sample_image
from polmvs.config import Estimator, NormalOptions
from polmvs.memory import MemoryNeeds
from polmvs.normals.estimator import NormalEstimate, solve_normals
from polmvs.normals.mixture_estimator import MixtureEstimate, row_scales, solve_mixture
from polmvs.normals.observations import PointObservations, gather_observations
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_VIEWS, Seeds, Tracks, evenly_spread, point_sigmas, some_tracks

logger = logging.getLogger(__name__)


MAX_SCALE_POINTS = 600  # points for the scales of the rows. Guess: more cost time only
MAX_ROWS = MemoryNeeds.max_rows  # rows of points and views at a time, without a budget
# A region's border is that uncertain, by marks and smoothing: points nearer to it may lie on the
# background. Guess.
BORDER_MARGIN_PX = 3


@dataclass(frozen=True, kw_only=True)
class SeedTolerances:
    """Tolerances of seeds: tracks whose phases one normal explains.

    Attributes
    ----------
    min_inside_share : share of a track's views that must see it in their region, and of the views
        that its point faces that must show the surface there. Guess.
    max_dolp_share : of a mark's DoLP in that of the surface about it. Guess.
    clear_dolp : least DoLP of the surface for this comparison. Guess.
    max_sigma_deg : of the normal. Guess.
    min_on_region : number of seeds on strongly polarized regions above which the other seeds are
        surroundings. Derived: three points make a plane.
    """

    min_inside_share: float = 0.8
    max_dolp_share: float = 0.85
    clear_dolp: float = 0.15
    max_sigma_deg: float = 5.0
    min_on_region: int = 3


TOL = SeedTolerances()


def observe(
    angle_model: AngleModel, tracks: Tracks, maps: Sequence[PhaseMap], options: NormalOptions
) -> tuple[PointObservations, Mask]:
    """Observations of tracks in all views, and the views (K, T) that match them."""
    found = gather_observations(
        angle_model,
        tracks.points_in_world,
        maps,
        window_px=options.window_px,
        tilt_aware=options.tilt_aware_weights,
    )
    return found, matched_views(tracks, len(maps))


def matched_views(tracks: Tracks, num_views: int) -> Mask:
    """Which views (K, T) match each track."""
    matched = np.zeros((num_views, len(tracks.points_in_world)), bool)
    matched[tracks.obs_view, tracks.obs_track] = True
    return matched


def evenly_chosen(num_points: int, limit: int) -> Mask:
    """Of points (N,) some that are spread evenly over them, ``limit`` at most."""
    chosen = np.zeros(num_points, bool)
    chosen[evenly_spread(num_points, limit)] = True
    return chosen


def track_normals(
    angle_model: AngleModel,
    tracks: Tracks,
    maps: Sequence[PhaseMap],
    options: NormalOptions,
    light: Light | None = None,
    *,
    max_rows: int = MAX_ROWS,
) -> MixtureEstimate:
    """Normals of all tracks (paper, eq. coeff_2), many at a time; one map is held at a time.

    Parameters
    ----------
    angle_model : OPA, PPA or tilted.
    tracks : sparse points; ``obs_view`` counts in ``maps``.
    maps : phase maps of the views.
    options : window, estimator and weights.
    light : of all observations, if known; else each observation has its own.
    max_rows : rows of tracks and views that are solved at a time.
    """
    prior = {None: 0.5, Light.SPECULAR: 1.0, Light.DIFFUSE: 0.0}[light]

    # The scales of the rows of each view come from some of the points first.
    limit = min(MAX_SCALE_POINTS, max(1, max_rows // max(len(maps), 1)))
    chosen = evenly_chosen(len(tracks.points_in_world), limit)
    tiles = list(in_tiles(tracks, len(maps), max_rows))
    observed = observe(angle_model, tracks, maps, options) if len(tiles) == 1 else None
    if observed is None:
        found, matched = observe(angle_model, some_tracks(tracks, chosen), maps, options)
    else:
        found, matched = observed[0].some(chosen), observed[1][:, chosen]
    first = solve_mixture(found, matched, prior_specular=prior)
    scales = row_scales(found, matched, first)
    logger.debug("rows err by %s of what is stated", np.round(scales.of_views, 2))
    estimates = []
    for some in tiles:
        found, matched = observed or observe(angle_model, some, maps, options)
        estimate = solve_mixture(found, matched, prior_specular=prior, scales=scales)
        if options.estimator is Estimator.ALGEBRAIC:
            estimate = _algebraic(found, estimate)
        estimates.append(estimate)
    joined = {
        field.name: np.concatenate([getattr(one, field.name) for one in estimates], axis=axis)
        for field in fields(MixtureEstimate)
        # These have views before tracks.
        for axis in [1 if field.name in ("row_weights", "labels") else 0]
    }
    return MixtureEstimate(**joined)


def _algebraic(found: PointObservations, estimate: MixtureEstimate) -> MixtureEstimate:
    """The paper's estimator on rows whose light is told: their eigenvector, all alike."""
    diffuse = estimate.labels < 0
    rows = np.where(diffuse, found.rows[1], found.rows[0])
    variance = np.where(diffuse, found.turn_variances[1], found.turn_variances[0])
    sigma = np.where(estimate.labels != 0, np.sqrt(variance), np.inf)
    solved = solve_normals(rows, found.rays, sigma, robust=False)
    return replace(estimate, **{f.name: getattr(solved, f.name) for f in fields(NormalEstimate)})


def in_tiles(tracks: Tracks, num_views: int, max_rows: int) -> Iterator[Tracks]:
    """The tracks in order, in tiles with at most ``max_rows`` rows in all views."""
    num = max(1, max_rows // max(num_views, 1))
    index = np.arange(len(tracks.points_in_world))
    for start in range(0, max(len(index), 1), num):
        yield some_tracks(tracks, (index >= start) & (index < start + num))


def tracks_on_parts(tracks: Tracks, maps: Sequence[PhaseMap]) -> Tracks:
    """The tracks that at least one of their views sees in its region."""
    return some_tracks(tracks, inside_shares(tracks, maps, margin_px=0) > 0)


def inside_shares(
    tracks: Tracks, maps: Sequence[PhaseMap], margin_px: int = BORDER_MARGIN_PX
) -> Array:
    """Share ``(T,)`` of each track's observations that lie well inside their view's region."""
    num_tracks = len(tracks.points_in_world)
    inside = np.zeros(len(tracks.obs_track), bool)
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    for phase_map, here in zip(maps, tracks.of_views(len(maps)), strict=True):
        flags = phase_map.region.inside.astype(np.uint8)
        eroded = cv2.erode(flags, kernel, borderType=cv2.BORDER_REPLICATE).astype(np.float32)
        inside[here] = sample_image(eroded, tracks.obs_xy[here], nearest=True) > 0
    count = np.bincount(tracks.obs_track, minlength=num_tracks)
    return np.asarray(np.bincount(tracks.obs_track, inside, num_tracks) / np.maximum(count, 1))


def seen_shares(points: Array, normals: Array, maps: Sequence[PhaseMap]) -> Array:
    """Share ``(T,)`` of the views that a point faces which show the region there.

    0 for points that face no view or have no normal.
    """
    facing, seen = np.zeros(len(points)), np.zeros(len(points))
    for phase_map in maps:
        view = phase_map.view
        xy = view.project(points)
        shown = in_image(view.camera, xy) & view.faces(points, normals)
        facing += shown
        seen += shown & phase_map.shows_surface(xy)
    return np.asarray(seen / np.maximum(facing, 1))


def dolp_shares(tracks: Tracks, maps: Sequence[PhaseMap]) -> Array:
    """DoLP at the keypoints over that of the surface about them, the median ``(T,)`` of a track.

    NaN if the surface is nowhere polarized enough.
    """
    ratio = np.full(len(tracks.obs_track), np.nan)
    for phase_map, here in zip(maps, tracks.of_views(len(maps)), strict=True):
        xy = tracks.obs_xy[here]
        lowest = sample_image(phase_map.lowest_dolp.astype(np.float32), xy, nearest=True) / 255
        about = sample_image(phase_map.samples, xy, nearest=True)
        surface = np.hypot(about[:, 0], about[:, 1])
        ratio[here] = np.where(surface > TOL.clear_dolp, lowest / np.maximum(surface, 1e-6), np.nan)
    known = np.isfinite(ratio)
    # The median of each track: its ratios lie together once sorted by track and value.
    order = np.lexsort((ratio[known], tracks.obs_track[known]))
    owner, values = tracks.obs_track[known][order], ratio[known][order]
    count = np.bincount(owner, minlength=len(tracks.points_in_world))
    first = np.cumsum(count) - count
    medians = np.full(len(count), np.nan)
    has = count > 0
    medians[has] = values[first[has] + (count[has] - 1) // 2]
    return medians


def select_seeds(
    tracks: Tracks,
    estimate: NormalEstimate,
    maps: Sequence[PhaseMap],
) -> tuple[Seeds, Mask]:
    """Tracks whose normal explains the observations of all views.

    If some of them lie on strongly polarized regions, these are the seeds and the others are
    surroundings; otherwise all are seeds.

    A flat glossy surface mirrors its surroundings, and the mirror images make good tracks behind
    the surface. They are detected: from oblique views they leave the region, and unlike prints on
    the surface they have its polarization.

    Returns
    -------
    The seeds, and whether each track ``(T,)`` is one.
    """
    good = (
        estimate.valid & (estimate.num_rows >= MIN_VIEWS) & (estimate.sigma_deg < TOL.max_sigma_deg)
    )
    some = some_tracks(tracks, good)
    good[good] = ~(dolp_shares(some, maps) > TOL.max_dolp_share)
    # The slowest test last, on the remaining tracks: it looks up all points in all views.
    on_region = good.copy()
    on_region[good] = inside_shares(some_tracks(tracks, good), maps) >= TOL.min_inside_share
    points, normals = tracks.points_in_world[on_region], estimate.normals[on_region]
    on_region[on_region] = seen_shares(points, normals, maps) >= TOL.min_inside_share
    if on_region.sum() >= TOL.min_on_region:
        good = on_region
    some = some_tracks(tracks, good)
    sigma = point_sigmas(some, [m.view for m in maps])
    return Seeds(some.points_in_world, estimate.normals[good], sigma), good
