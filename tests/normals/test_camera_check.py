"""Which camera the phases fit."""

from dataclasses import replace

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.geometry import dots, unit_or_zero
from polmvs.normals.camera_check import CameraCheckTolerances, CameraFit, PhaseRows, fit_camera
from polmvs.polarization.angle_models import phase_from_normal, rows_from_phase
from polmvs.polarization.kinds import AngleModel

CAMERA = PinholeCamera(width=612, height=512, fx=445.0, fy=445.0, cx=306.0, cy=256.0)
NUM_VIEWS, NUM_POINTS = 12, 1000
# Phases whose errors are their noise alone.
EXACT = CameraCheckTolerances(shared_sigma=0.0)
SEMI_AXES = np.array([1.0, 0.7, 0.4])


def rotation_towards(center: np.ndarray) -> np.ndarray:
    """From the world to a camera that looks at the origin."""
    ahead = -center / np.linalg.norm(center)
    right = unit_or_zero(np.cross(ahead, [0.0, 0.0, 1.0]))
    return np.stack([right, np.cross(ahead, right), ahead])


def ellipsoid(
    given: PinholeCamera, *, distance: float = 3.0, true: PinholeCamera = CAMERA, noise: float = 0.0
) -> tuple[PhaseRows, np.ndarray, np.ndarray]:
    """Rows of an ellipsoid that a camera saw, with the rays of a given one."""
    rng = np.random.default_rng(0)
    points = unit_or_zero(rng.normal(size=(NUM_POINTS, 3))) * SEMI_AXES
    normals = unit_or_zero(points / SEMI_AXES**2)
    angles = 2 * np.pi * np.arange(NUM_VIEWS) / NUM_VIEWS
    height = np.where(np.arange(NUM_VIEWS) % 2, 0.4, 0.9)
    centers = np.column_stack([np.cos(angles), np.sin(angles), height])
    centers *= distance / np.linalg.norm(centers, axis=1, keepdims=True)
    rotations = np.stack([rotation_towards(center) for center in centers])
    rows, rays, point, view = [], [], [], []
    for index, (center, rotation) in enumerate(zip(centers, rotations, strict=True)):
        seen = np.flatnonzero(dots(normals, unit_or_zero(center - points)) > 0.3)
        in_cam = (points[seen] - center) @ rotation.T
        phase = phase_from_normal(AngleModel.PPA, normals[seen] @ rotation.T, unit_or_zero(in_cam))
        phase = phase + noise * rng.normal(size=len(seen))
        own = given.rays(true.project(in_cam))
        rows.append(rows_from_phase(AngleModel.PPA, phase, own) @ rotation)
        rays.append(own @ rotation)
        point.append(seen)
        view.append(np.full(len(seen), index))
    joined = np.concatenate(rows)
    observed = PhaseRows(
        rows=joined,
        rays=np.concatenate(rays),
        variance=np.full(len(joined), max(noise, 0.002) ** 2),
        point=np.concatenate(point),
        view=np.concatenate(view),
    )
    return observed, normals, rotations


def fit_of(given: PinholeCamera, **options: object) -> CameraFit:
    observed, normals, rotations = ellipsoid(given, **options)  # type: ignore[arg-type]
    fit = fit_camera(observed, normals, rotations, tolerances=EXACT)
    assert fit is not None
    return fit


def test_a_right_camera_fits() -> None:
    fit = fit_of(CAMERA)
    assert fit.agrees
    assert fit.focal_change == pytest.approx(0, abs=1e-9)
    assert fit.point_change == pytest.approx((0, 0), abs=1e-9)


@pytest.mark.parametrize("scale", [0.9, 1.1])
def test_a_wrong_focal_length_is_found(scale: float) -> None:
    given = replace(CAMERA, fx=445 * scale, fy=445 * scale)
    fit = fit_of(given)
    assert not fit.agrees
    # The prior pulls by the square of the deviation over its own: (0.0045 / 0.2)^2 of the change.
    assert 1 + fit.focal_change == pytest.approx(1 / scale, rel=1e-3)
    assert "a focal length of 44" in fit.message(given)


def test_a_wrong_principal_point_is_found() -> None:
    fit = fit_of(replace(CAMERA, cx=312.0, cy=250.0))
    assert not fit.agrees
    assert 445 * np.array(fit.point_change) == pytest.approx([-6, 6], abs=0.1)


def test_noise_stays_within_its_deviation() -> None:
    fit = fit_of(CAMERA, noise=0.02)
    assert fit.agrees
    # Twelve groups give a deviation with an error of a fifth: three deviations are at most four.
    assert abs(fit.focal_change) < 4 * fit.focal_sigma
    assert 0.02 < fit.focal_sigma < 0.06  # 0.044 by the noise of the rows


def test_errors_that_views_share_do_not_accuse_the_camera() -> None:
    """From afar another focal length changes the phases by less than such errors."""
    observed, normals, rotations = ellipsoid(replace(CAMERA, fx=480.0, fy=480.0), noise=0.002)
    strict = fit_camera(observed, normals, rotations, tolerances=EXACT)
    assert strict is not None
    assert not strict.agrees
    assert fit_camera(observed, normals, rotations) is None


def test_one_wrong_view_does_not_accuse_the_camera() -> None:
    observed, normals, rotations = ellipsoid(CAMERA)
    turned = observed.rows.copy()
    odd = observed.view == 3
    turned[odd] = np.cross(observed.rays[odd], turned[odd])
    turned_rows = replace(observed, rows=turned)
    fit = fit_camera(turned_rows, normals, rotations, tolerances=EXACT)
    assert fit is not None
    assert fit.agrees


def test_narrow_views_determine_no_camera() -> None:
    """Through a telephoto lens all rays are alike, and any focal length fits."""
    far = replace(CAMERA, fx=445e3, fy=445e3)
    observed, normals, rotations = ellipsoid(far, distance=3e3, true=far, noise=0.02)
    some = observed.only(np.arange(len(observed.view)) % 3 == 0)
    assert fit_camera(some, normals, rotations, tolerances=EXACT) is None
