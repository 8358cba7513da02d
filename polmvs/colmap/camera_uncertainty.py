"""Uncertainty of estimated cameras and poses.

Few views determine a camera badly, and an error of its focal length or principal point bends the
whole model although every image fits. The covariance of bundle adjustment gives the deviation of
independent combinations of the camera's parameters. Where the camera changes by one standard
deviation along one of them, poses and points follow, to first order: with the Jacobians ``J_c`` of
the residuals by the camera and ``J`` by poses and points, the change ``c`` moves them by the
solution ``d`` of ``J^T J d = -J^T J_c c``. The displacement of the points is a *mode*, and the
squares of the modes add up to the variance at any point. The covariance of the poses is taken after
an alignment of the camera centres.
"""

from __future__ import annotations

import copy
import logging
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy import sparse

from polmvs.arrays import Array
from polmvs.colmap.models import read_reconstruction, registered
from polmvs.colmap.sfm import SfmTolerances, bundle_of
from polmvs.geometry import align_points
from polmvs.scene import KEYPOINT_SIGMA_PX

logger = logging.getLogger(__name__)

DIFFERENCE = 1e-6  # relative step of a central difference: near the cube root of the precision
GAUGE = 1e-10  # relative eigenvalue below which a change leaves all residuals as they are


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
    max_views : of a model: the covariance is dense, and the camera of so many views is well known.
        Guess.
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
    steps = np.zeros((len(estimated), len(names)))
    steps[:, estimated] = _principal_steps(covariance)
    linear = _linearized(reconstruction, camera, tolerances)
    if not np.isfinite(linear.of_params).all():  # a distortion that is not defined at a point
        return None
    responses = linear.responses(steps, [])
    if not freed:  # it was kept at the centre, which is known as well as sensors are mounted
        sigma = tolerances.principal_point_sigma * camera.width
        centered = sigma * np.eye(len(names))[point]
        responses += linear.responses(centered, [i for i in names if i not in point])
    modes = np.array([_displacements(reconstruction, response) for response in responses])
    if not np.isfinite(modes).all():
        return None
    changes = [response.params[camera.focal_length_idxs()].mean() for response in responses]
    focal = float(np.linalg.norm(changes)) / camera.mean_focal_length()
    return CameraUncertainty(focal=focal, modes=modes)


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


@dataclass(frozen=True, eq=False)
class _Response:
    """Changes of a model that follow from a change of its camera.

    Attributes
    ----------
    params : (P,) of the camera, the given change included.
    centers : (V, 3) of the camera centres, sorted by name, world.
    points : (T, 3) of the points in the order of their ids, world.
    """

    params: Array
    centers: Array
    points: Array


@dataclass(frozen=True, eq=False)
class _Linearized:
    """Jacobians of the K residuals of a model's keypoints, times the roots of their weights.

    Attributes
    ----------
    of_params : (2 K, P)
    of_poses : (2 K, 6 V) by a turn and a move of each camera in its own frame.
    of_points : (2 K, 3 T)
    rotations : (V, 3, 3), world to camera.
    """

    of_params: Array
    of_poses: sparse.csr_array
    of_points: sparse.csr_array
    rotations: Array

    def responses(self, steps: Array, followers: Sequence[int]) -> list[_Response]:
        """What follows from each of some changes (M, P); parameters ``followers`` follow as well.

        The points are eliminated (Schur complement). A similarity of the whole model leaves all
        residuals as they are; of all solutions the one of least norm is taken.
        """
        followed = sparse.csr_array(self.of_params[:, followers])
        cameras = sparse.csr_array(sparse.hstack([self.of_poses, followed]))
        inverse = self._inverse_of_points
        across = sparse.csr_array(cameras.T @ self.of_points)
        eliminated = sparse.csr_array(across @ inverse)
        matrix = (cameras.T @ cameras - eliminated @ across.T).toarray()
        residuals = self.of_params @ steps.T
        of_points = self.of_points.T @ residuals
        right = cameras.T @ residuals - eliminated @ of_points
        # Turns, moves and focal lengths have different units.
        scale = 1 / np.sqrt(np.maximum(np.diag(matrix), 1e-300))[:, None]
        moved = -scale * (
            np.linalg.pinv(scale * matrix * scale.T, rcond=GAUGE, hermitian=True) @ (scale * right)
        )
        points = -(inverse @ (of_points + across.T @ moved)).T.reshape(len(steps), -1, 3)
        num = self.of_poses.shape[1]
        moves = moved[:num].T.reshape(len(steps), -1, 6)[..., 3:]
        centers = -np.einsum("vji,mvj->mvi", self.rotations, moves)
        params = np.array(steps, np.float64)
        params[:, followers] += moved[num:].T
        return [_Response(*each) for each in zip(params, centers, points, strict=True)]

    @cached_property
    def _inverse_of_points(self) -> sparse.bsr_array:
        """Inverse of the block diagonal matrix of the points; 0 along what no view shows."""
        num = self.of_points.shape[1] // 3
        blocks = np.zeros((num, 3, 3))
        normal = sparse.bsr_array(self.of_points.T @ self.of_points, blocksize=(3, 3))
        blocks[normal.indices] = normal.data  # one block a row, where there is any
        inverse = np.linalg.pinv(blocks, rcond=GAUGE, hermitian=True)
        return sparse.bsr_array((inverse, np.arange(num), np.arange(num + 1)))


def _linearized(
    reconstruction: pycolmap.Reconstruction, camera: pycolmap.Camera, t: CameraTolerances
) -> _Linearized:
    """The residuals of a model about its solution, under the adjustment's Cauchy loss."""
    images = registered(reconstruction)
    number = {point_id: index for index, point_id in enumerate(sorted(reconstruction.points3D))}
    of_params, of_poses, of_points, rotations = [], [], [], []
    for index, image in enumerate(images):
        pose = image.cam_from_world()
        rotation = np.asarray(pose.rotation.matrix(), np.float64)
        rotations.append(rotation)
        observed = image.get_observation_points2D()
        places = [reconstruction.points3D[point.point3D_id].xyz for point in observed]
        seen = pose * np.array(places).reshape(-1, 3)
        shown = np.flatnonzero(seen[:, 2] > 0)
        if not len(shown):
            continue
        seen, xy = seen[shown], np.array([observed[k].xy for k in shown])
        by_place, by_params = _jacobians(camera, seen)
        square = ((np.asarray(camera.img_from_cam(seen)) - xy) ** 2).sum(axis=1)
        root = np.sqrt(1 / (1 + square / t.loss_scale_px**2))[:, None, None]
        turns = np.cross(np.eye(3), seen[:, None])  # (K, 3, 3), rows: d seen / d turn about an axis
        by_pose = np.concatenate([by_place @ np.swapaxes(turns, 1, 2), by_place], axis=2)
        of_params.append((root * by_params).reshape(-1, by_params.shape[2]))
        of_poses.append(_spread(root * by_pose, np.full(len(shown), index), len(images)))
        which = np.array([number[observed[k].point3D_id] for k in shown], np.int64)
        of_points.append(_spread(root * (by_place @ rotation), which, len(number)))
    return _Linearized(
        np.concatenate(of_params),
        sparse.csr_array(sparse.vstack(of_poses)),
        sparse.csr_array(sparse.vstack(of_points)),
        np.array(rotations),
    )


def _jacobians(camera: pycolmap.Camera, seen: Array) -> tuple[Array, Array]:
    """Changes of pixels by the place (K, 2, 3) and by the camera's parameters (K, 2, P).

    They are central differences.

    Parameters
    ----------
    seen : (K, 3) before the camera.
    """

    def pixels(seen: Array, params: Array) -> Array:
        other = copy.deepcopy(camera)
        other.params = params.tolist()
        return np.asarray(other.img_from_cam(seen), np.float64)

    params = np.asarray(camera.params, np.float64)
    by_place, by_params = [], []
    for axis in np.eye(3):
        reach = DIFFERENCE * seen[:, 2:]
        change = pixels(seen + reach * axis, params) - pixels(seen - reach * axis, params)
        by_place.append(change / (2 * reach))
    for axis, value in zip(np.eye(len(params)), params, strict=True):
        size = DIFFERENCE * max(abs(float(value)), 1.0)
        change = pixels(seen, params + size * axis) - pixels(seen, params - size * axis)
        by_params.append(change / (2 * size))
    return np.stack(by_place, axis=2), np.stack(by_params, axis=2)


def _spread(blocks: Array, which: NDArray[np.int64], num: int) -> sparse.bsr_array:
    """Sparse matrix (2 K, D num) with the block (2, D) of each row in the columns of its number."""
    shape = (2 * len(blocks), blocks.shape[2] * num)
    return sparse.bsr_array((blocks, which, np.arange(len(blocks) + 1)), shape=shape)


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


def _displacements(reconstruction: pycolmap.Reconstruction, response: _Response) -> Array:
    """Displacements (T, 3) of the points after the cameras are aligned."""
    ids = sorted(reconstruction.points3D)
    points = np.array([reconstruction.points3D[i].xyz for i in ids], np.float64).reshape(-1, 3)
    images = registered(reconstruction)
    centers = np.array([image.projection_center() for image in images], np.float64)
    others, other_centers = points + response.points, centers + response.centers
    try:
        back = align_points(other_centers, centers)
    except ValueError:  # on one line: the turn about it is told by the points
        back = align_points(np.vstack([other_centers, others]), np.vstack([centers, points]))
    return np.asarray(back * others - points, np.float64)
