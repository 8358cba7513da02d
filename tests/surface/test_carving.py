"""Carving a closed mesh."""

import numpy as np
import pytest

from polmvs.config import AngleModel
from polmvs.scene import Seeds
from polmvs.surface.carving import carved_mesh, find_steps
from polmvs.surface.mesh_geometry import TriangleMesh, mesh_from_grid

STEP = 0.05


@pytest.fixture(scope="module")
def box():
    """A cube of half side 0.5."""
    axis = np.arange(-0.8, 0.8 + STEP / 2, STEP)
    x, y, z = np.meshgrid(axis, axis, axis, indexing="ij")
    values = np.maximum(np.maximum(np.abs(x), np.abs(y)), np.abs(z)) - 0.5
    return mesh_from_grid(values.astype(np.float32), np.full(3, -0.8), STEP)


def test_without_free_space_a_mesh_stays_as_it_is(box):
    assert carved_mesh(box, [], STEP) is box


def test_free_space_is_cut_off_and_the_rest_stays(box):
    carved = carved_mesh(box, [lambda points: points[:, 2] - 0.13], STEP)
    assert carved.vertices[:, 2].max() == pytest.approx(0.13, abs=0.01)
    assert carved.vertices.min() == pytest.approx(-0.5, abs=0.01)
    assert np.abs(carved.vertices[:, :2]).max() == pytest.approx(0.5, abs=0.01)


def test_a_hollow_is_open_to_the_outside(box):
    def bore(points):
        return np.minimum(0.25 - np.hypot(points[:, 0], points[:, 1]), points[:, 2] + 0.2)

    carved = carved_mesh(box, [bore], STEP)
    inside = np.hypot(*carved.vertices[:, :2].T) < 0.2
    assert carved.vertices[inside & (carved.vertices[:, 2] > -0.4), 2].max() < -0.15
    assert len(np.unique(carved.face_components)) == 1


def test_all_of_it_free_leaves_nothing(box):
    assert len(carved_mesh(box, [lambda points: np.ones(len(points))], STEP).faces) == 0


def test_no_mesh_and_no_seeds_have_no_steps(box):
    none = Seeds(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))
    assert find_steps(box, none, [], AngleModel.PPA) == ()
    empty = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    assert carved_mesh(empty, [lambda points: points[:, 0]], STEP) is empty
