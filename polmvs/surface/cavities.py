"""Cavities of vessels, such as the inside of a mug.

Silhouettes close the opening of a vessel with a cap. Phases hardly support it, except those of
mirror images in metal, so each part that faces upwards may be a cap as well. The inside is assumed
to follow the outside, at the thickness of the wall.

The rim around the cap, flat or rounded, is the top of the wall. A rounded rim is a half circle
across the wall. Its phases give the thickness, and those of its inner half, which faces the axis
of the opening, show the opening. Below it phases may show a floor, such as a sunk lid.

Light from inside a dark vessel has been reflected several times, and its phase gives no normal. If
the rim is flat, it gives the plane of the opening: at the right offset of this plane, the lines of
the rim in all views coincide. The inner line is the border of the opening. The width of the rim is
the thickness of the wall. If the width varies, nothing is inferred.

Inside other vessels the phases are those of the walls. The thickness of the wall is the one at
which they are likeliest, and they must be likelier than on the cap.

A cavity states its thickness and how uncertain that is. Where no phase supports its walls they are
an inference, not a measurement, and points on them should be labelled as inferred.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, sparse, special

from polmvs.camera import in_frame, sample_image
from polmvs.fitting import robust_deviation
from polmvs.normals.estimator import solve_normals
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_VIEWS
from polmvs.surface.borders import cells_beside
from polmvs.surface.creases import CreaseTolerances
from polmvs.surface.ground import SupportingPlane
from polmvs.surface.mesh_geometry import MAX_CELLS, RayScene, TriangleMesh, height_field
from polmvs.surface.observations import Looking
from polmvs.surface.offsets import (
    MAX_COST,
    NO_PATCH,
    OffsetTolerances,
    Patch,
    PatchGrid,
    PatchScene,
    border_of_steps,
    median_loss,
    patch_evidence,
    patch_lines,
    row_losses,
    snapped_border,
)
from polmvs.surface.surface_quality import MIN_POINTS, SIGNIFICANCE
from polmvs.surface.visual_hull import HullTolerances

Array = NDArray[np.float64]
Indices = NDArray[np.int64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

SAME_PLANE_PX = HullTolerances.step_px  # GSDs, uncertainty of a rim's plane: a cell of the hull
MIN_BORDER = 10  # least number of faces of a rim, and of the border of an opening
THICKNESS_RATIO = 1.25  # of neighbours among the thicknesses that are tried
THINNEST = -2  # exponent of the ratio, over the width of the rounding: about two cells of the mesh
NUM_SECTORS = 8  # around an opening
RIM_CELLS = 8  # across a rounded rim, whose normals turn by 180 deg; half as many to find it
DEPTH_RATIO = 1.1  # of neighbours among the depths that are tried
THICK_BOTTOM = 4  # exponent of that ratio for a bottom as thick as a third of the depth
RIM_RATIO = 1.08  # as 1.25, of a rounded rim: its phases contradict a tenth more or less
TOP_SECTORS = 36  # in each of which the top of a wall is sought
PLANE_ROUNDS = 3  # of the fit of a plane to half of a border


@dataclass(frozen=True, kw_only=True)
class CavityTolerances:
    """Tolerances of the search for cavities; lengths in GSD.

    Attributes
    ----------
    min_sectors : number of the eight sectors around an opening that must have faces of the rim.
        Guess: one sector may be hidden.
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

    min_sectors: int = 7
    max_gap: float = 4.0
    max_brightness: float = 0.3
    rounding: float = 6.0
    thickness_spread: float = 0.15
    growth: float = 0.5


TOL = CavityTolerances()


@dataclass(frozen=True)
class Cavity:
    """Free space inside a vessel.

    Attributes
    ----------
    rim : plane of the opening; its members are faces of the surface on the rim.
    grid : across the opening.
    thickness : of the wall, world units.
    thickness_sigma : its robust deviation around the rim, or its deviation between views, world
        units.
    field : (D, H, W) float32, signed distance to the cavity's walls in layers across the opening,
        positive in the cavity.
    layer_step : distance of the layers, world units.
    first_layer : depth of the first layer below the rim, in layers (negative: above).
    is_measured : whether the phases on its walls gave the thickness, not those of the rim.
    """

    rim: Patch
    grid: PatchGrid
    thickness: float
    thickness_sigma: float
    field: Image
    layer_step: float
    first_layer: int
    is_measured: bool = False

    @property
    def is_deep(self) -> bool:
        """Whether it is deeper than wide: light in it was reflected several times."""
        area = np.count_nonzero(self.open_cells) * self.grid.step**2
        return bool(self.depth > 2 * np.sqrt(area / np.pi))

    @property
    def open_cells(self) -> Mask:
        """(H, W) bool, its opening at the height of the rim."""
        return np.asarray(self.field[-self.first_layer] > 0)

    @property
    def depths(self) -> Array:
        """(D,) of the layers below the rim, world units."""
        return self.layer_step * (self.first_layer + np.arange(len(self.field), dtype=np.float64))

    @property
    def depth(self) -> float:
        """Of its lowest free layer, world units."""
        return float(self.depths[(self.field > 0).any(axis=(1, 2))].max(initial=0.0))

    def is_below(self, point: Array) -> bool:
        """Whether a point (3,), projected to the plane of the rim, lies in the opening."""
        in_plane = point - self.rim.height(point) * self.rim.normal
        return bool(self.values(in_plane[None])[0] > 0)

    def above(self, depth: float) -> Cavity:
        """Its part above a floor at a depth below the rim."""
        floor = (depth - self.depths).astype(np.float32)
        return replace(self, field=np.minimum(self.field, floor[:, None, None]))

    def shallower(self, share: float) -> Cavity:
        """The cavity with all its depths times a share."""
        return replace(self, layer_step=share * self.layer_step)

    def values(self, points: Floats) -> Array:
        """Signed distance ``(N,)`` of points, positive in the cavity's free space."""
        points = np.asarray(points, np.float64)
        depth = -self.rim.height(points) / self.layer_step - self.first_layer
        cells = self.grid.cells(points)
        place = np.stack([depth, cells[..., 0], cells[..., 1]])
        outside = -float(max(self.field.shape)) * self.grid.step
        found = ndimage.map_coordinates(self.field, place, order=1, mode="constant", cval=outside)
        return np.asarray(found, np.float64)


# Information (V,) that a cavity adds to each view's phases, nats.
Gain: TypeAlias = Callable[[Cavity], Array]
# Information (V, F) of each view's phases on the faces of a mesh, nats.
Information: TypeAlias = Callable[[TriangleMesh], sparse.csr_array]


@dataclass(frozen=True)
class Opening:
    """A connected patch of a closed surface that may be a cap over a cavity.

    Attributes
    ----------
    patch : (P,) indices of its faces.
    border : (B,) indices of the faces about it.
    area : of the patch, world units squared.
    is_supported : whether phases support the patch. Those of mirror images in polished metal agree
        with a cap; then only the rim tells that it is one.
    """

    patch: Indices
    border: Indices
    area: float
    is_supported: bool = False


@dataclass(frozen=True)
class SurfaceFaces:
    """Small faces of a closed surface.

    Attributes
    ----------
    centers, normals : (F, 3), world; unit normals outwards.
    supported : (F,) bool, faces whose phases support them.
    openings : patches that may close a cavity: those without support first, largest first.
    inside_along : which points ``(D, N)`` lie inside, on rays from origins ``(N, 3)`` along one
        direction ``(3,)``, at ascending distances ``(D,)``.
    gsd : ground sampling distance at the surface, world units.
    """

    centers: Array
    normals: Array
    supported: Mask
    openings: Sequence[Opening]
    inside_along: Callable[[Array, Array, Array], Mask]
    gsd: float


def surface_faces(
    scene: RayScene, seen: Mask, supported: Mask, gsd: float, upwards: Array | None = None
) -> SurfaceFaces:
    """The faces of a closed mesh, with the openings among them.

    Parameters
    ----------
    scene : of the mesh, with F faces.
    seen : (F,), faces that views see.
    supported : (F,), faces whose phases support them.
    gsd : ground sampling distance at the surface, world units.
    upwards : (3,) direction in which objects that stand on a plane are open; None: unknown.
    """
    mesh = scene.mesh
    pieces = mesh.pieces(supported)
    area = np.bincount(pieces + 1, mesh.face_areas)[1:]
    # Phases may support islands of a cap by chance.
    is_body = (pieces >= 0) & (pieces == (np.argmax(area) if len(area) else 0))
    least = np.pi * (TOL.rounding * gsd) ** 2
    openings = [
        Opening(patch, border[is_body[border]], area)
        for patch, border, area in _patches(mesh, seen & ~is_body, least)
    ]
    if upwards is not None:
        is_top = mesh.face_normals @ upwards > np.cos(np.pi / 4)
        openings += [
            Opening(*top, is_supported=True)
            for top in _patches(mesh, seen & is_top, _least_area(gsd))
        ]
    return SurfaceFaces(mesh.centers, mesh.face_normals, is_body, openings, scene.inside_along, gsd)


def _patches(
    mesh: TriangleMesh, chosen: Mask, least: float
) -> Iterator[tuple[Indices, Indices, float]]:
    """Faces, faces about them, and area of the connected patches of a least area, largest first."""
    patches = mesh.pieces(chosen)
    areas = np.bincount(patches + 1, mesh.face_areas)[1:]
    for number in np.argsort(-areas, kind="stable"):
        if areas[number] < least:
            break
        patch = np.flatnonzero(patches == number)
        touches = np.zeros(len(mesh.vertices), np.bool_)
        touches[mesh.faces[patch]] = True
        about = touches[mesh.faces].any(axis=1) & (patches != number)
        yield patch, np.flatnonzero(about), float(areas[number])


def find_cavities(
    surface: SurfaceFaces,
    scene: PatchScene,
    gain: Gain,
    information: Information,
) -> tuple[Cavity, ...]:
    """Openings that a surface closes with a cap, and the cavities behind them.

    Parameters
    ----------
    surface : refined; its outside determines the cavity's walls.
    scene : the views.
    gain : information (V,) of each view's phases that a cavity adds to the closed surface's.
    information : (V, F) of each view's phases on the faces of a mesh.
    """
    if len(scene.maps) < MIN_VIEWS:
        return ()
    found: list[Cavity] = []
    for opening in surface.openings:
        plane = _plane_of(opening, surface)
        middle = surface.centers[opening.patch].mean(axis=0)
        if plane is None or any(other.is_below(middle) for other in found):
            continue
        enclosed = _is_enclosed(surface, opening, plane)
        top = _top_of_wall(surface, opening, plane) if enclosed else None
        cavity = None if top is None else _rounded_cavity(surface, opening, top, information)
        if cavity is not None and not _is_dark_opening(
            cavity.open_cells, cavity.rim, cavity.grid, scene.maps
        ):
            cavity = _likeliest_floor(cavity, gain)
            if opening.is_supported and not _agree(gain(cavity)):  # such as a lid at its rim
                cavity = None
        if cavity is None and not opening.is_supported:
            cavity = _dark_cavity(surface, opening, plane, scene)
            if cavity is None and top is not None:
                cavity = _bright_cavity(surface, opening, top, gain)
        if cavity is not None:
            found.append(cavity)
    return tuple(found)


def find_vessel(
    scene: RayScene, top: SupportingPlane, gsd: float, gain: Gain, points: Floats
) -> Cavity | None:
    """The shallow cavity below a plane, at whose walls the phases are likelier than on a solid.

    Known points inside tell its depth. Without them phases do, which light that was reflected
    several times biases: in a glazed bowl by a fifth of the depth.

    Parameters
    ----------
    scene : of a closed first surface, whose cap above the plane is not the vessel's.
    top : plane of the top of the wall, with the normal upwards.
    gsd : ground sampling distance at the surface, world units.
    gain : information (V,) of each view's phases that a cavity adds to the solid's.
    points : (N, 3), known points of the object.

    Returns
    -------
    None if the solid explains the phases, or if views disagree on the wall.
    """
    mesh = scene.mesh
    height = top.height(mesh.centers) + TOL.rounding * gsd  # above the rim: the hull rounds edges
    patch = np.flatnonzero(height > 0)
    members = np.flatnonzero(np.abs(height) < 2 * SAME_PLANE_PX * gsd)
    rim = Patch(top.normal, top.offset - TOL.rounding * gsd, members)
    opening = Opening(patch, rim.members, float(mesh.face_areas[patch].sum()))
    below = height <= 0
    if not below.any() or len(rim.members) < MIN_BORDER or opening.area < _least_area(gsd):
        return None
    surface = SurfaceFaces(
        mesh.centers, mesh.face_normals, below, [opening], scene.inside_along, gsd
    )
    within = _cavities_within(surface, opening, rim)

    def cavity_of(number: float, thickness: float, sigma: float = 0.0) -> Cavity | None:
        """A cavity ``number`` steps shallower than with a bottom as thick as its wall."""
        cavity = within(False, thickness, sigma)
        # Many reflections bias the phases in a deep one: `find_cavities` infers its wall.
        if cavity is None or cavity.is_deep:
            return None
        return cavity.shallower(DEPTH_RATIO**-number)

    for start in (0, THICK_BOTTOM):
        likeliest = _likeliest_thickness(partial(cavity_of, start), gain)
        # Neither solid nor vessel is refined, so errors of their shapes have a part in the sum.
        if likeliest is not None and likeliest.views_agree:
            of_wall = partial(cavity_of, thickness=likeliest.thickness, sigma=likeliest.sigma)
            inner = points[scene.signed_distance(points) < -0.5 * likeliest.thickness * gsd]
            if len(inner) < MIN_POINTS:
                return _likeliest_depth(of_wall, start, gain)
            return _likeliest_depth(of_wall, start, partial(_agreement, points=inner))
    return None


def _agreement(cavity: Cavity, points: Floats) -> Array:
    """Log-likelihood (N,) of points on a cavity's walls: Cauchy's, of the width of a cell."""
    return np.asarray(-np.log1p((cavity.values(points) / cavity.grid.step) ** 2))


def _least_area(gsd: float) -> float:
    """Area of an opening with its wall about it, world units squared."""
    return float(np.pi * (2 * TOL.rounding * gsd) ** 2)


def _is_enclosed(surface: SurfaceFaces, opening: Opening, plane: Patch) -> bool:
    """Whether supported faces surround an opening that is wide enough for a wall."""
    if opening.area < _least_area(surface.gsd):
        return False
    return _surrounds(plane, surface.centers[opening.border], surface.centers[opening.patch])


def _rounded_cavity(
    surface: SurfaceFaces, opening: Opening, rim: Patch, information: Information
) -> Cavity | None:
    """The cavity within a rounded rim; ``rim`` is the plane through its top."""
    grid = _grid_about(surface, rim)
    wall = _rounded_wall(surface, opening, rim, grid, information)
    return None if wall is None else _cavity(surface, wall, grid, opening)


def _dark_cavity(
    surface: SurfaceFaces, opening: Opening, plane: Patch, scene: PatchScene
) -> Cavity | None:
    """The cavity with a wall as thick as the flat rim about its dark opening."""
    rim = _rim(surface, opening, plane, scene)
    if rim is None:
        return None
    grid = _grid_about(surface, rim)
    wall = _flat_wall(surface, rim, grid, scene)
    return None if wall is None else _cavity(surface, wall, grid, opening)


def _bright_cavity(
    surface: SurfaceFaces, opening: Opening, rim: Patch, gain: Gain
) -> Cavity | None:
    """The cavity with the wall at which the phases are likeliest; None if the cap explains them.

    The rim is flat or rounded. The wrong shape makes the wall too thin, because a narrower rim
    contradicts fewer phases, so the thicker wall is taken. ``rim`` is the plane
    through its top, ``gain`` the information that a cavity adds.
    """
    cavity_of = _cavities_within(surface, opening, rim)
    found = []
    for is_round in (False, True):
        likeliest = _likeliest_thickness(partial(cavity_of, is_round), gain)
        if likeliest is None:  # a rounded rim adds none where a flat one does not
            break
        found.append((likeliest.thickness, likeliest.sigma, is_round))
    if not found:
        return None
    thickness, sigma, is_round = max(found)
    return cavity_of(is_round, thickness, sigma)


def _cavities_within(
    surface: SurfaceFaces, opening: Opening, rim: Patch
) -> Callable[..., Cavity | None]:
    """The cavity below a rim by its shape, its wall's thickness and the deviation of that."""
    grid = _grid_about(surface, rim)
    outside_at = cache(partial(_outside_at, surface, rim, grid))

    def cavity_of(is_round: bool, thickness: float, sigma: float = 0.0) -> Cavity | None:
        radius = 0.5 * thickness if is_round else 0.0
        start = max(TOL.rounding, radius)
        outer = outside_at(start)
        wall = _Wall(rim, thickness, sigma, -outer - (radius or thickness), outer, start, radius)
        cavity = _cavity(surface, wall, grid, opening)
        return None if cavity is None else replace(cavity, is_measured=True)

    return cavity_of


@dataclass(frozen=True)
class _Thickness:
    """The likeliest thickness of a wall.

    Attributes
    ----------
    thickness, sigma : in cells, and its deviation between views.
    gain : (V,) information that the wall adds to each view's phases, nats.
    """

    thickness: float
    sigma: float
    gain: Array

    @property
    def views_agree(self) -> bool:
        """Whether the mean of the views shows the wall at a significance of 95 %."""
        return _agree(self.gain)


def _likeliest_thickness(
    cavity_of: Callable[[float], Cavity | None], gain: Gain
) -> _Thickness | None:
    """The thickness of the wall that adds the most information; None if no wall adds any."""
    gains: dict[int, Array] = {}

    def thickness_of(number: float) -> float:
        return float(TOL.rounding * THICKNESS_RATIO**number)

    def total(number: int) -> float:
        if number not in gains:
            cavity = cavity_of(thickness_of(number)) if number >= THINNEST else None
            gains[number] = np.array([-np.inf]) if cavity is None else gain(cavity)
        return float(gains[number].sum())

    def may_add(number: int) -> bool:
        """Whether a wall thinner than one that adds nothing may add some, by ever smaller rises."""
        rise = total(number) - total(number + 1)
        return total(number) > 0 or total(number) + (number - THINNEST) * rise > 0

    best = 1
    # A thicker wall leaves less of a cavity that adds nothing, so only thinner ones may add any.
    for step in (1, -1) if total(best) > 0 else (-1,):
        while total(best + step) > total(best):
            best += step
            if step < 0 and not may_add(best):
                return None
    if not total(best) > 0:
        return None
    shift, sigma = _vertex(gains[best - 1], gains[best], gains[best + 1])
    thickness = thickness_of(best + shift)
    return _Thickness(thickness, thickness * (THICKNESS_RATIO**sigma - 1), gains[best])


def _likeliest_depth(
    cavity_of: Callable[[float], Cavity | None], start: int, gain: Gain
) -> Cavity | None:
    """The cavity of the largest gain whose bottom is as thick as the wall, or thicker.

    All depths change together, so a round bottom stays round and upright walls stay upright.
    """

    @cache
    def information(number: int) -> Array:
        cavity = cavity_of(number) if number >= 0 else None
        return np.array([-np.inf]) if cavity is None else gain(cavity)

    best = start
    for step in (1, -1):
        while information(best + step).sum() > information(best).sum():
            best += step
    return cavity_of(best + _vertex(*(information(best + step) for step in (-1, 0, 1)))[0])


def _vertex(below: Array, here: Array, above: Array) -> tuple[float, float]:
    """Place of the greatest mean of values (V,) at -1, 0 and 1, by a parabola, and its deviation.

    The deviation is that of the slope.
    """
    if np.isfinite(below).all() and np.isfinite(above).all():
        slope, bend = 0.5 * (above - below), float((below - 2 * here + above).mean())
        if bend < 0:
            return -float(slope.mean()) / bend, _sigma_of_mean(slope) / -bend
    return 0.0, 1.0


def _likeliest_floor(cavity: Cavity, gain: Gain) -> Cavity:
    """A cavity with its floor at the likeliest depth: at the bottom unless most views deny it.

    A sunk lid is a floor below a rim as well. Light that was reflected several times biases the
    phases on the right walls, too, so only floors are compared.
    """
    step, at_bottom = cavity.grid.step, gain(cavity)
    lowest = int(np.log2(cavity.depth / (TOL.rounding * step)))
    if lowest < 1:
        return cavity

    @cache
    def information(exponent: float) -> Array:
        depth = cavity.depth * 2.0**exponent
        is_cavity = depth > TOL.rounding * step
        return gain(cavity.above(depth)) if is_cavity else np.full_like(at_bottom, -np.inf)

    best = float(max(range(-lowest, 0), key=lambda exponent: information(exponent).sum()))
    if not _agree(information(best) - at_bottom, best_of=lowest):
        return cavity
    halving = 0.5
    while cavity.depth * (2.0 ** (best + halving) - 2.0**best) > step:
        near = (best - halving, best, best + halving)
        best = max(near, key=lambda exponent: information(exponent).sum())
        halving *= 0.5
    return cavity.above(cavity.depth * 2.0**best)


def _top_of_wall(surface: SurfaceFaces, opening: Opening, plane: Patch) -> Patch:
    """The plane through the top of the wall about an opening; ``plane`` is near it."""
    middle = surface.centers[opening.patch].mean(axis=0)
    for _ in range(PLANE_ROUNDS):
        grid = _grid_about(surface, plane)
        outer = _outside_at(surface, plane, grid, TOL.rounding)
        cells = grid.cells(surface.centers)
        outwards = ndimage.map_coordinates(outer, cells.T, order=1, mode="nearest")
        height = plane.height(surface.centers)
        near = (np.abs(outwards) < TOL.rounding) & (surface.normals @ plane.normal > 0)
        near &= np.abs(height) < 2 * TOL.rounding * surface.gsd
        x, y = (cells - grid.cells(middle)).T
        sector = np.where(near, _sectors(x, y, TOP_SECTORS), -1)
        tops = []
        for number in range(TOP_SECTORS):
            index = np.flatnonzero(sector == number)
            if len(index):  # the highest twentieth
                highest = index[np.argsort(-height[index])[: -(-len(index) // 20)]]
                tops.append(surface.centers[highest].mean(axis=0))
        if len(tops) < MIN_BORDER:
            break
        point, normal, _ = _plane_through(np.array(tops))
        normal = normal * np.sign(normal @ plane.normal)
        plane = replace(plane, normal=normal, offset=float(point @ normal))
    return plane


def _agree(gain: Array, best_of: int = 1) -> bool:
    """Whether gains (N,), the best of some tried, have a positive mean at a significance of 95 %.

    The more are tried, the more likely is one by chance (Sidak 1967).
    """
    deviations = float(special.ndtri(SIGNIFICANCE ** (1 / best_of)))
    return bool(gain.mean() > deviations * _sigma_of_mean(gain))


def _sigma_of_mean(values: Array) -> float:
    """Standard deviation of the mean of independent values."""
    return float(values.std(ddof=1) / np.sqrt(len(values)))


def _plane_of(opening: Opening, surface: SurfaceFaces) -> Patch | None:
    """The plane of an opening's border, with its faces; None if the border is not planar."""
    if len(opening.border) < MIN_BORDER:
        return None
    middle, normal, distance = _plane_through(surface.centers[opening.border])
    if distance > SAME_PLANE_PX * surface.gsd:
        return None
    if surface.normals[opening.patch].mean(axis=0) @ normal < 0:
        normal = -normal
    return Patch(normal, float(middle @ normal), opening.border)


def _plane_through(points: Array) -> tuple[Array, Array, float]:
    """Point, normal and median distance of the plane through most of points (N, 3)."""
    kept = np.ones(len(points), np.bool_)
    for _ in range(PLANE_ROUNDS):
        middle = points[kept].mean(axis=0)
        normal = np.linalg.svd(points[kept] - middle, full_matrices=False)[2][2]
        distance = np.abs((points - middle) @ normal)
        kept = distance <= max(2 * float(np.median(distance)), 1e-300)
    return middle, normal, float(np.median(distance))


def _rim(
    surface: SurfaceFaces,
    opening: Opening,
    plane: Patch,
    scene: PatchScene,
) -> Patch | None:
    """The rim about a dark opening, with the normal that the phases of its faces have.

    Its members are faces of the surface. None if the rim does not surround the opening, or if that
    is not dark. ``plane`` is that of the opening's border.
    """
    normal, offset = plane.normal, plane.offset
    # A rounded rim is higher than the border of its phases.
    near = np.abs(surface.centers @ normal - offset) < 2 * SAME_PLANE_PX * surface.gsd
    near &= surface.normals @ normal > np.cos(np.radians(CreaseTolerances.crease_deg))
    members = np.flatnonzero(near & surface.supported)
    if len(members) < MIN_BORDER:
        return None
    places = surface.centers[members]
    rows = scene.rows(places)
    facing = -np.einsum("ikn,i->kn", rows.rays, normal) > Looking.min_cosine
    sigma = np.where(facing, rows.sigma, np.inf)
    start = np.repeat(normal[:, None], len(members), axis=1)
    estimate = solve_normals(rows.rows, rows.rays, sigma, initial_normals=start)
    agree = estimate.valid & (estimate.num_rows >= MIN_VIEWS)
    agree &= np.nan_to_num(estimate.normals) @ normal > np.cos(
        np.radians(CreaseTolerances.crease_deg)
    )
    if agree.sum() < MIN_BORDER:
        return None
    normal = np.median(estimate.normals[agree], axis=0)
    normal /= np.linalg.norm(normal)
    losses = row_losses(rows, normal[:, None])[0]
    losses = np.where(facing, losses, np.nan)
    has_phase = np.isfinite(losses).sum(axis=0) >= 0.5 * facing.sum(axis=0)
    fits = has_phase & (median_loss(losses[:, None])[0] < MAX_COST)
    if not fits.any():
        return None
    rim = Patch(normal, float(np.median(places[fits] @ normal)), members[fits])
    cap = surface.centers[opening.patch]
    on_plane = cap - rim.height(cap)[:, None] * normal
    is_rim = _surrounds(rim, places[fits], cap) and _is_dark(on_plane, places[fits], scene.maps)
    return rim if is_rim else None


def _surrounds(plane: Patch, border: Array, cap: Array) -> bool:
    """Whether points ``(B, 3)`` surround others ``(P, 3)``, seen along the normal of a plane."""
    tangents = np.linalg.svd(plane.normal[None])[2][1:]
    x, y = tangents @ (border - np.median(cap, axis=0)).T
    return len(np.unique(_sectors(x, y))) >= TOL.min_sectors


def _grid_about(surface: SurfaceFaces, rim: Patch) -> PatchGrid:
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
    return PatchGrid(origin, first, second, rim.normal, step, (2 * half + 1, 2 * half + 1))


def _in_focus(
    rim: Patch,
    grid: PatchGrid,
    scene: PatchScene,
    gsd: float,
) -> Patch:
    """The rim at the offset at which its lines in the views coincide (a plane sweep)."""

    def strength(shift: float) -> float:
        patch = replace(rim, offset=rim.offset + shift * gsd)
        places, share = grid.points(patch), 1 - OffsetTolerances.view_share
        return float(patch_lines(places, patch, scene, share).sum())

    shifts = np.arange(-HullTolerances.step_px, HullTolerances.step_px + 0.5)  # a cell of the hull
    sums = np.array([strength(shift) for shift in shifts])
    best = int(np.clip(sums.argmax(), 1, len(sums) - 2))
    below, here, above = sums[best - 1 : best + 2]
    bend = below - 2 * here + above
    vertex = np.clip(0.5 * (below - above) / bend, -1, 1) if bend < 0 else 0.0
    return replace(rim, offset=rim.offset + float(shifts[best] + vertex) * gsd)


def _open_cells(
    rim: Patch,
    on_rim: Array,
    grid: PatchGrid,
    scene: PatchScene,
) -> Mask:
    """Cells (H, W) of the opening: those inside the bright cells of the rim, up to its inner line.

    ``on_rim`` are centres (N, 3) of the surface's faces on the rim. Phases of the inside may
    agree with the rim's normal by chance, and outlines may cut off a part of the rim: brightness
    alone separates the two.
    """
    nothing_near = np.zeros(grid.shape, np.bool_)
    places = grid.points(rim)
    losses = scene.losses_on(places, rim)
    evidence = patch_evidence(places, rim, scene, losses, nothing_near)
    brightness = _brightness(places.reshape(-1, 3), on_rim, scene.maps).reshape(grid.shape)
    bright = brightness > TOL.max_brightness
    closed = ndimage.binary_closing(bright, iterations=round(TOL.max_gap))
    enclosed = np.asarray(ndimage.binary_fill_holes(closed), np.bool_) & ~closed
    enclosed = np.asarray(ndimage.binary_opening(enclosed, iterations=2), np.bool_)
    pieces, num = ndimage.label(enclosed)
    if num == 0:
        return enclosed
    open_cells = pieces == 1 + int(np.argmax(np.bincount(pieces.ravel())[1:]))
    if open_cells.sum() < np.pi * TOL.rounding**2:
        return np.zeros(grid.shape, np.bool_)
    labels = np.where(open_cells, 0, NO_PATCH)
    jump = evidence.jump.astype(np.float64)
    snapped = snapped_border(labels, 0, jump, TOL.max_gap, OffsetTolerances.line_steps)
    return np.asarray(snapped == 0)


def _is_dark(inner: Array, ring: Array, maps: Sequence[PhaseMap]) -> bool:
    """Whether half of points ``(N, 3)`` are much darker than a ring ``(R, 3)``."""
    dark = _brightness(inner, ring, maps) < TOL.max_brightness
    return bool(len(dark) and dark.mean() > 0.5)


def _is_dark_opening(
    open_cells: Mask, rim: Patch, grid: PatchGrid, maps: Sequence[PhaseMap]
) -> bool:
    """Whether an opening, of cells (H, W), is much darker than its rim."""
    inner = ndimage.binary_erosion(open_cells, iterations=3)
    places = grid.points(rim)
    return _is_dark(places[inner], places[_ring_about(open_cells)], maps)


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


def _ring_about(open_cells: Mask) -> Mask:
    """Cells (H, W) of the rim about an opening, away from the line between them."""
    line = ndimage.binary_dilation(open_cells, iterations=2)
    ring = ndimage.binary_dilation(line, iterations=max(round(0.5 * TOL.rounding), 1))
    return np.asarray(ring & ~line, np.bool_)


@dataclass(frozen=True)
class _Wall:
    """The wall of a vessel under its rim; lengths in cells of a grid.

    Attributes
    ----------
    rim : plane of the rim.
    thickness, sigma : of the wall, and its robust deviation around the rim.
    top : (H, W) signed distance to the wall at the height of the rim, positive in the opening.
    outer : (H, W) signed distance to the outside of the wall at ``start``, negative inside.
    start : depth below which the wall has its thickness, and the outside of the surface is used.
    radius : of a rounded rim; 0 of a flat one.
    """

    rim: Patch
    thickness: float
    sigma: float
    top: Array
    outer: Array
    start: float
    radius: float

    def free(self, depth: float) -> Array:
        """Signed distance (H, W) to the wall at a depth above ``start``, positive in the cavity."""
        if self.radius:
            known = float(np.sqrt(1 - (1 - min(depth / self.radius, 1)) ** 2))
        else:
            known = depth / self.start
        return known * (-self.outer - self.thickness) + (1 - known) * self.top


def _inside_at(surface: SurfaceFaces, rim: Patch, grid: PatchGrid, depths: Array) -> Mask:
    """Cells (D, H, W) inside the surface at depths (D,) of cells below a rim."""
    origins = grid.points(rim).reshape(-1, 3)
    inside = surface.inside_along(origins, -rim.normal, depths * grid.step)
    return inside.reshape(-1, *grid.shape)


def _outside_at(surface: SurfaceFaces, rim: Patch, grid: PatchGrid, depth: float) -> Array:
    """Distance (H, W) in cells to the outer wall at a depth of cells, negative inside."""
    return _outside(_inside_at(surface, rim, grid, np.array([depth]))[0])


def _outside(inside: Mask) -> Array:
    """Distance (H, W) in cells to the border of a section's outer contour, negative inside."""
    # Space that the silhouettes left open inside the wall is not wall.
    return cells_beside(np.asarray(ndimage.binary_fill_holes(inside), np.bool_))


def _flat_wall(
    surface: SurfaceFaces,
    rim: Patch,
    grid: PatchGrid,
    scene: PatchScene,
) -> _Wall | None:
    """The wall under a flat rim: as thick as the rim is wide. None without a dark opening in it."""
    rim = _in_focus(rim, grid, scene, surface.gsd)
    open_cells = _open_cells(rim, surface.centers[rim.members], grid, scene)
    if not _is_dark_opening(open_cells, rim, grid, scene.maps):
        return None
    beside = border_of_steps(open_cells, open_cells, rim, grid, scene)
    outer = _outside_at(surface, rim, grid, TOL.rounding)
    width = (beside - outer)[open_cells & ~ndimage.binary_erosion(open_cells)]
    thickness = float(np.median(width))
    sigma = robust_deviation(width - thickness)
    return _Wall(rim, thickness, sigma, -np.asarray(beside, np.float64), outer, TOL.rounding, 0.0)


def _rounded_wall(
    surface: SurfaceFaces,
    opening: Opening,
    rim: Patch,
    grid: PatchGrid,
    information: Information,
) -> _Wall | None:
    """The wall under a rim that is a half circle across, of the radius that is likeliest.

    The inner half of the rim faces the axis of the opening, which no cap does. So its phases also
    show that there is an opening. None if they do not. ``rim`` is the plane through its top.
    """
    (below,) = _inside_at(surface, rim, grid, np.array([TOL.rounding]))
    inwards = -_outside(below)
    walls = _walls_about(inwards)
    if not walls or _is_open(opening, below[inwards > walls[0]], grid.step):
        return None
    # Only below the radius the outside is that of the wall.
    starts = np.maximum(TOL.rounding, 0.5 * np.array(walls))
    different, which = np.unique(starts, return_inverse=True)
    insides = _inside_at(surface, rim, grid, different)
    outsides = cache(lambda number: _outside(insides[number]))
    middle = grid.cells(surface.centers[opening.patch].mean(axis=0))

    @cache
    def at_rim(number: int, num_cells: int = RIM_CELLS) -> _RimInformation | None:
        if not 0 <= number < len(walls):
            return None
        inwards = -outsides(int(which[number]))
        return _on_half_circle(walls[number], num_cells, inwards, rim, grid, middle, information)

    def total(number: int, *num_cells: int) -> float:
        found = at_rim(number, *num_cells)
        return -np.inf if found is None else float(found.of_views.sum())

    some = range(0, len(walls), 2)
    best = max(some, key=lambda number: total(number, RIM_CELLS // 2))
    if not total(best) > 0:
        return None
    best = max((best - 1, best, best + 1), key=total)
    found = at_rim(best)
    if found is None or not _agree(found.of_views) or not _agree(found.inner_of_sectors):
        return None
    near = (best - 1, best, best + 1)
    tried = {number: one for number in sorted({*some, *near}) if (one := at_rim(number))}
    thickness = walls[best]
    beside = [tried[number].of_views for number in near if number in tried]
    if len(beside) == 3:
        thickness = float(thickness * RIM_RATIO ** _vertex(*beside)[0])
    likeliest = np.argmax([one.inner_of_sectors for one in tried.values()], axis=0)
    sigma = robust_deviation(np.array(walls)[list(tried)][likeliest] - thickness)
    radius = 0.5 * thickness
    start = max(TOL.rounding, radius)
    outer = _outside_at(surface, rim, grid, start)
    return _Wall(rim, thickness, sigma, -outer - radius, outer, start, radius)


def _is_open(opening: Opening, solid: Mask, step: float) -> bool:
    """Whether a surface has an inside below a rim, where ``solid`` (N,) are cells of the opening.

    A cap that phases hardly support may have sunk below the rim: it is no inside.
    """
    is_cap = not opening.is_supported and opening.area > 0.5 * len(solid) * step**2
    return not is_cap and bool(solid.mean() < 0.5)


def _walls_about(inwards: Array) -> list[float]:
    """Thicknesses of a wall that leave an opening, in cells.

    ``inwards`` (H, W) are distances from the outside of the wall, in cells.
    """
    tried: list[float] = []
    thickness = TOL.rounding * THICKNESS_RATIO**THINNEST
    while np.count_nonzero(inwards > thickness) > np.pi * TOL.rounding**2:
        tried.append(thickness)
        thickness *= RIM_RATIO
    return tried


@dataclass(frozen=True)
class _RimInformation:
    """Information of the phases on a rounded rim, nats.

    Attributes
    ----------
    of_views : (V,) of each view.
    inner_of_sectors : (8,) on the inner half in each sector about the opening.
    """

    of_views: Array
    inner_of_sectors: Array


def _on_half_circle(
    thickness: float,
    num_cells: int,
    inwards: Array,
    rim: Patch,
    grid: PatchGrid,
    middle: Array,
    information: Information,
) -> _RimInformation | None:
    """Information on the half circle across a wall; None of a wall that is not there.

    Parameters
    ----------
    thickness : of the wall, in cells.
    num_cells : across it, for the half circle.
    inwards : (H, W) distance from the outside of the wall, in cells.
    rim, grid : plane through the top of the wall, and the grid across it.
    middle : (2,), cell in the opening.
    information : (V, F) of each view's phases on the faces of a mesh.
    """
    radius, fine = 0.5 * thickness, grid.at_step(thickness * grid.step / num_cells)
    places = np.indices(fine.shape) * (fine.step / grid.step)
    smooth = ndimage.gaussian_filter(inwards, 1.0, mode="nearest")
    inwards = ndimage.map_coordinates(smooth, places, order=1, mode="nearest")
    across = np.clip(inwards, 0, thickness)
    height = np.sqrt(across * (thickness - across)) - radius
    points = fine.points(rim) + height[..., None] * grid.step * rim.normal
    mesh = height_field(points, (inwards >= 0) & (inwards <= thickness))
    if not len(mesh.faces):
        return None
    cells = grid.cells(mesh.centers)
    inner = ndimage.map_coordinates(smooth, cells.T, order=1) > radius
    sector = _sectors(*(cells - middle).T)
    found = information(mesh)
    of_faces = np.asarray(found.sum(axis=0))
    return _RimInformation(
        np.asarray(found.sum(axis=1)),
        np.bincount(sector[inner], of_faces[inner], NUM_SECTORS).astype(np.float64),
    )


def _sectors(x: Floats, y: Floats, num: int = NUM_SECTORS) -> Indices:
    """Which of a number of sectors about the origin (N,) points lie in."""
    return np.floor((np.arctan2(y, x) / np.pi + 1) * 0.5 * num).astype(np.int64) % num


def _cavity(surface: SurfaceFaces, wall: _Wall, grid: PatchGrid, opening: Opening) -> Cavity | None:
    """The cavity within a wall, below an opening; None if the wall's thickness varies."""
    rim, thickness = wall.rim, wall.thickness
    if thickness <= 1 or wall.sigma > max(TOL.thickness_spread * thickness, 1.0):
        return None
    most = MAX_CELLS // (grid.shape[0] * grid.shape[1])
    lowest = -float(rim.height(surface.centers[surface.supported]).min()) / grid.step
    spacing = max(0.5 * TOL.rounding, lowest / most)
    depths = spacing * np.arange(1, int(np.ceil(lowest / spacing)) + 2, dtype=np.float64)
    insides = _inside_at(surface, rim, grid, depths)
    layers = [wall.top]
    for depth, inside in zip(depths, insides, strict=True):
        if not inside.any():
            break
        below = depth >= wall.start
        free = -_outside(inside) - thickness if below else wall.free(float(depth))
        free = np.minimum(free, layers[-1] + TOL.growth * spacing)
        pieces = ndimage.label(free > 0)[0]
        linked = np.unique(pieces[(layers[-1] > 0) & (pieces > 0)])
        free = np.where((pieces > 0) & ~np.isin(pieces, linked), -0.5, free)
        if not (free > 0).any():
            break
        layers.append(free)
    # The bottom is at least as thick as the wall.
    floor = spacing * len(layers) - thickness - spacing * np.arange(len(layers), dtype=np.float64)
    if floor[0] <= TOL.rounding:
        return None
    cap_height = max(float(rim.height(surface.centers[opening.patch]).max()), 0.0)
    above = int(np.ceil(cap_height / (spacing * grid.step))) + 2
    field = np.minimum(np.stack(layers), floor[:, None, None])
    field = np.concatenate([np.repeat(field[:1], above, axis=0), field])
    field = ndimage.gaussian_filter(field, (0.5, 1.0, 1.0), mode="nearest") * grid.step
    return Cavity(
        rim=rim,
        grid=grid,
        thickness=thickness * grid.step,
        thickness_sigma=wall.sigma * grid.step,
        field=field.astype(np.float32),
        layer_step=spacing * grid.step,
        first_layer=-above,
    )
