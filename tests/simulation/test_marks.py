"""Places of printed marks."""

import numpy as np
import pytest
import trimesh

from polmvs.errors import DataError
from polmvs.io.clouds import Mesh
from polmvs.simulation.marks import marks_at, marks_on


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


def test_given_marks_lie_on_the_surface_where_they_were_put(tmp_path):
    places = tmp_path / "places.txt"
    places.write_text("# x y z\n0.05 -0.02 0.2\n\n0.1 0.03 0.105\n")
    marks = marks_at(_box((0.2, 0.2, 0.2)), places, 0.012, 0)
    np.testing.assert_allclose(marks.centers, [[0.05, -0.02, 0.2], [0.1, 0.03, 0.105]], atol=1e-6)
    np.testing.assert_allclose(marks.axes[:, 2], [[0, 0, 1], [1, 0, 0]], atol=1e-6)
    np.testing.assert_allclose(
        marks.axes @ np.swapaxes(marks.axes, 1, 2), [np.eye(3)] * 2, atol=1e-9
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("0 0 0.2\n0 0 200\n", r"place 2 .* m from the object's surface"),
        ("0 0 0.2\n0 0\n", "line 2 needs: x y z"),
        ("0 0 nan\n", "line 1 needs: x y z"),
        ("a b c\n", "line 1 needs: x y z"),
        ("# none\n", "has no places"),
        (None, "read"),
    ],
)
def test_unusable_places_of_marks_are_named(tmp_path, text, message):
    places = tmp_path / "places.txt"
    if text is not None:
        places.write_text(text)
    with pytest.raises(DataError, match=message):
        marks_at(_box((0.2, 0.2, 0.2)), places, 0.012, 0)
