"""Meshes in other programs' formats, read back by readers that are not ours."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest
import trimesh

from polmvs.errors import OptionError
from polmvs.io.clouds import Mesh
from polmvs.io.mesh_files import MESH_FORMATS, Texture, linear_of_display, write_mesh_file


def tetrahedron() -> Mesh:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1.0]]) * 0.123456 + 4
    normals = vertices - vertices.mean(axis=0)
    return Mesh(
        vertices=vertices,
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        triangles=np.array([[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]], np.int32),
        colors=np.array([[250, 20, 0], [10, 200, 30], [0, 3, 128], [90, 90, 90]], np.uint8),
    )


def chequered() -> Texture:
    image = np.zeros((8, 8, 3), np.uint8)
    image[:4, :4] = (255, 0, 0)  # upper left
    image[4:, 4:] = (0, 0, 255)  # lower right
    return Texture(image=image, uv=np.array([[0.1, 0.9], [0.9, 0.1], [0.9, 0.9], [0.1, 0.1]]))


def loaded(path: Path) -> trimesh.Trimesh:
    return trimesh.load(path, process=False, maintain_order=True, force="mesh")


def glb_floats(path: Path, name: str) -> np.ndarray:
    """Numbers of an attribute: trimesh drops colours beside a material."""
    data = path.read_bytes()
    length = int.from_bytes(data[12:16], "little")
    content = json.loads(data[20 : 20 + length])
    number = content["meshes"][0]["primitives"][0]["attributes"][name]
    view = content["bufferViews"][content["accessors"][number]["bufferView"]]
    start = 20 + length + 8 + view["byteOffset"]
    return np.frombuffer(data[start : start + view["byteLength"]], "<f4")


@pytest.mark.parametrize("suffix", MESH_FORMATS)
def test_trimesh_reads_what_the_format_holds(tmp_path: Path, suffix: str) -> None:
    mesh, kind = tetrahedron(), MESH_FORMATS[suffix]
    path = tmp_path / f"part{suffix.upper()}"
    assert write_mesh_file(path, mesh) == (path,)
    assert [p.name for p in tmp_path.iterdir()] == [path.name]
    found = loaded(path)
    corners = np.asarray(found.vertices)[np.asarray(found.faces)]
    np.testing.assert_allclose(corners, mesh.vertices[mesh.triangles], atol=1e-6)
    assert found.is_watertight == (suffix != ".stl")  # of its own the STL's corners are separate
    assert found.volume == pytest.approx(0.123456**3 / 6, rel=1e-4)  # and so faces outwards
    if kind.colors:
        if suffix == ".glb":  # linear there, as the standard has it
            colors = glb_floats(path, "COLOR_0").reshape(-1, 3)
            np.testing.assert_allclose(colors, linear_of_display(mesh.colors), atol=1e-6)
        else:
            colors = np.asarray(found.visual.vertex_colors)[:, :3]
            np.testing.assert_array_equal(colors, mesh.colors)


@pytest.mark.parametrize("suffix", MESH_FORMATS)
def test_open3d_reads_it(tmp_path: Path, suffix: str) -> None:
    import open3d

    mesh = tetrahedron()
    path = tmp_path / f"part{suffix}"
    write_mesh_file(path, mesh)
    found = open3d.io.read_triangle_mesh(str(path))
    corners = np.asarray(found.vertices)[np.asarray(found.triangles)]
    np.testing.assert_allclose(corners, mesh.vertices[mesh.triangles], atol=1e-6)
    if MESH_FORMATS[suffix].normals:
        normals = np.asarray(found.vertex_normals)[np.asarray(found.triangles)]
        np.testing.assert_allclose(normals, mesh.normals[mesh.triangles], atol=2e-5)


@pytest.mark.parametrize("suffix", [s for s, kind in MESH_FORMATS.items() if kind.texture])
def test_a_texture_lies_where_it_should(tmp_path: Path, suffix: str) -> None:
    texture = chequered()
    files = write_mesh_file(tmp_path / f"part{suffix}", tetrahedron(), texture)
    assert {p.name for p in tmp_path.iterdir()} == {p.name for p in files}
    found = loaded(files[0])
    np.testing.assert_allclose(found.visual.uv, texture.uv, atol=1e-6)
    colors = found.visual.to_color().vertex_colors[:, :3]
    np.testing.assert_array_equal(colors[0], (255, 0, 0))  # uv has its origin below
    np.testing.assert_array_equal(colors[1], (0, 0, 255))
    if suffix == ".obj":
        assert cv2.imread(str(files[2])).shape == (8, 8, 3)


def test_colours_of_a_screen_as_linear_ones() -> None:
    shares = linear_of_display(np.array([0, 10, 128, 255], np.uint8))
    np.testing.assert_allclose(shares, [0, 0.0030353, 0.2158605, 1], atol=1e-6)  # IEC 61966-2-1


@pytest.mark.parametrize("name", ["part.stp", "part", "part.ply.gz"])
def test_unknown_names_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(OptionError, match=r"\.ply, \.obj, \.stl, \.glb"):
        write_mesh_file(tmp_path / name, tetrahedron())
    assert not list(tmp_path.iterdir())


def test_formats_without_texture_say_so(tmp_path: Path) -> None:
    with pytest.raises(OptionError, match=r"holds no texture; name a file of \.obj, \.glb"):
        write_mesh_file(tmp_path / "part.stl", tetrahedron(), chequered())
    with pytest.raises(OptionError, match="without blanks"):
        write_mesh_file(tmp_path / "a part.obj", tetrahedron(), chequered())
    assert not list(tmp_path.iterdir())
