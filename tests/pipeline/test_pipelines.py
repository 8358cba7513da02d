import importlib.util
import json
import shutil
import sys
from pathlib import Path
from types import ModuleType

import pytest

PIPELINES = Path(__file__).parents[2] / "pipelines"
SCRIPTS = sorted(path.stem for path in PIPELINES.glob("*.py"))


def load(name: str) -> ModuleType:
    spec = importlib.util.spec_from_file_location(f"pipelines_{name}", PIPELINES / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_there_are_scripts() -> None:
    assert {"reconstruct", "compare", "benchmark"} <= set(SCRIPTS)


@pytest.mark.parametrize("name", SCRIPTS)
def test_help(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert help_status(load(name)) == 0
    assert "usage:" in capsys.readouterr().out.lower()


def help_status(script: ModuleType) -> int:
    """Exit status of ``--help``, which some parsers return and others raise."""
    try:
        return script.main(["--help"])
    except SystemExit as stop:
        return int(stop.code or 0)


def test_reconstruct_goes_on_with_a_run(
    demo_run: Path, demo_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    intrinsics = json.loads((demo_run / "run.json").read_text())["options"]["sfm"]["intrinsics"]
    out = tmp_path / "out"
    shutil.copytree(demo_run, out)
    flags = ["--intrinsics", ",".join(map(str, intrinsics)), "--resume", "--no-mesh", "--no-colmap"]
    assert load("reconstruct").main([str(demo_capture), str(out), *flags]) == 0
    assert f"{out / 'ppa.ply'}: " in capsys.readouterr().out


def test_compare_takes_truth_from_the_capture(
    demo_run: Path, demo_capture: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    intrinsics = json.loads((demo_run / "run.json").read_text())["options"]["sfm"]["intrinsics"]
    shutil.copytree(demo_run, tmp_path / demo_capture.name)
    flags = ["--intrinsics", ",".join(map(str, intrinsics)), "--resume"]
    assert load("compare").main([str(tmp_path), str(demo_capture), *flags]) == 0
    assert "Chamfer" in capsys.readouterr().out


def test_benchmark_prints_stages_of_several_runs(
    demo_run: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert load("benchmark").main([str(demo_run), str(demo_run / "run.json")]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = [line.split("|")[1].strip() for line in lines[2:]]
    assert names[:4] == ["images", "sfm", "poses", "maps"]
    assert names[-3:] == ["all stages", "all but poses", "wall clock"]
    assert lines[0].count("peak MB") == 2


def test_benchmark_of_no_run_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert load("benchmark").main([str(tmp_path)]) == 1
    assert capsys.readouterr().err.count("\n") == 1
