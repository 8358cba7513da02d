"""Experiment 2: normal of a planar region from one view (paper, 5.3, M1).

The paper's eigenvector and the robust maximum likelihood of :mod:`polmvs.normals.single_view.plane`
use the same pixels. On a curved part, the region of each view is the largest patch whose true
normals lie within a few degrees of one of them; its true normal is their mean.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np

from polmvs.arrays import Array, Floats, Mask
from polmvs.config import ExperimentOptions
from polmvs.evaluation.metrics import AngleStats, angular_errors_deg
from polmvs.experiments.data import Scene, ViewData, load_view, require_counted
from polmvs.normals.single_view.measurement import MIN_PIXELS
from polmvs.normals.single_view.plane import phase_residuals, plane_normal
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.polarization.kinds import FORMULAS, AngleModel
from polmvs.polarization.stokes import Stokes

NUM_CANDIDATES = 64  # normals tried as the middle of a patch
MAX_SPREAD_DEG = 0.2  # of the true normals of a plane; 16-bit maps have less

# A lens may or may not tilt the polarizers (:mod:`polmvs.polarization.angle_models`), and PPA
# ignores the tilt: its rotation of a pixel's phase is part of the phase's uncertainty. It is common
# to a whole part of the image and does not average out over the pixels as noise does, hence the
# factor.
TILT_FACTOR = 4.0


class Weights(StrEnum):
    """Weights of the pixels of an estimate."""

    ALIKE = "alike"
    NOISE = "noise"
    TILT_AWARE = "tilt-aware"


# Name of the estimate, its model, and its weights; "alike" is the paper's eigenvector.
ESTIMATES: dict[str, tuple[AngleModel, Weights]] = {
    "algebraic": (AngleModel.PPA, Weights.ALIKE),
    "weighted_noise": (AngleModel.PPA, Weights.NOISE),
    "weighted": (AngleModel.PPA, Weights.TILT_AWARE),
    "tilted_algebraic": (AngleModel.TILTED, Weights.ALIKE),
    "tilted": (AngleModel.TILTED, Weights.NOISE),
}

PLANE_LABELS = {
    "algebraic": "PPA, eigenvector (paper)",
    "weighted_noise": "PPA, robust, noise weights",
    "weighted": "PPA, robust, tilt-aware weights",
    "tilted_algebraic": "tilted, eigenvector",
    "tilted": "tilted, robust",
}


@dataclass(frozen=True, kw_only=True)
class ImagePlane:
    """Estimates of one view; all by the name of the estimate.

    Attributes
    ----------
    name : of the image.
    num_pixels : of the region.
    spread_deg : root mean square angle of the region's true normals to their mean, degrees.
    error_deg : angle to the true normal; NaN without an estimate.
    sigma_deg : as stated by the estimator.
    seconds : wall time of the estimate.
    """

    name: str
    num_pixels: int
    spread_deg: float
    error_deg: Mapping[str, float]
    sigma_deg: Mapping[str, float]
    seconds: Mapping[str, float]


@dataclass(frozen=True, kw_only=True)
class Ambiguity:
    """Comparison of the normal with its twin, turned by pi about the optical axis.

    Attributes
    ----------
    rmse_deg, rmse_turned_deg : phase residual of the true normal and of the twin, root mean
        square over all views.
    determined_share : share of the views whose rows determine a single normal.
    """

    rmse_deg: float
    rmse_turned_deg: float
    determined_share: float


@dataclass(frozen=True, kw_only=True)
class PlaneResult:
    """Single-view normals over a capture.

    Attributes
    ----------
    stats : angular errors over the images, by estimate.
    seconds : median time per estimate.
    failed : images without an estimate.
    per_image : of each image with enough pixels.
    skipped : names of the images with fewer than ``MIN_PIXELS`` pixels.
    ambiguity : of pi, by model.
    """

    stats: Mapping[str, AngleStats]
    seconds: Mapping[str, float]
    failed: Mapping[str, int]
    per_image: tuple[ImagePlane, ...]
    skipped: tuple[str, ...]
    ambiguity: Mapping[AngleModel, Ambiguity]

    @property
    def spread_deg(self) -> float:
        """Median over the images of the spread of the region's true normals, degrees."""
        return float(np.median([image.spread_deg for image in self.per_image]))

    @property
    def is_planar(self) -> bool:
        """Whether the regions are planes and not patches of a curved part."""
        return self.spread_deg < MAX_SPREAD_DEG


def measure_plane(
    scene: Scene,
    workers: Workers,
    on_progress: OnProgress = no_progress,
    *,
    planar_deg: float = ExperimentOptions.planar_deg,
) -> PlaneResult:
    """Single-view normals of all views.

    Parameters
    ----------
    planar_deg : largest angle of the region's true normals to the middle one, degrees.

    Raises
    ------
    DataError
        No view has enough pixels, or a file is unusable.
    """
    images, residuals = [], []
    work = partial(measure_image, scene, planar_deg=planar_deg)
    for image, residual in workers.map(work, range(len(scene.views))):
        images.append(image)
        residuals.append(residual)
        on_progress(1)
    used = [i for i, image in enumerate(images) if image.num_pixels >= MIN_PIXELS]
    require_counted(scene, len(used))
    kept = [images[i] for i in used]
    errors = {name: np.array([image.error_deg[name] for image in kept]) for name in ESTIMATES}
    return PlaneResult(
        stats={name: AngleStats.from_degrees(error) for name, error in errors.items()},
        seconds={n: float(np.median([image.seconds[n] for image in kept])) for n in ESTIMATES},
        failed={name: int(np.isnan(error).sum()) for name, error in errors.items()},
        per_image=tuple(kept),
        skipped=tuple(im.name for i, im in enumerate(images) if i not in used),
        ambiguity={m: _pool([residuals[i][m] for i in used]) for m in FORMULAS},
    )


def measure_image(
    scene: Scene, index: int, *, planar_deg: float
) -> tuple[ImagePlane, dict[AngleModel, Ambiguity]]:
    """Estimates of one view, and its share in the ambiguity."""
    data = load_view(scene, index)
    region, true_normal = planar_region(data, planar_deg)
    pixels = {angle_model: _pixels(data, angle_model, region) for angle_model in FORMULAS}
    estimates, seconds = {}, {}
    enough = int(region.sum()) >= MIN_PIXELS
    # What tilted polarizers turn the phase by, rad.
    axial, corrected = (pixels[model][0] for model in (AngleModel.PPA, AngleModel.TILTED))
    sine = axial[1] * corrected[0] - axial[0] * corrected[1]
    turn = 0.5 * np.arctan2(sine, (axial * corrected).sum(axis=0))
    for name, (angle_model, weights) in ESTIMATES.items() if enough else ():
        axial, rays, sigma = pixels[angle_model]
        start = time.perf_counter()
        if weights is Weights.TILT_AWARE:
            sigma = np.hypot(sigma, TILT_FACTOR * turn)
        robust = weights is not Weights.ALIKE
        estimates[name] = plane_normal(angle_model, axial, rays, sigma, robust=robust)
        seconds[name] = time.perf_counter() - start
    spread = angular_errors_deg(data.normals_in_cam[region], true_normal)
    image = ImagePlane(
        name=data.view.name,
        num_pixels=int(region.sum()),
        spread_deg=AngleStats.from_degrees(spread).rmse_deg,
        error_deg={
            name: float(angular_errors_deg(e.normal, true_normal)) if e.valid else np.nan
            for name, e in estimates.items()
        },
        sigma_deg={name: e.sigma_deg for name, e in estimates.items()},
        seconds=seconds,
    )
    ambiguity = {m: _ambiguity(m, true_normal, *pixels[m]) for m in FORMULAS} if enough else {}
    return image, ambiguity


def planar_region(data: ViewData, planar_deg: float) -> tuple[Mask, Array]:
    """Counted pixels of the largest nearly planar patch, and their mean true normal.

    Returns
    -------
    (H, W) bool, and (3,) unit, camera frame; NaN where no pixel is counted.
    """
    normals = data.normals_in_cam[data.counted].astype(np.float64)
    region = np.zeros_like(data.counted)
    if len(normals) == 0:
        return region, np.full(3, np.nan)
    candidates = normals[np.linspace(0, len(normals) - 1, NUM_CANDIDATES).astype(int)]
    near = np.cos(np.radians(planar_deg))
    shares = [(normals[::7] @ candidate > near).sum() for candidate in candidates]
    inside = normals @ candidates[int(np.argmax(shares))] > near
    region[data.counted] = inside
    mean = normals[inside].sum(axis=0)
    return region, mean / np.linalg.norm(mean)


def _pixels(data: ViewData, angle_model: AngleModel, region: Mask) -> tuple[Floats, Floats, Floats]:
    """Axial pair (2, N), rays (3, N) and phase deviation (N,) of the region's pixels."""
    stokes: Stokes = data.blurred_for(angle_model)
    axial = np.ascontiguousarray(data.axial(angle_model)[region].T)
    rays = np.ascontiguousarray(data.rays[region].T)
    return axial, rays, stokes.sigma_aolp[region]


def _ambiguity(
    angle_model: AngleModel, normal: Array, axial: Floats, rays: Floats, sigma: Floats
) -> Ambiguity:
    """Residuals of a normal and of its twin, and whether the rows tell them apart."""
    turned = normal * [-1.0, -1.0, 1.0]
    rmse = [
        float(np.degrees(np.sqrt(np.nanmean(phase_residuals(angle_model, n, axial, rays) ** 2))))
        for n in (normal, turned)
    ]
    determined = plane_normal(angle_model, axial, rays, sigma, robust=False).valid
    return Ambiguity(rmse_deg=rmse[0], rmse_turned_deg=rmse[1], determined_share=float(determined))


def _pool(parts: list[Ambiguity]) -> Ambiguity:
    """Over all views, each of the same weight."""
    return Ambiguity(
        rmse_deg=float(np.sqrt(np.mean([p.rmse_deg**2 for p in parts]))),
        rmse_turned_deg=float(np.sqrt(np.mean([p.rmse_turned_deg**2 for p in parts]))),
        determined_share=float(np.mean([p.determined_share for p in parts])),
    )
