"""Vertex colours of a mesh as the albedo of a plastic, which needs the mean of its texture."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.simulation.renderer_import import Renderer

ATTRIBUTE = "vertex_color"  # of Mitsuba's mesh
NAME = "vertex_albedo"

_registered: set[str] = set()  # variants of the renderer


def vertex_albedo(renderer: Renderer, albedo: NDArray[np.float32]) -> dict[str, Any]:
    """Description of a texture for Mitsuba: a mesh's attribute, which has no mean of its own.

    Parameters
    ----------
    albedo : (V, 3) of the vertices. Their mean is that of slivers; from it a plastic also tells how
        often to sample its gloss.
    """
    if renderer.variant not in _registered:
        _register(renderer)
        _registered.add(renderer.variant)
    return {"type": NAME, "mean": float(albedo.mean())}


def _register(renderer: Renderer) -> None:
    """Make the texture known to the variant."""
    mi = renderer.mi

    class VertexAlbedo(mi.Texture):  # type: ignore[misc, name-defined]
        """As Mitsuba's ``mesh_attribute``, with a mean."""

        def __init__(self, properties: Any) -> None:
            mi.Texture.__init__(self, properties)
            self.attribute = mi.load_dict({"type": "mesh_attribute", "name": ATTRIBUTE})
            self.share = float(properties["mean"])

        def eval(self, si: Any, active: Any = True) -> Any:
            """Spectrum at a place; in slivers, whose coordinates are NaN, the mean."""
            dr, found = renderer.dr, self.attribute.eval(si, active)
            return dr.select(dr.isfinite(found), found, self.share)

        def mean(self) -> Any:
            """Mean of the mesh."""
            return mi.Float(self.share)

        def is_spatially_varying(self) -> bool:
            """It is."""
            return True

        def traverse(self, callback: Any) -> None:
            """There is nothing to optimise."""

        def to_string(self) -> str:
            """Name for Mitsuba's messages."""
            return NAME

    mi.register_texture(NAME, VertexAlbedo)
