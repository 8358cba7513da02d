"""Sharp edges of a mesh from the normals of its faces.

A mesh whose triangles do not follow an edge of the object rounds it over a triangle's width. The
normals that the phases give are those of one side or of the other up to a few pixels from the edge:
smoothed over faces of like normal alone, they part the sides, and vertices that are moved until
all faces about them lie in planes of these normals come to lie on the edge itself.

Sun et al., Fast and effective feature-preserving mesh denoising, TVCG 2007.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from polmvs.surface.mesh_geometry import TriangleMesh

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class CreaseTolerances:
    """When faces belong to one side of an edge.

    Attributes
    ----------
    like_sine : deviation of the difference of normals that are averaged. Guess: above the noise of
        fitted normals (1 to 3 deg) and the curvature of a face, below the edges of parts. Measured
        on five captures: with 0.4 for 0.2 the F-score at 1 mm falls by 0.2 to 1.4 points.
    fitting_sine : deviation of a face's own normal from the given one at which its vertices are
        free to move. Half of ``like_sine``.
    reach_edges : deviation of the distance of faces that are averaged, in edges. Guess.
    unfitted_weight : of a normal that is the mesh's own. Guess.
    normal_rounds : of the average. Measured, 6, 12, 20: normals of `step` err by 2.61, 2.47, 2.40
        deg, of `mug` by 1.84, 1.97, 2.12.
    vertex_rounds : of the vertices' move: until it ends. Measured: 30 fall short, F at 1 mm of
        `step` 97.1 and not 97.2.
    max_move : of a vertex, in edges: what rounding takes. 0.5 and 1 alike.
    crease_deg : between faces that do not share the normal of a corner. Guess: three ``like_sine``.
    """

    like_sine: float = 0.2
    fitting_sine: float = 0.1
    reach_edges: float = 1.0
    unfitted_weight: float = 0.2
    normal_rounds: int = 10
    vertex_rounds: int = 60
    max_move: float = 1.0
    crease_deg: float = 30.0


def sided_normals(
    mesh: TriangleMesh,
    normals: Array,
    is_fitted: Mask,
    tolerances: CreaseTolerances | None = None,
) -> Array:
    """Normals of faces smoothed within the sides of edges (a bilateral filter).

    Parameters
    ----------
    mesh : with F faces.
    normals : (F, 3) unit.
    is_fitted : (F,) bool, those that the phases gave.

    Returns
    -------
    (F, 3) unit.
    """
    tol = tolerances or CreaseTolerances()
    one, other = (mesh.incidence @ mesh.incidence.T).tocoo().coords
    centers = mesh.centers
    width = tol.reach_edges * mesh.mean_edge
    near = np.exp(-0.5 * ((centers[one] - centers[other]) ** 2).sum(axis=1) / width**2)
    certain = mesh.face_areas * np.where(is_fitted, 1.0, tol.unfitted_weight)
    near *= certain[other]
    for _ in range(tol.normal_rounds):
        apart = ((normals[one] - normals[other]) ** 2).sum(axis=1)
        weight = near * np.exp(-0.5 * apart / tol.like_sine**2)
        normals = _unit(_sums(one, weight[:, None] * normals[other], len(normals)))
    return normals


def sharpened(
    mesh: TriangleMesh, normals: Array, tolerances: CreaseTolerances | None = None
) -> TriangleMesh:
    """The mesh, its vertices moved until its faces have given normals ``(F, 3)``."""
    tol = tolerances or CreaseTolerances()
    if not len(mesh.faces):
        return mesh
    index = mesh.faces.ravel()
    area = np.repeat(mesh.face_areas, 3)
    total = np.maximum(np.bincount(index, area, len(mesh.vertices)), 1e-300)[:, None]
    moved = np.zeros_like(mesh.vertices)
    limit = tol.max_move * mesh.mean_edge
    # Places that fit stay: what a rounded edge lacks is not to be taken from the face beside it.
    off = ((mesh.face_normals - normals) ** 2).sum(axis=1)
    off_at_vertex = np.bincount(index, area * np.repeat(off, 3), len(moved))[:, None] / total
    mobility = 1 - np.exp(-0.5 * off_at_vertex / tol.fitting_sine**2)
    for _ in range(tol.vertex_rounds):
        corners = (mesh.vertices + moved)[mesh.faces]
        from_plane = corners.mean(axis=1, keepdims=True) - corners
        height = (from_plane * normals[:, None]).sum(axis=-1, keepdims=True)
        step = (height * normals[:, None]).reshape(-1, 3) * area[:, None]
        moved += mobility * _sums(index, step, len(moved)) / total
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        moved *= np.minimum(1.0, limit / np.maximum(length, 1e-300))
    return mesh.moved(moved)


def corner_normals(
    mesh: TriangleMesh, normals: Array, tolerances: CreaseTolerances | None = None
) -> Array:
    """Normals ``(F, 3, 3)`` of the corners of faces: means over the faces of the same side.

    Parameters
    ----------
    mesh : with F faces.
    normals : (F, 3) unit, of the faces.
    """
    tol = tolerances or CreaseTolerances()
    num = len(mesh.faces)
    ones, corner_vertex = np.ones(3 * num), mesh.faces.ravel()
    shape = (3 * num, len(mesh.vertices))
    at_vertex = sparse.coo_array((ones, (np.arange(3 * num), corner_vertex)), shape=shape).tocsr()
    corner, face = (at_vertex @ mesh.incidence.T).tocoo().coords
    alike = (normals[corner // 3] * normals[face]).sum(axis=1) > np.cos(np.radians(tol.crease_deg))
    weight = mesh.face_areas[face] * alike
    mean = _sums(corner, weight[:, None] * normals[face], 3 * num)
    return _unit(mean).reshape(num, 3, 3)


def _sums(index: NDArray[np.int64], values: Array, num: int) -> Array:
    """Sums ``(num, 3)`` of rows ``(N, 3)`` by index."""
    return np.stack([np.bincount(index, column, num) for column in values.T], axis=1)


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))
