"""Normals of points whose observations may be specular, diffuse, or neither.

The search tries directions over the whole sphere with both labels open. It ranks them by the
likelihood of the views that certainly see the point (:mod:`polmvs.polarization.light_mixture`).
The best few distinct directions are refined by expectation maximization, labels and normal in turn,
with all views that face them. Then they are compared: if two labelings explain the observations
about equally, the deviation of the normal includes both.

Everything is batched over points: arrays are component first, ``(3, K, N)``. The time of the search
grows with the observations, that of the refinement with views times points.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats, Mask
from polmvs.fitting import MEDIAN_OF_NORMAL
from polmvs.normals.estimator import NormalEstimate, smallest_eigenvectors
from polmvs.normals.observations import PointObservations
from polmvs.polarization.light_mixture import (
    LightMixtureTolerances,
    LightShares,
    light_shares,
    residual_variance,
    row_precisions,
)
from polmvs.scene import MIN_FACING_COSINE

TRIED_AT_A_TIME = 2_000_000  # observations times directions: 100 MB
PAIRS = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))


@dataclass(frozen=True, kw_only=True)
class MixtureTolerances:
    """Tolerances of the search for normals, and of their validity.

    Attributes
    ----------
    light : prior assumptions about the light.
    num_directions : tried directions over the whole sphere. Derived: neighbours are 9 deg apart.
    direction_sigma : rad, error of a tried direction. Derived: over half the neighbours' distance.
    num_modes : number of best directions that are refined. Guess.
    hopeless : log-likelihood below the best at which a direction is not refined. Guess: more than
        refinement gains.
    apart : rad, least angle between modes. Guess: the width of the likelihood of a few rows.
    num_rounds : of refinement; the assumed error of the normal shrinks over the first ones. Guess.
    prior_rows : weight of the stated noise against a point's own scatter, in rows. Guess.
    correlation : of the errors of a point's rows: marks and reflections about it, gains and the
        model are the same for all views. Measured: see ``docs``.
    clear_turn : rad, largest deviation of rows from which scales are estimated. Guess.
    min_scale_rows : least number of such rows of a point, and of all points. Guess.
    prior_scale_rows : weight of the common scale against a view's own rows, in rows. Guess.
    min_rows : of a normal, sum of their labels' certainty. Derived: two planes of incidence
        intersect, neither quite certain.
    min_explained : share of the observations of views that certainly see the point which one of
        the two kinds of light explains. Derived: the majority.
    max_noise_ratio : of the noise in the spread of the rows, in its deviations. Derived: chance of
        1 in 1000.
    max_sigma_deg : of a valid normal. Guess.
    """

    light: LightMixtureTolerances = LightMixtureTolerances()
    num_directions: int = 500
    direction_sigma: float = 0.1
    num_modes: int = 4
    hopeless: float = 12.0
    apart: float = 0.35
    num_rounds: int = 6
    prior_rows: float = 6.0
    correlation: float = 0.3
    clear_turn: float = 0.3
    min_scale_rows: int = 5
    prior_scale_rows: float = 20.0
    min_rows: float = 1.5
    min_explained: float = 0.5
    max_noise_ratio: float = 3.0
    max_sigma_deg: float = 15.0


@dataclass(frozen=True, kw_only=True)
class MixtureEstimate(NormalEstimate):
    """Normals with their quality and light.

    ``sigma_deg`` includes noise, the scatter of the point's own rows, and every other normal that
    explains the observations about as well. ``num_rows`` is the number of observations that one of
    the two kinds of light explains.

    Attributes
    ----------
    specular, diffuse : (N,) in [0, 1], mean probability of the label over the observations of views
        that the normal faces; the rest is neither. NaN where not valid.
    dolp : (N,) median DoLP of those observations. NaN where not valid.
    labels : (K, N) probability of specular light minus that of diffuse light of each observation; 0
        for views that the normal does not face.
    log_likelihood : (N,), of the observations relative to chance, at the best normal.
    """

    specular: Array
    diffuse: Array
    dolp: Array
    labels: Floats
    log_likelihood: Array


@dataclass(frozen=True)
class RowScales:
    """Factors from the stated deviations of the rows of a capture to the actual ones.

    Attributes
    ----------
    of_views : (K,), at least 1: a view with a wrong pose or image gets less weight.
    overall : at most 1: of all rows, if their errors are smaller than stated.
    """

    of_views: Array
    overall: float = 1.0


def solve_mixture(
    observations: PointObservations,
    matched: Mask,
    *,
    prior_specular: float = 0.5,
    scales: RowScales | None = None,
    tolerances: MixtureTolerances = MixtureTolerances(),
) -> MixtureEstimate:
    """Normals of N points from K observations each, with unknown light.

    Parameters
    ----------
    observations : of the points.
    matched : (K, N) bool, views that certainly see the point. Others are used once a normal is
        known that faces them.
    prior_specular : 0.5; 1 or 0 if the light of all observations is known.
    scales : of the rows' deviations, see :func:`row_scales`; None: as stated.
    tolerances : of this step.
    """
    t = tolerances
    scales = scales or RowScales(np.ones(len(matched)))
    stated = observations.turn_variances
    scaled = np.asarray(stated * np.square(scales.of_views)[:, None], stated.dtype)
    observations = replace(observations, turn_variances=scaled)
    problem = _MixtureProblem(observations, matched, prior_specular, t)
    starts = problem.best_directions()
    num_points = matched.shape[1]
    normals = np.zeros((len(starts), 3, num_points))
    likelihoods = np.full((len(starts), num_points), -np.inf)
    for index, (directions, scores) in enumerate(starts):
        where = np.flatnonzero(scores > starts[0][1] - t.hopeless)
        mode = problem.some(where).refined(directions[:, where])
        normals[index][:, where], likelihoods[index, where] = mode.normals, mode.log_likelihood
    best = likelihoods.argmax(axis=0)
    chosen = normals[best, :, np.arange(num_points)].T
    # Modes that converged to one normal count once.
    angles = np.arccos(np.clip(np.einsum("min,in->mn", normals, chosen), -1, 1))
    weights = np.exp(likelihoods - likelihoods.max(axis=0))
    for index in range(len(starts)):
        earlier = np.einsum("min,in->mn", normals[:index], normals[index])
        weights[index] *= ~(earlier > np.cos(0.5 * t.apart)).any(axis=0)
    weights *= angles > 0.5 * t.apart
    elsewhere = (weights * np.square(angles)).sum(axis=0) / (1 + weights.sum(axis=0))
    return problem.described(problem.weighed(chosen), elsewhere, scales.overall)


def row_scales(
    observations: PointObservations,
    matched: Mask,
    estimate: MixtureEstimate,
    *,
    tolerances: MixtureTolerances = MixtureTolerances(),
) -> RowScales:
    """Actual over stated deviation of the rows about the normals, of each view and of all.

    Parameters
    ----------
    observations, matched : of some points, as :func:`solve_mixture` takes them.
    estimate : their normals, solved without scales.
    """
    t = tolerances
    normals = np.nan_to_num(estimate.normals).T.astype(np.float32)
    cosines = -np.einsum("ikn,in->kn", observations.rays, normals)
    sin2 = np.maximum(1 - np.square(cosines), t.light.min_sine**2)
    residuals = np.einsum("likn,in->lkn", observations.rows, normals)
    turns = observations.turn_variances
    with np.errstate(invalid="ignore"):
        squares = np.nanmin(
            np.nan_to_num(np.square(residuals) / (turns * sin2), nan=np.inf), axis=0
        )
    # A row without information has no residual; two rows of each point always fit exactly.
    num_rows = (np.abs(estimate.labels) > 0.5).sum(axis=0)
    clear = matched & estimate.valid & (num_rows >= t.min_scale_rows)
    clear &= (turns[0] < t.clear_turn**2) & (cosines > MIN_FACING_COSINE)
    squares = np.where(clear, squares, 0) * (num_rows / np.maximum(num_rows - 2.0, 1.0))
    if clear.sum() < t.prior_scale_rows:
        return RowScales(np.ones(len(matched)))
    overall = float(np.median(squares[clear])) / MEDIAN_OF_NORMAL**2
    of_views = np.full(len(matched), overall)
    for k in np.flatnonzero(clear.any(axis=1)):
        own = squares[k, clear[k]]
        share = len(own) / (len(own) + t.prior_scale_rows)
        of_views[k] += share * (float(np.median(own)) / MEDIAN_OF_NORMAL**2 - overall)
    return RowScales(np.sqrt(np.maximum(of_views, 1)), float(np.sqrt(min(overall, 1))))


@dataclass(frozen=True)
class _Mode:
    """A normal of every point (3, N), and what follows from it.

    ``shares`` (K, N) of its labels, ``counted`` (K, N) who faces it, ``precisions`` and
    ``residuals`` (2, K, N) of either row, ``log_likelihood`` (N,).
    """

    normals: Array
    shares: LightShares
    counted: Mask
    precisions: Floats
    residuals: Floats
    log_likelihood: Array


class _MixtureProblem:
    """Observations of which nothing is NaN, and who surely sees a point."""

    def __init__(
        self, found: PointObservations, matched: Mask, prior_specular: float, t: MixtureTolerances
    ) -> None:
        self.known = np.isfinite(found.turn_variances[0]) & np.isfinite(found.rows[0, 0])
        self.rows = np.where(self.known, found.rows, 0)
        self.rays, self.turns = found.rays, found.turn_variances
        self.dolp, self.dolp_variance = found.dolp, found.dolp_variance
        self.matched = matched & self.known
        self.prior_specular, self.t = prior_specular, t

    def some(self, points: NDArray[np.intp]) -> _MixtureProblem:
        """The problem of some of the points."""
        if len(points) == self.matched.shape[1]:
            return self
        stated = (self.rows, self.rays, self.turns, self.dolp, self.dolp_variance)
        found = PointObservations(*stated).some(points)
        return _MixtureProblem(found, self.matched[:, points], self.prior_specular, self.t)

    def best_directions(self) -> list[tuple[Array, Floats]]:
        """Normals (3, N) of most likelihood with it (N,), then those of most apart, and so on."""
        t = self.t
        directions = _directions(t.num_directions)
        near = directions @ directions.T > np.cos(t.apart)
        scores = self._scores(directions.T.astype(np.float32))
        found = []
        for _ in range(t.num_modes):
            best = scores.argmax(axis=1)
            found.append((directions[best].T, scores[np.arange(len(best)), best]))
            scores[near[best]] = -np.inf
        return found

    def _scores(self, directions: NDArray[np.float32]) -> NDArray[np.float32]:
        """Log-likelihoods (N, D) of directions (3, D) by the views that match each point."""
        points, views = np.nonzero(self.matched.T)  # in the order of the points
        scores = np.zeros((self.matched.shape[1], directions.shape[1]), np.float32)
        step = max(1, TRIED_AT_A_TIME // directions.shape[1])
        for start in range(0, len(points), step):
            k, n = views[start : start + step], points[start : start + step]
            specular, diffuse = (np.ascontiguousarray(rows[:, k, n].T) for rows in self.rows)
            cosines = -(np.ascontiguousarray(self.rays[:, k, n].T) @ directions)
            shares = light_shares(
                (specular @ directions, diffuse @ directions),
                (self.turns[0, k, n][:, None], self.turns[1, k, n][:, None]),
                cosines,
                self.dolp[k, n][:, None],
                self.dolp_variance[k, n][:, None],
                normal_variance=self.t.direction_sigma**2,
                prior_specular=self.prior_specular,
                tolerances=self.t.light,
            )
            likelihoods = np.where(
                cosines > MIN_FACING_COSINE, shares.log_likelihood, self._unseen
            ).astype(np.float32)
            first = np.flatnonzero(np.diff(n, prepend=-1))
            scores[n[first]] += np.add.reduceat(likelihoods, first, axis=0)
        return scores

    @property
    def _unseen(self) -> float:
        """Log-likelihood of a view that matched a point whose normal faces away from it."""
        return 2 * float(np.log(self.t.light.neither_share))

    def refined(self, normals: Array) -> _Mode:
        """Labels and normals (3, N) in turn."""
        t = self.t
        sigmas = np.linspace(t.direction_sigma, 0, t.num_rounds - 1)
        for sigma in sigmas:
            mode = self.weighed(normals, float(sigma))
            solved = smallest_eigenvectors(self._moments(mode.precisions))[1]
            solved = np.where((solved * normals).sum(axis=0) < 0, -solved, solved)
            # Where nothing has weight, any normal would do: it stays.
            normals = np.where(mode.precisions.sum(axis=(0, 1)) > 0, solved, normals)
        return self.weighed(normals)

    def weighed(self, normals: Array, sigma: float = 0.0) -> _Mode:
        """Labels and weights under normals (3, N) of that deviation, rad."""
        n = normals.astype(np.float32)
        cosines = -np.einsum("ikn,in->kn", self.rays, n)
        residuals = np.einsum("likn,in->lkn", self.rows, n)
        counted = self.known & (cosines > MIN_FACING_COSINE)
        shares = light_shares(
            (residuals[0], residuals[1]),
            (self.turns[0], self.turns[1]),
            cosines,
            self.dolp,
            self.dolp_variance,
            normal_variance=sigma**2,
            prior_specular=self.prior_specular,
            tolerances=self.t.light,
        )
        sin2 = np.maximum(1 - np.square(cosines), self.t.light.min_sine**2)
        variances = residual_variance(self.turns, sin2, sigma**2)
        precisions = np.stack(row_precisions(shares, (variances[0], variances[1]))) * counted
        unseen = np.where(self.matched, self._unseen, 0)
        likelihood = np.where(counted, shares.log_likelihood, unseen)
        return _Mode(
            normals=normals,
            shares=shares,
            counted=counted,
            precisions=precisions,
            residuals=residuals,
            log_likelihood=likelihood.sum(axis=0, dtype=np.float64),
        )

    def _moments(self, precisions: Floats) -> Array:
        """Weighted sums (6, N) of ``m m^T``, as :func:`smallest_eigenvectors` takes them."""
        rows = self.rows
        sums = [
            (precisions * rows[:, i] * rows[:, j]).sum(axis=(0, 1), dtype=np.float64)
            for i, j in PAIRS
        ]
        return np.array(sums)

    def described(self, mode: _Mode, elsewhere: Array, overall: float) -> MixtureEstimate:
        """The estimate of a mode.

        Parameters
        ----------
        elsewhere : (N,), the variance by other modes, rad^2.
        overall : deviation of the rows over the stated one.
        """
        t, precisions = self.t, mode.precisions
        moments = self._moments(precisions)
        eigenvalues = smallest_eigenvectors(moments)[0]
        along = _middle_directions(moments, mode.normals, eigenvalues[1])
        middle = np.maximum(eigenvalues[1], 0)
        spread = self._spread(mode, along, middle)
        total = precisions.sum(axis=(0, 1), dtype=np.float64)
        squares = (precisions * np.square(mode.residuals)).sum(axis=(0, 1), dtype=np.float64)
        certain = np.abs(mode.shares.specular - mode.shares.diffuse) * mode.counted
        num_certain = certain.sum(axis=0, dtype=np.float64)
        # Rows that scatter more than their noise make the normal less certain.
        squares_of_scale = squares / overall**2
        scatter = squares_of_scale + t.prior_rows
        scatter /= np.maximum(num_certain - 2, 0) + t.prior_rows
        # What rows of a point have in common is not averaged out.
        factor = np.maximum(scatter, 1) * overall**2
        factor *= 1 + t.correlation * np.maximum(num_certain - 1, 0)
        with np.errstate(divide="ignore", invalid="ignore"):
            variance = factor * middle / np.square(spread) + elsewhere
            conditioning = np.sqrt(middle / eigenvalues[2])
            residual = np.sqrt(squares / total)
            sigma_deg = np.degrees(np.sqrt(variance))
        explained_share = 1 - (mode.shares.neither * self.matched).sum(axis=0) / np.maximum(
            self.matched.sum(axis=0), 1
        )
        valid = (num_certain >= t.min_rows) & (explained_share > t.min_explained)
        valid &= (total > 0) & (spread > 0) & (sigma_deg < t.max_sigma_deg)
        explained = (mode.shares.specular + mode.shares.diffuse > 0.5) & mode.counted
        count = np.maximum(mode.counted.sum(axis=0), 1)
        dolp = np.where(mode.counted, self.dolp, np.nan)
        dolp[:, ~valid] = 0

        def where_valid(values: Floats) -> Array:
            return np.where(valid, values, np.nan)

        return MixtureEstimate(
            normals=where_valid(mode.normals).T,
            valid=valid,
            conditioning=np.where(total > 0, conditioning, 0.0),
            sigma_deg=where_valid(sigma_deg),
            residual=where_valid(residual),
            num_rows=explained.sum(axis=0),
            row_weights=(1 - mode.shares.neither) * mode.counted,
            specular=where_valid((mode.shares.specular * mode.counted).sum(axis=0) / count),
            diffuse=where_valid((mode.shares.diffuse * mode.counted).sum(axis=0) / count),
            dolp=where_valid(np.nanmedian(dolp, axis=0)),
            labels=(mode.shares.specular - mode.shares.diffuse) * mode.counted,
            log_likelihood=mode.log_likelihood,
        )

    def _spread(self, mode: _Mode, along: Array, middle: Array) -> Array:
        """Information (N,) on the least known direction less what noise alone makes of it.

        Where all planes of incidence are one (camera centres and normal in a plane, as on a rail)
        the noise of the rows spreads them all the same. It is 0 where it may be noise alone.
        """
        turned = np.cross(self.rays[None], self.rows, axisa=1, axisb=1, axisc=1)
        levers = np.square(np.einsum("likn,in->lkn", turned, along.astype(np.float32)))
        noise = mode.precisions * np.where(self.known, self.turns, 0) * levers
        mean = noise.sum(axis=(0, 1), dtype=np.float64)
        deviation = np.sqrt(2 * np.square(noise).sum(axis=(0, 1), dtype=np.float64))
        spread = middle - mean
        return np.where(spread > self.t.max_noise_ratio * deviation, spread, 0)


def _middle_directions(moments: Array, normals: Array, middle: Array) -> Array:
    """Unit tangents (3, N) along which sums (6, N) of ``m m^T`` have their middle eigenvalue."""
    xx, yy, zz, xy, xz, yz = moments
    shifted = np.array([[xx - middle, xy, xz], [xy, yy - middle, yz], [xz, yz, zz - middle]])
    largest = np.linalg.norm(shifted, axis=1).argmax(axis=0)
    # What is left of a row is perpendicular to that direction, and so is the normal.
    row = np.take_along_axis(shifted, largest[None, None], axis=0)[0]
    row = row / np.maximum(np.abs(row).max(axis=0), 1e-300)  # whose square may be too small
    along = np.cross(normals, row, axis=0)
    length = np.linalg.norm(along, axis=0)
    return np.asarray(along / np.maximum(length, 1e-12))


@lru_cache(maxsize=2)
def _directions(num: int) -> Array:
    """Evenly spread unit vectors (num, 3): a spiral of the golden angle."""
    index = np.arange(num) + 0.5
    z, angle = 1 - 2 * index / num, np.pi * (1 + 5**0.5) * index
    radius = np.sqrt(1 - z * z)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1)
