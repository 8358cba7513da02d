"""The first surface of bowls, and of solids with the same silhouettes."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from analytic_objects import phase_maps_of, ring_of_views
from scipy.spatial import ConvexHull

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.polarization.kinds import AngleModel
from polmvs.surface.cavities import find_vessel
from polmvs.surface.ground import SupportingPlane
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh
from polmvs.surface.observations import Looking
from polmvs.surface.solver import first_fit
from polmvs.surface.surface_view import Silhouette, surface_view
from polmvs.surface.vessels import opened_hull, rim_height
from polmvs.surface.visual_hull import visual_hull

WALL = 0.16
GROUND = SupportingPlane(np.array([0.0, 0.0, 1.0]), -1.0)


def half_ball(points):
    return np.maximum(np.linalg.norm(points, axis=-1) - 1, points[..., 2])


def bowl(points):
    """Half a hollow ball, open at the top, whose rim has the height 1 above the ground."""
    return np.maximum(half_ball(points), 1 - WALL - np.linalg.norm(points, axis=-1))


NO_POINTS = np.zeros((0, 3))
BOTTOM = 0.45  # thickness of the bottom of a bowl whose wall is WALL thick


def thick_bowl(points):
    """Its inside is half an ellipsoid."""
    radii = np.array([1 - WALL, 1 - WALL, 1 - BOTTOM])
    inside = (np.linalg.norm(points / radii, axis=-1) - 1) * radii.min()
    return np.maximum(half_ball(points), -inside)


def cylinder(points, radius, low, high=0.6):
    beside = np.hypot(points[..., 0], points[..., 1]) - radius
    return np.maximum(beside, np.maximum(points[..., 2] - high, low - points[..., 2]))


def drum(points):
    """Phases contradict the cap of its hull more than the inside of a vessel."""
    return cylinder(points, 1.0, -1.0, 0.0)


def beaker(points):
    """Deeper than wide."""
    inside = cylinder(points - [0, 0, 0.3], 0.45, -1.2)
    return np.maximum(cylinder(points, 0.6, -1.0), -inside)


def given(distance):
    camera = PinholeCamera(width=264, height=224, fx=300, fy=300, cx=132, cy=112)
    views = ring_of_views(8, elevations=(20.0, 50.0))
    views = [replace(view, camera=camera) for view in views]
    maps = phase_maps_of(distance, views)
    views = [surface_view(m, Silhouette(m.region.inside, m.region.inside)) for m in maps]
    hull = visual_hull(views, GROUND)
    return hull, first_fit(views, Looking(angle_model=AngleModel.PPA, tilt_aware=False), hull.gsd)


@pytest.fixture(scope="module")
def of_bowl():
    return given(bowl)


def test_silhouettes_show_the_height_of_the_rim(of_bowl):
    hull, fit = of_bowl
    cap = GROUND.height(hull.mesh.vertices).max()
    height = rim_height(RayScene(hull.mesh), fit.views, GROUND)
    assert height == pytest.approx(1, abs=2 * hull.gsd)
    assert cap > height + 5 * hull.gsd


def meet_half_ball(center, rays):
    """Which rays (..., 3) from a center (3,) meet the half ball: its ball below the rim's plane."""
    along = rays @ center
    root = np.sqrt(np.maximum(along**2 - (center @ center - 1), 0))
    heights = [center[2] + (-along + sign * root) * rays[..., 2] for sign in (-1, 1)]
    return (root > 0) & (np.minimum(*heights) < 0)


def test_what_silhouettes_hold_wrongly_is_no_rim(of_bowl):
    """In each view a small block floats behind the bowl, above the rim."""
    hull, _ = of_bowl
    camera = PinholeCamera(width=792, height=672, fx=900, fy=900, cx=396, cy=336)
    views = [replace(view, camera=camera) for view in ring_of_views(8, elevations=(20.0, 50.0))]
    corners = 0.015 * np.array(np.meshgrid([-1, 1], [-1, 1], [-1, 1])).reshape(3, -1).T
    sides = ConvexHull(corners).simplices
    vertices, faces, seen = [hull.mesh.vertices], [hull.mesh.faces], []
    for view in views:
        away = -view.center_in_world[:2] / np.linalg.norm(view.center_in_world[:2])
        block = corners + np.array((1.25 * away[0], 1.25 * away[1], 0.25))
        faces.append(sides + sum(len(own) for own in vertices))
        vertices.append(block)
        center = view.center_in_world
        rays = view.rays_in_world(pixel_centers(camera.width, camera.height))
        hit = RayScene(TriangleMesh(block, sides)).cast(center, rays.reshape(-1, 3)).distance
        mask = meet_half_ball(center, rays) | np.isfinite(hit).reshape(rays.shape[:2])
        silhouette = Silhouette(mask, mask)
        seen.append(SimpleNamespace(view=view, center=center, silhouette=silhouette))
    scene = RayScene(TriangleMesh(np.concatenate(vertices), np.concatenate(faces)))
    assert rim_height(scene, seen, GROUND) == pytest.approx(1, abs=hull.step)


def test_no_silhouette_shows_no_height(of_bowl):
    hull, fit = of_bowl
    assert np.isnan(rim_height(RayScene(hull.mesh), [], GROUND))
    assert opened_hull(hull, GROUND, replace(fit, views=[])) == (hull, None)


def test_the_inside_of_a_bowl_is_carved(of_bowl):
    carved, walls = opened_hull(of_bowl[0], GROUND, of_bowl[1])
    assert walls is not None
    free, wall = [[0, 0, -0.3], [0.4, 0, -0.2], [0, 0, 0.2]], [[0.9, 0, -0.2], [0, -0.9, -0.2]]
    assert (carved.distances(np.array(free)) > 0).all()
    assert (carved.distances(np.array(wall)) < 0).all()


def depth_on_axis(distances):
    """Depth of the free space below the middle of the rim."""
    depths = np.linspace(0.0, 1.0, 500)
    below = np.stack([0 * depths, 0 * depths, -depths], axis=-1)
    return depths[distances(below) > 0].max()


@pytest.mark.parametrize(("solid", "bottom"), [(bowl, WALL), (thick_bowl, BOTTOM)])
def test_the_bottom_is_as_thick_as_phases_show(solid, bottom):
    hull, fit = given(solid)
    carved, walls = opened_hull(hull, GROUND, fit)
    assert walls is not None
    # Within two cells of the hull: its outside is wider than the bowl. Measured: 0.9 and 0.6.
    assert depth_on_axis(carved.distances) == pytest.approx(1 - bottom, abs=2 * hull.step)


@pytest.mark.parametrize(("num", "bottom"), [(60, BOTTOM), (9, WALL)])
def test_points_inside_tell_the_depth_that_phases_miss(of_bowl, num, bottom):
    """Phases prefer a bottom as thick as the wall. A sixth of the points are mirror images."""
    hull, _ = of_bowl
    rng = np.random.default_rng(0)
    directions = rng.normal(size=(num, 3)) * [1, 1, -2]
    directions[:, 2] = -np.abs(directions[:, 2])
    radii = np.array([1 - WALL, 1 - WALL, 1 - BOTTOM])
    points = directions / np.linalg.norm(directions / radii, axis=1, keepdims=True)
    points[: num // 6] = rng.uniform(-0.3, 0.3, (num // 6, 3))

    def gain(cavity):
        return np.full(8, 1 - 10 * np.log(cavity.thickness / WALL) ** 2 + cavity.depth)

    top = replace(GROUND, offset=GROUND.offset + 1.0)
    vessel = find_vessel(RayScene(hull.mesh), top, hull.gsd, gain, points)
    assert vessel is not None
    assert vessel.depth == pytest.approx(1 - bottom, abs=2 * hull.step)


@pytest.mark.parametrize("solid", [half_ball, drum, beaker])
def test_a_lid_and_a_deep_vessel_keep_their_hull(solid):
    hull, fit = given(solid)
    same, walls = opened_hull(hull, GROUND, fit)
    assert same is hull
    assert walls is None


@pytest.mark.parametrize(
    ("gains", "is_open"), [([1.0] * 8, True), ([9.0, 9, -1, -1, -1, -1, -1, -1], False)]
)
def test_a_vessel_is_carved_into_a_rough_hull_only_if_views_agree(of_bowl, gains, is_open):
    hull, _ = of_bowl

    def gain(cavity):
        return np.array(gains) * (1 - np.log(cavity.thickness / WALL) ** 2)

    top = replace(GROUND, offset=GROUND.offset + 1.0)
    vessel = find_vessel(RayScene(hull.mesh), top, hull.gsd, gain, NO_POINTS)
    assert (vessel is not None) == is_open


def test_without_a_plane_no_vessel_is_looked_for(of_bowl):
    hull, fit = of_bowl
    assert opened_hull(hull, None, fit) == (hull, None)


def test_a_plane_below_the_whole_hull_is_the_rim_of_no_vessel(of_bowl):
    hull, _ = of_bowl
    lowest = hull.mesh.centers[:, 2].min()

    def gain(cavity):
        return np.ones(8)

    for below in (0.25, 1.0):  # its bottom is near the plane; the plane is far below
        top = replace(GROUND, offset=float(lowest - below * hull.gsd))
        assert find_vessel(RayScene(hull.mesh), top, hull.gsd, gain, NO_POINTS) is None
