"""From rays to Stokes vectors: specular reflections are traced, diffuse light is looked up.

At each surface, a ray collects the light of the diffuse base (the baked irradiance times the
albedo, polarized at the interface). It continues along a sampled specular reflection with its
Mueller matrix, and ends at the sky. The basis of the Stokes vectors is that of the ray's transverse
plane: the image's x and upward y, turned by the shortest rotation from the optical axis to the ray
(as in :mod:`polmvs.polarization.angle_models`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.geometry import RigidTransform
from polmvs.simulation.scene import SPREAD_NM, MitsubaScene

STRATA = 4  # of a sample's area along each side; third differences need four
MIN_CHUNK_RAYS = 1 << 15
RAYS = STRATA * STRATA  # of a sample in one pass
CHUNK_RAYS = 1 << 21  # at a time: about 300 MB


@dataclass(frozen=True, kw_only=True, eq=False)
class Lens:
    """Rays of a file's samples, and their blur.

    Attributes
    ----------
    corners : (H + 1, W + 1, 2) float32, ``(x / z, y / z)`` of the rays through the corners of the
        samples, camera frame; between them rays are interpolated.
    aperture : radius, metres; 0: pinhole.
    focus : distance of the plane in focus, metres.
    motion : (3,), motion of the camera during an exposure, metres, camera frame.
    """

    corners: NDArray[np.float32]
    aperture: float = 0.0
    focus: float = 1.0
    motion: tuple[float, float, float] = (0.0, 0.0, 0.0)

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of samples."""
        rows, cols = self.corners.shape[:2]
        return rows - 1, cols - 1


@dataclass(frozen=True, kw_only=True, eq=False)
class Traced:
    """Means over the rays of N samples of a file.

    Attributes
    ----------
    stokes : (N, 3), s0, s1, s2 of all light.
    diffuse : (N, 2), s1, s2 of the part's diffuse light only.
    variance : (N,), of one ray in its stratum, of the light behind the sample's own polarizer.
    """

    stokes: Array
    diffuse: Array
    variance: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class Samples:
    """N samples of a file.

    Attributes
    ----------
    places : (N,), flat indices of samples, row by row.
    angles : (N,), of each polarizer, rad.
    wavelengths : (N, 4), nm, of each sample's rays; None without colours.
    """

    places: NDArray[np.int64]
    angles: NDArray[np.float32]
    wavelengths: NDArray[np.float32] | None = None

    def part(self, chosen: slice) -> Samples:
        """Some of them."""
        waves = self.wavelengths
        return Samples(
            places=self.places[chosen],
            angles=self.angles[chosen],
            wavelengths=None if waves is None else waves[chosen],
        )

    def padded(self, num: int) -> Samples:
        """These rays padded by others to a number."""
        add, waves = (0, num - len(self.places)), self.wavelengths
        return Samples(
            places=np.pad(self.places, add),
            angles=np.pad(self.angles, add),
            wavelengths=None if waves is None else np.pad(waves, (add, (0, 0)), mode="edge"),
        )


def trace(
    scene: MitsubaScene,
    lens: Lens,
    cam_from_world: RigidTransform,
    samples: Samples,
    *,
    bounces: int,
    seed: int,
) -> Iterator[tuple[slice, Traced]]:
    """Trace ``RAYS`` rays through each sample, evenly spread over its area.

    Samples are processed in parts to bound the memory.

    Parameters
    ----------
    bounces : number of traced reflections.
    seed : of the random numbers.
    """
    per_chunk = CHUNK_RAYS // RAYS
    num = len(samples.places)
    for start in range(0, num, per_chunk):
        part = slice(start, min(start + per_chunk, num))
        seed_of_part = (seed * 1_000_003 + start) & 0x7FFFFFFF
        yield (
            part,
            _trace_chunk(scene, lens, cam_from_world, samples.part(part), bounces, seed_of_part),
        )


def _trace_chunk(
    scene: MitsubaScene,
    lens: Lens,
    cam_from_world: RigidTransform,
    samples: Samples,
    bounces: int,
    seed: int,
) -> Traced:
    mi, dr = scene.renderer.mi, scene.renderer.dr
    # Kernels are compiled for a number of rays: there are few of these, and they are kept.
    num_samples = len(samples.places)
    samples = samples.padded(max(MIN_CHUNK_RAYS // RAYS, 1 << (num_samples - 1).bit_length()))
    num = len(samples.places) * RAYS
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(dr.opaque(mi.UInt32, seed), num)
    index = dr.arange(mi.UInt32, num)
    site = index // RAYS

    def of_sample(values: NDArray[np.float32]) -> Any:
        return dr.gather(mi.Float, mi.Float(np.ascontiguousarray(values)), site)

    sample = dr.gather(mi.UInt32, mi.UInt32(samples.places.astype(np.uint32)), site)
    direction_in_cam, offset_in_cam = _camera_rays(scene, lens, sample, index % RAYS, sampler)
    world_from_cam = cam_from_world.inverse()
    # Numbers that change with the view are no literals: a kernel would be compiled for each.
    rotation = [_opaque(scene, row) for row in world_from_cam.rotation]
    center = _opaque(scene, world_from_cam.translation)
    direction = _rotated(mi, rotation, direction_in_cam)
    offset = _rotated(mi, rotation, offset_in_cam)
    ray = mi.Ray3f(mi.Point3f(center) + offset, direction)
    if samples.wavelengths is not None:
        ray.wavelengths = type(ray.wavelengths)(*map(of_sample, samples.wavelengths.T))
    total, diffuse = _follow(scene, ray, sampler, bounces)
    # Mitsuba's basis, turned to that of the image; angles count anticlockwise as displayed.
    along, up = _image_basis(mi, direction_in_cam)
    basis = mi.mueller.stokes_basis(-direction)
    cos = dr.dot(basis, _rotated(mi, rotation, along))
    sin = dr.dot(basis, _rotated(mi, rotation, up))
    cos2, sin2 = cos * cos - sin * sin, 2 * sin * cos

    def turned(s1: Any, s2: Any) -> tuple[Any, Any]:
        return cos2 * s1 - sin2 * s2, sin2 * s1 + cos2 * s2

    light = (total[0], *turned(total[1], total[2]), *turned(diffuse[0], diffuse[1]))
    means = _means(scene, light, of_sample(samples.angles), index)
    columns = [np.asarray(mean, np.float64)[:num_samples] for mean in means]
    return Traced(
        stokes=np.stack(columns[:3], axis=1),
        diffuse=np.stack(columns[3:5], axis=1),
        variance=columns[5],
    )


def _means(scene: MitsubaScene, light: tuple[Any, ...], angle: Any, index: Any) -> list[Any]:
    """Means over the rays of each sample: of light as it is, and of the variance of one ray.

    Parameters
    ----------
    light : s0, s1, s2 and more of each ray.
    angle : of each ray's polarizer.
    index : of each ray.
    """
    mi, dr = scene.renderer.mi, scene.renderer.dr
    s0, s1, s2 = light[:3]
    behind = 0.5 * (s0 + dr.cos(2 * angle) * s1 + dr.sin(2 * angle) * s2)
    dr.eval(behind, *light)
    # Third differences along a row of strata: a gradient across the sample is no noise.
    first = index - index % STRATA
    row = [dr.gather(mi.Float, behind, first + k) for k in range(STRATA)]
    differences = dr.square(row[0] - 3 * row[1] + 3 * row[2] - row[3]) / 20
    means = [dr.block_reduce(dr.ReduceOp.Add, v, RAYS) / RAYS for v in (*light, differences)]
    dr.eval(means)
    return means


def _camera_rays(
    scene: MitsubaScene, lens: Lens, sample: Any, step: Any, sampler: Any
) -> tuple[Any, Any]:
    """Unit directions and starts relative to the camera's centre, camera frame."""
    mi, dr = scene.renderer.mi, scene.renderer.dr
    _, width = lens.shape
    corners = mi.Float(np.ascontiguousarray(lens.corners, np.float32).ravel())
    row, col = sample // width, sample % width
    # Strata of the sample's area, and within one at random.
    across, down = sampler.next_1d(), sampler.next_1d()
    across = (mi.Float(step % STRATA) + across) / STRATA
    down = (mi.Float(step // STRATA) + down) / STRATA

    def corner(rows: int, cols: int) -> Any:
        place = 2 * ((row + rows) * (width + 1) + col + cols)
        return mi.Point2f(
            dr.gather(mi.Float, corners, place), dr.gather(mi.Float, corners, place + 1)
        )

    upper = (1 - across) * corner(0, 0) + across * corner(0, 1)
    lower = (1 - across) * corner(1, 0) + across * corner(1, 1)
    plane = (1 - down) * upper + down * lower
    direction = mi.Vector3f(plane.x, plane.y, 1.0)
    offset = mi.Vector3f(0.0)
    if lens.aperture > 0:
        disc = mi.warp.square_to_uniform_disk_concentric(sampler.next_2d())
        offset = mi.Vector3f(lens.aperture * disc.x, lens.aperture * disc.y, 0.0)
        direction = lens.focus * direction - offset
    if any(lens.motion):
        offset = offset + (sampler.next_1d() - 0.5) * _opaque(scene, lens.motion)
    return dr.normalize(direction), offset


def _follow(scene: MitsubaScene, ray: Any, sampler: Any, bounces: int) -> tuple[Any, Any]:
    """Stokes parameters of all light, and s1, s2 of the part's diffuse light, Mitsuba's basis."""
    mi, dr = scene.renderer.mi, scene.renderer.dr
    specular = mi.BSDFContext()
    specular.type_mask = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.DeltaReflection
    matte = mi.BSDFContext()
    matte.type_mask = mi.BSDFFlags.DiffuseReflection
    upright = mi.Vector3f(0.0, 0.0, 1.0)
    part = mi.ShapePtr(scene.part)

    gathered = partial(_gathered, mi, dr)

    # A loop of Dr.Jit: rays that end do not wait for the others.
    def follow(
        active: Any, bounce: Any, ray: Any, sampler: Any, throughput: Any, total: Any, diffuse: Any
    ) -> tuple[Any, ...]:
        hit = scene.scene.ray_intersect(ray, active)
        emitter = hit.emitter(scene.scene, active)
        shining = active & (emitter != None)  # noqa: E711  (of each ray)
        total = total + gathered(throughput, emitter.eval(hit, shining)[0, 0], shining)
        active = active & hit.is_valid() & ~shining
        is_part = active & (hit.shape == part)
        irradiance = _irradiance(scene, hit, active)
        surface = hit.bsdf(ray)
        others = active & ~is_part
        lambertian = surface.eval(matte, hit, upright, others)
        lambertian = hit.to_world_mueller(lambertian, -upright, hit.wi)
        total = total + gathered(throughput @ lambertian, irradiance, others)
        if scene.base is not None:
            leaving = scene.base.eval(matte, hit, upright, is_part)
            leaving = hit.to_world_mueller(leaving, -upright, hit.wi)
            albedo = _albedo(scene, hit, is_part)
            own = gathered(throughput @ leaving, irradiance * albedo, is_part)
            total = total + own
            diffuse = dr.select(bounce == 0, mi.Vector2f(own.y, own.z), diffuse)
        active = active & (bounce < bounces)
        reflected, weight = surface.sample(
            specular, hit, sampler.next_1d(active), sampler.next_2d(active), active
        )
        weight = hit.to_world_mueller(weight, -reflected.wo, hit.wi)
        active = active & (reflected.pdf > 0)
        throughput = throughput @ weight
        ray = hit.spawn_ray(hit.to_world(reflected.wo))
        return active, bounce + 1, ray, sampler, throughput, total, diffuse

    state = (
        mi.Bool(True),
        mi.UInt32(0),
        ray,
        sampler,
        mi.Spectrum(1.0),
        mi.Vector3f(0.0),
        mi.Vector2f(0.0),
    )
    *_, total, diffuse = dr.while_loop(state, lambda active, *_: active, follow)
    return total, diffuse


def _gathered(mi: Any, dr: Any, light: Any, radiance: Any, lit: Any) -> Any:
    """Unpolarized light through what was met so far; its mean over wavelengths."""
    return dr.select(lit, mi.Vector3f(*(dr.mean(light[k, 0] * radiance) for k in range(3))), 0.0)


def _irradiance(scene: MitsubaScene, hit: Any, active: Any) -> Any:
    """Irradiance at places, interpolated between vertices; in slivers, that of the face.

    If a face is 3,000 times as long as high, Mitsuba's float32 barycentric coordinates are NaN.
    """
    dr = scene.renderer.dr
    found = hit.shape.eval_attribute_1("vertex_irradiance", hit, active)
    of_face = hit.shape.eval_attribute_1("face_irradiance", hit, active)
    found = dr.select(dr.isfinite(found), found, of_face)
    if scene.illuminant is None:
        return found
    return found * _relative_illuminant(scene, hit, active)


def _relative_illuminant(scene: MitsubaScene, hit: Any, active: Any) -> Any:
    """White light's spectrum over its mean at the wavelengths of the baked irradiance."""
    mi, dr = scene.renderer.mi, scene.renderer.dr
    baked = dr.zeros(mi.SurfaceInteraction3f)
    baked.wavelengths = type(hit.wavelengths)(*SPREAD_NM)
    return scene.illuminant.eval(hit, active) / dr.mean(scene.illuminant.eval(baked))


def _albedo(scene: MitsubaScene, hit: Any, active: Any) -> Any:
    """Albedo of the object's base: the material's, the mesh's, or that of a printed mark."""
    mi, dr = scene.renderer.mi, scene.renderer.dr
    albedo = scene.albedo.eval(hit, active)
    marks = scene.description.marks
    number = len(marks.centers)
    if not number:
        return albedo
    place = mi.Point2f(0.0)
    marked = mi.Bool(False)
    for index, (center, axes) in enumerate(zip(marks.centers, marks.axes, strict=True)):
        away = hit.p - mi.Point3f(*map(float, center))
        x, y, normal = (mi.Vector3f(*map(float, axis)) for axis in axes)
        local = mi.Point2f(dr.dot(away, x), dr.dot(away, y)) / marks.radius
        inside = (dr.squared_norm(local) < 1) & (dr.dot(hit.n, normal) > 0.3)
        inside &= dr.abs(dr.dot(away, normal)) < marks.radius
        marked |= inside
        place = dr.select(
            inside, mi.Point2f((index + 0.5 + 0.5 * local.x) / number, 0.5 + 0.5 * local.y), place
        )
    printed = scene.mark_prints.eval(place)[0]
    return dr.select(marked, type(albedo)(printed), albedo)


def _opaque(scene: MitsubaScene, values: Array | tuple[float, ...]) -> Any:
    vector = scene.renderer.mi.Vector3f(*map(float, values))
    scene.renderer.dr.make_opaque(vector)
    return vector


def _rotated(mi: Any, rows: list[Any], vector: Any) -> Any:
    return mi.Vector3f(*(row.x * vector.x + row.y * vector.y + row.z * vector.z for row in rows))


def _image_basis(mi: Any, ray: Any) -> tuple[Any, Any]:
    """The image's x and upward y, turned by the shortest rotation from the axis to the ray."""
    scale = 1 / (1 + ray.z)
    along = mi.Vector3f(1 - ray.x * ray.x * scale, -ray.x * ray.y * scale, -ray.x)
    up = mi.Vector3f(ray.x * ray.y * scale, -(1 - ray.y * ray.y * scale), ray.y)
    return along, up
