"""The run folder: the paths of its files, and how they are written and deleted.

Everything is written whole or not at all. Only files of a run are ever deleted: those with its
token (:mod:`polmvs.pipeline.run_lock`), and results by their names. Links are not followed.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator, Set
from contextlib import contextmanager
from dataclasses import dataclass
from itertools import count, takewhile
from pathlib import Path

from polmvs.errors import DataError
from polmvs.io.plain_files import read_text
from polmvs.io.temporary import remove_temporary, temporary_path
from polmvs.polarization.kinds import AngleModel

RUN_FILE = "run.json"
LOG_FILE = "polmvs.log"
SURFACE_MESH = "surface.ply"  # among dense views: the mesh that they are rendered from
NOT_OURS = "was not written by polmvs. Move it out of the way."
CAMERA_MODES = "camera_modes.npy"  # beside the model of SfM: uncertainty of its camera
POSE_COVARIANCES = "pose_covariances.npy"  # likewise: uncertainty of its poses
SURFACE_LEVELS = "surface_{number}.ply"  # and those before it: its hull, then after each level
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
        """Images for COLMAP."""
        return self.root / "images"

    @property
    def sfm(self) -> Path:
        """COLMAP model of SfM, in its own frame."""
        return self.root / "sfm"

    @property
    def sparse(self) -> Path:
        """COLMAP model, binary."""
        return self.root / "sparse"

    @property
    def camera_modes(self) -> Path:
        """Uncertainty of an estimated camera, in the frame of ``sparse``."""
        return self.root / "tracks" / "camera.npy"

    @property
    def pose_covariances(self) -> Path:
        """Uncertainty of estimated poses, in the frame of ``sparse``."""
        return self.root / "tracks" / "poses.npy"

    @property
    def seeds(self) -> Path:
        """Seeds of all models."""
        return self.root / "tracks" / "seeds.npy"

    @property
    def metrics(self) -> Path:
        """Metrics of a comparison."""
        return self.root / "metrics.json"

    @property
    def summary(self) -> Path:
        """The same as a table."""
        return self.root / "summary.md"

    @property
    def report(self) -> Path:
        """The report."""
        return self.root / "report.html"

    @property
    def deviation(self) -> Path:
        """Results of ``polmvs deviation``."""
        return self.root / "deviation"

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

    @property
    def silhouettes(self) -> Path:
        """Silhouettes of the views, of all models."""
        return self.root / "silhouettes"

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

_MODEL_FILES = {f"{name}.bin" for name in ("cameras", "images", "points3D", "rigs", "frames")}
_SURFACES = {SURFACE_MESH, *(SURFACE_LEVELS.format(number=number) for number in range(10))}
# What a run writes in its folders, by folder.
FOLDER_FILES = {
    HERE.sfm.name: {*_MODEL_FILES, CAMERA_MODES, POSE_COVARIANCES},
    HERE.sparse.name: _MODEL_FILES,
    HERE.seeds.parent.name: {
        HERE.seeds.name,
        HERE.camera_modes.name,
        HERE.pose_covariances.name,
        *(HERE.track_normals(model).name for model in AngleModel),
    },
    HERE.deviation.name: {f"deviation.{suffix}" for suffix in ("ply", "png", "svg", "json")},
    **{HERE.views(model).name: _SURFACES for model in AngleModel},
}
# In these, files named IMAGE.part.npy as well; images are known by name from the record.
FOLDERS_BY_IMAGE = frozenset(
    path.name
    for model in AngleModel
    for path in (HERE.maps(model), HERE.silhouettes, HERE.views(model))
)
DENSE_FOLDERS = frozenset(HERE.dense(model).name for model in AngleModel)


# Writing


@contextmanager
def scratch(target: Path) -> Iterator[Path]:
    """A temporary folder beside ``target``, removed at the end."""
    folder = temporary_path(target)
    try:
        folder.mkdir(parents=True)
        yield folder
    finally:
        remove_temporary(folder)


@contextmanager
def replacing(target: Path) -> Iterator[Path]:
    """A new folder that replaces ``target`` on success and is removed otherwise.

    Raises
    ------
    DataError
        The other one holds files that no run wrote.
    """
    with scratch(target) as folder:
        yield folder
        replace_folder(folder, target)


def replace_folder(folder: Path, target: Path) -> None:
    """Replace a folder by a finished one.

    Raises
    ------
    DataError
        The other one holds files that no run wrote.
    """
    if os.path.lexists(target):
        require_own(target, also={file.name for file in folder.iterdir()})
        shutil.rmtree(target)
    folder.replace(target)


# Deleting


def require_own(
    folder: Path, images: Set[str] = frozenset(), *, also: Set[str] = frozenset()
) -> None:
    """Refuse to delete a folder with files that no run writes in it.

    Parameters
    ----------
    images : names of the run's images.
    also : names of further files that may be deleted.

    Raises
    ------
    DataError
        There is such a file; the message names it.
    """
    require_no_link(folder)
    if not folder.is_dir():
        raise DataError(folder, NOT_OURS)
    if folder.name in DENSE_FOLDERS:
        _require_own_workspace(folder)
        return
    own = FOLDER_FILES.get(folder.name, set()) | also
    if folder.name == HERE.images.name:
        own |= images
    for file in folder.iterdir():
        of_image = folder.name in FOLDERS_BY_IMAGE and file.suffix == ".npy"
        known = file.name in own or (of_image and file.name.rsplit(".", 2)[0] in images)
        if not known or (file.is_dir() and not file.is_symlink()):
            raise DataError(file, NOT_OURS)


def require_no_link(path: Path) -> None:
    """Refuse a link in place of a result: its target does not belong to the run.

    Raises
    ------
    DataError
        It is one.
    """
    if path.is_symlink():
        raise DataError(path, f"is a link and {NOT_OURS}")


def discard(paths: Iterable[Path], images: Set[str] = frozenset()) -> None:
    """Delete existing files and folders of a run.

    Raises
    ------
    DataError
        A folder has files that no run of these images writes; nothing is deleted.
    """
    present = [path for path in paths if os.path.lexists(path)]
    for path in present:
        if path.is_dir():
            require_own(path, images)
    for path in present:
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink()


def _require_own_workspace(folder: Path) -> None:
    """Refuse to delete a COLMAP workspace that holds more than a run writes in it."""
    marker = folder / DENSE_MARKER
    if not marker.is_file():
        raise DataError(folder, NOT_OURS)
    try:
        written = {*read_text(marker).splitlines(), DENSE_MARKER}
    except (OSError, ValueError) as error:
        raise DataError(
            marker, f"cannot be read ({error}). Move {folder} out of the way."
        ) from error
    for file in folder.rglob("*"):
        plain = file.is_dir() and not file.is_symlink()
        if not plain and file.relative_to(folder).as_posix() not in written:
            raise DataError(file, NOT_OURS)


def mark_own_workspace(folder: Path) -> None:
    """List the files of a COLMAP workspace in it, to recognize a user's files later."""
    lines = sorted(path.relative_to(folder).as_posix() for path in files_in(folder))
    (folder / DENSE_MARKER).write_text("\n".join(lines) + "\n", encoding="utf-8")


def files_in(folder: Path) -> list[Path]:
    """All files in a folder and those within it."""
    return [path for path in folder.rglob("*") if path.is_file()]


def surface_levels(views: Path) -> list[Path]:
    """The closed meshes among dense views: the hull, then after each level of the surface."""
    paths = (views / SURFACE_LEVELS.format(number=number) for number in count())
    return list(takewhile(Path.is_file, paths))


def num_files(path: Path) -> int:
    """Number of files of a path: 1, or those in a folder; 0 if it does not exist."""
    return len(files_in(path)) if path.is_dir() else int(path.exists())


def has_content(folder: Path, apart_from: Set[str] = frozenset()) -> bool:
    """Whether a folder exists and has other entries than these names.

    Raises
    ------
    DataError
        It is a file, or cannot be read.
    """
    try:
        return folder.exists() and any(path.name not in apart_from for path in folder.iterdir())
    except NotADirectoryError as error:
        raise DataError(folder, "is a file; OUT must be a folder.") from error
    except OSError as error:
        raise DataError(folder, f"cannot be used: {error.strerror or error}.") from error
