"""Boxes in the frame of the model, and in that of a rendered marker."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from marker_scenes import ONE, OPTION, PINHOLE, loader, views_of

from polmvs.config import CropOptions
from polmvs.errors import OptionError
from polmvs.geometry import RigidTransform
from polmvs.poses.crop_box import CropBox, crop_box, marker_frames


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
