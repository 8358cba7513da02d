"""Matches do not hang on how they are shared among processes, nor on threads."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest

from polmvs.colmap import database as database_module
from polmvs.colmap.database import image_numbers, match_pairs

NAMES = [f"view {k}.png" for k in range(6)]  # blanks, at which COLMAP splits its lists


@pytest.fixture(scope="module")
def features(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A database with features of six images of one plane, shifted."""
    folder = tmp_path_factory.mktemp("matching")
    noise = np.random.default_rng(0).integers(0, 255, (60, 80)).astype(np.uint8)
    texture = cv2.resize(noise, (640, 480), interpolation=cv2.INTER_CUBIC)
    (folder / "images").mkdir()
    for k, name in enumerate(NAMES):
        cv2.imwrite(
            str(folder / "images" / name), texture[10 * k : 300 + 10 * k, 15 * k :][:, :400]
        )
    path = folder / "database.db"
    pycolmap.Database.open(path).close()
    pycolmap.import_images(path, folder / "images", pycolmap.CameraMode.SINGLE, NAMES)
    pycolmap.extract_features(path, folder / "images", device=pycolmap.Device.cpu)
    return path


def matched(features: Path, folder: Path, pairs: list[tuple[str, str]]) -> dict[str, list]:
    """Rows of what is found, in a folder of its own."""
    folder.mkdir()
    path = folder / "database.db"
    path.write_bytes(features.read_bytes())
    match_pairs(path, tuple(pairs))
    assert sorted(image_numbers(path)) == NAMES
    assert [file.name for file in folder.iterdir()] == ["database.db"]
    with sqlite3.connect(path) as connection:
        return {
            table: connection.execute(f"SELECT * FROM {table} ORDER BY pair_id").fetchall()
            for table in ("matches", "two_view_geometries")
        }


def all_pairs() -> list[tuple[str, str]]:
    return [(a, b) for i, a in enumerate(NAMES) for b in NAMES[i + 1 :]]


def test_shares_give_the_same_matches(
    features: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(database_module, "default_num_workers", lambda: 3)
    alone = matched(features, tmp_path / "alone", all_pairs())
    monkeypatch.setattr(database_module, "MIN_SHARE", 1)
    assert matched(features, tmp_path / "shared", all_pairs()) == alone
    assert len(alone["matches"]) == len(all_pairs())
    assert min(rows for _, rows, *_ in alone["matches"]) > 30


def test_one_thread_searches_at_a_time(
    features: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two disturb each other, so rarely that no test would see it in the matches."""
    threads = []
    match = pycolmap.match_image_pairs

    def watched(*arguments, matching_options, **others) -> None:
        threads.append(matching_options.num_threads)
        match(*arguments, matching_options=matching_options, **others)

    monkeypatch.setattr(pycolmap, "match_image_pairs", watched)
    matched(features, tmp_path / "alone", all_pairs()[:2])
    assert threads == [1]
