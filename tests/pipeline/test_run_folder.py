import json
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from polmvs.errors import DataError, OptionError
from polmvs.io.typed_json import write_json
from polmvs.pipeline import checks
from polmvs.pipeline.record import (
    SCHEMA_VERSION,
    Record,
    StageRecord,
    read_options,
    versions,
    write_record,
)
from polmvs.pipeline.run_folder import (
    SURFACE_MESH,
    RunFolder,
    discard,
    has_content,
    replacing,
)
from polmvs.pipeline.run_lock import locked
from polmvs.pipeline.runner import load_record, prepare_output
from polmvs.pipeline.stage_table import written_names
from polmvs.pipeline.stages.images import ImagesResult
from polmvs.polarization.kinds import AngleModel


def finished_run(root: Path) -> RunFolder:
    """An output folder with one file of each kind."""
    run_folder = RunFolder(root)
    for folder, name in (
        ("images", "a.png"),
        ("sparse", "cameras.bin"),
        ("maps", "a.png.region.npy"),
        ("silhouettes", "a.png.inner.npy"),
    ):
        (root / folder).mkdir(parents=True)
        (root / folder / name).write_bytes(b"x")
    for model in AngleModel:
        run_folder.cloud(model).write_bytes(b"x")
        run_folder.views(model).mkdir()
        for name in ("a.png.range.npy", SURFACE_MESH):
            (run_folder.views(model) / name).write_bytes(b"x")
        run_folder.sparse_cloud(model).write_bytes(b"x")
    run_folder.metrics.write_text("{}")
    stage = StageRecord(
        name="images",
        options={"capture.gamma": 1.0},
        seconds=1.0,
        cpu_s=1.5,
        peak_rss_mb=2.0,
        result=ImagesResult(num_images=1),
    )
    write_record(run_folder, Record(images=("a.png",), stages=(stage,), options={"sfm": {}}))
    return run_folder


def require_apart(run_folder: RunFolder, *, capture: Path, others: Sequence[Path]) -> None:
    checks.require_apart(run_folder, capture=capture, others=others, written=written_names())


def test_record_survives_writing_and_reading(tmp_path: Path) -> None:
    run_folder = finished_run(tmp_path)
    record = load_record(run_folder)
    assert record.images == ("a.png",)
    assert record.stage("maps") is None
    assert record.result(ImagesResult) == ImagesResult(num_images=1)
    write_record(run_folder, record)
    assert load_record(run_folder) == record
    assert read_options(run_folder) == {"sfm": {}}
    record.forget(["images"])
    assert record.stages == ()
    assert record.find(ImagesResult) is None
    with pytest.raises(KeyError, match="no stage with a ImagesResult"):
        record.result(ImagesResult)


@pytest.mark.parametrize(
    "text",
    [
        "",
        "[]",
        "{}",
        '{"stages": 3}',
        f'{{"schema_version": {SCHEMA_VERSION}, "stages": []}}',
        "\0",
    ],
)
def test_damaged_record_is_one_clear_error(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_text(text)
    with pytest.raises(DataError, match=r"run\.json: is no record of a run"):
        load_record(RunFolder(tmp_path))


def test_run_of_the_version_before_is_refused_by_name_and_version(tmp_path: Path) -> None:
    """Not misread: its stages have other names, and its seeds lie elsewhere."""
    run_folder = finished_run(tmp_path)
    stage = {"name": "sfm", "seconds": 1.0, "peak_rss_mb": 2.0}
    content = {
        "capture": {"folder": "c", "width": 4, "height": 4, "bytes": {}},
        "images": ["a.png"],
        "stages": [stage],
        "stage_options": {"sfm": {}},
        "results": {"num_views": 3},
        "versions": {"polmvs": "0.1.0"},
    }
    run_folder.run_file.write_text(json.dumps(content))
    message = (
        rf"{tmp_path}: holds a run of polmvs 0\.1\.0, whose run\.json has schema version 1; this "
        r"is polmvs .*, which reads version \d+ .*Give another OUT, or begin anew there: .*with "
        r"`run\.overwrite` delete that run"
    )
    with pytest.raises(DataError, match=message):
        prepare_output(run_folder, overwrite=False, resume=True)
    with pytest.raises(DataError, match=message):
        read_options(run_folder)
    content["schema_version"] = SCHEMA_VERSION + 1
    run_folder.run_file.write_text(json.dumps(content))
    with pytest.raises(DataError, match=f"has schema version {SCHEMA_VERSION + 1}"):
        load_record(run_folder)
    assert prepare_output(run_folder, overwrite=True, resume=False) == Record()
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda r: r["stages"][0].update(name="soup"), "stage 'soup' is unknown"),
        (lambda r: r["stages"][0].update(seconds="1"), r"stages\[0\]\.seconds cannot be '1'"),
        (lambda r: r["stages"][0].pop("reads"), r"stages\[0\] lacks 'reads'"),
        (lambda r: r["stages"][0].update(angle_model="best"), "'best' is not a valid AngleModel"),
        (
            lambda r: r["stages"][0]["result"].update(num_images=1.5),
            r"images\.result\.num_images cannot be '1\.5'",
        ),
        (lambda r: r.update(colour="red"), "unknown key 'colour'"),
    ],
)
def test_record_is_read_strictly(tmp_path: Path, change, message: str) -> None:
    run_folder = finished_run(tmp_path)
    content = json.loads(run_folder.run_file.read_text())
    change(content)
    run_folder.run_file.write_text(json.dumps(content))
    with pytest.raises(DataError, match=rf"run\.json: is no record of a run \(.*{message}"):
        load_record(run_folder)


def test_json_has_null_for_what_is_no_number(tmp_path: Path) -> None:
    write_json(
        tmp_path / "a.json",
        {"a": np.float32("nan"), "b": [float("inf"), np.int64(3)], "model": AngleModel.PPA},
    )
    content = json.loads((tmp_path / "a.json").read_text())
    assert content == {"a": None, "b": [None, 3], "model": "ppa"}


def test_new_and_empty_folders_are_taken(tmp_path: Path) -> None:
    for root in (tmp_path / "new" / "deep", tmp_path / "empty"):
        run_folder = RunFolder(root)
        assert not has_content(root)
        assert prepare_output(run_folder, overwrite=False, resume=False) == Record()


def test_occupied_folder_is_refused(tmp_path: Path) -> None:
    run_folder = finished_run(tmp_path)
    with pytest.raises(OptionError, match=r"`run\.overwrite` .*`run\.resume`"):
        prepare_output(run_folder, overwrite=False, resume=False)
    assert run_folder.cloud(AngleModel.PPA).exists()


def test_overwrite_deletes_results_only(tmp_path: Path) -> None:
    run_folder = finished_run(tmp_path)
    (tmp_path / "notes.txt").write_text("mine")
    (tmp_path / "photos").mkdir()
    assert prepare_output(run_folder, overwrite=True, resume=False) == Record()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes.txt", "photos"]


@pytest.mark.parametrize(
    "foreign",
    [
        *("images/mine.png", "sparse/notes.txt", "maps/sub/a.npy"),
        *("maps/mine.npy", "maps/mine.png.region.npy", "views_ppa/mine.png.range.npy"),
        *("sparse/mine.bin", "tracks/mine.npy"),
    ],
)
def test_overwrite_deletes_nothing_where_foreign_files_lie(tmp_path: Path, foreign: str) -> None:
    run_folder = finished_run(tmp_path)
    path = tmp_path / foreign
    path.parent.mkdir(exist_ok=True)
    path.write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(DataError, match="was not written by polmvs"):
        prepare_output(run_folder, overwrite=True, resume=False)
    assert sorted(tmp_path.rglob("*")) == before


def test_overwrite_needs_the_record_of_a_run(tmp_path: Path) -> None:
    """Another program's project may well have a folder ``images``."""
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "photo.png").write_bytes(b"x")
    with pytest.raises(DataError, match=r"images: was not written by polmvs"):
        prepare_output(RunFolder(tmp_path), overwrite=True, resume=False)
    assert (tmp_path / "images" / "photo.png").exists()


def test_linked_folder_is_not_emptied(tmp_path: Path) -> None:
    run_folder = finished_run(tmp_path / "out")
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "points3D.bin").write_bytes(b"x")
    (run_folder.sparse / "cameras.bin").unlink()
    run_folder.sparse.rmdir()
    run_folder.sparse.symlink_to(tmp_path / "elsewhere")
    for overwrite in (True, False):
        with pytest.raises(DataError, match=r"out/sparse: is a link and was not written by polmvs"):
            prepare_output(run_folder, overwrite=overwrite, resume=not overwrite)
    assert (tmp_path / "elsewhere" / "points3D.bin").exists()


def test_resume_keeps_results(tmp_path: Path) -> None:
    run_folder = finished_run(tmp_path)
    record = prepare_output(run_folder, overwrite=False, resume=True)
    assert record.stage("images") is not None
    assert run_folder.cloud(AngleModel.PPA).exists()


def test_resume_without_a_run_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("mine")
    with pytest.raises(DataError, match=r"no run of polmvs \(run.json is missing\)"):
        prepare_output(RunFolder(tmp_path), overwrite=False, resume=True)


def test_output_that_is_a_file_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "out").write_text("mine")
    with pytest.raises(DataError, match="OUT must be a folder"):
        prepare_output(RunFolder(tmp_path / "out"), overwrite=True, resume=False)
    for root in (tmp_path / "out", tmp_path / "out" / "deeper"):
        with pytest.raises(DataError, match="cannot be made"), locked(root):
            pass


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
    # By a link, too.
    (tmp_path / "images").mkdir()
    (tmp_path / "images" / "a.png").write_bytes(b"x")
    (tmp_path / "c").mkdir()
    (tmp_path / "c" / "a.png").symlink_to(tmp_path / "images" / "a.png")
    with pytest.raises(OptionError, match="lies where OUT's results go"):
        require_apart(RunFolder(tmp_path), capture=tmp_path / "c", others=())
    require_apart(RunFolder(tmp_path / "out"), capture=tmp_path, others=[tmp_path / "model"])
    require_apart(RunFolder(tmp_path), capture=tmp_path / "capture", others=())


def test_replacing_a_folder_is_whole_or_not_at_all(tmp_path: Path) -> None:
    maps = tmp_path / "maps"
    with replacing(maps) as folder:
        (folder / "a.npy").write_bytes(b"1")
        assert not maps.exists()
    with suppress(KeyboardInterrupt), replacing(maps) as folder:
        (folder / "a.npy").write_bytes(b"2")
        raise KeyboardInterrupt
    assert (maps / "a.npy").read_bytes() == b"1"
    with replacing(maps) as folder:
        (folder / "a.npy").write_bytes(b"3")
    assert [path.name for path in tmp_path.rglob("*")] == ["maps", "a.npy"]
    (maps / "mine.npy").write_bytes(b"4")
    with pytest.raises(DataError, match=r"mine\.npy: was not written"), replacing(maps) as folder:
        (folder / "a.npy").write_bytes(b"5")
    assert (maps / "a.npy").read_bytes() == b"3"


def test_nothing_is_discarded_where_a_foreign_file_lies(tmp_path: Path) -> None:
    run_folder = finished_run(tmp_path)
    paths = [run_folder.metrics, run_folder.maps(AngleModel.PPA), tmp_path / "nothing"]
    (tmp_path / "maps" / "mine.txt").write_text("mine")
    with pytest.raises(DataError, match=r"mine\.txt: was not written by polmvs"):
        discard(paths)
    assert run_folder.metrics.exists()
    (tmp_path / "maps" / "mine.txt").unlink()
    discard(paths, {"a.png"})
    assert not any(path.exists() for path in paths)


def test_machine_facts() -> None:
    assert set(versions()) >= {"polmvs", "python", "numpy", "open3d"}
    assert "unknown" not in versions().values()
