"""Contour propagation: from a few seeds to the range of every point of a polarised region.

Contours traced through a view's phase carry a seed's range across the region; normals solved from
the phases of all views carry it sideways, from contour to contour. One robust least-squares
problem per view joins both, so that every node draws on all seeds. Normals need the points' place
in the other views, so the two alternate; they depend on it weakly and few rounds suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.camera import sample_image
from polmvs.config import Contour, Model, PropagationOptions
from polmvs.contour import Contours, cover_with_contours, direction_field
from polmvs.dense import DenseView, store_dense_view
from polmvs.network import (
    Nodes,
    bending_modes,
    connect,
    fill_normals,
    node_edges,
    tie_seeds,
    visible_seeds,
)
from polmvs.normals import solve_normals
from polmvs.parallel import Workers
from polmvs.phasemap import PhaseMap, gather_rows, view_rays
from polmvs.surface import log_range_increment, solve_log_ranges
from polmvs.tracks import Seeds

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.float32]

MIN_CONTOUR_DOLP = 0.05  # smoothed; contours stop under it
MAX_STACKED_VIEWS = 8  # whose contours are traced together


def choose_neighbors(maps: Sequence[PhaseMap], seeds: Seeds, max_neighbors: int) -> list[list[int]]:
    """For each view, itself first, then the views that share most seeds with it."""
    seen = np.array([visible_seeds(m, seeds)[0] for m in maps], float).reshape(len(maps), -1)
    shared = seen @ seen.T
    neighbors = []
    for k in range(len(maps)):
        shared[k, k] = np.inf
        order = np.argsort(-shared[k], kind="stable")
        neighbors.append([int(j) for j in order[: max_neighbors + 1]])
    return neighbors


def propagate(
    model: Model,
    maps: Sequence[PhaseMap],
    seeds: Seeds,
    options: PropagationOptions,
    folder: Path,
    *,
    workers: Workers | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> list[DenseView | None]:
    """Range and normal over the polarised region of every view.

    Parameters
    ----------
    model : OPA or PPA; it decides the rows of the normals and what is constant on a contour.
    maps : phase maps of the posed views.
    seeds : points on the surface.
    folder : for the dense views, which stay on disk; existing files are replaced.
    workers : processes to share the views among; None: this one.
    on_progress : called with the number of views done, ``(num_rounds + 1)`` times per view.

    Returns
    -------
    Per view its dense result, or None where no seed reaches the view's region.
    """
    workers = workers or Workers(1)
    report = on_progress or (lambda count: None)
    neighbors = choose_neighbors(maps, seeds, options.max_neighbors)
    nodes: list[Nodes | None] = []
    for started in workers.map(partial(_start, model, seeds, options), _chunks(maps)):
        nodes += started
        report(len(started))
    dense: list[DenseView | None] = [None] * len(maps)
    for round_index in range(options.num_rounds):
        last = round_index == options.num_rounds - 1
        tasks = [
            _Task(
                maps=[maps[j] for j in near],
                dense=[dense[j] for j in near],
                nodes=nodes[k],
                stride_px=options.stride_px if last else 2 * options.stride_px,
                path=folder / f"{maps[k].view.name}.{round_index}",
            )
            for k, near in enumerate(neighbors)
        ]
        for k, result in enumerate(workers.map(partial(_round, model, seeds, options), tasks)):
            nodes[k], dense[k] = result
            report(1)
    return dense


def _chunks(maps: Sequence[PhaseMap]) -> list[Sequence[PhaseMap]]:
    """Split the views; not by the number of workers, which must not change the result."""
    size = max(min(MAX_STACKED_VIEWS, -(-len(maps) // 2)), 1)
    return [maps[i : i + size] for i in range(0, len(maps), size)]


def _start(
    model: Model, seeds: Seeds, options: PropagationOptions, maps: Sequence[PhaseMap]
) -> list[Nodes | None]:
    """Trace the contours of some views and give each node a first range from the seeds."""
    path_model = Model.OPA if options.contour is Contour.NORMALS else model
    fields, insides, seeds_xy = [], [], []
    top = 0.0
    for phase_map in maps:
        open_pixels = phase_map.region.inside & ~phase_map.region.edges
        dolp = np.hypot(phase_map.samples[..., 0], phase_map.samples[..., 1])
        passable = open_pixels & (dolp > MIN_CONTOUR_DOLP)
        passable[[0, -1]] = False  # the views lie below each other: keep them apart
        fields.append(
            direction_field(path_model, phase_map.samples, view_rays(phase_map.view), passable)
        )
        insides.append(open_pixels)
        visible, xy = visible_seeds(phase_map, seeds)
        seeds_xy.append(xy[visible] + [0.0, top])
        top += phase_map.view.camera.height
    contours = cover_with_contours(
        np.concatenate(fields),
        np.concatenate(seeds_xy),
        np.concatenate(insides),
        spacing_px=options.spacing_px,
        step_px=options.step_px,
    )
    starts = np.cumsum([0] + [m.view.camera.height for m in maps])
    owner = np.searchsorted(starts, contours.xy[:, 1], side="right") - 1
    results = []
    for k, phase_map in enumerate(maps):
        mine = owner == k
        xy = (contours.xy[mine] - [0.0, starts[k]]).astype(np.float32)
        part = Contours(xy, contours.curve[mine], contours.arc_px[mine])
        results.append(_start_view(phase_map, seeds, part, options))
    return results


def _start_view(
    phase_map: PhaseMap, seeds: Seeds, contours: Contours, options: PropagationOptions
) -> Nodes | None:
    """Network of a view's contours with ranges and normals from the nearest seeds."""
    visible, seed_xy = visible_seeds(phase_map, seeds)
    if not visible.any() or not len(contours.xy):
        return None
    rays_in_cam = phase_map.view.camera.rays(contours.xy)
    tail, head, on_contour = connect(contours, phase_map, options.spacing_px)
    distance = np.linalg.norm(
        seeds.points_in_world[visible] - phase_map.view.center_in_world, axis=-1
    )
    nearest = cKDTree(seed_xy[visible]).query(contours.xy)[1]
    return Nodes(
        xy=contours.xy,
        rays_in_world=(rays_in_cam @ phase_map.view.cam_from_world.rotation).astype(np.float32),
        ray_z=rays_in_cam[:, 2].astype(np.float32),
        tail=tail,
        head=head,
        on_contour=on_contour,
        log_range=_interpolate(seed_xy[visible], np.log(distance), contours.xy),
        normals=seeds.normals_in_world[visible][nearest],
        normal_sigma=np.full(len(contours.xy), np.nan),
    )


@dataclass(frozen=True)
class _Task:
    """One view in one round: its own map first, then its neighbours'."""

    maps: list[PhaseMap]
    dense: list[DenseView | None]
    nodes: Nodes | None
    stride_px: int
    path: Path


def _round(
    model: Model, seeds: Seeds, options: PropagationOptions, task: _Task
) -> tuple[Nodes | None, DenseView | None]:
    """Normals and ranges of one view's nodes, and the dense view that they make."""
    if task.nodes is None:
        return None, None
    range_maps = [d.range_map if d is not None else None for d in task.dense]
    nodes = _update(model, task.maps[0], task.maps, range_maps, task.nodes, seeds, options)
    dense = _densify(task.maps[0], nodes, task.stride_px, 2 * options.spacing_px)
    return nodes, store_dense_view(dense, task.path) if dense is not None else None


def _interpolate(known_xy: Floats, values: Array, xy: Floats, num_nearest: int = 5) -> Array:
    """Median of the nearest known values: a rough start that one wrong seed does not spoil."""
    nearest = min(num_nearest, len(known_xy))
    indices = cKDTree(known_xy).query(xy, k=nearest)[1].reshape(len(xy), nearest)
    return np.asarray(np.median(values[indices], axis=1), np.float64)


def _update(
    model: Model,
    phase_map: PhaseMap,
    used_maps: Sequence[PhaseMap],
    range_maps: Sequence[Image | None],
    nodes: Nodes,
    seeds: Seeds,
    options: PropagationOptions,
) -> Nodes:
    """One round: normals at the nodes from all views, then ranges from normals and seeds."""
    center = phase_map.view.center_in_world
    points = center + np.exp(nodes.log_range)[:, None] * nodes.rays_in_world
    known = np.isfinite(nodes.log_range)
    points[~known] = center  # projects nowhere: no rows
    rows = gather_rows(model, points, used_maps, range_maps)
    estimate = solve_normals(rows.rows, rows.rays, rows.sigma, initial_normals=nodes.normals.T)
    normals, sigma = fill_normals(nodes, estimate)
    own_sigma = rows.sigma[0]
    edges = node_edges(model, nodes, normals, sigma, own_sigma, options)
    ties, num_seeds = tie_seeds(phase_map, nodes, normals, seeds)
    solution = solve_log_ranges(
        len(nodes.xy),
        edges,
        ties,
        num_seeds,
        modes=bending_modes(nodes.xy) if options.bending > 0 else None,
        mode_sigma=options.bending,
    )
    return replace(nodes, log_range=solution.log_range, normals=normals, normal_sigma=sigma)


def _densify(phase_map: PhaseMap, nodes: Nodes, stride: int, max_gap_px: float) -> DenseView | None:
    """Ranges and normals on the lattice of the region, from the planes of the nearest nodes."""
    good = np.isfinite(nodes.log_range) & np.isfinite(nodes.normals).all(axis=-1)
    if not good.any():
        return None
    camera = phase_map.view.camera
    height, width = camera.height // stride, camera.width // stride
    grid = (np.stack(np.meshgrid(np.arange(width), np.arange(height)), -1) + 0.5) * stride
    open_pixels = (phase_map.region.inside & ~phase_map.region.edges).astype(np.float32)
    wanted = sample_image(open_pixels, grid, nearest=True) > 0
    xy = grid[wanted]
    k = min(4, int(good.sum()))
    gap, index = cKDTree(nodes.xy[good]).query(xy, k=k, distance_upper_bound=max_gap_px)
    gap, index = gap.reshape(-1, k), index.reshape(-1, k)
    found = np.isfinite(gap)
    index = np.where(found, index, 0)
    rays = camera.rays(xy) @ phase_map.view.cam_from_world.rotation
    normals = nodes.normals[good][index]
    step = log_range_increment(normals, nodes.rays_in_world[good][index], rays[:, None])
    weight = np.where(found, 1 / (1 + gap**2), 0)
    total = weight.sum(axis=1)
    has = total > 0
    weight = weight / np.maximum(total, 1e-12)[:, None]
    log_range = (weight * (nodes.log_range[good][index] + step)).sum(axis=1)
    normal = (weight[..., None] * normals).sum(axis=1)
    normal /= np.maximum(np.linalg.norm(normal, axis=-1, keepdims=True), 1e-12)
    range_map = np.zeros((height, width), np.float32)
    range_map[wanted] = np.where(has, np.exp(log_range), 0)
    normal_map = np.full((height, width, 3), np.nan, np.float32)
    normal_map[wanted] = np.where(has[:, None], normal, np.nan)
    sigma_map = np.full((height, width), np.nan, np.float32)
    sigma_map[wanted] = np.degrees((weight * nodes.normal_sigma[good][index]).sum(axis=1))
    return DenseView(stride, range_map, normal_map, sigma_map)
