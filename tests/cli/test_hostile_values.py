"""Values that lie: each is one line that names the file or argument, and no traceback."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest

from polmvs.errors import DataError, final_name
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.images import write_bytes
from polmvs.io.intrinsics import read_intrinsics
from polmvs.io.temporary import temporary_path

LAUGHS = "\n".join(f"l{i}: &l{i} [{', '.join([f'*l{i - 1}' if i else 'x'] * 9)}]" for i in range(9))


@pytest.mark.parametrize(
    "text",
    [
        "&a\nimage_width: 100\nimage_height: 100\ncamera_matrix: *a\n",
        "image_width: 100\nimage_height: 100\n"
        "camera_matrix: {rows: 3, cols: 3, data: &a [1, 0, *a]}\n",
        "cam0: &c\n  camera_model: pinhole\n  intrinsics: &i [*i, 1, 1, 1]\n  resolution: [9, 9]\n",
        "cam0: {camera_model: pinhole, intrinsics: [9, 9, 4, 4], resolution: [.inf, 9]}\n",
        "cam0: {camera_model: pinhole, intrinsics: [9, 9, 4, 4], resolution: [9, .nan]}\n",
        "image_width: .inf\nimage_height: 9\ncamera_matrix: [1, 0, 1, 0, 1, 1, 0, 0, 1]\n",
        '{"image_size": [1e400, 9], "camera_matrix": [[1, 0, 1], [0, 1, 1], [0, 0, 1]]}',
        f"{LAUGHS}\ncam0: {{camera_model: *l8, intrinsics: [9, 9, 4, 4], resolution: [9, 9]}}\n",
        f"{LAUGHS}\n? [*l8]\n: 1\n",
    ],
)
def test_a_camera_file(tmp_path: Path, text: str) -> None:
    (tmp_path / "a.yaml").write_text(text)
    with pytest.raises(DataError, match=r"a\.yaml: ") as found:
        read_intrinsics(tmp_path / "a.yaml")
    assert len(str(found.value)) < 400


@pytest.mark.parametrize("value", ["1e400", "-1e400", "NaN", '"a"', "[]", "0", "9" * 400])
@pytest.mark.parametrize("name", ["width", "height"])
def test_a_size_of_truth(demo_capture: Path, tmp_path: Path, name: str, value: str) -> None:
    text = (demo_capture / "gt" / "cameras.json").read_text()
    size = {"width": 459, "height": 384}[name]
    assert f'"{name}": {size}' in text
    path = tmp_path / "cameras.json"
    path.write_text(text.replace(f'"{name}": {size}', f'"{name}": {value}'))
    with pytest.raises(DataError, match=r"cameras\.json: "):
        open_ground_truth(tmp_path)


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The current directory: a capture, a link to itself."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "capture").mkdir()
    rng = np.random.default_rng(0)
    for index in range(3):
        mosaic = rng.integers(0, 200, (64, 80)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "capture" / f"{index}.png"), mosaic)
    (tmp_path / "loop").symlink_to("loop")
    return tmp_path


@pytest.mark.parametrize(
    "arguments",
    [
        *(("sfm", "capture", "loop"), ("sfm", "loop", "out"), ("sfm", "capture", "loop/out")),
        *(("report", "loop"), ("mesh", "loop", "loop"), ("inspect", "loop")),
        *(("densify", "capture", "loop"), ("batch", "loop", "out"), ("view", "loop")),
        *(("experiment", "phase", "capture", "loop"), ("evaluate", "loop", "--gt", "loop")),
        *(("sfm", "capture", ""), ("sfm", "", "out"), ("report", ""), ("render", "a.png", "")),
        *(("sfm", "capture", "out", "--sparse", ""), ("inspect", "capture", "--config", "")),
    ],
    ids=" ".join,
)
def test_links_to_themselves_and_empty_paths(cli, here: Path, arguments: tuple[str, ...]) -> None:
    status, out, err = cli(*arguments)
    assert (status in (1, 2), out, err.count("\n")) == (True, "", 1), err
    assert "internal error" not in err
    if "" in arguments:
        assert "'' is no path" in err
    assert sorted(path.name for path in here.iterdir()) == ["capture", "loop"]


def ply(vertices: np.ndarray, faces: list[list[int]]) -> str:
    lines = [
        *("ply", "format ascii 1.0", f"element vertex {len(vertices)}"),
        *(f"property float {axis}" for axis in "xyz"),
        *(f"element face {len(faces)}", "property list uchar int vertex_indices", "end_header"),
        *(" ".join(map(str, vertex)) for vertex in vertices),
        *(" ".join(map(str, [len(face), *face])) for face in faces),
    ]
    return "\n".join(lines) + "\n"


@pytest.mark.parametrize(
    ("kind", "face"), [("plane", [0, 1, 2]), ("plane", [0, 0, 0]), ("line", [0, 1, 2])]
)
@pytest.mark.parametrize("num", [3, 60])
def test_pictures_of_what_has_no_area(cli, tmp_path: Path, kind, face, num) -> None:
    points = np.zeros((num, 3))
    points[:, 0] = np.arange(num)
    points[:, 1] = np.arange(num) ** 2 % 7 if kind == "plane" else 0
    (tmp_path / "a.ply").write_text(ply(points, [face]))
    status, _, err = cli("render", tmp_path / "a.png", tmp_path / "a.ply", "--size", "64,48")
    assert (status, err) == (0, "")
    assert (cv2.imread(str(tmp_path / "a.png")) != cv2.imread(str(tmp_path / "a.png"))[0, 0]).any()


def test_a_board_too_small_for_its_finder(cli, here: Path) -> None:
    status, _, err = cli("calibrate", "camera", "capture", "out.txt", "--cols", 3, "--rows", 3)
    assert status == 1
    assert "has too few corners" in err


def test_errors_name_what_the_user_knows(tmp_path: Path) -> None:
    """Not the name that a file has while it is written."""
    unfinished = temporary_path(tmp_path / "images") / "003.png"
    assert final_name(unfinished) == str(tmp_path / "images" / "003.png")
    with pytest.raises(DataError) as found:
        write_bytes(unfinished, b"a")
    place = tmp_path / "images" / "003.png"
    assert str(found.value) == f"{place}: cannot be written: No such file or directory."


@pytest.mark.skipif(shutil.which("bash") is None, reason="needs limits of a shell")
@pytest.mark.parametrize("blocks", [1, 8])
def test_a_disk_that_is_full(demo_capture: Path, tmp_path: Path, blocks: int) -> None:
    """A limit on the size of files stands for it: 1 and 8 kB."""
    command = f"ulimit -f {blocks}; exec {sys.executable} -m polmvs inspect $0 --sheet $1"
    done = subprocess.run(
        ["bash", "-c", command, demo_capture, tmp_path / "sheet.png"],
        env={**os.environ, "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert f"{tmp_path / 'sheet.png'}: cannot be written: File too large" in done.stderr
    assert list(tmp_path.iterdir()) == []
