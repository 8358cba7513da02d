"""Sub-pixel outlines of a disc before a known background."""

import cv2
import numpy as np
import pytest

from polmvs.camera import pixel_centers, sample_image
from polmvs.surface.grazing import outline_bias
from polmvs.surface.matting import Background, find_outline

SIZE, CENTER, RADIUS = 240, (120.3, 118.6), 70.0
FINER = 4  # samples of a pixel, along each side
BLUR_PX = 0.8


def distance_of(xy: np.ndarray, radius: float = RADIUS) -> np.ndarray:
    return np.linalg.norm(xy - CENTER, axis=-1) - radius


def mean_of_samples(fine: np.ndarray) -> np.ndarray:
    blurred = cv2.GaussianBlur(fine.astype(np.float32), (0, 0), BLUR_PX * FINER)
    return blurred.reshape(SIZE, FINER, SIZE, FINER).mean(axis=(1, 3))


XY = pixel_centers(SIZE, SIZE)
FINE_XY = pixel_centers(FINER * SIZE, FINER * SIZE) / FINER
TRUTH = distance_of(XY)
BORDER = np.abs(TRUTH) < 1


def texture(contrast: float) -> np.ndarray:
    rng = np.random.default_rng(0)
    coarse = rng.uniform(1 - contrast, 1 + contrast, (SIZE // 8, SIZE // 8)).astype(np.float32)
    return np.asarray(cv2.resize(coarse, (FINER * SIZE, FINER * SIZE)), np.float32)


def photograph(own: np.ndarray, behind: np.ndarray, noise: float = 0.01) -> np.ndarray:
    fine = np.where(distance_of(FINE_XY) < 0, own, behind)
    rng = np.random.default_rng(1)
    return (mean_of_samples(fine) + rng.normal(scale=noise, size=(SIZE, SIZE))).astype(np.float32)


def known(behind: np.ndarray, *, until: float = np.inf) -> Background:
    """The background as it is, where x is less than ``until``."""
    image = mean_of_samples(behind)

    def at(places: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        value = sample_image(image, places)
        value = np.where(places[..., 0] < until, value, np.nan)
        return value, np.zeros_like(value), np.ones(value.shape, bool)

    return at


def errors(
    image: np.ndarray,
    background: Background,
    *,
    start: float = 1.5,
    polarized: np.ndarray | None = None,
) -> np.ndarray:
    """Errors of the signed distance at the outline, px; the start is ``start`` px too wide."""
    coarse = (TRUTH - start).astype(np.float32)
    light = np.zeros((SIZE, SIZE, 2), np.float32) if polarized is None else polarized
    found = find_outline(image, coarse, background, 0.01, polarized=light, start_px=2.0)
    return (found - TRUTH)[BORDER]


def test_a_shaded_disc_before_texture():
    behind = texture(0.4)
    own = 0.3 + 0.1 * (FINE_XY[..., 0] - CENTER[0]) / RADIUS
    error = errors(photograph(own, behind), known(behind))
    # A profile's 33 samples have a noise of 1 % over a contrast of 0.7, averaged over 8 of them.
    assert abs(np.mean(error)) < 0.02
    assert np.std(error) < 0.1


@pytest.mark.parametrize("start", [-2.5, 2.5])
def test_the_start_may_be_off_by_pixels(start):
    behind = texture(0.4)
    error = errors(photograph(np.full_like(behind, 0.2), behind), known(behind), start=start)
    assert np.percentile(np.abs(error), 95) < 0.2


def test_what_is_as_bright_as_the_background_stays():
    behind = np.ones((FINER * SIZE, FINER * SIZE))
    error = errors(photograph(behind, behind), known(behind))
    assert np.median(error) == pytest.approx(-1.5, abs=0.3)


@pytest.mark.parametrize("table", [0.0, 0.05])
def test_polarization_shows_what_is_as_bright_as_the_background(table):
    """The disc's light is polarized by 10 % along its outline; ``table`` is the background's."""
    behind = np.ones((FINER * SIZE, FINER * SIZE))
    around = np.arctan2(FINE_XY[..., 1] - CENTER[1], FINE_XY[..., 0] - CENTER[0])
    own, seed = 0.1 * np.stack([np.cos(2 * around), np.sin(2 * around)]), 2
    light = [photograph(one, np.full_like(behind, table)) for one in own]
    light = np.dstack(light) + np.random.default_rng(seed).normal(scale=0.01, size=(SIZE, SIZE, 2))
    error = errors(photograph(behind, behind), known(behind), polarized=light.astype(np.float32))
    # Where it has the background's polarization, nothing tells; half of the outline is beyond that.
    assert abs(np.median(error)) < 0.1
    assert np.percentile(np.abs(error), 75) < 0.5


def test_where_the_background_should_be_known_and_is_not_the_outline_stays():
    """Something else hides it there."""
    behind = texture(0.4)
    image = photograph(np.full_like(behind, 0.2), behind)
    error = errors(image, known(behind, until=CENTER[0]))
    x = XY[BORDER][:, 0]
    assert np.median(np.abs(error[x < CENTER[0] - 20])) < 0.1
    assert np.median(error[x > CENTER[0] + 20]) == pytest.approx(-1.5, abs=0.1)


@pytest.mark.parametrize("bend_px", [10.0, 100.0])
def test_a_mirroring_surface_seems_to_end_early(bend_px):
    """By what `outline_bias` expects, if it mirrors a background of one brightness."""
    behind = np.ones((FINER * SIZE, FINER * SIZE))
    sine = np.clip(1 + np.minimum(distance_of(FINE_XY), 0) / bend_px, 0, 1)
    cosine, refracted = np.sqrt(1 - sine**2), np.sqrt(1 - (sine / 1.5) ** 2)
    across = (cosine - 1.5 * refracted) / (cosine + 1.5 * refracted)
    within = (refracted - 1.5 * cosine) / (refracted + 1.5 * cosine)
    mirrored = 0.5 * (across**2 + within**2)
    error = errors(photograph(0.1 * (1 - mirrored) + mirrored, behind), known(behind))
    expected = outline_bias(np.array([bend_px]), matted=True)[0]
    assert np.mean(error) == pytest.approx(expected, rel=0.2)
