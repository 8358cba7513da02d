"""Sizes and tags in image headers, checked before decoding.

A compressed file of a megabyte may declare an image of a terabyte. Only containers whose header is
read here are decoded.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator
from math import prod
from os import PathLike
from typing import NamedTuple

from polmvs.config import MAX_PIXELS
from polmvs.errors import DataError

BYTES_OF_PIXEL = 8  # on average, of what the limit allows: more than 16-bit colour
BROKEN = "Copy it again from the camera or take it out of the folder."
SCALE_DOWN = "Scale it down, or check that it is the right file."

PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
TIFF_SIGNATURES = (b"II*\0", b"MM\0*")
BIG_TIFF_SIGNATURES = (b"II+\0", b"MM\0+")
PNG_CHANNELS = {2: 3, 4: 2, 6: 4}  # by colour type; 1 of all others
_TIFF_TYPES = {1: "B", 3: "H", 4: "I", 16: "Q"}
_TIFF_WIDTH, _TIFF_HEIGHT, _TIFF_BITS, _TIFF_SAMPLES = 256, 257, 258, 277
_TIFF_TILE_WIDTH, _TIFF_TILE_HEIGHT = 322, 323
_MAX_TIFF_IMAGES = 1 << 16
_MAX_TIFF_TAGS = 1 << 12
# Markers of JPEG that begin a frame: all of their group but tables, and those without a length.
_JPEG_FRAMES = {*range(0xC0, 0xD0)} - {0xC4, 0xC8, 0xCC}
_JPEG_BARE = {0x01, *range(0xD0, 0xD9)}
_JPEG_SCAN = 0xDA
_PNM_NUMBER = rb"(?:\s|#[^\n\r]*[\n\r])+(\d{1,11})"


class ImageSize(NamedTuple):
    """Size declared by a header.

    Attributes
    ----------
    width, height : px; for a tiled image at least those of a tile, which is decoded whole.
    num_bytes : of the decoded samples.
    """

    width: int
    height: int
    num_bytes: int


class TiffTag(NamedTuple):
    """First number of a tag.

    Attributes
    ----------
    value : the number.
    place : of it in the file, bytes.
    format : of it, as ``struct`` has it.
    """

    value: int
    place: int
    format: str


def declared_size(path: str | PathLike[str], data: bytes) -> ImageSize:
    """Size of an encoded image by its header: PNG, TIFF, JPEG, BMP, PGM, PPM or Radiance HDR.

    Raises
    ------
    DataError
        It is none of these, or its header is incomplete.
    """
    try:
        found = _declared(data)
    except (struct.error, ValueError, IndexError, StopIteration) as error:
        raise DataError(
            path, f"is not a readable image, or is damaged or truncated. {BROKEN}"
        ) from error
    if found is None:
        raise DataError(
            path,
            "is not a readable image: its content is no PNG, TIFF, JPEG, BMP, PGM, PPM or HDR. "
            f"{BROKEN}",
        )
    if min(found[:2]) <= 0:
        raise DataError(path, f"is damaged: it cannot hold {found[0]}x{found[1]} px. {BROKEN}")
    return found


def require_size(
    path: str | PathLike[str],
    size: ImageSize,
    *,
    max_pixels: int = MAX_PIXELS,
    remedy: str = SCALE_DOWN,
) -> None:
    """Refuse an image that is larger than a limit.

    Parameters
    ----------
    max_pixels : limit of width times height; all samples may take eight bytes per pixel.
    remedy : a sentence for the message.

    Raises
    ------
    DataError
        The image is larger.
    """
    if size.width * size.height > max_pixels or size.num_bytes > BYTES_OF_PIXEL * max_pixels:
        raise DataError(
            path,
            f"declares {size.width}x{size.height} px, {size.num_bytes / 1e9:.1f} GB; the limit is "
            f"{max_pixels:,} px of {BYTES_OF_PIXEL} bytes. {remedy}",
        )


def _declared(data: bytes) -> ImageSize | None:
    if data.startswith(PNG_SIGNATURE):
        width, height, bits, colour = struct.unpack_from(">IIBB", data, 16)
        samples = 4 if colour == 3 else PNG_CHANNELS.get(colour, 1)  # a palette may have alpha
        return ImageSize(width, height, width * height * samples * (2 if bits == 16 else 1))
    if data[:4] in (*TIFF_SIGNATURES, *BIG_TIFF_SIGNATURES):
        return _of_tiff(data)
    if data[:2] == b"\xff\xd8":
        return _of_jpeg(data)
    if data[:2] == b"BM":
        return _of_bmp(data)
    if re.match(rb"P[1-6][\s#]", data):
        return _of_netpbm(data)
    if data.startswith((b"#?RADIANCE", b"#?RGBE")):
        found = re.search(rb"^[-+]Y (\d{1,10}) [-+]X (\d{1,10})\s", data[: 1 << 16], re.MULTILINE)
        if found is None:
            raise ValueError("no size")
        height, width = int(found[1]), int(found[2])
        return ImageSize(width, height, 12 * width * height)
    return None


def tiff_images(data: bytes) -> Iterator[dict[int, TiffTag]]:
    """Tags that hold whole numbers of each image in a TIFF's or BigTIFF's chain.

    Raises
    ------
    ValueError
        The chain is incomplete.
    """
    order = "<" if data[:2] == b"II" else ">"
    offset, counter, length = ("Q", "Q", 20) if data[:4] in BIG_TIFF_SIGNATURES else ("I", "H", 12)
    room = struct.calcsize(offset)  # bytes of a value that lies in the tag itself

    def number(letter: str, at: int) -> int:
        if at + struct.calcsize(letter) > len(data):
            raise ValueError("not whole")
        return int(struct.unpack_from(order + letter, data, at)[0])

    start, seen = number(offset, room), set[int]()
    while start and start not in seen and len(seen) < _MAX_TIFF_IMAGES:
        seen.add(start)
        num, first = number(counter, start), start + struct.calcsize(counter)
        tags: dict[int, TiffTag] = {}
        for at in range(first, first + length * min(num, _MAX_TIFF_TAGS), length):
            letter, count = _TIFF_TYPES.get(number("H", at + 2)), number(offset, at + 4)
            if letter is None or not count:
                continue
            place = at + length - room
            if count * struct.calcsize(letter) > room:
                place = number(offset, place)
                if place + struct.calcsize(letter) > len(data):
                    continue
            tags.setdefault(number("H", at), TiffTag(number(letter, place), place, order + letter))
        yield tags
        start = number(offset, first + length * num)


def _of_tiff(data: bytes) -> ImageSize:
    """Size of the first image."""
    tags = {tag: found.value for tag, found in next(tiff_images(data), {}).items()}
    if _TIFF_WIDTH not in tags or _TIFF_HEIGHT not in tags:
        raise ValueError("no size")
    width = max(tags[_TIFF_WIDTH], tags.get(_TIFF_TILE_WIDTH, 0))
    height = max(tags[_TIFF_HEIGHT], tags.get(_TIFF_TILE_HEIGHT, 0))
    bits = max(tags.get(_TIFF_BITS, 1), 8)
    return ImageSize(width, height, width * height * tags.get(_TIFF_SAMPLES, 1) * -(-bits // 8))


def jpeg_segments(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Markers of a JPEG with their segments, up to the samples.

    Raises
    ------
    ValueError, IndexError, struct.error
        It is not whole.
    """
    position, marker = 2, 0
    while marker != _JPEG_SCAN:
        if data[position] != 0xFF:
            raise ValueError("no marker")
        marker = data[position + 1]
        if marker == 0xFF:  # filling
            position += 1
        elif marker in _JPEG_BARE:
            position += 2
        else:
            end = position + 2 + struct.unpack_from(">H", data, position + 2)[0]
            yield marker, data[position + 4 : end]
            position = end


def _of_jpeg(data: bytes) -> ImageSize:
    frame = next(content for marker, content in jpeg_segments(data) if marker in _JPEG_FRAMES)
    height, width, channels = struct.unpack_from(">HHB", frame, 1)
    return ImageSize(width, height, width * height * channels)


def _of_bmp(data: bytes) -> ImageSize:
    (header,) = struct.unpack_from("<I", data, 14)
    if header == 12:
        width, height = struct.unpack_from("<HH", data, 18)
    else:
        width, height = struct.unpack_from("<ii", data, 18)
    width, height = abs(width), abs(height)  # upside down
    return ImageSize(width, height, 4 * width * height)


def netpbm_header(data: bytes) -> tuple[list[int], int]:
    """Width, height and largest value (1 of bits) of a PBM, PGM or PPM; where samples begin.

    Raises
    ------
    ValueError
        It is not whole.
    """
    is_bits = data[1:2] in b"14"
    pattern = rb"P[1-6]" + _PNM_NUMBER * (2 if is_bits else 3) + rb"\s"
    found = re.match(pattern, data[: 1 << 16])
    if found is None:
        raise ValueError("header is not whole")
    return [*map(int, found.groups()), 1][:3], found.end()


def _of_netpbm(data: bytes) -> ImageSize:
    (width, height, largest), _ = netpbm_header(data)
    channels = 3 if data[1:2] in b"36" else 1
    return ImageSize(width, height, prod((width, height, channels, 2 if largest > 0xFF else 1)))
