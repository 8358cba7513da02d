from dataclasses import replace

import numpy as np
import pytest
import trimesh
from analytic_objects import phase_maps_of, ring_of_views, sphere

from polmvs.polarization.kinds import AngleModel
from polmvs.surface.creases import sided_normals
from polmvs.surface.mesh_geometry import TriangleMesh
from polmvs.surface.observations import Looking
from polmvs.surface.solver import first_fit, label, phase_information
from polmvs.surface.surface_quality import (
    MIN_EXPLAINED,
    FaceEvidence,
    contradicted_faces,
    disagreement_deg,
    fit_normals,
    misfit,
    share_off,
    stand_apart,
    supported_faces,
    view_information,
)
from polmvs.surface.surface_view import Silhouette, surface_view
from polmvs.surface.terms import KnownPoints

NAN = np.nan


@pytest.mark.parametrize(
    ("unexplained", "apart"),
    [
        ([0.1, 0.1, 0.12, 0.5, 0.1], [3]),  # of 0.9 that the median explains, 0.56
        ([0.02, 0.02, 0.03, 0.02, 0.15], [4]),  # explained, but seven times as much is not
        ([0.02, 0.02, 0.03, 0.02, 0.09], []),  # few pixels
        ([0.3, 0.3, 0.35, 0.4, 0.3], []),
        ([0.1, NAN, 0.1, 0.6, 0.1], [3]),
        ([NAN, NAN, NAN], []),
        ([0.1, 0.1, 0.9], []),  # two would be left
        # Of the surface that explains so little nothing is known, hence nothing of a view.
        ([0.7, 0.6, 0.7, 0.95, 0.7], []),
        ([0.45, 0.4, 0.45, 0.95, 0.45], [3]),
        # Some views see the wrong parts of a surface: no view is apart.
        ([0.2, 0.3, 0.35, 0.4, 0.45, 0.5, 0.6, 0.7, 0.75], []),
    ],
)
def test_views_that_stand_apart_from_a_surface(unexplained, apart):
    assert np.flatnonzero(stand_apart(np.array(unexplained), MIN_EXPLAINED)).tolist() == apart


@pytest.fixture(scope="module")
def exact() -> TriangleMesh:
    """A unit sphere, whose normals are those of its faces."""
    made = trimesh.creation.icosphere(subdivisions=5)
    return TriangleMesh(np.asarray(made.vertices), np.asarray(made.faces, np.int64))


def fit_of(noise):
    views = [
        surface_view(m, Silhouette(m.region.inside, m.region.inside))
        for m in phase_maps_of(
            sphere(), ring_of_views(12, elevations=(0.0, 45.0, -35.0)), noise=noise
        )
    ]
    looking = Looking(angle_model=AngleModel.PPA, tilt_aware=False)
    return first_fit(views, looking, 5 / 150).at_width(1.0)


def test_normals_err_by_their_stated_deviation(exact):
    """Of phases with independent noise; the views share no error."""
    fit = fit_of(np.radians(2.0))
    fitted = fit_normals(exact, label(exact, fit))
    normals, average = sided_normals(exact, fitted.normals, fitted.is_fitted)
    sigma = fitted.sigma_deg(exact, average)
    known = np.isfinite(sigma)
    cosine = np.clip((normals * exact.face_normals).sum(axis=1), -1, 1)[known]
    ratio = np.degrees(np.arccos(cosine)) / sigma[known]
    assert known.mean() > 0.95
    # Of a normal error in two dimensions 63 to 68 % are within the root of its mean square. Rows of
    # few views have a larger jackknife than variance (Efron and Stein 1981).
    assert 0.6 < (ratio < 1).mean() < 0.85
    assert (ratio < 2).mean() > 0.93


@pytest.mark.parametrize(("num", "num_sunk", "share"), [(60, 6, 0.1), (60, 24, 0.4), (12, 6, None)])
def test_known_points_off_the_surface_are_counted(exact, num, num_sunk, share):
    directions = np.random.default_rng(0).normal(size=(num, 3))
    points = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    points[:num_sunk] *= 0.8
    points = np.concatenate([points, [[3.0, 0.0, 0.0]] * 40])  # beside the silhouettes
    known = KnownPoints(points, np.full(num + 40, 0.01))
    assert share_off(exact, known, fit_of(0.0).views) == share
    # What a deviation explains is not off.
    uncertain = KnownPoints(points, np.full(num + 40, 0.1))
    assert share_off(exact, uncertain, fit_of(0.0).views) == (None if share is None else 0.0)
    # Nor does what a box cuts away count.
    views = fit_of(0.0).views
    cut = {one.view.name: np.ones_like(one.silhouette.certain) for one in views}
    assert share_off(exact, known, views, cut) is None


def test_normals_that_all_views_turn_alike_disagree_with_the_mesh(exact):
    upper = exact.centers[:, 2] > 0.2
    turned = np.where(
        upper[:, None], exact.face_normals + np.array([0, 0, 0.1]), exact.face_normals
    )
    turned /= np.linalg.norm(turned, axis=1, keepdims=True)
    is_fitted = exact.centers[:, 0] < 0.5
    found = disagreement_deg(exact, turned, is_fitted)
    own = np.degrees(np.arccos(np.clip((turned * exact.face_normals).sum(axis=1), -1, 1)))
    height = exact.centers[:, 2]
    inner = is_fitted & (height > 0.4) & (height < 0.9) & (exact.centers[:, 0] < 0.3)
    np.testing.assert_allclose(found[inner], own[inner], rtol=0.15, atol=0.2)
    # arccos of a rounded cosine is as large as the root of the rounding.
    assert found[is_fitted & (height < 0)].max() < 1e-4
    assert np.isfinite(found).all()


def test_a_vertex_whose_phases_fit_worse_than_elsewhere_is_less_certain(exact):
    """By the ratio of the mean squares; where they fit better, nothing changes."""
    labelled = label(exact, fit_of(np.radians(6.0)))
    usual = misfit(exact, labelled)
    assert np.all(misfit(exact, label(exact, fit_of(0.0))) < 1.2)  # residuals of rounding alone
    assert 1 <= usual.min() <= np.median(usual) < 1.2
    is_low = exact.centers[labelled.observations.face, 2] < -0.5
    rows = np.where(is_low[:, None], 3.0, 1.0) * labelled.observations.rows
    worse = replace(labelled, observations=replace(labelled.observations, rows=rows))
    ratio = misfit(exact, worse)
    above, below = exact.vertices[:, 2] > -0.4, exact.vertices[:, 2] < -0.6
    assert np.median(ratio[above]) < 1.2
    assert 7 < np.median(ratio[below]) < 11


def test_phases_of_another_place_carry_no_information(exact):
    fit = fit_of(np.radians(0.5))
    observations = label(exact, fit).observations
    own = phase_information(exact, observations, fit)
    assert np.median(own) > 1.5
    rng = np.random.default_rng(0)
    mixed = replace(observations, rows=observations.rows[:, rng.permutation(len(own))])
    assert phase_information(exact, mixed, fit).mean() < 0


def test_phases_of_any_direction_carry_no_information(exact):
    fit = fit_of(np.radians(0.5))
    observations = label(exact, fit).observations
    vague = replace(observations, turn_variance=np.full_like(observations.turn_variance, 100.0))
    information = phase_information(exact, vague, fit)
    assert np.allclose(information, 0, atol=0.015)


def test_information_of_a_view_does_not_depend_on_the_mesh(exact):
    """It is that of its pixels: of half as many faces it is about the same."""
    coarse = trimesh.creation.icosphere(subdivisions=4)
    coarse = TriangleMesh(np.asarray(coarse.vertices), np.asarray(coarse.faces, np.int64))
    fit = fit_of(np.radians(2.0))
    fine = view_information(exact, fit)
    np.testing.assert_allclose(view_information(coarse, fit), fine, rtol=0.1)
    # A view shows a disc with a radius of about 150 / 5 px; its middle says little.
    assert fine.shape == (len(fit.views),)
    assert (fine / (np.pi * 30**2) > 0.5).all()
    assert (fine / (np.pi * 30**2) < 5).all()


def test_what_lies_beside_a_part_hides_it(exact):
    """Two halves of a ball have the information of the whole, each with the other beside it."""
    fit = fit_of(np.radians(2.0))
    is_left = exact.centers[:, 0] < 0
    left, right = (TriangleMesh(exact.vertices, exact.faces[own]) for own in (is_left, ~is_left))
    parts = view_information(left, fit, right) + view_information(right, fit, left)
    np.testing.assert_allclose(parts, view_information(exact, fit), rtol=1e-6)
    wall = exact.moved(np.array([0.0, 0.0, 20.0]))  # beyond the cameras
    np.testing.assert_allclose(view_information(exact, fit, wall), view_information(exact, fit))
    shell = TriangleMesh(1.5 * exact.vertices, exact.faces)
    assert (view_information(exact, fit, shell) == 0).all()


def test_phases_that_all_say_little_determine_faces_with_less():
    assert evidence_of(9).enough_information == pytest.approx(np.log(2))
    weak = evidence_of(9, information=np.full(9, 8 * 0.4))
    assert weak.enough_information == pytest.approx(0.3 * 0.4)
    nothing = evidence_of(9, num_rows=np.zeros(9, int), information=np.zeros(9))
    assert nothing.enough_information == 0


def evidence_of(num, **changes):
    some = {"num_views": 8, "num_outside": 0, "num_rows": 8, "num_contradicting": 0}
    counts = {name: np.full(num, value) for name, value in some.items()}
    found = FaceEvidence(**counts, num_outlines=np.zeros(num, int), information=np.full(num, 20.0))
    return replace(found, **changes)


@pytest.mark.parametrize(
    ("information", "outlines", "sigma", "cap", "is_kept"),
    [
        (2.0, 0, 5.0, 0.8, False),  # a quarter of a nat for each of eight phases
        (8.0, 0, 5.0, 0.8, True),
        (2.0, 2, 5.0, 0.8, True),  # outlines show it
        (2.0, 0, 1.5, 0.8, True),  # points or the views' agreement fix it
        (2.0, 0, 5.0, 0.995, True),  # a small gap
        (2.0, 0, np.inf, 0.8, False),
    ],
)
def test_a_part_that_nothing_determines_is_not_supported(
    exact, information, outlines, sigma, cap, is_kept
):
    top = exact.centers[:, 2] > cap
    given = evidence_of(
        len(top),
        information=np.where(top, information, 20.0),
        num_outlines=np.where(top, outlines, 0),
    )
    of_vertices = np.where(exact.vertices[:, 2] > cap - 0.1, sigma, 1.0)
    kept = supported_faces(exact, given, gsd=5 / 150, sigma=of_vertices)
    inner = exact.centers[:, 2] > 0.5 * (1 + cap)
    assert kept[inner].all() if is_kept else not kept[inner].any()
    assert kept[exact.centers[:, 2] < cap - 0.1].all()
    if is_kept and sigma > 2:
        # The cavities are found before the uncertainty is known.
        assert supported_faces(exact, given, gsd=5 / 150)[inner].all()


@pytest.mark.parametrize(("information", "is_denied"), [(-1.0, True), (1.0, False)])
def test_wide_parts_that_phases_contradict_have_no_points(exact, information, is_denied):
    def found_at(cap):
        top = exact.centers[:, 2] > cap
        given = evidence_of(len(top), information=np.where(top, information, 20.0))
        return contradicted_faces(exact, given, gsd=5 / 150)

    wide = found_at(0.8)
    assert wide[exact.centers[:, 2] > 0.9].all() == is_denied
    assert not wide[exact.centers[:, 2] < 0.7].any()
    assert not found_at(0.995).any()  # smoothness bridges it
