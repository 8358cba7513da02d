"""Files that lie, one of each kind that once crashed or got through; and structured nonsense."""

import io
import json
import struct
import zlib
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from polmvs.cli.call import read_config
from polmvs.config import CaptureOptions
from polmvs.errors import DataError, OptionError, PolmvsError
from polmvs.evaluation.comparison import read_comparison
from polmvs.experiments.contours import open_surface
from polmvs.io.arrays import map_array
from polmvs.io.ground_truth import GroundTruth, open_ground_truth, read_views
from polmvs.io.images import read_mask
from polmvs.io.intrinsics import read_intrinsics
from polmvs.io.layouts import read_author_truth
from polmvs.io.raw_formats import read_raw
from polmvs.pipeline.record import read_options
from polmvs.pipeline.run_folder import DENSE_MARKER, RunFolder, require_own
from polmvs.pipeline.runner import load_record
from polmvs.poses.metric_frame import read_centers

DEEP = "[" * 100_000
LONG = "9" * 5000

JSON_READERS = {
    "cameras.json": read_views,
    "run.json": lambda path: load_record(RunFolder(path.parent)),
    "options.json": lambda path: read_options(RunFolder(path.parent)),
    "metrics.json": read_comparison,
    "centers.json": read_centers,
    "camera.json": read_intrinsics,
    "scene.json": lambda path: open_surface(GroundTruth(folder=path.parent, views={})),
}


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / ("run.json" if name == "options.json" else name)
    path.write_text(text)
    return path


@pytest.mark.parametrize("name", JSON_READERS)
@pytest.mark.parametrize(
    "text",
    [
        DEEP,
        '{"a":' * 100_000,
        LONG,
        f'{{"width": {LONG}, "schema_version": 2, "stages": [], "surface": {LONG}}}',
        *("", "null", "3", "[]", "{}", '"x"', "NaN", "\ud800".encode(errors="surrogatepass").hex()),
    ],
    ids=repr,
)
def test_json_of_every_reader(tmp_path: Path, name: str, text: str) -> None:
    path = write(tmp_path, name, text)
    with pytest.raises(DataError, match=path.name):
        JSON_READERS[name](path)


KEYS = st.sampled_from(
    [
        *("width", "height", "images", "K", "cam_from_world", "a.png", "center", "stages"),
        *("options", "schema_version", "versions", "capture", "surface", "type", "normal"),
        *("offset", "models", "image_size", "camera_matrix", "data", "dist", "cam0"),
        *("intrinsics", "resolution"),
    ]
)
LEAVES = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=5), st.just(2),
    st.sampled_from(["plane", "pinhole", "ppa", 10**400, -(10**25), [[1, 0, 0]] * 3]),
)  # fmt: skip
VALUES = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(KEYS, inner, max_size=4)
)


@given(content=st.dictionaries(KEYS, VALUES, max_size=6), name=st.sampled_from([*JSON_READERS]))
@settings(
    max_examples=150, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)
def test_json_of_any_shape_is_read_or_refused(tmp_path: Path, content, name: str) -> None:
    path = write(tmp_path, name, json.dumps(content))
    with suppress(PolmvsError):
        JSON_READERS[name](path)


@pytest.mark.parametrize(
    ("normal", "offset"),
    [
        *(([0, 0, 0], 1), ([0, 0, 1e-300], 1), ([0, 0, 1e400], 1), ([0, 0, 1], 1e400)),
        *(([0, 0], 1), ([[0, 0, 1]], 1), ([0, 0, 1], None), ([0, 0, 10**400], 0), ("up", 0)),
    ],
)
def test_a_surface_that_is_no_plane(tmp_path: Path, normal, offset) -> None:
    surface = {"type": "plane", "normal": normal, "offset": offset}
    (tmp_path / "scene.json").write_text(json.dumps({"surface": surface}))
    with pytest.raises(DataError, match=r"scene\.json: does not describe the surface"):
        open_surface(GroundTruth(folder=tmp_path, views={}))


@pytest.mark.parametrize(
    "text", ["a = " + LONG, "a = " + "[" * 5000, "a = " + "{a=" * 2000, "[" + "a." * 5000, "\0"]
)
def test_toml_of_the_command_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "o.toml").write_text(text)
    with pytest.raises(OptionError, match=r"o\.toml: is no TOML file") as found:
        read_config(tmp_path / "o.toml", (CaptureOptions,))
    assert len(str(found.value)) < 2000


def npy(header: str, data: bytes = bytes(96)) -> bytes:
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode() + data


HEADERS = {
    "open bracket": "{'descr': '<f8', 'fortran_order': False, 'shape': (3, 4",
    "null": "{'descr': '<f8', \0",
    "object": "{'descr': '|O', 'fortran_order': False, 'shape': (12,), }",
    "nothing": "{'descr': '|V0', 'fortran_order': False, 'shape': (12,), }",
    "negative": "{'descr': '<f8', 'fortran_order': False, 'shape': (-3, -4), }",
    "endless": f"{{'descr': '<f8', 'fortran_order': False, 'shape': ({LONG},), }}",
    "huge": "{'descr': '<f8', 'fortran_order': False, 'shape': (0, 99999999999999999999), }",
    "deep": "(" * 3000,
    "other": "{'descr': 'elephant', 'fortran_order': 7, 'shape': 'x'}",
}


@pytest.mark.parametrize("name", HEADERS)
def test_npy_headers(tmp_path: Path, name: str) -> None:
    path = tmp_path / "normal_w.npy"
    path.write_bytes(npy(HEADERS[name]))
    for read in (read_raw,) if name == "nothing" else (map_array, read_raw):
        with pytest.raises(DataError, match=r"normal_w\.npy"):
            read(path)
    (tmp_path / "cams").mkdir()
    with pytest.raises(DataError, match=r"normal_w\.npy"):
        read_author_truth(tmp_path, [], 4, 4)


def test_an_archive_is_no_array(tmp_path: Path) -> None:
    buffer = io.BytesIO()
    np.savez(buffer, a=np.zeros(3))
    (tmp_path / "a.npy").write_bytes(buffer.getvalue())
    with pytest.raises(DataError, match=r"a\.npy"):
        map_array(tmp_path / "a.npy")


def test_a_marker_that_is_no_text(tmp_path: Path) -> None:
    folder = tmp_path / "dense"
    folder.mkdir()
    (folder / DENSE_MARKER).write_bytes(b"\xff\xfe\xfd")
    with pytest.raises(DataError, match=rf"{DENSE_MARKER}: cannot be read"):
        require_own(folder)


def test_pixels_that_a_file_cannot_hold(tmp_path: Path) -> None:
    """Memory is not taken for them."""
    _, encoded = cv2.imencode(".png", np.zeros((4, 4), np.uint8))
    data = bytearray(encoded.tobytes())
    for width, height in ((60_000, 60_000), (0, 4), (2**31 - 1, 2**31 - 1)):
        struct.pack_into(">II", data, 16, width, height)
        struct.pack_into(">I", data, 29, zlib.crc32(data[12:29]))
        (tmp_path / "a.png").write_bytes(data)
        with pytest.raises(DataError, match=rf"a\.png: .*cannot hold {width}x{height} px"):
            read_mask(tmp_path / "a.png", (4, 4))


def test_an_error_of_opencv_is_one_of_the_file(tmp_path: Path, monkeypatch) -> None:
    """Its decoders raise their own exception for some damage, wherever an image is read."""
    _, encoded = cv2.imencode(".png", np.zeros((4, 4), np.uint8))
    content = {"width": 4, "height": 4, "images": {}}
    entry = {"K": np.eye(3).tolist(), "cam_from_world": np.eye(3, 4).tolist()}
    content["images"] = {"a.png": entry}
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    for kind in ("depth", "normal", "mask"):
        (tmp_path / f"a_{kind}.png").write_bytes(encoded.tobytes())
    truth = open_ground_truth(tmp_path)

    def fail(*arguments):
        raise cv2.error("OpenCV(5.0) assertion failed")

    monkeypatch.setattr(cv2, "imdecode", fail)
    with pytest.raises(DataError, match=r"a_mask\.png: is not a readable image"):
        read_mask(tmp_path / "a_mask.png", (4, 4))
    with pytest.raises(DataError, match=r"a_mask\.png: is not a readable image"):
        truth.mask("a.png")
