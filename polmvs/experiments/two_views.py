"""Contours with normals from two views, in the paper's way: the distance stepped along 2D paths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from polmvs.config import AngleModel
from polmvs.normals.estimator import solve_normals
from polmvs.normals.rows import gather_rows
from polmvs.polarization.phase_map import PhaseMap
from polmvs.surface.contour import Contours
from polmvs.surface.log_range import log_range_increment

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Indices = NDArray[np.int64]

MIN_SEEN_SHARE = 0.9  # of the seeds, that a second view must see


def second_view(maps: Sequence[PhaseMap], index: int, seeds: Array) -> int | None:
    """The view whose rows cross those of another at the largest angle, seen from its seeds.

    Parameters
    ----------
    maps : phase maps of all views.
    index : of the first view.
    seeds : (S, 3), world.

    Returns
    -------
    Among the views that have rows for at least 90 % of the seeds (or, failing that, the most)
    the one with the largest median angle; None without seeds or a second view.
    """
    if len(seeds) == 0 or len(maps) < 2:
        return None
    rows = gather_rows(AngleModel.PPA, seeds, maps)
    sine = np.linalg.norm(np.cross(rows.rows, rows.rows[:, index : index + 1], axis=0), axis=0)
    sine = np.where(np.isfinite(rows.sigma) & np.isfinite(sine), sine, np.nan)
    sine[index] = np.nan
    seen = np.isfinite(sine).sum(axis=1)
    if seen.max() == 0:
        return None
    eligible = seen >= min(MIN_SEEN_SHARE * len(seeds), seen.max())
    medians = [np.nanmedian(s) if ok else -1.0 for s, ok in zip(sine, eligible, strict=True)]
    return int(np.argmax(medians))


def step_with_normals(
    maps: Sequence[PhaseMap],
    range_maps: Sequence[Image | None],
    paths: Contours,
    seed_range: Floats,
) -> Array:
    """Distances along 2D paths, with the normal of two views at every place reached.

    Parameters
    ----------
    maps : of the view of the paths, and of the second view.
    range_maps : of the same views, by which occluded rows are told; see
        :func:`polmvs.polarization.phase_map.gather_rows`.
    paths : nodes of each curve ordered by their arc, seeds at arc 0; ``curve`` counts in seeds.
    seed_range : (S,), distance of each seed from the camera centre.

    Returns
    -------
    (N,), NaN from where on the second view has no row, or the two rows give no normal.
    """
    nodes = _halves(paths)
    view = maps[0].view
    rays = view.camera.rays(paths.xy)
    result = np.full(len(paths.xy), np.nan)
    if nodes.shape[1] == 0:
        return result
    seeds = nodes[:, 0]
    ranges = np.asarray(seed_range, np.float64)[paths.curve[seeds]]
    result[seeds] = ranges
    active = np.arange(len(nodes))
    for here, there in zip(nodes.T[:-1], nodes.T[1:], strict=True):
        active = active[there[active] >= 0]
        tail, head = rays[here[active]], rays[there[active]]
        normals = _normals(maps, range_maps, tail * ranges[active, None])
        known = np.isfinite(normals).all(axis=1)
        active = active[known]
        if len(active) == 0:
            break
        ranges[active] *= np.exp(log_range_increment(normals[known], tail[known], head[known]))
        result[there[active]] = ranges[active]
    return result


def _halves(paths: Contours) -> Indices:
    """Nodes (2 S, L) of both halves of every curve from its seed outwards, -1 after its end."""
    halves = []
    for curve in np.unique(paths.curve):
        nodes = np.flatnonzero(paths.curve == curve)
        arc = paths.arc_px[nodes]
        halves.append(nodes[arc >= 0])
        halves.append(nodes[arc <= 0][::-1])
    length = max((len(half) for half in halves), default=0)
    result = np.full((len(halves), length), -1, np.int64)
    for row, half in zip(result, halves, strict=True):
        row[: len(half)] = half
    return result


def _normals(
    maps: Sequence[PhaseMap], range_maps: Sequence[Image | None], points_in_cam: Array
) -> Array:
    """Normals (N, 3) in the frame of the first view, NaN where the views do not give one."""
    first = maps[0].view.cam_from_world
    rows = gather_rows(AngleModel.PPA, first.inverse() * points_in_cam, maps, range_maps)
    estimate = solve_normals(rows.rows, rows.rays, rows.sigma, robust=False)
    return np.asarray(estimate.normals @ first.rotation.T, np.float64)
