"""Meshes as files of other programs: PLY, OBJ with its MTL and texture, STL, GLB.

:data:`MESH_FORMATS` has the content of each. Coordinates keep the unit and axes of the mesh; GLB
and STL have 32-bit floats.
"""

from __future__ import annotations

import io
import json
import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs._version import __version__
from polmvs.arrays import Array
from polmvs.errors import DataError, OptionError
from polmvs.io.clouds import Mesh, write_mesh
from polmvs.io.images import encode_png, write_bytes

GLB_MAGIC, GLB_VERSION, GLB_JSON, GLB_BIN = 0x46546C67, 2, 0x4E4F534A, 0x004E4942
FLOAT, UNSIGNED_INT = 5126, 5125  # component types of glTF
ARRAY_BUFFER, ELEMENT_ARRAY_BUFFER = 34962, 34963
LINEAR, MIPMAPPED, CLAMPED = 9729, 9987, 33071  # of a glTF sampler
ROUGHNESS = 0.6  # of the material, for viewers with lighting: neither mirror nor chalk


@dataclass(frozen=True, kw_only=True)
class Texture:
    """A texture of a mesh.

    Attributes
    ----------
    image : (H, W, 3) uint8, red, green, blue, encoded for display.
    uv : (V, 2) texture coordinates, shares of width and height from the lower left corner.
    """

    image: NDArray[np.uint8]
    uv: Array


@dataclass(frozen=True, kw_only=True)
class MeshFormat:
    """A format of mesh files.

    Attributes
    ----------
    normals, colors, texture : whether it supports them.
    write : called with path, mesh and texture.
    """

    normals: bool
    colors: bool
    texture: bool
    write: Callable[[Path, Mesh, Texture | None], tuple[Path, ...]]


def write_mesh_file(path: Path, mesh: Mesh, texture: Texture | None = None) -> tuple[Path, ...]:
    """Write a mesh in the format of the file's suffix.

    Parameters
    ----------
    path : ends in one of :data:`MESH_FORMATS`.
    texture : for formats that support one; its ``uv`` are of the mesh's vertices.

    Returns
    -------
    The written files, ``path`` first; an OBJ has an MTL and a texture file.

    Raises
    ------
    OptionError
        The suffix is unknown, or the format has no texture.
    DataError
        A file cannot be written.
    """
    kind = mesh_format_of(path)
    if texture is not None and not kind.texture:
        holding = ", ".join(suffix for suffix, k in MESH_FORMATS.items() if k.texture)
        raise OptionError(f"{path}: this format holds no texture; name a file of {holding}.")
    return kind.write(path, mesh, texture)


def mesh_format_of(path: Path) -> MeshFormat:
    """The format of a file's suffix.

    Raises
    ------
    OptionError
        The suffix is unknown.
    """
    kind = MESH_FORMATS.get(path.suffix.lower())
    if kind is None:
        known = ", ".join(MESH_FORMATS)
        raise OptionError(f"{path}: is no name of a mesh, which ends in one of {known}.")
    return kind


def linear_of_display(colors: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Linear components 0 to 1 of colours encoded for display (sRGB)."""
    share = np.asarray(colors, np.float64) / 255
    curved = ((share + 0.055) / 1.055) ** 2.4
    return np.where(share <= 0.04045, share / 12.92, curved).astype(np.float32)


def _write_ply(path: Path, mesh: Mesh, texture: Texture | None) -> tuple[Path, ...]:
    write_mesh(path, mesh)
    return (path,)


def _write_stl(path: Path, mesh: Mesh, texture: Texture | None) -> tuple[Path, ...]:
    """Binary STL: triangles alone, each with its normal."""
    corners = mesh.vertices[mesh.triangles]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(across, axis=1, keepdims=True)
    record = np.zeros(
        len(corners), [("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("x", "<u2")]
    )
    record["normal"] = across / np.maximum(length, 1e-300)
    record["corners"] = corners
    header = f"binary STL of polmvs {__version__}".encode().ljust(80, b" ")
    write_bytes(path, header + struct.pack("<I", len(corners)) + record.tobytes())
    return (path,)


def _write_obj(path: Path, mesh: Mesh, texture: Texture | None) -> tuple[Path, ...]:
    """OBJ with normals; colours after the places, as most programs read them, or a texture."""
    lines = io.StringIO()
    lines.write(f"# polmvs {__version__}\n")
    others: tuple[Path, ...] = ()
    if texture is not None:
        material, picture = path.with_suffix(".mtl"), path.with_suffix(".png")
        # An MTL names the texture by its bare name, which ends at a blank for some readers.
        if any(letter.isspace() for letter in path.name):
            raise OptionError(f"{path}: an OBJ with a texture needs a name without blanks.")
        write_bytes(picture, encode_png(texture.image[..., ::-1]))
        words = f"newmtl surface\nKa 1 1 1\nKd 1 1 1\nKs 0 0 0\nillum 1\nmap_Kd {picture.name}\n"
        write_bytes(material, words.encode())
        lines.write(f"mtllib {material.name}\nusemtl surface\n")
        others = (material, picture)
    if texture is None and mesh.colors is not None:
        rows = np.column_stack([mesh.vertices, mesh.colors / 255])
        np.savetxt(lines, rows, fmt="v %.9g %.9g %.9g %.4f %.4f %.4f")
    else:
        np.savetxt(lines, mesh.vertices, fmt="v %.9g %.9g %.9g")
    if texture is not None:
        np.savetxt(lines, texture.uv, fmt="vt %.6f %.6f")
    np.savetxt(lines, mesh.normals, fmt="vn %.5f %.5f %.5f")
    corner = "{0}/{0}/{0}" if texture is not None else "{0}//{0}"
    pattern = "f " + " ".join(corner.format("%d") for _ in range(3))
    times = 3 if texture is not None else 2
    np.savetxt(lines, np.repeat(mesh.triangles + 1, times, axis=1), fmt=pattern)
    write_bytes(path, lines.getvalue().encode())
    return (path, *others)


class _Buffer:
    """Binary data of a glTF with its buffer views and accessors."""

    def __init__(self) -> None:
        self.data = bytearray()
        self.views: list[dict[str, Any]] = []
        self.accessors: list[dict[str, Any]] = []

    def view(self, content: bytes, **more: Any) -> int:
        """Add bytes; the number of their view."""
        place = {"buffer": 0, "byteOffset": len(self.data), "byteLength": len(content)}
        self.views.append({**place, **more})
        self.data += content + b"\0" * (-len(content) % 4)
        return len(self.views) - 1

    def accessor(self, array: NDArray[Any], target: int = ARRAY_BUFFER, **more: Any) -> int:
        """Add float32 or uint32 numbers (N,) or vectors (N, K); the number of their accessor."""
        view = self.view(np.ascontiguousarray(array).tobytes(), target=target)
        kind = UNSIGNED_INT if array.dtype == np.uint32 else FLOAT
        shape = "SCALAR" if array.ndim == 1 else f"VEC{array.shape[1]}"
        found = {"bufferView": view, "componentType": kind, "count": len(array), "type": shape}
        self.accessors.append({**found, **more})
        return len(self.accessors) - 1


def _write_glb(path: Path, mesh: Mesh, texture: Texture | None) -> tuple[Path, ...]:
    """Binary glTF 2.0; colours of vertices are linear there, those of a texture are not."""
    buffer = _Buffer()
    places = mesh.vertices.astype(np.float32)
    span: Mapping[str, Any] = {}
    if len(places):
        span = {"min": places.min(axis=0).tolist(), "max": places.max(axis=0).tolist()}
    length = np.linalg.norm(mesh.normals, axis=1, keepdims=True)
    upright = np.where(length > 0, mesh.normals / np.maximum(length, 1e-300), [0.0, 0.0, 1.0])
    attributes = {
        "POSITION": buffer.accessor(places, **span),
        "NORMAL": buffer.accessor(upright.astype(np.float32)),
    }
    surface: dict[str, Any] = {"metallicFactor": 0.0, "roughnessFactor": ROUGHNESS}
    content: dict[str, Any] = {}
    if texture is not None:
        below = np.column_stack([texture.uv[:, 0], 1 - texture.uv[:, 1]]).astype(np.float32)
        attributes["TEXCOORD_0"] = buffer.accessor(below)
        surface["baseColorTexture"] = {"index": 0}
        image = buffer.view(encode_png(texture.image[..., ::-1]))
        content = {
            "images": [{"bufferView": image, "mimeType": "image/png"}],
            "samplers": [
                {"magFilter": LINEAR, "minFilter": MIPMAPPED, "wrapS": CLAMPED, "wrapT": CLAMPED}
            ],
            "textures": [{"source": 0, "sampler": 0}],
        }
    elif mesh.colors is not None:
        attributes["COLOR_0"] = buffer.accessor(linear_of_display(mesh.colors))
    corners = buffer.accessor(mesh.triangles.astype(np.uint32).ravel(), ELEMENT_ARRAY_BUFFER)
    primitive = {"attributes": attributes, "indices": corners, "material": 0}
    content |= {
        "asset": {"version": "2.0", "generator": f"polmvs {__version__}"},
        "scene": 0,
        "scenes": [{"nodes": [0]}],
        "nodes": [{"mesh": 0, "name": path.stem}],
        "meshes": [{"primitives": [primitive], "name": path.stem}],
        "materials": [{"name": "surface", "pbrMetallicRoughness": surface, "doubleSided": True}],
        "accessors": buffer.accessors,
        "bufferViews": buffer.views,
        "buffers": [{"byteLength": len(buffer.data)}],
    }
    words = json.dumps(content, separators=(",", ":")).encode()
    words += b" " * (-len(words) % 4)
    total = 12 + 8 + len(words) + 8 + len(buffer.data)
    if total >= 1 << 32:
        raise DataError(path, "would exceed the 4 GB that GLB holds. Write PLY.")
    header = struct.pack("<5I", GLB_MAGIC, GLB_VERSION, total, len(words), GLB_JSON)
    binary = struct.pack("<II", len(buffer.data), GLB_BIN)
    write_bytes(path, header + words + binary + buffer.data)
    return (path,)


MESH_FORMATS: Mapping[str, MeshFormat] = {
    ".ply": MeshFormat(normals=True, colors=True, texture=False, write=_write_ply),
    ".obj": MeshFormat(normals=True, colors=True, texture=True, write=_write_obj),
    ".stl": MeshFormat(normals=False, colors=False, texture=False, write=_write_stl),
    ".glb": MeshFormat(normals=True, colors=True, texture=True, write=_write_glb),
}
