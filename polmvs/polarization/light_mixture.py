r"""Classification of each observation as specular light, diffuse light or neither.

An observation is the measurement of one point in one view: ``p = (s1, s2) / s0``, with noise of
variance v in each component. Its angle fits a normal n as specular light, ``m_s . n = 0``, or as
diffuse light, ``m_d . n = 0``; the two rows m differ by a rotation of 90 degrees about the ray.
With the rotation psi about the ray between plane of incidence and normal,
``m . n = sin(theta) sin(psi)``, where theta is the angle between normal and ray.

Likelihood
----------
With Gaussian noise of p, psi has a von Mises distribution on twice the angle, ``exp(kappa cos 2
psi) / (pi I0(kappa))`` with ``kappa = 1 / (4 var(psi))``, and ``kappa cos 2 psi = kappa - (m . n)^2
/ (2 var(m . n))``, ``var(m . n) = sin^2(theta) var(psi)``. A certain observation has the Gaussian
density of its residual. With less polarization the density becomes uniform, and the observation
gives neither a normal nor a label. "Neither" (light reflected twice, marks, polarized surroundings)
has the uniform density ``1 / pi``.

Degree of polarization
----------------------
Light of both kinds mixes, and their polarizations subtract: the measured DoLP is between zero and
that of one kind alone at this theta, by Fresnel's equations. So a DoLP is evidence only as an upper
bound: ``P(rho <= bound(theta))``, with the noise of rho, the error of theta and a refractive index
between two limits.

The functions take and return arrays of any common shape.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from polmvs.arrays import Array, Floats
from polmvs.polarization.fresnel import fresnel_dolp
from polmvs.polarization.kinds import Light

TABLE_SIZE = 512  # number of cosines in the table of bounds
NUM_IORS = 7
LOGISTIC_SCALE = 1.702  # of a logistic distribution that comes nearest to the normal one (Camilli)


@dataclass(frozen=True, kw_only=True)
class LightMixtureTolerances:
    """Prior assumptions about light and surface.

    Attributes
    ----------
    neither_share : of all observations. Guess.
    min_ior, max_ior : limits of the uniformly distributed refractive index of dielectrics. Derived:
        water 1.33, plastics, glazes, lacquers and glass 1.45 to 1.6, dense glass 1.7.
    dolp_margin : by which a bound may be exceeded in addition to noise: reflections of polarized
        light, another model of the surface. Guess.
    model_sigma : rad; error of the phase of strongly polarized light that noise does not explain.
        Measured on the shared captures.
    mixture_sigma : rad times DoLP; light of a second reflection turns the phase by this over the
        DoLP. Measured on the shared captures.
    min_sine : of theta. A surface seen frontally has no plane of incidence. Guess.
    """

    neither_share: float = 0.15
    min_ior: float = 1.4
    max_ior: float = 1.7
    dolp_margin: float = 0.02
    model_sigma: float = 0.014
    mixture_sigma: float = 0.006
    min_sine: float = 0.05


class LightShares(NamedTuple):
    """Probabilities of the three labels, which sum to one, and the likelihood of an observation.

    Attributes
    ----------
    specular, diffuse, neither : (...) in [0, 1].
    log_likelihood : (...) of the observation's angle and DoLP over that of an angle by chance: 0
        where nothing is polarized, at least ``log(neither_share)``.
    """

    specular: Floats
    diffuse: Floats
    neither: Floats
    log_likelihood: Floats


def phase_variance(
    dolp: Floats,
    variance: Floats,
    *,
    tolerances: LightMixtureTolerances = LightMixtureTolerances(),
) -> Floats:
    """Variance (...) of a phase, rad^2: noise, the model's error and light of other reflections.

    Infinite where the DoLP does not exceed that of unpolarized light with noise. (The mean square
    of a measured DoLP is too large by twice the variance of the noise.)

    Parameters
    ----------
    dolp : (...), as measured.
    variance : (...), of ``s1 / s0`` and of ``s2 / s0``.
    """
    t = tolerances
    signal = np.maximum(np.square(dolp) - 2 * variance, 0)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        found = t.model_sigma**2 + (t.mixture_sigma**2 + variance / 4) / signal
    return np.where(signal > 0, found, np.inf).astype(np.result_type(dolp), copy=False)


def light_shares(
    residuals: tuple[Floats, Floats],
    turn_variances: tuple[Floats, Floats],
    cosines: Floats,
    dolp: Floats,
    dolp_variance: Floats,
    *,
    normal_variance: Floats | float = 0.0,
    prior_specular: Floats | float = 0.5,
    tolerances: LightMixtureTolerances = LightMixtureTolerances(),
) -> LightShares:
    """Probabilities of an observation's labels, given a normal.

    All arrays broadcast to one shape (...).

    Parameters
    ----------
    residuals : ``m . n`` of the specular and of the diffuse plane of incidence, m and n unit.
    turn_variances : of either plane's rotation about the ray, rad^2: :func:`phase_variance` times
        the square of the rotation per phase. Infinite where unknown: residuals may be NaN there.
    cosines : of the angle theta between the normal and the direction to the viewer.
    dolp, dolp_variance : measured, and its variance.
    normal_variance : of the normal along either direction, rad^2; 0 for a hypothesis.
    prior_specular : probability that light is specular, if it is one of the two: 1 if the user
        says so, else for example that of the neighbours.
    tolerances : of this step.
    """
    t = tolerances
    cosines = np.asarray(cosines)
    sin2 = np.maximum(1 - np.square(cosines), t.min_sine**2)
    # Single precision stays so: NumPy's own numbers of double precision would widen all.
    prior = np.asarray(prior_specular, np.result_type(cosines, dolp))
    log_neither, log_either = math.log(t.neither_share), math.log1p(-t.neither_share)
    with np.errstate(divide="ignore"):
        priors = np.log(prior), np.log1p(-prior)
    parts = []
    for light, log_prior, residual, turn in zip(
        (Light.SPECULAR, Light.DIFFUSE), priors, residuals, turn_variances, strict=True
    ):
        density = angle_log_density(residual, turn, sin2, normal_variance)
        bound = dolp_log_evidence(
            light, dolp, dolp_variance, cosines, normal_variance=normal_variance, tolerances=t
        )
        parts.append(density + bound + log_prior + log_either)
    specular, diffuse = parts
    total = _log_of_sum(_log_of_sum(specular, diffuse), log_neither)
    return LightShares(
        specular=np.exp(specular - total),
        diffuse=np.exp(diffuse - total),
        neither=np.exp(log_neither - total),
        log_likelihood=total,
    )


def residual_variance(
    turn_variance: Floats, sin2: Floats, normal_variance: Floats | float = 0.0
) -> Floats:
    """Variance (...) of ``m . n``: the plane's rotation about the ray, and the normal's error."""
    return np.asarray(sin2 * turn_variance + normal_variance)


def row_precisions(shares: LightShares, variances: tuple[Floats, Floats]) -> tuple[Floats, Floats]:
    """Weights (...) of the squares of the two residuals in a fit of the normal.

    The squares of the residuals sum to ``sin^2(theta)`` for any plane. The part common to both
    labels only pulls the normal to the ray, so a label counts by its excess over the other.

    Parameters
    ----------
    shares : of the observations.
    variances : of the specular and of the diffuse residual (:func:`residual_variance`).
    """
    excess = shares.specular - shares.diffuse
    return np.maximum(excess, 0) / variances[0], np.maximum(-excess, 0) / variances[1]


def angle_log_density(
    residual: Floats, turn_variance: Floats, sin2: Floats, normal_variance: Floats | float = 0.0
) -> Floats:
    """Log density (...) of a plane's rotation about the ray over a uniform one; 0 if unknown."""
    variance = residual_variance(turn_variance, sin2, normal_variance)
    known = np.isfinite(variance)
    safe = np.where(known, variance, 1)
    density = -0.5 * np.square(residual) / safe - _log_bessel(0.25 * sin2 / safe)
    return np.where(known, density, np.zeros_like(density))


def _log_bessel(x: Floats) -> Floats:
    """``log(exp(-x) I0(x))`` (...), x >= 0, within 0.0025, many times faster than SciPy's.

    Olivares et al., A simple and accurate approximation for the modified Bessel functions of zeroth
    order, J. Phys.: Conf. Ser. 1043 (2018).
    """
    x2 = np.square(x)
    rational = (1 + 0.24273 * x2) / (1 + 0.43023 * x2)
    even = 0.5 + 0.5 * np.exp(-2 * x)
    return np.asarray(np.log(even * rational) - 0.25 * np.log(1 + 0.25 * x2))


def _log_of_sum(first: Floats, second: Floats | float) -> Floats:
    """``log(exp(first) + exp(second))``, of which at most one is -inf.

    NumPy's ``logaddexp`` takes six times as long, as it is not vectorized.
    """
    return np.asarray(np.maximum(first, second) + np.log(1 + np.exp(-np.abs(first - second))))


def dolp_log_evidence(
    light: Light,
    dolp: Floats,
    dolp_variance: Floats,
    cosines: Floats,
    *,
    normal_variance: Floats | float = 0.0,
    tolerances: LightMixtureTolerances = LightMixtureTolerances(),
) -> Floats:
    """Log probability (...) that a measured DoLP is possible for a kind of light.

    Parameters are those of :func:`light_shares`.
    """
    table = _bounds(light, tolerances)
    cosines = np.asarray(cosines)
    # Seen from behind it is no observation at all; the bound is that at a grazing angle.
    place = (np.clip(cosines, 0, 1) * (TABLE_SIZE - 1)).astype(np.intp)
    bound, spread, slope = table[:, place].astype(np.result_type(dolp))
    variance = dolp_variance + spread + slope * normal_variance
    finite = np.isfinite(variance)
    sigma = np.sqrt(np.where(finite, variance, 1))
    # The normal distribution's integral by a logistic one, within 0.01, whose tail is longer.
    excess = np.asarray(LOGISTIC_SCALE * (dolp - bound) / sigma)
    return np.where(finite, -_log_of_sum(excess, 0.0), np.zeros_like(excess))


@lru_cache(maxsize=8)
def _bounds(light: Light, tolerances: LightMixtureTolerances) -> Array:
    """Bound of the DoLP (3, TABLE_SIZE) by the cosine of theta.

    Mean over the refractive indices, variance by them and the margin, square of the slope by theta.
    """
    t = tolerances
    cosines = np.linspace(0, 1, TABLE_SIZE)
    iors = np.linspace(t.min_ior, t.max_ior, NUM_IORS)[:, None]
    dolp = fresnel_dolp(cosines, light, iors)
    theta = np.arccos(cosines)
    slope = np.gradient(dolp.mean(axis=0), theta)
    return np.stack([dolp.mean(axis=0), dolp.var(axis=0) + t.dolp_margin**2, np.square(slope)])
