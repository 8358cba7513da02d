"""Contents of a report: metrics, pictures of the views and the 3D scene of a finished run.

Few views are processed at a time and only their encoded pictures are kept, so the memory does not
grow with them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Floats
from polmvs.camera import sample_image
from polmvs.evaluation.map_errors import LatticeErrors, lattice_errors
from polmvs.evaluation.metrics import THRESHOLDS_M, axial_errors_deg
from polmvs.geometry import SimilarityTransform
from polmvs.io.ground_truth import GroundTruth
from polmvs.polarization.angle_models import phase_from_normal
from polmvs.polarization.inspection import SHOWN_DOLP
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.polarization.stokes import Stokes
from polmvs.report import pictures
from polmvs.report.page import PagePicture, ViewPage
from polmvs.report.reprojection import mesh_normals_in_cam
from polmvs.scene import View
from polmvs.surface.dense_view import DenseView
from polmvs.surface.mesh_geometry import RayScene

MAX_ERROR_DEG = 20.0  # top of the colour scales: OPA's phase errors on oblique surfaces
MAX_ERROR_M = max(THRESHOLDS_M)  # of distances to ground truth
# OPA, in order of preference: it is best known as published.
ORTHOGRAPHIC = (AngleModel.TEXTBOOK_OPA, AngleModel.OPA)
MAX_SAMPLES_A_VIEW = 4000  # errors for the plots: quartiles of 16 views are then exact to 1 %


@dataclass(frozen=True)
class DisplayUnit:
    """Unit of the shown lengths.

    Attributes
    ----------
    name : of the unit.
    factor : its number in one unit of the model.
    """

    name: str
    factor: float = 1.0

    def text(self, length: float) -> str:
        """A length of the model, to three digits or whole, with its unit."""
        value = self.factor * length
        return f"{value:.0f} {self.name}" if abs(value) >= 1000 else f"{value:.3g} {self.name}"


@dataclass(kw_only=True)
class ErrorSamples:
    """Errors of a model at some pixels of all views, and their possible causes.

    Attributes
    ----------
    residual_deg : difference of the phase of the surface and the measured one.
    viewing_deg : angle between the normal and the ray, at the same pixels.
    depth_m, normal_deg, true_viewing_deg : against ground truth, if there is one.
    """

    residual_deg: list[Floats] = field(default_factory=list)
    viewing_deg: list[Floats] = field(default_factory=list)
    depth_m: list[Floats] = field(default_factory=list)
    normal_deg: list[Floats] = field(default_factory=list)
    true_viewing_deg: list[Floats] = field(default_factory=list)

    def extend(self, others: ErrorSamples) -> None:
        """Add those of other views."""
        for name, values in vars(self).items():
            values.extend(getattr(others, name))


@dataclass(frozen=True, kw_only=True)
class ViewInput:
    """Data of one view.

    Attributes
    ----------
    maps : phase map for each model.
    stokes : raw Stokes images; None without the capture.
    dense : dense result under each model, or None.
    """

    view: View
    maps: Mapping[AngleModel, PhaseMap]
    stokes: Stokes | None
    dense: Mapping[AngleModel, DenseView | None]


def view_page(
    given: ViewInput,
    truth: tuple[GroundTruth, SimilarityTransform] | None,
    *,
    white: float,
    length: DisplayUnit,
    mesh: RayScene | None = None,
) -> tuple[ViewPage, dict[AngleModel, ErrorSamples]]:
    """Pictures of one view, and samples of its errors for each model.

    Parameters
    ----------
    given : of the view.
    truth : ground truth and ``truth_from_world``.
    white : intensity of white.
    length : unit of depths.
    mesh : of the part, for its picture in the view; None without one.
    """
    first = next(iter(given.maps.values()))
    samples = {model: ErrorSamples() for model in given.dense}
    shown = [*_measured(given, first, white)]
    if mesh is not None:
        over = mesh_normals_in_cam(mesh, given.view)
        shown.append(
            _picture(
                "reprojected mesh",
                "the mesh as this camera sees it, blue, over the intensity; its outline should be "
                "the part's",
                pictures.mesh_picture(first.intensity, white, over),
            )
        )
    of_model: dict[AngleModel, list[PagePicture]] = {}
    for model, dense in given.dense.items():
        if dense is not None:
            errors = None
            if truth is not None and truth[0].find(given.view.name) is not None:
                errors = lattice_errors(given.view, dense, *truth)
            of_model[model] = _of_model(model, given, dense, errors, samples[model], length)
    for several in zip(*of_model.values(), strict=False):
        shown += several
    page = ViewPage(name=given.view.name, pictures=tuple(shown), wipe=_wipe(of_model))
    return page, samples


def _measured(given: ViewInput, phase_map: PhaseMap, white: float) -> list[PagePicture]:
    """Pictures of the measured images and of the polarized region."""
    inside = phase_map.region.inside
    intensity = phase_map.intensity
    aolp: Floats
    dolp: Floats
    if given.stokes is not None:
        valid = given.stokes.valid
        aolp = np.where(valid, given.stokes.aolp, np.nan)
        dolp = np.where(valid, given.stokes.dolp, np.nan)
    else:  # of the region alone, smoothed
        samples = phase_map.samples
        sign = np.where(phase_map.diffuse, 1, -1)
        aolp = 0.5 * np.arctan2(sign * samples[..., 1], sign * samples[..., 0])
        dolp = np.where(samples[..., 2] > 0, np.hypot(samples[..., 0], samples[..., 1]), np.nan)
    return [
        _picture(
            "intensity",
            "brightness without regard to polarization, which COLMAP was given",
            pictures.gray_picture(intensity, white),
        ),
        _picture(
            "AoLP",
            "angle of linear polarization in cyclic colours, faint where the DoLP is low",
            pictures.angle_picture(aolp, strength=dolp / SHOWN_DOLP),
        ),
        _picture(
            "DoLP",
            "degree of linear polarization: the share of the light that has one direction",
            pictures.scalar_picture(dolp, 0, 1),
            scale=("0", "100 %", pictures.SEQUENTIAL),
        ),
        _picture(
            "silhouette",
            "the intensity, dim outside the polarized region, whose outline is drawn",
            pictures.outline_picture(intensity, white, inside),
        ),
    ]


def _of_model(
    model: AngleModel,
    given: ViewInput,
    dense: DenseView,
    errors: LatticeErrors | None,
    samples: ErrorSamples,
    length: DisplayUnit,
) -> list[PagePicture]:
    """Normals, depth, residual phase, and the errors where there is a truth."""
    view, name = given.view, model.label
    xy = dense.lattice_xy()
    rays = view.camera.rays(xy)
    known = dense.known
    in_cam = np.where(known[..., None], dense.normals_in_world, np.nan) @ (
        view.cam_from_world.rotation.T
    )
    depth = np.where(known, dense.range_map, np.nan) * rays[..., 2]
    residual = _residual_deg(model, in_cam, rays, sample_image(given.maps[model].samples, xy))
    viewing = np.degrees(np.arccos(np.clip(-(in_cam * rays).sum(axis=-1), -1, 1)))
    _add(samples.residual_deg, samples.viewing_deg, residual, viewing)
    low, high = np.nanpercentile(depth, (1, 99)) if known.any() else (0.0, 1.0)
    result = [
        _picture(
            f"{name}: normals",
            "directions of the surface found, as the camera sees them",
            pictures.normal_picture(in_cam),
        ),
        _picture(
            f"{name}: depth",
            "distance from the camera along its axis",
            pictures.scalar_picture(depth, low, high),
            scale=(length.text(low), length.text(high), pictures.SEQUENTIAL),
        ),
        _picture(
            f"{name}: residual phase",
            "angle between the measured phase and that of the surface found",
            pictures.scalar_picture(residual, 0, MAX_ERROR_DEG, colors=pictures.ERROR),
            scale=("0", f"{MAX_ERROR_DEG:g} deg", pictures.ERROR),
        ),
    ]
    if errors is None:
        return result
    _add(samples.normal_deg, samples.true_viewing_deg, errors.normal_deg, viewing)
    samples.depth_m.append(_some(np.abs(errors.depth_m[np.isfinite(errors.depth_m)])))
    return [
        *result,
        _picture(
            f"{name}: depth error",
            "absolute error of the depth against the truth",
            pictures.scalar_picture(np.abs(errors.depth_m), 0, MAX_ERROR_M, colors=pictures.ERROR),
            scale=("0", f"{1e3 * MAX_ERROR_M:g} mm", pictures.ERROR),
        ),
        _picture(
            f"{name}: normal error",
            "angle between the normal and the true one",
            pictures.scalar_picture(errors.normal_deg, 0, MAX_ERROR_DEG, colors=pictures.ERROR),
            scale=("0", f"{MAX_ERROR_DEG:g} deg", pictures.ERROR),
        ),
    ]


def _wipe(
    of_model: Mapping[AngleModel, Sequence[PagePicture]],
) -> tuple[PagePicture, PagePicture] | None:
    """The last picture of OPA and of the best of the others: errors if known, else residuals."""
    opa = next((m for m in ORTHOGRAPHIC if m in of_model), None)
    others = (AngleModel.PPA, AngleModel.TILTED, AngleModel.TEXTBOOK_PPA)
    other = next((m for m in others if m in of_model), None)
    if opa is None or other is None:
        return None
    return of_model[opa][-1], of_model[other][-1]


def _residual_deg(model: AngleModel, in_cam: Floats, rays: Floats, samples: Floats) -> Floats:
    """Axial difference (h, w) of predicted and measured phase, NaN where one is missing."""
    measured = 0.5 * np.arctan2(samples[..., 1], samples[..., 0])
    known = (samples[..., 2] > 0) & np.isfinite(in_cam).all(axis=-1)
    safe = np.where(known[..., None], in_cam, -rays + 0.1)
    predicted = phase_from_normal(model, safe, rays)
    return np.where(known, axial_errors_deg(measured, predicted), np.nan)


def _add(errors: list[Floats], causes: list[Floats], error: Floats, cause: Floats) -> None:
    known = np.isfinite(error) & np.isfinite(cause)
    errors.append(_some(error[known]))
    causes.append(_some(cause[known]))


def _some(values: Floats) -> Floats:
    """An even choice, the same for arrays of one length."""
    step = max(1, -(-len(values) // MAX_SAMPLES_A_VIEW))
    return np.asarray(values[::step])


def _picture(
    title: str,
    alt: str,
    rgb: NDArray[np.uint8],
    *,
    scale: tuple[str, str, str] | None = None,
) -> PagePicture:
    return PagePicture(title=title, alt=alt, uri=pictures.data_uri(rgb), scale=scale)
