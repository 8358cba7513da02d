"""Clouds as other programs read them."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import open3d
import pytest

from polmvs.errors import PolmvsError
from polmvs.io.cloud_files import CLOUD_FORMATS, write_cloud_file
from polmvs.io.clouds import Cloud


@pytest.fixture
def cloud() -> Cloud:
    rng = np.random.default_rng(0)
    normals = rng.normal(size=(500, 3))
    return Cloud(
        points=rng.normal(size=(500, 3)) + np.array([1e3, -5, 0]),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        colors=rng.integers(0, 256, (500, 3)).astype(np.uint8),
        scalars={"sigma": rng.uniform(size=500).astype(np.float32)},
    )


@pytest.mark.parametrize("form", ["las", "laz"])
def test_laspy_reads_las(tmp_path: Path, cloud: Cloud, form: str) -> None:
    path = tmp_path / f"c.{form}"
    write_cloud_file(path, cloud, form)
    found = laspy.read(path)
    np.testing.assert_allclose(found.xyz, cloud.points, atol=1e-8)
    for name, column in zip(("red", "green", "blue"), cloud.colors.T, strict=True):
        np.testing.assert_array_equal(np.asarray(found[name]) // 257, column)
    np.testing.assert_array_equal(found["sigma"], cloud.scalars["sigma"])
    np.testing.assert_allclose(found["ny"], cloud.normals[:, 1], atol=1e-7)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


def test_xyz_and_ply(tmp_path: Path, cloud: Cloud) -> None:
    write_cloud_file(tmp_path / "c.xyz", cloud, "xyz")
    rows = np.loadtxt(tmp_path / "c.xyz")
    np.testing.assert_allclose(rows[:, :3], cloud.points, rtol=1e-8)
    np.testing.assert_allclose(rows[:, 3:6], cloud.normals, atol=1e-5)
    np.testing.assert_array_equal(rows[:, 6:], cloud.colors)
    write_cloud_file(tmp_path / "c.ply", cloud, "ply")
    assert len(open3d.io.read_point_cloud(str(tmp_path / "c.ply")).points) == 500


@pytest.mark.parametrize("form", CLOUD_FORMATS)
def test_no_points(tmp_path: Path, form: str) -> None:
    write_cloud_file(tmp_path / f"c.{form}", Cloud(points=np.zeros((0, 3))), form)
    assert (tmp_path / f"c.{form}").is_file()


def test_the_library_for_las_is_named(tmp_path: Path, cloud: Cloud, monkeypatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "laspy", None)
    with pytest.raises(PolmvsError, match=r"pip install '\.\[las\]'"):
        write_cloud_file(tmp_path / "c.las", cloud, "las")
    assert not list(tmp_path.iterdir())
