"""Experiment 4: contours traced from seeds on the part's edge (paper, 5.4).

Of each view: 20 true points along the edge of the part are the seeds. ``opa``: iso-depth contours
in the OPA direction. ``ppa_normals``: the same 2D paths, the distance stepped along them with
normals from two views at the place reached so far (the paper's way). ``ppa_tangent`` and
``tilted_tangent``: iso-range contours of the view alone. All use the same phase maps, smoothed
over the reliable pixels.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.config import AngleModel, ExperimentOptions
from polmvs.experiments.data import Scene, load_view, require_counted
from polmvs.experiments.surfaces import TrueSurface
from polmvs.experiments.two_views import second_view, step_with_normals
from polmvs.parallel import Workers
from polmvs.polarization.phase_map import PhaseMap, open_phase_map, store_phase_map, view_rays
from polmvs.surface.contour import Contours, direction_field, trace_contours

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

INSET_PX = 4  # of the seeds: nearer to the edge the blurred light of the background is mixed in
MEASURED_PX = 1.0  # distance between the points of a contour that are measured

METHODS = ("opa", "ppa_normals", "ppa_tangent", "tilted_tangent")


@dataclass(frozen=True, kw_only=True, eq=False)
class Lines:
    """Contours of one view and method.

    Attributes
    ----------
    points : (N, 3), true world, metres, one a pixel; those of a curve in order.
    curve : (N,) int, index of the seed.
    heights : (N,), signed distance to the true surface, metres.
    """

    points: Array
    curve: NDArray[np.int64]
    heights: Array

    @property
    def rmse_mm(self) -> float:
        """Root mean square distance to the true surface, mm; NaN without points."""
        return 1e3 * float(np.sqrt(np.mean(self.heights**2))) if len(self.heights) else np.nan


@dataclass(frozen=True, kw_only=True, eq=False)
class ViewContours:
    """Contours of one view by method.

    Attributes
    ----------
    name : of the image.
    second : name of the image that gave the second rows of ``ppa_normals``; None without seeds.
    lines : by method.
    """

    name: str
    second: str | None
    lines: Mapping[str, Lines]


@dataclass(frozen=True, kw_only=True)
class LineStats:
    """Distance of the contours' points to the true surface, mm, over all views.

    Attributes
    ----------
    rmse_mm, median_mm, p95_mm : of the absolute distances; NaN without points.
    num_points, num_curves : that were measured.
    """

    rmse_mm: float
    median_mm: float
    p95_mm: float
    num_points: int
    num_curves: int


def measure_contours(
    scene: Scene,
    surface: TrueSurface,
    indices: Sequence[int],
    workers: Workers,
    report: Callable[[int], None] = lambda count: None,
    *,
    num_seeds: int = ExperimentOptions.num_seeds,
    step_px: float = ExperimentOptions.step_px,
) -> list[ViewContours]:
    """Contours of some views; all views may give the second rows.

    Parameters
    ----------
    indices : of the views that contours are traced in.
    num_seeds : in each view.
    step_px : of the tracing, px.

    Raises
    ------
    DataError
        No pixel is counted, or a file is at fault.
    """
    with TemporaryDirectory(prefix="polmvs-contours-") as name:
        folder = Path(name)
        for model in (AngleModel.PPA, AngleModel.TILTED):
            (folder / model).mkdir()
        counts = []
        for counted in workers.map(partial(_store_maps, scene, folder), range(len(scene.views))):
            counts.append(counted)
            report(1)
        require_counted(scene, counts)
        trace = partial(trace_view, scene, folder, num_seeds=num_seeds, step_px=step_px)
        results: list[ViewContours] = []
        for traced, second in workers.map(trace, indices):
            result = ViewContours(
                name=scene.views[indices[len(results)]].name,
                second=second,
                lines={m: _measured(*line, surface) for m, line in traced.items()},
            )
            results.append(result)
            report(1)
        return results


def pool_lines(views: Sequence[ViewContours], method: str) -> LineStats:
    """Statistics of one method over all views."""
    lines = [view.lines[method] for view in views]
    distances = 1e3 * np.abs(np.concatenate([line.heights for line in lines]))
    known = len(distances) > 0
    median, p95 = np.percentile(distances, (50, 95)) if known else (np.nan, np.nan)
    return LineStats(
        rmse_mm=float(np.sqrt(np.mean(distances**2))) if known else np.nan,
        median_mm=float(median),
        p95_mm=float(p95),
        num_points=len(distances),
        num_curves=sum(len(np.unique(line.curve)) for line in lines),
    )


def _store_maps(scene: Scene, folder: Path, index: int) -> int:
    """Store the phase maps of one view, as captured and corrected; the number of counted pixels."""
    data = load_view(scene, index)
    region = data.find_region(scene.region.min_dolp)
    for model in (AngleModel.PPA, AngleModel.TILTED):
        store_phase_map(data.phase_map(model, region), folder / model)
    return int(data.counted.sum())


def trace_view(
    scene: Scene, folder: Path, index: int, *, num_seeds: int, step_px: float
) -> tuple[dict[str, tuple[Array, NDArray[np.int64]]], str | None]:
    """World points (N, 3) and curves (N,) of all methods in one view, and the second view.

    ``folder`` has the stored phase maps of all views.
    """
    ppa_maps = [open_phase_map(view, folder / AngleModel.PPA) for view in scene.views]
    own = ppa_maps[index]
    ranges = np.nan_to_num(_true_ranges(scene, index))
    seeds_xy = edge_seeds(own.region.inside & (ranges > 0), num_seeds)
    seed_range = sample_image(ranges.astype(np.float32), seeds_xy, nearest=True)
    seeds = _to_world(own, seeds_xy, seed_range)
    lines = {}
    along: Floats
    sources = (
        ("opa", AngleModel.OPA),
        ("ppa_tangent", AngleModel.PPA),
        ("tilted_tangent", AngleModel.TILTED),
    )
    second = second_view(ppa_maps, index, seeds)
    for name, model in sources:
        phase_map = own
        if model is AngleModel.TILTED:
            phase_map = open_phase_map(own.view, folder / AngleModel.TILTED, tilted=True)
        paths = _trace(model, phase_map, seeds_xy, step_px, scene.region.min_dolp)
        if model is AngleModel.OPA:
            depths = seed_range * own.view.camera.rays(seeds_xy)[:, 2]
            along = depths[paths.curve] / own.view.camera.rays(paths.xy)[:, 2]
            stepped = np.full(len(paths.xy), np.nan)
            if second is not None:
                hidden = [None, np.nan_to_num(_true_ranges(scene, second)).astype(np.float32)]
                maps = [own, ppa_maps[second]]
                stepped = step_with_normals(maps, hidden, paths, seed_range)
            lines["ppa_normals"] = _thinned(own, paths, stepped)
        else:
            along = seed_range[paths.curve]
        lines[name] = _thinned(own, paths, along)
    return lines, None if second is None else ppa_maps[second].view.name


def edge_seeds(part: Mask, num: int) -> NDArray[np.float32]:
    """Image coordinates (S, 2) spread evenly along the outline of the part, a little inside.

    The outline is that of the largest connected piece, without what the image's border cuts off:
    that is no edge of the part. No seeds where nothing is left.
    """
    eroded = cv2.erode(
        part.astype(np.uint8), np.ones((2 * INSET_PX + 1,) * 2, np.uint8), borderValue=0
    )
    outlines = cv2.findContours(eroded, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]
    if not outlines:
        return np.zeros((0, 2), np.float32)
    outline = max(outlines, key=len)[:, 0]
    far_side = np.array(part.shape[::-1]) - 1 - INSET_PX
    outline = outline[((outline > INSET_PX) & (outline < far_side)).all(axis=1)].astype(np.float32)
    if len(outline) == 0:
        return np.zeros((0, 2), np.float32)
    places = (np.arange(num) + 0.5) * (len(outline) / num)
    return np.asarray(outline[places.astype(int)] + 0.5, np.float32)


def _thinned(
    phase_map: PhaseMap, paths: Contours, ranges: Floats
) -> tuple[Array, NDArray[np.int64]]:
    """World points (N, 3) once a pixel, and their curves (N,); only where a distance is known."""
    step = np.rint(np.abs(paths.arc_px) / MEASURED_PX) * MEASURED_PX
    # The node nearest to each whole pixel; steps need not divide a pixel.
    nearest = np.abs(np.abs(paths.arc_px) - step) <= 0.25 * MEASURED_PX
    kept = nearest & np.isfinite(ranges)
    return _to_world(phase_map, paths.xy[kept], ranges[kept]), paths.curve[kept]


def _trace(
    model: AngleModel, phase_map: PhaseMap, seeds_xy: Floats, step_px: float, min_dolp: float
) -> Contours:
    """Contours of a model where the view shows the part, polarised over the threshold."""
    dolp = np.hypot(phase_map.samples[..., 0], phase_map.samples[..., 1])
    passable = phase_map.region.inside & ~phase_map.region.edges & (dolp > min_dolp)
    field = direction_field(model, phase_map.samples, view_rays(phase_map.view), passable)
    return trace_contours(field, seeds_xy, step_px=step_px)


def _true_ranges(scene: Scene, index: int) -> Array:
    """True distances (H, W) from the camera centre, metres; NaN where nothing is."""
    name = scene.views[index].name
    depth = scene.truth.depth(name).astype(np.float64)
    return depth / view_rays(scene.truth.views[name])[..., 2]


def _to_world(phase_map: PhaseMap, xy: Floats, ranges: Floats) -> Array:
    """World points (N, 3) of image coordinates (N, 2) at distances (N,)."""
    in_cam = phase_map.view.camera.rays(xy) * np.asarray(ranges, np.float64)[:, None]
    return np.asarray(phase_map.view.cam_from_world.inverse() * in_cam, np.float64)


def _measured(points: Array, curve: NDArray[np.int64], surface: TrueSurface) -> Lines:
    return Lines(points=points, curve=curve, heights=surface.heights(points))
