"""Check of a mesh for double layers and self-intersections.

Both come from views that contradict each other: each view has its own sheet. In a valid solid the
crossings of a camera ray alternate between entering and leaving, and are some distance apart.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from polmvs.scene import View
from polmvs.surface.dense_view import lattice_xy
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh

Mask = NDArray[np.bool_]

STRIDE_PX = 6
# Sheets nearer to each other than this are a double layer: the deviation of silhouettes and phases
# is a pixel at best.
SHEET_PX = 3.0
MIN_COSINE = 0.3  # of a crossing: a grazed outline is thin in any solid. Guess


@dataclass(frozen=True, kw_only=True)
class Soundness:
    """Crossings of a mesh by the views' rays.

    Attributes
    ----------
    layered : share of the rays that hit it which cross two sheets nearly at the same position.
    overlapping : share which enter it twice without leaving, or leave it twice: it intersects
        itself.
    """

    layered: float
    overlapping: float


def find_soundness(
    mesh: TriangleMesh, views: Sequence[View], outside: Mapping[str, Mask] = MappingProxyType({})
) -> Soundness:
    """Cast rays of all views through a closed mesh.

    Parameters
    ----------
    mesh : closed, its faces anticlockwise from outside.
    views : whose rays are cast, every few pixels.
    outside : pixels (H, W) of each view, by its name, that show what is outside the crop box; no
        rays are cast there.
    """
    met, layered, overlapping = 0, 0, 0
    scene = RayScene(mesh)
    for view in views if len(mesh.faces) else ():
        camera = view.camera
        xy = lattice_xy(camera.height // STRIDE_PX, camera.width // STRIDE_PX, STRIDE_PX)
        xy = xy.reshape(-1, 2)
        if view.name in outside:
            cols, rows = np.floor(xy).astype(np.intp).T
            xy = xy[~outside[view.name][rows, cols]]
        rays = view.rays_in_world(xy)
        found = scene.crossings(view.center_in_world, rays)
        gsd = found.distance / camera.mean_focal_px
        follows = found.ray[1:] == found.ray[:-1]
        enters, steep = found.cosine < 0, np.abs(found.cosine) > MIN_COSINE
        near = np.diff(found.distance) < SHEET_PX * gsd[1:]
        # Two faces that meet on an edge are both crossed by a ray through it.
        apart = np.diff(found.distance) > 0.05 * gsd[1:]
        both_steep = follows & steep[1:] & steep[:-1]
        met += len(np.unique(found.ray))
        layered += len(np.unique(found.ray[1:][both_steep & near & apart]))
        overlapping += len(
            np.unique(found.ray[1:][both_steep & apart & (enters[1:] == enters[:-1])])
        )
    return Soundness(layered=layered / max(met, 1), overlapping=overlapping / max(met, 1))
