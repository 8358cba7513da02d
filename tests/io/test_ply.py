"""PLY files of all kinds, and those that lie: each fault is one error that names the file."""

import struct
from pathlib import Path

import numpy as np
import pytest

from polmvs.errors import DataError
from polmvs.io.clouds import Mesh, has_triangles, read_cloud, read_mesh, write_mesh

POINTS = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], np.float64)
SQUARE = [[0, 1, 2], [0, 2, 3]]
FLOATS = "property float x\nproperty float y\nproperty float z\n"


def ply(kind: str, text: str, data: bytes) -> bytes:
    return f"ply\nformat {kind} 1.0\n{text}end_header\n".encode() + data


def ascii_ply(vertices: str, faces: str = "", num_vertices: int = 4, num_faces: int = 0) -> bytes:
    header = f"element vertex {num_vertices}\n{FLOATS}"
    if num_faces:
        header += f"element face {num_faces}\nproperty list uchar int vertex_indices\n"
    return ply("ascii", header, (vertices + faces).encode())


def binary_ply(faces: bytes, num: int, index: str = "int", kind: str = "binary_little_endian"):
    order = "<f4" if kind == "binary_little_endian" else ">f4"
    header = f"element vertex 4\n{FLOATS}element face {num}\n"
    header += f"property list uchar {index} vertex_indices\n"
    return ply(kind, header, POINTS.astype(order).tobytes() + faces)


@pytest.fixture
def write(tmp_path: Path):
    def write(data: bytes) -> Path:
        path = tmp_path / "a.ply"
        path.write_bytes(data)
        return path

    return write


ROWS = "0 0 0\n1 0 0\n1 1 0\n0 1 0\n"


@pytest.mark.parametrize(
    "data",
    [
        ascii_ply(ROWS, "3 0 1 2\n3 0 2 3\n", num_faces=2),
        ascii_ply(ROWS.replace("\n", "\r\n"), "4 0 1 2 3", num_faces=1),
        binary_ply(struct.pack("<B3iB3i", 3, 0, 1, 2, 3, 0, 2, 3), 2),
        binary_ply(struct.pack(">B4H", 4, 0, 1, 2, 3), 1, "ushort", "binary_big_endian"),
    ],
)
def test_a_square_in_every_form(write, data: bytes) -> None:
    path = write(data)
    assert has_triangles(path)
    mesh = read_mesh(path)
    np.testing.assert_array_equal(mesh.vertices, POINTS)
    np.testing.assert_array_equal(mesh.triangles, SQUARE)
    np.testing.assert_allclose(mesh.normals, np.tile([0, 0, 1.0], (4, 1)))
    np.testing.assert_array_equal(read_cloud(path).points, POINTS)


def test_polygons_of_different_sizes_beside_other_columns(write) -> None:
    header = f"element vertex 4\n{FLOATS}element edge 2\nproperty int a\nproperty int b\n"
    header += "element face 2\nproperty uchar flags\nproperty list uchar uint vertex_index\n"
    header += "property list uchar float texcoord\nelement mine 1\nproperty double w\n"
    faces = struct.pack("<BB4IB2f", 7, 4, 0, 1, 2, 3, 2, 0.5, 0.5)
    faces += struct.pack("<BB3IB", 7, 3, 0, 2, 3, 0)
    data = POINTS.astype("<f4").tobytes() + struct.pack("<4i", 0, 1, 1, 2) + faces
    mesh = read_mesh(write(ply("binary_little_endian", header, data + struct.pack("<d", 1))))
    np.testing.assert_array_equal(mesh.triangles, [*SQUARE, [0, 2, 3]])


def test_what_has_no_faces_is_no_mesh(write) -> None:
    assert not has_triangles(write(ascii_ply(ROWS)))
    header = f"element vertex 4\n{FLOATS}element face 0\nproperty list uchar int vertex_indices\n"
    assert not has_triangles(write(ply("ascii", header, ROWS.encode())))


def test_lists_of_an_ascii_file_may_be_empty(write) -> None:
    """Strips and groups of other programs: each row of its own length, none as well."""
    header = f"element vertex 4\n{FLOATS}element strip 3\nproperty list uchar int indices\n"
    header += "element face 1\nproperty list uchar int vertex_indices\n"
    path = write(ply("ascii", header, f"{ROWS}0\n2 1 2\n0\n3 0 1 2\n".encode()))
    assert read_mesh(path).triangles.tolist() == [[0, 1, 2]]


def test_colours_of_other_programs(write) -> None:
    for kind, values in (("uchar", "255 0 128"), ("float", "1 0 0.5"), ("ushort", "65535 0 32768")):
        names = "".join(f"property {kind} {name}\n" for name in ("red", "green", "blue"))
        header = f"comment caf\xe9\nelement vertex 1\n{FLOATS}{names}property int label\n"
        cloud = read_cloud(write(ply("ascii", header, f"1 2 3 {values} -7\n".encode())))
        np.testing.assert_array_equal(cloud.colors, [[255, 0, 128]])
        np.testing.assert_array_equal(cloud.scalars["label"], [-7])


def test_open3d_reads_the_mesh_that_is_written(tmp_path: Path) -> None:
    import open3d

    mesh = Mesh(POINTS, np.tile([0, 0, 1.0], (4, 1)), np.array(SQUARE, np.int32), np.eye(4, 3) > 0)
    write_mesh(tmp_path / "m.ply", mesh)
    loaded = open3d.io.read_triangle_mesh(str(tmp_path / "m.ply"))
    np.testing.assert_array_equal(np.asarray(loaded.triangles), SQUARE)
    np.testing.assert_array_equal(np.asarray(loaded.vertices), POINTS)
    assert loaded.has_vertex_normals()


def test_the_smallest_rows_of_an_ascii_file_are_read_and_one_less_is_not(write) -> None:
    """A value is a digit and a space or a line's end, of which the last may be missing."""
    assert len(read_cloud(write(ascii_ply("0 0 0\n" * 4))).points) == 4
    assert len(read_cloud(write(ascii_ply(("0 0 0\n" * 4)[:-1]))).points) == 4
    for data in ("0 0 0\n" * 3, ("0 0 0\n" * 4)[:-3], "0 0 0\n" * 3 + "0 0\n"):
        with pytest.raises(DataError, match=r"a\.ply: is truncated"):
            read_cloud(write(ascii_ply(data)))


LONG = "9" * 5000
FACE = struct.pack("<B3i", 3, 0, 1, 2)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (ascii_ply(ROWS, num_vertices=5), "truncated"),
        (ascii_ply(ROWS, num_vertices=10**14), "truncated"),
        (ascii_ply(ROWS).replace(b"vertex 4", b"vertex " + LONG.encode()), "header line"),
        (ascii_ply(ROWS).replace(b"vertex 4", b"vertex -4"), "header line"),
        (ascii_ply(ROWS).replace(b"vertex 4", "vertex \N{SUPERSCRIPT TWO}".encode()), "header"),
        (ascii_ply(ROWS).replace(b"float z", b"quaternion z"), "a column 'z' that no PLY has"),
        (ascii_ply(ROWS).replace(b"float z", b"float y"), "a column 'y'"),
        (ascii_ply(ROWS).replace(b"property float z\n", b""), "truncated"),
        (ascii_ply(ROWS).replace(b"format ascii 1.0\n", b""), "its format is missing"),
        (ascii_ply(ROWS).replace(b"end_header", b"end"), "is no PLY"),
        (ascii_ply("\n\n\n\n" * 8), "truncated"),
        (ascii_ply("a b c\n" * 4), "a row of vertex that is none"),
        (ascii_ply(ROWS.replace("1 1 0", "nan 1 0")), "not finite"),
        (ascii_ply(ROWS.replace("1 1 0", "1e300 1 0")), "not finite"),
        (ascii_ply(ROWS.replace("1 1 0", f"{LONG} 1 0")), "not finite"),
        (ascii_ply(ROWS, "3 0 1 4\n", num_faces=1), "a vertex that there is not"),
        (ascii_ply(ROWS, "3 0 1 -1\n", num_faces=1), "a vertex that there is not"),
        (ascii_ply(ROWS, "3 0 1 inf\n", num_faces=1), "a vertex that there is not"),
        (ascii_ply(ROWS, "3 0 1 0.5\n", num_faces=1), "no whole numbers"),
        (ascii_ply(ROWS, "2 0 1\n", num_faces=1), "fewer than three"),
        (ascii_ply(ROWS, "-3 0 1\n", num_faces=1), "truncated"),
        (ascii_ply(ROWS, f"{LONG} 0 1\n", num_faces=1), "truncated"),
        (ascii_ply(ROWS, "3 0 1 2\n", num_faces=2), "truncated"),
        (ascii_ply(ROWS, "x 0 1 2\n", num_faces=1), "truncated"),
        (binary_ply(FACE, 2), "truncated"),
        (binary_ply(FACE, 10**14), "truncated"),
        (binary_ply(FACE[:-2], 1), "truncated"),
        (binary_ply(struct.pack("<B3i", 255, 0, 1, 2), 1), "truncated"),
        (binary_ply(FACE + struct.pack("<B2i", 2, 0, 1), 2), "fewer than three"),
        (binary_ply(FACE + struct.pack("<B4i", 9, 0, 1, 2, 3), 2), "truncated"),
        (binary_ply(struct.pack("<B3i", 3, 0, 1, 2**31 - 1), 1), "a vertex that there is not"),
        (binary_ply(struct.pack("<B3i", 3, 0, 1, -1), 1), "a vertex that there is not"),
        (binary_ply(FACE, 1).replace(b"vertex_indices", b"corners_______"), "vertex_indices"),
        (binary_ply(FACE, 1).replace(b"list uchar", b"list float"), "a column 'vertex_indices'"),
        (binary_ply(FACE, 1).replace(b"vertex 4", b"vertex 0"), "truncated|fewer than|vertex that"),
        (ply("ascii", f"element vertex 0\n{FLOATS}" * 2, b""), "two elements of one name"),
        (ply("ascii", "element vertex 7\n", b""), "rows without columns"),
        (ply("ascii", "", b""), "holds no vertices"),
    ],
)
def test_what_lies_is_one_error_that_names_the_file(write, data: bytes, message: str) -> None:
    path = write(data)
    with pytest.raises(DataError, match=rf"a\.ply: .*({message})"):
        read_mesh(path) if b"element face" in data else read_cloud(path)
