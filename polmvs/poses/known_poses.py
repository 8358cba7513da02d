"""A sparse model with its poses replaced by known ones and its points triangulated again.

This is for calibrated rigs and robot arms, and for evaluation with true poses: the matches are
kept, and the cameras and points are replaced.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from polmvs.arrays import Array
from polmvs.colmap.models import match_model_to_capture, read_model, write_model
from polmvs.colmap.sfm import SfmTolerances
from polmvs.errors import DataError, OptionError
from polmvs.geometry import intersect_rays
from polmvs.io.ground_truth import read_views as read_known_views
from polmvs.scene import SparseModel, Tracks, View, match_names, some_tracks

logger = logging.getLogger(__name__)

# Mean error of a track, px: the limit of SfM, several times a keypoint's noise, below a mismatch.
MAX_ERROR_PX = SfmTolerances().max_reproj_error_px


def write_known_poses(sparse: Path, cameras: Path, new: Path) -> SparseModel:
    """Write a COLMAP model with known poses and triangulated points.

    Parameters
    ----------
    sparse : COLMAP model whose matches are used; it is not modified.
    cameras : ``cameras.json`` with ``width``, ``height`` and, for each image, ``K`` and
        ``cam_from_world`` (3x4), as in a folder of ground truth.
    new : folder of the new model, in the frame and unit of ``cameras``.

    Raises
    ------
    DataError
        A file is unusable, fewer than two images are known, or no track fits the poses.
    OptionError
        ``new`` exists.
    """
    if new.exists():
        raise OptionError(f"{new}: exists. Give another NEW_MODEL.")
    known = read_known_views(cameras)
    sparse_model = with_known_poses(read_model(sparse), known, source=cameras)
    write_model(sparse_model, new)
    return sparse_model


def with_known_poses(
    sparse_model: SparseModel, known: Mapping[str, View], *, source: str | Path = "known poses"
) -> SparseModel:
    """Replace a model's views by known ones and triangulate its tracks again.

    Parameters
    ----------
    sparse_model : of the same images; its cameras may have another size of the same aspect ratio.
    known : views by image name, all of one size; names match exactly, else by stem.
    source : their origin, for messages.

    Returns
    -------
    SparseModel
        In the frame and unit of the known poses, with their names. Unknown images and tracks that
        do not fit (:func:`retriangulate`) are left out.

    Raises
    ------
    DataError
        Fewer than two images are known, or no track fits the poses.
    """
    names = [view.name for view in sparse_model.views]
    num_known = len(match_names(names, known))
    if num_known < 2:
        raise DataError(
            source,
            f"knows {num_known} of the {len(names)} images of the model, 2 are needed; its names "
            f"are like {next(iter(known), '')!r}, the model's like {names[0]!r}.",
        )
    camera = next(iter(known.values())).camera
    fitted = match_model_to_capture(
        sparse_model, list(known), camera.width, camera.height, source=source
    )
    views = tuple(known[view.name] for view in fitted.views)
    tracks = retriangulate(views, fitted.tracks)
    num_tracks, num_before = len(tracks.point3D_ids), len(sparse_model.tracks.point3D_ids)
    if num_tracks == 0:
        raise DataError(
            source,
            f"none of the model's {num_before} tracks fits its poses; cam_from_world takes points "
            "of the world to the camera (x right, y down, z forward), K is of the given size.",
        )
    logger.info("%d of %d tracks fit the known poses.", num_tracks, num_before)
    return replace(fitted, views=views, tracks=tracks)


def retriangulate(views: Sequence[View], tracks: Tracks) -> Tracks:
    """Triangulate tracks from their observations, all tracks at once.

    Parameters
    ----------
    views : that ``tracks.obs_view`` counts in.
    tracks : whose points and errors do not matter.

    Returns
    -------
    Tracks
        With new points and errors. Those seen once, from one place or under parallel rays, with
        a mean error above ``MAX_ERROR_PX`` or behind a camera that observes them are dropped.
    """
    points = _intersect(views, tracks)
    errors = _mean_errors(views, points, tracks)
    good = errors <= MAX_ERROR_PX  # not where NaN
    return some_tracks(replace(tracks, points_in_world=points, errors=errors), good)


def _intersect(views: Sequence[View], tracks: Tracks) -> Array:
    """Points ``(T, 3)`` nearest to the rays of each track; NaN where they are undetermined."""
    centers, rays = np.zeros((2, len(tracks.obs_view), 3))
    for view, own in zip(views, tracks.of_views(len(views)), strict=True):
        centers[own] = view.center_in_world
        rays[own] = view.rays_in_world(tracks.obs_xy[own])
    points = np.full((len(tracks.point3D_ids), 3), np.nan)
    # Tracks of equally many observations make a batch; their rays lie together once sorted.
    order = np.argsort(tracks.obs_track, kind="stable")
    count = np.bincount(tracks.obs_track, minlength=len(points))
    first = np.cumsum(count) - count
    for num in np.unique(count[count >= 2]):
        batch = np.flatnonzero(count == num)
        obs = order[first[batch][:, None] + np.arange(num)]
        points[batch] = intersect_rays(centers[obs], rays[obs])
    return points


def _mean_errors(views: Sequence[View], points: Array, tracks: Tracks) -> Array:
    """Mean reprojection error ``(T,)``, px; NaN where a view does not see the point."""
    errors = np.zeros(len(tracks.obs_view))
    for view, own in zip(views, tracks.of_views(len(views)), strict=True):
        xy = view.project(points[tracks.obs_track[own]])
        errors[own] = np.linalg.norm(xy - tracks.obs_xy[own], axis=1)
    count = np.bincount(tracks.obs_track, minlength=len(points))
    total = np.bincount(tracks.obs_track, errors, len(points))
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)
