"""Terms of the energy, linearized about a mesh.

The unknowns are the displacements u of the vertices along their normals, and a few unknowns that
all views share:

    E(u) = sum_o  w_o rho(r_o / sigma_o)     phases      :func:`add_phases`
         + sum_v  rho(d_v / sigma_v)         outlines    :func:`add_outlines`
         + sum_p  rho(h_p / sigma_p)         points      :func:`add_points`
         + sum_i  rho(k_i / sigma_k)         smoothness  :func:`smoothness`

Here ``r = m . n`` are the residuals of observations under their likelier label, w the certainties
of the labels (:mod:`polmvs.surface.labels`), d the distances of the mesh's outline to the
silhouettes, h the heights above known points, and k the changes of the scale-free curvature.
``sigma_v`` includes the bias of outlines of round surfaces (:mod:`polmvs.surface.grazing`). All
losses rho are robust (Geman and McClure 1985). One Gauss-Newton step solves the sum
(:mod:`polmvs.surface.solver`).
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.sparse.linalg import LinearOperator, cg

from polmvs.camera import sample_image
from polmvs.config import default_num_workers
from polmvs.fitting import geman_mcclure_weights, robust_deviation
from polmvs.geometry import dots, lengths, unit_or_zero
from polmvs.surface.creases import CreaseTolerances
from polmvs.surface.grazing import outline_bias
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh
from polmvs.surface.observations import DIFFUSE, SPECULAR, Observations
from polmvs.surface.surface_view import OutlineSource, SurfaceView

EDGE_NOISE = 0.1  # of the sines of normals beside an edge: half of the difference of its sides
UPPER = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))  # entries of a symmetric block
PART = 100_000  # observations that a thread sums at a time: it bounds the memory
# A point and those beside it by whose difference a field's gradient is computed, px.
BESIDE_PX = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
RIM_HALVINGS = 4  # bisections of a pixel in the search for a mesh's outline: to a sixteenth

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]
Indices = NDArray[np.int64]


@dataclass(frozen=True, kw_only=True)
class TermTolerances:
    """Tolerances of the terms.

    Attributes
    ----------
    row_sigma : least deviation of ``m . n`` beyond noise (facets, interreflection). Measured: 0.03.
    independent_px : area over which phase errors are correlated, px^2, with smoothing over 1 px;
        smaller faces are weighted by their area. Measured: equal weights cost 4 %.
    alike_px : area over which phase errors are correlated by the model of the light and not by
        noise, px^2: outlines and points get more weight relative to the rows. Measured on `dome`: a
        bias of the phases bends it by 1.5 mm with 4, by 0.7 with 400, by 0.4 with 1600, which dents
        `mug` at its sparse points.
    alike_views : number of views over which they are also correlated: with more views the weight of
        points grows.
    place_sigma_px : least deviation of an outline, px, and of a known point, GSD; an outline's
        residuals may show a larger one. Measured: 0.3; 0.7 costs 30 % on general shapes.
    outline_bias_px : deviation of a common error of all silhouettes beyond the bias of round
        surfaces. It is part of the stated deviations and not solved for. Measured on nine captures,
        median: -0.17 to 0.14, 0.11 on average.
    alike_outline_px : length over which errors of an outline are the same, px. Measured with the
        next on `mug` and a glazed vase: means over 1, 10, 40 and 80 px deviate by 0.5 to 0.7, 0.4
        to 0.6, 0.4 to 0.5 and 0.3 to 0.4 px.
    matting_sigma_px : deviation of such errors from matting (:mod:`polmvs.surface.matting`), px.
    matting_bias_px : as ``outline_bias_px``, from matting, where it differs between upper, lateral
        and lower outlines. Measured on twelve captures, root mean square of the medians: 0.22.
    point_loss_edges : least scale of the loss of known points, in edges. Measured: 1 raises a
        teapot with sparse points 2.7 mm off its lid from 79 to 96 % (F at 1 mm), but a public
        ceramic is 0.3 deg worse.
    smoothness : deviation of the scale-free curvature from the mean of its surroundings. Measured:
        0.02 to 0.08 give the same.
    smoothness_memory : share of the surroundings' curvature without penalty. Measured: 0.8.
    vote_sigma : deviation of a face's normal from the winner of the vote. Measured, 0.03 and 0.07:
        a ledge beside a box is 0.57 and 0.98 px off; a public ceramic is the same.
    """

    row_sigma: float = 0.03
    independent_px: float = 4.0
    alike_px: float = 400.0
    alike_views: int = 20
    place_sigma_px: float = 0.3
    outline_bias_px: float = 0.1
    alike_outline_px: float = 40.0
    matting_sigma_px: float = 0.35
    matting_bias_px: float = 0.2
    point_loss_edges: float = 0.0
    smoothness: float = 0.04
    smoothness_memory: float = 0.8
    vote_sigma: float = 0.03

    def phase_correlation(self, face_area_px: float) -> float:
        """Number of rows with correlated errors, for faces of this area, px^2."""
        return max(self.alike_px / max(face_area_px, self.independent_px), 1.0)

    def point_weight(self, num_views: int, face_area_px: float) -> float:
        """Weight of the known points' rows, whose errors are independent."""
        return self.phase_correlation(face_area_px) * max(1.0, num_views / self.alike_views)


@dataclass(frozen=True)
class KnownPoints:
    """Known points of the surface.

    Attributes
    ----------
    points : (N, 3), world.
    sigma : (N,), position uncertainty, world units.
    """

    points: Array
    sigma: Array


@dataclass(frozen=True)
class KnownSides:
    """Known sides of edges of a sharpened mesh with F faces.

    Attributes
    ----------
    is_shown : (F,) bool, faces of sides with a known normal. Edges between other faces are still
        round; their outlines are ignored, and smoothness holds them.
    is_fitted : (F,) bool, faces with a normal from phases. Observations of other faces are of no
        side or of mirror images: they push the walls of a height step out by up to 1.3 mm (`step`).
    """

    is_shown: Mask
    is_fitted: Mask


@dataclass
class Equations:
    """Sum of normal equations of displacements."""

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
class SharedError:
    """One unknown error that many residuals share, eliminated from the equations.

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

    def add(self, vertices: Indices, slope: Array, weight: float, residual: float) -> None:
        """Sums over residuals as in :meth:`Equations.add`, with the factors f.

        Parameters
        ----------
        vertices, slope : (N, 3), vertices and ``w f J``.
        weight, residual : ``w f^2`` and ``w f r``.
        """
        self.slope += np.bincount(vertices.ravel(), slope.ravel(), self.num)
        self._weight += weight
        self._residual += residual

    def column(self) -> Array:
        """The vector u ``(num,)`` of the class's text."""
        return np.asarray(self.slope / np.sqrt(self._weight + self.prior))

    def offset(self) -> float:
        """Factor of u on the right side."""
        return self._residual / float(np.sqrt(self._weight + self.prior))

    def solved(self, displacement: Array) -> float:
        """The error, given the solution ``(num,)``."""
        return (self._residual + float(self.slope @ displacement)) / (self._weight + self.prior)

    def deviation(self, response: Array) -> float:
        """Deviation of the error after the solution.

        ``response`` (num,) is the solution, without the error, for ``slope`` as right side.
        """
        left = self._weight + self.prior - float(self.slope @ response)
        return float(1 / np.sqrt(max(left, self.prior)))


def normal_changes(mesh: TriangleMesh) -> Array:
    """Change of a face's normal, ``(F, 3, 3)``, by the displacement of each vertex along its own.

    The component along the normal is not removed: the residuals do that.
    """
    a, b, c = np.moveaxis(mesh.corners, 1, 0)
    opposite = np.stack([c - b, a - c, b - a], axis=1)
    crossed = np.cross(opposite, mesh.vertex_normals.take(mesh.faces, axis=0))
    return np.asarray(crossed / np.maximum(2 * mesh.face_areas, 1e-300)[:, None, None])


def add_phases(
    equations: Equations,
    tilt: SharedError,
    mesh: TriangleMesh,
    observations: Observations,
    shares: Array,
    variances: Array,
    *,
    independent_area: float,
    loss_scale: float,
) -> None:
    """Add the rows of observations.

    ``r_s^2 + r_d^2`` is about the squared sine of the angle between normal and ray: with an
    undecided label, both rows together would turn the normal towards the ray. Only the excess of
    one precision over the other has weight.

    Parameters
    ----------
    tilt : the share of the polarizers' tilt that is not yet corrected.
    shares : (2, K) probabilities of both kinds of light.
    variances : (2, K) of the residuals.
    independent_area : area of correlated phase errors; smaller faces are weighted by their area.
    loss_scale : of the loss, in deviations.
    """
    o, num = observations, len(mesh.faces)
    change = normal_changes(mesh)
    along = dots(mesh.vertex_normals.take(mesh.faces, axis=0), mesh.face_normals[:, None]) / 3
    area = np.minimum(mesh.face_areas / independent_area, 1.0)

    def sums(part: slice) -> tuple[Array, float, float]:
        """Sums (F, 12) of some observations: blocks, gradients, slopes; and those of the tilt."""
        face, precision = o.face[part], shares[:, part] / variances[:, part]
        excess = precision[DIFFUSE] - precision[SPECULAR]
        own = partial(_of_kind, excess > 0, part)
        normals, rows = mesh.face_normals.take(face, axis=0), own(o.rows)
        residual = dots(rows, normals)
        weight = np.abs(excess) * area.take(face)
        weight *= geman_mcclure_weights(residual, loss_scale**2 * own(variances))
        across = rows - residual[:, None] * normals
        jacobian = np.einsum("nij,nj->ni", change.take(face, axis=0), across)
        jacobian += along.take(face, axis=0) * own(o.slope)[:, None]
        factor = own(o.tilt) * dots(np.cross(o.rays[part], rows), normals)
        weighted = weight[:, None] * jacobian
        products = np.empty((len(face), 12))
        for column, (a, b) in enumerate(UPPER):
            products[:, column] = weighted[:, a] * jacobian[:, b]
        products[:, 6:9] = residual[:, None] * weighted
        products[:, 9:] = factor[:, None] * weighted
        # Column k has its one entry in the row of the observation's face.
        index = np.arange(len(face) + 1)
        of_faces = sparse.csc_array((np.ones(len(face)), face, index), shape=(num, len(face)))
        return of_faces @ products, float(weight @ factor**2), float((weight * factor) @ residual)

    # Parts of a fixed length: on any number of cores the sums are rounded alike.
    parts = [slice(k, k + PART) for k in range(0, len(o.face), PART)]
    with ThreadPoolExecutor(default_num_workers()) as pool:
        found = list(pool.map(sums, parts))
    total: Array = sum((one[0] for one in found), np.zeros((num, 12)))
    blocks = np.empty((num, 3, 3))
    for column, (a, b) in enumerate(UPPER):
        blocks[:, a, b] = blocks[:, b, a] = total[:, column]
    equations.add_blocks(mesh.faces, blocks, total[:, 6:9])
    weight, residual = sum(one[1] for one in found), sum(one[2] for one in found)
    tilt.add(mesh.faces, total[:, 9:], weight, residual)


def _of_kind(is_diffuse: Mask, part: slice, of_both: Floats) -> Floats:
    """Values of one kind of light for some observations, from those of both ``(2, K, ...)``."""
    chosen = is_diffuse.reshape(-1, *(1,) * (of_both.ndim - 2))
    return np.where(chosen, of_both[DIFFUSE, part], of_both[SPECULAR, part])


def add_votes(
    equations: Equations,
    mesh: TriangleMesh,
    normals: Array,
    has_won: Mask,
    *,
    sigma: float,
    independent_area: float,
) -> None:
    """Turn faces towards the normals ``(F, 3)`` that their observations voted for."""
    face = np.flatnonzero(has_won)
    target, own = normals[face], mesh.face_normals[face]
    change = normal_changes(mesh)[face]
    weight = np.minimum(mesh.face_areas[face] / independent_area, 1.0) / sigma**2
    helper = np.where(np.abs(target[:, :1]) < 0.7, [[1.0, 0, 0]], [[0, 1.0, 0]])
    first = unit_or_zero(np.cross(target, helper))
    for tangent in (first, np.cross(target, first)):
        residual = dots(tangent, own)
        jacobian = np.einsum("nij,nj->ni", change, tangent - residual[:, None] * own)
        equations.add(mesh.faces[face], jacobian, residual, weight)


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
        """The ``kept`` (E,) edges."""
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
    """Contour generator: points of a mesh on its outline in one view.

    Attributes
    ----------
    ends : (K, 2) vertices; the points lie in the middle between them.
    faces : (K, 2) that share these edges.
    xy : (K, 2) image coordinates of the points, or of the mesh's outline beside them.
    length_px : (K,) length of the outline of each point.
    radius_px : (K,) radius of curvature of the surface along the line of sight.
    """

    ends: Indices
    faces: Indices
    xy: Array
    length_px: Array
    radius_px: Array


def find_rim(
    mesh: TriangleMesh,
    scene: RayScene,
    view: SurfaceView,
    edges: SharedEdges,
    *,
    on_outline: bool = False,
) -> Rim:
    """The contour generator in a view: edges between front and back faces with nothing behind.

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
    # One pixel outside of the outline there is nothing, one pixel inside the surface: on a round or
    # oblique one it lies far before the outline.
    beyond = scene.cast(view.center, away + 1.0 * pixel[:, None] * outwards).distance
    before = scene.cast(view.center, away - 1.0 * pixel[:, None] * outwards).distance
    slack = 4 * mesh.mean_edge / distance[:, 0]
    rim = ~np.isfinite(beyond) & (before < 1 + slack)
    away, step = away[rim], (pixel[:, None] * outwards)[rim]
    # The surface lies a d + sqrt(2 r d) before the outline, d inside of it; a is that of a plane.
    inner = scene.cast(view.center, away - 4.0 * step).distance
    gap, inner_gap = ((1 - t) * distance[rim, 0] / pixel[rim] for t in (before[rim], inner))
    bend = np.clip((4 * gap - inner_gap) / 2, 0, None)
    radius = np.where(np.isfinite(bend), bend**2 / 2, 0)
    if not on_outline:
        return Rim(ends[rim], faces[rim], xy[rim], length[rim], radius)
    low, high = np.zeros(len(away)), np.ones(len(away))
    for _ in range(RIM_HALVINGS):
        middle = 0.5 * (low + high)
        met = np.isfinite(scene.cast(view.center, away + middle[:, None] * step).distance)
        low, high = np.where(met, middle, low), np.where(met, high, middle)
    xy, _ = view.project(view.center + away + (0.5 * (low + high))[:, None] * step)
    return Rim(ends[rim], faces[rim], xy, length[rim], radius)


def rim_residuals(view: SurfaceView, xy: Array) -> tuple[Array, Array]:
    """Signed distance ``(K,)`` of points to the silhouette, px, and its gradient ``(K, 2)``.

    Where the silhouette has unknown pixels, the nearer of its two outlines is used.
    """
    places = xy[:, None] + BESIDE_PX
    field = sample_image(view.silhouette.inner, places).astype(np.float64)
    if not view.silhouette.is_sharp:
        outer = sample_image(view.silhouette.outer, places).astype(np.float64)
        field = np.where(np.abs(outer[:, :1]) < np.abs(field[:, :1]), outer, field)
    return field[:, 0], 0.5 * (field[:, 1::2] - field[:, 2::2])


@dataclass(frozen=True)
class OutlineRows:
    """Rows of a view's outline.

    Attributes
    ----------
    vertices, jacobian : (K, 3).
    residual, length_px : (K,) px, of the outline.
    alike_px : (K,) deviation of the error that neighbours on the outline share.
    bias_px : (K,) deviation of the part of it that all outlines share.
    """

    vertices: Indices
    jacobian: Array
    residual: Array
    length_px: Array
    alike_px: Array
    bias_px: Array


def outline_rows(
    mesh: TriangleMesh,
    scene: RayScene,
    view: SurfaceView,
    edges: SharedEdges,
    sharp: Mask,
    tol: TermTolerances,
    *,
    gate_px: float,
    on_outline: bool = False,
) -> OutlineRows:
    """Rows of a view's outline, of points within ``gate_px`` of its silhouette."""
    rim = find_rim(mesh, scene, view, edges, on_outline=on_outline)
    residual, gradient = rim_residuals(view, rim.xy)
    near = np.abs(residual) < gate_px
    ends, residual, gradient = rim.ends[near], residual[near], gradient[near]
    vertices, directions = outline_moves(mesh, ends, rim.faces[near], sharp)
    jacobian = np.zeros((len(ends), 3))
    middle = mesh.vertices[ends].mean(axis=1)
    reach = 1e-3 * mesh.mean_edge
    for column in (0, 1):
        ahead, _ = view.project(middle + reach * directions[:, column])
        behind, _ = view.project(middle - reach * directions[:, column])
        jacobian[:, column] = dots(gradient, ahead - behind) / (2 * reach)
    vertices = np.column_stack([vertices, vertices[:, 0]])
    is_matted = view.outline_source is OutlineSource.MATTING
    # The true bias lies anywhere between none and the largest: half of it is subtracted, and the
    # deviation of an even distribution remains.
    bias = half = 0.5 * outline_bias(rim.radius_px[near], matted=is_matted)
    if view.outline_source is not OutlineSource.MASK:
        residual, bias = residual - half, half / np.sqrt(3)
    return OutlineRows(
        vertices=vertices,
        jacobian=np.nan_to_num(jacobian),
        residual=residual,
        length_px=rim.length_px[near],
        alike_px=np.hypot(bias, tol.matting_sigma_px) if is_matted else half,
        bias_px=np.hypot(bias, tol.matting_bias_px) if is_matted else bias,
    )


def outline_moves(
    mesh: TriangleMesh, ends: Indices, faces: Indices, sharp: Mask
) -> tuple[Indices, Array]:
    """Derivatives ``(K, 2, 3)`` of edge midpoints by the displacements of two vertices ``(K, 2)``.

    Both ends move the midpoint by half of their own displacements. An edge between two sides of the
    object is their intersection: it moves with each side within the plane of the other.
    """
    directions = 0.5 * mesh.vertex_normals[ends]
    one, other = np.moveaxis(mesh.face_normals[faces], 1, 0)
    cosine = dots(one, other)
    # This also holds for a fold, whose sides face away from each other.
    apart = np.abs(cosine) < np.cos(np.radians(CreaseTolerances.crease_deg))
    meets = np.all(sharp[ends], axis=1) & apart
    opposite = mesh.faces[faces].sum(axis=2) - ends.sum(axis=1, keepdims=True)
    dual = np.stack([one - cosine[:, None] * other, other - cosine[:, None] * one], axis=1)
    dual /= np.maximum(1 - cosine**2, 1e-9)[:, None, None]
    # A side of one row of triangles has no vertex but those of its edges.
    along = dots(mesh.vertex_normals[opposite], mesh.face_normals[faces]) * ~sharp[opposite]
    directions[meets] = (dual * along[..., None])[meets]
    return np.where(meets[:, None], opposite, ends), directions


def outline_sigma(rows: OutlineRows, tol: TermTolerances) -> float:
    """Deviation of a view's outline from its residuals, px."""
    if not len(rows.residual):
        return tol.place_sigma_px
    centred = rows.residual - np.median(rows.residual)
    return max(tol.place_sigma_px, robust_deviation(centred))


def add_outlines(
    equations: Equations,
    rows: Sequence[OutlineRows],
    tol: TermTolerances,
    *,
    face_area_px: float,
    gate_px: float,
) -> Array:
    """Add the outlines of some views.

    Returns the change of the gradient (V,) by one deviation of the error that all outlines share.
    """
    slope = np.zeros(equations.num)
    scale = max(3 * tol.place_sigma_px, 0.5 * gate_px) ** 2
    for own in rows:
        variance = outline_sigma(own, tol) ** 2 + tol.alike_outline_px * own.alike_px**2
        weight = own.length_px * geman_mcclure_weights(own.residual, scale) / variance
        # An outline crosses an area of correlated errors over the root of its pixels.
        weight *= np.sqrt(tol.phase_correlation(face_area_px))
        equations.add(own.vertices, own.jacobian, own.residual, weight)
        shared = np.hypot(tol.outline_bias_px, own.bias_px)
        change = ((weight * shared)[:, None] * own.jacobian).ravel()
        slope += np.bincount(own.vertices.ravel(), change, equations.num)
    return slope


def add_points(
    equations: Equations,
    mesh: TriangleMesh,
    seen: Mask,
    known: KnownPoints,
    tol: TermTolerances,
    *,
    weight: float,
    gsd: float,
    gate_px: float,
) -> None:
    """Pull the ``seen`` (F,) faces, not those behind them, to nearby known points.

    ``weight`` is that of a point (:meth:`TermTolerances.point_weight`).
    """
    visible = TriangleMesh(mesh.vertices, mesh.faces[seen])
    place, face, barycentric = RayScene(visible).closest(known.points)
    face = np.flatnonzero(seen)[face]
    normals = mesh.face_normals[face]
    residual = dots(place - known.points, normals)
    sigma = np.hypot(known.sigma, tol.place_sigma_px * gsd)
    near = lengths(place - known.points) < gate_px * gsd
    face, residual, sigma = face[near], residual[near], sigma[near]
    along = dots(mesh.vertex_normals[mesh.faces[face]], normals[near][:, None])
    jacobian = barycentric[near] * along
    least = max(0.1 * gate_px * gsd, tol.point_loss_edges * mesh.mean_edge)
    scale = np.maximum(4 * sigma, least) ** 2
    weights = weight * geman_mcclure_weights(residual, scale) / sigma**2
    equations.add(mesh.faces[face], jacobian, residual, weights)


def smoothness(
    mesh: TriangleMesh, edge: float, tol: TermTolerances, sharp: Mask
) -> tuple[sparse.csr_array, Array, sparse.csr_array]:
    """Smoothness: the scale-free curvature is pulled to a share of its surroundings' mean.

    ``sharp`` (V,) vertices are excluded: smoothing an edge would pull in the faces beside it.
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


def with_edges(mesh: TriangleMesh, moves: Array, sharp: Mask) -> Array:
    """Moves ``(V, 3)`` of vertices; ``sharp`` ones (V,) move to the intersection of their sides.

    A side moves as its vertices that are not on an edge.
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


def solve(matrix: sparse.csr_array, right: Array, damping: Array, shared: Array) -> Array:
    """Solution of ``(matrix + diag(damping) - s sT) x = right`` by conjugate gradients.

    s is ``shared`` (V,), see :class:`SharedError`.

    The system is well conditioned: the damping bounds the smallest eigenvalue, and low frequencies
    were solved on coarser meshes.
    """
    num = len(right)
    damped = sparse.csr_array(matrix + sparse.diags_array(damping))
    inverse = 1 / damped.diagonal()
    precondition = LinearOperator((num, num), matvec=lambda x: inverse * x.ravel())
    reduced = LinearOperator(
        (num, num), matvec=lambda x: damped @ x.ravel() - (shared @ x.ravel()) * shared
    )
    return np.asarray(cg(reduced, right, rtol=1e-3, maxiter=300, M=precondition)[0])
