"""Whether cameras are those of images: places of features, and what wrong cameras do to them."""

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.geometry import RigidTransform
from polmvs.poses.image_check import (
    ImageCheckTolerances,
    epipolar_distances,
    feature_detector,
    find_features,
)
from polmvs.scene import View


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


def side_by_side() -> tuple[View, View]:
    camera = PinholeCamera(width=400, height=300, fx=400.0, fy=400.0, cx=200.0, cy=150.0)
    poses = (RigidTransform(np.eye(3), np.array([-x, 0.0, 0.0])) for x in (0.0, 0.1))
    first, second = (View(name="a.png", camera=camera, cam_from_world=pose) for pose in poses)
    return first, second


def test_true_matches_lie_on_their_epipolar_lines_and_before_both_cameras() -> None:
    first, second = side_by_side()
    points = np.random.default_rng(0).uniform([-0.3, -0.2, 0.8], [0.3, 0.2, 1.5], (30, 3))
    a, b = first.project(points), second.project(points)
    np.testing.assert_allclose(epipolar_distances(first, second, a, b), 0, atol=1e-9)
    # Seen the other way round their lines would meet behind the cameras.
    assert np.isinf(epipolar_distances(first, second, b, a)).all()
    # What is very far is before them, whatever rounding makes of it.
    np.testing.assert_allclose(epipolar_distances(first, second, a, a), 0, atol=1e-9)


def test_distances_from_epipolar_lines_are_shares_of_the_diagonal() -> None:
    first, second = side_by_side()
    point = np.array([[0.0, 0.0, 1.0]])
    a, b = first.project(point), second.project(point) + np.array([0.0, 5.0])
    assert epipolar_distances(first, second, a, b)[0] == pytest.approx(5 / 500, rel=0.01)
