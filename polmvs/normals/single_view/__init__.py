"""Planes in one view."""
