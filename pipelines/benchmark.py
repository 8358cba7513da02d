"""Print the seconds and memory of the stages of one or more runs, side by side.

    python pipelines/benchmark.py OUT [OUT ...]
    python pipelines/benchmark.py --capture CAPTURE OUT [flags of polmvs compare]
    OMP_NUM_THREADS=1 python pipelines/benchmark.py --estimators

With ``--capture`` that capture is run first, into the only OUT. ``--estimators`` times the normal
estimators beside a plain NumPy baseline.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import benchmark_estimators

from polmvs.cli import main as run_polmvs
from polmvs.errors import PolmvsError
from polmvs.summary import stage_table
from polmvs.workspace import RUN_FILE, Workspace


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "runs", type=Path, nargs="*", metavar="OUT", help="folders of finished runs"
    )
    parser.add_argument("--capture", type=Path, help="compare the models on this capture first")
    parser.add_argument("--estimators", action="store_true", help="time the normal estimators")
    args, flags = parser.parse_known_args(argv)
    if args.estimators:
        print(benchmark_estimators.run())
    if not args.runs:
        return 0 if args.estimators else parser.error("give the folder of a run, or --estimators")
    if args.capture is not None:
        if len(args.runs) != 1:
            parser.error("--capture goes with one OUT")
        status = run_polmvs(["compare", str(args.capture), str(args.runs[0]), *flags])
        if status != 0:
            return status
    elif flags:
        parser.error(f"unknown arguments: {' '.join(flags)}")
    try:
        records = {str(out): asdict(Workspace(_folder(out)).load()) for out in args.runs}
    except PolmvsError as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return error.exit_status
    print(stage_table(records))
    return 0


def _folder(path: Path) -> Path:
    """The folder of a run, which may be named by its ``run.json``."""
    return path.parent if path.name == RUN_FILE else path


if __name__ == "__main__":
    raise SystemExit(main())
