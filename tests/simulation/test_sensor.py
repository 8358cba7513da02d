"""Polarizers behind lenses: what the angle models make of light that a telecentric lens turned."""

import numpy as np
import pytest

from polmvs.config import AngleModel
from polmvs.geometry import unit
from polmvs.polarization.angle_models import correct_parameters, phase_from_normal
from polmvs.polarization.mosaic import ANGLES_DEG
from polmvs.simulation.options import Optics
from polmvs.simulation.sensor import polarizer_images

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
