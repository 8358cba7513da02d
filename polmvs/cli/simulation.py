"""``polmvs simulate`` and ``polmvs plan``: rendered captures of a mesh, and plans from them."""

from __future__ import annotations

import shlex
from typing import Any

from polmvs.cli.call import Call
from polmvs.cli.commands import PlanArguments, SimulateArguments
from polmvs.cli.terminal import Terminal
from polmvs.config import groups_of
from polmvs.simulation.capture import simulate_capture
from polmvs.simulation.options import PlanOptions, Simulation, SimulationRun
from polmvs.simulation.planning import PLOT_FILE, TABLE_FILE, make_plan


def simulate(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs simulate``."""
    arguments = call.get(SimulateArguments)
    options = _simulation(call)
    known = options.path.cameras is None
    num_views = (
        options.for_preview().path.views if options.rendering.preview else options.path.views
    )
    with terminal.stage("simulate", num_views if known else None) as on_progress:
        made = simulate_capture(
            arguments.mesh,
            arguments.out,
            options,
            call.get(SimulationRun),
            on_progress=on_progress,
        )
    camera, config = made.folder / "camera.txt", made.folder / "capture.toml"
    words = ["polmvs", "reconstruct", made.folder, "RUN", "--camera", camera, "--config", config]
    terminal.show([*made.lines, f"next: {shlex.join(map(str, words))}"], made)
    return 0


def plan(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs plan``."""
    arguments, options = call.get(PlanArguments), call.get(PlanOptions)
    num = len(options.lights) * len(options.view_counts)
    with terminal.stage("trials", num) as on_progress:
        made = make_plan(
            arguments.mesh, arguments.out, _simulation(call), options, on_progress=on_progress
        )
    text = f"{made.table()}\n{made.recommendation}\n{made.folder}: {TABLE_FILE}, {PLOT_FILE}"
    terminal.show(text, made)
    return 0


def _simulation(call: Call) -> Simulation:
    """All options of what is rendered."""
    groups: dict[str, Any] = {name: call.get(c) for name, c in groups_of(Simulation).items()}
    return Simulation(**groups)
