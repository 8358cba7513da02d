"""Quality checks of a reconstruction with their normal ranges, and its verdict.

They need no ground truth. Some ranges are derived; the others were measured on right and wrong
reconstructions: see :class:`NormalRanges`. Some checks use the data to which the surface was
fitted; those of held-out views and of the mesh are independent.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from types import MappingProxyType

import numpy as np

from polmvs.arrays import Floats, Mask
from polmvs.camera import in_image, sample_image
from polmvs.config import PropagationOptions
from polmvs.evaluation.consistency import (
    MAX_RESIDUAL_POINTS,
    first_seen,
    is_labelled,
    measure_consistency,
    phase_residuals_deg,
    within_box,
)
from polmvs.fitting import MEDIAN_OF_NORMAL
from polmvs.io.clouds import Cloud
from polmvs.normals.tracks import BORDER_MARGIN_PX
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.mask_check import MAX_CUT_SHARE
from polmvs.polarization.phase_map import PhaseMap
from polmvs.polarization.region import grow_mask
from polmvs.scene import PointKind
from polmvs.surface.held_out import Prediction
from polmvs.surface.soundness import Soundness
from polmvs.surface.surface_quality import MAX_OFF, MAX_SHARE

LIGHT_OPTIONS = "`region.light`, `capture.pattern`, `capture.gamma`"
MIN_CHECKED = 4  # views: three make a surface, and one checks it
# Least number of phases for the error of a prediction.
MIN_PHASES = 50


@dataclass(frozen=True, kw_only=True)
class NormalRanges:
    """Ranges (least, most) of the quality checks for right reconstructions.

    Attributes
    ----------
    residual_sigmas : derived: 0.67 if the stated deviations include all errors. Those of a phase
        map include more than noise; errors of an angle model come on top. Right ones have 0.05 to
        0.9, OPA's 6.
    excess_deg : measured, 0 to 0.5; with the light of a glazed figure 2 to 2.7; OPA's 7. The end is
        a guess.
    agreement : measured, 0.95 to 1; 0.65 with `contour` on ``step``, which bridges its parallel
        patches (31 % within a millimetre).
    inside : measured, 0.95 to 1; marks in a region and its uncertain border cost the rest.
    determined : measured, 0.79 to 1 if every part has marks; parts without any lower it correctly,
        so the end is a guess.
    sigma_share : measured, 0.0003 to 0.0019. The end is derived: twice the bending that the
        camera's model is allowed (`propagation.bending`).

    predicted_deg : of held-out views. Measured, 0.6 to 2.5; wrong ones 5 to 78. The end is a guess
        in the gap.
    overlap : of their silhouettes. Measured, 0.93 to 0.99; wrong masks 0.28 and 0.79, wrong gamma
        0.18.
    unexplained : share of the phases that the surface explains under neither kind of light.
        Measured, 0.000 to 0.03; wrong angles 0.1 to 0.6.
    layered, overlapping : shares of the views' rays. Measured, 0 to 0.004, and 0; the ends are
        guesses.
    left_out : share of the views without a pose or inconsistent. Guess.
    contradicted : share of the surface. Measured, 0 to 0.08; with normals or F-scores that are
        wrong 0.18 and 0.31, under OPA 0.12. The end is that of the surface's own warning.
    moved : share of the surface. Measured, 0 on board, dome, mug and step, to 0.05; of a figure
        whose concave back stayed at the visual hull 0.17. The end is that of ``contradicted``.
    off_points : share of the sparse points; the end is where the surface is refined again.
    cut : measured, see :mod:`polmvs.polarization.mask_check`.

    Measured on right reconstructions: five rendered captures (``board``, ``dome``, ``demo``,
    ``mug``, ``step``) by one or both methods, ``board`` with six views, and analytic boards and
    balls of 6 and 12 views, sensors that obey PPA and tilted ones, noise of 0.2 and 1 % of full
    scale.
    """

    residual_sigmas: tuple[float, float] = (0.0, 2.5)
    excess_deg: tuple[float, float] = (0.0, 3.0)
    agreement: tuple[float, float] = (0.8, 1.0)
    inside: tuple[float, float] = (0.9, 1.0)
    determined: tuple[float, float] = (0.7, 1.0)
    sigma_share: tuple[float, float] = (0.0, 2 * PropagationOptions.bending)
    predicted_deg: tuple[float, float] = (0.0, 4.0)
    overlap: tuple[float, float] = (0.85, 1.0)
    unexplained: tuple[float, float] = (0.0, 0.15)
    layered: tuple[float, float] = (0.0, 0.05)
    overlapping: tuple[float, float] = (0.0, 0.02)
    left_out: tuple[float, float] = (0.0, 0.25)
    contradicted: tuple[float, float] = (0.0, MAX_SHARE)
    moved: tuple[float, float] = (0.0, MAX_SHARE)
    off_points: tuple[float, float] = (0.0, MAX_OFF)
    cut: tuple[float, float] = (0.0, MAX_CUT_SHARE)


@dataclass(frozen=True, kw_only=True)
class TrustFigure:
    """One quality check: a number with its normal range.

    Attributes
    ----------
    name : what it measures, with its unit.
    value : None if unknown.
    least, most : normal range.
    remedy : what to check if it is outside.
    decides : whether the result is not to be trusted if it is outside; otherwise the result is less
        accurate or incomplete.
    """

    name: str
    value: float | None
    least: float
    most: float
    remedy: str
    decides: bool = True

    @property
    def is_normal(self) -> bool:
        """Whether the value is known and within its range."""
        return self.value is not None and self.least <= self.value <= self.most

    def __str__(self) -> str:
        value = "unknown" if self.value is None else f"{self.value:.3g}"
        text = f"{self.name}: {value} (normal {self.least:g} to {self.most:g})"
        return text if self.is_normal else text + f"; check {self.remedy}"


def _figure(
    name: str,
    value: float,
    normal: tuple[float, float],
    remedy: str,
    *,
    scale: float = 100.0,
    decides: bool = True,
) -> TrustFigure:
    """Figure of a share in per cent, or of a value with a scale of 1; None if not finite."""
    return TrustFigure(
        name=name,
        value=scale * value if np.isfinite(value) else None,
        least=scale * normal[0],
        most=scale * normal[1],
        remedy=remedy,
        decides=decides,
    )


@dataclass(frozen=True, kw_only=True)
class Trust:
    """Quality checks of a cloud of one angle model, and the verdict.

    Attributes
    ----------
    residual_deg : median angle between measured phases and those that the cloud's normals predict.
    residual_sigmas : the same in the deviations that the phase maps state.
    agreement : share of the views that see a point which agree with it in position and normal.
    inside : share of the points visible in views that lie in the views' polarized regions: other
        points contradict the silhouettes.
    determined : share of the regions, over all views, that show a point.
    sigma_share : median position uncertainty (1 sigma), share of the distance from the nearest
        camera.
    num_views : number of views of the capture.
    left_out : views without a pose, and inconsistent views.
    predicted : held-out views, predicted from a surface of the others; None if not made.
    fitted : all views, predicted from the surface; None without a surface of all views.
    soundness : of the mesh; likewise.
    contradicted_share : share of the surface that its phases contradict; likewise.
    off_points : share of the sparse points with a normal that are off the surface; None if few.
    complaints : errors that earlier stages found (cameras, pattern, light), one clause each.
    cut_share : share of the band outside of the user's masks that is as polarized as a surface;
        None without masks.
    is_bounded : silhouettes bound the surface. They do not bound an open scene, so its checks
        leave them out.
    is_trusted, verdict : the verdict, in one sentence.
    """

    residual_deg: float
    residual_sigmas: float
    agreement: float
    inside: float
    determined: float
    sigma_share: float
    num_views: int = 0
    left_out: int = 0
    predicted: Prediction | None = None
    fitted: Prediction | None = None
    soundness: Soundness | None = None
    contradicted_share: float | None = None
    off_points: float | None = None
    complaints: tuple[str, ...] = ()
    cut_share: float | None = None
    is_bounded: bool = True
    is_trusted: bool = False
    verdict: str = ""

    def __str__(self) -> str:
        return self.verdict

    @property
    def excess_deg(self) -> float:
        """The part of ``residual_deg`` that the stated deviations of the phases do not explain.

        Weak polarization has noisy phases, which do not make a surface wrong.
        """
        explained = MEDIAN_OF_NORMAL / max(self.residual_sigmas, MEDIAN_OF_NORMAL)
        return float(self.residual_deg * np.sqrt(1 - explained**2))

    def figures(self, ranges: NormalRanges = NormalRanges()) -> tuple[TrustFigure, ...]:
        """The quality checks with their normal ranges; the independent ones first."""
        return (*self._contradicting(ranges), *self._fitted(ranges))

    def _contradicting(self, ranges: NormalRanges) -> Iterator[TrustFigure]:
        if self.predicted is not None:
            enough = self.predicted.num_phases >= MIN_PHASES
            remedy = (
                "`sfm.intrinsics`, `sfm.sparse`, `region.light`, `capture.pattern`, and that "
                "nothing was moved between the images"
            )
            name_of_view = self.predicted.inconsistent_view(ranges.predicted_deg[1])
            if name_of_view is not None:
                remedy = f"pose, image and mask of {name_of_view}"
            name = (
                "held-out views: median error of their planes of incidence, deg "
                f"({self.predicted.chance_deg:g} by chance)"
            )
            error = self.predicted.error_deg if enough else float("nan")
            yield _figure(name, error, ranges.predicted_deg, remedy, scale=1.0)
            if self.is_bounded:
                name = "held-out views: overlap of their silhouettes with the prediction, %"
                remedy = "`region.mask`, `capture.gamma`, poses"
                yield _figure(name, self.predicted.overlap, ranges.overlap, remedy)
            if self.predicted.moved is not None:
                name = "held-out views: surface that moves without them, %"
                remedy = "concave parts that no outline shows; more views"
                yield _figure(name, self.predicted.moved, ranges.moved, remedy)
        if self.fitted is not None:
            name = "phases that neither kind of light explains, %"
            yield _figure(name, self.fitted.unexplained, ranges.unexplained, LIGHT_OPTIONS)
        if self.contradicted_share is not None:
            name = "surface that its phases contradict, %"
            remedy = "`region.mask` (holes, cavities), `region.light`, `sfm.intrinsics`"
            yield _figure(
                name,
                self.contradicted_share,
                ranges.contradicted,
                remedy,
                # An open scene lacks things without sparse points; what closes the gap is left out.
                decides=self.is_bounded,
            )
        if self.off_points is not None:
            name = "sparse points with a normal that are off the surface, %"
            remedy = "parts that are too high or too low; more marks there"
            yield _figure(name, self.off_points, ranges.off_points, remedy)
        if self.soundness is not None:
            views = "views that contradict each other: poses, `region.mask`"
            name = "lines of sight through a double layer of the surface, %"
            yield _figure(name, self.soundness.layered, ranges.layered, views)
            name = "lines of sight through a surface that intersects itself, %"
            yield _figure(name, self.soundness.overlapping, ranges.overlapping, views)
        if self.num_views:
            name = "views without a pose or inconsistent, %"
            remedy = "the images of these views, `sfm.intrinsics`, `region.mask`"
            yield _figure(name, self.left_out / self.num_views, ranges.left_out, remedy)
        if self.cut_share is not None:
            name = "polarized surface along the masks, outside of them, %"
            remedy = (
                "`region.mask`, which ends within a surface: its edge is frayed there; masks "
                "of the whole object, its sides too, or none"
            )
            yield _figure(name, self.cut_share, ranges.cut, remedy, decides=False)

    def _fitted(self, ranges: NormalRanges) -> Iterator[TrustFigure]:
        name = "phase residual beyond noise, median, deg"
        yield _figure(name, self.excess_deg, ranges.excess_deg, LIGHT_OPTIONS, scale=1.0)
        name = "phase residual, median, sigma"
        sigmas = ranges.residual_sigmas
        yield _figure(name, self.residual_sigmas, sigmas, LIGHT_OPTIONS, scale=1.0, decides=False)
        name = "views that agree with a point they see, %"
        remedy = "poses: `sfm.intrinsics`, `sfm.sparse`"
        yield _figure(name, self.agreement, ranges.agreement, remedy)
        if self.is_bounded:
            name = "points within the silhouettes of the views, %"
            yield _figure(name, self.inside, ranges.inside, "`region.mask`, poses")
        name = "coverage of the polarized regions, %"
        remedy = "marks on the part; more views"
        yield _figure(name, self.determined, ranges.determined, remedy, decides=False)
        name = "position uncertainty (1 sigma), median, % of the distance"
        remedy = "`sfm.intrinsics`; more views"
        yield _figure(name, self.sigma_share, ranges.sigma_share, remedy, decides=False)

    def doubts(self) -> tuple[str, ...]:
        """A line for each quality check outside its range."""
        return tuple(str(figure) for figure in self.figures() if not figure.is_normal)

    def judged(self) -> Trust:
        """The quality checks with their verdict."""
        if np.isnan(self.inside) and np.isnan(self.residual_deg):
            verdict = "Not to be trusted: no view sees a point of a surface in the result."
            return replace(self, is_trusted=False, verdict=verdict)
        against = [*self.complaints]
        num_used = self.num_views - self.left_out
        if self.num_views and num_used < MIN_CHECKED:
            against.append(
                f"{num_used} views leave none to check the others by; record ten or more"
            )
        figures = self.figures()
        against += [str(figure) for figure in figures if figure.decides and not figure.is_normal]
        if against:
            more = f" (and {len(against) - 1} more)" if len(against) > 1 else ""
            verdict = f"Not to be trusted: {against[0].rstrip('.')}{more}."
            return replace(self, is_trusted=False, verdict=verdict)
        weak = [str(figure) for figure in figures if not figure.is_normal]
        return replace(self, is_trusted=True, verdict=f"To be trusted: {self._why(weak)}.")

    def _why(self, weak: Sequence[str]) -> str:
        if self.predicted is not None:
            reason = (
                f"a surface of the other views predicts {self.predicted.num_views} held-out views, "
                f"phases to {self.predicted.error_deg:.1f} deg ({self.predicted.chance_deg:g} by "
                "chance)"
            )
            if self.is_bounded:
                reason += f", silhouettes to {self.predicted.overlap:.0%}"
        else:
            reason = "the views agree with each other; no view was held out as a check"
        if np.isfinite(self.determined):
            reason += f"; points cover {self.determined:.0%} of what the views show"
        return reason + (f". But {weak[0]}" if weak else "")


def measure_trust(
    angle_model: AngleModel,
    cloud: Cloud,
    tracks: Cloud,
    maps: Sequence[PhaseMap],
    outside: Mapping[str, Mask] = MappingProxyType({}),
) -> Trust:
    """Quality checks of a cloud against its capture.

    Parameters
    ----------
    angle_model : of the cloud.
    cloud : dense, with ``kind``, ``num_views`` and ``sigma``.
    tracks : sparse points, as in :func:`polmvs.evaluation.consistency.measure_consistency`.
    maps : of all views, for the model.
    outside : as in :func:`polmvs.evaluation.consistency.measure_consistency`.
    """
    consistency = measure_consistency(angle_model, cloud, tracks, maps, outside)
    surface = cloud.only(cloud.are(PointKind.SURFACE))
    nothing = np.zeros((0, 3))
    points, normals = surface.points, nothing if surface.normals is None else surface.normals
    step = -(-len(points) // MAX_RESIDUAL_POINTS) or 1
    chosen = np.zeros(len(points), np.bool_)
    chosen[::step] = True
    in_sigmas, num_seen, num_inside = [np.zeros(0)], 0, 0
    nearest = np.full(len(points), np.inf)
    for whole in maps if len(points) else ():
        phase_map, view = within_box(whole, outside), whole.view
        nearest = np.minimum(nearest, view.ranges(points))
        shows = partial(_shows, phase_map, outside.get(view.name))
        seen = first_seen(points, normals, view, shows)[0] & chosen
        xy = view.project(points[seen])
        region = grow_mask(phase_map.region.inside, BORDER_MARGIN_PX).astype(np.float32)
        inside = sample_image(region, xy, nearest=True) > 0
        num_seen, num_inside = num_seen + len(inside), num_inside + int(inside.sum())
        residuals = phase_residuals_deg(
            angle_model, points[seen], normals[seen], phase_map, labelled=is_labelled(surface)
        )
        precision = sample_image(np.ascontiguousarray(phase_map.samples[..., 2]), xy)
        known = (precision > 0) & np.isfinite(residuals)
        in_sigmas.append(np.radians(residuals[known]) * np.sqrt(precision[known]))
    ratios = np.abs(np.concatenate(in_sigmas))
    sigma = surface.scalars.get("sigma", np.full(len(points), np.nan)) / nearest
    return Trust(
        residual_deg=consistency.phase_residual.median_deg,
        residual_sigmas=float(np.median(ratios)) if len(ratios) else float("nan"),
        agreement=min(consistency.agreement, 1.0),
        inside=num_inside / num_seen if num_seen else float("nan"),
        determined=consistency.coverage,
        sigma_share=float(np.nanmedian(sigma)) if np.isfinite(sigma).any() else float("nan"),
    )


def _shows(phase_map: PhaseMap, outside: Mask | None, xy: Floats) -> Mask:
    """Whether image coordinates (M, 2) lie in the image, and not where a box cut away."""
    shown = in_image(phase_map.view.camera, xy)
    if outside is not None:
        shown[shown] = sample_image(outside.astype(np.float32), xy[shown], nearest=True) == 0
    return shown
