"""Surfaces of synthetic captures, with ray intersection in closed form."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from polmvs.arrays import Array
from polmvs.geometry import dots, unit
from polmvs.scene import MIN_DISTANCE


class Surface(Protocol):
    """Interface of a surface for ray intersection."""

    def intersect(self, origins: Array, rays: Array) -> tuple[Array, Array]:
        """Distances ``(...)`` along unit rays and unit normals ``(..., 3)`` that face them.

        ``origins`` are ``(3,)`` or as ``rays``, ``(..., 3)``. A miss is ``inf``, its normal NaN.
        """


@dataclass(frozen=True, eq=False)
class Plane:
    """A plane, seen from both sides.

    ``extent``: half sides of a rectangle about ``point``; None: unbounded. Its first axis is the
    world's x projected on the plane (y if the normal is along x), see :attr:`axes`.
    """

    point: ArrayLike
    normal: ArrayLike
    extent: tuple[float, float] | None = None

    @property
    def axes(self) -> Array:
        """Unit tangents along the sides, rows ``(2, 3)``; right-handed with the normal."""
        normal = unit(np.asarray(self.normal, np.float64))
        along = np.eye(3)[1 if abs(normal[0]) > 0.99 else 0]
        first = unit(along - (along @ normal) * normal)
        return np.stack([first, np.cross(normal, first)])

    def intersect(self, origins: Array, rays: Array) -> tuple[Array, Array]:
        """See :class:`Surface`."""
        normal = unit(np.asarray(self.normal, np.float64))
        offsets = np.asarray(self.point, np.float64) - origins
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = (offsets @ normal) / (rays @ normal)
        hit = np.isfinite(distance) & (distance > MIN_DISTANCE)
        distance = np.where(hit, distance, np.inf)
        if self.extent is not None:
            position = np.where(hit, distance, 0.0)[..., None] * rays - offsets
            hit &= np.all(np.abs(position @ self.axes.T) <= self.extent, axis=-1)
        return _finish(distance, hit, np.broadcast_to(normal, rays.shape), rays)


@dataclass(frozen=True, eq=False)
class Sphere:
    """A sphere; concave if the camera is inside."""

    center: ArrayLike
    radius: float

    def intersect(self, origins: Array, rays: Array) -> tuple[Array, Array]:
        """See :class:`Surface`."""
        start = np.broadcast_to(origins - np.asarray(self.center, np.float64), rays.shape)
        distance, hit = _quadratic(
            np.ones(rays.shape[:-1]), dots(start, rays), dots(start, start) - self.radius**2
        )
        position = start + np.where(hit, distance, 0.0)[..., None] * rays
        return _finish(distance, hit, position / self.radius, rays)


@dataclass(frozen=True, eq=False)
class Cylinder:
    """The side of a round cylinder, unbounded unless ``half_length`` is given; open at its ends."""

    point: ArrayLike
    axis: ArrayLike
    radius: float
    half_length: float | None = None

    def intersect(self, origins: Array, rays: Array) -> tuple[Array, Array]:
        """See :class:`Surface`."""
        axis = unit(np.asarray(self.axis, np.float64))
        start = np.broadcast_to(origins - np.asarray(self.point, np.float64), rays.shape)
        across = start - (start @ axis)[..., None] * axis
        rays_across = rays - (rays @ axis)[..., None] * axis
        a, b = dots(rays_across, rays_across), dots(across, rays_across)
        c = dots(across, across) - self.radius**2
        limit = np.inf if self.half_length is None else self.half_length

        def within(distance: Array) -> NDArray[np.bool_]:
            along: Array = (start + distance[..., None] * rays) @ axis
            return np.asarray(np.abs(along) <= limit)

        distance, hit = _quadratic(a, b, c, within)
        position = across + np.where(hit, distance, 0.0)[..., None] * rays_across
        return _finish(distance, hit, position / self.radius, rays)


@dataclass(frozen=True, eq=False)
class Group:
    """Several surfaces that occlude each other."""

    surfaces: Sequence[Surface]

    def intersect(self, origins: Array, rays: Array) -> tuple[Array, Array]:
        """See :class:`Surface`."""
        hits = [surface.intersect(origins, rays) for surface in self.surfaces]
        distances = np.stack([distance for distance, _ in hits])
        nearest = np.argmin(distances, axis=0)[None]
        normals = np.stack([normals for _, normals in hits])
        return (
            np.take_along_axis(distances, nearest, axis=0)[0],
            np.take_along_axis(normals, nearest[..., None], axis=0)[0],
        )


def _quadratic(
    a: Array, b: Array, c: Array, inside: Callable[[Array], NDArray[np.bool_]] | None = None
) -> tuple[Array, NDArray[np.bool_]]:
    """Smallest root of ``a t^2 + 2 b t + c`` in front of the camera and ``inside``, and whether."""
    with np.errstate(divide="ignore", invalid="ignore"):
        root = np.sqrt(b * b - a * c)
        # The root of the larger sum first, the other from the product of both: no cancellation.
        far = -(b + np.copysign(root, b)) / a
        near = c / (a * far)
    distance = np.full(a.shape, np.inf)
    for candidate in (far, near):
        usable = np.isfinite(candidate) & (candidate > MIN_DISTANCE)
        if inside is not None:
            usable &= inside(np.where(usable, candidate, 0.0))
        distance = np.where(usable & (candidate < distance), candidate, distance)
    return distance, np.isfinite(distance)


def _finish(
    distance: Array, hit: NDArray[np.bool_], normals: Array, rays: Array
) -> tuple[Array, Array]:
    """Misses to infinity and NaN; unit normals towards the camera."""
    facing = np.where(dots(normals, rays)[..., None] > 0, -normals, normals)
    return np.where(hit, distance, np.inf), np.where(hit[..., None], facing, np.nan)
