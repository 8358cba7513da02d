"""Masks that end where the polarized surface does, and masks that end within it."""

import numpy as np
import pytest

from polmvs.polarization.mask_check import MAX_CUT_SHARE, cut_share
from polmvs.polarization.stokes import Stokes

ROWS, COLS = np.indices((96, 128))
PART = (abs(COLS - 64) < 40) & (abs(ROWS - 48) < 30)


def stokes_of(polarized: np.ndarray, valid: np.ndarray | None = None) -> Stokes:
    s0 = np.full(polarized.shape, 0.4, np.float32)
    return Stokes(
        s0=s0,
        s1=np.where(polarized, 0.2, 0.004).astype(np.float32) * s0,
        s2=np.zeros_like(s0),
        sigma=np.full_like(s0, 1e-3),
        valid=np.ones(s0.shape, bool) if valid is None else valid,
    )


def test_a_whole_mask_cuts_nothing():
    assert cut_share(stokes_of(PART), PART, min_dolp=0.1) == 0


def test_a_mask_of_the_top_alone_cuts_the_side():
    """A side of 10 px under one of the four edges: 80 of 280 px of the outline."""
    top = PART & (ROWS < 68)
    found = cut_share(stokes_of(PART), top, min_dolp=0.1)
    assert found == pytest.approx(80 / 260, abs=0.06)
    assert found > MAX_CUT_SHARE


def test_what_is_saturated_is_no_surface():
    top = PART & (ROWS < 68)
    assert cut_share(stokes_of(PART, valid=ROWS < 68), top, min_dolp=0.1) == 0


@pytest.mark.parametrize("mask", [np.zeros_like(PART), np.ones_like(PART)])
def test_masks_without_an_outline_tell_nothing(mask):
    assert np.isnan(cut_share(stokes_of(PART), mask, min_dolp=0.1))
