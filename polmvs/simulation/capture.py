"""Render a whole capture with its ground truth."""

from __future__ import annotations

import json
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.geometry import lengths
from polmvs.io.ground_truth import DEPTH_UNIT_M
from polmvs.io.images import write_bytes, write_png
from polmvs.io.intrinsics import Intrinsics, write_intrinsics
from polmvs.parallel import OnProgress, no_progress
from polmvs.scene import View, stem_of
from polmvs.simulation.camera_path import camera_views
from polmvs.simulation.irradiance import bake
from polmvs.simulation.lights import environment
from polmvs.simulation.marks import marks_on
from polmvs.simulation.materials import material_of
from polmvs.simulation.mesh_input import object_mesh
from polmvs.simulation.options import (
    LightingOptions,
    ObjectOptions,
    PathOptions,
    RenderingOptions,
    SceneryOptions,
    SensorOptions,
)
from polmvs.simulation.renderer_import import import_renderer
from polmvs.simulation.scene import MitsubaScene, SceneDescription, build_scene
from polmvs.simulation.sensor import (
    Channels,
    draw_channels,
    expose,
    polarizer_images,
    sample_angles,
    sample_centers,
)
from polmvs.simulation.surroundings import surroundings
from polmvs.simulation.transport import Lens, trace

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class Simulation:
    """All options of a simulated capture."""

    object: ObjectOptions = field(default_factory=ObjectOptions)
    lighting: LightingOptions = field(default_factory=LightingOptions)
    scenery: SceneryOptions = field(default_factory=SceneryOptions)
    path: PathOptions = field(default_factory=PathOptions)
    sensor: SensorOptions = field(default_factory=SensorOptions)
    rendering: RenderingOptions = field(default_factory=RenderingOptions)


def simulate_capture(
    mesh: str, out: Path, simulation: Simulation, *, on_progress: OnProgress = no_progress
) -> int:
    """Render a capture; the number of its views."""
    options = simulation
    part = object_mesh(mesh, options.object)
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    size = float((high - low).max())
    radius = float(lengths(part.vertices[:, :2] @ np.eye(2, 3)).max())
    seed = options.rendering.seed
    width, height = options.sensor.image_size
    focal = 0.5 * width / np.tan(np.radians(options.sensor.field_of_view / 2))
    camera = PinholeCamera(
        width=width // 2,
        height=height // 2,
        fx=focal / 2,
        fy=focal / 2,
        cx=width / 4,
        cy=height / 4,
    )
    target = 0.5 * (low + high)
    reach = 0.5 * float(np.linalg.norm(high - low))
    distance = options.path.distance or reach / np.sin(
        np.arctan(0.8 * 0.5 * camera.height / camera.fy)
    )
    views = camera_views(options.path, camera, target, distance, seed)
    renderer = import_renderer(variant=options.rendering.variant)
    description = SceneDescription(
        part=part,
        material=material_of(options.object),
        vertex_albedo=None,
        marks=marks_on(part, options.object.marks, options.object.mark_size * size, seed),
        surroundings=surroundings(options.scenery, size, radius, seed),
        environment=environment(options.lighting),
        colour=False,
    )
    scene = build_scene(renderer, description)
    bake(scene, bounces=options.lighting.bounces, samples=256, spacing=size / 30, seed=seed)
    raw, gt = out / "raw", out / "gt"
    raw.mkdir(parents=True, exist_ok=True)
    gt.mkdir(exist_ok=True)
    channels = draw_channels(options.sensor, seed)
    exposure = 1.0
    images = {
        view.name: {
            "K": camera.K.tolist(),
            "cam_from_world": np.column_stack(
                [view.cam_from_world.rotation, view.cam_from_world.translation]
            ).tolist(),
        }
        for view in views
    }
    content = {"width": camera.width, "height": camera.height, "images": images}
    write_bytes(gt / "cameras.json", json.dumps(content, indent=1).encode())
    intrinsics = Intrinsics(
        model="PINHOLE",
        width=camera.width,
        height=camera.height,
        params=(camera.fx, camera.fy, camera.cx, camera.cy),
    )
    write_intrinsics(out / "camera.txt", intrinsics)
    for index, view in enumerate(views):
        _write_view(scene, view, options, channels, exposure, raw, gt, index)
        on_progress(1)
    return len(views)


def _write_view(
    scene: MitsubaScene,
    view: View,
    options: Simulation,
    channels: Channels,
    exposure: float,
    raw: Path,
    gt: Path,
    index: int,
) -> None:
    camera = view.camera
    rows, cols = 2 * camera.height, 2 * camera.width
    grid = 0.5 * np.stack(np.meshgrid(np.arange(cols + 1), np.arange(rows + 1)), axis=-1)
    rays = camera.rays(grid)
    lens = Lens(corners=(rays[..., :2] / rays[..., 2:]).astype(np.float32))
    which = sample_angles(options.sensor, (rows, cols))
    angles = np.radians(np.array(channels.angles_deg))[which].ravel().astype(np.float32)
    num = 16
    traced = trace(
        scene,
        lens,
        view.cam_from_world,
        np.arange(rows * cols),
        angles,
        num,
        bounces=options.lighting.bounces,
        seed=options.rendering.seed * 100_003 + index,
    )
    stokes = (traced.stokes / num).reshape(rows, cols, 3)
    centers = sample_centers(camera, options.sensor.sensor)
    light = polarizer_images(
        stokes,
        camera.rays(centers),
        np.array(channels.angles_deg)[which],
        options.sensor.optics,
        channels.diattenuation,
    )
    light = light * np.array(channels.gains)[which]
    rng = np.random.default_rng([options.rendering.seed, 3, index])
    write_png(raw / view.name, expose(light, options.sensor, exposure, rng))
    _write_truth(scene, view, gt)


def _write_truth(scene: MitsubaScene, view: View, gt: Path) -> None:
    mi = scene.renderer.mi
    camera = view.camera
    xy = pixel_centers(camera.width, camera.height).reshape(-1, 2)
    rays = view.rays_in_world(xy).astype(np.float32)
    d = mi.Vector3f(*(mi.Float(rays[:, k].copy()) for k in range(3)))
    hit = scene.scene.ray_intersect(mi.Ray3f(mi.Point3f(*map(float, view.center_in_world)), d))
    valid = np.asarray(hit.is_valid())
    mask = (np.asarray(hit.shape == mi.ShapePtr(scene.part)) & valid).reshape(
        camera.height, camera.width
    )
    depth = np.where(valid, np.asarray(hit.t, np.float64) * camera.rays(xy)[:, 2], 0)
    normals = np.stack([np.asarray(c, np.float64) for c in hit.sh_frame.n], axis=1)
    normals = (normals @ view.cam_from_world.rotation.T).reshape(camera.height, camera.width, 3)
    stem = gt / stem_of(view.name)
    encoded = np.rint(depth / DEPTH_UNIT_M).reshape(camera.height, camera.width)
    encoded = np.where(encoded <= np.iinfo(np.uint16).max, encoded, 0)
    write_png(f"{stem}_depth.png", encoded.astype(np.uint16))
    write_png(f"{stem}_mask.png", np.where(mask, 255, 0).astype(np.uint8))
    coded = np.rint((np.where(mask[..., None], normals, 0) + 1) * 32767.5)
    write_png(f"{stem}_normal.png", coded.astype(np.uint16)[..., ::-1].copy())
