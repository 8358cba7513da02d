"""Printed captures: light of the print, the same place alike from everywhere, true cameras."""

import numpy as np
import pytest

from polmvs.camera import sample_image
from polmvs.errors import DataError
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.images import read_gray
from polmvs.synthetic.printed import orbit_views, render_printed_mosaic, render_printed_truth
from polmvs.synthetic.printed_capture import (
    Part,
    camera_of,
    printed_model,
    scene_of,
    write_printed_capture,
)

CAMERA = camera_of(120)
SCENE = scene_of(Part.BOARD)


@pytest.fixture(scope="module")
def views():
    return orbit_views(3, CAMERA, seed=2)


def half_size(mosaic):
    return mosaic.reshape(CAMERA.height, 2, CAMERA.width, 2).mean(axis=(1, 3))


def test_only_the_part_is_polarized(views) -> None:
    mosaic = render_printed_mosaic(views[0], SCENE)
    i90, i0 = mosaic[::2, ::2], mosaic[1::2, 1::2]
    part, _ = render_printed_truth(views[0], SCENE)
    dolp = np.abs(i0 - i90) / (i0 + i90)
    # Beside edges of the print and of the part the samples of a cell see different things.
    assert np.median(dolp[~part.mask]) < 0.05
    labelled = half_size(mosaic)[part.mask] > 0.16  # the part itself reflects 0.2 in all
    assert 0.005 < labelled.mean() < 0.2
    assert part.dolp[part.mask].max() > 0.1


def test_a_place_looks_the_same_from_everywhere(views) -> None:
    model = printed_model(SCENE, views, num_points=600)
    brightness = np.full((len(views), 600), np.nan)
    for index, view in enumerate(views):
        seen = model.tracks.obs_view == index
        image = half_size(render_printed_mosaic(view, SCENE)).astype(np.float32)
        xy = model.tracks.obs_xy[seen]
        brightness[index, model.tracks.obs_track[seen]] = sample_image(image, xy)
    both = np.isfinite(brightness[:2]).all(axis=0)
    assert both.sum() > 200
    assert np.corrcoef(brightness[:2, both])[0, 1] > 0.9


def test_points_project_where_they_are_observed(views) -> None:
    tracks = printed_model(SCENE, views, num_points=200).tracks
    for index, view in enumerate(views):
        seen = tracks.obs_view == index
        xy = view.project(tracks.points_in_world[tracks.obs_track[seen]])
        np.testing.assert_allclose(xy, tracks.obs_xy[seen], atol=1e-9)
        depth = render_printed_truth(view, SCENE)[1]
        cells = np.floor(xy).astype(int)
        z = (view.cam_from_world * tracks.points_in_world[tracks.obs_track[seen]])[:, 2]
        assert np.median(np.abs(depth[cells[:, 1], cells[:, 0]] - z)) < 0.005


def test_orders_of_names(views) -> None:
    def azimuths(ordered):
        centers = [v.center_in_world for v in orbit_views(20, CAMERA, ordered=ordered)]
        return (np.arctan2(*np.array(centers).T[[1, 0]]) + 0.1) % (2 * np.pi)  # none at the seam

    assert np.all(np.diff(azimuths(True)) > 0)
    assert not np.all(np.diff(azimuths(False)) > 0)
    np.testing.assert_allclose(np.sort(azimuths(False)), azimuths(True), atol=1e-9)


def test_written_capture(tmp_path) -> None:
    views = orbit_views(2, camera_of(60))
    write_printed_capture(tmp_path / "a", views, scene_of(Part.DOME), maps=True)
    truth = open_ground_truth(tmp_path / "a")
    assert list(truth.views) == ["000.png", "001.png"]
    for view in views:
        assert read_gray(tmp_path / "a" / "raw" / view.name).shape == (100, 120)
        center = truth.views[view.name].center_in_world
        np.testing.assert_allclose(center, view.center_in_world, atol=1e-12)
        mask, normals = truth.mask(view.name), truth.normals(view.name)
        assert 0.02 < mask.mean() < 0.5
        # Of a sphere about a point under the table, as the camera sees it.
        center = view.cam_from_world * np.array([0.0, 0.0, -0.08])
        rays = view.camera.rays(np.argwhere(mask)[:, ::-1] + 0.5)
        points = rays * (truth.depth(view.name)[mask] / rays[:, 2])[:, None]
        np.testing.assert_allclose((points - center) / 0.12, normals[mask], atol=2e-3)
    with pytest.raises(DataError, match="exists already"):
        write_printed_capture(tmp_path / "a", views, SCENE)
