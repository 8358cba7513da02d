"""Surroundings of the object: a table with printed clutter, or a calibration board.

SfM needs static features around a part that has none. Without a varnish everything here is matte:
its light is unpolarized and the same in all directions.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Image
from polmvs.geometry import unit
from polmvs.io.clouds import Mesh
from polmvs.simulation.options import Scenery, SceneryOptions
from polmvs.synthetic.printed import random_print
from polmvs.synthetic.shapes import grid_triangles

# All lengths in sizes of the object.
TABLE_SIDE = 5.0
TURNTABLE_RADIUS = 1.3
TABLE_CELLS = 96  # along a side; those in the middle are four times as narrow as at the border
NUM_BLOCKS = 9
BLOCK_RING = (0.78, 1.3)
PRINT_SIDE = 2048  # texels of the table's print: 2.4 mm of an object of a metre
BLOCK_PRINT_SIDE = 256
NUM_WAVES = 24
WAVE_LENGTHS = (0.4, 1.2)
WAVES_RISE = 0.3
BOARD_MARKERS = 15  # along each side; 225 of the 250 of the dictionary
BOARD_TEXELS = 2250
MARKER_SHARE = 0.72  # of a cell: 108 of 150 texels
WHITE, BLACK = 0.8, 0.04  # albedo of paper and ink


@dataclass(frozen=True, kw_only=True, eq=False)
class Surrounding:
    """A printed surface.

    Attributes
    ----------
    mesh : metres, world; fine enough for linear interpolation of the light in its triangles.
    uv : (V, 2) float32, texture coordinates of the vertices, 0 to 1, v downwards.
    print : (H, W) float32, albedo.
    """

    mesh: Mesh
    uv: NDArray[np.float32]
    print: Image


def surroundings(
    options: SceneryOptions, size: float, radius: float, seed: int
) -> list[Surrounding]:
    """Surroundings of an object on the plane z = 0.

    Parameters
    ----------
    size : largest side of the object, metres.
    radius : of the circle about the origin that contains the object, metres.
    seed : of the prints and positions.
    """
    if options.surroundings is Scenery.NOTHING:
        return []
    rng = np.random.default_rng(seed)
    waves = _Waves.random(options.relief * size, size, radius, seed)
    table = waves.lifted(_table(size, rng, round_=options.turntable))
    if options.surroundings is Scenery.BOARD:
        return [replace(table, print=_marker_board())]
    return [table, *_blocks(size, radius, rng, options, waves)]


@dataclass(frozen=True, kw_only=True, eq=False)
class _Waves:
    """Relief of the table: plane waves of random directions, flat under the object.

    Attributes
    ----------
    numbers : (N, 2), angular wave numbers, rad per metre.
    phases : (N,), rad.
    amplitude : of each, metres.
    flat, full : distances from the origin up to which the table is flat, and from which the waves
        have their full height, metres.
    """

    numbers: Array
    phases: Array
    amplitude: float
    flat: float
    full: float

    @staticmethod
    def random(relief: float, size: float, radius: float, seed: int) -> _Waves:
        """Waves with a root mean square height."""
        rng = np.random.default_rng((seed, 1))  # the prints of a seed are the same with relief
        azimuth, phases = rng.uniform(0, 2 * np.pi, (2, NUM_WAVES))
        length = size * rng.uniform(*WAVE_LENGTHS, NUM_WAVES)
        directions = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
        return _Waves(
            numbers=2 * np.pi / length[:, None] * directions,
            phases=phases,
            amplitude=relief * math.sqrt(2 / NUM_WAVES),
            flat=radius,
            full=radius + WAVES_RISE * size,
        )

    def heights(self, places: Array) -> Array:
        """Heights ``(...)`` at places ``(..., 2)``."""
        share = (np.linalg.norm(places, axis=-1) - self.flat) / (self.full - self.flat)
        share = np.clip(share, 0, 1)
        waves = np.cos(places @ self.numbers.T + self.phases).sum(axis=-1)
        return np.asarray(self.amplitude * share**2 * (3 - 2 * share) * waves)

    def lifted(self, flat: Surrounding) -> Surrounding:
        """A flat table with these waves."""
        if self.amplitude == 0:
            return flat
        places, step = flat.mesh.vertices[:, :2], 1e-3 * self.full
        slopes = [
            (self.heights(places + along) - self.heights(places - along)) / (2 * step)
            for along in step * np.eye(2)
        ]
        vertices = np.column_stack([places, self.heights(places)])
        normals = unit(np.column_stack([-slopes[0], -slopes[1], np.ones(len(places))]))
        return replace(flat, mesh=Mesh(vertices, normals, flat.mesh.triangles))


def _marker_board() -> Image:
    """A square grid of ArUco markers (DICT_4X4_250), black on white paper, all different."""
    dictionary = cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_250)
    cell = BOARD_TEXELS // BOARD_MARKERS
    side = round(cell * MARKER_SHARE / 6) * 6  # 4 bits and the border
    margin = (cell - side) // 2
    board = np.full((BOARD_TEXELS, BOARD_TEXELS), WHITE, np.float32)
    for index in range(BOARD_MARKERS**2):
        drawn = cv2.aruco.generateImageMarker(dictionary, index, side)
        row, col = divmod(index, BOARD_MARKERS)
        top, left = row * cell + margin, col * cell + margin
        board[top : top + side, left : left + side] = np.where(drawn > 0, WHITE, BLACK)
    return board


@lru_cache(maxsize=16)  # several captures of a process have the same
def _print(side: int, seed: int) -> Image:
    return random_print(side, np.random.default_rng(seed))


def _table(size: float, rng: np.random.Generator, *, round_: bool) -> Surrounding:
    steps = np.linspace(-1, 1, TABLE_CELLS + 1)
    places = np.sinh(2 * steps) / np.sinh(2)
    if round_:  # rays from the middle, so that the border is a circle
        angle = np.linspace(0, 2 * np.pi, 2 * TABLE_CELLS + 1)
        radius = np.linspace(0, 1, TABLE_CELLS // 2 + 1)
        unit_xy = radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
        half = TURNTABLE_RADIUS * size
        rows, cols = TABLE_CELLS // 2, 2 * TABLE_CELLS
    else:
        unit_xy = np.stack(np.meshgrid(places, places), axis=-1)
        half = 0.5 * TABLE_SIDE * size
        rows = cols = TABLE_CELLS
    unit_xy = unit_xy.reshape(-1, 2)
    points = np.column_stack([half * unit_xy, np.zeros(len(unit_xy))])
    triangles = grid_triangles(rows, cols)
    if round_:
        triangles = triangles[:, ::-1]
    normals = np.broadcast_to([0.0, 0.0, 1.0], points.shape).copy()
    # The print's texels are of one size whatever the table's.
    share = half / (0.5 * TABLE_SIDE * size)
    uv = 0.5 + 0.5 * share * unit_xy
    mesh = Mesh(points, normals, np.ascontiguousarray(triangles))
    return Surrounding(
        mesh=mesh, uv=uv.astype(np.float32), print=_print(PRINT_SIDE, int(rng.integers(1 << 31)))
    )


def _blocks(
    size: float,
    radius: float,
    rng: np.random.Generator,
    options: SceneryOptions,
    waves: _Waves,
) -> list[Surrounding]:
    """Printed boxes in a ring about the object, which they do not touch."""
    found = []
    for index in range(NUM_BLOCKS):
        sides = size * rng.uniform([0.14, 0.12, 0.06], [0.3, 0.24, 0.26])
        turn = rng.uniform(0, np.pi)
        azimuth = 2 * np.pi * (index + rng.uniform(-0.25, 0.25)) / NUM_BLOCKS
        nearest = radius + 0.5 * float(np.hypot(*sides[:2]))
        low, high = BLOCK_RING
        if options.turntable:
            high = TURNTABLE_RADIUS - 0.2
        away = max(nearest + 0.05 * size, size * rng.uniform(low, high))
        place = away * np.array([math.cos(azimuth), math.sin(azimuth)])
        center = np.append(place, waves.heights(place))
        found.append(
            _block(sides, turn, center, _print(BLOCK_PRINT_SIDE, int(rng.integers(1 << 31))))
        )
    return found


def _block(sides: Array, turn: float, center: Array, texture: Image) -> Surrounding:
    """A box that stands on the table; its faces share one print, each a part of it."""
    half = 0.5 * sides
    cells = 6
    points: list[Array] = []
    normals: list[Array] = []
    uvs: list[Array] = []
    triangles: list[NDArray[np.int32]] = []
    steps = np.linspace(-1, 1, cells + 1)
    grid = np.stack(np.meshgrid(steps, steps), axis=-1).reshape(-1, 2)
    quad = grid_triangles(cells, cells)
    rotation = np.array(
        [[math.cos(turn), -math.sin(turn), 0], [math.sin(turn), math.cos(turn), 0], [0, 0, 1]]
    )
    longest = float(sides.max())
    for face, (first, second, outwards) in enumerate(
        (
            ([1, 0, 0], [0, 1, 0], [0, 0, 1]),
            ([0, 1, 0], [0, 0, 1], [1, 0, 0]),
            ([0, 0, 1], [0, 1, 0], [-1, 0, 0]),
            ([0, 0, 1], [1, 0, 0], [0, 1, 0]),
            ([1, 0, 0], [0, 0, 1], [0, -1, 0]),
        )
    ):
        local = (grid @ np.array([first, second]) + outwards) * half
        start = len(points) * len(grid)
        points.append(local @ rotation.T + center + [0, 0, half[2]])
        normals.append(np.broadcast_to(rotation @ np.array(outwards, np.float64), local.shape))
        extent = np.array([np.abs(first) @ sides, np.abs(second) @ sides]) / longest / 3
        corner = np.array([face % 3, face // 3]) / 3
        uvs.append(corner + (0.5 * grid + 0.5) * extent)
        triangles.append(quad + start)
    mesh = Mesh(np.concatenate(points), unit(np.concatenate(normals)), np.concatenate(triangles))
    return Surrounding(mesh=mesh, uv=np.concatenate(uvs).astype(np.float32), print=texture)
