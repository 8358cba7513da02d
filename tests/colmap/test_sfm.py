"""Structure from motion on the bundled capture, and its refusals."""

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

import polmvs
from polmvs.colmap.models import read_model
from polmvs.colmap.sfm import check_intrinsics, run_sfm
from polmvs.config import SfmOptions
from polmvs.errors import DataError, OptionError
from polmvs.geometry import align_points
from polmvs.polarization.capture import intensity_image_8bit, open_capture
from polmvs.scene import SparseModel

DEMO = Path(polmvs.__file__).parent / "demo_capture"
TRUTH = json.loads((DEMO / "gt" / "cameras.json").read_text())["images"]
K = np.array(TRUTH["000.png"]["K"])
INTRINSICS = (K[0, 0], K[1, 1], K[0, 2], K[1, 2])


@pytest.fixture(scope="module")
def images(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("images")
    capture = open_capture(DEMO)
    white = capture.exposure()
    for name in capture.names:
        cv2.imwrite(str(folder / name), intensity_image_8bit(capture.load(name), white))
    return folder


def reconstruct(images: Path, work: Path, num: int | None = None, **options) -> SparseModel:
    names = sorted(path.name for path in images.iterdir())[:num]
    return run_sfm(images, names, work / "work", work / "sparse", SfmOptions(**options))


def pose_errors(model: SparseModel) -> tuple[np.ndarray, np.ndarray]:
    """Errors of camera centres, mm, and of rotations, degrees, after alignment of the centres."""
    truth = [np.array(TRUTH[view.name]["cam_from_world"]) for view in model.views]
    true_centers = np.array([-pose[:, :3].T @ pose[:, 3] for pose in truth])
    centers = np.array([view.center_in_world for view in model.views])
    transform = align_points(centers, true_centers)
    turns = [
        cv2.Rodrigues(view.cam_from_world.rotation @ transform.rotation.T @ pose[:, :3].T)[0]
        for view, pose in zip(model.views, truth, strict=True)
    ]
    distances = np.linalg.norm(transform * centers - true_centers, axis=1)
    return 1e3 * distances, np.degrees(np.linalg.norm(np.array(turns)[..., 0], axis=1))


def test_images_of_low_contrast_give_as_many_points(images, tmp_path, caplog):
    """As if a window left the rest dark."""
    caplog.set_level("INFO")
    dark = tmp_path / "dark"
    dark.mkdir()
    for path in images.iterdir():
        image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        cv2.imwrite(str(dark / path.name), np.rint(50 + 0.2 * image).astype(np.uint8))
    model = reconstruct(dark, tmp_path, intrinsics=INTRINSICS)
    assert "lower contrast" in caplog.text
    assert len(model.views) == 10
    assert len(model.tracks.point3D_ids) > 700
    centers, rotations = pose_errors(model)
    assert centers.max() < 3
    assert rotations.max() < 0.3


def test_demo_with_intrinsics(images, tmp_path):
    stages: list[str] = []
    names = sorted(path.name for path in images.iterdir())
    model = run_sfm(
        images,
        names[::-1],
        tmp_path / "work",
        tmp_path / "sparse",
        SfmOptions(intrinsics=INTRINSICS),
        stages.append,
    )
    assert stages == ["features", "matching", "mapping", "bundle adjustment"]
    assert [view.name for view in model.views] == names
    assert model.unregistered == ()
    assert len(model.tracks.point3D_ids) > 1500
    camera = model.views[0].camera
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == INTRINSICS
    distances, turns = pose_errors(model)  # 0.19 mm and 0.02 degrees when written
    assert np.median(distances) < 0.5
    assert np.median(turns) < 0.06

    assert_same(model, read_model(tmp_path / "sparse"))


def assert_same(model: SparseModel, other: SparseModel) -> None:
    for one, two in zip(model.views, other.views, strict=True):
        for part in ("rotation", "translation"):
            first, second = (getattr(v.cam_from_world, part) for v in (one, two))
            np.testing.assert_allclose(first, second, rtol=0, atol=1e-14)
    np.testing.assert_array_equal(model.tracks.points_in_world, other.tracks.points_in_world)
    np.testing.assert_array_equal(model.tracks.obs_xy, other.tracks.obs_xy)


def test_demo_without_intrinsics(images, tmp_path):
    """The principal point, 1 and 5 px off the centre, is found."""
    model = reconstruct(images, tmp_path)
    assert len(model.views) == 10
    camera = model.views[0].camera
    focal, cx, cy, _ = camera.params
    np.testing.assert_allclose((focal, cx, cy), (K[0, 0], K[0, 2], K[1, 2]), atol=1.5)
    distances, turns = pose_errors(model)  # 0.22 mm and 0.08 degrees when written
    assert np.median(distances) < 0.6
    assert np.median(turns) < 0.2


@pytest.mark.parametrize("single_camera", [True, False])
def test_three_views(images, tmp_path, single_camera):
    model = reconstruct(images, tmp_path, num=3, intrinsics=INTRINSICS, single_camera=single_camera)
    assert len(model.views) == 3
    assert np.median(pose_errors(model)[0]) < 1
    if single_camera:  # again, over the first one's files
        again = reconstruct(images, tmp_path, num=3, intrinsics=INTRINSICS)
        assert_same(model, again)


def test_no_model_of_textureless_images(tmp_path):
    folder = tmp_path / "images"
    folder.mkdir()
    for index in range(3):
        cv2.imwrite(str(folder / f"{index}.png"), np.full((80, 100), 90, np.uint8))
    with pytest.raises(DataError, match=r"no model of these images.*texture.*`sfm.sparse`"):
        reconstruct(folder, tmp_path)
    assert not (tmp_path / "sparse").exists()


def test_faulty_images(images, tmp_path):
    options = SfmOptions()
    work, sparse = tmp_path / "work", tmp_path / "sparse"
    with pytest.raises(DataError, match="has 1 images"):
        run_sfm(images, ["000.png"], work, sparse, options)
    with pytest.raises(DataError, match=r"none\.png: no such file"):
        run_sfm(images, ["000.png", "none.png"], work, sparse, options)
    small = tmp_path / "images"
    small.mkdir()
    for index in (0, 1):
        cv2.imwrite(str(small / f"{index}.png"), np.zeros((80 + index, 100), np.uint8))
    with pytest.raises(DataError, match="differ in size"):
        run_sfm(small, ["0.png", "1.png"], work, sparse, options)


def test_unknown_camera_model(images, tmp_path):
    with pytest.raises(OptionError, match=r"`sfm.camera_model` LENS is unknown.*SIMPLE_RADIAL"):
        reconstruct(images, tmp_path, camera_model="LENS")


def test_intrinsics_that_fit():
    camera = check_intrinsics(INTRINSICS, 459, 384)
    assert (camera.width, camera.height, camera.fx, camera.cy) == (459, 384, K[0, 0], K[1, 2])


@pytest.mark.parametrize(
    ("intrinsics", "message"),
    [
        (tuple(2 * value for value in INTRINSICS), "full mosaic.*333.75,333.75,230.6475,196.608"),
        ((333.0, 333.0, 700.0, 196.0), "outside the 459x384"),
        ((333.0, 333.0, 230.0, 390.0), "outside the 459x384"),
        ((8.0, 8.0, 230.0, 196.0), "half-size"),
        ((333.0, 9000.0, 230.0, 196.0), "half-size"),
    ],
)
def test_intrinsics_that_cannot_be(intrinsics, message):
    with pytest.raises(OptionError, match=message):
        check_intrinsics(intrinsics, 459, 384)
