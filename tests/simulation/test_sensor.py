"""The sensor: noise, levels and faults; and polarizers behind a lens that turns the light."""

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.geometry import unit
from polmvs.polarization.angle_models import correct_parameters, phase_from_normal
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.mosaic import ANGLES_DEG
from polmvs.simulation.options import Optics, SensorOptions
from polmvs.simulation.sensor import (
    draw_channels,
    expose,
    polarizer_images,
    sample_angles,
    stated_sigma,
    vignette,
)

NUM = 20_000


def rays_and_normals(off_axis_deg):
    """Rays at an angle off the axis all about it, and surfaces that face them."""
    rng = np.random.default_rng(0)
    off, around = np.radians(off_axis_deg), rng.uniform(0, 2 * np.pi, NUM)
    flat = np.sin(off) * np.stack([np.cos(around), np.sin(around)], axis=-1)
    rays = np.column_stack([flat, np.full(NUM, np.cos(off))])
    normals = unit(rng.normal(size=(NUM, 3)))
    return rays, normals * -np.sign((normals * rays).sum(axis=-1))[:, None]


def measured(optics, rays, normals, *, diffuse):
    """Stokes parameters of the sensor, (3, N), of fully polarized light."""
    across = unit(np.cross(rays, normals))
    field = np.cross(rays, across) if diffuse else across
    # Turned with its ray onto the axis, by Rodrigues' formula.
    axis = unit(np.cross(rays, [0.0, 0.0, 1.0]))
    cos, sin = rays[:, 2:], np.sqrt(1 - rays[:, 2:] ** 2)
    along = (axis * field).sum(axis=-1, keepdims=True)
    turned = cos * field + sin * np.cross(axis, field) + (1 - cos) * along * axis
    assert np.abs(turned[:, 2]).max() < 1e-12
    angle = np.arctan2(-turned[:, 1], turned[:, 0])
    stokes = np.stack([np.ones(NUM), np.cos(2 * angle), np.sin(2 * angle)], axis=-1)
    zero, half, right, other = (
        polarizer_images(stokes, rays, np.full(NUM, float(angle)), optics, 1.0)
        for angle in ANGLES_DEG
    )
    return np.stack([0.5 * (zero + half + right + other), zero - right, half - other])


def phase_errors(parameters, rays, normals, *, diffuse):
    """Degrees, of PPA."""
    turn = 0.0 if diffuse else np.pi / 2
    phase = 0.5 * np.arctan2(parameters[2], parameters[1]) + turn
    difference = phase - phase_from_normal(AngleModel.PPA, normals, rays)
    return np.degrees(np.abs((difference + np.pi / 2) % np.pi - np.pi / 2))


@pytest.mark.parametrize("diffuse", [False, True])
@pytest.mark.parametrize(("off_axis_deg", "tilted_deg"), [(10, 0.005), (30, 0.2), (45, 1.2)])
def test_no_model_is_exact_behind_a_telecentric_lens(off_axis_deg, tilted_deg, diffuse):
    rays, normals = rays_and_normals(off_axis_deg)
    found = measured(Optics.TELECENTRIC, rays, normals, diffuse=diffuse)
    height = np.cos(np.radians(off_axis_deg))
    largest = np.degrees(np.arcsin((1 - height) / (1 + height)))
    errors = phase_errors(found, rays, normals, diffuse=diffuse)
    assert errors.max() == pytest.approx(largest, rel=1e-3)
    corrected = correct_parameters(found, rays, diffuse=diffuse)
    assert phase_errors(corrected, rays, normals, diffuse=diffuse).max() < tilted_deg


@pytest.mark.parametrize("diffuse", [False, True])
def test_the_tilted_model_is_exact_for_rays_that_a_lens_does_not_turn(diffuse):
    rays, normals = rays_and_normals(40)
    found = measured(Optics.TILTED, rays, normals, diffuse=diffuse)
    corrected = correct_parameters(found, rays, diffuse=diffuse)
    assert phase_errors(corrected, rays, normals, diffuse=diffuse).max() < 1e-6


def test_exposure_gain_black_level_and_full_well():
    """Means and deviations of a grey card are those of the sensor's numbers."""
    rng = np.random.default_rng(0)
    light = np.full(200_000, 0.3)
    for bits in (8, 10, 12, 16):
        options = SensorOptions(bits=bits, gain=2.0, black_level=0.1, full_well=5000, read_noise=20)
        found = expose(light, options, 0.8, rng) / (2**bits - 1)
        assert found.mean() == pytest.approx(2 * 0.8 * 0.3 + 0.1, abs=2e-4)
        variance = 4 * (0.24 / 5000 + (20 / 5000) ** 2) + (1 / (2**bits - 1)) ** 2 / 12
        assert found.std() == pytest.approx(np.sqrt(variance), rel=0.02)
        assert stated_sigma(light[:1], options, 0.8)[0] * 0.8 * 2 == pytest.approx(
            np.sqrt(variance), rel=1e-3
        )
    bright = expose(np.full(100, 50.0), SensorOptions(bits=12, gain=0.5), 1.0, rng)
    assert bright.max() == round(0.5 * 4095)  # a full well holds no more
    assert (expose(np.full(1000, 50.0), SensorOptions(bits=8), 1.0, rng) == 255).all()


def test_faults_of_the_polarizers():
    """Extinction ratio, angles and gains, from what a rotating linear polarizer shows."""
    rays = np.array([[0.0, 0.0, 1.0]])
    ratio = SensorOptions(extinction=50.0)
    faults = draw_channels(ratio, 0)
    turned = np.radians(np.arange(0, 180, 5))
    stokes = np.stack([np.ones(36), np.cos(2 * turned), np.sin(2 * turned)], axis=-1)
    seen = polarizer_images(
        stokes, np.repeat(rays, 36, 0), np.full(36, 45.0), Optics.TILTED, faults.diattenuation
    )
    assert seen.max() / seen.min() == pytest.approx(50)
    assert np.degrees(turned[seen.argmax()]) == pytest.approx(45)
    assert draw_channels(SensorOptions(), 0).diattenuation == 1
    many = [draw_channels(SensorOptions(angle_errors=2.0, gain_errors=0.03), n) for n in range(400)]
    errors = np.array([channels.angles_deg for channels in many]) - ANGLES_DEG
    assert errors.std() == pytest.approx(2.0, rel=0.1)
    gains = np.array([channels.gains for channels in many])
    assert gains.mean(axis=1) == pytest.approx(1)
    assert gains.std() == pytest.approx(0.03 * np.sqrt(3 / 4), rel=0.1)  # of the mean of four


def test_vignetting_is_none_in_the_middle_and_stated_in_the_corners():
    camera = PinholeCamera(width=61, height=51, fx=60.0, fy=60.0, cx=30.5, cy=25.5)
    share = vignette(SensorOptions(vignetting=0.4), camera, np.array([[30.5, 25.5], [0.0, 0.0]]))
    assert share == pytest.approx([1.0, 0.6])
    assert (vignette(SensorOptions(), camera, np.zeros((2, 2))) == 1).all()


def test_the_mosaic_repeats_its_cell():
    angles = sample_angles(SensorOptions(pattern=(0, 45, 90, 135)), (4, 6))
    assert [ANGLES_DEG[k] for k in (angles[2, 4], angles[2, 5], angles[3, 4], angles[3, 5])] == [
        0,
        45,
        90,
        135,
    ]
