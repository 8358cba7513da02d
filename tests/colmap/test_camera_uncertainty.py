"""What an estimated camera leaves open: on synthetic models, against how far cameras really err."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest
from scipy.spatial.transform import Rotation

from polmvs.colmap.camera_uncertainty import (
    CameraTolerances,
    adjuster_of,
    camera_uncertainty,
    parameter_covariance,
    pose_uncertainty,
)
from polmvs.geometry import align_points

NOISE_PX = 0.5
TRUE = (1280.0, 512.0, 384.0)  # f, cx, cy


def noisy_model(folder: Path, *, num_views: int, seed: int, single: bool = True) -> Path:
    """A model of exact geometry whose keypoints have noise."""
    pycolmap.set_random_seed(seed)
    settings = pycolmap.SyntheticDatasetOptions()
    settings.num_rigs = 1 if single else num_views
    settings.num_cameras_per_rig = 1
    settings.num_frames_per_rig = num_views if single else 1
    settings.num_points3D = 150
    settings.camera_model_id = pycolmap.CameraModelId.SIMPLE_PINHOLE
    settings.camera_params = list(TRUE)
    made = pycolmap.synthesize_dataset(settings)
    noise = pycolmap.SyntheticNoiseOptions()
    noise.point2D_stddev = NOISE_PX
    pycolmap.synthesize_noise(noise, made)
    folder.mkdir(parents=True)
    made.write_binary(str(folder))
    return folder


def adjusted(folder: Path, *, point: bool, focal: bool = True) -> float:
    """Have the camera estimated, written back; the error of its focal length, px."""
    model = pycolmap.Reconstruction(str(folder))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = point
    options.refine_focal_length = options.refine_extra_params = focal
    options.print_summary = False
    config = pycolmap.BundleAdjustmentConfig()
    for image_id in model.reg_image_ids():
        config.add_image(image_id)
    config.fix_gauge(pycolmap.BundleAdjustmentGauge.TWO_CAMS_FROM_WORLD)
    pycolmap.create_default_bundle_adjuster(options, config, model).solve()
    model.update_point_3d_errors()
    model.write_binary(str(folder))
    return float(next(iter(model.cameras.values())).params[0] - TRUE[0])


def test_the_focal_length_errs_as_stated(tmp_path: Path) -> None:
    ratios = []
    for seed in range(12):
        folder = noisy_model(tmp_path / str(seed), num_views=6, seed=seed)
        error = adjusted(folder, point=True)
        found = camera_uncertainty(folder)
        assert found is not None
        ratios.append(error / (found.focal * TRUE[0]))
    # Of twelve: the root mean square of a normal distribution's is within 0.6 to 1.4 (3 sigma).
    assert 0.5 < np.sqrt(np.mean(np.square(ratios))) < 1.5


def test_a_mode_is_what_an_adjustment_with_another_camera_gives(tmp_path: Path) -> None:
    """The focal length is one deviation longer, all else follows; without outliers."""
    t = CameraTolerances(loss_scale_px=20 * NOISE_PX)
    folder = noisy_model(tmp_path / "a", num_views=6, seed=4)
    before = pycolmap.Reconstruction(str(folder))
    adjuster_of(before, t, free=True, free_point=False).solve()
    before.update_point_3d_errors()
    before.write_binary(str(folder))
    camera = next(iter(before.cameras.values()))
    covariance = parameter_covariance(before, camera, [0], False, t)
    assert covariance is not None
    after = pycolmap.Reconstruction(str(folder))
    longer = next(iter(after.cameras.values()))
    longer.params = [camera.params[0] + np.sqrt(covariance[0, 0]), *camera.params[1:]]
    adjuster_of(after, t, free=False, free_point=False).solve()
    points, moved = (
        np.array([one.points3D[i].xyz for i in sorted(one.points3D)]) for one in (before, after)
    )
    centers, moved_centers = (
        np.array([one.image(i).projection_center() for i in sorted(one.reg_image_ids())])
        for one in (before, after)
    )
    displacement = align_points(moved_centers, centers) * moved - points
    found = camera_uncertainty(folder, tolerances=t)
    assert found is not None
    mode = found.modes[0] * np.sign((found.modes[0] * displacement).sum())  # its sign is free
    assert np.linalg.norm(mode - displacement) < 0.03 * np.linalg.norm(displacement)


def test_fewer_views_leave_more_open(tmp_path: Path) -> None:
    moved = {}
    for num in (3, 12):
        folder = noisy_model(tmp_path / str(num), num_views=num, seed=1)
        adjusted(folder, point=num > 3)
        found = camera_uncertainty(folder)
        assert found is not None
        assert found.modes.shape[1:] == (150, 3)
        moved[num] = np.median(np.sqrt(np.square(found.modes).sum(axis=(0, 2))))
    assert moved[3] > 2 * moved[12]


def test_a_principal_point_that_was_not_estimated_counts(tmp_path: Path) -> None:
    folder = noisy_model(tmp_path / "a", num_views=4, seed=2)
    adjusted(folder, point=False)
    known = camera_uncertainty(folder, tolerances=CameraTolerances(principal_point_sigma=1e-9))
    unknown = camera_uncertainty(folder)
    assert known is not None
    assert unknown is not None
    assert len(unknown.modes) == 3  # the focal length, and both coordinates of the point
    assert np.square(unknown.modes).sum() > 2 * np.square(known.modes).sum()


@pytest.mark.parametrize("case", ["several cameras", "too many views"])
def test_what_is_not_estimated_is_none(tmp_path: Path, case: str) -> None:
    single = case != "several cameras"
    folder = noisy_model(tmp_path / "a", num_views=4, seed=3, single=single)
    limit = CameraTolerances(max_views=3 if single else 40)
    assert camera_uncertainty(folder, tolerances=limit) is None


def aligned_poses(folder: Path, true: pycolmap.Reconstruction) -> np.ndarray:
    """Turns about the world's axes and moves (V, 6) of the poses, the centres laid on the true."""
    model = pycolmap.Reconstruction(str(folder))
    ids = sorted(model.reg_image_ids(), key=lambda i: model.image(i).name)
    centers, true_centers = (
        np.array([one.image(i).projection_center() for i in ids]) for one in (model, true)
    )
    back = align_points(centers, true_centers)
    found = []
    for i, center, true_center in zip(ids, centers, true_centers, strict=True):
        rotation, true_rotation = (
            one.image(i).cam_from_world().rotation.matrix() for one in (model, true)
        )
        turned = Rotation.from_matrix((rotation @ back.rotation.T).T @ true_rotation)
        found.append(np.concatenate([turned.as_rotvec(), back * center - true_center]))
    return np.array(found)


def test_poses_err_as_stated(tmp_path: Path) -> None:
    """Errors of six poses, twelve times, in their stated deviations."""
    squares = []
    for seed in range(12):
        folder = noisy_model(tmp_path / str(seed), num_views=6, seed=seed)
        true = pycolmap.Reconstruction(str(folder))  # noise is in the keypoints alone
        adjusted(folder, point=False, focal=False)
        found = pose_uncertainty(folder)
        assert found is not None
        assert found.shape == (6, 6, 6)
        errors = aligned_poses(folder, true)
        for part in (slice(3), slice(3, 6)):
            variance = np.trace(found[:, part, part], axis1=1, axis2=2)
            squares.append([(errors[:, part] ** 2).sum(axis=1), variance])
    turns, moves = np.array(squares[::2]), np.array(squares[1::2])
    for errors, variance in ((turns[:, 0], turns[:, 1]), (moves[:, 0], moves[:, 1])):
        # Of 12 x 6 errors of three coordinates: within a quarter (3 sigma), were they independent.
        assert 0.7 < np.sqrt(errors.sum() / variance.sum()) < 1.4


def test_poses_of_many_views_have_none(tmp_path: Path) -> None:
    folder = noisy_model(tmp_path / "a", num_views=4, seed=3)
    assert pose_uncertainty(folder, tolerances=CameraTolerances(max_views=3)) is None
