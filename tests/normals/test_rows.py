"""Constraint rows: their weights, and the range maps that hide points."""

import numpy as np
import pytest
from scenes import board_scene

from polmvs.normals.rows import gather_rows, sample_range
from polmvs.polarization.kinds import AngleModel


@pytest.fixture(scope="module")
def scene():
    return board_scene(3)


def test_the_variance_of_an_orthographic_row_holds_its_angle_to_the_perspective_one(scene) -> None:
    """That angle, from both models' rows, on top of what the phase's noise and turn make."""
    points, _ = scene.surface_points(40)
    plain, aware = (
        gather_rows(AngleModel.OPA, points, scene.maps, tilt_aware=aware) for aware in (False, True)
    )
    perspective_plain, perspective_aware = (
        gather_rows(AngleModel.PPA, points, scene.maps, tilt_aware=aware) for aware in (False, True)
    )
    counted = np.isfinite(plain.sigma) & np.isfinite(perspective_plain.sigma)
    assert counted.mean() > 0.8
    cosine = np.abs((plain.rows * perspective_plain.rows).sum(axis=0))[counted]
    sine2 = 1 - np.clip(cosine, 0, 1) ** 2
    # What a tilt adds to the variance of a phase: PPA's rows turn by a factor of their own.
    factor = np.square(perspective_plain.sigma / plain.sigma)[counted]
    of_tilt = (perspective_aware.sigma**2 - perspective_plain.sigma**2)[counted] / factor
    added = (aware.sigma**2 - plain.sigma**2)[counted]
    np.testing.assert_allclose(added - of_tilt, sine2, atol=2e-3 * sine2.max())
    assert sine2.max() > 0.01
    tilted = [
        gather_rows(AngleModel.TILTED, points, scene.maps, tilt_aware=aware).sigma
        for aware in (False, True)
    ]
    np.testing.assert_array_equal(*tilted)


@pytest.mark.parametrize("factor", [1, 2, 4])
def test_a_range_map_may_be_coarser(scene, factor: int) -> None:
    """Its values are found at the place that they are of."""
    view = scene.views[0]
    camera = view.camera
    height, width = camera.height // factor, camera.width // factor
    col, row = np.meshgrid(np.arange(width), np.arange(height))
    range_map = (1000 * row + col + 1).astype(np.float32)
    rng = np.random.default_rng(0)
    xy = rng.uniform(0.1, 0.9, (50, 2)) * [camera.width, camera.height]
    cell = np.floor(xy / factor)
    np.testing.assert_array_equal(
        sample_range(range_map, view, xy), 1000 * cell[:, 1] + cell[:, 0] + 1
    )


def test_a_coarse_range_map_hides_what_lies_behind_it(scene) -> None:
    """The left half of the first view is covered; only points there lose its row."""
    points, _ = scene.surface_points(60)
    view = scene.views[0]
    covered = np.zeros((view.camera.height // 2, view.camera.width // 2), np.float32)
    covered[:, : covered.shape[1] // 2] = 0.1
    open_rows = gather_rows(AngleModel.PPA, points, scene.maps)
    rows = gather_rows(AngleModel.PPA, points, scene.maps, [covered, None, None])
    left = view.project(points)[:, 0] < view.camera.width / 2
    assert 10 < left.sum() < 50
    seen = np.isfinite(open_rows.sigma[0])
    np.testing.assert_array_equal(np.isfinite(rows.sigma[0]), seen & ~left)
    np.testing.assert_array_equal(rows.sigma[1:], open_rows.sigma[1:])
