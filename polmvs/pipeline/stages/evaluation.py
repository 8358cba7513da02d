"""Stage ``evaluation``: metrics of several models on the same poses and seeds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from polmvs.evaluation.comparison import Comparison, ModelEstimate, SparseFigures, compare_models
from polmvs.io.clouds import read_cloud
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.images import write_bytes
from polmvs.io.typed_json import write_json
from polmvs.parallel import Workers
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages.densify import open_dense_views, open_outside
from polmvs.pipeline.stages.maps import open_maps
from polmvs.polarization.capture import Capture
from polmvs.polarization.kinds import AngleModel


@dataclass(frozen=True, kw_only=True)
class EvaluationResult:
    """Result of the stage; the metrics are in ``metrics.json``.

    Attributes
    ----------
    models : compared models.
    best_fit : the model that fits the phases best; None if unknown.
    """

    models: tuple[AngleModel, ...]
    best_fit: AngleModel | None

    def __str__(self) -> str:
        names = ", ".join(model.label for model in self.models)
        best = self.best_fit
        return f"metrics of {names}" + (f"; {best.label} fits best" if best is not None else "")


def load_estimate(run_folder: RunFolder, model: AngleModel) -> ModelEstimate:
    """Results of a model from the files of a run.

    Raises
    ------
    DataError
        A file is missing or damaged.
    """
    return ModelEstimate(
        cloud=read_cloud(run_folder.cloud(model)),
        tracks=read_cloud(run_folder.sparse_cloud(model)),
        maps=open_maps(run_folder, model),
        dense=open_dense_views(run_folder, model),
        outside=open_outside(run_folder, model),
    )


def evaluate_models(
    capture: Capture,
    sparse: SparseFigures,
    run_folder: RunFolder,
    models: Sequence[AngleModel],
    gt: Path | None,
    *,
    workers: Workers,
) -> Comparison:
    """Evaluate the clouds of a run.

    Parameters
    ----------
    capture : raw mosaics.
    sparse : numbers of the input that all models share.
    run_folder : with the results of the models.
    models : to compare.
    gt : folder of the ground truth, if there is one.
    """
    estimates: Mapping[AngleModel, ModelEstimate] = {
        model: load_estimate(run_folder, model) for model in models
    }
    maps = open_maps(run_folder, AngleModel.PPA)
    truth = open_ground_truth(gt) if gt is not None else None
    return compare_models(capture, sparse, maps, estimates, truth, workers=workers)


def write_comparison(comparison: Comparison, metrics: Path, summary: Path) -> EvaluationResult:
    """Write the metrics as JSON and Markdown."""
    write_json(metrics, comparison)
    write_bytes(summary, comparison.summary().encode())
    return EvaluationResult(models=tuple(comparison.models), best_fit=comparison.best_fit)
