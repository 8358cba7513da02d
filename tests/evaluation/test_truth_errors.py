from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import polmvs
from polmvs.camera import pixel_centers
from polmvs.errors import DataError
from polmvs.evaluation.truth_errors import evaluate, phase_errors_on_part, track_normal_errors
from polmvs.geometry import RigidTransform
from polmvs.io.ground_truth import GroundTruth, open_ground_truth
from polmvs.polarization.angle_models import phase_from_normal
from polmvs.polarization.kinds import AngleModel
from polmvs.poses.alignment import align_views
from polmvs.scene import View

Array = NDArray[np.float64]
DEMO = Path(polmvs.__file__).parent / "demo_capture"
SCALE = 7.0  # units of the scrambled world per metre
ROTATION = Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix()
SHIFT = np.array([5.0, -3.0, 11.0])


@pytest.fixture(scope="module")
def truth() -> GroundTruth:
    return open_ground_truth(DEMO)


def scramble(points: Array) -> Array:
    """True frame to a world of another scale, orientation and origin."""
    return SCALE * points @ ROTATION.T + SHIFT


def scrambled_views(truth: GroundTruth) -> list[View]:
    views = []
    for view in truth.views.values():
        rotation = view.cam_from_world.rotation @ ROTATION.T
        center = scramble(view.center_in_world)
        views.append(replace(view, cam_from_world=RigidTransform(rotation, -rotation @ center)))
    return views


def moved(view: View, offset: Array) -> View:
    """View whose centre is displaced in the world."""
    pose = view.cam_from_world
    translation = pose.translation - pose.rotation @ offset
    return replace(view, cam_from_world=RigidTransform(pose.rotation, translation))


def test_truth_scrambled_is_perfect(truth: GroundTruth) -> None:
    surface = truth.surface_points()
    metrics, report = evaluate(
        scramble(surface.points), surface.normals @ ROTATION.T, scrambled_views(truth), truth
    )
    assert metrics.f_score == (1.0, 1.0, 1.0)
    assert metrics.chamfer_m < 1e-9
    assert metrics.normal_mean_deg < 1e-3
    assert metrics.off_surface_share == 0.0
    assert metrics.num_on_part == surface.is_part.sum()
    assert report.scale == pytest.approx(1 / SCALE, rel=1e-9)
    assert report.rms_residual_mm < 1e-6
    assert report.rotation_error_median_deg < 1e-6
    assert (report.num_cameras, report.dropped) == (10, ())


def test_cloud_with_holes_in_its_numbers(truth: GroundTruth) -> None:
    points = np.full((5, 3), np.inf)
    metrics, _ = evaluate(points, points, scrambled_views(truth), truth)
    assert metrics.num_points == 0
    assert metrics.f_score == (0.0, 0.0, 0.0)


@pytest.mark.parametrize("num", [5, 6, 10])
@pytest.mark.parametrize("distance", [0.03, 0.5, 50.0])
def test_one_wrong_camera_is_dropped(truth: GroundTruth, num: int, distance: float) -> None:
    rng = np.random.default_rng(0)
    views = [moved(v, SCALE * rng.normal(0, 0.0003, 3)) for v in scrambled_views(truth)[:num]]
    views[2] = moved(views[2], SCALE * distance * np.array([0.6, 0.0, 0.8]))
    transform, report = align_views(views, truth.views)
    assert report.dropped == (views[2].name,)
    assert report.num_cameras == num - 1
    assert report.scale == pytest.approx(1 / SCALE, rel=5e-3)
    assert report.rms_residual_mm < 3 * np.sqrt(3) * 0.3
    np.testing.assert_allclose(transform * scramble(np.zeros((1, 3))), 0.0, atol=0.005)


def test_noise_alone_drops_nobody(truth: GroundTruth) -> None:
    for seed in range(20):
        rng = np.random.default_rng(seed)
        views = [moved(v, SCALE * rng.normal(0, 0.002, 3)) for v in scrambled_views(truth)]
        assert align_views(views, truth.views)[1].dropped == ()


def test_rotation_error_is_reported(truth: GroundTruth) -> None:
    turn = Rotation.from_rotvec([0.0, np.radians(2.0), 0.0]).as_matrix()
    views = []
    for view in scrambled_views(truth):
        rotation = turn @ view.cam_from_world.rotation
        pose = RigidTransform(rotation, -rotation @ view.center_in_world)
        views.append(replace(view, cam_from_world=pose))
    _, report = align_views(views, truth.views)
    assert report.rotation_error_median_deg == pytest.approx(2.0, rel=1e-6)


def test_three_names_must_match(truth: GroundTruth) -> None:
    views = scrambled_views(truth)[:4]
    views[:2] = [replace(view, name=f"other_{view.name}") for view in views[:2]]
    with pytest.raises(DataError, match="knows 2 of the 4"):
        align_views(views, truth.views)


def test_cameras_on_a_line(truth: GroundTruth) -> None:
    views = scrambled_views(truth)[:3]
    on_line = [moved(v, -v.center_in_world + [k, 0.0, 0.0]) for k, v in enumerate(views)]
    with pytest.raises(DataError, match="cannot be aligned"):
        align_views(on_line, truth.views)


def test_track_normals(truth: GroundTruth) -> None:
    surface = truth.surface_points()
    inner = surface.points[surface.is_part]
    inner = inner[np.linalg.norm(inner[:, :2] - inner[:, :2].mean(axis=0), axis=1) < 0.05][:100]
    table = surface.points[~surface.is_part & (np.abs(surface.points[:, 2]) < 1e-4)][:50]
    floating = inner[:10] + np.array([0.0, 0.0, 0.03])
    points = np.concatenate([inner, table, floating])
    tilted = np.array([np.sin(0.1), 0.0, np.cos(0.1)])
    normals = np.tile(tilted @ ROTATION.T, (len(points), 1))
    normals[1] = -normals[1]
    valid = np.ones(len(points), np.bool_)
    valid[0] = False
    normals[0] = np.nan
    result = track_normal_errors(scramble(points), normals, valid, scrambled_views(truth), truth)
    assert (result.num_points, result.num_valid) == (160, 159)
    assert result.num_on_part == result.errors.count == 99
    assert result.errors.median_deg == pytest.approx(np.degrees(0.1), abs=0.02)
    flipped = (98 * np.degrees(0.1) + 180 - np.degrees(0.1)) / 99
    assert result.errors.mean_deg == pytest.approx(flipped, abs=0.02)


def test_tracks_without_points(truth: GroundTruth) -> None:
    none = np.zeros((0, 3))
    valid = np.zeros(0, np.bool_)
    result = track_normal_errors(none, none, valid, scrambled_views(truth), truth)
    assert result.num_on_part == 0
    assert np.isnan(result.errors.mean_deg)


def test_phase_made_by_a_model_fits_that_model_only(truth: GroundTruth) -> None:
    name = truth.names[0]
    camera = truth.views[name].camera
    rays = camera.rays(pixel_centers(camera.width, camera.height))
    phase = phase_from_normal(AngleModel.PPA, truth.normals(name), rays) + np.radians(1.0)
    dolp = np.where(np.arange(camera.width) < camera.width // 2, 0.5, 0.05) * np.ones(phase.shape)
    errors = phase_errors_on_part([(name, phase, dolp), ("strange.png", phase, dolp)], truth)
    assert errors[AngleModel.PPA].median_deg == pytest.approx(1.0, abs=0.01)
    assert errors[AngleModel.PPA].count == (truth.mask(name) & (dolp > 0.1)).sum()
    assert errors[AngleModel.OPA].mean_deg > 3.0
    empty = phase_errors_on_part([(name, phase, 0 * dolp)], truth)
    assert empty[AngleModel.OPA].count == 0
    with pytest.raises(ValueError, match=r"phase\.shape"):
        phase_errors_on_part([(name, phase[1:], dolp)], truth)
