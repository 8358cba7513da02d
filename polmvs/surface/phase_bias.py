"""Bias of a surface that sparse points show: a smooth field of heights, by kriging.

Phases of light that was reflected twice, or under an angle model that the camera does not follow,
are biased over wide areas. The surface then has the right detail at a wrong position. Sparse points
are free of this bias, but few and noisy. So their heights h above the surface are modelled as a
Gaussian process b with noise e,

    h_p = b(x_p) + e_p,    e_p ~ N(0, sigma_p^2 + t^2),
    b ~ GP(0, s^2 exp(-|x - x'|^2 / 2 l^2) ((1 + n . n') / 2)^4).

The factor of the normals n separates the two sides of a wall; as a power series in n . n' without
negative terms it leaves the covariance valid (Schoenberg 1942). The amplitude s, the length l and
the excess noise t are those of the largest marginal likelihood (Rasmussen and Williams, Gaussian
Processes for Machine Learning, 2006, Eq. 5.8).
"""

from __future__ import annotations

import logging
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_solve, solve_triangular
from scipy.optimize import minimize
from scipy.spatial.distance import cdist

from polmvs.geometry import dots, lengths
from polmvs.normals.tracks import evenly_chosen
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh
from polmvs.surface.terms import KnownPoints, TermTolerances

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_POINTS = 10  # with fewer, three parameters follow the noise. Guess
MAX_POINTS = 300  # evenly chosen: time grows with their cube
MIN_GAIN = 2.0  # nats: one for each parameter of the process (Akaike 1974)
FACING = 4  # power: half is left at 45 deg, a sixteenth at a right angle. Guess
NEGLIGIBLE_PX = 0.01  # amplitude and noise below which nothing changes
PART = 20_000  # vertices at a time: bounds the memory


@dataclass(frozen=True)
class Bias:
    """Bias of a mesh with V vertices; world units.

    Attributes
    ----------
    heights : (V,) of the true surface above the mesh, along the normals.
    sigma : (V,) their deviation.
    """

    heights: Array
    sigma: Array


@dataclass(frozen=True)
class _Heights:
    """Heights of N points; lengths in GSD.

    Attributes
    ----------
    places, normals : (N, 3), on the surface.
    heights, sigma : (N,)
    """

    places: Array
    normals: Array
    heights: Array
    sigma: Array


@dataclass(frozen=True)
class _Process:
    """The parameters s, l and t of the module's text, GSD."""

    amplitude: float
    length: float
    noise: float

    def covariance(self, one: Array, one_normals: Array, other: _Heights) -> Array:
        """Of the bias at places (M, 3) with normals (M, 3) and at points: (M, N)."""
        square = cdist(one, other.places, "sqeuclidean") / self.length**2
        alike = (0.5 + 0.5 * one_normals @ other.normals.T) ** FACING
        return np.asarray(self.amplitude**2 * np.exp(-0.5 * square) * alike)

    def factor(self, given: _Heights) -> Array:
        """Lower Cholesky factor (N, N) of the covariance of the heights."""
        covariance = self.covariance(given.places, given.normals, given)
        covariance += np.diag(given.sigma**2 + self.noise**2)
        return np.asarray(np.linalg.cholesky(covariance))

    def loss(self, given: _Heights) -> float:
        """Negative marginal log-likelihood of the heights, without its constant."""
        factor = self.factor(given)
        white = solve_triangular(factor, given.heights, lower=True)
        return float(0.5 * white @ white + np.log(np.diag(factor)).sum())


def find_bias(
    mesh: TriangleMesh, seen: Mask, known: KnownPoints, gsd: float, *, gate_px: float
) -> Bias | None:
    """The bias of a mesh that known points show.

    Parameters
    ----------
    mesh : refined without the points.
    seen : (F,) bool, faces that a view sees.
    known : points of the surface.
    gsd : ground sampling distance at the surface, world units.
    gate_px : points farther from the mesh, GSD, are not of it.

    Returns
    -------
    None if the points are explained as well without it, or too few.
    """
    given = _heights(mesh, seen, known, gsd, gate_px)
    if len(given.heights) < MIN_POINTS:
        return None
    process, gain = _likeliest(given, gate_px)
    if gain < MIN_GAIN:
        return None
    logger.info(
        "%d sparse points show a bias of %.2f px over %.0f px.",
        len(given.heights),
        process.amplitude,
        process.length,
    )
    factor = process.factor(given)
    weights = cho_solve((factor, True), given.heights)
    heights, variance = np.zeros((2, len(mesh.vertices)))
    for start in range(0, len(mesh.vertices), PART):
        part = slice(start, start + PART)
        places, normals = mesh.vertices[part] / gsd, mesh.vertex_normals[part]
        covariance = process.covariance(places, normals, given)
        explained = solve_triangular(factor, covariance.T, lower=True)
        heights[part] = covariance @ weights
        variance[part] = process.amplitude**2 - (explained**2).sum(axis=0)
    return Bias(heights * gsd, np.sqrt(np.maximum(variance, 0)) * gsd)


def _heights(
    mesh: TriangleMesh, seen: Mask, known: KnownPoints, gsd: float, gate_px: float
) -> _Heights:
    """Heights of the points near the seen faces of a mesh."""
    nothing = np.zeros((0, 3))
    if not seen.any() or not len(known.points):
        return _Heights(nothing, nothing, np.zeros(0), np.zeros(0))
    visible = TriangleMesh(mesh.vertices, mesh.faces[seen])
    place, face, _ = RayScene(visible).closest(known.points)
    normals = visible.face_normals[face]
    offset = (known.points - place) / gsd
    near = np.flatnonzero((lengths(offset) < gate_px) & np.isfinite(known.sigma))
    near = near[evenly_chosen(len(near), MAX_POINTS)]
    return _Heights(
        place[near] / gsd,
        normals[near],
        dots(offset[near], normals[near]),
        np.hypot(known.sigma[near] / gsd, TermTolerances.place_sigma_px),
    )


def _likeliest(given: _Heights, largest: float) -> tuple[_Process, float]:
    """The likeliest process of an amplitude up to the ``largest``, and its gain over none, nats."""
    # The energy itself weighs points against errors over shorter lengths.
    shortest = float(np.sqrt(TermTolerances.alike_px))
    longest = max(float(np.ptp(given.places, axis=0).max()), 2 * shortest)
    bounds = np.log([(NEGLIGIBLE_PX, largest), (shortest, longest), (NEGLIGIBLE_PX, largest)])

    def loss(logarithms: Array) -> float:
        return _Process(*np.exp(logarithms)).loss(given)

    def without(logarithms: Array) -> float:
        return _Process(0.0, 1.0, float(np.exp(logarithms[0]))).loss(given)

    none = minimize(without, [0.0], method="L-BFGS-B", bounds=bounds[2:]).fun
    # The likelihood may have a maximum at short and at long lengths.
    trials = [
        minimize(loss, [0.0, start, 0.0], method="L-BFGS-B", bounds=bounds)
        for start in bounds[1] @ np.array([[0.75, 0.25], [0.25, 0.75]])
    ]
    best = min(trials, key=lambda trial: trial.fun)
    return _Process(*np.exp(best.x)), float(none - best.fun)
