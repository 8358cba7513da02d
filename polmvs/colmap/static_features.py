"""Features of a static background behind a part on a turntable.

On a turntable, part and table turn before a static camera. For SfM the camera moves about the part,
but the more numerous matches of the background say that it does not move. Background features are
recognized by their position: the same pixel shows the same in most images.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.arrays import Mask
from polmvs.colmap.database import opened, read_descriptors


@dataclass(frozen=True, kw_only=True)
class StaticTolerances:
    """Tolerances of static features.

    Attributes
    ----------
    num_others : images with which each is compared, evenly spread over the others. Costs time only.
    reach_px : distance within which a keypoint has the same position. Derived: three deviations of
        a keypoint along each axis.
    min_likeness : cosine of two descriptors of one feature. Guess.
    min_images : share of the compared images in which a keypoint is static, and in which a
        background must have such keypoints. Guess.
    min_share : of a background, in an image's keypoints. Guess: by chance it is below 1 %, and a
        mark on the lens or a dead pixel makes a few keypoints.
    min_count : of keypoints of a background in an image. Guess.
    """

    num_others: int = 8
    reach_px: float = 1.5
    min_likeness: float = 0.9
    min_images: float = 0.5
    min_share: float = 0.1
    min_count: int = 30


TOL = StaticTolerances()


def take_out_static(database: Path) -> float | None:
    """Remove features of a static background from a database that has no matches yet.

    Returns
    -------
    The share of removed features, if there is such a background; None: nothing was changed.
    """
    with opened(database) as content:
        ids = [image.image_id for image in content.read_all_images()]
        keypoints = [np.asarray(content.read_keypoints(number)) for number in ids]
        values = [read_descriptors(content, number) for number in ids]
        still = find_static([k[:, :2] for k in keypoints], values)
        if still is None:
            return None
        keep_features(content, {n: ~out for n, out in zip(ids, still, strict=True)})
        return float(np.concatenate(still).mean())


def keep_features(content: pycolmap.Database, kept: Mapping[int, Mask]) -> None:
    """Keep only the given features (N,) of each image, by its id, in a database without matches."""
    found = {n: (content.read_keypoints(n), content.read_descriptors(n)) for n in kept}
    content.clear_keypoints()
    content.clear_descriptors()
    for number, (points, features) in found.items():
        content.write_keypoints(number, np.ascontiguousarray(points[kept[number]]))
        features.data = np.ascontiguousarray(np.asarray(features.data)[kept[number]])
        content.write_descriptors(number, features)


def find_static(
    places: Sequence[NDArray[np.floating]],
    descriptors: Sequence[NDArray[np.number[Any]]],
) -> list[Mask] | None:
    """Which keypoints of each image are static; None if there is no static background.

    Parameters
    ----------
    places : (N, 2) of each image, px.
    descriptors : (N, D) of each image.
    """
    num = len(places)
    if num < 3:
        return None
    trees = [cKDTree(place) if len(place) else None for place in places]
    unit = [
        d / np.maximum(np.linalg.norm(d, axis=1, keepdims=True), 1e-12)
        for d in (np.asarray(one, np.float32) for one in descriptors)
    ]
    still = []
    for index in range(num):
        others = [other for other in range(num) if other != index]
        step = max(1, len(others) // TOL.num_others)
        chosen = others[::step][: TOL.num_others]
        count = np.zeros(len(places[index]), np.int64)
        for other in chosen:
            tree = trees[other]
            if tree is None or not len(count):
                continue
            distance, nearest = tree.query(places[index], distance_upper_bound=TOL.reach_px)
            near = np.flatnonzero(np.isfinite(distance))
            alike = (unit[index][near] * unit[other][nearest[near]]).sum(axis=1)
            count[near[alike > TOL.min_likeness]] += 1
        still.append(count >= TOL.min_images * len(chosen))
    enough = [
        out.sum() >= TOL.min_count and out.mean() >= TOL.min_share for out in still if len(out)
    ]
    if not enough or np.mean(enough) < TOL.min_images:
        return None
    return still
