"""The bias of a surface that sparse points show."""

from functools import partial

import numpy as np
import pytest
from analytic_objects import extracted

from polmvs.surface.mesh_geometry import TriangleMesh
from polmvs.surface.phase_bias import MAX_POINTS, MIN_POINTS, find_bias
from polmvs.surface.terms import KnownPoints

GSD = 0.01
SIGMA = 0.3 * GSD  # of a point
THICKNESS = 0.2


def plate(points):
    """A plate of 2 x 2, 20 GSD thick."""
    half = np.array([1.0, 1.0, 0.5 * THICKNESS])
    return np.max(np.abs(points) - half, axis=-1)


@pytest.fixture(scope="module")
def mesh() -> TriangleMesh:
    return extracted(plate, half=1.2, step=0.05)


@pytest.fixture
def on_top(mesh):
    inside = np.all(np.abs(mesh.vertices[:, :2]) < 0.8, axis=1)
    return inside & (mesh.vertices[:, 2] > 0.4 * THICKNESS)


def bias_at(x):
    """A wave of 1.5 GSD and a length of 2."""
    return 1.5 * GSD * np.cos(np.pi * x / 2)


def points_above(height, *, num=60, seed=0):
    """Points over the top of the plate with an error of ``SIGMA``, as they are triangulated."""
    rng = np.random.default_rng(seed)
    places = rng.uniform(-0.9, 0.9, (num, 3))
    places[:, 2] = 0.5 * THICKNESS + height(places[:, 0]) + rng.normal(0, SIGMA, num)
    return KnownPoints(places, np.full(num, SIGMA))


def found_in(mesh, known, *, seen=None):
    seen = np.ones(len(mesh.faces), np.bool_) if seen is None else seen
    return find_bias(mesh, seen, known, GSD, gate_px=4.0)


def test_points_that_show_a_smooth_bias_give_it_everywhere_between_them(mesh, on_top):
    bias = found_in(mesh, points_above(bias_at))
    off = bias.heights[on_top] - bias_at(mesh.vertices[on_top, 0])
    # 60 points of 0.42 GSD (theirs and the least one) and a few degrees of freedom: 0.15 GSD.
    assert np.sqrt(np.mean(off**2)) < 0.2 * GSD
    assert np.mean(np.abs(off) < 2 * bias.sigma[on_top]) > 0.8
    assert bias.sigma[on_top].max() < 0.5 * GSD


def test_the_other_side_of_a_wall_has_a_bias_of_its_own(mesh):
    bias = found_in(mesh, points_above(bias_at))
    below = np.all(np.abs(mesh.vertices[:, :2]) < 0.8, axis=1) & (mesh.vertices[:, 2] < 0)
    np.testing.assert_allclose(bias.heights[below], 0, atol=1e-6 * GSD)
    assert bias.sigma[below].min() > 0.5 * GSD


@pytest.mark.parametrize("seed", range(5))
def test_points_that_only_noise_moves_show_none(mesh, seed):
    bias = found_in(mesh, points_above(np.zeros_like, seed=seed))
    assert bias is None or np.abs(bias.heights).max() < 0.3 * GSD


def test_few_false_points_do_not_make_one(mesh, on_top):
    known = points_above(bias_at)
    known.points[::10, 2] += 3 * GSD
    bias = found_in(mesh, known)
    off = bias.heights[on_top] - bias_at(mesh.vertices[on_top, 0])
    assert np.sqrt(np.mean(off**2)) < 0.6 * GSD


def test_points_far_from_the_surface_and_of_unseen_faces_are_of_another(mesh):
    far = points_above(lambda x: np.full_like(x, 6 * GSD))
    assert found_in(mesh, far) is None
    below = mesh.face_normals[:, 2] < -0.5
    assert found_in(mesh, points_above(bias_at), seen=below) is None


def test_too_few_points_show_none(mesh):
    found = partial(found_in, mesh)
    assert found(points_above(bias_at, num=MIN_POINTS - 1)) is None
    assert found(KnownPoints(np.zeros((0, 3)), np.zeros(0))) is None


def test_points_of_unknown_position_count_for_nothing(mesh):
    known = points_above(bias_at)
    known.sigma[MIN_POINTS - 1 :] = np.inf
    assert found_in(mesh, known) is None


def test_more_points_than_its_time_allows_are_thinned_evenly(mesh, on_top):
    bias = found_in(mesh, points_above(bias_at, num=4 * MAX_POINTS))
    off = bias.heights[on_top] - bias_at(mesh.vertices[on_top, 0])
    assert np.sqrt(np.mean(off**2)) < 0.1 * GSD
