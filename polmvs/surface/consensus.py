"""Comparison of dense views: positions, normals and occlusion of one view's points in another."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import depth_buffer, in_image, sample_image
from polmvs.geometry import points_on_rays
from polmvs.normals.rows import OCCLUSION_TOLERANCE
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import View
from polmvs.surface.dense_view import (
    REACH,
    DenseView,
    SurfaceSamples,
    extend_planes,
    view_samples,
)

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

MAX_DEVIATIONS = 3.0  # between views at one point: 0.3 % of correct ones differ by more


@dataclass(frozen=True)
class Sighting:
    """Surface of another view at N points of a view.

    Attributes
    ----------
    place : (N,) distance along the first view's rays to the other's surface; NaN: none.
    sigma : (N,) its standard deviation.
    normals : (N, 3) its normal there, zero if it has none.
    cosine : (N,) between that normal and the point's own.
    excess : (N,) distance of its surface behind the point, along its own ray; NaN: none.
    facing : (N,) cosine between the point's normal and the direction to the other camera.
    outside : (N,) its image contains the point but shows no polarized surface there.
    """

    place: Array
    sigma: Array
    normals: Array
    cosine: Array
    excess: Array
    facing: Array
    outside: Mask


def sight(
    phase_map: PhaseMap,
    dense: DenseView,
    center: Floats,
    rays: Floats,
    distance: Floats,
    normals: Floats,
) -> Sighting:
    """Look up a view's points in another dense view.

    Parameters
    ----------
    phase_map, dense : of the other view.
    center, rays, distance, normals : of the first view's points: camera centre (3,), unit rays
        (N, 3), distances (N,) and unit normals (N, 3), world frame.
    """
    view = phase_map.view
    points = points_on_rays(center, rays, distance)
    in_cam = view.cam_from_world * points
    own_range = np.linalg.norm(in_cam, axis=-1)
    xy = view.camera.project(in_cam)
    lattice_xy = xy / dense.stride_px
    seen = sample_image(dense.range_map, lattice_xy, nearest=True).astype(np.float64)
    seen_normals = sample_image(dense.normals_in_world, lattice_xy, nearest=True)
    seen_normals = np.where(seen[:, None] > 0, seen_normals.astype(np.float64), np.nan)
    # The other's surface element at the nearest lattice point, and the chord from there to the
    # point: perpendicular to the mean of both normals, exactly so on planes and spheres. The
    # element's own plane would lie outside of every convex surface.
    nearest_xy = (np.floor(np.nan_to_num(lattice_xy)) + 0.5) * dense.stride_px
    other_rays = view.rays_in_world(nearest_xy)
    elements = points_on_rays(view.center_in_world, other_rays, seen)
    slant = (rays * seen_normals).sum(-1)
    mean = seen_normals + normals
    with np.errstate(divide="ignore", invalid="ignore"):
        place = ((elements - center) * mean).sum(-1) / (rays * mean).sum(-1)
        # An error along the other's ray moves the surface along its normal, by less where it looks
        # at a grazing angle; but there its rows come from farther off, so that it is not trusted
        # more.
        seen_sigma = sample_image(dense.sigma, lattice_xy, nearest=True)
        sigma = seen_sigma / np.abs(slant)
        facing = view.facing_cosines(points, normals)
    excess = np.where(seen > 0, seen - own_range, np.nan)
    cosine = (seen_normals * normals).sum(axis=-1)
    outside = _shows_background(phase_map, xy)
    return Sighting(place, sigma, np.nan_to_num(seen_normals), cosine, excess, facing, outside)


def surface_of_others(
    maps: Sequence[PhaseMap],
    dense: Sequence[DenseView | None],
    xy: Floats,
) -> SurfaceSamples | None:
    """A first estimate of the surface at pixels of the first view, from the other views.

    Parameters
    ----------
    maps, dense : of the views, the first view first.
    xy : (N, 2), image coordinates of the wanted surface.

    Returns
    -------
    None if they show nothing in the view's region.
    """
    view, center = maps[0].view, maps[0].view.center_in_world
    known = [(m.view, d) for m, d in zip(maps[1:], dense[1:], strict=True) if d is not None]
    if not known or not len(xy):
        return None
    parts, normals = [], []
    for other, result in known:
        rotation = other.cam_from_world.rotation
        samples = view_samples(result, other.camera.rays(result.lattice_xy()) @ rotation)
        parts.append(
            points_on_rays(other.center_in_world, samples.rays_in_world, np.exp(samples.log_range))
        )
        normals.append(samples.normals)
    points = np.concatenate(parts)
    distance = np.linalg.norm(points - center, axis=-1)
    unknown = np.full(len(points), np.nan)
    shown = SurfaceSamples(
        xy=np.asarray(view.project(points), np.float64),
        rays_in_world=(points - center) / distance[:, None],
        log_range=np.log(distance),
        normals=np.concatenate(normals),
        normal_sigma=unknown,
        log_range_sigma=unknown,
        confidence=np.zeros(len(points)),
    )
    facing = (shown.rays_in_world * shown.normals).sum(axis=-1) < 0
    shown = shown[facing & maps[0].shows_surface(shown.xy)]
    if not len(shown.xy):
        return None
    stride_px = max(result.stride_px for _, result in known)
    rays = view.rays_in_world(xy)
    return extend_planes(shown, xy, rays, REACH * stride_px)


def hidden_by(dense: DenseView, view: View, points: Floats, normals: Floats) -> Mask:
    """Which lattice points (h, w) of a view lie behind a surface that faces it.

    Views may agree on a surface that this view cannot see and that its phase does not contradict.

    Parameters
    ----------
    dense, view : of the view.
    points, normals : (N, 3), world, of the surfaces of all views.
    """
    xy = view.project(points) / dense.stride_px
    height, width = dense.range_map.shape
    with np.errstate(invalid="ignore"):
        shown = view.faces(points, normals) & ((xy >= 0) & (xy < [width, height])).all(axis=-1)
    nearest, _ = depth_buffer(xy[shown], view.ranges(points[shown]), width, height)
    return np.asarray(dense.range_map > (1 + OCCLUSION_TOLERANCE) * nearest)


def _shows_background(phase_map: PhaseMap, xy: Floats) -> Mask:
    """Which points lie in the image but outside its region."""
    return np.asarray(in_image(phase_map.view.camera, xy) & ~phase_map.shows_surface(xy))
