"""The stages from phase maps to clouds: normals of the sparse points, seeds, dense clouds."""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.models import read_model
from polmvs.config import (
    AngleModel,
    FusionOptions,
    Method,
    NormalOptions,
    PropagationOptions,
    to_plain,
)
from polmvs.io.arrays import map_array, save_array
from polmvs.io.clouds import Cloud, write_cloud
from polmvs.normals.estimator import NormalEstimate
from polmvs.normals.tracks import select_seeds, track_normals
from polmvs.parallel import Workers
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.scene_cloud import join_clouds, open_given, surface_cloud, surroundings_cloud
from polmvs.pipeline.stages.capture import Facts, Report, open_maps, posed_views, tilt_maps
from polmvs.scene import Seeds, Tracks
from polmvs.surface.consensus import hidden_by
from polmvs.surface.dense_view import DenseView, find_dense_view, store_dense_view
from polmvs.surface.fusion import fuse, no_points
from polmvs.surface.integration import integrate, plan_rounds
from polmvs.surface.parts.agreement import PartReport, contradicted, join_seeds
from polmvs.surface.parts.pieces import find_part_seeds
from polmvs.surface.propagation import propagate

logger = logging.getLogger(__name__)

SEED_COLUMNS = 7  # place, normal, deviation


def solve_tracks(
    model: AngleModel, workspace: RunFolder, options: NormalOptions, *, workers: Workers
) -> Facts:
    """Normals of the sparse points under a model; PPA's also select the seeds."""
    if model is AngleModel.TILTED:
        tilt_maps(workspace, workers=workers)
    tracks = read_model(workspace.sparse).tracks
    maps = open_maps(workspace, model)
    if len(tracks.point3D_ids) == 0:
        estimate = _no_estimate(len(maps))
    else:
        estimate = track_normals(model, tracks, maps, options)
    facts: Facts = {f"num_normals_{model}": int(estimate.valid.sum())}
    if model is AngleModel.PPA:
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


def place_parts(
    workspace: RunFolder, options: NormalOptions, *, max_neighbors: int, workers: Workers
) -> Facts:
    """Seeds for the parts on which none of the sparse points lies, from their outlines.

    They come from PPA and are the same for all models.
    """
    seeds = load_seeds(AngleModel.PPA, workspace)
    reports: list[PartReport] = []
    points = read_model(workspace.sparse).tracks.points_in_world
    found = np.zeros((0, SEED_COLUMNS))
    if options.unseeded and len(points):
        new, reports = find_part_seeds(
            AngleModel.PPA,
            open_maps(workspace, AngleModel.PPA),
            seeds,
            points,
            max_neighbors=max_neighbors,
            tilt_aware=options.tilt_aware_weights,
            workers=workers,
        )
        found = np.column_stack([new.points_in_world, new.normals_in_world, _shared_sigma(new)])
        _drop_seeds(workspace, contradicted(seeds, new))
    save_array(_part_file(workspace), found)
    for part in reports:
        if part.doubt:
            logger.warning(
                "%s: a part of %d px without a sparse point stays undetermined: %s.",
                part.view,
                part.num_px,
                part.doubt,
            )
    num_seeds = int(np.isfinite(map_array(_seed_file(workspace))).sum())
    return {
        "num_seeds": num_seeds,
        "num_part_seeds": len(found),
        "parts": [to_plain(part) for part in reports],
    }


def _drop_seeds(workspace: RunFolder, dropped: NDArray[np.bool_]) -> None:
    """Take the name of a seed from tracks that the outlines contradict."""
    sigma = np.array(map_array(_seed_file(workspace)))
    index = np.flatnonzero(np.isfinite(sigma))
    if dropped.any():
        logger.warning("%d sparse points contradict the outlines and are no seeds.", dropped.sum())
        sigma[index[dropped]] = np.nan
        save_array(_seed_file(workspace), sigma)


def _shared_sigma(seeds: Seeds) -> NDArray[np.float64]:
    """Deviations that make seeds which err as one weigh as one.

    All seeds of a part have the same deviation, and one part's is hardly another's.
    """
    _, part, count = np.unique(seeds.sigma, return_inverse=True, return_counts=True)
    return np.asarray(seeds.sigma * np.sqrt(count[part]))


def _part_file(workspace: RunFolder) -> Path:
    """Seeds of the parts without sparse points: place, normal, deviation."""
    return workspace.maps / "parts.npy"


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


def _seed_file(workspace: RunFolder) -> Path:
    """Standard deviation of each track's place, NaN where it is no seed."""
    return workspace.maps / "seeds.npy"


def _normal_file(workspace: RunFolder, model: AngleModel) -> Path:
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


def load_seeds(model: AngleModel, workspace: RunFolder) -> Seeds:
    """Seeds with the normals of a model; which points they are is the same for all models."""
    points = read_model(workspace.sparse).tracks.points_in_world
    sigma = np.array(map_array(_seed_file(workspace)))
    normals = np.array(map_array(_normal_file(workspace, model)))
    used = np.isfinite(sigma)
    tracks = Seeds(points[used], normals[used], sigma[used])
    if not _part_file(workspace).is_file():
        return tracks
    parts = np.array(map_array(_part_file(workspace)))
    if model is not AngleModel.PPA:
        parts[:, 3:6] = np.nan  # each model solves its own
    return join_seeds([tracks, Seeds(parts[:, :3], parts[:, 3:6], parts[:, 6])])


def densify(
    model: AngleModel,
    workspace: RunFolder,
    propagation: PropagationOptions,
    fusion: FusionOptions,
    *,
    tilt_aware: bool = True,
    workers: Workers,
    report: Report,
) -> Facts:
    """Spread the seeds over the region of every view and fuse the views into one cloud.

    Without a region or seeds the surface has no points. ``tilt_aware`` as in ``NormalOptions``.
    """
    maps = open_maps(workspace, model)
    seeds = load_seeds(model, workspace)
    num_inside = sum(int(phase_map.region.inside.sum()) for phase_map in maps)
    given = open_given(workspace, fusion)
    with workspace.scratch(f"densify_{model}") as folder, workers.stopped_on_error():
        views = folder / "views"
        views.mkdir()
        if num_inside == 0 or len(seeds.sigma) == 0:
            cloud = no_points()
        else:
            spread = integrate if propagation.method is Method.INTEGRATE else propagate
            dense = spread(
                model,
                maps,
                seeds,
                propagation,
                folder,
                tilt_aware=tilt_aware,
                workers=workers,
                on_progress=report,
            )

            confirmed: dict[int, NDArray[np.bool_]] = {}
            cloud = fuse(
                maps,
                dense,
                fusion,
                max_neighbors=propagation.max_neighbors,
                workers=workers,
                on_progress=report,
                on_confirmed=confirmed.__setitem__,
            )
            for index, points in confirmed.items():
                dense_view, view = dense[index], maps[index].view
                assert dense_view is not None  # has points
                seen = points & ~hidden_by(dense_view, view, cloud.points, cloud.normals)
                store_dense_view(dense_view.only(seen), views / view.name)
        surface = surface_cloud(cloud)
        around = surroundings_cloud(
            workspace, cloud, maps, fusion, given, folder / "around", workers=workers
        )
        workspace.replace(views, workspace.views(model))
    write_cloud(workspace.cloud(model), join_clouds(surface, around))
    return {
        f"num_points_{model}": len(surface.points),
        f"num_surroundings_{model}": len(around.points),
    }


def open_dense_views(workspace: RunFolder, model: AngleModel) -> list[DenseView | None]:
    """Dense results of all posed views under a model, None where a view has none."""
    folder = workspace.views(model)
    names = [view.name for view in posed_views(workspace)]
    return [find_dense_view(folder / name) for name in names]


def densify_steps(num_views: int, options: PropagationOptions) -> int:
    """How many times :func:`densify` reports."""
    if options.method is Method.INTEGRATE:
        return (len(plan_rounds(options)) + 1) * num_views
    return (options.num_rounds + 2) * num_views
