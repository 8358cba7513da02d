"""Scale from printed ArUco markers: detection, triangulation and measurement.

The detector gives corners to about a pixel. OpenCV's refinement pulls all corners of a blurred
square inwards by several tenths of a pixel, an error of the scale of about one per cent. So lines
are fitted to the four edges instead: in linear light, where a symmetric blur does not move an edge,
and as planes through the camera's centre, which lens distortion does not bend.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.integrate import trapezoid

from polmvs.arrays import Array, Mask
from polmvs.camera import Camera, sample_image, xy_from_opencv
from polmvs.colmap.sfm import COLMAP_DEFAULTS
from polmvs.errors import DataError, OptionError
from polmvs.fitting import BEYOND_CHANCE, MEDIAN_OF_NORMAL, cauchy_weights, like_most
from polmvs.geometry import intersect_rays
from polmvs.polarization.capture import DISPLAY_GAMMA
from polmvs.poses.alignment import MAX_STARTS
from polmvs.scene import KEYPOINT_SIGMA_PX, View, short_list

Gray = NDArray[np.uint8]

logger = logging.getLogger(__name__)

NUM_SAMPLES = 32  # along each edge, and of the profile across it at each
ROUNDS = 8  # of a fit; each converges in three or four
# Step of numerical derivatives, as a share of the depth. Derived: to either side, truncation errs
# with its square and rounding with its inverse.
DIFFERENCE = float(np.cbrt(np.finfo(np.float64).eps))


@dataclass(frozen=True, kw_only=True)
class EdgeTolerances:
    """Tolerances of the edges of a marker; lengths in px, from the blur of the lens.

    Attributes
    ----------
    corner_share : share of an edge's length next to each corner that is not used; a guess: the blur
        of the other edge reaches there.
    reach_px : of a profile to each side, least and most; a guess: it covers the blur and the
        error of the detector's corners, and ends half-way into the marker's outer module.
    """

    corner_share: float = 0.15
    reach_px: tuple[float, float] = (1.5, 3.0)


@dataclass(frozen=True, kw_only=True)
class TriangulationTolerances:
    """Tolerances of the views that agree on a marker, and of corner errors, px.

    Attributes
    ----------
    huber_px : of the robust loss, and an always allowed error of a view. Derived: a keypoint's
        deviation, larger than the noise of a refined corner (0.1 px) and of a usual pose (0.3 px).
    max_residual_px : largest error. Derived: COLMAP drops observations beyond this.
    min_sigma_px : of a corner; a guess: few residuals can be small by chance.
    """

    huber_px: float = KEYPOINT_SIGMA_PX
    max_residual_px: float = COLMAP_DEFAULTS.filter_max_reproj_error
    min_sigma_px: float = 0.05


@dataclass(frozen=True, kw_only=True)
class ScaleTolerances:
    """Tolerances of the agreement of two measured lengths, and of their uncertainty.

    Attributes
    ----------
    floor : relative difference that is always allowed, in addition to that by the deviations; a
        guess: paper and print are not more exact.
    max_relative_sigma : of a marker's side; a guess.
    """

    floor: float = 0.01
    max_relative_sigma: float = 0.1

    def allowed(self, relative_sigma: float) -> float:
        """Allowed relative difference, given its standard deviation."""
        return max(BEYOND_CHANCE * relative_sigma, self.floor)


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

    Parameters
    ----------
    option : as :class:`polmvs.config.ReferenceOptions` has checked it.

    Raises
    ------
    OptionError
        The dictionary is unknown.
    """
    name, _, size_m = option.rpartition(":")
    known = {key: value for key, value in vars(cv2.aruco).items() if key.startswith("DICT_")}
    if name not in known:
        raise OptionError(
            f"names an unknown dictionary {name!r}; known are {', '.join(known)}.",
            field="reference.aruco",
        )
    return int(known[name]), float(size_m)


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
        An id that an image shows twice is ignored in it, and so is a marker cut by the border.

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
    linear: NDArray[np.float32],
    camera: Camera,
    corners: NDArray[np.floating],
    num_modules: int,
    *,
    tolerances: EdgeTolerances = EdgeTolerances(),
) -> Array:
    """Corners of a black square on white from lines fitted to its four edges.

    Parameters
    ----------
    linear : (H, W) float32, linear light, 1 is white.
    corners : (4, 2), image coordinates, clockwise, good to about a pixel.
    num_modules : width of the square in modules; the profiles must not reach into the next one.

    Returns
    -------
    (4, 2) float64
        NaN where an edge is not found or leaves the image, or a corner moved out of reach.
    """
    sides_px = np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)
    reach = float(np.clip(sides_px.min() / num_modules / 2, *tolerances.reach_px))
    rays = camera.rays(corners)
    for _ in range(ROUNDS):
        edge_xy = _edge_points(linear, camera, rays, reach, tolerances)
        planes = _fit_planes(camera.rays(edge_xy))
        # The corner lies on the edge that ends in it and on the one that begins there.
        rays = np.cross(np.roll(planes, 1, axis=0), planes)
        rays *= np.where(rays[:, 2:] < 0, -1.0, 1.0)
        if not np.isfinite(rays).all():
            return np.full((4, 2), np.nan)
    refined = np.asarray(camera.project(rays), np.float64)
    moved = np.linalg.norm(refined - corners, axis=1)
    return refined if (moved <= np.sqrt(2) * reach).all() else np.full((4, 2), np.nan)


def _edge_points(
    linear: NDArray[np.float32],
    camera: Camera,
    rays: Array,
    reach: float,
    tolerances: EdgeTolerances,
) -> Array:
    """Points ``(4, P, 2)`` on the edges between the corners' rays ``(4, 3)``; NaN where none."""
    beside = tolerances.corner_share
    along = np.linspace(beside, 1 - beside, NUM_SAMPLES)[:, None]
    between = (1 - along) * rays[:, None] + along * np.roll(rays, -1, axis=0)[:, None]
    xy = np.asarray(camera.project(between), np.float64)  # (4, P, 2)
    tangent = np.gradient(xy, axis=1)
    tangent /= np.linalg.norm(tangent, axis=-1, keepdims=True)
    outward = np.stack([tangent[..., 1], -tangent[..., 0]], axis=-1)  # clockwise, y down
    offsets = np.linspace(-reach, reach, NUM_SAMPLES)
    places = xy[..., None, :] + offsets[:, None] * outward[..., None, :]  # (4, P, S, 2)
    height, width = linear.shape
    beyond = np.maximum(0.5 - places, places - [width - 0.5, height - 0.5])
    inside = beyond.reshape(4, NUM_SAMPLES, -1).max(axis=-1) <= 0
    profiles = sample_image(linear, places).astype(np.float64)
    dark = profiles[..., :2].sum(axis=-1) / 2  # the inner end
    bright = profiles[..., -2:].sum(axis=-1) / 2
    step = np.where(inside & (bright > dark), bright - dark, np.nan)
    # A step at x, however blurred, has the area reach - x under its profile.
    area = trapezoid((profiles - dark[..., None]) / step[..., None], offsets, axis=-1)
    return np.asarray(xy + (reach - area)[..., None] * outward)


def _fit_planes(rays: Array) -> Array:
    """Normals ``(4, 3)`` of the planes through the origin nearest the rays ``(4, P, 3)``.

    NaN where less than half of the rays are known.
    """
    valid = np.asarray(np.isfinite(rays).all(axis=-1), np.bool_)
    if (valid.sum(axis=1) < NUM_SAMPLES // 2).any():
        return np.full((4, 3), np.nan)
    rays = np.where(valid[..., None], rays, 0.0)
    weights = valid.astype(np.float64)
    for _ in range(ROUNDS):
        normals = np.linalg.svd(weights[..., None] * rays, full_matrices=False)[2][:, -1]
        residuals = np.abs(np.einsum("epk,ek->ep", rays, normals))
        median = np.nanmedian(np.where(valid, residuals, np.nan), axis=1, keepdims=True)
        # The scale of the Cauchy loss in medians; rays are unit, exact edges have no residual.
        squares = np.square(residuals / np.maximum(median / MEDIAN_OF_NORMAL, 1e-9))
        weights = np.where(valid, cauchy_weights(squares), 0.0)
    return np.asarray(normals)


@dataclass(frozen=True)
class Triangulation:
    """Points seen together by several views.

    Attributes
    ----------
    points : (K, 3) float64, world.
    covariances : (K, 3, 3) float64, of the points, world units squared; errors of the poses count
        as far as they show in the residuals.
    used : (V,) bool, views that agree.
    rms_px : RMS distance between the points' projections and where the used views show them.
    """

    points: Array
    covariances: Array
    used: Mask
    rms_px: float


def triangulate_together(
    views: Sequence[View],
    xy: Array,
    *,
    tolerances: TriangulationTolerances = TriangulationTolerances(),
) -> Triangulation | None:
    """Triangulate points from the majority of views that agree on all of them.

    The start is the pair of views whose intersection the majority confirms best; least squares
    on pixels follows, with a robust loss.

    Parameters
    ----------
    views : V views.
    xy : (V, K, 2), image coordinates of K points in each.

    Returns
    -------
    Triangulation or None
        None where fewer than two views, or no majority of them, agree.
    """
    num = len(views)
    if xy.ndim != 3 or len(xy) != num or xy.shape[2] != 2:
        raise ValueError(f"{xy.shape=} but expected ({num}, K, 2).")
    start = _best_pair(views, xy) if num >= 2 else None
    if start is None:
        return None
    t, points, errors = tolerances, start, _errors(views, start, xy)
    used = like_most(errors, floor=t.huber_px, ceiling=t.max_residual_px)
    for _ in range(ROUNDS):
        if used.sum() < 2 or 2 * used.sum() <= num:
            return None
        for _ in range(ROUNDS):  # of Gauss-Newton
            information, gradient, _ = _normal_equations(views, points, xy, used, t.huber_px)
            points = points - np.linalg.solve(information, gradient[..., None])[..., 0]
        errors, before = _errors(views, points, xy), used
        used = like_most(errors, floor=t.huber_px, ceiling=t.max_residual_px)
        if np.array_equal(used, before):
            break
    if used.sum() < 2 or 2 * used.sum() <= num:
        return None
    information, _, squared = _normal_equations(views, points, xy, used, t.huber_px)
    num_free = 2 * int(used.sum()) * len(points) - 3 * len(points)
    sigma = max(float(np.sqrt(squared.sum() / num_free)), t.min_sigma_px)
    return Triangulation(
        points=points,
        covariances=np.asarray(sigma**2 * np.linalg.inv(information), np.float64),
        used=used,
        rms_px=float(np.sqrt((errors[used] ** 2).mean())),
    )


def _best_pair(views: Sequence[View], xy: Array) -> Array | None:
    """Points ``(K, 3)`` from the two views that the majority agrees with best."""
    centers = np.array([view.center_in_world for view in views])
    rays = np.array([view.rays_in_world(own) for view, own in zip(views, xy, strict=True)])
    pairs = np.array(list(combinations(range(len(views)), 2)))
    if len(pairs) > MAX_STARTS:
        pairs = np.random.default_rng(0).choice(pairs, MAX_STARTS, replace=False)
    pair_rays = rays[pairs].swapaxes(1, 2)  # (P, K, 2, 3)
    pair_centers = np.broadcast_to(centers[pairs][:, None], pair_rays.shape)
    points = intersect_rays(pair_centers, pair_rays)  # (P, K, 3)
    errors = np.array([_errors(views, candidate, xy) for candidate in points])
    majority = max(len(views) // 2 + 1, 2)
    scores = np.partition(errors, majority - 1, axis=1)[:, majority - 1]
    best = int(scores.argmin())
    return points[best] if np.isfinite(scores[best]) else None


def _errors(views: Sequence[View], points: Array, xy: Array) -> Array:
    """RMS distance ``(V,)`` of the points' projections, px; infinite where one is not visible."""
    offsets = np.array([view.project(points) for view in views], np.float64) - xy
    rms = np.sqrt(np.square(offsets).sum(axis=-1).mean(axis=-1))
    return np.where(np.isfinite(rms), rms, np.inf)


def _normal_equations(
    views: Sequence[View], points: Array, xy: Array, used: Mask, huber_px: float
) -> tuple[Array, Array, Array]:
    """Information ``(K, 3, 3)``, gradient ``(K, 3)`` and squared errors ``(V, K)``, weighted."""
    information = np.zeros((len(points), 3, 3))
    gradient = np.zeros((len(points), 3))
    squared = np.zeros(xy.shape[:2])
    for k in map(int, np.flatnonzero(used)):
        residuals, jacobian = _residuals(views[k], points, xy[k])
        error = np.linalg.norm(residuals, axis=-1)
        weight = huber_px / np.maximum(error, huber_px)
        information += np.einsum("k,kai,kaj->kij", weight, jacobian, jacobian)
        gradient += np.einsum("k,kai,ka->ki", weight, jacobian, residuals)
        squared[k] = weight * error**2
    # Rays nearly parallel: a touch of damping keeps the solution finite, the covariance tells.
    trace = np.trace(information, axis1=1, axis2=2)
    return information + 1e-12 * trace[:, None, None] * np.eye(3), gradient, squared


def _residuals(view: View, points: Array, xy: Array) -> tuple[Array, Array]:
    """Errors ``(K, 2)``, px, and their derivatives ``(K, 2, 3)`` by the points in the world."""
    in_cam = np.asarray(view.cam_from_world * points)
    step = DIFFERENCE * np.abs(in_cam[:, 2])
    shifts = step[:, None, None] * np.eye(3)
    ahead = view.camera.project(in_cam[:, None] + shifts)
    behind = view.camera.project(in_cam[:, None] - shifts)
    by_cam = ((ahead - behind) / (2 * step[:, None, None])).swapaxes(1, 2)
    residuals = np.asarray(view.camera.project(in_cam) - xy, np.float64)
    return residuals, np.asarray(by_cam @ view.cam_from_world.rotation, np.float64)


@dataclass(frozen=True, kw_only=True)
class MarkerMeasure:
    """Side of the markers in the model.

    Attributes
    ----------
    side : world units.
    relative_sigma : its standard deviation as a share of it.
    rms_residual_px : of the corners, px.
    num_views : that show at least one of them.
    dropped : what is left out, as ``marker ID in NAME``.
    """

    side: float
    relative_sigma: float
    rms_residual_px: float
    num_views: int
    dropped: tuple[str, ...]


@dataclass(frozen=True)
class _Square:
    """One triangulated marker; ``lengths`` and ``sigmas`` (6,): four sides, two diagonals / √2."""

    marker_id: int
    views: tuple[int, ...]
    rejected: tuple[int, ...]
    rms_px: float
    side: float
    side_sigma: float
    lengths: Array
    sigmas: Array


def measure_markers(
    views: Sequence[View],
    detections: Sequence[Detection],
    *,
    source: str,
    tolerances: ScaleTolerances = ScaleTolerances(),
) -> MarkerMeasure:
    """Common side of the markers, each triangulated from all views that show it.

    Parameters
    ----------
    views : posed.
    detections : of one printed size.
    source : the option, for messages.

    Raises
    ------
    DataError
        No marker is seen in two views that agree, one is not square within its uncertainty and 1 %,
        two differ in size by more than that, or the size is not known to 10 %.
    """
    by_id: dict[int, list[Detection]] = {}
    for detection in detections:
        by_id.setdefault(detection.marker_id, []).append(detection)
    if not by_id:
        raise DataError(
            source,
            f"no such marker is found in the {len(views)} images. Check the dictionary; a marker "
            "needs a white margin and some 20 px or more.",
        )
    squares, faults = [], []
    for marker_id, seen in sorted(by_id.items()):
        square = _measure(views, marker_id, seen, tolerances)
        if isinstance(square, str):
            faults.append(square)
        else:
            squares.append(square)
    if not squares:
        raise DataError(source, f"{faults[0]}. Take more images of it, from several sides.")
    for fault in faults:
        logger.warning("%s: %s; it is left out.", source, fault)
    _require_square(squares, source, tolerances)
    _require_one_size(squares, source, tolerances)
    return _combine(views, squares, source)


def _measure(
    views: Sequence[View], marker_id: int, seen: Sequence[Detection], tolerances: ScaleTolerances
) -> _Square | str:
    """The triangulated marker, or the reason why it is unusable."""
    names = [views[d.view].name for d in seen]
    if len(seen) < 2:
        return f"marker {marker_id} is seen in one view only ({names[0]})"
    result = triangulate_together(
        [views[d.view] for d in seen], np.array([d.corners for d in seen])
    )
    if result is None:
        return f"the {len(seen)} views of marker {marker_id} contradict each other"
    square = _square(marker_id, seen, result)
    relative_sigma = square.side_sigma / square.side
    if not relative_sigma <= tolerances.max_relative_sigma:
        return (
            f"the size of marker {marker_id} is known to {100 * relative_sigma:.0f} % only, its "
            f"{int(result.used.sum())} views ({short_list(names)}) are too much alike"
        )
    return square


def _square(marker_id: int, seen: Sequence[Detection], result: Triangulation) -> _Square:
    """Lengths of a triangulated marker, with their standard deviations."""
    ends = np.array([(0, 1), (1, 2), (2, 3), (3, 0), (0, 2), (1, 3)])
    shrink = np.array([1.0, 1.0, 1.0, 1.0, np.sqrt(0.5), np.sqrt(0.5)])  # a square's diagonals
    offsets = result.points[ends[:, 1]] - result.points[ends[:, 0]]
    distances = np.linalg.norm(offsets, axis=1)
    along = offsets / distances[:, None]
    covariances = result.covariances[ends].sum(axis=1)
    sigmas = np.sqrt(np.einsum("li,lij,lj->l", along, covariances, along))
    # Each corner moves the two sides that meet in it.
    pull = (np.roll(along[:4], 1, axis=0) - along[:4]) / 4
    side_variance = np.einsum("ki,kij,kj->", pull, result.covariances, pull)
    return _Square(
        marker_id=marker_id,
        views=tuple(d.view for d, used in zip(seen, result.used, strict=True) if used),
        rejected=tuple(d.view for d, used in zip(seen, result.used, strict=True) if not used),
        rms_px=result.rms_px,
        side=float(distances[:4].mean()),
        side_sigma=float(np.sqrt(side_variance)),
        lengths=distances * shrink,
        sigmas=sigmas * shrink,
    )


def _require_square(squares: Sequence[_Square], source: str, tolerances: ScaleTolerances) -> None:
    for square in squares:
        allowed = np.maximum(BEYOND_CHANCE * square.sigmas, tolerances.floor * square.side)
        if (np.abs(square.lengths - square.side) > allowed).any():
            shares = ", ".join(f"{100 * share:.1f}" for share in square.lengths / square.side)
            raise DataError(
                source,
                f"marker {square.marker_id} is not square: its sides and its diagonals / √2 are "
                f"{shares} % of the mean side. Print it flat and unstretched, or leave it out.",
            )


def _require_one_size(squares: Sequence[_Square], source: str, tolerances: ScaleTolerances) -> None:
    for one, two in combinations(squares, 2):
        sigma = np.hypot(one.side_sigma / one.side, two.side_sigma / two.side)
        ratio = two.side / one.side
        if abs(np.log(ratio)) > tolerances.allowed(float(sigma)):
            raise DataError(
                source,
                f"markers {one.marker_id} and {two.marker_id} differ in size by a factor of "
                f"{ratio:.4g}, their scales contradict each other. Leave out one of them.",
            )


def _combine(views: Sequence[View], squares: Sequence[_Square], source: str) -> MarkerMeasure:
    """Mean of the markers, weighted by their certainty."""
    weights = np.array([square.side_sigma**-2 for square in squares])
    sides = np.array([square.side for square in squares])
    side = float((weights * sides).sum() / weights.sum())
    num_views = np.array([len(square.views) for square in squares])
    squared = np.array([square.rms_px**2 for square in squares])
    dropped = tuple(
        f"marker {square.marker_id} in {views[k].name}"
        for square in squares
        for k in square.rejected
    )
    if dropped:
        logger.warning("%s: does not fit and is left out: %s.", source, short_list(dropped))
    return MarkerMeasure(
        side=side,
        relative_sigma=float(weights.sum() ** -0.5) / side,
        rms_residual_px=float(np.sqrt((num_views * squared).sum() / num_views.sum())),
        num_views=len({k for square in squares for k in square.views}),
        dropped=dropped,
    )
