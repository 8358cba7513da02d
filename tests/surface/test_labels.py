"""Labels of observations: their light, given a normal, neighbours, or no good normal."""

from dataclasses import replace

import numpy as np
import pytest
from analytic_objects import extracted, phase_maps_of, ring_of_views, sphere

from polmvs.polarization.kinds import AngleModel
from polmvs.surface.labels import LabelTolerances, neighbors, responsibilities, vote
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh
from polmvs.surface.observations import DIFFUSE, SPECULAR, Looking, level_image, observe
from polmvs.surface.surface_view import Silhouette, surface_view
from polmvs.surface.terms import shared_edges

LOOKING = Looking(angle_model=AngleModel.PPA, tilt_aware=False)
ROW_SIGMA = np.array([[0.03], [0.03]])
WEAK = 0.05  # DoLP that both kinds of light can have


def scene(diffuse_views=(), dolp=WEAK):
    """A ball under specular light, or diffuse in some views, and the views' pairs of faces."""
    mesh = extracted(sphere(), step=0.1)
    views = []
    for index, phase_map in enumerate(phase_maps_of(sphere(), ring_of_views(8))):
        polarization = np.array(phase_map.polarization)
        length = np.maximum(np.hypot(*np.moveaxis(polarization[..., :2], -1, 0)), 1e-9)
        sign = -1 if index in diffuse_views else 1
        polarization[..., :2] *= (sign * dolp / length)[..., None]
        polarization[..., 2] = 1e-6
        phase_map = replace(phase_map, polarization=polarization)
        inside = phase_map.region.inside
        views.append(surface_view(phase_map, Silhouette(inside, inside)))
    images = [level_image(view, 1.0) for view in views]
    return mesh, observe(mesh, RayScene(mesh), views, images, LOOKING)


def pairs_of(mesh):
    edges = shared_edges(mesh)
    return edges.faces[:, 0], edges.faces[:, 1]


def test_the_light_changes_from_view_to_view_and_each_is_told():
    mesh, seen = scene(diffuse_views=(1, 4))
    shares = responsibilities(seen, mesh.face_normals, normal_sigma=0.1, row_sigma=ROW_SIGMA)
    oblique = seen.cosine < 0.9  # seen frontally, a place has no plane of incidence
    is_diffuse = np.isin(seen.view, (1, 4))
    assert (shares[DIFFUSE] > 0.9)[oblique & is_diffuse].mean() > 0.97
    assert (shares[SPECULAR] > 0.9)[oblique & ~is_diffuse].mean() > 0.97


def test_more_polarization_than_diffuse_light_can_have_is_specular():
    """Under a normal that fits neither kind better, the degree of polarization decides."""
    for dolp, sure in ((WEAK, False), (0.8, True)):
        mesh, seen = scene(dolp=dolp)
        # Between both planes of incidence: the same residual under either.
        normals = mesh.face_normals
        rows = seen.rows / np.sqrt(2)
        middle = replace(seen, rows=np.stack([rows[0] + rows[1], rows[0] - rows[1]]))
        shares = responsibilities(middle, normals, normal_sigma=0.5, row_sigma=ROW_SIGMA)
        ratio = shares[SPECULAR] / np.maximum(shares.sum(axis=0), 1e-9)
        told = np.median(ratio) > 0.99
        assert told == sure, (dolp, np.median(ratio))


def test_neighbours_decide_where_an_observation_alone_does_not():
    mesh, seen = scene(dolp=0.009)
    pairs = pairs_of(mesh)
    near = neighbors(seen.only(seen.view == 0), pairs, len(mesh.faces))
    assert (near.data >= 0).all()
    assert (near.data <= 1).all()
    assert np.median(near.data) > 0.9  # a smooth ball turns its phases slowly
    # One face in ten with a normal that says nothing of its light: along its ray in this view.
    normals = mesh.face_normals.copy()
    blind = np.zeros(len(normals), bool)
    blind[::10] = True
    one = np.flatnonzero((seen.view == 0) & blind[seen.face] & (seen.cosine < 0.8))
    normals[seen.face[one]] = -seen.rays[one]
    alone = responsibilities(seen, normals, normal_sigma=0.1, row_sigma=ROW_SIGMA)
    coupled = responsibilities(seen, normals, normal_sigma=0.1, row_sigma=ROW_SIGMA, pairs=pairs)
    assert np.median(alone[SPECULAR, one]) < 0.6
    assert np.median(coupled[SPECULAR, one]) > 0.9


@pytest.mark.parametrize("light", [SPECULAR, DIFFUSE])
def test_a_stated_light_is_that_of_all(light):
    mesh, seen = scene(diffuse_views=(1, 4))
    pairs = pairs_of(mesh)
    weights = (1.0, 0.0) if light == SPECULAR else (0.0, 1.0)
    shares = responsibilities(
        seen, mesh.face_normals, normal_sigma=0.1, row_sigma=ROW_SIGMA, pairs=pairs, weights=weights
    )
    assert shares[1 - light].max() < 1e-6


def test_what_fits_neither_light_is_of_neither():
    mesh, seen = scene()
    turned = replace(seen, rows=np.broadcast_to(mesh.face_normals[seen.face], seen.rows.shape))
    shares = responsibilities(turned, mesh.face_normals, normal_sigma=0.1, row_sigma=ROW_SIGMA)
    assert shares.sum(axis=0).max() < 0.01


@pytest.mark.parametrize("tilt_deg", [0.0, 28.0])
def test_a_vote_finds_the_normal_that_a_mesh_does_not_have(tilt_deg):
    mesh, seen = scene(diffuse_views=(0, 3, 5))
    # The same places, their faces turned: the observations are of the ball.
    axis = np.array([0.0, 0.0, 1.0])
    angle = np.radians(tilt_deg)
    true = mesh.face_normals
    across = np.cross(axis, true)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-9)
    turned = np.cos(angle) * true + np.sin(angle) * np.cross(across, true)
    posed = TriangleMesh(mesh.vertices, mesh.faces)
    vars(posed)["face_normals"] = turned
    found = vote(posed, seen, pairs_of(mesh), row_sigma=ROW_SIGMA, tolerances=LabelTolerances())
    count = np.bincount(seen.face, minlength=len(true))
    known = (count >= 4) & (np.abs(mesh.centers[:, 2]) < 0.6)
    off = np.degrees(np.arccos(np.clip((found.normals * true).sum(axis=1), -1, 1)))[known]
    if tilt_deg == 0:
        assert found.has_won[known].mean() < 0.02
    else:
        assert np.median(off) < 10  # the candidates' spacing is 15 deg
        assert found.has_won[known].mean() > 0.8
