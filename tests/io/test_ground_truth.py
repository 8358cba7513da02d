from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

import polmvs
from polmvs.errors import DataError
from polmvs.io.ground_truth import GroundTruth, depth_unit, open_ground_truth
from polmvs.neighbors import in_cells_beside, nearest_points, voxel_representatives

DEMO = Path(polmvs.__file__).parent / "demo_capture"
BOARD_TOP_M = 0.012


@pytest.fixture(scope="module")
def demo() -> GroundTruth:
    return open_ground_truth(DEMO)


@pytest.fixture
def copy(tmp_path: Path) -> Path:
    """Ground truth of one view that a test may spoil."""
    for path in DEMO.glob("gt/000_*.png"):
        shutil.copy(path, tmp_path)
    content = json.loads((DEMO / "gt" / "cameras.json").read_text())
    content["images"] = {"000.png": content["images"]["000.png"]}
    (tmp_path / "cameras.json").write_text(json.dumps(content))
    return tmp_path


def test_capture_folder_and_gt_folder_open_the_same(demo: GroundTruth) -> None:
    assert open_ground_truth(DEMO / "gt").names == demo.names
    assert len(demo.names) == 10
    assert demo.find("raw/003.png") is demo.views["003.png"]
    assert demo.find("nothing.png") is None


def test_maps_have_units_and_nan(demo: GroundTruth) -> None:
    name = demo.names[0]
    depth, normals, mask = demo.depth(name), demo.normals(name), demo.mask(name)
    assert depth.dtype == normals.dtype == np.float32
    assert mask.dtype == np.bool_
    assert 0.2 < np.nanmin(depth) < np.nanmax(depth) < 1.0
    assert np.isnan(depth).any()
    np.testing.assert_array_equal(np.isfinite(normals).all(axis=-1), mask)
    np.testing.assert_allclose(np.linalg.norm(normals[mask], axis=-1), 1.0, atol=1e-6)


def test_far_depths_have_a_coarser_unit(copy: Path, demo: GroundTruth) -> None:
    content = json.loads((copy / "cameras.json").read_text())
    (copy / "cameras.json").write_text(json.dumps({**content, "depth_unit_m": depth_unit(6.5)}))
    far, near = open_ground_truth(copy), demo.depth("000.png")
    np.testing.assert_allclose(far.depth("000.png"), near * 6.5 / 65535 / 20e-6, rtol=1e-6)
    assert depth_unit(1.3) == 20e-6  # of usual captures


def test_surface_is_the_board_and_its_surroundings(demo: GroundTruth) -> None:
    surface = demo.surface_points(0.002, 0.004)
    part = surface.points[surface.is_part]
    np.testing.assert_allclose(part[:, 2], BOARD_TOP_M, atol=2e-5)  # depth comes in 20 um
    np.testing.assert_allclose(surface.normals[surface.is_part], [[0, 0, 1]] * len(part), atol=1e-3)
    assert np.isnan(surface.normals[~surface.is_part]).all()
    # One point per 2 mm square of the 300 x 400 mm board that the views see, few at its rim twice.
    assert 0.5 * 30_000 < len(part) < 1.1 * 30_000
    assert demo.surface_points(0.002, 0.004) is surface


def test_spacing_must_be_positive(demo: GroundTruth) -> None:
    with pytest.raises(ValueError, match="spacing"):
        demo.surface_points(0.0, 0.001)


def test_pixels_beside_a_depth_step_are_no_surface(copy: Path) -> None:
    path = str(copy / "000_depth.png")
    depth = cv2.imread(path, cv2.IMREAD_UNCHANGED)
    assert depth is not None
    depth[::3, ::3] //= 2  # every pixel is now beside a step
    cv2.imwrite(path, depth)
    mask = np.zeros(depth.shape, np.uint8)
    mask[1:-1, 1:-1] = 1  # at the frame's edge there is no neighbour to compare with
    cv2.imwrite(str(copy / "000_mask.png"), mask)
    with pytest.raises(DataError, match="no mask shows the part"):
        open_ground_truth(copy).surface_points()


def _remove_image(folder: Path) -> None:
    (folder / "000_normal.png").unlink()


def _remove_cameras(folder: Path) -> None:
    (folder / "cameras.json").unlink()


def _spoil_json(folder: Path) -> None:
    (folder / "cameras.json").write_text('{"width": 4')


def _set(folder: Path, key: str, value: object) -> None:
    content = json.loads((folder / "cameras.json").read_text())
    (folder / "cameras.json").write_text(json.dumps({**content, key: value}))


def _edit(folder: Path, key: str, value: object) -> None:
    content = json.loads((folder / "cameras.json").read_text())
    content["images"]["000.png"][key] = value
    (folder / "cameras.json").write_text(json.dumps(content))


@pytest.mark.parametrize(
    ("spoil", "file"),
    [
        (_remove_image, "000_normal.png: missing"),
        (_remove_cameras, "cameras.json: missing"),
        (_spoil_json, "cameras.json: cannot be read as JSON"),
        (lambda f: (f / "cameras.json").write_text("[]"), "cameras.json: needs integer width"),
        (lambda f: _edit(f, "K", [[1, 2], [3, 4]]), "cameras.json: K of 000.png"),
        (lambda f: _edit(f, "K", "abc"), "cameras.json: 000.png needs numbers"),
        (lambda f: _set(f, "depth_unit_m", 0), "cameras.json: has a depth_unit_m of 0"),
        (lambda f: _set(f, "depth_unit_m", "mm"), "cameras.json: needs integer width"),
        (lambda f: _edit(f, "K", [[1, 2, 0], [0, 1, 0], [0, 0, 1]]), "without skew"),
        (lambda f: _edit(f, "cam_from_world", [[1] * 4] * 3), "rigid motion"),
        (lambda f: _edit(f, "cam_from_world", [[float("nan")] * 4] * 3), "rigid motion"),
    ],
)
def test_spoilt_folder_is_one_line(copy: Path, spoil: Callable[[Path], object], file: str) -> None:
    spoil(copy)
    with pytest.raises(DataError, match=file) as caught:
        open_ground_truth(copy)
    assert "\n" not in str(caught.value)


def test_missing_folder(tmp_path: Path) -> None:
    with pytest.raises(DataError, match="no such folder"):
        open_ground_truth(tmp_path / "nowhere")


def test_truncated_image(copy: Path) -> None:
    path = copy / "000_depth.png"
    path.write_bytes(path.read_bytes()[:-2000])
    with pytest.raises(DataError, match=r"000_depth\.png: is truncated"):
        open_ground_truth(copy).depth("000.png")


def test_image_of_another_size_or_depth(copy: Path) -> None:
    cv2.imwrite(str(copy / "000_mask.png"), np.zeros((5, 7), np.uint8))
    cv2.imwrite(str(copy / "000_depth.png"), np.zeros((384, 459), np.uint8))
    truth = open_ground_truth(copy)
    with pytest.raises(DataError, match=r"000_mask\.png: is 7x5 px but cameras.json says 459x384"):
        truth.mask("000.png")
    with pytest.raises(DataError, match="must be a 16-bit PNG of 1 channel"):
        truth.depth("000.png")


def test_voxels_keep_one_point_each() -> None:
    points = np.random.default_rng(0).uniform(-1, 1, (20_000, 3))
    kept = voxel_representatives(points, 0.5)
    assert 4**3 <= len(kept) <= 5**3
    assert len(voxel_representatives(points[:0], 0.5)) == 0
    np.testing.assert_array_equal(voxel_representatives(points[:1], 0.5), [0])


def test_cells_beside() -> None:
    others = np.zeros((1, 3))
    points = np.array([[0.9, 0, 0], [-0.9, -0.9, -0.9], [3.5, 0, 0]])
    np.testing.assert_array_equal(in_cells_beside(points, others, 1.0), [True, True, False])


def test_nearest_is_exact_near_and_close_to_it_far() -> None:
    rng = np.random.default_rng(0)
    points, queries = rng.uniform(-1, 1, (2000, 3)), rng.uniform(-2, 2, (300, 3))
    exact = np.linalg.norm(queries[:, None] - points, axis=-1)
    distances, indices = nearest_points(points, queries, far=0.5)
    near = exact.min(axis=1) < 0.5
    np.testing.assert_array_equal(indices[near], exact.argmin(axis=1)[near])
    np.testing.assert_allclose(distances, exact[np.arange(300), indices])
    assert np.all(distances <= exact.min(axis=1) + 0.35 * 0.5)
    assert np.isinf(nearest_points(points[:0], queries, far=0.5)[0]).all()
