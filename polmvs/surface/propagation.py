"""Contour propagation: from a few seeds to the range of every point of a polarised region.

Contours traced through a view's phase carry a seed's range across the region; normals solved from
the phases of all views carry it sideways, from contour to contour. One robust least-squares
problem per view joins both, so that every node draws on all seeds. Normals need the points' place
in the other views, so the two alternate; they depend on it weakly and few rounds suffice.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.config import AngleModel, Contour, PropagationOptions
from polmvs.parallel import Workers
from polmvs.polarization.phase_map import PhaseMap, view_rays
from polmvs.scene import Seeds
from polmvs.surface.contour import Contours, cover_with_contours, direction_field
from polmvs.surface.dense_view import DenseView, store_dense_view
from polmvs.surface.pixel_graph import Nodes, connect, visible_seeds
from polmvs.surface.relaxation import relax, spread_nodes, surface_at_seeds
from polmvs.surface.view_selection import choose_neighbors

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.float32]

MIN_CONTOUR_DOLP = 0.05  # smoothed; contours stop under it
MAX_STACKED_VIEWS = 8  # whose contours are traced together


def propagate(
    model: AngleModel,
    maps: Sequence[PhaseMap],
    seeds: Seeds,
    options: PropagationOptions,
    folder: Path,
    *,
    tilt_aware: bool = True,
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
    tilt_aware : of the rows' weights, see :func:`polmvs.normals.rows.gather_rows`.
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
    folder.mkdir(parents=True, exist_ok=True)
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
        solve = partial(_round, model, seeds, options, tilt_aware)
        for k, result in enumerate(workers.map(solve, tasks)):
            nodes[k], dense[k] = result
            report(1)
    return dense


def _chunks(maps: Sequence[PhaseMap]) -> list[Sequence[PhaseMap]]:
    """Split the views; not by the number of workers, which must not change the result."""
    size = max(min(MAX_STACKED_VIEWS, -(-len(maps) // 2)), 1)
    return [maps[i : i + size] for i in range(0, len(maps), size)]


def _start(
    model: AngleModel, seeds: Seeds, options: PropagationOptions, maps: Sequence[PhaseMap]
) -> list[Nodes | None]:
    """Trace the contours of some views and give each node a first range from the seeds."""
    path_model = AngleModel.OPA if options.contour is Contour.NORMALS else model
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
    surface = surface_at_seeds(phase_map, seeds, contours.xy)
    if surface is None:
        return None
    tail, head, on_contour = connect(contours, phase_map, options.spacing_px)
    return Nodes(
        surface=surface,
        ray_z=phase_map.view.camera.rays(contours.xy)[:, 2],
        spacing_px=options.spacing_px,
        tail=tail,
        head=head,
        on_contour=on_contour,
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
    model: AngleModel, seeds: Seeds, options: PropagationOptions, tilt_aware: bool, task: _Task
) -> tuple[Nodes | None, DenseView | None]:
    """Normals and ranges of one view's nodes, and the dense view that they make."""
    if task.nodes is None:
        return None, None
    nodes = relax(
        model,
        task.maps,
        task.dense,
        task.nodes,
        seeds,
        bending=options.bending,
        tilt_aware=tilt_aware,
        along_contours=options.contour is Contour.TANGENT,
    )
    dense = spread_nodes(task.maps[0], nodes.surface, task.stride_px, 2 * options.spacing_px)
    return nodes, store_dense_view(dense, task.path) if dense is not None else None
