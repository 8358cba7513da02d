"""True surfaces that contours are measured against."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from polmvs.errors import DataError
from polmvs.experiments.data import Truth
from polmvs.io.ground_truth import GroundTruth
from polmvs.io.layouts import BoardTruth
from polmvs.neighbors import nearest_points

Array = NDArray[np.float64]
Floats = NDArray[np.floating[Any]]

FAR_M = 0.02


class TrueSurface(Protocol):
    """Distance of points to a surface."""

    @property
    def description(self) -> str:
        """What it is, for the record."""

    def heights(self, points: Floats) -> Array:
        """Signed distance (N,) of points (N, 3), true world; positive outside, in its units."""


@dataclass(frozen=True, eq=False)
class PlaneSurface:
    """The plane ``normal . x = offset`` with a unit normal (3,)."""

    normal: Array
    offset: float
    description: str = "plane, exact"

    def heights(self, points: Floats) -> Array:
        """Signed distance (N,) of points (N, 3)."""
        return np.asarray(points @ self.normal - self.offset, np.float64)


@dataclass(frozen=True, eq=False)
class SampledSurface:
    """Points (N, 3) of a surface with unit normals (N, 3): distances are to tangent planes."""

    points: Array
    normals: Array
    spacing: float
    description: str = "tangent plane of the nearest true point"

    def heights(self, points: Floats) -> Array:
        """Signed distance (N,); to the nearest point itself where the surface has ended."""
        distances, nearest = nearest_points(self.points, np.asarray(points, np.float64), far=FAR_M)
        offsets = points - self.points[nearest]
        heights = np.einsum("ij,ij->i", offsets, self.normals[nearest])
        beside = np.sqrt(np.maximum(distances**2 - heights**2, 0)) > 3 * self.spacing
        sign = np.where(heights < 0, -1.0, 1.0)
        return np.asarray(np.where(beside, sign * distances, heights), np.float64)


def open_surface(truth: Truth) -> TrueSurface:
    """The part's surface: exact where the truth tells that it is a plane, else sampled.

    Raises
    ------
    DataError
        The truth has neither.
    """
    if isinstance(truth, BoardTruth):
        return PlaneSurface(truth.normal, truth.offset)
    scene_path = truth.folder / "scene.json"
    if scene_path.is_file():
        try:
            surface = json.loads(scene_path.read_text(encoding="utf-8"))["surface"]
            if surface["type"] == "plane":
                normal = np.array(surface["normal"], np.float64)
                length = float(np.linalg.norm(normal))
                return PlaneSurface(normal / length, float(surface["offset"]) / length)
        except (OSError, ValueError, KeyError, TypeError) as error:
            raise DataError(scene_path, f"does not describe the surface ({error}).") from error
    if not isinstance(truth, GroundTruth):
        raise DataError(truth.folder, "has no surface that contours can be measured against.")
    sampling = truth.surface_points()
    part = sampling.is_part & np.isfinite(sampling.normals).all(axis=1)
    return SampledSurface(
        sampling.points[part], sampling.normals[part].astype(np.float64), sampling.spacing_m
    )
