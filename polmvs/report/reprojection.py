"""Reprojection of a mesh into a view."""

from __future__ import annotations

import numpy as np

from polmvs.arrays import Array
from polmvs.camera import pixel_centers
from polmvs.scene import View
from polmvs.surface.mesh_geometry import RayScene

MAX_RAYS = 160_000  # a picture, which a thumbnail and half a screen show; 0.1 s


def mesh_normals_in_cam(scene: RayScene, view: View) -> Array:
    """Normals ``(H, W, 3)``, camera frame, of the mesh at each pixel; NaN off the mesh.

    In a large image one ray serves a few neighbouring pixels.
    """
    camera = view.camera
    step = max(1, int(np.ceil(np.sqrt(camera.width * camera.height / MAX_RAYS))))
    centers = pixel_centers(camera.width, camera.height)[step // 2 :: step, step // 2 :: step]
    rays = view.rays_in_world(centers)
    known = np.isfinite(rays).all(axis=-1)
    hits = scene.cast(view.center_in_world, rays[known])
    met = hits.face >= 0
    corners = scene.mesh.vertex_normals[scene.mesh.faces[hits.face[met]]]
    normals = np.einsum("nji,nj->ni", corners, hits.barycentric[met])
    found = np.full((*known.shape, 3), np.nan)
    at = np.flatnonzero(known)[met]
    found.reshape(-1, 3)[at] = normals @ view.cam_from_world.rotation.T
    full = np.repeat(np.repeat(found, step, axis=0), step, axis=1)[: camera.height, : camera.width]
    missing = (camera.height - full.shape[0], camera.width - full.shape[1])
    return np.pad(full, ((0, missing[0]), (0, missing[1]), (0, 0)), mode="edge")
