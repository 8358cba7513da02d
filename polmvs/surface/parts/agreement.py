"""Whether views that placed a part each by itself agree, and the place that they have in common."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.scene import Seeds, View
from polmvs.surface.dense_view import extend_planes
from polmvs.surface.parts.outline_range import MIN_COSINE, cosines, points_of
from polmvs.surface.parts.placement import Placement

Array = NDArray[np.float64]

AGREEMENT_SIGMAS = 3.0
MIN_OVERLAP = 8  # points that two views' surfaces share
OVERLAP_GAP_PX = 24.0  # between a view's nodes and another's points, as it sees them
MAX_SEED_NORMAL_SIGMA = 0.05  # rad
MAX_CONTRADICTION = 3.0  # deviations of a track from the place that the outlines give


@dataclass(frozen=True)
class PartReport:
    """What was found about a part without seeds.

    Attributes
    ----------
    view : name of the view that placed it first.
    num_px : pixels of the part in that view.
    num_views : views that show it, at the place found.
    num_agreeing : views that, each by itself, put it at that place.
    doubt : why it has no place; empty if it has one.
    range : of its middle from that view, world units; NaN: none was found.
    sigma : standard deviation along the surface's normal, world units.
    outline_px : median distance of the outlines that are met, px.
    phase_deg : median residual of the phases, degrees.
    """

    view: str
    num_px: int
    num_views: int
    num_agreeing: int
    doubt: str
    range: float
    sigma: float
    outline_px: float
    phase_deg: float


def normal_depth(placement: Placement) -> float:
    """How far a surface moves along its normals per unit of its log-range, world units."""
    surface = placement.surface
    cosine = np.abs((surface.normals * surface.rays_in_world).sum(axis=-1))
    return float(np.median(np.exp(surface.log_range) * cosine)) if len(cosine) else np.nan


def heights_over(placement: Placement, view: View, points: Array, normals: Array) -> Array:
    """Heights (N,) of points (N, 3) over a placed surface that ``view`` sees, along its normals.

    Away from the view is negative; NaN where the view knows no surface and where the points'
    own normals (N, 3) face away: it does not see these.
    """
    to_point = points - placement.center
    distance = np.linalg.norm(to_point, axis=-1)
    xy = view.camera.project(view.cam_from_world * points)
    heights = np.full(len(points), np.nan)
    facing = cosines(view, points, normals) > MIN_COSINE
    seen = np.flatnonzero(np.isfinite(xy).all(axis=-1) & facing)
    if not len(seen) or not len(placement.surface.xy):
        return heights
    rays = to_point[seen] / distance[seen, None]
    here = extend_planes(placement.surface, xy[seen], rays, OVERLAP_GAP_PX)
    cosine = np.abs((rays * here.normals).sum(axis=-1))
    heights[seen] = (np.exp(here.log_range) - distance[seen]) * cosine
    return heights


def _height(placement: Placement, view: View, other: Placement, shift: float = 0.0) -> float:
    """Median height of another surface over one; NaN where the two hardly overlap."""
    points = points_of(other.surface, other.center, shift)
    heights = heights_over(placement, view, points, other.surface.normals)
    heights = heights[np.isfinite(heights)]
    return float(np.median(heights)) if len(heights) >= MIN_OVERLAP else np.nan


def most_agreeing(placements: Sequence[Placement], views: Sequence[View]) -> list[int]:
    """Indices of the largest set of placements that agree with one of them, that one first.

    Agreement is within ``AGREEMENT_SIGMAS`` of both deviations.
    """
    if not placements:
        return []
    sigma = np.array([p.sigma * normal_depth(p) for p in placements])
    heights = np.array(
        [
            [_height(p, view, other) for other in placements]
            for p, view in zip(placements, views, strict=True)
        ]
    )
    np.fill_diagonal(heights, 0.0)
    with np.errstate(invalid="ignore"):
        agree = np.abs(heights) < AGREEMENT_SIGMAS * np.hypot(sigma[:, None], sigma)
    center = int(np.lexsort((sigma, -agree.sum(axis=1)))[0])
    return [center, *(int(i) for i in np.flatnonzero(agree[center]) if i != center)]


def common_place(placements: Sequence[Placement], views: Sequence[View]) -> tuple[Array, float]:
    """Shifts of the log-ranges that take placements that agree to one surface.

    Returns
    -------
    shifts : (P,), of each placement.
    sigma : standard deviation of the common surface along its normals, world units: that of one
        placement and the placements' spread, neither narrowed by their number, because what errs
        in all of them does not average out.
    """
    depth = np.array([normal_depth(p) for p in placements])
    own = np.array([p.sigma for p in placements]) * depth
    heights = np.array([_height(placements[0], views[0], other) for other in placements])
    heights[0] = 0.0
    known = np.isfinite(heights)
    weight = 1 / own[known] ** 2
    mean = float((weight * heights[known]).sum() / weight.sum())
    spread = float(np.sqrt(np.square(heights[known] - mean).sum() / max(known.sum() - 1, 1)))
    # A higher surface is a nearer one.
    first = -mean / depth[0]
    pairs = zip(placements, views, strict=True)
    moves = np.array([_height(p, view, placements[0], first) for p, view in pairs])
    moves[0] = mean
    return -np.nan_to_num(moves) / depth, float(np.hypot(np.median(own), spread))


def shared_seeds(
    placements: Sequence[Placement],
    views: Sequence[View],
    shifts: Array,
    sigma: float,
    count: int,
) -> Seeds:
    """About ``count`` seeds, evenly spread over the surfaces where these coincide.

    Parameters
    ----------
    placements, views, shifts, sigma : from :func:`common_place`.
    count : of all placements together.
    """
    moved = [
        replace(p, surface=replace(p.surface, log_range=p.surface.log_range + shift))
        for p, shift in zip(placements, shifts, strict=True)
    ]
    each = -(-count // len(moved))
    chosen = []
    for index, placement in enumerate(moved):
        surface = placement.surface
        points = points_of(surface, placement.center)
        others = [i for i in range(len(moved)) if i != index]
        heights = np.abs(
            [heights_over(moved[i], views[i], points, surface.normals) for i in others]
        )
        overlap = np.isfinite(heights).sum(axis=0)
        near = (heights < AGREEMENT_SIGMAS * sigma).sum(axis=0)
        sure = (surface.normal_sigma < MAX_SEED_NORMAL_SIGMA) & (2 * near > overlap)
        good = np.flatnonzero(sure)
        some = good[np.unique(np.linspace(0, len(good) - 1, min(each, len(good))).astype(int))]
        chosen.append(Seeds(points[some], surface.normals[some], np.full(len(some), sigma)))
    return join_seeds(chosen)


def join_seeds(parts: Sequence[Seeds]) -> Seeds:
    """All seeds of several."""
    return Seeds(
        np.concatenate([np.zeros((0, 3)), *(part.points_in_world for part in parts)]),
        np.concatenate([np.zeros((0, 3)), *(part.normals_in_world for part in parts)]),
        np.concatenate([np.zeros(0), *(part.sigma for part in parts)]),
    )


def contradicted(seeds: Seeds, part_seeds: Seeds) -> NDArray[np.bool_]:
    """Which seeds (S,) lie off a surface that the outlines placed, by more than its deviation.

    Parameters
    ----------
    seeds : of tracks.
    part_seeds : from :func:`polmvs.surface.parts.pieces.find_part_seeds`; a seed is held against
    the nearest
        one if it lies over or under the part and not beside it.
    """
    if not len(part_seeds.sigma) or not len(seeds.sigma):
        return np.zeros(len(seeds.sigma), np.bool_)
    tree = cKDTree(part_seeds.points_in_world)
    near = tree.query(seeds.points_in_world)[1]
    offset = seeds.points_in_world - part_seeds.points_in_world[near]
    height = np.abs((offset * part_seeds.normals_in_world[near]).sum(axis=-1))
    beside = np.sqrt(np.maximum((offset**2).sum(axis=-1) - height**2, 0))
    k = min(2, len(part_seeds.sigma))
    spacing = np.median(tree.query(part_seeds.points_in_world, k=k)[0][..., -1])
    spread = np.hypot(part_seeds.sigma[near], seeds.sigma)
    return np.asarray((height > MAX_CONTRADICTION * spread) & (beside < 2 * spacing))
