r"""The angle models: predicted phase, rows, and the effect of tilted polarizers on the phase.

One formula serves all (paper, Table "Summary of the OPA and PPA models"): the PPA model uses the
pixel's own ray ``v``; the OPA model replaces it by the optical axis ``(0, 0, 1)``. The geometry of
the tilted model is that of PPA, on Stokes parameters corrected for the tilt.

Tilted polarizers
-----------------
A polarizer in the image plane with absorbing axis A lets through ``I = tr J - a' J a`` of light
with the transverse coherency J, ``a = normalise(A - (A . v) v)`` for the ray v (Korger et al.
2013; Pistellato and Bergamasco 2024). This assumes that rays meet the sensor at the angle at
which they enter the lens; for other lenses see below.

The basis of a ray's transverse plane is the image's x and upward y, turned by the shortest
rotation from the optical axis to the ray. In this basis J has three Stokes parameters. Projection
on the plane shrinks the radial component of A by ``v_z``. Let C, S be the cosine and sine of twice
the angle of the pixel's radial direction, ``g = (1 - v_z^2) / (1 + v_z^2)`` and
``q = sqrt(1 - g^2)``. Then the sensor measures

    (1 - g^2 C^2) s1 = q^2 C S1r - q S S2r,   (1 - g^2 S^2) s2 = q^2 S S1r + q C S2r

with the Stokes parameters S1r, S2r relative to the radial direction. They give the direction e of
polarization, a 3D vector perpendicular to the ray; the normal of the plane of incidence is e for
specular light, ``v x e`` for diffuse light. The *corrected* Stokes parameters are those of a sensor
that obeys PPA, so that all later steps are those of PPA:

- specular: the plane of incidence cuts the image plane perpendicular to the orthogonal projection
  of e, ``(e_x, e_y)``, so AoLP' is the direction of that projection;
- diffuse: it cuts the image plane parallel to the projection of e along the ray,
  ``e - (e_z / v_z) v``, so AoLP' is the direction of this projection.

With c, s the cosine and sine of twice the angle between e and the radial direction, the first
projection shrinks the radial component by ``v_z`` and the second stretches it by ``1 / v_z``:

    c' = (c + h) / (1 + h c),   s' = q s / (1 + h c),   h = -+g

with the minus for specular light. The length of ``(s1, s2)`` does not change.

Telecentric lenses
------------------
A lens that is telecentric on the image side turns each ray, and the field with it, in the plane
of ray and axis until it meets the sensor perpendicularly. The polarizers are then not tilted, and
the sensor measures the Stokes parameters of the ray's transverse plane. PPA is not exact here
either: it assumes the projections above. Its phase is off by up to ``arcsin((1 - v_z) / (1 +
v_z))``, 4.1 degrees at 30 degrees off the axis. This is about as much as behind tilted polarizers,
because tilt changes these parameters only to second order in g. For the same reason the tilted
model is nearly right behind such a lens: it is off by up to 0.2 degrees at 30 and 1.2 degrees at 45
degrees off the axis.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from polmvs.arrays import Array, Floats, Mask
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.stokes import Stokes, wrap_axial

OPTICAL_AXIS = np.array([0.0, 0.0, 1.0])


def model_rays(angle_model: AngleModel, rays_in_cam: Floats) -> Floats:
    """Rays of the model: the optical axis under OPA, the pixels' rays under the others."""
    if angle_model.formula is AngleModel.OPA:
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


def phase_from_normal(
    angle_model: AngleModel, normals_in_cam: Floats, rays_in_cam: Floats
) -> Array:
    """Predict the phase angle of a surface (paper, eqs. phi_ortho and phi_persp).

    Parameters
    ----------
    angle_model : OPA, PPA or tilted.
    normals_in_cam : (..., 3), camera frame; the sign does not matter.
    rays_in_cam : (..., 3), unit rays, camera frame.

    Returns
    -------
    (...) float64 radians in [0, pi). NaN where the normal is parallel to the model's ray: the plane
    of incidence is undefined.
    """
    v = model_rays(angle_model, np.asarray(rays_in_cam, np.float64))
    n = np.asarray(normals_in_cam, np.float64)
    x = v[..., 0] * n[..., 2] - v[..., 2] * n[..., 0]
    y = v[..., 1] * n[..., 2] - v[..., 2] * n[..., 1]
    return np.where(np.hypot(x, y) > 1e-12, wrap_axial(-np.arctan2(y, x)), np.nan)


def rows_from_phase(angle_model: AngleModel, phase: Floats, rays_in_cam: Floats) -> Array:
    """Unit constraint rows ``m`` with ``m . n = 0`` (paper, eqs. con_ortho and con_persp).

    Parameters
    ----------
    angle_model : OPA, PPA or tilted.
    phase : (...) radians, modulo pi.
    rays_in_cam : (..., 3), unit rays, camera frame.

    Returns
    -------
    (..., 3) float64, camera frame: the unit normal of the plane of incidence, ``v x d``. It is
    also a tangent of the surface, and perpendicular to the model's ray.
    """
    cos2, sin2 = np.cos(2 * phase), np.sin(2 * phase)
    return np.asarray(rows_from_axial(angle_model, cos2, sin2, rays_in_cam), np.float64)


def rows_from_axial(
    angle_model: AngleModel, cos2: Floats, sin2: Floats, rays_in_cam: Floats
) -> Floats:
    """Rows from ``(cos 2 phase, sin 2 phase)`` of any common length; float32 stays float32.

    A pair of zero length (no polarization) gives a NaN row.
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
    v = model_rays(angle_model, rays_in_cam)
    x, y = v[..., 2] * sin, v[..., 2] * cos
    z = -v[..., 0] * sin - v[..., 1] * cos
    scale = 1 / np.sqrt(x * x + y * y + z * z)
    return np.stack([x * scale, y * scale, z * scale], axis=-1)


def correct_parameters(parameters: Floats, rays_in_cam: Floats, *, diffuse: Mask | bool) -> Floats:
    """Stokes parameters that a sensor obeying PPA would have measured behind tilted polarizers.

    Parameters
    ----------
    parameters : (3, ...), ``s0 = (I0 + I45 + I90 + I135) / 2``, ``s1 = I0 - I90``,
        ``s2 = I45 - I135``.
    rays_in_cam : (..., 3), unit, camera frame.
    diffuse : (...) or one for all, whether diffuse reflection dominates, else specular. It selects
        the projection of the polarization.

    Returns
    -------
    (3, ...). From their ``phase = aolp + pi/2`` (specular) or ``aolp`` (diffuse),
    :func:`rows_from_phase` gives the exact rows.
    """
    if parameters.shape != (3, *rays_in_cam.shape[:-1]) or rays_in_cam.shape[-1] != 3:
        raise ValueError(
            f"{parameters.shape=}, {rays_in_cam.shape=} but expected (3, ...), (..., 3)."
        )
    s0, s1, s2 = parameters
    g1, g2, q = _radial(rays_in_cam)
    first, second = 1 - g1 * g1, 1 - g2 * g2
    p1, p2 = first * s1, second * s2
    along = (g1 * p1 + g2 * p2) / (q * q)  # g S1r
    total = s0 - 0.5 * (g2 * (p2 + g2 * along) / first + g1 * (p1 + g1 * along) / second)
    return np.stack([total, *correct_polarization(s1, s2, rays_in_cam, diffuse)])


def correct_stokes(stokes: Stokes, rays_in_cam: Floats, *, diffuse: Mask | bool) -> Stokes:
    """As :func:`correct_parameters`, for the Stokes images of one view with their noise.

    Parameters
    ----------
    stokes : (H, W) images as :func:`polmvs.polarization.stokes.stokes_from_intensities` makes them.
    rays_in_cam : (H, W, 3), unit, camera frame.
    diffuse : (H, W) or one for all.

    Returns
    -------
    The corrected images; ``sigma`` is scaled by :func:`sigma_scale`.
    """
    parameters = np.stack([stokes.s0, stokes.s1, stokes.s2])
    s0, s1, s2 = correct_parameters(parameters, rays_in_cam, diffuse=diffuse)
    return replace(
        stokes,
        s0=np.asarray(s0, np.float32),
        s1=np.asarray(s1, np.float32),
        s2=np.asarray(s2, np.float32),
        sigma=np.asarray(
            stokes.sigma * sigma_scale(s1, s2, rays_in_cam, diffuse=diffuse), np.float32
        ),
    )


def sigma_scale(s1: Floats, s2: Floats, rays_in_cam: Floats, *, diffuse: Mask | bool) -> Floats:
    """Factor by which the correction raises the deviation of s1, s2 across their direction.

    It is ``(1 - (v . d)^2) / v_z`` with the direction d of the corrected phase: the inverse of a
    row's rotation about its ray per rotation of the phase, which therefore equals the rotation of
    e. The gain of the inversion (within 6 % of 1 up to 45 degrees off the axis) is neglected.

    Parameters
    ----------
    s1, s2 : (...), corrected.
    rays_in_cam : (..., 3), unit, camera frame.
    diffuse : as in the correction.

    Returns
    -------
    (...); 1 where there is no polarization.
    """
    x, y, z = rays_in_cam[..., 0], rays_in_cam[..., 1], rays_in_cam[..., 2]
    polarized = np.sqrt(s1 * s1 + s2 * s2)
    # (v . d)^2 = (x^2 + y^2 + (x^2 - y^2) cos 2 phase - 2 x y sin 2 phase) / 2
    along = (x * x - y * y) * s1 - (2 * x * y) * s2
    with np.errstate(invalid="ignore", divide="ignore"):
        squared = 0.5 * (x * x + y * y + _signs(diffuse, s1.dtype) * along / polarized)
    return np.where(polarized > 0, (1 - squared) / z, 1)


def tilt_turn(
    cos2: Floats, sin2: Floats, rays_in_cam: Floats, *, diffuse: Mask | bool = False
) -> Floats:
    """Rotation of a phase by tilted polarizers, rad in [-pi/2, pi/2].

    OPA and PPA ignore the tilt, and do not know whether the lens causes it: the rotation counts as
    a deviation of their phases.

    Parameters
    ----------
    cos2, sin2 : (...), of twice the phase, times any common length.
    rays_in_cam : (..., 3), unit, camera frame.
    diffuse : (...) or one for all, whether diffuse reflection dominates.
    """
    sign = _signs(diffuse, cos2.dtype)
    s1, s2 = sign * cos2, sign * sin2
    t1, t2 = correct_polarization(s1, s2, rays_in_cam, diffuse)
    return np.asarray(0.5 * np.arctan2(s1 * t2 - s2 * t1, s1 * t1 + s2 * t2))


def _signs(diffuse: Mask | bool, dtype: np.dtype[np.floating]) -> Floats:
    """Factor from ``(cos, sin)`` of twice the AoLP to that of twice the phase."""
    signs = np.where(diffuse, phase_sign(Light.DIFFUSE), phase_sign(Light.SPECULAR))
    return np.asarray(signs, dtype)


def _radial(rays_in_cam: Floats) -> tuple[Floats, Floats, Floats]:
    """``g`` along the doubled radial direction, y upwards, and ``q = sqrt(1 - g^2)``."""
    x, y, z = rays_in_cam[..., 0], rays_in_cam[..., 1], rays_in_cam[..., 2]
    inverse = 1 / (1 + z * z)
    return (x * x - y * y) * inverse, -2 * x * y * inverse, 2 * z * inverse


def correct_polarization(
    s1: Floats, s2: Floats, rays_in_cam: Floats, diffuse: Mask | bool
) -> tuple[Floats, Floats]:
    """Corrected s1, s2 alone (...): see :func:`correct_parameters`.

    To the ray's transverse plane, and projected on the image plane.
    """
    g1, g2, q = _radial(rays_in_cam)
    p1, p2 = (1 - g1 * g1) * s1, (1 - g2 * g2) * s2
    # S = P / q + G (G . P) / (q^2 (1 + q)), free of the radial direction, which the axis lacks.
    shift = (g1 * p1 + g2 * p2) / (q * (1 + q))
    t1, t2 = (p1 + shift * g1) / q, (p2 + shift * g2) / q
    sign = _signs(diffuse, s1.dtype)
    h1, h2 = sign * g1, sign * g2
    along = t1 * h1 + t2 * h2
    length = np.sqrt(t1 * t1 + t2 * t2)
    shift = along / (1 + q) + length
    with np.errstate(invalid="ignore", divide="ignore"):
        inverse = np.where(length > 0, length / (length + along), 1)
    return (q * t1 + shift * h1) * inverse, (q * t2 + shift * h2) * inverse
