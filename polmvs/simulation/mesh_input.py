"""The object's mesh: a built-in shape or a file, in metres, standing on the plane z = 0."""

from __future__ import annotations

from polmvs.errors import DataError
from polmvs.io.clouds import Mesh
from polmvs.simulation.options import ObjectOptions
from polmvs.synthetic.shapes import named_shape, shape_names

DEFAULT_SIZE = 0.2


def object_mesh(mesh: str, options: ObjectOptions) -> Mesh:
    """The object, metres, on the plane z = 0 over the origin."""
    if mesh in shape_names():
        shape = named_shape(mesh)
        return Mesh(shape.vertices * (options.size or DEFAULT_SIZE), shape.normals, shape.triangles)
    raise DataError(mesh, f"no such file, nor a shape; shapes are {', '.join(shape_names())}.")
