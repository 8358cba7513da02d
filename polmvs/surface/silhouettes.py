"""Silhouettes of the polarized objects: each pixel of each view is on, off or unknown.

The polarized region of a view is on the objects. Where an object is dark, frontal or shows mixed
light, it is hardly polarized, and the region ends too early. Pixels next to the region that look
more like the region than like the surroundings (a graph cut on intensity) are unknown. So are
hardly polarized parts of the region that reach the image's border. Views check one another: pixels
that only one view claims or denies are also unknown.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from polmvs.camera import sample_image
from polmvs.io.arrays import StoredArray, map_array, save_array
from polmvs.polarization.phase_map import PhaseMap, box_about
from polmvs.polarization.region import RegionTolerances, parts_at_border
from polmvs.surface.surface_view import (
    REFERENCE_FOCAL_PX,
    Silhouette,
    border_pixels,
    outward_normals,
    signed_distance_px,
)

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class SilhouetteTolerances:
    """Tolerances of the search for silhouettes; lengths are for a focal length of 445 px.

    Attributes
    ----------
    min_piece_px : least area of a piece of the region, and of a hole in it: smaller ones are marks.
        Guess.
    closing_px : width of gaps that are closed. Guess.
    mark_area_px : a piece up to this area that the object and the image's border enclose is
        unknown: it may be a mark that the border cuts. From `RegionTolerances`.
    near_px : reach of the continuation in pixels that resemble the region a little. Measured with
        the next two on an analytic vase: both factors of two within 0.07 points of F at 1 mm.
    far_px : reach in pixels that resemble it much: the inside of a mug is 60 px across.
    object_quantile : share of the region's pixels whose intensity stands for it. Guess; measured
        with the two before.
    cut_rounds : of the graph cut; a fourth changes less than 0.5 % of the pixels (mug).
    edge_reach_px : of the search for an intensity edge about an outline. The region's Stokes images
        are smoothed over 2 px, so strong polarization leaks by about as much.
    edge_prior_px : deviation of that edge from the region's border. Guess.
    edge_contrast : least contrast of the edge, as a share of the brighter side. Guess.
    edge_smoothing_px : of the shifts along the outline. Guess.
    """

    min_piece_px: int = 60
    closing_px: int = 5
    mark_area_px: float = RegionTolerances.mark_area_px
    near_px: int = 10
    far_px: int = 40
    object_quantile: float = 0.85
    cut_rounds: int = 3
    edge_reach_px: float = 4.0
    edge_prior_px: float = 2.5
    edge_contrast: float = 0.15
    edge_smoothing_px: float = 1.5


TOL = SilhouetteTolerances()


def find_silhouette(phase_map: PhaseMap, *, mask_given: bool) -> Silhouette:
    """Silhouette of a view from its region and intensity.

    Parameters
    ----------
    phase_map : of the view.
    mask_given : the region is the user's mask, which is certain.
    """
    inside = np.asarray(phase_map.region.inside, np.bool_)
    if (shift := phase_map.outline_shift) is not None:
        return Silhouette(inside, inside, shift, shift)
    if mask_given or not inside.any():
        return Silhouette(inside, inside)
    scale = phase_map.view.camera.mean_focal_px / REFERENCE_FOCAL_PX
    unbounded = phase_map.region.unbounded
    certain = _cleaned(phase_map.region.bounded, scale)
    if not certain.any():
        return Silhouette(certain, certain)
    intensity = np.asarray(phase_map.intensity, np.float32)
    possible = _continued(certain, intensity, scale)
    if unbounded is not None:
        possible = possible | unbounded
    possible = possible | _cut_by_the_border(possible, TOL.mark_area_px * scale**2)
    inner = _outline_shift(certain, intensity, scale)
    sharp = bool((possible == certain).all())
    outer = inner if sharp else _outline_shift(possible, intensity, scale)
    return Silhouette(certain, possible, inner, outer)


def store_silhouette(silhouette: Silhouette, folder: Path, name: str) -> None:
    """Write the silhouette of the view ``name`` as ``.npy`` files, into an existing folder."""
    flags = silhouette.certain * 1 | silhouette.possible * 2
    save_array(folder / f"{name}.silhouette.npy", flags.astype(np.uint8))
    shifts = {"inner": silhouette.inner_shift, "outer": silhouette.outer_shift}
    for which, shift in shifts.items():
        if shift is not None:
            save_array(folder / f"{name}.{which}.npy", np.asarray(shift))


def open_silhouette(folder: Path, name: str) -> Silhouette:
    """The stored silhouette of the view ``name``; its shifts stay on disk.

    Raises
    ------
    DataError
        A file is missing or damaged.
    """
    flags = map_array(folder / f"{name}.silhouette.npy", np.uint8)
    paths = (folder / f"{name}.{which}.npy" for which in ("inner", "outer"))
    shifts = (StoredArray(path) if path.exists() else None for path in paths)
    return Silhouette(flags & 1 > 0, flags & 2 > 0, *shifts)


def _cleaned(mask: Mask, scale: float) -> Mask:
    """The mask without specks, gaps and pinholes."""
    area = scale * scale
    pixels = _without_small(mask, TOL.min_piece_px * area, connectivity=8).astype(np.uint8)
    size = 2 * round(0.5 * (TOL.closing_px - 1) * scale) + 1
    holes = cv2.morphologyEx(pixels, cv2.MORPH_CLOSE, np.ones((size, size), np.uint8)) == 0
    return ~_without_small(holes, TOL.min_piece_px * area, connectivity=4)


def _without_small(mask: Mask, min_area: float, *, connectivity: int) -> Mask:
    num, labels, stats, _ = cv2.connectedComponentsWithStats(
        mask.astype(np.uint8), connectivity=connectivity
    )
    kept = stats[:, cv2.CC_STAT_AREA] >= min_area
    kept[0] = False
    return np.asarray(kept[labels]) if num > 1 else np.zeros(mask.shape, np.bool_)


def _cut_by_the_border(mask: Mask, max_area: float) -> Mask:
    """Small pieces beside a mask that only it and the image's border enclose."""
    return parts_at_border(~mask & ~_without_small(~mask, max_area, connectivity=4))


def _ellipse(radius: int) -> NDArray[np.uint8]:
    size = (2 * radius + 1, 2 * radius + 1)
    return np.asarray(cv2.getStructuringElement(cv2.MORPH_ELLIPSE, size), np.uint8)


def _continued(certain: Mask, intensity: Image, scale: float) -> Mask:
    """The mask with the pixels that continue it, by a graph cut on intensity (GrabCut)."""
    white = max(float(np.percentile(intensity, 95)), 1e-9)
    bright = np.sqrt(np.clip(intensity / white, 0, 1)).astype(np.float32)
    smooth = cv2.GaussianBlur(bright, (0, 0), 1.5)
    darkest = cv2.erode(bright, np.ones((5, 5), np.uint8))
    features = (255 * np.dstack([bright, smooth, darkest])).astype(np.uint8)

    pixels = certain.astype(np.uint8)
    like = np.quantile(bright[certain], TOL.object_quantile)
    near = cv2.dilate(pixels, _ellipse(round(TOL.near_px * scale))) > 0
    far = cv2.dilate(pixels, _ellipse(round(TOL.far_px * scale))) > 0
    searched = near | (far & (smooth <= like))
    labels = np.full(certain.shape, cv2.GC_BGD, np.uint8)
    labels[searched] = cv2.GC_PR_BGD
    labels[searched & (bright <= like)] = cv2.GC_PR_FGD
    labels[certain] = cv2.GC_PR_FGD
    labels[cv2.erode(pixels, np.ones((5, 5), np.uint8)) > 0] = cv2.GC_FGD
    box = box_about(searched, round(20 * scale))
    cut = np.ascontiguousarray(labels[box])
    objects = np.isin(cut, (cv2.GC_FGD, cv2.GC_PR_FGD))
    if objects.all() or not objects.any():
        return certain
    cv2.setRNGSeed(0)
    cv2.grabCut(
        np.ascontiguousarray(features[box]),
        cut,
        (0, 0, 1, 1),  # not used: the labels are the start
        np.zeros((1, 65)),
        np.zeros((1, 65)),
        TOL.cut_rounds,
        cv2.GC_INIT_WITH_MASK,
    )
    found = np.zeros(certain.shape, np.uint8)
    found[box] = np.isin(cut, (cv2.GC_FGD, cv2.GC_PR_FGD))
    opened = cv2.morphologyEx(found, cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)) > 0
    pieces = cv2.connectedComponents((opened | certain).astype(np.uint8))[1]
    held = np.unique(pieces[certain])
    found_mask = np.isin(pieces, held[held > 0])
    found_mask = ~_without_small(~found_mask, TOL.min_piece_px * scale**2, connectivity=4)
    if 2 * (found_mask & ~certain).sum() > certain.size:
        return certain  # the cut has leaked into the surroundings
    return np.asarray(found_mask)


def _outline_shift(mask: Mask, intensity: Image, scale: float) -> Image | None:
    """Distance of the intensity edge at a mask's border outside of it.

    Returns
    -------
    (H, W) px, at each pixel that of the nearest border pixel; None without a border.
    """
    border = border_pixels(mask)
    rows, cols = np.nonzero(border)
    if len(rows) < 10:
        return None
    distance = signed_distance_px(mask)
    outwards = outward_normals(distance, border)
    step = 0.25
    reach = TOL.edge_reach_px * max(scale, 1.0)
    along = np.arange(-reach - 1, reach + 1 + step, step)
    # The border runs half a pixel outside of its pixels' centres.
    centers = np.stack([cols + 0.5, rows + 0.5], axis=1)
    places = centers[:, None] + outwards[:, None] * (
        along[:, None] - distance[rows, cols][:, None, None]
    )
    profile = sample_image(intensity, places)
    contrast = step_slope(profile) * 5 / np.maximum(profile.max(axis=1, keepdims=True), 1e-6)
    found, height = nearest_steps(contrast, along, scale)
    weight = np.clip(height / TOL.edge_contrast - 1, 0, 1)
    shifts, weights = np.zeros(mask.shape, np.float32), np.zeros(mask.shape, np.float32)
    shifts[rows, cols], weights[rows, cols] = weight * found, weight
    width = TOL.edge_smoothing_px * max(scale, 1.0)
    total = np.asarray(cv2.GaussianBlur(shifts, (0, 0), width), np.float32)
    share = np.asarray(cv2.GaussianBlur(weights, (0, 0), width), np.float32)
    mean = np.where(share > 1e-4, total / np.maximum(share, 1e-4), 0).astype(np.float32)
    nearest = ndimage.distance_transform_edt(~border, return_distances=False, return_indices=True)
    return np.asarray(mean[nearest[0], nearest[1]])


def step_slope(profile: Image) -> Image:
    """Slopes (N, S) along profiles ``(N, S)``, smoothed over two samples, per sample."""
    return np.asarray(np.abs(ndimage.gaussian_filter1d(profile, 2.0, axis=1, order=1)))


def nearest_steps(contrast: Floats, along: Array, scale: float) -> tuple[Array, Array]:
    """Positions ``(N,)`` of the edges chosen on profiles across a border, and their contrasts.

    Parameters
    ----------
    contrast : (N, S), steepness of each profile.
    along : (S,) equidistant, distances from the border, in ``scale`` times the tolerances' unit.
    """
    step = float(along[1] - along[0])
    score = contrast * np.exp(-0.5 * (along / (TOL.edge_prior_px * max(scale, 1.0))) ** 2)
    score[:, np.abs(along) > TOL.edge_reach_px * max(scale, 1.0)] = 0
    best, index = score.argmax(axis=1), np.arange(len(score))
    # The border only chooses among edges; it does not shift their positions.
    for _ in range(round(1 / step)):
        beside = np.stack([contrast[index, best + side] for side in (-1, 0, 1)])
        best = np.clip(best + beside.argmax(axis=0) - 1, 1, len(along) - 2)
    vertex = _vertex_of_parabola(*(contrast[index, best + side] for side in (-1, 0, 1)))
    return along[best] + step * vertex, np.asarray(contrast[index, best], np.float64)


def _vertex_of_parabola(before: Floats, at: Floats, after: Floats) -> Array:
    """Position of the maximum of a parabola through three values, in spacings from the middle."""
    bend = before - 2 * at + after
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.where(bend < 0, np.clip(0.5 * (before - after) / bend, -0.5, 0.5), 0.0)
