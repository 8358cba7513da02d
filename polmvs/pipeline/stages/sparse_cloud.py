"""Stage ``sparse_cloud_MODEL``: the sparse points with their normals, for a viewer."""

from __future__ import annotations

from dataclasses import dataclass

from polmvs.colmap.models import read_model
from polmvs.io.clouds import Cloud, write_cloud
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages.normals import load_track_normals
from polmvs.pipeline.stages.seeds import seed_tracks
from polmvs.polarization.kinds import AngleModel


@dataclass(frozen=True, kw_only=True)
class SparseCloudResult:
    """Result of the stage.

    Attributes
    ----------
    num_points : of the cloud, all sparse points.
    num_seeds : those that are seeds, of all models.
    """

    num_points: int
    num_seeds: int

    def __str__(self) -> str:
        return f"{self.num_points:,} points, {self.num_seeds:,} of them seeds"


def write_sparse_cloud(model: AngleModel, folder: RunFolder) -> SparseCloudResult:
    """Write the sparse points with normal, quality, and whether they are seeds."""
    tracks = read_model(folder.sparse).tracks
    estimate = load_track_normals(folder, model)
    is_seed = seed_tracks(folder.seeds, len(tracks.point3D_ids))
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
    write_cloud(folder.sparse_cloud(model), cloud)
    return SparseCloudResult(num_points=len(cloud.points), num_seeds=int(is_seed.sum()))
