"""Whole captures, tiny: what is written, read again, resumed and refused."""

import errno
import json
import os

import numpy as np
import pytest
from scipy.ndimage import binary_erosion

import polmvs
from polmvs.camera import pixel_centers
from polmvs.cli import main
from polmvs.cli.call import read_config
from polmvs.config import CaptureKind, CaptureOptions
from polmvs.errors import DataError, OptionError
from polmvs.io.clouds import read_mesh
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.intrinsics import read_intrinsics
from polmvs.polarization.angle_models import correct_stokes, phase_from_normal
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import AngleModel
from polmvs.simulation import capture as capture_module

SMALL = {"image_size": (96, 80), "views": 2, "max_samples": 16, "directions": 8}


def opened(folder):
    table = read_config(folder / "capture.toml", (CaptureOptions,))["capture"]
    return open_capture(folder, CaptureOptions(**table))


@pytest.fixture(scope="module")
def made(renderer, tmp_path_factory):
    folder = tmp_path_factory.mktemp("simulated") / "capture"
    return polmvs.simulate(
        "sphere", folder, material="black-plastic", light="even", marks=0, masks=True, **SMALL
    )


def test_readers_take_it(made):
    capture, truth = opened(made.folder), open_ground_truth(made.folder)
    assert capture.names == truth.names == ("000.png", "001.png")
    assert read_intrinsics(made.folder / "camera.txt").pinhole == truth.views["000.png"].camera
    for name in capture.names:
        depth, mask = truth.depth(name), truth.mask(name)
        assert mask.mean() > 0.1
        assert np.isfinite(depth[mask]).all()
        assert (made.folder / "masks" / name).is_file()
    assert len(read_mesh(made.folder / "gt" / "mesh.ply").triangles) > 1000


def test_truth_lies_on_the_shape(made):
    truth = open_ground_truth(made.folder)
    points = truth.surface_points().points[truth.surface_points().is_part]
    radius = np.linalg.norm(points - [0, 0, 0.1], axis=1)
    assert np.abs(radius - 0.1).max() < 5e-5  # the depth's step of 20 um, and the mesh's chords


def test_its_phases_are_those_of_the_model(made):
    capture, truth = opened(made.folder), open_ground_truth(made.folder)
    name = capture.names[0]
    camera = truth.views[name].camera
    rays = camera.rays(pixel_centers(camera.width, camera.height))
    stokes = capture.load(name)
    corrected = correct_stokes(stokes, rays, diffuse=False)
    phase = phase_from_normal(AngleModel.TILTED, truth.normals(name), rays)
    found = 0.5 * np.arctan2(corrected.s2, corrected.s1) + np.pi / 2
    error = np.degrees(np.abs((found - phase + np.pi / 2) % np.pi - np.pi / 2))
    dolp = np.hypot(stokes.s1, stokes.s2) / stokes.s0
    use = truth.mask(name) & (dolp > 0.3)
    assert use.sum() > 100
    assert np.median(error[use]) < 1.5  # sensor noise at a DoLP of 0.3
    light = polmvs.io.images.decode_image(
        "light", (made.folder / "gt" / "000_light.png").read_bytes()
    )
    assert (light[use] == 255).mean() > 0.99
    assert (light[~truth.mask(name)] == 0).all()


def test_true_stokes_are_those_of_the_sensor_without_noise(made):
    name = "000.png"
    stokes = opened(made.folder).load(name)
    exact = np.load(made.folder / "gt" / "000_stokes.npy")
    inner = open_ground_truth(made.folder).mask(name)
    ratio = stokes.s0[inner] / (made.exposure * exact[0][inner])
    assert np.median(ratio) == pytest.approx(1, abs=0.02)


def test_same_seed_same_capture_and_resume_gives_the_same(made, tmp_path, monkeypatch):
    options = dict(material="black-plastic", light="even", marks=0, masks=True, **SMALL)
    calls = []
    write = capture_module._write_view

    def stops(out, studio, index, exposure):
        if calls:
            raise KeyboardInterrupt
        calls.append(index)
        return write(out, studio, index, exposure)

    monkeypatch.setattr(capture_module, "_write_view", stops)
    with pytest.raises(KeyboardInterrupt):
        polmvs.simulate("sphere", tmp_path / "c", **options)
    monkeypatch.undo()
    assert not (tmp_path / "c" / "gt" / "cameras.json").exists()
    kept = (tmp_path / "c" / "raw" / "000.png").stat().st_mtime_ns
    with pytest.raises(OptionError, match=r"run\.resume"):
        polmvs.simulate("sphere", tmp_path / "c", **options)
    with pytest.raises(OptionError, match=r"object\.marks"):
        polmvs.simulate("sphere", tmp_path / "c", resume=True, **{**options, "marks": 3})
    again = polmvs.simulate("sphere", tmp_path / "c", resume=True, **options)
    assert list(again.views) == ["001.png"]
    assert (tmp_path / "c" / "raw" / "000.png").stat().st_mtime_ns == kept
    files = sorted(p.relative_to(made.folder) for p in made.folder.rglob("*") if p.is_file())
    assert files == sorted(
        p.relative_to(tmp_path / "c") for p in (tmp_path / "c").rglob("*") if p.is_file()
    )
    for path in files:
        assert (made.folder / path).read_bytes() == (tmp_path / "c" / path).read_bytes(), path
    # What is complete is told from its files.
    monkeypatch.setattr(capture_module, "import_renderer", None)
    whole = polmvs.simulate("sphere", tmp_path / "c", resume=True, **options)
    assert not whole.views
    assert (whole.exposure, whole.variant) == (again.exposure, again.variant)


def test_rotating_filter_of_twelve_bits(renderer, tmp_path):
    polmvs.simulate("dome", tmp_path / "c", sensor="filter", bits=12, drift=0.02, **SMALL)
    capture = opened(tmp_path / "c")
    assert capture.files.kind is CaptureKind.ANGLES
    assert capture.full_scale == 4095
    assert (capture.width, capture.height) == (96, 80)
    assert capture.load("000.png").s0.max() > 0.5


def test_colour_sensor(renderer, tmp_path):
    made = polmvs.simulate(
        "dome", tmp_path / "c", material="car-paint", colour="rggb", light="even", **SMALL
    )
    assert "spectral" in made.variant
    levels = {}
    truth = open_ground_truth(tmp_path / "c")
    for channel in ("red", "blue"):
        options = CaptureOptions(bayer="rggb", channel=channel, full_scale=255)
        stokes = open_capture(tmp_path / "c", options).load("000.png")
        mask = truth.mask("000.png")
        levels[channel] = np.median(stokes.s0[mask]) / np.median(stokes.s0[~mask])
    assert levels["red"] > 1.5 * levels["blue"]  # the paint is red, the table grey


def test_distorted_lens(renderer, tmp_path):
    polmvs.simulate("dome", tmp_path / "c", lens=(-0.2, 0.05, 0.001, 0.0), **SMALL)
    camera = read_intrinsics(tmp_path / "c" / "camera.txt")
    assert camera.model == "OPENCV"
    assert camera.params[4:] == (-0.2, 0.05, 0.001, 0.0)
    # The truth's maps are of the same pixels; their points lie on the table.
    truth = open_ground_truth(tmp_path / "c")
    points = truth.surface_points()
    table = points.points[~points.is_part]
    flat = np.abs(table[:, 2]) < 1e-3
    assert flat.mean() > 0.6


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"cameras": "inside.txt"}, "from inside"),
        ({"cameras": "away.txt"}, "see nothing"),
        ({"light": "even", "contrast": 9}, "contrast"),
        ({"light": "file"}, "needed"),
        ({"colour": "rggb", "sensor": "filter"}, "not of a filter"),
        ({"image_size": (97, 80)}, "multiples of 2"),
        ({"lens": (-3.0, 0, 0, 0)}, "no inverse"),
        ({"variant": "llvm_ad_rgb_polarized"}, "must be one of"),
    ],
)
def test_what_cannot_be_rendered_is_refused(renderer, tmp_path, changes, message):
    (tmp_path / "inside.txt").write_text("a 1 0 0 0 0 0 -0.02\nb 1 0 0 0 0 0 -0.03\n")
    (tmp_path / "away.txt").write_text("a 1 0 0 0 0 0 -9\n")
    if "cameras" in changes:
        changes = {"cameras": tmp_path / changes["cameras"]}
    with pytest.raises((OptionError, DataError), match=message):
        polmvs.simulate("dome", tmp_path / "c", **{**SMALL, **changes})
    assert not (tmp_path / "c").exists()


def test_a_large_object_has_true_depths(renderer, tmp_path):
    """Depths of metres are beyond 16 bits of the usual unit."""
    options = {**SMALL, "image_size": (48, 40), "marks": 0, "surroundings": "nothing"}
    made = polmvs.simulate("sphere", tmp_path / "c", **options, size=2.0)
    truth = open_ground_truth(made.folder)
    assert truth.depth_unit_m > 20e-6
    for name in truth.names:
        depth, mask = truth.depth(name), truth.mask(name)
        points = truth.views[name].cam_from_world.inverse() * (
            truth.rays(name)[mask] * (depth / truth.rays(name)[..., 2])[mask][:, None]
        )
        radius = np.linalg.norm(points - [0, 0, 1], axis=1)
        assert np.abs(radius - 1).max() < 1e-3  # the chords of the mesh, and the depth's step


def test_a_flat_mesh_is_no_object_on_a_table(renderer, tmp_path):
    sheet = "v 0 0 3\nv 1 0 3\nv 0 1 3\nf 1 2 3\n"
    (tmp_path / "sheet.obj").write_text(sheet)
    with pytest.raises(DataError, match=r"sheet\.obj: is flat"):
        polmvs.simulate(tmp_path / "sheet.obj", tmp_path / "c", **SMALL)
    options = {**SMALL, "views": 1, "image_size": (48, 40), "surroundings": "nothing", "marks": 0}
    polmvs.simulate(tmp_path / "sheet.obj", tmp_path / "c", **options, size=0.1)


def test_a_capture_is_replaced_only_by_one_that_can_be_rendered(renderer, tmp_path):
    (tmp_path / "away.txt").write_text("a 1 0 0 0 0 0 -9\n")
    options = {**SMALL, "image_size": (48, 40), "views": 1, "surroundings": "nothing"}
    polmvs.simulate("plane", tmp_path / "c", **options)
    first = (tmp_path / "c" / "raw" / "000.png").read_bytes()
    with pytest.raises(OptionError, match="see nothing"):
        polmvs.simulate(
            "plane", tmp_path / "c", overwrite=True, cameras=tmp_path / "away.txt", **options
        )
    assert (tmp_path / "c" / "raw" / "000.png").read_bytes() == first
    polmvs.simulate("plane", tmp_path / "c", overwrite=True, light="softbox", **options)
    assert (tmp_path / "c" / "raw" / "000.png").read_bytes() != first


def test_other_folders_are_left_alone(renderer, tmp_path):
    (tmp_path / "thesis.txt").write_text("mine")
    with pytest.raises(DataError, match="no simulated capture"):
        polmvs.simulate("dome", tmp_path, overwrite=True, **SMALL)
    assert (tmp_path / "thesis.txt").read_text() == "mine"


@pytest.mark.parametrize("full_at", ["mesh.ply", "001_depth.png", "001.png"])
def test_a_full_disk_is_one_line_and_what_is_whole_is_gone_on_with(
    renderer, tmp_path, monkeypatch, capsys, full_at
):
    """The system refuses a file at its end; those before it went well."""
    replace = os.replace

    def replaces(source, target, **kwargs):
        if os.path.basename(target) == full_at:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), os.fspath(source))
        replace(source, target, **kwargs)

    out = tmp_path / "c"
    args = ["simulate", "plane", str(out), "--image-size", "48,40", "--views", "2"]
    args += ["--directions", "4", "--max-samples", "16", "--surroundings", "nothing"]
    monkeypatch.setattr(os, "replace", replaces)
    assert main(args) == 1
    monkeypatch.undo()
    message = capsys.readouterr().err
    assert message.count("\n") == 1
    assert full_at in message
    assert "No space left" in message
    assert not list(out.rglob(f"*{full_at}*"))  # nothing half-written
    assert not (out / "gt" / "cameras.json").exists()
    assert main([*args, "--resume"]) == 0
    assert open_ground_truth(out).names == ("000.png", "001.png")


def test_command_line_and_preview(renderer, tmp_path, capsys):
    out = tmp_path / "c"
    args = ["simulate", "mug", str(out), "--preview", "--image-size", "320,256", "--json"]
    args += ["--directions", "8"]
    status = main(args)
    assert status == 0
    content = json.loads(capsys.readouterr().out)
    assert content["num_views"] == 2
    assert (open_ground_truth(out).views["000.png"].camera.width) == 40


def test_scalar_renderer_agrees(renderer, tmp_path):
    """Mitsuba's own path tracer, which bakes nothing, gives the same light."""
    options = {"image_size": (48, 40), "views": 1, "marks": 0, "material": "black-plastic"}
    options |= {"light": "studio", "roughness": 0.1}
    try:
        polmvs.simulate(
            "dome",
            tmp_path / "scalar",
            variant="scalar_spectral_polarized",
            max_samples=64,
            **options,
        )
    finally:
        renderer.mi.set_variant(renderer.variant)
    polmvs.simulate("dome", tmp_path / "jit", directions=64, max_samples=64, **options)
    slow, quick = (np.load(tmp_path / n / "gt" / "000_stokes.npy") for n in ("scalar", "jit"))
    mask = binary_erosion(open_ground_truth(tmp_path / "jit").mask("000.png"))
    assert mask.sum() > 60
    for index in range(3):
        assert np.corrcoef(slow[index][mask], quick[index][mask])[0, 1] > 0.97
        scale = np.abs(quick[index][mask]).mean()
        assert np.abs(slow[index] - quick[index])[mask].mean() < 0.15 * scale
    assert slow[0][mask].mean() == pytest.approx(quick[0][mask].mean(), rel=0.02)
    assert slow[0][~mask].mean() == pytest.approx(quick[0][~mask].mean(), rel=0.03)
