"""Sharp edges of a mesh from the normals of its faces.

A mesh whose triangles do not follow an edge of the object rounds it over a triangle's width. The
normals that the phases give are those of one side or of the other up to a few pixels from the edge:
smoothed over faces of like normal alone, they part the sides, and vertices that are moved until
all faces about them lie in planes of these normals come to lie on the edge itself.

Sun et al., Fast and effective feature-preserving mesh denoising, TVCG 2007.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from polmvs.geometry import dots
from polmvs.surface.mesh_geometry import TriangleMesh

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

GRADIENT_STEP = 0.1  # of a mesh's edge: small against what it can show


@dataclass(frozen=True, kw_only=True)
class CreaseTolerances:
    """When faces belong to one side of an edge.

    Attributes
    ----------
    like_sine : deviation of the difference of normals that are averaged. Above the noise of fitted
        normals (1 to 3 deg) and the curvature of a face, below the edges of parts. Measured on five
        captures: with 0.4 for 0.2 the F-score at 1 mm falls by 0.2 to 1.4 points. Half of it is
        the deviation of a face's own normal from the given one at which its vertices are free to
        move.
    crease_deg : between normals of different sides, of a mesh, of its phases and of faces that
        points show: a face that a mesh rounds across a right-angled edge is turned by 45 deg, most
        by less. Measured: 60 for the corners costs an analytic bracket 0.24 deg, 50 for the phases'
        normals 0.4 points of F at 1 mm; half of it is as good.
    unfitted_weight : of a normal that is the mesh's own. Measured, 1 for 0.2: normals of `step` err
        by 2.10 deg and not 1.81, of `mug` by 1.78 and not 1.96.
    normal_rounds : of the average. Measured, 6, 12, 20: normals of `step` err by 2.61, 2.47, 2.40
        deg, of `mug` by 1.84, 1.97, 2.12.
    vertex_rounds : of the vertices' move. Measured on `step`: the faces along the edge of the box
        lie too low by 0.16, 0.11, 0.12, 0.12 mm after 20, 30, 40 and 240. Where normals contradict
        one another (OPA's) what lies far from edges moves as well: F at 1 mm of OPA on `mug` is
        84, 84, 53 % after 12, 20 and 40.
    """

    like_sine: float = 0.2
    crease_deg: float = 25.0
    unfitted_weight: float = 0.2
    normal_rounds: int = 10
    vertex_rounds: int = 20


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
    average = mesh.face_pairs.copy()
    one, other = average.tocoo().coords
    near = np.exp(-0.5 * _squared_distance(mesh.centers, one, other) / mesh.mean_edge**2)
    certain = mesh.face_areas * np.where(is_fitted, 1.0, tol.unfitted_weight)
    near *= certain[other]
    normals = _taken_from_sides(normals, is_fitted, one, other, tol)
    for _ in range(tol.normal_rounds):
        apart = _squared_distance(normals, one, other)
        average.data = near * np.exp(-0.5 * apart / tol.like_sine**2)
        normals = _unit(average @ normals)
    return normals


def _taken_from_sides(
    normals: Array,
    is_known: Mask,
    one: NDArray[np.integer],
    other: NDArray[np.integer],
    tol: CreaseTolerances,
) -> Array:
    """Normals ``(F, 3)``, of unknown faces turned from known ones beside them that of the nearest.

    A face that a mesh rounds across an edge is of one of its sides, and resembles neither enough
    for an average of like ones to tell which.

    Parameters
    ----------
    normals : (F, 3) unit.
    is_known : (F,) bool.
    one, other : (N,), pairs of faces that share a vertex.
    """
    ahead = ~is_known[one] & is_known[other]
    one, other = one[ahead], other[ahead]
    alike = dots(normals[one], normals[other])
    order = np.lexsort((-alike, one))
    one, other, alike = one[order], other[order], alike[order]
    nearest = np.diff(one, prepend=-1) > 0
    # Turned from the nearer side of a right angle by no more than its middle is.
    nearest &= (alike > np.sqrt(0.5)) & (alike < np.cos(np.radians(tol.crease_deg)))
    taken = normals.copy()
    taken[one[nearest]] = normals[other[nearest]]
    return taken


def sides_known(
    mesh: TriangleMesh, normals: Array, is_known: Mask, tolerances: CreaseTolerances | None = None
) -> Mask:
    """Which faces ``(F,)`` belong to a side of which some face near them is known.

    Parameters
    ----------
    mesh : with F faces.
    normals : (F, 3) unit, as of :func:`sided_normals`.
    is_known : (F,) bool, faces whose normals something shows.
    """
    tol = tolerances or CreaseTolerances()
    one, other = mesh.face_pairs.tocoo().coords
    alike = (normals[one] * normals[other]).sum(axis=1) > np.cos(np.radians(tol.crease_deg))
    one, other = one[alike], other[alike]
    for _ in range(2):  # rings of triangles over which an edge is rounded
        near = one[is_known[other]]
        is_known = is_known.copy()
        is_known[near] = True
    return is_known


def crease_vertices(
    mesh: TriangleMesh, is_shown: Mask, tolerances: CreaseTolerances | None = None
) -> Mask:
    """Which vertices ``(V,)`` of a sharpened mesh lie on an edge between sides that are known.

    Parameters
    ----------
    mesh : with V vertices and F faces.
    is_shown : (F,) bool, faces of sides that are known.
    """
    tol = tolerances or CreaseTolerances()
    corner = mesh.faces.ravel()
    apart = dots(mesh.vertex_normals[corner], np.repeat(mesh.face_normals, 3, axis=0))
    # Two sides are turned from their mean by half of what they are from each other.
    turned = apart < np.cos(np.radians(0.5 * tol.crease_deg))
    found = np.zeros(len(mesh.vertices), np.bool_)
    found[corner[turned]] = True
    found[mesh.faces[~is_shown]] = False
    return found


def wall_normals(
    mesh: TriangleMesh,
    normals: Array,
    is_fitted: Mask,
    carvings: Sequence[Callable[[Array], Floats]],
    to_uncarved: Floats,
    tolerances: CreaseTolerances | None = None,
) -> tuple[Array, Mask]:
    """Normals ``(F, 3)``, those of carved walls as they were carved, and which faces ``(F,)`` are.

    Walls of steps and of cavities see what stands beside them, and their phases are those of its
    mirror image.

    Parameters
    ----------
    mesh : carved, with F faces.
    normals, is_fitted : as of :func:`sided_normals`.
    carvings : signed distances of points ``(N, 3)``, positive in the space that is carved away.
    to_uncarved : (F,), distances of the faces to the surface before.
    """
    tol = tolerances or CreaseTolerances()
    carved, is_carved = normals.copy(), np.zeros(len(normals), np.bool_)
    # The grid has rounded the edges of walls: a face belongs to what passes nearest to it.
    nearest = np.minimum(to_uncarved, mesh.mean_edge)
    for values in carvings:
        distance = np.abs(values(mesh.centers))
        own = np.flatnonzero(distance < nearest)
        carved[own] = _gradients(values, mesh.centers[own], GRADIENT_STEP * mesh.mean_edge)
        nearest[own], is_carved[own] = distance[own], True
    to_carved = dots(carved, mesh.face_normals)
    # A face that is rounded across a right-angled edge is turned by no more than half of it; where
    # phases show another side than the carving, the face has that of the two which is nearer.
    is_wall = is_carved & (to_carved > np.sqrt(0.5))
    is_wall &= ~is_fitted | (to_carved > dots(normals, mesh.face_normals))
    is_wall &= ~is_fitted | (dots(carved, normals) < np.cos(np.radians(tol.crease_deg)))
    return np.where(is_wall[:, None], carved, normals), is_wall


def _gradients(values: Callable[[Array], Floats], points: Array, step: float) -> Array:
    """Unit gradients ``(N, 3)`` of a function at points ``(N, 3)``, from central differences."""
    slopes = [values(points + step * axis) - values(points - step * axis) for axis in np.eye(3)]
    return _unit(np.stack(slopes, axis=-1).astype(np.float64))


def sharpened(
    mesh: TriangleMesh, normals: Array, tolerances: CreaseTolerances | None = None
) -> TriangleMesh:
    """The mesh, its vertices moved until its faces have given normals ``(F, 3)``."""
    tol = tolerances or CreaseTolerances()
    if not len(mesh.faces):
        return mesh
    num, area = len(mesh.vertices), mesh.face_areas
    total = np.maximum(mesh.incidence.T @ area, 1e-300)[:, None]
    # Places that fit stay: what a rounded edge lacks is not to be taken from the face beside it.
    off = ((mesh.face_normals - normals) ** 2).sum(axis=1)
    off = (mesh.incidence.T @ (area * off))[:, None] / total
    mobility = 1 - np.exp(-0.5 * off / (0.5 * tol.like_sine) ** 2)
    # All steps are one linear map: the mean height of a face's corners along its normal less each
    # corner's own, times the area, summed at the corners.
    columns = (3 * mesh.faces[:, :, None] + np.arange(3)).reshape(-1)
    indptr = 9 * np.arange(len(area) + 1)
    along = sparse.csr_array(
        (np.tile(normals, (1, 3)).ravel(), columns, indptr), (len(area), 3 * num)
    )
    spread = sparse.csr_array(along.T @ sparse.diags_array(area))
    squares = (area[:, None, None] * normals[:, :, None] * normals[:, None, :]).reshape(-1, 9)
    own = (mesh.incidence.T @ squares).reshape(-1, 3, 3)
    start = mesh.vertices - mesh.vertices.mean(axis=0)
    moved = before = np.zeros_like(start)
    for k in range(tol.vertex_rounds):
        # With the last move once more (Nesterov): what takes edges together is slow without.
        ahead = moved + k / (k + 3) * (moved - before)
        vertices, before = start + ahead, moved
        height = along @ vertices.ravel() / 3
        step = (spread @ height).reshape(-1, 3) - (own @ vertices[:, :, None])[..., 0]
        moved = ahead + mobility * step / total
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        # What rounding takes is less than an edge; half of one as a limit gives the same.
        moved = moved * np.minimum(1.0, mesh.mean_edge / np.maximum(length, 1e-300))
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
    mean = sparse.coo_array((weight, (corner, face)), shape=(3 * num, num)).tocsr() @ normals
    return _unit(mean).reshape(num, 3, 3)


def _squared_distance(places: Array, one: NDArray[np.integer], other: NDArray[np.integer]) -> Array:
    """Of pairs ``(N,)`` of places ``(P, 3)``."""
    squares = [(column[one] - column[other]) ** 2 for column in np.ascontiguousarray(places.T)]
    return np.asarray(sum(squares))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))
