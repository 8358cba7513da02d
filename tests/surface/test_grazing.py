import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from polmvs.surface.grazing import BLUR_PX, outline_bias


@pytest.mark.parametrize("matted", [False, True])
def test_edges_have_none_and_rounder_surfaces_more(matted):
    bias = outline_bias(np.array([0.0, 1.0, 10.0, 100.0, 1e6]), matted=matted)
    assert (np.diff(bias) > 0).all()
    assert bias[0] < 0.06
    assert bias[-1] < 1.5


@pytest.mark.parametrize("radius", [10.0, 80.0])
def test_the_bias_is_that_of_a_mirrored_background(radius):
    """By Schlick's approximation, which exceeds Fresnel's reflectance by up to 0.05."""
    x = np.arange(-8, 8, 0.01)
    cosine = np.sqrt(np.maximum(1 - (1 + np.minimum(x, 0) / radius) ** 2, 0))
    reflected = 0.04 + 0.96 * (1 - cosine) ** 5
    share = gaussian_filter1d(np.where(x < 0, 1 - reflected, 0), BLUR_PX / 0.01)
    steepest = x[np.argmin(np.gradient(share))]
    assert outline_bias(np.array([radius]), matted=False) == pytest.approx(-steepest, abs=0.06)
