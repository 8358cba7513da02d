"""Compare a dense cloud with the planes that sparse points show: a check without ground truth.

    python pipelines/planes.py SPARSE CLOUD

Prints for each of the largest planes: how much of it the cloud covers, the distance of the cloud
in per cent of the plane's size, and the angle between its normals and the plane's.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.colmap.models import read_model
from polmvs.config import OptionGroup, option
from polmvs.errors import DataError
from polmvs.geometry import dots, lengths
from polmvs.io.clouds import Cloud, read_cloud
from polmvs.scene import PointKind
from polmvs.surface.ground import largest_plane

Array = NDArray[np.float64]

NUM_TRIALS = 3000
THICKNESS = 0.01  # of a plane, share of the median distance of the points from their middle
NUM_NEAR = 5  # neighbours; points whose spacing is twice the usual one are beside the plane
MAX_OFFSET = 0.05  # of the cloud from a plane, share of its size: other things are farther


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    sparse: Path = option(MISSING, "COLMAP model", positional=True)
    cloud: Path = option(MISSING, "dense cloud of the same frame (PLY)", positional=True)
    num: int = option(3, "number of planes", least=1)


def planes(points: Array, num: int) -> Iterator[Array]:
    """Points (N, 3) of each of the largest planes of a cloud; each point belongs to one."""
    limit = THICKNESS * float(np.median(lengths(points - np.median(points, axis=0))))
    for _ in range(num):
        found = largest_plane(points, limit, num_trials=NUM_TRIALS)
        if found is None:
            return
        _, _, inliers = found
        if inliers.sum() <= NUM_NEAR:
            return
        yield points[inliers]
        points = points[~inliers]


def compared(members: Array, cloud: Cloud) -> dict[str, float]:
    """The part of a cloud that lies along the members (N, 3) of a plane."""
    middle = members.mean(axis=0)
    x, y, normal = np.linalg.svd(members - middle, full_matrices=False)[2]
    along = np.stack([x, y], axis=1)
    flat = (members - middle) @ along
    spacing = cKDTree(flat).query(flat, k=NUM_NEAR + 1)[0][:, -1]
    reach = 2 * float(np.median(spacing))
    core = flat[spacing < reach]
    size = float(np.linalg.norm(np.ptp(core, axis=0)))
    offset = (cloud.points - middle) @ normal
    places = (cloud.points - middle) @ along
    near = np.abs(offset) < MAX_OFFSET * size
    near[near] = np.isfinite(cKDTree(core).query(places[near], distance_upper_bound=reach)[0])
    found = {"sparse points": float(len(members)), "points": float(near.sum())}
    if near.any() and cloud.normals is not None:
        covered = np.isfinite(cKDTree(places[near]).query(core, distance_upper_bound=reach)[0])
        cosine = np.abs(dots(cloud.normals[near], np.broadcast_to(normal, (int(near.sum()), 3))))
        angle = np.degrees(np.arccos(np.clip(cosine, 0, 1)))
        found |= {
            "covered, %": 100 * float(covered.mean()),
            "distance, median, % of the size": 100 * float(np.median(np.abs(offset[near]))) / size,
            "normals, median, deg": float(np.median(angle)),
        }
    return found


def _planes(call: Call, terminal: Terminal) -> int:
    given = call.get(Arguments)
    points = read_model(given.sparse).tracks.points_in_world
    cloud = read_cloud(given.cloud)
    if "kind" in cloud.scalars:
        cloud = cloud.only(cloud.scalars["kind"] == PointKind.SURFACE)
    rows = [compared(members, cloud) for members in planes(points, given.num)]
    if not rows:
        raise DataError(given.sparse, "has no plane with enough sparse points.")
    text = "\n".join(", ".join(f"{k} {v:.3g}" for k, v in row.items()) for row in rows)
    terminal.show(text, {"planes": rows})
    return 0


main = script(__file__, __doc__, _planes, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
