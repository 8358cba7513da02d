"""``OUT/report.html``: what a finished run came to, in one file that needs nothing beside it."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.models import read_model
from polmvs.config import AngleModel, Options, options_from_plain, to_plain
from polmvs.errors import DataError, PolmvsError
from polmvs.evaluation.comparison import Comparison, named_as_truth, read_comparison
from polmvs.evaluation.metrics import angular_errors_deg
from polmvs.evaluation.tables import comparison_rows, number
from polmvs.evaluation.trust import Trust
from polmvs.geometry import SimilarityTransform
from polmvs.io.clouds import Cloud, read_cloud, read_mesh
from polmvs.io.ground_truth import GroundTruth, open_ground_truth
from polmvs.io.images import write_bytes
from polmvs.neighbors import nearest_points
from polmvs.parallel import OnProgress, no_progress
from polmvs.pipeline.record import Record
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.runner import dense_models, load_record
from polmvs.pipeline.stages.densify import DensifyResult, open_dense_views
from polmvs.pipeline.stages.images import image_names
from polmvs.pipeline.stages.maps import open_maps
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.pipeline.stages.seeds import SeedsResult
from polmvs.polarization.capture import WHITE_PERCENTILE, Capture, open_capture
from polmvs.poses.alignment import align_views
from polmvs.report import pictures, plots
from polmvs.report.contents import (
    MAX_ERROR_DEG,
    MAX_ERROR_M,
    ErrorSamples,
    ViewInput,
    view_page,
)
from polmvs.report.layers import KIND, Channel, Layer, Scene3D, pack_scene, thinned
from polmvs.report.page import Page, Plot, Table, ViewPage, page_text
from polmvs.scene import PointKind, SparseModel, View

logger = logging.getLogger(__name__)

Floats = NDArray[np.floating]

MAX_POINTS = 150_000  # of each cloud on the page: two clouds turn smoothly, and 2 MB each
ANGLE_BINS_DEG = np.arange(0.0, 91.0, 5.0)
# Rows of the comparison that tell the models apart at a glance.
HEADLINE = (
    "part of the region covered, %",
    "phase residual over all views, RMSE / median, deg",
    "depth maps, RMSE, mm",
    "F-score at 1 mm, %",
    "Chamfer distance, mm",
    "normal error, mean / median, deg",
)
# Who stands for the run, and for OPA, in order: people know OPA as the paper has it.
MAIN = (
    AngleModel.PPA,
    AngleModel.TILTED,
    AngleModel.TEXTBOOK_PPA,
    AngleModel.OPA,
    AngleModel.TEXTBOOK_OPA,
)
ORTHOGRAPHIC = (AngleModel.TEXTBOOK_OPA, AngleModel.OPA)


@dataclass(frozen=True, kw_only=True)
class _Given:
    """A finished run, opened.

    Attributes
    ----------
    models : those that have a cloud with points, OPA first.
    capture : None where it is gone or has changed.
    truth : with ``truth_from_world``; None without ground truth.
    """

    folder: RunFolder
    record: Record
    options: Options
    sparse: SparseModel
    models: tuple[AngleModel, ...]
    clouds: Mapping[AngleModel, Cloud]
    capture: Capture | None
    truth: tuple[GroundTruth, SimilarityTransform] | None
    comparison: Comparison | None


def write_report(run_folder: RunFolder, *, on_progress: OnProgress = no_progress) -> Path:
    """Make the report of a run, again if there is one.

    Parameters
    ----------
    run_folder : with poses, phase maps and at least one dense cloud.
    on_progress : called with 1 for each view.

    Returns
    -------
    The report's path.

    Raises
    ------
    DataError
        The folder holds no such run, or a file of it is damaged.
    """
    given = _open(run_folder)
    samples = {model: ErrorSamples() for model in given.models}
    views = []
    for page in _view_pages(given, samples):
        views.append(page)
        on_progress(1)
    layers, channels = _layers(given)
    text = page_text(
        Page(
            title=_title(given),
            sentence=" ".join([*_verdict(given), _sentence(given)]),
            facts=_facts(given),
            warnings=tuple(w for stage in given.record.stages for w in stage.warnings),
            tables=_tables(given),
            trust=_trust(given),
            views=views,
            plots=_plots(given, samples),
            scene=_scene(given, layers, channels),
            thinned=MAX_POINTS if _is_thinned(given) else 0,
            stages=[
                (stage.name, number(stage.seconds, 1, 1), number(stage.peak_rss_mb, 1, 0))
                for stage in given.record.stages
            ],
            record=to_plain(
                {
                    "command line": list(given.record.command_line),
                    "versions": given.record.versions,
                    "options": given.record.options,
                }
            ),
        )
    )
    write_bytes(run_folder.report, text.encode())
    return run_folder.report


def _open(folder: RunFolder) -> _Given:
    record = load_record(folder)
    options = options_from_plain(record.options, source=str(folder.run_file))
    models = dense_models(record)
    if not models:
        raise DataError(folder.root, "has no dense cloud to report on. Run 'polmvs densify' first.")
    sparse = read_model(folder.sparse)
    clouds = {model: read_cloud(folder.cloud(model)) for model in models}
    truth = None
    if options.evaluation.gt is not None:
        truth = _open_truth(options.evaluation.gt, sparse.views)
    comparison = read_comparison(folder.metrics) if folder.metrics.is_file() else None
    return _Given(
        folder=folder,
        record=record,
        options=options,
        sparse=sparse,
        models=models,
        clouds=clouds,
        capture=_open_capture(record, options),
        truth=truth,
        comparison=comparison,
    )


def _open_capture(record: Record, options: Options) -> Capture | None:
    """The capture, if it still lies where it was."""
    if record.capture is None:
        return None
    try:
        return open_capture(record.capture.folder, options.capture)
    except PolmvsError as error:
        logger.warning("the report shows no raw polarisation: %s", error)
        return None


def _open_truth(
    folder: Path, views: Sequence[View]
) -> tuple[GroundTruth, SimilarityTransform] | None:
    """The truth with the similarity to it; None, and a warning, where it is gone."""
    try:
        truth = open_ground_truth(folder)
        named = named_as_truth(views, truth)
        return truth, align_views(named, truth.views, source=truth.cameras)[0]
    except PolmvsError as error:
        logger.warning("the report shows no errors against the truth: %s", error)
        return None


def _view_pages(given: _Given, samples: Mapping[AngleModel, ErrorSamples]) -> Iterator[ViewPage]:
    folder = given.folder
    maps = {m: open_maps(folder.sparse, folder.maps(m), m) for m in given.models}
    dense = {m: open_dense_views(folder.sparse, folder.views(m)) for m in given.models}
    raw = image_names(given.capture) if given.capture is not None else {}
    first = next(iter(maps.values()))
    white = max(float(np.percentile(one.intensity, WHITE_PERCENTILE)) for one in first)
    views = given.sparse.views
    if given.truth is not None:
        views = tuple(named_as_truth(views, given.truth[0]))
    for index, view in enumerate(views):
        name = given.sparse.views[index].name
        stokes = None
        if given.capture is not None and name in raw:
            stokes = given.capture.load(raw[name])
        yield view_page(
            ViewInput(
                view=view,
                maps={m: maps[m][index] for m in given.models},
                stokes=stokes,
                dense={m: dense[m][index] for m in given.models},
            ),
            given.truth,
            samples,
            white=max(white, 1e-9),
        )


# The 3D scene


def _layers(given: _Given) -> tuple[list[Layer], dict[str, Channel]]:
    """Clouds and meshes of all models, and what they can be coloured by."""
    sigmas = [
        np.asarray(cloud.scalars["sigma"])[_on_surface(cloud)]
        for cloud in given.clouds.values()
        if "sigma" in cloud.scalars
    ]
    finite = np.concatenate([np.zeros(0), *sigmas])
    finite = finite[np.isfinite(finite)]
    poses = given.record.result(PosesResult)
    factor, unit = (1e3, "mm") if poses.is_metric else (1.0, "of the model's unit")
    if given.truth is not None:  # the truth is metric, and so is its scale
        factor, unit = 1e3 * given.truth[1].scale, "mm"
    top = float(np.percentile(finite, 95)) * factor if len(finite) else 1.0
    channels = {
        "intensity": Channel(label="intensity"),
        "kind": KIND,
        "sigma": Channel(
            label="stated deviation of the place", unit=unit, high=top, colors=pictures.SEQUENTIAL
        ),
        "sigma_deg": Channel(
            label="stated deviation of the normal", unit="deg", high=5.0, colors=pictures.SEQUENTIAL
        ),
        "num_views": Channel(
            label="views that agree",
            unit="",
            high=float(len(given.sparse.views)),
            colors=pictures.SEQUENTIAL,
        ),
    }
    if given.truth is not None:
        channels["error"] = Channel(
            label="distance from the truth",
            unit="mm",
            high=1e3 * MAX_ERROR_M,
            colors=pictures.ERROR,
        )
        channels["normal_error"] = Channel(
            label="angle to the true normal, on the part",
            unit="deg",
            high=MAX_ERROR_DEG,
            colors=pictures.ERROR,
        )
    layers = [
        _cloud_layer(given, model, cloud, factor)
        for model, cloud in given.clouds.items()
        if len(cloud.points)
    ]
    for model in given.models:
        if given.folder.mesh(model).is_file():
            mesh = read_mesh(given.folder.mesh(model))
            values: dict[str, Floats] = {}
            if mesh.colors is not None:
                values["intensity"] = mesh.colors[:, 0] / 255
            else:
                values["intensity"] = np.full(len(mesh.vertices), 0.7)
            layers.append(
                Layer(
                    label=f"{plots.LABELS[model]} mesh",
                    points=mesh.vertices,
                    normals=mesh.normals,
                    values=values,
                    triangles=mesh.triangles,
                )
            )
    return layers, channels


def _cloud_layer(given: _Given, model: AngleModel, cloud: Cloud, factor: float) -> Layer:
    num = len(cloud.points)
    shown = {"intensity": np.full(num, 0.7) if cloud.colors is None else cloud.colors[:, 0] / 255}
    for name, values in cloud.scalars.items():
        if name in ("kind", "sigma", "sigma_deg", "num_views"):
            shown[name] = np.asarray(values, np.float64) * (factor if name == "sigma" else 1.0)
    layer = thinned(
        Layer(
            label=f"{plots.LABELS[model]} cloud",
            points=cloud.points,
            normals=np.zeros((num, 3)) if cloud.normals is None else cloud.normals,
            values=shown,
        ),
        MAX_POINTS,
    )
    if given.truth is None:
        return layer
    truth, truth_from_world = given.truth
    true = truth.surface_points()
    distance, nearest = nearest_points(
        true.points, truth_from_world * layer.points, far=MAX_ERROR_M
    )
    normals = layer.normals @ truth_from_world.rotation.T
    off = np.nan_to_num(angular_errors_deg(normals, true.normals[nearest]))
    errors = {"error": 1e3 * distance, "normal_error": off}
    return replace(layer, values={**layer.values, **errors})


def _on_surface(cloud: Cloud) -> NDArray[np.bool_]:
    kind = cloud.scalars.get("kind")
    if kind is None:
        return np.ones(len(cloud.points), np.bool_)
    return np.asarray(kind == PointKind.SURFACE)


def _scene(
    given: _Given, layers: Sequence[Layer], channels: Mapping[str, Channel]
) -> Scene3D | None:
    if not layers:
        return None
    labels = [layer.label for layer in layers]

    def index(model: AngleModel) -> int | None:
        name = f"{plots.LABELS[model]} cloud"
        return labels.index(name) if name in labels else None

    main = next((i for i in map(index, MAIN) if i is not None), 0)
    opa = next((i for i in map(index, ORTHOGRAPHIC) if i is not None), None)
    start = (opa, main) if opa is not None and opa != main else (main, None)
    return pack_scene(layers, channels, given.sparse.views, start)


def _is_thinned(given: _Given) -> bool:
    return any(len(cloud.points) > MAX_POINTS for cloud in given.clouds.values())


# Words and figures


def _title(given: _Given) -> str:
    capture = given.record.capture
    return f"{capture.folder.name}: reconstruction from polarisation" if capture else "polmvs"


def _sentence(given: _Given) -> str:
    """What a reader in a hurry takes along."""
    opa = next((m for m in ORTHOGRAPHIC if m in given.models), ORTHOGRAPHIC[0])
    main = next(m for m in MAIN if m in given.models)
    figures = given.comparison.models if given.comparison is not None else {}
    if main is opa or opa not in figures or main not in figures:
        cloud = given.record.result(DensifyResult, main)
        return f"{plots.LABELS[main]}: {cloud}."
    first, second = figures[opa].truth, figures[main].truth
    name = plots.LABELS[main]
    if first is not None and second is not None:
        near = first.cloud.thresholds_m[0]
        scores = [number(truth.cloud.f_score[0], 100, 1) for truth in (second, first)]
        angles = [number(truth.cloud.normal_mean_deg, 1, 1) for truth in (second, first)]
        return (
            f"{name} has an F-score of {scores[0]} % at {1e3 * near:g} mm and normals "
            f"{angles[0]} deg off, {plots.LABELS[opa]} {scores[1]} % and {angles[1]} deg: oblique "
            "rays turn the phase of a surface, which OPA, for which all rays are parallel, takes "
            "for shape."
        )
    before = figures[opa].consistency.phase_residual.median_deg
    after = figures[main].consistency.phase_residual.median_deg
    return (
        f"The surface found under {name} explains the measured phase to {number(after)} deg in "
        f"the median, that under {plots.LABELS[opa]} to {number(before)} deg."
    )


def _facts(given: _Given) -> list[tuple[str, str]]:
    poses, seeds = given.record.result(PosesResult), given.record.result(SeedsResult)
    main = next(m for m in MAIN if m in given.models)
    total = poses.num_views + len(poses.unregistered)
    facts = [
        ("views with a pose", f"{poses.num_views} of {total}"),
        ("sparse points", f"{poses.num_tracks:,}"),
        ("seeds on the part", f"{seeds.num_seeds:,}"),
        (
            f"points, {plots.LABELS[main]}",
            f"{given.record.result(DensifyResult, main).num_points:,}",
        ),
    ]
    if given.comparison is not None and main in given.comparison.models:
        coverage = given.comparison.models[main].consistency.coverage
        facts.append(("region covered", f"{number(coverage, 100, 1)} %"))
    facts += [
        ("time", f"{number(given.record.wall_s, 1, 1)} s"),
        ("unit", "metre" if poses.is_metric else "of the model, not metric"),
    ]
    return facts


def _tables(given: _Given) -> tuple[Table, ...]:
    """The figures to begin with, and all of them."""
    if given.comparison is None:
        return ()
    header, rows = comparison_rows(given.comparison)
    first = [row for row in rows if row[0] in HEADLINE]
    return Table(header=header, rows=first), Table(header=header, rows=rows)


def _verdict(given: _Given) -> list[str]:
    """Whether the main result is to be trusted, in one sentence."""
    main = next(m for m in MAIN if m in given.models)
    found = given.record.find(Trust, main)
    if found is None or not found.verdict:
        return []
    return [f"{plots.LABELS[main]}: {found.verdict.replace('`', '')}"]


def _trust(given: _Given) -> Table | None:
    """What the main result says about itself, with what is normal."""
    main = next(m for m in MAIN if m in given.models)
    found = given.record.find(Trust, main)
    if found is None:
        return None
    rows = [
        [
            figure.name,
            number(figure.value, 1, 2),
            f"{figure.least:g} to {figure.most:g}",
            "" if figure.is_normal else f"check {figure.remedy.replace('`', '')}",
        ]
        for figure in found.figures()
    ]
    return Table(header=[plots.LABELS[main], "value", "normal", ""], rows=rows)


def _plots(given: _Given, samples: Mapping[AngleModel, ErrorSamples]) -> list[Plot]:
    def joined(name: str) -> dict[AngleModel, Floats]:
        found = {m: np.concatenate([np.zeros(0), *getattr(s, name)]) for m, s in samples.items()}
        return {model: values for model, values in found.items() if len(values)}

    residual, viewing = joined("residual_deg"), joined("viewing_deg")
    names = ("angle between normal and ray, deg", "residual phase, deg")
    result = [
        Plot(
            svg=plots.error_curves(residual, "deg", "residual phase"),
            caption="Angle between the measured phase and that of the surface found, at pixels of "
            "all views. No truth is needed for it.",
            wide=True,
        ),
        Plot(
            svg=plots.error_against(residual, viewing, ANGLE_BINS_DEG, names),
            caption="Residual phase against the viewing angle: median and quartiles.",
        ),
    ]
    depth, normal = joined("depth_m"), joined("normal_deg")
    if depth:
        result.append(
            Plot(
                svg=plots.error_curves({m: 1e3 * e for m, e in depth.items()}, "mm", "depth error"),
                caption="Absolute errors of the depth maps against the truth.",
                wide=True,
            )
        )
    if normal:
        result.append(
            Plot(
                svg=plots.error_curves(normal, "deg", "normal error"),
                caption="Errors of the normal maps against the truth.",
                wide=True,
            )
        )
        names = (names[0], "normal error, deg")
        result.append(
            Plot(
                svg=plots.error_against(normal, joined("true_viewing_deg"), ANGLE_BINS_DEG, names),
                caption="Error of the normals against the viewing angle: median and quartiles.",
            )
        )
    result += _against_views(given)
    stages = [(stage.name, stage.seconds) for stage in given.record.stages]
    result.append(Plot(svg=plots.time_bars(stages), caption="Wall time of each stage, seconds."))
    return result


def _against_views(given: _Given) -> list[Plot]:
    """Stated deviation of the points by the number of views that agree on them."""
    sigma, count = {}, {}
    for model, cloud in given.clouds.items():
        if "sigma_deg" not in cloud.scalars or "num_views" not in cloud.scalars:
            continue
        values = np.asarray(cloud.scalars["sigma_deg"], np.float64)
        chosen = _on_surface(cloud) & np.isfinite(values)
        sigma[model] = values[chosen]
        count[model] = np.asarray(cloud.scalars["num_views"], np.float64)[chosen]
    if not any(len(values) for values in sigma.values()):
        return []
    edges = np.arange(0.5, len(given.sparse.views) + 1.5)
    names = ("views that agree on a point", "stated deviation of its normal, deg")
    return [
        Plot(
            svg=plots.error_against(sigma, count, edges, names),
            caption="Deviation that the normals are stated with against the views used.",
        )
    ]
