"""Files are written whole or not at all."""

from pathlib import Path

import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.images import write_bytes, write_png
from polmvs.io.raw_formats import read_raw


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
