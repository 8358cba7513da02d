"""The commands: each parses, calls one library function and prints what came of it."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import polmvs
from polmvs import pipeline, plane_command
from polmvs.camera import PinholeCamera
from polmvs.cli.flags import (
    GROUPS,
    Parser,
    add_flags,
    add_run_flags,
    options_from,
    recorded_options,
    run_options,
)
from polmvs.cli.terminal import Terminal
from polmvs.comparison import evaluate_file
from polmvs.config import EvaluationOptions, Model, Options, RunOptions, SfmOptions
from polmvs.experiments.command import add_parser as add_experiment
from polmvs.groundtruth import open_ground_truth
from polmvs.summary import best_fit_lines, comparison_table, evaluation_text

EMPTY_STATUS = 3
DEMO_CAPTURE = Path(polmvs.__file__).parent / "demo_capture"
DEMO_OUT = Path("polmvs-demo")

Command = Callable[[argparse.Namespace, Terminal], int]


def build_parser() -> Parser:
    """The parser of the whole command line."""
    parser = Parser(
        prog="polmvs",
        description="Dense clouds of glossy, textureless surfaces from polarization cameras.",
    )
    parser.add_argument("--version", action="version", version=f"polmvs {polmvs.__version__}")
    subparsers = parser.add_subparsers(dest="command", required=True, metavar="COMMAND")
    _add_demo(subparsers)
    _add_reconstruct(subparsers)
    _add_compare(subparsers)
    _add_evaluate(subparsers)
    _add_sfm(subparsers)
    _add_normals(subparsers)
    _add_densify(subparsers)
    _add_plane(subparsers)
    add_experiment(subparsers)
    return parser


def _add(subparsers: Any, name: str, help_text: str, run: Command) -> argparse.ArgumentParser:
    parser: argparse.ArgumentParser = subparsers.add_parser(
        name, help=help_text, description=help_text[0].upper() + help_text[1:] + "."
    )
    parser.add_argument("-v", "--verbose", action="store_true", help="show every step")
    parser.set_defaults(run=run)
    return parser


def _add_job(
    subparsers: Any, name: str, help_text: str, run: Command, groups: Sequence[str]
) -> argparse.ArgumentParser:
    """A command on a capture."""
    parser = _add(subparsers, name, help_text, run)
    parser.add_argument(
        "capture",
        type=Path,
        metavar="CAPTURE",
        help="folder of raw polarizer mosaics, in it or in its raw/",
    )
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the results")
    add_run_flags(parser)
    add_flags(parser, groups)
    return parser


def _add_model(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--model",
        type=Model,
        choices=list(Model),
        default=Model.PPA,
        help="relation of measured angle and normal (default: %(default)s)",
    )


def _add_demo(subparsers: Any) -> None:
    parser = _add(
        subparsers, "demo", "compare OPA and PPA on the bundled capture of a glossy board", demo
    )
    parser.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        nargs="?",
        default=DEMO_OUT,
        help="folder of the results (default: %(default)s)",
    )
    add_run_flags(parser)


def _add_reconstruct(subparsers: Any) -> None:
    groups = [name for name in GROUPS if name != "evaluation"]
    _add_model(
        _add_job(
            subparsers,
            "reconstruct",
            "capture in, dense cloud of one model out",
            reconstruct,
            groups,
        )
    )


def _add_compare(subparsers: Any) -> None:
    parser = _add_job(
        subparsers,
        "compare",
        "dense clouds of several models on the same poses, seeds and region, and figures that "
        "tell them apart",
        compare,
        list(GROUPS),
    )
    parser.add_argument(
        "--models",
        type=_models,
        default=pipeline.COMPARED,
        metavar="MODEL,...",
        help=f"what to compare, of {', '.join(Model)} (default: {','.join(pipeline.COMPARED)})",
    )


def _models(text: str) -> tuple[Model, ...]:
    return tuple(dict.fromkeys(Model(name.strip()) for name in text.split(",")))


def _add_evaluate(subparsers: Any) -> None:
    parser = _add(subparsers, "evaluate", "measure a cloud against ground truth", evaluate)
    parser.add_argument("cloud", type=Path, metavar="CLOUD.ply", help="points, if possible normals")
    parser.add_argument("--gt", type=Path, required=True, metavar="DIR", help="ground truth")
    parser.add_argument(
        "--sparse",
        type=Path,
        required=True,
        metavar="DIR",
        help="COLMAP model in whose frame the cloud is; its cameras align it with the truth",
    )
    parser.add_argument("--json", action="store_true", help="print JSON")


def _add_sfm(subparsers: Any) -> None:
    _add_job(subparsers, "sfm", "the first stages alone: images and poses", sfm, ["capture", "sfm"])


def _add_normals(subparsers: Any) -> None:
    groups = ["capture", "sfm", "region", "normals"]
    parser = _add_job(
        subparsers, "normals", "normals of the sparse points, after 'sfm'", normals, groups
    )
    _add_model(parser)


def _add_densify(subparsers: Any) -> None:
    groups = ["capture", "sfm", "region", "normals", "propagation", "fusion"]
    parser = _add_job(subparsers, "densify", "the dense cloud, after 'normals'", densify, groups)
    _add_model(parser)


def _add_plane(subparsers: Any) -> None:
    plane_command.add_parser(subparsers).set_defaults(
        run=lambda args, terminal: plane_command.run(args)
    )


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


def _report_cloud(outcome: pipeline.Outcome, model: Model) -> int:
    results = outcome.results
    print(
        f"{outcome.workspace.cloud(model)}: {results[f'num_points_{model}']:,} points from "
        f"{_views(results)}"
    )
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
