"""Gains between the images of a view, told from polarized light."""

import numpy as np
import pytest

from polmvs.polarization.angle_gains import find_angle_gains
from polmvs.polarization.stokes import ideal_analyzers

FOUR = (0.0, 45.0, 90.0, 135.0)


def scene(angles, gains, *, ground_dolp=0.0, part=0.4, seed=0):
    """A polarized part of every angle on a ground, with 1 % of noise."""
    rng = np.random.default_rng(seed)
    shape = (120, 160)
    s0 = rng.uniform(0.2, 0.8, shape)
    dolp = np.full(shape, ground_dolp)
    angle = np.zeros(shape)
    num = int(part * shape[0])
    dolp[:num] = rng.uniform(0.1, 0.9, (num, shape[1]))
    angle[:num] = rng.uniform(0, np.pi, (num, shape[1]))
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
