"""Print times and memory: of runs by stage, of single steps beside others' ways, and their growth.

    python pipelines/benchmark.py OUT [OUT ...]
    python pipelines/benchmark.py --capture CAPTURE OUT [flags of polmvs compare]
    OMP_NUM_THREADS=1 python pipelines/benchmark.py --estimators --ingest
    python pipelines/benchmark.py --growth WORK --views 25,50,100 --num-workers 1,2,4 --write DIR

With ``--capture`` that capture is run first, into the only OUT. ``--estimators`` times the normal
estimators beside a plain NumPy baseline, ``--ingest`` the way from a mosaic of 5 megapixels to
Stokes images with their noise beside OpenCV's and, where it is installed, polanalyser's.
``--growth`` makes captures of printed texture in WORK and measures all stages after SfM, on true
poses, with the number of views, each in a process of its own, and the per-view stages with that of
workers: threads, processes and Dask's. With ``--write DIR`` its table and plot become
``DIR/growth.md`` and ``DIR/images/growth.png``.
"""

from __future__ import annotations

import os
import platform
import shutil
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.cli.call import Call
from polmvs.cli.commands import EXECUTION, TO_CLOUD
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.colmap.models import write_model
from polmvs.config import (
    EvaluationOptions,
    ExportOptions,
    OptionGroup,
    Options,
    RegionOptions,
    RunOptions,
    default_num_workers,
    option,
)
from polmvs.errors import OptionError
from polmvs.evaluation.tables import format_table, number
from polmvs.io.images import write_bytes
from polmvs.normals.estimator import EstimatorTolerances, solve_normals
from polmvs.normals.single_view.plane import plane_normal
from polmvs.parallel import Workers
from polmvs.pipeline.jobs import compare, reconstruct
from polmvs.pipeline.record import POSE_STAGES, Record, versions
from polmvs.pipeline.run_folder import RUN_FILE, RunFolder
from polmvs.pipeline.runner import Job, load_record
from polmvs.pipeline.stages.images import write_images
from polmvs.pipeline.stages.maps import build_maps
from polmvs.polarization.angle_models import phase_from_normal, rows_from_phase
from polmvs.polarization.capture import Capture, open_capture
from polmvs.polarization.kinds import AngleModel
from polmvs.synthetic.printed import orbit_views
from polmvs.synthetic.printed_capture import (
    Part,
    camera_of,
    printed_model,
    scene_of,
    write_printed_capture,
)

NUM_PIXELS = 250_000
NUM_TRACKS, NUM_VIEWS = 10_000, 10
PHASE_SIGMA = 0.02  # rad
REPEATS = 7
TRIALS = 3
SHOWN_SHARE = 0.005  # of a run's time, from which on a stage is drawn


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    runs: tuple[Path, ...] = option((), "folders of finished runs", positional=True, metavar="OUT")
    capture: Path | None = option(None, "compare the models on this capture first, into OUT")
    estimators: bool = option(False, "time the normal estimators")
    ingest: bool = option(False, "time the way from a mosaic to Stokes images")
    growth: Path | None = option(None, "measure the growth, in this folder", metavar="WORK")
    views: tuple[int, ...] = option((25, 50, 100), "growth: numbers of views", least=4)
    width: int = option(612, "growth: of the half-size images, px", least=48)
    num_workers: tuple[int, ...] = option((1, 2, 4), "growth: numbers of workers", least=1)
    write: Path | None = option(None, "growth: folder of growth.md and images/", metavar="DIR")

    def check(self) -> None:
        """There is something to do."""
        if not (self.runs or self.estimators or self.ingest or self.growth):
            raise OptionError("give the folder of a run, --estimators, --ingest or --growth.")
        if self.capture is not None and len(self.runs) != 1:
            raise OptionError("--capture goes with one OUT.")


def _benchmark(call: Call, terminal: Terminal) -> int:
    given = call.get(Arguments)
    if given.estimators:
        print(estimator_table())
    if given.ingest:
        print(ingest_table())
    if given.growth is not None:
        run_options = call.get(RunOptions)
        text, runs, scalings = growth_page(given, call.options(), run_options, terminal)
        print(text)
        if given.write is not None:
            save_growth(given.write, text, runs, scalings)
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


def timing_table(records: Mapping[str, Record]) -> str:
    """Seconds, those of the processor, and memory of the stages of one or more runs."""
    names = dict.fromkeys(stage.name for record in records.values() for stage in record.stages)
    header = ["stage"]
    for name in records:
        header += [f"{name}, s", "CPU s", "peak MB"]
    rows = [[name, *_stage_cells(name, records)] for name in names]
    total, rest, wall = ["all stages"], ["all but poses"], ["wall clock"]
    for record in records.values():
        seconds = {stage.name: stage.seconds for stage in record.stages}
        peak = max((stage.peak_rss_mb for stage in record.stages), default=None)
        cpu = {stage.name: stage.cpu_s for stage in record.stages}
        total += [number(sum(seconds.values())), number(sum(cpu.values())), number(peak, 1, 0)]
        rest += [number(_without_poses(times)) for times in (seconds, cpu)] + [""]
        wall += [number(record.wall_s), "", ""]
    return format_table(header, [*rows, total, rest, wall])


def _without_poses(times: Mapping[str, float]) -> float:
    return sum(time for name, time in times.items() if name not in POSE_STAGES)


def _stage_cells(name: str, records: Mapping[str, Record]) -> list[str]:
    cells = []
    for record in records.values():
        stage = record.stage(name)
        if stage is None:
            cells += [number(None)] * 3
        else:
            cells += [number(stage.seconds), number(stage.cpu_s), number(stage.peak_rss_mb, 1, 0)]
    return cells


def _folder(path: Path) -> Path:
    """The folder of a run, which may be named by its ``run.json``."""
    return path.parent if path.name == RUN_FILE else path


def estimator_table() -> str:
    """Time everything; a table."""
    rng = np.random.default_rng(0)
    rows = [*_planes(rng), *_tracks(rng)]
    table = [[name, f"{1e3 * seconds:.1f}"] for name, seconds in rows]
    return format_table(["median of 7 runs", "CPU ms"], table)


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


def ingest_table() -> str:
    """Stokes images from a mosaic of 5 megapixels, three ways; without reading the file."""
    cv2.setNumThreads(1)
    rng = np.random.default_rng(0)
    rows, cols = np.mgrid[:2048, :2448]
    scene = 90 + 60 * np.sin(rows / 37) * np.cos(cols / 53) + rng.normal(0, 2, rows.shape)
    raw = np.clip(scene, 1, 250).astype(np.uint8)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.pgm"
        header = b"P5\n%d %d\n255\n" % raw.shape[::-1]
        for name in ("a.pgm", "b.pgm"):
            (path.parent / name).write_bytes(header + raw.tobytes())
        capture = open_capture(path.parent)
        reading = _median_seconds(lambda: capture._read(path))
        own = _median_seconds(lambda: capture.load("a.pgm")) - reading
    ways = [("polmvs: interpolated to the cell's centre, noise, clipped and dark pixels", own)]
    ways.append(
        (
            "OpenCV: slices of the mosaic, Stokes, angle and degree",
            _median_seconds(partial(_opencv_ingest, raw)),
        )
    )
    try:
        import polanalyser
    except ImportError:
        ways.append(("polanalyser: not installed", np.nan))
    else:
        angles = np.deg2rad([0, 45, 90, 135])

        def others() -> object:
            images = polanalyser.demosaicing(raw, polanalyser.COLOR_PolarMono)
            stokes = polanalyser.calcStokes(images, angles)
            return polanalyser.cvtStokesToAoLP(stokes), polanalyser.cvtStokesToDoLP(stokes)

        ways.append(("polanalyser: demosaicing, Stokes, angle and degree", _median_seconds(others)))
    rows_ = [[name, f"{1e3 * t:.1f}", f"{t / own:.2f}"] for name, t in ways]
    return format_table(["mosaic of 2448x2048, median of 7", "CPU ms", "of polmvs"], rows_)


def _opencv_ingest(raw: NDArray[np.uint8]) -> object:
    samples = raw.astype(np.float32)
    i90, i45, i135, i0 = (samples[r::2, c::2] for r, c in ((0, 0), (0, 1), (1, 0), (1, 1)))
    s0 = 0.5 * (i0 + i45 + i90 + i135)
    s1, s2 = cv2.subtract(i0, i90), cv2.subtract(i45, i135)
    length, angle = cv2.cartToPolar(s1, s2)
    return 0.5 * angle, length / s0


# Growth


@dataclass(frozen=True, kw_only=True)
class Growth:
    """One run of some views.

    Attributes
    ----------
    num_views : of it.
    seconds, peak_mb : of the processor and of memory, of each stage by name.
    """

    num_views: int
    seconds: dict[str, float]
    peak_mb: dict[str, float]


@dataclass(frozen=True, kw_only=True)
class Scaling:
    """The per-view stages with some workers.

    Attributes
    ----------
    backend : ``threads``, ``processes`` or ``Dask``.
    num_workers : of it.
    seconds : of images and maps, workers started already; the least of some trials.
    """

    backend: str
    num_workers: int
    seconds: float


def save_growth(
    folder: Path, text: str, runs: Sequence[Growth], scalings: Sequence[Scaling]
) -> None:
    """Write ``growth.md`` and ``images/growth.png`` into a folder of documents."""
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot

    (folder / "images").mkdir(parents=True, exist_ok=True)
    figure, axes = pyplot.subplots(1, 3, figsize=(13, 3.8), layout="constrained")
    views = [run.num_views for run in runs]
    last = runs[-1].seconds
    shown = [stage for stage in last if last[stage] > SHOWN_SHARE * sum(last.values())]
    for stage in sorted(shown, key=last.__getitem__, reverse=True):
        axes[0].loglog(views, [run.seconds[stage] for run in runs], "o-", label=stage)
        axes[1].semilogx(views, [run.peak_mb[stage] for run in runs], "o-", label=stage)
    for backend in dict.fromkeys(one.backend for one in scalings):
        some = [one for one in scalings if one.backend == backend]
        nums, seconds = [one.num_workers for one in some], [one.seconds for one in some]
        axes[2].semilogx(nums, seconds, "o-", label=backend)
    workers = sorted({one.num_workers for one in scalings})
    for axis, ticks, x, y in (
        (axes[0], views, "views", "CPU seconds of a stage"),
        (axes[1], views, "views", "peak memory of a stage, MB"),
        (axes[2], workers, "workers", "images and maps, seconds"),
    ):
        axis.set(xlabel=x, ylabel=y)
        axis.set_xticks(ticks, [str(tick) for tick in ticks])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
        if axis is not axes[0]:
            axis.set_ylim(bottom=0)
    axes[1].legend(fontsize=7, ncols=3, loc="lower center")  # under the least memory
    axes[2].legend(fontsize=8)
    figure.savefig(folder / "images" / "growth.png", dpi=120)
    pyplot.close(figure)
    picture = "![Time and memory of the stages with the views, and with workers](images/growth.png)"
    write_bytes(folder / "growth.md", f"{text}\n\n{picture}\n".encode())


def growth_page(
    given: Arguments, options: Options, run_options: RunOptions, terminal: Terminal
) -> tuple[str, list[Growth], list[Scaling]]:
    """Make the captures, run them, and fit the exponents: Markdown, and what it shows."""
    assert given.growth is not None
    run_options = replace(run_options, workers=1, scheduler=None, overwrite=True, resume=False)
    runs = [_run_views(given, num, options, run_options, terminal) for num in sorted(given.views)]
    scalings = _scalings(given, min(given.views), terminal)
    stages = list(runs[-1].seconds)
    header = ["stage", *(f"{run.num_views} views, CPU s" for run in runs), "exponent"]
    header += [*(f"{run.num_views}, MB" for run in runs), "ratio of time per view"]
    rows = []
    for stage in stages:
        times = [run.seconds[stage] for run in runs]
        per_view = [t / run.num_views for t, run in zip(times, runs, strict=True)]
        rows.append(
            [
                stage,
                *(f"{t:.2f}" for t in times),
                _exponent(runs, times),
                *(f"{run.peak_mb[stage]:.0f}" for run in runs),
                f"{per_view[-1] / max(per_view[0], 1e-9):.2f}",
            ]
        )
    one = {s.backend: s.seconds for s in scalings if s.num_workers == min(given.num_workers)}
    worker_rows = [
        [
            f"{s.backend}, {s.num_workers}",
            f"{s.seconds:.2f}",
            f"{one[s.backend] / s.seconds:.2f}",
            f"{one[s.backend] / s.seconds / s.num_workers:.2f}",
        ]
        for s in scalings
    ]
    sizes = ",".join(map(str, given.views))
    text = "\n\n".join(
        [
            "# Growth with views and workers",
            f"`python pipelines/benchmark.py --growth WORK --views {sizes} --width {given.width} "
            f"--num-workers {','.join(map(str, given.num_workers))}`, on "
            f"{_machine()}.",
            f"Captures of `pipelines/synthetic.py`, half-size images {given.width} px wide, true "
            "poses and 2,000 true sparse points in place of SfM's, one process. An exponent of 1 "
            "is a time that grows with the views; the last column is the time per view of most "
            "views over that of fewest.",
            format_table(header, rows),
            "Stages `images` and `maps` of the smallest capture, their workers started before, by "
            f"the clock, the least of {TRIALS} trials:",
            format_table(["workers", "s", "speed-up", "efficiency"], worker_rows),
        ]
    )
    return text, runs, scalings


def _machine() -> str:
    """What the figures were measured on."""
    model = platform.processor() or platform.machine()
    cpuinfo = Path("/proc/cpuinfo")
    if cpuinfo.is_file():
        names = [line for line in cpuinfo.read_text().splitlines() if line.startswith("model name")]
        model = names[0].partition(":")[2].strip() if names else model
    load = os.getloadavg()[0] if hasattr(os, "getloadavg") else float("nan")
    found = versions()
    return (
        f"{os.cpu_count()} cores ({model}), load {load:.1f} at the end, Python {found['python']}, "
        f"NumPy {found['numpy']}, polmvs {found['polmvs']}"
    )


def _capture(given: Arguments, num_views: int) -> tuple[Path, Path]:
    """Folders of a capture and of its true model, made where they are missing."""
    assert given.growth is not None
    folder = given.growth / f"capture-{num_views}-{given.width}"
    model = given.growth / f"model-{num_views}-{given.width}"
    if not folder.exists():
        views = orbit_views(num_views, camera_of(given.width))
        scene = scene_of(Part.BOARD)
        with Workers(default_num_workers()) as workers:
            write_printed_capture(folder, views, scene, workers=workers)
        shutil.rmtree(model, ignore_errors=True)
        write_model(printed_model(scene, views), model)
    return folder, model


def _run_views(
    given: Arguments, num_views: int, options: Options, run_options: RunOptions, terminal: Terminal
) -> Growth:
    folder, model = _capture(given, num_views)
    assert given.growth is not None
    job = Job(
        capture=folder,
        out=given.growth / f"run-{num_views}-{given.width}",
        options=replace(options, sfm=replace(options.sfm, sparse=model)),
        run_options=run_options,
    )
    start = time.perf_counter()
    # What one run has loaded is no memory of the next.
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        record = pool.submit(reconstruct, job).result().record
    terminal.finished(f"{num_views} views", time.perf_counter() - start, "")
    return Growth(
        num_views=num_views,
        seconds={stage.name: stage.cpu_s for stage in record.stages},
        peak_mb={stage.name: stage.peak_rss_mb for stage in record.stages},
    )


def _exponent(runs: Sequence[Growth], times: Sequence[float]) -> str:
    """Slope of the logarithms; none for what takes no time."""
    if min(times) < 0.05 or len(runs) < 2:
        return "-"
    views = np.log([run.num_views for run in runs])
    return f"{np.polyfit(views, np.log(times), 1)[0]:.2f}"


class _Threads:
    """Threads of this process, as a backend to compare with."""

    def __init__(self, num: int) -> None:
        self.pool = ThreadPoolExecutor(num)

    def submit(self, function: Callable[..., Any], task: tuple[Any, ...]) -> Future[Any]:
        """Queue a task."""
        return self.pool.submit(function, *task)

    def result(
        self,
        function: Callable[..., Any],
        tasks: list[tuple[Any, ...]],
        futures: list[Future[Any]],
        index: int,
    ) -> Any:
        """Result of a task."""
        return futures[index].result()

    def close(self, *, cancel: bool) -> None:
        """End the threads."""
        self.pool.shutdown(cancel_futures=cancel)


@contextmanager
def _workers_of(backend: str, num: int) -> Iterator[Workers | None]:
    """Some workers, started; None where Dask is not installed."""
    if backend == "threads":
        with Workers(num, _Threads(num)) as workers:
            yield workers
    elif backend == "processes":
        with Workers(num) as workers:
            yield workers
    else:
        try:
            from distributed import LocalCluster
        except ImportError:
            yield None
            return
        with (
            LocalCluster(n_workers=num, threads_per_worker=1, dashboard_address=":0") as cluster,
            Workers.of_cluster(cluster.scheduler_address) as workers,
        ):
            yield workers


def _scalings(given: Arguments, num_views: int, terminal: Terminal) -> list[Scaling]:
    folder, model = _capture(given, num_views)
    capture = open_capture(folder.absolute())
    found = []
    for backend in ("threads", "processes", "Dask"):
        for num in given.num_workers:
            with _workers_of(backend, num) as workers:
                if workers is None:
                    continue
                list(workers.map(_warm_up, range(4 * num)))
                trials = [_per_view(capture, model.absolute(), workers) for _ in range(TRIALS)]
                seconds = min(trials)
            found.append(Scaling(backend=backend, num_workers=num, seconds=seconds))
            terminal.finished(f"{backend}, {num}", seconds, "")
    return found


def _per_view(capture: Capture, model: Path, workers: Workers) -> float:
    """Seconds that the images and maps of a capture take."""
    with tempfile.TemporaryDirectory(dir=capture.folder.parent) as scratch:
        folder = RunFolder(Path(scratch))
        shutil.copytree(model, folder.sparse)
        start = time.perf_counter()
        write_images(capture, folder.images, workers=workers)
        build_maps(capture, folder, RegionOptions(), workers=workers)
        return time.perf_counter() - start


def _warm_up(index: int) -> int:
    """Have a worker import what the stages need."""
    import polmvs.pipeline.stages.maps  # noqa: F401

    time.sleep(0.1)
    return index


def _median_seconds(work: Callable[[], object]) -> float:
    """Of the processor, so that other work on the machine does not count."""
    work()
    seconds = []
    for _ in range(REPEATS):
        start = time.process_time()
        work()
        seconds.append(time.process_time() - start)
    return float(np.median(seconds))


main = script(
    __file__,
    __doc__,
    _benchmark,
    (Arguments, *TO_CLOUD, ExportOptions, EvaluationOptions, *EXECUTION),
)

if __name__ == "__main__":
    raise SystemExit(main())
