"""The last bundle adjustment of SfM, more careful than those on its way."""

from __future__ import annotations

import copy
import logging

from polmvs.colmap.models import pycolmap

logger = logging.getLogger(__name__)

MAX_REPROJ_ERROR_PX = 2.0
MIN_TRI_ANGLE_DEG = 1.5
LOSS_SCALE_PX = 0.5  # Cauchy; about twice the error of a good keypoint
MIN_VIEWS_PRINCIPAL_POINT = 4  # of three views two captures of three got worse, of four none
MAX_PRINCIPAL_POINT_SHIFT = 0.1  # of the image's width; more is an estimate gone astray


def refine(
    reconstruction: pycolmap.Reconstruction, *, free_intrinsics: bool, single_camera: bool
) -> pycolmap.Reconstruction:
    """Adjust poses, points and free intrinsics with a robust loss, then filter the points.

    Parameters
    ----------
    reconstruction : from the mapper; adjusted in place, or left aside for the result.
    free_intrinsics : estimate the cameras too.
    single_camera : all images share one; its principal point is then freed as well where there
        are views enough, and kept at the centre where the estimate goes astray.
    """
    num_views = reconstruction.num_reg_images()
    if free_intrinsics and single_camera and num_views >= MIN_VIEWS_PRINCIPAL_POINT:
        with_point = copy.deepcopy(reconstruction)
        _adjust(with_point, free_intrinsics=True, free_principal_point=True)
        if _principal_points_plausible(with_point):
            return with_point
        logger.warning("SfM: the principal point cannot be estimated; the centre is kept.")
    _adjust(reconstruction, free_intrinsics=free_intrinsics, free_principal_point=False)
    return reconstruction


def _adjust(
    reconstruction: pycolmap.Reconstruction, *, free_intrinsics: bool, free_principal_point: bool
) -> None:
    """Bundle adjustment in place on one thread, then drop what is beyond the thresholds."""
    bundle = pycolmap.BundleAdjustmentOptions()
    bundle.refine_focal_length = free_intrinsics
    bundle.refine_extra_params = free_intrinsics
    bundle.refine_principal_point = free_principal_point
    bundle.print_summary = False
    bundle.ceres.loss_function_type = pycolmap.LossFunctionType.CAUCHY
    bundle.ceres.loss_function_scale = LOSS_SCALE_PX
    bundle.ceres.solver_options.num_threads = 1  # sums over threads depend on their timing
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in reconstruction.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    # Not pycolmap.bundle_adjustment: release 4.2 turns the log level back to INFO in it.
    pycolmap.create_default_bundle_adjuster(bundle, config, reconstruction).solve()
    observations = pycolmap.ObservationManager(reconstruction)
    observations.filter_all_points3D(MAX_REPROJ_ERROR_PX, MIN_TRI_ANGLE_DEG)
    reconstruction.update_point_3d_errors()


def _principal_points_plausible(reconstruction: pycolmap.Reconstruction) -> bool:
    """Whether every camera's principal point stayed near the centre of its image."""
    return all(
        max(abs(c.principal_point_x - c.width / 2), abs(c.principal_point_y - c.height / 2))
        < MAX_PRINCIPAL_POINT_SHIFT * c.width
        for c in reconstruction.cameras.values()
    )
