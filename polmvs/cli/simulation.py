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
    with terminal.stage("simulate", simulation.path.views) as on_progress:
        num = simulate_capture(arguments.mesh, arguments.out, simulation, on_progress=on_progress)
    terminal.show(f"{arguments.out}: {num} views", {"out": arguments.out, "views": num})
    return 0
