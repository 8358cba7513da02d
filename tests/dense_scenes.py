"""Exact dense results of analytic surfaces, and sparse models of them, for any camera."""

from dataclasses import dataclass, fields

import numpy as np
import pycolmap

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.colmap.cameras import ColmapCamera
from polmvs.colmap.maps import DepthNormals, map_pixel_xy
from polmvs.geometry import RigidTransform
from polmvs.io.clouds import read_cloud
from polmvs.scene import SparseModel, Tracks, View
from polmvs.surface.dense_view import DenseView
from polmvs.surface.map_export import export_dense_workspace
from polmvs.synthetic.captures import ring_of_views
from polmvs.synthetic.surfaces import Plane

PINHOLE = PinholeCamera(width=160, height=128, fx=120.0, fy=121.0, cx=79.0, cy=63.0)
OPENCV = ColmapCamera(
    model="OPENCV",
    width=160,
    height=128,
    params=(120.0, 121.0, 79.0, 63.0, -0.15, 0.04, 0.001, -0.002),
)
FISHEYE = ColmapCamera(
    model="OPENCV_FISHEYE",
    width=160,
    height=128,
    params=(110.0, 111.0, 79.0, 63.0, 0.02, -0.003, 0.001, 0.0),
)
NORMAL = np.array([0.3, -0.2, 1.0]) / np.linalg.norm([0.3, -0.2, 1.0])
BOARD = Plane(point=np.zeros(3), normal=NORMAL)


def shade(points):
    """A smooth texture of the world, grey levels."""
    x, y = np.asarray(points)[..., 0], np.asarray(points)[..., 1]
    waves = np.sin(90 * x + 20 * y) + np.sin(70 * y - 40 * x + 1) + np.sin(130 * x * (1 + 3 * y))
    return 120 + 35 * waves


@dataclass(frozen=True)
class DenseScene:
    """A surface seen by some views, with points on it that all of them observe."""

    surface: object
    model: SparseModel

    @property
    def views(self):
        return self.model.views

    def view(self, name):
        return next(view for view in self.views if view.name == name)

    def seen(self, view, xy):
        """Ranges and world normals at image coordinates; inf and NaN beside the surface."""
        rays = view.camera.rays(xy) @ view.cam_from_world.rotation
        return self.surface.intersect(view.center_in_world, rays)

    def image(self, name):
        view = self.view(name)
        xy = pixel_centers(view.camera.width, view.camera.height)
        rays = view.camera.rays(xy) @ view.cam_from_world.rotation
        distance, _ = self.seen(view, xy)
        points = (
            view.center_in_world + np.where(np.isfinite(distance), distance, 1)[..., None] * rays
        )
        gray = np.where(np.isfinite(distance), shade(points), 20)
        return np.rint(np.clip(gray, 0, 255)).astype(np.uint8)

    def dense(self, name, stride=2):
        view = self.view(name)
        height, width = view.camera.height // stride, view.camera.width // stride
        grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        distance, normals = self.seen(view, (grid + 0.5) * stride)
        known = np.isfinite(distance)
        maps = {
            "range_map": np.where(known, distance, 0).astype(np.float32),
            "normals_in_world": np.where(known[..., None], normals, np.nan).astype(np.float32),
        }
        for field in fields(DenseView):
            if field.name not in (*maps, "stride_px", "path"):
                maps[field.name] = np.zeros((height, width), np.float32)
        return DenseView(stride_px=stride, **maps)

    def exact_maps(self, view, offset=0.0):
        """Maps of a view at the map pixels, moved by an offset in px."""
        xy = map_pixel_xy(view.camera.width, view.camera.height) + offset
        distance, normals = self.seen(view, xy)
        known = np.isfinite(distance)
        depth = np.where(known, distance, 0) * view.camera.rays(xy)[..., 2]
        in_cam = np.where(known[..., None], normals, 0) @ view.cam_from_world.rotation.T
        return DepthNormals(depth.astype(np.float32), in_cam.astype(np.float32))

    def write(self, folder, dense=None, **options):
        dense = self.dense if dense is None else dense
        export_dense_workspace(folder, self.model, self.image, dense, **options)
        return folder


def scene_of(views, surface, points):
    """A scene of given points on the surface; a view observes those in its image."""
    observations = []
    for index, view in enumerate(views):
        xy = view.camera.project(view.cam_from_world * points)
        inside = ((xy > 0) & (xy < (view.camera.width, view.camera.height))).all(axis=-1)
        observations += [(track, index, *xy[track]) for track in np.flatnonzero(inside)]
    obs = np.array(observations)
    tracks = Tracks(
        point3D_ids=np.arange(1, len(points) + 1),
        points_in_world=points,
        colors=np.full((len(points), 3), 128, np.uint8),
        errors=np.zeros(len(points)),
        obs_track=obs[:, 0].astype(np.int64),
        obs_view=obs[:, 1].astype(np.int64),
        obs_xy=obs[:, 2:],
    )
    return DenseScene(surface, SparseModel(views=tuple(views), tracks=tracks, unregistered=()))


def board_points(num=40, half=0.06, seed=0):
    xy = np.random.default_rng(seed).uniform(-half, half, (num, 2))
    return np.column_stack([xy, -(xy @ NORMAL[:2]) / NORMAL[2]])


def board_scene(camera=OPENCV, num_views=5, extent=(0.12, 0.15)):
    """A tilted board in a ring of views."""
    surface = Plane(point=np.zeros(3), normal=NORMAL, extent=extent)
    views = ring_of_views(num_views, camera, distance=0.5, elevation_deg=55, roll_deg=20)
    return scene_of(views, surface, board_points())


def parallel_views(camera, num_views=4, distance=0.5, step=0.03):
    """Views side by side that all look along the world's -z, so that shifts do not cancel."""
    rotation = np.diag([1.0, -1.0, -1.0])
    centers = [(step * (i % 2), step * (i // 2), distance) for i in range(num_views)]
    return [
        View(
            name=f"{i:03d}.png",
            camera=camera,
            cam_from_world=RigidTransform(rotation, -rotation @ np.array(center)),
        )
        for i, center in enumerate(centers)
    ]


def fuse(folder, *, min_num_pixels=2, max_reproj_error=2.0):
    """COLMAP's fusion of a workspace, opened with Open3D."""
    options = pycolmap.StereoFusionOptions()
    options.min_num_pixels, options.num_threads = min_num_pixels, 1
    options.max_reproj_error = max_reproj_error
    target = folder.parent / f"{folder.name}-fused.ply"
    pycolmap.stereo_fusion(
        str(target), str(folder), input_type="geometric", options=options, output_type="PLY"
    )
    return read_cloud(target)


def without_maps(workspace):
    """Names of the views of an opened workspace that have no depth map or no normal map."""
    return tuple(item.view.name for item in workspace.views if item.depth is None)


def image_shift(one, two, inside):
    """By how many px (x, y) the second image is moved against the first, by its gradients."""
    one, two = np.asarray(one, np.float64), np.asarray(two, np.float64)
    gradient_y, gradient_x = np.gradient(one)
    design = np.stack([gradient_x[inside], gradient_y[inside]], axis=-1)
    return np.linalg.lstsq(design, (one - two)[inside], rcond=None)[0]
