"""Number of views and light for a part, from a few small simulations."""

from __future__ import annotations

import hashlib
import io
import shutil
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from polmvs.errors import OptionError
from polmvs.io.images import write_bytes
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import from_json, json_bytes, parse_json, write_json
from polmvs.parallel import OnProgress, no_progress
from polmvs.simulation.options import LightName, PlanOptions, Simulation
from polmvs.simulation.trial import TrialResult, run_trial, trial_table

ENOUGH_OF_BEST = 0.02  # F-score given up for fewer views; defines the recommendation
USELESS = 0.5  # F-score at 2 mm below which nothing is recommended; defines it as well
TABLE_FILE, PLOT_FILE = "plan.md", "plan.png"


@dataclass(frozen=True, kw_only=True)
class PlannedTrial:
    """A trial with its light and number of views."""

    light: LightName
    trial: TrialResult


@dataclass(frozen=True, kw_only=True)
class Plan:
    """Result of the trials.

    Attributes
    ----------
    trials : of each light and number of views.
    recommendation : one sentence.
    folder : of table and plot.
    """

    trials: tuple[PlannedTrial, ...]
    recommendation: str
    folder: Path

    def table(self) -> str:
        """A row for each trial, in Markdown."""
        named = [replace(one.trial, name=one.light.value) for one in self.trials]
        return trial_table(named, first="light")


def make_plan(
    mesh: str,
    folder: Path,
    simulation: Simulation,
    options: PlanOptions,
    *,
    on_progress: OnProgress = no_progress,
) -> Plan:
    """Simulate, reconstruct and measure; ``plan.md`` and ``plan.png`` in the folder.

    Parameters
    ----------
    simulation : of the part; its light, number of views and size of images are those of
        ``options``.
    on_progress : called for each trial. Finished ones are kept in the folder and do not run again.

    Raises
    ------
    DataError, OptionError
        As :func:`polmvs.simulation.capture.simulate_capture`.
    """
    if simulation.path.cameras is not None:
        raise OptionError("gives the views that are to be planned.", field="path.cameras")
    folder.mkdir(parents=True, exist_ok=True)
    trials = []
    for light in options.lights:
        for views in sorted(options.view_counts):
            trials.append(_trial(mesh, folder, simulation, options, light, views))
            on_progress(1)
    plan = Plan(trials=tuple(trials), recommendation=recommend(trials), folder=folder)
    text = f"{plan.table()}\n\n{plan.recommendation}\n"
    write_bytes(folder / TABLE_FILE, text.encode())
    write_bytes(folder / PLOT_FILE, _plot(trials))
    return plan


def recommend(trials: Sequence[PlannedTrial]) -> str:
    """The fewest views that come close to the best result, in one sentence."""
    best = max(trials, key=lambda one: one.trial.f_score[1])
    if not best.trial.f_score[1] >= USELESS:
        return (
            "None of these suffices: the best, "
            f"{best.trial.views} views under {best.light} light, finds "
            f"{100 * best.trial.completeness[1]:.0f} % of the surface within 2 mm; try more views, "
            "more marks, another light, or a matt coating."
        )
    near = [
        one
        for one in trials
        if one.trial.f_score[1] >= best.trial.f_score[1] - ENOUGH_OF_BEST
        and one.trial.f_score[0] >= best.trial.f_score[0] - 5 * ENOUGH_OF_BEST
    ]
    chosen = min(near, key=lambda one: (one.trial.views, -one.trial.f_score[0]))
    found = chosen.trial
    return (
        f"Take {found.views} views under {chosen.light} light: they find "
        f"{100 * found.completeness[0]:.0f} % of the surface within 1 mm and "
        f"{100 * found.completeness[1]:.0f} % within 2 mm, with normals to "
        f"{found.normal_median_deg:.1f} degrees (median)."
    )


def _trial(
    mesh: str,
    folder: Path,
    simulation: Simulation,
    options: PlanOptions,
    light: LightName,
    views: int,
) -> PlannedTrial:
    asked = replace(
        simulation,
        lighting=replace(simulation.lighting, light=light),
        path=replace(simulation.path, views=views),
        sensor=replace(simulation.sensor, image_size=options.plan_size),
    )
    digest = hashlib.sha256(json_bytes([mesh, asked])).hexdigest()[:8]
    place = folder / f"{light}_{views:03d}_{digest}"  # of other options it is another
    stored = place / "trial.json"
    if stored.is_file():
        trial = from_json(TrialResult, parse_json(read_text(stored)))
    else:
        trial = run_trial(f"{light}, {views}", mesh, place, asked)
        write_json(stored, trial)
        if not options.keep:
            shutil.rmtree(place / "capture", ignore_errors=True)
            shutil.rmtree(place / "run", ignore_errors=True)
    return PlannedTrial(light=light, trial=trial)


def _plot(trials: Sequence[PlannedTrial]) -> bytes:
    """Completeness, F-score, error of normals and time over the number of views, by the light."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(13, 3.2), layout="constrained")
    axes = figure.subplots(1, 4)
    titles = (
        *("completeness at 1 mm, %", "F-score at 1 mm, %", "normal error, median, deg"),
        "time of the reconstruction, s",
    )
    for light in dict.fromkeys(one.light for one in trials):
        own = [one.trial for one in trials if one.light is light]
        views = [trial.views for trial in own]
        columns = (
            [100 * trial.completeness[0] for trial in own],
            [100 * trial.f_score[0] for trial in own],
            [trial.normal_median_deg for trial in own],
            [trial.seconds for trial in own],
        )
        for axis, column in zip(axes, columns, strict=True):
            axis.plot(views, column, marker="o", label=light.value)
    for axis, title in zip(axes, titles, strict=True):
        axis.set(xlabel="views", title=title)
        axis.set_xticks(sorted({one.trial.views for one in trials}))
        axis.grid(alpha=0.3)
        axis.margins(y=0.15)  # what lies at the end is seen whole
        axis.set_ylim(bottom=0)
    for axis in axes[:2]:
        axis.set_ylim(0, 105)
    axes[0].legend()
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=110)
    return buffer.getvalue()
