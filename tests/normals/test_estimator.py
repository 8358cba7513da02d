"""Normals from rows: exact cases, honest deviations, outliers, and what cannot be solved."""

import numpy as np
import pytest
from rows_of_points import errors_deg, simulate, tangents_of, unit

from polmvs.normals.estimator import (
    CAUCHY_SCALE,
    EstimatorTolerances,
    smallest_eigenvectors,
    solve_normals,
)

ENTRIES = ([0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2])


@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize("num_rows", [2, 3, 10])
def test_exact_rows_give_the_normal_facing_the_cameras(robust, num_rows):
    rng = np.random.default_rng(0)
    rows, rays, sigma, normals = simulate(num_rows, 50, (1, 2), rng)
    rows = unit(np.cross(rays, normals[:, None], axis=0)) * rng.choice([-1, 1], sigma.shape)
    estimate = solve_normals(rows, rays, sigma, robust=robust)
    assert estimate.valid.all()
    np.testing.assert_allclose(estimate.normals.T, normals, atol=1e-7)
    np.testing.assert_allclose(estimate.residual, 0, atol=1e-7)
    assert (estimate.num_rows == num_rows).all()


@pytest.mark.parametrize("robust", [True, False])
def test_the_sign_of_rows_and_the_frame_do_not_matter(robust):
    rng = np.random.default_rng(1)
    rows, rays, sigma, _ = simulate(8, 20, (1, 2), rng)
    turn = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    turn *= np.linalg.det(turn)
    one = solve_normals(rows, rays, sigma, robust=robust)
    flipped = solve_normals(-rows, rays, sigma, robust=robust)
    turned = solve_normals(
        np.einsum("ij,jkn->ikn", turn, rows),
        np.einsum("ij,jkn->ikn", turn, rays),
        sigma,
        robust=robust,
    )
    np.testing.assert_allclose(flipped.normals, one.normals, atol=1e-9)
    np.testing.assert_allclose(turned.normals, one.normals @ turn.T, atol=1e-6)
    np.testing.assert_allclose(turned.sigma_deg, one.sigma_deg, rtol=1e-4)


@pytest.mark.parametrize("num_rows", [5, 10, 40])
def test_sigma_is_honest(num_rows):
    # Errors along both axes of the covariance, over their deviations, have unit variance.
    rows, rays, sigma, normals = simulate(num_rows, 4000, (0.3, 3), np.random.default_rng(2))
    estimate = solve_normals(rows, rays, sigma)
    assert estimate.valid.all()
    cosine = (rays * estimate.normals.T[:, None]).sum(axis=0)
    sin2 = np.maximum(1 - cosine**2, EstimatorTolerances().min_sin_zenith ** 2)
    weights = estimate.row_weights / (sigma**2 * sin2)
    precision = np.einsum("ikn,kn,jkn->nij", rows, weights, rows)
    values, axes = np.linalg.eigh(precision)
    along = np.einsum("ni,nij->nj", estimate.normals - normals.T, axes)[:, 1:]
    normalized = along * np.sqrt(values[:, 1:])
    np.testing.assert_allclose(normalized.var(axis=0), 1, atol=0.15)
    np.testing.assert_allclose(normalized.mean(axis=0), 0, atol=0.06)
    np.testing.assert_allclose(estimate.sigma_deg, np.degrees(values[:, 1] ** -0.5), rtol=0.05)


def simulate_arc(num_rows, num_points, sigma_deg, arc_deg, rng):
    """As :func:`simulate`, with planes of incidence that lie within a short arc."""
    shape = (num_rows, num_points)
    normals = unit(rng.standard_normal((3, num_points)))
    zenith = np.radians(rng.uniform(20, 70, shape))
    azimuth = np.radians(arc_deg) * np.linspace(-0.5, 0.5, num_rows)[:, None]
    first, second = tangents_of(normals)
    across = np.cos(azimuth) * first[:, None] + np.sin(azimuth) * second[:, None]
    rays = -np.cos(zenith) * normals[:, None] - np.sin(zenith) * across
    rows = unit(np.cross(rays, normals[:, None], axis=0))
    sigma = np.full(shape, np.radians(sigma_deg))
    turn = sigma * rng.standard_normal(shape)
    rows = np.cos(turn) * rows + np.sin(turn) * np.cross(rays, rows, axis=0)
    return rows, rays, sigma, normals


@pytest.mark.parametrize("num_rows", [10, 20])
def test_noise_in_short_arcs_is_no_spread_and_draws_no_normal(num_rows):
    """Noise parts rows of one plane of incidence as well; half of all were within a deviation."""
    rows, rays, sigma, normals = simulate_arc(num_rows, 3000, 1.0, 10.0, np.random.default_rng(5))
    estimate = solve_normals(rows, rays, sigma)
    assert estimate.valid.mean() > 0.99
    ratio = errors_deg(estimate, normals) / estimate.sigma_deg
    assert 0.64 < np.nanmean(ratio < 1) < 0.75
    assert np.nanmean(ratio < 2) > 0.93
    towards = (normals.T * np.einsum("ikn->ni", rays)).sum(axis=1)
    found = (estimate.normals * np.einsum("ikn->ni", rays)).sum(axis=1)
    drawn = np.degrees(found - towards) / num_rows  # about the angle between them
    assert abs(np.nanmedian(drawn)) < 0.25 * np.nanmedian(estimate.sigma_deg)


def test_sigma_of_the_algebraic_estimator_is_that_of_unit_weights():
    rows, rays, sigma, normals = simulate(10, 4000, (0.3, 3), np.random.default_rng(3))
    estimate = solve_normals(rows, rays, sigma, robust=False)
    ratio = np.mean(errors_deg(estimate, normals) ** 2) / np.mean(estimate.sigma_deg**2)
    assert 0.9 < ratio < 2.1  # one axis of the covariance, or two alike


def test_weights_gain_over_the_eigenvector():
    rows, rays, sigma, normals = simulate(10, 2000, (0.3, 5), np.random.default_rng(4))
    robust = errors_deg(solve_normals(rows, rays, sigma), normals)
    algebraic = errors_deg(solve_normals(rows, rays, sigma, robust=False), normals)
    assert robust.mean() < 0.6 * algebraic.mean()


def simulate_rail(num_rows, num_points, sigma_deg, rng, off_deg=0.0):
    """As :func:`simulate`, the cameras on a line whose plane with the point holds its normal.

    ``off_deg``: the angle by which the normal lies off that plane.
    """
    shape = (num_rows, num_points)
    normals = unit(rng.standard_normal((3, num_points)))
    zenith = np.radians(rng.uniform(-60, 60, shape))
    along, across = tangents_of(normals)
    middle = np.cos(np.radians(off_deg)) * normals + np.sin(np.radians(off_deg)) * across
    rays = -np.cos(zenith) * middle[:, None] - np.sin(zenith) * along[:, None]
    rows = unit(np.cross(rays, normals[:, None], axis=0))
    sigma = np.full(shape, np.radians(sigma_deg))
    turn = sigma * rng.standard_normal(shape)
    rows = np.cos(turn) * rows + np.sin(turn) * np.cross(rays, rows, axis=0)
    return rows, rays, sigma, normals


@pytest.mark.parametrize("robust", [True, False])
@pytest.mark.parametrize("num_rows", [3, 6, 16])
@pytest.mark.parametrize("sigma_deg", [0.5, 3.0])
def test_a_direction_left_open_is_no_normal(sigma_deg, num_rows, robust):
    """Centres and normal in one plane, as on a linear rail: only noise parts the rows."""
    rng = np.random.default_rng(13)
    rows, rays, sigma, _ = simulate_rail(num_rows, 1000, sigma_deg, rng)
    assert solve_normals(rows, rays, sigma, robust=robust).valid.mean() < 0.01


@pytest.mark.parametrize("off_deg", [15.0, 30.0])
def test_a_rail_that_looks_aside_tells_its_own_deviation(off_deg):
    rng = np.random.default_rng(14)
    rows, rays, sigma, normals = simulate_rail(16, 1000, 1.0, rng, off_deg)
    estimate = solve_normals(rows, rays, sigma)
    assert estimate.valid.mean() > 0.99
    ratio = errors_deg(estimate, normals)[estimate.valid] / estimate.sigma_deg[estimate.valid]
    # The median of |x| is 0.67 with unit deviation along one axis, 1.18 along two.
    assert 0.6 < np.median(ratio) < 1.25


def test_two_survivors_of_more_rows_are_no_normal():
    """Any two rows have a normal in common; that two of many do says nothing."""
    rng = np.random.default_rng(15)
    rows, rays, sigma, normals = simulate(2, 500, (0.3, 1), rng)
    assert solve_normals(rows, rays, sigma).valid.mean() > 0.99  # two were given
    wrong = np.cross(rays, rows, axis=0)  # a quarter turn off
    estimate = solve_normals(
        np.concatenate([rows, wrong], axis=1),
        np.concatenate([rays, rays], axis=1),
        np.concatenate([sigma, 0.01 * sigma], axis=0) * [[1], [1], [1], [1]],
        initial_normals=normals,
    )
    assert not (estimate.valid & (estimate.num_rows < 3)).any()


@pytest.mark.parametrize(("num_rows", "max_failures"), [(10, 0.03), (30, 0.002)])
def test_three_outliers_in_ten_are_tolerated(num_rows, max_failures):
    rng = np.random.default_rng(5)
    rows, rays, sigma, normals = simulate(num_rows, 2000, (0.3, 3), rng, outliers=0.3)
    clean = simulate(num_rows, 2000, (0.3, 3), rng)
    estimate = solve_normals(rows, rays, sigma)
    errors = errors_deg(estimate, normals)
    assert np.mean(errors > 5) < max_failures
    assert np.mean(np.isnan(errors)) < 0.02
    assert np.nanmedian(errors) < 1.6 * np.median(errors_deg(solve_normals(*clean[:3]), clean[3]))
    assert np.median(estimate.row_weights[:, errors < 1]) > 0.5


@pytest.mark.parametrize("num_unseen", [3, 30])
def test_rows_that_do_not_count_waste_no_start(num_unseen):
    """Views that do not see a point change nothing where others are wrong: each start is the same.

    A third of the rows is wrong, so that points are started again from pairs of rows.
    """
    rng = np.random.default_rng(5)
    rows, rays, sigma, normals = simulate(9, 300, (0.3, 1), rng, outliers=0.33)
    alone = solve_normals(rows, rays, sigma)
    shape = (3, num_unseen, 300)
    unseen = np.full(shape, np.nan), np.broadcast_to(rays[:, :1], shape)
    among = solve_normals(
        np.concatenate([unseen[0], rows], axis=1),
        np.concatenate([unseen[1], rays], axis=1),
        np.concatenate([np.full(shape[1:], np.inf), sigma]),
    )
    np.testing.assert_array_equal(among.valid, alone.valid)
    np.testing.assert_allclose(among.normals, alone.normals, atol=1e-9)
    assert np.nanmedian(errors_deg(alone, normals)) < 1


def test_row_weights_tell_the_outlier():
    rows, rays, sigma, normals = simulate(10, 200, (0.5, 1), np.random.default_rng(6))
    rows[:, 3] = np.cross(rays[:, 3], rows[:, 3], axis=0)  # a quarter turn
    estimate = solve_normals(rows, rays, sigma)
    assert (estimate.row_weights[3] < 0.02).all()
    assert (estimate.num_rows <= 9).all()
    assert errors_deg(estimate, normals).max() < 3


def test_a_view_from_behind_is_left_out():
    rows, rays, sigma, normals = simulate(9, 100, (0.5, 1), np.random.default_rng(7))
    rays[:, 0] *= -1
    rows[:, 0] = np.cross(rays[:, 0], rows[:, 0], axis=0)
    estimate = solve_normals(rows, rays, sigma)
    assert (estimate.row_weights[0] == 0).all()
    assert errors_deg(estimate, normals).max() < 3


def test_known_normals_tell_which_of_two_parties_sees_the_point():
    # Two cameras on either side: without a start it is a draw, with one it is not.
    rows, rays, sigma, normals = simulate(4, 100, (0.2, 0.3), np.random.default_rng(8))
    rays[:, 2:] *= -1
    rows[:, 2:] = np.cross(rays[:, 2:], rows[:, 2:], axis=0)
    estimate = solve_normals(rows, rays, sigma, initial_normals=normals)
    assert errors_deg(estimate, normals).max() < 4


def test_nan_rows_and_infinite_sigmas_do_not_count():
    rows, rays, sigma, _ = simulate(6, 30, (0.5, 1), np.random.default_rng(9))
    expected = solve_normals(rows[:, :4], rays[:, :4], sigma[:4])
    rows[:, 4] = np.nan
    sigma[5] = np.inf
    for robust in (True, False):
        estimate = solve_normals(rows, rays, sigma, robust=robust)
        assert (estimate.row_weights[4:] == 0).all()
        assert (estimate.num_rows <= 4).all()
    np.testing.assert_allclose(solve_normals(rows, rays, sigma).normals, expected.normals)


def assert_no_normal(estimate):
    assert not estimate.valid.any()
    assert np.isnan(estimate.normals).all()
    assert np.isnan(estimate.sigma_deg).all()


@pytest.mark.parametrize("robust", [True, False])
class TestDegenerate:
    def test_one_view(self, robust):
        rows, rays, sigma, _ = simulate(1, 5, (1, 2), np.random.default_rng(10))
        assert_no_normal(solve_normals(rows, rays, sigma, robust=robust))

    def test_no_row_at_all(self, robust):
        rows, rays, sigma, _ = simulate(3, 5, (1, 2), np.random.default_rng(11))
        estimate = solve_normals(np.full_like(rows, np.nan), rays, sigma, robust=robust)
        assert_no_normal(estimate)
        assert (estimate.num_rows == 0).all()
        assert (estimate.conditioning == 0).all()

    def test_rows_of_rank_one(self, robust):
        # A camera that moves towards the point, or turns about the ray: one plane of incidence.
        rows, rays, sigma, normals = simulate(6, 20, (1, 2), np.random.default_rng(12))
        rays[:] = rays[:, :1]
        rows[:] = unit(np.cross(rays, normals[:, None], axis=0))
        estimate = solve_normals(rows, rays, sigma, robust=robust)
        assert_no_normal(estimate)
        assert (estimate.conditioning < 1e-4).all()

    def test_cameras_in_one_plane_of_incidence(self, robust):
        # Moving within it adds nothing: all rows are its normal.
        rows, rays, sigma, normals = simulate(6, 20, (1, 2), np.random.default_rng(13))
        across = unit(rays[:, 0] + 0.7 * normals)
        share = np.linspace(0.2, 0.8, 6)[:, None]
        rays[:] = unit(-normals[:, None] * (1 - share) - across[:, None] * share)
        rows[:] = unit(np.cross(rays, normals[:, None], axis=0))
        assert_no_normal(solve_normals(rows, rays, sigma, robust=robust))

    def test_a_good_point_beside_bad_ones_is_solved(self, robust):
        rows, rays, sigma, normals = simulate(6, 3, (0.1, 0.2), np.random.default_rng(14))
        rows[:, :, 0] = rows[:, :1, 0]
        rows[:, :, 2] = np.nan
        estimate = solve_normals(rows, rays, sigma, robust=robust)
        assert estimate.valid.tolist() == [False, True, False]
        assert errors_deg(estimate, normals)[1] < 1


def test_float32_is_enough():
    rows, rays, sigma, _ = simulate(10, 500, (0.3, 3), np.random.default_rng(15))
    exact = solve_normals(rows, rays, sigma)
    single = solve_normals(*(a.astype(np.float32) for a in (rows, rays, sigma)))
    assert np.abs(single.normals - exact.normals).max() < 1e-4


def test_shapes_are_checked():
    rows, rays, sigma, _ = simulate(3, 5, (1, 2), np.random.default_rng(16))
    with pytest.raises(ValueError, match=r"rows\.shape"):
        solve_normals(rows[:, :, :4], rays, sigma)
    with pytest.raises(ValueError, match=r"sigma\.shape"):
        solve_normals(rows, rays, sigma[:2])


def eigen_pairs(matrices):
    return smallest_eigenvectors(np.array([m[ENTRIES] for m in matrices]).T)


def test_smallest_eigenvectors_are_those_of_lapack():
    factors = np.random.default_rng(17).standard_normal((300, 3, 3))
    scale = np.logspace(-6, 6, 300)[:, None, None]
    matrices = scale * factors @ factors.swapaxes(1, 2)
    values, vectors = eigen_pairs(matrices)
    expected, expected_vectors = np.linalg.eigh(matrices)
    size = expected[:, -1]
    np.testing.assert_allclose(values.T / size[:, None], expected / size[:, None], atol=1e-12)
    # The vector is as well determined as the gap to the next eigenvalue allows.
    gap = (expected[:, 1] - expected[:, 0]) / size
    cosine = np.abs((vectors.T * expected_vectors[:, :, 0]).sum(axis=1))
    assert (np.sqrt(np.maximum(1 - cosine**2, 0)) * gap < 1e-7).all()
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=0), 1, rtol=1e-12)


def test_double_and_triple_eigenvalues_give_a_unit_vector_of_their_space():
    axes = np.linalg.qr(np.random.default_rng(18).standard_normal((3, 3)))[0]
    diagonals = [(1, 1, 3), (1, 3, 3), (2, 2, 2), (0, 0, 0), (0, 0, 1), (0, 1, 1)]
    matrices = [axes @ np.diag(d) @ axes.T for d in np.array(diagonals, float)]
    values, vectors = eigen_pairs(matrices)
    np.testing.assert_allclose(values.T, diagonals, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(vectors, axis=0), 1, rtol=1e-9)
    for matrix, value, vector in zip(matrices, values[0], vectors.T, strict=True):
        if np.ptp(np.linalg.eigvalsh(matrix)) > 0 and np.linalg.eigvalsh(matrix)[1] > value + 0.1:
            np.testing.assert_allclose(matrix @ vector, value * vector, atol=1e-7)


def test_the_cauchy_scale_is_the_one_of_95_percent_efficiency():
    z = np.random.default_rng(19).standard_normal(400_000)
    weight = 1 / (1 + (z / CAUCHY_SCALE) ** 2)
    slope = weight**2 * (1 - (z / CAUCHY_SCALE) ** 2)
    efficiency = slope.mean() ** 2 / np.square(z * weight).mean()
    assert efficiency == pytest.approx(0.95, abs=0.005)
