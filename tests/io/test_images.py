"""Files are written whole or not at all."""

from pathlib import Path

import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.images import write_bytes, write_png


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
