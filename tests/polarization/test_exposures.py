"""Exposures of one view are averaged with the weights that their noise gives."""

import numpy as np
import pytest

from polmvs.polarization.exposures import READ_VARIANCE, merge_exposures

FULL_WELL = 1e4  # electrons, of the noise that the weights are made for


def test_weights_are_those_of_least_variance() -> None:
    """One pair of samples by hand: the variance of x / share is (light share + read) / share^2."""
    light, shares = 0.2, np.array([1.0, 0.25])
    samples = light * shares + [0.01, -0.004]
    pooled = samples.sum() / shares.sum()
    weight = shares**2 / (pooled * shares + READ_VARIANCE)
    images = [np.full((1, 1), value, np.float32) for value in samples]
    merged, nowhere = merge_exposures(images, [np.zeros((1, 1), bool)] * 2, shares * 7)
    expected = (weight * samples / shares).sum() / weight.sum()
    assert merged.item() == pytest.approx(expected, rel=1e-5)
    assert not nowhere.any()


@pytest.mark.parametrize("light", [0.02, 0.5])
def test_the_mean_is_as_good_as_the_best_of_its_kind(light: float) -> None:
    """Its variance is that of the sum of both precisions, to 3 % (200,000 pixels)."""
    rng = np.random.default_rng(0)
    shares = np.array([1.0, 0.1])
    variances = (light * shares + READ_VARIANCE) / FULL_WELL
    images = [
        rng.normal(light * share, np.sqrt(variance), (400, 500)).astype(np.float32)
        for share, variance in zip(shares, variances, strict=True)
    ]
    merged, _ = merge_exposures(images, [np.zeros((400, 500), bool)] * 2, shares)
    best = 1 / (shares**2 / variances).sum()
    assert merged.mean() == pytest.approx(light, abs=5 * np.sqrt(best / merged.size))
    assert merged.var() == pytest.approx(best, rel=0.03)


def test_clipped_samples_say_nothing() -> None:
    long, short = np.array([[1.0, 0.5, 1.0]], np.float32), np.array([[0.4, 0.05, 1.0]], np.float32)
    clipped = [long >= 1, short >= 1]
    merged, nowhere = merge_exposures([long, short], clipped, [1.0, 0.1])
    np.testing.assert_allclose(merged, [[4.0, 0.5, 10.0]], rtol=1e-5)
    np.testing.assert_array_equal(nowhere, [[False, False, True]])
