"""The commands that run jobs in output folders: each calls one function of the pipeline."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import polmvs
from polmvs.camera import PinholeCamera
from polmvs.cli.call import Call, RecordingOptions
from polmvs.cli.commands import (
    BatchArguments,
    ComparedModels,
    DemoArguments,
    JobArguments,
    ModelChoice,
    ReportChoice,
)
from polmvs.cli.exit_status import EMPTY_STATUS
from polmvs.cli.flags import in_flags
from polmvs.cli.terminal import Terminal
from polmvs.config import (
    EvaluationOptions,
    Options,
    RunOptions,
    SfmOptions,
)
from polmvs.errors import PolmvsError, printable
from polmvs.evaluation.comparison import best_fit_lines
from polmvs.evaluation.trust import Trust
from polmvs.io.ground_truth import open_ground_truth
from polmvs.pipeline import jobs as pipeline
from polmvs.pipeline.batch import TABLE_FILE, BatchRow, State, batch_table, read_batch, run_batch
from polmvs.pipeline.data_set_import import as_capture
from polmvs.pipeline.record import is_finished, read_options
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.runner import Job
from polmvs.pipeline.stages.dense_workspace import DenseWorkspaceResult
from polmvs.pipeline.stages.densify import DensifyResult
from polmvs.pipeline.stages.mesh import MeshResult
from polmvs.pipeline.stages.normals import NormalsResult
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.pipeline.stages.seeds import SeedsResult
from polmvs.polarization.kinds import AngleModel

DEMO_CAPTURE = Path(polmvs.__file__).parent / "demo_capture"
DEMO_MODELS = (AngleModel.OPA, AngleModel.PPA, AngleModel.TILTED)


def demo(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs demo``."""
    _check_recording(call)
    truth = open_ground_truth(DEMO_CAPTURE)
    camera = truth.views[truth.names[0]].camera
    assert isinstance(camera, PinholeCamera)
    options = Options(
        sfm=SfmOptions(intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy)),
        evaluation=EvaluationOptions(gt=DEMO_CAPTURE / "gt"),
    )
    job = Job(
        capture=DEMO_CAPTURE,
        out=call.get(DemoArguments).out,
        options=options,
        run_options=call.get(RunOptions),
        monitor=terminal,
        command_line=call.command_line,
    )
    return _show_comparison(_reported(pipeline.compare(job, DEMO_MODELS), call, terminal), terminal)


def reconstruct(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs reconstruct``."""
    _check_recording(call)
    model = call.get(ModelChoice).model
    outcome = pipeline.reconstruct(job_of(call, terminal), model)
    return _show_cloud(_reported(outcome, call, terminal), model, terminal)


def compare(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs compare``."""
    _check_recording(call)
    models = call.get(ComparedModels).models
    outcome = pipeline.compare(job_of(call, terminal), models)
    return _show_comparison(_reported(outcome, call, terminal), terminal)


def sfm(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs sfm``."""
    outcome = pipeline.find_poses(job_of(call, terminal))
    num_tracks = outcome.record.result(PosesResult).num_tracks
    text = (
        f"{outcome.run_folder.sparse}: {_views(outcome)} have a pose, {num_tracks:,} sparse points"
    )
    terminal.show([text], _content(outcome, terminal))
    return 0


def normals(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs normals``."""
    model = call.get(ModelChoice).model
    outcome = pipeline.solve_normals(job_of(call, terminal, continues=True), (model,))
    found, seeds = outcome.record.result(NormalsResult, model), outcome.record.result(SeedsResult)
    text = (
        f"{outcome.run_folder.sparse_cloud(model)}: {found.num_normals:,} of "
        f"{found.num_tracks:,} sparse points have a normal, {seeds.num_seeds:,} are seeds"
    )
    terminal.show([text], _content(outcome, terminal))
    return 0


def densify(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs densify``."""
    model = call.get(ModelChoice).model
    outcome = pipeline.densify(job_of(call, terminal, continues=True), (model,))
    return _show_cloud(outcome, model, terminal)


def finish(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs finish``."""
    model = call.get(ModelChoice).model
    outcome = pipeline.finish(job_of(call, terminal, continues=True), model)
    return _show_cloud(outcome, model, terminal)


def batch(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs batch``."""
    arguments = call.get(BatchArguments)
    model = call.get(ModelChoice).model
    entries = read_batch(arguments.list_file, call.options(), model)
    with terminal.stage("captures", len(entries)) as progress:

        def show(row: BatchRow) -> None:
            progress(1)
            found = row.message or f"{row.num_points:,} points"
            terminal.say(in_flags(f"{row.name:<20} {row.seconds:7.1f} s  {row.state}: {found}"))

        rows = run_batch(entries, arguments.out, call.get(RunOptions), show)
    states = [row.state for row in rows]
    last = f"{arguments.out / TABLE_FILE}: " + ", ".join(
        f"{states.count(state)} {state}" for state in State if state in states
    )
    lines = [*in_flags(batch_table(rows)).splitlines(), last]
    terminal.show(lines, {"out": arguments.out, "captures": rows})
    if State.FAILED in states:
        return PolmvsError.exit_status
    return EMPTY_STATUS if State.EMPTY in states else 0


def _reported(outcome: pipeline.JobOutcome, call: Call, terminal: Terminal) -> pipeline.JobOutcome:
    """Write the report and the recording, if the options ask for them."""
    recording = call.get(RecordingOptions).rerun
    if call.get(ReportChoice).report or recording is not None:
        from polmvs.cli.pages import make_recording, make_report

        if call.get(ReportChoice).report:
            make_report(outcome.run_folder, terminal)
        if recording is not None:
            make_recording(outcome.run_folder, recording, terminal)
    return outcome


def _check_recording(call: Call) -> None:
    """Refuse a recording that cannot be made, before the run starts."""
    recording = call.get(RecordingOptions).rerun
    if recording is not None:
        from polmvs.report.recording import require_rerun

        require_rerun(recording)


def job_of(call: Call, terminal: Terminal, *, continues: bool = False) -> Job:
    """The job; a continued job takes options that are not given from the run in OUT."""
    arguments, run_options = call.get(JobArguments), call.get(RunOptions)
    recorded = None
    if run_options.resume or continues:
        run_folder = RunFolder(arguments.out)
        recorded = read_options(run_folder)
        # A given reference replaces the one that failed.
        named = any(option.startswith("reference.") for option in call.given)
        if named and not is_finished(run_folder, "poses"):
            recorded = {name: group for name, group in recorded.items() if name != "reference"}
    capture, options = as_capture(arguments.capture, arguments.out, call.options(recorded))
    return Job(
        capture=capture,
        out=arguments.out,
        options=options,
        run_options=run_options,
        monitor=terminal,
        command_line=call.command_line,
    )


def _show_cloud(outcome: pipeline.JobOutcome, model: AngleModel, terminal: Terminal) -> int:
    folder, cloud = outcome.run_folder, outcome.record.result(DensifyResult, model)
    metric = outcome.record.result(PosesResult).is_metric
    unit = "metres" if metric else "the model's unit, not metric"
    lines = [
        f"{folder.cloud(model)}: {cloud.num_points:,} points from {_views(outcome)}, and "
        f"{cloud.num_surroundings:,} of the surroundings; in {unit}"
    ]
    mesh = outcome.record.find(MeshResult, model)
    if mesh is not None and mesh.num_triangles:
        lines.append(f"{folder.mesh(model)}: {mesh.num_triangles:,} triangles")
    dense = outcome.record.find(DenseWorkspaceResult, model)
    if dense is not None and dense.folder is not None:
        lines.append(f"{dense.folder}: COLMAP dense workspace")
    trust = outcome.record.find(Trust, model)
    if trust is not None and cloud.num_points:
        lines = [f"{model.upper()}: {trust.verdict}", *lines, *map(str, trust.figures())]
    terminal.show([in_flags(line) for line in lines], _content(outcome, terminal))
    return _status(outcome, terminal)


def _show_comparison(outcome: pipeline.JobOutcome, terminal: Terminal) -> int:
    comparison = outcome.comparison
    assert comparison is not None
    clouds = ", ".join(f"{model}.ply" for model in comparison.models)
    last = f"{outcome.run_folder.root}: {clouds}, metrics.json, summary.md; {_views(outcome)}"
    lines = [*comparison.table().splitlines(), *best_fit_lines(comparison), last]
    terminal.show(lines, {**_content(outcome, terminal), "metrics": comparison})
    return _status(outcome, terminal)


def _content(outcome: pipeline.JobOutcome, terminal: Terminal) -> dict[str, Any]:
    """The outcome for machines."""
    return {
        "out": outcome.run_folder.root,
        "results": {stage.name: stage.result for stage in outcome.record.stages},
        "empty": outcome.empty,
        "stages": terminal.stages,
        "warnings": terminal.warnings,
    }


def _views(outcome: pipeline.JobOutcome) -> str:
    poses = outcome.record.result(PosesResult)
    return f"{poses.num_views} of {poses.num_views + len(poses.unregistered)} views"


def _status(outcome: pipeline.JobOutcome, terminal: Terminal) -> int:
    if outcome.empty is None:
        return 0
    terminal.repeat_warnings()
    print(f"polmvs: {printable(in_flags(outcome.empty))}", file=sys.stderr)
    return EMPTY_STATUS
