"""Meshes of files: formats, units, faults, and how far facets are from their normals."""

import logging

import numpy as np
import pytest

from polmvs.errors import DataError, OptionError
from polmvs.io.clouds import Mesh
from polmvs.simulation.mesh_input import object_mesh, surface_sag
from polmvs.simulation.options import Facets, ObjectOptions
from polmvs.synthetic.shapes import named_shape, shape_names

trimesh = pytest.importorskip("trimesh", reason="trimesh is not installed (extra 'simulate')")


def sphere(subdivisions=2, radius=0.12):
    return trimesh.creation.icosphere(subdivisions=subdivisions, radius=radius)


def area(corners):
    sides = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.linalg.norm(np.cross(*sides), axis=1).sum()


@pytest.mark.parametrize("suffix", ["ply", "obj", "stl", "glb"])
def test_formats_give_the_same_object(tmp_path, suffix):
    path = tmp_path / f"part.{suffix}"
    sphere().export(path)
    found = object_mesh(path, ObjectOptions())
    assert np.ptp(found.mesh.vertices, axis=0) == pytest.approx([0.24, 0.24, 0.24], rel=0.02)
    assert found.mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-9)
    corners = found.mesh.vertices[found.mesh.triangles]
    assert area(corners) == pytest.approx(sphere().area, rel=1e-5)
    outwards = corners.mean(axis=1) - [0, 0, found.mesh.vertices[:, 2].max() / 2]
    assert ((found.mesh.normals[found.mesh.triangles[:, 0]] * outwards).sum(axis=1) > 0).all()
    assert surface_sag(found.mesh) == 0  # facets are what they are


def test_flat_facets_smooth_surface_and_the_trap_between_them(tmp_path):
    path = tmp_path / "part.ply"
    sphere().export(path)
    coarse = sphere()
    interpolated = Mesh(
        np.asarray(coarse.vertices),
        np.asarray(coarse.vertices) / 0.12,
        np.asarray(coarse.faces, np.int32),
    )
    # An arc's sagitta over a chord l: r - sqrt(r^2 - l^2 / 4).
    edge = np.linalg.norm(
        coarse.vertices[coarse.edges[:, 0]] - coarse.vertices[coarse.edges[:, 1]], axis=1
    ).max()
    assert surface_sag(interpolated) == pytest.approx(
        0.12 - np.sqrt(0.12**2 - edge**2 / 4), rel=0.02
    )
    assert surface_sag(interpolated) > 5e-4  # the trap: over half a millimetre
    smooth = object_mesh(path, ObjectOptions(facets=Facets.SMOOTH))
    assert surface_sag(smooth.mesh) <= 2e-4 * 0.24
    assert len(smooth.mesh.triangles) > 320


def test_millimetres_are_told_by_the_size(tmp_path, caplog):
    path = tmp_path / "part.stl"
    sphere(radius=120.0).export(path)
    with caplog.at_level(logging.WARNING):
        found = object_mesh(path, ObjectOptions())
    assert "millimetres" in caplog.text
    assert np.ptp(found.mesh.vertices[:, 0]) == pytest.approx(0.24, rel=0.02)
    given = object_mesh(path, ObjectOptions(unit=0.0254))
    assert np.ptp(given.mesh.vertices[:, 0]) == pytest.approx(240 * 0.0254, rel=0.02)
    sized = object_mesh(path, ObjectOptions(size=0.5))
    assert np.ptp(sized.mesh.vertices, axis=0).max() == pytest.approx(0.5)
    with pytest.raises(OptionError, match="exclude"):
        object_mesh(path, ObjectOptions(size=0.5, unit=1.0))


def test_holes_and_edges_of_three_faces_are_told(tmp_path, caplog):
    whole = sphere()
    holed = trimesh.Trimesh(whole.vertices, whole.faces[:-5], process=False)
    holed.export(tmp_path / "holed.ply")
    fin = np.vstack([whole.faces, [whole.faces[0, 0], whole.faces[0, 1], 100]])
    trimesh.Trimesh(whole.vertices, fin, process=False).export(tmp_path / "fin.ply")
    with caplog.at_level(logging.WARNING):
        object_mesh(tmp_path / "holed.ply", ObjectOptions())
        assert "holes" in caplog.text
        object_mesh(tmp_path / "fin.ply", ObjectOptions())
        assert "more than two faces" in caplog.text


def test_colours_of_vertices_become_linear_albedo(tmp_path):
    coloured = sphere(1)
    coloured.visual.vertex_colors = np.tile([188, 0, 255, 255], (len(coloured.vertices), 1))
    coloured.export(tmp_path / "part.ply")
    found = object_mesh(tmp_path / "part.ply", ObjectOptions())
    # 188 of 255 is half of the light in sRGB.
    np.testing.assert_allclose(found.vertex_albedo[0], [0.5, 0, 1], atol=0.005)


def test_large_facets_are_halved_and_colours_stay_linear(tmp_path):
    # A square of 0.2 m, red along x.
    corners = np.array([[0, 0, 0], [0.2, 0, 0], [0.2, 0.2, 0], [0, 0.2, 0]])
    square = trimesh.Trimesh(corners, [[0, 1, 2], [2, 3, 0]], process=False)
    square.visual.vertex_colors = [[value, 0, 0, 255] for value in (0, 255, 255, 0)]
    square.export(tmp_path / "square.ply")
    found = object_mesh(tmp_path / "square.ply", ObjectOptions())
    halved = found.mesh.vertices[found.mesh.triangles]
    assert area(halved) == pytest.approx(0.04, rel=1e-6)
    edges = np.linalg.norm(np.roll(halved, -1, axis=1) - halved, axis=2)
    assert 0.5 * 0.2 / 30 < edges.max() <= 0.2 / 30
    x = found.mesh.vertices[:, 0] - found.mesh.vertices[:, 0].min()
    np.testing.assert_allclose(found.vertex_albedo[:, 0], x / 0.2, atol=0.01)


def test_what_is_no_object_is_refused(tmp_path, monkeypatch):
    cloud = tmp_path / "cloud.ply"
    trimesh.PointCloud(np.random.default_rng(0).normal(size=(50, 3))).export(cloud)
    with pytest.raises(DataError, match="no faces"):
        object_mesh(cloud, ObjectOptions())
    (tmp_path / "broken.glb").write_bytes(b"glTF\x02\0\0\0garbage")
    with pytest.raises(DataError, match="cannot be read"):
        object_mesh(tmp_path / "broken.glb", ObjectOptions())
    with pytest.raises(DataError, match="no built-in shape"):
        object_mesh("teapot", ObjectOptions())
    (tmp_path / "part.step").write_text("ISO-10303-21;")
    with pytest.raises(DataError, match="no mesh that is read"):
        object_mesh(tmp_path / "part.step", ObjectOptions())
    sphere(radius=1e-7).export(tmp_path / "dust.ply")
    with pytest.raises(DataError, match=r"object\.size"):
        object_mesh(tmp_path / "dust.ply", ObjectOptions())
    monkeypatch.setattr("polmvs.simulation.mesh_input.MAX_TRIANGLES", 300)
    sphere().export(tmp_path / "part.ply")
    with pytest.raises(DataError, match="320 faces"):
        object_mesh(tmp_path / "part.ply", ObjectOptions())
    flat = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [2, 0, 0]], [[0, 1, 2]], process=False)
    flat.export(tmp_path / "flat.ply")
    with pytest.raises(DataError, match="no face with an area"):
        object_mesh(tmp_path / "flat.ply", ObjectOptions())


@pytest.mark.parametrize("name", shape_names())
def test_built_in_shapes_are_closed_and_true_to_their_normals(name):
    mesh = named_shape(name)
    corners = mesh.vertices[mesh.triangles]
    facing = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    facing /= np.linalg.norm(facing, axis=1, keepdims=True)
    normals = mesh.normals[mesh.triangles].mean(axis=1)
    assert (facing * normals).sum(axis=1).min() > 0.99
    assert surface_sag(mesh) < 3e-4
    assert np.ptp(mesh.vertices, axis=0).max() == pytest.approx(1)
    assert mesh.vertices[:, 2].min() == pytest.approx(0, abs=1e-12)
