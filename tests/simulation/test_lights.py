"""Environments: presets, files, and the ratio of their brightest to their darkest part."""

import cv2
import numpy as np
import pytest

from polmvs.errors import DataError, OptionError
from polmvs.simulation.lights import environment
from polmvs.simulation.options import LightingOptions, LightName, SceneryOptions
from polmvs.simulation.surroundings import TURNTABLE_RADIUS, surroundings


def test_overcast_sky_is_three_times_as_bright_above():
    sky = environment(LightingOptions(light=LightName.OVERCAST))[..., 0]
    assert sky[0, 0] / sky[len(sky) // 2 - 1, 0] == pytest.approx(3, rel=0.02)
    assert (np.ptp(sky, axis=1) == 0).all()


def test_contrast_is_the_ratio_of_brightest_to_darkest():
    room = environment(LightingOptions(light=LightName.STUDIO, contrast=1000.0))[..., 0]
    assert room.max() / np.percentile(room, 1) == pytest.approx(1000, rel=0.01)


def test_environment_of_a_file(tmp_path):
    path = tmp_path / "sky.hdr"
    image = np.zeros((8, 16, 3), np.float32)
    image[:4] = (0.25, 0.5, 2.0)  # blue, green, red
    assert cv2.imwrite(str(path), image)
    found = environment(LightingOptions(light=LightName.FILE, environment=path))
    np.testing.assert_allclose(found[0, 0], [2.0, 0.5, 0.25], rtol=0.01)
    assert cv2.imwrite(str(tmp_path / "square.hdr"), image[:, :8])
    with pytest.raises(DataError, match="twice as wide"):
        environment(LightingOptions(light=LightName.FILE, environment=tmp_path / "square.hdr"))
    with pytest.raises(OptionError, match=r"lighting\.light"):
        environment(LightingOptions(light=LightName.EVEN, environment=path))


def test_board_bears_markers_that_are_found_and_a_turntable_is_round():
    board = surroundings(SceneryOptions(surroundings="board"), 0.2, 0.1, 0)
    picture = np.rint(255 * board[0].print / board[0].print.max()).astype(np.uint8)
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    _, found, _ = cv2.aruco.ArucoDetector(dictionary).detectMarkers(picture)
    assert sorted(found.ravel()) == list(range(225))
    table = surroundings(SceneryOptions(turntable=True), 0.2, 0.1, 0)
    reach = max(np.linalg.norm(one.mesh.vertices[:, :2], axis=1).max() for one in table)
    assert reach <= TURNTABLE_RADIUS * 0.2 * 1.15
