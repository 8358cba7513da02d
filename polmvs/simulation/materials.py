"""Materials: presets with common names, and their optical constants.

Dielectrics are a rough interface of Beckmann's slopes over a Lambertian base (Baek et al., SIGGRAPH
Asia 2018): light is reflected specularly by the interface, or it enters, is depolarized by the base
and polarized when it leaves. Conductors only reflect, by their complex refractive index.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from polmvs.errors import OptionError
from polmvs.simulation.options import MaterialName, Metal, ObjectOptions, SceneryOptions

VARNISH_IOR = 1.5

# n and k at 550 nm, and the name that Mitsuba's table of spectra has of them.
METALS = {
    Metal.ALUMINIUM: (0.958, 6.69, "Al"),
    Metal.CHROMIUM: (3.18, 4.41, "Cr"),
    Metal.COPPER: (1.04, 2.59, "Cu"),
    Metal.GOLD: (0.43, 2.455, "Au"),
    Metal.SILVER: (0.055, 3.32, "Ag"),
}


@dataclass(frozen=True, kw_only=True)
class Material:
    """Material of the object.

    Attributes
    ----------
    albedo : of the base under the interface, red, green, blue; 0 for conductors.
    roughness : alpha of Beckmann's slopes.
    ior : of the dielectric; None for conductors.
    metal : of the conductor; None for dielectrics.
    """

    albedo: tuple[float, float, float] = (0.0, 0.0, 0.0)
    roughness: float
    ior: float | None = None
    metal: Metal | None = None

    @property
    def grey(self) -> float:
        """The albedo for a sensor without colours: its luminance (Rec. 709)."""
        return float(np.dot((0.2126, 0.7152, 0.0722), self.albedo))


PRESETS = {
    MaterialName.BLACK_PLASTIC: Material(albedo=(0.01,) * 3, roughness=0.02, ior=1.5),
    MaterialName.GREY_PLASTIC: Material(albedo=(0.18,) * 3, roughness=0.05, ior=1.5),
    MaterialName.WHITE_PLASTIC: Material(albedo=(0.8,) * 3, roughness=0.08, ior=1.5),
    MaterialName.CAR_PAINT: Material(albedo=(0.25, 0.02, 0.02), roughness=0.01, ior=1.52),
    MaterialName.GLAZED_CERAMIC: Material(albedo=(0.65, 0.62, 0.55), roughness=0.01, ior=1.54),
    MaterialName.POLISHED_METAL: Material(roughness=0.01, metal=Metal.CHROMIUM),
    MaterialName.BRUSHED_METAL: Material(roughness=0.2, metal=Metal.ALUMINIUM),
}


def material_of(options: ObjectOptions) -> Material:
    """The preset, changed by the options.

    Raises
    ------
    OptionError
        An option is of the other kind of material.
    """
    material = PRESETS[options.material]
    if options.roughness is not None:
        material = replace(material, roughness=options.roughness)
    if material.metal is None:
        if options.metal is not None:
            raise OptionError(
                f"is of a conductor, and {options.material} is none; choose polished-metal or "
                "brushed-metal.",
                field="object.metal",
            )
        if options.albedo is not None:
            material = replace(material, albedo=(options.albedo,) * 3)
        if options.ior is not None:
            material = replace(material, ior=options.ior)
        return material
    for name in ("albedo", "ior"):
        if getattr(options, name) is not None:
            raise OptionError(
                f"is of a dielectric, and {options.material} is a conductor; choose its "
                "`object.metal`.",
                field=f"object.{name}",
            )
    return material if options.metal is None else replace(material, metal=options.metal)


def varnish_of(options: SceneryOptions) -> Material | None:
    """The varnish over the surroundings; their prints are the base under it."""
    if options.varnish is None:
        return None
    return Material(albedo=(1.0, 1.0, 1.0), roughness=options.varnish, ior=VARNISH_IOR)


def bsdf_of(material: Material, *, colour: bool) -> dict[str, Any]:
    """Mitsuba's description of the material, with its own albedo."""
    if material.metal is not None:
        # A named table of spectra in colour; the values at 550 nm for one brightness.
        n, k, name = METALS[material.metal]
        optics: dict[str, Any] = (
            {"material": name}
            if colour
            else {"eta": {"type": "uniform", "value": n}, "k": {"type": "uniform", "value": k}}
        )
        return {"type": "roughconductor", "alpha": material.roughness, **optics}
    assert material.ior is not None  # of a dielectric
    albedo = (
        {"type": "rgb", "value": list(material.albedo)}
        if colour
        else {"type": "uniform", "value": material.grey}
    )
    return {
        "type": "pplastic",
        "alpha": material.roughness,
        "int_ior": material.ior,
        "ext_ior": 1.0,
        "diffuse_reflectance": albedo,
    }
