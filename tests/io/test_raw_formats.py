"""Numbers of every type that become samples, and those that are none."""

from pathlib import Path

import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.raw_formats import read_radiance, read_raw

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


RED, GREEN, BLUE = (np.full((4, 6), value, np.float32) for value in (0.5, 1.5, 2.5))
ALL = np.dstack([RED, GREEN, BLUE])


@pytest.mark.parametrize(
    ("channels", "expected"),
    [
        ({"RGB": ALL}, ALL),
        ({"RGBA": np.dstack([ALL, RED])}, ALL),
        ({"B": BLUE, "G": GREEN, "R": RED, "Z": RED}, ALL),
        ({"Y": GREEN}, GREEN),
        ({"Y": GREEN, "Z": RED}, GREEN),
        ({"Z": RED}, RED),
        ({"intensity": GREEN}, GREEN),
        ({"V": RED, "W": GREEN}, None),
        ({"A": RED, "Z": GREEN}, None),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, dict) else "",
)
def test_channels_of_openexr(
    tmp_path: Path, channels: dict[str, np.ndarray], expected: np.ndarray | None
) -> None:
    """As samples, and as radiances, which are of all colours."""
    exr = pytest.importorskip("OpenEXR")
    header = {"compression": exr.ZIP_COMPRESSION, "type": exr.scanlineimage}
    path = tmp_path / "a.exr"
    with exr.File(header, channels) as file:
        file.write(str(path))
    if expected is None:
        for read in (read_raw, read_radiance):
            names = ", ".join(channels)
            with pytest.raises(DataError, match=f"has the channels {names}; one or RGB is read"):
                read(path)
    else:
        np.testing.assert_array_equal(read_raw(path).samples, expected)
        radiances = np.dstack([expected] * 3) if expected.ndim == 2 else expected
        np.testing.assert_array_equal(read_radiance(path), radiances)
