"""Printed ArUco markers in the images, their corners to a fraction of a pixel.

The detector gives corners to about a pixel, and OpenCV's refinement pulls those of a blurred
square inwards by several tenths of a pixel, all alike, which would make the scale wrong by a
per cent. So lines are fitted to the four edges instead, in linear light, where a symmetric blur
leaves an edge in its place, and as planes through the camera's centre, so that lens distortion
does not bend them.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid

from polmvs.camera import Camera, sample_image, xy_from_opencv
from polmvs.errors import DataError, OptionError
from polmvs.polarization.capture import DISPLAY_GAMMA
from polmvs.scene import View

Array = NDArray[np.float64]
Gray = NDArray[np.uint8]

NUM_PROFILES = 32  # across each edge
NUM_SAMPLES = 25  # of a profile
EDGE_SHARE = 0.15  # of an edge's length beside each corner, where the other edge's blur reaches
MIN_REACH_PX, MAX_REACH_PX = 1.5, 3.0  # of a profile to each side; covers blur and first error
MIN_CONTRAST = 0.02  # of white, in linear light; half a step of 8 bits there is 0.002
REFINEMENTS = 4
ROBUST_ROUNDS = 4


@dataclass(frozen=True)
class Detection:
    """One marker in one view.

    Attributes
    ----------
    marker_id : in the dictionary.
    view : index of the view.
    corners : (4, 2) float64, image coordinates, clockwise from the marker's own first corner.
    """

    marker_id: int
    view: int
    corners: Array


def parse_marker_option(option: str) -> tuple[int, float]:
    """OpenCV's number of a dictionary, and the side in metres, of ``DICT:SIZE``.

    Raises
    ------
    OptionError
        The text is malformed, the size is not positive, or the dictionary is unknown.
    """
    name, _, size_text = option.rpartition(":")
    try:
        size_m = float(size_text)
    except ValueError:
        size_m = np.nan
    if not 0 < size_m < np.inf:
        raise OptionError(f"--aruco needs DICT:SIZE with a positive size in metres, not {option}.")
    known = {key: value for key, value in vars(cv2.aruco).items() if key.startswith("DICT_")}
    if name not in known:
        raise OptionError(f"--aruco: unknown dictionary {name!r}; known are {', '.join(known)}.")
    return int(known[name]), size_m


def detect_markers(
    views: Sequence[View], dictionary: int, load_image: Callable[[str], Gray]
) -> list[Detection]:
    """Find the markers of a dictionary in the images of all views.

    Parameters
    ----------
    dictionary : OpenCV's number, see :func:`parse_marker_option`.
    load_image : gives the intensity image ``(H, W)`` of a view by name, encoded with gamma 2.2.

    Returns
    -------
    list of Detection
        An id that an image shows twice is left out there, as is a marker cut by the border.

    Raises
    ------
    DataError
        An image is not of the camera's size.
    """
    detections = []
    for index, view in enumerate(views):
        image = load_image(view.name)
        if image.shape != (view.camera.height, view.camera.width):
            raise DataError(
                view.name,
                f"the image's (rows, columns) are {image.shape} but its camera has "
                f"{view.camera.height} rows of {view.camera.width} px; give images of that size.",
            )
        for marker_id, corners in find_markers(image, view.camera, dictionary).items():
            detections.append(Detection(marker_id, index, corners))
    return detections


def find_markers(image: Gray, camera: Camera, dictionary: int) -> dict[int, Array]:
    """Refined corners ``(4, 2)``, image coordinates, of the markers in one image, by id."""
    table = cv2.aruco.getPredefinedDictionary(dictionary)
    detector = cv2.aruco.ArucoDetector(table, cv2.aruco.DetectorParameters())
    quads, ids, _ = detector.detectMarkers(image)
    if len(quads) == 0:  # ids is None then
        return {}
    linear = np.power(np.float32(1 / 255) * image, np.float32(DISPLAY_GAMMA))
    num_modules = int(table.markerSize) + 2  # a black frame of one module about the bits
    found: dict[int, Array] = {}
    flat = [int(marker_id) for marker_id in np.ravel(ids)]
    for marker_id, quad in zip(flat, quads, strict=True):
        if flat.count(marker_id) > 1:
            continue
        rough = xy_from_opencv(np.asarray(quad, np.float64).reshape(4, 2))
        corners = refine_corners(linear, camera, rough, num_modules)
        if np.isfinite(corners).all():
            found[marker_id] = np.asarray(corners, np.float64)
    return found


def refine_corners(
    linear: NDArray[np.float32], camera: Camera, corners: NDArray[np.floating], num_modules: int
) -> Array:
    """Corners of a black square on white from lines fitted to its four edges.

    Parameters
    ----------
    linear : (H, W) float32, linear light, 1 is white.
    corners : (4, 2), image coordinates, clockwise, good to about a pixel.
    num_modules : that the square is wide; the profiles must not reach into the next one.

    Returns
    -------
    (4, 2) float64
        NaN where an edge is not found or leaves the image, or a corner moved out of reach.
    """
    sides_px = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    reach = float(np.clip(sides_px.min() / num_modules / 2, MIN_REACH_PX, MAX_REACH_PX))
    rays = camera.rays(corners)
    for _ in range(REFINEMENTS):
        edge_xy = _edge_points(linear, camera, rays, reach)
        planes = _fit_planes(camera.rays(edge_xy))
        # The corner lies on the edge that ends in it and on the one that begins there.
        rays = np.cross(np.roll(planes, 1, axis=0), planes)
        rays *= np.where(rays[:, 2:] < 0, -1.0, 1.0)
        if not np.isfinite(rays).all():
            return np.full((4, 2), np.nan)
    refined = np.asarray(camera.project(rays), np.float64)
    moved = np.linalg.norm(refined - corners, axis=1)
    return refined if (moved <= np.sqrt(2) * reach).all() else np.full((4, 2), np.nan)


def _edge_points(linear: NDArray[np.float32], camera: Camera, rays: Array, reach: float) -> Array:
    """Points ``(4, P, 2)`` on the edges between the corners' rays ``(4, 3)``; NaN where none."""
    along = np.linspace(EDGE_SHARE, 1 - EDGE_SHARE, NUM_PROFILES)[:, None]
    between = (1 - along) * rays[:, None] + along * np.roll(rays, -1, axis=0)[:, None]
    xy = np.asarray(camera.project(between), np.float64)  # (4, P, 2)
    tangent = np.gradient(xy, axis=1)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    outward = np.stack([tangent[..., 1], -tangent[..., 0]], axis=-1)  # clockwise, y down
    offsets = np.linspace(-reach, reach, NUM_SAMPLES)
    places = xy[..., None, :] + offsets[:, None] * outward[..., None, :]  # (4, P, S, 2)
    height, width = linear.shape
    beyond = np.maximum(0.5 - places, places - [width - 0.5, height - 0.5])
    inside = beyond.reshape(4, NUM_PROFILES, -1).max(axis=-1) <= 0
    profiles = sample_image(linear, places).astype(np.float64)
    dark = profiles[..., :2].sum(axis=-1) / 2  # the inner end
    bright = profiles[..., -2:].sum(axis=-1) / 2
    step = np.where(inside & (bright - dark > MIN_CONTRAST), bright - dark, np.nan)
    # A step at x, however blurred, has the area reach - x under its profile.
    area = trapezoid((profiles - dark[..., None]) / step[..., None], offsets, axis=-1)
    return np.asarray(xy + (reach - area)[..., None] * outward)


def _fit_planes(rays: Array) -> Array:
    """Normals ``(4, 3)`` of the planes through the origin nearest the rays ``(4, P, 3)``.

    NaN where less than half of the rays are known.
    """
    valid = np.asarray(np.isfinite(rays).all(axis=-1), np.bool_)
    if (valid.sum(axis=1) < NUM_PROFILES // 2).any():
        return np.full((4, 3), np.nan)
    rays = np.where(valid[..., None], rays, 0.0)
    weights = valid.astype(np.float64)
    for _ in range(ROBUST_ROUNDS):
        normals = np.linalg.svd(weights[..., None] * rays, full_matrices=False)[2][:, -1]
        residuals = np.abs(np.einsum("epk,ek->ep", rays, normals))
        scale = 3 * np.nanmedian(np.where(valid, residuals, np.nan), axis=1)
        share = residuals / np.maximum(scale, 1e-9).reshape(-1, 1)
        weights = np.where(valid, 1 / (1 + share**2), 0.0)  # Geman and McClure
    return np.asarray(normals)
