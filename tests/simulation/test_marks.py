"""Places of printed marks."""

import numpy as np
import trimesh

from polmvs.io.clouds import Mesh
from polmvs.simulation.marks import marks_on


def _box(sides: tuple[float, float, float]) -> Mesh:
    box = trimesh.creation.box(sides)
    corners = np.asarray(box.triangles)
    corners = corners + np.array([0, 0, 0.5 * sides[2]])
    normals = np.repeat(np.asarray(box.face_normals), 3, axis=0)
    return Mesh(corners.reshape(-1, 3), normals, np.arange(36, dtype=np.int32).reshape(-1, 3))


def test_all_marks_of_a_low_board_lie_on_its_top_away_from_its_edges():
    for seed in range(3):
        marks = marks_on(_box((0.3, 0.4, 0.012)), 9, 0.024, seed)
        assert len(marks.centers) == 9
        np.testing.assert_allclose(marks.axes[:, 2], [[0, 0, 1]] * 9, atol=1e-6)
        from_edge = [0.15, 0.2] - np.abs(marks.centers[:, :2])
        assert from_edge.min() > 3 * 0.012  # a part is 0.1 m wide


def test_marks_lie_on_the_sides_of_a_high_box_too():
    marks = marks_on(_box((0.2, 0.2, 0.2)), 24, 0.012, 0)
    assert (np.abs(marks.axes[:, 2, 2]) < 0.1).sum() > 8
    assert marks.centers[:, 2].min() > 0.006


def test_marks_too_large_for_a_surface_lie_somewhere():
    assert len(marks_on(_box((0.01, 0.2, 0.01)), 5, 0.05, 0).centers) == 5
