"""How well a surface, at some range from its view, meets the outlines of the other views.

Where a surface ends, its outline in one view and that in another are pictures of one curve. Where
it bends away from a camera it does not end: that camera sees as its outline those points at which
it looks along the surface, wherever these lie in the picture of another view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import View
from polmvs.surface.dense_view import SurfaceSamples, extend_planes
from polmvs.surface.parts.misfit import Misfit
from polmvs.surface.parts.outline import BORDER_PX, FAR_PX, OUTLINE_STEP, Piece
from polmvs.surface.pixel_graph import Nodes, uncrossed

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

NUM_NODES = 300  # of a piece's lattice, about: normals vary slowly
SPACINGS_PX = (4.0, 16.0)  # finest and coarsest lattice
INNER_PX = 1.5  # phases nearer to the boundary may be mixed
GAP_SPACINGS = 3.0  # from the lattice to the outline
MIN_COSINE = 0.25  # between normal and ray: nearer to grazing a smooth surface may bend away
STRETCH_POINTS = 16  # points of an outline whose errors are alike
SLOPE_STEP = 1e-3  # of log range, for derivatives
MIN_MATCH_SHARE = 0.5  # of a surface's visible points that lie on a piece which shows it


@dataclass(frozen=True)
class Reference:
    """A piece of one view, to be placed by the others.

    Attributes
    ----------
    maps : of the views, the piece's own first.
    pieces : of each view.
    index : of the piece among those of the first view.
    tilt_aware : of the rows' weights, see :func:`polmvs.normals.rows.gather_rows`.
    """

    maps: Sequence[PhaseMap]
    pieces: Sequence[Sequence[Piece]]
    index: int
    tilt_aware: bool = True

    @property
    def piece(self) -> Piece:
        """The piece to be placed."""
        return self.pieces[0][self.index]


def piece_nodes(phase_map: PhaseMap, piece: Piece) -> Nodes:
    """Nodes on a lattice over a piece, joined in rows and columns; nothing is known of them yet."""
    spacing = float(np.clip(np.sqrt(piece.num_px / NUM_NODES), *SPACINGS_PX))
    camera = phase_map.view.camera
    x = np.arange(spacing / 2, camera.width, spacing)
    y = np.arange(spacing / 2, camera.height, spacing)
    grid = np.stack(np.meshgrid(x, y), axis=-1)
    wanted = piece.signed_distance(grid) < -INNER_PX
    index = np.where(wanted, np.cumsum(wanted).reshape(wanted.shape) - 1, -1)
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    tail = np.concatenate([a[(a >= 0) & (b >= 0)] for a, b in pairs])
    head = np.concatenate([b[(a >= 0) & (b >= 0)] for a, b in pairs])
    xy = grid[wanted]
    clear = uncrossed(phase_map, xy[tail], xy[head])
    rays_in_cam = camera.rays(xy)
    unknown = np.full(len(xy), np.nan)
    surface = SurfaceSamples(
        xy=xy,
        rays_in_world=rays_in_cam @ phase_map.view.cam_from_world.rotation,
        log_range=unknown,
        normals=np.full((len(xy), 3), np.nan),
        normal_sigma=unknown,
        log_range_sigma=unknown,
        confidence=unknown,
    )
    return Nodes(
        surface=surface,
        ray_z=rays_in_cam[:, 2],
        spacing_px=spacing,
        tail=tail[clear],
        head=head[clear],
        on_contour=np.zeros(int(clear.sum()), np.bool_),
    )


def known(surface: SurfaceSamples) -> Mask:
    """Samples (N,) with a range and a normal."""
    has_normal = np.isfinite(surface.normals).all(axis=-1)
    return np.asarray(np.isfinite(surface.log_range) & has_normal)


def rim_of(reference: Reference, nodes: Nodes) -> SurfaceSamples:
    """The surface at the points of the piece's outline where it ends, none where it bends away."""
    view, outline = reference.maps[0].view, reference.piece.outline
    rays = view.camera.rays(outline) @ view.cam_from_world.rotation
    surface = nodes.surface
    rim = extend_planes(surface[known(surface)], outline, rays, GAP_SPACINGS * nodes.spacing_px)
    with np.errstate(invalid="ignore"):
        rim_cosine = -(rim.rays_in_world * rim.normals).sum(axis=-1)
    return rim[np.flatnonzero(rim_cosine > MIN_COSINE)]


def points_of(surface: SurfaceSamples, center: Array, shift: float = 0.0) -> Array:
    """Points (N, 3) in the world of a surface seen from a camera centre, log-ranges shifted."""
    distance = np.exp(surface.log_range + shift)[:, None]
    return np.asarray(center + distance * surface.rays_in_world, np.float64)


def find_misfit(
    reference: Reference,
    nodes: Nodes,
    rim: SurfaceSamples,
    shift: float = 0.0,
    *,
    thin: int = 1,
    with_slopes: bool = False,
) -> Misfit:
    """Compare a surface's outlines with the other views' pieces.

    Parameters
    ----------
    reference : the piece and the views.
    nodes : with ranges and normals.
    rim : from :func:`rim_of`.
    shift : added to all log-ranges.
    thin : use every so many points of the rim.
    with_slopes : find the slopes, too; NaN without.
    """
    center = reference.maps[0].view.center_in_world
    rim = rim[np.arange(0, len(rim.xy), thin)]
    outlines = _Outlines(
        nodes=nodes,
        points=points_of(nodes.surface, center, shift),
        known=known(nodes.surface),
        rim_points=points_of(rim, center, shift),
        rim_normals=rim.normals,
        thin=thin,
    )
    # The same points a little farther.
    step = np.exp(SLOPE_STEP) if with_slopes else None
    matched = np.full(len(reference.maps), -1)
    matched[0] = reference.index
    none, nobody = np.zeros(0), np.zeros(0, np.int64)
    parts = [(none, none, none, nobody, nobody)]
    for k in range(1, len(reference.maps)):
        view, pieces = reference.maps[k].view, reference.pieces[k]
        matched[k] = _best_piece(view, pieces, outlines.points[outlines.known])
        points, weight, stretch = outlines.seen_by(view)
        xy = view.camera.project(view.cam_from_world * points)
        shown = np.flatnonzero(_in_image(view, xy))
        piece = pieces[matched[k]] if matched[k] >= 0 else None
        error = _errors(piece, xy[shown])
        slope = np.full(len(error), np.nan)
        if step is not None:
            farther = center + step * (points[shown] - center)
            moved = view.camera.project(view.cam_from_world * farther)
            slope = (_errors(piece, moved) - error) / SLOPE_STEP
        owner = np.full(len(error), k)
        turning = np.where(stretch[shown] < 0, -1 - k, stretch[shown])
        parts.append((error, slope, weight[shown], owner, turning))
    error, slope, weight, owner, stretch = (np.concatenate(c) for c in zip(*parts, strict=True))
    return Misfit(error, slope, weight, owner, stretch, matched)


@dataclass(frozen=True)
class _Outlines:
    """Nodes and points of the rim of a surface at one range."""

    nodes: Nodes
    points: Array
    known: Mask
    rim_points: Array
    rim_normals: Array
    thin: int

    def seen_by(self, view: View) -> tuple[Array, Array, Indices]:
        """Points (P, 3) of the surface's outline for a view, their weights and stretches.

        Where the surface ends facing the view, and where it turns away from it (stretch -1).
        """
        ends = np.flatnonzero(cosines(view, self.rim_points, self.rim_normals) > MIN_COSINE)
        turns = self._turning_points(view)
        stretch = np.full(len(ends) + len(turns), -1)
        stretch[: len(ends)] = ends * self.thin // STRETCH_POINTS
        weight = np.full(len(stretch), self.nodes.spacing_px / OUTLINE_STEP)
        weight[: len(ends)] = self.thin
        return np.concatenate([self.rim_points[ends], turns]), weight, stretch

    def _turning_points(self, view: View) -> Array:
        """Points (T, 3) between nodes: the nearer faces the view, the other does not.

        A hollow turns the other way about, and shows no outline there.
        """
        surface, tail, head = self.nodes.surface, self.nodes.tail, self.nodes.head
        cosine = cosines(view, self.points, surface.normals)
        distance = np.linalg.norm(self.points - view.center_in_world, axis=-1)
        own = -(surface.normals * surface.rays_in_world).sum(axis=-1)
        with np.errstate(invalid="ignore"):
            firm = self.known & (own > MIN_COSINE)
            turns = (cosine[tail] * cosine[head] < 0) & firm[tail] & firm[head]
            turns &= (cosine[tail] > 0) == (distance[tail] < distance[head])
        tail, head = tail[turns], head[turns]
        share = (cosine[tail] / (cosine[tail] - cosine[head]))[:, None]
        return np.asarray((1 - share) * self.points[tail] + share * self.points[head])


def _errors(piece: Piece | None, xy: Floats) -> Array:
    """Signed distances (N,) from a piece's boundary, as far as can be without a piece."""
    distance = piece.signed_distance(xy) if piece is not None else np.full(len(xy), FAR_PX)
    return np.asarray(distance, np.float64)


def _in_image(view: View, xy: Floats) -> Mask:
    """Image coordinates (N, 2) that lie in the image and off its border."""
    size = np.array([view.camera.width, view.camera.height])
    return np.asarray(((xy > BORDER_PX) & (xy < size - BORDER_PX)).all(axis=-1))


def cosines(view: View, points: Array, normals: Array) -> Array:
    """Cosine (N,) between the normals and the directions to the camera."""
    to_camera = view.center_in_world - points
    return np.asarray((to_camera * normals).sum(axis=-1) / np.linalg.norm(to_camera, axis=-1))


def _best_piece(view: View, pieces: Sequence[Piece], points: Array) -> int:
    """The piece that most of the points in the image lie on; -1: none holds a good share."""
    xy = view.camera.project(view.cam_from_world * points)
    xy = xy[_in_image(view, xy)]
    if not len(xy) or not len(pieces):
        return -1
    shares = [float((piece.signed_distance(xy) < 0).mean()) for piece in pieces]
    best = int(np.argmax(shares))
    return best if shares[best] >= MIN_MATCH_SHARE else -1
