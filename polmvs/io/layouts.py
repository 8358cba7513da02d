"""The layout of the demo published by the paper's authors.

The authors' demo is a folder with

- ``images/*.png``: raw mosaics 2448x2048, 8 bit, cells 90 45 / 135 0, encoded with a gamma of 0.5,
  that is ``linear = (raw / 255) ** 2``;
- ``cams/%08d_cam.txt``: in the text form of MVSNet and ACMM the word ``extrinsic``, a 4x4 matrix
  camera from world, the word ``intrinsic``, a 3x3 matrix of the half-size image whose pixels are
  counted from the centre of the first (OpenCV), and a line with the range of depths;
- ``normal_w.npy`` (3x1) and ``pts_3d_corners_w.npy`` (4x3): the board's normal and corners in the
  world.

The board is the only ground truth: masks, depths and normals follow from its geometry, without
occlusion.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polmvs.arrays import Array, Image, Mask
from polmvs.camera import PinholeCamera, pixel_centers, xy_from_opencv
from polmvs.config import CaptureOptions
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform, nearest_rotation, points_on_rays
from polmvs.io.images import read_bytes
from polmvs.io.plain_files import read_text
from polmvs.io.raw_formats import read_npy
from polmvs.scene import View, stem_of

AUTHOR_OPTIONS = CaptureOptions(pattern=(90, 45, 135, 0), gamma=0.5)
MAX_OFF_PLANE = 0.02  # of the corners from the plane, in sizes of the board; a guess


@dataclass(frozen=True, kw_only=True, eq=False)
class BoardTruth:
    """Ground truth of a capture of one flat board: true maps of any view from ray intersections.

    Attributes
    ----------
    folder : folder of the files.
    views : posed views by image name, half-size images, units of the corners.
    normal : (3,), unit, world, towards the cameras.
    corners : (4, 3), world, in order around the board.
    """

    folder: Path
    views: Mapping[str, View]
    normal: Array
    corners: Array

    @property
    def offset(self) -> float:
        """Offset of the board's plane: ``normal . x = offset``."""
        return float((self.corners @ self.normal).mean())

    def mask(self, name: str) -> Mask:
        """Whether each pixel shows the board, (H, W)."""
        return np.isfinite(self.depth(name))

    def depth(self, name: str) -> Image:
        """Depth z of the board, (H, W) float32; NaN off the board."""
        view = self.views[name]
        xy = pixel_centers(view.camera.width, view.camera.height)
        rays, world_rays = view.camera.rays(xy), view.rays_in_world(xy)
        center = view.center_in_world
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (self.offset - center @ self.normal) / (world_rays @ self.normal)
            points = points_on_rays(center, world_rays, distance)
            inside = (distance > 0) & self._inside(points)
        return np.where(inside, distance * rays[..., 2], np.nan).astype(np.float32)

    def normals(self, name: str) -> Image:
        """Normals (H, W, 3) float32, camera frame, facing the camera; NaN off the board."""
        view = self.views[name]
        normal = view.cam_from_world.rotation @ self.normal
        if view.center_in_world @ self.normal < self.offset:
            normal = -normal
        shown = self.mask(name)[..., None]
        return np.where(shown, normal, np.nan).astype(np.float32)

    def _inside(self, points: Array) -> Mask:
        """Whether points (..., 3) of the plane lie within the convex outline of the corners."""
        edges = np.roll(self.corners, -1, axis=0) - self.corners
        inwards = np.cross(self.normal, edges)
        inwards *= np.sign(((self.corners.mean(axis=0) - self.corners) * inwards).sum(axis=1))[
            :, None
        ]
        sides = points @ inwards.T - (self.corners * inwards).sum(axis=1)
        return np.asarray((sides >= 0).all(axis=-1))


def is_author_layout(folder: Path) -> bool:
    """Whether a folder has the layout of the authors' demo."""
    return (folder / "images").is_dir() and (folder / "cams").is_dir()


def read_author_truth(folder: Path, names: Sequence[str], width: int, height: int) -> BoardTruth:
    """Read the ground truth of a capture in the layout of the authors' demo.

    Parameters
    ----------
    names : of the capture's images, in order.
    width, height : of its polarization images, px.

    Raises
    ------
    DataError
        A file is missing or damaged, or the number of files is wrong.
    """
    views = read_author_views(folder, names, width, height)
    normal = _read_npy(folder / "normal_w.npy", 3).reshape(3)
    corners = _read_npy(folder / "pts_3d_corners_w.npy", 12).reshape(4, 3)
    length = float(np.linalg.norm(normal))
    if not length > 0:
        raise DataError(folder / "normal_w.npy", "is no direction; copy the data again.")
    normal = normal / length
    center = corners.mean(axis=0)
    size = float(np.linalg.norm(corners - center, axis=1).max())
    if np.abs((corners - center) @ normal).max() > MAX_OFF_PLANE * size:
        raise DataError(
            folder / "pts_3d_corners_w.npy",
            "the corners do not lie in a plane across normal_w.npy; copy the data again.",
        )
    cameras = np.array([view.center_in_world for view in views.values()])
    if np.median((cameras - center) @ normal) < 0:
        normal = -normal
    first = corners[0] - center
    angles = np.arctan2((corners - center) @ np.cross(normal, first), (corners - center) @ first)
    return BoardTruth(folder=folder, views=views, normal=normal, corners=corners[angles.argsort()])


def read_author_views(
    folder: Path, names: Sequence[str], width: int, height: int
) -> dict[str, View]:
    """The cameras of the authors' demo by name; parameters and errors of its truth."""
    views = {}
    for index, name in enumerate(names):
        path = folder / "cams" / f"{stem_of(name)}_cam.txt"
        if not path.is_file():
            path = folder / "cams" / f"{index:08d}_cam.txt"
        views[name] = read_camera_text(path, name, width, height)
    return views


def read_camera_text(path: Path, name: str, width: int, height: int) -> View:
    """Read a camera in the text form of MVSNet and ACMM, whose pixel origin is a pixel centre.

    Parameters
    ----------
    name : of the image.
    width, height : of the image of the intrinsics, px.

    Raises
    ------
    DataError
        The file is missing or malformed.
    """
    try:
        words = read_text(path, "ascii").split()
    except (OSError, ValueError) as error:
        raise DataError(
            path, f"no readable camera file ({error}); each image needs one."
        ) from error
    try:
        start, middle = words.index("extrinsic"), words.index("intrinsic")
        pose = np.array(words[start + 1 : start + 17], np.float64).reshape(4, 4)
        K = np.array(words[middle + 1 : middle + 10], np.float64).reshape(3, 3)
    except ValueError as error:
        raise DataError(
            path, "needs 'extrinsic' with 16 numbers and 'intrinsic' with 9; copy it again."
        ) from error
    rotation = nearest_rotation(pose[:3, :3])
    if rotation is None or not np.isfinite(pose).all():
        raise DataError(path, "its extrinsic matrix is no rigid motion; copy it again.")
    if not (np.isfinite(K).all() and min(K[0, 0], K[1, 1]) > 0):
        raise DataError(path, "its focal lengths must be positive; copy it again.")
    cx, cy = xy_from_opencv(K[:2, 2])
    camera = PinholeCamera(
        width=width, height=height, fx=K[0, 0], fy=K[1, 1], cx=float(cx), cy=float(cy)
    )
    return View(name=name, camera=camera, cam_from_world=RigidTransform(rotation, pose[:3, 3]))


def _read_npy(path: Path, num: int) -> Array:
    """Numbers of a ``.npy`` file."""
    values = read_npy(path, read_bytes(path))
    if values.size != num or values.dtype.kind not in "fiu":
        raise DataError(path, f"needs {num} numbers; copy the data again.")
    if not np.isfinite(values).all():
        raise DataError(path, "has numbers that are not finite; copy the data again.")
    return np.asarray(values, np.float64)
