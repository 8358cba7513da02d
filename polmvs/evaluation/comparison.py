"""Compare the clouds of several models, against ground truth or against the phases."""

from __future__ import annotations

import operator
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.models import read_model
from polmvs.errors import DataError, as_data_error
from polmvs.evaluation.consistency import Consistency, best_fitting_model, measure_consistency
from polmvs.evaluation.map_errors import MapErrors, map_errors
from polmvs.evaluation.metrics import AngleStats, CloudMetrics
from polmvs.evaluation.tables import (
    NONE,
    cloud_rows,
    format_table,
    mean_and_median,
    number,
    rmse_and_median,
)
from polmvs.evaluation.truth_errors import (
    TrackNormalErrors,
    evaluate,
    phase_errors,
    track_normal_errors,
)
from polmvs.io.clouds import Cloud, read_cloud
from polmvs.io.ground_truth import GroundTruth, open_ground_truth
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import from_json, parse_json
from polmvs.parallel import Workers
from polmvs.polarization.capture import Capture
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.poses.alignment import Alignment
from polmvs.scene import View, match_names
from polmvs.surface.dense_view import DenseView

DenseViews = Sequence[DenseView | None]

SCHEMA_VERSION = 3  # of ``metrics.json``; 1: the first releases, which did not name it; 2: 0.2.0


@dataclass(frozen=True, kw_only=True)
class TruthFigures:
    """Metrics of a model against ground truth.

    Attributes
    ----------
    cloud : of the dense cloud.
    alignment : of the estimated cameras to the true ones.
    tracks : of the normals of the sparse points; None if not measured.
    maps : of the dense depth and normal maps; None if not measured.
    """

    cloud: CloudMetrics
    alignment: Alignment
    tracks: TrackNormalErrors | None = None
    maps: MapErrors | None = None


@dataclass(frozen=True, kw_only=True)
class ModelFigures:
    """Metrics of an angle model.

    Attributes
    ----------
    consistency : of its cloud with the capture.
    truth : against ground truth; None without it.
    """

    consistency: Consistency
    truth: TruthFigures | None


@dataclass(frozen=True, kw_only=True)
class PhaseFigures:
    """Errors of the measured phase on the part, under each model with the true normals.

    Attributes
    ----------
    maps : of the phase maps.
    pixels : of the single pixels of the capture that are neither clipped nor dark.
    """

    maps: Mapping[AngleModel, AngleStats]
    pixels: Mapping[AngleModel, AngleStats]


@dataclass(frozen=True, kw_only=True)
class SparseFigures:
    """Numbers of the input that all models share.

    Attributes
    ----------
    num_views : images with a pose.
    unregistered : names of images without a pose.
    num_tracks : sparse points.
    num_seeds : sparse points that are seeds.
    """

    num_views: int
    unregistered: tuple[str, ...]
    num_tracks: int
    num_seeds: int


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """Several models on the same poses and seeds; ``metrics.json`` is its serialisation.

    Attributes
    ----------
    schema_version : of the file.
    capture : folder of the raw mosaics.
    sparse : what all models started from.
    models : metrics of each model.
    phase : errors of the phase; None without ground truth.
    best_fit : the model that fits the phases best; None if unknown.
    """

    schema_version: int = SCHEMA_VERSION
    capture: str
    sparse: SparseFigures
    models: Mapping[AngleModel, ModelFigures]
    phase: PhaseFigures | None
    best_fit: AngleModel | None

    def table(self) -> str:
        """The metrics as a Markdown table with one column for each model."""
        return format_table(*comparison_rows(self))

    def summary(self) -> str:
        """The metrics as a Markdown page."""
        sparse = self.sparse
        missing = sparse.unregistered
        lines = [
            f"# {self.capture}",
            "",
            f"{sparse.num_views} of {sparse.num_views + len(missing)} views have a pose"
            + (f"; without one: {', '.join(missing)}" if missing else "")
            + f". {sparse.num_tracks} sparse points, {sparse.num_seeds} of them seeds.",
            "",
            self.table(),
            *best_fit_lines(self),
        ]
        return "\n".join(lines) + "\n"


@dataclass(frozen=True, kw_only=True)
class ModelEstimate:
    """Results of a model, for the metrics.

    Attributes
    ----------
    cloud : dense cloud.
    tracks : sparse points with normals, quality and ``seed``.
    maps : phase maps of all views for the model.
    dense : dense depth and normals of the same views.
    outside : pixels (H, W) of views, by name, that show what is outside the crop box.
    """

    cloud: Cloud
    tracks: Cloud
    maps: Sequence[PhaseMap]
    dense: DenseViews
    outside: Mapping[str, NDArray[np.bool_]] = field(default_factory=dict)


def compare_models(
    capture: Capture,
    sparse: SparseFigures,
    maps: Sequence[PhaseMap],
    estimates: Mapping[AngleModel, ModelEstimate],
    truth: GroundTruth | None,
    *,
    workers: Workers,
) -> Comparison:
    """Metrics of several models.

    Parameters
    ----------
    capture : raw mosaics.
    sparse : what all models started from.
    maps : phase maps as OPA and PPA use them.
    estimates : of each model, in the world of its maps' views.
    truth : ground truth, if there is one.
    """
    tasks: list[Callable[[], Any]] = []
    if truth is not None:  # the longest first
        tasks.append(partial(_measure_all, estimates, truth))
        tasks.append(partial(phase_errors, capture, maps, truth))
    tasks += [
        partial(measure_consistency, m, e.cloud, e.tracks, e.maps, e.outside)
        for m, e in estimates.items()
    ]
    done = list(workers.map(operator.call, tasks))
    found: list[Consistency] = done[len(done) - len(estimates) :]
    consistency = dict(zip(estimates, found, strict=True))
    against_truth: Mapping[AngleModel, TruthFigures] = done[0] if truth is not None else {}
    return Comparison(
        capture=str(capture.folder),
        sparse=sparse,
        models={
            model: ModelFigures(consistency=consistency[model], truth=against_truth.get(model))
            for model in estimates
        },
        phase=PhaseFigures(**done[1]) if truth is not None else None,
        best_fit=best_fitting_model(consistency),
    )


def measure_against_truth(
    cloud: Cloud,
    tracks: Cloud | None,
    views: Sequence[View],
    truth: GroundTruth,
    dense: DenseViews | None = None,
) -> TruthFigures:
    """Metrics of a dense cloud, of the normals of sparse points and of the views' dense maps.

    Parameters
    ----------
    cloud : in the world of ``views``.
    tracks : sparse points with normals and ``valid``, or None.
    dense : maps of ``views``, or None.
    """
    named = named_as_truth(views, truth)
    metrics, alignment = evaluate(cloud.points, cloud.normals, named, truth)
    track_errors = None
    if tracks is not None and tracks.normals is not None:
        valid = tracks.scalars["valid"] > 0
        track_errors = track_normal_errors(tracks.points, tracks.normals, valid, named, truth)
    return TruthFigures(
        cloud=metrics,
        alignment=alignment,
        tracks=track_errors,
        maps=None if dense is None else map_errors(named, dense, truth),
    )


def named_as_truth(views: Sequence[View], truth: GroundTruth) -> list[View]:
    """Views with the names of the ground truth, which may have another suffix."""
    matched = match_names([view.name for view in views], truth.names)
    return [replace(view, name=matched.get(view.name, view.name)) for view in views]


def evaluate_file(cloud: Path, gt: Path, sparse: Path) -> TruthFigures:
    """Metrics of a cloud file against ground truth.

    Parameters
    ----------
    cloud : PLY in the frame of ``sparse``.
    gt : folder of the ground truth.
    sparse : COLMAP model; its camera centres are aligned to the true ones.
    """
    truth = open_ground_truth(gt)
    return measure_against_truth(read_cloud(cloud), None, read_model(sparse).views, truth)


def read_comparison(path: Path) -> Comparison:
    """Read a ``metrics.json``.

    Raises
    ------
    DataError
        It is missing, no such file, or of another version.
    """
    try:
        with as_data_error(path, "read"):
            content = parse_json(read_text(path))
        found = content.get("schema_version", 1)
        if found != SCHEMA_VERSION:
            raise DataError(
                path,
                f"has schema version {found}; this polmvs reads {SCHEMA_VERSION}. Compare again.",
            )
        return from_json(Comparison, content)
    except (ValueError, AttributeError) as error:
        raise DataError(path, f"holds no figures of a comparison ({error}).") from error


def _measure_all(
    estimates: Mapping[AngleModel, ModelEstimate], truth: GroundTruth
) -> dict[AngleModel, TruthFigures]:
    """All models together: sampling the true surface is most of the work."""
    return {
        model: measure_against_truth(
            one.cloud, one.tracks, [m.view for m in one.maps], truth, one.dense
        )
        for model, one in estimates.items()
    }


def best_fit_lines(comparison: Comparison) -> list[str]:
    """A sentence on the model that fits the capture's phases best; empty if it is unknown."""
    best = comparison.best_fit
    if best is None or len(comparison.models) < 2:
        return []
    residual = comparison.models[best].consistency.track_residual_median_deg
    return ["", f"The phases fit {best.label} best: {number(residual)} deg at the seeds."]


def comparison_rows(comparison: Comparison) -> tuple[list[str], list[list[str]]]:
    """Header and rows of the figures, a column for each model."""
    models = comparison.models

    def row(name: str, cell: Callable[[ModelFigures], str]) -> list[str]:
        return [name, *map(cell, models.values())]

    rows = [
        row("points", lambda m: f"{m.consistency.num_points:,}"),
        row("coverage, %", lambda m: number(m.consistency.coverage, 100, 1)),
        row(
            "agreement of the views that see a point, %",
            lambda m: number(m.consistency.agreement, 100, 1),
        ),
        row(
            "phase residual over all views, RMSE / median, deg",
            lambda m: rmse_and_median(m.consistency.phase_residual),
        ),
        row(
            "phase residual of the seeds, median, deg",
            lambda m: number(m.consistency.track_residual_median_deg),
        ),
    ]
    truth = {model: figures.truth for model, figures in models.items() if figures.truth is not None}
    if len(truth) == len(models):
        rows += _truth_rows(truth, comparison.phase)
    return ["", *[model.label for model in models]], rows


def _truth_rows(
    models: Mapping[AngleModel, TruthFigures], phase: PhaseFigures | None
) -> list[list[str]]:
    """Rows of the measures against the truth."""
    rows = []
    if phase is not None:
        for what, errors in (("smoothed", phase.maps), ("single pixels", phase.pixels)):
            cells = [rmse_and_median(errors.get(model.formula)) for model in models]
            rows.append([f"phase error on the part, {what}, RMSE / median, deg", *cells])
    figures = list(models.values())
    rows.append(
        [
            "error of the sparse normals, mean / median, deg",
            *[mean_and_median(f.tracks.errors if f.tracks else None) for f in figures],
        ]
    )
    maps = [f.maps for f in figures]
    rows += [
        ["depth maps, RMSE, mm", *[number(m.depth_rmse_m if m else None, 1e3) for m in maps]],
        [
            "depth maps within 1 mm, %",
            *[number(m.depth_within_1mm if m else None, 100, 1) for m in maps],
        ],
        [
            "depths within one / two sigma, %",
            *[_shares(m.within_one_sigma, m.within_two_sigma) if m else NONE for m in maps],
        ],
        [
            "normal maps, mean / median error, deg",
            *[mean_and_median(m.normals if m else None) for m in maps],
        ],
        [
            "normals within one / two sigma, %",
            *[
                _shares(m.normals_within_one_sigma, m.normals_within_two_sigma) if m else NONE
                for m in maps
            ],
        ],
    ]
    for same in zip(*(cloud_rows(f.cloud) for f in figures), strict=True):
        rows.append([same[0][0], *[row[1] for row in same]])
    return rows


def _shares(*shares: float) -> str:
    return " / ".join(number(share, 100, 0) for share in shares)


def evaluation_text(figures: TruthFigures) -> str:
    """Table of one cloud against ground truth, with its alignment."""
    cloud, alignment = figures.cloud, figures.alignment
    return (
        format_table(["", "value"], cloud_rows(cloud))
        + f"\n{cloud.num_points:,} points, {cloud.num_on_part:,} on "
        f"the part. Aligned by {alignment.num_cameras} cameras, "
        f"{alignment.rms_residual_mm:.2f} mm RMS."
    )
