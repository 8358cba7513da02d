"""Files are written whole or not at all."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.images import (
    read_bytes,
    read_gray,
    read_mask,
    write_bytes,
    write_png,
)
from polmvs.io.raw_formats import read_radiance, read_raw


@pytest.mark.parametrize("write", [lambda path: write_bytes(path, b"new"), None], ids=["b", "png"])
def test_what_is_cut_short_leaves_the_older_file(
    write, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The disk is full when half is written."""
    target = tmp_path / "a.png"
    target.write_bytes(b"older")
    original = Path.write_bytes

    def half(path: Path, data: bytes) -> int:
        original(path, bytes(data)[: len(data) // 2])
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(DataError, match=r"a\.png: cannot be written: No space left"):
        (write or (lambda path: write_png(path, np.zeros((4, 4), np.uint8))))(target)
    assert target.read_bytes() == b"older"
    assert [path.name for path in tmp_path.iterdir()] == ["a.png"]
    monkeypatch.undo()
    write_bytes(target, b"new")
    assert target.read_bytes() == b"new"


@pytest.mark.parametrize(
    ("largest", "bits"), [(1023, 10), (4095, 12), (65535, None), (255, None), (1000, None), (15, 4)]
)
def test_a_pgm_says_of_how_many_bits_it_is(tmp_path: Path, largest: int, bits: int | None) -> None:
    depth = np.dtype(">u2" if largest > 255 else np.uint8)
    samples = np.full((2, 3), largest, depth)
    (tmp_path / "a.pgm").write_bytes(f"P5\n3 2\n{largest}\n".encode() + samples.tobytes())
    found = read_raw(tmp_path / "a.pgm")
    assert found.declared_bits == bits
    np.testing.assert_array_equal(found.samples, samples)


def test_masks_are_what_is_not_black_in_any_colour(tmp_path: Path) -> None:
    image = np.zeros((2, 3, 4), np.uint8)
    image[..., 3] = 255  # alpha says nothing
    image[0, 1, 0] = image[1, 2, 2] = 1
    expected = [[False, True, False], [False, False, True]]
    for name, pixels in (
        ("rgba", image),
        ("rgb", image[..., :3]),
        ("gray", image[..., :3].max(-1)),
    ):
        write_png(tmp_path / f"{name}.png", pixels)
        assert read_mask(tmp_path / f"{name}.png", (2, 3)).tolist() == expected
    with pytest.raises(DataError, match="the mask is 3x2 px, the polarization image 2x3 px"):
        read_mask(tmp_path / "gray.png", (3, 2))


def test_gray_is_the_mean_of_the_colours(tmp_path: Path) -> None:
    image = np.array([[[10, 20, 60, 7], [0, 0, 1, 255], [255, 255, 255, 0]]], np.uint8)
    for name, pixels in (("rgba", image), ("rgb", image[..., :3])):
        write_png(tmp_path / f"{name}.png", pixels)
        assert read_gray(tmp_path / f"{name}.png").tolist() == [[30, 0, 255]]
    write_png(tmp_path / "gray.png", image[..., 0])
    assert read_gray(tmp_path / "gray.png").tolist() == [[10, 0, 255]]
    write_png(tmp_path / "deep.png", image.astype(np.uint16))
    with pytest.raises(DataError, match="no 8-bit image"):
        read_gray(tmp_path / "deep.png")


@pytest.mark.parametrize("suffix", [".tif", ".hdr"])
def test_radiances_are_red_green_blue(tmp_path: Path, suffix: str) -> None:
    image = np.zeros((2, 3, 3), np.float32)
    image[...] = [0.25, 2.0, 16.0]  # exact in each format
    assert cv2.imwrite(str(tmp_path / f"a{suffix}"), np.ascontiguousarray(image[..., ::-1]))
    found = read_radiance(tmp_path / f"a{suffix}")
    np.testing.assert_allclose(found, image, rtol=0.01)
    assert found.dtype == np.float32


def test_gray_radiances_are_of_all_colours(tmp_path: Path) -> None:
    image = np.linspace(0, 5, 6, dtype=np.float32).reshape(2, 3)
    assert cv2.imwrite(str(tmp_path / "a.tif"), image)
    np.testing.assert_array_equal(read_radiance(tmp_path / "a.tif"), np.dstack([image] * 3))
    write_png(tmp_path / "a.png", np.zeros((2, 3), np.uint8))
    with pytest.raises(DataError, match="no image of radiances"):
        read_radiance(tmp_path / "a.png")


def test_files_are_read_whole_or_named(tmp_path: Path) -> None:
    path = tmp_path / "a"
    path.write_bytes(b"12345")
    assert read_bytes(path, most=5) == b"12345"
    with pytest.raises(DataError, match="the limit is"):
        read_bytes(path, most=4)
    path.write_bytes(b"")
    with pytest.raises(DataError, match="is empty"):
        read_bytes(path)
    with pytest.raises(DataError, match="no such file"):
        read_bytes(tmp_path / "b")
