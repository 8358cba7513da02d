"""Fewer matches for the mapper: its time grows with them, and the poses hardly improve.

Poses come from a sample of the tracks; points and the final adjustment use all of them.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from pathlib import Path
from typing import TypeAlias

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

Flags: TypeAlias = NDArray[np.bool_]

PAIR_BYTES = 8  # of a match: two uint32


def thin_database(database: Path, target: Path, num_kept: int, *, seed: int = 0) -> bool:
    """Write a database with fewer matches, if more than half of them can be removed.

    Parameters
    ----------
    database : COLMAP's, with verified matches; it is not changed.
    target : a new file.
    num_kept, seed : see :func:`sample_tracks`.

    Returns
    -------
    bool
        Whether it was written.
    """
    with closing(sqlite3.connect(database)) as source:
        try:
            rows = source.execute(
                "SELECT pair_id, data FROM two_view_geometries WHERE length(data) = ? * rows",
                (PAIR_BYTES,),
            ).fetchall()
        except sqlite3.DatabaseError:  # a damaged one is left to COLMAP
            return False
        numbers = [number for number, _ in rows]
        matches = [np.frombuffer(data, np.uint32).reshape(-1, 2) for _, data in rows]
        pairs = [pycolmap.pair_id_to_image_pair(number) for number in numbers]
        kept = sample_tracks(pairs, matches, num_kept, seed=seed)
        if 2 * sum(map(np.count_nonzero, kept)) >= sum(map(len, kept)):
            return False
        with closing(sqlite3.connect(target)) as thinned, thinned:
            source.backup(thinned)
            for number, found, keep in zip(numbers, matches, kept, strict=True):
                thinned.execute(
                    "UPDATE two_view_geometries SET rows = ?, data = ? WHERE pair_id = ?",
                    (int(keep.sum()), found[keep].tobytes(), number),
                )
    return True


def sample_tracks(
    pairs: Sequence[tuple[int, int]],
    matches: Sequence[NDArray[np.unsignedinteger]],
    num_kept: int,
    *,
    seed: int = 0,
) -> list[Flags]:
    """Matches of each pair to keep, whole tracks at a time.

    All tracks have one random order. A pair keeps its first tracks in this order, and all other
    pairs keep these as well. So tracks stay whole, a pair with few matches keeps all, and the kept
    matches have the distribution of all.

    Parameters
    ----------
    pairs : numbers of the two images of each.
    matches : (M, 2) of each pair, indices of keypoints in the two images.
    num_kept : least number of matches that a pair keeps, if it has as many.
    seed : of the order.
    """
    if not matches:
        return []
    sizes = [len(found) for found in matches]
    images = np.repeat(np.asarray(pairs, np.int64), sizes, axis=0)
    _, ends = np.unique((images << 32) + np.concatenate(matches), return_inverse=True)
    ends = ends.reshape(-1, 2)
    num_keypoints = ends.max(initial=-1) + 1
    graph = coo_array((np.ones(len(ends), bool), ends.T), shape=(num_keypoints, num_keypoints))
    num_tracks, track = connected_components(graph, directed=False)
    turn = np.random.default_rng(seed).permutation(num_tracks)[track[ends[:, 0]]]
    turns = np.split(turn, np.cumsum(sizes)[:-1])
    kept = np.zeros(num_tracks, bool)
    for own in turns:
        kept[np.sort(own)[:num_kept]] = True
    return [kept[own] for own in turns]
