import importlib.util
import shutil
import sys
from pathlib import Path
from types import ModuleType

import cv2
import numpy as np
import pytest

from polmvs.colmap.models import read_model
from polmvs.io.clouds import Cloud

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
    assert {"benchmark", "paper"} <= set(SCRIPTS)


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


@pytest.mark.slow
def test_trust_table_tells_a_right_run(demo_run: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert load("trust_table").main([str(demo_run)]) == 0
    text = capsys.readouterr().out
    assert "To be trusted: a surface of the other views predicts 2 held-out views" in text
    assert "0 false alarms of 1 right results, 0 misses of 0 wrong ones" in text


def test_false_alarms_and_misses_are_counted() -> None:
    script = load("trust_table")
    row = ("run", "0", "99", "right", "1", "99", "0", "yes", "")
    rows = [
        row,
        (*row[:7], "no", ""),
        (*row[:3], "wrong", *row[4:]),
        (*row[:3], "wrong", *row[4:7], "no", ""),
        (*row[:3], "between", *row[4:]),
    ]
    assert script.counts(rows) == (
        "1 false alarms of 2 right results, 1 misses of 2 wrong ones; 1 of 1 in between are "
        "trusted."
    )


@pytest.mark.parametrize(
    ("normals", "scores", "state"),
    [
        (0.5, (0.8, 0.95, 1.0), "right"),
        (5.0, (0.9, 0.95, 1.0), "wrong"),
        (0.5, (0.1, 0.6, 1.0), "wrong"),
        (float("nan"), (0.9, 0.95, 1.0), "wrong"),
        (3.0, (0.9, 0.95, 1.0), "between"),
        (0.5, (0.5, 0.8, 1.0), "between"),
    ],
)
def test_results_are_right_wrong_or_between(normals, scores, state) -> None:
    cloud = type(
        "Cloud",
        (),
        {
            "thresholds_m": (0.001, 0.002, 0.005),
            "f_score": scores,
            "normal_median_deg": normals,
        },
    )
    assert load("trust_table").state_of(cloud) == state


def test_wrong_settings_are_what_their_names_say(
    demo_run: Path, demo_capture: Path, tmp_path: Path
) -> None:
    script = load("wrong_settings")
    work = tmp_path / "work"
    (work / "right" / "run").mkdir(parents=True)
    shutil.copytree(demo_run / "sparse", work / "right" / "run" / "sparse")
    settings = {
        setting.name: setting
        for setting in script.Settings(script.Arguments(capture=demo_capture, work=work))
    }
    right = {view.name: view for view in read_model(demo_run / "sparse").views}

    def model_of(name: str) -> dict:
        folder = tmp_path / name.replace(" ", "_")
        folder.mkdir()
        flag, path = settings[name].flags(folder)
        assert flag == "--sparse"
        return {view.name: view for view in read_model(path).views}

    def turned_deg(name: str) -> list[float]:
        angles = []
        for key, view in model_of(name).items():
            turn = view.cam_from_world.rotation @ right[key].cam_from_world.rotation.T
            angles.append(np.degrees(np.arccos(np.clip((np.trace(turn) - 1) / 2, -1, 1))))
        return sorted(angles)

    for name, degrees in {"pose off by 1 deg": 1, "pose off by 5 deg": 5}.items():
        found = turned_deg(name)
        assert found[-1] == pytest.approx(degrees, abs=1e-3)
        assert found[-2] < 1e-3
    focal = model_of("model with focal length 1.1")
    assert all(v.camera.fx == pytest.approx(1.1 * right[k].camera.fx) for k, v in focal.items())
    masks = tmp_path / "masks"
    masks.mkdir()
    settings["mask shifted"].flags(masks)
    mask = cv2.imread(str(masks / "000.png"), cv2.IMREAD_GRAYSCALE)
    true = cv2.imread(str(demo_capture / "gt" / "000_mask.png"), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_array_equal(mask[:, 20:] > 0, true[:, :-20] > 0)
    frames = []
    for k in range(6):
        frames.append(tmp_path / f"{k}.raw")
        frames[-1].write_bytes(bytes([k]))
    settings["frames swapped"].frames(frames)
    assert [frame.read_bytes()[0] for frame in frames] == [0, 3, 2, 1, 4, 5]
    settings["frame duplicated"].frames(frames)
    assert [frame.read_bytes()[0] for frame in frames] == [0, 3, 2, 3, 4, 5]
    settings["three views"].frames(frames)
    assert [frame.exists() for frame in frames] == [True] * 3 + [False] * 3


def test_figures_stand_beside_those_of_another_version() -> None:
    figures = load("figures")
    old = figures.Figures(name="board", f_score=99.46, is_trusted=True, seconds=30.0)
    new = figures.Figures(name="board", f_score=99.5, is_trusted=False, seconds=20.04)
    other = figures.Figures(name="dome", message="no views")
    table = figures.figures_table([new, other], {"board": old})
    cells = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()[2:]]
    assert cells[0][:3] == ["board", "-", "99.5"]  # the same as printed
    assert cells[0][6:8] == ["yes > no", "30.0 > 20.0"]
    assert cells[1][0] == "dome"
    assert cells[1][-1] == "no views"


def test_a_cloud_beside_the_planes_of_sparse_points() -> None:
    """Two planes, and a cloud one hundredth of the size above the larger, its normals turned."""
    script, rng = load("planes"), np.random.default_rng(0)
    floor = np.column_stack(
        [rng.uniform(0, 3, (400, 1)), rng.uniform(0, 4, (400, 1)), np.zeros(400)]
    )
    wall = np.column_stack(
        [np.zeros(200), rng.uniform(0, 4, (200, 1)), rng.uniform(0, 3, (200, 1))]
    )
    found = list(script.planes(np.concatenate([wall, floor]), 3))
    assert [len(members) for members in found] == pytest.approx([400, 200], abs=8)
    turn = np.radians(3)
    above = np.add(floor, (0, 0, 0.05))
    normals = np.tile((0, np.sin(turn), -np.cos(turn)), (len(above), 1))
    row = script.compared(floor, Cloud(points=above, normals=normals))
    assert row["covered, %"] == 100
    assert row["distance, median, % of the size"] == pytest.approx(1, rel=0.05)
    assert row["normals, median, deg"] == pytest.approx(3, abs=1e-6)
    assert list(script.planes(floor[:5], 3)) == []
