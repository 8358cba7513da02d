"""Print the seconds and memory of the stages of one or more runs, side by side.

    python pipelines/benchmark.py OUT [OUT ...]
    python pipelines/benchmark.py --capture CAPTURE OUT [flags of polmvs compare]
    OMP_NUM_THREADS=1 python pipelines/benchmark.py --estimators

With ``--capture`` that capture is run first, into the only OUT. ``--estimators`` times the normal
estimators beside a plain NumPy baseline.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.cli import main as run_polmvs
from polmvs.config import AngleModel
from polmvs.errors import PolmvsError
from polmvs.evaluation.tables import format_table
from polmvs.normals.estimator import NUM_ROUNDS, solve_normals
from polmvs.normals.single_view.plane import plane_normal
from polmvs.pipeline.run_folder import RUN_FILE, RunFolder
from polmvs.pipeline.runner import load_record, timing_table
from polmvs.polarization.angle_models import phase_from_normal, rows_from_phase

Array = NDArray[np.float64]

NUM_PIXELS = 250_000
NUM_TRACKS, NUM_VIEWS = 10_000, 10
PHASE_SIGMA = 0.02  # rad
REPEATS = 7


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument(
        "runs", type=Path, nargs="*", metavar="OUT", help="folders of finished runs"
    )
    parser.add_argument("--capture", type=Path, help="compare the models on this capture first")
    parser.add_argument("--estimators", action="store_true", help="time the normal estimators")
    args, flags = parser.parse_known_args(argv)
    if args.estimators:
        print(estimator_table())
    if not args.runs:
        return 0 if args.estimators else parser.error("give the folder of a run, or --estimators")
    if args.capture is not None:
        if len(args.runs) != 1:
            parser.error("--capture goes with one OUT")
        status = run_polmvs(["compare", str(args.capture), str(args.runs[0]), *flags])
        if status != 0:
            return status
    elif flags:
        parser.error(f"unknown arguments: {' '.join(flags)}")
    try:
        records = {str(out): load_record(RunFolder(_folder(out))) for out in args.runs}
    except PolmvsError as error:
        print(f"{parser.prog}: error: {error}", file=sys.stderr)
        return error.exit_status
    print(timing_table(records))
    return 0


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
        for _ in range(NUM_ROUNDS + 1):
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
