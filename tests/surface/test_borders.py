"""Borders between cells: drawn to steps, straight where nothing shows them."""

import numpy as np
import pytest
from scipy import ndimage

from polmvs.surface.borders import cells_beside, drawn_border, smoothly_beside

SHAPE = (120, 130)
CENTER = np.array([60.3, 62.7])
SIDE = 32.2  # half of it
TURN = np.array([[np.cos(0.3), np.sin(0.3)], [-np.sin(0.3), np.cos(0.3)]])
CELLS = np.moveaxis(np.indices(SHAPE), 0, -1).astype(float)


def square(points) -> np.ndarray:
    """Signed distance to a square, exact off its corners."""
    local = np.abs((points - CENTER) @ TURN) - SIDE
    outside = np.linalg.norm(np.maximum(local, 0), axis=-1)
    return outside + np.minimum(local.max(axis=-1), 0)


def disc(points) -> np.ndarray:
    return np.linalg.norm(points - CENTER, axis=-1) - SIDE


def steps_of(shape, *, noise=0.0, hidden=None):
    """What a look across a curve finds: where along its normals the border of a shape is."""
    rng = np.random.default_rng(0)
    along = np.arange(-4, 4.01, 0.05)

    def across(curve, normals):
        values = shape(curve[:, None] + along[:, None] * normals[:, None])
        crossing = (values[:, :-1] <= 0) & (values[:, 1:] > 0)
        first = np.where(crossing, np.abs(along[:-1]), np.inf).argmin(axis=1)
        found = along[first] + 0.025 + noise * rng.standard_normal(len(curve))
        weight = crossing.any(axis=1).astype(float)
        if hidden is not None:
            weight[hidden(curve)] = 0
        return found, weight

    return across


def near_border(shape, reach=1.5) -> np.ndarray:
    """Cells near the border; of a square, off its corners."""
    near = np.abs(shape(CELLS)) < reach
    local = np.abs((CELLS - CENTER) @ TURN)
    return near & (local.min(axis=-1) < SIDE - 5) if shape is square else near


def roughened(inside) -> np.ndarray:
    """Labels that end by up to three cells beside the border."""
    noise = ndimage.gaussian_filter(np.random.default_rng(1).standard_normal(inside.shape), 3)
    return smoothly_beside(inside) < 2 * noise / noise.std()


@pytest.mark.parametrize("shape", [square, disc])
def test_a_border_goes_to_its_steps(shape):
    inside = roughened(shape(CELLS) < 0)
    found = drawn_border(inside, steps_of(shape, noise=0.2))
    near = near_border(shape)
    before = (smoothly_beside(inside) - shape(CELLS))[near]
    off = (found - shape(CELLS))[near]
    assert np.sqrt(np.mean(before**2)) > 1
    # Steps err by 0.2 each.
    assert np.sqrt(np.mean(off**2)) < 0.12
    assert abs(np.mean(off)) < 0.03


def test_corners_are_kept():
    """Points of a curve are a cell apart, and their normals are smooth: that rounds by a cell."""
    found = drawn_border(square(CELLS) < 0, steps_of(square))
    corners = CENTER + SIDE * np.array([[1, 1], [1, -1], [-1, 1], [-1, -1]]) @ TURN.T
    inwards = CENTER - corners
    places = corners + 1.2 * inwards / np.linalg.norm(inwards, axis=1, keepdims=True)
    assert (ndimage.map_coordinates(found, places.T, order=1) < 0).all()


def test_a_border_is_straight_where_nothing_shows_it():
    local = (CELLS - CENTER) @ TURN
    tooth = (np.abs(local[..., 1]) < 8) & (local[..., 0] > 0) & (local[..., 0] < SIDE + 4)
    inside = (square(CELLS) < 0) | tooth

    def hidden(curve):
        at = (curve - CENTER) @ TURN
        return (np.abs(at[:, 1]) < 12) & (at[:, 0] > 0)

    found = drawn_border(inside, steps_of(square, hidden=hidden))
    gap = near_border(square) & (np.abs(local[..., 1]) < 8) & (local[..., 0] > 0)
    assert gap.sum() > 30
    assert np.abs((smoothly_beside(inside) - square(CELLS))[gap]).mean() > 2.5
    assert np.abs((found - square(CELLS))[gap]).max() < 0.15


def test_single_false_steps_move_no_border():
    true = steps_of(square)

    def across(curve, normals):
        found, weight = true(curve, normals)
        found[::9] += 3
        return found, weight

    found = drawn_border(square(CELLS) < 0, across)
    off = (found - square(CELLS))[near_border(square)]
    assert np.sqrt(np.mean(off**2)) < 0.1


def test_borders_that_are_not_to_move_stay():
    local = (CELLS - CENTER) @ TURN
    inside = square(CELLS) < 0
    farther = steps_of(lambda points: square(points) - 2)

    def across(curve, normals):
        found, weight = farther(curve, normals)
        return found, np.where(((curve - CENTER) @ TURN)[:, 0] < 0, np.nan, weight)

    found = drawn_border(inside, across)
    along = np.abs(local[..., 1]) < SIDE - 4
    kept = near_border(square) & along & (local[..., 0] < 0)
    moved = near_border(square) & along & (local[..., 0] > 0)
    assert np.abs((found - square(CELLS))[kept]).max() < 0.7  # of labels that end at whole cells
    np.testing.assert_allclose((found - square(CELLS))[moved], -2, atol=0.1)


def test_the_edge_of_the_grid_is_no_border():
    """A region beyond a corner, and one along a side, go on where the grid ends."""
    rows, cols = np.indices(SHAPE)
    beyond = 20.6 - (rows + cols) / np.sqrt(2)

    def line(points):
        return 20.6 - points.sum(axis=-1) / np.sqrt(2)

    for sign in (1, -1):
        inside = sign * beyond < 0
        found = drawn_border(inside, steps_of(lambda points, sign=sign: sign * line(points)))
        assert np.array_equal(found < -0.5, sign * beyond < -0.5)
        near = (np.abs(beyond) < 2) & (np.minimum(rows, cols) > 4)
        assert np.abs((found - sign * beyond)[near]).max() < 0.1


def test_a_hole_is_a_border_too():
    outer = square(CELLS)
    hole = np.linalg.norm(CELLS - CENTER, axis=-1) - 12.3

    def ring(points):
        return np.maximum(square(points), 12.3 - np.linalg.norm(points - CENTER, axis=-1))

    found = drawn_border(np.maximum(outer, -hole) < 0, steps_of(ring))
    about = np.abs(hole) < 1.5
    assert np.abs((found + hole)[about]).max() < 0.15
    assert (found[hole < -3] > 0).all()


@pytest.mark.parametrize("value", [True, False])
def test_without_a_border_nothing_is_near(value):
    found = drawn_border(np.full(SHAPE, value), steps_of(square))
    assert (found < -SHAPE[0]).all() if value else (found > SHAPE[0] / 2).all()


def test_without_steps_the_labels_stay():
    inside = square(CELLS) < 0
    found = drawn_border(inside, lambda curve, normals: (curve[:, 0], np.zeros(len(curve))))
    assert np.abs((found - smoothly_beside(inside))[near_border(square)]).max() < 0.4


def test_kinks_of_a_border_do_not_swap_its_sides():
    """Rough borders with noisy steps have kinks, whose normals look to the wrong side."""
    wrong = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        inside = ndimage.gaussian_filter(rng.normal(size=SHAPE), 8) > 0

        def noise(curve, normals, rng=rng):
            return 0.5 * rng.normal(size=len(curve)), np.ones(len(curve))

        found = drawn_border(inside, noise)
        far = np.abs(cells_beside(inside)) > 3
        wrong.append(np.count_nonzero(far & ((found < 0) != inside)))
    # Islands too small for a curve are left out; swapped sides were hundreds of cells.
    assert max(wrong) < 30
    assert np.median(wrong) == 0
