"""Vignetting of a lens is fitted exactly, and told from the falloff of a lamp at the camera."""

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.surface.vignetting import fit_vignetting, vignetting_terms

TRUTH = np.array([0.9, 1.4])
LAMP = 3.0
NUM = 2000


def pairs(lamp=0.0, noise=0.0):
    """Ratios, terms and distances of pairs of points in two views of a 70 degree lens."""
    rng = np.random.default_rng(0)
    camera = PinholeCamera(width=600, height=400, fx=430, fy=430, cx=300, cy=200)
    xy = rng.uniform((0, 0), (600, 400), (2, 2, NUM, 2))  # points of a pair, views
    terms = vignetting_terms(camera, xy)
    distances = rng.uniform(-0.3, 0.3, (2, 2, NUM))
    log = -terms @ TRUTH - lamp * distances
    log += rng.normal(size=(2, 1, NUM)) + rng.normal(size=(1, 2, NUM))  # radiances, gains
    log += rng.normal(scale=noise, size=log.shape) if noise else 0.0

    def differences(values):
        of_views = values[:, 0] - values[:, 1]
        return of_views[0] - of_views[1]

    return differences(log), differences(terms), differences(distances)


def test_the_terms_are_powers_of_the_sine_of_the_angle_from_the_axis():
    camera = PinholeCamera(width=200, height=200, fx=100, fy=100, cx=100, cy=100)
    terms = vignetting_terms(camera, np.array([[100.0, 100.0], [200.0, 100.0], [100.0, 0.0]]))
    np.testing.assert_allclose(terms, [[0, 0], [0.5, 0.25], [0.5, 0.25]], atol=1e-12)


@pytest.mark.parametrize("lamp", [0.0, LAMP])
def test_vignetting_is_found_exactly_with_and_without_a_lamp_at_the_camera(lamp):
    np.testing.assert_allclose(fit_vignetting(*pairs(lamp)), TRUTH, atol=1e-6)


def test_points_that_mirror_or_are_hidden_do_not_count():
    noise = 0.02
    ratios, terms, distances = pairs(noise=noise)
    wrong = np.random.default_rng(1).random(NUM) < 0.2
    ratios = np.where(wrong, ratios + 1.0, ratios)  # one-sided, as highlights are
    columns = np.column_stack([terms, distances])[~wrong]
    # Four deviations of least squares on the right ones; a ratio has the noise of four values.
    # The robust loss loses 5 % of the information, and outliers widen its scale.
    sigma = 2 * noise * np.sqrt(np.diag(np.linalg.inv(columns.T @ columns)))[:2]
    error = np.abs(fit_vignetting(ratios, terms, distances) - TRUTH)
    assert (error < 4 * 1.5 * sigma).all()
    plain = np.linalg.lstsq(-np.column_stack([terms, distances]), ratios, rcond=None)[0]
    assert (error < np.abs(plain[:2] - TRUTH)).all()


def test_without_points_or_differences_there_is_none():
    nothing = fit_vignetting(np.zeros(0), np.zeros((0, 2)), np.zeros(0))
    np.testing.assert_array_equal(nothing, [0, 0])
    alike = fit_vignetting(np.zeros(50), np.zeros((50, 2)), np.zeros(50))
    np.testing.assert_array_equal(alike, [0, 0])
