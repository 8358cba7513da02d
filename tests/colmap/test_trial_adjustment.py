"""Wrong cameras are told from right ones by the matches, and what would fit is said."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import tracks_at
from scipy.spatial.transform import Rotation

from polmvs.camera import PinholeCamera
from polmvs.colmap.models import write_model
from polmvs.colmap.trial_adjustment import try_cameras
from polmvs.geometry import RigidTransform
from polmvs.scene import SparseModel, View
from polmvs.synthetic.captures import ring_of_views

NOISE_PX = 0.2
CAMERA = PinholeCamera(width=640, height=512, fx=480.0, fy=480.0, cx=320.0, cy=256.0)
# Not looking at one place: a principal point is told by views that are rolled and see depth.
VIEWS = [
    replace(view, cam_from_world=RigidTransform(roll @ pose.rotation, roll @ pose.translation))
    for index, view in enumerate(
        ring_of_views(8, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=45, roll_deg=20)
    )
    for pose in [view.cam_from_world]
    for roll in [Rotation.from_euler("z", 50 * index, degrees=True).as_matrix()]
]


class Scene:
    """What ``tracks_at`` asks for."""

    views = VIEWS


@pytest.fixture(scope="module")
def sound() -> SparseModel:
    """True cameras, and keypoints with noise."""
    rng = np.random.default_rng(0)
    tracks = tracks_at(Scene(), rng.uniform(-0.1, 0.1, (250, 3)))
    noise = rng.normal(0, NOISE_PX, tracks.obs_xy.shape)
    tracks = replace(tracks, obs_xy=tracks.obs_xy + noise)
    return SparseModel(views=tuple(VIEWS), tracks=tracks, unregistered=())


def trial_of(model: SparseModel, folder: Path):
    write_model(model, folder)
    found = try_cameras(folder)
    assert found is not None
    return found


def with_camera(model: SparseModel, **changes: float) -> SparseModel:
    views = (replace(view, camera=replace(CAMERA, **changes)) for view in model.views)
    return replace(model, views=tuple(views))


def with_pose(model: SparseModel, index: int, pose: RigidTransform) -> SparseModel:
    views = list(model.views)
    views[index] = replace(views[index], cam_from_world=pose)
    return replace(model, views=tuple(views))


def test_right_cameras_fit(sound: SparseModel, tmp_path: Path) -> None:
    found = trial_of(sound, tmp_path / "model")
    assert found.camera_fits
    assert found.wrong_poses == found.complaints == ()
    assert found.fitting_error_px == pytest.approx(
        NOISE_PX * 1.18, rel=0.15
    )  # of a Rayleigh median
    assert abs(found.fitting_focal - CAMERA.fx) < 4 * found.focal_sigma < 8


@pytest.mark.parametrize(
    "changes",
    [
        *({"fx": factor * CAMERA.fx, "fy": factor * CAMERA.fy} for factor in (0.9, 1.03, 1.1)),
        *({"cx": CAMERA.cx + 6.0}, {"cy": CAMERA.cy - 6.0}),
    ],
)
def test_wrong_cameras_do_not_and_the_right_one_is_named(
    sound: SparseModel, tmp_path: Path, changes: dict[str, float]
) -> None:
    found = trial_of(with_camera(sound, **changes), tmp_path / "model")
    assert not found.camera_fits
    assert found.wrong_poses == ()
    assert abs(found.fitting_focal - CAMERA.fx) < 4 * found.focal_sigma
    right = np.array([CAMERA.cx, CAMERA.cy])
    assert np.abs(np.array(found.fitting_point) - right).max() < 4 * found.point_sigma
    (complaint,) = found.complaints
    text = complaint.text
    assert f"a focal length of {found.fitting_focal:.1f}" in text
    assert f"not the given {changes.get('fx', CAMERA.fx):.1f} px" in text
    assert found.fitting_error_px < found.error_px


@pytest.mark.parametrize("index", [0, 1, 5])
@pytest.mark.parametrize("degrees", [1.0, 5.0])
def test_one_turned_pose(sound: SparseModel, tmp_path: Path, index: int, degrees: float) -> None:
    view = sound.views[index]
    axis = np.array([1.0, 0.5, 0.2]) / np.linalg.norm([1.0, 0.5, 0.2])
    turn = Rotation.from_rotvec(np.radians(degrees) * axis).as_matrix()
    pose = view.cam_from_world
    moved = RigidTransform(turn @ pose.rotation, turn @ pose.translation)
    found = trial_of(with_pose(sound, index, moved), tmp_path / "model")
    assert found.camera_fits
    (wrong,) = found.wrong_poses
    assert wrong.name == view.name
    assert wrong.turn_deg == pytest.approx(degrees, abs=0.3)
    assert wrong.shift < 0.02
    assert f"the pose of {view.name} is" in found.complaints[0].text
    assert found.complaints[0].view == view.name


def test_one_camera_that_stands_farther_away(sound: SparseModel, tmp_path: Path) -> None:
    view = sound.views[2]
    rotation = view.cam_from_world.rotation
    center = 1.04 * view.center_in_world
    found = trial_of(
        with_pose(sound, 2, RigidTransform(rotation, -rotation @ center)), tmp_path / "model"
    )
    assert found.camera_fits
    (wrong,) = found.wrong_poses
    assert wrong.name == view.name
    assert wrong.shift == pytest.approx(0.04 / 1.04, abs=0.005)
    assert wrong.turn_deg < 0.3


def test_another_frame_and_scale_change_nothing(sound: SparseModel, tmp_path: Path) -> None:
    turn = Rotation.from_euler("xyz", [20, 130, 70], degrees=True).as_matrix()
    scale, shift = 7.0, np.array([5.0, -3.0, 2.0])
    views = tuple(
        replace(
            view,
            cam_from_world=RigidTransform(
                view.cam_from_world.rotation @ turn.T,
                scale * view.cam_from_world.translation
                - view.cam_from_world.rotation @ turn.T @ shift,
            ),
        )
        for view in sound.views
    )
    points = scale * sound.tracks.points_in_world @ turn.T + shift
    tracks = replace(sound.tracks, points_in_world=points)
    found = trial_of(replace(sound, views=views, tracks=tracks), tmp_path / "model")
    assert found.complaints == ()
    assert found.error_px == pytest.approx(trial_of(sound, tmp_path / "first").error_px, rel=1e-4)


def test_too_little_to_tell(sound: SparseModel, tmp_path: Path) -> None:
    tracks = tracks_at(Scene(), np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3)))
    write_model(replace(sound, tracks=tracks), tmp_path / "few")
    assert try_cameras(tmp_path / "few") is None
    views: tuple[View, ...] = (
        replace(sound.views[0], camera=replace(CAMERA, fx=1.2 * CAMERA.fx)),
        *sound.views[1:],
    )
    write_model(replace(sound, views=views), tmp_path / "two")
    assert try_cameras(tmp_path / "two") is None
