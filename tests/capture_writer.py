"""Writes one capture out in every format that is read; what a camera, an SDK or a script writes.

Samples are given as shares of full scale, a mosaic of cells 90 45 / 135 0 for each view. Each
writer returns the options that the capture needs to be read, and how far each of s0, s1 and s2 may
be from those of the shares themselves by rounding.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from polmvs.config import CaptureKind, CaptureOptions, Packing
from polmvs.polarization.mosaic import ANGLES_DEG, split_mosaic, turned_pattern

PATTERN = (90, 45, 135, 0)
Mosaics = dict[str, np.ndarray]


class Written(NamedTuple):
    options: CaptureOptions
    tolerance: float  # of s0, s1, s2, shares of full scale
    turn: int = 1  # TIFF orientation by which the images are turned


def rounded(share, bits):
    return np.rint(share * (2**bits - 1)).astype(np.uint8 if bits <= 8 else np.uint16)


def tolerance(bits):
    # A Stokes parameter is a weighted sum of samples whose weights sum to 2 in magnitude.
    return 2 * 0.5 / (2**bits - 1) + 1e-6


def integers(suffix: str, bits: int, shift: int = 0):
    def write(folder: Path, mosaics: Mosaics) -> Written:
        for stem, share in mosaics.items():
            assert cv2.imwrite(str(folder / f"{stem}{suffix}"), rounded(share, bits) << shift)
        return Written(CaptureOptions(), tolerance(bits))

    return write


def scaled_12_bits(folder, mosaics):
    for stem, share in mosaics.items():
        deep = rounded(share, 12).astype(float) * 65535 / 4095
        cv2.imwrite(str(folder / f"{stem}.png"), np.rint(deep).astype(np.uint16))
    return Written(CaptureOptions(), tolerance(12) + 1e-5)


def pgm_12_bits(folder, mosaics):
    for stem, share in mosaics.items():
        height, width = share.shape
        header = b"P5\n# a camera\n%d %d\n4095\n" % (width, height)
        (folder / f"{stem}.pgm").write_bytes(header + rounded(share, 12).astype(">u2").tobytes())
    return Written(CaptureOptions(), tolerance(12))


def tiff_bytes(samples, orientation, bits=None):
    """An uncompressed TIFF with an orientation tag; bits 12: two samples in three bytes."""
    height, width = samples.shape
    if bits == 12:
        pairs = samples.reshape(-1, 2).astype(np.uint16)
        packed = [pairs[:, 0] >> 4, (pairs[:, 0] & 15) << 4 | pairs[:, 1] >> 8, pairs[:, 1] & 255]
        pixels = np.stack(packed, axis=1).astype(np.uint8).tobytes()
    else:
        pixels = samples.tobytes()
    bits = bits or 8 * samples.itemsize
    tags = [
        (256, width), (257, height), (258, bits), (259, 1), (262, 1), (273, 8 + 2 + 12 * 10 + 4),
        (274, orientation), (277, 1), (278, height), (279, len(pixels)),
    ]  # fmt: skip
    entries = b""
    for tag, value in tags:
        short = tag in (258, 259, 262, 274, 277)
        entries += struct.pack("<HHIHxx" if short else "<HHII", tag, 3 if short else 4, 1, value)
    return struct.pack("<2sHIH", b"II", 42, 8, len(tags)) + entries + bytes(4) + pixels


def tiff_with_orientation(orientation):
    def write(folder, mosaics):
        for stem, share in mosaics.items():
            data = tiff_bytes(rounded(share, 16), orientation)
            (folder / f"{stem}.tif").write_bytes(data)
        return Written(CaptureOptions(), tolerance(16))

    return write


def tiff_packed_12_bits(folder, mosaics):
    for stem, share in mosaics.items():
        (folder / f"{stem}.tif").write_bytes(tiff_bytes(rounded(share, 12), 1, bits=12))
    return Written(CaptureOptions(), tolerance(12))


def turned(orientation):
    """The samples themselves turned or mirrored, as software does, with the pattern to it."""

    def write(folder, mosaics):
        for stem, share in mosaics.items():
            image = turn(rounded(share, 16), orientation)
            cv2.imwrite(str(folder / f"{stem}.png"), np.ascontiguousarray(image))
        pattern = turned_pattern(PATTERN, orientation)
        return Written(CaptureOptions(pattern=pattern), tolerance(16), orientation)

    return write


def turn(image, orientation):
    """An image as displayed whose samples have this TIFF orientation."""
    return {
        1: lambda a: a,
        2: lambda a: a[:, ::-1],
        3: lambda a: a[::-1, ::-1],
        4: lambda a: a[::-1],
        5: lambda a: a.T,
        6: lambda a: np.rot90(a, -1),
        7: lambda a: a[::-1, ::-1].T,
        8: lambda a: np.rot90(a),
    }[orientation](image)


def npy(dtype):
    def write(folder, mosaics):
        for stem, share in mosaics.items():
            values = rounded(share, 12) if np.dtype(dtype).kind != "f" else share
            np.save(folder / f"{stem}.npy", values.astype(dtype))
        floats = np.dtype(dtype).kind == "f"
        return Written(CaptureOptions(), 1e-6 if floats else tolerance(12))

    return write


def exr(folder, mosaics):
    import OpenEXR

    for stem, share in mosaics.items():
        header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
        OpenEXR.File(header, {"Y": share.astype(np.float32)}).write(str(folder / f"{stem}.exr"))
    return Written(CaptureOptions(), 1e-6)


def bits_of_stream(samples, bits):
    """Samples as one stream of bits, least significant first: Mono10p and Mono12p."""
    planes = samples.ravel()[:, None] >> np.arange(bits) & 1
    return np.packbits(planes.astype(np.uint8).ravel(), bitorder="little").tobytes()


def packed_pairs(samples, low_bits):
    """High byte, low bits of both, high byte: Mono10Packed and Mono12Packed."""
    first, second = samples.ravel()[::2], samples.ravel()[1::2]
    mask = (1 << low_bits) - 1
    middle = (first & mask) | (second & mask) << 4
    parts = [first >> low_bits, middle, second >> low_bits]
    return np.stack(parts, axis=1).astype(np.uint8).tobytes()


def dump(packing, bits, suffix=".raw", *, named=True):
    def write(folder, mosaics):
        for stem, share in mosaics.items():
            samples = rounded(share, bits)
            match packing:
                case Packing.MONO10P | Packing.MONO12P:
                    data = bits_of_stream(samples, bits)
                case Packing.MONO10PACKED | Packing.MONO12PACKED:
                    data = packed_pairs(samples, bits - 8)
                case _:
                    data = samples.tobytes()
            (folder / f"{stem}{suffix}").write_bytes(data)
        options = CaptureOptions(
            width=share.shape[1], height=share.shape[0], packing=packing if named else None
        )
        return Written(options, tolerance(bits))

    return write


def angle_images(share):
    return dict(zip(ANGLES_DEG, split_mosaic(share, PATTERN), strict=True))


def four_images(template, **options):
    def write(folder, mosaics):
        for stem, share in mosaics.items():
            for angle, image in angle_images(share).items():
                path = folder / template.format(stem=stem, angle=angle)
                path.parent.mkdir(exist_ok=True, parents=True)
                cv2.imwrite(str(path), rounded(image, 16))
        return Written(CaptureOptions(**options), tolerance(16))

    return write


def stokes_of(share):
    i0, i45, i90, i135 = split_mosaic(share, PATTERN)
    return {"s0": 0.5 * (i0 + i45 + i90 + i135), "s1": i0 - i90, "s2": i45 - i135}


def behind(stokes, angle):
    """Malus' law."""
    twice = 2 * np.radians(angle)
    polarized = np.cos(twice) * stokes["s1"] + np.sin(twice) * stokes["s2"]
    return 0.5 * (stokes["s0"] + polarized)


def rotated_polarizer(template, angles, *, index=False, **options):
    def write(folder, mosaics):
        for stem, share in mosaics.items():
            for k, angle in enumerate(angles):
                name = template.format(stem=stem, angle=f"{angle:g}", index=k)
                image = np.clip(behind(stokes_of(share), angle), 0, 1)
                cv2.imwrite(str(folder / name), rounded(image, 16))
        given = {"angles": tuple(map(float, angles))} if index else {}
        # Three images determine s1 and s2 with an error of up to 2 steps.
        return Written(CaptureOptions(**given, **options), 3 * tolerance(16))

    return write


def stokes_arrays(template):
    def write(folder, mosaics):
        for stem, share in mosaics.items():
            for name, image in stokes_of(share).items():
                path = folder / template.format(stem=stem, name=name)
                path.parent.mkdir(exist_ok=True)
                np.save(path, image.astype(np.float32))
        return Written(CaptureOptions(full_scale=1.0), 1e-6)

    return write


def stokes_in_one_array(folder, mosaics):
    for stem, share in mosaics.items():
        planes = np.stack(list(stokes_of(share).values()), axis=-1)
        np.save(folder / f"{stem}.npy", planes.astype(np.float32))
    options = CaptureOptions(kind=CaptureKind.STOKES, naming="{view}.npy", full_scale=1.0)
    return Written(options, 1e-6)


def maps(*, degrees=False, clockwise=False):
    def write(folder, mosaics):
        for stem, share in mosaics.items():
            s = stokes_of(share)
            aolp = 0.5 * np.arctan2(s["s2"], s["s1"])
            aolp = -aolp if clockwise else aolp
            dolp = np.hypot(s["s1"], s["s2"]) / np.maximum(s["s0"], 1e-9)
            np.save(folder / f"{stem}_aolp.npy", np.degrees(aolp % np.pi) if degrees else aolp)
            np.save(folder / f"{stem}_dolp.npy", dolp)
            np.save(folder / f"{stem}_intensity.npy", s["s0"])
        return Written(CaptureOptions(clockwise=clockwise), 1e-5)

    return write


def colour_angle_images(folder, mosaics):
    """RGB, each colour as bright as the others; OpenCV writes them in the order BGR."""
    for stem, share in mosaics.items():
        for angle, image in angle_images(share).items():
            rgb = np.dstack([image, image, image])
            cv2.imwrite(str(folder / f"{stem}_{angle:03d}.png"), rounded(rgb, 16))
    return Written(CaptureOptions(), tolerance(16))


FORMATS: dict[str, Callable[[Path, Mosaics], Written]] = {
    "png, 8 bits": integers(".png", 8),
    "png, 16 bits": integers(".png", 16),
    "png, 10 bits right-aligned": integers(".png", 10),
    "png, 12 bits right-aligned": integers(".png", 12),
    "png, 14 bits right-aligned": integers(".png", 14),
    "png, 10 bits left-aligned": integers(".png", 10, 6),
    "png, 12 bits left-aligned": integers(".png", 12, 4),
    "png, 14 bits left-aligned": integers(".png", 14, 2),
    "png, 10 bits in 12": integers(".png", 10, 2),
    "png, 12 bits scaled to 16": scaled_12_bits,
    "bmp": integers(".bmp", 8),
    "tiff, 16 bits": integers(".tif", 16),
    "tiff, orientation 3": tiff_with_orientation(3),
    "tiff, orientation 6": tiff_with_orientation(6),
    "tiff, 12 bits packed": tiff_packed_12_bits,
    **{f"samples turned, {o}": turned(o) for o in range(2, 9)},
    "pgm, 8 bits": integers(".pgm", 8),
    "pgm, 12 bits": pgm_12_bits,
    "npy, uint16": npy(np.uint16),
    "npy, int32": npy(np.int32),
    "npy, float64": npy(np.float64),
    "exr": exr,
    "dump, mono8": dump(Packing.MONO8, 8, named=False),
    "dump, mono16": dump(Packing.MONO16, 12, ".bin", named=False),
    "dump, mono10p": dump(Packing.MONO10P, 10, named=False),
    "dump, mono12p": dump(Packing.MONO12P, 12),
    "dump, mono10packed": dump(Packing.MONO10PACKED, 10),
    "dump, mono12packed": dump(Packing.MONO12PACKED, 12),
    "angles by ending": four_images("{stem}_{angle:03d}.png"),
    "angles by words": four_images("{stem}-POL{angle}deg.png"),
    "angles by folder": four_images("pol{angle:03d}/{stem}.png"),
    "angles by view": four_images("{stem}/I{angle}.png"),
    "angles by template": four_images("{angle}deg-{stem}.tif", naming="{angle}deg-{view}.tif"),
    "angles 0 60 120": rotated_polarizer("{stem}_{angle}.png", (0, 60, 120)),
    "angles every 20": rotated_polarizer("{stem}-{angle}.png", range(0, 180, 20)),
    "angles by index": rotated_polarizer(
        "{stem}.{index}.png", (10, 50, 100, 170), index=True, naming="{view}.{index}.png"
    ),
    "angle images in colour": colour_angle_images,
    "stokes by folder": stokes_arrays("{name}/{stem}.npy"),
    "stokes by ending": stokes_arrays("{stem}_{name}.npy"),
    "stokes in one array": stokes_in_one_array,
    "maps in rad": maps(),
    "maps in degrees": maps(degrees=True),
    "maps, clockwise": maps(clockwise=True),
}  # fmt: skip
