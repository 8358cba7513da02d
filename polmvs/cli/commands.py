"""The commands: each calls one library function and prints what came of it."""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import Any

import polmvs
from polmvs.camera import PinholeCamera
from polmvs.cli.flags import options_from, recorded_options, run_options
from polmvs.cli.terminal import Terminal
from polmvs.config import AngleModel, EvaluationOptions, Options, RunOptions, SfmOptions
from polmvs.errors import OptionError
from polmvs.evaluation.comparison import evaluate_file
from polmvs.evaluation.tables import best_fit_lines, comparison_table, evaluation_text
from polmvs.io.clouds import read_cloud, write_mesh
from polmvs.io.ground_truth import open_ground_truth
from polmvs.pipeline import jobs as pipeline
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
    print(json.dumps(figures, indent=1) if args.json else evaluation_text(figures))
    return 0


def sfm(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs sfm``."""
    outcome = pipeline.find_poses(_job_from(args, terminal))
    results = outcome.results
    print(
        f"{outcome.workspace.sparse}: {_views(results)} have a pose, "
        f"{results['num_tracks']:,} sparse points"
    )
    return 0


def normals(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs normals``."""
    outcome = pipeline.solve_normals(_job_from(args, terminal, goes_on=True), (args.model,))
    results = outcome.results
    print(
        f"{outcome.workspace.normals(args.model)}: {results[f'num_normals_{args.model}']:,} of "
        f"{results['num_tracks']:,} sparse points have a normal, {results['num_seeds']:,} are seeds"
    )
    return 0


def densify(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs densify``."""
    outcome = pipeline.densify(_job_from(args, terminal, goes_on=True), (args.model,))
    return _report_cloud(outcome, args.model)


def export(args: argparse.Namespace, terminal: Terminal) -> int:
    """Run ``polmvs export``."""
    outcome = pipeline.export(_job_from(args, terminal, goes_on=True), args.model)
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
    args: argparse.Namespace, terminal: Terminal, *, goes_on: bool = False
) -> pipeline.Job:
    """The job; one that goes on takes the options of the run in OUT where none are given."""
    how = run_options(args)
    recorded = recorded_options(args.out) if how.resume or goes_on else None
    return _job(args, terminal, args.capture, options_from(args, recorded), how)


def _job(
    args: argparse.Namespace, terminal: Terminal, capture: Path, options: Options, how: RunOptions
) -> pipeline.Job:
    return pipeline.Job(
        capture=capture,
        out=args.out,
        options=options,
        how=how,
        monitor=terminal,
        command_line=args.command_line,
    )


def _report_cloud(outcome: pipeline.Outcome, model: AngleModel) -> int:
    results, workspace = outcome.results, outcome.workspace
    unit = "metres" if results.get("unit") == "m" else "the model's unit, not metric"
    print(
        f"{workspace.cloud(model)}: {results[f'num_points_{model}']:,} points from "
        f"{_views(results)}, and {results[f'num_surroundings_{model}']:,} of the surroundings; "
        f"in {unit}"
    )
    if workspace.mesh(model).is_file():
        print(f"{workspace.mesh(model)}: {results[f'num_triangles_{model}']:,} triangles")
    dense = results.get(f"dense_{model}")
    if dense is not None and Path(dense).is_dir():
        print(f"{dense}: COLMAP dense workspace")
    return _status(outcome)


def _report_comparison(outcome: pipeline.Outcome) -> int:
    metrics = json.loads(outcome.workspace.metrics.read_text(encoding="utf-8"))
    print("\n".join([comparison_table(metrics), *best_fit_lines(metrics)]))
    clouds = ", ".join(f"{model}.ply" for model in metrics["models"])
    print(
        f"{outcome.workspace.root}: {clouds}, metrics.json, summary.md; {_views(outcome.results)}"
    )
    return _status(outcome)


def _views(results: dict[str, Any]) -> str:
    num_views = results["num_views"]
    return f"{num_views} of {num_views + len(results['unregistered'])} views"


def _status(outcome: pipeline.Outcome) -> int:
    if outcome.empty is None:
        return 0
    print(f"polmvs: {outcome.empty}", file=sys.stderr)
    return EMPTY_STATUS
