"""Colours of a surface from the views that see each point best, without highlights.

Each view gives the unpolarized part of its light, which lacks most of the specular reflection. The
colour is the weighted median of the views that see the point best, which removes highlights that
only some of them see.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from polmvs.camera import in_image, sample_image
from polmvs.geometry import dots, lengths
from polmvs.io.mesh_files import Texture
from polmvs.scene import View
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh

Array = NDArray[np.float64]
Floats = NDArray[np.floating]

DISPLAY_GAMMA = 2.2


@dataclass(frozen=True, kw_only=True)
class ColoringTolerances:
    """Tolerances of colours and textures.

    Attributes
    ----------
    num_views : largest number of views for a point's colour: those that see it best. Guess.
    min_cosine : between normal and ray; more oblique views blur. Guess: 75 degrees.
    depth_share : share of the distance within which a ray's hit is the point itself. Guess.
    gutter_px : width of the background about the charts of a texture that is painted, for filters.
    fill : share of a texture that its charts cover after packing. Measured: xatlas on the meshes of
        the shared captures, 0.5 to 0.7.
    max_size_px : of a texture.
    """

    num_views: int = 8
    min_cosine: float = 0.26
    depth_share: float = 0.005
    gutter_px: int = 8
    fill: float = 0.5
    max_size_px: int = 8192


TOL = ColoringTolerances()


def surface_colors(
    points: Array,
    normals: Array,
    views: Sequence[View],
    load: Callable[[View], NDArray[np.float32]],
    scene: RayScene,
    *,
    white: float,
) -> NDArray[np.uint8]:
    """Colours of points on a surface, encoded for display.

    Parameters
    ----------
    points, normals : (N, 3) world, unit normals outwards.
    views : views that may see them.
    load : gives a view's linear intensities (H, W) or (H, W, 3), NaN where unknown.
    scene : the surface, for occlusion.
    white : intensity of white.

    Returns
    -------
    (N, 3) red, green, blue. A point that no view sees gets the colour of the nearest seen one, or
    mid grey if there is none.
    """
    num = len(points)
    weights = np.zeros((num, TOL.num_views), np.float32)
    values = np.zeros((num, TOL.num_views, 3), np.float32)
    for view in views:
        weight, value = _seen_by(view, points, normals, load(view), scene)
        slot = weights.argmin(axis=1)
        better = np.flatnonzero(weight > weights[np.arange(num), slot])
        weights[better, slot[better]] = weight[better]
        values[better, slot[better]] = value[better]
    known = weights.max(axis=1, initial=0) > 0
    linear = np.full((num, 3), 0.2 * white)
    linear[known] = _weighted_medians(values[known], weights[known])
    if known.any() and not known.all():
        _, nearest = cKDTree(points[known]).query(points[~known])
        linear[~known] = linear[known][nearest]
    share = np.clip(linear / white, 0, 1) ** (1 / DISPLAY_GAMMA)
    return np.asarray(np.rint(255 * share), np.uint8)


def _seen_by(
    view: View,
    points: Array,
    normals: Array,
    image: NDArray[np.float32],
    scene: RayScene,
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """How well a view sees points (N,), 0 if not at all, and their colours in it (N, 3)."""
    weight = np.zeros(len(points), np.float32)
    value = np.zeros((len(points), 3), np.float32)
    towards = points - view.center_in_world
    distance = lengths(towards)
    rays = towards / np.maximum(distance, 1e-300)[:, None]
    cosine = -dots(rays, normals)
    chosen = np.flatnonzero(cosine > TOL.min_cosine)
    xy = view.project(points[chosen])
    inside = np.isfinite(xy).all(axis=-1) & in_image(view.camera, np.nan_to_num(xy, nan=-1))
    chosen, xy = chosen[inside], xy[inside]
    hits = scene.cast(view.center_in_world, rays[chosen])
    free = hits.distance > (1 - TOL.depth_share) * distance[chosen]
    chosen, xy = chosen[free], xy[free]
    seen = sample_image(image, xy)
    seen = np.repeat(seen[:, None], 3, axis=1) if seen.ndim == 1 else seen
    good = np.isfinite(seen).all(axis=-1)
    chosen = chosen[good]
    value[chosen] = seen[good]
    scale = view.camera.mean_focal_px / distance[chosen]
    weight[chosen] = cosine[chosen] * np.square(scale) * cosine[chosen]
    return weight, value


def _weighted_medians(values: NDArray[np.float32], weights: NDArray[np.float32]) -> Array:
    """Medians (N, C) of (N, K, C) values, weighted by (N, K)."""
    order = np.argsort(values, axis=1)
    ordered = np.take_along_axis(values, order, axis=1)
    spread = np.take_along_axis(np.broadcast_to(weights[..., None], values.shape), order, axis=1)
    total = np.cumsum(spread, axis=1, dtype=np.float64)
    middle = (total < 0.5 * total[:, -1:]).sum(axis=1)
    return np.asarray(np.take_along_axis(ordered, middle[:, None], axis=1)[:, 0], np.float64)


def texture_size(mesh: TriangleMesh, texel: float) -> int:
    """Sides, px, of a square texture whose texels have a size on the surface; a power of two."""
    area = float(mesh.face_areas.sum())
    side = np.sqrt(area / TOL.fill) / max(texel, 1e-300)
    whole = 2 ** int(np.ceil(np.log2(max(side, 64))))
    return int(min(whole, TOL.max_size_px))


def paint_texture(
    mesh: TriangleMesh,
    uv: Array,
    colors_of: Callable[[Array, Array], NDArray[np.uint8]],
    size_px: int,
) -> Texture:
    """A square texture of a mesh whose vertices have texture coordinates.

    Parameters
    ----------
    mesh : with a vertex for each side of a seam.
    uv : (V, 2), texture coordinates, shares of width and height from the lower left.
    colors_of : gives (N, 3) colours of points and normals (N, 3).
    size_px : side of the texture.
    """
    # Rays on the mesh in texture coordinates give the face of each texel, and the point in it.
    flat = TriangleMesh(np.column_stack([uv, np.zeros(len(uv))]), mesh.faces)
    axis = (np.arange(size_px) + 0.5) / size_px
    u, v = np.meshgrid(axis, axis[::-1])
    above = np.column_stack([u.ravel(), v.ravel(), np.ones(size_px**2)])
    hits = RayScene(flat).cast(above, np.tile([0.0, 0.0, -1.0], (len(above), 1)))
    covered = hits.face >= 0
    face, place = hits.face[covered], hits.barycentric[covered]
    points = np.einsum("nk,nkd->nd", place, mesh.corners[face])
    normals = np.einsum("nk,nkd->nd", place, mesh.vertex_normals[mesh.faces[face]])
    normals /= np.maximum(lengths(normals), 1e-300)[:, None]
    image = np.zeros((size_px**2, 3), np.uint8)
    image[covered] = colors_of(points, normals)
    return Texture(image=_with_gutter(image, covered, size_px, TOL.gutter_px), uv=uv)


def _with_gutter(
    image: NDArray[np.uint8], covered: NDArray[np.bool_], size_px: int, gutter_px: int
) -> NDArray[np.uint8]:
    """The image with the colours of its charts carried on about them, and their mean beyond."""
    inside = covered.reshape(size_px, size_px)
    grown = image.reshape(size_px, size_px, 3).copy()
    if not inside.any():
        return grown
    grown[~inside] = np.rint(image[covered].mean(axis=0)).astype(np.uint8)
    distance, (rows, cols) = ndimage.distance_transform_edt(~inside, return_indices=True)
    near = (distance > 0) & (distance <= gutter_px)
    grown[near] = grown[rows[near], cols[near]]
    return grown
