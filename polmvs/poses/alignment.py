"""Alignment of an estimated world to a known one by the camera centres."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from math import comb
from os import PathLike

import numpy as np

from polmvs.arrays import Array, Mask
from polmvs.errors import DataError
from polmvs.fitting import like_most
from polmvs.geometry import SimilarityTransform, align_points, rotation_angle
from polmvs.scene import View, match_names

MIN_CAMERAS = 3  # that determine a similarity
# Random minimal samples in the search for the majority. A guess, bounds the time; if half of the
# data are wrong, one triple in eight is right, and one pair in four.
MAX_STARTS = 500


@dataclass(frozen=True, kw_only=True)
class AlignmentTolerances:
    """Tolerances of misregistered cameras; see :func:`polmvs.fitting.like_most`.

    Attributes
    ----------
    outlier_floor : residual that is always allowed, as a share of the cameras' spread; a guess:
        centres are usually exact to 0.1 %.
    max_relative_rms : residual over the cameras' spread above which they are of different captures;
        a guess: unrelated centres give about 1.
    max_turn_deg : likewise, the median angle between the orientations. Three centres always fit
        well; the orientations of unrelated cameras about one object differ by 30 degrees and more.
        Guess.
    """

    outlier_floor: float = 0.005
    max_relative_rms: float = 0.2
    max_turn_deg: float = 15.0


TOL = AlignmentTolerances()


@dataclass(frozen=True, kw_only=True)
class Alignment:
    """Alignment of the estimated cameras to the true ones.

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


def align_views(
    views: Sequence[View],
    true_views: Mapping[str, View],
    *,
    source: str | PathLike[str] = "known poses",
) -> tuple[SimilarityTransform, Alignment]:
    """Similarity ``truth_from_world`` that takes the estimated camera centres to the true ones.

    With five cameras or more, those whose residual exceeds five times the median (and 0.5 % of
    the cameras' spread) are left out. The search starts from the best of many triples, so that one
    distant camera does not dominate the fit.

    Parameters
    ----------
    views : of the estimated world.
    true_views : by image name, metres; names match exactly, else by stem.
    source : origin of the true ones, for messages.

    Raises
    ------
    DataError
        When fewer than three names match, the centres lie on one line, or the cameras are not
        those of one capture.
    """
    matched = match_names([view.name for view in views], true_views)
    pairs = [(view, true_views[matched[view.name]]) for view in views if view.name in matched]
    if len(pairs) < MIN_CAMERAS:
        raise DataError(
            source,
            f"knows {len(pairs)} of the {len(views)} reconstructed images by name, alignment needs "
            f"{MIN_CAMERAS}; give the ground truth of this capture.",
        )
    centers = np.array([view.center_in_world for view, _ in pairs])
    true_centers = np.array([true.center_in_world for _, true in pairs])
    try:
        truth_from_world, used = align_cameras(centers, true_centers)
    except ValueError as error:
        raise DataError(source, f"cameras cannot be aligned: {error}") from error
    residuals = align_residuals(truth_from_world, centers[used], true_centers[used])
    turns = [
        rotation_angle(
            view.cam_from_world.rotation, true.cam_from_world.rotation @ truth_from_world.rotation
        )
        for (view, true), is_used in zip(pairs, used, strict=True)
        if is_used
    ]
    spread = spread_of(true_centers)
    rms, turn_deg = float(np.sqrt((residuals**2).mean())), float(np.degrees(np.median(turns)))
    if rms > TOL.max_relative_rms * spread or turn_deg > TOL.max_turn_deg:
        raise DataError(
            source,
            f"its cameras cannot be those of the {len(pairs)} reconstructed images: aligned, they "
            f"stay {1e3 * rms:.3g} mm (RMS, of a spread of {1e3 * spread:.3g} mm) and "
            f"{turn_deg:.3g} deg apart. Give the ground truth of this capture, or better poses.",
        )
    names = [view.name for view, _ in pairs]
    return truth_from_world, Alignment(
        scale=truth_from_world.scale,
        rms_residual_mm=1e3 * rms,
        num_cameras=int(used.sum()),
        dropped=tuple(name for name, is_used in zip(names, used, strict=True) if not is_used),
        rotation_error_median_deg=turn_deg,
    )


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


def spread_of(points: Array) -> float:
    """Root mean square distance of points ``(N, 3)`` from their mean."""
    return float(np.sqrt(((points - points.mean(axis=0)) ** 2).sum(axis=1).mean()))


def _consistent_cameras(centers: Array, true_centers: Array) -> Mask:
    """Cameras that one similarity explains; all of them if there are few."""
    majority = max(len(centers) // 2 + 1, MIN_CAMERAS + 1)  # any three agree well enough
    if len(centers) <= majority:
        return np.ones(len(centers), np.bool_)
    spread = spread_of(true_centers)
    used = _best_majority(centers, true_centers, majority)
    for _ in range(len(centers)):
        transform = align_points(centers[used], true_centers[used])
        residuals = align_residuals(transform, centers, true_centers)
        again = like_most(residuals, floor=TOL.outlier_floor * spread)
        if np.array_equal(again, used):
            break
        used = again
    return used


def _best_majority(centers: Array, true_centers: Array, majority: int) -> Mask:
    """The majority of cameras that the alignment of some three of them explains best."""
    num = len(centers)
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
    if comb(num, MIN_CAMERAS) <= MAX_STARTS:
        return [list(triple) for triple in combinations(range(num), MIN_CAMERAS)]
    rng = np.random.default_rng(0)
    return [rng.choice(num, MIN_CAMERAS, replace=False).tolist() for _ in range(MAX_STARTS)]
