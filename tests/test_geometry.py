import numpy as np
import pytest

from polmvs.camera import depth_buffer
from polmvs.geometry import (
    RigidTransform,
    SimilarityTransform,
    nearest_rotation,
    rotation_angle,
    unit,
)
from polmvs.neighbors import voxel_of_each


def turn(angle, axis=2):
    cos, sin = np.cos(angle), np.sin(angle)
    rotation = np.roll(
        np.roll([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]], axis + 1, 0), axis + 1, 1
    )
    return np.asarray(rotation, np.float64)


@pytest.mark.parametrize("shape", [(1,), (7,), (2, 3)])
def test_unit_vectors_have_length_one_and_none_has_none(shape):
    vectors = np.random.default_rng(0).normal(size=(*shape, 3))
    np.testing.assert_allclose(np.linalg.norm(unit(vectors), axis=-1), 1.0, rtol=1e-12)
    assert np.isnan(unit(np.zeros((*shape, 3)))).all()


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-3, 1.0, 3.0, np.pi])
def test_rotation_angle_is_exact_from_nanoradians_to_half_a_turn(angle):
    start = turn(0.3, 0) @ turn(1.1, 1)
    assert rotation_angle(turn(angle) @ start, start) == pytest.approx(angle, rel=1e-6, abs=1e-14)


def test_a_rounded_rotation_is_mended_and_what_is_none_is_refused():
    exact = turn(0.3, 0) @ turn(1.1, 1)
    mended = nearest_rotation(np.round(exact, 4))
    np.testing.assert_allclose(mended @ mended.T, np.eye(3), atol=1e-14)
    assert rotation_angle(mended, exact) < 1e-4
    np.testing.assert_allclose(nearest_rotation(exact), exact, atol=1e-15)
    for wrong in (1.01 * exact, -exact, exact * np.nan, exact[:2], np.zeros((3, 3))):
        assert nearest_rotation(wrong) is None


def test_a_pose_in_another_frame_sees_points_along_the_same_rays_in_the_new_unit():
    pose = RigidTransform(turn(0.4, 1), np.array([0.2, -0.1, 0.5]))
    target_from_world = SimilarityTransform(2.5, turn(0.8, 0), np.array([3.0, 1.0, -2.0]))
    points = np.random.default_rng(1).normal(size=(5, 3))
    moved = target_from_world.pose(pose)
    np.testing.assert_allclose(moved * (target_from_world * points), 2.5 * (pose * points))


def test_depth_buffer_keeps_the_nearest_point_of_each_cell():
    xy = np.array([[0.1, 0.1], [3.9, 3.9], [4.1, 0.0], [9.9, 5.9]])
    nearest, own = depth_buffer(xy, np.array([2.0, 1.0, 5.0, 7.0]), 10, 6, cell_px=4)
    assert nearest.shape == (2, 3)
    np.testing.assert_array_equal(own, [1, 1, 5, 7])
    np.testing.assert_array_equal(np.isfinite(nearest), [[1, 1, 0], [0, 0, 1]])
    empty, none = depth_buffer(xy[:0], np.zeros(0), 10, 6)
    assert empty.shape == (6, 10)
    assert not np.isfinite(empty).any()
    assert len(none) == 0


def test_points_share_a_voxel_only_within_its_diagonal():
    points = np.random.default_rng(2).uniform(-5, 5, (400, 3))
    voxel = voxel_of_each(points, 0.8)
    assert set(voxel) == set(range(voxel.max() + 1))
    for index in range(voxel.max() + 1):
        assert np.ptp(points[voxel == index], axis=0).max() <= 0.8
    assert len(voxel_of_each(points[:0], 0.8)) == 0
