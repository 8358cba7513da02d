"""Harder matching, in steps, for views that SfM does not register.

Steps keep the keypoints and all matches between registered views. Each step is slower than the
previous one, and they end when every view is registered.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np
import pycolmap

from polmvs.colmap.database import image_numbers, match_pairs, opened
from polmvs.colmap.pairs import Pairs
from polmvs.scene import short_list

logger = logging.getLogger(__name__)

# Up to which images more is tried: descriptors of all are made anew. A guess: of many views one
# that is left out is no great loss.
MAX_IMAGES = 40

Describe = Callable[[Path], None]  # makes a database of the same images with pooled descriptors
Map = Callable[[], pycolmap.Reconstruction | None]


class Step(StrEnum):
    """The steps, the quickest first."""

    GUIDED = "guided matching"
    POOLED = "domain-size pooling and guided matching"


@dataclass(frozen=True, kw_only=True)
class Trial:
    """Functions for new matches and models.

    Attributes
    ----------
    database : of the features and matches; changed.
    pairs : names of the matched pairs of images.
    describe : makes a database with pooled descriptors of the same images.
    map : gives the mapper's model of the database, or None.
    seed : of the verification.
    """

    database: Path
    pairs: Pairs
    describe: Describe
    map: Map
    seed: int


def try_harder(
    found: pycolmap.Reconstruction | None, names: Sequence[str], trial: Trial
) -> pycolmap.Reconstruction | None:
    """The model with the most views after the necessary steps.

    Parameters
    ----------
    found : the current model.
    names : of all images.
    trial : functions of the steps.

    Returns
    -------
    ``found`` if no step registers more views.
    """
    best = found
    for step in Step:
        missing = _missing(best, names)
        if not missing:
            break
        pairs = tuple(pair for pair in trial.pairs if missing & set(pair))
        if step is Step.POOLED:
            pool_descriptors(trial)
        forget_matches(trial.database, pairs)
        match_pairs(trial.database, pairs, seed=trial.seed, guided=True)
        model = trial.map()
        gained = missing - _missing(model, names)
        if model is not None and len(_missing(model, names)) < len(missing):
            logger.warning(
                "SfM: without a pose at first, with one after %s: %s.",
                step.value,
                short_list(sorted(gained)),
            )
            best = model
    if missing := _missing(best, names):
        steps = " nor ".join(step.value for step in Step)
        logger.info("SfM: neither %s helps %s.", steps, short_list(sorted(missing)))
    return best


def _missing(model: pycolmap.Reconstruction | None, names: Sequence[str]) -> set[str]:
    """Names of the images without a pose."""
    if model is None:
        return set(names)
    return set(names) - {model.images[number].name for number in model.reg_image_ids()}


def forget_matches(database: Path, pairs: Pairs) -> None:
    """Remove the matches of pairs from a database."""
    numbers = image_numbers(database)
    with opened(database) as content:
        for first, second in pairs:
            pair = numbers[first], numbers[second]
            if content.exists_matches(*pair):
                content.delete_matches(*pair)
            if content.exists_two_view_geometry(*pair):
                content.delete_two_view_geometry(*pair)


def pool_descriptors(trial: Trial) -> None:
    """Replace the descriptors of a database by pooled ones of the same keypoints."""
    pooled = trial.database.with_name("pooled.db")
    trial.describe(pooled)
    numbers, others = image_numbers(trial.database), image_numbers(pooled)
    with opened(trial.database) as content, opened(pooled) as source:
        replaced = {}
        for name, number in numbers.items():
            # Pooling leaves the keypoints as they are; those of a static background are gone here.
            here = np.ascontiguousarray(content.read_keypoints(number))
            there = np.ascontiguousarray(source.read_keypoints(others[name]))
            rows = {row.tobytes(): index for index, row in enumerate(there)}
            kept = [rows[row.tobytes()] for row in here]
            features = source.read_descriptors(others[name])
            features.data = np.ascontiguousarray(np.asarray(features.data)[kept])
            replaced[number] = features
        content.clear_descriptors()
        for number, features in replaced.items():
            content.write_descriptors(number, features)
    for path in pooled.parent.glob(f"{pooled.name}*"):
        path.unlink()
