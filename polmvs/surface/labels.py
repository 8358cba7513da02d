"""Labels of the observations: specular, diffuse or neither, inferred together with the shape.

Let ``r_s = m_s . n`` and ``r_d = m_d . n`` be the residuals of an observation under the two kinds
of light. Its likelihood is the mixture

    p = w_s k(r_s) + w_d f(dolp, theta) k(r_d) + w_o,    k(r) = exp(-r^2 / 2 v),

where the w are prior shares, and v is the variance of the row plus the assumed error of the current
normal, which shrinks from iteration to iteration. k is a normal density over its peak: under the
density itself, the light whose residuals are larger would lose observations, and so get still
larger residuals. The factor f falls where the degree of polarization exceeds that of diffuse light
at this angle (Fresnel, for the largest refractive index of dielectrics). Neighbouring faces in one
view have the same label unless the polarization turns by a right angle between them; there its
degree passes through zero. A mean field (Ising) therefore couples the labels by the cosine of the
angle between the axial vectors of the faces.

A normal that all observations around a face contradict cannot give labels. There :func:`vote` tries
other normals near it, each with either label.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from polmvs.config import default_num_workers
from polmvs.geometry import dots, unit
from polmvs.polarization.fresnel import fresnel_dolp
from polmvs.polarization.kinds import Light
from polmvs.surface.mesh_geometry import TriangleMesh
from polmvs.surface.observations import DIFFUSE, SPECULAR, Observations

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]
Pairs: TypeAlias = tuple[Indices, Indices]


@dataclass(frozen=True, kw_only=True)
class LabelTolerances:
    """Tolerances of the labels.

    Attributes
    ----------
    refractive_index : largest of common dielectrics (glazes, lacquers); it bounds the degree of
        polarization of diffuse light. Derived.
    angle_margin : rad, of the mesh's normal in that bound, beyond its annealed error. Guess.
    excess_scale : relative excess over the bound by which diffuse light becomes less likely by e.
        Guess.
    outlier : density of observations of neither light, over the peak of a normal's. Guess.
    coupling : of neighbours' labels. Guess: one neighbour has the weight of the observation.
    coupling_rounds : of the mean field.
    vote_tilts : rad, from the mesh's normal to the candidates, rings of ten.
    vote_rings : rings of faces that share their votes. Measured, 1 and 3: equal on a public
        ceramic; a ledge beside a box is 0.3 and 0.57 px off.
    vote_sigma : rad, error of a candidate: half the distance of neighbouring candidates.
    vote_prior : cost per square of a candidate's tilt. Guess.
    vote_margin : mean cost by which a candidate must win. Guess.
    max_cost : largest cost of an observation in a vote: that of 3 deviations.
    """

    refractive_index: float = 1.7
    angle_margin: float = 0.17
    excess_scale: float = 0.125
    outlier: float = 0.02
    coupling: float = 1.0
    coupling_rounds: int = 8
    vote_tilts: tuple[float, ...] = (0.26, 0.52, 0.8)
    vote_rings: int = 1
    vote_sigma: float = 0.13
    vote_prior: float = 0.6
    vote_margin: float = 0.5
    max_cost: float = 9.0


def neighbors(observations: Observations, pairs: Pairs, num: int) -> sparse.csr_array:
    """Coupling (K, K) of the labels of two observations of one view, in [0, 1].

    It is not 0 for faces that share an edge.

    Parameters
    ----------
    observations : of one view, of a mesh with ``num`` faces.
    pairs : faces that share an edge, each pair once.
    """
    o, size = observations, len(observations.face)
    index = np.full(num, -1, np.int32)
    index[o.face] = np.arange(size)
    one, other = index[pairs[0]], index[pairs[1]]
    both = (one >= 0) & (other >= 0)
    one, other = one[both], other[both]
    axial = o.axial.astype(np.float32)
    first, second = axial.take(one, axis=0), axial.take(other, axis=0)
    length = o.dolp.astype(np.float32)
    near, far = length.take(one), length.take(other)
    cosine = np.einsum("pi,pi->p", first, second) / np.maximum(near * far, 1e-12)
    sigma = o.sigma_dolp.astype(np.float32)
    noise = np.maximum(sigma.take(one), sigma.take(other))
    # A vector as short as its noise has no direction.
    known = np.clip(np.minimum(near, far) / np.maximum(4 * noise, 1e-12), 0, 1)
    alike = np.clip(cosine, 0, 1) * known
    upper = sparse.csr_array((alike, (one, other)), shape=(size, size))
    return sparse.csr_array(upper + upper.T)


def _excess(dolp: Floats, sigma_dolp: Floats, angle: Floats, tol: LabelTolerances) -> Array:
    """Loss of the log-likelihood of diffuse light by a degree of polarization above its bound."""
    bound = fresnel_dolp(np.cos(np.minimum(angle, 1.5)), Light.DIFFUSE, tol.refractive_index)
    bound = bound + 2 * sigma_dolp + 0.01
    log = np.log(np.maximum(dolp, 1e-6) / bound)
    return np.asarray(np.clip(log, 0, None) / tol.excess_scale)


def responsibilities(
    observations: Observations,
    normals: Array,
    *,
    normal_sigma: float,
    row_sigma: Floats,
    pairs: Pairs | None = None,
    weights: tuple[float, float] = (0.5, 0.5),
    tolerances: LabelTolerances | None = None,
) -> Array:
    """Probabilities (2, K) of specular and of diffuse light of observations; the rest is neither.

    Parameters
    ----------
    observations : of a mesh with F faces.
    normals : (F, 3) unit, assumed.
    normal_sigma : rad, their error.
    row_sigma : (2, K) deviation of ``m . n`` that noise does not explain.
    pairs : of faces, as of :func:`neighbors`; None: their labels are not coupled.
    weights : prior shares of specular and of diffuse light; 0 for one that does not occur.
    """
    tol, o = tolerances or LabelTolerances(), observations
    row_sigma = np.broadcast_to(row_sigma, o.turn_variance.shape)

    def of_view(part: slice) -> Array:
        own = o.only(part)
        cosine = np.clip(-dots(own.rays, normals.take(own.face, axis=0)), 0, 1)
        variance = own.variances(normals, row_sigma[:, part]) + (1 - cosine**2) * normal_sigma**2
        fits = -0.5 * own.residuals(normals) ** 2 / variance
        angle = np.arccos(cosine) + tol.angle_margin + 0.7 * normal_sigma
        score = fits + np.log(np.maximum(weights, 1e-30))[:, None]
        score[DIFFUSE] -= np.minimum(_excess(own.dolp, own.sigma_dolp, angle, tol), 30)
        odds = np.clip(score[SPECULAR] - score[DIFFUSE], -60, 60)
        if pairs is not None:
            odds = _coupled(odds, neighbors(own, pairs, len(normals)), tol)
        specular = 1 / (1 + np.exp(-np.clip(odds, -40, 40)))
        fit = np.where(specular > 0.5, fits[SPECULAR], fits[DIFFUSE])
        inlier = 1 / (1 + np.exp(np.clip(np.log(tol.outlier) - fit, -40, 40)))
        return np.stack([specular * inlier, (1 - specular) * inlier])

    # Views are coupled by nothing. Threads, as products of large arrays release Python's lock.
    with ThreadPoolExecutor(default_num_workers()) as pool:
        return np.concatenate([np.zeros((2, 0)), *pool.map(of_view, o.of_views())], axis=1)


def _coupled(own: Array, near: sparse.csr_array, tol: LabelTolerances) -> Array:
    """Log odds (K,) of observations with those of their neighbours, by a mean field."""
    odds = own
    for _ in range(tol.coupling_rounds):
        odds = own + tol.coupling * (near @ np.tanh(0.5 * odds.astype(np.float32)))
    return odds


@dataclass(frozen=True)
class Vote:
    """Normals that the observations about each face prefer.

    Attributes
    ----------
    normals : (F, 3) unit: the winner, or the mesh's own.
    has_won : (F,) bool, True where it is not the mesh's own.
    """

    normals: Array
    has_won: Mask


def vote(
    mesh: TriangleMesh,
    observations: Observations,
    pairs: Pairs,
    *,
    row_sigma: Floats,
    tolerances: LabelTolerances | None = None,
) -> Vote:
    """Try normals about those of the mesh, with the labels of all observations open.

    Parameters
    ----------
    mesh : with F faces.
    observations : of it.
    pairs : as of :func:`neighbors`.
    row_sigma : as of :func:`responsibilities`.
    """
    tol, o = tolerances or LabelTolerances(), observations
    normals, num = mesh.face_normals, len(mesh.faces)
    helper = np.where(np.abs(normals[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = unit(np.cross(helper, normals) + 1e-300)
    frames = np.stack([normals, first, np.cross(normals, first)], axis=1)
    tilts, candidates = _candidates(tol)
    ones = np.ones(len(pairs[0]), np.float32)
    shared = sparse.coo_array((ones, pairs), shape=(num, num))
    shared = sparse.csr_array(shared + shared.T + sparse.eye_array(num, dtype=np.float32))
    voters = _Voters.of(o, frames, row_sigma, tol)

    def over_rings(sums: NDArray[np.float32]) -> NDArray[np.float32]:
        for _ in range(tol.vote_rings):
            sums = shared @ sums
        return sums

    count = over_rings(np.bincount(o.face, minlength=num).astype(np.float32)[:, None])
    count = np.maximum(count, 1e-6)
    own = over_rings(voters.costs(candidates[:1], num, tol)) / count
    # Costs are not negative: nothing wins where the mesh's own normal costs less than the margin.
    doubted = own[:, 0] > tol.vote_margin
    near = over_rings(doubted.astype(np.float32)) > 0
    others = over_rings(voters.only(near[o.face]).costs(candidates[1:], num, tol)) / count
    others += np.float32(tol.vote_prior) * np.square(tilts[1:])
    best = 1 + others.argmin(axis=1)
    has_won = doubted & (own[:, 0] - others.min(axis=1) > tol.vote_margin)
    winner = np.einsum("fa,fai->fi", candidates[best].astype(np.float64), frames)
    return Vote(np.where(has_won[:, None], winner, normals), has_won)


def _candidates(tol: LabelTolerances) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Tilts (C,), rad, and unit vectors (C, 3) of the candidates in a face's frame.

    The first is the face's own normal.
    """
    tilts, turns = [0.0], [0.0]
    for ring, tilt in enumerate(tol.vote_tilts):
        tilts += 10 * [tilt]
        turns += list(2 * np.pi * (np.arange(10) + 0.3 * ring) / 10)
    vectors = [np.cos(tilts), np.sin(tilts) * np.cos(turns), np.sin(tilts) * np.sin(turns)]
    return np.array(tilts, np.float32), np.stack(vectors, axis=1).astype(np.float32)


@dataclass(frozen=True)
class _Voters:
    """Observations of a vote, in the frames of their faces; float32.

    Attributes
    ----------
    face : (K,) of each.
    rows : (2, K, 3), for both kinds of light.
    towards : (K, 3), direction to the camera.
    turn_variance, base_variance : (2, K) of the row's angle about the ray, and of ``m . n`` beyond
        noise.
    dolp, sigma_dolp : (K,)
    """

    face: Indices
    rows: Floats
    towards: Floats
    turn_variance: Floats
    base_variance: Floats
    dolp: Floats
    sigma_dolp: Floats

    @classmethod
    def of(
        cls, observations: Observations, frames: Array, row_sigma: Floats, tol: LabelTolerances
    ) -> _Voters:
        """The voters of observations of a mesh whose faces have these frames (F, 3, 3)."""
        o = observations
        axes = frames[o.face].astype(np.float32)
        turn = np.minimum(o.turn_variance, 1e6).astype(np.float32)
        return cls(
            face=o.face,
            rows=np.stack([np.einsum("kai,ki->ka", axes, rows) for rows in o.rows]),
            towards=np.einsum("kai,ki->ka", axes, -o.rays),
            turn_variance=turn + np.float32(tol.vote_sigma**2),
            base_variance=np.broadcast_to(np.square(row_sigma, dtype=np.float32), turn.shape),
            dolp=o.dolp,
            sigma_dolp=o.sigma_dolp,
        )

    def only(self, kept: Mask) -> _Voters:
        """The ``kept`` (K,) voters."""
        return _Voters(
            face=self.face[kept],
            rows=self.rows[:, kept],
            towards=self.towards[kept],
            turn_variance=self.turn_variance[:, kept],
            base_variance=self.base_variance[:, kept],
            dolp=self.dolp[kept],
            sigma_dolp=self.sigma_dolp[kept],
        )

    def costs(self, candidates: Floats, num: int, tol: LabelTolerances) -> NDArray[np.float32]:
        """Sums (num, C) over the observations of each face, of the costs of candidates (C, 3)."""
        angles = np.linspace(0, 1.5, 256)
        table = fresnel_dolp(np.cos(angles), Light.DIFFUSE, tol.refractive_index) + 0.01
        found = np.zeros((num, len(candidates)), np.float32)
        for index, candidate in enumerate(candidates):
            cosine = self.towards @ candidate
            sine2 = 1 - np.clip(cosine, 0.02, 1) ** 2
            angle = np.minimum(np.arccos(np.clip(cosine, 0.02, 1)) + tol.angle_margin, 1.5)
            bound = table[(angle * (255 / 1.5)).astype(np.int64)] + 2 * self.sigma_dolp
            variance = self.base_variance + sine2 * self.turn_variance
            specular, diffuse = (self.rows @ candidate) ** 2 / variance
            is_diffuse = self.dolp <= 1.3 * bound
            best = np.where(is_diffuse, np.minimum(specular, diffuse), specular)
            best = np.where(cosine < 0.05, tol.max_cost, np.minimum(best, tol.max_cost))
            found[:, index] = np.bincount(self.face, best, num)
        return found
