"""Captures with printed texture for SfM, cheap enough for hundreds of views.

A dark glossy part lies in printed surroundings. Light from the print is unpolarized and the same in
all directions; light from the part is polarized by Fresnel's equations. Labels on the part are also
printed, so that sparse points lie on it. Every ray has a closed form, as in
:mod:`polmvs.synthetic.captures`. The print is sampled at the resolution of a pixel, so features
match at different distances.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import uniform_filter1d
from scipy.spatial import cKDTree

from polmvs.arrays import Array, Mask
from polmvs.camera import Camera, sample_image
from polmvs.geometry import points_on_rays
from polmvs.scene import View
from polmvs.synthetic.captures import (
    SyntheticView,
    direction,
    look_at,
    render_mosaic,
    render_view,
    rolled,
)
from polmvs.synthetic.surfaces import Group, Surface

DARKEST, BRIGHTEST = 0.15, 0.85  # of a print, s0 in full scales
DISTANCE = 0.6  # of an orbit's cameras from the origin, metres
ELEVATIONS_DEG = (30.0, 65.0)  # of these over the x-y plane
STRIP = 32  # rows of a mosaic that are rendered at a time


@dataclass(frozen=True, kw_only=True, eq=False)
class PrintedScene:
    """A glossy part among printed surfaces, which lie nearly along the x-y plane.

    Attributes
    ----------
    part : glossy surface, which polarizes the light.
    surroundings : printed surface, textured by x and y.
    labels : (L, 3), centres of round printed labels on the part, world.
    label_radius : of each label.
    texel : side of a texel of the print in the scene's unit; on labels a quarter of it.
    seed : of the print.
    part_s0 : ``I0 + I90`` of the part off its labels, full scales.
    """

    part: Surface
    surroundings: Surface
    labels: ArrayLike
    label_radius: float
    texel: float
    seed: int = 0
    part_s0: float = 0.2

    @cached_property
    def all_surfaces(self) -> Group:
        """Part and surroundings, which occlude each other."""
        return Group((self.part, self.surroundings))


def render_printed_mosaic(view: View, scene: PrintedScene) -> Array:
    """Render a raw mosaic ``(2 H, 2 W)`` of the view's half-size image, share of full scale.

    Its polarizers are tilted for oblique rays; see :func:`polmvs.synthetic.captures.render_view`.

    Parameters
    ----------
    view : camera of the half-size image, and pose.
    scene : part and surroundings.
    """
    mosaic = render_mosaic(view, scene.part, sensor="tilted", s0=scene.part_s0)
    num_rows, num_cols = mosaic.shape
    for start in range(0, num_rows, STRIP):  # which the processor's cache holds
        strip = mosaic[start : start + STRIP]
        # Samples of the mosaic lie half a half-size pixel apart.
        rows = np.arange(start, start + len(strip))
        xy = 0.5 * np.stack(np.meshgrid(np.arange(num_cols) + 0.5, rows + 0.5), axis=-1)
        printed, brightness = _print_seen(view, scene, xy)
        strip[printed] = 0.5 * brightness[printed]  # behind any polarizer half of it is left
    return mosaic


def render_printed_truth(view: View, scene: PrintedScene) -> tuple[SyntheticView, Array]:
    """The part alone, as by :func:`render_view`, and the depth (H, W) of the whole scene."""
    part = render_view(view, scene.part, s0=scene.part_s0)
    everything = render_view(view, scene.all_surfaces)
    return part, everything.depth


def orbit_views(
    num_views: int,
    camera: Camera,
    *,
    seed: int = 0,
    ordered: bool = False,
) -> list[View]:
    """Views from all around, as of a hand-held camera, with names in random order.

    Azimuths advance by the golden angle, so that any number of views surrounds the origin; places,
    directions and rolls vary by a few percent and degrees.

    Parameters
    ----------
    num_views, camera : of how many, with which.
    seed : of the variations and of the order of the names.
    ordered : name the views by their azimuth instead.

    Returns
    -------
    Views named ``000.png`` on, sorted by name.
    """
    rng = np.random.default_rng(seed)
    low, high = np.radians(ELEVATIONS_DEG)
    azimuths = np.mod(np.arange(num_views) * np.pi * (3 - np.sqrt(5)), 2 * np.pi)
    ranks = np.argsort(np.argsort(azimuths)) if ordered else rng.permutation(num_views)
    views = []
    for rank, azimuth in zip(ranks, azimuths, strict=True):
        elevation = rng.uniform(low, high)
        center = DISTANCE * rng.uniform(0.9, 1.1) * direction(azimuth, elevation)
        pose = look_at(center, DISTANCE * rng.normal(scale=0.02, size=3))
        pose = rolled(pose, rng.normal(scale=0.2))
        name = f"{rank:0{max(3, len(str(num_views - 1)))}d}.png"
        views.append(View(name=name, camera=camera, cam_from_world=pose))
    return sorted(views, key=lambda view: view.name)


def _print_seen(view: View, scene: PrintedScene, xy: Array) -> tuple[Mask, Array]:
    """Whether image coordinates (H, W, 2) show a print, and its brightness."""
    rays = view.camera.rays(xy) @ view.cam_from_world.rotation
    center = view.center_in_world
    on_part, _ = scene.part.intersect(center, rays)
    on_print, normals = scene.surroundings.intersect(center, rays)
    is_part = on_part < on_print
    distance = np.minimum(on_part, on_print)
    points = points_on_rays(center, rays, np.where(np.isfinite(distance), distance, 0))
    labelled = np.zeros(is_part.shape, np.bool_)
    tree = cKDTree(np.asarray(scene.labels, np.float64).reshape(-1, 3))
    labelled[is_part] = np.isfinite(
        tree.query(points[is_part], distance_upper_bound=scene.label_radius)[0]
    )
    printed = np.isfinite(distance) & (labelled | ~is_part)
    # Sides of a pixel on the surface, the geometric mean of the long and the short one.
    facing = np.abs(np.einsum("...i,...i", np.nan_to_num(normals), rays))
    gsd = distance / view.camera.mean_focal_px / np.sqrt(np.maximum(facing, 0.05))
    scale = np.where(labelled, 4.0, 1.0) / scene.texel
    place = points[..., :2] * scale[..., None]
    level = np.log2(np.maximum(np.where(printed, gsd * scale, 1.0), 1e-3))
    return printed, _sample_levels(_print_levels(scene.seed), place, level)


def _sample_levels(levels: Sequence[NDArray[np.float32]], place: Array, level: Array) -> Array:
    """A periodic print at places (..., 2), texels, blended between two levels of its pyramid."""
    level = np.clip(level, 0, len(levels) - 1.001)
    lower = level.astype(int)
    sampled = np.zeros(level.shape)
    for index in np.unique(lower):
        here = lower == index
        share = level[here] - index
        fine, coarse = (_sample_periodic(levels[i], place[here] / 2**i) for i in (index, index + 1))
        sampled[here] = (1 - share) * fine + share * coarse
    return sampled


def _sample_periodic(image: NDArray[np.float32], xy: Array) -> NDArray[np.float32]:
    side = image.shape[0]
    padded = np.pad(image, 1, mode="wrap")
    return sample_image(padded, np.mod(xy, side) + 1)


@lru_cache(maxsize=2)  # of a process: a scene comes anew with each view
def _print_levels(seed: int) -> list[NDArray[np.float32]]:
    """The print, and its means over 2, 4, 8, ... texels a side."""
    levels = [random_print(1024, np.random.default_rng(seed))]
    while levels[-1].shape[0] > 4:
        side = levels[-1].shape[0] // 2
        levels.append(levels[-1].reshape(side, 2, side, 2).mean(axis=(1, 3)))
    return levels


def random_print(side: int, rng: np.random.Generator) -> NDArray[np.float32]:
    """Blocks of random brightness of every size from 4 to 64 texels, smoothed at their own."""
    total = np.zeros((side, side))
    for exponent in range(2, 7):
        size = 2**exponent
        blocks = rng.uniform(-1, 1, (side // size, side // size))
        layer = np.kron(blocks, np.ones((size, size)))
        for axis in (0, 1):  # a box of its own size leaves no edges that lie on a lattice
            layer = uniform_filter1d(layer, size, axis, mode="wrap", origin=-1)
        total += layer
    low, high = np.percentile(total, [2, 98])
    share = np.clip((total - low) / (high - low), 0, 1)
    return np.asarray(DARKEST + (BRIGHTEST - DARKEST) * share, np.float32)
