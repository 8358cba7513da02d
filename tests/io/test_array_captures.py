"""Frames in memory become files that hold the same numbers."""

from pathlib import Path

import numpy as np
import pytest

from polmvs.config import CaptureKind
from polmvs.errors import OptionError
from polmvs.io.array_captures import are_frames, write_frames

MOSAIC = np.arange(24, dtype=np.uint16).reshape(4, 6)
STOKES = np.linspace(0, 1, 36, dtype=np.float32).reshape(3, 4, 3)


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        ([MOSAIC], True),
        ((MOSAIC, MOSAIC), True),
        ({"a": MOSAIC}, True),
        ("folder", False),
        (b"folder", False),
        (Path("folder"), False),
        (MOSAIC, False),
        ({}, False),
        ({0: MOSAIC, 45: MOSAIC}, False),
        (None, False),
    ],
)
def test_what_is_a_collection_of_frames(value: object, expected: bool) -> None:
    assert are_frames(value) is expected


@pytest.mark.parametrize(
    ("frame", "kind", "names"),
    [
        (MOSAIC, CaptureKind.MOSAIC, ["000.npy"]),
        (STOKES, CaptureKind.STOKES, ["000.npy"]),
        ({0: MOSAIC, 67.5: MOSAIC}, CaptureKind.ANGLES, ["000_000.npy", "000_67.5.npy"]),
    ],
)
def test_files_hold_the_numbers(
    tmp_path: Path, frame: object, kind: CaptureKind, names: list[str]
) -> None:
    assert write_frames([frame], tmp_path) is kind  # type: ignore[list-item]
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    expected = MOSAIC if isinstance(frame, dict) else np.asarray(frame)
    for name in names:
        np.testing.assert_array_equal(np.load(tmp_path / name), expected)


def test_names_of_a_mapping_lose_their_suffix(tmp_path: Path) -> None:
    write_frames({"a.png": MOSAIC, "b": MOSAIC}, tmp_path)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.npy", "b.npy"]


@pytest.mark.parametrize(
    ("frames", "message"),
    [
        ([], "no frames"),
        ([MOSAIC, STOKES], "frame '001' holds"),
        ([MOSAIC[0]], "no image"),
        ([MOSAIC[:0]], "no image"),
        ([MOSAIC.astype(complex)], "no image"),
        ([STOKES.astype(np.uint8)], "is expected"),
        ([STOKES.reshape(2, 6, 3)[..., :2]], "is expected"),
        ({"a/b": MOSAIC}, "no name of a frame"),
        ({"": MOSAIC}, "no name of a frame"),
    ],
)
def test_what_is_no_frame_is_refused(tmp_path: Path, frames: object, message: str) -> None:
    with pytest.raises(OptionError, match=message):
        write_frames(frames, tmp_path)  # type: ignore[arg-type]
