"""``polmvs experiment`` and ``pipelines/paper.py``: results, and each kind of bad input."""

import importlib.util
import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest

import polmvs
from polmvs.experiments import output
from polmvs.io.images import write_png
from polmvs.polarization.capture import open_capture

DEMO = Path(polmvs.__file__).parent / "demo_capture"

FAST = ("--num-points", 300, "--k", "2,3", "--num-seeds", 6, "--workers", 1)


@pytest.mark.slow
def test_all_experiments_on_the_bundled_capture(cli, tmp_path):
    out = tmp_path / "out"
    for name in output.NAMES:
        views = ("--views", "000,004.png") if name in ("phase", "contours") else ()
        status, text, _ = cli("experiment", name, DEMO, out, "--gt", DEMO / "gt", *FAST, *views)
        assert status == 0
        assert "tilted" in text
    content = {name: json.loads((out / f"{name}.json").read_text()) for name in output.NAMES}
    # The targets for a board, with some room: this capture is smaller and noisier.
    phase = content["phase"]
    assert phase["ppa"]["rmse_deg"] / phase["opa"]["rmse_deg"] < 0.25
    assert phase["tilted"]["rmse_deg"] < phase["ppa"]["rmse_deg"]
    assert content["plane"]["weighted"]["mean_deg"] < 0.8
    assert content["plane"]["weighted"]["mean_deg"] < content["plane"]["algebraic"]["mean_deg"]
    assert len(content["plane"]["per_image"]) == 10
    tracks = content["tracks"]
    assert tracks["k"] == [2, 3]
    assert tracks["ppa_weighted"]["mean_deg"][1] < 2
    assert set(tracks["opa"]) >= {"mean_deg", "median_deg", "p80_deg", "under_25"}
    contours = content["contours"]
    assert contours["ppa_tangent"]["rmse_mm"] < 0.2 * contours["opa"]["rmse_mm"]
    assert contours["ppa_normals"]["rmse_mm"] < 0.3 * contours["opa"]["rmse_mm"]
    for path in out.glob("*.md"):
        assert all((out / name).is_file() for name in _links(path.read_text()))
    assert not [path for path in out.iterdir() if path.name.startswith(".")]
    status, text, err = cli("experiment", "phase", DEMO, out)
    assert (status, text) == (2, "")
    assert "Give --overwrite to replace results of 'phase'" in err


def _links(markdown):
    return [part.split(")")[0] for part in markdown.split("](")[1:]]


def demo_copy(tmp_path):
    return Path(shutil.copytree(DEMO, tmp_path / "capture"))


@pytest.fixture
def refused(cli, tmp_path):
    """Call the command, which must fail in one line and write nothing."""

    def call(match: str, name: str, capture: Path, *words: object, status: int = 1) -> None:
        out = tmp_path / "refused"
        found, text, err = cli("experiment", name, capture, out, "--workers", 1, *words)
        assert (found, text) == (status, "")
        assert match in err
        assert err.startswith("polmvs experiment: error: ")
        assert err.count("\n") == 1
        assert not out.exists()

    return call


def test_missing_truth(refused, tmp_path) -> None:
    capture = demo_copy(tmp_path)
    shutil.rmtree(capture / "gt")
    refused("missing", "phase", capture)
    refused("no such folder", "phase", capture, "--gt", tmp_path / "none")


def test_truth_of_other_images(refused, tmp_path) -> None:
    capture = demo_copy(tmp_path)
    for path in (capture / "raw").iterdir():
        path.rename(path.with_name(f"other{path.name}"))
    refused("none match", "tracks", capture)


def test_mask_of_another_size(refused, tmp_path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    for index in range(10):
        write_png(masks / f"{index:03d}.png", np.full((20, 30), 255, np.uint8))
    refused("30x20", "plane", DEMO, "--mask", masks)
    capture = demo_copy(tmp_path)
    write_png(capture / "gt" / "000_mask.png", np.ones((20, 30), np.uint8))
    refused("30x20", "phase", capture)


def test_no_pixel_over_the_threshold(refused, tmp_path) -> None:
    masks, capture = tmp_path / "masks", demo_copy(tmp_path)
    masks.mkdir()
    for path in sorted((capture / "raw").iterdir())[3:]:
        path.unlink()
    shape = (open_capture(DEMO).height, open_capture(DEMO).width)
    for index in range(3):
        write_png(masks / f"{index:03d}.png", np.zeros(shape, np.uint8))
    for name in output.NAMES:
        refused("--min-dolp", name, capture, "--mask", masks)


def test_options_that_cannot_be(refused) -> None:
    for words, match in (
        (("--k", "2,30"), "--k"),
        (("--k", "two"), "--k"),
        (("--views", "nine"), "--views"),
        (("--poses", "sfm"), "--sparse"),
        (("--blur-px", "-1"), "--blur-px"),
        (("--num-seeds", "0"), "--num-seeds must lie in 1"),
        (("--step-px", "9"), "--step-px must lie in 0.05 to 4, not 9"),
        (("--workers", "2"), "--workers specified multiple times"),
    ):
        refused(match, "tracks", DEMO, *words, status=2)


def test_poses_of_other_images(refused, tmp_path) -> None:
    sparse = tmp_path / "sparse"
    sparse.mkdir()
    (sparse / "cameras.txt").write_text("1 PINHOLE 459 384 330 330 229.5 192\n")
    (sparse / "images.txt").write_text(
        "".join(f"{i} 1 0 0 0 {i} 0 0 1 cat{i}.png\n\n" for i in range(1, 5))
    )
    (sparse / "points3D.txt").write_text("")
    refused("match", "phase", DEMO, "--poses", "sfm", "--sparse", sparse)


@pytest.fixture
def page(monkeypatch):
    """The script ``pipelines/paper.py`` as a module."""
    path = Path(__file__).parents[2] / "pipelines" / "paper.py"
    spec = importlib.util.spec_from_file_location("paper", path)
    module = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, module)  # dataclasses look their module up
    spec.loader.exec_module(module)
    return module


def test_page_of_the_paper(tmp_path, monkeypatch, page):
    def report(name, scene, options, workers, progress):
        figures = {f"{name}.png": ("seen", b"png")}
        return output.Report(
            name=name, title=name, content={"value": 1.5}, text="text", figures=figures, lines={}
        )

    monkeypatch.setattr(page, "run_experiment", report)
    out = tmp_path / "page"
    assert page.main([str(out), str(DEMO), "--workers", "1"]) == 0
    content = json.loads((out / "paper.json").read_text())
    assert content["captures"]["demo_capture"]["tracks"] == {"value": 1.5}
    links = _links((out / "paper.md").read_text())
    assert len(links) == 4
    assert all((out / link).is_file() for link in links)


def test_page_refuses(tmp_path, capsys, page):
    assert page.main([str(tmp_path / "page"), str(tmp_path / "none")]) == 1
    assert page.main([str(tmp_path / "page"), str(DEMO), str(DEMO)]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 2
    assert not (tmp_path / "page").exists()
