"""Measurements of planes in one raw image: normals, focal length, and the model that fits.

The implementation of ``polmvs plane``.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from polmvs.arrays import Mask
from polmvs.camera import PinholeCamera
from polmvs.config import (
    CaptureOptions,
    Estimator,
    PlaneOptions,
    to_plain,
)
from polmvs.errors import DataError, OptionError
from polmvs.io.images import read_mask
from polmvs.normals.single_view.focal import FocalEstimate
from polmvs.normals.single_view.pixels import PlaneView, load_stokes, polygon_mask
from polmvs.normals.single_view.plane import PlaneEstimate
from polmvs.polarization.kinds import FORMULAS, AngleModel, Light
from polmvs.polarization.stokes import Stokes

MIN_PIXELS = 50


class IntrinsicsSource(StrEnum):
    """Where the intrinsics come from."""

    OPTIONS = "options"
    ASSUMED = "assumed"
    ESTIMATED = "estimated"


@dataclass(frozen=True, kw_only=True)
class PlaneFigures:
    """A plane's normal, as in :class:`.plane.PlaneEstimate`, in JSON types.

    Attributes
    ----------
    normal : unit, camera frame, facing the camera.
    center_xy : mean of its pixels' centres, px; None for the plane of all pixels.
    """

    normal: tuple[float, float, float]
    valid: bool
    conditioning: float
    sigma_deg: float
    rmse_deg: float
    median_deg: float
    num_pixels: int
    outlier_share: float
    center_xy: tuple[float, float] | None = None


@dataclass(frozen=True, kw_only=True)
class Residual:
    """Phase residual of the best single normal, degrees."""

    rmse_deg: float
    median_deg: float


@dataclass(frozen=True, kw_only=True)
class FocalFigures:
    """A focal length, as in :class:`.focal.FocalEstimate`; ``focal_px`` is None if unobservable."""

    focal_px: float | None
    sigma_px: float
    observable: bool
    scan_focal_px: tuple[float, ...]
    scan_rmse_deg: tuple[float, ...]
    scan_median_deg: tuple[float, ...]


@dataclass(frozen=True, kw_only=True)
class PlaneMeasurement:
    """Measurements of planes in one image.

    Attributes
    ----------
    image : the raw mosaic.
    width, height : of the polarization image, px.
    intrinsics : fx, fy, cx, cy that were used, px, COLMAP's convention.
    intrinsics_from : their source.
    angle_model, light, estimator, min_dolp : options on which ``plane`` depends.
    plane : the best single normal of all usable pixels, under ``angle_model``.
    residuals : of the best single normal under each model.
    focal : the focal length, if requested.
    planes : all planes in view, if requested.
    """

    image: Path
    width: int
    height: int
    intrinsics: tuple[float, float, float, float]
    intrinsics_from: IntrinsicsSource
    angle_model: AngleModel
    light: Light
    estimator: Estimator
    min_dolp: float
    plane: PlaneFigures
    residuals: dict[AngleModel, Residual]
    focal: FocalFigures | None = None
    planes: tuple[PlaneFigures, ...] | None = None

    def content(self) -> dict[str, Any]:
        """The measurement as JSON, without what was not requested."""
        plain: dict[str, Any] = to_plain(self)
        return {key: value for key, value in plain.items() if value is not None}


def measure_planes(
    image: Path, options: PlaneOptions | None = None, capture: CaptureOptions | None = None
) -> PlaneMeasurement:
    """Normals of planes in one raw mosaic, under every angle model.

    Parameters
    ----------
    image : the file.
    options : which pixels to use, and how to solve their normal.
    capture : how to read the mosaic.

    Raises
    ------
    OptionError
        The intrinsics do not fit the image.
    DataError
        A file is unusable, or no pixel is usable.
    """
    options = options or PlaneOptions()
    stokes = load_stokes(image, capture or CaptureOptions())
    mask = select_pixels(stokes, options, image)
    view = PlaneView(stokes=stokes, mask=mask, light=options.light)
    camera = _camera(options, stokes)
    source = IntrinsicsSource.OPTIONS if options.intrinsics else IntrinsicsSource.ASSUMED
    focal = view.focal(camera) if options.estimate_focal else None
    if focal is not None and focal.observable and options.intrinsics is None:
        scale = focal.focal_px / camera.fx
        camera = replace(camera, fx=camera.fx * scale, fy=camera.fy * scale)
        source = IntrinsicsSource.ESTIMATED
    robust = options.estimator is Estimator.ROBUST
    planes = {model: view.plane(model, camera, robust=robust) for model in FORMULAS}
    found = None
    if options.find_planes:
        found = tuple(
            _figures(plane.estimate, plane.mask) for plane in view.planes(options.model, camera)
        )
    return PlaneMeasurement(
        image=image,
        width=camera.width,
        height=camera.height,
        intrinsics=(camera.fx, camera.fy, camera.cx, camera.cy),
        intrinsics_from=source,
        angle_model=options.model,
        light=options.light,
        estimator=options.estimator,
        min_dolp=options.min_dolp,
        plane=_figures(planes[options.model]),
        residuals={
            model: Residual(rmse_deg=plane.rmse_deg, median_deg=plane.median_deg)
            for model, plane in planes.items()
        },
        focal=None if focal is None else _focal_figures(focal),
        planes=found,
    )


def select_pixels(
    stokes: Stokes, options: PlaneOptions, source: str | Path, inside: Mask | None = None
) -> Mask:
    """Usable pixels (H, W).

    Parameters
    ----------
    stokes : images of the mosaic.
    options : conditions on the pixels.
    source : the image, for messages.
    inside : (H, W) bool, pixels to choose from, instead of the options' mask or polygon.

    Raises
    ------
    DataError
        Fewer than ``MIN_PIXELS`` are usable, or the mask is unusable.
    """
    if inside is not None:
        if inside.shape != stokes.shape:
            raise ValueError(f"{inside.shape=} but expected {stokes.shape}.")
    elif options.mask is not None:
        inside = read_mask(options.mask, stokes.shape)
    elif options.polygon is not None:
        inside = polygon_mask(options.polygon, stokes.shape)
    else:
        inside = np.ones(stokes.shape, np.bool_)
    valid = stokes.valid if options.drop_clipped else stokes.s0 > 0
    mask = inside & valid & (stokes.dolp > options.min_dolp)
    if mask.any():
        mask &= stokes.s0 >= options.min_intensity * np.median(stokes.s0[mask])
    if np.count_nonzero(mask) < MIN_PIXELS:
        raise DataError(
            source,
            f"only {np.count_nonzero(mask)} pixels have a DoLP above {options.min_dolp} there; "
            "lower `plane.min_dolp` or choose a polarized area.",
        )
    return np.asarray(mask)


def _camera(options: PlaneOptions, stokes: Stokes) -> PinholeCamera:
    """The given camera, or a centred one with a focal length of the image's width."""
    height, width = stokes.shape
    if options.intrinsics is None:
        return PinholeCamera(
            width=width, height=height, fx=width, fy=width, cx=width / 2, cy=height / 2
        )
    fx, fy, cx, cy = options.intrinsics
    if not (0 < cx < width and 0 < cy < height):
        raise OptionError(
            f"have the principal point {cx:g},{cy:g} outside the polarization image of "
            f"{width}x{height} px; give those of the half-size image.",
            field="plane.intrinsics",
        )
    return PinholeCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


def _figures(plane: PlaneEstimate, mask: Mask | None = None) -> PlaneFigures:
    center = None
    if mask is not None:
        row, col = np.argwhere(mask).mean(axis=0)
        center = (float(col + 0.5), float(row + 0.5))
    given = vars(plane) | {"normal": tuple(plane.normal.tolist()), "center_xy": center}
    del given["covariance"]
    return PlaneFigures(**given)


def _focal_figures(focal: FocalEstimate) -> FocalFigures:
    return FocalFigures(
        focal_px=focal.focal_px if focal.observable else None,
        sigma_px=focal.sigma_px,
        observable=focal.observable,
        scan_focal_px=tuple(focal.scan_focal_px.tolist()),
        scan_rmse_deg=tuple(focal.scan_rmse_deg.tolist()),
        scan_median_deg=tuple(focal.scan_median_deg.tolist()),
    )
