"""The stated deviation of smoothed phases: what smoothing does not lessen stays in it."""

import cv2
import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.config import Light
from polmvs.geometry import RigidTransform
from polmvs.polarization.capture import open_capture
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
    polarised = np.arange(height) >= 24
    aolp = np.tile(np.linspace(0, np.pi, width), (height, 1))
    share = np.where(polarised, dolp, 0.0)[:, None]
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
