"""Reader and writer of PLY files as columns of numbers; input is untrusted.

If a header declares more than the file has, Open3D's readers abort, crash or fill up with zeros.
Here every count is checked against the length of the file before memory is allocated, and every
index of a face against the number of vertices.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from io import BytesIO
from itertools import islice
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from polmvs.errors import MAX_QUOTED, DataError, as_data_error
from polmvs.io.images import read_bytes, write_bytes
from polmvs.io.plain_files import read_head

MAX_HEADER_BYTES = 1 << 16
TYPES = {
    "char": "i1", "uchar": "u1", "int8": "i1", "uint8": "u1", "short": "i2", "ushort": "u2",
    "int16": "i2", "uint16": "u2", "int": "i4", "uint": "u4", "int32": "i4", "uint32": "u4",
    "float": "f4", "float32": "f4", "double": "f8", "float64": "f8",
}  # fmt: skip
NAMES = {"u1": "uchar", "i4": "int", "f4": "float"}  # of the written types
ORDERS = {"ascii": "", "binary_little_endian": "<", "binary_big_endian": ">"}
_COUNT = re.compile(r"\d{1,15}", re.ASCII)
_TRUNCATED = "is truncated; write or copy it again."


class Property(NamedTuple):
    """A column: a value for each row, or a list of values if ``length`` is given.

    Attributes
    ----------
    name : of the column.
    type : of a value, NumPy's name without byte order.
    length : type of the length of a list; empty for a single value.
    """

    name: str
    type: str
    length: str = ""


class Element(NamedTuple):
    """A table.

    Attributes
    ----------
    name : such as ``vertex``.
    num : rows.
    properties : columns.
    """

    name: str
    num: int
    properties: tuple[Property, ...]

    @property
    def has_lists(self) -> bool:
        """Whether rows differ in length."""
        return any(column.length for column in self.properties)

    def least_bytes(self, *, ascii_format: bool) -> int:
        """Least size of all rows: an ASCII value takes two bytes, a list at least its length."""
        if ascii_format:
            return max(2 * len(self.properties) * self.num - 1, 0)
        widths = [np.dtype(column.length or column.type).itemsize for column in self.properties]
        return self.num * sum(widths)


@dataclass(frozen=True, kw_only=True)
class PlyHeader:
    """The header of a PLY.

    Attributes
    ----------
    order : ``<`` or ``>``; empty for ASCII.
    elements : tables in the order of the file.
    start : of the first row, bytes.
    """

    order: str
    elements: tuple[Element, ...]
    start: int

    def find(self, name: str) -> Element | None:
        """The table of that name."""
        return next((element for element in self.elements if element.name == name), None)


@dataclass(frozen=True, kw_only=True)
class PlyContent:
    """Vertices and faces of a PLY.

    Attributes
    ----------
    vertices : columns (N,) by name, in the types of the file.
    triangles : (F, 3) int64, polygons cut into fans; None without faces.
    """

    vertices: Mapping[str, NDArray[Any]]
    triangles: NDArray[np.int64] | None


def read_ply_header(path: Path) -> PlyHeader:
    """Read and check a header.

    Raises
    ------
    DataError
        The file is missing, not a PLY, or too short for its header.
    """
    with as_data_error(path, "read", missing="no such file; give a PLY point cloud."):
        head, size = read_head(path, MAX_HEADER_BYTES)
    found = re.match(rb"ply\s.*?^end_header[^\S\n]*\r?\n", head, re.DOTALL | re.MULTILINE)
    if found is None:
        raise DataError(path, "is no PLY file; give a PLY point cloud.")
    lines = [line.split() for line in found[0].decode("ascii", "replace").split("\n")]
    order, elements = None, list[Element]()
    for words in lines:
        match words:
            case ["format", name, "1.0"] if name in ORDERS and order is None:
                order = ORDERS[name]
            case ["element", name, num] if _COUNT.fullmatch(num):
                elements.append(Element(name, int(num), ()))
            case ["property", "list", count, kind, name] if elements:
                elements[-1] = _with(path, elements[-1], name, kind, count)
            case ["property", kind, name] if elements:
                elements[-1] = _with(path, elements[-1], name, kind)
            case [] | ["ply"] | ["end_header"] | ["comment", *_] | ["obj_info", *_]:
                pass
            case _:
                line = " ".join(words)[:MAX_QUOTED]
                raise DataError(path, f"has a header line that no PLY has: {line!r}.")
    if order is None:
        raise DataError(path, "is no PLY file: its format is missing.")
    if any(element.num and not element.properties for element in elements):
        raise DataError(path, "is no PLY file: rows without columns.")
    if len({element.name for element in elements}) < len(elements):
        raise DataError(path, "is no PLY file: two elements of one name.")
    header = PlyHeader(order=order, elements=tuple(elements), start=found.end())
    least = sum(element.least_bytes(ascii_format=not order) for element in elements)
    if size < header.start + least:
        raise DataError(path, _TRUNCATED)
    return header


def _with(path: Path, element: Element, name: str, kind: str, count: str = "") -> Element:
    """An element with a further column."""
    known = kind in TYPES and (not count or TYPES.get(count, "f")[0] in "ui")
    if not known or any(other.name == name for other in element.properties):
        raise DataError(path, f"has a column {name[:MAX_QUOTED]!r} that no PLY has.")
    column = Property(name, TYPES[kind], TYPES[count] if count else "")
    return element._replace(properties=(*element.properties, column))


def read_ply(path: Path, *, faces: bool = False) -> PlyContent:
    """Read the vertices of a PLY, and on request its faces.

    Raises
    ------
    DataError
        The file is missing, truncated, not a PLY, or a face has an invalid vertex index.
    """
    header = read_ply_header(path)
    vertex = header.find("vertex")
    if vertex is None or vertex.has_lists:
        raise DataError(path, "holds no vertices; give a PLY point cloud.")
    face = header.find("face") if faces else None
    reader = _Ascii(path, header) if not header.order else _Binary(path, header)
    vertices: Mapping[str, NDArray[Any]] = {}
    triangles = None
    last = max(header.elements.index(element) for element in (vertex, face) if element is not None)
    for element in header.elements[: last + 1]:
        if not element.has_lists:
            columns = reader.columns(element)
            if element is vertex:
                vertices = columns
        lists = reader.lists(element) if element.has_lists else None
        if element is face:
            triangles = _triangles(path, lists or {}, vertex.num)
    return PlyContent(vertices=vertices, triangles=triangles)


class _Lists(NamedTuple):
    """A column of lists: their lengths (N,), and all values one after the other."""

    lengths: NDArray[np.int64]
    values: NDArray[Any]


class _Reader:
    """Elements one after the other."""

    path: Path

    def row(self, element: Element) -> list[Any]:
        """The values of each column in the next row."""
        raise NotImplementedError

    def lists(self, element: Element) -> dict[str, _Lists]:
        """Columns of lists of an element, by name."""
        if element.num == 0:
            return {}
        columns = zip(*(self.row(element) for _ in range(element.num)), strict=True)
        return {
            kind.name: _Lists(np.array([*map(len, rows)], np.int64), np.concatenate(rows))
            for kind, rows in zip(element.properties, columns, strict=True)
            if kind.length
        }


class _Binary(_Reader):
    """Rows of numbers."""

    def __init__(self, path: Path, header: PlyHeader) -> None:
        self.path, self.order = path, header.order
        self.data, self.position = read_bytes(path), header.start

    def columns(self, element: Element) -> dict[str, NDArray[Any]]:
        """Columns of an element without lists, by name."""
        kinds = [(str(i), self.order + c.type) for i, c in enumerate(element.properties)]
        rows = self.take(np.dtype(kinds), element.num)
        return {
            c.name: np.ascontiguousarray(rows[str(i)], c.type)
            for i, c in enumerate(element.properties)
        }

    def take(self, kind: np.dtype[Any], num: int) -> NDArray[Any]:
        """The next values of one type."""
        if num < 0 or num * kind.itemsize > len(self.data) - self.position:
            raise DataError(self.path, _TRUNCATED)
        values = np.frombuffer(self.data, kind, num, self.position)
        self.position += num * kind.itemsize
        return values

    def row(self, element: Element) -> list[Any]:
        """The values of each column in the next row."""
        values = []
        for column in element.properties:
            num = 1
            if column.length:
                num = int(self.take(np.dtype(self.order + column.length), 1)[0])
            values.append(self.take(np.dtype(self.order + column.type), num))
        return values

    def lists(self, element: Element) -> dict[str, _Lists]:
        """Columns of lists: nearly always all faces have as many corners as the first."""
        if element.num == 0:
            return {}
        start = self.position
        lengths = [len(values) for values in self.row(element)]
        row_bytes, self.position = self.position - start, start
        if row_bytes * element.num <= len(self.data) - start:
            kinds: list[tuple[Any, ...]] = []
            for i, column in enumerate(element.properties):
                kinds += [(f"n{i}", self.order + column.length)] if column.length else []
                kinds += [(str(i), self.order + column.type, (lengths[i],))]
            rows = self.take(np.dtype(kinds), element.num)
            found = [i for i, column in enumerate(element.properties) if column.length]
            if all((rows[f"n{i}"] == lengths[i]).all() for i in found):
                return {
                    element.properties[i].name: _Lists(
                        np.full(element.num, lengths[i]),
                        rows[str(i)].astype(element.properties[i].type).reshape(-1),
                    )
                    for i in found
                }
            self.position = start
        return super().lists(element)


class _Ascii(_Reader):
    """Lines of numbers."""

    def __init__(self, path: Path, header: PlyHeader) -> None:
        self.path = path
        self.stream = BytesIO(read_bytes(path)[header.start :])

    def columns(self, element: Element) -> dict[str, NDArray[Any]]:
        """Columns of an element without lists, by name."""
        names = element.properties
        if element.num == 0:
            return {c.name: np.zeros(0, c.type) for c in names}
        try:
            lines = [self.stream.readline() for _ in range(element.num)]
            if not lines[0].strip():  # NumPy warns of no numbers at all
                raise DataError(self.path, _TRUNCATED)
            rows = np.loadtxt(lines, np.float64, comments=None, ndmin=2)
        except (ValueError, OverflowError) as error:
            raise DataError(self.path, f"holds a row of {element.name} that is none.") from error
        if rows.shape != (element.num, len(names)):
            raise DataError(self.path, _TRUNCATED)
        with np.errstate(invalid="ignore", over="ignore"):
            return {c.name: rows[:, i].astype(c.type) for i, c in enumerate(names)}

    def row(self, element: Element) -> list[Any]:
        """The values of each column in the next line."""
        words, values = iter(self.stream.readline().split()), []
        try:
            for column in element.properties:
                num = int(next(words)[:9]) if column.length else 1
                values.append([float(word) for word in islice(words, num)])
                if len(values[-1]) != num:
                    raise DataError(self.path, _TRUNCATED)
        except (ValueError, StopIteration) as error:
            raise DataError(self.path, _TRUNCATED) from error
        return values


def _triangles(path: Path, lists: Mapping[str, _Lists], num_vertices: int) -> NDArray[np.int64]:
    """Corners of triangles; a polygon is the fan about its first corner."""
    corners = lists.get("vertex_indices", lists.get("vertex_index"))
    if corners is None:
        if not lists:
            return np.zeros((0, 3), np.int64)
        raise DataError(path, "has faces without vertex_indices; give a PLY mesh.")
    lengths, values = corners
    if len(lengths) and lengths.min() < 3:
        raise DataError(path, "has a face of fewer than three corners.")
    if values.dtype.kind == "f" and not (values == np.floor(values)).all():
        raise DataError(path, "has a face whose corners are no whole numbers.")
    if len(values) and not (values.min() >= 0 and values.max() < num_vertices):
        raise DataError(path, "has a face with a vertex that there is not.")
    values = values.astype(np.int64)
    num_cut = lengths - 2
    face = np.repeat(np.arange(len(lengths)), num_cut)
    first = (np.cumsum(lengths) - lengths)[face]
    step = np.arange(len(face)) - (np.cumsum(num_cut) - num_cut)[face]
    return np.stack([values[first], values[first + step + 1], values[first + step + 2]], axis=-1)


def write_ply(
    path: Path,
    vertices: Mapping[str, NDArray[Any]],
    triangles: NDArray[np.int32] | None = None,
) -> None:
    """Write a binary PLY whole or not at all.

    Parameters
    ----------
    path : file to write or replace; its folder is created.
    vertices : columns (N,) by name; uint8 is kept, all others become float32.
    triangles : (F, 3), indices of vertices.

    Raises
    ------
    DataError
        The system refuses.
    """
    kinds = {n: "u1" if c.dtype == np.uint8 else "f4" for n, c in vertices.items()}
    num = len(next(iter(vertices.values())))
    rows = np.empty(num, [(name, f"<{kind}") for name, kind in kinds.items()])
    for name, column in vertices.items():
        rows[name] = column
    lines = ["ply", "format binary_little_endian 1.0", f"element vertex {num}"]
    lines += [f"property {NAMES[kind]} {name}" for name, kind in kinds.items()]
    tables: Sequence[NDArray[Any]] = [rows]
    if triangles is not None:
        faces = np.empty(len(triangles), [("count", "u1"), ("index", "<i4", 3)])
        faces["count"], faces["index"] = 3, triangles
        lines += [f"element face {len(faces)}", "property list uchar int vertex_indices"]
        tables = [rows, faces]
    header = ("\n".join([*lines, "end_header"]) + "\n").encode()
    with as_data_error(path, "written"):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_bytes(path, b"".join([header, *(table.tobytes() for table in tables)]))
