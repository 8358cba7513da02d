"""Neighbours of a view: those that see its places, from directions far apart."""

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.normals.estimator import solve_normals
from polmvs.polarization.phase_map import PhaseMap
from polmvs.polarization.region import Region
from polmvs.scene import Seeds
from polmvs.surface.view_selection import choose_neighbors
from polmvs.synthetic.captures import ring_of_views

CAMERA = PinholeCamera(width=32, height=24, fx=40.0, fy=40.0, cx=16.0, cy=12.0)
NUM_VIEWS = 90


def maps_of(views):
    """Views whose whole image shows a surface."""
    inside = np.ones((CAMERA.height, CAMERA.width), bool)
    region = Region(inside, inside, ~inside)
    samples = np.zeros((*inside.shape, 3), np.float32)
    dolp = np.zeros(inside.shape, np.uint8)
    polarization = np.zeros((*inside.shape, 4), np.float32)
    return [
        PhaseMap(v, region, samples, samples[..., 0], ~inside, dolp, polarization) for v in views
    ]


def seeds_at(center, num=20):
    offsets = np.random.default_rng(0).uniform(-0.02, 0.02, (num, 3)) * [1, 1, 0]
    normals = np.tile([0.0, 0.0, 1.0], (num, 1))
    return Seeds(center + offsets, normals, np.full(num, 1e-4))


@pytest.fixture(scope="module")
def views():
    return ring_of_views(NUM_VIEWS, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=45)


def sigma_deg(views, chosen):
    """Deviation of the normal of a point that the chosen views see, one degree a row."""
    rays = -np.array([views[j].center_in_world for j in chosen]).T[..., None]
    rays /= np.linalg.norm(rays, axis=0)
    rows = np.cross(rays, [[[0.0]], [[0.0]], [[1.0]]], axis=0)
    rows /= np.linalg.norm(rows, axis=0)
    sigma = np.full(rows.shape[1:], np.radians(1))
    return solve_normals(rows, rays, sigma).sigma_deg[0]


def test_neighbors_of_a_dense_ring_look_from_all_sides(views):
    """All views share all seeds: taken by index they would look from one side alone."""
    neighbors = choose_neighbors(maps_of(views), seeds_at(np.zeros(3)), 6)
    best = sigma_deg(views, range(0, NUM_VIEWS, NUM_VIEWS // 7))
    assert sigma_deg(views, range(7)) > 3 * best
    for k in (0, 40, 89):
        assert neighbors[k][0] == k
        assert len(set(neighbors[k])) == 7
        assert sigma_deg(views, neighbors[k]) < 1.2 * best


def test_views_of_other_places_are_no_neighbors(views):
    away = ring_of_views(30, CAMERA, target=np.array([2.0, 0, 0]), distance=0.5, elevation_deg=60)
    neighbors = choose_neighbors(maps_of([*away, *views]), seeds_at(np.zeros(3)), 8)
    assert min(neighbors[30]) >= 30


def test_a_view_without_seeds_is_helped_by_those_that_see_some(views):
    [away] = ring_of_views(1, CAMERA, target=np.array([2.0, 0, 0]), distance=0.5)
    neighbors = choose_neighbors(maps_of([away, away, *views]), seeds_at(np.zeros(3)), 8)
    assert neighbors[0][0] == 0
    assert 1 not in neighbors[0]


def test_few_views_are_all_taken(views):
    some = views[::30]
    assert [sorted(n) for n in choose_neighbors(maps_of(some), seeds_at(np.zeros(3)), 8)] == [
        [0, 1, 2]
    ] * 3
    none = Seeds(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert [len(n) for n in choose_neighbors(maps_of(some), none, 8)] == [3] * 3
