"""The metric frame from what the options name: files of known cameras, images with markers."""

from __future__ import annotations

import json
import logging
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.config import ReferenceOptions
from polmvs.errors import DataError
from polmvs.poses.marker_size import measure_markers
from polmvs.poses.markers import detect_markers, parse_marker_option
from polmvs.poses.metric_frame import (
    Frame,
    frame_from_centers,
    frame_from_distance,
    require_agreement,
    scaling,
)
from polmvs.scene import SparseModel

Array = NDArray[np.float64]
ImageLoader = Callable[[str], NDArray[np.uint8]]

logger = logging.getLogger(__name__)

ROTATION_TOLERANCE = 1e-3  # of R R^T from the identity; poses are often written with few digits


def check_reference(options: ReferenceOptions) -> None:
    """Refuse what is wrong with the options or the file, before a model is there.

    Raises
    ------
    DataError, OptionError
        The file is unusable, or the dictionary of markers is unknown.
    """
    if options.reference is not None:
        read_centers(options.reference)
    if options.aruco is not None:
        parse_marker_option(options.aruco)


def metric_frame(
    model: SparseModel, options: ReferenceOptions, load_image: ImageLoader
) -> Frame | None:
    """Metric frame from the sources that the options name; None where they name none.

    Parameters
    ----------
    model : in its own frame.
    options : sources; the first of reference, aruco and scale decides, the others check it.
    load_image : gives the 8-bit intensity image ``(H, W)`` of a view by its name; used for
        markers only.

    Raises
    ------
    DataError
        A source does not fix the scale (too few cameras, no marker, contradictory markers, ...).
    OptionError
        An option is malformed, names what the model lacks, or two sources contradict each other.
    """
    check_reference(options)
    frames = []
    if options.reference is not None:
        centers = read_centers(options.reference)
        frames.append(frame_from_centers(model, centers, options.reference))
    if options.aruco is not None:
        frames.append(frame_from_markers(model, options.aruco, load_image))
    if options.scale is not None:
        frames.append(frame_from_distance(model, *options.scale))
    if not frames:
        return None
    first, *others = frames
    for other in others:
        require_agreement(first, other)
    frame = replace(first, checked_by=tuple((other.source, other.scale) for other in others))
    logger.info("metric scale %.6g m per unit, from %s.", frame.scale, frame.source)
    return frame


def frame_from_markers(model: SparseModel, option: str, load_image: ImageLoader) -> Frame:
    """Scale from printed ArUco markers, ``option`` being ``DICT:SIZE`` with the side in metres.

    Raises
    ------
    DataError
        No marker is found in two views, or markers contradict themselves or each other.
    OptionError
        The option is malformed or the dictionary unknown.
    """
    dictionary, size_m = parse_marker_option(option)
    detections = detect_markers(model.views, dictionary, load_image)
    result = measure_markers(model.views, detections, source=f"--aruco {option}")
    return Frame(
        metric_from_world=scaling(size_m / result.side),
        source="aruco",
        relative_sigma=result.relative_sigma,
        rms_residual=result.rms_residual_px,
        num_used=result.num_views,
        dropped=result.dropped,
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
        text = path.read_text(encoding="utf-8-sig")
    except (OSError, UnicodeDecodeError) as error:
        reason = error.strerror if isinstance(error, OSError) else "it is no text"
        raise DataError(path, f"cannot be read: {reason}.") from error
    centers = parse(path, text)
    if not centers:
        raise DataError(path, "names no camera; give at least three.")
    return centers


def _parse_json(path: Path, text: str) -> dict[str, Array]:
    try:
        content = json.loads(text, object_pairs_hook=_unique_pairs)
    except (ValueError, RecursionError) as error:
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
    rotation = pose[:, :3]
    deviation = np.abs(rotation @ rotation.T - np.eye(3)).max()
    if deviation > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
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
