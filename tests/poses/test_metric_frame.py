"""Metric frame from known cameras and distances, and the model in another frame."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

import polmvs
from polmvs.camera import PinholeCamera
from polmvs.config import ReferenceOptions
from polmvs.errors import DataError, OptionError
from polmvs.geometry import RigidTransform, SimilarityTransform
from polmvs.poses.metric_frame import (
    Frame,
    frame_from_centers,
    metric_frame,
    read_centers,
    require_agreement,
    transform_model,
)
from polmvs.scene import SparseModel, Tracks, View, find_name, match_names
from polmvs.synthetic.captures import ring_of_views

Array = NDArray[np.float64]

CAMERA = PinholeCamera(width=320, height=240, fx=330.0, fy=330.0, cx=160.0, cy=120.0)
NUM_POINTS = 20
WORLD_FROM_METRIC = SimilarityTransform(
    7.0, Rotation.from_rotvec([0.3, -2.0, 0.7]).as_matrix(), np.array([5.0, -3.0, 11.0])
)
METRIC_FROM_WORLD = SimilarityTransform(
    1 / 7.0,
    WORLD_FROM_METRIC.rotation.T,
    -WORLD_FROM_METRIC.rotation.T @ WORLD_FROM_METRIC.translation / 7.0,
)
DEMO_CAMERAS = Path(polmvs.__file__).parent / "demo_capture" / "gt" / "cameras.json"


def metric_model(num_views: int = 8) -> SparseModel:
    """Cameras about a cloud of points that all of them see, metres."""
    lower = ring_of_views(num_views, CAMERA, distance=0.5, elevation_deg=40)
    upper = ring_of_views(num_views, CAMERA, distance=0.6, elevation_deg=60)
    views = [upper[k] if k % 2 else lower[k] for k in range(num_views)]
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (NUM_POINTS, 3))
    xy = np.array([v.camera.project(v.cam_from_world * points) for v in views])
    tracks = Tracks(
        point3D_ids=np.arange(100, 100 + NUM_POINTS),
        points_in_world=points,
        colors=np.zeros((NUM_POINTS, 3), np.uint8),
        errors=np.full(NUM_POINTS, 0.3),
        obs_track=np.tile(np.arange(NUM_POINTS), num_views),
        obs_view=np.repeat(np.arange(num_views), NUM_POINTS),
        obs_xy=xy.reshape(-1, 2),
    )
    return SparseModel(views=tuple(views), tracks=tracks, unregistered=("lost.png",))


METRIC = metric_model()
CENTERS = {view.name: view.center_in_world for view in METRIC.views}
WORLD = transform_model(METRIC, WORLD_FROM_METRIC)


def frame_of(**options: object) -> Frame:
    """Metric frame of the scrambled model; no image is needed."""
    frame = metric_frame(WORLD, ReferenceOptions(**options), lambda name: pytest.fail(name))
    assert frame is not None
    return frame


def write(path: Path, content: object) -> Path:
    path.write_text(content if isinstance(content, str) else json.dumps(content))
    return path


def pose_list(view: View) -> list[list[float]]:
    pose = view.cam_from_world
    return np.column_stack([pose.rotation, pose.translation]).tolist()


def as_lists(centers: dict[str, Array]) -> dict[str, list[float]]:
    return {name: center.tolist() for name, center in centers.items()}


def as_text(centers: dict[str, Array]) -> str:
    lines = [f"{name} {x:.17g} {y:.17g} {z:.17g}" for name, (x, y, z) in centers.items()]
    return "# name x y z\n\n" + "\n".join(lines) + "\n"


def test_round_trip_of_a_model() -> None:
    again = transform_model(WORLD, METRIC_FROM_WORLD)
    for one, two, scrambled in zip(METRIC.views, again.views, WORLD.views, strict=True):
        rotation = scrambled.cam_from_world.rotation
        np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(rotation) > 0
        np.testing.assert_allclose(two.center_in_world, one.center_in_world, atol=1e-12)
        np.testing.assert_allclose(
            scrambled.center_in_world, WORLD_FROM_METRIC * one.center_in_world, atol=1e-12
        )
        np.testing.assert_allclose(
            two.cam_from_world.rotation, one.cam_from_world.rotation, atol=1e-12
        )
    np.testing.assert_allclose(
        again.tracks.points_in_world, METRIC.tracks.points_in_world, atol=1e-12
    )


def test_pixels_stay_where_they_are() -> None:
    assert WORLD.tracks.obs_xy is METRIC.tracks.obs_xy
    for k, view in enumerate(WORLD.views):
        seen = view.camera.project(view.cam_from_world * WORLD.tracks.points_in_world)
        np.testing.assert_allclose(seen, METRIC.tracks.obs_xy[METRIC.tracks.obs_view == k])
    assert WORLD.unregistered == METRIC.unregistered


def test_every_form_of_file_gives_the_true_frame(tmp_path: Path) -> None:
    files = [
        write(
            tmp_path / "a.json", {"images": {n: {"center": list(c)} for n, c in CENTERS.items()}}
        ),
        write(
            tmp_path / "b.json",
            {"images": {v.name: {"cam_from_world": pose_list(v)} for v in METRIC.views}},
        ),
        write(tmp_path / "c.json", as_lists(CENTERS)),
        write(tmp_path / "d.txt", as_text(CENTERS)),
        write(
            tmp_path / "e.txt", as_text({f"raw/{Path(n).stem}.tif": c for n, c in CENTERS.items()})
        ),
    ]
    for path in files:
        frame = frame_of(reference=path)
        assert frame.source == "reference"
        assert (frame.num_used, frame.dropped, frame.checked_by) == (8, (), ())
        assert frame.scale == pytest.approx(1 / 7, rel=1e-9)
        assert frame.rms_residual < 1e-9
        assert frame.relative_sigma < 1e-9
        transform = frame.metric_from_world
        np.testing.assert_allclose(transform.rotation, METRIC_FROM_WORLD.rotation, atol=1e-9)
        np.testing.assert_allclose(transform.translation, METRIC_FROM_WORLD.translation, atol=1e-9)


def test_true_cameras_of_a_capture_are_read() -> None:
    centers = read_centers(DEMO_CAMERAS)
    pose = np.array(json.loads(DEMO_CAMERAS.read_text())["images"]["000.png"]["cam_from_world"])
    np.testing.assert_allclose(pose[:, :3] @ centers["000.png"] + pose[:, 3], 0, atol=1e-9)


def test_standard_deviation_is_that_of_repeated_noise() -> None:
    rng = np.random.default_rng(0)
    frames = [
        frame_from_centers(
            WORLD, {n: c + rng.normal(0, 2e-3, 3) for n, c in CENTERS.items()}, "test"
        )
        for _ in range(200)
    ]
    # 200 draws tell a standard deviation to 5 %; the bound is three times that.
    spread = np.std([7 * frame.scale for frame in frames])
    assert np.mean([frame.relative_sigma for frame in frames]) == pytest.approx(spread, rel=0.15)


def test_wrong_camera_is_dropped() -> None:
    centers = CENTERS | {"003.png": CENTERS["003.png"] + [0.0, 0.3, 0.1]}
    frame = frame_from_centers(WORLD, centers, "test")
    assert frame.dropped == ("003.png",)
    assert frame.num_used == 7
    assert frame.scale == pytest.approx(1 / 7, rel=1e-9)


def test_distance_between_cameras_and_points() -> None:
    first, second = CENTERS["000.png"], METRIC.tracks.points_in_world[4]
    cases = [
        ("000.png", "003.png", np.linalg.norm(CENTERS["003.png"] - first)),
        ("000", "raw/003.tif", np.linalg.norm(CENTERS["003.png"] - first)),
        ("000.png", "104", np.linalg.norm(second - first)),
        ("104", "110", np.linalg.norm(METRIC.tracks.points_in_world[10] - second)),
    ]
    for a, b, distance in cases:
        frame = frame_of(scale=(a, b, float(distance)))
        assert frame.source == "scale"
        assert frame.scale == pytest.approx(1 / 7, rel=1e-9)
        assert (frame.relative_sigma is not None) == (a == "104")
        np.testing.assert_array_equal(frame.metric_from_world.rotation, np.eye(3))


def test_uncertainty_of_a_distance_has_no_unit() -> None:
    distance = float(np.linalg.norm(np.diff(METRIC.tracks.points_in_world[[4, 10]], axis=0)))
    options = ReferenceOptions(scale=("104", "110", distance))
    frames = [metric_frame(model, options, lambda _: None) for model in (METRIC, WORLD)]
    sigmas = [frame.relative_sigma for frame in frames if frame is not None]
    assert sigmas[0] == pytest.approx(sigmas[1], rel=1e-9)
    assert 1e-4 < sigmas[0] < 0.05


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (("000.png", "nobody.png", 1.0), "nobody.png, which is neither a .* image .*000.png"),
        (("000.png", "999", 1.0), "999, which is neither"),
        (("000.png", "-1", 1.0), "-1, which is neither"),
        (("lost.png", "000.png", 1.0), "image lost.png, which has no pose"),
        (("000.png", "000", 1.0), "at one place"),
    ],
)
def test_bad_ends_of_a_distance(scale: tuple[str, str, float], message: str) -> None:
    with pytest.raises(OptionError, match=message):
        frame_of(scale=scale)


@pytest.mark.parametrize(
    "options",
    [
        {"scale": ("a", "a", 1.0)},
        {"scale": ("a", "b", 0.0)},
        {"scale": ("a", "b", -1.0)},
        {"scale": ("a", "b", float("nan"))},
        {"scale": ("a", "b", float("inf"))},
        {"aruco": "DICT_4X4_50"},
        {"aruco": "DICT_4X4_50:-0.05"},
        {"aruco": "DICT_4X4_50:0"},
        {"aruco": "DICT_4X4_50:nan"},
        {"aruco": "DICT_4X4_50:5cm"},
        {"aruco": ":0.05"},
    ],
)
def test_malformed_options(options: dict[str, object]) -> None:
    with pytest.raises(OptionError, match=r"reference\."):
        ReferenceOptions(**options)


def test_unknown_dictionary_is_refused_before_anything_else() -> None:
    options = ReferenceOptions(aruco="DICT_9X9_7:0.05", scale=("000", "001", 1.0))
    with pytest.raises(OptionError, match="unknown dictionary"):
        metric_frame(WORLD, options, {}.__getitem__)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "cannot be read as JSON"),
        ("a.json", "[1, 2]", "must map image names"),
        ("a.json", "{}", "names no camera"),
        ("a.json", '{"images": [1]}', "must map image names"),
        ("a.json", '{"a": [0, 1]}', "a needs 3 numbers"),
        ("a.json", '{"a": [0, 1, "x"]}', "a needs 3 numbers"),
        ("a.json", '{"a": [0, 1, NaN]}', "a has a number that is not finite"),
        ("a.json", '{"a": [0, 1, 2], "a": [0, 1, 3]}', "'a' occurs twice"),
        ("a.json", '{"images": {"a": {"place": [0, 1, 2]}}}', "neither center nor"),
        ("a.json", '{"images": {"a": {"cam_from_world": [[1, 0], [0, 1]]}}}', "3x4 numbers"),
        (
            "a.json",
            '{"images": {"a": {"cam_from_world": [[2,0,0,0], [0,1,0,0], [0,0,1,0]]}}}',
            "no rigid motion",
        ),
        ("a.txt", "a 1 2\n", "line 1 is not of the form: name x y z"),
        ("a.txt", "# c\na 1 2 x\n", "line 2 needs 3 numbers"),
        ("a.txt", "a 1 2 inf\n", "line 1 has a number that is not finite"),
        ("a.txt", "a 1 2 3\na 1 2 4\n", "line 2 names a a second time"),
        ("a.txt", "", "names no camera"),
        ("a.csv", "a 1 2 3\n", r"neither \.json nor \.txt"),
        ("a.txt", b"\xff\xfe\x00", "it is no text"),
    ],
)
def test_malformed_file(tmp_path: Path, name: str, content: str | bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    with pytest.raises(DataError, match=message):
        read_centers(path)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="No such file"):
        metric_frame(WORLD, ReferenceOptions(reference=tmp_path / "none.txt"), {}.__getitem__)


def test_too_few_names_match() -> None:
    some = dict(list(CENTERS.items())[:2])
    with pytest.raises(DataError, match="knows 2 of the 8 reconstructed images"):
        frame_from_centers(WORLD, some | {"x.png": np.zeros(3)}, "test")
    with pytest.raises(DataError, match=r"knows 0 of the 8 .* like 'IMG000.png', the images' like"):
        frame_from_centers(WORLD, {f"IMG{n}": c for n, c in CENTERS.items()}, "test")


@pytest.mark.parametrize("wobble", [0.0, 1e-4])
def test_cameras_on_a_line(wobble: float) -> None:
    """Also when noise hides it: 0.1 mm beside a line of 0.7 m tells no rotation."""
    rng = np.random.default_rng(0)
    line = {n: np.array([0.1 * k, 0.2, 0.3]) for k, n in enumerate(CENTERS)}
    known = {n: c + rng.normal(0, wobble, 3) for n, c in line.items()}
    views = [
        replace(v, cam_from_world=RigidTransform(np.eye(3), -known[v.name])) for v in METRIC.views
    ]
    model = replace(METRIC, views=tuple(views))
    for centers in (line, known):
        with pytest.raises(DataError, match="lie on one line"):
            frame_from_centers(model, centers, "test")
    with pytest.raises(DataError, match="lie on one line"):
        frame_from_centers(WORLD, line, "test")
    with pytest.raises(DataError, match="in one place"):
        frame_from_centers(WORLD, dict.fromkeys(CENTERS, np.ones(3)), "test")


def test_cameras_on_a_narrow_band() -> None:
    """Nine hundredths as broad as long: enough to tell the rotation about its length."""
    known = {n: np.array([0.1 * k, 0.02 * (-1) ** k, 0.3]) for k, n in enumerate(CENTERS)}
    views = [
        replace(v, cam_from_world=RigidTransform(np.eye(3), -known[v.name])) for v in METRIC.views
    ]
    double = {name: 2 * center for name, center in known.items()}
    frame = frame_from_centers(replace(METRIC, views=tuple(views)), double, "test")
    assert frame.metric_from_world.scale == pytest.approx(2)
    np.testing.assert_allclose(frame.metric_from_world.rotation, np.eye(3), atol=1e-9)


def test_centres_that_do_not_fit() -> None:
    names = list(CENTERS)
    shuffled = dict(zip(names, [CENTERS[n] for n in names[3:] + names[:3]][::-1], strict=True))
    mirrored = {n: c * [1.0, 1.0, -1.0] for n, c in CENTERS.items()}
    scattered = {n: np.random.default_rng(k).normal(size=3) for k, n in enumerate(names)}
    for centers in (shuffled, mirrored, scattered):
        with pytest.raises(DataError, match="do not fit"):
            frame_from_centers(WORLD, centers, "test")


def test_names() -> None:
    names = ["a/0.png", "b/0.png", "1.png"]
    assert find_name("a/0.png", names) == "a/0.png"
    assert find_name("1.tif", names) == "1.png"
    assert find_name("0.png", names) is None
    assert match_names(names, ["0.png", "1.tif"]) == {"1.png": "1.tif"}
    assert match_names(names, names) == {name: name for name in names}


def test_sources_that_agree_and_that_do_not(tmp_path: Path) -> None:
    path = write(tmp_path / "centers.json", as_lists(CENTERS))
    distance = float(np.linalg.norm(CENTERS["003.png"] - CENTERS["000.png"]))
    frame = frame_of(reference=path, scale=("000", "003", 1.005 * distance))
    assert frame.source == "reference"
    assert frame.checked_by == (("scale", pytest.approx(1.005 / 7)),)
    message = "gives a scale of 0.142857 m per unit but `reference.scale` 0.145714"
    with pytest.raises(OptionError, match=message):
        frame_of(reference=path, scale=("000", "003", 1.02 * distance))


def test_uncertain_sources_may_differ_more() -> None:
    first = frame_from_centers(WORLD, CENTERS, "test")
    wide = SimilarityTransform(1.02 / 7, np.eye(3), np.zeros(3))
    other = replace(first, metric_from_world=wide, source="aruco", relative_sigma=0.006)
    require_agreement(first, other)
    with pytest.raises(OptionError, match=r"reference\.aruco"):
        require_agreement(first, replace(other, relative_sigma=0.004))


def test_nothing_given() -> None:
    assert metric_frame(WORLD, ReferenceOptions(), lambda name: pytest.fail(name)) is None
