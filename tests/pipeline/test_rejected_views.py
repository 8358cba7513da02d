"""Views whose pose is wrong are taken out of the model, its workspace and its counts."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from helpers import record_of, refused, result_of

from polmvs.cli import main
from polmvs.colmap.models import read_model, write_model
from polmvs.geometry import RigidTransform
from polmvs.io.arrays import map_array
from polmvs.scene import SparseModel, View, without_views

INTRINSICS = "333.75,333.75,230.6475,196.608"


@pytest.fixture(scope="module")
def wrong_model(demo_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The demo's model with one camera turned about the part by 60 degrees."""
    out = tmp_path_factory.mktemp("right") / "out"
    assert main(["sfm", str(demo_capture), str(out), "--intrinsics", INTRINSICS]) == 0
    model = read_model(out / "sparse")
    center = np.median(model.tracks.points_in_world, axis=0)
    up = np.mean([view.center_in_world for view in model.views], axis=0) - center
    up /= np.linalg.norm(up)
    across = np.array([[0, -up[2], up[1]], [up[2], 0, -up[0]], [-up[1], up[0], 0]])
    turn = np.eye(3) + np.sin(1.05) * across + (1 - np.cos(1.05)) * across @ across
    views = list(model.views)
    first = views[4]
    rotation = first.cam_from_world.rotation @ turn
    place = center + turn.T @ (first.center_in_world - center)
    pose = RigidTransform(rotation, -rotation @ place)
    views[4] = View(name=first.name, camera=first.camera, cam_from_world=pose)
    folder = tmp_path_factory.mktemp("wrong") / "sparse"
    folder.mkdir()
    wrong = SparseModel(views=tuple(views), tracks=model.tracks, unregistered=model.unregistered)
    write_model(wrong, folder)
    return folder


@pytest.mark.slow
def test_a_view_that_the_surface_contradicts_is_taken_out(
    wrong_model: Path, demo_capture: Path, tmp_path: Path, cli
) -> None:
    out = tmp_path / "out"
    flags = ("--sparse", wrong_model, "--no-mesh")
    status, text, err = cli("reconstruct", demo_capture, out, *flags)
    assert status == 0, err
    assert "points from 9 of 10 views" in text
    assert [view.name for view in read_model(out / "sparse").views if view.name == "004.png"] == []
    assert len(read_model(out / "dense" / "sparse").views) == 9
    record = record_of(out)
    assert record["options"]["sfm"]["without"] == ["004.png"]
    assert any("004.png is inconsistent with the other views" in note for note in record["notes"])
    # What is left is right: the complaint about the pose went with its view.
    first, figures = text.splitlines()[0], text.splitlines()[1:]
    assert first.startswith(
        "PPA: To be trusted: a surface of the other views predicts 2 held-out views"
    )
    assert any(line.startswith("held-out views: overlap of their silhouettes") for line in figures)
    trust = result_of(out, "trust_ppa")
    assert trust["is_trusted"]
    assert first == f"PPA: {trust['verdict']}"
    assert (trust["num_views"], trust["left_out"], trust["complaints"]) == (10, 1, [])
    # It goes on with what is recorded.
    status, _, err = cli("reconstruct", demo_capture, out, *flags, "--resume")
    assert status == 0, err


@pytest.mark.slow
def test_images_can_be_taken_out_by_hand(demo_run: Path, demo_capture, tmp_path, cli) -> None:
    out = tmp_path / "out"
    given = ("--sparse", demo_run / "sparse")
    status, text, _ = cli("sfm", demo_capture, out, *given, "--without", "000.png,007")
    assert status == 0
    assert "8 of 10 views have a pose" in text
    record = record_of(out)
    poses = next(stage for stage in record["stages"] if stage["name"] == "poses")
    assert poses["result"]["unregistered"] == ["000.png", "007.png"]
    num_points = len(read_model(out / "sparse").tracks.point3D_ids)
    assert map_array(out / "tracks" / "camera.npy").shape[1] == num_points
    err = refused(cli("sfm", demo_capture, tmp_path / "b", *given, "--without", "47.png"), 2)
    assert "--without '47.png' is no image of the capture" in err


def test_tracks_of_one_view_go_with_the_others(demo_run: Path) -> None:
    model = read_model(demo_run / "sparse")
    fewer, kept, points = without_views(model, {"003.png"})
    assert (~kept).sum() == 1
    assert [view.name for view in fewer.views] == [
        view.name for view in model.views if view.name != "003.png"
    ]
    assert fewer.unregistered == ("003.png",)
    counts = np.bincount(fewer.tracks.obs_track)
    assert counts.min() >= 2
    assert len(counts) == points.sum() < len(points)
    # The same places are seen by the same cameras.
    before = {
        (model.tracks.point3D_ids[t], model.views[v].name)
        for t, v in zip(model.tracks.obs_track, model.tracks.obs_view, strict=True)
    }
    after = {
        (fewer.tracks.point3D_ids[t], fewer.views[v].name)
        for t, v in zip(fewer.tracks.obs_track, fewer.tracks.obs_view, strict=True)
    }
    assert after <= before
