"""Why SfM found no model is told apart, from the database that it leaves."""

import sqlite3
from contextlib import closing
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from fuzzing.readers import write_database

from polmvs.colmap.sfm import run_sfm
from polmvs.colmap.sfm_failure import why_no_model
from polmvs.config import SfmOptions
from polmvs.errors import DataError


def database_of(folder: Path, num_features: int, shared: dict[tuple[int, int], int]) -> Path:
    """A database of four images, some of which share verified matches."""
    path = folder / "database.db"
    rng = np.random.default_rng(0)
    with closing(pycolmap.Database.open(path)) as database:
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", 300.0, 400, 300)
        camera_id = database.write_camera(camera)
        ids = []
        for index in range(4):
            image = pycolmap.Image(name=f"{index}.png", camera_id=camera_id)
            ids.append(database.write_image(image))
            places = rng.uniform(0, 300, (num_features, 2)).astype(np.float32)
            database.write_keypoints(ids[-1], places)
        for (a, b), num in shared.items():
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.repeat(np.arange(num, dtype=np.uint32)[:, None], 2, 1)
            database.write_two_view_geometry(ids[a], ids[b], geometry)
    return path


def test_no_texture(tmp_path: Path) -> None:
    found = why_no_model(database_of(tmp_path, 20, {}), SfmOptions())
    assert "too little texture: under 100 features in 4 of 4 (0.png, 1.png" in found
    assert "`sfm.sparse`" in found


def test_too_little_overlap(tmp_path: Path) -> None:
    found = why_no_model(database_of(tmp_path, 900, {(0, 1): 40, (1, 2): 12}), SfmOptions())
    assert "overlap too little: the two most alike share 40 features, and 2 of 4" in found


@pytest.mark.parametrize(
    ("options", "remedy"),
    [
        (SfmOptions(camera_model="OPENCV_FISHEYE"), "`sfm.camera_model` OPENCV_FISHEYE; a normal"),
        (SfmOptions(intrinsics=(9.0, 9.0, 4.0, 4.0)), "Check `sfm.intrinsics`"),
        (SfmOptions(), "Give `sfm.intrinsics`"),
    ],
)
def test_a_camera_that_explains_nothing(tmp_path: Path, options: SfmOptions, remedy: str) -> None:
    shared = {(0, 1): 400, (1, 2): 300, (2, 3): 200}
    found = why_no_model(database_of(tmp_path, 900, shared), options)
    assert "have texture and overlap (up to 400 shared features)" in found
    assert remedy in found


@pytest.mark.parametrize(
    "damage",
    [
        "UPDATE cameras SET model = 999",
        "UPDATE cameras SET params = x'00'",
        "UPDATE two_view_geometries SET rows = 1000",
        "UPDATE two_view_geometries SET F = x'00'",
    ],
)
def test_a_database_that_colmap_refuses_is_named(tmp_path: Path, damage: str) -> None:
    """What SQLite finds sound and COLMAP does not."""
    write_database(tmp_path)
    with closing(sqlite3.connect(tmp_path / "a.db")) as connection, connection:
        connection.execute(damage)
    for name in ("a.png", "b.png"):
        cv2.imwrite(str(tmp_path / name), np.zeros((16, 24), np.uint8))
    options = SfmOptions(database=tmp_path / "a.db", pairs="exhaustive")
    with pytest.raises(DataError, match=r"a\.db: is no sound COLMAP database"):
        run_sfm(tmp_path, ["a.png", "b.png"], tmp_path / "w", tmp_path / "sparse", options)
