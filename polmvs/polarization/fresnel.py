"""DoLP of unpolarized light after reflection or refraction at a smooth dielectric (Fresnel)."""

from __future__ import annotations

import numpy as np

from polmvs.arrays import Array, Floats
from polmvs.polarization.kinds import Light


def fresnel_dolp(cosines: Floats, light: Light | str, ior: Floats | float) -> Array:
    """DoLP of unpolarized light that a surface reflects, or that leaves it from inside.

    Parameters
    ----------
    cosines : (...), of the angle between the surface's normal and the direction to the viewer.
    light : specular or diffuse.
    ior : refractive index, over 1; broadcasts.
    """
    c = np.clip(np.asarray(cosines, np.float64), 1e-6, 1.0)  # 0 / 0 at a grazing angle
    refracted = np.sqrt(1 - (1 - c * c) / np.square(ior))
    across = np.square((c - ior * refracted) / (c + ior * refracted))
    along = np.square((ior * c - refracted) / (ior * c + refracted))
    total = across + along
    return np.asarray((across - along) / (total if light == Light.SPECULAR else 2 - total))
