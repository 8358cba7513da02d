"""Metric scale and frame of a reconstruction, whose own are arbitrary.

Known camera centres give a whole similarity; printed markers and a known distance give the scale
only, and the frame's origin and axes stay. Several sources must agree in scale.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from polmvs.errors import DataError, OptionError
from polmvs.geometry import RigidTransform, SimilarityTransform
from polmvs.poses.alignment import align_cameras, align_residuals
from polmvs.scene import SparseModel, point_sigmas, short_list, some_tracks

Array = NDArray[np.float64]

MIN_CAMERAS = 3
# Rotation about the line through the cameras: centres are good to about 0.1 % of their spread, so
# that a breadth of 1 % leaves it uncertain by 0.1 rad.
MIN_BREADTH = 0.01  # breadth of the camera centres over their length
MAX_TURN_SIGMA = 0.1  # rad, of the same rotation as the residuals tell it
MAX_MISFIT = 0.2  # RMS residual over the cameras' spread; unrelated centres give about 1
SIGMA_LIMIT = 4.0  # standard deviations that two scales may differ by
AGREEMENT_FLOOR = 0.01  # relative difference of two scales that is always allowed


@dataclass(frozen=True, kw_only=True)
class Frame:
    """How the reconstruction's world becomes metric, and how well that is known.

    Attributes
    ----------
    metric_from_world : similarity; for markers and distances a scale about the origin.
    source : ``reference``, ``aruco`` or ``scale``.
    relative_sigma : standard deviation of the scale as a share of it; None where unknown.
    rms_residual : of the camera centres used, m (``reference``), or of the markers' corners, px
        (``aruco``); None for a distance.
    num_used : cameras, or views that show a marker, or ends of the distance.
    dropped : names of cameras left out as inconsistent; for markers ``ID in NAME``.
    checked_by : scales of the other sources that agree, m per world unit.
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


def find_name(name: str, names: Iterable[str]) -> str | None:
    """The one of some names that is meant: the same, else the only one with the same stem."""
    available = set(names)
    if name in available:
        return name
    stem = PurePosixPath(name).stem
    same = [other for other in available if PurePosixPath(other).stem == stem]
    return same[0] if len(same) == 1 else None


def match_names(known: Sequence[str], names: Sequence[str]) -> dict[str, str]:
    """Which of the known names each image has; images without one are left out.

    A known name is used once, so that ``a/0.png`` and ``b/0.png`` do not share a ``0.png``.
    """
    found = {name: find_name(name, known) for name in names}
    matched = {name: other for name, other in found.items() if other is not None}
    owners: dict[str, list[str]] = {}
    for name, other in matched.items():
        owners.setdefault(other, []).append(name)
    return {
        name: other for name, other in matched.items() if name == other or len(owners[other]) == 1
    }


def frame_from_centers(
    model: SparseModel, known_centers: Mapping[str, Array], source: str | Path
) -> Frame:
    """Whole similarity from known camera centres.

    Parameters
    ----------
    known_centers : ``(3,)`` by image name, m; names match exactly, else by stem.
    source : where they came from, for messages.

    Raises
    ------
    DataError
        Fewer than three names match, the centres lie on one line, or they do not fit.
    """
    matched = match_names(list(known_centers), [view.name for view in model.views])
    views = [view for view in model.views if view.name in matched]
    if len(views) < MIN_CAMERAS:
        raise DataError(
            source,
            f"knows {len(views)} of the {len(model.views)} reconstructed images by name, "
            f"{MIN_CAMERAS} are needed; its names are like {next(iter(known_centers))!r}, the "
            f"images' like {model.views[0].name!r}.",
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
    """The cameras must not lie on one line, in neither frame."""
    for points, name in ((known, "known"), (centers, "reconstructed")):
        length, breadth, _ = _extents(points)
        if not breadth > MIN_BREADTH * length:
            raise DataError(
                source,
                f"the {name} centres of the {len(points)} cameras lie on one line (or in one "
                "place), which leaves the rotation open; give cameras beside it, or use --scale.",
            )


def _fit_quality(residuals: Array, known: Array, source: str | Path) -> tuple[float, float]:
    """RMS distance of the cameras from their mean, and standard deviation of a coordinate."""
    num = len(known)
    _, breadth, _ = _extents(known)
    spread = float(np.sqrt(((known - known.mean(axis=0)) ** 2).sum(axis=1).mean()))
    rms = float(np.sqrt((residuals**2).mean()))
    sigma = float(np.sqrt((residuals**2).sum() / (3 * num - 7)))  # a similarity has 7 parameters
    if rms > MAX_MISFIT * spread or sigma > MAX_TURN_SIGMA * breadth:
        raise DataError(
            source,
            f"the known centres do not fit the {num} reconstructed cameras: RMS {rms:.4g} m at a "
            f"spread of {spread:.4g} m. Are names exchanged, or the axes left-handed?",
        )
    return spread, sigma


def frame_from_distance(model: SparseModel, first: str, second: str, distance_m: float) -> Frame:
    """Scale from the distance between two cameras (image names) or sparse points (ids).

    Raises
    ------
    OptionError
        An end is unknown, or the two are one, or their distance in the model is none.
    """
    if not 0 < distance_m < np.inf:
        raise OptionError(f"--scale needs a positive distance, not {distance_m}.")
    ends = [_end_of_distance(model, text) for text in (first, second)]
    offset = ends[1][0] - ends[0][0]
    distance = float(np.linalg.norm(offset))
    # Coordinates are of the size of the scene: below this their difference is rounding.
    rounding = 1e-9 * max(float(np.abs(end).max()) for end, _ in ends)
    if not distance > rounding:
        raise OptionError(f"--scale: {first} and {second} are at one place in the model.")
    sigmas = [sigma for _, sigma in ends]
    known = [sigma**2 for sigma in sigmas if sigma is not None]
    return Frame(
        metric_from_world=scaling(distance_m / distance),
        source="scale",
        relative_sigma=float(np.sqrt(sum(known))) / distance if len(known) == 2 else None,
        rms_residual=None,
        num_used=2,
    )


def _end_of_distance(model: SparseModel, text: str) -> tuple[Array, float | None]:
    """Place of a camera or a sparse point, and its standard deviation where it is known."""
    views = {view.name: view for view in model.views}
    name = find_name(text, views)
    if name is not None:
        return views[name].center_in_world, None
    if text.isdecimal():
        chosen = model.tracks.point3D_ids == int(text)
        if chosen.any():
            point = model.tracks.points_in_world[chosen][0]
            return point, float(point_sigmas(some_tracks(model.tracks, chosen), model.views)[0])
    if find_name(text, model.unregistered) is not None:
        raise OptionError(f"--scale: the image {text} has no pose; name another one.")
    raise OptionError(
        f"--scale: {text} is neither a reconstructed image (such as "
        f"{short_list(list(views)[:2])}) nor the id of a sparse point."
    )


def scaling(scale: float) -> SimilarityTransform:
    """A change of unit; the origin and the axes stay."""
    return SimilarityTransform(scale, np.eye(3), np.zeros(3))


def require_agreement(first: Frame, other: Frame) -> None:
    """Two sources must give one scale, within what their uncertainties allow and 1 %.

    Raises
    ------
    OptionError
        They contradict each other.
    """
    sigma = np.hypot(first.relative_sigma or 0.0, other.relative_sigma or 0.0)
    allowed = max(SIGMA_LIMIT * float(sigma), AGREEMENT_FLOOR)
    # The logarithm makes it the same whichever comes first.
    if not abs(np.log(other.scale / first.scale)) <= allowed:
        raise OptionError(
            f"--{first.source} gives a scale of {first.scale:.6g} m per unit but --{other.source} "
            f"{other.scale:.6g}; they may differ by {100 * allowed:.2g} %. Leave out the wrong one."
        )


def transform_model(model: SparseModel, target_from_world: SimilarityTransform) -> SparseModel:
    """The model in another frame; poses stay rigid, so depths scale, and pixels stay.

    Parameters
    ----------
    model : in its own frame.
    target_from_world : such as :attr:`Frame.metric_from_world`.
    """
    views = tuple(
        replace(view, cam_from_world=_transform_pose(view.cam_from_world, target_from_world))
        for view in model.views
    )
    points = target_from_world * model.tracks.points_in_world
    return replace(model, views=views, tracks=replace(model.tracks, points_in_world=points))


def _transform_pose(
    cam_from_world: RigidTransform, target_from_world: SimilarityTransform
) -> RigidTransform:
    """``cam_from_target``, its camera frame in the target's unit."""
    rotation = cam_from_world.rotation @ target_from_world.rotation.T
    translation = (
        target_from_world.scale * cam_from_world.translation
        - rotation @ target_from_world.translation
    )
    return RigidTransform(rotation, translation)
