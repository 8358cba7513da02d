"""Numbers of every type that become samples, and those that are none."""

from pathlib import Path

import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.raw_formats import read_raw

ROWS = np.arange(24).reshape(4, 6)


@pytest.mark.parametrize(
    ("given", "kind"),
    [
        ("u1", np.uint8),
        ("<u2", np.uint16),
        (">u2", np.uint16),
        ("<i4", np.uint16),
        (">u8", np.uint16),
        ("<f4", np.float32),
        (">f8", np.float32),
    ],
)
def test_values_stay_in_the_smallest_type_that_holds_them(
    tmp_path: Path, given: str, kind: type
) -> None:
    np.save(tmp_path / "a.npy", ROWS.astype(given))
    samples = read_raw(tmp_path / "a.npy").samples
    assert samples.dtype == kind
    assert samples.dtype.isnative
    np.testing.assert_array_equal(samples, ROWS)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (ROWS > 3, "holds bool, no intensities"),
        (ROWS.astype(complex), "no intensities"),
        (ROWS - 1, "outside 0 to 65535"),
        (ROWS + 65536 - 23, "outside 0 to 65535"),
    ],
)
def test_what_is_no_intensity_is_refused(tmp_path: Path, values: np.ndarray, words: str) -> None:
    np.save(tmp_path / "a.npy", values)
    with pytest.raises(DataError, match=words):
        read_raw(tmp_path / "a.npy")


def test_the_largest_integers_are_samples(tmp_path: Path) -> None:
    np.save(tmp_path / "a.npy", ROWS + 65535 - 23)
    assert read_raw(tmp_path / "a.npy").samples.max() == 65535


RED, GREEN = (np.full((4, 6), value, np.float32) for value in (0.5, 1.5))


@pytest.mark.parametrize(
    ("channels", "expected"),
    [
        ({"RGB": np.dstack([RED, GREEN, RED])}, np.dstack([RED, GREEN, RED])),
        ({"RGBA": np.dstack([RED, GREEN, RED, RED])}, np.dstack([RED, GREEN, RED])),
        ({"Y": GREEN, "Z": RED}, GREEN),
        ({"Z": RED}, RED),
        ({"V": RED, "W": GREEN}, None),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_channels_of_openexr(
    tmp_path: Path, channels: dict[str, np.ndarray], expected: np.ndarray | None
) -> None:
    exr = pytest.importorskip("OpenEXR")
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    with exr.File(header, channels) as file:
        file.write(str(tmp_path / "a.exr"))
    if expected is None:
        with pytest.raises(DataError, match="has the channels V, W; one or RGB is read"):
            read_raw(tmp_path / "a.exr")
    else:
        np.testing.assert_array_equal(read_raw(tmp_path / "a.exr").samples, expected)
