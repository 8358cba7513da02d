"""Plots: sound SVG in the page's colours, with text that can be read and found."""

import xml.etree.ElementTree as ET

import numpy as np
import pytest

from polmvs.polarization.kinds import AngleModel
from polmvs.report import plots

RNG = np.random.default_rng(0)
ERRORS = {AngleModel.OPA: RNG.exponential(3, 2000), AngleModel.PPA: RNG.exponential(0.3, 2000)}
CAUSES = {model: RNG.uniform(0, 80, 2000) for model in ERRORS}


def all_plots() -> list[str]:
    edges = np.arange(0, 85, 5.0)
    return [
        plots.error_curves(ERRORS, "mm", "depth error"),
        plots.error_against(ERRORS, CAUSES, edges, ("viewing angle, deg", "depth error, mm")),
        plots.time_bars([("sfm", 8.0), ("maps", 2.5)]),
    ]


@pytest.mark.parametrize("number", range(3))
def test_sound_svg_with_a_name_for_screen_readers(number: int) -> None:
    text = all_plots()[number]
    root = ET.fromstring(text)
    assert root.get("role") == "img"
    assert root.get("aria-label")
    assert plots.INK not in text
    assert "currentColor" in text


def test_no_two_plots_share_an_id() -> None:
    found = [
        element.get("id") for text in all_plots() for element in ET.fromstring(text).iter()
        if element.get("id")
    ]  # fmt: skip
    assert len(found) == len(set(found))


def test_references_inside_a_plot_hit() -> None:
    for text in all_plots():
        root = ET.fromstring(text)
        ids = {element.get("id") for element in root.iter()}
        for element in root.iter():
            for name, value in element.attrib.items():
                if name.endswith("href"):
                    assert value.removeprefix("#") in ids
                elif value.startswith("url(#"):
                    assert value[5:-1] in ids


def test_labels_are_text() -> None:
    text = plots.error_curves(ERRORS, "mm", "depth error")
    assert "depth error, mm" in text
    assert ">polmvs OPA<" in text


@pytest.mark.parametrize("num", [0, 3])
def test_few_values_are_no_fault(num: int) -> None:
    few = {AngleModel.PPA: np.full(num, 0.1)}
    plots.error_curves(few, "mm", "error")
    plots.error_against(few, few, np.arange(0, 5, 1.0), ("a", "b"))
    plots.time_bars([])


def test_a_median_needs_enough_values() -> None:
    few = {AngleModel.PPA: np.full(plots.MIN_IN_BIN - 1, 2.0)}
    enough = {AngleModel.PPA: np.full(plots.MIN_IN_BIN, 2.0)}
    edges = np.array([0.0, 5.0])

    def marks(errors) -> int:
        text = plots.error_against(errors, errors, edges, ("a", "b"))
        return text.count("<use")

    assert marks(enough) > marks(few)
