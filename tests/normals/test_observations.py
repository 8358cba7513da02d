"""What windows of pixels measure: every pixel by its variance, under each angle model."""

import numpy as np
import pytest
from scenes import board_scene, seen_tracks

from polmvs.config import NormalOptions
from polmvs.normals.observations import gather_observations, window_polarization
from polmvs.normals.tracks import select_seeds, track_normals
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.region import Region

WINDOW = 7


@pytest.fixture(scope="module")
def scenes():
    return {sensor: board_scene(6, sensor=sensor) for sensor in ("ppa", "opa", "tilted")}


def flat(dolp, sigma, size=40):
    image = np.zeros((size, size, 4), np.float32)
    image[..., 0], image[..., 2] = dolp, sigma**2
    return image


@pytest.mark.parametrize("sensor", ["ppa", "opa", "tilted"])
@pytest.mark.parametrize("light", [0, 1])
def test_rows_of_either_light_are_those_of_the_model(scenes, sensor, light):
    """Of light of that kind the normal is perpendicular to its rows, not to the other's."""
    scene = scenes[sensor] if light == 0 else board_scene(6, sensor=sensor, light="diffuse")
    points, truth = scene.surface_points(30)
    found = gather_observations(AngleModel(sensor), points, scene.maps, window_px=WINDOW)
    residuals = np.abs(np.einsum("likn,ni->lkn", found.rows, truth))
    counted = np.isfinite(found.turn_variances[0]) & (found.dolp > 0.05)
    assert counted.mean() > 0.4
    assert np.percentile(residuals[light][counted], 80) < 0.02
    assert np.median(residuals[1 - light][counted]) > 0.3


@pytest.mark.parametrize("light", [0, 1])
def test_tilted_rows_take_back_what_ppa_leaves_out(scenes, light):
    scene = scenes["tilted"] if light == 0 else board_scene(6, sensor="tilted", light="diffuse")
    points, truth = scene.surface_points(30)
    medians = []
    for model in (AngleModel.TILTED, AngleModel.PPA):
        found = gather_observations(model, points, scene.maps, window_px=WINDOW)
        residuals = np.abs(np.einsum("ikn,ni->kn", found.rows[light], truth))
        medians.append(np.median(residuals[np.isfinite(found.turn_variances[0])]))
    assert medians[0] < 0.5 * medians[1]


def test_a_mark_in_the_window_hardly_counts():
    """Half of it unpolarized and bright, so of less noise: the phase is that of the rest."""
    image = flat(0.5, 0.01)
    image[:, 20:, :2] = 0, 0.004
    image[:, 20:, 2] = 0.001**2
    mean = window_polarization(image, 9)[20, 20]
    assert mean[0] > 0.4
    assert abs(mean[1]) < 0.01


def test_variance_of_a_window_is_that_of_its_pixels():
    rng = np.random.default_rng(0)
    image = flat(0.3, 0.02, 400)
    image[..., :2] += rng.normal(0, 0.02, (400, 400, 2))
    image[..., 3] = 0.005**2
    mean = window_polarization(image, 9)[20:-20:9, 20:-20:9]
    of_noise = np.sqrt(mean[..., 2].mean())
    assert of_noise == pytest.approx(mean[..., :2].std(axis=(0, 1)).mean(), rel=0.15)
    np.testing.assert_allclose(mean[..., 3], 0.005**2, rtol=1e-3)


def test_what_varies_over_a_window_makes_its_mean_less_certain():
    image = flat(0.3, 0.001)
    still = window_polarization(image, 17)[20, 20, 2]
    image[..., 1] = np.linspace(-0.3, 0.3, 40)
    assert window_polarization(image, 17)[20, 20, 2] > 50 * still


def test_clipped_pixels_do_not_count():
    image = flat(0.3, 0.01)
    image[10:30, 10:30] = 0, 0, np.inf, np.inf
    found = window_polarization(image, 9)
    assert (found[16:24, 16:24, 3] == 0).all()
    assert found[9, 9, 0] == pytest.approx(0.3, rel=1e-3)


def without_regions(maps):
    """The maps as if nothing were polarized strongly enough for a region."""
    nothing = np.zeros_like(maps[0].region.inside)
    region = Region(nothing, nothing, nothing)
    return [m.changed(region=region, samples=np.zeros_like(m.samples)) for m in maps]


@pytest.mark.parametrize("light", ["specular", "diffuse"])
def test_no_region_is_needed_for_normals_and_seeds(light):
    scene = board_scene(6, light=light)
    points, truth = scene.surface_points(40)
    tracks, maps = seen_tracks(scene, points, truth), without_regions(scene.maps)
    estimate = track_normals(AngleModel.PPA, tracks, maps, NormalOptions(window_px=WINDOW))
    errors = np.degrees(np.arccos(np.clip((estimate.normals * truth).sum(axis=1), -1, 1)))
    assert estimate.valid.mean() > 0.9
    assert np.nanmedian(errors) < 0.5
    assert np.nanmedian(getattr(estimate, light)) > 0.7
    seeds, chosen = select_seeds(tracks, estimate, maps)
    assert chosen.mean() > 0.7
    assert np.isfinite(seeds.normals_in_world).all()


def test_light_that_is_given_is_obeyed():
    scene = board_scene(6, light="diffuse")
    points, truth = scene.surface_points(30)
    tracks, options = seen_tracks(scene, points, truth), NormalOptions(window_px=WINDOW)
    right = track_normals(AngleModel.PPA, tracks, scene.maps, options, Light.DIFFUSE)
    wrong = track_normals(AngleModel.PPA, tracks, scene.maps, options, Light.SPECULAR)
    assert np.nanmedian(right.specular) == 0
    assert right.valid.mean() > 0.9
    assert np.nan_to_num(wrong.diffuse).max() == 0
    assert wrong.log_likelihood.sum() < right.log_likelihood.sum() - 50


@pytest.mark.parametrize("light", [0, 1])
def test_the_variance_of_an_orthographic_row_holds_its_angle_to_the_perspective_one(scenes, light):
    """That angle, from both models' rows, on top of what the phase's noise and a tilt make."""
    scene = scenes["ppa"]
    points, _ = scene.surface_points(40)

    def of(model, aware):
        return gather_observations(model, points, scene.maps, window_px=WINDOW, tilt_aware=aware)

    opa, opa_aware = of(AngleModel.OPA, False), of(AngleModel.OPA, True)
    ppa, ppa_aware = of(AngleModel.PPA, False), of(AngleModel.PPA, True)
    counted = np.isfinite(opa.turn_variances[light])
    assert counted.mean() > 0.8
    cosine = np.abs((opa.rows[light] * ppa.rows[light]).sum(axis=0))[counted]
    sine2 = 1 - np.clip(cosine, 0, 1) ** 2
    assert sine2.max() > 0.01
    variances = [one.turn_variances[light][counted] for one in (opa, opa_aware, ppa, ppa_aware)]
    # PPA's rows turn by a factor of their own, and add no angle.
    of_tilt = (variances[3] - variances[2]) * variances[0] / variances[2]
    np.testing.assert_allclose(
        variances[1] - variances[0] - of_tilt, sine2, atol=2e-3 * sine2.max()
    )
