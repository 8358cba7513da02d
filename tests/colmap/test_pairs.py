"""Pairs of images: which are chosen, and lists that cannot be used."""

import itertools
import re

import numpy as np
import pytest

from polmvs.colmap.pairs import (
    PairTolerances,
    choose_pairs,
    image_similarity,
    names_count_up,
    read_pairs,
    similar_pairs,
)
from polmvs.config import SfmOptions
from polmvs.errors import DataError, OptionError

NAMES = [f"{index:03d}.png" for index in range(60)]


def no_descriptors(name):
    raise AssertionError("asked for features")


def ring_descriptors(num_points=1200, shown=240):
    """Images of a ring of things: each shows the next fifth of them, in a noisy likeness."""
    rng = np.random.default_rng(1)
    things = rng.uniform(0, 255, (num_points, 128))
    places = rng.permutation(len(NAMES))

    def descriptors(name):
        first = round(places[int(name[:3])] * num_points / len(NAMES))
        seen = things[np.arange(first, first + shown) % num_points]
        own = np.random.default_rng(int(name[:3]))
        noisy = seen + own.normal(scale=20, size=seen.shape)
        return np.clip(noisy, 0, 255).astype(np.uint8)

    return descriptors, places


@pytest.mark.parametrize(
    ("num", "choice", "expected"),
    [(40, None, 780), (3, None, 3), (60, "exhaustive", 1770), (60, "sequential", 990)],
)
def test_pairs_that_need_no_features(num, choice, expected):
    pairs = choose_pairs(NAMES[:num], choice, no_descriptors)
    assert len(pairs) == len(set(pairs)) == expected
    assert all(first < second for first, second in pairs)


def test_many_images_are_retrieved():
    """Neighbours on the ring are found, whatever their names, and few pairs are made."""
    descriptors, places = ring_descriptors()
    tolerances = PairTolerances(num_similar=6)
    pairs = choose_pairs(NAMES, None, descriptors, tolerances=tolerances)
    assert pairs == choose_pairs(NAMES, "retrieval", descriptors, tolerances=tolerances)
    assert len(pairs) < 60 * (6 + 2)
    gaps = [abs(int(places[int(a[:3])]) - int(places[int(b[:3])])) for a, b in pairs]
    near = np.minimum(gaps, len(NAMES) - np.array(gaps)) <= 8
    in_time = [abs(int(a[:3]) - int(b[:3])) <= 2 for a, b in pairs]
    assert np.all(near | in_time)
    followers = {frozenset(pair) for pair in pairs}
    order = np.argsort(places)
    for one, two in zip(order, np.roll(order, -1), strict=True):
        assert frozenset((NAMES[one], NAMES[two])) in followers


def test_neighbours_in_time_where_names_count():
    descriptors, _ = ring_descriptors()
    pairs = set(choose_pairs(NAMES, "retrieval", descriptors))
    assert set(itertools.pairwise(NAMES)) <= pairs
    assert names_count_up(NAMES)
    assert names_count_up(["a1.png", "a10.png", "a2.png"])
    assert not names_count_up(["a1.png", "b2.png"])
    assert not names_count_up(["left.png", "right.png"])


def test_islands_are_joined():
    """Two groups that see different things stay one graph."""
    similarity = np.kron(np.eye(2), np.full((5, 5), 0.9))
    similarity[2, 7] = similarity[7, 2] = 0.2
    names = NAMES[:10]
    pairs = similar_pairs(names, similarity, 2)
    assert (names[2], names[7]) in pairs
    assert sum(int(a[:3]) < 5 <= int(b[:3]) for a, b in pairs) == 1


def test_images_without_features():
    similarity = image_similarity(NAMES[:4], lambda name: np.zeros((0, 128), np.uint8))
    assert not similarity.any()
    some, _ = ring_descriptors()
    empty = np.zeros((0, 128), np.uint8)
    similarity = image_similarity(NAMES[:4], lambda n: empty if n == NAMES[0] else some(n))
    np.testing.assert_allclose(np.diag(similarity), [0, 1, 1, 1], atol=1e-6)


def test_list_of_pairs(tmp_path):
    path = tmp_path / "pairs.txt"
    path.write_text('# a comment\nb.png a.tif\n\n"a.png" "c d.png" # why\na b\nc.png c.png\n')
    names = ["a.png", "b.png", "c d.png", "c.png"]
    assert read_pairs(path, names) == (("a.png", "b.png"), ("a.png", "c d.png"))
    assert choose_pairs(names, str(path), no_descriptors) == read_pairs(path, names)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("a.png b.png\na.png z.png\ny.png b.png\n", r"does not have: z\.png, y\.png\."),
        ("a.png b.png c.png\n", "line 1 has 3 names"),
        ("a.png\n", "line 1 has 1 names"),
        ("# nothing\n", "has no pair"),
        ("a.png a.png\n", "has no pair"),
        (b"\xff\xfe\x00", "no readable list of pairs \\(not UTF-8\\)"),
        (None, "no readable list of pairs \\(No such file"),
    ],
)
def test_faulty_lists(tmp_path, text, message):
    path = tmp_path / "pairs.txt"
    if text is not None:
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(DataError, match=re.escape(str(path)) + ": .*" + message):
        read_pairs(path, ["a.png", "b.png", "c.png"])


def test_options(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert SfmOptions(pairs="retrieval").pairs_file is None
    assert SfmOptions(pairs="list.txt").pairs_file == tmp_path / "list.txt"
    for name, value in {"pairs": "retrieval", "database": tmp_path, "mapper": "global"}.items():
        with pytest.raises(OptionError, match=f"`sfm.{name}` is for SfM.*`sfm.sparse`"):
            SfmOptions(sparse=tmp_path, **{name: value})
