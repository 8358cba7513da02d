"""The tilted polarizer's correction: exact rows for both kinds of light, and its noise."""

import numpy as np
import pytest

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.polarization.angle_models import (
    correct_parameters,
    correct_stokes,
    rows_from_phase,
    sigma_scale,
    tilt_turn,
)
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.stokes import Stokes
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Plane, Sphere

CAMERA = PinholeCamera(width=48, height=40, fx=27.0, fy=28.0, cx=24.3, cy=19.6)  # 49 deg off axis
SURFACES = {
    "plane": Plane([0.02, 0.01, 0.03], [0.3, -0.2, 1.0]),
    "sphere": Sphere([0.0, 0.0, -0.1], 0.25),
}
RAYS = CAMERA.rays(pixel_centers(CAMERA.width, CAMERA.height))

pytestmark = pytest.mark.parametrize("light", list(Light))


def render(surface, light, sensor="tilted"):
    [view, *_] = ring_of_views(3, CAMERA, distance=0.5, elevation_deg=50.0, roll_deg=20.0)
    return render_view(view, surface, light=str(light), sensor=sensor)


def parameters_of(intensities):
    i0, i45, i90, i135 = intensities
    return np.stack([0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135])


def corrected(intensities, light, rays=RAYS):
    parameters = parameters_of(intensities)
    return correct_parameters(parameters, rays, diffuse=light is Light.DIFFUSE)


def phase_of(s1, s2, light):
    return 0.5 * np.arctan2(s2, s1) + (np.pi / 2 if light is Light.SPECULAR else 0.0)


def true_rows(rendered):
    rows = np.cross(RAYS, rendered.normals_in_cam)
    return rows / np.linalg.norm(rows, axis=-1, keepdims=True)


def sine_between(a, b):
    return np.linalg.norm(np.cross(a, b), axis=-1)


@pytest.mark.parametrize("name", SURFACES)
def test_rows_are_exact(name, light):
    rendered = render(SURFACES[name], light)
    s0, s1, s2 = corrected(rendered.intensities, light)
    used = rendered.mask & (rendered.dolp > 1e-3)
    assert used.sum() > 300
    rows = rows_from_phase(AngleModel.TILTED, phase_of(s1, s2, light), RAYS)
    assert sine_between(rows, true_rows(rendered))[used].max() < 1e-9
    np.testing.assert_allclose(s0[used], 0.8, rtol=1e-12)
    np.testing.assert_allclose(np.hypot(s1, s2)[used], 0.8 * rendered.dolp[used], rtol=1e-9)


def test_without_correction_rows_are_degrees_off(light):
    rendered = render(SURFACES["plane"], light)
    _, s1, s2 = parameters_of(rendered.intensities)
    rows = rows_from_phase(AngleModel.PPA, phase_of(s1, s2, light), RAYS)
    assert sine_between(rows, true_rows(rendered)).max() > np.sin(np.radians(3))


@pytest.mark.parametrize("shape", [(), (1,), (7,), (2, 3)])
def test_parameters_may_have_any_shape(shape, light):
    rng = np.random.default_rng(0)
    rays = RAYS[rng.integers(40, size=shape), rng.integers(48, size=shape)]
    parameters = rng.uniform(0.1, 1, (3, *shape))
    corrected = correct_parameters(parameters, rays, diffuse=light is Light.DIFFUSE)
    assert corrected.shape == (3, *shape)
    flat = correct_parameters(
        parameters.reshape(3, -1), rays.reshape(-1, 3), diffuse=light is Light.DIFFUSE
    )
    np.testing.assert_allclose(corrected.reshape(3, -1), flat, rtol=1e-12)


def test_on_the_axis_nothing_is_corrected(light):
    axis = np.array([[[0.0, 0.0, 1.0]]])
    parameters = np.array([0.8, 0.3, -0.2]).reshape(3, 1, 1)
    corrected = correct_parameters(parameters, axis, diffuse=light is Light.DIFFUSE)
    np.testing.assert_allclose(corrected, parameters, rtol=1e-12)


def test_unpolarized_light_stays_so(light):
    parameters = np.array([0.8, 0.0, 0.0])[:, None, None] * np.ones(RAYS.shape[:2])
    s0, s1, s2 = corrected(np.full((4, *RAYS.shape[:2]), 0.4), light)
    np.testing.assert_allclose(s0, 0.8, rtol=1e-12)
    np.testing.assert_allclose([s1, s2], 0, atol=1e-12)
    dark = correct_parameters(np.zeros_like(parameters), RAYS, diffuse=light is Light.DIFFUSE)
    np.testing.assert_array_equal(dark, 0)  # not NaN
    np.testing.assert_array_equal(
        sigma_scale(s1 * 0, s2 * 0, RAYS, diffuse=light is Light.DIFFUSE), 1
    )


def test_single_precision_is_kept(light):
    rendered = render(SURFACES["plane"], light)
    rays = RAYS.astype(np.float32)
    intensities = rendered.intensities.astype(np.float32)
    s0, s1, s2 = corrected(intensities, light, rays)
    assert s0.dtype == s1.dtype == s2.dtype == np.float32
    rows = rows_from_phase(AngleModel.TILTED, phase_of(s1, s2, light), rays)
    used = rendered.dolp > 0.02
    assert sine_between(rows, true_rows(rendered))[used].max() < 3e-5


def test_kinds_of_light_may_differ_by_pixel(light):
    rendered = render(SURFACES["plane"], light)
    parameters = parameters_of(rendered.intensities)
    some = np.zeros(RAYS.shape[:2], bool)
    some[::2] = True
    mixed = correct_parameters(parameters, RAYS, diffuse=some)
    for diffuse in (True, False):
        alone = correct_parameters(parameters, RAYS, diffuse=diffuse)
        np.testing.assert_array_equal(mixed[:, some == diffuse], alone[:, some == diffuse])


def test_the_turn_of_a_tilt_is_that_of_the_correction(light):
    rendered = render(SURFACES["plane"], light)
    diffuse = light is Light.DIFFUSE
    _, s1, s2 = parameters_of(rendered.intensities)
    _, t1, t2 = corrected(rendered.intensities, light)
    measured, exact = phase_of(s1, s2, light), phase_of(t1, t2, light)
    turn = tilt_turn(np.cos(2 * measured), np.sin(2 * measured), RAYS, diffuse=diffuse)
    assert np.abs(turn).max() > np.radians(3)
    np.testing.assert_allclose(np.sin(exact - measured - turn), 0, atol=1e-9)


def test_sigma_is_that_of_the_corrected_images(light):
    # The turn of the row about its ray is the turn of e: sigma_scale undoes what projection did.
    rendered = render(SURFACES["plane"], light)
    rng = np.random.default_rng(2)
    parameters = parameters_of(rendered.intensities)
    clean = correct_parameters(parameters, RAYS, diffuse=light is Light.DIFFUSE)
    length = np.hypot(clean[1], clean[2])
    sigma, errors = 1e-4, []
    for _ in range(60):
        noise = sigma * rng.standard_normal(parameters.shape)
        noise[0] = 0
        noisy = correct_parameters(parameters + noise, RAYS, diffuse=light is Light.DIFFUSE)
        errors.append((clean[1] * noisy[2] - clean[2] * noisy[1]) / length)
    scale = sigma_scale(clean[1], clean[2], RAYS, diffuse=light is Light.DIFFUSE)
    normalized = np.array(errors) / (sigma * scale)
    # Of the whole image; single pixels differ by the solver's own gain.
    assert normalized.std() == pytest.approx(1, abs=0.03)
    assert np.abs(normalized.std(axis=0) - 1).max() < 0.6
    assert scale.min() < 0.85
    assert scale.max() > 1.05


def test_stokes_are_corrected_with_their_noise(light):
    rendered = render(SURFACES["plane"], light)
    s0, s1, s2 = parameters_of(rendered.intensities).astype(np.float32)
    stokes = Stokes(
        s0=s0, s1=s1, s2=s2, sigma=np.full_like(s0, 0.01), valid=np.ones(s0.shape, bool)
    )
    corrected = correct_stokes(stokes, RAYS, diffuse=light is Light.DIFFUSE)
    expected = correct_parameters(np.stack([s0, s1, s2]), RAYS, diffuse=light is Light.DIFFUSE)
    np.testing.assert_allclose([corrected.s0, corrected.s1, corrected.s2], expected, rtol=1e-5)
    assert corrected.s1.dtype == corrected.sigma.dtype == np.float32
    scale = sigma_scale(corrected.s1, corrected.s2, RAYS, diffuse=light is Light.DIFFUSE)
    np.testing.assert_allclose(corrected.sigma, 0.01 * scale, rtol=1e-5)


def test_shapes_are_checked(light):
    with pytest.raises(ValueError, match="expected"):
        correct_parameters(np.zeros((3, 5)), RAYS, diffuse=light is Light.DIFFUSE)
