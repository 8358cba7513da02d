import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.clouds import Cloud, Mesh, mesh_to_open3d, read_cloud, write_cloud

RNG = np.random.default_rng(0)


def some_cloud(num=50):
    normals = RNG.normal(size=(num, 3))
    return Cloud(
        points=RNG.normal(size=(num, 3)),
        normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        colors=RNG.integers(0, 255, size=(num, 3)).astype(np.uint8),
        scalars={"sigma_deg": RNG.uniform(size=num), "num_views": np.arange(num)},
    )


def test_everything_comes_back(tmp_path):
    cloud = some_cloud()
    write_cloud(tmp_path / "c.ply", cloud)
    again = read_cloud(tmp_path / "c.ply")
    np.testing.assert_allclose(again.points, cloud.points, atol=1e-6)
    np.testing.assert_allclose(again.normals, cloud.normals, atol=1e-6)
    np.testing.assert_array_equal(again.colors, cloud.colors)
    np.testing.assert_allclose(again.scalars["sigma_deg"], cloud.scalars["sigma_deg"], atol=1e-6)
    np.testing.assert_array_equal(again.scalars["num_views"], np.arange(50))
    assert [p.name for p in tmp_path.iterdir()] == ["c.ply"]


def test_open3d_opens_it_as_any_cloud(tmp_path):
    import open3d

    write_cloud(tmp_path / "c.ply", some_cloud())
    loaded = open3d.io.read_point_cloud(str(tmp_path / "c.ply"))
    assert len(loaded.points) == 50
    assert loaded.has_normals()
    assert loaded.has_colors()
    assert np.asarray(loaded.colors).max() > 0.5


def test_the_header_names_the_columns_that_other_programs_look_for(tmp_path):
    write_cloud(tmp_path / "c.ply", some_cloud())
    header = (tmp_path / "c.ply").read_bytes().split(b"end_header")[0].decode()
    for column in ("float x", "float nx", "uchar red", "float sigma_deg"):
        assert f"property {column}" in header
    assert "binary_little_endian" in header


def test_an_empty_cloud(tmp_path):
    empty = Cloud(np.zeros((0, 3)), scalars={"sigma_deg": np.zeros(0)})
    write_cloud(tmp_path / "e.ply", empty)
    assert read_cloud(tmp_path / "e.ply").points.shape == (0, 3)


@pytest.mark.parametrize("content", [b"", b"not a cloud", b"ply\nformat ascii 1.0\nend_header\n"])
def test_what_is_no_cloud_is_named(tmp_path, content):
    path = tmp_path / "bad.ply"
    path.write_bytes(content)
    with pytest.raises(DataError, match=r"bad\.ply"):
        read_cloud(path)


def test_a_truncated_cloud_is_named(tmp_path):
    path = tmp_path / "short.ply"
    write_cloud(path, some_cloud())
    path.write_bytes(path.read_bytes()[:-200])
    with pytest.raises(DataError, match=r"short\.ply"):
        read_cloud(path)


def test_a_missing_cloud_is_named(tmp_path):
    with pytest.raises(DataError, match=r"nothing\.ply"):
        read_cloud(tmp_path / "nothing.ply")


@pytest.mark.parametrize(
    ("kind", "colors", "expected"),
    [
        ("uchar", "0 127 255", [0, 127, 255]),
        ("ushort", "0 32896 65535", [0, 128, 255]),
        ("float", "0 0.5 1", [0, 128, 255]),
        ("float", "-1 nan 2", [0, 0, 255]),
        ("double", "0.25 inf -inf", [64, 255, 0]),
    ],
)
def test_colours_of_any_type_are_shares_of_their_range(tmp_path, kind, colors, expected):
    """Half of 255 is rounded to the even 128."""
    lines = [
        *("ply", "format ascii 1.0", "element vertex 1"),
        *(f"property float {name}" for name in "xyz"),
        *(f"property {kind} {name}" for name in ("red", "green", "blue")),
        *("end_header", f"0 0 0 {colors}"),
    ]
    (tmp_path / "a.ply").write_text("\n".join(lines) + "\n")
    assert read_cloud(tmp_path / "a.ply").colors.tolist() == [expected]


def test_open3d_shows_a_mesh_in_its_colours():
    colors = np.array([[0, 51, 255], [255, 0, 102], [1, 2, 3]], np.uint8)
    mesh = Mesh(
        vertices=np.eye(3),
        normals=np.full((3, 3), np.sqrt(1 / 3)),
        triangles=np.array([[0, 1, 2]], np.int32),
        colors=colors,
    )
    shown = mesh_to_open3d(mesh)
    np.testing.assert_allclose(np.asarray(shown.vertex_colors), colors / 255, atol=1e-12)
    np.testing.assert_array_equal(np.asarray(shown.vertices), mesh.vertices)
    np.testing.assert_array_equal(np.asarray(shown.triangles), mesh.triangles)
    np.testing.assert_allclose(np.asarray(shown.vertex_normals), mesh.normals)
