"""Contours of phase, which carry ranges over a polarized region, as in the paper.

A row ``m`` is a tangent of the surface. Under PPA it is perpendicular to the ray, so a point moved
along it keeps its distance to the camera centre: the contour is an iso-range curve. Under OPA it
has no z component and the contour is an iso-depth curve (Cui et al. 2017). Both need one view
and no normal. The curves are traced in the image; the constant quantity is applied afterwards, so
it does not drift.

Contours traced through a view's phase carry a seed's range across the region; normals solved from
the phases of all views carry it sideways, from contour to contour. One robust least-squares
problem per view combines both, so every node uses all seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.camera import sample_image
from polmvs.config import Contour, PropagationOptions
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.polarization.angle_models import rows_from_axial
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap, view_rays
from polmvs.scene import Seeds
from polmvs.surface.dense_view import DenseView, store_dense_view
from polmvs.surface.integration import (
    RoundPlan,
    ViewTask,
    in_rounds,
    relax,
    spread_nodes,
    surface_at_seeds,
)
from polmvs.surface.pixel_graph import Nodes, uncrossed, visible_seeds
from polmvs.surface.view_selection import choose_neighbors

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.float32]


Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class ContourTolerances:
    """Tolerances of the tracing of contours, and of their connections.

    Attributes
    ----------
    num_neighbors : number of neighbours to which a node is connected. Guess.
    min_dolp : smoothed; contours stop below it. Guess; without it F at 1 mm of OPA on the bundled
        capture is 33.0 and not 35.4 %.
    min_coherence : of neighbouring directions: a contour stops in an incoherent field.
        Derived: cosine of half a right angle.
    meeting_px : distance at which the two halves of a closed curve end. Guess.
    """

    num_neighbors: int = 6
    min_dolp: float = 0.05
    min_coherence: float = 0.7
    meeting_px: float = 2.0


TOL = ContourTolerances()


def propagate(
    angle_model: AngleModel,
    maps: Sequence[PhaseMap],
    seeds: Seeds,
    options: PropagationOptions,
    folder: Path,
    *,
    tilt_aware: bool = True,
    workers: Workers | None = None,
    on_progress: OnProgress = no_progress,
) -> list[DenseView | None]:
    """Range and normal over the polarized region of every view.

    Parameters
    ----------
    angle_model : OPA or PPA; it sets the rows of the normals and the constant of a contour.
    maps : phase maps of the posed views.
    seeds : points on the surface.
    folder : for the dense views, which stay on disk; existing files are replaced.
    tilt_aware : of the rows' weights, see :func:`polmvs.normals.rows.gather_rows`.
    workers : processes for the views; None: this process.
    on_progress : called with the number of views done, ``(num_rounds + 1)`` times per view.

    Returns
    -------
    Dense result of each view, or None if no seed reaches its region.
    """
    workers = workers or Workers(1)
    nodes: list[Nodes | None] = []
    start = partial(_start, angle_model, seeds, options)
    for started in workers.map(start, maps):
        nodes.append(started)
        on_progress(1)
    strides = [2 * options.stride_px] * (options.num_rounds - 1) + [options.stride_px]
    plans = [RoundPlan(stride_px, use_consensus=False) for stride_px in strides]
    neighbors = choose_neighbors(maps, seeds, options.max_neighbors)
    solve = partial(_round, angle_model, seeds, options, tilt_aware)
    return in_rounds(solve, plans, maps, neighbors, folder, workers, on_progress, nodes)


def _connect(
    contours: Contours, phase_map: PhaseMap, spacing_px: float
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Edges between consecutive nodes of a curve and between neighbouring nodes of all curves."""
    xy = contours.xy
    num = len(xy)
    follows = contours.curve[1:] == contours.curve[:-1]
    along = np.stack([np.flatnonzero(follows), np.flatnonzero(follows) + 1], axis=1)
    k = min(TOL.num_neighbors + 1, num)
    distance, index = cKDTree(xy).query(xy, k=k, distance_upper_bound=2.2 * spacing_px)
    tails = np.repeat(np.arange(num), k)
    heads, near = index.reshape(-1), distance.reshape(-1)
    cross = (heads < num) & (heads != tails) & (near > 0)
    pairs = np.unique(np.sort(np.stack([tails[cross], heads[cross]], axis=1), axis=1), axis=0)
    is_along = np.isin(pairs[:, 0] * num + pairs[:, 1], along[:, 0] * num + along[:, 1])
    pairs = np.concatenate([along, pairs[~is_along]])
    on_contour = np.arange(len(pairs)) < len(along)
    clear = uncrossed(phase_map, xy[pairs[:, 0]], xy[pairs[:, 1]])
    return pairs[clear, 0], pairs[clear, 1], on_contour[clear]


def _start(
    angle_model: AngleModel,
    seeds: Seeds,
    options: PropagationOptions,
    phase_map: PhaseMap,
) -> Nodes | None:
    """Network of a view's contours with ranges and normals from the nearest seeds."""
    path_model = AngleModel.OPA if options.contour is Contour.NORMALS else angle_model
    open_pixels = phase_map.region.inside & ~phase_map.region.edges
    dolp = np.hypot(phase_map.samples[..., 0], phase_map.samples[..., 1])
    passable = open_pixels & (dolp > TOL.min_dolp)
    rays = view_rays(phase_map.view)
    visible, seeds_xy = visible_seeds(phase_map, seeds)
    contours = cover_with_contours(
        direction_field(path_model, phase_map.samples, rays, passable),
        seeds_xy[visible],
        open_pixels,
        spacing_px=options.spacing_px,
        step_px=options.step_px,
    )
    surface = surface_at_seeds(phase_map, seeds, contours.xy)
    if surface is None:
        return None
    tail, head, on_contour = _connect(contours, phase_map, options.spacing_px)
    return Nodes(
        surface=surface,
        ray_z=phase_map.view.camera.rays(contours.xy)[:, 2],
        spacing_px=options.spacing_px,
        focal_px=phase_map.view.camera.mean_focal_px,
        tail=tail,
        head=head,
        on_contour=on_contour,
    )


def _round(
    angle_model: AngleModel,
    seeds: Seeds,
    options: PropagationOptions,
    tilt_aware: bool,
    task: ViewTask,
) -> tuple[Nodes | None, DenseView | None]:
    """Normals and ranges of one view's nodes, and the dense view that they make."""
    if task.nodes is None:
        return None, None
    nodes = relax(
        angle_model,
        task.maps,
        task.dense,
        task.nodes,
        seeds,
        bending=options.bending,
        tilt_aware=tilt_aware,
        along_contours=options.contour is Contour.TANGENT,
    )
    dense = spread_nodes(task.maps[0], nodes, task.plan.stride_px)
    return nodes, store_dense_view(dense, task.path) if dense is not None else None


@dataclass(frozen=True)
class Contours:
    """Traced curves as one list of nodes.

    Attributes
    ----------
    xy : (N, 2) float32, image coordinates.
    curve : (N,) int, index of the curve a node belongs to.
    arc_px : (N,) float32, signed length from the curve's seed; nodes of a curve are ordered by it.
    """

    xy: NDArray[np.float32]
    curve: NDArray[np.int64]
    arc_px: NDArray[np.float32]


def direction_field(angle_model: AngleModel, samples: Image, rays: Image, passable: Mask) -> Image:
    """Direction of the contour at every pixel, as an axial image that can be interpolated.

    Parameters
    ----------
    angle_model : OPA or PPA.
    samples : (H, W, 3), phase map samples.
    rays : (H, W, 3), unit rays of the pixels; their derivatives carry any camera model.
    passable : (H, W) bool, pixels on which a contour may run.

    Returns
    -------
    (H, W, 2) float32: cos and sin of twice the direction's angle in the image (x right, y
    down); 0 where not passable.
    """
    row = rows_from_axial(angle_model, samples[..., 0], samples[..., 1], rays)
    along = row - (row * rays).sum(axis=-1, keepdims=True) * rays  # the ray's own motion
    ray_dy, ray_dx = np.gradient(rays, axis=(0, 1))
    # Solve [ray_dx ray_dy] e = along in the plane perpendicular to the ray.
    xx, yy = (ray_dx**2).sum(-1), (ray_dy**2).sum(-1)
    xy = (ray_dx * ray_dy).sum(-1)
    bx, by = (ray_dx * along).sum(-1), (ray_dy * along).sum(-1)
    ex, ey = yy * bx - xy * by, xx * by - xy * bx
    square = ex * ex + ey * ey
    with np.errstate(divide="ignore", invalid="ignore"):
        axial = np.stack([(ex * ex - ey * ey) / square, 2 * ex * ey / square], axis=-1)
    axial[~(passable & np.isfinite(axial).all(axis=-1))] = 0
    return np.asarray(axial, np.float32)


def trace_contours(
    field: Image,
    seeds_xy: Floats,
    *,
    step_px: float,
    keep_every: int = 1,
    claims: NDArray[np.int32] | None = None,
    first_curve: int = 0,
) -> Contours:
    """Trace contours both ways from all seeds in lock step (midpoint rule).

    A contour ends where the field ends (region edge, crease, weak polarization, clipped pixels),
    where neighbouring directions disagree, or where it closes. A contour without an end is cut
    where each half is as long as the image's border.

    Parameters
    ----------
    field : (H, W, 2), from :func:`direction_field`.
    seeds_xy : (S, 2), image coordinates.
    step_px : step length, px.
    keep_every : number of steps between kept nodes.
    claims : cells of the image, each owned by the first curve that entered it (-1: free), over
        the extent of the field; a curve ends in a cell of another. Updated in place.
    first_curve : index of the first seed's curve.
    """
    seeds = np.asarray(seeds_xy, np.float32).reshape(-1, 2)
    start = sample_image(field, seeds)
    angle = _angle(start)
    forward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    curve = np.flatnonzero(np.linalg.norm(start, axis=-1) > TOL.min_coherence)
    nodes, owners = [seeds[curve]], [curve]
    arcs = [np.zeros(len(curve), np.float32)]
    # Both halves of a curve side by side, (2, S, 2): a closed curve ends where they meet.
    position = np.stack([seeds[curve]] * 2)
    heading = np.stack([forward, -forward])[:, curve]
    alive = np.ones(position.shape[:2], bool)
    check_every = max(keep_every // 2, 1)
    border_px = 2 * sum(field.shape[:2])
    for index in range(1, int(border_px / step_px) + 1):
        if not len(curve):
            break
        middle_heading, ok = _heading(field, position + 0.5 * step_px * heading, heading)
        position = np.where(alive[..., None], position + step_px * middle_heading, position)
        heading, still_ok = _heading(field, position, middle_heading)
        alive &= ok & still_ok
        if index * step_px > 2 * TOL.meeting_px:
            gap = ((position[0] - position[1]) ** 2).sum(axis=-1)
            alive &= (gap > TOL.meeting_px**2) | ~alive.all(axis=0)
        if claims is not None and index % check_every == 0:
            alive &= _claim(claims, field.shape, position, curve + first_curve)
        if index % keep_every == 0:
            for half, way in enumerate((1, -1)):
                nodes.append(position[half][alive[half]])
                owners.append(curve[alive[half]])
                arcs.append(np.full(len(nodes[-1]), way * index * step_px, np.float32))
        going = alive.any(axis=0)
        if not going.all():
            position, heading, alive = position[:, going], heading[:, going], alive[:, going]
            curve = curve[going]
    xy, owner, arc = np.concatenate(nodes), np.concatenate(owners), np.concatenate(arcs)
    order = np.lexsort((arc, owner))
    return Contours(xy[order], owner[order] + first_curve, arc[order])


def _angle(axial: Image) -> NDArray[np.float32]:
    return np.asarray(0.5 * np.arctan2(axial[..., 1], axial[..., 0]), np.float32)


def _heading(field: Image, xy: Floats, previous: Floats) -> tuple[Image, Mask]:
    """Unit direction of the field nearest to the previous one, and where the field is coherent."""
    axial = sample_image(field, xy)
    angle = _angle(axial)
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    dot = (heading * previous).sum(axis=-1)
    heading *= np.where(dot < 0, -1, 1)[..., None].astype(np.float32)
    coherent = (axial**2).sum(axis=-1) > TOL.min_coherence**2
    return heading, coherent & (np.abs(dot) > TOL.min_coherence)


def _cells(claims: NDArray[np.int32], shape: tuple[int, ...], xy: Floats) -> tuple[Any, Any]:
    """Row and column of the claim cells of image coordinates."""
    rows, cols = claims.shape
    row = (xy[..., 1] * np.float32(rows / shape[0])).astype(np.int64)
    col = (xy[..., 0] * np.float32(cols / shape[1])).astype(np.int64)
    return np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)


def _claim(
    claims: NDArray[np.int32], shape: tuple[int, ...], xy: Floats, curve: NDArray[np.int64]
) -> Mask:
    """Claim the cells of positions (2, S, 2) for their curves; False where another owns it."""
    row, col = _cells(claims, shape, xy)
    mine = np.broadcast_to(curve, row.shape).astype(np.int32)
    free = claims[row, col] < 0
    claims[row[free], col[free]] = mine[free]
    return np.asarray(claims[row, col] == mine)


def cover_with_contours(
    field: Image,
    seeds_xy: Floats,
    inside: Mask,
    *,
    spacing_px: float,
    step_px: float,
) -> Contours:
    """Contours from the seeds, then between them until the region is covered.

    The seeds' contours come first, then rounds from free pixels with decreasing spacing. A new
    curve ends where it meets an earlier one. Pixels of the region that no contour can reach
    (frontal spots, marks) become curves of a single node.

    Parameters
    ----------
    field : (H, W, 2), from :func:`direction_field`.
    seeds_xy : (S, 2), image coordinates.
    inside : (H, W) bool, the region to cover.
    spacing_px : distance between contours, and between the nodes kept of each.
    step_px : step length, px.
    """
    height, width = field.shape[:2]
    keep_every = max(round(spacing_px / step_px), 1)
    cell_px = 0.7 * spacing_px
    claims = np.full((max(int(height / cell_px), 1), max(int(width / cell_px), 1)), -1, np.int32)
    candidates = [np.asarray(seeds_xy, np.float32).reshape(-1, 2)]
    candidates += [_lattice(width, height, spacing_px * scale) for scale in (16, 4, 1)]
    parts, num_curves = [], 0
    for places in candidates:
        free = claims[_cells(claims, field.shape, places)] < 0
        free &= (
            np.linalg.norm(sample_image(field, places, nearest=True), axis=-1) > TOL.min_coherence
        )
        parts.append(
            trace_contours(
                field,
                places[free],
                step_px=step_px,
                keep_every=keep_every,
                claims=claims,
                first_curve=num_curves,
            )
        )
        num_curves += int(free.sum())
    lone = candidates[-1]
    lone = lone[sample_image(inside.astype(np.float32), lone, nearest=True) > 0]
    traced = np.concatenate([p.xy for p in parts])
    if len(traced) and len(lone):
        lone = lone[cKDTree(traced).query(lone)[0] > 0.7 * spacing_px]
    curve = num_curves + np.arange(len(lone))
    parts.append(Contours(lone, curve, np.zeros(len(lone), np.float32)))
    return Contours(
        np.concatenate([p.xy for p in parts]),
        np.concatenate([p.curve for p in parts]),
        np.concatenate([p.arc_px for p in parts]),
    )


def _lattice(width: int, height: int, spacing: float) -> NDArray[np.float32]:
    x = np.arange(spacing / 2, width, spacing)
    y = np.arange(spacing / 2, height, spacing)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float32)
