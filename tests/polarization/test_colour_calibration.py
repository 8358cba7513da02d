"""Calibration of a colour sensor's 4x4 cell: each of its four blocks has faults of its own."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from polmvs.cli import main
from polmvs.config import BayerOrder, CaptureOptions
from polmvs.errors import DataError, OptionError
from polmvs.polarization.calibration import (
    measure_colour_response,
    read_calibration,
    write_calibration,
)
from polmvs.polarization.capture import open_capture
from polmvs.polarization.stokes import axial_difference
from polmvs.synthetic.sensor import FaultySensor, faulty_sensor

PATTERN = (90, 45, 135, 0)
BAYER = BayerOrder.RGGB
COLOURS = np.array([[1.0, 0.8], [0.8, 0.6]])  # brightness of the lamp in the four blocks
SHAPE = (96, 128)
POLARIZER_DEG = (0, 20, 45, 70, 90, 110, 135, 160)


def colour_sensor(seed=0, sample_share=0.0) -> FaultySensor:
    """Four sensors, each in its block of the 4x4 cell."""
    rng = np.random.default_rng(seed)
    parts = [faulty_sensor((48, 64), rng, dark=0.01, sample_share=sample_share) for _ in range(4)]

    def joined(name):
        whole = np.empty(SHAPE)
        for k, part in enumerate(parts):
            for cell in range(4):
                row, col = 2 * (k // 2) + cell // 2, 2 * (k % 2) + cell % 2
                whole[row::4, col::4] = getattr(part, name)[cell // 2 :: 2, cell % 2 :: 2]
        return whole

    return FaultySensor(**{n: joined(n) for n in ("gain", "angle_deg", "diattenuation", "dark")})


def light(s0, dolp=0.0, aolp_deg=0.0):
    """Uniform light (3, H, W) through the colour filters."""
    twice = 2 * np.radians(aolp_deg)
    filters = np.kron(np.tile(COLOURS, (24, 32)), np.ones((2, 2)))
    return np.stack([s0 * filters * f for f in (1, dolp * np.cos(twice), dolp * np.sin(twice))])


def response_of(sensor, per_sample=False):
    rng = np.random.default_rng(1)
    num = 20 if per_sample else 3
    return measure_colour_response(
        PATTERN,
        BAYER,
        unpolarized=[sensor.expose(light(1.2), rng) for _ in range(num)],
        polarized=[
            (a, sensor.expose(light(0.9, 1.0, a), rng)) for a in POLARIZER_DEG for _ in range(num)
        ],
        dark=[sensor.expose(light(0.0), rng) for _ in range(num)],
        per_sample=per_sample,
    )


def channel_values(array):
    """Of the channels 0, 45, 90, 135 of each block, row by row."""
    blocks = [array[r : r + 2, c : c + 2] for r in (0, 2) for c in (0, 2)]
    return np.array([[b[1, 1], b[0, 1], b[0, 0], b[1, 0]] for b in blocks])


def test_each_block_is_found():
    sensor = colour_sensor()
    response = response_of(sensor)
    gains = channel_values(sensor.gain)
    gains /= gains.mean(axis=1, keepdims=True)
    np.testing.assert_allclose(response.gains.reshape(4, 4), gains, atol=2e-3)
    angles = channel_values(sensor.angle_deg)
    np.testing.assert_allclose(response.angles_deg.reshape(4, 4), angles, atol=0.1)


def errors_deg(folder, options):
    """AoLP errors of uniform light of 30 degrees, in each colour and combined."""
    found = {}
    for channel in ("red", "green", "blue", "combined"):
        stokes = open_capture(folder, replace(options, channel=channel)).load("a.png")
        error = axial_difference(stokes.aolp, np.radians(30.0))[4:-4, 4:-4]
        found[channel] = np.degrees(np.sqrt(np.mean(error**2)))
    return found


@pytest.mark.parametrize("per_sample", [False, True])
def test_calibration_takes_the_faults_out(tmp_path, per_sample):
    sensor = colour_sensor(3, sample_share=0.5 if per_sample else 0.0)
    (tmp_path / "capture").mkdir()
    raw = sensor.expose(light(1.0, 0.3, 30.0))
    cv2.imwrite(str(tmp_path / "capture" / "a.png"), np.rint(65535 * raw).astype(np.uint16))
    write_calibration(tmp_path / "camera.toml", response_of(sensor, per_sample))
    options = CaptureOptions(bayer=BAYER, full_scale=65535)
    before = errors_deg(tmp_path / "capture", options)
    after = errors_deg(tmp_path / "capture", replace(options, calibration=tmp_path / "camera.toml"))
    # A single colour's faults may cancel each other.
    assert np.mean(list(before.values())) > 0.4
    assert max(after.values()) < 0.2  # noise of twenty frames, of single samples


def test_files_hold_the_blocks(tmp_path):
    response = response_of(colour_sensor())
    written = write_calibration(tmp_path / "camera.toml", response)
    assert written.bayer is BAYER
    np.testing.assert_allclose(written.angles_deg, response.angles_deg, rtol=1e-6)
    text = (tmp_path / "camera.toml").read_text()
    (tmp_path / "few.toml").write_text("version = 1\nbayer = 'rggb'\ngains = [1, 1, 1, 1]")
    with pytest.raises(DataError, match="for each of the four 2x2 blocks"):
        read_calibration(tmp_path / "few.toml")
    (tmp_path / "none.toml").write_text(text.replace('"rggb"', '"rgb"'))
    with pytest.raises(DataError, match="bayer must be one of rggb"):
        read_calibration(tmp_path / "none.toml")


def test_calibrations_of_other_sensors_are_refused(tmp_path):
    (tmp_path / "capture").mkdir()
    raw = colour_sensor().expose(light(1.0, 0.3, 30.0))
    cv2.imwrite(str(tmp_path / "capture" / "a.png"), np.rint(65535 * raw).astype(np.uint16))
    write_calibration(tmp_path / "camera.toml", response_of(colour_sensor()))
    for bayer, words in ((None, "is of rggb, `capture.bayer` is not given"), ("bggr", "is bggr")):
        options = CaptureOptions(bayer=bayer, calibration=tmp_path / "camera.toml")
        with pytest.raises(OptionError, match=words):
            open_capture(tmp_path / "capture", options)


def test_the_command_calibrates_a_colour_sensor(tmp_path, capfd):
    sensor, rng = colour_sensor(), np.random.default_rng(2)
    frames = {"unpolarized/a": light(1.2), "dark/a": light(0.0)}
    frames |= {f"polarized/{a:03}": light(0.9, 1.0, a) for a in POLARIZER_DEG}
    for name, shown in frames.items():
        path = tmp_path / "frames" / f"{name}.png"
        path.parent.mkdir(parents=True, exist_ok=True)
        raw = np.clip(sensor.expose(shown, rng), 0, 1)
        cv2.imwrite(str(path), np.rint(65535 * raw).astype(np.uint16))
    out = tmp_path / "camera.toml"
    arguments = ["calibrate", "polarizers", tmp_path / "frames", out, "--bayer", "rggb"]
    assert main([*map(str, arguments), "--full-scale", "65535"]) == 0
    text = capfd.readouterr().out
    assert "r   0 deg: gain" in text
    assert "b 135 deg: gain" in text
    angles = channel_values(sensor.angle_deg)
    np.testing.assert_allclose(
        np.reshape(read_calibration(out).angles_deg, (4, 4)), angles, atol=0.3
    )
