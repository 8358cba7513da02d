"""Boxes in the frame of the model, and in that of a rendered marker."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from marker_scenes import ONE, OPTION, PINHOLE, loader, views_of
from scipy.spatial.transform import Rotation

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.config import CropOptions
from polmvs.errors import OptionError
from polmvs.geometry import RigidTransform
from polmvs.poses.crop_box import CropBox, crop_box, marker_frames
from polmvs.scene import View
from polmvs.synthetic.captures import look_at

ONES = np.ones(3)


def no_image(name: str) -> np.ndarray:
    raise AssertionError(name)


def test_box_of_the_model_needs_no_marker_and_no_order_of_corners() -> None:
    box = crop_box(CropOptions(box=(1, -2, 3, 0, 2, 0)), None, [], no_image)
    assert box is not None
    points = np.array([[0.5, 0, 1], [1, 2, 3], [0, -2, 0], [1.01, 0, 1], [0.5, -2.1, 1]])
    assert box.contains(points).tolist() == [True, True, True, False, False]
    assert box.contains(points.reshape(1, 5, 3)).shape == (1, 5)
    assert crop_box(CropOptions(), None, [], no_image) is None


def test_what_is_not_known_is_not_inside() -> None:
    box = CropBox(RigidTransform(np.eye(3), np.zeros(3)), -np.ones(3), np.ones(3))
    assert not box.contains(np.full((2, 3), np.nan)).any()


def test_an_empty_box_says_where_the_surface_is() -> None:
    box = CropBox(RigidTransform(np.eye(3), np.zeros(3)), np.ones(3), 2 * np.ones(3))
    with pytest.raises(OptionError, match=r"holds nothing .* lies in -1,0,0,0.5,0.25,3"):
        box.require_some(np.array([[-1, 0.25, 3], [0.5, 0, 0]]))


@pytest.fixture(scope="module")
def images() -> Callable[[str], np.ndarray]:
    return loader(views_of(PINHOLE), ONE)


def test_frame_of_a_marker_is_where_it_lies(images) -> None:
    frames = marker_frames(views_of(PINHOLE), OPTION, images)
    (marker_id, center, side, turn) = ONE[0]
    assert list(frames) == [marker_id]
    right = np.array([np.cos(turn), np.sin(turn), 0])
    top = np.array([-np.sin(turn), np.cos(turn), 0])
    middle = np.array([*center, 0.0])
    world = middle + np.array([np.zeros(3), side * right, side * top, [0, 0, side]])
    local = side * np.vstack([np.zeros(3), np.eye(3)])
    # A corner is found to a tenth of a pixel of a millimetre.
    np.testing.assert_allclose(frames[marker_id] * world, local, atol=3e-4)


def test_box_on_a_marker(images) -> None:
    views = views_of(PINHOLE)
    options = CropOptions(box=(-0.025, -0.025, -0.01, 0.025, 0.025, 0.03), box_marker=7)
    box = crop_box(options, OPTION, views, images)
    assert box is not None
    along = np.array([np.cos(0.4), np.sin(0.4), 0])
    middle = np.array([0.01, -0.02, 0])
    rows = middle + np.array([0, 0.024, 0.026, -0.026, 0.0335])[:, None] * along
    assert box.contains(rows).tolist() == [True, True, False, False, False]
    assert box.contains(middle + np.array([0, 0, 0.029]))
    assert not box.contains(middle + np.array([0, 0, 0.031]))


def test_marker_that_is_not_there(images) -> None:
    views = views_of(PINHOLE)
    options = CropOptions(box=(0, 0, 0, 1, 1, 1), box_marker=3)
    with pytest.raises(OptionError, match="is 3, which no two views show; found: 7"):
        crop_box(options, OPTION, views, images)
    with pytest.raises(OptionError, match=r"needs `reference.aruco`"):
        crop_box(options, None, views, no_image)


def test_boxes_that_are_none() -> None:
    with pytest.raises(OptionError, match="corners that differ in x, y and z"):
        CropOptions(box=(0, 0, 0, 1, 1, 0))
    with pytest.raises(OptionError, match=r"needs `crop.box`"):
        CropOptions(box_marker=1)


WORLD = RigidTransform(np.eye(3), np.zeros(3))


def test_pixels_whose_rays_miss_a_box() -> None:
    """Against points of the rays: near, far, and behind the camera."""
    camera = PinholeCamera(width=40, height=30, fx=35, fy=35, cx=20, cy=15)
    view = View(name="a", camera=camera, cam_from_world=look_at([0.1, -0.5, 0.6], (0, 0, 0)))
    turned = RigidTransform(Rotation.from_euler("xyz", [0.3, 0.2, 1.0]).as_matrix(), ONES / 50)
    rays = view.rays_in_world(pixel_centers(40, 30))
    for box in (
        CropBox(WORLD, np.array([-0.2, -0.1, -0.05]), np.array([0.1, 0.2, 0.1])),
        CropBox(turned, np.array([-0.2, -0.1, -0.05]), np.array([0.1, 0.2, 0.1])),
        CropBox(WORLD, np.array([-0.1, -0.7, 0.4]), np.array([0.3, -0.3, 0.8])),  # about the camera
        CropBox(WORLD, np.array([-0.3, -1.9, 1.2]), np.array([0.3, -1.5, 1.8])),  # behind it
    ):
        steps = np.linspace(0, 3, 6001)[:, None, None, None]
        meets = box.contains(view.center_in_world + steps * rays).any(axis=0)
        differ = meets == box.misses(view)
        assert differ.mean() < 0.01  # rays that touch an edge between two steps
        assert not (meets & box.misses(view)).any()


SPARSE = np.random.default_rng(0).uniform(-1, 1, (200, 3)) * [1, 1, 0.05]  # a table
CENTERS = np.array([[2, 0, 2.0], [-2, 0, 2], [0, 2, 2], [0, -2, 2]])


@pytest.mark.parametrize(
    ("low", "high", "num"),
    [
        ((-0.5, -0.5, -0.1), (0.5, 0.5, 0.1), "some"),
        ((-0.1, -0.1, 0.3), (0.1, 0.1, 0.5), None),  # over the table, without any point
        ((-100, -100, -100), (100, 100, 100), "all"),
    ],
)
def test_boxes_that_may_hold_a_surface(low, high, num) -> None:
    kept = CropBox(WORLD, np.array(low, float), np.array(high, float)).require_possible(
        SPARSE, CENTERS
    )
    assert kept.any() == (num is not None)
    assert kept.all() == (num == "all")


@pytest.mark.parametrize(
    ("low", "high"),
    [
        ((90, 90, 90), (91, 91, 91)),
        ((-1, -1, -0.6), (1, 1, -0.3)),  # under the table
        ((1.9, 1.9, 1.0), (2, 2, 1.9)),  # within the scene's own box, beside its hull
    ],
)
def test_boxes_beside_the_scene(low, high) -> None:
    box = CropBox(WORLD, np.array(low, float), np.array(high, float))
    with pytest.raises(
        OptionError, match=r"most sparse points lie in -0\.9\d+,-0\.9\d+,-0\.0"
    ) as caught:
        box.require_possible(SPARSE, CENTERS)
    assert caught.value.field == "crop.box"


def test_a_scene_in_one_plane_has_a_hull_as_well() -> None:
    flat = SPARSE * [1, 1, 0]
    box = CropBox(WORLD, np.array([-2, -2, 1.0]), np.array([2, 2, 2.0]))
    with pytest.raises(OptionError, match="lies beside all"):
        box.require_possible(flat, flat[:3])
