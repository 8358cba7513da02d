"""The metric frame as a user asks for it: files of known cameras, markers, a known distance."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers import cut_after, record_of, refused, result_of, stages_of

from polmvs.cli import main
from polmvs.colmap.models import read_model
from polmvs.io.ground_truth import open_ground_truth

# The capture's poses are good to 0.35 mm (design notes, section 5).
CENTER_TOLERANCE_M = 0.001


@pytest.fixture(scope="module")
def posed(demo_run: Path, demo_capture: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """``sfm`` with the model of the finished run."""
    folder = tmp_path_factory.mktemp("posed") / "out"
    flags = ("--sparse", demo_run / "sparse")
    assert main(list(map(str, ["sfm", demo_capture, folder, *flags]))) == 0
    return folder


@pytest.fixture
def out(posed: Path, tmp_path: Path) -> Path:
    """A run that has images and a model, and no frame yet."""
    return begun(posed, tmp_path / "out", "images", "sfm")


def begun(run: Path, out: Path, *stages: str) -> Path:
    """A copy of the run's first stages, which have folders of their names."""
    for stage in stages:
        shutil.copytree(run / stage, out / stage)
    shutil.copy(run / "run.json", out)
    cut_after(out, stages[-1])
    return out


@pytest.fixture
def take_poses(cli, demo_run: Path, demo_capture: Path, out: Path):
    """``sfm`` goes on with the poses of the finished run, and what is given."""

    def call(*flags: object) -> tuple[int, str, str]:
        return cli("sfm", demo_capture, out, "--resume", "--sparse", demo_run / "sparse", *flags)

    return call


@pytest.fixture
def refuses(cli, demo_run: Path, demo_capture: Path, tmp_path: Path):
    """``reconstruct``, which must fail in one line before it writes anything."""

    def call(*flags: object, status: int = 1) -> str:
        target = tmp_path / "new"
        given = ("--sparse", demo_run / "sparse", *flags)
        err = refused(cli("reconstruct", demo_capture, target, *given), status)
        assert not target.exists()
        return err

    return call


@pytest.fixture(scope="module")
def true_centers(demo_capture: Path) -> dict[str, np.ndarray]:
    views = open_ground_truth(demo_capture).views
    return {name: view.center_in_world for name, view in views.items()}


def cameras_file(demo_capture: Path) -> Path:
    return demo_capture / "gt" / "cameras.json"


def write_lines(path: Path, centers: dict[str, np.ndarray]) -> Path:
    rows = (f"{name} {x:.9f} {y:.9f} {z:.9f}" for name, (x, y, z) in centers.items())
    path.write_text("# name x y z\n" + "\n".join(rows) + "\n")
    return path


def center_errors_m(out: Path, true_centers: dict[str, np.ndarray]) -> np.ndarray:
    views = read_model(out / "sparse").views
    assert len(views) == len(true_centers)
    return np.array(
        [np.linalg.norm(view.center_in_world - true_centers[view.name]) for view in views]
    )


def distance_in(model_folder: Path, first: str, second: str) -> float:
    centers = {view.name: view.center_in_world for view in read_model(model_folder).views}
    return float(np.linalg.norm(centers[first] - centers[second]))


# Known cameras


def test_reference_brings_the_model_into_the_true_frame(
    take_poses, out: Path, demo_run: Path, demo_capture: Path, true_centers
) -> None:
    assert center_errors_m(demo_run, true_centers).min() > 0.1  # SfM's own frame is another
    status, text, err = take_poses("--reference", cameras_file(demo_capture))
    assert (status, err) == (0, "")
    assert "10 of 10 views" in text
    assert center_errors_m(out, true_centers).max() < CENTER_TOLERANCE_M
    frame = result_of(out, "poses")["frame"]
    assert (frame["source"], frame["num_used"], frame["dropped"]) == ("reference", 10, [])
    ends = ("000.png", "004.png")
    ratio = distance_in(out / "sparse", *ends) / distance_in(demo_run / "sparse", *ends)
    assert frame["scale"] == pytest.approx(ratio, rel=1e-6)
    assert frame["rms_residual"] < CENTER_TOLERANCE_M


def test_given_model_and_reference_stay_as_they_are(
    take_poses, demo_run: Path, demo_capture: Path
) -> None:
    files = [*(demo_run / "sparse").iterdir(), cameras_file(demo_capture)]
    before = [path.read_bytes() for path in files]
    assert take_poses("--reference", cameras_file(demo_capture))[0] == 0
    assert [path.read_bytes() for path in files] == before


def test_reference_as_text_by_stem_and_with_one_that_is_wrong(
    take_poses, out: Path, tmp_path: Path, true_centers
) -> None:
    centers = {Path(name).stem: center for name, center in true_centers.items()}
    centers["003"] = centers["003"] + (0.0, 0.1, 0.0)
    status, _, err = take_poses("--reference", write_lines(tmp_path / "cameras.txt", centers))
    assert (status, err) == (0, "")
    assert center_errors_m(out, true_centers).max() < CENTER_TOLERANCE_M
    frame = result_of(out, "poses")["frame"]
    assert (frame["source"], frame["dropped"]) == ("reference", ["003.png"])


def test_reference_from_a_config_file(
    take_poses, out: Path, tmp_path: Path, demo_capture: Path, true_centers
) -> None:
    config = tmp_path / "polmvs.toml"
    config.write_text(f"[reference]\nreference = {json.dumps(str(cameras_file(demo_capture)))}\n")
    assert take_poses("--config", config)[0] == 0
    assert center_errors_m(out, true_centers).max() < CENTER_TOLERANCE_M
    assert record_of(out)["options"]["reference"]["reference"] == str(cameras_file(demo_capture))


def test_reference_of_too_few_cameras(
    cli, posed: Path, demo_run: Path, demo_capture: Path, tmp_path: Path, true_centers
) -> None:
    out = begun(posed, tmp_path / "out", "images")
    two = {name: true_centers[name] for name in ("000.png", "001.png")}
    flags = ("--sparse", demo_run / "sparse", "--reference", write_lines(tmp_path / "two.txt", two))
    err = refused(cli("sfm", demo_capture, out, "--resume", *flags))
    assert "two.txt: knows 2 of the 10 images by name, 3 are needed" in err
    assert not (out / "sparse").exists()
    assert stages_of(out) == ["images"]


def test_reference_of_other_names(take_poses, tmp_path: Path, true_centers) -> None:
    others = {f"IMG_{name}": center for name, center in true_centers.items()}
    err = refused(take_poses("--reference", write_lines(tmp_path / "others.txt", others)))
    assert "knows 0 of the 10" in err
    assert "'IMG_000.png'" in err


def test_reference_whose_names_are_exchanged(take_poses, tmp_path: Path, true_centers) -> None:
    names = list(true_centers)
    exchanged = np.random.default_rng(0).permutation(names)
    mixed = dict(zip(exchanged, true_centers.values(), strict=True))
    err = refused(take_poses("--reference", write_lines(tmp_path / "mixed.txt", mixed)))
    assert "mixed.txt: " in err


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.json", "{", "cannot be read as JSON"),
        ("a.json", "[1, 2]", "must map image names to camera centres"),
        ("a.json", '{"000.png": [1, 2]}', "000.png needs 3 numbers"),
        ("a.json", '{"000.png": {"center": [1, 2, NaN]}}', "not finite"),
        ("a.json", '{"000.png": [0, 0, 0], "000.png": [0, 0, 1]}', "'000.png' occurs twice"),
        ("a.json", '{"000.png": {"K": []}}', "neither center nor cam_from_world"),
        ("a.txt", "000.png 1 2\n", "line 1 is not of the form: name x y z"),
        ("a.txt", "000.png 1 2 x\n", "line 1 needs 3 numbers"),
        ("a.txt", "# nothing\n", "names no camera"),
        ("a.csv", "000.png 1 2 3\n", "a.csv"),
    ],
)
def test_malformed_reference(refuses, tmp_path: Path, name, content, message) -> None:
    (tmp_path / name).write_text(content)
    err = refuses("--reference", tmp_path / name)
    assert name in err
    assert message in err


def test_missing_reference(refuses, tmp_path: Path) -> None:
    assert "nothing.json" in refuses("--reference", tmp_path / "nothing.json")


# A known distance


def test_scale_from_the_distance_of_two_cameras(take_poses, out: Path, demo_run: Path) -> None:
    status, _, err = take_poses("--scale", "000", "004.png", 0.25)
    assert (status, err) == (0, "")
    assert distance_in(out / "sparse", "000.png", "004.png") == pytest.approx(0.25, rel=1e-9)
    assert result_of(out, "poses")["frame"]["source"] == "scale"
    # The axes stay: only the unit changes.
    before = {view.name: view for view in read_model(demo_run / "sparse").views}
    for view in read_model(out / "sparse").views:
        rotation = before[view.name].cam_from_world.rotation
        np.testing.assert_allclose(view.cam_from_world.rotation, rotation, atol=1e-9)


def test_without_a_source_the_model_stays(take_poses, out: Path, demo_run: Path) -> None:
    assert take_poses()[0] == 0
    assert result_of(out, "poses")["frame"] is None
    ends = ("000.png", "004.png")
    expected = distance_in(demo_run / "sparse", *ends)
    assert distance_in(out / "sparse", *ends) == pytest.approx(expected, rel=1e-9)


def test_agreeing_scale_is_recorded(
    take_poses, out: Path, demo_capture: Path, true_centers
) -> None:
    distance = np.linalg.norm(true_centers["000.png"] - true_centers["004.png"])
    flags = ("--reference", cameras_file(demo_capture), "--scale", "000.png", "004.png", distance)
    assert take_poses(*flags)[0] == 0
    frame = result_of(out, "poses")["frame"]
    assert frame["checked_by"]["scale"] == pytest.approx(frame["scale"], rel=0.005)


def test_contradictory_scale_names_both(
    take_poses, out: Path, demo_capture: Path, true_centers
) -> None:
    distance = 1.1 * np.linalg.norm(true_centers["000.png"] - true_centers["004.png"])
    flags = ("--reference", cameras_file(demo_capture), "--scale", "000.png", "004.png", distance)
    err = refused(take_poses(*flags), 2)
    assert "--reference gives a scale of" in err
    assert "but --scale" in err
    assert not (out / "sparse").exists()


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        (("000.png", "999.png", 1), "999.png, which is neither an image"),
        (("000.png", "123456789", 1), "123456789, which is neither a reconstructed image"),
        (("000.png", "000", 1), "are at one place"),
    ],
)
def test_scale_between_what_is_not_there(take_poses, ends, message) -> None:
    assert message in refused(take_poses("--scale", *ends), 2)


@pytest.mark.parametrize(
    ("ends", "message"),
    [
        (("000.png", "000.png", 1), "two different ends"),
        (("000.png", "001.png", 0), "positive distance"),
    ],
)
def test_malformed_scale(refuses, ends, message) -> None:
    assert message in refuses("--scale", *ends, status=2)


@pytest.mark.slow
def test_run_goes_on_with_the_same_scale_only(
    take_poses, cli, out: Path, demo_capture: Path
) -> None:
    assert take_poses("--scale", "000.png", "004.png", 0.25)[0] == 0
    before = (out / "sparse" / "images.bin").read_bytes()
    again = ("sfm", demo_capture, out, "--resume", "--scale", "000.png", "004.png")
    err = refused(cli(*again, 0.5), 2)
    assert "--scale is 000.png,004.png,0.5 but" in err
    assert "used 000.png,004.png,0.25" in err
    assert cli(*again, 0.25)[0] == 0
    assert (out / "sparse" / "images.bin").read_bytes() == before


# Markers


@pytest.mark.slow
def test_markers_where_there_are_none(take_poses, out: Path) -> None:
    err = refused(take_poses("--aruco", "DICT_4X4_50:0.05"))
    assert "--aruco DICT_4X4_50:0.05: " in err
    assert "marker" in err
    assert not (out / "sparse").exists()
    # What SfM found is kept: the run goes on without doing it again.
    assert stages_of(out) == ["images", "sfm"]
    before = (out / "sfm" / "images.bin").stat().st_mtime_ns
    assert take_poses("--scale", "000.png", "004.png", 0.25)[0] == 0
    assert (out / "sfm" / "images.bin").stat().st_mtime_ns == before
    assert stages_of(out) == ["images", "sfm", "poses"]


@pytest.mark.parametrize(
    ("option", "message"),
    [("DICT_9X9_50:0.05", "DICT_9X9_50"), ("0.05", "DICT:SIZE"), ("DICT_4X4_50:-1", "positive")],
)
def test_malformed_markers(refuses, option, message) -> None:
    assert message in refuses("--aruco", option, status=2)
