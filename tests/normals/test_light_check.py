"""The light that a user states, against what the planes of incidence show."""

import numpy as np
import pytest
from scenes import Scene, board_scene, phase_map_of, seen_tracks, tracks_at

from polmvs.normals.light import track_votes
from polmvs.normals.light_check import check_light
from polmvs.polarization.kinds import Light
from polmvs.synthetic.captures import render_view
from polmvs.synthetic.surfaces import Sphere

OTHER = {Light.SPECULAR: Light.DIFFUSE, Light.DIFFUSE: Light.SPECULAR}


def ball_scene(light: Light, sensor: str) -> Scene:
    """A ball, whose light is polarized all round its rim under either kind of reflection."""
    views, ball = board_scene(6).views, Sphere(center=np.zeros(3), radius=0.2)
    rendered = [
        render_view(v, ball, light=light.value, sensor=sensor, s0=0.3, background=0.9)
        for v in views
    ]
    return Scene(ball, views, rendered, [phase_map_of(r, light) for r in rendered])


@pytest.mark.parametrize("light", list(Light))
@pytest.mark.parametrize("sensor", ["ppa", "tilted"])
def test_only_the_wrong_light_is_contradicted(light, sensor):
    scene = ball_scene(light, sensor)
    tracks = seen_tracks(scene, *scene.surface_points(60))
    right = [phase_map_of(rendered, light) for rendered in scene.rendered]
    assert not check_light(tracks, right, light).contradicted
    found = check_light(tracks, right, OTHER[light])
    assert found.contradicted
    assert f"`region.light` {OTHER[light]} does not fit: under {light} light" in found.message
    assert f"Give `region.light` {light}, or leave it out" in found.message


def test_few_points_say_nothing():
    scene = board_scene(6)
    tracks = tracks_at(scene, scene.surface_points(5)[0])
    assert not check_light(tracks, scene.maps, Light.DIFFUSE).contradicted
    nothing = tracks_at(scene, np.zeros((0, 3)))
    assert check_light(nothing, scene.maps, Light.DIFFUSE).num_votes == 0


def test_tiles_of_points_change_nothing():
    scene = ball_scene(Light.SPECULAR, "ppa")
    tracks = tracks_at(scene, scene.surface_points(40)[0])
    votes, voting = track_votes(tracks, scene.maps)
    in_tiles = track_votes(tracks, scene.maps, max_rows=7 * len(scene.maps))
    np.testing.assert_array_equal(in_tiles[0], votes)
    np.testing.assert_array_equal(in_tiles[1], voting)
    assert voting.sum() > 7
