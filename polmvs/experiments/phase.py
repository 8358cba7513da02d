"""Experiment 1: error of the phase that each model predicts from true normals (paper, 5.2).

The measured phase is that of the Stokes images blurred as in the paper, at the pixels of the part
above the DoLP threshold. The third model also predicts the effect of tilted polarizers: its error
is that of the corrected measured phase under PPA.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats, Image, Mask
from polmvs.experiments.data import Scene, ViewData, load_view, require_counted
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.polarization.angle_models import phase_from_normal
from polmvs.polarization.kinds import FORMULAS, AngleModel
from polmvs.polarization.stokes import axial_difference

Density = NDArray[np.float64]
Counts = NDArray[np.int64]

ANGLES = ("viewing", "azimuth", "zenith")
ANGLE_LIMITS_DEG = {"viewing": 90.0, "azimuth": 180.0, "zenith": 90.0}
ANGLE_BINS = 90
ERROR_BINS = 180  # over -90 to 90 degrees
MIN_COLUMN_PIXELS = 200  # least number of pixels for the density in an angle's bin


@dataclass(frozen=True, kw_only=True)
class ViewPhase:
    """Tallies of one view.

    Attributes
    ----------
    name : of the image.
    all_pixels, unmarked : by model, over all counted pixels and over those outside of marks.
    counts : by model, (3, ANGLE_BINS, ERROR_BINS), pixels by angle and error.
    """

    name: str
    all_pixels: Mapping[AngleModel, ErrorTally]
    unmarked: Mapping[AngleModel, ErrorTally]
    counts: Mapping[AngleModel, Density]


@dataclass(frozen=True, kw_only=True)
class PhaseResult:
    """Phase errors of the models over a capture.

    Attributes
    ----------
    all_pixels : over the counted pixels of all views.
    unmarked : over those outside the blur of printed marks (not ``reliable`` in
        :class:`polmvs.polarization.region.Region`).
    per_view : root mean square error of each view, degrees, by image name.
    densities : by model, (3, ANGLE_BINS, ERROR_BINS), for the angles of ``ANGLES``: share of the
        pixels of an angle's bin in each bin of the error; NaN for an angle with too few pixels.
    """

    all_pixels: Mapping[AngleModel, SignedStats]
    unmarked: Mapping[AngleModel, SignedStats]
    per_view: Mapping[str, Mapping[AngleModel, float]]
    densities: Mapping[AngleModel, Density]


@dataclass(frozen=True, kw_only=True, eq=False)
class PhaseImages:
    """Images of one view for the paper's other figure.

    Attributes
    ----------
    name : of the image.
    intensity : (H, W), s0.
    part : (H, W) bool.
    measured : (H, W), phase, rad; NaN where it is not used.
    predicted : by model, (H, W), rad; NaN off the part.
    """

    name: str
    intensity: Image
    part: Mask
    measured: Array
    predicted: Mapping[AngleModel, Array]


def measure_phase(
    scene: Scene, workers: Workers, on_progress: OnProgress = no_progress
) -> PhaseResult:
    """Phase errors of all models over all views.

    Raises
    ------
    DataError
        No pixel is usable, or a file is unusable.
    """
    views = []
    for view in workers.map(partial(measure_view, scene), range(len(scene.views))):
        views.append(view)
        on_progress(1)
    totals = {m: _total([view.all_pixels[m] for view in views]).stats() for m in FORMULAS}
    require_counted(scene, totals[AngleModel.OPA].num_pixels)
    return PhaseResult(
        all_pixels=totals,
        unmarked={m: _total([view.unmarked[m] for view in views]).stats() for m in FORMULAS},
        per_view={v.name: {m: v.all_pixels[m].stats().rmse_deg for m in FORMULAS} for v in views},
        densities={m: _normalize(np.sum([v.counts[m] for v in views], axis=0)) for m in FORMULAS},
    )


def measure_view(scene: Scene, index: int) -> ViewPhase:
    """Tallies of one view."""
    data = load_view(scene, index)
    marked = data.beside_marks(data.find_region(scene.region.min_dolp), scene.blur_px)
    unmarked = ~marked[data.counted]
    angles = _angles(data)
    errors = {angle_model: _errors_deg(data, angle_model) for angle_model in FORMULAS}
    return ViewPhase(
        name=data.view.name,
        all_pixels={angle_model: ErrorTally.of(error) for angle_model, error in errors.items()},
        unmarked={
            angle_model: ErrorTally.of(error[unmarked]) for angle_model, error in errors.items()
        },
        counts={angle_model: _histograms(angles, error) for angle_model, error in errors.items()},
    )


def phase_images(scene: Scene, index: int) -> PhaseImages:
    """Intensity, measured and predicted phases of one view."""
    data = load_view(scene, index)
    measured = _phase(data, AngleModel.PPA)
    # What tilted polarizers turn the phase by is the same for the light's and the normal's.
    turn = axial_difference(measured, _phase(data, AngleModel.TILTED))
    predicted = {m: phase_from_normal(m, data.normals_in_cam, data.rays) for m in FORMULAS}
    predicted[AngleModel.TILTED] = np.mod(predicted[AngleModel.TILTED] + turn, np.pi)
    return PhaseImages(
        name=data.view.name,
        intensity=data.sharp.s0,
        part=data.part,
        measured=np.where(data.counted, measured, np.nan),
        predicted={m: np.where(data.part, phase, np.nan) for m, phase in predicted.items()},
    )


def _phase(data: ViewData, angle_model: AngleModel) -> Array:
    """Measured phase (H, W), rad in [0, pi), as the model takes it."""
    axial = data.axial(angle_model)
    return np.asarray(np.mod(0.5 * np.arctan2(axial[..., 1], axial[..., 0]), np.pi), np.float64)


def _errors_deg(data: ViewData, angle_model: AngleModel) -> Array:
    """Predicted minus measured phase of the counted pixels, (P,) degrees."""
    counted = data.counted
    predicted = phase_from_normal(angle_model, data.normals_in_cam[counted], data.rays[counted])
    return np.degrees(axial_difference(predicted, _phase(data, angle_model)[counted]))


def _angles(data: ViewData) -> dict[str, Array]:
    """Angles of the counted pixels that errors are plotted against, (P,) degrees.

    Between ray and normal; between the azimuths of ray and normal in the image plane; between
    the normal and the optical axis.
    """
    rays = data.rays[data.counted].astype(np.float64)
    normals = data.normals_in_cam[data.counted].astype(np.float64)
    cosine = np.clip(-(rays * normals).sum(axis=-1), -1, 1)
    azimuth = np.arctan2(normals[:, 1], normals[:, 0]) - np.arctan2(rays[:, 1], rays[:, 0])
    return {
        "viewing": np.degrees(np.arccos(cosine)),
        "azimuth": np.degrees(np.abs(np.mod(azimuth + np.pi, 2 * np.pi) - np.pi)),
        "zenith": np.degrees(np.arccos(np.clip(-normals[:, 2], -1, 1))),
    }


def _histograms(angles: Mapping[str, Array], errors: Array) -> Density:
    """Pixels by angle and error, (3, ANGLE_BINS, ERROR_BINS)."""
    kept = np.isfinite(errors)
    bins = (ANGLE_BINS, ERROR_BINS)
    return np.stack(
        [
            np.histogram2d(
                angles[name][kept],
                errors[kept],
                bins,
                range=((0, ANGLE_LIMITS_DEG[name]), (-90, 90)),
            )[0]
            for name in ANGLES
        ]
    )


def _normalize(counts: Density) -> Density:
    """Counts to shares of the pixels of each angle's bin."""
    total = counts.sum(axis=-1, keepdims=True)
    enough = np.broadcast_to(total >= MIN_COLUMN_PIXELS, counts.shape)
    shares = np.divide(counts, total, out=np.full_like(counts, np.nan), where=enough)
    return np.asarray(shares)


def _total(tallies: list[ErrorTally]) -> ErrorTally:
    return sum(tallies[1:], tallies[0])


BIN_DEG = 0.01  # of the histogram that percentiles are read from
NUM_BINS = round(90 / BIN_DEG)


@dataclass(frozen=True, kw_only=True)
class SignedStats:
    """Statistics of signed errors; NaN where there are none.

    Attributes
    ----------
    mean_deg : of the signed errors, as in the paper.
    mean_abs_deg, rmse_deg, median_deg, p95_deg : of their absolute values; the last two to 0.01.
    num_pixels : number of errors.
    """

    mean_deg: float
    mean_abs_deg: float
    rmse_deg: float
    median_deg: float
    p95_deg: float
    num_pixels: int


@dataclass(frozen=True)
class ErrorTally:
    """Sums of signed axial errors for their statistics; tallies can be added.

    Attributes
    ----------
    sums : (3,), of the errors, their absolute values and their squares, degrees.
    counts : (9000,), errors in bins of 0.01 degrees of their absolute value.
    """

    sums: NDArray[np.float64]
    counts: Counts

    @classmethod
    def of(cls, errors_deg: Floats) -> ErrorTally:
        """Tally of errors of any shape, -90 to 90 degrees; NaN are left out."""
        errors = np.asarray(errors_deg, np.float64).ravel()
        errors = errors[np.isfinite(errors)]
        sizes = np.abs(errors)
        bins = np.minimum((sizes / BIN_DEG).astype(np.int64), NUM_BINS - 1)
        sums = np.array([errors.sum(), sizes.sum(), (errors**2).sum()])
        return cls(sums, np.bincount(bins, minlength=NUM_BINS))

    def __add__(self, other: ErrorTally) -> ErrorTally:
        """Tally of both sets of errors."""
        return ErrorTally(self.sums + other.sums, self.counts + other.counts)

    def stats(self) -> SignedStats:
        """Statistics of all errors tallied."""
        num = int(self.counts.sum())
        mean, mean_abs, mean_square = self.sums / num if num else np.full(3, np.nan)
        return SignedStats(
            mean_deg=float(mean),
            mean_abs_deg=float(mean_abs),
            rmse_deg=float(np.sqrt(mean_square)),
            median_deg=self._quantile(0.5),
            p95_deg=self._quantile(0.95),
            num_pixels=num,
        )

    def _quantile(self, share: float) -> float:
        """Quantile of the absolute error, linear within a bin."""
        cumulative = np.cumsum(self.counts)
        if cumulative[-1] == 0:
            return float("nan")
        target = share * cumulative[-1]
        index = int(np.searchsorted(cumulative, target))
        before = cumulative[index - 1] if index else 0
        return float(BIN_DEG * (index + (target - before) / max(self.counts[index], 1)))


def ratio_to_opa(stats: Mapping[AngleModel, SignedStats], angle_model: AngleModel) -> float:
    """Root mean square error of a model over that of OPA."""
    return ratio(stats[angle_model].rmse_deg, stats[AngleModel.OPA].rmse_deg)


def ratio(numerator: float, denominator: float) -> float:
    """Quotient, NaN where the denominator is 0 or unknown."""
    return numerator / denominator if denominator > 0 else float("nan")
