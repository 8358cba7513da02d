"""A run with wrong cameras says so, and which would fit; one with right ones says nothing."""

from dataclasses import replace
from pathlib import Path

import pytest

from polmvs.colmap.models import write_model
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
