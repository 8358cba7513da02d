"""Pictures: axial colours, legends that agree with them, and codes that a browser reads."""

import base64

import cv2
import numpy as np
import pytest

from polmvs.report import pictures


def decoded(uri: str) -> np.ndarray:
    head, _, code = uri.partition(",")
    assert head == "data:image/webp;base64"
    return cv2.imdecode(np.frombuffer(base64.b64decode(code), np.uint8), cv2.IMREAD_UNCHANGED)


def test_angles_half_a_turn_apart_have_one_colour() -> None:
    angle = np.linspace(0, np.pi, 50, endpoint=False)[None]
    np.testing.assert_array_equal(
        pictures.angle_picture(angle + 1e-6), pictures.angle_picture(angle + np.pi + 1e-6)
    )


def test_colours_of_angles_close_at_the_seam() -> None:
    ends = pictures.angle_picture(np.array([[1e-6, np.pi - 1e-6]])).astype(int)
    assert np.abs(ends[0, 0] - ends[0, 1]).max() <= 6  # neighbours of 256 colours on a circle


def test_wheel_shows_at_each_direction_the_colour_of_its_angle() -> None:
    size = 201
    wheel = pictures.angle_wheel(size)
    for angle in np.radians([0, 30, 90, 135, 179]):
        row = int(size / 2 - 0.8 * size / 2 * np.sin(angle))  # anticlockwise as displayed
        col = int(size / 2 + 0.8 * size / 2 * np.cos(angle))
        expected = pictures.angle_picture(np.array([[angle]]))[0, 0].astype(int)
        assert wheel[row, col, 3] == 255
        assert np.abs(wheel[row, col, :3].astype(int) - expected).max() <= 12
    assert wheel[size // 2, size // 2, 3] == 0


def test_unknown_pixels_are_grey_and_not_a_colour_of_the_scale() -> None:
    values = np.array([[0.0, 0.5, 1.0, np.nan, np.inf]])
    picture = pictures.scalar_picture(values, 0, 1)
    colors = pictures.palette(pictures.SEQUENTIAL)
    np.testing.assert_array_equal(picture[0, 0], colors[0])
    np.testing.assert_array_equal(picture[0, 2], colors[-1])
    assert (picture[0, 3:] == pictures.NOTHING).all()


def test_values_beyond_the_scale_have_its_last_colours() -> None:
    picture = pictures.scalar_picture(np.array([[-5.0, 7.0]]), 0, 1)
    np.testing.assert_array_equal(picture[0], pictures.palette(pictures.SEQUENTIAL)[[0, -1]])


@pytest.mark.parametrize(
    ("normal", "color"),
    [((1, 0, 0), (255, 128, 128)), ((0, -1, 0), (128, 255, 128)), ((0, 0, -1), (128, 128, 255))],
)
def test_normals_are_red_right_green_up_blue_towards_us(normal, color) -> None:
    picture = pictures.normal_picture(np.array([[normal]], float))
    np.testing.assert_allclose(picture[0, 0], color, atol=1)


def test_a_normal_of_nan_is_grey() -> None:
    assert (pictures.normal_picture(np.full((1, 1, 3), np.nan)) == pictures.NOTHING).all()


def test_outline_lies_outside_the_mask() -> None:
    inside = np.zeros((9, 9), bool)
    inside[3:6, 3:6] = True
    picture = pictures.outline_picture(np.full((9, 9), 0.5), 1.0, inside)
    assert (picture[2, 4] == (230, 159, 0)).all()
    assert (picture[inside] == pictures.gray_picture(np.array([[0.5]]), 1.0)[0, 0]).all()


def test_a_coded_picture_is_the_picture() -> None:
    rng = np.random.default_rng(0)
    smooth = cv2.GaussianBlur(rng.uniform(0, 255, (40, 60, 3)), (0, 0), 6)
    picture = np.ascontiguousarray(255 * (smooth - smooth.min()) / np.ptp(smooth)).astype(np.uint8)
    found = decoded(pictures.data_uri(picture))[..., ::-1]
    assert found.shape == picture.shape
    assert np.abs(found.astype(int) - picture).mean() < 6  # lossy


def test_transparency_survives() -> None:
    found = decoded(pictures.data_uri(pictures.angle_wheel(64)))
    assert found.shape == (64, 64, 4)
    assert (found[32, 32, 3], found[32, 8, 3]) == (0, 255)
