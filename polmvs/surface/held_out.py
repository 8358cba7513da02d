"""Held-out views: a check of a surface with data that it was not fitted to.

A surface that was fitted to phases and silhouettes agrees with them, right or wrong: each point may
have either kind of light, and a bent surface follows its data. So some views are left out, a coarse
surface is made from the others, and the left-out views are predicted from it. With wrong poses, a
wrong camera, wrong light or wrong masks, the predictions fail.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from polmvs.geometry import dots, points_on_rays
from polmvs.polarization.kinds import Light
from polmvs.scene import MIN_VIEWS
from polmvs.surface.dense_view import lattice_xy
from polmvs.surface.ground import SupportingPlane
from polmvs.surface.mesh_geometry import RayScene, SignedDistance, TriangleMesh
from polmvs.surface.observations import Image, Looking, level_image, rows_of_both
from polmvs.surface.open_scene import OpenScene
from polmvs.surface.solver import Level, SolverTolerances, first_fit, refine
from polmvs.surface.surface_view import SurfaceView
from polmvs.surface.terms import KnownPoints
from polmvs.surface.vessels import opened_hull
from polmvs.surface.visual_hull import VisualHull, visual_hull

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_PREDICTING = MIN_VIEWS  # least number of views for a surface
STRIDE_PX = 4
# By chance, the error under the nearer of two kinds of light is uniform in 0 to 45 deg: 22.5 deg in
# the median; under one kind it is in 0 to 90.
CHANCE_DEG = (22.5, 45.0)
# A phase with a larger deviation has little information: by chance it agrees within two deviations
# at half of the pixels.
MAX_SIGMA_DEG = 6.0
# A residual larger than this under both kinds of light is not noise (facets, marks, light from
# elsewhere); by chance it is larger at 78 % of the pixels. Guess.
UNEXPLAINED_DEG = 10.0
MIN_PHASES = 50  # least number of phases of one view for a median
MIN_SINE = 0.1  # between ray and normal, for a phase to be defined


@dataclass(frozen=True, kw_only=True)
class HeldOutTolerances:
    """Tolerances of held-out views.

    Attributes
    ----------
    share : one of so many views is left out at a time. Guess.
    levels : of the coarse refinement. Measured: on three captures the error of its predictions is
        that of the solver's first two levels, in 0.45 of the time; on one it is 15 % larger.
    careful_levels : of a second trial if the first predicts badly, as it may have been too short.
    doubtful_deg : error above which there is a second trial. Measured: right results had 1.1 to 2.4
        deg; one of them 10 at first, and 0.6 at the second trial.
    width_px : of the smoothing of the predicted phases.
    """

    share: int = 4
    levels: tuple[Level, ...] = (
        Level(edge_px=10.0, num_steps=6, loss_scale=12.0, gate_px=25.0),
        Level(edge_px=6.0, num_steps=5, loss_scale=8.0, gate_px=8.0),
    )
    careful_levels: tuple[Level, ...] = SolverTolerances().levels[:3]
    doubtful_deg: float = 4.0
    width_px: float = 1.0


@dataclass(frozen=True, kw_only=True)
class ViewError:
    """Median error of the phases of one view, as ``error_deg`` of :class:`Prediction`."""

    name: str
    error_deg: float


@dataclass(frozen=True, kw_only=True)
class Prediction:
    """How well a surface predicts views.

    Attributes
    ----------
    num_views : number of predicted views.
    num_phases : number of their phases, at every few pixels, with a small enough deviation.
    error_deg : median angle about the ray between the measured plane of incidence, under the
        nearer kind of light, and the surface's normal.
    chance_deg : this median for normals that are independent of the phases.
    within : share of the phases within two of their stated deviations.
    unexplained : share that neither kind of light explains: farther from both than 10 deg and
        three deviations.
    overlap : intersection over union of silhouettes and their predictions; unknown pixels are
        ignored.
    views : errors of each view that has enough phases.
    moved : share of the surface of all views that lies farther than a coarse edge from the
        predicting one; None if they cannot be compared.
    """

    num_views: int
    num_phases: int
    error_deg: float
    chance_deg: float
    within: float
    unexplained: float
    overlap: float
    views: tuple[ViewError, ...] = ()
    moved: float | None = None

    def inconsistent_view(self, limit_deg: float) -> str | None:
        """The view, if exactly one of several, that is predicted worse than a limit."""
        found = [view.name for view in self.views if view.error_deg > limit_deg]
        return found[0] if len(found) == 1 < len(self.views) else None


@dataclass(frozen=True, kw_only=True)
class WholeSurface:
    """A surface of all views, to compare with a surface of some of them.

    Attributes
    ----------
    mesh : its measured faces.
    refined : closed, before height steps and cavities were carved: the coarse one has none either.
    is_vessel : whether it was open at the top from the start.
    """

    mesh: TriangleMesh
    refined: TriangleMesh
    is_vessel: bool

    def moved_share(self, other: TriangleMesh, reach: float) -> float:
        """Share of its area from which another mesh is farther than a reach."""
        centers, area = self.mesh.centers, self.mesh.face_areas

        def is_near(mesh: TriangleMesh) -> Mask:
            return np.asarray(RayScene(mesh).distance(centers) < reach)

        moved = is_near(self.refined) & ~is_near(other)
        return float(area[moved].sum() / max(float(area.sum()), 1e-300))


def predict_left_out(
    views: Sequence[SurfaceView],
    plane: SupportingPlane | None,
    looking: Looking,
    known: KnownPoints,
    *,
    scene: OpenScene | None = None,
    whole: WholeSurface | None = None,
    outside: Mapping[str, Mask] = MappingProxyType({}),
    tolerances: HeldOutTolerances | None = None,
) -> Prediction | None:
    """Predict some views from a surface of the others.

    The sparse points and the poses are those of all views, in an open scene the normals with which
    it starts as well.

    Parameters
    ----------
    views : from which the surface was made.
    plane : on which the objects stand.
    looking : angle model and the share of the tilt that the whole surface corrects.
    known : points of the surface.
    scene : the open scene of ``views``; None: silhouettes bound the objects.
    whole : the surface of all views, if it is to be compared with that of the others. A concave
        part that neither outlines nor phases determine stays near the visual hull, which depends
        on the views.
    outside : pixels (H, W) of each view, by its name, that are not compared: they show what is
        outside the crop box.

    Returns
    -------
    None if too few views remain for a surface.
    """
    tol = tolerances or HeldOutTolerances()
    left_out = np.zeros(len(views), np.bool_)
    left_out[tol.share // 2 :: tol.share] = True
    used = [view for view, out in zip(views, left_out, strict=True) if not out]
    others = [view for view, out in zip(views, left_out, strict=True) if out]
    if len(used) < MIN_PREDICTING or not others:
        return None
    walls: SignedDistance | None = None
    first: OpenScene | VisualHull | None = scene
    if first is None:
        hull = visual_hull(used, plane)
        fit = first_fit(used, looking, hull.gsd, known=known)
        first, walls = opened_hull(hull, plane, fit)

    def trial(levels: tuple[Level, ...]) -> Prediction:
        mesh = first.mesh
        if len(mesh.faces):
            solver = replace(SolverTolerances(), levels=levels)
            fit = first_fit(used, looking, first.gsd, known=known, tolerances=solver)
            mesh = refine(mesh, fit, walls=walls).mesh
        found = predict(mesh, others, looking, outside=outside, width_px=tol.width_px)
        # Fewer views may not show that there is a vessel.
        if whole is None or whole.is_vessel != (walls is not None) or not len(mesh.faces):
            return found
        moved = whole.moved_share(mesh, tol.levels[-1].edge_px * first.gsd)
        return replace(found, moved=moved)

    found = trial(tol.levels)
    if found.error_deg > tol.doubtful_deg:
        again = trial(tol.careful_levels)
        found = again if again.error_deg < found.error_deg else found
    return found


def predict(
    mesh: TriangleMesh,
    views: Sequence[SurfaceView],
    looking: Looking,
    *,
    outside: Mapping[str, Mask] = MappingProxyType({}),
    measured: Mask | None = None,
    width_px: float = HeldOutTolerances.width_px,
) -> Prediction:
    """Compare views with a mesh; other parameters as of :func:`predict_left_out`.

    Parameters
    ----------
    measured : (F,) faces whose phases count; light in a cavity does not show its inferred walls.
        None: all.
    """
    scene = RayScene(mesh) if len(mesh.faces) else None
    common, either = 0, 0
    of_views: list[ViewError] = []
    errors, sigmas = [np.zeros(0)], [np.zeros(0)]
    for view in views:
        image = level_image(view, width_px)
        camera = view.view.camera
        xy = lattice_xy(camera.height // STRIDE_PX, camera.width // STRIDE_PX, STRIDE_PX)
        xy = xy.reshape(-1, 2)
        if view.view.name in outside:
            cols, rows = np.floor(xy).astype(np.intp).T
            xy = xy[~outside[view.view.name][rows, cols]]
        cols, rows = np.floor(xy).astype(np.intp).T
        rays = view.view.rays_in_world(xy)
        hit, face, points = _first_hits(scene, view, rays)
        shown, possible = (
            mask[rows, cols] for mask in (view.silhouette.certain, view.silhouette.possible)
        )
        common += int((shown & hit).sum())
        either += int((shown | (hit & ~possible)).sum())
        seen = shown[hit] if measured is None else shown[hit] & measured[face]
        own_errors, own_sigmas = _phase_errors(
            mesh, view, image, looking, rays[hit][seen], face[seen], points[seen]
        )
        errors.append(own_errors)
        sigmas.append(own_sigmas)
        clear = own_errors[own_sigmas < np.radians(MAX_SIGMA_DEG)]
        if len(clear) >= MIN_PHASES:
            median = float(np.degrees(np.median(clear)))
            of_views.append(ViewError(name=view.view.name, error_deg=median))
    error, sigma = np.concatenate(errors), np.concatenate(sigmas)
    sure = sigma < np.radians(MAX_SIGMA_DEG)
    far = error > np.radians(UNEXPLAINED_DEG) + 3 * sigma
    return Prediction(
        num_views=len(views),
        num_phases=int(sure.sum()),
        error_deg=float(np.degrees(np.median(error[sure]))) if sure.any() else float("nan"),
        chance_deg=CHANCE_DEG[0] if looking.light is None else CHANCE_DEG[1],
        within=float((error[sure] < 2 * sigma[sure]).mean()) if sure.any() else float("nan"),
        unexplained=float(far[sure].mean()) if sure.any() else float("nan"),
        overlap=common / either if either else float("nan"),
        views=tuple(of_views),
    )


def _first_hits(
    scene: RayScene | None, view: SurfaceView, rays: Array
) -> tuple[Mask, NDArray[np.int64], Array]:
    """Which rays (N,) hit, and the faces (M,) and places (M, 3) of those that do."""
    if scene is None:
        return np.zeros(len(rays), np.bool_), np.zeros(0, np.int64), np.zeros((0, 3))
    hits = scene.cast(view.center, rays)
    hit = hits.face >= 0
    return hit, hits.face[hit], points_on_rays(view.center, rays[hit], hits.distance[hit])


def _phase_errors(
    mesh: TriangleMesh,
    view: SurfaceView,
    image: Image,
    looking: Looking,
    rays: Array,
    face: NDArray[np.int64],
    points: Array,
) -> tuple[Array, Array]:
    """Angles about the ray, rad, between phases and normals, and their stated deviations."""
    found = rows_of_both(view, image, looking, points)
    normals = mesh.face_normals[face]
    sine = np.sqrt(np.maximum(1 - dots(rays, normals) ** 2, 1e-12))
    turns = np.arcsin(np.clip(np.abs(np.einsum("lki,ki->lk", found.rows, normals)) / sine, 0, 1))
    if looking.light is not None:
        turns = turns[[0 if looking.light is Light.SPECULAR else 1]]
    nearest = turns.argmin(axis=0)
    sigma = np.sqrt(found.turn_variance[nearest, np.arange(len(nearest))])
    known = np.isfinite(sigma) & (sine > MIN_SINE)
    return turns.min(axis=0)[known], sigma[known]
