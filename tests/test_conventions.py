"""The conventions page of the package, one test for each statement."""

import subprocess
import sys

import numpy as np
import pycolmap
import pytest
from scenes import CAMERA, random_rotation

from polmvs.camera import PinholeCamera, pixel_centers, sample_image, xy_from_opencv, xy_to_opencv
from polmvs.geometry import RigidTransform, align_points
from polmvs.polarization.angle_models import phase_from_normal, rows_from_phase
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.scene import View
from polmvs.synthetic.captures import look_at, render_view
from polmvs.synthetic.surfaces import Plane

RNG = np.random.default_rng(0)


def test_pixel_centres_are_at_half_integers():
    centers = pixel_centers(4, 3)
    assert centers.shape == (3, 4, 2)
    np.testing.assert_array_equal(centers[2, 1], [1.5, 2.5])


def test_pinhole_agrees_with_colmap():
    colmap = pycolmap.Camera(model="PINHOLE", width=640, height=480, params=[500, 510, 321.5, 238])
    ours = PinholeCamera(width=640, height=480, fx=500, fy=510, cx=321.5, cy=238)
    xy = RNG.uniform(0, 480, size=(50, 2))
    plane = np.column_stack([colmap.cam_from_img(xy), np.ones(len(xy))])
    rays = plane / np.linalg.norm(plane, axis=1, keepdims=True)
    np.testing.assert_allclose(ours.rays(xy), rays, atol=1e-12)
    points = ours.rays(xy) * RNG.uniform(0.5, 3, size=(50, 1))
    np.testing.assert_allclose(ours.project(points), colmap.img_from_cam(points), atol=1e-9)


def test_points_behind_the_camera_do_not_project():
    assert np.isnan(CAMERA.project(np.array([[0.1, 0.1, -1.0], [0.0, 0.0, 0.0]]))).all()


def test_halving_the_image_halves_the_intrinsics():
    raw = PinholeCamera(width=640, height=480, fx=500, fy=500, cx=322, cy=238)
    half = PinholeCamera(width=320, height=240, fx=250, fy=250, cx=161, cy=119)
    # The centre of a 2x2 cell of raw pixels is the centre of a half-size pixel.
    np.testing.assert_allclose(raw.rays(np.array([2.0, 4.0]) * 7), half.rays(np.array([7.0, 14.0])))


def test_opencv_counts_from_pixel_centres():
    np.testing.assert_array_equal(xy_to_opencv(np.array([0.5, 0.5])), [0, 0])
    np.testing.assert_array_equal(xy_from_opencv(np.array([3.0, 4.0])), [3.5, 4.5])


def test_sampling_a_ramp_gives_its_coordinate():
    ramp = pixel_centers(9, 7).astype(np.float32)
    xy = np.array([[2.25, 3.5], [0.5, 0.5], [8.5, 6.5]])
    np.testing.assert_allclose(sample_image(ramp, xy), xy, atol=1e-2)
    np.testing.assert_allclose(sample_image(ramp, xy[:1], nearest=True), [[2.5, 3.5]])


def test_sampling_outside_or_nan_gives_zero_whatever_the_number_of_points():
    image = np.ones((5, 5), np.float32)
    outside = np.array([[np.nan, 1.0], [-3.0, 2.0], [2.5, 1e9], [np.inf, 2.0]])
    np.testing.assert_array_equal(sample_image(image, outside), 0)
    many = np.full((10_000, 2), 2.5)
    assert (sample_image(image, many) == 1).all()
    assert sample_image(image, np.zeros((0, 2))).shape == (0,)


def test_transforms_compose_with_their_inverse():
    transform = RigidTransform(random_rotation(RNG), RNG.normal(size=3))
    points = RNG.normal(size=(2, 5, 3))
    np.testing.assert_allclose(transform.inverse() * (transform * points), points, atol=1e-12)


def test_similarity_is_recovered_and_lines_are_refused():
    source = RNG.normal(size=(6, 3))
    rotation, scale, shift = random_rotation(RNG), 2.5, np.array([1.0, -2.0, 0.5])
    found = align_points(source, scale * source @ rotation.T + shift)
    np.testing.assert_allclose(found.rotation, rotation, atol=1e-12)
    assert found.scale == pytest.approx(scale)
    np.testing.assert_allclose(found.translation, shift, atol=1e-12)
    with pytest.raises(ValueError, match="on one line"):
        align_points(np.outer(np.arange(5.0), [1, 2, 3]), np.outer(np.arange(5.0), [1, 2, 3]))


def test_aolp_is_anticlockwise_as_displayed_and_specular_phase_is_turned_by_half_pi():
    """A floor below the camera's axis, seen level: its specular light is polarized along x."""
    floor = Plane(point=np.array([0.0, 0.0, 0.0]), normal=np.array([0.0, 0.0, 1.0]))
    view = View(
        name="v",
        camera=CAMERA,
        cam_from_world=look_at(np.array([0.0, -1.0, 0.6]), np.array([0.0, 0.0, 0.0])),
    )
    rendered = render_view(view, floor, light="specular")
    middle = (CAMERA.height // 2, CAMERA.width // 2)
    assert np.sin(rendered.aolp[middle]) == pytest.approx(0, abs=0.02)
    assert rendered.phase[middle] == pytest.approx(np.pi / 2, abs=0.02)
    # Towards the right the plane of incidence leans as the ray does: its trace in the image
    # turns clockwise as displayed, towards the vanishing point of the floor's normal.
    row = rows_from_phase(
        AngleModel.PPA, rendered.phase[middle], view.camera.rays(np.array([80.0, 64.0]))
    )
    assert abs(row @ rendered.normals_in_cam[middle]) < 0.02


@pytest.mark.parametrize("light", list(Light))
def test_rendered_phase_is_that_of_the_model(light):
    plane = Plane(point=np.zeros(3), normal=np.array([0.2, -0.3, 1.0]))
    view = View(
        name="v",
        camera=CAMERA,
        cam_from_world=look_at(np.array([0.2, -0.5, 0.4]), np.zeros(3)),
    )
    rendered = render_view(view, plane, light=light.value, sensor="ppa")
    rays = CAMERA.rays(pixel_centers(CAMERA.width, CAMERA.height))
    predicted = phase_from_normal(AngleModel.PPA, rendered.normals_in_cam, rays)
    difference = np.sin(rendered.phase - predicted)[rendered.mask]
    assert np.nanmax(np.abs(difference)) < 1e-9
    turn = np.pi / 2 if light is Light.SPECULAR else 0.0
    assert np.nanmax(np.abs(np.sin(rendered.aolp + turn - rendered.phase))) < 1e-9


def test_zlib_works_after_everything_is_imported():
    """Imported before zlib, pycolmap breaks deflate: PNG and npz writing abort."""
    code = (
        "import polmvs, polmvs.colmap.models, io, zlib, cv2, numpy as np\n"
        "np.savez_compressed(io.BytesIO(), a=np.arange(100000))\n"
        "assert cv2.imencode('.png', np.zeros((300, 300), np.uint8))[0]\n"
        "assert zlib.decompress(zlib.compress(b'a' * 100000)) == b'a' * 100000\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True, timeout=60)
