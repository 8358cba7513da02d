import numpy as np
import pytest
from stereo_scenes import (
    CAMERAS,
    PINHOLE,
    RNG,
    TEXELS,
    TEXTURE,
    TEXTURE_SIDE,
    map_of,
    plane_points,
    true_ranges,
    views_of,
)

from polmvs.camera import pixel_centers, sample_image
from polmvs.polarization.region import smooth
from polmvs.surface.surroundings import (
    combine_ranges,
    fit_planes,
    match,
    ranges_from_disparity,
    rectify_pair,
    stereo_view,
    warp,
)


@pytest.mark.parametrize("camera", CAMERAS)
def test_rectified_rows_correspond_and_disparity_is_depth(camera):
    view, other = views_of(camera)
    pair = rectify_pair(view, other, plane_points())
    points = np.random.default_rng(2).uniform(-0.1, 0.1, size=(50, 3))
    left = (points - view.center_in_world) @ pair.rect_from_world.T
    right = (points - other.center_in_world) @ pair.rect_from_world.T
    left_xy, right_xy = pair.left.project(left), pair.right.project(right)
    np.testing.assert_allclose(left_xy[:, 1], right_xy[:, 1], rtol=1e-9)
    disparity = left_xy[:, 0] - right_xy[:, 0] + pair.offset_px
    np.testing.assert_allclose(pair.left.fx * pair.baseline / disparity, left[:, 2], rtol=1e-9)
    on_plane = (plane_points() - view.center_in_world) @ pair.rect_from_world.T
    searched = pair.left.fx * pair.baseline / on_plane[:, 2] - pair.offset_px
    assert ((searched > 0) & (searched < pair.num_disparities)).mean() > 0.97


@pytest.mark.parametrize("camera", CAMERAS)
def test_a_warped_image_shows_the_same_texture_along_the_same_rays(camera):
    view, other = views_of(camera)
    pair = rectify_pair(view, other, plane_points())
    texture = smooth(TEXTURE, 6.0)
    shown = map_of(view, texture=texture).intensity
    warped, inside = warp(shown, view, pair.left, pair.rect_from_world)
    rays = pair.left.rays(pixel_centers(pair.left.width, pair.left.height)) @ pair.rect_from_world
    points = view.center_in_world - (view.center_in_world[2] / rays[..., 2])[..., None] * rays
    expected = sample_image(texture, points[..., :2] * TEXELS + TEXTURE_SIDE / 2)
    assert inside.sum() > 20000
    step = np.abs(np.diff(expected, axis=1))[inside[:, 1:]].mean()
    assert np.median(np.abs(warped - expected)[inside]) < 0.1 * step  # a tenth of a pixel


def test_views_that_cannot_be_rectified_give_no_pair():
    view, other = views_of()
    assert rectify_pair(view, view, plane_points()) is None
    assert rectify_pair(view, other, plane_points(5)) is None
    behind = view.center_in_world + (view.center_in_world - plane_points())
    assert rectify_pair(view, other, behind) is None
    near = plane_points() * 1e-4 + view.center_in_world + 1e-3 * view.cam_from_world.rotation[2]
    assert rectify_pair(view, other, np.concatenate([near, plane_points()])) is None


@pytest.mark.parametrize("camera", CAMERAS)
def test_true_disparities_give_true_ranges(camera):
    view, other = views_of(camera)
    pair = rectify_pair(view, other, plane_points())
    rect_rays = pair.left.rays(pixel_centers(pair.left.width, pair.left.height))
    rays = rect_rays @ pair.rect_from_world
    depth = -view.center_in_world[2] / rays[..., 2] * rect_rays[..., 2]
    disparity = (pair.left.fx * pair.baseline / depth - pair.offset_px).astype(np.float32)
    xy = pixel_centers(240, 192)[20:-20, 20:-20]
    rays, expected = true_ranges(view, xy)
    ranges, sigma = ranges_from_disparity(pair, disparity, rays)
    assert (ranges > 0).all()
    np.testing.assert_allclose(ranges, expected, rtol=1e-5)  # a plane's disparity is linear
    total = pair.left.fx * pair.baseline / (expected * (rays @ pair.rect_from_world.T)[..., 2])
    np.testing.assert_allclose(sigma, 0.5 / total, rtol=1e-4)
    disparity[:] = np.nan
    assert (ranges_from_disparity(pair, disparity, rays)[0] == 0).all()


def test_ranges_of_pairs_that_agree_are_averaged_and_others_dropped():
    sigma = np.full((3, 1, 4), 0.01, np.float32)
    columns = [[1.0, 1.01, 1.5], [1.0, 1.2, 1.5], [0.0, 2.0, 0.0], [0.0, 0.0, 0.0]]
    ranges = np.array(columns, np.float32).T[:, None]
    combined, combined_sigma = combine_ranges(ranges, sigma)
    np.testing.assert_allclose(combined[0], [np.sqrt(1.01), 0, 2, 0], rtol=1e-5)
    np.testing.assert_allclose(combined_sigma[0], [0.01 / np.sqrt(2), 0, 0.01, 0], rtol=1e-5)


def test_a_more_certain_range_counts_more():
    ranges = np.array([1.0, 1.02], np.float32).reshape(2, 1, 1)
    sigmas = np.array([0.01, 0.02], np.float32).reshape(2, 1, 1)
    expected = np.exp(0.2 * np.log(1.02))
    np.testing.assert_allclose(combine_ranges(ranges, sigmas)[0].item(), expected, rtol=1e-5)


def test_a_plane_is_fitted_exactly_and_a_step_is_not():
    rays = PINHOLE.rays(pixel_centers(60, 48) * 4)
    normal = np.array([0.3, -0.2, -0.9])
    normal /= np.linalg.norm(normal)
    inverse = (rays @ -normal) / 0.7
    slope, deviation = fit_planes(inverse, rays)
    inner = (slice(3, -3), slice(3, -3))
    np.testing.assert_allclose(slope[inner], np.broadcast_to(-normal / 0.7, (42, 54, 3)), rtol=1e-6)
    assert deviation[inner].max() < 1e-6
    inverse[:, 30:] *= 1.1
    deviation = fit_planes(inverse, rays)[1][10]
    assert deviation[29:31].min() > 0.02
    assert deviation[[20, 40]].max() < 1e-6


def test_a_window_of_few_ranges_has_no_plane():
    rays = PINHOLE.rays(pixel_centers(60, 48) * 4)
    inverse = np.zeros((48, 60))
    inverse[10:13, 10:13] = 1
    assert np.isnan(fit_planes(inverse, rays)[0]).all()


@pytest.mark.parametrize("camera", CAMERAS)
@pytest.mark.parametrize("order", [(1, 0, 2), (1, 2, 0)])
def test_a_textured_plane_is_found(camera, order):
    views = [views_of(camera, num=3)[i] for i in order]
    first, *others = [map_of(v) for v in views]
    part = np.zeros((192, 240), bool)
    part[60:100, 100:160] = True
    dense = stereo_view(first, others, plane_points(), part, 2)
    rays, expected = true_ranges(views[0], dense.lattice_xy())
    known = dense.known
    assert not known[30:50, 50:80].any()
    assert known.mean() > 0.4
    pair = rectify_pair(views[0], views[1], plane_points())
    disparity = pair.left.fx * pair.baseline / (expected * (rays @ pair.rect_from_world.T)[..., 2])
    error_px = ((dense.range_map / expected - 1) * disparity)[known]
    # Matches are good to a fraction of a pixel, and planes average them.
    assert abs(np.median(error_px)) < 0.1
    assert np.median(np.abs(error_px)) < 0.1
    assert (np.abs(error_px) > 1).mean() < 0.02
    cosine = -(dense.normals_in_world[known] * [0, 0, -1]).sum(axis=-1)
    assert np.degrees(np.arccos(np.median(cosine))) < 10
    assert np.isfinite(dense.sigma[known]).all()
    assert (dense.range_map[~known] == 0).all()


def test_without_texture_or_partners_nothing_is_found():
    views = views_of(num=2)
    grey = np.full_like(TEXTURE, 0.5) + RNG.normal(scale=0.002, size=TEXTURE.shape).astype("f4")
    flat = [map_of(v, texture=grey) for v in views]
    nothing = np.zeros((192, 240), bool)
    assert not stereo_view(flat[0], flat[1:], plane_points(), nothing, 2).known.any()
    assert not stereo_view(map_of(views[0]), [], plane_points(), nothing, 2).known.any()


def test_what_the_other_view_does_not_show_is_not_matched():
    left, right = views_of(num=2)
    pair = rectify_pair(left, right, plane_points())
    disparity = match(pair, map_of(left), map_of(right))
    xy = pixel_centers(pair.left.width, pair.left.height)
    xy[..., 0] -= disparity
    rays = pair.right.rays(xy) @ pair.rect_from_world
    seen = right.camera.project(rays @ right.cam_from_world.rotation.T)[np.isfinite(disparity)]
    assert len(seen) > 5000
    assert ((seen > 0) & (seen < [240, 192])).all()
