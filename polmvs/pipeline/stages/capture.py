"""The stages from a capture to phase maps.

Each reads what the stage before wrote. Every function writes whole files or folders only and
returns what it found, in numbers. Their order is in :mod:`polmvs.pipeline.jobs`, their record and
how
a run goes on in :mod:`polmvs.pipeline.run`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from polmvs.colmap.models import match_model_to_capture, read_model, write_model
from polmvs.colmap.sfm import run_sfm
from polmvs.config import AngleModel, Light, ReferenceOptions, RegionOptions, SfmOptions
from polmvs.errors import DataError
from polmvs.io.images import read_gray, read_mask, write_png
from polmvs.normals.light import find_diffuse
from polmvs.parallel import Workers
from polmvs.pipeline.run_folder import RunFolder
from polmvs.polarization.capture import Capture, intensity_image_8bit
from polmvs.polarization.phase_map import (
    PhaseMap,
    as_tilted,
    build_phase_map,
    open_phase_map,
    store_phase_map,
    turned,
)
from polmvs.polarization.region import find_region
from polmvs.poses.metric_frame import metric_frame, transform_model
from polmvs.scene import SparseModel, Tracks, View, short_list

logger = logging.getLogger(__name__)

Facts = dict[str, Any]
Report = Callable[[int], None]

SFM_STEPS = 4  # that run_sfm reports
MIN_VIEWS = 3  # of normals: with two there is nothing left to check them by


def image_names(capture: Capture) -> dict[str, str]:
    """File name of each mosaic by the name of its image: the stem with ``.png``.

    Raises
    ------
    DataError
        Two mosaics differ in their suffix only.
    """
    names: dict[str, str] = {}
    for name in capture.names:
        image = f"{Path(name).stem}.png"
        if image in names:
            raise DataError(
                capture.folder, f"{names[image]} and {name} are of one name; rename one of them."
            )
        names[image] = name
    return names


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


def write_images(
    capture: Capture, workspace: RunFolder, *, workers: Workers, report: Report
) -> Facts:
    """Write the 8-bit intensity images that COLMAP sees."""
    names = image_names(capture)
    white = capture.exposure()
    with workspace.replacing(workspace.images) as folder:
        write = partial(_write_image, capture, white, folder)
        for _ in workers.map(write, names.values(), names):
            report(1)
    return {"num_images": len(names)}


def _write_image(capture: Capture, white: float, folder: Path, name: str, image: str) -> None:
    write_png(folder / image, intensity_image_8bit(capture.load(name), white))


def find_poses(
    names: Sequence[str],
    workspace: RunFolder,
    options: SfmOptions,
    reference: ReferenceOptions,
    *,
    report: Callable[[str], None],
) -> Facts:
    """Run SfM on the images, and bring its model into the metric frame that is asked for."""
    with workspace.scratch("sfm") as folder:
        model = run_sfm(
            workspace.images, names, folder / "work", folder / "sparse", options, report
        )
        facts = _take_frame(model, workspace, reference, folder / "sparse")
        workspace.replace(folder / "sparse", workspace.sparse)
    return _pose_facts(model, workspace.images) | facts


def fit_model(capture: Capture, source: Path) -> SparseModel:
    """An existing COLMAP model, fitted to the capture's image names and size."""
    names = list(image_names(capture))
    return match_model_to_capture(
        read_model(source), names, capture.width, capture.height, source=source
    )


def take_poses(
    model: SparseModel, workspace: RunFolder, source: Path, reference: ReferenceOptions
) -> Facts:
    """Write an existing model that was fitted to the capture; the original is not touched."""
    with workspace.scratch("sfm") as folder:
        write_model(model, folder / "sparse")
        facts = _take_frame(model, workspace, reference, folder / "sparse")
        workspace.replace(folder / "sparse", workspace.sparse)
    return _pose_facts(model, source) | facts


def _take_frame(
    model: SparseModel, workspace: RunFolder, options: ReferenceOptions, target: Path
) -> Facts:
    """Rewrite a model in the metric frame that the options give; without one it stays."""
    frame = metric_frame(model, options, lambda name: read_gray(workspace.images / name))
    if frame is None:
        return {"frame": None, "unit": "model unit"}
    write_model(transform_model(model, frame.metric_from_world), target)
    similarity = frame.metric_from_world
    facts = {
        "source": frame.source,
        "scale": frame.scale,
        "relative_sigma": frame.relative_sigma,
        "rms_residual": frame.rms_residual,
        "num_used": frame.num_used,
        "dropped": list(frame.dropped),
        "checked_by": dict(frame.checked_by),
        "rotation": similarity.rotation.tolist(),
        "translation": similarity.translation.tolist(),
    }
    return {"frame": facts, "unit": "m"}


def _pose_facts(model: SparseModel, source: Path) -> Facts:
    num_views, num_missing = len(model.views), len(model.unregistered)
    if num_missing >= num_views:
        logger.warning(
            "%s: only %d of %d views have a pose; without one are %s.",
            source,
            num_views,
            num_views + num_missing,
            short_list(model.unregistered),
        )
    return {
        "num_views": num_views,
        "unregistered": list(model.unregistered),
        "num_tracks": len(model.tracks.point3D_ids),
    }


def build_maps(
    capture: Capture,
    workspace: RunFolder,
    options: RegionOptions,
    *,
    workers: Workers,
    report: Report,
) -> Facts:
    """Find the region of every posed view and store its phase map."""
    views = posed_views(workspace)
    names = image_names(capture)
    tracks = read_model(workspace.sparse).tracks
    with workspace.replacing(workspace.maps) as folder:
        build = partial(_build_map, capture, options, folder)
        num_inside = 0
        for count in workers.map(build, views, [names[view.name] for view in views]):
            num_inside += count
            report(1)
        maps = [open_phase_map(view, folder) for view in views]
        num_diffuse = num_inside if options.light is Light.DIFFUSE else 0
        if options.light is None and len(tracks.point3D_ids):
            num_diffuse = _turn_diffuse(tracks, maps, folder)
    return {"num_region_px": num_inside, "num_diffuse_px": num_diffuse}


def _turn_diffuse(tracks: Tracks, maps: Sequence[PhaseMap], folder: Path) -> int:
    """Turn the phase where the light is diffuse; returns the number of these pixels."""
    num_diffuse = 0
    for phase_map, where in zip(maps, find_diffuse(tracks, maps), strict=True):
        if where.any():
            store_phase_map(turned(phase_map, where), folder)
            num_diffuse += int(where.sum())
    return num_diffuse


def _build_map(
    capture: Capture, options: RegionOptions, folder: Path, view: View, name: str
) -> int:
    """Phase map of one view; returns the number of its region's pixels."""
    stokes = capture.load(name)
    mask = None
    if options.mask is not None:
        mask = read_mask(find_mask(options.mask, view.name), stokes.shape)
    s0, s1, s2 = stokes.s0, stokes.s1, stokes.s2
    region = find_region(s0, s1, s2, stokes.valid, min_dolp=options.min_dolp, mask=mask)
    light = options.light or Light.SPECULAR
    store_phase_map(build_phase_map(view, s0, s1, s2, stokes.sigma, region, light), folder)
    return int(region.inside.sum())


def posed_views(workspace: RunFolder) -> tuple[View, ...]:
    """Views of ``sparse/``.

    Raises
    ------
    DataError
        There are too few for normals.
    """
    views = read_model(workspace.sparse).views
    if len(views) < MIN_VIEWS:
        raise DataError(
            workspace.sparse,
            f"{len(views)} views with a pose; normals need {MIN_VIEWS} or more. "
            "Record more views, or give a better model with --sparse.",
        )
    return views


def tilt_maps(workspace: RunFolder, *, workers: Workers) -> None:
    """Store beside each phase map the one that the tilted model needs."""
    for _ in workers.map(partial(_tilt_map, workspace.maps), open_maps(workspace, AngleModel.PPA)):
        pass


def _tilt_map(folder: Path, phase_map: PhaseMap) -> None:
    store_phase_map(as_tilted(phase_map), folder)


def open_maps(workspace: RunFolder, model: AngleModel) -> list[PhaseMap]:
    """Phase maps of all posed views for a model; their pixels stay on disk."""
    tilted = model is AngleModel.TILTED
    return [open_phase_map(v, workspace.maps, tilted=tilted) for v in posed_views(workspace)]
