"""``polmvs simulate``: a rendered capture of a mesh."""

from __future__ import annotations

from polmvs.cli.call import Call
from polmvs.cli.commands import SimulateArguments
from polmvs.cli.terminal import Terminal
from polmvs.simulation.capture import Simulation, simulate_capture
from polmvs.simulation.options import (
    LightingOptions,
    ObjectOptions,
    PathOptions,
    RenderingOptions,
    SceneryOptions,
    SensorOptions,
    SimulationRun,
)


def simulate(call: Call, terminal: Terminal) -> int:
    """Run ``polmvs simulate``."""
    arguments = call.get(SimulateArguments)
    simulation = Simulation(
        object=call.get(ObjectOptions),
        lighting=call.get(LightingOptions),
        scenery=call.get(SceneryOptions),
        path=call.get(PathOptions),
        sensor=call.get(SensorOptions),
        rendering=call.get(RenderingOptions),
    )
    with terminal.stage("simulate", None) as on_progress:
        made = simulate_capture(
            arguments.mesh,
            arguments.out,
            simulation,
            call.get(SimulationRun),
            on_progress=on_progress,
        )
    terminal.show("\n".join(made.lines), made)
    return 0
