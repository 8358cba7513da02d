from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from polmvs.evaluation.metrics import (
    AngleStats,
    CloudMetrics,
    angular_errors_deg,
    axial_errors_deg,
    evaluate_cloud,
)

Array = NDArray[np.float64]
UP = np.array([0.0, 0.0, 1.0])
THRESHOLDS_M = (0.0005, 0.001)


def plane(spacing: float = 0.0005, side: float = 0.06, z: float = 0.0) -> Array:
    """Square of points about the origin."""
    ticks = (np.arange(round(side / spacing)) + 0.5) * spacing - side / 2
    x, y = np.meshgrid(ticks, ticks)
    return np.stack([x, y, np.full_like(x, z)], axis=-1).reshape(-1, 3)


def evaluate(points: Array, normals: Array | None = None) -> CloudMetrics:
    """Against a plane, the part, that lies 30 mm above a wider table without normals."""
    part, table = plane(), plane(0.002, 0.2, -0.03)
    truth = np.concatenate([part, table])
    is_part = np.arange(len(truth)) < len(part)
    truth_normals = np.where(is_part[:, None], UP, np.nan)
    return evaluate_cloud(points, normals, truth, truth_normals, is_part, THRESHOLDS_M)


def test_truth_itself_is_perfect() -> None:
    points = plane()
    metrics = evaluate(points, np.broadcast_to(UP, points.shape))
    assert metrics.accuracy == metrics.completeness == metrics.f_score == (1.0, 1.0)
    assert metrics.chamfer_m == metrics.accuracy_mean_m == metrics.normal_mean_deg == 0.0
    assert metrics.num_points == metrics.num_on_part == len(points)
    assert metrics.off_surface_share == 0.0


def test_plane_shifted_by_700_um() -> None:
    metrics = evaluate(plane(z=0.0007))
    assert metrics.f_score == (0.0, 1.0)
    for distance in (metrics.accuracy_mean_m, metrics.completeness_median_m, metrics.chamfer_m):
        assert distance == pytest.approx(0.0007, rel=1e-9)
    assert np.isnan(metrics.normal_mean_deg)


def test_sampling_of_the_truth_does_not_count() -> None:
    points = plane() + np.array([0.0002, 0.0002, 0.0])  # between the truth's points, on its surface
    metrics = evaluate(points)
    assert metrics.accuracy_mean_m == pytest.approx(0.0, abs=1e-12)
    assert metrics.completeness_mean_m == pytest.approx(0.0002 * np.sqrt(2), rel=1e-9)


def test_beyond_the_rim_is_euclidean() -> None:
    metrics = evaluate(np.array([[0.034, 0.00025, 0.0]]))
    assert metrics.accuracy_mean_m == pytest.approx(0.00425, rel=1e-9)
    assert metrics.accuracy == (0.0, 0.0)


def test_half_of_the_plane() -> None:
    points = plane()
    metrics = evaluate(points[points[:, 0] > 0])
    assert metrics.accuracy == (1.0, 1.0)
    # The missing half's first column is one spacing, 0.5 mm, away; the second 1 mm.
    np.testing.assert_allclose(metrics.completeness, (0.5, 0.5), atol=2 / 120 + 1e-9)
    np.testing.assert_allclose(metrics.f_score, (2 / 3, 2 / 3), atol=0.015)


def test_flipped_normals_are_180_degrees_off() -> None:
    points = plane(0.001)
    metrics = evaluate(points, np.broadcast_to(-UP, points.shape))
    assert metrics.normal_mean_deg == metrics.normal_median_deg == pytest.approx(180.0)


def test_table_is_not_the_part_and_floaters_are() -> None:
    table = plane(0.004, 0.1, -0.03)
    floaters = plane(0.004, 0.04, 0.01)
    metrics = evaluate(np.concatenate([plane(), table, floaters]))
    assert metrics.num_on_part == 120**2 + len(floaters)
    share = 120**2 / metrics.num_on_part
    assert metrics.accuracy == pytest.approx((share, share))
    assert metrics.off_surface_share == pytest.approx(len(floaters) / metrics.num_points)
    assert metrics.completeness == (1.0, 1.0)


def test_cloud_only_on_the_table() -> None:
    metrics = evaluate(plane(0.004, 0.1, -0.03))
    assert metrics.num_on_part == 0
    assert metrics.f_score == metrics.accuracy == (0.0, 0.0)
    assert np.isnan(metrics.accuracy_mean_m)
    assert metrics.completeness_mean_m == pytest.approx(0.03, rel=0.05)


@pytest.mark.parametrize("with_normals", [True, False])
@pytest.mark.parametrize("points", [np.zeros((0, 3)), np.full((4, 3), np.nan)])
def test_cloud_without_points(points: Array, with_normals: bool) -> None:
    metrics = evaluate(points, points if with_normals else None)
    assert metrics.num_points == metrics.num_on_part == 0
    assert metrics.accuracy == metrics.completeness == metrics.f_score == (0.0, 0.0)
    for value in (metrics.chamfer_m, metrics.completeness_mean_m, metrics.off_surface_share):
        assert np.isnan(value)


def test_rows_that_are_not_finite_are_ignored() -> None:
    points = np.concatenate([plane(), [[np.nan, 0, 0], [np.inf, 0, 0]]])
    normals = np.tile(UP, (len(points), 1))
    normals[0] = np.nan
    metrics = evaluate(points, normals)
    assert metrics.num_points == len(points) - 2
    assert metrics.f_score == (1.0, 1.0)
    assert metrics.normal_mean_deg == 0.0


def test_large_cloud_is_judged_by_a_subset(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("polmvs.evaluation.metrics.MAX_QUERIES", 1000)
    points = plane()
    metrics = evaluate(points, np.tile(UP, (len(points), 1)))
    assert metrics.f_score == (1.0, 1.0)
    assert metrics.num_on_part == metrics.num_points == len(points)


def test_wrong_shapes() -> None:
    points = plane(0.01)
    is_part = np.ones(len(points), np.bool_)
    with pytest.raises(ValueError, match=r"points\.shape"):
        evaluate_cloud(points[:, :2], None, points, points, is_part)
    with pytest.raises(ValueError, match=r"normals\.shape"):
        evaluate_cloud(points, points[1:], points, points, is_part)
    with pytest.raises(ValueError, match="no point of the part"):
        evaluate_cloud(points, None, points, points, ~is_part)


def test_angular_errors() -> None:
    normals = np.array([[0, 0, 2.0], [0, 0, -1], [1, 0, 0], [1, 0, 1], [0, 0, 0], [np.nan, 0, 1]])
    expected = [0, 180, 90, 45, np.nan, np.nan]
    np.testing.assert_allclose(angular_errors_deg(normals, UP), expected, rtol=1e-9)
    assert angular_errors_deg(normals.reshape(2, 3, 3), UP).shape == (2, 3)


def test_axial_errors_ignore_multiples_of_pi() -> None:
    phases = np.radians([0.0, 179.0, 1.0, 90.0, 400.0])
    truth = np.radians([180.0, 1.0, 179.0, 0.0, 30.0])
    np.testing.assert_allclose(axial_errors_deg(phases, truth), [0, 2, 2, 90, 10], atol=1e-9)
    errors = axial_errors_deg(np.append(phases, np.nan), np.append(truth, 0.0))
    stats = AngleStats.from_degrees(errors)
    assert stats.count == 5
    assert stats.median_deg == pytest.approx(2.0)


def test_angle_statistics() -> None:
    stats = AngleStats.from_degrees(np.array([[-3.0, 4.0], [0.0, np.nan]]))
    assert (stats.count, stats.median_deg) == (3, 3.0)
    assert stats.mean_deg == pytest.approx(7 / 3)
    assert stats.rmse_deg == pytest.approx(np.sqrt(25 / 3))
    assert stats.p95_deg == pytest.approx(3.9)
    assert np.isnan(AngleStats.from_degrees(np.array([np.nan])).mean_deg)
