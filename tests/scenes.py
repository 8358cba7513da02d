"""Small analytic scenes that several test files share."""

from dataclasses import dataclass, replace

import numpy as np

from polmvs.camera import PinholeCamera
from polmvs.polarization.angle_models import model_rays, phase_direction
from polmvs.polarization.kinds import Light
from polmvs.polarization.phase_map import PhaseMap, build_phase_map
from polmvs.polarization.region import find_region
from polmvs.polarization.stokes import Stokes
from polmvs.scene import Seeds, Tracks, View
from polmvs.synthetic.captures import SyntheticView, render_view, ring_of_views
from polmvs.synthetic.surfaces import Plane

CAMERA = PinholeCamera(width=160, height=128, fx=120.0, fy=120.0, cx=80.0, cy=64.0)


@dataclass(frozen=True)
class Scene:
    surface: object
    views: list[View]
    rendered: list[SyntheticView]
    maps: list[PhaseMap]

    def surface_points(self, num: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
        """True points and normals (world), from pixels of the first view well inside."""
        first, view = self.rendered[0], self.views[0]
        inside = first.mask.copy()
        inside[:12], inside[-12:], inside[:, :12], inside[:, -12:] = False, False, False, False
        pixels = np.argwhere(inside)
        chosen = pixels[np.random.default_rng(seed).choice(len(pixels), num, replace=False)]
        rays = view.camera.rays(chosen[:, ::-1] + 0.5)
        in_cam = rays * first.range[chosen[:, 0], chosen[:, 1], None]
        normals = first.normals_in_cam[chosen[:, 0], chosen[:, 1]]
        world = view.cam_from_world.inverse()
        return world * in_cam, normals @ world.rotation.T

    def seeds(self, num: int, sigma: float = 1e-4) -> Seeds:
        points, normals = self.surface_points(num)
        return Seeds(points, normals, np.full(num, sigma))


def board_scene(num_views: int = 6, sensor: str = "ppa", light: str = "specular") -> Scene:
    """A tilted glossy board that lies whole in most views of a ring."""
    surface = Plane(
        point=np.array([0.0, 0.0, 0.0]), normal=np.array([0.1, -0.05, 1.0]), extent=(0.12, 0.15)
    )
    views = ring_of_views(
        num_views, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=45, roll_deg=20
    )
    rendered = [
        render_view(v, surface, sensor=sensor, light=light, s0=0.2, background=0.6) for v in views
    ]
    return Scene(surface, views, rendered, [phase_map_of(r) for r in rendered])


def phase_map_of(rendered: SyntheticView, light: Light = Light.SPECULAR) -> PhaseMap:
    """Phase map of a rendered view without noise."""
    i0, i45, i90, i135 = rendered.intensities.astype(np.float32)
    s0, s1, s2 = 0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135
    valid = np.ones(s0.shape, bool)
    region = find_region(s0, s1, s2, valid, min_dolp=0.1)
    sigma = np.full(s0.shape, 1e-3, np.float32)
    stokes = Stokes(s0=s0, s1=s1, s2=s2, sigma=sigma, valid=valid)
    return build_phase_map(rendered.view, stokes, region, light)


def tracks_at(scene, points, views=None):
    """Tracks of points as all (or some) views would observe them."""
    views = range(len(scene.views)) if views is None else views
    obs = [(t, k) for t in range(len(points)) for k in views]
    xy = [scene.views[k].camera.project(scene.views[k].cam_from_world * points[t]) for t, k in obs]
    num = len(points)
    return Tracks(
        point3D_ids=np.arange(num),
        points_in_world=points,
        colors=np.zeros((num, 3), np.uint8),
        errors=np.zeros(num),
        obs_track=np.array([t for t, _ in obs], np.int64),
        obs_view=np.array([k for _, k in obs], np.int64),
        obs_xy=np.array(xy).reshape(-1, 2),
    )


def seen_tracks(scene, points, normals):
    """Tracks of points as the views that face them observe them."""
    tracks = tracks_at(scene, points)
    kept = np.zeros(len(tracks.obs_track), bool)
    for k, view in enumerate(scene.views):
        here = tracks.obs_view == k
        kept[here] = view.faces(points, normals)[tracks.obs_track[here]]
    observed = {name: getattr(tracks, name)[kept] for name in ("obs_track", "obs_view", "obs_xy")}
    return replace(tracks, **observed)


def normal_from_angles(angle_model, phase, zenith, rays_in_cam) -> np.ndarray:
    """Normal ``n = -exp(zenith a^) v`` of the paper; zenith angles from ``-v`` or the axis."""
    v = model_rays(angle_model, np.asarray(rays_in_cam, np.float64))
    axis = np.cross(phase_direction(phase), v)
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    zenith = np.asarray(zenith)[..., None]
    # Rodrigues; the axis is perpendicular to v.
    return np.asarray(-(np.cos(zenith) * v + np.sin(zenith) * np.cross(axis, v)))


def random_rotation(rng: np.random.Generator) -> np.ndarray:
    q, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    return q * np.sign(np.linalg.det(q))
