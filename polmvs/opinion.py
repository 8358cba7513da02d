"""What one view's dense result says about points of another."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.dense import DenseView
from polmvs.phasemap import PhaseMap

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Opinion:
    """What another view says of N points of a view.

    Attributes
    ----------
    place : (N,) distance along the first view's rays at which the other's surface is met; NaN:
        none.
    sigma : (N,) its standard deviation.
    normals : (N, 3) its normal there, zero where it has none.
    cosine : (N,) between that normal and the point's own.
    excess : (N,) how much farther than the point its surface lies, along its own ray; NaN: it has
        none there.
    facing : (N,) cosine between the point's normal and the direction to the other camera.
    outside : (N,) it shows the point's place and no polarised surface there.
    """

    place: Array
    sigma: Array
    normals: Array
    cosine: Array
    excess: Array
    facing: Array
    outside: Mask


def ask_view(
    phase_map: PhaseMap,
    dense: DenseView,
    center: Array,
    rays: Array,
    distance: Array,
    normals: Array,
) -> Opinion:
    """Look a view's points up in another dense view.

    Parameters
    ----------
    phase_map, dense : of the other view.
    center, rays, distance, normals : of the first view's points: camera centre (3,), unit rays
        (N, 3), distances (N,) and unit normals (N, 3), world frame.
    """
    view = phase_map.view
    points = center + distance[:, None] * rays
    in_cam = view.cam_from_world * points
    own_range = np.linalg.norm(in_cam, axis=-1)
    xy = view.camera.project(in_cam)
    lattice_xy = xy / dense.stride_px
    seen = sample_image(dense.range_map, lattice_xy, nearest=True).astype(np.float64)
    seen_normals = sample_image(dense.normals_in_world, lattice_xy, nearest=True)
    seen_normals = np.where(seen[:, None] > 0, seen_normals.astype(np.float64), np.nan)
    other_center = view.center_in_world
    # The other's surface element at the nearest lattice point, and the chord from there to the
    # point: perpendicular to the mean of both normals, exactly so on planes and spheres. The
    # element's own plane would lie outside of every convex surface.
    nearest_xy = (np.floor(np.nan_to_num(lattice_xy)) + 0.5) * dense.stride_px
    other_rays = view.camera.rays(nearest_xy) @ view.cam_from_world.rotation
    elements = other_center + seen[:, None] * other_rays
    slant = (rays * seen_normals).sum(-1)
    mean = seen_normals + normals
    with np.errstate(divide="ignore", invalid="ignore"):
        place = ((elements - center) * mean).sum(-1) / (rays * mean).sum(-1)
        # An error along the other's ray moves the surface along its normal, by less where it looks
        # at a grazing angle; but there its rows come from farther off, so that it is not trusted
        # more.
        seen_sigma = sample_image(dense.sigma, lattice_xy, nearest=True)
        sigma = seen_sigma / np.abs(slant)
        to_camera = other_center - points
        facing = (to_camera * normals).sum(-1) / own_range
    excess = np.where(seen > 0, seen - own_range, np.nan)
    cosine = (seen_normals * normals).sum(axis=-1)
    outside = _shows_background(phase_map, xy)
    return Opinion(place, sigma, np.nan_to_num(seen_normals), cosine, excess, facing, outside)


def _shows_background(phase_map: PhaseMap, xy: Floats) -> Mask:
    """Which places lie in the image but outside its region."""
    camera = phase_map.view.camera
    in_image = ((xy >= 0) & (xy < [camera.width, camera.height])).all(axis=-1)
    return np.asarray(in_image & ~phase_map.shows_surface(xy))
