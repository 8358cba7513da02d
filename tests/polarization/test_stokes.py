"""Stokes images: known light, noise against simulation, masks, axial angles, real films."""

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from scipy import ndimage

from polmvs.io.raw_formats import read_raw
from polmvs.polarization.mosaic import clipped_cells, linearize, split_mosaic
from polmvs.polarization.stokes import (
    UNIFORM_SIGMA,
    Stokes,
    axial_difference,
    combine,
    estimate_noise,
    ideal_analyzers,
    stokes_by_least_squares,
    stokes_from_intensities,
    stokes_from_maps,
    turned_axes,
)

FILMS = Path(__file__).parents[3] / "shared" / "data" / "real" / "polarizer_IMX250MZR.png"
PATTERN = (90, 45, 135, 0)
FULL_WELL = 10_000  # electrons


def intensities_of(s0, dolp, aolp):
    """Malus: what ideal polarizers at 0, 45, 90, 135 degrees let through, (4, ...)."""
    angles = np.radians([0, 45, 90, 135]).reshape(4, *[1] * np.ndim(s0 * dolp * aolp))
    return (0.5 * s0 * (1 + dolp * np.cos(2 * (aolp - angles)))).astype(np.float32)


def exposed_mosaic(intensities, seed, read_noise=2.5):
    """8-bit linear mosaic of intensities given at every raw pixel; read noise in electrons."""
    rng = np.random.default_rng(seed)
    clean = np.empty(intensities.shape[1:])
    for cell, angle in enumerate(PATTERN):
        site = (slice(cell // 2, None, 2), slice(cell % 2, None, 2))
        clean[site] = intensities[angle // 45][site]
    electrons = rng.poisson(clean * FULL_WELL) + rng.normal(0, read_noise, clean.shape)
    return np.clip(np.rint(electrons / FULL_WELL * 255), 0, 255).astype(np.uint8)


def stokes_of(raw):
    return stokes_from_intensities(
        split_mosaic(linearize(raw), PATTERN), clipped_cells(raw, 250), quantum=1 / 255
    )


def uniform(s0, s1, s2, sigma=0.01):
    full = [np.full((2, 3), value, np.float32) for value in (s0, s1, s2, sigma)]
    valid = np.ones((2, 3), bool)
    return Stokes(s0=full[0], s1=full[1], s2=full[2], sigma=full[3], valid=valid)


@pytest.mark.parametrize("aolp_deg", [0, 1, 45, 89, 90, 135, 179])
@pytest.mark.parametrize("dolp", [0.05, 1.0])
def test_known_light_is_recovered(aolp_deg, dolp):
    aolp = np.full((4, 5), np.radians(aolp_deg))
    stokes = stokes_from_intensities(intensities_of(0.8, dolp, aolp), np.zeros((4, 5), bool))
    np.testing.assert_allclose(stokes.s0, 0.8, rtol=1e-6)
    np.testing.assert_allclose(stokes.s1, 0.8 * dolp * np.cos(2 * aolp), atol=1e-6)
    np.testing.assert_allclose(stokes.s2, 0.8 * dolp * np.sin(2 * aolp), atol=1e-6)
    np.testing.assert_allclose(stokes.dolp, dolp, rtol=1e-5)
    np.testing.assert_allclose(axial_difference(stokes.aolp, aolp), 0, atol=1e-5)
    assert stokes.shape == (4, 5)
    assert stokes.valid.all()
    assert stokes.sigma.min() > 0
    assert all(a.dtype == np.float32 for a in (stokes.s0, stokes.sigma, stokes.aolp, stokes.dolp))


def test_aolp_range_is_half_open():
    for s2 in (0.0, -0.0, -1e-30, -1e-9, 1e-9):
        aolp = uniform(1.0, 0.5, s2).aolp
        assert (aolp >= 0).all()
        assert (aolp < np.pi).all()


def test_sigma_aolp_formula_and_cap():
    # sigma / (2 dolp s0)
    assert uniform(0.8, 0.3, -0.4).sigma_aolp == pytest.approx(0.01 / (2 * 0.5), rel=1e-6)
    assert uniform(0.8, 1e-5, 0).sigma_aolp == pytest.approx(UNIFORM_SIGMA)
    assert uniform(0.8, 0, 0).sigma_aolp == pytest.approx(UNIFORM_SIGMA)
    assert uniform(0, 0, 0).dolp == pytest.approx(0)


@pytest.mark.parametrize("read_noise", [2.5, 40.0])
def test_noise_matches_the_simulation_at_every_intensity(read_noise):
    height, width = 512, 1024
    s0 = np.broadcast_to(np.linspace(0.1, 1.5, width), (height, width))
    dolp, aolp = 0.25, 0.4
    raw = exposed_mosaic(intensities_of(s0, dolp, aolp), seed=0, read_noise=read_noise)
    stokes = stokes_of(raw)
    truth = 0.5 * (s0[::2, ::2] + s0[1::2, 1::2])
    error = {
        "s1": stokes.s1 - truth * dolp * np.cos(2 * aolp),
        "s2": stokes.s2 - truth * dolp * np.sin(2 * aolp),
    }
    angle_error = axial_difference(stokes.aolp, aolp)
    for band in np.split(np.arange(8, width // 2 - 8), 4):
        region = np.ix_(range(4, height // 2 - 4), band)
        assert stokes.valid[region].all()
        sigma = np.sqrt(np.mean(stokes.sigma[region] ** 2))
        for name in ("s1", "s2"):
            assert sigma == pytest.approx(error[name][region].std(), rel=0.15), name
        predicted = np.sqrt(np.mean(stokes.sigma_aolp[region] ** 2))
        assert predicted == pytest.approx(angle_error[region].std(), rel=0.15)


@pytest.mark.parametrize("spread", [0.0, 0.02])
def test_sigma_covers_gain_errors(spread):
    """Uniform AoLP over a sky that is half unpolarized; gains drawn anew for each sensor."""
    rng = np.random.default_rng(3)
    height, width = 96, 192
    s0 = np.broadcast_to(np.linspace(0.4, 1.2, width), (height, width))
    dolp = np.where(np.arange(height)[:, None] < 48, 0.0, 0.3) * np.ones(width)
    aolp = np.tile(np.linspace(0, np.pi, width), (height, 1))
    within = []
    for _ in range(120):
        intensities = intensities_of(s0, dolp, aolp)
        intensities *= (1 + spread * rng.normal(size=4))[:, None, None].astype(np.float32)
        intensities += rng.normal(0, 0.003, intensities.shape).astype(np.float32)
        stokes = stokes_from_intensities(intensities, np.zeros((height, width), bool))
        error = axial_difference(stokes.aolp, aolp)[50:-2]
        within.append(np.mean(np.abs(error) < stokes.sigma_aolp[50:-2]))
        unaware = replace(stokes, gain_sigma=0.0).sigma_aolp[50:-2]
        assert (stokes.sigma_aolp[50:-2] >= unaware).all()
    # Of 120 sensors; 0.683 of a normal distribution. Without gain_sigma 0.29 at 2 %.
    assert np.mean(within) == pytest.approx(0.68, abs=0.06)


@pytest.mark.parametrize("angles", [(0, 45, 90, 135), (0, 60, 120), (0, 30, 60, 90, 120, 150)])
def test_least_squares_at_any_angles(angles):
    aolp = np.tile(np.linspace(0, np.pi, 50, endpoint=False), (40, 1))
    rows = ideal_analyzers(angles)
    light = np.stack([np.ones_like(aolp), 0.4 * np.cos(2 * aolp), 0.4 * np.sin(2 * aolp)])
    images = np.tensordot(rows, 0.7 * light, 1).astype(np.float32)
    stokes = stokes_by_least_squares(images, rows, np.zeros(aolp.shape, bool))
    np.testing.assert_allclose(stokes.dolp, 0.4, rtol=1e-5)
    np.testing.assert_allclose(axial_difference(stokes.aolp, aolp), 0, atol=1e-5)


@pytest.mark.parametrize("num", [3, 4, 9])
def test_noise_of_n_images_matches_the_simulation(num):
    rng = np.random.default_rng(0)
    angles = np.arange(num) * 180 / num
    aolp = np.full((256, 256), 0.6)
    rows = ideal_analyzers(angles)
    light = np.stack([np.ones_like(aolp), 0.2 * np.cos(2 * aolp), 0.2 * np.sin(2 * aolp)])
    images = np.tensordot(rows, 0.8 * light, 1) + rng.normal(0, 0.01, (num, 256, 256))
    clear = np.zeros(aolp.shape, bool)
    stokes = stokes_by_least_squares(images.astype(np.float32), rows, clear)
    error = np.stack([stokes.s1 - 0.8 * light[1], stokes.s2 - 0.8 * light[2]])
    assert np.sqrt(np.mean(stokes.sigma**2)) == pytest.approx(error.std(), rel=0.15)
    maps = stokes_from_maps(stokes.s0, stokes.s1, stokes.s2, ~clear)
    assert np.sqrt(np.mean(maps.sigma**2)) == pytest.approx(error.std(), rel=0.15)


def test_noise_of_stokes_images_is_told_though_neighbours_share_samples():
    """Interpolated from a mosaic, as other programs do it, over a floor of two brightnesses."""
    rng = np.random.default_rng(1)
    true = np.stack([np.full((512, 512), value) for value in (0.8, 0.1, -0.05)])
    true[:, :200] *= 0.4
    weights = np.array([0.75, 0.25])
    noise = rng.normal(0, 0.02, true.shape)
    for axis in (1, 2):
        noise = ndimage.convolve1d(noise, weights, axis=axis)
    s0, s1, s2 = (true + noise).astype(np.float32)
    stokes = stokes_from_maps(s0, s1, s2, np.ones(s0.shape, bool))
    # 0.6 of it where neighbours are asked.
    assert np.median(stokes.sigma) == pytest.approx(noise.std(), rel=0.1)


def test_per_pixel_analyzers_equal_shared_ones():
    rng = np.random.default_rng(0)
    images = rng.uniform(0.2, 0.8, (4, 12, 16)).astype(np.float32)
    rows = ideal_analyzers([1, 44, 93, 133])
    clear = np.zeros((12, 16), bool)
    shared = stokes_by_least_squares(images, rows, clear)
    each = stokes_by_least_squares(images, np.tile(rows[..., None, None], (12, 16)), clear)
    for name in ("s0", "s1", "s2", "sigma"):
        np.testing.assert_allclose(getattr(each, name), getattr(shared, name), rtol=1e-3, atol=1e-5)


def test_angles_that_determine_nothing():
    images = np.ones((3, 4, 4), np.float32)
    with pytest.raises(ValueError, match="do not determine"):
        stokes_by_least_squares(images, ideal_analyzers([0, 90, 180]), np.zeros((4, 4), bool))


@pytest.mark.parametrize(("zero", "clockwise"), [(0, False), (30, False), (0, True), (90, True)])
def test_axes_are_turned(zero, clockwise):
    stokes = uniform(1.0, 0.3 * np.cos(0.8), 0.3 * np.sin(0.8))
    turned = turned_axes(stokes, zero_deg=zero, clockwise=clockwise)
    expected = np.radians(zero) + (-0.4 if clockwise else 0.4)
    np.testing.assert_allclose(axial_difference(turned.aolp, expected), 0, atol=1e-6)
    np.testing.assert_allclose(turned.dolp, 0.3, rtol=1e-5)


def test_texture_raises_sigma_where_it_is_and_nowhere_else():
    rng = np.random.default_rng(1)
    s0 = np.tile(np.linspace(0.2, 1.0, 512), (512, 1))
    smooth = stokes_of(exposed_mosaic(intensities_of(s0, 0.3, 1.0), seed=2))
    s0[256:] *= rng.uniform(0.7, 1.3, (256, 512))
    half = stokes_of(exposed_mosaic(intensities_of(s0, 0.3, 1.0), seed=2))
    upper, lower = slice(4, 120), slice(136, 252)
    np.testing.assert_allclose(half.sigma[upper].mean(), smooth.sigma[upper].mean(), rtol=0.15)
    truth = 0.25 * s0.reshape(256, 2, 256, 2).sum(axis=(1, 3)) * 0.3
    error = half.s1[lower] - truth[lower] * np.cos(2.0)
    assert error.std() > 5 * smooth.sigma[lower].mean()
    assert np.sqrt(np.mean(half.sigma[lower] ** 2)) == pytest.approx(error.std(), rel=0.3)


def test_noise_has_the_floor_of_quantisation():
    flat = np.full((4, 80, 80), 0.25, np.float32)
    for quantum in (1 / 255, 1 / 4095):
        sigma = stokes_from_intensities(flat, np.zeros((80, 80), bool), quantum=quantum).sigma
        # Two interpolated samples, each with 0.39 of the variance of a rounded one.
        np.testing.assert_allclose(sigma, quantum * np.sqrt(2 * 0.390625 / 12), rtol=1e-4)


def test_of_too_few_patches_the_rounding_alone_is_known():
    rng = np.random.default_rng(0)
    few = (0.25 + 0.01 * rng.standard_normal((4, 16, 16))).astype(np.float32)
    redundancy = few[0] + few[2] - few[1] - few[3]
    s0 = few.sum(axis=0) / 2
    found = estimate_noise(s0, redundancy, np.ones((16, 16), bool), floor=1e-6)
    np.testing.assert_allclose(found.variance(s0), 1e-6, rtol=1e-6)


@pytest.mark.parametrize("level", [0.0, 0.3])
def test_images_without_information_raise_no_warning(level):
    for shape in ((1, 1), (4, 4), (80, 80)):
        stokes = stokes_from_intensities(
            np.full((4, *shape), level, np.float32), np.zeros(shape, bool), darkness=0, quantum=0
        )
        assert np.isfinite(stokes.sigma).all()
        assert np.isfinite(stokes.sigma_aolp).all()


def test_saturated_and_dark_pixels_are_invalid():
    intensities = np.full((4, 20, 20), 0.3, np.float32)
    intensities[:, :, 15:] = 0.003
    # A polarizer at right angles to the light is black, yet the pixel is not dark.
    intensities[:, 5:, 10:15] = np.array([0.0, 0.1, 0.2, 0.1])[:, None, None]
    clipped = np.zeros((20, 20), bool)
    clipped[2:4, 2:4] = True
    valid = stokes_from_intensities(intensities, clipped, darkness=0.004).valid
    assert not valid[2:4, 2:4].any()
    assert not valid[:, 15:].any()
    assert valid.sum() == 20 * 15 - 4


def test_a_clipped_raw_sample_invalidates_what_it_enters():
    raw = np.full((40, 40), 100, np.uint8)
    raw[20, 20] = 255
    assert np.argwhere(~stokes_of(raw).valid).tolist() == [[9, 9], [9, 10], [10, 9], [10, 10]]


def test_wrong_shapes_are_a_callers_error():
    with pytest.raises(ValueError, match="expected"):
        stokes_from_intensities(np.zeros((3, 4, 4), np.float32), np.zeros((4, 4), bool))
    with pytest.raises(ValueError, match="expected"):
        stokes_from_intensities(np.zeros((4, 4, 4), np.float32), np.zeros((4, 5), bool))


@pytest.mark.parametrize("shape", [(), (7,), (2, 3)])
def test_axial_difference_ignores_half_turns(shape):
    rng = np.random.default_rng(0)
    a, b = rng.uniform(-10, 10, (2, *shape))
    difference = axial_difference(a, b)
    assert difference.shape == shape
    assert np.all((difference >= -np.pi / 2) & (difference < np.pi / 2))
    np.testing.assert_allclose(np.sin(difference - (a - b)), 0, atol=1e-12)
    np.testing.assert_allclose(axial_difference(a + np.pi, b - 3 * np.pi), difference, atol=1e-12)


def test_axial_difference_of_right_angles_is_the_lower_bound():
    assert axial_difference(np.pi / 2, 0.0) == pytest.approx(-np.pi / 2)
    assert axial_difference(-np.pi / 2, 1e-17) < np.pi / 2


@pytest.mark.skipif(not FILMS.is_file(), reason=f"{FILMS} is absent")
def test_real_polarizer_films_give_their_angles():
    stokes = stokes_of(read_raw(FILMS).samples)
    centers = {83: (545, 192), 44: (547, 500), 175: (547, 777), 135: (553, 1053)}
    for expected_deg, (row, col) in centers.items():
        film = (slice(row - 40, row + 41), slice(col - 40, col + 41))
        inside = stokes.valid[film]
        mean = 0.5 * np.angle(np.exp(2j * stokes.aolp[film][inside]).sum())
        assert abs(np.degrees(axial_difference(mean, np.radians(expected_deg)))) < 1
        assert np.median(stokes.dolp[film]) > 0.35  # 0.38 to 0.51: the window glares
        spread = axial_difference(stokes.aolp[film][inside], mean)
        assert np.degrees(np.median(np.abs(spread))) < 2
    assert 0.13 < np.mean(~stokes.valid) < 0.17  # the saturated sky


def edge_images(*, turned: bool):
    """Stokes images of two sides: one is brighter and, if ``turned``, of another phase."""
    rng = np.random.default_rng(3)
    right = np.arange(160) >= 80
    s0 = np.where(right, 0.6, 0.3) * np.ones((120, 1))
    turn = np.where(right, 0.8 if turned else 0.0, 0.0)
    clean = s0, 0.4 * s0 * np.cos(turn), 0.4 * s0 * np.sin(turn)
    blurred = [cv2.GaussianBlur(image, (0, 0), 0.8) for image in clean]
    noise = 0.002 * rng.standard_normal((3, *s0.shape))
    return [np.asarray(b + n, np.float32) for b, n in zip(blurred, noise, strict=True)]


def at_edge_and_beside(stokes):
    columns = np.abs(np.arange(stokes.shape[1]) - 79.5)
    sigma = np.sqrt(np.mean(np.square(stokes.sigma), axis=0))
    return sigma[columns < 1].mean(), sigma[(columns > 10) & (columns < 60)].mean()


@pytest.mark.parametrize("images", ["Stokes", "angles", "colours"])
@pytest.mark.parametrize("turned", [True, False])
def test_mixed_phases_widen_sigma_and_mere_brightness_does_not(images, turned):
    """Whatever the images are: what an edge mixes agrees with itself, and noise averages out."""
    s0, s1, s2 = edge_images(turned=turned)
    valid = np.ones(s0.shape, bool)
    if images == "angles":
        analyzers = ideal_analyzers([0, 20, 40, 60, 80, 100, 120, 140, 160])
        intensities = np.tensordot(analyzers, np.stack([s0, s1, s2]), 1).astype(np.float32)
        stokes = stokes_by_least_squares(intensities, analyzers, ~valid)
    else:
        stokes = stokes_from_maps(s0, s1, s2, valid)
    if images == "colours":
        flat = replace(stokes, sigma=np.full_like(s0, 0.002))
        stokes = combine([flat, flat, flat])
    edge, beside = at_edge_and_beside(stokes)
    assert edge > 3 * beside if turned else edge < 1.5 * beside


@pytest.mark.parametrize(("noise", "share"), [(0.02, 0.8), (0.01, 0.5), (0.005, 0.2)])
def test_colours_weigh_by_their_noise(noise: float, share: float) -> None:
    """Two colours of one polarization: their weights are as the inverse variances."""
    shape = (20, 24)

    def colour(s1: float, sigma: float) -> Stokes:
        full = np.full(shape, 0.5, np.float32)
        return Stokes(
            s0=full,
            s1=np.full(shape, s1, np.float32),
            s2=np.zeros(shape, np.float32),
            sigma=np.full(shape, sigma, np.float32),
            valid=np.ones(shape, bool),
        )

    merged = combine([colour(0.2, 0.01), colour(-0.2, noise)])
    assert merged.s1.mean() == pytest.approx(0.2 * (2 * share - 1), abs=1e-6)
    # Of even images no noise is seen: it is what their own noise makes, by the weights' squares.
    expected = np.hypot(share * 0.01, (1 - share) * noise)
    np.testing.assert_allclose(merged.sigma, expected, rtol=1e-5)
    # The matched filter: a colour of half the polarization has half the weight.
    weaker = combine([colour(0.2, 0.01), colour(0.1, 0.01)])
    assert weaker.s1.mean() == pytest.approx((2 * 0.2 + 0.1) / 3, abs=1e-6)
