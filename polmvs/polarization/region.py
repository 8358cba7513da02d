"""Region to densify in a view: polarized and textureless, with the edges inside it."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats, Image, Mask


@dataclass(frozen=True, kw_only=True)
class RegionTolerances:
    """Tolerances of the polarized region of a view.

    Lengths of objects in the scene are for images of ``reference_area_px`` pixels; :meth:`at`
    scales them.

    Attributes
    ----------
    smoothing_px : width over which the false polarization of texture (the four samples see
        different points) averages out. Derived: twice a cell.
    low_texture : relative intensity gradient per px below which a surface shows no texture.
        Guess.
    similar_intensity : factor within which unpolarized pixels may belong to a polarized
        region. Guess.
    min_area_px : least area of a region, pixels at any resolution. Guess.
    min_core_share : least share of the core in a region: with less it has grown into the
        background. Guess.
    growth_px : a round of growth reaches about three times this. Guess.
    max_growth_rounds : Guess.
    mark_area_px : holes up to this area are filled whatever they show (printed marks).
        Guess.
    gap_px : a gap up to this width does not join a mark with the background. Derived: twice the
        smoothing, which widens both.
    mark_reach_px : deviation of the window that gives the mean intensity of the surface about a
        mark, with which the mark is compared. Guess.
    min_phase_jump : change of (cos 2 phase, sin 2 phase) per px that counts as a crease; the
        smoothing makes it a matter of pixels. Guess.
    reference_area_px : area of the images for which these were chosen.
    """

    smoothing_px: float = 2.0
    low_texture: float = 0.03
    similar_intensity: float = 1.6
    min_area_px: int = 200
    min_core_share: float = 0.03
    growth_px: float = 15.0
    max_growth_rounds: int = 6
    mark_area_px: float = 1500.0
    gap_px: int = 4
    mark_reach_px: float = 8.0
    min_phase_jump: float = 0.12
    reference_area_px: float = 612.0 * 512.0

    def at(self, shape: tuple[int, ...]) -> RegionTolerances:
        """The same for a larger image, ``shape`` (H, W), of the same scene.

        For a smaller image they stay: fewer pixels do not separate a surface from its surroundings.
        """
        scale = max(np.sqrt(shape[0] * shape[1] / self.reference_area_px), 1.0)
        return replace(
            self,
            growth_px=float(scale * self.growth_px),
            mark_area_px=float(scale**2 * self.mark_area_px),
            mark_reach_px=float(scale * self.mark_reach_px),
        )


@dataclass(frozen=True)
class Region:
    """Pixels of one view.

    Attributes
    ----------
    inside : (H, W) bool, the surface to densify, holes (marks, frontal spots) filled.
    reliable : (H, W) bool, pixels for averages over windows and votes on the light: polarized,
        unsaturated, and not like a mark. Phase maps use all pixels.
    edges : (H, W) bool, creases and depth edges; contours stop there.
    unbounded : (H, W) bool, hardly polarized pixels inside that reach the image's border: a surface
        seen frontally, or a textureless background as bright as it. None: there are none.
    """

    inside: Mask
    reliable: Mask
    edges: Mask
    unbounded: Mask | None = None

    @property
    def bounded(self) -> Mask:
        """(H, W) bool, pixels inside that are not unbounded."""
        return self.inside if self.unbounded is None else self.inside & ~self.unbounded


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
    tolerances: RegionTolerances = RegionTolerances(),
) -> Region:
    """Find the polarized, textureless region of a view.

    The polarized pixels are the core. The core grows into dark neighbours without texture (a
    surface seen frontally has no polarization). Its holes are filled if they show no texture or are
    as small as a printed mark. Where growth meets the image's border, nothing shows whether it has
    left the surface.

    Parameters
    ----------
    s0, s1, s2 : (H, W) float32 Stokes images.
    valid : (H, W) bool, neither clipped nor dark.
    min_dolp : smoothed DoLP from which a pixel belongs to the core.
    mask : (H, W) bool, the user's region; it replaces the search. Edges are still found.
    tolerances : of this step.
    """
    tolerances = tolerances.at(s0.shape)
    intensity = np.maximum(smooth(s0, tolerances.smoothing_px), 1e-6)
    axial = smooth(np.dstack([s1, s2]), tolerances.smoothing_px)
    dolp = np.hypot(axial[..., 0], axial[..., 1]) / intensity
    texture = _relative_gradient(s0)
    core = (dolp > min_dolp) & valid
    core = _open(core, 3)
    inside = mask if mask is not None else _grow(core, intensity, texture, tolerances)
    marks = _marks(s0, inside & core, tolerances.mark_reach_px)
    reliable = inside & valid & ~marks & (dolp > 0.3 * min_dolp)
    edges = inside & _phase_jumps(axial, dolp, min_dolp, tolerances)
    unbounded = parts_at_border(_open(inside & ~core, 5)) if mask is None else None
    return Region(inside, reliable, edges, unbounded)


def _open(mask: Mask, size: int) -> Mask:
    kernel = np.ones((size, size), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0)


def grow_mask(mask: Mask, margin_px: int) -> Mask:
    """The mask, grown by a margin in rows, columns and diagonals, px."""
    kernel = np.ones((2 * margin_px + 1, 2 * margin_px + 1), np.uint8)
    return np.asarray(cv2.dilate(mask.astype(np.uint8), kernel) > 0)


def _relative_gradient(s0: Image) -> Image:
    """Intensity gradient relative to the intensity, per px."""
    fine = smooth(s0, 1.0)
    dx = cv2.Sobel(fine, cv2.CV_32F, 1, 0, scale=1 / 8)
    dy = cv2.Sobel(fine, cv2.CV_32F, 0, 1, scale=1 / 8)
    return np.asarray(np.hypot(dx, dy) / np.maximum(smooth(s0, 3.0), 1e-6), np.float32)


def _grow(core: Mask, intensity: Image, texture: Image, tolerances: RegionTolerances) -> Mask:
    """Core plus textureless neighbours of like intensity, holes filled, small regions dropped.

    The intensity that a neighbour must resemble is that of the region next to it, and follows
    shading as the region grows. Where growth would swallow much more than the core (an open,
    textureless background) the core stays as it is.
    """
    flat = texture < tolerances.low_texture
    grown = core
    for _ in range(tolerances.max_growth_rounds):
        reference, weight = _mean_about(intensity, grown, tolerances.growth_px)
        similar = (
            flat
            & (intensity < tolerances.similar_intensity * reference)
            & (intensity * tolerances.similar_intensity > reference)
            & (weight > 1e-3)
        )
        before = int(grown.sum())
        grown = _touching(_open(grown | similar, 5), core)
        if grown.sum() < 1.02 * before:
            break
    grown = _fill_holes(grown, texture, tolerances)
    grown = _substantial(grown, core, tolerances.min_area_px, tolerances.min_core_share)
    alone = _fill_holes(core, texture, tolerances) & ~grown
    alone = _substantial(alone, core, tolerances.min_area_px, 0.0)
    return _fill_holes(grown | alone, texture, tolerances)


def _mean_about(image: Image, mask: Mask, reach_px: float) -> tuple[Image, Image]:
    """Mean of an image over the mask's pixels near each pixel, and the mask's share there."""
    share = smooth(mask.astype(np.float32), reach_px)
    total = smooth(np.where(mask, image, 0).astype(np.float32), reach_px)
    return np.asarray(total / np.maximum(share, 1e-6), np.float32), share


def _touching(mask: Mask, core: Mask) -> Mask:
    """Connected parts of the mask that hold some of the core."""
    labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[1]
    held = np.zeros(int(labels.max()) + 1, bool)
    held[labels[core & mask]] = True
    held[0] = False
    return np.asarray(held[labels])


def parts_at_border(mask: Mask) -> Mask:
    """Connected parts (H, W) of the mask that touch the image's border."""
    labels = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)[1]
    at_border = np.concatenate([labels[0], labels[-1], labels[:, 0], labels[:, -1]])
    return np.isin(labels, at_border[at_border > 0])


def _substantial(mask: Mask, core: Mask, min_area_px: int, min_core_share: float) -> Mask:
    """Connected parts with enough of the core, in px and as a share of the part."""
    num, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8), connectivity=4)
    core_area = np.bincount(labels[core & mask], minlength=num)
    area = stats[:, cv2.CC_STAT_AREA]
    keep = (core_area >= min_area_px) & (core_area >= min_core_share * area)
    keep[0] = False
    return np.asarray(keep[labels])


def _fill_holes(mask: Mask, texture: Image, tolerances: RegionTolerances) -> Mask:
    """Fill holes that are small or show no texture, and small ones that a narrow gap opens."""
    labels, area = _holes(mask)
    flat = np.bincount(labels.ravel(), (texture < tolerances.low_texture).ravel(), len(area))
    filled = mask | ((area <= tolerances.mark_area_px) | (flat > 0.7 * area))[labels]
    size = np.ones((tolerances.gap_px + 1, tolerances.gap_px + 1), np.uint8)
    without_gaps = cv2.morphologyEx(filled.astype(np.uint8), cv2.MORPH_CLOSE, size) > 0
    labels, area = _holes(without_gaps)
    opened = ~without_gaps & (area <= tolerances.mark_area_px)[labels]
    # Closing gaps has taken the margin of such a hole as well.
    margin = without_gaps & grow_mask(opened, tolerances.gap_px // 2)
    return np.asarray(filled | opened | margin)


def _holes(mask: Mask) -> tuple[NDArray[np.int32], Array]:
    """Labels (H, W) of the parts beside a mask, and their areas; inf where it encloses none."""
    _, labels, stats, _ = cv2.connectedComponentsWithStats((~mask).astype(np.uint8), connectivity=4)
    height, width = mask.shape
    left, top = stats[:, cv2.CC_STAT_LEFT], stats[:, cv2.CC_STAT_TOP]
    closed = (
        (left > 0)
        & (top > 0)
        & (left + stats[:, cv2.CC_STAT_WIDTH] < width)
        & (top + stats[:, cv2.CC_STAT_HEIGHT] < height)
    )
    closed[0] = False
    area = np.where(closed, np.maximum(stats[:, cv2.CC_STAT_AREA], 1.0), np.inf)
    return np.asarray(labels, np.int32), area


def _marks(s0: Image, polarized: Mask, reach_px: float) -> Mask:
    """Pixels much brighter or darker than the polarized surface about them, with a margin."""
    reference, weight = _mean_about(s0, polarized, reach_px)
    deviation = smooth(s0, 0.8) / np.maximum(reference, 1e-6)
    return grow_mask((weight > 0.02) & ((deviation > 1.5) | (deviation < 0.5)), 1)


def _phase_jumps(
    axial: Floats, dolp: Floats, min_dolp: float, tolerances: RegionTolerances
) -> Mask:
    """Where the phase changes abruptly between two polarized sides."""
    unit = axial / np.maximum(np.linalg.norm(axial, axis=-1, keepdims=True), 1e-9)
    dx = cv2.Sobel(unit, cv2.CV_32F, 1, 0, scale=1 / 8)
    dy = cv2.Sobel(unit, cv2.CV_32F, 0, 1, scale=1 / 8)
    jump = np.sqrt((dx**2 + dy**2).sum(axis=-1))
    near_polarized = grow_mask(dolp > min_dolp, 2)
    return np.asarray((jump > tolerances.min_phase_jump) & near_polarized & (dolp > 0.5 * min_dolp))
