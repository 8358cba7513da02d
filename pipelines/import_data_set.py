"""Make a public polarization set (ppa4p3d, PISR, PANDORA, NeRSP, MVAS) ready for ``reconstruct``.

    python pipelines/import_data_set.py SET OUT [--bayer rggb]

The set stays as it is. OUT gets the options to read it, its poses as a COLMAP model whose points
are triangulated, its masks, and its images where they are in no form that is read.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.flags import Command
from polmvs.cli.running import run
from polmvs.cli.terminal import Terminal
from polmvs.config import BayerOrder, OptionGroup, option
from polmvs.pipeline.data_set_import import ImportedSet, import_data_set


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    folder: Path = option(MISSING, "folder of one object or scene", positional=True, metavar="SET")
    out: Path = option(MISSING, "folder to make", positional=True)
    bayer: BayerOrder = option(
        BayerOrder.RGGB, "colours of raw colour mosaics' 2x2 blocks, which no set says"
    )


def _import(call: Call, terminal: Terminal) -> int:
    given = call.get(Arguments)
    imported = import_data_set(given.folder, given.out, bayer=given.bayer)
    num_views = len(imported.data_set.names)
    lines = [f"{given.out}: {num_views} views of {imported.data_set.kind}"]
    if imported.num_points is not None:
        lines.append(f"{imported.sparse}: given poses, {imported.num_points:,} points")
    lines.append(" ".join(["polmvs reconstruct", *arguments_of(imported)]))
    terminal.show(
        "\n".join(lines),
        {"kind": imported.data_set.kind, "num_views": num_views, "points": imported.num_points},
    )
    return 0


def arguments_of(imported: ImportedSet) -> list[str]:
    """What to call ``polmvs reconstruct`` with."""
    words = [str(imported.capture), "RUN", "--config", str(imported.options_file)]
    if imported.sparse is not None:
        words += ["--sparse", str(imported.sparse)]
    if imported.masks is not None:
        words += ["--mask", str(imported.masks)]
    if imported.light is not None:
        words += ["--light", str(imported.light)]
    return words


COMMAND = Command(
    help_text="make a public polarization set ready for reconstruct",
    run=_import,
    groups=(Arguments, TerminalOptions),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    return run((COMMAND,), "import_data_set.py", argv)


if __name__ == "__main__":
    raise SystemExit(main())
