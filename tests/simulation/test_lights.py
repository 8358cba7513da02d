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


def test_a_crumpled_table_is_flat_under_the_object_and_has_its_prints():
    flat, crumpled = (
        surroundings(SceneryOptions(relief=relief), 0.2, 0.1, 7) for relief in (0.0, 0.02)
    )
    np.testing.assert_array_equal(flat[0].print, crumpled[0].print)
    places, heights = np.split(crumpled[0].mesh.vertices, [2], axis=1)
    away = np.linalg.norm(places, axis=1)
    assert (flat[0].mesh.vertices[:, 2] == 0).all()
    assert (heights[away <= 0.1] == 0).all()
    # 24 waves over some wavelengths: their mean square varies by about a third.
    assert np.sqrt(np.mean(heights[away > 0.16] ** 2)) == pytest.approx(0.004, rel=0.3)
    edges = np.diff(crumpled[0].mesh.vertices[crumpled[0].mesh.triangles[:, :2]], axis=1)[:, 0]
    normals = crumpled[0].mesh.normals[crumpled[0].mesh.triangles[:, :2]].mean(axis=1)
    rise = np.abs((edges * normals).sum(axis=1)) / np.linalg.norm(edges, axis=1)
    assert np.quantile(rise, 0.95) < 0.02  # of flat normals 0.2
    for one, other in zip(flat[1:], crumpled[1:], strict=True):
        moved = other.mesh.vertices - one.mesh.vertices
        np.testing.assert_allclose(moved, np.broadcast_to(moved[0], moved.shape), atol=1e-12)
        assert (moved[:, :2] == 0).all()
