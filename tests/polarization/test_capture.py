"""Captures on disk: good folders, every kind of bad file, exposure, atomic writing."""

import errno
import os
import struct
from dataclasses import FrozenInstanceError, replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from polmvs.config import BayerOrder, CaptureKind, CaptureOptions, Resolution
from polmvs.errors import DataError
from polmvs.io.capture_files import find_capture
from polmvs.io.images import read_mask, write_bytes, write_png
from polmvs.io.raw_formats import read_raw
from polmvs.polarization.capture import (
    Capture,
    _share,
    intensity_image_8bit,
    open_capture,
    open_image,
)
from polmvs.polarization.stokes import stokes_from_intensities

SHARED = Path(__file__).parents[3] / "shared" / "data"


def mosaic(height=24, width=32, dtype=np.uint8, low=20, high=200, seed=0):
    return np.random.default_rng(seed).integers(low, high, (height, width)).astype(dtype)


def encoded(image, suffix=".png", params=()):
    _, data = cv2.imencode(suffix, image, list(params))
    return data.tobytes()


def save(path, image):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(encoded(image, path.suffix))
    return path


def flat_cells(levels, height=24, width=32, dtype=np.uint8):
    """Raw mosaic of one 2x2 cell, repeated."""
    return np.tile(np.array(levels, dtype), (height // 2, width // 2))


def assert_data_error(path, words, call, *args):
    """The call fails with one line that names the file and contains the words."""
    with pytest.raises(DataError) as caught:
        call(*args)
    message = str(caught.value)
    assert str(path) in message
    assert "\n" not in message
    for word in words:
        assert word in message


# --- reading one mosaic ----------------------------------------------------------------------


@pytest.mark.parametrize("suffix", [".png", ".tif", ".bmp", ".pgm"])
def test_mosaics_are_read_unchanged(tmp_path, suffix):
    image = mosaic()
    path = save(tmp_path / f"a{suffix}", image)
    np.testing.assert_array_equal(read_raw(path).samples, image)
    assert open_image(path).header == (32, 24, 1, "uint8")


@pytest.mark.parametrize("suffix", [".png", ".tif", ".pgm"])
def test_16_bits_are_kept(tmp_path, suffix):
    image = mosaic(dtype=np.uint16, high=65535)
    path = save(tmp_path / f"a{suffix}", image)
    read = read_raw(str(path)).samples
    assert read.dtype == np.uint16
    np.testing.assert_array_equal(read, image)
    assert open_image(path).header == (32, 24, 1, "uint16")


def broken_checksum():
    data = bytearray(encoded(mosaic()))
    data[60] ^= 0xFF
    return bytes(data)


def tiff_with_its_directory_first():
    """An uncompressed TIFF whose end holds pixels, so that a cut leaves the header whole."""
    height, width = 24, 32
    tags = [
        (256, width), (257, height), (258, 8), (259, 1), (262, 1),
        (273, 8 + 2 + 12 * 9 + 4), (277, 1), (278, height), (279, height * width),
    ]  # fmt: skip
    entries = b"".join(struct.pack("<HHII", tag, 4, 1, value) for tag, value in tags)
    header = struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + entries + bytes(4)
    return header + mosaic(height, width).tobytes()


BAD_FILES = {
    "empty.png": (b"", ["empty"]),
    "text.png": (b"this is no image", ["not a readable image"]),
    "signature.png": (encoded(mosaic())[:8], ["truncated"]),
    "half.png": (encoded(mosaic())[:400], ["truncated"]),
    "last_byte.png": (encoded(mosaic())[:-1], ["truncated"]),
    "no_end.png": (encoded(mosaic())[:-12], ["truncated"]),
    "flipped.png": (broken_checksum(), ["damaged", "checksum"]),
    "no_header.png": (encoded(mosaic())[:8] + encoded(mosaic())[33:], ["no header"]),
    "cut.tif": (encoded(mosaic(), ".tif")[:-40], ["truncated"]),
    "cut_pixels.tif": (tiff_with_its_directory_first()[:-40], ["truncated"]),
    "cut.bmp": (encoded(mosaic(), ".bmp")[:-40], ["truncated"]),
    "cut.pgm": (encoded(mosaic(), ".pgm")[:-40], ["truncated"]),
    "colour.png": (encoded(np.dstack([mosaic()] * 3)), ["3 channels", "monochrome"]),
    "alpha.png": (encoded(np.dstack([mosaic()] * 4)), ["3 channels", "monochrome"]),
    "odd_width.png": (encoded(mosaic(24, 31)), ["31x24", "even"]),
    "odd_height.tif": (encoded(mosaic(23, 32), ".tif"), ["32x23", "even"]),
    "float.tif": (encoded(mosaic().astype(np.float32), ".tif"), ["float32", "16-bit"]),
}


@pytest.mark.parametrize("name", BAD_FILES)
def test_bad_files_are_named_with_the_reason(tmp_path, name, capfd):
    data, words = BAD_FILES[name]
    path = tmp_path / name
    path.write_bytes(data)
    assert_data_error(path, words, open_image, path)
    assert capfd.readouterr().err == ""  # OpenCV's own complaints stay off the terminal


def test_the_uncut_twin_of_the_handmade_tiff_is_read(tmp_path):
    path = tmp_path / "whole.tif"
    path.write_bytes(tiff_with_its_directory_first())
    np.testing.assert_array_equal(read_raw(path).samples, mosaic())


def test_missing_file_and_folder_in_place_of_a_file(tmp_path):
    assert_data_error("gone.png", ["no such file"], read_raw, tmp_path / "gone.png")
    assert_data_error(tmp_path, ["cannot be read"], read_raw, tmp_path)


# --- masks and writing -----------------------------------------------------------------------


def test_mask_is_true_where_any_colour_is_not_black(tmp_path):
    gray = np.zeros((12, 16), np.uint8)
    gray[2:5, 3:9] = 1
    np.testing.assert_array_equal(read_mask(save(tmp_path / "m.png", gray), (12, 16)), gray > 0)
    colour = np.zeros((12, 16, 4), np.uint8)
    colour[..., 3] = 255
    colour[2:5, 3:9, 1] = 200
    mask = read_mask(save(tmp_path / "c.png", colour), (12, 16))
    assert mask.dtype == bool
    np.testing.assert_array_equal(mask, gray > 0)


def test_mask_of_another_size_names_both(tmp_path):
    path = save(tmp_path / "m.png", np.ones((24, 32), np.uint8))
    assert_data_error(path, ["32x24", "16x12"], read_mask, path, (12, 16))
    assert_data_error("gone.png", ["no such file"], read_mask, tmp_path / "gone.png", (1, 1))


@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_png_round_trip_replaces_an_older_file(tmp_path, dtype):
    path = tmp_path / "a.tif"  # a PNG whatever its name
    path.write_bytes(b"older")
    write_png(path, mosaic(dtype=dtype))
    assert path.read_bytes().startswith(b"\x89PNG")
    np.testing.assert_array_equal(read_raw(path).samples, mosaic(dtype=dtype))
    assert [p.name for p in tmp_path.iterdir()] == ["a.tif"]


def test_a_full_disk_leaves_the_older_file_and_no_temporary(tmp_path, monkeypatch):
    path = tmp_path / "a.png"
    path.write_bytes(b"older")

    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    assert_data_error(path, [os.strerror(errno.ENOSPC)], write_png, path, mosaic())
    assert [p.name for p in tmp_path.iterdir()] == ["a.png"]
    assert path.read_bytes() == b"older"


def test_an_interrupted_write_leaves_nothing(tmp_path, monkeypatch):
    def interrupted(source, target):
        raise KeyboardInterrupt

    monkeypatch.setattr(os, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_bytes(tmp_path / "a.png", b"data")
    assert list(tmp_path.iterdir()) == []


def test_only_plain_files_are_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe.png")
    (tmp_path / "folder.png").mkdir()
    for path in (tmp_path / "pipe.png", tmp_path / "folder.png"):
        assert_data_error(path, ["no plain file"], write_png, path, mosaic())
    assert (tmp_path / "pipe.png").is_fifo()
    assert (tmp_path / "folder.png").is_dir()


def test_writing_into_a_missing_folder_or_a_wrong_image(tmp_path):
    path = tmp_path / "gone" / "a.png"
    assert_data_error(path, ["cannot be written"], write_png, path, mosaic())
    with pytest.raises(ValueError, match="expected a uint8"):
        write_png(tmp_path / "a.png", np.zeros((4, 4)))


# --- folders ---------------------------------------------------------------------------------


def test_mosaics_are_found_directly_or_in_raw_and_sorted(tmp_path):
    for name in ("b.png", "a.TIF", "c.bmp"):
        (tmp_path / "raw").mkdir(exist_ok=True)
        (tmp_path / "raw" / name).write_bytes(b"x")
    (tmp_path / "notes.txt").write_text("x")
    (tmp_path / "raw" / "._a.png").write_bytes(b"x")
    (tmp_path / "raw" / "folder.png").mkdir()
    assert [p.name for p in find_capture(tmp_path).paths] == ["a.TIF", "b.png", "c.bmp"]
    (tmp_path / "d.png").write_bytes(b"x")
    assert find_capture(tmp_path).paths == (tmp_path / "d.png",)


def test_bad_folders(tmp_path):
    assert_data_error("gone", ["no such folder"], open_capture, tmp_path / "gone")
    assert_data_error(tmp_path, ["no images"], open_capture, tmp_path)
    (tmp_path / "a.jpg").write_bytes(b"x")
    assert_data_error("a.jpg", ["no folder"], open_capture, tmp_path / "a.jpg")


@pytest.mark.parametrize(
    ("other", "words"),
    [
        (mosaic(24, 34), ["34x24", "32x24"]),
        (mosaic(dtype=np.uint16), ["16 bits", "8"]),
    ],
)
def test_mixed_captures_name_both_files(tmp_path, other, words):
    save(tmp_path / "a.png", mosaic())
    save(tmp_path / "b.png", mosaic())
    path = save(tmp_path / "c.png", other)
    assert_data_error(path, [*words, "a.png"], open_capture, tmp_path)


def test_a_damaged_file_is_found_on_opening(tmp_path):
    save(tmp_path / "a.png", mosaic())
    path = tmp_path / "b.png"
    path.write_bytes(encoded(mosaic())[:-12])
    assert_data_error(path, ["truncated"], open_capture, tmp_path)


# --- a capture -------------------------------------------------------------------------------


def test_capture_describes_and_loads(tmp_path):
    for name in ("b.png", "a.png"):
        save(tmp_path / name, flat_cells([[40, 100], [60, 120]]))
    capture = open_capture(tmp_path)
    assert capture.names == ("a.png", "b.png")
    assert (capture.width, capture.height) == (16, 12)
    assert (capture.levels.bit_depth, capture.full_scale) == (8, 255)
    stokes = capture.load("b.png")  # 90 45 / 135 0
    assert stokes.shape == (12, 16)
    np.testing.assert_allclose(stokes.s0, 160 / 255, rtol=1e-6)
    np.testing.assert_allclose(stokes.s1, 80 / 255, rtol=1e-6)
    np.testing.assert_allclose(stokes.s2, 40 / 255, rtol=1e-6)
    assert stokes.valid.all()
    with pytest.raises(ValueError, match=r"c\.png"):
        capture.load("c.png")
    with pytest.raises(FrozenInstanceError):
        capture.width = 3


def test_options_reach_the_stokes_images(tmp_path):
    save(tmp_path / "a.png", flat_cells([[51, 102], [153, 204]]))
    options = CaptureOptions(pattern=(0, 45, 90, 135), gamma=0.5, saturation=0.9, darkness=0.01)
    stokes = open_capture(tmp_path, options).load("a.png")
    np.testing.assert_allclose(stokes.s1, 0.2**2 - 0.6**2, rtol=1e-5)
    np.testing.assert_allclose(stokes.s2, 0.4**2 - 0.8**2, rtol=1e-5)
    assert stokes.valid.all()
    for changed in ({"saturation": 0.79}, {"darkness": 0.4}):  # the mean is 0.3 of full scale
        other = open_capture(tmp_path, replace(options, **changed))
        assert not other.load("a.png").valid.any()


def test_right_aligned_12_bits_give_the_same_stokes_as_16(tmp_path):
    image = mosaic(dtype=np.uint16, high=4000)
    image[0, 0] = 4095
    save(tmp_path / "right" / "a.png", image)
    save(tmp_path / "left" / "a.png", image << 4)
    right = open_capture(tmp_path / "right").load("a.png")
    left = open_capture(tmp_path / "left").load("a.png")
    np.testing.assert_allclose(right.s0, left.s0, rtol=1e-3)
    np.testing.assert_array_equal(right.valid, left.valid)
    assert not right.valid[0, 0]


def test_a_file_changed_after_opening_is_reported(tmp_path):
    path = save(tmp_path / "a.png", mosaic())
    capture = open_capture(tmp_path)
    save(path, mosaic(24, 34))
    assert_data_error(path, ["changed"], capture.load, "a.png")
    path.unlink()
    assert_data_error(path, ["no such file"], capture.load, "a.png")


def test_one_white_level_for_the_whole_capture(tmp_path):
    for k, level in enumerate((20, 100, 60)):
        image = np.full((64, 96), level, np.uint8)
        image[10, 12] = 255  # a glint does not set the exposure
        save(tmp_path / f"{k}.png", image)
    capture = open_capture(tmp_path)
    white = capture.exposure()
    assert white == pytest.approx(2 * 100 / 255, rel=1e-6)
    for name, level in zip(capture.names, (20, 100, 60), strict=True):
        image = intensity_image_8bit(capture.load(name), white)
        assert image.shape == (32, 48)
        assert image.dtype == np.uint8
        assert image[20, 20] == round(255 * (level / 100) ** (1 / 2.2))
        assert image[5, 6] >= image[20, 20]


def test_exposure_of_large_images_is_a_spread_sample(tmp_path):
    image = np.tile(np.linspace(0, 200, 1000), (600, 1)).astype(np.uint8)
    save(tmp_path / "a.png", image)
    capture = open_capture(tmp_path)
    assert capture.exposure() == pytest.approx(2 * 199 / 255, rel=0.01)


def test_black_capture_and_wrong_white(tmp_path):
    save(tmp_path / "a.png", np.zeros((24, 32), np.uint8))
    assert_data_error(tmp_path, ["black"], open_capture(tmp_path).exposure)
    stokes = stokes_from_intensities(np.zeros((4, 2, 2), np.float32), np.zeros((2, 2), bool))
    np.testing.assert_array_equal(intensity_image_8bit(stokes, 1.0), 0)
    with pytest.raises(ValueError, match="white"):
        intensity_image_8bit(stokes, 0.0)


@pytest.mark.skipif(not SHARED.is_dir(), reason=f"{SHARED} is absent")
def test_rendered_capture_opens():
    capture = open_capture(SHARED / "demo")
    assert isinstance(capture, Capture)
    assert len(capture.names) == 10
    assert (capture.width, capture.height) == (459, 384)
    stokes = capture.load(capture.names[3])
    assert stokes.valid.mean() > 0.9
    assert 0.001 < np.median(stokes.sigma) < 0.05
    assert 0 < capture.exposure() <= 2


@pytest.mark.parametrize(
    "angles",
    [
        (0, 45, 90, 135),
        (0, 45, 90),
        (0, 60, 120),
        (0, 30, 60, 90, 120, 150),
        (0, 22.5, 45, 67.5, 90, 112.5, 135, 157.5),
        range(0, 180, 20),
        range(0, 180, 15),
        range(0, 180, 10),
    ],
)
def test_usual_sets_of_angles_are_known_by_their_names(tmp_path, angles):
    for view in "ab":
        for angle in angles:
            save(tmp_path / f"{view}_{angle:g}.png", mosaic())
    found = find_capture(tmp_path)
    assert found.kind is CaptureKind.ANGLES
    assert found.angles_deg == tuple(angles)


def test_an_odd_angle_makes_no_set(tmp_path):
    for view in "ab":
        for angle in (0, 30, 61, 90, 120, 150):
            save(tmp_path / f"{view}_{angle:g}.png", mosaic())
    assert find_capture(tmp_path).kind is not CaptureKind.ANGLES


@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"bayer": BayerOrder.RGGB},
        {"resolution": Resolution.FULL},
        {"bayer": BayerOrder.RGGB, "resolution": Resolution.FULL},
    ],
    ids=lambda changes: " ".join(changes) or "plain",
)
def test_the_white_level_is_that_of_the_images_that_are_read(tmp_path, changes):
    """Mosaics that are brighter to one side; colours differ by a factor of four."""
    rows, cols = np.mgrid[:96, :128]
    gains = [1.0, 0.5, 0.5, 0.25] if "bayer" in changes else [1.0] * 4
    gain = np.choose(2 * (rows // 2 % 2) + cols // 2 % 2, gains)
    mosaic = np.rint(40000 * gain * (0.5 + cols / 256)).astype(np.uint16)
    for name in ("a", "b"):
        cv2.imwrite(str(tmp_path / f"{name}.png"), mosaic)
    capture = open_capture(tmp_path, CaptureOptions(full_scale=65535, **changes))
    expected = np.percentile(capture.load("a.png").s0, 99.5)
    assert capture.exposure() == pytest.approx(expected, rel=0.02)


def test_shares_of_colours_are_their_mean():
    image = np.array([[[0, 30, 60], [255, 255, 255]]], np.uint8)
    np.testing.assert_allclose(_share(None, 0, image), [[30 / 255, 1]], rtol=1e-6)
    np.testing.assert_allclose(_share(None, 0, image[..., 1]), [[30 / 255, 1]], rtol=1e-6)
    np.testing.assert_allclose(_share(None, 0, np.float32(image) / 255), [[30 / 255, 1]], rtol=1e-6)
