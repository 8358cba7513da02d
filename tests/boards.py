"""Pictures of calibration boards through a known lens."""

import cv2
import numpy as np

from polmvs.poses.board_calibration import Board

K = np.array([[620.0, 0, 318.5], [0, 622.0, 241.0], [0, 0, 1]])
D = np.array([-0.12, 0.05, 0.001, -0.0008])
SIZE = (640, 480)
CHECKER = Board(cols=9, rows=7, square=0.03)
CHARUCO = Board(cols=9, rows=7, square=0.03, dictionary="DICT_4X4_50", marker=0.022)
PX = 40  # of a square in the drawn board


def drawn(board):
    """The board as a flat picture with a margin of a square."""
    if board.dictionary is not None:
        dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, board.dictionary))
        charuco = cv2.aruco.CharucoBoard(
            (board.cols, board.rows), board.square, board.marker, dictionary
        )
        return charuco.generateImage(
            ((board.cols + 2) * PX, (board.rows + 2) * PX), marginSize=PX, borderBits=1
        )
    picture = np.full(((board.rows + 2) * PX, (board.cols + 2) * PX), 255, np.uint8)
    for row in range(board.rows):
        for col in range(board.cols):
            if (row + col) % 2 == 0:
                picture[(row + 1) * PX : (row + 2) * PX, (col + 1) * PX : (col + 2) * PX] = 0
    return picture


def seen(board, turn, shift):
    """The board through the lens, by the inverse of OpenCV's distortion at every pixel."""
    flat = drawn(board)
    x, y = np.meshgrid(np.arange(SIZE[0]), np.arange(SIZE[1]))
    pixels = np.stack([x, y], axis=-1).reshape(-1, 1, 2).astype(np.float64)
    rays = cv2.undistortPoints(pixels, K, D).reshape(-1, 2)
    rays = np.column_stack([rays, np.ones(len(rays))])
    rotation = cv2.Rodrigues(np.array(turn, float))[0]
    normal, center = rotation[:, 2], np.array(shift, float)
    points = rays * ((normal @ center) / (rays @ normal))[:, None]
    on_board = (points - center) @ rotation / board.square  # in squares from its corner
    at = ((on_board[:, :2] + 1) * PX - 0.5).reshape(SIZE[1], SIZE[0], 2).astype(np.float32)
    big = cv2.remap(flat, at[..., 0], at[..., 1], cv2.INTER_LINEAR, borderValue=160)
    return cv2.GaussianBlur(big, (3, 3), 0.6)


TURNS = [(0, 0, 0), (0.5, 0, 0), (-0.5, 0.1, 0.2), (0, 0.6, 0.1), (0.1, -0.6, 0), (0.4, 0.4, 0.3)]


def pictures(board, turns=TURNS):
    center = np.array([board.cols, board.rows, 0]) * board.square / 2
    result = {}
    for k, turn in enumerate(turns):
        middle = np.array([0.02 * (k % 3 - 1), 0.015 * (k % 2), 0.34])
        corner = middle - cv2.Rodrigues(np.array(turn, float))[0] @ center
        result[f"{k}.png"] = seen(board, turn, corner)
    return result
