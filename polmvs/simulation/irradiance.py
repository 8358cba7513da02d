"""Irradiance that enters the diffuse base at every vertex, by Mitsuba's path tracer.

The base under a dielectric receives ``E = int L T(theta) / T(0) cos(theta) dw`` with Fresnel's
transmittance T; a matte surface the same with T = 1. Light is gathered at some of the vertices,
spread over surface and orientation, by emitter and hemisphere samples with the balance heuristic,
on one low-discrepancy set of directions with a random shift for each vertex. The others are
interpolated.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.arrays import Array
from polmvs.simulation.scene import SPREAD_NM, MitsubaScene

CHUNK = 1 << 21  # paths at a time: about 100 MB
NORMAL_WEIGHT = 3.0  # a right angle between normals counts as 4.2 spacings: edges stay sharp
NORMAL_CELLS = 2.5  # normals that differ by more than about 23 degrees are separate
NEIGHBORS = 16
SPREAD_CHUNK = 1 << 16  # vertices at a time: about 50 MB


def bake(scene: MitsubaScene, *, bounces: int, samples: int, spacing: float, seed: int) -> None:
    """Compute the irradiance of all vertices.

    Parameters
    ----------
    bounces : number of traced reflections.
    samples : directions at each vertex.
    spacing : between the vertices of the object at which light is gathered, metres.
    seed : of the directions.
    """
    material, varnish = scene.description.material, scene.description.varnish
    mi = scene.renderer.mi
    meshes = [scene.description.part, *(s.mesh for s in scene.description.surroundings)]
    for index, (shape, mesh) in enumerate(zip(scene.shapes, meshes, strict=True)):
        is_part = index == 0
        if is_part and material.metal is not None:
            continue
        vertices, normals = mesh.vertices, mesh.normals
        chosen = _representatives(vertices, normals, spacing) if is_part else slice(None)
        coat = material if is_part else varnish
        ior = None if coat is None else coat.ior
        light = _Gathering(scene=scene, ior=ior, bounces=bounces, samples=samples)
        gathered = light.at(vertices[chosen], normals[chosen], seed + index)
        if is_part:
            values = _spread(
                vertices[chosen], normals[chosen], gathered, vertices, normals, spacing
            )
        else:
            values = gathered
        parameters = mi.traverse(shape)
        parameters["vertex_irradiance"] = np.asarray(values, np.float32)
        parameters["face_irradiance"] = values[mesh.triangles].mean(axis=1).astype(np.float32)
        parameters.update()


def _representatives(vertices: Array, normals: Array, spacing: float) -> NDArray[np.int64]:
    """Indices of vertices, one of each cell in space that faces about the same way."""
    cells = np.concatenate([np.floor(vertices / spacing), np.rint(NORMAL_CELLS * normals)], axis=1)
    _, first = np.unique(cells.astype(np.int64), axis=0, return_index=True)
    return np.asarray(first, np.int64)


def _spread(
    places: Array,
    place_normals: Array,
    values: Array,
    vertices: Array,
    normals: Array,
    spacing: float,
) -> Array:
    """Values at vertices, interpolated from places near them that face the same way."""
    tree = cKDTree(np.concatenate([places / spacing, NORMAL_WEIGHT * place_normals], axis=1))
    num = min(NEIGHBORS, len(places))
    found = np.empty(len(vertices))
    for start in range(0, len(vertices), SPREAD_CHUNK):
        part = np.s_[start : start + SPREAD_CHUNK]
        wanted = np.concatenate([vertices[part] / spacing, NORMAL_WEIGHT * normals[part]], axis=1)
        distance, index = tree.query(wanted, k=num)
        distance, index = distance.reshape(-1, num), index.reshape(-1, num)
        weights = np.exp(-0.5 * np.square(distance)) + 1e-9
        found[part] = (weights * values[index]).sum(axis=1) / weights.sum(axis=1)
    return found


@dataclass(frozen=True, kw_only=True)
class _Gathering:
    """Settings of gathering light at places: surface, reflections and samples."""

    scene: MitsubaScene
    ior: float | None
    bounces: int
    samples: int

    def at(self, points: Array, normals: Array, seed: int) -> Array:
        """Irradiance (N,) at points with their normals."""
        step = max(1, CHUNK // self.samples)
        parts = [
            _gather(self, points[at : at + step], normals[at : at + step], seed * 7919 + at)
            for at in range(0, len(points), step)
        ]
        return np.concatenate(parts) if parts else np.zeros(0)

    def by_hemisphere(self, place: Any, points: Any, sampler: Any) -> Any:
        """Irradiance by samples of the hemisphere: surfaces, and emitters with their MIS weight."""
        scene = self.scene
        mi, dr = scene.renderer.mi, scene.renderer.dr
        local = mi.warp.square_to_cosine_hemisphere(points)
        cosine = local.z
        ray = mi.Ray3f(place.p, mi.Frame3f(place.n).to_world(local))
        ray.wavelengths = place.wavelengths
        hit = scene.scene.ray_intersect(ray)
        density = cosine / dr.pi
        emitter = hit.emitter(scene.scene)
        has_emitter = emitter != None  # noqa: E711  (of each ray)
        emitted = self.brightness(emitter.eval(hit, has_emitter))
        record = mi.DirectionSample3f(scene.scene, hit, place)
        of_emitter = scene.scene.pdf_emitter_direction(place, record, has_emitter)
        emitted *= density / (density + of_emitter)
        indirect = mi.Float(0.0)
        if self.bounces > 1:
            path = mi.load_dict(
                {"type": "path", "max_depth": self.bounces, "rr_depth": 64, "hide_emitters": True}
            )
            found, _, _ = path.sample(
                scene.scene, sampler, mi.RayDifferential3f(ray), None, hit.is_valid() & ~has_emitter
            )
            indirect = dr.select(hit.is_valid() & ~has_emitter, self.brightness(found), 0.0)
        return dr.pi * self.entering(cosine) * (dr.select(has_emitter, emitted, 0.0) + indirect)

    def by_emitters(self, place: Any, points: Any) -> Any:
        """Irradiance by samples of the emitters, with their MIS weight."""
        dr = self.scene.renderer.dr
        towards, weight = self.scene.scene.sample_emitter_direction(place, points, True)
        cosine = dr.dot(towards.d, place.n)
        lit = (cosine > 0) & (towards.pdf > 0)
        share = towards.pdf / (towards.pdf + cosine / dr.pi)
        entering = self.entering(dr.maximum(cosine, 1e-6))
        return dr.select(lit, self.brightness(weight) * cosine * entering * share, 0.0)

    def brightness(self, value: Any) -> Any:
        """First element of Mueller's matrix, for unpolarized light, mean over wavelengths."""
        return self.scene.renderer.dr.mean(value[0, 0])

    def entering(self, cosine: Any) -> Any:
        """Transmittance of unpolarized light, over that at normal incidence."""
        mi, dr, ior = self.scene.renderer.mi, self.scene.renderer.dr, self.ior
        if ior is None:
            return mi.Float(1.0)
        refracted = dr.sqrt(1 - (1 - cosine * cosine) / ior**2)
        across = dr.square((cosine - ior * refracted) / (cosine + ior * refracted))
        along = dr.square((ior * cosine - refracted) / (ior * cosine + refracted))
        return (1 - 0.5 * (across + along)) / (1 - ((ior - 1) / (ior + 1)) ** 2)


def _gather(light: _Gathering, points: Array, normals: Array, seed: int) -> Array:
    """Irradiance (N,) at the points of one chunk."""
    scene, samples = light.scene, light.samples
    mi, dr = scene.renderer.mi, scene.renderer.dr
    num = len(points) * samples
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed & 0x7FFFFFFF), num)
    index = dr.arange(mi.UInt32, num)
    site, step = index // samples, index % samples
    offset = 1e-4 * float(np.ptp(scene.description.part.vertices, axis=0).max())

    def at_site(values: Array) -> Any:
        columns = [mi.Float(np.ascontiguousarray(values[:, k], np.float32)) for k in range(3)]
        return mi.Vector3f(*(dr.gather(mi.Float, column, site) for column in columns))

    shifts = np.random.default_rng(seed).uniform(size=(len(points), 4)).astype(np.float32)

    def stratified(first: int) -> Any:
        # Roberts' sequence: additive, of the plastic number.
        values = []
        for k, step_size in enumerate((0.7548776662466927, 0.5698402909980532)):
            shift = dr.gather(mi.Float, mi.Float(shifts[:, first + k].copy()), site)
            value = mi.Float(step) * step_size + shift
            values.append(value - dr.floor(value))
        return mi.Point2f(*values)

    place = dr.zeros(mi.Interaction3f, num)
    place.n = at_site(normals)
    place.p = mi.Point3f(at_site(points + offset * normals))
    if scene.description.colour:
        place.wavelengths = type(place.wavelengths)(*SPREAD_NM)
    total = light.by_hemisphere(place, stratified(0), sampler)
    total += light.by_emitters(place, stratified(2))
    summed = dr.block_reduce(dr.ReduceOp.Add, total, samples)
    return np.asarray(summed, np.float64) / samples
