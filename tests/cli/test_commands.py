"""What the commands print."""

import json
from pathlib import Path

from polmvs.cli.jobs import DEMO_MODELS


def test_demo_prints_both_models_and_no_progress(demo_run: Path, cli) -> None:
    """The same lines as the finished run's, which goes on without anything left to do."""
    status, out, err = cli("demo", demo_run, "--resume", "--no-report")
    assert (status, err) == (0, "")
    lines = out.splitlines()
    names = [model.label for model in DEMO_MODELS]
    assert [cell.strip() for cell in lines[0].split("|")] == ["", "", *names, ""]
    assert any(line.startswith("| F-score at 1 mm, %") for line in lines)
    assert lines[-1].startswith(f"{demo_run}: opa.ply, ppa.ply, tilted.ply, ")
    assert lines[-1].endswith("metrics.json, summary.md; 10 of 10 views")
    summary = (demo_run / "summary.md").read_text()
    assert "\n".join(lines[:-1]) in summary


def test_json_of_a_job_is_all_that_is_printed(demo_run: Path, cli) -> None:
    status, out, err = cli("demo", demo_run, "--resume", "--json", "--no-report")
    content = json.loads(out)
    assert (status, err) == (0, "")
    assert content["out"] == str(demo_run)
    assert content["results"]["densify_ppa"]["num_points"] > 10_000
    assert (content["empty"], content["warnings"]) == (None, [])


def test_quiet_leaves_the_result(demo_run: Path, cli) -> None:
    _, text, _ = cli("demo", demo_run, "--resume", "--no-report")
    assert cli("demo", demo_run, "--resume", "--quiet", "--no-report") == (0, text, "")


def test_verbose_shows_every_stage(demo_run: Path, cli) -> None:
    status, _, err = cli("demo", demo_run, "--resume", "-v", "--no-report")
    assert status == 0
    assert "\nposes                finished earlier\n" in err
    assert "poses: begins" in (demo_run / "polmvs.log").read_text()


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
