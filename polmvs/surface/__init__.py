"""From phases and normals to surfaces."""
