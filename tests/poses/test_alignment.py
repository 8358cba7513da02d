"""Cameras of one capture are told from others by their orientations as well."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA
from scipy.spatial.transform import Rotation

from polmvs.errors import DataError
from polmvs.geometry import RigidTransform, SimilarityTransform
from polmvs.poses.alignment import AlignmentTolerances, align_cameras, align_views
from polmvs.scene import View
from polmvs.synthetic.captures import ring_of_views

VIEWS = ring_of_views(6, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=45, roll_deg=20)


def turned(view: View, degrees: float) -> View:
    """The same centre, turned about the camera's own axis of sight."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    pose = view.cam_from_world
    moved = RigidTransform(turn @ pose.rotation, turn @ pose.translation)
    return replace(view, cam_from_world=moved)


def test_centres_that_fit_do_not_excuse_orientations_that_do_not() -> None:
    most = AlignmentTolerances().max_turn_deg
    truth = {view.name: view for view in VIEWS}
    near = [turned(view, most - 1) for view in VIEWS]
    transform, found = align_views(near, truth)
    assert found.rotation_error_median_deg == pytest.approx(most - 1, abs=1e-6)
    np.testing.assert_allclose(transform.rotation, np.eye(3), atol=1e-9)
    for degrees in (most + 1, 90.0, 180.0):
        with pytest.raises(DataError, match="deg apart"):
            align_views([turned(view, degrees) for view in VIEWS], truth)


@pytest.mark.parametrize(
    ("num", "num_wrong"), [(4, 0), (5, 1), (6, 2), (7, 3), (9, 4), (13, 6), (40, 19)]
)
def test_wrong_cameras_below_half_change_nothing(num: int, num_wrong: int) -> None:
    """Exact centres: whatever fewer than half of them are, the others tell the similarity."""
    for seed in range(3):
        rng = np.random.default_rng([num, seed])
        truth = SimilarityTransform(2.5, Rotation.random(rng=rng).as_matrix(), rng.normal(size=3))
        centers = rng.normal(size=(num, 3))
        true_centers = truth * centers
        wrong = rng.permutation(num)[:num_wrong]
        true_centers[wrong] += rng.uniform(5, 50, (num_wrong, 1)) * rng.normal(size=(num_wrong, 3))
        found, used = align_cameras(centers, true_centers)
        assert sorted(np.flatnonzero(~used)) == sorted(wrong)
        assert found.scale == pytest.approx(truth.scale, rel=1e-9)
        np.testing.assert_allclose(found.rotation, truth.rotation, atol=1e-9)
        np.testing.assert_allclose(found * centers, truth * centers, atol=1e-8)


def test_few_cameras_are_all_used() -> None:
    """Of three or four no majority is told from the rest."""
    rng = np.random.default_rng(0)
    for num in (3, 4):
        centers = rng.normal(size=(num, 3))
        used = align_cameras(centers, centers + 0.3 * rng.normal(size=(num, 3)))[1]
        assert used.all()


def test_figures_of_an_alignment_are_those_of_its_cameras() -> None:
    """One camera of seven is 100 m off; the others are 0.1 mm off along the axis, both ways."""
    views = ring_of_views(7, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=45)
    truth = {view.name: view for view in views}
    scaled = SimilarityTransform(0.25, np.eye(3), np.zeros(3))  # the estimated world is so small

    def seen(view: View, off: np.ndarray) -> View:
        rotation = view.cam_from_world.rotation
        center = scaled * (view.center_in_world + off)
        return replace(view, cam_from_world=RigidTransform(rotation, -rotation @ center))

    moved = [seen(view, np.array([0, 0, 1e-4 * (-1) ** k])) for k, view in enumerate(views[:6])]
    moved.append(seen(views[6], np.array([100.0, 0, 0])))
    transform, found = align_views(moved, truth)
    assert found.dropped == (views[6].name,)
    assert found.num_cameras == 6
    assert found.scale == transform.scale == pytest.approx(4, rel=1e-3)
    assert found.rms_residual_mm == pytest.approx(0.1, rel=0.05)
    assert found.rotation_error_median_deg < 0.2


def test_too_few_names_are_refused() -> None:
    with pytest.raises(DataError, match="knows 2 of the 6 reconstructed images"):
        align_views(VIEWS, {view.name: view for view in VIEWS[:2]})
    align_views(VIEWS, {view.name: view for view in VIEWS[:3]})
