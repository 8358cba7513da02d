"""Markers rendered on a plane, of a size that is known exactly."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import Camera, PinholeCamera
from polmvs.colmap.cameras import ColmapCamera
from polmvs.geometry import RigidTransform
from polmvs.polarization.capture import DISPLAY_GAMMA
from polmvs.scene import SparseModel, Tracks, View
from polmvs.synthetic.captures import ring_of_views

Array = NDArray[np.float64]

DICT = cv2.aruco.DICT_4X4_50
OPTION = "DICT_4X4_50:0.05"
SIDE = 0.05
PINHOLE = PinholeCamera(width=320, height=240, fx=330.0, fy=330.0, cx=158.3, cy=121.6)
BARREL = ColmapCamera(
    model="OPENCV",
    width=320,
    height=240,
    params=(330.0, 331.0, 158.3, 121.6, -0.25, 0.06, 0.002, -0.001),
)
# id, centre (x, y), side, turn in the plane (rad)
Marker = tuple[int, tuple[float, float], float, float]
ONE: tuple[Marker, ...] = ((7, (0.01, -0.02), SIDE, 0.4),)
SUPERSAMPLING = 5


def true_corners(marker: Marker) -> Array:
    """Corners in the world, in the detector's order, seen from above (z > 0)."""
    _, center, side, turn = marker
    square = side / 2 * np.array([[-1, 1], [1, 1], [1, -1], [-1, -1]])
    rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
    return np.column_stack([square @ rotation.T + center, np.zeros(4)])


def paper(points: Array, markers: Sequence[Marker]) -> Array:
    """Linear brightness of points on the plane z = 0: grey, with markers on white squares."""
    brightness = np.full(points.shape[:-1], 0.3)
    table = cv2.aruco.getPredefinedDictionary(DICT)
    for marker_id, center, side, turn in markers:
        rotation = np.array([[np.cos(turn), -np.sin(turn)], [np.sin(turn), np.cos(turn)]])
        local = (points[..., :2] - center) @ rotation / side  # the black square is +-0.5
        texture = cv2.aruco.generateImageMarker(table, marker_id, 6)
        col, row = np.floor((local[..., 0] + 0.5) * 6), np.floor((0.5 - local[..., 1]) * 6)
        black = (np.abs(local) < 0.5).all(axis=-1)
        index = (np.clip(row, 0, 5).astype(int), np.clip(col, 0, 5).astype(int))
        value = np.where(black & (texture[index] == 0), 0.04, 0.8)
        brightness = np.where((np.abs(local) < 0.7).all(axis=-1), value, brightness)
    return brightness


def render(view: View, markers: Sequence[Marker], noise: float = 0.0, blur: float = 0.5):
    """8-bit image as SfM gets it: averaged over pixels in linear light, blurred, gamma 2.2."""
    camera, n = view.camera, SUPERSAMPLING
    ticks = [(np.arange(n * size) + 0.5) / n for size in (camera.width, camera.height)]
    world_from_cam = view.cam_from_world.inverse()
    rays = camera.rays(np.stack(np.meshgrid(*ticks), axis=-1)) @ world_from_cam.rotation.T
    origin = world_from_cam.translation
    points = origin - rays * (origin[2] / rays[..., 2])[..., None]
    fine = paper(points, markers).reshape(camera.height, n, camera.width, n).mean(axis=(1, 3))
    image = cv2.GaussianBlur(fine, (0, 0), blur)
    image = image + np.random.default_rng(0).normal(0, noise, image.shape)
    return np.rint(255 * np.clip(image, 0, 1) ** (1 / DISPLAY_GAMMA)).astype(np.uint8)


def views_of(camera: Camera, num: int = 5) -> list[View]:
    return ring_of_views(num, camera, distance=0.35, elevation_deg=50, roll_deg=15)


def loader(views: Sequence[View], markers: Sequence[Marker], **options) -> Callable:
    images = {view.name: render(view, markers, **options) for view in views}
    return images.__getitem__


def model_of(views: Sequence[View], scale: float = 1.0) -> SparseModel:
    """A model of the views, ``scale`` units to the metre, and no points."""
    scaled = [
        replace(
            view,
            cam_from_world=RigidTransform(
                view.cam_from_world.rotation, scale * view.cam_from_world.translation
            ),
        )
        for view in views
    ]
    none = np.zeros(0, np.int64)
    tracks = Tracks(
        point3D_ids=none,
        points_in_world=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        errors=np.zeros(0),
        obs_track=none,
        obs_view=none,
        obs_xy=np.zeros((0, 2)),
    )
    return SparseModel(views=tuple(scaled), tracks=tracks, unregistered=())
