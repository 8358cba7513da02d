"""Which files in an output folder a run wrote: only those are ever deleted."""

from __future__ import annotations

from collections.abc import Set
from pathlib import Path

from polmvs.config import AngleModel
from polmvs.errors import DataError

# What a run writes in its folders, by folder; images are known by name from the record.
FOLDER_PATTERNS = {"sparse": ("*.bin",), "maps": ("*.npy",)} | {
    f"views_{model}": ("*.npy",) for model in AngleModel
}
DENSE_FOLDERS = frozenset({"dense", *(f"dense_{model}" for model in AngleModel)})
DENSE_MARKER = "polmvs-files.txt"  # in a COLMAP workspace: the files that were written with it


def require_own(folder: Path, names: Set[str]) -> None:
    """Refuse to delete a folder with files other than these and those that a run writes in it."""
    if folder.name in DENSE_FOLDERS and not folder.is_symlink():
        _require_own_workspace(folder)
        return
    patterns = FOLDER_PATTERNS.get(folder.name, ())
    for file in folder.iterdir():
        own = file.name in names or any(file.match(pattern) for pattern in patterns)
        if folder.is_symlink() or file.is_dir() or not own:
            raise DataError(file, "was not written by polmvs. Move it out of the way.")


def _require_own_workspace(folder: Path) -> None:
    """Refuse to delete a COLMAP workspace that holds more than a run writes in it."""
    marker = folder / DENSE_MARKER
    if not marker.is_file():
        raise DataError(folder, "was not written by polmvs. Move it out of the way.")
    written = set(marker.read_text(encoding="utf-8").splitlines())
    for file in folder.rglob("*"):
        if file.is_file() and file.relative_to(folder).as_posix() not in written | {DENSE_MARKER}:
            raise DataError(file, "was not written by polmvs. Move it out of the way.")


def mark_own_workspace(folder: Path) -> None:
    """List the files of a COLMAP workspace in it, so that what a user adds is told from them."""
    files = (path for path in folder.rglob("*") if path.is_file())
    lines = sorted(path.relative_to(folder).as_posix() for path in files)
    (folder / DENSE_MARKER).write_text("\n".join(lines) + "\n", encoding="utf-8")
