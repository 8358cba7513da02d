"""Registration of a result to a reference: coarse from many starts, fine by robust least squares.

The fine fit minimizes the distances of the points along the reference's normals, with weights of
Geman and McClure: a dent or a missing part is an outlier without influence.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, replace
from itertools import permutations, product
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from polmvs.arrays import Array
from polmvs.fitting import geman_mcclure_weights, robust_deviation
from polmvs.geometry import SimilarityTransform, dots, lengths
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh


@dataclass(frozen=True, kw_only=True)
class RegistrationTolerances:
    """Tolerances of the registration.

    Attributes
    ----------
    coarse_points, fine_points : number of points of the result to use. They cost time only.
    coarse_steps, fine_steps : of each start, and of the best. More change the result by less than a
        thousandth of the deviation on the captures of the tests.
    num_kept : starts that continue after the first steps. Guess.
    width : of the loss, standard deviations of the residuals; about that of 95 % efficiency.
    last_width_share : initial width of the loss, share of the part's size; it narrows. Guess.
    max_scale_ratio : of an estimated scale to the ratio of the sizes. Guess.
    backward_points : points of the reference whose distances from the result are also used if the
        scale is estimated: otherwise the result would shrink into a flat spot of the reference.
    """

    coarse_points: int = 1500
    fine_points: int = 20_000
    coarse_steps: int = 12
    fine_steps: int = 40
    num_kept: int = 6
    width: float = 3.0
    last_width_share: float = 0.05
    max_scale_ratio: float = 1.5
    backward_points: int = 3000


TOL = RegistrationTolerances()


class Reference(Protocol):
    """A surface to measure distances to."""

    @property
    def points(self) -> Array:
        """Points (M, 3) all over it."""

    def closest(self, points: Array) -> tuple[Array, Array]:
        """The closest points (N, 3) and the unit normals (N, 3) there."""


class MeshReference:
    """A mesh."""

    def __init__(self, mesh: TriangleMesh) -> None:
        self._mesh, self._scene = mesh, RayScene(mesh)
        area = mesh.face_areas
        rng = np.random.default_rng(0)
        face = rng.choice(len(area), size=20_000, p=area / area.sum())
        place = rng.dirichlet(np.ones(3), size=len(face))
        self.points: Array = np.einsum("nk,nkd->nd", place, mesh.corners[face])

    def closest(self, points: Array) -> tuple[Array, Array]:
        """The closest points, and the normals of their faces."""
        place, face, _ = self._scene.closest(points)
        return place, self._mesh.face_normals[face]


class CloudReference:
    """A cloud with normals; the surface is flat between its points."""

    def __init__(self, points: Array, normals: Array) -> None:
        self.points, self._normals = points, normals
        self._tree = cKDTree(points)

    def closest(self, points: Array) -> tuple[Array, Array]:
        """The closest points on the tangent plane of the nearest point."""
        _, index = self._tree.query(points)
        normals = self._normals[index]
        height = dots(points - self.points[index], normals)
        return points - height[:, None] * normals, normals


@dataclass(frozen=True, kw_only=True)
class Registration:
    """Result of a registration.

    Attributes
    ----------
    reference_from_result : the similarity, with scale 1 unless it was estimated.
    covariance : (7, 7) of the rotation (rad, about ``center``), the shift and the scale's
        logarithm.
    center : (3,) of the result after the registration.
    rms : robust standard deviation of the distances, reference's unit.
    runner_up : mean distance of the best other registration over that of this one, which shows an
        ambiguous one; infinite if there is none.
    """

    reference_from_result: SimilarityTransform
    covariance: Array
    center: Array
    rms: float
    runner_up: float

    def distance_sigmas(self, points: Array, normals: Array) -> Array:
        """Standard deviations (N,) of distances by the registration, at registered points."""
        rows = _rows(points - self.center, normals)
        return np.asarray(
            np.sqrt(np.maximum(np.einsum("ni,ij,nj->n", rows, self.covariance, rows), 0))
        )


# Of a result that lies in the reference's frame as it is.
ALIGNED = Registration(
    reference_from_result=SimilarityTransform(
        scale=1.0, rotation=np.eye(3), translation=np.zeros(3)
    ),
    covariance=np.zeros((7, 7)),
    center=np.zeros(3),
    rms=float("nan"),
    runner_up=float("inf"),
)


def register(
    points: Array,
    normals: Array | None,
    reference: Reference,
    *,
    with_scale: bool = False,
) -> Registration:
    """Register points to a reference.

    Parameters
    ----------
    points : (N, 3) of the result.
    normals : (N, 3) unit, outwards; they separate the two sides of thin parts.
    with_scale : also estimate the scale.
    """
    size = float(np.linalg.norm(np.ptp(reference.points, axis=0)))
    whole = _Fit(points, normals, reference, size, with_scale)
    few, more = whole.some(TOL.coarse_points), whole.some(TOL.fine_points)

    def ranked(
        places: Iterable[SimilarityTransform], steps: int
    ) -> list[tuple[float, SimilarityTransform]]:
        refined = [few.refined(place, steps) for place in places]
        return sorted(((few.spread(place), place) for place in refined), key=lambda pair: pair[0])

    found = ranked(_starts(points, reference.points, with_scale=with_scale), 4)
    kept = [place for _, place in found[: TOL.num_kept]]
    found = ranked(kept, TOL.coarse_steps)
    best = more.refined(found[0][1], TOL.fine_steps)
    least = max(found[0][0], 1e-300)
    others = [spread / least for spread, place in found[1:] if _differ(place, found[0][1])]
    return more.described(best, min(others, default=np.inf))


def _starts(points: Array, target: Array, *, with_scale: bool) -> Iterator[SimilarityTransform]:
    """Places with the middle and the main axes of both on each other, in all 24 ways."""
    center, axes, spread = _axes(points)
    onto, target_axes, target_spread = _axes(target)
    scale = target_spread / spread if with_scale else 1.0
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turned = target_axes[:, order] * np.array(signs)
            if np.linalg.det(turned @ axes.T) > 0:
                rotation = turned @ axes.T
                translation = onto - scale * rotation @ center
                yield SimilarityTransform(scale=scale, rotation=rotation, translation=translation)


def _axes(points: Array) -> tuple[Array, Array, float]:
    """Middle, main axes as columns, and radius of points."""
    center = 0.5 * (points.min(axis=0) + points.max(axis=0))
    _, axes = np.linalg.eigh(np.cov(points.T))
    # The middle of the box along these axes depends least on the density of points.
    along = (points - center) @ axes
    center = center + axes @ (0.5 * (along.min(axis=0) + along.max(axis=0)))
    return center, axes, float(np.sqrt(np.mean(lengths(points - center) ** 2)))


@dataclass(frozen=True)
class _Fit:
    """Points (N, 3) of a result, their normals, and what they are registered to, of some size."""

    points: Array
    normals: Array | None
    reference: Reference
    size: float
    with_scale: bool

    def some(self, num: int) -> _Fit:
        """The same with a random choice of the points."""
        index = np.random.default_rng(0).permutation(len(self.points))[:num]
        normals = None if self.normals is None else self.normals[index]
        return replace(self, points=self.points[index], normals=normals)

    def _offsets(self, place: SimilarityTransform) -> tuple[Array, Array, Array, NDArray[np.bool_]]:
        """Moved points, their offsets from the reference, its normals, and which points count."""
        moved = np.asarray(place * self.points)
        closest, normals = self.reference.closest(moved)
        counts = np.ones(len(moved), np.bool_)
        if self.normals is not None:
            counts = dots(self.normals @ np.asarray(place.rotation).T, normals) > 0
        return moved, moved - closest, normals, counts

    def spread(self, place: SimilarityTransform) -> float:
        """Mean distance of the points, those that face the wrong way counted with the largest.

        It includes the mean distance of the reference from them, so that a registration that covers
        only half of it is not better.
        """
        moved, offsets, _, facing = self._offsets(place)
        distance = lengths(offsets)
        missed = cKDTree(moved).query(self.reference.points[::20])[0].mean()
        return float(np.where(facing, distance, distance.max()).mean() + missed)

    def refined(self, place: SimilarityTransform, num_steps: int) -> SimilarityTransform:
        """A place after some steps of weighted least squares."""
        number = 7 if self.with_scale else 6
        size, fitting = self.size, 1.0
        if self.with_scale:
            fitting = _axes(self.reference.points)[2] / _axes(self.points)[2]
        scales = fitting / TOL.max_scale_ratio, fitting * TOL.max_scale_ratio
        for step in range(num_steps):
            moved, offsets, normals, counts = self._offsets(place)
            if counts.sum() < 2 * number:
                return place
            distance = dots(offsets, normals)
            deviation = max(robust_deviation(distance[counts]), 1e-9 * size)
            widest = TOL.last_width_share * size * 0.5 ** min(step, 30)
            width = max(TOL.width * deviation, widest if step < num_steps // 2 else 0.0)
            weights = np.where(counts, geman_mcclure_weights(distance, width**2), 0)
            center = moved.mean(axis=0)
            rows = _rows(moved - center, normals)[:, :number]
            if self.with_scale:
                back = self._backward(moved, center, width)
                share = counts.sum() / max(len(back[1]), 1)
                rows = np.concatenate([rows, back[0]])
                distance = np.concatenate([distance, back[1]])
                weights = np.concatenate([weights, share * back[2]])
            # An undetermined direction, such as the rotation of a disc, does not change.
            length = np.array([size, size, size, 1, 1, 1, size][:number])
            scaled = rows / length
            normal = scaled.T @ (weights[:, None] * scaled)
            normal += 1e-9 * np.trace(normal) / number * np.eye(number)
            change = -np.linalg.solve(normal, scaled.T @ (weights * distance)) / length
            turn = Rotation.from_rotvec(change[:3]).as_matrix()
            factor = 1.0
            if self.with_scale:
                low, high = (limits / place.scale for limits in scales)
                factor = float(np.clip(np.exp(change[6]), low, high))
            arm = factor * turn @ (np.asarray(place.translation) - center)
            place = SimilarityTransform(
                scale=factor * place.scale,
                rotation=turn @ np.asarray(place.rotation),
                translation=arm + center + change[3:6],
            )
        return place

    def _backward(self, moved: Array, center: Array, width: float) -> tuple[Array, Array, Array]:
        """Rows, distances and weights of places on the reference from the nearest points."""
        points = self.reference.points
        chosen = np.random.default_rng(1).permutation(len(points))
        places = points[chosen[: TOL.backward_points]]
        distance, nearest = cKDTree(moved).query(places)
        towards = (moved[nearest] - places) / np.maximum(distance, 1e-300)[:, None]
        weights = geman_mcclure_weights(distance, width**2)
        return _rows(moved[nearest] - center, towards), distance, weights

    def described(self, place: SimilarityTransform, runner_up: float) -> Registration:
        """A place with its uncertainty."""
        moved, offsets, normals, counts = self._offsets(place)
        distance = dots(offsets, normals)
        deviation = robust_deviation(distance[counts])
        loss = geman_mcclure_weights(distance, (3 * deviation) ** 2 or 1e-300)
        weights = np.where(counts, loss, 0)
        center = moved.mean(axis=0)
        number = 7 if self.with_scale else 6
        rows = _rows(moved - center, normals)[:, :number]
        covariance = np.zeros((7, 7))
        information = rows.T @ (weights[:, None] * rows)
        covariance[:number, :number] = deviation**2 * np.linalg.pinv(information)
        return Registration(
            reference_from_result=place,
            covariance=covariance,
            center=center,
            rms=deviation,
            runner_up=runner_up,
        )


def _rows(arms: Array, normals: Array) -> Array:
    """Derivatives (N, 7) of distances by turn, shift and the scale's logarithm."""
    return np.column_stack([np.cross(arms, normals), normals, dots(arms, normals)])


def _differ(first: SimilarityTransform, second: SimilarityTransform) -> bool:
    """Whether two places are turned by more than 5 degrees against each other."""
    relative = np.asarray(first.rotation) @ np.asarray(second.rotation).T
    return bool(np.trace(relative) < 1 + 2 * np.cos(np.radians(5)))
