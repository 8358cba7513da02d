"""Normals whose observations' light is open: exact, mixed, ambiguous, degenerate, and honest."""

import numpy as np
import pytest
from rows_of_points import errors_deg, simulate, tangents_of, unit

from polmvs.normals.mixture_estimator import (
    MixtureTolerances,
    _middle_directions,
    row_scales,
    solve_mixture,
)
from polmvs.normals.observations import PointObservations
from polmvs.polarization.light_mixture import phase_variance

NOISE = 0.004  # of s1 / s0


def observe(rows, rays, *, diffuse=None, dolp=0.1, noise=NOISE, rng=None):
    """Observations whose planes of incidence are these rows; ``diffuse`` (K, N) has the light."""
    shape = rows.shape[1:]
    diffuse = np.zeros(shape, bool) if diffuse is None else diffuse
    dolps = np.broadcast_to(np.asarray(dolp, float), shape)
    variance = np.full(shape, noise**2)
    if rng is not None:
        turn = 0.5 * noise / dolps * rng.standard_normal(shape)
        rows = np.cos(turn) * rows + np.sin(turn) * np.cross(rays, rows, axis=0)
    other = np.cross(rays, rows, axis=0)
    of_phase = phase_variance(dolps, variance)
    return PointObservations(
        rows=np.where(diffuse, np.stack([other, rows]), np.stack([rows, other])).astype(np.float32),
        rays=rays.astype(np.float32),
        turn_variances=np.stack([of_phase, of_phase]).astype(np.float32),
        dolp=dolps.astype(np.float32),
        dolp_variance=variance.astype(np.float32),
    )


def scene(num_rows, num_points, seed=0):
    """Exact rows, rays and normals of points seen from all around."""
    rng = np.random.default_rng(seed)
    _, rays, _, normals = simulate(num_rows, num_points, (1, 2), rng)
    return unit(np.cross(rays, normals[:, None], axis=0)), rays, normals, rng


def everyone(found):
    return np.ones(found.dolp.shape, bool)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_the_light_of_each_observation_is_told_with_the_normal(share):
    rows, rays, normals, rng = scene(10, 80)
    diffuse = rng.random(rows.shape[1:]) < share
    dolp = 0.03 if share else 0.2  # what diffuse light can have
    found = observe(rows, rays, diffuse=diffuse, dolp=dolp, noise=0.001)
    estimate = solve_mixture(found, everyone(found))
    assert estimate.valid.mean() > 0.95
    good = estimate.valid
    assert np.median(errors_deg(estimate, normals)[good]) < 0.2
    sure = np.abs(estimate.labels[:, good]) > 0.5
    assert sure.mean() > 0.8
    assert ((estimate.labels < 0) == diffuse)[:, good][sure].mean() > 0.97
    assert estimate.diffuse[good].mean() == pytest.approx(share, abs=0.15)


def test_two_planes_of_incidence_determine_nothing():
    """Their labels are open, and even where they are given either may be neither."""
    rows, rays, normals, _ = scene(4, 60)
    for num, prior, expected in ((2, 0.5, 0.0), (2, 1.0, 0.1), (4, 1.0, 0.9)):
        found = observe(rows[:, :num], rays[:, :num], dolp=0.03, noise=0.0005)
        estimate = solve_mixture(found, everyone(found), prior_specular=prior)
        assert estimate.valid.mean() == pytest.approx(expected, abs=0.15)
    assert np.median(errors_deg(estimate, normals)[estimate.valid]) < 0.5


def test_what_is_given_is_obeyed():
    rows, rays, normals, _ = scene(8, 40)
    found = observe(rows, rays, dolp=0.03, noise=0.001)
    given = solve_mixture(found, everyone(found), prior_specular=1.0)
    assert np.median(errors_deg(given, normals)) < 0.2
    assert (given.diffuse[given.valid] == 0).all()
    wrong = solve_mixture(found, everyone(found), prior_specular=0.0)
    assert not (errors_deg(wrong, normals)[wrong.valid] < 5).any()


def test_wrong_observations_are_neither():
    rows, rays, normals, rng = scene(12, 100)
    wrong = rng.random(rows.shape[1:]) < 0.25
    turn = np.where(wrong, rng.uniform(0.3, np.pi / 2 - 0.3, wrong.shape), 0)
    turned = np.cos(turn) * rows + np.sin(turn) * np.cross(rays, rows, axis=0)
    found = observe(turned, rays, dolp=0.3, noise=0.002)
    estimate = solve_mixture(found, everyone(found))
    errors = errors_deg(estimate, normals)[estimate.valid]
    assert estimate.valid.mean() > 0.9
    assert np.mean(errors < 1) > 0.97
    assert estimate.row_weights[wrong].mean() < 0.1 < 0.9 < estimate.row_weights[~wrong].mean()


def test_nothing_polarized_tells_nothing():
    rows, rays, _, rng = scene(10, 50)
    found = observe(rows, rays, dolp=NOISE * np.sqrt(2) * 1.05, rng=rng)
    estimate = solve_mixture(found, everyone(found))
    assert not estimate.valid.any()
    assert np.isnan(estimate.normals).all()
    assert np.isnan(estimate.dolp).all()


def test_centres_on_a_line_in_a_plane_with_the_normal_leave_it_open():
    """All planes of incidence are one: only their noise spreads the rows."""
    rng = np.random.default_rng(2)
    normals = unit(rng.standard_normal((3, 60)))
    across = tangents_of(normals)[0]
    zenith = np.radians(np.linspace(4, 20, 9))[:, None]
    rays = -np.cos(zenith) * normals[:, None] - np.sin(zenith) * across[:, None]
    rows = unit(np.cross(rays, normals[:, None], axis=0))
    found = observe(rows, rays, dolp=0.03, noise=0.001, rng=rng)
    estimate = solve_mixture(found, everyone(found), prior_specular=1.0)
    assert estimate.valid.mean() < 0.05


def test_what_most_views_contradict_is_no_normal():
    """Five of twelve planes meet in a normal, the others anywhere."""
    rows, rays, _, rng = scene(12, 60)
    wrong = np.arange(12)[:, None] >= 5
    turn = np.where(wrong, rng.uniform(0.35, 1.2, rows.shape[1:]), 0)
    turned = np.cos(turn) * rows + np.sin(turn) * np.cross(rays, rows, axis=0)
    found = observe(turned, rays, dolp=0.3, noise=0.002)
    assert solve_mixture(found, everyone(found)).valid.mean() < 0.1


def test_labels_that_may_be_otherwise_make_a_normal_unsure():
    """Two planes meet in four normals, as either may be of either light."""
    rows, rays, _, _ = scene(2, 60)
    found = observe(rows, rays, dolp=0.03, noise=0.0005)
    loose = MixtureTolerances(max_sigma_deg=1e3, min_rows=0.0)
    sigmas = [
        np.nanmedian(
            solve_mixture(found, everyone(found), prior_specular=prior, tolerances=loose).sigma_deg
        )
        for prior in (0.5, 1.0)
    ]
    assert sigmas[0] > 20
    assert sigmas[0] > 1.5 * sigmas[1]


def test_stated_deviations_cover_the_errors():
    """Of independent noise they are larger than needed: errors in common are allowed for."""
    rows, rays, normals, rng = scene(9, 400)
    found = observe(rows, rays, dolp=0.15, noise=0.01, rng=rng)
    estimate = solve_mixture(found, everyone(found))
    good = estimate.valid
    assert good.mean() > 0.9
    ratio = errors_deg(estimate, normals)[good] / estimate.sigma_deg[good]
    assert np.mean(ratio < 1) > 0.58
    assert np.mean(ratio < 2) > 0.9
    assert np.median(ratio) > 0.15


def test_a_wrong_view_counts_for_less():
    rows, rays, normals, rng = scene(8, 200)
    turn = np.where(np.arange(8)[:, None] == 3, 0.25, 0) * rng.choice([-1, 1], rows.shape[1:])
    turned = np.cos(turn) * rows + np.sin(turn) * np.cross(rays, rows, axis=0)
    found = observe(turned, rays, dolp=0.2, noise=0.008, rng=rng)
    first = solve_mixture(found, everyone(found))
    scales = row_scales(found, everyone(found), first)
    assert scales.of_views[3] > 2
    assert np.delete(scales.of_views, 3).max() < 1.5
    again = solve_mixture(found, everyone(found), scales=scales)
    before, after = (np.median(errors_deg(e, normals)[e.valid]) for e in (first, again))
    assert after < before


def test_a_view_that_is_not_known_to_see_a_point_counts_where_it_faces_it():
    rows, rays, _, _ = scene(8, 40)
    behind = np.arange(8)[:, None] == 7
    found = observe(rows, np.where(behind, -rays, rays), dolp=0.2, noise=0.002)
    matched = everyone(found) & (np.arange(8)[:, None] < 4)
    estimate = solve_mixture(found, matched)
    assert estimate.valid.mean() > 0.9
    assert (estimate.labels[7] == 0).all()
    assert np.mean(estimate.labels[6] > 0.5) > 0.9


def test_conditioning_is_the_spread_of_the_rows():
    """Rows of a normal turn about it: over an arc of 2 a their spreads are sin and cos of it."""
    num, arcs = 12, np.radians([10.0, 30.0, 45.0])
    angle = np.linspace(-1, 1, num)[:, None] * arcs
    rows = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)])
    tilt = np.radians(50)
    # Rays across their rows, tilted against the normal (0, 0, 1).
    across = np.stack([-np.sin(angle), np.cos(angle), np.zeros_like(angle)])
    rays = np.sin(tilt) * across - np.cos(tilt) * np.array([0, 0, 1])[:, None, None]
    found = observe(rows, rays, dolp=0.2, noise=0.001)
    estimate = solve_mixture(found, everyone(found))
    expected = np.sqrt((np.sin(angle) ** 2).mean(axis=0) / (np.cos(angle) ** 2).mean(axis=0))
    np.testing.assert_allclose(estimate.conditioning, expected, rtol=0.1)


@pytest.mark.parametrize("scale", [1e-200, 1e-20, 1.0, 1e20])
def test_the_least_known_direction_has_no_unit(scale):
    """Moments of known axes: the direction of the middle one, whatever the weights are."""
    rng = np.random.default_rng(0)
    axes = np.linalg.qr(rng.normal(size=(40, 3, 3)))[0]
    values = scale * np.array([1e-3, 1.0, 5.0])
    matrices = np.einsum("nik,k,njk->nij", axes, values, axes)
    moments = np.array(
        [matrices[:, i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))]
    )
    along = _middle_directions(moments, axes[:, :, 0].T, np.full(40, values[1]))
    np.testing.assert_allclose(np.abs((along.T * axes[:, :, 1]).sum(axis=1)), 1, atol=1e-9)
