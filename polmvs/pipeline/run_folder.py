"""The output folder of a run: its files, and the record of what is finished (``run.json``).

Everything is written whole or not at all. What carries a temporary name belongs to an unfinished
stage and is removed when the run goes on.
"""

from __future__ import annotations

import json
import logging
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from polmvs.config import AngleModel
from polmvs.errors import DataError, OptionError
from polmvs.pipeline.own_files import require_own
from polmvs.pipeline.record import Record, StageRecord, write_json

logger = logging.getLogger(__name__)

RUN_FILE = "run.json"
LOG_FILE = "polmvs.log"


@dataclass(frozen=True)
class RunFolder:
    """Paths of an output folder.

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
    def maps(self) -> Path:
        """Phase maps and seeds: what the later stages read."""
        return self.root / "maps"

    @property
    def metrics(self) -> Path:
        """Figures of a comparison."""
        return self.root / "metrics.json"

    @property
    def summary(self) -> Path:
        """The same as a table to read."""
        return self.root / "summary.md"

    @property
    def run_file(self) -> Path:
        """Record of the run."""
        return self.root / RUN_FILE

    @property
    def log(self) -> Path:
        """Log of all calls."""
        return self.root / LOG_FILE

    def normals(self, model: AngleModel) -> Path:
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

    def files_of(self, stage: str) -> list[Path]:
        """Files, and a folder, that nothing but this stage writes; those of all stages left out."""
        if stage == "evaluate":
            return [self.metrics, self.summary]
        kind, _, model = stage.partition("_")
        if kind == "normals":
            return [self.normals(AngleModel(model or AngleModel.PPA))]
        if kind == "densify":
            return [self.cloud(AngleModel(model))]
        if kind == "dense":
            return [self.dense(AngleModel(model))]
        return [self.mesh(AngleModel(model))] if kind == "mesh" else []

    def require_own(self, path: Path) -> None:
        """Refuse, by DataError, to delete a folder that holds more than a stage wrote."""
        if path.is_dir():
            require_own(path, set())

    def discard(self, path: Path) -> None:
        """Delete a file or folder that a stage wrote, if it is there."""
        if path.is_dir():
            self.require_own(path)
            shutil.rmtree(path)
        path.unlink(missing_ok=True)

    def temporary(self, name: str) -> Path:
        """A name in the folder for work that is not finished."""
        return self.root / f".{name}.tmp"

    @contextmanager
    def replacing(self, target: Path) -> Iterator[Path]:
        """A new folder that takes the place of ``target`` when all went well, else goes."""
        with self.scratch(target.name) as folder:
            yield folder
            self.replace(folder, target)

    def replace(self, folder: Path, target: Path) -> None:
        """Put a finished folder in the place of another one.

        Raises
        ------
        DataError
            The other one holds files that no run wrote.
        """
        if target.exists():
            names = {file.name for file in folder.iterdir()}
            require_own(target, names)
            shutil.rmtree(target)
        folder.replace(target)

    @contextmanager
    def scratch(self, name: str) -> Iterator[Path]:
        """A new folder that goes when the work is done or fails."""
        folder = self.temporary(name)
        try:
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir(parents=True)
            yield folder
        finally:
            shutil.rmtree(folder, ignore_errors=True)

    def load(self) -> Record:
        """Read ``run.json``.

        Raises
        ------
        DataError
            It is missing or no record of a run.
        """
        try:
            content = json.loads(self.run_file.read_text(encoding="utf-8"))
            stages = [StageRecord(**stage) for stage in content.pop("stages")]
            return Record(stages=stages, **content)
        except FileNotFoundError as error:
            raise DataError(
                self.root, f"holds no run of polmvs ({RUN_FILE} is missing)."
            ) from error
        except (OSError, ValueError, TypeError, KeyError, AttributeError) as error:
            raise DataError(
                self.run_file, f"is no record of a run ({error}). Give another OUT."
            ) from error

    def save(self, record: Record) -> None:
        """Write ``run.json``."""
        write_json(self.run_file, asdict(record))


def prepare_output(workspace: RunFolder, *, overwrite: bool, resume: bool) -> Record:
    """Make the output folder ready and give the record that the run starts from.

    Parameters
    ----------
    overwrite : delete the results of an earlier run. Only what polmvs wrote is deleted.
    resume : keep them and go on.

    Raises
    ------
    OptionError
        The folder holds something and neither was asked for.
    DataError
        It cannot be made, or holds files with our names that no run of polmvs wrote.
    """
    root = workspace.root
    occupied = has_content(root)
    if occupied and resume:
        record = workspace.load()
        _remove_temporary(root)
        return record
    if occupied and not overwrite:
        raise OptionError(
            f"{root}: exists and is not empty. Give --overwrite to delete an earlier run in it, "
            "--resume to go on with it, or another OUT."
        )
    if occupied:
        _remove_results(workspace)
    try:
        root.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise DataError(root, f"cannot be made: {error.strerror or error}.") from error
    return Record()


def require_apart(workspace: RunFolder, *, capture: Path, others: Sequence[Path]) -> None:
    """Refuse an output folder whose results would be mixed with the input, or delete it.

    Parameters
    ----------
    capture : folder of the raw mosaics.
    others : further folders that are read.

    Raises
    ------
    OptionError
        The output folder is the capture's, or the input lies where results go.
    """
    root = workspace.root.resolve()
    if root in (capture.resolve(), (capture / "raw").resolve()):
        raise OptionError(f"{workspace.root}: OUT is the capture's own folder. Give another OUT.")
    written = [root / name for name in result_names()]
    for path in (capture, *others):
        resolved = path.resolve()
        if any(resolved == place or place in resolved.parents for place in written):
            raise OptionError(f"{path}: lies where OUT's results go. Give another OUT.")


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


def result_names() -> list[str]:
    """Names of all files and folders that a run may write, the record last."""
    names = ["images", "sparse", "maps", "metrics.json", "summary.md", LOG_FILE]
    for model in AngleModel:
        here = RunFolder(Path())
        names += [here.normals(model).name, here.cloud(model).name, here.views(model).name]
        names += [here.mesh(model).name, here.dense(model).name]
    return [*names, RUN_FILE]


def _remove_results(workspace: RunFolder) -> None:
    """Delete what an earlier run wrote; other files stay."""
    root = workspace.root
    present = [name for name in result_names() if os.path.lexists(root / name)]
    if not present:
        return
    if RUN_FILE not in present:
        raise DataError(
            root / present[0],
            f"was not written by polmvs ({RUN_FILE} is missing) and is not overwritten. "
            "Give another OUT.",
        )
    images = set(workspace.load().images)
    folders = [root / name for name in present if (root / name).is_dir()]
    for folder in folders:
        require_own(folder, images if folder == workspace.images else set())
    try:
        _remove_temporary(root)
        for name in present:
            path = root / name
            if path in folders:
                shutil.rmtree(path)
            else:
                path.unlink()
    except OSError as error:
        raise DataError(root, f"cannot be emptied: {error.strerror or error}.") from error


def _remove_temporary(root: Path) -> None:
    """Remove what a killed run left half done."""
    for path in root.glob(".*.tmp*"):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
