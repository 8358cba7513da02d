"""Held-out views: predicted by a surface of the others, if it is right."""

from dataclasses import replace

import numpy as np
import pytest
from analytic_objects import extracted, phase_maps_of, ring_of_views, sphere
from scipy.spatial.transform import Rotation

from polmvs.geometry import RigidTransform
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.surface.held_out import (
    HeldOutTolerances,
    Prediction,
    WholeSurface,
    predict,
    predict_left_out,
)
from polmvs.surface.mesh_geometry import TriangleMesh
from polmvs.surface.observations import Looking
from polmvs.surface.solver import Level
from polmvs.surface.surface_view import Silhouette, SurfaceView, surface_view
from polmvs.surface.terms import KnownPoints

LOOKING = Looking(angle_model=AngleModel.PPA, tilt_aware=False)
NOTHING = KnownPoints(np.zeros((0, 3)), np.zeros(0))


FINE = HeldOutTolerances(  # for images of a hundred pixels
    levels=(
        Level(edge_px=5.0, num_steps=5, loss_scale=12.0, gate_px=25.0),
        Level(edge_px=3.0, num_steps=4, loss_scale=8.0, gate_px=8.0),
    )
)
AXES = np.array([1.2, 0.9, 0.7])


def ellipsoid(points: np.ndarray) -> np.ndarray:
    """Distance, or less."""
    return (np.linalg.norm(points / AXES, axis=-1) - 1) * AXES.min()


def views_of(num: int = 12, distance=ellipsoid) -> list[SurfaceView]:
    maps = phase_maps_of(distance, ring_of_views(num, elevations=(5.0, 45.0, -35.0)))
    return [surface_view(m, Silhouette(m.region.inside, m.region.inside)) for m in maps]


@pytest.fixture(scope="module")
def views() -> list[SurfaceView]:
    return views_of()


def predicted(views: list[SurfaceView], looking: Looking = LOOKING, **kwargs) -> Prediction:
    found = predict_left_out(views, None, looking, NOTHING, tolerances=FINE, **kwargs)
    assert found is not None
    return found


def test_right_views_are_predicted(views) -> None:
    found = predicted(views)
    assert found.num_views == 3
    assert found.num_phases > 300
    assert found.error_deg < 2.5
    assert found.chance_deg == 22.5
    assert found.unexplained < 0.1
    assert found.overlap > 0.93


def test_turned_poses_are_not(views) -> None:
    """Each view turned by itself: the phases are as before, the shape is not of them."""
    rng = np.random.default_rng(0)

    def turned(view: SurfaceView) -> SurfaceView:
        turn = Rotation.from_rotvec(rng.normal(0, 0.06, 3)).as_matrix()
        pose = view.view.cam_from_world
        pose = RigidTransform(turn @ pose.rotation, turn @ pose.translation)
        other = replace(view.view, cam_from_world=pose)
        return replace(view, phase_map=view.phase_map.changed(view=other))

    found = predicted(list(map(turned, views)))
    assert found.error_deg > 4
    assert found.overlap < 0.85


def test_light_that_is_stated_wrongly_leaves_nothing_right(views) -> None:
    right = predicted(views, replace(LOOKING, light=Light.SPECULAR))
    wrong = predicted(views, replace(LOOKING, light=Light.DIFFUSE))
    assert right.chance_deg == wrong.chance_deg == 45
    assert right.error_deg < 2.5
    assert wrong.error_deg > 20


def test_phases_of_something_else_are_at_chance(views) -> None:
    """Random axes: half of all lie farther than 22.5 deg from the nearer of two directions."""
    mesh = extracted(ellipsoid, step=0.05)
    rng = np.random.default_rng(0)
    other = []
    for view in views:
        samples = view.phase_map.samples.copy()
        angle = rng.uniform(0, 2 * np.pi, samples.shape[:2])
        samples[..., 0], samples[..., 1] = np.cos(angle), np.sin(angle)
        polarization = view.phase_map.polarization.copy()
        length = np.hypot(polarization[..., 0], polarization[..., 1])
        polarization[..., 0], polarization[..., 1] = length * np.cos(angle), length * np.sin(angle)
        other.append(
            surface_view(
                replace(view.phase_map, samples=samples, polarization=polarization),
                view.silhouette,
            )
        )
    right = predict(mesh, views, LOOKING, width_px=0.3)
    chance = predict(mesh, other, LOOKING, width_px=0.3)
    assert right.error_deg < 1.5  # of faces of a pixel and a half
    assert right.within > 0.75
    assert chance.error_deg == pytest.approx(chance.chance_deg, abs=1.5)
    assert chance.unexplained > 0.5


def test_phases_of_inferred_faces_do_not_count(views) -> None:
    """Half of an ellipsoid is replaced by a ball, as if it were inferred."""
    mesh = extracted(ellipsoid, step=0.05)
    is_right = mesh.centers[:, 0] > 0
    bent = mesh.vertices.copy()
    bent[bent[:, 0] < 0] *= [0.5, 1, 1]
    bent = TriangleMesh(bent, mesh.faces)
    every, some = (predict(bent, views, LOOKING, measured=m) for m in (None, is_right))
    assert every.unexplained > 0.1
    assert some.unexplained < 0.03
    assert 0.3 * every.num_phases < some.num_phases < 0.7 * every.num_phases
    assert some.overlap == every.overlap


def test_one_inconsistent_view_is_named(views) -> None:
    """A view among those left out looks aside by 4 deg: it alone is predicted badly."""
    turn = Rotation.from_rotvec([0, 0.07, 0]).as_matrix()
    pose = views[6].view.cam_from_world
    pose = RigidTransform(turn @ pose.rotation, turn @ pose.translation)
    other = replace(views[6].view, cam_from_world=pose)
    wrong = replace(views[6], phase_map=views[6].phase_map.changed(view=other))
    found = predicted([*views[:6], wrong, *views[7:]])
    assert [view.name for view in found.views] == ["002.png", "006.png", "010.png"]
    assert found.inconsistent_view(4.0) == "006.png"
    assert predicted(views).inconsistent_view(4.0) is None


def test_a_short_trial_that_fails_is_done_again_with_care(views) -> None:
    short = replace(FINE, levels=(replace(FINE.levels[0], edge_px=14.0, num_steps=1),))
    once = replace(short, careful_levels=short.levels)
    first, second = (
        predict_left_out(views, None, LOOKING, NOTHING, tolerances=t)
        for t in (once, replace(short, careful_levels=FINE.levels))
    )
    assert first is not None
    assert second is not None
    assert first.error_deg > FINE.doubtful_deg
    assert second.error_deg < 2.5


def test_a_part_that_the_views_do_not_determine_moves_without_some(views) -> None:
    right = extracted(ellipsoid, step=0.05)

    def raised(points: np.ndarray) -> np.ndarray:
        bump = np.linalg.norm(points - [0.0, 0.9, 0.0], axis=-1) - 0.5
        return np.minimum(ellipsoid(points), bump)

    wrong = extracted(raised, step=0.05)
    wrong_area = wrong.face_areas[ellipsoid(wrong.centers) > 0.15].sum()

    def moved(mesh: TriangleMesh, refined: TriangleMesh, *, is_vessel: bool = False):
        whole = WholeSurface(mesh=mesh, refined=refined, is_vessel=is_vessel)
        return predicted(views, whole=whole).moved

    assert moved(right, right) < 0.01
    assert moved(wrong, wrong) > 0.8 * wrong_area / wrong.face_areas.sum() > 0.05
    assert moved(wrong, right) < 0.05  # what was carved or filled later has its own evidence
    assert moved(right, right, is_vessel=True) is None
    assert moved(TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64)), right) == 0
    assert predicted(views).moved is None


def test_a_silhouette_that_is_larger_overlaps_by_its_share() -> None:
    views = views_of(4, sphere())
    small = predict(extracted(sphere(0.8), step=0.05), views, LOOKING)
    assert small.overlap == pytest.approx(0.64, abs=0.03)


def test_too_few_views_predict_nothing(views) -> None:
    assert predict_left_out(views[:3], None, LOOKING, NOTHING) is None
    assert predict_left_out(views[:4], None, LOOKING, NOTHING) is not None


def test_no_surface_predicts_nothing_right(views) -> None:
    nothing = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    found = predict(nothing, views, LOOKING)
    assert (found.num_phases, found.overlap) == (0, 0)
    assert np.isnan(found.error_deg)


def test_pixels_outside_a_box_are_not_compared(views) -> None:
    """Of the left half of each image nothing counts, and of whole images nothing is known."""
    mesh = extracted(ellipsoid, step=0.05)
    height, width = views[0].silhouette.certain.shape
    left = np.arange(width)[None] < width // 2
    outside = {view.view.name: np.broadcast_to(left, (height, width)) for view in views}
    whole, half = predict(mesh, views, LOOKING), predict(mesh, views, LOOKING, outside=outside)
    assert 0.4 < half.num_phases / whole.num_phases < 0.6
    assert half.overlap > 0.9
    everything = {name: np.ones((height, width), np.bool_) for name in outside}
    assert np.isnan(predict(mesh, views, LOOKING, outside=everything).overlap)
