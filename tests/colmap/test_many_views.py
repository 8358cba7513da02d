"""SfM of many unordered views: retrieved pairs, a given database, the global mapper."""

import shutil
import sqlite3
from contextlib import closing

import numpy as np
import pycolmap
import pytest
from printed_images import CAMERA, INTRINSICS, write_printed_images

from polmvs.colmap.database import check_database
from polmvs.colmap.sfm import SfmTolerances, run_sfm
from polmvs.config import SfmOptions
from polmvs.errors import DataError
from polmvs.geometry import align_points

NUM_VIEWS = 18
ALL = 100_000  # matches of a pair


@pytest.fixture(scope="module")
def capture(tmp_path_factory):
    folder = tmp_path_factory.mktemp("orbit")
    return folder, write_printed_images(folder, NUM_VIEWS)


@pytest.fixture(scope="module")
def retrieved(capture, tmp_path_factory):
    """A model by retrieval, and its database, which stays."""
    folder, views = capture
    work = tmp_path_factory.mktemp("work")
    options = SfmOptions(intrinsics=INTRINSICS, pairs="retrieval")
    names, whole = [view.name for view in views], SfmTolerances(min_pair_matches=ALL)
    model = run_sfm(folder, names, work, work / "sparse", options, tolerances=whole)
    return model, work / "database.db"


def sfm(capture, work, *, min_pair_matches=ALL, **options):
    folder, views = capture
    names = [view.name for view in views]
    given = SfmOptions(**{"intrinsics": INTRINSICS, **options})
    tolerances = SfmTolerances(min_pair_matches=min_pair_matches)
    return run_sfm(folder, names, work / "work", work / "sparse", given, tolerances=tolerances)


def change(database, *statements):
    """Close it as COLMAP does, so that all is in the one file."""
    with closing(sqlite3.connect(database)) as connection, connection:
        for statement in statements:
            connection.execute(statement)


def matched_pairs(database):
    with closing(sqlite3.connect(database)) as connection:
        return connection.execute("SELECT count(*) FROM matches").fetchone()[0]


def image_names(database):
    with closing(sqlite3.connect(database)) as connection:
        return {name for (name,) in connection.execute("SELECT name FROM images")}


def center_errors_mm(model, views):
    """Distances of the cameras from the true ones after alignment; all must be there."""
    assert [view.name for view in model.views] == [view.name for view in views]
    found = np.array([view.center_in_world for view in model.views])
    true = np.array([view.center_in_world for view in views])
    return 1e3 * np.linalg.norm(align_points(found, true) * found - true, axis=1)


def assert_same(one, other):
    for first, second in zip(one.views, other.views, strict=True):
        a, b = first.cam_from_world, second.cam_from_world
        np.testing.assert_array_equal(a.rotation, b.rotation)
        np.testing.assert_array_equal(a.translation, b.translation)
    np.testing.assert_array_equal(one.tracks.points_in_world, other.tracks.points_in_world)
    np.testing.assert_array_equal(one.tracks.obs_xy, other.tracks.obs_xy)


def test_unordered_orbit(capture, retrieved):
    """All views are found. 0.4 mm at 600 mm when written: a third of a pixel's gsd."""
    model, database = retrieved
    assert np.median(center_errors_mm(model, capture[1])) < 1.0
    assert matched_pairs(database) < NUM_VIEWS * (NUM_VIEWS - 1) / 2
    assert image_names(database) == {view.name for view in capture[1]}


def test_database_is_taken_and_kept(capture, retrieved, tmp_path):
    """Its features and matches give the same model; neither it nor its folder changes."""
    model, original = retrieved
    database = tmp_path / "mine" / "given.db"
    database.parent.mkdir()
    shutil.copy(original, database)
    change(database, "UPDATE images SET name = 'shots/' || replace(name, '.png', '.tif')")
    before = database.read_bytes()
    again = sfm(capture, tmp_path, database=database)
    assert database.read_bytes() == before
    assert [path.name for path in database.parent.iterdir()] == ["given.db"]
    assert_same(model, again)


def test_database_without_matches_or_with_more_pairs(capture, retrieved, tmp_path):
    """Features alone are matched; pairs that are asked for are added."""
    _, views = capture
    database = tmp_path / "features.db"
    shutil.copy(retrieved[1], database)
    change(database, "DELETE FROM matches", "DELETE FROM two_view_geometries")
    names = [view.name for view in views]
    pairs = tmp_path / "pairs.txt"
    pairs.write_text("".join(f"{a} {b}\n" for a in names[:4] for b in names if a < b))
    model = sfm(capture, tmp_path, database=database, pairs=str(pairs))
    assert np.median(center_errors_mm(model, views)) < 2.0
    assert matched_pairs(tmp_path / "work" / "database.db") == 17 + 16 + 15 + 14


def test_global_mapper(capture, retrieved, tmp_path):
    """As exact as the incremental one of fewer matches too, and the same twice."""
    if not hasattr(pycolmap, "global_mapping"):
        pytest.skip("pycolmap before 4.1")
    options = {"database": retrieved[1], "mapper": "global", "min_pair_matches": 30}
    one = sfm(capture, tmp_path / "one", **options)
    assert np.median(center_errors_mm(one, capture[1])) < 1.0
    assert_same(one, sfm(capture, tmp_path / "two", **options))


def test_mapping_of_fewer_matches(capture, retrieved, tmp_path):
    """All points come back, the cameras are as exact, and twice the same."""
    options = {"database": retrieved[1], "min_pair_matches": 30}
    one = sfm(capture, tmp_path / "one", **options)
    assert np.median(center_errors_mm(one, capture[1])) < 1.0
    num_points = len(retrieved[0].tracks.point3D_ids)
    assert len(one.tracks.point3D_ids) == pytest.approx(num_points, rel=0.1)
    assert_same(one, sfm(capture, tmp_path / "two", **options))


def test_too_few_matches_to_map_are_not_all(capture, retrieved, tmp_path):
    """Where the mapper cannot do with a part of them it gets the rest."""
    model = sfm(capture, tmp_path, database=retrieved[1], min_pair_matches=2)
    assert_same(model, retrieved[0])


def test_names_with_blanks(capture, tmp_path):
    folder, views = capture
    images = tmp_path / "images"
    images.mkdir()
    names = [f"view {index}, left.png" for index in range(4)]
    for view, name in zip(views, names, strict=False):
        shutil.copy(folder / view.name, images / name)
    run_sfm(images, names, tmp_path, tmp_path / "sparse", SfmOptions(intrinsics=INTRINSICS))
    assert image_names(tmp_path / "database.db") == set(names)
    assert matched_pairs(tmp_path / "database.db") == 6


SIZE = (CAMERA.width, CAMERA.height)


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ("DROP TABLE keypoints", "no table keypoints"),
        ("UPDATE images SET name = 'x' || name", "names 0 of the capture's 18 images"),
        ("UPDATE cameras SET width = 600, height = 500", "600x500 px.*300x250 px"),
        ("UPDATE keypoints SET data = substr(data, 9)", r"damaged features of 000\.png"),
        ("UPDATE descriptors SET rows = rows - 1", r"damaged features of 000\.png"),
        ("UPDATE images SET camera_id = 99", "has unknown px"),
        ("DELETE FROM keypoints", "has no features"),
    ],
)
def test_unusable_databases(capture, retrieved, tmp_path, statement, message):
    database = tmp_path / "given.db"
    shutil.copy(retrieved[1], database)
    change(database, statement)
    with pytest.raises(DataError, match=rf"given\.db: .*{message}"):
        check_database(database, [view.name for view in capture[1]], *SIZE)


def test_files_that_are_no_databases(retrieved, tmp_path):
    names = ["000.png", "001.png"]
    with pytest.raises(DataError, match=r"none\.db: no such file"):
        check_database(tmp_path / "none.db", names, *SIZE)
    text = tmp_path / "text.db"
    text.write_text("no database\n" * 100)
    whole = retrieved[1].read_bytes()
    cut = tmp_path / "cut.db"
    cut.write_bytes(whole[: len(whole) // 2])
    torn = tmp_path / "torn.db"
    torn.write_bytes(whole[:8192] + bytes(4096) + whole[12288:])
    for path in (text, cut, torn):
        with pytest.raises(DataError, match=rf"{path.name}: .*`sfm\.database`"):
            check_database(path, names, *SIZE)
