"""The public API as a notebook uses it."""

import inspect
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import open3d
import pycolmap
import pytest

import polmvs
from polmvs.cli.jobs import DEMO_MODELS
from polmvs.config import Options
from polmvs.io.clouds import read_cloud
from polmvs.io.images import read_mask
from polmvs.pipeline.stages.densify import DensifyResult
from polmvs.polarization.capture import open_capture

INTRINSICS = (333.75, 333.75, 230.6475, 196.608)  # of the bundled capture
FRAME = "003.png"
TEXTBOOK = "textbook-opa, textbook-ppa"


def in_new_process(code: str) -> str:
    done = subprocess.run(
        [sys.executable, "-W", "error::RuntimeWarning", "-c", code],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stderr == ""
    return done.stdout


# Importing


def test_importing_is_light_and_sets_nothing() -> None:
    code = """
import logging, signal, sys
before = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)], list(logging.root.handlers)
import polmvs
after = [signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)], list(logging.root.handlers)
assert before == after
assert logging.getLogger("polmvs").level == logging.NOTSET
heavy = {"numpy", "scipy", "cv2", "pycolmap", "open3d", "matplotlib", "msgspec", "rich"}
print(sorted(heavy & set(sys.modules)))
polmvs.Options, polmvs.PolmvsError, polmvs.AngleModel
heavy -= {"numpy"}
print(sorted(heavy & set(sys.modules)))
"""
    assert in_new_process(code) == "[]\n[]\n"


def test_colmaps_log_stays_as_the_user_has_it() -> None:
    code = """
import pycolmap
for level in (0, 2):
    pycolmap.logging.minloglevel = level
    import polmvs, polmvs.api, polmvs.colmap.models, polmvs.colmap.sfm, polmvs.pipeline.jobs
    assert pycolmap.logging.minloglevel == level
    for name in [name for name in __import__("sys").modules if name.startswith("polmvs")]:
        del __import__("sys").modules[name]
"""
    assert in_new_process(code) == ""


def test_names_of_the_api() -> None:
    assert set(polmvs.__all__) <= set(dir(polmvs))
    for name in polmvs.__all__:
        assert getattr(polmvs, name) is not None
    with pytest.raises(AttributeError, match="no attribute 'reconstruct_all'"):
        _ = polmvs.reconstruct_all


# One image


def test_stokes_of_a_frame(demo_capture: Path) -> None:
    stokes = polmvs.read_stokes(demo_capture / "raw" / FRAME)
    same = open_capture(demo_capture).load(FRAME)
    np.testing.assert_array_equal(stokes.s1, same.s1)
    phase = stokes.phase()
    assert ((phase >= 0) & (phase < np.float32(np.pi))).all()
    turn = np.exp(2j * (phase - stokes.aolp))
    np.testing.assert_allclose(turn, -1, atol=1e-5)
    np.testing.assert_array_equal(stokes.phase("diffuse"), stokes.aolp)
    turned = polmvs.read_stokes(demo_capture / "raw" / FRAME, pattern=(0, 135, 45, 90))
    assert not np.allclose(turned.s1, stokes.s1)
    with pytest.raises(ValueError, match="'mirror' is not a valid Light"):
        stokes.phase("mirror")


def test_errors_name_fields_and_not_flags(demo_capture: Path, tmp_path: Path) -> None:
    frame = demo_capture / "raw" / FRAME
    cases = {
        "`capture.gamma` must": lambda: polmvs.read_stokes(frame, gamma=0.0),
        "no option 'gama'; is it 'gamma'?": lambda: polmvs.read_stokes(frame, gama=2.0),
        "`capture.gamma` cannot be none": lambda: polmvs.read_stokes(frame, gamma=None),
        "`capture.gamma` cannot be '2'": lambda: polmvs.read_stokes(frame, gamma="2"),
        f"`model` must be one of opa, ppa, tilted, {TEXTBOOK}, not 'best'": lambda: (
            polmvs.reconstruct(demo_capture, tmp_path / "out", "best")
        ),
        f"`plane.model` must be one of opa, ppa, tilted, {TEXTBOOK}, not best": lambda: (
            polmvs.plane_normal(polmvs.read_stokes(frame), INTRINSICS, model="best")
        ),
        "`sfm.intrinsics` must be a finite number, not nan,1,1,1": lambda: polmvs.reconstruct(
            demo_capture, tmp_path / "out", intrinsics=(np.nan, 1, 1, 1)
        ),
        "`options` must be Options, not dict": lambda: polmvs.reconstruct(
            demo_capture, tmp_path / "out", options={"stride_px": 2}
        ),
        "`options` must be CaptureOptions, not Options": lambda: polmvs.read_stokes(
            frame, options=Options()
        ),
        "`models` needs one angle model or more": lambda: polmvs.compare(
            demo_capture, tmp_path / "out", models=()
        ),
        f"`models` must be one of opa, ppa, tilted, {TEXTBOOK}, not 'best'": lambda: polmvs.compare(
            demo_capture, tmp_path / "out", models="best"
        ),
        "`run.workers` cannot be 1.5": lambda: polmvs.track_normals(
            demo_capture, tmp_path, workers=1.5
        ),
        "no option 'min_view'; is it 'min_views'?": lambda: polmvs.reconstruct(
            demo_capture, tmp_path / "out", min_view=3
        ),
        "`export.in_place` needs a `fusion.workspace`": lambda: polmvs.reconstruct(
            demo_capture, tmp_path / "out", in_place=True
        ),
    }
    for message, call in cases.items():
        with pytest.raises(polmvs.OptionError) as error:
            call()
        assert message in str(error.value)
        assert "--" not in str(error.value)
    with pytest.raises(polmvs.DataError, match="no such"):
        polmvs.read_stokes(tmp_path / "none.png")
    assert not (tmp_path / "out").exists()


def test_plane_from_one_frame(demo_capture: Path) -> None:
    """The board's true normal is +z of the world, in the camera's frame by its pose."""
    from polmvs.io.ground_truth import open_ground_truth

    stokes = polmvs.read_stokes(demo_capture / "raw" / FRAME)
    mask = read_mask(demo_capture / "gt" / "003_mask.png", stokes.shape)
    truth = open_ground_truth(demo_capture).views[FRAME].cam_from_world.rotation[:, 2]
    errors = {}
    for model in ("ppa", "tilted"):
        plane = polmvs.plane_normal(stokes, INTRINSICS, model=model, mask=mask)
        assert plane.valid
        errors[model] = np.degrees(np.arccos(plane.normal @ truth))
        variance = np.linalg.eigvalsh(plane.covariance)
        assert np.degrees(np.sqrt(variance[2])) == pytest.approx(plane.sigma_deg, rel=1e-6)
        assert variance[0] == pytest.approx(0, abs=1e-9 * variance[2])
        assert variance[1] > 0.001 * variance[2]
        np.testing.assert_allclose(plane.covariance @ plane.normal, 0, atol=1e-12)
    # Measured 0.9 and 0.1 deg; the sensor's polarizers are tilted.
    assert errors["ppa"] < 3
    assert errors["tilted"] < 0.5
    opa = polmvs.plane_normal(stokes, INTRINSICS, model="opa", mask=mask)
    assert not opa.valid
    assert np.isnan(opa.covariance).all()


def test_camera_must_fit_the_images(demo_capture: Path) -> None:
    stokes = polmvs.read_stokes(demo_capture / "raw" / FRAME)
    camera = polmvs.PinholeCamera(width=100, height=100, fx=100, fy=100, cx=50, cy=50)
    with pytest.raises(polmvs.OptionError, match="`camera` is of 100x100 px"):
        polmvs.plane_normal(stokes, camera)
    with pytest.raises(polmvs.OptionError, match="`camera` needs four positive numbers"):
        polmvs.plane_normal(stokes, (1, 2, 3))
    with pytest.raises(ValueError, match=r"inside.shape=\(2, 2\)"):
        polmvs.plane_normal(stokes, INTRINSICS, mask=np.ones((2, 2)))
    nothing = np.zeros(stokes.shape, bool)
    with pytest.raises(polmvs.DataError, match="only 0 pixels"):
        polmvs.plane_normal(stokes, INTRINSICS, mask=nothing)


# Whole captures


@pytest.fixture(scope="module")
def result(
    demo_run: Path, demo_capture: Path, tmp_path_factory: pytest.TempPathFactory
) -> polmvs.Reconstruction:
    return polmvs.reconstruct(
        demo_capture,
        tmp_path_factory.mktemp("api") / "out",
        sparse=str(demo_run / "sparse"),
        gt=demo_capture / "gt",
        stride_px=4,
        workers=1,
    )


def test_cloud_and_mesh_are_open3ds(result: polmvs.Reconstruction) -> None:
    cloud, whole = result.point_cloud(), result.point_cloud(surroundings=True)
    assert isinstance(cloud, open3d.geometry.PointCloud)
    found = result.record.result(DensifyResult, result.angle_model)
    assert len(cloud.points) == found.num_points > 10_000
    assert len(whole.points) == found.num_points + found.num_surroundings
    assert cloud.has_normals()
    assert cloud.has_colors()
    assert np.nanmax(result.cloud.scalars["sigma"]) > 0
    mesh = result.mesh()
    assert isinstance(mesh, open3d.geometry.TriangleMesh)
    assert mesh.has_vertex_normals()
    assert len(mesh.triangles) > 1000


def test_maps_show_the_cloud(result: polmvs.Reconstruction, demo_capture: Path) -> None:
    """Where a point of the cloud projects, the map has its depth: less than a pixel's gsd."""
    assert len(result.view_names) == 10
    view = result._view("003")
    depth, normals = result.depth_map("003.png"), result.normal_map("003")
    assert depth.shape == (view.camera.height, view.camera.width)
    assert normals.shape == (*depth.shape, 3)
    known = np.isfinite(depth)
    board = read_mask(demo_capture / "gt" / "003_mask.png", depth.shape)
    assert known[board].mean() > 0.9
    assert board[known].mean() > 0.9  # its sides are not in the mask of its top
    np.testing.assert_array_equal(np.isfinite(normals).all(axis=-1), known)
    np.testing.assert_allclose(np.linalg.norm(normals[known], axis=-1), 1, atol=1e-5)
    points = view.cam_from_world * np.asarray(result.point_cloud().points)
    xy = view.camera.project(points)
    inside = ((xy > 0) & (xy < [view.camera.width, view.camera.height])).all(axis=-1)
    cols, rows = np.floor(xy[inside]).astype(int).T
    error = np.abs(depth[rows, cols] / points[inside, 2] - 1)
    assert np.isfinite(error).mean() > 0.9
    # But where a pixel holds two depths, at the edges of the sides.
    assert np.nanquantile(error, 0.9) < 1 / view.camera.mean_focal_px
    with pytest.raises(KeyError, match=r"'900\.png' is no view"):
        result.depth_map("900.png")


def test_sparse_model_is_pycolmaps(result: polmvs.Reconstruction) -> None:
    assert isinstance(result.sparse_model, pycolmap.Reconstruction)
    assert result.sparse_model.num_reg_images() == 10


def test_figures_of_a_reconstruction(result: polmvs.Reconstruction) -> None:
    """They are measured when they are asked for; nothing is written."""
    before = {path: path.stat().st_mtime_ns for path in result.folder.rglob("*")}
    metrics = result.metrics
    assert metrics.consistency.coverage > 0.9
    assert metrics.truth is not None
    assert metrics.truth.cloud.f_score[1] > 0.9
    assert metrics.truth.maps is not None
    assert metrics.truth.maps.depth_rmse_m < 0.001
    assert {path: path.stat().st_mtime_ns for path in result.folder.rglob("*")} == before


def test_going_on_takes_the_options_of_the_run(
    result: polmvs.Reconstruction, demo_capture: Path
) -> None:
    again = polmvs.reconstruct(demo_capture, result.folder, resume=True, workers=1)
    assert len(again.cloud.points) == len(result.cloud.points)
    with pytest.raises(polmvs.OptionError, match=r"`propagation\.stride_px` is 2 but"):
        polmvs.reconstruct(demo_capture, result.folder, resume=True, stride_px=2)
    with pytest.raises(polmvs.OptionError, match=r"Give `run\.overwrite`"):
        polmvs.reconstruct(demo_capture, result.folder, options=Options())


def test_a_stem_that_two_views_have_names_none(tmp_path: Path) -> None:
    result = polmvs.Reconstruction(folder=tmp_path, angle_model=polmvs.AngleModel.PPA)
    vars(result)["_views"] = {name: name for name in ("a/000.png", "b/000.png", "b/001.png")}
    assert result._view("001") == "b/001.png"
    assert result._view("a/000.png") == "a/000.png"
    with pytest.raises(KeyError, match="'000' is no view"):
        result._view("000")


@pytest.mark.parametrize("name", ["track_normals", "reconstruct", "compare"])
def test_a_script_starts_no_processes_of_itself(name: str) -> None:
    assert inspect.signature(getattr(polmvs, name)).parameters["workers"].default == 1


def test_a_script_without_a_guard_is_told_of_it(demo_capture: Path, tmp_path: Path) -> None:
    """Its workers run it again before they work, and end."""
    script = tmp_path / "script.py"
    script.write_text(
        "import sys, polmvs\n"
        "try:\n"
        f"    polmvs.reconstruct({str(demo_capture)!r}, {str(tmp_path / 'out')!r}, workers=2)\n"
        "except polmvs.PolmvsError as error:\n"
        "    sys.exit(f'{type(error).__name__}: {error}')\n"
    )
    done = subprocess.run([sys.executable, script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    last = done.stderr.splitlines()[-1]
    assert last.startswith("OptionError: `run.workers` is 2, but the worker processes ended: ")
    assert 'if __name__ == "__main__":' in last


def test_results_of_an_earlier_run(demo_run: Path, tmp_path: Path) -> None:
    run = polmvs.open_run(demo_run)
    assert tuple(run.models) == DEMO_MODELS
    assert run.table() in (demo_run / "summary.md").read_text()
    assert run.metrics.best_fit == "tilted"
    assert len(run["opa"].cloud.points) == len(read_cloud(demo_run / "opa.ply").points)
    assert "ppa: " in repr(run["ppa"])
    with pytest.raises(polmvs.OptionError, match="`model` must be one of"):
        run["best"]
    with pytest.raises(polmvs.DataError, match="no mesh was made"):
        run["ppa"].mesh()
    with pytest.raises(polmvs.DataError, match="holds no run of polmvs"):
        polmvs.open_run(tmp_path)


def test_comparison_goes_on_with_a_run(demo_run: Path, demo_capture: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(demo_run, tmp_path / "out"))
    run = polmvs.compare(demo_capture, out, models=DEMO_MODELS, resume=True, workers=1)
    assert run.table() in (out / "summary.md").read_text()
    assert tuple(run.models) == DEMO_MODELS


@pytest.mark.parametrize("as_object", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_normals_of_sparse_points(demo_run: Path, demo_capture: Path, as_object: bool) -> None:
    """The same as the stages find on the same model; writing it anew changes the last digits."""
    folder = demo_run / "sparse"
    sparse = pycolmap.Reconstruction(str(folder)) if as_object else folder
    found = polmvs.track_normals(demo_capture, sparse, model="tilted", workers=1)
    expected = read_cloud(demo_run / "normals_tilted.ply")
    np.testing.assert_allclose(found.points, expected.points, rtol=1e-5, atol=1e-5)
    assert (found.valid == (expected.scalars["valid"] > 0)).mean() > 0.998
    both = found.valid & (expected.scalars["valid"] > 0)
    assert both.sum() > 80
    assert expected.normals is not None
    cosine = (found.normals * expected.normals)[both].sum(axis=-1)
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() < 0.1
    assert len(found.point_cloud().points) == found.valid.sum()
    assert not found.normals[~found.valid].any() or np.isnan(found.normals[~found.valid]).all()


def test_an_empty_path_is_not_the_current_directory(demo_capture) -> None:
    for paths in ((demo_capture, ""), ("", "out")):
        with pytest.raises(ValueError, match="is no path"):
            polmvs.reconstruct(*paths)


# Arrays instead of files


def mosaic_of(demo_capture, stem="003"):
    return cv2.imread(str(demo_capture / "raw" / f"{stem}.png"), cv2.IMREAD_UNCHANGED)


def test_stokes_of_an_array_are_those_of_its_file(demo_capture):
    array = mosaic_of(demo_capture)
    of_file = polmvs.read_stokes(demo_capture / "raw" / "003.png")
    of_array = polmvs.read_stokes(array)
    for name in ("s0", "s1", "s2", "valid"):
        np.testing.assert_array_equal(getattr(of_array, name), getattr(of_file, name))
    by_angle = {
        90: array[::2, ::2],
        45: array[::2, 1::2],
        135: array[1::2, ::2],
        0: array[1::2, 1::2],
    }
    split = polmvs.read_stokes(by_angle)
    strong = of_file.valid & (of_file.dolp > 0.5)
    # Of samples that lie half a pixel apart, not brought to one place.
    assert np.median(np.abs(split.dolp - of_file.dolp)[strong]) < 0.05
    given = polmvs.read_stokes(
        np.stack([of_file.s0, of_file.s1, of_file.s2]).astype(np.float32), full_scale=1.0
    )
    np.testing.assert_allclose(given.s1, of_file.s1, atol=1e-6)
    for wrong in (np.zeros(5), np.zeros((4, 4, 2), np.uint8), {0: "a"}):
        with pytest.raises(polmvs.OptionError, match="frame"):
            polmvs.read_stokes(wrong)


def test_colours_of_angles(demo_capture):
    stokes = polmvs.read_stokes(mosaic_of(demo_capture))
    even, hue = polmvs.aolp_colors(stokes), polmvs.aolp_colors(stokes, hue=True)
    for picture in (even, hue, polmvs.dolp_colors(stokes)):
        assert picture.shape == (*stokes.shape, 3)
        assert picture.dtype == np.uint8
    # Hue: red is along x, and cyan across it.
    across = stokes.valid & (stokes.dolp > 0.5) & (np.abs(np.degrees(stokes.aolp) - 90) < 5)
    assert across.sum() > 20
    assert (hue[across][:, 0] < 60).all()
    assert (hue[across][:, 1:] > 150).all()
    faint = stokes.valid & (stokes.dolp < 0.02)
    assert np.median(np.abs(even[faint].astype(int) - 236)) < 12  # the grey of no angle


def test_frames_in_memory_become_a_run(demo_capture, tmp_path):
    stems = ("000", "002", "004", "006", "008")
    frames = {f"left {stem}": mosaic_of(demo_capture, stem) for stem in stems}
    result = polmvs.reconstruct(
        frames, tmp_path / "out", intrinsics=INTRINSICS, method="contour", stride_px=8,
        mesh=False, colmap=False,
    )  # fmt: skip
    assert sorted(p.name for p in (tmp_path / "out_frames").iterdir()) == [
        f"left {stem}.npy" for stem in stems
    ]
    assert result.record.images == tuple(f"left {stem}.png" for stem in stems)
    with pytest.raises(polmvs.OptionError, match="holds angles images, the first one mosaic"):
        polmvs.reconstruct([np.zeros((8, 8)), {0: np.zeros((4, 4))}], tmp_path / "b")
    assert not (tmp_path / "b_frames").exists()
