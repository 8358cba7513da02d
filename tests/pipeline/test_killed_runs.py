"""Runs that are killed or interrupted anywhere, and go on: the same bytes, and nothing left over.

A small analytic board with a given model, so that one run takes seconds; SfM, which is a process of
its own, is killed in `test_end_to_end.py`.
"""

import json
import random
import shutil
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import content_of, stages_of

from polmvs.camera import PinholeCamera
from polmvs.colmap.models import write_model
from polmvs.config import Method, Options, PropagationOptions, RunOptions, SfmOptions
from polmvs.errors import DataError
from polmvs.parallel import Workers
from polmvs.pipeline.jobs import reconstruct
from polmvs.pipeline.run_lock import locked
from polmvs.pipeline.runner import Job, NoMonitor
from polmvs.scene import SparseModel, Tracks
from polmvs.synthetic.captures import quantize, render_mosaic, ring_of_views
from polmvs.synthetic.surfaces import Plane

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="forks, and reads /proc")

CAMERA = PinholeCamera(width=96, height=80, fx=80.0, fy=80.0, cx=48.0, cy=40.0)
LEAST_KILLS = 20
MAX_KILLS_OF_RUN = 6  # then it may go on to its end: a stage may take longer than it is given
FLAGS = (
    "--workers",
    "1",
    "--quiet",
    "--no-report",
    "--no-mesh",
    "--stride-px",
    "3",
)
# What a run writes and is not the same twice: when it ran, and how long it took.
TIMED = ("run.json", "polmvs.log")

Call = Callable[..., dict]


@pytest.fixture(scope="module")
def call() -> Iterator[Call]:
    """The command line in a fork of a process that has imported everything."""
    script = Path(__file__).with_name("fork_server.py")
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "text": True}
    with subprocess.Popen([sys.executable, script], **pipes) as server:

        def call(*argv: object, number: int | None = None, after=0.0, stage=None) -> dict:
            request = {"argv": list(map(str, argv)), "signal": number}
            server.stdin.write(json.dumps({**request, "after": after, "stage": stage}) + "\n")
            server.stdin.flush()
            return json.loads(server.stdout.readline())

        yield call
        server.stdin.close()


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> list[object]:
    """Arguments of a run: a capture of a board, and a model with points on it."""
    folder = tmp_path_factory.mktemp("given")
    (folder / "capture").mkdir()
    board = Plane(np.zeros(3), np.array([0.1, -0.05, 1.0]), extent=(0.12, 0.15))
    views = ring_of_views(6, CAMERA, distance=0.5, elevation_deg=45, roll_deg=20)
    for view in views:
        mosaic = render_mosaic(view, board, s0=0.3, background=0.6)
        cv2.imwrite(str(folder / "capture" / view.name), quantize(mosaic))
    xy = np.random.default_rng(0).uniform(-0.05, 0.05, (30, 2))
    points = np.column_stack([xy, -(xy @ [0.1, -0.05])])
    observed = [(t, k) for t in range(len(points)) for k in range(len(views))]
    places = [views[k].camera.project(views[k].cam_from_world * points[t]) for t, k in observed]
    tracks = Tracks(
        point3D_ids=np.arange(1, len(points) + 1),
        points_in_world=points,
        colors=np.zeros((len(points), 3), np.uint8),
        errors=np.zeros(len(points)),
        obs_track=np.array([t for t, _ in observed], np.int64),
        obs_view=np.array([k for _, k in observed], np.int64),
        obs_xy=np.array(places).reshape(-1, 2),
    )
    model = SparseModel(views=tuple(views), tracks=tracks, unregistered=())
    write_model(model, folder / "sparse")
    return [folder / "capture", "--sparse", folder / "sparse"]


@pytest.fixture(scope="module")
def undisturbed(call: Call, given, tmp_path_factory) -> tuple[dict[str, bytes], float, list[str]]:
    """What a run writes, how long it takes, and its stages."""
    out = tmp_path_factory.mktemp("undisturbed") / "out"
    done = call("reconstruct", given[0], out, *given[1:], *FLAGS)
    assert (done["status"], done["stderr"]) == (0, "")
    return results_of(out), done["seconds"], stages_of(out)


def results_of(out: Path) -> dict[str, bytes]:
    return {name: data for name, data in content_of(out).items() if name not in TIMED}


@pytest.mark.slow
def test_a_run_killed_at_any_moments_comes_to_the_same(
    call: Call, given, undisturbed, tmp_path: Path
) -> None:
    """Killed again and again on its way, so that what goes on is killed as well."""
    expected, seconds, _ = undisturbed
    rng = random.Random(1)
    num_kills, kills_of_runs = 0, list[int]()
    while num_kills < LEAST_KILLS:
        out = tmp_path / str(len(kills_of_runs))
        again = ["reconstruct", given[0], out, *given[1:], *FLAGS]
        kills = 0
        while kills < MAX_KILLS_OF_RUN:
            done = call(*again, number=signal.SIGKILL, after=rng.uniform(0, 0.5 * seconds))
            assert done["orphans"] == []
            if "--resume" not in again:
                again.append("--resume")
            if done["status"] != -signal.SIGKILL:
                break
            kills += 1
        else:
            done = call(*again)
        assert (done["status"], done["stderr"]) == (0, "")
        assert results_of(out) == expected
        assert [path.name for path in out.rglob(".*")] == []
        kills_of_runs.append(kills)
        num_kills += kills
    assert max(kills_of_runs) > 1


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, 1])
def test_a_run_interrupted_in_any_stage_goes_on(
    call: Call, given, undisturbed, tmp_path: Path, first: int
) -> None:
    """By Ctrl-C and by a plain kill: one line, whole stages only, nothing and nobody left."""
    expected, _, stages = undisturbed
    out = tmp_path / "out"
    again = ["reconstruct", given[0], out, *given[1:], *FLAGS]
    for index, stage in enumerate(stages):
        number = (signal.SIGINT, signal.SIGTERM)[(index + first) % 2]
        done = call(*again, number=number, stage=stage)
        assert done["status"] == 130, (stage, number)
        line = "interrupted; finished stages are kept, go on with --resume"
        assert (done["stdout"], done["stderr"]) == ("", f"polmvs reconstruct: {line}\n")
        assert done["orphans"] == []
        assert stages_of(out) == stages[:index]
        assert [path.name for path in out.rglob(".*")] == []
        if "--resume" not in again:
            again.append("--resume")
    assert call(*again)["status"] == 0
    assert results_of(out) == expected


@pytest.mark.slow
def test_stages_alone_and_two_workers_give_the_same(
    call: Call, given, undisturbed, tmp_path: Path
) -> None:
    expected, _, stages = undisturbed
    out = tmp_path / "out"
    flags = ["--workers", "2", "--quiet"]
    assert call("sfm", given[0], out, *given[1:], *flags)["status"] == 0
    done = call("normals", given[0], out, *flags)
    assert done["status"] == 0
    assert "are seeds" in done["stdout"]
    done = call("densify", given[0], out, *flags, "--stride-px", "3")
    assert done["status"] == 0
    assert done["stdout"].startswith(f"{out / 'ppa.ply'}: ")
    assert call("finish", given[0], out, *flags, "--no-mesh")["status"] == 0
    assert stages_of(out) == stages
    assert results_of(out) == expected


@pytest.mark.slow
def test_a_comparison_killed_in_its_surfaces_goes_on_to_the_same(
    call: Call, given, tmp_path: Path
) -> None:
    """Two surfaces side by side; the finished stages stay."""
    models = ("--models", "opa,ppa", "--workers", "2", "--quiet", "--no-report")
    models += ("--stride-px", "3")
    expected, out = tmp_path / "expected", tmp_path / "out"
    assert call("compare", given[0], expected, *given[1:], *models)["status"] == 0
    before = [name for name in stages_of(expected) if not name.startswith(("densify", "eval"))]
    command = ("compare", given[0], out, *given[1:], *models)
    done = call(*command, number=signal.SIGKILL, stage="2 side by side", after=0.5)
    assert (done["status"], done["orphans"]) == (-signal.SIGKILL, [])
    assert stages_of(out) == before
    assert not (out / "ppa.ply").exists()
    assert call(*command, "--resume")["status"] == 0
    assert results_of(out) == results_of(expected)
    assert [path.name for path in out.rglob(".*")] == []


def test_a_second_run_beside_a_first_is_refused(
    call: Call, given, undisturbed, tmp_path: Path
) -> None:
    """Whether it is to go on or to begin anew; the first one is not disturbed."""
    out = tmp_path / "out"
    again = ["reconstruct", given[0], out, *given[1:], *FLAGS]
    with locked(out):
        for flag in ("--resume", "--overwrite"):
            done = call(*again, flag)
            assert done["status"] == 1
            assert "another run is at work in it (process" in done["stderr"]
            assert done["stderr"].count("\n") == 1
            assert [path.name for path in out.iterdir()] == [".polmvs-lock"]


def test_an_input_that_vanishes_on_the_way_is_named(given, tmp_path: Path) -> None:
    """What is finished stays, and the run goes on when it is back."""
    capture, out = tmp_path / "capture", tmp_path / "out"
    shutil.copytree(given[0], capture)

    class Thief(NoMonitor):
        def stage(self, name, total):
            if name == "maps":
                (capture / "003.png").unlink()
            return super().stage(name, total)

    job = Job(
        capture=capture,
        out=out,
        options=Options(sfm=SfmOptions(sparse=given[2])),
        run_options=RunOptions(workers=1),
        monitor=Thief(),
    )
    with pytest.raises(DataError, match=r"003\.png: no such file"):
        reconstruct(job)
    assert stages_of(out) == ["images", "sfm", "poses"]
    assert [path.name for path in out.rglob(".*")] == []


@pytest.mark.parametrize(
    ("work", "unfinished"),
    [
        ("images._write_image", "images"),
        ("maps._build_map", "maps"),
        ("densify._dense_surface", "views_ppa"),
    ],
)
def test_stages_stop_their_workers_before_their_files_go(
    given, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, work: str, unfinished: str
) -> None:
    out, there = tmp_path / "out", []

    def fail(*arguments, **options):
        raise DataError("a", "is bad.")

    @contextmanager
    def stopped_on_error(self):
        try:
            yield
        except DataError:
            there.extend(path.name.rpartition("-")[2] for path in out.glob(".polmvs-*-*-*"))
            raise

    monkeypatch.setattr(f"polmvs.pipeline.stages.{work}", fail)
    monkeypatch.setattr(Workers, "stopped_on_error", stopped_on_error)
    job = Job(
        capture=given[0],
        out=out,
        options=Options(
            sfm=SfmOptions(sparse=given[2]), propagation=PropagationOptions(method=Method.CONTOUR)
        ),
        run_options=RunOptions(workers=1),
    )
    with pytest.raises(DataError, match="a: is bad"):
        reconstruct(job)
    assert there == [unfinished]
    assert not list(out.glob(".*"))
