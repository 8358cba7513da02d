"""Triangle meshes as arrays: normals, neighbourhoods, ray casting, and extraction from a grid.

Ray casting uses Open3D (Embree), which is imported at the first cast.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from polmvs.geometry import dots, lengths, unit_or_zero
from polmvs.io.clouds import Mesh
from polmvs.io.open3d_import import import_open3d

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Faces = NDArray[np.int64]
Mask = NDArray[np.bool_]
# Of points (N, 3): (N,), negative in solid, positive in free space.
SignedDistance: TypeAlias = Callable[[Array], Floats]
# Lowest and highest corner along the axes of the world.
Box: TypeAlias = tuple[tuple[float, ...], tuple[float, ...]]

# Directions of rays whose majority decides inside or outside, as one may graze an edge; not axes.
SIGN_DIRECTIONS = (
    np.array([0.36, 0.48, 0.80]),
    np.array([-0.70, 0.10, 0.71]),
    np.array([0.25, -0.83, -0.50]),
)
LINE_OFFSET = np.array([1e-3, 7e-4])  # of rays beside lines of a grid, in its steps
MIN_CELLS = 30  # least number inside a piece of a mesh
MAX_CELLS = 6_000_000  # of a grid: 4 bytes each for a few arrays. From the memory allowed
BAND_CELLS = 3  # half width of the band about a mesh in which distances are computed


@dataclass(frozen=True)
class TriangleMesh:
    """A triangle mesh; derived quantities are computed once.

    Attributes
    ----------
    vertices : (V, 3) float64, world.
    faces : (F, 3) int64, indices of vertices, anticlockwise seen from outside.
    """

    vertices: Array
    faces: Faces

    @classmethod
    def of(cls, mesh: Mesh) -> TriangleMesh:
        """The triangles of a mesh of a file."""
        return cls(mesh.vertices, mesh.triangles.astype(np.int64))

    def with_faces_of(self, other: TriangleMesh) -> TriangleMesh:
        """Both meshes in one, not joined."""
        vertices = np.concatenate([self.vertices, other.vertices])
        return TriangleMesh(
            vertices, np.concatenate([self.faces, other.faces + len(self.vertices)])
        )

    @cached_property
    def corners(self) -> Array:
        """Vertices of each face, ``(F, 3, 3)``."""
        return self.vertices.take(self.faces, axis=0)

    @cached_property
    def centers(self) -> Array:
        """Centroids ``(F, 3)``."""
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.asarray((a + b + c) / 3)

    @cached_property
    def _crosses(self) -> Array:
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.asarray(np.cross(b - a, c - a))

    @cached_property
    def face_areas(self) -> Array:
        """Areas ``(F,)``."""
        return np.asarray(0.5 * lengths(self._crosses))

    @cached_property
    def face_normals(self) -> Array:
        """Unit normals ``(F, 3)``; 0 for a face without area."""
        return np.asarray(self._crosses / np.maximum(2 * self.face_areas, 1e-300)[:, None])

    @cached_property
    def vertex_normals(self) -> Array:
        """Unit normals ``(V, 3)``, means of the face normals weighted by area; 0 without faces."""
        total: Array = np.stack(
            [
                np.bincount(self.faces.ravel(), np.repeat(column, 3), len(self.vertices))
                for column in self._crosses.T
            ],
            axis=-1,
        )
        return unit_or_zero(total)

    @cached_property
    def adjacency(self) -> sparse.csr_array:
        """Symmetric ``(V, V)`` matrix with ones at the edges."""
        tail = self.faces[:, [0, 1, 2]].ravel()
        head = self.faces[:, [1, 2, 0]].ravel()
        num = len(self.vertices)
        ones = np.ones(2 * len(tail))
        indices = (np.concatenate([tail, head]), np.concatenate([head, tail]))
        matrix = sparse.coo_array((ones, indices), shape=(num, num)).tocsr()
        matrix.data[:] = 1.0
        return matrix

    @cached_property
    def neighbor_mean(self) -> sparse.csr_array:
        """``(V, V)``: the mean over the neighbours of each vertex."""
        degree = np.asarray(self.adjacency.sum(axis=1)).ravel()
        return sparse.csr_array(sparse.diags_array(1 / np.maximum(degree, 1)) @ self.adjacency)

    @cached_property
    def mean_edge(self) -> float:
        """Mean length of an edge."""
        ends = self.corners - np.roll(self.corners, 1, axis=1)
        return float(lengths(ends).mean()) if len(self.faces) else 0.0

    @cached_property
    def incidence(self) -> sparse.csr_array:
        """Which faces hold which vertices, ``(F, V)``."""
        num = len(self.faces)
        indices = (np.repeat(np.arange(num), 3), self.faces.ravel())
        shape = (num, len(self.vertices))
        return sparse.coo_array((np.ones(3 * num), indices), shape=shape).tocsr()

    @cached_property
    def face_pairs(self) -> sparse.csr_array:
        """Number of vertices that two faces share, sparse ``(F, F)``."""
        return sparse.csr_array(self.incidence @ self.incidence.T)

    @cached_property
    def face_components(self) -> NDArray[np.int64]:
        """Label ``(F,)`` of the connected piece of each face, from 0."""
        labels = connected_components(self.adjacency, directed=False)[1]
        _, compact = np.unique(labels[self.faces[:, 0]], return_inverse=True)
        return np.asarray(compact, np.int64)

    def pieces(self, chosen: Mask) -> NDArray[np.int64]:
        """Number ``(F,)`` of the connected piece of each chosen face, from 0; -1 of the others."""
        found = np.full(len(self.faces), -1, np.int64)
        index = np.flatnonzero(chosen)
        found[index] = connected_components(self.face_pairs[index][:, index], directed=False)[1]
        return found

    def moved(self, displacement: Array) -> TriangleMesh:
        """Vertices displaced by ``(V, 3)``."""
        return TriangleMesh(self.vertices + displacement, self.faces)

    def halved(self) -> TriangleMesh:
        """Each face cut into four at the middles of its edges; the inner ones are the last."""
        num = len(self.vertices)
        ends = np.sort(np.stack([self.faces, np.roll(self.faces, -1, axis=1)], axis=-1), axis=-1)
        edges, index = np.unique(ends.reshape(-1, 2), axis=0, return_inverse=True)
        middles = num + index.reshape(-1, 3)  # of the edges that begin at the three corners
        at_corners = np.stack([self.faces, middles, np.roll(middles, 1, axis=1)], axis=-1)
        faces = np.concatenate([at_corners.reshape(-1, 3), middles])
        vertices = np.concatenate([self.vertices, self.vertices[edges].mean(axis=1)])
        return TriangleMesh(vertices, faces)

    def only(self, kept: Mask) -> TriangleMesh:
        """The ``kept`` (F,) faces and the vertices that they use."""
        faces = self.faces[kept]
        used, compact = np.unique(faces, return_inverse=True)
        return TriangleMesh(self.vertices[used], compact.reshape(-1, 3).astype(np.int64))

    def points_at(self, face: NDArray[np.int64], barycentric: Floats) -> Array:
        """Points ``(N, 3)`` at barycentric coordinates ``(N, 3)`` of faces ``(N,)``."""
        return np.asarray(np.einsum("nji,nj->ni", self.corners.take(face, axis=0), barycentric))


def height_field(points: Array, kept: Mask) -> TriangleMesh:
    """Triangles between the kept ``(H, W)`` of points ``(H, W, 3)`` over a grid.

    They face where rows, columns and normal are right-handed.
    """
    index = np.arange(kept.size).reshape(kept.shape)
    a, b, c, d = index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]
    faces = np.stack([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).reshape(-1, 3)
    return TriangleMesh(points.reshape(-1, 3), faces).only(np.all(kept.ravel()[faces], axis=1))


@dataclass(frozen=True)
class RayHits:
    """Where rays first meet a mesh.

    Attributes
    ----------
    distance : (N,) in lengths of the ray's direction; inf without a hit.
    face : (N,) int64, -1 without a hit.
    barycentric : (N, 3) of the hit in its face.
    """

    distance: NDArray[np.float32]
    face: NDArray[np.int64]
    barycentric: NDArray[np.float32]


@dataclass(frozen=True)
class Crossings:
    """Where rays cross a mesh, by ray and then along it.

    Attributes
    ----------
    ray : (C,) index.
    distance : (C,) in lengths of the ray's direction.
    cosine : (C,) between the direction and the face's normal; negative where the ray enters.
    """

    ray: NDArray[np.int64]
    distance: NDArray[np.float32]
    cosine: Array


class RayScene:
    """A ``mesh`` for ray casting and distances."""

    def __init__(self, mesh: TriangleMesh) -> None:
        o3d = import_open3d()
        # Open3D computes in float32: coordinates are taken from the mesh's centre.
        self._origin = mesh.vertices.mean(axis=0) if len(mesh.vertices) else np.zeros(3)
        self._tensor = o3d.core.Tensor
        self.mesh = mesh
        self._scene: Any = o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            self._tensor(self._local(mesh.vertices)),
            self._tensor(np.ascontiguousarray(mesh.faces, np.uint32)),
        )
        if len(mesh.faces):  # the first query builds the tree, which two threads must not do
            self._scene.cast_rays(self._tensor(np.ones((1, 6), np.float32)))

    def _local(self, points: Floats) -> NDArray[np.float32]:
        return np.ascontiguousarray(points - self._origin, np.float32)

    def _rays(self, origins: Floats, directions: Floats) -> Any:
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = self._local(origins), directions
        return self._tensor(rays)

    def cast(self, origins: Floats, directions: Floats) -> RayHits:
        """First hits of rays from ``origins`` (3,) or (N, 3) along ``directions`` (N, 3)."""
        hits = self._scene.cast_rays(self._rays(origins, directions))
        distance = hits["t_hit"].numpy()
        face = hits["primitive_ids"].numpy().astype(np.int64)
        uv = hits["primitive_uvs"].numpy()
        barycentric = np.column_stack([1 - uv[:, 0] - uv[:, 1], uv])
        return RayHits(distance, np.where(np.isfinite(distance), face, -1), barycentric)

    def is_met(self, origin: Array, segments: Floats) -> Mask:
        """Which segments ``(N, 3)`` from an ``origin`` (3,) meet the mesh: faster than rays."""
        if not len(segments):  # Open3D crashes on none
            return np.zeros(0, np.bool_)
        rays = self._rays(origin, segments)
        return np.asarray(self._scene.test_occlusions(rays, tfar=1.0).numpy())

    def closest(self, points: Floats) -> tuple[Array, NDArray[np.int64], NDArray[np.float32]]:
        """Closest points ``(N, 3)``, their faces ``(N,)`` and barycentrics ``(N, 3)``."""
        found = self._scene.compute_closest_points(self._tensor(self._local(points)))
        uv = found["primitive_uvs"].numpy()
        place = found["points"].numpy().astype(np.float64) + self._origin
        face = found["primitive_ids"].numpy().astype(np.int64)
        return place, face, np.column_stack([1 - uv[:, 0] - uv[:, 1], uv])

    def signed_distance(self, points: Floats) -> NDArray[np.float32]:
        """Distance ``(N,)`` of points ``(N, 3)`` to the mesh, negative inside of it.

        A point is inside if the mesh winds about it, also where the mesh overlaps itself.
        """
        distance = self.distance(points)
        return np.where(self.is_inside(points), -distance, distance)

    def distance(self, points: Floats) -> NDArray[np.float32]:
        """Distance ``(N,)`` of points ``(N, 3)`` to the mesh."""
        if not len(points):  # Open3D crashes on none
            return np.zeros(0, np.float32)
        found = self._scene.compute_distance(self._tensor(self._local(points)))
        return np.asarray(found.numpy(), np.float32)

    def is_inside(self, points: Floats, *, num_rays: int = len(SIGN_DIRECTIONS)) -> Mask:
        """Which points ``(N, 3)`` the mesh winds about.

        ``num_rays``, odd, up to 3, is the number of rays whose majority decides: one may graze an
        edge.
        """
        local, votes = self._local(points), np.zeros(len(points), np.int64)
        for direction in SIGN_DIRECTIONS[:num_rays]:
            votes += self._windings(local, direction) > 0
        return np.asarray(2 * votes > num_rays)

    def crossed_faces(self, depth: float) -> NDArray[np.int64]:
        """Faces that do not separate inside from outside, because sheets of the mesh have crossed.

        Parameters
        ----------
        depth : distance of the compared points on both sides of a face.
        """
        suspects = np.arange(len(self.mesh.faces))
        # One ray decides nearly all faces; the others get three. Walls and gaps thinner than the
        # depth count as crossed as well.
        for num_rays in (1, len(SIGN_DIRECTIONS)):
            if not len(suspects):
                break
            centers = self.mesh.centers[suspects]
            step = depth * self.mesh.face_normals[suspects]
            inner = self.is_inside(centers - step, num_rays=num_rays)
            outer = self.is_inside(centers + step, num_rays=num_rays)
            suspects = suspects[outer | ~inner]
        return suspects

    def inside_along(self, origins: Floats, direction: Array, distances: Array) -> Mask:
        """Which points ``(D, N)`` on parallel rays lie inside.

        Parameters
        ----------
        origins : (N, 3).
        direction : (3,) unit.
        distances : (D,) of the points from the origins, ascending.
        """
        ray, leaves, length = self._crossings(self._local(origins), direction)
        # Beyond an inside point, the ray leaves the mesh more often than it enters it.
        last = np.searchsorted(distances, length)
        shape = (len(distances) + 1, len(origins))
        count = np.bincount(np.ravel_multi_index((last, ray), shape), leaves, shape[0] * shape[1])
        beyond = np.cumsum(count.reshape(shape)[::-1], axis=0)[::-1]
        return np.asarray(np.rint(beyond[1:]) > 0)

    def crossings(self, origins: Floats, directions: Floats) -> Crossings:
        """All crossings of rays from ``origins`` (3,) or (N, 3) along ``directions`` (N, 3)."""
        found = self._scene.list_intersections(self._rays(origins, directions))
        ray = found["ray_ids"].numpy().astype(np.int64)
        length = found["t_hit"].numpy()
        order = np.lexsort((length, ray))
        face = found["primitive_ids"].numpy().astype(np.int64)[order]
        cosine = np.einsum("ki,ki->k", self.mesh.face_normals[face], directions[ray[order]])
        return Crossings(ray[order], length[order], cosine)

    def _windings(self, local: NDArray[np.float32], direction: Array) -> NDArray[np.int64]:
        """Number ``(N,)`` of times a ray leaves the mesh minus the times it enters it."""
        ray, leaves, _ = self._crossings(local, direction)
        return np.rint(np.bincount(ray, leaves, len(local))).astype(np.int64)

    def _crossings(
        self, local: NDArray[np.float32], direction: Array
    ) -> tuple[NDArray[np.int64], Array, NDArray[np.float32]]:
        """Ray, 1 where it leaves and -1 where it enters, and length of every crossing ``(C,)``."""
        if not len(local):  # Open3D crashes on none
            return np.zeros(0, np.int64), np.zeros(0), np.zeros(0, np.float32)
        rays = np.empty((len(local), 6), np.float32)
        rays[:, :3], rays[:, 3:] = local, direction
        hits = self._scene.list_intersections(self._tensor(rays))
        face = hits["primitive_ids"].numpy().astype(np.int64)
        leaves = np.sign(self.mesh.face_normals[face] @ direction)
        return hits["ray_ids"].numpy().astype(np.int64), leaves, hits["t_hit"].numpy()


def visible_points(
    scene: RayScene,
    center: Array,
    points: Floats,
    normals: Floats,
    *,
    min_cosine: float,
) -> tuple[NDArray[np.int64], Array, Array]:
    """Points of the surface that a camera sees.

    Parameters
    ----------
    scene : the mesh, for occlusion; by less than half an edge length it does not count.
    center : (3,), of the camera.
    points, normals : (N, 3).
    min_cosine : between normal and direction to the camera.

    Returns
    -------
    index : (K,) of the visible ones.
    rays : (K, 3) unit, from the camera to them.
    cosine : (K,) between normal and direction to the camera.
    """
    away = np.asarray(points, np.float64) - center
    distance = lengths(away)
    rays = away / np.maximum(distance, 1e-300)[:, None]
    cosine: Array = -dots(rays, np.asarray(normals, np.float64))
    index = np.flatnonzero(cosine > min_cosine)
    before = 1 - 0.5 * scene.mesh.mean_edge / distance[index]
    index = index[~scene.is_met(center, before[:, None] * away.take(index, axis=0))]
    return index, rays.take(index, axis=0), cosine[index]


def mesh_from_grid(values: NDArray[np.float32], origin: Array, step: float) -> TriangleMesh:
    """Surface at zero of a function on a grid, by surface nets.

    Each cell that the surface passes has one vertex, at the mean of its crossings of the cell's
    edges, and each crossed edge of the grid has one quad. The triangles are far more regular than
    those of marching cubes. Values are negative inside.

    Parameters
    ----------
    values : (X, Y, Z); if not positive on the grid's border, the surface is open there.
    origin : (3,), place of ``values[0, 0, 0]``.
    step : distance of neighbours.
    """
    inside = values < 0
    shape = np.array(values.shape)
    cells = shape - 1
    # Cells whose corners differ.
    count = sum(
        inside[i : i + cells[0], j : j + cells[1], k : k + cells[2]].astype(np.int8)
        for i in (0, 1)
        for j in (0, 1)
        for k in (0, 1)
    )
    active = (count > 0) & (count < 8)
    cell = np.argwhere(active)
    if not len(cell):
        return TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    number = np.full(tuple(cells), -1, np.int64)
    number[active] = np.arange(len(cell))
    total, num = np.zeros((len(cell), 3)), np.zeros(len(cell))
    faces = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for a in (0, 1):
            for b in (0, 1):
                low = cell.copy()
                low[:, first] += a
                low[:, second] += b
                high = low.copy()
                high[:, axis] += 1
                at_low, at_high = values[tuple(low.T)], values[tuple(high.T)]
                crosses = (at_low < 0) != (at_high < 0)
                with np.errstate(divide="ignore", invalid="ignore"):
                    share = np.where(crosses, at_low / (at_low - at_high), 0.0)
                point = (low - cell).astype(np.float64)
                point[:, axis] += share
                total += np.where(crosses[:, None], point, 0)
                num += crosses
        # Quads about the grid's edges along this axis, away from its border.
        inner = [slice(1, n - 1) for n in shape]
        lower, upper = list(inner), list(inner)
        lower[axis], upper[axis] = slice(0, -1), slice(1, None)
        edge = np.argwhere(inside[tuple(lower)] != inside[tuple(upper)])
        offset = np.ones(3, np.int64)
        offset[axis] = 0
        edge = edge + offset
        unit_a, unit_b = np.eye(3, dtype=np.int64)[first], np.eye(3, dtype=np.int64)[second]
        ring = [edge - unit_a - unit_b, edge - unit_b, edge, edge - unit_a]
        quad = np.stack([number[tuple(corner.T)] for corner in ring], axis=1)
        outwards = inside[tuple(edge.T)]
        quad[~outwards] = quad[~outwards][:, ::-1]
        faces.append(quad)
    vertices = origin + step * (cell + total / num[:, None])
    return TriangleMesh(vertices, _split_quads(vertices, np.concatenate(faces)))


def _split_quads(vertices: Array, quads: NDArray[np.int64]) -> Faces:
    """Two triangles for each quad, along its shorter diagonal."""
    a, b, c, d = (vertices[quads[:, i]] for i in range(4))
    along = lengths(a - c) <= lengths(b - d)
    first = np.where(along[:, None], quads[:, [0, 1, 2]], quads[:, [1, 2, 3]])
    second = np.where(along[:, None], quads[:, [0, 2, 3]], quads[:, [1, 3, 0]])
    return np.concatenate([first, second])


def relaxed(mesh: TriangleMesh, rounds: int = 2) -> TriangleMesh:
    """Vertices moved along the surface towards the mean of their neighbours."""
    for _ in range(rounds):
        towards = mesh.neighbor_mean @ mesh.vertices - mesh.vertices
        normals = mesh.vertex_normals
        towards -= dots(towards, normals)[:, None] * normals
        mesh = mesh.moved(0.5 * towards)
    return mesh


def thickened(scene: RayScene, coarse: RayScene, edge: float) -> TriangleMesh:
    """The mesh of a scene, widened on both sides where a coarse mesh of it lost thin parts.

    These and what lies within two edges of them, to which they are joined, become two edges thick.
    Every position of a rod two grid spacings wide holds a point of the grid, so :func:`remeshed`
    keeps it.

    Parameters
    ----------
    scene : of a closed mesh.
    coarse : of the same surface, with edges of length ``edge``. A vertex farther from it than an
        edge is lost. The rounded sides of a plate lie nearer.
    """
    mesh = scene.mesh
    if not len(mesh.faces):
        return mesh
    is_lost = np.ones(len(mesh.vertices), np.bool_)
    if len(coarse.mesh.faces):
        is_lost = coarse.distance(mesh.vertices) > edge
    if not is_lost.any():
        return mesh
    is_near = cKDTree(mesh.vertices[is_lost]).query(mesh.vertices)[0] <= 2 * edge
    inwards = -mesh.vertex_normals
    start = 2e-3 * edge  # off the vertex's own faces
    thickness = start + scene.cast(mesh.vertices + start * inwards, inwards).distance
    missing = np.where(is_near, np.clip(2 * edge - thickness, 0, None), 0.0)
    return mesh.moved(-0.5 * missing[:, None] * inwards)


@dataclass(frozen=True)
class DistanceGrid:
    """Signed distance to a closed mesh on a grid, from which meshes with free space are made.

    Attributes
    ----------
    values : (X, Y, Z) float32, clipped to ``BAND_CELLS`` steps, negative inside.
    origin : (3,), place of ``values[0, 0, 0]``.
    step : of the grid, world units.
    """

    values: NDArray[np.float32]
    origin: Array
    step: float

    @classmethod
    def of(cls, scene: RayScene, step: float, box: Box | None = None) -> DistanceGrid:
        """The grid about the mesh of a scene, which has faces, or about its part in a box."""
        vertices = scene.mesh.vertices
        low, high = (vertices.min(axis=0), vertices.max(axis=0)) if box is None else np.array(box)
        origin = low - (BAND_CELLS + 1) * step
        shape = tuple(int(n) for n in np.ceil((high - low) / step) + 2 * BAND_CELLS + 3)
        return cls(_signed_distances(scene, origin, step, shape), origin, step)

    def mesh(
        self,
        *,
        solid: Sequence[SignedDistance] = (),
        free: Sequence[SignedDistance] = (),
        smoothing: float = 0.5,
    ) -> TriangleMesh:
        """The mesh of the grid's surface; see :func:`remeshed`."""
        origin, step, shape = self.origin, self.step, self.values.shape
        limit = np.float32(BAND_CELLS * step)
        values = (
            ndimage.gaussian_filter(self.values, smoothing) if smoothing else self.values.copy()
        )
        if solid:
            rest = np.stack(np.meshgrid(*map(np.arange, shape[1:]), indexing="ij"), axis=-1)
            for number, slab in enumerate(values):  # to bound the memory
                cells = np.concatenate([np.full((*shape[1:], 1), number), rest], axis=-1)
                points = origin + step * cells.reshape(-1, 3)
                for function in solid:
                    distances = np.clip(function(points), -limit, limit).reshape(slab.shape)
                    np.minimum(slab, distances, out=slab)
        if free:
            inner = values < limit
            points = origin + step * np.argwhere(inner)
            for function in free:
                values[inner] = np.maximum(values[inner], np.minimum(function(points), limit))
        _drop_small(values, limit)
        return relaxed(mesh_from_grid(values, origin, step))


def remeshed(
    scene: RayScene,
    step: float,
    *,
    solid: Sequence[SignedDistance] = (),
    free: Sequence[SignedDistance] = (),
    smoothing: float = 0.5,
) -> TriangleMesh:
    """The mesh of a scene, with edges of about ``step`` from its signed distance on a grid.

    The new mesh does not intersect itself; touching pieces are joined, and pieces that enclose
    fewer than ``MIN_CELLS`` cells are removed.

    Parameters
    ----------
    scene : of a closed mesh.
    step : of the grid, world units.
    solid : functions of points ``(N, 3)`` that give signed distances ``(N,)``, negative in solid
        to add.
    free : functions of points ``(N, 3)`` that give signed distances ``(N,)``, positive in free
        space to carve; its borders are not smoothed.
    smoothing : width of a Gaussian on the distances, in steps.
    """
    if not len(scene.mesh.faces):
        return scene.mesh
    return DistanceGrid.of(scene, step).mesh(solid=solid, free=free, smoothing=smoothing)


def _signed_distances(
    scene: RayScene, origin: Array, step: float, shape: tuple[int, ...]
) -> NDArray[np.float32]:
    """Signed distance to a scene on a grid, clipped to ``BAND_CELLS`` steps, negative inside."""
    band = _band_about(scene.mesh, origin, step, shape)
    limit = np.float32(BAND_CELLS * step)
    values = np.full(shape, np.nan, np.float32)
    values[band] = scene.distance(origin + step * np.argwhere(band))
    # One ray decides for a whole line of the grid. It runs beside the line, on which vertices may
    # lie.
    lines = np.argwhere(band.any(axis=2))
    starts = np.column_stack([lines + LINE_OFFSET, np.zeros(len(lines))])
    is_inside = np.zeros(shape, np.bool_)
    is_inside[tuple(lines.T)] = scene.inside_along(
        origin + step * starts,
        np.array([0.0, 0.0, 1.0]),
        step * np.arange(shape[2], dtype=np.float64),
    ).T
    values[is_inside] *= -1
    doubtful = _impossible_signs(values, step)
    if doubtful.any():
        values[doubtful] = scene.signed_distance(origin + step * np.argwhere(doubtful))
    values[band] = np.clip(values[band], -limit, limit)
    values[~band] = limit
    # Beyond the band each piece has the sign of any of its points.
    pieces, num_pieces = ndimage.label(~band)
    points = np.zeros(num_pieces + 1, np.int32)
    points[pieces.ravel()] = np.arange(pieces.size, dtype=np.int32)
    cells = np.stack(np.unravel_index(points[1:], shape), axis=1)
    of_pieces = np.append(False, scene.is_inside(origin + step * cells))
    values[of_pieces[pieces]] = -limit
    return values


def _band_about(mesh: TriangleMesh, origin: Array, step: float, shape: tuple[int, ...]) -> Mask:
    """Grid points within about ``BAND_CELLS`` steps of a mesh."""
    band = np.zeros(shape, np.bool_)
    num = int(np.ceil(1 + 2 * mesh.mean_edge / step))
    cells = (mesh.corners - origin) / step
    near = ((cells.max(axis=1) > -0.5) & (cells.min(axis=1) < np.array(shape) - 0.5)).all(axis=1)
    cells = cells[near]
    for weights in _simplex_lattice(num):
        place = np.rint(np.tensordot(weights, cells, (0, 1)))
        place = place[((place >= 0) & (place < shape)).all(axis=1)]
        band[tuple(place.astype(np.int64).T)] = True
    return np.asarray(ndimage.binary_dilation(band, iterations=BAND_CELLS))


def _impossible_signs(values: NDArray[np.float32], step: float) -> Mask:
    """Grid points whose sign differs from a neighbour's although both are too far from the mesh.

    The sign cannot change between neighbours that are farther from the mesh than from each other.
    """
    doubtful = np.zeros(values.shape, np.bool_)
    for axis in range(3):
        first, second = (np.moveaxis(values, axis, 0)[part] for part in (slice(-1), slice(1, None)))
        apart = np.minimum(np.abs(first), np.abs(second)) > 1.01 * step
        jumps = (first * second < 0) & apart
        for part in (slice(-1), slice(1, None)):
            np.moveaxis(doubtful, axis, 0)[part] |= jumps
    return doubtful


def _drop_small(values: NDArray[np.float32], outside: np.float32) -> None:
    """Fill inside pieces of fewer than ``MIN_CELLS`` grid points with ``outside``, in place."""
    labels, num = ndimage.label(values < 0)
    if num > 1:
        small = np.bincount(labels.ravel()) < MIN_CELLS
        small[0] = False
        values[small[labels]] = outside


def _simplex_lattice(num: int) -> Array:
    """Barycentric coordinates ``(K, 3)`` that cover a triangle, ``num`` to an edge."""
    i, j = np.meshgrid(np.arange(num + 1), np.arange(num + 1), indexing="ij")
    inside = i + j <= num
    lattice = np.stack([i[inside], j[inside], num - i[inside] - j[inside]], axis=1)
    return np.asarray(lattice / num)


def sample_surface(
    mesh: TriangleMesh, weights: Floats, num: int, rng: np.random.Generator
) -> tuple[NDArray[np.int64], Array]:
    """Faces ``(N,)`` and barycentric coordinates ``(N, 3)`` of evenly spread points on a mesh.

    Parameters
    ----------
    mesh : the surface.
    weights : (F,), weight of each face, 0 to 1.
    num : expected number of points.
    rng : random numbers.
    """
    area = mesh.face_areas * weights
    total = float(area.sum())
    if total <= 0:
        return np.zeros(0, np.int64), np.zeros((0, 3))
    # Stratified: the running area passes a whole number where a point falls.
    running = np.concatenate([[0.0], np.cumsum(area)]) * (num / total) + rng.random()
    count = np.diff(np.floor(running)).astype(np.int64)
    face = np.repeat(np.arange(len(area)), count)
    root, share = np.sqrt(rng.random(len(face))), rng.random(len(face))
    barycentric = np.column_stack([1 - root, root * (1 - share), root * share])
    return face, barycentric
