"""Names that are no text, long names, and text in a locale that knows none: work, or one line."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from polmvs.io.capture_files import MAX_NAME_BYTES

INTRINSICS = "333.75,333.75,230.6475,196.608"  # of the bundled capture


def copy_capture(demo_capture: Path, folder: Path, name: str, num: int = 3) -> Path:
    folder.mkdir()
    for index, path in enumerate(sorted((demo_capture / "raw").iterdir())[:num]):
        shutil.copy(path, folder / name.format(index))
    return folder


@pytest.fixture
def refuses(cli, tmp_path: Path):
    def refuses(capture: Path, out: Path, *arguments: object) -> str:
        before = sorted(tmp_path.rglob("*"))
        status, text, err = cli("reconstruct", capture, out, *arguments)
        assert (status, text, err.count("\n")) == (1, "", 1), err
        assert sorted(tmp_path.rglob("*")) == before
        return err

    return refuses


def test_what_is_not_utf_8_is_refused_at_the_start(refuses, demo_capture: Path, tmp_path: Path):
    odd = os.fsdecode(b"\xffa")
    capture = copy_capture(demo_capture, tmp_path / "capture", odd + "{}.png")
    assert r"\udcffa0.png': is a name that is not UTF-8" in refuses(capture, tmp_path / "out")
    for arguments in (
        (demo_capture, tmp_path / odd),
        (tmp_path / odd, tmp_path / "out"),
        (demo_capture, tmp_path / "out", "--sparse", tmp_path / odd),
    ):
        assert r"\udcffa': is a name that is not UTF-8" in refuses(*arguments)


def test_a_name_too_long_for_its_results_is_refused_at_the_start(
    refuses, demo_capture: Path, tmp_path: Path
) -> None:
    long = "ü" * (MAX_NAME_BYTES // 2)
    capture = copy_capture(demo_capture, tmp_path / "capture", long[3:] + "{}.png", 1)
    copy_capture(demo_capture, tmp_path / "more", long + "{}.png")
    for path in (tmp_path / "more").iterdir():
        shutil.copy(path, capture)
    assert f"{long}0.png' is longer than {MAX_NAME_BYTES} bytes" in refuses(
        capture, tmp_path / "out"
    )


@pytest.mark.slow
def test_text_works_in_every_locale_and_the_longest_names_do(
    demo_capture: Path, tmp_path: Path
) -> None:
    name = "ä" + "x" * (MAX_NAME_BYTES - len("ä0.png".encode())) + "{}.png"
    capture = copy_capture(demo_capture, tmp_path / "größe", name)
    arguments = ["reconstruct", capture, tmp_path / "maß", "--intrinsics", INTRINSICS, "--quiet"]
    arguments += ["--no-report", "--no-mesh", "--workers", 1, "--method", "contour"]
    done = subprocess.run(
        [sys.executable, "-m", "polmvs", *map(str, arguments)],
        env={**os.environ, "LC_ALL": "C"},
        capture_output=True,
        check=False,
    )
    assert (done.returncode, done.stderr) == (0, b"")
    assert (tmp_path / "maß" / "ppa.ply").is_file()
    maps = tmp_path / "maß" / "dense" / "stereo" / "depth_maps"
    assert len(list(maps.iterdir())) == 3


def test_a_name_that_no_system_takes_is_shown_short(
    cli, demo_capture: Path, tmp_path: Path
) -> None:
    calibration = tmp_path / "calibration.toml"
    calibration.write_text(f'version = 1\ndark = "{"9" * 3000}"\n')
    status, _, err = cli("inspect", demo_capture, "--calibration", calibration)
    assert status == 1
    assert str(tmp_path) in err
    assert "999 ... 999" in err
    assert len(err) < 2000
