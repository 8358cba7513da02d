"""Outlines of the smooth pieces of a view's region, and how well a surface meets them.

A piece is bounded by the region's own boundary and by creases, where the phase jumps. Where a
surface ends, its outline in one view and that in another are pictures of one curve in space. Where
it bends away from a camera it does not end: that camera sees as its outline those points at which
it looks along the surface, wherever these lie in the picture of another view.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, uniform_filter1d

from polmvs.camera import sample_image, xy_from_opencv, xy_to_opencv
from polmvs.polarization.phase_map import PhaseMap
from polmvs.polarization.region import Region, RegionTolerances, smooth
from polmvs.scene import View
from polmvs.surface.dense_view import SurfaceSamples, extend_planes
from polmvs.surface.pixel_graph import Nodes, lattice_edges, uncrossed

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

FAR_PX = 32.0  # signed distances are not known beyond
LEAK_PX = 2.5  # half the width of a gap in a crease that is closed
FINE = 2  # the outline is drawn at so many times the resolution
SPECK_PX = 12  # smaller cores are none
MIN_PIECE_PX = 600  # fewer leave too little outline to tell a range from a crooked boundary
BORDER_PX = 3.0  # an outline this near to the image's border is where the view ends
OUTLINE_STEP = 3  # boundary pixels per point of an outline
PROFILE_SMOOTHING_PX = 0.7
SNAP_PX = 3.0  # deviation of the region's boundary from the step that it stands for
PEAK_PX = 1.25  # about a step's largest change, that its place is the mean of
SNAP_HALF_WINDOW = 7  # boundary pixels to each side whose steps agree

Indices = NDArray[np.int64]

NUM_NODES = 300  # of a piece's lattice, about: normals vary slowly
SPACINGS_PX = (4.0, 16.0)  # finest and coarsest lattice
INNER_PX = 1.5  # phases nearer to the boundary may be mixed
GAP_SPACINGS = 3.0  # from the lattice to the outline
MIN_COSINE = 0.25  # between normal and ray: nearer to grazing a smooth surface may bend away
STRETCH_POINTS = 16  # points of an outline whose errors are alike
SLOPE_STEP = 1e-3  # of log range, for derivatives
MIN_MATCH_SHARE = 0.5  # of a surface's visible points that lie on a piece which shows it


# Outlines err by half a pixel. A crease that is missed puts one some pixels outside, always to the
# same side: a wider loss would be drawn there.
FINE_SCALE_PX = 1.0
OUTLINE_BIAS_PX = 0.5  # all outlines may lie this much too far outside


@dataclass(frozen=True)
class Piece:
    """A smooth piece of one view's region.

    Attributes
    ----------
    num_px : its area.
    corner : (2,), image coordinates of the corner of ``field``.
    field : (h, w) float32, px, signed distance from the piece's boundary (negative inside) less
        ``FAR_PX``, so that 0 is what a sampler gives outside of it. Holes are filled.
    outline : (M, 2) float64, image coordinates of points of the outline in order, those where
        the image ends left out.
    cut_share : share of the outline that the image's border cuts off.
    """

    num_px: int
    corner: Array
    field: Image
    outline: Array
    cut_share: float

    def signed_distance(self, xy: Floats) -> NDArray[np.float32]:
        """Distance (...) of image coordinates (..., 2) from the boundary, px, negative inside.

        ``FAR_PX`` also stands for anything farther outside.
        """
        return np.float32(FAR_PX) + sample_image(self.field, xy - self.corner)


def find_pieces(region: Region, intensity: Image, *, min_px: int = MIN_PIECE_PX) -> list[Piece]:
    """Split a region at its creases and find the outlines of the pieces.

    Parameters
    ----------
    region : of one view.
    intensity : (H, W), s0; the region's boundary is moved to the step in it.
    min_px : smallest piece.

    Returns
    -------
    The pieces, the largest first.
    """
    labels: NDArray[np.int32] = _split(region)
    counts = np.bincount(labels.ravel())
    counts[0] = 0
    large = [int(label) for label in np.argsort(-counts, kind="stable") if counts[label] >= min_px]
    smoothed = smooth(intensity, PROFILE_SMOOTHING_PX)
    others = np.isin(labels, large)
    masks = [np.asarray(labels == label) for label in large]
    return [_describe(mask, others & ~mask, smoothed) for mask in masks]


def _split(region: Region) -> NDArray[np.int32]:
    """Label what lies between creases; these themselves go to the nearest piece.

    Creases have gaps where the phases of both sides happen to agree: a piece's core keeps
    ``LEAK_PX`` off them, so that it does not run through.
    """
    open_pixels = (region.inside & ~region.edges).astype(np.uint8)
    depth = cv2.distanceTransform(open_pixels, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    core = (depth > LEAK_PX).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=4)
    keep = stats[:, cv2.CC_STAT_AREA] >= SPECK_PX
    keep[0] = False
    kept = np.where(keep[labels], labels, 0)
    if not keep.any():
        return np.zeros(labels.shape, np.int32)
    _, nearest = cv2.distanceTransformWithLabels(
        (kept == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros(int(nearest.max()) + 1, np.int32)
    owner[nearest[kept > 0]] = kept[kept > 0]
    return np.where(region.inside, owner[nearest], 0).astype(np.int32)


def _describe(mask: Mask, others: Mask, smoothed: Image) -> Piece:
    """Outline and signed distances of a piece; holes are filled but for other pieces in them."""
    rough = _longest_contour(mask)
    snapped = _snap(smoothed, mask, rough)
    height, width = mask.shape
    at_end = (rough < BORDER_PX) | (rough > np.array([width, height]) - BORDER_PX)
    cut: Mask = np.asarray(at_end.any(axis=-1))
    # Where the image ends the piece goes on.
    beyond = BORDER_PX * (np.sign(rough - 0.5 * np.array([width, height])) * at_end)
    snapped = np.where(cut[:, None], rough + beyond, snapped)
    filled = np.zeros((FINE * height, FINE * width), np.uint8)
    corners = np.rint(16 * xy_to_opencv(FINE * snapped)).astype(np.int32)
    cv2.fillPoly(filled, [corners[:, None]], [1], shift=4)
    enclosed = cv2.erode(filled, np.ones((3, 3), np.uint8)) > 0
    other = np.repeat(np.repeat(others, FINE, axis=0), FINE, axis=1)
    distance, corner = _signed_distances(np.where(enclosed & other, 0, filled).astype(np.uint8))
    outline = _on_zero_level(distance, snapped[::OUTLINE_STEP] - corner) + corner
    field = np.minimum(distance, FAR_PX) - np.float32(FAR_PX)
    kept = outline[~cut[::OUTLINE_STEP]]
    return Piece(int(mask.sum()), corner, field, kept, float(cut.mean()))


def _longest_contour(mask: Mask) -> Array:
    """Image coordinates (M, 2) of the boundary pixels of a mask's largest outline, in order."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(xy_from_opencv(max(contours, key=len)[:, 0].astype(np.float64)))


def _snap(smoothed: Image, mask: Mask, contour: Array) -> Array:
    """Move a boundary to the largest step of the intensity near it, smoothly along it.

    Where there is none, as at some creases, it stays.
    """
    share = smooth(mask.astype(np.float32), SNAP_PX)
    slopes = [
        cv2.Sobel(share, cv2.CV_32F, dx, 1 - dx, borderType=cv2.BORDER_REPLICATE) for dx in (1, 0)
    ]
    slope = np.stack(slopes, axis=-1).astype(np.float32)
    outward = -sample_image(slope, contour, nearest=True).astype(np.float64)
    outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    offsets = np.arange(-2 * SNAP_PX, 2 * SNAP_PX + 0.25, 0.5)
    profile = sample_image(smoothed, contour[:, None] + offsets[:, None] * outward[:, None])
    middles = 0.5 * (offsets[1:] + offsets[:-1])
    step = np.abs(np.diff(profile, axis=1)) * np.exp(-0.5 * (middles / SNAP_PX) ** 2)
    texture = (
        0.5 * RegionTolerances().low_texture * profile.mean(axis=1)
    )  # change from sample to sample
    peak = middles[step.argmax(axis=1)]
    about = np.where(np.abs(middles - peak[:, None]) <= PEAK_PX, step, 0)
    place = (about * middles).sum(axis=1) / np.maximum(about.sum(axis=1), 1e-12)
    # The contour runs through the last pixels inside; the region ends half a pixel farther.
    shift = np.where(step.max(axis=1) > texture, place, 0.5)
    shift = median_filter(shift, size=2 * SNAP_HALF_WINDOW + 1, mode="wrap")
    shift = uniform_filter1d(shift, SNAP_HALF_WINDOW, mode="wrap")
    # fillPoly draws the pixels of its boundary as well, half of a fine one to the outside.
    return np.asarray(contour + (shift[:, None] - 0.5 / FINE) * outward)


def _signed_distances(fine: NDArray[np.uint8]) -> tuple[Image, Array]:
    """Signed distance from a fine mask's boundary in a box about it, px, and the box's corner.

    The image's border is no boundary: the mask goes on beyond it as it is there.
    """
    margin = int(FAR_PX)
    left, top, width, height = cv2.boundingRect(fine)
    right, bottom = -(-(left + width) // FINE), -(-(top + height) // FINE)
    left, top = left // FINE, top // FINE
    side = FINE * margin
    padded = cv2.copyMakeBorder(fine, side, side, side, side, cv2.BORDER_REPLICATE)
    rows = slice(FINE * top, FINE * (bottom + 2 * margin))
    box = padded[rows, FINE * left : FINE * (right + 2 * margin)]
    outside = cv2.distanceTransform(1 - box, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inside = cv2.distanceTransform(box, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Distances count to the centres of pixels of the other kind; the boundary is half way.
    signed = np.where(box > 0, 0.5 - inside, outside - 0.5).astype(np.float32) / FINE
    size = (right - left + 2 * margin, bottom - top + 2 * margin)
    coarse = cv2.resize(signed, size, interpolation=cv2.INTER_AREA)
    return smooth(np.asarray(coarse, np.float32), 1.0), np.array(
        [left - margin, top - margin], np.float64
    )


def _on_zero_level(distance: Image, xy: Array) -> Array:
    """Move points to where the signed distance vanishes, along its gradient."""
    dx = cv2.Sobel(distance, cv2.CV_32F, 1, 0, scale=1 / 8)
    dy = cv2.Sobel(distance, cv2.CV_32F, 0, 1, scale=1 / 8)
    stacked = np.dstack([distance, dx, dy])
    for _ in range(2):
        sampled = sample_image(stacked, xy).astype(np.float64)
        norm2 = np.maximum((sampled[:, 1:] ** 2).sum(axis=-1, keepdims=True), 0.1)
        xy = xy - sampled[:, :1] * sampled[:, 1:] / norm2
    return xy


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
    tail, head = lattice_edges(wanted)
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
        focal_px=camera.mean_focal_px,
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
    rays = view.rays_in_world(outline)
    surface = nodes.surface
    rim = extend_planes(surface[known(surface)], outline, rays, GAP_SPACINGS * nodes.spacing_px)
    with np.errstate(invalid="ignore"):
        rim_cosine = -(rim.rays_in_world * rim.normals).sum(axis=-1)
    return rim[np.flatnonzero(rim_cosine > MIN_COSINE)]


def points_of(surface: SurfaceSamples, center: Array, shift: float = 0.0) -> Array:
    """Points (N, 3) in the world of a surface seen from a camera centre, log-ranges shifted."""
    distance = np.exp(surface.log_range + shift)[:, None]
    return np.asarray(center + distance * surface.rays_in_world, np.float64)


def find_outline_errors(
    reference: Reference,
    nodes: Nodes,
    rim: SurfaceSamples,
    shift: float = 0.0,
    *,
    thin: int = 1,
    with_slopes: bool = False,
) -> OutlineErrors:
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
        xy = view.project(points)
        shown = np.flatnonzero(_in_image(view, xy))
        piece = pieces[matched[k]] if matched[k] >= 0 else None
        error = _errors(piece, xy[shown])
        slope = np.full(len(error), np.nan)
        if step is not None:
            farther = center + step * (points[shown] - center)
            moved = view.project(farther)
            slope = (_errors(piece, moved) - error) / SLOPE_STEP
        owner = np.full(len(error), k)
        turning = np.where(stretch[shown] < 0, -1 - k, stretch[shown])
        parts.append((error, slope, weight[shown], owner, turning))
    error, slope, weight, owner, stretch = (np.concatenate(c) for c in zip(*parts, strict=True))
    return OutlineErrors(error, slope, weight, owner, stretch, matched)


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
        ends = np.flatnonzero(view.facing_cosines(self.rim_points, self.rim_normals) > MIN_COSINE)
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
        cosine = view.facing_cosines(self.points, surface.normals)
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


def _best_piece(view: View, pieces: Sequence[Piece], points: Array) -> int:
    """The piece that most of the points in the image lie on; -1: none holds a good share."""
    xy = view.project(points)
    xy = xy[_in_image(view, xy)]
    if not len(xy) or not len(pieces):
        return -1
    shares = [float((piece.signed_distance(xy) < 0).mean()) for piece in pieces]
    best = int(np.argmax(shares))
    return best if shares[best] >= MIN_MATCH_SHARE else -1


@dataclass(frozen=True)
class OutlineErrors:
    """Distances of the points of a surface's outlines from those of the pieces that show it.

    Attributes
    ----------
    error : (P,) px, signed, positive outside the piece.
    slope : (P,) px per unit of log range.
    weight : (P,), points of a sparse sampling count for several.
    view, stretch : (P,), view that the point is seen in; part of the outline that it belongs to.
    matched : (K,), index of the piece in each view that shows the surface; -1: none.
    """

    error: Array
    slope: Array
    weight: Array
    view: Indices
    stretch: Indices
    matched: Indices

    def balancing_step(self) -> float:
        """Step of the log-range at which the reweighted errors balance."""
        weight = self._robust_weight()
        information = (weight * self.slope**2).sum()
        pull = (weight * self.slope * self.error).sum()
        return float(-pull / information) if information > 0 else 0.0

    def sigma(self) -> float:
        """Standard deviation of the log-range at which the errors balance.

        Errors of one view's outline are alike, and so are those of a stretch of the piece's own
        outline in all views: the variance is that of sums over either, not over points. Added is
        what a common bias of all outlines does: on a surface seen whole, little.
        """
        weight = self._robust_weight()
        information = (weight * self.slope**2).sum()
        if not information > 0:
            return float(np.inf)
        pull = weight * self.slope * self.error
        variance = 0.0
        for groups in (self.view, self.stretch):
            sums = np.bincount(np.unique(groups, return_inverse=True)[1], pull)
            variance += float((sums**2).sum() * len(sums) / max(len(sums) - 1, 1))
        bias = OUTLINE_BIAS_PX * (weight * self.slope).sum()
        return float(np.sqrt(variance + bias**2) / information)

    def _robust_weight(self) -> Array:
        return np.asarray(self.weight / (1 + (self.error / FINE_SCALE_PX) ** 2) ** 2)

    def support(self, scale_px: float) -> float:
        """Number of points that meet an outline, softly counted."""
        return float(self.weight.sum() * (1 - self.cost(scale_px)))

    def cost(self, scale_px: float) -> float:
        """Mean of the bounded loss ``e^2 / (e^2 + scale^2)``; 1 where there is no point."""
        total = self.weight.sum()
        loss = self.error**2 / (self.error**2 + scale_px**2)
        return float((self.weight * loss).sum() / total) if total > 0 else 1.0
