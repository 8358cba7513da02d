"""Bad input of large captures and clusters: one clear line before work starts."""

from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import refused


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Four small mosaics of nothing."""
    folder = tmp_path / "capture"
    folder.mkdir()
    rng = np.random.default_rng(0)
    for index in range(4):
        noise = rng.integers(0, 255, (48, 64), dtype=np.uint8)
        assert cv2.imwrite(str(folder / f"{index}.png"), noise)
    return folder


@pytest.mark.parametrize(
    ("flags", "status", "message"),
    [
        (("--pairs", "list.txt"), 1, "list.txt: names images that the capture does not have: x."),
        (("--pairs", "none.txt"), 1, "none.txt: is no readable list of pairs"),
        (("--database", "list.txt"), 1, "list.txt: is no sound COLMAP database"),
        (("--database", "none.db"), 1, "none.db: no such file. --database takes"),
        (("--memory", 0.05), 2, "--memory 0.05 GB hold no view of 0.0 million pixels"),
        (("--sparse", "model", "--pairs", "retrieval"), 2, "--pairs is for SfM, in whose place"),
        (("--mapper", "other"), 2, "--mapper"),
    ],
)
def test_refused(cli, capture, tmp_path, monkeypatch, flags, status, message) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "list.txt").write_text("0.png x.png\n")
    line = refused(cli("sfm", capture, tmp_path / "out", *flags), status)
    assert message in line
    assert not (tmp_path / "out").exists()
