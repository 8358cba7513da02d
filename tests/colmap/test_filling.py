"""Holes of a workspace filled: what is kept, what is made, what is restored."""

import os
import shutil

import numpy as np
import pytest
from dense_scenes import NORMAL, board_scene, fuse, without_maps

from polmvs.colmap.dense_workspace import open_dense_workspace
from polmvs.colmap.filling import fill_maps, fill_workspace
from polmvs.colmap.maps import DepthNormals
from polmvs.errors import DataError, OptionError

NAMES = [f"{i:03d}.png" for i in range(5)]
FAR = 1.25  # of COLMAP's own maps beside the truth: to be recognised


@pytest.fixture(scope="module")
def scene():
    return board_scene()


@pytest.fixture(scope="module")
def made(scene, tmp_path_factory):
    """As COLMAP left it: left halves only, of 001 and 003 photometric, nothing of 002."""

    def left_half(name):
        dense = scene.dense(name)
        dense.range_map[:, 40:] = 0
        return None if name == "002.png" else dense

    folder = scene.write(tmp_path_factory.mktemp("filling") / "workspace", left_half)
    for name in ("001.png", "003.png"):
        for path in folder.rglob(f"{name}.geometric.bin"):
            path.rename(path.with_name(f"{name}.photometric.bin"))
    (folder / "fused.ply").write_text("stale")
    return folder


@pytest.fixture
def workspace(made, tmp_path):
    return shutil.copytree(made, tmp_path / "workspace")


def contents(folder):
    return {
        str(path.relative_to(folder)): path.read_bytes()
        for path in folder.rglob("*")
        if path.is_file()
    }


def exact_fill(scene, source):
    views = {item.view.name: item.view for item in source.views}
    return lambda name: scene.exact_maps(views[name])


def test_own_depth_is_kept_and_holes_are_filled():
    own = DepthNormals(
        np.array([[1.0, 0.0, 0.0]], np.float32), np.array([[[0, 0, -1], [0, 0, 0], [0, 0, 0]]])
    )
    fill = DepthNormals(
        np.array([[5.0, 6.0, 0.0]], np.float32), np.array([[[0, 1, 0], [0.6, 0, -0.8], [0, 0, 0]]])
    )
    merged = fill_maps(own, fill)
    np.testing.assert_array_equal(merged.depth, [[1, 6, 0]])
    np.testing.assert_array_equal(merged.normals, [[[0, 0, -1], [0.6, 0, -0.8], [0, 0, 0]]])
    assert fill_maps(None, fill) is fill
    with pytest.raises(ValueError, match="shape"):
        fill_maps(own, DepthNormals(np.zeros((2, 3)), np.zeros((2, 3, 3))))


def test_a_new_workspace(scene, made, tmp_path):
    before = contents(made)
    source = open_dense_workspace(made)
    exact = exact_fill(scene, source)

    def moved(name):
        maps = exact(name)
        return DepthNormals(maps.depth * FAR, maps.normals) if name in NAMES[:3] else None

    assert fill_workspace(source, tmp_path / "filled", moved) is None
    assert contents(made) == before
    filled = open_dense_workspace(tmp_path / "filled")
    assert without_maps(filled) == ()
    assert (tmp_path / "filled" / "stereo" / "fusion.cfg").read_text().split() == NAMES
    assert not (tmp_path / "filled" / "fused.ply").exists()
    for old, new in zip(source.views, filled.views, strict=True):
        assert new.depth.name == f"{new.view.name}.geometric.bin"
        own, maps, fill = old.load_maps(), new.load_maps(), moved(new.view.name)
        kept = np.zeros(maps.depth.shape, bool) if own is None else own.depth > 0
        assert kept.any() == (new.view.name != "002.png")
        for index in range(2):
            if own is not None:
                np.testing.assert_array_equal(maps[index][kept], own[index][kept])
            expected = np.zeros_like(maps[index]) if fill is None else fill[index]
            np.testing.assert_array_equal(maps[index][~kept], expected[~kept])
    # Files that do not change are copies, not links.
    for path in (tmp_path / "filled").rglob("*.*"):
        assert path.stat().st_nlink == 1
        assert not path.is_symlink()


def coverage(cloud, cell=0.01):
    """Number of cells of a centimetre that hold points."""
    return len(np.unique(np.floor(cloud.points[:, :2] / cell), axis=0))


def test_the_filled_workspace_fuses(scene, made, tmp_path):
    source = open_dense_workspace(made)
    few = coverage(fuse(made, min_num_pixels=3))
    fill_workspace(source, tmp_path / "filled", exact_fill(scene, source))
    cloud = fuse(tmp_path / "filled", min_num_pixels=3)
    assert coverage(cloud) > 1.5 * few
    assert np.abs(cloud.points @ NORMAL).max() < 0.5 * 0.5 / 120


def test_in_place_with_a_backup(scene, workspace):
    before = contents(workspace)
    source = open_dense_workspace(workspace)
    backup = fill_workspace(source, None, exact_fill(scene, source))
    assert backup == workspace / "stereo.polmvs-backup-1"
    after = contents(workspace)
    saved = contents(backup)
    for name, data in saved.items():
        assert before[f"stereo/{name}"] == data
    replaced = {f"stereo/{name}" for name in saved}
    assert {name for name in before if after[name] != before[name]} <= replaced
    assert "stereo/depth_maps/000.png.geometric.bin" in replaced
    assert not any("photometric" in name for name in replaced)
    assert without_maps(open_dense_workspace(workspace)) == ()
    assert not [path for path in workspace.iterdir() if path.name.startswith(".")]
    again = open_dense_workspace(workspace)
    second = fill_workspace(again, None, lambda _: None)
    assert second == workspace / "stereo.polmvs-backup-2"
    now = contents(workspace / "stereo")
    assert now == {name[7:]: data for name, data in after.items() if name.startswith("stereo/")}


@pytest.mark.parametrize("fail_at", [1, 4, 9])
def test_a_failure_while_swapping_restores_all(scene, workspace, monkeypatch, fail_at):
    before = contents(workspace)
    source = open_dense_workspace(workspace)
    real, calls = os.replace, []

    def broken(start, end):
        calls.append(start)
        if len(calls) == fail_at:
            raise OSError(28, "No space left on device")
        real(start, end)

    class Os:
        replace = staticmethod(broken)

    monkeypatch.setattr("polmvs.colmap.filling.os", Os)  # the swap's alone, not write_bytes'
    with pytest.raises(DataError, match="No space left on device"):
        fill_workspace(source, None, exact_fill(scene, source))
    assert len(calls) > fail_at or fail_at == 1
    assert contents(workspace) == before
    assert not list(workspace.glob("stereo.*"))


def test_a_damaged_map_changes_nothing(scene, workspace):
    source = open_dense_workspace(workspace)
    path = workspace / "stereo" / "depth_maps" / "004.png.geometric.bin"
    data = bytearray(path.read_bytes())
    data[-4:] = b"\x00\x00\xc0\x7f"  # NaN
    path.write_bytes(data)
    before = contents(workspace)
    with pytest.raises(DataError, match="not finite"):
        fill_workspace(source, None, exact_fill(scene, source))
    with pytest.raises(DataError, match="not finite"):
        fill_workspace(source, workspace.parent / "new", exact_fill(scene, source))
    assert contents(workspace) == before
    assert [entry.name for entry in workspace.parent.iterdir()] == ["workspace"]


def test_links_in_the_source_are_not_followed_by_writes(scene, workspace, tmp_path):
    store = tmp_path / "store"
    (workspace / "stereo" / "depth_maps").rename(store)
    (workspace / "stereo" / "depth_maps").symlink_to(store)
    before = contents(store)
    source = open_dense_workspace(workspace)
    fill_workspace(source, tmp_path / "filled", exact_fill(scene, source))
    assert contents(store) == before
    assert not (tmp_path / "filled" / "stereo" / "depth_maps").is_symlink()


def test_bad_targets(workspace):
    source = open_dense_workspace(workspace)
    for target in (workspace, workspace / "new"):
        with pytest.raises(OptionError, match="lies in the workspace"):
            fill_workspace(source, target, lambda _: None)
    (workspace.parent / "used").mkdir()
    (workspace.parent / "used" / "file").write_text("a")
    with pytest.raises(DataError, match="exists already"):
        fill_workspace(source, workspace.parent / "used", lambda _: None)


def test_a_fill_of_another_size(scene, workspace):
    small = DepthNormals(np.ones((3, 4), np.float32), np.zeros((3, 4, 3), np.float32))
    with pytest.raises(ValueError, match=r"of 000.png but expected \(132, 168\)"):
        fill_workspace(open_dense_workspace(workspace), workspace.parent / "new", lambda _: small)
