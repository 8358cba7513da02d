"""Dense result of one view: range and normal on a lattice of its pixels, stored on disk."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.storage import map_array, save_array

Image = NDArray[np.float32]


@dataclass(frozen=True)
class DenseView:
    """Dense result of one view.

    Attributes
    ----------
    stride_px : lattice point (i, j) lies at ``xy = ((j + 0.5) stride, (i + 0.5) stride)``.
    range_map : (h, w) float32, distance from the camera centre, world units; 0 where unknown.
    normals_in_world : (h, w, 3) float32, unit; NaN where unknown.
    sigma_deg : (h, w) float32, standard deviation of the normal.
    path : stem of the files that hold the arrays, if they are stored.
    """

    stride_px: int
    range_map: Image
    normals_in_world: Image
    sigma_deg: Image
    path: Path | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a stored view as its place."""
        if self.path is not None:
            return open_dense_view, (self.stride_px, self.path)
        arrays = (self.range_map, self.normals_in_world, self.sigma_deg)
        return DenseView, (self.stride_px, *arrays)

    def lattice_xy(self) -> NDArray[np.float64]:
        """Image coordinates ``(h, w, 2)`` of the lattice."""
        height, width = self.range_map.shape
        indices = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1)
        return np.asarray((indices + 0.5) * self.stride_px, np.float64)


def store_dense_view(dense: DenseView, path: Path) -> DenseView:
    """Write a dense view to ``path.range.npy`` and its fellows; returns the stored one."""
    for name, array in (
        ("range", dense.range_map),
        ("normals", dense.normals_in_world),
        ("sigma", dense.sigma_deg),
    ):
        save_array(_member(path, name), array)
    return open_dense_view(dense.stride_px, path)


def open_dense_view(stride_px: int, path: Path) -> DenseView:
    """Map a stored dense view into memory."""
    return DenseView(
        stride_px=stride_px,
        range_map=map_array(_member(path, "range")),
        normals_in_world=map_array(_member(path, "normals")),
        sigma_deg=map_array(_member(path, "sigma")),
        path=path,
    )


def _member(path: Path, name: str) -> Path:
    return path.with_name(f"{path.name}.{name}.npy")
