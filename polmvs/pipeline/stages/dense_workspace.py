"""Stage ``dense_MODEL``: a COLMAP workspace of the depth and normal maps of a dense cloud."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from polmvs.colmap.dense_workspace import common_views
from polmvs.colmap.filling import fill_workspace
from polmvs.colmap.maps import DepthNormals
from polmvs.colmap.models import read_model
from polmvs.errors import DataError
from polmvs.io.images import read_gray
from polmvs.pipeline.run_folder import RunFolder, mark_own_workspace, replace_folder, scratch
from polmvs.pipeline.stages.densify import open_checked, open_dense_views
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import SparseModel
from polmvs.surface.dense_view import DenseView
from polmvs.surface.map_export import export_dense_workspace, warp_dense_view


@dataclass(frozen=True, kw_only=True)
class DenseWorkspaceResult:
    """Result of the stage.

    Attributes
    ----------
    folder : of the workspace; None if there are no points.
    backup : folder of the former maps, if a given workspace was filled in place.
    """

    folder: Path | None
    backup: Path | None = None

    def __str__(self) -> str:
        return "no workspace, for want of points" if self.folder is None else str(self.folder)


def write_workspace(model: AngleModel, folder: RunFolder) -> DenseWorkspaceResult:
    """Write a COLMAP workspace of the run's undistorted images and maps.

    Parameters
    ----------
    model : angle model.
    folder : of a run with images, sparse model and dense views. The workspace is written whole or
        not at all.

    Raises
    ------
    DataError
        There are no dense views, or the target folder holds files that no run wrote.
    """
    sparse, target = read_model(folder.sparse), folder.dense(model)
    dense = _by_name(sparse, model, folder)
    with _new_workspace(target) as new:
        export_dense_workspace(
            new, sparse, lambda name: read_gray(folder.images / name), dense.__getitem__
        )
    return DenseWorkspaceResult(folder=target.absolute())


def fill_given(
    model: AngleModel, folder: RunFolder, given: Path, *, in_place: bool
) -> DenseWorkspaceResult:
    """Fill the holes of the maps of the user's workspace, in a copy or in place.

    Parameters
    ----------
    model, folder : as in :func:`write_workspace`.
    given : the user's workspace.
    in_place : fill the given one after a backup of its maps, and write no copy.

    Raises
    ------
    DataError
        The workspace is unusable, or not of these images and this model.
    """
    sparse, target = read_model(folder.sparse), folder.dense(model)
    dense = _by_name(sparse, model, folder)
    source = open_checked(given, folder)
    pairs = {pair.item.view.name: pair for pair in common_views(source, sparse)}

    def load_fill(name: str) -> DepthNormals | None:
        pair = pairs.get(name)
        view = dense.get(pair.view.name) if pair is not None else None
        if pair is None or view is None:
            return None
        return warp_dense_view(view, pair.view, pair.item.camera)

    if in_place:
        backup = fill_workspace(source, None, load_fill)
        return DenseWorkspaceResult(folder=given.absolute(), backup=backup)
    with _new_workspace(target) as new:
        fill_workspace(source, new, load_fill)
    return DenseWorkspaceResult(folder=target.absolute())


@contextmanager
def _new_workspace(target: Path) -> Iterator[Path]:
    """Folder to write a COLMAP workspace to, which then replaces the former one."""
    with scratch(target) as folder:
        workspace = folder / "dense"
        yield workspace
        mark_own_workspace(workspace)
        replace_folder(workspace, target)


def _by_name(
    sparse: SparseModel, model: AngleModel, folder: RunFolder
) -> dict[str, DenseView | None]:
    """Dense views by image name.

    Raises
    ------
    DataError
        There are none.
    """
    names = [view.name for view in sparse.views]
    dense = dict(zip(names, open_dense_views(folder, model), strict=True))
    if not any(dense.values()):
        raise DataError(
            folder.views(model),
            "holds no depth maps, so that there is no COLMAP workspace to write. "
            "Look at the warnings in polmvs.log.",
        )
    return dense
