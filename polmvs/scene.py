"""Types that all stages use: views, names of images, sparse points, seeds, kinds of points."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum
from itertools import compress, pairwise
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats, Mask
from polmvs.camera import Camera
from polmvs.geometry import RigidTransform, dots, lengths

KEYPOINT_SIGMA_PX = 0.5  # of a keypoint of SfM: the usual reprojection error after adjustment
# Between a normal and the direction to the camera. A surface seen flatter than 6 degrees shows a
# tenth of its pixels, and its range changes by ten GSDs a pixel.
MIN_FACING_COSINE = 0.1
# Of a coordinate in any unit, and of a point from a camera that sees it. Guesses: beyond them
# squares lose all that matters, or overflow, and no measurement lies there.
MAX_COORDINATE = 1e12
MIN_DISTANCE = 1e-12
MIN_VIEWS = 3  # views of a point, a normal, a shape: two always agree, right or wrong
MAX_NAMES_SHOWN = 5


@dataclass(frozen=True, kw_only=True)
class View:
    """One posed image.

    Attributes
    ----------
    name : file name of the raw mosaic, also the image's name in the COLMAP model.
    camera : of the half-size polarization image.
    cam_from_world : pose.
    """

    name: str
    camera: Camera
    cam_from_world: RigidTransform

    @property
    def center_in_world(self) -> Array:
        """Camera centre ``(3,)`` in the world."""
        return self.cam_from_world.inverse().translation

    def rays_in_world(self, xy: Floats) -> Array:
        """Unit rays ``(..., 3)`` in the world of image coordinates ``(..., 2)``."""
        return np.asarray(self.camera.rays(xy) @ self.cam_from_world.rotation, np.float64)

    def project(self, points: Floats) -> Floats:
        """Image coordinates ``(..., 2)`` of world points; NaN behind the camera."""
        return self.camera.project(self.cam_from_world * points)

    def ranges(self, points: Floats) -> Array:
        """Distances ``(...)`` of world points from the camera's centre."""
        return lengths(np.asarray(points, np.float64) - self.center_in_world)

    def points_at(self, xy: Floats, ranges: Floats) -> Array:
        """World points ``(..., 3)`` at distances ``(...)`` along the rays of coordinates."""
        in_cam = self.camera.rays(xy) * np.asarray(ranges, np.float64)[..., None]
        return np.asarray(self.cam_from_world.inverse() * in_cam, np.float64)

    def facing_cosines(self, points: Floats, normals: Floats) -> Array:
        """Cosine ``(...)`` between normals and the direction to the camera; NaN where unknown.

        Parameters
        ----------
        points, normals : (..., 3), world, normals unit.
        """
        to_camera = self.center_in_world - np.asarray(points, np.float64)
        along = dots(to_camera, np.asarray(normals, np.float64))
        return np.asarray(along / lengths(to_camera))

    def faces(self, points: Floats, normals: Floats) -> Mask:
        """Whether surface points ``(..., 3)`` with unit normals face the camera; not where NaN."""
        return np.asarray(self.facing_cosines(points, normals) > MIN_FACING_COSINE, np.bool_)


def stem_of(name: str) -> str:
    """Name of an image without folder and suffix."""
    return PurePosixPath(name).stem


def match_names(names: Sequence[str], known: Iterable[str]) -> dict[str, str]:
    """The known name of each image; images without one are left out.

    An equal name goes before the only name with the same stem. A known name is used once, so that
    ``a/0.png`` and ``b/0.png`` do not share a ``0.png``.

    Parameters
    ----------
    names : of the images.
    known : among which each is looked for.
    """
    available = list(dict.fromkeys(known))
    exact = {name: name for name in names if name in set(available)}
    left = [other for other in available if other not in exact]
    stems = Counter(map(stem_of, available))
    own_stems = Counter(map(stem_of, names))
    by_stem = {stem_of(other): other for other in left if stems[stem_of(other)] == 1}
    matched = {
        name: by_stem[stem_of(name)]
        for name in names
        if name not in exact and stem_of(name) in by_stem and own_stems[stem_of(name)] == 1
    }
    return {name: other for name in names if (other := exact.get(name) or matched.get(name))}


def find_name(name: str, known: Iterable[str]) -> str | None:
    """The equal name among some names, else the only one with the same stem."""
    return match_names([name], known).get(name)


def short_list(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    more = len(names) - MAX_NAMES_SHOWN
    return ", ".join(names[:MAX_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")


def evenly_spread(num: int, most: int) -> NDArray[np.int64]:
    """Indices of at most ``most`` of ``num`` things, spread evenly over their order."""
    return np.linspace(0, num - 1, min(num, most)).round().astype(np.int64)


@dataclass(frozen=True)
class Tracks:
    """Sparse points and their observations as flat arrays.

    Attributes
    ----------
    point3D_ids : (T,) int64
    points_in_world : (T, 3) float64
    colors : (T, 3) uint8
    errors : (T,) float64, mean reprojection error, px
    obs_track, obs_view : (O,) int64, indices of a track and of a view
    obs_xy : (O, 2) float64, image coordinates
    """

    point3D_ids: NDArray[np.int64]
    points_in_world: Array
    colors: NDArray[np.uint8]
    errors: Array
    obs_track: NDArray[np.int64]
    obs_view: NDArray[np.int64]
    obs_xy: Array

    def of_views(self, num_views: int) -> list[NDArray[np.int64]]:
        """Indices of the observations of each view, in their order."""
        return _by_owner(self.obs_view, num_views)

    def of_tracks(self) -> list[NDArray[np.int64]]:
        """Indices of the observations of each track, in their order."""
        return _by_owner(self.obs_track, len(self.point3D_ids))

    def in_views(self, kept: Mask) -> Tracks:
        """All tracks with the observations of the chosen ``(V,)`` views, renumbered from 0."""
        index = np.cumsum(kept) - 1
        seen = kept[self.obs_view]
        return replace(
            self,
            obs_track=self.obs_track[seen],
            obs_view=index[self.obs_view[seen]],
            obs_xy=self.obs_xy[seen],
        )


def _by_owner(owners: NDArray[np.int64], num: int) -> list[NDArray[np.int64]]:
    order = np.argsort(owners, kind="stable")
    starts = np.searchsorted(owners[order], np.arange(num + 1))
    return [order[a:b] for a, b in pairwise(starts)]


def some_tracks(tracks: Tracks, chosen: Mask) -> Tracks:
    """The chosen ``(T,)`` tracks with their observations."""
    index = np.cumsum(chosen) - 1
    kept = chosen[tracks.obs_track]
    return Tracks(
        point3D_ids=tracks.point3D_ids[chosen],
        points_in_world=tracks.points_in_world[chosen],
        colors=tracks.colors[chosen],
        errors=tracks.errors[chosen],
        obs_track=index[tracks.obs_track[kept]],
        obs_view=tracks.obs_view[kept],
        obs_xy=tracks.obs_xy[kept],
    )


def point_sigmas(tracks: Tracks, views: Sequence[View]) -> Array:
    """Standard deviation ``(T,)`` of the points along their least certain axis, world units."""
    information = np.zeros((len(tracks.points_in_world), 3, 3))
    for view, own in zip(views, tracks.of_views(len(views)), strict=True):
        seen = tracks.obs_track[own]
        to_point = tracks.points_in_world[seen] - view.center_in_world
        # A point in the camera itself is no measurement, but it must not make all NaN.
        distance = np.maximum(np.linalg.norm(to_point, axis=-1), MIN_DISTANCE)
        ray = to_point / distance[:, None]
        precision = (view.camera.mean_focal_px / (KEYPOINT_SIGMA_PX * distance)) ** 2
        across = np.eye(3) - ray[:, :, None] * ray[:, None, :]
        information[seen] += precision[:, None, None] * across
    smallest = np.maximum(np.linalg.eigvalsh(information)[:, 0], 1e-300)
    return np.asarray(1 / np.sqrt(smallest), np.float64)


@dataclass(frozen=True)
class Seeds:
    """Points of the surface with known position.

    Attributes
    ----------
    points_in_world : (S, 3) float64
    normals_in_world : (S, 3) float64, unit; NaN where unknown.
    sigma : (S,) float64, standard deviation of the position, world units.
    """

    points_in_world: Array
    normals_in_world: Array
    sigma: Array


@dataclass(frozen=True, kw_only=True)
class SparseModel:
    """Posed views and sparse points, free of pycolmap's types.

    Attributes
    ----------
    views : registered images, sorted by name.
    tracks : sparse points; ``obs_view`` counts in ``views``.
    unregistered : names of images without a pose, sorted.
    """

    views: tuple[View, ...]
    tracks: Tracks
    unregistered: tuple[str, ...]


def without_views(model: SparseModel, names: Collection[str]) -> tuple[SparseModel, Mask, Mask]:
    """A model without some of its views, and without points that fewer than two other views see.

    Parameters
    ----------
    names : names of the views to remove; they count as not registered.

    Returns
    -------
    The model; which views (V,) and which tracks (T,) of the former model it has.
    """
    kept = np.array([view.name not in names for view in model.views], np.bool_)
    fewer = model.tracks.in_views(kept)
    enough = np.bincount(fewer.obs_track, minlength=len(fewer.point3D_ids)) >= 2
    out = [view.name for view in model.views if view.name in names]
    changed = SparseModel(
        views=tuple(compress(model.views, kept)),
        tracks=some_tracks(fewer, enough),
        unregistered=tuple(sorted((*model.unregistered, *out))),
    )
    return changed, kept, enough


class PointKind(IntEnum):
    """Kind of a point of a cloud: on a polarized surface, or how it was found in the surroundings.

    ``INFERRED`` is surface that no phase shows: the inner wall of a cavity, inferred to be as
    thick as the wall at its opening.
    """

    SURFACE = 0
    SPARSE = 1
    STEREO = 2
    COLMAP = 3
    INFERRED = 4
