"""The camera models: forward phase, constraint rows and parametrisation of the normal.

One formula serves all (paper, Table "Summary of the OPA and PPA models"): the PPA model uses the
pixel's own ray ``v``; the OPA model replaces it by the optical axis ``(0, 0, 1)``. The geometry of
the tilted model is that of PPA, on Stokes images corrected by :mod:`polmvs.polarization.tilted`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polmvs.config import AngleModel, Light

Floats = NDArray[np.floating]
Array = NDArray[np.float64]

OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])


def model_rays(model: AngleModel, rays_in_cam: Floats) -> Floats:
    """Rays as the model sees them: the optical axis under OPA, themselves under the others."""
    if model is AngleModel.OPA:
        return np.broadcast_to(OPTICAL_AXIS.astype(rays_in_cam.dtype), rays_in_cam.shape)
    return rays_in_cam


def phase_sign(light: Light) -> np.float32:
    """Factor from ``(cos, sin)`` of twice the AoLP to that of twice the phase.

    Specular light turns the phase by pi/2 from the AoLP, diffuse light does not.
    """
    return np.float32(-1.0 if light is Light.SPECULAR else 1.0)


def phase_direction(phase: Floats) -> Array:
    """Image direction ``d = (cos, -sin, 0)``, ``(..., 3)``, of a phase angle in radians."""
    return np.stack([np.cos(phase), -np.sin(phase), np.zeros_like(phase)], axis=-1)


def phase_from_normal(model: AngleModel, normals_in_cam: Floats, rays_in_cam: Floats) -> Array:
    """Predict the phase angle of a surface (paper, eqs. phi_ortho and phi_persp).

    Parameters
    ----------
    model : OPA, PPA or tilted.
    normals_in_cam : (..., 3), camera frame; the sign does not matter.
    rays_in_cam : (..., 3), unit rays, camera frame.

    Returns
    -------
    (...) float64 radians in [0, pi). Where the normal lies along the model's ray the plane of
    incidence is undefined and the value is NaN.
    """
    v = model_rays(model, np.asarray(rays_in_cam, np.float64))
    n = np.asarray(normals_in_cam, np.float64)
    x = v[..., 0] * n[..., 2] - v[..., 2] * n[..., 0]
    y = v[..., 1] * n[..., 2] - v[..., 2] * n[..., 1]
    phase = np.mod(-np.arctan2(y, x), np.pi)
    phase = np.where(phase >= np.pi, 0.0, phase)  # mod of a tiny negative number rounds to pi
    return np.where(np.hypot(x, y) > 1e-12, phase, np.nan)


def rows_from_phase(model: AngleModel, phase: Floats, rays_in_cam: Floats) -> Array:
    """Unit constraint rows ``m`` with ``m . n = 0`` (paper, eqs. con_ortho and con_persp).

    Parameters
    ----------
    model : OPA, PPA or tilted.
    phase : (...) radians, modulo pi.
    rays_in_cam : (..., 3), unit rays, camera frame.

    Returns
    -------
    (..., 3) float64, camera frame: the unit normal of the plane of incidence, ``v x d``. It is
    also a tangent of the surface, and perpendicular to the model's ray.
    """
    cos2, sin2 = np.cos(2 * phase), np.sin(2 * phase)
    return np.asarray(rows_from_axial(model, cos2, sin2, rays_in_cam), np.float64)


def rows_from_axial(model: AngleModel, cos2: Floats, sin2: Floats, rays_in_cam: Floats) -> Floats:
    """Rows from ``(cos 2 phase, sin 2 phase)`` of any common length; float32 stays float32.

    A pair of zero length (no polarisation) gives a NaN row.
    """
    length = np.sqrt(cos2 * cos2 + sin2 * sin2)
    with np.errstate(invalid="ignore", divide="ignore"):
        cos2, sin2 = cos2 / length, sin2 / length
    # Half angles without trigonometry, the larger first: the smaller is a difference of near
    # equals. The sign is that of sin2.
    larger = np.sqrt(0.5 + 0.5 * np.abs(cos2))
    smaller = np.abs(0.5 * sin2) / larger
    steep = cos2 < 0
    cos = np.where(steep, smaller, larger)
    sin = np.copysign(np.where(steep, larger, smaller), sin2)
    v = model_rays(model, rays_in_cam)
    x, y = v[..., 2] * sin, v[..., 2] * cos
    z = -v[..., 0] * sin - v[..., 1] * cos
    scale = 1 / np.sqrt(x * x + y * y + z * z)
    return np.stack([x * scale, y * scale, z * scale], axis=-1)


def normal_from_angles(
    model: AngleModel, phase: Floats, zenith: Floats, rays_in_cam: Floats
) -> Array:
    """Normal ``n = -exp(zenith a^) v`` of a phase and a zenith angle (paper, same table).

    Parameters
    ----------
    model : OPA, PPA or tilted.
    phase, zenith : (...) radians; the zenith angle lies between the normal and ``-v`` (PPA) or
        the optical axis (OPA).
    rays_in_cam : (..., 3), unit rays, camera frame.

    Returns
    -------
    (..., 3) float64, unit, camera frame.
    """
    v = model_rays(model, np.asarray(rays_in_cam, np.float64))
    axis = np.cross(phase_direction(phase), v)
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    zenith = np.asarray(zenith)[..., None]
    # Rodrigues; the axis is perpendicular to v.
    return np.asarray(-(np.cos(zenith) * v + np.sin(zenith) * np.cross(axis, v)))
