"""Polarization where pixels move and where axes turn: both exact on analytic surfaces.

Undistortion moves pixels and leaves the sensor's axes; a turn of the image, and a rectification
that turns the camera about its centre, turn them. What stays is the plane of incidence in space.
"""

import numpy as np
import pytest
from dense_scenes import FISHEYE, OPENCV, PINHOLE
from scipy.spatial.transform import Rotation

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.colmap.undistort import undistorted_camera, warp_image
from polmvs.geometry import RigidTransform
from polmvs.polarization.angle_models import phase_from_normal, rows_from_phase
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.mosaic import split_mosaic, turned_pattern
from polmvs.polarization.stokes import (
    Stokes,
    axial_difference,
    stokes_from_intensities,
    turned_axes,
)
from polmvs.scene import View
from polmvs.synthetic.captures import render_mosaic, render_view, ring_of_views
from polmvs.synthetic.surfaces import Sphere

BALL = Sphere(center=np.zeros(3), radius=0.3)


def stokes_of(rendered) -> np.ndarray:
    i0, i45, i90, i135 = np.nan_to_num(rendered.intensities)
    return np.dstack([0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135])


def aolp_of(stokes: np.ndarray) -> np.ndarray:
    return 0.5 * np.arctan2(stokes[..., 2], stokes[..., 1])


@pytest.mark.parametrize("camera", [OPENCV, FISHEYE], ids=["opencv", "fisheye"])
def test_undistortion_leaves_the_axes(camera):
    """Warped Stokes images have the angles that the pinhole of the same axes sees."""
    view = ring_of_views(1, camera, distance=0.5, elevation_deg=50, roll_deg=25)[0]
    pinhole = undistorted_camera(camera)
    straight = View(name="a", camera=pinhole, cam_from_world=view.cam_from_world)
    seen, expected = render_view(view, BALL), render_view(straight, BALL)
    warped, mask = warp_image(stokes_of(seen).astype(np.float32), camera, pinhole)
    good = mask & expected.mask & (expected.dolp > 0.1)
    good[:3], good[-3:], good[:, :3], good[:, -3:] = False, False, False, False
    error = np.degrees(axial_difference(aolp_of(warped), np.nan_to_num(expected.aolp)))[good]
    assert good.sum() > 3000
    # What is left is bilinear interpolation between pixels beside the sphere's rim.
    assert np.median(np.abs(error)) < 0.02
    # Turned by the lens's own radial direction instead, angles would be off by tens of degrees.
    assert np.percentile(np.abs(error), 99) < 1.0


@pytest.mark.parametrize("turn_deg", [0.0, 17.0, 90.0, -140.0])
def test_an_image_that_is_turned_turns_its_axes(turn_deg):
    """A camera rolled about its axis sees the same light under angles that count from its own x."""
    view = ring_of_views(1, PINHOLE, distance=0.5, elevation_deg=50)[0]
    roll = Rotation.from_euler("z", turn_deg, degrees=True).as_matrix()
    # A square image about the axis, so that both see the same pixels of it.
    square = PinholeCamera(width=64, height=64, fx=80.0, fy=80.0, cx=32.0, cy=32.0)
    pose = view.cam_from_world
    rolled_pose = RigidTransform(roll @ pose.rotation, roll @ pose.translation)
    before = View(name="a", camera=square, cam_from_world=pose)
    after = View(name="b", camera=square, cam_from_world=rolled_pose)
    xy = np.random.default_rng(0).uniform(12, 52, (500, 2))
    rays = before.camera.rays(xy)
    normals = np.random.default_rng(1).normal(size=(500, 3))
    first = phase_from_normal(AngleModel.PPA, normals, rays)
    second = phase_from_normal(AngleModel.PPA, normals @ roll.T, rays @ roll.T)
    # y points down: a turn of the camera's frame by +t turns displayed angles by -t.
    np.testing.assert_allclose(axial_difference(second, first - np.radians(turn_deg)), 0, atol=1e-9)
    stokes = Stokes(
        s0=np.ones((1, 500), np.float32),
        s1=np.cos(2 * first)[None].astype(np.float32),
        s2=np.sin(2 * first)[None].astype(np.float32),
        sigma=np.full((1, 500), 1e-3, np.float32),
        valid=np.ones((1, 500), bool),
    )
    turned = turned_axes(stokes, zero_deg=-turn_deg).aolp[0]
    np.testing.assert_allclose(axial_difference(turned, second), 0, atol=2e-6)
    assert np.allclose(after.cam_from_world.rotation, roll @ before.cam_from_world.rotation)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_a_mosaic_that_is_turned_or_mirrored_keeps_its_light(orientation):
    """With the pattern of the turned samples, angles are those of the turned picture."""
    view = ring_of_views(1, PINHOLE, distance=0.5, elevation_deg=50, roll_deg=10)[0]
    pattern = (90, 45, 135, 0)
    raw = render_mosaic(view, BALL, pattern=pattern)

    def turned(image):
        image = image.T if orientation >= 5 else image
        if orientation in (2, 3, 6, 7):
            image = image[:, ::-1]
        return image[::-1] if orientation in (3, 4, 7, 8) else image

    def read(samples, order):
        images = split_mosaic(np.ascontiguousarray(samples), order)
        return stokes_from_intensities(images, np.zeros(images.shape[1:], bool))

    plain, found = read(raw, pattern), read(turned(raw), turned_pattern(pattern, orientation))
    sign1 = -1 if orientation >= 5 else 1
    sign2 = -1 if orientation in (2, 4, 6, 8) else 1
    np.testing.assert_allclose(found.s1, sign1 * turned(plain.s1), atol=1e-6)
    np.testing.assert_allclose(found.s2, sign2 * turned(plain.s2), atol=1e-6)


def test_a_rectified_camera_sees_the_same_planes_of_incidence():
    """A camera turned about its centre: rows turn with it, and with them the phase."""
    rng = np.random.default_rng(2)
    turn = Rotation.from_euler("xyz", [12, -20, 7], degrees=True).as_matrix()
    xy = pixel_centers(PINHOLE.width, PINHOLE.height).reshape(-1, 2)[::37]
    rays = PINHOLE.rays(xy)
    normals = rng.normal(size=rays.shape)
    normals[(normals * rays).sum(axis=1) > 0] *= -1
    phase = phase_from_normal(AngleModel.PPA, normals, rays)
    rows = rows_from_phase(AngleModel.PPA, phase, rays)
    np.testing.assert_allclose((rows * normals).sum(axis=1), 0, atol=1e-12)
    turned_rows, turned_rays = rows @ turn.T, rays @ turn.T
    ahead = turned_rays[:, 2] > 0.2
    # The plane cuts the new image plane along (m_y, -m_x); displayed angles count upwards.
    found = np.arctan2(turned_rows[:, 0], turned_rows[:, 1])
    expected = phase_from_normal(AngleModel.PPA, normals @ turn.T, turned_rays)
    np.testing.assert_allclose(axial_difference(found, expected)[ahead], 0, atol=1e-9)
    # The phase itself has not stayed: a value moved to the new pixel would be wrong.
    stayed = np.degrees(axial_difference(phase, expected))[ahead]
    assert np.median(np.abs(stayed)) > 3
