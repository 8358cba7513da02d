"""A calibration file in the place of ``--intrinsics``."""

import json
from pathlib import Path

import numpy as np
import pytest

import polmvs
from polmvs.colmap.sfm import check_camera
from polmvs.config import SfmOptions
from polmvs.errors import DataError, OptionError

DEMO = Path(polmvs.__file__).parent / "demo_capture"
K = np.array(json.loads((DEMO / "gt" / "cameras.json").read_text())["images"]["000.png"]["K"])


def test_a_file_of_the_mosaic_is_halved(tmp_path):
    full = 2 * K
    full[:2, 2] -= 0.5  # OpenCV's pixels
    full[2, 2] = 1
    path = tmp_path / "camera.json"
    path.write_text(json.dumps({"K": full.tolist(), "width": 918, "height": 768}))
    camera = check_camera(path, 459, 384)
    assert camera.model == "PINHOLE"
    np.testing.assert_allclose(camera.params, [K[0, 0], K[1, 1], K[0, 2], K[1, 2]], rtol=1e-12)
    with pytest.raises(DataError, match=r"camera\.json: it is of 918x768 px images"):
        check_camera(path, 459, 300)


def test_one_of_the_two(tmp_path):
    with pytest.raises(OptionError, match="exclude each other"):
        SfmOptions(camera=tmp_path / "c.txt", intrinsics=(1, 1, 1, 1))
