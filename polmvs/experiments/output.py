"""Results as files: ``NAME.json``, ``NAME.md`` and their figures, written whole or not at all."""

from __future__ import annotations

import os
import re
import shutil
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import mkdtemp
from typing import Any

from polmvs.config import Experiment
from polmvs.errors import OptionError, as_data_error
from polmvs.io.typed_json import json_bytes
from polmvs.pipeline.run_folder import has_content

NAMES = tuple(Experiment)
_OWN = re.compile(rf"({'|'.join(NAMES)})(_\w+)?\.(json|md|png|ply)")


@dataclass(frozen=True, kw_only=True)
class Report:
    """Results of one experiment, ready to be written.

    Attributes
    ----------
    name : of the experiment.
    title : of its section.
    content : of ``NAME.json``.
    text : Markdown: the procedure and the tables.
    figures : caption and PNG by file name.
    lines : PLY line sets by file name.
    """

    name: str
    title: str
    content: Mapping[str, Any]
    text: str
    figures: Mapping[str, tuple[str, bytes]]
    lines: Mapping[str, bytes] = field(default_factory=dict)

    def section(self, folder: str = "", *, level: int = 1) -> str:
        """Markdown of the experiment, its heading of a level; figures lie in ``folder``."""
        images = [f"![{caption}]({folder}{name})\n" for name, (caption, _) in self.figures.items()]
        return "\n".join([f"{'#' * level} {self.title}\n", self.text, *images])

    def files(self) -> dict[str, bytes]:
        """All files by name, the JSON last: if it exists, the others do."""
        return {
            **{name: png for name, (_, png) in self.figures.items()},
            **self.lines,
            f"{self.name}.md": self.section().encode(),
            f"{self.name}.json": json_bytes(self.content),
        }


def check_output(out: Path, name: str, *, overwrite: bool) -> None:
    """Refuse an output folder with other content; several experiments may share one.

    Raises
    ------
    OptionError
        It has results of this experiment, or files of another kind, and ``overwrite`` is off.
    DataError
        It cannot be used.
    """
    if not has_content(out) or overwrite:
        return
    names = [path.name for path in out.iterdir()]
    foreign = [other for other in names if not _OWN.fullmatch(other)]
    if f"{name}.json" in names or foreign:
        raise OptionError(
            f"{out}: exists and is not empty. Give `run.overwrite` to replace results of '{name}' "
            "in it, or another OUT."
        )


def write_report(out: Path, report: Report) -> None:
    """Write all files of a report under temporary names, then rename them.

    Older results of the same experiment are replaced; other files stay unchanged.

    Raises
    ------
    DataError
        The system refuses; then no file has its final name.
    """
    write_files(out, report.files())
    for path in out.iterdir():
        match = _OWN.fullmatch(path.name)
        if match and match[1] == report.name and path.name not in report.files():
            path.unlink(missing_ok=True)


def write_files(out: Path, files: Mapping[str, bytes]) -> None:
    """Write files into a folder, all of them or none.

    Raises
    ------
    DataError
        The system refuses.
    """
    with as_data_error(out, "made"):
        out.mkdir(parents=True, exist_ok=True)
        scratch = Path(mkdtemp(prefix=".experiment-", dir=out))
    try:
        with as_data_error(out, "written"):
            for name, data in files.items():
                (scratch / name).write_bytes(data)
            for name in files:
                os.replace(scratch / name, out / name)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
