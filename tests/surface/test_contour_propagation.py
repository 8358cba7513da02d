from dataclasses import replace

import numpy as np
import pytest
from scenes import CAMERA, board_scene

from polmvs.camera import PinholeCamera
from polmvs.config import (
    Contour,
    FusionOptions,
    PropagationOptions,
)
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import Seeds
from polmvs.surface.dense_view import DenseView, open_dense_view, store_dense_view
from polmvs.surface.fusion import FusedCloud, fuse, merge
from polmvs.surface.propagation import propagate

OPTIONS = PropagationOptions(num_rounds=2, stride_px=2)


@pytest.fixture(scope="module")
def scene():
    return board_scene(6)


def distances(scene, points):
    normal = scene.surface.normal / np.linalg.norm(scene.surface.normal)
    return (points - scene.surface.point) @ normal


@pytest.mark.parametrize("contour", list(Contour))
def test_ppa_covers_the_board_from_a_few_seeds_and_opa_bends_it(scene, tmp_path, contour):
    options = PropagationOptions(num_rounds=2, contour=contour)
    rmse = {}
    for model in (AngleModel.OPA, AngleModel.PPA):
        dense = propagate(model, scene.maps, scene.seeds(8), options, tmp_path / model)
        cloud = fuse(scene.maps, dense, FusionOptions())
        rmse[model] = np.sqrt((distances(scene, cloud.points) ** 2).mean())
        for rendered, view in zip(scene.rendered, dense, strict=True):
            known = view.range_map > 0
            truth = rendered.mask[1::2, 1::2]
            assert (known & truth).sum() > 0.85 * truth.sum()
    assert rmse[AngleModel.PPA] < 0.0002  # 0.05 mm measured at half a metre, 4 mm a pixel
    assert rmse[AngleModel.OPA] > 10 * rmse[AngleModel.PPA]


def test_a_wrong_seed_does_not_dent_the_surface(scene, tmp_path):
    seeds = scene.seeds(20)
    points = seeds.points_in_world.copy()
    points[3] += 0.03 * seeds.normals_in_world[3]
    bad = Seeds(points, seeds.normals_in_world, seeds.sigma)
    cloud = fuse(
        scene.maps, propagate(AngleModel.PPA, scene.maps, bad, OPTIONS, tmp_path), FusionOptions()
    )
    assert np.abs(distances(scene, cloud.points)).max() < 0.003


def plane_view(scene, k, offset=0.0):
    """True dense view of a scene's view, the surface moved by an offset along its normal."""
    view, surface = scene.views[k], scene.surface
    normal = surface.normal / np.linalg.norm(surface.normal)
    shape = (view.camera.height // 2, view.camera.width // 2)
    zero = np.zeros(shape, np.float32)
    empty = DenseView(2, zero, np.zeros((*shape, 3), np.float32), zero, zero, zero)
    rays = view.camera.rays(empty.lattice_xy()) @ view.cam_from_world.rotation
    top = (surface.point + offset * normal - view.center_in_world) @ normal
    mask = scene.rendered[k].mask[1::2, 1::2]
    ranges = np.where(mask, top / (rays @ normal), 0).astype(np.float32)
    normals = np.where(mask[..., None], normal, np.nan).astype(np.float32)
    some = np.full(shape, 0.3, np.float32)
    return DenseView(2, ranges, normals, some, 1e-3 * some, some)


def test_fusion_keeps_what_views_agree_on_and_drops_what_one_view_says_alone(scene):
    dense = [plane_view(scene, k) for k in range(6)]
    dense[2] = plane_view(scene, 2, offset=0.05)
    cloud = fuse(scene.maps, dense, FusionOptions())
    assert np.abs(distances(scene, cloud.points)).max() < 1e-4
    assert cloud.num_views.max() == 5


def test_fusion_averages_the_views(scene):
    offsets = [-0.001, 0.001, -0.0005, 0.0005, 0.0, 0.0]
    dense = [plane_view(scene, k, o) for k, o in enumerate(offsets)]
    cloud = fuse(scene.maps, dense, FusionOptions(voxel_px=0))
    everywhere = cloud.num_views == 6
    assert everywhere.sum() > 1000
    np.testing.assert_allclose(distances(scene, cloud.points[everywhere]), 0, atol=2e-5)


def test_fusion_merges_duplicates(scene):
    dense = [plane_view(scene, k) for k in range(6)]
    merged = fuse(scene.maps, dense, FusionOptions(voxel_px=1.0))
    apart = fuse(scene.maps, dense, FusionOptions(voxel_px=0))
    assert len(merged.points) < 0.7 * len(apart.points)
    np.testing.assert_allclose(np.linalg.norm(merged.normals, axis=-1), 1, atol=1e-6)


def test_min_views(scene):
    dense = [plane_view(scene, 0)] + [None] * 5
    assert len(fuse(scene.maps, dense, FusionOptions(min_views=2)).points) == 0
    assert len(fuse(scene.maps, dense, FusionOptions(min_views=1)).points) > 100


def test_normals_must_agree(scene):
    dense = [plane_view(scene, k) for k in range(2)]
    turned = dense[1].normals_in_world @ np.array(
        [[1, 0, 0], [0, np.cos(0.5), -np.sin(0.5)], [0, np.sin(0.5), np.cos(0.5)]], np.float32
    )
    dense[1] = replace(dense[1], normals_in_world=turned.astype(np.float32))
    assert len(fuse(scene.maps[:2], dense, FusionOptions()).points) == 0


def one_view_off(scene, off, sigma_off, *, sigma=3e-4, k=0, **options):
    """Fused cloud of true views of a deviation, one of them off by so much with its own."""
    dense = []
    for j in range(6):
        view = plane_view(scene, j, off if j == k else 0.0)
        known = view.range_map > 0
        own = np.where(known, sigma_off if j == k else sigma, np.nan).astype(np.float32)
        dense.append(replace(view, sigma=own))
    return fuse(scene.maps, dense, FusionOptions(voxel_px=0, **options))


def test_the_surer_view_has_the_greater_weight(scene):
    """1 mm off with a third of the others' deviation: nine of fourteen parts, and the reverse."""
    for sigma_off, expected in ((1e-4, 9 / 14), (3e-4, 1 / 6), (9e-4, (1 / 9) / (5 + 1 / 9))):
        cloud = one_view_off(scene, 1e-3, sigma_off)
        everywhere = cloud.num_views == 6
        assert everywhere.sum() > 1000
        # Views look at the board at different angles, which their deviations go with.
        assert np.median(distances(scene, cloud.points[everywhere])) == pytest.approx(
            1e-3 * expected, rel=0.1
        )


def test_the_tolerance_narrows_for_certain_views_but_not_below_half(scene):
    """A gsd is 4 mm, the tolerance two of them: 8 mm along the ray, 4 mm where certain."""
    gsd = 0.5 / CAMERA.fx
    certain, doubtful = gsd / 100, 2 * gsd

    def votes(off, sigma):
        cloud = one_view_off(scene, off, sigma, sigma=sigma, min_views=5)
        return np.median(cloud.num_views)

    # Offsets along the normal; along rays 45 degrees off it they are 1.4 times as large.
    assert votes(0.5 * gsd, certain) == 6
    assert votes(1.0 * gsd, certain) == 5
    assert votes(1.0 * gsd, doubtful) == 6
    assert votes(2.0 * gsd, doubtful) == 5


def test_the_fused_deviation_is_that_of_a_view_and_along_the_normal(scene):
    """Views err alike: six of them are no surer than one."""
    cloud = one_view_off(scene, 0.0, 3e-4)
    assert (cloud.num_views == 6).sum() > 1000
    np.testing.assert_allclose(cloud.sigma, 3e-4, rtol=0.15)
    mixed = one_view_off(scene, 0.0, 1e-4)
    expected = np.sqrt(6 / (5 / 3e-4**2 + 1 / 1e-4**2))
    assert np.median(mixed.sigma[mixed.num_views == 6]) == pytest.approx(expected, rel=0.1)


def test_an_unknown_deviation_is_that_of_a_gsd(scene):
    cloud = one_view_off(scene, 1e-3, np.nan, sigma=np.nan)
    everywhere = cloud.num_views == 6
    assert np.median(distances(scene, cloud.points[everywhere])) == pytest.approx(1e-3 / 6, rel=0.1)
    np.testing.assert_allclose(np.median(cloud.sigma), 0.5 / CAMERA.fx * 0.72, rtol=0.25)


@pytest.mark.parametrize("scale", [1.0, 20.0])
def test_the_voxel_is_in_units_of_the_world(scene, scale):
    dense = [plane_view(scene, k) for k in range(6)]
    voxel = 0.01
    cloud = fuse(scene.maps, dense, FusionOptions(voxel=voxel, voxel_px=scale))
    # A board of 24 x 30 cm, some cells cut by the tilted plane.
    assert 600 < len(cloud.points) < 2000
    fine = fuse(scene.maps, dense, FusionOptions(voxel=voxel / 2))
    assert 2.5 < len(fine.points) / len(cloud.points) < 5
    whole = fuse(scene.maps, dense, FusionOptions(voxel=0.0))
    np.testing.assert_array_equal(
        whole.points, fuse(scene.maps, dense, FusionOptions(voxel_px=0)).points
    )


def test_min_views_counts_the_views_own_vote(scene):
    dense = [plane_view(scene, k) for k in range(3)] + [None] * 3
    for min_views in (1, 2, 3):
        cloud = fuse(scene.maps, dense, FusionOptions(min_views=min_views, voxel_px=0))
        assert cloud.num_views.min() == min_views
        assert cloud.num_views.max() == 3
    assert len(fuse(scene.maps, dense, FusionOptions(min_views=4)).points) == 0


def test_merged_points_lie_where_the_surer_ones_do():
    """Two points in a voxel: 16 times the weight for a quarter of the deviation."""
    cloud = FusedCloud(
        points=np.array([[0.0, 0, 0], [0.4, 0, 0], [5.0, 0, 0]]),
        normals=np.array([[0.0, 0, -1], [0, 0, -1], [0, 0, -1]]),
        intensity=np.zeros(3, np.float32),
        num_views=np.array([2, 2, 3], np.int32),
        sigma_deg=np.ones(3, np.float32),
        sigma=np.array([0.4, 0.1, 0.1], np.float32),
    )
    merged = merge(cloud, 1.0)
    np.testing.assert_allclose(merged.points[:, 0], [0.4 * 16 / 17, 5.0], rtol=1e-6)
    np.testing.assert_array_equal(merged.num_views, [2, 3])
    np.testing.assert_allclose(merged.sigma, [(0.4 + 16 * 0.1) / 17, 0.1], rtol=1e-6)


def test_a_stored_dense_view_travels_as_its_path(scene, tmp_path):
    import pickle

    stored = store_dense_view(plane_view(scene, 0), tmp_path / "a.0")
    assert len(pickle.dumps(stored)) < 1000
    again = pickle.loads(pickle.dumps(stored))
    np.testing.assert_array_equal(again.range_map, stored.range_map)
    assert open_dense_view(2, tmp_path / "a.0").stride_px == 2


def test_a_view_of_another_camera_fits_in(scene):
    """Fusion reads each view through its own camera."""
    from dataclasses import replace

    wide = PinholeCamera(width=160, height=128, fx=100.0, fy=100.0, cx=80.0, cy=64.0)
    other = replace(scene.maps[1], view=replace(scene.maps[1].view, camera=wide))
    changed = replace(scene, views=[scene.views[0], other.view])
    dense = [plane_view(scene, 0), plane_view(changed, 1)]
    cloud = fuse([scene.maps[0], other], dense, FusionOptions())
    assert len(cloud.points) > 300
    assert np.abs(distances(scene, cloud.points)).max() < 1e-4
