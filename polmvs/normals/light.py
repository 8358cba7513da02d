"""Specular or diffuse: the dominant kind of light in each connected part of a region.

The phases of the two kinds differ by 90 degrees, so the wrong choice turns every plane of incidence
by 90 degrees. One view does not show the error. Three or more do, because wrong planes of incidence
do not intersect in one normal. Every sparse point on a part votes with the likelihoods of its two
best normals. Pixels of the part also vote: they are placed in the visual hull of the regions, at
the depth that best explains their phases, for each kind of light. One view alone is unreliable, so
all views that show a part decide. The DoLP votes where phases do not decide (specular light may be
fully polarized, diffuse light of a smooth dielectric hardly over 0.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats, Mask
from polmvs.camera import in_image, sample_image
from polmvs.config import NormalOptions
from polmvs.geometry import lengths, points_on_rays
from polmvs.normals.estimator import solve_normals
from polmvs.normals.mixture_estimator import solve_mixture
from polmvs.normals.rows import AS_MEASURED, OTHER_LIGHT, gather_rows_under
from polmvs.normals.tracks import MAX_ROWS, in_tiles, observe, tracks_on_parts
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_VIEWS, Tracks, evenly_spread

LIGHTS = (AS_MEASURED, OTHER_LIGHT)  # that of the maps, and the other


@dataclass(frozen=True, kw_only=True)
class LightTolerances:
    """Tolerances of the choice between specular and diffuse light.

    Attributes
    ----------
    min_rows : least number of rows of a point that votes, and of points of a part that votes.
        Derived: two planes of incidence always intersect in a normal.
    max_row_cost : of one row, so that a single row cannot outvote the others. Guess.
    diffuse_dolp : largest DoLP of diffuse light. Derived: smooth dielectric of ior 1.5, seen at a
        grazing angle.
    dolp_votes : log-likelihood of twice that DoLP. Guess.
    max_pixel_views : views, evenly spread, in which a part's pixels are looked up. Guess; more cost
        time only.
    num_pixels : pixels of a part that are placed in space. Guess; costs time only.
    num_steps : of the search for the hull along their rays. Guess: a step is 2 % of the distance.
    num_ranges : tried depths in the hull. Guess; the first is right where the surface is convex.
    widening : factor of the distances beyond those of the scene's points. Guess.
    """

    min_rows: int = MIN_VIEWS
    max_row_cost: float = 4.0
    diffuse_dolp: float = 0.4
    dolp_votes: float = 20.0
    max_pixel_views: int = 60
    num_pixels: int = 64
    num_steps: int = 48
    num_ranges: int = 7
    widening: float = 1.3


TOL = LightTolerances()


def find_diffuse_parts(
    tracks: Tracks,
    maps: Sequence[PhaseMap],
    *,
    max_rows: int = MAX_ROWS,
) -> list[Mask]:
    """Connected parts of each view's region with mainly diffuse light.

    Each part is decided as a whole: by the votes of its points and pixels and of the same part in
    other views, else by the majority of the capture.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``.
    maps : phase maps built for specular light; one is held at a time.
    max_rows : rows of points and views that are solved at a time.

    Returns
    -------
    For each map ``(P,)`` bool, by part, for :func:`diffuse_pixels`.
    """
    on_parts = tracks_on_parts(tracks, maps)
    votes, voting = track_votes(on_parts, maps, max_rows=max_rows)
    of_points = [
        _part_votes(m, on_parts.points_in_world[voting], votes[voting], TOL.min_rows) for m in maps
    ]
    slots = _place_pixels(maps, tracks.points_in_world)
    of_pixels = _pixel_votes(slots, maps, max_rows)
    overall = float(votes[voting].sum()) + _dolp_votes(maps)
    own = []
    for known, dense in zip(of_points, of_pixels, strict=True):
        unknown = np.isnan(known) & np.isnan(dense)
        own.append(np.where(unknown, np.nan, np.nan_to_num(known) + np.nan_to_num(dense)))
        overall += float(np.nansum(dense))
    # Without any evidence light is specular, which is polarized most.
    tie = overall if overall != 0 else 1.0
    verdicts = (
        np.where(np.isfinite(pooled), pooled, overall) for pooled in _pooled_votes(slots, own, maps)
    )
    return [np.where(verdict == 0, tie, verdict) < 0 for verdict in verdicts]


def diffuse_pixels(phase_map: PhaseMap, parts: Mask) -> Mask:
    """Pixels ``(H, W)`` of those parts ``(P,)`` of a view; see :func:`find_diffuse_parts`."""
    return np.asarray(parts[_parts_of(phase_map)] & phase_map.region.inside)


def track_votes(
    tracks: Tracks,
    maps: Sequence[PhaseMap],
    *,
    max_rows: int = MAX_ROWS,
) -> tuple[Array, Mask]:
    """Log-likelihood of specular over diffuse light for each track, and which tracks vote.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``.
    maps : phase maps, built for either kind of light.
    """
    votes, voting = [], []
    for some in in_tiles(tracks, len(maps), max_rows):
        found, matched = observe(AngleModel.PPA, some, maps, NormalOptions())
        specular, diffuse = (solve_mixture(found, matched, prior_specular=p) for p in (1.0, 0.0))
        votes.append(specular.log_likelihood - diffuse.log_likelihood)
        enough = np.maximum(specular.num_rows, diffuse.num_rows) >= TOL.min_rows
        # Under the wrong kind of light the rows often leave no normal at all.
        voting.append((specular.valid | diffuse.valid) & enough)
    return np.concatenate(votes), np.concatenate(voting)


def _parts_of(phase_map: PhaseMap) -> NDArray[np.int32]:
    """Number (H, W) of each pixel's connected part of the region; 0 outside of it."""
    inside = phase_map.region.inside.astype(np.uint8)
    return np.asarray(cv2.connectedComponents(inside, connectivity=4)[1], np.int32)


def _part_votes(phase_map: PhaseMap, points: Array, votes: Array, min_points: int) -> Array:
    """Votes (P,) of each part: those (N,) of the points (N, 3) in it; NaN for too few."""
    labels = _parts_of(phase_map)
    num = int(labels.max(initial=0)) + 1
    xy = phase_map.view.project(points)
    owner = sample_image(labels.astype(np.float32), xy, nearest=True).astype(np.int64)
    total = np.bincount(owner, votes, minlength=num)
    count = np.bincount(owner, minlength=num)
    return np.where(count >= min_points, total, np.nan)


def _pixel_votes(slots: _Slots, maps: Sequence[PhaseMap], max_rows: int) -> list[Array]:
    """Votes (P,) of the pixels of each view's parts; NaN where no view sees enough.

    By the phases of single pixels: averaged over a window, those of a thin thing tell nothing.
    Of many views some are asked, evenly spread; the parts of the others are decided with these.

    Parameters
    ----------
    slots : pixels of all parts.
    maps : of all views, under the assumption of specular light.
    """
    seen_by = evenly_spread(len(maps), TOL.max_pixel_views)
    asked = np.isin(slots.view, seen_by)
    points, owner = slots.points[asked], slots.owner[asked]
    total, sums = np.zeros(slots.num), np.zeros((2, slots.num))
    step = max(1, max_rows // max(len(seen_by), 1))
    for start in range(0, len(owner), step):
        tile, here = points[start : start + step], owner[start : start + step]
        weights = [
            solve_normals(rows.rows, rows.rays, rows.sigma).row_weights
            for rows in gather_rows_under(LIGHTS, AngleModel.PPA, tile, [maps[k] for k in seen_by])
        ]
        compared = (weights[0] > 0) & (weights[1] > 0)
        counts = compared.sum(axis=0) * (compared.sum(axis=0) >= TOL.min_rows)
        total += np.bincount(here, counts, slots.num)
        for which, of_light in enumerate(weights):
            # A robust weight is 1 / (1 + z^2 / c^2): minus its logarithm is a log-likelihood.
            cost = -np.log(np.maximum(of_light, np.exp(-TOL.max_row_cost)))
            weighted = (cost * compared).sum(axis=0) * (counts > 0)
            sums[which] += np.bincount(here, weighted, slots.num)
    mean = np.divide(sums, total, out=np.full((2, slots.num), np.inf), where=total > 0)
    dense = []
    for rows_there, costs_there in zip(slots.by_view(total), slots.by_view(mean), strict=True):
        # Of each part, per kind of light, the least cost of a row at any of the depths.
        least, num_rows = costs_there.min(axis=1), rows_there.max(axis=0)
        known = np.isfinite(least).all(axis=0)
        of_view = np.full(len(num_rows), np.nan)
        of_view[known] = (least[1, known] - least[0, known]) * num_rows[known]
        dense.append(of_view)
    return dense


def _pooled_votes(slots: _Slots, votes: Sequence[Array], maps: Sequence[PhaseMap]) -> list[Array]:
    """Votes (P,) of each part with those of the parts of other views that show the same.

    A part's pixels, as deep in the hull as most views have a part where they fall, pass on the
    votes of what they fall on. A thing of another light beside it keeps its own.

    Parameters
    ----------
    slots : pixels of all parts.
    votes : of each view's parts alone (P,); NaN where unknown.
    """
    placed = np.maximum(np.bincount(slots.owner, minlength=slots.num), 1)
    covered, passed, known = np.zeros(slots.num), np.zeros(slots.num), np.zeros(slots.num)
    for k in evenly_spread(len(maps), TOL.max_pixel_views):
        elsewhere = slots.view != k
        xy = maps[k].view.project(slots.points[elsewhere])
        part = sample_image(_parts_of(maps[k]).astype(np.float32), xy, nearest=True).astype(int)
        there, owner = votes[k][part], slots.owner[elsewhere]
        covered += np.bincount(owner, part > 0, slots.num)
        known += np.bincount(owner, (part > 0) & np.isfinite(there), slots.num)
        given = np.where(part > 0, np.nan_to_num(there), 0)
        passed += np.bincount(owner, given, slots.num) / placed
    pooled = []
    for own, *others in zip(votes, *map(slots.by_view, (covered, passed, known)), strict=True):
        best = others[0].argmax(axis=0)[None]
        passed_on, num_known = (np.take_along_axis(x, best, axis=0)[0] for x in others[1:])
        total = np.nan_to_num(own) + passed_on
        pooled.append(np.where(np.isfinite(own) | (num_known > 0), total, np.nan))
    return pooled


@dataclass(frozen=True)
class _Slots:
    """Some pixels of parts of all views, placed in space at each of several depths in the hull.

    A slot is a part of a view at one of the depths.

    Attributes
    ----------
    points : (N, 3), world.
    owner, view : (N,), the slot and the view of each point.
    num_parts : of each view.
    num_ranges : depths.
    """

    points: Array
    owner: NDArray[np.int64]
    view: NDArray[np.int64]
    num_parts: tuple[int, ...]
    num_ranges: int

    @property
    def num(self) -> int:
        """Slots of all views."""
        return self.num_ranges * sum(self.num_parts)

    def by_view(self, values: Array) -> list[Array]:
        """Values (..., slots) as arrays (..., depths, parts), one for each view."""
        ends = self.num_ranges * np.cumsum(self.num_parts)
        return [
            of_view.reshape(*of_view.shape[:-1], self.num_ranges, num)
            for of_view, num in zip(
                np.split(values, ends[:-1], axis=-1), self.num_parts, strict=True
            )
        ]


def _place_pixels(maps: Sequence[PhaseMap], points: Array) -> _Slots:
    """Place pixels of all parts in the hull of the regions, about where the scene's points lie.

    Parameters
    ----------
    points : (T, 3), world, of the scene.
    """
    chosen = [_choose_pixels(phase_map, points) for phase_map in maps]
    support = [np.zeros((len(one.distances), len(one.rays)), np.int16) for one in chosen]
    for k in evenly_spread(len(maps), TOL.max_pixel_views):
        inside, camera = maps[k].region.inside.astype(np.float32), maps[k].view.camera
        for one, views in zip(chosen, support, strict=True):
            xy = maps[k].view.project(one.places())
            shown = sample_image(inside, xy, nearest=True) > 0
            # What lies outside of an image it says nothing of.
            views += np.where(in_image(camera, xy), np.where(shown, 1, -1), 0).astype(np.int16)
    placed, owner, view = [np.zeros((0, 3))], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    begin = 0
    for index, (one, views) in enumerate(zip(chosen, support, strict=True)):
        most = views == views.max(axis=0, initial=-len(maps))
        first = one.distances[most.argmax(axis=0)]
        last = one.distances[len(most) - 1 - most[::-1].argmax(axis=0)]
        for slot, share in enumerate(np.linspace(0, 1, TOL.num_ranges)):
            placed.append(points_on_rays(one.center, one.rays, first ** (1 - share) * last**share))
            owner.append(begin + slot * one.num_parts + one.part)
            view.append(np.full(len(one.rays), index))
        begin += TOL.num_ranges * one.num_parts
    return _Slots(
        points=np.concatenate(placed),
        owner=np.concatenate(owner),
        view=np.concatenate(view),
        num_parts=tuple(one.num_parts for one in chosen),
        num_ranges=TOL.num_ranges,
    )


@dataclass(frozen=True)
class _ChosenPixels:
    """Some pixels of the parts of one view, and where along their rays they may lie.

    Attributes
    ----------
    center : (3,), world, of the camera.
    rays : (N, 3), world, unit.
    part : (N,), of each pixel.
    num_parts : of the view.
    distances : (S,), that are tried.
    """

    center: Array
    rays: Array
    part: NDArray[np.int64]
    num_parts: int
    distances: Array

    def places(self) -> Array:
        """Points (S, N, 3), world, at all distances of all rays."""
        return points_on_rays(self.center, self.rays, self.distances[:, None])


def _choose_pixels(phase_map: PhaseMap, points: Array) -> _ChosenPixels:
    """Evenly spread pixels of each part, and distances about those of points (T, 3)."""
    labels, reliable = _parts_of(phase_map), phase_map.region.reliable
    view, num_parts = phase_map.view, int(labels.max(initial=0)) + 1
    pixels: list[Floats] = [np.zeros((0, 2))]
    of_part = [np.zeros(0, np.int64)]
    in_cam = view.cam_from_world * points
    ahead = lengths(in_cam[in_cam[:, 2] > 0])
    for part in range(1, num_parts if len(ahead) else 1):
        rows, cols = np.nonzero((labels == part) & reliable)
        step = max(1, len(rows) // TOL.num_pixels)
        pixels.append(np.stack([cols[::step], rows[::step]], axis=-1) + 0.5)
        of_part.append(np.full(len(pixels[-1]), part))
    near, far = np.percentile(ahead, [2, 98]) if len(ahead) else (1.0, 1.0)
    return _ChosenPixels(
        center=view.center_in_world,
        rays=view.rays_in_world(np.concatenate(pixels)),
        part=np.concatenate(of_part),
        num_parts=num_parts,
        distances=np.geomspace(near / TOL.widening, far * TOL.widening, TOL.num_steps),
    )


def _dolp_votes(maps: Sequence[PhaseMap]) -> float:
    """What the highest degrees of polarization of the capture speak for."""
    highest = []
    for phase_map in maps:
        reliable = phase_map.region.reliable
        if reliable.any():
            axial = phase_map.samples[reliable][:, :2]
            highest.append(float(np.percentile(np.linalg.norm(axial, axis=-1), 90)))
    if not highest:
        return 0.0
    excess = (max(highest) - TOL.diffuse_dolp) / TOL.diffuse_dolp
    return float(np.clip(excess, -1, 1) * TOL.dolp_votes)
