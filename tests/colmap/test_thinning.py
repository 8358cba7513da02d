"""Fewer matches for the mapper: whole tracks, weak pairs untouched, the database as it was."""

import sqlite3
from contextlib import closing

import numpy as np
import pycolmap

from polmvs.colmap.thinning import sample_tracks, thin_database


def write_database(path, matches):
    """One with these matches of the pairs of images 1 and 2, 2 and 3, and so on."""
    database = pycolmap.Database.open(path)
    camera = pycolmap.Camera(model="PINHOLE", width=300, height=200, params=[200, 200, 150, 100])
    camera.camera_id = database.write_camera(camera)
    for index in range(len(matches) + 1):
        image = pycolmap.Image(name=f"{index}.png", camera_id=camera.camera_id)
        image.image_id = database.write_image(image)
        database.write_keypoints(image.image_id, np.zeros((1000, 2), np.float32))
    for index, found in enumerate(matches, start=1):
        geometry = pycolmap.TwoViewGeometry()
        geometry.inlier_matches = found
        database.write_two_view_geometry(index, index + 1, geometry)
    database.close()


def read_matches(path):
    database = pycolmap.Database.open(path)
    pairs, geometries = database.read_two_view_geometries()
    database.close()
    found = dict(zip(pairs, geometries, strict=True))
    return [found[pair].inlier_matches for pair in sorted(found)]


def chain(num_tracks):
    """Tracks through three images; the keypoints of each are in another order."""
    order = np.random.default_rng(1).permutation(num_tracks)
    first = np.stack([np.arange(num_tracks), order], axis=1).astype(np.uint32)
    second = np.stack([order, np.arange(num_tracks)], axis=1).astype(np.uint32)
    return first, second[::-1]


def test_tracks_stay_whole():
    first, second = chain(500)
    one, other = sample_tracks([(1, 2), (2, 3)], [first, second], 40)
    assert one.sum() == other.sum() == 40
    assert set(first[one, 1]) == set(second[other, 0])


def test_weak_pairs_keep_all():
    """And what they keep, the other pairs of these tracks keep beside their own."""
    first, second = chain(500)
    weak = np.stack([np.arange(30), np.arange(30)], axis=1).astype(np.uint32)
    matches = [first, second, weak]
    kept = sample_tracks([(1, 2), (2, 3), (3, 4)], matches, 40)
    assert kept[2].all()
    assert 40 < kept[0].sum() <= 70
    assert kept[0].sum() == kept[1].sum()
    again = sample_tracks([(1, 2), (2, 3), (3, 4)], matches, 40)
    for one, other in zip(kept, again, strict=True):
        np.testing.assert_array_equal(one, other)


def test_nothing_to_sample():
    assert sample_tracks([], [], 40) == []
    (kept,) = sample_tracks([(1, 2)], [np.zeros((0, 2), np.uint32)], 40)
    assert kept.shape == (0,)


def test_database_is_thinned_into_a_new_one(tmp_path):
    full, thinned = tmp_path / "full.db", tmp_path / "thinned.db"
    write_database(full, chain(500))
    before = full.read_bytes()
    assert thin_database(full, thinned, 40)
    assert full.read_bytes() == before
    assert [len(found) for found in read_matches(thinned)] == [40, 40]
    assert {tuple(row) for row in read_matches(thinned)[0]} <= {tuple(row) for row in chain(500)[0]}


def test_database_with_little_to_gain_or_damage(tmp_path):
    full, thinned = tmp_path / "full.db", tmp_path / "thinned.db"
    write_database(full, chain(500))
    assert not thin_database(full, thinned, 251)
    with closing(sqlite3.connect(full)) as connection, connection:
        connection.execute("UPDATE two_view_geometries SET data = NULL")
    assert not thin_database(full, thinned, 40)
    assert not thinned.exists()
