"""``OUT/report.html``: the results of a finished run in one self-contained file."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.arrays import Floats
from polmvs.colmap.models import read_model
from polmvs.config import Options, default_num_workers, to_plain
from polmvs.errors import DataError, PolmvsError
from polmvs.evaluation.comparison import (
    Comparison,
    comparison_rows,
    named_as_truth,
    read_comparison,
)
from polmvs.evaluation.consistency import first_seen, is_labelled, phase_residuals_deg
from polmvs.evaluation.metrics import angular_errors_deg
from polmvs.evaluation.tables import number
from polmvs.evaluation.trust import Trust
from polmvs.geometry import SimilarityTransform
from polmvs.io.clouds import Cloud, Mesh, read_cloud, read_mesh
from polmvs.io.ground_truth import GroundTruth, open_ground_truth
from polmvs.io.images import read_gray, write_bytes
from polmvs.neighbors import nearest_points
from polmvs.parallel import OnProgress, no_progress
from polmvs.pipeline.record import Record
from polmvs.pipeline.run_folder import SURFACE_MESH, RunFolder
from polmvs.pipeline.runner import dense_models, load_run
from polmvs.pipeline.stages.densify import DensifyResult, open_dense_views
from polmvs.pipeline.stages.images import image_names
from polmvs.pipeline.stages.maps import open_maps
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.pipeline.stages.seeds import SeedsResult
from polmvs.polarization.capture import WHITE_PERCENTILE, Capture, open_capture
from polmvs.polarization.kinds import AngleModel
from polmvs.poses.alignment import align_views
from polmvs.poses.crop_box import marker_frames
from polmvs.report import pictures, plots
from polmvs.report.contents import (
    MAX_ERROR_DEG,
    MAX_ERROR_M,
    ORTHOGRAPHIC,
    DisplayUnit,
    ErrorSamples,
    ViewInput,
    view_page,
)
from polmvs.report.deviation_section import (
    FoundDeviation,
    deviation_layer,
    deviation_section,
    open_deviation,
)
from polmvs.report.layers import KIND, BoxFrame, Layer, PointColoring, Scene3D, pack_scene, thinned
from polmvs.report.page import Page, Plot, Table, ViewPage, page_text
from polmvs.scene import PointKind, SparseModel, View
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh

logger = logging.getLogger(__name__)


MAX_POINTS = 150_000  # of each cloud on the page: two clouds turn smoothly, and 2 MB each
ANGLE_BINS_DEG = np.arange(0.0, 91.0, 5.0)
# Rows of the comparison that best show the difference of the models.
HEADLINE = (
    "coverage, %",
    "phase residual over all views, RMSE / median, deg",
    "depth maps, RMSE, mm",
    "F-score at 1 mm, %",
    "Chamfer distance, mm",
    "normal error, mean / median, deg",
)
# Colour scales that end where 95 % of the worst layer's values do, and at most here.
ADAPTED = {"residual": MAX_ERROR_DEG, "normal_error": MAX_ERROR_DEG, "error": 1e3 * MAX_ERROR_M}
SIZE_PERCENTILES = (0.5, 99.5)
MIN_SIZED = 100  # least number of points for a size
SIZED = 5000  # points for a size: its ends are exact to some of their spacings
# Models that represent the run, in order of preference.
MAIN = (
    AngleModel.PPA,
    AngleModel.TILTED,
    AngleModel.TEXTBOOK_PPA,
    AngleModel.OPA,
    AngleModel.TEXTBOOK_OPA,
)


@dataclass(frozen=True, kw_only=True)
class ReportInput:
    """A finished run, opened.

    Attributes
    ----------
    models : those with points, OPA first.
    capture : None if it is missing or has changed.
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
    deviation: FoundDeviation | None

    @property
    def main(self) -> AngleModel:
        """The model that represents the run."""
        return next(model for model in MAIN if model in self.models)

    @property
    def is_metric(self) -> bool:
        """Whether the unit is the metre."""
        return self.record.result(PosesResult).is_metric

    @property
    def length(self) -> DisplayUnit:
        """Unit of the shown lengths; with ground truth the scale is metric."""
        if self.truth is not None:
            return DisplayUnit("mm", 1e3 * self.truth[1].scale)
        return DisplayUnit("mm", 1e3) if self.is_metric else DisplayUnit("model units")


def write_report(run_folder: RunFolder, *, on_progress: OnProgress = no_progress) -> Path:
    """Write the report of a run; an existing one is replaced.

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
    for page, errors in _view_pages(given):
        views.append(page)
        for model, own in errors.items():
            samples[model].extend(own)
        on_progress(1)
    layers, channels = scene_layers(given)
    scene = _scene(given, layers, channels)
    is_thinned = any(len(cloud.points) > MAX_POINTS for cloud in given.clouds.values())
    size = [f"The part is about {sides} in size." for sides in _size(given)]
    text = page_text(
        Page(
            title=_title(given),
            sentence=" ".join([*_verdict(given), *size, *_quality_words(given)]),
            facts=_facts(given),
            warnings=warnings_of(given),
            tables=_tables(given),
            trust=trust_table(given),
            views=views,
            plots=_plots(given, samples),
            deviation=deviation_section(given.deviation),
            scene=scene,
            thinned=MAX_POINTS if is_thinned else 0,
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


def _open(folder: RunFolder) -> ReportInput:
    record, options = load_run(folder)
    models = dense_models(record)
    if not models:
        raise DataError(folder.root, "has no dense cloud to report on. Run 'polmvs densify' first.")
    sparse = read_model(folder.sparse)
    clouds = {model: read_cloud(folder.cloud(model)) for model in models}
    truth = None
    if options.evaluation.gt is not None:
        truth = _open_truth(options.evaluation.gt, sparse.views)
    comparison = read_comparison(folder.metrics) if folder.metrics.is_file() else None
    return ReportInput(
        folder=folder,
        record=record,
        options=options,
        sparse=sparse,
        models=models,
        clouds=clouds,
        capture=_open_capture(record, options),
        truth=truth,
        comparison=comparison,
        deviation=open_deviation(folder, clouds),
    )


def _open_capture(record: Record, options: Options) -> Capture | None:
    """The capture, if its folder still exists."""
    if record.capture is None:
        return None
    try:
        return open_capture(record.capture.folder, options.capture)
    except PolmvsError as error:
        logger.warning("the report shows no raw polarization: %s", error)
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


def _view_pages(given: ReportInput) -> Iterator[tuple[ViewPage, dict[AngleModel, ErrorSamples]]]:
    folder = given.folder
    maps = {m: open_maps(folder, m) for m in given.models}
    dense = {m: open_dense_views(folder, m) for m in given.models}
    raw = image_names(given.capture) if given.capture is not None else {}
    first = next(iter(maps.values()))
    white = max(float(np.percentile(one.intensity, WHITE_PERCENTILE)) for one in first)
    views = given.sparse.views
    mesh = _mesh_of(given, given.main)
    surface = None
    if mesh is not None:
        surface = RayScene(TriangleMesh.of(mesh))
    if given.truth is not None:
        views = tuple(named_as_truth(views, given.truth[0]))

    def page_of(index: int) -> tuple[ViewPage, dict[AngleModel, ErrorSamples]]:
        name = given.sparse.views[index].name
        stokes = None
        if given.capture is not None and name in raw:
            stokes = given.capture.load(raw[name])
        return view_page(
            ViewInput(
                view=views[index],
                maps={m: maps[m][index] for m in given.models},
                stokes=stokes,
                dense={m: dense[m][index] for m in given.models},
            ),
            given.truth,
            white=max(white, 1e-9),
            length=given.length,
            mesh=surface,
        )

    # Threads, as encoding pictures and casting rays release Python's lock.
    with ThreadPoolExecutor(default_num_workers()) as pool:
        yield from pool.map(page_of, range(len(views)))


def _mesh_of(given: ReportInput, model: AngleModel) -> Mesh | None:
    """The mesh of a model: the run's, or the one that its cloud was made from."""
    for path in (given.folder.mesh(model), given.folder.views(model) / SURFACE_MESH):
        if path.is_file():
            mesh = read_mesh(path)
            return mesh if len(mesh.triangles) else None
    return None


# The 3D scene


def scene_layers(given: ReportInput) -> tuple[list[Layer], dict[str, PointColoring]]:
    """Clouds and meshes of all models, and what they can be coloured by."""
    if given.truth is not None:
        given.truth[0].surface_points()  # once, before the threads
    shown = {model: cloud for model, cloud in given.clouds.items() if len(cloud.points)}
    with ThreadPoolExecutor(default_num_workers()) as pool:
        layers = list(pool.map(partial(_cloud_layer, given), shown, shown.values()))
    for model in given.models:
        if (mesh := _mesh_of(given, model)) is not None:
            layers.append(_mesh_layer(model, mesh, layers))
    channels = _point_colorings(given)
    if given.deviation is not None and not given.deviation.is_stale:
        layer, channels["deviation"] = deviation_layer(given.deviation)
        layers.append(thinned(layer, MAX_POINTS))
    for name, limit in ADAPTED.items():
        if name in channels:
            channels[name] = replace(channels[name], high=_top(layers, name, limit))
    used = {name for layer in layers for name in layer.values}
    return layers, {name: one for name, one in channels.items() if name in used}


def _point_colorings(given: ReportInput) -> dict[str, PointColoring]:
    """Quantities that colour a run's points."""
    sigmas = [
        np.asarray(cloud.scalars["sigma"])[cloud.are(PointKind.SURFACE)]
        for cloud in given.clouds.values()
        if "sigma" in cloud.scalars
    ]
    finite = np.concatenate([np.zeros(0), *sigmas])
    finite = finite[np.isfinite(finite)]
    top = float(np.percentile(finite, 95)) * given.length.factor if len(finite) else 1.0
    channels = {
        "intensity": PointColoring(label="intensity", note="Brightness in the photographs."),
        "kind": KIND,
        "residual": PointColoring(
            label="phase residual",
            unit="deg",
            colors=pictures.ERROR,
            note="Angle between the measured phase and the one that the surface predicts, mean of "
            "the views that see a point. Needs no ground truth.",
            may_lack=True,
        ),
        "sigma": PointColoring(
            label="position uncertainty (1 sigma)",
            unit=given.length.name,
            high=top,
            colors=pictures.SEQUENTIAL,
            note="Standard deviation of a place along its normal, by its own statement.",
        ),
        "sigma_deg": PointColoring(
            label="normal uncertainty (1 sigma)",
            unit="deg",
            high=5.0,
            colors=pictures.SEQUENTIAL,
            note="Standard deviation of the surface's direction, by its own statement.",
        ),
        "num_views": PointColoring(
            label="views that agree",
            unit="views",
            high=float(len(given.sparse.views)),
            colors=pictures.SEQUENTIAL,
            note="Photographs that agree on a point, in place and normal.",
        ),
    }
    if given.truth is not None:
        channels["error"] = PointColoring(
            label="distance to ground truth",
            unit="mm",
            colors=pictures.ERROR,
            note="From each point to the true surface.",
        )
        channels["normal_error"] = PointColoring(
            label="angle to the true normal, on the part",
            unit="deg",
            colors=pictures.ERROR,
            note="Between the surface's direction and the true one.",
            may_lack=True,
        )
    return channels


def _mesh_layer(model: AngleModel, mesh: Mesh, layers: Sequence[Layer]) -> Layer:
    """A mesh with the values of the cloud's nearest points."""
    label = model.label
    values: dict[str, NDArray[Any]] = {}
    of_cloud = next((layer for layer in layers if layer.label == f"{label} cloud"), None)
    if of_cloud is not None:
        kind = of_cloud.values.get("kind", np.zeros(len(of_cloud.points)))
        own = np.flatnonzero(np.isin(kind, (PointKind.SURFACE, PointKind.INFERRED)))
        if len(own):
            nearest = own[cKDTree(of_cloud.points[own]).query(mesh.vertices)[1]]
            # Kinds are names, which cannot change gradually over a triangle.
            names = [name for name in of_cloud.values if name != "kind"]
            values = {name: of_cloud.values[name][nearest] for name in names}
    if not values:
        values["intensity"] = np.full(len(mesh.vertices), 0.7)
    return Layer(
        label=f"{label} mesh",
        points=mesh.vertices,
        normals=mesh.normals,
        values=values,
        triangles=mesh.triangles,
    )


def _top(layers: Sequence[Layer], name: str, limit: float) -> float:
    """End of a colour scale: what 95 % of the worst layer's values keep to, as a round number."""
    tops = []
    for layer in layers:
        values = np.asarray(layer.values.get(name, ()), np.float64)
        if np.isfinite(values).any():
            tops.append(float(np.nanpercentile(values, 95)))
    wanted = min(max(tops, default=limit), limit)
    steps = limit / np.array([1, 2, 4, 10, 20, 40, 100])
    return float(steps[steps >= 0.999 * wanted].min())


def _cloud_layer(given: ReportInput, model: AngleModel, cloud: Cloud) -> Layer:
    num, factor = len(cloud.points), given.length.factor
    shown = {"intensity": np.full(num, 0.7) if cloud.colors is None else cloud.colors[:, 0] / 255}
    for name, values in cloud.scalars.items():
        if name in ("kind", "sigma", "sigma_deg", "num_views"):
            shown[name] = np.asarray(values, np.float64) * (factor if name == "sigma" else 1.0)
    layer = thinned(
        Layer(
            label=f"{model.label} cloud",
            points=cloud.points,
            normals=np.zeros((num, 3)) if cloud.normals is None else cloud.normals,
            values=shown,
        ),
        MAX_POINTS,
    )
    layer = replace(
        layer, values={**layer.values, "residual": _residuals(given, model, layer, cloud)}
    )
    if given.truth is None:
        return layer
    truth, truth_from_world = given.truth
    true = truth.surface_points()
    distance, nearest = nearest_points(
        true.points, truth_from_world * layer.points, far=MAX_ERROR_M
    )
    normals = layer.normals @ truth_from_world.rotation.T
    off = angular_errors_deg(normals, true.normals[nearest])
    off[np.linalg.norm(normals, axis=1) < 0.5] = np.nan
    errors = {"error": 1e3 * distance, "normal_error": off}
    return replace(layer, values={**layer.values, **errors})


def _residuals(given: ReportInput, model: AngleModel, layer: Layer, cloud: Cloud) -> Floats:
    """Mean residual phase of each point over the views that see it, degrees; NaN without one."""
    total, count = np.zeros(len(layer.points)), np.zeros(len(layer.points))
    on_surface = np.flatnonzero(np.linalg.norm(layer.normals, axis=1) > 0.5)
    points, normals = layer.points[on_surface], layer.normals[on_surface]
    for phase_map in open_maps(given.folder, model):
        visible, _ = first_seen(points, normals, phase_map.view, phase_map.shows_surface)
        found = phase_residuals_deg(
            model, points[visible], normals[visible], phase_map, labelled=is_labelled(cloud)
        )
        known = np.isfinite(found)
        index = on_surface[visible][known]
        total[index] += found[known]
        count[index] += 1
    mean = np.full(len(total), np.nan)
    seen = count > 0
    mean[seen] = total[seen] / count[seen]
    return mean


def _scene(
    given: ReportInput, layers: Sequence[Layer], channels: Mapping[str, PointColoring]
) -> Scene3D | None:
    if not layers:
        return None
    labels = [layer.label for layer in layers]

    def index(model: AngleModel) -> int | None:
        name = f"{model.label} cloud"
        return labels.index(name) if name in labels else None

    main = next((i for i in map(index, MAIN) if i is not None), 0)
    opa = next((i for i in map(index, ORTHOGRAPHIC) if i is not None), None)
    start = (opa, main) if opa is not None and opa != main else (main, None)
    color = "normal"
    if start[1] is not None:
        color = "normal_error" if "normal_error" in channels else "residual"
    return pack_scene(
        layers,
        channels,
        given.sparse.views,
        start,
        color=color,
        unit=(given.length.name, given.length.factor),
        frames=_box_frames(given),
    )


def _box_frames(given: ReportInput) -> list[BoxFrame]:
    """Frames of the printed markers that the run's scale came from."""
    aruco = given.options.reference.aruco
    if aruco is None:
        return []
    try:
        frames = marker_frames(
            given.sparse.views, aruco, lambda name: read_gray(given.folder.images / name)
        )
    except PolmvsError as error:
        logger.warning("the report offers no box in a marker's frame: %s", error)
        return []
    return [
        BoxFrame(f"marker {marker}", f"--box-marker={marker}", frame)
        for marker, frame in frames.items()
    ]


# Words and figures


def _title(given: ReportInput) -> str:
    """The result of the run in a sentence."""
    capture = given.record.capture
    name = capture.folder.name if capture else given.folder.root.name
    num_views = given.record.result(PosesResult).num_views
    points = given.record.result(DensifyResult, given.main).num_points
    return f"{name}: {num_views} views became a surface of {points:,} points"


def _size(given: ReportInput) -> list[str]:
    """Extents of the part along its main directions; empty where lengths have no unit."""
    surface = given.clouds[given.main]
    points = surface.points[surface.are(PointKind.SURFACE)]
    if not (given.is_metric or given.truth is not None) or len(points) < MIN_SIZED:
        return []
    sides = " x ".join(f"{given.length.factor * side:.0f}" for side in _sides(points))
    return [f"{sides} {given.length.name}"]


def _sides(points: Floats) -> Floats:
    """Sides (3,) of a box about points (N, 3): the smallest of those on their mean plane."""
    some = np.asarray(points[:: max(1, len(points) // SIZED)], np.float64)
    centered = some - some.mean(axis=0)
    along = centered @ np.linalg.eigh(centered.T @ centered)[1][:, ::-1]
    best = np.full(3, np.inf)
    for turn in np.radians(np.arange(0.0, 90.0)):
        cos, sin = np.cos(turn), np.sin(turn)
        turned = along @ np.array([[cos, -sin, 0], [sin, cos, 0], [0, 0, 1]])
        sides = np.ptp(np.percentile(turned, SIZE_PERCENTILES, axis=0), axis=0)
        if sides[0] * sides[1] < best[0] * best[1]:
            best = sides
    return np.sort(best)[::-1]


def _quality_words(given: ReportInput) -> list[str]:
    """Quality of the surface, compared with that under OPA if it was computed."""
    main = given.main
    figures = given.comparison.models if given.comparison is not None else {}
    if main not in figures:
        return _uncertainty_words(given)
    name, truth = main.label, figures[main].truth
    opa = next((m for m in ORTHOGRAPHIC if m in figures and m is not main), None)
    other = None if opa is None else figures[opa]
    older = "" if opa is None else f"the older orthographic model ({opa.label})"
    if truth is not None:
        near = f"{1e3 * truth.cloud.thresholds_m[0]:g} mm"
        right, covered = truth.cloud.accuracy[0], truth.cloud.completeness[0]
        words = [
            f"{number(right, 100, 1)} % of the points lie within {near} of the true surface and "
            f"cover {number(covered, 100, 1)} % of it ({name})."
        ]
        if other is not None and other.truth is not None:
            right, covered = other.truth.cloud.accuracy[0], other.truth.cloud.completeness[0]
            words.append(
                f"Under {older} it is {number(right, 100, 1)} % and {number(covered, 100, 1)} %: "
                "it takes what perspective does to the polarization angle for shape."
            )
        return words
    residual = figures[main].consistency.phase_residual.median_deg
    sentence = (
        f"The polarization angles that the surface predicts differ from the measured ones by "
        f"{number(residual)} deg in the median ({name})"
    )
    if other is not None:
        before = other.consistency.phase_residual.median_deg
        sentence += f", under {older} by {number(before)} deg"
    return [sentence + "."]


def _uncertainty_words(given: ReportInput) -> list[str]:
    """Median uncertainty of the points."""
    cloud = given.clouds[given.main]
    sigma = np.asarray(cloud.scalars.get("sigma", ()), np.float64)
    known = sigma[cloud.are(PointKind.SURFACE)] if len(sigma) else sigma
    known = known[np.isfinite(known)]
    if not len(known):
        return []
    typical = given.length.text(float(np.median(known)))
    return [
        f"Half of its points are known to {typical} or better along the normal, by their own "
        "statement (one standard deviation)."
    ]


def warnings_of(given: ReportInput) -> tuple[str, ...]:
    """Warnings of the run, and of its comparison with a reference."""
    warnings = [w for stage in given.record.stages for w in stage.warnings]
    if given.deviation is not None and given.deviation.is_stale:
        warnings.append(
            "the deviation from the reference is of an earlier cloud of this run and is not shown; "
            "'polmvs deviation' makes it anew."
        )
    return tuple(warnings)


def _facts(given: ReportInput) -> list[tuple[str, str]]:
    poses, seeds = given.record.result(PosesResult), given.record.result(SeedsResult)
    main = given.main
    total = poses.num_views + len(poses.unregistered)
    facts = [
        ("views with a pose", f"{poses.num_views} of {total}"),
        ("sparse points", f"{poses.num_tracks:,}"),
        ("seeds on the part", f"{seeds.num_seeds:,}"),
        (
            f"points, {main.label}",
            f"{given.record.result(DensifyResult, main).num_points:,}",
        ),
    ]
    facts += [("size", sides) for sides in _size(given)]
    if given.comparison is not None and main in given.comparison.models:
        coverage = given.comparison.models[main].consistency.coverage
        facts.append(("region covered", f"{number(coverage, 100, 1)} %"))
    facts += [
        ("time", f"{number(given.record.wall_s, 1, 1)} s"),
        ("scale", "metric, in metres" if poses.is_metric else "unknown: model units"),
    ]
    return facts


def _tables(given: ReportInput) -> tuple[Table, ...]:
    """The figures to begin with, and all of them."""
    if given.comparison is None:
        return ()
    header, rows = comparison_rows(given.comparison)
    first = [row for row in rows if row[0] in HEADLINE]
    return Table(header=header, rows=first), Table(header=header, rows=rows)


def _verdict(given: ReportInput) -> list[str]:
    """Whether the main result is to be trusted, in one sentence."""
    main = given.main
    found = given.record.find(Trust, main)
    if found is None or not found.verdict:
        return []
    return [f"{main.label}: {found.verdict.replace('`', '')}"]


def trust_table(given: ReportInput) -> Table | None:
    """Quality checks of the main result with their normal ranges."""
    main = given.main
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
    return Table(header=[main.label, "value", "normal", ""], rows=rows)


def _plots(given: ReportInput, samples: Mapping[AngleModel, ErrorSamples]) -> list[Plot]:
    def joined(name: str) -> dict[AngleModel, Floats]:
        found = {m: np.concatenate([np.zeros(0), *getattr(s, name)]) for m, s in samples.items()}
        return {model: values for model, values in found.items() if len(values)}

    residual, viewing = joined("residual_deg"), joined("viewing_deg")
    names = ("angle between normal and ray, deg", "residual phase, deg")
    result = [
        Plot(
            svg=plots.error_curves(residual, "deg", "residual phase"),
            caption="Angle between the measured phase and that of the surface found, at pixels of "
            "all views. It needs no ground truth.",
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


def _against_views(given: ReportInput) -> list[Plot]:
    """Stated deviation of the points by the number of views that agree on them."""
    sigma, count = {}, {}
    for model, cloud in given.clouds.items():
        if "sigma_deg" not in cloud.scalars or "num_views" not in cloud.scalars:
            continue
        values = np.asarray(cloud.scalars["sigma_deg"], np.float64)
        chosen = cloud.are(PointKind.SURFACE) & np.isfinite(values)
        sigma[model] = values[chosen]
        count[model] = np.asarray(cloud.scalars["num_views"], np.float64)[chosen]
    if not any(len(values) for values in sigma.values()):
        return []
    edges = np.arange(0.5, len(given.sparse.views) + 1.5)
    names = ("views that agree on a point", "uncertainty (1 sigma) of its normal, deg")
    return [
        Plot(
            svg=plots.error_against(sigma, count, edges, names),
            caption="Deviation that the normals are stated with against the views used.",
        )
    ]
