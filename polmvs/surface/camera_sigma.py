"""Contribution of estimated cameras and poses to the position uncertainty of a surface."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.geometry import points_on_rays
from polmvs.scene import MIN_FACING_COSINE, View
from polmvs.surface.dense_view import find_dense_view, store_dense_view
from polmvs.surface.fusion import FusedCloud

Array = NDArray[np.float64]

NUM_NEAREST = (
    8  # sparse points over which the modes at a point are averaged: modes vary over the whole scene
)


class CameraModes:
    """The modes of :mod:`polmvs.colmap.camera_uncertainty` at any point.

    Parameters
    ----------
    points : (T, 3), sparse points, world.
    modes : (K, T, 3), their displacement by each mode, world units; K is 0 for a given camera.
    """

    def __init__(self, points: Array, modes: Array) -> None:
        self.modes = modes
        self._tree = cKDTree(points) if modes.size else None

    def sigma_along(self, points: Array, directions: Array) -> Array:
        """Deviation (N,) of points (N, 3) along unit directions (N, 3), world units."""
        if self._tree is None or len(points) == 0:
            return np.zeros(len(points))
        num = min(NUM_NEAREST, self._tree.n)
        _, nearest = self._tree.query(points, k=num)
        there = self.modes[:, nearest.reshape(len(points), num)].mean(axis=2)
        along = (there * directions).sum(axis=-1)
        return np.asarray(np.sqrt(np.square(along).sum(axis=0)), np.float64)

    def widened(self, cloud: FusedCloud) -> FusedCloud:
        """A cloud whose deviations include the camera's."""
        if self._tree is None:
            return cloud
        own = self.sigma_along(cloud.points, cloud.normals)
        return replace(cloud, sigma=np.hypot(cloud.sigma, own).astype(np.float32))

    def widen_stored(self, views: Sequence[View], folder: Path) -> None:
        """Add the camera's deviations to those of stored dense views."""
        for view in views if self._tree is not None else ():
            _widen(view, folder, lambda points, rays, normals: self.sigma_along(points, rays))


def widen_by_poses(views: Sequence[View], covariances: Array, folder: Path) -> None:
    """Add the deviations by the views' own poses to those of stored dense views.

    All views determine the position of the surface; its distance from one view depends on the pose
    of that view.

    Parameters
    ----------
    views, covariances : (V, 6, 6), as of :func:`polmvs.colmap.camera_uncertainty.pose_uncertainty`;
        empty if unknown.
    folder : of the stored views.
    """
    if not len(covariances):
        return
    for view, covariance in zip(views, covariances, strict=True):
        _widen(view, folder, partial(_range_sigma, view.center_in_world, covariance))


def _range_sigma(
    center: Array, covariance: Array, points: Array, rays: Array, normals: Array
) -> Array:
    """Deviation (N,) of the ranges of points on planes of given normals ``(N, 3)``."""
    facing = np.minimum((normals * rays).sum(axis=1), -MIN_FACING_COSINE)
    by_pose = np.concatenate([np.cross(points - center, normals), normals], axis=1)
    by_pose /= facing[:, None]
    return np.asarray(np.sqrt(np.einsum("ni,ij,nj->n", by_pose, covariance, by_pose)))


def _widen(view: View, folder: Path, sigma_of: Callable[[Array, Array, Array], Array]) -> None:
    """Add deviations, of points, rays and normals ``(N, 3)``, to those of a stored view."""
    dense = find_dense_view(folder / view.name)
    if dense is None:
        return
    known = dense.known
    rays = view.rays_in_world(dense.lattice_xy()[known])
    points = points_on_rays(view.center_in_world, rays, dense.range_map[known])
    normals = np.asarray(dense.normals_in_world[known], np.float64)
    sigma = np.array(dense.sigma)
    sigma[known] = np.hypot(sigma[known], sigma_of(points, rays, normals))
    store_dense_view(replace(dense, sigma=sigma, path=None), folder / view.name)
