"""Image files: decoding, masks, PNG output; a faulty file is a ``DataError``."""

from __future__ import annotations

import os
import struct
import zlib
from os import PathLike
from pathlib import Path
from typing import Any, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.config import MAX_PIXELS
from polmvs.errors import DataError, as_data_error
from polmvs.io.image_size import (
    BROKEN,
    PNG_CHANNELS,
    PNG_SIGNATURE,
    SCALE_DOWN,
    declared_size,
    require_size,
)
from polmvs.io.plain_files import open_plain
from polmvs.io.temporary import remove_temporary, temporary_path

PathArg: TypeAlias = str | PathLike[str]

SILENT = 0  # OpenCV's log level
DEFLATE_RATIO = 1032  # by which zlib compresses at the very best


def read_mask(path: PathArg, shape: tuple[int, int]) -> NDArray[np.bool_]:
    """Read a mask of the half-size polarization image.

    Parameters
    ----------
    path : an image; a pixel is inside if any colour channel is not 0; alpha is ignored.
    shape : required (H, W), px.

    Returns
    -------
    (H, W) bool

    Raises
    ------
    DataError
        The file is missing, truncated, not an image or of another size.
    """
    image = decode_image(path, read_bytes(path), max_pixels=max(shape[0] * shape[1], MAX_PIXELS))
    height, width = image.shape[:2]
    if (height, width) != tuple(shape):
        raise DataError(
            path,
            f"the mask is {width}x{height} px, the polarization image {shape[1]}x{shape[0]} px. "
            "Draw it at the size of the polarization image, half that of the raw mosaic.",
        )
    if image.ndim == 2:
        return np.asarray(image != 0)
    return np.asarray((image[..., :3] != 0).any(axis=-1))


def read_gray(path: PathArg) -> NDArray[np.uint8]:
    """Read an 8-bit image as grey, ``(H, W)`` uint8; the mean of the colour channels.

    Raises
    ------
    DataError
        The file is missing, truncated, not an image or not 8-bit.
    """
    image = decode_image(path, read_bytes(path))
    if image.dtype != np.uint8:
        raise DataError(path, "is no 8-bit image.")
    gray = image if image.ndim == 2 else np.rint(image[..., :3].mean(axis=-1))
    return np.asarray(gray, np.uint8)


def write_png(path: PathArg, image: NDArray[Any]) -> None:
    """Write a PNG whole or not at all, with any suffix.

    Parameters
    ----------
    path : file to write or replace; its folder must exist.
    image : (H, W), (H, W, 3) or (H, W, 4), uint8 or uint16, channels in OpenCV's order (BGR).

    Raises
    ------
    DataError
        The system refuses, e.g. a full disk or a read-only folder.
    """
    write_bytes(path, encode_png(image))


def write_mask(path: PathArg, mask: NDArray[np.bool_]) -> None:
    """Write a mask (H, W) as :func:`read_mask` reads it, 255 inside."""
    write_png(path, np.where(mask, 255, 0).astype(np.uint8))


def encode_png(image: NDArray[Any]) -> bytes:
    """The bytes of a PNG of an image as for :func:`write_png`."""
    if image.dtype not in (np.uint8, np.uint16) or image.ndim not in (2, 3) or image.size == 0:
        raise ValueError(f"{image.dtype=}, {image.shape=} but expected a uint8 or uint16 image.")
    encoded, data = cv2.imencode(".png", np.ascontiguousarray(image))
    if not encoded:
        raise ValueError(f"OpenCV cannot encode {image.shape=} as PNG.")
    return bytes(data.tobytes())


def write_bytes(path: PathArg, data: bytes) -> None:
    """Write a file whole or not at all: under a temporary name, which is then renamed.

    Raises
    ------
    DataError
        The system refuses; the temporary file is removed and an existing file is unchanged.
    """
    target = Path(path)
    # A rename would put a plain file in the place of a device such as /dev/null.
    if target.exists() and not target.is_file():
        raise DataError(target, "exists and is no plain file. Choose another name.")
    temporary = temporary_path(target)
    try:
        with as_data_error(target, "written"):
            temporary.write_bytes(data)
            os.replace(temporary, target)
    finally:
        remove_temporary(temporary)


def read_bytes(path: PathArg, most: int | None = None) -> bytes:
    """The content of a plain file, or a ``DataError`` with the system's reason.

    Parameters
    ----------
    most : largest number of bytes.
    """
    with as_data_error(path, "read", missing="no such file."), open_plain(path) as file:
        size = os.fstat(file.fileno()).st_size
        if most is not None and size > most:
            raise DataError(
                path, f"has {size / 1e9:.1f} GB; the limit is {most / 1e9:.1f} GB. {SCALE_DOWN}"
            )
        data = file.read()
    if not data:
        raise DataError(path, f"is empty. {BROKEN}")
    return data


def _set_log_level(level: int) -> int:
    """Set OpenCV's log level, which moved in OpenCV 5; returns the one before."""
    setter = cv2.setLogLevel if hasattr(cv2, "setLogLevel") else cv2.utils.logging.setLogLevel
    return int(setter(level))


def decode_image(
    path: PathArg, data: bytes, *, max_pixels: int = MAX_PIXELS, remedy: str = SCALE_DOWN
) -> NDArray[Any]:
    """Pixels of an encoded image, unchanged; OpenCV's messages are not shown on the terminal.

    Parameters
    ----------
    max_pixels : limit for the header.
    remedy : a sentence for the message about a larger image.
    """
    if data.startswith(PNG_SIGNATURE):
        check_png(path, data)
    require_size(path, declared_size(path, data), max_pixels=max_pixels, remedy=remedy)
    level = _set_log_level(SILENT)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    except cv2.error:
        image = None
    finally:
        _set_log_level(level)
    if image is None:
        raise DataError(path, f"is not a readable image, or is damaged or truncated. {BROKEN}")
    return np.asarray(image)


def check_png(path: PathArg, data: bytes) -> None:
    """Check the chunks up to IEND: OpenCV may fill a truncated PNG with zeros."""
    view = memoryview(data)
    position = len(PNG_SIGNATURE)
    kind = b""
    while kind != b"IEND":
        if position + 12 > len(view):
            raise DataError(path, f"is truncated: the PNG ends after {len(view)} bytes. {BROKEN}")
        length, kind = struct.unpack_from(">I4s", view, position)
        end = position + 12 + length
        if end > len(view):
            raise DataError(path, f"is truncated: the PNG ends after {len(view)} bytes. {BROKEN}")
        (checksum,) = struct.unpack_from(">I", view, end - 4)
        # Chunk order: IHDR of 13 bytes comes first.
        if position == len(PNG_SIGNATURE) and (kind, length) != (b"IHDR", 13):
            raise DataError(path, f"is damaged: the PNG has no header. {BROKEN}")
        if zlib.crc32(view[position + 4 : end - 4]) != checksum:
            raise DataError(path, f"is damaged: wrong checksum at byte {position}. {BROKEN}")
        position = end
    width, height, bits, kind_of_colour = struct.unpack_from(">IIBB", view, 16)
    row = -(-width * bits * PNG_CHANNELS.get(kind_of_colour, 1) // 8)
    if not width or not height or row * height > DEFLATE_RATIO * len(view):
        raise DataError(path, f"is damaged: it cannot hold {width}x{height} px. {BROKEN}")
