"""Dense views: their lattice, their files, and the surface between known points."""

import pickle

import numpy as np
import pytest
from scenes import CAMERA

from polmvs.errors import DataError
from polmvs.surface.dense_view import (
    DenseView,
    SurfaceSamples,
    dense_view,
    extend_planes,
    lattice_points,
    lattice_xy,
    open_dense_view,
    store_dense_view,
)
from polmvs.synthetic.surfaces import Plane, Sphere

BALL = Sphere(center=np.array([0.02, -0.01, 0.9]), radius=0.4)
BOARD = Plane(point=np.array([0.0, 0.0, 0.5]), normal=np.array([0.3, -0.2, -1.0]))
MEMBERS = ("range_map", "normals_in_world", "sigma_deg", "sigma", "confidence")


def samples_of(surface, xy, normal_sigma=0.01, log_range_sigma=0.002):
    """True points of a surface seen by a camera at the origin, those it hits."""
    rays = CAMERA.rays(xy)
    distance, normals = surface.intersect(np.zeros(3), rays)
    hit = np.isfinite(distance)
    ones = np.ones(int(hit.sum()))
    return SurfaceSamples(
        xy=xy[hit],
        rays_in_world=rays[hit],
        log_range=np.log(distance[hit]),
        normals=normals[hit],
        normal_sigma=normal_sigma * ones,
        log_range_sigma=log_range_sigma * ones,
        confidence=0.75 * ones,
    )


def grid(low, high, step):
    return np.stack(
        np.meshgrid(np.arange(low, high, step), np.arange(low, high, step)), -1
    ).reshape(-1, 2)


def test_the_lattice_lies_at_the_centres_of_its_cells():
    xy = lattice_xy(2, 3, 4)
    np.testing.assert_array_equal(xy[0, :, 0], [2, 6, 10])
    np.testing.assert_array_equal(xy[:, 0, 1], [2, 6])
    np.testing.assert_array_equal(lattice_xy(1, 2, 1)[0], [[0.5, 0.5], [1.5, 0.5]])
    wanted = np.array([[False, True, False], [True, False, False]])
    np.testing.assert_array_equal(lattice_points(wanted, 4), [[6, 2], [2, 6]])


def round_trip():
    stride = 4
    wanted = np.zeros((32, 40), bool)
    wanted[6:26, 8:33] = True
    samples = samples_of(BOARD, lattice_points(wanted, stride))
    samples.log_range[3], samples.normals[5] = np.nan, np.nan
    return samples, dense_view(samples, wanted, stride)


def test_samples_become_a_view():
    samples, dense = round_trip()
    kept = np.setdiff1d(np.arange(len(samples.xy)), [3, 5])
    np.testing.assert_array_equal(dense.lattice_xy()[dense.known], samples.xy[kept])
    known, expected = dense.known, samples[kept]
    for found, truth in (
        (dense.range_map[known], np.exp(expected.log_range)),
        (dense.normals_in_world[known], expected.normals),
        (np.radians(dense.sigma_deg[known]), expected.normal_sigma),
        (dense.confidence[known], expected.confidence),
    ):
        np.testing.assert_allclose(found, truth, rtol=1e-6, atol=1e-6)


def test_a_dense_view_holds_world_units_and_degrees_and_says_where_it_knows_nothing():
    _, dense = round_trip()
    known = dense.known
    np.testing.assert_allclose(dense.sigma[known], 0.002 * dense.range_map[known], rtol=1e-5)
    np.testing.assert_allclose(dense.sigma_deg[known], np.degrees(0.01), rtol=1e-5)
    assert (dense.range_map[~known] == 0).all()
    assert (dense.confidence[~known] == 0).all()
    for name in ("normals_in_world", "sigma", "sigma_deg"):
        assert np.isnan(getattr(dense, name)[~known]).all()
    assert all(getattr(dense, name).dtype == np.float32 for name in MEMBERS)


@pytest.mark.parametrize("stored", [False, True])
def test_a_view_survives_disk_and_pickle(tmp_path, stored):
    _, dense = round_trip()
    again = store_dense_view(dense, tmp_path / "a.png.3") if stored else dense
    again = pickle.loads(pickle.dumps(again))
    for name in MEMBERS:
        np.testing.assert_array_equal(getattr(again, name), getattr(dense, name))
    assert again.stride_px == dense.stride_px == 4
    assert isinstance(again, DenseView)


def test_a_missing_file_of_a_view_is_named(tmp_path):
    _, dense = round_trip()
    store_dense_view(dense, tmp_path / "a.0")
    (tmp_path / "a.0.sigma.npy").unlink()
    with pytest.raises(DataError, match=r"a\.0\.sigma\.npy"):
        open_dense_view(4, tmp_path / "a.0")


def test_a_plane_is_extended_exactly():
    known = samples_of(BOARD, grid(30.0, 100.0, 5))
    xy = grid(33.3, 95.0, 1.7)
    truth = samples_of(BOARD, xy)
    extended = extend_planes(known, xy, CAMERA.rays(xy), 10.0)
    np.testing.assert_allclose(extended.log_range, truth.log_range, atol=1e-12)
    np.testing.assert_allclose(extended.normals, truth.normals, atol=1e-12)
    np.testing.assert_allclose(extended.log_range_sigma, 0.002, rtol=1e-9)
    np.testing.assert_allclose(extended.confidence, 0.75, rtol=1e-9)


def test_a_sphere_is_extended_without_the_bulge_of_its_tangent_planes():
    """Halfway between points: their planes lie outside the sphere by gap^2 / 2 R."""
    known = samples_of(BALL, grid(60.0, 100.0, 4))
    xy = grid(66.0, 94.0, 4)  # the centres of the cells
    truth = samples_of(BALL, xy)
    extended = extend_planes(known, xy, CAMERA.rays(xy), 8.0)
    error = np.exp(extended.log_range) - np.exp(truth.log_range)
    gap = np.sqrt(8) * np.exp(truth.log_range) / CAMERA.fx
    sagitta = gap**2 / (2 * BALL.radius)
    assert np.abs(error / sagitta).max() < 0.1
    cosine = (extended.normals * truth.normals).sum(axis=-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.1


def test_nothing_is_extended_beyond_the_gap():
    known = samples_of(BOARD, np.array([[50.0, 50.0], [52.0, 50.0], [50.0, 52.0]]))
    xy = np.array([[52.0, 56.0], [47.1, 50.0], [46.9, 50.0], [90.0, 90.0]])
    extended = extend_planes(known, xy, CAMERA.rays(xy), 3.0)
    np.testing.assert_array_equal(np.isfinite(extended.log_range), [False, True, False, False])
    np.testing.assert_array_equal(
        np.isfinite(extended.normals).all(axis=-1), [False, True, False, False]
    )
    for name in ("normal_sigma", "log_range_sigma", "confidence"):
        np.testing.assert_array_equal(
            np.isfinite(getattr(extended, name)), [False, True, False, False], err_msg=name
        )


def test_one_sample_carries_its_plane():
    known = samples_of(BOARD, np.array([[50.0, 50.0]]))
    xy = np.array([[50.0, 50.0], [53.0, 51.0]])
    extended = extend_planes(known, xy, CAMERA.rays(xy), 5.0)
    np.testing.assert_allclose(extended.log_range, samples_of(BOARD, xy).log_range, atol=1e-12)


def test_nearer_samples_count_more():
    """Two planes, one sample of each: the place next to one lies almost on it."""
    near, far = samples_of(BOARD, np.array([[50.0, 50.0]])), np.array([[58.0, 50.0]])
    moved = samples_of(BOARD, far)
    joined = SurfaceSamples(
        *(
            np.concatenate([getattr(near, name), getattr(moved, name)])
            for name in SurfaceSamples.__dataclass_fields__
        )
    )
    joined.log_range[1] += 0.1
    xy = np.array([[51.0, 50.0]])
    error = (
        extend_planes(joined, xy, CAMERA.rays(xy), 20.0).log_range - samples_of(BOARD, xy).log_range
    )
    np.testing.assert_allclose(error, 0.1 * (1 / 50) / (1 / 2 + 1 / 50), rtol=1e-6)


def test_samples_are_chosen_together():
    samples = samples_of(BOARD, grid(50.0, 60.0, 5))
    some = samples[np.array([2, 0])]
    np.testing.assert_array_equal(some.xy, samples.xy[[2, 0]])
    np.testing.assert_array_equal(some.normals, samples.normals[[2, 0]])
