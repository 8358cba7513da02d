"""Many captures: the list and its faults, one table, failures that stop no other."""

import json
import re
from enum import StrEnum
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import content_of, record_of, refused
from printed_images import INTRINSICS, write_printed_capture

from polmvs.config import (
    FieldInfo,
    Options,
    PropagationOptions,
    RunOptions,
    describe_fields,
    get_option,
    groups_of,
    option_paths,
    to_plain,
)
from polmvs.errors import DataError, OptionError
from polmvs.pipeline.batch import BatchEntry, read_batch, row_of, run_batch
from polmvs.polarization.kinds import AngleModel, Light

COARSE = ("--method", "contour", "--stride-px", 8, "--no-mesh", "--no-colmap", "--workers", 2)


@pytest.fixture(scope="module")
def captures(tmp_path_factory) -> Path:
    """A folder with a sound capture and one in which SfM finds nothing, and a list of both."""
    folder = tmp_path_factory.mktemp("captures")
    (folder / "good").mkdir()
    write_printed_capture(folder / "good", 6)
    (folder / "bad").mkdir()
    for index in range(4):
        flat = np.full((100, 120), 90 + index, np.uint8)
        assert cv2.imwrite(str(folder / "bad" / f"{index}.png"), flat)
    given = ",".join(map(str, INTRINSICS))
    (folder / "list.csv").write_text(
        f'capture,name,model,sfm.intrinsics\nbad,,,\ngood,first,opa,"{given}"\n'
    )
    return folder


@pytest.mark.slow
def test_batch(cli, captures, tmp_path) -> None:
    """The sound capture is reconstructed beside the faulty one; going on repeats nothing."""
    out = tmp_path / "out"
    status, text, err = cli("batch", captures / "list.csv", out, *COARSE)
    assert status == 1, err
    assert (out / "first" / "opa.ply").is_file()
    assert "reconstruct" not in (out / "first" / "polmvs.log").read_text()
    assert "poses: begins" in (out / "first" / "polmvs.log").read_text()
    bad, first = json.loads((out / "batch.json").read_text())
    assert (bad["name"], bad["state"], first["name"]) == ("bad", "failed", "first")
    assert "finds no model" in bad["message"]
    assert first["state"] in ("finished", "empty")
    assert (first["num_images"], first["num_views"]) == (6, 6)
    assert first["seconds"] == record_of(out / "first")["wall_s"]
    table = (out / "batch.md").read_text()
    assert "| first   | " in text
    assert "1 finished, 1 failed" in text or "1 empty, 1 failed" in text
    assert len(table.splitlines()) == 4

    refused(cli("batch", captures / "list.csv", out, *COARSE), 2)
    cloud = (out / "first" / "opa.ply").read_bytes()
    stages = record_of(out / "first")["stages"]
    status, _, _ = cli("batch", captures / "list.csv", out, *COARSE, "--resume")
    assert status == 1
    assert (out / "first" / "opa.ply").read_bytes() == cloud
    assert record_of(out / "first")["stages"] == stages


def test_faulty_lists_write_nothing(cli, captures, tmp_path) -> None:
    path = captures / "missing.toml"
    path.write_text('[[captures]]\ncapture = "good"\n[[captures]]\ncapture = "gone"\n')
    before = content_of(captures)
    line = refused(cli("batch", path, tmp_path / "out"))
    assert re.search(r"gone: no such folder; .*missing\.toml lists it as 'gone'", line)
    assert not (tmp_path / "out").exists()
    assert content_of(captures) == before


def test_a_second_list_leaves_the_first_one_s_rows(captures, tmp_path) -> None:
    out = tmp_path / "out"
    options = Options()
    first, second = (
        BatchEntry(name=name, capture=captures / "bad", angle_model=AngleModel.PPA, options=options)
        for name in ("one", "two")
    )
    run_batch([first], out, RunOptions(workers=1))
    rows = run_batch([second], out, RunOptions(workers=1))
    assert [row.name for row in rows] == ["two"]
    assert [row["name"] for row in json.loads((out / "batch.json").read_text())] == ["one", "two"]
    assert "| one " in (out / "batch.md").read_text()
    run_batch([first], out, RunOptions(workers=1, overwrite=True))  # its row is not there twice
    assert [row["name"] for row in json.loads((out / "batch.json").read_text())] == ["two", "one"]
    (out / "batch.json").write_text("[1]")
    with pytest.raises(DataError, match=r"batch\.json: is no table of a batch"):
        run_batch([second], out, RunOptions(workers=1, overwrite=True))
    assert (out / "batch.json").read_text() == "[1]"


# A value of each option that is not its default, as a cell of a CSV file has it, and as it is.
OTHERS = {
    "capture.pattern": ("0,45,135,90", (0, 45, 135, 90)),
    "capture.naming": ("{view}.tif", "{view}.tif"),
    "capture.angles": ("0,60,120", (0, 60, 120)),
    "sfm.intrinsics": ("4,5,6,7", (4, 5, 6, 7)),
    "sfm.camera_model": ("OPENCV", "OPENCV"),
    "sfm.without": ("a.png,b.png", ("a.png", "b.png")),
    "sfm.pairs": ("sequential", "sequential"),
    "reference.aruco": ("DICT_4X4_50:0.05", "DICT_4X4_50:0.05"),
    "reference.scale": ("a,b,2", ("a", "b", 2)),
    "normals.window_px": ("19", 19),
    "crop.box": ("0,0,0,1,2,3", (0.0, 0.0, 0.0, 1.0, 2.0, 3.0)),
    "propagation.bending": ("0.05", 0.05),
}


def other_value(info: FieldInfo) -> tuple[str, object]:
    if info.path in OTHERS:
        return OTHERS[info.path]
    if info.kind is bool:
        return ("no" if info.default else "yes"), not info.default
    if issubclass(info.kind, StrEnum):
        last = list(info.kind)[-1]
        return last.value, last
    if info.kind is Path:
        return "x", Path("x")
    low = info.range.least if info.range.above is None else info.range.above
    value = info.kind((info.default or low or 0) + 1)
    if value not in info.range:
        value = 0.5 * (info.default + (info.range.most or info.range.below))
    return (str(value) if info.kind is int else f"{value:g}"), value


# A marker without a box is refused, and so are weights of features without those of their matcher.
ONLY_TOGETHER = {"crop.box_marker", "sfm.aliked", "sfm.lightglue"}


@pytest.mark.parametrize("path", sorted({*option_paths()} - ONLY_TOGETHER))
def test_every_option_can_be_one_capture_s(tmp_path, path: str) -> None:
    group, name = path.split(".")
    info = next(i for i in describe_fields(groups_of(Options)[group]) if i.name == name)
    cell, value = other_value(info)
    sheet = write(tmp_path, "list.csv", f'folder,name,{path}\na,first,"{cell}"\nb,,\n')
    toml = write(
        tmp_path,
        "list.toml",
        f"[[captures]]\nfolder = 'a'\nname = 'first'\n[captures.{group}]\n"
        f"{name} = {json.dumps(to_plain(value) if info.kind is not Path else 'x')}\n"
        "[[captures]]\nfolder = 'b'\n",
    )
    first, second = read_batch(sheet, Options())
    assert get_option(second.options, path) == info.default
    expected = tmp_path / value if isinstance(value, Path) else value
    assert get_option(first.options, path) == expected
    assert read_batch(toml, Options())[0] == first


def test_the_folder_s_older_name(tmp_path) -> None:
    path = write(tmp_path, "l.csv", "capture,capture.gamma\na,0.5\n")
    assert read_batch(path, Options())[0].options.capture.gamma == 0.5
    path = write(
        tmp_path, "l.toml", "[[captures]]\ncapture = 'a'\n[captures.capture]\ngamma = 0.5\n"
    )
    with pytest.raises(DataError, match="Name the folder of a capture 'folder'"):
        read_batch(path, Options())


def write(folder: Path, name: str, text: str) -> Path:
    for capture in ("a", "b"):
        (folder / capture).mkdir(exist_ok=True)
    (folder / name).write_text(text)
    return folder / name


def test_toml_and_csv_say_the_same(tmp_path) -> None:
    toml = write(
        tmp_path,
        "list.toml",
        '[[captures]]\ncapture = "a"\n'
        '[[captures]]\ncapture = "b"\nname = "second"\nmodel = "tilted"\n'
        "[captures.sfm]\nintrinsics = [400, 401.5, 300, 250]\nsingle_camera = false\n"
        'pairs = "pairs.txt"\n'
        '[captures.region]\nlight = "diffuse"\nmask = "masks"\n',
    )
    sheet = write(
        tmp_path,
        "list.csv",
        "capture,name,model,sfm.intrinsics,sfm.single_camera,sfm.pairs,region.light,region.mask\n"
        "a,,,,,,,\n"
        'b,second,tilted,"400, 401.5, 300, 250",no,pairs.txt,diffuse,masks\n',
    )
    defaults = Options(propagation=PropagationOptions(stride_px=3))
    first, second = read_batch(toml, defaults)
    assert read_batch(sheet, defaults) == (first, second)
    assert (first.name, first.capture, first.angle_model) == ("a", tmp_path / "a", AngleModel.PPA)
    assert first.options == defaults
    assert (second.name, second.angle_model) == ("second", AngleModel.TILTED)
    assert second.options.sfm.intrinsics == (400, 401.5, 300, 250)
    assert second.options.sfm.pairs_file == tmp_path / "pairs.txt"
    assert second.options.region.light is Light.DIFFUSE
    assert second.options.region.mask == tmp_path / "masks"
    assert second.options.propagation.stride_px == 3


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("l.toml", "captures = 3", "'captures' is none of its tables"),
        ("l.toml", "[[runs]]\n", "'runs' is none of its tables"),
        ("l.toml", "[[captures]\n", "is no TOML file"),
        ("l.toml", "", "lists no captures"),
        ("l.toml", "[[captures]]\nname = 'a'\n", "capture 1: needs a 'folder'"),
        ("l.toml", "[[captures]]\ncapture = 'a'\nname = '../a'\n", "capture 1: the name '../a'"),
        ("l.toml", "[[captures]]\ncapture = 'a'\nmodel = 'x'\n", "model must be one of opa, ppa"),
        ("l.toml", "[[captures]]\ncapture = 'a'\nsfm.seeds = 1\n", r"capture 1: \[sfm\].*'seed'"),
        ("l.toml", "[[captures]]\ncapture = 'a'\nsfn.seed = 1\n", "unknown table 'sfn'"),
        ("l.toml", 2 * "[[captures]]\ncapture = 'a'\n", "two captures are named 'a'"),
        ("l.toml", "[[captures]]\ncapture = 'a'\nregion.min_dolp = 2\n", r"\[region\] min_dolp"),
        ("l.csv", "capture,sfm.seeds\na,1\n", "unknown column 'sfm.seeds'"),
        ("l.csv", "capture,sfm.seed\na,one\n", "line 2: sfm.seed cannot be 'one'"),
        ("l.csv", "capture,sfm.single_camera\na,maybe\n", "cannot be 'maybe'"),
        ("l.csv", "capture\na,b\n", "line 2: has more cells"),
        ("l.csv", "name\na\n", "line 2: needs a 'folder'"),
        ("l.csv", "capture\n", "lists no captures"),
        ("l.csv", "capture,folder\na,a\n", "names its folder twice"),
        ("l.csv", "folder,name\na,batch.md\n", "cannot be named 'batch.md'"),
        ("l.csv", "folder,name\na,Batch.JSON\n", "cannot be named 'Batch.JSON'"),
        ("l.txt", "a\n", "must end in .toml or .csv"),
    ],
)
def test_faulty_lists(tmp_path, name, text, message) -> None:
    path = write(tmp_path, name, text)
    with pytest.raises((DataError, OptionError), match=re.escape(str(path)) + ".*" + message):
        read_batch(path, Options())


def test_a_lost_worker_is_one_row() -> None:
    from concurrent.futures.process import BrokenProcessPool

    entry = BatchEntry(name="a", capture=Path("a"), angle_model=AngleModel.PPA, options=Options())

    def lose(error):
        raise error

    row = row_of(entry, partial(lose, BrokenProcessPool()))
    assert (row.state, "out of memory" in row.message) == ("failed", True)
    row = row_of(entry, partial(lose, DataError("tcp://a", "workers were lost.")))
    assert (row.state, row.message) == ("failed", "tcp://a: workers were lost.")
