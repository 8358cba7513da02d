"""Gains between the images of a view, told from polarized light."""

import numpy as np
import pytest

from polmvs.polarization.angle_gains import SENSOR_SPREAD, capture_gains, find_angle_gains
from polmvs.polarization.stokes import ideal_analyzers

FOUR = (0.0, 45.0, 90.0, 135.0)


def scene(angles, gains, *, ground_dolp=0.0, part=0.4, seed=0):
    """A polarized part, of another angle every 8 px, on a ground, with 1 % of noise."""
    rng = np.random.default_rng(seed)
    shape = (120, 160)
    patch = np.ones((8, 8))
    s0 = rng.uniform(0.2, 0.8, shape)
    dolp = np.full(shape, ground_dolp)
    angle = np.zeros(shape)
    num = int(part * shape[0])
    dolp[:num] = np.kron(rng.uniform(0.1, 0.9, (15, 20)), patch)[:num]
    angle[:num] = np.kron(rng.uniform(0, np.pi, (15, 20)), patch)[:num]
    stokes = np.stack([s0, s0 * dolp * np.cos(2 * angle), s0 * dolp * np.sin(2 * angle)])
    images = np.tensordot(ideal_analyzers(angles), stokes, axes=1)
    images *= np.reshape(gains, (-1, 1, 1)) * rng.normal(1, 0.01, images.shape)
    return images, np.ones(shape, np.bool_)


@pytest.mark.parametrize("angles", [FOUR, (0.0, 60.0, 120.0), tuple(range(0, 180, 30))])
@pytest.mark.parametrize("part", [0.0, 0.4, 0.8])
def test_gains_of_any_angles_are_found(angles, part):
    gains = np.linspace(0.3, 1.0, len(angles))
    images, usable = scene(angles, gains, part=part)
    found = find_angle_gains(images, angles, usable)
    assert found.differ
    expected = gains / np.exp(np.log(gains).mean())
    # 1 % of noise at a pixel, of thousands of which these are the median.
    np.testing.assert_allclose(found.gains, expected, rtol=5e-3)
    assert found.support > 0.5 * (1 - part)


@pytest.mark.parametrize("dolp", [0.0, 0.1, 0.3])
def test_a_ground_that_is_polarized_is_no_gain(dolp):
    images, usable = scene(FOUR, np.ones(4), ground_dolp=dolp)
    assert not find_angle_gains(images, FOUR, usable).differ


def test_too_little_to_go_by():
    images, usable = scene(FOUR, [0.2, 1, 1, 1])
    found = find_angle_gains(images, FOUR, np.zeros_like(usable))
    assert (found.gains, found.differ) == ((1.0,) * 4, False)
    images, usable = scene(FOUR, [0.2, 1, 1, 1], part=0.97)  # hardly any unpolarized place
    assert not find_angle_gains(images, FOUR, usable).differ


def axial(logs):
    """Polarization that gains feign, by the definition of the Stokes parameters."""
    g = np.exp(logs)
    return 2 * np.array([g[0] - g[2], g[1] - g[3]]) / g.sum()


def found_in(gains_of_views, **of_scene):
    return [
        find_angle_gains(*scene(FOUR, gains, seed=seed, **of_scene)[:1], FOUR, np.ones((120, 160)))
        for seed, gains in enumerate(gains_of_views)
    ]


def test_gains_of_a_sensor_are_found_in_all_views():
    gains = np.array([1.02, 1.0, 0.97, 1.01])
    gains /= np.exp(np.log(gains).mean())
    views = found_in([gains] * 6)
    found = capture_gains(views, FOUR, constant=True)
    # 1 % of noise at a pixel; 64 pixels a patch, half of 300 patches show the ground.
    np.testing.assert_allclose(found.common.gains, gains, atol=3 * 0.01 / np.sqrt(64 * 150))
    # What is left lies within its stated deviation, below the one that the misfit alone gives.
    left = axial(np.log(gains) - np.log(found.common.gains))
    assert np.abs(left).max() < 3 * found.common.sigma < 0.1 * found.prior
    # Files of each angle show a sensor's gains as well.
    assert capture_gains(views, FOUR, constant=False).common.gains == found.common.gains
    assert "differ by 5.2 % (0 deg 1.020" in found.message


def test_each_view_has_gains_of_its_own():
    rng = np.random.default_rng(0)
    truth = rng.normal(0, 0.02, (8, 4))
    views = found_in(np.exp(truth))
    found = capture_gains(views, FOUR, constant=False)
    assert found.common is None
    assert 0.3 * 0.02 < found.prior < 3 * 0.02
    for view, own in zip(views, truth, strict=True):
        left = axial(own - np.log(found.of(view).gains))
        assert np.abs(left).max() < 1e-3  # of 0.014 that such gains feign


@pytest.mark.parametrize("dolp", [0.02, 0.05])
def test_light_of_one_polarization_is_no_gain(dolp):
    """Equal gains have no misfit, so polarized light that all views share stays."""
    views = found_in([np.ones(4)] * 6, ground_dolp=dolp)
    assert capture_gains(views, FOUR, constant=True) is None


def test_strong_polarization_is_no_gain():
    """Gains of real sensors, and a ground polarized by more than such gains feign."""
    gains = np.array([1.005, 0.995, 1.005, 0.995])
    views = found_in([gains] * 6, ground_dolp=5 * SENSOR_SPREAD)
    assert capture_gains(views, FOUR, constant=True) is None


def test_views_that_disagree_show_no_gains():
    rng = np.random.default_rng(1)
    scenes = [
        scene(FOUR, [1.005, 0.995, 1.005, 0.995], ground_dolp=dolp, seed=k)[0]
        for k, dolp in enumerate(rng.normal(0, 0.04, 6))
    ]
    views = [find_angle_gains(images, FOUR, np.ones((120, 160))) for images in scenes]
    assert capture_gains(views, FOUR, constant=True) is None


def test_three_angles_have_no_misfit():
    angles = (0.0, 60.0, 120.0)
    usable = np.ones((120, 160), np.bool_)
    rng = np.random.default_rng(3)
    for constant in (True, False):
        truth = rng.normal(0, 0.02, (1 if constant else 8, 3))
        views = [
            find_angle_gains(
                scene(angles, np.exp(truth[k % len(truth)]), seed=k)[0], angles, usable
            )
            for k in range(8)
        ]
        found = capture_gains(views, angles, constant=False)
        assert (found is None) == constant
        if found is not None:  # the views disagree, the parts of each do not
            for view, own in zip(views, truth, strict=True):
                expected = np.exp(own - own.mean())
                np.testing.assert_allclose(found.of(view).gains, expected, rtol=1e-3)
