"""Reconstruct a capture with one model: the whole chain as one call of the library.

    python pipelines/reconstruct.py CAPTURE OUT [--model opa] [--intrinsics fx,fy,cx,cy] ...

The same as ``polmvs reconstruct``, to copy and change.
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from polmvs.cli.flags import GROUPS, add_flags, add_run_flags, options_from, run_options
from polmvs.cli.terminal import Terminal, guarded
from polmvs.config import AngleModel
from polmvs.pipeline.jobs import Job, reconstruct
from polmvs.pipeline.stages.densify import DensifyResult


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("capture", type=Path, help="folder of raw polarizer mosaics")
    parser.add_argument("out", type=Path, help="folder of the results")
    parser.add_argument(
        "--model", type=AngleModel, choices=list(AngleModel), default=AngleModel.PPA
    )
    add_run_flags(parser)
    add_flags(parser, [name for name in GROUPS if name != "evaluation"])
    args = parser.parse_args(argv)

    def run() -> int:
        job = Job(
            capture=args.capture,
            out=args.out,
            options=options_from(args),
            run_options=run_options(args),
            monitor=terminal,
        )
        outcome = reconstruct(job, args.model)
        cloud = outcome.run_folder.cloud(args.model)
        print(outcome.empty or f"{cloud}: {outcome.result(DensifyResult, args.model)}")
        return 0 if outcome.empty is None else 3

    with Terminal(verbose=True) as terminal:
        return guarded(run, terminal, parser.prog)


if __name__ == "__main__":
    raise SystemExit(main())
