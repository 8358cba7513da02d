"""Where to densify: the polarised, textureless region of a view, and the edges inside it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Image = NDArray[np.float32]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

SMOOTHING_PX = (
    2.0  # texture's false polarisation (the four samples see different points) averages out
)
LOW_TEXTURE = 0.03  # relative intensity gradient per px under which a surface shows no texture
SIMILAR_INTENSITY = 1.6  # factor within which unpolarised pixels may belong to a polarised region
MIN_AREA_PX = 200  # of a region
MIN_CORE_SHARE = 0.03  # of a region: less means that it has run into the background
GROWTH_PX = 15.0  # reach of a round of growth is about three times this
MAX_GROWTH_ROUNDS = 6
MARK_AREA_PX = 1500  # holes of up to this area are filled whatever they show (printed marks)
MIN_PHASE_JUMP = 0.12  # change of (cos 2 phase, sin 2 phase) per px that counts as a crease


@dataclass(frozen=True)
class Region:
    """Pixels of one view.

    Attributes
    ----------
    inside : (H, W) bool, the surface to densify, holes (marks, frontal spots) filled.
    reliable : (H, W) bool, pixels whose own phase counts: polarised, unsaturated, no mark.
    edges : (H, W) bool, creases and depth edges; contours stop there.
    """

    inside: Mask
    reliable: Mask
    edges: Mask


def smooth(image: Image, sigma_px: float) -> Image:
    """Gaussian smoothing with replicated borders."""
    blurred = cv2.GaussianBlur(image, (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
    return np.asarray(blurred, np.float32)


def find_region(
    s0: Image,
    s1: Image,
    s2: Image,
    valid: Mask,
    *,
    min_dolp: float,
    mask: Mask | None = None,
) -> Region:
    """Find the polarised, textureless region of a view.

    Polarised pixels are the core. It grows into dark neighbours without texture (a surface seen
    frontally has no polarisation) and its holes are filled where they show no texture or are
    as small as a printed mark.

    Parameters
    ----------
    s0, s1, s2 : (H, W) float32 Stokes images.
    valid : (H, W) bool, neither clipped nor dark.
    min_dolp : smoothed DoLP from which a pixel belongs to the core.
    mask : (H, W) bool, the user's region; it replaces the search, edges are still found.
    """
    intensity = np.maximum(smooth(s0, SMOOTHING_PX), 1e-6)
    axial = smooth(np.dstack([s1, s2]), SMOOTHING_PX)
    dolp = np.hypot(axial[..., 0], axial[..., 1]) / intensity
    texture = _relative_gradient(s0)
    core = (dolp > min_dolp) & valid
    core = _open(core, 3)
    inside = mask if mask is not None else _grow(core, intensity, texture)
    marks = _marks(s0, inside & core)
    reliable = inside & valid & ~marks & (dolp > 0.3 * min_dolp)
    edges = inside & _phase_jumps(axial, dolp, min_dolp)
    return Region(inside, reliable, edges)


def _open(mask: Mask, size: int) -> Mask:
    kernel = np.ones((size, size), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0)


def _dilate(mask: Mask, size: int) -> Mask:
    return np.asarray(cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0)


def _relative_gradient(s0: Image) -> Image:
    """Intensity gradient relative to the intensity, per px."""
    fine = smooth(s0, 1.0)
    dx = cv2.Sobel(fine, cv2.CV_32F, 1, 0, scale=1 / 8)
    dy = cv2.Sobel(fine, cv2.CV_32F, 0, 1, scale=1 / 8)
    return np.asarray(np.hypot(dx, dy) / np.maximum(smooth(s0, 3.0), 1e-6), np.float32)


def _grow(core: Mask, intensity: Image, texture: Image) -> Mask:
    """Core plus textureless neighbours of like intensity, holes filled, small regions dropped.

    The intensity that a neighbour must resemble is that of the region next to it, and follows
    shading as the region grows. Where growth would swallow much more than the core (an open,
    textureless background) the core stays as it is.
    """
    flat = texture < LOW_TEXTURE
    grown = core
    for _ in range(MAX_GROWTH_ROUNDS):
        weight = smooth(grown.astype(np.float32), GROWTH_PX)
        reference = smooth(np.where(grown, intensity, 0), GROWTH_PX) / np.maximum(weight, 1e-6)
        similar = (
            flat
            & (intensity < SIMILAR_INTENSITY * reference)
            & (intensity * SIMILAR_INTENSITY > reference)
            & (weight > 1e-3)
        )
        before = int(grown.sum())
        grown = _touching(_open(grown | similar, 5), core)
        if grown.sum() < 1.02 * before:
            break
    grown = _substantial(_fill_holes(grown, texture), core, MIN_CORE_SHARE)
    alone = _substantial(_fill_holes(core, texture) & ~grown, core, 0.0)
    return _fill_holes(grown | alone, texture)


def _touching(mask: Mask, core: Mask) -> Mask:
    """Connected parts of the mask that hold some of the core."""
    labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[1]
    held = np.zeros(int(labels.max()) + 1, bool)
    held[labels[core & mask]] = True
    held[0] = False
    return np.asarray(held[labels])


def _substantial(mask: Mask, core: Mask, min_core_share: float) -> Mask:
    """Connected parts with enough of the core, in px and as a share of the part."""
    num, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    core_area = np.bincount(labels[core & mask], minlength=num)
    area = stats[:, cv2.CC_STAT_AREA]
    keep = (core_area >= MIN_AREA_PX) & (core_area >= min_core_share * area)
    keep[0] = False
    return np.asarray(keep[labels])


def _fill_holes(mask: Mask, texture: Image) -> Mask:
    """Fill holes that are small or show no texture."""
    num, labels, stats, _ = cv2.connectedComponentsWithStats(
        (~mask).astype(np.uint8), connectivity=4
    )
    height, width = mask.shape
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    closed = (
        (left > 0)
        & (top > 0)
        & (left + stats[:, cv2.CC_STAT_WIDTH] < width)
        & (top + stats[:, cv2.CC_STAT_HEIGHT] < height)
    )
    area = np.maximum(stats[:, cv2.CC_STAT_AREA], 1)
    flat = np.bincount(labels.ravel(), (texture < LOW_TEXTURE).ravel(), minlength=num)
    fill = closed & ((area <= MARK_AREA_PX) | (flat > 0.7 * area))
    fill[0] = False
    return np.asarray(mask | fill[labels])


def _marks(s0: Image, polarised: Mask) -> Mask:
    """Pixels much brighter or darker than the polarised surface about them, with a margin."""
    weight = smooth(polarised.astype(np.float32), 8.0)
    reference = smooth(np.where(polarised, s0, 0).astype(np.float32), 8.0) / np.maximum(
        weight, 1e-6
    )
    deviation = smooth(s0, 0.8) / np.maximum(reference, 1e-6)
    return _dilate((weight > 0.02) & ((deviation > 1.5) | (deviation < 0.5)), 3)


def _phase_jumps(axial: Floats, dolp: Floats, min_dolp: float) -> Mask:
    """Where the phase changes abruptly between two polarised sides."""
    unit = axial / np.maximum(np.linalg.norm(axial, axis=-1, keepdims=True), 1e-9)
    dx = cv2.Sobel(unit, cv2.CV_32F, 1, 0, scale=1 / 8)
    dy = cv2.Sobel(unit, cv2.CV_32F, 0, 1, scale=1 / 8)
    jump = np.sqrt((dx**2 + dy**2).sum(axis=-1))
    near_polarised = _dilate(dolp > min_dolp, 5)
    return np.asarray((jump > MIN_PHASE_JUMP) & near_polarised & (dolp > 0.5 * min_dolp))
