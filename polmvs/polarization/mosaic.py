"""Polarizer mosaics: linear samples, and four angle images on one common grid.

A pattern holds the angles of a 2x2 cell as *displayed*. There are 24 orders. A camera mounted
upside down, an image turned or mirrored by software, and a region of interest with odd offsets
change the order; :func:`turned_pattern` gives the new one. In a colour sensor the 2x2 cells are the
pixels of a Bayer pattern, so its cell has 4x4 samples.
"""

from __future__ import annotations

from typing import Any, Final

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Image
from polmvs.config import BayerOrder

ANGLES_DEG: Final = (0, 45, 90, 135)
# A sample lies 0.25 half-size px from the centre of its cell and its next neighbour 0.75 px on
# the other side, along each axis.
FILTERED = (np.uint8, np.uint16, np.float32)  # types that OpenCV filters as they are
NEAR, FAR = 0.75, 0.25
# Variance of an interpolated sample over that of a raw one: (0.75^2 + 0.25^2) for each axis.
INTERPOLATION_NOISE_GAIN: Final = (NEAR**2 + FAR**2) ** 2


def noise_area_px(*, colour: bool = False, full: bool = False) -> float:
    """Pixels of a polarization image that share an error, since all are interpolated.

    It is the variance of the mean of many pixels times their number, over the variance of one: the
    number of pixels per raw sample, over the mean square sum of the weights.

    Parameters
    ----------
    colour, full : of a colour mosaic; in full resolution.
    """
    spacing, step = (4 if colour else 2), (1 if full else 2)
    # Places of pixels between two samples of a lattice, shares of their spacing.
    places = (np.arange(0, spacing, step) + (0.0 if full else 0.5)) / spacing
    along_axis = float(np.mean(places**2 + (1 - places) ** 2))
    return float((spacing / step) ** 2 / along_axis**2)


def linearize(raw: NDArray[Any], *, gamma: float = 1.0, full_scale: float | None = None) -> Image:
    """Raw samples in units of full scale, proportional to the light: ``(raw / full) ** (1 / g)``.

    Parameters
    ----------
    raw : (H, W) uint8, uint16 or floats
    gamma : encoding gamma of the camera, 1 for a linear one.
    full_scale : value of a saturated sample; None: the largest of the type, 1 for floats.

    Returns
    -------
    (H, W) float32, 0 to 1 (above 1 only where ``raw`` exceeds ``full_scale``).
    """
    if raw.dtype.kind == "f":
        share = np.asarray(raw, np.float32) / np.float32(1.0 if full_scale is None else full_scale)
        if gamma == 1.0:
            return np.asarray(share, np.float32)
        return np.asarray(np.maximum(share, 0) ** np.float32(1.0 / gamma), np.float32)
    largest = np.iinfo(raw.dtype).max
    scale = largest if full_scale is None else full_scale
    if gamma == 1.0:
        return np.asarray(np.multiply(raw, np.float32(1.0 / scale), dtype=np.float32))
    table = (np.arange(largest + 1) / scale) ** (1.0 / gamma)
    return np.asarray(table.astype(np.float32)[raw])


def split_mosaic(
    raw: NDArray[Any],
    pattern: tuple[int, int, int, int],
    *,
    scale: float = 1.0,
    out: Image | None = None,
) -> Image:
    """Four angle images, each interpolated to the centres of the 2x2 cells.

    Bilinear, which is exact on a linear ramp. Measured, redundancy ``|I0 + I90 - I45 - I135| / s0``
    on the shared captures: slicing 5.7 %, this 3.4 %, four-tap cubic 4.2 %, guided by a
    pseudo-intensity 3.4 % (at five times the cost and a wider reach of clipping).

    Parameters
    ----------
    raw : (H, W), H and W even, linear.
    pattern : polarizer angles of a 2x2 cell, row by row, degrees.
    scale : factor applied to the images, at no cost for integer samples.
    out : (4, H/2, W/2) float32 output array; None for a new one.

    Returns
    -------
    (4, H/2, W/2) float32, angles 0, 45, 90, 135 degrees, in the units of ``raw``. At the border
    the missing neighbour is the sample itself.
    """
    _require_cells(raw)
    _require_pattern(pattern)
    height, width = raw.shape
    images = np.empty((4, height // 2, width // 2), np.float32) if out is None else out
    for cell, angle in enumerate(pattern):
        row, col = divmod(cell, 2)
        site = raw[row::2, col::2]
        samples = np.ascontiguousarray(site, None if site.dtype in FILTERED else np.float32)
        across = _taps(col) * np.float32(scale)
        image = images[ANGLES_DEG.index(angle)]
        cv2.sepFilter2D(
            samples, cv2.CV_32F, across, _taps(row), dst=image, borderType=cv2.BORDER_REPLICATE
        )
    return images


def split_mosaic_full(raw: NDArray[Any], pattern: tuple[int, int, int, int]) -> Image:
    """Four angle images at the mosaic's own pixels, each interpolated bilinearly.

    Parameters
    ----------
    raw, pattern : see :func:`split_mosaic`.

    Returns
    -------
    (4, H, W) float32, angles 0, 45, 90, 135 degrees, in the units of ``raw``. A pixel's own
    sample stays as it is; at the border the missing neighbour is the next sample inwards.
    """
    _require_cells(raw)
    _require_pattern(pattern)
    images = np.empty((4, *raw.shape), np.float32)
    for cell, angle in enumerate(pattern):
        row, col = divmod(cell, 2)
        images[ANGLES_DEG.index(angle)] = _fill_lattice(raw, row, col, 2, raw.shape, (0.0, 0.0))
    return images


def split_colour_mosaic(
    raw: NDArray[Any],
    pattern: tuple[int, int, int, int],
    bayer: BayerOrder,
    *,
    full: bool = False,
) -> Image:
    """Four angle images of each colour at the centres of the 2x2 cells, bilinear.

    Parameters
    ----------
    raw : (H, W), H and W multiples of 4, linear.
    pattern : polarizer angles of a 2x2 cell, row by row, degrees.
    bayer : colours of the 2x2 cells, row by row.
    full : at the mosaic's own pixels instead.

    Returns
    -------
    (3, 4, H/2, W/2) float32, in full (3, 4, H, W): red, green, blue; 0, 45, 90, 135 degrees.
    """
    _require_cells(raw)
    _require_pattern(pattern)
    if raw.shape[0] % 4 or raw.shape[1] % 4:
        raise ValueError(f"{raw.shape=} but expected multiples of 4.")
    shape = (raw.shape[0], raw.shape[1]) if full else (raw.shape[0] // 2, raw.shape[1] // 2)
    first = (0.0, 0.0) if full else (0.5, 0.5)
    images = np.zeros((3, 4, *shape), np.float32)
    for block, colour in enumerate(bayer):
        channel = "rgb".index(colour)
        for cell, angle in enumerate(pattern):
            row = 2 * (block // 2) + cell // 2
            col = 2 * (block % 2) + cell % 2
            filled = _fill_lattice(raw, row, col, 4, shape, first)
            images[channel, ANGLES_DEG.index(angle)] += filled
    images[1] *= np.float32(0.5)  # two of the four blocks are green
    return images


def turned_pattern(
    pattern: tuple[int, int, int, int], orientation: int
) -> tuple[int, int, int, int]:
    """Pattern of an image whose samples were turned or mirrored by a TIFF orientation.

    Angles are as displayed, so they turn with the image: a rotation by 90 degrees moves the
    samples of a cell and makes each angle its perpendicular; a reflection makes 45 to 135.

    Parameters
    ----------
    pattern : of the samples as the sensor read them.
    orientation : 1 to 8 as in TIFF's tag 274: where row 0 and column 0 are displayed.
    """
    _require_pattern(pattern)
    if not 1 <= orientation <= 8:
        raise ValueError(f"{orientation=} but expected 1 to 8.")
    cell = np.array(pattern).reshape(2, 2)
    match orientation:
        case 2:
            cell = -cell[:, ::-1]
        case 3:
            cell = cell[::-1, ::-1]
        case 4:
            cell = -cell[::-1]
        case 5:
            cell = -90 - cell.T
        case 6:
            cell = np.rot90(cell, -1) - 90
        case 7:
            cell = 90 - cell[::-1, ::-1].T
        case 8:
            cell = np.rot90(cell) + 90
    return tuple(int(angle) % 180 for angle in cell.ravel())  # type: ignore[return-value]


def clipped_cells(
    raw: NDArray[Any], threshold: float, *, colour: bool = False, full: bool = False
) -> NDArray[np.bool_]:
    """Pixels of the polarization images to which a clipped raw sample contributes.

    Parameters
    ----------
    raw : (H, W), H and W even.
    threshold : raw value from which a sample counts as clipped.
    colour, full : of a colour mosaic, in full resolution; see :func:`split_colour_mosaic`.

    Returns
    -------
    (H/2, W/2) bool, in full (H, W): True if a sample of the interpolation is clipped. For a
    monochrome mosaic in half resolution these are the 4x4 raw px about the cell's centre.
    """
    _require_cells(raw)
    clipped = np.asarray(raw >= threshold, np.uint8)
    step = 1 if full else 2
    if not clipped.any():
        return np.zeros((raw.shape[0] // step, raw.shape[1] // step), np.bool_)
    # Samples of one lattice lie 2 px apart, of one colour 4: a pixel is between two of them. With
    # the anchor of half resolution, pixel (r, c) covers rows r - 1 to r + 2, the reach of cell
    # (r / 2, c / 2); in colour r - 3 to r + 4.
    reach_px = 3 if colour else 1
    size = 2 * reach_px + step
    kernel = np.ones((size, size), np.uint8)
    reach = cv2.dilate(clipped, kernel, anchor=(reach_px, reach_px))
    return np.asarray(reach[::step, ::step] != 0)


def _taps(offset: int) -> NDArray[np.float32]:
    """Weights of the previous, own and next sample for a sample on side 0 or 1 of its cell."""
    return np.array([0.0, NEAR, FAR] if offset == 0 else [FAR, NEAR, 0.0], np.float32)


def _fill_lattice(
    raw: NDArray[Any],
    row: int,
    col: int,
    spacing: int,
    shape: tuple[int, int],
    first: tuple[float, float],
) -> Image:
    """Bilinear values of every ``spacing``-th sample from (row, col) on a grid over the mosaic.

    ``first`` is the grid's first point in rows and columns of the mosaic; its shape says how
    dense it is. OpenCV's table of weights has 32 steps a pixel, which holds all that occur here.
    """
    samples = np.ascontiguousarray(raw[row::spacing, col::spacing], np.float32)
    step = raw.shape[0] / shape[0] / spacing
    at_x, at_y = (first[1] - col) / spacing, (first[0] - row) / spacing
    transform = np.array([[step, 0.0, at_x], [0.0, step, at_y]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    filled = cv2.warpAffine(
        samples, transform, shape[::-1], flags=flags, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(filled, np.float32)


def _require_pattern(pattern: tuple[int, int, int, int]) -> None:
    if sorted(pattern) != list(ANGLES_DEG):
        raise ValueError(f"{pattern=} but expected each of {ANGLES_DEG} once.")


def _require_cells(raw: NDArray[Any]) -> None:
    if raw.ndim != 2 or raw.size == 0 or raw.shape[0] % 2 or raw.shape[1] % 2:
        raise ValueError(f"{raw.shape=} but expected (H, W), both even.")
