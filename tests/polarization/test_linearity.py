"""The gamma that samples show: of exact light behind imperfect sensors, and where nothing tells."""

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.polarization.linearity import check_linearity
from polmvs.synthetic.captures import render_mosaic, ring_of_views
from polmvs.synthetic.surfaces import Plane, Sphere

PATTERN = (90, 45, 135, 0)
CAMERA = PinholeCamera(width=240, height=192, fx=180.0, fy=180.0, cx=120.0, cy=96.0)
BOARD = Plane(
    point=np.array([0.0, 0.0, 0.0]), normal=np.array([0.1, -0.05, 1.0]), extent=(0.3, 0.3)
)


def mosaics(sensor: str = "ppa", surface=BOARD, gain: float = 0.0, noise: float = 0.004):
    rng = np.random.default_rng(5)
    gains = 1 + gain * rng.normal(size=(2, 2))
    views = ring_of_views(3, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=40)
    made = []
    for view in views:
        raw = render_mosaic(view, surface, sensor=sensor, s0=0.7, background=0.5)
        raw = raw * np.tile(gains, (CAMERA.height, CAMERA.width))
        made.append(np.clip(raw + rng.normal(0, noise, raw.shape), 0, 1).astype(np.float32))
    return made


@pytest.mark.parametrize("sensor", ["ppa", "tilted"])
@pytest.mark.parametrize("gain", [0.0, 0.03])
@pytest.mark.parametrize("encoding", [0.4545, 0.7, 1.0, 2.0])
def test_the_encoding_is_found_whatever_the_sensor(sensor, gain, encoding):
    raws = [raw**encoding for raw in mosaics(sensor, gain=gain)]
    found = check_linearity(raws, PATTERN, 0.98, 1.0)
    assert found.found == pytest.approx(encoding, rel=max(0.08, 4 * found.log_sigma))
    assert found.fits is (encoding == 1.0)
    decoded = check_linearity(raws, PATTERN, 0.98, encoding)
    assert decoded.fits is True


def test_the_message_names_the_setting_and_its_value():
    message = check_linearity(mosaics(), PATTERN, 0.98, 0.5).message
    assert "`capture.gamma` 0.5 does not fit" in message
    assert message.endswith("Give `capture.gamma` 1")


def test_unpolarized_light_tells_nothing():
    nothing = [np.full((200, 240), 0.4, np.float32)] * 2
    rng = np.random.default_rng(0)
    noisy = [image + rng.normal(0, 0.01, image.shape).astype(np.float32) for image in nothing]
    for raws in (nothing, noisy, []):
        check = check_linearity(raws, PATTERN, 0.98, 2.2)
        assert check.fits is None
        assert "too little polarized light" in check.message


def test_images_that_contradict_each_other_tell_nothing():
    """As of different scenes, in one of which the polarization itself follows the intensity."""
    raws = mosaics()
    check = check_linearity([raws[0], raws[1], raws[2] ** 0.4545], PATTERN, 0.98, 1.0)
    assert check.fits is None
    assert "images that show different things" in check.message


def test_a_curved_surface():
    sphere = Sphere(center=np.zeros(3), radius=0.12)
    raws = mosaics("tilted", sphere, gain=0.02)
    assert check_linearity(raws, PATTERN, 0.98, 1.0).fits is True
    assert check_linearity([raw**0.5 for raw in raws], PATTERN, 0.98, 1.0).fits is False
