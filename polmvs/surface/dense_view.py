"""Dense result of one view: range and normal on a lattice of its pixels, stored on disk."""

from __future__ import annotations

from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.camera import MAX_SIDE
from polmvs.errors import DataError
from polmvs.io.arrays import MADE_AGAIN, map_array, save_array
from polmvs.surface.log_range import log_range_increment

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Image = NDArray[np.float32]

NUM_NEAREST = 4  # known points from which a point between them is interpolated
REACH = 2.0  # reach of known points, in their spacings: a cell's diagonal, with a margin
MEMBERS = ("range", "normals", "sigma_deg", "sigma", "confidence")  # of a stored view


@dataclass(frozen=True)
class DenseView:
    """Dense result of one view.

    Attributes
    ----------
    stride_px : lattice point (i, j) lies at ``xy = ((j + 0.5) stride, (i + 0.5) stride)``.
    range_map : (h, w) float32, distance from the camera centre, world units; 0 where unknown.
    normals_in_world : (h, w, 3) float32, unit; NaN where unknown.
    sigma_deg : (h, w) float32, standard deviation of the normal.
    sigma : (h, w) float32, standard deviation of the range, world units.
    confidence : (h, w) float32, share from 0 to 1 of the views facing the point whose phase
        agrees with its normal; 0 where the view's own phase denies it.
    path : stem of the files that hold the arrays, if they are stored.
    """

    stride_px: int
    range_map: Image
    normals_in_world: Image
    sigma_deg: Image
    sigma: Image
    confidence: Image
    path: Path | None = None

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle a stored view as its place."""
        if self.path is not None:
            return open_dense_view, (self.stride_px, self.path)
        return DenseView, (self.stride_px, *self._arrays())

    def _arrays(self) -> tuple[Image, ...]:
        maps = (self.range_map, self.normals_in_world, self.sigma_deg, self.sigma)
        return (*maps, self.confidence)

    @property
    def known(self) -> NDArray[np.bool_]:
        """Lattice points (h, w) with a range and a normal."""
        has_normal = np.isfinite(self.normals_in_world).all(axis=-1)
        return np.asarray((self.range_map > 0) & has_normal)

    def only(self, kept: NDArray[np.bool_]) -> DenseView:
        """The view with nothing known outside the ``kept`` (h, w) points of its lattice."""
        nothing = np.float32(np.nan)
        return DenseView(
            stride_px=self.stride_px,
            range_map=np.where(kept, self.range_map, np.float32(0)),
            normals_in_world=np.where(kept[..., None], self.normals_in_world, nothing),
            sigma_deg=np.where(kept, self.sigma_deg, nothing),
            sigma=np.where(kept, self.sigma, nothing),
            confidence=np.where(kept, self.confidence, np.float32(0)),
        )

    def lattice_xy(self) -> Array:
        """Image coordinates ``(h, w, 2)`` of the lattice."""
        num_rows, num_cols = self.range_map.shape
        return lattice_xy(num_rows, num_cols, self.stride_px)


def lattice_xy(num_rows: int, num_cols: int, stride_px: int) -> Array:
    """Image coordinates ``(num_rows, num_cols, 2)`` of a view's lattice."""
    indices = np.stack(np.meshgrid(np.arange(num_cols), np.arange(num_rows)), axis=-1)
    return np.asarray((indices + 0.5) * stride_px, np.float64)


def lattice_points(wanted: NDArray[np.bool_], stride_px: int) -> Array:
    """Image coordinates ``(N, 2)`` of the ``wanted`` (h, w) points of a lattice, row by row."""
    num_rows, num_cols = wanted.shape
    return lattice_xy(num_rows, num_cols, stride_px)[wanted]


@dataclass(frozen=True)
class SurfaceSamples:
    """Points of the surface that a view sees.

    Attributes
    ----------
    xy : (N, 2), image coordinates; rays_in_world : (N, 3), unit.
    log_range : (N,); normals : (N, 3), unit, world.
    normal_sigma : (N,), rad; log_range_sigma : (N,); confidence : (N,), 0 to 1.
    """

    xy: Floats
    rays_in_world: Floats
    log_range: Array
    normals: Array
    normal_sigma: Array
    log_range_sigma: Array
    confidence: Array

    def __getitem__(self, index: NDArray[np.bool_] | NDArray[np.int64]) -> SurfaceSamples:
        """Some of the points."""
        return SurfaceSamples(*(getattr(self, f.name)[index] for f in fields(self)))


def extend_planes(
    samples: SurfaceSamples, xy: Floats, rays_in_world: Floats, max_gap_px: float
) -> SurfaceSamples:
    """The surface at other pixels, from the nearest samples.

    The chord from a sample is perpendicular to the mean of the normals at its ends, exactly so on
    planes and spheres.

    Parameters
    ----------
    samples : at least one, all finite.
    xy, rays_in_world : (N, 2) and (N, 3), of the wanted surface.
    max_gap_px : samples farther away are ignored.

    Returns
    -------
    SurfaceSamples of N points, with NaN ranges and normals where no sample is near.
    """
    k = min(NUM_NEAREST, len(samples.xy))
    gap, index = cKDTree(samples.xy).query(xy, k=k, distance_upper_bound=max_gap_px)
    gap, index = gap.reshape(-1, k), index.reshape(-1, k)
    found = np.isfinite(gap)
    index = np.where(found, index, 0)
    normals = samples.normals[index]
    weight = np.where(found, 1 / (1 + np.where(found, gap, 0) ** 2), 0)
    total = weight.sum(axis=1)
    weight = weight / np.maximum(total, 1e-12)[:, None]
    normal = (weight[..., None] * normals).sum(axis=1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    with np.errstate(invalid="ignore", divide="ignore"):
        normal = np.where(total[:, None] > 0, normal / length, np.nan)

    def mean(values: Array) -> Array:
        return np.where(total > 0, (weight * values).sum(axis=1), np.nan)

    chord = normals + normal[:, None]
    step = log_range_increment(chord, samples.rays_in_world[index], rays_in_world[:, None])
    return SurfaceSamples(
        xy=xy,
        rays_in_world=rays_in_world,
        log_range=mean(samples.log_range[index] + step),
        normals=normal,
        normal_sigma=mean(samples.normal_sigma[index]),
        log_range_sigma=mean(samples.log_range_sigma[index]),
        confidence=mean(samples.confidence[index]),
    )


def dense_view(samples: SurfaceSamples, wanted: NDArray[np.bool_], stride_px: int) -> DenseView:
    """A dense view of samples at the ``wanted`` (h, w) points of its lattice, row by row."""
    known = np.isfinite(samples.log_range) & np.isfinite(samples.normals).all(axis=-1)
    distance = np.where(known, np.exp(np.where(known, samples.log_range, 0)), 0)

    def image(values: Array, unknown: float) -> Image:
        result = np.full((*wanted.shape, *values.shape[1:]), unknown, np.float32)
        good = known if values.ndim == 1 else known[:, None]
        result[wanted] = np.where(good, values, unknown)
        return result

    return DenseView(
        stride_px=stride_px,
        range_map=image(distance, 0.0),
        normals_in_world=image(samples.normals, np.nan),
        sigma_deg=image(np.degrees(samples.normal_sigma), np.nan),
        sigma=image(samples.log_range_sigma * distance, np.nan),
        confidence=image(samples.confidence, 0.0),
    )


def store_dense_view(dense: DenseView, path: Path) -> DenseView:
    """Write a dense view to ``path.range.npy`` and other files; return the stored view."""
    for name, array in zip(MEMBERS, dense._arrays(), strict=True):
        save_array(_member(path, name), array)
    save_array(_member(path, "stride"), np.array(dense.stride_px))
    return open_dense_view(dense.stride_px, path)


def open_dense_view(stride_px: int, path: Path) -> DenseView:
    """Map a stored dense view into memory.

    Raises
    ------
    DataError
        A file is missing, damaged, or has another size than the others.
    """
    range_map, normals, sigma_deg, sigma, confidence = (
        map_array(_member(path, name), np.floating) for name in MEMBERS
    )
    size = range_map.shape
    shapes = {sigma_deg.shape, sigma.shape, confidence.shape}
    if len(size) != 2 or shapes != {size} or normals.shape != (*size, 3):
        raise DataError(path, f"its files differ in size. {MADE_AGAIN}")
    return DenseView(stride_px, range_map, normals, sigma_deg, sigma, confidence, path)


def find_dense_view(path: Path) -> DenseView | None:
    """Map a stored dense view, with its own stride, into memory; None if there is none."""
    if not _member(path, "stride").is_file():
        return None
    stride = map_array(_member(path, "stride"), np.integer)
    if stride.shape != () or not 0 < int(stride) < MAX_SIDE:
        raise DataError(_member(path, "stride"), f"holds no stride. {MADE_AGAIN}")
    return open_dense_view(int(stride), path)


def _member(path: Path, name: str) -> Path:
    return path.with_name(f"{path.name}.{name}.npy")
