"""Hollows that see only themselves: the inside of a mug.

A vessel's mouth is dark: light that comes out of it has been reflected several times, and its
phase says nothing of a normal. Silhouettes close the mouth with a cap, which no view's phase
supports, in the middle of a flat ring that the phases do support: the rim. The rim's inner line,
seen at one place by several views, is the mouth's border. How thick the wall is shows at the rim;
where it is of one thickness all around, a wall of that thickness is presumed to go on below, and
the inside follows the outside. That is a presumption, not a measurement: each hollow carries its
thickness and how much it varies, and points on its walls should be labelled accordingly. Where
the rim's width varies nothing is presumed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from polmvs.camera import sample_image
from polmvs.config import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.surface.offsets import (
    NO_FACE,
    Face,
    FaceGrid,
    FaceScene,
    OffsetTolerances,
    SignedDistance,
    cells_beside,
    face_evidence,
    face_scene,
    median_loss,
    row_losses,
    snapped_border,
)

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class HollowTolerances:
    """Numbers of the search for hollows; lengths in footprints of a pixel.

    Attributes
    ----------
    min_cosine : between a face's normal and the direction to a view that is asked. Guess.
    min_views : that see a place which is doubted.
    min_phase_share : of these views that must have a phase there, or it is doubted. Guess.
    min_radius : of a cap, as a disc. Guess: as for the smallest face.
    flat_cosine : of the angle between the normals of a cap, or of a rim, and their mean, on
        average. Guess: a membrane sags.
    rim_width : of the ring about a cap that must be supported. Guess.
    min_rim_sectors : of eight about the cap in which there is a rim; one may be hidden.
    rim_deviation : of the rim from a plane, root mean square. Guess.
    max_brightness : of the mouth over the rim, median over the views. A second reflection on
        glass of ior 1.5 leaves a tenth to a half of the light of the first at 45 to 75 deg. Guess.
    snap_cells : by which the border of the cap may be off the mouth's. Guess.
    wall_depth : under the rim at which the wall's thickness is measured: below its rounding.
    thickness_spread : robust deviation of the wall's thickness around the rim, as a share of it;
        one footprint is always allowed. Guess.
    growth : of a hollow's half width per depth. A bottle's shoulders are not presumed. Guess.
    above : height of a cap's bulge over the rim that is cut off. Guess.
    max_cells : of the grid of a hollow.
    """

    min_cosine: float = 0.3
    min_views: int = 3
    min_phase_share: float = 0.5
    min_radius: float = 8.0
    flat_cosine: float = 0.8
    rim_width: float = 6.0
    min_rim_sectors: int = 7
    rim_deviation: float = 1.5
    max_brightness: float = 0.3
    snap_cells: float = 8.0
    wall_depth: float = 3.0
    thickness_spread: float = 0.15
    growth: float = 0.5
    above: float = 12.0
    max_cells: int = 6_000_000


@dataclass(frozen=True)
class Hollow:
    """Free space inside of a vessel.

    Attributes
    ----------
    rim : plane of the mouth; its members are faces of the surface on the rim.
    cap : (M,) int64, faces of the surface that close the mouth; no view supports them.
    grid : across the mouth.
    thickness : of the wall, world units.
    thickness_sigma : its robust deviation around the rim, world units.
    field : (D, H, W) float32, signed distance to the hollow's walls in layers of ``grid.step``
        from ``first_layer`` downwards, positive in the hollow.
    first_layer : depth of the first layer below the rim, in steps (negative: above).
    """

    rim: Face
    cap: NDArray[np.int64]
    grid: FaceGrid
    thickness: float
    thickness_sigma: float
    field: Image
    first_layer: int

    def values(self, points: Floats) -> Array:
        """Signed distance ``(N,)`` of points, positive in the hollow's free space."""
        points = np.asarray(points, np.float64)
        depth = -self.rim.height(points) / self.grid.step - self.first_layer
        cells = self.grid.cells(points)
        place = np.stack([depth, cells[..., 0], cells[..., 1]])
        outside = -float(max(self.field.shape)) * self.grid.step
        found = ndimage.map_coordinates(self.field, place, order=1, mode="constant", cval=outside)
        return np.asarray(found, np.float64)


@dataclass(frozen=True)
class SurfaceFaces:
    """Small faces of a closed surface, as the views see it.

    Attributes
    ----------
    centers, normals : (F, 3), world; unit normals outwards.
    areas : (F,).
    seen : (K, F) bool, which views have the face in their image, facing them and not hidden.
    signed_distance : of points ``(N, 3)`` to the surface, negative inside.
    footprint : length that a pixel covers at the surface, world units.
    """

    centers: Array
    normals: Array
    areas: Array
    seen: Mask
    signed_distance: SignedDistance
    footprint: float


def unsupported_faces(
    surface: SurfaceFaces,
    scene: FaceScene,
    tolerances: HollowTolerances | None = None,
    offset_tolerances: OffsetTolerances | None = None,
) -> tuple[Mask, Mask]:
    """Faces that their views' phases support, and those they do not, each ``(F,)``.

    Faces that fewer than ``min_views`` see well are neither.
    """
    tol, face_tol = tolerances or HollowTolerances(), offset_tolerances or OffsetTolerances()
    losses, cosines = row_losses(scene.rows(surface.centers), surface.normals.T, face_tol)
    judged = surface.seen & (cosines > tol.min_cosine)
    has_phase = judged & np.isfinite(losses)
    num = judged.sum(axis=0)
    cost = median_loss(np.where(has_phase, losses, np.nan)[:, None])[0]
    enough = num >= tol.min_views
    supported = has_phase.sum(axis=0) >= tol.min_phase_share * num
    supported &= cost < face_tol.max_cost
    return enough & supported, enough & ~supported


def find_hollows(
    surface: SurfaceFaces,
    maps: Sequence[PhaseMap],
    angle_model: AngleModel,
    *,
    tilt_aware: bool = True,
    tolerances: HollowTolerances | None = None,
    offset_tolerances: OffsetTolerances | None = None,
) -> tuple[Hollow, ...]:
    """Mouths that a surface closes with a cap, and the hollows presumed behind them.

    Parameters
    ----------
    surface : refined, so that its outside and the rims are right to a footprint.
    maps : phase maps of the views, as ``surface.seen`` counts them.
    angle_model, tilt_aware : of the rows, as in :func:`polmvs.normals.rows.gather_rows`.
    tolerances, offset_tolerances : numbers of the search, and of the borders.
    """
    tol, face_tol = tolerances or HollowTolerances(), offset_tolerances or OffsetTolerances()
    if surface.seen.shape != (len(maps), len(surface.centers)):
        raise ValueError(f"{surface.seen.shape=} but expected {(len(maps), len(surface.centers))}.")
    scene = face_scene(maps, angle_model, tilt_aware=tilt_aware, tolerances=face_tol)
    supported, doubted = unsupported_faces(surface, scene, tol, face_tol)
    found = []
    for cap in _caps(surface, doubted, tol):
        rim = _rim(surface, cap, supported, tol)
        if rim is None:
            continue
        grid, mouth = _mouth(surface, cap, rim, scene, tol, face_tol)
        if not mouth.any() or not _is_dark(mouth, grid.points(rim), maps, tol):
            continue
        hollow = _hollow(surface, cap, rim, grid, mouth, tol)
        if hollow is not None:
            found.append(hollow)
    return tuple(found)


def _caps(surface: SurfaceFaces, doubted: Mask, tol: HollowTolerances) -> list[NDArray[np.int64]]:
    """Connected, about flat pieces of doubted faces that are large enough for a mouth."""
    index = np.flatnonzero(doubted)
    if not len(index):
        return []
    reach = max(2 * float(np.sqrt(np.median(surface.areas[index]))), surface.footprint)
    pairs = cKDTree(surface.centers[index]).query_pairs(reach, output_type="ndarray")
    links = sparse.coo_array((np.ones(len(pairs)), tuple(pairs.T)), shape=(len(index),) * 2)
    labels = connected_components(links, directed=False)[1]
    area = np.bincount(labels, surface.areas[index])
    least = np.pi * (tol.min_radius * surface.footprint) ** 2
    caps = [index[labels == label] for label in np.flatnonzero(area > least)]
    return [cap for cap in caps if _flatness(surface, cap) > tol.flat_cosine]


def _mean_normal(surface: SurfaceFaces, faces: NDArray[np.int64]) -> Array:
    """Mean of normals, weighted by area; its length tells how flat they lie."""
    weight = surface.areas[faces] / surface.areas[faces].sum()
    return np.asarray(weight @ surface.normals[faces])


def _flatness(surface: SurfaceFaces, faces: NDArray[np.int64]) -> float:
    return float(np.linalg.norm(_mean_normal(surface, faces)))


def _rim(
    surface: SurfaceFaces, cap: NDArray[np.int64], supported: Mask, tol: HollowTolerances
) -> Face | None:
    """Plane of the supported faces about a cap, if they surround it and lie in one."""
    axis = _mean_normal(surface, cap)
    axis /= np.linalg.norm(axis)
    candidates = np.flatnonzero(supported & (surface.normals @ axis > tol.flat_cosine))
    if not len(candidates):
        return None
    distance = cKDTree(surface.centers[cap]).query(surface.centers[candidates])[0]
    ring = candidates[distance < tol.rim_width * surface.footprint]
    limit = tol.rim_deviation * surface.footprint
    height = np.zeros(len(ring))
    for _ in range(3):
        ring = (
            ring[np.abs(height) <= max(2 * limit, 2 * float(np.median(np.abs(height))))]
            if (len(ring))
            else ring
        )
        if len(ring) < tol.min_rim_sectors:
            return None
        center = surface.centers[ring].mean(axis=0)
        normal = np.linalg.svd(surface.centers[ring] - center, full_matrices=False)[2][2]
        normal *= np.sign(normal @ axis)
        height = (surface.centers[ring] - center) @ normal
    if (
        np.sqrt(np.mean(height**2)) > limit
        or normal @ _mean_normal(surface, ring) < tol.flat_cosine
    ):
        return None
    tangents = np.linalg.svd(normal[None])[2][1:]
    across = (surface.centers[ring] - surface.centers[cap].mean(axis=0)) @ tangents.T
    sector = np.floor((np.arctan2(across[:, 1], across[:, 0]) / np.pi + 1) * 4).astype(np.int64) % 8
    if len(np.unique(sector)) < tol.min_rim_sectors:
        return None
    return Face(normal, float(center @ normal), ring)


def _mouth(
    surface: SurfaceFaces,
    cap: NDArray[np.int64],
    rim: Face,
    scene: FaceScene,
    tol: HollowTolerances,
    face_tol: OffsetTolerances,
) -> tuple[FaceGrid, Mask]:
    """A grid across the mouth, and the cells of the mouth: the cap's, up to the rim's line."""
    tangents = np.linalg.svd(rim.normal[None])[2][1:]
    first, second = tangents[0], np.cross(rim.normal, tangents[0])
    center = surface.centers[cap].mean(axis=0)
    center = center - rim.height(center) * rim.normal
    # Below its mouth a vessel may be wider: twice as wide at most.
    reach = 2 * float(np.linalg.norm(surface.centers[rim.members] - center, axis=1).max())
    half = int(np.ceil(reach / surface.footprint))
    step = surface.footprint
    origin = center - half * step * (first + second)
    grid = FaceGrid(origin, first, second, rim.normal, step, (2 * half + 1, 2 * half + 1))

    places = grid.cells(np.concatenate([surface.centers[cap], surface.centers[rim.members]]))
    lattice = np.indices(grid.shape).reshape(2, -1).T
    distance, nearest = cKDTree(places).query(lattice)
    spacing = 2 * np.sqrt(np.median(surface.areas[cap])) / step
    mouth = ((nearest < len(cap)) & (distance < spacing + 1)).reshape(grid.shape)
    mouth = np.asarray(ndimage.binary_fill_holes(mouth), np.bool_)
    pieces, num = ndimage.label(mouth)
    if num > 1:
        mouth = pieces == 1 + np.argmax(np.bincount(pieces.ravel())[1:])
    nothing_near = np.zeros(grid.shape, np.bool_)
    evidence = face_evidence(grid.points(rim), rim, scene, nothing_near, None, face_tol)
    labels = np.where(mouth, 0, NO_FACE)
    snapped = snapped_border(
        labels, 0, evidence.jump.astype(np.float64), face_tol, band_cells=tol.snap_cells
    )
    return grid, np.asarray(snapped == 0)


def _is_dark(mouth: Mask, places: Array, maps: Sequence[PhaseMap], tol: HollowTolerances) -> bool:
    """Whether the mouth is much darker than its rim in most views that show both."""
    inner = ndimage.binary_erosion(mouth, iterations=3)
    width = max(round(0.5 * tol.rim_width), 1)
    ring = ndimage.binary_dilation(mouth, iterations=2 + width)
    ring &= ~ndimage.binary_dilation(mouth, iterations=2)
    ratios = []
    for phase_map in maps:
        medians = []
        for cells in (inner, ring):
            xy = phase_map.view.camera.project(phase_map.view.cam_from_world * places[cells])
            size = np.array([phase_map.view.camera.width, phase_map.view.camera.height])
            with np.errstate(invalid="ignore"):
                shown = ((xy >= 1) & (xy <= size - 1)).all(axis=-1)
            if shown.mean() > 0.5:
                intensity = np.asarray(phase_map.intensity, np.float32)
                medians.append(float(np.median(sample_image(intensity, xy[shown]))))
        if len(medians) == 2:
            ratios.append(medians[0] / max(medians[1], 1e-9))
    return len(ratios) >= tol.min_views and float(np.median(ratios)) < tol.max_brightness


def _hollow(
    surface: SurfaceFaces,
    cap: NDArray[np.int64],
    rim: Face,
    grid: FaceGrid,
    mouth: Mask,
    tol: HollowTolerances,
) -> Hollow | None:
    """The hollow under a mouth, its wall as thick as at the rim; None where that varies."""
    step = grid.step
    places = grid.points(rim)
    border = mouth & ~ndimage.binary_erosion(mouth)

    def outside_of(layer: int) -> tuple[Array, bool]:
        """Distance (H, W) in cells to the outer wall, negative inside, and whether any is."""
        points = (places - layer * step * rim.normal).reshape(-1, 3)
        inside = np.asarray(surface.signed_distance(points) < 0).reshape(grid.shape)
        return cells_beside(inside), bool(inside.any())

    wall = -outside_of(round(tol.wall_depth))[0][border] - 0.5
    thickness = float(np.median(wall))
    sigma = 1.4826 * float(np.median(np.abs(wall - thickness)))
    if thickness <= 1 or sigma > max(tol.thickness_spread * thickness, 1.0):
        return None
    free = -cells_beside(mouth)
    layers = [free]
    most = tol.max_cells // mouth.size
    while len(layers) < most:
        away, any_inside = outside_of(len(layers))
        if not any_inside:
            break
        # At the rim its line is known; below it the wall's thickness takes over.
        known = min(len(layers) / tol.wall_depth, 1.0)
        presumed = known * (-away - thickness) + (1 - known) * layers[0]
        free = np.minimum(presumed, layers[-1] + tol.growth)
        pieces = ndimage.label(free > 0)[0]
        linked = np.unique(pieces[(layers[-1] > 0) & (pieces > 0)])
        free = np.where((pieces > 0) & ~np.isin(pieces, linked), -0.5, free)
        if not (free > 0).any():
            break
        layers.append(free)
    depth = np.arange(len(layers), dtype=np.float64)
    # The bottom is as thick as the wall, at least.
    floor = len(layers) - thickness - depth
    if floor[0] <= tol.min_radius:
        return None
    above = round(tol.above)
    field = np.minimum(np.stack(layers), floor[:, None, None])
    field = np.concatenate([np.repeat(field[:1], above, axis=0), field])
    field = ndimage.gaussian_filter(field, (1.0, 1.0, 1.0), mode="nearest") * step
    return Hollow(rim, cap, grid, thickness * step, sigma * step, field.astype(np.float32), -above)
