"""Boards drawn through a known lens give its parameters back."""

import numpy as np
import pytest
from boards import CHARUCO, CHECKER, SIZE, D, pictures

from polmvs.poses.board_calibration import Board, calibrate_camera


@pytest.mark.parametrize("board", [CHECKER, CHARUCO], ids=["checkerboard", "charuco"])
def test_a_known_lens_is_found(board):
    shown = pictures(board)
    shown["empty.png"] = np.full(SIZE[::-1], 128, np.uint8)
    found = calibrate_camera(shown, board)
    assert found.skipped == ("empty.png",)
    assert found.rms_px < 0.3
    camera = found.intrinsics
    assert (camera.model, camera.width, camera.height) == ("OPENCV", *SIZE)
    expected = [620, 622, 319.0, 241.5]  # half a pixel more than OpenCV's
    np.testing.assert_allclose(camera.params[:4], expected, atol=2.5)
    np.testing.assert_allclose(camera.params[4], D[0], atol=0.02)
    assert len(found.sigma) == 8
    assert 0.2 < found.coverage <= 1


def test_what_does_not_calibrate():
    shown = pictures(CHECKER)
    with pytest.raises(ValueError, match="0 of 6"):
        calibrate_camera(shown, Board(cols=12, rows=11))
    with pytest.raises(ValueError, match="2 of 2"):
        calibrate_camera(dict(list(shown.items())[:2]), CHECKER)
    with pytest.raises(ValueError, match="leaves the focal length open"):
        calibrate_camera(pictures(CHECKER, [(0, 0, 0.1 * k) for k in range(5)]), CHECKER)
    with pytest.raises(ValueError, match="DICT_"):
        calibrate_camera(shown, Board(cols=9, rows=7, dictionary="none"))
    with pytest.raises(ValueError, match="one size"):
        calibrate_camera(
            {"a": np.zeros((4, 4), np.uint8), "b": np.zeros((4, 5), np.uint8)}, CHECKER
        )
