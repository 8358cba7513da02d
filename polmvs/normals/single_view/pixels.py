"""The pixels of one image that show a plane, for ``polmvs plane``."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polmvs.arrays import Image, Mask
from polmvs.camera import Camera, PinholeCamera, pixel_centers
from polmvs.config import CaptureOptions
from polmvs.normals.single_view.focal import FocalEstimate, estimate_focal
from polmvs.normals.single_view.plane import PlaneEstimate, plane_normal
from polmvs.normals.single_view.search import FoundPlane, find_planes
from polmvs.polarization.angle_models import correct_stokes, phase_sign
from polmvs.polarization.capture import open_image
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.phase_map import PhaseTolerances
from polmvs.polarization.stokes import Stokes

FOCAL_RANGE = (0.25, 6.0)  # tried focal lengths, image widths


@dataclass(frozen=True, kw_only=True, eq=False)
class PlaneView:
    """One image and its used pixels.

    Attributes
    ----------
    stokes : (H, W) images as measured.
    mask : (H, W) bool, pixels to use.
    light : dominant kind of light.
    """

    stokes: Stokes
    mask: Mask
    light: Light

    def phase_map(self, model: AngleModel, camera: Camera) -> tuple[Image, Image, Image]:
        """Phase in the form of the estimators.

        Returns
        -------
        axial : (2, H, W), ``(cos 2 phase, sin 2 phase)`` times the polarized intensity.
        rays : (3, H, W), unit, camera frame.
        sigma : (H, W), standard deviation of the phase, rad.
        """
        rays = camera.rays(pixel_centers(camera.width, camera.height)).astype(np.float32)
        stokes = self.stokes
        if model is AngleModel.TILTED:
            stokes = correct_stokes(stokes, rays, diffuse=self.light is Light.DIFFUSE)
        axial = phase_sign(self.light) * np.stack([stokes.s1, stokes.s2])
        return axial, np.ascontiguousarray(np.moveaxis(rays, -1, 0)), phase_sigma(stokes)

    def plane(self, model: AngleModel, camera: Camera, *, robust: bool = True) -> PlaneEstimate:
        """Best single normal of the pixels, by :func:`.plane.plane_normal`."""
        axial, rays, sigma = self.phase_map(model, camera)
        m = self.mask
        return plane_normal(model, axial[:, m], rays[:, m], sigma[m], robust=robust)

    def planes(self, model: AngleModel, camera: Camera) -> list[FoundPlane]:
        """All planes among the pixels, by :func:`.search.find_planes`."""
        axial, rays, sigma = self.phase_map(model, camera)
        return find_planes(model, axial, rays, sigma, self.mask)

    def focal(self, camera: PinholeCamera) -> FocalEstimate:
        """Focal length fx of the best single normal under the tilted model.

        Parameters
        ----------
        camera : its principal point and aspect ratio are used.
        """
        stokes, mask = self.stokes, self.mask
        xy = pixel_centers(camera.width, camera.height)[mask]
        offsets = (xy - [camera.cx, camera.cy]) * [1.0, camera.fx / camera.fy]
        return estimate_focal(
            AngleModel.TILTED,
            np.stack([stokes.s0[mask], stokes.s1[mask], stokes.s2[mask]]),
            np.ascontiguousarray(offsets.T, np.float32),
            phase_sigma(stokes)[mask],
            light=self.light,
            focal_range_px=(FOCAL_RANGE[0] * camera.width, FOCAL_RANGE[1] * camera.width),
        )


def load_stokes(path: Path, options: CaptureOptions) -> Stokes:
    """Stokes images of one mosaic.

    Raises
    ------
    DataError
        The file is missing, damaged or no monochrome mosaic.
    """
    return open_image(path, options).load(path.name)


def phase_sigma(stokes: Stokes) -> Image:
    """Deviation of the phase (H, W), rad: noise, the model's error, and light of the other kind.

    As in :mod:`polmvs.polarization.phase_map`, for single pixels; infinite or NaN where there is
    no polarization.
    """
    t = PhaseTolerances()
    with np.errstate(divide="ignore", invalid="ignore"):
        noise = t.mixture_sigma**2 + np.square(0.5 * stokes.sigma / stokes.s0)
        return np.asarray(np.sqrt(t.model_sigma**2 + noise / np.square(stokes.dolp)), np.float32)


def polygon_mask(corners: Sequence[Sequence[float]], shape: tuple[int, int]) -> Mask:
    """Pixels (H, W) whose centres lie inside a polygon, by the even-odd rule."""
    x, y = np.moveaxis(pixel_centers(shape[1], shape[0]), -1, 0)
    inside = np.zeros(shape, np.bool_)
    for (x0, y0), (x1, y1) in zip(corners, [*corners[1:], corners[0]], strict=True):
        if y0 != y1:
            crossing = x0 + (y - y0) * ((x1 - x0) / (y1 - y0))
            inside ^= ((y0 > y) != (y1 > y)) & (x < crossing)
    return inside
