"""What neighbours share of the rounding of a sample: against the rounding itself."""

import numpy as np
import pytest
from scipy.special import ndtr

from polmvs.polarization.rounding import shared_rounding

STEP = 1 / 255


def mean_error(x: np.ndarray, deviation: float) -> np.ndarray:
    """Mean of what rounding adds to a value with normal noise, steps."""
    levels = np.arange(-20, 21)[:, None]
    below, above = (ndtr((levels + side - x) / deviation) for side in (-0.5, 0.5))
    return (levels * (above - below)).sum(axis=0) - x


def found(images: np.ndarray, noise: float, **options) -> float:
    """Squared steps in the middle, of samples with that variance in squared steps."""
    valid = np.ones(images.shape[1:], bool)
    shared = shared_rounding(
        images.astype(np.float32) * np.float32(STEP),
        valid,
        constant=noise * STEP**2,
        slope=options.pop("slope", 0.0) * STEP,
        quantum=STEP,
        **options,
    )
    assert shared is not None
    return shared[15, 15] / STEP**2


@pytest.mark.parametrize("deviation", [0.1, 0.15, 0.2, 0.3])
def test_a_flat_image_shares_what_the_mean_of_rounding_errs_by(deviation):
    x = np.linspace(0, 1, 2000, endpoint=False)
    expected = np.var(mean_error(x, deviation))
    flat = np.full((4, 31, 31), 3.0)
    assert found(flat, deviation**2) == pytest.approx(expected, rel=0.03)


def test_noise_that_grows_with_the_light_blurs():
    flat = np.full((4, 31, 31), 2.0)
    assert found(flat, 0.0, slope=0.02) == pytest.approx(found(flat, 0.04), rel=1e-4)
    assert found(flat, -0.02, slope=0.03) == pytest.approx(found(flat, 0.04), rel=1e-4)


@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("width", [1.0, 2.0])
def test_smoothing_over_several_steps_takes_it_away(turned, width):
    """Against the smoothing of a rounded ramp, whose shape in the steps is a saw's."""
    slope, deviation = 0.12 / width, 0.15
    place = np.arange(31) * slope
    ramp = np.tile(place, (4, 31, 1))
    if turned:
        ramp = np.swapaxes(ramp, 1, 2)
    along = np.linspace(-40, 40, 16001)
    window = np.exp(-0.5 * (np.arange(-8, 8.001, 0.005) / width) ** 2)
    smooth = np.convolve(mean_error(along * slope, deviation), window / window.sum(), "valid")
    period = round(1 / slope / 0.005)
    expected = np.var(smooth[: len(smooth) // period * period])
    options = {} if width == 1 else {"window_px": width}
    assert found(ramp, deviation**2, **options) == pytest.approx(expected, rel=0.1)


def test_images_count_alike_and_bright_ones_share_nothing():
    images = np.stack([np.full((31, 31), level) for level in (1.0, 100.0, 100.0, 100.0)])
    alone = found(images[:1], 0.0, slope=0.02)
    assert found(images, 0.0, slope=0.02) == pytest.approx(alone / 4, rel=1e-3)


def test_without_steps_or_dark_pixels_nothing_is_shared():
    images, valid = np.full((4, 31, 31), 0.01, np.float32), np.ones((31, 31), bool)
    assert shared_rounding(images, valid, constant=0.0, slope=0.0, quantum=0.0) is None
    assert shared_rounding(images, ~valid, constant=0.0, slope=0.0, quantum=STEP) is None
    assert shared_rounding(images, valid, constant=STEP**2, slope=0.0, quantum=STEP) is None
