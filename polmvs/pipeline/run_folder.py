"""The run folder: the paths of its files, how they are written, and which of them are its own.

Everything is written whole or not at all. What carries a temporary name belongs to an unfinished
stage and is removed when the run goes on. Only what a run wrote is ever deleted.
"""

from __future__ import annotations

import shutil
from collections.abc import Iterable, Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

from polmvs.config import AngleModel
from polmvs.errors import DataError

RUN_FILE = "run.json"
LOG_FILE = "polmvs.log"
SURFACE_MESH = "surface.ply"  # among dense views: the mesh that they are rendered from
SURFACE_LEVELS = "surface_{number}.ply"  # and those on its way: its hull, then after each level
DENSE_MARKER = "polmvs-files.txt"  # in a COLMAP workspace: the files that were written with it


@dataclass(frozen=True)
class RunFolder:
    """Paths of a run folder.

    Attributes
    ----------
    root : the folder.
    """

    root: Path

    @property
    def images(self) -> Path:
        """Images that COLMAP was given."""
        return self.root / "images"

    @property
    def sparse(self) -> Path:
        """COLMAP model, binary."""
        return self.root / "sparse"

    @property
    def seeds(self) -> Path:
        """Seeds of all models."""
        return self.root / "tracks" / "seeds.npy"

    @property
    def metrics(self) -> Path:
        """Figures of a comparison."""
        return self.root / "metrics.json"

    @property
    def summary(self) -> Path:
        """The same as a table to read."""
        return self.root / "summary.md"

    @property
    def report(self) -> Path:
        """The page that shows all results."""
        return self.root / "report.html"

    @property
    def run_file(self) -> Path:
        """Record of the run."""
        return self.root / RUN_FILE

    @property
    def log(self) -> Path:
        """Log of all calls."""
        return self.root / LOG_FILE

    def maps(self, model: AngleModel) -> Path:
        """Phase maps; OPA and PPA share theirs."""
        return self.root / ("maps_tilted" if model is AngleModel.TILTED else "maps")

    def track_normals(self, model: AngleModel) -> Path:
        """Normals of the sparse points with their quality, as the later stages read them."""
        return self.root / "tracks" / f"normals_{model}.npy"

    def sparse_cloud(self, model: AngleModel) -> Path:
        """Sparse points with normals: ``normals.ply`` is PPA's."""
        return self.root / ("normals.ply" if model is AngleModel.PPA else f"normals_{model}.ply")

    def cloud(self, model: AngleModel) -> Path:
        """Dense cloud."""
        return self.root / f"{model}.ply"

    def views(self, model: AngleModel) -> Path:
        """Dense views: ranges, normals and deviations of each view."""
        return self.root / f"views_{model}"

    def mesh(self, model: AngleModel) -> Path:
        """Poisson mesh of the dense cloud."""
        return self.root / f"{model}_mesh.ply"

    def dense(self, model: AngleModel) -> Path:
        """COLMAP dense workspace: ``dense/`` is PPA's."""
        return self.root / ("dense" if model is AngleModel.PPA else f"dense_{model}")


HERE = RunFolder(Path())  # its paths are those within any run folder

# What a run writes in its folders, by folder; images are known by name from the record.
FOLDER_PATTERNS = {
    HERE.sparse.name: ("*.bin",),
    HERE.seeds.parent.name: ("*.npy",),
    **{HERE.maps(model).name: ("*.npy",) for model in AngleModel},
    **{
        HERE.views(model).name: ("*.npy", SURFACE_MESH, SURFACE_LEVELS.format(number="[0-9]"))
        for model in AngleModel
    },
}
DENSE_FOLDERS = frozenset(HERE.dense(model).name for model in AngleModel)


# Writing


@contextmanager
def scratch(target: Path) -> Iterator[Path]:
    """A new folder beside ``target`` that goes when the work is done or fails."""
    folder = target.with_name(f".{target.name}.tmp")
    try:
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
        yield folder
    finally:
        shutil.rmtree(folder, ignore_errors=True)


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A new folder that takes the place of ``target`` when all went well, else goes.

    Raises
    ------
    DataError
        The other one holds files that no run wrote.
    """
    with scratch(target) as folder:
        yield folder
        replace_folder(folder, target)


def replace_folder(folder: Path, target: Path) -> None:
    """Put a finished folder in the place of another one.

    Raises
    ------
    DataError
        The other one holds files that no run wrote.
    """
    if target.exists():
        require_own(target, {file.name for file in folder.iterdir()})
        shutil.rmtree(target)
    folder.replace(target)


def remove_temporary(root: Path) -> None:
    """Remove what a killed run left half done."""
    for folder in (root, root / HERE.seeds.parent):
        for path in folder.glob(".*.tmp*"):
            if path.is_dir():
                shutil.rmtree(path, ignore_errors=True)
            else:
                path.unlink(missing_ok=True)


# Deleting


def require_own(folder: Path, names: Set[str] = frozenset()) -> None:
    """Refuse to delete a folder with files other than these and those that a run writes in it.

    Raises
    ------
    DataError
        There is one; it is named.
    """
    if folder.name in DENSE_FOLDERS and not folder.is_symlink():
        _require_own_workspace(folder)
        return
    patterns = FOLDER_PATTERNS.get(folder.name, ())
    for file in folder.iterdir():
        own = file.name in names or any(file.match(pattern) for pattern in patterns)
        if folder.is_symlink() or file.is_dir() or not own:
            raise DataError(file, "was not written by polmvs. Move it out of the way.")


def discard(paths: Iterable[Path], names: Set[str] = frozenset()) -> None:
    """Delete files and folders that a run wrote, those that are there.

    Raises
    ------
    DataError
        A folder holds files other than ``names`` and those that a run writes; nothing is deleted.
    """
    present = [path for path in paths if path.exists() or path.is_symlink()]
    for path in present:
        if path.is_dir():
            require_own(path, names)
    for path in present:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


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


def has_content(folder: Path) -> bool:
    """Whether a folder exists and holds anything.

    Raises
    ------
    DataError
        It is a file, or cannot be read.
    """
    try:
        return folder.exists() and any(folder.iterdir())
    except NotADirectoryError as error:
        raise DataError(folder, "is a file; OUT must be a folder.") from error
    except OSError as error:
        raise DataError(folder, f"cannot be used: {error.strerror or error}.") from error
