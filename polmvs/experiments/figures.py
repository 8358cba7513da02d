"""Figures of the experiments as PNG, with matplotlib."""

from __future__ import annotations

import io
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from matplotlib.colors import PowerNorm
from matplotlib.figure import Figure
from matplotlib.ticker import LogFormatter

from polmvs.arrays import Array
from polmvs.experiments.contours import CONTOUR_LABELS, METHODS, ViewContours
from polmvs.experiments.data import MODEL_LABELS
from polmvs.experiments.phase import ANGLE_LIMITS_DEG, ANGLES, PhaseImages, PhaseResult
from polmvs.experiments.plane import ESTIMATES, PLANE_LABELS, PlaneResult
from polmvs.experiments.tracks import ESTIMATORS, TRACK_LABELS, TrackResult
from polmvs.polarization.kinds import FORMULAS

# Okabe and Ito's palette, distinguishable with any kind of colour blindness.
VERMILLION, ORANGE, SKY, BLUE, GREEN, GREY = (
    "#D55E00", "#E69F00", "#56B4E9", "#0072B2", "#009E73", "#666666",
)  # fmt: skip
PLANE_STYLES = {  # marker and colour
    "algebraic": ("o", SKY),
    "weighted_noise": ("x", GREY),
    "weighted": ("s", BLUE),
    "tilted_algebraic": ("v", ORANGE),
    "tilted": ("D", GREEN),
}
TRACK_STYLES = {  # line and colour
    "opa": ("-", VERMILLION),
    "opa_weighted": ("--", ORANGE),
    "ppa_algebraic": ("--", SKY),
    "ppa_weighted": ("-", BLUE),
    "tilted_weighted": ("-", GREEN),
}
CONTOUR_COLORS = {
    "opa": VERMILLION,
    "ppa_normals": SKY,
    "ppa_tangent": BLUE,
    "tilted_tangent": GREEN,
}

DPI = 150
CYCLIC = "twilight"  # perceptually uniform, cyclic, safe for colour blindness
MAX_BOXES = 8  # numbers of views in the box plot; more become unreadable
ANGLE_NAMES = {
    "viewing": "viewing angle",
    "azimuth": "azimuth difference of ray and normal",
    "zenith": "zenith angle of the normal",
}


def draw_phase_density(result: PhaseResult) -> bytes:
    """The paper's figure of phase errors against three angles, one row for each model."""
    figure = _figure(10.0, 8.0)
    axes = figure.subplots(3, 3, sharey=True, sharex="col")
    norm = PowerNorm(0.4, vmin=0, vmax=0.5)
    image = None
    for row, angle_model in enumerate(FORMULAS):
        for column, angle in enumerate(ANGLES):
            ax = axes[row, column]
            image = ax.imshow(
                result.densities[angle_model][column].T,
                origin="lower",
                extent=(0, ANGLE_LIMITS_DEG[angle], -90, 90),
                aspect="auto",
                norm=norm,
                cmap="viridis",
                interpolation="nearest",
            )
            ax.set_facecolor("#dddddd")
            ax.set_yticks((-90, -45, 0, 45, 90))
            if row == 2:
                ax.set_xlabel(f"{ANGLE_NAMES[angle]} (°)")
        rmse = result.all_pixels[angle_model].rmse_deg
        axes[row, 0].set_ylabel(f"{MODEL_LABELS[angle_model]}, RMSE {rmse:.1f}°\nphase error (°)")
    if image is not None:
        bar = figure.colorbar(image, ax=axes, shrink=0.7, extend="max", pad=0.02)
        bar.set_label("density of each column (1/°); grey: too few pixels")
    return _png(figure)


def draw_phase_maps(views: Sequence[PhaseImages]) -> bytes:
    """The paper's figure of measured and predicted phases, in cyclic colours with their wheel."""
    titles = [
        "intensity",
        "measured phase",
        *(f"{MODEL_LABELS[m]} phase" for m in FORMULAS),
    ]
    height, width = views[0].intensity.shape
    panel = 2.3
    figure = _figure(5 * panel + 1.2, len(views) * panel * height / width + 0.5)
    axes = figure.subplots(len(views), 5, squeeze=False)
    for row, view in zip(axes, views, strict=True):
        white = float(np.percentile(view.intensity, 99.5))
        shown = np.clip(view.intensity / max(white, 1e-9), 0, 1) ** (1 / 2.2)
        row[0].imshow(shown, cmap="gray", vmin=0, vmax=1)
        row[0].set_ylabel(view.name)
        for ax, phase in zip(row[1:], (view.measured, *view.predicted.values()), strict=True):
            ax.set_facecolor("#bbbbbb")
            ax.imshow(phase, cmap=CYCLIC, vmin=0, vmax=np.pi, interpolation="nearest")
        for ax in row:
            ax.set_xticks([])
            ax.set_yticks([])
    for ax, title in zip(axes[0], titles, strict=True):
        ax.set_title(title, fontsize=10)
    _add_wheel(figure)
    return _png(figure)


def _add_wheel(figure: Figure) -> None:
    """Colour of each phase, at its direction in the image."""
    figure.get_layout_engine().set(rect=(0, 0, 0.9, 1))  # type: ignore[union-attr, call-arg]
    ax: Any = figure.add_axes((0.912, 0.35, 0.065, 0.3), projection="polar")
    ax.set_in_layout(False)
    angle = np.linspace(0, 2 * np.pi, 361)
    radius = np.array([0.55, 1.0])
    colors = np.mod(0.5 * (angle[1:] + angle[:-1]), np.pi)[None]
    ax.pcolormesh(angle, radius, colors, cmap=CYCLIC, vmin=0, vmax=np.pi, shading="flat")
    ax.set_yticks([])
    ax.set_xticks(np.radians([0, 45, 90, 135]), ["0°", "45°", "90°", "135°"], fontsize=8)
    ax.tick_params(pad=-1)
    ax.grid(False)
    ax.set_title("phase", fontsize=9, pad=8)


def draw_plane(result: PlaneResult) -> bytes:
    """Angular error of each image, and the residual of the twin normal."""
    figure = _figure(9.5, 3.8)
    left, right = figure.subplots(1, 2, width_ratios=(2.4, 1))
    for name in ESTIMATES:
        errors = [image.error_deg[name] for image in result.per_image]
        marker, color = PLANE_STYLES[name]
        left.plot(
            np.arange(len(errors)),
            errors,
            marker,
            color=color,
            label=f"{PLANE_LABELS[name]}: mean {result.stats[name].mean_deg:.2f}°",
            markersize=5,
        )
    left.set_yscale("log")
    left.yaxis.set_major_formatter("{x:g}")
    left.yaxis.set_minor_formatter(LogFormatter(labelOnlyBase=False, minor_thresholds=(1, 0.5)))
    left.set_xlabel("image, in the order of plane.json")
    left.set_ylabel("angular error of the normal (°)")
    left.grid(True, which="both", alpha=0.25)
    left.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    places = np.arange(len(FORMULAS))
    for offset, values, label, color in (
        (-0.2, [a.rmse_deg for a in result.ambiguity.values()], "true normal", BLUE),
        (0.2, [a.rmse_turned_deg for a in result.ambiguity.values()], "turned by π", ORANGE),
    ):
        bars = right.bar(places + offset, values, 0.4, label=label, color=color)
        right.bar_label(bars, fmt="%.1f", fontsize=8)
    right.set_xticks(places, [MODEL_LABELS[m] for m in result.ambiguity])
    right.set_ylabel("phase residual, RMS (°)")
    right.margins(y=0.15)
    right.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2)
    return _png(figure)


def draw_track_distribution(result: TrackResult) -> bytes:
    """Histogram and cumulative distribution of the errors with three views, as in the paper."""
    index = int(np.argmin(np.abs(np.array(result.k) - 3)))
    figure = _figure(9.5, 3.6)
    left, right = figure.subplots(1, 2)
    bins = np.linspace(0, 40, 81)
    for name in ESTIMATORS:
        errors = result.estimators[name].errors_deg[index]
        line, color = TRACK_STYLES[name]
        counts = np.histogram(errors[np.isfinite(errors)], bins)[0]
        share = 100 * counts / max(len(errors), 1)
        left.stairs(share, bins, label=TRACK_LABELS[name], lw=1.5, color=color, ls=line)
        ordered = np.sort(errors[np.isfinite(errors)])
        rank = 100 * np.arange(1, len(ordered) + 1) / max(len(errors), 1)
        right.plot(ordered, rank, label=TRACK_LABELS[name], lw=1.8, color=color, ls=line)
    left.set_yscale("log")
    left.yaxis.set_major_formatter("{x:g}")
    right.set_xscale("log")
    right.xaxis.set_major_formatter("{x:g}")
    left.set_ylabel("share of points per 0.5° (%)")
    right.set_xlim(0.05, 90)
    right.set_ylim(0, 100)
    right.axvline(25, color=GREY, linewidth=0.8)
    right.text(26, 4, "25°", color=GREY, fontsize=8)
    right.set_ylabel("share of points with a smaller error (%)")
    for ax in (left, right):
        ax.set_xlabel(f"angular error with {result.k[index]} views (°)")
        ax.grid(True, alpha=0.25)
    left.set_xlim(0, 40)
    figure.legend(
        *right.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=5
    )
    return _png(figure)


def draw_track_means(result: TrackResult) -> bytes:
    """Mean and median error against the number of views."""
    figure = _figure(9.5, 3.6)
    axes = figure.subplots(1, 2, sharey=True)
    statistics: dict[str, Callable[[Array], np.floating]] = {"mean": np.mean, "median": np.median}
    for ax, (label, statistic) in zip(axes, statistics.items(), strict=True):
        for name in ESTIMATORS:
            line, color = TRACK_STYLES[name]
            errors = result.estimators[name].over(statistic)
            ax.plot(result.k, errors, marker=".", color=color, ls=line, label=TRACK_LABELS[name])
        ax.set_yscale("log")
        ax.set_xlabel("number of views K")
        ax.set_ylabel(f"{label} angular error (°)")
        ax.yaxis.set_tick_params(labelleft=True)
        ax.grid(True, which="both", alpha=0.25)
        ax.yaxis.set_major_formatter("{x:g}")
    figure.legend(*ax.get_legend_handles_labels(), fontsize=8, loc="outside lower center", ncols=5)
    return _png(figure)


def draw_track_boxes(result: TrackResult) -> bytes:
    """Box plots of the errors against the number of views."""
    figure = _figure(9.5, 4.0)
    ax = figure.subplots()
    chosen = np.unique(np.linspace(0, len(result.k) - 1, MAX_BOXES).round().astype(int))
    width = 0.8 / len(ESTIMATORS)
    for column, name in enumerate(ESTIMATORS):
        errors = [result.estimators[name].errors_deg[i] for i in chosen]
        finite = [e[np.isfinite(e)] for e in errors]
        boxes = ax.boxplot(
            finite,
            positions=np.arange(len(chosen)) + (column - (len(ESTIMATORS) - 1) / 2) * width,
            widths=0.85 * width,
            whis=(5, 95),
            showfliers=False,
            patch_artist=True,
            medianprops={"color": "black"},
            manage_ticks=False,
        )
        for box in boxes["boxes"]:
            box.set_facecolor(TRACK_STYLES[name][1])
        boxes["boxes"][0].set_label(TRACK_LABELS[name])
    ax.set_yscale("log")
    ax.yaxis.set_major_formatter("{x:g}")
    ax.set_xticks(np.arange(len(chosen)), [str(result.k[i]) for i in chosen])
    ax.set_xlabel("number of views K")
    ax.set_ylabel("angular error (°)")
    ax.grid(True, axis="y", which="both", alpha=0.25)
    ax.legend(
        fontsize=8,
        ncols=3,
        loc="upper center",
        bbox_to_anchor=(0.5, -0.13),
        title="box: quartiles and median; whiskers: 5th and 95th percentile",
        title_fontsize=8,
    )
    return _png(figure)


def draw_contours(view: ViewContours) -> bytes:
    """Contours of one view in profile: height above the surface against the horizontal position.

    The upper row has the same scale for all methods, the lower one that of the PPA tangents.
    """
    figure = _figure(12.0, 5.4)
    axes = figure.subplots(2, len(METHODS), sharex=True, sharey="row")
    everything = np.concatenate([line.points for line in view.lines.values()])
    axis = _main_direction(everything)
    middle = np.median(everything @ axis) if len(everything) else 0.0
    near = np.concatenate([view.lines[m].heights for m in METHODS[1:]])
    limit = 1.1e3 * float(np.abs(near).max()) if len(near) else 1.0
    for column, method in enumerate(METHODS):
        line = view.lines[method]
        for ax in axes[:, column]:
            ax.axhline(0, color="black", linewidth=1.6, label="true surface")
            for curve in np.unique(line.curve):
                own = line.curve == curve
                ax.plot(
                    1e3 * (line.points[own] @ axis - middle),
                    1e3 * line.heights[own],
                    color=CONTOUR_COLORS[method],
                    linewidth=0.9,
                )
        axes[0, column].set_title(
            f"{CONTOUR_LABELS[method]}\nRMSE {line.rmse_mm:.2f} mm", fontsize=9
        )
        axes[1, column].set_xlabel("place along the surface (mm)")
        axes[1, column].set_ylim(-limit, limit)
    axes[0, 0].set_ylabel("height over the true surface (mm)")
    axes[1, 0].set_ylabel("the same, enlarged (mm)")
    axes[0, 0].legend(fontsize=8, loc="lower left")
    figure.suptitle(f"Contours of {view.name}, seen along the surface", fontsize=10)
    return _png(figure)


def _main_direction(points: Array) -> Array:
    """Unit vector (3,) along which points (N, 3) spread the most; x for fewer than two."""
    if len(points) < 2:
        return np.array([1.0, 0.0, 0.0])
    return np.asarray(np.linalg.eigh(np.cov(points.T))[1][:, -1], np.float64)


def _figure(width: float, height: float) -> Figure:
    return Figure(figsize=(width, height), layout="constrained", dpi=DPI)


def _png(figure: Figure) -> bytes:
    buffer = io.BytesIO()
    # Without the version of matplotlib the file depends on its content only.
    figure.savefig(buffer, format="png", metadata={"Software": None})
    return buffer.getvalue()
