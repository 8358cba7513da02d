"""A folder of captures on a Dask cluster: efficiency, a lost worker, and equal results.

    python pipelines/machine_room.py WORK [--captures 20] [--views 12] [--width 306]

Renders captures of several shapes, materials and lights, and reconstructs all of them with
``polmvs batch``: by one process, by two workers of a Dask cluster, and by four, of which one is
killed when a quarter of the captures is done. The cluster is a plain ``dask scheduler`` with ``dask
worker`` processes on this machine. The table has the time, the CPU time of all processes with its
ratio to that of one process, and how many captures have the results of one process bit by bit.
Captures and runs stay in WORK; what is rendered is not rendered again.
"""

from __future__ import annotations

import json
import os
import resource
import socket
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, dataclass
from itertools import cycle, islice
from pathlib import Path

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, option
from polmvs.errors import PolmvsError
from polmvs.evaluation.tables import format_table, number
from polmvs.io.images import write_bytes
from polmvs.pipeline.batch import JSON_FILE
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
from polmvs.simulation.trial import options_of

SHAPES = ("ellipsoid", "box", "dome", "vase", "knot")
MATERIALS = (MaterialName.BLACK_PLASTIC, MaterialName.CAR_PAINT, MaterialName.GLAZED_CERAMIC)
LIGHTS = (LightName.OVERCAST, LightName.EVEN)
RESULTS = ("ppa.ply", "ppa_mesh.ply", "normals.ply")  # files of a capture that are compared


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    work: Path = option(MISSING, "folder of the captures and runs", positional=True)
    captures: int = option(20, "number of captures", least=4)
    views: int = option(12, "of each capture", least=3)
    width: int = option(306, "of the mosaics, px", least=64)


@dataclass(frozen=True, kw_only=True)
class WayResult:
    """One way to reconstruct all captures.

    Attributes
    ----------
    name : of the way.
    seconds, cpu_s : of all its processes, with the start of the cluster.
    states : number of captures by their state.
    num_equal : captures with the same results as by one process.
    """

    name: str
    seconds: float
    cpu_s: float
    states: dict[str, int]
    num_equal: int


def _run(call: Call, terminal: Terminal) -> int:
    arguments = call.get(Arguments)
    captures = _render(arguments, terminal)
    outs = [arguments.work / name for name in ("one", "two", "four")]
    ways = [("one process", 0, False), ("2 workers", 2, False), ("4 workers, 1 killed", 4, True)]
    results: list[WayResult] = []
    with terminal.stage("ways", len(ways)) as on_progress:
        for (name, num, kills), out in zip(ways, outs, strict=True):
            start, cpu = time.monotonic(), _cpu_s()
            _reconstruct(captures, out, num, kills)
            rows = _rows(out)
            if len(rows) != arguments.captures:
                raise PolmvsError(f"{out}: {len(rows)} captures are done; see {out}/batch.md.")
            states = [row["state"] for row in rows]
            results.append(
                WayResult(
                    name=name,
                    seconds=time.monotonic() - start,
                    cpu_s=_cpu_s() - cpu,
                    states={state: states.count(state) for state in dict.fromkeys(states)},
                    num_equal=sum(_same(outs[0] / row["name"], out / row["name"]) for row in rows),
                )
            )
            on_progress(1)
    text = table(results)
    write_bytes(arguments.work / "table.md", (text + "\n").encode())
    terminal.show(text, results)
    return 0


def _render(arguments: Arguments, terminal: Terminal) -> Path:
    """Render the captures; the list of all of them."""
    kinds = zip(cycle(SHAPES), cycle(MATERIALS), cycle(LIGHTS), strict=False)
    lines = []
    with terminal.stage("captures", arguments.captures) as on_progress:
        for index, (shape, material, light) in enumerate(islice(kinds, arguments.captures)):
            capture = arguments.work / f"capture_{index:02d}"
            simulation = Simulation(
                object=ObjectOptions(material=material, marks=24),
                lighting=LightingOptions(light=light),
                path=PathOptions(views=arguments.views),
                rendering=RenderingOptions(seed=index),
                sensor=SensorOptions(
                    image_size=(arguments.width, arguments.width * 2048 // 2448 // 2 * 2)
                ),
            )
            simulate_capture(shape, capture, simulation, SimulationRun(resume=True))
            sfm = options_of(capture, simulation.sensor).sfm
            lines += ["[[captures]]", f"folder = {json.dumps(capture.name)}", "[captures.sfm]"]
            lines += [f"camera = {json.dumps(str(sfm.camera))}"]
            on_progress(1)
    path = arguments.work / "captures.toml"
    write_bytes(path, ("\n".join(lines) + "\n").encode())
    return path


def _reconstruct(captures: Path, out: Path, num_workers: int, kills: bool) -> None:
    command = [sys.executable, "-m", "polmvs", "batch", str(captures), str(out)]
    command += ["--overwrite", "--quiet", "--workers", "1"]
    if not num_workers:
        subprocess.run(command, check=False)
        return
    with _cluster(num_workers, out.parent) as (address, workers):
        batch = subprocess.Popen([*command, "--scheduler", address])
        while kills and batch.poll() is None:
            if 4 * len(_rows(out)) >= len(_rows(out.parent / "one")):
                workers[0].kill()
                break
            time.sleep(0.2)
        batch.wait()


@contextmanager
def _cluster(num_workers: int, folder: Path) -> Iterator[tuple[str, list[subprocess.Popen[bytes]]]]:
    """A scheduler and its workers; their address, and the workers' processes."""
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    address = f"tcp://127.0.0.1:{port}"
    dask = str(Path(sys.executable).with_name("dask"))
    scheduler = ["scheduler", "--host", "127.0.0.1", "--port", str(port), "--no-dashboard"]
    # Without a nanny, a killed worker does not come back.
    worker = ["worker", address, "--nthreads", "1", "--no-nanny", "--no-dashboard"]
    processes = []
    with (folder / "dask.log").open("wb") as log:
        try:
            for arguments in (scheduler, *[worker] * num_workers):
                process = subprocess.Popen(
                    [dask, *arguments],
                    stdout=log,
                    stderr=log,
                    cwd=folder,
                    env={**os.environ, "PYTHONSAFEPATH": "1"},
                )
                processes.append(process)
            yield address, processes[1:]
        finally:
            for process in processes:
                process.terminate()
            for process in processes:
                process.wait()


def _rows(out: Path) -> list[dict[str, str]]:
    """Rows of the captures that are done."""
    try:
        rows = json.loads((out / JSON_FILE).read_text())
    except FileNotFoundError:
        return []
    return list(rows)


def _same(one: Path, other: Path) -> bool:
    """Whether two runs have the same results."""
    found = [[_bytes(folder / name) for name in RESULTS] for folder in (one, other)]
    return found[0] == found[1]


def _bytes(path: Path) -> bytes | None:
    return path.read_bytes() if path.is_file() else None


def _cpu_s() -> float:
    """CPU time of the ended child processes and theirs."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def table(results: Sequence[WayResult]) -> str:
    """One row for each way."""
    header = ["way", "s", "CPU s", "CPU, ratio to one", "captures per minute", "states", "equal"]
    rows = [
        [
            result.name,
            number(result.seconds, 1, 0),
            number(result.cpu_s, 1, 0),
            number(result.cpu_s / results[0].cpu_s),
            number(60 * sum(result.states.values()) / result.seconds),
            ", ".join(f"{count} {state}" for state, count in result.states.items()),
            f"{result.num_equal} of {sum(result.states.values())}",
        ]
        for result in results
    ]
    return format_table(header, rows)


main = script(__file__, __doc__, _run, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
