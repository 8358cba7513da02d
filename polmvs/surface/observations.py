"""Observations of a mesh: the polarization of each face in each view that sees it.

An observation has two planes of incidence, one for specular and one for diffuse light;
:mod:`polmvs.surface.labels` infers which one holds. OPA, PPA and tilted differ only in the rows.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import partial

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.config import default_num_workers
from polmvs.geometry import dots, unit_or_zero
from polmvs.polarization.angle_models import correct_parameters, rows_from_axial, tilt_turn
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.light_mixture import phase_variance
from polmvs.polarization.phase_map import smoothed_polarization
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh, visible_points
from polmvs.surface.surface_view import SurfaceView

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Indices = NDArray[np.int64]

SPECULAR, DIFFUSE = 0, 1  # kinds of light: the first axis of arrays of both
KINDS = (SPECULAR, DIFFUSE)
OF_BOTH = ("rows", "turn_variance", "tilt", "slope")  # fields with these on their first axis


@dataclass(frozen=True)
class RowsOfBoth:
    """Rows of one view at N points, under both kinds of light.

    Attributes
    ----------
    rows : (2, N, 3) unit, world; 0 where the view shows no polarization.
    turn_variance : (2, N) of the row's angle about the ray, rad^2; inf without polarization.
    tilt : (2, N) rotation of the row about the ray by tilted polarizers, rad.
    axial : (N, 2) measured ``s1 / s0`` and ``s2 / s0``.
    dolp, sigma_dolp : (N,) degree of polarization and its deviation.
    """

    rows: Array
    turn_variance: Array
    tilt: Array
    axial: Array
    dolp: Array
    sigma_dolp: Array


def level_image(view: SurfaceView, width_px: float) -> Image:
    """Polarization of a view (H, W, 3): s1 / s0, s2 / s0, their variance, 0 where unknown.

    It is smoothed with a Gaussian of ``width_px``: Stokes images are averaged, never phases. Pixels
    outside of the possible silhouette are ignored.
    """
    return smoothed_polarization(view.phase_map.polarization, width_px, view.silhouette.possible)


def rows_of_both(
    view: SurfaceView,
    image: Image,
    angle_model: AngleModel,
    points: Floats,
    *,
    tilt_aware: bool = True,
    tilt_share: float = 0.0,
) -> RowsOfBoth:
    """Rows ``m`` with ``m . n = 0`` of one view at points of space, for both kinds of light.

    Parameters
    ----------
    view : its camera and pose.
    image : (H, W, 3), as :func:`level_image` makes it.
    angle_model : OPA, PPA or tilted.
    points : (N, 3), world.
    tilt_aware : compute the rotation of the rows by tilted polarizers, which OPA and PPA ignore.
    tilt_share : share of that rotation that is corrected.
    """
    in_cam = view.to_camera(points)
    xy = view.view.camera.project(in_cam)
    rays = unit_or_zero(in_cam)
    s1, s2, noise = (np.asarray(c, np.float64) for c in sample_image(image, xy).T)
    known = (noise > 0) & (rays[:, 2] > 0)
    length = np.hypot(s1, s2)
    dolp = np.clip(length, 0, 1)
    of_phase = phase_variance(dolp, noise)
    known &= np.isfinite(of_phase)
    rotation = view.view.cam_from_world.rotation
    rows = np.zeros((2, len(xy), 3))
    turn_variance = np.full((2, len(xy)), np.inf)
    tilt = np.zeros((2, len(xy)))
    for kind in KINDS:
        sign, diffuse = (1.0, True) if kind == DIFFUSE else (-1.0, False)
        cos2, sin2 = sign * s1, sign * s2
        turn = np.ones(len(xy))
        if angle_model is AngleModel.TILTED:
            measured = np.stack([np.ones_like(s1), s1, s2])
            _, c1, c2 = correct_parameters(measured, rays, diffuse=diffuse)
            cos2, sin2 = sign * c1, sign * c2
        elif tilt_aware:
            turns = np.nan_to_num(tilt_turn(cos2, sin2, rays, diffuse=diffuse))
            if tilt_share:
                cos, sin = np.cos(2 * tilt_share * turns), np.sin(2 * tilt_share * turns)
                cos2, sin2 = cos2 * cos - sin2 * sin, sin2 * cos + cos2 * sin
            tilt[kind] = turns
        found = np.nan_to_num(rows_from_axial(angle_model, cos2, sin2, rays))
        if angle_model is AngleModel.PPA:
            # d psi / d phase = v_z / (1 - (v.d)^2), by the row's own components; the direction
            # that the tilted model measures turns about the ray itself.
            turn = (found[:, 0] ** 2 + found[:, 1] ** 2) / np.where(known, rays[:, 2], 1.0)
        rows[kind] = np.where(known[:, None], found @ rotation, 0.0)
        turn_variance[kind, known] = turn[known] ** 2 * of_phase[known]
        tilt[kind] *= turn
    axial = np.where(known[:, None], np.stack([s1, s2], axis=1), 0.0)
    return RowsOfBoth(rows, turn_variance, tilt, axial, dolp, np.sqrt(np.maximum(noise, 0)))


@dataclass(frozen=True)
class Observations:
    """K observations of the faces of a mesh.

    Attributes
    ----------
    face, view : (K,) indices; the observations are sorted by view.
    rays : (K, 3) unit, from the camera to the face.
    cosine : (K,) between the face's normal and the direction to the camera.
    rows, turn_variance, tilt, axial, dolp, sigma_dolp : as of :class:`RowsOfBoth`.
    slope : (2, K) change of ``m . n`` per length as the face moves along its normal, with the
        normal fixed.
    """

    face: Indices
    view: Indices
    rays: Array
    cosine: Array
    rows: Array
    turn_variance: Array
    tilt: Array
    axial: Array
    dolp: Array
    sigma_dolp: Array
    slope: Array

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

    def tilt_slopes(self, normals: Array) -> Array:
        """Change of ``m . n`` (2, K) by a correction of the polarizers' tilt."""
        own = normals.take(self.face, axis=0)
        across = np.stack([dots(np.cross(self.rays, rows), own) for rows in self.rows])
        return np.asarray(-self.tilt * across)

    def only(self, kept: NDArray[np.bool_]) -> Observations:
        """The ``kept`` (K,) observations."""
        values = {
            one.name: getattr(self, one.name)[:, kept]
            if one.name in OF_BOTH
            else getattr(self, one.name)[kept]
            for one in fields(self)
        }
        return Observations(**values)


@dataclass(frozen=True, kw_only=True)
class Looking:
    """How views are observed.

    Attributes
    ----------
    angle_model : of the rows.
    tilt_aware, tilt_share : as in :func:`rows_of_both`.
    min_cosine : between normal and direction to the camera; more oblique views are ignored.
    """

    angle_model: AngleModel
    tilt_aware: bool = True
    tilt_share: float = 0.0
    min_cosine: float = 0.25


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
    own = partial(
        rows_of_both,
        view,
        image,
        looking.angle_model,
        tilt_aware=looking.tilt_aware,
        tilt_share=looking.tilt_share,
    )
    found = own(mesh.centers.take(face, axis=0))
    known = np.flatnonzero(np.isfinite(found.turn_variance[0]))
    face, rays, cosine = face[known], rays[known], cosine[known]
    rows = found.rows[:, known]
    slope = np.zeros((2, len(known)))
    if gsd is not None and len(known):
        reach = min(0.5 * mesh.mean_edge, 1.5 * gsd)
        normals, centers = mesh.face_normals.take(face, axis=0), mesh.centers.take(face, axis=0)
        aside = own(centers + reach * normals)
        same = np.where(np.einsum("lki,lki->lk", aside.rows, rows) < 0, -1.0, 1.0)
        ahead = same * np.einsum("lki,ki->lk", aside.rows, normals)
        change = ahead - np.einsum("lki,ki->lk", rows, normals)
        slope = np.where(np.isfinite(aside.turn_variance), change / reach, 0.0)
        slope = np.clip(slope, -0.5 / gsd, 0.5 / gsd)
    return Observations(
        face=face,
        view=np.full(len(face), index),
        rays=rays,
        cosine=cosine,
        rows=rows,
        turn_variance=found.turn_variance[:, known],
        tilt=found.tilt[:, known],
        axial=found.axial[known],
        dolp=found.dolp[known],
        sigma_dolp=found.sigma_dolp[known],
        slope=slope,
    )
