"""Light that moves with the camera: a ring about it, and a turntable's background."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.ndimage import binary_erosion
from traced_scenes import (
    GLOSS,
    SIDE,
    cosines,
    fresnel,
    lit_scene,
    scaled,
    specular_dolp,
    stokes_of,
    transmittance,
    view_of,
)

import polmvs
from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.io.ground_truth import open_ground_truth
from polmvs.simulation.lights import RING_DIM, RING_RADII
from polmvs.simulation.materials import Material
from polmvs.simulation.options import LightName
from polmvs.simulation.scene import RING_IRRADIANCE
from polmvs.simulation.truth import true_maps

TINY = {
    "image_size": (96, 80),
    "views": 2,
    "max_samples": 16,
    "directions": 4,
    "exposure": 1.0,
    "elevation": (12, 12),
}
RING_RADIANCE = RING_IRRADIANCE / (np.pi * (RING_RADII[1] ** 2 - RING_RADII[0] ** 2))


@pytest.mark.parametrize("elevation_deg", [20.0, 75.0])
def test_a_ring_light_shows_where_normals_point_to_the_camera(renderer, elevation_deg):
    distance = 0.3
    narrow = PinholeCamera(width=SIDE, height=SIDE, fx=320.0, fy=320.0, cx=30.0, cy=33.0)
    view = replace(view_of(distance, elevation_deg), camera=narrow)
    light = {"light": LightName.RING, "ring": (view.cam_from_world, distance)}
    scene = lit_scene(renderer, scaled("sphere"), GLOSS, samples=16, **light)
    stokes = stokes_of(scene, view)
    # Where the mirrored ray meets the camera's plane, in distances: in the ring it shines.
    depth, normals, mask = true_maps(scene, view)
    rays = view.camera.rays(pixel_centers(SIDE, SIDE))
    cos = cosines(view, normals)
    mirrored = rays + 2 * cos[..., None] * normals
    points = rays * (depth / rays[..., 2])[..., None]
    back = mirrored[..., 2] < -0.1
    reach = points[..., 2] / np.where(back, -mirrored[..., 2], 1)
    met = np.linalg.norm((points + reach[..., None] * mirrored)[..., :2], axis=-1) / distance
    blurred = 0.02  # of a pixel, the roughness and the ring's corners
    lit = mask & back & (met > RING_RADII[0] + blurred) & (met < RING_RADII[1] - blurred)
    dim = mask & (cos > 0.2) & (~back | (met < RING_RADII[0] - blurred) | (met > 0.3))
    assert lit.sum() > 20
    assert np.degrees(np.arccos(cos[lit])).max() < 10
    assert (dim & (met < RING_RADII[0])).sum() > 20
    across, along = fresnel(np.clip(cos, 0.01, 1), 1.5)
    reflected = 0.5 * (across + along)
    np.testing.assert_allclose(stokes[lit][:, 0], RING_RADIANCE * reflected[lit], rtol=0.03)
    np.testing.assert_allclose(stokes[dim][:, 0], RING_DIM * reflected[dim], rtol=0.05)
    dolp = np.hypot(stokes[..., 1], stokes[..., 2])[lit] / stokes[lit][:, 0]
    np.testing.assert_allclose(dolp, specular_dolp(cos[lit], 1.5), atol=0.01)
    assert dolp.max() < 0.03  # which is why it is a hard light


def test_a_ring_light_lights_a_matt_surface_as_a_ring_does(renderer):
    """A plane that faces the camera: the integral over the ring, and the room's."""
    distance = 0.4
    view = view_of(distance, 89.0)
    paper = Material(roughness=0.3, ior=1.5, albedo=(1.0,) * 3)
    light = {"light": LightName.RING, "ring": (view.cam_from_world, distance)}
    scene = lit_scene(renderer, scaled("plane", 0.1), paper, samples=1024, spacing=0.01, **light)
    found = np.asarray(renderer.mi.traverse(scene.part)["vertex_irradiance"])
    vertices, normals = scene.description.part.vertices, scene.description.part.normals
    middle = (normals[:, 2] > 0.9) & (np.linalg.norm(vertices[:, :2], axis=1) < 0.02)
    from_ring = view.center_in_world[2] - vertices[middle][0, 2]
    # int L cos^2 / r^2 dA over radii rho, cos = h / r, r^2 = h^2 + rho^2.
    rho = np.linspace(*RING_RADII, 2001) * distance
    rho = 0.5 * (rho[1:] + rho[:-1])
    squared = from_ring**2 + rho**2
    enters = transmittance(from_ring / np.sqrt(squared), 1.5) / transmittance(np.array(1.0), 1.5)
    width = (RING_RADII[1] - RING_RADII[0]) * distance / len(rho)
    ring = (2 * np.pi * rho * from_ring**2 / squared**2 * enters).sum() * width * RING_RADIANCE
    grid = (np.arange(2000) + 0.5) / 2000
    enters = transmittance(grid, 1.5) / transmittance(np.array(1.0), 1.5)
    room = np.pi * RING_DIM * 2 * (enters * grid).mean()
    assert found[middle].mean() == pytest.approx(ring + room, rel=0.02)
    assert ring > 8 * room


@pytest.fixture(scope="module")
def turned(renderer, tmp_path_factory):
    """Light and depth of two views of a capture, a right angle apart, just above the table."""

    def capture(shape, **options):
        folder = tmp_path_factory.mktemp("turned") / shape
        options = {"light": "studio", "path": "arc", "azimuth": (20, 110), **TINY, **options}
        polmvs.simulate(shape, folder, material="black-plastic", marks=0, **options)
        truth = open_ground_truth(folder)
        lights = [np.load(folder / "gt" / f"{name[:-4]}_stokes.npy")[0] for name in truth.names]
        seen = [np.nan_to_num(truth.depth(name)) > 0 for name in truth.names]
        return lights, seen

    return capture


def difference(lights, where):
    """Of the light of two views, relative: that which a tenth of the pixels exceeds."""
    first, second = (light[where] for light in lights)
    return np.percentile(np.abs(first - second) / (first + second), 90)


def test_light_stands_still_while_the_object_turns(turned):
    """A sphere turns onto itself: it looks the same from all sides, unless the light turns too."""
    lights, seen = turned("sphere", surroundings="nothing", turntable=True)
    inner = binary_erosion(seen[0])
    assert difference(lights, inner) < 0.03
    lights, _ = turned("sphere", surroundings="nothing")
    assert difference(lights, inner) > 0.2


def test_background_stands_still_while_table_and_object_turn(turned):
    lights, seen = turned("mug", turntable=True)
    background = ~seen[0] & ~seen[1]
    assert background.sum() > 100
    assert difference(lights, background) < 0.01
    assert difference(lights, seen[0] & seen[1]) > 0.2  # the table's print is another
    assert (seen[0] != seen[1]).sum() > 20  # and so is the side of the handle
