"""Parts without seeds: their pieces in all views, the views' agreement, and seeds for them.

A polarised part on which no SfM track lies has a shape but no place. Each piece of a region
without seeds is placed by its outlines on its own (:mod:`polmvs.surface.parts.placement`); it
counts where
other views, each from its own phases and outline, put the same surface at the same place.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from polmvs.config import AngleModel
from polmvs.parallel import Workers
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import Seeds, View
from polmvs.surface.parts.agreement import (
    MIN_OVERLAP,
    PartReport,
    common_place,
    join_seeds,
    most_agreeing,
    normal_depth,
    shared_seeds,
)
from polmvs.surface.parts.outline import Piece, find_pieces
from polmvs.surface.parts.outline_range import MIN_COSINE, Reference, cosines, points_of
from polmvs.surface.parts.placement import MIN_VIEWS, Placement, place_piece
from polmvs.surface.pixel_graph import visible_seeds

Array = NDArray[np.float64]

MIN_SCENE_POINTS = 10  # in sight of a view, for it to know how far the scene is
SCENE_PERCENTILES = (2.0, 98.0)
SCENE_WIDENING = 1.6  # a part may stand nearer or farther than all that has texture
FOLLOWER_BOUNDS = 0.12  # of log range about where the first view puts the part
MAX_FOLLOWERS = 6  # views that place a part again
MAX_TRIES = 3  # first views for what may be one part
NUM_PART_SEEDS = 48
PLACEMENTS_PER_VIEW = 6  # bounds the search's time; five parts of a whole capture take two
MIN_SEEDS = 3  # on a piece: fewer cannot bear each other out, and one false track is enough


KNOWN_PART = "most views show it as a part that has its place"

PieceId = tuple[int, int]  # view, piece


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
    model: AngleModel,
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
    model : of the rows.
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
    search = _Search(model, maps, pieces, seeded, points_in_world, max_neighbors, workers)
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
        model: AngleModel,
        maps: Sequence[PhaseMap],
        pieces: Sequence[Sequence[Piece]],
        seeded: set[PieceId],
        points_in_world: Array,
        max_neighbors: int,
        workers: Workers,
    ) -> None:
        self.model, self.maps, self.pieces, self.done = model, maps, pieces, set(seeded)
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
            lead = self.left.pop(0)
            first = self._place([lead], [None])[0]
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
            self._drop(set().union(*(member.pieces for member in members)) | {lead})
        reports += [report for _, report in self.failures]
        if self.left:
            reports.append(self._not_tried())
        progress.left(0)
        return join_seeds(parts), reports

    def _place(self, leads: list[PieceId], middles: Sequence[float | None]) -> list[_Member]:
        """Place pieces, where known within bounds about a log-range."""
        views = [self._neighbors(lead) for lead in leads]
        references, bounds = [], []
        for lead, near, middle in zip(leads, views, middles, strict=True):
            chosen = [self.pieces[k] for k in near]
            maps = [self.maps[k] for k in near]
            references.append(Reference(maps, chosen, lead[1], self.tilt_aware))
            low, high = self._bounds(lead[0])
            if middle is not None:
                low, high = middle - FOLLOWER_BOUNDS, middle + FOLLOWER_BOUNDS
            bounds.append((low, high))
        self.placements_left -= len(leads)
        placements = self.workers.map(partial(place_piece, self.model), references, bounds)
        return [_Member(*each) for each in zip(leads, views, placements, strict=True)]

    def _bounds(self, k: int) -> tuple[float, float]:
        """Of the log-range in a view, from the scene's points that it sees."""
        view = self.maps[k].view
        in_cam = view.cam_from_world * self.points
        xy = view.camera.project(in_cam)
        shown = ((xy > 0) & (xy < [view.camera.width, view.camera.height])).all(axis=-1)
        if shown.sum() < MIN_SCENE_POINTS:
            shown = in_cam[:, 2] > 0
        if not shown.any():
            raise ValueError("no point of the scene lies before a view; its range has no bounds.")
        distance = np.linalg.norm(in_cam[shown], axis=-1)
        low, high = np.log(np.percentile(distance, SCENE_PERCENTILES))
        return float(low - np.log(SCENE_WIDENING)), float(high + np.log(SCENE_WIDENING))

    def _neighbors(self, lead: PieceId) -> list[int]:
        """The lead's view, then others that can see what lies on its piece, from all sides."""
        k = lead[0]
        view = self.maps[k].view
        outline = self.pieces[k][lead[1]].outline
        low, high = self._bounds(k)
        middle = outline.mean(axis=0) if len(outline) else np.zeros(2)
        ray = view.camera.rays(middle[None])[0] @ view.cam_from_world.rotation
        along = view.center_in_world + np.exp(np.linspace(low, high, 9))[:, None] * ray
        others = []
        for j, phase_map in enumerate(self.maps):
            camera = phase_map.view.camera
            xy = camera.project(phase_map.view.cam_from_world * along)
            if j != k and ((xy > 0) & (xy < [camera.width, camera.height])).all(axis=-1).any():
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
        followers = sorted(others - self.done, key=self._rank)[:MAX_FOLLOWERS]
        middles = [self._middle(follower, placement) for follower in followers]
        members = [first, *self._place(followers, middles)]
        members = [member for member in members if not member.placement.doubt]
        agreeing = most_agreeing([member.placement for member in members], self._views(members))
        if len(agreeing) < max(MIN_VIEWS, len(members) // 2 + 1):
            return [first], "the views put it at different places"
        return [members[i] for i in agreeing], ""

    def _views(self, members: Sequence[_Member]) -> list[View]:
        return [self.maps[member.piece[0]].view for member in members]

    def _middle(self, piece: PieceId, placement: Placement) -> float:
        """Log-range at which another view sees the middle of a placed surface's piece."""
        view = self.maps[piece[0]].view
        points = points_of(placement.surface, placement.center)
        cosine = cosines(view, points, placement.surface.normals)
        points = points[cosine > np.minimum(MIN_COSINE, np.median(cosine))]
        xy = view.camera.project(view.cam_from_world * points)
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
