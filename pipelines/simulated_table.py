"""Tell where reconstruction works and where it fails: each material under each light.

    python pipelines/simulated_table.py WORK [--only render] [--workers 2] [--shapes ...]

Renders a capture of each, then finds the poses of each by SfM, reconstructs it under PPA and
measures it against the truth. ``WORK/ROW/capture`` is the capture of a row and stays;
``WORK/ROW/trial.json`` is what was measured; ``WORK/table.md`` has the rows that are finished,
failures with their reason. What is finished is not done again, unless ``--again`` asks for other
measurements of it.
"""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, option
from polmvs.errors import PolmvsError
from polmvs.io.images import write_bytes
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import from_json, parse_json, write_json
from polmvs.parallel import Workers
from polmvs.simulation.capture import simulate_capture
from polmvs.simulation.options import (
    LightingOptions,
    LightName,
    MaterialName,
    ObjectOptions,
    PathOptions,
    RenderingOptions,
    SensorOptions,
    Simulation,
    SimulationRun,
)
from polmvs.simulation.trial import CAPTURE, RUN, TrialResult, measure, options_of, trial_table

LIGHTS = tuple(light for light in LightName if light is not LightName.FILE)
TRIAL, TABLE = "trial.json", "table.md"


class Step(StrEnum):
    """What is done of a row."""

    RENDER = "render"
    MEASURE = "measure"


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    work: Path = option(MISSING, "folder of the captures and runs", positional=True)
    only: Step | None = option(None, "render all captures, or measure those that are rendered")
    workers: int = option(1, "rows that are measured at a time, each by a process", least=1)
    shapes: tuple[str, ...] = option(("dome", "mug"), "files or built-in shapes")
    materials: tuple[MaterialName, ...] = option(tuple(MaterialName), "presets")
    lights: tuple[LightName, ...] = option(LIGHTS, "presets")
    views: int = option(12, "of each capture", least=3)
    image_size: tuple[int, int] = option((612, 512), "of the mosaics, px", metavar="WIDTH,HEIGHT")
    marks: int = option(9, "printed marks on the object", least=0)
    seed: int = option(0, "of all that is random", least=0)
    again: bool = option(False, "measure finished rows again")
    keep: bool = option(False, "keep the runs of finished rows")


@dataclass(frozen=True, kw_only=True)
class Row:
    """A capture of the table.

    Attributes
    ----------
    shape : of its object.
    simulation : all else about it.
    """

    shape: str
    simulation: Simulation

    @property
    def name(self) -> str:
        """For people."""
        simulation = self.simulation
        return ", ".join(
            (Path(self.shape).stem, simulation.lighting.light, simulation.object.material)
        )

    def folder(self, work: Path) -> Path:
        """Where its capture and its trial lie."""
        return work / self.name.replace(", ", "_")


def _run(call: Call, terminal: Terminal) -> int:
    arguments = call.get(Arguments)
    arguments.work.mkdir(parents=True, exist_ok=True)
    rows = _rows(arguments)
    if arguments.only is not Step.MEASURE:
        failed = _render(arguments, rows, terminal)
        if arguments.only is Step.RENDER:
            terminal.show(f"{len(rows) - failed} of {len(rows)} captures in {arguments.work}", None)
            return 1 if failed else 0
    trials = _measure(arguments, rows, terminal)
    terminal.show(trial_table(trials), trials)
    return 0


def _rows(arguments: Arguments) -> list[Row]:
    return [
        Row(
            shape=shape,
            simulation=Simulation(
                object=ObjectOptions(material=material, marks=arguments.marks),
                lighting=LightingOptions(light=light),
                path=PathOptions(views=arguments.views),
                sensor=SensorOptions(image_size=arguments.image_size),
                rendering=RenderingOptions(seed=arguments.seed, masks=True),
            ),
        )
        for shape in arguments.shapes
        for light in arguments.lights
        for material in arguments.materials
    ]


def _render(arguments: Arguments, rows: Sequence[Row], terminal: Terminal) -> int:
    """Render what is not there; the number of captures that failed."""
    failed = 0
    with terminal.stage("render", len(rows)) as on_progress:
        for row in rows:
            folder = row.folder(arguments.work) / CAPTURE
            try:
                made = simulate_capture(
                    row.shape, folder, row.simulation, SimulationRun(resume=True)
                )
                for line in made.lines if made.views else ():
                    terminal.say(line)
            except PolmvsError as error:
                failed += 1
                terminal.say(f"{row.name}: {error}")
            on_progress(1)
    return failed


def _measure(arguments: Arguments, rows: Sequence[Row], terminal: Terminal) -> list[TrialResult]:
    """Trials of the captures that are there, in order."""
    there = [row for row in rows if row.folder(arguments.work).is_dir()]
    for row in rows:
        if row not in there:
            terminal.say(f"{row.name}: no capture, left out")
    trials = []
    trial_of = partial(_trial, arguments)
    with Workers(arguments.workers) as workers, terminal.stage("measure", len(there)) as advance:
        for trial in workers.map(trial_of, there):
            trials.append(trial)
            write_bytes(arguments.work / TABLE, (trial_table(trials) + "\n").encode())
            terminal.say(" | ".join(trial.cells))
            advance(1)
    return trials


def _trial(arguments: Arguments, row: Row) -> TrialResult:
    """One row, from its file where it is finished."""
    folder = row.folder(arguments.work)
    stored = folder / TRIAL
    if stored.is_file() and not arguments.again:
        return from_json(TrialResult, parse_json(read_text(stored)))
    try:
        options = options_of(folder / CAPTURE, row.simulation.sensor)
        (trial,) = measure(
            row.name, folder / CAPTURE, folder / RUN, options, views=row.simulation.path.views
        )
    except PolmvsError as error:
        trial = TrialResult(name=row.name, views=arguments.views, message=str(error)[:160])
    write_json(stored, trial)
    if not arguments.keep:
        shutil.rmtree(folder / RUN, ignore_errors=True)
    return trial


main = script(__file__, __doc__, _run, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
