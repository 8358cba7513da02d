"""The part against its reference, as the report shows it."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from helpers import refused

from polmvs.cli import deviations
from polmvs.io.clouds import read_cloud
from polmvs.pipeline.run_folder import RunFolder
from polmvs.polarization.kinds import AngleModel
from polmvs.report.deviation_section import deviation_layer, deviation_section, open_deviation
from polmvs.report.report import warnings_of
from polmvs.scene import PointKind

PPA = AngleModel.PPA


@pytest.fixture(scope="module")
def compared(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list]:
    """A copy of the finished run, compared with its own mesh, turned and a millimetre higher."""
    root = tmp_path_factory.mktemp("deviation")
    run = root / "run"
    shutil.copytree(demo_run, run, ignore=shutil.ignore_patterns("report.html", "maps*"))
    mesh = trimesh.load(run / "views_ppa" / "surface.ply", process=False)
    mesh.vertices += 0.002 * np.asarray(mesh.vertex_normals)
    mesh.export(root / "part.stl")
    return run, [root / "part.stl", "--unit", "m", "--aligned", "--report"]


@pytest.fixture
def call(compared, cli, monkeypatch):
    """``polmvs deviation`` without making the page, which takes its time."""
    run, arguments = compared

    def done(*more: object):
        made = []
        monkeypatch.setattr(deviations, "make_report", lambda f, t: made.append(f) or "PAGE")
        status, text, err = cli("deviation", run, *arguments, *more)
        assert made == [RunFolder(run)]
        assert text.splitlines()[-1] == "PAGE"
        return status, err

    return done


def opened(run: Path) -> SimpleNamespace:
    """As much of a run as the section needs."""
    return SimpleNamespace(deviation=open_deviation(RunFolder(run), [PPA]))


def test_a_comparison_is_kept_in_the_run_and_shown(call, compared) -> None:
    run = compared[0]
    status, _ = call("--tolerance", 0.5)
    assert status == 4
    assert {p.name for p in (run / "deviation").iterdir()} == {
        *("deviation.ply", "deviation.png", "deviation.svg", "deviation.json")
    }
    given = opened(run)
    assert not given.deviation.is_stale
    section = deviation_section(given.deviation)
    assert section is not None
    assert section.passed is False
    assert section.sentence.startswith("The part fails: ")
    assert " of part.stl, 99 % are asked for. Against part.stl the part is " in section.sentence
    assert "mm inside in the mean" in section.sentence
    rows = dict(section.table.rows)
    assert float(rows["mean, mm"]) == pytest.approx(-2.0, abs=0.3)
    assert "repeatability of one run, mm" not in rows
    assert call("--tolerance", 5)[0] == 0  # again, in the place of the last one
    assert deviation_section(opened(run).deviation).sentence.startswith("The part passes: ")


def test_the_layer_lies_where_the_cloud_does(call, compared) -> None:
    run = compared[0]
    call()
    layer, channel = deviation_layer(opened(run).deviation)
    cloud = read_cloud(run / "ppa.ply")
    part = cloud.points[np.isin(cloud.scalars["kind"], (PointKind.SURFACE, PointKind.INFERRED))]
    # Each is a point of the cloud: it was thinned and laid, and comes back.
    near = trimesh.proximity.cKDTree(part).query(layer.points)[0]
    assert near.max() < 1e-6
    assert (channel.low, channel.unit) == (-channel.high, "mm")
    assert np.median(layer.values["deviation"]) == pytest.approx(-2.0, abs=0.3)


def test_of_another_cloud_it_is_not_shown_but_told(call, compared, tmp_path: Path) -> None:
    call()
    run = tmp_path / "run"
    shutil.copytree(compared[0], run)
    (run / "ppa.ply").write_bytes((run / "opa.ply").read_bytes())
    given = opened(run)
    given.record = SimpleNamespace(stages=[])
    assert deviation_section(given.deviation) is None
    (warning,) = warnings_of(given)
    assert "of an earlier cloud of this run" in warning
    (run / "deviation" / "deviation.json").write_text("{}")
    assert open_deviation(RunFolder(run), [PPA]) is None


def test_two_runs_repeat(compared, demo_run: Path, cli, tmp_path: Path) -> None:
    run, out = compared[0], tmp_path / "out"
    flags = ("--unit", "m", "--aligned", "--out", out)
    status, text, _ = cli("deviation", run, demo_run, *flags)
    assert status == 0
    figures = json.loads((out / "deviation.json").read_text())
    assert figures["repeatability"] == pytest.approx(figures["standard_deviation"] / np.sqrt(2))
    assert f"standard deviation of {figures['repeatability']:.4f} mm" in text
    # The deviations of both runs count, which are alike.
    alone = read_cloud(run / "ppa.ply").scalars["sigma"]
    part = np.isin(read_cloud(run / "ppa.ply").scalars["kind"], (0, 4))
    both = 1e3 * np.sqrt(2) * np.median(alone[part & np.isfinite(alone)])
    assert figures["median_sigma"] == pytest.approx(both, rel=0.1)


def test_a_report_is_of_a_run(compared, cli) -> None:
    run, arguments = compared
    err = refused(cli("deviation", run / "ppa.ply", *arguments), 2)
    assert "--report is of a finished run" in err
