"""One piece of a view without seeds: its shape, and the range at which it meets the outlines.

Normals hardly depend on the distance at which the other views are asked for them, so that the
shape of a piece is known up to one scale about its view's centre. The scale is swept over all
that the scene allows, coarsely and with a wide loss, and refined where outlines meet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components

from polmvs.config import AngleModel
from polmvs.normals.estimator import solve_normals
from polmvs.normals.rows import gather_rows
from polmvs.scene import Seeds
from polmvs.surface.dense_view import SurfaceSamples
from polmvs.surface.parts.misfit import FINE_SCALE_PX, Misfit
from polmvs.surface.parts.outline_range import (
    Reference,
    find_misfit,
    known,
    piece_nodes,
    points_of,
    rim_of,
)
from polmvs.surface.pixel_graph import Nodes
from polmvs.surface.relaxation import relax

Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MIN_VIEWS = 3  # that show a part, its own included: two outlines always meet somewhere
SHAPE_STEP = 0.15  # of log range, within which a shape serves in the sweep
WARM_UP = 3  # shapes ahead of the sweep
SWEEP_STEP = 0.012  # of log range; some 5 px where views are a distance apart, inside the loss
SWEEP_SCALE_PX = 8.0
SWEEP_THINNING = 3
REFINEMENTS = (
    (0.03, 0.003, 4.0),
    (0.006, 0.0006, FINE_SCALE_PX),
)  # reach, step of log range, scale in px
MAX_STEP = 0.0012  # of log range, between the refinement's
NUM_CANDIDATES = 3  # minima of the sweep that are looked at closely
CANDIDATE_SUPPORT = 0.6  # of that of the lowest
MIN_POINTS = 40  # of outlines in other views
NEAR_PX = 3.0  # an outline this near is met
MIN_MET_SHARE = 0.2
MAX_SWEEP_COST = 0.67  # that of points scattered evenly over what distances reach to
RIVAL_SUPPORT = 0.8  # of the best place's support, from which another one is its rival
MAX_SIGMA = 0.02  # of log range
MAX_NORMAL_SIGMA = 0.015  # rad; a part 0.3 m wide then lies 2 mm off at its ends
NORMAL_BIAS = 0.004  # rad, common to all normals of a surface: a camera model's error
MAX_PHASE_OUTLIERS = 0.5  # share of rows that contradict the normals


@dataclass(frozen=True)
class Placement:
    """A piece's surface at the range at which it meets the outlines.

    Attributes
    ----------
    surface : nodes of the piece that have a range and a normal.
    center : (3,), of the piece's view, world.
    log_range : of the piece's middle.
    sigma : standard deviation of all log-ranges together.
    matched : (K,), index of the piece that shows the surface in each view; -1: none.
    outline_px : median distance of the outlines that are met, px; NaN: none.
    phase_deg : median over the nodes of the phases' residual, degrees.
    doubt : why it is undetermined; empty if it is not.
    """

    surface: SurfaceSamples
    center: Array
    log_range: float
    sigma: float
    matched: Indices
    outline_px: float
    phase_deg: float
    doubt: str


@dataclass(frozen=True)
class _State:
    """A shape, its rim, and where its middle is."""

    nodes: Nodes
    rim: SurfaceSamples
    log_range: float


def place_piece(model: AngleModel, reference: Reference, bounds: tuple[float, float]) -> Placement:
    """Find the range of a piece within bounds.

    Parameters
    ----------
    model : of the rows.
    reference : the piece and the views.
    bounds : of the log-range of the piece's middle.

    Returns
    -------
    Where the outlines meet best, with a doubt if they do not, or elsewhere as well.
    """
    nodes = piece_nodes(reference.maps[0], reference.piece)
    if not len(nodes.surface.xy):
        return _nowhere(reference, nodes)
    states, costs = _sweep(model, reference, nodes, bounds)
    refined = []
    for index in _minima(costs):
        state = _refine(model, reference, states[index])
        if state is not None:
            refined.append((_misfit(reference, state).support(FINE_SCALE_PX), state))
    if not refined:
        return _nowhere(reference, nodes)
    refined.sort(key=lambda candidate: -candidate[0])
    best = refined[0][1]
    placement = _describe(model, reference, best)
    rival = _has_rival(refined, max(5 * placement.sigma, 2 * SWEEP_STEP))
    flat = costs.min() > MAX_SWEEP_COST
    at_end = not bounds[0] < best.log_range < bounds[1]
    return replace(placement, doubt=placement.doubt or _doubt_of_sweep(rival, flat, at_end))


def _doubt_of_sweep(rival: bool, flat: bool, at_end: bool) -> str:
    if flat:
        return "no range at which the outlines meet"
    if at_end:
        return "outlines meet best beyond the scene"
    return "outlines meet at several ranges" if rival else ""


def _nowhere(reference: Reference, nodes: Nodes) -> Placement:
    """No surface at all."""
    matched = np.full(len(reference.maps), -1)
    matched[0] = reference.index
    surface = nodes.surface[np.zeros(0, np.int64)]
    doubt = "too few views give its phase"
    center = reference.maps[0].view.center_in_world
    return Placement(surface, center, np.nan, np.inf, matched, np.nan, np.nan, doubt)


def _sweep(
    model: AngleModel, reference: Reference, nodes: Nodes, bounds: tuple[float, float]
) -> tuple[list[_State], Array]:
    """States over all ranges and what they cost."""
    num_shapes = max(int(np.ceil((bounds[1] - bounds[0]) / SHAPE_STEP)), 1)
    width = (bounds[1] - bounds[0]) / num_shapes
    num_shifts = max(int(np.ceil(width / SWEEP_STEP)), 1)
    shifts = ((np.arange(num_shifts) + 0.5) / num_shifts - 0.5) * width
    states: list[_State] = []
    costs: list[float] = []
    # Shapes begin with one range for all nodes; on the way from nearer ranges they settle.
    for index in range(-WARM_UP, num_shapes):
        log_range = float(bounds[0] + (index + 0.5) * width)
        state = _solve_shape(model, reference, nodes, log_range)
        if state is not None:
            nodes = state.nodes
        if index < 0:
            continue
        if state is None:
            continue
        for shift in shifts:
            misfit = find_misfit(
                reference, state.nodes, state.rim, float(shift), thin=SWEEP_THINNING
            )
            states.append(_shifted(state, float(shift)))
            enough = misfit.weight.sum() >= MIN_POINTS
            costs.append(misfit.cost(SWEEP_SCALE_PX) if enough else 1.0)
    return states, np.array(costs)


def _minima(costs: Array) -> list[int]:
    """The lowest local minima of a profile, the lowest first."""
    if not len(costs):
        return []
    padded = np.concatenate([[np.inf], costs, [np.inf]])
    low = np.flatnonzero((costs < padded[:-2]) & (costs <= padded[2:]))
    low = low[1 - costs[low] > CANDIDATE_SUPPORT * (1 - costs.min())]
    return [int(i) for i in low[np.argsort(costs[low])][:NUM_CANDIDATES]]


def _solve_shape(
    model: AngleModel, reference: Reference, nodes: Nodes, log_range: float
) -> _State | None:
    """The piece's shape with its middle at a range; None where no normals are found."""
    surface = nodes.surface
    pivot = _pivot(nodes)
    moved = surface.log_range + (log_range - surface.log_range[pivot])
    surface = replace(surface, log_range=np.where(np.isfinite(moved), moved, log_range))
    center = reference.maps[0].view.center_in_world
    place = points_of(surface[np.array([pivot])], center)  # a seed that holds the middle
    held = Seeds(place, np.full((1, 3), np.nan), np.full(1, 1e-4 * np.exp(log_range)))
    blind = [None] * len(reference.maps)
    nodes = relax(
        model,
        reference.maps,
        blind,
        replace(nodes, surface=surface),
        held,
        bending=0.0,
        tilt_aware=reference.tilt_aware,
    )
    if not known(nodes.surface)[pivot]:
        return None
    return _State(nodes, rim_of(reference, nodes), log_range)


def _pivot(nodes: Nodes) -> int:
    """The node nearest to the middle of those that are joined to most others."""
    num = len(nodes.surface.xy)
    ones = np.ones(len(nodes.tail), np.int8)
    graph = sparse.coo_matrix((ones, (nodes.tail, nodes.head)), shape=(num, num))
    labels = connected_components(graph, directed=False)[1]
    joined = np.flatnonzero(labels == np.bincount(labels).argmax())
    offset = nodes.surface.xy[joined] - np.median(nodes.surface.xy[joined], axis=0)
    return int(joined[(offset**2).sum(axis=-1).argmin()])


def _shifted(state: _State, shift: float) -> _State:
    surface, rim = state.nodes.surface, state.rim
    surface = replace(surface, log_range=surface.log_range + shift)
    rim = replace(rim, log_range=rim.log_range + shift)
    return _State(replace(state.nodes, surface=surface), rim, state.log_range + shift)


def _misfit(reference: Reference, state: _State) -> Misfit:
    return find_misfit(reference, state.nodes, state.rim, with_slopes=True)


def _refine(model: AngleModel, reference: Reference, state: _State) -> _State | None:
    """Follow a minimum down: the shape anew and a closer look, again and again."""
    for reach, step, scale in REFINEMENTS:
        solved = _solve_shape(model, reference, state.nodes, state.log_range)
        if solved is None:
            return None
        shifts = np.arange(-reach, reach + step / 2, step)
        misfits = [find_misfit(reference, solved.nodes, solved.rim, float(s)) for s in shifts]
        best = int(np.argmin([misfit.cost(scale) for misfit in misfits]))
        state = _shifted(solved, float(shifts[best]))
    for _ in range(3):
        step = _misfit(reference, state).balancing_step()
        state = _shifted(state, float(np.clip(step, -MAX_STEP, MAX_STEP)))
    return state


def _has_rival(refined: Sequence[tuple[float, _State]], apart: float) -> bool:
    """Whether outlines meet at another range about as well as at the best."""
    most, best = refined[0]
    return any(
        abs(state.log_range - best.log_range) > apart and support > RIVAL_SUPPORT * most
        for support, state in refined[1:]
    )


def _describe(model: AngleModel, reference: Reference, state: _State) -> Placement:
    """The state with its uncertainty, and the doubts that it gives rise to itself."""
    misfit = _misfit(reference, state)
    surface = state.nodes.surface[np.flatnonzero(known(state.nodes.surface))]
    center = reference.maps[0].view.center_in_world
    points = points_of(surface, center)
    rows = gather_rows(model, points, reference.maps, tilt_aware=reference.tilt_aware)
    estimate = solve_normals(rows.rows, rows.rays, rows.sigma, initial_normals=surface.normals.T)
    used = np.isfinite(rows.sigma)
    outliers = float((1 - estimate.row_weights)[used].mean()) if used.any() else 1.0
    near = np.abs(misfit.error) < NEAR_PX
    total = misfit.weight.sum()
    met = float((misfit.weight * near).sum() / total) if total > 0 else 0.0
    sigma = float(np.hypot(misfit.sigma(), _shape_sigma(surface, points, center)))
    num_views = len(np.unique(misfit.view[near])) + 1
    doubt = ""
    if outliers > MAX_PHASE_OUTLIERS:
        doubt = "phases of the views contradict each other"
    if not np.median(surface.normal_sigma) < MAX_NORMAL_SIGMA:
        doubt = "too few views to fix its shape"
    if not sigma < MAX_SIGMA:
        doubt = "outlines do not fix the range"
    if met < MIN_MET_SHARE:
        doubt = "outlines of the views do not meet"
    if num_views < MIN_VIEWS or total < MIN_POINTS:
        doubt = f"its outline is seen in fewer than {MIN_VIEWS} views"
    return Placement(
        surface=surface,
        center=center,
        log_range=state.log_range,
        sigma=sigma,
        matched=misfit.matched,
        outline_px=float(np.median(np.abs(misfit.error[near]))) if near.any() else np.nan,
        phase_deg=float(np.degrees(np.median(estimate.residual[estimate.valid])))
        if estimate.valid.any()
        else np.nan,
        doubt=doubt,
    )


def _shape_sigma(surface: SurfaceSamples, points: Array, center: Array) -> float:
    """Deviation of the log-range from the normals', as if alike in all: it tilts the surface."""
    to_point = points - center
    reach = np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=-1).mean())
    depth = np.abs((to_point * surface.normals).sum(axis=-1)).mean()
    turn = np.hypot(NORMAL_BIAS, np.median(surface.normal_sigma))
    return float(turn * reach / depth)
