"""Each experiment from a scene to its report: measurement, figures and text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from polmvs.config import ExperimentOptions
from polmvs.evaluation.tables import format_table
from polmvs.experiments import figures
from polmvs.experiments.contours import (
    CONTOUR_LABELS,
    METHODS,
    LineStats,
    ViewContours,
    line_set_bytes,
    measure_contours,
    open_surface,
    pool_lines,
)
from polmvs.experiments.data import MODEL_LABELS, Scene, view_indices
from polmvs.experiments.output import Report
from polmvs.experiments.phase import (
    PhaseResult,
    SignedStats,
    measure_phase,
    phase_images,
    ratio,
    ratio_to_opa,
)
from polmvs.experiments.plane import (
    ESTIMATES,
    PLANE_LABELS,
    TILT_FACTOR,
    PlaneResult,
    measure_plane,
)
from polmvs.experiments.tracks import (
    ESTIMATORS,
    TRACK_LABELS,
    UNDER_DEG,
    TrackErrors,
    TrackResult,
    check_k,
    measure_tracks,
)
from polmvs.parallel import OnProgress, Workers
from polmvs.polarization.kinds import AngleModel

NUM_FIGURE_VIEWS = 3

# Results of the paper on its own data, 282 images of a real board.
PAPER = {
    "phase": "OPA -0.18° and 20.90° (mean, RMSE), PPA 0.35° and 5.90°, ratio 28 %",
    "plane": "eigenvector 2.68° mean, 1.16° RMSE (as the paper calls it)",
    "tracks": "under 25° with K = 3: PPA 80 %, OPA 26 %",
    "contours": "PPA with two-view normals 2.2 mm RMSE, OPA 9.6 mm, ratio 23 %",
}


def check_options(scene: Scene, options: ExperimentOptions, names: Sequence[str]) -> None:
    """Refuse impossible options before anything is measured.

    Parameters
    ----------
    scene : data of the experiments.
    options : of the experiments.
    names : experiments to run.

    Raises
    ------
    OptionError
        A view is unknown, or there are fewer views than requested.
    """
    view_indices(options.views, scene)
    if "tracks" in names:
        check_k(options.k, len(scene.views))


def run_experiment(
    name: str, scene: Scene, options: ExperimentOptions, workers: Workers, on_progress: OnProgress
) -> Report:
    """Run one of the experiments.

    Raises
    ------
    PolmvsError
        The capture or its ground truth does not allow it.
    """
    runners = {
        "phase": _run_phase,
        "plane": _run_plane,
        "tracks": _run_tracks,
        "contours": _run_contours,
    }
    return runners[name](scene, options, workers, on_progress)


def num_steps(name: str, scene: Scene, options: ExperimentOptions) -> int:
    """Number of steps that an experiment reports."""
    num = len(scene.views)
    if name != "contours":
        return num
    chosen = view_indices(options.views, scene)
    return num + (num if chosen is None else len(chosen))


def figure_views(scene: Scene, options: ExperimentOptions) -> tuple[int, ...]:
    """Indices of the shown views: the user's, or a few evenly spread."""
    chosen = view_indices(options.views, scene)
    if chosen is not None:
        return chosen
    num = min(NUM_FIGURE_VIEWS, len(scene.views))
    return tuple((np.arange(num) * len(scene.views) // num).tolist())


def _run_phase(
    scene: Scene, options: ExperimentOptions, workers: Workers, on_progress: OnProgress
) -> Report:
    result = measure_phase(scene, workers, on_progress)
    shown = [phase_images(scene, index) for index in figure_views(scene, options)]
    text = (
        f"Predicted minus measured phase, degrees, over {_pixels(scene)}; "
        f"{_blur(scene)}. {_poses(scene)} {_paper('phase')}\n\n{phase_table(result)}"
    )
    captions = (
        "Density of the phase error against viewing angle, azimuth difference and zenith angle",
        "Intensity, measured phase and the phases that the models predict",
    )
    return Report(
        name="phase",
        title="Phase of the forward models",
        content={"settings": scene.settings(), **phase_json(result)},
        text=text,
        figures={
            "phase_density.png": (captions[0], figures.draw_phase_density(result)),
            "phase_maps.png": (captions[1], figures.draw_phase_maps(shown)),
        },
    )


def _run_plane(
    scene: Scene, options: ExperimentOptions, workers: Workers, on_progress: OnProgress
) -> Report:
    result = measure_plane(scene, workers, on_progress, planar_deg=options.planar_deg)
    settings = {
        **scene.settings(),
        "planar_deg": options.planar_deg,
        "tilt_factor": TILT_FACTOR,
    }
    pixels = [image.num_pixels for image in result.per_image]
    text = (
        f"Angle between the normal of one view and the true one; {min(pixels)} to {max(pixels)} "
        f"pixels an image, {_pixels(scene)}, with true normals within {options.planar_deg:g}° of "
        f"one of them; {_blur(scene)}. Tilt-aware weights count {TILT_FACTOR:g} times what a "
        "tilted polarizer would turn a phase by into its uncertainty: an error that neighbours "
        f"share. {_poses(scene)} {_paper('plane')}\n\n{plane_table(result)}"
    )
    if not result.is_planar:
        text += (
            f"\nThis part is curved: the regions are patches whose true normals spread by "
            f"{result.spread_deg:.1f}° (RMS). In one view curvature looks like "
            "perspective: these are the errors of calling such a patch a plane.\n"
        )
    caption = "Angular error of the normal of each image; phase residual of its twin"
    return Report(
        name="plane",
        title="Normal of a planar region from one view",
        content={
            "settings": settings,
            "is_planar": result.is_planar,
            "normal_spread_deg": result.spread_deg,
            **plane_json(result),
        },
        text=text,
        figures={"plane_errors.png": (caption, figures.draw_plane(result))},
    )


def _run_tracks(
    scene: Scene, options: ExperimentOptions, workers: Workers, on_progress: OnProgress
) -> Report:
    result = measure_tracks(scene, options, workers, on_progress)
    settings = {
        **scene.settings(),
        "num_points": options.num_points,
        "selection": options.select,
        "seed": options.seed,
    }
    text = (
        f"Angle between multi-view and true normals of {options.num_points} random pixels of the "
        f"part, from K views ({options.select}) that see them with a DoLP above "
        f"{scene.region.min_dolp:g}; a point without so many views is left out. Eigenvector: "
        f"single pixels, {_blur(scene)}, all alike. Weighted robust: the package's phase maps. "
        f"{_poses(scene)} {_paper('tracks')}\n\n"
        f"{tracks_table(result)}"
    )
    return Report(
        name="tracks",
        title="Normals of surface points from K views",
        content={"settings": settings, **tracks_json(result)},
        text=text,
        figures={
            "tracks_k3.png": (
                "Histogram and cumulative distribution of the errors with three views",
                figures.draw_track_distribution(result),
            ),
            "tracks_mean.png": (
                "Mean and median error against the number of views",
                figures.draw_track_means(result),
            ),
            "tracks_box.png": (
                "Errors against the number of views",
                figures.draw_track_boxes(result),
            ),
        },
    )


def _run_contours(
    scene: Scene, options: ExperimentOptions, workers: Workers, on_progress: OnProgress
) -> Report:
    surface = open_surface(scene.truth)
    chosen = view_indices(options.views, scene)
    indices = range(len(scene.views)) if chosen is None else chosen
    views = measure_contours(
        scene,
        surface,
        indices,
        workers,
        on_progress,
        num_seeds=options.num_seeds,
        step_px=options.step_px,
    )
    stats = {method: pool_lines(views, method) for method in METHODS}
    shown = _typical(views)
    settings: dict[str, Any] = {
        **scene.settings(),
        "num_seeds": options.num_seeds,
        "step_px": options.step_px,
        "surface": surface.description,
        "figure_view": shown.name,
    }
    text = (
        f"Distance to the true surface ({surface.description}) of contours from "
        f"{options.num_seeds} true points along the edge of the part in each of {len(views)} "
        f"views, steps of {options.step_px:g} px, where the smoothed DoLP exceeds "
        f"{scene.region.min_dolp:g}. {_poses(scene)} {_paper('contours')}\n\n"
        f"{contours_table(stats)}"
    )
    caption = "Contours of one view, seen along the surface"
    return Report(
        name="contours",
        title="Contours from seeds on the edge",
        content={"settings": settings, **contours_json(views, stats)},
        text=text,
        figures={"contours.png": (caption, figures.draw_contours(shown))},
        lines={
            f"contours_{method}.ply": line_set_bytes([view.lines[method] for view in views])
            for method in METHODS
        },
    )


def _typical(views: Sequence[ViewContours]) -> ViewContours:
    """The view whose OPA contours have the median error."""
    errors = [np.nan_to_num(view.lines["opa"].rmse_mm, nan=-1.0) for view in views]
    return views[int(np.argsort(errors)[len(views) // 2])]


def _pixels(scene: Scene) -> str:
    return f"pixels of the part with a DoLP above {scene.region.min_dolp:g}, not clipped"


def _blur(scene: Scene) -> str:
    if scene.blur_px <= 0:
        return "images not blurred"
    return f"images blurred by a Gaussian of {scene.blur_px:g} px before phase and DoLP are taken"


def _paper(name: str) -> str:
    return f"The paper, on its own data: {PAPER[name]}."


def _poses(scene: Scene) -> str:
    if scene.alignment is None:
        return f"True poses, {len(scene.views)} views."
    a = scene.alignment
    return (
        f"Poses from SfM, {len(scene.views)} views, aligned by the camera centres "
        f"({a.rms_residual_mm:.2f} mm RMS, {a.rotation_error_median_deg:.3f}° median rotation)."
    )


def phase_json(result: PhaseResult) -> dict[str, Any]:
    """Content of ``phase.json`` beside the settings."""
    return {
        **_with_ratios(result.all_pixels),
        "outside_marks": _with_ratios(result.unmarked),
        "rmse_deg_per_view": result.per_view,
    }


def _with_ratios(stats: Mapping[AngleModel, SignedStats]) -> dict[str, Any]:
    return {
        **{angle_model.value: of_model for angle_model, of_model in stats.items()},
        "ratio_ppa_opa": ratio_to_opa(stats, AngleModel.PPA),
        "ratio_tilted_opa": ratio_to_opa(stats, AngleModel.TILTED),
    }


def phase_table(result: PhaseResult) -> str:
    """Phase errors, all pixels and those outside of printed marks."""
    rows = []
    for where, stats in (
        ("all valid pixels", result.all_pixels),
        ("outside printed marks", result.unmarked),
    ):
        rows += [[where, *_phase_row(m, s, ratio_to_opa(stats, m))] for m, s in stats.items()]
    head = ["pixels", "model", "mean", "RMSE", "median", "95 %", "RMSE / OPA", "number"]
    return _table(head, rows)


def _phase_row(angle_model: AngleModel, stats: SignedStats, share: float) -> list[str]:
    return [
        MODEL_LABELS[angle_model],
        f"{stats.mean_deg:+.2f}°",
        f"{stats.rmse_deg:.2f}°",
        f"{stats.median_deg:.2f}°",
        f"{stats.p95_deg:.2f}°",
        f"{100 * share:.1f} %",
        f"{stats.num_pixels}",
    ]


def plane_json(result: PlaneResult) -> dict[str, Any]:
    """Content of ``plane.json`` beside the settings."""
    estimates = {
        name: {
            **asdict(stats),
            "seconds": result.seconds[name],
            "num_failed": result.failed[name],
        }
        for name, stats in result.stats.items()
    }
    return {
        **estimates,
        "per_image": result.per_image,
        "skipped": result.skipped,
        "pi_ambiguity": result.ambiguity,
    }


def plane_table(result: PlaneResult) -> str:
    """Errors and times of the single-view normals, and the ambiguity of pi."""
    rows = [
        [
            PLANE_LABELS[name],
            f"{result.stats[name].mean_deg:.3f}°",
            f"{result.stats[name].rmse_deg:.3f}°",
            f"{result.stats[name].median_deg:.3f}°",
            f"{1e3 * result.seconds[name]:.1f} ms",
            f"{result.stats[name].count} of {len(result.per_image)}",
        ]
        for name in ESTIMATES
    ]
    errors = _table(["estimate", "mean", "RMSE", "median", "time", "images"], rows)
    twins = [
        [
            MODEL_LABELS[angle_model],
            f"{a.rmse_deg:.2f}°",
            f"{a.rmse_turned_deg:.2f}°",
            f"{100 * a.determined_share:.0f} %",
        ]
        for angle_model, a in result.ambiguity.items()
    ]
    head = ["model", "residual of the true normal", "of its twin turned by π", "views determined"]
    return f"{errors}\n{_table(head, twins)}"


def tracks_json(result: TrackResult) -> dict[str, Any]:
    """Content of ``tracks.json`` beside the settings."""
    return {
        "k": result.k,
        "num_points": result.num_points,
        **{name: _track_json(errors) for name, errors in result.estimators.items()},
    }


def _track_json(errors: TrackErrors) -> dict[str, list[float]]:
    return {
        "mean_deg": errors.over(np.mean),
        "median_deg": errors.over(np.median),
        "p80_deg": errors.over(lambda e: np.percentile(e, 80)),
        "under_25": errors.under,
        "valid_share": errors.valid_share,
    }


def tracks_table(result: TrackResult) -> str:
    """Errors of the normals from tracks, for some numbers of views."""
    shown = [i for i, k in enumerate(result.k) if k in (2, 3, 5, 10, 15, 20)] or [0]
    head = ["estimator", "statistic", *(f"K = {result.k[i]}" for i in shown)]
    rows = []
    for name in ESTIMATORS:
        content = _track_json(result.estimators[name])
        for key, label in (("mean_deg", "mean"), ("median_deg", "median"), ("p80_deg", "80 %")):
            values = [f"{content[key][i]:.2f}°" for i in shown]
            rows.append([TRACK_LABELS[name], label, *values])
        shares = [f"{100 * content['under_25'][i]:.1f} %" for i in shown]
        rows.append([TRACK_LABELS[name], f"under {UNDER_DEG:.0f}°", *shares])
    rows.append(["points", "", *(str(result.num_points[i]) for i in shown)])
    return _table(head, rows)


def contours_json(views: Sequence[ViewContours], stats: Mapping[str, LineStats]) -> dict[str, Any]:
    """Content of ``contours.json`` beside the settings."""
    opa = stats["opa"].rmse_mm
    return {
        **stats,
        "ratio_to_opa": {name: ratio(stats[name].rmse_mm, opa) for name in METHODS},
        "per_view": [
            {
                "name": view.name,
                "second": view.second,
                "rmse_mm": {name: line.rmse_mm for name, line in view.lines.items()},
            }
            for view in views
        ],
    }


def contours_table(stats: Mapping[str, LineStats]) -> str:
    """Distance of the contours to the true surface."""
    rows = [
        [
            CONTOUR_LABELS[name],
            f"{s.rmse_mm:.2f} mm",
            f"{s.median_mm:.2f} mm",
            f"{s.p95_mm:.2f} mm",
            f"{100 * ratio(s.rmse_mm, stats['opa'].rmse_mm):.1f} %",
            f"{s.num_curves}",
            f"{s.num_points}",
        ]
        for name, s in stats.items()
    ]
    return _table(["contours", "RMSE", "median", "95 %", "RMSE / OPA", "curves", "points"], rows)


def _table(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """A Markdown table, a dash where there is no number."""
    return format_table(head, rows).replace("nan", "–") + "\n"
