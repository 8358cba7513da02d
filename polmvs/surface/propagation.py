"""Propagation of seeds over a polarized region along contours of phase, as in the paper.

Contours traced through a view's phase carry a seed's range across the region; normals solved from
the phases of all views carry it sideways, from contour to contour. One robust least-squares
problem per view combines both, so every node uses all seeds.

Normals need the nodes' positions in the other views, and ranges come from the normals, so the two
alternate (:func:`relax`). Normals depend weakly on the positions, so few rounds suffice. Views
depend on each other only through the previous round.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.camera import sample_image
from polmvs.config import Contour, PropagationOptions
from polmvs.geometry import points_on_rays
from polmvs.normals.estimator import NormalEstimate, solve_normals
from polmvs.normals.rows import gather_rows
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap, view_rays
from polmvs.scene import Seeds
from polmvs.surface.contour import (
    Contours,
    ContourTolerances,
    cover_with_contours,
    direction_field,
)
from polmvs.surface.dense_view import (
    NUM_NEAREST,
    REACH,
    DenseView,
    SurfaceSamples,
    dense_view,
    extend_planes,
    lattice_points,
    lattice_xy,
    store_dense_view,
)
from polmvs.surface.log_range import solve_log_ranges
from polmvs.surface.pixel_graph import (
    Nodes,
    bending_modes,
    fill_normals,
    node_edges,
    tie_seeds,
    uncrossed,
    visible_seeds,
)
from polmvs.surface.view_selection import choose_neighbors

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class PropagationTolerances:
    """Tolerances of the connections between contours, and of the agreement of views.

    Attributes
    ----------
    num_neighbors : number of neighbours to which a node is connected. Guess.
    min_own_weight : weight of a view's own row below which the row contradicts the node; that of a
        row 4 deviations off. Derived.
    """

    num_neighbors: int = 6
    min_own_weight: float = 0.25


TOL = PropagationTolerances()


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
    folder.mkdir(parents=True, exist_ok=True)
    nodes: list[Nodes | None] = []
    for started in workers.map(partial(_start, angle_model, seeds, options), maps):
        nodes.append(started)
        on_progress(1)
    dense: list[DenseView | None] = [None] * len(maps)
    neighbors = choose_neighbors(maps, seeds, options.max_neighbors)
    solve = partial(_round, angle_model, seeds, options, tilt_aware)
    for index in range(options.num_rounds):
        is_last = index == options.num_rounds - 1
        tasks = [
            _ViewTask(
                maps=[maps[j] for j in near],
                dense=[dense[j] for j in near],
                nodes=nodes[k],
                stride_px=options.stride_px * (1 if is_last else 2),
                path=folder / f"{maps[k].view.name}.{index}",
            )
            for k, near in enumerate(neighbors)
        ]
        nodes, dense = [], []
        for own_nodes, result in workers.map(solve, tasks):
            nodes.append(own_nodes)
            dense.append(result)
            on_progress(1)
    return dense


@dataclass(frozen=True)
class _ViewTask:
    """One view in one round: its own map and last result first, then its neighbours'.

    Attributes
    ----------
    maps, dense : of the view and its neighbours.
    nodes : of the view; None without a visible seed.
    stride_px : of the lattice of its result.
    path : stem of the files of the result.
    """

    maps: list[PhaseMap]
    dense: list[DenseView | None]
    nodes: Nodes | None
    stride_px: int
    path: Path


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
    passable = open_pixels & (dolp > ContourTolerances.min_dolp)
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


def surface_at_seeds(phase_map: PhaseMap, seeds: Seeds, xy: Floats) -> SurfaceSamples | None:
    """A first guess of the surface at some pixels: range and normal of the nearest seeds.

    None if the view sees no seed.
    """
    visible, seed_xy = visible_seeds(phase_map, seeds)
    if not visible.any() or not len(xy):
        return None
    view = phase_map.view
    distance = np.linalg.norm(seeds.points_in_world[visible] - view.center_in_world, axis=-1)
    k = min(NUM_NEAREST, len(distance))
    nearest = cKDTree(seed_xy[visible]).query(xy, k=k)[1].reshape(len(xy), k)
    unknown = np.full(len(xy), np.nan)
    return SurfaceSamples(
        xy=xy,
        rays_in_world=view.rays_in_world(xy),
        # The median of some: one wrong seed does not spoil it.
        log_range=np.median(np.log(distance)[nearest], axis=1),
        normals=seeds.normals_in_world[visible][nearest[:, 0]],
        normal_sigma=unknown,
        log_range_sigma=unknown,
        confidence=np.zeros(len(xy)),
    )


def _round(
    angle_model: AngleModel,
    seeds: Seeds,
    options: PropagationOptions,
    tilt_aware: bool,
    task: _ViewTask,
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
    dense = spread_nodes(task.maps[0], nodes, task.stride_px)
    return nodes, store_dense_view(dense, task.path) if dense is not None else None


def relax(
    angle_model: AngleModel,
    maps: Sequence[PhaseMap],
    dense: Sequence[DenseView | None],
    nodes: Nodes,
    seeds: Seeds,
    *,
    bending: float,
    tilt_aware: bool = True,
    along_contours: bool = False,
) -> Nodes:
    """Solve the normals at a view's nodes from all views, then the ranges of the nodes.

    Parameters
    ----------
    angle_model : of the rows.
    maps, dense : phase maps, and dense views of the previous round if there are any, the view's own
        first.
    nodes : of the first view, with the ranges and normals of the previous round.
    seeds : points on the surface.
    bending : deviation of the smooth modes, as a share of the distance; 0: none.
    tilt_aware : of the rows' weights.
    along_contours : ranges (OPA: depths) are constant along the nodes' contours.
    """
    center = maps[0].view.center_in_world
    surface = nodes.surface
    points = points_on_rays(center, surface.rays_in_world, np.exp(surface.log_range))
    unknown = ~np.isfinite(surface.log_range)
    points[unknown] = center  # anywhere
    range_maps = [d.range_map if d is not None else None for d in dense]
    rows = gather_rows(angle_model, points, maps, range_maps, tilt_aware=tilt_aware)
    rows.sigma[:, unknown] = np.inf  # other views may see this one's camera: no rows
    estimate = solve_normals(rows.rows, rows.rays, rows.sigma, initial_normals=surface.normals.T)
    normals, normal_sigma = fill_normals(nodes, estimate)
    surface = replace(
        surface,
        normals=normals,
        normal_sigma=normal_sigma,
        confidence=_agreement(rows.sigma, rows.rays, estimate),
    )
    nodes = replace(nodes, surface=surface)
    solution = solve_log_ranges(
        len(normals),
        node_edges(angle_model, nodes, rows.sigma[0], along_contours=along_contours),
        tie_seeds(maps[0], nodes, seeds),
        len(seeds.sigma),
        modes=bending * bending_modes(surface.xy) if bending > 0 else None,
    )
    surface = replace(surface, log_range=solution.log_range, log_range_sigma=solution.sigma)
    return replace(nodes, surface=surface)


def _agreement(sigma: Floats, rays: Floats, estimate: NormalEstimate) -> Array:
    """Share (N,) of the rows that face a node which its normal explains.

    0 where the view's own row, the first, is an outlier: it sees another surface there, such as
    one in front of that which the other views agree on.
    """
    cosine = np.einsum("ikn,ni->kn", rays, np.nan_to_num(estimate.normals))
    facing = np.isfinite(sigma) & (cosine < 0)
    agree = facing & (estimate.row_weights > 0.5)
    denied = facing[0] & (estimate.row_weights[0] < TOL.min_own_weight)
    return np.where(denied, 0, agree.sum(axis=0) / np.maximum(facing.sum(axis=0), 1))


def open_lattice(phase_map: PhaseMap, stride_px: int) -> Mask:
    """Lattice points (h, w) in the region and on none of its edges."""
    camera = phase_map.view.camera
    xy = lattice_xy(camera.height // stride_px, camera.width // stride_px, stride_px)
    open_pixels = (phase_map.region.inside & ~phase_map.region.edges).astype(np.float32)
    return np.asarray(sample_image(open_pixels, xy, nearest=True) > 0)


def spread_nodes(phase_map: PhaseMap, nodes: Nodes, stride_px: int) -> DenseView | None:
    """Ranges and normals on the lattice of the region, from the planes of the nearest nodes."""
    surface = nodes.surface
    good = np.isfinite(surface.log_range) & np.isfinite(surface.normals).all(axis=-1)
    if not good.any():
        return None
    wanted = open_lattice(phase_map, stride_px)
    xy = lattice_points(wanted, stride_px)
    rays = phase_map.view.rays_in_world(xy)
    extended = extend_planes(surface[good], xy, rays, REACH * nodes.spacing_px)
    return dense_view(extended, wanted, stride_px)
