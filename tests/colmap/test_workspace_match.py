"""Does a workspace belong to a capture: poses and images that do and that do not."""

import shutil
from dataclasses import replace

import cv2
import numpy as np
import pytest
from dense_scenes import board_scene
from scenes import random_rotation

from polmvs.colmap.cameras import rescaled_camera
from polmvs.colmap.dense_workspace import (
    common_views,
    image_correlation,
    open_dense_workspace,
    require_matching_images,
    require_same_frame,
)
from polmvs.colmap.undistort import undistorted_camera, warp_image
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform
from polmvs.io.images import write_png


@pytest.fixture(scope="module")
def scene():
    return board_scene()


@pytest.fixture(scope="module")
def folder(scene, tmp_path_factory):
    return scene.write(tmp_path_factory.mktemp("checks") / "workspace", lambda _: None)


@pytest.fixture(scope="module")
def workspace(folder):
    return open_dense_workspace(folder)


def with_poses(model, change):
    views = [
        replace(view, cam_from_world=change(i, view.cam_from_world))
        for i, view in enumerate(model.views)
    ]
    return replace(model, views=tuple(views))


def turned(degrees):
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    return np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])


def test_the_same_frame(workspace, scene):
    require_same_frame(workspace, scene.model)
    # Rounding to six digits, as text files do.
    rounded = with_poses(
        scene.model, lambda _, p: RigidTransform(p.rotation.round(6), p.translation.round(6))
    )
    require_same_frame(workspace, rounded)


@pytest.mark.parametrize("view", [0, 3])
def test_one_view_is_elsewhere(workspace, scene, view):
    def change(i, pose):
        return RigidTransform(
            pose.rotation, pose.translation + np.array([0.01 * (i == view), 0, 0])
        )

    with pytest.raises(DataError, match=rf"another frame.* in 00{view}.png, the worst of 5"):
        require_same_frame(workspace, with_poses(scene.model, change))


def test_the_bound_is_half_a_pixel_of_turn_or_shift(workspace, scene):
    half_px = np.degrees(0.5 / 120)
    for scale, fine in ((0.8, True), (1.2, False)):
        by_turn = with_poses(
            scene.model,
            lambda i, p, s=scale: RigidTransform(
                *(turned(half_px * s * (i == 1)) @ part for part in (p.rotation, p.translation))
            ),
        )
        by_shift = with_poses(
            scene.model,
            # The scene's points are 0.5 away, give or take 10 %.
            lambda i, p, s=scale: RigidTransform(
                p.rotation, p.translation + np.array([0, s * 0.5 * 0.5 / 120 * (i == 1), 0])
            ),
        )
        for model in (by_turn, by_shift):
            if fine:
                require_same_frame(workspace, model)
            else:
                with pytest.raises(DataError, match=r"001\.png"):
                    require_same_frame(workspace, model)


def moved_by_similarity(model, scale, rotation, translation):
    """The same cameras with the world in another frame."""

    def change(_, pose):
        center = scale * rotation @ pose.inverse().translation + translation
        turn = pose.rotation @ rotation.T
        return RigidTransform(turn, -turn @ center)

    return with_poses(model, change)


def test_similar_models_are_told(workspace, scene):
    rotation = random_rotation(np.random.default_rng(3))
    model = moved_by_similarity(scene.model, 2.5, rotation, np.array([1.0, 2.0, 3.0]))
    with pytest.raises(DataError, match=r"they agree after a similarity \(scale 0\.4, rotation"):
        require_same_frame(workspace, model)
    shifted = moved_by_similarity(scene.model, 1.0, np.eye(3), np.array([1.0, 0.0, 0.0]))
    with pytest.raises(DataError, match=r"scale 1, rotation .*e-?\d* degrees|rotation 0 degrees"):
        require_same_frame(workspace, shifted)


def test_unrelated_models_are_told(workspace, scene):
    rng = np.random.default_rng(0)
    model = with_poses(
        scene.model, lambda *_: RigidTransform(random_rotation(rng), rng.normal(size=3))
    )
    with pytest.raises(DataError, match="after a similarity still"):
        require_same_frame(workspace, model)


def test_two_views_do_not_determine_a_similarity(workspace, scene):
    model = moved_by_similarity(scene.model, 2.0, np.eye(3), np.zeros(3))
    model = replace(model, views=model.views[:2])
    with pytest.raises(DataError, match=r"worst of 2 views\. Give"):
        require_same_frame(workspace, model)


def test_names_match_by_stem(workspace, scene):
    views = tuple(replace(v, name=v.name.replace(".png", ".tif")) for v in scene.views[:3])
    pairs = common_views(workspace, replace(scene.model, views=views))
    names = [(pair.item.view.name, pair.view.name) for pair in pairs]
    assert names == [(f"00{i}.png", f"00{i}.tif") for i in range(3)]
    with pytest.raises(DataError, match="none match"):
        common_views(workspace, replace(scene.model, views=(replace(views[0], name="x.png"),)))


def test_matching_images(workspace, scene):
    assert require_matching_images(workspace, scene.model, scene.image) > 0.99


@pytest.mark.parametrize("gamma", [0.45, 2.2])
def test_gamma_and_exposure_do_not_matter(workspace, scene, gamma):
    def other(name):
        return np.rint(200 * (scene.image(name) / 255.0) ** gamma).astype(np.uint8)

    assert require_matching_images(workspace, scene.model, other) > 0.95


@pytest.mark.parametrize("options", [{"max_image_size": 90}, {"blank_pixels": 1.0}])
def test_other_sizes_and_blank_borders(scene, tmp_path, options):
    folder = scene.write(tmp_path / "workspace", lambda _: None, **options)
    opened = open_dense_workspace(folder)
    assert require_matching_images(opened, scene.model, scene.image) > 0.98


def test_workspace_of_the_full_mosaic(scene):
    """Twice the size, with the 2x2 pattern of the polarizers in it."""
    view = scene.views[0]
    image = scene.image("000.png")
    double = cv2.resize(image, None, fx=2, fy=2, interpolation=cv2.INTER_LINEAR).astype(float)
    double *= np.tile([[1.2, 0.9], [0.8, 1.1]], (128, 160))
    camera = rescaled_camera(view.camera, 320, 256)
    target = undistorted_camera(camera)
    undistorted, _ = warp_image(double.clip(0, 255).astype(np.uint8), camera, target)
    assert image_correlation(undistorted.astype(np.uint8), target, image, view) > 0.9


def test_images_of_another_view_mirrored_or_negative(workspace, scene):
    wrong = {
        "another": lambda name: scene.image(f"00{(int(name[2]) + 1) % 5}.png"),
        "mirrored": lambda name: np.ascontiguousarray(scene.image(name)[:, ::-1]),
        "negative": lambda name: 255 - scene.image(name),
        "moved": lambda name: np.roll(scene.image(name), 15, axis=1),
        "flat": lambda name: np.full_like(scene.image(name), 100),
    }
    for load in wrong.values():
        with pytest.raises(DataError, match="do not match the polarization images") as caught:
            require_matching_images(workspace, scene.model, load)
        assert "000.png" in str(caught.value)


def test_a_single_wrong_image_is_found(folder, scene, tmp_path):
    copy = shutil.copytree(folder, tmp_path / "workspace")
    item = open_dense_workspace(copy).views[3]
    write_png(item.image, np.ascontiguousarray(item.load_image()[::-1]))
    with pytest.raises(DataError, match=r"003\.png: undistorted images do not match"):
        require_matching_images(open_dense_workspace(copy), scene.model, scene.image)
