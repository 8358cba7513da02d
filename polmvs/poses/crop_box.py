"""The box that a result is cut to, in the frame of the model or of a printed marker."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from polmvs.config import CropOptions
from polmvs.errors import OptionError
from polmvs.geometry import RigidTransform, align_points
from polmvs.poses.markers import detect_markers, parse_marker_option, triangulate_together
from polmvs.scene import View, short_list

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

# Corners of a marker of unit side in its own frame, clockwise from its first, as OpenCV has them.
UNIT_MARKER = np.array([[-0.5, 0.5, 0.0], [0.5, 0.5, 0.0], [0.5, -0.5, 0.0], [-0.5, -0.5, 0.0]])


@dataclass(frozen=True)
class CropBox:
    """A box.

    Attributes
    ----------
    frame_from_world : frame along whose axes its edges lie.
    low, high : (3,), its corners there.
    """

    frame_from_world: RigidTransform
    low: Array
    high: Array

    def contains(self, points: NDArray[np.floating]) -> Mask:
        """Which points (..., 3), world, lie in it."""
        inside = self.frame_from_world * np.asarray(points, np.float64)
        return np.asarray(((inside >= self.low) & (inside <= self.high)).all(axis=-1), np.bool_)

    def require_some(self, points: NDArray[np.floating]) -> Mask:
        """As :meth:`contains`; points (N, 3).

        Raises
        ------
        OptionError
            It holds none of them; says where they are.
        """
        kept = self.contains(points)
        if len(points) and not kept.any():
            inside = self.frame_from_world * np.asarray(points, np.float64)
            corners = np.concatenate([inside.min(axis=0), inside.max(axis=0)])
            text = ",".join(f"{value:.4g}" for value in corners)
            raise OptionError(
                f"holds nothing of the surface, which lies in {text}.", field="crop.box"
            )
        return kept


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
    views : posed, metric where the box is in a marker's frame.
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
    """``marker_from_world`` of the printed markers that two views or more agree on, by id.

    The origin is in a marker's middle, x to its right, y to its top, z out of it; the unit is that
    of the world.

    Parameters
    ----------
    aruco : ``DICT:SIZE``, as the option.

    Raises
    ------
    DataError, OptionError
        An image is not of its camera's size, or the dictionary is unknown.
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
