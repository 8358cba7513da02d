"""The visual hull of silhouettes, robust against some wrong views.

The value of a point is the k-th largest of its signed distances to the views' silhouettes (pixels
times the GSD there), so k - 1 views may deny it wrongly. Space below the plane on which the objects
stand is outside.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from polmvs.camera import sample_image
from polmvs.surface.ground import SupportingPlane
from polmvs.surface.mesh_geometry import (
    MAX_CELLS,
    SignedDistance,
    TriangleMesh,
    mesh_from_grid,
    relaxed,
)
from polmvs.surface.surface_view import SurfaceView

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

OUTSIDE = np.float32(1e6)
MAX_VALUES = 8_000_000  # of points and views at a time; bounds memory


@dataclass(frozen=True, kw_only=True)
class HullTolerances:
    """Tolerances of the hull.

    Attributes
    ----------
    step_px : spacing of the finest grid, GSD. Two thirds of the first mesh's edges. Below the
        supporting plane, where no view sees it, the hull extends by three default spacings: two
        edges of that mesh. Measured: a plate on the demo's table vanishes without this extension,
        and with half of it a thin bowl loses 0.3 points of F at 1 mm.
    min_seen_share : of the views that must have a point in their image. Measured on an analytic
        vase: both factors of two within 0.01 points of F at 1 mm.
    min_piece_share : of the largest piece's volume; smaller pieces are removed. Guess.
    """

    step_px: float = 4.0
    min_seen_share: float = 0.34
    min_piece_share: float = 0.01


TOL = HullTolerances()


@dataclass(frozen=True)
class VisualHull:
    """The hull as a function on a grid.

    Attributes
    ----------
    values : (X, Y, Z) float32 on a grid, negative inside; see :func:`hull_values`.
    origin : (3,), place of the first grid point.
    step : distance of neighbours.
    gsd : ground sampling distance at the objects, world units.
    """

    values: NDArray[np.float32]
    origin: Array
    step: float
    gsd: float

    @cached_property
    def mesh(self) -> TriangleMesh:
        """Closed surface; empty if the silhouettes have nothing in common."""
        return relaxed(mesh_from_grid(self.values, self.origin, self.step))

    def distances(self, points: Floats) -> Array:
        """Signed distance ``(N,)`` of points ``(N, 3)`` to the hull, at most some of its cells."""
        places = (np.asarray(points, np.float64) - self.origin).T / self.step
        outside = float(self.values.max())
        found = ndimage.map_coordinates(self.values, places, order=1, cval=outside)
        return np.asarray(found, np.float64)

    def carved(
        self,
        free: Sequence[SignedDistance],
    ) -> VisualHull:
        """The hull without known free space.

        Parameters
        ----------
        free : functions of points ``(N, 3)`` that give signed distances ``(N,)``, positive where
            space is free.
        """
        near = self.values < 4 * self.step
        points = self.origin + self.step * np.argwhere(near)
        values = self.values.copy()
        for function in free:
            values[near] = np.maximum(values[near], function(points).astype(np.float32))
        return replace(self, values=_without_specks(values, self.step))


def visual_hull(
    views: Sequence[SurfaceView],
    plane: SupportingPlane | None = None,
    *,
    wrong_share: float = 0.1,
) -> VisualHull:
    """Carve space by the views' silhouettes; unknown pixels do not carve.

    Parameters
    ----------
    views : those without an outline are ignored.
    plane : space behind it is outside.
    wrong_share : of the views that may deny a point wrongly. Measured: 3 of 18 to 20 views.
    """
    used = [view for view in views if view.has_outline]
    nothing = VisualHull(np.ones((2, 2, 2), np.float32), np.zeros(3), 1.0, 1.0)
    if len(used) < 2:
        return nothing

    def values_at(points: Array) -> NDArray[np.float32]:
        return hull_values(used, points, wrong_share, plane)

    on_grid = partial(values_on_grid, values_at, max(1, MAX_VALUES // len(used)))
    center = _meeting_point(used)
    distance = float(np.median([np.linalg.norm(view.center - center) for view in used]))
    gsd = float(np.median([distance / view.view.camera.mean_focal_px for view in used]))
    low, high = center - distance, center + distance
    for num_cells in (32, 48, 64):
        step = float((high - low).max() / num_cells)
        values = on_grid(low, high, step)
        near = np.argwhere(values < 1.8 * step)  # the diagonal of a cell
        if not len(near):
            return nothing
        low, high = low + (near.min(axis=0) - 1) * step, low + (near.max(axis=0) + 1) * step
    fine = max(TOL.step_px * gsd, float(np.prod(high - low) / MAX_CELLS) ** (1 / 3))
    low, high = low - 3 * fine, high + 3 * fine
    values = _cleaned(_refined(on_grid, low, high, fine), fine)
    return VisualHull(values, low, fine, gsd)


def _meeting_point(views: Sequence[SurfaceView]) -> Array:
    """Point nearest to the rays through the middles of the silhouettes."""
    matrix, right = np.zeros((3, 3)), np.zeros(3)
    for view in views:
        rows, cols = np.nonzero(view.silhouette.certain | view.silhouette.possible)
        middle = np.array([[np.median(cols) + 0.5, np.median(rows) + 0.5]])
        ray = view.view.camera.rays(middle)[0] @ view.view.cam_from_world.rotation
        across = np.eye(3) - np.outer(ray, ray)
        matrix += across
        right += across @ view.center
    return np.asarray(np.linalg.lstsq(matrix, right, rcond=None)[0])


def hull_values(
    views: Sequence[SurfaceView],
    points: Floats,
    wrong_share: float,
    plane: SupportingPlane | None,
) -> NDArray[np.float32]:
    """Signed distance ``(N,)`` to the hull's cones at points ``(N, 3)``, negative inside."""
    of_views = np.empty((len(views), len(points)), np.float32)
    num_seen = np.zeros(len(points), np.int32)
    for index, view in enumerate(views):
        xy, z = view.project(points)
        seen = view.in_image(xy, 1.0) & (z > 0)
        pixels = sample_image(view.silhouette.outer, xy)
        of_views[index] = np.where(seen, pixels * (z / view.view.camera.mean_focal_px), -OUTSIDE)
        num_seen += seen
    largest = np.sort(of_views, axis=0)[::-1]
    # If few views see a point, fewer may be wrong.
    chosen = (wrong_share * num_seen + 0.5).astype(np.int64)
    values = largest[chosen, np.arange(len(points))]
    values = np.where(num_seen < max(2, TOL.min_seen_share * len(views)), OUTSIDE, values)
    if plane is not None:
        # Deeper than the plane: a thin plate on it must not be thinner than a coarse mesh's edges.
        z = np.median([view.gsd(points) for view in views], axis=0)
        floor = -plane.height(points) - 3 * TOL.step_px * z
        values = np.maximum(values, floor).astype(np.float32)
    return values


def _grid(low: Array, high: Array, step: float) -> tuple[int, ...]:
    return tuple(int(n) for n in np.ceil((high - low) / step) + 1)


def values_on_grid(
    values_at: Callable[[Array], NDArray[np.float32]],
    num_at_a_time: int,
    low: Array,
    high: Array,
    step: float,
    where: Mask | None = None,
    values: NDArray[np.float32] | None = None,
) -> NDArray[np.float32]:
    """Hull values on a grid, or at the points ``where`` of one with ``values`` elsewhere."""
    shape = _grid(low, high, step)
    if values is None:
        values = np.zeros(shape, np.float32)
    flat = values.reshape(-1)
    chosen = np.arange(flat.size) if where is None else np.flatnonzero(where)
    for start in range(0, len(chosen), num_at_a_time):
        some = chosen[start : start + num_at_a_time]
        points = low + step * np.stack(np.unravel_index(some, shape), axis=1)
        flat[some] = values_at(points)
    return values


def _refined(
    on_grid: Callable[..., NDArray[np.float32]], low: Array, high: Array, step: float
) -> NDArray[np.float32]:
    """Values on the fine grid, computed only where the coarse one comes near to zero."""
    ratio = 4
    shape = _grid(low, high, step)
    coarse_high = low + (np.array(shape) + ratio) * step
    coarse = on_grid(low, coarse_high, ratio * step)
    limit = np.float32(1.8 * ratio * step)
    coarse = np.clip(coarse, -limit, limit)
    index = np.meshgrid(*(np.arange(n) / ratio for n in shape), indexing="ij", sparse=True)
    grid = [np.broadcast_to(i, shape) for i in index]
    values = ndimage.map_coordinates(coarse, grid, order=1, mode="nearest").astype(np.float32)
    close = ndimage.grey_dilation(coarse, size=3) * ndimage.grey_erosion(coarse, size=3) <= 0
    near = close | (np.abs(coarse) < limit)
    fine_near = near[
        np.ix_(
            *(
                np.minimum(np.rint(np.arange(n) / ratio).astype(int), near.shape[d] - 1)
                for d, n in enumerate(shape)
            )
        )
    ]
    return on_grid(low, high, step, where=fine_near, values=values)


def _cleaned(values: NDArray[np.float32], step: float) -> NDArray[np.float32]:
    """Smoothed, closed at the grid's border, without pieces too small for objects."""
    return _without_specks(ndimage.gaussian_filter(closed_on_grid(values, step), 0.7), step)


def closed_on_grid(values: NDArray[np.float32], step: float) -> NDArray[np.float32]:
    """Values clipped to four steps, outside at the grid's border: their surface is closed."""
    limit = np.float32(4 * step)
    values = np.clip(values, -limit, limit)
    for axis in range(3):
        border = np.moveaxis(values, axis, 0)
        border[0], border[-1] = limit, limit
    return values


def _without_specks(values: NDArray[np.float32], step: float) -> NDArray[np.float32]:
    """Pieces too small for objects filled with outside, in place."""
    labels, num = ndimage.label(values < 0)
    if num > 1:
        size = np.bincount(labels.ravel())
        size[0] = 0
        small = size < max(30, TOL.min_piece_share * size.max())
        small[0] = False
        values[small[labels]] = np.float32(4 * step)
    return values
