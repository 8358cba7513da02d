"""Focal length from one view of a plane.

Under PPA, a change of the focal length is equivalent to a change of the plane's normal (the row of
a pixel is ``n_x sin + n_y cos - (x sin + y cos) n_z / f``), so every focal length fits equally. The
correction of the tilted model depends on the true angles of the rays, so one focal length has the
least phase residual.

Light that no single normal explains (mixed with light from below the surface, or from a second
reflection) shifts the minimum by more than its deviation. On a real pond of nominally 870 px the
result is 837 +- 22, 880 +- 22 and 908 +- 25 px from the pixels with a DoLP over 0.35, 0.45 and
0.55. The correction is not linear in noise: blur images of weak polarization (noise over a tenth of
the polarized intensity) first.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import minimize_scalar

from polmvs.arrays import Array, Floats
from polmvs.fitting import CAUCHY_SCALE, cauchy_weights
from polmvs.normals.single_view.plane import (
    EXACT,
    PlaneEstimate,
    PlaneTolerances,
    error_gradients,
    phase_errors,
    plane_normal,
    residual_scale,
    stack_samples,
    tangents,
)
from polmvs.polarization.angle_models import correct_parameters, phase_sign, sigma_scale
from polmvs.polarization.kinds import AngleModel, Light


@dataclass(frozen=True, kw_only=True)
class FocalTolerances:
    """Tolerances of the search for a focal length, and of its observability.

    Attributes
    ----------
    num_focals : of the scan. Guess.
    log_step : step of the numerical derivative by the logarithm of the focal length.
    max_log_sigma : relative deviation above which a focal length is not observable.
        Guess.
    """

    num_focals: int = 20
    log_step: float = 0.01
    max_log_sigma: float = 0.2


TOL = FocalTolerances()


@dataclass(frozen=True, kw_only=True)
class FocalEstimate:
    """Focal length of one view of a plane.

    Attributes
    ----------
    focal_px : of the least residual, px.
    sigma_px : its standard deviation, from the scatter of runs of pixels; infinite if the residual
        does not depend on it. Errors of the principal point and distortion are not included.
    observable : the residual has a minimum within the range, and ``sigma_px`` is below a fifth of
        it. Otherwise ``focal_px`` is meaningless.
    plane : the plane's normal at ``focal_px``.
    scan_focal_px, scan_rmse_deg, scan_median_deg : (S,), residual of the best normal for each tried
        focal length.
    """

    focal_px: float
    sigma_px: float
    observable: bool
    plane: PlaneEstimate
    scan_focal_px: Array
    scan_rmse_deg: Array
    scan_median_deg: Array


@dataclass(frozen=True)
class _View:
    """Pixels of a view whose focal length is unknown: Stokes (3, N), offsets (2, N), sigma (N,)."""

    parameters: Floats
    offsets: Floats
    sigma: Floats
    angle_model: AngleModel
    light: Light

    def phases(self, focal_px: float) -> tuple[Floats, Floats, Floats]:
        """Axial pairs (2, N), unit rays (3, N) and sigma (N,) at a focal length.

        The correction stretches the noise of the phase: sigma is that of the corrected one, so
        that errors over sigma mean the same at every focal length.
        """
        one = np.ones_like(self.offsets[:1])
        rays = np.concatenate([self.offsets / self.offsets.dtype.type(focal_px), one])
        rays /= np.sqrt((rays * rays).sum(axis=0))
        parameters, sigma = self.parameters, self.sigma
        if self.angle_model is AngleModel.TILTED:
            diffuse = self.light is Light.DIFFUSE
            parameters = correct_parameters(parameters, rays.T, diffuse=diffuse)
            sigma = sigma * sigma_scale(parameters[1], parameters[2], rays.T, diffuse=diffuse)
        return phase_sign(self.light) * parameters[1:], rays, sigma

    def plane(self, focal_px: float) -> PlaneEstimate:
        """Robust normal at a focal length."""
        return plane_normal(self.angle_model, *self.phases(focal_px))

    def errors(self, focal_px: float, normal: Floats) -> Floats:
        """Phase errors (N,) over their sigma."""
        samples = stack_samples(self.angle_model, *self.phases(focal_px))
        return np.asarray(phase_errors(normal, samples) * np.sqrt(samples[4]))


def estimate_focal(
    angle_model: AngleModel,
    parameters: Floats,
    offsets_px: Floats,
    sigma: Floats,
    *,
    light: Light,
    focal_range_px: tuple[float, float],
) -> FocalEstimate:
    """Focal length at which one normal best explains the phase angles of a plane.

    Parameters
    ----------
    angle_model : tilted; under the others the result is not observable.
    parameters : (3, N), Stokes parameters s0, s1, s2 as measured, not corrected.
    offsets_px : (2, N), image coordinates relative to the principal point, px; square pixels.
    sigma : (N,), standard deviation of the phase, rad.
    light : dominant kind of light.
    focal_range_px : shortest and longest focal length to try, px.
    """
    shortest, longest = focal_range_px
    if not 0 < shortest < longest:
        raise ValueError(f"{focal_range_px=} but expected 0 < shortest < longest.")
    view = _pick(angle_model, parameters, offsets_px, sigma, light)
    focals = np.geomspace(shortest, longest, TOL.num_focals)
    planes = [view.plane(float(focal)) for focal in focals]
    errors = [view.errors(f, p.normal) for f, p in zip(focals, planes, strict=True)]
    scale = CAUCHY_SCALE * min(residual_scale(error) for error in errors)
    best = int(np.argmin([_loss(error, scale) for error in errors]))
    inner = min(max(best, 1), len(focals) - 2)
    focal = _refine(view, focals[inner - 1], focals[inner + 1], scale)
    plane = view.plane(focal)
    sigma_log = _log_sigma(view, focal, plane.normal, scale)
    interior = focals[0] * (1 + TOL.log_step) < focal < focals[-1] / (1 + TOL.log_step)
    return FocalEstimate(
        focal_px=focal,
        sigma_px=focal * sigma_log,
        observable=bool(interior and plane.valid and sigma_log < TOL.max_log_sigma),
        plane=plane,
        scan_focal_px=focals,
        scan_rmse_deg=np.array([p.rmse_deg for p in planes]),
        scan_median_deg=np.array([p.median_deg for p in planes]),
    )


def _pick(
    angle_model: AngleModel,
    parameters: Floats,
    offsets_px: Floats,
    sigma: Floats,
    light: Light,
) -> _View:
    """Evenly spaced ones of the polarized pixels that are known."""
    if parameters.shape != (3, len(sigma)) or offsets_px.shape != (2, len(sigma)):
        raise ValueError(
            f"{parameters.shape=}, {offsets_px.shape=}, {sigma.shape=} but expected (3, N), "
            "(2, N), (N,)."
        )
    polarized = np.abs(parameters[1]) + np.abs(parameters[2])
    usable = np.flatnonzero((polarized > 0) & (sigma > 0) & (polarized + sigma < np.inf))
    usable = usable[:: max(1, len(usable) // PlaneTolerances.some_pixels)]
    return _View(parameters[:, usable], offsets_px[:, usable], sigma[usable], angle_model, light)


def _loss(errors: Floats, scale: float) -> float:
    """Mean Cauchy loss of errors over their sigma."""
    return float(np.log1p(np.square(errors / scale)).mean())


def _refine(view: _View, shortest: float, longest: float, scale: float) -> float:
    """Focal length of the least loss within two neighbours of the scan's best, px."""

    def loss(log_focal: float) -> float:
        focal = float(np.exp(log_focal))
        return _loss(view.errors(focal, view.plane(focal).normal), scale)

    bounds = (float(np.log(shortest)), float(np.log(longest)))
    found = minimize_scalar(loss, bounds=bounds, method="bounded", options={"xatol": 1e-3})
    return float(np.exp(found.x))


def _log_sigma(view: _View, focal: float, normal: Array, scale: float) -> float:
    """Deviation of the logarithm of the focal length, the normal being free as well.

    Infinite where the equations are as flat as rounding makes them.
    """
    step = float(np.exp(TOL.log_step))
    error = view.errors(focal, normal)
    slope = (view.errors(focal * step, normal) - view.errors(focal / step, normal)) / (
        2 * TOL.log_step
    )
    samples = stack_samples(view.angle_model, *view.phases(focal))
    on_normal = tangents(normal) @ error_gradients(normal, samples) * np.sqrt(samples[4])
    gradients = np.stack([*on_normal, slope]).astype(np.float64)
    weighted = gradients * cauchy_weights(np.square(error), scale)
    matrix = weighted @ gradients.T
    # Dividing by the diagonal first makes the test for a flat direction independent of units.
    size = np.sqrt(np.maximum(matrix.diagonal(), 1e-300))
    if np.linalg.eigvalsh(matrix / np.outer(size, size))[0] < EXACT:
        return np.inf
    inverse = np.linalg.inv(matrix)
    runs = np.array_split(np.arange(len(error)), min(PlaneTolerances.num_runs, len(error)))
    influence = np.array([weighted[:, run] @ error[run] for run in runs]) @ inverse[2]
    scatter = influence @ influence * len(runs) / max(len(runs) - 3, 1)
    return float(np.sqrt(max(scatter, inverse[2, 2])))
