"""Small scenes, and the light that reaches a camera of 64x64 px from them."""

from typing import Any

import numpy as np

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.geometry import RigidTransform
from polmvs.io.clouds import Mesh
from polmvs.scene import View
from polmvs.simulation.irradiance import bake
from polmvs.simulation.lights import environment
from polmvs.simulation.marks import marks_on
from polmvs.simulation.materials import METALS, Material
from polmvs.simulation.options import LightingOptions, LightName
from polmvs.simulation.renderer_import import Renderer
from polmvs.simulation.scene import MitsubaScene, SceneDescription, build_scene
from polmvs.simulation.transport import Lens, Samples, trace
from polmvs.synthetic.captures import look_at, rolled
from polmvs.synthetic.shapes import named_shape

SIDE = 64  # px
CAMERA = PinholeCamera(width=SIDE, height=SIDE, fx=56.0, fy=56.0, cx=30.0, cy=33.0)
SMOOTH = 0.004  # roughness; slopes of 0.2 degrees
GLOSS = Material(roughness=SMOOTH, ior=1.5)


def refractive_index(material: Material) -> complex:
    """Of a dielectric, or ``n + i k`` of a metal at 550 nm."""
    if material.metal is None:
        return complex(material.ior)
    n, k, _ = METALS[material.metal]
    return complex(n, k)


def fresnel(cos_incidence: np.ndarray, index: complex) -> tuple[np.ndarray, np.ndarray]:
    """Reflectances ``(R_s, R_p)`` of a smooth surface in air.

    Parameters
    ----------
    cos_incidence : (...), 0 to 1.
    index : refractive index ``n + i k``.
    """
    c = np.asarray(cos_incidence, np.complex128)
    refracted = np.sqrt(index**2 - (1 - c * c))
    across = (c - refracted) / (c + refracted)
    along = (index**2 * c - refracted) / (index**2 * c + refracted)
    return np.abs(across) ** 2, np.abs(along) ** 2


def transmittance(cos_incidence: np.ndarray, index: complex) -> np.ndarray:
    """Share of unpolarized light that enters a dielectric."""
    across, along = fresnel(cos_incidence, index)
    return np.asarray(1 - 0.5 * (across + along))


def specular_dolp(cos_incidence: np.ndarray, index: complex) -> np.ndarray:
    """Degree of polarization of unpolarized light that a surface reflects."""
    across, along = fresnel(cos_incidence, index)
    return np.asarray((across - along) / (across + along))


def diffuse_dolp(cos_emergence: np.ndarray, index: complex) -> np.ndarray:
    """Degree of polarization of unpolarized light that leaves a dielectric."""
    across, along = fresnel(cos_emergence, index)
    with np.errstate(invalid="ignore"):  # nothing leaves at grazing emergence
        return np.asarray((across - along) / (2 - across - along))


def view_of(distance: float = 0.22, elevation_deg: float = 35.0) -> View:
    """A rolled camera above the shape's middle, which fills a field of 60 degrees."""
    up, target = np.radians(elevation_deg), np.array([0.0, 0.0, 0.1])
    away = distance * np.array([np.cos(up) * 0.6, np.cos(up) * 0.8, np.sin(up)])
    pose = rolled(look_at(target + away, target), 0.4)
    return View(name="000.png", camera=CAMERA, cam_from_world=pose)


def lit_scene(
    renderer: Renderer,
    mesh: Mesh,
    material: Material,
    *,
    samples: int = 2048,
    spacing: float = 0.05,
    light: LightName = LightName.EVEN,
    ring: tuple[RigidTransform, float] | None = None,
) -> MitsubaScene:
    """A shape alone under an even sky, or another light."""
    description = SceneDescription(
        part=mesh,
        material=material,
        vertex_albedo=None,
        marks=marks_on(mesh, 0, 0.01, 0),
        surroundings=[],
        varnish=None,
        environment=environment(LightingOptions(light=light)),
        colour=False,
    )
    scene = build_scene(renderer, description, ring=ring)
    bake(scene, bounces=1, samples=samples, spacing=spacing, seed=0)
    return scene


def scaled(name: str, size: float = 0.2) -> Mesh:
    shape = named_shape(name)
    return Mesh(shape.vertices * size, shape.normals, shape.triangles)


def stokes_of(scene: MitsubaScene, view: View, **blur: Any) -> np.ndarray:
    """(H, W, 3), in the rays' transverse planes, of small samples about the pixels' centres."""
    centers = pixel_centers(SIDE, SIDE).reshape(-1, 1, 2)
    # One cell of four corners for each pixel: a tenth of it, so that edges and curvature are none.
    rays = view.camera.rays(np.concatenate([centers - 0.05, centers + 0.05], axis=1))
    low, high = np.moveaxis(rays[..., :2] / rays[..., 2:], 1, 0)
    grid = np.empty((2 * len(low), 2, 2))
    grid[0::2, 0], grid[0::2, 1] = low, np.stack([high[:, 0], low[:, 1]], 1)
    grid[1::2, 0], grid[1::2, 1] = np.stack([low[:, 0], high[:, 1]], 1), high
    samples = Samples(
        places=np.arange(0, 2 * len(low) - 1, 2), angles=np.zeros(len(low), np.float32)
    )
    lens = Lens(corners=grid.astype(np.float32), **blur)
    parts = trace(scene, lens, view.cam_from_world, samples, bounces=2, seed=1)
    return np.concatenate([found.stokes for _, found in parts]).reshape(SIDE, SIDE, 3)


def cosines(view: View, normals: np.ndarray) -> np.ndarray:
    return -(normals * view.camera.rays(pixel_centers(SIDE, SIDE))).sum(axis=-1)
