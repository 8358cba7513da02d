"""All experiments of the paper over a list of captures: one page, Markdown and JSON, with figures.

    python pipelines/paper.py OUT CAPTURE [CAPTURE ...]

Each capture brings its ground truth (in its ``gt/``, or the board of the authors' layout). The
page is ``OUT/paper.md``, its figures lie in ``OUT/CAPTURE/``, all numbers in ``OUT/paper.json``.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from polmvs.cli.flags import add_flags
from polmvs.cli.terminal import Terminal, guarded
from polmvs.errors import OptionError
from polmvs.experiments.command import (
    add_experiment_flags,
    experiment_options,
    require_apart,
    scene_from,
)
from polmvs.experiments.output import NAMES, Report, write_files, write_report
from polmvs.experiments.reports import num_steps, run_experiment
from polmvs.option_values import to_plain
from polmvs.parallel import Workers
from polmvs.pipeline.record import peak_rss_mb, versions
from polmvs.pipeline.run_folder import has_content


def main(argv: Sequence[str] | None = None) -> int:
    """Run the experiments; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the page")
    parser.add_argument("captures", type=Path, nargs="+", metavar="CAPTURE", help="with truth")
    add_experiment_flags(parser)
    add_flags(parser, ["capture", "region"])
    args = parser.parse_args(argv)
    with Terminal(verbose=False) as terminal:
        return guarded(lambda: _run(args, terminal), terminal, parser.prog)


def _run(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run all, then write all."""
    names = [folder.resolve().name for folder in args.captures]
    if len(set(names)) < len(names):
        raise OptionError("two captures have the same folder name; their results would mix.")
    if len(names) > 1 and (args.gt is not None or args.sparse is not None):
        raise OptionError("--gt and --sparse belong to one capture; give that one alone.")
    if has_content(args.out) and not args.overwrite:
        raise OptionError(f"{args.out}: exists and is not empty. Give --overwrite or another OUT.")
    scenes = []
    for folder in args.captures:
        args.capture = folder
        require_apart(args)
        scenes.append(scene_from(args))
    options = [experiment_options(args, scene, NAMES) for scene in scenes]
    reports: dict[str, list[Report]] = {}
    seconds: dict[str, dict[str, float]] = {}
    with Workers(args.workers) as workers:
        for capture, scene, chosen in zip(names, scenes, options, strict=True):
            reports[capture], seconds[capture] = [], {}
            for name in NAMES:
                start = time.perf_counter()
                steps = num_steps(name, scene, chosen)
                with terminal.stage(f"{capture} {name}", steps) as progress:
                    report = run_experiment(name, scene, chosen, workers, progress)
                seconds[capture][name] = round(time.perf_counter() - start, 2)
                reports[capture].append(report)
                print(f"{capture}: {name} {seconds[capture][name]:.1f} s", file=sys.stderr)
        memory = round(peak_rss_mb())
    for capture in names:
        for report in reports[capture]:
            write_report(args.out / capture, report)
    write_files(args.out, _page(reports, seconds, memory, args.workers))
    print(args.out / "paper.md")
    return 0


def _page(
    reports: dict[str, list[Report]],
    seconds: dict[str, dict[str, float]],
    memory: int,
    workers: int,
) -> dict[str, bytes]:
    """The page and its numbers, by file name."""
    total = sum(sum(times.values()) for times in seconds.values())
    lines = [
        "# The paper's experiments\n",
        "OPA, PPA and tilted, the paper's estimators and ours, in one run. "
        f"{total:.0f} s with {workers} processes, at most {memory} MB.\n",
    ]
    for capture, own in reports.items():
        lines.append(f"## {capture}\n")
        lines += [report.section(f"{capture}/", level=3) for report in own]
    content: dict[str, Any] = {
        "captures": {
            capture: {report.name: report.content for report in own}
            for capture, own in reports.items()
        },
        "seconds": seconds,
        "workers": workers,
        "peak_rss_mb": memory,
        "versions": versions(),
    }
    text = json.dumps(to_plain(content), indent=1, allow_nan=False) + "\n"
    return {"paper.md": "\n".join(lines).encode(), "paper.json": text.encode()}


if __name__ == "__main__":
    raise SystemExit(main())
