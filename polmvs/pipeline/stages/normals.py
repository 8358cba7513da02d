"""Stage ``normals_MODEL``: normals of the sparse points under an angle model."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.models import read_model
from polmvs.config import NormalOptions
from polmvs.io.arrays import map_array, save_array
from polmvs.normals.mixture_estimator import MixtureEstimate
from polmvs.normals.tracks import MAX_ROWS, track_normals
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages.maps import open_maps
from polmvs.polarization.kinds import AngleModel, Light

# Columns of the stored normals, one row for each track; see MixtureEstimate.
NORMALS_TYPE = np.dtype(
    [
        ("normal", np.float64, 3),
        ("valid", np.bool_),
        ("conditioning", np.float64),
        ("sigma_deg", np.float64),
        ("residual", np.float64),
        ("num_rows", np.int64),
        ("specular", np.float64),
        ("diffuse", np.float64),
        ("dolp", np.float64),
    ]
)


@dataclass(frozen=True, kw_only=True)
class NormalsResult:
    """Result of the stage.

    Attributes
    ----------
    num_tracks : sparse points.
    num_normals : those with a normal.
    """

    num_tracks: int
    num_normals: int

    def __str__(self) -> str:
        return f"{self.num_normals:,} of {self.num_tracks:,} sparse points have a normal"


def solve_track_normals(
    model: AngleModel,
    folder: RunFolder,
    options: NormalOptions,
    light: Light | None = None,
    *,
    max_rows: int = MAX_ROWS,
) -> NormalsResult:
    """Normals of the sparse points from the phases of all views that see them.

    Parameters
    ----------
    model : angle model.
    folder : of a run with model and phase maps; one row of ``NORMALS_TYPE`` is written for each
        track.
    options : of the estimator.
    light : kind of light of all observations, if known.
    max_rows : rows of points and views that are solved at a time.
    """
    tracks, target = read_model(folder.sparse).tracks, folder.track_normals(model)
    phase_maps = open_maps(folder, model)
    stored = np.zeros(len(tracks.point3D_ids), NORMALS_TYPE)
    if len(stored):
        if model.is_textbook:
            options = replace(options, tilt_aware_weights=False)
        estimate = track_normals(
            model.formula, tracks, phase_maps, options, light, max_rows=max_rows
        )
        for name in NORMALS_TYPE.names or ():
            stored[name] = getattr(estimate, "normals" if name == "normal" else name)
    target.parent.mkdir(exist_ok=True)
    save_array(target, stored)
    return NormalsResult(num_tracks=len(stored), num_normals=int(stored["valid"].sum()))


def load_track_normals(folder: RunFolder, model: AngleModel) -> MixtureEstimate:
    """The normals that :func:`solve_track_normals` stored; they have no data of single rows.

    Raises
    ------
    DataError
        The file is missing or damaged.
    """
    stored: NDArray[np.void] = np.array(map_array(folder.track_normals(model), NORMALS_TYPE))
    scalars = {name: stored[name].copy() for name in NORMALS_TYPE.names or () if name != "normal"}
    none = np.zeros((0, len(stored)))
    return MixtureEstimate(
        normals=np.ascontiguousarray(stored["normal"]),
        row_weights=none,
        labels=none,
        log_likelihood=np.full(len(stored), np.nan),
        **scalars,
    )
