"""Named shapes as triangle meshes with their exact normals, for simulated captures.

They stand on the plane z = 0, centred over the origin, with their largest side of unit length.
Curved shapes have enough segments for triangles within ``MAX_SAG`` of the surface.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.geometry import unit, unit_or_zero
from polmvs.io.clouds import Mesh

Triangles = NDArray[np.int32]

MAX_SAG = 5e-5  # of the largest side: 10 um at 0.2 m, half a step of the stored depth
KNOT_SEGMENTS = 1024


def shape_names() -> tuple[str, ...]:
    """Names of all shapes."""
    return tuple(_SHAPES)


def named_shape(name: str) -> Mesh:
    """A shape by its name.

    Raises
    ------
    KeyError
        There is no shape of that name.
    """
    mesh = _SHAPES[name]()
    low, high = mesh.vertices.min(axis=0), mesh.vertices.max(axis=0)
    origin = np.array([*(0.5 * (low + high))[:2], low[2]])
    return Mesh((mesh.vertices - origin) / (high - low).max(), mesh.normals, mesh.triangles)


def _plane() -> Mesh:
    """A slab of 4:3 with a low edge."""
    return _box((0.0, 0.0, 0.0), (1.0, 0.75, 0.02))


def _sphere() -> Mesh:
    return _ellipsoid((0.5, 0.5, 0.5))


def _ellipsoid(axes: tuple[float, float, float] = (0.5, 0.4, 0.3)) -> Mesh:
    num = _segments(0.5)
    mesh = _surface(
        lambda u, v: np.stack(
            [
                np.sin(np.pi * v) * np.cos(2 * np.pi * u),
                np.sin(np.pi * v) * np.sin(2 * np.pi * u),
                -np.cos(np.pi * v),
            ],
            axis=-1,
        ),
        num,
        num // 2,
    )
    return Mesh(mesh.vertices * axes, unit(mesh.vertices / axes), mesh.triangles)


def _dome() -> Mesh:
    """Half an ellipsoid, with its base."""
    num = _segments(0.5)
    axes = np.array([0.5, 0.425, 0.275])

    def place(u: Array, v: Array) -> Array:
        up = 0.5 * np.pi * v
        around = np.stack([np.cos(2 * np.pi * u), np.sin(2 * np.pi * u), np.zeros_like(u)], axis=-1)
        rising = np.sin(up)[..., None] * np.array([0.0, 0.0, 1.0])
        return np.asarray(np.cos(up)[..., None] * around + rising)

    shell = _surface(place, num, num // 4)
    curved = Mesh(shell.vertices * axes, unit(shell.vertices / axes), shell.triangles)
    return _joined([curved, _disc(curved.vertices[: num + 1])])


def _box_on_plate() -> Mesh:
    plate = _box((-0.5, -0.4, 0.0), (0.5, 0.4, 0.06))
    return _joined([plate, _box((-0.22, -0.16, 0.06), (0.22, 0.16, 0.26))])


def _mug() -> Mesh:
    """A mug with a wall, a rounded lip and a handle."""
    outer, wall, height, base = 0.36, 0.035, 0.78, 0.05
    lip = np.linspace(0.0, np.pi, 49)
    radius = 0.5 * wall
    middle = outer - radius
    profile = [(0.0, 0.0), (outer - 0.03, 0.0)]
    foot = np.linspace(-0.5 * np.pi, 0.0, 33)
    profile += [(outer - 0.03 + 0.03 * math.cos(a), 0.03 + 0.03 * math.sin(a)) for a in foot]
    profile += [(outer, z) for z in np.linspace(0.05, height - radius, 12)]
    profile += [
        (middle + radius * math.cos(a), height - radius + radius * math.sin(a)) for a in lip
    ]
    inner, floor_round = outer - wall, 0.06
    profile += [(inner, z) for z in np.linspace(height - radius, base + floor_round, 12)]
    turn = np.linspace(0.0, -0.5 * np.pi, 33)
    profile += [
        (inner - floor_round + floor_round * math.cos(a), base + floor_round * (1 + math.sin(a)))
        for a in turn
    ]
    profile.append((0.0, base))
    body = _lathe(np.array(profile), _segments(outer))
    # The handle's ends lie within the wall.
    along = np.linspace(-0.62 * np.pi, 0.62 * np.pi, 97)
    center = np.array([outer + 0.03, 0.0, 0.42])
    path = center + np.stack(
        [0.2 * np.cos(along), np.zeros_like(along), 0.24 * np.sin(along)], axis=1
    )
    tangents = unit(np.stack([-0.2 * np.sin(along), 0 * along, 0.24 * np.cos(along)], axis=1))
    sides = np.broadcast_to([0.0, 1.0, 0.0], path.shape)
    handle = _tube(path, tangents, sides, 0.045)
    return _joined([body, handle])


def _knot() -> Mesh:
    """A trefoil knot, lying."""
    t = np.linspace(0.0, 2 * np.pi, KNOT_SEGMENTS + 1)
    path = np.stack(
        [np.sin(t) + 2 * np.sin(2 * t), np.cos(t) - 2 * np.cos(2 * t), -np.sin(3 * t)], axis=1
    )
    tangents = unit(
        np.stack(
            [np.cos(t) + 4 * np.cos(2 * t), -np.sin(t) + 4 * np.sin(2 * t), -3 * np.cos(3 * t)],
            axis=1,
        )
    )
    return _tube(path, tangents, _carried(tangents), 0.62)


def _vase() -> Mesh:
    """A closed body of revolution with convex and concave parts."""
    height = np.linspace(0.0, 1.0, 257)
    radius = 0.24 + 0.1 * np.sin(2 * np.pi * (0.15 + 0.85 * height)) * (1 - 0.35 * height)
    profile = np.stack([radius, height], axis=1)
    return _lathe(np.concatenate([[[0.0, 0.0]], profile, [[0.0, 1.0]]]), _segments(0.34))


_SHAPES: dict[str, Callable[[], Mesh]] = {
    "plane": _plane,
    "sphere": _sphere,
    "ellipsoid": _ellipsoid,
    "dome": _dome,
    "box": _box_on_plate,
    "mug": _mug,
    "vase": _vase,
    "knot": _knot,
}


def _segments(radius: float) -> int:
    """Segments of a circle whose chords lie within ``MAX_SAG`` of it; a multiple of four."""
    return 4 * math.ceil(math.pi / math.acos(1 - MAX_SAG / radius) / 4)


def grid_triangles(rows: int, cols: int) -> Triangles:
    """Triangles of a grid of (rows + 1) x (cols + 1) vertices."""
    index = np.arange((rows + 1) * (cols + 1)).reshape(rows + 1, cols + 1)
    a, b = index[:-1, :-1].ravel(), index[:-1, 1:].ravel()
    c, d = index[1:, 1:].ravel(), index[1:, :-1].ravel()
    return np.concatenate([np.stack([a, b, c], 1), np.stack([a, c, d], 1)]).astype(np.int32)


def _surface(place: Callable[[Array, Array], Array], across: int, up: int) -> Mesh:
    """Points ``place(u, v)`` of a grid over the unit square, without normals."""
    v, u = np.meshgrid(np.linspace(0, 1, up + 1), np.linspace(0, 1, across + 1), indexing="ij")
    points = place(u, v).reshape(-1, 3)
    return Mesh(points, np.zeros_like(points), _without_slivers(points, grid_triangles(up, across)))


def _without_slivers(points: Array, triangles: Triangles) -> Triangles:
    """Triangles that have an area: those at poles have none."""
    a, b, c = (points[triangles[:, k]] for k in range(3))
    area = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return np.asarray(triangles[area > 1e-12])


def _lathe(profile: Array, segments: int) -> Mesh:
    """Body of revolution of a profile (radius, height) with the material on its left.

    Corners of the profile sharper than 30 degrees stay sharp.
    """
    kept = np.linalg.norm(np.diff(profile, axis=0), axis=1) > 1e-9
    profile = profile[np.concatenate([[True], kept])]
    pieces = []
    start = 0
    directions = unit_or_zero(
        np.column_stack([np.diff(profile, axis=0), np.zeros(len(profile) - 1)])
    )
    bends = (directions[:-1] * directions[1:]).sum(axis=1)
    cuts = [*(np.flatnonzero(bends < math.cos(math.radians(30))) + 1), len(profile) - 1]
    for cut in cuts:
        part = profile[start : cut + 1]
        # By length: where a line meets an arc, the line's direction is the tangent.
        slope = np.diff(part, axis=0)
        mean = np.concatenate([slope[:1], slope[:-1] + slope[1:], slope[-1:]])
        pieces.append(_lathe_smooth(part, mean, segments))
        start = cut
    return _joined(pieces)


def _lathe_smooth(profile: Array, slope: Array, segments: int) -> Mesh:
    angle = np.linspace(0.0, 2 * np.pi, segments + 1)
    radius, height = profile[:, :1], profile[:, 1:]
    points = np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), height + 0 * angle], axis=-1
    ).reshape(-1, 3)
    outwards, up = slope[:, 1:], -slope[:, :1]
    normals = unit(
        np.stack([outwards * np.cos(angle), outwards * np.sin(angle), up + 0 * angle], axis=-1)
    ).reshape(-1, 3)
    triangles = grid_triangles(len(profile) - 1, segments)
    return Mesh(points, normals, _without_slivers(points, triangles))


def _disc(border: Array) -> Mesh:
    """The base of a body whose border (N, 3) lies in the plane z = 0, seen from below."""
    points = np.concatenate([[[0.0, 0.0, 0.0]], border])
    index = np.arange(1, len(border))
    triangles = np.stack([0 * index, index + 1, index], axis=1).astype(np.int32)
    normals = np.broadcast_to([0.0, 0.0, -1.0], points.shape).copy()
    return Mesh(points, normals, triangles)


def _tube(path: Array, tangents: Array, sides: Array, radius: float) -> Mesh:
    """A round tube about a path (N, 3); ``sides`` are unit and across the tangents."""
    num = 96
    angle = np.linspace(0.0, 2 * np.pi, num + 1)[:, None]
    across = np.cross(tangents, sides)
    normals = np.cos(angle) * sides[:, None] + np.sin(angle) * across[:, None]
    points = path[:, None] + radius * normals
    triangles = grid_triangles(len(path) - 1, num)
    return Mesh(points.reshape(-1, 3), normals.reshape(-1, 3), triangles)


def _carried(tangents: Array) -> Array:
    """Sides (N, 3) across the tangents of a closed path, turning as little as they can."""
    sides = np.empty_like(tangents)
    side = unit(np.cross(tangents[0], [0.0, 0.0, 1.0]))
    for index, tangent in enumerate(tangents):
        side = unit(side - (side @ tangent) * tangent)
        sides[index] = side
    # What is left of a turn at the end is spread over the whole path.
    across = np.cross(tangents[-1], sides[-1])
    twist = math.atan2(float(sides[0] @ across), float(sides[0] @ sides[-1]))
    share = (twist * np.linspace(0, 1, len(tangents)))[:, None]
    return np.asarray(np.cos(share) * sides + np.sin(share) * np.cross(tangents, sides))


def _box(low: tuple[float, float, float], high: tuple[float, float, float]) -> Mesh:
    """A box with sharp edges, its faces in squares small enough for the light on them to vary."""
    low_, high_ = np.array(low), np.array(high)
    faces = []
    for axis in range(3):
        first, second = (axis + 1) % 3, (axis + 2) % 3
        for side in (0, 1):
            counts = [max(1, math.ceil((high_ - low_)[k] / 0.02)) for k in (first, second)]
            v, u = np.meshgrid(
                np.linspace(low_[second], high_[second], counts[1] + 1),
                np.linspace(low_[first], high_[first], counts[0] + 1),
                indexing="ij",
            )
            points = np.empty((u.size, 3))
            points[:, first], points[:, second] = u.ravel(), v.ravel()
            points[:, axis] = high_[axis] if side else low_[axis]
            normal = np.zeros(3)
            normal[axis] = 1.0 if side else -1.0
            triangles = grid_triangles(counts[1], counts[0])
            if not side:
                triangles = triangles[:, ::-1].copy()
            faces.append(Mesh(points, np.broadcast_to(normal, points.shape).copy(), triangles))
    return _joined(faces)


def _joined(meshes: list[Mesh]) -> Mesh:
    """Several meshes as one."""
    starts = np.cumsum([0] + [len(mesh.vertices) for mesh in meshes[:-1]])
    return Mesh(
        np.concatenate([mesh.vertices for mesh in meshes]),
        np.concatenate([mesh.normals for mesh in meshes]),
        np.concatenate([m.triangles + s for m, s in zip(meshes, starts, strict=True)]).astype(
            np.int32
        ),
    )
