"""Physically based captures: any mesh, material, light, path and camera, rendered by Mitsuba."""
