"""Uncertainty of estimated cameras and poses.

Few views determine a camera badly, and an error of its focal length or principal point bends the
whole model although every image fits. The covariance of bundle adjustment gives the deviation of
independent combinations of the camera's parameters. The model is adjusted again with the camera
changed by one standard deviation along each of them. The displacement of its points is a *mode*,
and the squares of the modes add up to the variance at any point. The covariance of the poses is
taken after an alignment of the camera centres.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from polmvs.arrays import Array
from polmvs.colmap.models import read_reconstruction, registered
from polmvs.colmap.sfm import SfmTolerances, bundle_of
from polmvs.geometry import align_points
from polmvs.scene import KEYPOINT_SIGMA_PX

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CameraTolerances:
    """Tolerances of the camera's uncertainty.

    Attributes
    ----------
    principal_point_sigma : of a lens, from the image's centre, share of the image's width, if it is
        not estimated. Guess; sensors are mounted to about 1 %.
    min_residual_px : least deviation of a keypoint's coordinate, as for the points' own deviations.
        Errors of nearby features are correlated, which residuals do not show. Measured: errors of
        the cameras of five captures are 1.8 times those from residuals of 0.17 px (RMS of 12
        parameters, from five views each), of ``demo`` with ten views 4 times.
    loss_scale_px : of the adjustment's Cauchy loss. Derived: that of SfM's last one.
    max_views : of a model: each mode costs an adjustment, and the camera of so many views is well
        known. Guess.
    """

    principal_point_sigma: float = 0.01
    min_residual_px: float = KEYPOINT_SIGMA_PX
    loss_scale_px: float = SfmTolerances.loss_scale_px
    max_views: int = 40


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraUncertainty:
    """Uncertainty of an estimated camera.

    Attributes
    ----------
    focal : relative standard deviation of the focal length.
    modes : (K, T, 3) float64, displacement of the sparse points by each uncertain combination of
        the parameters, in the order of their ids, world; the cameras' centres stay.
    """

    focal: float
    modes: Array


def camera_uncertainty(
    model: Path, *, tolerances: CameraTolerances = CameraTolerances()
) -> CameraUncertainty | None:
    """Uncertainty of the one camera that bundle adjustment estimated for a model.

    Parameters
    ----------
    model : folder of a COLMAP model whose images share a camera.

    Returns
    -------
    None if there are several cameras, too many views, or no covariance, such as for a model of
    three or more views that do not determine the camera.
    """
    reconstruction = read_reconstruction(model)
    if len(reconstruction.cameras) != 1 or reconstruction.num_reg_images() > tolerances.max_views:
        return None
    camera = next(iter(reconstruction.cameras.values()))
    names = list(range(len(camera.params)))
    point = [int(i) for i in camera.principal_point_idxs()]
    center = np.array([camera.width / 2, camera.height / 2])
    freed = not np.array_equal(np.asarray(camera.params)[point], center)
    estimated = names if freed else [i for i in names if i not in point]
    covariance = parameter_covariance(reconstruction, camera, estimated, freed, tolerances)
    if covariance is None:
        return None
    modes = []
    for step in _principal_steps(covariance):
        whole = np.zeros(len(names))
        whole[estimated] = step
        modes.append(_mode(reconstruction, whole, tolerances, free=False))
    if not freed:  # it was kept at the centre, which is known as well as sensors are mounted
        for index in point:
            whole = np.zeros(len(names))
            whole[index] = tolerances.principal_point_sigma * camera.width
            modes.append(_mode(reconstruction, whole, tolerances, free=True))
    stacked = np.array([mode for mode, _ in modes]).reshape(len(modes), -1, 3)
    if not np.isfinite(stacked).all():
        return None
    focal = float(np.linalg.norm([change for _, change in modes])) / camera.mean_focal_length()
    return CameraUncertainty(focal=focal, modes=stacked)


def pose_uncertainty(
    model: Path, *, tolerances: CameraTolerances = CameraTolerances()
) -> Array | None:
    """Covariances of the poses that bundle adjustment estimated, with a fixed camera.

    Parameters
    ----------
    model : folder of a COLMAP model.

    Returns
    -------
    (V, 6, 6) of the views sorted by name: of a small rotation of the camera about the world's axes,
    radians, and of its centre, world units, after all centres are aligned by a similarity. None if
    there are too many views, or no covariance.
    """
    reconstruction = read_reconstruction(model)
    if reconstruction.num_reg_images() > tolerances.max_views:
        return None
    images = registered(reconstruction)
    adjuster = adjuster_of(reconstruction, tolerances, free=False, free_point=False)
    options = pycolmap.BACovarianceOptions()
    options.params = pycolmap.BACovarianceOptionsParams.POSES
    found = pycolmap.estimate_ba_covariance(options, reconstruction, adjuster)
    if found is None:
        return None
    num = len(images)
    joint, by_step = np.zeros((2, 6 * num, 6 * num))
    for row, one in enumerate(images):
        here = slice(6 * row, 6 * row + 6)
        by_step[here, here] = _in_world(one.cam_from_world())
        for col, other in enumerate(images[: row + 1]):
            there = slice(6 * col, 6 * col + 6)
            block = (
                found.get_cam_cov_from_world(one.image_id)
                if row == col
                else found.get_cam_cross_cov_from_world(one.image_id, other.image_id)
            )
            if block is not None and block.shape == (6, 6):  # none: held by the gauge
                joint[here, there], joint[there, here] = block, block.T
    by_step = _with_centers_aligned([one.projection_center() for one in images]) @ by_step
    # The estimate takes residuals of one pixel. Those of few views are small by being adjusted.
    covariance = by_step @ joint @ by_step.T * _residual_px(reconstruction, tolerances) ** 2
    each = np.array([covariance[6 * k : 6 * k + 6, 6 * k : 6 * k + 6] for k in range(num)])
    return each if np.isfinite(each).all() else None


def _in_world(cam_from_world: pycolmap.Rigid3d) -> Array:
    """Turn and move (6, 6) of a camera in the world by those of ``cam_from_world``."""
    rotation = np.asarray(cam_from_world.rotation.matrix(), np.float64)
    x, y, z = cam_from_world.translation
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    step = np.zeros((6, 6))
    step[:3, :3] = -rotation.T
    step[3:, :3], step[3:, 3:] = -rotation.T @ cross, -rotation.T
    return step


def _with_centers_aligned(centers: Sequence[Array]) -> Array:
    """Map (6 V, 6 V) from changes of all poses to those that remain after alignment."""
    num = len(centers)
    around = np.asarray(centers) - np.mean(centers, axis=0)
    by_similarity = np.zeros((num, 6, 7))  # a turn, a move, a scale
    by_similarity[:, :3, :3] = np.eye(3)
    for axis in range(3):
        by_similarity[:, 3:, axis] = np.cross(np.eye(3)[axis], around)
    by_similarity[:, 3:, 3:6] = np.eye(3)
    by_similarity[:, 3:, 6] = around
    of_centers = np.zeros((num, 3, 6 * num))
    for k in range(num):
        of_centers[k, :, 6 * k + 3 : 6 * k + 6] = np.eye(3)
    fitted = np.linalg.pinv(by_similarity[:, 3:].reshape(3 * num, 7)) @ of_centers.reshape(
        3 * num, 6 * num
    )
    return np.asarray(np.eye(6 * num) - by_similarity.reshape(6 * num, 7) @ fitted)


def _residual_px(reconstruction: pycolmap.Reconstruction, t: CameraTolerances) -> float:
    """Deviation of a keypoint's coordinate; the mean of a 2D distance is 1.25 deviations."""
    return float(max(reconstruction.compute_mean_reprojection_error() / 1.2533, t.min_residual_px))


def _mode(
    reconstruction: pycolmap.Reconstruction, step: Array, t: CameraTolerances, *, free: bool
) -> tuple[Array, float]:
    """Displacements (T, 3) of the points with another camera, and its change of focal length.

    Parameters
    ----------
    step : (P,), of the camera's parameters.
    free : focal length and distortion follow.
    """
    moved = copy.deepcopy(reconstruction)
    moved_camera = next(iter(moved.cameras.values()))
    before = moved_camera.mean_focal_length()
    moved_camera.params = moved_camera.params + step
    adjuster_of(moved, t, free=free, free_point=False).solve()
    change = moved_camera.mean_focal_length() - before
    return _displacements(reconstruction, moved), float(change)


def parameter_covariance(
    reconstruction: pycolmap.Reconstruction,
    camera: pycolmap.Camera,
    estimated: list[int],
    freed: bool,
    t: CameraTolerances,
) -> Array | None:
    """Covariance of the estimated parameters of the camera, in their units; None if it has none."""
    adjuster = adjuster_of(reconstruction, t, free=True, free_point=freed)
    found = pycolmap.estimate_ba_covariance(
        pycolmap.BACovarianceOptions(), reconstruction, adjuster
    )
    covariance = None if found is None else found.get_other_params_cov(camera.params)
    if covariance is None or covariance.shape != (len(estimated), len(estimated)):
        return None
    # The estimate takes residuals of one pixel.
    covariance = np.asarray(covariance, np.float64) * _residual_px(reconstruction, t) ** 2
    positive = bool((np.diag(covariance) > 0).all())
    return covariance if positive and np.isfinite(covariance).all() else None


def _principal_steps(covariance: Array) -> Array:
    """Independent steps (P, P) of one standard deviation each, a row for each."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0))).T * scale, np.float64)


def adjuster_of(
    reconstruction: pycolmap.Reconstruction,
    t: CameraTolerances,
    *,
    free: bool,
    free_point: bool,
) -> pycolmap.CeresBundleAdjuster:
    """An adjuster of all images: of the camera too, and of its principal point, where free."""
    bundle, config = bundle_of(
        reconstruction, t.loss_scale_px, free_intrinsics=free, free_principal_point=free_point
    )
    return pycolmap.create_default_ceres_bundle_adjuster(bundle, config, reconstruction)


def _displacements(
    reconstruction: pycolmap.Reconstruction, moved: pycolmap.Reconstruction
) -> Array:
    """Displacements (T, 3) of the points after the cameras are aligned."""
    ids, images = sorted(reconstruction.points3D), sorted(reconstruction.reg_image_ids())
    points, others = (
        np.array([r.points3D[i].xyz for i in ids], np.float64).reshape(-1, 3)
        for r in (reconstruction, moved)
    )
    centers, other_centers = (
        np.array([r.image(i).projection_center() for i in images], np.float64)
        for r in (reconstruction, moved)
    )
    try:
        back = align_points(other_centers, centers)
    except ValueError:  # on one line: the turn about it is told by the points
        back = align_points(np.vstack([other_centers, others]), np.vstack([centers, points]))
    return np.asarray(back * others - points, np.float64)
