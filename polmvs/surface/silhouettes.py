"""Silhouettes of the polarised objects with doubt: on, off or unknown, for each pixel of each view.

The polarised region of a view is on the objects. Where they are dark, frontal or show mixed light
they are hardly polarised, and the region ends too early: pixels that continue it and look like it
rather than like the surroundings (a cut of the graph of pixels by intensity) are unknown. Views
check one another: what a view alone claims, or alone denies, is unknown as well.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.polarization.phase_map import PhaseMap
from polmvs.surface.surface_view import Silhouette

Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class SilhouetteTolerances:
    """Numbers of the search for silhouettes; lengths are for a focal length of 445 px.

    Attributes
    ----------
    min_speck_px : least area of a piece of the region. Guess.
    min_hole_px : least area of a hole in it, smaller ones are marks. Guess.
    closing_px : width of gaps that are closed. Guess.
    near_px : reach of the continuation in pixels that resemble the region a little. Guess.
    far_px : reach in pixels that resemble it much. Guess; the inside of a mug is 60 px across.
    object_quantile : share of the region's pixels whose intensity stands for it. Guess.
    cut_rounds : of the graph cut; a fourth changes under 0.5 % of the pixels (mug).
    max_unknown_share : of the image; beyond it the cut has run into the surroundings. Guess.
    """

    min_speck_px: int = 30
    min_hole_px: int = 60
    closing_px: int = 5
    near_px: int = 10
    far_px: int = 40
    object_quantile: float = 0.85
    cut_rounds: int = 3
    max_unknown_share: float = 0.5


REFERENCE_FOCAL_PX = 445.0


def find_silhouettes(
    maps: Sequence[PhaseMap],
    *,
    masks_given: bool,
    tolerances: SilhouetteTolerances | None = None,
) -> list[Silhouette]:
    """Silhouette of each view from its region and intensity.

    Parameters
    ----------
    maps : phase maps of the views.
    masks_given : the regions are the user's masks; they are certain.
    """
    tol = tolerances or SilhouetteTolerances()
    return [_silhouette(phase_map, masks_given, tol) for phase_map in maps]


def _silhouette(phase_map: PhaseMap, mask_given: bool, tol: SilhouetteTolerances) -> Silhouette:
    inside = np.asarray(phase_map.region.inside, np.bool_)
    if mask_given or not inside.any():
        return Silhouette(inside, inside)
    scale = phase_map.view.camera.mean_focal_px / REFERENCE_FOCAL_PX
    certain = _cleaned(inside, scale, tol)
    if not certain.any():
        return Silhouette(certain, certain)
    possible = _continued(certain, np.asarray(phase_map.intensity, np.float32), scale, tol)
    return Silhouette(certain, possible)


def _cleaned(mask: Mask, scale: float, tol: SilhouetteTolerances) -> Mask:
    """The mask without specks, gaps and pinholes."""
    area = scale * scale
    pixels = _without_small(mask, tol.min_speck_px * area, connectivity=8).astype(np.uint8)
    size = 2 * round(0.5 * (tol.closing_px - 1) * scale) + 1
    pixels = cv2.morphologyEx(pixels, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8))
    holes = pixels == 0
    return ~_without_small(holes, tol.min_hole_px * area, connectivity=4)


def _without_small(mask: Mask, min_area: float, *, connectivity: int) -> Mask:
    num, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=connectivity
    )
    kept = stats[:, cv2.CC_STAT_AREA] >= min_area
    kept[0] = False
    return np.asarray(kept[labels]) if num > 1 else np.zeros(mask.shape, np.bool_)


def _ellipse(radius: int) -> NDArray[np.uint8]:
    size = (2 * radius + 1, 2 * radius + 1)
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size), np.uint8)


def _continued(certain: Mask, intensity: Image, scale: float, tol: SilhouetteTolerances) -> Mask:
    """The mask and the pixels that continue it, by a graph cut on intensity (GrabCut)."""
    white = max(float(np.percentile(intensity, 95)), 1e-9)
    bright = np.sqrt(np.clip(intensity / white, 0, 1)).astype(np.float32)
    smooth = cv2.GaussianBlur(bright, (0, 0), 1.5)
    darkest = cv2.erode(bright, np.ones((5, 5), np.uint8))
    features = (255 * np.dstack([bright, smooth, darkest])).astype(np.uint8)

    pixels = certain.astype(np.uint8)
    like = np.quantile(bright[certain], tol.object_quantile)
    near = cv2.dilate(pixels, _ellipse(round(tol.near_px * scale))) > 0
    far = cv2.dilate(pixels, _ellipse(round(tol.far_px * scale))) > 0
    searched = near | (far & (smooth < like))
    labels = np.full(certain.shape, cv2.GC_BGD, np.uint8)
    labels[searched] = cv2.GC_PR_BGD
    labels[searched & (bright < like)] = cv2.GC_PR_FGD
    labels[certain] = cv2.GC_PR_FGD
    labels[cv2.erode(pixels, np.ones((5, 5), np.uint8)) > 0] = cv2.GC_FGD
    rows, cols = np.flatnonzero(searched.any(axis=1)), np.flatnonzero(searched.any(axis=0))
    margin = round(20 * scale)
    box = (
        slice(max(rows[0] - margin, 0), rows[-1] + margin + 1),
        slice(max(cols[0] - margin, 0), cols[-1] + margin + 1),
    )
    cut = np.ascontiguousarray(labels[box])
    objects = np.isin(cut, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if objects.all() or not objects.any():
        return certain
    cv2.setRNGSeed(0)
    cv2.grabCut(
        np.ascontiguousarray(features[box]),
        cut,
        None,
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        tol.cut_rounds,
        cv2.GC_INIT_WITH_MASK,
    )
    found = np.zeros(certain.shape, np.uint8)
    found[box] = np.isin(cut, (cv2.GC_FGD, cv2.GC_PR_FGD))
    found = cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) | pixels
    pieces = cv2.connectedComponents(found)[1]
    held = np.unique(pieces[certain])
    found_mask = np.isin(pieces, held[held > 0])
    found_mask = ~_without_small(~found_mask, tol.min_hole_px * scale**2, connectivity=4)
    if (found_mask & ~certain).sum() > tol.max_unknown_share * certain.size:
        return certain
    return np.asarray(found_mask)

