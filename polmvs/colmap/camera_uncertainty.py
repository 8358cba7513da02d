"""What an estimated camera leaves uncertain of a model's shape.

Few views fix a camera badly, and an error of its focal length or principal point bends the whole
model while every image fits. Bundle adjustment's covariance says how well each combination of the
camera's parameters is known. The model is adjusted anew with the camera moved by one standard
deviation along each of them: how its points move then is a *mode*, and the modes' squares add up to
the variance of any place.
"""

from __future__ import annotations

import copy
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from polmvs.colmap.models import read_reconstruction
from polmvs.geometry import align_points
from polmvs.scene import KEYPOINT_SIGMA_PX

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class CameraTolerances:
    """What the camera's uncertainty is made of.

    Attributes
    ----------
    principal_point_sigma : of a lens, from the image's centre, share of the image's width: what is
        known of it where it is not estimated. Guess; sensors are mounted to about 1 %.
    min_residual_px : of a keypoint's coordinate, where the residual is less: that which the points'
        own deviations are made of. Features near each other err alike, which residuals hide.
        Measured: cameras of five captures err by 1.8 times what residuals of 0.17 px say (RMS of 12
        parameters, from five views each), of ``demo`` with ten views by 4 times.
    loss_scale_px : of the adjustment's Cauchy loss, as that of SfM's last one.
    max_views : of a model that is looked at: each mode costs an adjustment, and the camera of so
        many views is known. Guess.
    """

    principal_point_sigma: float = 0.01
    min_residual_px: float = KEYPOINT_SIGMA_PX
    loss_scale_px: float = 0.5
    max_views: int = 40


@dataclass(frozen=True, kw_only=True, eq=False)
class CameraUncertainty:
    """How an estimated camera may err.

    Attributes
    ----------
    focal : standard deviation of the focal length as a share of it.
    modes : (K, T, 3) float64, what each uncertain combination of the parameters moves the sparse
        points by, in the order of their ids, world; the cameras' centres stay.
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
    None where there are several cameras, too many views, or the covariance cannot be had: a model
    of three or more views whose camera is not fixed at all has none.
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
    covariance = _parameter_covariance(reconstruction, camera, estimated, freed, tolerances)
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
    _adjuster(moved, t, free=free, free_point=False).solve()
    change = moved_camera.mean_focal_length() - before
    return _displacements(reconstruction, moved), float(change)


def _parameter_covariance(
    reconstruction: pycolmap.Reconstruction,
    camera: pycolmap.Camera,
    estimated: list[int],
    freed: bool,
    t: CameraTolerances,
) -> Array | None:
    """Covariance of the estimated parameters of the camera, in their units; None if it has none."""
    adjuster = _adjuster(reconstruction, t, free=True, free_point=freed)
    found = pycolmap.estimate_ba_covariance(
        pycolmap.BACovarianceOptions(), reconstruction, adjuster
    )
    covariance = None if found is None else found.get_other_params_cov(camera.params)
    if covariance is None or covariance.shape != (len(estimated), len(estimated)):
        return None
    # The estimate takes residuals of one pixel; the mean of a 2D distance is 1.25 deviations.
    residual = max(reconstruction.compute_mean_reprojection_error() / 1.2533, t.min_residual_px)
    covariance = np.asarray(covariance, np.float64) * residual**2
    positive = bool((np.diag(covariance) > 0).all())
    return covariance if positive and np.isfinite(covariance).all() else None


def _principal_steps(covariance: Array) -> Array:
    """Independent steps (P, P) of one standard deviation each, a row for each."""
    scale = np.sqrt(np.diag(covariance))
    values, vectors = np.linalg.eigh(covariance / np.outer(scale, scale))
    return np.asarray((vectors * np.sqrt(np.maximum(values, 0))).T * scale, np.float64)


def _adjuster(
    reconstruction: pycolmap.Reconstruction,
    t: CameraTolerances,
    *,
    free: bool,
    free_point: bool,
) -> pycolmap.CeresBundleAdjuster:
    bundle = pycolmap.BundleAdjustmentOptions()
    bundle.refine_focal_length = bundle.refine_extra_params = free
    bundle.refine_principal_point = free_point
    bundle.print_summary = False
    bundle.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    bundle.ceres.loss_function_scale = t.loss_scale_px
    bundle.ceres.solver_options.num_threads = 1
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    return pycolmap.create_default_ceres_bundle_adjuster(bundle, config, reconstruction)


def _displacements(
    reconstruction: pycolmap.Reconstruction, moved: pycolmap.Reconstruction
) -> Array:
    """How far (T, 3) the points have moved, seen from cameras that stay."""
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
