"""One surface from all views: the energy of :mod:`polmvs.surface.terms`, solved coarse to fine.

Each iteration observes the mesh in all views, infers the label of every observation, linearizes all
terms and solves for one displacement per vertex::

    for level in levels:
        for iteration in level:
            observations = observe(mesh, views)
            labels = responsibilities(observations, vote(mesh, observations))
            mesh, tilt = solve(phases + outlines + points + smoothness)
        scales = deviations that the residuals of each view and kind of light show
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from polmvs.config import default_num_workers
from polmvs.fitting import CAUCHY_SCALE, robust_deviation
from polmvs.geometry import dots, points_on_rays
from polmvs.parallel import OnProgress, no_progress
from polmvs.surface.creases import CreaseTolerances, crease_vertices
from polmvs.surface.labels import (
    LabelTolerances,
    Vote,
    responsibilities,
    vote,
)
from polmvs.surface.mesh_geometry import (
    RayScene,
    SignedDistance,
    TriangleMesh,
    remeshed,
    thickened,
)
from polmvs.surface.observations import (
    KINDS,
    Image,
    Looking,
    Observations,
    level_image,
    observe,
    rows_of_both,
)
from polmvs.surface.surface_view import SurfaceView
from polmvs.surface.terms import (
    Equations,
    KnownPoints,
    KnownSides,
    OutlineRows,
    SharedEdges,
    SharedError,
    TermTolerances,
    add_outlines,
    add_phases,
    add_points,
    add_votes,
    outline_rows,
    shared_edges,
    smoothness,
    solve,
    with_edges,
)

logger = logging.getLogger(__name__)

POLISHING_STEPS = 2  # until a new mesh, which shrinks by some tenths of a pixel, converges
CROSSED_DEPTH = 0.05  # of an edge: far above rounding, far below the resolution of a mesh
# Share of the silhouettes that a remeshed surface may lose. Measured: up to 0.011 if walls are
# thicker than edges, 0.036 to 0.6 if they are thinner.
REMESHING_LOSS = 0.02
MIN_RESIDUALS = 100  # least number of rows of one view and kind of light for a separate deviation

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Level:
    """One level of refinement.

    Attributes
    ----------
    edge_px : edge length of the mesh, GSD.
    num_steps : largest number of Gauss-Newton iterations.
    loss_scale : of the phase rows' loss, in their standard deviations.
    gate_px : outlines farther from a silhouette than this are not pulled to it.
    is_uncrossed : a mesh whose sheets have crossed is made anew, so that parts join and separate.
        Each new mesh rounds creases and thin walls; finer levels restore them. Measured on a chair,
        made anew at all levels and at the first only: F at 1 mm of 73 and 92 %.
    """

    edge_px: float
    num_steps: int
    loss_scale: float
    gate_px: float
    is_uncrossed: bool = False

    @property
    def width_px(self) -> float:
        """Width of the Gaussian over which Stokes images are averaged: a fifth of an edge.

        Less than 1 px leaves the mosaic's interpolation in the phases (`PhaseTolerances`).
        """
        return max(0.2 * self.edge_px, 1.0)


@dataclass(frozen=True, kw_only=True)
class SolverTolerances:
    """Tolerances of the solver.

    Attributes
    ----------
    levels : coarse to fine.
    annealing : assumed error of the mesh's normals in the labels, rad, at the first and the last
        iteration.
    vote_every : iterations from one vote to the next.
    last_steps : iterations without a vote, at the end.
    damping : deviation of a step, in edges; it holds vertices without outlines or points.
    unseen_damping : of a vertex that no view sees, in edges; smoothness alone would shrink it.
        Guess.
    remesh_after : displacement of a fiftieth of the vertices that triggers remeshing, in edges.
        Guess: triangles of a mesh that moves by less stay usable.
    converged : root mean square of the displacements of seen vertices that ends a level, in edges.
    max_vertices : of a mesh; its edges are longer if need be. From the time allowed.
    terms, labels : tolerances of these.
    """

    levels: tuple[Level, ...] = (
        Level(edge_px=10.0, num_steps=24, loss_scale=12.0, gate_px=25.0, is_uncrossed=True),
        Level(edge_px=5.0, num_steps=12, loss_scale=8.0, gate_px=8.0),
        Level(edge_px=3.0, num_steps=8, loss_scale=6.0, gate_px=4.0),
        Level(edge_px=2.0, num_steps=3, loss_scale=4.0, gate_px=4.0),
    )
    annealing: tuple[float, float] = (0.5, 0.12)
    vote_every: int = 2
    last_steps: int = 5
    damping: float = 0.5
    unseen_damping: float = 0.02
    remesh_after: float = 2.0
    converged: float = 0.01
    max_vertices: int = 120_000
    terms: TermTolerances = field(default_factory=TermTolerances)
    labels: LabelTolerances = field(default_factory=LabelTolerances)

    @property
    def num_steps(self) -> int:
        """Largest number of iterations."""
        return sum(level.num_steps for level in self.levels)


@dataclass(frozen=True)
class Scales:
    """Deviations of the residuals beyond noise.

    Attributes
    ----------
    rows : (K, 2) of ``m . n``, for each view and kind of light.
    """

    rows: Array

    def of(self, observations: Observations) -> Array:
        """Deviations ``(2, N)`` for observations."""
        return np.asarray(self.rows[observations.view].T)


@dataclass(frozen=True)
class Fit:
    """The views with the state of the fit.

    Attributes
    ----------
    views : all views.
    images : their images, smoothed for the current level.
    looking : angle model and share of the tilt.
    scales : of the views' rows.
    gsd : ground sampling distance at the surface, world units.
    known : points of the surface.
    tol : tolerances.
    width_px : of the images' smoothing; NaN without images.
    """

    views: Sequence[SurfaceView]
    images: Sequence[Image]
    looking: Looking
    scales: Scales
    gsd: float
    known: KnownPoints | None
    tol: SolverTolerances
    width_px: float = float("nan")

    def face_area_px(self, mesh: TriangleMesh) -> float:
        """Mean area of a mesh's faces, px^2."""
        return float(mesh.face_areas.mean()) / self.gsd**2

    def independent_area(self, level: Level) -> float:
        """Area of the surface over which a level's phase errors are correlated."""
        return self.tol.terms.independent_px * level.width_px**2 * self.gsd**2

    def at_width(self, width_px: float) -> Fit:
        """The fit with images smoothed over a width."""
        if width_px == self.width_px:
            return self
        with ThreadPoolExecutor(default_num_workers()) as pool:
            images = list(pool.map(lambda view: level_image(view, width_px), self.views))
        return replace(self, images=images, width_px=width_px)

    def of(self, kept: Mask) -> Fit:
        """The fit of some views (K,)."""
        chosen = np.flatnonzero(kept).tolist()
        return replace(
            self,
            views=[self.views[index] for index in chosen],
            images=[self.images[index] for index in chosen] if len(self.images) else [],
            scales=Scales(self.scales.rows[chosen]),
        )


def first_fit(
    views: Sequence[SurfaceView],
    looking: Looking,
    gsd: float,
    *,
    known: KnownPoints | None = None,
    tolerances: SolverTolerances | None = None,
) -> Fit:
    """The fit of a first surface; parameters as of :class:`Fit`."""
    tol = tolerances or SolverTolerances()
    rows = np.full((len(views), 2), tol.terms.row_sigma)
    return Fit(views, [], looking, Scales(rows), gsd, known, tol)


@dataclass(frozen=True)
class Refined:
    """A refined surface.

    Attributes
    ----------
    mesh : closed.
    fit : of the consistent views, with their share of the tilt and scales.
    left_out : (K,) bool, inconsistent views.
    unexplained : (K,) share of each view that the first level does not explain.
    meshes : after each level.
    """

    mesh: TriangleMesh
    fit: Fit
    left_out: Mask
    unexplained: Array
    meshes: list[TriangleMesh]


def refine(
    mesh: TriangleMesh,
    fit: Fit,
    *,
    stands_apart: Callable[[Array], Mask] | None = None,
    walls: SignedDistance | None = None,
    on_progress: OnProgress = no_progress,
) -> Refined:
    """Move a closed mesh until the views' phases and silhouettes agree with it.

    OPA and PPA ignore the tilt of the polarizers. Its error is common to all rows, so it does not
    average out, and whether the lens causes it is unknown. Its share is therefore one more
    unknown.

    Parameters
    ----------
    mesh : first surface, closed.
    fit : of all views.
    stands_apart : finds inconsistent views from the unexplained shares ``(K,)``; these are left out
        after the first level.
    walls : signed distance of points (N, 3) to walls that coarse meshes lose, negative inside; each
        level starts with them.
    on_progress : called with the number of iterations done.
    """
    tol, done = fit.tol, 0
    meshes: list[TriangleMesh] = []
    total = tol.num_steps
    left_out = np.zeros(len(fit.views), np.bool_)
    unexplained = np.full(len(fit.views), np.nan)
    for number, level in enumerate(tol.levels):
        edge = level.edge_px * fit.gsd
        edge *= max(float(np.sqrt(_num_vertices(mesh, edge) / tol.max_vertices)), 1.0)
        fit = fit.at_width(level.width_px)
        mesh = _at_level(RayScene(mesh), edge, fit.views, walls)
        mesh, fit = _refined_at(mesh, fit, level, edge, (done, total), on_progress)
        done += level.num_steps
        meshes.append(mesh)
        if not len(mesh.faces):
            break
        if number == 0 and stands_apart is not None:
            unexplained = unexplained_shares(mesh, fit)
            left_out = stands_apart(unexplained)
            fit = fit.of(~left_out)
    return Refined(mesh, fit, left_out, unexplained, meshes)


def _num_vertices(mesh: TriangleMesh, edge: float) -> float:
    """Number of vertices of the mesh with edges of this length."""
    return 1.2 * float(mesh.face_areas.sum()) / edge**2


def covered_shares(scene: RayScene, views: Sequence[SurfaceView], *, stride_px: int = 4) -> Array:
    """Share ``(K,)`` of each view's certain silhouette that a mesh covers; NaN without one."""
    is_empty = not len(scene.mesh.faces)
    shares = np.full(len(views), np.nan)
    for index, view in enumerate(views):
        rays = certain_rays(view, stride_px)
        if len(rays):
            hit = 0.0 if is_empty else np.mean(scene.cast(view.center, rays).face >= 0)
            shares[index] = hit
    return shares


def covered_share(scene: RayScene, views: Sequence[SurfaceView]) -> float:
    """Mean of :func:`covered_shares`; 1 where no view shows a silhouette."""
    shares = covered_shares(scene, views)
    known = shares[np.isfinite(shares)]
    return float(known.mean()) if len(known) else 1.0


def _refined_at(
    mesh: TriangleMesh,
    fit: Fit,
    level: Level,
    edge: float,
    progress: tuple[int, int],
    on_progress: OnProgress,
) -> tuple[TriangleMesh, Fit]:
    """The surface after one level, with edges of the given length.

    ``progress`` are the iterations done before it, and of all levels.
    """
    tol, (done, total) = fit.tol, progress
    moved, energy, is_thin = np.zeros(len(mesh.vertices)), None, False
    first, last = tol.annealing
    for step in range(level.num_steps):
        # A mesh that has moved far is irregular. Other meshes stay as they are, because the grid
        # rounds their creases.
        scene = RayScene(mesh)
        if step > 0 and not is_thin and _is_irregular(scene, moved, edge, level, tol):
            # No smoothing: the mesh is smooth. The grid loses walls thinner than its cells.
            again = RayScene(remeshed(scene, edge, smoothing=0))
            is_thin = _loses_walls(scene, again, fit.views)
            if not is_thin:
                scene, mesh = again, again.mesh
                moved = np.zeros(len(mesh.vertices))
        if not len(mesh.faces):
            on_progress(total - done - step)
            return mesh, fit
        share = (done + step) / max(total - 1, 1)
        with_vote = step % tol.vote_every == 0 and done + step < total - tol.last_steps
        energy = linearize(
            scene,
            fit,
            edge,
            level,
            normal_sigma=first * (last / first) ** share,
            with_vote=with_vote,
            with_slope=True,
        )
        mesh, displacement = _step(mesh, energy, edge, tol)
        fit = replace(fit, looking=energy.with_tilt(fit.looking, displacement))
        moved = moved + displacement
        free = displacement[energy.free]
        change = float(np.sqrt(np.mean(free**2))) if len(free) else 0.0
        logger.info(
            "edges of %.1f px, %d vertices: moved by %.3f px; light %.0f %% specular, %.0f %% "
            "diffuse; %.2f of the polarizers' tilt.",
            edge / fit.gsd,
            len(mesh.vertices),
            change / fit.gsd,
            *(100 * energy.light),
            fit.looking.tilt_share,
        )
        on_progress(1)
        if not with_vote and change < tol.converged * edge and step > 1:
            on_progress(level.num_steps - step - 1)
            break
    assert energy is not None  # a level has an iteration
    return mesh, replace(fit, scales=energy.shown_scales())


def _at_level(
    scene: RayScene, edge: float, views: Sequence[SurfaceView], walls: SignedDistance | None
) -> TriangleMesh:
    """A level's first mesh.

    Parts that a new mesh would lose are widened; outlines make them thin again. If widening brings
    silhouettes back, the walls are thin: then the triangles of a mesh that is no finer than the
    level are kept and cut.
    """
    mesh, ratio = scene.mesh, np.sqrt(2)  # half of the factor of two by which a cut is finer
    again = RayScene(remeshed(scene, edge, solid=() if walls is None else (walls,)))
    if not _loses_walls(scene, again, views):
        return again.mesh
    wide = RayScene(remeshed(RayScene(thickened(scene, again, edge)), edge))
    if ratio * mesh.mean_edge < edge or not _loses_walls(wide, again, views):
        logger.info("parts that edges of the level would lose are widened.")
        return wide.mesh
    logger.info("the triangles are cut: a new mesh would lose thin walls.")
    while mesh.mean_edge > ratio * edge:
        mesh = mesh.halved()
    return mesh


def _loses_walls(scene: RayScene, again: RayScene, views: Sequence[SurfaceView]) -> bool:
    """Whether a remeshed surface covers clearly less of the silhouettes than the one before."""
    return covered_share(scene, views) - covered_share(again, views) >= REMESHING_LOSS


def _is_irregular(
    scene: RayScene, moved: Array, edge: float, level: Level, tol: SolverTolerances
) -> bool:
    """Whether a mesh has moved (V,) far since it was made, or intersects itself and may not."""
    if float(np.quantile(np.abs(moved), 0.98)) > tol.remesh_after * edge:
        return True
    return level.is_uncrossed and len(scene.crossed_faces(CROSSED_DEPTH * edge)) > 0


@dataclass(frozen=True)
class _Evidence:
    """Equations of some views for the displacements of one mesh.

    Attributes
    ----------
    equations : of their phases and outlines.
    outline_slope : (V,), change of the gradient by one deviation of the error that all silhouettes
        share.
    tilt : share of the polarizers' tilt that is not yet corrected.
    """

    equations: Equations
    outline_slope: Array
    tilt: SharedError


@dataclass(frozen=True)
class Energy:
    """The energy about one mesh, as the parts of its normal equations.

    Attributes
    ----------
    views : equations of all views.
    of_views : equations of some of the views, by their indices.
    points : equations of the known points.
    smooth, pull : matrix ``(V, V)`` and gradient ``(V,)`` of the smoothness, and the matrix
        ``(V, V)`` whose product with its own transpose is the former.
    free : (V,) bool, vertices of faces that some view sees.
    sharp : (V,) bool, vertices on edges between sides.
    light : (2,) shares of the observations whose light is specular, and diffuse.
    shown_scales : those of the rows' residuals.
    """

    views: _Evidence
    of_views: Callable[[Sequence[int]], _Evidence]
    points: Equations
    smooth: sparse.csr_array
    pull: Array
    smooth_factor: sparse.csr_array
    free: Mask
    sharp: Mask
    light: Array
    shown_scales: Callable[[], Scales]

    def matrix(self) -> sparse.csr_array:
        """Of all parts ``(V, V)``, without damping."""
        return sparse.csr_array(self.views.equations.matrix() + self.points.matrix() + self.smooth)

    def gradient(self) -> Array:
        """Of all parts ``(V,)``."""
        tilt = self.views.tilt
        sums = self.views.equations.gradient + self.points.gradient + self.pull
        return np.asarray(sums - tilt.offset() * tilt.column())

    def with_tilt(self, looking: Looking, displacement: Array) -> Looking:
        """With the share of the tilt that a solution (V,) shows."""
        if not looking.tilt_aware:
            return looking
        share = looking.tilt_share + self.views.tilt.solved(displacement)
        return replace(looking, tilt_share=float(np.clip(share, 0, 1)))


@dataclass(frozen=True)
class _Observed:
    """What the views show of a mesh with F faces.

    Attributes
    ----------
    observations : K of them, those that are used.
    shares : (2, K) probabilities of specular and of diffuse light.
    variances : (2, K) of the rows' residuals.
    voted : the normals that the observations prefer.
    is_seen : (F,) bool, faces that a view observes, used or not.
    """

    observations: Observations
    shares: Array
    variances: Array
    voted: Vote
    is_seen: Mask


def _observed(
    scene: RayScene,
    fit: Fit,
    pairs: tuple[Indices, Indices],
    used: Mask | None,
    *,
    normal_sigma: float,
    with_vote: bool,
    with_slope: bool,
) -> _Observed:
    """The observations of a mesh and their labels.

    ``pairs`` are faces that share an edge; ``used`` (F,) those whose observations are used (None:
    all); the others are parameters of :func:`linearize`.
    """
    mesh, tol = scene.mesh, fit.tol.labels
    gsd = fit.gsd if with_slope else None
    observations = observe(mesh, scene, fit.views, fit.images, fit.looking, gsd=gsd)
    is_seen = np.zeros(len(mesh.faces), np.bool_)
    is_seen[observations.face] = True
    if used is not None:
        observations = observations.only(used[observations.face])
    row_sigma = fit.scales.of(observations)
    voted = Vote(mesh.face_normals, np.zeros(len(mesh.faces), np.bool_))
    if with_vote:
        voted = vote(mesh, observations, pairs, row_sigma=row_sigma, tolerances=tol)
    shares = responsibilities(
        observations,
        voted.normals,
        normal_sigma=normal_sigma,
        row_sigma=row_sigma,
        pairs=pairs,
        weights=fit.looking.light_weights,
        tolerances=tol,
    )
    variances = observations.variances(mesh.face_normals, row_sigma)
    return _Observed(observations, shares, variances, voted, is_seen)


def _outlines(
    scene: RayScene,
    fit: Fit,
    edges: SharedEdges,
    sharp: Mask,
    *,
    gate_px: float,
    on_outline: bool,
) -> list[OutlineRows | None]:
    """Rows of the outline of each view; None for a view without one."""

    def outline(view: SurfaceView) -> OutlineRows | None:
        if not view.has_outline:
            return None
        return outline_rows(
            scene.mesh,
            scene,
            view,
            edges,
            sharp,
            fit.tol.terms,
            gate_px=gate_px,
            on_outline=on_outline,
        )

    # Threads, as products of large arrays and ray casting release Python's lock.
    with ThreadPoolExecutor(default_num_workers()) as pool:
        return list(pool.map(outline, fit.views))


def _evidence_of_views(
    mesh: TriangleMesh,
    fit: Fit,
    level: Level,
    observed: _Observed,
    outlines: Sequence[OutlineRows | None],
    chosen: Sequence[int],
) -> _Evidence:
    """Equations of the phases and outlines of some views, by their indices."""
    terms, observations = fit.tol.terms, observed.observations
    face_area_px = fit.face_area_px(mesh)
    equations = Equations(len(mesh.vertices))
    # The share is anywhere between a sensor of the angle model and a tilted polarizer, and is as
    # uncertain as other errors that the rows share.
    tilt = SharedError(
        len(mesh.vertices),
        prior=terms.phase_correlation(face_area_px),
        expected=-fit.looking.tilt_share,
    )
    kept = np.isin(observations.view, chosen)
    add_phases(
        equations,
        tilt,
        mesh,
        observations if kept.all() else observations.only(kept),
        observed.shares[:, kept],
        observed.variances[:, kept],
        independent_area=fit.independent_area(level),
        loss_scale=level.loss_scale,
    )
    own = [rows for rows in (outlines[index] for index in chosen) if rows is not None]
    slope = add_outlines(equations, own, terms, face_area_px=face_area_px, gate_px=level.gate_px)
    return _Evidence(equations, slope, tilt)


def linearize(
    scene: RayScene,
    fit: Fit,
    edge: float,
    level: Level,
    *,
    normal_sigma: float,
    with_vote: bool = False,
    with_slope: bool = False,
    sides: KnownSides | None = None,
) -> Energy:
    """The energy about a mesh.

    Parameters
    ----------
    scene : of the mesh.
    edge : length of its edges.
    normal_sigma : rad, assumed error of its normals in the labels.
    with_vote : try other normals for the labels, and turn faces towards those that win.
    with_slope : include the change of a row as its face moves through the image. It determines the
        position of parts that no outline bounds (the floor of a dish, waves).
    sides : of a sharpened mesh, whose exact outline is then compared with the silhouettes.
    """
    terms, mesh = fit.tol.terms, scene.mesh
    edges = shared_edges(mesh)
    pairs = edges.faces[:, 0], edges.faces[:, 1]
    sharp, used = np.zeros(len(mesh.vertices), np.bool_), None
    if sides is not None:
        edges = edges.only(np.all(sides.is_shown[edges.faces], axis=1))
        sharp = crease_vertices(mesh, sides.is_shown)
        # Edges move to where their sides intersect: the faces there do not constrain the sides.
        used = sides.is_fitted & ~np.any(sharp[mesh.faces], axis=1)
    observed = _observed(
        scene,
        fit,
        pairs,
        used,
        normal_sigma=normal_sigma,
        with_vote=with_vote,
        with_slope=with_slope,
    )
    outlines = _outlines(
        scene, fit, edges, sharp, gate_px=level.gate_px, on_outline=sides is not None
    )
    of_views = partial(_evidence_of_views, mesh, fit, level, observed, outlines)
    everything = of_views(range(len(fit.views)))
    if observed.voted.has_won.any():
        add_votes(
            everything.equations,
            mesh,
            observed.voted.normals,
            observed.voted.has_won,
            sigma=terms.vote_sigma,
            independent_area=fit.independent_area(level),
        )
    smooth, pull, factor = smoothness(mesh, edge, terms, sharp)
    free = np.zeros(len(mesh.vertices), np.bool_)
    free[mesh.faces[observed.is_seen]] = True
    shares = observed.shares
    return Energy(
        views=everything,
        of_views=of_views,
        points=_of_points(mesh, fit, observed.is_seen, gate_px=level.gate_px),
        smooth=smooth,
        pull=pull,
        smooth_factor=factor,
        free=free,
        sharp=sharp,
        light=shares.mean(axis=1) if shares.size else np.zeros(2),
        shown_scales=partial(_shown_scales, observed.observations, mesh.face_normals, shares, fit),
    )


def _of_points(mesh: TriangleMesh, fit: Fit, is_seen: Mask, *, gate_px: float) -> Equations:
    """Equations of the known points, which the seen (F,) faces are pulled to."""
    points = Equations(len(mesh.vertices))
    if fit.known is not None and len(fit.known.points) and is_seen.any():
        face_area_px = fit.face_area_px(mesh)
        add_points(
            points,
            mesh,
            is_seen,
            fit.known,
            fit.tol.terms,
            weight=fit.tol.terms.point_weight(len(fit.views), face_area_px),
            gsd=fit.gsd,
            gate_px=gate_px,
        )
    return points


@dataclass(frozen=True)
class Labelled:
    """Observations of a refined mesh with their labels.

    Attributes
    ----------
    observations : K of them.
    shares : (2, K) probabilities of specular and of diffuse light.
    row_sigma : (2, K) deviation of ``m . n`` beyond noise.
    num_views : of all observations.
    """

    observations: Observations
    shares: Array
    row_sigma: Array
    num_views: int

    @property
    def kind(self) -> Indices:
        """(K,) the likelier light."""
        return np.asarray(self.shares.argmax(axis=0), np.int64)

    @property
    def excess(self) -> Array:
        """(K,) difference of the probabilities of the two."""
        return np.asarray(np.abs(self.shares[0] - self.shares[1]))

    def residuals(self, mesh: TriangleMesh) -> tuple[Array, Array]:
        """``m . n`` (K,) under the likelier light, and its variance (K,)."""
        kind, index = self.kind, np.arange(len(self.observations.face))
        residuals = self.observations.residuals(mesh.face_normals)
        variances = self.observations.variances(mesh.face_normals, self.row_sigma)
        return residuals[kind, index], variances[kind, index]

    def contradicts(self, mesh: TriangleMesh) -> Mask:
        """(K,) bool, residuals beyond noise and beyond the difference between sides of a crease."""
        residual, variance = self.residuals(mesh)
        limit = np.maximum(3 * np.sqrt(variance), CreaseTolerances.like_sine)
        return np.asarray(np.abs(residual) > limit)

    def mean_loss(self, mesh: TriangleMesh) -> float:
        """Mean robust loss of the residuals, in [0, 1]; 0 if the mesh fits its phases exactly."""
        residual, variance = self.residuals(mesh)
        square = residual**2 / variance
        area = mesh.face_areas[self.observations.face]
        loss = square / (square + CAUCHY_SCALE**2)
        return float((area * loss).sum() / max(float(area.sum()), 1e-300))

    def means(self, num_faces: int) -> Array:
        """Means (3, F) over a face's observations: of both probabilities, and of the DoLP."""
        face = self.observations.face
        count = np.maximum(np.bincount(face, minlength=num_faces), 1)
        values = (*self.shares, self.observations.dolp)
        return np.stack([np.bincount(face, value, num_faces) / count for value in values])


def phase_information(mesh: TriangleMesh, seen: Observations, fit: Fit) -> Array:
    """Log-likelihood (K,) of the phases under the mesh's normals, over that of any phase, nats.

    The light is unknown. Phases that are noisy, or seen frontally, say little; phases that
    contradict the normal have a negative value.
    """
    sine2 = np.maximum(1 - dots(seen.rays, mesh.face_normals.take(seen.face, axis=0)) ** 2, 1e-6)
    turn = np.arcsin(np.clip(seen.residuals(mesh.face_normals) / np.sqrt(sine2), -1, 1))
    variance = seen.variances(mesh.face_normals, fit.scales.of(seen)) / sine2
    # Phases repeat after pi. Above a deviation of pi/2 all are alike within 1.5 %.
    variance = np.minimum(variance, (np.pi / 2) ** 2)
    periods = np.array([-np.pi, 0, np.pi])[:, None, None]
    density = np.exp(-0.5 * (turn + periods) ** 2 / variance).sum(axis=0)
    density /= np.sqrt(2 * np.pi * variance)
    either = np.einsum("l,lk->k", fit.looking.light_weights, density)
    other = fit.tol.labels.outlier  # share of neither light
    return np.asarray(np.log((1 - other) * np.pi * either + other))


def label(mesh: TriangleMesh, fit: Fit, *, min_cosine: float | None = None) -> Labelled:
    """The observations of a refined mesh with their labels.

    Parameters
    ----------
    min_cosine : more oblique views are ignored; by default as in the refinement.
    """
    looking = fit.looking if min_cosine is None else replace(fit.looking, min_cosine=min_cosine)
    edges = shared_edges(mesh)
    pairs = edges.faces[:, 0], edges.faces[:, 1]
    observations = observe(mesh, RayScene(mesh), fit.views, fit.images, looking)
    row_sigma = fit.scales.of(observations)
    shares = responsibilities(
        observations,
        mesh.face_normals,
        normal_sigma=fit.tol.annealing[1],
        row_sigma=row_sigma,
        pairs=pairs,
        weights=fit.looking.light_weights,
        tolerances=fit.tol.labels,
    )
    return Labelled(observations, shares, row_sigma, len(fit.views))


def _shown_scales(observations: Observations, normals: Array, shares: Array, fit: Fit) -> Scales:
    """Deviations of rows beyond their noise, for each view and kind of light.

    If a view has few observations of a kind, those of all views replace them.
    """
    least = fit.tol.terms.row_sigma
    residuals = observations.residuals(normals)
    noise = observations.variances(normals, np.zeros(1))
    found = np.full((len(fit.views), 2), least)
    for kind in KINDS:
        own = shares[kind] > 0.5

        def deviation(chosen: Mask, kind: int = kind) -> float:
            if chosen.sum() < MIN_RESIDUALS:
                return np.nan
            square = robust_deviation(residuals[kind, chosen]) ** 2
            return float(np.sqrt(max(square - np.median(noise[kind, chosen]), least**2)))

        of_all = np.nan_to_num(deviation(own), nan=least)
        for index in range(len(fit.views)):
            shown = deviation(own & (observations.view == index))
            found[index, kind] = of_all if np.isnan(shown) else shown
    return Scales(found)


def _step(
    mesh: TriangleMesh, energy: Energy, edge: float, tol: SolverTolerances
) -> tuple[TriangleMesh, Array]:
    """One Gauss-Newton step: the new mesh and the displacements ``(V,)``."""
    damping = np.where(energy.free, tol.damping, tol.unseen_damping) * edge
    shared = energy.views.tilt.column()
    displacement = -solve(energy.matrix(), energy.gradient(), 1 / damping**2, shared)
    displacement = np.clip(np.nan_to_num(displacement), -edge, edge)
    moves = displacement[:, None] * mesh.vertex_normals
    return mesh.moved(with_edges(mesh, moves, energy.sharp)), displacement


def polishing_step(mesh: TriangleMesh, fit: Fit, sides: KnownSides) -> tuple[TriangleMesh, bool]:
    """One polishing step of a mesh with sharp edges, under outlines, points and phases.

    Parameters
    ----------
    mesh : sharpened; its triangles are kept.
    fit : of a refined surface.
    sides : of its faces.

    Returns
    -------
    The mesh, and whether it has converged.
    """
    tol, edge = fit.tol, mesh.mean_edge
    energy = linearize(
        RayScene(mesh), fit, edge, tol.levels[-1], normal_sigma=tol.annealing[1], sides=sides
    )
    moved, displacement = _step(mesh, energy, edge, tol)
    free = np.abs(displacement[energy.free & ~energy.sharp])
    return moved, not len(free) or float(np.median(free)) < 0.03 * edge


def iterated(mesh: TriangleMesh, fit: Fit) -> TriangleMesh:
    """A refined mesh after some more iterations of the last level, such as without its points."""
    tol, edge = fit.tol, mesh.mean_edge
    for _ in range(POLISHING_STEPS):
        energy = linearize(
            RayScene(mesh),
            fit,
            edge,
            tol.levels[-1],
            normal_sigma=tol.annealing[1],
            with_slope=True,
        )
        mesh, _ = _step(mesh, energy, edge, tol)
    return mesh


def certain_rays(view: SurfaceView, stride_px: int = 4) -> Array:
    """Unit rays ``(N, 3)``, world, of pixels of a view's certain silhouette, at a stride."""
    half = stride_px // 2
    rows, cols = np.nonzero(view.silhouette.certain[half::stride_px, half::stride_px])
    xy = np.stack([cols, rows], axis=1) * stride_px + half + 0.5
    return view.view.rays_in_world(xy)


def unexplained_shares(mesh: TriangleMesh, fit: Fit, *, stride_px: int = 4) -> Array:
    """Share ``(K,)`` of each view that a mesh does not explain: mean over its certain silhouette.

    A pixel counts 1 if the mesh shows nothing there, or a normal that the phase contradicts under
    both kinds of light by far more than the scales of all views; 0 if they agree.
    """
    scene, shares = RayScene(mesh), np.full(len(fit.views), np.nan)
    row_sigma = float(np.median(fit.scales.rows))
    for index, (view, image) in enumerate(zip(fit.views, fit.images, strict=True)):
        rays = certain_rays(view, stride_px)
        hits = scene.cast(view.center, rays)
        hit = np.flatnonzero(hits.face >= 0)
        points = points_on_rays(view.center, rays[hit], hits.distance[hit])
        looking = fit.looking
        found = rows_of_both(view, image, looking, points)
        normals = mesh.face_normals[hits.face[hit]]
        residuals = np.einsum("lki,ki->lk", found.rows, normals)
        sine2 = 1 - np.einsum("ki,ki->k", rays[hit], normals) ** 2
        with np.errstate(invalid="ignore"):
            square = (residuals**2 / (row_sigma**2 + sine2 * found.turn_variance)).min(axis=0)
        known = np.isfinite(found.turn_variance[0])
        loss = np.ones(len(rays))
        loss[hit[known]] = (square / (square + CAUCHY_SCALE**2))[known]
        kept = hits.face < 0
        kept[hit[known]] = True  # a pixel without a phase does not test the mesh
        if kept.any():
            shares[index] = loss[kept].mean()
    return shares


@dataclass(frozen=True)
class PositionSigma:
    """Position uncertainty (1 sigma) along the normals of V vertices; inf where no view sees one.

    Attributes
    ----------
    own : (V,) of what differs from place to place: views, noise, points, smoothness.
    shared : (V,) of what moves wide parts: the polarizers' tilt, the bias of outlines and phases.
    """

    own: Array
    shared: Array

    @property
    def total(self) -> Array:
        """(V,) of both."""
        return np.asarray(np.hypot(self.own, self.shared))


def place_deviations(
    mesh: TriangleMesh,
    fit: Fit,
    *,
    max_groups: int = 24,
    num_samples: int = 12,
    seed: int = 0,
) -> PositionSigma:
    """Position uncertainty of each vertex of a refined mesh.

    The contribution of the views is the jackknife (Tukey 1958): the displacement of the surface
    when one of them, or one of some groups of them, is left out. It includes all errors that the
    phases and the outline of a view share (light, pose, blur). It does not include errors that all
    views share: the share of the polarizers' tilt and the bias of the outlines are added. Samples
    of the errors of points, smoothness and the views' stated noise are also added, as few views may
    agree by chance. It is large where only smoothness determines a vertex.

    Parameters
    ----------
    mesh, fit : as of :func:`refine`, refined.
    max_groups : largest number of groups of views.
    num_samples : the relative error of a deviation is one over the root of twice this number.
    seed : of the random numbers.
    """
    tol = fit.tol
    num, rng, level = len(mesh.vertices), np.random.default_rng(seed), tol.levels[-1]
    if not num:
        return PositionSigma(np.zeros(0), np.zeros(0))
    edge, num_views = mesh.mean_edge, len(fit.views)
    face_area_px = fit.face_area_px(mesh)

    def energy_of(mesh: TriangleMesh, *, with_slope: bool = True) -> Energy:
        return linearize(
            RayScene(mesh), fit, edge, level, normal_sigma=tol.annealing[1], with_slope=with_slope
        )

    energy = energy_of(mesh)
    for _ in range(POLISHING_STEPS):
        mesh, _ = _step(mesh, energy, edge, tol)
        energy = energy_of(mesh)
    matrix = energy.matrix()
    # Only the energy holds the surface here; vertices that no view sees are not used.
    loose = 1 / (np.where(energy.free, 100.0, tol.unseen_damping) * edge) ** 2
    none = np.zeros(num)
    rest = -solve(matrix, energy.gradient(), loose, none)
    by_tilt = solve(matrix, energy.views.tilt.slope, loose, none)
    # The shared error of rows is as large as their own errors before they are weighted down.
    by_tilt *= energy.views.tilt.deviation(by_tilt) * np.sqrt(
        tol.terms.phase_correlation(face_area_px)
    )
    # The noise of the slopes would seem to hold the surface against a common error of outlines.
    no_slopes = energy_of(mesh, with_slope=False)
    by_outlines = solve(no_slopes.matrix(), no_slopes.views.outline_slope, loose, none)
    variance = np.zeros(num)
    for _ in range(num_samples):
        noise = energy.views.equations.noise(rng) + energy.smooth_factor @ rng.standard_normal(num)
        noise += np.sqrt(tol.terms.point_weight(num_views, face_area_px)) * energy.points.noise(rng)
        variance += solve(matrix, noise, loose, none) ** 2 / num_samples
    num_groups = min(num_views, max_groups)
    for first in range(num_groups):
        # Neighbours by name probably see the same, so they go to different groups.
        left_out = energy.of_views(range(first, num_views, num_groups)).equations
        own = left_out.matrix()
        change = solve(sparse.csr_array(matrix - own), left_out.gradient + own @ rest, loose, none)
        variance += (num_groups - 1) / num_groups * change**2
    own = np.where(energy.free, np.sqrt(variance), np.inf)
    return PositionSigma(own, np.where(energy.free, np.hypot(by_tilt, by_outlines), np.inf))
