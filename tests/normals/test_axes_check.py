"""Which way angles of polarization count, as the planes of incidence of many views show it."""

from itertools import permutations

import numpy as np
import pytest
from scenes import Scene, board_scene, phase_map_of, tracks_at

from polmvs.config import CaptureKind, CaptureOptions
from polmvs.normals.axes_check import (
    MIRRORED,
    TURNED,
    TURNED_MIRRORED,
    changed_pattern,
    check_axes,
)
from polmvs.normals.rows import AS_MEASURED
from polmvs.polarization.kinds import Light
from polmvs.synthetic.captures import render_view
from polmvs.synthetic.surfaces import Sphere

STANDARD = (90, 45, 135, 0)
PAIRED = [p for p in permutations((0, 45, 90, 135)) if abs(p[0] - p[3]) == 90]


def read_as(phase_map, change):
    """The map with all its phases changed."""
    changed = phase_map.polarization[..., :2] @ np.array(change, np.float32).T
    return phase_map.changed(polarization=np.dstack([changed, phase_map.polarization[..., 2:]]))


def ball_scene(light: Light, sensor: str = "ppa") -> Scene:
    views, ball = board_scene(6).views, Sphere(center=np.zeros(3), radius=0.2)
    rendered = [
        render_view(v, ball, light=light.value, sensor=sensor, s0=0.3, background=0.9)
        for v in views
    ]
    return Scene(ball, views, rendered, [phase_map_of(r) for r in rendered])


@pytest.mark.parametrize("light", list(Light))
@pytest.mark.parametrize("sensor", ["ppa", "tilted"])
def test_right_angles_are_left_alone_under_either_light(light, sensor):
    scene = ball_scene(light, sensor)
    tracks = tracks_at(scene, scene.surface_points(500)[0])
    found = check_axes(tracks, scene.maps)
    assert found.num_votes > 20
    assert found.change is None


@pytest.mark.parametrize("change", [MIRRORED, TURNED, TURNED_MIRRORED])
@pytest.mark.parametrize("shape", ["board", "ball"])
def test_wrong_angles_are_told_apart(change, shape):
    scene = board_scene(6) if shape == "board" else ball_scene(Light.SPECULAR)
    # Few of a ball's points are seen by four views.
    tracks = tracks_at(scene, scene.surface_points(60 if shape == "board" else 500)[0])
    wrong = [read_as(phase_map, change) for phase_map in scene.maps]
    assert check_axes(tracks, wrong).change == change  # each undoes itself, but for the light


def test_few_views_or_points_say_nothing():
    scene = board_scene(6)
    wrong = [read_as(phase_map, MIRRORED) for phase_map in scene.maps]
    few = tracks_at(scene, scene.surface_points(4)[0])
    assert check_axes(few, wrong).change is None
    three = tracks_at(scene, scene.surface_points(60)[0], range(3))
    assert check_axes(three, wrong[:3]).change is None


def stokes_of(pattern: tuple[int, ...], samples: np.ndarray) -> np.ndarray:
    by_angle = dict(zip(pattern, samples, strict=True))
    return np.array([by_angle[0] - by_angle[90], by_angle[45] - by_angle[135]])


@pytest.mark.parametrize("given", PAIRED)
@pytest.mark.parametrize("change", [AS_MEASURED, MIRRORED, TURNED, TURNED_MIRRORED])
def test_the_pattern_that_is_named_gives_the_changed_parameters(given, change):
    samples = np.random.default_rng(0).uniform(size=4)
    samples[3] = samples[1] + samples[2] - samples[0]  # perpendicular pairs sum alike
    likely = changed_pattern(given, change)
    assert sorted(likely) == [0, 45, 90, 135]
    expected = np.array(change) @ stokes_of(given, samples)
    found = stokes_of(likely, samples)
    assert np.allclose(found, expected) or np.allclose(found, -expected)


def test_the_message_names_the_setting():
    scene = board_scene(6)
    tracks = tracks_at(scene, scene.surface_points(60)[0])
    wrong = [read_as(phase_map, MIRRORED) for phase_map in scene.maps]
    found = check_axes(tracks, wrong)
    options = CaptureOptions(pattern=(90, 135, 45, 0))
    text = found.message(options, CaptureKind.MOSAIC)
    assert text.startswith("`capture.pattern` 90,135,45,0 does not fit")
    assert text.endswith("Give `capture.pattern` 90,45,135,0")
    assert "Give `capture.clockwise`" in found.message(CaptureOptions(), CaptureKind.AOLP)
    mirrored = CaptureOptions(clockwise=True)
    assert "Give `capture.clockwise`" in found.message(mirrored, CaptureKind.MOSAIC)
