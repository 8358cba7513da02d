"""Removal of features outside masks."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from polmvs.arrays import Mask
from polmvs.colmap.database import image_numbers, opened
from polmvs.colmap.static_features import keep_features


def keep_inside(database: Path, masks: Mapping[str, Mask]) -> int:
    """Remove features outside of masks from a database that has no matches yet.

    Parameters
    ----------
    masks : (H, W) of each image, by its name.

    Returns
    -------
    The number of remaining features.
    """
    numbers = image_numbers(database)
    kept: dict[int, Mask] = {}
    with opened(database) as content:
        for name, mask in masks.items():
            xy = np.asarray(content.read_keypoints(numbers[name]))[:, :2]
            col, row = np.clip(np.floor(xy), 0, np.array(mask.shape[::-1]) - 1).astype(int).T
            kept[numbers[name]] = mask[row, col]
        keep_features(content, kept)
    return int(sum(mask.sum() for mask in kept.values()))
