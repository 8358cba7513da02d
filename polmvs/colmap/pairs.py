"""Pairs of images to match: all, the most similar ones, neighbours by name, or a list.

100 images have 4,950 pairs, 1,000 have half a million, and most pairs have no overlap or too
different directions. Retrieval first compares whole images, by VLAD (Jegou et al., Aggregating
local descriptors into a compact image representation, CVPR 2010) of the features for matching, with
the normalization within words of Arandjelovic and Zisserman (All about
VLAD, CVPR 2013).
"""

from __future__ import annotations

import logging
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans, vq
from scipy.sparse.csgraph import minimum_spanning_tree

from polmvs.config import PairChoice
from polmvs.errors import DataError
from polmvs.io.plain_files import read_list
from polmvs.scene import find_name, short_list

logger = logging.getLogger(__name__)

Floats: TypeAlias = NDArray[np.float32]
Pairs: TypeAlias = tuple[tuple[str, str], ...]
Descriptors: TypeAlias = Callable[[str], NDArray[np.generic]]


@dataclass(frozen=True, kw_only=True)
class PairTolerances:
    """Tolerances of the number of pairs.

    Measured: with ``pipelines/synthetic.py``, 100 views of an orbit in random order.

    Attributes
    ----------
    max_exhaustive_images : number of images up to which all pairs are matched; a guess: 780 pairs
        take seconds.
    num_similar : most similar images with which each one is matched; measured: see
        ``docs/records/scale.md``.
    num_in_time : images before and after with which each one is matched if names are numbered; a
        guess.
    num_words : of the vocabulary; a guess: published results hardly change from 64 to 256.
    num_training : descriptors for the vocabulary; a guess, 300 for each word.
    min_change : of the mean distance to the words at which the vocabulary has converged; a guess.
    """

    max_exhaustive_images: int = 40
    num_similar: int = 10
    num_in_time: int = 2
    num_words: int = 64
    num_training: int = 20_000
    min_change: float = 1e-3


def choose_pairs(
    names: Sequence[str],
    choice: str | None,
    descriptors: Descriptors,
    *,
    seed: int = 0,
    tolerances: PairTolerances = PairTolerances(),
) -> Pairs:
    """Pairs of images to match, each once, in order.

    Parameters
    ----------
    names : of the images, sorted.
    choice : ``exhaustive``, ``retrieval``, ``sequential``, or the path of a list of pairs; None:
        all pairs of few images, retrieval for more.
    descriptors : gives the (N, D) descriptors of an image by its name; only for retrieval.
    seed : of the vocabulary.
    tolerances : of this step.

    Raises
    ------
    DataError
        The list is unusable, see :func:`read_pairs`.
    """
    t = tolerances
    if choice is None:
        few = len(names) <= t.max_exhaustive_images
        choice = PairChoice.EXHAUSTIVE if few else PairChoice.RETRIEVAL
    if choice == PairChoice.EXHAUSTIVE:
        pairs = _neighbours(names, len(names))
    elif choice == PairChoice.SEQUENTIAL:
        # Before and after: as many partners as in the largest set that is matched in all pairs.
        pairs = _neighbours(names, t.max_exhaustive_images // 2)
    elif choice == PairChoice.RETRIEVAL:
        similarity = image_similarity(names, descriptors, seed=seed, tolerances=t)
        pairs = similar_pairs(names, similarity, t.num_similar)
        if names_count_up(names):
            pairs |= _neighbours(names, t.num_in_time)
    else:
        return read_pairs(Path(choice), names)
    logger.info("SfM: %d images, %d pairs (%s).", len(names), len(pairs), choice)
    return tuple(sorted(pairs))


def read_pairs(path: Path, names: Sequence[str]) -> Pairs:
    """Pairs from a text file: two names of images on each line; ``#`` begins a comment.

    Parameters
    ----------
    path : the file. Names with blanks stand between double quotes.
    names : of the images; the file may name them with another suffix.

    Raises
    ------
    DataError
        It cannot be read, has a line that is not a pair, names unknown images, or has no pair to
        match.
    """
    lines = read_list(path, "pairs").splitlines()
    known = {name: name for name in names}
    pairs, unknown = set(), []
    for number, line in enumerate(lines, start=1):
        words = [a or b for a, b in re.findall(r'"([^"]*)"|([^\s"]+)', line.partition("#")[0])]
        if not words:
            continue
        if len(words) != 2:
            raise DataError(
                path, f"line {number} has {len(words)} names; a pair is two names of images."
            )
        found = []
        for word in words:
            if word not in known:
                known[word] = find_name(word, names) or ""
            found.append(known[word])
        unknown += [word for word, name in zip(words, found, strict=True) if not name]
        if found[0] != found[1] and all(found):
            pairs.add((min(found), max(found)))
    if unknown:
        listed = short_list(list(dict.fromkeys(unknown)))
        raise DataError(path, f"names images that the capture does not have: {listed}.")
    if not pairs:
        raise DataError(path, "has no pair of two images.")
    return tuple(sorted(pairs))


def image_similarity(
    names: Sequence[str],
    descriptors: Descriptors,
    *,
    seed: int = 0,
    tolerances: PairTolerances = PairTolerances(),
) -> Floats:
    """Cosine ``(K, K)`` of the VLAD vectors of all images; 0 for images without features.

    Parameters
    ----------
    names, descriptors, seed : as in :func:`choose_pairs`.
    tolerances : of the vocabulary.
    """
    t, rng = tolerances, np.random.default_rng(seed)
    share = -(-t.num_training // max(len(names), 1))
    training = []
    for name in names:
        own = _unit_rows(descriptors(name))
        training.append(own[rng.permutation(len(own))[:share]])
    chosen = np.concatenate(training)
    if not len(chosen):
        return np.zeros((len(names), len(names)), np.float32)
    start = chosen[rng.permutation(len(chosen))[: t.num_words]]
    words, _ = kmeans(chosen, start, thresh=t.min_change)
    vectors = np.stack([vlad(_unit_rows(descriptors(name)), words) for name in names])
    return np.asarray(vectors @ vectors.T, np.float32)


def vlad(descriptors: Floats, words: Floats) -> Floats:
    """Unit vector ``(W * D,)`` of an image's descriptors ``(N, D)``; 0 if it has none."""
    total = np.zeros_like(words)
    if len(descriptors):
        nearest, _ = vq(descriptors, words)
        np.add.at(total, nearest, descriptors - words[nearest])
    total /= np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-12)
    return np.asarray(total.ravel() / max(float(np.linalg.norm(total)), 1e-12), np.float32)


def similar_pairs(
    names: Sequence[str], similarity: NDArray[np.floating], num_similar: int
) -> set[tuple[str, str]]:
    """Each image with the most similar ones, and the pairs that connect all images in one graph.

    Parameters
    ----------
    names : K images, sorted.
    similarity : (K, K), symmetric.
    num_similar : least number of partners of each image.
    """
    others = similarity - 4 * np.eye(len(names))  # never itself
    nearest = np.argsort(-others, axis=1, kind="stable")[:, : min(num_similar, len(names) - 1)]
    rows = np.repeat(np.arange(len(names)), nearest.shape[1])
    # Views that form islands among their nearest are joined where they are most alike. Zero is no
    # edge to the tree, so that all lengths are over 1.
    tree = minimum_spanning_tree(np.triu(3.0 - others, k=1)).tocoo()
    ends = zip((*rows, *tree.row), (*nearest.ravel(), *tree.col), strict=True)
    return {(names[min(a, b)], names[max(a, b)]) for a, b in ends}


def names_count_up(names: Sequence[str]) -> bool:
    """Whether all names are one, but for a number before the suffix: then they count time."""
    found = [re.fullmatch(r"(.*?)(\d+)(\.[^.]*)?", name) for name in names]
    return len({match and (match[1], match[3]) for match in found}) == 1 and None not in found


def _neighbours(names: Sequence[str], reach: int) -> set[tuple[str, str]]:
    """Each image with those after it."""
    return {(a, b) for i, a in enumerate(names) for b in names[i + 1 : i + 1 + reach]}


def _unit_rows(descriptors: NDArray[np.generic]) -> Floats:
    rows = np.asarray(descriptors, np.float32)
    lengths = np.linalg.norm(rows, axis=1, keepdims=True)
    return np.asarray(rows / np.maximum(lengths, 1e-12), np.float32)
