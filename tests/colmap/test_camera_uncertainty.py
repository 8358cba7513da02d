"""What an estimated camera leaves open: on synthetic models, against how far cameras really err."""

from pathlib import Path

import numpy as np
import pycolmap
import pytest

from polmvs.colmap.camera_uncertainty import CameraTolerances, camera_uncertainty

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


def adjusted(folder: Path, *, point: bool) -> float:
    """Have the camera estimated, written back; the error of its focal length, px."""
    model = pycolmap.Reconstruction(str(folder))
    options = pycolmap.BundleAdjustmentOptions()
    options.refine_principal_point = point
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
