"""The stages of a reconstruction: each reads what the stage before wrote, and writes its own.

Every function writes whole files or folders only and returns what it found, in numbers. The order
of the stages, their record and how a run goes on are in :mod:`polmvs.pipeline`.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import View
from polmvs.capture import DISPLAY_GAMMA, Capture, intensity_image_8bit
from polmvs.cloud_io import Cloud, write_cloud
from polmvs.colmap_io import SparseModel, read_model
from polmvs.config import (
    FusionOptions,
    Light,
    Model,
    NormalOptions,
    PropagationOptions,
    RegionOptions,
    SfmOptions,
)
from polmvs.errors import DataError
from polmvs.fuse import FusedCloud, fuse
from polmvs.image_io import read_mask, write_png
from polmvs.light import find_diffuse
from polmvs.normals import NormalEstimate
from polmvs.parallel import Workers
from polmvs.phasemap import (
    PhaseMap,
    as_tilted,
    build_phase_map,
    open_phase_map,
    store_phase_map,
    turned,
)
from polmvs.propagate import propagate
from polmvs.region import find_region
from polmvs.sfm import run_sfm
from polmvs.sparse_model import match_model_to_capture, short_list, write_model
from polmvs.storage import map_array, save_array
from polmvs.tracks import Seeds, Tracks, select_seeds, track_normals
from polmvs.workspace import Workspace

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
    capture: Capture, workspace: Workspace, *, workers: Workers, report: Report
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
    workspace: Workspace,
    options: SfmOptions,
    *,
    report: Callable[[str], None],
) -> Facts:
    """Run SfM on the images."""
    with workspace.scratch("sfm") as folder:
        model = run_sfm(
            workspace.images, names, folder / "work", folder / "sparse", options, report
        )
        workspace.replace(folder / "sparse", workspace.sparse)
    return _pose_facts(model, workspace.images)


def fit_model(capture: Capture, source: Path) -> SparseModel:
    """An existing COLMAP model, fitted to the capture's image names and size."""
    names = list(image_names(capture))
    return match_model_to_capture(
        read_model(source), names, capture.width, capture.height, source=source
    )


def take_poses(model: SparseModel, workspace: Workspace, source: Path) -> Facts:
    """Write an existing model that was fitted to the capture; the original is not touched."""
    with workspace.scratch("sfm") as folder:
        write_model(model, folder / "sparse")
        workspace.replace(folder / "sparse", workspace.sparse)
    return _pose_facts(model, source)


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
    workspace: Workspace,
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
        diffuse: list[NDArray[np.bool_] | None] = [None] * len(maps)
        if options.light is None and len(tracks.point3D_ids):
            diffuse = list(find_diffuse(tracks, maps))
        num_diffuse = 0
        for count in workers.map(partial(_finish_map, folder), maps, diffuse):
            num_diffuse += count
    return {"num_region_px": num_inside, "num_diffuse_px": num_diffuse}


def _finish_map(folder: Path, phase_map: PhaseMap, diffuse: NDArray[np.bool_] | None) -> int:
    """Turn what is diffuse, and store the tilted map beside; returns the diffuse pixels."""
    if diffuse is not None and diffuse.any():
        phase_map = store_phase_map(turned(phase_map, diffuse), folder)
    store_phase_map(as_tilted(phase_map), folder)
    return int((phase_map.diffuse & phase_map.region.inside).sum())


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


def posed_views(workspace: Workspace) -> tuple[View, ...]:
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


def open_maps(workspace: Workspace, model: Model) -> list[PhaseMap]:
    """Phase maps of all posed views for a model; their pixels stay on disk."""
    tilted = model is Model.TILTED
    return [open_phase_map(v, workspace.maps, tilted=tilted) for v in posed_views(workspace)]


def solve_tracks(model: Model, workspace: Workspace, options: NormalOptions) -> Facts:
    """Normals of the sparse points under a model; PPA's also select the seeds."""
    tracks = read_model(workspace.sparse).tracks
    maps = open_maps(workspace, model)
    if len(tracks.point3D_ids) == 0:
        estimate = _no_estimate(len(maps))
    else:
        estimate = track_normals(model, tracks, maps, options)
    facts: Facts = {f"num_normals_{model}": int(estimate.valid.sum())}
    if model is Model.PPA:
        is_seed, sigma = np.zeros(len(tracks.point3D_ids), np.bool_), np.zeros(0)
        if len(tracks.point3D_ids):
            seeds, is_seed = select_seeds(tracks, estimate, maps)
            sigma = seeds.sigma
        seed_sigma = np.full(len(is_seed), np.nan)
        seed_sigma[is_seed] = sigma
        save_array(_seed_file(workspace), seed_sigma)
        facts["num_seeds"] = int(is_seed.sum())
    is_seed = np.isfinite(map_array(_seed_file(workspace)))
    save_array(_normal_file(workspace, model), estimate.normals)
    write_cloud(workspace.normals(model), _track_cloud(tracks, estimate, is_seed))
    return facts


def _no_estimate(num_views: int) -> NormalEstimate:
    """The estimate of no tracks."""
    none = np.zeros(0)
    return NormalEstimate(
        normals=np.zeros((0, 3)),
        valid=np.zeros(0, np.bool_),
        conditioning=none,
        sigma_deg=none,
        residual=none,
        num_rows=np.zeros(0, np.int64),
        row_weights=np.zeros((num_views, 0)),
    )


def _seed_file(workspace: Workspace) -> Path:
    """Standard deviation of each track's place, NaN where it is no seed."""
    return workspace.maps / "seeds.npy"


def _normal_file(workspace: Workspace, model: Model) -> Path:
    return workspace.maps / f"normals_{model}.npy"


def _track_cloud(tracks: Tracks, estimate: NormalEstimate, is_seed: NDArray[np.bool_]) -> Cloud:
    return Cloud(
        points=tracks.points_in_world,
        normals=estimate.normals,
        colors=tracks.colors,
        scalars={
            "sigma_deg": estimate.sigma_deg,
            "num_views": estimate.num_rows,
            "residual": estimate.residual,
            "conditioning": estimate.conditioning,
            "valid": estimate.valid,
            "seed": is_seed,
        },
    )


def load_seeds(model: Model, workspace: Workspace) -> Seeds:
    """Seeds with the normals of a model; which tracks they are is the same for all models."""
    points = read_model(workspace.sparse).tracks.points_in_world
    sigma = np.array(map_array(_seed_file(workspace)))
    normals = np.array(map_array(_normal_file(workspace, model)))
    used = np.isfinite(sigma)
    return Seeds(points[used], normals[used], sigma[used])


def densify(
    model: Model,
    workspace: Workspace,
    propagation: PropagationOptions,
    fusion: FusionOptions,
    *,
    workers: Workers,
    report: Report,
) -> Facts:
    """Spread the seeds over the region of every view and fuse the views into one cloud.

    Without a region or seeds the cloud has no points.
    """
    maps = open_maps(workspace, model)
    seeds = load_seeds(model, workspace)
    num_inside = sum(int(phase_map.region.inside.sum()) for phase_map in maps)
    if num_inside == 0 or len(seeds.sigma) == 0:
        write_cloud(workspace.cloud(model), Cloud(np.zeros((0, 3))))
        return {f"num_points_{model}": 0}
    with workspace.scratch(f"densify_{model}") as folder:
        dense = propagate(
            model, maps, seeds, propagation, folder, workers=workers, on_progress=report
        )
        cloud = fuse(
            maps,
            dense,
            fusion,
            max_neighbors=propagation.max_neighbors,
            workers=workers,
            on_progress=report,
        )
    write_cloud(workspace.cloud(model), _dense_cloud(cloud))
    return {f"num_points_{model}": len(cloud.points)}


def densify_steps(num_views: int, options: PropagationOptions) -> int:
    """How many times :func:`densify` reports."""
    return (options.num_rounds + 2) * num_views


def _dense_cloud(cloud: FusedCloud) -> Cloud:
    """The cloud with grey colours: intensity as COLMAP's images show it, brightest 1 % white."""
    white = float(np.percentile(cloud.intensity, 99)) if len(cloud.intensity) else 1.0
    share = np.clip(cloud.intensity / max(white, 1e-9), 0, 1) ** (1 / DISPLAY_GAMMA)
    grey = np.rint(255 * share).astype(np.uint8)
    return Cloud(
        points=cloud.points,
        normals=cloud.normals,
        colors=np.repeat(grey[:, None], 3, axis=1),
        scalars={"num_views": cloud.num_views, "sigma_deg": cloud.sigma_deg},
    )
