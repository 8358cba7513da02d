"""Specular or diffuse: which reflection dominates the polarisation of each part of a region.

The two differ by a quarter turn of the phase, so the wrong choice puts every plane of incidence
at a right angle to the true one. One view cannot tell; three or more can, because wrong planes of
incidence do not meet in one normal. Every sparse point on a part votes with the likelihoods of
its two best normals. Where a part has too few of them its pixels vote the same way, placed as far
off as explains their phases best, for either kind of light: normals hardly depend on that. The
degree of polarisation has a say where phases have none (specular light is polarised up to wholly,
diffuse light of a smooth dielectric hardly over 0.4).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.config import AngleModel, NormalOptions
from polmvs.normals.estimator import NormalEstimate, solve_normals
from polmvs.normals.rows import gather_rows
from polmvs.normals.tracks import inside_shares, normals_from_windows, window_map
from polmvs.polarization.phase_map import PhaseMap, turned
from polmvs.scene import Tracks, some_tracks

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class LightTolerances:
    """What the choice between specular and diffuse light depends on.

    Attributes
    ----------
    min_rows : of a point that votes, and points of a part that decide for it. Derived: two planes
        of incidence always meet in a normal.
    max_row_cost : of one row, so that a single one cannot outvote the others. Guess.
    diffuse_dolp : largest DoLP of diffuse light. Derived: smooth dielectric of ior 1.5, seen at a
        grazing angle.
    dolp_votes : log-likelihood that twice that DoLP is worth. Guess.
    num_pixels : of a part that vote where it has no points. Guess; costs time only.
    num_ranges : distances that these are tried at. Guess; normals hardly depend on them.
    widening : of the distances beyond those of the scene's points, factor. Guess.
    """

    min_rows: int = 3
    max_row_cost: float = 4.0
    diffuse_dolp: float = 0.4
    dolp_votes: float = 20.0
    num_pixels: int = 64
    num_ranges: int = 7
    widening: float = 1.3


def find_diffuse(
    tracks: Tracks, maps: Sequence[PhaseMap], tolerances: LightTolerances | None = None
) -> list[Mask]:
    """Pixels of each view whose light is diffuse-dominant.

    Every connected part of a view's region is decided as a whole: by the points that project into
    it, else by its own pixels, else with the majority of the capture.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``.
    maps : phase maps built under the assumption of specular light.
    tolerances : see there.

    Returns
    -------
    One ``(H, W)`` bool mask for each map.
    """
    t = tolerances or LightTolerances()
    options = NormalOptions()
    on_parts = some_tracks(tracks, inside_shares(tracks, maps, margin_px=1) > 0)
    windows = [window_map(phase_map, options.window_px) for phase_map in maps]
    opposite = [turned(m, np.ones(m.region.inside.shape, bool)) for m in windows]
    specular = normals_from_windows(AngleModel.PPA, on_parts, windows, options.estimator)
    diffuse = normals_from_windows(AngleModel.PPA, on_parts, opposite, options.estimator)
    votes, voting = specular_votes(specular, diffuse, t)
    parts = [
        _find_parts(m, on_parts.points_in_world[voting], votes[voting], t.min_rows) for m in maps
    ]
    overall = float(votes[voting].sum()) + _dolp_votes(maps, t)
    for k, found in enumerate(parts):
        dense = _pixel_votes(found, k, windows, opposite, tracks.points_in_world, t)
        undecided = ~np.isfinite(found.votes)
        found.votes[undecided] = dense[undecided]
        overall += float(np.nansum(dense[undecided]))
    # Without any evidence light is specular: what polarises most.
    tie = overall if overall != 0 else 1.0
    masks = []
    for phase_map, found in zip(maps, parts, strict=True):
        verdict = np.where(np.isfinite(found.votes), found.votes, overall)
        verdict = np.where(verdict == 0, tie, verdict)
        masks.append(np.asarray((verdict < 0)[found.labels] & phase_map.region.inside))
    return masks


@dataclass(frozen=True)
class _Parts:
    """Connected parts of a view's region.

    Attributes
    ----------
    labels : (H, W), number of each pixel's part; 0 outside of the region.
    votes : (P,), log-likelihood of specular over diffuse light; NaN where nothing has voted.
    """

    labels: NDArray[np.int32]
    votes: Array


def _find_parts(phase_map: PhaseMap, points: Array, votes: Array, min_points: int) -> _Parts:
    """Parts with the votes (N,) of the points (N, 3) that project into them; NaN for too few."""
    inside = phase_map.region.inside
    num, labels = cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)
    xy = phase_map.view.project(points)
    owner = sample_image(labels.astype(np.float32), xy, nearest=True).astype(np.int64)
    total = np.bincount(owner, votes, minlength=num)
    count = np.bincount(owner, minlength=num)
    return _Parts(np.asarray(labels, np.int32), np.where(count >= min_points, total, np.nan))


def _pixel_votes(
    parts: _Parts,
    k: int,
    windows: Sequence[PhaseMap],
    opposite: Sequence[PhaseMap],
    points: Array,
    t: LightTolerances,
) -> Array:
    """Votes (P,) of the pixels of view k's undecided parts; NaN where no view sees enough.

    Parameters
    ----------
    windows, opposite : averaged maps of all views under specular and diffuse light.
    points : (T, 3), of the scene, which say how far off a part may be.
    """
    votes = np.full(len(parts.votes), np.nan)
    phase_map = windows[k]
    view, center = phase_map.view, phase_map.view.center_in_world
    undecided = [int(i) for i in np.flatnonzero(~np.isfinite(parts.votes)) if i > 0]
    in_cam = view.cam_from_world * points
    ahead = in_cam[in_cam[:, 2] > 0]
    if not undecided or not len(ahead):
        return votes
    pixels, owners = [], []
    for index in undecided:
        rows, cols = np.nonzero((parts.labels == index) & phase_map.region.reliable)
        step = max(1, len(rows) // t.num_pixels)
        pixels.append(np.stack([cols[::step], rows[::step]], axis=-1) + 0.5)
        owners.append(np.full(len(pixels[-1]), index))
    owner, num = np.concatenate(owners), len(votes)
    rays = view.rays_in_world(np.concatenate(pixels))
    distances = np.linalg.norm(ahead, axis=-1)
    nearest, farthest = np.percentile(distances, [2, 98]) * [1 / t.widening, t.widening]
    # Of each part, per kind of light, the least cost of a row at any of the distances.
    least, rows_there = np.full((2, num), np.inf), np.zeros(num)
    for distance in np.geomspace(nearest, farthest, t.num_ranges):
        placed = center + distance * rays
        specular, diffuse = (
            solve_normals(rows.rows, rows.rays, rows.sigma)
            for rows in (gather_rows(AngleModel.PPA, placed, maps) for maps in (windows, opposite))
        )
        costs, compared = _row_costs(specular, diffuse, t.max_row_cost)
        counts = compared.sum(axis=0) * (compared.sum(axis=0) >= t.min_rows)
        total = np.bincount(owner, counts, num)
        for which, cost in enumerate(costs):
            sums = np.bincount(owner, (cost * compared).sum(axis=0) * (counts > 0), num)
            mean = np.divide(sums, total, out=np.full(num, np.inf), where=total > 0)
            least[which] = np.minimum(least[which], mean)
        rows_there = np.maximum(rows_there, total)
    known = np.isfinite(least).all(axis=0)
    votes[known] = (least[1, known] - least[0, known]) * rows_there[known]
    return votes


def _row_costs(
    specular: NormalEstimate, diffuse: NormalEstimate, max_cost: float
) -> tuple[list[Floats], Mask]:
    """Cauchy costs (K, N) of the rows under either light, and which rows count under both.

    The robust weight is ``1 / (1 + z^2 / c^2)``: minus its logarithm is the row's cost.
    """
    costs = [
        np.minimum(-np.log(np.maximum(e.row_weights, 1e-6)), max_cost) for e in (specular, diffuse)
    ]
    return costs, np.asarray((specular.row_weights > 0) & (diffuse.row_weights > 0))


def specular_votes(
    specular: NormalEstimate, diffuse: NormalEstimate, tolerances: LightTolerances | None = None
) -> tuple[Array, Mask]:
    """Log-likelihood of specular over diffuse light for each track, and which tracks have a say.

    Parameters
    ----------
    specular, diffuse : normals of the same tracks from rows under either assumption.
    tolerances : see there.
    """
    t = tolerances or LightTolerances()
    costs, compared = _row_costs(specular, diffuse, t.max_row_cost)
    votes = ((costs[1] - costs[0]) * compared).sum(axis=0)
    enough = np.maximum(specular.num_rows, diffuse.num_rows) >= t.min_rows
    # Under the wrong kind of light the rows often leave no normal at all.
    return np.asarray(votes, np.float64), (specular.valid | diffuse.valid) & enough


def _dolp_votes(maps: Sequence[PhaseMap], t: LightTolerances) -> float:
    """What the highest degrees of polarisation of the capture speak for."""
    highest = []
    for phase_map in maps:
        reliable = phase_map.region.reliable
        if reliable.any():
            axial = phase_map.samples[reliable][:, :2]
            highest.append(float(np.percentile(np.linalg.norm(axial, axis=-1), 90)))
    if not highest:
        return 0.0
    excess = (max(highest) - t.diffuse_dolp) / t.diffuse_dolp
    return float(np.clip(excess, -1, 1) * t.dolp_votes)
