"""The nouns that all stages share: views, sparse points, seeds, and kinds of points."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import Camera
from polmvs.geometry import RigidTransform

Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class View:
    """One posed image.

    Attributes
    ----------
    name : file name of the raw mosaic, also the image's name in the COLMAP model.
    camera : of the half-size polarization image.
    cam_from_world : pose.
    """

    name: str
    camera: Camera
    cam_from_world: RigidTransform

    @property
    def center_in_world(self) -> Array:
        """Camera centre ``(3,)`` in the world."""
        return self.cam_from_world.inverse().translation


@dataclass(frozen=True)
class Tracks:
    """Sparse points and their observations as flat arrays.

    Attributes
    ----------
    point3D_ids : (T,) int64
    points_in_world : (T, 3) float64
    colors : (T, 3) uint8
    errors : (T,) float64, mean reprojection error, px
    obs_track, obs_view : (O,) int64, indices of a track and of a view
    obs_xy : (O, 2) float64, image coordinates
    """

    point3D_ids: NDArray[np.int64]
    points_in_world: Array
    colors: NDArray[np.uint8]
    errors: Array
    obs_track: NDArray[np.int64]
    obs_view: NDArray[np.int64]
    obs_xy: Array


@dataclass(frozen=True)
class Seeds:
    """Points of known place on the surface.

    Attributes
    ----------
    points_in_world : (S, 3) float64
    normals_in_world : (S, 3) float64, unit; NaN where unknown.
    sigma : (S,) float64, standard deviation of the place, world units.
    """

    points_in_world: Array
    normals_in_world: Array
    sigma: Array


@dataclass(frozen=True, kw_only=True)
class SparseModel:
    """Posed views and sparse points, free of pycolmap's types.

    Attributes
    ----------
    views : registered images, sorted by name.
    tracks : sparse points; ``obs_view`` counts in ``views``.
    unregistered : names of images without a pose, sorted.
    """

    views: tuple[View, ...]
    tracks: Tracks
    unregistered: tuple[str, ...]


class PointKind(IntEnum):
    """What a point of a cloud is: on a polarised part, or how it was found beside one."""

    SURFACE = 0
    SPARSE = 1
    STEREO = 2
    COLMAP = 3
