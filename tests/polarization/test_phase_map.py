"""Smoothing of the Stokes images into a phase map."""

import numpy as np
import pytest

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.config import Light
from polmvs.geometry import RigidTransform
from polmvs.polarization.phase_map import PhaseTolerances, build_phase_map
from polmvs.polarization.region import Region
from polmvs.polarization.stokes import Stokes
from polmvs.scene import View

WIDTH, HEIGHT = 48, 40


def disc(radius: float) -> np.ndarray:
    xy = pixel_centers(WIDTH, HEIGHT) - (WIDTH / 2, HEIGHT / 2)
    return np.linalg.norm(xy, axis=-1) < radius


def build(s0, s1, s2, sigma, reliable, **tolerances):
    camera = PinholeCamera(
        width=WIDTH, height=HEIGHT, fx=60.0, fy=60.0, cx=WIDTH / 2, cy=HEIGHT / 2
    )
    pose = RigidTransform(np.eye(3), np.zeros(3))
    view = View(name="a", camera=camera, cam_from_world=pose)
    nothing = np.zeros_like(reliable)
    s0, s1, s2, sigma = (np.asarray(image, np.float32) for image in (s0, s1, s2, sigma))
    stokes = Stokes(s0=s0, s1=s1, s2=s2, sigma=sigma, valid=reliable)
    region = Region(reliable, reliable, nothing)
    return build_phase_map(
        view, stokes, region, Light.DIFFUSE, tolerances=PhaseTolerances(**tolerances)
    )


def test_an_outline_does_not_turn_phases():
    """Stokes images that vary linearly keep their values where half of the window is off."""
    xy = pixel_centers(WIDTH, HEIGHT)
    s1, s2 = 0.1 + 0.01 * xy[..., 0], 0.6 - 0.012 * xy[..., 1]
    inside = disc(15.0)
    phase_map = build(np.ones_like(s1), s1, s2, np.full_like(s1, 1e-3), inside)
    found = phase_map.samples[..., :2][inside]
    # The mean of half a Gaussian of 1.5 px lies 1.2 px inside: 0.014 off; the ridge leaves 5 %.
    assert np.abs(found - np.stack([s1, s2], axis=-1)[inside]).max() < 0.0015


@pytest.mark.parametrize("beside", ["middle", "outline"])
def test_precision_is_that_of_the_noise(beside):
    rng = np.random.default_rng(1)
    inside = disc(15.0)
    where = disc(8.0) if beside == "middle" else inside & ~disc(14.0)
    shape, sigma, dolp = (HEIGHT, WIDTH), 0.05, 0.8
    turns = []
    for _ in range(40):
        s1 = dolp + sigma * rng.standard_normal(shape)
        s2 = sigma * rng.standard_normal(shape)
        stokes = (np.ones(shape), s1, s2, np.full(shape, sigma))
        phase_map = build(*stokes, inside, model_sigma=0.0, mixture_sigma=0.0)
        cos2, sin2, precision = phase_map.samples[where].T
        turns.append(0.5 * np.arctan2(sin2, cos2) * np.sqrt(precision))
    assert np.std(np.concatenate(turns)) == pytest.approx(1.0, rel=0.1)


def test_no_light_gives_no_phase():
    inside = disc(15.0)
    dark = np.zeros((HEIGHT, WIDTH))
    phase_map = build(dark, dark, dark, np.full_like(dark, 1e-3), inside)
    assert not phase_map.samples.any()
