"""Cameras of one capture are told from others by their orientations as well."""

from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA
from scipy.spatial.transform import Rotation

from polmvs.errors import DataError
from polmvs.geometry import RigidTransform
from polmvs.poses.alignment import AlignmentTolerances, align_views
from polmvs.scene import View
from polmvs.synthetic.captures import ring_of_views

VIEWS = ring_of_views(6, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=45, roll_deg=20)


def turned(view: View, degrees: float) -> View:
    """The same centre, turned about the camera's own axis of sight."""
    turn = Rotation.from_euler("z", degrees, degrees=True).as_matrix()
    pose = view.cam_from_world
    moved = RigidTransform(turn @ pose.rotation, turn @ pose.translation)
    return replace(view, cam_from_world=moved)


def test_centres_that_fit_do_not_excuse_orientations_that_do_not() -> None:
    most = AlignmentTolerances().max_turn_deg
    truth = {view.name: view for view in VIEWS}
    near = [turned(view, most - 1) for view in VIEWS]
    transform, found = align_views(near, truth)
    assert found.rotation_error_median_deg == pytest.approx(most - 1, abs=1e-6)
    np.testing.assert_allclose(transform.rotation, np.eye(3), atol=1e-9)
    for degrees in (most + 1, 90.0, 180.0):
        with pytest.raises(DataError, match="deg apart"):
            align_views([turned(view, degrees) for view in VIEWS], truth)
