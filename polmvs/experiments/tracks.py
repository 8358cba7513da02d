"""Experiment 3: normals of surface points from K views (paper, 5.3, M2).

Points are random pixels of the part, back-projected with the true depth. A view is usable for a
point if it sees it (by the true depth) and the blurred pixel there is above the DoLP threshold. K
of these views are chosen, the same for every estimator; a larger K includes the views of a smaller
one.

Rows of ``opa`` and ``ppa_algebraic`` are the blurred pixels with equal weights, as in the paper.
Those of the weighted robust estimators are from phase maps, weighted by their precision.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import partial

import numpy as np

from polmvs.arrays import Array, Floats, Indices, Mask
from polmvs.config import ExperimentOptions, Selection
from polmvs.errors import OptionError
from polmvs.evaluation.metrics import angular_errors_deg
from polmvs.experiments.data import Scene, load_view, require_counted
from polmvs.normals.estimator import solve_normals
from polmvs.normals.rows import Rows, gather_rows
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.polarization.kinds import AngleModel
from polmvs.surface.surface_quality import MIN_POINTS

UNDER_DEG = 25.0  # the paper's limit
CHUNK_ROWS = 200_000  # solved at a time: bounds the memory of many views


class Source(StrEnum):
    """Source of rows."""

    PIXELS = "pixels"
    MAP = "map"


# Name of the estimator, the model and source of its rows; rows of maps are weighted and robust.
ESTIMATORS: dict[str, tuple[AngleModel, Source]] = {
    "opa": (AngleModel.OPA, Source.PIXELS),
    "opa_weighted": (AngleModel.OPA, Source.MAP),
    "ppa_algebraic": (AngleModel.PPA, Source.PIXELS),
    "ppa_weighted": (AngleModel.PPA, Source.MAP),
    "tilted_weighted": (AngleModel.TILTED, Source.MAP),
}

TRACK_LABELS = {
    "opa": "OPA, eigenvector",
    "opa_weighted": "OPA, weighted robust",
    "ppa_algebraic": "PPA, eigenvector (paper)",
    "ppa_weighted": "PPA, weighted robust",
    "tilted_weighted": "tilted, weighted robust",
}


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackErrors:
    """Angular errors of one estimator.

    Attributes
    ----------
    errors_deg : for each K, the errors of the P points with K views, 0 to 180 degrees; NaN without
        a normal.
    """

    errors_deg: tuple[Array, ...]

    def over(self, statistic: Callable[[Array], np.floating]) -> list[float]:
        """A statistic of the finite errors for each K; NaN if there are none."""
        finite = [errors[np.isfinite(errors)] for errors in self.errors_deg]
        return [float(statistic(errors)) if len(errors) else np.nan for errors in finite]

    @property
    def under(self) -> list[float]:
        """Share of the points with an error below 25 degrees; missing normals do not count."""
        shares = [(errors < UNDER_DEG) for errors in self.errors_deg]
        return [float(share.mean()) if len(share) else np.nan for share in shares]

    @property
    def valid_share(self) -> list[float]:
        """Share of the points with a normal."""
        shares = [np.isfinite(errors) for errors in self.errors_deg]
        return [float(share.mean()) if len(share) else np.nan for share in shares]


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackResult:
    """Errors of all estimators.

    Attributes
    ----------
    k : numbers of views.
    num_points : for each K, the points with that many views.
    estimators : by name.
    """

    k: tuple[int, ...]
    num_points: tuple[int, ...]
    estimators: Mapping[str, TrackErrors]


@dataclass(frozen=True, kw_only=True, eq=False)
class TruePoints:
    """N true points and normals (N, 3), true world, metres."""

    points: Array
    normals: Array


def measure_tracks(
    scene: Scene,
    options: ExperimentOptions,
    workers: Workers,
    on_progress: OnProgress = no_progress,
) -> TrackResult:
    """Errors of normals from K views for every estimator and K.

    Raises
    ------
    OptionError
        A K is below 2 or above the number of views.
    DataError
        No point is on the part, or a file is unusable.
    """
    ks = check_k(options.k, len(scene.views))
    rng = np.random.default_rng(options.seed)
    sample = sample_points(scene, options.num_points, rng, workers)
    parts = []
    for part in workers.map(partial(view_rows, scene, sample.points), range(len(scene.views))):
        parts.append(part)
        on_progress(1)
    rows = {name: _stack([part[name] for part in parts]) for name in ESTIMATORS}
    usable = np.isfinite(rows["ppa_algebraic"].sigma)
    require_counted(scene, int(usable.sum()))
    if options.select is Selection.ANGLE:
        order = order_by_angle(rows["opa"].rays, usable, max(ks), rng)
    else:
        order = order_at_random(usable, rng)
    enough = [usable.sum(axis=0) >= k for k in ks]
    return TrackResult(
        k=ks,
        num_points=tuple(int(mask.sum()) for mask in enough),
        estimators={
            name: TrackErrors(
                errors_deg=tuple(
                    _errors_deg(name, _take(rows[name], order[:k], mask), sample.normals[mask])
                    for k, mask in zip(ks, enough, strict=True)
                )
            )
            for name in ESTIMATORS
        },
    )


def sample_points(
    scene: Scene, num_points: int, rng: np.random.Generator, workers: Workers
) -> TruePoints:
    """Random pixels of the part in all views, back-projected; the same number from each view."""
    seeds = rng.integers(0, 2**63, len(scene.views)).tolist()
    quotas = np.diff(np.linspace(0, num_points, len(scene.views) + 1).round().astype(int)).tolist()
    parts = list(workers.map(partial(_sample_view, scene), range(len(scene.views)), quotas, seeds))
    return TruePoints(
        points=np.concatenate([part.points for part in parts]),
        normals=np.concatenate([part.normals for part in parts]),
    )


def _sample_view(scene: Scene, index: int, num: int, seed: int) -> TruePoints:
    """Random points that one view sees, from the true maps alone."""
    truth, name = scene.truth, scene.views[index].name
    view, depth, normals = truth.views[name], truth.depth(name), truth.normals(name)
    pixels = np.argwhere(truth.mask(name) & np.isfinite(depth) & np.isfinite(normals[..., 0]))
    if len(pixels) == 0:
        return TruePoints(points=np.zeros((0, 3)), normals=np.zeros((0, 3)))
    rows, cols = pixels[np.random.default_rng(seed).integers(0, len(pixels), num)].T
    xy = np.stack([cols + 0.5, rows + 0.5], axis=-1)
    return TruePoints(
        points=view.points_at(xy, depth[rows, cols] / view.camera.rays(xy)[:, 2]),
        normals=normals[rows, cols] @ view.cam_from_world.rotation,
    )


def view_rows(scene: Scene, points: Array, index: int) -> dict[str, Rows]:
    """Rows of N points from one view, by estimator; arrays (3, 1, N) and (1, N)."""
    data = load_view(scene, index)
    region = data.find_region(scene.region.min_dolp)
    rows = {}
    for name, (angle_model, source) in ESTIMATORS.items():
        if source is Source.PIXELS:
            phase_map = data.plain_map(angle_model)
        else:
            phase_map = data.phase_map(angle_model, region)
        rows[name] = gather_rows(
            angle_model,
            points,
            [phase_map],
            [data.range_map],
            tilt_aware=source is Source.MAP,
        )
    return rows


def _stack(parts: Sequence[Rows]) -> Rows:
    """Rows of single views side by side."""
    return Rows(
        np.concatenate([part.rows for part in parts], axis=1),
        np.concatenate([part.rays for part in parts], axis=1),
        np.concatenate([part.sigma for part in parts], axis=0),
    )


def _take(rows: Rows, order: Indices, points: Mask) -> Rows:
    """Rows of chosen views (K, N) of the points that have them."""
    columns = np.flatnonzero(points)
    chosen = order[:, columns]
    return Rows(
        rows.rows[:, chosen, columns], rows.rays[:, chosen, columns], rows.sigma[chosen, columns]
    )


def _errors_deg(name: str, rows: Rows, true_normals: Array) -> Array:
    """Errors (P,) of the normals of P points under one estimator."""
    num_views, num_points = rows.sigma.shape
    if num_points < MIN_POINTS:
        return np.zeros(0)
    robust = ESTIMATORS[name][1] is Source.MAP
    size = max(1, CHUNK_ROWS // num_views)
    normals = [
        solve_normals(
            rows.rows[:, :, start : start + size],
            rows.rays[:, :, start : start + size],
            rows.sigma[:, start : start + size],
            robust=robust,
        ).normals
        for start in range(0, num_points, size)
    ]
    return angular_errors_deg(np.concatenate(normals), true_normals)


DEFAULT_K = tuple(range(2, 21))


def check_k(k: Sequence[int] | None, num_views: int) -> tuple[int, ...]:
    """Numbers of views in ascending order; of the default only those possible with the capture.

    Raises
    ------
    OptionError
        One is below 2 or above ``num_views``, or the capture has fewer than two views.
    """
    if num_views < 2:
        raise OptionError(f"normals from tracks need 2 views or more, this capture has {num_views}")
    if k is None:
        return tuple(value for value in DEFAULT_K if value <= num_views)
    if not k or min(k) < 2 or max(k) > num_views:
        raise OptionError(
            f"must lie in 2 to {num_views}, the views of this capture with truth and pose, "
            f"not {','.join(map(str, k))}.",
            field="experiment.k",
        )
    return tuple(sorted(set(k)))


def order_at_random(usable: Mask, rng: np.random.Generator) -> Indices:
    """Views of each point (V, N) in random order, unusable ones last."""
    keys = np.where(usable, rng.random(usable.shape), 2.0)
    return np.argsort(keys, axis=0, kind="stable")


def order_by_angle(rays: Floats, usable: Mask, num: int, rng: np.random.Generator) -> Indices:
    """Views of each point (num, N): a random one, then each the farthest in angle from the others.

    Parameters
    ----------
    rays : (3, V, N), unit, world, from the views to the points.
    usable : (V, N) bool; unusable views come last.
    num : number of views to choose.
    """
    points = np.arange(usable.shape[1])
    order = order_at_random(usable, rng)[:num]
    # Largest cosine to a chosen view; 3: not usable, 2: chosen already.
    closest = np.where(usable, -1.0, 3.0)
    for step in range(1, num):
        chosen = order[step - 1]
        cosine = np.einsum("ivn,in->vn", rays, rays[:, chosen, points])
        closest = np.where(usable, np.maximum(closest, cosine), 3.0)
        for earlier in order[:step]:
            closest[earlier, points] = np.maximum(closest[earlier, points], 2.0)
        order[step] = closest.argmin(axis=0)
    return order
