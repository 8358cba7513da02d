"""Errors of dense depth and normal maps against ground truth, pixel by pixel.

Ground truth is known at the centres of the pixels, the maps at the points of a lattice between
them. Inverse depth, which is linear on a plane, is interpolated. A lattice point is compared only
if all pixels about it are on the part and on one surface.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from polmvs.arrays import Array, Image, Mask
from polmvs.camera import sample_image
from polmvs.errors import DataError
from polmvs.evaluation.metrics import THRESHOLDS_M, AngleStats, angular_errors_deg
from polmvs.geometry import SimilarityTransform
from polmvs.io.ground_truth import GroundTruth
from polmvs.poses.alignment import align_views
from polmvs.scene import View
from polmvs.surface.dense_view import DenseView, lattice_xy

# These define the figures; they are no tolerances of an algorithm.
WHOLE_SHARE = 0.999  # of the pixels about a lattice point; interpolation rounds
MAX_SLOPE = 20.0  # depth per width of a pixel's gsd: a surface seen under 3 deg, or a step


@dataclass(frozen=True, kw_only=True)
class MapErrors:
    """Errors of depth and normal maps over the part's pixels of all views together.

    All values except ``outside`` are over the lattice points that are wholly on the part; errors
    are NaN if no such point has a value.

    Attributes
    ----------
    num_pixels : lattice points with a value and ground truth.
    coverage : their share of all lattice points of the part, also in views without a map.
    outside : share of the lattice points with a value that are off the part.
    depth_rmse_m, depth_median_m, depth_p95_m : of the absolute error of depth, m.
    depth_bias_m : mean error, positive behind the surface, m.
    depth_within_1mm : share of the errors below 1 mm.
    normals : angles between normals and ground truth.
    sigma_ratio_median : median of the range's absolute error over its standard deviation; 0.67 for
        normal errors and true deviations.
    within_one_sigma, within_two_sigma : shares of the errors below one and two standard
        deviations; 0.68 and 0.95 likewise.
    normals_within_one_sigma, normals_within_two_sigma : the same shares of the normals' angles;
        NaN in files of earlier versions.
    """

    num_pixels: int
    coverage: float
    outside: float
    depth_rmse_m: float
    depth_median_m: float
    depth_p95_m: float
    depth_bias_m: float
    depth_within_1mm: float
    normals: AngleStats
    sigma_ratio_median: float
    within_one_sigma: float
    within_two_sigma: float
    normals_within_one_sigma: float = float("nan")
    normals_within_two_sigma: float = float("nan")


@dataclass(frozen=True, kw_only=True, eq=False)
class LatticeErrors:
    """Errors of one view at the points (h, w) of its lattice.

    Attributes
    ----------
    on_part : bool, points wholly on one surface of the part.
    off_part : bool, points off the part.
    known : bool, points with a range.
    depth_m : error of the depth, positive behind the surface, m; NaN where not ``on_part`` or not
        ``known``.
    sigma_m : standard deviation that the view states for it, m; NaN likewise.
    normal_deg : angle between the normal and the true one, degrees; NaN likewise.
    normal_sigma_deg : standard deviation that the view states for it, degrees; NaN likewise.
    """

    on_part: Mask
    off_part: Mask
    known: Mask
    depth_m: Array
    sigma_m: Array
    normal_deg: Array
    normal_sigma_deg: Array


class _Truth(NamedTuple):
    """Truth of one view at the points (h, w) of a lattice, camera frame, m."""

    on_part: Mask  # wholly, and of one surface
    off_part: Mask  # wholly
    depth: Array
    normals: Image  # of any length


def map_errors(
    views: Sequence[View], dense: Sequence[DenseView | None], truth: GroundTruth
) -> MapErrors:
    """Compare dense views with the true depth and normal maps.

    The estimated world is aligned to the true one by the camera centres, which determines the
    scale. Each map is then compared in its own camera, so errors of single poses have no influence.

    Parameters
    ----------
    views : V estimated views, named as in the ground truth; others are ignored.
    dense : V maps of the same views, in the same world; None for a view without maps.
    truth : maps of the same camera.

    Raises
    ------
    DataError
        The cameras do not determine the alignment, or the true maps have another size.
    """
    truth_from_world, _ = align_views(views, truth.views, source=truth.cameras)
    strides = [one.stride_px for one in dense if one is not None]
    found = [
        lattice_errors(view, one, truth, truth_from_world, stride_px=strides[0] if strides else 1)
        for view, one in zip(views, dense, strict=True)
        if truth.find(view.name) is not None
    ]
    return _summary(found)


def lattice_errors(
    view: View,
    dense: DenseView | None,
    truth: GroundTruth,
    truth_from_world: SimilarityTransform,
    *,
    stride_px: int = 1,
) -> LatticeErrors:
    """Compare one dense view with the true maps of its image.

    Parameters
    ----------
    view : estimated, of an image with ground truth.
    dense : its maps; None: all values are unknown.
    truth_from_world : only its scale is used.
    stride_px : of the lattice without maps.

    Raises
    ------
    DataError
        The true maps have another size.
    """
    camera = view.camera
    if dense is None:
        xy = lattice_xy(camera.height // stride_px, camera.width // stride_px, stride_px)
        true, known = _truth_at(xy, view, truth), np.zeros(xy.shape[:2], np.bool_)
        depth_m = sigma_m = normal_deg = normal_sigma_deg = np.full(xy.shape[:2], np.nan)
    else:
        xy = dense.lattice_xy()
        true, known = _truth_at(xy, view, truth), dense.range_map > 0
        compared = known & true.on_part
        z_per_range = truth_from_world.scale * camera.rays(xy)[..., 2]
        in_cam = dense.normals_in_world @ view.cam_from_world.rotation.T
        depth_m = np.where(compared, z_per_range * dense.range_map - true.depth, np.nan)
        sigma_m = np.where(compared, z_per_range * dense.sigma, np.nan)
        normal_deg = np.where(compared, angular_errors_deg(in_cam, true.normals), np.nan)
        normal_sigma_deg = np.where(compared, dense.sigma_deg, np.nan)
    return LatticeErrors(
        on_part=true.on_part,
        off_part=true.off_part,
        known=known,
        depth_m=depth_m,
        sigma_m=sigma_m,
        normal_deg=normal_deg,
        normal_sigma_deg=normal_sigma_deg,
    )


def _truth_at(xy: Array, view: View, truth: GroundTruth) -> _Truth:
    """Interpolate the true maps of a view at image coordinates ``(h, w, 2)``."""
    true = truth.find(view.name)
    assert true is not None
    size, true_size = ((c.width, c.height) for c in (view.camera, true.camera))
    if size != true_size:
        raise DataError(
            truth.folder / "cameras.json",
            f"has images of {true_size[0]}x{true_size[1]} px but the capture's are "
            f"{size[0]}x{size[1]} px; give the ground truth of this capture.",
        )
    depth, mask = truth.depth(true.name), truth.mask(true.name)
    usable = mask & np.isfinite(depth)
    inverse = np.where(usable, 1 / np.where(usable, depth, 1), 0).astype(np.float32)
    mean = sample_image(inverse, xy).astype(np.float64)
    spread = np.sqrt(np.maximum(sample_image(np.square(inverse), xy) - mean**2, 0))
    # Two pixels whose depths differ by a share d deviate by d / 2 from their mean.
    steps = spread > 0.5 * MAX_SLOPE / true.camera.mean_focal_px * mean
    on_part = (sample_image(usable.astype(np.float32), xy) > WHOLE_SHARE) & ~steps
    return _Truth(
        on_part=on_part,
        off_part=sample_image(mask.astype(np.float32), xy) < 1 - WHOLE_SHARE,
        depth=np.where(on_part, 1 / np.where(on_part, mean, 1), np.nan),
        normals=sample_image(np.nan_to_num(truth.normals(true.name)), xy),
    )


def _summary(views: Sequence[LatticeErrors]) -> MapErrors:
    """The figures of all views together."""

    def pooled(values: Callable[[LatticeErrors], Array]) -> Array:
        return np.concatenate(
            [np.zeros(0), *(values(one)[one.known & one.on_part] for one in views)]
        )

    depth, angle = pooled(lambda one: one.depth_m), pooled(lambda one: one.normal_deg)
    size = np.abs(depth)
    ratio = _ratios(size, pooled(lambda one: one.sigma_m))
    angle_ratio = _ratios(angle, pooled(lambda one: one.normal_sigma_deg))
    num_known = sum(int(one.known.sum()) for one in views)
    median, p95 = np.percentile(size, (50, 95)) if len(size) else (np.nan, np.nan)
    return MapErrors(
        num_pixels=len(depth),
        coverage=_ratio(len(depth), sum(int(one.on_part.sum()) for one in views)),
        outside=_ratio(sum(int((one.known & one.off_part).sum()) for one in views), num_known),
        depth_rmse_m=float(np.sqrt(_mean(depth**2))),
        depth_median_m=float(median),
        depth_p95_m=float(p95),
        depth_bias_m=_mean(depth),
        depth_within_1mm=_mean(size < min(THRESHOLDS_M)),
        normals=AngleStats.from_degrees(angle),
        sigma_ratio_median=float(np.median(ratio)) if len(ratio) else float("nan"),
        within_one_sigma=_mean(ratio < 1),
        within_two_sigma=_mean(ratio < 2),
        normals_within_one_sigma=_mean(angle_ratio < 1),
        normals_within_two_sigma=_mean(angle_ratio < 2),
    )


def _ratios(errors: Array, sigma: Array) -> Array:
    """Errors over their standard deviations, where these are known."""
    known = np.isfinite(errors) & np.isfinite(sigma) & (sigma > 0)
    return np.asarray(errors[known] / sigma[known])


def _ratio(part: int, whole: int) -> float:
    return part / whole if whole else float("nan")


def _mean(values: Array | Mask) -> float:
    return float(values.mean()) if len(values) else float("nan")
