"""Phase maps and meshes of objects given by their signed distance: exact, small and fast."""

from __future__ import annotations

from collections.abc import Callable
from functools import reduce

import numpy as np

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.geometry import RigidTransform
from polmvs.polarization.angle_models import phase_from_normal
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.polarization.region import Region
from polmvs.scene import View
from polmvs.surface.mesh_geometry import TriangleMesh, mesh_from_grid

Distance = Callable[[np.ndarray], np.ndarray]

WIDTH, HEIGHT, FOCAL = 132, 112, 150.0
DOLP = 0.5
PHASE_SIGMA = 0.01


def sphere(radius=1.0, center=(0.0, 0.0, 0.0)) -> Distance:
    return lambda p: np.linalg.norm(p - np.asarray(center), axis=-1) - radius


def torus(radius=1.0, tube=0.35) -> Distance:
    def distance(p):
        ring = np.hypot(p[..., 0], p[..., 1]) - radius
        return np.hypot(ring, p[..., 2]) - tube

    return distance


def box(half=(0.8, 0.6, 0.5)) -> Distance:
    def distance(p):
        q = np.abs(p) - np.asarray(half)
        outside = np.linalg.norm(np.maximum(q, 0), axis=-1)
        return outside + np.minimum(q.max(axis=-1), 0)

    return distance


def union(*parts: Distance) -> Distance:
    return lambda p: np.min([part(p) for part in parts], axis=0)


def looking_at(center, target=(0.0, 0.0, 0.0), focal=FOCAL, name="000.png") -> View:
    center = np.asarray(center, float)
    forward = np.asarray(target) - center
    forward /= np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    rotation = np.stack([right, np.cross(forward, right), forward])
    camera = PinholeCamera(
        width=WIDTH, height=HEIGHT, fx=focal, fy=focal, cx=WIDTH / 2, cy=HEIGHT / 2
    )
    return View(
        name=name,
        camera=camera,
        cam_from_world=RigidTransform(rotation, -rotation @ center),
    )


def ring_of_views(num=10, distance=5.0, elevations=(20.0, 50.0), focal=FOCAL) -> list[View]:
    views = []
    for index in range(num):
        azimuth = 2 * np.pi * index / num
        elevation = np.radians(elevations[index % len(elevations)])
        direction = [
            np.cos(elevation) * np.cos(azimuth),
            np.cos(elevation) * np.sin(azimuth),
            np.sin(elevation),
        ]
        views.append(
            looking_at(distance * np.array(direction), focal=focal, name=f"{index:03d}.png")
        )
    return views


def trace(distance: Distance, view: View) -> tuple[np.ndarray, np.ndarray]:
    """Ranges (H, W), inf beside the object, and normals (H, W, 3), world, by sphere tracing."""
    xy = pixel_centers(view.camera.width, view.camera.height)
    rays = view.rays_in_world(xy).reshape(-1, 3)
    ranges = np.zeros(len(rays))
    for _ in range(120):
        ranges += distance(view.center_in_world + ranges[:, None] * rays)
    points = view.center_in_world + ranges[:, None] * rays
    hit = np.abs(distance(points)) < 1e-3
    step = 1e-5
    normals = np.stack(
        [distance(points + step * e) - distance(points - step * e) for e in np.eye(3)], axis=-1
    )
    normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), 1e-12)
    shape = xy.shape[:2]
    return np.where(hit, ranges, np.inf).reshape(shape), normals.reshape(*shape, 3)


def phase_map_of(
    distance: Distance,
    view: View,
    *,
    angle_model: AngleModel = AngleModel.PPA,
    noise: float = 0.0,
    rng: np.random.Generator | None = None,
) -> PhaseMap:
    """What a view sees of an object: dark, on a bright background."""
    ranges, normals = trace(distance, view)
    inside = np.isfinite(ranges)
    rays = view.camera.rays(pixel_centers(view.camera.width, view.camera.height))
    in_cam = normals @ view.cam_from_world.rotation.T
    phase = np.nan_to_num(phase_from_normal(angle_model, in_cam, rays))
    if noise:
        phase = phase + noise * (rng or np.random.default_rng(0)).standard_normal(phase.shape)
    precision = np.where(inside, 1 / PHASE_SIGMA**2, 0)
    samples = np.dstack([DOLP * np.cos(2 * phase), DOLP * np.sin(2 * phase), precision])
    # Specular light, on an unpolarized background.
    measured = np.where(inside[..., None], -samples[..., :2], 0)
    variance = np.full(inside.shape, 4 * DOLP**2 * PHASE_SIGMA**2)
    return PhaseMap(
        view=view,
        region=Region(inside, inside, np.zeros_like(inside)),
        samples=samples.astype(np.float32),
        intensity=np.where(inside, 0.1, 0.6).astype(np.float32),
        diffuse=np.zeros_like(inside),
        lowest_dolp=np.full(inside.shape, round(255 * DOLP), np.uint8),
        polarization=np.dstack([measured, variance, 0 * variance]).astype(np.float32),
    )


def phase_maps_of(distance: Distance, views: list[View], **kwargs) -> list[PhaseMap]:
    return [phase_map_of(distance, view, **kwargs) for view in views]


def extracted(distance, half=1.6, step=0.08) -> TriangleMesh:
    axis = np.arange(-half, half + step, step)
    grid = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1)
    values = distance(grid).astype(np.float32)
    return mesh_from_grid(values, np.full(3, -half), step)


def side_by_side(*parts: TriangleMesh) -> TriangleMesh:
    """One mesh of several that may overlap."""
    return reduce(TriangleMesh.with_faces_of, parts)


def euler_number(mesh: TriangleMesh) -> int:
    return len(mesh.vertices) - mesh.adjacency.nnz // 2 + len(mesh.faces)
