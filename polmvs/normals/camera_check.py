"""Check of a camera by the phases: which focal length and principal point they fit.

Under PPA, a surface with the normal ``n`` has, in a pixel with the ray ``v``, the phase of the
direction ``u`` in the image plane with ``u . w = 0``, where ``w = v x n`` in the camera's frame.
Another focal length or principal point turns the rays, so the phases of one point in several views
no longer belong to one normal. For camera parameters ``c`` and normals ``n_p`` the check minimizes

    sum over observations k of  rho((phase_k - phase(v_k(c), n_p)) / sigma_k)  +  prior of c

with Gauss-Newton steps from which the normals are eliminated. Derivatives are taken at the
predicted phase. At the measured phase they would depend on its noise, which would favour long focal
lengths. The check needs no matches, so it also works on objects without texture. The standard
deviation of c has two parts: the jackknife over the views, because errors of light and pose are
common to a view, and errors such as blur that all views share and the jackknife does not show.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from polmvs.arrays import Array, Floats, Indices, Mask
from polmvs.camera import Camera
from polmvs.fitting import CAUCHY_SCALE
from polmvs.geometry import dots, unit_or_zero

NUM_PARAMETERS = 3  # change of the focal length, as a share, and of the principal point over it


@dataclass(frozen=True, kw_only=True)
class CameraCheckTolerances:
    """Tolerances of the check.

    Attributes
    ----------
    prior_sigma : of the focal length as a share, and of the principal point as a share of the focal
        length. Wide: a zoom lens read off its ring. If the phases do not narrow it to half, they
        determine no camera.
    num_groups : groups of views for the jackknife.
    num_steps : Gauss-Newton steps.
    shared_sigma : rad, error of the phases that all views share. Measured: right cameras of six
        captures leave up to 0.0008 that another camera would explain, and a dome of 306 x 256 px
        0.0035; a focal length 10 % off leaves 0.010.
    max_sigmas : a difference is certain above this many deviations, as in the check by matches.
    min_focal_change, min_point_change : least difference that counts, of the focal length and of
        the principal point, as shares of the focal length. As in the check by matches; right
        cameras of five rendered captures differ by up to 0.0048 and 0.0024.
    """

    prior_sigma: tuple[float, float, float] = (0.2, 0.1, 0.1)
    num_groups: int = 12
    num_steps: int = 4
    shared_sigma: float = 0.0015
    max_sigmas: float = 4.0
    min_focal_change: float = 0.01
    min_point_change: float = 0.005


@dataclass(frozen=True, kw_only=True)
class PhaseRows:
    """Observations of points by views.

    Attributes
    ----------
    rows : (N, 3) unit, world, of the likelier light: ``m . n = 0``.
    rays : (N, 3) unit, world, from the camera.
    variance : (N,) of ``m . n``.
    point, view : (N,) indices.
    """

    rows: Floats
    rays: Floats
    variance: Floats
    point: Indices
    view: Indices

    def only(self, kept: Mask) -> PhaseRows:
        """Those that are kept (N,)."""
        return PhaseRows(
            rows=self.rows[kept],
            rays=self.rays[kept],
            variance=self.variance[kept],
            point=self.point[kept],
            view=self.view[kept],
        )


@dataclass(frozen=True, kw_only=True)
class CameraFit:
    """The camera that fits the phases, relative to the given one.

    Attributes
    ----------
    focal_change, focal_sigma : change of the focal length as a share, and its deviation.
    point_change, point_sigma : (2,) of the principal point, as shares of the given focal length.
    agrees : whether the given camera fits as well.
    """

    focal_change: float
    focal_sigma: float
    point_change: tuple[float, float]
    point_sigma: tuple[float, float]
    agrees: bool

    def message(self, camera: Camera) -> str:
        """A clause that names the camera that fits instead of the given one."""
        focal = camera.mean_focal_px
        x, y = camera.project(np.array([[0.0, 0.0, 1.0]]))[0]
        dx, dy = focal * np.array(self.point_change)
        return (
            f"a focal length of {focal * (1 + self.focal_change):.1f} +- "
            f"{focal * self.focal_sigma:.1f} px and a principal point of {x + dx:.1f},{y + dy:.1f} "
            f"+- {focal * max(self.point_sigma):.1f} px fit the phases of the surface, not "
            f"{focal:.1f} px and {x:.1f},{y:.1f}"
        )


def fit_camera(
    observed: PhaseRows,
    normals: Floats,
    rotations: Floats,
    *,
    tolerances: CameraCheckTolerances = CameraCheckTolerances(),
) -> CameraFit | None:
    """Focal length and principal point that fit phases.

    Parameters
    ----------
    observed : of points in views that share a camera, under PPA or tilted.
    normals : (P, 3) unit, world, of the points under the given camera; where the fit starts.
    rotations : (K, 3, 3) from the world to the cameras of the views.

    Returns
    -------
    None if the phases determine no camera.
    """
    t = tolerances
    change, sigma, precision = _fitted(observed, normals, rotations, t)
    # An error common to all rows, in the worst pattern, moves the camera by this.
    shared = t.shared_sigma * np.sqrt(precision) * sigma
    sigma = np.hypot(sigma, shared)
    if not (sigma < 0.5 * np.array(t.prior_sigma)).all() or not (np.abs(change) < 0.5).all():
        return None
    num = min(len(rotations), t.num_groups)
    left_out = np.array(
        [
            _fitted(observed.only(observed.view % num != group), normals, rotations, t)[0]
            for group in range(num)
        ]
    )
    between = np.sqrt((num - 1) / num * ((left_out - left_out.mean(axis=0)) ** 2).sum(axis=0))
    deviation = np.hypot(between, shared)
    least = np.array([t.min_focal_change, t.min_point_change, t.min_point_change])
    differs = (np.abs(change) > t.max_sigmas * deviation) & (np.abs(change) > least)
    return CameraFit(
        focal_change=float(change[0]),
        focal_sigma=float(deviation[0]),
        point_change=(float(change[1]), float(change[2])),
        point_sigma=(float(deviation[1]), float(deviation[2])),
        agrees=not differs.any(),
    )


def _fitted(
    observed: PhaseRows, normals: Floats, rotations: Floats, t: CameraCheckTolerances
) -> tuple[Array, Array, float]:
    """Change (3,) of the camera, its deviation (3,) from the rows' noise, and their precision."""
    rotation, point, num = rotations[observed.view], observed.point, len(normals)
    rows, rays = (np.einsum("nij,nj->ni", rotation, a) for a in (observed.rows, observed.rays))
    xy = rays[:, :2] / rays[:, 2:]
    measured = unit_or_zero(np.column_stack([-rows[:, 1], rows[:, 0]]))
    normals = np.asarray(normals, np.float64)
    # m . n is the error of the phase times the sine between ray and normal, times how far the plane
    # of incidence turns about the ray with the phase.
    sine2 = 1 - dots(observed.rays, normals[point]) ** 2
    plane_turn = (rows[:, 0] ** 2 + rows[:, 1] ** 2) / rays[:, 2]
    variance = observed.variance / np.maximum(sine2 * plane_turn**2, 1e-6)
    prior = np.diag(1 / np.square(t.prior_sigma))
    change, hessian = np.zeros(NUM_PARAMETERS), prior
    for _ in range(t.num_steps):
        axis = np.eye(3)[np.abs(normals).argmin(axis=1)]
        first = unit_or_zero(np.cross(normals, axis))
        second = np.cross(normals, first)
        turned = [np.einsum("nij,nj->ni", rotation, a[point]) for a in (normals, first, second)]
        residual, camera, normal = _linearized(measured, xy, change, *turned)
        weight = 1 / (variance * (1 + residual**2 / variance / CAUCHY_SCALE**2))

        def sums(values: Array) -> Array:
            return np.asarray(np.bincount(point, values, num), np.float64)

        # The 2 x 2 blocks of the normals are eliminated (Schur complement).
        block = np.array([[sums(weight * a * b) for b in normal] for a in normal])
        coupling = np.array([[sums(weight * a * b) for b in camera] for a in normal])
        pull = np.array([sums(weight * a * residual) for a in normal])
        block[[0, 1], [0, 1]] += 1e-6 * (block[0, 0] + block[1, 1]) + 1e-12
        inverse = np.linalg.inv(np.moveaxis(block, -1, 0))
        reduced = np.einsum("iap,pij->paj", coupling, inverse)
        hessian = prior + (camera * weight) @ camera.T - np.einsum("paj,jbp->ab", reduced, coupling)
        gradient = (camera * weight) @ residual - np.einsum("paj,jp->a", reduced, pull)
        step = -np.linalg.solve(hessian, gradient + prior @ change)
        change = change + step
        moves = -np.einsum("pij,jp->pi", inverse, pull + np.einsum("jap,a->jp", coupling, step))
        moves = np.clip(moves, -0.2, 0.2)
        normals = unit_or_zero(normals + moves[:, :1] * first + moves[:, 1:] * second)
    return change, np.sqrt(np.diag(np.linalg.inv(hessian))), float(weight.sum())


def _linearized(
    measured: Array, xy: Array, change: Array, normals: Array, first: Array, second: Array
) -> tuple[Array, Array, Array]:
    """Errors of phases, and their derivatives by the camera and by moves of the normals.

    Parameters
    ----------
    measured : (N, 2) unit, directions of the phases in the image.
    xy : (N, 2) of the pixels, in focal lengths from the principal point.
    change : (3,) of the camera.
    normals, first, second : (N, 3), camera frame; the last two are the directions of the moves.

    Returns
    -------
    Residuals (N,), and derivatives (3, N) and (2, N).
    """
    x, y = ((xy - change[1:]) / (1 + change[0])).T
    none, one = np.zeros_like(x), np.ones_like(x)
    ray = np.column_stack([x, y, one])
    across = np.cross(ray, normals)[:, :2]
    length = np.maximum(np.linalg.norm(across, axis=1), 1e-9)
    across /= length[:, None]
    predicted = np.column_stack([-across[:, 1], across[:, 0]])
    same = np.where(dots(measured, predicted) < 0, -1.0, 1.0)
    by_across = predicted / length[:, None]  # change of the phase with it
    turns = ((-x, -y, none), (-one, none, none), (none, -one, none))
    camera = [
        dots(by_across, np.cross(np.column_stack(turn), normals)[:, :2]) / (1 + change[0])
        for turn in turns
    ]
    normal = [dots(by_across, np.cross(ray, side)[:, :2]) for side in (first, second)]
    return same * dots(measured, across), np.stack(camera), np.stack(normal)
