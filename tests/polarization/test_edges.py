"""Edges of unpolarized things must not look polarized, at half and at full resolution."""

import cv2
import numpy as np
import pytest

from polmvs.polarization.mosaic import split_mosaic, split_mosaic_full
from polmvs.polarization.region import find_region
from polmvs.polarization.stokes import stokes_from_intensities

PATTERN = (90, 45, 135, 0)
SPLITS = {"half": split_mosaic, "full": split_mosaic_full}


def edges(blur_px: float, noise: float = 0.003) -> np.ndarray:
    """A mosaic of unpolarized polygons of random brightness, with a lens's blur."""
    rng = np.random.default_rng(7)
    fine = np.full((768, 1024), 0.25, np.float32)
    for _ in range(60):
        center = rng.uniform(0, 1, 2) * [1024, 768]
        corners = np.rint(center + rng.normal(0, 90, (4, 2))).astype(np.int32)
        cv2.fillConvexPoly(fine, cv2.convexHull(corners), float(rng.uniform(0.05, 0.45)))
    small = cv2.resize(fine, (512, 384), interpolation=cv2.INTER_AREA)
    seen = cv2.GaussianBlur(small, (0, 0), blur_px)
    return np.asarray(seen + rng.normal(0, noise, seen.shape), np.float32)


@pytest.mark.parametrize("resolution", SPLITS)
@pytest.mark.parametrize("blur_px", [0.5, 1.0])
def test_no_edge_is_a_polarized_region(resolution, blur_px):
    images = SPLITS[resolution](edges(blur_px), PATTERN)
    nothing = np.zeros(images.shape[1:], bool)
    stokes = stokes_from_intensities(images, nothing)
    if blur_px < 1:  # single pixels do seem so: what must not be taken for a surface
        assert np.mean(stokes.dolp > 0.1) > 0.005
    region = find_region(stokes.s0, stokes.s1, stokes.s2, stokes.valid, min_dolp=0.1)
    assert not region.inside.any()
