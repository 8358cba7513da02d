from dataclasses import replace

import cv2
import numpy as np
import pytest
from analytic_objects import looking_at, phase_map_of, sphere

from polmvs.polarization.region import Region
from polmvs.surface.silhouettes import (
    _outline_shift,
    find_silhouette,
    open_silhouette,
    store_silhouette,
)
from polmvs.surface.surface_view import FAR_PX, Silhouette, signed_distance_px

VIEW = looking_at((5.0, 0, 2.0))


@pytest.fixture(scope="module")
def ball():
    return phase_map_of(sphere(), VIEW)


def with_region(phase_map, inside):
    return replace(phase_map, region=Region(inside, inside, np.zeros_like(inside)))


def found_silhouette(phase_map, *, mask_given=False):
    return find_silhouette(phase_map, mask_given=mask_given)


def test_the_border_of_a_mask_runs_between_its_pixels():
    mask = np.zeros((20, 30), bool)
    mask[:, :10] = True
    distance = signed_distance_px(mask)
    assert distance[5, 9] == -0.5
    assert distance[5, 10] == 0.5
    assert distance[5, 0] == -9.5


@pytest.mark.parametrize(("full", "sign"), [(True, -1), (False, 1)])
def test_a_mask_without_border_is_far(full, sign):
    assert (signed_distance_px(np.full((8, 9), full)) == sign * FAR_PX).all()


def test_gradient_of_a_silhouette_points_outwards(ball):
    silhouette = found_silhouette(ball)
    distance = silhouette.inner
    dy, dx = np.gradient(distance)
    ring = np.abs(distance) < 3
    rows, cols = np.nonzero(ring)
    outwards = np.stack([cols, rows], 1) - [np.mean(cols), np.mean(rows)]
    outwards /= np.linalg.norm(outwards, axis=1, keepdims=True)
    assert ((dx[ring] * outwards[:, 0] + dy[ring] * outwards[:, 1]) > 0.85).all()


def test_user_masks_are_certain(ball):
    inside = ball.region.inside.copy()
    inside[50:54, 60:64] = False  # a hole as small as a mark stays if the user drew it
    silhouette = found_silhouette(with_region(ball, inside), mask_given=True)
    assert (silhouette.certain == inside).all()
    assert silhouette.is_sharp


def test_specks_gaps_and_marks_are_cleaned(ball):
    inside = ball.region.inside.copy()
    clean = found_silhouette(ball).certain
    inside[2, 2] = True
    inside[50:52, 60:63] = False
    assert (found_silhouette(with_region(ball, inside)).certain == clean).all()


def test_an_unbounded_part_of_the_region_is_unknown(ball):
    """It may be the surface or the background, out to where the region ends."""
    inside = ball.region.inside.copy()
    unbounded = np.zeros_like(inside)
    unbounded[:, :40] = True
    unbounded &= ~cv2.dilate(inside.astype(np.uint8), np.ones((9, 9), np.uint8)).astype(bool)
    whole = Region(inside | unbounded, inside, np.zeros_like(inside), unbounded)
    silhouette = found_silhouette(replace(ball, region=whole))
    assert not silhouette.certain[unbounded].any()
    assert silhouette.possible[unbounded].all()
    assert (silhouette.certain == found_silhouette(ball).certain).all()


def test_what_the_border_of_the_image_and_the_object_enclose_is_unknown(ball):
    """It may be a mark that the border cuts, or background."""
    inside = np.zeros_like(ball.region.inside)
    inside[20:, 30:90] = True
    inside[-10:, 50:60] = False
    intensity = np.where(inside, 0.1, 0.6).astype(np.float32)
    silhouette = found_silhouette(with_region(replace(ball, intensity=intensity), inside))
    assert silhouette.possible[-10:, 50:60].all()
    assert not silhouette.certain[-8:, 52:58].any()
    assert not silhouette.possible[-10:, :25].any()  # all of the background, not a small piece


def test_a_large_hole_stays(ball):
    inside = ball.region.inside.copy()
    inside[48:62, 60:72] = False
    silhouette = found_silhouette(with_region(replace(ball, intensity=_bright_hole(ball)), inside))
    assert not silhouette.possible[52:58, 64:68].any()


def _bright_hole(ball):
    intensity = ball.intensity.copy()
    intensity[48:62, 60:72] = 0.6
    return intensity


def test_dark_pixels_that_go_on_are_unknown(ball):
    inside = ball.region.inside
    left = inside.copy()
    left[:, 86:] = False  # unpolarized there, as dark as the rest
    silhouette = found_silhouette(with_region(ball, left))
    missing = inside & ~left
    assert (silhouette.possible & missing).sum() > 0.4 * missing.sum()  # up to the blurred edge
    assert not (silhouette.certain & missing)[:, 89:].any()
    assert (silhouette.possible & ~inside).sum() < 0.02 * inside.sum()


def test_outlines_follow_the_step_of_intensity(ball):
    """A region that has leaked over the object's border by two pixels."""
    grown = cv2.dilate(ball.region.inside.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    true = signed_distance_px(ball.region.inside)
    ring = np.abs(true) < 0.6
    before = signed_distance_px(grown)[ring]
    after = found_silhouette(with_region(ball, grown)).inner[ring]
    assert np.median(before) < -1.4
    assert abs(np.median(after)) < 0.5


@pytest.mark.parametrize("leak", [0, 1, 2, 3])
def test_how_far_a_region_leaks_does_not_move_the_outline(leak):
    """Its border chooses among steps of intensity, and does not draw the chosen one to itself."""
    inside = np.zeros((60, 80), bool)
    inside[:, :40] = True
    intensity = cv2.GaussianBlur(np.where(inside, 0.2, 0.6).astype(np.float32), (0, 0), 0.8)
    leaked = np.zeros_like(inside)
    leaked[:, : 40 + leak] = True
    shift = _outline_shift(leaked, intensity, 1.0)
    assert shift[20:40, 40] == pytest.approx(-leak, abs=0.03)


def test_nothing_polarized_gives_an_empty_silhouette(ball):
    silhouette = found_silhouette(with_region(ball, np.zeros_like(ball.region.inside)))
    assert not silhouette.possible.any()


def test_the_nearer_outline_counts_in_doubt():
    from polmvs.surface.surface_view import surface_view
    from polmvs.surface.terms import rim_residuals

    ball = phase_map_of(sphere(), VIEW)
    certain = np.zeros((112, 132), bool)
    certain[30:80, 30:60] = True
    possible = certain.copy()
    possible[30:80, 60:90] = True
    view = surface_view(ball, Silhouette(certain, possible))
    xy = np.array([[62.0, 55.0], [88.0, 55.0], [58.0, 55.0]])
    residual, gradient = rim_residuals(view, xy)
    assert residual == pytest.approx([2, -2, -2], abs=0.1)
    assert gradient[:, 0] == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("mask_given", [True, False])
def test_stored_silhouettes_are_as_they_were(ball, tmp_path, mask_given):
    inside = ball.region.inside.copy()
    inside[:, 86:] = False
    made = found_silhouette(with_region(ball, inside), mask_given=mask_given)
    store_silhouette(made, tmp_path, "a.png")
    read = open_silhouette(tmp_path, "a.png")
    assert (made.inner_shift is None) == mask_given
    assert read.is_sharp == made.is_sharp
    for name in ("certain", "possible", "inner", "outer"):
        assert np.array_equal(getattr(read, name), getattr(made, name)), name
