"""Vignetting of a camera, from a plane that several views show.

A lens darkens its image with the angle theta from its axis, alike in all views. The light of a lamp
at the camera falls off with the distance d instead:

    log I = log L + log g - V(theta) - c log d,     V(theta) = a sin^2 theta + b sin^4 theta

The radiance L of a point cancels between two views, their gains g cancel between two points. c is 0
without such a lamp, and 3 with no other light: the square of the distance, and the cosine at the
plane.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from polmvs.camera import Camera
from polmvs.fitting import CAUCHY_SCALE, robust_deviation

Floats = NDArray[np.floating]
Array = NDArray[np.float64]

NUM_TERMS = 2


def vignetting_terms(camera: Camera, xy: Floats) -> Array:
    """Even powers ``(..., 2)`` of the sine of the angle from the axis.

    Their product with the coefficients is V.

    Parameters
    ----------
    xy : image coordinates ``(..., 2)``.
    """
    square = 1.0 - camera.rays(xy)[..., 2] ** 2
    return np.stack([square, square**2], axis=-1)


def fit_vignetting(ratios: Floats, terms: Floats, distances: Floats) -> Array:
    """Coefficients ``(2,)`` of V, robust against points that mirror or are hidden.

    Parameters
    ----------
    ratios : (N,), of each pair of points the difference of ``log I`` between two views, one point's
        less the other's.
    terms : (N, 2), the same differences of :func:`vignetting_terms`.
    distances : (N,), the same differences of ``log d``.
    """
    columns = np.column_stack([terms, distances])
    scale = robust_deviation(ratios) if len(ratios) > columns.shape[1] else 0.0
    if scale == 0.0:
        return np.zeros(NUM_TERMS)
    fit = least_squares(
        lambda coefficients: ratios + columns @ coefficients,
        np.zeros(columns.shape[1]),
        jac=lambda _: columns,
        x_scale="jac",
        loss="cauchy",
        f_scale=CAUCHY_SCALE * scale,
    )
    return np.asarray(fit.x[:NUM_TERMS], np.float64)
