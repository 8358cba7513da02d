"""A run with wrong cameras says so, and which would fit; one with right ones says nothing."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from polmvs.colmap.models import write_model
from polmvs.evaluation.trust import Trust
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.runner import load_record
from polmvs.polarization.kinds import AngleModel
from polmvs.scene import SparseModel
from polmvs.synthetic.printed import orbit_views
from polmvs.synthetic.printed_capture import (
    Part,
    camera_of,
    printed_model,
    scene_of,
    write_printed_capture,
)


@pytest.fixture(scope="module")
def given(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, SparseModel]:
    folder = tmp_path_factory.mktemp("wrong") / "capture"
    views, scene = orbit_views(6, camera_of(128)), scene_of(Part.BOARD)
    write_printed_capture(folder, views, scene)
    return folder, printed_model(scene, views, num_points=400)


@pytest.mark.parametrize("factor", [1.0, 1.1])
def test_the_focal_length_of_a_model(cli, given, tmp_path: Path, factor: float) -> None:
    capture, model = given
    camera = model.views[0].camera
    wrong = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    views = tuple(replace(view, camera=wrong) for view in model.views)
    write_model(replace(model, views=views), tmp_path / "model")
    status, out, err = cli(
        "sfm", capture, tmp_path / "out", "--sparse", tmp_path / "model", "--json"
    )
    assert status == 0, err
    told = [f"a focal length of {camera.fx:.0f}" in out, "fit the matches, not the given" in out]
    assert told == [factor != 1] * 2, out
    if factor != 1:
        assert f"{wrong.fx:.1f} px" in out
        assert "leave --sparse out" in out or "leave `sfm.sparse` out" in out


@pytest.mark.slow
@pytest.mark.parametrize("factor", [1.0, 1.1])
def test_phases_find_a_wrong_focal_length(cli, tmp_path: Path, factor: float) -> None:
    """They need no matches: of each track one observation is left."""
    views, scene = orbit_views(10, camera_of(160)), scene_of(Part.DOME)
    write_printed_capture(tmp_path / "capture", views, scene)
    model = printed_model(scene, views, num_points=400)
    camera, tracks = views[0].camera, model.tracks
    wrong = replace(camera, fx=factor * camera.fx, fy=factor * camera.fy)
    _, first = np.unique(tracks.obs_track, return_index=True)
    kept = {name: getattr(tracks, name)[first] for name in ("obs_track", "obs_view", "obs_xy")}
    views = tuple(replace(view, camera=wrong) for view in model.views)
    once = replace(model, views=views, tracks=replace(tracks, **kept))
    write_model(once, tmp_path / "model")
    out = tmp_path / "out"
    capture, given = tmp_path / "capture", tmp_path / "model"
    status, said, err = cli("reconstruct", capture, out, "--sparse", given, "--no-mesh")
    assert status == 0, err
    trust = load_record(RunFolder(out)).result(Trust, AngleModel.PPA)
    told = ["fit the phases of the surface" in complaint for complaint in trust.complaints]
    assert told == [True] * (factor != 1), said
