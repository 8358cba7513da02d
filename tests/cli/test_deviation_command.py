"""``polmvs deviation`` on files: what it says, writes, and ends with."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh
from helpers import refused

from polmvs.io.clouds import Cloud, read_cloud, write_cloud


def part() -> trimesh.Trimesh:
    block = trimesh.creation.box((0.12, 0.08, 0.03))
    knob = trimesh.creation.icosphere(subdivisions=3, radius=0.01)
    knob.apply_translation([-0.04, -0.02, 0.018])
    return trimesh.util.concatenate([block, knob])


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A cloud in metres with a dent of half a millimetre, turned and shifted."""
    points, face = trimesh.sample.sample_surface(part(), 15_000, seed=0)
    points, normals = np.array(points), part().face_normals[face]
    dent = (normals[:, 2] > 0.9) & (np.abs(points[:, 2] - 0.015) < 1e-9) & (points[:, 0] > 0.03)
    points[dent, 2] -= 5e-4
    turn = trimesh.transformations.rotation_matrix(2.0, [1, 2, 3])[:3, :3]
    path = tmp_path_factory.mktemp("result") / "cloud.ply"
    sigma = np.full(len(points), 1e-5)
    moved = points @ turn.T + np.array([1, 2, 3])
    write_cloud(path, Cloud(points=moved, normals=normals @ turn.T, scalars={"sigma": sigma}))
    return path


@pytest.mark.parametrize(
    ("suffix", "scale", "unit"), [("stl", 1e3, "mm"), ("obj", 1.0, "m"), ("glb", 100.0, "cm")]
)
def test_references_of_any_format_and_unit(
    tmp_path: Path, result: Path, cli, suffix: str, scale: float, unit: str
) -> None:
    mesh = part().apply_scale(scale)
    mesh.export(tmp_path / f"part.{suffix}")
    out = tmp_path / "out"
    arguments = ("deviation", result, tmp_path / f"part.{suffix}", "--metric")
    status, text, _ = cli(*arguments, "--tolerance", 0.2, "--least-share", 0.95, "--out", out)
    assert status == 4  # 7 % of the area are dented
    assert f"reference in {unit} (inferred from the sizes)" in text
    assert "95 % are asked for: FAIL" in text
    figures = json.loads((out / "deviation.json").read_text())
    assert figures["percentiles"]["1"] == pytest.approx(-0.5, abs=0.03)
    assert figures["percentiles"]["75"] == pytest.approx(0, abs=0.03)
    cloud = read_cloud(out / "deviation.ply")
    low = cloud.scalars["distance_mm"] < -0.4
    assert 0.05 < low.mean() < 0.09
    assert (cloud.colors[low][:, 2] > cloud.colors[low][:, 0] + 50).all()  # blue: inside
    assert cv2.imread(str(out / "deviation.png")) is not None
    assert "<svg" in (out / "deviation.svg").read_text()
    status, text, _ = cli(*arguments, "--tolerance", 0.6, "--json")
    assert status == 0
    assert json.loads(text)["passed"] is True


def test_a_part_that_looks_alike_when_turned_is_said_with_the_flag(tmp_path: Path, cli) -> None:
    block = trimesh.creation.box((120, 80, 30))
    block.export(tmp_path / "block.stl")
    points, face = trimesh.sample.sample_surface(block, 5_000, seed=0)
    write_cloud(
        tmp_path / "cloud.ply",
        Cloud(points=1e-3 * np.array(points), normals=block.face_normals[face]),
    )
    arguments = (tmp_path / "cloud.ply", tmp_path / "block.stl", "--metric", "--tolerance", 0.2)
    status, text, _ = cli("deviation", *arguments)
    assert status == 0
    assert "when it is turned: bring it to its place and give --aligned" in text


def test_a_cloud_without_a_scale_needs_a_unit(tmp_path: Path, result: Path, cli) -> None:
    part().apply_scale(1e3).export(tmp_path / "part.stl")
    err = refused(cli("deviation", result, tmp_path / "part.stl"), 2)
    assert "--unit is needed" in err
    status, text, _ = cli("deviation", result, tmp_path / "part.stl", "--unit", "mm")
    assert status == 0
    assert "was fitted, so that its size is not tested" in text


@pytest.mark.parametrize(
    ("name", "content", "words"),
    [
        ("part.stl", b"", "holds no faces"),
        ("part.stl", b"solid nothing", "holds no faces"),
        ("part.step", b"", "is no mesh"),
        ("gone.obj", None, "No such file"),
        ("part.ply", b"ply", "part.ply"),
    ],
)
def test_references_that_cannot_be_used(
    tmp_path: Path, result: Path, cli, name: str, content: bytes | None, words: str
) -> None:
    if content is not None:
        (tmp_path / name).write_bytes(content)
    out = tmp_path / "out"
    err = refused(cli("deviation", result, tmp_path / name, "--metric", "--out", out))
    assert words in err
    assert not out.exists()
