"""Results as tables."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from polmvs.errors import printable
from polmvs.evaluation.metrics import AngleStats, CloudMetrics

NONE = "-"


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """An aligned Markdown table; the first column is text, the others are numbers."""
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


def rmse_and_median(stats: AngleStats | None) -> str:
    """RMSE and median of angles, degrees."""
    return pair(*((stats.rmse_deg, stats.median_deg) if stats is not None else (None, None)))


def mean_and_median(stats: AngleStats | None) -> str:
    """Mean and median of angles, degrees."""
    return pair(*((stats.mean_deg, stats.median_deg) if stats is not None else (None, None)))


def cloud_rows(cloud: CloudMetrics) -> list[list[str]]:
    """Name and value of every metric of a cloud against ground truth."""
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
    rows.append(["outliers, %", number(cloud.off_surface_share, 100, 1)])
    return rows
