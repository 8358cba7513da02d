"""First surface of an open vessel: the visual hull with its inside carved.

Silhouettes close the opening of a vessel with a cap. Over a bowl it lies so far from the inside
that the refinement does not get there. So the likelihood of the phases decides before it: the
object is solid (the hull, or the hull cut at its rim, as a plate or a box), or a vessel with a wall
of one thickness and a bottom of another. The refinement then moves the inside like any surface.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
from numpy.typing import NDArray

from polmvs.geometry import points_on_rays
from polmvs.surface.cavities import Cavity, find_vessel
from polmvs.surface.ground import SupportingPlane
from polmvs.surface.mesh_geometry import DistanceGrid, RayScene, SignedDistance
from polmvs.surface.solver import (
    REMESHING_LOSS,
    Fit,
    certain_rays,
    covered_share,
)
from polmvs.surface.surface_quality import view_information
from polmvs.surface.surface_view import SurfaceView
from polmvs.surface.visual_hull import VisualHull

Array = NDArray[np.float64]

# Of a silhouette's rays, whose height is that of the rim: some pass through what it holds wrongly.
# Measured on four bowls: rims 50 to 92 mm high to 0.7 mm; the highest ray of a view errs by up to
# 31 mm.
TOP_SHARE = 0.999


def opened_hull(
    hull: VisualHull, plane: SupportingPlane | None, fit: Fit
) -> tuple[VisualHull, SignedDistance | None]:
    """The hull, with its inside carved if the object is a shallow vessel that stands on a plane.

    Parameters
    ----------
    hull : of the silhouettes.
    plane : on which the object stands, if it is known. The rim is parallel to it.
    fit : of the first surface.

    Returns
    -------
    The hull, and the signed distance to a vessel's walls for :func:`polmvs.surface.solver.refine`;
    None of a solid.
    """
    if plane is None or not len(hull.mesh.faces):
        return hull, None
    scene = RayScene(hull.mesh)
    height = rim_height(scene, fit.views, plane)
    if not np.isfinite(height):
        return hull, None
    fit = fit.at_width(fit.tol.levels[0].width_px)
    grid = DistanceGrid.of(scene, hull.step)

    def carved(*free: SignedDistance) -> RayScene:
        return RayScene(grid.mesh(free=free, smoothing=0))

    def information(scene: RayScene) -> Array:
        """Of the phases of each view, nats."""
        return view_information(scene.mesh, fit)

    closed, top = carved(), replace(plane, offset=plane.offset + height)
    solid = cache(lambda: max(information(closed), information(carved(top.height)), key=np.sum))
    least = covered_share(closed, fit.views) - REMESHING_LOSS

    def gain(cavity: Cavity) -> Array:
        vessel = carved(cavity.values)
        # Where nothing is left, phases contradict nothing: it must still cover the silhouettes.
        if covered_share(vessel, fit.views) < least:
            return np.full(len(fit.views), -np.inf)
        return information(vessel) - solid()

    # Outlines on the ground are uncertain, so the hull reaches below the plane; the floor does not.
    above = carved(lambda points: -plane.height(points))
    known = np.zeros((0, 3)) if fit.known is None else fit.known.points
    cavity = find_vessel(above, top, fit.gsd, gain, known)
    if cavity is None:
        return hull, None
    vessel = hull.carved([cavity.values])
    return vessel, vessel.distances


def rim_height(scene: RayScene, views: Sequence[SurfaceView], plane: SupportingPlane) -> float:
    """The least height above a plane that an object with these silhouettes has.

    A ray within a silhouette meets the object between the ends of its way through the hull, so the
    object is as high as the lower end. The highest ones of a view are those of the rim, if a vessel
    is open; the median over the views ignores wrong silhouettes. NaN without silhouettes.

    Parameters
    ----------
    scene : of the hull.
    views : their silhouettes.
    plane : on which the object stands.
    """
    found = []
    for view in views:
        rays = certain_rays(view)
        entry = scene.cast(view.center, rays).distance
        rays, entry = rays[np.isfinite(entry)], entry[np.isfinite(entry)]
        if not len(rays):
            continue
        # The last exit is the first hit from behind all.
        far = 2 * float(entry.max())
        behind = scene.cast(view.center + far * rays, -rays).distance
        last = np.where(np.isfinite(behind), far - behind, entry)
        heights = [plane.height(points_on_rays(view.center, rays, end)) for end in (entry, last)]
        found.append(float(np.quantile(np.minimum(*heights), TOP_SHARE)))
    return float(np.median(found)) if found else float("nan")
