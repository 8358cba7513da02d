"""Deviation of a part from its reference: a CAD mesh, a scan, or another run of the part."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.arrays import Array
from polmvs.errors import OptionError
from polmvs.evaluation.registration import ALIGNED, Reference, register
from polmvs.geometry import SimilarityTransform, dots, lengths

UNITS_M: Mapping[str, float] = {"mm": 1e-3, "cm": 1e-2, "m": 1.0, "inch": 0.0254, "um": 1e-6}
PERCENTILES = (1, 5, 25, 50, 75, 95, 99)
# For an inferred unit, the sizes of result and reference may differ by this factor, as if the lower
# side of a part is hidden. Guess; units differ by a factor of 2.5 and more.
SIZE_RATIO = 1.5
AMBIGUOUS = 1.3  # ratio of the second-best mean distance to the best, below which both fit
# Distance beyond which a point is not on the part. Share of the size. Guess.
FAR_SHARE = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class MeasuredPart:
    """A result of which the deviation is measured.

    Attributes
    ----------
    points : (N, 3), metres where ``is_metric``.
    normals : (N, 3) unit, outwards; None where points have none.
    sigma : (N,) standard deviations of the points along their normals, in their unit; None where
        the result states none.
    is_metric : else the scale is estimated, and sizes are not tested.
    """

    points: Array
    normals: Array | None = None
    sigma: Array | None = None
    is_metric: bool = True


@dataclass(frozen=True, kw_only=True)
class DeviationFigures:
    """Statistics of the distances from a reference; lengths in millimetres.

    Attributes
    ----------
    num_points : compared points; ``num_far`` more are not on the part.
    mean, rms, standard_deviation : of the signed distances; positive is outside.
    percentiles : of the signed distances, by percent.
    median_sigma : median of the distances' stated standard deviations; NaN where none is stated.
    significant_share : share of the points farther away than three of these.
    tolerance : given tolerance, and ``share_within`` it.
    least_share : required share within it, and whether that ``passed``; None without a tolerance.
    scale : estimated scale of the result; 1 if it was given.
    unit : of the reference, and whether it was ``unit_inferred``.
    ambiguous : another registration fits about as well, as of a part with rotational symmetry.
    reference_from_result : rows of the 4 x 4 matrix of the registration, in the reference's unit.
    repeatability : if the reference is another run of the part: standard deviation of one run, that
        of the differences of two runs over the square root of two.
    result, reference : compared files; ``result_digest`` identifies the result's content.
    """

    num_points: int
    num_far: int
    mean: float
    rms: float
    standard_deviation: float
    percentiles: dict[str, float]
    median_sigma: float
    significant_share: float
    tolerance: float | None
    share_within: float | None
    least_share: float
    passed: bool | None
    scale: float
    unit: str
    unit_inferred: bool
    ambiguous: bool
    reference_from_result: tuple[tuple[float, ...], ...]
    repeatability: float | None = None
    result: str = ""
    reference: str = ""
    result_digest: str = ""


@dataclass(frozen=True, kw_only=True)
class Deviation:
    """Signed distances of a result's points from a reference, in millimetres.

    Attributes
    ----------
    index : (N,) of the points among the given ones.
    points : (N, 3) registered to the reference, in its unit.
    normals : (N, 3) of the reference there.
    distance : (N,) positive outside.
    sigma : (N,) standard deviation; NaN if the result states none.
    figures : their statistics.
    reference_from_result : the registration.
    """

    index: NDArray[np.intp]
    points: Array
    normals: Array
    distance: Array
    sigma: Array
    figures: DeviationFigures
    reference_from_result: SimilarityTransform


def infer_unit(result_m: Array, reference: Array) -> str:
    """The unit in which a reference (M, 3) has the size of a result (N, 3) in metres.

    Raises
    ------
    OptionError
        No unit fits.
    """
    size_m, size = (float(np.linalg.norm(np.ptp(p, axis=0))) for p in (result_m, reference))
    ratios = {name: size * unit / size_m for name, unit in UNITS_M.items()}
    name = min(ratios, key=lambda key: abs(np.log(ratios[key])))
    if not 1 / SIZE_RATIO < ratios[name] < SIZE_RATIO:
        raise OptionError(
            f"follows from no size: the result spans {1e3 * size_m:.4g} mm, the reference "
            f"{size:.4g} of its unit. Give it.",
            field="arguments.unit",
        )
    return name


def measure_deviation(
    part: MeasuredPart,
    reference: Reference,
    *,
    unit: str | None,
    aligned: bool = False,
    tolerance_mm: float | None = None,
    least_share: float = 1.0,
    other_run: tuple[Array, Array] | None = None,
) -> Deviation:
    """Distances of a result from a reference.

    Parameters
    ----------
    reference : in its ``unit``, one of ``UNITS_M``; None: inferred, of a metric result.
    aligned : the result lies in the frame of the reference.
    tolerance_mm : distance that is allowed either way, and the ``least_share`` of the points that
        must keep to it.
    other_run : where the reference is another run of the part, its points (M, 3) and their
        standard deviations (M,), in the reference's unit: these count as well.

    Raises
    ------
    OptionError
        The unit cannot be inferred.
    """
    inferred = unit is None
    if unit is None:
        if not part.is_metric:
            raise OptionError(
                "is needed: the result has no metric scale to tell it by.", field="arguments.unit"
            )
        unit = infer_unit(part.points, reference.points)
    to_unit = 1 / UNITS_M[unit] if part.is_metric else 1.0
    to_mm = 1e3 * UNITS_M[unit]
    scaled = to_unit * part.points
    found = ALIGNED
    if not aligned:
        found = register(scaled, part.normals, reference, with_scale=not part.is_metric)
    place = found.reference_from_result
    moved = place * scaled
    closest, facing = reference.closest(moved)
    size = float(np.linalg.norm(np.ptp(reference.points, axis=0)))
    near = lengths(moved - closest) < FAR_SHARE * size
    if part.normals is not None:
        near &= dots(part.normals @ place.rotation.T, facing) > 0
    distance = to_mm * dots(moved - closest, facing)[near]
    variance = np.square(found.distance_sigmas(moved, facing))
    if part.sigma is None:
        variance[:] = np.nan
    else:
        variance += np.square(part.sigma * to_unit * place.scale)
    if other_run is not None:
        points, sigma = other_run
        variance += np.square(sigma[cKDTree(points).query(closest)[1]])
    stated = to_mm * np.sqrt(variance[near])
    laid = SimilarityTransform(place.scale * to_unit, place.rotation, place.translation)
    matrix = np.column_stack([laid.scale * laid.rotation, laid.translation])
    return Deviation(
        index=np.flatnonzero(near),
        points=moved[near],
        normals=facing[near],
        distance=distance,
        sigma=stated,
        figures=DeviationFigures(
            **_statistics(distance, stated, tolerance_mm, least_share),
            num_far=int((~near).sum()),
            scale=place.scale if not part.is_metric else 1.0,
            unit=unit,
            unit_inferred=inferred,
            ambiguous=found.runner_up < AMBIGUOUS,
            reference_from_result=(*map(tuple, matrix.tolist()), (0.0, 0.0, 0.0, 1.0)),
            repeatability=None if other_run is None else float(distance.std() / np.sqrt(2)),
        ),
        reference_from_result=laid,
    )


def _statistics(
    distance: Array, sigma: Array, tolerance: float | None, least_share: float
) -> dict[str, Any]:
    """The statistics of distances and their standard deviations."""
    known = np.isfinite(sigma)
    beyond = np.abs(distance[known]) > 3 * sigma[known]
    within = None if tolerance is None else float(np.mean(np.abs(distance) <= tolerance))
    return {
        "num_points": len(distance),
        "mean": float(distance.mean()),
        "rms": float(np.sqrt(np.mean(distance**2))),
        "standard_deviation": float(distance.std()),
        "percentiles": {str(p): float(np.percentile(distance, p)) for p in PERCENTILES},
        "median_sigma": float(np.median(sigma[known])) if known.any() else float("nan"),
        "significant_share": float(beyond.mean()) if known.any() else float("nan"),
        "tolerance": tolerance,
        "share_within": within,
        "least_share": least_share,
        "passed": None if within is None else within >= least_share,
    }
