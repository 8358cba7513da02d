"""Pipes and devices in the place of files: refused at once, never waited for."""

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.plain_files import open_plain, read_text
from polmvs.pipeline.run_lock import LOCK_FILE, locked

pytestmark = pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="needs pipes with names")
LIMIT_S = 10


class Late(BaseException):
    """What nothing on the way takes for an error of its own."""


@contextmanager
def in_time() -> Iterator[None]:
    def late(number, frame):
        raise Late(f"not within {LIMIT_S} s")

    before = signal.signal(signal.SIGALRM, late)
    signal.alarm(LIMIT_S)
    try:
        yield
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, before)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A capture of three mosaics, and pipes with the endings of what is read."""
    rng = np.random.default_rng(0)
    (tmp_path / "capture").mkdir()
    for index in range(3):
        mosaic = rng.integers(0, 200, (64, 80)).astype(np.uint8)
        cv2.imwrite(str(tmp_path / "capture" / f"{index}.png"), mosaic)
    for name in ("p.toml", "p.csv", "p.json", "p.txt", "p.yaml", "p.ply", "p.png", "p.tif"):
        os.mkfifo(tmp_path / name)
    for folder, names in {
        "model": ("cameras.bin", "images.bin", "points3D.bin"),
        "text": ("cameras.txt", "images.txt", "points3D.txt"),
        "gt": ("cameras.json",),
        "run": ("run.json",),
        "frames": ("0.png", "1.png"),
    }.items():
        (tmp_path / folder).mkdir()
        for name in names:
            os.mkfifo(tmp_path / folder / name)
    (tmp_path / "locked").mkdir()
    os.mkfifo(tmp_path / "locked" / LOCK_FILE)
    return tmp_path


@pytest.mark.parametrize(
    "arguments",
    [
        ("inspect", "{}/frames"),
        ("inspect", "{}/capture", "--config", "{}/p.toml"),
        ("inspect", "{}/capture", "--calibration", "{}/p.toml"),
        ("plane", "{}/p.png", "--intrinsics", "50,50,20,16"),
        ("plane", "{}/capture/0.png", "--intrinsics", "50,50,20,16", "--mask", "{}/p.png"),
        ("sfm", "{}/capture", "{}/out", "--sparse", "{}/model"),
        ("sfm", "{}/capture", "{}/out", "--sparse", "{}/text"),
        ("sfm", "{}/capture", "{}/out", "--camera", "{}/p.yaml"),
        ("sfm", "{}/capture", "{}/out", "--pairs", "{}/p.txt"),
        ("sfm", "{}/capture", "{}/out", "--reference", "{}/p.json"),
        ("sfm", "{}/capture", "{}/locked", "--resume"),
        ("densify", "{}/capture", "{}/run"),
        ("report", "{}/run"),
        ("mesh", "{}/p.ply", "{}/mesh.ply"),
        ("render", "{}/a.png", "{}/p.ply"),
        ("render", "{}/p.png", "{}/p.ply"),
        ("evaluate", "{}/p.ply", "--gt", "{}/gt", "--sparse", "{}/model"),
        ("batch", "{}/p.csv", "{}/out"),
        ("batch", "{}/p.toml", "{}/out"),
    ],
    ids=lambda arguments: " ".join(arguments).replace("{}/", ""),
)
def test_no_command_waits_for_a_pipe(cli, folder: Path, arguments: tuple[str, ...]) -> None:
    with in_time():
        status, _, err = cli(*(argument.replace("{}", str(folder)) for argument in arguments))
    assert status in (1, 2)
    assert err.count("\n") == 1
    assert "internal error" not in err


def test_devices_and_folders(tmp_path: Path) -> None:
    with in_time():
        for path in ("/dev/zero", "/dev/null"):
            with pytest.raises(OSError, match="pipe, socket or device"):
                open_plain(path)
        with pytest.raises(IsADirectoryError):
            open_plain(tmp_path)
        with pytest.raises(FileNotFoundError):
            read_text(tmp_path / "none")


def test_text_is_read_as_text(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "a.txt").write_bytes("\ufeffä\r\nb\rc\n".encode())
    assert read_text(tmp_path / "a.txt", "utf-8-sig") == "ä\nb\nc\n"
    monkeypatch.setattr("polmvs.io.plain_files.MAX_TEXT_BYTES", 9)
    with pytest.raises(OSError, match="too large for a text"):
        read_text(tmp_path / "a.txt")


def test_a_lock_that_is_a_pipe_stays(folder: Path) -> None:
    with (
        in_time(),
        pytest.raises(DataError, match="was not written by polmvs"),
        locked(folder / "locked"),
    ):
        pass
    assert (folder / "locked" / LOCK_FILE).is_fifo()
