"""Tell where reconstruction works and where it fails: each material under each light.

    python pipelines/simulated_table.py WORK [--shapes dome,mug] [--materials ...] [--lights ...]

Renders a capture of each, finds its poses by SfM, reconstructs it under PPA and measures it against
the truth. Rows are written to ``WORK/table.md`` as they come, failures with their reason; what is
finished is not done again.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.flags import Command
from polmvs.cli.running import run
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, option
from polmvs.errors import PolmvsError
from polmvs.io.images import write_bytes
from polmvs.io.typed_json import from_json, parse_json, write_json
from polmvs.simulation.options import (
    LightingOptions,
    LightName,
    MaterialName,
    ObjectOptions,
    PathOptions,
    RenderingOptions,
    SensorOptions,
    Simulation,
)
from polmvs.simulation.trial import Trial, run_trial, trial_table

LIGHTS = tuple(light for light in LightName if light is not LightName.FILE)


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    work: Path = option(MISSING, "folder of the captures and runs", positional=True)
    shapes: tuple[str, ...] = option(("dome", "mug"), "files or built-in shapes")
    materials: tuple[MaterialName, ...] = option(tuple(MaterialName), "presets")
    lights: tuple[LightName, ...] = option(LIGHTS, "presets")
    views: int = option(12, "of each capture", least=3)
    image_size: tuple[int, int] = option((612, 512), "of the mosaics, px", metavar="WIDTH,HEIGHT")
    marks: int = option(9, "printed marks on the object", least=0)
    seed: int = option(0, "of all that is random", least=0)
    keep: bool = option(False, "keep the captures and runs of finished rows")


def _measure(call: Call, terminal: Terminal) -> int:
    arguments = call.get(Arguments)
    arguments.work.mkdir(parents=True, exist_ok=True)
    trials: list[Trial] = []
    kinds = [
        (shape, light, material)
        for shape in arguments.shapes
        for light in arguments.lights
        for material in arguments.materials
    ]
    with terminal.stage("trials", len(kinds)) as on_progress:
        for shape, light, material in kinds:
            name = f"{Path(shape).stem}, {light}, {material}"
            trials.append(_trial(arguments, name, shape, light, material))
            write_bytes(arguments.work / "table.md", (trial_table(trials) + "\n").encode())
            terminal.say(" | ".join(trials[-1].cells))
            on_progress(1)
    terminal.show(trial_table(trials), trials)
    return 0


def _trial(
    arguments: Arguments, name: str, shape: str, light: LightName, material: MaterialName
) -> Trial:
    """One row, from its file where it is finished."""
    folder = arguments.work / name.replace(", ", "_")
    stored = folder / "trial.json"
    if stored.is_file():
        return from_json(Trial, parse_json(stored.read_text(encoding="utf-8")))
    simulation = Simulation(
        object=ObjectOptions(material=material, marks=arguments.marks),
        lighting=LightingOptions(light=light),
        path=PathOptions(views=arguments.views),
        sensor=SensorOptions(image_size=arguments.image_size),
        rendering=RenderingOptions(seed=arguments.seed),
    )
    try:
        trial = run_trial(name, shape, folder, simulation)
    except PolmvsError as error:
        trial = Trial(name=name, views=arguments.views, message=str(error)[:160])
    folder.mkdir(parents=True, exist_ok=True)
    write_json(stored, trial)
    if not arguments.keep:
        shutil.rmtree(folder / "run", ignore_errors=True)
        shutil.rmtree(folder / "capture", ignore_errors=True)
    return trial


COMMAND = Command(
    help_text="reconstruct rendered captures of each material under each light",
    run=_measure,
    groups=(Arguments, TerminalOptions),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, and print the table."""
    return run((COMMAND,), "simulated_table.py", argv)


if __name__ == "__main__":
    raise SystemExit(main())
