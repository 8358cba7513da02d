"""The cavity of an analytic vessel, and bodies that have none."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from polmvs.camera import PinholeCamera
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.phase_map import build_phase_map
from polmvs.polarization.region import find_region
from polmvs.polarization.stokes import Stokes
from polmvs.surface.cavities import CavityTolerances, SurfaceFaces, find_cavities
from polmvs.surface.offsets import OffsetTolerances, face_scene
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Cylinder, Group, Plane

CAMERA = PinholeCamera(width=280, height=240, fx=260.0, fy=260.0, cx=140.0, cy=120.0)
RADIUS, HEIGHT, WALL = 0.06, 0.12, 0.012
FOOTPRINT = 0.5 / 260


@dataclass(frozen=True, eq=False)
class Annulus:
    """A flat ring at height ``z`` about an upright axis."""

    z: float
    center: tuple[float, float]
    inner: float
    outer: float

    def intersect(self, origins, rays):
        distance, normals = Plane([0, 0, self.z], [0, 0, 1]).intersect(origins, rays)
        point = origins + np.where(np.isfinite(distance), distance, 0.0)[..., None] * rays
        hit = np.isfinite(distance)
        hit &= np.hypot(point[..., 0], point[..., 1]) <= self.outer
        radius = np.hypot(point[..., 0] - self.center[0], point[..., 1] - self.center[1])
        hit &= radius >= self.inner
        return np.where(hit, distance, np.inf), np.where(hit[..., None], normals, np.nan)


def vessel_maps(bore=RADIUS - WALL, offset=0.0, dark=0.02, weak_inside=False, rim_cut_in=0):
    """Phase maps of a vessel with a bore, dark inside, on an unpolarized bright ground.

    The inside has no phases, or those of its noise (``weak_inside``). The outlines of some views
    (``rim_cut_in``) leave out the rim.
    """
    middle = HEIGHT / 2
    surfaces = [
        Cylinder([0, 0, middle], [0, 0, 1], RADIUS, middle),
        Cylinder([offset, 0, middle], [0, 0, 1], bore, middle),
        Annulus(HEIGHT, (offset, 0.0), bore, RADIUS),
        Annulus(WALL, (offset, 0.0), 0.0, bore),
    ]
    views = ring_of_views(
        8, CAMERA, target=(0, 0, HEIGHT / 2), distance=0.5, elevation_deg=42, roll_deg=5
    )
    rng = np.random.default_rng(0)
    maps = []
    darkest = 0.0 if weak_inside else 0.04
    for index, view in enumerate(views):
        seen = render_view(view, Group(surfaces), s0=0.2, background=0.8)
        xy = np.stack(np.meshgrid(np.arange(280) + 0.5, np.arange(240) + 0.5), axis=-1)
        rays = view.camera.rays(xy) @ view.cam_from_world.rotation
        point = view.center_in_world + np.where(seen.mask, seen.range, 0)[..., None] * rays
        below = point[..., 2] < HEIGHT - 1e-6
        inside = seen.mask & below
        inside &= np.hypot(point[..., 0] - offset, point[..., 1]) < bore + 1e-6
        images = np.where(inside, dark, 1.0) * seen.intensities
        images = np.rint(255 * (images + rng.normal(0, 2e-4, images.shape))) / 255
        i0, i45, i90, i135 = images.astype(np.float32)
        s0, s1, s2 = 0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135
        on_rim = seen.mask & ~below
        outline = seen.mask & ~on_rim if index < rim_cut_in else seen.mask
        region = find_region(s0, s1, s2, s0 > darkest, min_dolp=0.1, mask=outline)
        sigma = np.where(inside & weak_inside, 0.05, 2e-3).astype(np.float32)
        stokes = Stokes(s0=s0, s1=s1, s2=s2, sigma=sigma, valid=s0 > darkest)
        made = build_phase_map(view, stokes, region, Light.SPECULAR)
        known = made.samples.copy()
        if not weak_inside:
            known[inside] = 0
        maps.append(replace(made, samples=known))
    return maps


def closed_cylinder():
    """Faces of the vessel's outside with a flat cap over its mouth."""
    step = FOOTPRINT
    turns = np.arange(0, 2 * np.pi, step / RADIUS)
    heights = np.arange(0.5 * step, HEIGHT, step)
    turn, height = (a.ravel() for a in np.meshgrid(turns, heights))
    out = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    side = out * RADIUS + height[:, None] * [0, 0, 1]
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.arange(-RADIUS, RADIUS, step)]))
    flat = np.hypot(x, y) < RADIUS
    top = np.stack([x[flat], y[flat], np.full(flat.sum(), HEIGHT)], axis=1)
    centers = np.concatenate([side, top])
    normals = np.concatenate([out, np.tile([0.0, 0.0, 1.0], (len(top), 1))])

    def inside_along(origins, direction, distances):
        points = origins + distances[:, None, None] * direction
        across = np.hypot(points[..., 0], points[..., 1])
        return (across < RADIUS) & (points[..., 2] > 0) & (points[..., 2] < HEIGHT)

    areas = np.full(len(centers), step**2)
    return SurfaceFaces(centers, normals, areas, inside_along, FOOTPRINT)


def test_a_dark_mouth_with_a_rim_of_one_width_opens_into_a_cavity():
    maps = vessel_maps()
    (cavity,) = find_cavities(closed_cylinder(), face_scene(maps, AngleModel.PPA))
    assert cavity.thickness == pytest.approx(WALL, abs=0.5 * FOOTPRINT)
    assert cavity.thickness_sigma < 0.7 * FOOTPRINT
    np.testing.assert_allclose(cavity.rim.normal, [0, 0, 1], atol=0.01)
    rng = np.random.default_rng(0)
    points = rng.uniform([-0.07, -0.07, 0.03], [0.07, 0.07, HEIGHT - 0.003], (3000, 3))
    inwards = RADIUS - WALL - np.hypot(points[:, 0], points[:, 1])
    values = cavity.values(points)
    clear = np.abs(inwards) > 1e-3
    assert np.mean((values > 0)[clear] == (inwards > 0)[clear]) > 0.99
    near = np.abs(inwards) < 4e-3
    assert np.quantile(np.abs(values - inwards)[near], 0.9) < 1e-3
    # Nothing under the bottom, nor beside the vessel above its rim.
    assert (cavity.values(np.array([[0, 0, 0.004], [0.055, 0, HEIGHT + 0.002]])) < 0).all()


@pytest.mark.parametrize("harm", [{"weak_inside": True, "dark": 0.1}, {"rim_cut_in": 4}])
def test_a_mouth_is_found_by_its_darkness(harm):
    """With a mask the dark inside has phases, and some of them agree with the rim's normal."""
    maps = vessel_maps(**harm)
    (cavity,) = find_cavities(closed_cylinder(), face_scene(maps, AngleModel.PPA))
    assert cavity.thickness == pytest.approx(WALL, abs=0.5 * FOOTPRINT)


def test_a_plane_found_from_few_faces_has_all_of_its_faces():
    """The planes of a surface come from a sample, in which the rim may be a few faces."""
    surface, scene = closed_cylinder(), face_scene(vessel_maps(), AngleModel.PPA)
    few = OffsetTolerances(num_trials=150)
    (cavity,) = find_cavities(surface, scene, offset_tolerances=few)
    (expected,) = find_cavities(surface, scene)
    assert cavity.thickness == pytest.approx(expected.thickness, abs=0.1 * FOOTPRINT)


def test_a_mouth_is_round_though_its_cells_are_not():
    """To a tenth of a pixel; cut at whole cells it goes in and out by 0.15."""
    (cavity,) = find_cavities(closed_cylinder(), face_scene(vessel_maps(), AngleModel.PPA))
    around = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    radii = RADIUS - WALL + np.arange(3, -3, -0.02) * FOOTPRINT
    across = np.stack([np.cos(around), np.sin(around)], axis=-1) * radii[:, None, None]
    points = np.dstack([across, np.full(across.shape[:2], HEIGHT - 0.001)])
    free = cavity.values(points.reshape(-1, 3)).reshape(points.shape[:2]) > 0
    off = (radii[free.argmax(axis=0)] - (RADIUS - WALL)) / FOOTPRINT
    assert abs(off.mean()) < 0.15
    assert off.std() < 0.1


def test_a_mouth_once_found_is_looked_for_at_its_place():
    surface, scene = closed_cylinder(), face_scene(vessel_maps(), AngleModel.PPA)
    before = find_cavities(surface, scene)
    x, y, z = surface.centers.T
    # Phases have bent one side of the cap up, and no plane is found in it.
    bent_up = (surface.normals[:, 2] > 0.5) & (x > 0)
    height = np.where(bent_up, z + 3.5 * FOOTPRINT, z)
    bent = replace(surface, centers=np.stack([x, y, height], axis=1))
    no_plane = CavityTolerances(max_planes=0)
    assert find_cavities(bent, scene, tolerances=no_plane) == ()
    (cavity,) = find_cavities(bent, scene, tolerances=no_plane, before=before)
    assert cavity.thickness == pytest.approx(WALL, abs=0.5 * FOOTPRINT)
    assert cavity.rim.offset == pytest.approx(HEIGHT, abs=0.5 * FOOTPRINT)


def test_a_closed_body_has_no_cavity():
    maps = vessel_maps(bore=1e-4)
    assert find_cavities(closed_cylinder(), face_scene(maps, AngleModel.PPA)) == ()


def test_a_rim_of_varying_width_infers_nothing():
    maps = vessel_maps(bore=0.035, offset=0.015)
    assert find_cavities(closed_cylinder(), face_scene(maps, AngleModel.PPA)) == ()


def test_a_bright_label_without_phase_is_no_mouth():
    maps = vessel_maps(dark=1.0)
    assert find_cavities(closed_cylinder(), face_scene(maps, AngleModel.PPA)) == ()


def test_too_few_views_find_nothing():
    maps = vessel_maps()[:2]
    assert find_cavities(closed_cylinder(), face_scene(maps, AngleModel.PPA)) == ()
