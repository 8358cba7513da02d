import json
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
from polmvs.pipeline.runtime import peak_rss_mb, versions

from polmvs.config import AngleModel
from polmvs.errors import DataError, OptionError
from polmvs.pipeline.checks import followers
from polmvs.pipeline.record import Record, StageRecord, write_json
from polmvs.pipeline.run_folder import RunFolder, has_content, prepare_output, require_apart


def finished_run(root: Path) -> RunFolder:
    """An output folder with one file of each kind."""
    workspace = RunFolder(root)
    for folder, name in (("images", "a.png"), ("sparse", "cameras.bin"), ("maps", "a.npy")):
        (root / folder).mkdir(parents=True)
        (root / folder / name).write_bytes(b"x")
    for model in AngleModel:
        workspace.cloud(model).write_bytes(b"x")
        workspace.normals(model).write_bytes(b"x")
    workspace.metrics.write_text("{}")
    workspace.save(
        Record(images=["a.png"], stages=[StageRecord(name="sfm", seconds=1.0, peak_rss_mb=2.0)])
    )
    return workspace


def test_record_survives_writing_and_reading(tmp_path: Path) -> None:
    workspace = finished_run(tmp_path)
    record = workspace.load()
    assert record.images == ["a.png"]
    assert record.is_done("sparse", "sfm")
    assert not record.is_done("maps")
    record.forget(["sfm"])
    assert record.stages == []


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"stages": 3}', '{"stages": [], "x": 1}', "\0"])
def test_damaged_record_is_one_clear_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(DataError, match=r"run\.json: is no record of a run"):
        RunFolder(tmp_path).load()


def test_json_has_null_for_what_is_no_number(tmp_path: Path) -> None:
    write_json(
        tmp_path / "a.json",
        {"a": np.float32("nan"), "b": [float("inf"), np.int64(3)], "model": AngleModel.PPA},
    )
    content = json.loads((tmp_path / "a.json").read_text())
    assert content == {"a": None, "b": [None, 3], "model": "ppa"}


def test_new_and_empty_folders_are_taken(tmp_path: Path) -> None:
    for root in (tmp_path / "new" / "deep", tmp_path / "empty"):
        workspace = RunFolder(root)
        assert not has_content(root)
        assert prepare_output(workspace, overwrite=False, resume=False) == Record()
        assert root.is_dir()


def test_occupied_folder_is_refused(tmp_path: Path) -> None:
    workspace = finished_run(tmp_path)
    with pytest.raises(OptionError, match=r"--overwrite .*--resume"):
        prepare_output(workspace, overwrite=False, resume=False)
    assert workspace.cloud(AngleModel.PPA).exists()


def test_overwrite_deletes_results_only(tmp_path: Path) -> None:
    workspace = finished_run(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "photos").mkdir()
    (tmp_path / ".sfm.tmp").mkdir()
    assert prepare_output(workspace, overwrite=True, resume=False) == Record()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "photos"]


@pytest.mark.parametrize("foreign", ["images/mine.png", "sparse/notes.txt", "maps/sub/a.npy"])
def test_overwrite_deletes_nothing_where_foreign_files_lie(tmp_path: Path, foreign: str) -> None:
    workspace = finished_run(tmp_path)
    path = tmp_path / foreign
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DataError, match="was not written by polmvs"):
        prepare_output(workspace, overwrite=True, resume=False)
    assert sorted(tmp_path.rglob("*")) == before


def test_overwrite_needs_the_record_of_a_run(tmp_path: Path) -> None:
    """Another program's project may well have a folder ``images``."""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "photo.png").write_bytes(b"x")
    with pytest.raises(DataError, match=r"images: was not written by polmvs"):
        prepare_output(RunFolder(tmp_path), overwrite=True, resume=False)
    assert (tmp_path / "images" / "photo.png").exists()


def test_linked_folder_is_not_emptied(tmp_path: Path) -> None:
    workspace = finished_run(tmp_path / "out")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "points3D.bin").write_bytes(b"x")
    (workspace.sparse / "cameras.bin").unlink()
    workspace.sparse.rmdir()
    workspace.sparse.symlink_to(tmp_path / "elsewhere")
    with pytest.raises(DataError, match="was not written by polmvs"):
        prepare_output(workspace, overwrite=True, resume=False)
    assert (tmp_path / "elsewhere" / "points3D.bin").exists()


def test_resume_keeps_results_and_clears_what_is_half_done(tmp_path: Path) -> None:
    workspace = finished_run(tmp_path)
    (tmp_path / ".maps.tmp").mkdir()
    (tmp_path / ".ppa.12.tmp.ply").write_bytes(b"x")
    record = prepare_output(workspace, overwrite=False, resume=True)
    assert record.is_done("sfm")
    assert not list(tmp_path.glob(".*"))
    assert workspace.cloud(AngleModel.PPA).exists()


def test_resume_without_a_run_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match=r"no run of polmvs \(run.json is missing\)"):
        prepare_output(RunFolder(tmp_path), overwrite=False, resume=True)


def test_output_that_is_a_file_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    for root in (tmp_path / "out", tmp_path / "out" / "deeper"):
        with pytest.raises(DataError, match=r"OUT must be a folder|cannot be (made|used)"):
            prepare_output(RunFolder(root), overwrite=True, resume=False)


@pytest.mark.parametrize("place", ["", "raw"])
def test_output_may_not_be_the_capture(tmp_path: Path, place: str) -> None:
    with pytest.raises(OptionError, match="OUT is the capture's own folder"):
        require_apart(RunFolder(tmp_path / place), capture=tmp_path, others=())


def test_input_may_not_lie_where_results_go(tmp_path: Path) -> None:
    for name in ("images", "sparse/0", "maps"):
        with pytest.raises(OptionError, match="lies where OUT's results go"):
            require_apart(RunFolder(tmp_path), capture=tmp_path / name, others=())
        with pytest.raises(OptionError, match="lies where OUT's results go"):
            require_apart(RunFolder(tmp_path), capture=tmp_path / "c", others=[tmp_path / name])
    require_apart(RunFolder(tmp_path / "out"), capture=tmp_path, others=[tmp_path / "model"])
    require_apart(RunFolder(tmp_path), capture=tmp_path / "capture", others=())


def test_replacing_a_folder_is_whole_or_not_at_all(tmp_path: Path) -> None:
    workspace = RunFolder(tmp_path)
    with workspace.replacing(workspace.maps) as folder:
        (folder / "a.npy").write_bytes(b"1")
        assert not workspace.maps.exists()
    with suppress(KeyboardInterrupt), workspace.replacing(workspace.maps) as folder:
        (folder / "a.npy").write_bytes(b"2")
        raise KeyboardInterrupt
    assert (workspace.maps / "a.npy").read_bytes() == b"1"
    with workspace.replacing(workspace.maps) as folder:
        (folder / "b.npy").write_bytes(b"3")
    assert [path.name for path in tmp_path.rglob("*")] == ["maps", "b.npy"]


def test_names_of_the_files_of_a_stage(tmp_path: Path) -> None:
    workspace = RunFolder(tmp_path)
    names = {
        "capture": [],
        "normals": ["normals.ply"],
        "normals_opa": ["normals_opa.ply"],
        "densify_opa": ["opa.ply"],
        "evaluate": ["metrics.json", "summary.md"],
    }
    for stage, expected in names.items():
        assert [path.name for path in workspace.files_of(stage)] == expected


def test_machine_facts() -> None:
    assert set(versions()) >= {"polmvs", "python", "numpy", "open3d"}
    assert "unknown" not in versions().values()
    assert 20 < peak_rss_mb() < 100_000


def test_what_follows_a_stage_leaves_other_models_alone():
    assert followers("mesh_ppa") == ["mesh_ppa"]
    assert set(followers("densify_tilted")) == {
        "densify_tilted",
        "mesh_tilted",
        "dense_tilted",
        "evaluate",
    }
    assert {"densify_opa", "dense_ppa", "parts", "evaluate"} <= set(followers("normals"))
    assert {"sparse", "maps"} <= set(followers("sfm"))
