"""What SfM says of a camera that it estimates, and what a run says of too few views."""

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from polmvs.colmap.camera_uncertainty import CameraUncertainty
from polmvs.pipeline import jobs
from polmvs.pipeline.stages import sfm
from polmvs.pipeline.stages.densify import DensifyResult
from polmvs.pipeline.stages.maps import MapsResult
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.pipeline.stages.seeds import SeedsResult
from polmvs.scene import SparseModel
from polmvs.synthetic.printed import orbit_views
from polmvs.synthetic.printed_capture import Part, camera_of, printed_model, scene_of


@pytest.fixture(scope="module")
def model() -> SparseModel:
    return printed_model(scene_of(Part.BOARD), orbit_views(6, camera_of(128)), num_points=50)


def found(
    model: SparseModel,
    uncertainty: CameraUncertainty | None,
    folder: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> sfm.SfmResult:
    """The result of an SfM that finds this model and uncertainty."""

    def find(images: Path, names: Any, work: Path, new: Path, *rest: Any) -> SparseModel:
        new.mkdir()
        return model

    monkeypatch.setattr(sfm, "_find_apart", find)
    monkeypatch.setattr(sfm, "camera_uncertainty", lambda _: uncertainty)
    monkeypatch.setattr(sfm, "pose_uncertainty", lambda _: None)
    return sfm.find_model(folder, [view.name for view in model.views], folder / "sparse")


def of_share(model: SparseModel, share: float) -> CameraUncertainty:
    """Two modes that together move each point by a share of its distance from the nearest view."""
    points = model.tracks.points_in_world
    distance = np.min([view.ranges(points) for view in model.views], axis=0)
    modes = np.zeros((2, len(points), 3))
    modes[0, :, 0], modes[1, :, 2] = 0.6 * share * distance, 0.8 * share * distance
    return CameraUncertainty(focal=0.04, modes=modes)


def test_a_camera_without_a_known_uncertainty_is_said_nothing_of(
    model, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    result = found(model, None, tmp_path, monkeypatch)
    assert (result.focal_sigma, result.bending) == (None, None)
    assert "do not fix the camera" not in caplog.text


@pytest.mark.parametrize("share", [0.9, 1.1])
def test_views_that_do_not_fix_the_camera_are_named(
    model,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    share: float,
) -> None:
    share *= sfm.LARGE_BENDING
    result = found(model, of_share(model, share), tmp_path, monkeypatch)
    assert result.focal_sigma == pytest.approx(0.04)
    assert result.bending == pytest.approx(share)
    assert ("do not fix the camera" in caplog.text) == (share > sfm.LARGE_BENDING)


@pytest.mark.parametrize(
    ("num_region_px", "min_views", "num_seeds", "reason"),
    [
        (0, 2, 0, jobs.NO_REGION),
        (0, 9, 5, jobs.NO_REGION),
        (100, 7, 5, jobs.TOO_MANY_VIEWS),
        (100, 6, 5, jobs.NO_POINTS),
        (100, 6, 0, jobs.NO_SEEDS),
    ],
)
def test_why_there_is_no_point(
    num_region_px: int, min_views: int, num_seeds: int, reason: str
) -> None:
    """Six views have a pose."""
    results: dict[type, Any] = {
        DensifyResult: SimpleNamespace(num_points=0),
        SeedsResult: SimpleNamespace(num_seeds=num_seeds),
        MapsResult: SimpleNamespace(num_region_px=num_region_px),
        PosesResult: SimpleNamespace(num_views=6),
    }
    run = SimpleNamespace(
        save=lambda finished: None,
        record=SimpleNamespace(result=lambda kind, model=None: results[kind]),
        options=SimpleNamespace(fusion=SimpleNamespace(min_views=min_views)),
        run_folder=None,
    )
    assert jobs._close(run, ["ppa"]).empty == reason  # type: ignore[arg-type, list-item]
