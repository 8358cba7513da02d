from __future__ import annotations

import numpy as np
import pytest
from scenes import Scene, board_scene

from polmvs.evaluation.consistency import Consistency, measure_consistency
from polmvs.io.clouds import Cloud
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.region import Region
from polmvs.scene import PointKind

NO_TRACKS = Cloud(np.zeros((0, 3)))


@pytest.fixture(scope="module")
def scene() -> Scene:
    return board_scene(4)


def surface_of(scene: Scene) -> Cloud:
    points, normals = scene.surface_points(2000)
    return Cloud(points, normals, scalars={"num_views": np.full(2000, 4.0)})


def with_surroundings(surface: Cloud, kind: PointKind) -> Cloud:
    """The surface and as many points of the surroundings, which hover before it."""
    num = len(surface.points)
    hovering = surface.points + np.array([0.0, 0.0, 0.02])
    normals = np.zeros((num, 3)) if kind is PointKind.SPARSE else surface.normals
    return Cloud(
        points=np.concatenate([hovering, surface.points]),
        normals=np.concatenate([normals, surface.normals]),
        scalars={
            "num_views": np.concatenate([np.zeros(num), surface.scalars["num_views"]]),
            "kind": np.repeat(np.array([kind, PointKind.SURFACE], np.float32), num),
        },
    )


def measure(scene: Scene, cloud: Cloud) -> Consistency:
    return measure_consistency(AngleModel.PPA, cloud, NO_TRACKS, scene.maps)


@pytest.mark.parametrize("kind", [PointKind.SPARSE, PointKind.STEREO])
def test_only_the_polarized_surface_counts(scene: Scene, kind: PointKind) -> None:
    surface = surface_of(scene)
    alone = measure(scene, surface)
    assert alone.num_points == 2000
    assert alone.agreement > 0.9
    assert alone.phase_residual.median_deg < 0.1
    cloud = with_surroundings(surface, kind)
    assert str(measure(scene, cloud)) == str(alone)  # NaN is not equal to itself
    unknown = Cloud(cloud.points, cloud.normals, scalars={"num_views": cloud.scalars["num_views"]})
    assert measure(scene, unknown).num_points == 4000


def test_surroundings_alone_are_no_points(scene: Scene) -> None:
    surface = surface_of(scene)
    cloud = Cloud(
        surface.points,
        surface.normals,
        scalars={"kind": np.full(2000, PointKind.SPARSE, np.float32)},
    )
    found = measure(scene, cloud)
    assert found.num_points == 0
    assert found.coverage == 0
    assert np.isnan(found.agreement)


def test_background_that_a_region_grew_into_is_not_missing(scene: Scene) -> None:
    surface = surface_of(scene)
    grown = []
    for one in scene.maps:
        region, everything = one.region, np.ones_like(one.region.inside)
        leaked = Region(everything, region.reliable, region.edges, ~region.inside)
        grown.append(one.changed(region=leaked))
    alone = measure(scene, surface)
    found = measure_consistency(AngleModel.PPA, surface, NO_TRACKS, grown)
    # The points on the border of the part are seen now: 0.2 % of it.
    assert found.coverage == pytest.approx(alone.coverage, abs=0.01)


def test_no_more_than_all_views_agree(scene: Scene) -> None:
    surface = surface_of(scene)
    hidden = surface.points - np.array([0.0, 0.0, 0.05])  # below the board: no view sees them
    cloud = Cloud(
        points=np.concatenate([surface.points, hidden]),
        normals=np.concatenate([surface.normals, surface.normals]),
        scalars={"num_views": np.full(4000, 4.0)},
    )
    assert 0.9 < measure(scene, cloud).agreement <= 1
