"""Names of files may hold what a terminal acts on: it is written out wherever people read it."""

import logging
import re
import shutil
from pathlib import Path

import pytest

from polmvs.errors import DataError, OptionError, printable
from polmvs.evaluation.tables import format_table
from polmvs.pipeline.log_format import LogFormatter

ODD = "\x1b]0;owned\x07\x1b[31m\x9b2J\u202egnp\nERROR: forged"
RAW = re.compile("[\x00-\x09\x0b-\x1f\x7f-\x9f\u202a-\u202e\u2066-\u2069]")


def test_what_is_written_out_and_what_is_not() -> None:
    assert printable("a\x1b[31mb\nc\x9b\u202ed\x7f") == r"a\x1b[31mb\nc\x9b\u202ed\x7f"
    assert printable("größe 日本 a\u200db c:\\d", keep="\n") == "größe 日本 a\u200db c:\\d"
    assert printable("a\nb\tc", keep="\n") == "a\nb\\tc"
    assert printable("\udcff") == r"\udcff"


@pytest.mark.parametrize(
    "arguments",
    [
        ("inspect", "{}/none"),
        ("sfm", "{}/none", "out"),
        ("reconstruct", "{}/capture", "{}/out", "--sparse", "{}/none"),
        ("densify", "{}/capture", "{}/out"),
        ("mesh", "{}/none.ply", "{}/mesh.ply"),
        ("evaluate", "{}/none.ply", "--gt", "{}", "--sparse", "{}"),
        ("batch", "{}/none.csv", "{}/out"),
        ("reconstruct", "--" + ODD),
        (ODD,),
    ],
)
def test_errors_are_one_plain_line(cli, tmp_path: Path, arguments) -> None:
    folder = tmp_path / ODD
    (folder / "capture").mkdir(parents=True)
    status, out, err = cli(*(argument.replace("{}", str(folder)) for argument in arguments))
    assert status in (1, 2)
    assert out == ""
    assert err.count("\n") == 1
    assert RAW.search(err) is None
    assert "x1b" in err


def test_inspect_has_a_line_for_each_view(cli, demo_capture: Path, tmp_path: Path) -> None:
    folder = tmp_path / ("capture" + ODD)
    folder.mkdir()
    source = next((demo_capture / "raw").iterdir())
    shutil.copy(source, folder / "plain.png")
    status, plain, _ = cli("inspect", folder)
    shutil.copy(source, folder / f"b{ODD}.png")
    status, out, err = cli("inspect", folder, "--sheet", tmp_path / f"{ODD}.png")
    assert status == 0, err
    assert RAW.search(out + err) is None
    assert out.count("\n") == plain.count("\n") + 2  # the second view, and the sheet
    assert (tmp_path / f"{ODD}.png").is_file()
    status, out, _ = cli("inspect", folder, "--json")
    assert RAW.search(out) is None


def test_errors_of_the_library() -> None:
    assert str(DataError(Path("a\x1b\nb"), "quotes \x1b\nof a file")) == (
        "a\\x1b\\nb: quotes \\x1b\nof a file"
    )
    assert str(OptionError("a\x1b\nb", field="run.out")) == r"`run.out` a\x1b\nb"


def test_lines_of_a_log_cannot_be_forged() -> None:
    record = logging.LogRecord("polmvs", logging.INFO, "", 1, "view %s", (ODD,), None)
    lines = LogFormatter().format(record).split("\n")
    assert RAW.search("".join(lines)) is None
    assert lines[1] == "    ERROR: forged"


def test_rows_of_tables_stay_rows() -> None:
    text = format_table(["view", "n"], [[ODD, "1"], ["b", "2"]])
    lines = text.split("\n")
    assert len(lines) == 4
    assert len({len(line) for line in lines}) == 1
    assert RAW.search(text) is None
