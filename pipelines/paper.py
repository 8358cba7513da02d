"""All experiments of the paper over a list of captures: one page, Markdown and JSON, with figures.

    python pipelines/paper.py OUT CAPTURE [CAPTURE ...]

Each capture brings its ground truth (in its ``gt/``, or the board of the authors' layout). The
page is ``OUT/paper.md``, its figures lie in ``OUT/CAPTURE/``, all numbers in ``OUT/paper.json``.
"""

from __future__ import annotations

import time
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import Any

from polmvs.cli.call import Call, FileOptions, TerminalOptions
from polmvs.cli.commands import ExperimentRun
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import (
    CaptureOptions,
    ExperimentOptions,
    OptionGroup,
    RegionOptions,
    option,
)
from polmvs.errors import OptionError
from polmvs.experiments.data import open_experiment, require_apart
from polmvs.experiments.output import NAMES, Report, write_files, write_report
from polmvs.experiments.report import check_options, num_steps, run_experiment
from polmvs.io.typed_json import json_bytes
from polmvs.memory import PeakMemory
from polmvs.parallel import Workers
from polmvs.pipeline.record import versions
from polmvs.pipeline.run_folder import has_content


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    out: Path = option(MISSING, "folder of the page", positional=True)
    captures: tuple[Path, ...] = option(
        MISSING, "captures with truth", positional=True, metavar="CAPTURE"
    )


def _paper(call: Call, terminal: Terminal) -> int:
    """Run all, then write all."""
    given, running = call.get(Arguments), call.get(ExperimentRun)
    options = call.get(ExperimentOptions)
    names = [folder.resolve().name for folder in given.captures]
    if len(set(names)) < len(names):
        raise OptionError("two captures have the same folder name; their results would mix.")
    if len(names) > 1 and (options.gt is not None or options.sparse is not None):
        raise OptionError(
            "`experiment.gt` and `experiment.sparse` belong to one capture; give that one alone."
        )
    if has_content(given.out) and not running.overwrite:
        raise OptionError(
            f"{given.out}: exists and is not empty. Give `run.overwrite` or another OUT."
        )
    scenes = []
    for folder in given.captures:
        require_apart(given.out, folder)
        scene = open_experiment(folder, options, call.get(CaptureOptions), call.get(RegionOptions))
        check_options(scene, options, NAMES)
        scenes.append(scene)
    reports: dict[str, list[Report]] = {}
    seconds: dict[str, dict[str, float]] = {}
    memory = PeakMemory()
    with Workers(running.workers) as workers:
        for capture, scene in zip(names, scenes, strict=True):
            reports[capture], seconds[capture] = [], {}
            for name in NAMES:
                start = time.perf_counter()
                with terminal.stage(
                    f"{capture} {name}", num_steps(name, scene, options)
                ) as on_progress:
                    reports[capture].append(
                        run_experiment(name, scene, options, workers, on_progress)
                    )
                seconds[capture][name] = round(time.perf_counter() - start, 2)
                terminal.finished(f"{capture} {name}", seconds[capture][name], "")
        peak_mb = round(memory.mb())
    for capture in names:
        for made in reports[capture]:
            write_report(given.out / capture, made)
    write_files(given.out, _page(reports, seconds, peak_mb, running.workers))
    terminal.show(str(given.out / "paper.md"), {"page": given.out / "paper.md"})
    return 0


def _page(
    reports: dict[str, list[Report]],
    seconds: dict[str, dict[str, float]],
    peak_mb: int,
    workers: int,
) -> dict[str, bytes]:
    """The page and its numbers, by file name."""
    total = sum(sum(times.values()) for times in seconds.values())
    lines = [
        "# The paper's experiments\n",
        "OPA, PPA and tilted, the paper's estimators and ours, in one run. "
        f"{total:.0f} s with {workers} processes, at most {peak_mb} MB.\n",
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
        "peak_rss_mb": peak_mb,
        "versions": versions(),
    }
    return {"paper.md": "\n".join(lines).encode(), "paper.json": json_bytes(content)}


main = script(
    __file__,
    __doc__,
    _paper,
    (
        Arguments,
        ExperimentOptions,
        CaptureOptions,
        RegionOptions,
        ExperimentRun,
        FileOptions,
        TerminalOptions,
    ),
)

if __name__ == "__main__":
    raise SystemExit(main())
