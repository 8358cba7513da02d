"""Light on planes and spheres under an even sky against the closed forms."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion
from traced_scenes import (
    CAMERA,
    GLOSS,
    SIDE,
    SMOOTH,
    cosines,
    diffuse_dolp,
    fresnel,
    lit_scene,
    refractive_index,
    scaled,
    specular_dolp,
    stokes_of,
    transmittance,
    view_of,
)

from polmvs.camera import pixel_centers
from polmvs.geometry import lengths, unit
from polmvs.io.clouds import Mesh
from polmvs.polarization.angle_models import phase_from_normal
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.mosaic import ANGLES_DEG
from polmvs.scene import View
from polmvs.simulation.irradiance import bake
from polmvs.simulation.lights import environment
from polmvs.simulation.marks import marks_on
from polmvs.simulation.materials import Material
from polmvs.simulation.options import LightingOptions, LightName, Metal, Optics
from polmvs.simulation.scene import MitsubaScene, SceneDescription, build_scene
from polmvs.simulation.sensor import polarizer_images
from polmvs.simulation.surroundings import Surrounding
from polmvs.simulation.truth import true_maps
from polmvs.synthetic.captures import look_at, render_view
from polmvs.synthetic.surfaces import Plane, Sphere


def inner(scene: MitsubaScene, view: View) -> tuple[np.ndarray, np.ndarray]:
    """True normals, and the pixels within the shape whose neighbours are on the same face."""
    _, normals, mask = true_maps(scene, view)
    upright = normals @ view.cam_from_world.rotation[:, 2]
    flat = mask & (
        upright > 0.99 if upright[mask].max() - np.median(upright[mask]) < 1e-3 else mask
    )
    return normals, binary_erosion(flat, iterations=2)


def telecentric_intensities(rays: np.ndarray, normals: np.ndarray, cos: np.ndarray) -> np.ndarray:
    """(4, H, W) of specular light of s0 = 1 whose rays and fields a lens turned onto the axis."""
    field = unit(np.cross(rays, normals))
    # The component in the plane of ray and axis becomes radial, the other one stays.
    radial = unit(np.concatenate([rays[..., :2], np.zeros_like(rays[..., :1])], axis=-1))
    around = np.cross([0.0, 0.0, 1.0], radial)
    tangent = np.cross(around, rays)
    x = (field * tangent).sum(-1) * radial[..., 0] + (field * around).sum(-1) * around[..., 0]
    y = (field * tangent).sum(-1) * radial[..., 1] + (field * around).sum(-1) * around[..., 1]
    angle = np.arctan2(-y, x)
    dolp = specular_dolp(np.nan_to_num(cos).clip(0.01, 1), 1.5)
    return np.stack(
        [0.5 * (1 + dolp * np.cos(2 * (angle - np.radians(one)))) for one in ANGLES_DEG]
    )


def axial_error(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Difference of angles modulo pi, degrees."""
    return np.degrees(np.abs((first - second + np.pi / 2) % np.pi - np.pi / 2))


@pytest.mark.parametrize("shape", ["sphere", "plane"])
def test_specular_light_is_that_of_fresnel(renderer, shape):
    view = view_of(0.22 if shape == "sphere" else 0.3)
    scene = lit_scene(renderer, scaled(shape), GLOSS, samples=16)
    stokes = stokes_of(scene, view)
    normals, mask = inner(scene, view)
    cos = cosines(view, normals)
    use = mask & (cos > 0.15) & (cos < 0.97)
    assert use.sum() > 300
    across, along = fresnel(cos, 1.5)
    dolp = np.hypot(stokes[..., 1], stokes[..., 2]) / stokes[..., 0]
    # Roughness, and float32 of Mitsuba.
    np.testing.assert_allclose(stokes[use][:, 0], 0.5 * (across + along)[use], rtol=0.03)
    np.testing.assert_allclose(dolp[use], specular_dolp(cos, 1.5)[use], atol=0.02)


@pytest.mark.parametrize("optics", list(Optics))
@pytest.mark.parametrize("shape", ["sphere", "plane"])
def test_light_behind_polarizers_is_that_of_the_closed_form(renderer, shape, optics):
    view = view_of(0.22 if shape == "sphere" else 0.3)
    surface = Sphere((0.0, 0.0, 0.1), 0.1)
    if shape == "plane":
        surface = Plane((0.0, 0.0, 0.004), (0, 0, 1), (0.1, 0.075))
    exact = render_view(view, surface, sensor="tilted", s0=1.0)
    scene = lit_scene(renderer, scaled(shape), GLOSS, samples=16)
    stokes = stokes_of(scene, view)
    rays = view.camera.rays(pixel_centers(SIDE, SIDE))
    images = (
        np.stack(
            [
                polarizer_images(stokes, rays, np.full((SIDE, SIDE), float(angle)), optics, 1.0)
                for angle in ANGLES_DEG
            ]
        )
        / stokes[..., 0]
    )
    cos = cosines(view, exact.normals_in_cam)
    _, mask = inner(scene, view)
    use = mask & exact.mask & (cos > 0.2) & (cos < 0.95)
    expected = exact.intensities
    if optics is Optics.TELECENTRIC:
        expected = telecentric_intensities(rays, exact.normals_in_cam, cos)
        assert np.percentile(np.abs(expected - exact.intensities)[:, use], 99) > 0.012
    assert np.percentile(np.abs(images - expected)[:, use], 99) < 0.006


def test_phase_of_both_lights(renderer):
    view = view_of()
    dark = lit_scene(renderer, scaled("sphere"), GLOSS)
    bright = lit_scene(renderer, scaled("sphere"), replace(GLOSS, albedo=(1.0,) * 3))
    _, normals, mask = true_maps(dark, view)
    rays = view.camera.rays(pixel_centers(SIDE, SIDE))
    specular = stokes_of(dark, view)
    diffuse = stokes_of(bright, view) - specular  # the same rays
    cos = cosines(view, normals)
    use = mask & (cos > 0.25) & (cos < 0.9)
    phase = phase_from_normal(AngleModel.PPA, normals, rays)
    off_axis = rays[..., 2] < np.cos(np.radians(12))
    for stokes, turn, dolp in (
        (specular, np.pi / 2, specular_dolp(cos, 1.5)),
        (diffuse, 0.0, diffuse_dolp(cos, 1.5)),
    ):
        aolp = 0.5 * np.arctan2(stokes[..., 2], stokes[..., 1])
        error = axial_error(aolp + turn, phase)
        # In the transverse plane's own basis; its projection on the image turns it off the axis.
        assert np.median(error[use & ~off_axis]) < 0.6
        assert np.median(error[use]) < 2.0
        found = np.hypot(stokes[..., 1], stokes[..., 2])[use] / stokes[..., 0][use]
        assert np.abs(found - dolp[use]).max() < 0.03


def test_diffuse_light_is_what_enters_and_leaves(renderer):
    view = view_of()
    dark = lit_scene(renderer, scaled("sphere"), GLOSS)
    bright = lit_scene(renderer, scaled("sphere"), replace(GLOSS, albedo=(0.5,) * 3))
    _, normals, mask = true_maps(dark, view)
    diffuse = (stokes_of(bright, view) - stokes_of(dark, view))[..., 0]
    cos = cosines(view, normals)
    use = mask & (cos > 0.25)
    # All that enters an even sky's hemisphere: twice the integral of T cos over the cosine.
    grid = (np.arange(2000) + 0.5) / 2000
    entering = 2 * (transmittance(grid, 1.5) * grid).mean()
    # What leaves is spread over the solid angle that refraction makes n^2 times as large.
    leaving = 0.5 * entering * transmittance(cos, 1.5)
    ratio = diffuse[use] / leaving[use]
    assert np.ptp(np.percentile(ratio, [2, 98])) < 0.03
    assert np.median(ratio) == pytest.approx(1.0, abs=0.01)


def test_metal_reflects_by_its_complex_index(renderer):
    view = view_of()
    metal = Material(roughness=SMOOTH, metal=Metal.CHROMIUM)
    scene = lit_scene(renderer, scaled("sphere"), metal, samples=16)
    stokes = stokes_of(scene, view)
    _, normals, mask = true_maps(scene, view)
    cos = cosines(view, normals)
    use = mask & (cos > 0.2) & (cos < 0.97)
    dolp = np.hypot(stokes[..., 1], stokes[..., 2]) / stokes[..., 0]
    np.testing.assert_allclose(
        dolp[use], specular_dolp(cos, refractive_index(metal))[use], atol=0.02
    )


def test_sky_alone_is_unpolarized(renderer):
    # The sky's own light, seen past the shape and through several reflections' worth of passes.
    for light in (LightName.STUDIO, LightName.OVERCAST, LightName.SOFTBOX):
        description = SceneDescription(
            part=scaled("sphere", 0.02),
            material=GLOSS,
            vertex_albedo=None,
            marks=marks_on(scaled("sphere"), 0, 0.01, 0),
            surroundings=[],
            varnish=None,
            environment=environment(LightingOptions(light=light)),
            colour=False,
        )
        scene = build_scene(renderer, description)
        view = view_of(1.0)
        stokes = stokes_of(scene, view)
        _, _, mask = true_maps(scene, view)
        assert (stokes[~mask][:, 0] > 0).all()
        assert np.abs(stokes[~mask][:, 1:]).max() < 1e-6


@pytest.mark.parametrize(
    ("blur", "deviation_px"),
    [
        # A disc of light's deviation along one axis is half its radius, a box's is 1 / sqrt(12).
        ({"aperture": 0.02, "focus": 0.45}, 0.5 * 0.02 * (1 / 0.3 - 1 / 0.45) * 56),
        ({"motion": (0.03, 0.0, 0.0)}, 0.03 / 0.3 * 56 / np.sqrt(12)),
        ({"motion": (0.0, 0.03, 0.0)}, 0.0),  # along the edge
        ({"aperture": 0.02, "focus": 0.3}, 0.0),
    ],
)
def test_blur_of_an_edge_is_that_of_the_lens(renderer, blur, deviation_px):
    """The border of a plane before the sky, across which light goes from little to 1."""
    scene = lit_scene(renderer, scaled("plane"), GLOSS, samples=16)
    top = scene.description.part.vertices[:, 2].max()
    pose = look_at((0.1, 0.0, top + 0.3), (0.1, 0.0, 0.0), (0, 1, 0))
    view = View(name="000.png", camera=CAMERA, cam_from_world=pose)
    light = stokes_of(scene, view, **blur)[24:42, 10:54, 0].mean(axis=0)
    steps = np.diff(light) / (light[-1] - light[0])
    places = np.arange(len(steps)) - (steps * np.arange(len(steps))).sum()
    found = np.sqrt(max(0.0, (steps * places**2).sum()))
    assert found == pytest.approx(deviation_px, abs=0.3)


@pytest.mark.parametrize("varnish", [Material(albedo=(0.05,) * 3, roughness=0.02, ior=1.5), None])
def test_a_varnished_table_shines_as_an_object_of_that_material(renderer, varnish):
    """Without varnish it is matte: unpolarized, of the brightness of its print."""
    plane, view = scaled("plane"), view_of()
    albedo = np.full((4, 4), 0.05, np.float32)
    description = SceneDescription(
        part=scaled("sphere", 0.001),
        material=GLOSS,
        vertex_albedo=None,
        marks=marks_on(plane, 0, 0.01, 0),
        surroundings=[
            Surrounding(mesh=plane, uv=np.zeros((len(plane.vertices), 2), np.float32), print=albedo)
        ],
        varnish=varnish,
        environment=environment(LightingOptions(light=LightName.EVEN)),
        colour=False,
    )
    scene = build_scene(renderer, description)
    bake(scene, bounces=1, samples=2048, spacing=0.05, seed=0)
    found = stokes_of(scene, view)
    as_object = lit_scene(renderer, plane, varnish or GLOSS)
    _, _, mask = true_maps(as_object, view)
    small = true_maps(scene, view)[2]
    use = binary_erosion(mask & ~small, iterations=3)
    assert use.sum() > 300
    if varnish is None:
        np.testing.assert_allclose(found[use] - (0.05, 0.0, 0.0), 0, atol=0.002)
    else:
        np.testing.assert_allclose(found[use], stokes_of(as_object, view)[use], atol=0.002)
        assert np.median(lengths(found[use][:, 1:])) > 0.01


def test_slivers_are_lit_as_other_faces(renderer):
    """Strips 4,000 times as long as high, whose barycentric coordinates are NaN in float32."""
    y = np.linspace(-0.1, 0.1, 4001)
    corners = np.stack([np.tile([-0.1, 0.1], len(y)), np.repeat(y, 2)], axis=1)
    first = 2 * np.arange(len(y) - 1)[:, None]
    strips = Mesh(
        np.insert(corners, 2, 0.1, axis=1),
        np.tile([0.0, 0.0, 1.0], (len(corners), 1)),
        (first + np.array([[0, 1, 3, 0, 3, 2]])).reshape(-1, 3).astype(np.int32),
    )
    halves = np.array([[0, 1, 3], [0, 3, 2]], np.int32)
    whole = Mesh(strips.vertices[[0, 1, -2, -1]], strips.normals[:4], halves)
    paper = Material(roughness=SMOOTH, ior=1.5, albedo=(0.5,) * 3)
    view = view_of()
    of_strips, of_whole = (
        stokes_of(lit_scene(renderer, mesh, paper), view) for mesh in (strips, whole)
    )
    _, _, mask = true_maps(lit_scene(renderer, whole, paper, samples=4), view)
    assert mask.sum() > 1000
    # One ray in 16 of few pixels meets two strips.
    np.testing.assert_allclose(of_strips[mask], of_whole[mask], atol=0.05)
