from dataclasses import replace

import numpy as np
import pytest
from analytic_objects import (
    euler_number,
    looking_at,
    phase_maps_of,
    ring_of_views,
    sphere,
    torus,
    union,
)

from polmvs.surface.global_surface import consistent_hull
from polmvs.surface.ground import SupportingPlane
from polmvs.surface.surface_view import Silhouette, surface_view
from polmvs.surface.visual_hull import (
    HullTolerances,
    visual_hull,
)


def views_of(distance, views):
    maps = phase_maps_of(distance, views)
    return [surface_view(m, Silhouette(m.region.inside, m.region.inside)) for m in maps]


@pytest.fixture(scope="module")
def ball():
    return views_of(sphere(), ring_of_views(12, elevations=(5.0, 45.0, -30.0)))


def test_the_hull_holds_the_object_and_little_more(ball):
    hull = visual_hull(ball, wrong_share=0.0)
    radii = np.linalg.norm(hull.mesh.vertices, axis=1)
    assert radii.min() > 1 - 1.5 * hull.gsd
    assert np.median(radii) < 1.08
    assert euler_number(hull.mesh) == 2
    assert hull.gsd == pytest.approx(5 / 150, rel=0.05)


def test_one_wrong_mask_does_no_harm(ball):
    good = visual_hull(ball).mesh
    certain = np.zeros_like(ball[0].silhouette.certain)
    certain[:8, :8] = True  # another thing altogether
    wrong = [replace(ball[0], silhouette=Silhouette(certain, certain)), *ball[1:]]
    mesh = visual_hull(wrong).mesh
    assert np.abs(np.linalg.norm(mesh.vertices, axis=1)).min() > 0.9
    assert mesh.face_areas.sum() == pytest.approx(good.face_areas.sum(), rel=0.1)


@pytest.mark.parametrize("num_wrong", [0, 1, 3])
def test_as_many_wrong_masks_are_tolerated_as_there_are(ball, num_wrong):
    certain = np.zeros_like(ball[0].silhouette.certain)
    certain[:8, :8] = True
    wrong = [replace(view, silhouette=Silhouette(certain, certain)) for view in ball[::4]]
    hull, _ = consistent_hull([*wrong[:num_wrong], *ball[num_wrong:]], None)
    radii = np.linalg.norm(hull.mesh.vertices, axis=1)
    assert radii.min() > 0.9
    assert np.median(radii) < (1.08 if num_wrong == 0 else 1.3)


def test_several_objects_and_loops(ball):
    views = ring_of_views(12, elevations=(10.0, 40.0, 65.0))
    pair = union(sphere(0.4, (0.7, 0, 0)), sphere(0.4, (-0.7, 0, 0)))
    hull = visual_hull(views_of(pair, views), wrong_share=0.0)
    assert len(set(hull.mesh.face_components)) == 2
    ring = visual_hull(views_of(torus(), views), wrong_share=0.0)
    assert euler_number(ring.mesh) == 0


def test_an_object_cut_by_the_images_borders_is_not_carved_there():
    """Views from near show the ball only in part: what they do not show is not denied."""
    far = ring_of_views(8, elevations=(10.0, 50.0))
    near = [
        looking_at((2.4, 0.3, 0.4), target=(0, 0.9, 0), name="near0.png"),
        looking_at((-0.2, 2.4, 0.4), target=(0.9, 0, 0), name="near1.png"),
    ]
    hull = visual_hull(views_of(sphere(), far + near), wrong_share=0.0)
    assert np.linalg.norm(hull.mesh.vertices, axis=1).min() > 0.93


def test_unknown_pixels_do_not_carve(ball):
    inside = ball[0].silhouette.certain
    certain = inside.copy()
    certain[:, 66:] = False
    doubtful = [replace(ball[0], silhouette=Silhouette(certain, inside)), *ball[1:]]
    area = visual_hull(doubtful, wrong_share=0.0).mesh.face_areas.sum()
    assert area == pytest.approx(visual_hull(ball, wrong_share=0.0).mesh.face_areas.sum(), rel=0.01)
    denied = [replace(ball[0], silhouette=Silhouette(certain, certain)), *ball[1:]]
    assert visual_hull(denied, wrong_share=0.0).mesh.face_areas.sum() < 0.9 * area


def test_the_supporting_plane_bounds_the_hull(ball):
    plane = SupportingPlane(np.array([0.0, 0, 1.0]), -0.3)
    mesh = visual_hull(ball, plane).mesh
    depth = 3 * HullTolerances.step_px * 5 / 150
    assert mesh.vertices[:, 2].min() == pytest.approx(-0.3 - depth, abs=0.06)


def test_free_space_is_carved(ball):
    hull = visual_hull(ball).carved([lambda points: points[:, 0] - 0.2])
    assert hull.mesh.vertices[:, 0].max() == pytest.approx(0.2, abs=0.05)


def test_no_common_object_is_an_empty_hull(ball):
    certain = np.zeros_like(ball[0].silhouette.certain)
    nothing = [replace(v, silhouette=Silhouette(certain, certain), has_outline=False) for v in ball]
    assert len(visual_hull(nothing).mesh.faces) == 0
    assert len(visual_hull(ball[:1]).mesh.faces) == 0
    corner = certain.copy()
    corner[:5, :5] = True
    scattered = [replace(v, silhouette=Silhouette(corner, corner)) for v in ball]
    assert len(visual_hull(scattered, wrong_share=0.0).mesh.faces) == 0
