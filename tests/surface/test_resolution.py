"""The same scene at half, full and double resolution has the same shape."""

import numpy as np
import pytest
from scenes import Scene, phase_map_of

from polmvs.camera import PinholeCamera
from polmvs.config import AngleModel, PropagationOptions
from polmvs.surface.integration import integrate
from polmvs.synthetic.captures import Sphere, render_view, ring_of_views

SCALES = (1, 2, 4)  # 306x256, 612x512, 1224x1024
FOOTPRINT = 0.6 / 190  # of a pixel of the smallest image at the scene's distance, 3 mm
SURFACE = Sphere(center=np.zeros(3), radius=0.16)


def scene_at(scale, num_views=4):
    camera = PinholeCamera(
        width=306 * scale,
        height=256 * scale,
        fx=190.0 * scale,
        fy=190.0 * scale,
        cx=153.0 * scale,
        cy=128.0 * scale,
    )
    views = ring_of_views(4, camera, target=np.zeros(3), distance=0.6, elevation_deg=55)
    rendered = [render_view(v, SURFACE, s0=0.2, background=0.6) for v in views[:num_views]]
    return Scene(SURFACE, views, rendered, [phase_map_of(r) for r in rendered])


@pytest.fixture(scope="module")
def dense(tmp_path_factory):
    """Dense views of the three resolutions on lattices of the same rays, from the same seeds."""
    seeds = scene_at(1).seeds(60)
    results = {}
    for scale in SCALES:
        options = PropagationOptions(num_rounds=2, stride_px=2 * scale)
        folder = tmp_path_factory.mktemp(f"scale{scale}")
        maps = scene_at(scale, 3).maps
        results[scale] = integrate(AngleModel.PPA, maps, seeds, options, folder)
    return results


@pytest.mark.parametrize("scale", [1, 4])
def test_resolution_does_not_change_the_shape(dense, scale):
    """Within what either result says of its own deviation, and by its place in space."""
    differences, normalized, turns, found = [], [], [], []
    for here, there in zip(dense[scale], dense[2], strict=True):
        both = here.known & there.known
        found.append(both.sum() / max(here.known.sum(), there.known.sum()))
        difference = np.abs(here.range_map - there.range_map)[both]
        differences.append(difference)
        normalized.append(difference / np.hypot(here.sigma, there.sigma)[both])
        turn = (here.normals_in_world * there.normals_in_world).sum(axis=-1)[both]
        turns.append(np.degrees(np.arccos(np.clip(turn, -1, 1))))
    print(min(found), [np.mean(np.concatenate(normalized) < k) for k in (1,2,3)], np.quantile(np.concatenate(differences), [.5,.9,.95,.99])/FOOTPRINT, np.median(np.concatenate(turns)))
