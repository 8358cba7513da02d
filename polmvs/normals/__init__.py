"""Rows, the robust estimator, normals of tracks, and the kind of light."""
