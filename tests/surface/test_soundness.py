"""Sheets upon each other and overlaps are found, and sound bodies are not blamed."""

import numpy as np
import pytest
from analytic_objects import box, extracted, ring_of_views, side_by_side, sphere, torus

from polmvs.surface.mesh_geometry import TriangleMesh
from polmvs.surface.soundness import find_soundness

VIEWS = ring_of_views(6)
GSD = 5 / 150


@pytest.mark.parametrize("distance", [sphere(), torus(), box()])
def test_bodies_are_sound(distance) -> None:
    found = find_soundness(extracted(distance, step=0.05), VIEWS)
    assert found.layered < 0.02
    assert found.overlapping == 0


def test_a_shell_as_thin_as_a_pixel_is_two_sheets() -> None:
    def shell(thickness):
        return lambda p: abs(sphere()(p)) - thickness / 2

    thin, thick = (
        find_soundness(extracted(shell(t), half=1.2, step=0.03), VIEWS[:2]).layered
        for t in (2 * GSD, 6 * GSD)
    )
    assert thin > 0.6  # all but the rim
    assert thick < 0.1


def test_bodies_in_each_other_overlap() -> None:
    apart = side_by_side(extracted(sphere(0.5)), extracted(sphere(0.5, (1.05, 0, 0))))
    within = side_by_side(extracted(sphere(1.0)), extracted(sphere(0.5)))
    assert find_soundness(apart, VIEWS).overlapping == 0
    # A quarter of the outer one's disc is the inner one's.
    assert find_soundness(within, VIEWS).overlapping == pytest.approx(0.25, abs=0.04)


def test_what_a_box_cut_away_is_not_looked_at() -> None:
    within = side_by_side(extracted(sphere(1.0)), extracted(sphere(0.5)))
    outside = {}
    for view in VIEWS:  # all pixels that show the inner one
        camera = view.camera
        x, y = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        middle = view.project(np.zeros(3))
        outside[view.name] = np.hypot(x - middle[0], y - middle[1]) < 0.6 * camera.fx / 5
    assert find_soundness(within, VIEWS).overlapping > 0.2
    assert find_soundness(within, VIEWS, outside).overlapping == 0


def test_nothing_is_sound() -> None:
    nothing = TriangleMesh(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    assert find_soundness(nothing, VIEWS).layered == 0
