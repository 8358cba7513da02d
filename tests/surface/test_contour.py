import numpy as np
import pytest
from scenes import CAMERA, board_scene

from polmvs.camera import pixel_centers
from polmvs.polarization.kinds import AngleModel
from polmvs.surface.contour import cover_with_contours, direction_field, trace_contours


@pytest.fixture(scope="module")
def scene():
    return board_scene(1)


def field_of(scene, model, passable=None):
    rays = CAMERA.rays(pixel_centers(CAMERA.width, CAMERA.height)).astype(np.float32)
    rendered = scene.rendered[0]
    samples = np.dstack(
        [
            rendered.dolp * np.cos(2 * rendered.phase),
            rendered.dolp * np.sin(2 * rendered.phase),
            np.ones_like(rendered.dolp),
        ]
    )
    samples = np.nan_to_num(samples).astype(np.float32)
    passable = rendered.mask if passable is None else passable
    return direction_field(model, samples, rays, passable)


def true_range(scene, xy):
    view, surface = scene.views[0], scene.surface
    rays = view.camera.rays(xy) @ view.cam_from_world.rotation
    center = view.center_in_world
    normal = surface.normal / np.linalg.norm(surface.normal)
    return ((surface.point - center) @ normal) / (rays @ normal)


def seeds_of(scene):
    pixels = np.argwhere(scene.rendered[0].mask)
    return pixels[:: len(pixels) // 20][:, ::-1] + 0.5


def test_a_ppa_contour_keeps_the_range(scene):
    contours = trace_contours(field_of(scene, AngleModel.PPA), seeds_of(scene), step_px=0.5)
    spread = []
    for curve in np.unique(contours.curve):
        ranges = true_range(scene, contours.xy[contours.curve == curve])
        if len(ranges) > 20:
            spread.append(np.ptp(ranges) / ranges.mean())
    assert len(spread) >= 10
    # Bilinear direction and a midpoint step: far below a pixel's share of the range.
    assert max(spread) < 2e-3


def test_an_opa_contour_keeps_neither_range_nor_depth_of_a_perspective_view(scene):
    contours = trace_contours(field_of(scene, AngleModel.OPA), seeds_of(scene), step_px=0.5)
    worst = 0.0
    for curve in np.unique(contours.curve):
        xy = contours.xy[contours.curve == curve]
        depth = true_range(scene, xy) * CAMERA.rays(xy)[:, 2]
        worst = max(worst, np.ptp(depth) / depth.mean())
    assert worst > 0.02


def test_the_step_is_half_a_pixel_and_nodes_are_ordered(scene):
    contours = trace_contours(field_of(scene, AngleModel.PPA), seeds_of(scene)[:3], step_px=0.5)
    for curve in np.unique(contours.curve):
        mine = contours.curve == curve
        steps = np.linalg.norm(np.diff(contours.xy[mine], axis=0), axis=-1)
        np.testing.assert_allclose(steps, 0.5, atol=1e-3)
        np.testing.assert_allclose(np.diff(contours.arc_px[mine]), 0.5, atol=1e-5)


def test_contours_stop_at_the_edge_of_the_passable_pixels(scene):
    passable = scene.rendered[0].mask.copy()
    passable[:, 80:84] = False
    contours = trace_contours(
        field_of(scene, AngleModel.PPA, passable), seeds_of(scene), step_px=0.5
    )
    col, row = contours.xy[:, 0].astype(int), contours.xy[:, 1].astype(int)
    assert passable[row, col].mean() > 0.98  # the last step may reach into the edge's half pixel
    for curve in np.unique(contours.curve):
        x = contours.xy[contours.curve == curve, 0]
        assert (x < 81).all() or (x > 83).all()


def test_a_circular_field_gives_closed_curves_once():
    xy = pixel_centers(100, 100) - 50.0
    angle = np.arctan2(xy[..., 1], xy[..., 0]) + np.pi / 2
    field = np.dstack([np.cos(2 * angle), np.sin(2 * angle)]).astype(np.float32)
    contours = trace_contours(field, np.array([[80.0, 50.0]]), step_px=0.5)
    radius = np.linalg.norm(contours.xy - 50.0, axis=-1)
    assert np.ptp(radius) < 0.5
    assert len(contours.xy) * 0.5 == pytest.approx(2 * np.pi * 30, rel=0.05)


def test_covering_reaches_every_part_of_the_region_at_about_the_spacing(scene):
    mask = scene.rendered[0].mask
    contours = cover_with_contours(
        field_of(scene, AngleModel.PPA), np.zeros((0, 2)), mask, spacing_px=6.0, step_px=0.5
    )
    pixels = np.argwhere(mask)[:, ::-1] + 0.5
    gap = np.sqrt(((pixels[:, None] - contours.xy[None]) ** 2).sum(-1)).min(axis=1)
    assert gap.max() < 9
    assert len(contours.xy) < 3 * mask.sum() / 36


def test_places_without_direction_become_single_nodes():
    inside = np.zeros((60, 60), bool)
    inside[10:50, 10:50] = True
    field = np.zeros((60, 60, 2), np.float32)
    contours = cover_with_contours(field, np.zeros((0, 2)), inside, spacing_px=5.0, step_px=0.5)
    assert len(contours.xy) >= 49
    assert len(np.unique(contours.curve)) == len(contours.xy)
