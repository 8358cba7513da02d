"""Integration: range and normal of every pixel of a polarized region, coarse to fine.

The log-ranges of a view's lattice solve one sparse least-squares problem. Normals from the phases
of all views give the change of the log-range from pixel to pixel, and seeds give its value. The
surfaces of the other views in the previous round tie all views to one surface: at a grazing angle a
small error of the normals is a large error of the ranges, but other views see the same point
better. Views depend on each other only through the previous round.

Normals need the nodes' positions in the other views, and ranges come from the normals, so the two
alternate (:func:`relax`). Normals depend weakly on the positions, so few rounds suffice. Contour
propagation (:mod:`polmvs.surface.contour`) differs only in which nodes it connects.
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
from polmvs.config import PropagationOptions
from polmvs.geometry import points_on_rays
from polmvs.normals.estimator import NormalEstimate, solve_normals
from polmvs.normals.rows import gather_rows
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import Seeds
from polmvs.surface.consensus import MAX_DEVIATIONS, sight, surface_of_others
from polmvs.surface.creases import CreaseTolerances
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
    view_samples,
)
from polmvs.surface.log_range import SeedTies, solve_log_ranges
from polmvs.surface.pixel_graph import (
    Nodes,
    bending_modes,
    fill_normals,
    lattice_edges,
    node_edges,
    tie_seeds,
    uncrossed,
    visible_seeds,
)
from polmvs.surface.view_selection import choose_neighbors

Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

REFINEMENTS = (4, 2, 1)  # strides of the lattices, coarsest first, in strides of the last one

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class IntegrationTolerances:
    """Tolerances of the start from seeds and of the ties between views.

    Attributes
    ----------
    min_agreeing : least number of views that tie a node: the error of a single view must not return
        to it as the agreement of another. Derived.
    correlation_px : errors of another view's map are correlated over about this distance: its
        points within it count as one. Measured on the shared captures.
    common_share : share of a tie's deviation that all ties of a view have in common, as the views
        share seeds and rows. Measured on a curved part: the stated deviations are half of the
        errors at 0 and twice the errors at 1.
    min_own_weight : weight of a view's own row below which the row contradicts the node; that of a
        row 4 deviations off. Derived.
    """

    min_agreeing: int = 2
    correlation_px: float = 24.0
    common_share: float = 0.5
    min_own_weight: float = 0.25


TOL = IntegrationTolerances()


def integrate(
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
    angle_model : decides the rows of the normals.
    maps : phase maps of the posed views.
    seeds : points on the surface.
    folder : for the dense views, which stay on disk; existing files are replaced.
    tilt_aware : of the rows' weights, see :func:`polmvs.normals.rows.gather_rows`.
    workers : processes to share the views among; None: this one.
    on_progress : called with the number of views done, once per view and round.

    Returns
    -------
    Dense result of each view, or None if neither a seed nor another view reaches it.
    """
    workers = workers or Workers(1)
    neighbors = choose_neighbors(maps, seeds, options.max_neighbors)
    solve = partial(_round, angle_model, seeds, options.bending, tilt_aware)
    return in_rounds(solve, plan_rounds(options), maps, neighbors, folder, workers, on_progress)


@dataclass(frozen=True)
class RoundPlan:
    """One round: its lattice, and whether the surfaces of other views tie the view's own."""

    stride_px: int
    use_consensus: bool


def plan_rounds(options: PropagationOptions) -> list[RoundPlan]:
    """``num_rounds`` on the coarsest lattice, then one on each finer one.

    The last round on the coarsest lattice and those on finer ones use ties to the other views. The
    first ranges come from a few seeds and are wrong by centimetres on a curved part: each view
    corrects its own fast, and ties would slow this down.
    """
    coarse, *finer = [options.stride_px * factor for factor in REFINEMENTS]
    alone = [RoundPlan(coarse, False)] * (options.num_rounds - 1)
    return [*alone, RoundPlan(coarse, True), *(RoundPlan(stride, True) for stride in finer)]


@dataclass(frozen=True)
class ViewTask:
    """One view in one round: its own map and last result first, then its neighbours'.

    Attributes
    ----------
    maps, dense : of the view and its neighbours.
    nodes : of the view, if the previous round provides them.
    plan : of the round.
    path : stem of the files of the view's result.
    """

    maps: list[PhaseMap]
    dense: list[DenseView | None]
    nodes: Nodes | None
    plan: RoundPlan
    path: Path


def in_rounds(
    solve: Callable[[ViewTask], tuple[Nodes | None, DenseView | None]],
    plans: Sequence[RoundPlan],
    maps: Sequence[PhaseMap],
    neighbors: Sequence[Sequence[int]],
    folder: Path,
    workers: Workers,
    on_progress: OnProgress,
    nodes: Sequence[Nodes | None] | None = None,
) -> list[DenseView | None]:
    """Solve all views in every round, from the results of the previous round.

    Parameters
    ----------
    solve : gives one view's nodes for the next round, and its dense result.
    plans : of the rounds.
    maps : of the views.
    neighbors : for each view the indices of the views that it uses, itself first.
    folder : for the dense views.
    workers : processes for the views.
    on_progress : called with 1 for each view of each round.
    nodes : nodes of each view for the first round; None: ``solve`` makes its own.
    """
    folder.mkdir(parents=True, exist_ok=True)
    dense: list[DenseView | None] = [None] * len(maps)
    nodes = nodes or [None] * len(maps)
    for index, plan in enumerate(plans):
        tasks = [
            ViewTask(
                maps=[maps[j] for j in near],
                dense=[dense[j] for j in near],
                nodes=nodes[k],
                plan=plan,
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


def _round(
    angle_model: AngleModel,
    seeds: Seeds,
    bending: float,
    tilt_aware: bool,
    task: ViewTask,
) -> tuple[None, DenseView | None]:
    """One view's result on its lattice, which the next round's nodes are made of."""
    stride_px = task.plan.stride_px
    wanted = open_lattice(task.maps[0], stride_px)
    surface = _start(task, seeds, wanted)
    if surface is None:
        return None, None
    nodes = relax(
        angle_model,
        task.maps,
        task.dense,
        _lattice_nodes(task.maps[0], surface, wanted, stride_px),
        seeds,
        bending=bending,
        tilt_aware=tilt_aware,
        use_consensus=task.plan.use_consensus,
    )
    dense = dense_view(nodes.surface, wanted, stride_px)
    return None, store_dense_view(dense, task.path) if dense.known.any() else None


def _start(task: ViewTask, seeds: Seeds, wanted: Mask) -> SurfaceSamples | None:
    """The lattice's surface: of the view's last result; else of the seeds, or of the others."""
    phase_map, before = task.maps[0], task.dense[0]
    xy = lattice_points(wanted, task.plan.stride_px)
    if before is None:
        surface = surface_at_seeds(phase_map, seeds, xy)
        return surface or surface_of_others(task.maps, task.dense, xy)
    camera, rotation = phase_map.view.camera, phase_map.view.cam_from_world.rotation
    coarse = view_samples(before, camera.rays(before.lattice_xy()) @ rotation)
    return extend_planes(coarse, xy, camera.rays(xy) @ rotation, REACH * before.stride_px)


def _lattice_nodes(
    phase_map: PhaseMap, surface: SurfaceSamples, wanted: Mask, stride_px: int
) -> Nodes:
    """The lattice's points, joined to their neighbours in rows and columns."""
    tail, head = lattice_edges(wanted)
    clear = uncrossed(phase_map, surface.xy[tail], surface.xy[head])
    return Nodes(
        surface=surface,
        ray_z=phase_map.view.camera.rays(surface.xy)[:, 2],
        spacing_px=float(stride_px),
        focal_px=phase_map.view.camera.mean_focal_px,
        tail=tail[clear],
        head=head[clear],
        on_contour=np.zeros(len(tail[clear]), np.bool_),
    )


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
    use_consensus: bool = False,
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
    use_consensus : the surfaces of the other views also tie the nodes.
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
    ties, num_known = tie_seeds(maps[0], nodes, seeds), len(seeds.sigma)
    if use_consensus:
        ties = _joined(ties, tie_to_consensus(maps, dense, nodes), num_known)
        num_known += len(normals)
    solution = solve_log_ranges(
        len(normals),
        node_edges(angle_model, nodes, rows.sigma[0], along_contours=along_contours),
        ties,
        num_known,
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


def tie_to_consensus(
    maps: Sequence[PhaseMap],
    dense: Sequence[DenseView | None],
    nodes: Nodes,
) -> SeedTies:
    """Tie the nodes of the first view to the surface on which the other views agree.

    Each tie counts as a separate seed.
    """
    surface, center = nodes.surface, maps[0].view.center_in_world
    distance = np.exp(surface.log_range)
    min_cosine = np.cos(np.radians(CreaseTolerances.crease_deg))
    said, deviations = [], []
    for phase_map, other in zip(maps[1:], dense[1:], strict=True):
        if other is None:
            continue
        seen = sight(phase_map, other, center, surface.rays_in_world, distance, surface.normals)
        with np.errstate(invalid="ignore"):
            counts = (seen.cosine > min_cosine) & (seen.place > 0)
        said.append(np.where(counts, seen.place, np.nan))
        deviations.append(np.where(counts, seen.sigma, np.nan))
    if not said:
        none = np.zeros(0, np.int64)
        return SeedTies(
            node=none, seed=none, value=np.zeros(0), sigma=np.zeros(0), common=np.zeros(0)
        )
    place, sigma, count = _consensus(np.array(said), np.array(deviations))
    node = np.flatnonzero((count >= TOL.min_agreeing) & np.isfinite(place) & np.isfinite(sigma))
    alike = max(TOL.correlation_px / nodes.spacing_px, 1.0)
    relative = sigma[node] / place[node]
    return SeedTies(
        node=node,
        seed=node,
        value=np.log(place[node]),
        sigma=alike * relative,
        common=TOL.common_share * relative,
    )


def _consensus(places: Array, sigmas: Array) -> tuple[Array, Array, Array]:
    """Robust weighted mean (N,) of what K views say (K, N), NaN: nothing.

    With it its deviation, which the number of views does not narrow because their errors are not
    independent, and how many agree.
    """
    order = np.sort(places, axis=0)  # NaN last
    count = np.isfinite(places).sum(axis=0)
    columns = np.arange(places.shape[1])
    median = order[np.maximum(count - 1, 0) // 2, columns]
    with np.errstate(invalid="ignore", divide="ignore"):
        gap = np.abs(places - median)
        spread = np.sort(gap, axis=0)[np.maximum(count - 1, 0) // 2, columns]
        near = gap <= MAX_DEVIATIONS * np.maximum(1.5 * spread, sigmas)
        weight = np.where(near, 1 / sigmas**2, 0)
        total = weight.sum(axis=0)
        place = (weight * np.where(near, places, 0)).sum(axis=0) / total
        own = np.sqrt(near.sum(axis=0) / total)
    return place, np.hypot(own, spread), near.sum(axis=0)


def _joined(first: SeedTies, second: SeedTies, num_first: int) -> SeedTies:
    return SeedTies(
        node=np.concatenate([first.node, second.node]),
        seed=np.concatenate([first.seed, num_first + second.seed]),
        value=np.concatenate([first.value, second.value]),
        sigma=np.concatenate([first.sigma, second.sigma]),
        common=np.concatenate([first.common, second.common]),
    )


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
