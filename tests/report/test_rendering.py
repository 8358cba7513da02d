"""Still pictures: what is near hides what is far, and what faces away is not drawn."""

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.geometry import RigidTransform
from polmvs.io.clouds import Cloud, Mesh
from polmvs.report.rendering import (
    PAPER,
    Subject,
    Viewpoint,
    contact_sheet,
    mesh_points,
    render_cloud,
)

CAMERA = PinholeCamera(width=60, height=40, fx=50, fy=50, cx=30, cy=20)
HERE = RigidTransform(np.eye(3), np.zeros(3))
TOWARDS_US = [0.0, 0.0, -1.0]


def cloud_of(points, normals, colors) -> Cloud:
    return Cloud(
        points=np.array(points, float),
        normals=np.array(normals, float),
        colors=np.array(colors, np.uint8),
    )


def test_the_near_point_hides_the_far_one() -> None:
    red, blue = (250, 0, 0), (0, 0, 250)
    cloud = cloud_of([[0, 0, 1], [0, 0, 2]], [TOWARDS_US] * 2, [red, blue])
    for order in ([0, 1], [1, 0]):
        turned = cloud_of(cloud.points[order], cloud.normals[order], cloud.colors[order])
        pixel = render_cloud(turned, CAMERA, HERE)[20, 30]
        assert pixel[0] > 100
        assert pixel[2] == 0


def test_back_faces_and_points_behind_the_camera_are_not_drawn() -> None:
    cloud = cloud_of([[0, 0, 1], [0, 0, -1]], [[0, 0, 1.0], TOWARDS_US], [(9, 9, 9)] * 2)
    assert (render_cloud(cloud, CAMERA, HERE) == PAPER).all()


def test_points_without_a_normal_or_place() -> None:
    cloud = cloud_of([[0, 0, 1], [np.nan] * 3], [[0, 0, 0], TOWARDS_US], [(200, 0, 0)] * 2)
    picture = render_cloud(cloud, CAMERA, HERE, radius_px=0)
    assert (picture != PAPER).any(axis=-1).sum() == 1


def sphere() -> Cloud:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(20_000, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    return Cloud(points=5 + 2 * normals, normals=normals)


@pytest.mark.parametrize("elevation", [-30.0, 0.0, 35.0, 90.0])
def test_the_subject_fills_the_picture_from_every_side(elevation: float) -> None:
    picture = contact_sheet([sphere()], [Viewpoint(elevation_deg=elevation, azimuth_deg=20)])
    drawn = (picture != PAPER).any(axis=-1)
    rows, cols = np.nonzero(drawn)
    height, width = drawn.shape
    assert abs(rows.mean() - height / 2) < 0.03 * height
    assert abs(cols.mean() - width / 2) < 0.03 * width
    assert 0.5 < np.ptp(rows) / height < 1


def test_up_is_where_the_normals_look() -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.uniform(-2, 2, 500), rng.uniform(-1, 1, 500), np.zeros(500)])
    for sign in (1.0, -1.0):
        normals = np.tile([0, 0, sign], (500, 1))
        subject = Subject.of(plane, normals)
        np.testing.assert_allclose(subject.axes[2], [0, 0, sign], atol=1e-9)
        assert np.linalg.det(subject.axes) == pytest.approx(1)
        eye = subject.pose(Viewpoint(elevation_deg=90, azimuth_deg=0)).inverse().translation
        assert sign * eye[2] > 0


def test_points_of_a_mesh_lie_on_it_by_area() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 9], [3, 0, 9], [0, 3, 9]], float)
    mesh = Mesh(
        vertices=vertices,
        normals=np.tile([0.0, 0, 1], (6, 1)),
        triangles=np.array([[0, 1, 2], [3, 4, 5]], np.int32),
    )
    cloud = mesh_points(mesh, 5000)
    high = cloud.points[:, 2] > 5
    assert high.mean() == pytest.approx(0.9, abs=0.02)  # nine times the area
    np.testing.assert_allclose(cloud.points[high, 2], 9)
    assert (cloud.points[high, :2].sum(axis=1) <= 3 + 1e-9).all()
    empty = Mesh(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    assert len(mesh_points(empty, 10).points) == 0


def test_a_column_for_each_subject_and_a_row_for_each_viewpoint() -> None:
    views = [Viewpoint(elevation_deg=e, azimuth_deg=0) for e in (10, 40, 80)]
    sheet = contact_sheet([sphere(), sphere()], views, labels=["one", "two"], size_px=(120, 90))
    assert sheet.shape == (270, 240, 3)
    np.testing.assert_array_equal(sheet[40:, :120], sheet[40:, 120:])  # but for the labels
