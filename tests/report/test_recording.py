"""The recording for Rerun, read back: what is in it, and when on its timeline."""

from __future__ import annotations

import shutil
from collections import defaultdict
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from polmvs.cli import pages
from polmvs.colmap.models import read_model
from polmvs.errors import DataError, OptionError
from polmvs.io.clouds import Mesh, read_cloud, write_mesh
from polmvs.pipeline.run_folder import SURFACE_LEVELS, SURFACE_MESH, RunFolder
from polmvs.polarization.kinds import AngleModel
from polmvs.report import recording
from polmvs.report.recording import num_recorded_steps, write_recording

chunk = pytest.importorskip("rerun.chunk", reason="the extra 'rerun' is not installed")

TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]])
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)


@lru_cache(maxsize=1)
def entries(path: Path) -> dict[tuple[str, str], list[tuple[int, Any]]]:
    """Steps and values of each component of each entity of a recording, in their order."""
    found: dict[tuple[str, str], list[tuple[int, Any]]] = defaultdict(list)
    for part in chunk.RrdReader(str(path)).stream():
        batch = part.to_record_batch()
        if "stage" not in batch.schema.names:
            continue
        steps = batch.column("stage").to_pylist()
        for name in filter(lambda name: ":" in name, batch.schema.names):
            for step, value in zip(steps, batch.column(name), strict=True):
                if value.is_valid:
                    found[str(part.entity_path), name].append((step, value))
    return {key: sorted(values, key=lambda pair: pair[0]) for key, values in found.items()}


def find(path: Path, entity: str, component: str) -> list[tuple[int, Any]]:
    return entries(path).get((entity, component), [])


def stages(path: Path) -> list[str]:
    """Names of the stages, in their order."""
    return [v.as_py()[0].split(":")[0] for _, v in find(path, "/log/stages", "TextLog:text")]


def array(value: Any) -> np.ndarray:
    """The numbers of a list of vectors or matrices, a row each."""
    return np.asarray(value.values.flatten(), np.float64).reshape(len(value.values), -1)


@pytest.fixture(scope="module")
def run(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's run, as if PPA's surface had been refined from a hull in two levels."""
    folder = tmp_path_factory.mktemp("recording") / "run"
    shutil.copytree(demo_run, folder)
    views = RunFolder(folder).views("ppa")
    for model in AngleModel:
        for path in RunFolder(folder).views(model).glob("surface*.ply"):
            path.unlink()
    for number, name in enumerate(
        [*(SURFACE_LEVELS.format(number=n) for n in range(3)), SURFACE_MESH]
    ):
        vertices = TETRAHEDRON / (1 + number)
        write_mesh(views / name, Mesh(vertices=vertices, normals=TETRAHEDRON, triangles=FACES))
    return folder


@pytest.fixture(scope="module")
def recorded(run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("recorded") / "demo.rrd"
    steps: list[int] = []
    write_recording(RunFolder(run), path, on_progress=steps.append)
    assert sum(steps) == num_recorded_steps(RunFolder(run))
    return path


def test_the_stages_follow_each_other(recorded: Path) -> None:
    assert stages(recorded) == [
        "images",
        "poses",
        "maps",
        "normals_opa",
        "densify_opa",
        "normals_ppa",
        *(["surface_ppa"] * 4),
        "densify_ppa",
        "normals_tilted",
        "densify_tilted",
    ]


def test_cameras_are_those_of_the_model(run: Path, recorded: Path) -> None:
    for view in read_model(run / "sparse").views:
        entity = f"/world/cameras/{view.name}"
        [(step, translation)] = find(recorded, entity, "Transform3D:translation")
        assert stages(recorded)[step] == "poses"
        np.testing.assert_allclose(array(translation)[0], view.center_in_world, atol=1e-5)
        [(_, rotation)] = find(recorded, entity, "Transform3D:mat3x3")
        # By columns, world from camera: the rows of camera from world.
        columns = array(rotation)[0].reshape(3, 3)
        np.testing.assert_allclose(columns, view.cam_from_world.rotation, atol=1e-5)
        [(_, matrix)] = find(recorded, entity, "Pinhole:image_from_camera")
        np.testing.assert_allclose(array(matrix)[0].reshape(3, 3).T, view.camera.K, atol=1e-3)
        assert len(find(recorded, f"{entity}/image", "EncodedImage:blob")) == 1
        assert len(find(recorded, f"{entity}/phase", "EncodedImage:blob")) == 1


@pytest.mark.parametrize("model", ["opa", "ppa", "tilted"])
def test_clouds_are_those_of_the_run(run: Path, recorded: Path, model: str) -> None:
    [(step, positions)] = find(recorded, f"/world/{model}/cloud", "Points3D:positions")
    assert stages(recorded)[step] == f"densify_{model}"
    np.testing.assert_allclose(array(positions), read_cloud(run / f"{model}.ply").points, atol=1e-5)


def test_the_surface_refines_from_its_hull(recorded: Path) -> None:
    found = find(recorded, "/world/ppa/surface", "Mesh3D:vertex_positions")
    assert [stages(recorded)[step] for step, _ in found] == ["surface_ppa"] * 4
    for number, (_, vertices) in enumerate(found):
        np.testing.assert_allclose(array(vertices), TETRAHEDRON / (1 + number), atol=1e-6)


def test_the_command(cli, run: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(pages, "make_report", lambda *arguments: "report.html")  # slow
    path = tmp_path / "new" / "out.rrd"
    status, out, _ = cli("report", run, "--rerun", path)
    assert status == 0
    assert out.splitlines()[-1] == str(path)
    assert path.stat().st_size > 1e6
    assert [file.name for file in path.parent.iterdir()] == ["out.rrd"]


@pytest.mark.parametrize("words", [["report"], ["reconstruct", "nowhere"], ["demo"]])
def test_without_the_extra_nothing_is_begun(cli, tmp_path: Path, monkeypatch, words) -> None:
    monkeypatch.setattr(recording, "find_spec", lambda name: None)
    status, out, err = cli(*words, tmp_path / "out", "--rerun", tmp_path / "out.rrd")
    assert (status, out) == (2, "")
    assert err.count("\n") == 1
    assert "--rerun needs the extra 'rerun': pip install '.[rerun]'" in err
    assert list(tmp_path.iterdir()) == []


def test_another_ending_is_refused(run: Path, tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"must end with \.rrd"):
        write_recording(RunFolder(run), tmp_path / "out.ply")


def test_a_run_without_poses_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DataError):
        write_recording(RunFolder(tmp_path), tmp_path / "out.rrd")
    assert list(tmp_path.iterdir()) == []
