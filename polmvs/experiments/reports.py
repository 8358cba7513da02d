"""Each experiment from a scene to its report: measured, drawn and put into words."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from polmvs.config import ExperimentOptions
from polmvs.experiments import figures, tables
from polmvs.experiments.contours import METHODS, ViewContours, measure_contours, pool_lines
from polmvs.experiments.data import Scene
from polmvs.experiments.inputs import view_indices
from polmvs.experiments.lines_io import line_set_bytes
from polmvs.experiments.output import Report
from polmvs.experiments.phase import measure_phase, phase_images
from polmvs.experiments.plane import TILT_FACTOR, measure_plane
from polmvs.experiments.surfaces import open_surface
from polmvs.experiments.tracks import measure_tracks
from polmvs.parallel import Workers

Progress = Callable[[int], None]

NUM_FIGURE_VIEWS = 3

# What the paper measured on its own data, 282 images of a real board.
PAPER = {
    "phase": "OPA -0.18° and 20.90° (mean, RMSE), PPA 0.35° and 5.90°, ratio 28 %",
    "plane": "eigenvector 2.68° mean, 1.16° RMSE (as the paper calls it)",
    "tracks": "under 25° with K = 3: PPA 80 %, OPA 26 %",
    "contours": "PPA with two-view normals 2.2 mm RMSE, OPA 9.6 mm, ratio 23 %",
}


def run_experiment(
    name: str, scene: Scene, options: ExperimentOptions, workers: Workers, progress: Progress
) -> Report:
    """Run one of the experiments.

    Raises
    ------
    PolmvsError
        The capture or its truth does not allow it.
    """
    runners = {
        "phase": _run_phase,
        "plane": _run_plane,
        "tracks": _run_tracks,
        "contours": _run_contours,
    }
    return runners[name](scene, options, workers, progress)


def num_steps(name: str, scene: Scene, options: ExperimentOptions) -> int:
    """How often an experiment reports progress."""
    num = len(scene.views)
    if name != "contours":
        return num
    chosen = view_indices(options.views, scene)
    return num + (num if chosen is None else len(chosen))


def figure_views(scene: Scene, options: ExperimentOptions) -> tuple[int, ...]:
    """Indices of the views that are shown: the user's, or a few evenly spread."""
    chosen = view_indices(options.views, scene)
    if chosen is not None:
        return chosen
    num = min(NUM_FIGURE_VIEWS, len(scene.views))
    return tuple((np.arange(num) * len(scene.views) // num).tolist())


def _run_phase(
    scene: Scene, options: ExperimentOptions, workers: Workers, progress: Progress
) -> Report:
    result = measure_phase(scene, workers, progress)
    shown = [phase_images(scene, index) for index in figure_views(scene, options)]
    text = (
        f"Predicted minus measured phase, degrees, over {_pixels(scene)}; "
        f"{_blur(scene)}. {_poses(scene)} {_paper('phase')}\n\n{tables.phase_table(result)}"
    )
    captions = (
        "Density of the phase error against viewing angle, azimuth difference and zenith angle",
        "Intensity, measured phase and the phases that the models predict",
    )
    return Report(
        name="phase",
        title="Phase of the forward models",
        content={"settings": scene.settings(), **tables.phase_json(result)},
        text=text,
        figures={
            "phase_density.png": (captions[0], figures.draw_phase_density(result)),
            "phase_maps.png": (captions[1], figures.draw_phase_maps(shown)),
        },
        lines={},
    )


def _run_plane(
    scene: Scene, options: ExperimentOptions, workers: Workers, progress: Progress
) -> Report:
    result = measure_plane(scene, workers, progress, planar_deg=options.planar_deg)
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
        f"share. {_poses(scene)} {_paper('plane')}\n\n{tables.plane_table(result)}"
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
            **tables.plane_json(result),
        },
        text=text,
        figures={"plane_errors.png": (caption, figures.draw_plane(result))},
        lines={},
    )


def _run_tracks(
    scene: Scene, options: ExperimentOptions, workers: Workers, progress: Progress
) -> Report:
    result = measure_tracks(scene, options, workers, progress)
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
        f"single pixels, {_blur(scene)}, all alike. Weighted robust: the package's phase maps, "
        f"smoothed over reliable pixels. {_poses(scene)} {_paper('tracks')}\n\n"
        f"{tables.tracks_table(result)}"
    )
    return Report(
        name="tracks",
        title="Normals of surface points from K views",
        content={"settings": settings, **tables.tracks_json(result)},
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
        lines={},
    )


def _run_contours(
    scene: Scene, options: ExperimentOptions, workers: Workers, progress: Progress
) -> Report:
    surface = open_surface(scene.truth)
    chosen = view_indices(options.views, scene)
    indices = range(len(scene.views)) if chosen is None else chosen
    views = measure_contours(
        scene,
        surface,
        indices,
        workers,
        progress,
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
        f"{tables.contours_table(stats)}"
    )
    caption = "Contours of one view, seen along the surface"
    return Report(
        name="contours",
        title="Contours from seeds on the edge",
        content={"settings": settings, **tables.contours_json(views, stats)},
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
