"""``polmvs inspect`` and ``polmvs calibrate`` end to end."""

import json
import shutil

import cv2
import numpy as np
import pytest
from boards import CHECKER, pictures

from polmvs.camera import PinholeCamera
from polmvs.io.intrinsics import read_intrinsics
from polmvs.polarization import inspection
from polmvs.polarization.calibration import read_calibration
from polmvs.synthetic.captures import render_mosaic, ring_of_views
from polmvs.synthetic.sensor import faulty_sensor
from polmvs.synthetic.surfaces import Plane

SHAPE = (96, 128)


def test_inspect_says_what_a_capture_is(cli, demo_capture, tmp_path, monkeypatch):
    written = []
    monkeypatch.setattr(inspection, "_write", lambda picture, text, *where: written.append(text))
    status, out, _ = cli("inspect", demo_capture, "--sheet", tmp_path / "sheet.png")
    assert status == 0
    assert "10 views, raw mosaics; files of 918x768 px, uint8" in out
    assert "fits, or a turned or mirrored one" in out
    assert "clipped in" not in out  # what is clipped is the table
    assert out.splitlines()[-2] == "This capture will do."
    sheet = cv2.imread(str(tmp_path / "sheet.png"))
    assert sheet.shape[1] == 6 * 326
    assert "--pattern 90,45,135,0 fits, or a turned or mirrored one" in written
    status, out, _ = cli("inspect", demo_capture, "--json")
    content = json.loads(out)
    assert len(content["views"]) == 10
    assert content["levels"]["full_scale"] == 255
    assert content["verdict"] == "This capture will do."
    assert content["views"][1]["saturated"] > 0.15 > 0.01 > content["views"][1]["part_saturated"]


def test_inspect_warns_of_bad_captures(cli, tmp_path):
    rng = np.random.default_rng(0)
    folder = tmp_path / "capture"
    folder.mkdir()
    for name, level in (("a", 2), ("b", 20)):
        noise = rng.poisson(level, (240, 320)).astype(np.float32)
        blurred = cv2.GaussianBlur(noise, (0, 0), 8)
        cv2.imwrite(str(folder / f"{name}.png"), np.rint(blurred).astype(np.uint8))
    status, out, _ = cli("inspect", folder)
    assert status == 0
    for words in ("too little polarized light", "expose more", "factor of"):
        assert words in out, words
    assert out.splitlines()[-1].startswith("This capture will not do, because it has 2 views")
    assert "pixels are polarized" in out.splitlines()[-1]


def test_clipped_spots_of_the_part_count(cli, demo_capture, tmp_path):
    """Twice the exposure: the marks and the reflected lamps on the board clip."""
    folder = tmp_path / "capture"
    folder.mkdir()
    for path in sorted((demo_capture / "raw").iterdir())[:4]:
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED).astype(np.float32)
        cv2.imwrite(str(folder / path.name), np.clip(5 * raw, 0, 255).astype(np.uint8))
    out = cli("inspect", folder)[1]
    assert "of the part is clipped in" in out
    assert out.splitlines()[-1].startswith("This capture will do, but the")


def angle_images(folder, demo_capture, gains, stems=("000", "004", "008")):
    """The demo's views as an image for each polarizer angle, each with a gain of its own."""
    folder.mkdir()
    for stem in stems:
        raw = cv2.imread(str(demo_capture / "raw" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)
        sites = {90: (0, 0), 45: (0, 1), 135: (1, 0), 0: (1, 1)}
        for angle, gain in gains.items():
            row, col = sites[angle]
            image = np.minimum(256.0 * gain * raw[row::2, col::2], 65535).astype(np.uint16)
            cv2.imwrite(str(folder / f"{stem}_{angle:03d}.png"), image)
    return folder


EQUAL = {0: 0.5, 45: 0.5, 90: 0.5, 135: 0.5}
UNEQUAL = {0: 0.15, 45: 0.5, 90: 0.6, 135: 0.5}


@pytest.mark.slow
def test_exposures_that_differ_between_angles_are_found_and_made_up_for(
    cli, demo_capture, tmp_path
):
    good = angle_images(tmp_path / "good", demo_capture, EQUAL)
    bad = angle_images(tmp_path / "bad", demo_capture, UNEQUAL)
    status, out, _ = cli("inspect", good)
    assert "differ in exposure" not in out
    status, out, _ = cli("inspect", bad)
    assert status == 0
    assert "differ in exposure by up to a factor of 4.0 (0 deg 0.25, 45 deg 0.83, 90 deg 1" in out
    assert "3 of 3 views" in out
    assert "--equalize" in out.splitlines()[-1]
    views = {
        name: json.loads(cli("inspect", folder, "--json", *flags)[1])["views"]
        for name, folder, flags in (
            ("good", good, ()), ("bad", bad, ()), ("mended", bad, ("--equalize",))
        )
    }  # fmt: skip
    for index in range(3):
        polarized = {name: rows[index]["polarized"] for name, rows in views.items()}
        assert polarized["bad"] > 0.9
        assert polarized["mended"] == pytest.approx(polarized["good"], abs=0.04)
    err = cli("inspect", demo_capture, "--equalize")[2]
    assert "--equalize is of an image for each polarizer angle" in err


def test_inspect_knows_a_colour_sensor(cli, tmp_path):
    camera = PinholeCamera(width=160, height=120, fx=150, fy=150, cx=80, cy=60)
    view = ring_of_views(1, camera)[0]
    mosaic = render_mosaic(view, Plane(point=np.zeros(3), normal=[0, 0, 1]), s0=0.8)
    for block, gain in enumerate((0.5, 1.0, 1.0, 0.7)):
        for i in (0, 1):
            for j in (0, 1):
                mosaic[2 * (block // 2) + i :: 4, 2 * (block % 2) + j :: 4] *= gain
    folder = tmp_path / "capture"
    folder.mkdir()
    cv2.imwrite(str(folder / "a.png"), np.rint(255 * mosaic).astype(np.uint8))
    assert "--bayer" in cli("inspect", folder)[1]
    assert "2x2 rhythm" not in cli("inspect", folder, "--bayer", "rggb")[1]


def write_frames(folder, sensor, *, polarized=True):
    rng = np.random.default_rng(0)

    def save(name, s0, dolp=0.0, angle=0.0):
        twice = 2 * np.radians(angle)
        light = s0 * np.array([1.0, dolp * np.cos(twice), dolp * np.sin(twice)])
        samples = sensor.expose(np.broadcast_to(light[:, None, None], (3, *SHAPE)), rng)
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        deep = np.clip(np.rint(samples * 4095), 0, 4095).astype(np.uint16)
        cv2.imwrite(str(path), deep)

    for k in range(4):
        save(f"unpolarized/{k}.png", 1.5)
        save(f"dark/{k}.png", 0.0)
        for angle in (0, 30, 60, 90, 120, 150) if polarized else ():
            save(f"polarized/{angle:03d}_{k}.png", 0.8, 1.0, angle)


@pytest.mark.parametrize("per_sample", [False, True])
def test_calibrate_polarizers(cli, tmp_path, per_sample):
    sensor = faulty_sensor(SHAPE, np.random.default_rng(0))
    write_frames(tmp_path / "frames", sensor)
    out_file = tmp_path / "sensor.toml"
    flags = ["--full-scale", 4095, *(["--per-sample"] if per_sample else [])]
    status, out, err = cli("calibrate", "polarizers", tmp_path / "frames", out_file, *flags)
    assert status == 0, err
    assert "extinction ratio" in out
    read = read_calibration(out_file)
    assert read.full_scale == 4095
    site = (1, 1), (0, 1), (0, 0), (1, 0)  # of 0, 45, 90, 135
    angles = [sensor.angle_deg[s] for s in site]
    np.testing.assert_allclose(read.angles_deg, angles, atol=0.1)
    assert (read.flat is not None) is per_sample
    if not per_sample:
        gains = np.array([sensor.gain[s] for s in site])
        np.testing.assert_allclose(read.gains, gains / gains.mean(), atol=2e-3)
    status, _, err = cli("calibrate", "polarizers", tmp_path / "frames", out_file)
    assert status == 2
    assert "exists" in err


def test_frames_that_cannot_be_used(cli, tmp_path):
    out = tmp_path / "sensor.toml"
    (tmp_path / "empty").mkdir()
    assert "neither" in cli("calibrate", "polarizers", tmp_path / "empty", out)[2]
    sensor = faulty_sensor(SHAPE, np.random.default_rng(0))
    write_frames(tmp_path / "bright", sensor, polarized=False)
    cv2.imwrite(str(tmp_path / "bright" / "unpolarized" / "9.png"), np.full(SHAPE, 4095, np.uint16))
    assert "clipped" in cli("calibrate", "polarizers", tmp_path / "bright", out)[2]
    write_frames(tmp_path / "misnamed", sensor)
    folder = tmp_path / "misnamed" / "polarized"
    (folder / "000_0.png").rename(folder / "zero.png")
    flags = ("--full-scale", 4095)
    assert "angle" in cli("calibrate", "polarizers", tmp_path / "misnamed", out, *flags)[2]
    assert not out.exists()


def test_calibrate_camera_needs_a_board(cli, demo_capture, tmp_path):
    out, folder = tmp_path / "camera.txt", tmp_path / "capture"
    folder.mkdir()
    for path in sorted((demo_capture / "raw").iterdir())[:3]:
        shutil.copy(path, folder)
    status, _, err = cli("calibrate", "camera", folder, out)
    assert status == 2
    assert "squares" in err
    status, _, err = cli("calibrate", "camera", folder, out, "--cols", 9, "--rows", 7)
    assert status == 1
    assert "0 of 3 pictures" in err
    assert not out.exists()


def test_calibrate_camera_writes_a_colmap_camera(cli, tmp_path):
    folder = tmp_path / "capture"
    folder.mkdir()
    for name, picture in pictures(CHECKER).items():
        # An unpolarized mosaic: every sample of a cell is the picture's.
        cv2.imwrite(str(folder / name), np.kron(picture, np.ones((2, 2), np.uint8)))
    out = tmp_path / "camera.txt"
    status, text, err = cli("calibrate", "camera", folder, out, "--cols", 9, "--rows", 7)
    assert status == 0, err
    assert "6 of 6" in text
    camera = read_intrinsics(out)
    np.testing.assert_allclose(camera.params[:4], [620, 622, 319.0, 241.5], atol=3)
