import pickle
from dataclasses import replace

import numpy as np
import pytest
from stereo_scenes import DISTANCE, map_of, plane_points, views_of

from polmvs.polarization.phase_map import store_phase_map
from polmvs.scene import Tracks
from polmvs.surface.surroundings import (
    SurroundingsTolerances,
    _whole_view,
    choose_partners,
    part_shares,
    relative_sigmas,
    sparse_surroundings,
    stereo_surroundings,
)

PART_SIDE = 0.05  # half the side of a square part on the plane z = 0


def part_maps(num=12):
    """Views of a textured plane with a part in its middle."""
    corners = np.array([[-1, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]) * PART_SIDE
    maps = []
    for view in views_of(num=num):
        rays = view.camera.rays(np.stack(np.meshgrid(np.arange(240), np.arange(192)), -1) + 0.5)
        rays = rays @ view.cam_from_world.rotation
        points = view.center_in_world - (view.center_in_world[2] / rays[..., 2])[..., None] * rays
        inside = (np.abs(points[..., :2]) < corners.max()).all(axis=-1)
        maps.append(map_of(view, inside=inside))
    return maps


def tracks_of(points, views, seen=None):
    """Tracks as all views, or each track's ``seen`` ones, observe them."""
    obs = [(t, k) for t in range(len(points)) for k in (seen[t] if seen else range(len(views)))]
    xy = [views[k].camera.project(views[k].cam_from_world * points[t]) for t, k in obs]
    return Tracks(
        point3D_ids=np.arange(len(points)),
        points_in_world=np.asarray(points, np.float64),
        colors=np.arange(3 * len(points), dtype=np.uint8).reshape(-1, 3),
        errors=np.full(len(points), 0.3),
        obs_track=np.array([t for t, _ in obs], np.int64),
        obs_view=np.array([k for _, k in obs], np.int64),
        obs_xy=np.array(xy).reshape(-1, 2),
    )


def test_points_on_parts_and_mirror_images_go_and_the_rest_stays():
    maps = part_maps()
    views = [m.view for m in maps]
    beside, on_part = [0.1, 0.02, 0.0], [0.02, -0.01, 0.0]
    mirrored = [0.01, 0.0, -0.06]  # behind the part, seen through it
    border = [PART_SIDE, 0.0, 0.0]
    found = sparse_surroundings(
        tracks_of(np.array([beside, on_part, mirrored, border]), views), maps
    )
    np.testing.assert_array_equal(found.is_kept, [True, False, False, False])
    np.testing.assert_array_equal(found.points, [beside])
    np.testing.assert_array_equal(found.colors, [[0, 1, 2]])
    np.testing.assert_array_equal(found.num_views, [12])


def test_a_point_that_the_part_occludes_in_some_views_stays():
    maps = part_maps()
    tracks = tracks_of(np.array([[0.1, 0.0, 0.0]]), [m.view for m in maps])
    on_part = tracks_of(np.array([[0.0, 0.0, 0.0]]), [m.view for m in maps])
    some_inside = np.where(tracks.obs_view[:, None] < 4, on_part.obs_xy, tracks.obs_xy)
    assert sparse_surroundings(replace(tracks, obs_xy=some_inside), maps).is_kept.all()
    more_inside = np.where(tracks.obs_view[:, None] < 5, on_part.obs_xy, tracks.obs_xy)
    assert not sparse_surroundings(replace(tracks, obs_xy=more_inside), maps).is_kept.any()


def test_uncertain_points_go():
    maps = part_maps()
    views = [m.view for m in maps]
    points = np.array([[0.1, 0.0, 0.0]] * 3)
    tracks = tracks_of(points, views, seen=[range(12), (0, 11), range(12)])
    tracks = replace(tracks, errors=np.array([0.3, 0.3, 8.0]))
    np.testing.assert_array_equal(sparse_surroundings(tracks, maps).is_kept, [True, False, False])
    loose = SurroundingsTolerances(max_relative_sigma=0.02)
    far = tracks_of(np.array([[0.1, 0.0, 0.0], [5.0, 0.0, -30.0]]), views)
    np.testing.assert_array_equal(
        sparse_surroundings(far, maps, tolerances=loose).is_kept, [True, False]
    )


def test_relative_sigma_of_a_known_geometry():
    views = views_of(num=2)
    tracks = tracks_of(np.zeros((1, 3)), views)
    ray, other = (v.center_in_world / DISTANCE for v in views)
    half = 0.5 * np.arccos(ray @ other)
    # Half a pixel of 180 from two sides: along the bisector the two rays' errors divided by sine.
    expected = 0.5 / 180 / (np.sqrt(2) * np.sin(half))
    np.testing.assert_allclose(relative_sigmas(tracks, views), [expected], rtol=1e-6)
    bad = replace(tracks, errors=np.array([5.0]))
    # Two rays leave one of four residuals: the error says a quarter of the variance.
    worse = 5.0 / np.sqrt(0.5 * np.pi * 0.25) / 0.5
    np.testing.assert_allclose(relative_sigmas(bad, views), [worse * expected], rtol=1e-6)


def test_no_tracks_and_tracks_without_observations():
    maps = part_maps(2)
    none = tracks_of(np.zeros((0, 3)), [m.view for m in maps])
    assert sparse_surroundings(none, maps).points.shape == (0, 3)
    assert choose_partners(none, [m.view for m in maps]) == [[], []]
    unseen = tracks_of(np.ones((1, 3)), [m.view for m in maps], seen=[()])
    np.testing.assert_array_equal(part_shares(unseen, maps, 3), [1.0])
    assert np.isinf(relative_sigmas(unseen, [m.view for m in maps])).all()
    assert not sparse_surroundings(unseen, maps).is_kept.any()


def test_partners_have_a_useful_angle():
    views = views_of(num=8)  # about 8 deg apart
    partners = choose_partners(tracks_of(plane_points(60), views), views, max_partners=8)
    assert partners[0] == [1, 2, 3]
    assert partners[4] == [1, 2, 3, 5, 6, 7]
    assert choose_partners(tracks_of(plane_points(60), views), views, max_partners=1)[0] == [1]
    few = tracks_of(plane_points(10), views)
    assert choose_partners(few, views) == [[]] * 8


def test_the_view_with_the_most_points_in_common_comes_first():
    views = views_of(num=3)
    seen = [(0, 1, 2)] * 30 + [(0, 2)] * 10
    assert choose_partners(tracks_of(plane_points(40), views, seen), views)[0] == [2, 1]


@pytest.mark.parametrize("stored", [False, True])
def test_views_of_the_whole_image_survive_pickling(tmp_path, stored):
    phase_map = part_maps(1)[0]
    if stored:
        phase_map = store_phase_map(phase_map, tmp_path)
    again = pickle.loads(pickle.dumps(_whole_view(phase_map)))
    assert again.shows_surface(np.zeros((4, 5, 2))).all()
    np.testing.assert_array_equal(again.intensity, phase_map.intensity)


def test_dense_surroundings_lie_on_the_plane_and_beside_the_part(tmp_path):
    maps = part_maps()
    points = plane_points(400)
    points = points[np.abs(points[:, :2]).max(axis=-1) > PART_SIDE + 0.02]
    cloud = stereo_surroundings(tracks_of(points, [m.view for m in maps]), maps, tmp_path)
    assert len(cloud.points) > 3000
    assert (cloud.num_views >= 3).all()
    # A pixel's gsd is 3.3 mm here.
    assert np.median(np.abs(cloud.points[:, 2])) < 0.002
    assert (np.abs(cloud.points[:, 2]) > 0.01).mean() < 0.01
    inside = np.abs(cloud.points[:, :2]).max(axis=-1) < PART_SIDE
    assert inside.sum() == 0
    assert np.median(cloud.normals[:, 2]) > np.cos(np.radians(10))


def test_without_points_there_are_no_dense_surroundings(tmp_path):
    maps = part_maps(3)
    none = tracks_of(np.zeros((0, 3)), [m.view for m in maps])
    assert len(stereo_surroundings(none, maps, tmp_path).points) == 0
