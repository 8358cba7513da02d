"""The analytic generator against the equations it is made from."""

import numpy as np
import pytest

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.geometry import RigidTransform
from polmvs.polarization.mosaic import ANGLES_DEG
from polmvs.scene import View
from polmvs.synthetic.captures import (
    add_noise,
    look_at,
    quantize,
    render_mosaic,
    render_view,
    ring_of_views,
)
from polmvs.synthetic.surfaces import Cylinder, Group, Plane, Sphere

CAMERA = PinholeCamera(width=48, height=40, fx=35.0, fy=36.0, cx=24.3, cy=19.6)
NORMAL = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
POINT = np.array([0.02, 0.01, 0.03])
SURFACES = {
    "plane": Plane(POINT, NORMAL),
    "sphere": Sphere([0.0, 0.0, -0.1], 0.25),
    "cylinder": Cylinder([0.0, 0.0, -0.05], [1.0, 0.4, 0.1], 0.15),
    "inside": Sphere([0.0, 0.1, 0.2], 2.0),
}


def make_view(camera=CAMERA):
    [view, *_] = ring_of_views(3, camera, distance=0.5, elevation_deg=50.0, roll_deg=20.0)
    return view


def raw_size(camera):
    return PinholeCamera(
        width=2 * camera.width,
        height=2 * camera.height,
        **{key: 2 * getattr(camera, key) for key in ("fx", "fy", "cx", "cy")},
    )


def camera_rays():
    return CAMERA.rays(pixel_centers(CAMERA.width, CAMERA.height))


def assert_axial_close(actual, expected, atol=1e-9):
    difference = np.mod(actual - expected + np.pi / 2, np.pi) - np.pi / 2
    np.testing.assert_allclose(difference, 0.0, atol=atol)


def points_in_world(rendered):
    points_in_cam = rendered.range[..., None] * camera_rays()
    return rendered.view.cam_from_world.inverse() * points_in_cam


def measured_aolp(intensities):
    i0, i45, i90, i135 = intensities
    return 0.5 * np.arctan2(i45 - i135, i0 - i90)


def test_plane_depth_is_that_of_its_equation():
    view = make_view()
    rendered = render_view(view, SURFACES["plane"])
    # In the camera n . X = c; with X = z K^-1 (u, v, 1) the depth is c / (n . K^-1 (u, v, 1)).
    normal = view.cam_from_world.rotation @ NORMAL
    offset = normal @ (view.cam_from_world * POINT)
    xy = pixel_centers(CAMERA.width, CAMERA.height)
    directions = (
        np.concatenate([xy, np.ones_like(xy[..., :1])], axis=-1) @ np.linalg.inv(CAMERA.K).T
    )
    depth = offset / (directions @ normal)
    assert np.array_equal(rendered.mask, depth > 0)
    np.testing.assert_allclose(rendered.depth[rendered.mask], depth[rendered.mask], rtol=1e-12)
    np.testing.assert_allclose(
        rendered.range[rendered.mask],
        (depth * np.linalg.norm(directions, axis=-1))[rendered.mask],
        rtol=1e-12,
    )


def test_points_lie_on_sphere_and_cylinder_with_radial_normals():
    for name in ("sphere", "inside"):
        sphere = SURFACES[name]
        rendered = render_view(make_view(), sphere)
        radial = points_in_world(rendered) - sphere.center
        normals = rendered.normals_in_cam @ rendered.view.cam_from_world.rotation
        sign = -1.0 if name == "inside" else 1.0
        seen = rendered.mask
        assert seen.all() if name == "inside" else 0.2 < seen.mean() < 0.9
        np.testing.assert_allclose(radial[seen], sign * sphere.radius * normals[seen], atol=1e-12)

    cylinder = SURFACES["cylinder"]
    rendered = render_view(make_view(), cylinder)
    axis = np.array(cylinder.axis) / np.linalg.norm(cylinder.axis)
    radial = points_in_world(rendered) - cylinder.point
    radial -= (radial @ axis)[..., None] * axis
    normals = rendered.normals_in_cam @ rendered.view.cam_from_world.rotation
    seen = rendered.mask
    assert 0.2 < seen.mean() < 0.9
    np.testing.assert_allclose(radial[seen], cylinder.radius * normals[seen], atol=1e-12)


@pytest.mark.parametrize("name", SURFACES)
def test_normals_are_unit_and_face_the_camera(name):
    rendered = render_view(make_view(), SURFACES[name])
    seen = rendered.mask
    np.testing.assert_allclose(
        np.linalg.norm(rendered.normals_in_cam[seen], axis=-1), 1, rtol=1e-12
    )
    assert np.all((rendered.normals_in_cam * camera_rays()).sum(-1)[seen] < 0)
    for missed in (rendered.depth, rendered.range, rendered.phase, rendered.aolp, rendered.dolp):
        assert np.isnan(missed[~seen]).all()
    assert np.isnan(rendered.normals_in_cam[~seen]).all()


@pytest.mark.parametrize("light", ["specular", "diffuse"])
@pytest.mark.parametrize("name", SURFACES)
def test_phase_obeys_the_papers_models(name, light):
    rays = camera_rays()
    rendered = render_view(make_view(), SURFACES[name], light=light, sensor="ppa")
    seen = rendered.mask
    n, v = rendered.normals_in_cam[seen], rays[seen]
    ppa = -np.arctan2(
        -v[:, 2] * n[:, 1] + v[:, 1] * n[:, 2], -v[:, 2] * n[:, 0] + v[:, 0] * n[:, 2]
    )
    assert_axial_close(rendered.phase[seen], ppa)
    assert_axial_close(rendered.aolp[seen], ppa + (np.pi / 2 if light == "specular" else 0.0))
    assert_axial_close(measured_aolp(rendered.intensities)[seen], rendered.aolp[seen])

    opa = render_view(make_view(), SURFACES[name], light=light, sensor="opa")
    assert_axial_close(opa.phase[seen], -np.arctan2(n[:, 1], n[:, 0]))


def test_stokes_of_the_intensities():
    rendered = render_view(make_view(), SURFACES["sphere"], s0=0.6, background=0.2)
    i0, i45, i90, i135 = rendered.intensities
    seen = rendered.mask
    np.testing.assert_allclose((i0 + i90)[seen], 0.6, rtol=1e-12)
    np.testing.assert_allclose((i45 + i135)[seen], 0.6, rtol=1e-12)
    dolp = np.hypot(i0 - i90, i45 - i135) / (i0 + i90)
    np.testing.assert_allclose(dolp[seen], rendered.dolp[seen], atol=1e-12)
    np.testing.assert_allclose(rendered.intensities[:, ~seen], 0.1, rtol=1e-12)


def frontal_plane(incidence_deg):
    """One pixel that looks along the optical axis at a plane, x-z the plane of incidence."""
    camera = PinholeCamera(width=1, height=1, fx=1.0, fy=1.0, cx=0.5, cy=0.5)
    view = View(name="0", camera=camera, cam_from_world=RigidTransform(np.eye(3), np.zeros(3)))
    theta = np.radians(incidence_deg)
    return view, Plane([0.0, 0.0, 1.0], [np.sin(theta), 0.0, -np.cos(theta)])


def test_dolp_by_fresnel():
    brewster = np.degrees(np.arctan(1.5))
    specular = render_view(*frontal_plane(brewster))
    np.testing.assert_allclose(specular.dolp, 1.0, rtol=1e-12)
    # Across the plane of incidence (x-z): vertical, and nothing passes a horizontal polarizer.
    np.testing.assert_allclose(specular.aolp, np.pi / 2)
    np.testing.assert_allclose(specular.intensities[0], 0.0, atol=1e-12)
    assert_axial_close(specular.phase, 0.0)
    # The transmitted share along the plane is 1 there, across it 1 - ((n^2-1)/(n^2+1))^2.
    across = 1 - ((1.5**2 - 1) / (1.5**2 + 1)) ** 2
    diffuse = render_view(*frontal_plane(brewster), light="diffuse")
    np.testing.assert_allclose(diffuse.dolp, (1 - across) / (1 + across), rtol=1e-12)
    assert_axial_close(diffuse.aolp, 0.0)


@pytest.mark.parametrize("sensor", ["ppa", "opa", "tilted"])
def test_head_on_the_phase_is_undefined_and_the_light_unpolarized(sensor):
    rendered = render_view(*frontal_plane(0.0), sensor=sensor)
    assert rendered.mask.all()
    assert np.isnan(rendered.phase).all()
    assert np.isnan(rendered.aolp).all()
    np.testing.assert_allclose(rendered.dolp, 0.0, atol=1e-12)
    np.testing.assert_allclose(rendered.intensities, 0.4, rtol=1e-12)


@pytest.mark.parametrize("light", ["specular", "diffuse"])
def test_tilted_sensor_is_inverted_by_its_coherency(light):
    rendered = render_view(make_view(), SURFACES["plane"], light=light, sensor="tilted", s0=0.8)
    rays, seen = camera_rays(), rendered.mask
    checked = 0
    for row, col in np.argwhere(seen)[::50]:
        v, n = rays[row, col], rendered.normals_in_cam[row, col]
        # I_k = sum_ij J_ij (1 - a a')_ij over a basis of the plane transverse to the ray.
        basis = np.linalg.svd(v[None])[2][1:]
        system = []
        for angle in np.radians(ANGLES_DEG):
            axis = np.array([np.sin(angle), np.cos(angle), 0.0])
            axis -= (axis @ v) * v
            a, b = basis @ (axis / np.linalg.norm(axis))
            system.append([1 - a * a, -2 * a * b, 1 - b * b])
        solution, residual, *_ = np.linalg.lstsq(
            np.array(system), rendered.intensities[:, row, col], rcond=None
        )
        np.testing.assert_allclose(residual, 0.0, atol=1e-20)
        coherency = solution[[0, 1, 1, 2]].reshape(2, 2)
        values, vectors = np.linalg.eigh(coherency)
        np.testing.assert_allclose(values.sum(), 0.8, rtol=1e-9)
        np.testing.assert_allclose(
            (values[1] - values[0]) / values.sum(), rendered.dolp[row, col], atol=1e-9
        )
        direction = vectors[:, 1] @ basis
        incidence_plane = np.cross(v, n) / np.linalg.norm(np.cross(v, n))
        expected = incidence_plane if light == "specular" else np.cross(v, incidence_plane)
        np.testing.assert_allclose(abs(direction @ expected), 1.0, rtol=1e-9)
        checked += 1
    assert checked > 20


def test_sensors_agree_on_the_optical_axis_only():
    view, plane = frontal_plane(40.0)
    phases = [render_view(view, plane, sensor=s).phase[0, 0] for s in ("ppa", "opa", "tilted")]
    assert_axial_close(np.array(phases), 0.0)
    ppa, tilted = (render_view(make_view(), SURFACES["plane"], sensor=s) for s in ("ppa", "tilted"))
    assert np.nanmax(np.abs(np.sin(ppa.phase - tilted.phase))) > np.radians(2)


@pytest.mark.parametrize("sensor", ["ppa", "tilted"])
def test_mosaic_samples_lie_at_their_own_pixels(sensor):
    view, surface = make_view(), SURFACES["sphere"]
    mosaic = render_mosaic(view, surface, sensor=sensor)
    raw_view = View(name="raw", camera=raw_size(CAMERA), cam_from_world=view.cam_from_world)
    intensities = render_view(raw_view, surface, sensor=sensor).intensities
    assert mosaic.shape == (80, 96)
    for row, col, angle in ((0, 0, 90), (0, 1, 45), (1, 0, 135), (1, 1, 0)):
        np.testing.assert_allclose(
            mosaic[row::2, col::2],
            intensities[ANGLES_DEG.index(angle), row::2, col::2],
            atol=1e-12,
        )


def test_noise_has_the_stated_mean_and_variance():
    rng = np.random.default_rng(0)
    for level in (0.0, 0.02, 0.5):
        noisy = add_noise(np.full(200_000, level), full_well=10_000, read_noise=2.5, rng=rng)
        variance = level / 10_000 + (2.5 / 10_000) ** 2
        # Of 200,000 samples the mean deviates by sigma / 447, the variance by 0.3 %; four sigma.
        assert abs(noisy.mean() - level) < 4 * np.sqrt(variance / 200_000)
        np.testing.assert_allclose(noisy.var(), variance, rtol=0.013)


def test_quantize_rounds_and_clips():
    values = np.array([-0.1, 0.0, 0.5, 1.0, 1.3])
    eight, sixteen = quantize(values), quantize(values, bits=12)
    assert eight.dtype == np.uint8
    assert sixteen.dtype == np.uint16
    np.testing.assert_array_equal(eight, [0, 0, 128, 255, 255])
    np.testing.assert_array_equal(sixteen, [0, 0, 2048, 4095, 4095])


def test_extents_bound_plane_and_cylinder():
    plane = Plane(POINT, NORMAL, extent=(0.1, 0.05))
    rendered = render_view(make_view(), plane)
    position = (points_in_world(rendered)[rendered.mask] - POINT) @ plane.axes.T
    assert 0.01 < rendered.mask.mean() < 0.5
    assert np.all(np.abs(position) <= [0.1, 0.05])
    np.testing.assert_allclose(np.abs(position).max(axis=0), [0.1, 0.05], atol=0.02)  # a pixel

    tube = Cylinder([0.0, 0.0, 0.0], [0.0, 0.0, 1.0], 0.1, half_length=0.08)
    rendered = render_view(make_view(), tube)
    assert np.abs(points_in_world(rendered)[rendered.mask][:, 2]).max() <= 0.08
    # Through the open top the far wall is seen from inside.
    normals = rendered.normals_in_cam @ rendered.view.cam_from_world.rotation
    radial = points_in_world(rendered)[..., :2]
    outwards = (normals[..., :2] * radial).sum(-1)[rendered.mask]
    assert (outwards > 0).any()
    assert (outwards < 0).any()


def test_group_shows_the_nearest_surface():
    parts = (Plane(POINT, NORMAL), Sphere([0.0, 0.0, 0.05], 0.1))
    both = render_view(make_view(), Group(parts))
    alone = [render_view(make_view(), part) for part in parts]
    expected = np.fmin(alone[0].range, alone[1].range)
    np.testing.assert_array_equal(both.range, expected)
    sphere = both.range == alone[1].range
    assert 0.02 < sphere.mean() < 0.9
    np.testing.assert_array_equal(both.phase[sphere], alone[1].phase[sphere])
    np.testing.assert_array_equal(both.phase[~sphere], alone[0].phase[~sphere])


def test_surface_behind_the_camera_or_along_the_ray_is_missed():
    view, _ = frontal_plane(0.0)
    for surface in (
        Plane([0.0, 0.0, -1.0], [0.0, 0.0, 1.0]),
        Plane([0.1, 0.0, 0.0], [1.0, 0.0, 0.0]),
        Sphere([0.0, 0.0, -2.0], 1.0),
        Sphere([0.0, 3.0, 2.0], 1.0),
        Cylinder([2.0, 0.0, 0.0], [0.0, 0.0, 1.0], 1.0),
    ):
        rendered = render_view(view, surface)
        assert not rendered.mask.any()
        assert np.isnan(rendered.depth).all()


def test_look_at_and_ring():
    pose = look_at([0.3, 0.1, 0.4], [0.0, 0.0, 0.1])
    np.testing.assert_allclose(pose.rotation @ pose.rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(pose.rotation) > 0
    np.testing.assert_allclose((pose * np.array([0.0, 0.0, 0.1]))[:2], 0.0, atol=1e-12)
    assert (pose.rotation @ [0.0, 0.0, 1.0])[1] < 0  # the world's up is up in the image
    np.testing.assert_allclose((pose.rotation @ [0.0, 0.0, 1.0])[0], 0.0, atol=1e-12)
    with pytest.raises(ValueError, match="up"):
        look_at([0.0, 0.0, 1.0], [0.0, 0.0, 0.0])

    views = ring_of_views(5, CAMERA, target=[0.1, 0.0, 0.0], distance=0.7, elevation_deg=30.0)
    assert [view.name for view in views] == [f"{i:03d}.png" for i in range(5)]
    for view in views:
        offset = view.center_in_world - [0.1, 0.0, 0.0]
        np.testing.assert_allclose(np.linalg.norm(offset), 0.7, rtol=1e-12)
        np.testing.assert_allclose(offset[2], 0.35, rtol=1e-12)
        np.testing.assert_allclose(
            view.camera.project(view.cam_from_world * np.array([0.1, 0.0, 0.0])), [24.3, 19.6]
        )


@pytest.mark.parametrize("options", [{"light": "mixed"}, {"sensor": "ideal"}])
def test_unknown_options_are_refused(options):
    with pytest.raises(ValueError, match="expected one of"):
        render_view(make_view(), SURFACES["plane"], **options)


def test_malformed_patterns_are_refused():
    with pytest.raises(ValueError, match="pattern"):
        render_mosaic(make_view(), SURFACES["plane"], pattern=(0, 45, 90, 90))
