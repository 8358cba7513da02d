"""Parts without seeds, placed by their outlines."""
