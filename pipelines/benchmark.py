"""Print the seconds and memory of the stages of one or more runs, side by side.

    python pipelines/benchmark.py OUT [OUT ...]
    python pipelines/benchmark.py --capture CAPTURE OUT [flags of polmvs compare]
    OMP_NUM_THREADS=1 python pipelines/benchmark.py --estimators

With ``--capture`` that capture is run first, into the only OUT. ``--estimators`` times the normal
estimators beside a plain NumPy baseline.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.cli.call import Call
from polmvs.cli.commands import HOW, TO_CLOUD
from polmvs.cli.flags import Command
from polmvs.cli.running import run
from polmvs.cli.terminal import Terminal
from polmvs.config import AngleModel, EvaluationOptions, OptionGroup, RunOptions, option
from polmvs.errors import OptionError
from polmvs.evaluation.tables import format_table
from polmvs.normals.estimator import EstimatorTolerances, solve_normals
from polmvs.normals.single_view.plane import plane_normal
from polmvs.pipeline.jobs import Job, compare
from polmvs.pipeline.run_folder import RUN_FILE, RunFolder
from polmvs.pipeline.runner import load_record, timing_table
from polmvs.polarization.angle_models import phase_from_normal, rows_from_phase

Array = NDArray[np.float64]

NUM_PIXELS = 250_000
NUM_TRACKS, NUM_VIEWS = 10_000, 10
PHASE_SIGMA = 0.02  # rad
REPEATS = 7


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    runs: tuple[Path, ...] = option((), "folders of finished runs", positional=True, metavar="OUT")
    capture: Path | None = option(None, "compare the models on this capture first, into OUT")
    estimators: bool = option(False, "time the normal estimators")

    def check(self) -> None:
        """There is something to do."""
        if not self.runs and not self.estimators:
            raise OptionError("give the folder of a run, or --estimators.")
        if self.capture is not None and len(self.runs) != 1:
            raise OptionError("--capture goes with one OUT.")


def _benchmark(call: Call, terminal: Terminal) -> int:
    given = call.get(Arguments)
    if given.estimators:
        print(estimator_table())
    if given.capture is not None:
        job = Job(
            capture=given.capture,
            out=given.runs[0],
            options=call.options(),
            run_options=call.get(RunOptions),
            monitor=terminal,
            command_line=call.command_line,
        )
        compare(job)
    records = {str(out): load_record(RunFolder(_folder(out))) for out in given.runs}
    if records:
        print(timing_table(records))
    return 0


COMMAND = Command(
    help_text="seconds and memory of the stages of one or more runs, side by side",
    run=_benchmark,
    groups=(Arguments, *TO_CLOUD, EvaluationOptions, *HOW),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    return run((COMMAND,), "benchmark.py", argv)


def _folder(path: Path) -> Path:
    """The folder of a run, which may be named by its ``run.json``."""
    return path.parent if path.name == RUN_FILE else path


def estimator_table() -> str:
    """Time everything; a table."""
    rng = np.random.default_rng(0)
    rows = [*_planes(rng), *_tracks(rng)]
    table = [[name, f"{1e3 * seconds:.1f}"] for name, seconds in rows]
    return format_table(["median of 7 runs", "ms"], table)


def _planes(rng: np.random.Generator) -> list[tuple[str, float]]:
    """One plane normal from many pixels of one view."""
    offsets = rng.uniform(-0.6, 0.6, size=(NUM_PIXELS, 2))
    rays = np.column_stack([offsets, np.ones(NUM_PIXELS)])
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    normal = np.array([0.3, -0.5, -0.8]) / np.linalg.norm([0.3, -0.5, -0.8])
    phase = phase_from_normal(AngleModel.PPA, np.broadcast_to(normal, rays.shape), rays)
    phase = phase + rng.normal(scale=PHASE_SIGMA, size=NUM_PIXELS)
    axial = np.array([np.cos(2 * phase), np.sin(2 * phase)], np.float32)
    columns = np.ascontiguousarray(rays.T, np.float32)
    sigma = np.full(NUM_PIXELS, PHASE_SIGMA, np.float32)

    def estimate(robust: bool) -> Callable[[], object]:
        return lambda: plane_normal(AngleModel.PPA, axial, columns, sigma, robust=robust)

    def baseline() -> Array:
        matrix = rows_from_phase(AngleModel.PPA, phase, rays)
        return np.asarray(np.linalg.eigh(matrix.T @ matrix)[1][:, 0])

    what = f"one plane, {NUM_PIXELS:,} pixels: "
    return [
        (what + "algebraic", _median_seconds(estimate(False))),
        (what + "weighted, robust", _median_seconds(estimate(True))),
        (what + "plain NumPy, algebraic", _median_seconds(baseline)),
    ]


def _tracks(rng: np.random.Generator) -> list[tuple[str, float]]:
    """Many normals from a few rows each."""
    shape = (3, NUM_VIEWS, NUM_TRACKS)
    normals = rng.normal(size=(3, 1, NUM_TRACKS))
    normals /= np.linalg.norm(normals, axis=0)
    rays = rng.normal(size=shape)
    rays /= np.linalg.norm(rays, axis=0)
    rays *= -np.sign((rays * normals).sum(axis=0))
    rows = np.cross(rays, np.broadcast_to(normals, shape), axis=0)
    rows /= np.linalg.norm(rows, axis=0)
    turn = rng.normal(scale=PHASE_SIGMA, size=shape[1:])
    rows = np.cos(turn) * rows + np.sin(turn) * np.cross(rays, rows, axis=0)
    rows, rays = rows.astype(np.float32), rays.astype(np.float32)
    sigma = np.full(shape[1:], PHASE_SIGMA, np.float32)

    def estimate(robust: bool) -> Callable[[], object]:
        return lambda: solve_normals(rows, rays, sigma, robust=robust)

    def baseline() -> Array:
        """The weighted rounds with one LAPACK call for each matrix."""
        weights = np.ones(shape[1:])
        vectors = np.zeros((NUM_TRACKS, 3))
        for _ in range(EstimatorTolerances().num_rounds + 1):
            matrices = np.einsum("ikn,jkn,kn->nij", rows, rows, weights)
            vectors = np.linalg.eigh(matrices)[1][:, :, 0]
            residual = np.einsum("ikn,ni->kn", rows, vectors)
            weights = 1 / (1 + (residual / (3 * PHASE_SIGMA)) ** 2)
        return np.asarray(vectors)

    what = f"{NUM_TRACKS:,} tracks of {NUM_VIEWS} views: "
    return [
        (what + "algebraic", _median_seconds(estimate(False))),
        (what + "weighted, robust", _median_seconds(estimate(True))),
        (what + "plain NumPy, robust rounds", _median_seconds(baseline)),
    ]


def _median_seconds(work: Callable[[], object]) -> float:
    work()
    seconds = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        work()
        seconds.append(time.perf_counter() - start)
    return float(np.median(seconds))


if __name__ == "__main__":
    raise SystemExit(main())
