"""Planes in one view: normals, several planes, the focal length."""

from pathlib import Path

import numpy as np
import pytest
from scenes import normal_from_angles

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.io.ground_truth import open_ground_truth
from polmvs.normals.single_view.focal import estimate_focal
from polmvs.normals.single_view.pixels import PlaneView, phase_sigma, polygon_mask
from polmvs.normals.single_view.plane import (
    EXACT,
    normal_equations,
    phase_residuals,
    plane_normal,
    stack_samples,
)
from polmvs.normals.single_view.search import find_planes
from polmvs.polarization.angle_models import phase_from_normal
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.stokes import Stokes
from polmvs.scene import View
from polmvs.synthetic.captures import add_noise, look_at, render_view
from polmvs.synthetic.surfaces import Group, Plane, Sphere

SHARED = Path(__file__).parents[3] / "shared" / "data"
BOARD = SHARED / "board"
needs_board = pytest.mark.skipif(not BOARD.is_dir(), reason=f"{BOARD} is not here")

CAMERA = PinholeCamera(width=160, height=120, fx=110.0, fy=110.0, cx=80.0, cy=60.0)
RAYS = np.moveaxis(CAMERA.rays(pixel_centers(CAMERA.width, CAMERA.height)), -1, 0).reshape(3, -1)
NORMAL = np.array([0.2, 0.6, -0.8]) / np.linalg.norm([0.2, 0.6, -0.8])
BOTH = pytest.mark.parametrize("robust", [True, False])


def axial_of(phase, rng=None, sigma=0.0, outliers=0.0):
    if rng is not None:
        phase = phase + sigma * rng.standard_normal(phase.shape)
        wrong = rng.random(phase.shape) < outliers
        phase = np.where(wrong, rng.uniform(0, np.pi, phase.shape), phase)
    return np.stack([np.cos(2 * phase), np.sin(2 * phase)])


def plane_axial(normal=NORMAL, model=AngleModel.PPA, **noise):
    return axial_of(phase_from_normal(model, normal, RAYS.T), **noise)


def error_deg(normal, truth):
    return np.degrees(np.arccos(np.clip(normal @ truth, -1, 1)))


@BOTH
@pytest.mark.parametrize("model", [AngleModel.PPA, AngleModel.TILTED])
@pytest.mark.parametrize("shift", [1.0, -3.0])
def test_exact_phases_give_the_normal(robust, model, shift):
    sigma = np.full(RAYS.shape[1], 0.02)
    estimate = plane_normal(model, shift**2 * plane_axial(), RAYS, sigma, robust=robust)
    np.testing.assert_allclose(estimate.normal, NORMAL, atol=1e-9)
    assert estimate.valid
    assert 0 < estimate.conditioning <= 1
    assert estimate.rmse_deg < 1e-6
    assert estimate.num_pixels == RAYS.shape[1]
    assert estimate.outlier_share == 0


@BOTH
@pytest.mark.parametrize("num", [2, 3, 7])
def test_few_pixels_are_enough(robust, num):
    some = np.linspace(0, RAYS.shape[1] - 1, num).astype(int)
    axial = plane_axial()[:, some]
    estimate = plane_normal(AngleModel.PPA, axial, RAYS[:, some], np.full(num, 0.01), robust=robust)
    np.testing.assert_allclose(estimate.normal, NORMAL, atol=1e-7)
    assert 0.1 < estimate.sigma_deg < 10


@pytest.mark.parametrize("scale", [EXACT, 1e-3, 1.0])
def test_rounding_of_exact_phases_makes_no_negative_weight(scale):
    """Sums of squares are never negative, however small the scale of the loss."""
    num = RAYS.shape[1]
    samples = stack_samples(AngleModel.PPA, plane_axial(), RAYS, np.full(num, 0.01))
    for first in range(0, num, 97):
        matrix = normal_equations(NORMAL, samples[:, first : first + 3], scale).matrix
        assert (np.diag(matrix) >= 0).all()


def test_a_start_chooses_between_two_planes():
    """Half of the pixels are of either: each is found from a start that is near it."""
    other = np.array([-0.5, 0.1, -0.8]) / np.linalg.norm([-0.5, 0.1, -0.8])
    axial = np.where(np.arange(RAYS.shape[1]) % 2, plane_axial(), plane_axial(other))
    sigma = np.full(RAYS.shape[1], 0.02)
    for truth in (NORMAL, other):
        start = truth + 0.05 * np.array([1, -1, 0.5])
        start /= np.linalg.norm(start)
        found = plane_normal(AngleModel.PPA, axial, RAYS, sigma, initial_normal=start)
        assert error_deg(found.normal, truth) < 3
        assert found.outlier_share > 0.3


def test_random_planes_and_turned_cameras():
    rng = np.random.default_rng(0)
    sigma = np.full(RAYS.shape[1], 0.02)
    for _ in range(20):
        zenith, phase = rng.uniform(0.1, 1.2), rng.uniform(0, np.pi)
        normal = normal_from_angles(AngleModel.PPA, np.array(phase), np.array(zenith), np.eye(3)[2])
        estimate = plane_normal(AngleModel.PPA, plane_axial(normal), RAYS, sigma)
        assert error_deg(estimate.normal, normal) < 1e-5


def test_noise_is_averaged_and_sigma_is_honest():
    rng = np.random.default_rng(1)
    some = np.linspace(0, RAYS.shape[1] - 1, 4000).astype(int)
    rays, sigma = RAYS[:, some], np.exp(rng.uniform(-4, -2.3, 4000))
    phase = phase_from_normal(AngleModel.PPA, NORMAL, rays.T)
    ratios = []
    for _ in range(80):
        estimate = plane_normal(AngleModel.PPA, axial_of(phase, rng, sigma), rays, sigma)
        ratios.append(error_deg(estimate.normal, NORMAL) / estimate.sigma_deg)
    # Error in two dimensions, deviation along the larger axis; the larger of two estimates of it.
    assert 0.7 < np.sqrt(np.mean(np.square(ratios))) < 1.3


def test_covariance_is_that_of_the_errors():
    """Squared errors in units of the covariance have a mean of 2: one for each direction."""
    rng = np.random.default_rng(3)
    some = np.linspace(0, RAYS.shape[1] - 1, 4000).astype(int)
    rays, sigma = RAYS[:, some], np.full(4000, 0.05)
    phase = phase_from_normal(AngleModel.PPA, NORMAL, rays.T)
    squared, errors, covariances = [], [], []
    for _ in range(80):
        estimate = plane_normal(AngleModel.PPA, axial_of(phase, rng, sigma), rays, sigma)
        error = estimate.normal - NORMAL
        inverse = np.linalg.pinv(estimate.covariance, rcond=1e-6, hermitian=True)
        squared.append(error @ inverse @ error)
        errors.append(error)
        covariances.append(estimate.covariance)
        variance = np.linalg.eigvalsh(estimate.covariance)
        assert np.degrees(np.sqrt(variance[2])) == pytest.approx(estimate.sigma_deg)
        np.testing.assert_allclose(estimate.covariance @ estimate.normal, 0, atol=1e-15)
    assert 1.2 < np.mean(squared) < 2.8  # 80 of chi-squared with 2: 2 +- 0.22; the scatter is noisy
    found, stated = np.cov(np.transpose(errors)), np.mean(covariances, axis=0)
    across = np.linalg.eigh(stated)[1][:, 1:]
    ratio = np.diag(across.T @ found @ across) / np.diag(across.T @ stated @ across)
    assert ((ratio > 0.5) & (ratio < 1.6)).all()


def test_no_covariance_where_the_rows_have_rank_one():
    axial = plane_axial(model=AngleModel.OPA)
    estimate = plane_normal(AngleModel.OPA, axial, RAYS, np.full(RAYS.shape[1], 0.02))
    assert not estimate.valid
    assert np.isnan(estimate.covariance).all()
    assert estimate.sigma_deg == np.inf


def test_the_bias_of_the_eigenvector_is_not_in_the_robust_one():
    rng = np.random.default_rng(2)
    sigma = np.full(RAYS.shape[1], 0.15)
    errors = {True: [], False: []}
    for _ in range(5):
        axial = plane_axial(rng=rng, sigma=0.15)
        for robust, found in errors.items():
            estimate = plane_normal(AngleModel.PPA, axial, RAYS, sigma, robust=robust)
            found.append(error_deg(estimate.normal, NORMAL))
    assert np.mean(errors[True]) < 0.25
    assert np.mean(errors[False]) > 4 * np.mean(errors[True])


def test_outliers_lose():
    rng = np.random.default_rng(3)
    axial = plane_axial(rng=rng, sigma=0.02, outliers=0.3)
    sigma = np.full(RAYS.shape[1], 0.02)
    robust = plane_normal(AngleModel.PPA, axial, RAYS, sigma)
    algebraic = plane_normal(AngleModel.PPA, axial, RAYS, sigma, robust=False)
    assert error_deg(robust.normal, NORMAL) < 0.1
    assert error_deg(algebraic.normal, NORMAL) > 2
    assert robust.outlier_share == pytest.approx(0.27, abs=0.03)


def test_opa_knows_the_azimuth_only():
    sigma = np.full(RAYS.shape[1], 0.02)
    for robust in (True, False):
        axial = plane_axial(model=AngleModel.OPA)
        estimate = plane_normal(AngleModel.OPA, axial, RAYS, sigma, robust=robust)
        assert not estimate.valid
        assert estimate.conditioning < 1e-6
        assert estimate.sigma_deg == np.inf
        assert estimate.rmse_deg < 1e-5
        expected = NORMAL[:2] / np.linalg.norm(NORMAL[:2])
        assert abs(estimate.normal[:2] @ expected) == pytest.approx(1, abs=1e-9)
    # Of phases that PPA made it leaves degrees.
    estimate = plane_normal(AngleModel.OPA, plane_axial(), RAYS, sigma)
    assert estimate.rmse_deg > 5
    best = plane_normal(AngleModel.PPA, plane_axial(), RAYS, sigma)
    assert best.rmse_deg < 1e-5


def test_one_pixel_and_none_are_not_enough():
    for num in (0, 1):
        estimate = plane_normal(
            AngleModel.PPA, plane_axial()[:, :num], RAYS[:, :num], np.full(num, 0.01)
        )
        assert not estimate.valid
        assert np.isnan(estimate.normal).all()
        assert estimate.num_pixels == num


def test_pixels_of_one_plane_of_incidence_are_not_enough():
    # On the image line through the foot of the normal all rows are the same.
    share = np.linspace(-0.4, 0.4, 50)
    rays = np.array([0.0, 0.0, 1.0])[:, None] + share * np.array([NORMAL[0], NORMAL[1], 0])[:, None]
    axial = axial_of(phase_from_normal(AngleModel.PPA, NORMAL, rays.T))
    estimate = plane_normal(AngleModel.PPA, axial, rays, np.full(50, 0.01))
    assert not estimate.valid
    assert estimate.rmse_deg < 1e-5


def test_unknown_pixels_are_left_out():
    axial, sigma = plane_axial(), np.full(RAYS.shape[1], 0.02)
    axial[:, 0], axial[0, 1], sigma[2], sigma[3] = 0, np.nan, np.inf, 0
    estimate = plane_normal(AngleModel.PPA, axial, RAYS, sigma)
    assert estimate.num_pixels == RAYS.shape[1] - 4
    assert error_deg(estimate.normal, NORMAL) < 1e-5
    residuals = phase_residuals(AngleModel.PPA, NORMAL, axial, RAYS)
    assert np.isnan(residuals[:2]).all()
    np.testing.assert_allclose(residuals[2:], 0, atol=1e-9)


def test_residuals_are_measured_minus_predicted():
    phase = phase_from_normal(AngleModel.PPA, NORMAL, RAYS.T)
    residuals = phase_residuals(AngleModel.PPA, NORMAL, axial_of(phase + 0.3), RAYS)
    np.testing.assert_allclose(residuals, 0.3, atol=1e-9)
    assert not phase_residuals(AngleModel.OPA, NORMAL, axial_of(phase), RAYS).max() < 0.05


def test_shapes_are_checked():
    with pytest.raises(ValueError, match="expected"):
        plane_normal(AngleModel.PPA, plane_axial()[:, :5], RAYS, np.ones(RAYS.shape[1]))


# Several planes.

CORNER = Group(
    [Plane([0, 0, 0], [0, 0, 1]), Plane([0, 0, 0], [0, 1, 0.1]), Plane([0, 0, 0], [1, 0.2, 0])]
)


def render_corner(surface=CORNER, seed=0):
    view = View(name="a", camera=CAMERA, cam_from_world=look_at([0.5, 0.6, 0.55], [0.0, 0.0, 0.05]))
    rendered = render_view(view, surface)
    images = add_noise(rendered.intensities, rng=np.random.default_rng(seed), full_well=2000)
    s1, s2 = images[0] - images[2], images[1] - images[3]
    dolp = np.hypot(s1, s2) / (0.5 * images.sum(axis=0))
    return rendered, np.stack([-s1, -s2]), 0.01 / dolp, rendered.mask & (dolp > 0.1)


def test_the_three_planes_of_a_corner_are_found():
    rendered, axial, sigma, mask = render_corner()
    rays = RAYS.reshape(3, *mask.shape)
    planes = find_planes(AngleModel.PPA, axial, rays, sigma, mask)
    assert len(planes) == 3
    assert sum(plane.mask.astype(int) for plane in planes).max() == 1
    assert sum(plane.mask.sum() for plane in planes) > 0.85 * mask.sum()
    for plane in planes:
        agreement = rendered.normals_in_cam[plane.mask] @ plane.estimate.normal
        assert np.mean(agreement > np.cos(np.radians(2))) > 0.98
        assert np.degrees(np.arccos(np.median(agreement))) < 0.3
        assert plane.estimate.num_pixels == plane.mask.sum()


def test_one_plane_is_one_plane_and_a_seed_repeats():
    rendered, axial, sigma, mask = render_corner(Plane([0, 0, 0], [0.1, 0.2, 1]))
    rays = RAYS.reshape(3, *mask.shape)
    planes = [find_planes(AngleModel.PPA, axial, rays, sigma, mask, seed=1) for _ in range(2)]
    assert len(planes[0]) == 1
    np.testing.assert_array_equal(planes[0][0].mask, planes[1][0].mask)
    normal = rendered.normals_in_cam[mask][0]
    assert error_deg(planes[0][0].estimate.normal, normal) < 0.1


def test_nothing_but_noise_has_no_plane():
    rng = np.random.default_rng(4)
    shape = (CAMERA.height, CAMERA.width)
    axial = axial_of(rng.uniform(0, np.pi, shape))
    rays, mask = RAYS.reshape(3, *shape), np.ones(shape, bool)
    assert find_planes(AngleModel.PPA, axial, rays, np.full(shape, 0.02), mask) == []
    assert find_planes(AngleModel.PPA, axial, rays, np.full(shape, 0.02), ~mask) == []


def test_a_sphere_beside_a_plane_leaves_the_plane_alone():
    surface = Group([Plane([0, 0, 0], [0, 0, 1]), Sphere([0.1, 0.12, 0.1], 0.1)])
    rendered, axial, sigma, mask = render_corner(surface)
    [largest, *_] = find_planes(AngleModel.PPA, axial, RAYS.reshape(3, *mask.shape), sigma, mask)
    floor = rendered.view.cam_from_world.rotation @ [0, 0, 1]
    assert error_deg(largest.estimate.normal, floor) < 0.3


# Focal length.


def focal_samples(sensor, light=Light.SPECULAR, seed=0):
    # Weakly polarized light needs the blur or, here, the more light.
    full_well = 1e4 if light is Light.SPECULAR else 1e6
    view = View(name="a", camera=CAMERA, cam_from_world=look_at([0.1, 0.5, 0.5], [0.0, 0.1, 0.0]))
    rendered = render_view(view, Plane([0, 0, 0], [0.1, 0.0, 1]), sensor=sensor, light=str(light))
    i0, i45, i90, i135 = add_noise(
        rendered.intensities, rng=np.random.default_rng(seed), full_well=full_well
    )
    parameters = np.stack([0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135])
    dolp = np.hypot(parameters[1], parameters[2]) / parameters[0]
    used = rendered.mask & (rendered.dolp > 0.1)
    used[::2] = False  # to be quick
    offsets = pixel_centers(CAMERA.width, CAMERA.height)[used] - [CAMERA.cx, CAMERA.cy]
    sigma = 0.5 / np.sqrt(full_well) / dolp[used]
    return parameters[:, used], offsets.T, sigma, rendered.normals_in_cam[used][0]


@pytest.mark.parametrize("light", list(Light))
def test_the_focal_length_is_found_within_its_uncertainty(light):
    normalized = []
    for seed in range(2):
        parameters, offsets, sigma, normal = focal_samples("tilted", light, seed)
        estimate = estimate_focal(
            AngleModel.TILTED, parameters, offsets, sigma, light=light, focal_range_px=(40, 800)
        )
        assert estimate.observable
        assert estimate.sigma_px < 0.05 * CAMERA.fx
        assert error_deg(estimate.plane.normal, normal) < 1
        normalized.append((estimate.focal_px - CAMERA.fx) / estimate.sigma_px)
    assert np.abs(normalized).max() < 3.5


def test_under_ppa_every_focal_length_fits_alike():
    parameters, offsets, sigma, _ = focal_samples("ppa")
    estimate = estimate_focal(
        AngleModel.PPA, parameters, offsets, sigma, light=Light.SPECULAR, focal_range_px=(40, 800)
    )
    assert not estimate.observable
    assert estimate.sigma_px == np.inf
    assert np.ptp(estimate.scan_rmse_deg) < 0.01 * estimate.scan_rmse_deg.mean()


def test_a_ppa_sensor_has_no_focal_length_under_the_tilted_model():
    # Without tilt the least correction fits best: the longest focal length of any range.
    parameters, offsets, sigma, _ = focal_samples("ppa")
    estimate = estimate_focal(
        AngleModel.TILTED,
        parameters,
        offsets,
        sigma,
        light=Light.SPECULAR,
        focal_range_px=(40, 800),
    )
    assert not estimate.observable
    with pytest.raises(ValueError, match="focal_range_px"):
        estimate_focal(
            AngleModel.PPA, parameters, offsets, sigma, light=Light.SPECULAR, focal_range_px=(9, 2)
        )


# Pixels.


def test_a_polygon_contains_the_pixels_whose_centres_it_does():
    mask = polygon_mask([(0, 0), (4, 0), (0, 4)], (5, 5))
    # Centres with x + y < 4: the diagonal itself is out.
    assert mask.sum(axis=1).tolist() in ([3, 2, 1, 0, 0], [4, 3, 2, 1, 0])
    assert polygon_mask([(-5, -5), (9, -5), (9, 9), (-5, 9)], (5, 5)).all()


# What the shared captures gave when this was written.


@needs_board
def test_normals_of_the_board():
    capture, truth = open_capture(BOARD), open_ground_truth(BOARD)
    errors = {}
    for name in capture.names[::2]:
        stokes, part = capture.load(name), truth.mask(name)
        camera = truth.views[name].camera
        assert isinstance(camera, PinholeCamera)
        normal = truth.normals(name)[part].mean(axis=0)
        normal /= np.linalg.norm(normal)
        mask = part & stokes.valid & (stokes.dolp > 0.1)
        view = PlaneView(stokes=stokes, mask=mask, light=Light.SPECULAR)
        for model in (AngleModel.PPA, AngleModel.TILTED):
            for robust in (True, False):
                estimate = view.plane(model, camera, robust=robust)
                errors.setdefault((model, robust), []).append(error_deg(estimate.normal, normal))
    mean = {key: np.mean(values) for key, values in errors.items()}
    assert mean[AngleModel.PPA, False] < 2.4
    assert mean[AngleModel.PPA, True] < 1.5  # the tilt of the rendered polarizers
    assert mean[AngleModel.TILTED, False] < 1.7
    assert mean[AngleModel.TILTED, True] < 0.1


def test_phases_of_pixels_err_by_noise_model_and_mixed_light():
    one = np.ones((1, 1), np.float32)
    stokes = Stokes(
        s0=0.5 * one, s1=0.06 * one, s2=0.08 * one, sigma=0.01 * one, valid=one.astype(bool)
    )
    # sqrt(0.014^2 + (0.006^2 + (0.01 / 2 / 0.5)^2) / 0.2^2)
    assert phase_sigma(stokes)[0, 0] == pytest.approx(0.05997, rel=1e-3)
