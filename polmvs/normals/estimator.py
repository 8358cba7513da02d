"""Normals from stacked rows: the paper's eigenvector and a weighted robust estimator.

Everything is batched over points: arrays are component first, ``(3, K, N)`` for K rows of N
points, so that thousands of 3x3 problems are solved by a few vector operations.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats
from polmvs.fitting import CAUCHY_SCALE, annealed_scales, cauchy_weights
from polmvs.scene import MIN_FACING_COSINE


@dataclass(frozen=True, kw_only=True)
class EstimatorTolerances:
    """Tolerances of the robust estimator, and of rows that determine a normal.

    Attributes
    ----------
    min_sin_zenith : sine of the zenith angle that caps the weight of a row of a nearly frontal
        surface, which has little information. Guess.
    counted_weight : robust weight above which a row counts. Derived: four deviations off.
    num_rounds : of reweighting. Measured (tests): the change of later ones is below 0.01 deg.
    num_unbiased_rounds : after them. Measured: see ``num_rounds``.
    doubtful_loss : above it a point is tried again; about 0.12 without outliers. Guess.
    num_pairs : pairs of rows from which a doubtful point starts again. Derived: with three of ten
        rows wrong, all of 24 pairs contain a wrong row once in 3,000,000.
    min_rows_to_doubt : least number of counted rows; of fewer, some agree by chance. Guess.
    min_spread : of the rows, over the variance of their noise. Where all planes of incidence are
        one (camera centres and normal in one plane, as on a linear rail) the noise alone spreads
        them. Derived: their mean variance is more than this many times the expected one for fewer
        than 1 in 1000 of three rows (chi-squared of 3, over 3, is 5.4 there).
    min_rows : of a normal. Derived.
    min_conditioning : ratio of singular values below which rows count as parallel; for two rows it
        is half the sine of the small angle between them. Guess.
    """

    min_sin_zenith: float = 0.1
    counted_weight: float = 0.25
    num_rounds: int = 5
    num_unbiased_rounds: int = 3
    doubtful_loss: float = 0.25
    num_pairs: int = 24
    min_rows_to_doubt: int = 7
    min_spread: float = 6.0
    min_rows: int = 2
    min_conditioning: float = 0.02


TOL = EstimatorTolerances()


@dataclass(frozen=True, kw_only=True)
class NormalEstimate:
    """Normals of N points with their quality.

    Attributes
    ----------
    normals : (N, 3) float64, unit, frame of the rows, facing the viewers; NaN where not valid.
    valid : (N,) bool. False if fewer than two rows count; if only two of more given rows do, as any
        two agree; or if the rows leave a direction open, except for their noise.
    conditioning : (N,) ratio of the middle to the largest singular value of the weighted rows,
        0 for rows of rank 1, at most 1.
    sigma_deg : (N,) standard deviation along the larger axis of the covariance, degrees.
    residual : (N,) weighted root mean square of ``m . n``: sine of the angle to the planes of
        incidence.
    num_rows : (N,) int, rows that count, without outliers (weight below a quarter).
    row_weights : (K, N) robust weights in [0, 1].
    """

    normals: Array
    valid: NDArray[np.bool_]
    conditioning: Array
    sigma_deg: Array
    residual: Array
    num_rows: NDArray[np.int64]
    row_weights: Floats


def smallest_eigenvectors(matrices: Floats) -> tuple[Array, Array]:
    """Eigenvalues and the eigenvector of the smallest one of symmetric 3x3 matrices.

    Closed form (Smith 1961), one or two orders of magnitude faster than a LAPACK call per matrix.

    Parameters
    ----------
    matrices : (6, N), the entries xx, yy, zz, xy, xz, yz.

    Returns
    -------
    eigenvalues : (3, N) float64, ascending.
    eigenvectors : (3, N) float64, unit; arbitrary if the smallest eigenvalue is double.
    """
    xx, yy, zz, xy, xz, yz = np.asarray(matrices, np.float64)
    mean = (xx + yy + zz) / 3
    bxx, byy, bzz = xx - mean, yy - mean, zz - mean
    off = xy * xy + xz * xz + yz * yz
    spread = np.sqrt((bxx * bxx + byy * byy + bzz * bzz + 2 * off) / 6)
    det = bxx * (byy * bzz - yz * yz) - xy * (xy * bzz - yz * xz) + xz * (xy * yz - byy * xz)
    safe = np.maximum(spread, 1e-100)
    angle = np.arccos(np.clip(det / (2 * safe**3), -1, 1)) / 3
    largest = mean + 2 * spread * np.cos(angle)
    smallest = mean + 2 * spread * np.cos(angle + 2 * np.pi / 3)
    middle = 3 * mean - largest - smallest

    # The eigenvector spans the null space of A - smallest I: the longest cross product of rows.
    axx, ayy, azz = xx - smallest, yy - smallest, zz - smallest
    crosses = np.array(
        [
            [xy * yz - xz * ayy, xz * xy - axx * yz, axx * ayy - xy * xy],
            [xy * azz - xz * yz, xz * xz - axx * azz, axx * yz - xy * xz],
            [ayy * azz - yz * yz, yz * xz - xy * azz, xy * yz - ayy * xz],
        ]
    )
    norms = np.sqrt((crosses**2).sum(axis=1))
    best = norms.argmax(axis=0)
    columns = np.arange(crosses.shape[2])
    vectors = crosses[best, :, columns].T
    length = norms[best, columns]
    degenerate = ~(length > 1e-14 * np.maximum(spread, 1e-150) ** 2)
    vectors = np.where(degenerate, np.array([[0.0], [0.0], [1.0]]), vectors)
    vectors = vectors / np.where(degenerate, 1.0, length)
    return np.array([smallest, middle, largest]), vectors


def solve_normals(
    rows: Floats,
    rays: Floats,
    sigma: Floats,
    *,
    robust: bool = True,
    initial_normals: Floats | None = None,
) -> NormalEstimate:
    """Normals of N points from K rows each.

    The paper's estimator (``robust=False``) is the eigenvector of the smallest eigenvalue of
    ``M^T M`` over the usable rows with equal weights. The robust estimator weights rows by the
    inverse variance of their residual, ``(sin(theta) sigma)^2`` with theta the angle between normal
    and ray, and by a Cauchy loss. Both are re-estimated in ``num_rounds`` rounds. The row of a view
    from behind the surface is ignored. A point whose rows disagree starts again from pairs of its
    rows: of ten rows, three may be wrong.

    Parameters
    ----------
    rows : (3, K, N), unit, any one frame per point; NaN rows are left out.
    rays : (3, K, N), unit, same frame, from the cameras towards the points.
    sigma : (K, N), standard deviation of the row's rotation about its ray, radians; infinite or
        NaN: the row is ignored.
    robust : weighted robust estimator, or the paper's.
    initial_normals : (3, N), NaN where unknown: a start, which decides the views that face the
        point before its first solution.
    """
    if rows.ndim != 3 or rows.shape[0] != 3 or rows.shape != rays.shape:
        raise ValueError(f"{rows.shape=}, {rays.shape=} but expected two (3, K, N).")
    if sigma.shape != rows.shape[1:]:
        raise ValueError(f"{sigma.shape=} but expected {rows.shape[1:]}.")
    usable = np.isfinite(sigma) & (sigma > 0) & np.isfinite(rows).all(axis=0)
    rows = np.where(usable, rows, 0)
    precision = np.where(usable, 1 / np.where(usable, sigma, 1) ** 2, 0)
    weights = precision if robust else usable.astype(rows.dtype)
    facing, outlier_weights = usable, usable.astype(rows.dtype)
    if initial_normals is not None:
        cosine = _dot(rays, initial_normals)
        weights = weights * ~(cosine > 0)  # NaN: unknown, kept
    normals = _smallest(rows, weights)[1]
    if robust:
        problem = _Problem(rows, rays, precision, weights)
        normals = problem.iterate(normals, annealed_scales(TOL.num_rounds))
        normals = problem.try_again(normals)
        normals = problem.unbiased(normals)
        weights, outlier_weights = problem.weights(normals, CAUCHY_SCALE)
        facing = outlier_weights > 0
    moments = _moments(rows, weights)
    if robust:
        moments -= problem.gained(normals, CAUCHY_SCALE)
    estimate = _describe(rays, weights, outlier_weights, moments)
    kept = precision * (outlier_weights > TOL.counted_weight)
    determined = _spread(rows, kept, alike=not robust) > TOL.min_spread
    determined &= (estimate.num_rows > 2) | (facing.sum(axis=0) <= 2)
    estimate = _only(estimate, determined)
    if robust:
        return estimate
    sigma = _algebraic_sigma(rows, rays, precision, estimate.normals.T, TOL.min_sin_zenith)
    return replace(estimate, sigma_deg=np.degrees(sigma, dtype=np.float64))


@dataclass(frozen=True)
class _Problem:
    """Rows and rays (3, K, N), precisions (K, N), 0 where a row does not count.

    ``votes`` (K, N) are the rows' votes on which side of the surface the viewers are.
    """

    rows: Floats
    rays: Floats
    precision: Floats
    votes: Floats

    def iterate(self, normals: Array, scales: Iterable[float]) -> Array:
        """Reweight and solve again, a round for each scale of the loss."""
        for scale in scales:
            normals = _smallest(self.rows, self.weights(normals, scale)[0])[1]
        return normals

    def unbiased(self, normals: Array) -> Array:
        """Minimize the squared errors over their variances, which depend on the normal.

        Reweighting alone ignores the derivative of the variances and biases normals towards the
        rays, for short arcs by more than their deviation. The fundamental numerical scheme
        (Chojnacki et al., PAMI 2000) includes it.
        """
        for _ in range(TOL.num_unbiased_rounds):
            moments = _moments(self.rows, self.weights(normals, CAUCHY_SCALE)[0])
            normals = smallest_eigenvectors(moments - self.gained(normals, CAUCHY_SCALE))[1]
        return normals

    def gained(self, normals: Array, scale: float) -> Array:
        """Contribution of the derivative of the variances to the moments (6, N)."""
        z2, sin2, visible = self._errors(normals)
        share = np.where(visible, z2 * cauchy_weights(z2, scale), 0) / sin2
        moments = -_moments(self.rays, share)
        moments[:3] += share.sum(axis=0, dtype=np.float64)
        return moments

    def weights(self, normals: Array, scale: float) -> tuple[Floats, Floats]:
        """Weights (K, N) of the squared ``m . n``, and their robust part in [0, 1]."""
        z2, sin2, visible = self._errors(normals)
        robust = np.where(visible, cauchy_weights(z2, scale), 0)
        return self.precision / sin2 * robust, robust

    def losses(self, normals: Array) -> Floats:
        """Mean of ``z^2 / (z^2 + c^2)`` (N,) over the rows that count, 1 where one is not seen.

        Bounded, unlike the minimized loss: it measures the number of rows that agree.
        """
        z2, _, visible = self._errors(normals)
        counted = self.precision > 0
        loss = np.where(visible, z2 / (z2 + CAUCHY_SCALE**2), 1) * counted
        return np.asarray(loss.sum(axis=0) / np.maximum(counted.sum(axis=0), 1))

    def try_again(self, normals: Array) -> Array:
        """Start points that are badly explained again from pairs of rows; the better one stays."""
        losses = self.losses(normals)
        enough = (self.precision > 0).sum(axis=0) >= TOL.min_rows_to_doubt
        where = np.flatnonzero((losses > TOL.doubtful_loss) & enough)
        if len(where) == 0:
            return normals
        some = _Problem(
            self.rows[..., where],
            self.rays[..., where],
            self.precision[..., where],
            self.votes[..., where],
        )
        # A pair of correct rows is near enough to the solution: no wide loss is needed.
        scales = (s for s in annealed_scales(TOL.num_rounds) if s == CAUCHY_SCALE)
        again = some.iterate(some._best_pair(normals[:, where]), scales)
        better = some.losses(again) < losses[where]
        improved = normals.copy()
        improved[:, where[better]] = again[:, better]
        return improved

    def _best_pair(self, normals: Array) -> Array:
        """Of the normals given and those of pairs of rows, the ones of least loss (3, N)."""
        best, least = normals.copy(), self.losses(normals)
        rng = np.random.default_rng(0)
        # Rows that count come first in this order, so that no pair is wasted on others.
        order = np.argsort(self.precision <= 0, axis=0, kind="stable")
        count = (self.precision > 0).sum(axis=0)
        points = np.arange(len(count))
        min_sine = 2 * TOL.min_conditioning
        for _ in range(TOL.num_pairs):
            first, step = rng.random((2, len(count)))
            i = np.floor(first * count).astype(np.int64)
            j = (i + 1 + np.floor(step * (count - 1)).astype(np.int64)) % count
            a, b = (self.rows[:, order[k, points], points] for k in (i, j))
            candidate = np.cross(a, b, axis=0).astype(np.float64)
            length = np.linalg.norm(candidate, axis=0)
            candidate /= np.maximum(length, min_sine)
            losses = np.where(length > min_sine, self.losses(candidate), np.inf)
            better = losses < least
            best[:, better], least[better] = candidate[:, better], losses[better]
        return best

    def _errors(self, normals: Array) -> tuple[Floats, Floats, NDArray[np.bool_]]:
        """Squared error over sigma, squared sine of the zenith angle, and who sees the point."""
        cosine = _dot(self.rays, normals)
        facing = np.sign((cosine * self.votes).sum(axis=0))
        visible = (self.precision > 0) & (cosine * facing > MIN_FACING_COSINE)
        sin2 = np.maximum(1 - cosine**2, TOL.min_sin_zenith**2)
        return _dot(self.rows, normals) ** 2 * self.precision / sin2, sin2, visible


def _dot(rows: Floats, normals: Floats) -> Floats:
    """``m . n`` for rows (3, K, N) and normals (3, N)."""
    n = normals.astype(rows.dtype, copy=False)
    return np.asarray(rows[0] * n[0] + rows[1] * n[1] + rows[2] * n[2])


def _smallest(rows: Floats, weights: Floats) -> tuple[Array, Array]:
    """Eigenvalues and smallest eigenvector of the weighted ``M^T M``."""
    return smallest_eigenvectors(_moments(rows, weights))


def _moments(rows: Floats, weights: Floats) -> Array:
    """Elements (6, N) of the weighted ``M^T M``: xx, yy, zz, xy, xz, yz."""
    x, y, z = rows
    wx, wy, wz = weights * x, weights * y, weights * z
    products = (wx * x, wy * y, wz * z, wx * y, wx * z, wy * z)
    return np.array([p.sum(axis=0, dtype=np.float64) for p in products])


def _describe(
    rays: Floats,
    weights: Floats,
    outlier_weights: Floats,
    moments: Array,
) -> NormalEstimate:
    """Final solution with its sign, conditioning, covariance and validity."""
    eigenvalues, normals = smallest_eigenvectors(moments)
    num_rows = (outlier_weights > TOL.counted_weight).sum(axis=0)
    total = weights.sum(axis=0, dtype=np.float64)
    with np.errstate(invalid="ignore", divide="ignore"):
        conditioning = np.sqrt(np.maximum(eigenvalues[1], 0) / eigenvalues[2])
        residual = np.sqrt(np.maximum(eigenvalues[0], 0) / total)
        # The precision matrix of the normal on its tangent plane is M^T W M itself.
        sigma_deg = np.degrees(1 / np.sqrt(eigenvalues[1]))
    facing = (_dot(rays, normals) * weights).sum(axis=0)
    normals = np.where(facing > 0, -normals, normals)
    valid = (num_rows >= TOL.min_rows) & (conditioning >= TOL.min_conditioning) & (total > 0)
    return NormalEstimate(
        normals=np.where(valid, normals, np.nan).T,
        valid=valid,
        conditioning=np.where(total > 0, conditioning, 0.0),
        sigma_deg=np.where(valid, sigma_deg, np.nan),
        residual=np.where(valid, residual, np.nan),
        num_rows=num_rows,
        row_weights=outlier_weights,
    )


def _spread(rows: Floats, precision: Floats, *, alike: bool) -> Array:
    """Middle eigenvalue (N,) of the mean of ``m m^T`` over the variance of the rows' noise.

    Rows are weighted by their precision, or alike, but not by their angle to the normal: under
    those weights the noise of frontal rows would pass for spread.
    """
    counted = precision > 0
    weights = counted.astype(rows.dtype) if alike else precision
    variance = np.divide(weights, precision, out=np.zeros_like(weights), where=counted)
    noise = variance.sum(axis=0, dtype=np.float64)
    middle = _smallest(rows, weights)[0][1]
    return np.asarray(np.divide(middle, noise, out=np.zeros_like(middle), where=noise > 0))


def _only(estimate: NormalEstimate, kept: NDArray[np.bool_]) -> NormalEstimate:
    """The estimate with no normal at other points."""
    valid = estimate.valid & kept
    return replace(
        estimate,
        normals=np.where(valid[:, None], estimate.normals, np.nan),
        valid=valid,
        sigma_deg=np.where(valid, estimate.sigma_deg, np.nan),
        residual=np.where(valid, estimate.residual, np.nan),
    )


def _algebraic_sigma(
    rows: Floats, rays: Floats, precision: Floats, normals: Array, min_sin_zenith: float
) -> Array:
    """Deviation (N,) of a solution with all weights alike along its larger axis, rad.

    The covariance on the tangent plane is ``A^-1 B A^-1`` with ``A = M^T M`` and B the same with
    each row weighted by the variance of its residual.
    """
    least = np.eye(3)[np.argmin(np.abs(np.nan_to_num(normals)), axis=0)].T
    first = np.cross(normals, least, axis=0)
    first /= np.linalg.norm(first, axis=0)
    a, b = _dot(rows, first), _dot(rows, np.cross(normals, first, axis=0))
    sin2 = np.maximum(1 - _dot(rays, normals) ** 2, min_sin_zenith**2)
    variance = np.divide(sin2, precision, out=np.zeros_like(sin2), where=precision > 0)
    products = (a * a, a * b, b * b)
    aa, ab, bb = (p.sum(axis=0, dtype=np.float64) for p in products)
    noise = [(p * variance).sum(axis=0, dtype=np.float64) for p in products]
    with np.errstate(divide="ignore", invalid="ignore"):
        inverse = np.array([[bb, -ab], [-ab, aa]]) / (aa * bb - ab * ab)
        middle = np.array([noise[:2], noise[1:]])
        (xx, xy), (_, yy) = np.einsum("ijn,jkn,kln->iln", inverse, middle, inverse)
        return np.asarray(np.sqrt(0.5 * (xx + yy) + np.hypot(0.5 * (xx - yy), xy)))
