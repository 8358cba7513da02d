"""Sizes are told from headers before anything is decoded, and held against a limit."""

import io
import resource
import struct
import subprocess
import sys
import zipfile
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest

from polmvs.config import MAX_PIXELS, CaptureOptions
from polmvs.errors import DataError
from polmvs.io.data_sets import read_npz
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.image_size import declared_size
from polmvs.io.images import read_gray, read_mask
from polmvs.io.raw_formats import probe_raw, read_raw
from polmvs.polarization.capture import open_capture

SIDE = 30_000  # px; the square is 900 Mpx


def encoded(suffix: str, image: np.ndarray, *parameters: int) -> bytes:
    done, data = cv2.imencode(suffix, image, parameters)
    assert done
    return data.tobytes()


GRAY = np.zeros((10, 14), np.uint8)
COLOUR = np.zeros((10, 14, 3), np.uint8)


@pytest.mark.parametrize(
    ("data", "num_bytes"),
    [
        (encoded(".png", GRAY), 140),
        (encoded(".png", COLOUR.astype(np.uint16)), 840),
        (encoded(".png", np.zeros((10, 14, 4), np.uint8)), 560),
        (encoded(".tiff", GRAY), 140),
        (encoded(".tiff", COLOUR.astype(np.uint16)), 840),
        (encoded(".tiff", COLOUR.astype(np.float32)), 1680),
        (encoded(".jpg", COLOUR), 420),
        (encoded(".jpg", GRAY, cv2.IMWRITE_JPEG_PROGRESSIVE, 1), 140),
        (encoded(".bmp", COLOUR), 560),
        (encoded(".pgm", GRAY.astype(np.uint16)), 280),
        (encoded(".ppm", COLOUR), 420),
        (b"P5 # a comment 99 99\n14\n10 255\n" + bytes(140), 140),
        (b"P4\n14 10\n" + bytes(20), 140),
        (encoded(".hdr", COLOUR.astype(np.float32)), 1680),
    ],
)
def test_size_of_each_container(data: bytes, num_bytes: int) -> None:
    assert declared_size("a", data) == (14, 10, num_bytes)
    with pytest.raises(DataError, match=r"a: is (not|damaged)"):
        declared_size("a", data[: min(len(data) // 40 + 3, 8)])


@pytest.mark.parametrize("order", ["<", ">"])
def test_size_of_a_big_tiff(order: str) -> None:
    head = (b"II" if order == "<" else b"MM") + struct.pack(f"{order}HHHQ", 43, 8, 0, 16)
    tags = [(256, 16, 1, 14), (257, 16, 1, 10), (322, 16, 1, 64), (323, 16, 1, 32)]
    body = struct.pack(f"{order}Q", len(tags)) + b"".join(
        struct.pack(f"{order}HHQQ", *tag) for tag in tags
    )
    assert declared_size("a", head + body) == (64, 32, 64 * 32)  # of a tile, which is larger


def big_tiff(images: list[np.ndarray], orientation: int) -> bytes:
    """Uncompressed, 16 bits; the orientation as a long number, as some writers store it."""
    data = b"MM\0+" + struct.pack(">HHQ", 8, 0, 16)
    for index, image in enumerate(images):
        rows, cols = image.shape
        num, start = 9, len(data)
        strip = start + 8 + 20 * num + 8
        tags = [(256, 3, cols), (257, 3, rows), (258, 3, 16), (259, 3, 1), (262, 3, 1)]
        tags += [(273, 16, strip), (274, 4, orientation), (278, 3, rows), (279, 16, image.nbytes)]
        data += struct.pack(">Q", num)
        for tag, kind, value in tags:
            packed = struct.pack({3: ">H", 4: ">I", 16: ">Q"}[kind], value)
            data += struct.pack(">HHQ", tag, kind, 1) + packed.ljust(8, b"\0")
        last = index == len(images) - 1
        data += struct.pack(">Q", 0 if last else strip + image.nbytes)
        data += image.astype(">u2").tobytes()
    return data


def test_orientation_and_images_of_a_big_tiff(tmp_path: Path) -> None:
    image = np.arange(24, dtype=np.uint16).reshape(4, 6)
    path = tmp_path / "a.tif"
    path.write_bytes(big_tiff([image], 6))
    found = read_raw(path)
    np.testing.assert_array_equal(found.samples, image)  # as stored
    assert found.orientation == 6
    path.write_bytes(big_tiff([image, image], 1))
    with pytest.raises(DataError, match="holds 2 images"):
        read_raw(path)


def test_a_big_tiff_that_begins_beyond_every_file_is_damaged() -> None:
    for start in (1 << 63, (1 << 64) - 1, 1000):
        with pytest.raises(DataError, match="damaged or truncated"):
            declared_size("a", b"II+\0" + struct.pack("<HHQ", 8, 0, start) + bytes(64))


def test_what_is_no_known_container_is_not_decoded() -> None:
    for data in (b"RIFF0000WEBPVP8 ", b"\0\0\0\x0cjP  \r\n\x87\n", b"GIF89a", b"mine", b"P7\n"):
        with pytest.raises(DataError, match="is no PNG, TIFF"):
            declared_size("a", data)


def huge_png() -> bytes:
    def chunk(kind: bytes, content: bytes) -> bytes:
        check = struct.pack(">I", zlib.crc32(kind + content))
        return struct.pack(">I", len(content)) + kind + content + check

    packer = zlib.compressobj(9)
    rows = b"".join(packer.compress(bytes(SIDE + 1)) for _ in range(SIDE)) + packer.flush()
    header = struct.pack(">IIBBBBB", SIDE, SIDE, 8, 0, 0, 0, 0)
    parts = [chunk(b"IHDR", header), chunk(b"IDAT", rows), chunk(b"IEND", b"")]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def huge_tiff(pixels: bytes) -> bytes:
    """One deflated strip."""
    offset = 8 + 2 + 12 * 9 + 4
    tags = [
        *((256, 4, 1, SIDE), (257, 4, 1, SIDE), (258, 3, 1, 8), (259, 3, 1, 8), (262, 3, 1, 1)),
        *((273, 4, 1, offset), (277, 3, 1, 1), (278, 4, 1, SIDE), (279, 4, 1, len(pixels))),
    ]
    entries = b"".join(
        struct.pack("<HHI", *tag[:3])
        + (struct.pack("<HH", tag[3], 0) if tag[1] == 3 else struct.pack("<I", tag[3]))
        for tag in tags
    )
    return b"II*\0" + struct.pack("<IH", 8, len(tags)) + entries + bytes(4) + pixels


@pytest.fixture(scope="module")
def huge(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Small files of huge images."""
    folder = tmp_path_factory.mktemp("huge")
    png = huge_png()
    (folder / "a.png").write_bytes(png)
    at = png.index(b"IDAT") + 4
    (folder / "a.tif").write_bytes(huge_tiff(png[at:-16]))
    (folder / "a.pgm").write_bytes(b"P5 30000 30000 255\n")
    (folder / "a.bmp").write_bytes(
        encoded(".bmp", GRAY)[:18] + struct.pack("<ii", SIDE, -SIDE) + bytes(400)
    )
    (folder / "a.hdr").write_bytes(b"#?RADIANCE\nFORMAT=32-bit_rle_rgbe\n\n-Y 30000 +X 30000\n")
    jpeg = bytearray(encoded(".jpg", GRAY))
    at = jpeg.index(b"\xff\xc0")
    jpeg[at + 5 : at + 9] = struct.pack(">HH", SIDE, SIDE)
    (folder / "a.jpg").write_bytes(jpeg)
    return folder


LIMITED = """
import resource, sys
from pathlib import Path
import cv2, numpy
from polmvs.errors import DataError
from polmvs.io.images import read_gray, read_mask
from polmvs.io.raw_formats import probe_raw, read_raw
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
for path in sorted(Path(sys.argv[1]).iterdir()):
    for read in (read_raw, read_gray, lambda path: read_mask(path, (10, 14)), probe_raw):
        try:
            found = read(path)
        except DataError as error:
            assert "30000x30000 px" in str(error), error
        else:
            assert found is None
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)
"""


def test_huge_images_of_small_files_are_not_decoded(huge: Path) -> None:
    """Of each container, as frame, mask and picture: the peak is that of the files."""
    done = subprocess.run(
        [sys.executable, "-c", LIMITED, str(huge)], capture_output=True, text=True, check=False
    )
    assert done.stderr == ""
    assert int(done.stdout) < 100  # MB; one of them decoded has 900


def test_the_limit_moves(tmp_path: Path) -> None:
    path = tmp_path / "a.png"
    path.write_bytes(encoded(".png", np.arange(140, dtype=np.uint8).reshape(10, 14)))
    message = r"declares 14x10 px.*the limit is 139 px of 8 bytes\. Give `capture\.max_pixels`"
    for name in ("a.png", "a.tif", "a.pgm", "a.npy"):
        if name == "a.npy":
            np.save(tmp_path / name, np.zeros((10, 14), np.uint8))
        else:
            cv2.imwrite(str(tmp_path / name), GRAY)
        with pytest.raises(DataError, match=message):
            read_raw(tmp_path / name, max_pixels=139)
        assert read_raw(tmp_path / name, max_pixels=140).samples.shape == (10, 14)
    with pytest.raises(DataError, match=message):
        probe_raw(path, max_pixels=139)
    assert probe_raw(path, max_pixels=140) is not None


def test_large_exr_and_its_limit(tmp_path: Path) -> None:
    OpenEXR = pytest.importorskip("OpenEXR")
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    path = tmp_path / "a.exr"
    OpenEXR.File(header, {"Y": np.zeros((10, 14), np.float32)}).write(str(path))
    with pytest.raises(DataError, match="14x10 px"):
        read_raw(path, max_pixels=139)
    assert read_raw(path, max_pixels=140).samples.shape == (10, 14)


def test_a_capture_is_held_against_its_own_limit(tmp_path: Path, cli) -> None:
    rng = np.random.default_rng(0)
    cv2.imwrite(str(tmp_path / "a.png"), rng.integers(0, 200, (40, 60)).astype(np.uint8))
    with pytest.raises(DataError, match=r"a\.png: declares 60x40 px"):
        open_capture(tmp_path, CaptureOptions(max_pixels=2399))
    assert open_capture(tmp_path, CaptureOptions(max_pixels=2400)).load("a.png").s0.size == 600
    status, _, err = cli("inspect", tmp_path, "--max-pixels", "2399")
    assert status == 1
    assert "Give --max-pixels if it is the right file" in err


def test_cameras_of_a_set_are_weighed_before_they_are_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "cameras.npz"
    np.savez_compressed(path, world_mat_0=np.zeros((40_000, 1000)))
    assert path.stat().st_size < 1 << 20
    with pytest.raises(DataError, match="is too large for cameras"):
        read_npz(path)
    header = io.BytesIO()
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f8", "fortran_order": False, "shape": (700_000_000,)}
    )
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as file:
        file.writestr("world_mat_0.npy", header.getvalue())
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(DataError, match="truncated"):
        read_npz(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100_000
    np.savez_compressed(path, world_mat_0=np.eye(4))
    np.testing.assert_array_equal(read_npz(path)["world_mat_0"], np.eye(4))


def test_a_file_without_end_is_not_read(tmp_path: Path) -> None:
    """Blocks of a sparse file take no room on the disk."""
    for name in ("a.png", "a.raw", "a.npy"):
        with (tmp_path / name).open("wb") as file:
            file.truncate(9 * MAX_PIXELS)
        with pytest.raises(DataError, match=r"has 1\.2 GB; the limit is 1\.1 GB"):
            read_raw(tmp_path / name)


def test_truth_of_another_size_is_refused(demo_capture: Path, tmp_path: Path, huge: Path) -> None:
    truth = open_ground_truth(demo_capture)
    name = truth.names[0]
    for path in (demo_capture / "gt").iterdir():
        (tmp_path / path.name).symlink_to(path)
    mask = tmp_path / f"{Path(name).stem}_mask.png"
    mask.unlink()
    mask.symlink_to(huge / "a.png")
    with pytest.raises(DataError, match="declares 30000x30000 px"):
        open_ground_truth(tmp_path).mask(name)
    with pytest.raises(DataError, match="declares 30000x30000 px"):
        read_gray(mask)
    with pytest.raises(DataError, match="declares 30000x30000 px"):
        read_mask(mask, (10, 14))
