"""Splitting of mosaics: exact ramps, the redundancy of real captures, clipping, gamma."""

from itertools import permutations
from pathlib import Path

import numpy as np
import pytest

from polmvs.io.raw_formats import read_raw
from polmvs.polarization.mosaic import (
    ANGLES_DEG,
    INTERPOLATION_NOISE_GAIN,
    clipped_cells,
    linearize,
    split_mosaic,
)

SHARED = Path(__file__).parents[3] / "shared" / "data"
PATTERN = (90, 45, 135, 0)


def ramps_and_mosaic(pattern, height=12, width=16):
    """Four different linear ramps at the cells' centres, and the raw mosaic that samples them."""
    slopes = {0: (0.5, 0.1), 45: (-0.2, 0.3), 90: (0.05, -0.4), 135: (0.7, 0.6)}
    y, x = np.mgrid[0:height, 0:width] + 0.5  # raw px, corner origin
    center_y, center_x = np.mgrid[0 : height // 2, 0 : width // 2] * 2.0 + 1.0
    raw = np.empty((height, width))
    centers = np.empty((4, height // 2, width // 2))
    for cell, angle in enumerate(pattern):
        row, col = divmod(cell, 2)
        a, b = slopes[angle]
        raw[row::2, col::2] = (20 + angle + a * x + b * y)[row::2, col::2]
        centers[ANGLES_DEG.index(angle)] = 20 + angle + a * center_x + b * center_y
    return raw, centers


@pytest.mark.parametrize("pattern", list(permutations((0, 45, 90, 135))))
def test_linear_ramps_are_exact_at_the_cell_centres(pattern):
    raw, centers = ramps_and_mosaic(pattern)
    images = split_mosaic(raw, pattern)
    assert images.shape == (4, 6, 8)
    assert images.dtype == np.float32
    np.testing.assert_allclose(images[:, 1:-1, 1:-1], centers[:, 1:-1, 1:-1], rtol=1e-6)


def test_border_replicates_its_own_samples():
    raw, _ = ramps_and_mosaic(PATTERN)
    images = split_mosaic(raw, PATTERN)
    # Angle 0 sits at the lower right of its cell: cell (0, 0) has no neighbour up or left.
    assert images[0, 0, 0] == pytest.approx(raw[1, 1], rel=1e-6)
    # Angle 90 sits at the upper left: the last cell has no neighbour down or right.
    assert images[2, -1, -1] == pytest.approx(raw[-2, -2], rel=1e-6)


def test_one_cell_is_enough():
    images = split_mosaic(np.array([[9, 4], [13, 1]], np.uint8), PATTERN)
    np.testing.assert_array_equal(images[:, 0, 0], [1, 4, 9, 13])


def test_noise_gain_is_that_of_the_interpolation():
    raw = np.random.default_rng(0).normal(size=(400, 400))
    images = split_mosaic(raw, PATTERN)[:, 1:-1, 1:-1]
    np.testing.assert_allclose(images.var(axis=(1, 2)), INTERPOLATION_NOISE_GAIN, rtol=0.03)


@pytest.mark.parametrize("shape", [(3, 4), (4, 3), (0, 0), (4, 4, 3)])
def test_wrong_shape_is_a_callers_error(shape):
    with pytest.raises(ValueError, match="both even"):
        split_mosaic(np.zeros(shape), PATTERN)
    with pytest.raises(ValueError, match="both even"):
        clipped_cells(np.zeros(shape), 1.0)


def test_wrong_pattern_is_a_callers_error():
    with pytest.raises(ValueError, match="each of"):
        split_mosaic(np.zeros((4, 4)), (0, 0, 90, 135))


@pytest.mark.parametrize(("row", "col"), [(4, 4), (4, 5), (5, 4), (5, 5)])
def test_a_clipped_sample_marks_exactly_the_pixels_that_it_changes(row, col):
    raw = np.zeros((10, 12), np.uint8)
    raw[row, col] = 255
    changed = split_mosaic(raw, PATTERN).any(axis=0)
    assert changed.sum() == 4
    np.testing.assert_array_equal(clipped_cells(raw, 250), changed)
    assert not clipped_cells(raw, 255.5).any()


def test_linearize():
    raw = np.array([[0, 51, 255]], np.uint8)
    np.testing.assert_allclose(linearize(raw), [[0, 0.2, 1]], atol=1e-7)
    np.testing.assert_allclose(linearize(raw, gamma=0.5), [[0, 0.04, 1]], atol=1e-7)
    deep = np.array([[0, 1024, 4095]], np.uint16)
    np.testing.assert_allclose(
        linearize(deep, gamma=2.0, full_scale=4095), [[0, np.sqrt(1024 / 4095), 1]], atol=1e-7
    )
    assert linearize(deep).dtype == np.float32
    assert linearize(deep).max() == pytest.approx(4095 / 65535)


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"{SHARED} is absent")
def test_interpolation_meets_the_redundancy_better_than_slicing():
    raw = linearize(read_raw(SHARED / "board" / "raw" / "003.png").samples)
    cells = raw.reshape(512, 2, 612, 2).transpose(1, 3, 0, 2).reshape(4, 512, 612)
    sliced = cells[[3, 1, 0, 2]]
    even = {}
    for name, images in {"sliced": sliced, "interpolated": split_mosaic(raw, PATTERN)}.items():
        total = images.sum(axis=0) / 2
        lit = (total > 0.01) & (images.max(axis=0) < 0.98)
        difference = np.abs(images[0] + images[2] - images[1] - images[3])
        even[name] = np.mean(difference[lit] / total[lit])
    # Measured: 5.7 % and 3.4 %.
    assert even["interpolated"] < 0.04
    assert even["interpolated"] < 0.7 * even["sliced"]
