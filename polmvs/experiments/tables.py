"""Results as JSON values and Markdown tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from polmvs.config import AngleModel
from polmvs.experiments import style
from polmvs.experiments.contours import METHODS, LineStats, ViewContours
from polmvs.experiments.phase import PhaseResult
from polmvs.experiments.plane import ESTIMATES, PlaneResult
from polmvs.experiments.statistics import SignedStats, ratio
from polmvs.experiments.tracks import ESTIMATORS, UNDER_DEG, TrackErrors, TrackResult


def phase_json(result: PhaseResult) -> dict[str, Any]:
    """Content of ``phase.json`` beside the settings."""
    return {
        **{model.value: asdict(stats) for model, stats in result.all_pixels.items()},
        "ratio_ppa_opa": result.ratio(AngleModel.PPA),
        "ratio_tilted_opa": result.ratio(AngleModel.TILTED),
        "outside_marks": {
            **{model.value: asdict(stats) for model, stats in result.unmarked.items()},
            "ratio_ppa_opa": result.ratio_unmarked(AngleModel.PPA),
            "ratio_tilted_opa": result.ratio_unmarked(AngleModel.TILTED),
        },
        "rmse_deg_per_view": result.per_view,
    }


def phase_table(result: PhaseResult) -> str:
    """Phase errors, all pixels and those outside of printed marks."""
    rows = []
    for where, stats, share in (
        ("all valid pixels", result.all_pixels, result.ratio),
        ("outside printed marks", result.unmarked, result.ratio_unmarked),
    ):
        rows += [[where, *_phase_row(m, s, share(m))] for m, s in stats.items()]
    head = ["pixels", "model", "mean", "RMSE", "median", "95 %", "RMSE / OPA", "number"]
    return table(head, rows)


def _phase_row(model: AngleModel, stats: SignedStats, share: float) -> list[str]:
    return [
        style.MODEL_LABELS[model],
        f"{stats.mean_deg:+.2f}°",
        f"{stats.rmse_deg:.2f}°",
        f"{stats.median_deg:.2f}°",
        f"{stats.p95_deg:.2f}°",
        f"{100 * share:.1f} %",
        f"{stats.num_pixels}",
    ]


def plane_json(result: PlaneResult) -> dict[str, Any]:
    """Content of ``plane.json`` beside the settings."""
    estimates = {
        name: {
            **asdict(stats),
            "seconds": result.seconds[name],
            "num_failed": result.failed[name],
        }
        for name, stats in result.stats.items()
    }
    return {
        **estimates,
        "per_image": [asdict(image) for image in result.per_image],
        "skipped": list(result.skipped),
        "pi_ambiguity": {model.value: asdict(a) for model, a in result.ambiguity.items()},
    }


def plane_table(result: PlaneResult) -> str:
    """Errors and times of the single-view normals, and the ambiguity of pi."""
    rows = [
        [
            style.PLANE_LABELS[name],
            f"{result.stats[name].mean_deg:.3f}°",
            f"{result.stats[name].rmse_deg:.3f}°",
            f"{result.stats[name].median_deg:.3f}°",
            f"{1e3 * result.seconds[name]:.1f} ms",
            f"{result.stats[name].count} of {len(result.per_image)}",
        ]
        for name in ESTIMATES
    ]
    errors = table(["estimate", "mean", "RMSE", "median", "time", "images"], rows)
    twins = [
        [
            style.MODEL_LABELS[model],
            f"{a.rmse_deg:.2f}°",
            f"{a.rmse_turned_deg:.2f}°",
            f"{100 * a.determined_share:.0f} %",
        ]
        for model, a in result.ambiguity.items()
    ]
    head = ["model", "residual of the true normal", "of its twin turned by π", "views determined"]
    return f"{errors}\n{table(head, twins)}"


def tracks_json(result: TrackResult) -> dict[str, Any]:
    """Content of ``tracks.json`` beside the settings."""
    return {
        "k": list(result.k),
        "num_points": list(result.num_points),
        **{name: _track_json(errors) for name, errors in result.estimators.items()},
    }


def _track_json(errors: TrackErrors) -> dict[str, list[float]]:
    return {
        "mean_deg": errors.over(lambda e: float(e.mean())),
        "median_deg": errors.over(lambda e: float(np.median(e))),
        "p80_deg": errors.over(lambda e: float(np.percentile(e, 80))),
        "under_25": errors.under,
        "valid_share": errors.valid_share,
    }


def tracks_table(result: TrackResult, wanted: Sequence[int] = (2, 3, 5, 10, 15, 20)) -> str:
    """Errors of the normals from tracks, for some numbers of views."""
    shown = [i for i, k in enumerate(result.k) if k in wanted] or [0]
    head = ["estimator", "statistic", *(f"K = {result.k[i]}" for i in shown)]
    rows = []
    for name in ESTIMATORS:
        content = _track_json(result.estimators[name])
        for key, label in (("mean_deg", "mean"), ("median_deg", "median"), ("p80_deg", "80 %")):
            values = [f"{content[key][i]:.2f}°" for i in shown]
            rows.append([style.TRACK_LABELS[name], label, *values])
        shares = [f"{100 * content['under_25'][i]:.1f} %" for i in shown]
        rows.append([style.TRACK_LABELS[name], f"under {UNDER_DEG:.0f}°", *shares])
    rows.append(["points", "", *(str(result.num_points[i]) for i in shown)])
    return table(head, rows)


def contours_json(views: Sequence[ViewContours], stats: Mapping[str, LineStats]) -> dict[str, Any]:
    """Content of ``contours.json`` beside the settings."""
    opa = stats["opa"].rmse_mm
    return {
        **{name: asdict(line_stats) for name, line_stats in stats.items()},
        "ratio_to_opa": {name: ratio(stats[name].rmse_mm, opa) for name in METHODS},
        "per_view": [
            {
                "name": view.name,
                "second": view.second,
                "rmse_mm": {name: line.rmse_mm for name, line in view.lines.items()},
            }
            for view in views
        ],
    }


def contours_table(stats: Mapping[str, LineStats]) -> str:
    """Distance of the contours to the true surface."""
    rows = [
        [
            style.CONTOUR_LABELS[name],
            f"{s.rmse_mm:.2f} mm",
            f"{s.median_mm:.2f} mm",
            f"{s.p95_mm:.2f} mm",
            f"{100 * ratio(s.rmse_mm, stats['opa'].rmse_mm):.1f} %",
            f"{s.num_curves}",
            f"{s.num_points}",
        ]
        for name, s in stats.items()
    ]
    return table(["contours", "RMSE", "median", "95 %", "RMSE / OPA", "curves", "points"], rows)


def table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table."""
    lines = ["| " + " | ".join(cells) + " |" for cells in (head, ["---"] * len(head), *rows)]
    return "\n".join(line.replace("nan", "–") for line in lines) + "\n"
