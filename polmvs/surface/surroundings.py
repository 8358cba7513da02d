"""What lies about the polarised parts: which sparse points to keep, and which views to pair.

The surroundings are textured and unpolarised, so that matching features and patches works there
and on the parts it does not: a glossy surface shows mirror images, which make sparse points as
good as any, behind it. Where a view shows a part is known, and what is seen there is left out.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.config import FusionOptions
from polmvs.parallel import Workers
from polmvs.polarization.phase_map import PhaseMap, open_phase_map
from polmvs.scene import KEYPOINT_SIGMA_PX, Tracks, View, point_sigmas, some_tracks
from polmvs.surface.dense_view import DenseView, store_dense_view
from polmvs.surface.fusion import FusedCloud, fuse
from polmvs.surface.stereo import stereo_view

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

REGION_MARGIN_PX = 3  # a keypoint this near a part's outline may owe its place to the outline
MIN_OBSERVATIONS = 3  # two rays that meet say nothing about whether they belong together
MAX_PART_SHARE = 1 / 3  # of a point's observations on parts: of three, none; of four, one
MAX_RELATIVE_SIGMA = 0.005  # of a point's place, as a share of its distance
MIN_ANGLE_DEG = 5.0  # of triangulation: half a pixel of disparity is 1 % of the distance there
MAX_ANGLE_DEG = 25.0  # of triangulation: patches of slanted surfaces look too different beyond
MAX_AXIS_ANGLE_DEG = 45.0  # between the directions in which two views look
MIN_BASELINE_ANGLE_DEG = 40.0  # between baseline and views: an epipole in the image is no use
PART_MARGIN_PX = 8  # by which a match may leak over a part's outline: a patch and its neighbours
MAX_NORMAL_DIFFERENCE_DEG = 30.0  # of two views; planes of ten pixels' disparities are uncertain
MIN_SHARED_POINTS = 20  # of two views, for their angle to be known and their overlap to be worth it


@dataclass(frozen=True)
class SparseSurroundings:
    """Sparse points that lie on no polarised part.

    Attributes
    ----------
    points : (N, 3) float64, world frame.
    colors : (N, 3) uint8
    num_views : (N,) int32, observations of each point.
    is_kept : (T,) bool, which of the tracks they are.
    """

    points: Array
    colors: NDArray[np.uint8]
    num_views: NDArray[np.int32]
    is_kept: Mask


def sparse_surroundings(
    tracks: Tracks,
    maps: Sequence[PhaseMap],
    *,
    max_part_share: float = MAX_PART_SHARE,
    max_relative_sigma: float = MAX_RELATIVE_SIGMA,
    margin_px: int = REGION_MARGIN_PX,
) -> SparseSurroundings:
    """Sparse points that are certain in place and neither on a polarised part nor mirrored in one.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``.
    maps : phase maps of the views.
    max_part_share : points of which a larger share of the observations lies on parts are left
        out: they are on the part, which has its own cloud, or mirror images behind it.
    max_relative_sigma : points are left out whose place is less certain than this share of their
        mean distance from the cameras, along the worst axis.
    margin_px : the parts' regions are grown by this, px.
    """
    part_share = part_shares(tracks, maps, margin_px)
    num_views = np.bincount(tracks.obs_track, minlength=len(part_share))
    sigma = relative_sigmas(tracks, [phase_map.view for phase_map in maps])
    kept = (
        (num_views >= MIN_OBSERVATIONS)
        & (part_share <= max_part_share)
        & (sigma <= max_relative_sigma)
    )
    return SparseSurroundings(
        points=tracks.points_in_world[kept],
        colors=tracks.colors[kept],
        num_views=num_views[kept].astype(np.int32),
        is_kept=kept,
    )


def part_shares(
    tracks: Tracks, maps: Sequence[PhaseMap], margin_px: int = REGION_MARGIN_PX
) -> Array:
    """Share ``(T,)`` of each track's observations in or beside a region; 1 without any."""
    num_tracks = len(tracks.points_in_world)
    on_part = np.zeros(len(tracks.obs_track), bool)
    for k, phase_map in enumerate(maps):
        here = tracks.obs_view == k
        grown = grow_mask(phase_map.region.inside, margin_px).astype(np.float32)
        on_part[here] = sample_image(grown, tracks.obs_xy[here], nearest=True) > 0
    count = np.bincount(tracks.obs_track, minlength=num_tracks)
    hits = np.bincount(tracks.obs_track, on_part, num_tracks)
    return np.where(count > 0, hits / np.maximum(count, 1), 1.0)


def grow_mask(mask: Mask, margin_px: int) -> Mask:
    """The mask and all that is within the margin of it, in rows, columns and diagonals, px."""
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def relative_sigmas(tracks: Tracks, views: Sequence[View]) -> Array:
    """Standard deviation ``(T,)`` of the points' places as shares of their mean distances.

    That of the geometry of rays, larger where the reprojection error shows worse keypoints than
    are usual. Infinite for points with fewer than two observations.
    """
    num_tracks = len(tracks.points_in_world)
    count = np.bincount(tracks.obs_track, minlength=num_tracks)
    total = np.zeros(num_tracks)
    for k, view in enumerate(views):
        seen = tracks.obs_track[tracks.obs_view == k]
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
    tracks: Tracks, views: Sequence[View], max_partners: int = 3
) -> list[list[int]]:
    """For each view the views to match it with, those with the most points in common first.

    Partners see the shared points under a useful angle of triangulation, look into a similar
    direction and stand beside the view rather than before or behind it. A view may have none.

    Parameters
    ----------
    tracks : points to go by; ``obs_view`` counts in ``views``.
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
            and shared[a, b] >= MIN_SHARED_POINTS
            and _fits(view, views[b], tracks.points_in_world[sees[a] & sees[b]])
        ]
        partners.append([int(b) for b in candidates[:max_partners]])
    return partners


def _fits(view: View, other: View, points: Array) -> bool:
    """Whether two views can be matched, by their poses and the points that both see."""
    axes = view.cam_from_world.rotation[2], other.cam_from_world.rotation[2]
    baseline = other.center_in_world - view.center_in_world
    if not np.linalg.norm(baseline) > 0 or _angle_deg(*axes) > MAX_AXIS_ANGLE_DEG:
        return False
    to_baseline = float(_angle_deg(baseline, axes[0] + axes[1]))
    if not MIN_BASELINE_ANGLE_DEG <= to_baseline <= 180 - MIN_BASELINE_ANGLE_DEG:
        return False
    angles = _angle_deg(points - view.center_in_world, points - other.center_in_world)
    return bool(MIN_ANGLE_DEG <= np.median(angles) <= MAX_ANGLE_DEG)


def _angle_deg(a: Array, b: Array) -> Array:
    """Angles between vectors ``(..., 3)``, degrees."""
    sine = np.linalg.norm(np.cross(a, b), axis=-1)
    return np.asarray(np.degrees(np.arctan2(sine, (a * b).sum(axis=-1))))


@dataclass(frozen=True)
class _WholeView(PhaseMap):
    """A view that may show a surface at any pixel, so that fusing takes no part for background."""

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
    stride_px: int = 2,
    max_partners: int = 3,
    min_views: int = 3,
    voxel_px: float = 1.0,
    workers: Workers | None = None,
    on_progress: Callable[[int], None] | None = None,
) -> FusedCloud:
    """Dense cloud of the textured surroundings of the polarised parts, from pairs of views.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``. They choose the pairs and bound the
        depths.
    maps : phase maps of the views.
    folder : where the views' ranges are kept meanwhile; the caller removes it.
    stride_px : distance between matched pixels of a view, px.
    max_partners : views that each view is matched with.
    min_views : views that must agree on a point, its own included.
    voxel_px : edge of the merging voxel, in footprints of a pixel.
    workers : processes to share the views among; None: this one.
    on_progress : called with the number of views done, twice for each view with points.
    """
    workers = workers or Workers(1)
    folder.mkdir(parents=True, exist_ok=True)
    kept = sparse_surroundings(tracks, maps).is_kept
    certain = some_tracks(tracks, kept)
    chosen = choose_partners(certain, [m.view for m in maps], max_partners)
    used = [k for k, partners in enumerate(chosen) if partners]
    task = partial(_match_view, folder, stride_px)
    groups = [[maps[k], *(maps[j] for j in chosen[k])] for k in used]
    dense: list[DenseView] = []
    points = [certain.points_in_world[certain.obs_track[certain.obs_view == k]] for k in used]
    for done in workers.map(task, groups, points):
        dense.append(done)
        if on_progress is not None:
            on_progress(1)
    options = FusionOptions(
        min_views=min_views,
        max_normal_difference_deg=MAX_NORMAL_DIFFERENCE_DEG,
        voxel_px=voxel_px,
    )
    views = [_whole_view(maps[k]) for k in used]
    return fuse(views, dense, options, workers=workers, on_progress=on_progress)


def _match_view(folder: Path, stride_px: int, maps: Sequence[PhaseMap], points: Array) -> DenseView:
    """Match the first view with the others and store what comes of it."""
    excluded = grow_mask(maps[0].region.inside, PART_MARGIN_PX)
    dense = stereo_view(maps[0], maps[1:], points, excluded, stride_px)
    return store_dense_view(dense, folder / f"{maps[0].view.name}.stereo")
