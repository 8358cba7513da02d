"""Stages ``maps`` and ``maps_tilted``: where each view shows a polarized surface, and its phase.

OPA and PPA have the same maps. Those of the tilted model are corrected for the tilt of the sensor's
polarizers and have their own folder.
"""

from __future__ import annotations

import logging
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.models import read_model, read_views
from polmvs.config import RegionOptions
from polmvs.errors import DataError
from polmvs.io.images import read_mask
from polmvs.normals.axes_check import check_axes
from polmvs.normals.light import diffuse_pixels, find_diffuse_parts
from polmvs.normals.light_check import check_light
from polmvs.normals.tracks import MAX_ROWS
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.pipeline.run_folder import RunFolder, replacing
from polmvs.pipeline.stages.images import image_names
from polmvs.polarization.capture import Capture
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.mask_check import MAX_CUT_SHARE, cut_share
from polmvs.polarization.phase_map import (
    MIN_DOLP_SIGMAS,
    PhaseMap,
    as_tilted,
    build_phase_map,
    dolp_in_sigmas,
    median_strength,
    open_phase_map,
    store_phase_map,
    turned,
)
from polmvs.polarization.region import find_region
from polmvs.scene import MIN_VIEWS, Tracks, View, evenly_spread
from polmvs.surface.ground import supporting_plane
from polmvs.surface.object_search import FoundObject, find_object

logger = logging.getLogger(__name__)

MAX_CHECKED_VIEWS = 24  # for what settings they fit; a guess, their maps are held together


@dataclass(frozen=True, kw_only=True)
class MapsResult:
    """Result of the stage ``maps``.

    Attributes
    ----------
    num_region_px : pixels of all views that show a polarized surface.
    num_diffuse_px : those with diffuse light.
    complaints : settings that the phases contradict, one clause each.
    cut_share : share of the bands outside of the user's masks that is as polarized as a surface,
        mean over the views; None without masks.
    """

    num_region_px: int
    num_diffuse_px: int
    complaints: tuple[str, ...] = ()
    cut_share: float | None = None

    def __str__(self) -> str:
        return f"{self.num_region_px:,} polarized pixels, {self.num_diffuse_px:,} of them diffuse"


@dataclass(frozen=True, kw_only=True)
class TiltedMapsResult:
    """Result of the stage ``maps_tilted``.

    Attributes
    ----------
    num_maps : maps corrected for the tilt.
    """

    num_maps: int

    def __str__(self) -> str:
        return f"{self.num_maps} maps"


def build_maps(
    capture: Capture,
    run_folder: RunFolder,
    options: RegionOptions,
    *,
    max_rows: int = MAX_ROWS,
    workers: Workers,
    on_progress: OnProgress = no_progress,
) -> MapsResult:
    """Find the region of every posed view and store its phase map.

    Parameters
    ----------
    capture : raw mosaics.
    run_folder : with the sparse model; the maps are written whole or not at all.
    options : of the region, and the kind of light.
    max_rows : rows of points and views from which normals are solved at a time.

    Raises
    ------
    DataError
        Fewer than three views have a pose, or a mosaic or mask is unusable.
    """
    model = read_model(run_folder.sparse)
    views, tracks = _enough(model.views, run_folder.sparse), model.tracks
    names = image_names(capture)
    with replacing(run_folder.maps(AngleModel.PPA)) as folder, workers.stopped_on_error():
        build = partial(_build_map, capture, options, folder)
        raw_names = [names[view.name] for view in views]
        built: list[_Built] = []
        for one in workers.map(build, views, raw_names):
            built.append(one)
            on_progress(1)
        maps = [open_phase_map(view, folder) for view in views]
        if options.mask is None and (found := hidden_plane(maps, tracks)) is not None:
            again = [k for k, own in enumerate(found) if own is not None]
            rebuilt = workers.map(
                build,
                [views[k] for k in again],
                [raw_names[k] for k in again],
                [found[k] for k in again],
            )
            for k, one in zip(again, rebuilt, strict=True):
                built[k] = one
            maps = [open_phase_map(view, folder) for view in views]
        num_inside = sum(one.num_inside for one in built)
        num_diffuse = num_inside if options.light is Light.DIFFUSE else 0
        wrong = None
        if len(tracks.point3D_ids):
            # Both need all views, so they are separate tasks.
            questions: list[Callable[[], Any]] = [
                partial(_wrong_setting, capture, options.light, tracks, maps)
            ]
            if options.light is None:
                questions.append(partial(find_diffuse_parts, tracks, maps, max_rows=max_rows))
            wrong, *diffuse = workers.map(operator.call, questions)
            if wrong is not None:
                logger.warning("%s.", wrong)
            for of_views in diffuse:  # here: turned twice, should a worker be lost, it were wrong
                num_diffuse += sum(map(partial(_turn_parts, folder), maps, of_views))
    return MapsResult(
        num_region_px=num_inside,
        num_diffuse_px=num_diffuse,
        complaints=() if wrong is None else (wrong,),
        cut_share=_cut_by_masks(built),
    )


def _cut_by_masks(built: Sequence[_Built]) -> float | None:
    """Mean share of the bands outside of masks that is polarized; a warning if it is too large."""
    shares = [one.cut_share for one in built if np.isfinite(one.cut_share)]
    if not shares:
        return None
    share = float(np.mean(shares))
    if share > MAX_CUT_SHARE:
        logger.warning(
            "`region.mask`: %.0f %% of what lies along the masks, outside of them, is polarized as "
            "a surface is. Where masks end within a surface it frays and bends. Give masks of the "
            "whole object, its sides too, or none.",
            100 * share,
        )
    return share


def tilt_maps(
    run_folder: RunFolder, *, workers: Workers, on_progress: OnProgress = no_progress
) -> TiltedMapsResult:
    """Correct the phase maps of a run for tilted polarizers."""
    stored = open_maps(run_folder, AngleModel.PPA)
    with replacing(run_folder.maps(AngleModel.TILTED)) as folder, workers.stopped_on_error():
        for _ in workers.map(partial(_tilt_map, folder), stored):
            on_progress(1)
    return TiltedMapsResult(num_maps=len(stored))


def open_maps(folder: RunFolder, model: AngleModel) -> list[PhaseMap]:
    """Phase maps of all posed views of a run for an angle model; their pixels stay on disk.

    Raises
    ------
    DataError
        Fewer than three views have a pose, or a map is missing or damaged.
    """
    tilted = model is AngleModel.TILTED
    maps = folder.maps(model)
    return [open_phase_map(view, maps, tilted=tilted) for view in posed_views(folder)]


def posed_views(folder: RunFolder) -> tuple[View, ...]:
    """Views of a run's COLMAP model.

    Raises
    ------
    DataError
        There are too few views for normals.
    """
    return _enough(read_views(folder.sparse), folder.sparse)


def _enough(views: tuple[View, ...], sparse: Path) -> tuple[View, ...]:
    if len(views) < MIN_VIEWS:
        raise DataError(
            sparse,
            f"{len(views)} views with a pose; normals need {MIN_VIEWS} or more. "
            "Record more views, or give a better model with `sfm.sparse`.",
        )
    return views


def find_mask(folder: Path, image: str) -> Path:
    """The mask of an image: ``STEM.png`` or ``STEM_mask.png``.

    Raises
    ------
    DataError
        There is none.
    """
    if not folder.is_dir():
        raise DataError(folder, "no such folder of masks.")
    stem = Path(image).stem
    for name in (f"{stem}.png", f"{stem}_mask.png"):
        if (folder / name).is_file():
            return folder / name
    raise DataError(folder, f"has no mask {stem}.png or {stem}_mask.png.")


def hidden_plane(maps: Sequence[PhaseMap], tracks: Tracks) -> list[FoundObject | None] | None:
    """The object on a plane, in each view in which polarization does not show it."""
    points = tracks.points_in_world
    centers = np.array([one.view.center_in_world for one in maps])
    plane = supporting_plane(points, centers)
    if plane is None:
        return None
    found = find_object(maps, plane, tracks)
    if found is None:
        return None
    shares = [
        1.0 if hiding is None else one.region.inside[hiding.inner].mean()
        for one, hiding in zip(maps, found, strict=True)
        if hiding is None or hiding.inner.any()
    ]
    if shares and float(np.median(shares)) > 0.5:  # most of it is polarized
        return found
    # Without any phase, its outline alone would pass for a surface.
    strengths = [
        median_strength(dolp_in_sigmas(one), hiding.inner)
        for one, hiding in zip(maps, found, strict=True)
        if hiding is not None
    ]
    if (strength := float(np.median(strengths))) > MIN_DOLP_SIGMAS:
        return found
    logger.warning(
        "An object stands on the plane, but its light is hardly polarized: the median DoLP is %.1f "
        "standard deviations (needed: %.1f). Only what polarization shows is reconstructed. Expose "
        "longer, or average frames.",
        strength,
        MIN_DOLP_SIGMAS,
    )
    return None


@dataclass(frozen=True)
class _Built:
    """A view's map: the number of its region's pixels, and NaN or its mask's ``cut_share``."""

    num_inside: int
    cut_share: float


def _build_map(
    capture: Capture,
    options: RegionOptions,
    folder: Path,
    view: View,
    name: str,
    found: FoundObject | None = None,
) -> _Built:
    """Phase map of one view."""
    stokes = capture.load(name)
    mask, cut = None if found is None else found.mask, float("nan")
    if options.mask is not None:
        mask = read_mask(find_mask(options.mask, view.name), stokes.shape)
        cut = cut_share(stokes, mask, min_dolp=options.min_dolp)
    s0, s1, s2 = stokes.s0, stokes.s1, stokes.s2
    region = find_region(s0, s1, s2, stokes.valid, min_dolp=options.min_dolp, mask=mask)
    light = options.light or Light.SPECULAR
    phase_map = build_phase_map(view, stokes, region, light)
    if found is not None:
        phase_map = phase_map.changed(outline_shift=found.outline_shift)
    store_phase_map(phase_map, folder)
    return _Built(int(region.inside.sum()), cut)


def _wrong_setting(
    capture: Capture, light: Light | None, tracks: Tracks, maps: Sequence[PhaseMap]
) -> str | None:
    """Message about a setting that the planes of incidence contradict, without its full stop."""
    tracks, maps = _some_views(tracks, maps)
    axes = check_axes(tracks, maps)
    if axes.change is not None:
        return axes.message(capture.options, capture.files.kind)
    if light is not None and (check := check_light(tracks, maps, light)).contradicted:
        return check.message
    return None


def _some_views(tracks: Tracks, maps: Sequence[PhaseMap]) -> tuple[Tracks, list[PhaseMap]]:
    """Evenly spread views, as many as a check may hold at a time, with their observations."""
    chosen = evenly_spread(len(maps), MAX_CHECKED_VIEWS)
    kept = np.isin(np.arange(len(maps)), chosen)
    return tracks.in_views(kept), [maps[k] for k in chosen]


def _turn_parts(folder: Path, phase_map: PhaseMap, parts: NDArray[np.bool_]) -> int:
    """Turn the phase of a view's parts whose light is diffuse; the number of their pixels."""
    where = diffuse_pixels(phase_map, parts) if parts.any() else parts
    if where.any():
        store_phase_map(turned(phase_map, where), folder)
    return int(where.sum())


def _tilt_map(folder: Path, phase_map: PhaseMap) -> None:
    store_phase_map(as_tilted(phase_map), folder)
