"""Each kind of bad input: one clear line, the exit status, and nothing half-written or lost."""

import ctypes
import json
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from helpers import content_of, cut_after, record_of, result_of, stages_of

from polmvs.cli import main
from polmvs.colmap.cameras import quiet_colmap
from polmvs.colmap.models import read_model, write_model
from polmvs.errors import DataError
from polmvs.io.clouds import read_cloud
from polmvs.pipeline.checks import identity_of
from polmvs.pipeline.record import Record, StageRecord, write_record
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages.images import ImagesResult, write_images
from polmvs.polarization.capture import open_capture
from polmvs.scene import PointKind, Tracks

INTRINSICS = "333.75,333.75,230.6475,196.608"  # of the bundled capture
SIZE = (48, 64)
# For what is not about the surface: one that is a quarter of the work.
QUICK = ("--method", "contour", "--stride-px", 8)
CLOUD_ONLY = ("--no-mesh", "--no-colmap", "--no-report")


def noise(seed: int, shape: tuple[int, ...] = SIZE, dtype: type = np.uint8) -> np.ndarray:
    top = np.iinfo(dtype).max
    return np.random.default_rng(seed).integers(0, top, shape, dtype=dtype)


@pytest.fixture
def capture(tmp_path: Path) -> Path:
    """Four small mosaics of nothing."""
    folder = tmp_path / "capture"
    folder.mkdir()
    for index in range(4):
        cv2.imwrite(str(folder / f"{index}.png"), noise(index))
    return folder


@pytest.fixture
def fails(cli, tmp_path: Path):
    """Call the command, which must fail in one line and leave no OUT."""

    def call(*arguments: object, status: int = 1) -> str:
        out = tmp_path / "out"
        given = [out if argument is OUT else argument for argument in arguments]
        found, text, err = cli(*given)
        assert found == status, err
        assert text == ""
        assert err.count("\n") == 1
        assert err.startswith(f"polmvs {arguments[0]}: error: ")
        assert not out.exists()
        return err

    return call


OUT = object()


# The capture


def test_missing_folder(fails, tmp_path: Path) -> None:
    assert "nothing: no such folder" in fails("reconstruct", tmp_path / "nothing", OUT)


def test_file_in_place_of_a_folder(fails, capture: Path) -> None:
    assert "is no folder" in fails("reconstruct", capture / "0.png", OUT)


def test_empty_folder(fails, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    assert "no images in it or in its raw/" in fails("compare", tmp_path / "empty", OUT)


def test_file_that_is_no_image(fails, capture: Path) -> None:
    (capture / "2.png").write_text("no image")
    assert "2.png: is not a readable image" in fails("reconstruct", capture, OUT)


def test_truncated_image(fails, capture: Path) -> None:
    content = (capture / "2.png").read_bytes()
    (capture / "2.png").write_bytes(content[: len(content) // 2])
    assert "2.png: is truncated" in fails("reconstruct", capture, OUT)


def test_odd_size(fails, capture: Path) -> None:
    cv2.imwrite(str(capture / "2.png"), noise(2, (48, 63)))
    assert "2.png: is 63x48 px" in fails("reconstruct", capture, OUT)


def test_mixed_sizes(fails, capture: Path) -> None:
    cv2.imwrite(str(capture / "2.png"), noise(2, (50, 64)))
    assert "2.png: is 64x50 px but 0.png is 64x48 px" in fails("sfm", capture, OUT)


def test_mixed_bit_depths(fails, capture: Path) -> None:
    cv2.imwrite(str(capture / "2.png"), noise(2, dtype=np.uint16))
    assert "2.png: has 16 bits a sample" in fails("sfm", capture, OUT)


def test_colour(fails, capture: Path) -> None:
    cv2.imwrite(str(capture / "2.png"), noise(2, (48, 64, 3)))
    assert "2.png: has 3 channels" in fails("reconstruct", capture, OUT)


def test_names_that_differ_in_the_suffix_only(fails, capture: Path) -> None:
    cv2.imwrite(str(capture / "2.tif"), noise(2))
    assert "2.tif: is the same image of the same view as " in fails("reconstruct", capture, OUT)


@pytest.mark.parametrize(("command", "num_images"), [("sfm", 1), ("reconstruct", 2)])
def test_too_few_images(fails, capture: Path, command: str, num_images: int) -> None:
    for path in sorted(capture.iterdir())[num_images:]:
        path.unlink()
    assert f"holds {num_images} image" in fails(command, capture, OUT)


def test_black_images_are_found_before_sfm(cli, capture: Path, tmp_path: Path) -> None:
    for path in capture.iterdir():
        cv2.imwrite(str(path), np.zeros(SIZE, np.uint8))
    status, _, err = cli("reconstruct", capture, tmp_path / "out")
    assert status == 1
    assert "the images are black" in err
    assert not (tmp_path / "out" / "images").exists()


# Poses


def test_sfm_that_finds_no_model(cli, capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    status, text, err = cli("reconstruct", capture, out)
    assert (status, text) == (1, "")
    first, *_, last = err.splitlines()
    assert first.startswith("images ")
    assert "SfM finds no model" in last
    assert not (out / "sparse").exists()
    assert not list(out.glob(".*"))
    assert [stage["name"] for stage in json.loads((out / "run.json").read_text())["stages"]] == [
        "images"
    ]


@pytest.mark.slow
def test_sfm_that_registers_few_views_names_the_others(
    cli, demo_capture: Path, tmp_path: Path
) -> None:
    folder = tmp_path / "capture"
    folder.mkdir()
    for index in range(3):
        shutil.copy(demo_capture / "raw" / f"00{index}.png", folder)
    for index in range(4):
        shape = cv2.imread(str(folder / "000.png"), cv2.IMREAD_UNCHANGED).shape
        cv2.imwrite(str(folder / f"noise{index}.png"), noise(index, shape))
    status, text, err = cli("sfm", folder, tmp_path / "out", "--intrinsics", INTRINSICS)
    assert status == 0
    assert "3 of 7 views" in text
    assert "noise0.png, noise1.png, noise2.png, noise3.png" in err


@pytest.mark.parametrize(
    ("intrinsics", "message"),
    [
        ("667.5,667.5,461.295,393.216", "give half of each: 333.75,333.75,230.6"),
        ("333,333,900,100", "--intrinsics has the principal point 900,100 outside the 459x384 px"),
        ("33375,33375,230,196", "--intrinsics has focal lengths 33375,33375, not within"),
    ],
)
def test_intrinsics_that_do_not_fit(
    fails, demo_capture: Path, intrinsics: str, message: str
) -> None:
    err = fails("reconstruct", demo_capture, OUT, "--intrinsics", intrinsics, status=2)
    assert message in err


def test_sparse_model_that_is_none(fails, demo_capture: Path, tmp_path: Path) -> None:
    arguments = ("reconstruct", demo_capture, OUT, "--sparse")
    assert "no such folder" in fails(*arguments, tmp_path / "nothing")
    (tmp_path / "model").mkdir()
    assert "holds no COLMAP model" in fails(*arguments, tmp_path / "model")


def test_sparse_model_whose_names_do_not_match(
    fails, demo_run: Path, demo_capture: Path, tmp_path: Path
) -> None:
    model = read_model(demo_run / "sparse")
    views = tuple(replace(view, name=f"IMG_{view.name}") for view in model.views)
    write_model(replace(model, views=views), tmp_path / "model")
    err = fails("reconstruct", demo_capture, OUT, "--sparse", tmp_path / "model")
    assert "none match" in err


def test_sparse_model_of_two_views(cli, demo_run: Path, demo_capture: Path, tmp_path: Path) -> None:
    capture = tmp_path / "two"
    capture.mkdir()
    for name in ("000.png", "001.png"):
        shutil.copy(demo_capture / "raw" / name, capture)
    for index in range(2):
        shape = cv2.imread(str(capture / "000.png"), cv2.IMREAD_UNCHANGED).shape
        cv2.imwrite(str(capture / f"noise{index}.png"), noise(index, shape))
    status, _, err = cli("reconstruct", capture, tmp_path / "out", "--sparse", demo_run / "sparse")
    assert status == 1
    assert "2 views with a pose; normals need 3 or more" in err.splitlines()[-1]
    assert not (tmp_path / "out" / "maps").exists()


# No polarized region, no seeds


def without_points(model_folder: Path, target: Path) -> Path:
    """The model's poses alone."""
    model = read_model(model_folder)
    tracks = Tracks(
        point3D_ids=np.zeros(0, np.int64),
        points_in_world=np.zeros((0, 3)),
        colors=np.zeros((0, 3), np.uint8),
        errors=np.zeros(0),
        obs_track=np.zeros(0, np.int64),
        obs_view=np.zeros(0, np.int64),
        obs_xy=np.zeros((0, 2)),
    )
    write_model(replace(model, tracks=tracks), target)
    return target


def assert_finished_but_empty(out: Path) -> None:
    cloud = read_cloud(out / "ppa.ply")
    assert not (cloud.scalars.get("kind", np.ones(0)) == PointKind.SURFACE).any()
    record = json.loads((out / "run.json").read_text())
    assert record["finished"] is True
    assert result_of(out, "densify_ppa")["num_points"] == 0


@pytest.mark.slow
def test_no_polarized_region(cli, demo_run: Path, demo_capture: Path, tmp_path: Path) -> None:
    """The bundled capture with each cell's four samples made equal."""
    capture, out = tmp_path / "capture", tmp_path / "out"
    capture.mkdir()
    for path in (demo_capture / "raw").glob("*.png"):
        raw = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        mean = cv2.resize(raw, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA)
        smooth = cv2.GaussianBlur(np.kron(mean, np.ones((2, 2), np.uint8)), (0, 0), 4)
        cv2.imwrite(str(capture / path.name), smooth)
    status, text, err = cli("reconstruct", capture, out, "--sparse", demo_run / "sparse")
    assert status == 3
    assert text.startswith(f"{out / 'ppa.ply'}: 0 points")
    last = err.splitlines()[-1]
    assert last.startswith("polmvs: no polarized region: ")
    assert "--min-dolp" in last
    assert_finished_but_empty(out)


@pytest.mark.slow
def test_no_seeds(cli, demo_run: Path, demo_capture: Path, tmp_path: Path) -> None:
    model, out = without_points(demo_run / "sparse", tmp_path / "model"), tmp_path / "out"
    flags = ("--sparse", model, "--gt", demo_capture, "--models", "ppa", *QUICK)
    status, text, err = cli("compare", demo_capture, out, *flags)
    assert status == 3
    assert "| F-score at 1 mm, %" in text
    last = err.splitlines()[-1]
    assert last.startswith("polmvs: no seeds: ")
    assert "marks" in last
    assert_finished_but_empty(out)
    json.loads((out / "metrics.json").read_text())
    # The same when it is asked for again.
    assert cli("compare", demo_capture, out, *flags, "--resume", "--no-report")[0] == 3


# Masks and ground truth


def test_masks_that_are_missing_or_of_another_size(
    fails, demo_capture: Path, tmp_path: Path
) -> None:
    masks = tmp_path / "masks"
    arguments = ("reconstruct", demo_capture, OUT, "--mask", masks)
    assert "no such folder of masks" in fails(*arguments)
    masks.mkdir()
    assert "has no mask 000.png or 000_mask.png" in fails(*arguments)
    for index in range(10):
        cv2.imwrite(str(masks / f"00{index}.png"), np.ones((10, 10), np.uint8))
    assert "the mask is 10x10 px" in fails(*arguments)


def test_masks_are_honoured(cli, demo_run: Path, demo_capture: Path, tmp_path: Path) -> None:
    """Half of each view's part: about half of the region."""
    masks, out = tmp_path / "masks", tmp_path / "out"
    masks.mkdir()
    expected = 0
    for path in (demo_capture / "gt").glob("*_mask.png"):
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        mask[:, : mask.shape[1] // 2] = 0
        expected += np.count_nonzero(mask)
        cv2.imwrite(str(masks / path.name), mask)
    assert cli("sfm", demo_capture, out, "--sparse", demo_run / "sparse")[0] == 0
    status, _, err = cli("normals", demo_capture, out, "--mask", masks)
    assert status == 0
    assert result_of(out, "maps")["num_region_px"] == expected
    assert result_of(out, "maps")["cut_share"] > 0.1
    assert "Give masks of the whole object, its sides too, or none" in err


def test_ground_truth_that_is_none(fails, demo_capture: Path, tmp_path: Path) -> None:
    (tmp_path / "gt").mkdir()
    err = fails("compare", demo_capture, OUT, "--gt", tmp_path / "gt")
    assert "cameras.json: missing" in err


def test_clouds_that_cannot_be_evaluated(
    cli, demo_run: Path, demo_capture: Path, tmp_path: Path
) -> None:
    (tmp_path / "text.ply").write_text("no cloud")
    for cloud, gt, sparse, message in (
        (tmp_path / "none.ply", demo_capture, demo_run / "sparse", "no such file"),
        (tmp_path / "text.ply", demo_capture, demo_run / "sparse", "is no PLY file"),
        (demo_run / "ppa.ply", tmp_path / "none", demo_run / "sparse", "no such folder"),
        (demo_run / "ppa.ply", demo_capture, tmp_path / "none", "no such folder"),
    ):
        status, text, err = cli("evaluate", cloud, "--gt", gt, "--sparse", sparse)
        assert (status, text) == (1, "")
        assert message in err
        assert err.count("\n") == 1


# The output folder


def listing(folder: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def test_existing_output_is_refused_and_kept(cli, demo_run: Path, demo_capture: Path) -> None:
    before = listing(demo_run)
    status, text, err = cli("reconstruct", demo_capture, demo_run)
    assert (status, text) == (2, "")
    assert "--overwrite" in err
    assert "--resume" in err
    assert err.count("\n") == 1
    assert listing(demo_run) == before


def test_overwrite_loses_nothing_to_bad_input(cli, demo_run: Path, demo_capture: Path) -> None:
    before = listing(demo_run)
    for flags in (
        ("--sparse", demo_run / "nothing"),
        ("--sparse", demo_run / "sparse"),  # about to be deleted
        ("--mask", demo_run / "nothing"),
        ("--intrinsics", "9000,9000,1,1"),
    ):
        status, _, err = cli("reconstruct", demo_capture, demo_run, "--overwrite", *flags)
        assert status in (1, 2)
        assert err.count("\n") == 1
    assert cli("reconstruct", demo_run / "nothing", demo_run, "--overwrite")[0] == 1
    assert listing(demo_run) == before


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (("--gamma", "1.1"), "--gamma is 1.1 but the finished stage 'images'"),
        (("--intrinsics", "400,400,230,190"), "--intrinsics is 400,400,230,190 but"),
        (("--min-dolp", "0.2"), "--min-dolp is 0.2 but the finished stage 'maps'"),
        (("--stride-px", "4"), "--stride-px is 4 but the finished stage 'densify_opa'"),
    ],
)
def test_resume_with_other_options(
    cli, demo_run: Path, demo_capture: Path, flags: tuple[str, ...], message: str
) -> None:
    before = listing(demo_run)
    status, _, err = cli("compare", demo_capture, demo_run, "--resume", *flags)
    assert status == 2
    assert message in err
    assert err.count("\n") == 1
    assert listing(demo_run) == before


def test_resume_with_another_capture(cli, demo_run: Path, capture: Path) -> None:
    before = listing(demo_run)
    # The recorded intrinsics would not fit this capture either.
    status, _, err = cli("compare", capture, demo_run, "--resume", "--intrinsics", "30,30,16,12")
    assert status == 1
    assert "holds a run of another capture" in err
    assert listing(demo_run) == before


def test_resume_with_other_images_of_the_same_size(cli, tmp_path: Path) -> None:
    """Files of as many bytes, which say nothing of what they show."""
    capture, out = tmp_path / "capture", tmp_path / "out"
    capture.mkdir()
    for number in range(3):
        image = np.full((48, 64), 100 + number, np.uint8)
        assert cv2.imwrite(str(capture / f"{number}.bmp"), image)
    out.mkdir()
    identity = identity_of(open_capture(capture))
    done = ImagesResult(num_images=3)
    stage = StageRecord(name="images", seconds=1.0, cpu_s=1.0, peak_rss_mb=1.0, result=done)
    write_record(RunFolder(out), Record(capture=identity, stages=(stage,)))
    shutil.copy(capture / "0.bmp", capture / "1.bmp")
    status, _, err = cli("sfm", capture, out, "--resume")
    assert status == 1
    assert "or its images have changed" in err


@pytest.mark.parametrize(
    ("group", "name", "value"),
    [("propagation", "stride_px", "3"), ("region", "unknown", 1), (None, "propagation", [])],
)
def test_resume_of_a_record_with_damaged_options(
    cli, demo_run: Path, demo_capture: Path, tmp_path: Path, group, name: str, value
) -> None:
    """The file is named, and not a flag that nobody gave."""
    record = record_of(demo_run)
    (record["options"] if group is None else record["options"][group])[name] = value
    (tmp_path / "run.json").write_text(json.dumps(record))
    status, _, err = cli("reconstruct", demo_capture, tmp_path, "--resume")
    assert status == 1
    assert "run.json: is no record of a run" in err
    assert f"{name}" in err
    assert err.count("\n") == 1


def test_resume_of_a_damaged_record(cli, capture: Path, tmp_path: Path) -> None:
    (tmp_path / "run.json").write_text("{")
    status, _, err = cli("sfm", capture, tmp_path, "--resume")
    assert status == 1
    assert "run.json: is no record of a run" in err
    assert err.count("\n") == 1


@pytest.mark.parametrize("command", ["normals", "densify"])
def test_stage_alone_without_a_run(fails, demo_capture: Path, command: str) -> None:
    assert "holds no run of polmvs" in fails(command, demo_capture, OUT)


def test_stages_alone_out_of_order(cli, demo_run: Path, demo_capture: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    shutil.copytree(demo_run, out)
    record = json.loads((out / "run.json").read_text())
    record["stages"] = record["stages"][:1]
    (out / "run.json").write_text(json.dumps(record))
    status, _, err = cli("densify", demo_capture, out)
    assert status == 1
    assert "its stage 'poses' is not finished, which 'densify_ppa' reads" in err
    assert "Run 'polmvs sfm' first" in err
    status, _, err = cli("normals", demo_capture, out)
    assert status == 1
    assert "Run 'polmvs sfm' first" in err


def test_output_that_cannot_be_made(cli, capture: Path, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("mine")
    # The second is refused to the superuser, too.
    for out in (tmp_path / "file", tmp_path / "file" / "out", Path("/proc/polmvs")):
        status, text, err = cli("sfm", capture, out)
        assert (status, text) == (1, "")
        assert err.count("\n") == 1
        assert str(out) in err


DROP_BOUND, WRITE_ANYWHERE = 24, 1  # of prctl and of Linux' capabilities


def test_read_only_output(capture: Path, tmp_path: Path) -> None:
    """The superuser's, too, who may write anywhere unless that is taken away."""
    out = tmp_path / "out"
    out.mkdir(mode=0o555)
    done = subprocess.run(
        [sys.executable, "-m", "polmvs", "sfm", capture, out],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: ctypes.CDLL(None).prctl(DROP_BOUND, WRITE_ANYWHERE),
    )
    assert (done.returncode, done.stdout) == (1, "")
    assert "out/.polmvs-lock: cannot be written: Permission denied" in done.stderr
    assert done.stderr.count("\n") == 1
    assert list(out.iterdir()) == []


FULL_DISK = """
import resource, sys
from polmvs.cli import main
resource.setrlimit(resource.RLIMIT_FSIZE, (int(sys.argv[1]),) * 2)
sys.exit(main(sys.argv[2:]))
"""


# In SfM COLMAP refuses to begin, or aborts the process that it works in.
@pytest.mark.parametrize(
    ("num_stages", "limit"),
    [(1, 200_000), *(pytest.param(stage, 30000, marks=pytest.mark.slow) for stage in range(4))],
)
def test_full_disk(
    demo_run: Path, demo_capture: Path, tmp_path: Path, num_stages: int, limit: int
) -> None:
    """A limit on the size of files fails as a full disk does, at a stage's first large file."""
    out = tmp_path / "out"
    shutil.copytree(demo_run, out)
    record = json.loads((out / "run.json").read_text())
    record["stages"] = record["stages"][:num_stages]
    (out / "run.json").write_text(json.dumps(record))
    arguments = [str(limit), "demo", str(out), "--resume", "--workers", "1"]
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.startswith("polmvs demo: error: ")
    assert done.stderr.count("\n") == 1
    assert "cannot be written" in done.stderr
    assert not list(out.glob(".*"))
    names = [stage["name"] for stage in json.loads((out / "run.json").read_text())["stages"]]
    assert names == [stage["name"] for stage in record["stages"]]


@pytest.mark.slow
def test_with_room_again_it_comes_to_the_same(
    demo_run: Path, demo_capture: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    shutil.copytree(demo_run, out)
    cut_after(out, "normals_opa")
    for path in (out / "normals.ply", out / "tracks" / "normals_ppa.npy"):
        path.unlink()
    arguments = ["normals", str(demo_capture), str(out), "--workers", "1"]
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, "30000", *arguments],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 1
    assert done.stderr.startswith("polmvs normals: error: ")
    assert "cannot be written" in done.stderr
    assert not list(out.glob(".*"))
    assert stages_of(out)[-1] == "normals_opa"
    assert main([*arguments, "--quiet"]) == 0
    assert stages_of(out)[-1] == "sparse_cloud_ppa"
    found = content_of(out)
    for name, data in content_of(demo_run).items():
        if name == "normals.ply" or name.startswith(("maps/", "tracks/")):
            assert found[name] == data, name


@pytest.mark.slow
def test_no_room_for_a_copy_of_a_database(
    demo_capture: Path, demo_run: Path, tmp_path: Path
) -> None:
    """The user's own database is not to blame."""
    database, out = tmp_path / "given.db", tmp_path / "out"
    with quiet_colmap():
        pycolmap.extract_features(database, demo_run / "images")
    assert database.stat().st_size > 200_000
    arguments = ["200000", "sfm", str(demo_capture), str(out), "--database", str(database)]
    arguments.append("--quiet")
    done = subprocess.run(
        [sys.executable, "-c", FULL_DISK, *arguments], capture_output=True, text=True, check=False
    )
    assert done.returncode == 1
    assert done.stderr.count("\n") == 1
    assert f"error: {out}: cannot be written: is the disk full?" in done.stderr
    assert not list(out.glob(".*"))


# Faults of the program itself


def test_internal_error_is_one_line_and_the_rest_is_in_the_log(
    cli, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise RuntimeError("a fault\nof two lines")

    monkeypatch.setattr("polmvs.pipeline.stages.images.write_images", fail)
    out = tmp_path / "out"
    status, text, err = cli("sfm", capture, out)
    assert (status, text) == (1, "")
    assert err == (
        f"polmvs sfm: internal error: RuntimeError: a fault of two lines; see {out}/polmvs.log\n"
    )
    assert "Traceback" in (out / "polmvs.log").read_text()


def test_a_missing_package_is_named(
    cli, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise ModuleNotFoundError("No module named 'open3d'")

    monkeypatch.setattr("polmvs.pipeline.stages.images.write_images", fail)
    status, _, err = cli("sfm", capture, tmp_path / "out")
    assert status == 1
    assert err.startswith("polmvs sfm: error: No module named 'open3d'. Run 'polmvs doctor'")
    assert err.count("\n") == 1


def test_traceback_of_a_user_error_is_in_the_log_if_asked_for(
    cli, capture: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object, **kwargs: object) -> None:
        raise DataError("file", "is broken.")

    monkeypatch.setattr("polmvs.pipeline.stages.images.write_images", fail)
    for flags, expected in (((), False), (("-v",), True)):
        out = tmp_path / f"out{expected}"
        status, _, err = cli("sfm", capture, out, *flags)
        assert status == 1
        assert err.endswith("polmvs sfm: error: file: is broken.\n")
        assert "Traceback" not in err
        assert ("Traceback" in (out / "polmvs.log").read_text()) is expected


def test_errors_of_workers_arrive_whole(capture: Path, tmp_path: Path) -> None:
    """A file that is damaged after the run has begun, read in another process."""
    from polmvs.parallel import Workers

    found = open_capture(capture)
    (capture / "2.png").write_text("no image")
    (tmp_path / "out").mkdir()
    with Workers(2) as workers, pytest.raises(DataError, match=r"2\.png: is not a readable image"):
        write_images(found, tmp_path / "out" / "images", workers=workers)
    assert not (tmp_path / "out" / "images").exists()
