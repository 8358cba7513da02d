"""Whether cameras are those of images: places of features, and what wrong cameras do to them."""

import numpy as np
import pytest

from polmvs.poses.image_check import ImageCheckTolerances, feature_detector, find_features


@pytest.mark.parametrize("center", [(40.0, 30.0), (40.5, 30.5), (37.25, 44.75)])
def test_places_of_features_count_from_the_corner(center: tuple[float, float]) -> None:
    """A round spot, of whose centre a feature is good to a tenth of a pixel (COLMAP's pixels)."""
    col, row = np.meshgrid(np.arange(80) + 0.5, np.arange(80) + 0.5)
    for sigma in (3.0, 5.0):
        squared = (col - center[0]) ** 2 + (row - center[1]) ** 2
        image = np.rint(30 + 200 * np.exp(-squared / (2 * sigma**2))).astype(np.uint8)
        places, descriptors, shape = find_features(feature_detector(ImageCheckTolerances()), image)
        assert shape == image.shape
        assert len(places) == len(descriptors) > 0
        nearest = np.linalg.norm(places - center, axis=1).min()
        assert nearest < 0.1
