"""A part that turns before a background that stands still."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest
from printed_images import CAMERA, INTRINSICS, write_printed_images

from polmvs.camera import pixel_centers
from polmvs.colmap.models import read_model
from polmvs.colmap.sfm import run_sfm
from polmvs.colmap.static_features import find_static
from polmvs.config import SfmOptions
from polmvs.errors import OptionError
from polmvs.io.images import read_gray
from polmvs.pipeline.stages.sfm import find_model
from polmvs.poses.alignment import align_views
from polmvs.scene import SparseModel, View

NUM_VIEWS = 16
TABLE_RADIUS = 0.4


@pytest.fixture(scope="module")
def turntable(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[View]]:
    """Printed part and table, and a fixed textured wall wherever the table ends."""
    folder = tmp_path_factory.mktemp("turntable")
    views = write_printed_images(folder, NUM_VIEWS)
    rng = np.random.default_rng(0)
    wall = cv2.GaussianBlur(rng.uniform(0, 255, (CAMERA.height, CAMERA.width)), (0, 0), 1.5)
    wall = np.clip(128 + 4 * (wall - wall.mean()), 0, 255)
    for view in views:
        rays = view.rays_in_world(pixel_centers(CAMERA.width, CAMERA.height))
        center = view.center_in_world
        along = -center[2] / np.minimum(rays[..., 2], -1e-9)
        on_plane = center[:2] + along[..., None] * rays[..., :2]
        off_table = np.linalg.norm(on_plane, axis=-1) > TABLE_RADIUS
        image = cv2.imread(str(folder / view.name), cv2.IMREAD_UNCHANGED)
        noisy = wall + rng.normal(0, 2, wall.shape)
        image[off_table] = np.clip(noisy, 0, 255).astype(np.uint8)[off_table]
        assert 0.1 < off_table.mean() < 0.9
        cv2.imwrite(str(folder / view.name), image)
        masks = folder / "masks"
        masks.mkdir(exist_ok=True)
        cv2.imwrite(str(masks / view.name), 255 * (~off_table).astype(np.uint8))
    return folder, views


def largest_error(model: SparseModel, views: list[View]) -> float:
    """Of a camera's place, as a share of its distance."""
    truth = {view.name: view for view in views}
    similarity, _ = align_views(model.views, truth, source="test")
    errors = [
        np.linalg.norm(similarity * view.center_in_world - truth[view.name].center_in_world)
        / np.linalg.norm(truth[view.name].center_in_world)
        for view in model.views
    ]
    return float(max(errors))


def test_the_background_is_found_and_left_out(turntable, tmp_path: Path, caplog) -> None:
    folder, views = turntable
    names = [view.name for view in views]
    options = SfmOptions(intrinsics=INTRINSICS)
    model = run_sfm(folder, names, tmp_path / "work", tmp_path / "sparse", options)
    assert "a background stands still" in caplog.text
    assert len(model.views) >= NUM_VIEWS - 1
    # A degree of the orbit: the table is small and the images are of 300 px.
    assert largest_error(model, views) < 0.02


@pytest.mark.slow
def test_features_inside_masks_alone_find_the_turning_poses(turntable, tmp_path: Path) -> None:
    """Without them, and without the search for a background, the camera seems to stand still."""
    folder, views = turntable
    names = [view.name for view in views][3:12]
    options = SfmOptions(
        intrinsics=INTRINSICS, static_background=False, feature_masks=folder / "masks"
    )
    find_model(folder, names, tmp_path / "sparse", options)
    model = read_model(tmp_path / "sparse")
    assert len(model.views) >= len(names) - 1
    assert largest_error(model, views) < 0.02
    for index, of_view in enumerate(model.tracks.of_views(len(model.views))):
        mask = read_gray(folder / "masks" / model.views[index].name)
        col, row = np.floor(model.tracks.obs_xy[of_view]).astype(int).T
        assert (mask[row, col] > 0).all()


@pytest.mark.slow
def test_a_camera_that_moves_has_no_static_background(tmp_path: Path, caplog) -> None:
    views = write_printed_images(tmp_path, 5)
    names = [view.name for view in views]
    options = SfmOptions(intrinsics=INTRINSICS)
    run_sfm(tmp_path, names, tmp_path / "work", tmp_path / "sparse", options)
    assert "stands still" not in caplog.text


def test_static_keypoints_are_told_by_place_and_look() -> None:
    rng = np.random.default_rng(0)
    wall, looks = rng.uniform(0, 500, (60, 2)), rng.uniform(0, 255, (60, 128)).astype(np.uint8)
    places, descriptors = [], []
    for _ in range(6):
        places.append(np.concatenate([wall + rng.normal(0, 0.3, wall.shape),
                                      rng.uniform(0, 500, (100, 2))]))  # fmt: skip
        turning = rng.uniform(0, 255, (100, 128)).astype(np.uint8)
        descriptors.append(np.concatenate([looks, turning]))
    for out in find_static(places, descriptors):
        assert out[:60].mean() > 0.95
        assert out[60:].mean() < 0.05
    moved = [place + 20 * index for index, place in enumerate(places)]
    assert find_static(moved, descriptors) is None
    assert find_static(places[:2], descriptors[:2]) is None
    assert find_static([np.zeros((0, 2))] * 4, [np.zeros((0, 128), np.uint8)] * 4) is None


def test_feature_masks_need_features_to_find() -> None:
    masks = Path("masks")
    with pytest.raises(OptionError, match=r"feature_masks.*sfm.database"):
        SfmOptions(feature_masks=masks, database=Path("a.db"))
    with pytest.raises(OptionError, match=r"feature_masks.*sfm.sparse"):
        SfmOptions(feature_masks=masks, sparse=Path("model"))
