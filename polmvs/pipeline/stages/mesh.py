"""Stage ``mesh_MODEL``: a Poisson mesh of the polarised surfaces of a dense cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from polmvs.io.clouds import read_cloud, write_mesh
from polmvs.scene import PointKind
from polmvs.surface.poisson import MIN_POINTS, poisson_mesh


@dataclass(frozen=True, kw_only=True)
class MeshResult:
    """What the stage made.

    Attributes
    ----------
    num_triangles : 0 where the cloud has too few points for a mesh, which is then not written.
    """

    num_triangles: int

    def __str__(self) -> str:
        return f"{self.num_triangles:,} triangles"


def make_mesh(cloud: Path, target: Path) -> MeshResult:
    """Mesh of the polarised surfaces of a cloud; none of too few points.

    Parameters
    ----------
    cloud : PLY that :func:`polmvs.pipeline.stages.densify.densify` wrote.
    target : PLY of the mesh.
    """
    loaded = read_cloud(cloud)
    kinds = loaded.scalars.get("kind")
    if kinds is None or int((kinds == PointKind.SURFACE).sum()) < MIN_POINTS:
        return MeshResult(num_triangles=0)
    mesh = poisson_mesh(loaded, source=cloud)
    write_mesh(target, mesh)
    return MeshResult(num_triangles=len(mesh.triangles))
