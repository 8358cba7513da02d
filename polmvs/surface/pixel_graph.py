"""The graph of a view's nodes: edges between them, and ties to seeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.camera import sample_image
from polmvs.normals.estimator import NormalEstimate
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_FACING_COSINE, MIN_VIEWS, Seeds
from polmvs.surface.dense_view import NUM_NEAREST, REACH, SurfaceSamples
from polmvs.surface.log_range import (
    Edges,
    SeedTies,
    log_range_increment,
    slope_sigma,
)

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Image = NDArray[np.float32]


@dataclass(frozen=True, kw_only=True)
class GraphTolerances:
    """Tolerances of the edges between nodes, and of ties to seeds.

    Attributes
    ----------
    normal_error : systematic error of multi-view normals between nodes an angle apart, rad, times
        the root of that angle. Errors of edges count as independent, so those of denser edges must
        be larger to have the same sum. Measured on the shared captures: 0.012 rad at 0.0135 rad.
    crease_factor : factor by which a crease turns the normal more than noise or local curvature.
        Derived: on a cylinder half of the edges of a lattice turn, their local mean is a quarter of
        a turn, which must pass.
    filled_sigma : rad, deviation of a normal from the neighbours, and limit above which a normal is
        replaced by one. Seeds whose normal differs from a node's by more are of another surface.
        Guess.
    """

    normal_error: float = 0.0014
    crease_factor: float = 5.0
    filled_sigma: float = 0.1


TOL = GraphTolerances()


@dataclass(frozen=True)
class Nodes:
    """Nodes of one view on contours, and what is known about them.

    Attributes
    ----------
    surface : ranges and normals at the nodes; NaN where unknown.
    ray_z : (N,), z component of the nodes' rays in the camera frame.
    spacing_px : distance between neighbouring nodes.
    focal_px : of the view.
    tail, head : (E,) indices of the two nodes of an edge.
    on_contour : (E,) bool, edges between consecutive nodes of a contour.
    """

    surface: SurfaceSamples
    ray_z: Floats
    spacing_px: float
    focal_px: float
    tail: Indices
    head: Indices
    on_contour: NDArray[np.bool_]

    @property
    def spacing(self) -> float:
        """Angle between neighbouring nodes, rad."""
        return self.spacing_px / self.focal_px


def visible_seeds(phase_map: PhaseMap, seeds: Seeds) -> tuple[NDArray[np.bool_], Array]:
    """Seeds that face the view and project into its region, and their projections."""
    view, points, normals = phase_map.view, seeds.points_in_world, seeds.normals_in_world
    xy = view.project(points)
    facing = view.faces(points, normals) | ~np.isfinite(normals).all(axis=-1)
    return phase_map.shows_surface(xy) & facing, np.asarray(xy, np.float64)


def uncrossed(phase_map: PhaseMap, start_xy: Floats, end_xy: Floats) -> NDArray[np.bool_]:
    """Lines between pixels that cross no crease and stay in the region."""
    open_pixels = (phase_map.region.inside & ~phase_map.region.edges).astype(np.float32)
    clear = np.ones(len(start_xy), bool)
    for share in (0.25, 0.5, 0.75):
        between = (1 - share) * start_xy + share * end_xy
        clear &= sample_image(open_pixels, between, nearest=True) > 0
    return clear


def bending_modes(xy: Image) -> Array:
    """Polynomials of the nodes' position up to the second degree, of order one over the region.

    Errors of multi-view normals by the camera model are smooth over a view: they tilt and bend the
    surface as a whole, which the seeds correct.
    """
    low, high = xy.min(axis=0), xy.max(axis=0)
    x, y = (2 * (xy - low) / np.maximum(high - low, 1e-9) - 1).T.astype(np.float64)
    legendre = [[np.ones_like(t), t, 1.5 * t**2 - 0.5] for t in (x, y)]
    degrees = [(i, j) for i in range(3) for j in range(3) if 1 <= i + j <= 2]
    return np.stack([legendre[0][i] * legendre[1][j] for i, j in degrees], axis=-1)


def fill_normals(nodes: Nodes, estimate: NormalEstimate) -> tuple[Array, Array]:
    """Normals with gaps filled from neighbours, with a larger deviation."""
    sigma = np.radians(estimate.sigma_deg)
    good = estimate.valid & (estimate.num_rows >= MIN_VIEWS) & (sigma < TOL.filled_sigma)
    if not good.any():
        return estimate.normals, sigma
    xy, normals = nodes.surface.xy, estimate.normals.copy()
    k = min(NUM_NEAREST, int(good.sum()))
    index = cKDTree(xy[good]).query(xy[~good], k=k)[1].reshape(-1, k)
    mean = normals[good][index].mean(axis=1)
    normals[~good] = mean / np.linalg.norm(mean, axis=-1, keepdims=True)
    sigma[~good] = TOL.filled_sigma
    return normals, sigma


def node_edges(
    angle_model: AngleModel,
    nodes: Nodes,
    own_sigma: Floats,
    *,
    along_contours: bool,
) -> Edges:
    """Increments from the nodes' normals on all edges, and the constancy along the contours.

    Parameters
    ----------
    angle_model : sets the constant of a contour.
    nodes : with normals.
    own_sigma : (N,), deviation of the rotation of the view's own row about its ray, rad.
    along_contours : use that constancy.
    """
    surface = nodes.surface
    sigma = np.hypot(surface.normal_sigma, TOL.normal_error / np.sqrt(nodes.spacing))
    joined = _smooth_edges(nodes, surface.normals, sigma)
    tail, head = nodes.tail[joined], nodes.head[joined]
    rays = surface.rays_in_world.astype(np.float64)
    mean = surface.normals[tail] + surface.normals[head]
    mean /= np.linalg.norm(mean, axis=-1, keepdims=True)
    angle = np.linalg.norm(rays[head] - rays[tail], axis=-1)
    slope = slope_sigma(mean, rays[tail], 0.5 * (sigma[tail] + sigma[head]))
    delta = log_range_increment(mean, rays[tail], rays[head])
    edge_sigma = np.maximum(angle * slope, 1e-7)
    finite = np.isfinite(delta) & np.isfinite(edge_sigma)
    edges = Edges(
        tail=tail[finite], head=head[finite], delta=delta[finite], sigma=edge_sigma[finite]
    )
    if not along_contours:
        return edges
    # Constant range (PPA) or depth (OPA); its slope errs by the turn of the row about the ray.
    constant = (
        np.log(nodes.ray_z[tail] / nodes.ray_z[head])
        if angle_model is AngleModel.OPA
        else 0.0 * angle
    )
    turn = 0.5 * (own_sigma[tail] + own_sigma[head])
    cosine = np.abs((mean * rays[tail]).sum(axis=-1))
    constant_sigma = (
        angle
        * turn
        * np.sqrt(1 - np.minimum(cosine, 1) ** 2)
        / np.maximum(cosine, MIN_FACING_COSINE)
    )
    use = nodes.on_contour[joined] & finite & np.isfinite(constant_sigma)
    return Edges(
        tail=np.concatenate([edges.tail, tail[use]]),
        head=np.concatenate([edges.head, head[use]]),
        delta=np.concatenate([edges.delta, constant[use]]),
        sigma=np.concatenate([edges.sigma, np.maximum(constant_sigma[use], 1e-7)]),
    )


def _smooth_edges(nodes: Nodes, normals: Array, sigma: Array) -> NDArray[np.bool_]:
    """Edges without a crease: normals differ no more than noise and the curvature about them."""
    tail, head = nodes.tail, nodes.head
    turn = np.arccos(np.clip((normals[tail] * normals[head]).sum(axis=-1), -1, 1))
    num = len(normals)
    degree = np.maximum(np.bincount(tail, minlength=num) + np.bincount(head, minlength=num), 1)
    # Root turn averaged over a node's edges: a crease crosses few of them, curvature all.
    root = np.sqrt(turn)
    local = ((np.bincount(tail, root, num) + np.bincount(head, root, num)) / degree) ** 2
    noise = np.hypot(sigma[tail], sigma[head])
    expected = np.minimum(local[tail], local[head])
    return np.asarray(~(turn > TOL.crease_factor * np.maximum(noise, expected)))


def tie_seeds(
    phase_map: PhaseMap,
    nodes: Nodes,
    seeds: Seeds,
) -> SeedTies:
    """Tie every visible seed to the nearest nodes along the chords to them."""
    surface = nodes.surface
    visible, seed_xy = visible_seeds(phase_map, seeds)
    to_seed = seeds.points_in_world - phase_map.view.center_in_world
    distance = np.linalg.norm(to_seed, axis=-1)
    k = min(NUM_NEAREST, len(surface.xy))
    gap, node = cKDTree(surface.xy).query(np.where(visible[:, None], seed_xy, -1e6), k=k)
    gap, node = gap.reshape(-1, k), node.reshape(-1, k)
    seed = np.repeat(np.arange(len(distance)), k)
    node, gap = node.reshape(-1), gap.reshape(-1)
    rays = (to_seed / distance[:, None])[seed]
    with np.errstate(invalid="ignore"):
        node_rays = surface.rays_in_world[node].astype(np.float64)
        seed_normals, node_normals = seeds.normals_in_world[seed], surface.normals[node]
        known = np.isfinite(seed_normals).all(axis=-1, keepdims=True)
        chord = node_normals + np.where(known, seed_normals, node_normals)
        step = log_range_increment(chord, rays, node_rays)
        # A seed of another surface, hidden behind this one, has another normal.
        alike = ~((seed_normals * node_normals).sum(axis=-1) < np.cos(TOL.filled_sigma))
    ok = visible[seed] & alike & (gap < REACH * nodes.spacing_px) & np.isfinite(step)
    seed, node, gap, step = seed[ok], node[ok], gap[ok], step[ok]
    gsd = 1 / phase_map.view.camera.mean_focal_px
    sigma = np.sqrt(k * (seeds.sigma[seed] / distance[seed]) ** 2 + (0.02 * (1 + gap) * gsd) ** 2)
    value = np.log(distance[seed]) + step
    return SeedTies(node=node, seed=seed, value=value, sigma=sigma)
