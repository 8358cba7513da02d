"""Stage ``seeds``: the sparse points on a polarized surface, which give its distance.

All models use one set, which PPA chooses, so that they are compared from the same seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.models import read_model
from polmvs.errors import DataError
from polmvs.io.arrays import MADE_AGAIN, map_array, save_array
from polmvs.normals.tracks import select_seeds
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages.maps import open_maps
from polmvs.pipeline.stages.normals import load_track_normals
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import Seeds, Tracks, View, point_sigmas

SEEDS_TYPE = np.dtype(
    [
        ("point", np.float64, 3),
        ("sigma", np.float64),
        ("track", np.int64),  # index of the sparse point
    ]
)


@dataclass(frozen=True, kw_only=True)
class SeedsResult:
    """Result of the stage.

    Attributes
    ----------
    num_seeds : sparse points that are seeds.
    """

    num_seeds: int

    def __str__(self) -> str:
        return f"{self.num_seeds:,} sparse points are seeds"


def find_seeds(folder: RunFolder) -> SeedsResult:
    """Choose the seeds among the sparse points.

    Parameters
    ----------
    folder : of a run with model, PPA's phase maps and PPA's normals of the sparse points; rows of
        ``SEEDS_TYPE`` are written.
    """
    tracks = read_model(folder.sparse).tracks
    rows = np.zeros(0, SEEDS_TYPE)
    if len(tracks.point3D_ids):
        normals = load_track_normals(folder, AngleModel.PPA)
        seeds, is_seed = select_seeds(tracks, normals, open_maps(folder, AngleModel.PPA))
        rows = np.zeros(len(seeds.sigma), SEEDS_TYPE)
        rows["point"], rows["sigma"] = seeds.points_in_world, seeds.sigma
        rows["track"] = np.flatnonzero(is_seed)
    folder.seeds.parent.mkdir(exist_ok=True)
    save_array(folder.seeds, rows)
    return SeedsResult(num_seeds=len(rows))


def load_seeds(folder: RunFolder, model: AngleModel) -> Seeds:
    """Seeds with the normals of a model; all models have the same points.

    Raises
    ------
    DataError
        A file is missing or damaged.
    """
    stored: NDArray[np.void] = np.array(map_array(folder.seeds, SEEDS_TYPE))
    solved = load_track_normals(folder, model).normals
    _require_tracks(folder.seeds, stored["track"], len(solved))
    return Seeds(np.array(stored["point"]), solved[stored["track"]], np.array(stored["sigma"]))


def load_points(
    folder: RunFolder, model: AngleModel, tracks: Tracks, views: Sequence[View]
) -> Seeds:
    """All sparse points with the normals of a model; NaN where none is known.

    Parameters
    ----------
    folder : of a run with normals of the sparse points.
    model : angle model.
    tracks, views : of the run's model, all of them.

    Raises
    ------
    DataError
        A file is missing or damaged.
    """
    estimate = load_track_normals(folder, model)
    normals = np.where(estimate.valid[:, None], estimate.normals, np.nan)
    return Seeds(tracks.points_in_world, normals, point_sigmas(tracks, views))


def seed_tracks(source: Path, num_tracks: int) -> NDArray[np.bool_]:
    """Whether sparse points ``(num_tracks,)`` are seeds.

    Raises
    ------
    DataError
        The file is missing or damaged.
    """
    track = np.asarray(map_array(source, SEEDS_TYPE)["track"])
    _require_tracks(source, track, num_tracks)
    is_seed = np.zeros(num_tracks, np.bool_)
    is_seed[track] = True
    return is_seed


def _require_tracks(source: Path, track: NDArray[np.int64], num_tracks: int) -> None:
    """Refuse seeds of other sparse points."""
    if len(track) and not (track.min() >= 0 and track.max() < num_tracks):
        raise DataError(source, f"is not of these sparse points. {MADE_AGAIN}")
