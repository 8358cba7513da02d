import numpy as np
import pytest

from polmvs.polarization.angle_models import phase_from_normal, rows_from_phase
from polmvs.polarization.fresnel import fresnel_dolp
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.light_mixture import (
    LightMixtureTolerances,
    angle_log_density,
    dolp_log_evidence,
    light_shares,
    phase_variance,
    row_precisions,
)

RAY = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
NOISE = 0.01  # of s1 / s0


def normal_at(zenith, azimuth=0.7):
    """A unit normal that far from the direction to the viewer."""
    first = np.cross(RAY, [0.0, 1.0, 0.0])
    first /= np.linalg.norm(first)
    second = np.cross(RAY, first)
    aside = np.cos(azimuth) * first + np.sin(azimuth) * second
    return -np.cos(zenith) * RAY + np.sin(zenith) * aside


def shares(normal, dolp, *, turn=0.0, light="specular", noise=NOISE, **options):
    """Labels of an observation whose plane of incidence is that of the normal, turned."""
    phase = phase_from_normal(AngleModel.PPA, normal, RAY) + turn
    phase = phase + (0 if light == "specular" else np.pi / 2)
    planes = [rows_from_phase(AngleModel.PPA, phase + q, RAY) for q in (0, np.pi / 2)]
    variance = phase_variance(np.array(dolp), np.array(noise**2))
    residuals = planes[0] @ normal, planes[1] @ normal
    dolps = np.array(dolp), np.array(noise**2)
    return light_shares(residuals, (variance, variance), -RAY @ normal, *dolps, **options)


def test_each_light_is_told_by_its_plane():
    normal = normal_at(1.0)
    specular = shares(normal, 0.1)
    assert specular.specular > 0.9
    assert specular.log_likelihood > 1
    diffuse = shares(normal, 0.1, light="diffuse")
    assert diffuse.diffuse > 0.9
    neither = shares(normal, 0.1, turn=np.pi / 4)
    assert neither.neither > 0.98
    for found in (specular, diffuse, neither):
        assert sum(found[:3]) == pytest.approx(1)


def test_unpolarized_light_tells_nothing():
    found = shares(normal_at(1.0), 0.005)
    t = LightMixtureTolerances()
    assert found.neither == pytest.approx(t.neither_share, abs=5e-3)
    assert found.specular == pytest.approx(found.diffuse, abs=5e-3)
    assert abs(found.log_likelihood) < 0.02


def test_variance_grows_without_bound_as_dolp_falls_to_the_noise():
    dolp = np.array([0.5, 0.1, 0.05, 0.02, 0.015, 0.0142, 0.01, 0.0])
    found = phase_variance(dolp, np.full(8, NOISE**2))
    assert (np.diff(found[:6]) > 0).all()
    assert found[5] > 1
    assert np.isinf(found[6:]).all()


def test_the_density_of_an_angle_integrates_to_one():
    """Over all turns, for sure and unsure observations, with and without an error of the normal."""
    turns = (np.arange(20000) + 0.5) * np.pi / 20000
    sin = np.sin(0.6)
    for variance, of_normal in ((1e-3, 0.0), (0.2, 0.0), (5.0, 0.0), (1e-3, 0.1)):
        density = np.exp(angle_log_density(sin * np.sin(turns), variance, sin**2, of_normal))
        assert density.mean() == pytest.approx(1, rel=4e-3)


def test_dolp_above_fresnels_bound_is_specular():
    """A diffuse plane fits and so does DoLP; then only the DoLP is too high, and the frontal."""
    normal = normal_at(0.7)
    assert shares(normal, 0.04, light="diffuse").diffuse > 0.85
    assert shares(normal, 0.4, light="diffuse").diffuse < 0.01
    assert shares(normal, 0.4).specular > 0.98
    assert shares(normal_at(0.2), 0.6).neither > 0.98  # nothing mirrors that much so frontally
    sigma = LightMixtureTolerances().dolp_margin
    for light in Light:
        theta = np.linspace(0.1, 1.2, 12)
        bound = fresnel_dolp(np.cos(theta), light, np.array([[1.4], [1.7]])).min(axis=0)
        found = dolp_log_evidence(light, bound - 3 * sigma, np.zeros(12), np.cos(theta))
        assert (found > -0.1).all()


def test_an_unsure_normal_makes_labels_unsure():
    normal = normal_at(1.0)
    sure, unsure = (shares(normal, 0.1, normal_variance=v) for v in (0.0, 0.5))
    assert abs(unsure.specular - unsure.diffuse) < 0.6 < sure.specular - sure.diffuse - 0.3


def test_labels_obey_what_is_given():
    found = shares(normal_at(1.0), 0.1, light="diffuse", prior_specular=1.0)
    assert found.diffuse == 0
    assert found.neither > 0.98


def test_noise_of_the_angle_is_as_stated():
    """Simulated noise of (s1, s2): the residual's z is normal, from sure to hardly polarized."""
    rng = np.random.default_rng(1)
    exact = LightMixtureTolerances(model_sigma=0, mixture_sigma=0)
    for dolp in (0.4, 0.1, 0.06):
        p = np.array([dolp, 0]) + NOISE * rng.standard_normal((20000, 2))
        angle = 0.5 * np.arctan2(p[:, 1], p[:, 0])
        variance = phase_variance(np.hypot(*p.T), np.full(len(p), NOISE**2), tolerances=exact)
        assert np.mean(angle**2 / variance) == pytest.approx(1, abs=0.08)


def test_missing_observations_count_for_nothing():
    nan = np.full(2, np.nan)
    inf = np.full(2, np.inf)
    found = light_shares((nan, nan), (inf, inf), np.full(2, 0.5), np.zeros(2), inf)
    assert np.isfinite(np.array(found)).all()
    assert np.allclose(found.log_likelihood, 0)


def test_an_observation_of_no_label_draws_nowhere():
    """Its two residuals' squares sum to the same whatever the normal: no weight is left."""
    variance = phase_variance(np.array(0.02), np.array(NOISE**2))
    found = row_precisions(shares(normal_at(1.0), 0.02, turn=np.pi / 4), (variance, variance))
    assert max(found) < 0.05 / variance
    specular, diffuse = row_precisions(shares(normal_at(1.0), 0.1), (variance, variance))
    assert specular > 0.9 / variance
    assert diffuse == 0
