"""The stages from phase maps to clouds: normals of the sparse points, seeds, dense clouds."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.capture import DISPLAY_GAMMA
from polmvs.cloud_io import Cloud, write_cloud
from polmvs.colmap_io import read_model
from polmvs.config import FusionOptions, Method, Model, NormalOptions, PropagationOptions
from polmvs.fuse import FusedCloud, fuse
from polmvs.integrate import integrate, plan_rounds
from polmvs.normals import NormalEstimate
from polmvs.parallel import Workers
from polmvs.propagate import propagate
from polmvs.stages import Facts, Report, open_maps, tilt_maps
from polmvs.storage import map_array, save_array
from polmvs.tracks import Seeds, Tracks, select_seeds, track_normals
from polmvs.workspace import Workspace


def solve_tracks(
    model: Model, workspace: Workspace, options: NormalOptions, *, workers: Workers
) -> Facts:
    """Normals of the sparse points under a model; PPA's also select the seeds."""
    if model is Model.TILTED:
        tilt_maps(workspace, workers=workers)
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
        spread = integrate if propagation.method is Method.INTEGRATE else propagate
        dense = spread(model, maps, seeds, propagation, folder, workers=workers, on_progress=report)
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
    if options.method is Method.INTEGRATE:
        return (len(plan_rounds(options)) + 1) * num_views
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
        scalars={
            "num_views": cloud.num_views,
            "sigma": cloud.sigma,
            "sigma_deg": cloud.sigma_deg,
        },
    )
