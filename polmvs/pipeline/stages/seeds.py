"""Stage ``seeds``: the points of known place from which surfaces grow, one set for all models.

They are the sparse points that lie on a polarised surface, and points on parts that have none,
placed by their outlines. PPA chooses them, so that a comparison of models starts from the same.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.models import read_model
from polmvs.config import AngleModel, NormalOptions
from polmvs.errors import DataError
from polmvs.io.arrays import map_array, save_array
from polmvs.normals.tracks import select_seeds
from polmvs.parallel import Workers
from polmvs.pipeline.monitor import OnProgress, no_progress
from polmvs.pipeline.stages.maps import open_maps
from polmvs.pipeline.stages.normals import load_track_normals
from polmvs.scene import Seeds
from polmvs.surface.parts import PartReport, contradicted, find_part_seeds

logger = logging.getLogger(__name__)

NO_TRACK = -1
# Columns of the stored seeds: those of tracks, by track, then those of parts without any.
SEEDS_TYPE = np.dtype(
    [
        ("point", np.float64, 3),
        ("normal", np.float64, 3),  # under PPA
        ("sigma", np.float64),
        ("track", np.int64),  # index of the sparse point, or NO_TRACK
    ]
)


@dataclass(frozen=True, kw_only=True)
class SeedsResult:
    """What the stage found.

    Attributes
    ----------
    num_track_seeds : sparse points that are seeds.
    num_part_seeds : seeds on parts without sparse points.
    parts : what was found about each of these parts.
    """

    num_track_seeds: int
    num_part_seeds: int
    parts: tuple[PartReport, ...]

    def __str__(self) -> str:
        text = f"{self.num_track_seeds:,} sparse points are seeds"
        return text + (f", {self.num_part_seeds:,} more by outlines" if self.num_part_seeds else "")


def find_seeds(
    sparse: Path,
    maps: Path,
    track_normals: Path,
    target: Path,
    *,
    options: NormalOptions | None = None,
    max_neighbors: int,
    workers: Workers | None = None,
    on_progress: OnProgress = no_progress,
) -> SeedsResult:
    """Choose the seeds among the sparse points, and place the parts that have none.

    Parameters
    ----------
    sparse, maps : folders of the COLMAP model and of PPA's phase maps.
    track_normals : file of PPA's normals of the sparse points.
    target : file of the seeds, ``.npy`` with rows of ``SEEDS_TYPE``.
    options : whether and how parts without sparse points are placed; defaults where None.
    max_neighbors : other views that give rows to the view of a part.
    """
    options, workers = options or NormalOptions(), workers or Workers()
    tracks = read_model(sparse).tracks
    phase_maps = open_maps(sparse, maps)
    if not len(tracks.point3D_ids):
        _save(target, np.zeros(0, SEEDS_TYPE))
        return SeedsResult(num_track_seeds=0, num_part_seeds=0, parts=())
    seeds, is_seed = select_seeds(tracks, load_track_normals(track_normals), phase_maps)
    on_tracks = _rows(seeds, np.flatnonzero(is_seed))
    on_parts = np.zeros(0, SEEDS_TYPE)
    reports: tuple[PartReport, ...] = ()
    if options.unseeded:
        new, found = find_part_seeds(
            AngleModel.PPA,
            phase_maps,
            seeds,
            tracks.points_in_world,
            max_neighbors=max_neighbors,
            tilt_aware=options.tilt_aware_weights,
            workers=workers,
            on_progress=on_progress,
        )
        reports = tuple(found)
        on_parts = _rows(new, np.full(len(new.sigma), NO_TRACK))
        on_parts["sigma"] = _shared_sigma(new)
        dropped = contradicted(seeds, new)
        if dropped.any():
            logger.warning(
                "%d sparse points contradict the outlines and are no seeds.", dropped.sum()
            )
        on_tracks = on_tracks[~dropped]
    _warn_of_doubts([part for part in reports if part.doubt])
    _save(target, np.concatenate([on_tracks, on_parts]))
    return SeedsResult(num_track_seeds=len(on_tracks), num_part_seeds=len(on_parts), parts=reports)


def load_seeds(model: AngleModel, source: Path, track_normals: Path) -> Seeds:
    """Seeds with the normals of a model; which points they are is the same for all models.

    Parameters
    ----------
    source : file that :func:`find_seeds` wrote.
    track_normals : file of the model's normals of the sparse points.

    Raises
    ------
    DataError
        A file is missing or damaged.
    """
    stored: NDArray[np.void] = np.array(map_array(source, SEEDS_TYPE))
    normals = np.array(stored["normal"])
    on_track = stored["track"] != NO_TRACK
    solved = load_track_normals(track_normals).normals
    _require_tracks(source, stored["track"], len(solved))
    if model is not AngleModel.PPA:
        normals[~on_track] = np.nan  # each model solves its own
    normals[on_track] = solved[stored["track"][on_track]]
    return Seeds(np.array(stored["point"]), normals, np.array(stored["sigma"]))


def seed_tracks(source: Path, num_tracks: int) -> NDArray[np.bool_]:
    """Which of the sparse points ``(num_tracks,)`` are seeds.

    Raises
    ------
    DataError
        The file is missing or damaged.
    """
    track = np.asarray(map_array(source, SEEDS_TYPE)["track"])
    _require_tracks(source, track, num_tracks)
    is_seed = np.zeros(num_tracks, np.bool_)
    is_seed[track[track != NO_TRACK]] = True
    return is_seed


def _require_tracks(source: Path, track: NDArray[np.int64], num_tracks: int) -> None:
    """Refuse seeds of other sparse points."""
    if len(track) and not (track.min() >= NO_TRACK and track.max() < num_tracks):
        raise DataError(source, "is not of these sparse points; run again with `run.overwrite`.")


def _warn_of_doubts(parts: Sequence[PartReport]) -> None:
    """One line for all parts without a place, by the largest of them; the log has the others."""
    if not parts:
        return
    first, *others = sorted(parts, key=lambda part: -part.num_px)
    also = ""
    if others:
        also = f" (and {len(others)} smaller part{'s' * (len(others) > 1)}; see the log)"
    logger.warning(
        "%s: a part of %d px without a sparse point stays undetermined: %s%s.",
        first.view,
        first.num_px,
        first.doubt,
        also,
    )
    for part in others:
        logger.info("%s: so does one of %d px: %s.", part.view, part.num_px, part.doubt)


def _rows(seeds: Seeds, track: NDArray[np.int64]) -> NDArray[np.void]:
    rows = np.zeros(len(seeds.sigma), SEEDS_TYPE)
    rows["point"], rows["normal"] = seeds.points_in_world, seeds.normals_in_world
    rows["sigma"], rows["track"] = seeds.sigma, track
    return rows


def _save(target: Path, rows: NDArray[np.void]) -> None:
    target.parent.mkdir(exist_ok=True)
    save_array(target, rows)


def _shared_sigma(seeds: Seeds) -> NDArray[np.float64]:
    """Deviations that make seeds which err as one weigh as one.

    All seeds of a part have the same deviation, and one part's is hardly another's.
    """
    _, part, count = np.unique(seeds.sigma, return_inverse=True, return_counts=True)
    return np.asarray(seeds.sigma * np.sqrt(count[part]))
