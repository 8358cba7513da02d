"""The same scene at half, full and double resolution has the same shape."""

import numpy as np
import pytest
from scenes import phase_map_of

from polmvs.camera import PinholeCamera
from polmvs.config import AngleModel, PropagationOptions
from polmvs.scene import Seeds
from polmvs.surface.integration import integrate
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.surfaces import Sphere

SCALES = (1, 2, 4)  # 306x256, 612x512, 1224x1024
BALL = Sphere(center=np.zeros(3), radius=0.16)


def maps_at(scale):
    camera = PinholeCamera(
        width=306 * scale,
        height=256 * scale,
        fx=190.0 * scale,
        fy=190.0 * scale,
        cx=153.0 * scale,
        cy=128.0 * scale,
    )
    views = ring_of_views(4, camera, target=np.zeros(3), distance=0.6, elevation_deg=65)
    return [phase_map_of(render_view(v, BALL, s0=0.2, background=0.6)) for v in views]


def seeds_on_top(num=60):
    normals = np.random.default_rng(0).normal(size=(5 * num, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    normals = normals[normals[:, 2] > 0.5][:num]
    return Seeds(BALL.radius * normals, normals, np.full(len(normals), 1e-4))


@pytest.fixture(scope="module")
def dense(tmp_path_factory):
    """Maps and dense views of the three resolutions, on lattices of the same rays."""
    results = {}
    for scale in SCALES:
        options = PropagationOptions(num_rounds=2, stride_px=2 * scale)
        folder, maps = tmp_path_factory.mktemp(f"scale{scale}"), maps_at(scale)
        results[scale] = maps, integrate(AngleModel.PPA, maps, seeds_on_top(), options, folder)
    return results


@pytest.mark.parametrize("scale", [1, 4])
def test_resolution_does_not_change_the_shape(dense, scale):
    """Within what either result says of its own deviation, where views see it well."""
    normalized, turns, found = [], [], []
    for phase_map, here, there in zip(*dense[2], dense[scale][1], strict=True):
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
    assert np.median(np.concatenate(turns)) < 0.1
