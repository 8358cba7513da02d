"""Dense workspaces: written, opened again, against COLMAP's own; bad folders."""

import shutil
from dataclasses import replace

import numpy as np
import pycolmap
import pytest
from dense_scenes import (
    DenseScene,
    board_points,
    board_scene,
    fuse,
    image_shift,
    scene_of,
    without_maps,
)

from polmvs.camera import PinholeCamera
from polmvs.colmap.dense_workspace import map_files, open_dense_workspace, source_order
from polmvs.colmap.models import read_model, write_model
from polmvs.errors import DataError
from polmvs.io.images import write_png
from polmvs.scene import SparseModel
from polmvs.surface.map_export import export_dense_workspace


@pytest.fixture(scope="module")
def scene():
    return board_scene()


@pytest.fixture(scope="module")
def written(scene, tmp_path_factory):
    """A workspace without maps of its second view; tests that change it take a copy."""
    return scene.write(
        tmp_path_factory.mktemp("dense") / "workspace",
        lambda name: None if name == "001.png" else scene.dense(name),
    )


@pytest.fixture
def workspace(written, tmp_path):
    return shutil.copytree(written, tmp_path / "workspace")


def in_subfolders(scene):
    names = [f"left/a/{view.name}" for view in scene.views]
    views = [replace(view, name=name) for view, name in zip(scene.views, names, strict=True)]
    model = SparseModel(views=tuple(views), tracks=scene.model.tracks, unregistered=())
    return DenseScene(scene.surface, model)


def test_files_of_a_workspace(written, scene):
    names = [view.name for view in scene.views]
    assert {path.name for path in written.iterdir()} == {"images", "sparse", "stereo"}
    assert not list((written / "stereo" / "consistency_graphs").iterdir())
    assert sorted(path.name for path in (written / "images").iterdir()) == names
    fused = (written / "stereo" / "fusion.cfg").read_text().split()
    assert fused == [name for name in names if name != "001.png"]
    for kind in ("depth_maps", "normal_maps"):
        files = sorted(path.name for path in (written / "stereo" / kind).iterdir())
        assert files == [f"{name}.geometric.bin" for name in fused]
    lines = (written / "stereo" / "patch-match.cfg").read_text().splitlines()
    assert lines[::2] == names
    for name, sources in zip(names, lines[1::2], strict=True):
        assert sorted([name, *sources.split(", ")]) == names


def test_workspace_round_trip(written, scene):
    opened = open_dense_workspace(written)
    assert without_maps(opened) == ("001.png",)
    assert [item.view.name for item in opened.views] == [view.name for view in scene.views]
    item = opened.views[0]
    assert isinstance(item.camera, PinholeCamera)
    maps, exact = item.load_maps(), scene.exact_maps(item.view)
    known = (maps.depth > 0) & (exact.depth > 0)
    assert known.mean() > 0.15
    np.testing.assert_allclose(maps.depth[known], exact.depth[known], atol=1e-6)
    np.testing.assert_allclose(maps.normals[known], exact.normals[known], atol=1e-5)
    assert opened.views[1].load_maps() is None
    for original, view in zip(scene.views, opened.views, strict=True):
        np.testing.assert_allclose(
            view.view.cam_from_world.rotation, original.cam_from_world.rotation, atol=1e-12
        )


def test_images_show_what_the_undistorted_camera_sees(written, scene):
    item = open_dense_workspace(written).views[2]
    model = SparseModel(views=(item.view,), tracks=scene.model.tracks, unregistered=())
    seen = DenseScene(scene.surface, model).image(item.view.name).astype(float)
    difference = np.abs(item.load_image() - seen)
    assert np.median(difference) <= 1


def test_against_the_workspace_that_colmap_makes(scene, tmp_path):
    for view in scene.views:
        (tmp_path / "images").mkdir(exist_ok=True)
        write_png(tmp_path / "images" / view.name, scene.image(view.name))
    write_model(scene.model, tmp_path / "sparse")
    theirs_folder = tmp_path / "theirs"
    pycolmap.undistort_images(
        str(theirs_folder), str(tmp_path / "sparse"), str(tmp_path / "images")
    )
    theirs = open_dense_workspace(theirs_folder)
    ours = open_dense_workspace(scene.write(tmp_path / "ours"))
    assert without_maps(theirs) == tuple(view.name for view in scene.views)
    for one, two in zip(ours.views, theirs.views, strict=True):
        assert one.view.name == two.view.name
        assert one.camera == two.camera
        images = one.load_image(), two.load_image()
        inner = np.zeros(images[0].shape, bool)
        inner[3:-3, 3:-3] = True
        assert np.abs(image_shift(*images, inner)).max() < 0.05
        assert np.median(np.abs(images[0].astype(float) - images[1])) <= 1
    np.testing.assert_allclose(ours.tracks.obs_xy, theirs.tracks.obs_xy, atol=1e-4)


def test_names_with_subfolders(scene, tmp_path):
    nested = in_subfolders(scene)
    folder = nested.write(tmp_path / "workspace")
    opened = open_dense_workspace(folder)
    assert without_maps(opened) == ()
    name = opened.views[0].view.name
    assert name == "left/a/000.png"
    assert map_files(folder / "stereo", name)[0] == opened.views[0].depth
    assert len(fuse(folder).points) > 500


@pytest.mark.parametrize("name", ["../out.png", "/tmp/out.png", "a/../../out.png"])
def test_names_that_lead_out_of_the_folder(scene, tmp_path, name):
    view = scene.views[0]
    views = (replace(view, name=name),)
    model = scene_of(views, scene.surface, board_points()).model
    with pytest.raises(DataError, match="no name of an image"):
        export_dense_workspace(
            tmp_path / "workspace", model, lambda _: scene.image("000.png"), lambda _: None
        )
    assert not list(tmp_path.iterdir())


def test_one_view_has_no_sources(scene, tmp_path):
    single = scene_of(scene.views[:1], scene.surface, board_points())
    folder = single.write(tmp_path / "workspace")
    assert (folder / "stereo" / "patch-match.cfg").read_text() == ""


def test_sources_by_shared_points_then_by_nearness():
    scene = board_scene()
    tracks = scene.model.tracks
    # View 2, opposite of view 0, keeps all its points, its neighbour 1 only one, the others none.
    kept = (tracks.obs_view == 0) | (tracks.obs_view == 2)
    kept |= (tracks.obs_view == 1) & (tracks.obs_track == 0)
    fewer = replace(
        tracks,
        obs_track=tracks.obs_track[kept],
        obs_view=tracks.obs_view[kept],
        obs_xy=tracks.obs_xy[kept],
    )
    model = replace(scene.model, tracks=fewer)
    orders = source_order(model)
    assert orders[0] == [2, 1, 4, 3]
    assert set(orders[4][:2]) == {0, 3}  # its neighbours in the ring
    assert set(orders[4][2:]) == {1, 2}


def test_a_folder_in_use_is_refused(scene, written, tmp_path):
    with pytest.raises(DataError, match="exists already"):
        scene.write(written)
    (tmp_path / "file").write_text("a")
    with pytest.raises(DataError, match="exists already"):
        scene.write(tmp_path / "file")
    (tmp_path / "empty").mkdir()
    scene.write(tmp_path / "empty", lambda _: None)
    assert len(without_maps(open_dense_workspace(tmp_path / "empty"))) == 5


def test_whole_or_not_at_all(scene, tmp_path):
    def fail(name):
        if name == "002.png":
            raise RuntimeError(name)
        return scene.dense(name)

    with pytest.raises(RuntimeError):
        scene.write(tmp_path / "workspace", fail)
    assert not list(tmp_path.iterdir())


def test_photometric_maps_where_there_are_no_geometric(workspace):
    for path in workspace.rglob("000.png.geometric.bin"):
        path.rename(path.with_name("000.png.photometric.bin"))
    opened = open_dense_workspace(workspace)
    assert without_maps(opened) == ("001.png",)
    assert opened.views[0].depth.name == "000.png.photometric.bin"
    assert opened.views[0].load_maps().depth.any()


def test_half_a_pair_of_maps_counts_as_missing(workspace):
    (workspace / "stereo" / "normal_maps" / "000.png.geometric.bin").unlink()
    assert without_maps(open_dense_workspace(workspace)) == ("000.png", "001.png")


def refused(folder, words):
    with pytest.raises(DataError, match=words) as caught:
        open_dense_workspace(folder)
    assert "\n" not in str(caught.value)


def test_bad_workspaces(workspace, scene):
    refused(workspace / "none", "no such folder")
    refused(workspace / "stereo" / "fusion.cfg", "is no folder")
    refused(workspace / "images", "has no stereo folder")
    path = workspace / "stereo" / "depth_maps" / "000.png.geometric.bin"
    good = path.read_bytes()
    path.write_bytes(good[:-100])
    refused(workspace, "000.png.geometric.bin: is damaged")
    path.write_bytes(good.replace(b"168&132&", b"132&168&", 1))
    refused(workspace, "is 132x168 px but its camera 168x132")
    path.write_bytes(good)
    (workspace / "images" / "003.png").unlink()
    refused(workspace, "lacks 1 of the model's 5 images: 003.png")
    write_model(scene.model, workspace / "sparse")
    write_png(workspace / "images" / "003.png", scene.image("003.png"))
    refused(workspace, "the camera of 000.png has distortion")
    shutil.rmtree(workspace / "sparse")
    refused(workspace, "sparse: no such folder")


def test_bad_images(workspace):
    view = open_dense_workspace(workspace).views[0]
    write_png(view.image, np.zeros((10, 12), np.uint8))
    with pytest.raises(DataError, match="is 12x10 px but its camera 168x132"):
        view.load_image()
    view.image.write_bytes(b"nothing")
    with pytest.raises(DataError, match="not a readable image"):
        view.load_image()


def test_the_written_model_reads_as_it_is(written, scene):
    model = read_model(written / "sparse")
    assert len(model.tracks.point3D_ids) == len(scene.model.tracks.point3D_ids)
    np.testing.assert_allclose(
        model.tracks.points_in_world, scene.model.tracks.points_in_world, atol=1e-12
    )
