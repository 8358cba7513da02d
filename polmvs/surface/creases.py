"""Sharp edges of a mesh from the normals of its faces.

A mesh whose triangles do not follow an edge of the object rounds it over the width of a triangle.
The normals from the phases belong to one side or the other up to a few pixels from the edge.
Smoothing them only over faces with similar normals separates the sides. Vertices then move until
all faces around them have the smoothed normals; this puts the vertices on the edge.

Sun et al., Fast and effective feature-preserving mesh denoising, TVCG 2007.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from polmvs.geometry import dots
from polmvs.surface.mesh_geometry import SignedDistance, TriangleMesh

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

GRADIENT_STEP = 0.1  # of the mean edge length: small against the resolution of the mesh


@dataclass(frozen=True, kw_only=True)
class CreaseTolerances:
    """Tolerances for faces that belong to one side of an edge.

    Attributes
    ----------
    like_sine : width of the Gaussian, in differences of unit normals, by which neighbouring normals
        are averaged. Above the noise of fitted normals (1 to 3 deg) and the curvature of a face,
        below the edges of parts. Measured on five captures: with 0.4 for 0.2 the F-score at 1 mm
        falls by 0.2 to 1.4 points. A face's vertices are free to move if its own normal differs
        from the given one by half of this.
    crease_deg : between normals of different sides, of a mesh, of its phases and of planar patches:
        a face across a right-angled edge is turned by at most 45 deg. Measured: 60 for the corners
        costs an analytic bracket 0.24 deg, 50 for the phases' normals 0.4 points of F at 1 mm; half
        of it is as good.
    unfitted_weight : of a normal of the mesh. Measured, 1 for 0.2: the error of normals of `step`
        is 2.10 deg and not 1.81, of `mug` 1.78 and not 1.96.
    normal_rounds : of the average. Measured, 6, 12, 20: the error of normals of `step` is 2.61,
        2.47, 2.40 deg, of `mug` 1.84, 1.97, 2.12.
    vertex_rounds : of the vertices' moves. Measured on `step`: the faces along the edge of the box
        are too low by 0.16, 0.11, 0.12, 0.12 mm after 20, 30, 40 and 240. With contradictory
        normals (OPA's) vertices far from edges move as well: F at 1 mm of OPA on `mug` is 84, 84,
        53 % after 12, 20 and 40.
    """

    like_sine: float = 0.2
    crease_deg: float = 25.0
    unfitted_weight: float = 0.2
    normal_rounds: int = 10
    vertex_rounds: int = 20


TOL = CreaseTolerances()


@dataclass(frozen=True)
class SideAverage:
    """Average of values of faces over the sides of edges.

    Attributes
    ----------
    weights : (F, F) float32, of one round; rows sum to 1.
    rounds : how often it is applied.
    """

    weights: sparse.csr_array
    rounds: int

    def of(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """Averages ``(F, C)`` of values ``(F, C)``."""
        for _ in range(self.rounds):
            values = self.weights @ values
        return values


def sided_normals(
    mesh: TriangleMesh,
    normals: Array,
    is_fitted: Mask,
) -> tuple[Array, SideAverage]:
    """Normals of faces smoothed within the sides of edges (a bilateral filter).

    Parameters
    ----------
    mesh : with F faces.
    normals : (F, 3) unit.
    is_fitted : (F,) bool, normals from the phases.

    Returns
    -------
    The normals ``(F, 3)``, unit, and the average that made them.
    """
    average = mesh.face_pairs.copy()
    one, other = average.tocoo().coords
    near = np.exp(-0.5 * _squared_distance(mesh.centers, one, other) / mesh.mean_edge**2)
    certain = mesh.face_areas * np.where(is_fitted, 1.0, TOL.unfitted_weight)
    near *= certain[other]
    normals = _taken_from_sides(normals, is_fitted, one, other)
    for _ in range(TOL.normal_rounds):
        apart = _squared_distance(normals, one, other)
        average.data = near * np.exp(-0.5 * apart / TOL.like_sine**2)
        normals = _unit(average @ normals)
    total = np.maximum(np.asarray(average.sum(axis=1)), 1e-300)
    average.data = (average.data / total[one]).astype(np.float32)
    return normals, SideAverage(average, TOL.normal_rounds)


def _taken_from_sides(
    normals: Array,
    is_known: Mask,
    one: NDArray[np.integer],
    other: NDArray[np.integer],
) -> Array:
    """Normals ``(F, 3)``; an unknown face on an edge gets that of the nearest known side.

    A rounded face across an edge belongs to one of its sides, but resembles neither enough for the
    average of similar normals.

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
    nearest &= (alike > np.sqrt(0.5)) & (alike < np.cos(np.radians(TOL.crease_deg)))
    taken = normals.copy()
    taken[one[nearest]] = normals[other[nearest]]
    return taken


def sides_known(mesh: TriangleMesh, normals: Array, is_known: Mask) -> Mask:
    """Which faces ``(F,)`` belong to a side with a known face nearby.

    Parameters
    ----------
    mesh : with F faces.
    normals : (F, 3) unit, as of :func:`sided_normals`.
    is_known : (F,) bool, faces with a measured normal.
    """
    one, other = mesh.face_pairs.tocoo().coords
    alike = (normals[one] * normals[other]).sum(axis=1) > np.cos(np.radians(TOL.crease_deg))
    one, other = one[alike], other[alike]
    for _ in range(2):  # rings of triangles over which an edge is rounded
        near = one[is_known[other]]
        is_known = is_known.copy()
        is_known[near] = True
    return is_known


def crease_vertices(mesh: TriangleMesh, is_shown: Mask) -> Mask:
    """Which vertices ``(V,)`` of a sharpened mesh lie on an edge between known sides.

    Parameters
    ----------
    mesh : with V vertices and F faces.
    is_shown : (F,) bool, faces of sides that are known.
    """
    corner = mesh.faces.ravel()
    apart = dots(mesh.vertex_normals[corner], np.repeat(mesh.face_normals, 3, axis=0))
    # The angle of each side to their mean is half of the angle between them.
    turned = apart < np.cos(np.radians(0.5 * TOL.crease_deg))
    found = np.zeros(len(mesh.vertices), np.bool_)
    found[corner[turned]] = True
    found[mesh.faces[~is_shown]] = False
    return found


def wall_normals(
    mesh: TriangleMesh,
    normals: Array,
    is_fitted: Mask,
    carvings: Sequence[SignedDistance],
    to_uncarved: Floats,
) -> tuple[Array, Mask]:
    """Normals ``(F, 3)`` with those of carved walls as carved, and which faces ``(F,)`` are walls.

    Walls of height steps and cavities reflect what is next to them, and their phases are those of
    its mirror image.

    Parameters
    ----------
    mesh : carved, with F faces.
    normals, is_fitted : as of :func:`sided_normals`.
    carvings : signed distances of points ``(N, 3)``, positive in the carved space.
    to_uncarved : (F,), distances of the faces to the surface before carving.
    """
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
    is_wall &= ~is_fitted | (dots(carved, normals) < np.cos(np.radians(TOL.crease_deg)))
    return np.where(is_wall[:, None], carved, normals), is_wall


def _gradients(values: SignedDistance, points: Array, step: float) -> Array:
    """Unit gradients ``(N, 3)`` of a function at points ``(N, 3)``, from central differences."""
    slopes = [values(points + step * axis) - values(points - step * axis) for axis in np.eye(3)]
    return _unit(np.stack(slopes, axis=-1).astype(np.float64))


def sharpened(mesh: TriangleMesh, normals: Array) -> TriangleMesh:
    """The mesh with its vertices moved until its faces have given normals ``(F, 3)``."""
    if not len(mesh.faces):
        return mesh
    num, area = len(mesh.vertices), mesh.face_areas
    total = np.maximum(mesh.incidence.T @ area, 1e-300)[:, None]
    # Vertices that fit stay: an edge must not be sharpened at the expense of the patch beside it.
    off = ((mesh.face_normals - normals) ** 2).sum(axis=1)
    off = (mesh.incidence.T @ (area * off))[:, None] / total
    mobility = 1 - np.exp(-0.5 * off / (0.5 * TOL.like_sine) ** 2)
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
    for k in range(TOL.vertex_rounds):
        # With momentum (Nesterov): long-range moves of edges are slow without it.
        ahead = moved + k / (k + 3) * (moved - before)
        vertices, before = start + ahead, moved
        height = along @ vertices.ravel() / 3
        step = (spread @ height).reshape(-1, 3) - (own @ vertices[:, :, None])[..., 0]
        moved = ahead + mobility * step / total
        length = np.linalg.norm(moved, axis=1, keepdims=True)
        # Rounding removes less than an edge length; half of it as a limit gives the same.
        moved = moved * np.minimum(1.0, mesh.mean_edge / np.maximum(length, 1e-300))
    return mesh.moved(moved)


def corner_normals(mesh: TriangleMesh, normals: Array) -> Array:
    """Normals ``(F, 3, 3)`` of the corners of faces: means over the faces of the same side.

    Parameters
    ----------
    mesh : with F faces.
    normals : (F, 3) unit, of the faces.
    """
    num = len(mesh.faces)
    ones, corner_vertex = np.ones(3 * num), mesh.faces.ravel()
    shape = (3 * num, len(mesh.vertices))
    at_vertex = sparse.coo_array((ones, (np.arange(3 * num), corner_vertex)), shape=shape).tocsr()
    corner, face = (at_vertex @ mesh.incidence.T).tocoo().coords
    alike = (normals[corner // 3] * normals[face]).sum(axis=1) > np.cos(np.radians(TOL.crease_deg))
    weight = mesh.face_areas[face] * alike
    mean = sparse.coo_array((weight, (corner, face)), shape=(3 * num, num)).tocsr() @ normals
    return _unit(mean).reshape(num, 3, 3)


def _squared_distance(places: Array, one: NDArray[np.integer], other: NDArray[np.integer]) -> Array:
    """Of pairs ``(N,)`` of places ``(P, 3)``."""
    squares = [(column[one] - column[other]) ** 2 for column in np.ascontiguousarray(places.T)]
    return np.asarray(sum(squares))


def _unit(vectors: Array) -> Array:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))
