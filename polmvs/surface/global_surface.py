"""One surface from all views: from phase maps to a mesh with what is known of it.

Silhouettes, their hull, its refinement by all phases, and what the views bear out of it. Clouds,
meshes and the depth and normal maps of the views are made from that one surface.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.config import AngleModel, default_num_workers
from polmvs.geometry import lengths
from polmvs.io.clouds import Mesh
from polmvs.neighbors import voxel_representatives
from polmvs.parallel import OnProgress, no_progress
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_VIEWS, Seeds, View
from polmvs.surface.creases import (
    corner_normals,
    sharpened,
    sided_normals,
    sides_known,
    wall_normals,
)
from polmvs.surface.dense_view import DenseView, lattice_xy
from polmvs.surface.fusion import FusedCloud, no_points
from polmvs.surface.hollows import Hollow, SurfaceFaces, find_hollows
from polmvs.surface.mesh_geometry import (
    BAND_CELLS,
    RayScene,
    TriangleMesh,
    remeshed,
    sample_surface,
)
from polmvs.surface.offsets import (
    FaceScene,
    SteppedFaces,
    face_scene,
    find_faces,
    stepped_faces,
)
from polmvs.surface.refinement import (
    KnownPoints,
    KnownSides,
    Refined,
    RefinementTolerances,
    median_residual,
    place_deviations,
    refine,
    settling_step,
    unexplained_shares,
)
from polmvs.surface.silhouettes import find_silhouette
from polmvs.surface.surface_quality import (
    MAX_SHARE,
    MIN_EXPLAINED,
    MIN_OUTLINED,
    Contradictions,
    FaceEvidence,
    face_evidence,
    find_contradictions,
    fit_normals,
    outline_mismatch,
    point_offset,
    points_deny,
    stand_apart,
    supported_faces,
)
from polmvs.surface.surface_view import SurfaceView, surface_view
from polmvs.surface.visual_hull import (
    HullTolerances,
    Plane,
    VisualHull,
    supporting_plane,
    visual_hull,
)

logger = logging.getLogger(__name__)

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

MAX_FILLED_SHARE = 0.35  # of the image's border on the objects, where a silhouette bounds little
REMESHED_EDGE = 0.85  # mean edge of a mesh from a grid, in its steps; measured on spheres
# While a mesh's edges were round, outlines drew its faces outwards by what the edges lacked: 0.2 to
# 0.4 px. Each step takes about half of what the one before has left: measured on analytic boxes.
SHARP_STEPS = 4
NUM_FINAL_STEPS = 3  # of the progress: evidence, normals, deviations


@dataclass(frozen=True)
class GlobalSurface:
    """A surface and what is known of it.

    Attributes
    ----------
    mesh : all of it, closed, parts that no view bears out included.
    supported : (F,) bool, faces that the views bear out.
    evidence : of the faces.
    normals : (F, 3, 3) unit, from the phases, of each corner of the faces: two sides of an edge
        have their own.
    sigma_deg : (F,) standard deviation of the normal, degrees; inf where unknown.
    sigma : (V,) standard deviation of the place along the normal, world units; inf where unknown.
    footprint : length that a pixel covers at the surface, world units.
    contradictions : with the data.
    presumed : (F,) bool, faces that no phase shows: walls of hollows, presumed as thick inside as
        the rim shows them.
    tilt_share : as in :class:`polmvs.surface.refinement.Refined`.
    left_out : (K,) bool, views that contradict the others; the surface is made without them.
    """

    mesh: TriangleMesh
    supported: Mask
    evidence: FaceEvidence
    normals: Array
    sigma_deg: Array
    sigma: Array
    footprint: float
    contradictions: Contradictions
    presumed: Mask
    tilt_share: float
    left_out: Mask


@dataclass(frozen=True)
class Undetermined:
    """Why there is no surface from all views.

    Attributes
    ----------
    reason : a clause without its end, such as "no view shows a polarised region".
    """

    reason: str


def num_surface_steps(num_views: int) -> int:
    """How many steps :func:`reconstruct_surface` and the rendering of its views report.

    A surface that is made once more reports none of its steps.
    """
    *before, last = RefinementTolerances().levels
    refinement = 2 * sum(level.num_steps for level in before) + last.num_steps  # they go two ways
    return refinement + NUM_FINAL_STEPS + num_views


def reconstruct_surface(
    angle_model: AngleModel,
    maps: Sequence[PhaseMap],
    seeds: Seeds,
    surroundings: Floats,
    *,
    masks_given: bool = False,
    tilt_aware: bool = True,
    min_views: int = 2,
    tolerances: RefinementTolerances | None = None,
    on_progress: OnProgress = no_progress,
    on_mesh: Callable[[TriangleMesh], None] | None = None,
    folder: Path | None = None,
) -> GlobalSurface | Undetermined:
    """The surface on which all views agree.

    Parameters
    ----------
    angle_model : of the phase maps.
    maps : of all views.
    seeds : points of the surface.
    surroundings : (N, 3), sparse points beside it.
    masks_given : the maps' regions are the user's masks.
    tilt_aware : as :func:`polmvs.surface.surface_view.surface_view`, and of the rows' weights.
    min_views : that must bear out a part.
    tolerances : of the refinement.
    on_progress : called with 1 after each step.
    on_mesh : called at the end with the hull, and with the mesh after each level of its refinement.
    folder : where what is made of each view is kept meanwhile; None: in memory.
    """

    def look_at(phase_map: PhaseMap) -> SurfaceView:
        silhouette = find_silhouette(phase_map, mask_given=masks_given)
        return surface_view(
            phase_map, silhouette, angle_model, tilt_aware=tilt_aware, folder=folder
        )

    # Threads, for nearly all of it is OpenCV's; each view's depends on itself alone.
    with ThreadPoolExecutor(default_num_workers()) as pool:
        views = list(pool.map(look_at, maps))
    if reason := _no_hull(views):
        return Undetermined(reason)
    scene = face_scene(maps, angle_model, tilt_aware=tilt_aware, folder=folder)
    done = 0

    def advance(count: int) -> None:
        nonlocal done
        # Steps of a surface that is given up count, up to the number announced.
        count = min(count, num_surface_steps(0) - done)
        done += count
        on_progress(count)

    def given_by(kept: Mask, *, is_suspicion: bool = False) -> _Given:
        own = list(compress(views, kept))
        return _Given(
            all_views=views,
            kept=kept,
            is_suspicion=is_suspicion,
            views=own,
            scene=scene.of(kept),
            seeds=seeds,
            plane=supporting_plane(surroundings, np.array([view.center for view in own])),
            min_views=min_views,
            on_progress=advance,
        )

    tolerances, hull_tolerances = tolerances or RefinementTolerances(), HullTolerances()
    given = given_by(np.ones(len(views), np.bool_))
    hull = given.hull(hull_tolerances)
    suspects = stand_apart(outline_mismatch(hull.mesh, views), MIN_OUTLINED)
    if suspects.any():
        given = given_by(~suspects, is_suspicion=True)
        hull = given.hull(hull_tolerances)
    attempt = _surface(given, hull, tolerances)
    while attempt.found is None:
        given = given_by(~attempt.odd)
        attempt = _surface(given, given.hull(hull_tolerances), tolerances)
    attempt.warn(given)
    found, meshes = attempt.found, attempt.meshes
    if tolerances.thin_levels and _uncovered_share(found) > MAX_SHARE:
        logger.warning(
            "%s: %.0f %% of the polarised regions stay uncovered, walls may be thin: the surface "
            "is made once more with a finer mesh, which may take minutes.",
            angle_model,
            100 * _uncovered_share(found),
        )
        fine = replace(hull_tolerances, step_px=0.5 * hull_tolerances.step_px)
        thin = replace(tolerances, levels=tolerances.thin_levels)
        unheard = replace(given, is_suspicion=False, on_progress=no_progress)
        again = _surface(unheard, unheard.hull(fine), thin)
        if again.found is not None and _uncovered_share(again.found) < _uncovered_share(found):
            found, meshes = again.found, again.meshes
    advance(max(num_surface_steps(0) - done, 0))
    if on_mesh is not None:
        for mesh in meshes:
            on_mesh(mesh)
    return found


@dataclass(frozen=True, kw_only=True)
class _Given:
    """What a surface is made from.

    Attributes
    ----------
    all_views, kept : what the views show, and which of them ``(K,)`` are believed.
    is_suspicion : the others are left out for their outlines alone: they may come back.
    views, scene : of those believed.
    seeds, min_views : as of :func:`reconstruct_surface`.
    plane : on which the objects stand.
    on_progress : called with the number of steps done.
    """

    all_views: Sequence[SurfaceView]
    kept: Mask
    is_suspicion: bool
    views: Sequence[SurfaceView]
    scene: FaceScene
    seeds: Seeds
    plane: Plane | None
    min_views: int
    on_progress: OnProgress

    @property
    def rows(self) -> AngleModel:
        """Of the phases' rows: those of a tilted map are those of PPA, its samples corrected."""
        return AngleModel.OPA if self.scene.angle_model is AngleModel.OPA else AngleModel.PPA

    @property
    def known(self) -> KnownPoints:
        """Sparse points on the surface."""
        return KnownPoints(self.seeds.points_in_world, self.seeds.sigma)

    def hull(self, tolerances: HullTolerances) -> VisualHull:
        """The first surface."""
        return visual_hull(self.views, self.plane, tolerances=tolerances)


@dataclass(frozen=True)
class _Attempt:
    """A surface from views that may contradict each other.

    Attributes
    ----------
    found : None where other views are to be left out than were.
    meshes : the hull, and the mesh after each level of its refinement.
    unexplained : (K,) share of what each of all views shows that the first level does not explain.
    odd : (K,) bool, which are to be left out.
    """

    found: GlobalSurface | Undetermined | None
    meshes: list[TriangleMesh]
    unexplained: Array
    odd: Mask

    def warn(self, given: _Given) -> None:
        """Say which are left out, and what to look at."""
        shares = zip(given.all_views, self.unexplained, strict=True)
        for view, share in compress(shares, self.odd & np.isfinite(self.unexplained)):
            logger.warning(
                "%s: %s contradicts the other views: %.0f %% of what it shows is not explained by "
                "a first surface (median of all: %.0f %%). It is left out; its pose, its mask "
                "or its image may be wrong.",
                given.scene.angle_model,
                view.view.name,
                100 * share,
                100 * np.nanmedian(self.unexplained),
            )


def _uncovered_share(found: GlobalSurface | Undetermined) -> float:
    """Mean share of the silhouettes that a surface does not cover; 1 without one."""
    return 1.0 if isinstance(found, Undetermined) else found.contradictions.uncovered_share


def _surface(given: _Given, hull: VisualHull, tolerances: RefinementTolerances) -> _Attempt:
    """The surface that a hull is refined to."""
    meshes: list[TriangleMesh] = []
    unexplained, odd = np.full(len(given.kept), np.nan), ~given.kept

    def attempt(found: GlobalSurface | Undetermined | None) -> _Attempt:
        return _Attempt(found, meshes, unexplained, odd)

    if not len(hull.mesh.faces):
        return attempt(Undetermined("the polarised regions of the views have no common object"))
    logger.info("visual hull: %d vertices.", len(hull.mesh.vertices))
    steps = stepped_faces(
        find_faces(given.seeds),
        given.seeds,
        given.scene,
        signed_distance=RayScene(hull.mesh).signed_distance,
        first_hit=_first_hit(hull.mesh),
    )
    if steps:
        logger.info("%d groups of faces that silhouettes do not tell apart.", len(steps))
        hull = hull.carved([group.values for group in steps])
    meshes.append(hull.mesh)
    hollows = _hollows(given.scene, hull.mesh, hull.footprint)
    if hollows:
        # Phases of what sees only itself would be dug after.
        still = tuple(replace(level, with_slope=False) for level in tolerances.levels)
        tolerances = replace(tolerances, levels=still)

    def is_agreed(mesh: TriangleMesh) -> bool:
        nonlocal unexplained, odd
        meshes.append(mesh)
        if len(meshes) == 2:  # the hull and the first level
            # A model that leaves something out (OPA the perspective) contradicts all views.
            shown, _ = median_residual(mesh, given.views, given.rows, tolerances)
            unexplained = unexplained_shares(mesh, given.all_views, given.rows, shown.direct)
            judged = given.kept | given.is_suspicion
            odd = ~judged
            odd[judged] = stand_apart(unexplained[judged], MIN_EXPLAINED)
        return bool((odd == ~given.kept).all())

    refined = refine(
        hull.mesh,
        given.views,
        given.rows,
        hull.footprint,
        known=given.known,
        tolerances=tolerances,
        on_progress=given.on_progress,
        go_on=is_agreed,
    )
    if (odd == given.kept).any():
        return attempt(None)
    # A refined outer wall places the inner one better than the hull's.
    hollows = _hollows(given.scene, refined.mesh, hull.footprint, hollows) or hollows
    carvings = [*(group.values for group in steps), *(hollow.values for hollow in hollows)]
    mesh = refined.mesh
    if carvings and len(mesh.faces):
        # Smoothness rounds the walls of steps; what is carved out of the refined surface is sharp.
        mesh = remeshed(
            mesh,
            mesh.mean_edge / REMESHED_EDGE,
            solid=[_within(group.solid, hull.mesh, mesh.mean_edge) for group in steps],
            free=carvings,
            smoothing=0,
        )
    if not len(mesh.faces):
        return attempt(Undetermined("the surface vanishes under the phases of the views"))
    settled = _settled(given, mesh, refined, carvings, hull.footprint, tolerances)
    return attempt(_borne_out(given, settled, steps, hollows, hull.footprint, refined.tilt_share))


@dataclass(frozen=True)
class _Settled:
    """A sharp mesh at rest.

    Attributes
    ----------
    mesh : with F faces.
    views : which know what of the tilt is taken back.
    normals : (F, 3) unit, of the sides of edges.
    sigma_deg : (F,) of the normals that the phases show.
    row_sigma, median : of the phases' residuals, and their median.
    """

    mesh: TriangleMesh
    views: Sequence[SurfaceView]
    normals: Array
    sigma_deg: Array
    row_sigma: float
    median: float


def _settled(
    given: _Given,
    mesh: TriangleMesh,
    refined: Refined,
    carvings: Sequence[Callable[[Array], Floats]],
    footprint: float,
    tolerances: RefinementTolerances,
) -> _Settled:
    """A carved mesh with the sides of its edges sharp, moved until it is at rest."""
    views = [replace(view, tilt_share=refined.tilt_share) for view in given.views]
    shown, median = median_residual(mesh, views, given.rows, tolerances)
    fitted = fit_normals(mesh, views, given.rows, row_sigma=shown.direct)
    facing, is_wall = fitted.normals, np.zeros(len(mesh.faces), np.bool_)
    if carvings:
        to_uncarved = lengths(RayScene(refined.mesh).closest(mesh.centers)[0] - mesh.centers)
        facing, is_wall = wall_normals(
            mesh, fitted.normals, fitted.is_fitted, carvings, to_uncarved
        )
    is_known = fitted.is_fitted | is_wall
    normals = sided_normals(mesh, facing, is_known)
    sides = KnownSides(sides_known(mesh, normals, is_known), fitted.is_fitted & ~is_wall)

    def settle(mesh: TriangleMesh) -> tuple[TriangleMesh, bool]:
        return settling_step(
            mesh,
            views,
            given.rows,
            footprint,
            shown,
            sides=sides,
            known=given.known,
            tolerances=tolerances,
        )

    mesh = _at_rest(sharpened(mesh, normals), normals, settle, given.known, footprint)
    given.on_progress(1)
    return _Settled(mesh, views, normals, fitted.sigma_deg, shown.direct, median)


def _borne_out(
    given: _Given,
    settled: _Settled,
    steps: Sequence[SteppedFaces],
    hollows: Sequence[Hollow],
    footprint: float,
    tilt_share: float,
) -> GlobalSurface:
    """A surface with what the views bear out of it."""
    mesh, views, rows, known = settled.mesh, settled.views, given.rows, given.known
    evidence = face_evidence(mesh, views, rows, row_sigma=settled.row_sigma)
    supported = supported_faces(mesh, evidence, min_views=given.min_views)
    seen = evidence.num_views >= given.min_views
    supported |= seen & _lie_on(mesh, [group.values for group in steps])
    presumed = seen & ~supported & _lie_on(mesh, [hollow.values for hollow in hollows])
    supported |= presumed
    given.on_progress(1)
    sigma = _deviations(mesh, views, rows, footprint, known)
    given.on_progress(1)
    offset_px, offset_sigmas = point_offset(mesh, supported, sigma, known, footprint)
    contradictions = replace(
        find_contradictions(mesh, evidence, supported, views, settled.median),
        point_offset_px=offset_px,
        point_offset_sigmas=offset_sigmas,
    )
    return GlobalSurface(
        mesh=mesh,
        supported=supported,
        evidence=evidence,
        normals=corner_normals(mesh, settled.normals),
        sigma_deg=settled.sigma_deg,
        sigma=sigma,
        footprint=footprint,
        contradictions=contradictions,
        presumed=presumed,
        tilt_share=tilt_share,
        left_out=~given.kept,
    )


def _at_rest(
    sharp: TriangleMesh,
    normals: Array,
    settle: Callable[[TriangleMesh], tuple[TriangleMesh, bool]],
    known: KnownPoints,
    footprint: float,
) -> TriangleMesh:
    """A sharpened mesh, moved by steps until it is at rest, unless known points deny them."""
    mesh, is_at_rest, steps_left = sharp, False, SHARP_STEPS
    while not is_at_rest and steps_left:
        mesh, is_at_rest = settle(mesh)
        mesh, steps_left = sharpened(mesh, normals), steps_left - 1
        # Phases read by a model that their camera does not follow sink it, OPA's by millimetres.
        if points_deny(mesh, sharp, known, footprint):
            return sharp
    return mesh


def _hollows(
    scene: FaceScene, mesh: TriangleMesh, footprint: float, before: Sequence[Hollow] = ()
) -> tuple[Hollow, ...]:
    """Hollows of a mesh that see only themselves, ``before`` of an earlier state of it."""
    if not len(mesh.faces):
        return ()
    faces = SurfaceFaces(
        mesh.centers,
        mesh.face_normals,
        mesh.face_areas,
        RayScene(mesh).inside_along,
        footprint,
    )
    return find_hollows(faces, scene, before=before)


def _first_hit(mesh: TriangleMesh) -> Callable[[Array, Array], tuple[Floats, Floats]]:
    """Distance ``(N,)`` and normal ``(N, 3)`` where rays along one direction first meet a mesh."""
    scene = RayScene(mesh)

    def first_hit(origins: Array, direction: Array) -> tuple[Floats, Floats]:
        hits = scene.cast(origins, np.broadcast_to(direction, origins.shape))
        return hits.distance, mesh.face_normals[hits.face]

    return first_hit


def _within(
    solid: Callable[[Array], Array], mesh: TriangleMesh, edge: float
) -> Callable[[Array], Array]:
    """Signed distances to what is solid and enclosed by a mesh, for a new one of such edges.

    Far off what is solid they are not less than the distance to it, which is enough.
    """
    scene = RayScene(mesh)

    def distances(points: Array) -> Array:
        found = solid(points)
        near = np.flatnonzero(found < (BAND_CELLS + 1) * edge / REMESHED_EDGE)
        if not len(near):
            return found
        found[near] = np.maximum(found[near], scene.signed_distance(points[near], num_rays=1))
        return found

    return distances


def _lie_on(mesh: TriangleMesh, carvings: Sequence[Callable[[Array], Floats]]) -> Mask:
    """Which faces ``(F,)`` are borders of carved space."""
    found = np.zeros(len(mesh.faces), np.bool_)
    for values in carvings:
        found |= np.abs(values(mesh.centers)) < mesh.mean_edge
    return found


def _no_hull(views: Sequence[SurfaceView]) -> str | None:
    """Why silhouettes do not bound the objects, if they do not."""
    outlined = [view for view in views if view.has_outline]
    if not any(view.silhouette.certain.any() for view in views):
        return "no view shows a polarised region"
    if len(outlined) < MIN_VIEWS:
        return f"{len(outlined)} views show an outline of an object, of {MIN_VIEWS} needed"
    borders = [_border_share(view.silhouette.certain) for view in outlined]
    if float(np.median(borders)) > MAX_FILLED_SHARE:
        return "the polarised object fills the images"
    return None


def _border_share(mask: Mask) -> float:
    border = np.concatenate([mask[0], mask[-1], mask[:, 0], mask[:, -1]])
    return float(border.mean())


def _deviations(
    mesh: TriangleMesh,
    views: Sequence[SurfaceView],
    angle_model: AngleModel,
    footprint: float,
    known: KnownPoints,
) -> Array:
    """Deviations of the vertices, sampled on a coarser mesh if that saves time."""
    coarse = remeshed(mesh, RefinementTolerances.levels[0].edge_px * footprint)
    if not len(coarse.faces):
        coarse = mesh
    sigma = place_deviations(coarse, views, angle_model, footprint, known=known)
    _, face, barycentric = RayScene(coarse).closest(mesh.vertices)
    corners = sigma[coarse.faces[face]]
    known_corners = np.isfinite(corners)
    weight = barycentric * known_corners
    total = weight.sum(axis=1)
    mean = (np.where(known_corners, corners, 0) * weight).sum(axis=1) / np.maximum(total, 1e-9)
    return np.where(total > 1e-6, mean, np.inf)


def supported_mesh(surface: GlobalSurface) -> Mesh:
    """What the views bear out of the surface, with the normals of the phases."""
    faces = surface.mesh.faces[surface.supported]
    used, compact = np.unique(faces, return_inverse=True)
    # A file has one normal for each vertex: on an edge the mean of its sides'.
    sums = np.zeros_like(surface.mesh.vertices)
    np.add.at(sums, faces, surface.normals[surface.supported])
    normals = sums[used]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return Mesh(
        vertices=surface.mesh.vertices[used],
        normals=normals,
        triangles=compact.reshape(-1, 3).astype(np.int32),
    )


def surface_points(
    surface: GlobalSurface, maps: Sequence[PhaseMap], spacing: float, *, max_points: int = 2_000_000
) -> tuple[FusedCloud, Mask]:
    """Points spread evenly over what the views bear out, and which of them ``(N,)`` are presumed.

    Parameters
    ----------
    surface : of all views.
    maps : of the views, for the intensity.
    spacing : mean distance of neighbours, world units.
    max_points : the spacing grows beyond that.
    """
    mesh = surface.mesh
    area = float(mesh.face_areas[surface.supported].sum())
    if area <= 0:
        return no_points(), np.zeros(0, np.bool_)
    # Random places leave gaps: of three times as many, one in each voxel.
    num = int(min(max(3 * area / spacing**2, 1), 3 * max_points))
    face, barycentric = sample_surface(
        mesh, surface.supported.astype(np.float64), num, np.random.default_rng(0)
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
    return cloud, surface.presumed[face]


def _finite(values: Array) -> NDArray[np.float32]:
    """Deviations as they are written: NaN where unknown."""
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
    """Depth and normals of the surface in one view; None where it sees nothing of it.

    Parameters
    ----------
    surface : of all views.
    scene : of the surface's mesh, all of it: parts that no view bears out hide others as well.
    view : to render.
    stride_px : distance of the lattice's points, px.
    """
    mesh = surface.mesh
    num_rows, num_cols = view.camera.height // stride_px, view.camera.width // stride_px
    xy = lattice_xy(num_rows, num_cols, stride_px).reshape(-1, 2)
    rays = view.rays_in_world(xy)
    hits = scene.cast(view.center_in_world, rays)
    index = np.flatnonzero(hits.face >= 0)
    index = index[surface.supported[hits.face[index]]]
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
