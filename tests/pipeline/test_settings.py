"""Wrong settings on the bundled capture: each is named before the work begins."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers import record_of, refused, result_of

from polmvs.colmap.models import read_model, write_model
from polmvs.pipeline.checks import identity_of
from polmvs.polarization.capture import open_capture
from polmvs.scene import some_tracks

INTRINSICS = "333.75,333.75,230.6475,196.608"  # of the bundled capture


@pytest.fixture
def refuses(cli, demo_capture: Path, tmp_path: Path):
    """``reconstruct``, which must fail in one line before it writes anything."""

    def call(*flags: object, status: int = 1, capture: Path = demo_capture) -> str:
        target = tmp_path / "new"
        err = refused(cli("reconstruct", capture, target, *flags), status)
        assert not target.exists()
        return err

    return call


def test_more_views_than_there_are(refuses) -> None:
    err = refuses("--min-views", 11, status=2)
    assert "--min-views asks for points that 11 views confirm; the capture has 10" in err


def test_distance_to_an_unknown_image(refuses) -> None:
    err = refuses("--scale", "000.png", "start", 0.3, status=2)
    assert "--scale names start, which is neither an image (such as 000.png, 001.png)" in err


def test_reference_of_other_names(refuses, tmp_path: Path) -> None:
    (tmp_path / "known.txt").write_text("a 0 0 0\nb 1 0 0\nc 0 1 0\n")
    err = refuses("--reference", tmp_path / "known.txt")
    assert "known.txt: knows 0 of the 10 images by name" in err


def test_masks_of_nothing(refuses, tmp_path: Path) -> None:
    masks = tmp_path / "masks"
    masks.mkdir()
    capture = open_capture_size()
    for index in range(10):
        cv2.imwrite(str(masks / f"{index:03}.png"), np.zeros(capture, np.uint8))
    assert "000.png: and all other masks are 0 everywhere" in refuses("--mask", masks)


def open_capture_size() -> tuple[int, int]:
    import polmvs

    capture = open_capture(Path(polmvs.__file__).parent / "demo_capture")
    return capture.height, capture.width


def other_poses(source: Path, target: Path) -> Path:
    """A model whose names fit and whose poses are other images'."""
    model = read_model(source)
    shifted = [*model.views[3:], *model.views[:3]]
    views = tuple(
        replace(view, cam_from_world=other.cam_from_world)
        for view, other in zip(model.views, shifted, strict=True)
    )
    write_model(replace(model, views=views), target)
    return target


def test_model_of_another_capture(refuses, demo_run: Path, tmp_path: Path) -> None:
    err = refuses("--sparse", other_poses(demo_run / "sparse", tmp_path / "other"))
    assert "other: its cameras do not fit the images" in err
    assert "--sparse" in err


def test_intrinsics_beside_a_model(cli, refuses, demo_capture, demo_run, tmp_path: Path) -> None:
    sparse = demo_run / "sparse"
    err = refuses("--sparse", sparse, "--intrinsics", "400,400,230.6,196.6", status=2)
    assert "--intrinsics has focal length 400.0 and principal point 230.6,196.6" in err
    assert "333.8" in err
    # The same ones are no contradiction.
    same = cli("sfm", demo_capture, tmp_path / "o", "--sparse", sparse, "--intrinsics", INTRINSICS)
    assert same[0] == 0
    err = refuses("--sparse", sparse, "--camera-model", "OPENCV", status=2)
    assert "--camera-model has no effect beside --sparse" in err


def other_truth(demo_capture: Path, target: Path) -> Path:
    """Ground truth whose names and sizes fit and whose cameras are other images'."""
    shutil.copytree(demo_capture / "gt", target)
    path = target / "cameras.json"
    content = json.loads(path.read_text())
    names = list(content["images"])
    entries = list(content["images"].values())
    content["images"] = dict(zip(names, [*entries[4:], *entries[:4]], strict=True))
    path.write_text(json.dumps(content))
    return target


def test_truth_of_another_capture(cli, refuses, demo_capture, demo_run, tmp_path: Path) -> None:
    gt = other_truth(demo_capture, tmp_path / "gt")
    target = tmp_path / "out"
    err = refused(cli("compare", demo_capture, target, "--gt", gt))
    assert "cameras.json: its cameras do not fit the images" in err
    assert not target.exists()
    err = refused(cli("experiment", "phase", demo_capture, target, "--gt", gt))
    assert "its cameras do not fit the images" in err
    cloud = ("evaluate", demo_run / "ppa.ply", "--gt", gt, "--sparse", demo_run / "sparse")
    err = refused(cli(*cloud))
    assert "its cameras cannot be those of the 10 reconstructed images" in err


def test_truth_of_other_names(cli, demo_capture, tmp_path: Path) -> None:
    gt = tmp_path / "gt"
    shutil.copytree(demo_capture / "gt", gt)
    content = (gt / "cameras.json").read_text()
    for name in [p.name for p in gt.glob("0*")]:
        (gt / name).rename(gt / f"x{name}")
    (gt / "cameras.json").write_text(content.replace('"0', '"x0'))
    err = refused(cli("compare", demo_capture, tmp_path / "out", "--gt", gt))
    assert "knows 0 of the 10 images by name" in err


def test_few_views_are_said_to_carry_little(
    cli, demo_capture, demo_run, tmp_path: Path, caplog
) -> None:
    model = read_model(demo_run / "sparse")
    few = tmp_path / "few"
    seen = model.tracks.obs_view < 3
    tracks = replace(
        model.tracks,
        obs_track=model.tracks.obs_track[seen],
        obs_view=model.tracks.obs_view[seen],
        obs_xy=model.tracks.obs_xy[seen],
    )
    counted = np.bincount(tracks.obs_track, minlength=len(tracks.point3D_ids)) > 0
    write_model(replace(model, views=model.views[:3], tracks=some_tracks(tracks, counted)), few)
    assert cli("sfm", demo_capture, tmp_path / "out", "--sparse", few)[0] == 0
    assert "3 views carry little" in caplog.text
    assert result_of(tmp_path / "out", "sfm")["num_views"] == 3


def test_a_gamma_that_does_not_fit_is_warned_of(cli, demo_capture) -> None:
    status, text, _ = cli("inspect", demo_capture, "--gamma", 0.5)
    assert status == 0
    assert "warning: --gamma 0.5 does not fit" in text
    assert "Give --gamma 1" in text
    assert "--gamma 1 fits" in cli("inspect", demo_capture)[1]


def test_what_was_decided_is_recorded(demo_run: Path) -> None:
    notes = "\n".join(record_of(demo_run)["notes"])
    assert "10 views, raw mosaics" in notes
    assert "`capture.pattern` 90,45,135,0 fits" in notes


def test_files_of_one_name_in_two_folders_are_told_apart(demo_capture, tmp_path: Path) -> None:
    for angle in (0, 45, 90, 135):
        (tmp_path / f"I{angle}").mkdir()
        for view in range(3):
            image = np.full((16, 16), 50 + angle + view, np.uint8)
            cv2.imwrite(str(tmp_path / f"I{angle}" / f"{view}.png"), image)
    identity = identity_of(open_capture(tmp_path))
    assert len(identity.digests) == 12
    assert "I45/1.png" in identity.digests
