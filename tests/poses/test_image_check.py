"""Whether cameras are those of images: places of features, and what wrong cameras do to them."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from printed_images import CAMERA, noisy_mosaics

from polmvs.camera import PinholeCamera
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform
from polmvs.poses.image_check import (
    ImageCheckTolerances,
    ImageMatches,
    epipolar_distances,
    feature_detector,
    find_features,
    fit_to_images,
    require_cameras_of_images,
)
from polmvs.scene import View
from polmvs.synthetic.captures import quantize
from polmvs.synthetic.printed import orbit_views

Images = dict[str, np.ndarray]


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


@pytest.fixture(scope="module")
def printed() -> tuple[list[View], Images]:
    """Views of printed surfaces, neighbours of which share most, and their images."""
    views = orbit_views(12, CAMERA, seed=0)[:3]
    cells = (m.reshape(CAMERA.height, 2, CAMERA.width, 2) for m in noisy_mosaics(views, 0))
    images = [quantize(2 * cell.mean(axis=(1, 3))) for cell in cells]
    return views, {view.name: image for view, image in zip(views, images, strict=True)}


def test_cameras_of_the_images_fit_and_those_of_others_do_not(
    printed: tuple[list[View], Images],
) -> None:
    views, images = printed
    matches = ImageMatches(images.__getitem__)
    fit = require_cameras_of_images(views, matches, "cameras.txt", "Give others.")
    assert fit.fits
    assert fit.num_matches > 100
    assert fit.fitting > 0.95
    # The same cameras, each with the name of the next one's image.
    names = [view.name for view in views]
    others = [
        replace(view, name=name) for view, name in zip(views, names[1:] + names[:1], strict=True)
    ]
    with pytest.raises(DataError, match=r"cameras\.txt: its cameras do not fit .* Give others\."):
        require_cameras_of_images(others, matches, "cameras.txt", "Give others.")


def test_a_background_that_stays_in_place_tells_nothing(
    printed: tuple[list[View], Images],
) -> None:
    """As behind a turntable, before which the camera stands still."""
    views, images = printed
    wall = np.random.default_rng(0).integers(0, 255, (50, 30)).astype(np.uint8)
    wall = np.kron(wall, np.ones((5, 5), np.uint8))  # half as wide as the images
    behind = {n: np.hstack([wall, image[:, wall.shape[1] :]]) for n, image in images.items()}
    fit = fit_to_images(views, ImageMatches(behind.__getitem__))
    assert fit.num_matches > 40
    assert fit.fitting > 0.95
    only = fit_to_images(views, ImageMatches(lambda name: images[views[0].name]))
    assert only.num_matches == 0
    assert only.fits is None


@pytest.mark.parametrize(
    "image_of",
    [
        lambda rng: np.full((250, 300), 90, np.uint8),
        lambda rng: rng.integers(0, 255, (250, 300)).astype(np.uint8),
    ],
    ids=["blank", "unrelated"],
)
def test_images_that_share_nothing_do_not_tell(
    printed: tuple[list[View], Images], image_of: Callable[[np.random.Generator], np.ndarray]
) -> None:
    views, _ = printed
    rng = np.random.default_rng(0)
    matches = ImageMatches({view.name: image_of(rng) for view in views}.__getitem__)
    fit = require_cameras_of_images(views, matches, "cameras.txt", "Give others.")
    assert fit.fits is None
    assert fit.num_matches == 0
    assert np.isnan(fit.fitting)


def test_views_that_are_compared_are_spread_over_all(printed: tuple[list[View], Images]) -> None:
    views, images = printed
    many = [replace(views[k % 3], name=f"{k}") for k in range(9)]
    seen: list[str] = []

    def load(name: str) -> np.ndarray:
        seen.append(name)
        return images[views[int(name) % 3].name]

    matches = ImageMatches(load, tolerances=ImageCheckTolerances(max_views=3))
    first, again = (fit_to_images(many, matches) for _ in range(2))
    assert seen == ["0", "4", "8"]  # each once, however many cameras are compared
    assert first == again
