"""From normals to distances: least squares for the log-range of nodes joined by edges.

Between two pixels of a surface with normal ``n`` the distances along the rays ``v`` obey
``log r_j - log r_i = log((n . v_i) / (n . v_j))``, exactly so on a plane and for any camera model.
Seeds fix the value of some nodes; robust losses let wrong seeds and edges across depth jumps
lose.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]

MAX_GRAZING = 0.05  # |n . v| under which the increment of a node is not to be trusted
CAUCHY_SCALE = 2.385


@dataclass(frozen=True, kw_only=True)
class Edges:
    """Edges between nodes: ``log_range[head] - log_range[tail] = delta``, deviation ``sigma``."""

    tail: Indices
    head: Indices
    delta: Array
    sigma: Array


@dataclass(frozen=True, kw_only=True)
class SeedTies:
    """Seeds tied to nodes: ``log_range[node] = value`` with deviation ``sigma``; by seed index."""

    node: Indices
    seed: Indices
    value: Array
    sigma: Array


@dataclass(frozen=True, kw_only=True)
class RangeSolution:
    """Log-ranges of N nodes.

    Attributes
    ----------
    log_range : (N,) float64; NaN for nodes that no seed reaches.
    seed_weight : (S,) robust weight of each seed, 0 to 1.
    edge_weight : (E,) robust weight of each edge, 0 to 1.
    """

    log_range: Array
    seed_weight: Array
    edge_weight: Array


def log_range_increment(normals: Floats, rays_tail: Floats, rays_head: Floats) -> Array:
    """``log r_head - log r_tail`` on a plane with normal ``n`` (all ``(..., 3)``, one frame)."""
    tail = np.minimum((normals * rays_tail).sum(axis=-1), -MAX_GRAZING)
    head = np.minimum((normals * rays_head).sum(axis=-1), -MAX_GRAZING)
    return np.asarray(np.log(tail / head), np.float64)


def slope_sigma(normals: Floats, rays: Floats, sigma: Floats) -> Array:
    """Deviation of the log-range's slope (per radian of ray) from that of the normal (rad)."""
    cosine = np.maximum(np.abs((normals * rays).sum(axis=-1)), MAX_GRAZING)
    return np.asarray(sigma / cosine**2, np.float64)


def solve_log_ranges(
    num_nodes: int,
    edges: Edges,
    ties: SeedTies,
    num_seeds: int,
    *,
    num_rounds: int = 4,
) -> RangeSolution:
    """Robust least squares for the log-ranges of the nodes that seeds reach.

    Iteratively reweighted with Cauchy losses on seeds and edges; each round is one sparse
    Cholesky-like factorisation (SuperLU on the normal matrix).
    """
    reached = _reached_nodes(num_nodes, edges, ties)
    index = np.cumsum(reached) - 1
    keep = reached[edges.tail] & reached[edges.head]
    tail, head = index[edges.tail[keep]], index[edges.head[keep]]
    delta, edge_precision = edges.delta[keep], 1 / edges.sigma[keep] ** 2
    node, tie_precision = index[ties.node], 1 / ties.sigma**2
    edge_weight, tie_weight = np.ones(len(tail)), np.ones(len(node))
    seed_weight = np.ones(num_seeds)
    size = int(reached.sum())
    solution = np.full(num_nodes, np.nan)
    weights = np.zeros(len(edges.tail))
    if size == 0:
        return RangeSolution(log_range=solution, seed_weight=seed_weight, edge_weight=weights)
    values = np.zeros(size)
    for round_index in range(num_rounds):
        we, wt = edge_weight * edge_precision, tie_weight * tie_precision
        diagonal = (
            np.bincount(tail, we, size) + np.bincount(head, we, size) + np.bincount(node, wt, size)
        )
        rows = np.concatenate([tail, head, np.arange(size)])
        cols = np.concatenate([head, tail, np.arange(size)])
        matrix = sparse.csc_matrix((np.concatenate([-we, -we, diagonal]), (rows, cols)))
        right = (
            np.bincount(head, we * delta, size)
            - np.bincount(tail, we * delta, size)
            + np.bincount(node, wt * ties.value, size)
        )
        values = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True}).solve(
            right
        )
        scale = CAUCHY_SCALE * 2.0 ** max(num_rounds - 3 - round_index, 0)
        edge_z2 = (values[head] - values[tail] - delta) ** 2 * edge_precision
        edge_weight = 1 / (1 + edge_z2 / scale**2)
        # A seed is tied to several nodes; it is right or wrong as a whole.
        tie_z2 = (values[node] - ties.value) ** 2 * tie_precision
        count = np.maximum(np.bincount(ties.seed, minlength=num_seeds), 1)
        seed_z2 = np.bincount(ties.seed, tie_z2, num_seeds) / count
        seed_weight = 1 / (1 + seed_z2 / scale**2)
        tie_weight = seed_weight[ties.seed]
    solution[reached] = values
    weights[keep] = edge_weight
    return RangeSolution(log_range=solution, seed_weight=seed_weight, edge_weight=weights)


def _reached_nodes(num_nodes: int, edges: Edges, ties: SeedTies) -> NDArray[np.bool_]:
    """Nodes in a connected component that holds a seed."""
    ones = np.ones(len(edges.tail), np.int8)
    graph = sparse.coo_matrix((ones, (edges.tail, edges.head)), shape=(num_nodes, num_nodes))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(np.isin(labels, np.unique(labels[ties.node])))
