"""Figures as tables to read; they come from ``metrics.json`` and ``run.json`` as they are."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

NONE = "-"


def format_table(header: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A table in Markdown, aligned for the eye; the first column is text, the others numbers."""
    cells = [list(header), *[list(row) for row in rows]]
    widths = [max(len(row[i]) for row in cells) for i in range(len(header))]
    lines = [_line(row, widths) for row in cells]
    rule = ["-" * widths[0], *["-" * (width - 1) + ":" for width in widths[1:]]]
    return "\n".join([lines[0], _line(rule, widths), *lines[1:]])


def _line(row: Sequence[str], widths: Sequence[int]) -> str:
    first = row[0].ljust(widths[0])
    rest = [cell.rjust(width) for cell, width in zip(row[1:], widths[1:], strict=True)]
    return "| " + " | ".join([first, *rest]) + " |"


def summary_text(metrics: Mapping[str, Any]) -> str:
    """The summary of a comparison, Markdown."""
    results = metrics["results"]
    missing = results.get("unregistered", [])
    lines = [
        f"# {metrics['capture']}",
        "",
        f"{results['num_views']} of {results['num_views'] + len(missing)} views have a pose"
        + (f"; without one: {', '.join(missing)}" if missing else "")
        + f". {results['num_tracks']} sparse points, {results['num_seeds']} of them seeds.",
        "",
        comparison_table(metrics),
        *best_fit_lines(metrics),
    ]
    return "\n".join(lines) + "\n"


def best_fit_lines(metrics: Mapping[str, Any]) -> list[str]:
    """Which model the capture's phases fit best, if there is anything to tell it by."""
    best = metrics.get("best_fit")
    if best is None:
        return []
    residual = dig(metrics["models"], best, "consistency", "track_residual_median_deg")
    return ["", f"The phases fit {best.upper()} best: {number(residual)} deg at the seeds."]


def comparison_table(metrics: Mapping[str, Any]) -> str:
    """One column for each model."""
    models: Mapping[str, Any] = metrics["models"]
    rows = [
        ["points", *[f"{m['consistency']['num_points']:,}" for m in models.values()]],
        ["part of the region covered, %", *_each(models, ("coverage",), 100, 1)],
        ["agreement of the views that see a point, %", *_each(models, ("agreement",), 100, 1)],
        [
            "phase residual over all views, RMSE / median, deg",
            *_pairs(models, ("consistency", "phase_residual"), "rmse_deg", "median_deg"),
        ],
        [
            "phase residual of the seeds, median, deg",
            *_each(models, ("track_residual_median_deg",), 1, 2),
        ],
    ]
    if all("truth" in model for model in models.values()):
        rows += _truth_rows(models, metrics.get("phase") or {})
    return format_table(["", *[name.upper() for name in models]], rows)


def _each(models: Mapping[str, Any], keys: Sequence[str], factor: float, digits: int) -> list[str]:
    return [number(dig(m["consistency"], *keys), factor, digits) for m in models.values()]


def _pairs(models: Mapping[str, Any], keys: Sequence[str], first: str, second: str) -> list[str]:
    return [_pair(dig(model, *keys), first, second) for model in models.values()]


def _pair(stats: Any, first: str, second: str) -> str:
    return f"{number(dig(stats, first))} / {number(dig(stats, second))}"


def _truth_rows(models: Mapping[str, Any], phase: Mapping[str, Any]) -> list[list[str]]:
    """Rows of the measures against the truth."""
    rows = [
        *[
            [
                f"phase error on the part, {what}, RMSE / median, deg",
                *[_pair(dig(phase, source, name), "rmse_deg", "median_deg") for name in models],
            ]
            for source, what in (("maps", "smoothed"), ("pixels", "single pixels"))
        ],
        [
            "error of the sparse normals, mean / median, deg",
            *_pairs(models, ("truth", "tracks", "errors"), "mean_deg", "median_deg"),
        ],
    ]
    rows += _map_rows(models)
    columns = [cloud_rows(model["truth"]["cloud"]) for model in models.values()]
    for cells in zip(*columns, strict=True):
        rows.append([cells[0][0], *[cell[1] for cell in cells]])
    return rows


def _map_rows(models: Mapping[str, Any]) -> list[list[str]]:
    """Rows of the dense depth and normal maps."""
    maps = [dig(model, "truth", "maps") for model in models.values()]
    return [
        ["depth maps, RMSE, mm", *[number(dig(m, "depth_rmse_m"), 1e3) for m in maps]],
        ["depth maps within 1 mm, %", *[number(dig(m, "depth_within_1mm"), 100, 1) for m in maps]],
        [
            "normal maps, mean / median error, deg",
            *[_pair(dig(m, "normals"), "mean_deg", "median_deg") for m in maps],
        ],
    ]


def cloud_rows(cloud: Mapping[str, Any]) -> list[list[str]]:
    """Name and figure of every measure of a cloud against the truth."""
    rows = []
    for key, name in (
        ("f_score", "F-score"),
        ("accuracy", "accuracy"),
        ("completeness", "completeness"),
    ):
        for threshold, share in zip(cloud["thresholds_m"], cloud[key], strict=True):
            rows.append([f"{name} at {1e3 * threshold:g} mm, %", number(share, 100, 1)])
    rows.append(["Chamfer distance, mm", number(cloud["chamfer_m"], 1e3, 2)])
    rows.append(["normal error, mean / median, deg", _pair(cloud, *NORMAL_KEYS)])
    rows.append(["points off every surface, %", number(cloud["off_surface_share"], 100, 1)])
    return rows


NORMAL_KEYS = ("normal_mean_deg", "normal_median_deg")


def evaluation_text(figures: Mapping[str, Any]) -> str:
    """Table of one cloud against the truth, and how it was aligned."""
    alignment = figures["alignment"]
    return (
        format_table(["", "value"], cloud_rows(figures["cloud"]))
        + f"\n{figures['cloud']['num_points']:,} points, {figures['cloud']['num_on_part']:,} on "
        f"the part. Aligned by {alignment['num_cameras']} cameras, "
        f"{alignment['rms_residual_mm']:.2f} mm RMS."
    )


def stage_table(runs: Mapping[str, Mapping[str, Any]]) -> str:
    """Seconds and memory of the stages of one or more ``run.json``, one column pair each."""
    names = list(dict.fromkeys(s["name"] for run in runs.values() for s in run["stages"]))
    header = ["stage"]
    for run in runs:
        header += [f"{run}, s", "peak MB"]
    rows = [[name, *_stage_cells(name, runs)] for name in names]
    total, rest, wall = ["all stages"], ["all but SfM"], ["wall clock"]
    for content in runs.values():
        seconds = {s["name"]: s["seconds"] for s in content["stages"]}
        peak = max((s["peak_rss_mb"] for s in content["stages"]), default=None)
        total += [number(sum(seconds.values())), number(peak, 1, 0)]
        rest += [number(sum(t for name, t in seconds.items() if name != "sfm")), ""]
        wall += [number(content.get("wall_s")), ""]
    return format_table(header, [*rows, total, rest, wall])


def _stage_cells(name: str, runs: Mapping[str, Mapping[str, Any]]) -> list[str]:
    cells = []
    for run in runs.values():
        stage = next((s for s in run["stages"] if s["name"] == name), None)
        cells += [number(dig(stage, "seconds")), number(dig(stage, "peak_rss_mb"), 1, 0)]
    return cells


def dig(content: Any, *keys: str) -> Any:
    """Value at a path of keys; None where a step is missing."""
    for key in keys:
        if not isinstance(content, Mapping):
            return None
        content = content.get(key)
    return content


def number(value: Any, factor: float = 1.0, digits: int = 2) -> str:
    """A number with fixed digits, a dash for none."""
    return NONE if value is None else f"{factor * value:.{digits}f}"
