"""Directions, rotations, and rigid and similarity transforms.

The transforms mirror ``pycolmap.Rigid3d`` and ``Sim3d``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from polmvs.arrays import Array

Float = TypeVar("Float", bound=np.floating[Any])

ROTATION_TOLERANCE = 1e-3  # of R R^T from the identity: poses are often written with few digits


def dots(first: NDArray[Float], second: NDArray[Float]) -> NDArray[Float]:
    """Scalar products ``(...)`` of vectors ``(..., 3)``, in a third of the time of a sum."""
    return np.asarray(np.einsum("...i,...i->...", first, second))


def lengths(vectors: NDArray[Float]) -> NDArray[Float]:
    """Lengths ``(...)`` of vectors ``(..., 3)``, in a third of the time of ``np.linalg.norm``."""
    return np.asarray(np.sqrt(dots(vectors, vectors)))


def unit(vectors: ArrayLike) -> Array:
    """Vectors ``(..., 3)`` scaled to unit length; NaN for zero vectors."""
    array = np.asarray(vectors, np.float64)
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.asarray(array / np.linalg.norm(array, axis=-1, keepdims=True))


def unit_or_zero(vectors: NDArray[Float]) -> NDArray[Float]:
    """Vectors ``(..., D)`` scaled to unit length; 0 for zero vectors."""
    return np.asarray(vectors / np.maximum(lengths(vectors)[..., None], 1e-300))


def points_on_rays(
    center: NDArray[np.floating], rays: NDArray[np.floating], ranges: NDArray[np.floating]
) -> Array:
    """Points ``(..., 3)`` at distances ``(...)`` from a centre along unit rays ``(..., 3)``."""
    return np.asarray(center + ranges[..., None] * rays, np.float64)


def nearest_rotation(matrix: Array) -> Array | None:
    """The rotation ``(3, 3)`` nearest to a matrix, which may have the rounding of a text file.

    None if the matrix is not finite, not orthonormal to 1e-3, or a reflection.
    """
    if matrix.shape != (3, 3) or not np.isfinite(matrix).all():
        return None
    deviation = np.abs(matrix @ matrix.T - np.eye(3)).max()
    if deviation > ROTATION_TOLERANCE or np.linalg.det(matrix) < 0:
        return None
    left, _, right = np.linalg.svd(matrix)
    return np.asarray(left @ right, np.float64)


def rotation_angle(first: Array, second: Array) -> float:
    """Angle between two orientations ``(3, 3)``, rad; exact for small angles too."""
    # |R - S| (Frobenius) is 2 sqrt(2) sin(angle / 2).
    chord = float(np.linalg.norm(first - second))
    return float(2.0 * np.arcsin(min(chord / np.sqrt(8.0), 1.0)))


@dataclass(frozen=True)
class RigidTransform:
    """``target_from_source``: ``p_in_target = rotation @ p_in_source + translation``.

    Attributes
    ----------
    rotation : (3, 3) float64
    translation : (3,) float64
    """

    rotation: Array
    translation: Array

    def __mul__(self, points: NDArray[np.floating]) -> NDArray[np.floating]:
        """Transform points ``(..., 3)``; float32 stays float32."""
        rotation = self.rotation.astype(points.dtype, copy=False)
        # Three times as fast as with the transpose in place.
        turned: NDArray[np.floating] = points @ np.ascontiguousarray(rotation.T)
        return turned + self.translation.astype(points.dtype, copy=False)

    def inverse(self) -> RigidTransform:
        """``source_from_target``."""
        return RigidTransform(self.rotation.T, -self.rotation.T @ self.translation)


@dataclass(frozen=True)
class SimilarityTransform:
    """``p_in_target = scale * rotation @ p_in_source + translation``."""

    scale: float
    rotation: Array
    translation: Array

    def __mul__(self, points: NDArray[np.floating]) -> Array:
        """Transform points ``(..., 3)``."""
        return self.scale * (np.asarray(points, np.float64) @ self.rotation.T) + self.translation

    def pose(self, cam_from_source: RigidTransform) -> RigidTransform:
        """``cam_from_target`` of a camera in the source; its frame gets the target's unit."""
        rotation = cam_from_source.rotation @ self.rotation.T
        translation = self.scale * cam_from_source.translation - rotation @ self.translation
        return RigidTransform(rotation, translation)


def align_points(source: Array, target: Array) -> SimilarityTransform:
    """Least-squares similarity that takes ``source`` to ``target`` (Umeyama 1991).

    Parameters
    ----------
    source, target : (N, 3), N >= 3, not all on one line.

    Raises
    ------
    ValueError
        For fewer than three points, or points that leave the rotation undetermined.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"{source.shape=}, {target.shape=} but expected two (N, 3).")
    source_centered = source - source.mean(axis=0)
    target_centered = target - target.mean(axis=0)
    left, singular, right = np.linalg.svd(target_centered.T @ source_centered)
    if len(source) < 3 or singular[1] <= 1e-9 * max(singular[0], 1e-300):
        raise ValueError("alignment needs at least three points that are not on one line.")
    sign = np.array([1.0, 1.0, np.sign(np.linalg.det(left @ right))])
    rotation = (left * sign) @ right
    scale = float((singular * sign).sum() / (source_centered**2).sum())
    translation = target.mean(axis=0) - scale * rotation @ source.mean(axis=0)
    return SimilarityTransform(scale, rotation, translation)


def intersect_rays(centers: Array, rays: Array) -> Array:
    """Points nearest to rays in the least-squares sense.

    Parameters
    ----------
    centers : (..., V, 3), where the rays begin.
    rays : (..., V, 3), unit.

    Returns
    -------
    (..., 3) float64
        NaN where the rays are parallel or not known.
    """
    across = np.eye(3) - rays[..., :, None] * rays[..., None, :]
    matrix = across.sum(axis=-3)
    target = np.einsum("...vij,...vj->...i", across, centers)
    known = np.isfinite(matrix).all(axis=(-2, -1)) & np.isfinite(target).all(axis=-1)
    matrix = np.where(known[..., None, None], matrix, np.eye(3))
    parallel = np.linalg.eigvalsh(matrix)[..., 0] < 1e-12
    matrix = np.where(parallel[..., None, None], np.eye(3), matrix)
    points = np.linalg.solve(matrix, target[..., None])[..., 0]
    return np.where((parallel | ~known)[..., None], np.nan, points)
