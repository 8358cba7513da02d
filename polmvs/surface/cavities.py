"""Cavities that reflect only themselves, such as the inside of a mug.

The opening of a vessel is dark: light from inside has been reflected several times, and its phase
gives no normal. Silhouettes close the opening with a flat cap, which no phase supports. Around it,
in the same plane, is a ring that the phases do support: the top of the wall, the vessel's rim. Its
lines in the views coincide at the right offset of its plane; its inner line is the border of the
opening. The width of the rim is the thickness of the wall. If it is the same all around, a wall of
that thickness is inferred to continue below, so that the inside follows the outside. This is an
inference, not a measurement: each cavity has its thickness and the thickness's variation, and
points on its walls should be labelled as inferred. If the rim's width varies, nothing is inferred.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from polmvs.camera import in_frame, sample_image
from polmvs.fitting import robust_deviation
from polmvs.normals.estimator import solve_normals
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import KEYPOINT_SIGMA_PX, MIN_VIEWS, Seeds
from polmvs.surface.borders import cells_beside
from polmvs.surface.creases import CreaseTolerances
from polmvs.surface.mesh_geometry import MAX_CELLS
from polmvs.surface.observations import Looking
from polmvs.surface.offsets import (
    MAX_COST,
    NO_FACE,
    Face,
    FaceGrid,
    FaceScene,
    OffsetTolerances,
    border_of_steps,
    face_evidence,
    face_lines,
    find_faces,
    median_loss,
    row_losses,
    snapped_border,
)
from polmvs.surface.visual_hull import HullTolerances

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

SAME_PLANE_PX = HullTolerances.step_px  # GSDs, uncertainty of a rim's plane: a cell of the hull


@dataclass(frozen=True, kw_only=True)
class CavityTolerances:
    """Tolerances of the search for cavities; lengths in GSD.

    Attributes
    ----------
    max_planes : number of planes of the surface to check, largest first: a box has six. 4 and 16
        give the same.
    min_part : least share of rim, and of opening, in the faces of a plane. Guess.
    min_sectors : number of the eight sectors around faces without a phase that must have faces with
        one. Guess: one sector may be hidden.
    max_gap : half the length of a gap of the rim (a mark, a reflection). Guess. The cells that the
        closed rim encloses may be off the opening's border by as much. 2 and 8 give the same.
    max_brightness : of the opening over the rim, median over the views. A second reflection on
        glass of ior 1.5 leaves a tenth to a half of the light of the first at 45 to 75 deg. Guess.
    rounding : width of the rounded surface beside the rim. The wall's thickness is measured below
        it, the rim's brightness over half of it, and an opening must be wider. Three of the
        surface's cells; 3 and 12 give the same.
    thickness_spread : robust deviation of the wall's thickness around the rim, as a share of it;
        one GSD is always allowed. Guess.
    growth : of a cavity's half width per depth. A bottle's shoulders are not inferred. Guess.
    """

    max_planes: int = 8
    min_part: float = 0.15
    min_sectors: int = 7
    max_gap: float = 4.0
    max_brightness: float = 0.3
    rounding: float = 6.0
    thickness_spread: float = 0.15
    growth: float = 0.5


@dataclass(frozen=True)
class Cavity:
    """Free space inside a vessel.

    Attributes
    ----------
    rim : plane of the opening; its members are faces of the surface on the rim.
    grid : across the opening.
    thickness : of the wall, world units.
    thickness_sigma : its robust deviation around the rim, world units.
    field : (D, H, W) float32, signed distance to the cavity's walls in layers across the opening,
        positive in the cavity.
    layer_step : distance of the layers, world units.
    first_layer : depth of the first layer below the rim, in layers (negative: above).
    """

    rim: Face
    grid: FaceGrid
    thickness: float
    thickness_sigma: float
    field: Image
    layer_step: float
    first_layer: int

    def values(self, points: Floats) -> Array:
        """Signed distance ``(N,)`` of points, positive in the cavity's free space."""
        points = np.asarray(points, np.float64)
        depth = -self.rim.height(points) / self.layer_step - self.first_layer
        cells = self.grid.cells(points)
        place = np.stack([depth, cells[..., 0], cells[..., 1]])
        outside = -float(max(self.field.shape)) * self.grid.step
        found = ndimage.map_coordinates(self.field, place, order=1, mode="constant", cval=outside)
        return np.asarray(found, np.float64)


@dataclass(frozen=True)
class SurfaceFaces:
    """Small faces of a closed surface.

    Attributes
    ----------
    centers, normals : (F, 3), world; unit normals outwards.
    areas : (F,).
    inside_along : which points ``(D, N)`` lie inside, on rays from origins ``(N, 3)`` along one
        direction ``(3,)``, at ascending distances ``(D,)``.
    gsd : ground sampling distance at the surface, world units.
    """

    centers: Array
    normals: Array
    areas: Array
    inside_along: Callable[[Array, Array, Array], Mask]
    gsd: float


def find_cavities(
    surface: SurfaceFaces,
    scene: FaceScene,
    *,
    tolerances: CavityTolerances | None = None,
    offset_tolerances: OffsetTolerances | None = None,
    before: Sequence[Cavity] = (),
) -> tuple[Cavity, ...]:
    """Openings that a surface closes with a cap, and the cavities inferred behind them.

    Parameters
    ----------
    surface : the visual hull or better; its outside determines the cavity's walls.
    scene : the views.
    tolerances, offset_tolerances : of the search, and of the borders.
    before : cavities of an earlier state of the surface, whose openings are tried first: a cap that
        phases have bent is not planar.
    """
    tol, face_tol = tolerances or CavityTolerances(), offset_tolerances or OffsetTolerances()
    if not len(surface.centers) or len(scene.maps) < MIN_VIEWS:
        return ()
    found: list[Cavity] = []
    planes = [*(cavity.rim for cavity in before), *_flat_pieces(surface, tol, face_tol)]
    for plane in planes:
        rim = _rim(surface, _on_surface(plane, surface), scene, tol, face_tol)
        if rim is None or any(_is_same(rim, other.rim, surface) for other in found):
            continue
        grid = _grid_about(surface, rim, tol)
        rim = _in_focus(rim, grid, scene, surface.gsd, tol, face_tol)
        mouth = _mouth(rim, surface.centers[rim.members], grid, scene, tol, face_tol)
        inner = ndimage.binary_erosion(mouth, iterations=3)
        places = grid.points(rim)
        if not _is_dark(places[inner], places[_ring_about(mouth, tol)], scene.maps, tol):
            continue
        beside = border_of_steps(mouth, mouth, rim, grid, scene, face_tol)
        cavity = _cavity(surface, rim, grid, mouth, beside, tol)
        if cavity is not None:
            found.append(cavity)
    return tuple(found)


def _flat_pieces(
    surface: SurfaceFaces, tol: CavityTolerances, face_tol: OffsetTolerances
) -> tuple[Face, ...]:
    """The largest planes of a surface; their members are faces of a sample."""
    rng = np.random.default_rng(0)
    share = surface.areas / surface.areas.sum()
    num = min(face_tol.num_trials, len(share))
    chosen = np.sort(rng.choice(len(share), num, replace=False, p=share))
    sigma = np.full(num, KEYPOINT_SIGMA_PX * surface.gsd)
    seeds = Seeds(surface.centers[chosen], surface.normals[chosen], sigma)
    least = np.pi * (tol.rounding * surface.gsd) ** 2 / surface.areas.sum()
    search = replace(
        face_tol,
        min_points=max(int(least * num), 10),
        normal_deg=CreaseTolerances.crease_deg,
        min_normal_sigma_deg=CreaseTolerances.crease_deg,
    )
    return find_faces(seeds, search, max_faces=tol.max_planes)


def _on_surface(rim: Face, surface: SurfaceFaces) -> Face:
    """A rim's plane with the faces of a surface that lie in it."""
    near = np.abs(rim.height(surface.centers)) < SAME_PLANE_PX * surface.gsd
    near &= surface.normals @ rim.normal > np.cos(np.radians(CreaseTolerances.crease_deg))
    return replace(rim, members=np.flatnonzero(near))


def _rim(
    surface: SurfaceFaces,
    flat: Face,
    scene: FaceScene,
    tol: CavityTolerances,
    face_tol: OffsetTolerances,
) -> Face | None:
    """The plane turned to the normal that the phases of its faces have; None without an opening.

    At an opening in a rim, some faces are bright and have phases, and others are dark and have none
    or contradicting ones. Beside the rim, dark ones may agree with its normal.
    """
    rows = scene.rows(surface.centers[flat.members])
    facing = -np.einsum("ikn,i->kn", rows.rays, flat.normal) > Looking.min_cosine
    sigma = np.where(facing, rows.sigma, np.inf)
    start = np.repeat(flat.normal[:, None], len(flat.members), axis=1)
    estimate = solve_normals(rows.rows, rows.rays, sigma, initial_normals=start)
    turned = np.nan_to_num(estimate.normals) @ flat.normal
    agree = estimate.valid & (estimate.num_rows >= MIN_VIEWS)
    agree &= turned > np.cos(np.radians(CreaseTolerances.crease_deg))
    if agree.sum() < 10:
        return None
    normal = np.median(estimate.normals[agree], axis=0)
    normal /= np.linalg.norm(normal)
    losses = row_losses(rows, normal[:, None], face_tol)[0]
    losses = np.where(facing, losses, np.nan)
    has_phase = np.isfinite(losses).sum(axis=0) >= 0.5 * facing.sum(axis=0)
    places = surface.centers[flat.members]
    bright = _is_bright(places, scene.maps, tol)
    supported = bright & has_phase & (median_loss(losses[:, None])[0] < MAX_COST)
    share = float(supported.mean())
    if not tol.min_part <= share <= 1 - tol.min_part:
        return None
    tangents = np.linalg.svd(normal[None])[2][1:]
    x, y = tangents @ (places[supported] - np.median(places[~supported], axis=0)).T
    sectors = np.unique(np.floor((np.arctan2(y, x) / np.pi + 1) * 4).astype(np.int64) % 8)
    if len(sectors) < tol.min_sectors:
        return None
    if not _is_dark(places[~supported], places[supported], scene.maps, tol):
        return None
    offset = float(np.median(places[supported] @ normal))
    return Face(normal, offset, flat.members[supported])


def _is_same(rim: Face, other: Face, surface: SurfaceFaces) -> bool:
    """Whether two rims are of the same opening."""
    near = np.abs(other.height(surface.centers[rim.members])) < SAME_PLANE_PX * surface.gsd
    return bool(near.mean() > 0.5)


def _grid_about(surface: SurfaceFaces, rim: Face, tol: CavityTolerances) -> FaceGrid:
    """A grid across the rim that holds all of the surface below it."""
    tangents = np.linalg.svd(rim.normal[None])[2][1:]
    first, second = tangents[0], np.cross(rim.normal, tangents[0])
    members = surface.centers[rim.members]
    center = 0.5 * (members.min(axis=0) + members.max(axis=0))
    center = center - rim.height(center) * rim.normal
    radius = float(np.linalg.norm(members - center, axis=1).max())
    # Below its opening a vessel may be wider, at most by half.
    half = int(np.ceil(1.5 * radius / surface.gsd))
    step = surface.gsd
    origin = center - half * step * (first + second)
    return FaceGrid(origin, first, second, rim.normal, step, (2 * half + 1, 2 * half + 1))


def _in_focus(
    rim: Face,
    grid: FaceGrid,
    scene: FaceScene,
    gsd: float,
    tol: CavityTolerances,
    face_tol: OffsetTolerances,
) -> Face:
    """The rim at the offset at which its lines in the views coincide (a plane sweep)."""

    def strength(shift: float) -> float:
        face = replace(rim, offset=rim.offset + shift * gsd)
        return float(
            face_lines(grid.points(face), face, scene, face_tol, 1 - face_tol.view_share).sum()
        )

    shifts = np.arange(-HullTolerances.step_px, HullTolerances.step_px + 0.5)  # a cell of the hull
    sums = np.array([strength(shift) for shift in shifts])
    best = int(np.clip(sums.argmax(), 1, len(sums) - 2))
    below, here, above = sums[best - 1 : best + 2]
    bend = below - 2 * here + above
    vertex = np.clip(0.5 * (below - above) / bend, -1, 1) if bend < 0 else 0.0
    return replace(rim, offset=rim.offset + float(shifts[best] + vertex) * gsd)


def _mouth(
    rim: Face,
    on_rim: Array,
    grid: FaceGrid,
    scene: FaceScene,
    tol: CavityTolerances,
    face_tol: OffsetTolerances,
) -> Mask:
    """Cells (H, W) of the opening: those inside the bright cells of the rim, up to its inner line.

    ``on_rim`` are centres (N, 3) of the surface's faces on the rim. Phases of the inside may
    agree with the rim's normal by chance; darkness separates the inside from the rim.
    """
    nothing_near = np.zeros(grid.shape, np.bool_)
    places = grid.points(rim)
    losses = scene.losses_on(places, rim, face_tol)
    evidence = face_evidence(places, rim, scene, losses, nothing_near, None, face_tol)
    brightness = _brightness(places.reshape(-1, 3), on_rim, scene.maps).reshape(grid.shape)
    # Outlines may have cut off a part of the rim, so `evidence.possible` is not used.
    supported = (brightness > tol.max_brightness) & (evidence.cost < MAX_COST)
    closed = ndimage.binary_closing(supported, iterations=round(tol.max_gap))
    enclosed = np.asarray(ndimage.binary_fill_holes(closed), np.bool_) & ~closed
    enclosed = np.asarray(ndimage.binary_opening(enclosed, iterations=2), np.bool_)
    pieces, num = ndimage.label(enclosed)
    if num == 0:
        return enclosed
    mouth = pieces == 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
    if mouth.sum() < np.pi * tol.rounding**2:
        return np.zeros(grid.shape, np.bool_)
    labels = np.where(mouth, 0, NO_FACE)
    jump = evidence.jump.astype(np.float64)
    snapped = snapped_border(labels, 0, jump, tol.max_gap, face_tol.line_steps)
    return np.asarray(snapped == 0)


def _is_dark(inner: Array, ring: Array, maps: Sequence[PhaseMap], tol: CavityTolerances) -> bool:
    """Whether half of points ``(N, 3)`` are much darker than a ring ``(R, 3)``."""
    dark = _brightness(inner, ring, maps) < tol.max_brightness
    return bool(len(dark) and dark.mean() > 0.5)


def _is_bright(places: Array, maps: Sequence[PhaseMap], tol: CavityTolerances) -> Mask:
    """Which faces ``(N, 3)`` of a plane are not much darker than its brightest ones.

    The brightest are the share ``min_part`` that a rim has at least.
    """
    among_all = np.nan_to_num(_brightness(places, places, maps))
    brightest = among_all >= np.quantile(among_all, 1 - tol.min_part)
    return np.asarray(_brightness(places, places[brightest], maps) > tol.max_brightness)


def _brightness(points: Array, ring: Array, maps: Sequence[PhaseMap]) -> Array:
    """Intensity ``(N,)`` of points over the median of a ring's, median over the views.

    Views that show less than half of the ring are ignored. NaN where fewer than ``MIN_VIEWS``
    views show a point.
    """
    ratios = np.full((len(maps), len(points)), np.nan)
    for ratio, phase_map in zip(ratios, maps, strict=True):
        of_ring = _intensities(ring, phase_map)
        if np.isfinite(of_ring).sum() > 0.5 * len(ring):
            ratio[:] = _intensities(points, phase_map) / max(float(np.nanmedian(of_ring)), 1e-9)
    enough = np.isfinite(ratios).sum(axis=0) >= MIN_VIEWS
    brightness = np.full(len(points), np.nan)
    brightness[enough] = np.nanmedian(ratios[:, enough], axis=0)
    return brightness


def _intensities(points: Array, phase_map: PhaseMap) -> Array:
    """Intensity ``(N,)`` of points in a view; NaN beyond its image."""
    camera = phase_map.view.camera
    xy = camera.project(phase_map.view.cam_from_world * points)
    shown = in_frame(xy, camera.width, camera.height, 1)
    sampled = sample_image(np.asarray(phase_map.intensity, np.float32), xy)
    return np.where(shown, sampled, np.nan)


def _ring_about(mouth: Mask, tol: CavityTolerances) -> Mask:
    """Cells (H, W) of the rim about an opening, away from the line between them."""
    line = ndimage.binary_dilation(mouth, iterations=2)
    ring = ndimage.binary_dilation(line, iterations=max(round(0.5 * tol.rounding), 1))
    return np.asarray(ring & ~line, np.bool_)


def _cavity(
    surface: SurfaceFaces,
    rim: Face,
    grid: FaceGrid,
    mouth: Mask,
    beside: Floats,
    tol: CavityTolerances,
) -> Cavity | None:
    """The cavity under an opening, its wall as thick as at the rim; None if that varies.

    ``beside`` (H, W) is the signed distance of the cells to the opening's border, negative inside.
    """
    border = mouth & ~ndimage.binary_erosion(mouth)
    spacing, most = 0.5 * tol.rounding, MAX_CELLS // mouth.size
    depths = np.array([tol.rounding, *(spacing * np.arange(1, most))], np.float64)
    order = np.argsort(depths)
    insides = np.empty((len(depths), *grid.shape), np.bool_)
    insides[order] = surface.inside_along(
        grid.points(rim).reshape(-1, 3), -rim.normal, depths[order] * grid.step
    ).reshape(insides.shape)

    def outside_of(inside: Mask) -> Array:
        """Distance (H, W) in cells to the outer wall, negative inside."""
        # Space that the silhouettes left open inside the wall is not wall.
        return cells_beside(np.asarray(ndimage.binary_fill_holes(inside), np.bool_))

    wall = (beside - outside_of(insides[0]))[border]
    thickness = float(np.median(wall))
    sigma = robust_deviation(wall - thickness)
    if thickness <= 1 or sigma > max(tol.thickness_spread * thickness, 1.0):
        return None
    free = -np.asarray(beside, np.float64)
    layers = [free]
    for depth, inside in zip(depths[1:], insides[1:], strict=True):
        if not inside.any():
            break
        # At the rim its line is known; below it the wall's thickness is used.
        known = min(depth / tol.rounding, 1.0)
        inferred = known * (-outside_of(inside) - thickness) + (1 - known) * layers[0]
        free = np.minimum(inferred, layers[-1] + tol.growth * spacing)
        pieces = ndimage.label(free > 0)[0]
        linked = np.unique(pieces[(layers[-1] > 0) & (pieces > 0)])
        free = np.where((pieces > 0) & ~np.isin(pieces, linked), -0.5, free)
        if not (free > 0).any():
            break
        layers.append(free)
    depths = spacing * np.arange(len(layers), dtype=np.float64)
    # The bottom is at least as thick as the wall.
    floor = spacing * len(layers) - thickness - depths
    if floor[0] <= tol.rounding:
        return None
    # A cap bulges above the rim by no more than its rounding.
    above = int(np.ceil(2 * tol.rounding / spacing))
    field = np.minimum(np.stack(layers), floor[:, None, None])
    field = np.concatenate([np.repeat(field[:1], above, axis=0), field])
    field = ndimage.gaussian_filter(field, (0.5, 1.0, 1.0), mode="nearest") * grid.step
    return Cavity(
        rim=rim,
        grid=grid,
        thickness=thickness * grid.step,
        thickness_sigma=sigma * grid.step,
        field=field.astype(np.float32),
        layer_step=spacing * grid.step,
        first_layer=-above,
    )
