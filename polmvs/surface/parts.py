"""Parts without seeds: their pieces in all views, the views' agreement, and seeds for them.

A polarised part on which no SfM track lies has a shape but no place. Normals hardly depend on the
distance at which the other views are asked for them, so that the shape of a piece is known up to
one scale about its view's centre. The scale is swept over all that the scene allows, coarsely and
with a wide loss, and refined where outlines meet. A piece counts where other views, each from its
own phases and outline, put the same surface at the same place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from polmvs.camera import in_image
from polmvs.config import AngleModel
from polmvs.normals.estimator import solve_normals
from polmvs.normals.rows import gather_rows
from polmvs.parallel import Workers
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import Seeds, View
from polmvs.surface.dense_view import SurfaceSamples, extend_planes
from polmvs.surface.integration import relax
from polmvs.surface.outlines import (
    FINE_SCALE_PX,
    MIN_COSINE,
    OutlineErrors,
    Piece,
    Reference,
    find_outline_errors,
    find_pieces,
    known,
    piece_nodes,
    points_of,
    rim_of,
)
from polmvs.surface.pixel_graph import Nodes, visible_seeds

Array = NDArray[np.float64]

MIN_SCENE_POINTS = 10  # in sight of a view, for it to know how far the scene is
SCENE_PERCENTILES = (2.0, 98.0)
SCENE_WIDENING = 1.6  # a part may stand nearer or farther than all that has texture
OTHER_VIEW_BOUNDS = 0.12  # of log range about where the first view puts the part
MAX_OTHER_VIEWS = 6  # views that place a part again
MAX_TRIES = 3  # first views for what may be one part
NUM_PART_SEEDS = 48
PLACEMENTS_PER_VIEW = 6  # bounds the search's time; five parts of a whole capture take two
MIN_SEEDS = 3  # on a piece: fewer cannot bear each other out, and one false track is enough


KNOWN_PART = "most views show it as a part that has its place"

PieceId = tuple[int, int]  # view, piece

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


AGREEMENT_SIGMAS = 3.0
MIN_OVERLAP = 8  # points that two views' surfaces share
OVERLAP_GAP_PX = 24.0  # between a view's nodes and another's points, as it sees them
MAX_SEED_NORMAL_SIGMA = 0.05  # rad
MAX_CONTRADICTION = 3.0  # deviations of a track from the place that the outlines give


@dataclass(frozen=True)
class _Member:
    """One view's placement of a part; ``views`` are those that its arrays count in."""

    piece: PieceId
    views: list[int]
    placement: Placement

    @property
    def pieces(self) -> set[PieceId]:
        """The pieces of all views that show the part."""
        found = zip(self.views, self.placement.matched, strict=True)
        return {(view, int(index)) for view, index in found if index >= 0}


def find_part_seeds(
    angle_model: AngleModel,
    maps: Sequence[PhaseMap],
    seeds: Seeds,
    points_in_world: Array,
    *,
    max_neighbors: int = 15,
    tilt_aware: bool = True,
    placements_per_view: int = PLACEMENTS_PER_VIEW,
    workers: Workers | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> tuple[Seeds, list[PartReport]]:
    """Place the parts on which no seed lies, and put seeds on them.

    Parameters
    ----------
    angle_model : of the rows.
    maps : phase maps of the posed views.
    seeds : those there are. A piece of a view is left alone if three lie on it, or if most of the
        other views show it so.
    points_in_world : (N, 3), points of the scene; they bound the range of the parts.
    max_neighbors : other views that place a piece.
    tilt_aware : of the rows' weights, see :func:`polmvs.normals.rows.gather_rows`.
    placements_per_view : after as many times the number of views the search ends; pieces that it
        has not come to, the smallest ones, are reported as not tried. One costs half a second.
    workers : processes to share the views among; None: this one.
    on_progress : called with 1 as many times as there are views, as pieces are decided.

    Returns
    -------
    The seeds, and a report on every part. A seed's ``sigma`` is the deviation of the whole part
    along its normal: all seeds of a part are off together, and no number of them narrows it. Their
    places relative to each other are better, by an order of magnitude, and the normals are those
    solved from all views.
    """
    workers = workers or Workers(1)
    pieces = list(workers.map(_pieces_of, maps))
    seeded = _seeded_pieces(maps, pieces, seeds)
    search = _Search(angle_model, maps, pieces, seeded, points_in_world, max_neighbors, workers)
    search.tilt_aware = tilt_aware
    search.placements_left = placements_per_view * len(maps)
    return search.run(_Progress(len(search.left), len(maps), on_progress))


def _pieces_of(phase_map: PhaseMap) -> list[Piece]:
    return find_pieces(phase_map.region, np.asarray(phase_map.intensity))


def _seeded_pieces(
    maps: Sequence[PhaseMap], pieces: Sequence[Sequence[Piece]], seeds: Seeds
) -> set[PieceId]:
    """Pieces on which enough seeds lie to bear each other out."""
    seeded: set[PieceId] = set()
    for k, phase_map in enumerate(maps):
        visible, xy = visible_seeds(phase_map, seeds)
        for index, piece in enumerate(pieces[k]):
            if (piece.signed_distance(xy[visible]) < 0).sum() >= MIN_SEEDS:
                seeded.add((k, index))
    return seeded


class _Progress:
    """Tells of a number of steps, in proportion to the pieces that are decided."""

    def __init__(
        self, num_pieces: int, num_steps: int, on_progress: Callable[[int], None] | None
    ) -> None:
        self.num_pieces, self.num_steps, self.told = num_pieces, num_steps, 0
        self.on_progress = on_progress

    def left(self, num_left: int) -> None:
        """So many pieces are not decided yet."""
        share = 1 - num_left / max(self.num_pieces, 1) if num_left else 1.0
        while self.on_progress is not None and self.told < int(share * self.num_steps):
            self.told += 1
            self.on_progress(1)


class _Search:
    """Pieces still to be placed, and what was found."""

    def __init__(
        self,
        angle_model: AngleModel,
        maps: Sequence[PhaseMap],
        pieces: Sequence[Sequence[Piece]],
        seeded: set[PieceId],
        points_in_world: Array,
        max_neighbors: int,
        workers: Workers,
    ) -> None:
        self.angle_model, self.maps, self.pieces, self.done = angle_model, maps, pieces, set(seeded)
        self.points, self.max_neighbors, self.workers = points_in_world, max_neighbors, workers
        self.tilt_aware = True
        self.placements_left = PLACEMENTS_PER_VIEW * len(maps)
        unseeded = {(k, i) for k, found in enumerate(pieces) for i in range(len(found))} - seeded
        self.left = sorted(unseeded, key=self._rank)
        self.tries = dict.fromkeys(self.left, 0)
        self.failures: list[tuple[set[PieceId], PartReport]] = []

    def _rank(self, piece: PieceId) -> float:
        """Large pieces that the image does not cut come first."""
        found = self.pieces[piece[0]][piece[1]]
        return -found.num_px * (1 - found.cut_share)

    def run(self, progress: _Progress) -> tuple[Seeds, list[PartReport]]:
        """Place part after part."""
        parts, reports = [], []
        while self.left and self.placements_left > 0:
            progress.left(len(self.left))
            piece_id = self.left.pop(0)
            first = self._place([piece_id], [None])[0]
            members, doubt = self._agreement(first)
            if doubt == KNOWN_PART:
                self._drop(first.pieces)
                continue
            if doubt:
                self._fail(first, doubt)
                continue
            part, report = self._finish(members)
            parts.append(part)
            reports.append(report)
            self._drop(set().union(*(member.pieces for member in members)) | {piece_id})
        reports += [report for _, report in self.failures]
        if self.left:
            reports.append(self._not_tried())
        progress.left(0)
        return join_seeds(parts), reports

    def _place(
        self, chosen_pieces: list[PieceId], middles: Sequence[float | None]
    ) -> list[_Member]:
        """Place pieces, where known within bounds about a log-range."""
        views = [self._neighbors(piece_id) for piece_id in chosen_pieces]
        references, bounds = [], []
        for piece_id, near, middle in zip(chosen_pieces, views, middles, strict=True):
            chosen = [self.pieces[k] for k in near]
            maps = [self.maps[k] for k in near]
            references.append(Reference(maps, chosen, piece_id[1], self.tilt_aware))
            low, high = self._bounds(piece_id[0])
            if middle is not None:
                low, high = middle - OTHER_VIEW_BOUNDS, middle + OTHER_VIEW_BOUNDS
            bounds.append((low, high))
        self.placements_left -= len(chosen_pieces)
        placements = self.workers.map(partial(place_piece, self.angle_model), references, bounds)
        return [_Member(*each) for each in zip(chosen_pieces, views, placements, strict=True)]

    def _bounds(self, k: int) -> tuple[float, float]:
        """Of the log-range in a view, from the scene's points that it sees."""
        view = self.maps[k].view
        in_cam = view.cam_from_world * self.points
        xy = view.camera.project(in_cam)
        shown = in_image(view.camera, xy)
        if shown.sum() < MIN_SCENE_POINTS:
            shown = in_cam[:, 2] > 0
        if not shown.any():
            raise ValueError("no point of the scene lies before a view; its range has no bounds.")
        distance = np.linalg.norm(in_cam[shown], axis=-1)
        low, high = np.log(np.percentile(distance, SCENE_PERCENTILES))
        return float(low - np.log(SCENE_WIDENING)), float(high + np.log(SCENE_WIDENING))

    def _neighbors(self, piece_id: PieceId) -> list[int]:
        """The piece_id's view, then others that can see what lies on its piece, from all sides."""
        k = piece_id[0]
        view = self.maps[k].view
        outline = self.pieces[k][piece_id[1]].outline
        low, high = self._bounds(k)
        middle = outline.mean(axis=0) if len(outline) else np.zeros(2)
        ray = view.camera.rays(middle[None])[0] @ view.cam_from_world.rotation
        along = view.center_in_world + np.exp(np.linspace(low, high, 9))[:, None] * ray
        others = []
        for j, phase_map in enumerate(self.maps):
            other = phase_map.view
            if j != k and in_image(other.camera, other.project(along)).any():
                others.append(j)
        gap = [np.linalg.norm(self.maps[j].view.center_in_world - along[4]) for j in others]
        order = [others[i] for i in np.argsort(gap, kind="stable")]
        return [k, *sorted(order[: self.max_neighbors])]

    def _agreement(self, first: _Member) -> tuple[list[_Member], str]:
        """The placements that agree, the best first, or why there are none."""
        placement = first.placement
        others = first.pieces - {first.piece}
        if placement.doubt:
            return [first], placement.doubt
        if 2 * len(others & self.done) > len(others):
            return [first], KNOWN_PART
        others_left = sorted(others - self.done, key=self._rank)[:MAX_OTHER_VIEWS]
        middles = [self._middle(other, placement) for other in others_left]
        members = [first, *self._place(others_left, middles)]
        members = [member for member in members if not member.placement.doubt]
        agreeing = most_agreeing([member.placement for member in members], self._views(members))
        if len(agreeing) < max(MIN_VIEWS, len(members) // 2 + 1):
            return [first], "the views put it at different places"
        return [members[i] for i in agreeing], ""

    def _views(self, members: Sequence[_Member]) -> list[View]:
        return [self.maps[member.piece[0]].view for member in members]

    def _middle(self, piece: PieceId, placement: Placement) -> float | None:
        """Log-range at which another view sees the middle of a placed surface's piece.

        None where nothing of the surface has a place: the scene's own bounds must do.
        """
        view = self.maps[piece[0]].view
        points = points_of(placement.surface, placement.center)
        known = np.isfinite(points).all(axis=-1)
        points = points[known]
        if not len(points):
            return None
        cosine = np.nan_to_num(
            view.facing_cosines(points, placement.surface.normals[known]), nan=-1.0
        )
        points = points[cosine >= min(MIN_COSINE, float(np.median(cosine)))]
        xy = view.project(points)
        outline = self.pieces[piece[0]][piece[1]].outline
        gap = np.linalg.norm(xy - np.median(outline, axis=0), axis=-1)
        near = points[np.argsort(np.nan_to_num(gap, nan=np.inf))[:MIN_OVERLAP]]
        return float(np.log(np.median(np.linalg.norm(near - view.center_in_world, axis=-1))))

    def _finish(self, members: list[_Member]) -> tuple[Seeds, PartReport]:
        """Seeds on the surfaces of the agreeing views, moved to their common place."""
        placements, views = [m.placement for m in members], self._views(members)
        shifts, sigma = common_place(placements, views)
        report = replace(
            self._report(members[0], ""),
            num_agreeing=len(members),
            range=float(np.exp(placements[0].log_range + shifts[0])),
            sigma=sigma,
        )
        return shared_seeds(placements, views, shifts, sigma, NUM_PART_SEEDS), report

    def _report(self, member: _Member, doubt: str) -> PartReport:
        placement, (k, index) = member.placement, member.piece
        return PartReport(
            view=self.maps[k].view.name,
            num_px=self.pieces[k][index].num_px,
            num_views=int((placement.matched >= 0).sum()),
            num_agreeing=0,
            doubt=doubt,
            range=float(np.exp(placement.log_range)),
            sigma=placement.sigma * normal_depth(placement),
            outline_px=placement.outline_px,
            phase_deg=placement.phase_deg,
        )

    def _not_tried(self) -> PartReport:
        """What is left when the search ends, by the largest of it."""
        k, index = self.left[0]
        others = f", nor were {len(self.left) - 1} smaller ones" if len(self.left) > 1 else ""
        return PartReport(
            view=self.maps[k].view.name,
            num_px=self.pieces[k][index].num_px,
            num_views=0,
            num_agreeing=0,
            doubt=f"it was not tried{others}: too many pieces without sparse points",
            range=np.nan,
            sigma=np.nan,
            outline_px=np.nan,
            phase_deg=np.nan,
        )

    def _fail(self, member: _Member, doubt: str) -> None:
        """Note a failure; after some, the pieces that may show the same part are left."""
        pieces = member.pieces & set(self.tries) | {member.piece}
        for piece in pieces:
            self.tries[piece] += 1
        self.left = [piece for piece in self.left if self.tries[piece] < MAX_TRIES]
        known = next((i for i, (before, _) in enumerate(self.failures) if before & pieces), None)
        if known is None:
            self.failures.append((pieces, self._report(member, doubt)))
        else:
            self.failures[known][0].update(pieces)

    def _drop(self, pieces: set[PieceId]) -> None:
        """These are placed: neither to be tried again nor failures any more."""
        self.done |= pieces
        self.left = [piece for piece in self.left if piece not in pieces]
        self.failures = [failure for failure in self.failures if not failure[0] & pieces]


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


def place_piece(
    angle_model: AngleModel, reference: Reference, bounds: tuple[float, float]
) -> Placement:
    """Find the range of a piece within bounds.

    Parameters
    ----------
    angle_model : of the rows.
    reference : the piece and the views.
    bounds : of the log-range of the piece's middle.

    Returns
    -------
    Where the outlines meet best, with a doubt if they do not, or elsewhere as well.
    """
    nodes = piece_nodes(reference.maps[0], reference.piece)
    if not len(nodes.surface.xy):
        return _nowhere(reference, nodes)
    states, costs = _sweep(angle_model, reference, nodes, bounds)
    refined = []
    for index in _minima(costs):
        state = _refine(angle_model, reference, states[index])
        if state is not None:
            refined.append((_outline_errors(reference, state).support(FINE_SCALE_PX), state))
    if not refined:
        return _nowhere(reference, nodes)
    refined.sort(key=lambda candidate: -candidate[0])
    best = refined[0][1]
    placement = _describe(angle_model, reference, best)
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
    angle_model: AngleModel, reference: Reference, nodes: Nodes, bounds: tuple[float, float]
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
        state = _solve_shape(angle_model, reference, nodes, log_range)
        if state is not None:
            nodes = state.nodes
        if index < 0:
            continue
        if state is None:
            continue
        for shift in shifts:
            met = find_outline_errors(
                reference, state.nodes, state.rim, float(shift), thin=SWEEP_THINNING
            )
            states.append(_shifted(state, float(shift)))
            enough = met.weight.sum() >= MIN_POINTS
            costs.append(met.cost(SWEEP_SCALE_PX) if enough else 1.0)
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
    angle_model: AngleModel, reference: Reference, nodes: Nodes, log_range: float
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
        angle_model,
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


def _outline_errors(reference: Reference, state: _State) -> OutlineErrors:
    return find_outline_errors(reference, state.nodes, state.rim, with_slopes=True)


def _refine(angle_model: AngleModel, reference: Reference, state: _State) -> _State | None:
    """Follow a minimum down: the shape anew and a closer look, again and again."""
    for reach, step, scale in REFINEMENTS:
        solved = _solve_shape(angle_model, reference, state.nodes, state.log_range)
        if solved is None:
            return None
        shifts = np.arange(-reach, reach + step / 2, step)
        candidates = [
            find_outline_errors(reference, solved.nodes, solved.rim, float(s)) for s in shifts
        ]
        best = int(np.argmin([met.cost(scale) for met in candidates]))
        state = _shifted(solved, float(shifts[best]))
    for _ in range(3):
        step = _outline_errors(reference, state).balancing_step()
        state = _shifted(state, float(np.clip(step, -MAX_STEP, MAX_STEP)))
    return state


def _has_rival(refined: Sequence[tuple[float, _State]], apart: float) -> bool:
    """Whether outlines meet at another range about as well as at the best."""
    most, best = refined[0]
    return any(
        abs(state.log_range - best.log_range) > apart and support > RIVAL_SUPPORT * most
        for support, state in refined[1:]
    )


def _describe(angle_model: AngleModel, reference: Reference, state: _State) -> Placement:
    """The state with its uncertainty, and the doubts that it gives rise to itself."""
    met = _outline_errors(reference, state)
    surface = state.nodes.surface[np.flatnonzero(known(state.nodes.surface))]
    center = reference.maps[0].view.center_in_world
    points = points_of(surface, center)
    rows = gather_rows(angle_model, points, reference.maps, tilt_aware=reference.tilt_aware)
    estimate = solve_normals(rows.rows, rows.rays, rows.sigma, initial_normals=surface.normals.T)
    used = np.isfinite(rows.sigma)
    outliers = float((1 - estimate.row_weights)[used].mean()) if used.any() else 1.0
    near = np.abs(met.error) < NEAR_PX
    total = met.weight.sum()
    met_share = float((met.weight * near).sum() / total) if total > 0 else 0.0
    sigma = float(np.hypot(met.sigma(), _shape_sigma(surface, points, center)))
    num_views = len(np.unique(met.view[near])) + 1
    doubt = ""
    if outliers > MAX_PHASE_OUTLIERS:
        doubt = "phases of the views contradict each other"
    if not np.median(surface.normal_sigma) < MAX_NORMAL_SIGMA:
        doubt = "too few views to fix its shape"
    if not sigma < MAX_SIGMA:
        doubt = "outlines do not fix the range"
    if met_share < MIN_MET_SHARE:
        doubt = "outlines of the views do not meet"
    if num_views < MIN_VIEWS or total < MIN_POINTS:
        doubt = f"its outline is seen in fewer than {MIN_VIEWS} views"
    return Placement(
        surface=surface,
        center=center,
        log_range=state.log_range,
        sigma=sigma,
        matched=met.matched,
        outline_px=float(np.median(np.abs(met.error[near]))) if near.any() else np.nan,
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


@dataclass(frozen=True)
class PartReport:
    """What was found about a part without seeds.

    Attributes
    ----------
    view : name of the view that placed it first.
    num_px : pixels of the part in that view.
    num_views : views that show it, at the place found.
    num_agreeing : views that, each by itself, put it at that place.
    doubt : why it has no place; empty if it has one.
    range : of its middle from that view, world units; NaN: none was found.
    sigma : standard deviation along the surface's normal, world units.
    outline_px : median distance of the outlines that are met, px.
    phase_deg : median residual of the phases, degrees.
    """

    view: str
    num_px: int
    num_views: int
    num_agreeing: int
    doubt: str
    range: float
    sigma: float
    outline_px: float
    phase_deg: float


def normal_depth(placement: Placement) -> float:
    """How far a surface moves along its normals per unit of its log-range, world units."""
    surface = placement.surface
    cosine = np.abs((surface.normals * surface.rays_in_world).sum(axis=-1))
    return float(np.median(np.exp(surface.log_range) * cosine)) if len(cosine) else np.nan


def heights_over(placement: Placement, view: View, points: Array, normals: Array) -> Array:
    """Heights (N,) of points (N, 3) over a placed surface that ``view`` sees, along its normals.

    Away from the view is negative; NaN where the view knows no surface and where the points'
    own normals (N, 3) face away: it does not see these.
    """
    to_point = points - placement.center
    distance = np.linalg.norm(to_point, axis=-1)
    xy = view.project(points)
    heights = np.full(len(points), np.nan)
    facing = view.facing_cosines(points, normals) > MIN_COSINE
    seen = np.flatnonzero(np.isfinite(xy).all(axis=-1) & facing)
    if not len(seen) or not len(placement.surface.xy):
        return heights
    rays = to_point[seen] / distance[seen, None]
    here = extend_planes(placement.surface, xy[seen], rays, OVERLAP_GAP_PX)
    cosine = np.abs((rays * here.normals).sum(axis=-1))
    heights[seen] = (np.exp(here.log_range) - distance[seen]) * cosine
    return heights


def _height(placement: Placement, view: View, other: Placement, shift: float = 0.0) -> float:
    """Median height of another surface over one; NaN where the two hardly overlap."""
    points = points_of(other.surface, other.center, shift)
    heights = heights_over(placement, view, points, other.surface.normals)
    heights = heights[np.isfinite(heights)]
    return float(np.median(heights)) if len(heights) >= MIN_OVERLAP else np.nan


def most_agreeing(placements: Sequence[Placement], views: Sequence[View]) -> list[int]:
    """Indices of the largest set of placements that agree with one of them, that one first.

    Agreement is within ``AGREEMENT_SIGMAS`` of both deviations.
    """
    if not placements:
        return []
    sigma = np.array([p.sigma * normal_depth(p) for p in placements])
    heights = np.array(
        [
            [_height(p, view, other) for other in placements]
            for p, view in zip(placements, views, strict=True)
        ]
    )
    np.fill_diagonal(heights, 0.0)
    with np.errstate(invalid="ignore"):
        agree = np.abs(heights) < AGREEMENT_SIGMAS * np.hypot(sigma[:, None], sigma)
    center = int(np.lexsort((sigma, -agree.sum(axis=1)))[0])
    return [center, *(int(i) for i in np.flatnonzero(agree[center]) if i != center)]


def common_place(placements: Sequence[Placement], views: Sequence[View]) -> tuple[Array, float]:
    """Shifts of the log-ranges that take placements that agree to one surface.

    Returns
    -------
    shifts : (P,), of each placement.
    sigma : standard deviation of the common surface along its normals, world units: that of one
        placement and the placements' spread, neither narrowed by their number, because what errs
        in all of them does not average out.
    """
    depth = np.array([normal_depth(p) for p in placements])
    own = np.array([p.sigma for p in placements]) * depth
    heights = np.array([_height(placements[0], views[0], other) for other in placements])
    heights[0] = 0.0
    known = np.isfinite(heights)
    weight = 1 / own[known] ** 2
    mean = float((weight * heights[known]).sum() / weight.sum())
    spread = float(np.sqrt(np.square(heights[known] - mean).sum() / max(known.sum() - 1, 1)))
    # A higher surface is a nearer one.
    first = -mean / depth[0]
    pairs = zip(placements, views, strict=True)
    moves = np.array([_height(p, view, placements[0], first) for p, view in pairs])
    moves[0] = mean
    return -np.nan_to_num(moves) / depth, float(np.hypot(np.median(own), spread))


def shared_seeds(
    placements: Sequence[Placement],
    views: Sequence[View],
    shifts: Array,
    sigma: float,
    count: int,
) -> Seeds:
    """About ``count`` seeds, evenly spread over the surfaces where these coincide.

    Parameters
    ----------
    placements, views, shifts, sigma : from :func:`common_place`.
    count : of all placements together.
    """
    moved = [
        replace(p, surface=replace(p.surface, log_range=p.surface.log_range + shift))
        for p, shift in zip(placements, shifts, strict=True)
    ]
    each = -(-count // len(moved))
    chosen = []
    for index, placement in enumerate(moved):
        surface = placement.surface
        points = points_of(surface, placement.center)
        others = [i for i in range(len(moved)) if i != index]
        heights = np.abs(
            [heights_over(moved[i], views[i], points, surface.normals) for i in others]
        )
        overlap = np.isfinite(heights).sum(axis=0)
        near = (heights < AGREEMENT_SIGMAS * sigma).sum(axis=0)
        sure = (surface.normal_sigma < MAX_SEED_NORMAL_SIGMA) & (2 * near > overlap)
        good = np.flatnonzero(sure)
        some = good[np.unique(np.linspace(0, len(good) - 1, min(each, len(good))).astype(int))]
        chosen.append(Seeds(points[some], surface.normals[some], np.full(len(some), sigma)))
    return join_seeds(chosen)


def join_seeds(parts: Sequence[Seeds]) -> Seeds:
    """All seeds of several."""
    return Seeds(
        np.concatenate([np.zeros((0, 3)), *(part.points_in_world for part in parts)]),
        np.concatenate([np.zeros((0, 3)), *(part.normals_in_world for part in parts)]),
        np.concatenate([np.zeros(0), *(part.sigma for part in parts)]),
    )


def contradicted(seeds: Seeds, part_seeds: Seeds) -> NDArray[np.bool_]:
    """Which seeds (S,) lie off a surface that the outlines placed, by more than its deviation.

    Parameters
    ----------
    seeds : of tracks.
    part_seeds : from :func:`polmvs.surface.parts.find_part_seeds`; a seed is held against
    the nearest
        one if it lies over or under the part and not beside it.
    """
    if not len(part_seeds.sigma) or not len(seeds.sigma):
        return np.zeros(len(seeds.sigma), np.bool_)
    tree = cKDTree(part_seeds.points_in_world)
    near = tree.query(seeds.points_in_world)[1]
    offset = seeds.points_in_world - part_seeds.points_in_world[near]
    height = np.abs((offset * part_seeds.normals_in_world[near]).sum(axis=-1))
    beside = np.sqrt(np.maximum((offset**2).sum(axis=-1) - height**2, 0))
    k = min(2, len(part_seeds.sigma))
    spacing = np.median(tree.query(part_seeds.points_in_world, k=k)[0][..., -1])
    spread = np.hypot(part_seeds.sigma[near], seeds.sigma)
    return np.asarray((height > MAX_CONTRADICTION * spread) & (beside < 2 * spacing))
