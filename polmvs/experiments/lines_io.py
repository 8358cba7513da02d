"""Contours as PLY line sets (vertices and edges), which Open3D, MeshLab and Blender open."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from polmvs.experiments.contours import Lines

MAX_STRIDE = 4  # points of a contour between two vertices of the file


def line_set_bytes(lines: Sequence[Lines], *, stride: int = MAX_STRIDE) -> bytes:
    """A binary PLY of contours; neighbours on a curve are joined.

    Parameters
    ----------
    lines : of any number of views, true world, metres.
    stride : every how many-th point of a curve is kept.

    Returns
    -------
    Vertices with ``height_mm``, the signed distance to the true surface; edges between them.
    """
    vertex = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("height_mm", "<f4")])
    points, curves, heights, offset = [], [], [], 0
    for line in lines:
        points.append(line.points[::stride])
        heights.append(line.heights[::stride])
        curves.append(line.curve[::stride] + offset)
        offset += int(line.curve.max(initial=-1)) + 1
    vertices = np.zeros(sum(map(len, points)), vertex)
    if len(vertices):
        place = np.concatenate(points)
        vertices["x"], vertices["y"], vertices["z"] = place.T
        vertices["height_mm"] = 1e3 * np.concatenate(heights)
    curve = np.concatenate(curves) if curves else np.zeros(0, np.int64)
    tails = np.flatnonzero(curve[1:] == curve[:-1])
    edges = np.stack([tails, tails + 1], axis=-1).astype("<i4")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment contours in the world of the ground truth, metres",
        f"element vertex {len(vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        "property float height_mm",
        f"element edge {len(edges)}",
        "property int vertex1",
        "property int vertex2",
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + edges.tobytes()
