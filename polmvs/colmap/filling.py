"""Fill the holes of a dense workspace from COLMAP, in a new folder or in place.

COLMAP's own depth is kept. Its stereo uses another pixel origin than its cameras (see
:mod:`polmvs.colmap.maps`), so its part of a fused cloud is shifted by about half a pixel against
the sparse points. The fill is not.
"""

from __future__ import annotations

import os
import shutil
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from os import PathLike
from pathlib import Path

import numpy as np

from polmvs.colmap.dense_workspace import (
    FUSION_FILE,
    IMAGES,
    SPARSE,
    STEREO,
    DenseWorkspace,
    WorkspaceView,
    map_files,
    write_lines,
    write_maps,
)
from polmvs.colmap.maps import DepthNormals
from polmvs.errors import DataError, OptionError, as_data_error
from polmvs.io.folders import new_folder, resolved

# Depth and normals of an image in the workspace's pixels by name, None for none.
FillLoader = Callable[[str], DepthNormals | None]

BACKUP = "stereo.polmvs-backup"


def fill_maps(own: DepthNormals | None, fill: DepthNormals) -> DepthNormals:
    """Maps with their holes filled; positive depth is kept.

    Parameters
    ----------
    own, fill : depth (H, W) and normals (H, W, 3), of one size; ``own`` may be missing.
    """
    if own is None:
        return fill
    if own.depth.shape != fill.depth.shape:
        raise ValueError(f"{fill.depth.shape=} but expected {own.depth.shape}.")
    kept = own.depth > 0
    return DepthNormals(
        depth=np.where(kept, own.depth, fill.depth),
        normals=np.where(kept[..., None], own.normals, fill.normals),
    )


def fill_workspace(
    source: DenseWorkspace,
    target: str | PathLike[str] | None,
    load_fill: FillLoader,
) -> Path | None:
    """Add depth and normals to a workspace where it has none.

    The result has geometric maps of every view that had maps of either kind or has a fill. All of
    them are in its ``fusion.cfg``, so one fusion uses both. Clouds and meshes from the old maps are
    not copied.

    Parameters
    ----------
    source : the workspace.
    target : folder of the new workspace, which may exist if it is empty. None: the source itself
        is changed. Every replaced file is first moved to ``stereo.polmvs-backup-<n>/``; after a
        failure the former state is restored.
    load_fill : gives a view's depth and normals by name.

    Returns
    -------
    The folder of the backup; None if a new workspace was written.

    Raises
    ------
    DataError
        A map is damaged, or the system refuses.
    OptionError
        The target is inside the source.
    """
    if target is None:
        with _scratch(source.folder) as scratch:
            staged = scratch / STEREO
            _write_filled(source, staged, load_fill)
            return _swap_in(staged, source.stereo)
    folder, place = resolved(source.folder), resolved(Path(target))
    if folder == place or folder in place.parents:
        raise OptionError(f"{target} lies in the workspace; choose another folder or in_place.")
    with new_folder(target) as root:
        for name in (IMAGES, SPARSE, STEREO):
            shutil.copytree(source.folder / name, root / name)
        _write_filled(source, root / STEREO, load_fill)
    return None


@contextmanager
def _scratch(folder: Path) -> Iterator[Path]:
    """A temporary folder in another one."""
    with as_data_error(folder, "changed"):
        scratch = Path(tempfile.mkdtemp(prefix=".polmvs-", dir=folder))
    try:
        yield scratch
    finally:
        shutil.rmtree(scratch, ignore_errors=True)


def _write_filled(source: DenseWorkspace, stereo: Path, load_fill: FillLoader) -> None:
    """Write the maps that change, and ``fusion.cfg``, into a stereo folder."""
    stereo.mkdir(exist_ok=True)
    fused = []
    for item in source.views:
        fill = load_fill(item.view.name)
        if fill is not None:
            _require_size(item, fill)
            write_maps(stereo, item.view.name, fill_maps(item.load_maps(), fill))
        elif item.depth not in (None, map_files(source.stereo, item.view.name)[0]):
            maps = item.load_maps()
            assert maps is not None  # has a depth map
            write_maps(stereo, item.view.name, maps)
        if fill is not None or item.depth is not None:
            fused.append(item.view.name)
    write_lines(stereo / FUSION_FILE, fused)


def _require_size(item: WorkspaceView, fill: DepthNormals) -> None:
    """A fill is in the workspace's pixels."""
    if fill.depth.shape != (item.camera.height, item.camera.width):
        raise ValueError(
            f"{fill.depth.shape=} of {item.view.name} but expected "
            f"{(item.camera.height, item.camera.width)}."
        )


def _swap_in(staged: Path, stereo: Path) -> Path:
    """Replace files of a stereo folder by staged ones; the old files go to a new backup."""
    backup = _new_backup(stereo.parent)
    moved: list[tuple[Path, Path]] = []  # from, to; in order
    try:
        for file in sorted(path for path in staged.rglob("*") if path.is_file()):
            relative = file.relative_to(staged)
            for start, end in (
                (stereo / relative, backup / relative),
                (file, stereo / relative),
            ):
                if start.exists():
                    end.parent.mkdir(parents=True, exist_ok=True)
                    os.replace(start, end)
                    moved.append((start, end))
    except BaseException as error:
        for start, end in reversed(moved):
            os.replace(end, start)
        shutil.rmtree(backup, ignore_errors=True)
        if isinstance(error, OSError):
            raise DataError(
                stereo, f"cannot be changed: {error.strerror or error}. It is as it was."
            ) from error
        raise
    return backup


def previous_backups(source: DenseWorkspace) -> list[Path]:
    """Backups of earlier fillings in place, the first of them first."""
    found = source.folder.glob(f"{BACKUP}-*")
    return sorted(found, key=lambda path: (len(path.name), path.name))


def _new_backup(folder: Path) -> Path:
    """Make the first backup folder of a number that is free."""
    number = 1
    while True:
        backup = folder / f"{BACKUP}-{number}"
        try:
            backup.mkdir()
            return backup
        except FileExistsError:
            number += 1
        except OSError as error:
            raise DataError(folder, f"cannot be changed: {error.strerror or error}.") from error
