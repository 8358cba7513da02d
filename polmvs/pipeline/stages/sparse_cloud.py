"""Stage ``sparse_cloud_MODEL``: the sparse points with their normals, as people look at them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from polmvs.colmap.models import read_model
from polmvs.io.clouds import Cloud, write_cloud
from polmvs.pipeline.stages.normals import load_track_normals
from polmvs.pipeline.stages.seeds import seed_tracks


@dataclass(frozen=True, kw_only=True)
class SparseCloudResult:
    """What the stage wrote.

    Attributes
    ----------
    num_points : of the cloud, all sparse points.
    num_seeds : those that are seeds, of all models.
    """

    num_points: int
    num_seeds: int

    def __str__(self) -> str:
        return f"{self.num_points:,} points, {self.num_seeds:,} of them seeds"


def write_sparse_cloud(
    sparse: Path, track_normals: Path, seeds: Path, target: Path
) -> SparseCloudResult:
    """Write the sparse points with normal, quality, and whether they are seeds.

    Parameters
    ----------
    sparse : folder of the COLMAP model.
    track_normals, seeds : files of the normals of a model and of the seeds of all.
    target : PLY.
    """
    tracks = read_model(sparse).tracks
    estimate = load_track_normals(track_normals)
    is_seed = seed_tracks(seeds, len(tracks.point3D_ids))
    cloud = Cloud(
        points=tracks.points_in_world,
        normals=estimate.normals,
        colors=tracks.colors,
        scalars={
            "sigma_deg": estimate.sigma_deg,
            "num_views": estimate.num_rows,
            "residual": estimate.residual,
            "conditioning": estimate.conditioning,
            "valid": estimate.valid,
            "specular": estimate.specular,
            "diffuse": estimate.diffuse,
            "dolp": estimate.dolp,
            "seed": is_seed,
        },
    )
    write_cloud(target, cloud)
    return SparseCloudResult(num_points=len(cloud.points), num_seeds=int(is_seed.sum()))
