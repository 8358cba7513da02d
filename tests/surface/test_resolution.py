"""The same scene at half, full and double resolution has the same shape."""

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from scenes import phase_map_of
from scipy.spatial import cKDTree

from polmvs.camera import PinholeCamera
from polmvs.config import PropagationOptions
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import Seeds
from polmvs.surface.global_surface import SparsePoints, Undetermined, reconstruct_surface
from polmvs.surface.observations import Looking
from polmvs.surface.propagation import propagate
from polmvs.surface.silhouettes import find_silhouette
from polmvs.surface.surface_view import surface_view
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Sphere

MEDIUM, LARGE = (pytest.param(scale, marks=pytest.mark.slow) for scale in (2, 4))
SCALES = (1, MEDIUM, LARGE)  # 306x256, 612x512, 1224x1024
OTHERS = (1, LARGE)  # than the one that they are held against
BALL = Sphere(center=np.zeros(3), radius=0.16)
NOISE = 1e-3 / np.sqrt(2)  # of intensities, full scales: 1e-3 of s1 and s2, as the maps state


def camera_at(scale):
    return PinholeCamera(
        width=306 * scale,
        height=256 * scale,
        fx=190.0 * scale,
        fy=190.0 * scale,
        cx=153.0 * scale,
        cy=128.0 * scale,
    )


def maps_at(scale):
    views = ring_of_views(4, camera_at(scale), target=np.zeros(3), distance=0.6, elevation_deg=65)
    return [phase_map_of(render_view(v, BALL, s0=0.2, background=0.6)) for v in views]


def seeds_on_top(num=60):
    normals = np.random.default_rng(0).normal(size=(5 * num, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] > 0.5][:num]
    return Seeds(BALL.radius * normals, normals, np.full(len(normals), 1e-4))


@pytest.fixture(scope="module")
def dense(tmp_path_factory):
    """Maps and dense views at a resolution, on lattices of the same rays."""

    @cache
    def at(scale):
        options = PropagationOptions(
            num_rounds=2, stride_px=2 * scale, step_px=0.5 * scale, spacing_px=6 * scale
        )
        folder, maps = tmp_path_factory.mktemp(f"scale{scale}"), maps_at(scale)
        return maps, propagate(AngleModel.PPA, maps, seeds_on_top(), options, folder)

    return at


@pytest.mark.parametrize("scale", OTHERS)
def test_resolution_does_not_change_the_shape(dense, scale):
    """Within what either result says of its own deviation, where views see it well."""
    normalized, turns, found = [], [], []
    for phase_map, here, there in zip(*dense(2), dense(scale)[1], strict=True):
        rays = phase_map.view.rays_in_world(here.lattice_xy())
        _, normals = BALL.intersect(phase_map.view.center_in_world, rays)
        well = np.nan_to_num(-(rays * normals).sum(axis=-1)) > 0.6
        both = here.known & there.known & well
        found.append(both.sum() / well.sum())
        sigma = np.hypot(here.sigma, there.sigma)[both]
        normalized.append(np.abs(here.range_map - there.range_map)[both] / sigma)
        turn = (here.normals_in_world * there.normals_in_world).sum(axis=-1)[both]
        turns.append(np.degrees(np.arccos(np.clip(turn, -1, 1))))
    # About the frontal spot the phase turns too fast for half the pixels.
    assert min(found) > (0.88 if scale == 1 else 0.99)
    assert (np.concatenate(normalized) < 1).mean() > 0.68
    assert (np.concatenate(normalized) < 2).mean() > 0.95
    # A pixel of the smallest images turns the normal by 0.8 deg; nodes are 6 pixels apart.
    assert np.median(np.concatenate(turns)) < 0.12  # measured: 0.10


def noisy_maps_around(scale):
    """Maps with a sensor's noise of eight views around the ball, at two heights.

    Its radius is 30, 61 and 122 px in them.
    """
    views = [
        *ring_of_views(8, camera_at(scale), distance=1.0, elevation_deg=15)[::2],
        *ring_of_views(8, camera_at(scale), distance=1.0, elevation_deg=50)[1::2],
    ]
    rng, maps = np.random.default_rng(0), []
    for view in views:
        exact = render_view(view, BALL, s0=0.2, background=0.6)
        noise = NOISE * rng.standard_normal(exact.intensities.shape)
        maps.append(phase_map_of(replace(exact, intensities=exact.intensities + noise)))
    return maps


@pytest.fixture(scope="module")
def surfaces():
    """The surface of all views at a resolution."""
    none = Seeds(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))

    @cache
    def at(scale):
        maps = noisy_maps_around(scale)
        views = [surface_view(one, find_silhouette(one, mask_given=False)) for one in maps]
        looking = Looking(angle_model=AngleModel.PPA)
        found = reconstruct_surface(looking, views, SparsePoints(none, np.zeros((0, 3))))
        assert not isinstance(found, Undetermined)
        return found

    return at


def errors(surface):
    """Distance from the ball (N,), its stated deviation, and direction (N, 3) of known vertices."""
    used = np.zeros(len(surface.mesh.vertices), bool)
    used[surface.mesh.faces[surface.supported]] = True
    used &= np.isfinite(surface.sigma)
    radii = np.linalg.norm(surface.mesh.vertices[used], axis=1)
    directions = surface.mesh.vertices[used] / radii[:, None]
    return radii - BALL.radius, surface.sigma[used], directions


@pytest.mark.parametrize("scale", SCALES)
def test_the_surface_of_all_views_is_the_balls(surfaces, scale):
    """Two deviations hold 95 % of errors where they are those of noise."""
    surface = surfaces(scale)
    error, sigma, _ = errors(surface)
    area = surface.mesh.face_areas[surface.supported].sum()
    assert area > 0.6 * 4 * np.pi * BALL.radius**2  # no view looks up at it
    assert (np.abs(error) < 2 * sigma).mean() > 0.95
    # Most of it is the bias of outlines, of a tenth of a pixel, which all vertices share.
    assert 0.05 < np.median(sigma) / surface.gsd < 0.2


@pytest.mark.parametrize("scale", OTHERS)
def test_resolution_does_not_change_the_surface_of_all_views(surfaces, scale):
    """By more than two deviations of the difference, 95 % of it, in the same directions."""
    error, sigma, directions = errors(surfaces(scale))
    error_there, sigma_there, others = errors(surfaces(2))
    apart, nearest = cKDTree(others).query(directions)
    met = apart < 0.1  # rad; edges of the coarsest mesh are 0.04
    assert met.mean() > 0.95
    difference = np.abs(error - error_there[nearest])[met]
    sigma = np.hypot(sigma, sigma_there[nearest])[met]
    assert (difference < 2 * sigma).mean() > 0.95
