"""Metric scale and frame of a reconstruction, from references.

Known camera centres give a full similarity. Printed markers and a known distance give only the
scale; origin and axes stay. Several sources must agree in scale.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.config import ReferenceOptions
from polmvs.errors import DataError, OptionError
from polmvs.geometry import SimilarityTransform, nearest_rotation
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import parse_json
from polmvs.poses.alignment import (
    MIN_CAMERAS,
    AlignmentTolerances,
    align_cameras,
    align_residuals,
    spread_of,
)
from polmvs.poses.markers import (
    ScaleTolerances,
    detect_markers,
    measure_markers,
    parse_marker_option,
)
from polmvs.scene import (
    SparseModel,
    find_name,
    match_names,
    point_sigmas,
    short_list,
    some_tracks,
)

ImageLoader = Callable[[str], NDArray[np.uint8]]

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class FrameTolerances:
    """Tolerances of a frame from known camera centres.

    Attributes
    ----------
    min_breadth : breadth of the camera centres over their length; derived: centres are exact to
        about 0.1 % of their spread, so with 1 % the rotation about the line through them is
        uncertain by 0.1 rad.
    max_turn_sigma : rad, deviation of this rotation from the residuals. Derived: the relative error
        of points at the side, as by the scale of markers.
    max_relative_rms : RMS residual over the cameras' spread. Derived: that of an alignment.
    """

    min_breadth: float = 0.01
    max_turn_sigma: float = ScaleTolerances.max_relative_sigma
    max_relative_rms: float = AlignmentTolerances.max_relative_rms


TOL = FrameTolerances()


@dataclass(frozen=True, kw_only=True)
class Frame:
    """Transformation of the reconstruction's world to metric units, with its uncertainty.

    Attributes
    ----------
    metric_from_world : similarity; for markers and distances a scale about the origin.
    source : ``reference``, ``aruco`` or ``scale``.
    relative_sigma : relative standard deviation of the scale; None if unknown.
    rms_residual : of the camera centres used, m (``reference``), or of the markers' corners, px
        (``aruco``); None for a distance.
    num_used : cameras, or views that show a marker, or ends of the distance.
    dropped : names of cameras left out as inconsistent; for markers ``ID in NAME``.
    checked_by : scales of the other sources, which agree, m per world unit.
    """

    metric_from_world: SimilarityTransform
    source: str
    relative_sigma: float | None
    rms_residual: float | None
    num_used: int
    dropped: tuple[str, ...] = ()
    checked_by: tuple[tuple[str, float], ...] = ()

    @property
    def scale(self) -> float:
        """Metres per unit of the reconstruction's world."""
        return self.metric_from_world.scale


def metric_frame(
    sparse_model: SparseModel, options: ReferenceOptions, load_image: ImageLoader
) -> Frame | None:
    """Metric frame from the sources of the options; None without a source.

    Parameters
    ----------
    sparse_model : in its own frame.
    options : sources; the first of reference, aruco and scale decides, the others check it.
    load_image : gives the 8-bit intensity image ``(H, W)`` of a view by its name; used for
        markers only.

    Raises
    ------
    DataError
        A source does not determine the scale (too few cameras, no marker, contradictory markers,
        ...).
    OptionError
        An option is malformed, names what the model lacks, or two sources contradict each other.
    """
    frames = []
    if options.reference is not None:
        centers = read_centers(options.reference)
        frames.append(frame_from_centers(sparse_model, centers, options.reference))
    if options.aruco is not None:
        frames.append(frame_from_markers(sparse_model, options.aruco, load_image))
    if options.scale is not None:
        frames.append(frame_from_distance(sparse_model, *options.scale))
    if not frames:
        return None
    first, *others = frames
    for other in others:
        require_agreement(first, other)
    frame = replace(first, checked_by=tuple((other.source, other.scale) for other in others))
    logger.info("metric scale %.6g m per unit, from %s.", frame.scale, frame.source)
    return frame


def frame_from_markers(sparse_model: SparseModel, option: str, load_image: ImageLoader) -> Frame:
    """Scale from printed ArUco markers, ``option`` being ``DICT:SIZE`` with the side in metres.

    Raises
    ------
    DataError
        No marker is found in two views, or markers contradict each other.
    OptionError
        The option is malformed or the dictionary unknown.
    """
    dictionary, size_m = parse_marker_option(option)
    detections = detect_markers(sparse_model.views, dictionary, load_image)
    result = measure_markers(sparse_model.views, detections, source=f"`reference.aruco` {option}")
    return Frame(
        metric_from_world=scaling(size_m / result.side),
        source="aruco",
        relative_sigma=result.relative_sigma,
        rms_residual=result.rms_residual_px,
        num_used=result.num_views,
        dropped=result.dropped,
    )


def frame_from_centers(
    sparse_model: SparseModel,
    known_centers: Mapping[str, Array],
    source: str | Path,
) -> Frame:
    """Whole similarity from known camera centres.

    Parameters
    ----------
    known_centers : ``(3,)`` by image name, m; names match exactly, else by stem.
    source : their origin, for messages.

    Raises
    ------
    DataError
        Fewer than three names match, the centres lie on one line, or they do not fit.
    """
    matched = match_names([view.name for view in sparse_model.views], known_centers)
    views = [view for view in sparse_model.views if view.name in matched]
    if len(views) < MIN_CAMERAS:
        raise DataError(
            source,
            f"knows {len(views)} of the {len(sparse_model.views)} reconstructed images by name, "
            f"{MIN_CAMERAS} are needed; its names are like {next(iter(known_centers))!r}, the "
            f"images' like {sparse_model.views[0].name!r}.",
        )
    centers = np.array([view.center_in_world for view in views])
    known = np.array([known_centers[matched[view.name]] for view in views])
    _require_breadth(centers, known, source)
    try:
        transform, used = align_cameras(centers, known)
    except ValueError as error:
        raise DataError(source, f"cameras cannot be aligned: {error}") from error
    _require_breadth(centers[used], known[used], source)
    residuals = align_residuals(transform, centers[used], known[used])
    spread, sigma = _fit_quality(residuals, known[used], source)
    return Frame(
        metric_from_world=transform,
        source="reference",
        relative_sigma=sigma / (spread * float(np.sqrt(used.sum()))),
        rms_residual=float(np.sqrt((residuals**2).mean())),
        num_used=int(used.sum()),
        dropped=tuple(v.name for v, is_used in zip(views, used, strict=True) if not is_used),
    )


def _extents(points: Array) -> Array:
    """Root of the sums of squares ``(3,)`` along the principal axes, the longest first."""
    centered = points - points.mean(axis=0)
    return np.asarray(np.linalg.svd(np.vstack([centered, np.zeros((3, 3))]), compute_uv=False))


def _require_breadth(centers: Array, known: Array, source: str | Path) -> None:
    """Refuse cameras on one line, in either frame."""
    for points, name in ((known, "known"), (centers, "reconstructed")):
        length, breadth, _ = _extents(points)
        if not breadth > TOL.min_breadth * length:
            raise DataError(
                source,
                f"the {name} centres of the {len(points)} cameras lie on one line (or in one "
                "place), which leaves the rotation open; give cameras beside it, or use "
                "`reference.scale`.",
            )


def _fit_quality(residuals: Array, known: Array, source: str | Path) -> tuple[float, float]:
    """RMS distance of the cameras from their mean, and standard deviation of a coordinate."""
    num = len(known)
    _, breadth, _ = _extents(known)
    spread = spread_of(known)
    rms = float(np.sqrt((residuals**2).mean()))
    sigma = float(np.sqrt((residuals**2).sum() / (3 * num - 7)))  # a similarity has 7 parameters
    if rms > TOL.max_relative_rms * spread or sigma > TOL.max_turn_sigma * breadth:
        raise DataError(
            source,
            f"the known centres do not fit the {num} reconstructed cameras: RMS {rms:.4g} m at a "
            f"spread of {spread:.4g} m. Are names exchanged, or the axes left-handed?",
        )
    return spread, sigma


def frame_from_distance(
    sparse_model: SparseModel, first: str, second: str, distance_m: float
) -> Frame:
    """Scale from the distance between two cameras (image names) or sparse points (ids).

    Raises
    ------
    OptionError
        An end is unknown, or both ends are the same, or their distance in the model is 0.
    """
    ends = [_end_of_distance(sparse_model, text) for text in (first, second)]
    offset = ends[1][0] - ends[0][0]
    distance = float(np.linalg.norm(offset))
    # Coordinates are of the size of the scene: below this their difference is rounding.
    rounding = 1e-9 * max(float(np.abs(end).max()) for end, _ in ends)
    if not distance > rounding:
        raise OptionError(
            f"names {first} and {second}, which are at one place in the model.",
            field="reference.scale",
        )
    sigmas = [sigma for _, sigma in ends]
    known = [sigma**2 for sigma in sigmas if sigma is not None]
    return Frame(
        metric_from_world=scaling(distance_m / distance),
        source="scale",
        relative_sigma=float(np.sqrt(sum(known))) / distance if len(known) == 2 else None,
        rms_residual=None,
        num_used=2,
    )


def _end_of_distance(sparse_model: SparseModel, text: str) -> tuple[Array, float | None]:
    """Place of a camera or a sparse point, and its standard deviation where it is known."""
    views = {view.name: view for view in sparse_model.views}
    name = find_name(text, views)
    if name is not None:
        return views[name].center_in_world, None
    if text.isdecimal():
        chosen = sparse_model.tracks.point3D_ids == int(text)
        if chosen.any():
            point = sparse_model.tracks.points_in_world[chosen][0]
            return point, float(
                point_sigmas(some_tracks(sparse_model.tracks, chosen), sparse_model.views)[0]
            )
    if find_name(text, sparse_model.unregistered) is not None:
        raise OptionError(
            f"names the image {text}, which has no pose; name another one.",
            field="reference.scale",
        )
    raise OptionError(
        f"names {text}, which is neither a reconstructed image (such as "
        f"{short_list(list(views)[:2])}) nor the id of a sparse point.",
        field="reference.scale",
    )


def scaling(scale: float) -> SimilarityTransform:
    """A change of unit; origin and axes stay."""
    return SimilarityTransform(scale, np.eye(3), np.zeros(3))


def require_agreement(first: Frame, other: Frame) -> None:
    """Refuse two sources whose scales differ by more than their uncertainties and 1 %.

    Raises
    ------
    OptionError
        The sources contradict each other.
    """
    sigma = np.hypot(first.relative_sigma or 0.0, other.relative_sigma or 0.0)
    allowed = ScaleTolerances().allowed(float(sigma))
    # The logarithm makes it the same whichever comes first.
    if not abs(np.log(other.scale / first.scale)) <= allowed:
        raise OptionError(
            f"gives a scale of {first.scale:.6g} m per unit but `reference.{other.source}` "
            f"{other.scale:.6g}; they may differ by {100 * allowed:.2g} %. Leave out the wrong "
            "one.",
            field=f"reference.{first.source}",
        )


def transform_model(
    sparse_model: SparseModel, target_from_world: SimilarityTransform
) -> SparseModel:
    """The model in another frame; poses stay rigid, so depths scale and pixels do not change.

    Parameters
    ----------
    sparse_model : in its own frame.
    target_from_world : such as :attr:`Frame.metric_from_world`.
    """
    views = tuple(
        replace(view, cam_from_world=target_from_world.pose(view.cam_from_world))
        for view in sparse_model.views
    )
    points = target_from_world * sparse_model.tracks.points_in_world
    return replace(
        sparse_model, views=views, tracks=replace(sparse_model.tracks, points_in_world=points)
    )


def read_centers(path: str | Path) -> dict[str, Array]:
    """Read known camera centres by image name.

    Parameters
    ----------
    path : ``.json``: ``{"images": {name: {"center": [x, y, z]}}}``, or with ``cam_from_world``
        (3x4) in the place of ``center``, or ``{name: [x, y, z]}``. ``.txt``: lines
        ``name x y z``; empty lines and those that begin with ``#`` are skipped.

    Returns
    -------
    dict
        Centres ``(3,)`` float64 in the file's frame and unit, metres by convention.

    Raises
    ------
    DataError
        The file is missing, malformed, names an image twice, or a number is not finite.
    """
    path = Path(path)
    parse = {".json": _parse_json, ".txt": _parse_lines}.get(path.suffix.lower())
    if parse is None:
        raise DataError(
            path, "is neither .json nor .txt; give known camera centres as one of both."
        )
    try:
        text = read_text(path, "utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise DataError(path, f"cannot be read: {reason}.") from error
    centers = parse(path, text)
    if not centers:
        raise DataError(path, "names no camera; give at least three.")
    return centers


def _parse_json(path: Path, text: str) -> dict[str, Array]:
    try:
        content = parse_json(text, _unique_pairs)
    except ValueError as error:
        raise DataError(path, f"cannot be read as JSON ({error}).") from error
    images = content.get("images", content) if isinstance(content, dict) else None
    if not isinstance(images, dict):
        raise DataError(path, "must map image names to camera centres.")
    return {str(name): _center(path, str(name), entry) for name, entry in images.items()}


def _unique_pairs(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; ValueError where a key occurs twice, which JSON itself lets pass."""
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"{twice!r} occurs twice")
    return content


def _center(path: Path, name: str, entry: Any) -> Array:
    """Camera centre of one image's entry."""
    if not isinstance(entry, dict):
        return _numbers(path, name, entry, (3,))
    if "center" in entry:
        return _numbers(path, name, entry["center"], (3,))
    if "cam_from_world" not in entry:
        raise DataError(path, f"{name} has neither center nor cam_from_world.")
    pose = _numbers(path, name, entry["cam_from_world"], (3, 4))
    rotation = nearest_rotation(pose[:, :3])
    if rotation is None:
        raise DataError(path, f"cam_from_world of {name} is no rigid motion.")
    return np.asarray(-rotation.T @ pose[:, 3])


def _numbers(path: Path, name: str, value: Any, shape: tuple[int, ...]) -> Array:
    wanted = "x".join(map(str, shape))
    try:
        array = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise DataError(path, f"{name} needs {wanted} numbers.") from error
    if array.shape != shape:
        raise DataError(path, f"{name} needs {wanted} numbers.")
    if not np.isfinite(array).all():
        raise DataError(path, f"{name} has a number that is not finite.")
    return array


def _parse_lines(path: Path, text: str) -> dict[str, Array]:
    centers: dict[str, Array] = {}
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        parts = line.rsplit(maxsplit=3)  # names may hold spaces
        if len(parts) != 4:
            raise DataError(path, f"line {number} is not of the form: name x y z.")
        name = parts[0].strip()
        if name in centers:
            raise DataError(path, f"line {number} names {name} a second time.")
        centers[name] = _numbers(path, f"line {number}", parts[1:], (3,))
    return centers
