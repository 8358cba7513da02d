"""Surroundings of the polarized parts: sparse points, and stereo of textured surfaces.

The surroundings are textured and unpolarized, so features and patches match there. On the parts
they do not: a glossy surface shows mirror images, which give consistent sparse points behind it.
The region of the parts in each view is known, and points in it are left out.

Stereo is OpenCV's semi-global matching on rectified pairs of views. Any camera model is rectified
through its rays: both views are rotated into one frame whose x axis is the baseline, and resampled
by pinhole cameras of that frame. A rotated pinhole camera has the rays of its view, so matching
gives the ranges of the view's own pixels, without reprojection.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import PinholeCamera, in_frame, pixel_centers, sample_image
from polmvs.config import FusionOptions, PropagationOptions
from polmvs.parallel import Workers
from polmvs.polarization.capture import DISPLAY_GAMMA
from polmvs.polarization.phase_map import PhaseMap, open_phase_map
from polmvs.polarization.region import grow_mask
from polmvs.scene import (
    KEYPOINT_SIGMA_PX,
    MIN_FACING_COSINE,
    MIN_VIEWS,
    Tracks,
    View,
    point_sigmas,
    some_tracks,
)
from polmvs.surface.creases import CreaseTolerances
from polmvs.surface.dense_view import DenseView, lattice_xy, store_dense_view
from polmvs.surface.fusion import FusedCloud, fuse

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

Floats = NDArray[np.floating]
Image = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class SurroundingsTolerances:
    """Tolerances of sparse points, pairs of views, and matches.

    Attributes
    ----------
    min_observations : of a sparse point: two rays may meet by chance. Derived. As many views must
        agree on a point of stereo. A point is left out if more than one in so many observations is
        on a part: it is on the part, which has its own cloud, or a mirror image behind it.
    max_relative_sigma : largest position uncertainty, as a share of the mean distance from the
        cameras, along the worst axis. Measured on `dome`: twice as much keeps 1.2 times as many.
    min_angle_deg : of triangulation: half a pixel of disparity is 1 % of the distance there.
        Derived.
    max_angle_deg : of triangulation: beyond it patches of slanted surfaces look too different.
        Guess.
    max_axis_angle_deg : between the optical axes of two views, and between their baseline and the
        plane perpendicular to the axes: no epipole may be in the image. Guess.
    min_shared_points : of two views, for their angle, their range of depths and a useful overlap.
        Guess.
    block_px : side of the matched patches, and of the fitted planes, in points of the lattice.
        Guess.
    min_texture : standard deviation, grey levels. Derived: noise of a full well of 10,000
        electrons makes 0.6.
    min_ray_z : rays more than 60 deg from the rectified axis would be stretched fourfold.
        Derived.
    range_percentiles : of the sparse points' distances; few of them are wrong. Guess.
    range_margin : of the disparities beyond those of the sparse points. Guess.
    max_disparities : largest number to search; with more, the sparse points are useless. Guess.
    min_window_share : share of a plane's lattice points that are known. Guess.
    """

    min_observations: int = MIN_VIEWS
    max_relative_sigma: float = 0.005
    min_angle_deg: float = 5.0
    max_angle_deg: float = 25.0
    max_axis_angle_deg: float = 45.0
    min_shared_points: int = 20
    block_px: int = 5
    min_texture: float = 2.0
    min_ray_z: float = 0.5
    range_percentiles: tuple[float, float] = (1.0, 99.0)
    range_margin: float = 0.15
    max_disparities: int = 512
    min_window_share: float = 0.6

    @property
    def border_px(self) -> int:
        """Reach of a patch and of the filter before it."""
        return self.block_px // 2 + 2


@dataclass(frozen=True)
class SparseSurroundings:
    """Sparse points off the polarized parts.

    Attributes
    ----------
    points : (N, 3) float64, world frame.
    colors : (N, 3) uint8
    num_views : (N,) int32, observations of each point.
    is_kept : (T,) bool, the tracks among them.
    """

    points: Array
    colors: NDArray[np.uint8]
    num_views: NDArray[np.int32]
    is_kept: Mask


def sparse_surroundings(
    tracks: Tracks,
    maps: Sequence[PhaseMap],
    *,
    tolerances: SurroundingsTolerances = SurroundingsTolerances(),
) -> SparseSurroundings:
    """Sparse points of certain position, neither on a polarized part nor mirrored in one.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``.
    maps : phase maps of the views.
    tolerances : of this step.
    """
    # A keypoint this near to a part's outline may be on the outline.
    part_share = part_shares(tracks, maps, tolerances.border_px)
    num_views = np.bincount(tracks.obs_track, minlength=len(part_share))
    sigma = relative_sigmas(tracks, [phase_map.view for phase_map in maps])
    kept = (
        (num_views >= tolerances.min_observations)
        & (part_share <= 1 / tolerances.min_observations)
        & (sigma <= tolerances.max_relative_sigma)
    )
    return SparseSurroundings(
        points=tracks.points_in_world[kept],
        colors=tracks.colors[kept],
        num_views=num_views[kept].astype(np.int32),
        is_kept=kept,
    )


def part_shares(tracks: Tracks, maps: Sequence[PhaseMap], margin_px: int) -> Array:
    """Share ``(T,)`` of each track's observations in or beside a region; 1 without any."""
    num_tracks = len(tracks.points_in_world)
    on_part = np.zeros(len(tracks.obs_track), bool)
    for phase_map, here in zip(maps, tracks.of_views(len(maps)), strict=True):
        grown = grow_mask(phase_map.region.inside, margin_px).astype(np.float32)
        on_part[here] = sample_image(grown, tracks.obs_xy[here], nearest=True) > 0
    count = np.bincount(tracks.obs_track, minlength=num_tracks)
    hits = np.bincount(tracks.obs_track, on_part, num_tracks)
    return np.where(count > 0, hits / np.maximum(count, 1), 1.0)


def relative_sigmas(tracks: Tracks, views: Sequence[View]) -> Array:
    """Standard deviation ``(T,)`` of the points' positions as shares of their mean distances.

    It follows from the geometry of the rays, and is larger if the reprojection error shows worse
    keypoints than usual. Infinite for points with fewer than two observations.
    """
    num_tracks = len(tracks.points_in_world)
    count = np.bincount(tracks.obs_track, minlength=num_tracks)
    total = np.zeros(num_tracks)
    for view, own in zip(views, tracks.of_views(len(views)), strict=True):
        seen = tracks.obs_track[own]
        offsets = tracks.points_in_world[seen] - view.center_in_world
        total[seen] += np.linalg.norm(offsets, axis=-1)
    # Keypoints of deviation s per axis are sqrt(pi / 2) s off on average, less what the point's
    # three coordinates take up of the 2 n residuals.
    freedom = 1 - 1.5 / np.maximum(count, 2)
    keypoint_sigma = tracks.errors / np.sqrt(0.5 * np.pi * freedom)
    worse = np.maximum(np.nan_to_num(keypoint_sigma) / KEYPOINT_SIGMA_PX, 1.0)
    distance = np.maximum(total / np.maximum(count, 1), 1e-100)
    sigma = worse * point_sigmas(tracks, views) / distance
    return np.where(count >= 2, sigma, np.inf)


def choose_partners(
    tracks: Tracks,
    views: Sequence[View],
    max_partners: int = 3,
    *,
    tolerances: SurroundingsTolerances = SurroundingsTolerances(),
) -> list[list[int]]:
    """For each view the views to match it with, those with the most common points first.

    Partners see the common points under a useful angle of triangulation, have a similar viewing
    direction and stand beside the view and not before or behind it. A view may have none.

    Parameters
    ----------
    tracks : common points; ``obs_view`` counts in ``views``.
    tolerances : of this step.
    """
    sees = np.zeros((len(views), len(tracks.points_in_world)), bool)
    sees[tracks.obs_view, tracks.obs_track] = True
    shared = sees.astype(np.int32) @ sees.T.astype(np.int32)
    partners = []
    for a, view in enumerate(views):
        candidates = [
            b
            for b in np.argsort(-shared[a], kind="stable")
            if b != a
            and shared[a, b] >= tolerances.min_shared_points
            and _fits(
                view, views[b], tracks.points_in_world[sees[a] & sees[b]], tolerances=tolerances
            )
        ]
        partners.append([int(b) for b in candidates[:max_partners]])
    return partners


def _fits(view: View, other: View, points: Array, *, tolerances: SurroundingsTolerances) -> bool:
    """Whether two views can be matched, by their poses and the points that both see."""
    axes = view.cam_from_world.rotation[2], other.cam_from_world.rotation[2]
    baseline = other.center_in_world - view.center_in_world
    if not np.linalg.norm(baseline) > 0 or _angle_deg(*axes) > tolerances.max_axis_angle_deg:
        return False
    to_baseline = float(_angle_deg(baseline, axes[0] + axes[1]))
    if abs(to_baseline - 90) > tolerances.max_axis_angle_deg:
        return False
    angles = _angle_deg(points - view.center_in_world, points - other.center_in_world)
    return bool(tolerances.min_angle_deg <= np.median(angles) <= tolerances.max_angle_deg)


def _angle_deg(a: Array, b: Array) -> Array:
    """Angles between vectors ``(..., 3)``, degrees."""
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(sine, (a * b).sum(axis=-1))))


@dataclass(frozen=True)
class _WholeView(PhaseMap):
    """A view whose region is the whole image, so that fusion treats no pixel as background."""

    def shows_surface(self, xy: NDArray[np.floating]) -> Mask:
        """True everywhere."""
        return np.ones(xy.shape[:-1], bool)

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a stored map as its place."""
        if self.folder is not None:
            return _open_whole_view, (self.view, self.folder)
        return _WholeView, tuple(getattr(self, f.name) for f in fields(self))


def _whole_view(phase_map: PhaseMap) -> _WholeView:
    return _WholeView(*(getattr(phase_map, f.name) for f in fields(PhaseMap)))


def _open_whole_view(view: View, folder: Path) -> _WholeView:
    return _whole_view(open_phase_map(view, folder))


def stereo_surroundings(
    tracks: Tracks,
    maps: Sequence[PhaseMap],
    folder: Path,
    *,
    workers: Workers | None = None,
    tolerances: SurroundingsTolerances = SurroundingsTolerances(),
) -> FusedCloud:
    """Dense cloud of the textured surroundings of the polarized parts, from pairs of views.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``. They select the pairs and bound the
        depths.
    maps : phase maps of the views.
    folder : for the views' ranges; the caller removes it.
    workers : processes for the views; None: this process.
    tolerances : of this step.
    """
    workers = workers or Workers(1)
    folder.mkdir(parents=True, exist_ok=True)
    kept = sparse_surroundings(tracks, maps, tolerances=tolerances).is_kept
    certain = some_tracks(tracks, kept)
    chosen = choose_partners(certain, [m.view for m in maps], tolerances=tolerances)
    used = [k for k, partners in enumerate(chosen) if partners]
    task = partial(_match_view, folder, tolerances=tolerances)
    groups = [[maps[k], *(maps[j] for j in chosen[k])] for k in used]
    own = certain.of_views(len(maps))
    points = [certain.points_in_world[certain.obs_track[own[k]]] for k in used]
    dense = list(workers.map(task, groups, points))
    options = FusionOptions(
        min_views=tolerances.min_observations,
        max_normal_difference_deg=CreaseTolerances.crease_deg,
        voxel_px=1.0,
    )
    views = [_whole_view(maps[k]) for k in used]
    return fuse(views, dense, options, workers=workers)


def _match_view(
    folder: Path,
    maps: Sequence[PhaseMap],
    points: Array,
    *,
    tolerances: SurroundingsTolerances,
) -> DenseView:
    """Match the first view with the others and store what comes of it."""
    # A match may leak across a part's outline by its patch and a neighbour's.
    excluded = grow_mask(maps[0].region.inside, 2 * tolerances.border_px)
    stride_px = PropagationOptions.stride_px  # as dense as the polarized surface
    dense = stereo_view(maps[0], maps[1:], points, excluded, stride_px, tolerances=tolerances)
    return store_dense_view(dense, folder / f"{maps[0].view.name}.stereo")


@dataclass(frozen=True)
class RectifiedPair:
    """Two virtual pinholes of one frame, whose rows correspond.

    Attributes
    ----------
    rect_from_world : (3, 3), rotation into the frame; its x axis runs from left to right.
    left, right : pinholes of the same size; they differ in ``cx``, so that disparities start at 0.
    baseline : distance of the centres, world units.
    num_disparities : to search, a multiple of 16.
    """

    rect_from_world: Array
    left: PinholeCamera
    right: PinholeCamera
    baseline: float
    num_disparities: int

    @property
    def offset_px(self) -> float:
        """Offset to add to a disparity; then depth z is ``fx * baseline / disparity``."""
        return self.right.cx - self.left.cx


def rectify_pair(
    view: View,
    other: View,
    points: Floats,
    *,
    tolerances: SurroundingsTolerances = SurroundingsTolerances(),
) -> RectifiedPair | None:
    """Virtual cameras at the centres of two views, over their common field of view.

    Parameters
    ----------
    view, other : the left and the right view, at any roll.
    points : (N, 3), world, that the view sees; they bound the depths to search.
    tolerances : of this step.

    Returns
    -------
    RectifiedPair, or None if the views share no rows or the range of depths is unusable.
    """
    baseline = other.center_in_world - view.center_in_world
    length = float(np.linalg.norm(baseline))
    forward = view.cam_from_world.rotation[2] + other.cam_from_world.rotation[2]
    if np.linalg.norm(np.cross(baseline, forward)) <= 1e-6 * length:
        return None  # one view stands before the other, or where it stands
    x = baseline / length
    z = forward - (forward @ x) * x
    z /= np.linalg.norm(z)
    rotation = np.stack([x, np.cross(z, x), z])
    depth = (np.asarray(points, np.float64) - view.center_in_world) @ z
    depth = depth[depth > 0]
    boxes = [_plane_box(v, rotation, tolerances=tolerances) for v in (view, other)]
    low, high = np.maximum(boxes[0][0], boxes[1][0]), np.minimum(boxes[0][1], boxes[1][1])
    if len(depth) < tolerances.min_shared_points or not high[1] > low[1]:
        return None
    focal = view.camera.mean_focal_px
    far, near = focal * length / np.percentile(depth, tolerances.range_percentiles[::-1])
    margin = tolerances.range_margin * (near - far) + 4 * KEYPOINT_SIGMA_PX
    lowest = max(far - margin, 0.0)
    num = 16 * int(np.ceil((near + margin - lowest) / 16))
    if num > tolerances.max_disparities:
        return None
    left = PinholeCamera(
        width=num + int(np.ceil(focal * (boxes[0][1][0] - boxes[0][0][0]))),
        height=int(np.ceil(focal * (high[1] - low[1]))),
        fx=focal,
        fy=focal,
        cx=num - focal * boxes[0][0][0],  # matches end where their disparity leaves the image
        cy=-focal * low[1],
    )
    return RectifiedPair(rotation, left, replace(left, cx=left.cx + lowest), length, num)


def _plane_box(
    view: View, rect_from_world: Array, *, tolerances: SurroundingsTolerances
) -> tuple[Array, Array]:
    """Lowest and highest ``(x, y) / z`` of a view's rays in the rectified frame."""
    size = view.camera.width, view.camera.height
    grid = np.stack(np.meshgrid(*2 * [np.linspace(0, 1, 33)]), axis=-1).reshape(-1, 2)
    rays = view.camera.rays(grid * size) @ (rect_from_world @ view.cam_from_world.rotation.T).T
    plane = rays[rays[:, 2] > tolerances.min_ray_z]
    plane = plane[:, :2] / plane[:, 2:]
    return plane.min(axis=0, initial=np.inf), plane.max(axis=0, initial=-np.inf)


def warp(
    image: Image,
    view: View,
    camera: PinholeCamera,
    rotation: Array,
    *,
    tolerances: SurroundingsTolerances = SurroundingsTolerances(),
) -> tuple[Image, Mask]:
    """An image of a view, resampled for a virtual camera at its centre, and its valid pixels."""
    rays = camera.rays(pixel_centers(camera.width, camera.height))
    xy = view.camera.project(rays @ (view.cam_from_world.rotation @ rotation.T).T)
    inside = in_frame(xy, view.camera.width, view.camera.height, tolerances.border_px)
    return sample_image(image, xy), inside


def match(
    pair: RectifiedPair,
    left: PhaseMap,
    right: PhaseMap,
    *,
    tolerances: SurroundingsTolerances = SurroundingsTolerances(),
) -> Image:
    """Disparities ``(H, W)`` of the left virtual camera, px, minus the pair's offset; NaN: none."""
    white = max(float(np.percentile(m.intensity, 99)) for m in (left, right))
    sides = []
    for phase_map, camera in ((left, pair.left), (right, pair.right)):
        shown = np.clip(phase_map.intensity / max(white, 1e-9), 0, 1) ** (1 / DISPLAY_GAMMA)
        grey_levels = 255 * shown.astype(np.float32)
        grey, inside = warp(
            grey_levels, phase_map.view, camera, pair.rect_from_world, tolerances=tolerances
        )
        sides.append((np.rint(grey).astype(np.uint8), inside))
    matcher = cv2.StereoSGBM.create(
        numDisparities=pair.num_disparities,
        blockSize=tolerances.block_px,
        P1=8 * tolerances.block_px**2,  # OpenCV's recommendation
        P2=32 * tolerances.block_px**2,
        disp12MaxDiff=1,
        preFilterCap=31,
        uniquenessRatio=10,
        speckleWindowSize=100,
        speckleRange=1,
    )
    disparity = matcher.compute(sides[0][0], sides[1][0]).astype(np.float32) / 16
    xy = pixel_centers(pair.left.width, pair.left.height)
    xy[..., 0] -= disparity
    matched = sample_image(sides[1][1].astype(np.float32), xy, nearest=True) > 0
    good = (
        (disparity >= 0) & sides[0][1] & matched & _is_textured(sides[0][0], tolerances=tolerances)
    )
    return np.where(good, disparity, np.nan).astype(np.float32)


def _is_textured(grey: NDArray[np.uint8], *, tolerances: SurroundingsTolerances) -> Mask:
    """Where an image varies by more than noise; elsewhere a match only continues others."""
    image, size = grey.astype(np.float32), (2 * tolerances.border_px + 1,) * 2
    variance = cv2.boxFilter(image * image, -1, size) - cv2.boxFilter(image, -1, size) ** 2
    return np.asarray(variance > tolerances.min_texture**2)


def ranges_from_disparity(
    pair: RectifiedPair,
    disparity: Image,
    rays_in_world: Floats,
    *,
    tolerances: SurroundingsTolerances = SurroundingsTolerances(),
) -> tuple[Image, Image]:
    """Distances of the left view's rays, and their relative deviations.

    Parameters
    ----------
    disparity : as from :func:`match`.
    rays_in_world : (..., 3), unit, world axes.
    tolerances : of this step.

    Returns
    -------
    (...) float32 each; the distance is 0 where no disparity is known, or where those of the four
    pixels about the ray differ by more than their uncertainty.
    """
    rays = rays_in_world @ pair.rect_from_world.T
    xy = pair.left.project(np.where(rays[..., 2:] > 0, rays, np.nan))
    known = np.isfinite(disparity)
    filled = np.where(known, disparity, 0).astype(np.float32)
    moments = np.dstack([known.astype(np.float32), filled, filled * filled])
    share, mean, square = np.moveaxis(sample_image(moments, xy), -1, 0)
    smooth = square - mean * mean < KEYPOINT_SIGMA_PX**2
    total = mean + np.float32(pair.offset_px)
    good = (share > 0.999) & smooth & (total > 0)
    total = np.where(good, total, 1)
    depth = pair.left.fx * pair.baseline / total
    distance = np.where(good, depth / np.where(good, rays[..., 2], 1), 0)
    return distance.astype(np.float32), (KEYPOINT_SIGMA_PX / total).astype(np.float32)


def combine_ranges(ranges: Image, sigmas: Image) -> tuple[Image, Image]:
    """One range of each pixel from those of several pairs ``(P, h, w)``, and its deviation.

    It is the weighted mean of the largest group that agrees within two deviations; 0 if there are
    several ranges and no two agree.
    """
    known = ranges > 0
    log_range = np.log(np.where(known, ranges, 1), dtype=np.float64)
    weight = np.where(known, 1 / sigmas.astype(np.float64) ** 2, 0)
    best = np.zeros(ranges.shape[1:])
    place, lone = np.zeros(ranges.shape[1:]), known.sum(axis=0) < 2
    for i in range(len(ranges)):
        limit = 2 * np.hypot(sigmas, sigmas[i])
        agrees = known & known[i] & (np.abs(log_range - log_range[i]) < limit)
        total = np.where((agrees.sum(axis=0) >= 2) | lone, (weight * agrees).sum(axis=0), 0)
        mean = (weight * agrees * log_range).sum(axis=0) / np.maximum(total, 1e-300)
        place = np.where(total > best, mean, place)
        best = np.maximum(best, total)
    found = best > 0
    sigma = np.where(found, 1 / np.sqrt(np.where(found, best, 1)), 0)
    return np.where(found, np.exp(place), 0).astype(np.float32), sigma.astype(np.float32)


def fit_planes(
    inverse_ranges: Floats,
    rays: Floats,
    *,
    tolerances: SurroundingsTolerances = SurroundingsTolerances(),
) -> tuple[Array, Array]:
    """Planes about every lattice point; on a plane the inverse range is linear in the ray.

    Parameters
    ----------
    inverse_ranges : (h, w), 0 where unknown.
    rays : (h, w, 3), unit.
    tolerances : of this step.

    Returns
    -------
    slope : (h, w, 3), the plane's normal, pointing away from the camera, over its distance from
        it; ``1 / range = slope . ray``. NaN where too little of the window is known.
    deviation : (h, w), RMS of the window's inverse ranges from the plane, relative to the centre's.
    """
    known = (inverse_ranges > 0) & np.isfinite(rays).all(axis=-1)
    v = np.where(known[..., None], rays, 0.0).astype(np.float64)
    u = np.where(known, inverse_ranges, 0.0).astype(np.float64)
    outer = (v[..., :, None] * v[..., None, :]).reshape(*known.shape, 9)
    columns = [outer, v * u[..., None], (u * u)[..., None], known[..., None].astype(np.float64)]
    moments, border = np.concatenate(columns, axis=-1), cv2.BORDER_CONSTANT
    sums = cv2.boxFilter(
        moments, -1, (tolerances.block_px, tolerances.block_px), normalize=False, borderType=border
    )
    used = known & (sums[..., 13] >= tolerances.min_window_share * tolerances.block_px**2 - 0.5)
    matrix, right = sums[used, :9].reshape(-1, 3, 3), sums[used, 9:12]
    solved = np.linalg.solve(matrix, right[..., None])[..., 0]
    residual = sums[used, 12] - (solved * right).sum(axis=-1)
    freedom = np.maximum(sums[used, 13] - 3, 1)
    slope, deviation = np.full((*known.shape, 3), np.nan), np.full(known.shape, np.nan)
    slope[used] = solved
    deviation[used] = np.sqrt(np.maximum(residual, 0) / freedom) / u[used]
    return slope, deviation


def stereo_view(
    phase_map: PhaseMap,
    partners: Sequence[PhaseMap],
    points: Floats,
    part: Mask,
    stride_px: int,
    *,
    tolerances: SurroundingsTolerances = SurroundingsTolerances(),
) -> DenseView:
    """Ranges and normals of one view's pixels, matched with its partners.

    Parameters
    ----------
    phase_map : of the view; its intensity is matched.
    partners : of the views to match it with.
    points : (N, 3), world, that the view sees; they bound the depths to search.
    part : (H, W) bool, pixels to ignore: polarized parts with a margin.
    stride_px : of the lattice.
    tolerances : of this step.
    """
    view = phase_map.view
    shape = view.camera.height // stride_px, view.camera.width // stride_px
    xy = lattice_xy(*shape, stride_px)
    rays = view.rays_in_world(xy)
    found = []
    for partner in partners:
        pair = rectify_pair(view, partner.view, points, tolerances=tolerances)
        if pair is not None:
            found.append(
                ranges_from_disparity(
                    pair,
                    match(pair, phase_map, partner, tolerances=tolerances),
                    rays,
                    tolerances=tolerances,
                )
            )
    found.append((np.zeros(shape, np.float32), np.ones(shape, np.float32)))  # if there is no pair
    ranges, sigma = combine_ranges(*(np.stack(kind) for kind in zip(*found, strict=True)))
    ranges[sample_image(part.astype(np.float32), xy, nearest=True) > 0] = 0
    return _on_planes(ranges, sigma, rays, view, stride_px, tolerances=tolerances)


def _on_planes(
    ranges: Image,
    sigma: Image,
    rays: Array,
    view: View,
    stride_px: int,
    *,
    tolerances: SurroundingsTolerances,
) -> DenseView:
    """Ranges moved onto the planes through their windows, where a plane explains the window."""
    inverse = 1 / np.where(ranges > 0, ranges, np.inf)
    slope, deviation = fit_planes(inverse, rays, tolerances=tolerances)
    length = np.linalg.norm(slope, axis=-1)
    with np.errstate(invalid="ignore", divide="ignore"):
        fitted = 1 / (slope * rays).sum(axis=-1)
        cosine = 1 / (fitted * length)
        good = (np.abs(fitted / ranges - 1) < 2 * sigma) & (deviation < 2 * sigma)
        good &= cosine > MIN_FACING_COSINE  # steeper ones are jumps of the range
        # The normal of a plane through errors of the window's points, seen under this angle.
        spread = tolerances.block_px * stride_px / np.sqrt(12) / view.camera.mean_focal_px
        turn = deviation / (tolerances.block_px * spread) * cosine**2
    normals = np.where(good[..., None], -slope / length[..., None], np.nan)
    return DenseView(
        stride_px=stride_px,
        range_map=np.where(good, fitted, 0).astype(np.float32),
        normals_in_world=normals.astype(np.float32),
        sigma_deg=np.where(good, np.degrees(turn), np.nan).astype(np.float32),
        sigma=np.where(good, sigma * ranges, np.nan).astype(np.float32),
        confidence=good.astype(np.float32),
    )
