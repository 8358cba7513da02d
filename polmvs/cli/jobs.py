"""The commands that run a job in an output folder: each calls one function of the pipeline."""

from __future__ import annotations

import json
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import polmvs
from polmvs.camera import PinholeCamera
from polmvs.cli.call import Call
from polmvs.cli.commands import ComparedModels, DemoArguments, JobArguments, ModelChoice
from polmvs.cli.flags import in_flags
from polmvs.cli.terminal import Terminal
from polmvs.config import AngleModel, EvaluationOptions, Options, RunOptions, SfmOptions
from polmvs.evaluation.tables import best_fit_lines, comparison_table
from polmvs.io.ground_truth import open_ground_truth
from polmvs.pipeline import jobs as pipeline
from polmvs.pipeline.run_folder import RunFolder

EMPTY_STATUS = 3
DEMO_CAPTURE = Path(polmvs.__file__).parent / "demo_capture"


def demo(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs demo``."""
    truth = open_ground_truth(DEMO_CAPTURE)
    camera = truth.views[truth.names[0]].camera
    assert isinstance(camera, PinholeCamera)
    options = Options(
        sfm=SfmOptions(intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy)),
        evaluation=EvaluationOptions(gt=DEMO_CAPTURE / "gt"),
    )
    job = pipeline.Job(
        capture=DEMO_CAPTURE,
        out=call.get(DemoArguments).out,
        options=options,
        how=call.get(RunOptions),
        monitor=terminal,
        command_line=call.command_line,
    )
    return _show_comparison(pipeline.compare(job), terminal)


def reconstruct(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs reconstruct``."""
    model = call.get(ModelChoice).angle_model
    return _show_cloud(pipeline.reconstruct(job_of(call, terminal), model), model, terminal)


def compare(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs compare``."""
    models = call.get(ComparedModels).angle_models
    return _show_comparison(pipeline.compare(job_of(call, terminal), models), terminal)


def sfm(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs sfm``."""
    outcome = pipeline.find_poses(job_of(call, terminal))
    results = outcome.results
    text = (
        f"{outcome.workspace.sparse}: {_views(results)} have a pose, "
        f"{results['num_tracks']:,} sparse points"
    )
    terminal.show(text, _content(outcome, terminal))
    return 0


def normals(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs normals``."""
    model = call.get(ModelChoice).angle_model
    outcome = pipeline.solve_normals(job_of(call, terminal, goes_on=True), (model,))
    results = outcome.results
    text = (
        f"{outcome.workspace.normals(model)}: {results[f'num_normals_{model}']:,} of "
        f"{results['num_tracks']:,} sparse points have a normal, {results['num_seeds']:,} are seeds"
    )
    terminal.show(text, _content(outcome, terminal))
    return 0


def densify(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs densify``."""
    model = call.get(ModelChoice).angle_model
    outcome = pipeline.densify(job_of(call, terminal, goes_on=True), (model,))
    return _show_cloud(outcome, model, terminal)


def export(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs export``."""
    model = call.get(ModelChoice).angle_model
    outcome = pipeline.export(job_of(call, terminal, goes_on=True), model)
    return _show_cloud(outcome, model, terminal)


def job_of(call: Call, terminal: Terminal, *, goes_on: bool = False) -> pipeline.Job:
    """The job; one that goes on takes the options of the run in OUT where none are given."""
    arguments, how = call.get(JobArguments), call.get(RunOptions)
    recorded = recorded_options(arguments.out) if how.resume or goes_on else None
    return pipeline.Job(
        capture=arguments.capture,
        out=arguments.out,
        options=call.options(recorded),
        how=how,
        monitor=terminal,
        command_line=call.command_line,
    )


def recorded_options(out: Path) -> Mapping[str, Any]:
    """Options of the run in a folder; empty where there is none."""
    run_folder = RunFolder(out)
    if not run_folder.run_file.is_file():
        return {}
    record = run_folder.load()
    return record.options if record.stages else {}


def _show_cloud(outcome: pipeline.Outcome, model: AngleModel, terminal: Terminal) -> int:
    results, workspace = outcome.results, outcome.workspace
    unit = "metres" if results.get("unit") == "m" else "the model's unit, not metric"
    lines = [
        f"{workspace.cloud(model)}: {results[f'num_points_{model}']:,} points from "
        f"{_views(results)}, and {results[f'num_surroundings_{model}']:,} of the surroundings; "
        f"in {unit}"
    ]
    if workspace.mesh(model).is_file():
        lines.append(f"{workspace.mesh(model)}: {results[f'num_triangles_{model}']:,} triangles")
    dense = results.get(f"dense_{model}")
    if dense is not None and Path(dense).is_dir():
        lines.append(f"{dense}: COLMAP dense workspace")
    terminal.show("\n".join(lines), _content(outcome, terminal))
    return _status(outcome)


def _show_comparison(outcome: pipeline.Outcome, terminal: Terminal) -> int:
    metrics = json.loads(outcome.workspace.metrics.read_text(encoding="utf-8"))
    clouds = ", ".join(f"{model}.ply" for model in metrics["models"])
    last = f"{outcome.workspace.root}: {clouds}, metrics.json, summary.md; "
    lines = [comparison_table(metrics), *best_fit_lines(metrics), last + _views(outcome.results)]
    terminal.show("\n".join(lines), {**_content(outcome, terminal), "metrics": metrics})
    return _status(outcome)


def _content(outcome: pipeline.Outcome, terminal: Terminal) -> dict[str, Any]:
    """The outcome for machines."""
    return {
        "out": outcome.workspace.root,
        "results": outcome.results,
        "empty": outcome.empty,
        "stages": terminal.stages,
        "warnings": terminal.warnings,
    }


def _views(results: dict[str, Any]) -> str:
    num_views = results["num_views"]
    return f"{num_views} of {num_views + len(results['unregistered'])} views"


def _status(outcome: pipeline.Outcome) -> int:
    if outcome.empty is None:
        return 0
    print(f"polmvs: {in_flags(outcome.empty)}", file=sys.stderr)
    return EMPTY_STATUS
