"""Trial adjustments: a test whether other cameras fit a model's matches better than the given ones.

A wrong focal length or principal point bends the whole model and its normals although every image
fits; a wrong pose makes all rows of its view wrong. The matches show both. The model is adjusted
again with focal length, principal point, poses and points free, and the result is compared with the
given cameras, in deviations of the adjustment.
"""

from __future__ import annotations

import copy
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pycolmap

from polmvs.arrays import Array
from polmvs.colmap.camera_uncertainty import CameraTolerances, parameter_covariance
from polmvs.colmap.cameras import quiet_colmap
from polmvs.colmap.models import read_reconstruction, registered
from polmvs.colmap.sfm import bundle_of
from polmvs.geometry import align_points, nearest_rotation

ADJUSTMENT = CameraTolerances()

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class TrialTolerances:
    """Tolerances of given cameras.

    Attributes
    ----------
    min_images, min_points : least size of a model for the test. Guess.
    num_points : of each image that are used, at random; it bounds the time. Measured on a model of
        16 images and 14,611 points: with the 3,888 that are left a focal length of 530.0 px is
        known to 0.3 px and a principal point to 0.8, with all of them to 0.2 and 0.4.
    max_cost_change : relative change of the cost at which an adjustment ends. Measured on the same
        model: parameters are those of COLMAP's default 0 within 0.002 px, in a third of the time.
    max_sigmas : largest difference of a parameter from the fitting one. Derived: errors of cameras
        are up to 4 times those from residuals (see ``CameraTolerances.min_residual_px``).
    min_focal_change : share of the focal length. Guess: a tenth of the change that turns normals by
        3 degrees.
    min_point_change : of the principal point, share of the image's width. Measured: 1.3 % turn
        normals by 2.2 degrees; a guess of a third of it.
    min_turn_deg : of a pose. Guess: half of the rotation that turns normals by about one degree.
    min_shift : of a camera, share of its distance from the points: it moves the image as far as
        ``min_turn_deg``. Derived.
    pose_ratio : factor by which reprojection errors of a view under the given cameras must exceed
        those of the other views; or those of most views must exceed the errors under fitting
        cameras, for a camera that is certainly wrong. Guess.
    """

    min_images: int = 3
    min_points: int = 50
    num_points: int = 1000
    max_cost_change: float = 1e-6
    max_sigmas: float = 4.0
    min_focal_change: float = 0.01
    min_point_change: float = 0.004
    min_turn_deg: float = 0.5
    min_shift: float = 0.009
    pose_ratio: float = 3.0


TOL = TrialTolerances()


@dataclass(frozen=True, kw_only=True)
class PoseChange:
    """Difference of a pose from the fitting one.

    Attributes
    ----------
    name : of the view.
    turn_deg : between the orientations.
    shift : between the centres, share of the distance from the points.
    """

    name: str
    turn_deg: float
    shift: float


@dataclass(frozen=True, kw_only=True)
class Complaint:
    """A camera or pose that does not fit, with the fitting one.

    Attributes
    ----------
    text : a clause.
    view : name of the view of a pose; None: all views.
    """

    text: str
    view: str | None = None


@dataclass(frozen=True, kw_only=True)
class CameraTrial:
    """Result of the test of given cameras.

    Attributes
    ----------
    focal, fitting_focal : given and fitting mean focal length, px.
    point, fitting_point : the principal points, px.
    focal_sigma, point_sigma : deviations of the fitting ones, px.
    camera_fits : whether both agree.
    wrong_poses : of views whose pose does not fit although the others do.
    error_px, fitting_error_px : mean reprojection errors.
    """

    focal: float
    fitting_focal: float
    focal_sigma: float
    point: tuple[float, float]
    fitting_point: tuple[float, float]
    point_sigma: float
    camera_fits: bool
    wrong_poses: tuple[PoseChange, ...]
    error_px: float
    fitting_error_px: float

    @property
    def complaints(self) -> tuple[Complaint, ...]:
        """Cameras and poses that do not fit, with the fitting ones."""
        found = []
        if not self.camera_fits:
            x, y = self.point
            fitting_x, fitting_y = self.fitting_point
            text = (
                f"a focal length of {self.fitting_focal:.1f} +- {self.focal_sigma:.1f} px and a "
                f"principal point of {fitting_x:.1f},{fitting_y:.1f} +- {self.point_sigma:.1f} px "
                f"fit the matches, not the given {self.focal:.1f} px and {x:.1f},{y:.1f}"
            )
            found.append(Complaint(text=text))
        for pose in self.wrong_poses:
            text = (
                f"the pose of {pose.name} is {pose.turn_deg:.1f} deg and {100 * pose.shift:.1f} % "
                "of its distance from one that fits the matches"
            )
            found.append(Complaint(text=text, view=pose.name))
        return tuple(found)


def try_cameras(model: Path) -> CameraTrial | None:
    """Adjust a model's matches with its cameras free, and compare; points seen once are left out.

    Parameters
    ----------
    model : folder of a COLMAP model whose images share a camera.

    Returns
    -------
    None if the test is impossible: several cameras, too few or too many views, too few points, or
    an adjustment that does not determine the camera.
    """
    given = read_reconstruction(model)
    for number in set(given.points3D) - _sampled(given):
        given.delete_point3D(number)
    try:
        return _compared(given)
    except (ValueError, RuntimeError) as error:  # what COLMAP says of a model that it cannot adjust
        logger.info("the cameras of %s cannot be tried: %s", model, error)
        return None


def _sampled(given: pycolmap.Reconstruction) -> set[int]:
    """Points seen at least twice: the first of each image, in one random order of all."""
    points = sorted(number for number, p in given.points3D.items() if p.track.length() > 1)
    order = np.random.default_rng(0).permutation(len(points)).tolist()
    turn = dict(zip(points, order, strict=True))
    kept: set[int] = set()
    for image in registered(given):
        seen = {point.point3D_id for point in image.get_observation_points2D()}
        kept.update(sorted(seen & turn.keys(), key=turn.__getitem__)[: TOL.num_points])
    return kept


def _compared(given: pycolmap.Reconstruction) -> CameraTrial | None:
    """The comparison; see :func:`try_cameras`."""
    if (
        len(given.cameras) != 1
        or not TOL.min_images <= given.num_reg_images() <= ADJUSTMENT.max_views
        or given.num_points3D() < TOL.min_points
    ):
        return None
    errors = _errors_of_images(given)
    adjusted = _adjusted(given, errors)
    if adjusted is None:
        return None
    fitting, sigma = adjusted
    camera = next(iter(fitting.cameras.values()))
    before = next(iter(given.cameras.values()))
    focal_at, point_at = camera.focal_length_idxs(), camera.principal_point_idxs()
    change = np.asarray(camera.params) - np.asarray(before.params)
    focal_change = np.abs(change[focal_at]) / camera.mean_focal_length()
    point_change = np.abs(change[point_at]) / camera.width
    fitting_errors = _errors_of_images(fitting)
    usual, usual_fitting = (float(np.median([*e.values()])) for e in (errors, fitting_errors))
    # Most views do not see the points where they are said to be: the camera was changed since.
    stale = usual > max(TOL.pose_ratio * usual_fitting, ADJUSTMENT.min_residual_px)
    certain = stale | (np.abs(change) > TOL.max_sigmas * sigma)
    wrong = (certain[focal_at] & (focal_change > TOL.min_focal_change)).any() or (
        certain[point_at] & (point_change > TOL.min_point_change)
    ).any()
    x, y = (float(before.params[i]) for i in point_at)
    fitting_x, fitting_y = (float(camera.params[i]) for i in point_at)
    return CameraTrial(
        focal=float(before.mean_focal_length()),
        fitting_focal=float(camera.mean_focal_length()),
        focal_sigma=float(sigma[focal_at].mean()),
        point=(x, y),
        fitting_point=(fitting_x, fitting_y),
        point_sigma=float(sigma[point_at].max()),
        camera_fits=not wrong,
        wrong_poses=_wrong_poses(given, fitting, errors),
        error_px=float(np.mean(list(errors.values()))),
        fitting_error_px=float(np.mean(list(fitting_errors.values()))),
    )


def _adjusted(
    given: pycolmap.Reconstruction, errors: dict[str, float]
) -> tuple[pycolmap.Reconstruction, Array] | None:
    """A model adjusted with its camera, and the deviations (P,) of the camera's parameters.

    None if the camera is not determined. ``errors`` are those of the given images.
    """
    fitting = copy.deepcopy(given)
    # First as if nothing were an outlier: a view with a wrong pose is one as a whole. Points hold
    # the frame, for a pose that does may be the wrong one.
    finite = [error for error in errors.values() if np.isfinite(error)]
    widest = 2 * max(finite, default=0.0)
    bundle, config = bundle_of(
        fitting,
        max(widest, ADJUSTMENT.loss_scale_px),
        free_intrinsics=False,
        free_principal_point=False,
    )
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.THREE_POINTS)
    bundle.ceres.solver_options.function_tolerance = TOL.max_cost_change
    last, last_config = bundle_of(
        fitting, ADJUSTMENT.loss_scale_px, free_intrinsics=True, free_principal_point=True
    )
    last.ceres.solver_options.function_tolerance = TOL.max_cost_change
    with quiet_colmap():
        pycolmap.create_default_bundle_adjuster(bundle, config, fitting).solve()
        pycolmap.create_default_bundle_adjuster(last, last_config, fitting).solve()
        fitting.update_point_3d_errors()
        camera = next(iter(fitting.cameras.values()))
        estimated = list(range(len(camera.params)))
        covariance = parameter_covariance(fitting, camera, estimated, True, ADJUSTMENT)
    if covariance is None or not np.isfinite(camera.params).all():
        return None
    return fitting, np.sqrt(np.diag(covariance))


def _errors_of_images(reconstruction: pycolmap.Reconstruction) -> dict[str, float]:
    """Median distance of each image's keypoints from where their points are seen, px."""
    errors = {}
    for image in registered(reconstruction):
        observed = image.get_observation_points2D()
        if not observed:
            continue
        points = np.array([reconstruction.points3D[p.point3D_id].xyz for p in observed])
        seen = image.cam_from_world() * points
        in_front = seen[:, 2] > 0
        camera = reconstruction.cameras[image.camera_id]
        places = np.full((len(points), 2), np.inf)
        places[in_front] = camera.img_from_cam(seen[in_front])
        xy = np.array([p.xy for p in observed])
        errors[image.name] = float(np.median(np.linalg.norm(places - xy, axis=1)))
    return errors


def _wrong_poses(
    given: pycolmap.Reconstruction,
    fitting: pycolmap.Reconstruction,
    errors: dict[str, float],
) -> tuple[PoseChange, ...]:
    """Views with a pose that does not fit while those of most others do.

    A turn, shift and scale that all have in common is one of the frame.
    """
    images, others = registered(given), registered(fitting)
    rotations, fitting_rotations = (
        np.array([image.cam_from_world().rotation.matrix() for image in some])
        for some in (images, others)
    )
    worlds = np.swapaxes(fitting_rotations, 1, 2) @ rotations
    # The elementwise median resists a few that are far off.
    common = nearest_rotation(np.median(worlds, axis=0))
    if common is None:
        return ()
    cosines = (np.einsum("kij,ij->k", worlds, common) - 1) / 2
    turns = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    centers, fitting_centers = (
        np.array([image.projection_center() for image in some]) for some in (images, others)
    )
    fits = np.array([errors.get(image.name, 0.0) for image in images])
    usual = float(np.median(fits))
    good = fits <= TOL.pose_ratio * usual
    try:
        back = align_points(fitting_centers[good], centers[good])
    except ValueError:  # on one line, or too few
        return ()
    middle = np.median([point.xyz for point in given.points3D.values()], axis=0)
    distances = np.linalg.norm(centers - middle, axis=1)
    shifts = np.linalg.norm(back * fitting_centers - centers, axis=1) / distances
    return tuple(
        PoseChange(name=image.name, turn_deg=float(turn), shift=float(shift))
        for image, turn, shift, fit in zip(images, turns, shifts, good, strict=True)
        if not fit and (turn > TOL.min_turn_deg or shift > TOL.min_shift)
    )
