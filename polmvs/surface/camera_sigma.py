"""What an estimated camera adds to the stated deviations of a surface."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.scene import View
from polmvs.surface.dense_view import find_dense_view, store_dense_view
from polmvs.surface.fusion import FusedCloud

Array = NDArray[np.float64]

NUM_NEAREST = (
    8  # sparse points that a place's modes are the mean of: they vary over the whole scene
)


class CameraModes:
    """The modes of :mod:`polmvs.colmap.camera_uncertainty` at any place.

    Parameters
    ----------
    points : (T, 3), sparse points, world.
    modes : (K, T, 3), what each mode moves them by, world units; K is 0 for a camera that was
        given.
    """

    def __init__(self, points: Array, modes: Array) -> None:
        self.modes = modes
        self._tree = cKDTree(points) if modes.size else None

    def sigma_along(self, points: Array, directions: Array) -> Array:
        """Deviation (N,) of places (N, 3) along unit directions (N, 3), world units."""
        if self._tree is None or len(points) == 0:
            return np.zeros(len(points))
        num = min(NUM_NEAREST, self._tree.n)
        _, nearest = self._tree.query(points, k=num)
        there = self.modes[:, nearest.reshape(len(points), num)].mean(axis=2)
        along = (there * directions).sum(axis=-1)
        return np.asarray(np.sqrt(np.square(along).sum(axis=0)), np.float64)

    def widened(self, cloud: FusedCloud) -> FusedCloud:
        """A cloud whose deviations hold the camera's."""
        if self._tree is None:
            return cloud
        own = self.sigma_along(cloud.points, cloud.normals)
        return replace(cloud, sigma=np.hypot(cloud.sigma, own).astype(np.float32))

    def widen_stored(self, views: Sequence[View], folder: Path) -> None:
        """Have the deviations of stored dense views hold the camera's."""
        for view in views if self._tree is not None else ():
            dense = find_dense_view(folder / view.name)
            if dense is None:
                continue
            known = dense.known
            rays = view.rays_in_world(dense.lattice_xy()[known])
            points = view.center_in_world + rays * dense.range_map[known][:, None]
            sigma = np.array(dense.sigma)
            sigma[known] = np.hypot(sigma[known], self.sigma_along(points, rays))
            store_dense_view(replace(dense, sigma=sigma, path=None), folder / view.name)
