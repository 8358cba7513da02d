"""Presets: their Fresnel curves against closed formulas, and Mitsuba's BSDFs against both."""

import numpy as np
import pytest
from traced_scenes import diffuse_dolp, fresnel, refractive_index, specular_dolp, transmittance

from polmvs.errors import OptionError
from polmvs.simulation.materials import PRESETS, bsdf_of, material_of
from polmvs.simulation.options import MaterialName, Metal, ObjectOptions

COSINES = np.cos(np.radians([5, 20, 40, 55, 70, 80]))


def test_fresnel_at_normal_incidence_and_at_brewsters_angle():
    across, along = fresnel(np.array(1.0), 1.5)
    assert across == pytest.approx(0.04)
    assert along == pytest.approx(0.04)
    brewster = np.cos(np.arctan(1.5))
    assert fresnel(np.array(brewster), 1.5)[1] == pytest.approx(0, abs=1e-12)
    assert specular_dolp(np.array(brewster), 1.5) == pytest.approx(1)
    # Aluminium at 550 nm reflects 92 %: ((n - 1)^2 + k^2) / ((n + 1)^2 + k^2).
    n, k = 0.958, 6.69
    expected = ((n - 1) ** 2 + k**2) / ((n + 1) ** 2 + k**2)
    assert fresnel(np.array(1.0), complex(n, k))[0] == pytest.approx(expected)


def test_diffuse_dolp_is_that_of_atkinson_and_hancock():
    theta = np.radians([10.0, 30, 50, 70, 85])
    n, sin, cos = 1.5, np.sin(theta), np.cos(theta)
    numerator = (n - 1 / n) ** 2 * sin**2
    denominator = 2 + 2 * n**2 - (n + 1 / n) ** 2 * sin**2 + 4 * cos * np.sqrt(n**2 - sin**2)
    np.testing.assert_allclose(diffuse_dolp(cos, 1.5), numerator / denominator, rtol=1e-12)


@pytest.mark.parametrize("name", list(MaterialName))
def test_a_presets_curves_are_those_of_its_bsdf(renderer, name):
    mi = renderer.mi
    material = PRESETS[name]
    index = refractive_index(material)
    bsdf = mi.load_dict({**bsdf_of(material, colour=False), "alpha": 0.002})
    sampled = mi.BSDFContext()
    sampled.type_mask = mi.BSDFFlags.GlossyReflection | mi.BSDFFlags.DeltaReflection
    hit = renderer.dr.zeros(mi.SurfaceInteraction3f, len(COSINES))
    sin = np.sqrt(1 - COSINES**2)
    hit.wi = mi.Vector3f(mi.Float(sin), mi.Float(0.0), mi.Float(COSINES))
    # A microfacet's normal as near to the macroscopic one as can be.
    _, weight = bsdf.sample(sampled, hit, mi.Float(0.0), mi.Point2f(1e-6, 0.5), mi.Bool(True))
    first = [np.asarray(weight[k, 0]).ravel() for k in range(3)]
    dolp = np.hypot(first[1], first[2]) / first[0]
    np.testing.assert_allclose(dolp, specular_dolp(COSINES, index), atol=0.02)
    if material.metal is None:
        matte = mi.BSDFContext()
        matte.type_mask = mi.BSDFFlags.DiffuseReflection
        out = bsdf.eval(matte, hit, mi.Vector3f(0.0, 0.0, 1.0), mi.Bool(True))
        first = [np.asarray(out[k, 0]).ravel() for k in range(3)]
        dolp = np.hypot(first[1], first[2]) / first[0]
        np.testing.assert_allclose(dolp, diffuse_dolp(COSINES, index), atol=2e-3)
        leaves = transmittance(COSINES, index)
        np.testing.assert_allclose(first[0] / first[0][0], leaves / leaves[0], rtol=2e-3)


def test_options_change_a_preset():
    options = ObjectOptions(material=MaterialName.BLACK_PLASTIC, albedo=0.5, ior=1.7)
    assert material_of(options).grey == pytest.approx(0.5)
    assert material_of(options).ior == 1.7
    metal = material_of(ObjectOptions(material=MaterialName.POLISHED_METAL, metal=Metal.GOLD))
    assert refractive_index(metal) == complex(0.43, 2.455)


@pytest.mark.parametrize(
    ("material", "changes", "field"),
    [
        (MaterialName.BLACK_PLASTIC, {"metal": Metal.GOLD}, "object.metal"),
        (MaterialName.POLISHED_METAL, {"albedo": 0.5}, "object.albedo"),
        (MaterialName.BRUSHED_METAL, {"ior": 1.5}, "object.ior"),
    ],
)
def test_options_of_another_kind_of_material_are_refused(material, changes, field):
    with pytest.raises(OptionError) as found:
        material_of(ObjectOptions(material=material, **changes))
    assert found.value.field == field
