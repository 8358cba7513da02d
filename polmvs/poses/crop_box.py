"""The crop box of a result, in the frame of the model or of a printed marker."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog
from scipy.spatial import ConvexHull, QhullError

from polmvs.arrays import Array, Mask
from polmvs.camera import pixel_centers
from polmvs.config import CropOptions
from polmvs.errors import OptionError
from polmvs.geometry import RigidTransform, align_points
from polmvs.poses.markers import detect_markers, parse_marker_option, triangulate_together
from polmvs.scene import View, short_list

MOST = (2, 98)  # percentiles of the coordinates of sparse points for messages
# Corners of a marker of unit side in its own frame, clockwise from its first, in OpenCV's order.
UNIT_MARKER = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


@dataclass(frozen=True)
class CropBox:
    """A box.

    Attributes
    ----------
    frame_from_world : its edges are parallel to the axes of this frame.
    low, high : (3,), its corners there.
    """

    frame_from_world: RigidTransform
    low: Array
    high: Array

    def contains(self, points: NDArray[np.floating]) -> Mask:
        """Which points (..., 3), world, are in the box."""
        inside = self.frame_from_world * np.asarray(points, np.float64)
        return np.asarray(((inside >= self.low) & (inside <= self.high)).all(axis=-1), np.bool_)

    def misses(self, view: View) -> Mask:
        """Pixels (H, W) of a view whose rays do not meet the box."""
        height, width = view.camera.height, view.camera.width
        rays = view.rays_in_world(pixel_centers(width, height).reshape(-1, 2))
        along = rays @ np.asarray(self.frame_from_world.rotation).T
        along = np.where(along == 0, np.finfo(np.float64).tiny, along)
        center = np.asarray(self.frame_from_world * view.center_in_world)
        with np.errstate(over="ignore"):
            ends = np.sort([(side - center) / along for side in (self.low, self.high)], axis=0)
        enters, leaves = ends[0].max(axis=-1), ends[1].min(axis=-1)
        return np.asarray((leaves < np.maximum(enters, 0)).reshape(height, width))

    def require_possible(self, points: NDArray[np.floating], centers: Array) -> Mask:
        """Refuse a box that cannot contain anything that the cameras see.

        A box may contain a surface without sparse points. But such a surface lies between sparse
        points and the cameras, or among the points.

        Parameters
        ----------
        points : (N, 3), sparse ones, world.
        centers : (V, 3), of the cameras, world.

        Returns
        -------
        (N,), which of the points lie in the box.

        Raises
        ------
        OptionError
            The box is outside of all points; the message says where they are.
        """
        kept = self.contains(points)
        scene = np.asarray(self.frame_from_world * np.concatenate([points, centers]))
        if not kept.any() and not self._meets_hull(scene):
            near = np.asarray(self.frame_from_world * np.asarray(points, np.float64))
            text = _corners(np.percentile(near, MOST, axis=0)) if len(near) else "no place"
            raise OptionError(
                f"lies beside all that the cameras see: most sparse points lie in {text}. Is it in "
                "the unit and the frame of this model?",
                field="crop.box",
            )
        return kept

    def _meets_hull(self, points: Array) -> bool:
        """Whether the box meets the convex hull of points (N, 3) in its frame."""
        try:
            planes = ConvexHull(points).equations
        except (QhullError, ValueError):  # in one plane: its box is the next best
            low, high = points.min(axis=0), points.max(axis=0)
            return bool(((self.low <= high) & (self.high >= low)).all())
        sides = list(zip(self.low, self.high, strict=True))
        found = linprog(np.zeros(3), A_ub=planes[:, :3], b_ub=-planes[:, 3], bounds=sides)
        return bool(found.status != 2)  # 2: there is no such point

    def require_some(self, points: NDArray[np.floating]) -> Mask:
        """As :meth:`contains`; points (N, 3).

        Raises
        ------
        OptionError
            The box contains none of them; the message says where they are.
        """
        kept = self.contains(points)
        if len(points) and not kept.any():
            inside = self.frame_from_world * np.asarray(points, np.float64)
            text = _corners(np.array([inside.min(axis=0), inside.max(axis=0)]))
            raise OptionError(
                f"holds nothing of the surface, which lies in {text}.", field="crop.box"
            )
        return kept


def _corners(ends: Array) -> str:
    """Two corners (2, 3) in the form of the option."""
    return ",".join(f"{value:.4g}" for value in ends.reshape(-1))


def crop_box(
    options: CropOptions,
    aruco: str | None,
    views: Sequence[View],
    load_image: Callable[[str], NDArray[np.uint8]],
) -> CropBox | None:
    """The box of the options; None without one.

    Parameters
    ----------
    aruco : ``DICT:SIZE`` of the markers in the scene, if there are any.
    views : posed, metric if the box is in a marker's frame.
    load_image : gives the 8-bit intensity image ``(H, W)`` of a view by its name.

    Raises
    ------
    OptionError
        The marker is not found.
    """
    if options.box is None:
        return None
    frame = RigidTransform(np.eye(3), np.zeros(3))
    if options.box_marker is not None:
        if aruco is None:
            raise OptionError("needs `reference.aruco`, the markers.", field="crop.box_marker")
        frames = marker_frames(views, aruco, load_image)
        if options.box_marker not in frames:
            known = short_list([str(marker) for marker in frames]) if frames else "none"
            raise OptionError(
                f"is {options.box_marker}, which no two views show; found: {known}.",
                field="crop.box_marker",
            )
        frame = frames[options.box_marker]
    corners = np.reshape(np.asarray(options.box, np.float64), (2, 3))
    return CropBox(frame, corners.min(axis=0), corners.max(axis=0))


def marker_frames(
    views: Sequence[View], aruco: str, load_image: Callable[[str], NDArray[np.uint8]]
) -> Mapping[int, RigidTransform]:
    """``marker_from_world`` of the printed markers on which two views or more agree, by id.

    The origin is the middle of a marker, x to its right, y to its top, z out of it; the unit is
    that of the world.

    Parameters
    ----------
    aruco : ``DICT:SIZE``, as the option.

    Raises
    ------
    DataError, OptionError
        An image has not its camera's size, or the dictionary is unknown.
    """
    dictionary, _ = parse_marker_option(aruco)
    found = detect_markers(views, dictionary, load_image)
    frames = {}
    for marker in sorted({detection.marker_id for detection in found}):
        seen = [detection for detection in found if detection.marker_id == marker]
        square = triangulate_together(
            [views[detection.view] for detection in seen],
            np.array([detection.corners for detection in seen]),
        )
        if square is not None:
            world_from_marker = align_points(UNIT_MARKER, square.points)
            rigid = RigidTransform(world_from_marker.rotation, world_from_marker.translation)
            frames[marker] = rigid.inverse()
    return frames
