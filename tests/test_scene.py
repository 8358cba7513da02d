import numpy as np
import pytest

from polmvs.camera import PinholeCamera, in_frame, in_image
from polmvs.geometry import RigidTransform, points_on_rays
from polmvs.scene import Tracks, View, find_name, match_names, short_list

CAMERA = PinholeCamera(width=40, height=30, fx=50, fy=60, cx=20, cy=15)


@pytest.fixture
def view():
    cos, sin = np.cos(0.7), np.sin(0.7)
    rotation = np.array([[cos, 0, sin], [0, 1, 0], [-sin, 0, cos]])
    return View(
        name="a.png", camera=CAMERA, cam_from_world=RigidTransform(rotation, np.array([0.1, 2, 3]))
    )


def test_points_along_rays_project_back_and_lie_at_their_distance(view):
    xy = np.random.default_rng(0).uniform([0, 0], [40, 30], (2, 4, 2))
    ranges = np.linspace(1, 8, 8).reshape(2, 4)
    points = view.points_at(xy, ranges)
    along = points_on_rays(view.center_in_world, view.rays_in_world(xy), ranges)
    np.testing.assert_allclose(points, along, atol=1e-12)
    np.testing.assert_allclose(view.project(points), xy, rtol=1e-9)
    np.testing.assert_allclose(view.ranges(points), ranges, rtol=1e-12)
    np.testing.assert_allclose(
        view.center_in_world + ranges[..., None] * view.rays_in_world(xy), points
    )


def test_a_surface_faces_the_camera_up_to_grazing(view):
    points = view.points_at(np.array([[12.0, 9.0]]), np.array([2.0]))
    ray = view.rays_in_world(np.array([[12.0, 9.0]]))
    across = np.cross(ray, [0.0, 1.0, 0.0])
    across /= np.linalg.norm(across)
    for cosine in (1.0, 0.11, 0.09, -0.5):
        normals = -cosine * ray + np.sqrt(1 - cosine**2) * across
        assert view.facing_cosines(points, normals)[0] == pytest.approx(cosine)
        assert view.faces(points, normals)[0] == (cosine > 0.1)
    assert not view.faces(points, normals * np.nan)[0]


def test_the_image_has_its_upper_left_border_and_not_its_lower_right():
    xy = np.array([[0.0, 0.0], [39.99, 29.99], [40.0, 3.0], [3.0, 30.0], [-0.01, 3.0], [np.nan, 3]])
    np.testing.assert_array_equal(in_image(CAMERA, xy), [1, 1, 0, 0, 0, 0])


def test_a_frame_has_its_whole_border_and_a_margin():
    xy = np.array([[0.0, 0.0], [40, 30], [2, 28], [1.9, 15], [20, 28.1], [np.nan, 5]])
    np.testing.assert_array_equal(in_frame(xy, 40, 30), [1, 1, 1, 1, 1, 0])
    np.testing.assert_array_equal(in_frame(xy, 40, 30, 2), [0, 0, 1, 0, 0, 0])


def test_observations_of_views_keep_their_order():
    tracks = Tracks(
        point3D_ids=np.arange(3),
        points_in_world=np.zeros((3, 3)),
        colors=np.zeros((3, 3), np.uint8),
        errors=np.zeros(3),
        obs_track=np.array([2, 0, 1, 0, 2]),
        obs_view=np.array([3, 1, 3, 0, 1]),
        obs_xy=np.zeros((5, 2)),
    )
    assert [own.tolist() for own in tracks.of_views(5)] == [[3], [1, 4], [], [0, 2], []]


def test_names_match_exactly_before_they_match_by_stem():
    assert match_names(["0.png", "1.png"], ["1.png", "0.jpg"]) == {
        "0.png": "0.jpg",
        "1.png": "1.png",
    }
    # The known name of the same stem belongs to the image of exactly that name.
    assert match_names(["0.png", "left/0.png"], ["0.png"]) == {"0.png": "0.png"}
    # Nobody can tell whose it is.
    assert match_names(["a/0.png", "b/0.png"], ["0.png"]) == {}
    assert match_names(["0.png"], ["a/0.png", "b/0.png"]) == {}
    assert match_names([], ["0.png"]) == match_names(["0.png"], []) == {}


def test_one_name_is_found_by_name_or_stem():
    assert find_name("x/3.png", ["3.bmp", "4.bmp"]) == "3.bmp"
    assert find_name("3.png", ["3.bmp", "y/3.png"]) is None
    assert find_name("3.png", ["3.bmp", "3.png"]) == "3.png"


def test_long_lists_are_cut():
    assert short_list(["a", "b"]) == "a, b"
    assert short_list(list("abcdefg")) == "a, b, c, d, e and 2 more"
