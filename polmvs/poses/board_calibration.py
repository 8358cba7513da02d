"""A camera's intrinsics from pictures of a checkerboard or a ChArUco board."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.io.intrinsics import Intrinsics, from_opencv_matrix

Gray = NDArray[np.uint8]

MIN_VIEWS = 4  # with a corner grid each; fewer do not separate focal length and distortion
MIN_CORNERS = 8  # of a view
# Corners of a sharp board are found to a tenth of a pixel; a larger mean error shows another board
# than stated, or a bent one (guess).
MAX_ERROR_PX = 1.5
MIN_TILT_DEG = 10.0  # between views: with all boards parallel the focal length is not determined


@dataclass(frozen=True, kw_only=True)
class Board:
    """A printed board.

    Attributes
    ----------
    cols, rows : squares along each side; inner corners are one fewer.
    square : side of a square, any unit; the intrinsics do not depend on it.
    dictionary : of a ChArUco board's markers, such as "DICT_4X4_50"; None: a checkerboard.
    marker : side of a marker, the unit of ``square``; of a ChArUco board.
    """

    cols: int
    rows: int
    square: float = 1.0
    dictionary: str | None = None
    marker: float | None = None


@dataclass(frozen=True, kw_only=True)
class BoardCalibration:
    """Result of a calibration with a board.

    Attributes
    ----------
    intrinsics : in COLMAP's convention.
    sigma : standard deviations of its parameters, in their order, from the adjustment.
    rms_px : reprojection error.
    views : names of the used pictures.
    errors_px : rms error of each.
    skipped : names of the pictures without a board.
    coverage : share of the image with corners, in a grid of 8x8.
    """

    intrinsics: Intrinsics
    sigma: tuple[float, ...]
    rms_px: float
    views: tuple[str, ...]
    errors_px: tuple[float, ...]
    skipped: tuple[str, ...]
    coverage: float


def calibrate_camera(pictures: Mapping[str, Gray], board: Board) -> BoardCalibration:
    """Intrinsics and distortion (COLMAP's OPENCV model) from pictures of a board.

    Parameters
    ----------
    pictures : (H, W) uint8 by name, all of one size and one camera.
    board : the board in them.

    Raises
    ------
    ValueError
        Too few pictures show the board, all boards are parallel, or it is another board.
    """
    sizes = {picture.shape for picture in pictures.values()}
    if len(sizes) != 1:
        raise ValueError(f"pictures of {sorted(sizes)}; expected one size.")
    height, width = next(iter(sizes))
    find = _checkerboard_finder(board) if board.dictionary is None else _charuco_finder(board)
    found = {}
    for name, picture in pictures.items():
        corners = find(picture)
        if corners is not None and len(corners[0]) >= MIN_CORNERS:
            found[name] = corners
    if len(found) < MIN_VIEWS:
        what = f"{board.cols}x{board.rows} squares"
        raise ValueError(
            f"the board ({what}) is found in {len(found)} of {len(pictures)} pictures, {MIN_VIEWS} "
            "are needed. Count squares, not corners, and light the board evenly."
        )
    points = [np.asarray(xyz, np.float32) for xyz, _ in found.values()]
    corners = [np.asarray(xy, np.float32) for _, xy in found.values()]
    rms, matrix, distortion, turns, _, deviations, _, errors = cv2.calibrateCameraExtended(  # type: ignore[call-overload]
        points, corners, (width, height), None, None, flags=cv2.CALIB_FIX_K3
    )
    if not rms < MAX_ERROR_PX:
        raise ValueError(
            f"the corners do not fit a board by {rms:.1f} px rms. Is it flat, and of "
            f"{board.cols}x{board.rows} squares?"
        )
    _require_tilt([np.asarray(turn, np.float64).ravel() for turn in turns])
    intrinsics = from_opencv_matrix(matrix.tolist(), [*np.ravel(distortion)[:4]], width, height)
    cells = {
        (int(8 * x / width), int(8 * y / height)) for c in corners for x, y in c.reshape(-1, 2)
    }
    sigma = np.ravel(deviations)[:8]
    return BoardCalibration(
        intrinsics=intrinsics,
        sigma=tuple(float(s) for s in sigma[: len(intrinsics.params)]),
        rms_px=float(rms),
        views=tuple(found),
        errors_px=tuple(float(e) for e in np.ravel(errors)),
        skipped=tuple(name for name in pictures if name not in found),
        coverage=len(cells) / 64,
    )


def _require_tilt(turns: list[Array]) -> None:
    """The boards must not all be parallel."""
    normals = np.array([cv2.Rodrigues(turn)[0][:, 2] for turn in turns])
    cosines = np.clip(normals @ normals.T, -1, 1)
    widest = float(np.degrees(np.arccos(np.abs(cosines).min())))
    if widest < MIN_TILT_DEG:
        raise ValueError(
            f"the board is tilted by {widest:.0f} degrees between the pictures at most, which "
            "leaves the focal length open. Take some of them obliquely."
        )


def _checkerboard_finder(board: Board) -> Any:
    """A function that finds points ``(N, 3)`` of the board and their corners ``(N, 1, 2)``."""
    size = (board.cols - 1, board.rows - 1)
    if min(size) < 3:
        raise ValueError(f"a board of {board.cols}x{board.rows} squares has too few corners.")
    grid = np.zeros((size[0] * size[1], 3))
    grid[:, :2] = board.square * np.mgrid[: size[0], : size[1]].T.reshape(-1, 2)

    def find(picture: Gray) -> tuple[Array, Any] | None:
        flags = cv2.CALIB_CB_ACCURACY | cv2.CALIB_CB_NORMALIZE_IMAGE | cv2.CALIB_CB_EXHAUSTIVE
        shown, corners = cv2.findChessboardCornersSB(picture, size, flags=flags)
        return (grid, corners) if shown else None

    return find


def _charuco_finder(board: Board) -> Any:
    """The same of a ChArUco board, of which a part may be seen."""
    name = board.dictionary or ""
    known = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if known is None:
        raise ValueError(f"{name!r} is no dictionary of ArUco markers, such as DICT_4X4_50.")
    marker = board.marker if board.marker is not None else 0.75 * board.square
    if not 0 < marker < board.square:
        raise ValueError(f"markers of {marker:g} do not lie in squares of {board.square:g}.")
    dictionary = cv2.aruco.getPredefinedDictionary(known)
    drawn = cv2.aruco.CharucoBoard((board.cols, board.rows), board.square, marker, dictionary)
    detector = cv2.aruco.CharucoDetector(drawn)
    grid = np.asarray(drawn.getChessboardCorners(), np.float64)

    def find(picture: Gray) -> tuple[Array, Any] | None:
        corners, ids, _, _ = detector.detectBoard(picture)
        if ids is None or len(ids) == 0:
            return None
        return grid[np.ravel(ids)], corners

    return find
