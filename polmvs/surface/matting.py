"""Sub-pixel outline of an object before a known background, as in matting.

Along a line across the outline, the object's share of a pixel's light,

    alpha = (I - B) / (F - B),

falls from 1 to 0. I is the image, B the background, and F the object's brightness, a line fitted
within the outline. The integral of alpha over the line is the position of the outline, for any
blur.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.spatial import cKDTree

from polmvs.camera import in_frame, sample_image
from polmvs.surface.surface_view import (
    FIELD_SMOOTHING_PX,
    border_pixels,
    outward_normals,
    smoothed_distance,
)

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

# Background at image coordinates (..., 2): intensity (NaN: not known), its relative deviation, and
# whether it should be known there.
Background = Callable[[Floats], tuple[Image, Image, Mask]]

STEP = 0.25  # along the lines across the outline
LEAST_SPREAD = 0.1  # of the depths of a line's values, px^2: at one depth they tell no slope
LEAST_TOLD = 0.5  # share of the outline about a point that is told; the rest stays
MIN_BORDER = 10  # pixels of an outline; fewer tell nothing


@dataclass(frozen=True, kw_only=True)
class MattingTolerances:
    """Tolerances of the matting, in pixels of the scale of each pass.

    Attributes
    ----------
    reach_px : of the search, on both sides.
    core_px : distance from the outline beyond which there is only object, or only background.
    blend_px : deviation of the weights of pixels beyond it, by their distance from it.
    along_px : deviation of averages along the outline.
    """

    reach_px: float = 4.0
    core_px: float = 2.0
    blend_px: float = 2.5
    along_px: float = 3.0


TOL = MattingTolerances()


def find_outline(
    image: Image,
    distance: Image,
    background: Background,
    noise: float,
    *,
    polarized: Image,
    start_px: float,
) -> Image:
    """Signed distance (H, W) to the outline, px, negative inside.

    Parameters
    ----------
    image : (H, W) intensity.
    distance : (H, W) approximate signed distance, right to about ``start_px``.
    noise : least relative deviation of the background's intensity.
    polarized : (H, W, 2) ``s1`` and ``s2``, in the unit of the intensity.
    """
    scale = max(start_px, 1.0)
    stokes = np.dstack([image, polarized])
    while scale > 1:
        distance = _moved(stokes, distance, background, noise, scale)
        scale = max(scale / 2, 1.0)
    # The lines of the last pass start at the outline.
    for _ in range(2):
        distance = _moved(stokes, distance, background, noise, 1.0)
    return distance


def _moved(
    stokes: Image,
    distance: Image,
    background: Background,
    noise: float,
    scale: float,
) -> Image:
    """The distance after one pass."""
    border = border_pixels(distance < 0)
    rows, columns = np.nonzero(border)
    if len(rows) < MIN_BORDER:
        return distance
    outwards = outward_normals(distance, border)
    centers = np.stack([columns + 0.5, rows + 0.5], axis=1)
    onto = centers - outwards * distance[rows, columns][:, None]
    mean = _along_border(onto, TOL.along_px * scale)
    far = TOL.core_px + 2 * TOL.blend_px
    along = np.arange(-far, far + STEP, STEP)
    places = onto[:, None] + scale * along[:, None] * outwards[:, None]
    alpha, told = _alpha(
        stokes, places, along, sample_image(distance, places) / scale, background, noise, mean
    )
    shift = scale * (STEP * (alpha.sum(axis=1) - 0.5) - TOL.reach_px)
    shift = (mean @ (told * shift)) / np.maximum(mean @ told, LEAST_TOLD)
    # Each pixel moves with the nearest of the border.
    _, labels = cv2.distanceTransformWithLabels(
        (~border).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    of_label = np.zeros(labels.max() + 1, np.float32)
    of_label[labels[rows, columns]] = shift
    return smoothed_distance(distance - of_label[labels], FIELD_SMOOTHING_PX * scale)


def _alpha(
    stokes: Image,
    places: Array,
    along: Array,
    depth: Image,
    background: Background,
    noise: float,
    mean: sparse.csr_array,
) -> tuple[Array, Array]:
    """Share of the object ``(N, S)`` along lines across an outline, and if it is told ``(N,)``.

    Parameters
    ----------
    stokes : (H, W, 3) Stokes parameters.
    places : (N, L, 2) image coordinates of the lines.
    along, depth : (L,) and (N, L), places on the lines and distances from the outline, scaled.
    mean : (N, N) averages over neighbours.
    """
    height, width, _ = stokes.shape
    values = sample_image(stokes, places)
    in_image = in_frame(places, width, height)
    weight = np.where(in_image, np.exp(-0.5 * (along / TOL.blend_px) ** 2), 0)
    within, beyond = weight * (depth < -TOL.core_px), weight * (depth > TOL.core_px)
    near = np.abs(along) <= TOL.reach_px + 1e-9
    predicted, deviation, should_be_known = background(places[:, near])
    known = np.asarray(np.isfinite(predicted), np.bool_)
    total, most = np.zeros(known.shape), np.zeros(known.shape)
    for channel in range(stokes.shape[2]):
        level, slope, own_variance = _line(values[..., channel], depth, within, mean)
        behind, _, variance = _line(values[..., channel], depth, beyond, mean)
        # Shading continues to the outline: what the object shows there is extrapolated.
        own = level + slope * np.minimum(along[near], 0)
        if channel == 0:
            own = np.maximum(own, 0)
            variance = np.where(known, (deviation**2 + noise**2) * predicted**2, variance)
            behind = np.where(known, predicted, behind)
        contrast = own - behind
        precision = in_image[:, near] / (variance + own_variance)
        total += mean @ (precision * contrast * (values[:, near, channel] - behind))
        most += mean @ (precision * contrast**2)
    alpha = np.clip(total / np.maximum(most, 1e-9), 0, 1)
    # An outline needs a mean contrast of one deviation. Beyond it the background is visible;
    # anything else there hides the outline.
    told = np.minimum(most.mean(axis=1), 1) ** 2
    told *= (known | ~should_be_known)[:, int(near.sum()) // 2]
    told *= alpha[:, -round(1 / STEP) :].mean(axis=1) < 0.5
    return alpha, told


def _along_border(points: Floats, sigma: float) -> sparse.csr_array:
    """Gaussian weights ``(N, N)`` of the points of a border near each."""
    pairs = cKDTree(points).sparse_distance_matrix(
        cKDTree(points), 2.5 * sigma, output_type="coo_matrix"
    )
    weights = np.exp(-0.5 * (pairs.data / sigma) ** 2)
    total = np.bincount(pairs.row, weights, len(points))
    return sparse.csr_array((weights / total[pairs.row], (pairs.row, pairs.col)), pairs.shape)


def _line(
    values: Floats, depth: Floats, weight: Floats, mean: sparse.csr_array
) -> tuple[Array, Array, Array]:
    """Line over the depth through weighted values ``(N, S)``: its value at 0, its slope, variance.

    Each is (N, 1). The slope shrinks where values at few depths tell it.
    """
    total = np.maximum(mean @ weight.sum(axis=1), 1e-6)

    def averaged(quantity: Floats) -> Array:
        return np.asarray((mean @ (weight * quantity).sum(axis=1)) / total)

    level, middle = averaged(values), averaged(depth)
    spread = averaged(depth * depth) - middle**2
    slope = (averaged(values * depth) - level * middle) / (spread + LEAST_SPREAD)
    variance = averaged(values * values) - level**2 - slope**2 * spread
    line = level - slope * middle, slope, np.maximum(variance, 1e-8)
    return line[0][:, None], line[1][:, None], line[2][:, None]
