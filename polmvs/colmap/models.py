"""COLMAP's cameras and sparse models; the only file that imports pycolmap.

The rest of the package sees :class:`polmvs.camera.Camera` and :class:`SparseModel` and no type of
pycolmap, but for ``sfm.py`` and ``sparse_model.py``, which take the module from here.
"""

from __future__ import annotations

import logging
import os
import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
import pycolmap as pycolmap  # re-exported, see above
from numpy.typing import NDArray

from polmvs.camera import Camera, PinholeCamera
from polmvs.colmap.binary_check import check_binary_model
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform
from polmvs.scene import SparseModel, Tracks, View

Array = NDArray[np.float64]

logger = logging.getLogger(__name__)

# Models that are a pinhole camera where all their distortion is zero. Fisheye models are not.
PERSPECTIVE_MODELS = frozenset(
    {"SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV"}
)
# Distortion polynomials fold far points back into the image; beyond the border's widest ray
# times this they are declared invisible.
FIELD_MARGIN = 1.05
BORDER_SAMPLES = 64  # along each side of the image
MODEL_FILES = ("cameras", "images", "points3D")  # rigs and frames came with COLMAP 3.12


@contextmanager
def quiet_colmap() -> Iterator[None]:
    """Keep COLMAP's own log off stderr, which says every step; afterwards it is as it was."""
    before = pycolmap.logging.minloglevel
    pycolmap.logging.minloglevel = 3
    try:
        yield
    finally:
        pycolmap.logging.minloglevel = before


@dataclass(frozen=True, kw_only=True)
class ColmapCamera:
    """A camera of any COLMAP model; implements :class:`polmvs.camera.Camera`.

    Attributes
    ----------
    model : name of the COLMAP model, such as ``OPENCV_FISHEYE``.
    width, height : px
    params : in COLMAP's order, COLMAP's pixel convention.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def mean_focal_px(self) -> float:
        """Mean of the focal lengths, px."""
        return float(_pycolmap_camera(self).mean_focal_length())

    def rays(self, xy: NDArray[np.floating]) -> Array:
        """Unit rays ``(..., 3)`` in the camera frame of image coordinates ``(..., 2)``.

        NaN where the distortion has no inverse and for pixels that look sideways or backwards.
        """
        xy = np.asarray(xy, np.float64)
        camera = _pycolmap_camera(self)
        flat = np.ascontiguousarray(xy.reshape(-1, 2))
        if hasattr(camera, "cam_ray_from_img"):
            rays = np.asarray(camera.cam_ray_from_img(flat), np.float64)
        else:  # pycolmap 4.0
            plane = np.asarray(camera.cam_from_img(flat), np.float64)
            rays = np.column_stack([plane, np.ones(len(plane))])
        rays = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        rays[~(rays[:, 2] > 0)] = np.nan
        return np.asarray(rays.reshape(*xy.shape[:-1], 3), np.float64)

    def project(self, points_in_cam: NDArray[np.floating]) -> NDArray[np.floating]:
        """Image coordinates ``(..., 2)`` of camera-frame points.

        NaN behind the camera and more than 5 % further from the axis than the widest ray.
        """
        points = np.asarray(points_in_cam, np.float64)
        flat = np.ascontiguousarray(points.reshape(-1, 3))
        angle = np.arctan2(np.hypot(flat[:, 0], flat[:, 1]), flat[:, 2])
        seen = (flat[:, 2] > 0) & (angle <= _widest_angle(self))
        xy = np.full((len(flat), 2), np.nan)
        if seen.any():
            xy[seen] = _pycolmap_camera(self).img_from_cam(flat[seen])
        return xy.reshape(*points.shape[:-1], 2)

    def rescaled(self, width: int, height: int) -> ColmapCamera:
        """The same camera with its images resized, px."""
        camera = camera_to_colmap(self)
        camera.rescale(width, height)
        return ColmapCamera(
            model=self.model, width=width, height=height, params=tuple(map(float, camera.params))
        )


def camera_to_colmap(camera: Camera) -> pycolmap.Camera:
    """A fresh ``pycolmap.Camera``."""
    if isinstance(camera, PinholeCamera):
        model = "PINHOLE"
        params: tuple[float, ...] = (camera.fx, camera.fy, camera.cx, camera.cy)
    elif isinstance(camera, ColmapCamera):
        model, params = camera.model, camera.params
    else:
        raise TypeError(f"{type(camera).__name__} has no counterpart in COLMAP.")
    return pycolmap.Camera(
        model=model, width=camera.width, height=camera.height, params=np.array(params)
    )


@lru_cache(maxsize=4096)
def _pycolmap_camera(camera: ColmapCamera) -> pycolmap.Camera:
    """The wrapped camera, never modified; outside the dataclass so that that one pickles."""
    return camera_to_colmap(camera)


@lru_cache(maxsize=4096)
def _widest_angle(camera: ColmapCamera) -> float:
    """Angle from the optical axis of the widest ray of the image's border, with margin, rad."""
    along = np.linspace(0, 1, BORDER_SAMPLES)
    share = [np.stack([along, np.full_like(along, side)], axis=-1) for side in (0, 1)]
    border = np.concatenate([*share, *(pair[:, ::-1] for pair in share)])
    z = camera.rays(border * (camera.width, camera.height))[:, 2]
    inside = z[np.isfinite(z)]
    # Where the border reaches beyond the fold, the last rays before it are the bound themselves.
    margin = FIELD_MARGIN if len(inside) == len(z) else 1.0
    return float(margin * np.arccos(inside.min(initial=1.0) if len(inside) else 0.0))


def camera_from_colmap(camera: pycolmap.Camera) -> Camera:
    """A ``pycolmap.Camera`` as this package's; the fast pinhole where it is one."""
    model = str(camera.model_name)
    if model in PERSPECTIVE_MODELS and camera.is_undistorted():
        return PinholeCamera(
            width=int(camera.width),
            height=int(camera.height),
            fx=float(camera.focal_length_x),
            fy=float(camera.focal_length_y),
            cx=float(camera.principal_point_x),
            cy=float(camera.principal_point_y),
        )
    return ColmapCamera(
        model=model,
        width=int(camera.width),
        height=int(camera.height),
        params=tuple(map(float, camera.params)),
    )


def model_from_reconstruction(
    reconstruction: pycolmap.Reconstruction, names: Iterable[str] = ()
) -> SparseModel:
    """The registered part of a reconstruction.

    Parameters
    ----------
    reconstruction : with any rigs and camera models.
    names : of all images that were to be registered, in addition to the reconstruction's own.
    """
    cameras = {i: camera_from_colmap(c) for i, c in reconstruction.cameras.items()}
    images = [reconstruction.image(i) for i in reconstruction.reg_image_ids()]
    images.sort(key=lambda image: str(image.name))
    views = tuple(
        View(
            name=str(image.name),
            camera=cameras[image.camera_id],
            cam_from_world=_rigid_transform(image.cam_from_world()),
        )
        for image in images
    )
    known = {str(image.name) for image in reconstruction.images.values()} | set(names)
    return SparseModel(
        views=views,
        tracks=_tracks(reconstruction, images),
        unregistered=tuple(sorted(known - {view.name for view in views})),
    )


def _rigid_transform(transform: pycolmap.Rigid3d) -> RigidTransform:
    matrix = np.array(transform.matrix(), np.float64)
    return RigidTransform(matrix[:, :3].copy(), matrix[:, 3].copy())


def _tracks(reconstruction: pycolmap.Reconstruction, images: list[pycolmap.Image]) -> Tracks:
    """Sparse points by id, and their observations in ``images``, view by view."""
    points = sorted(reconstruction.points3D.items())
    ids = np.array([i for i, _ in points], np.int64)
    seen = [image.get_observation_points2D() for image in images]
    obs_ids = np.array([point.point3D_id for view in seen for point in view], np.int64)
    obs_xy = np.array([point.xy for view in seen for point in view], np.float64)
    if not np.isin(obs_ids, ids).all():
        raise ValueError("keypoints observe points that are missing")
    return Tracks(
        point3D_ids=ids,
        points_in_world=np.array([p.xyz for _, p in points], np.float64).reshape(-1, 3),
        colors=np.array([p.color for _, p in points], np.uint8).reshape(-1, 3),
        errors=np.array([p.error for _, p in points], np.float64),
        obs_track=np.searchsorted(ids, obs_ids),
        obs_view=np.repeat(np.arange(len(seen)), [len(view) for view in seen]),
        obs_xy=obs_xy.reshape(-1, 2),
    )


def find_model(path: str | os.PathLike[str]) -> Path:
    """Folder of a COLMAP model: the given one, or its ``0``, ``sparse`` or ``sparse/0``.

    Raises
    ------
    DataError
        No such folder, or no complete model in it.
    """
    root = Path(path)
    if not root.is_dir():
        raise DataError(root, "is no folder." if root.exists() else "no such folder.")
    for folder in (root, root / "0", root / "sparse", root / "sparse" / "0"):
        if _model_suffix(folder) is not None:
            if folder.name == "0" and (folder.parent / "1").is_dir():
                logger.warning("%s: holds several models; 0 is used.", folder.parent)
            return folder
    raise DataError(
        root,
        "holds no COLMAP model. Its cameras, images and points3D files (.bin or .txt) are "
        "expected in it, in 0/, in sparse/ or in sparse/0/.",
    )


def _model_suffix(folder: Path) -> str | None:
    """``.bin`` or ``.txt``, whichever of COLMAP's forms the folder holds whole."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in MODEL_FILES):
            return suffix
    return None


def read_model(path: str | os.PathLike[str]) -> SparseModel:
    """Read a COLMAP model, binary or text, of three or of five files.

    Parameters
    ----------
    path : the model's folder or a parent, see :func:`find_model`.

    Raises
    ------
    DataError
        The model is missing, damaged or without a registered image.
    """
    folder = find_model(path)
    if _model_suffix(folder) == ".bin":
        check_binary_model(folder, _num_params)
    try:
        model = model_from_reconstruction(pycolmap.Reconstruction(str(folder)))
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError, OverflowError) as error:
        # COLMAP's own words, shortened and without the place in its source.
        reason = re.sub(r"\[[\w.]+:\d+\]", "", " ".join(str(error).split()))[:120].strip()
        raise DataError(
            folder, f"is no sound COLMAP model ({reason or 'no reason given'}). Export it again."
        ) from error
    if not model.views:
        raise DataError(folder, "has no registered image. Run COLMAP again or leave out --sparse.")
    numbers = [view.cam_from_world.translation for view in model.views]
    if not all(np.isfinite(array).all() for array in (*numbers, model.tracks.points_in_world)):
        raise DataError(folder, "is no sound COLMAP model (not all numbers in it are finite).")
    return model


def _num_params(model_id: int) -> int:
    """Number of parameters of a camera model; ValueError where pycolmap does not know it."""
    model = pycolmap.CameraModelId(model_id)
    return len(pycolmap.Camera.create_from_model_id(1, model, 1.0, 1, 1).params)
