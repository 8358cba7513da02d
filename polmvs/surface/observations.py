"""Observations of a mesh: the polarization of each face in each view that sees it.

An observation has two planes of incidence, one for specular and one for diffuse light;
:mod:`polmvs.surface.labels` infers which one holds. OPA, PPA and tilted differ only in the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import partial
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.config import default_num_workers
from polmvs.geometry import dots, unit_or_zero
from polmvs.polarization.angle_models import correct_parameters, rows_from_axial, tilt_turn
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.light_mixture import phase_variance
from polmvs.polarization.phase_map import smoothed_polarization
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh, visible_points
from polmvs.surface.surface_view import SurfaceView

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Indices = NDArray[np.int64]
Mask = NDArray[np.bool_]

SPECULAR, DIFFUSE = 0, 1  # kinds of light: the first axis of arrays of both
KINDS = (SPECULAR, DIFFUSE)
OF_BOTH = ("rows", "turn_variance", "tilt", "slope")  # fields with these on their first axis


@dataclass(frozen=True)
class RowsOfBoth:
    """Rows of one view at N points, under both kinds of light, float32.

    Attributes
    ----------
    rows : (2, N, 3) unit, world; 0 where the view shows no polarization.
    turn_variance : (2, N) of the row's angle about the ray, rad^2; inf without polarization.
    tilt : (2, N) rotation of the row about the ray by tilted polarizers, rad.
    axial : (N, 2) measured ``s1 / s0`` and ``s2 / s0``.
    dolp, sigma_dolp : (N,) degree of polarization and its deviation.
    """

    rows: Floats
    turn_variance: Floats
    tilt: Floats
    axial: Floats
    dolp: Floats
    sigma_dolp: Floats


def level_image(view: SurfaceView, width_px: float) -> Image:
    """Polarization of a view (H, W, 3): s1 / s0, s2 / s0, their variance, 0 where unknown.

    It is smoothed with a Gaussian of ``width_px``: Stokes images are averaged, never phases. Pixels
    outside of the possible silhouette are ignored.
    """
    return smoothed_polarization(view.phase_map.polarization, width_px, view.silhouette.possible)


@dataclass(frozen=True, kw_only=True)
class Looking:
    """How views are observed.

    Attributes
    ----------
    angle_model : OPA, PPA or tilted.
    tilt_aware : compute the rotation of the rows by tilted polarizers, which OPA and PPA ignore.
    tilt_share : share of that rotation that is corrected.
    min_cosine : between normal and direction to the camera; more oblique views are ignored.
    light : of all observations, given by the user; None: inferred for each.
    """

    angle_model: AngleModel
    tilt_aware: bool = True
    tilt_share: float = 0.0
    min_cosine: float = 0.25
    light: Light | None = None

    @property
    def light_weights(self) -> tuple[float, float]:
        """Prior shares of specular and of diffuse light."""
        if self.light is None:
            return 0.5, 0.5
        return (1.0, 0.0) if self.light is Light.SPECULAR else (0.0, 1.0)


def rows_of_both(view: SurfaceView, image: Image, looking: Looking, points: Floats) -> RowsOfBoth:
    """Rows ``m`` with ``m . n = 0`` of one view at points of space, for both kinds of light.

    Parameters
    ----------
    view : its camera and pose.
    image : (H, W, 3), as :func:`level_image` makes it.
    looking : how to observe.
    points : (N, 3), world.
    """
    sample = _sampled(view, image, points)
    turns = _turns(sample, looking.angle_model) if looking.tilt_aware else None
    found = _rows_of(sample, view, looking.angle_model, turns, looking.tilt_share)
    known = np.isfinite(sample.phase_variance)
    return RowsOfBoth(
        rows=np.where(known[:, None], found.rows, 0.0),
        turn_variance=np.where(known, found.turn_variance, np.inf),
        tilt=np.where(known, found.tilt, 0.0),
        axial=np.where(known[:, None], found.axial, 0.0),
        dolp=found.dolp,
        sigma_dolp=found.sigma_dolp,
    )


@dataclass(frozen=True)
class _Sample:
    """Polarization of one view at N points.

    Attributes
    ----------
    rays : (N, 3) unit, camera frame.
    s1, s2, noise : (N,) relative to s0, and the variance of both.
    dolp, phase_variance : (N,); inf where the view shows no polarization.
    """

    rays: Floats
    s1: Floats
    s2: Floats
    noise: Floats
    dolp: Floats
    phase_variance: Floats

    def only(self, kept: Indices) -> _Sample:
        """The ``kept`` points."""
        return _Sample(**{name: values[kept] for name, values in vars(self).items()})


def _sampled(view: SurfaceView, image: Image, points: Floats) -> _Sample:
    in_cam = view.to_camera(points)
    rays = unit_or_zero(in_cam).astype(np.float32)
    sampled = sample_image(image, view.view.camera.project(in_cam))
    s1, s2, noise = np.ascontiguousarray(sampled.T)
    dolp = np.minimum(np.hypot(s1, s2), np.float32(1))
    variance = np.where((noise > 0) & (rays[:, 2] > 0), phase_variance(dolp, noise), np.inf)
    return _Sample(rays, s1, s2, noise, dolp, variance)


def _turns(sample: _Sample, angle_model: AngleModel) -> Floats | None:
    """Rotation (2, N) of the phases by tilted polarizers, rad; None where the model knows it."""
    if angle_model is AngleModel.TILTED:
        return None
    s1, s2, rays = sample.s1, sample.s2, sample.rays
    specular = tilt_turn(-s1, -s2, rays, diffuse=False)
    return np.stack([specular, tilt_turn(s1, s2, rays, diffuse=True)])


def _rows_of(
    sample: _Sample,
    view: SurfaceView,
    angle_model: AngleModel,
    turns: Floats | None,
    tilt_share: float,
) -> RowsOfBoth:
    """Rows of a sample, of any value where it has no polarization."""
    s1, s2, rays = sample.s1, sample.s2, sample.rays
    rows = np.empty((2, len(s1), 3), np.float32)
    factor = np.ones((2, len(s1)), np.float32)
    rotation = view.view.cam_from_world.rotation.astype(np.float32)
    for kind in KINDS:
        sign = np.float32(1.0 if kind == DIFFUSE else -1.0)
        cos2, sin2 = sign * s1, sign * s2
        if angle_model is AngleModel.TILTED:
            measured = np.stack([np.ones_like(s1), s1, s2])
            _, c1, c2 = correct_parameters(measured, rays, diffuse=kind == DIFFUSE)
            cos2, sin2 = sign * c1, sign * c2
        elif turns is not None and tilt_share:
            double = np.float32(2 * tilt_share) * turns[kind]
            cos, sin = np.cos(double), np.sin(double)
            cos2, sin2 = cos2 * cos - sin2 * sin, sin2 * cos + cos2 * sin
        found = rows_from_axial(angle_model, cos2, sin2, rays)
        if angle_model is AngleModel.PPA:
            # d psi / d phase = v_z / (1 - (v.d)^2), by the row's own components; the direction
            # that the tilted model measures turns about the ray itself.
            with np.errstate(divide="ignore", invalid="ignore"):
                factor[kind] = (found[:, 0] ** 2 + found[:, 1] ** 2) / rays[:, 2]
        np.matmul(found, rotation, out=rows[kind])
    with np.errstate(invalid="ignore"):
        turn_variance = factor**2 * sample.phase_variance
    return RowsOfBoth(
        rows=rows,
        turn_variance=turn_variance,
        tilt=np.zeros_like(factor) if turns is None else turns * factor,
        axial=np.stack([s1, s2], axis=1),
        dolp=sample.dolp,
        sigma_dolp=np.sqrt(np.maximum(sample.noise, 0)),
    )


@dataclass(frozen=True)
class Observations(RowsOfBoth):
    """Rows of K observations of the faces of a mesh, with what they are seen from.

    Attributes
    ----------
    face, view : (K,) indices; the observations are sorted by view.
    rays : (K, 3) unit, from the camera to the face.
    cosine : (K,) between the face's normal and the direction to the camera.
    slope : (2, K) change of ``m . n`` per length as the face moves along its normal, with the
        normal fixed.
    """

    face: Indices
    view: Indices
    rays: Floats
    cosine: Floats
    slope: Floats

    def of_views(self) -> list[slice]:
        """Where the observations of each view are that has some."""
        starts = np.flatnonzero(np.diff(self.view, prepend=-1))
        return [slice(*ends) for ends in pairwise([*starts.tolist(), len(self.view)])]

    def residuals(self, normals: Array) -> Array:
        """``m . n`` (2, K) for the normals (F, 3) of the faces."""
        return np.asarray(np.einsum("lki,ki->lk", self.rows, normals.take(self.face, axis=0)))

    def variances(self, normals: Array, row_sigma: Floats) -> Array:
        """Variance of ``m . n`` (2, K) about the normals (F, 3).

        A rotation of the row by psi about the ray changes it by the sine of the angle between ray
        and normal times psi. ``row_sigma``, which broadcasts, is the deviation that noise does not
        explain (facets, light from elsewhere).
        """
        cosine = dots(self.rays, normals.take(self.face, axis=0))
        return np.asarray((1 - cosine**2) * self.turn_variance + row_sigma**2)

    def only(self, kept: NDArray[np.bool_] | slice) -> Observations:
        """The ``kept`` observations."""
        values = {
            one.name: getattr(self, one.name)[:, kept]
            if one.name in OF_BOTH
            else getattr(self, one.name)[kept]
            for one in fields(self)
        }
        return Observations(**values)


def observe(
    mesh: TriangleMesh,
    scene: RayScene,
    views: Sequence[SurfaceView],
    images: Sequence[Image],
    looking: Looking,
    *,
    gsd: float | None = None,
) -> Observations:
    """All observations of the faces of a mesh.

    Parameters
    ----------
    mesh, scene : the mesh, and its scene for ray casting.
    views, images : the views, and their smoothed images (:func:`level_image`).
    looking : how to observe.
    gsd : ground sampling distance, for the slopes; None: they are 0.
    """
    look = partial(_observe_view, mesh, scene, looking, gsd)
    # Threads, as products of large arrays and ray casting release Python's lock.
    with ThreadPoolExecutor(default_num_workers()) as pool:
        found = [vars(own) for own in pool.map(look, range(len(views)), views, images)]
    # The views' arrays are released as they are joined: together they may take gigabytes.
    return Observations(
        **{
            one.name: np.concatenate(
                [own.pop(one.name) for own in found], axis=1 if one.name in OF_BOTH else 0
            )
            for one in fields(Observations)
        }
    )


def reflects_itself(mesh: TriangleMesh, scene: RayScene, found: Observations) -> Mask:
    """Which observations ``(K,)`` show a mirror image of the mesh itself.

    Such light was reflected twice and may be polarized by either surface.

    Parameters
    ----------
    mesh, scene : whose faces ``found`` observes; the whole surface, for ray casting.
    """
    normals = mesh.face_normals.take(found.face, axis=0)
    rays = np.asarray(found.rays, np.float64)
    mirrored = rays - 2 * dots(rays, normals)[:, None] * normals
    away = 0.5 * scene.mesh.mean_edge * normals
    return np.asarray(scene.cast(mesh.centers.take(found.face, axis=0) + away, mirrored).face >= 0)


def _observe_view(
    mesh: TriangleMesh,
    scene: RayScene,
    looking: Looking,
    gsd: float | None,
    index: int,
    view: SurfaceView,
    image: Image,
) -> Observations:
    face, rays, cosine = visible_points(
        scene, view.center, mesh.centers, mesh.face_normals, min_cosine=looking.min_cosine
    )
    centers = mesh.centers.take(face, axis=0)
    sample = _sampled(view, image, centers)
    known = np.flatnonzero(np.isfinite(sample.phase_variance))
    face, rays, cosine, centers = face[known], rays[known], cosine[known], centers[known]
    sample = sample.only(known)
    model, share = looking.angle_model, looking.tilt_share
    turns = _turns(sample, model) if looking.tilt_aware else None
    found = _rows_of(sample, view, model, turns, share)
    slope = np.zeros((2, len(known)))
    if gsd is not None and len(known):
        reach = min(0.5 * mesh.mean_edge, 1.5 * gsd)
        normals = mesh.face_normals.take(face, axis=0)
        aside = _sampled(view, image, centers + reach * normals)
        # The polarizers' tilt turns both alike.
        moved = _rows_of(aside, view, model, turns, share).rows
        same = np.where(np.einsum("lki,lki->lk", moved, found.rows) < 0, -1.0, 1.0)
        change = np.einsum("lki,ki->lk", same[..., None] * moved - found.rows, normals)
        slope = np.where(np.isfinite(aside.phase_variance), change / reach, 0.0)
        slope = np.clip(slope, -0.5 / gsd, 0.5 / gsd)
    return Observations(
        face=face,
        view=np.full(len(face), index),
        rays=rays.astype(np.float32),
        cosine=cosine.astype(np.float32),
        slope=slope.astype(np.float32),
        **vars(found),
    )
