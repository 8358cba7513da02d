"""Masks and cameras of public sets, of which everything is known."""

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from polmvs.errors import DataError
from polmvs.io.data_sets import PosedImage, read_data_set, read_npz, read_set_mask
from polmvs.io.images import write_png

MATRIX = np.array([[900.0, 0, 310.25], [0, 910.0, 255.75], [0, 0, 1]])


def test_alpha_is_the_mask_where_there_is_one(tmp_path: Path) -> None:
    image = np.zeros((1, 4, 4), np.uint8)
    image[0, :, 3] = [0, 255, 0, 1]
    image[0, :, 1] = [0, 0, 9, 9]
    expected = {
        "rgba": (image, [False, True, False, True]),
        "rgb": (image[..., :3], [False, False, True, True]),
        "gray": (image[..., 1], [False, False, True, True]),
        "deep": (image.astype(np.uint16), [False, True, False, True]),
    }
    for name, (pixels, mask) in expected.items():
        write_png(tmp_path / f"{name}.png", pixels)
        assert read_set_mask(tmp_path / f"{name}.png").tolist() == [mask]


def read_camera(folder: Path, projection: np.ndarray) -> PosedImage:
    """The camera of a set in the layout of NeRSP with one image of 620x512 px."""
    for name in ("s0", "s1", "s2"):
        (folder / name).mkdir(exist_ok=True)
        np.save(folder / name / "0.npy", np.zeros((512, 620), np.float32))
    np.savez(folder / "cameras.npz", world_mat_0=projection)
    (camera,) = read_data_set(folder).cameras
    return camera


def require_matrix(camera: PosedImage, matrix: np.ndarray) -> None:
    """COLMAP counts pixels from the image's corner, the set from the first one's centre."""
    assert camera.intrinsics.model == "PINHOLE"
    center = matrix[:2, 2] + 0.5
    expected = [matrix[0, 0], matrix[1, 1], *center]
    np.testing.assert_allclose(camera.intrinsics.params, expected, atol=1e-8)


@pytest.mark.parametrize("scale", [1.0, -1.0, 1e-3, 250.0])
def test_a_projection_of_any_scale_and_sign_is_one_camera(tmp_path: Path, scale: float) -> None:
    rotation = Rotation.from_euler("xyz", [0.3, -0.4, 2.0]).as_matrix()
    translation = np.array([0.1, -0.2, 0.7])
    projection = scale * MATRIX @ np.column_stack([rotation, translation])
    camera = read_camera(tmp_path, projection)
    require_matrix(camera, MATRIX)
    np.testing.assert_allclose(camera.cam_from_world.rotation, rotation, atol=1e-10)
    np.testing.assert_allclose(camera.cam_from_world.translation, translation, atol=1e-10)


@pytest.mark.parametrize("value", [0.0, np.nan, np.inf])
def test_what_projects_nothing_is_refused(tmp_path: Path, value: float) -> None:
    with pytest.raises(DataError, match="world_mat_0 is no camera: it is singular"):
        read_camera(tmp_path, np.full((3, 4), value))


@pytest.mark.parametrize("sign", [1, -1])
def test_skew_of_rounding_goes_and_that_of_a_camera_is_refused(tmp_path: Path, sign: int) -> None:
    """The limit is a thousandth of the focal length of 900 px."""
    skewed = np.column_stack([MATRIX, np.zeros(3)])
    skewed[0, 1] = 0.8 * sign
    require_matrix(read_camera(tmp_path, skewed), MATRIX)
    skewed[0, 1] = 1.0 * sign
    with pytest.raises(DataError, match=r"skewed by -?1 px"):
        read_camera(tmp_path, skewed)


def test_a_matrix_of_mosaics_is_halved(tmp_path: Path) -> None:
    """Pixels count from the first one's centre: u of the mosaic is 2 u + 0.5 of the image."""
    mosaic = np.array([[1800.0, 0, 621.0, 0], [0, 1820.0, 512.0, 0], [0, 0, 1, 0]])
    require_matrix(read_camera(tmp_path, mosaic), MATRIX)


def test_arrays_of_a_file_by_name(tmp_path: Path) -> None:
    np.savez(tmp_path / "a.npz", first=MATRIX, second=np.arange(3))
    found = read_npz(tmp_path / "a.npz")
    assert sorted(found) == ["first", "second"]
    np.testing.assert_array_equal(found["first"], MATRIX)
    (tmp_path / "b.npz").write_bytes((tmp_path / "a.npz").read_bytes()[:-30])
    with pytest.raises(DataError, match=r"no readable \.npz of cameras"):
        read_npz(tmp_path / "b.npz")
