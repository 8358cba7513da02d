"""COLMAP's models, maps and workspaces: the only importer of pycolmap."""
