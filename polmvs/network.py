"""The network of a view's contours: nodes, the edges between them, and the seeds tied to them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.camera import sample_image
from polmvs.config import Contour, Model, PropagationOptions
from polmvs.contour import Contours
from polmvs.normals import NormalEstimate
from polmvs.phasemap import PhaseMap
from polmvs.surface import Edges, SeedTies, log_range_increment, slope_sigma
from polmvs.tracks import Seeds

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.float32]

NORMAL_SIGMA_FLOOR = 0.012  # rad; systematic error of multi-view normals
MAX_SEED_DISTANCE_PX = 12.0  # from a seed to the nodes it is tied to
NUM_TIES = 4
MIN_SEED_COSINE = 0.995  # 5.7 deg between the normals of a seed and of a node it is tied to
MIN_CREASE_ANGLE = 0.03  # rad, between neighbouring normals
CREASE_FACTOR = 4.0  # a crease turns the normal this much more than noise or local curvature
NUM_NEIGHBORS = 6


@dataclass(frozen=True)
class Nodes:
    """Nodes of one view's contour network and what is known about them.

    Attributes
    ----------
    xy : (N, 2), image coordinates.
    rays_in_world : (N, 3), unit; ray_z : (N,), their z component in the camera frame.
    tail, head : (E,) indices of the nodes that an edge joins.
    on_contour : (E,) bool, edges between consecutive nodes of a contour.
    log_range : (N,), logarithm of the distance from the camera centre; NaN where unknown.
    normals : (N, 3), unit, world; normal_sigma : (N,), their deviation, rad.
    """

    xy: Image
    rays_in_world: NDArray[np.float32]
    ray_z: NDArray[np.float32]
    tail: Indices
    head: Indices
    on_contour: NDArray[np.bool_]
    log_range: Array
    normals: Array
    normal_sigma: Array


def visible_seeds(phase_map: PhaseMap, seeds: Seeds) -> tuple[NDArray[np.bool_], Array]:
    """Which seeds project into the view's region facing it, and where."""
    in_cam = phase_map.view.cam_from_world * seeds.points_in_world
    xy = phase_map.view.camera.project(in_cam)
    to_point = seeds.points_in_world - phase_map.view.center_in_world
    facing = (to_point * seeds.normals_in_world).sum(-1) < -0.1 * np.linalg.norm(to_point, axis=-1)
    known = np.isfinite(seeds.normals_in_world).all(axis=-1)
    return phase_map.shows_surface(xy) & (facing | ~known), np.asarray(xy, np.float64)


def connect(
    contours: Contours, phase_map: PhaseMap, spacing_px: float
) -> tuple[Indices, Indices, NDArray[np.bool_]]:
    """Edges between consecutive nodes of a curve and between neighbouring nodes of all curves."""
    xy = contours.xy
    num = len(xy)
    follows = contours.curve[1:] == contours.curve[:-1]
    along = np.stack([np.flatnonzero(follows), np.flatnonzero(follows) + 1], axis=1)
    k = min(NUM_NEIGHBORS + 1, num)
    distance, index = cKDTree(xy).query(xy, k=k, distance_upper_bound=2.2 * spacing_px)
    tails = np.repeat(np.arange(num), k)
    heads, near = index.reshape(-1), distance.reshape(-1)
    cross = (heads < num) & (heads != tails) & (near > 0)
    pairs = np.unique(np.sort(np.stack([tails[cross], heads[cross]], axis=1), axis=1), axis=0)
    is_along = np.isin(pairs[:, 0] * num + pairs[:, 1], along[:, 0] * num + along[:, 1])
    pairs = np.concatenate([along, pairs[~is_along]])
    on_contour = np.arange(len(pairs)) < len(along)
    # An edge may not cross a crease or leave the region.
    open_pixels = (phase_map.region.inside & ~phase_map.region.edges).astype(np.float32)
    clear = np.ones(len(pairs), bool)
    for share in (0.25, 0.5, 0.75):
        between = (1 - share) * xy[pairs[:, 0]] + share * xy[pairs[:, 1]]
        clear &= sample_image(open_pixels, between, nearest=True) > 0
    return pairs[clear, 0], pairs[clear, 1], on_contour[clear]


def bending_modes(xy: Image) -> Array:
    """Polynomials of the nodes' place up to the second degree, of order one over the region.

    The errors of multi-view normals that a camera model leaves are smooth over a view: they tilt
    and bend the surface as a whole, which the seeds can tell.
    """
    low, high = xy.min(axis=0), xy.max(axis=0)
    x, y = (2 * (xy - low) / np.maximum(high - low, 1e-9) - 1).T.astype(np.float64)
    legendre = [[np.ones_like(t), t, 1.5 * t**2 - 0.5] for t in (x, y)]
    degrees = [(i, j) for i in range(3) for j in range(3) if 1 <= i + j <= 2]
    return np.stack([legendre[0][i] * legendre[1][j] for i, j in degrees], axis=-1)


def fill_normals(nodes: Nodes, estimate: NormalEstimate) -> tuple[Array, Array]:
    """Normals with the gaps filled from neighbours, which widens their deviation."""
    sigma = np.hypot(np.radians(estimate.sigma_deg), NORMAL_SIGMA_FLOOR)
    good = estimate.valid & (estimate.num_rows >= 3) & (estimate.sigma_deg < 5)
    if not good.any():
        return estimate.normals, sigma
    normals = estimate.normals.copy()
    k = min(8, int(good.sum()))
    index = cKDTree(nodes.xy[good]).query(nodes.xy[~good], k=k)[1].reshape(-1, k)
    mean = normals[good][index].mean(axis=1)
    normals[~good] = mean / np.linalg.norm(mean, axis=-1, keepdims=True)
    sigma[~good] = 0.1
    return normals, sigma


def node_edges(
    model: Model,
    nodes: Nodes,
    normals: Array,
    sigma: Array,
    own_sigma: Floats,
    options: PropagationOptions,
) -> Edges:
    """Increments from normals on all edges, and the constancy along the contours."""
    joined = _smooth_edges(nodes, normals, sigma)
    tail, head = nodes.tail[joined], nodes.head[joined]
    rays = nodes.rays_in_world.astype(np.float64)
    mean = normals[tail] + normals[head]
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
    angle = np.linalg.norm(rays[head] - rays[tail], axis=-1)
    slope = slope_sigma(mean, rays[tail], 0.5 * (sigma[tail] + sigma[head]))
    delta = log_range_increment(mean, rays[tail], rays[head])
    edge_sigma = np.maximum(angle * slope, 1e-7)
    finite = np.isfinite(delta) & np.isfinite(edge_sigma)
    use = nodes.on_contour[joined] & finite & (options.contour is Contour.TANGENT)
    # Constant range (PPA) or depth (OPA); its slope errs by the turn of the row about the ray.
    constant = np.log(nodes.ray_z[tail] / nodes.ray_z[head]) if model is Model.OPA else 0.0 * angle
    turn = 0.5 * (own_sigma[tail] + own_sigma[head])
    cosine = np.abs((mean * rays[tail]).sum(axis=-1))
    constant_sigma = (
        angle * turn * np.sqrt(1 - np.minimum(cosine, 1) ** 2) / np.maximum(cosine, 0.05)
    )
    use &= np.isfinite(constant_sigma)
    return Edges(
        tail=np.concatenate([tail[finite], tail[use]]),
        head=np.concatenate([head[finite], head[use]]),
        delta=np.concatenate([delta[finite], constant[use]]),
        sigma=np.concatenate([edge_sigma[finite], np.maximum(constant_sigma[use], 1e-7)]),
    )


def _smooth_edges(nodes: Nodes, normals: Array, sigma: Array) -> NDArray[np.bool_]:
    """Edges without a crease: normals differ no more than noise and the curvature about them."""
    tail, head = nodes.tail, nodes.head
    turn = np.arccos(np.clip((normals[tail] * normals[head]).sum(axis=-1), -1, 1))
    num = len(nodes.xy)
    degree = np.maximum(np.bincount(tail, minlength=num) + np.bincount(head, minlength=num), 1)
    # Root turn averaged over a node's edges: a crease crosses few of them, curvature all.
    root = np.sqrt(turn)
    local = ((np.bincount(tail, root, num) + np.bincount(head, root, num)) / degree) ** 2
    noise = np.hypot(sigma[tail], sigma[head])
    expected = np.minimum(local[tail], local[head])
    limit = np.maximum(MIN_CREASE_ANGLE, CREASE_FACTOR * np.maximum(noise, expected))
    return np.asarray(~(turn > limit))


def tie_seeds(
    phase_map: PhaseMap, nodes: Nodes, normals: Array, seeds: Seeds
) -> tuple[SeedTies, int]:
    """Tie every visible seed to the nearest nodes through the plane of the node's normal."""
    visible, seed_xy = visible_seeds(phase_map, seeds)
    to_seed = seeds.points_in_world - phase_map.view.center_in_world
    distance = np.linalg.norm(to_seed, axis=-1)
    k = min(NUM_TIES, len(nodes.xy))
    gap, node = cKDTree(nodes.xy).query(np.where(visible[:, None], seed_xy, -1e6), k=k)
    gap, node = gap.reshape(-1, k), node.reshape(-1, k)
    seed = np.repeat(np.arange(len(distance)), k)
    node, gap = node.reshape(-1), gap.reshape(-1)
    rays = (to_seed / distance[:, None])[seed]
    with np.errstate(invalid="ignore"):
        node_rays = nodes.rays_in_world[node].astype(np.float64)
        step = log_range_increment(normals[node], rays, node_rays)
        # A seed of another surface, hidden behind this one, has another normal.
        alike = ~((seeds.normals_in_world[seed] * normals[node]).sum(axis=-1) < MIN_SEED_COSINE)
    ok = visible[seed] & alike & (gap < MAX_SEED_DISTANCE_PX) & np.isfinite(step)
    seed, node, gap, step = seed[ok], node[ok], gap[ok], step[ok]
    footprint = 1 / phase_map.view.camera.mean_focal_px
    sigma = np.sqrt(
        k * (seeds.sigma[seed] / distance[seed]) ** 2 + (0.02 * (1 + gap) * footprint) ** 2
    )
    value = np.log(distance[seed]) + step
    return SeedTies(node=node, seed=seed, value=value, sigma=sigma), len(distance)
