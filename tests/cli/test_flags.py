"""Flags, help and usage errors."""

import json
import subprocess
import sys
from dataclasses import MISSING
from enum import StrEnum
from pathlib import Path

import pytest

import polmvs
from polmvs.cli.call import Call
from polmvs.cli.commands import ABOUT, COMMANDS, TO_CLOUD, TO_NORMALS, ComparedModels
from polmvs.cli.flags import UsageError, in_flags, parse
from polmvs.config import (
    Contour,
    Options,
    RunOptions,
    describe_fields,
    groups_of,
    option_paths,
)
from polmvs.polarization.kinds import COMPARED_MODELS, AngleModel

NAMES = tuple(command.name for command in COMMANDS)
HEAVY = ("numpy", "scipy", "cv2", "pycolmap", "open3d", "matplotlib", "msgspec", "multiprocessing")


def call(*arguments: object) -> Call:
    parsed = parse(COMMANDS, list(map(str, arguments)), "polmvs", ABOUT)
    assert parsed.call is not None
    return parsed.call


@pytest.fixture
def wide(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")


# Values


CHOICES = [
    (command, info, value)
    for command in COMMANDS
    for cls in command.groups
    for info in describe_fields(cls)
    if isinstance(info.kind, type) and issubclass(info.kind, StrEnum) and not info.positional
    for value in info.kind
]


@pytest.mark.parametrize(
    ("command", "info", "value"), {(i.path, v): (c, i, v) for c, i, v in CHOICES}.values()
)
def test_every_choice_is_written_as_the_help_names_it(command, info, value) -> None:
    needed = [
        next(iter(other.kind)) if issubclass(other.kind, StrEnum) else "x"
        for cls in command.groups
        for other in describe_fields(cls)
        if other.positional and other.default is MISSING and isinstance(other.kind, type)
    ]
    given = call(command.name, *needed, info.flag, str(value)).given
    assert given[info.path] is value


# Help


@pytest.mark.parametrize("command", NAMES)
def test_help_of_every_command(cli, command: str) -> None:
    status, out, err = cli(command, "--help")
    assert (status, err) == (0, "")
    assert out.startswith(f"Usage: polmvs {command} ")
    assert all(len(line) <= 80 for line in out.splitlines())


@pytest.mark.usefixtures("wide")
def test_help_lists_all_commands_in_order(cli) -> None:
    status, out, _ = cli("--help")
    assert status == 0
    lines = [line.strip("│ ") for line in out.splitlines()]
    rows = [line.split()[0] for line in lines if line.split()[:1] and line.split()[0] in NAMES]
    assert tuple(rows) == NAMES
    for command in COMMANDS:
        assert f"{command.name} " in out
        assert command.help_text in out


@pytest.mark.usefixtures("wide")
@pytest.mark.parametrize("command", COMMANDS, ids=NAMES)
def test_help_names_every_option_with_its_default(cli, command) -> None:
    _, out, _ = cli(command.name, "--help-all")
    for cls in (*command.groups, *command.earlier):
        for info in describe_fields(cls):
            if not info.positional:
                assert f" {info.flag} " in out
    assert "`" not in out
    if command.name == "compare":
        text = " ".join(out.replace("│", " ").split())
        assert "step of the contours, px [default: 0.5]" in text
        assert "--pattern INT,INT,INT,INT" in text
        assert "instead of --voxel-px; 0: none" in text
        assert "--scale A B DISTANCE" in text
        assert "--light specular|diffuse" in text


@pytest.mark.parametrize(
    ("command", "own", "earlier"),
    [
        ("normals", "--window-px", "--gamma"),
        ("densify", "--stride-px", "--min-dolp"),
        ("finish", "--in-place", "--stride-px"),
    ],
)
def test_help_of_a_stage_lists_its_own_options(cli, command: str, own: str, earlier: str) -> None:
    _, short, _ = cli(command, "--help")
    _, full, _ = cli(command, "--help-all")
    assert own in short
    assert earlier not in short
    assert "--help-all" in short
    assert full.index(own) < full.index(earlier)
    # What is not listed is understood all the same.
    assert call(command, "c", "o", earlier, 1).given["arguments.out"] == Path("o")


def test_version(cli) -> None:
    assert cli("--version") == (0, f"polmvs {polmvs.__version__}\n", "")


def test_module_is_the_command() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "polmvs", "--version"], capture_output=True, text=True, check=True
    )
    assert done.stdout == f"polmvs {polmvs.__version__}\n"


@pytest.mark.parametrize("arguments", [["--help"], ["reconstruct", "--help"], ["--version"], ["x"]])
def test_help_and_usage_errors_import_nothing_heavy(arguments: list[str]) -> None:
    """What makes ``--help`` quick, counted in modules, for time depends on the machine."""
    code = (
        "import json, sys\n"
        "from polmvs.cli import main\n"
        f"status = main({arguments!r})\n"
        "print(json.dumps(sorted(sys.modules)), file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    modules = set(json.loads(done.stderr.splitlines()[-1]))
    assert not modules & set(HEAVY)
    assert "cyclopts" in modules
    own = {name for name in modules if name.startswith("polmvs")}
    assert own <= {
        "polmvs",
        "polmvs._version",
        "polmvs.config",
        "polmvs.errors",
        "polmvs.cli",
        "polmvs.polarization",
        "polmvs.polarization.kinds",
        "polmvs.simulation",
        "polmvs.simulation.options",
        *(f"polmvs.cli.{name}" for name in ("call", "commands", "exit_status", "flags", "running")),
    }


# Values


def test_flags_are_unique_in_every_command_and_have_help() -> None:
    for command in COMMANDS:
        groups = (*command.groups, *command.earlier)
        fields = [info for cls in groups for info in describe_fields(cls)]
        flags = [info.flag for info in fields if not info.positional]
        assert len(flags) == len(set(flags))
        assert all(info.help_text for info in fields)


def test_paths_are_unique_and_their_groups_those_of_the_options() -> None:
    paths = option_paths(Options)
    assert len(paths) == len(set(paths))
    assert all(cls.group == name for name, cls in groups_of(Options).items())
    assert [cls.group for cls in TO_CLOUD[: len(TO_NORMALS)]] == [c.group for c in TO_NORMALS]


def test_defaults_are_those_of_the_options() -> None:
    given = call("compare", "capture", "out")
    assert given.options() == Options()
    assert given.get(RunOptions) == RunOptions()
    assert given.get(ComparedModels).models == COMPARED_MODELS
    assert COMPARED_MODELS[:2] == (AngleModel.TEXTBOOK_OPA, AngleModel.TEXTBOOK_PPA)


def test_flags_of_every_kind() -> None:
    options = call(
        *("reconstruct", "capture", "out", "--pattern", "0,45,135,90", "--gamma", "2.2"),
        *("--intrinsics", "400,401,200.5,150", "--no-single-camera", "--sparse", "model"),
        *("--contour", "normals", "--num-rounds", "2", "--scale", "a.png", "7", "0.25"),
        "--voxel=0.001",
    ).options()
    assert options.capture.pattern == (0, 45, 135, 90)
    assert options.capture.gamma == 2.2
    assert options.sfm.intrinsics == (400.0, 401.0, 200.5, 150.0)
    assert options.sfm.single_camera is False
    assert options.sfm.sparse == Path("model")
    assert options.propagation.contour is Contour.NORMALS
    assert options.propagation.num_rounds == 2
    assert options.reference.scale == ("a.png", "7", 0.25)
    assert options.fusion.voxel == 0.001


def test_flags_may_stand_before_arguments() -> None:
    given = call("sfm", "--overwrite", "--gamma", "2", "capture", "--workers", "3", "out")
    assert given.get(RunOptions) == RunOptions(overwrite=True, workers=3)
    assert given.options().capture.gamma == 2
    assert given.command_line == ["polmvs", "sfm", *("--overwrite", "--gamma", "2", "capture"),
                                  "--workers", "3", "out"]  # fmt: skip


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "a command is needed: demo, reconstruct"),
        (("dance",), 'unknown command "dance"'),
        (("reconstruct",), "CAPTURE is missing"),
        (("reconstruct", "c"), "OUT is missing"),
        (("reconstruct", "c", "o", "more"), "unexpected argument: more"),
        (("evaluate", "c.ply", "--gt", "g"), "error: --sparse is missing (see"),
        (("sfm", "c", "o", "--gama", "1"), "unknown option: --gama. Did you mean --gamma?"),
        (("sfm", "c", "o", "--stride-px", "1"), "unknown option: --stride-px"),
        (("sfm", "c", "o", "--gamma"), "--gamma needs a value"),
        (("evaluate", "c", "--gt", "x", "--sparse"), "error: --sparse needs a value (see"),
        (("sfm", "c", "o", "--workers", "1.9"), "--workers: '1.9' cannot be read as INT"),
        (("sfm", "c", "o", "--seed", "0x10"), "--seed: '0x10' cannot be read as INT"),
        (("normals", "c", "o", "--window-px", "17.6"), "--window-px: '17.6' cannot be read as INT"),
        (("densify", "c", "o", "--min-views", "-1.5"), "--min-views: '-1.5' cannot be read as INT"),
        (("densify", "c", "o", "--stride-px=2.5"), "--stride-px: '2.5' cannot be read as INT"),
        (("sfm", "c", "o", "--gamma", "high"), "--gamma: unable to convert"),
        (("sfm", "c", "o", "--gamma", "1", "--gamma", "1"), "--gamma specified multiple times"),
        (("sfm", "c", "o", "--gamma=1", "--gamma=2"), "--gamma specified multiple times"),
        (("sfm", "c", "o", "--resume", "--resume"), "--resume specified multiple times"),
        (("finish", "c", "o", "--mesh", "--no-mesh"), "--mesh and --no-mesh exclude each other"),
        (("finish", "c", "o", "--no-mesh", "--mesh"), "--no-mesh and --mesh exclude each other"),
        (("sfm", "c", "o", "--intrinsics", "1,1,1,1", "--intrinsics", "1,1,1,1"), "--intrinsics"),
        (("sfm", "c", "o", "--intrinsics", "400,x,1,1"), "cannot be read as NUMBER,..."),
        (("sfm", "c", "o", "--scale", "a", "b"), "--scale requires 3"),
        (("reconstruct", "c", "o", "--model", "best"), '"best" for --model'),
        (("compare", "c", "o", "--models", "opa,best"), "--models: 'opa,best' cannot be read"),
        (("experiment", "dance", "c", "o"), "NAME"),
    ],
)
def test_usage_errors_are_one_line(cli, arguments: tuple[str, ...], message: str) -> None:
    status, out, err = cli(*arguments)
    assert (status, out) == (2, "")
    assert message in err
    assert err.count("\n") == 1
    name = f"polmvs {arguments[0]}" if arguments and arguments[0] in NAMES else "polmvs"
    assert err.startswith(f"{name}: error: ")
    assert err.endswith(f"(see {name} --help)\n")


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--intrinsics", "400,400,200"), "--intrinsics needs four positive numbers fx,fy,cx,cy"),
        (("--intrinsics", "400,-400,200,150"), "--intrinsics needs four"),
        (("--intrinsics", "-1,1,2,3"), "--intrinsics needs four positive numbers fx,fy,cx,cy"),
        (("--intrinsics", "1,inf,1,1"), "--intrinsics must be a finite number, not 1,inf,1,1."),
        (("--pattern", "0,45,90,90"), "--pattern needs each of 0, 45, 90, 135 once"),
        (("--gamma", "0"), "--gamma must lie in 0.1 to 10, not 0."),
        (("--gamma", "nan"), "--gamma must lie in 0.1 to 10, not nan."),
        (("--min-dolp", "1.5"), "--min-dolp must lie in 0 to 1, ends excluded, not 1.5."),
        (("--window-px", "4"), "--window-px must be odd, not 4."),
        (("--step-px", "0"), "--step-px must lie in 0.05 to 4, not 0."),
        (("--spacing-px", "0.1"), "--spacing-px must be as long as --step-px or longer, not 0.1."),
        (("--min-views", "0"), "--min-views must be 1 or more, not 0."),
        (("--voxel", "-1"), "--voxel must be 0 or more, not -1."),
        (("--aruco", "DICT_4X4_50"), "--aruco needs DICT:SIZE"),
        (("--scale", "a", "a", "1"), "--scale needs two different ends, not a twice."),
        (("--workers", "0"), "--workers must be 1 or more, not 0."),
        (("--overwrite", "--resume"), "--overwrite and --resume exclude each other."),
        (("--verbose", "--quiet"), "--verbose and --quiet exclude each other."),
    ],
)
def test_values_out_of_range_are_one_line(
    cli, tmp_path: Path, flags: tuple[str, ...], message: str
) -> None:
    out = tmp_path / "out"
    status, text, err = cli("reconstruct", tmp_path, out, *flags)
    assert (status, text) == (2, "")
    assert err.startswith(f"polmvs reconstruct: error: {message}")
    assert err.count("\n") == 1
    assert not out.exists()


def test_a_loaded_pydantic_changes_nothing() -> None:
    pytest.importorskip("pydantic")
    code = (
        "import pydantic, sys\n"
        "from polmvs.cli import main\n"
        "sys.exit(main(['plane', 'none.png', '--intrinsics', '1,1,1,1', '--gamma', '1']))"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert done.stderr == "polmvs plane: error: none.png: no such file.\n"


def test_usage_error_names_program_and_command() -> None:
    with pytest.raises(UsageError) as caught:
        call("sfm", "c", "o", "--gama", "1")
    assert caught.value.prog == "polmvs sfm"


def test_messages_name_flags_where_the_library_names_options() -> None:
    text = "Give `run.overwrite` or `fusion.workspace`; not `a.b` nor `plane.model`."
    assert in_flags(text) == "Give --overwrite or --workspace; not a.b nor --model."
