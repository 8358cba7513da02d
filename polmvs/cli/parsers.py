"""The command line's parser: every command with its flags."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import polmvs
from polmvs.cli import commands
from polmvs.cli.flags import GROUPS, Parser, add_flags, add_run_flags
from polmvs.cli.terminal import Terminal
from polmvs.config import AngleModel
from polmvs.experiments.command import add_parser as add_experiment
from polmvs.normals.single_view import command as plane_command
from polmvs.pipeline import jobs as pipeline

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
    _add_export(subparsers)
    _add_mesh(subparsers)
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
        type=AngleModel,
        choices=list(AngleModel),
        default=AngleModel.PPA,
        help="relation of measured angle and normal (default: %(default)s)",
    )


def _add_demo(subparsers: Any) -> None:
    parser = _add(
        subparsers,
        "demo",
        "compare OPA and PPA on the bundled capture of a glossy board",
        commands.demo,
    )
    parser.add_argument(
        "out",
        type=Path,
        metavar="OUT",
        nargs="?",
        default=commands.DEMO_OUT,
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
            commands.reconstruct,
            groups,
        )
    )


def _add_compare(subparsers: Any) -> None:
    parser = _add_job(
        subparsers,
        "compare",
        "dense clouds of several models on the same poses, seeds and region, and figures that "
        "tell them apart",
        commands.compare,
        [name for name in GROUPS if name != "export"],
    )
    parser.add_argument(
        "--models",
        type=_models,
        default=pipeline.COMPARED,
        metavar="MODEL,...",
        help=f"what to compare, of {', '.join(AngleModel)} "
        f"(default: {','.join(pipeline.COMPARED)})",
    )


def _models(text: str) -> tuple[AngleModel, ...]:
    return tuple(dict.fromkeys(AngleModel(name.strip()) for name in text.split(",")))


def _add_evaluate(subparsers: Any) -> None:
    parser = _add(subparsers, "evaluate", "measure a cloud against ground truth", commands.evaluate)
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
    _add_job(
        subparsers,
        "sfm",
        "the first stages alone: images and poses",
        commands.sfm,
        ["capture", "sfm", "reference"],
    )


def _add_normals(subparsers: Any) -> None:
    groups = ["capture", "sfm", "reference", "region", "normals"]
    parser = _add_job(
        subparsers, "normals", "normals of the sparse points, after 'sfm'", commands.normals, groups
    )
    _add_model(parser)


def _add_densify(subparsers: Any) -> None:
    groups = [name for name in GROUPS if name not in ("evaluation", "export")]
    parser = _add_job(
        subparsers, "densify", "the dense cloud, after 'normals'", commands.densify, groups
    )
    _add_model(parser)


def _add_export(subparsers: Any) -> None:
    groups = [name for name in GROUPS if name != "evaluation"]
    text = "mesh and COLMAP dense workspace, after 'densify'"
    _add_model(_add_job(subparsers, "export", text, commands.export, groups))


def _add_mesh(subparsers: Any) -> None:
    parser = _add(subparsers, "mesh", "Poisson mesh of a cloud with normals", commands.mesh)
    parser.add_argument("cloud", type=Path, metavar="CLOUD.ply", help="points with normals")
    parser.add_argument("mesh", type=Path, metavar="MESH.ply", help="file of the mesh")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing MESH.ply")


def _add_plane(subparsers: Any) -> None:
    plane_command.add_parser(subparsers).set_defaults(
        run=lambda args, terminal: plane_command.run(args)
    )
