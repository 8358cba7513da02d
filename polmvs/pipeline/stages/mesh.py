"""Stage ``mesh_MODEL``: the mesh of all views, or the Poisson mesh of the polarized surfaces."""

from __future__ import annotations

from dataclasses import dataclass

from polmvs.io.clouds import read_cloud, read_mesh, write_mesh
from polmvs.pipeline.run_folder import SURFACE_MESH, RunFolder
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import PointKind
from polmvs.surface.poisson import MIN_POINTS, poisson_mesh


@dataclass(frozen=True, kw_only=True)
class MeshResult:
    """Result of the stage.

    Attributes
    ----------
    num_triangles : 0 if the cloud has too few points; no mesh is then written.
    """

    num_triangles: int

    def __str__(self) -> str:
        return f"{self.num_triangles:,} triangles"


def make_mesh(model: AngleModel, folder: RunFolder) -> MeshResult:
    """Mesh of the polarized surfaces: the surface of all views, or the Poisson mesh of the cloud.

    Parameters
    ----------
    model : angle model.
    folder : of a run with a dense cloud of the model. The folder of the dense views has a mesh if
        one surface came from all views. No mesh is written if the cloud has too few points.
    """
    found, target = folder.views(model) / SURFACE_MESH, folder.mesh(model)
    if found.is_file():
        surface = read_mesh(found)
        write_mesh(target, surface)
        return MeshResult(num_triangles=len(surface.triangles))
    cloud = folder.cloud(model)
    loaded = read_cloud(cloud)
    kinds = loaded.scalars.get("kind")
    if kinds is None or int((kinds == PointKind.SURFACE).sum()) < MIN_POINTS:
        return MeshResult(num_triangles=0)
    mesh = poisson_mesh(loaded, source=cloud)
    write_mesh(target, mesh)
    return MeshResult(num_triangles=len(mesh.triangles))
