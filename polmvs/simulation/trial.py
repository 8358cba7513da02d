"""One trial: render a capture, reconstruct it from its images only, and evaluate the result."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from polmvs.config import CaptureOptions, EvaluationOptions, Options, RunOptions, SfmOptions
from polmvs.errors import PolmvsError
from polmvs.evaluation.comparison import ModelFigures
from polmvs.evaluation.tables import format_table
from polmvs.evaluation.trust import Trust
from polmvs.io.clouds import Mesh
from polmvs.pipeline.jobs import compare, judge
from polmvs.pipeline.runner import Job
from polmvs.polarization.kinds import AngleModel
from polmvs.simulation.capture import simulate_capture
from polmvs.simulation.options import SensorOptions, Simulation, SimulationRun

MODEL = AngleModel.PPA
CAPTURE, RUN = "capture", "run"  # folders of a trial
HEADER = (  # but for the name
    "views",
    "posed",
    "points",
    "completeness 1 mm, %",
    "F 1 mm, %",
    "F 2 mm, %",
    "normals, median deg",
    "trusted",
    "s",
    "",
)


@dataclass(frozen=True, kw_only=True)
class TrialResult:
    """Result of one capture.

    Attributes
    ----------
    name : of the capture.
    views, posed : number of views, and of registered views.
    points : of the cloud's surface.
    completeness, f_score : at 1 and 2 mm, shares; NaN without a result.
    normal_median_deg : error of the cloud's normals.
    is_trusted : by the quality checks; None without a result.
    seconds : of the reconstruction and its checks.
    message : why there is no result, or why it is not to be trusted; else empty.
    """

    name: str
    views: int
    posed: int = 0
    points: int = 0
    completeness: tuple[float, float] = (0.0, 0.0)
    f_score: tuple[float, float] = (0.0, 0.0)
    normal_median_deg: float = float("nan")
    is_trusted: bool | None = None
    seconds: float = 0.0
    message: str = ""

    @property
    def cells(self) -> tuple[str, ...]:
        """Cells of a row of the table."""
        return (
            self.name,
            str(self.views),
            str(self.posed),
            f"{self.points:,}",
            f"{100 * self.completeness[0]:.1f}",
            f"{100 * self.f_score[0]:.1f}",
            f"{100 * self.f_score[1]:.1f}",
            f"{self.normal_median_deg:.2f}",
            {True: "yes", False: "no", None: "-"}[self.is_trusted],
            f"{self.seconds:.0f}",
            self.message,
        )


def run_trial(
    name: str,
    mesh: str | Path | Mesh,
    folder: Path,
    simulation: Simulation,
) -> TrialResult:
    """Render a capture into a folder, reconstruct and evaluate it; a failure is a result.

    Parameters
    ----------
    folder : of the capture and the run, ``capture`` and ``run``; both are resumed.
    """
    capture, run = folder / CAPTURE, folder / RUN
    made = simulate_capture(mesh, capture, simulation, SimulationRun(resume=True))
    options = options_of(capture, simulation.sensor)
    (trial,) = measure(name, capture, run, options, views=made.num_views)
    return trial


def options_of(capture: Path, sensor: SensorOptions) -> Options:
    """Options for the reconstruction of a rendered capture."""
    return Options(
        capture=CaptureOptions(
            pattern=sensor.pattern, full_scale=float(2**sensor.bits - 1), bayer=sensor.colour
        ),
        sfm=SfmOptions(camera=capture / "camera.txt"),
        evaluation=EvaluationOptions(gt=capture / "gt"),
    )


def measure(
    name: str,
    capture: Path,
    run: Path,
    options: Options,
    *,
    views: int,
    models: Sequence[AngleModel] = (MODEL,),
    workers: int = 1,
) -> list[TrialResult]:
    """Reconstruct a capture under each model and evaluate it; a failure is a result.

    Parameters
    ----------
    run : folder of the results; its content is replaced.
    options : with the capture's ground truth.
    views : number of views of the capture.
    """
    begun = time.perf_counter()
    job = Job(
        capture=capture,
        out=run,
        options=options,
        run_options=RunOptions(workers=workers, overwrite=run.exists()),
    )
    trial = TrialResult(name=name, views=views)
    try:
        outcome = compare(job, tuple(models))
        trusts = [judge(outcome.run_folder, model) for model in models]
    except PolmvsError as error:
        message = " ".join(str(error).split())[:160]
        failed = replace(trial, seconds=time.perf_counter() - begun, message=message)
        return [failed] * len(models)
    comparison = outcome.comparison
    assert comparison is not None
    trial = replace(
        trial,
        seconds=time.perf_counter() - begun,
        posed=comparison.sparse.num_views,
        message=outcome.empty or "",
    )
    return [
        _with_figures(trial, comparison.models[model], trust)
        for model, trust in zip(models, trusts, strict=True)
    ]


def _with_figures(trial: TrialResult, figures: ModelFigures, trust: Trust) -> TrialResult:
    if figures.truth is None:
        return trial
    cloud = figures.truth.cloud
    return replace(
        trial,
        points=cloud.num_on_part,
        completeness=(cloud.completeness[0], cloud.completeness[1]),
        f_score=(cloud.f_score[0], cloud.f_score[1]),
        normal_median_deg=cloud.normal_median_deg,
        is_trusted=trust.is_trusted,
        message=trial.message or ("" if trust.is_trusted else trust.verdict),
    )


def trial_table(trials: Sequence[TrialResult], *, first: str = "capture") -> str:
    """Markdown table with a row for each trial; ``first`` is the heading of their names."""
    return format_table((first, *HEADER), [trial.cells for trial in trials])
