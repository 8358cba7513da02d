"""Polarimetric refinement: one mesh moved along its normals until all views agree with it.

Gauss-Newton on one displacement per vertex, coarse to fine. The energy holds, for each face and
each view that sees it, the row ``m . n`` of the view's phase, with the change of the normal (and,
where no outline bounds the surface, of the row with the place); for each point of the outline in a
view, its distance to the silhouette; for each known point of the surface, its distance; and a
smoothness that is free of scale, so that it fades as the mesh refines. All losses are robust.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, fields, replace

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from polmvs.camera import sample_image
from polmvs.config import AngleModel, default_num_workers
from polmvs.fitting import CAUCHY_SCALE, annealed_scales, geman_mcclure_weights, robust_deviation
from polmvs.geometry import dots, lengths, points_on_rays, unit_or_zero
from polmvs.normals.estimator import smallest_eigenvectors
from polmvs.parallel import OnProgress, no_progress
from polmvs.scene import MIN_VIEWS
from polmvs.surface.creases import CreaseTolerances, crease_vertices
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh, remeshed, visible_points
from polmvs.surface.surface_view import SurfaceView, phase_rows

logger = logging.getLogger(__name__)

SETTLING_STEPS = 2  # until a mesh made anew, which shrinks by some tenths of a pixel, is at rest
EDGE_NOISE = 0.1  # of the sines of normals beside an edge: half of what parts its sides
RIM_HALVINGS = 4  # of a pixel, in which a mesh's outline is looked for: to a sixteenth

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class Level:
    """One level of refinement.

    Attributes
    ----------
    edge_px : edges of the mesh, in footprints of a pixel.
    num_steps : Gauss-Newton steps at most.
    loss_scale : of the phase rows' loss, in their standard deviations.
    rim_gate_px : outlines farther from a silhouette than this are not drawn to it.
    with_slope : count how a row changes as its place moves through the phase image (see
        :func:`_add_phases`) if the views are then clearly explained better: levels go both ways
        until one is better without, and the last of several goes the way of the one before.
    on_outline : hold the very outline of a sharp mesh against the silhouettes, and not the middles
        of edges, which wander to and fro about it and lie some tenths of a pixel within. Measured:
        so for the last level of refinement too, whose mesh is round, normals of `board` err by
        0.32 and not 0.24 deg, those of a bolt by 2.05 and not 2.15.
    """

    edge_px: float
    num_steps: int
    loss_scale: float
    rim_gate_px: float
    with_slope: bool = True
    on_outline: bool = False


@dataclass(frozen=True, kw_only=True)
class RefinementTolerances:
    """Numbers of the energy.

    Attributes
    ----------
    levels : coarse to fine. The third, of 2 px, is for edges: F at 1 mm of `board` 99.5 -> 99.9, of
        `step` 95.3 -> 96.3, for half as much time again.
    thin_levels : instead, where walls are thinner than the coarse edges, so that the mesh loses
        them: one of half as long edges, with as many steps as the same way takes and half as many
        again. Measured: a bowl with walls of 3 px, F at 1 mm 2 -> 91 %.
    row_sigma : deviation of ``m . n`` that noise does not explain (interreflection, mixed light,
        facets). Measured: 0.03.
    independent_px : area over which phases err alike, px^2; smaller faces count by their area.
        The phase map's smoothing; measured: counting each face anew costs 4 %.
    min_cosine : between normal and viewing direction; flatter sight is not counted. Measured on
        `dome`: within 3 px of the outline, where cosines are less, phases err by 1 to 3 deg all
        to one side.
    agreement : mean weight of a face's rows under the narrowest loss from which its views agree:
        on the mesh's normal, or else on one of their own. Noise alone leaves 0.9, of which one view
        in ten may stand apart. Measured on a prototype (dark walls left out), F at 1 mm with 0.5
        and 0.8: of a bolt 89.4 and 88.6, of a stack 80.8 and 80.9, of a bracket 92.6 and 94.2 %.
    phase_correlation : faces over which the phases' errors are alike, because the model of the
        light makes them and not noise: outlines and points count this much more than so many
        rows would let them. Measured on `dome`: a bias of the phases bends it by 1.5 mm with 1, by
        0.7 with 100, by 0.4 with 400, which dents `mug` at its sparse points.
    alike_views : in which they are alike, too: of more views points count the more. That many the
        captures have on which the rest was measured. Without, the face of a printed board sinks
        under its points by 0.3, 1.0 and 3.5 px where 23, 71 and 282 views show it; with, by 0.2 px
        where 71 do.
    place_sigma_px : least deviation of an outline, and of a known point in footprints; an
        outline's residuals may show a larger one. Measured: 0.3; 0.7 costs 30 % on general shapes.
    outline_bias_px : deviation of an error of all silhouettes together, too wide or too narrow.
        Measured on the true outlines of four captures: -0.35 to 0.04. It is part of the stated
        deviations and not solved for: what a mesh rounds at sharp edges would pass for it, by half
        a pixel on `board`, whose normals then err by 0.62 deg instead of 0.28.
    smoothness : deviation of the scale-free curvature from its surroundings' mean. Measured: 0.02
        to 0.04 alike.
    smoothness_memory : share of the surroundings' curvature that is not resisted. Measured: 0.8.
    damping : deviation of a step, in edges. Measured on `mug` and `step`: 100 and 0.5 alike; it
        holds what neither outlines nor points place. With the three that follow, half of it costs
        `mug` 0.4 points of F at 1 mm, twice gains 0.1.
    remesh_after : displacement of a fiftieth of the vertices after which a mesh is made anew, in
        edges. Guess: triangles of a mesh that moves by less stay usable.
    unseen_damping : of a vertex that no view sees, in edges; smoothness alone would melt it. Guess:
        a fiftieth of an edge.
    converged : root mean square of displacements of what is seen that ends a level, in edges.
        Guess: 0.06 px at the last level.
    max_vertices : of a mesh; finer levels are left out. From the time allowed.
    """

    levels: tuple[Level, ...] = (
        Level(edge_px=6.0, num_steps=18, loss_scale=12.0, rim_gate_px=25.0),
        Level(edge_px=3.0, num_steps=4, loss_scale=6.0, rim_gate_px=8.0),
        Level(edge_px=2.0, num_steps=3, loss_scale=4.0, rim_gate_px=4.0),
    )
    thin_levels: tuple[Level, ...] = (
        Level(edge_px=3.0, num_steps=60, loss_scale=12.0, rim_gate_px=25.0),
        Level(edge_px=2.0, num_steps=5, loss_scale=4.0, rim_gate_px=4.0),
    )
    row_sigma: float = 0.03
    independent_px: float = 4.0
    min_cosine: float = 0.25
    agreement: float = 0.8
    phase_correlation: float = 100.0
    alike_views: int = 20
    place_sigma_px: float = 0.3
    outline_bias_px: float = 0.1
    smoothness: float = 0.04
    smoothness_memory: float = 0.8
    damping: float = 0.5
    remesh_after: float = 2.0
    unseen_damping: float = 0.02
    converged: float = 0.03
    max_vertices: int = 120_000

    def point_weight(self, num_views: int) -> float:
        """Weight of the known points' rows, whose errors are not alike."""
        return self.phase_correlation * max(1.0, num_views / self.alike_views)


@dataclass(frozen=True)
class KnownPoints:
    """Points of the surface known from elsewhere.

    Attributes
    ----------
    points : (N, 3), world.
    sigma : (N,), of the place, world units.
    """

    points: Array
    sigma: Array


@dataclass(frozen=True)
class KnownSides:
    """What is known of the sides of a sharpened mesh with F faces.

    Attributes
    ----------
    is_shown : (F,) bool, faces of sides whose normal is known: edges between others are still
        round. Their outlines do not count, and smoothness holds them.
    is_fitted : (F,) bool, faces whose normal phases show. Those of others are no one side's, or
        what they mirror: they push a step's walls out by up to 1.3 mm (`step`).
    """

    is_shown: Mask
    is_fitted: Mask


@dataclass
class _Equations:
    """Normal equations of displacements that are being summed."""

    num: int
    gradient: Array = field(init=False)
    _vertices: list[Indices] = field(default_factory=list)
    _blocks: list[Array] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.gradient = np.zeros(self.num)

    def add(self, vertices: Indices, jacobian: Array, residual: Array, weight: Array) -> None:
        """Residuals ``(N,)`` that depend on three vertices ``(N, 3)`` each."""
        blocks = weight[:, None, None] * jacobian[:, :, None] * jacobian[:, None, :]
        self.add_blocks(vertices, blocks, (weight * residual)[:, None] * jacobian)

    def add_blocks(self, vertices: Indices, blocks: Array, gradient: Array) -> None:
        """Sums ``(N, 3, 3)`` and ``(N, 3)`` of such residuals."""
        self._vertices.append(vertices)
        self._blocks.append(blocks)
        self.gradient += np.bincount(vertices.ravel(), gradient.ravel(), self.num)

    def noise(self, rng: np.random.Generator) -> Array:
        """A random gradient ``(num,)`` with the matrix as its covariance."""
        total = np.zeros(self.num)
        for vertices, blocks in zip(self._vertices, self._blocks, strict=True):
            values, vectors = np.linalg.eigh(blocks)
            random = rng.standard_normal(values.shape) * np.sqrt(np.maximum(values, 0))
            drawn = (vectors @ random[:, :, None])[..., 0]
            total += np.bincount(vertices.ravel(), drawn.ravel(), self.num)
        return total

    def matrix(self) -> sparse.csr_array:
        """The sum, ``(num, num)``."""
        shape = (self.num, self.num)
        if not self._blocks:
            return sparse.csr_array(shape, dtype=np.float64)
        rows = [np.repeat(vertices, 3, axis=1).ravel() for vertices in self._vertices]
        cols = [np.tile(vertices, (1, 3)).ravel() for vertices in self._vertices]
        data = np.concatenate([blocks.ravel() for blocks in self._blocks])
        indices = (np.concatenate(rows), np.concatenate(cols))
        return sparse.coo_array((data, indices), shape=shape).tocsr()


@dataclass
class _SharedError:
    """One unknown error that many residuals share, solved for and left out of the equations.

    With residuals ``J x + r - f b`` of weights w and ``b`` of weight ``prior`` about ``expected``,
    the equations lose ``u uT`` and their right side ``u`` times :meth:`offset`, u being
    :meth:`column`.
    """

    num: int
    prior: float
    expected: float = 0.0
    slope: Array = field(init=False)
    _weight: float = 0.0
    _residual: float = 0.0

    def __post_init__(self) -> None:
        self.slope = np.zeros(self.num)
        self._residual = self.prior * self.expected

    def add(
        self,
        vertices: Indices,
        jacobian: Array,
        residual: Array,
        weight: Array,
        factor: Array | float = 1.0,
    ) -> None:
        """Residuals as in :meth:`_Equations.add`, with the factors f."""
        factor = np.broadcast_to(factor, residual.shape)
        weighted = ((weight * factor)[:, None] * jacobian).ravel()
        self.slope += np.bincount(vertices.ravel(), weighted, self.num)
        self._weight += float(weight @ factor**2)
        self._residual += float((weight * factor) @ residual)

    def column(self) -> Array:
        """The vector u ``(num,)`` of the class's text."""
        return np.asarray(self.slope / np.sqrt(self._weight + self.prior))

    def offset(self) -> float:
        """Factor of u on the right side."""
        return self._residual / float(np.sqrt(self._weight + self.prior))

    def solved(self, displacement: Array) -> float:
        """The error itself, given the solution ``(num,)``."""
        return (self._residual + float(self.slope @ displacement)) / (self._weight + self.prior)

    def deviation(self, response: Array) -> float:
        """Deviation of the error itself once all is solved.

        ``response`` (num,) is the solution, without the error, for ``slope`` as right side.
        """
        left = self._weight + self.prior - float(self.slope @ response)
        return float(1 / np.sqrt(max(left, self.prior)))


@dataclass(frozen=True)
class RowSigma:
    """Deviation of ``m . n`` that noise does not explain.

    Attributes
    ----------
    direct : of light from elsewhere.
    mirrored : of light that comes from the object itself and is polarised already, where the view's
        mirror ray meets it.
    """

    direct: float
    mirrored: float

    @classmethod
    def shown_by(cls, residuals: Array, is_mirrored: Mask, least: float) -> RowSigma:
        """What residuals ``(K,)`` show of it, at ``least`` a value."""
        found = (robust_deviation(residuals[kind]) for kind in (~is_mirrored, is_mirrored))
        return cls(*(max(least, np.nan_to_num(sigma)) for sigma in found))


@dataclass(frozen=True)
class FaceRows:
    """Phase rows of a view at the faces of a mesh that it sees.

    Attributes
    ----------
    face : (K,) indices.
    residual : (K,) ``m . n``.
    variance : (K,) of the residual.
    rows : (K, 3) unit, world.
    cosine : (K,) between normal and direction to the camera.
    tilt : (K,) by how much the residual would change, were the polarizers' tilt taken back.
    is_mirrored : (K,) bool, whether the mirror ray of the view meets the mesh.
    """

    face: Indices
    residual: Array
    variance: Array
    rows: Array
    cosine: Array
    tilt: Array
    is_mirrored: Mask

    def only(self, kept: Mask) -> FaceRows:
        """The ``kept`` (K,) of them."""
        names = [own.name for own in fields(self)]
        return FaceRows(**{name: getattr(self, name)[kept] for name in names})


def face_rows(
    mesh: TriangleMesh,
    scene: RayScene,
    view: SurfaceView,
    angle_model: AngleModel,
    row_sigma: RowSigma,
    tolerances: RefinementTolerances,
) -> FaceRows:
    """Rows of one view at the faces that it sees."""
    face, rays, cosine = visible_points(
        scene,
        view.center,
        mesh.centers,
        mesh.face_normals,
        min_cosine=tolerances.min_cosine,
    )
    found = phase_rows(view, angle_model, mesh.centers.take(face, axis=0))
    known = np.flatnonzero(found.precision > 0)
    face, cosine, rows = face[known], cosine[known], found.rows.take(known, axis=0)
    turn, precision = found.turn[known], found.precision[known]
    rays, normals = rays.take(known, axis=0), mesh.face_normals.take(face, axis=0)
    residual = dots(rows, normals)
    mirrored = rays + 2 * cosine[:, None] * normals
    start = mesh.centers.take(face, axis=0) + mesh.mean_edge * normals
    is_mirrored = np.isfinite(scene.cast(start, mirrored).distance)
    unexplained = np.where(is_mirrored, row_sigma.mirrored, row_sigma.direct)
    variance = (1 - cosine**2) * turn**2 / precision + unexplained**2
    # A greater phase turns the row against the sense of the ray.
    tilt = -found.tilt[known] * dots(np.cross(rays, rows), normals)
    return FaceRows(face, residual, variance, rows, cosine, tilt, is_mirrored)


@dataclass(frozen=True)
class Refined:
    """A refined surface.

    Attributes
    ----------
    mesh : closed.
    tilt_share : of the turn by tilted polarizers, as the phases of all views show it: about 0
        where the sensor obeys the angle model, 1 where each polarizer lies in the image plane.
    """

    mesh: TriangleMesh
    tilt_share: float


def refine(
    mesh: TriangleMesh,
    views: Sequence[SurfaceView],
    angle_model: AngleModel,
    footprint: float,
    *,
    known: KnownPoints | None = None,
    tolerances: RefinementTolerances | None = None,
    on_progress: OnProgress = no_progress,
    go_on: Callable[[TriangleMesh], bool] | None = None,
) -> Refined:
    """Move a closed mesh until the views' phases and silhouettes agree with it.

    What OPA and PPA leave out, the tilt of the polarizers, errs alike in all rows, so that no
    number of them averages it out; whether the lens makes it no model can know. Its share is one
    more unknown.

    Parameters
    ----------
    mesh : first surface, closed.
    views : what each view says.
    angle_model : OPA or PPA; PPA for samples corrected for tilted polarizers.
    footprint : length that a pixel covers at the surface, world units.
    known : points of the surface.
    tolerances : numbers of the energy, with the levels to do.
    on_progress : called with the number of steps done.
    go_on : asked with the mesh after each level, whether to refine it further.
    """
    tol = tolerances or RefinementTolerances()
    given = _Given(views, angle_model, footprint, known, tol)
    state, with_slope = _State(mesh, 0.0, RowSigma(tol.row_sigma, tol.row_sigma)), True
    for number, level in enumerate(tol.levels):
        edge = level.edge_px * footprint
        expected = 1.2 * state.mesh.face_areas.sum() / edge**2
        if number and expected > tol.max_vertices:
            edge = float(np.sqrt(1.2 * state.mesh.face_areas.sum() / tol.max_vertices))
        with_slope &= level.with_slope
        ways = [replace(level, with_slope=False), level][: 1 + with_slope]
        if number and number == len(tol.levels) - 1:  # the way of the level before
            ways = ways[-1:]
        found = [_refined_at(state, given, edge, way, on_progress) for way in ways]
        if len(found) > 1:
            shares = [
                unexplained_shares(one.mesh, views, angle_model, tol.row_sigma) for one in found
            ]
            with_slope = _is_less(shares[1], shares[0])
        state = found[-1] if with_slope else found[0]
        if not len(state.mesh.faces):
            break
        if go_on is not None and not go_on(state.mesh):
            break
    return Refined(state.mesh, state.tilt_share)


def _is_less(values: Array, others: Array) -> bool:
    """Whether values of K views are less than others in the mean, by more than its standard error.

    The rule of one standard error (Breiman et al. 1984): the others are the simpler way's.
    """
    gain = (others - values)[np.isfinite(others - values)]
    if len(gain) < 2:
        return bool(gain.sum() > 0)
    error = float(gain.std(ddof=1)) / np.sqrt(len(gain))
    logger.info(
        "with the slope of the phases %.4f +- %.4f less is unexplained.", gain.mean(), error
    )
    return bool(gain.mean() > error)


@dataclass(frozen=True)
class _Given:
    """What a mesh is refined by, as in :func:`refine`."""

    views: Sequence[SurfaceView]
    angle_model: AngleModel
    footprint: float
    known: KnownPoints | None
    tol: RefinementTolerances


@dataclass(frozen=True)
class _State:
    """What one level of refinement hands on to the next."""

    mesh: TriangleMesh
    tilt_share: float
    row_sigma: RowSigma


def _refined_at(
    state: _State,
    given: _Given,
    edge: float,
    level: Level,
    on_progress: OnProgress,
) -> _State:
    """The surface after one level, with edges of the given length."""
    mesh, tilt_share, shown, tol = state.mesh, state.tilt_share, state.row_sigma, given.tol
    moved = np.zeros(len(mesh.vertices))
    for step in range(level.num_steps):
        # A mesh that has moved far is uneven and may intersect itself; one that has not is
        # left alone, for the grid rounds its creases.
        if step == 0 or np.quantile(np.abs(moved), 0.98) > tol.remesh_after * edge:
            mesh = remeshed(mesh, edge)
            moved = np.zeros(len(mesh.vertices))
        if not len(mesh.faces):
            return _State(mesh, tilt_share, state.row_sigma)
        turned = [replace(view, tilt_share=tilt_share) for view in given.views]
        energy = _energy(mesh, replace(given, views=turned), edge, level, state.row_sigma)
        mesh, displacement = _step(mesh, energy, edge, tol)
        tilt_share += energy.views.tilt.solved(displacement)
        tilt_share = float(np.clip(tilt_share, 0, 1))
        shown = energy.views.row_sigma
        moved = moved + displacement
        free = displacement[energy.free]
        change = float(np.sqrt(np.mean(free**2))) if len(free) else 0.0
        logger.info(
            "edges of %.1f px, %d vertices: moved by %.3f px; %.2f of the polarizers' tilt.",
            edge / given.footprint,
            len(mesh.vertices),
            change / given.footprint,
            tilt_share,
        )
        on_progress(1)
        if change < tol.converged * edge and step > 1:
            on_progress(level.num_steps - step - 1)
            break
    # A model that leaves something out (OPA the perspective) errs by more than its phases' noise;
    # held against that, most of its rows were outliers. Every model is treated alike.
    return _State(mesh, tilt_share, shown)


def settling_step(
    mesh: TriangleMesh,
    views: Sequence[SurfaceView],
    angle_model: AngleModel,
    footprint: float,
    row_sigma: RowSigma,
    *,
    sides: KnownSides,
    known: KnownPoints | None = None,
    tolerances: RefinementTolerances | None = None,
) -> tuple[TriangleMesh, bool]:
    """A mesh with sharp edges, one step nearer to where outlines, points and phases have it.

    Parameters
    ----------
    mesh : sharpened; its triangles stay.
    views, angle_model, footprint, known, tolerances : as in :func:`refine`.
    row_sigma : deviations of the rows, as :func:`median_residual` finds them.
    sides : what is known of its faces.

    Returns
    -------
    The mesh, and whether it was at rest.
    """
    tol = tolerances or RefinementTolerances()
    level = replace(tol.levels[-1], with_slope=False, on_outline=True)
    edge = mesh.mean_edge
    given = _Given(views, angle_model, footprint, known, tol)
    energy = _energy(mesh, given, edge, level, row_sigma, sides)
    moved, displacement = _step(mesh, energy, edge, tol)
    free = np.abs(displacement[energy.free & ~energy.sharp])
    return moved, not len(free) or float(np.median(free)) < tol.converged * edge


def certain_rays(view: SurfaceView, stride_px: int) -> Array:
    """Unit rays ``(N, 3)``, world, of every so many-th pixel of a view's certain silhouette."""
    half = stride_px // 2
    rows, cols = np.nonzero(view.silhouette.certain[half::stride_px, half::stride_px])
    xy = np.stack([cols, rows], axis=1) * stride_px + half + 0.5
    return view.view.rays_in_world(xy)


def unexplained_shares(
    mesh: TriangleMesh,
    views: Sequence[SurfaceView],
    angle_model: AngleModel,
    row_sigma: float = RefinementTolerances.row_sigma,
    *,
    stride_px: int = 4,
) -> Array:
    """How little a mesh explains of each view: mean ``(K,)`` over its certain silhouette's pixels.

    1 where it shows nothing, or a normal that the phase contradicts by far more than ``row_sigma``
    (of ``m . n``); 0 where both agree.
    """
    scene, shares = RayScene(mesh), np.full(len(views), np.nan)
    for index, view in enumerate(views):
        rays = certain_rays(view, stride_px)
        hits = scene.cast(view.center, rays)
        hit = hits.face >= 0
        points = points_on_rays(view.center, rays[hit], hits.distance[hit])
        found = phase_rows(view, angle_model, points)
        square = (dots(found.rows, mesh.face_normals[hits.face[hit]]) / row_sigma) ** 2
        loss = np.ones(len(rays))
        known = found.precision > 0
        loss[np.flatnonzero(hit)[known]] = (square / (square + CAUCHY_SCALE**2))[known]
        kept = ~hit
        kept[np.flatnonzero(hit)[known]] = True  # a pixel without a phase says nothing of the mesh
        if kept.any():
            shares[index] = loss[kept].mean()
    return shares


@dataclass(frozen=True)
class _Evidence:
    """What some views say of the displacements of one mesh.

    Attributes
    ----------
    equations : of their phases and outlines.
    outline_slope : (V,), change of the gradient by an error of all silhouettes, per px.
    tilt : share of the polarizers' tilt that is still to be taken back.
    is_seen : (F,) bool, faces that some view sees.
    row_sigma : what the phase rows' residuals show of it.
    """

    equations: _Equations
    outline_slope: Array
    tilt: _SharedError
    is_seen: Mask
    row_sigma: RowSigma


@dataclass(frozen=True)
class _Energy:
    """The energy about one mesh, as the parts of its normal equations.

    Attributes
    ----------
    views : what all of them say.
    of_views : the same of some of them, by their indices.
    points : equations of the known points.
    smooth, pull : matrix ``(V, V)`` and gradient ``(V,)`` of the smoothness, and the matrix
        ``(V, V)`` whose product with its own transpose is the former.
    free : (V,) bool, vertices of faces that some view sees.
    sharp : (V,) bool, vertices on edges between sides.
    """

    views: _Evidence
    of_views: Callable[[Sequence[int]], _Evidence]
    points: _Equations
    smooth: sparse.csr_array
    pull: Array
    smooth_factor: sparse.csr_array
    free: Mask
    sharp: Mask

    def matrix(self) -> sparse.csr_array:
        """Of all parts ``(V, V)``, without damping."""
        sums = self.views.equations.matrix() + self.points.matrix() + self.smooth
        return sparse.csr_array(sums)

    def gradient(self) -> Array:
        """Of all parts ``(V,)``."""
        tilt = self.views.tilt
        sums = self.views.equations.gradient + self.points.gradient + self.pull
        return np.asarray(sums - tilt.offset() * tilt.column())


def _energy(
    mesh: TriangleMesh,
    given: _Given,
    edge: float,
    level: Level,
    row_sigma: RowSigma,
    sides: KnownSides | None = None,
) -> _Energy:
    views, known, tol = given.views, given.known, given.tol
    scene, edges = RayScene(mesh), shared_edges(mesh)
    sharp = np.zeros(len(mesh.vertices), np.bool_)
    asked = np.ones(len(mesh.faces), np.bool_)
    if sides is not None:
        edges = edges.only(np.all(sides.is_shown[edges.faces], axis=1))
        sharp = crease_vertices(mesh, sides.is_shown)
        # Edges go where their sides meet: the faces there say nothing of the sides beside them.
        asked = sides.is_fitted & ~np.any(sharp[mesh.faces], axis=1)

    def look_at(view: SurfaceView) -> tuple[_RimRows | None, FaceRows]:
        rim = None
        if view.has_outline:
            rim = _rim_rows(mesh, scene, view, edges, level, sharp)
        rows = face_rows(mesh, scene, view, given.angle_model, row_sigma, tol)
        return rim, rows if asked.all() else rows.only(asked[rows.face])

    # Threads, for products of large arrays and the casting of rays let go of Python's lock.
    with ThreadPoolExecutor(default_num_workers()) as pool:
        found = list(pool.map(look_at, views))
    rims, rows = [rim for rim, _ in found], [row for _, row in found]
    residuals = [np.zeros(0), *(rim.residual for rim in rims if rim is not None)]
    rim_sigma = _rim_sigma(np.concatenate(residuals), tol)
    agreed = _agreed_weights(rows, views, mesh.centers, 0.5 * edge / given.footprint, tol)
    with_slope = level.with_slope or not any(rims)

    def of_views(chosen: Sequence[int]) -> _Evidence:
        equations = _Equations(len(mesh.vertices))
        # Anything between a sensor of the angle model and a tilted polarizer may be, as little
        # known as what else the rows share.
        taken_back = views[0].tilt_share if views else 0.0
        tilt = _SharedError(len(mesh.vertices), prior=tol.phase_correlation, expected=-taken_back)
        seen_by = [(views[index], rows[index], agreed[index]) for index in chosen]
        is_seen, shown = _add_phases(
            equations, tilt, mesh, seen_by, given, level.loss_scale, with_slope=with_slope
        )
        own = [rim for rim in (rims[index] for index in chosen) if rim is not None]
        outline_slope = _add_rims(equations, own, rim_sigma, level, tol)
        return _Evidence(equations, outline_slope, tilt, is_seen, shown)

    everything = of_views(range(len(views)))
    points = _Equations(len(mesh.vertices))
    if known is not None and len(known.points) and everything.is_seen.any():
        _add_points(points, mesh, everything.is_seen, known, given, level.rim_gate_px)
    smooth, pull, factor = _smoothness(mesh, edge, tol, sharp)
    free = np.zeros(len(mesh.vertices), np.bool_)
    free[mesh.faces[everything.is_seen]] = True
    return _Energy(everything, of_views, points, smooth, pull, factor, free, sharp)


def _step(
    mesh: TriangleMesh, energy: _Energy, edge: float, tol: RefinementTolerances
) -> tuple[TriangleMesh, Array]:
    """One Gauss-Newton step: the new mesh and the displacements ``(V,)``."""
    damping = np.where(energy.free, tol.damping, tol.unseen_damping) * edge
    shared = energy.views.tilt.column()
    displacement = -solve(energy.matrix(), energy.gradient(), 1 / damping**2, shared)
    displacement = np.clip(np.nan_to_num(displacement), -edge, edge)
    moves = displacement[:, None] * mesh.vertex_normals
    return mesh.moved(_with_edges(mesh, moves, energy.sharp)), displacement


def place_deviations(
    mesh: TriangleMesh,
    views: Sequence[SurfaceView],
    angle_model: AngleModel,
    footprint: float,
    *,
    known: KnownPoints | None = None,
    tolerances: RefinementTolerances | None = None,
    max_groups: int = 24,
    num_samples: int = 12,
    seed: int = 0,
) -> Array:
    """Standard deviation ``(V,)`` of the place along the normal of each vertex of a refined mesh.

    What the views contribute is taken from the views: the jackknife (Tukey 1958), how far the
    surface moves when one of them, or one of some groups of them, is left out. Whatever a view's
    phases and outline have in common (light, pose, blur) is in it, without a guess of what. What
    all views share is not: the share of the polarizers' tilt and the bias of the outlines are
    added, and samples of the errors of points and smoothness, and of the views' stated noise, below
    which few views agree by chance. Large where only smoothness carries a vertex.

    Parameters
    ----------
    mesh, views, angle_model, footprint, known : as in :func:`refine`.
    max_groups : of views, to leave out.
    num_samples : the deviation of a deviation is one over the root of twice as many.
    seed : of the random numbers.
    """
    tol = tolerances or RefinementTolerances()
    num, rng = len(mesh.vertices), np.random.default_rng(seed)
    if not num:
        return np.zeros(0)
    edge, row_sigma = mesh.mean_edge, RowSigma(tol.row_sigma, tol.row_sigma)

    given = _Given(views, angle_model, footprint, known, tol)
    energy = _energy(mesh, given, edge, tol.levels[-1], row_sigma)
    for _ in range(SETTLING_STEPS):
        mesh, _ = _step(mesh, energy, edge, tol)
        energy = _energy(mesh, given, edge, tol.levels[-1], row_sigma)
    matrix = energy.matrix()
    # Nothing but the energy holds the surface here; what no view sees is not asked for.
    loose = 1 / (np.where(energy.free, 100.0, tol.unseen_damping) * edge) ** 2
    none = np.zeros(num)
    rest = -solve(matrix, energy.gradient(), loose, none)
    by_tilt = solve(matrix, energy.views.tilt.slope, loose, none)
    # What rows share is as uncertain as their own errors would be, were they not weighted down.
    by_tilt *= energy.views.tilt.deviation(by_tilt) * np.sqrt(tol.phase_correlation)
    by_outlines = solve(matrix, energy.views.outline_slope, loose, none) * tol.outline_bias_px
    variance = by_tilt**2 + by_outlines**2
    for _ in range(num_samples):
        noise = energy.views.equations.noise(rng) + energy.smooth_factor @ rng.standard_normal(num)
        noise += np.sqrt(tol.point_weight(len(views))) * energy.points.noise(rng)
        variance += solve(matrix, noise, loose, none) ** 2 / num_samples
    num_groups = min(len(views), max_groups)
    for first in range(num_groups):
        # Neighbours by name are likely to see the same: each goes to a group of its own.
        left_out = energy.of_views(range(first, len(views), num_groups)).equations
        own = left_out.matrix()
        change = solve(sparse.csr_array(matrix - own), left_out.gradient + own @ rest, loose, none)
        variance += (num_groups - 1) / num_groups * change**2
    return np.where(energy.free, np.sqrt(variance), np.inf)


def median_residual(
    mesh: TriangleMesh,
    views: Sequence[SurfaceView],
    angle_model: AngleModel,
    tolerances: RefinementTolerances | None = None,
) -> tuple[RowSigma, float]:
    """What the phases show of the angle model's own error on a refined mesh.

    Returns
    -------
    row_sigma : robust deviations of ``m . n``, at least that of the tolerances.
    median : of the absolute residuals; 0 without any.
    """
    tol = tolerances or RefinementTolerances()
    scene, equal = RayScene(mesh), RowSigma(tol.row_sigma, tol.row_sigma)
    rows = [face_rows(mesh, scene, view, angle_model, equal, tol) for view in views]
    residuals = np.concatenate([np.zeros(0), *(row.residual for row in rows)])
    is_mirrored = np.concatenate([np.zeros(0, np.bool_), *(row.is_mirrored for row in rows)])
    if not len(residuals):
        return equal, 0.0
    return RowSigma.shown_by(residuals, is_mirrored, tol.row_sigma), float(
        np.median(np.abs(residuals))
    )


def solve(matrix: sparse.csr_array, right: Array, damping: Array, shared: Array) -> Array:
    """Solution of ``(matrix + diag(damping) - s sT) x = right`` by conjugate gradients.

    s is ``shared`` (V,), see :class:`_SharedError`.

    Conditions are good: the damping bounds the smallest eigenvalue, and low frequencies were
    solved on coarser meshes.
    """
    num = len(right)
    damped = sparse.csr_array(matrix + sparse.diags_array(damping))
    inverse = 1 / damped.diagonal()
    precondition = LinearOperator((num, num), matvec=lambda x: inverse * x.ravel())
    reduced = LinearOperator(
        (num, num), matvec=lambda x: damped @ x.ravel() - (shared @ x.ravel()) * shared
    )
    return np.asarray(cg(reduced, right, rtol=1e-3, maxiter=300, M=precondition)[0])


def normal_changes(mesh: TriangleMesh) -> Array:
    """Change of a face's normal, ``(F, 3, 3)``, by the displacement of each vertex along its own.

    The part along the normal is not taken out: residuals do that.
    """
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    opposite = np.stack([c - b, a - c, b - a], axis=1)
    crossed = np.cross(opposite, mesh.vertex_normals.take(mesh.faces, axis=0))
    return np.asarray(crossed / np.maximum(2 * mesh.face_areas, 1e-300)[:, None, None])


def _add_phases(
    equations: _Equations,
    tilt: _SharedError,
    mesh: TriangleMesh,
    seen_by: Sequence[tuple[SurfaceView, FaceRows, Array]],
    given: _Given,
    loss_scale: float,
    *,
    with_slope: bool,
) -> tuple[Mask, RowSigma]:
    """Add the rows of some views, with the weights that they keep (:func:`_agreed_weights`).

    How a row changes as the place moves through the phase image (``with_slope``) places a surface
    that no outline bounds: all of one without outlines, hollows, waves. Measured: the floor of a
    dish without sparse points is 8 mm too high without it on the first level, and right with it;
    waves 7 mm high and 60 mm long lie 0.48 mm off without it on later levels, 0.25 mm with it. It
    hardly sees the scale of round objects and the walls of parts: the Chamfer distances of a blob
    and of a bracket would grow by 0.03 mm.

    Returns
    -------
    is_seen : (F,) faces that some view sees.
    row_sigma : what the rows' residuals show of it.
    """
    num_faces, footprint = len(mesh.faces), given.footprint
    blocks, gradient = np.zeros((num_faces, 3, 3)), np.zeros((num_faces, 3))
    is_seen = np.zeros(num_faces, np.bool_)
    change = normal_changes(mesh)
    along = dots(mesh.vertex_normals.take(mesh.faces, axis=0), mesh.face_normals[:, None]) / 3
    share = np.minimum(mesh.face_areas / (given.tol.independent_px * footprint**2), 1.0)
    reach = min(0.5 * mesh.mean_edge, 1.5 * footprint)
    steepest = 0.5 / footprint
    residuals, mirrored = [np.zeros(0)], [np.zeros(0, np.bool_)]
    for view, seen, agreed in seen_by:
        face = seen.face
        is_seen[face] = True
        if not len(face):
            continue
        normals, residual = mesh.face_normals.take(face, axis=0), seen.residual
        across = seen.rows - residual[:, None] * normals
        jacobian = np.einsum("nij,nj->ni", change.take(face, axis=0), across)
        if with_slope:
            centers = mesh.centers.take(face, axis=0)
            slope = _row_slope(view, given.angle_model, centers, normals, seen.rows, reach)
            jacobian += along[face] * np.clip(slope, -steepest, steepest)[:, None]
        weight = np.maximum(geman_mcclure_weights(residual, loss_scale**2 * seen.variance), agreed)
        weight *= share[face] / seen.variance
        blocks[face] += np.einsum("ni,nj->nij", weight[:, None] * jacobian, jacobian)
        gradient[face] += (weight * residual)[:, None] * jacobian
        tilt.add(mesh.faces[face], jacobian, residual, weight, -seen.tilt)
        residuals.append(residual)
        mirrored.append(seen.is_mirrored)
    equations.add_blocks(mesh.faces, blocks, gradient)
    everything, is_mirrored = np.concatenate(residuals), np.concatenate(mirrored)
    return is_seen, RowSigma.shown_by(everything, is_mirrored, given.tol.row_sigma)


def _agreed_weights(
    seen: Sequence[FaceRows],
    views: Sequence[SurfaceView],
    centers: Array,
    reach_px: float,
    tol: RefinementTolerances,
) -> list[Array]:
    """Weights that rows keep however far off the mesh is: where views agree on another normal.

    A shoulder between a wall and a floor that the first surface bridges is contradicted by all
    views alike. Under a loss about the mesh's own normal their rows were outliers, and it stayed.
    Its normal is that of the rows themselves, by a loss that narrows; those that agree with it pull
    the mesh as strongly as if it were off by the loss's width and no more.

    Rows of places that mirror the object are not asked: views may agree on what they mirror. Nor
    are those of faces that an outline crosses, within ``reach_px`` of their centres, half the
    length of an edge: the pixel may show what is not the face. All views showed the top of a thin
    sheet on its narrow sides, so that it grew until the outlines drew it down.
    """
    scale, num_faces = tol.levels[-1].loss_scale, len(centers)
    weights = [geman_mcclure_weights(rows.residual, scale**2 * rows.variance) for rows in seen]
    doubted = np.zeros(num_faces, np.bool_)
    for rows, weight in zip(seen, weights, strict=True):
        doubted[rows.face[weight < tol.agreement]] = True
    own, count, chosen = np.zeros(num_faces), np.zeros(num_faces), []
    for rows, view, weight in zip(seen, views, weights, strict=True):
        some = np.flatnonzero(doubted[rows.face] & ~rows.is_mirrored)
        some = some[~_near_outline(view, centers[rows.face[some]], reach_px)]
        own[rows.face[some]] += weight[some]  # no face twice
        count[rows.face[some]] += 1
        chosen.append(some)
    asked = (count > MIN_VIEWS) & (own < tol.agreement * count)
    kept = [np.zeros(len(rows.face)) for rows in seen]
    if not asked.any():
        return kept
    chosen = [some[asked[rows.face[some]]] for rows, some in zip(seen, chosen, strict=True)]
    pairs = list(zip(seen, chosen, strict=True))
    place = (np.cumsum(asked) - 1)[np.concatenate([rows.face[some] for rows, some in pairs])]
    variance = np.concatenate([rows.variance[some] for rows, some in pairs])
    residual = np.concatenate([rows.residual[some] for rows, some in pairs])
    all_rows = np.concatenate([rows.rows[some] for rows, some in pairs])
    weight, agree = _agreement(place, all_rows, variance, int(asked.sum()), scale)
    weight[agree[place] < tol.agreement] = 0
    weight *= np.minimum(scale * np.sqrt(variance) / np.maximum(np.abs(residual), 1e-300), 1)
    ends = np.cumsum([len(some) for some in chosen])[:-1]
    for values, some, found in zip(kept, chosen, np.split(weight, ends), strict=True):
        values[some] = found
    return kept


def _near_outline(view: SurfaceView, points: Array, reach_px: float) -> Mask:
    """Which points ``(N,)`` a view shows within a distance of its silhouette's outlines."""
    if not view.has_outline or not len(points):
        return np.zeros(len(points), np.bool_)
    distance, _ = rim_residuals(view, view.project(points)[0])
    return np.asarray(np.abs(distance) < reach_px)


def _agreement(
    place: Indices, rows: Array, variance: Array, num: int, scale: float
) -> tuple[Array, Array]:
    """Weights ``(N,)`` of rows about the normal of their own, and their means ``(num,)``.

    The mean is 0 where rows do not tell the normal from what is across it.
    """
    x, y, z = rows.T
    products = np.array([x * x, y * y, z * z, x * y, x * z, y * z]) / variance
    weight: Array = np.ones(len(rows))
    for width in annealed_scales(5, last=scale):
        sums = np.array([np.bincount(place, weight * product, num) for product in products])
        total = np.maximum(np.bincount(place, weight, num), 1e-300)
        values, normals = smallest_eigenvectors(sums)
        residual = np.einsum("ni,in->n", rows, normals[:, place])
        weight = geman_mcclure_weights(residual, width**2 * variance)
    agree = np.bincount(place, weight, num) / np.bincount(place, minlength=num)
    return weight, np.where(values[1] > scale**2 * total, agree, 0)


def _row_slope(
    view: SurfaceView,
    angle_model: AngleModel,
    points: Array,
    normals: Array,
    rows: Array,
    reach: float,
) -> Array:
    """Change of ``m . n`` per length as points move along their normals, the normals held."""
    sides = []
    for sign in (1, -1):
        found = phase_rows(view, angle_model, points + sign * reach * normals)
        same = np.where(dots(found.rows, rows) < 0, -1.0, 1.0)
        value = same * dots(found.rows, normals)
        sides.append(np.where(found.precision > 0, value, np.nan))
    return np.nan_to_num((sides[0] - sides[1]) / (2 * reach))


@dataclass(frozen=True)
class SharedEdges:
    """Edges of a mesh with the two faces that share each.

    Attributes
    ----------
    ends : (E, 2) vertices.
    faces : (E, 2)
    """

    ends: Indices
    faces: Indices

    def only(self, kept: Mask) -> SharedEdges:
        """The ``kept`` (E,) of them."""
        return SharedEdges(self.ends[kept], self.faces[kept])


def shared_edges(mesh: TriangleMesh) -> SharedEdges:
    """All edges that two faces share."""
    num = len(mesh.faces)
    ends = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    face = np.repeat(np.arange(num), 3)
    key = ends[:, 0] * np.int64(len(mesh.vertices)) + ends[:, 1]
    order = np.argsort(key, kind="stable")
    paired = np.flatnonzero(key[order][1:] == key[order][:-1])
    first, second = order[paired], order[paired + 1]
    return SharedEdges(ends[first], np.stack([face[first], face[second]], axis=1))


@dataclass(frozen=True)
class Rim:
    """Points of a mesh on its outline against the background of one view.

    Attributes
    ----------
    ends : (K, 2) vertices; the points lie in the middle between them.
    faces : (K, 2) that share these edges.
    xy : (K, 2) image coordinates of the points, or of the mesh's outline beside them.
    length_px : (K,) of the outline that each stands for.
    """

    ends: Indices
    faces: Indices
    xy: Array
    length_px: Array


def find_rim(
    mesh: TriangleMesh,
    scene: RayScene,
    view: SurfaceView,
    edges: SharedEdges,
    *,
    on_outline: bool = False,
) -> Rim:
    """The outline of a mesh in a view: edges between faces to and fro with nothing behind them.

    With ``on_outline`` each point is moved outwards to where rays begin to pass the mesh.
    """
    towards = view.center - mesh.centers
    front = dots(towards, mesh.face_normals) > 0
    turning = front[edges.faces[:, 0]] != front[edges.faces[:, 1]]
    ends, faces = edges.ends[turning], edges.faces[turning]
    middle = 0.5 * (mesh.vertices[ends[:, 0]] + mesh.vertices[ends[:, 1]])
    xy, z = view.project(middle)
    start, _ = view.project(mesh.vertices[ends[:, 0]])
    stop, _ = view.project(mesh.vertices[ends[:, 1]])
    length = lengths(stop - start)
    pixel = np.abs(z) / view.view.camera.mean_focal_px
    kept = view.in_image(xy, 3.0) & (z > 0) & np.isfinite(length)
    ends, faces = ends[kept], faces[kept]
    middle, xy, length, pixel = (a[kept] for a in (middle, xy, length, pixel))
    outwards = mesh.vertex_normals[ends].sum(axis=1)
    away = middle - view.center
    distance = lengths(away)[:, None]
    outwards = unit_or_zero(outwards - dots(outwards, away)[:, None] / distance**2 * away)
    # A pixel beyond the outline there is nothing, a pixel before it the surface itself.
    beyond = scene.cast(view.center, away + 1.0 * pixel[:, None] * outwards).distance
    before = scene.cast(view.center, away - 1.0 * pixel[:, None] * outwards).distance
    slack = 4 * mesh.mean_edge / distance[:, 0]
    rim = ~np.isfinite(beyond) & (np.abs(before - 1) < slack)
    if not on_outline:
        return Rim(ends[rim], faces[rim], xy[rim], length[rim])
    away, step = away[rim], (pixel[:, None] * outwards)[rim]
    low, high = np.zeros(len(away)), np.ones(len(away))
    for _ in range(RIM_HALVINGS):
        middle = 0.5 * (low + high)
        met = np.isfinite(scene.cast(view.center, away + middle[:, None] * step).distance)
        low, high = np.where(met, middle, low), np.where(met, high, middle)
    xy, _ = view.project(view.center + away + (0.5 * (low + high))[:, None] * step)
    return Rim(ends[rim], faces[rim], xy, length[rim])


def rim_residuals(view: SurfaceView, xy: Array) -> tuple[Array, Array]:
    """Signed distance ``(K,)`` of points to the silhouette, px, and its gradient ``(K, 2)``.

    Where the silhouette is in doubt the nearer of its two outlines counts.
    """
    inner = sample_image(view.silhouette.inner, xy).astype(np.float64)
    if view.silhouette.is_sharp:
        return inner[:, 0], inner[:, 1:]
    outer = sample_image(view.silhouette.outer, xy).astype(np.float64)
    chosen = np.where((np.abs(outer[:, 0]) < np.abs(inner[:, 0]))[:, None], outer, inner)
    return chosen[:, 0], chosen[:, 1:]


@dataclass(frozen=True)
class _RimRows:
    """Residuals (K,) of a view's outline, px, with their vertices (K, 3) and lengths (K,)."""

    vertices: Indices
    jacobian: Array
    residual: Array
    length_px: Array


def _rim_rows(
    mesh: TriangleMesh,
    scene: RayScene,
    view: SurfaceView,
    edges: SharedEdges,
    level: Level,
    sharp: Mask,
) -> _RimRows:
    rim = find_rim(mesh, scene, view, edges, on_outline=level.on_outline)
    residual, gradient = rim_residuals(view, rim.xy)
    near = np.abs(residual) < level.rim_gate_px
    ends, residual, gradient = rim.ends[near], residual[near], gradient[near]
    vertices, directions = _rim_moves(mesh, ends, rim.faces[near], sharp)
    jacobian = np.zeros((len(ends), 3))
    middle = mesh.vertices[ends].mean(axis=1)
    reach = 1e-3 * mesh.mean_edge
    for column in (0, 1):
        ahead, _ = view.project(middle + reach * directions[:, column])
        behind, _ = view.project(middle - reach * directions[:, column])
        jacobian[:, column] = dots(gradient, ahead - behind) / (2 * reach)
    vertices = np.column_stack([vertices, vertices[:, 0]])
    return _RimRows(vertices, np.nan_to_num(jacobian), residual, rim.length_px[near])


def _rim_moves(
    mesh: TriangleMesh, ends: Indices, faces: Indices, sharp: Mask
) -> tuple[Indices, Array]:
    """How the middles of edges move with two vertices each ``(K, 2)``: directions ``(K, 2, 3)``.

    Both ends move the middle by half of their own displacements. An edge between two sides of the
    object is where these meet: it moves with them, each along what leaves the other in its plane.
    """
    directions = 0.5 * mesh.vertex_normals[ends]
    one, other = np.moveaxis(mesh.face_normals[faces], 1, 0)
    cosine = dots(one, other)
    # Of a fold, too, whose sides turn their backs on each other, the middle is its own.
    apart = np.abs(cosine) < np.cos(np.radians(CreaseTolerances.crease_deg))
    meets = np.all(sharp[ends], axis=1) & apart
    opposite = mesh.faces[faces].sum(axis=2) - ends.sum(axis=1, keepdims=True)
    dual = np.stack([one - cosine[:, None] * other, other - cosine[:, None] * one], axis=1)
    dual /= np.maximum(1 - cosine**2, 1e-9)[:, None, None]
    # A side of one row of triangles has no vertex but those of its edges.
    along = dots(mesh.vertex_normals[opposite], mesh.face_normals[faces]) * ~sharp[opposite]
    directions[meets] = (dual * along[..., None])[meets]
    return np.where(meets[:, None], opposite, ends), directions


def _with_edges(mesh: TriangleMesh, moves: Array, sharp: Mask) -> Array:
    """Moves ``(V, 3)`` of vertices, those of ``sharp`` ones (V,) such that their sides meet there.

    A side moves as those of its vertices do that lie on no edge.
    """
    if not sharp.any():
        return moves
    free = ~sharp[mesh.faces]
    touching = np.flatnonzero(~free.all(axis=1) & free.any(axis=1))
    corners, free, normals = mesh.faces[touching], free[touching], mesh.face_normals[touching]
    along = dots(moves[corners], normals[:, None]) * free
    height = along.sum(axis=1) / free.sum(axis=1)
    area = mesh.face_areas[touching]
    squares = (area[:, None, None] * normals[:, :, None] * normals[:, None, :]).reshape(-1, 9)
    incidence = mesh.incidence[touching].T
    matrix = (incidence @ squares).reshape(-1, 3, 3)
    right = incidence @ ((area * height)[:, None] * normals)
    total = np.maximum(np.trace(matrix, axis1=1, axis2=2), 1e-300)
    # Along an edge, where only noise turns the normals, nothing moves.
    matrix += EDGE_NOISE**2 * total[:, None, None] * np.eye(3)
    moved = moves.copy()
    moved[sharp] = np.linalg.solve(matrix[sharp], right[sharp][..., None])[..., 0]
    return moved


def _rim_sigma(residuals: Array, tol: RefinementTolerances) -> float:
    """Deviation of the outlines that the residuals ``(K,)`` of all views show, px."""
    if not len(residuals):
        return tol.place_sigma_px
    return max(tol.place_sigma_px, robust_deviation(residuals - np.median(residuals)))


def _add_rims(
    equations: _Equations,
    rims: Sequence[_RimRows],
    sigma: float,
    level: Level,
    tol: RefinementTolerances,
) -> Array:
    """Add the outlines of some views, of deviation ``sigma``, px.

    Returns how the gradient (V,) changes with an error of all of them, per px.
    """
    slope = np.zeros(equations.num)
    scale = max(3 * tol.place_sigma_px, 0.5 * level.rim_gate_px) ** 2
    for rim in rims:
        weight = rim.length_px * geman_mcclure_weights(rim.residual, scale)
        # An outline crosses an area over which errors are alike along the root of its pixels.
        weight *= np.sqrt(tol.phase_correlation) / sigma**2
        equations.add(rim.vertices, rim.jacobian, rim.residual, weight)
        change = (weight[:, None] * rim.jacobian).ravel()
        slope += np.bincount(rim.vertices.ravel(), change, equations.num)
    return slope


def _add_points(
    equations: _Equations,
    mesh: TriangleMesh,
    seen: Mask,
    known: KnownPoints,
    given: _Given,
    gate_px: float,
) -> None:
    """Draw the faces that are ``seen`` (F,), not those behind them, to known points near them."""
    tol, footprint = given.tol, given.footprint
    visible = TriangleMesh(mesh.vertices, mesh.faces[seen])
    place, face, barycentric = RayScene(visible).closest(known.points)
    face = np.flatnonzero(seen)[face]
    normals = mesh.face_normals[face]
    residual = dots(place - known.points, normals)
    sigma = np.hypot(known.sigma, tol.place_sigma_px * footprint)
    near = lengths(place - known.points) < gate_px * footprint
    face, residual, sigma = face[near], residual[near], sigma[near]
    along = dots(mesh.vertex_normals[mesh.faces[face]], normals[near][:, None])
    jacobian = barycentric[near] * along
    scale = np.maximum(4 * sigma, 0.1 * gate_px * footprint) ** 2
    weights = tol.point_weight(len(given.views)) * geman_mcclure_weights(residual, scale) / sigma**2
    equations.add(mesh.faces[face], jacobian, residual, weights)


def _smoothness(
    mesh: TriangleMesh, edge: float, tol: RefinementTolerances, sharp: Mask
) -> tuple[sparse.csr_array, Array, sparse.csr_array]:
    """Curvature free of scale, drawn to most of its own surroundings' mean.

    That of ``sharp`` (V,) vertices is what it is: to smooth an edge draws the faces beside it in.
    """
    normals = mesh.vertex_normals
    laplacian = sparse.eye_array(len(mesh.vertices)) - mesh.neighbor_mean
    curvature = dots(laplacian @ mesh.vertices, normals) / edge
    curvature[sharp] = 0.0
    target = tol.smoothness_memory * (mesh.neighbor_mean @ (mesh.neighbor_mean @ curvature))
    entries = laplacian.tocoo()
    rows, cols = entries.coords
    data = entries.data * dots(normals.take(rows, axis=0), normals.take(cols, axis=0)) / edge
    change = sparse.coo_array((data, (rows, cols)), shape=laplacian.shape).tocsr()
    residual = curvature - target
    weight = geman_mcclure_weights(residual, (5 * tol.smoothness) ** 2) / tol.smoothness**2
    weight[sharp] = 0.0
    factor = sparse.csr_array(change.T @ sparse.diags_array(np.sqrt(weight)))
    matrix = sparse.csr_array(factor @ factor.T)
    return matrix, np.asarray(factor @ (np.sqrt(weight) * residual)), factor
