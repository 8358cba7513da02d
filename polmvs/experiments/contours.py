"""Experiment 4: contours traced from seeds on the part's edge (paper, 5.4).

In each view, 20 true points along the edge of the part are the seeds. ``opa``: iso-depth contours
in the OPA direction. ``ppa_normals``: the same 2D paths, with the distance integrated along them
from normals of two views at the current point (the paper's method). ``ppa_tangent`` and
``tilted_tangent``: iso-range contours of one view. All use the phase maps of polmvs.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats, Image, Indices, Mask
from polmvs.camera import sample_image
from polmvs.config import ExperimentOptions
from polmvs.errors import DataError
from polmvs.evaluation.metrics import FAR_M
from polmvs.experiments.data import (
    EXACT_SIGMA,
    Scene,
    Truth,
    load_view,
    require_counted,
)
from polmvs.io.ground_truth import GroundTruth
from polmvs.io.layouts import BoardTruth
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import parse_json
from polmvs.neighbors import nearest_points
from polmvs.normals.estimator import solve_normals
from polmvs.normals.rows import gather_rows
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap, open_phase_map, store_phase_map, view_rays
from polmvs.scene import MIN_DISTANCE
from polmvs.surface.contour import Contours, direction_field, trace_contours
from polmvs.surface.log_range import log_range_increment

# These define the results of the experiment.
INSET_PX = 4  # of the seeds from the edge: nearer to it the background's light is mixed in
MEASURED_PX = 1.0  # distance between the measured points of a contour
MIN_SEEN_SHARE = 0.9  # share of the seeds that a second view must see

CONTOUR_LABELS = {
    "opa": "OPA, iso-depth",
    "ppa_normals": "PPA, two-view normals, same 2D paths",
    "ppa_tangent": "PPA, iso-range, one view",
    "tilted_tangent": "tilted, iso-range, one view",
}
METHODS = tuple(CONTOUR_LABELS)


@dataclass(frozen=True, kw_only=True, eq=False)
class Lines:
    """Contours of one view and method.

    Attributes
    ----------
    points : (N, 3), true world, metres, one per pixel; those of a curve in order.
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
    second : name of the image of the second rows of ``ppa_normals``; None without seeds.
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
    num_points, num_curves : numbers of measured points and curves.
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
    on_progress: OnProgress = no_progress,
    *,
    num_seeds: int = ExperimentOptions.num_seeds,
    step_px: float = ExperimentOptions.step_px,
) -> list[ViewContours]:
    """Contours of some views; the second rows may come from all views.

    Parameters
    ----------
    indices : of the views with contours.
    num_seeds : in each view.
    step_px : of the tracing, px.

    Raises
    ------
    DataError
        No pixel is counted, or a file is at fault.
    """
    with TemporaryDirectory(prefix="polmvs-contours-") as name:
        folder = Path(name)
        for angle_model in (AngleModel.PPA, AngleModel.TILTED):
            (folder / angle_model).mkdir()
        counts = []
        for counted in workers.map(partial(_store_maps, scene, folder), range(len(scene.views))):
            counts.append(counted)
            on_progress(1)
        require_counted(scene, counts)
        trace = partial(trace_view, scene, folder, num_seeds=num_seeds, step_px=step_px)
        results: list[ViewContours] = []
        for traced, second in workers.map(trace, indices):
            result = ViewContours(
                name=scene.views[indices[len(results)]].name,
                second=second,
                lines={
                    method: Lines(points=points, curve=curve, heights=surface.heights(points))
                    for method, (points, curve) in traced.items()
                },
            )
            results.append(result)
            on_progress(1)
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
    for angle_model in (AngleModel.PPA, AngleModel.TILTED):
        store_phase_map(data.phase_map(angle_model, region), folder / angle_model)
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
    seeds = own.view.points_at(seeds_xy, seed_range)
    lines = {}
    along: Floats
    sources = (
        ("opa", AngleModel.OPA),
        ("ppa_tangent", AngleModel.PPA),
        ("tilted_tangent", AngleModel.TILTED),
    )
    second = second_view(ppa_maps, index, seeds)
    for name, angle_model in sources:
        phase_map = own
        if angle_model is AngleModel.TILTED:
            phase_map = open_phase_map(own.view, folder / AngleModel.TILTED, tilted=True)
        paths = _trace(angle_model, phase_map, seeds_xy, step_px, scene.region.min_dolp)
        if angle_model is AngleModel.OPA:
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

    The outline is that of the largest connected piece, without the image's border, which is not an
    edge of the part. There are no seeds if nothing remains.
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
    return phase_map.view.points_at(paths.xy[kept], ranges[kept]), paths.curve[kept]


def _trace(
    angle_model: AngleModel, phase_map: PhaseMap, seeds_xy: Floats, step_px: float, min_dolp: float
) -> Contours:
    """Contours of a model where the view shows the part, polarized over the threshold."""
    dolp = np.hypot(phase_map.samples[..., 0], phase_map.samples[..., 1])
    passable = phase_map.region.inside & ~phase_map.region.edges & (dolp > min_dolp)
    field = direction_field(angle_model, phase_map.samples, view_rays(phase_map.view), passable)
    return trace_contours(field, seeds_xy, step_px=step_px)


def _true_ranges(scene: Scene, index: int) -> Array:
    """True distances (H, W) from the camera centre, metres; NaN where nothing is."""
    name = scene.views[index].name
    depth = scene.truth.depth(name).astype(np.float64)
    return depth / view_rays(scene.truth.views[name])[..., 2]


def second_view(maps: Sequence[PhaseMap], index: int, seeds: Array) -> int | None:
    """The view whose rows have the largest angle to those of another view at its seeds.

    Parameters
    ----------
    maps : phase maps of all views.
    index : of the first view.
    seeds : (S, 3), world.

    Returns
    -------
    Among the views with rows for at least 90 % of the seeds (else with the most), the one with the
    largest median angle; None without seeds or a second view.
    """
    if len(seeds) == 0 or len(maps) < 2:
        return None
    rows = gather_rows(AngleModel.PPA, seeds, maps)
    sine = np.linalg.norm(np.cross(rows.rows, rows.rows[:, index : index + 1], axis=0), axis=0)
    sine = np.where(np.isfinite(rows.sigma) & np.isfinite(sine), sine, np.nan)
    sine[index] = np.nan
    seen = np.isfinite(sine).sum(axis=1)
    if seen.max() == 0:
        return None
    eligible = seen >= min(MIN_SEEN_SHARE * len(seeds), seen.max())
    medians = [np.nanmedian(s) if ok else -1.0 for s, ok in zip(sine, eligible, strict=True)]
    return int(np.argmax(medians))


def step_with_normals(
    maps: Sequence[PhaseMap],
    range_maps: Sequence[Image | None],
    paths: Contours,
    seed_range: Floats,
) -> Array:
    """Distances along 2D paths, with the normal of two views at every point.

    Parameters
    ----------
    maps : of the view of the paths, and of the second view.
    range_maps : of the same views, for occlusion; see
        :func:`polmvs.normals.rows.gather_rows`.
    paths : nodes of each curve ordered by their arc, seeds at arc 0; ``curve`` counts in seeds.
    seed_range : (S,), distance of each seed from the camera centre.

    Returns
    -------
    (N,), NaN from the first point where the second view has no row or the two rows give no normal.
    """
    nodes = _halves(paths)
    view = maps[0].view
    rays = view.camera.rays(paths.xy)
    result = np.full(len(paths.xy), np.nan)
    if nodes.shape[1] == 0:
        return result
    seeds = nodes[:, 0]
    ranges = np.asarray(seed_range, np.float64)[paths.curve[seeds]]
    result[seeds] = ranges
    active = np.arange(len(nodes))
    for here, there in zip(nodes.T[:-1], nodes.T[1:], strict=True):
        active = active[there[active] >= 0]
        tail, head = rays[here[active]], rays[there[active]]
        normals = _normals(maps, range_maps, tail * ranges[active, None])
        known = np.isfinite(normals).all(axis=1)
        active = active[known]
        if len(active) == 0:
            break
        ranges[active] *= np.exp(log_range_increment(normals[known], tail[known], head[known]))
        result[there[active]] = ranges[active]
    return result


def _halves(paths: Contours) -> Indices:
    """Nodes (2 S, L) of both halves of every curve from its seed outwards, -1 after its end."""
    halves = []
    for curve in np.unique(paths.curve):
        nodes = np.flatnonzero(paths.curve == curve)
        arc = paths.arc_px[nodes]
        halves.append(nodes[arc >= 0])
        halves.append(nodes[arc <= 0][::-1])
    length = max((len(half) for half in halves), default=0)
    result = np.full((len(halves), length), -1, np.int64)
    for row, half in zip(result, halves, strict=True):
        row[: len(half)] = half
    return result


def _normals(
    maps: Sequence[PhaseMap], range_maps: Sequence[Image | None], points_in_cam: Array
) -> Array:
    """Normals (N, 3) in the frame of the first view, NaN where the views do not give one."""
    first = maps[0].view.cam_from_world
    rows = gather_rows(AngleModel.PPA, first.inverse() * points_in_cam, maps, range_maps)
    # As in the paper, which has no noise model: two rows that are not parallel give a normal.
    sigma = np.where(np.isfinite(rows.sigma), EXACT_SIGMA, np.inf)
    estimate = solve_normals(rows.rows, rows.rays, sigma, robust=False)
    return np.asarray(estimate.normals @ first.rotation.T, np.float64)


class TrueSurface(Protocol):
    """Distance of points to a surface."""

    @property
    def description(self) -> str:
        """Description for the record."""

    def heights(self, points: Floats) -> Array:
        """Signed distance (N,) of points (N, 3), true world; positive outside, in its units."""


@dataclass(frozen=True, eq=False)
class PlaneSurface:
    """The plane ``normal . x = offset`` with a unit normal (3,)."""

    normal: Array
    offset: float
    description: str = "plane, exact"

    def heights(self, points: Floats) -> Array:
        """Signed distance (N,) of points (N, 3)."""
        return np.asarray(points @ self.normal - self.offset, np.float64)


@dataclass(frozen=True, eq=False)
class SampledSurface:
    """Points (N, 3) of a surface with unit normals (N, 3); distances are to tangent planes."""

    points: Array
    normals: Array
    spacing: float
    description: str = "tangent plane of the nearest true point"

    def heights(self, points: Floats) -> Array:
        """Signed distance (N,); to the nearest point beyond the end of the surface."""
        distances, nearest = nearest_points(self.points, np.asarray(points, np.float64), far=FAR_M)
        offsets = points - self.points[nearest]
        heights = np.einsum("ij,ij->i", offsets, self.normals[nearest])
        beside = np.sqrt(np.maximum(distances**2 - heights**2, 0)) > 3 * self.spacing
        sign = np.where(heights < 0, -1.0, 1.0)
        return np.asarray(np.where(beside, sign * distances, heights), np.float64)


def open_surface(truth: Truth) -> TrueSurface:
    """The part's surface: exact if the ground truth has a plane, else sampled.

    Raises
    ------
    DataError
        The ground truth has neither.
    """
    if isinstance(truth, BoardTruth):
        return PlaneSurface(truth.normal, truth.offset)
    scene_path = truth.folder / "scene.json"
    if scene_path.is_file():
        try:
            surface = parse_json(read_text(scene_path))["surface"]
            if surface["type"] == "plane":
                return _plane(surface["normal"], surface["offset"])
        except (OSError, ValueError, KeyError, TypeError, OverflowError) as error:
            raise DataError(scene_path, f"does not describe the surface ({error}).") from error
    if not isinstance(truth, GroundTruth):
        raise DataError(truth.folder, "has no surface that contours can be measured against.")
    sampling = truth.surface_points()
    part = sampling.is_part & np.isfinite(sampling.normals).all(axis=1)
    return SampledSurface(
        sampling.points[part], sampling.normals[part].astype(np.float64), sampling.spacing_m
    )


def _plane(normal: Any, offset: Any) -> PlaneSurface:
    """The plane ``normal . x = offset``.

    Raises
    ------
    TypeError, ValueError, OverflowError
        The numbers make none.
    """
    along, level = np.array(normal, np.float64), float(offset)
    length = float(np.linalg.norm(along))
    if along.shape != (3,) or not (MIN_DISTANCE < length < np.inf) or not np.isfinite(level):
        raise ValueError("its plane has no normal of three numbers, or no offset")
    return PlaneSurface(along / length, level / length)


def line_set_bytes(lines: Sequence[Lines], *, stride: int = 4) -> bytes:
    """A binary PLY of contours; neighbours on a curve are connected.

    Parameters
    ----------
    lines : of any number of views, true world, metres.
    stride : between the kept points of a curve.

    Returns
    -------
    Vertices with ``height_mm``, the signed distance to the true surface; edges between them.
    """
    vertex = np.dtype([("x", "<f8"), ("y", "<f8"), ("z", "<f8"), ("height_mm", "<f4")])
    points, curves, heights, offset = [], [], [], 0
    for line in lines:
        points.append(line.points[::stride])
        heights.append(line.heights[::stride])
        curves.append(line.curve[::stride] + offset)
        offset += int(line.curve.max(initial=-1)) + 1
    vertices = np.zeros(sum(map(len, points)), vertex)
    if len(vertices):
        place = np.concatenate(points)
        vertices["x"], vertices["y"], vertices["z"] = place.T
        vertices["height_mm"] = 1e3 * np.concatenate(heights)
    curve = np.concatenate(curves) if curves else np.zeros(0, np.int64)
    tails = np.flatnonzero(curve[1:] == curve[:-1])
    edges = np.stack([tails, tails + 1], axis=-1).astype("<i4")
    header = [
        "ply",
        "format binary_little_endian 1.0",
        "comment contours in the world of the ground truth, metres",
        f"element vertex {len(vertices)}",
        *(f"property double {axis}" for axis in "xyz"),
        "property float height_mm",
        f"element edge {len(edges)}",
        "property int vertex1",
        "property int vertex2",
        "end_header",
    ]
    return ("\n".join(header) + "\n").encode() + vertices.tobytes() + edges.tobytes()
