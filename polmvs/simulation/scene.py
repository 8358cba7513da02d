"""Mitsuba's scene: object, surroundings and light, with diffuse light baked into vertices.

The light from diffuse surfaces does not depend on the view, so it is computed once: each vertex
gets the irradiance that enters its diffuse base (:mod:`polmvs.simulation.irradiance`). A view then
only traces specular reflections (:mod:`polmvs.simulation.transport`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.geometry import RigidTransform
from polmvs.io.clouds import Mesh
from polmvs.simulation.lights import RING_RADII
from polmvs.simulation.marks import Marks
from polmvs.simulation.materials import Material, bsdf_of
from polmvs.simulation.renderer_import import Renderer
from polmvs.simulation.surroundings import Surrounding
from polmvs.simulation.vertex_albedo import ATTRIBUTE, vertex_albedo

# Of the baked irradiance of a colour sensor, which is their mean: its own spectrum is the sky's.
SPREAD_NM = (450.0, 520.0, 580.0, 640.0)
RING_IRRADIANCE = 2.0  # at the camera's distance, facing it


@dataclass(frozen=True, kw_only=True, eq=False)
class SceneDescription:
    """Description of the scene, independent of the renderer.

    Attributes
    ----------
    part : the object, metres, world.
    material : of the object.
    vertex_albedo : (V, 3) of the object's vertices; None: the material's albedo.
    marks : printed on it.
    surroundings : printed surfaces around it.
    varnish : over the surroundings; None: they are matte.
    environment : (H, 2 H, 3) float32, see :func:`polmvs.simulation.lights.environment`.
    colour : whether spectra are rendered.
    """

    part: Mesh
    material: Material
    vertex_albedo: NDArray[np.float32] | None
    marks: Marks
    surroundings: list[Surrounding]
    varnish: Material | None
    environment: NDArray[np.float32]
    colour: bool


@dataclass(frozen=True, kw_only=True, eq=False)
class MitsubaScene:
    """Mitsuba's scene for ray tracing.

    Attributes
    ----------
    renderer : Mitsuba.
    description : what it shows.
    scene : Mitsuba's.
    part : the object's shape.
    shapes : all shapes with a diffuse base, the object's first.
    base : the object's material with a diffuse base of albedo 1; None for conductors.
    albedo : texture of the object's base; None for conductors.
    mark_prints : Mitsuba's texture of the marks' prints; None without marks.
    illuminant : texture of the spectrum of white light, D65; None without colours.
    """

    renderer: Renderer
    description: SceneDescription
    scene: Any
    part: Any
    shapes: tuple[Any, ...]
    base: Any
    albedo: Any
    mark_prints: Any
    illuminant: Any = None


def build_scene(
    renderer: Renderer,
    description: SceneDescription,
    *,
    turn: float = 0.0,
    ring: tuple[RigidTransform, float] | None = None,
) -> MitsubaScene:
    """Make Mitsuba's scene; the irradiance of its vertices is 0 until it is baked.

    Parameters
    ----------
    turn : rotation of the light about the vertical axis, rad.
    ring : pose of the camera with a ring light, and its distance; None without one.
    """
    mi = renderer.mi
    material = description.material
    parts: dict[str, Any] = {"type": "scene"}
    albedo = _albedo_texture(renderer, description)
    bsdf = bsdf_of(material, colour=description.colour)
    if description.vertex_albedo is not None and material.metal is None:
        bsdf["diffuse_reflectance"] = vertex_albedo(renderer, description.vertex_albedo)
    part = _shape(renderer, description.part, mi.load_dict(bsdf))
    if description.vertex_albedo is not None:
        colours = description.vertex_albedo
        if not description.colour:
            colours = colours @ np.array([[0.2126], [0.7152], [0.0722]], np.float32)
        part.add_attribute(ATTRIBUTE, colours.shape[1], colours.ravel())
    parts["part"] = part
    shapes = [part]
    for index, surrounding in enumerate(description.surroundings):
        bitmap = mi.Bitmap(np.repeat(surrounding.print[..., None], 3, -1))
        texture = {"type": "bitmap", "bitmap": bitmap, "raw": "mono" in renderer.variant}
        if description.varnish is not None:
            own = bsdf_of(description.varnish, colour=description.colour)
            own["diffuse_reflectance"] = texture
        else:
            own = {"type": "twosided", "b": {"type": "diffuse", "reflectance": texture}}
        shape = _shape(renderer, surrounding.mesh, mi.load_dict(own), surrounding.uv)
        parts[f"surrounding{index}"] = shape
        shapes.append(shape)
    parts["sky"] = _sky(renderer, description.environment, turn)
    if ring is not None:
        parts["ring"] = _ring(renderer, *ring)
    unit_base = None
    if material.metal is None:
        white = {"type": "uniform", "value": 1.0}
        unit_base = mi.load_dict({**bsdf, "diffuse_reflectance": white})
    prints = None
    if len(description.marks.centers):
        prints = mi.Texture2f(mi.TensorXf(description.marks.print_atlas[..., None]))
    return MitsubaScene(
        renderer=renderer,
        description=description,
        scene=mi.load_dict(parts),
        part=part,
        shapes=tuple(shapes),
        base=unit_base,
        albedo=albedo,
        mark_prints=prints,
        illuminant=mi.load_dict({"type": "d65"}) if description.colour else None,
    )


def _albedo_texture(renderer: Renderer, description: SceneDescription) -> Any:
    """The object's albedo as a texture of Mitsuba."""
    material = description.material
    if material.metal is not None:
        return None
    if description.vertex_albedo is not None:
        return renderer.mi.load_dict(vertex_albedo(renderer, description.vertex_albedo))
    return renderer.mi.load_dict(
        bsdf_of(material, colour=description.colour)["diffuse_reflectance"]
    )


def _shape(renderer: Renderer, mesh: Mesh, bsdf: Any, uv: NDArray[np.float32] | None = None) -> Any:
    """A mesh of Mitsuba with a place for the irradiance of its vertices and faces."""
    shape = _mitsuba_mesh(renderer, mesh, uv, mesh_bsdf=bsdf)
    for element, values in (("vertex", mesh.vertices), ("face", mesh.triangles)):
        shape.add_attribute(f"{element}_irradiance", 1, np.zeros(len(values), np.float32))
    return shape


def _mitsuba_mesh(
    renderer: Renderer, mesh: Mesh, uv: NDArray[np.float32] | None = None, **given: Any
) -> Any:
    """A mesh of Mitsuba with given properties."""
    mi = renderer.mi
    properties = mi.Properties()
    for name, value in given.items():
        properties[name] = value
    shape = mi.Mesh(
        "mesh",
        len(mesh.vertices),
        len(mesh.triangles),
        props=properties,
        has_vertex_normals=True,
        has_vertex_texcoords=uv is not None,
    )
    parameters = mi.traverse(shape)
    parameters["vertex_positions"] = np.asarray(mesh.vertices, np.float32).ravel()
    parameters["vertex_normals"] = np.asarray(mesh.normals, np.float32).ravel()
    parameters["faces"] = np.asarray(mesh.triangles, np.uint32).ravel()
    if uv is not None:
        parameters["vertex_texcoords"] = np.asarray(uv, np.float32).ravel()
    parameters.update()
    return shape


def _sky(renderer: Renderer, image: NDArray[np.float32], turn: float) -> Any:
    """The environment, its top along the world's z; turned about that axis."""
    mi = renderer.mi
    # Mitsuba's image: its up is y, and u = atan2(x, -z) / 2 pi. Turned upright its column 0 looks
    # along the world's y and its columns go clockwise seen from above.
    shifted = np.roll(image[:, ::-1], image.shape[1] // 4, axis=1)
    upright = mi.ScalarTransform4f().rotate([0, 0, 1], float(np.degrees(turn)))
    upright = upright @ mi.ScalarTransform4f().rotate([1, 0, 0], 90)
    bitmap = mi.Bitmap(np.ascontiguousarray(shifted, np.float32))
    return {"type": "envmap", "bitmap": bitmap, "to_world": upright}


def _ring(renderer: Renderer, cam_from_world: RigidTransform, distance: float) -> Any:
    """A ring light about the camera that shines where it looks."""
    inner, outer = (share * distance for share in RING_RADII)
    angle = np.linspace(0, 2 * np.pi, 65)
    circle = np.stack([np.cos(angle), np.sin(angle), np.zeros_like(angle)], axis=-1)
    world_from_cam = cam_from_world.inverse()
    points = np.asarray(world_from_cam * np.concatenate([inner * circle, outer * circle]))
    index = np.arange(64)
    triangles = np.concatenate(
        [
            np.stack([index, index + 65, index + 66], 1),
            np.stack([index, index + 66, index + 1], 1),
        ]
    ).astype(np.int32)
    axis = world_from_cam.rotation @ [0.0, 0.0, 1.0]
    normals = np.broadcast_to(axis, points.shape)
    solid_angle = np.pi * (RING_RADII[1] ** 2 - RING_RADII[0] ** 2)
    emitter = renderer.mi.load_dict(
        {"type": "area", "radiance": {"type": "uniform", "value": RING_IRRADIANCE / solid_angle}}
    )
    return _mitsuba_mesh(renderer, Mesh(points, normals, triangles), emitter=emitter)
