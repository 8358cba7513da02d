"""The size of printed markers in the model, which gives its scale."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from polmvs.errors import DataError
from polmvs.poses.markers import Detection
from polmvs.poses.triangulation import Triangulation, triangulate_together
from polmvs.scene import View, short_list

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

SIGMA_LIMIT = 4.0  # standard deviations within which two lengths count as equal
FLOOR = 0.01  # relative difference that is always allowed: paper and print are no better
MAX_RELATIVE_SIGMA = 0.1  # of the side; a scale known worse than this is of no use


@dataclass(frozen=True, kw_only=True)
class MarkerMeasure:
    """Side of the markers in the model.

    Attributes
    ----------
    side : world units.
    relative_sigma : its standard deviation as a share of it.
    rms_residual_px : of the corners, px.
    marker_ids : measured markers.
    num_views : that show at least one of them.
    dropped : what is left out, as ``marker ID in NAME``.
    """

    side: float
    relative_sigma: float
    rms_residual_px: float
    marker_ids: tuple[int, ...]
    num_views: int
    dropped: tuple[str, ...]


@dataclass(frozen=True)
class _Square:
    """One triangulated marker; ``lengths`` and ``sigmas`` (6,): four sides, two diagonals / √2."""

    marker_id: int
    views: tuple[int, ...]
    rejected: tuple[int, ...]
    rms_px: float
    side: float
    side_sigma: float
    lengths: Array
    sigmas: Array


def measure_markers(
    views: Sequence[View], detections: Sequence[Detection], *, source: str
) -> MarkerMeasure:
    """Common side of the markers, each triangulated from all views that show it.

    Parameters
    ----------
    views : posed.
    detections : of one printed size.
    source : the option, for messages.

    Raises
    ------
    DataError
        No marker is seen from two views that agree, one is not square by more than its
        uncertainty and 1 %, two differ in size by more than that, or the size is not known to
        10 %.
    """
    by_id: dict[int, list[Detection]] = {}
    for detection in detections:
        by_id.setdefault(detection.marker_id, []).append(detection)
    if not by_id:
        raise DataError(
            source,
            f"no such marker is found in the {len(views)} images. Check the dictionary; a marker "
            "needs a white margin and some 20 px or more.",
        )
    squares, faults = [], []
    for marker_id, seen in sorted(by_id.items()):
        square = _measure(views, marker_id, seen)
        if isinstance(square, str):
            faults.append(square)
        else:
            squares.append(square)
    if not squares:
        raise DataError(source, f"{faults[0]}. Take more images of it, from several sides.")
    for fault in faults:
        logger.warning("%s: %s; it is left out.", source, fault)
    _require_square(squares, source)
    _require_one_size(squares, source)
    return _combine(views, squares, source)


def _measure(views: Sequence[View], marker_id: int, seen: Sequence[Detection]) -> _Square | str:
    """The triangulated marker, or what is wrong with it."""
    names = [views[d.view].name for d in seen]
    if len(seen) < 2:
        return f"marker {marker_id} is seen in one view only ({names[0]})"
    result = triangulate_together(
        [views[d.view] for d in seen], np.array([d.corners for d in seen])
    )
    if result is None:
        return f"the {len(seen)} views of marker {marker_id} contradict each other"
    square = _square(marker_id, seen, result)
    relative_sigma = square.side_sigma / square.side
    if not relative_sigma <= MAX_RELATIVE_SIGMA:
        return (
            f"the size of marker {marker_id} is known to {100 * relative_sigma:.0f} % only, its "
            f"{int(result.used.sum())} views ({short_list(names)}) are too much alike"
        )
    return square


def _square(marker_id: int, seen: Sequence[Detection], result: Triangulation) -> _Square:
    """Lengths of a triangulated marker, with their standard deviations."""
    ends = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)])
    shrink = np.array([1.0, 1.0, 1.0, 1.0, np.sqrt(0.5), np.sqrt(0.5)])  # a square's diagonals
    offsets = result.points[ends[:, 1]] - result.points[ends[:, 0]]
    distances = np.linalg.norm(offsets, axis=1)
    along = offsets / distances[:, None]
    covariances = result.covariances[ends].sum(axis=1)
    sigmas = np.sqrt(np.einsum("li,lij,lj->l", along, covariances, along))
    # Each corner moves the two sides that meet in it.
    pull = (np.roll(along[:4], 1, axis=0) - along[:4]) / 4
    side_variance = np.einsum("ki,kij,kj->", pull, result.covariances, pull)
    return _Square(
        marker_id=marker_id,
        views=tuple(d.view for d, used in zip(seen, result.used, strict=True) if used),
        rejected=tuple(d.view for d, used in zip(seen, result.used, strict=True) if not used),
        rms_px=result.rms_px,
        side=float(distances[:4].mean()),
        side_sigma=float(np.sqrt(side_variance)),
        lengths=distances * shrink,
        sigmas=sigmas * shrink,
    )


def _require_square(squares: Sequence[_Square], source: str) -> None:
    for square in squares:
        allowed = np.maximum(SIGMA_LIMIT * square.sigmas, FLOOR * square.side)
        if (np.abs(square.lengths - square.side) > allowed).any():
            shares = ", ".join(f"{100 * share:.1f}" for share in square.lengths / square.side)
            raise DataError(
                source,
                f"marker {square.marker_id} is not square: its sides and its diagonals / √2 are "
                f"{shares} % of the mean side. Print it flat and unstretched, or leave it out.",
            )


def _require_one_size(squares: Sequence[_Square], source: str) -> None:
    for one, two in combinations(squares, 2):
        sigma = np.hypot(one.side_sigma / one.side, two.side_sigma / two.side)
        allowed = max(SIGMA_LIMIT * float(sigma), FLOOR)
        ratio = two.side / one.side
        if abs(np.log(ratio)) > allowed:
            raise DataError(
                source,
                f"markers {one.marker_id} and {two.marker_id} differ in size by a factor of "
                f"{ratio:.4g}, their scales contradict each other. Leave out one of them.",
            )


def _combine(views: Sequence[View], squares: Sequence[_Square], source: str) -> MarkerMeasure:
    """Mean of the markers, weighted by their certainty."""
    weights = np.array([square.side_sigma**-2 for square in squares])
    sides = np.array([square.side for square in squares])
    side = float((weights * sides).sum() / weights.sum())
    num_views = np.array([len(square.views) for square in squares])
    squared = np.array([square.rms_px**2 for square in squares])
    dropped = tuple(
        f"marker {square.marker_id} in {views[k].name}"
        for square in squares
        for k in square.rejected
    )
    if dropped:
        logger.warning("%s: does not fit and is left out: %s.", source, short_list(dropped))
    return MarkerMeasure(
        side=side,
        relative_sigma=float(weights.sum() ** -0.5) / side,
        rms_residual_px=float(np.sqrt((num_views * squared).sum() / num_views.sum())),
        marker_ids=tuple(square.marker_id for square in squares),
        num_views=len({k for square in squares for k in square.views}),
        dropped=dropped,
    )
