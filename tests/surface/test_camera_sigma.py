"""What estimated cameras and poses add to stated deviations."""

import numpy as np
from dense_scenes import PINHOLE, board_scene

from polmvs.surface.camera_sigma import CameraModes, widen_by_poses
from polmvs.surface.dense_view import open_dense_view, store_dense_view
from polmvs.surface.fusion import no_points


def test_modes_add_up_along_a_direction():
    rng = np.random.default_rng(0)
    points = rng.uniform(-1, 1, (200, 3))
    modes = np.zeros((2, 200, 3))
    modes[0, :, 2], modes[1, :, 2] = 0.03, 0.04
    found = CameraModes(points, modes)
    places = rng.uniform(-0.5, 0.5, (50, 3))
    up = np.broadcast_to([0.0, 0.0, 1.0], places.shape)
    np.testing.assert_allclose(found.sigma_along(places, up), 0.05, rtol=1e-12)
    side = np.broadcast_to([1.0, 0.0, 0.0], places.shape)
    np.testing.assert_allclose(found.sigma_along(places, side), 0, atol=1e-15)


def test_a_given_camera_adds_nothing(tmp_path):
    scene = board_scene(PINHOLE)
    modes = CameraModes(scene.model.tracks.points_in_world, np.zeros((0, 40, 3)))
    cloud = no_points()
    assert modes.widened(cloud) is cloud
    view = scene.views[0]
    store_dense_view(scene.dense(view.name), tmp_path / view.name)
    before = (tmp_path / f"{view.name}.sigma.npy").read_bytes()
    modes.widen_stored(scene.views, tmp_path)
    assert (tmp_path / f"{view.name}.sigma.npy").read_bytes() == before


def test_stored_views_hold_it(tmp_path):
    scene = board_scene(PINHOLE)
    points = scene.model.tracks.points_in_world
    view = scene.views[1]
    dense = scene.dense(view.name)
    store_dense_view(dense, tmp_path / view.name)
    away = view.rays_in_world(np.array([[80.0, 64.0]]))[0]
    CameraModes(points, np.broadcast_to(0.02 * away, (1, len(points), 3))).widen_stored(
        scene.views, tmp_path
    )
    found = open_dense_view(dense.stride_px, tmp_path / view.name)
    middle = found.sigma[found.known]
    assert middle.max() <= 0.02 + 1e-6
    assert middle.max() > 0.0199
    assert (middle > 0.015).all()


def test_ranges_err_as_their_pose_does(tmp_path):
    """Against ranges to the same planes from poses that err by chance."""
    scene = board_scene(PINHOLE)
    view = scene.views[1]
    dense = scene.dense(view.name)
    store_dense_view(dense, tmp_path / view.name)
    rng = np.random.default_rng(0)
    root = rng.normal(0, 1, (6, 6)) * np.repeat([1e-3, 5e-4], 3)[:, None]
    widen_by_poses([view], (root @ root.T)[None], tmp_path)
    known = dense.known
    found = open_dense_view(dense.stride_px, tmp_path / view.name).sigma[known]
    added = np.sqrt(np.maximum(found**2 - dense.sigma[known] ** 2, 0))
    rays = view.rays_in_world(dense.lattice_xy()[known])
    ranges, normals = dense.range_map[known], dense.normals_in_world[known]
    points = view.center_in_world + rays * ranges[:, None]
    squares = np.zeros(len(rays))
    for _ in range(400):
        step = root @ rng.normal(size=6)
        turned = rays + np.cross(step[:3], rays)
        center = view.center_in_world + step[3:]
        again = ((points - center) * normals).sum(axis=1) / (turned * normals).sum(axis=1)
        squares += (again - ranges) ** 2 / 400
    # Of 400 samples: a deviation is known to 3.5 %.
    np.testing.assert_allclose(added, np.sqrt(squares), rtol=0.15)


def test_poses_of_which_nothing_is_known_add_nothing(tmp_path):
    scene = board_scene(PINHOLE)
    view = scene.views[0]
    store_dense_view(scene.dense(view.name), tmp_path / view.name)
    before = (tmp_path / f"{view.name}.sigma.npy").read_bytes()
    widen_by_poses(scene.views, np.zeros((0, 6, 6)), tmp_path)
    assert (tmp_path / f"{view.name}.sigma.npy").read_bytes() == before
