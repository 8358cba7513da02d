"""Figures, warnings and pictures of captures of which everything is known."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from polmvs.config import CaptureOptions
from polmvs.polarization.capture import open_capture
from polmvs.polarization.inspection import (
    HEADER_PX,
    LINE_PX,
    MARGIN_PX,
    TILE_PX,
    Inspection,
    InspectionLimits,
    ViewFigures,
    _edge_width,
    _figures_of,
    _obstacles,
    _warnings,
    aolp_picture,
    contact_sheet,
    dolp_picture,
    inspect_capture,
    intensity_picture,
)
from polmvs.polarization.kinds import COMPARED_MODELS, AngleModel
from polmvs.polarization.stokes import Stokes

DARKNESS = 0.01
GOOD = ViewFigures(
    name="a.png",
    median_intensity=0.3,
    saturated=0.0,
    part=0.2,
    part_saturated=0.0,
    dark=0.0,
    polarized=0.2,
    median_dolp=0.3,
    sigma_aolp_deg=1.0,
    gain_sigma=0.0,
    edge_px=2.5,
)


def stokes_of(s0: np.ndarray, dolp: float = 0.0, aolp_deg: float = 0.0, **changes) -> Stokes:
    s0 = np.asarray(s0, np.float32)
    angle = np.radians(2 * aolp_deg)
    made = Stokes(
        s0=s0,
        s1=np.asarray(dolp * np.cos(angle) * s0, np.float32),
        s2=np.asarray(dolp * np.sin(angle) * s0, np.float32),
        sigma=np.full(s0.shape, 0.002, np.float32),
        valid=np.ones(s0.shape, bool),
    )
    return replace(made, **changes)


@pytest.fixture
def small(tmp_path: Path):
    """A capture of three even mosaics, which are a tenth, a fifth and two fifths of full scale."""
    for name, level in (("a", 6553), ("b", 13107), ("c", 26214)):
        cv2.imwrite(str(tmp_path / f"{name}.png"), np.full((48, 64), level, np.uint16))
    return open_capture(tmp_path, CaptureOptions(full_scale=65535))


def test_dark_and_clipped_pixels_are_told_apart() -> None:
    """Both are not valid: what is under twice the darkness in s0 is dark, what is above clipped."""
    s0 = np.full((20, 20), 1.0)
    s0[0] = 1.9 * DARKNESS
    s0[1:4] = 2.1 * DARKNESS
    valid = np.ones((20, 20), bool)
    valid[:4] = False
    figures = _figures_of("a", stokes_of(s0, 0.3, valid=valid), DARKNESS)
    assert figures.dark == pytest.approx(1 / 20)
    assert figures.saturated == pytest.approx(3 / 20)
    assert figures.polarized == pytest.approx(16 / 20)
    assert figures.median_intensity == pytest.approx(0.5)
    assert figures.median_dolp == pytest.approx(0.3, abs=1e-6)
    # sigma over twice the polarized intensity
    assert figures.sigma_aolp_deg == pytest.approx(np.degrees(0.002 / 0.6), rel=1e-3)


def test_where_nothing_is_polarized_nothing_is_said_of_angles() -> None:
    figures = _figures_of("a", stokes_of(np.ones((20, 20))), DARKNESS)
    assert (figures.polarized, figures.part) == (0, 0)
    assert np.isnan(figures.sigma_aolp_deg)
    assert np.isnan(figures.part_saturated)


@pytest.mark.parametrize("axis", [0, 1])
@pytest.mark.parametrize("width", [2.0, 4.0])
def test_width_of_an_edge_is_contrast_over_slope(axis: int, width: float) -> None:
    """A ramp of so many pixels from 0.2 to 0.6."""
    ramp = 0.2 + 0.4 * np.clip((np.arange(200) - 100) / width, 0, 1)
    image = np.repeat(ramp[None], 200, axis=0).astype(np.float32)
    image = image if axis else np.ascontiguousarray(image.T)
    # The slope of an edge two pixels wide, which Sobel's filter covers, is whole in its middle.
    assert _edge_width(image) == pytest.approx(width, rel=0.02)
    assert np.isnan(_edge_width(np.ones((50, 50), np.float32)))


def said(views: list[ViewFigures], capture, white: float = 0.5, colour: float = 0.0) -> str:
    return " | ".join(_warnings(capture, white, views, colour, InspectionLimits()))


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"part_saturated": 0.11}, "more than 10 % of the part is clipped in a.png"),
        ({"edge_px": 6.1}, "no sharp edge in a.png"),
        ({"median_intensity": 1.3}, "differ by a factor of 4.3"),
    ],
)
def test_each_limit_of_a_view(small, change: dict[str, float], words: str) -> None:
    others = [replace(GOOD, name=f"{k}.png") for k in range(9)]
    assert said([GOOD, *others], small) == ""
    assert words in said([replace(GOOD, **change), *others], small)
    (name, value) = next(iter(change.items()))
    below = replace(GOOD, **{name: 0.9 * value})
    assert said([below, *others], small) == ""


def test_each_limit_of_a_capture(small) -> None:
    ten = [GOOD] * 10
    assert said(ten, small, white=0.21) == said(ten, small, colour=0.059) == ""
    assert "at 19 % of full scale" in said(ten, small, white=0.19)
    assert "differ by 7 % in a 2x2 rhythm" in said(ten, small, colour=0.07)
    assert "9 views carry little" in said(ten[:9], small)
    assert "3 views carry little" in said(ten[:3], small)
    assert said(ten[:2], small) == ""  # which is an obstacle


def test_obstacles(small) -> None:
    def kept(*views: ViewFigures) -> str:
        return " | ".join(_obstacles(small, views, InspectionLimits()))

    assert kept(GOOD, GOOD, GOOD) == ""
    assert kept(GOOD, GOOD) == "it has 2 views: a surface takes three or more"
    assert kept(GOOD).startswith("it has 1 view:")
    few = replace(GOOD, polarized=0.009)
    assert kept(few, few, few).startswith("0.9 % of its pixels are polarized (DoLP 0.1)")
    assert kept(GOOD, few, few) == ""  # of the whole capture
    noisy = replace(GOOD, sigma_aolp_deg=15.5)
    assert "noise turns the angles by 16 deg" in kept(noisy, noisy, GOOD)
    assert kept(noisy, GOOD, GOOD) == ""
    assert kept(GOOD, GOOD, replace(GOOD, sigma_aolp_deg=np.nan)) == ""


@pytest.mark.parametrize(
    ("warnings", "obstacles", "verdict"),
    [
        ((), (), "This capture will do."),
        (("a",), (), "This capture will do, but the warning above should be looked at."),
        (("a", "b"), (), "This capture will do, but the 2 warnings above should be looked at."),
        (("a",), ("b", "c"), "This capture will not do, because b; and c."),
    ],
)
def test_the_verdict_is_one_sentence(small, warnings, obstacles, verdict: str) -> None:
    found = Inspection(capture=small, white=0.5, views=(), warnings=warnings, obstacles=obstacles)
    assert found.verdict == verdict


def test_figures_of_an_even_capture(small) -> None:
    found = inspect_capture(small)
    assert [view.name for view in found.views] == ["a.png", "b.png", "c.png"]
    levels = [view.median_intensity for view in found.views]
    np.testing.assert_allclose(levels, [0.1, 0.2, 0.4], atol=1e-4)
    assert {view.polarized for view in found.views} == {0.0}
    assert "because 0.0 % of its pixels are polarized" in found.verdict


def test_pictures_are_what_they_say() -> None:
    white = 2.0
    valid = np.array([[True, False, False]])
    shown = intensity_picture(stokes_of([[2.0, 1.0, 0.1]], valid=valid), white)
    assert shown[0, 0].tolist() == [255, 255, 255]
    assert shown[0, 1].tolist() == [40, 40, 255]  # clipped
    assert shown[0, 2, 0] == shown[0, 2, 2] < 100  # too dark to be of use
    gray = dolp_picture(stokes_of(np.ones((2, 2)), dolp=0.25))
    assert np.unique(gray).tolist() == [128]
    assert np.unique(dolp_picture(stokes_of(np.ones((2, 2)), dolp=0.7))).tolist() == [255]
    for angle, colour in ((0, [0, 0, 255]), (60, [0, 255, 0]), (120, [255, 0, 0])):
        picture = aolp_picture(stokes_of(np.ones((1, 1)), dolp=0.5, aolp_deg=angle))
        assert picture[0, 0].tolist() == colour


def test_a_sheet_has_two_columns_of_views_below_its_header(small) -> None:
    """Three views: the fourth place is empty."""
    sheet = contact_sheet(small)
    rows = (TILE_PX * small.height // small.width) + LINE_PX + MARGIN_PX
    assert sheet.shape[1:] == (6 * (TILE_PX + MARGIN_PX), 3)
    header = sheet.shape[0] - 2 * rows
    assert header >= HEADER_PX
    assert (sheet[:HEADER_PX].max(axis=(0, 1)) == 255).all()  # the wheel has all colours
    body = sheet[header:]
    middle = body.shape[1] // 2
    assert body[rows:, :middle].any()
    assert not body[rows:, middle:].any()


def test_names_of_models_in_tables() -> None:
    assert [model.label for model in COMPARED_MODELS] == [
        "textbook OPA",
        "textbook PPA",
        "polmvs OPA",
        "polmvs PPA",
        "polmvs tilted",
    ]
    assert AngleModel.TEXTBOOK_PPA.formula is AngleModel.PPA
