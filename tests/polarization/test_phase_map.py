"""Smoothing of the Stokes images into a phase map."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.config import CaptureOptions
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import Light
from polmvs.polarization.phase_map import (
    PhaseTolerances,
    build_phase_map,
    open_phase_map,
    store_phase_map,
)
from polmvs.polarization.region import Region, find_region
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


def test_a_dark_wall_keeps_its_own_phase_beside_a_bright_face():
    """Narrow and a tenth as bright, it may be a printed mark: its phase is not the face's."""
    wall = np.zeros((HEIGHT, WIDTH), bool)
    wall[:, 20:26] = True
    s0 = np.where(wall, 0.05, 0.5)
    phase = np.where(wall, 0.6, 0.0)
    s1, s2 = 0.5 * s0 * np.cos(2 * phase), 0.5 * s0 * np.sin(2 * phase)
    everywhere = np.ones_like(wall)
    images = [np.asarray(image, np.float32) for image in (s0, s1, s2)]
    region = find_region(*images, everywhere, min_dolp=0.1)
    assert not region.reliable[10:30, 21:25].any()  # taken for a mark
    phase_map = build(*images, np.full_like(s0, 1e-4), region.inside)
    cos2, sin2, precision = np.moveaxis(phase_map.samples, -1, 0)
    found = 0.5 * np.arctan2(sin2, cos2)[10:30]
    assert (precision[10:30] > 0).all()
    assert np.abs(found[:, 22:24] - 0.6).max() < 0.01
    assert np.abs(found[:, 20:26] - 0.6).max() < 0.4 * 0.6  # the border is mixed, not the face's
    assert np.abs(found[:, :17]).max() < 0.01


def test_noise_of_dark_pixels_is_stated():
    """Dark pixels of mere noise turn the phase by no more than what is stated."""
    rng = np.random.default_rng(5)
    everywhere = np.ones((HEIGHT, WIDTH), bool)
    dark = rng.random(everywhere.shape) < 0.4
    s0 = np.where(dark, 0.01, 0.5)
    sigma = 0.01
    s1 = 0.5 * s0 + sigma * rng.standard_normal(s0.shape)
    s2 = sigma * rng.standard_normal(s0.shape)
    phase_map = build(s0, s1, s2, np.full_like(s0, sigma), everywhere, model_sigma=0.0)
    turn = 0.5 * np.arctan2(phase_map.samples[..., 1], phase_map.samples[..., 0])
    shares = turn * np.sqrt(phase_map.samples[..., 2])
    # Of 1,140 correlated values, a ninth or so independent.
    assert 0.7 < np.std(shares[5:-5, 5:-5]) < 1.1


def test_no_light_gives_no_phase():
    inside = disc(15.0)
    dark = np.zeros((HEIGHT, WIDTH))
    phase_map = build(dark, dark, dark, np.full_like(dark, 1e-3), inside)
    assert not phase_map.samples.any()


@pytest.mark.parametrize(("level", "bounds"), [(12, (0.6, 0.8)), (100, (0.62, 0.74))])
def test_dark_8_bit_mosaics_state_their_noise(level, bounds, tmp_path: Path):
    """Rounding, shot noise and interpolation at 5 and at 40 % of full scale, end to end."""
    rng = np.random.default_rng(level)
    axes = np.tile(np.radians([[90, 45], [135, 0]]), (100, 100))
    y, x = np.mgrid[:200, :200]
    shade = level * (1 + 0.15 * np.sin(x / 37) + 0.15 * np.cos(y / 53))
    electrons = rng.poisson(0.5 * shade * (1 + 0.5 * np.cos(2 * (axes - 0.5))) / 255 * 1e4)
    noisy = electrons + 2.5 * rng.standard_normal(axes.shape)
    cv2.imwrite(str(tmp_path / "0.png"), np.clip(np.rint(noisy / 1e4 * 255), 0, 255))
    stokes = open_capture(tmp_path, CaptureOptions(full_scale=255.0)).load("0.png")
    inside = np.ones(stokes.shape, bool)
    camera = PinholeCamera(width=100, height=100, fx=120.0, fy=120.0, cx=50.0, cy=50.0)
    view = View(name="a", camera=camera, cam_from_world=RigidTransform(np.eye(3), np.zeros(3)))
    exact = PhaseTolerances(model_sigma=0.0, mixture_sigma=0.0)
    region = Region(inside, inside, ~inside)
    phase_map = build_phase_map(view, stokes, region, Light.DIFFUSE, tolerances=exact)
    cos2, sin2, precision = np.moveaxis(phase_map.samples[5:-5, 5:-5], -1, 0)
    turn = 0.5 * np.arctan2(sin2, cos2) - 0.5
    ratio = np.abs(turn) * np.sqrt(precision)
    assert bounds[0] < (ratio < 1).mean() < bounds[1]
    assert (ratio < 2).mean() > 0.92


@pytest.mark.parametrize("part", ["samples", "intensity", "region", "dolp", "polarization"])
def test_stored_files_of_another_size_are_refused(tmp_path: Path, part: str) -> None:
    flat = np.ones((HEIGHT, WIDTH))
    phase_map = build(flat, 0.2 * flat, 0.1 * flat, 1e-3 * flat, disc(15.0))
    store_phase_map(phase_map, tmp_path)
    assert open_phase_map(phase_map.view, tmp_path).samples.shape == (HEIGHT, WIDTH, 3)
    path = tmp_path / f"{phase_map.view.name}.{part}.npy"
    whole = np.load(path)
    for cut in (whole[1:], whole[:, :-1], *([whole[..., :-1]] if whole.ndim == 3 else [])):
        np.save(path, cut)
        with pytest.raises(DataError, match="has another size than its camera"):
            open_phase_map(phase_map.view, tmp_path)
    np.save(path, whole)
    smaller = replace(phase_map.view.camera, width=WIDTH - 1)
    with pytest.raises(DataError, match="has another size"):
        open_phase_map(replace(phase_map.view, camera=smaller), tmp_path)
