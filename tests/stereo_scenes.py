"""Views of a textured plane, through lenses of three kinds."""

import numpy as np

from polmvs.camera import PinholeCamera, pixel_centers, sample_image
from polmvs.colmap.cameras import ColmapCamera
from polmvs.polarization.phase_map import PhaseMap
from polmvs.polarization.region import Region, smooth
from polmvs.scene import View
from polmvs.synthetic.captures import ring_of_views

PINHOLE = PinholeCamera(width=240, height=192, fx=180.0, fy=180.0, cx=120.0, cy=96.0)
OPENCV = ColmapCamera(
    model="OPENCV", width=240, height=192, params=(180, 182, 118, 97, -0.12, 0.05, 1e-3, -1e-3)
)
FISHEYE = ColmapCamera(
    model="OPENCV_FISHEYE", width=240, height=192, params=(150, 150, 120, 96, 0.02, 0, 0, 0)
)
CAMERAS = [PINHOLE, OPENCV, FISHEYE]
NUM_ON_RING = 30  # 8 deg of triangulation between neighbours
DISTANCE = 0.6
TEXTURE_SIDE = 1024
TEXELS = 400  # per unit of length; a pixel sees 1.3 of them
RNG = np.random.default_rng(0)
TEXTURE = smooth(RNG.uniform(size=(TEXTURE_SIDE, TEXTURE_SIDE)).astype(np.float32), 2.0)
TEXTURE = np.clip(0.5 + 5 * (TEXTURE - 0.5), 0.02, 0.98).astype(np.float32)


def views_of(camera=PINHOLE, num=2, roll_deg=30):
    ring = ring_of_views(
        NUM_ON_RING,
        PINHOLE,
        target=np.zeros(3),
        distance=DISTANCE,
        elevation_deg=50,
        roll_deg=roll_deg,
    )
    return [View(name=v.name, camera=camera, cam_from_world=v.cam_from_world) for v in ring[:num]]


def true_ranges(view, xy):
    """Distances along the rays to the plane z = 0 of the world."""
    rays = view.camera.rays(xy) @ view.cam_from_world.rotation
    return rays, -view.center_in_world[2] / rays[..., 2]


def map_of(view, inside=None, texture=TEXTURE):
    """What a view shows of the textured plane z = 0."""
    size = view.camera.height, view.camera.width
    rays, ranges = true_ranges(view, pixel_centers(*size[::-1]))
    points = view.center_in_world + ranges[..., None] * rays
    texture_xy = points[..., :2] * TEXELS + TEXTURE_SIDE / 2
    intensity = sample_image(texture, texture_xy)
    none = np.zeros(size, bool)
    region = Region(none if inside is None else inside, none, none)
    samples = np.zeros((*size, 3), np.float32)
    polarization = np.zeros((*size, 4), np.float32)
    return PhaseMap(view, region, samples, intensity, none, np.zeros(size, np.uint8), polarization)


def plane_points(num=200, side=0.35):
    points = np.random.default_rng(1).uniform(-side, side, size=(num, 3))
    points[:, 2] = 0
    return points
