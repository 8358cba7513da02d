"""The stated deviation of smoothed phases: what smoothing does not lessen stays in it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.config import BayerOrder
from polmvs.geometry import RigidTransform
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import Light
from polmvs.polarization.mosaic import (
    noise_area_px,
    split_colour_mosaic,
    split_mosaic,
    split_mosaic_full,
)
from polmvs.polarization.phase_map import PhaseTolerances, build_phase_map
from polmvs.polarization.region import Region
from polmvs.polarization.stokes import axial_difference, stokes_from_intensities
from polmvs.scene import View

# No light of another kind is mixed in: what is left is noise and gains.
PURE = PhaseTolerances(model_sigma=1e-6, mixture_sigma=0.0)


def view_of(width: int, height: int) -> View:
    camera = PinholeCamera(
        width=width, height=height, fx=200.0, fy=200.0, cx=width / 2, cy=height / 2
    )
    return View(name="a.png", camera=camera, cam_from_world=RigidTransform(np.eye(3), np.zeros(3)))


def everywhere(shape: tuple[int, int]) -> Region:
    whole = np.ones(shape, bool)
    return Region(whole, whole, np.zeros(shape, bool))


def phases(samples: np.ndarray) -> np.ndarray:
    return 0.5 * np.arctan2(samples[..., 1], samples[..., 0])


def test_gains_of_the_channels_stay_after_smoothing():
    """Phases of sensors with 2 % gain errors are within the stated deviation as often as normal."""
    rng = np.random.default_rng(3)
    height, width, dolp = 64, 128, 0.3
    polarized = np.arange(height) >= 24
    aolp = np.tile(np.linspace(0, np.pi, width), (height, 1))
    share = np.where(polarized, dolp, 0.0)[:, None]
    within, unaware = [], []
    for _ in range(80):
        images = [
            0.4 * (1 + share * np.cos(2 * (aolp - np.radians(angle)))) for angle in (0, 45, 90, 135)
        ]
        images = np.stack(images) * (1 + 0.02 * rng.normal(size=4))[:, None, None]
        images += rng.normal(0, 0.003, images.shape)
        stokes = stokes_from_intensities(
            images.astype(np.float32), np.zeros((height, width), bool), quantum=0.0
        )
        made = build_phase_map(
            view_of(width, height),
            stokes,
            everywhere((height, width)),
            Light.DIFFUSE,
            tolerances=PURE,
        )
        error = np.abs(axial_difference(phases(made.samples), aolp))[32:-6, 6:-6]
        sigma = 1 / np.sqrt(made.samples[32:-6, 6:-6, 2])
        within.append(np.mean(error < sigma))
        gain = 0.5 * stokes.gain_sigma / dolp
        unaware.append(np.mean(error < np.sqrt(np.maximum(sigma**2 - gain**2, 0))))
    assert np.mean(within) == pytest.approx(0.68, abs=0.07)
    assert np.mean(unaware) < 0.35


def test_compression_is_shared_by_blocks(demo_capture, tmp_path):
    """A JPEG's error of the phase, smoothed, is no smaller than what the map says of it."""
    raw = cv2.imread(str(demo_capture / "raw" / "000.png"), cv2.IMREAD_UNCHANGED)
    (tmp_path / "jpeg").mkdir()
    cv2.imwrite(str(tmp_path / "jpeg" / "000.jpg"), raw, [cv2.IMWRITE_JPEG_QUALITY, 75])
    clean = open_capture(demo_capture).load("000.png")
    capture = open_capture(tmp_path / "jpeg")
    lossy = capture.load("000.jpg")
    assert lossy.lossy_sigma > 0
    strong = clean.valid & lossy.valid & (clean.dolp > 0.15)
    region = Region(strong, strong, np.zeros_like(strong))
    view = view_of(capture.width, capture.height)
    maps = [build_phase_map(view, s, region, Light.SPECULAR) for s in (clean, lossy)]
    known = maps[1].samples[..., 2] > 0
    error = np.abs(axial_difference(phases(maps[1].samples), phases(maps[0].samples)))[known]
    sigma = 1 / np.sqrt(maps[1].samples[known][:, 2])
    assert 0.6 < np.mean(error < sigma) < 0.995  # 0.99: blocks share more than it is told


@pytest.mark.parametrize("dolp", [0.15, 0.5])
def test_interpolated_neighbours_are_not_independent(dolp):
    """Noise of raw samples: the smoothed phase errs by what is stated, not by half as much more."""
    rng = np.random.default_rng(5)
    height, width = 128, 160
    angles = np.tile(np.radians([[90, 45], [135, 0]]), (height, width))
    raw = 0.3 * (1 + dolp * np.cos(2 * (angles - 0.4)))
    raw = raw + rng.normal(0, 0.004, raw.shape)
    images = split_mosaic(raw.astype(np.float32), (90, 45, 135, 0))
    clipped = np.zeros((height, width), bool)
    stokes = stokes_from_intensities(images, clipped, quantum=0.0)
    stokes = replace(stokes, gain_sigma=0.0, noise_area_px=noise_area_px())
    made = build_phase_map(
        view_of(width, height), stokes, everywhere(clipped.shape), Light.DIFFUSE, tolerances=PURE
    )
    inner = np.s_[12:-12, 12:-12]
    z = axial_difference(phases(made.samples), 0.4)[inner] * np.sqrt(made.samples[inner][..., 2])
    assert np.sqrt(np.mean(z**2)) == pytest.approx(1, abs=0.12)


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("colour", [False, True])
def test_pixels_that_share_an_error_are_counted(full, colour):
    """White noise of a mosaic: the variance of large means against that of single pixels."""
    raw = np.random.default_rng(6).normal(0, 1, (1024, 1024)).astype(np.float32)
    pattern = (90, 45, 135, 0)
    if colour:
        image = split_colour_mosaic(raw, pattern, BayerOrder.RGGB, full=full)[0, 0]
    else:
        image = (split_mosaic_full if full else split_mosaic)(raw, pattern)[0]
    side = 32 if full else 16
    means = image.reshape(-1, side, image.shape[1] // side, side).mean(axis=(1, 3))
    area = means.var() * side**2 / image.var()
    assert noise_area_px(colour=colour, full=full) == pytest.approx(area, rel=0.2)


@pytest.mark.parametrize("electrons", [40, 240])
@pytest.mark.parametrize(("level", "dolp"), [(1.5, 0.2), (1.5, 0.5), (2, 0.5), (5, 0.5)])
def test_rounding_that_no_noise_blurs_stays_after_smoothing(level, dolp, electrons):
    """Dark parts of 8-bit images, a step of 40 electrons and of 240: neighbours round alike."""
    rng = np.random.default_rng(4)
    y, x = np.mgrid[-0.5:0.5:120j, -0.5:0.5:160j]
    aolp = 0.6 + 0.3 * x + 0.15 * y
    angles = np.tile(np.radians([[90, 45], [135, 0]]), (60, 80))
    light = level * (1 + 0.3 * x + 0.2 * y) * (1 + dolp * np.cos(2 * (angles - aolp)))
    counted = rng.poisson(light * electrons) + rng.normal(0, 2.5, light.shape)
    samples = np.rint(np.maximum(counted / electrons, 0)).astype(np.float32) / 255
    clipped = np.zeros((60, 80), bool)
    stokes = stokes_from_intensities(split_mosaic(samples, (90, 45, 135, 0)), clipped, darkness=0.0)
    stokes = replace(stokes, noise_area_px=noise_area_px())
    made = build_phase_map(
        view_of(80, 60), stokes, everywhere(clipped.shape), Light.DIFFUSE, tolerances=PURE
    )
    true = aolp.reshape(60, 2, 80, 2).mean(axis=(1, 3))
    inner = np.s_[6:-6, 6:-6]
    error = np.abs(axial_difference(phases(made.samples), true))[inner]
    sigma = 1 / np.sqrt(made.samples[inner][..., 2])
    # Of normal errors 0.68 and 0.95. Rounding errs evenly, up to 1.7 deviations, and few places of
    # the steps are seen.
    assert np.mean(error < sigma) > 0.35
    assert np.mean(error < 2 * sigma) > 0.9


def test_rounding_is_blurred_where_there_is_noise():
    """At two thirds of a step of noise neighbours round apart; smoothing takes that away."""
    samples = np.rint(np.random.default_rng(1).normal(20, 0.7, (120, 160))).astype(np.float32)
    images = split_mosaic(samples / 255, (90, 45, 135, 0))
    stokes = stokes_from_intensities(images, np.zeros((60, 80), bool))
    assert stokes.rounding is None
