"""Alignment of an estimated world with the true one by the camera centres."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb

import numpy as np
from numpy.typing import NDArray

from polmvs.errors import DataError
from polmvs.geometry import SimilarityTransform, align_points
from polmvs.io.ground_truth import GroundTruth
from polmvs.scene import View

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

OUTLIER_RATIO = 5.0  # a camera this many times the median residual off is misregistered
OUTLIER_FLOOR = 0.005  # ... but never for less than this share of the cameras' spread
MIN_ROBUST_CAMERAS = 5
MAX_TRIPLES = 500


@dataclass(frozen=True, kw_only=True)
class AlignmentReport:
    """How the estimated cameras were brought onto the true ones.

    Attributes
    ----------
    scale : metres per unit of the estimated world
    rms_residual_mm : of the centres of the cameras used, after the alignment, mm
    num_cameras : cameras used
    dropped : names of the cameras left out as grossly misregistered
    rotation_error_median_deg : median angle between estimated and true orientation of the
        cameras used, degrees
    """

    scale: float
    rms_residual_mm: float
    num_cameras: int
    dropped: tuple[str, ...]
    rotation_error_median_deg: float

    @property
    def num_dropped(self) -> int:
        """Number of cameras left out."""
        return len(self.dropped)


def align_to_truth(
    views: Sequence[View], truth: GroundTruth
) -> tuple[SimilarityTransform, AlignmentReport]:
    """Similarity ``truth_from_world`` that takes the estimated camera centres to the true ones.

    With five cameras or more, those whose residual exceeds five times the median (and 0.5 % of
    the cameras' spread) are left out; the search starts from the best of many triples, so that
    one camera far away does not hide itself.

    Raises
    ------
    DataError
        When fewer than three names match or the centres lie on one line.
    """
    path = truth.folder / "cameras.json"
    pairs = [(view, true) for view in views if (true := truth.find(view.name)) is not None]
    if len(pairs) < 3:
        raise DataError(
            path,
            f"knows {len(pairs)} of the {len(views)} reconstructed images by name, alignment needs "
            "3; give the ground truth of this capture.",
        )
    centers = np.array([view.center_in_world for view, _ in pairs])
    true_centers = np.array([true.center_in_world for _, true in pairs])
    try:
        truth_from_world, used = align_cameras(centers, true_centers)
    except ValueError as error:
        raise DataError(path, f"cameras cannot be aligned: {error}") from error
    residuals = align_residuals(truth_from_world, centers[used], true_centers[used])
    rotation_errors = [
        _rotation_error_deg(view, true, truth_from_world)
        for (view, true), is_used in zip(pairs, used, strict=True)
        if is_used
    ]
    report = AlignmentReport(
        scale=truth_from_world.scale,
        rms_residual_mm=1e3 * float(np.sqrt((residuals**2).mean())),
        num_cameras=int(used.sum()),
        dropped=tuple(
            view.name for (view, _), is_used in zip(pairs, used, strict=True) if not is_used
        ),
        rotation_error_median_deg=float(np.median(rotation_errors)),
    )
    return truth_from_world, report


def align_cameras(centers: Array, true_centers: Array) -> tuple[SimilarityTransform, Mask]:
    """Least-squares similarity from the camera centres that one similarity explains.

    Parameters
    ----------
    centers, true_centers : (N, 3) float64, the same cameras in the source and the target frame.

    Returns
    -------
    SimilarityTransform
        ``target_from_source``.
    (N,) bool
        The cameras used; all of them when there are fewer than five.

    Raises
    ------
    ValueError
        For fewer than three cameras, or centres on one line.
    """
    used = _consistent_cameras(centers, true_centers)
    return align_points(centers[used], true_centers[used]), used


def align_residuals(transform: SimilarityTransform, source: Array, target: Array) -> Array:
    """Distances ``(N,)`` of the transformed source points from the target, target units."""
    return np.asarray(np.linalg.norm(transform * source - target, axis=1))


def _consistent_cameras(centers: Array, true_centers: Array) -> Mask:
    """Which cameras one similarity explains; all of them when there are fewer than five."""
    used = np.ones(len(centers), np.bool_)
    if len(centers) < MIN_ROBUST_CAMERAS:
        return used
    spread = float(np.sqrt(((true_centers - true_centers.mean(axis=0)) ** 2).sum(1).mean()))
    used = _best_majority(centers, true_centers)
    for _ in range(10):
        residuals = align_residuals(
            align_points(centers[used], true_centers[used]), centers, true_centers
        )
        limit = max(OUTLIER_RATIO * float(np.median(residuals)), OUTLIER_FLOOR * spread)
        if np.array_equal(residuals <= limit, used):
            break
        used = residuals <= limit
    return used


def _best_majority(centers: Array, true_centers: Array) -> Mask:
    """The majority of cameras that the alignment of some three of them explains best."""
    num = len(centers)
    majority = max(num // 2 + 1, 4)  # three alone would always agree well enough
    best, best_residuals = np.inf, np.zeros(num)
    for triple in _triples(num):
        try:
            transform = align_points(centers[triple], true_centers[triple])
        except ValueError:
            continue
        residuals = align_residuals(transform, centers, true_centers)
        score = float(np.partition(residuals, majority - 1)[majority - 1])
        if score < best:
            best, best_residuals = score, residuals
    return best_residuals <= best


def _triples(num: int) -> list[list[int]]:
    """All triples of indices, or a fixed random choice of them."""
    if comb(num, 3) <= MAX_TRIPLES:
        return [list(triple) for triple in combinations(range(num), 3)]
    rng = np.random.default_rng(0)
    return [rng.choice(num, 3, replace=False).tolist() for _ in range(MAX_TRIPLES)]


def _rotation_error_deg(view: View, true: View, truth_from_world: SimilarityTransform) -> float:
    """Angle between the estimated orientation and the true one, degrees."""
    expected = true.cam_from_world.rotation @ truth_from_world.rotation
    chord = float(np.linalg.norm(view.cam_from_world.rotation - expected))
    return float(np.degrees(2.0 * np.arcsin(min(chord / np.sqrt(8.0), 1.0))))
