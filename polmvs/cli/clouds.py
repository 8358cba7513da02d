"""The commands on a cloud: evaluate it, and make a mesh of it."""

from __future__ import annotations

from polmvs.cli.call import Call, require_new
from polmvs.cli.commands import EvaluateArguments, MeshArguments
from polmvs.cli.terminal import Terminal
from polmvs.evaluation.comparison import evaluate_file, evaluation_text
from polmvs.io.clouds import read_cloud
from polmvs.io.mesh_files import mesh_format_of, write_mesh_file
from polmvs.surface.poisson import poisson_mesh


def evaluate(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs evaluate``."""
    arguments = call.get(EvaluateArguments)
    figures = evaluate_file(arguments.cloud, arguments.gt, arguments.sparse)
    terminal.show(evaluation_text(figures), figures)
    return 0


def mesh(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs mesh``."""
    arguments = call.get(MeshArguments)
    mesh_format_of(arguments.mesh)  # before the work
    require_new(arguments.mesh, overwrite=arguments.overwrite)
    made = poisson_mesh(read_cloud(arguments.cloud), source=arguments.cloud)
    write_mesh_file(arguments.mesh, made)
    num_triangles = len(made.triangles)
    terminal.show(
        [f"{arguments.mesh}: {num_triangles:,} triangles"],
        {"mesh": arguments.mesh, "num_triangles": num_triangles},
    )
    return 0
