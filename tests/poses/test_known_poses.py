from __future__ import annotations

import importlib.util
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scenes import CAMERA, tracks_at
from scipy.spatial.transform import Rotation

from polmvs.colmap.models import read_model, write_model
from polmvs.errors import DataError, OptionError
from polmvs.geometry import RigidTransform
from polmvs.io.ground_truth import write_views
from polmvs.poses.known_poses import retriangulate, with_known_poses, write_known_poses
from polmvs.scene import SparseModel, Tracks, View
from polmvs.synthetic.captures import ring_of_views

VIEWS = ring_of_views(6, CAMERA, target=np.zeros(3), distance=0.5, elevation_deg=45, roll_deg=20)


class Scene:
    """What ``tracks_at`` asks for."""

    views = VIEWS


def some_points(num: int, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform(-0.08, 0.08, (num, 3))


def without_points(tracks: Tracks) -> Tracks:
    """The tracks with points and errors that do not matter."""
    nowhere = np.full_like(tracks.points_in_world, 9.0)
    return replace(tracks, points_in_world=nowhere, errors=np.full(len(nowhere), 9.0))


def disturbed(views: list[View]) -> tuple[View, ...]:
    """Views of another world with errors of their poses."""
    rng, result = np.random.default_rng(1), []
    for view in views:
        turn = Rotation.from_rotvec(rng.normal(0, 0.01, 3)).as_matrix()
        rotation = turn @ view.cam_from_world.rotation
        shift = 7 * view.cam_from_world.translation + rng.normal(0, 0.02, 3)
        result.append(replace(view, cam_from_world=RigidTransform(rotation, shift)))
    return tuple(result)


def model_of(tracks: Tracks) -> SparseModel:
    return SparseModel(views=disturbed(VIEWS), tracks=without_points(tracks), unregistered=())


def known_views() -> dict[str, View]:
    return {view.name: view for view in VIEWS}


def test_points_are_exact() -> None:
    points = some_points(50)
    full = tracks_at(Scene, points)
    # Tracks of 2 to 6 observations, in an order of their own.
    kept = full.obs_view < 2 + full.obs_track % 5
    order = np.random.default_rng(2).permutation(np.flatnonzero(kept))
    tracks = replace(
        full,
        obs_track=full.obs_track[order],
        obs_view=full.obs_view[order],
        obs_xy=full.obs_xy[order],
        point3D_ids=full.point3D_ids + 100,
    )
    found = retriangulate(VIEWS, without_points(tracks))
    np.testing.assert_array_equal(found.point3D_ids, tracks.point3D_ids)
    np.testing.assert_allclose(found.points_in_world, points, atol=1e-12)
    assert found.errors.max() < 1e-9
    np.testing.assert_array_equal(found.obs_xy, tracks.obs_xy)


def test_known_poses_replace_those_of_the_model() -> None:
    points = some_points(30)
    model = with_known_poses(model_of(tracks_at(Scene, points)), known_views())
    np.testing.assert_allclose(model.tracks.points_in_world, points, atol=1e-12)
    assert model.views == tuple(VIEWS)


@pytest.mark.parametrize("views", [[0], [2, 2]])
def test_track_seen_from_one_place_is_dropped(views: list[int]) -> None:
    once = tracks_at(Scene, some_points(1), views)
    assert len(retriangulate(VIEWS, once).point3D_ids) == 0
    twice = tracks_at(Scene, some_points(1), [0, 3])
    assert len(retriangulate(VIEWS, twice).point3D_ids) == 1


def test_track_without_observations_is_dropped() -> None:
    tracks = tracks_at(Scene, some_points(3))
    kept = tracks.obs_track != 1
    tracks = replace(
        tracks,
        obs_track=tracks.obs_track[kept],
        obs_view=tracks.obs_view[kept],
        obs_xy=tracks.obs_xy[kept],
    )
    found = retriangulate(VIEWS, tracks)
    np.testing.assert_array_equal(found.point3D_ids, [0, 2])
    np.testing.assert_array_equal(np.unique(found.obs_track), [0, 1])


@pytest.mark.parametrize(("shift_px", "num"), [(1.0, 2), (40.0, 1)])
def test_wrong_match_is_dropped(shift_px: float, num: int) -> None:
    tracks = tracks_at(Scene, some_points(2))
    tracks.obs_xy[np.flatnonzero(tracks.obs_track == 1)[0]] += shift_px
    found = retriangulate(VIEWS, tracks)
    assert len(found.point3D_ids) == num
    assert np.all(found.errors < 2)


def test_point_behind_the_cameras_is_dropped() -> None:
    """Rays that diverge before the cameras meet behind them, without any error in the image."""
    a = View(name="a", camera=CAMERA, cam_from_world=RigidTransform(np.eye(3), np.zeros(3)))
    b = replace(a, cam_from_world=RigidTransform(np.eye(3), np.array([-0.1, 0.0, 0.0])))
    xy = np.array([[80.0, 64.0], [80 + 0.1 * 120 / 0.5, 64.0]])  # meet at z = -0.5
    tracks = Tracks(
        point3D_ids=np.array([1]),
        points_in_world=np.zeros((1, 3)),
        colors=np.zeros((1, 3), np.uint8),
        errors=np.zeros(1),
        obs_track=np.array([0, 0]),
        obs_view=np.array([0, 1]),
        obs_xy=xy,
    )
    assert len(retriangulate([a, b], tracks).point3D_ids) == 0
    crossed = replace(tracks, obs_xy=np.array([[80.0, 64.0], [80 - 0.1 * 120 / 0.5, 64.0]]))
    np.testing.assert_allclose(
        retriangulate([a, b], crossed).points_in_world, [[0, 0, 0.5]], atol=1e-12
    )


def test_names_must_match() -> None:
    model = model_of(tracks_at(Scene, some_points(5)))
    strangers = {f"x{name}": view for name, view in known_views().items()}
    with pytest.raises(DataError, match=r"rig\.json: knows 0 of the 6 images.*'x000.png'"):
        with_known_poses(model, strangers, source="rig.json")
    one = {"000.png": VIEWS[0]}
    with pytest.raises(DataError, match="knows 1 of the 6 images"):
        with_known_poses(model, one)
    with pytest.raises(DataError, match="knows 0 of the 6 images"):
        with_known_poses(model, {})


def test_some_known_names_of_another_suffix_at_half_the_size() -> None:
    points = some_points(20)
    model = model_of(tracks_at(Scene, points))
    known = {}
    for view in VIEWS[:4]:
        camera = replace(CAMERA, width=80, height=64, fx=60.0, fy=60.0, cx=40.0, cy=32.0)
        name = view.name.replace(".png", ".tif")
        known[name] = replace(view, name=name, camera=camera)
    found = with_known_poses(model, known)
    assert [view.name for view in found.views] == list(known)
    np.testing.assert_allclose(found.tracks.points_in_world, points, atol=1e-12)


def test_inverted_poses_are_told() -> None:
    model = model_of(tracks_at(Scene, some_points(20)))
    wrong = {
        n: replace(v, cam_from_world=v.cam_from_world.inverse()) for n, v in known_views().items()
    }
    with pytest.raises(DataError, match="none of the model's 20 tracks fits"):
        with_known_poses(model, wrong)


@pytest.fixture
def files(tmp_path: Path) -> tuple[Path, Path]:
    """A COLMAP model and a ``cameras.json``."""
    write_model(model_of(tracks_at(Scene, some_points(20))), tmp_path / "sparse")
    write_views(tmp_path / "cameras.json", VIEWS)
    return tmp_path / "sparse", tmp_path / "cameras.json"


def test_files(files: tuple[Path, Path], tmp_path: Path) -> None:
    sparse, cameras = files
    before = {path.name: path.read_bytes() for path in sparse.iterdir()}
    write_known_poses(sparse, cameras, tmp_path / "new")
    model = read_model(tmp_path / "new")
    np.testing.assert_allclose(model.tracks.points_in_world, some_points(20), atol=1e-9)
    for view, true in zip(model.views, VIEWS, strict=True):
        np.testing.assert_allclose(view.center_in_world, true.center_in_world, atol=1e-9)
    assert {path.name: path.read_bytes() for path in sparse.iterdir()} == before


def test_existing_model_is_not_replaced(files: tuple[Path, Path], tmp_path: Path) -> None:
    new = tmp_path / "new"
    new.mkdir()
    (new / "mine.txt").write_text("mine")
    with pytest.raises(OptionError, match="exists"):
        write_known_poses(*files, new)
    assert [path.name for path in new.iterdir()] == ["mine.txt"]


def test_script(
    files: tuple[Path, Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    path = Path(__file__).parents[2] / "pipelines" / "known_poses.py"
    spec = importlib.util.spec_from_file_location("pipelines_known_poses", path)
    assert spec is not None
    assert spec.loader is not None
    script = importlib.util.module_from_spec(spec)
    monkeypatch.setitem(sys.modules, spec.name, script)  # dataclasses look their module up
    spec.loader.exec_module(script)
    arguments = [*map(str, files), str(tmp_path / "new")]
    assert script.main(arguments) == 0
    assert "6 views, 20 points" in capsys.readouterr().out
    assert script.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert "exists" in captured.err
    files[1].write_text("{}")
    assert script.main([*arguments[:2], str(tmp_path / "other")]) == 1
    assert "cameras.json: needs integer width" in capsys.readouterr().err
    assert not (tmp_path / "other").exists()
