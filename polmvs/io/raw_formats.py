"""Samples of one image file as the camera stored them, from any container.

OpenCV decodes PNG, TIFF, PGM, BMP, JPEG and Radiance HDR. This module decodes NPY, and dumps
without a header, packed or not, from their size in pixels. OpenEXR has its own library (OpenCV
reads it only if an environment variable is set before its import). Nothing is scaled, turned or
converted: :mod:`polmvs.polarization.bit_depth` decides the meaning of sample values.

A TIFF's orientation tag is reported and not applied: turning the samples would turn the cells of
the mosaic, and views of one camera with different tags would have different cameras.
"""

from __future__ import annotations

import io
import math
import struct
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polmvs.config import MAX_PIXELS, Packing
from polmvs.errors import DataError, OptionError
from polmvs.io.image_size import (
    BIG_TIFF_SIGNATURES,
    BROKEN,
    BYTES_OF_PIXEL,
    PNG_SIGNATURE,
    SCALE_DOWN,
    TIFF_SIGNATURES,
    ImageSize,
    TiffTag,
    declared_size,
    jpeg_segments,
    netpbm_header,
    require_size,
    tiff_images,
)
from polmvs.io.images import PathArg, check_png, decode_image, read_bytes

DUMP_SUFFIXES = frozenset({".raw", ".bin"})
LOSSY_SUFFIXES = frozenset({".jpg", ".jpeg"})
FLOAT_SUFFIXES = frozenset({".exr", ".hdr"})
SUFFIXES = frozenset(
    {".png", ".tif", ".tiff", ".bmp", ".pgm", ".npy", *DUMP_SUFFIXES, *LOSSY_SUFFIXES}
    | FLOAT_SUFFIXES
)
MAX_DIMS = 8  # of an array
RAISE_LIMIT = "Give `capture.max_pixels` if it is the right file."
MAX_HEADER_BYTES = 1 << 20  # beside the samples
PNG_GRAY = 0  # colour type of a monochrome PNG without alpha
UPRIGHT = 1  # orientation tag of an image that is stored as it is shown
TIFF_BITS, TIFF_COMPRESSION, TIFF_ORIENTATION = 258, 259, 274
TIFF_SUBFILE, TIFF_REDUCED = 254, 1  # tag of an image's purpose; bit of a preview
TIFF_JPEG = (6, 7)
JPEG_TABLES = 0xDB
# Order of an 8x8 block's coefficients in a JPEG file, as (row, column).
_ZIGZAG = sorted(
    ((v, u) for v in range(8) for u in range(8)),
    key=lambda at: (sum(at), at[0] if sum(at) % 2 else at[1]),
)
_PACKED_BITS = {
    Packing.MONO10P: 10,
    Packing.MONO12P: 12,
    Packing.MONO10PACKED: 12,
    Packing.MONO12PACKED: 12,
}


class DumpSize(NamedTuple):
    """Size and packing of a dump without a header; None: from the length of the file.

    Attributes
    ----------
    width, height : px.
    packing : layout of the samples in the bytes.
    """

    width: int | None = None
    height: int | None = None
    packing: Packing | None = None


class RawImage(NamedTuple):
    """Samples and metadata of one file.

    Attributes
    ----------
    samples : (H, W), or (H, W, 3) in the order red, green, blue; uint8, uint16 or float32.
    declared_bits : bits of the samples by the file itself, if fewer than their type.
    orientation : 1 to 8 as in TIFF's tag 274; the samples are as stored, not turned.
    quantization : (8, 8) float64, steps of a JPEG's luminance coefficients, rows for vertical
        frequencies; None if the file is not known to be a JPEG.
    lossy : the container has lossy compression; the steps may be unknown.
    """

    samples: NDArray[Any]
    declared_bits: int | None = None
    orientation: int = UPRIGHT
    quantization: NDArray[np.float64] | None = None
    lossy: bool = False

    @property
    def header(self) -> RawHeader:
        """Its size and type."""
        height, width = self.samples.shape[:2]
        channels = 1 if self.samples.ndim == 2 else self.samples.shape[2]
        return RawHeader(width, height, channels, str(self.samples.dtype))


class RawHeader(NamedTuple):
    """Size and type of an image's samples.

    Attributes
    ----------
    width, height : px.
    channels : 1, or 3 in colour.
    dtype : "uint8", "uint16" or "float32".
    """

    width: int
    height: int
    channels: int
    dtype: str


class _Limit(NamedTuple):
    """Largest size that a file may declare, and the remedy for a larger one."""

    max_pixels: int
    remedy: str

    @property
    def most_bytes(self) -> int:
        """Limit of the file's length: its samples and a header."""
        return BYTES_OF_PIXEL * self.max_pixels + MAX_HEADER_BYTES


def _limit(max_pixels: int | None) -> _Limit:
    if max_pixels is None:
        return _Limit(MAX_PIXELS, SCALE_DOWN)
    return _Limit(max_pixels, RAISE_LIMIT)


def read_raw(
    path: PathArg, dump: DumpSize | None = None, *, max_pixels: int | None = None
) -> RawImage:
    """Read an image's samples unchanged.

    Parameters
    ----------
    path : a file with one of ``SUFFIXES``; its content decides where it has a signature.
    dump : size and packing of a ``.raw`` or ``.bin`` file.
    max_pixels : limit for files of a capture; None for other files.

    Raises
    ------
    DataError
        The file is missing, damaged, too large, or of a type without intensities.
    OptionError
        The size or packing of a dump is not given and does not follow from its length.
    """
    suffix = Path(path).suffix.lower()
    limit = _limit(max_pixels)
    data = read_bytes(path, limit.most_bytes)
    if suffix in DUMP_SUFFIXES:
        return RawImage(unpack(path, data, dump if dump is not None else DumpSize()))
    if data.startswith(b"\x93NUMPY"):
        values = read_npy(path, data)
        height, width = (*values.shape, 1, 1)[:2]
        require_size(path, ImageSize(width, height, values.nbytes), **limit._asdict())
        return RawImage(_as_samples(path, values))
    if data.startswith(b"v/1\x01"):
        return RawImage(_as_samples(path, _read_exr(path, limit)))
    if data[:2] == b"P5":
        require_size(path, declared_size(path, data), **limit._asdict())
        return _read_pgm(path, data)
    if data[:4] in (*TIFF_SIGNATURES, *BIG_TIFF_SIGNATURES):
        return _read_tiff(path, data, limit)
    samples = _colour_last(path, decode_image(path, data, **limit._asdict()))
    if data[:2] == b"\xff\xd8":
        return RawImage(samples, quantization=_luminance_steps(path, data), lossy=True)
    return RawImage(samples)


def read_radiance(path: PathArg) -> NDArray[np.float32]:
    """Read an image of radiances (.hdr, .exr, .tif), ``(H, W, 3)`` float32, red green blue.

    Raises
    ------
    DataError
        The file is missing, truncated or not an image of floats, or the package for EXR is missing.
    """
    image = read_raw(path).samples
    if image.dtype != np.float32:
        raise DataError(path, "is no image of radiances; give .hdr, .exr or a .tif of floats.")
    if image.ndim == 2:
        image = np.repeat(image[..., None], 3, axis=-1)
    return np.ascontiguousarray(image[..., :3], np.float32)


def probe_raw(path: PathArg, *, max_pixels: int | None = None) -> RawHeader | None:
    """Size and type of a monochrome PNG without decoding it; None for all other files.

    Its checksums are verified, so it can be decoded later.

    Raises
    ------
    DataError
        The file is missing, or a damaged or too large PNG.
    """
    limit = _limit(max_pixels)
    if Path(path).suffix.lower() != ".png":
        return None
    data = read_bytes(path, limit.most_bytes)
    if not data.startswith(PNG_SIGNATURE):
        return None
    check_png(path, data)
    require_size(path, declared_size(path, data), **limit._asdict())
    width, height, bit_depth, colour_type = struct.unpack_from(">IIBB", data, 16)
    if colour_type != PNG_GRAY or bit_depth not in (8, 16):
        return None
    return RawHeader(width, height, 1, f"uint{bit_depth}")


def unpack(path: PathArg, data: bytes, dump: DumpSize) -> NDArray[Any]:
    """Samples ``(H, W)`` of a dump without a header.

    ``Mono10p`` and ``Mono12p`` are one stream of bits, least significant first; the older
    ``Mono10Packed`` and ``Mono12Packed`` hold the high bytes of two samples about one byte of
    their low bits (GenICam PFNC 2.4 and GigE Vision 2.0).

    Raises
    ------
    DataError
        The length does not fit the size.
    OptionError
        The size is not given, or the packing is not given and is ambiguous for this length.
    """
    if dump.width is None or dump.height is None:
        raise OptionError(
            f"{path}: is a dump without a header. Give `capture.width` and `capture.height`."
        )
    num = dump.width * dump.height
    packing = dump.packing if dump.packing is not None else _packing_of(path, len(data), num)
    expected = _dump_bytes(packing, num)
    if len(data) != expected:
        raise DataError(
            path,
            f"has {len(data):,} bytes; {dump.width}x{dump.height} px of {packing} are "
            f"{expected:,}. Check `capture.width`, `capture.height` and `capture.packing`.",
        )
    shape = (dump.height, dump.width)
    if packing is Packing.MONO8:
        return np.frombuffer(data, np.uint8).reshape(shape)
    if packing is Packing.MONO16:
        return np.frombuffer(data, "<u2").astype(np.uint16).reshape(shape)
    return _unpack_bits(np.frombuffer(data, np.uint8), packing)[:num].reshape(shape)


def _unpack_bits(packed: NDArray[np.uint8], packing: Packing) -> NDArray[np.uint16]:
    """Samples of whole groups of bytes, flat."""
    group = 5 if packing is Packing.MONO10P else 3
    b = packed[: len(packed) // group * group].reshape(-1, group).T.astype(np.uint16)
    match packing:
        case Packing.MONO10P:
            parts = [
                b[0] | (b[1] & 0x03) << 8,
                b[1] >> 2 | (b[2] & 0x0F) << 6,
                b[2] >> 4 | (b[3] & 0x3F) << 4,
                b[3] >> 6 | b[4] << 2,
            ]
        case Packing.MONO12P:
            parts = [b[0] | (b[1] & 0x0F) << 8, b[1] >> 4 | b[2] << 4]
        case Packing.MONO10PACKED:
            parts = [b[0] << 2 | (b[1] & 0x03), b[2] << 2 | (b[1] >> 4 & 0x03)]
        case _:
            parts = [b[0] << 4 | (b[1] & 0x0F), b[2] << 4 | b[1] >> 4]
    return np.stack(parts, axis=-1).ravel()


def _dump_bytes(packing: Packing, num: int) -> int:
    """Bytes of that many samples; an even number of them, as a mosaic has."""
    bits = {Packing.MONO8: 8, Packing.MONO16: 16} | _PACKED_BITS
    return -(-num * bits[packing] // 8)


def _packing_of(path: PathArg, length: int, num: int) -> Packing:
    """The only packing of this length, or a complaint that names those that fit."""
    fits = [packing for packing in Packing if _dump_bytes(packing, num) == length]
    if len(fits) == 1:
        return fits[0]
    if fits:
        raise OptionError(
            f"{path}: may be packed as {' or '.join(fits)}. Say which by `capture.packing`."
        )
    raise DataError(
        path,
        f"has {length:,} bytes, which no packing of {num:,} samples has. "
        "Check `capture.width` and `capture.height`.",
    )


def _as_samples(path: PathArg, values: NDArray[Any]) -> NDArray[Any]:
    """Numbers as uint8, uint16 or float32, unchanged in value."""
    if values.dtype.kind == "f":
        return values.astype(np.float32)
    if values.dtype.kind not in "ui":
        raise DataError(path, f"holds {values.dtype}, no intensities. Store integers or floats.")
    if values.dtype in (np.uint8, np.uint16):
        return values.astype(values.dtype.newbyteorder("="))
    if values.size and (values.min() < 0 or values.max() > 0xFFFF):
        raise DataError(path, "holds integers outside 0 to 65535. Store 16-bit integers or floats.")
    return values.astype(np.uint16)


def _colour_last(path: PathArg, image: NDArray[Any]) -> NDArray[Any]:
    """OpenCV's channels in the order red, green, blue, alpha left out; its types checked."""
    if image.dtype.type not in (np.uint8, np.uint16, np.float32, np.float64):
        raise DataError(path, f"holds {image.dtype}. Export 8- or 16-bit integers, or floats.")
    if image.dtype == np.float64:
        image = image.astype(np.float32)
    if image.ndim == 2:
        return image
    return np.ascontiguousarray(image[..., 2::-1]) if image.shape[2] >= 3 else image[..., 0]


def read_npy(path: PathArg, data: bytes) -> NDArray[Any]:
    """An array of numbers; its header is checked against the length before memory is taken.

    Raises
    ------
    DataError
        The content is not an NPY file, or is truncated.
    """
    stream = io.BytesIO(data)
    try:
        version = np.lib.format.read_magic(stream)
        reader = {
            (1, 0): np.lib.format.read_array_header_1_0,
            (2, 0): np.lib.format.read_array_header_2_0,
        }[version]
        shape, fortran, dtype = reader(stream)
        offset = stream.tell()
    except Exception as error:  # the header goes through Python's own parser
        raise DataError(path, f"is no readable NPY file. {BROKEN}") from error
    num = math.prod(shape)
    sound = all(0 <= side <= 16 * MAX_PIXELS for side in shape) and len(shape) <= MAX_DIMS
    if (
        not sound
        or dtype.hasobject
        or not dtype.itemsize
        or (num * dtype.itemsize != len(data) - offset)
    ):
        raise DataError(path, f"is truncated or no array of numbers. {BROKEN}")
    flat = np.frombuffer(data, dtype, offset=offset)
    return flat.reshape(shape, order="F" if fortran else "C")


def _read_exr(path: PathArg, limit: _Limit) -> NDArray[Any]:
    """The image of an OpenEXR file: its only channel, or red, green and blue."""
    try:
        import OpenEXR
    except ImportError as error:
        raise DataError(
            path, "is an OpenEXR file. Install its library: pip install '.[exr]'."
        ) from error
    try:
        with OpenEXR.File(str(path), header_only=True) as file:
            declared = [_size_of_part(part) for part in file.parts]
    except Exception as error:
        raise DataError(path, f"is no readable OpenEXR file. {BROKEN}") from error
    for size in declared:
        require_size(path, size, **limit._asdict())
    try:
        with OpenEXR.File(str(path)) as file:
            channels = {name: np.array(c.pixels) for name, c in file.channels().items()}
    except Exception as error:  # the library raises RuntimeError, ValueError and its own
        raise DataError(path, f"is no readable OpenEXR file. {BROKEN}") from error
    for name in ("RGB", "RGBA"):
        if name in channels:
            return channels[name][..., :3]
    if len(channels) == 1:
        return next(iter(channels.values()))
    if "Y" in channels:
        return channels["Y"]
    raise DataError(path, f"has the channels {', '.join(sorted(channels))}; one or RGB is read.")


def _size_of_part(part: Any) -> ImageSize:
    """Declared size of a part of an OpenEXR file, four bytes a sample; whole tiles."""
    low, high = part.header["dataWindow"]
    width, height = (int(high[axis]) - int(low[axis]) + 1 for axis in (0, 1))
    tile = part.header.get("tiles")
    if tile is not None:
        width, height = max(width, int(tile.xSize)), max(height, int(tile.ySize))
    return ImageSize(width, height, 4 * width * height * max(len(part.header["channels"]), 1))


def _read_pgm(path: PathArg, data: bytes) -> RawImage:
    """Read a binary PGM; OpenCV drops its maximum value, which gives the bit depth."""
    (width, height, largest), start = netpbm_header(data)
    if not 0 < largest < 1 << 16:
        raise DataError(path, f"is damaged: its PGM header makes no image. {BROKEN}")
    dtype = np.dtype(">u2" if largest > 0xFF else np.uint8)
    pixels = data[start : start + width * height * dtype.itemsize]
    if len(pixels) < width * height * dtype.itemsize:
        raise DataError(path, f"is truncated: {width}x{height} px are promised. {BROKEN}")
    samples = np.frombuffer(pixels, dtype).reshape(height, width).astype(dtype.newbyteorder("="))
    bits = largest.bit_length()
    whole = largest == (1 << bits) - 1 and bits < 8 * dtype.itemsize
    return RawImage(samples, declared_bits=bits if whole else None)


def _read_tiff(path: PathArg, data: bytes, limit: _Limit) -> RawImage:
    """A TIFF as stored: its orientation is read, and hidden from OpenCV, which would apply it."""
    tags, pages = _tiff_tags(data)
    if pages > 1:
        raise DataError(
            path,
            f"holds {pages} images; one in a file is read. Store each in a file of its own, those "
            "of polarizer angles named by them (NAME_000.tif, NAME_045.tif, ...).",
        )
    orientation = tags.get(TIFF_ORIENTATION, TiffTag(UPRIGHT, 0, ""))
    if orientation.value != UPRIGHT:
        patched = bytearray(data)
        struct.pack_into(orientation.format, patched, orientation.place, UPRIGHT)
        data = bytes(patched)
    samples = _colour_last(path, decode_image(path, data, **limit._asdict()))
    bits = tags[TIFF_BITS].value if TIFF_BITS in tags else 0
    odd = samples.dtype.kind == "u" and 8 < bits < 8 * samples.itemsize
    return RawImage(
        samples,
        declared_bits=bits if odd else None,
        orientation=orientation.value if 1 <= orientation.value <= 8 else UPRIGHT,
        lossy=TIFF_COMPRESSION in tags and tags[TIFF_COMPRESSION].value in TIFF_JPEG,
    )


def _tiff_tags(data: bytes) -> tuple[dict[int, TiffTag], int]:
    """Tags of the first image, and how many there are, without previews; 1 of a damaged chain."""
    tags: dict[int, TiffTag] = {}
    pages = 0
    try:
        for image in tiff_images(data):
            tags = tags or image
            pages += TIFF_SUBFILE not in image or not image[TIFF_SUBFILE].value & TIFF_REDUCED
    except ValueError:
        return tags, 1  # OpenCV names the damage
    return tags, pages


def _luminance_steps(path: PathArg, data: bytes) -> NDArray[np.float64]:
    """Quantisation steps (8, 8) of a JPEG's first table, rows for vertical frequencies."""
    try:
        table = next(content for marker, content in jpeg_segments(data) if marker == JPEG_TABLES)
        steps = np.zeros((8, 8))
        kind = np.dtype(">u2" if table[0] >> 4 else np.uint8)
        steps[tuple(np.transpose(_ZIGZAG))] = np.frombuffer(table, kind, 64, 1)
        return steps
    except (ValueError, IndexError, struct.error, StopIteration) as error:
        reason = f"is a damaged JPEG without quantisation tables. {BROKEN}"
        raise DataError(path, reason) from error
