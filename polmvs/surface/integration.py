"""Integration: range and normal of every pixel of a polarised region, coarse to fine.

Each view's lattice is one sparse least-squares problem for the logarithm of its ranges: normals
from the phases of all views say how it changes from pixel to pixel, seeds where it lies, and what
the other views see, of the round before, ties the views to one surface. Where a view sees the
surface at a grazing angle, a small error of its normals is a large one of its ranges; others see
the same place better. Views depend on each other through the round before only.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.config import AngleModel, PropagationOptions
from polmvs.parallel import Workers
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import Seeds
from polmvs.surface.consensus import surface_of_others
from polmvs.surface.dense_view import (
    DenseView,
    SurfaceSamples,
    dense_view,
    extend_planes,
    lattice_points,
    store_dense_view,
    view_samples,
)
from polmvs.surface.pixel_graph import Nodes, uncrossed
from polmvs.surface.relaxation import open_lattice, relax, surface_at_seeds
from polmvs.surface.view_selection import choose_neighbors

Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

REFINEMENTS = (4, 2, 1)  # strides of the coarsest lattice and those that follow, of the last one's
MAX_GAP_STRIDES = 2.0  # from a point of the coarser lattice to those made of it


def integrate(
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
    model : decides the rows of the normals.
    maps : phase maps of the posed views.
    seeds : points on the surface.
    folder : for the dense views, which stay on disk; existing files are replaced.
    tilt_aware : of the rows' weights, see :func:`polmvs.normals.rows.gather_rows`.
    workers : processes to share the views among; None: this one.
    on_progress : called with the number of views done, once per view and round.

    Returns
    -------
    Per view its dense result, or None where neither a seed nor another view reaches it.
    """
    workers = workers or Workers(1)
    neighbors = choose_neighbors(maps, seeds, options.max_neighbors)
    folder.mkdir(parents=True, exist_ok=True)
    dense: list[DenseView | None] = [None] * len(maps)
    for index, plan in enumerate(plan_rounds(options)):
        tasks = [
            _Task(
                maps=[maps[j] for j in near],
                dense=[dense[j] for j in near],
                plan=plan,
                path=folder / f"{maps[k].view.name}.{index}",
            )
            for k, near in enumerate(neighbors)
        ]
        dense = []
        solve = partial(_round, model, seeds, options.bending, tilt_aware)
        for result in workers.map(solve, tasks):
            dense.append(result)
            if on_progress is not None:
                on_progress(1)
    return dense


@dataclass(frozen=True)
class RoundPlan:
    """One round: its lattice, and whether the other views' surfaces tie the view's own."""

    stride_px: int
    use_opinions: bool


def plan_rounds(options: PropagationOptions) -> list[RoundPlan]:
    """``num_rounds`` on the coarsest lattice, the last with opinions; then one for each finer one.

    The first ranges come from a few seeds and are wrong by centimetres on a curved part. Each view
    mends its own fast; the opinions of others would hold it back.
    """
    coarse, *finer = [options.stride_px * factor for factor in REFINEMENTS]
    alone = [RoundPlan(coarse, False)] * (options.num_rounds - 1)
    return [*alone, RoundPlan(coarse, True), *(RoundPlan(stride, True) for stride in finer)]


@dataclass(frozen=True)
class _Task:
    """One view in one round: its own map and last result first, then its neighbours'."""

    maps: list[PhaseMap]
    dense: list[DenseView | None]
    plan: RoundPlan
    path: Path


def _round(
    model: AngleModel, seeds: Seeds, bending: float, tilt_aware: bool, task: _Task
) -> DenseView | None:
    """One view's result on its lattice."""
    stride_px = task.plan.stride_px
    wanted = open_lattice(task.maps[0], stride_px)
    surface = _start(task, seeds, wanted)
    if surface is None:
        return None
    nodes = relax(
        model,
        task.maps,
        task.dense,
        _lattice_nodes(task.maps[0], surface, wanted, stride_px),
        seeds,
        bending=bending,
        tilt_aware=tilt_aware,
        use_opinions=task.plan.use_opinions,
    )
    dense = dense_view(nodes.surface, wanted, stride_px)
    return store_dense_view(dense, task.path) if dense.known.any() else None


def _start(task: _Task, seeds: Seeds, wanted: Mask) -> SurfaceSamples | None:
    """The lattice's surface: of the view's last result; else of the seeds, or of the others."""
    phase_map, before = task.maps[0], task.dense[0]
    xy = lattice_points(wanted, task.plan.stride_px)
    if before is None:
        surface = surface_at_seeds(phase_map, seeds, xy)
        return surface or surface_of_others(task.maps, task.dense, xy, MAX_GAP_STRIDES)
    camera, rotation = phase_map.view.camera, phase_map.view.cam_from_world.rotation
    coarse = view_samples(before, camera.rays(before.lattice_xy()) @ rotation)
    return extend_planes(coarse, xy, camera.rays(xy) @ rotation, MAX_GAP_STRIDES * before.stride_px)


def _lattice_nodes(
    phase_map: PhaseMap, surface: SurfaceSamples, wanted: Mask, stride_px: int
) -> Nodes:
    """The lattice's points, joined to their neighbours in rows and columns."""
    index = np.full(wanted.shape, -1)
    index[wanted] = np.arange(len(surface.xy))
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    tail = np.concatenate([a[(a >= 0) & (b >= 0)] for a, b in pairs])
    head = np.concatenate([b[(a >= 0) & (b >= 0)] for a, b in pairs])
    clear = uncrossed(phase_map, surface.xy[tail], surface.xy[head])
    return Nodes(
        surface=surface,
        ray_z=phase_map.view.camera.rays(surface.xy)[:, 2],
        spacing_px=float(stride_px),
        tail=tail[clear],
        head=head[clear],
        on_contour=np.zeros(len(tail[clear]), np.bool_),
    )
