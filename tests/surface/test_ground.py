"""The plane on which objects stand, and its relief, from sparse points."""

import numpy as np
import pytest
from analytic_objects import ring_of_views

from polmvs.camera import pixel_centers
from polmvs.geometry import lengths
from polmvs.surface.ground import SupportingPlane, find_ground, supporting_plane

TABLE = SupportingPlane(np.array([0.0, 0.0, 1.0]), 0.0, tolerance=0.03)
NOISE = 0.002


def plane_scene(rng, share):
    on = rng.uniform(-2, 2, (300, 3)) * [1, 1, 0] + [0, 0, -1]
    off = rng.uniform(-2, 2, (round(300 / share) - 300, 3)) + np.array([0, 0, 2.5])
    return np.concatenate([on + 0.002 * rng.standard_normal(on.shape), off])


def test_the_plane_of_the_surroundings_is_found_among_other_points():
    rng = np.random.default_rng(0)
    centers = np.array([view.center_in_world for view in ring_of_views()])
    plane = supporting_plane(plane_scene(rng, 0.5), centers)
    assert plane is not None
    assert plane.normal @ [0, 0, 1.0] > 0.9999
    assert plane.height(np.array([[0, 0, -1.0]])) == pytest.approx(0, abs=2e-3)
    assert plane.height(centers).min() > 0


def test_no_plane_without_support():
    rng = np.random.default_rng(0)
    centers = np.array([view.center_in_world for view in ring_of_views()])
    assert supporting_plane(rng.uniform(-2, 2, (400, 3)), centers) is None
    assert supporting_plane(np.zeros((3, 3)), centers) is None
    below = centers * [1, 1, -1]
    mixed = np.concatenate([centers[:5], below[5:]])
    assert supporting_plane(plane_scene(rng, 0.9), mixed) is None


def hills(places: np.ndarray) -> np.ndarray:
    """Heights (N,) of an uneven ground at places (N, 2)."""
    return 0.05 * np.sin(2.5 * places[:, 0]) * np.cos(2 * places[:, 1] + 1)


def points_on_hills(rng: np.random.Generator, num: int) -> np.ndarray:
    places = rng.uniform(-2, 2, (num, 2))
    return np.column_stack([places, hills(places) + NOISE * rng.standard_normal(num)])


def test_the_relief_is_found_between_points_and_outliers():
    rng = np.random.default_rng(1)
    points = points_on_hills(rng, 3000)
    outliers = rng.uniform(-2, 2, (600, 3)) * [1, 1, 0.05]
    ground = find_ground(np.concatenate([points, outliers]), TABLE)
    there = rng.uniform(-1.8, 1.8, (500, 2))
    error = ground.height(np.column_stack([there, np.zeros(500)])) - hills(there)
    # A window holds some ten points or more: less than the noise of one. The plane errs by 0.02.
    assert np.median(np.abs(error)) < NOISE
    assert np.quantile(np.abs(error), 0.95) < 0.01


def test_a_plane_has_no_relief():
    rng = np.random.default_rng(2)
    points = rng.uniform(-2, 2, (2000, 3)) * [1, 1, 0] + NOISE * rng.standard_normal((2000, 3))
    ground = find_ground(points, TABLE)
    assert np.abs(ground.relief).max() < 0.2 * NOISE
    assert find_ground(points + np.array([0, 0, 1.0]), TABLE).is_flat
    assert find_ground(np.zeros((0, 3)), TABLE).is_flat


@pytest.mark.parametrize("is_flat", [True, False])
def test_rays_meet_the_ground(is_flat):
    points = points_on_hills(np.random.default_rng(3), 3000)
    ground = find_ground(points[:0] if is_flat else points, TABLE)
    view = ring_of_views()[0]
    xy = pixel_centers(view.camera.width, view.camera.height)[::7, ::7].reshape(-1, 2)
    there = ground.seen_at(view, xy)
    rays, center = view.rays_in_world(xy), view.center_in_world
    known = np.isfinite(there).all(axis=1)
    assert (known == (rays[:, 2] < 0)).all()
    known &= (np.abs(there) < 1.9).all(axis=1)
    assert known.sum() > 100
    away = there[known] - center
    assert np.allclose(away / lengths(away)[:, None], rays[known])
    assert np.allclose(there[known, 2], ground.height(there[known]), atol=1e-3)


def test_the_ground_and_not_the_tops_of_boxes_on_it_is_the_plane():
    """An uneven ground has fewer points in one plane than boxes have on their tops."""
    rng = np.random.default_rng(4)
    ground = points_on_hills(rng, 300)
    tops = rng.uniform(-2, 2, (200, 3)) * [1, 1, 0] + [0, 0, 0.3]
    centers = np.array([view.center_in_world for view in ring_of_views()])
    plane = supporting_plane(np.concatenate([ground, tops]), centers)
    assert plane is not None
    assert abs(plane.height(np.zeros((1, 3)))[0]) < 0.05
    assert plane.normal @ [0, 0, 1.0] > 0.999
