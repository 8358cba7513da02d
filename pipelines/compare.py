"""Compare OPA and PPA on several captures, one output folder each, and print their tables.

    python pipelines/compare.py OUT CAPTURE [CAPTURE ...] [--intrinsics fx,fy,cx,cy] ...

A capture that holds a ``gt`` folder is measured against it.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from polmvs.cli.flags import GROUPS, add_flags, add_run_flags, options_from, run_options
from polmvs.cli.terminal import Terminal, guarded
from polmvs.config import EvaluationOptions
from polmvs.pipeline.jobs import Job, compare


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("out", type=Path, help="folder of the results, one folder in it for each")
    parser.add_argument("captures", type=Path, nargs="+", help="folders of raw polarizer mosaics")
    add_run_flags(parser)
    add_flags(parser, [name for name in GROUPS if name != "evaluation"])
    args = parser.parse_args(argv)

    def run() -> int:
        options, status = options_from(args), 0
        for capture in args.captures:
            gt = capture / "gt" if (capture / "gt").is_dir() else None
            job = Job(
                capture=capture,
                out=args.out / capture.resolve().name,
                options=replace(options, evaluation=EvaluationOptions(gt=gt)),
                run_options=run_options(args),
                monitor=terminal,
            )
            outcome = compare(job)
            assert outcome.comparison is not None
            print(f"{capture}\n{outcome.comparison.table()}\n")
            status = status if outcome.empty is None else 3
        return status

    with Terminal(verbose=False) as terminal:
        return guarded(run, terminal, parser.prog)


if __name__ == "__main__":
    raise SystemExit(main())
