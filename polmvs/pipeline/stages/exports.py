"""The stages after a dense cloud: its mesh, and a COLMAP workspace of its depth and normal maps."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from polmvs.colmap.dense_workspace import common_views
from polmvs.colmap.filling import fill_workspace
from polmvs.colmap.maps import DepthNormals
from polmvs.colmap.models import read_model
from polmvs.config import AngleModel
from polmvs.errors import DataError
from polmvs.io.clouds import read_cloud, write_mesh
from polmvs.io.images import read_gray
from polmvs.pipeline.own_files import mark_own_workspace
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.scene_cloud import open_checked
from polmvs.pipeline.stages.capture import Facts
from polmvs.pipeline.stages.clouds import open_dense_views
from polmvs.scene import PointKind, SparseModel
from polmvs.surface.dense_view import DenseView
from polmvs.surface.map_export import export_dense_workspace, warp_dense_view
from polmvs.surface.poisson import MIN_POINTS, poisson_mesh

DenseViews = dict[str, DenseView | None]


def make_mesh(model: AngleModel, workspace: RunFolder) -> Facts:
    """Mesh of the polarised surfaces; none, and a fact that says so, of too few points."""
    source = workspace.cloud(model)
    cloud = read_cloud(source)
    kinds = cloud.scalars.get("kind")
    if kinds is None or int((kinds == PointKind.SURFACE).sum()) < MIN_POINTS:
        return {f"num_triangles_{model}": 0}
    mesh = poisson_mesh(cloud, source=source)
    write_mesh(workspace.mesh(model), mesh)
    return {f"num_triangles_{model}": len(mesh.triangles)}


def write_workspace(model: AngleModel, workspace: RunFolder) -> Facts:
    """A COLMAP workspace of the run's own undistorted images and maps."""
    sparse = read_model(workspace.sparse)
    dense = _by_name(sparse, workspace, model)
    with _new_workspace(model, workspace) as target:
        export_dense_workspace(
            target, sparse, lambda name: read_gray(workspace.images / name), dense.__getitem__
        )
    return {f"dense_{model}": str(workspace.dense(model).absolute())}


def fill_given(model: AngleModel, workspace: RunFolder, given: Path, *, in_place: bool) -> Facts:
    """A copy of the user's workspace, or that one itself, with the holes of its maps filled.

    Raises
    ------
    DataError
        The workspace is unusable, or not of these images and this model.
    """
    sparse = read_model(workspace.sparse)
    dense = _by_name(sparse, workspace, model)
    source = open_checked(given, workspace)
    pairs = {pair.item.view.name: pair for pair in common_views(source, sparse)}

    def load_fill(name: str) -> DepthNormals | None:
        pair = pairs.get(name)
        view = dense.get(pair.view.name) if pair is not None else None
        if pair is None or view is None:
            return None
        return warp_dense_view(view, pair.view, pair.item.camera)

    if in_place:
        backup = fill_workspace(source, None, load_fill, in_place=True)
        return {f"dense_{model}": str(given.absolute()), f"backup_{model}": str(backup)}
    with _new_workspace(model, workspace) as target:
        fill_workspace(source, target, load_fill)
    return {f"dense_{model}": str(workspace.dense(model).absolute())}


@contextmanager
def _new_workspace(model: AngleModel, workspace: RunFolder) -> Iterator[Path]:
    """Where to write a COLMAP workspace, which then takes the place of the model's last one."""
    with workspace.scratch(f"dense_{model}") as folder:
        target = folder / "dense"
        yield target
        mark_own_workspace(target)
        workspace.replace(target, workspace.dense(model))


def _by_name(sparse: SparseModel, workspace: RunFolder, model: AngleModel) -> DenseViews:
    """Dense views by image name.

    Raises
    ------
    DataError
        There are none.
    """
    names = [view.name for view in sparse.views]
    dense = dict(zip(names, open_dense_views(workspace, model), strict=True))
    if not any(dense.values()):
        raise DataError(
            workspace.views(model),
            "holds no depth maps, so that there is no COLMAP workspace to write. "
            "Look at the warnings in polmvs.log.",
        )
    return dense
