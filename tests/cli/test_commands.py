import json
import subprocess
import sys
from pathlib import Path

import pytest
from polmvs.cli.parsers import build_parser

import polmvs
from polmvs.cli.flags import GROUPS, options_from, run_options
from polmvs.config import (
    AngleModel,
    Contour,
    Options,
    RunOptions,
    describe_fields,
    from_plain,
    to_plain,
)
from polmvs.pipeline.jobs import COMPARED

COMMANDS = ("demo", "reconstruct", "compare", "evaluate", "sfm", "normals", "densify", "plane")


def parse(*arguments: str) -> Options:
    return options_from(build_parser().parse_args(arguments))


@pytest.mark.parametrize("command", COMMANDS)
def test_help_of_every_command(cli, command: str) -> None:
    status, out, err = cli(command, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"usage: polmvs {command}")


def test_help_lists_all_commands(cli) -> None:
    status, out, _ = cli("--help")
    assert status == 0
    for command in COMMANDS:
        assert f"\n    {command}" in out


def test_version(cli) -> None:
    assert cli("--version") == (0, f"polmvs {polmvs.__version__}\n", "")


def test_module_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "polmvs", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"polmvs {polmvs.__version__}\n"


def test_flags_are_unique_and_have_help() -> None:
    fields = [info for cls in (*GROUPS.values(), RunOptions) for info in describe_fields(cls)]
    names = [info.name for info in fields]
    assert len(names) == len(set(names))
    assert all(info.help_text for info in fields)


def test_defaults_are_those_of_the_options() -> None:
    assert parse("compare", "capture", "out") == Options()
    args = build_parser().parse_args(["compare", "capture", "out"])
    assert run_options(args) == RunOptions()
    assert tuple(args.models) == COMPARED
    assert COMPARED[:2] == (AngleModel.OPA, AngleModel.PPA)


def test_flags_of_every_kind() -> None:
    options = parse(
        *("reconstruct", "capture", "out", "--pattern", "0,45,135,90", "--gamma", "2.2"),
        *("--intrinsics", "400,401,200.5,150", "--no-single-camera", "--sparse", "model"),
        *("--contour", "normals", "--num-rounds", "2"),
    )
    assert options.capture.pattern == (0, 45, 135, 90)
    assert options.capture.gamma == 2.2
    assert options.sfm.intrinsics == (400.0, 401.0, 200.5, 150.0)
    assert options.sfm.single_camera is False
    assert options.sfm.sparse == Path("model").absolute()
    assert options.propagation.contour is Contour.NORMALS
    assert options.propagation.num_rounds == 2


def test_file_goes_before_record_and_flags_before_both(tmp_path: Path) -> None:
    config = tmp_path / "options.toml"
    config.write_text("[capture]\ngamma = 2\n[sfm]\nintrinsics = [400, 400.5, 200, 150]\n")
    args = build_parser().parse_args(
        ["sfm", "capture", "out", "--config", str(config), "--darkness", "0.01"]
    )
    recorded = {"capture": {"gamma": 3.0, "darkness": 0.02, "saturation": 0.9}}
    options = options_from(args, recorded)
    assert options.capture.gamma == 2.0
    assert options.capture.darkness == 0.01
    assert options.capture.saturation == 0.9
    assert options.sfm.intrinsics == (400.0, 400.5, 200.0, 150.0)


def test_options_survive_json() -> None:
    options = parse("compare", "c", "o", "--intrinsics", "4,5,6,7", "--mask", "m", "--gt", "g")
    plain = json.loads(json.dumps(to_plain(options)))
    again = {name: from_plain(cls, plain[name], name) for name, cls in GROUPS.items()}
    assert Options(**again) == options


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "the following arguments are required: COMMAND"),
        (("dance",), "invalid choice: 'dance'"),
        (("reconstruct",), "the following arguments are required: CAPTURE, OUT"),
        (("sfm", "c", "o", "--gama", "1"), "unrecognized arguments: --gama"),
        (("sfm", "c", "o", "--gamma", "high"), "--gamma: 'high' cannot be read as NUMBER"),
        (("sfm", "c", "o", "--gamma", "nan"), "--gamma: 'nan' cannot be read as NUMBER"),
        (("sfm", "c", "o", "--intrinsics", "400,x,1,1"), "cannot be read as NUMBER,..."),
        (("sfm", "c", "o", "--intrinsics", "1,inf,1,1"), "cannot be read as NUMBER,..."),
        (("reconstruct", "c", "o", "--model", "best"), "--model"),
        (("compare", "c", "o", "--models", "opa,best"), "--models"),
    ],
)
def test_usage_errors_are_one_line(cli, arguments: tuple[str, ...], message: str) -> None:
    status, out, err = cli(*arguments)
    assert (status, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1


@pytest.mark.parametrize(
    "flags",
    [
        ("--intrinsics", "400,400,200"),
        ("--intrinsics", "400,-400,200,150"),
        ("--pattern", "0,45,90,90"),
        ("--gamma", "0"),
        ("--min-dolp", "1.5"),
        ("--window-px", "4"),
        ("--step-px", "0"),
        ("--workers", "0"),
        ("--overwrite", "--resume"),
    ],
)
def test_values_out_of_range_are_one_line(cli, tmp_path: Path, flags: tuple[str, ...]) -> None:
    out = tmp_path / "out"
    status, text, err = cli("reconstruct", tmp_path, out, *flags)
    assert (status, text) == (2, "")
    assert err.startswith("polmvs reconstruct: error: --")
    assert err.count("\n") == 1
    assert not out.exists()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[capture]\ngama = 2\n", "unknown key 'gama'"),
        ("[captures]\ngamma = 2\n", "unknown table 'captures'"),
        ("gamma = 2\n", "unknown table 'gamma'"),
        ("[fusion]\nmin_views = 2\n", "unknown table 'fusion'"),  # not a stage of 'sfm'
        ("[capture]\ngamma = '2'\n", "gamma cannot be '2'"),
        ("[capture]\ngamma = true\n", "gamma cannot be True"),
        ("[capture]\ngamma = inf\n", "gamma cannot be inf"),
        ("[capture]\npattern = 90\n", "pattern cannot be 90"),
        ("[capture]\ngamma = 20\n", "--gamma must lie in"),
        ("[sfm]\nseed = 1.5\n", "seed cannot be 1.5"),
        ("[capture\n", "is no TOML file"),
    ],
)
def test_config_file_is_read_strictly(cli, tmp_path: Path, text: str, message: str) -> None:
    config = tmp_path / "options.toml"
    config.write_text(text)
    status, _, err = cli("sfm", tmp_path, tmp_path / "out", "--config", config)
    assert status == 1
    assert err.startswith(f"polmvs sfm: error: {config}: ")
    assert message in err
    assert err.count("\n") == 1


def test_missing_config_file(cli, tmp_path: Path) -> None:
    status, _, err = cli("sfm", tmp_path, tmp_path / "out", "--config", tmp_path / "none.toml")
    assert status == 1
    assert "none.toml: cannot be read" in err


def test_demo_prints_both_models_and_no_progress(demo_run: Path, cli) -> None:
    """The same lines as the finished run's, which goes on without anything left to do."""
    status, out, err = cli("demo", demo_run, "--resume")
    assert (status, err) == (0, "")
    lines = out.splitlines()
    names = [model.upper() for model in COMPARED]
    assert [cell.strip() for cell in lines[0].split("|")] == ["", "", *names, ""]
    assert any(line.startswith("| F-score at 1 mm, %") for line in lines)
    assert lines[-1].startswith(f"{demo_run}: opa.ply, ppa.ply, ")
    assert lines[-1].endswith("metrics.json, summary.md; 10 of 10 views")
    summary = (demo_run / "summary.md").read_text()
    assert "\n".join(lines[:-1]) in summary


def test_verbose_shows_every_stage(demo_run: Path, cli) -> None:
    status, _, err = cli("demo", demo_run, "--resume", "-v")
    assert status == 0
    assert "sfm: finished earlier\n" in err
    assert "sfm: begins" in (demo_run / "polmvs.log").read_text()


def test_evaluate_prints_a_table_or_json(demo_run: Path, demo_capture: Path, cli) -> None:
    arguments = ("evaluate", demo_run / "ppa.ply", "--gt", demo_capture)
    status, out, err = cli(*arguments, "--sparse", demo_run / "sparse", "--json")
    assert (status, err) == (0, "")
    figures = json.loads(out)
    expected = json.loads((demo_run / "metrics.json").read_text())["models"]["ppa"]["truth"]
    assert figures["cloud"] == expected["cloud"]
    assert figures["alignment"]["num_cameras"] == 10
    status, out, _ = cli(*arguments, "--sparse", demo_run / "sparse")
    assert status == 0
    assert f"{100 * figures['cloud']['f_score'][0]:.1f} |" in out
