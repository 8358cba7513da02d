"""Figures of trust: normal where a surface is right, out of their ranges where it is not."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import board_scene

from polmvs.config import AngleModel
from polmvs.evaluation.trust import Trust, measure_trust
from polmvs.io.clouds import Cloud
from polmvs.polarization.phase_map import turned
from polmvs.scene import PointKind

NO_TRACKS = Cloud(points=np.zeros((0, 3)), normals=np.zeros((0, 3)))


@pytest.fixture(scope="module")
def scene():
    return board_scene(6)


def cloud_of(scene, shift=0.0, num=3000) -> Cloud:
    """Points of the true board, or of one beside it."""
    points, normals = scene.surface_points(num)
    return Cloud(
        points=points + shift * normals,
        normals=normals,
        scalars={
            "num_views": np.full(num, len(scene.views), np.float32),
            "sigma": np.full(num, 5e-4, np.float32),
            "kind": np.full(num, PointKind.SURFACE, np.float32),
        },
    )


def names(trust: Trust) -> list[str]:
    return [figure.name.split(",")[0] for figure in trust.figures() if not figure.is_normal]


def test_a_right_surface_is_normal(scene):
    trust = measure_trust(AngleModel.PPA, cloud_of(scene), NO_TRACKS, scene.maps)
    # No more than the border of the region is in doubt, and a part of it has no points.
    assert names(trust) in ([], ["part of the polarised regions determined"])
    assert trust.inside > 0.99
    assert trust.residual_deg < 0.1
    assert trust.sigma_share == pytest.approx(5e-4 / 0.5, rel=0.2)


def test_wrong_light_is_not_normal(scene):
    wrong = [turned(m, np.ones(m.region.inside.shape, bool)) for m in scene.maps]
    trust = measure_trust(AngleModel.PPA, cloud_of(scene), NO_TRACKS, wrong)
    assert trust.residual_deg > 80
    assert "phase residual" in names(trust)
    assert any("check `region.light`" in doubt for doubt in trust.doubts())


def test_a_surface_in_a_wrong_place_leaves_the_silhouettes(scene):
    trust = measure_trust(AngleModel.PPA, cloud_of(scene, shift=0.08), NO_TRACKS, scene.maps)
    assert trust.inside < 0.9
    assert "points within the silhouettes of the views" in names(trust)


def test_views_that_disagree_and_wide_deviations(scene):
    cloud = cloud_of(scene)
    scalars = {**cloud.scalars, "num_views": np.full(3000, 1.0), "sigma": np.full(3000, 0.01)}
    trust = measure_trust(AngleModel.PPA, replace(cloud, scalars=scalars), NO_TRACKS, scene.maps)
    assert {"views that agree with a point they see", "stated deviation of the places"} <= set(
        names(trust)
    )


def test_an_empty_cloud_tells_nothing(scene):
    nothing = Cloud(
        points=np.zeros((0, 3)),
        normals=np.zeros((0, 3)),
        scalars={name: np.zeros(0, np.float32) for name in ("num_views", "sigma", "kind")},
    )
    trust = measure_trust(AngleModel.PPA, nothing, NO_TRACKS, scene.maps)
    unknown = [figure for figure in trust.figures() if figure.value is None]
    assert len(unknown) == 5
    assert "unknown" in str(unknown[0])
