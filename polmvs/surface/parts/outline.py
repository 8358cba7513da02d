"""Outlines: the smooth pieces of a view's region, and how far a point lies from one's outline.

A piece is bounded by the region's own boundary and by creases, where the phase jumps. Where a
surface ends, its outline is the picture of one curve in space, whichever view it is seen from.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter, uniform_filter1d

from polmvs.camera import sample_image, xy_from_opencv, xy_to_opencv
from polmvs.polarization.region import LOW_TEXTURE, Region, smooth

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

FAR_PX = 32.0  # signed distances are not known beyond
LEAK_PX = 2.5  # half the width of a gap in a crease that is closed
FINE = 2  # the outline is drawn at so many times the resolution
SPECK_PX = 12  # smaller cores are none
MIN_PIECE_PX = 600  # fewer leave too little outline to tell a range from a crooked boundary
BORDER_PX = 3.0  # an outline this near to the image's border is where the view ends
OUTLINE_STEP = 3  # boundary pixels per point of an outline
PROFILE_SMOOTHING_PX = 0.7
SNAP_PX = 3.0  # deviation of the region's boundary from the step that it stands for
PEAK_PX = 1.25  # about a step's largest change, that its place is the mean of
SNAP_HALF_WINDOW = 7  # boundary pixels to each side whose steps agree


@dataclass(frozen=True)
class Piece:
    """A smooth piece of one view's region.

    Attributes
    ----------
    num_px : its area.
    corner : (2,), image coordinates of the corner of ``field``.
    field : (h, w) float32, px, signed distance from the piece's boundary (negative inside) less
        ``FAR_PX``, so that 0 is what a sampler gives outside of it. Holes are filled.
    outline : (M, 2) float64, image coordinates of points of the outline in order, those where
        the image ends left out.
    cut_share : share of the outline that the image's border cuts off.
    """

    num_px: int
    corner: Array
    field: Image
    outline: Array
    cut_share: float

    def signed_distance(self, xy: Floats) -> NDArray[np.float32]:
        """Distance (...) of image coordinates (..., 2) from the boundary, px, negative inside.

        ``FAR_PX`` also stands for anything farther outside.
        """
        return np.float32(FAR_PX) + sample_image(self.field, xy - self.corner)


def find_pieces(region: Region, intensity: Image, *, min_px: int = MIN_PIECE_PX) -> list[Piece]:
    """Split a region at its creases and find the outlines of the pieces.

    Parameters
    ----------
    region : of one view.
    intensity : (H, W), s0; the region's boundary is moved to the step in it.
    min_px : smallest piece.

    Returns
    -------
    The pieces, the largest first.
    """
    labels: NDArray[np.int32] = _split(region)
    counts = np.bincount(labels.ravel())
    counts[0] = 0
    large = [int(label) for label in np.argsort(-counts, kind="stable") if counts[label] >= min_px]
    smoothed = smooth(intensity, PROFILE_SMOOTHING_PX)
    others = np.isin(labels, large)
    masks = [np.asarray(labels == label) for label in large]
    return [_describe(mask, others & ~mask, smoothed) for mask in masks]


def _split(region: Region) -> NDArray[np.int32]:
    """Label what lies between creases; these themselves go to the nearest piece.

    Creases have gaps where the phases of both sides happen to agree: a piece's core keeps
    ``LEAK_PX`` off them, so that it does not run through.
    """
    open_pixels = (region.inside & ~region.edges).astype(np.uint8)
    depth = cv2.distanceTransform(open_pixels, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    core = (depth > LEAK_PX).astype(np.uint8)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(core, connectivity=4)
    keep = stats[:, cv2.CC_STAT_AREA] >= SPECK_PX
    keep[0] = False
    kept = np.where(keep[labels], labels, 0)
    if not keep.any():
        return np.zeros(labels.shape, np.int32)
    _, nearest = cv2.distanceTransformWithLabels(
        (kept == 0).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    owner = np.zeros(int(nearest.max()) + 1, np.int32)
    owner[nearest[kept > 0]] = kept[kept > 0]
    return np.where(region.inside, owner[nearest], 0).astype(np.int32)


def _describe(mask: Mask, others: Mask, smoothed: Image) -> Piece:
    """Outline and signed distances of a piece; holes are filled but for other pieces in them."""
    rough = _longest_contour(mask)
    snapped = _snap(smoothed, mask, rough)
    height, width = mask.shape
    at_end = (rough < BORDER_PX) | (rough > np.array([width, height]) - BORDER_PX)
    cut: Mask = np.asarray(at_end.any(axis=-1))
    # Where the image ends the piece goes on.
    beyond = BORDER_PX * (np.sign(rough - 0.5 * np.array([width, height])) * at_end)
    snapped = np.where(cut[:, None], rough + beyond, snapped)
    filled = np.zeros((FINE * height, FINE * width), np.uint8)
    corners = np.rint(16 * xy_to_opencv(FINE * snapped)).astype(np.int32)
    cv2.fillPoly(filled, [corners[:, None]], [1], shift=4)
    enclosed = cv2.erode(filled, np.ones((3, 3), np.uint8)) > 0
    other = np.repeat(np.repeat(others, FINE, axis=0), FINE, axis=1)
    distance, corner = _signed_distances(np.where(enclosed & other, 0, filled).astype(np.uint8))
    outline = _on_zero_level(distance, snapped[::OUTLINE_STEP] - corner) + corner
    field = np.minimum(distance, FAR_PX) - np.float32(FAR_PX)
    kept = outline[~cut[::OUTLINE_STEP]]
    return Piece(int(mask.sum()), corner, field, kept, float(cut.mean()))


def _longest_contour(mask: Mask) -> Array:
    """Image coordinates (M, 2) of the boundary pixels of a mask's largest outline, in order."""
    contours, _ = cv2.findContours(mask.astype(np.uint8), cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    return np.asarray(xy_from_opencv(max(contours, key=len)[:, 0].astype(np.float64)))


def _snap(smoothed: Image, mask: Mask, contour: Array) -> Array:
    """Move a boundary to the largest step of the intensity near it, smoothly along it.

    Where there is none, as at some creases, it stays.
    """
    share = smooth(mask.astype(np.float32), SNAP_PX)
    slopes = [
        cv2.Sobel(share, cv2.CV_32F, dx, 1 - dx, borderType=cv2.BORDER_REPLICATE) for dx in (1, 0)
    ]
    slope = np.stack(slopes, axis=-1).astype(np.float32)
    outward = -sample_image(slope, contour, nearest=True).astype(np.float64)
    outward /= np.maximum(np.linalg.norm(outward, axis=-1, keepdims=True), 1e-9)
    offsets = np.arange(-2 * SNAP_PX, 2 * SNAP_PX + 0.25, 0.5)
    profile = sample_image(smoothed, contour[:, None] + offsets[:, None] * outward[:, None])
    middles = 0.5 * (offsets[1:] + offsets[:-1])
    step = np.abs(np.diff(profile, axis=1)) * np.exp(-0.5 * (middles / SNAP_PX) ** 2)
    texture = 0.5 * LOW_TEXTURE * profile.mean(axis=1)  # change from sample to sample
    peak = middles[step.argmax(axis=1)]
    about = np.where(np.abs(middles - peak[:, None]) <= PEAK_PX, step, 0)
    place = (about * middles).sum(axis=1) / np.maximum(about.sum(axis=1), 1e-12)
    # The contour runs through the last pixels inside; the region ends half a pixel farther.
    shift = np.where(step.max(axis=1) > texture, place, 0.5)
    shift = median_filter(shift, size=2 * SNAP_HALF_WINDOW + 1, mode="wrap")
    shift = uniform_filter1d(shift, SNAP_HALF_WINDOW, mode="wrap")
    # fillPoly draws the pixels of its boundary as well, half of a fine one to the outside.
    return np.asarray(contour + (shift[:, None] - 0.5 / FINE) * outward)


def _signed_distances(fine: NDArray[np.uint8]) -> tuple[Image, Array]:
    """Signed distance from a fine mask's boundary in a box about it, px, and the box's corner.

    The image's border is no boundary: the mask goes on beyond it as it is there.
    """
    margin = int(FAR_PX)
    left, top, width, height = cv2.boundingRect(fine)
    right, bottom = -(-(left + width) // FINE), -(-(top + height) // FINE)
    left, top = left // FINE, top // FINE
    side = FINE * margin
    padded = cv2.copyMakeBorder(fine, side, side, side, side, cv2.BORDER_REPLICATE)
    rows = slice(FINE * top, FINE * (bottom + 2 * margin))
    box = padded[rows, FINE * left : FINE * (right + 2 * margin)]
    outside = cv2.distanceTransform(1 - box, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    inside = cv2.distanceTransform(box, cv2.DIST_L2, cv2.DIST_MASK_PRECISE)
    # Distances count to the centres of pixels of the other kind; the boundary is half way.
    signed = np.where(box > 0, 0.5 - inside, outside - 0.5).astype(np.float32) / FINE
    size = (right - left + 2 * margin, bottom - top + 2 * margin)
    coarse = cv2.resize(signed, size, interpolation=cv2.INTER_AREA)
    return smooth(np.asarray(coarse, np.float32), 1.0), np.array(
        [left - margin, top - margin], np.float64
    )


def _on_zero_level(distance: Image, xy: Array) -> Array:
    """Move points to where the signed distance vanishes, along its gradient."""
    dx = cv2.Sobel(distance, cv2.CV_32F, 1, 0, scale=1 / 8)
    dy = cv2.Sobel(distance, cv2.CV_32F, 0, 1, scale=1 / 8)
    stacked = np.dstack([distance, dx, dy])
    for _ in range(2):
        sampled = sample_image(stacked, xy).astype(np.float64)
        norm2 = np.maximum((sampled[:, 1:] ** 2).sum(axis=-1, keepdims=True), 0.1)
        xy = xy - sampled[:, :1] * sampled[:, 1:] / norm2
    return xy
