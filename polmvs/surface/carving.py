"""What a first surface must give up: the space above faces of steps, and hollows.

Silhouettes and phases see neither (:mod:`polmvs.surface.offsets`, :mod:`polmvs.surface.hollows`).
Steps are carved before the refinement, which then has the right faces to move; hollows, whose walls
no phase holds, after it.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from polmvs.config import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import Seeds
from polmvs.surface.hollows import Hollow, SurfaceFaces, find_hollows
from polmvs.surface.mesh_geometry import (
    RayScene,
    TriangleMesh,
    distance_grid,
    drop_small,
    mesh_from_grid,
    relaxed,
)
from polmvs.surface.offsets import SignedDistance, SteppedFaces, find_faces, stepped_faces

Array = NDArray[np.float64]
Floats = NDArray[np.floating]

MIN_PIECE_CELLS = 30  # of a carved mesh; what is smaller is left between two carvings


def find_steps(
    mesh: TriangleMesh,
    seeds: Seeds,
    maps: Sequence[PhaseMap],
    angle_model: AngleModel,
    *,
    tilt_aware: bool = True,
) -> tuple[SteppedFaces, ...]:
    """Faces of steps and recesses that a closed mesh covers; none where it explains all seeds.

    Parameters
    ----------
    mesh : the visual hull.
    seeds : sparse points on the part with their normals.
    maps : of all views.
    angle_model, tilt_aware : as in :func:`polmvs.normals.rows.gather_rows`.
    """
    faces = find_faces(seeds)
    if not faces or not len(mesh.faces):
        return ()
    scene = RayScene(mesh)

    def first_hit(origins: Array, direction: Array) -> tuple[Floats, Floats]:
        hits = scene.cast(origins, np.broadcast_to(direction, origins.shape))
        return hits.distance, mesh.face_normals[hits.face]

    return stepped_faces(
        faces,
        seeds,
        maps,
        angle_model,
        tilt_aware=tilt_aware,
        signed_distance=scene.signed_distance,
        first_hit=first_hit,
    )


def find_vessels(
    mesh: TriangleMesh,
    footprint: float,
    maps: Sequence[PhaseMap],
    angle_model: AngleModel,
    *,
    tilt_aware: bool = True,
) -> tuple[Hollow, ...]:
    """Hollows that a closed mesh covers with a cap.

    Parameters
    ----------
    mesh : the visual hull or better.
    footprint : length that a pixel covers at the surface, world units.
    maps, angle_model, tilt_aware : as in :func:`find_steps`.
    """
    scene = RayScene(mesh)
    surface = SurfaceFaces(
        mesh.centers, mesh.face_normals, mesh.face_areas, scene.signed_distance, footprint
    )
    return find_hollows(surface, maps, angle_model, tilt_aware=tilt_aware)


def carved_mesh(mesh: TriangleMesh, free: Sequence[SignedDistance], step: float) -> TriangleMesh:
    """A closed mesh without what is known to be free space, its edges about ``step``.

    Parameters
    ----------
    mesh : closed.
    free : functions of points ``(N, 3)`` that give signed distances ``(N,)``, positive where space
        is free; without any the mesh is returned as it is.
    step : of the grid on which it is carved, world units.
    """
    if not free or not len(mesh.faces):
        return mesh
    values, origin = distance_grid(mesh, step)
    limit = values.max()
    solid = values < limit
    points = origin + step * np.argwhere(solid)
    for function in free:
        carved = np.clip(function(points), -limit, limit).astype(np.float32)
        values[solid] = np.maximum(values[solid], carved)
    drop_small(values, MIN_PIECE_CELLS, limit)
    return relaxed(mesh_from_grid(values, origin, step))
