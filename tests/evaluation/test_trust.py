"""Figures of trust: normal where a surface is right, out of their ranges where it is not."""

import re
from dataclasses import replace

import numpy as np
import pytest
from scenes import board_scene

from polmvs.camera import pixel_centers
from polmvs.evaluation.trust import Trust, measure_trust
from polmvs.geometry import RigidTransform
from polmvs.io.clouds import Cloud
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import turned
from polmvs.poses.crop_box import CropBox
from polmvs.scene import PointKind
from polmvs.surface.held_out import Prediction, ViewError
from polmvs.surface.soundness import Soundness

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
    assert names(trust) in ([], ["coverage of the polarized regions"])
    assert trust.inside > 0.99
    assert trust.residual_deg < 0.1
    assert trust.sigma_share == pytest.approx(5e-4 / 0.5, rel=0.2)


def test_wrong_light_is_not_normal(scene):
    wrong = [turned(m, np.ones(m.region.inside.shape, bool)) for m in scene.maps]
    trust = measure_trust(AngleModel.PPA, cloud_of(scene), NO_TRACKS, wrong)
    assert trust.residual_deg > 80
    assert "phase residual" in names(trust)
    assert any("check `region.light`" in doubt for doubt in trust.doubts())


def test_inferred_light_may_be_of_either_kind(scene):
    """A white object's is diffuse everywhere. Wrong normals fit neither kind."""
    diffuse = [turned(m, np.ones(m.region.inside.shape, bool)) for m in scene.maps]
    cloud = cloud_of(scene)
    cloud = replace(cloud, scalars={**cloud.scalars, "diffuse": np.ones(len(cloud.points))})
    assert measure_trust(AngleModel.PPA, cloud, NO_TRACKS, diffuse).residual_deg < 1
    across = replace(cloud, normals=cloud.normals[:, [1, 2, 0]])
    assert measure_trust(AngleModel.PPA, across, NO_TRACKS, diffuse).residual_deg > 3


def test_a_surface_in_a_wrong_place_leaves_the_silhouettes(scene):
    trust = measure_trust(AngleModel.PPA, cloud_of(scene, shift=0.08), NO_TRACKS, scene.maps)
    assert trust.inside < 0.9
    assert "points within the silhouettes of the views" in names(trust)


def test_views_that_disagree_and_wide_deviations(scene):
    cloud = cloud_of(scene)
    scalars = {**cloud.scalars, "num_views": np.full(3000, 1.0), "sigma": np.full(3000, 0.01)}
    trust = measure_trust(AngleModel.PPA, replace(cloud, scalars=scalars), NO_TRACKS, scene.maps)
    assert {"views that agree with a point they see", "position uncertainty (1 sigma)"} <= set(
        names(trust)
    )


def boxed(scene, cloud: Cloud) -> tuple[Cloud, dict[str, np.ndarray]]:
    """The half of the cloud of larger x, and the pixels of each view that show the other half."""
    kept = cloud.points[:, 0] > 0
    half = cloud.only(kept)
    box = CropBox(RigidTransform(np.eye(3), np.zeros(3)), np.array([0, -9, -9]), np.full(3, 9.0))
    outside = {}
    for one in scene.maps:
        camera, center = one.view.camera, one.view.center_in_world
        rays = one.view.rays_in_world(pixel_centers(camera.width, camera.height))
        ranges = -(center @ scene.surface.normal) / (rays @ scene.surface.normal)
        outside[one.view.name] = ~box.contains(center + rays * ranges[..., None])
    return half, outside


def test_what_a_box_cut_away_is_not_missing(scene):
    cloud = cloud_of(scene)
    whole = measure_trust(AngleModel.PPA, cloud, NO_TRACKS, scene.maps)
    half, outside = boxed(scene, cloud)
    trust = measure_trust(AngleModel.PPA, half, NO_TRACKS, scene.maps, outside)
    assert trust.determined == pytest.approx(whole.determined, abs=0.03)
    assert names(trust) == names(whole)
    blind = measure_trust(AngleModel.PPA, half, NO_TRACKS, scene.maps)
    assert blind.determined < 0.6 * whole.determined


def test_what_lies_behind_a_cut_is_not_visible(scene):
    """Points under the board, which the part that is cut away hides, contradict no view."""
    cloud = cloud_of(scene, shift=-0.05)
    everywhere = {m.view.name: np.ones(m.region.inside.shape, np.bool_) for m in scene.maps}
    trust = measure_trust(AngleModel.PPA, cloud, NO_TRACKS, scene.maps, everywhere)
    assert np.isnan(trust.inside)
    assert np.isnan(trust.determined)
    assert measure_trust(AngleModel.PPA, cloud, NO_TRACKS, scene.maps).inside < 1


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
    assert "no view sees a point of a surface" in trust.judged().verdict


PREDICTED = Prediction(
    num_views=3,
    num_phases=5000,
    error_deg=1.2,
    chance_deg=22.5,
    within=0.9,
    unexplained=0.01,
    overlap=0.98,
)
RIGHT = Trust(
    residual_deg=0.5,
    residual_sigmas=0.6,
    agreement=1.0,
    inside=1.0,
    determined=0.9,
    sigma_share=1e-3,
    num_views=12,
    predicted=PREDICTED,
    fitted=replace(PREDICTED, num_views=12),
    soundness=Soundness(layered=0.001, overlapping=0.0),
    contradicted_share=0.05,
)


def test_a_right_result_says_why_it_is_to_be_trusted():
    found = RIGHT.judged()
    assert found.is_trusted
    assert found.verdict == str(found)
    assert found.verdict == (
        "To be trusted: a surface of the other views predicts 3 held-out views, "
        "phases to 1.2 deg (22.5 by chance), silhouettes to 98%; points cover 90% of what the "
        "views show."
    )
    assert "points cover" not in replace(RIGHT, determined=float("nan")).judged().verdict


def test_noisy_phases_of_weak_polarization_are_no_contradiction():
    assert replace(RIGHT, residual_deg=6.0, residual_sigmas=0.67).judged().is_trusted


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"predicted": replace(PREDICTED, error_deg=12.0)}, "median error.* 12 .*region.light"),
        ({"predicted": replace(PREDICTED, num_phases=20)}, "median error.* unknown"),
        ({"predicted": replace(PREDICTED, overlap=0.7)}, "overlap of their silhouettes.* 70 "),
        ({"predicted": replace(PREDICTED, moved=0.17)}, "that moves without them, %: 17 "),
        ({"fitted": replace(PREDICTED, unexplained=0.5)}, "neither kind of light explains.* 50 "),
        ({"soundness": Soundness(layered=0.2, overlapping=0.0)}, "double layer.* 20 "),
        ({"soundness": Soundness(layered=0.0, overlapping=0.1)}, "intersects itself.* 10 "),
        ({"contradicted_share": 0.18}, "that its phases contradict, %: 18 "),
        ({"off_points": 0.4}, "with a normal that are off the surface, %: 40 "),
        ({"left_out": 5}, "a pose or inconsistent, %: 41.7 "),
        ({"num_views": 3}, "3 views leave none to check"),
        ({"residual_deg": 6.0, "residual_sigmas": 2.0}, "beyond noise, median, deg: 5.65 "),
        ({"complaints": ("the pose of 7.png is off.",)}, r"the pose of 7.png is off\.$"),
        ({"agreement": 0.4}, "agree with a point they see, %: 40 "),
    ],
)
def test_one_figure_that_contradicts_is_enough(changes, said):
    found = replace(RIGHT, **changes).judged()
    assert not found.is_trusted
    assert re.match(f"Not to be trusted: .*{said}", found.verdict)


def test_a_single_view_that_is_off_is_what_to_check():
    views = tuple(ViewError(name=f"{k}.png", error_deg=deg) for k, deg in enumerate((1.0, 9.0)))
    odd = replace(PREDICTED, error_deg=5.0, views=views)
    assert (
        replace(RIGHT, predicted=odd)
        .judged()
        .verdict.endswith("check pose, image and mask of 1.png.")
    )


def test_the_first_of_several_reasons_is_told_and_the_others_counted():
    found = replace(RIGHT, complaints=("the camera is wrong",), inside=0.2, agreement=0.2).judged()
    assert found.verdict == "Not to be trusted: the camera is wrong (and 2 more)."


def test_a_part_that_is_missing_is_a_reservation():
    found = replace(RIGHT, determined=0.3).judged()
    assert found.is_trusted
    assert "But coverage of the polarized regions, %: 30 " in found.verdict


def test_what_closes_an_open_scene_is_a_reservation():
    found = replace(RIGHT, is_bounded=False, contradicted_share=0.2).judged()
    assert found.is_trusted
    assert "But surface that its phases contradict, %: 20 " in found.verdict


def test_without_a_surface_of_all_views_none_was_held_out():
    found = replace(RIGHT, predicted=None, fitted=None, soundness=None).judged()
    assert found.is_trusted
    assert "no view was held out as a check" in found.verdict


@pytest.mark.parametrize(("share", "said"), [(None, False), (0.01, False), (0.1, True)])
def test_masks_that_end_within_a_surface_are_said(share, said):
    found = replace(RIGHT, cut_share=share).judged()
    assert found.is_trusted
    assert ("But polarized surface along the masks" in found.verdict) == said
    assert ("its sides too" in found.verdict) == said
