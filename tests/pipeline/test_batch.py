"""Many captures: the list and its faults, one table, failures that stop no other."""

import json
import re
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import content_of, record_of, refused
from printed_images import INTRINSICS, write_printed_capture

from polmvs.config import AngleModel, Light, Options, PropagationOptions
from polmvs.errors import DataError, OptionError
from polmvs.pipeline.batch import BatchEntry, _row_of, read_batch

COARSE = ("--method", "integrate", "--stride-px", 8, "--no-mesh", "--no-colmap", "--workers", 2)


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
        ("l.toml", "[[captures]]\nname = 'a'\n", "capture 1: needs a 'capture'"),
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
        ("l.csv", "name\na\n", "line 2: needs a 'capture'"),
        ("l.csv", "capture\n", "lists no captures"),
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

    row = _row_of(entry, partial(lose, BrokenProcessPool()))
    assert (row.state, "out of memory" in row.message) == ("failed", True)
    row = _row_of(entry, partial(lose, DataError("tcp://a", "workers were lost.")))
    assert (row.state, row.message) == ("failed", "tcp://a: workers were lost.")
