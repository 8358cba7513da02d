"""Consistency of a cloud with its capture, without ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Floats, Mask
from polmvs.camera import depth_buffer, sample_image
from polmvs.evaluation.metrics import MIN_DOLP, AngleStats, axial_errors_deg
from polmvs.geometry import unit
from polmvs.io.clouds import Cloud
from polmvs.polarization.angle_models import phase_from_normal
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.polarization.region import Region
from polmvs.scene import PointKind, View

# These define the figures; they are no tolerances of an algorithm.
MAX_RESIDUAL_POINTS = 100_000  # points of a cloud, evenly spread, for phase residuals
CELL_PX = 4  # cell of coverage and occlusion: wider than the spacing of the cloud
MAX_RELATIVE_EXCESS = 0.01  # ratio of a visible point's distance to the nearest one in its cell


@dataclass(frozen=True, kw_only=True)
class Consistency:
    """Fit of a cloud's polarized surface to its capture.

    Attributes
    ----------
    num_points : of the cloud, on the polarized surface.
    phase_residual : angle between the phase that a point's normal predicts, under the cloud's
        model, and the measured one, over all views that see the point
        (:func:`phase_residuals_deg`).
    coverage : share of the bounded region's pixels, over all views, that show a point of the cloud.
    agreement : share of the views that see a point which agree with it in position and normal.
    track_residual_median_deg : angle between the normals of the sparse points and their planes
        of incidence, over the points on the polarized surface.
    """

    num_points: int
    phase_residual: AngleStats
    coverage: float
    agreement: float
    track_residual_median_deg: float


def measure_consistency(
    angle_model: AngleModel,
    cloud: Cloud,
    tracks: Cloud,
    maps: Sequence[PhaseMap],
    outside: Mapping[str, Mask] = MappingProxyType({}),
) -> Consistency:
    """Compare the polarized surface of a cloud with the phase maps of all views.

    Parameters
    ----------
    angle_model : of the cloud.
    cloud : dense, with normals and, if it has points, ``num_views``. Points whose ``kind`` is
        that of the surroundings are left out; without a ``kind`` all are of the surface.
    tracks : sparse points with ``residual`` and ``seed``.
    maps : of all views.
    outside : pixels (H, W) of each view, by its name, that show what is outside the crop box; they
        are ignored.
    """
    cloud = cloud.only(cloud.are(PointKind.SURFACE))
    num = len(cloud.points)
    step = -(-num // MAX_RESIDUAL_POINTS) or 1
    covered = inside = 0
    seeing = np.zeros(num, np.int64)
    errors = [np.zeros(0)]
    for whole in maps:
        phase_map = within_box(whole, outside)
        cells = _region_cells(phase_map.region.bounded)
        inside += int(cells.sum())
        if num == 0 or cloud.normals is None:
            continue
        visible, nearest = first_seen(
            cloud.points, cloud.normals, phase_map.view, phase_map.shows_surface
        )
        covered += int((np.isfinite(nearest) & cells).sum())
        seeing += visible
        chosen = np.flatnonzero(visible[::step]) * step
        points, normals = cloud.points[chosen], cloud.normals[chosen]
        errors.append(
            phase_residuals_deg(
                angle_model, points, normals, phase_map, labelled=is_labelled(cloud)
            )
        )
    # Views in which the cells hide a point may still have confirmed it.
    confirmed = np.minimum(cloud.scalars.get("num_views", np.zeros(num)), seeing)
    return Consistency(
        num_points=num,
        phase_residual=AngleStats.from_degrees(np.concatenate(errors)),
        coverage=covered / inside if inside else float("nan"),
        agreement=float(confirmed.sum() / max(seeing.sum(), 1)) if num else float("nan"),
        track_residual_median_deg=_track_residual(tracks),
    )


def within_box(phase_map: PhaseMap, outside: Mapping[str, Mask]) -> PhaseMap:
    """The map, its region without pixels that show something outside a box.

    Points behind a surface that the box cut away then do not count as visible.
    """
    if phase_map.view.name not in outside:
        return phase_map
    region = phase_map.region
    inside = region.inside & ~outside[phase_map.view.name]
    kept = Region(
        inside=inside,
        reliable=region.reliable & inside,
        edges=region.edges,
        unbounded=None if region.unbounded is None else region.unbounded & inside,
    )
    return phase_map.changed(region=kept)


def _track_residual(tracks: Cloud) -> float:
    """Median over the seeds; NaN where there are none."""
    residuals = tracks.scalars.get("residual", np.zeros(0))
    used = (tracks.scalars.get("seed", np.zeros(0)) > 0) & np.isfinite(residuals)
    if not used.any():
        return float("nan")
    return float(np.degrees(np.arcsin(min(float(np.median(residuals[used])), 1.0))))


def first_seen(
    points: Floats, normals: Floats, view: View, shows: Callable[[Floats], Mask]
) -> tuple[Mask, NDArray[np.float64]]:
    """Points that face a view, project into shown pixels, and have no clearly nearer point there.

    Parameters
    ----------
    points, normals : (N, 3), world.
    shows : whether image coordinates (M, 2), inside the image, may show points.

    Returns
    -------
    visible : (N,) bool
    cells : (H / CELL_PX, W / CELL_PX), rounded up: distance of the nearest point, inf without.
    """
    seen = np.flatnonzero(view.faces(points, normals))
    xy = view.project(points[seen])
    shown = shows(xy)
    seen, xy = seen[shown], xy[shown]
    distance = view.ranges(points[seen])
    camera = view.camera
    cells, nearest = depth_buffer(xy, distance, camera.width, camera.height, cell_px=CELL_PX)
    visible = np.zeros(len(points), np.bool_)
    visible[seen] = distance <= (1 + MAX_RELATIVE_EXCESS) * nearest
    return visible, cells


def _region_cells(inside: Mask) -> Mask:
    """Cells of CELL_PX px whose centre lies inside."""
    half = CELL_PX // 2
    padded = np.pad(inside, ((0, CELL_PX), (0, CELL_PX)))
    shape = tuple(-(-side // CELL_PX) for side in inside.shape)
    return np.asarray(padded[half::CELL_PX, half::CELL_PX][: shape[0], : shape[1]])


def is_labelled(cloud: Cloud) -> bool:
    """Whether a cloud's normals come with the light of each observation (`--method surface`)."""
    return "diffuse" in cloud.scalars


def phase_residuals_deg(
    angle_model: AngleModel,
    points: Floats,
    normals: Floats,
    phase_map: PhaseMap,
    *,
    labelled: bool,
) -> NDArray[np.float64]:
    """Axial difference between predicted and measured phase at points, degrees.

    Parameters
    ----------
    points, normals : (N, 3), world.
    labelled : whether the light of each observation was inferred with the normals
        (:func:`is_labelled`). Light of the other kind turns the phase by 90 deg: the smaller
        difference counts, 22.5 deg by chance.

    Returns
    -------
    (N,), NaN where the view shows no polarized light.
    """
    view = phase_map.view
    rays = unit(view.cam_from_world * points)
    predicted = phase_from_normal(
        angle_model.formula, normals @ view.cam_from_world.rotation.T, rays
    )
    samples = sample_image(phase_map.samples, view.project(points))
    measured = 0.5 * np.arctan2(samples[:, 1], samples[:, 0])
    counted = (samples[:, 2] > 0) & (np.hypot(samples[:, 0], samples[:, 1]) > MIN_DOLP)
    difference = axial_errors_deg(measured, predicted)
    if labelled:
        difference = np.minimum(difference, 90 - difference)
    return np.where(counted, difference, np.nan)


def best_fitting_model(found: Mapping[AngleModel, Consistency]) -> AngleModel | None:
    """The model under which the planes of incidence of many views best intersect in one normal.

    The criterion is the median angle between normals and planes of incidence of the sparse points
    on the surface, whose positions do not depend on a model. None without such points.
    """
    residuals = {angle_model: one.track_residual_median_deg for angle_model, one in found.items()}
    known = {angle_model: value for angle_model, value in residuals.items() if np.isfinite(value)}
    return min(known, key=lambda angle_model: known[angle_model]) if known else None
