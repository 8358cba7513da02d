"""Stage ``silhouettes``: the outline of the objects in each view, for the surface of all views.

All angle models share them.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from polmvs.config import default_num_workers
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.pipeline.run_folder import RunFolder, replacing
from polmvs.pipeline.stages.maps import open_maps
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.surface.silhouettes import find_silhouette, open_silhouette, store_silhouette
from polmvs.surface.surface_view import SurfaceView, surface_view


@dataclass(frozen=True, kw_only=True)
class SilhouettesResult:
    """Result of the stage.

    Attributes
    ----------
    num_silhouettes : views with pixels of an object.
    """

    num_silhouettes: int

    def __str__(self) -> str:
        return f"{self.num_silhouettes} views show an object"


def find_silhouettes(
    run_folder: RunFolder,
    *,
    masks_given: bool,
    workers: Workers,
    on_progress: OnProgress = no_progress,
) -> SilhouettesResult:
    """Find and store the silhouette of every posed view.

    Parameters
    ----------
    run_folder : with the phase maps; the silhouettes are written whole or not at all.
    masks_given : the maps' regions are the user's masks.
    """
    maps = open_maps(run_folder, AngleModel.PPA)
    num = 0
    with replacing(run_folder.silhouettes) as folder, workers.stopped_on_error():
        for shows_object in workers.map(partial(_find, folder, masks_given), maps):
            num += shows_object
            on_progress(1)
    return SilhouettesResult(num_silhouettes=num)


def _find(folder: Path, mask_given: bool, phase_map: PhaseMap) -> bool:
    found = find_silhouette(phase_map, mask_given=mask_given)
    store_silhouette(found, folder, phase_map.view.name)
    return bool(found.certain.any())


def open_surface_views(
    run_folder: RunFolder, maps: Sequence[PhaseMap], *, folder: Path | None = None
) -> list[SurfaceView]:
    """The views of phase maps with their silhouettes.

    Parameters
    ----------
    folder : for derived arrays; None: in memory.

    Raises
    ------
    DataError
        A silhouette is missing or damaged.
    """

    def look_at(phase_map: PhaseMap) -> SurfaceView:
        silhouette = open_silhouette(run_folder.silhouettes, phase_map.view.name)
        return surface_view(phase_map, silhouette, folder=folder)

    # Threads, as nearly all of the work is OpenCV's.
    with ThreadPoolExecutor(default_num_workers()) as pool:
        return list(pool.map(look_at, maps))
