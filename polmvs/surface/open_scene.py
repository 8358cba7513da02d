"""The first surface of an open scene, from its sparse points.

On a desk or in a room, no view shows one object before a background, so there is no visual hull.
The first surface is then the Poisson surface of the sparse points with their normals. It is closed
behind and beside the points, because the solver moves closed meshes; the evidence of the views
later removes what only closes it. Views show the scene where its surface lies near sparse points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.camera import pixel_centers
from polmvs.geometry import dots, lengths
from polmvs.io.clouds import solve_poisson
from polmvs.neighbors import are_usual, point_spacings
from polmvs.scene import Seeds
from polmvs.surface.mesh_geometry import (
    MAX_CELLS,
    RayScene,
    TriangleMesh,
    mesh_from_grid,
    relaxed,
)
from polmvs.surface.poisson import MIN_POINTS, MeshTolerances, octree_depth
from polmvs.surface.surface_view import Silhouette, SurfaceView, surface_view
from polmvs.surface.terms import KnownPoints
from polmvs.surface.visual_hull import HullTolerances, closed_on_grid, values_on_grid

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_POINTS = 500_000  # of a grid at a time; bounds memory

TOL = MeshTolerances()


@dataclass(frozen=True)
class OpenScene:
    """A scene without silhouettes.

    Attributes
    ----------
    mesh : first surface, closed.
    views : without outlines; their certain silhouettes are the pixels that show the scene.
    known : sparse points.
    gsd : ground sampling distance at the points, world units.
    """

    mesh: TriangleMesh
    views: Sequence[SurfaceView]
    known: KnownPoints
    gsd: float


def open_scene(
    points: Seeds, views: Sequence[SurfaceView], *, folder: Path | None = None
) -> OpenScene | None:
    """The scene that sparse points show.

    Parameters
    ----------
    points : sparse points; those without a normal do not make the first surface.
    views : all views.
    folder : a new one, for what is derived from each view; None: in memory.

    Returns
    -------
    None if fewer than ``MIN_POINTS`` points have a normal, or less than half of them: phases then
    show an object among unpolarized things, and its textureless parts have no points. Measured: 80
    % of the points of a desk have a normal, 13 to 30 % of those of seven captures of objects.
    """
    has_normal = np.isfinite(points.normals_in_world).all(axis=1)
    places, normals = points.points_in_world[has_normal], points.normals_in_world[has_normal]
    if len(places) < max(MIN_POINTS, 0.5 * len(points.sigma)):
        return None
    spacings = point_spacings(places)
    usual = are_usual(spacings)
    places, normals, spacing = places[usual], normals[usual], float(np.median(spacings[usual]))
    if not spacing > 0:
        return None
    gsd = _gsd(places, views)
    vertices, triangles = solve_poisson(
        places, normals, depth=octree_depth(places, spacing), scale=TOL.cube_scale
    )
    sheet = TriangleMesh(vertices, triangles.astype(np.int64))
    if not len(triangles):
        return None
    if folder is not None:
        folder.mkdir()
    reach = TOL.support * spacing
    mesh = _closed(sheet, places.min(axis=0) - reach, places.max(axis=0) + reach, gsd)
    near = cKDTree(places).query(sheet.vertices)[0] <= reach
    shown = RayScene(sheet.only(near[sheet.faces].all(axis=1)))
    return OpenScene(
        mesh=mesh,
        views=[
            surface_view(view.phase_map, _silhouette(view, shown), folder=folder) for view in views
        ],
        known=KnownPoints(points.points_in_world, points.sigma),
        gsd=gsd,
    )


def _gsd(points: Array, views: Sequence[SurfaceView]) -> float:
    """Median ground sampling distance at points (N, 3) in the views that have them in the image."""
    found = [np.zeros(0)]
    for view in views:
        xy, z = view.project(points)
        found.append(view.gsd(points[view.in_image(xy) & (z > 0)]))
    return float(np.median(np.concatenate(found)))


def _closed(sheet: TriangleMesh, low: Array, high: Array, gsd: float) -> TriangleMesh:
    """The space behind a sheet, within a box: the closed surface of it."""
    scene = RayScene(sheet)

    def values_at(points: Array) -> NDArray[np.float32]:
        place, face, barycentric = scene.closest(points)
        corners = sheet.vertex_normals[sheet.faces[face]]
        normals = np.einsum("nk,nki->ni", barycentric, corners)
        offset = points - place
        return np.asarray(np.copysign(lengths(offset), dots(offset, normals)), np.float32)

    step = max(HullTolerances.step_px * gsd, float(np.prod(high - low) / MAX_CELLS) ** (1 / 3))
    values = closed_on_grid(values_on_grid(values_at, MAX_POINTS, low, high, step), step)
    return relaxed(mesh_from_grid(values, low, step))


def _silhouette(view: SurfaceView, scene: RayScene) -> Silhouette:
    """Where a view shows a mesh; all other pixels are unknown, so it has no outline."""
    rays = view.view.rays_in_world(pixel_centers(view.width, view.height).reshape(-1, 2))
    shown = (scene.cast(view.center, rays).face >= 0).reshape(view.height, view.width)
    return Silhouette(shown, np.ones_like(shown))
