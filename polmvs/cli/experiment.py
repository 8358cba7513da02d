"""``polmvs experiment``: one of the paper's experiments on a capture with ground truth."""

from __future__ import annotations

from polmvs.cli.call import Call
from polmvs.cli.commands import ExperimentArguments, ExperimentRun
from polmvs.cli.terminal import Terminal
from polmvs.config import CaptureOptions, ExperimentOptions, RegionOptions
from polmvs.experiments.data import open_experiment, require_apart
from polmvs.experiments.output import check_output, write_report
from polmvs.experiments.report import check_options, num_steps, run_experiment
from polmvs.parallel import Workers


def experiment(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs experiment``; results are written only if it completes."""
    arguments, run = call.get(ExperimentArguments), call.get(ExperimentRun)
    name, out = arguments.name, arguments.out
    options = call.get(ExperimentOptions)
    check_output(out, name, overwrite=run.overwrite)
    require_apart(out, arguments.capture)
    scene = open_experiment(
        arguments.capture, options, call.get(CaptureOptions), call.get(RegionOptions)
    )
    check_options(scene, options, (name,))
    with (
        Workers(run.workers) as workers,
        terminal.stage(name, num_steps(name, scene, options)) as on_progress,
    ):
        report = run_experiment(name, scene, options, workers, on_progress)
    write_report(out, report)
    terminal.show([*report.text.splitlines(), f"{out / name}.json"], report.content)
    return 0
