"""Rows: constraints on the normals of points from the phases of many views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Floats, Image
from polmvs.camera import sample_image
from polmvs.polarization.angle_models import rows_from_axial, tilt_turn
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_DISTANCE, View

# Relative distance behind the surface of a view beyond which a point is occluded. A guess: several
# times the error of a first range map, less than the depth of occluding objects.
OCCLUSION_TOLERANCE = 0.02


@dataclass(frozen=True)
class Rows:
    """Rows of N points from K views, world frame, component first.

    Attributes
    ----------
    rows, rays : (3, K, N) float32, unit; NaN rows where a view has no phase.
    sigma : (K, N) float32, rad; infinite where the row does not count.
    """

    rows: NDArray[np.float32]
    rays: NDArray[np.float32]
    sigma: NDArray[np.float32]


# Linear map of (cos 2 phase, sin 2 phase): rows of a matrix.
Reading: TypeAlias = tuple[tuple[int, int], tuple[int, int]]
AS_MEASURED: Reading = ((1, 0), (0, 1))
OTHER_LIGHT: Reading = ((-1, 0), (0, -1))


def gather_rows(
    angle_model: AngleModel,
    points_in_world: Floats,
    maps: Sequence[PhaseMap],
    range_maps: Sequence[Image | None] | None = None,
    *,
    tilt_aware: bool = True,
) -> Rows:
    """Rows of points from all views that see them (paper, eq. coeff_2, before stacking).

    Parameters are those of :func:`gather_rows_under`.
    """
    (rows,) = gather_rows_under(
        (AS_MEASURED,),
        angle_model,
        points_in_world,
        maps,
        range_maps,
        tilt_aware=tilt_aware,
    )
    return rows


def gather_rows_under(
    readings: Sequence[Reading],
    angle_model: AngleModel,
    points_in_world: Floats,
    maps: Sequence[PhaseMap],
    range_maps: Sequence[Image | None] | None = None,
    *,
    tilt_aware: bool = True,
) -> tuple[Rows, ...]:
    """Rows of points under several readings of the same phases; each map is read once.

    Parameters
    ----------
    readings : of the phases, one for each result; all have the weights of the measured phases.
    angle_model : model of the rows.
    points_in_world : (N, 3).
    maps : K phase maps.
    range_maps : per view ``(h, w)`` distances from the camera centre, 0 where unknown: a point
        that lies behind its view's map by more than ``OCCLUSION_TOLERANCE`` (relative) is occluded.
    tilt_aware : add to a row's variance the square of the error of its model: for OPA and PPA the
        rotation of the phase by tilted polarizers
        (:func:`polmvs.polarization.angle_models.tilt_turn`), for OPA also the angle to PPA's row.
        Oblique rays get less weight. Without it, the weight comes from the phase map alone.
    """
    tilt_aware = tilt_aware and angle_model is not AngleModel.TILTED
    points = np.asarray(points_in_world, np.float64)  # the origin may be far
    num_views, num_points = len(maps), len(points)
    rays = np.zeros((3, num_views, num_points), np.float32)
    found = [
        Rows(
            np.full((3, num_views, num_points), np.nan, np.float32),
            rays,
            np.full((num_views, num_points), np.inf, np.float32),
        )
        for _ in readings
    ]
    for k, phase_map in enumerate(maps):
        in_cam = (phase_map.view.cam_from_world * points).astype(np.float32)
        distance = np.linalg.norm(in_cam, axis=-1)
        ray = in_cam / np.maximum(distance, MIN_DISTANCE)[:, None]
        xy = phase_map.view.camera.project(in_cam)
        samples = sample_image(phase_map.samples, xy)
        precision = samples[:, 2]
        range_map = range_maps[k] if range_maps is not None else None
        if range_map is not None:
            shown = sample_range(range_map, phase_map.view, xy)
            precision = np.where(
                (shown > 0) & (distance > (1 + OCCLUSION_TOLERANCE) * shown), 0, precision
            )
        rotation = phase_map.view.cam_from_world.rotation.astype(np.float32)
        rays[:, k] = (ray @ rotation).T
        seen = np.flatnonzero(precision > 0)
        of_phase = 1 / precision[seen]
        if tilt_aware:
            of_phase += np.square(_tilt_turns(phase_map, samples[seen], ray[seen], xy[seen]))
        for reading, rows in zip(readings, found, strict=True):
            axial = samples[:, :2] @ np.array(reading, np.float32).T
            row, turn = _row_and_turn(angle_model, axial, ray)
            rows.rows[:, k] = (row @ rotation).T
            variance = of_phase * np.square(turn[seen])
            if tilt_aware and angle_model is AngleModel.OPA:
                # Both rows are perpendicular to d: v . (z x d) over v_z is the tangent of their
                # angle.
                aside2 = np.square((row[seen] * ray[seen]).sum(axis=-1))
                variance += aside2 / (aside2 + ray[seen, 2] ** 2)
            rows.sigma[k, seen] = np.sqrt(variance)
    return tuple(found)


def sample_range(range_map: Image, view: View, xy: Floats) -> NDArray[np.float32]:
    """Nearest value of a range map, which may be coarser than the view by an integer factor."""
    return sample_image(range_map, xy / round(view.camera.width / range_map.shape[1]), nearest=True)


def _tilt_turns(phase_map: PhaseMap, samples: Image, rays: Image, xy: Floats) -> Floats:
    """Turn (N,) of sampled phases by a tilt of the polarizers, rad."""
    diffuse: NDArray[np.bool_] | bool = False
    if phase_map.diffuse.any():
        diffuse = sample_image(phase_map.diffuse.astype(np.float32), xy, nearest=True) > 0
    return tilt_turn(samples[:, 0], samples[:, 1], rays, diffuse=diffuse)


def _row_and_turn(angle_model: AngleModel, axial: Image, rays: Floats) -> tuple[Floats, Floats]:
    """Row in the camera frame, and how far it turns about the ray per turn of the phase."""
    row = rows_from_axial(angle_model, axial[:, 0], axial[:, 1], rays)
    if angle_model is AngleModel.OPA:
        return row, np.ones(len(row), np.float32)
    # v_z / (1 - (v . d)^2): the length of v x d is v_z over the row's length in the image plane.
    return row, (row[:, 0] ** 2 + row[:, 1] ** 2) / rays[:, 2]
