"""The commands that show results: report, view and render."""

import json
import shutil
from pathlib import Path

import cv2
import pytest
from helpers import refused


@pytest.fixture
def run_copy(demo_run: Path, tmp_path: Path) -> Path:
    """The finished demo, to change."""
    return Path(shutil.copytree(demo_run, tmp_path / "run"))


@pytest.mark.slow
def test_report_makes_the_page_again_and_escapes_names(cli, run_copy: Path) -> None:
    page = run_copy / "report.html"
    record = json.loads((run_copy / "run.json").read_text())
    record["command_line"] = ["polmvs", "<script>alert(1)</script>"]
    record["stages"][0]["warnings"] = ["a <b>bold</b> warning"]
    (run_copy / "run.json").write_text(json.dumps(record))
    assert cli("report", run_copy)[0] == 0  # of the record as it is now
    first = page.read_bytes()
    page.unlink()
    status, text, _ = cli("report", run_copy)
    assert (status, text.strip()) == (0, str(page))
    assert page.read_bytes() == first
    assert b"<script>alert(1)" not in first
    assert b"a &lt;b&gt;bold&lt;/b&gt; warning" in first


def test_report_says_what_came_out(demo_run: Path) -> None:
    text = (demo_run / "report.html").read_text()
    metrics = json.loads((demo_run / "metrics.json").read_text())
    cloud = metrics["models"]["ppa"]["truth"]["cloud"]
    near, covered = (f"{100 * cloud[name][0]:.1f} %" for name in ("accuracy", "completeness"))
    assert f"{near} of the points lie within 1 mm of the true surface" in text
    assert f"cover {covered} of it" in text
    for name in ("000.png", "009.png"):
        assert f"<summary>{name}</summary>" in text


def test_report_without_the_capture_and_the_truth(cli, run_copy: Path) -> None:
    """What is gone is said, the rest is shown."""
    record = json.loads((run_copy / "run.json").read_text())
    record["capture"]["folder"] = str(run_copy / "gone")
    record["options"]["evaluation"]["gt"] = str(run_copy / "gone")
    (run_copy / "run.json").write_text(json.dumps(record))
    status, _, err = cli("report", run_copy)
    assert status == 0
    assert "no raw polarization" in err
    assert "no errors against the truth" in err
    text = (run_copy / "report.html").read_text()
    assert "residual phase" in text
    assert "depth error" not in text


@pytest.mark.parametrize("command", ["report", "view"])
def test_folders_that_hold_no_run(cli, tmp_path: Path, command: str) -> None:
    assert "holds no run of polmvs" in refused(cli(command, tmp_path))


def test_a_run_without_clouds_has_no_report(cli, run_copy: Path) -> None:
    record = json.loads((run_copy / "run.json").read_text())
    record["stages"] = [s for s in record["stages"] if not s["name"].startswith("densify")]
    (run_copy / "run.json").write_text(json.dumps(record))
    assert "polmvs densify" in refused(cli("report", run_copy))


@pytest.mark.parametrize("display", ["", pytest.param(":99", marks=pytest.mark.slow)])
def test_view_without_a_display_points_at_the_report(
    cli, run_copy: Path, monkeypatch: pytest.MonkeyPatch, display: str
) -> None:
    """None, or one that does not answer, at which Open3D ends the process."""
    monkeypatch.setenv("DISPLAY", display)
    monkeypatch.delenv("WAYLAND_DISPLAY", raising=False)
    status, text, err = cli("view", run_copy)
    assert (status, err) == (0, "")
    page = run_copy / "report.html"
    assert text == (
        f"there is no display here to open a window on; {page} shows the same in a browser\n"
    )


def test_render_draws_a_column_for_each_file(cli, demo_run: Path, tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    files = (demo_run / "opa.ply", demo_run / "ppa.ply")
    arguments = (picture, *files, "--labels", "OPA,PPA", "--elevations", "30,5,80")
    status, text, _ = cli("render", *arguments, "--size", "200,120")
    assert (status, text.strip()) == (0, str(picture))
    drawn = cv2.imread(str(picture))
    assert drawn.shape == (360, 400, 3)
    assert (drawn[:, :200] < 250).any()
    assert (drawn[:, 200:] < 250).any()
    assert "exists" in refused(cli("render", *arguments), 2)
    assert cli("render", *arguments, "--size", "200,120", "--overwrite", "--part")[0] == 0
    alone = cv2.imread(str(picture))  # without the surroundings' points
    assert (alone < 250).any()
    assert (alone != drawn).any()


def test_render_refuses_what_it_cannot_draw(cli, demo_run: Path, tmp_path: Path) -> None:
    picture = tmp_path / "picture.png"
    assert "no such file" in refused(cli("render", picture, tmp_path / "no.ply"))
    (tmp_path / "text.ply").write_text("not a cloud")
    assert "is no PLY file" in refused(cli("render", picture, tmp_path / "text.ply"))
    labels = (demo_run / "ppa.ply", "--labels", "a,b")
    assert "--labels" in refused(cli("render", picture, *labels), 2)
    assert not picture.exists()
