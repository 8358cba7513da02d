"""From normals to shape."""
