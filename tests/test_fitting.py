import numpy as np
import pytest

from polmvs.fitting import (
    CAUCHY_SCALE,
    annealed_scales,
    cauchy_weights,
    geman_mcclure_weights,
    like_most,
    robust_deviation,
)


def test_cauchy_weights_are_the_slope_of_the_loss():
    z, step = np.linspace(-9, 9, 31), 1e-6

    def loss(x):
        return 0.5 * CAUCHY_SCALE**2 * np.log1p((x / CAUCHY_SCALE) ** 2)

    slope = (loss(z + step) - loss(z - step)) / (2 * step)
    np.testing.assert_allclose(cauchy_weights(z**2) * z, slope, atol=1e-8)


def test_geman_mcclure_weights_are_the_slope_of_the_loss():
    residuals, square, step = np.linspace(0.1, 30, 100), 2.5, 1e-5

    def loss(r):  # half the square near 0, half the width's square far away
        return 0.5 * square * r**2 / (square + r**2)

    slope = (loss(residuals + step) - loss(residuals - step)) / (2 * step)
    weights = geman_mcclure_weights(residuals, square)
    np.testing.assert_allclose(weights * residuals, slope, rtol=1e-4)
    assert geman_mcclure_weights(np.zeros(1), square) == 1


def test_the_cauchy_mean_of_normal_data_is_95_percent_efficient():
    rng = np.random.default_rng(0)
    data = rng.normal(size=(20_000, 50))
    mean = np.zeros((len(data), 1))
    for scale in (*annealed_scales(5), *[CAUCHY_SCALE] * 3):
        weights = cauchy_weights((data - mean) ** 2, scale)
        mean = (weights * data).sum(axis=1, keepdims=True) / weights.sum(axis=1, keepdims=True)
    # The variance of 20,000 means is known to 1 %.
    assert 1 / (50 * mean.var()) == pytest.approx(0.95, abs=0.025)


def test_scales_are_halved_down_to_the_final_one():
    assert list(annealed_scales(5)) == [CAUCHY_SCALE * f for f in (4, 2, 1, 1, 1)]
    assert list(annealed_scales(2)) == [CAUCHY_SCALE] * 2
    assert list(annealed_scales(0)) == []


def test_the_deviation_is_that_of_the_majority():
    residuals = np.random.default_rng(1).normal(0, 0.3, 20_001)
    assert robust_deviation(residuals) == pytest.approx(0.3, rel=0.02)
    residuals[:2000] = 1e9
    assert robust_deviation(residuals) == pytest.approx(0.3, rel=0.2)
    assert np.isnan(robust_deviation(residuals[:0]))


def test_residuals_like_most_lie_within_floor_and_ceiling():
    residuals = np.array([1.0, 1.0, 1.0, 4.9, 5.1])
    np.testing.assert_array_equal(like_most(residuals, floor=0.0), [1, 1, 1, 1, 0])
    assert like_most(residuals, floor=6.0).all()
    np.testing.assert_array_equal(like_most(residuals, floor=0.0, ceiling=2.0), [1, 1, 1, 0, 0])
    assert like_most(np.zeros(3), floor=0.0).all()
