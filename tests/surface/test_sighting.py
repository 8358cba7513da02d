"""What one dense view says about points of another."""

from dataclasses import replace

import numpy as np
import pytest
from true_views import BALL, BOARD, SIGMA, scene_of, true_samples, true_view

from polmvs.surface.fusion import hidden_by, sight


def sighted(scene, dense, away=0.0, turn=None):
    """Sighting of the second view on the first one's true points, moved away from it."""
    samples, _ = true_samples(scene, 0)
    normals = samples.normals if turn is None else samples.normals @ turn.T
    distance = np.exp(samples.log_range)
    sighting = sight(
        scene.maps[1],
        dense,
        scene.views[0].center_in_world,
        samples.rays_in_world,
        distance + away,
        normals,
    )
    return samples, distance, sighting


@pytest.mark.parametrize("surface", [BOARD, BALL], ids=["plane", "sphere"])
@pytest.mark.parametrize("stride", [2, 8])
def test_the_true_surface_is_met_where_it_is(surface, stride):
    """Exactly, on spheres too: planes through the other's points would be met outside of them."""
    scene = scene_of(surface)
    _, distance, sighting = sighted(scene, true_view(scene, 1, stride))
    met = np.isfinite(sighting.place)
    assert met.sum() > 0.6 * len(distance)
    np.testing.assert_allclose(sighting.place[met], distance[met], rtol=3e-6)
    assert (sighting.cosine[met] > 0.99).mean() > 0.7


def test_a_point_away_from_the_surface_is_sent_back_to_it():
    scene = scene_of(BOARD)
    _, distance, sighting = sighted(scene, true_view(scene, 1), away=0.02)
    met = np.isfinite(sighting.place)
    assert met.sum() > 500
    np.testing.assert_allclose(sighting.place[met], distance[met], rtol=3e-6)
    # Farther from the first view: behind the surface that the other sees.
    assert (sighting.excess[met] < -0.005).all()
    _, _, before = sighted(scene, true_view(scene, 1), away=-0.02)
    assert (before.excess[np.isfinite(before.place)] > 0.005).all()


def test_a_deviation_counts_along_the_first_views_ray():
    scene = scene_of(BOARD)
    samples, distance, sighting = sighted(scene, true_view(scene, 1))
    met = np.isfinite(sighting.place)
    slant = np.abs((samples.rays_in_world * samples.normals).sum(axis=-1))
    to_point = scene.views[0].center_in_world + distance[:, None] * samples.rays_in_world
    other_range = np.linalg.norm(to_point - scene.views[1].center_in_world, axis=-1)
    expected = SIGMA * other_range / slant
    np.testing.assert_allclose(sighting.sigma[met], expected[met], rtol=0.02)


def test_normals_and_facing_are_those_of_the_point():
    scene = scene_of(BOARD)
    axis = np.array([[1, 0, 0], [0, np.cos(0.3), -np.sin(0.3)], [0, np.sin(0.3), np.cos(0.3)]])
    samples, distance, sighting = sighted(scene, true_view(scene, 1), turn=axis)
    met = np.isfinite(sighting.place)
    turned = samples.normals @ axis.T
    np.testing.assert_allclose(
        sighting.cosine[met], (samples.normals * turned).sum(-1)[met], atol=1e-5
    )
    np.testing.assert_allclose(sighting.normals[met], samples.normals[met], atol=1e-5)
    points = scene.views[0].center_in_world + distance[:, None] * samples.rays_in_world
    to_other = scene.views[1].center_in_world - points
    to_other /= np.linalg.norm(to_other, axis=-1, keepdims=True)
    np.testing.assert_allclose(sighting.facing, (to_other * turned).sum(-1), atol=1e-6)


def test_a_view_that_knows_nothing_says_nothing():
    scene = scene_of(BOARD)
    full = true_view(scene, 1)
    empty = replace(
        full,
        range_map=np.zeros_like(full.range_map),
        normals_in_world=np.full_like(full.normals_in_world, np.nan),
        sigma=np.full_like(full.sigma, np.nan),
    )
    _, _, sighting = sighted(scene, empty)
    assert np.isnan(sighting.place).all()
    assert np.isnan(sighting.excess).all()
    assert (sighting.normals == 0).all()


def test_outside_is_what_the_image_shows_beside_the_region():
    scene = scene_of(BOARD)
    view, other = scene.views[0], scene.maps[1]
    centre = np.zeros(3)
    beside = np.array([0.16, 0.0, -0.016])  # in the image, past the board's edge
    far = np.array([3.0, 0.0, 0.0])
    behind = other.view.center_in_world * 2
    points = np.array([centre, beside, far, behind])
    to_point = points - view.center_in_world
    distance = np.linalg.norm(to_point, axis=-1)
    normals = np.broadcast_to([0.0, 0.0, 1.0], (4, 3))
    sighting = sight(
        other,
        true_view(scene, 1),
        view.center_in_world,
        to_point / distance[:, None],
        distance,
        normals,
    )
    np.testing.assert_array_equal(sighting.outside, [False, True, False, False])
    assert np.isnan(sighting.place[2:]).all()


def test_what_lies_behind_another_surface_is_hidden():
    scene = scene_of(BOARD)
    dense, view = true_view(scene, 0), scene.views[0]
    samples, _ = true_samples(scene, 0)
    points = view.center_in_world + np.exp(samples.log_range)[:, None] * samples.rays_in_world
    assert not hidden_by(dense, view, points, samples.normals).any()
    left = samples.xy[:, 0] < 80
    nearer = view.center_in_world + 0.9 * (points[left] - view.center_in_world)
    hidden = hidden_by(dense, view, nearer, samples.normals[left])
    columns = np.arange(hidden.shape[1]) * dense.stride_px + 1 < 80
    np.testing.assert_array_equal(hidden, dense.known & columns)
    # What shows the view its back, or lies farther off, hides nothing.
    assert not hidden_by(dense, view, nearer, -samples.normals[left]).any()
    farther = view.center_in_world + 1.1 * (points - view.center_in_world)
    assert not hidden_by(dense, view, farther, samples.normals).any()
