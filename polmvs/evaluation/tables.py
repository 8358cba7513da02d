"""Figures as tables to read."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from polmvs.config import AngleModel
from polmvs.errors import printable
from polmvs.evaluation.metrics import AngleStats, CloudMetrics

if TYPE_CHECKING:
    from polmvs.evaluation.comparison import Comparison, ModelFigures, PhaseFigures, TruthFigures
    from polmvs.evaluation.map_errors import MapErrors

NONE = "-"


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, aligned for the eye; the first column is text, the others numbers."""
    cells = [[printable(cell) for cell in row] for row in (header, *rows)]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    lines = [_line(row, widths) for row in cells]
    rule = ["-" * widths[0], *["-" * (width - 1) + ":" for width in widths[1:]]]
    return "\n".join([lines[0], _line(rule, widths), *lines[1:]])


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    first = row[0].ljust(widths[0])
    rest = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
    return "| " + " | ".join([first, *rest]) + " |"


def number(value: float | None, factor: float = 1.0, digits: int = 2) -> str:
    """A number with fixed digits, a dash for none."""
    if value is None or not np.isfinite(value):
        return NONE
    return f"{factor * value:.{digits}f}"


def pair(first: float | None, second: float | None) -> str:
    """Two numbers."""
    return f"{number(first)} / {number(second)}"


def best_fit_lines(comparison: Comparison) -> list[str]:
    """Which of several models the capture's phases fit best, if there is anything to tell it by."""
    best = comparison.best_fit
    if best is None or len(comparison.models) < 2:
        return []
    residual = comparison.models[best].consistency.track_residual_median_deg
    return ["", f"The phases fit {best.label} best: {number(residual)} deg at the seeds."]


def comparison_rows(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the figures, a column for each model."""
    models = comparison.models

    def row(name: str, cell: Callable[[ModelFigures], str]) -> list[str]:
        return [name, *map(cell, models.values())]

    rows = [
        row("points", lambda m: f"{m.consistency.num_points:,}"),
        row("part of the region covered, %", lambda m: number(m.consistency.coverage, 100, 1)),
        row(
            "agreement of the views that see a point, %",
            lambda m: number(m.consistency.agreement, 100, 1),
        ),
        row(
            "phase residual over all views, RMSE / median, deg",
            lambda m: rmse_and_median(m.consistency.phase_residual),
        ),
        row(
            "phase residual of the seeds, median, deg",
            lambda m: number(m.consistency.track_residual_median_deg),
        ),
    ]
    truth = {model: figures.truth for model, figures in models.items() if figures.truth is not None}
    if len(truth) == len(models):
        rows += _truth_rows(truth, comparison.phase)
    return ["", *[model.label for model in models]], rows


def rmse_and_median(stats: AngleStats | None) -> str:
    """RMSE and median of angles, degrees."""
    return pair(*((stats.rmse_deg, stats.median_deg) if stats is not None else (None, None)))


def mean_and_median(stats: AngleStats | None) -> str:
    """Mean and median of angles, degrees."""
    return pair(*((stats.mean_deg, stats.median_deg) if stats is not None else (None, None)))


def _truth_rows(
    models: Mapping[AngleModel, TruthFigures], phase: PhaseFigures | None
) -> list[list[str]]:
    """Rows of the measures against the truth."""
    rows = []
    if phase is not None:
        for what, errors in (("smoothed", phase.maps), ("single pixels", phase.pixels)):
            cells = [rmse_and_median(errors.get(model.formula)) for model in models]
            rows.append([f"phase error on the part, {what}, RMSE / median, deg", *cells])
    figures = list(models.values())
    rows.append(
        [
            "error of the sparse normals, mean / median, deg",
            *[mean_and_median(f.tracks.errors if f.tracks else None) for f in figures],
        ]
    )
    maps = [f.maps for f in figures]
    rows += [
        ["depth maps, RMSE, mm", *[number(m.depth_rmse_m if m else None, 1e3) for m in maps]],
        [
            "depth maps within 1 mm, %",
            *[number(m.depth_within_1mm if m else None, 100, 1) for m in maps],
        ],
        [
            "depths within one / two stated deviations, %",
            *[_within_sigmas(m) if m else number(None) for m in maps],
        ],
        [
            "normal maps, mean / median error, deg",
            *[mean_and_median(m.normals if m else None) for m in maps],
        ],
    ]
    for same in zip(*(cloud_rows(f.cloud) for f in figures), strict=True):
        rows.append([same[0][0], *[row[1] for row in same]])
    return rows


def _within_sigmas(errors: MapErrors) -> str:
    shares = (errors.within_one_sigma, errors.within_two_sigma)
    return " / ".join(number(share, 100, 0) for share in shares)


def cloud_rows(cloud: CloudMetrics) -> list[list[str]]:
    """Name and figure of every measure of a cloud against the truth."""
    rows = []
    for name, shares in (
        ("F-score", cloud.f_score),
        ("accuracy", cloud.accuracy),
        ("completeness", cloud.completeness),
    ):
        for threshold, share in zip(cloud.thresholds_m, shares, strict=True):
            rows.append([f"{name} at {1e3 * threshold:g} mm, %", number(share, 100, 1)])
    rows.append(["Chamfer distance, mm", number(cloud.chamfer_m, 1e3, 2)])
    rows.append(
        ["normal error, mean / median, deg", pair(cloud.normal_mean_deg, cloud.normal_median_deg)]
    )
    rows.append(["points off every surface, %", number(cloud.off_surface_share, 100, 1)])
    return rows


def evaluation_text(figures: TruthFigures) -> str:
    """Table of one cloud against the truth, and how it was aligned."""
    cloud, alignment = figures.cloud, figures.alignment
    return (
        format_table(["", "value"], cloud_rows(cloud))
        + f"\n{cloud.num_points:,} points, {cloud.num_on_part:,} on "
        f"the part. Aligned by {alignment.num_cameras} cameras, "
        f"{alignment.rms_residual_mm:.2f} mm RMS."
    )
