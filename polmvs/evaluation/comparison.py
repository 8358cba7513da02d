"""Compare the clouds of several models, against the truth or against the phases themselves."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

from polmvs.colmap.models import read_model
from polmvs.config import AngleModel, Options, to_plain
from polmvs.evaluation.consistency import Consistency, best_fitting_model, measure_consistency
from polmvs.evaluation.map_errors import map_errors
from polmvs.evaluation.tables import summary_text
from polmvs.evaluation.truth_errors import evaluate, phase_errors, track_normal_errors
from polmvs.io.clouds import Cloud, read_cloud
from polmvs.io.ground_truth import GroundTruth, open_ground_truth
from polmvs.io.images import write_bytes
from polmvs.parallel import Workers
from polmvs.pipeline.record import write_json
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages.capture import open_maps
from polmvs.pipeline.stages.clouds import open_dense_views
from polmvs.polarization.capture import Capture
from polmvs.scene import View, match_names
from polmvs.surface.dense_view import DenseView

DenseViews = Sequence[DenseView | None]


def named_as_truth(views: Sequence[View], truth: GroundTruth) -> list[View]:
    """Views under the truth's names, which may have another suffix."""
    matched = match_names([view.name for view in views], truth.names)
    return [replace(view, name=matched.get(view.name, view.name)) for view in views]


def measure_against_truth(
    cloud: Cloud,
    tracks: Cloud | None,
    views: Sequence[View],
    truth: GroundTruth,
    dense: DenseViews | None = None,
) -> dict[str, Any]:
    """Figures of a dense cloud, of the normals of sparse points and of the views' dense maps.

    Parameters
    ----------
    cloud : in the world of ``views``.
    tracks : sparse points with normals and ``valid``, or None.
    dense : maps of ``views``, or None.
    """
    named = named_as_truth(views, truth)
    metrics, alignment = evaluate(cloud.points, cloud.normals, named, truth)
    figures: dict[str, Any] = {"cloud": metrics, "alignment": alignment}
    if tracks is not None and tracks.normals is not None:
        valid = tracks.scalars["valid"] > 0
        figures["tracks"] = track_normal_errors(tracks.points, tracks.normals, valid, named, truth)
    if dense is not None:
        figures["maps"] = map_errors(named, dense, truth)
    return figures


def compare_models(
    capture: Capture,
    workspace: RunFolder,
    options: Options,
    models: Sequence[AngleModel],
    *,
    workers: Workers,
) -> dict[str, Any]:
    """Measure the clouds of an output folder, in terms of JSON.

    Returns
    -------
    ``models``: for each its ``consistency`` and, with ground truth, its ``truth``. ``phase``:
    with ground truth, what :func:`phase_errors` gives. ``best_fit``: what
    :func:`best_fitting_model` says.
    """
    maps = {model: open_maps(workspace, model) for model in (AngleModel.PPA, *models)}
    clouds = {model: read_cloud(workspace.cloud(model)) for model in models}
    tracks = {model: read_cloud(workspace.normals(model)) for model in models}
    dense = {model: open_dense_views(workspace, model) for model in models}
    tasks: list[Callable[[], Any]] = []
    gt = options.evaluation.gt
    if gt is not None:  # the longest first
        truth = open_ground_truth(gt)
        views = [phase_map.view for phase_map in maps[AngleModel.PPA]]
        tasks.append(partial(_measure_all, clouds, tracks, dense, views, truth))
        tasks.append(partial(phase_errors, capture, maps[AngleModel.PPA], truth))
    tasks += [partial(measure_consistency, m, clouds[m], tracks[m], maps[m]) for m in models]
    done = list(workers.map(_call, tasks))
    consistencies: list[Consistency] = done[-len(models) :]
    figures: dict[str, Any] = {
        model: {"consistency": found} for model, found in zip(models, consistencies, strict=True)
    }
    if gt is not None:
        for model in models:
            figures[model]["truth"] = done[0][model]
    phase = done[1] if gt is not None else None
    best = best_fitting_model(dict(zip(models, consistencies, strict=True)))
    return dict(to_plain({"models": figures, "phase": phase, "best_fit": best}))


def _measure_all(
    clouds: Mapping[AngleModel, Cloud],
    tracks: Mapping[AngleModel, Cloud],
    dense: Mapping[AngleModel, DenseViews],
    views: Sequence[View],
    truth: GroundTruth,
) -> dict[AngleModel, dict[str, Any]]:
    """All models together: sampling the true surface is most of the work."""
    return {m: measure_against_truth(clouds[m], tracks[m], views, truth, dense[m]) for m in clouds}


def _call(task: Callable[[], Any]) -> Any:
    return task()


def write_comparison(
    capture: Capture,
    workspace: RunFolder,
    options: Options,
    models: Sequence[AngleModel],
    results: Mapping[str, Any],
    *,
    workers: Workers,
) -> None:
    """Write ``metrics.json`` and ``summary.md``."""
    metrics = {"capture": str(capture.folder), "results": dict(results)}
    metrics |= compare_models(capture, workspace, options, models, workers=workers)
    write_json(workspace.metrics, metrics)
    write_bytes(workspace.summary, summary_text(metrics).encode())


def evaluate_file(cloud: Path, gt: Path, sparse: Path) -> dict[str, Any]:
    """Figures of a cloud file against the truth, in terms of JSON.

    Parameters
    ----------
    cloud : PLY in the frame of ``sparse``.
    gt : folder of the ground truth.
    sparse : COLMAP model; its camera centres are brought onto the true ones.
    """
    truth = open_ground_truth(gt)
    figures = measure_against_truth(read_cloud(cloud), None, read_model(sparse).views, truth)
    return dict(to_plain(figures))
