"""The commands: each calls one library function and prints what came of it."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

import polmvs
from polmvs.camera import PinholeCamera
from polmvs.cli.flags import options_from, recorded_options, run_options
from polmvs.cli.terminal import Terminal
from polmvs.config import AngleModel, EvaluationOptions, Options, RunOptions, SfmOptions
from polmvs.errors import OptionError
from polmvs.evaluation.comparison import evaluate_file
from polmvs.evaluation.tables import best_fit_lines, evaluation_text
from polmvs.io.clouds import read_cloud, write_mesh
from polmvs.io.ground_truth import open_ground_truth
from polmvs.option_values import to_plain
from polmvs.pipeline import jobs as pipeline
from polmvs.pipeline.stages.dense_workspace import DenseWorkspaceResult
from polmvs.pipeline.stages.densify import DensifyResult
from polmvs.pipeline.stages.mesh import MeshResult
from polmvs.pipeline.stages.normals import NormalsResult
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.pipeline.stages.seeds import SeedsResult
from polmvs.surface.poisson import poisson_mesh

EMPTY_STATUS = 3
DEMO_CAPTURE = Path(polmvs.__file__).parent / "demo_capture"
DEMO_OUT = Path("polmvs-demo")


def demo(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs demo``."""
    truth = open_ground_truth(DEMO_CAPTURE)
    camera = truth.views[truth.names[0]].camera
    assert isinstance(camera, PinholeCamera)
    options = Options(
        sfm=SfmOptions(intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy)),
        evaluation=EvaluationOptions(gt=DEMO_CAPTURE / "gt"),
    )
    job = _job(args, terminal, DEMO_CAPTURE, options, run_options(args))
    return _report_comparison(pipeline.compare(job))


def reconstruct(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs reconstruct``."""
    outcome = pipeline.reconstruct(_job_from(args, terminal), args.model)
    return _report_cloud(outcome, args.model)


def compare(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs compare``."""
    return _report_comparison(pipeline.compare(_job_from(args, terminal), args.models))


def evaluate(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs evaluate``."""
    figures = evaluate_file(args.cloud, args.gt, args.sparse)
    print(json.dumps(to_plain(figures), indent=1) if args.json else evaluation_text(figures))
    return 0


def sfm(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs sfm``."""
    outcome = pipeline.find_poses(_job_from(args, terminal))
    poses = outcome.result(PosesResult)
    print(
        f"{outcome.run_folder.sparse}: {_views(outcome)} have a pose, "
        f"{poses.num_tracks:,} sparse points"
    )
    return 0


def normals(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs normals``."""
    outcome = pipeline.solve_normals(_job_from(args, terminal, continues=True), (args.model,))
    found, seeds = outcome.result(NormalsResult, args.model), outcome.result(SeedsResult)
    print(
        f"{outcome.run_folder.sparse_cloud(args.model)}: {found.num_normals:,} of "
        f"{found.num_tracks:,} sparse points have a normal, {seeds.num_track_seeds:,} are seeds"
    )
    return 0


def densify(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs densify``."""
    outcome = pipeline.densify(_job_from(args, terminal, continues=True), (args.model,))
    return _report_cloud(outcome, args.model)


def export(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs export``."""
    outcome = pipeline.export(_job_from(args, terminal, continues=True), args.model)
    return _report_cloud(outcome, args.model)


def mesh(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs mesh``."""
    if args.mesh.exists() and not args.overwrite:
        raise OptionError(f"{args.mesh}: exists. Give --overwrite to replace it.")
    made = poisson_mesh(read_cloud(args.cloud), source=args.cloud)
    write_mesh(args.mesh, made)
    print(f"{args.mesh}: {len(made.triangles):,} triangles")
    return 0


def _job_from(
    args: argparse.Namespace, terminal: Terminal, *, continues: bool = False
) -> pipeline.Job:
    """The job; one that goes on takes the options of the run in OUT where none are given."""
    how = run_options(args)
    recorded = recorded_options(args.out) if how.resume or continues else None
    return _job(args, terminal, args.capture, options_from(args, recorded), how)


def _job(
    args: argparse.Namespace, terminal: Terminal, capture: Path, options: Options, how: RunOptions
) -> pipeline.Job:
    return pipeline.Job(
        capture=capture,
        out=args.out,
        options=options,
        run_options=how,
        monitor=terminal,
        command_line=args.command_line,
    )


def _report_cloud(outcome: pipeline.JobOutcome, model: AngleModel) -> int:
    folder, cloud = outcome.run_folder, outcome.result(DensifyResult, model)
    metric = outcome.result(PosesResult).is_metric
    unit = "metres" if metric else "the model's unit, not metric"
    print(
        f"{folder.cloud(model)}: {cloud.num_points:,} points from {_views(outcome)}, and "
        f"{cloud.num_surroundings:,} of the surroundings; in {unit}"
    )
    mesh = outcome.find(MeshResult, model)
    if mesh is not None and mesh.num_triangles:
        print(f"{folder.mesh(model)}: {mesh.num_triangles:,} triangles")
    dense = outcome.find(DenseWorkspaceResult, model)
    if dense is not None and dense.folder is not None:
        print(f"{dense.folder}: COLMAP dense workspace")
    return _status(outcome)


def _report_comparison(outcome: pipeline.JobOutcome) -> int:
    comparison = outcome.comparison
    assert comparison is not None
    print("\n".join([comparison.table(), *best_fit_lines(comparison)]))
    clouds = ", ".join(f"{model}.ply" for model in comparison.models)
    print(f"{outcome.run_folder.root}: {clouds}, metrics.json, summary.md; {_views(outcome)}")
    return _status(outcome)


def _views(outcome: pipeline.JobOutcome) -> str:
    poses = outcome.result(PosesResult)
    return f"{poses.num_views} of {poses.num_views + len(poses.unregistered)} views"


def _status(outcome: pipeline.JobOutcome) -> int:
    if outcome.empty is None:
        return 0
    print(f"polmvs: {outcome.empty}", file=sys.stderr)
    return EMPTY_STATUS
