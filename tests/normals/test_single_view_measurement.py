"""Which pixels of a view count for its plane."""

import numpy as np
import pytest

from polmvs.config import PlaneOptions
from polmvs.errors import DataError
from polmvs.io.images import write_png
from polmvs.normals.single_view.measurement import MIN_PIXELS, select_pixels
from polmvs.polarization.stokes import Stokes

SHAPE = (20, 30)
OPTIONS = PlaneOptions(min_dolp=0.1, min_intensity=0.5)


def stokes_of(**changes: np.ndarray) -> Stokes:
    images = {
        "s0": np.ones(SHAPE, np.float32),
        "s1": np.full(SHAPE, 0.2, np.float32),
        "s2": np.zeros(SHAPE, np.float32),
        "sigma": np.full(SHAPE, 0.01, np.float32),
        "valid": np.ones(SHAPE, bool),
    }
    return Stokes(**(images | changes))


def test_all_pixels_count_unless_something_is_said() -> None:
    assert select_pixels(stokes_of(), OPTIONS, "a").all()


def test_pixels_of_weak_polarization_do_not_count() -> None:
    s1 = np.full(SHAPE, 0.2, np.float32)
    s1[:3] = 0.09
    mask = select_pixels(stokes_of(s1=s1), OPTIONS, "a")
    assert not mask[:3].any()
    assert mask[3:].all()


@pytest.mark.parametrize("scale", [0.1, 1.0])
def test_dark_pixels_are_told_by_the_median_of_those_that_count(scale: float) -> None:
    """Half of the median or less, whatever the exposure; unpolarized ones are not in the median."""
    s0 = np.full(SHAPE, scale, np.float32)
    s0[0], s0[1], s0[10:] = 0.4 * scale, 0.6 * scale, 50 * scale
    s1 = np.float32(0.2) * s0
    s1[10:] = 0
    mask = select_pixels(stokes_of(s0=s0, s1=s1), OPTIONS, "a")
    assert not mask[0].any()
    assert mask[1:10].all()
    assert not mask[10:].any()


def test_clipped_pixels_count_only_where_they_are_kept() -> None:
    valid = np.ones(SHAPE, bool)
    valid[:, :5] = False
    for dropped in (True, False):
        options = PlaneOptions(min_dolp=0.1, min_intensity=0.5, drop_clipped=dropped)
        found = select_pixels(stokes_of(valid=valid), options, "a")
        np.testing.assert_array_equal(found, valid | (not dropped))


def test_masks_polygons_and_given_pixels_bound_what_counts(tmp_path) -> None:
    inside = np.zeros(SHAPE, bool)
    inside[5:15, 10:20] = True
    write_png(tmp_path / "mask.png", inside.astype(np.uint8))
    masked = PlaneOptions(min_dolp=0.1, mask=tmp_path / "mask.png")
    drawn = PlaneOptions(min_dolp=0.1, polygon=((10, 5), (20, 5), (20, 15), (10, 15)))
    for found in (
        select_pixels(stokes_of(), masked, "a"),
        select_pixels(stokes_of(), drawn, "a"),
        select_pixels(stokes_of(), OPTIONS, "a", inside),
    ):
        np.testing.assert_array_equal(found, inside)
    # What is given goes before the options.
    np.testing.assert_array_equal(select_pixels(stokes_of(), masked, "a", ~inside), ~inside)
    with pytest.raises(ValueError, match="expected"):
        select_pixels(stokes_of(), OPTIONS, "a", inside[1:])


@pytest.mark.parametrize(
    ("num", "enough"), [(MIN_PIXELS, True), (MIN_PIXELS - 1, False), (0, False)]
)
def test_too_few_pixels_are_refused(num: int, enough: bool) -> None:
    inside = np.zeros(SHAPE, bool)
    inside.ravel()[:num] = True
    if enough:
        assert select_pixels(stokes_of(), OPTIONS, "a", inside).sum() == num
    else:
        with pytest.raises(DataError, match=f"only {num} pixels have a DoLP above 0.1"):
            select_pixels(stokes_of(), OPTIONS, "a", inside)
