"""One capture in every format gives the same Stokes images within its rounding."""

import struct

import cv2
import numpy as np
import pytest
from capture_writer import FORMATS, PATTERN, rounded, split_mosaic, stokes_of, tiff_bytes, turn

from polmvs.config import BayerOrder, CaptureKind, CaptureOptions, Channel, Packing, Resolution
from polmvs.errors import DataError, OptionError
from polmvs.io.raw_formats import read_raw
from polmvs.polarization.capture import open_capture
from polmvs.polarization.mosaic import clipped_cells, split_colour_mosaic
from polmvs.polarization.stokes import axial_difference

CROP = (slice(200, 392), slice(300, 556))  # of the demo's mosaics: board, marks and table


@pytest.fixture(scope="module")
def mosaics(demo_capture):
    """Two views as shares of full scale, with the noise that finer steps would show."""
    rng = np.random.default_rng(0)
    views = {}
    for stem in ("003", "007"):
        raw = read_raw(demo_capture / "raw" / f"{stem}.png").samples[CROP]
        share = np.clip((raw + rng.uniform(-0.5, 0.5, raw.shape)) / 255, 0, 1)
        share[raw == 255] = 1.0
        share[40:52, 60:72] = 1.0  # a glint
        views[stem] = share
    return views


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_gives_the_same_stokes(tmp_path, mosaics, name):
    written = FORMATS[name](tmp_path, mosaics)
    capture = open_capture(tmp_path, written.options)
    assert len(capture.names) == len(mosaics)
    for view, share in zip(capture.names, mosaics.values(), strict=True):
        stokes = capture.load(view)
        expected = {k: turn(image, written.turn) for k, image in stokes_of(share).items()}
        assert stokes.shape == expected["s0"].shape
        scale = written.tolerance
        seen = stokes.valid  # the writer clips what a polarizer between the four would let through
        np.testing.assert_allclose(stokes.s0[seen], expected["s0"][seen], atol=2 * scale)
        # Turned by 90 degrees an axis becomes its perpendicular, mirrored 45 becomes 135.
        sign1 = -1 if written.turn >= 5 else 1
        sign2 = -1 if written.turn in (2, 4, 6, 8) else 1
        np.testing.assert_allclose(stokes.s1[seen], sign1 * expected["s1"][seen], atol=scale)
        np.testing.assert_allclose(stokes.s2[seen], sign2 * expected["s2"][seen], atol=scale)
        assert np.isfinite(stokes.sigma).all()
        if capture.files.kind is not CaptureKind.AOLP:
            glint = turn(np.pad(np.ones((4, 4), bool), ((21, 71), (31, 93))), written.turn)
            assert not stokes.valid[glint].any(), capture.levels
            assert stokes.valid.mean() > 0.95


def test_lower_bits_of_a_tiff_orientation_are_said(tmp_path, mosaics, caplog):
    FORMATS["tiff, orientation 6"](tmp_path, mosaics)
    capture = open_capture(tmp_path)
    assert capture.orientations == (6,)
    assert any("orientation 6 is not applied" in note for note in capture.notes)
    assert "orientation" in caplog.text


# --- full scale ------------------------------------------------------------------------------


def tail(brightest, seed=0, num=(120, 160)):
    """Samples that get rarer towards the bright end."""
    values = np.random.default_rng(seed).gamma(2.0, brightest / 6, num)
    return np.rint(np.minimum(values, brightest)).astype(np.uint16)


def save16(folder, *images):
    for k, image in enumerate(images):
        cv2.imwrite(str(folder / f"{k}.png"), image)
    return folder


@pytest.mark.parametrize("bits", [8, 10, 12, 14, 16])
def test_a_pile_at_the_top_decides_the_depth(tmp_path, bits):
    top = 2**bits - 1
    image = tail(top)
    image[:10, :10] = top
    dark = tail(top // 20, seed=1)
    capture = open_capture(save16(tmp_path, dark, image))
    assert (capture.levels.bit_depth, capture.full_scale) == (bits, top)
    assert not capture.load("1.png").valid[2, 2]
    assert capture.load("0.png").valid.all()


def test_a_clipped_14_bit_sky_is_invalid(tmp_path):
    image = tail(9000)
    image[:60] = 16383
    stokes = open_capture(save16(tmp_path, image)).load("0.png")
    assert not stokes.valid[:30].any()
    assert stokes.valid[32:].mean() > 0.9


def test_a_dark_12_bit_capture_is_not_taken_for_a_clipped_10_bit_one(tmp_path):
    rng = np.random.default_rng(2)
    image = rng.integers(0, 1024, (120, 160)).astype(np.uint16)
    image[:, :50] = rng.integers(1003, 1023, (120, 50))
    capture = open_capture(save16(tmp_path, image))
    assert capture.full_scale == 4095
    assert "no sample is clipped" in capture.levels.reason
    assert capture.load("0.png").valid.all()


def test_a_sensor_that_clips_below_its_full_scale(tmp_path):
    image = tail(4095)
    image = np.minimum(image, 3800)
    image[:20, :20] = 3800
    capture = open_capture(save16(tmp_path, image))
    assert (capture.full_scale, capture.levels.clip_level) == (4095, 3800)
    assert not capture.load("0.png").valid[4, 4]


def test_the_given_full_scale_is_taken(tmp_path):
    image = tail(700)
    options = CaptureOptions(full_scale=1023)
    capture = open_capture(save16(tmp_path, image), options)
    assert capture.full_scale == 1023
    guessed = open_capture(tmp_path)
    assert guessed.full_scale == 4095
    ratio = capture.load("0.png").s0.mean() / guessed.load("0.png").s0.mean()
    assert ratio == pytest.approx(4095 / 1023, rel=1e-5)
    with pytest.raises(OptionError, match="full_scale"):
        CaptureOptions(full_scale=-1)


# --- pattern ---------------------------------------------------------------------------------


@pytest.mark.parametrize("pattern", [(0, 45, 90, 135), (0, 90, 45, 135), (45, 135, 90, 0)])
def test_a_swapped_pattern_is_refused_with_one_that_fits(tmp_path, mosaics, pattern):
    FORMATS["png, 8 bits"](tmp_path, mosaics)
    with pytest.raises(OptionError, match=r"does not fit.*pattern` 90,45,135,0"):
        open_capture(tmp_path, CaptureOptions(pattern=pattern))


def test_an_unpolarized_capture_says_nothing_of_its_pattern(tmp_path):
    flat = np.random.default_rng(0).poisson(90, (240, 320)).astype(np.uint8)
    cv2.imwrite(str(tmp_path / "a.png"), flat)
    for pattern in (PATTERN, (0, 45, 90, 135)):
        check = open_capture(tmp_path, CaptureOptions(pattern=pattern)).pattern_check
        assert check.fits is None
        assert "too little" in check.message


# --- colour ----------------------------------------------------------------------------------

COLOURS = {"r": 0.5, "g": 1.0, "b": 0.7}


def colour_mosaic(bayer, height=64, width=96):
    """Linear ramps behind a colour sensor; ramps at the cells' centres beside it."""
    y, x = np.mgrid[0:height, 0:width] + 0.5
    s0 = 0.4 + 0.002 * x + 0.003 * y

    def light(angle, s0):
        return 0.5 * s0 * (1 + 0.4 * np.cos(2 * np.radians(angle - 25)))

    raw = np.zeros((height, width))
    for block, colour in enumerate(bayer):
        for cell, angle in enumerate(PATTERN):
            site = np.s_[2 * (block // 2) + cell // 2 :: 4, 2 * (block % 2) + cell % 2 :: 4]
            raw[site] = COLOURS[colour] * light(angle, s0)[site]
    return raw, s0


@pytest.mark.parametrize("bayer", list(BayerOrder))
def test_colour_mosaics_are_exact_on_ramps(tmp_path, bayer):
    raw, s0 = colour_mosaic(bayer)
    np.save(tmp_path / "a.npy", raw.astype(np.float32))
    inside = np.s_[4:-4, 4:-4]
    for channel, gain in zip(("red", "green", "blue"), COLOURS.values(), strict=True):
        options = CaptureOptions(bayer=bayer, channel=Channel(channel))
        stokes = open_capture(tmp_path, options).load("a.npy")
        expected = gain * s0.reshape(32, 2, 48, 2).mean(axis=(1, 3))
        np.testing.assert_allclose(stokes.s0[inside], expected[inside], rtol=1e-5)
        np.testing.assert_allclose(stokes.dolp[inside], 0.4, rtol=1e-4)
        np.testing.assert_allclose(np.degrees(stokes.aolp[inside]), 25, atol=0.01)
    full = CaptureOptions(bayer=bayer, resolution=Resolution.FULL, channel=Channel.GREEN)
    stokes = open_capture(tmp_path, full).load("a.npy")
    np.testing.assert_allclose(stokes.s0[8:-8, 8:-8], s0[8:-8, 8:-8], rtol=1e-5)


def test_colours_are_combined_by_their_noise(tmp_path):
    raw, _ = colour_mosaic("rggb", 256, 256)
    noisy = raw + np.random.default_rng(0).normal(0, 0.01, raw.shape)
    np.save(tmp_path / "a.npy", noisy.astype(np.float32))
    errors = {}
    for channel in Channel:
        options = CaptureOptions(bayer=BayerOrder.RGGB, channel=channel)
        stokes = open_capture(tmp_path, options).load("a.npy")
        error = axial_difference(stokes.aolp, np.radians(25))[8:-8, 8:-8]
        errors[channel] = float(np.sqrt(np.mean(np.square(error))))
    assert errors[Channel.COMBINED] < 0.9 * min(errors[c] for c in ("red", "green", "blue"))


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("site", [(24, 24), (25, 26), (26, 25), (27, 27)])
def test_clipped_samples_of_colour_mosaics_spoil_what_they_reach(full, site):
    raw, _ = colour_mosaic("rggb")
    spoiled = raw.copy()
    spoiled[site] = 5.0
    before, after = (
        split_colour_mosaic(image, PATTERN, BayerOrder.RGGB, full=full) for image in (raw, spoiled)
    )
    changed = np.abs(after - before).max(axis=(0, 1)) > 1e-6
    reach = clipped_cells(spoiled, 2.0, colour=True, full=full)
    assert changed.any()
    assert not (changed & ~reach).any()
    assert reach.sum() <= 2 * changed.sum()


def test_sides_of_colour_mosaics_are_multiples_of_four(tmp_path):
    np.save(tmp_path / "a.npy", np.ones((64, 98), np.uint16))
    with pytest.raises(DataError, match="multiples of 4"):
        open_capture(tmp_path, CaptureOptions(bayer=BayerOrder.RGGB))


# --- full resolution -------------------------------------------------------------------------


def test_full_resolution_keeps_samples_and_ramps(tmp_path):
    height, width = 48, 64
    y, x = np.mgrid[0:height, 0:width] + 0.5
    s0 = 0.5 + 0.003 * x + 0.002 * y
    raw = np.zeros((height, width))
    for cell, angle in enumerate(PATTERN):
        site = np.s_[cell // 2 :: 2, cell % 2 :: 2]
        raw[site] = (0.5 * s0 * (1 + 0.3 * np.cos(2 * np.radians(angle - 70))))[site]
    np.save(tmp_path / "a.npy", raw.astype(np.float32))
    capture = open_capture(tmp_path, CaptureOptions(resolution=Resolution.FULL))
    assert (capture.width, capture.height) == (width, height)
    stokes = capture.load("a.npy")
    inside = np.s_[2:-2, 2:-2]
    np.testing.assert_allclose(stokes.s0[inside], s0[inside], rtol=1e-5)
    np.testing.assert_allclose(np.degrees(stokes.aolp[inside]), 70, atol=0.01)


# --- exposures -------------------------------------------------------------------------------


def test_exposures_are_merged_by_noise(tmp_path, mosaics):
    rng = np.random.default_rng(0)
    times = (0.5, 2, 8)
    for stem, share in mosaics.items():
        for time in times:
            electrons = rng.poisson(share * time / 2 * 10_000) + rng.normal(0, 2.5, share.shape)
            samples = np.clip(np.rint(electrons / 10_000 * 4095), 0, 4095)
            cv2.imwrite(str(tmp_path / f"{stem}_{time:g}ms.png"), samples.astype(np.uint16))
    capture = open_capture(tmp_path)
    assert capture.files.exposures_s == pytest.approx((8e-3, 2e-3, 5e-4))
    assert len(capture.names) == 2
    for view, share in zip(capture.names, mosaics.values(), strict=True):
        stokes = capture.load(view)
        # In units of the longest exposure, four times that of the shares.
        expected = {k: 4 * image for k, image in stokes_of(share).items()}
        assert stokes.valid.mean() > 0.99  # the shortest is not clipped where the longest is
        for k in ("s0", "s1", "s2"):
            error = getattr(stokes, k) - expected[k]
            assert np.median(np.abs(error)) < 0.012
            assert abs(np.median(error)) < 0.002
    assert any("3 exposures" in note for note in capture.notes)


def test_frames_named_by_time_are_no_exposures(tmp_path):
    for seconds in (10, 20, 30):
        cv2.imwrite(str(tmp_path / f"run_{seconds}s.png"), tail(200).astype(np.uint8))
    assert len(open_capture(tmp_path).names) == 3


# --- names -----------------------------------------------------------------------------------


def test_frame_numbers_are_no_angles(tmp_path):
    for k in range(20):
        cv2.imwrite(str(tmp_path / f"object_{k:03d}.png"), tail(200).astype(np.uint8))
    capture = open_capture(tmp_path)
    assert capture.files.kind is CaptureKind.MOSAIC
    assert len(capture.names) == 20


def test_a_missing_angle_names_the_view(tmp_path, mosaics):
    FORMATS["angles by ending"](tmp_path, mosaics)
    (tmp_path / "007_090.png").unlink()
    options = CaptureOptions(naming="{view}_{angle}.png")
    with pytest.raises(DataError, match="'007' lacks its image '90'"):
        open_capture(tmp_path, options)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"naming": "{view}_{angel}.png"}, "{angel} is unknown"),
        ({"naming": "{view}_{index}.png"}, "capture.angles"),
        ({"naming": "{view}_{view}.png"}, "twice"),
        ({"naming": "{view}.tif"}, "no image's name fits"),
        ({"naming": "{view}_{angle}.png", "kind": CaptureKind.STOKES}, r"kind` says stokes"),
        ({"kind": CaptureKind.STOKES}, "kind stokes"),
        ({"bayer": BayerOrder.RGGB}, r"capture\.bayer"),
        ({"resolution": Resolution.FULL}, r"capture\.resolution"),
    ],
)
def test_names_and_options_that_do_not_fit(tmp_path, mosaics, options, words):
    FORMATS["angles by ending"](tmp_path, mosaics)
    with pytest.raises((DataError, OptionError), match=words):
        open_capture(tmp_path, CaptureOptions(**options))


def test_dumps_need_their_size(tmp_path, mosaics):
    FORMATS["dump, mono12p"](tmp_path, mosaics)
    with pytest.raises(OptionError, match=r"width.*height"):
        open_capture(tmp_path)
    size = {"width": 256, "height": 192}
    with pytest.raises(OptionError, match="mono12p or mono10packed or mono12packed"):
        open_capture(tmp_path, CaptureOptions(**size))
    with pytest.raises(DataError, match="bytes"):
        open_capture(tmp_path, CaptureOptions(width=256, height=190, packing=Packing.MONO12P))


# --- lossy -----------------------------------------------------------------------------------


@pytest.mark.parametrize("quality", [50, 75, 90, 95, 98])
@pytest.mark.parametrize("suffix", [".jpg", ".png"])
def test_a_jpeg_is_recognised_and_its_noise_covers_the_error(
    tmp_path, demo_capture, caplog, quality, suffix
):
    raw = read_raw(demo_capture / "raw" / "003.png").samples
    _, data = cv2.imencode(".jpg", raw, [cv2.IMWRITE_JPEG_QUALITY, quality])
    path = tmp_path / f"a{suffix}"
    if suffix == ".jpg":
        path.write_bytes(data.tobytes())
    else:
        cv2.imwrite(str(path), cv2.imdecode(data, cv2.IMREAD_UNCHANGED))
    capture = open_capture(tmp_path)
    assert capture.lossy_steps is not None
    assert "JPEG" in caplog.text
    stokes = capture.load(path.name)
    expected = stokes_of(raw / 255)
    inside = np.s_[2:-2, 2:-2]
    error = np.stack([stokes.s1 - expected["s1"], stokes.s2 - expected["s2"]])
    rms = np.sqrt(np.mean(np.square(error), axis=0))[inside]
    stated = stokes.sigma[inside]
    assert np.mean(rms < stated) > 0.65
    # Yet by no more than some times the error.
    whole = open_capture(demo_capture).load("003.png").sigma[inside]
    widened = np.sqrt(np.maximum(np.square(stated) - np.square(whole), 0))
    assert np.median(widened) < 6 * np.median(rms)


@pytest.mark.parametrize("quality", [60, 85])
def test_jpegs_of_single_polarizers_state_the_error_of_a_block(tmp_path, quality):
    """Means of 8x8 px err by what is stated; that of the pixels is in the rest of the noise."""
    rng = np.random.default_rng(quality)
    rows, cols = np.mgrid[:256, :320]
    s0 = 90 + 30 * np.sin(rows / 37) + 25 * np.cos(cols / 51)
    for angle in (0, 45, 90, 135):
        samples = s0 * (1 + 0.1 * np.cos(2 * np.radians(angle) - cols / 300))
        samples = np.clip(np.rint(samples + rng.normal(0, 1.5, s0.shape)), 0, 255).astype(np.uint8)
        cv2.imwrite(str(tmp_path / f"a_{angle}.png"), samples)
        quality_of = [cv2.IMWRITE_JPEG_QUALITY, quality]
        (tmp_path / "jpeg").mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / "jpeg" / f"a_{angle}.jpg"), samples, quality_of)
    folders = {"png": tmp_path, "jpg": tmp_path / "jpeg"}
    images = [
        open_capture(folder, CaptureOptions(naming=f"{{view}}_{{angle}}.{suffix}"))
        for suffix, folder in folders.items()
    ]
    clean, lossy = (capture.load(capture.names[0]) for capture in images)
    assert clean.lossy_sigma == 0
    error = np.stack([lossy.s1 - clean.s1, lossy.s2 - clean.s2])
    blocks = error.reshape(2, 32, 8, 40, 8).mean(axis=(2, 4))
    assert lossy.lossy_sigma == pytest.approx(blocks.std(), rel=0.5)


def test_no_capture_is_called_lossy_by_mistake(demo_capture):
    assert open_capture(demo_capture).lossy_steps is None


# --- TIFF ------------------------------------------------------------------------------------


@pytest.mark.parametrize("orientation", range(1, 9))
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
def test_tiff_samples_stay_as_stored(tmp_path, orientation, dtype):
    image = rounded(np.random.default_rng(0).uniform(size=(24, 32)), 8 * np.dtype(dtype).itemsize)
    path = tmp_path / "a.tif"
    path.write_bytes(tiff_bytes(image, orientation))
    raw = read_raw(path)
    np.testing.assert_array_equal(raw.samples, image)
    assert raw.orientation == orientation


def test_split_of_the_writer_is_that_of_the_package():
    assert split_mosaic.__module__ == "polmvs.polarization.mosaic"


# --- what would be misread ---------------------------------------------------------------------


def four_page_tiff(page, purposes=(0, 0, 0, 0)):
    """The bytes of a TIFF of several pages, of which some may be previews (bit 0 of tag 254)."""
    height, width = page.shape
    data = bytearray(b"II*\0" + struct.pack("<I", 8))
    for number, purpose in enumerate(purposes):
        start = len(data)
        tags = [
            (254, 4, purpose), (256, 4, width), (257, 4, height), (258, 3, 8), (259, 3, 1),
            (262, 3, 1), (273, 4, start + 2 + 12 * 9 + 4), (277, 3, 1), (279, 4, page.size),
        ]  # fmt: skip
        data += struct.pack("<H", len(tags))
        for tag, kind, value in tags:
            data += struct.pack("<HHII", tag, kind, 1, value)
        end = start + 2 + 12 * len(tags) + 4 + page.size
        data += struct.pack("<I", end if number + 1 < len(purposes) else 0) + page.tobytes()
    return bytes(data)


def test_a_tiff_of_several_images_is_refused_and_says_why(tmp_path):
    page = np.arange(64, dtype=np.uint8).reshape(8, 8)
    path = tmp_path / "a.tif"
    path.write_bytes(four_page_tiff(page))
    with pytest.raises(DataError, match="holds 4 images; one in a file is read"):
        read_raw(path)
    path.write_bytes(four_page_tiff(page, (0, 1)))  # an image and its preview
    np.testing.assert_array_equal(read_raw(path).samples, page)


@pytest.mark.parametrize("shape", [(32, 32, 3), (3, 32, 32)])
def test_an_array_of_stokes_images_is_known_for_what_it_is(tmp_path, shape):
    rng = np.random.default_rng(0)
    for name in "ab":
        stokes = rng.uniform(0.0, 0.1, shape).astype(np.float32)
        np.moveaxis(stokes, int(np.argmin(shape)), 0)[0] += 0.5
        np.save(tmp_path / f"{name}.npy", stokes)
    with pytest.raises(DataError, match=r"Give `capture\.kind` stokes"):
        open_capture(tmp_path)
    capture = open_capture(tmp_path, CaptureOptions(kind=CaptureKind.STOKES, full_scale=1.0))
    assert capture.names == ("a.npy", "b.npy")
    first = np.moveaxis(np.load(tmp_path / "a.npy"), int(np.argmin(shape)), 0)
    np.testing.assert_allclose(capture.load("a.npy").s1, first[1], atol=1e-7)
