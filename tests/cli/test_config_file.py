"""``--config FILE.toml``: what goes before what, and that a slip is named in one line."""

from pathlib import Path

import pytest

from polmvs.cli.commands import ABOUT, COMMANDS
from polmvs.cli.flags import parse
from polmvs.config import Options


def options(recorded: dict | None, *arguments: object) -> Options:
    parsed = parse(COMMANDS, list(map(str, arguments)), "polmvs", ABOUT)
    assert parsed.call is not None
    return parsed.call.options(recorded)


@pytest.fixture
def config(tmp_path: Path):
    def write(text: str) -> Path:
        path = tmp_path / "options.toml"
        path.write_text(text)
        return path

    return write


def test_file_goes_before_record_and_flags_before_both(config) -> None:
    path = config("[capture]\ngamma = 2\n[sfm]\nintrinsics = [400, 400.5, 200, 150]\n")
    recorded = {"capture": {"gamma": 3.0, "darkness": 0.02, "saturation": 0.9}}
    found = options(recorded, "sfm", "capture", "out", "--config", path, "--darkness", "0.01")
    assert found.capture.gamma == 2.0
    assert found.capture.darkness == 0.01
    assert found.capture.saturation == 0.9
    assert found.sfm.intrinsics == (400.0, 400.5, 200.0, 150.0)


def test_values_of_every_kind(config) -> None:
    path = config(
        "[capture]\npattern = [0, 45, 135, 90]\n[sfm]\nsparse = 'model'\nsingle_camera = false\n"
        "[propagation]\nmethod = 'contour'\nnum_rounds = 2\n"
        "[reference]\nscale = ['a.png', '7', 1]\n"
    )
    found = options(None, "reconstruct", "c", "o", "--config", path)
    flags = ("--pattern", "0,45,135,90", "--sparse", "model", "--no-single-camera")
    flags += ("--method", "contour", "--num-rounds", "2", "--scale", "a.png", "7", "1")
    assert found == options(None, "reconstruct", "c", "o", *flags)


def test_values_that_fit_only_together(config) -> None:
    path = config("[propagation]\nspacing_px = 0.3\n")  # shorter than the default of the step
    found = options(None, "densify", "c", "o", "--config", path, "--step-px", "0.2")
    assert (found.propagation.spacing_px, found.propagation.step_px) == (0.3, 0.2)


def test_earlier_stages_may_be_in_the_file_of_a_stage(config) -> None:
    path = config("[capture]\ngamma = 2\n")
    assert options(None, "finish", "c", "o", "--config", path).capture.gamma == 2


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("[capture]\ngama = 2\n", "[capture] has an unknown key 'gama'; did you mean 'gamma'?"),
        ("[captures]\ngamma = 2\n", "unknown table 'captures'; did you mean 'capture'?"),
        ("gamma = 2\n", "a key outside the tables, 'gamma'"),
        ("capture = 2\n", "'capture' must be a table, [capture]"),
        ("[fusion]\nmin_views = 2\n", "unknown table 'fusion'"),  # not a stage of 'sfm'
        ("[run]\noverwrite = true\n", "unknown table 'run'"),
        ("[capture]\ngamma = '2'\n", "[capture] gamma cannot be '2': Expected float, got str."),
        ("[capture]\ngamma = true\n", "[capture] gamma cannot be True: Expected float, got bool."),
        ("[capture]\ngamma = inf\n", "[capture] gamma must lie in 0.1 to 10, not inf."),
        ("[capture]\npattern = 90\n", "pattern cannot be 90: Expected array, got int."),
        ("[capture]\npattern = [0, 90]\n", "pattern cannot be [0, 90]: Expected array of length 4"),
        ("[capture]\ngamma = 20\n", "[capture] gamma must lie in 0.1 to 10, not 20."),
        (
            "[capture]\nkind = 'foo'\n",
            "[capture] kind must be one of mosaic, angles, stokes, aolp,",
        ),
        ("[sfm]\nseed = 1.5\n", "[sfm] seed cannot be 1.5: Expected int, got float."),
        ("[capture]\ngamma = 1\ngamma = 1\n", "(at line 3, column 10): gamma = 1)"),
        ("[capture]\ngamma = 1\n[capture]\n", "(at line 3, column 9): [capture])"),
        ("[capture\n", "is no TOML file"),
        ("[reference]\nscale = ['a', 'a', 1]\n", "[reference] scale needs two different ends"),
    ],
)
def test_config_file_is_read_strictly(cli, config, tmp_path: Path, text: str, message: str) -> None:
    path = config(text)
    status, out, err = cli("sfm", tmp_path, tmp_path / "out", "--config", path)
    assert (status, out) == (2, "")
    assert err.startswith(f"polmvs sfm: error: {path}: ")
    assert message in err
    assert err.count("\n") == 1


def test_a_message_of_a_file_names_keys_alone(cli, config, tmp_path: Path) -> None:
    path = config("[propagation]\nspacing_px = 0.3\n")
    status, _, err = cli("reconstruct", tmp_path, tmp_path / "out", "--config", path)
    assert status == 2
    reason = "must be as long as [propagation] step_px or longer, not 0.3."
    assert err == f"polmvs reconstruct: error: {path}: [propagation] spacing_px {reason}\n"


def test_a_flag_in_place_of_a_wrong_value_of_the_file(cli, config, tmp_path: Path) -> None:
    path = config("[capture]\ngamma = 20\n")
    flags = ("--config", path, "--gamma", "30")
    status, _, err = cli("sfm", tmp_path, tmp_path / "out", *flags)
    assert status == 2
    assert err == "polmvs sfm: error: --gamma must lie in 0.1 to 10, not 30.\n"


def test_missing_config_file(cli, tmp_path: Path) -> None:
    status, _, err = cli("sfm", tmp_path, tmp_path / "out", "--config", tmp_path / "none.toml")
    assert status == 1
    assert "none.toml: cannot be read: No such file or directory." in err
