"""Depth and normals at the sensor's own pixels."""

import numpy as np
import pytest
from dense_scenes import FISHEYE, OPENCV, PINHOLE, board_scene

from polmvs.camera import pixel_centers
from polmvs.surface.map_export import sensor_maps


@pytest.mark.parametrize("camera", [PINHOLE, OPENCV, FISHEYE])
@pytest.mark.parametrize("stride", [1, 2, 4])
def test_plane_is_exact_at_the_centres_of_the_pixels(camera, stride):
    scene = board_scene(camera, num_views=1)
    view = scene.views[0]
    maps = sensor_maps(scene.dense(view.name, stride), view)
    xy = pixel_centers(camera.width, camera.height)
    distance, normals = scene.seen(view, xy)
    known = (maps.depth > 0) & np.isfinite(distance)
    assert known.sum() > 0.98 * np.isfinite(distance).sum()
    depth = distance * camera.rays(xy)[..., 2]
    # Half a pixel beside it the depth of this tilted plane differs by 0.1 %.
    np.testing.assert_allclose(maps.depth[known], depth[known], rtol=2e-6)
    expected = (normals @ view.cam_from_world.rotation.T)[known]
    np.testing.assert_allclose(maps.normals[known], expected, atol=1e-5)


def test_nothing_is_known_of_a_view_without_depth():
    scene = board_scene(PINHOLE, num_views=1)
    view = scene.views[0]
    dense = scene.dense(view.name)
    maps = sensor_maps(dense.only(np.zeros(dense.range_map.shape, bool)), view)
    assert not maps.depth.any()
    assert not maps.normals.any()
