"""Observations of points in views: the planes of incidence under both kinds of light.

Weakly polarized, bright and edge pixels are not excluded: each pixel of a window is weighted by the
inverse variance of its phase, and each window by the inverse variance of the mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats, Image
from polmvs.camera import in_image, sample_image
from polmvs.normals.rows import AS_MEASURED, Reading
from polmvs.polarization.angle_models import (
    correct_polarization,
    phase_sign,
    rows_from_axial,
    tilt_turn,
)
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.light_mixture import phase_variance
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_DISTANCE

LIGHTS = (Light.SPECULAR, Light.DIFFUSE)  # order of the first axis
LOCAL_SHARE = 6  # a pixel's phase is judged in a neighbourhood of this part of the window. Guess.
NUM_VARYING = 9  # neighbourhoods of a window, 3 x 3, that vary of their own. Guess.


@dataclass(frozen=True)
class PointObservations:
    """Polarization of N points in K views, world frame, component first.

    Attributes
    ----------
    rows : (2, 3, K, N) float32, unit: planes of incidence of specular and of diffuse light; NaN
        where a view has no measurement.
    rays : (3, K, N) float32, unit, from the cameras to the points.
    turn_variances : (2, K, N) float32, rad^2, of the rows' rotation about their rays; infinite
        where they have no weight.
    dolp : (K, N) float32, 0 where unknown.
    dolp_variance : (K, N) float32, infinite where unknown.
    """

    rows: NDArray[np.float32]
    rays: NDArray[np.float32]
    turn_variances: NDArray[np.float32]
    dolp: NDArray[np.float32]
    dolp_variance: NDArray[np.float32]

    def some(self, points: NDArray[Any]) -> PointObservations:
        """Those of some of the points."""
        parts = (getattr(self, field.name)[..., points] for field in fields(PointObservations))
        return PointObservations(*parts)


def gather_observations(
    angle_model: AngleModel,
    points_in_world: Floats,
    maps: Sequence[PhaseMap],
    *,
    window_px: int,
    tilt_aware: bool = True,
) -> PointObservations:
    """Observations of points in all views that show them; one map is held at a time.

    Parameters are those of :func:`gather_observations_under`.
    """
    (found,) = gather_observations_under(
        (AS_MEASURED,),
        angle_model,
        points_in_world,
        maps,
        window_px=window_px,
        tilt_aware=tilt_aware,
    )
    return found


def gather_observations_under(
    readings: Sequence[Reading],
    angle_model: AngleModel,
    points_in_world: Floats,
    maps: Sequence[PhaseMap],
    *,
    window_px: int,
    tilt_aware: bool = True,
) -> tuple[PointObservations, ...]:
    """Observations of points under several readings of the same angles; each map is read once.

    Parameters
    ----------
    readings : linear map of ``(s1, s2)`` for each result.
    angle_model : model of the planes of incidence.
    points_in_world : (N, 3).
    maps : K phase maps.
    window_px : side of the window about each point.
    tilt_aware : add to a row's variance the tilt that OPA and PPA ignore; see
        :func:`polmvs.normals.rows.gather_rows_under`.
    """
    points = np.asarray(points_in_world, np.float64)
    shape = len(maps), len(points)
    rays = np.zeros((3, *shape), np.float32)
    dolps = np.zeros(shape, np.float32)
    dolp_variances = np.full(shape, np.inf, np.float32)
    gathered = tuple(
        PointObservations(
            rows=np.full((2, 3, *shape), np.nan, np.float32),
            rays=rays,
            turn_variances=np.full((2, *shape), np.inf, np.float32),
            dolp=dolps,
            dolp_variance=dolp_variances,
        )
        for _ in readings
    )
    for k, phase_map in enumerate(maps):
        view = phase_map.view
        in_cam = (view.cam_from_world * points).astype(np.float32)
        ray = in_cam / np.maximum(np.linalg.norm(in_cam, axis=-1), MIN_DISTANCE)[:, None]
        xy = view.camera.project(in_cam)
        rotation = view.cam_from_world.rotation.astype(np.float32)
        rays[:, k] = (ray @ rotation).T
        sampled = sample_image(window_polarization(phase_map.polarization, window_px), xy)
        seen = np.flatnonzero((sampled[:, 3] > 0) & in_image(view.camera, xy))
        p, ray = sampled[seen, :2], ray[seen]
        variance = sampled[seen, 2] + sampled[seen, 3]
        dolp = np.hypot(p[:, 0], p[:, 1])
        dolps[k, seen], dolp_variances[k, seen] = np.minimum(dolp, 1), variance
        of_phase = phase_variance(dolp, variance)
        for reading, found in zip(readings, gathered, strict=True):
            read = p @ np.array(reading, np.float32).T
            for index, light in enumerate(LIGHTS):
                row, turned = _row(angle_model, light, read, ray, of_phase, tilt_aware=tilt_aware)
                found.rows[index][:, k, seen] = (row @ rotation).T
                found.turn_variances[index, k, seen] = turned
    return gathered


def _row(
    angle_model: AngleModel,
    light: Light,
    polarization: Floats,
    rays: Floats,
    of_phase: Floats,
    *,
    tilt_aware: bool,
) -> tuple[Floats, Floats]:
    """Rows (N, 3), camera frame, of polarization (N, 2) as light of one kind, and the variance.

    The variance (N,) is that of the row's turn about the ray, rad^2.
    """
    sign, diffuse = phase_sign(light), light is Light.DIFFUSE
    if angle_model is AngleModel.TILTED:
        s1, s2 = correct_polarization(polarization[:, 0], polarization[:, 1], rays, diffuse=diffuse)
        # The rotation of a row is that of the light's direction of polarization.
        return rows_from_axial(angle_model, sign * s1, sign * s2, rays), of_phase
    cos2, sin2 = sign * polarization[:, 0], sign * polarization[:, 1]
    row = rows_from_axial(angle_model, cos2, sin2, rays)
    variance = np.asarray(of_phase)
    if tilt_aware:
        variance = variance + np.square(tilt_turn(cos2, sin2, rays, diffuse=diffuse))
    if angle_model is AngleModel.PPA:
        # Turn per phase, v_z / (1 - (v . d)^2): the row's length in the image plane tells it.
        return row, variance * np.square((row[:, 0] ** 2 + row[:, 1] ** 2) / rays[:, 2])
    if tilt_aware:
        # Both rows are perpendicular to d: v . (z x d) over v_z is the tangent of their angle.
        aside2 = np.square((row * rays).sum(axis=-1))
        variance = variance + aside2 / (aside2 + rays[:, 2] ** 2)
    return row, variance


def window_polarization(polarization: Image, window_px: int) -> Image:
    """Polarization averaged over a window about every pixel (H, W, 4).

    ``s1 / s0`` and ``s2 / s0``, the variance of their mean, and the variance that all pixels share;
    0 where no pixel of the window is usable. Pixels are weighted by the inverse variance of their
    phase, so those of a mark, where light is mixed and hardly polarized, have little weight.

    Parameters
    ----------
    polarization : as in :class:`polmvs.polarization.phase_map.PhaseMap`.
    """
    known = np.isfinite(polarization[..., 2])
    # Running sums in single precision leave errors of the size of what varies.
    values = np.where(known[..., None], polarization, 0).astype(np.float64)
    own, shared = values[..., 2], values[..., 3]

    def box(image: Array, side: int) -> Array:
        blurred = cv2.blur(image, (side, side), borderType=cv2.BORDER_REPLICATE)
        return np.asarray(blurred, np.float64)

    # Of the phase in a small neighbourhood, so that single pixels' noise makes no weight.
    side = max(1, round(window_px / LOCAL_SHARE)) | 1
    count = np.maximum(box(known.astype(np.float64), side), 1e-6)
    near = box(values, side) / count[..., None]
    near_variance = near[..., 2] / (count * side**2) + near[..., 3]
    local = phase_variance(np.hypot(near[..., 0], near[..., 1]), near_variance)
    with np.errstate(divide="ignore"):
        weight = np.where(known, 1 / local, 0)
    total = box(weight, window_px)
    safe = np.maximum(total, 1e-9)

    def mean(image: Array) -> Array:
        weights = weight if image.ndim == 2 else weight[..., None]
        return box(image * weights, window_px) / (safe if image.ndim == 2 else safe[..., None])

    variance = box(np.square(weight) * own, window_px) / np.square(safe) / window_px**2
    # What varies over the window, by its shape or by what is on it: the mean of so many
    # neighbourhoods errs by that, too.
    square = np.square(near[..., :2]).sum(axis=-1)
    spread = mean(square) - np.square(mean(near[..., :2])).sum(axis=-1)
    variance = np.maximum(variance, 0.5 * spread / NUM_VARYING)
    common = np.where(total > 1e-6, np.maximum(mean(shared), 1e-12), 0)
    return np.dstack([mean(values[..., :2]), variance, common]).astype(np.float32)
