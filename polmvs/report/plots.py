"""Plots of a report as SVG text with the colours of the page."""

from __future__ import annotations

import io
import re
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from polmvs.arrays import Floats
from polmvs.polarization.kinds import AngleModel

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


# Okabe and Ito's colours, with a dash each, so that colour is never the only sign.
STYLES = {
    AngleModel.TEXTBOOK_OPA: ("#d55e00", (4, 2)),
    AngleModel.TEXTBOOK_PPA: ("#56b4e9", (6, 1.5)),
    AngleModel.OPA: ("#e69f00", (4, 2, 1, 2)),
    AngleModel.PPA: ("#0072b2", (1, 0)),
    AngleModel.TILTED: ("#009e73", (1, 1.5)),
}
COLORS = {model: color for model, (color, _) in STYLES.items()}
INK = "#123456"  # replaced by the page's text colour
MIN_IN_BIN = 30  # values for a median; its quartiles are then exact to about a tenth


def error_curves(errors: Mapping[AngleModel, Floats], unit: str, title: str) -> str:
    """Histograms and cumulative shares of errors of several models, side by side."""
    figure, (left, right) = _figure(2)
    high = max((float(np.percentile(e, 95)) for e in errors.values() if len(e)), default=1.0)
    edges = np.linspace(0, max(high, 1e-9), 61)
    for model, values in errors.items():
        if not len(values):
            continue
        share = np.histogram(values, edges)[0] / len(values)
        left.stairs(100 * share, edges, **_style(model))
        ordered = np.sort(values)
        along = np.linspace(0, len(ordered) - 1, 400).astype(np.intp)
        right.plot(ordered[along], 100 * (along + 1) / len(ordered), **_style(model))
    right.set_xscale("log")
    left.set(xlabel=f"{title}, {unit}", ylabel="points in each bin, %")
    right.set(xlabel=f"{title}, {unit} (log)", ylabel="points below, %", ylim=(0, 100))
    _add_legend(right)
    return _svg(figure, f"Histogram and cumulative curve of the {title}")


def error_against(
    errors: Mapping[AngleModel, Floats],
    causes: Mapping[AngleModel, Floats],
    edges: Floats,
    names: tuple[str, str],
) -> str:
    """Median error, and its quartiles, against a possible cause.

    Parameters
    ----------
    errors, causes : (N,) for each model.
    edges : bins of the cause.
    names : of the cause and of the error, with units.
    """
    figure, (axes,) = _figure(1)
    middle = 0.5 * (edges[1:] + edges[:-1])
    for model, values in errors.items():
        place = np.digitize(causes[model], edges) - 1
        found = np.full((len(middle), 3), np.nan)
        for i in range(len(middle)):
            here = values[place == i]
            if len(here) >= MIN_IN_BIN:
                found[i] = np.percentile(here, (25, 50, 75))
        axes.plot(middle, found[:, 1], marker=".", **_style(model))
        axes.fill_between(middle, found[:, 0], found[:, 2], color=COLORS[model], alpha=0.15, lw=0)
    axes.set(xlabel=names[0], ylabel=names[1])
    axes.set_ylim(bottom=0)
    _add_legend(axes)
    return _svg(figure, f"{names[1]} against {names[0]}")


def time_bars(stages: Sequence[tuple[str, float]]) -> str:
    """Seconds of each stage, in their order."""
    figure, (axes,) = _figure(1, height=0.6 + 0.24 * len(stages))
    place = np.arange(len(stages))
    seconds = [value for _, value in stages]
    axes.barh(place, seconds, color=COLORS[AngleModel.PPA])
    axes.set_yticks(place, [name for name, _ in stages])
    axes.invert_yaxis()
    for i, value in enumerate(seconds):
        axes.annotate(f" {value:.1f}", (value, i), va="center", color=INK, fontsize=8)
    axes.set(xlabel="seconds")
    axes.margins(x=0.12)
    return _svg(figure, "Seconds of each stage")


def deviation_histogram(distance_mm: Floats, tolerance_mm: float | None, limit_mm: float) -> str:
    """Histogram of signed distances from a reference, with the tolerance if there is one."""
    figure, (axes,) = _figure(1)
    edges = np.linspace(-2 * limit_mm, 2 * limit_mm, 81)
    inside = np.clip(distance_mm, edges[0], edges[-1])  # values beyond are in the last bins
    share = 100 * np.histogram(inside, edges)[0] / max(len(distance_mm), 1)
    axes.stairs(share, edges, fill=True, color=COLORS[AngleModel.PPA], alpha=0.6)
    if tolerance_mm is not None:
        for side in (-tolerance_mm, tolerance_mm):
            axes.axvline(side, color=COLORS[AngleModel.TEXTBOOK_OPA], lw=1.2, ls=(0, (4, 2)))
    axes.set(xlabel="distance from the reference, mm (outside positive)", ylabel="points, %")
    return _svg(figure, "Histogram of the distances from the reference").replace(
        "currentColor", "#555555"
    )


def _figure(num: int, height: float = 2.9) -> tuple[Figure, list[Axes]]:
    from matplotlib.figure import Figure

    figure = Figure(figsize=(4.6 * num, height), layout="constrained")
    axes = [figure.add_subplot(1, num, i + 1) for i in range(num)]
    figure.patch.set_alpha(0)
    for one in axes:
        one.patch.set_alpha(0)
        one.tick_params(colors=INK, labelsize=8)
        for side, spine in one.spines.items():
            spine.set_visible(side in ("left", "bottom"))
            spine.set_color(INK)
        one.xaxis.label.set_color(INK)
        one.yaxis.label.set_color(INK)
        one.grid(alpha=0.25, lw=0.5, color=INK)
        one.set_axisbelow(True)
    return figure, axes


def _add_legend(axes: Axes) -> None:
    """A legend, where anything is drawn that has a name."""
    if axes.get_legend_handles_labels()[0]:
        axes.legend(frameon=False, labelcolor=INK)


def _style(model: AngleModel) -> dict[str, Any]:
    color, dashes = STYLES[model]
    return {"color": color, "linestyle": (0, dashes), "label": model.label, "linewidth": 1.6}


def _svg(figure: Figure, title: str) -> str:
    """SVG with text as text, a title for screen readers, and the page's ink."""
    import matplotlib

    buffer = io.StringIO()
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": title}):
        figure.savefig(buffer, format="svg", metadata={"Date": None})
    text = buffer.getvalue()
    text = text[text.index("<svg") :].replace(INK, "currentColor")
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.S)
    # Ids must be of this plot alone among the page's.
    own = re.sub(r"\W+", "-", title.lower())
    text = re.sub(r'id="', f'id="{own}-', text)
    text = re.sub(r"url\(#", f"url(#{own}-", text)
    text = re.sub(r'href="#', f'href="#{own}-', text)
    return text.replace("<svg", f'<svg role="img" aria-label="{title}"', 1)
