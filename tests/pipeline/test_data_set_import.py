"""Public sets written in their real layout from the demo: same phases, poses and masks."""

import json
import struct
from functools import partial

import cv2
import numpy as np
import pytest
from capture_writer import PATTERN, bits_of_stream, split_mosaic, stokes_of
from data_set_writer import (
    mvas,
    nersp,
    neus,
    pandora,
    pisr,
    pisr_maps,
    ppa4p3d,
    transpir,
)

from polmvs.camera import PinholeCamera, pixel_centers
from polmvs.colmap.models import read_model
from polmvs.config import (
    BayerOrder,
    CaptureKind,
    CaptureOptions,
    Options,
    SfmOptions,
)
from polmvs.errors import DataError, OptionError
from polmvs.geometry import RigidTransform
from polmvs.io.data_sets import DataSetKind, read_data_set, recognise_data_set
from polmvs.io.raw_formats import read_raw
from polmvs.pipeline.data_set_import import as_capture, import_data_set
from polmvs.polarization.capture import open_capture
from polmvs.polarization.kinds import Light
from polmvs.polarization.stokes import axial_difference
from polmvs.scene import View

STEMS = ("000", "003", "007")
WIDTH, HEIGHT = 916, 768  # multiples of 4, for colour


@pytest.fixture(scope="module")
def source(demo_capture):
    """Linear mosaics, views and masks of three of the demo's images, by stem."""
    truth = json.loads((demo_capture / "gt" / "cameras.json").read_text())["images"]
    rng = np.random.default_rng(0)
    result = {}
    for stem in STEMS:
        raw = read_raw(demo_capture / "raw" / f"{stem}.png").samples[:, :WIDTH]
        share = np.clip((raw + rng.uniform(-0.5, 0.5, raw.shape)) / 255, 0, 1)
        K = np.array(truth[f"{stem}.png"]["K"])
        pose = np.array(truth[f"{stem}.png"]["cam_from_world"])
        camera = PinholeCamera(
            width=WIDTH // 2, height=HEIGHT // 2,
            fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2],
        )  # fmt: skip
        view = View(
            name=f"{stem}.png",
            camera=camera,
            cam_from_world=RigidTransform(pose[:, :3], pose[:, 3]),
        )
        mask = cv2.imread(str(demo_capture / "gt" / f"{stem}_mask.png"), -1)[:, : WIDTH // 2] > 0
        result[stem] = (share, view, mask)
    return result


SETS = {
    # Writer, kind, largest median error of the AoLP on the part, degrees.
    "ppa4p3d": (ppa4p3d, DataSetKind.PPA4P3D, 1.0),
    "PISR": (pisr, DataSetKind.PISR, 4.0),  # colours: a quarter of the samples each
    "PISR, maps": (pisr_maps, DataSetKind.PISR, 0.01),
    "PANDORA": (pandora, DataSetKind.PANDORA, 1.0),
    "NeRSP": (nersp, DataSetKind.NERSP, 0.01),
    "NeuS": (neus, DataSetKind.NEUS, 1.0),
    "NeuS of mosaics' cameras": (partial(neus, mosaics=True), DataSetKind.NEUS, 1.0),
    "TransPIR": (transpir, DataSetKind.TRANSPIR, 1.0),
    "MVAS": (mvas, DataSetKind.MVAS, 0.01),
}


@pytest.mark.parametrize("name", SETS)
def test_sets_are_read_as_they_are_published(tmp_path, source, name):
    write, kind, worst = SETS[name]
    root, out = tmp_path / "set", tmp_path / "out"
    stems = write(root, source)
    assert recognise_data_set(root) is kind
    before = sorted(p.as_posix() for p in root.rglob("*"))
    imported = import_data_set(root, out)
    assert sorted(p.as_posix() for p in root.rglob("*")) == before
    assert imported.data_set.names == tuple(stems)
    assert imported.light is (Light.DIFFUSE if kind is DataSetKind.MVAS else None)
    options = imported.data_set.options
    if imported.data_set.capture is None:
        from dataclasses import replace

        options = replace(options, kind=CaptureKind.STOKES)
    capture = open_capture(imported.capture, options)
    assert (capture.width, capture.height) == (WIDTH // 2, HEIGHT // 2)
    views = {view.name: view for view in read_model(imported.sparse).views}
    for image, stem, (share, view, mask) in zip(capture.names, stems, source.values(), strict=True):
        stokes = capture.load(image)
        expected = stokes_of(share)
        strong = np.hypot(expected["s1"], expected["s2"]) > 0.2 * expected["s0"]
        seen = strong & stokes.valid & mask
        assert seen.sum() > 1000
        aolp = 0.5 * np.arctan2(expected["s2"], expected["s1"])
        error = np.degrees(np.abs(axial_difference(stokes.aolp, aolp)))[seen]
        assert np.median(error) < worst
        if kind is not DataSetKind.MVAS:  # which has no DoLP; the others' shows a wrong gamma
            dolp = np.hypot(expected["s1"], expected["s2"]) / expected["s0"]
            assert np.median(np.abs(stokes.dolp - dolp)[seen] / dolp[seen]) < 0.15
        read = views[f"{stem}.png"]
        xy = pixel_centers(WIDTH // 2, HEIGHT // 2)[::50, ::50]
        np.testing.assert_allclose(read.camera.rays(xy), view.camera.rays(xy), atol=1e-6)
        np.testing.assert_allclose(
            read.cam_from_world.rotation, view.cam_from_world.rotation, atol=1e-6
        )
        np.testing.assert_allclose(
            read.cam_from_world.translation, view.cam_from_world.translation, atol=1e-6
        )
        if imported.masks is not None:
            saved = cv2.imread(str(imported.masks / f"{stem}.png"), -1)
            np.testing.assert_array_equal(saved > 0, mask)
    if imported.data_set.cameras:
        assert imported.num_points > 50


def test_reconstruct_and_inspect_know_a_set_by_themselves(tmp_path, source, cli):
    root, out = tmp_path / "set", tmp_path / "out"
    neus(root, source)
    status, text, _ = cli("inspect", root)
    assert status == 0
    assert text.startswith("a set in the layout of NeuS, with 3 cameras and 3 masks, which")
    capture, options = as_capture(root, out, Options())
    assert options.sfm.sparse == tmp_path / "out_import" / "sparse"
    assert options.region.mask == tmp_path / "out_import" / "masks"
    made = (tmp_path / "out_import" / "import.json").stat().st_mtime_ns
    for given in (Options(), options):  # found again, also by a run that goes on
        assert as_capture(root, out, given) == (capture, options)
    assert (tmp_path / "out_import" / "import.json").stat().st_mtime_ns == made
    status, text, err = cli("sfm", root, out)
    assert status == 0, err
    assert "3 of 3 views have a pose" in text
    own = Options(sfm=SfmOptions(sparse=tmp_path / "own"))  # poses that the user gives
    assert as_capture(root, out, own) == (root, own)
    assert as_capture(root / "raw", out, Options()) == (root / "raw", Options())
    (tmp_path / "other_import").mkdir()
    with pytest.raises(DataError, match="is in the way of the import"):
        as_capture(root, tmp_path / "other", Options())


def test_import_command(tmp_path, source, cli):
    root, out = tmp_path / "set", tmp_path / "out"
    neus(root, source)
    status, text, _ = cli("import", root, out)
    assert status == 0
    assert text.splitlines()[0] == f"{out}: 3 views of NeuS"
    words = ["polmvs", "reconstruct", str(root), "RUN", "--config", str(out / "capture.toml")]
    assert text.splitlines()[2].startswith(" ".join(words))
    status, _, err = cli("import", root, out)
    assert (status, err.count("\n")) == (2, 1)
    assert "exists" in err
    status, _, err = cli("import", root / "raw", tmp_path / "nothing")
    assert status == 1
    assert "no set that is known (ppa4p3d, PISR, PANDORA, NeRSP, MVAS, TransPIR, NeuS)" in err
    assert not (tmp_path / "nothing").exists()


def test_pandora_dumps(tmp_path, source, monkeypatch):
    monkeypatch.setattr("polmvs.io.data_sets.PANDORA_SIZE", (WIDTH, HEIGHT))
    root = tmp_path / "set"
    pandora(root, source)
    for path in (root / "images_stokes").iterdir():
        path.unlink()
    (root / "images_stokes").rmdir()
    (root / "images_raw").mkdir()
    for k, (share, _, _) in enumerate(source.values()):
        samples = np.rint(share * 4095).astype(np.uint16)
        (root / "images_raw" / f"{k + 1:02d}.raw").write_bytes(bits_of_stream(samples, 12))
    data_set = read_data_set(root, CaptureOptions(bayer=BayerOrder.GRBG))
    assert data_set.capture == root / "images_raw"
    capture = open_capture(data_set.capture, data_set.options)
    s0 = capture.load("01.raw").s0
    expected = split_mosaic(next(iter(source.values()))[0], PATTERN).sum(axis=0) / 2
    assert np.median(np.abs(s0 - expected)) < 0.02


def test_masks_of_the_mosaics_size_are_halved(tmp_path, source):
    root = tmp_path / "set"
    stems = pandora(root, source)
    for stem, (_, _, mask) in zip(stems, source.values(), strict=True):
        big = np.kron(mask.astype(np.uint8), np.ones((2, 2), np.uint8))
        cv2.imwrite(str(root / "mask" / f"{stem}.png"), 255 * big)
    imported = import_data_set(root, tmp_path / "out")
    saved = cv2.imread(str(imported.masks / f"{stems[0]}.png"), -1)
    np.testing.assert_array_equal(saved > 0, source[STEMS[0]][2])


def damage(root, name, content):
    path = root / name
    if content is None:
        path.unlink()
    else:
        path.write_bytes(content)


@pytest.mark.parametrize(
    ("write", "name", "content", "words"),
    [
        (nersp, "cameras.npz", None, r"cameras\.npz: cannot be read"),
        (nersp, "cameras.npz", b"PK", "no readable .npz"),
        (nersp, "s1/0001.npy", None, "0001"),
        (pandora, "images_stokes/02_s0p1.hdr", None, "lacks 02_s0p1"),
        (pandora, "images_stokes/02_s0p1.hdr", b"#?RADIANCE\n", "02_s0p1"),
        (pandora, "mask/02.png", None, "no mask of 02"),
        (pisr_maps, "intrinsics.npz", b"", "intrinsics.npz"),
        (ppa4p3d, "cams/00000001_cam.txt", b"extrinsic", "00000001_cam"),
        (mvas, "input_azimuth_maps/01.png", struct.pack("<4i", 1, 2, 3, 4), "01.png"),
    ],
)
def test_damaged_sets_name_the_file_and_leave_nothing(
    tmp_path, source, write, name, content, words
):
    root = tmp_path / "set"
    write(root, source)
    damage(root, name, content)
    with pytest.raises((DataError, OptionError), match=words):
        import_data_set(root, tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_world_mats_that_are_no_cameras(tmp_path, source):
    root = tmp_path / "set"
    nersp(root, source)
    for bad in (np.zeros((4, 4)), np.eye(3), np.full((4, 4), np.nan)):
        np.savez(root / "cameras.npz", **{f"world_mat_{k}": bad for k in range(3)})
        with pytest.raises(DataError, match="world_mat_0 is no camera"):
            read_data_set(root)
    np.savez(root / "cameras.npz", other=np.eye(4))
    with pytest.raises(DataError, match="has no world_mat_0000 and no world_mat_0"):
        read_data_set(root)


def test_unknown_layouts_and_existing_targets(tmp_path, source):
    (tmp_path / "empty").mkdir()
    with pytest.raises(DataError, match="no set that is known"):
        import_data_set(tmp_path / "empty", tmp_path / "out")
    mvas(tmp_path / "set", source)
    with pytest.raises(OptionError, match="exists"):
        import_data_set(tmp_path / "set", tmp_path / "empty")
