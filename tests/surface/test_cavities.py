"""The cavity of an analytic vessel, and bodies that have none."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import sparse

from polmvs.camera import PinholeCamera
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.phase_map import build_phase_map
from polmvs.polarization.region import find_region
from polmvs.polarization.stokes import Stokes
from polmvs.surface.cavities import (
    THICKNESS_RATIO,
    THINNEST,
    CavityTolerances,
    Opening,
    SurfaceFaces,
    find_cavities,
    surface_faces,
)
from polmvs.surface.mesh_geometry import RayScene, mesh_from_grid, visible_points
from polmvs.surface.offsets import MAX_COST, patch_scene
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Cylinder, Group, Plane

CAMERA = PinholeCamera(width=280, height=240, fx=260.0, fy=260.0, cx=140.0, cy=120.0)
RADIUS, HEIGHT, WALL = 0.06, 0.12, 0.012
GSD = 0.5 / 260


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


@dataclass(frozen=True, eq=False)
class Lip:
    """The upper half of a torus about the vertical axis, by sphere tracing."""

    z: float
    major: float
    minor: float

    def intersect(self, origins, rays):
        origins = np.broadcast_to(origins, rays.shape)
        near = np.full(rays.shape[:-1], 0.3)
        for _ in range(200):
            point = origins + near[..., None] * rays
            across = np.hypot(point[..., 0], point[..., 1]) - self.major
            height = point[..., 2] - self.z
            near = near + np.hypot(across, height) - self.minor
        hit = (np.abs(np.hypot(across, height) - self.minor) < 1e-6) & (height > 0)
        outwards = point[..., :2] / np.hypot(point[..., 0], point[..., 1])[..., None]
        normals = np.dstack([outwards * across[..., None], height]) / self.minor
        return np.where(hit, near, np.inf), np.where(hit[..., None], normals, np.nan)


def vessel_maps(
    bore=RADIUS - WALL, offset=0.0, dark=0.02, weak_inside=False, rim_cut_in=0, rounded=False
):
    """Phase maps of a vessel with a bore, dark inside, on an unpolarized bright ground.

    The inside has no phases, or those of its noise (``weak_inside``). The outlines of some views
    (``rim_cut_in``) leave out the rim, which is flat or ``rounded``.
    """
    top = HEIGHT - 0.5 * WALL * rounded
    surfaces = [
        Cylinder([0, 0, top / 2], [0, 0, 1], RADIUS, top / 2),
        Cylinder([offset, 0, top / 2], [0, 0, 1], bore, top / 2),
        Annulus(HEIGHT, (offset, 0.0), bore, RADIUS)
        if not rounded
        else Lip(top, RADIUS - 0.5 * WALL, 0.5 * WALL),
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
        below = point[..., 2] < top - 1e-6
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


def closed_cylinder(bore=RADIUS - WALL, offset=0.0):
    """Faces of the vessel's outside with a flat cap over its opening."""
    step = GSD
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

    across = np.hypot(centers[:, 0] - offset, centers[:, 1])
    is_top = normals[:, 2] > 0.5
    patch = is_top & (across < bore)
    border = is_top & ~patch & (across < bore + 1.5 * step)
    opening = Opening(np.flatnonzero(patch), np.flatnonzero(border), np.pi * bore**2)
    return SurfaceFaces(centers, normals, ~patch, [opening], inside_along, GSD)


def closed_rounded_vessel():
    """Faces of the vessel with a rounded rim, up to a cap that bulges over its opening."""
    step, minor = GSD, 0.5 * WALL
    middle = HEIGHT - minor
    turns = np.arange(0, 2 * np.pi, step / RADIUS)
    heights = np.arange(0.5 * step, middle, step)
    # The angle across the lip, from outside to where its phases end.
    profile = [(RADIUS, z, 1.0, 0.0) for z in heights]
    profile += [
        (RADIUS - minor + minor * np.cos(a), middle + minor * np.sin(a), np.cos(a), np.sin(a))
        for a in np.arange(0.5 * step / minor, np.radians(150), step / minor)
    ]
    bore = RADIUS - minor - minor * np.cos(np.radians(30))
    cap = [(r, middle + 0.5 * (bore - r), 0.45, 0.89) for r in np.arange(step, bore - step, step)]
    rows = np.array([(*one, k, t) for k, one in enumerate([*profile, *cap]) for t in turns])
    radius, z, across, up, number, turn = rows.T
    out = np.stack([np.cos(turn), np.sin(turn), np.zeros_like(turn)], axis=1)
    centers = radius[:, None] * out + z[:, None] * [0, 0, 1]
    normals = across[:, None] * out + up[:, None] * [0, 0, 1]

    def inside_along(origins, direction, distances):
        points = origins + distances[:, None, None] * direction
        far, z = np.hypot(points[..., 0], points[..., 1]), points[..., 2]
        lip = (np.hypot(far - RADIUS + minor, z - middle) < minor) & (z > middle)
        return ((far < RADIUS) & (z > 0) & (z < middle)) | lip

    patch = number >= len(profile)
    border = number == len(profile) - 1
    opening = Opening(np.flatnonzero(patch), np.flatnonzero(border), np.pi * bore**2)
    return SurfaceFaces(centers, normals, ~patch, [opening], inside_along, GSD)


def found_in(surface, maps, information=lambda cavity: np.zeros(8)):
    """Cavities of a surface; without ``information`` the phases in its openings say nothing."""
    scene = patch_scene(maps, AngleModel.PPA)

    def of_faces(mesh):
        pixels = np.zeros((len(maps), len(mesh.faces)))
        for row, one in zip(pixels, maps, strict=True):
            seen, _, cosine = visible_points(
                RayScene(mesh),
                one.view.center_in_world,
                mesh.centers,
                mesh.face_normals,
                min_cosine=0.2,
            )
            row[seen] = mesh.face_areas[seen] * cosine / GSD**2
        losses = scene.losses(mesh.centers, mesh.face_normals.T)
        return sparse.csr_array(pixels * np.nan_to_num(MAX_COST - losses))

    def gain(cavity):
        return information(cavity) - information(None)

    return find_cavities(surface, scene, gain, of_faces)


def information_of(inside, bore=RADIUS - WALL):
    """How well normals agree with those of what is ``inside`` an opening, for each of 8 views."""
    x, y = (a.ravel() for a in np.meshgrid(*2 * [np.linspace(-bore, bore, 41)]))
    start = np.stack([x, y, np.full_like(x, HEIGHT)], axis=1)[np.hypot(x, y) < bore - GSD]
    views = ring_of_views(8, CAMERA, target=(0, 0, HEIGHT), distance=0.5, elevation_deg=42)
    rays = [start - view.center_in_world for view in views]
    rays = [ray / np.linalg.norm(ray, axis=1)[:, None] for ray in rays]
    shown = [inside.intersect(start + 1e-9 * ray, ray)[1] for ray in rays]

    def information(cavity):
        found = np.zeros(8)
        for number, (ray, normals) in enumerate(zip(rays, shown, strict=True)):
            expected = np.tile([0.0, 0.0, 1.0], (len(start), 1))
            if cavity is not None:
                place = start - np.array([0, 0, GSD])
                for _ in range(60):  # sphere tracing
                    place = place + np.maximum(cavity.values(place), 0)[:, None] * ray
                sides = GSD * np.eye(3)
                expected = np.stack(
                    [cavity.values(place + side) - cavity.values(place - side) for side in sides],
                    axis=1,
                )
                expected /= np.maximum(np.linalg.norm(expected, axis=1), 1e-12)[:, None]
            cosine = np.clip(np.einsum("ni,ni->n", expected, normals), -1, 1)
            found[number] = -np.square(np.arccos(cosine)).sum()
        return found

    return information


def test_phases_measure_the_wall_of_a_bright_vessel():
    bore = RADIUS - WALL
    wall = Cylinder([0, 0, HEIGHT / 2], [0, 0, 1], bore, HEIGHT / 2)
    inside = Group([wall, Annulus(WALL, (0.0, 0.0), 0.0, bore)])
    (cavity,) = found_in(closed_cylinder(), vessel_maps(dark=1.0), information_of(inside))
    assert cavity.thickness == pytest.approx(WALL, abs=GSD)
    assert 0 < cavity.thickness_sigma < GSD
    np.testing.assert_allclose(cavity.rim.normal, [0, 0, 1], atol=1e-3)
    assert cavity.rim.offset == pytest.approx(HEIGHT, abs=0.1 * GSD)
    inner = np.array([[bore - 2 * GSD, 0, 0.06], [bore + 2 * GSD, 0, 0.06]])
    assert (cavity.values(inner) > 0).tolist() == [True, False]


def test_a_bright_lid_whose_phases_fit_is_no_opening():
    lid = Plane([0, 0, HEIGHT - 1e-6], [0, 0, 1])
    assert found_in(closed_cylinder(), vessel_maps(dark=1.0), information_of(lid)) == ()


def information_of_views(gains, slope):
    """Of each view's phases, likeliest at the true wall if there is a slope."""

    def information(cavity):
        if cavity is None:
            return np.zeros(len(gains))
        return np.array(gains) * (1 - slope * np.log(cavity.thickness / WALL) ** 2)

    return information


def test_the_wall_that_is_likeliest_in_total_is_taken_though_views_disagree():
    # In a vessel of car paint some views show light that was reflected twice.
    information = information_of_views([9.0, 9, -1, -1, -1, -1, -1, -1], 1.0)
    (cavity,) = found_in(closed_cylinder(), vessel_maps(dark=1.0), information)
    assert cavity.thickness == pytest.approx(WALL, abs=GSD)


def test_a_wall_thinner_than_the_first_is_found_though_that_adds_nothing():
    information = information_of_views([1.0] * 8, 50.0)
    (cavity,) = found_in(closed_cylinder(), vessel_maps(dark=1.0), information)
    first = CavityTolerances.rounding * THICKNESS_RATIO * GSD
    assert 1 - 50 * np.log(first / WALL) ** 2 < 0
    assert cavity.thickness == pytest.approx(WALL, abs=0.5 * GSD)


@pytest.mark.parametrize(
    ("offset", "thinnest"), [(3.7, THINNEST), (0.0, 0)], ids=["almost as likely", "far less likely"]
)
def test_walls_thinner_than_the_mesh_shows_or_than_may_add_are_not_tried(offset, thinnest):
    """The likelier the thinner, but none is likelier than the cap."""
    tried = []

    def information(cavity):
        if cavity is None:
            return np.zeros(8)
        tried.append(cavity.thickness / GSD)
        return np.full(8, offset - cavity.thickness / GSD)

    assert found_in(closed_cylinder(), vessel_maps(dark=1.0), information) == ()
    assert min(tried) == pytest.approx(CavityTolerances.rounding * THICKNESS_RATIO**thinnest)


def test_a_cap_that_is_likelier_in_total_stays():
    information = information_of_views([6.0, 6, -2, -2, -2, -2, -2, -2.5], 1.0)
    assert found_in(closed_cylinder(), vessel_maps(dark=1.0), information) == ()


def test_phases_that_do_not_determine_a_wall_show_no_cavity():
    information = information_of_views([1.0] * 8, 0.0)  # whatever the thickness
    assert found_in(closed_cylinder(), vessel_maps(dark=1.0), information) == ()


def test_a_dark_opening_with_a_rim_of_one_width_opens_into_a_cavity():
    maps = vessel_maps()
    (cavity,) = found_in(closed_cylinder(), maps)
    assert cavity.thickness == pytest.approx(WALL, abs=0.5 * GSD)
    assert cavity.thickness_sigma < 0.7 * GSD
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
def test_a_opening_is_found_by_its_darkness(harm):
    """With a mask the dark inside has phases, and some of them agree with the rim's normal."""
    maps = vessel_maps(**harm)
    (cavity,) = found_in(closed_cylinder(), maps)
    assert cavity.thickness == pytest.approx(WALL, abs=0.5 * GSD)


def test_a_rounded_rim_is_as_wide_as_its_wall():
    """The width of what is bright is not: the inner half of the rim reflects the inside."""
    (cavity,) = found_in(closed_rounded_vessel(), vessel_maps(rounded=True))
    assert cavity.thickness == pytest.approx(WALL, abs=0.5 * GSD)
    assert cavity.rim.offset == pytest.approx(HEIGHT, abs=GSD)
    bore = RADIUS - WALL
    inner = np.array([[bore - 2 * GSD, 0, 0.06], [bore + 2 * GSD, 0, 0.06]])
    assert (cavity.values(inner) > 0).tolist() == [True, False]
    # The cap goes, the rim stays.
    cap, rim = [0.2 * bore, 0, HEIGHT + 0.3 * bore], [RADIUS - 0.5 * WALL, 0, HEIGHT - 0.001]
    assert (cavity.values(np.array([cap, rim])) > 0).tolist() == [True, False]


def on_rim_of(wall_at, inner=-1.0):
    """How well normals agree with a rounded rim on a wall of a thickness at each angle.

    ``inner`` is the least sine between them and the vertical: 0 on the shoulder of a solid.
    """

    def information(mesh):
        x, y, _ = mesh.centers.T
        away = np.hypot(x, y)
        outwards = (mesh.face_normals[:, :2] * np.stack([x, y], axis=1)).sum(axis=1) / away
        expected = np.clip(1 - 2 * (RADIUS - away) / wall_at(np.arctan2(y, x)), inner, 1.0)
        agreement = np.maximum(0.2 - np.abs(outwards - expected), -0.05)
        agreement = mesh.face_areas / GSD**2 * agreement
        return sparse.csr_array(np.tile(agreement, (8, 1)))

    return information


@pytest.mark.parametrize(
    ("swing", "inner", "num"),
    [(0.0, -1.0, 1), (0.3, -1.0, 0), (0.0, 0.0, 0)],
    ids=["even wall", "wall of varying width", "shoulder of a solid"],
)
def test_a_rim_whose_inner_half_phases_show_on_one_width_opens_into_a_cavity(swing, inner, num):
    """However bright the opening is."""
    rim = on_rim_of(lambda angle: WALL * (1 + swing * np.sin(angle)), inner)
    scene = patch_scene(vessel_maps(dark=1.0), AngleModel.PPA)
    found = find_cavities(closed_rounded_vessel(), scene, lambda cavity: np.zeros(8), rim)
    assert len(found) == num
    for cavity in found:
        assert cavity.thickness == pytest.approx(WALL, abs=0.5 * GSD)
        assert cavity.thickness_sigma < 0.5 * GSD


@pytest.mark.parametrize(
    ("gains", "dark", "likeliest", "depth"),
    [
        ([1.0] * 8, 1.0, 0.03, 0.03),
        ([1.0] * 8, 1.0, 0.004, (CavityTolerances.rounding + 1) * GSD),
        ([9.0, 9, -1, -1, -1, -1, -1, -1], 1.0, 0.03, HEIGHT - WALL),
        ([3.0, 2, 1, 1, 0, 0, 0, -0.5], 1.0, 0.03, HEIGHT - WALL),  # 1.93 deviations, best of some
        ([1.0] * 8, 0.02, 0.03, HEIGHT - WALL),
    ],
    ids=[
        "a lid that all views show",
        "at the rim",
        "views that disagree",
        "by chance",
        "a dark inside",
    ],
)
def test_a_sunk_lid_below_a_rim_is_where_phases_are_likeliest(gains, dark, likeliest, depth):
    def gain(cavity):
        return -np.array(gains) * np.log(cavity.depth / likeliest) ** 2

    rim = on_rim_of(lambda angle: np.full_like(angle, WALL))
    scene = patch_scene(vessel_maps(dark=dark), AngleModel.PPA)
    (cavity,) = find_cavities(closed_rounded_vessel(), scene, gain, rim)
    assert cavity.depth == pytest.approx(depth, abs=3 * GSD)
    on_axis = np.array([[0, 0, HEIGHT - depth + GSD], [0, 0, HEIGHT - depth - GSD]])
    assert (cavity.values(on_axis) > 0).tolist() == [True, False]


@pytest.mark.parametrize(
    ("wall", "dark", "gain", "num"),
    [(WALL, 0.02, -1.0, 1), (-WALL, 0.02, -1.0, 0), (WALL, 1.0, -1.0, 0), (WALL, 1.0, 1.0, 1)],
    ids=["dark", "no rim", "a bright lid", "a bright inside"],
)
def test_a_supported_cap_over_a_rim_is_an_opening(wall, dark, gain, num):
    """Phases of a mirror image agree with a cap, those of its rim do not.

    The light of a mirror image is weak; under a bright opening the inside must be likelier.
    """
    surface = closed_rounded_vessel()
    (opening,) = surface.openings
    top = replace(opening, is_supported=True)
    surface = replace(surface, supported=np.ones(len(surface.centers), bool), openings=[top])
    scene = patch_scene(vessel_maps(dark=dark), AngleModel.PPA)
    rim = on_rim_of(lambda angle: np.full_like(angle, wall))
    found = find_cavities(surface, scene, lambda cavity: np.full(8, gain), rim)
    assert [cavity.thickness for cavity in found] == pytest.approx(num * [WALL], abs=GSD)


def test_an_inside_that_phases_support_is_not_carved_deeper():
    """A tray whose rim phases show; without support, its floor is a cap that has sunk."""
    surface = closed_rounded_vessel()
    (opening,) = surface.openings
    bore, floor = RADIUS - WALL, HEIGHT - 16 * GSD

    def inside_along(origins, direction, distances):
        points = origins + distances[:, None, None] * direction
        is_solid = np.hypot(points[..., 0], points[..., 1]) > bore
        is_solid |= points[..., 2] < floor
        return surface.inside_along(origins, direction, distances) & is_solid

    scene = patch_scene(vessel_maps(dark=1.0), AngleModel.PPA)
    rim = on_rim_of(lambda angle: np.full_like(angle, WALL))
    for is_supported in (True, False):
        openings = [replace(opening, is_supported=is_supported)]
        tray = replace(surface, openings=openings, inside_along=inside_along)
        found = find_cavities(tray, scene, lambda cavity: np.zeros(8), rim)
        assert len(found) == (not is_supported)


def test_an_opening_is_searched_once():
    """A cap without support and the top with its rim are one opening; another beside it is not."""
    surface = closed_rounded_vessel()
    (opening,) = surface.openings
    shift = np.array([4 * RADIUS, 0, 0])
    num = len(surface.centers)

    def inside_along(origins, direction, distances):
        both = [surface.inside_along(origins - x, direction, distances) for x in (0 * shift, shift)]
        return both[0] | both[1]

    twins = replace(
        surface,
        centers=np.concatenate([surface.centers, surface.centers + shift]),
        normals=np.tile(surface.normals, (2, 1)),
        supported=np.tile(surface.supported, 2),
        openings=[
            opening,
            replace(opening, is_supported=True),
            replace(opening, patch=opening.patch + num, border=opening.border + num),
        ],
        inside_along=inside_along,
    )
    scene = patch_scene(vessel_maps(dark=1.0), AngleModel.PPA)

    def rim(mesh):
        near = mesh.centers[:, 0] < 2 * RADIUS
        centred = mesh.moved(np.where(near[0], 0, -1) * shift)
        return on_rim_of(lambda angle: np.full_like(angle, WALL))(centred)

    found = find_cavities(twins, scene, lambda cavity: np.zeros(8), rim)
    assert len(found) == 2
    axes = np.array([[0, 0, 0.06], [4 * RADIUS, 0, 0.06]])
    assert [(cavity.values(axes) > 0).tolist() for cavity in found] == [
        [True, False],
        [False, True],
    ]


def test_tops_of_a_standing_body_may_be_caps():
    """A box whose faces are all supported."""
    grid = np.ones((30, 30, 20), np.float32)
    grid[2:-2, 2:-2, 2:-2] = -1
    mesh = mesh_from_grid(grid, np.zeros(3), 1.0)
    all_faces = np.ones(len(mesh.faces), bool)
    scene = RayScene(mesh)
    found = surface_faces(scene, all_faces, all_faces, 1.0, upwards=np.array([0, 0, 1.0]))
    (top,) = found.openings
    assert top.is_supported
    assert (mesh.face_normals[top.patch, 2] > 0.7).all()
    assert (mesh.face_normals[top.border, 2] < 0.72).all()
    assert top.area == pytest.approx(26**2, rel=0.05)
    assert surface_faces(scene, all_faces, all_faces, 1.0).openings == []


def test_rims_deeper_than_a_shallow_body_are_not_asked_for():
    surface, asked = closed_rounded_vessel(), []
    below = HEIGHT - 8 * GSD

    def inside_along(origins, direction, distances):
        points = origins + distances[:, None, None] * direction
        return surface.inside_along(origins, direction, distances) & (points[..., 2] > below)

    def rim(mesh):
        asked.append(len(mesh.faces))
        return on_rim_of(lambda angle: np.full_like(angle, WALL))(mesh)

    shallow = replace(surface, inside_along=inside_along)
    scene = patch_scene(vessel_maps(dark=1.0), AngleModel.PPA)
    find_cavities(shallow, scene, lambda cavity: np.zeros(8), rim)
    assert len(asked) > 5
    assert min(asked) > 0


def test_a_opening_is_round_though_its_cells_are_not():
    """To a tenth of a pixel; cut at whole cells it goes in and out by 0.15."""
    (cavity,) = found_in(closed_cylinder(), vessel_maps())
    around = np.linspace(0, 2 * np.pi, 180, endpoint=False)
    radii = RADIUS - WALL + np.arange(3, -3, -0.02) * GSD
    across = np.stack([np.cos(around), np.sin(around)], axis=-1) * radii[:, None, None]
    points = np.dstack([across, np.full(across.shape[:2], HEIGHT - 0.001)])
    free = cavity.values(points.reshape(-1, 3)).reshape(points.shape[:2]) > 0
    off = (radii[free.argmax(axis=0)] - (RADIUS - WALL)) / GSD
    assert abs(off.mean()) < 0.15
    assert off.std() < 0.1


def test_a_bent_cap_hides_no_opening():
    surface = closed_cylinder()
    x, y, z = surface.centers.T
    is_patch = np.isin(np.arange(len(x)), surface.openings[0].patch)
    height = np.where(is_patch & (x > 0), z + 12 * GSD, z)
    bent = replace(surface, centers=np.stack([x, y, height], axis=1))
    (cavity,) = found_in(bent, vessel_maps())
    assert cavity.thickness == pytest.approx(WALL, abs=0.5 * GSD)
    assert cavity.rim.offset == pytest.approx(HEIGHT, abs=0.5 * GSD)
    # The space above the rim is free up to the cap.
    assert (cavity.values(bent.centers[(x > 0) & (np.hypot(x, y) < 0.03)]) > 0).all()


def test_a_deep_cavity_has_a_bottom_however_fine_the_grid(monkeypatch):
    """The layers of a grid are few where its memory is bounded."""
    monkeypatch.setattr("polmvs.surface.cavities.MAX_CELLS", 12 * 97**2)
    (cavity,) = found_in(closed_cylinder(), vessel_maps())
    assert (cavity.values(np.array([[0, 0, 0.35 * HEIGHT]])) > 0).all()


def test_islands_of_a_cap_belong_to_its_opening():
    """A box of which the middle of the top is not supported, but for a speck in it."""
    grid = np.ones((30, 30, 20), np.float32)
    grid[2:-2, 2:-2, 2:-2] = -1
    mesh = mesh_from_grid(grid, np.zeros(3), 1.0)
    x, y, _ = np.abs(mesh.centers - mesh.vertices.mean(axis=0)).T
    is_top = (mesh.centers[:, 2] > mesh.vertices[:, 2].max() - 0.6) & (
        mesh.face_normals[:, 2] > 0.5
    )
    away = np.maximum(x, y)
    supported = ~(is_top & (away < 9) & (away > 2))
    found = surface_faces(RayScene(mesh), np.ones(len(away), bool), supported, gsd=1.0)
    (opening,) = found.openings
    assert set(opening.patch) == set(np.flatnonzero(is_top & (away < 9)))
    assert is_top[opening.border].all()
    assert (away[opening.border] < 10.5).all()
    assert not found.supported[opening.patch].any()
    nothing = surface_faces(
        RayScene(mesh), np.ones(len(away), bool), np.ones(len(away), bool), gsd=1.0
    )
    assert nothing.openings == []


def test_a_closed_body_has_no_cavity():
    maps = vessel_maps(bore=1e-4)
    assert found_in(closed_cylinder(0.03), maps) == ()


def test_a_rim_of_varying_width_infers_nothing():
    maps = vessel_maps(bore=0.035, offset=0.015)
    assert found_in(closed_cylinder(0.035, 0.015), maps) == ()


def test_a_bright_label_without_phase_is_no_opening():
    maps = vessel_maps(dark=1.0)
    assert found_in(closed_cylinder(), maps) == ()


def test_too_few_views_find_nothing():
    maps = vessel_maps()[:2]
    assert found_in(closed_cylinder(), maps) == ()
