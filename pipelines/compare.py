"""Compare OPA and PPA on several captures, one output folder each, and print their tables.

    python pipelines/compare.py OUT CAPTURE [CAPTURE ...] [--intrinsics fx,fy,cx,cy] ...

A capture that holds a ``gt`` folder is measured against it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass, replace
from pathlib import Path

from polmvs.cli.call import Call
from polmvs.cli.commands import EXECUTION, TO_CLOUD
from polmvs.cli.exit_status import EMPTY_STATUS
from polmvs.cli.flags import Command
from polmvs.cli.running import run
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, RunOptions, option, replace_option
from polmvs.pipeline.jobs import compare
from polmvs.pipeline.runner import Job


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    out: Path = option(MISSING, "folder of the results, one folder in it for each", positional=True)
    captures: tuple[Path, ...] = option(
        MISSING, "folders of raw polarizer mosaics", positional=True, metavar="CAPTURE"
    )


def _compare(call: Call, terminal: Terminal) -> int:
    arguments, status = call.get(Arguments), 0
    job = Job(
        capture=arguments.out,
        out=arguments.out,
        options=call.options(),
        run_options=call.get(RunOptions),
        monitor=terminal,
    )
    for capture in arguments.captures:
        gt = capture / "gt" if (capture / "gt").is_dir() else None
        options = replace_option(job.options, "evaluation.gt", gt)
        out = arguments.out / capture.resolve().name
        outcome = compare(replace(job, capture=capture, out=out, options=options))
        assert outcome.comparison is not None
        print(f"{capture}\n{outcome.comparison.table()}\n")
        status = status if outcome.empty is None else EMPTY_STATUS
    return status


COMMAND = Command(
    help_text="compare the models on several captures",
    run=_compare,
    groups=(Arguments, *TO_CLOUD, *EXECUTION),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    return run((COMMAND,), "compare.py", argv)


if __name__ == "__main__":
    raise SystemExit(main())
