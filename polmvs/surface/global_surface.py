"""One surface from all views: from phase maps to a mesh with its support and uncertainty.

The steps are silhouettes, their visual hull, its refinement by all phases, and the selection of the
part that the views support. Clouds, meshes and the depth and normal maps of the views are made from
this one surface.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cache, cached_property, lru_cache, partial
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from polmvs.camera import sample_image
from polmvs.io.clouds import Mesh
from polmvs.neighbors import voxel_representatives
from polmvs.normals.tracks import evenly_chosen
from polmvs.parallel import OnProgress, no_progress
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_FACING_COSINE, MIN_VIEWS, Seeds, View
from polmvs.surface.cavities import Cavity, find_cavities, surface_faces
from polmvs.surface.creases import (
    corner_normals,
    sharpened,
    sided_normals,
    sides_known,
    wall_normals,
)
from polmvs.surface.dense_view import DenseView, lattice_xy
from polmvs.surface.fusion import FusedCloud, no_points
from polmvs.surface.ground import SupportingPlane, supporting_plane
from polmvs.surface.mesh_geometry import (
    Box,
    DistanceGrid,
    RayScene,
    SignedDistance,
    TriangleMesh,
    remeshed,
    sample_surface,
)
from polmvs.surface.observations import Looking
from polmvs.surface.offsets import (
    PatchGroup,
    PatchScene,
    SteppedPatches,
    find_patches,
    free_spaces,
    patch_groups,
    patch_scene,
    stepped_patches,
)
from polmvs.surface.open_scene import open_scene
from polmvs.surface.phase_bias import MIN_POINTS, Bias, find_bias
from polmvs.surface.solver import (
    Fit,
    Labelled,
    PositionSigma,
    Refined,
    SolverTolerances,
    first_fit,
    iterated,
    label,
    place_deviations,
    polishing_step,
    refine,
)
from polmvs.surface.surface_quality import (
    MAX_OFF,
    MAX_SHARE,
    MIN_EXPLAINED,
    Contradictions,
    FaceEvidence,
    contradicted_faces,
    disagreement_deg,
    face_evidence,
    find_contradictions,
    fit_normals,
    loses_silhouettes,
    misfit,
    outline_mismatch,
    pixel_information,
    point_offset,
    points_deny,
    share_off,
    stand_apart,
    supported_faces,
    view_information,
)
from polmvs.surface.surface_view import SurfaceView
from polmvs.surface.terms import KnownPoints, KnownSides
from polmvs.surface.vessels import opened_hull
from polmvs.surface.visual_hull import (
    HullTolerances,
    VisualHull,
    visual_hull,
)

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

WRONG_SHARES = (0.1, 0.2, 0.3)  # of the silhouettes, tolerated by a hull
MAX_FILLED_SHARE = 0.35  # of the image's border on the objects: a silhouette then bounds little
REMESHED_EDGE = 0.85  # mean edge of a mesh from a grid, in its steps; measured on spheres
# Before edges are sharp, outlines pull the faces outwards by what rounding removes: 0.2 to 0.4 px.
# Each polishing step halves this error. Measured on analytic boxes.
SHARP_STEPS = 4
RIM_WIDTH_PX = 0.35  # of the images' smoothing about rims of a few pixels; less gives the same
DEVIATION_EDGE_PX = 6.0  # of the mesh on which the position uncertainty is computed
MAX_PATCH_VIEWS = 24  # evenly chosen views that show planar patches: it bounds time and memory
NUM_FINAL_STEPS = 3  # of the progress: evidence, normals, deviations


@dataclass(frozen=True)
class GlobalSurface:
    """A surface with its support and uncertainty.

    Attributes
    ----------
    mesh : closed, with the parts that no view supports.
    supported : (F,) bool, faces that the views support.
    evidence : of the faces.
    light : (3, F) means over a face's observations: probabilities of specular and of diffuse light,
        and the degree of polarization.
    normals : (F, 3, 3) unit, from the phases, of each corner of the faces: the two sides of an edge
        have different ones.
    sigma_deg : (F,) standard deviation of the normal, degrees; inf where unknown.
    sigma : (V,) standard deviation of the position along the normal, world units; inf if unknown.
    gsd : ground sampling distance at the surface, world units.
    contradictions : between the surface and the data.
    inferred : (F,) bool, walls of cavities without phases, or, where the rim gives the thickness,
        with phases of light that was reflected several times.
    contradicted : (F,) bool, faces that phases contradict: without points and depths.
    tilt_share : as in :class:`polmvs.surface.observations.Looking`.
    left_out : (K,) bool, inconsistent views; the surface is made without them.
    levels : the first surface, and the mesh after each level of refinement.
    is_bounded : by silhouettes; otherwise it is that of an open scene.
    is_vessel : open at the top from the start.
    """

    mesh: TriangleMesh
    supported: Mask
    evidence: FaceEvidence
    light: Array
    normals: Array
    sigma_deg: Array
    sigma: Array
    gsd: float
    contradictions: Contradictions
    inferred: Mask
    contradicted: Mask
    tilt_share: float
    left_out: Mask
    levels: tuple[TriangleMesh, ...] = ()
    is_bounded: bool = True
    is_vessel: bool = False

    def shown(self) -> GlobalSurface:
        """The surface without the inferred faces."""
        seen = self.supported & ~self.inferred
        return replace(self, supported=seen, inferred=np.zeros_like(seen))

    @property
    def measured(self) -> Mask:
        """(F,) supported faces that phases do not contradict."""
        return np.asarray(self.supported & ~self.contradicted)


@dataclass(frozen=True)
class Undetermined:
    """Why there is no surface from all views.

    Attributes
    ----------
    reason : a clause without its end, such as "no view shows a polarized region".
    """

    reason: str


@dataclass(frozen=True)
class SparsePoints:
    """Sparse points by their use.

    Attributes
    ----------
    seeds : points of the objects.
    surroundings : (N, 3), points of the surroundings.
    scene : all points, for an open scene; None: the silhouettes are certain.
    """

    seeds: Seeds
    surroundings: Floats
    scene: Seeds | None = None


def num_surface_steps(num_views: int) -> int:
    """Number of steps that :func:`reconstruct_surface` and the rendering of its views report."""
    return SolverTolerances().num_steps + NUM_FINAL_STEPS + num_views


def reconstruct_surface(
    looking: Looking,
    views: Sequence[SurfaceView],
    sparse: SparsePoints,
    *,
    min_views: int = 2,
    tolerances: SolverTolerances | None = None,
    on_progress: OnProgress = no_progress,
    folder: Path | None = None,
) -> GlobalSurface | Undetermined:
    """The surface on which all views agree.

    Parameters
    ----------
    looking : how the views are observed, at first.
    views : all.
    sparse : sparse points.
    min_views : number of views that must support a part.
    tolerances : of the solver.
    on_progress : called with 1 after each step.
    folder : for temporary results of each view; None: in memory.
    """
    first = _first_surface(views, sparse, folder)
    if isinstance(first, Undetermined):
        return first
    logger.info("first surface: %d vertices.", len(first.mesh.vertices))
    given = _Given(
        scene=patch_scene(
            [view.phase_map for view in first.views],
            looking.angle_model,
            tilt_aware=looking.tilt_aware,
            folder=folder,
        ),
        seeds=sparse.seeds,
        min_views=min_views,
        on_progress=on_progress,
    )
    fit = first_fit(first.views, looking, first.gsd, known=first.known, tolerances=tolerances)
    first = first.opened(given, fit)
    refined = _near_points(
        first,
        fit,
        partial(
            refine,
            first.mesh,
            stands_apart=partial(stand_apart, least=MIN_EXPLAINED),
            walls=first.walls,
        ),
        on_progress,
    )
    _warn_of_inconsistent(looking.angle_model, first.views, refined)
    if not len(refined.mesh.faces):
        return Undetermined("the surface vanishes under the phases of the views")
    if refined.left_out.any():
        given = replace(given, scene=given.scene.of(~refined.left_out))
    steps, cavities = _carvings(given, first, refined)
    free = _free_of_points(first, refined)
    mesh, fit = (refined.mesh, refined.fit) if free is None else free
    carved = mesh
    if first.hull is not None and (steps or cavities):
        edge = mesh.mean_edge / REMESHED_EDGE
        carved = _carved(RayScene(mesh), edge, first.hull, steps, cavities)
    if not len(carved.faces):
        return Undetermined("the surface vanishes under the cavities found in it")
    polished = _polished(given, carved, fit, replace(refined, mesh=mesh), [*steps, *cavities])
    if free is not None:
        polished = replace(_unbiased(polished, first.known), fit=refined.fit)
    surface = _supported(given, polished, steps, cavities, refined.left_out)
    levels, is_vessel = (first.mesh, *refined.meshes), first.walls is not None
    surface = replace(surface, levels=levels, is_vessel=is_vessel)
    if first.hull is not None:
        return surface
    # The silhouettes of an open scene are its first surface, not what the views show of objects.
    contradictions = replace(surface.contradictions, uncovered_share=0.0)
    return replace(surface, is_bounded=False, contradictions=contradictions)


@dataclass(frozen=True, kw_only=True)
class _First:
    """The first surface.

    Attributes
    ----------
    mesh : closed.
    views : all.
    known : points of the surface.
    gsd : ground sampling distance at the surface, world units.
    hull : whose surface it is; None for an open scene.
    plane : on which the objects stand, if it is known.
    walls : of a vessel, which coarse meshes lose.
    """

    mesh: TriangleMesh
    views: Sequence[SurfaceView]
    known: KnownPoints
    gsd: float
    hull: VisualHull | None = None
    plane: SupportingPlane | None = None
    walls: SignedDistance | None = None

    def opened(self, given: _Given, fit: Fit) -> _First:
        """The hull without the inside of a vessel, or without the space above planar patches."""
        if self.hull is None:
            return self
        hull, walls = opened_hull(self.hull, self.plane, fit)
        opened = replace(self, mesh=hull.mesh, hull=hull, walls=walls)
        if walls is None:
            return opened.carved(given.steps(RayScene(hull.mesh), is_refined=False))
        logger.info("a vessel, open at the top.")  # its floor is refined; it is no height step
        return opened

    def carved(self, steps: Sequence[SteppedPatches]) -> _First:
        """The hull without the space above the planar patches that lose no silhouettes."""
        assert self.hull is not None
        kept = [
            group
            for group in steps
            if not self.loses_silhouettes(self.mesh, self.hull.carved([group.values]).mesh)
        ]
        hull = self.hull.carved(free_spaces(kept))
        return replace(self, mesh=hull.mesh, hull=hull)

    def loses_silhouettes(self, mesh: TriangleMesh, carved: TriangleMesh) -> bool:
        """Whether a carved mesh loses what silhouettes show, by more than two cells of the hull."""
        margin = 2 * HullTolerances.step_px
        return loses_silhouettes(mesh, carved, self.views, margin_px=margin)


def _first_surface(
    views: Sequence[SurfaceView], sparse: SparsePoints, folder: Path | None
) -> _First | Undetermined:
    """The visual hull, or if silhouettes contradict each other, the surface of sparse points."""
    if reason := _no_hull(views):
        return Undetermined(reason)
    centers = np.array([view.center for view in views])
    plane = supporting_plane(sparse.surroundings, centers)
    hull, mismatch = consistent_hull(views, plane)
    scene = None
    if sparse.scene is not None and mismatch > MAX_SHARE:
        scene = open_scene(sparse.scene, views, folder=None if folder is None else folder / "scene")
    if scene is not None and len(scene.mesh.faces):
        logger.warning(
            "The silhouettes of the views contradict each other (%.0f %% of their area in the "
            "median), so they bound no object. The surface starts from the %d sparse points "
            "instead; things without any are missing. If there is one object, give "
            "`region.mask`, or check poses and `capture.gamma`.",
            100 * mismatch,
            len(scene.known.points),
        )
        return _First(mesh=scene.mesh, views=scene.views, known=scene.known, gsd=scene.gsd)
    if not len(hull.mesh.faces):
        return Undetermined("the silhouettes of the views have no common object")
    known = KnownPoints(sparse.seeds.points_in_world, sparse.seeds.sigma)
    return _First(mesh=hull.mesh, views=views, known=known, gsd=hull.gsd, hull=hull, plane=plane)


@dataclass(frozen=True, kw_only=True)
class _Given:
    """Input of a surface other than the views.

    Attributes
    ----------
    scene : of the views, for planar patches.
    seeds, min_views : as of :func:`reconstruct_surface`.
    on_progress : called with the number of steps done.
    """

    scene: PatchScene
    seeds: Seeds
    min_views: int
    on_progress: OnProgress

    @cached_property
    def groups(self) -> tuple[PatchGroup, ...]:
        """Groups of parallel patches on which the points lie."""
        views = self.scene.of(evenly_chosen(len(self.scene.maps), MAX_PATCH_VIEWS))
        return patch_groups(find_patches(self.seeds), self.seeds, views)

    def steps(self, scene: RayScene, *, is_refined: bool) -> tuple[SteppedPatches, ...]:
        """Planar patches where they explain more phases than a surface."""
        return stepped_patches(self.groups, surface=scene, is_refined=is_refined)


def consistent_hull(
    views: Sequence[SurfaceView], plane: SupportingPlane | None
) -> tuple[VisualHull, float]:
    """The hull whose outlines best match the silhouettes: of all views, or with some wrong ones.

    A single wrong silhouette carves the object away; tolerating some makes a hull of few views too
    wide. So more are tolerated only until most views agree with the hull.

    Returns
    -------
    The hull, and the median share of a view's area in which its outline and the silhouette differ.
    Measured on 20 captures of objects: 0.007 to 0.038; on a desk 0.23, with a wrong gamma 0.86.
    """

    def mismatch(hull: VisualHull) -> Array:
        if not len(hull.mesh.faces):
            return np.ones(len(views))
        return np.nan_to_num(outline_mismatch(hull.mesh, views), nan=1.0)

    best = visual_hull(views, plane, wrong_share=0.0)
    least = mismatch(best)
    if not (least > MAX_SHARE).any():
        return best, float(np.median(least))
    for share in WRONG_SHARES:
        hull = visual_hull(views, plane, wrong_share=share)
        found = mismatch(hull)
        if np.median(found) < np.median(least):
            best, least = hull, found
        if np.median(least) <= MAX_SHARE:
            break
    return best, float(np.median(least))


def _near_points(
    first: _First, fit: Fit, refined: Callable[..., Refined], on_progress: OnProgress
) -> Refined:
    """A refined surface; where many sparse points are off it, one that is pulled from farther.

    A part whose edges no outline shows may lie several edges beside its points, whose loss is then
    flat. A wider loss lets wrong points pull as well.
    """
    found = refined(fit, on_progress=on_progress)
    off = None if first.hull is None else share_off(found.mesh, first.known, first.views)
    # Points do not correct biased phases (OPA): they only dent the surface.
    if off is None or off <= MAX_OFF or _free_of_points(first, found) is not None:
        return found
    terms = replace(fit.tol.terms, point_loss_edges=1.0)
    again = refined(replace(fit, tol=replace(fit.tol, terms=terms)))
    still_off = share_off(again.mesh, first.known, first.views)
    if still_off is None or still_off >= off:
        return found
    logger.info(
        "%.0f %% of the sparse points were off the surface; pulled from farther, %.0f %%.",
        100 * off,
        100 * still_off,
    )
    return replace(again, fit=replace(again.fit, tol=fit.tol))


def _warn_of_inconsistent(
    angle_model: AngleModel, views: Sequence[SurfaceView], refined: Refined
) -> None:
    """Warn of the views that are left out, with what to check."""
    shares = zip(views, refined.unexplained, strict=True)
    for view, share in compress(shares, refined.left_out):
        logger.warning(
            "%s: %s is inconsistent with the other views: a first surface does not explain "
            "%.0f %% of what it shows (median of all views: %.0f %%). It is left out; its pose, "
            "its mask or its image may be wrong, or the object was moved.",
            angle_model,
            view.view.name,
            100 * share,
            100 * np.nanmedian(refined.unexplained),
        )


def _carved(
    scene: RayScene,
    edge: float,
    hull: VisualHull,
    steps: Sequence[SteppedPatches],
    cavities: Sequence[Cavity] = (),
) -> TriangleMesh:
    """A refined mesh with height steps and cavities carved, their walls sharp."""
    solid = [
        lambda points, group=group: np.maximum(group.solid(points), hull.distances(points))
        for group in steps
    ]
    # Smoothness rounds the walls of height steps; carving the refined surface makes them sharp.
    return remeshed(
        scene,
        edge,
        solid=solid,
        free=[*free_spaces(steps), *(cavity.values for cavity in cavities)],
        smoothing=0,
    )


@dataclass(frozen=True)
class _Polished:
    """A sharp mesh that has converged.

    Attributes
    ----------
    mesh : with F faces.
    fit : of the views.
    labelled : its observations, with their light.
    normals : (F, 3) unit, of the sides of edges.
    sigma_deg : (F,) of the normals from the phases.
    bias_sigma : (V,) deviation of the bias of the phases that sparse points show, world units.
    """

    mesh: TriangleMesh
    fit: Fit
    labelled: Labelled
    normals: Array
    sigma_deg: Array
    bias_sigma: Array


def _polished(
    given: _Given,
    mesh: TriangleMesh,
    fit: Fit,
    refined: Refined,
    carvings: Sequence[SteppedPatches | Cavity],
) -> _Polished:
    """A carved mesh with the sides of its edges sharp, moved until it has converged.

    ``refined`` is the surface before it was carved, ``fit`` its fit with or without sparse points.
    """
    labelled = label(mesh, fit)
    fitted = fit_normals(mesh, labelled)
    facing, is_wall = fitted.normals, np.zeros(len(mesh.faces), np.bool_)
    if carvings:
        to_uncarved = RayScene(refined.mesh).distance(mesh.centers).astype(np.float64)
        facing, is_wall = wall_normals(
            mesh,
            fitted.normals,
            fitted.is_fitted,
            [carving.values for carving in carvings],
            to_uncarved,
        )
    is_known = fitted.is_fitted | is_wall
    normals, average = sided_normals(mesh, facing, is_known)
    of_views = fitted.sigma_deg(mesh, average)
    sides = KnownSides(sides_known(mesh, normals, is_known), fitted.is_fitted & ~is_wall)

    def polish(mesh: TriangleMesh) -> tuple[TriangleMesh, bool]:
        return polishing_step(mesh, fit, sides)

    sharp = _converged(sharpened(mesh, normals), normals, polish, refined.fit)
    given.on_progress(1)
    # Detail as fine as the mesh looks like noise of the normals; the phases distinguish the two.
    is_sharp = label(sharp, fit).mean_loss(sharp) <= labelled.mean_loss(mesh)
    logger.info("the surface is %s.", "sharpened" if is_sharp else "left as smooth as it is")
    mesh = sharp if is_sharp else mesh
    labelled = label(mesh, fit, min_cosine=MIN_FACING_COSINE)
    sigma_deg = np.hypot(of_views, disagreement_deg(mesh, normals, fitted.is_fitted))
    return _Polished(mesh, fit, labelled, normals, sigma_deg, np.zeros(len(mesh.vertices)))


def _bias(mesh: TriangleMesh, labelled: Labelled, fit: Fit, known: KnownPoints) -> Bias | None:
    """The bias of the phases of a mesh that sparse points show."""
    seen = np.zeros(len(mesh.faces), np.bool_)
    seen[labelled.observations.face] = True
    return find_bias(mesh, seen, known, fit.gsd, gate_px=fit.tol.levels[-1].gate_px)


def _unbiased(polished: _Polished, known: KnownPoints) -> _Polished:
    """A mesh without the bias of its phases that sparse points show."""
    mesh, fit = polished.mesh, polished.fit
    bias = _bias(mesh, polished.labelled, fit, known)
    if bias is None:
        return polished
    mesh = mesh.moved(bias.heights[:, None] * mesh.vertex_normals)
    labelled = label(mesh, fit, min_cosine=MIN_FACING_COSINE)
    return replace(polished, mesh=mesh, labelled=labelled, bias_sigma=bias.sigma)


def _supported(
    given: _Given,
    polished: _Polished,
    steps: Sequence[SteppedPatches],
    cavities: Sequence[Cavity],
    left_out: Mask,
) -> GlobalSurface:
    """A surface with the part of it that the views support."""
    mesh, fit, labelled = polished.mesh, polished.fit, polished.labelled
    evidence = face_evidence(mesh, fit, labelled)
    given.on_progress(1)
    sigma = _deviations(mesh, fit)
    given.on_progress(1)
    supported = supported_faces(
        mesh, evidence, min_views=given.min_views, gsd=fit.gsd, sigma=sigma.own
    )
    seen = evidence.num_views >= given.min_views
    own = sigma.own * np.sqrt(misfit(mesh, labelled))
    sigma = PositionSigma(own, np.hypot(sigma.shared, polished.bias_sigma))
    supported |= seen & _lie_on(mesh, [group.values for group in steps])
    contradicted = contradicted_faces(mesh, evidence, gsd=fit.gsd)
    inferred = ~supported & _lie_on(mesh, [cavity.values for cavity in cavities])
    # Light in a cavity that its rim shows was reflected several times: it denies any wall.
    of_rim = [cavity.values for cavity in cavities if not cavity.is_measured]
    inferred |= contradicted & _lie_on(mesh, of_rim)
    inferred &= seen
    supported |= inferred
    contradicted &= ~inferred
    known = fit.known or KnownPoints(np.zeros((0, 3)), np.zeros(0))
    offset_px, offset_sigmas = point_offset(mesh, supported, sigma.total, known, fit.gsd)
    residual, _ = labelled.residuals(mesh)
    contradictions = replace(
        find_contradictions(
            mesh,
            evidence,
            supported,
            contradicted,
            fit.views,
            float(np.median(np.abs(residual))) if len(residual) else 0.0,
        ),
        point_offset_px=offset_px,
        point_offset_sigmas=offset_sigmas,
    )
    return GlobalSurface(
        mesh=mesh,
        supported=supported,
        evidence=evidence,
        light=labelled.means(len(mesh.faces)),
        normals=corner_normals(mesh, polished.normals),
        sigma_deg=polished.sigma_deg,
        sigma=sigma.total,
        gsd=fit.gsd,
        contradictions=contradictions,
        inferred=inferred,
        contradicted=contradicted,
        tilt_share=fit.looking.tilt_share,
        left_out=left_out,
    )


def _converged(
    sharp: TriangleMesh,
    normals: Array,
    polish: Callable[[TriangleMesh], tuple[TriangleMesh, bool]],
    fit: Fit,
) -> TriangleMesh:
    """A sharpened mesh, moved by steps until it has converged, unless known points deny them."""
    mesh, has_converged, steps_left = sharp, False, SHARP_STEPS
    while not has_converged and steps_left:
        mesh, has_converged = polish(mesh)
        mesh, steps_left = sharpened(mesh, normals), steps_left - 1
        # Phases under a model that the camera does not follow shift it inwards, under OPA by
        # millimetres.
        if fit.known is not None and points_deny(mesh, sharp, fit.known, fit.gsd):
            return sharp
    return mesh


def _carvings(
    given: _Given, first: _First, refined: Refined
) -> tuple[Sequence[SteppedPatches], Sequence[Cavity]]:
    """The height steps and cavities of a refined surface."""
    hull = first.hull
    if hull is None:
        return (), ()
    scene = RayScene(refined.mesh)
    cavities = _cavities(given, refined, scene, first.plane)
    if first.walls is not None:
        return (), cavities
    cell = HullTolerances.step_px * first.gsd
    steps = [
        group
        for group in given.steps(scene, is_refined=True)
        if not first.loses_silhouettes(refined.mesh, _carved(scene, cell, hull, [group]))
    ]
    logger.info("%d groups of planar patches.", len(steps))
    return steps, cavities


def _free_of_points(first: _First, refined: Refined) -> tuple[TriangleMesh, Fit] | None:
    """The surface and fit without known points, if these show that its phases are biased.

    Outlines hold the surface meanwhile.
    """
    if first.hull is None or len(first.known.points) < MIN_POINTS:
        return None
    free = replace(refined.fit, known=None)
    moved = iterated(refined.mesh, free)
    bias = _bias(moved, label(moved, free), free, first.known)
    return None if bias is None else (moved, free)


def _cavities(
    given: _Given, refined: Refined, scene: RayScene, plane: SupportingPlane | None
) -> tuple[Cavity, ...]:
    """Cavities of a refined mesh, which stands on a plane if that is known."""
    mesh, fit = refined.mesh, refined.fit
    evidence = face_evidence(mesh, fit, label(mesh, fit))
    supported = supported_faces(
        mesh,
        evidence,
        min_views=given.min_views,
        gsd=fit.gsd,
        min_information=evidence.enough_information,
    )
    seen = evidence.num_views >= given.min_views

    @lru_cache(1)
    def parts_at(step: float, box: Box) -> tuple[DistanceGrid, TriangleMesh]:
        """The part of the surface in a box, on a grid, and the rest."""
        low, high = np.array(box)
        within = ((mesh.centers >= low) & (mesh.centers <= high)).all(axis=1)
        return DistanceGrid.of(scene, step, box), TriangleMesh(mesh.vertices, mesh.faces[~within])

    def information(step: float, box: Box, *free: SignedDistance) -> Array:
        """Of the phases of each view on a part, nats, with free space carved."""
        part, rest = parts_at(step, box)
        return view_information(part.mesh(free=free, smoothing=0), fit, rest)

    closed = cache(information)

    def gain(cavity: Cavity) -> Array:
        # With fewer than two cells across it, a wall vanishes.
        step = min(HullTolerances.step_px * fit.gsd, 0.5 * cavity.thickness)
        box = cavity.grid.box_of(mesh.centers)
        return information(step, box, cavity.values) - closed(step, box)

    @cache
    def at_rims() -> Fit:
        return fit.at_width(RIM_WIDTH_PX)

    def of_faces(mesh: TriangleMesh) -> sparse.csr_array:
        return pixel_information(mesh, at_rims())

    upwards = None if plane is None else plane.normal
    surface = surface_faces(scene, seen, supported, fit.gsd, upwards)
    return find_cavities(surface, given.scene, gain, of_faces)


def _lie_on(mesh: TriangleMesh, carvings: Sequence[SignedDistance]) -> Mask:
    """Which faces ``(F,)`` border carved space."""
    found = np.zeros(len(mesh.faces), np.bool_)
    for values in carvings:
        found |= np.abs(values(mesh.centers)) < mesh.mean_edge
    return found


def _no_hull(views: Sequence[SurfaceView]) -> str | None:
    """Why silhouettes do not bound the objects, if they do not."""
    outlined = [view for view in views if view.has_outline]
    if not any(view.silhouette.certain.any() for view in views):
        return "no view shows a polarized region"
    if len(outlined) < MIN_VIEWS:
        return f"{len(outlined)} views show an outline of an object, of {MIN_VIEWS} needed"
    borders = [_border_share(view.silhouette.certain) for view in outlined]
    if float(np.median(borders)) > MAX_FILLED_SHARE:
        return "the polarized object fills the images"
    return None


def _border_share(mask: Mask) -> float:
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return float(border.mean())


def _deviations(mesh: TriangleMesh, fit: Fit) -> PositionSigma:
    """Position uncertainty of the vertices, sampled on a coarser mesh if that saves time."""
    coarse = remeshed(RayScene(mesh), DEVIATION_EDGE_PX * fit.gsd)
    if not len(coarse.faces):
        coarse = mesh
    sigma = place_deviations(coarse, fit)
    _, face, barycentric = RayScene(coarse).closest(mesh.vertices)

    def at_vertices(of_coarse: Array) -> Array:
        corners = of_coarse[coarse.faces[face]]
        weight = barycentric * np.isfinite(corners)
        total = weight.sum(axis=1)
        sums = (np.where(np.isfinite(corners), corners, 0) * weight).sum(axis=1)
        return np.where(total > 1e-6, sums / np.maximum(total, 1e-9), np.inf)

    return PositionSigma(at_vertices(sigma.own), at_vertices(sigma.shared))


def supported_mesh(surface: GlobalSurface) -> Mesh:
    """The part of the surface that the views support, with the normals from the phases."""
    faces = surface.mesh.faces[surface.supported]
    used, compact = np.unique(faces, return_inverse=True)
    # A file has one normal for each vertex: on an edge the mean of its sides.
    sums = np.zeros_like(surface.mesh.vertices)
    np.add.at(sums, faces, surface.normals[surface.supported])
    normals = sums[used]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return Mesh(
        vertices=surface.mesh.vertices[used],
        normals=normals,
        triangles=compact.reshape(-1, 3).astype(np.int32),
    )


@dataclass(frozen=True)
class SurfacePoints:
    """Points spread over a surface.

    Attributes
    ----------
    cloud : N points.
    inferred : (N,) bool, points that no phase shows.
    light : (3, N) probabilities of specular and of diffuse light, and the degree of polarization:
        means over the views.
    """

    cloud: FusedCloud
    inferred: Mask
    light: Array

    def scalars(self) -> dict[str, NDArray[np.float32]]:
        """The light by the names of the columns in files."""
        names = ("specular", "diffuse", "dolp")
        return dict(zip(names, self.light.astype(np.float32), strict=True))


def surface_points(
    surface: GlobalSurface, maps: Sequence[PhaseMap], spacing: float, *, max_points: int = 2_000_000
) -> SurfacePoints:
    """Points spread evenly over the part of a surface that views support and phases allow.

    Parameters
    ----------
    surface : of all views.
    maps : of the views, for the intensity.
    spacing : mean distance of neighbours, world units.
    max_points : largest number of points; above it the spacing grows.
    """
    mesh = surface.mesh
    area = float(mesh.face_areas[surface.measured].sum())
    if area <= 0:
        return SurfacePoints(no_points(), np.zeros(0, np.bool_), np.zeros((3, 0)))
    # Random points leave gaps: three times as many are drawn, and one is kept in each voxel.
    num = int(min(max(3 * area / spacing**2, 1), 3 * max_points))
    face, barycentric = sample_surface(
        mesh, surface.measured.astype(np.float64), num, np.random.default_rng(0)
    )
    points = mesh.points_at(face, barycentric)
    kept = voxel_representatives(points, max(spacing, np.sqrt(area / max_points)))
    face, barycentric, points = face[kept], barycentric[kept], points[kept]
    normals = _normals_at(surface, face, barycentric)
    cloud = FusedCloud(
        points=points,
        normals=normals,
        intensity=_intensity(points, normals, maps),
        num_views=surface.evidence.num_views[face].astype(np.int32),
        sigma_deg=_finite(surface.sigma_deg[face]),
        sigma=_finite(_interpolated(surface.sigma, mesh, face, barycentric)),
    )
    return SurfacePoints(cloud, surface.inferred[face], surface.light[:, face])


def _finite(values: Array) -> NDArray[np.float32]:
    """Deviations for writing: NaN where unknown."""
    return np.where(np.isfinite(values), values, np.nan).astype(np.float32)


def _interpolated(
    values: Array, mesh: TriangleMesh, face: NDArray[np.int64], barycentric: Floats
) -> Array:
    """Values ``(V,)`` of vertices at points of faces."""
    return np.asarray((values[mesh.faces[face]] * barycentric).sum(axis=1))


def _normals_at(surface: GlobalSurface, face: NDArray[np.int64], barycentric: Floats) -> Array:
    """Unit normals ``(N, 3)`` at points of faces."""
    normals = (surface.normals[face] * barycentric[:, :, None]).sum(axis=1)
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return np.asarray(normals)


def _intensity(points: Array, normals: Array, maps: Sequence[PhaseMap]) -> NDArray[np.float32]:
    """Mean intensity ``(N,)`` of the views that face each point."""
    total, count = np.zeros(len(points)), np.zeros(len(points))
    for phase_map in maps:
        faces = np.flatnonzero(phase_map.view.faces(points, normals))
        xy = phase_map.view.project(points[faces])
        values = sample_image(np.asarray(phase_map.intensity, np.float32), xy)
        seen = values > 0
        total[faces[seen]] += values[seen]
        count[faces[seen]] += 1
    return (total / np.maximum(count, 1)).astype(np.float32)


def render_view(
    surface: GlobalSurface, scene: RayScene, view: View, stride_px: int
) -> DenseView | None:
    """Depth and normals of the surface in one view; None if the view does not see it.

    Parameters
    ----------
    surface : of all views.
    scene : of the whole mesh: parts that no view supports occlude others as well.
    view : to render.
    stride_px : distance of the lattice's points, px.
    """
    mesh = surface.mesh
    num_rows, num_cols = view.camera.height // stride_px, view.camera.width // stride_px
    xy = lattice_xy(num_rows, num_cols, stride_px).reshape(-1, 2)
    rays = view.rays_in_world(xy)
    hits = scene.cast(view.center_in_world, rays)
    index = np.flatnonzero(hits.face >= 0)
    index = index[surface.measured[hits.face[index]]]
    face, barycentric = hits.face[index], hits.barycentric[index]
    cosine = -(mesh.face_normals[face] * rays[index]).sum(axis=1)
    front = cosine > 0
    index, face, barycentric, cosine = index[front], face[front], barycentric[front], cosine[front]
    if not len(index):
        return None
    shape = (num_rows, num_cols)
    range_map, confidence = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    sigma, sigma_deg = (np.full(shape, np.nan, np.float32) for _ in range(2))
    normal_map = np.full((*shape, 3), np.nan, np.float32)
    normals = _normals_at(surface, face, barycentric)
    along = _interpolated(surface.sigma, mesh, face, barycentric) / np.maximum(cosine, 0.1)
    range_map.ravel()[index] = hits.distance[index]
    normal_map.reshape(-1, 3)[index] = normals
    sigma.ravel()[index] = _finite(along)
    sigma_deg.ravel()[index] = _finite(surface.sigma_deg[face])
    confidence.ravel()[index] = surface.evidence.agreement[face]
    return DenseView(stride_px, range_map, normal_map, sigma_deg, sigma, confidence)
