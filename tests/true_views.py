"""Dense views of analytic surfaces, as they truly are."""

import numpy as np
from scenes import CAMERA, Scene, phase_map_of

from polmvs.surface.dense_view import SurfaceSamples, dense_view, lattice_points
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Plane, Sphere

BALL = Sphere(center=np.array([0.0, 0.0, -0.3]), radius=0.35)
BOARD = Plane(point=np.zeros(3), normal=np.array([0.1, -0.05, 1.0]), extent=(0.12, 0.15))
SIGMA = 1e-3  # of the true views' ranges, as a share


def scene_of(surface, num_views=3):
    views = ring_of_views(
        num_views, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=65, roll_deg=20
    )
    rendered = [render_view(v, surface, s0=0.2, background=0.6) for v in views]
    return Scene(surface, views, rendered, [phase_map_of(r) for r in rendered])


def true_samples(scene, k, stride=2):
    """The surface at a view's lattice, and where the lattice hits it."""
    view = scene.views[k]
    everywhere = np.ones((view.camera.height // stride, view.camera.width // stride), bool)
    xy = lattice_points(everywhere, stride)
    rays = view.camera.rays(xy) @ view.cam_from_world.rotation
    distance, normals = scene.surface.intersect(view.center_in_world, rays)
    hit = np.isfinite(distance)
    some = np.full(len(xy), SIGMA)
    with np.errstate(invalid="ignore"):
        log_range = np.log(distance)
    samples = SurfaceSamples(xy, rays, log_range, normals, some, some, np.ones(len(xy)))
    return samples[hit], hit.reshape(everywhere.shape)


def true_view(scene, k, stride=2):
    samples, hit = true_samples(scene, k, stride)
    return dense_view(samples, hit, stride)
