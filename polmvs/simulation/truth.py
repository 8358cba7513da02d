"""Ground truth of a rendered view, in the layout of ``--gt``, and further files.

In addition to depth, normals and mask there are ``STEM_light.png``, the dominant kind of light of
each pixel of the part (255 specular, 128 diffuse, 0 not the part), and ``STEM_stokes.npy``, (3, H,
W) float32, the light before the sensor: s0, s1, s2 in units of radiance, in the transverse plane of
each pixel's ray (see :mod:`polmvs.simulation.transport`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Mask
from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.io.arrays import save_array
from polmvs.io.ground_truth import write_true_maps, write_views
from polmvs.io.images import write_png
from polmvs.scene import View, stem_of
from polmvs.simulation.camera_model import pinhole_of
from polmvs.simulation.picture import Picture
from polmvs.simulation.scene import MitsubaScene

CAMERAS_FILE = "cameras.json"

SPECULAR, DIFFUSE = 255, 128


def true_maps(scene: MitsubaScene, view: View) -> tuple[Array, Array, Mask]:
    """Depth (H, W), 0 of nothing; normals (H, W, 3), camera frame; mask of the part."""
    camera = view.camera
    xy = pixel_centers(camera.width, camera.height)
    rays = view.rays_in_world(xy).reshape(-1, 3).astype(np.float32)
    shape = camera.height, camera.width
    cast = _cast_one_by_one if scene.renderer.is_scalar else _cast
    flat_distance, world, flat_mask = cast(scene, view.center_in_world, rays)
    distance, mask = flat_distance.reshape(shape), flat_mask.reshape(shape)
    normals = (world @ view.cam_from_world.rotation.T).reshape(*shape, 3)
    return distance * camera.rays(xy)[..., 2], normals, mask


def _cast(
    scene: MitsubaScene, center: Array, rays: NDArray[np.float32]
) -> tuple[Array, Array, Mask]:
    """Distance (N,), 0 of nothing, normal (N, 3) and whether it is the part, of rays (N, 3)."""
    mi = scene.renderer.mi
    directions = mi.Vector3f(*(mi.Float(np.ascontiguousarray(rays[:, k])) for k in range(3)))
    origin = mi.Point3f(*map(float, center))
    scene.renderer.dr.make_opaque(origin)
    hit = scene.scene.ray_intersect(mi.Ray3f(origin, directions))
    valid = np.asarray(hit.is_valid())
    mask = np.asarray(hit.shape == mi.ShapePtr(scene.part)) & valid
    normals = np.stack([np.asarray(one, np.float64) for one in hit.sh_frame.n], axis=-1)
    return np.where(valid, np.asarray(hit.t, np.float64), 0), normals, mask


def _cast_one_by_one(
    scene: MitsubaScene, center: Array, rays: NDArray[np.float32]
) -> tuple[Array, Array, Mask]:
    """As :func:`_cast`, without LLVM."""
    mi = scene.renderer.mi
    distance, normals = np.zeros(len(rays)), np.zeros((len(rays), 3))
    mask = np.zeros(len(rays), np.bool_)
    origin = mi.Point3f(center.tolist())
    for index, ray in enumerate(rays.tolist()):
        hit = scene.scene.ray_intersect(mi.Ray3f(origin, mi.Vector3f(ray)))
        if hit.is_valid():
            distance[index] = hit.t
            normals[index] = np.array(hit.sh_frame.n).ravel()
            mask[index] = hit.shape == scene.part
    return distance, normals, mask


def write_truth(
    folder: Path,
    view: View,
    maps: tuple[Array, Array, Mask],
    picture: Picture,
    *,
    depth_unit_m: float,
) -> None:
    """Write the ground truth of one view.

    Raises
    ------
    DataError
        The system refuses.
    """
    depth, normals, mask = maps
    stem = folder / stem_of(view.name)
    write_true_maps(stem, depth, normals, mask, depth_unit_m=depth_unit_m)
    stokes = _at_pixels(picture.stokes, mask.shape)
    if picture.diffuse is not None:
        diffuse = _at_pixels(picture.diffuse, mask.shape)
        others = np.linalg.norm(stokes[..., 1:] - diffuse, axis=-1)
        dominant = np.where(others > np.linalg.norm(diffuse, axis=-1), SPECULAR, DIFFUSE)
        write_png(f"{stem}_light.png", np.where(mask, dominant, 0).astype(np.uint8))
    channels_first = np.ascontiguousarray(np.moveaxis(stokes, -1, 0), np.float32)
    save_array(Path(f"{stem}_stokes.npy"), channels_first)


def write_cameras(folder: Path, views: Sequence[View], *, depth_unit_m: float) -> None:
    """Write ``cameras.json``; for a distorted lens the camera without distortion, and its rays.

    Raises
    ------
    DataError
        The system refuses.
    """
    camera = views[0].camera
    if not isinstance(camera, PinholeCamera):
        rays = camera.rays(pixel_centers(camera.width, camera.height))
        save_array(folder / "plane_xy.npy", np.asarray(rays[..., :2] / rays[..., 2:], np.float32))
    plain = [replace(view, camera=pinhole_of(view.camera)) for view in views]
    write_views(folder / CAMERAS_FILE, plain, depth_unit_m=depth_unit_m)


def _at_pixels(image: Array, shape: tuple[int, ...]) -> Array:
    """Means over the file's samples of each pixel of the polarization image."""
    if image.shape[:2] == shape:
        return image
    rows, cols = shape
    return np.asarray(image.reshape(rows, 2, cols, 2, -1).mean(axis=(1, 3)))
