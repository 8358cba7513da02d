"""The objects in each view, found by the textured ground that they hide.

Polarization does not show the outline of grey and white objects. The ground on which they stand
does, if it has a texture: its image in one view is predicted from the others. It is a plane with
relief (:mod:`polmvs.surface.ground`), called the plane here. Pixels that agree with the prediction
show the plane, so the space between it and the camera is free. Where there is no prediction,
brightness and contrast decide. The remaining space above the plane is the object where the cameras
look, with others beside it that are polarized and as poor in features as it. The outline in each
view is where the image changes from the predicted plane to the brightness of the object, as in
matting against a known background.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cache, cached_property, partial

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from polmvs.camera import pixel_centers, sample_image
from polmvs.config import default_num_workers
from polmvs.fitting import MEDIAN_OF_NORMAL, robust_deviation
from polmvs.geometry import lengths
from polmvs.polarization.phase_map import (
    MIN_DOLP_SIGMAS,
    PhaseMap,
    box_about,
    dolp_in_sigmas,
    median_strength,
    smoothed_polarization,
)
from polmvs.scene import Tracks, View
from polmvs.surface.ground import Ground, SupportingPlane, find_ground
from polmvs.surface.matting import find_outline
from polmvs.surface.surface_view import signed_distance_px, smooth_distance_px
from polmvs.surface.vignetting import NUM_TERMS, fit_vignetting, vignetting_terms

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

MAX_ODDS = 4.0  # log-odds of one pixel at most: any pixel may be wrong
LEAST_SIGMA = 1e-3  # of a logarithm of intensity, and its least spread: no image is that exact
LEAST_ODDS = 0.7  # log-odds that decide: two to one
BLUR_PX = 0.8  # deviation of averages of log-odds, working pixels


@dataclass(frozen=True, kw_only=True)
class SearchTolerances:
    """Tolerances of the search.

    Attributes
    ----------
    working_px : longest side of the images in which the object and its outline are searched.
    window_px : of the correlation with other views, working pixels.
    num_near : number of other views with which a view is correlated.
    num_others : largest number of other views that predict the plane.
    num_samples : pixels of each view at most from which vignetting is fitted. Measured on two
        captures: of 2,000, which darken by 0.06 and 0.22, it differs by less than 0.002.
    detail_px : deviation of the average that is subtracted to get texture.
    lighting_share : of an image's longest side, window over which the plane's brightness may differ
        between views, and in which the background's appearance is compared with the object's.
    num_levels : of brightness, and of contrast, in that comparison. Guess.
    extent_cells : of the grid on which the plane's extent is found, along its side. Guess.
    extent_gap : width of gaps in the extent that are closed, in those cells. Guess.
    least_share : share of a pixel's texture that agrees with the plane in two other views. Guess.
    wrong_share : share of the views that may deny a point of the object wrongly; at least two must
        deny it.
    seen_share : share of the views that must see a point; the objects lie in the common field of
        view.
    num_cells : of the coarse grid, along its side; the fine one has as many along the object's.
    least_part : volume of another object at least, a share of the largest part's. As that of a
        piece of the hull (:class:`polmvs.surface.visual_hull.HullTolerances`).
    num_rounds : of prediction and carving; a third changes the outlines by 0.1 px.
    inner_share : of an image's longest side, distance from the outline of what is well within the
        object.
    polarized_share : of an object within its outline that is polarized if polarization shows all
        of it: its region is then complete. In the median view.
    most_beside : share of a single view's object that may lack polarization, and of its polarized
        region that may lie beside the outline, and of what lies there, that may show the plane's
        texture. Guess.
    """

    working_px: int = 640
    window_px: int = 5
    num_near: int = 6
    num_others: int = 12
    num_samples: int = 300
    detail_px: float = 2.0
    lighting_share: float = 1 / 8
    num_levels: int = 32
    extent_cells: int = 100
    extent_gap: int = 10
    least_share: float = 0.2
    wrong_share: float = 0.25
    seen_share: float = 0.6
    num_cells: int = 72
    least_part: float = 0.01
    num_rounds: int = 2
    inner_share: float = 0.02
    polarized_share: float = 0.99
    most_beside: float = 0.1

    def lighting_px(self, image: Image | Mask) -> int:
        """Width of the window of :attr:`lighting_share`, pixels; odd."""
        return 2 * round(0.5 * self.lighting_share * int(max(image.shape))) + 1

    def needed(self, num_views: int) -> int:
        """Number of views that must deny a point."""
        return max(2, round(self.wrong_share * num_views))


TOL = SearchTolerances()


@dataclass(frozen=True)
class FoundObject:
    """The object in one view.

    Attributes
    ----------
    mask : (H, W) bool.
    outline_shift : (H, W) float32 px, distance of the outline outside of the mask's border, at each
        pixel that of the nearest border pixel.
    inner : (H, W) bool, pixels well within the object for any outline.
    """

    mask: Mask
    outline_shift: Image
    inner: Mask


def find_object(
    maps: Sequence[PhaseMap],
    plane: SupportingPlane,
    tracks: Tracks,
) -> list[FoundObject | None] | None:
    """The objects that stand on a plane, in each view.

    Parameters
    ----------
    maps : of each view, three or more; a polarized region shows the object, not the plane.
    plane : on which they stand.
    tracks : sparse points of the scene.

    Returns
    -------
    None for a view whose outline polarization shows. None for all if it does in every view, if the
    plane has too little texture to find what hides it, or if its light moves.
    """
    points = tracks.points_in_world
    ground = find_ground(points, plane)
    heights = np.abs(plane.height(points) - ground.height(points))
    near = points[heights < 3 * np.median(heights)]
    # A plane without fine texture may have a coarse one.
    shown = _shown_plane(maps, ground, near, 4, None)
    strengths = [cache(partial(dolp_in_sigmas, one)) for one in maps]
    features = [tracks.obs_xy[seen] for seen in tracks.of_views(len(maps))]
    for scale in (2, 1):
        shown = _shown_plane(maps, ground, near, scale, shown)
        small = _with_extent(shown.views, shown.textured, ground)
        shown = replace(shown, views=small)
        clues = [
            _Clues(*own) for own in zip(small, shown.shows_plane, strengths, features, strict=True)
        ]
        bounded = _bounded(_space(small, ground), clues)
        if bounded is None:
            return None
        coarse, num_cut = bounded
        masks = [coarse.mask(view) for view in small]
        # More than the object: if all of it is polarized, the object is. Half the size shows that.
        if not _views_to_search(small, masks, shown.textured):
            return None
        cells = coarse.finer()
    small = _without_vignetting(small, shown.textured)
    shown = replace(shown, views=small)
    for _ in range(TOL.num_rounds):
        plates = _plates(small, masks)
        odds = _background_odds(shown, plates, masks)
        left = cells.likely(small, odds)
        if left is None:
            return None
        masks = [left.mask(view) for view in small]
        widths = [left.width_px(view) for view in small]
    searched = _views_to_search(small, masks, shown.textured)
    if not searched:
        return None
    if num_cut:
        logger.warning(
            "Polarized objects on the plane that are left out, as they reach out of the field that "
            "most views show: %d. Move back, or give `region.mask`.",
            num_cut,
        )
    masks = [_decided(*given) for given in zip(masks, odds, widths, strict=True)]
    noise = _residual(small, plates, masks)
    odds = _by_texture(shown, _plane_odds(small, plates, noise), masks)
    masks = [fill_false_holes(*pair) for pair in zip(masks, odds, strict=True)]
    if _shadows_pass_for_objects(small, plates, noise):
        return None  # the lamp moves with the camera: outlines would be pixels wide
    # Threads, as sampling images releases Python's lock.
    found: list[FoundObject | None] = [None] * len(small)
    with ThreadPoolExecutor(default_num_workers()) as pool:
        one = partial(_found, small, ground=ground, noise=noise)
        chosen = ([values[index] for index in searched] for values in (masks, plates))
        for index, own in zip(searched, pool.map(one, searched, *chosen), strict=True):
            found[index] = own
    return found


@dataclass(frozen=True)
class _Shown:
    """Where views show the plane's texture.

    Attributes
    ----------
    views : in working pixels.
    textured : of each, (h, w) bool, pixels that show it.
    hidden : (h, w) bool, pixels that do not show it where they should.
    shows_plane : (h, w) bool, pixels that show it here or at a coarser scale.
    """

    views: list[_Working]
    textured: list[Mask]
    hidden: list[Mask]
    shows_plane: list[Mask]


def _shown_plane(
    maps: Sequence[PhaseMap],
    ground: Ground,
    points: Floats,
    scale: float,
    coarser: _Shown | None,
) -> _Shown:
    """Where views show the texture of a plane with some points, at a scale of their images."""
    views = [_working(phase_map, ground, TOL.working_px / scale) for phase_map in maps]
    shares, expected = _showing_plane(views, points)
    # A window next to an outline on the plane contains the outline, also inside the object.
    size = 2 * round(0.5 * TOL.window_px + TOL.detail_px) - 1
    window = np.ones((size, size), np.uint8)
    textured = [cv2.erode(share, window) > TOL.least_share for share in shares]
    found = [shown & ~view.polarized for shown, view in zip(textured, views, strict=True)]
    hidden = [
        (texture > TOL.least_share) & (share <= TOL.least_share)
        for texture, share in zip(expected, shares, strict=True)
    ]
    # Thin parts of the object are lost at a coarse scale: it does not overrule a finer one.
    shows_plane = [
        here | ((cv2.resize(before.astype(np.uint8), here.shape[::-1]) > 0) & ~unseen)
        for here, before, unseen in zip(
            found, coarser.shows_plane if coarser else found, hidden, strict=True
        )
    ]
    return _Shown(views, textured, hidden, shows_plane)


@dataclass(frozen=True, kw_only=True)
class _Working:
    """A view in working pixels.

    Attributes
    ----------
    view : in its own pixels.
    factor : of its own pixels to a working one.
    intensity : (H, W) float32, in its own pixels.
    measured : (H, W, 4) float32, ``s1 / s0`` and ``s2 / s0`` as of the phase map, with variances.
    lowest : intensity whose logarithm is the lowest.
    vignetting : (h, w) float32, logarithm of the intensity that the lens loses, if it is known.
    log : (h, w) float32, logarithm of the intensity, without vignetting.
    region : (h, w) bool, its polarized region.
    polarized : (h, w) bool, the region without what may be background up to the image's border.
    on_plane : (h, w, 3), where each pixel's ray meets the plane; NaN where it does not.
    has_plane : (h, w) bool, where the plane is known to reach to.
    """

    view: View
    factor: float
    intensity: Image
    measured: Image
    lowest: float
    vignetting: Image
    log: Image
    region: Mask
    polarized: Mask
    on_plane: Array
    has_plane: Mask

    @property
    def center(self) -> Array:
        return self.view.center_in_world

    @property
    def without_vignetting(self) -> Image:
        """(H, W) intensity, in its own pixels."""
        lost = cv2.resize(self.vignetting, self.intensity.shape[::-1])
        return np.asarray(self.intensity * np.exp(lost), np.float32)

    @cached_property
    def polarization(self) -> Image:
        """(h, w, 2), ``s1 / s0`` and ``s2 / s0``; NaN where they are not measured."""
        smoothed = smoothed_polarization(self.measured, BLUR_PX * self.factor)
        small = cv2.resize(smoothed, self.log.shape[::-1])
        known = small[..., 2:] > 0
        return np.where(known, small[..., :2], np.nan).astype(np.float32)

    def project(self, points: Floats) -> Floats:
        """Working coordinates ``(..., 2)``."""
        return np.asarray(self.view.project(points) / self.factor)

    def sees(self, xy: Floats, margin: float = 1.0) -> Mask:
        """Which working coordinates lie in the image."""
        height, width = self.log.shape
        x, y = xy[..., 0], xy[..., 1]
        return np.asarray(
            (x > margin) & (y > margin) & (x < width - margin) & (y < height - margin)
        )

    def pixel_at(self, distance: float) -> float:
        """Length that a working pixel covers at a distance."""
        return distance * self.factor / self.view.camera.mean_focal_px


def _working(phase_map: PhaseMap, ground: Ground, longest_px: float) -> _Working:
    view, image = phase_map.view, np.asarray(phase_map.intensity, np.float32)
    factor = max(max(image.shape) / longest_px, 1.0)
    size = (round(image.shape[1] / factor), round(image.shape[0] / factor))
    small = cv2.resize(image, size, interpolation=cv2.INTER_AREA) if factor > 1 else image
    lowest = 1e-3 * max(float(np.percentile(small, 99)), 1e-12)
    log = np.log(np.maximum(cv2.GaussianBlur(small, (0, 0), 0.5), lowest)).astype(np.float32)
    region, polarized = (
        cv2.resize(mask.astype(np.float32), size, interpolation=cv2.INTER_AREA) > 0.5
        for mask in (phase_map.region.inside, phase_map.region.bounded)
    )
    on_plane = ground.seen_at(view, pixel_centers(*size) * factor)
    has_plane = np.asarray(np.isfinite(on_plane).all(axis=-1), np.bool_)
    measured = np.asarray(phase_map.polarization)
    return _Working(
        view=view,
        factor=factor,
        intensity=image,
        measured=measured,
        lowest=lowest,
        vignetting=np.zeros_like(log),
        log=log,
        region=region,
        polarized=polarized,
        on_plane=on_plane,
        has_plane=has_plane,
    )


def _views_to_search(
    views: Sequence[_Working], masks: Sequence[Mask], textured: Sequence[Mask]
) -> list[int]:
    """Views in which polarization does not show what is well within some masks.

    Outlines from polarization and from the plane differ in their bias. So all views are searched,
    or, if polarization shows the object in the median view, those in which it fails, or in which
    its region has grown over the background up to the image's border. A view whose polarized
    region lies beside the mask has a wrong pose, and so would its search. If the median view's does
    and shows the plane's texture there, the plane is polarized, and polarization shows no outline.
    """
    shares, beside, grown, of_plane = np.full(len(views), np.nan), *np.zeros((3, len(views)))
    for index, (view, mask, texture) in enumerate(zip(views, masks, textured, strict=True)):
        inner, outer = _well_beyond(~mask), _well_beyond(mask)
        if inner.any():
            shares[index] = view.region[inner].mean()
        beside[index] = _share(outer, view.polarized)
        grown[index] = _share(outer, view.region)
        of_plane[index] = _share(texture, view.polarized & outer)
    known = np.isfinite(shares)
    median = float(np.median(shares[known])) if known.any() else 0.0
    logger.info("%.1f %% of what hides its support is polarized.", 100 * median)
    plane_is_polarized = min(np.median(beside), np.median(of_plane)) >= TOL.most_beside
    if median < TOL.polarized_share or plane_is_polarized:
        return list(range(len(views)))
    fails = (shares < 1 - TOL.most_beside) | (grown >= TOL.most_beside)
    return np.flatnonzero(fails & (beside < TOL.most_beside)).tolist()


def _well_beyond(mask: Mask) -> Mask:
    """Pixels (h, w) that lie outside of a mask for any outline of it."""
    return np.asarray(signed_distance_px(mask) > TOL.inner_share * max(mask.shape))


def _share(marked: Mask, region: Mask) -> float:
    """Share of a region's pixels that are marked; 0 without a region."""
    return float(marked[region].mean()) if region.any() else 0.0


def _nearest(views: Sequence[_Working], index: int) -> NDArray[np.int64]:
    """The other views, nearest first."""
    distances = lengths(np.array([view.center - views[index].center for view in views]))
    order = np.argsort(distances, kind="stable")
    return np.asarray(order[order != index])


def _showing_plane(views: Sequence[_Working], points: Floats) -> tuple[list[Image], list[Image]]:
    """Share of each view's texture that is the plane's, and the share that it should be, (h, w).

    Two other views show the same texture there; two show texture.
    """
    details = [view.log - cv2.GaussianBlur(view.log, (0, 0), TOL.detail_px) for view in views]
    seen_textures, textures, unexplained = [], [], []
    for index, view in enumerate(views):
        correlations, variances = [], []
        for other in _nearest(views, index)[: TOL.num_near]:
            xy = views[other].project(view.on_plane)
            value, variance = _correlation(
                details[index], sample_image(details[other], xy), TOL.window_px
            )
            seen = views[other].sees(xy)
            correlations.append(np.where(seen, value, 0))
            variances.append(np.where(seen, variance, 0))
        second, variance = (
            np.maximum(np.partition(np.array(values, np.float32), -2, axis=0)[-2], 0)
            for values in (correlations, variances)
        )
        own = _local_variance(details[index], TOL.window_px)
        seen_textures.append((second, own))
        textures.append((np.ones_like(second), variance))
        xy = view.project(points)
        left = np.asarray(own * (1 - second**2), np.float32)
        unexplained.append(sample_image(left, xy[view.sees(xy)]))
    noise = 3 * float(np.median(np.concatenate(unexplained)))

    def shares(found: Sequence[tuple[Image, Image]]) -> list[Image]:
        return [np.asarray(value * own / (own + noise), np.float32) for value, own in found]

    return shares(seen_textures), shares(textures)


def _local_variance(image: Image, window_px: int) -> Image:
    window = (window_px, window_px)
    mean = cv2.blur(image, window)
    return np.asarray(np.maximum(cv2.blur(image * image, window) - mean * mean, 0), np.float32)


def _correlation(a: Image, b: Image, window_px: int) -> tuple[Image, Image]:
    """Normalised correlation of two images in all windows, and the variance of the second."""
    window = (window_px, window_px)
    covariance = cv2.blur(a * b, window) - cv2.blur(a, window) * cv2.blur(b, window)
    variance = _local_variance(b, window_px)
    spread = _local_variance(a, window_px) * variance
    return np.asarray(covariance / np.sqrt(np.maximum(spread, 1e-12)), np.float32), variance


def _marked(pixels: Mask, xy: Floats) -> Mask:
    """Whether the pixels at some coordinates are marked."""
    return np.asarray(sample_image(pixels.astype(np.float32), xy, nearest=True) > 0)


@dataclass(frozen=True)
class _Cells:
    """Grid cells that may hold the object.

    Attributes
    ----------
    origin : (3,), centre of the first cell.
    axes : (3, 3), rows are the steps of the grid.
    held : (X, Y, Z) bool.
    """

    origin: Array
    axes: Array
    held: Mask

    def centers(self) -> Array:
        """Centres ``(N, 3)`` of the cells that are held."""
        return np.asarray(self.origin + np.argwhere(self.held) @ self.axes)

    @cached_property
    def middle(self) -> Array:
        """Mean (3,) of these centres."""
        return np.asarray(self.centers().mean(axis=0))

    def carved(
        self,
        views: Sequence[_Working],
        free: Sequence[Mask],
        *,
        needed: int,
        testable: Sequence[Mask] | None = None,
    ) -> _Cells | None:
        """The cells without those that some views see through.

        Parameters
        ----------
        free : pixels of each view that show the background.
        needed : number of views that must see through a cell.
        testable : pixels of each view that could show it; a cell must lie in those of two views.

        Returns
        -------
        None if nothing is left.
        """
        points = self.centers()
        num_free, num_seen, num_tests = np.zeros((3, len(points)), np.int32)
        for index, (view, pixels) in enumerate(zip(views, free, strict=True)):
            xy = view.project(points)
            seen = view.sees(xy, 0.5)
            num_seen += seen
            num_free += seen & _marked(pixels, xy)
            num_tests += seen if testable is None else seen & _marked(testable[index], xy)
        held = np.zeros_like(self.held)
        held[self.held] = (
            (num_free < needed) & (num_seen >= TOL.seen_share * len(views)) & (num_tests >= 2)
        )
        return replace(self, held=held) if held.any() else None

    def likely(self, views: Sequence[_Working], odds: Sequence[Image]) -> _Cells | None:
        """The cells that are more likely the object's.

        A pixel that shows the background frees all cells on its ray. A pixel that shows the object
        needs one of them: they share its evidence. A connected part must have more evidence than a
        single pixel, which may be wrong.

        Parameters
        ----------
        odds : log-odds (h, w) that each view's pixels show the background.

        Returns
        -------
        None if nothing is left.
        """
        points = self.centers()
        total, num_seen = np.zeros(len(points)), np.zeros(len(points), np.int32)
        for view, image in zip(views, odds, strict=True):
            xy = view.project(points)
            seen = view.sees(xy, 0.5)
            num_seen += seen
            shared = np.where(image < 0, image / self._num_on_rays(view, xy[seen]), image)
            total[seen] += sample_image(shared.astype(np.float32), xy[seen], nearest=True)
        held = np.zeros_like(self.held)
        held[self.held] = (total < LEAST_ODDS) & (num_seen >= TOL.seen_share * len(views))
        parts, num = ndimage.label(held)
        evidence = np.bincount(parts[self.held], total, num + 1)
        evidence[0] = 0
        held = np.asarray((evidence < -MAX_ODDS)[parts], np.bool_)
        return replace(self, held=held) if held.any() else None

    def _num_on_rays(self, view: _Working, xy: Floats) -> Image:
        """Number (h, w) of cells on each pixel's ray, at least one, from their coordinates."""
        height, width = view.log.shape
        columns, rows = xy.astype(int).T
        centers = np.bincount(rows * width + columns, minlength=height * width)
        size = self.width_px(view)
        density = cv2.GaussianBlur(
            centers.reshape(height, width).astype(np.float32), (0, 0), max(0.5 * size, 0.5)
        )
        return np.asarray(np.maximum(density * size**2, 1), np.float32)

    def width_px(self, view: _Working) -> float:
        """Width of a cell at their middle in a view, working pixels."""
        return float(lengths(self.axes).max()) / view.pixel_at(float(view.view.ranges(self.middle)))

    def parts(self) -> list[_Cells]:
        """The connected parts, the one around the middle first, then by size."""
        parts, num = ndimage.label(self.held)
        # The middle of the grid is where the cameras look: the part with most cells about it.
        x, y, _ = np.meshgrid(*(np.linspace(-1, 1, n) for n in self.held.shape), indexing="ij")
        nearness = ndimage.sum(np.exp(-8 * (x * x + y * y)), parts, np.arange(num + 1))
        size = np.bincount(parts.ravel(), minlength=num + 1)
        nearness[0] = size[0] = 0
        middle = int(np.argmax(nearness))
        order = np.argsort(-size[1:], kind="stable") + 1
        least = TOL.least_part * size.max()
        others = [number for number in order if number != middle and size[number] >= least]
        return [replace(self, held=parts == number) for number in (middle, *others)]

    @property
    def ends_at_sides(self) -> bool:
        """Whether the part reaches the sides of the grid."""
        held = self.held
        sides = (held[0], held[-1], held[:, 0], held[:, -1], held[:, :, -1])
        return any(side.any() for side in sides)

    @property
    def stands(self) -> bool:
        """Whether the part reaches the plane."""
        return bool(self.held[:, :, 0].any())

    def finer(self) -> _Cells:
        """The part, with a margin of one cell, on a finer grid."""
        inside = np.argwhere(self.held)
        low, high = inside.min(axis=0) - 1.0, inside.max(axis=0) + 1.0
        # The plane bounds the grid below.
        low[2] = max(low[2], -0.5)
        step = float(np.prod(high - low) ** (1 / 3)) / TOL.num_cells
        counts = np.maximum(np.ceil((high - low) / step).astype(int), 1)
        grid = np.stack(np.meshgrid(*(np.arange(n) for n in counts), indexing="ij"), axis=-1)
        old = np.clip(np.round(low + (grid + 0.5) * step).astype(int), 0, None)
        old = np.minimum(old, np.array(self.held.shape) - 1)
        near = ndimage.binary_dilation(self.held, np.ones((3, 3, 3), bool))
        origin = self.origin + (low + 0.5 * step) @ self.axes
        return _Cells(origin, step * self.axes, near[old[..., 0], old[..., 1], old[..., 2]])

    def mask(self, view: _Working) -> Mask:
        """What the cells cover in a view."""
        points = self.centers()
        xy = view.project(points)
        pixels = np.zeros(view.log.shape, np.uint8)
        columns, rows = xy[view.sees(xy, 0.5)].astype(int).T
        pixels[rows, columns] = 1
        size = int(np.ceil(np.sqrt(2) * self.width_px(view))) | 1  # odd, at least a cell's diagonal
        kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
        return np.asarray(cv2.morphologyEx(pixels, cv2.MORPH_CLOSE, kernel) > 0)


def _space(views: Sequence[_Working], ground: Ground) -> _Cells:
    """Cells above the plane about the point where the cameras look, within the view of most."""
    plane = ground.plane
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        camera = view.view.camera
        ray = view.view.rays_in_world(np.array([0.5 * camera.width, 0.5 * camera.height]))
        across = np.eye(3) - np.outer(ray, ray)
        matrix, right = matrix + across, right + across @ view.center
    middle = np.linalg.lstsq(matrix, right, rcond=None)[0]
    foot = middle - plane.height(middle) * plane.normal
    away = np.array([view.center - foot for view in views])
    ranges = lengths(away)
    reaches = [
        0.5 * min(view.log.shape) * view.pixel_at(float(one))
        for view, one in zip(views, ranges, strict=True)
    ]
    step = 2 * float(np.median(reaches)) / TOL.num_cells
    # An upright line is seen under the cosine of the elevation: how much of it fills the images.
    cosines = np.sqrt(1 - np.minimum(away @ plane.normal / ranges, 1) ** 2)
    height = float(plane.height(middle) + np.median(reaches / np.maximum(cosines, 0.5)))
    axes = step * np.vstack([plane.axes, plane.normal])
    shape = (TOL.num_cells, TOL.num_cells, max(round(height / step), 1))
    origin = foot - 0.5 * (TOL.num_cells - 1) * (axes[0] + axes[1]) + 0.5 * axes[2]
    return _Cells(origin, axes, np.ones(shape, bool))


def _bounded(space: _Cells, clues: Sequence[_Clues]) -> tuple[_Cells, int] | None:
    """The part around the middle that remains, if it ends within the space, and other objects.

    With the number of objects that do not end within the space; the cells do not have these.

    A view may deny a point wrongly, so others must deny it as well. Among clutter fewer views see
    the plane; if the remaining part does not end, one view is enough.
    """
    views, free = [one.view for one in clues], [one.shows_plane for one in clues]
    testable = [view.has_plane for view in views]
    for needed in (TOL.needed(len(views)), 1):
        left = space.carved(views, free, needed=needed, testable=testable)
        if left is None:
            continue
        middle, *others = left.parts()
        if not middle.ends_at_sides:
            objects = _objects_beside(middle, [part for part in others if part.stands], clues)
            ending = [part.held for part in objects if not part.ends_at_sides]
            held = np.logical_or.reduce([middle.held, *ending])
            return replace(middle, held=held), len(objects) - len(ending)
    return None


@dataclass(frozen=True)
class _Clues:
    """What tells in a view whether a part is an object.

    Attributes
    ----------
    view : in working pixels.
    shows_plane : (h, w) bool.
    strengths : gives (H, W), as of :func:`polmvs.polarization.phase_map.dolp_in_sigmas`.
    features : (O, 2) image coordinates of sparse points.
    """

    view: _Working
    shows_plane: Mask
    strengths: Callable[[], Image]
    features: Floats

    def mask(self, part: _Cells) -> Mask:
        """What a part covers, without what shows the plane."""
        return part.mask(self.view) & ~self.shows_plane

    def strength(self, mask: Mask) -> float:
        """Median strength of the polarization of some working pixels."""
        strengths = self.strengths()
        large = cv2.resize(mask.astype(np.uint8), strengths.shape[::-1]) > 0
        return median_strength(strengths, large)

    def num_features(self, mask: Mask) -> int:
        """Number of features in some working pixels."""
        return int(_marked(mask, self.features / self.view.factor).sum())


def _objects_beside(
    middle: _Cells, others: Sequence[_Cells], clues: Sequence[_Clues]
) -> list[_Cells]:
    """Which other parts are objects as well: polarized, and as poor in features as the middle.

    What is as rich in features as the plane belongs to the surroundings, which SfM reconstructs.
    The ratio of the densities decides between the two. A part is judged where no larger one hides
    it.
    """

    def counted(masks: Sequence[Mask]) -> tuple[int, int]:
        """Number of features, and of pixels."""
        num = sum(one.num_features(mask) for one, mask in zip(clues, masks, strict=True))
        return num, sum(int(np.count_nonzero(mask)) for mask in masks)

    covered = [one.mask(middle) for one in clues]
    of_plane = [one.shows_plane for one in clues]
    densities = [max(num, 1) / max(area, 1) for num, area in map(counted, (covered, of_plane))]
    most, found = float(np.sqrt(np.prod(densities))), []
    for part in others:
        own = [one.mask(part) & ~other for one, other in zip(clues, covered, strict=True)]
        num, area = counted(own)
        if num >= most * area:
            continue
        strengths = [one.strength(mask) for one, mask in zip(clues, own, strict=True) if mask.any()]
        if np.median(strengths) > MIN_DOLP_SIGMAS:
            found.append(part)
            covered = [mask | other for mask, other in zip(own, covered, strict=True)]
    return found


def _without_vignetting(views: Sequence[_Working], shows_plane: Sequence[Mask]) -> list[_Working]:
    """Views with the intensity that a lens without vignetting would give.

    What remains of the plane's change of brightness between views is due to the light.
    """
    rng = np.random.default_rng(0)
    terms = [
        vignetting_terms(view.view.camera, pixel_centers(*view.log.shape[::-1]) * view.factor)
        for view in views
    ]
    ratios, of_terms, of_distances = [], [], []
    for index, view in enumerate(views):
        pixels = rng.permutation(np.flatnonzero(shows_plane[index]))[: TOL.num_samples]
        points = view.on_plane.reshape(-1, 3)[pixels]
        own_terms = terms[index].reshape(-1, NUM_TERMS)[pixels]
        for number in _others(views, index):
            other = views[number]
            xy = other.project(points)
            ratio = view.log.ravel()[pixels] - sample_image(other.log, xy)
            other_terms = vignetting_terms(other.view.camera, xy * other.factor)
            both = other.sees(xy) & _marked(shows_plane[number], xy)
            ratios.append(np.diff(ratio[both]))
            of_terms.append(np.diff((own_terms - other_terms)[both], axis=0))
            distance = lengths(points - view.center) / lengths(points - other.center)
            of_distances.append(np.diff(np.log(distance[both])))
    coefficients = fit_vignetting(
        *(np.concatenate(values) for values in (ratios, of_terms, of_distances))
    )
    lost = [np.asarray(own @ coefficients, np.float32) for own in terms]
    return [
        replace(view, vignetting=own, log=view.log + own)
        for view, own in zip(views, lost, strict=True)
    ]


def _with_extent(
    views: Sequence[_Working],
    shows_plane: Sequence[Mask],
    ground: Ground,
) -> list[_Working]:
    """Views that know how far the plane reaches: where two of them show it, and in between."""
    axes = ground.plane.axes.T
    shown = [view.on_plane[mask] @ axes for view, mask in zip(views, shows_plane, strict=True)]
    everything = np.concatenate(shown)
    if not len(everything):
        return [replace(view, has_plane=np.zeros_like(view.has_plane)) for view in views]
    low, high = np.percentile(everything, (0.5, 99.5), axis=0)
    step = max(float(np.prod(high - low) ** 0.5) / TOL.extent_cells, 1e-12)
    counts = np.ceil((high - low) / step).astype(np.int64) + 1
    num_views = np.zeros(counts, np.int32)
    for places in shown:
        cells, inside = _cells_of(places, low, step, counts)
        reached = np.zeros(counts, np.bool_)
        reached[tuple(cells[inside].T)] = True
        num_views += reached
    size = TOL.extent_gap + 1
    extent = cv2.morphologyEx(
        np.pad(num_views >= 2, size).astype(np.uint8),
        cv2.MORPH_CLOSE,
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)),
    )
    extent = ndimage.binary_fill_holes(extent)[size:-size, size:-size]
    found = []
    for view in views:
        cells, inside = _cells_of(view.on_plane @ axes, low, step, counts)
        found.append(replace(view, has_plane=inside & extent[cells[..., 0], cells[..., 1]]))
    return found


def _cells_of(
    places: Floats, low: Array, step: float, counts: NDArray[np.int64]
) -> tuple[NDArray[np.int64], Mask]:
    """Cells ``(..., 2)`` of a grid of some counts that hold places on a plane, and whether any."""
    with np.errstate(invalid="ignore"):
        cells = np.floor((places - low) / step)
        inside = np.asarray(((cells >= 0) & (cells < counts)).all(axis=-1))
    return np.where(inside[..., None], cells, 0).astype(np.int64), inside


@dataclass(frozen=True)
class _Plate:
    """Predicted image of the plane in a view, without the object.

    Attributes
    ----------
    log : (h, w) float32, logarithm of the intensity; NaN where fewer than two other views see the
        plane, and far from the object.
    deviation : (h, w) float32, of the views that see it.
    predictions : of each other view: its index, 1 where it shows no object (h, w), and what is
        added to its logarithm, in a smaller image.
    changes : (n,), variation of the light on the plane over the image from view to view.
    """

    log: Image
    deviation: Image
    predictions: list[tuple[int, Image, Image]]
    changes: Array


def _others(views: Sequence[_Working], index: int) -> NDArray[np.int64]:
    """Views that predict the plane in a view: half nearby, half from around, which see behind."""
    near, far = np.split(_nearest(views, index), [TOL.num_others // 2])
    chosen = np.linspace(0, max(len(far) - 1, 0), TOL.num_others // 2).round().astype(int)
    return np.concatenate([near, far[np.unique(chosen)] if len(far) else far])


def _plates(views: Sequence[_Working], masks: Sequence[Mask]) -> list[_Plate]:
    """The plane about the object in each view, predicted from others where it is not hidden.

    A lamp that moves with the camera, and gloss, change the plane's brightness from view to view.
    At scales above ``lighting_share``, each prediction is adjusted to the brightness of the view.
    Pixels in holes of masks predict nothing: false holes of several views would confirm each other.
    """
    kernel = np.ones((3, 3), np.uint8)
    whole = [ndimage.binary_fill_holes(mask).astype(np.uint8) for mask in masks]
    free = [cv2.dilate(mask, kernel) == 0 for mask in whole]
    beside = [mask.astype(np.float32) for mask in free]

    def plate(index: int) -> _Plate:
        view, shown, changes, predictions = views[index], [], [], []
        window = TOL.lighting_px(view.log)
        shrink = 8 / window  # of an average over the window
        part = box_about(masks[index], window)
        own, on_plane, open_here = view.log[part], view.on_plane[part], free[index][part]
        for other in _others(views, index):
            xy = views[other].project(on_plane)
            seen = views[other].sees(xy) & (sample_image(beside[other], xy) >= 1)
            if not (both := seen & open_here).any():
                continue
            log = sample_image(views[other].log, xy)
            change = _local_mean(own - log, both, window)
            shown.append(np.where(seen, log + change, np.nan))
            whole = np.zeros_like(view.log)
            whole[part] = change
            small = cv2.resize(whole, None, fx=shrink, fy=shrink, interpolation=cv2.INTER_AREA)
            predictions.append((int(other), beside[other], np.asarray(small, np.float32)))
            varying = change[both]
            changes.append(robust_deviation(varying - np.median(varying)))
        stack = np.array(shown, np.float32).reshape(-1, *own.shape)
        log, deviation = np.full_like(view.log, np.nan), np.zeros_like(view.log)
        log[part], deviation[part] = _median_and_deviation(stack)
        log[~view.has_plane] = np.nan
        return _Plate(log, deviation, predictions, np.array(changes))

    # Threads, as sampling images and sorting release Python's lock.
    with ThreadPoolExecutor(default_num_workers()) as pool:
        return list(pool.map(plate, range(len(views))))


def _local_mean(values: Image, where: Mask, window_px: int) -> Image:
    """Mean (h, w) of some pixels over a window, where it has none that of all."""
    weight = cv2.blur(where.astype(np.float32), (window_px, window_px))
    total = cv2.blur(np.where(where, values, 0).astype(np.float32), (window_px, window_px))
    least = 1 / window_px  # of the window: a line of it
    mean = total / np.maximum(weight, least)
    return np.where(weight >= least, mean, np.median(values[where])).astype(np.float32)


def _median(stack: Image) -> Image:
    """Median over the finite ones of a stack (n, h, w); NaN where they are fewer than two."""
    if not len(stack):
        return np.full(stack.shape[1:], np.nan, np.float32)
    num = np.isfinite(stack).sum(axis=0)
    ordered = np.sort(stack, axis=0)  # NaN last
    low, high = np.maximum(num - 1, 0) // 2, np.minimum(num // 2, len(stack) - 1)
    middle = [np.take_along_axis(ordered, k[None], axis=0)[0] for k in (low, high)]
    return np.where(num >= 2, 0.5 * (middle[0] + middle[1]), np.nan).astype(np.float32)


def _median_and_deviation(stack: Image) -> tuple[Image, Image]:
    """:func:`_median`, and the robust deviation from it, 0 where it is NaN."""
    median = _median(stack)
    return median, np.nan_to_num(_median(np.abs(stack - median)) / MEDIAN_OF_NORMAL)


def _residual(views: Sequence[_Working], plates: Sequence[_Plate], masks: Sequence[Mask]) -> float:
    """Standard deviation of the views from the plane's prediction, beside the object."""
    left = []
    for view, plate, mask in zip(views, plates, masks, strict=True):
        beside = cv2.dilate(mask.astype(np.uint8), np.ones((9, 9), np.uint8)) == 0
        left.append((view.log - plate.log)[beside & np.isfinite(plate.log)])
    all_left = np.concatenate(left)
    return robust_deviation(all_left) if len(all_left) else np.inf


def _background_odds(
    plane: _Shown,
    plates: Sequence[_Plate],
    masks: Sequence[Mask],
) -> list[Image]:
    """Log-odds (h, w) that each view's pixels show the plane, or the background beyond it.

    Where the plane is predicted, the brightness tells; where it is not, the appearance. The
    polarization tells everywhere.
    """
    views, found = plane.views, []
    predicted = _plane_odds(views, plates, _residual(views, plates, masks))
    known = _known_pixels(plane, masks, predicted)
    appearance, polarization = _appearance_odds(plane, known), _polarization_odds(plane, known)
    for index, plate in enumerate(plates):
        odds = np.where(np.isfinite(plate.log), predicted[index], appearance[index])
        odds = np.clip(odds + polarization[index], -MAX_ODDS, MAX_ODDS)
        found.append(np.asarray(cv2.GaussianBlur(odds, (0, 0), BLUR_PX), np.float32))
    return _by_texture(plane, found, masks)


def _by_texture(plane: _Shown, odds: Sequence[Image], masks: Sequence[Mask]) -> list[Image]:
    """Log-odds (h, w) that each view's pixels show the background, with its texture.

    Where a view does not show the plane's texture though it should, the brightness agrees by chance
    only. Polarized regions show the object, unless they lie beside it as well.
    """
    found = []
    for view, own, seen, unseen, mask in zip(
        plane.views, odds, plane.textured, plane.hidden, masks, strict=True
    ):
        total = np.where(seen, np.minimum(own + MAX_ODDS, MAX_ODDS), own)
        total[unseen] = np.minimum(total[unseen], -LEAST_ODDS)
        if _share(_well_beyond(mask), view.polarized) < TOL.most_beside:
            total[view.polarized] = -MAX_ODDS
        found.append(total)
    return found


def _plane_odds(views: Sequence[_Working], plates: Sequence[_Plate], noise: float) -> list[Image]:
    """Log-odds (h, w) that each view's pixels show the plane; 0 where it is not predicted."""
    spread, found = _spread(views), []
    for view, plate in zip(views, plates, strict=True):
        odds = _odds(view.log - plate.log, np.hypot(plate.deviation, noise), spread)
        found.append(np.where(np.isfinite(plate.log), odds, 0).astype(np.float32))
    return found


def _spread(views: Sequence[_Working]) -> float:
    """Range of the logarithms of intensity in a view, mean over the views."""
    return float(np.mean([np.diff(np.percentile(view.log, (1, 99)))[0] for view in views]))


def _shadows_pass_for_objects(
    views: Sequence[_Working], plates: Sequence[_Plate], noise: float
) -> bool:
    """Whether shadows that move from view to view are too deep for a plane.

    The change of the plane's brightness over the image, from view to view, is about the share of
    its light that moves, and so the depth of the shadows of this light. In a shadow the plane is
    polarized as elsewhere, which outweighs any evidence but the strongest.
    """
    changes = np.concatenate([plate.changes for plate in plates])
    if not len(changes):
        return True
    depth = np.median(changes, keepdims=True).astype(np.float32)
    return bool(_odds(depth, np.full_like(depth, noise), _spread(views)) <= -MAX_ODDS)


def _decided(mask: Mask, odds: Image, width_px: float) -> Mask:
    """A mask (h, w) of cells, corrected by the odds of its pixels within a cell of its border."""
    near = np.abs(signed_distance_px(mask)) < width_px
    return np.asarray(np.where(near & (np.abs(odds) > LEAST_ODDS), odds < 0, mask), np.bool_)


def fill_false_holes(mask: Mask, odds: Floats) -> Mask:
    """A mask (H, W) with the holes filled that do not show the plane in this view.

    Mirror images of the plane in two views may carve a tunnel through the object. ``odds`` (H, W)
    are the log-odds that a pixel shows the plane; 0 where nothing tells.
    """
    holes = np.asarray(ndimage.binary_fill_holes(mask), np.bool_) & ~mask
    labels, num = ndimage.label(holes)
    shown = ndimage.mean(odds, labels, np.arange(1, num + 1)) if num else np.zeros(0)
    return mask | np.isin(labels, 1 + np.flatnonzero(shown <= LEAST_ODDS))


@dataclass(frozen=True)
class _Known:
    """Pixels of a view that certainly show one or the other, (h, w) bool."""

    object: Mask
    background: Mask


def _known_pixels(plane: _Shown, masks: Sequence[Mask], odds: Sequence[Image]) -> list[_Known]:
    """Pixels of the object and of the background of each view.

    The object is known where the prediction of the plane fails or its texture is hidden, the
    background about the object, where it shows the plane's texture or lies beyond the plane. Parts
    of the object that the masks lack are neither.
    """

    def grown(mask: Mask, size: int) -> Mask:
        return cv2.dilate(mask.astype(np.uint8), np.ones((size, size), np.uint8)) > 0

    found = []
    for view, mask, odd, shown, hidden in zip(
        plane.views, masks, odds, plane.shows_plane, plane.hidden, strict=True
    ):
        own = ~grown(~mask, TOL.window_px) & ((odd < -LEAST_ODDS) | hidden)
        near = grown(mask, TOL.lighting_px(mask)) & ~grown(mask, TOL.window_px)
        found.append(_Known(own, near & (shown | ~view.has_plane)))
    return found


def _learned_odds(
    bins: Sequence[NDArray[np.int64]],
    known: Sequence[_Known],
    shares: Callable[[NDArray[np.int64]], Array],
) -> list[Image]:
    """Log-odds (h, w) that each view's pixels show the background, by their bins.

    The bins of the object are those of all views, those of the background of each view.

    Parameters
    ----------
    bins : of each view's pixels (h, w).
    known : pixels of each view.
    shares : of the bins, from those of some pixels.
    """
    of_object = shares(
        np.concatenate([own[of.object] for own, of in zip(bins, known, strict=True)])
    )
    found = []
    for own, of in zip(bins, known, strict=True):
        ratio = np.log(shares(own[of.background]) / of_object)[own]
        found.append(np.clip(ratio, -MAX_ODDS, MAX_ODDS).astype(np.float32))
    return found


def _appearance_odds(plane: _Shown, known: Sequence[_Known]) -> list[Image]:
    """Log-odds (h, w) that each view's pixels show the background, by their appearance.

    Appearance is brightness and contrast. It tells where no other view predicts the plane: in
    shadow under the object, and beyond the plane's extent.
    """
    views = plane.views
    lowest = min(float(view.log.min()) for view in views)
    spread = max(max(float(view.log.max()) for view in views) - lowest, 1e-6)
    num, window = TOL.num_levels, np.ones((TOL.window_px, TOL.window_px), np.uint8)

    def bins(view: _Working) -> NDArray[np.int64]:
        bright = (view.log - lowest) / spread
        # The least of the windows that contain a pixel: that of its own side of an outline.
        variance = cv2.erode(_local_variance(view.log, TOL.window_px), window)
        rough = _on_log_scale(np.sqrt(variance), spread)
        return _levels(bright) * num + _levels(rough)

    def shares(of_pixels: NDArray[np.int64]) -> Array:
        counts = np.bincount(of_pixels, minlength=num * num).astype(np.float64)
        joint = ndimage.gaussian_filter(counts.reshape(num, num), 1.0)
        # Shadow, and light that is found nowhere else, change the brightness and not the contrast:
        # they are as likely as the rest.
        return _likelihoods((joint + joint.mean(axis=0)).ravel())

    return _learned_odds([bins(view) for view in views], known, shares)


def _polarization_odds(plane: _Shown, known: Sequence[_Known]) -> list[Image]:
    """Log-odds (h, w) that each view's pixels show the background, by their polarization.

    The background's varies slowly: that of the plane with the angle at which it is seen. What
    counts is the distance to its mean nearby, as far as that varies in the view.
    """

    def bins(view: _Working, of: _Known) -> NDArray[np.int64]:
        measured = np.isfinite(view.polarization[..., 0])
        away = np.full_like(view.log, np.nan)
        window = TOL.lighting_px(view.log)
        for part in (view.has_plane, ~view.has_plane):
            if not (beside := of.background & part & measured).any():
                continue
            mean = [
                _local_mean(one, beside, window) for one in np.moveaxis(view.polarization, -1, 0)
            ]
            away[part] = lengths(view.polarization - np.stack(mean, axis=-1))[part]
        return np.where(np.isfinite(away), _levels(_on_log_scale(away, 1.0)), -1)

    def shares(of_pixels: NDArray[np.int64]) -> Array:
        counts = np.bincount(of_pixels[of_pixels >= 0], minlength=TOL.num_levels)
        likelihoods = _likelihoods(ndimage.gaussian_filter1d(counts.astype(np.float64), 1.0))
        return np.append(likelihoods, 1.0)  # what is not measured tells nothing

    return _learned_odds(
        [bins(view, of) for view, of in zip(plane.views, known, strict=True)], known, shares
    )


def _on_log_scale(values: Image, largest: float) -> Image:
    """Places in [0, 1] of positive values between the least deviation and the largest."""
    share = np.log(values / LEAST_SIGMA + 1) / np.log(largest / LEAST_SIGMA + 1)
    return np.asarray(share, np.float32)


def _levels(values: Image) -> NDArray[np.int64]:
    """Numbers of the levels of values in [0, 1]."""
    num = TOL.num_levels
    return np.clip(np.nan_to_num(values * num).astype(np.int64), 0, num - 1)


def _likelihoods(counts: Array) -> Array:
    """Likelihoods of bins from their counts."""
    # One in a hundred may look like anything; of nothing, all are as likely.
    counts = counts + max(0.01 * counts.sum(), 1.0) / counts.size
    return np.asarray(counts / counts.sum())


def _odds(residual: Image, sigma: Image, spread: float) -> Image:
    """Log-odds that an image shows the prediction against a wide distribution."""
    sigma, spread = np.maximum(sigma, LEAST_SIGMA), max(spread, LEAST_SIGMA)
    # The noise is infinite where no place beside the object is predicted: then nothing is told.
    odds = np.log(spread / np.sqrt(2 * np.pi)) - np.log(sigma) - 0.5 * (residual / sigma) ** 2
    return np.asarray(np.clip(odds, -MAX_ODDS, MAX_ODDS), np.float32)


def _found(
    views: Sequence[_Working],
    index: int,
    mask: Mask,
    plate: _Plate,
    *,
    ground: Ground,
    noise: float,
) -> FoundObject:
    """The object in a view's own pixels, with the sub-pixel position of its outline.

    ``mask`` is accurate to a working pixel.
    """
    view = views[index]
    size = (view.view.camera.width, view.view.camera.height)
    coarse = cv2.resize(signed_distance_px(mask), size) * np.float32(view.factor)
    behind = partial(_behind, views, index, plate, ground)
    # Clipped light has no known polarization; 0 on both sides of an outline tells nothing.
    known = np.isfinite(view.measured[..., 2:3])
    intensity = view.without_vignetting
    polarized = np.where(known, view.measured[..., :2] * intensity[..., None], 0)
    distance = find_outline(
        intensity,
        coarse,
        behind,
        noise,
        polarized=polarized.astype(np.float32),
        start_px=view.factor,
    )
    found = distance < 0
    inner = coarse < -TOL.inner_share * max(coarse.shape)
    return FoundObject(found, smooth_distance_px(found) - distance, inner)


def _behind(
    views: Sequence[_Working], index: int, plate: _Plate, ground: Ground, places: Floats
) -> tuple[Image, Image, Mask]:
    """The plane at image coordinates ``(..., 2)`` of a view, predicted from others.

    Returns
    -------
    Intensity (...), NaN where it is not predicted, its relative deviation, and whether there is a
    plane.
    """
    view = views[index]
    on_plane = ground.seen_at(view.view, places)
    xy = places / view.factor
    has_plane = _marked(view.has_plane, xy)
    shown = []
    for other, free, change in plate.predictions:
        there = views[other].project(on_plane)
        seen = views[other].sees(there) & (sample_image(free, there) >= 1)
        image = sample_image(views[other].intensity, there * views[other].factor)
        small = xy * (np.array(change.shape[::-1]) / np.array(view.log.shape[::-1]))
        log = np.log(np.maximum(image, views[other].lowest)) + sample_image(change, small)
        log += sample_image(views[other].vignetting, there)
        shown.append(np.where(seen & has_plane, log, np.nan))
    stack = np.array(shown, np.float32).reshape(-1, *places.shape[:-1])
    log, deviation = _median_and_deviation(stack)
    return np.exp(log), deviation, has_plane
