"""Support of a surface: evidence for its faces, and their normals with uncertainty.

A part of the mesh is discarded if fewer than two views see it, if silhouettes deny it, or if
neither phases nor outlines nor points determine it. Such an undetermined part comes only from
smoothness or the visual hull. A part that its phases contradict has no points; the mesh keeps it,
because a hole would show the inside.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse, special

from polmvs.camera import in_image, sample_image
from polmvs.fitting import like_most, robust_deviation
from polmvs.geometry import dots, lengths, unit
from polmvs.normals.estimator import solve_normals
from polmvs.polarization.region import grow_mask
from polmvs.scene import MIN_FACING_COSINE, MIN_VIEWS
from polmvs.surface.creases import CreaseTolerances, SideAverage
from polmvs.surface.dense_view import lattice_xy
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh, visible_points
from polmvs.surface.observations import observe
from polmvs.surface.solver import Fit, Labelled, covered_share, phase_information
from polmvs.surface.surface_view import SurfaceView
from polmvs.surface.terms import KnownPoints
from polmvs.surface.visual_hull import HullTolerances

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Mask = NDArray[np.bool_]

MIN_EXCESS = 1e-3  # least excess probability of one kind of light over the other
MAX_SIGMAS = 3.0  # of a value above which it is a contradiction
MAX_SHARE = 0.1  # share of a surface or its silhouettes in contradiction. Guess
# Share of the sparse points off the surface. Measured, 0 to 0.12; of a teapot whose lid is too high
# 0.40. A guess in the gap.
MAX_OFF = 0.25
SIGNIFICANCE = 0.95  # of a one-sided test
MIN_POINTS = 10  # least number on the surface for a median
# Explained share of a consistent view, relative to the median view. Measured on eleven captures,
# each with the pose of one view exchanged: 0.80 and more; wrong ones under PPA had 0.47 and
# less.
MIN_EXPLAINED = 0.65
MIN_OTHERS = 0.05  # least share of a normal's precision that a row leaves to the others
MAX_GROUPS = 16  # of views: the relative error of a variance is the root of 2 over their number
MAX_ROWS = 500_000  # faces times views at a time; bounds memory


@dataclass(frozen=True, kw_only=True)
class QualityTolerances:
    """Tolerances of the support of a surface.

    Attributes
    ----------
    outside_px : distance outside of a silhouette at which it denies a face; an outline within it
        shows the face. Twice the deviation of an outline with its bias. Measured with the next:
        halves cost `mug` 0.4 points of F at 1 mm, doubles none.
    max_outside_share : of the views that see a face, above which it is denied: two of six.
    min_information : mean of the phases of a face, nats. Derived: one bit tells a direction from
        the perpendicular one, as the label of the light does.
    information_share : of the usual mean of a face's phases, if all say little. Measured on white,
        glazed and grey mugs: 0.15 on the cap over their opening, and 1 on their walls.
    max_sigma_ratio : position uncertainty over its median, above which neither phases nor points
        determine a face. Measured on a mug with a wrong cap over its opening: most faces of the
        cap have 1.8 to 4, 95 % of the right ones less than 1.7.
    min_gap_px : radius of a circle with the area of the smallest undetermined or contradicted part
        that is removed, GSD; smoothness bridges smaller ones. The least size of an opening
        (:class:`polmvs.surface.cavities.CavityTolerances`).
    min_mean_square : least median over the surface of the phases' mean squared residual over its
        variance. Measured on twelve captures: 0.12 to 0.79; images without noise have less.
    """

    outside_px: float = 1.5
    max_outside_share: float = 0.34
    min_information: float = math.log(2)
    information_share: float = 0.3
    max_sigma_ratio: float = 2.0
    min_gap_px: float = 6.0
    min_mean_square: float = 0.1


TOL = QualityTolerances()


@dataclass(frozen=True)
class FaceEvidence:
    """Evidence of the views for each face of a mesh.

    Attributes
    ----------
    num_views : (F,) int, views that see it.
    num_outside : (F,) int, views whose silhouettes deny it.
    num_rows : (F,) int, views with a phase there.
    num_contradicting : (F,) int, views whose phase contradicts its normal.
    num_outlines : (F,) int, views that see it at their outline.
    information : (F,) of all its phases, nats (:func:`polmvs.surface.solver.phase_information`).
    """

    num_views: NDArray[np.int64]
    num_outside: NDArray[np.int64]
    num_rows: NDArray[np.int64]
    num_contradicting: NDArray[np.int64]
    num_outlines: NDArray[np.int64]
    information: Array

    @property
    def agreement(self) -> Array:
        """Share ``(F,)`` of the phases that agree with the normal; 0 without any."""
        agreeing = self.num_rows - self.num_contradicting
        return np.asarray(agreeing / np.maximum(self.num_rows, 1), np.float64)

    @property
    def enough_information(self) -> float:
        """Mean information of a face's phases that tells it from a cap over an opening, nats.

        It is a share of the usual mean where all phases say little, as those of white things.
        """
        rows = self.num_rows
        usual = float(np.median(self.information[rows > 0] / rows[rows > 0])) if rows.any() else 0.0
        return min(TOL.min_information, TOL.information_share * usual)


def face_evidence(
    mesh: TriangleMesh,
    fit: Fit,
    labelled: Labelled,
) -> FaceEvidence:
    """Evidence of all views for all faces.

    Parameters
    ----------
    mesh : refined.
    fit : of the views.
    labelled : the observations of the mesh, with their light.
    """
    num = len(mesh.faces)
    views, outside, outlines = np.zeros((3, num), np.int64)
    if not num:
        return FaceEvidence(views, outside, views, views, outlines, np.zeros(0))
    scene = RayScene(mesh)
    for view in fit.views:
        seen, _, _ = visible_points(
            scene, view.center, mesh.centers, mesh.face_normals, min_cosine=MIN_FACING_COSINE
        )
        xy, _ = view.project(mesh.centers[seen])
        inside = view.in_image(xy, 2.0)
        seen, xy = seen[inside], xy[inside]
        views[seen] += 1
        if view.has_outline:
            distance = sample_image(view.silhouette.outer, xy)
            outside[seen[distance > TOL.outside_px]] += 1
            outlines[seen[np.abs(distance) <= TOL.outside_px]] += 1
    face = labelled.observations.face
    return FaceEvidence(
        num_views=views,
        num_outside=outside,
        num_rows=np.bincount(face, minlength=num),
        num_contradicting=np.bincount(face[labelled.contradicts(mesh)], minlength=num),
        num_outlines=outlines,
        information=np.bincount(
            face, phase_information(mesh, labelled.observations, fit), num
        ).astype(np.float64),
    )


def supported_faces(
    mesh: TriangleMesh,
    evidence: FaceEvidence,
    *,
    min_views: int = 2,
    gsd: float,
    sigma: Array | None = None,
    min_information: float = TOL.min_information,
) -> Mask:
    """Which faces ``(F,)`` the views support.

    Parameters
    ----------
    mesh : of the evidence.
    evidence : of its faces.
    min_views : number of views that must see a face and have a phase there.
    gsd : ground sampling distance, world units.
    sigma : (V,) position uncertainty of the vertices; None: no face counts as certain.
    min_information : mean information of a face's phases, nats, that determines the face.
    """
    if not len(mesh.faces):
        return np.zeros(0, np.bool_)
    of_faces = (
        evidence.num_views,
        evidence.num_outside,
        evidence.num_rows,
        evidence.num_outlines,
        evidence.information,
    )
    smooth = _smoothed(mesh, np.stack(of_faces, axis=1).astype(np.float64))
    views, outside, rows, outlines, information = smooth.T
    denied = outside > np.maximum(TOL.max_outside_share * views, 1.5)
    determined = (information >= min_information * rows) | (outlines >= 0.5)
    if sigma is not None:
        of_face = sigma[mesh.faces].mean(axis=1)
        known = np.isfinite(of_face)
        usual = np.median(of_face[known]) if known.any() else 0.0
        determined |= of_face <= TOL.max_sigma_ratio * usual
    undetermined = _wide_parts(mesh, ~determined, gsd)
    seen = (evidence.num_views >= min_views) & (rows >= min_views - 0.5)
    return np.asarray(seen & ~undetermined & ~denied)


def contradicted_faces(
    mesh: TriangleMesh,
    evidence: FaceEvidence,
    *,
    gsd: float,
) -> Mask:
    """Which faces ``(F,)`` have phases that are less likely than those of any direction.

    Parameters
    ----------
    mesh, evidence, gsd : as of :func:`supported_faces`.
    """
    information = _smoothed(mesh, evidence.information[:, None])[:, 0]
    return _wide_parts(mesh, information < 0, gsd)


def pixel_information(
    mesh: TriangleMesh, fit: Fit, beside: TriangleMesh | None = None
) -> sparse.csr_array:
    """Information of the phases of V views on each face, ``(V, F)``: nats, summed over pixels.

    The mesh is hidden by itself, and by what is ``beside`` it.
    """
    scene = RayScene(mesh if beside is None else mesh.with_faces_of(beside))
    seen = observe(mesh, scene, fit.views, fit.images, fit.looking)
    information = phase_information(mesh, seen, fit)
    found = np.zeros(len(seen.face))
    for one in seen.of_views():
        face, number = seen.face[one], int(seen.view[one.start])
        gsd = fit.views[number].gsd(mesh.centers[face])
        pixels = mesh.face_areas[face] * seen.cosine[one] / gsd**2
        found[one] = pixels * information[one]
    shape = (len(fit.views), len(mesh.faces))
    return sparse.coo_array((found, (seen.view, seen.face)), shape=shape).tocsr()


def view_information(mesh: TriangleMesh, fit: Fit, beside: TriangleMesh | None = None) -> Array:
    """Information (V,) of the phases of each view, nats; as of :func:`pixel_information`."""
    return np.asarray(pixel_information(mesh, fit, beside).sum(axis=1))


def misfit(mesh: TriangleMesh, labelled: Labelled) -> Array:
    """How much worse than on half of the surface the phases about each vertex fit, ``(V,)``.

    It is the ratio of the mean squares of the residuals over their variances, and at least 1
    (Birge 1932).

    Parameters
    ----------
    mesh : refined.
    labelled : its observations, with their light.
    """
    num, face = len(mesh.faces), labelled.observations.face
    if not len(face):
        return np.ones(len(mesh.vertices))
    residual, variance = labelled.residuals(mesh)
    squares = np.bincount(face, residual**2 / variance, num).astype(np.float64)
    mean, rows = _mean_about(mesh, squares, np.bincount(face, minlength=num))
    usual = max(float(np.median(mean[rows > 0])), TOL.min_mean_square)
    ratio = np.maximum(mean / usual, 1)
    count = np.maximum(np.bincount(mesh.faces.ravel(), minlength=len(mesh.vertices)), 1)
    return np.asarray(mesh.incidence.T @ ratio) / count


def _wide_parts(mesh: TriangleMesh, chosen: Mask, gsd: float) -> Mask:
    """Faces ``(F,)`` of the chosen ones whose connected part is as wide as an opening."""
    part = mesh.pieces(chosen)
    area = np.bincount(part + 1, mesh.face_areas)
    return np.asarray(chosen & (area[part + 1] >= np.pi * (TOL.min_gap_px * gsd) ** 2))


def _smoothed(mesh: TriangleMesh, values: Array) -> Array:
    """Means ``(F, C)`` of values ``(F, C)`` over faces that share a vertex, twice.

    Single faces are noisy. Measured: means taken once cost four captures 0.005 to 0.06 points of F
    at 1 mm, four times change as little.
    """
    incidence = mesh.incidence.T.tocsr()
    degree = np.maximum(np.asarray(incidence.sum(axis=1)).ravel(), 1)[:, None]
    for _ in range(2):
        values = np.asarray(incidence.T @ ((incidence @ values) / degree)) / 3
    return values


def _mean_about(mesh: TriangleMesh, sums: Array, counts: NDArray[Any]) -> tuple[Array, Array]:
    """Mean ``(F,)`` about each face of what has these sums and counts (F,), and its weight (F,)."""
    both = np.stack([sums, counts.astype(np.float64)], axis=1)
    total, weight = _smoothed(mesh, _smoothed(mesh, both)).T
    return total / np.maximum(weight, 1e-9), weight


@dataclass(frozen=True)
class FaceNormals:
    """Normals of a mesh's faces.

    Attributes
    ----------
    normals : (F, 3) unit, world: from the phases where they agree with the mesh, else the mesh's.
    noise : (F,) variance of the normal that the rows state, trace of its covariance, rad^2; inf
        where the phases give no normal.
    changes : (G, F, 3) float32, change of the normal by each of G groups of views.
    num_rows : (F,) rows that count.
    """

    normals: Array
    noise: Array
    changes: NDArray[np.float32]
    num_rows: NDArray[np.int64]

    @property
    def is_fitted(self) -> Mask:
        """(F,), whether a normal is from the phases."""
        return np.isfinite(self.noise)

    def sigma_deg(self, mesh: TriangleMesh, average: SideAverage) -> Array:
        """Standard deviation ``(F,)`` of the angle of averaged normals; inf where not fitted.

        The variance is the jackknife over groups of views (Tukey 1958). The changes are averaged
        as the normals are, so it includes errors that neighbours share in a view. A face has few
        views: the ratio of the jackknife to the stated variance is that of its surroundings, and of
        one view of the whole surface. It does not include errors that the views share
        (:func:`disagreement_deg`).

        Parameters
        ----------
        mesh : with F faces.
        average : of the normals, as of :func:`polmvs.surface.creases.sided_normals`.
        """
        num, fitted = len(self.noise), self.is_fitted
        columns = average.of(np.moveaxis(self.changes, 1, 0).reshape(num, -1))
        squares = np.einsum("fc,fc->f", columns, columns, dtype=np.float64)
        freedom = np.where(fitted, np.maximum(self.num_rows - 2, 0), 0)
        ratio = freedom * squares / np.where(fitted, self.noise, 1)
        sums = np.stack([ratio, freedom], axis=1)
        whole = sums.sum(axis=0)
        expected = whole[0] / whole[1] if whole[1] else 1.0
        about = _smoothed(mesh, sums)
        excess = (about[:, 0] + expected) / (about[:, 1] + 1)
        return np.degrees(np.sqrt(self.noise * excess))


def disagreement_deg(mesh: TriangleMesh, normals: Array, is_fitted: Mask) -> Array:
    """Angle ``(F,)`` between the normals of the phases and of the mesh, degrees.

    Root mean square about each face. The mesh's normals are those of positions that outlines,
    points and smoothness determine as well, so the angle shows errors of the phases that all views
    share, and detail that both smooth.

    Parameters
    ----------
    mesh : with F faces.
    normals : (F, 3) unit, of the phases.
    is_fitted : (F,) bool, where they are known.
    """
    cosine = np.clip(dots(normals, mesh.face_normals), -1, 1)
    squares = np.where(is_fitted, np.arccos(cosine) ** 2, 0)
    return np.asarray(np.degrees(np.sqrt(_mean_about(mesh, squares, is_fitted)[0])))


def fit_normals(mesh: TriangleMesh, labelled: Labelled) -> FaceNormals:
    """Normals from the phases of all views at the faces of the mesh, which does not move.

    A mesh's own normals are noisier, as they are differences of positions.

    Parameters
    ----------
    mesh : refined.
    labelled : its observations, with their light.
    """
    num, view_count = len(mesh.faces), labelled.num_views
    group = np.arange(view_count) % MAX_GROUPS
    normals, noise = mesh.face_normals.copy(), np.full(num, np.inf)
    num_rows = np.zeros(num, np.int64)
    changes = np.zeros((min(view_count, MAX_GROUPS), num, 3), np.float32)
    if not num:
        return FaceNormals(normals, noise, changes, num_rows)
    o = labelled.observations
    kind, excess = labelled.kind, labelled.excess
    index = np.arange(len(o.face))
    chosen = o.rows[kind, index]
    turn = np.sqrt(o.turn_variance[kind, index] / np.maximum(excess, MIN_EXCESS))
    row_sigma = float(np.median(labelled.row_sigma[kind, index])) if len(index) else 0.0
    at_a_time = max(1, MAX_ROWS // max(view_count, 1))
    for start in range(0, num, at_a_time):
        part = slice(start, min(start + at_a_time, num))
        expected = mesh.face_normals[part]
        shape = (view_count, len(expected))
        rows = np.full((3, *shape), np.nan, np.float32)
        rays = np.zeros((3, *shape), np.float32)
        turns = np.full(shape, np.inf, np.float32)
        here = np.flatnonzero((o.face >= part.start) & (o.face < part.stop))
        view, face = o.view[here], o.face[here] - part.start
        rows[:, view, face] = chosen[here].T
        rays[:, view, face] = o.rays[here].T
        turns[view, face] = turn[here]
        estimate = solve_normals(rows, rays, turns, initial_normals=expected.T)
        cosine = np.clip((estimate.normals * expected).sum(axis=1), -1, 1)
        apart = np.degrees(np.arccos(cosine))
        # A mesh rounds a right-angled edge: a face there is turned by at most 45 deg.
        good = estimate.valid & (apart < CreaseTolerances.crease_deg + 3 * estimate.sigma_deg)
        good &= estimate.residual < 3 * row_sigma
        own = np.flatnonzero(good)
        fitted = start + own
        normals[fitted] = estimate.normals[own]
        num_rows[fitted] = estimate.num_rows[own]
        noise[fitted], changes[:, fitted] = _spread_of_views(
            normals[fitted].T,
            rows[..., own],
            rays[..., own],
            turns[:, own],
            estimate.row_weights[:, own],
            group,
        )
    return FaceNormals(normals, noise, changes, num_rows)


def _spread_of_views(
    normals: Array,
    rows: Floats,
    rays: Floats,
    turns: Floats,
    row_weights: Floats,
    group: NDArray[np.int64],
) -> tuple[Array, Floats]:
    """Stated variance (N,) of normals (3, N), and their change (G, N, 3) by each group.

    A row k changes the normal by ``A^-1 w_k m_k (m_k . n) / (1 - h_k)`` on the tangent plane, with
    ``A = M^T W M`` and its leverage ``h_k = w_k m_k^T A^-1 m_k``: the change if it is left out.
    """
    least = np.eye(3)[np.argmin(np.abs(normals), axis=0)].T
    first = unit(np.cross(normals, least, axis=0).T).T
    second = np.cross(normals, first, axis=0)
    along, across, a, b = (
        np.einsum("ikn,in->kn", one, axis)
        for one, axis in ((rays, normals), (rows, normals), (rows, first), (rows, second))
    )
    usable = np.isfinite(across) & np.isfinite(turns)
    variance = turns**2 * (1 - along**2)
    weights = np.where(usable, row_weights / np.where(usable, variance, 1), 0)
    a, b, across = (np.where(usable, values, 0) for values in (a, b, across))
    aa, ab, bb = ((weights * p).sum(axis=0, dtype=np.float64) for p in (a * a, a * b, b * b))
    determinant = aa * bb - ab**2
    num_groups = int(group.max()) + 1
    pulls = np.zeros((2, num_groups, normals.shape[1]))
    leverage = weights * (bb * a**2 - 2 * ab * a * b + aa * b**2) / determinant
    across /= np.maximum(1 - leverage, MIN_OTHERS)
    for axis, direction in enumerate((a, b)):
        np.add.at(pulls[axis], group, weights * direction * across)
    along_first = (bb * pulls[0] - ab * pulls[1]) / determinant
    along_second = (aa * pulls[1] - ab * pulls[0]) / determinant
    changes = along_first[..., None] * first.T + along_second[..., None] * second.T
    return (aa + bb) / determinant, changes.astype(np.float32)


@dataclass(frozen=True, kw_only=True)
class Contradictions:
    """Disagreement between a surface and the data from which it was made.

    Attributes
    ----------
    phase_sine : median of the absolute residuals of the phases.
    contradicted_share : share of the area that two views see where the phases contradict the
        normals.
    denied_share : share of that area which silhouettes deny.
    uncovered_share : mean over the views of the share of the silhouette that the surface leaves
        uncovered.
    point_offset_px : median distance of the surface outside of the known points on it, GSD.
    point_offset_sigmas : the same in its standard deviations.
    """

    phase_sine: float
    contradicted_share: float
    denied_share: float
    uncovered_share: float
    point_offset_px: float = 0.0
    point_offset_sigmas: float = 0.0

    def warnings(self) -> list[str]:
        """Warnings for the user; none if the surface fits its data."""
        found = []
        if self.contradicted_share > MAX_SHARE:
            found.append(
                f"on {self.contradicted_share:.0%} of the surface the phases contradict it; the "
                "cloud leaves these parts out"
            )
        if self.denied_share > MAX_SHARE:
            found.append(
                f"{self.denied_share:.0%} of the surface lies outside of the silhouettes of views "
                "that see it; these parts are left out"
            )
        if self.uncovered_share > MAX_SHARE:
            found.append(
                f"{self.uncovered_share:.0%} of the polarized regions are not covered by the "
                "surface: views contradict each other, or a part is missing; one that hardly "
                "polarizes (bright, matt) needs `region.mask`"
            )
        if abs(self.point_offset_sigmas) > MAX_SIGMAS:
            side = "outside" if self.point_offset_px > 0 else "inside"
            found.append(
                f"the surface lies {abs(self.point_offset_px):.1f} px {side} of the sparse points "
                "on it, which its stated deviation does not explain: outlines are too wide or too "
                "narrow (masks, blur), or the points are not on it"
            )
        return found


def find_contradictions(
    mesh: TriangleMesh,
    evidence: FaceEvidence,
    supported: Mask,
    contradicted: Mask,
    views: Sequence[SurfaceView],
    phase_sine: float,
) -> Contradictions:
    """Compare a surface with the views.

    Parameters
    ----------
    mesh, evidence : the surface.
    supported, contradicted : (F,) faces that are kept, and those that phases contradict.
    views : all views.
    phase_sine : median of the absolute residuals of the phases.
    """
    area = mesh.face_areas * (evidence.num_views >= 2)
    total = max(float(area.sum()), 1e-300)
    denied = evidence.num_outside > np.maximum(TOL.max_outside_share * evidence.num_views, 1.5)
    return Contradictions(
        phase_sine=phase_sine,
        contradicted_share=float(area[contradicted].sum()) / total,
        denied_share=float(area[denied].sum()) / total,
        uncovered_share=1 - covered_share(RayScene(mesh.only(supported)), views),
    )


def outline_mismatch(
    mesh: TriangleMesh, views: Sequence[SurfaceView], *, stride_px: int = 4
) -> Array:
    """Share ``(K,)`` of the union of mesh and silhouette in each view that is of only one of them.

    NaN if a view shows neither.
    """
    scene, shares = RayScene(mesh), np.full(len(views), np.nan)
    for index, view in enumerate(views):
        hit, rows, cols = _covered(scene, view, stride_px)
        certain, possible = (
            mask[rows, cols] for mask in (view.silhouette.certain, view.silhouette.possible)
        )
        shown = int((certain | hit).sum())
        if shown:
            shares[index] = ((certain & ~hit) | (hit & ~possible)).sum() / shown
    return shares


def loses_silhouettes(
    mesh: TriangleMesh,
    carved: TriangleMesh,
    views: Sequence[SurfaceView],
    *,
    margin_px: float,
    stride_px: int = 4,
) -> bool:
    """Whether half of the views show the object where only the mesh is and not the carved one.

    Parameters
    ----------
    mesh, carved : the mesh, and the same with free space carved.
    views : all.
    margin_px : from the border of a silhouette; what is nearer does not count.
    """
    whole, rest = RayScene(mesh), RayScene(carved)
    lost = np.zeros(len(views), np.bool_)
    for index, view in enumerate(views):
        hit, rows, cols = _covered(whole, view, stride_px)
        inside = ndimage.distance_transform_edt(view.silhouette.certain)[rows, cols] > margin_px
        lost[index] = bool((inside & hit & ~_covered(rest, view, stride_px)[0]).any())
    return bool(lost.mean() >= 0.5)


def _covered(
    scene: RayScene, view: SurfaceView, stride_px: int
) -> tuple[Mask, NDArray[np.intp], NDArray[np.intp]]:
    """Where a view sees a mesh (H, W), on a lattice of pixels, and their rows and columns."""
    camera = view.view.camera
    xy = lattice_xy(camera.height // stride_px, camera.width // stride_px, stride_px)
    cols, rows = np.moveaxis(np.floor(xy).astype(np.intp), -1, 0)
    hit = scene.cast(view.center, view.view.rays_in_world(xy.reshape(-1, 2))).face >= 0
    return hit.reshape(xy.shape[:-1]), rows, cols


def stand_apart(unexplained: Array, least: float) -> Mask:
    """Which views a surface explains much worse than the median view.

    The criterion is the explained share or the unexplained share. A view with a wrong pose may
    agree with the surface by chance on most pixels, as either kind of light is possible, and still
    leave many times more unexplained than a correct one. It also stands beyond the spread of the
    views: if they differ widely, the surface is wrong in places and not a view.

    Parameters
    ----------
    unexplained : (K,) shares; NaN where unknown.
    least : sufficient explained share, relative to the median view.

    Returns
    -------
    (K,) bool. None if fewer than three views would remain (two agree by chance), or if half of the
    median view or more is unexplained (the surface itself is wrong).
    """
    explained = 1 - unexplained
    known = np.isfinite(explained)
    odd = np.zeros(len(explained), np.bool_)
    if known.any() and np.median(explained[known]) > 0.5:
        usual = float(np.median(explained[known]))
        odd[known] = explained[known] < least * usual
        odd[known] |= ~like_most(unexplained[known], floor=MAX_SHARE)
        spread = robust_deviation(explained[known] - usual)
        odd[known] &= explained[known] < usual - MAX_SIGMAS * spread
    return odd if (~odd).sum() >= MIN_VIEWS else np.zeros_like(odd)


def points_deny(moved: TriangleMesh, mesh: TriangleMesh, known: KnownPoints, gsd: float) -> bool:
    """Whether known points lie nearer to a mesh than to the same mesh after a move.

    It uses the signed-rank test (Wilcoxon 1945). Few points never deny a move. (The test of
    scipy.stats takes most of a second to import.)
    """
    (far, _, on_moved), (near, _, on_mesh) = (
        _offsets(surface, known, gsd) for surface in (moved, mesh)
    )
    both = on_moved & on_mesh
    if both.sum() < MIN_POINTS:
        return False
    change = np.abs(far[both]) - np.abs(near[both])
    change = change[change != 0]
    num = len(change)
    farther = np.flatnonzero(change[np.argsort(np.abs(change))] > 0) + 1
    mean, variance = num * (num + 1) / 4, num * (num + 1) * (2 * num + 1) / 24
    return bool(farther.sum() - mean > special.ndtri(SIGNIFICANCE) * np.sqrt(variance))


def _offsets(
    mesh: TriangleMesh, known: KnownPoints, gsd: float
) -> tuple[Array, NDArray[np.int64], Mask]:
    """Distance (N,) of a surface outside of points, the faces there, and which points are on it."""
    if not len(known.points):
        return np.zeros(0), np.zeros(0, np.int64), np.zeros(0, np.bool_)
    place, face, _ = RayScene(mesh).closest(known.points)
    offset = dots(place - known.points, mesh.face_normals[face])
    # Points farther than the width of the hull's cells are not on the surface.
    return offset, face, np.abs(offset) < HullTolerances.step_px * gsd


def share_off(
    mesh: TriangleMesh,
    known: KnownPoints,
    views: Sequence[SurfaceView],
    outside: Mapping[str, Mask] = MappingProxyType({}),
) -> float | None:
    """Share of the known points within the silhouettes that are off a surface; None with few.

    Off is farther than an edge and than three deviations of the point. Single points are on mirror
    images; many off the surface contradict it. ``outside`` are pixels (H, W) of views, by name,
    that show what a box cut away.
    """
    num_seen, num_inside = np.zeros((2, len(known.points)))
    for view in views:
        xy = view.view.project(known.points)
        shown = view.silhouette.certain | view.silhouette.possible
        shown = grow_mask(shown, 2)  # a point of the outline is inside
        if view.view.name in outside:
            shown &= ~outside[view.view.name]
        num_seen += in_image(view.view.camera, xy)
        num_inside += sample_image(shown.astype(np.float32), xy, nearest=True) > 0
    # A point of an object lies in its silhouettes, hidden or not; 5 % may be wrong.
    of_object = (num_seen > 0) & (num_inside >= 0.95 * num_seen)
    if of_object.sum() < 2 * MIN_POINTS or not len(mesh.faces):
        return None
    points, sigma = known.points[of_object], known.sigma[of_object]
    place, _, _ = RayScene(mesh).closest(points)
    limit = np.maximum(mesh.mean_edge, 3 * sigma)
    return float(np.mean(lengths(place - points) > limit))


def point_offset(
    mesh: TriangleMesh, supported: Mask, sigma: Array, known: KnownPoints, gsd: float
) -> tuple[float, float]:
    """Distance of a surface outside of the known points on it.

    Parameters
    ----------
    mesh, supported : the surface, with V vertices and F faces; (F,) those that are kept.
    sigma : (V,) its stated deviation, world units.
    known : points of the surface.
    gsd : ground sampling distance, world units.

    Returns
    -------
    The median, in GSD, and the same in standard deviations; 0 if few points are near.
    """
    if len(known.points) < MIN_POINTS or not supported.any():
        return 0.0, 0.0
    mesh = TriangleMesh(mesh.vertices, mesh.faces[supported])
    offset, face, near = _offsets(mesh, known, gsd)
    stated = np.median(sigma[mesh.faces[face]], axis=1)
    near &= np.isfinite(stated)
    if near.sum() < MIN_POINTS:
        return 0.0, 0.0
    offset, middle = offset[near], float(np.median(offset[near]))
    # The deviation of a median of normal errors is 1.25 deviations over the root of their number.
    own = max(robust_deviation(offset - middle), float(np.median(known.sigma[near])))
    noise = np.hypot(1.25 * own / np.sqrt(len(offset)), np.median(stated[near]))
    return middle / gsd, middle / max(float(noise), 1e-300)
