import numpy as np
import pytest

from polmvs.surface.surface_quality import MIN_EXPLAINED, stand_apart

NAN = np.nan


@pytest.mark.parametrize(
    ("unexplained", "apart"),
    [
        ([0.1, 0.1, 0.12, 0.5, 0.1], [3]),  # of 0.9 that the median explains, 0.56
        ([0.02, 0.02, 0.03, 0.02, 0.15], [4]),  # explained, but seven times as much is not
        ([0.02, 0.02, 0.03, 0.02, 0.09], []),  # few pixels
        ([0.3, 0.3, 0.35, 0.4, 0.3], []),
        ([0.1, NAN, 0.1, 0.6, 0.1], [3]),
        ([NAN, NAN, NAN], []),
        ([0.1, 0.1, 0.9], []),  # two would be left
        # Of the surface that explains so little nothing is known, hence nothing of a view.
        ([0.7, 0.6, 0.7, 0.95, 0.7], []),
        ([0.45, 0.4, 0.45, 0.95, 0.45], [3]),
        # Some views see the wrong parts of a surface: no view is apart.
        ([0.2, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.75], []),
    ],
)
def test_views_that_stand_apart_from_a_surface(unexplained, apart):
    assert np.flatnonzero(stand_apart(np.array(unexplained), MIN_EXPLAINED)).tolist() == apart
