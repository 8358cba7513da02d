"""The main job on the bundled capture: what the run leaves, how good it is, and how it goes on."""

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import content_of, cut_after, record_of, result_of, stages_of

from polmvs.cli.jobs import DEMO_MODELS
from polmvs.colmap.models import read_model
from polmvs.config import PropagationOptions
from polmvs.io.clouds import read_cloud
from polmvs.pipeline.record import SCHEMA_VERSION
from polmvs.scene import PointKind

BEFORE_CLOUDS = [
    *("images", "sfm", "poses", "maps", "maps_tilted", "silhouettes"),
    *(f"normals_{model}" for model in DEMO_MODELS),
    "seeds",
    *(f"sparse_cloud_{model}" for model in DEMO_MODELS),
]
STAGES = [*BEFORE_CLOUDS, *[f"densify_{model}" for model in DEMO_MODELS], "evaluation"]
RESULTS = ("normals.ply", "normals_opa.ply", "opa.ply", "ppa.ply", "tilted.ply", "metrics.json")
# For what is not about the surface: one that is a quarter of the work.
QUICK = ("--method", "contour", "--stride-px", 8)


def metrics_of(out: Path) -> dict:
    return json.loads((out / "metrics.json").read_text())


def assert_no_temporary_files(out: Path) -> None:
    assert [path.name for path in out.rglob(".*")] == []


def test_output_folder_is_as_described(demo_run: Path) -> None:
    names = {path.name for path in demo_run.iterdir()}
    assert {"images", "sparse", "summary.md", "run.json", "polmvs.log", *RESULTS} <= names
    assert len(list((demo_run / "images").glob("*.png"))) == 10
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= {
        path.name for path in (demo_run / "sparse").iterdir()
    }
    assert_no_temporary_files(demo_run)


def test_run_record(demo_run: Path) -> None:
    record = json.loads((demo_run / "run.json").read_text())
    assert [stage["name"] for stage in record["stages"]] == STAGES
    for stage in record["stages"]:
        assert stage["seconds"] > 0
        assert 50 < stage["peak_rss_mb"] < 4000  # two surfaces side by side
    # The surfaces are made side by side.
    one_by_one = [s["seconds"] for s in record["stages"] if not s["name"].startswith("densify")]
    assert record["wall_s"] >= 0.99 * sum(one_by_one)
    assert record["options"]["sfm"]["intrinsics"][0] == pytest.approx(333.75)
    assert record["options"]["fusion"]["min_views"] == 2
    assert {"python", "numpy", "pycolmap", "open3d", "polmvs"} <= set(record["versions"])
    assert record["schema_version"] == SCHEMA_VERSION
    poses = result_of(demo_run, "poses")
    assert (poses["num_views"], poses["unregistered"]) == (10, [])
    assert record["command_line"][:2] == ["polmvs", "demo"]
    assert record["finished"] is True


def test_ppa_reconstructs_the_board_and_opa_does_not(demo_run: Path) -> None:
    models = metrics_of(demo_run)["models"]
    opa, ppa = models["opa"]["truth"], models["ppa"]["truth"]
    assert ppa["cloud"]["thresholds_m"] == [0.001, 0.002, 0.005]
    # Measured 99.9 %; the prototype in the design notes had 94 %.
    assert ppa["cloud"]["f_score"][1] > 0.9
    assert ppa["cloud"]["completeness"][1] > 0.9
    assert ppa["cloud"]["chamfer_m"] < 0.001
    assert ppa["cloud"]["normal_mean_deg"] < 1
    assert ppa["tracks"]["errors"]["mean_deg"] < 1
    assert ppa["cloud"]["off_surface_share"] < 0.02
    # OPA's surface keeps to silhouettes and sparse points, but its normals are several times worse.
    assert 1 - opa["cloud"]["f_score"][0] > 4 * (1 - ppa["cloud"]["f_score"][0])
    assert opa["cloud"]["normal_mean_deg"] > 4 * ppa["cloud"]["normal_mean_deg"]
    assert opa["tracks"]["errors"]["mean_deg"] > 4 * ppa["tracks"]["errors"]["mean_deg"]


def test_comparison_without_truth_tells_the_models_apart(demo_run: Path) -> None:
    metrics = metrics_of(demo_run)
    opa = metrics["models"]["opa"]["consistency"]
    ppa = metrics["models"]["ppa"]["consistency"]
    assert ppa["coverage"] > 0.9
    assert ppa["agreement"] > 0.98
    assert opa["coverage"] < ppa["coverage"]
    assert ppa["phase_residual"]["rmse_deg"] < 0.5 * opa["phase_residual"]["rmse_deg"]
    assert ppa["track_residual_median_deg"] < 0.5 * opa["track_residual_median_deg"]
    assert metrics["phase"]["maps"]["ppa"]["rmse_deg"] < 4.5
    assert metrics["phase"]["pixels"]["opa"]["rmse_deg"] > 15


def test_clouds_carry_normals_colours_and_scalars(demo_run: Path) -> None:
    cloud = read_cloud(demo_run / "ppa.ply")
    assert len(cloud.points) > 10_000
    assert cloud.normals is not None
    length = np.linalg.norm(cloud.normals, axis=1)
    np.testing.assert_allclose(length, cloud.scalars["kind"] == PointKind.SURFACE, atol=1e-4)
    assert cloud.colors is not None
    assert cloud.colors.std() > 0
    light = {"specular", "diffuse", "dolp"}
    assert set(cloud.scalars) == {"num_views", "sigma_deg", "sigma", "kind", *light}
    on_part = cloud.scalars["kind"] == PointKind.SURFACE
    assert np.median(cloud.scalars["specular"][on_part]) > 0.9  # black and glossy
    assert np.isnan(cloud.scalars["specular"][~on_part]).all()
    assert cloud.scalars["num_views"].min() >= 2
    kinds = cloud.scalars["kind"]
    assert set(kinds.astype(int)) == {PointKind.SURFACE, PointKind.SPARSE}


def test_sparse_normals_carry_their_quality(demo_run: Path) -> None:
    tracks = read_cloud(demo_run / "normals.ply")
    assert len(tracks.points) == len(read_model(demo_run / "sparse").tracks.point3D_ids)
    names = {"sigma_deg", "num_views", "residual", "conditioning", "valid", "seed"}
    names |= {"specular", "diffuse", "dolp"}
    assert set(tracks.scalars) == names
    assert tracks.normals is not None
    valid = tracks.scalars["valid"] > 0
    np.testing.assert_array_equal(np.isfinite(tracks.normals).all(axis=1), valid)
    seeds = tracks.scalars["seed"] > 0
    assert 20 < seeds.sum() <= valid.sum()
    # The seeds are the same for both models.
    other = read_cloud(demo_run / "normals_opa.ply")
    np.testing.assert_array_equal(other.scalars["seed"], tracks.scalars["seed"])


@pytest.mark.slow
def test_16_bit_tiff_with_own_poses_and_names(
    demo_run: Path, demo_capture: Path, tmp_path: Path, cli
) -> None:
    """Images are matched to the model and to the truth by name without suffix."""
    capture, out = tmp_path / "capture", tmp_path / "out"
    (capture / "raw").mkdir(parents=True)
    for path in (demo_capture / "raw").glob("*.png"):
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        cv2.imwrite(str(capture / "raw" / f"{path.stem}.tif"), raw.astype(np.uint16) * 257)
    flags = ("--sparse", demo_run / "sparse", "--gt", demo_capture, "--models", "ppa")
    status, _, err = cli("compare", capture, out, *flags, *QUICK)
    assert (status, err) == (0, "")
    found = metrics_of(out)["models"]["ppa"]["truth"]
    assert found["alignment"]["num_cameras"] == 10
    assert found["cloud"]["f_score"][2] > 0.9
    assert not (out / "opa.ply").exists()


def start(out: Path, *arguments: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "polmvs", "demo", str(out), "--workers", "2", *arguments]
    command += ["--quiet", "--no-report"]
    return subprocess.Popen(
        command,
        stderr=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        # A shell ignores it for what runs in its background, and children inherit that.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )


def kill(process: subprocess.Popen[str]) -> None:
    """Kill a run and its workers without notice."""
    os.killpg(process.pid, signal.SIGKILL)
    process.communicate(timeout=300)


def wait_until(holds, process: subprocess.Popen[str], timeout_s: float = 300) -> None:
    deadline = time.monotonic() + timeout_s
    while not holds():
        assert process.poll() is None, process.communicate()[1]
        assert time.monotonic() < deadline
        time.sleep(0.02)


def unfinished(out: Path, name: str) -> bool:
    """Whether a stage is at work on this folder."""
    return any(out.glob(f".polmvs-*-{name}"))


def copy_until(demo_run: Path, out: Path, last: str) -> None:
    """A run that was stopped after this stage."""
    shutil.copytree(demo_run, out)
    cut_after(out, last)


@pytest.mark.slow
def test_run_killed_in_sfm_finds_the_same_model(
    demo_run: Path, demo_capture: Path, tmp_path: Path, cli
) -> None:
    """SfM is a process of its own; other stages are killed in `test_killed_runs.py`."""
    out = tmp_path / "out"
    process = start(out)
    wait_until(lambda: unfinished(out, "sfm"), process)
    time.sleep(0.5)
    kill(process)
    assert not (out / "sparse").exists()
    assert stages_of(out) == ["images"]

    intrinsics = ",".join(map(str, record_of(demo_run)["options"]["sfm"]["intrinsics"]))
    status, _, err = cli("sfm", demo_capture, out, "--resume", "--intrinsics", intrinsics)
    assert (status, err) == (0, "")
    assert content_of(out / "sparse") == content_of(demo_run / "sparse")
    assert_no_temporary_files(out)


@pytest.mark.parametrize(
    "number", [signal.SIGINT, pytest.param(signal.SIGTERM, marks=pytest.mark.slow)]
)
def test_interrupt_keeps_finished_stages_only(demo_run: Path, tmp_path: Path, number: int) -> None:
    """And does not wait for the surfaces that are being made."""
    out = tmp_path / "out"
    copy_until(demo_run, out, BEFORE_CLOUDS[-1])
    process = start(out, "--resume")
    wait_until(lambda: unfinished(out, "views_opa"), process)
    process.send_signal(number)
    stdout, stderr = process.communicate(timeout=300)
    assert process.returncode == 130, stderr
    assert stderr == ("polmvs demo: interrupted; finished stages are kept, go on with --resume\n")
    assert stdout == ""
    assert_no_temporary_files(out)
    assert stages_of(out) == BEFORE_CLOUDS


@pytest.mark.slow
def test_stage_alone_is_done_again_only_with_overwrite(
    demo_run: Path, demo_capture: Path, tmp_path: Path, cli
) -> None:
    out = tmp_path / "out"
    shutil.copytree(demo_run, out)
    status, _, err = cli("densify", demo_capture, out)
    assert status == 2
    assert "is finished. Give --overwrite" in err
    status, _, err = cli("densify", demo_capture, out, *QUICK, "--overwrite")
    assert (status, err) == (0, "")
    assert len(read_cloud(out / "ppa.ply").points) < 0.5 * len(
        read_cloud(demo_run / "ppa.ply").points
    )
    # Figures of the old cloud do not stay beside the new one.
    assert not (out / "metrics.json").exists()
    assert (out / "opa.ply").read_bytes() == (demo_run / "opa.ply").read_bytes()


@pytest.mark.slow
def test_new_truth_is_measured_on_a_finished_run(
    demo_run: Path, demo_capture: Path, tmp_path: Path, cli
) -> None:
    out = tmp_path / "out"
    copy_until(demo_run, out, STAGES[-2])
    record = json.loads((out / "run.json").read_text())
    record["options"]["evaluation"]["gt"] = None
    (out / "run.json").write_text(json.dumps(record))
    flags = ("--resume", "--models", "ppa")
    status, text, _ = cli("compare", demo_capture, out, *flags)
    assert status == 0
    assert "Chamfer" not in text
    assert metrics_of(out)["phase"] is None
    status, text, _ = cli("compare", demo_capture, out, *flags, "--gt", demo_capture)
    assert status == 0
    assert "Chamfer" in text
    assert metrics_of(out)["models"]["ppa"] == metrics_of(demo_run)["models"]["ppa"]
    assert metrics_of(out)["phase"]["maps"]["ppa"] == metrics_of(demo_run)["phase"]["maps"]["ppa"]


def test_paper_contours_work_too(demo_run: Path, demo_capture: Path, tmp_path: Path, cli) -> None:
    out = tmp_path / "out"
    copy_until(demo_run, out, "sparse_cloud_ppa")
    args = ("--method", "contour", "--contour", "normals")
    status, _, err = cli("densify", demo_capture, out, *args)
    assert (status, err) == (0, "")
    status, text, _ = cli(
        "evaluate", out / "ppa.ply", "--gt", demo_capture, "--sparse", out / "sparse", "--json"
    )
    assert status == 0
    assert json.loads(text)["cloud"]["f_score"][1] > 0.9
    assert PropagationOptions().contour == "tangent"
    assert PropagationOptions().method == "surface"
