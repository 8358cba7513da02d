"""Analytic captures: exact phase, depth, normals and noise."""
