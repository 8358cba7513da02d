"""Printed marks on the object, which give SfM sparse points on a part without texture."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree

from polmvs.arrays import Array
from polmvs.errors import DataError
from polmvs.geometry import unit
from polmvs.io.clouds import Mesh
from polmvs.io.plain_files import read_rows
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh

PRINT_CELLS = 8  # along a mark's side
CELL_TEXELS = 8
CANDIDATES = 4000
LOWEST = -0.3  # z of a mark's normal: few views see surfaces that face farther down
# The surface about a mark is flat: a disc of this radius deviates from it by at most this gap, both
# in radii of the mark. So a mark is half a radius from an edge: there it would break the outline.
FLAT_RADIUS, MAX_GAP = 2.0, 0.5
EDGE_POINTS = 12  # of the disc's circle, where that is tested
KMEANS_ITERATIONS = 50  # at most; nine parts of a plate stay as they are after fewer


@dataclass(frozen=True, kw_only=True, eq=False)
class Marks:
    """Round prints under the gloss of the surface.

    Attributes
    ----------
    centers, axes : (M, 3) and (M, 3, 3), world; the rows of the axes are the print's x and y and
        the surface's normal.
    radius : metres.
    print_atlas : (N, M N) float32, albedo, one print beside the other.
    """

    centers: Array
    axes: Array
    radius: float
    print_atlas: NDArray[np.float32]


def marks_on(mesh: Mesh, number: int, diameter: float, seed: int) -> Marks:
    """Marks spread evenly over the surface that faces upwards or sideways.

    They lie where the surface is flat enough: for a plate that is thinner than a mark, on its top,
    away from its edges. If the surface is nowhere flat enough, they lie anywhere.

    Parameters
    ----------
    mesh : of the object, metres.
    number : of marks.
    diameter : of a mark, metres.
    seed : of their positions and prints.
    """
    rng = np.random.default_rng(seed)
    points, normals = _on_surface(mesh, rng)
    seen = normals[:, 2] > LOWEST
    fitting = seen & _fits(mesh, points, normals, 0.5 * diameter)
    above_ground = points[:, 2] > 0.5 * diameter * np.hypot(normals[:, 0], normals[:, 1])
    usable = next(
        (w for w in (fitting & above_ground, fitting, seen & above_ground) if w.any()), seen
    )
    points, normals = points[usable], normals[usable]
    chosen = _spread(points, normals, number, seed)
    return _printed(points[chosen], normals[chosen], diameter, rng)


def marks_at(mesh: Mesh, file: Path, diameter: float, seed: int) -> Marks:
    """Marks at given points.

    Parameters
    ----------
    mesh : of the object, metres.
    file : text, a line ``x y z`` for each mark, in the mesh's frame, metres; a mark lies at the
        closest point of the surface.
    diameter : of a mark, metres.
    seed : of their prints.

    Raises
    ------
    DataError
        The file is missing or malformed, or a point is farther than a mark's radius from the
        surface.
    """
    places = _read_places(file)
    surface = RayScene(TriangleMesh.of(mesh))
    points, triangles, weights = surface.closest(places)
    away = np.linalg.norm(points - places, axis=1)
    if away.max() > 0.5 * diameter:
        farthest = int(away.argmax())
        raise DataError(
            file,
            f"place {farthest + 1} is {away[farthest]:.3g} m from the object's surface; places are "
            "in metres, in the object's frame (gt/mesh.ply).",
        )
    corners = mesh.normals[mesh.triangles[triangles]]
    normals = unit(np.einsum("nk,nkd->nd", weights, corners))
    return _printed(points, normals, diameter, np.random.default_rng(seed))


def _read_places(file: Path) -> Array:
    places = []
    for number, words in read_rows(file):
        try:
            place = [float(word) for word in words]
        except ValueError:
            place = []
        if len(place) != 3 or not np.isfinite(place).all():
            raise DataError(file, f"line {number} needs: x y z.")
        places.append(place)
    if not places:
        raise DataError(file, "has no places; lines are: x y z.")
    return np.array(places)


def _printed(points: Array, normals: Array, diameter: float, rng: np.random.Generator) -> Marks:
    axes = [_axes(normal, rng.uniform(0, 2 * np.pi)) for normal in normals]
    prints = [_print(rng) for _ in points]
    side = PRINT_CELLS * CELL_TEXELS
    return Marks(
        centers=points.reshape(-1, 3),
        axes=np.array(axes, np.float64).reshape(-1, 3, 3),
        radius=0.5 * diameter,
        print_atlas=np.concatenate([np.zeros((side, 0), np.float32), *prints], axis=1),
    )


def _on_surface(mesh: Mesh, rng: np.random.Generator) -> tuple[Array, Array]:
    """Random points of a mesh, evenly by area, with their normals."""
    corners = mesh.vertices[mesh.triangles]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    chosen = rng.choice(len(area), size=CANDIDATES, p=area / area.sum())
    first, second = rng.uniform(size=(2, CANDIDATES, 1))
    root = np.sqrt(first)
    weights = np.concatenate([1 - root, root * (1 - second), root * second], axis=1)
    points = np.einsum("nk,nkd->nd", weights, corners[chosen])
    normals = np.einsum("nk,nkd->nd", weights, mesh.normals[mesh.triangles[chosen]])
    return points, unit(normals)


def _fits(mesh: Mesh, points: Array, normals: Array, radius: float) -> NDArray[np.bool_]:
    """Where the surface is flat enough about a mark."""
    angle = np.linspace(0, 2 * np.pi, EDGE_POINTS, endpoint=False)
    x, y, _ = (axis[:, None, :] for axis in np.moveaxis(_axes(normals, 0.0), -2, 0))
    circle = FLAT_RADIUS * radius * np.stack([np.cos(angle), np.sin(angle)])[..., None]
    edge = points[:, None] + circle[0] * x + circle[1] * y
    surface = RayScene(TriangleMesh.of(mesh))
    closest = surface.closest(edge.reshape(-1, 3))[0].reshape(edge.shape)
    gap = np.linalg.norm(closest - edge, axis=-1).max(axis=1)
    return np.asarray(gap <= MAX_GAP * radius)


def _spread(points: Array, normals: Array, number: int, seed: int) -> list[int]:
    """Indices of points in the middle of parts of equal spread (k-means), normals counted as well.

    The distance of a mark from an edge is then about half of its distance to the next mark.
    Farthest points would lie at edges and corners, where a print breaks the outline.
    """
    number = min(number, len(points))
    if not number:
        return []
    size = float(np.ptp(points, axis=0).max())
    places = np.concatenate([points / size, 0.15 * normals], axis=1)
    middles, _ = kmeans2(places, number, iter=KMEANS_ITERATIONS, minit="++", rng=seed)
    return [int(index) for index in cKDTree(places).query(middles)[1]]


def _axes(normals: Array, turn: float) -> Array:
    """Axes (..., 3, 3) of prints on a surface, a row each, from its normals (..., 3)."""
    side = np.eye(3)[np.abs(normals).argmin(axis=-1)]
    x = unit(side - (side * normals).sum(axis=-1, keepdims=True) * normals)
    y = np.cross(normals, x)
    cos, sin = np.cos(turn), np.sin(turn)
    return np.stack([cos * x + sin * y, cos * y - sin * x, normals], axis=-2)


def _print(rng: np.random.Generator) -> NDArray[np.float32]:
    """A random pattern of cells in a light border."""
    cells = rng.choice([0.05, 0.3, 0.6, 0.85], size=(PRINT_CELLS, PRINT_CELLS))
    return np.asarray(np.kron(cells, np.ones((CELL_TEXELS, CELL_TEXELS))), np.float32)
