"""A capture: a folder of raw mosaics of one camera, checked as a whole, loaded one by one."""

from __future__ import annotations

from dataclasses import dataclass
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.config import CaptureOptions
from polmvs.errors import DataError
from polmvs.io.images import Mosaic, MosaicHeader, probe_mosaic, read_mosaic
from polmvs.polarization.mosaic import clipped_cells, linearize, split_mosaic
from polmvs.polarization.stokes import Stokes, stokes_from_intensities

SUFFIXES = frozenset({".png", ".tif", ".tiff", ".bmp", ".pgm"})
LOSSY_SUFFIXES = frozenset({".jpg", ".jpeg"})
DISPLAY_GAMMA = 2.2
WHITE_PERCENTILE = 99.5
WHITE_IMAGES = 32  # images that the white level is taken from, evenly spread over the capture
WHITE_SAMPLES = 20_000  # cells of each


@dataclass(frozen=True, kw_only=True)
class Capture:
    """Mosaics of one camera at one setting; nothing of their pixels is held.

    Attributes
    ----------
    folder : as given by the user.
    paths : of the raw mosaics, sorted by name.
    width, height : of the half-size polarization images, px.
    bit_depth : of the files' samples, 8 or 16.
    full_scale : raw value of a saturated sample: 255 or 65535, or 1023 or 4095 where 16-bit
        files hold right-aligned 10- or 12-bit samples.
    options : how mosaics become polarization images.
    """

    folder: Path
    paths: tuple[Path, ...]
    width: int
    height: int
    bit_depth: int
    full_scale: int
    options: CaptureOptions

    @property
    def names(self) -> tuple[str, ...]:
        """File names of the mosaics, which are also the images' names in the COLMAP model."""
        return tuple(path.name for path in self.paths)

    def load(self, name: str) -> Stokes:
        """Read a mosaic and turn it into Stokes images ``(height, width)``.

        Raises
        ------
        DataError
            The file is gone, damaged or has changed since the capture was opened.
        """
        raw = self._read(self._path(name))
        clipped = clipped_cells(raw, self.options.saturation * self.full_scale)
        linear = linearize(raw, gamma=self.options.gamma, full_scale=self.full_scale)
        return stokes_from_intensities(
            split_mosaic(linear, self.options.pattern),
            clipped,
            darkness=self.options.darkness,
            quantum=1.0 / self.full_scale,
        )

    def exposure(self) -> float:
        """White level of s0 for the whole capture, units of full scale: its 99.5 percentile.

        Taken over a spread of at most 32 images and 20,000 cells of each.

        Raises
        ------
        DataError
            The images are black.
        """
        step = -(-len(self.paths) // WHITE_IMAGES)
        samples = [self._intensity_samples(path) for path in self.paths[::step]]
        white = float(np.percentile(np.concatenate(samples), WHITE_PERCENTILE))
        if white <= 0:
            raise DataError(self.folder, "the images are black. Check exposure and lens cap.")
        return white

    def _path(self, name: str) -> Path:
        for path in self.paths:
            if path.name == name:
                return path
        raise ValueError(f"{name=} is not an image of {self.folder}.")

    def _read(self, path: Path) -> Mosaic:
        """A mosaic of the size and type that the capture was opened with."""
        raw = read_mosaic(path)
        found = (raw.shape[1] // 2, raw.shape[0] // 2, 8 * raw.dtype.itemsize)
        if found != (self.width, self.height, self.bit_depth):
            raise DataError(path, "has changed since the run began. Start the run again.")
        return raw

    def _intensity_samples(self, path: Path) -> NDArray[np.float32]:
        """Intensity s0 of evenly spread cells of one image, ``(N,)``."""
        raw = self._read(path)
        step = max(1, int(np.sqrt(self.width * self.height / WHITE_SAMPLES)))
        rows = np.arange(step // 2, self.height, step) * 2
        cols = np.arange(step // 2, self.width, step) * 2
        sites = [np.ix_(rows + i, cols + j) for i in (0, 1) for j in (0, 1)]
        cells: NDArray[np.unsignedinteger[Any]] = np.stack([raw[site] for site in sites])
        linear = linearize(cells, gamma=self.options.gamma, full_scale=self.full_scale)
        return np.asarray(0.5 * linear.sum(axis=0).ravel(), np.float32)


def find_mosaics(folder: str | PathLike[str]) -> list[Path]:
    """Images directly in a folder, or in its ``raw`` where it has none, sorted by name.

    Raises
    ------
    DataError
        The folder is missing or holds no mosaics.
    """
    root = Path(folder)
    if not root.is_dir():
        raise DataError(root, "is no folder." if root.exists() else "no such folder.")
    lossy = False
    for place in (root, root / "raw"):
        files = _files(place)
        mosaics = [path for path in files if path.suffix.lower() in SUFFIXES]
        if mosaics:
            return mosaics
        lossy |= any(path.suffix.lower() in LOSSY_SUFFIXES for path in files)
    if lossy:
        raise DataError(root, "holds JPEG images only, which spoil a mosaic. Record PNG or TIFF.")
    kinds = ", ".join(sorted(SUFFIXES))
    raise DataError(root, f"no images in it or in its raw/. Raw mosaics ({kinds}) are expected.")


def open_capture(folder: str | PathLike[str], options: CaptureOptions | None = None) -> Capture:
    """Check every mosaic of a folder and describe the capture.

    8-bit PNGs are checked without decoding them; 16-bit files are decoded, one at a time, to see
    how their samples are aligned.

    Parameters
    ----------
    folder : see :func:`find_mosaics`.
    options : None for the defaults.

    Raises
    ------
    DataError
        There is no mosaic, one is unusable, or two differ in size or bit depth.
    """
    paths = find_mosaics(folder)
    first = probe_mosaic(paths[0])
    for path in paths[1:]:
        _require_same(paths[0], first, path, probe_mosaic(path))
    return Capture(
        folder=Path(folder),
        paths=tuple(paths),
        width=first.width // 2,
        height=first.height // 2,
        bit_depth=first.bit_depth,
        full_scale=255 if first.bit_depth == 8 else _full_scale_16(paths),
        options=CaptureOptions() if options is None else options,
    )


def intensity_image_8bit(stokes: Stokes, white: float) -> NDArray[np.uint8]:
    """Intensity as COLMAP sees it best: one exposure for all views, gamma 2.2.

    Parameters
    ----------
    stokes : of one view.
    white : s0 that becomes 255, units of full scale; see :meth:`Capture.exposure`.

    Returns
    -------
    (H, W) uint8
    """
    if not white > 0:
        raise ValueError(f"{white=} but expected a positive number.")
    share = np.clip(stokes.s0 / np.float32(white), 0, 1)
    encoded = np.power(share, np.float32(1 / DISPLAY_GAMMA))
    return np.asarray(np.rint(np.float32(255) * encoded), np.uint8)


def _files(folder: Path) -> list[Path]:
    """Plain files of a folder by name, hidden ones left out; none where it does not exist."""
    try:
        found = sorted(folder.iterdir()) if folder.is_dir() else []
    except OSError as error:
        raise DataError(folder, f"cannot be read: {error.strerror or error}.") from error
    return [path for path in found if path.is_file() and not path.name.startswith(".")]


def _require_same(first_path: Path, first: MosaicHeader, path: Path, header: MosaicHeader) -> None:
    """All mosaics of a capture come from one camera at one setting."""
    if header[:2] != first[:2]:
        raise DataError(
            path,
            f"is {header.width}x{header.height} px but {first_path.name} is "
            f"{first.width}x{first.height} px. A capture holds mosaics of one size.",
        )
    if header.bit_depth != first.bit_depth:
        raise DataError(
            path,
            f"has {header.bit_depth} bits a sample but {first_path.name} has "
            f"{first.bit_depth}. A capture holds mosaics of one bit depth.",
        )


def _full_scale_16(paths: list[Path]) -> int:
    """Value of a saturated sample in 16-bit files, from all their samples.

    Left-aligned 10- or 12-bit samples leave the low bits zero and have the container's scale
    however dark they are; right-aligned ones never reach the high bits.
    """
    bits = 0
    for path in paths:
        bits |= int(np.bitwise_or.reduce(read_mosaic(path), axis=None))
        if bits >= 1 << 12:
            return 65535
    if bits & 0xF == 0:
        return 65535
    return 1023 if bits < 1 << 10 else 4095
