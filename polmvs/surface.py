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
    modes: Array | None = None,
    mode_sigma: float = 1.0,
    num_rounds: int = 4,
) -> RangeSolution:
    """Robust least squares for the log-ranges of the nodes that seeds reach.

    Iteratively reweighted with Cauchy losses on seeds and edges; each round is one sparse
    factorisation (SuperLU on the normal matrix).

    Parameters
    ----------
    num_nodes : N.
    edges, ties : what is known, with deviations of independent errors.
    num_seeds : S; a seed is tied to several nodes and right or wrong as a whole.
    modes : (N, M), smooth functions of the nodes. The log-range is the integral of the edges
        plus a combination of these: the errors of the increments are not independent, a wrong
        camera model bends the whole surface.
    mode_sigma : standard deviation of a mode's coefficient.
    num_rounds : of reweighting.
    """
    modes = np.zeros((num_nodes, 0)) if modes is None else modes
    reached = _reached_nodes(num_nodes, edges, ties)
    keep = reached[edges.tail] & reached[edges.head]
    num_edges, num_modes, size = int(keep.sum()), modes.shape[1], int(reached.sum())
    log_range = np.full(num_nodes, np.nan)
    seed_weight, edge_weight = np.ones(num_seeds), np.zeros(len(edges.tail))
    if size == 0:
        return RangeSolution(log_range=log_range, seed_weight=seed_weight, edge_weight=edge_weight)
    design = _design(reached, edges, keep, ties, modes)
    target = np.concatenate([edges.delta[keep], ties.value, np.zeros(num_modes)])
    sigma = np.concatenate([edges.sigma[keep], ties.sigma, np.full(num_modes, mode_sigma)])
    precision = 1 / sigma**2
    robust = np.ones(len(target))
    for round_index in range(num_rounds):
        weighted = design.T.multiply(robust * precision)
        factors = splu(
            (weighted @ design).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            options={"SymmetricMode": True},
        )
        unknowns = factors.solve(weighted @ target)
        scale = CAUCHY_SCALE * 2.0 ** max(num_rounds - 3 - round_index, 0)
        z2 = (design @ unknowns - target) ** 2 * precision
        tie_z2 = z2[num_edges : len(z2) - num_modes]
        count = np.maximum(np.bincount(ties.seed, minlength=num_seeds), 1)
        seed_weight = 1 / (1 + np.bincount(ties.seed, tie_z2, num_seeds) / count / scale**2)
        robust[:num_edges] = 1 / (1 + z2[:num_edges] / scale**2)
        robust[num_edges : len(z2) - num_modes] = seed_weight[ties.seed]
    log_range[reached] = unknowns[:size] + modes[reached] @ unknowns[size:]
    edge_weight[keep] = robust[:num_edges]
    return RangeSolution(log_range=log_range, seed_weight=seed_weight, edge_weight=edge_weight)


def _design(
    reached: NDArray[np.bool_], edges: Edges, keep: NDArray[np.bool_], ties: SeedTies, modes: Array
) -> sparse.csr_matrix:
    """Rows: edges, ties, the modes' prior. Columns: integrals at the reached nodes, modes."""
    index = np.cumsum(reached) - 1
    num_edges, num_ties, num_modes = int(keep.sum()), len(ties.node), modes.shape[1]
    size = int(reached.sum())
    edge, tie = np.arange(num_edges), num_edges + np.arange(num_ties)
    prior, mode = num_edges + num_ties + np.arange(num_modes), size + np.arange(num_modes)
    rows = [edge, edge, tie, np.repeat(tie, num_modes), prior]
    cols = [index[edges.head[keep]], index[edges.tail[keep]], index[ties.node]]
    cols += [np.tile(mode, num_ties), mode]
    values = [np.ones(num_edges), -np.ones(num_edges), np.ones(num_ties)]
    values += [modes[ties.node].reshape(-1), np.ones(num_modes)]
    return sparse.csr_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(cols))),
        shape=(num_edges + num_ties + num_modes, size + num_modes),
    )


def _reached_nodes(num_nodes: int, edges: Edges, ties: SeedTies) -> NDArray[np.bool_]:
    """Nodes in a connected component that holds a seed."""
    ones = np.ones(len(edges.tail), np.int8)
    graph = sparse.coo_matrix((ones, (edges.tail, edges.head)), shape=(num_nodes, num_nodes))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(np.isin(labels, np.unique(labels[ties.node])))
