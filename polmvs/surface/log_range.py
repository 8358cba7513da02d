"""From normals to distances: least squares for the log-range of nodes joined by edges.

Between two pixels of a surface with normal ``n`` the distances along the rays ``v`` obey
``log r_j - log r_i = log((n . v_i) / (n . v_j))``, exactly so on a plane and for any camera model.
Seeds fix the value of some nodes. Robust losses reject wrong seeds and edges across depth jumps.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.csgraph import connected_components
from scipy.sparse.linalg import splu

from polmvs.fitting import annealed_scales, cauchy_weights
from polmvs.geometry import dots, lengths
from polmvs.scene import MIN_FACING_COSINE

Floats = NDArray[np.floating]
Array = NDArray[np.float64]
Indices = NDArray[np.int64]

NUM_DRAWS = 16  # of the noise, for the deviation of the solution, which is then 18 % uncertain


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
    sigma : (N,) float64, its standard deviation; NaN likewise.
    seed_weight : (S,) robust weight of each seed, 0 to 1.
    edge_weight : (E,) robust weight of each edge, 0 to 1.
    """

    log_range: Array
    sigma: Array
    seed_weight: Array
    edge_weight: Array


def log_range_increment(normals: Floats, rays_tail: Floats, rays_head: Floats) -> Array:
    """``log r_head - log r_tail`` on a plane with normal ``n`` (all ``(..., 3)``, one frame).

    The normal may have any length. Surfaces flatter than a limit count as that limit.
    """
    least = -MIN_FACING_COSINE * np.maximum(lengths(normals), 1e-12)
    tail = np.minimum(dots(normals, rays_tail), least)
    head = np.minimum(dots(normals, rays_head), least)
    return np.asarray(np.log(tail / head), np.float64)


def slope_sigma(normals: Floats, rays: Floats, sigma: Floats) -> Array:
    """Deviation of the log-range's slope (per radian of ray) from that of the normal (rad)."""
    cosine = np.maximum(np.abs((normals * rays).sum(axis=-1)), MIN_FACING_COSINE)
    return np.asarray(sigma / cosine**2, np.float64)


def solve_log_ranges(
    num_nodes: int,
    edges: Edges,
    ties: SeedTies,
    num_seeds: int,
    *,
    modes: Array | None = None,
    num_rounds: int = 4,
) -> RangeSolution:
    """Robust least squares for the log-ranges of the nodes connected to seeds.

    Iteratively reweighted with Cauchy losses on seeds and edges; each round is one sparse
    factorisation (SuperLU on the normal matrix).

    Parameters
    ----------
    num_nodes : N.
    edges, ties : the constraints, with deviations of independent errors.
    num_seeds : S; a seed is tied to several nodes and is right or wrong as a whole.
    modes : (N, M), smooth functions of the nodes. The log-range is the integral of the edges plus a
        combination of these, as the errors of the increments are not independent: a wrong camera
        model bends the whole surface. The size of each is one standard deviation.
    num_rounds : of reweighting.
    """
    modes = np.zeros((num_nodes, 0)) if modes is None else modes
    reached = _reached_nodes(num_nodes, edges, ties)
    keep = reached[edges.tail] & reached[edges.head]
    num_edges, num_modes, size = int(keep.sum()), modes.shape[1], int(reached.sum())
    log_range = np.full(num_nodes, np.nan)
    seed_weight, edge_weight = np.ones(num_seeds), np.zeros(len(edges.tail))
    spread = np.full(num_nodes, np.nan)
    if size == 0:
        return RangeSolution(
            log_range=log_range, sigma=spread, seed_weight=seed_weight, edge_weight=edge_weight
        )
    system = _System(reached, edges, keep, ties, modes)
    target = np.concatenate([edges.delta[keep], ties.value, np.zeros(num_modes)])
    sigma = np.concatenate([edges.sigma[keep], ties.sigma, np.ones(num_modes)])
    precision = 1 / sigma**2
    robust = np.ones(len(target))
    for scale in annealed_scales(num_rounds):
        used = robust.copy()
        factors = system.factorise(used * precision)
        solution = factors.solve(target[:, None])
        z2 = (system.predict(solution)[:, 0] - target) ** 2 * precision
        tie_z2 = z2[num_edges : len(z2) - num_modes]
        count = np.maximum(np.bincount(ties.seed, minlength=num_seeds), 1)
        seed_z2 = np.bincount(ties.seed, tie_z2, num_seeds) / count
        seed_weight = np.asarray(cauchy_weights(seed_z2, scale), np.float64)
        robust[:num_edges] = cauchy_weights(z2[:num_edges], scale)
        robust[num_edges : len(z2) - num_modes] = seed_weight[ties.seed]
    log_range[reached] = system.log_ranges(solution)[:, 0]
    draws = factors.solve(_noise(sigma, used))
    spread[reached] = system.log_ranges(draws).std(axis=1)
    edge_weight[keep] = robust[:num_edges]
    return RangeSolution(
        log_range=log_range, sigma=spread, seed_weight=seed_weight, edge_weight=edge_weight
    )


def _noise(sigma: Array, robust: Array) -> Array:
    """Draws (M, NUM_DRAWS) of the observations' noise, wider where the loss trusts them less.

    The solutions for them scatter as the solution for the observations does: its deviation at
    every node without the inverse of the normal matrix.
    """
    rng = np.random.default_rng(0)
    own = sigma / np.sqrt(np.maximum(robust, 1e-6))
    return rng.standard_normal((len(sigma), NUM_DRAWS)) * own[:, None]


class _System:
    """The linear system: unknowns are the integrals at the reached nodes, then the modes.

    Rows: edges, ties, the modes' prior. The modes touch every tie, so that their columns are kept
    dense and apart: within the sparse matrix they would fill its factors.
    """

    def __init__(
        self,
        reached: NDArray[np.bool_],
        edges: Edges,
        keep: NDArray[np.bool_],
        ties: SeedTies,
        modes: Array,
    ) -> None:
        index = np.cumsum(reached) - 1
        num_edges, num_ties, num_modes = int(keep.sum()), len(ties.node), modes.shape[1]
        edge, tie = np.arange(num_edges), num_edges + np.arange(num_ties)
        cols = [index[edges.head[keep]], index[edges.tail[keep]], index[ties.node]]
        values = [np.ones(num_edges), -np.ones(num_edges), np.ones(num_ties)]
        self.node_columns = sparse.csr_matrix(
            (np.concatenate(values), (np.concatenate([edge, edge, tie]), np.concatenate(cols))),
            shape=(num_edges + num_ties + num_modes, int(reached.sum())),
        )
        blocks = [np.zeros((num_edges, num_modes)), modes[ties.node], np.eye(num_modes)]
        self.mode_columns = np.concatenate(blocks)
        self.modes = modes[reached]

    def factorise(self, weights: Array) -> _Factors:
        """Factors of the normal matrix under weights of the rows."""
        return _Factors(self.node_columns, self.mode_columns, weights)

    def predict(self, solution: Array) -> Array:
        """What the rows should hold for a solution."""
        size = self.node_columns.shape[1]
        return np.asarray(self.node_columns @ solution[:size] + self.mode_columns @ solution[size:])

    def log_ranges(self, solution: Array) -> Array:
        """Log-ranges of the reached nodes."""
        size = self.node_columns.shape[1]
        return np.asarray(solution[:size] + self.modes @ solution[size:])


class _Factors:
    """A weighted normal matrix with a dense border, factorised by blocks (Schur complement)."""

    def __init__(self, node_columns: sparse.csr_matrix, mode_columns: Array, weights: Array):
        self.weighted = node_columns.T.multiply(weights).tocsr()
        self.weighted_modes = mode_columns.T * weights
        self.factors = splu(
            (self.weighted @ node_columns).tocsc(),
            permc_spec="MMD_AT_PLUS_A",
            options={"SymmetricMode": True},
        )
        self.border = self.weighted @ mode_columns
        self.inner = self.factors.solve(self.border)
        self.schur = _product(self.weighted_modes, mode_columns)
        self.schur -= _product(self.border.T, self.inner)

    def solve(self, targets: Array) -> Array:
        """Least-squares solutions (unknowns, R) for right-hand sides (rows, R)."""
        inner = self.factors.solve(self.weighted @ targets)
        right = _product(self.weighted_modes, targets) - _product(self.border.T, inner)
        modes = np.linalg.solve(self.schur, right)
        return np.concatenate([inner - self.inner @ modes, modes])


def _product(a: Array, b: Array) -> Array:
    """``a @ b`` of long thin matrices, summed in one order whatever threads BLAS has to spare."""
    return np.asarray(np.einsum("ij,jk->ik", a, b))


def _reached_nodes(num_nodes: int, edges: Edges, ties: SeedTies) -> NDArray[np.bool_]:
    """Nodes in a connected component that holds a seed."""
    ones = np.ones(len(edges.tail), np.int8)
    graph = sparse.coo_matrix((ones, (edges.tail, edges.head)), shape=(num_nodes, num_nodes))
    labels = connected_components(graph, directed=False)[1]
    return np.asarray(np.isin(labels, np.unique(labels[ties.node])))
