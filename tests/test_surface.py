import numpy as np
import pytest

from polmvs.surface import Edges, SeedTies, log_range_increment, solve_log_ranges

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
    straight = solve_log_ranges(61, bent, seeds, 3, modes=modes, mode_sigma=0.01).log_range
    assert np.abs(straight - truth).max() < 2e-4
    assert np.abs(plain - truth).max() > 1e-3


def test_modes_do_nothing_where_the_increments_are_right():
    modes = np.linspace(-1, 1, 40)[:, None] ** [1, 2]
    seeds = ties([3, 20, 36], 0.01 * np.array([3, 20, 36]))
    solution = solve_log_ranges(40, chain(40), seeds, 3, modes=modes, mode_sigma=0.01)
    np.testing.assert_allclose(solution.log_range, 0.01 * np.arange(40), atol=1e-6)
