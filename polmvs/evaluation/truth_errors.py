"""Errors of clouds, normals of sparse points and measured phases against ground truth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import product

import cv2
import numpy as np

from polmvs.arrays import Array, Floats, Image, Mask
from polmvs.camera import in_image, pixel_centers
from polmvs.evaluation.metrics import (
    MIN_DOLP,
    AngleStats,
    CloudMetrics,
    angular_errors_deg,
    axial_errors_deg,
    evaluate_cloud,
)
from polmvs.io.ground_truth import GroundTruth
from polmvs.neighbors import nearest_points
from polmvs.polarization.angle_models import correct_stokes, phase_from_normal
from polmvs.polarization.capture import Capture
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap, as_tilted, view_rays
from polmvs.polarization.stokes import Stokes
from polmvs.poses.alignment import Alignment, align_views
from polmvs.scene import View, match_names

# Of a sparse point on the part; definitions, see `track_normal_errors`.
ON_PART_M = 0.003
IN_FRONT_M = 0.010

Measured = Iterable[tuple[str, Image, Image]]


@dataclass(frozen=True, kw_only=True)
class TrackNormalErrors:
    """Errors of the normals of sparse points.

    Attributes
    ----------
    errors : of the valid points on the part, degrees, 0 to 180
    num_points : points given
    num_valid : those with a valid normal
    num_on_part : those of the valid ones on the part
    """

    errors: AngleStats
    num_points: int
    num_valid: int
    num_on_part: int


def evaluate(
    cloud_points: Floats,
    cloud_normals: Floats | None,
    views: Sequence[View],
    truth: GroundTruth,
) -> tuple[CloudMetrics, Alignment]:
    """Align a cloud by its cameras and compare it with ground truth.

    Parameters
    ----------
    cloud_points : (N, 3), estimated world, any scale; rows that are not finite are ignored
    cloud_normals : (N, 3) or None, estimated world; NaN rows have no normal
    views : estimated views, in the same world

    Raises
    ------
    DataError
        The cameras do not determine the alignment.
    """
    truth_from_world, report = align_views(views, truth.views, source=truth.cameras)
    surface = truth.surface_points()
    finite = np.isfinite(cloud_points).all(axis=1)
    metrics = evaluate_cloud(
        truth_from_world * cloud_points[finite],
        None if cloud_normals is None else cloud_normals[finite] @ truth_from_world.rotation.T,
        surface.points,
        surface.normals,
        surface.is_part,
        spacing_m=surface.spacing_m,
    )
    return metrics, report


def track_normal_errors(
    points: Floats,
    normals: Floats,
    valid: Mask,
    views: Sequence[View],
    truth: GroundTruth,
) -> TrackNormalErrors:
    """Errors of the normals of the sparse points that lie on the part.

    A point is on the part if in at least one view it projects into the true mask, eroded by one
    pixel, within 3 mm of the true depth, and in no view lies more than 10 mm in front of the
    nearest surface among the 3x3 pixels about it. Its true normal is that of the nearest true
    point of the part.

    Parameters
    ----------
    points, normals : (N, 3), estimated world
    valid : (N,) bool, normals to use
    views : estimated views, in the same world.
    """
    if normals.shape != points.shape or valid.shape != points.shape[:1]:
        raise ValueError(f"{points.shape=}, {normals.shape=}, {valid.shape=} do not fit.")
    truth_from_world, _ = align_views(views, truth.views, source=truth.cameras)
    counted = valid & np.isfinite(points).all(axis=1) & np.isfinite(normals).all(axis=1)
    points_in_truth = truth_from_world * points[counted]
    on_part = points_on_part(points_in_truth, truth)
    surface = truth.surface_points()
    _, nearest = nearest_points(
        surface.points[surface.is_part], points_in_truth[on_part], far=IN_FRONT_M
    )
    errors = angular_errors_deg(
        normals[counted][on_part] @ truth_from_world.rotation.T,
        surface.normals[surface.is_part][nearest],
    )
    return TrackNormalErrors(
        errors=AngleStats.from_degrees(errors),
        num_points=len(points),
        num_valid=int(counted.sum()),
        num_on_part=int(on_part.sum()),
    )


def points_on_part(points_in_truth: Floats, truth: GroundTruth) -> Mask:
    """Whether points ``(N, 3)``, true frame, m, lie on the part; see `track_normal_errors`."""
    near = np.zeros(len(points_in_truth), np.bool_)
    floats = np.zeros(len(points_in_truth), np.bool_)
    kernel = np.ones((3, 3), np.uint8)
    for name, view in truth.views.items():
        points_in_cam = view.cam_from_world * points_in_truth
        xy = view.camera.project(points_in_cam)
        inside = in_image(view.camera, xy)
        cols, rows = np.floor(xy[inside]).astype(np.intp).T
        z = points_in_cam[inside, 2]
        depth = truth.depth(name)
        mask = cv2.erode(truth.mask(name).astype(np.uint8), kernel).astype(np.bool_)
        # NaN, where the camera sees nothing, is infinitely far: all points there float.
        closest = cv2.erode(np.where(np.isfinite(depth), depth, np.float32(np.inf)), kernel)
        near[inside] |= mask[rows, cols] & (np.abs(z - depth[rows, cols]) <= ON_PART_M)
        floats[inside] |= z < closest[rows, cols] - IN_FRONT_M
    return near & ~floats


def phase_errors(
    capture: Capture, maps: Sequence[PhaseMap], truth: GroundTruth
) -> dict[str, dict[AngleModel, AngleStats]]:
    """Errors of the measured phase on the part, under each model with the true normals.

    Parameters
    ----------
    capture : its single pixels are also compared.
    maps : phase maps, as OPA and PPA use them.
    truth : ground truth with normals.

    Returns
    -------
    ``maps``: errors of the phase maps. ``pixels``: errors of the single pixels of the capture that
    are neither clipped nor dark.
    """
    raw = match_names([phase_map.view.name for phase_map in maps], capture.names)
    errors: dict[str, dict[AngleModel, AngleStats]] = {}
    for source, tilted in product(("maps", "pixels"), (False, True)):
        measured: Measured
        if source == "maps":
            measured = (_of_map(as_tilted(one) if tilted else one) for one in maps)
        else:
            # The folder has the mosaics of all maps, which were made from it.
            measured = (
                _of_pixels(one, capture.load(raw[one.view.name]), tilted=tilted) for one in maps
            )
        found = phase_errors_on_part(measured, truth)
        if tilted:  # the corrected phase is one that PPA predicts
            errors[source][AngleModel.TILTED] = found[AngleModel.PPA]
        else:
            errors[source] = found
    return errors


def phase_errors_on_part(measured: Measured, truth: GroundTruth) -> dict[AngleModel, AngleStats]:
    """Axial errors of the phases that each model predicts from the true normals.

    Parameters
    ----------
    measured : name, phase (not AoLP), rad modulo pi, and DoLP (H, W) of each image, one at a
        time. Pixels whose phase is NaN or whose DoLP is at most 0.1, and images without ground
        truth, are ignored.

    Returns
    -------
    For OPA and PPA, the statistics over all pixels of the part in all images with ground truth.
    """
    errors: dict[AngleModel, list[Array]] = {AngleModel.OPA: [], AngleModel.PPA: []}
    for name, phase, dolp in measured:
        view = truth.find(name)
        if view is None:
            continue
        camera = view.camera
        if phase.shape != (camera.height, camera.width) or dolp.shape != phase.shape:
            raise ValueError(
                f"{phase.shape=}, {dolp.shape=} but expected {(camera.height, camera.width)}."
            )
        counted = truth.mask(view.name) & (dolp > MIN_DOLP) & np.isfinite(phase)
        normals = truth.normals(view.name)[counted]
        rays = camera.rays(pixel_centers(camera.width, camera.height)[counted])
        for angle_model, values in errors.items():
            predicted = phase_from_normal(angle_model, normals, rays)
            values.append(axial_errors_deg(phase[counted], predicted))
    return {
        angle_model: AngleStats.from_degrees(np.concatenate([np.zeros(0), *values]))
        for angle_model, values in errors.items()
    }


def _of_map(phase_map: PhaseMap) -> tuple[str, Image, Image]:
    """Name, phase, NaN where there is none, and DoLP of a phase map."""
    cos, sin, precision = np.moveaxis(phase_map.samples, -1, 0)
    phase = np.where(precision > 0, 0.5 * np.arctan2(sin, cos), np.nan)
    return phase_map.view.name, phase.astype(np.float32), np.hypot(cos, sin)


def _of_pixels(phase_map: PhaseMap, stokes: Stokes, *, tilted: bool) -> tuple[str, Image, Image]:
    """Name, phase, NaN where clipped or dark, and DoLP of the single pixels of a view."""
    if tilted:
        stokes = correct_stokes(stokes, view_rays(phase_map.view), diffuse=phase_map.diffuse)
    turn = np.where(phase_map.diffuse, np.float32(0), np.float32(np.pi / 2))
    phase = np.where(stokes.valid, stokes.aolp + turn, np.float32(np.nan))
    return phase_map.view.name, phase, stokes.dolp
