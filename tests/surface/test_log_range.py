import numpy as np
import pytest

from polmvs.surface.log_range import Edges, SeedTies, log_range_increment, solve_log_ranges

RNG = np.random.default_rng(0)


def chain(num, delta=0.01, sigma=0.001):
    tail = np.arange(num - 1)
    ones = np.ones(num - 1)
    return Edges(tail=tail, head=tail + 1, delta=delta * ones, sigma=sigma * ones)


def ties(nodes, values, sigma=0.001):
    nodes = np.asarray(nodes, np.int64)
    return SeedTies(
        node=nodes,
        seed=np.arange(len(nodes)),
        value=np.asarray(values, float),
        sigma=np.full(len(nodes), sigma),
    )


def test_the_increment_is_exact_on_a_plane():
    normal = np.array([0.2, -0.4, -0.9])
    rays = RNG.normal(size=(2, 50, 3)) * 0.2 + [0, 0, 1]
    rays /= np.linalg.norm(rays, axis=-1, keepdims=True)
    ranges = -1.5 / (rays @ normal)
    step = log_range_increment(normal, rays[0], rays[1])
    np.testing.assert_allclose(step, np.log(ranges[1] / ranges[0]), atol=1e-12)


def test_one_seed_fixes_a_chain():
    solution = solve_log_ranges(20, chain(20), ties([4], [0.5]), 1)
    np.testing.assert_allclose(solution.log_range, 0.5 + 0.01 * (np.arange(20) - 4), atol=1e-9)


def test_a_wrong_seed_loses():
    solution = solve_log_ranges(
        50, chain(50), ties([5, 15, 25, 35, 45], [0.05, 0.15, 0.75, 0.35, 0.45]), 5
    )
    np.testing.assert_allclose(solution.log_range, 0.01 * np.arange(50), atol=0.01)
    assert solution.seed_weight[2] < 0.05
    assert solution.seed_weight[[0, 1, 3, 4]].min() > 0.5


def test_nodes_that_no_seed_reaches_are_nan():
    edges = chain(20)
    keep = edges.tail != 9
    edges = Edges(
        tail=edges.tail[keep],
        head=edges.head[keep],
        delta=edges.delta[keep],
        sigma=edges.sigma[keep],
    )
    solution = solve_log_ranges(20, edges, ties([2], [0.0]), 1)
    assert np.isfinite(solution.log_range[:10]).all()
    assert np.isnan(solution.log_range[10:]).all()


def test_no_seed_at_all():
    solution = solve_log_ranges(5, chain(5), ties([], []), 0)
    assert np.isnan(solution.log_range).all()


def test_an_edge_across_a_depth_jump_breaks_where_seeds_hold_both_sides():
    edges = chain(40, delta=0.0, sigma=0.002)
    low, high = np.arange(0, 20, 2), np.arange(20, 40, 2)
    values = np.concatenate([np.zeros(10), np.full(10, 0.3)])
    solution = solve_log_ranges(
        40, edges, ties(np.concatenate([low, high]), values), 20, num_rounds=8
    )
    assert np.abs(solution.log_range[:18]).max() < 0.02
    assert np.abs(solution.log_range[22:] - 0.3).max() < 0.02
    assert solution.edge_weight.argmin() in (18, 19, 20)


@pytest.mark.parametrize("num_seeds", [4, 16])
def test_noise_averages_over_seeds(num_seeds):
    """With stiff edges the common offset is the mean of the seeds: sigma / sqrt(n)."""
    errors = []
    for trial in range(60):
        rng = np.random.default_rng(trial)
        nodes = np.linspace(0, 39, num_seeds).astype(int)
        values = rng.normal(scale=0.001, size=num_seeds)
        errors.append(
            solve_log_ranges(40, chain(40, 0.0, 1e-6), ties(nodes, values), num_seeds).log_range[20]
        )
    expected = 0.001 / np.sqrt(num_seeds)
    # 60 trials: the deviation's own error is 9 %; the robust loss costs 5 %.
    assert np.std(errors) == pytest.approx(expected, rel=0.3)


def test_modes_take_up_an_error_that_all_increments_share():
    """A chain whose every increment errs alike is straightened by three seeds; without, it sags."""
    x = np.linspace(-1, 1, 61)
    truth = 0.3 * x
    bent = Edges(
        tail=np.arange(60),
        head=np.arange(1, 61),
        delta=np.diff(truth + 0.004 * x**2),
        sigma=np.full(60, 1e-5),
    )
    nodes = [5, 30, 55]
    seeds = ties(nodes, truth[nodes], sigma=3e-4)
    modes = np.stack([x, 1.5 * x**2 - 0.5], axis=-1)
    plain = solve_log_ranges(61, bent, seeds, 3).log_range
    straight = solve_log_ranges(61, bent, seeds, 3, modes=0.01 * modes).log_range
    assert np.abs(straight - truth).max() < 2e-4
    assert np.abs(plain - truth).max() > 1e-3


def test_modes_do_nothing_where_the_increments_are_right():
    modes = np.linspace(-1, 1, 40)[:, None] ** [1, 2]
    seeds = ties([3, 20, 36], 0.01 * np.array([3, 20, 36]))
    solution = solve_log_ranges(40, chain(40), seeds, 3, modes=0.01 * modes)
    np.testing.assert_allclose(solution.log_range, 0.01 * np.arange(40), atol=1e-6)


def lattice(rows, columns, rng, sigma=0.02):
    """Edges of a grid of nodes whose true log-range is zero, with noise."""
    index = np.arange(rows * columns).reshape(rows, columns)
    pairs = [(index[:, :-1], index[:, 1:]), (index[:-1], index[1:])]
    tail, head = (np.concatenate([p[i].ravel() for p in pairs]) for i in (0, 1))
    spread = sigma * rng.uniform(0.5, 2, len(tail))
    return Edges(tail=tail, head=head, delta=spread * rng.normal(size=len(tail)), sigma=spread)


def noisy_ties(nodes, rng, sigma=0.01):
    return ties(nodes, sigma * rng.normal(size=len(nodes)), sigma)


def dense_system(num, edges, seeds, modes):
    """Rows (edges, ties, prior) over nodes and modes, not yet weighted."""
    num_modes = modes.shape[1]
    matrix = np.zeros((len(edges.tail) + len(seeds.node) + num_modes, num + num_modes))
    row = np.arange(len(edges.tail))
    matrix[row, edges.head], matrix[row, edges.tail] = 1, -1
    row = len(edges.tail) + np.arange(len(seeds.node))
    matrix[row, seeds.node] = 1
    matrix[row, num:] = modes[seeds.node]
    matrix[len(matrix) - num_modes :, num:] = np.eye(num_modes)
    return matrix


def polynomials(rows, columns, num):
    y, x = np.meshgrid(np.linspace(-1, 1, rows), np.linspace(-1, 1, columns), indexing="ij")
    return np.stack([x, y, x * y], axis=-1).reshape(-1, 3)[:, :num]


@pytest.mark.parametrize("num_modes", [0, 3])
def test_the_bordered_solution_is_the_least_squares_one(num_modes):
    """Modes as further columns, their prior as further rows."""
    rng = np.random.default_rng(5)
    edges, modes = lattice(6, 7, rng), polynomials(6, 7, num_modes)
    seeds = noisy_ties([3, 17, 30, 41, 17], rng)
    result = solve_log_ranges(42, edges, seeds, 5, modes=0.03 * modes, num_rounds=1)
    matrix = dense_system(42, edges, seeds, modes)
    target = np.concatenate([edges.delta, seeds.value, np.zeros(num_modes)])
    sigma = np.concatenate([edges.sigma, seeds.sigma, np.full(num_modes, 0.03)])
    expected = np.linalg.lstsq(matrix / sigma[:, None], target / sigma, rcond=None)[0]
    expected = expected[:42] + modes @ expected[42:]
    np.testing.assert_allclose(result.log_range, expected, atol=1e-11)


@pytest.mark.parametrize("num_modes", [0, 3])
def test_the_deviation_is_that_of_the_normal_matrix(num_modes):
    """Within what 16 draws leave, 18 %: for the weights that the last solution had."""
    rng = np.random.default_rng(6)
    edges, modes = lattice(9, 9, rng), polynomials(9, 9, num_modes)
    seeds = noisy_ties([3, 17, 30, 41, 70], rng)
    seeds.value[2] += 0.06  # a doubtful one, so that a weight differs from one
    result = solve_log_ranges(81, edges, seeds, 5, modes=0.03 * modes, num_rounds=30)
    assert result.seed_weight[2] < 0.9
    weight = np.concatenate([result.edge_weight, result.seed_weight, np.ones(num_modes)])
    sigma = np.concatenate([edges.sigma, seeds.sigma, np.full(num_modes, 0.03)])
    matrix = dense_system(81, edges, seeds, modes) * (np.sqrt(weight) / sigma)[:, None]
    covariance = np.linalg.inv(matrix.T @ matrix)
    to_ranges = np.hstack([np.eye(81), modes])
    expected = np.sqrt(np.diag(to_ranges @ covariance @ to_ranges.T))
    ratio = result.sigma / expected
    # Neighbouring nodes err alike: some ten numbers, each with 18 % of its own.
    assert ratio.mean() == pytest.approx(1, abs=0.1)
    assert np.sqrt(((ratio - 1) ** 2).mean()) < 0.25
    assert np.abs(ratio - 1).max() < 4 * 0.18


def test_two_in_three_errors_are_smaller_than_their_deviation():
    errors = []
    for trial in range(30):
        rng = np.random.default_rng(trial)
        seeds = noisy_ties([3, 40, 77, 110, 140], rng)
        result = solve_log_ranges(144, lattice(12, 12, rng), seeds, 5)
        errors.append(np.abs(result.log_range) / result.sigma)
    share = [(np.array(errors) < level).mean() for level in (1, 2)]
    # 30 trials of about three independent numbers each: 5 % of their own.
    assert share[0] == pytest.approx(0.68, abs=0.1)
    assert share[1] == pytest.approx(0.95, abs=0.05)


def test_the_deviation_grows_with_the_distance_from_the_seeds():
    result = solve_log_ranges(60, chain(60, 0.0, 0.01), ties([0], [0.0], 0.001), 1)
    assert result.sigma[0] == pytest.approx(0.001, rel=0.6)
    assert result.sigma[50] == pytest.approx(0.01 * np.sqrt(50), rel=0.6)
    assert np.isnan(solve_log_ranges(3, chain(3), ties([], []), 0).sigma).all()


def test_seeds_that_the_loss_doubts_leave_a_wider_deviation():
    """Two seeds 2.3 deviations off either way: each counts half."""
    sigmas = []
    for num in range(40, 48):
        seeds = ties([5, 12, 25, 35], [0.023, -0.023, 0.023, -0.023], 0.01)
        result = solve_log_ranges(num, chain(num, 0.0, 1e-6), seeds, 4)
        np.testing.assert_allclose(result.seed_weight, 1 / (1 + (2.3 / 2.385) ** 2), rtol=1e-3)
        sigmas.append(result.sigma[20])
    # The mean of eight numbers of 18 % each.
    expected = 0.01 / np.sqrt(4 / (1 + (2.3 / 2.385) ** 2))
    assert np.mean(sigmas) == pytest.approx(expected, rel=0.15)


def test_the_same_result_twice():
    rng = np.random.default_rng(8)
    edges, seeds = lattice(9, 9, rng), noisy_ties([3, 17, 30], rng)
    one, two = (solve_log_ranges(81, edges, seeds, 3) for _ in range(2))
    np.testing.assert_array_equal(one.sigma, two.sigma)


def test_the_normal_of_an_increment_may_be_of_any_length():
    normal, rays = np.array([0.2, -0.4, -0.9]), np.array([[0.0, 0, 1], [0.1, 0, 0.995]])
    step = log_range_increment(normal, rays[0], rays[1])
    for length in (7.0, 0.01):
        scaled = log_range_increment(length * normal, rays[0], rays[1])
        assert scaled == pytest.approx(step, abs=1e-12)
