"""Planar patches with an offset that no silhouette or phase shows: height steps, lids, recesses.

Phases give normals, which are the same on parallel patches, and a silhouette does not show a
surface inside its outline. Sparse points do: points that share a plane, and whose phases agree with
its normal, show a patch and its offset. The extent of a patch is found on a grid in its plane. At
the right offset, the border and the marks of the patch have the same grid position in all views;
lines on other patches do not. So a line that several views show at the same position is a border.
Beyond the border of a recess, some views show its walls where the patch would be; within it, where
a surface over it would be. So a random walk from a cell (Grady 2006), hampered by lines, ends on
points of the patch, or where the phases of some views contradict either the patch or the given
surface, on the other one. Space above the cells whose walks end on the patch is free: its signed
distance carves the surface. Smoothness does not round the walls that the carving leaves between the
patches.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property, partial
from itertools import compress
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage, sparse
from scipy.sparse.csgraph import breadth_first_order, maximum_flow
from scipy.sparse.linalg import splu
from scipy.spatial import Delaunay, cKDTree

from polmvs.camera import in_frame, sample_image
from polmvs.config import default_num_workers
from polmvs.fitting import geman_mcclure_weights, robust_deviation
from polmvs.geometry import lengths
from polmvs.io.arrays import kept_array
from polmvs.normals.rows import AS_MEASURED, OTHER_LIGHT, Rows, gather_rows, gather_rows_under
from polmvs.normals.tracks import SeedTolerances
from polmvs.polarization.fresnel import fresnel_dolp
from polmvs.polarization.kinds import AngleModel, Light
from polmvs.polarization.light_mixture import LightMixtureTolerances
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import MIN_FACING_COSINE, Seeds
from polmvs.surface.borders import drawn_border, smoothly_beside
from polmvs.surface.creases import CreaseTolerances
from polmvs.surface.mesh_geometry import Box, RayScene, SignedDistance, visible_points
from polmvs.surface.silhouettes import SilhouetteTolerances, nearest_steps, step_slope
from polmvs.surface.surface_view import REFERENCE_FOCAL_PX
from polmvs.surface.terms import TermTolerances

Array = NDArray[np.float64]
Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

NO_PATCH = -1
BESIDE, ACROSS = ((0, 1), (1, 0)), ((1, 1), (1, -1))  # neighbours of a cell: down, right
SPACING = 0.25  # of samples across a border, cells
CUT_UNIT = 10_000  # scale of the weights of a cut, which are integers
MAX_COST = 0.5  # loss beyond which a phase contradicts a patch: that of ``sigmas`` deviations


@dataclass(frozen=True, kw_only=True)
class OffsetTolerances:
    """Tolerances of the search for planar patches and of their borders.

    Attributes
    ----------
    min_points : of a patch. Three always share a plane. The same number of neighbours decides
        whether a point lies among those of another patch.
    num_trials : random triples of points per patch; a patch of a tenth of the points is then missed
        once in 1000 searches. Derived.
    sigmas : largest distance of a point to its patch, and residual of a phase on it, in deviations.
        Derived (99.7 %).
    normal_deg : largest angle between a point's normal and its patch. Guess: several deviations.
    min_normal_sigma_deg : least deviation of the mean of the points' normals (sensor and model, the
        same for all points). Measured on board: 0.2.
    max_cells : of a grid. Memory and time: one solution takes 7 us a cell.
    smoothing_px : of the intensity before its edges are measured.
    dark : least excess brightness of a mark, full scales, and least noise of a difference between
        cells. Derived: one count of 8 bits; synthetic images have less. Not varied.
    view_share : share of the views of a point that must show a line there. About half of the views
        around a convex part see a wall of it. Guess: half of these.
    line_steps : intensity edge, in units of noise, that hampers the walk. Guess.
    mark_px : greatest width of a printed mark, at a focal length of 445 px. Guess.
    mark_contrast : of a mark's intensity to its surroundings. As for the region's marks.
    mark_share : share of the views of a point that must show a mark there. Half of them see a wall
        of a convex part. Measured, 0.5: F at 1 mm of an analytic bracket falls by 0.9 points.
    seed_cells : radius about a sparse point that belongs to its patch; a cell is a GSD. Guess: a
        point's uncertainty.
    end_weight : probability that a walk ends on a cell that two views more, or fewer, contradict on
        the patch than on the given surface, relative to a move. Measured on the carved surfaces of
        `step` and of a box with a recess: twice and half move 0.1 % of the surface.
    seed_weight : probability that a walk ends on a point that it passes, relative to a move. Guess.
    min_total : probability that a walk from a cell ends on the points of any patch. Guess: one in a
        hundred gets through where the phases contradict.
    min_share : share of the views of a point in whose region it must lie. Guess: one view in six
        wrong.
    min_radius_cells : of a patch's area: smaller ones are tangent planes of curved surfaces. Guess.
        A border moves to the lines in a band of this width: every patch has a core. Measured on
        `step`: bands of 8, 12 and 20 give the same corners.
    """

    min_points: int = 4
    num_trials: int = 2000
    sigmas: float = 3.0
    normal_deg: float = 4.0
    min_normal_sigma_deg: float = 0.2
    max_cells: int = 160_000
    smoothing_px: float = 1.0
    dark: float = 1 / 255
    view_share: float = 0.25
    line_steps: float = 4.0
    mark_px: float = 20.0
    mark_contrast: float = 1.5
    mark_share: float = 0.6
    seed_cells: float = 2.0
    end_weight: float = 0.1
    seed_weight: float = 0.2
    min_total: float = 0.01
    min_share: float = 0.84
    min_radius_cells: float = 12.0


TOL = OffsetTolerances()


@dataclass(frozen=True)
class Patch:
    """A planar patch that sparse points show: points x with ``normal . x = offset``.

    Attributes
    ----------
    normal : (3,) unit, towards the cameras.
    offset : world units.
    members : (M,) int64, indices of the seeds on it.
    """

    normal: Array
    offset: float
    members: NDArray[np.int64]

    def height(self, points: Floats) -> Array:
        """Signed distance ``(...)`` of points ``(..., 3)``, positive on the cameras' side."""
        return np.asarray(points @ self.normal - self.offset, np.float64)


@dataclass(frozen=True)
class PatchGrid:
    """A grid of cells perpendicular to a direction; each patch is a height over it.

    Attributes
    ----------
    origin : (3,), position of cell (0, 0) at height 0.
    first, second, axis : (3,) unit, along rows, along columns, and the direction of heights.
    step : side of a cell, world units.
    shape : rows, columns.
    """

    origin: Array
    first: Array
    second: Array
    axis: Array
    step: float
    shape: tuple[int, int]

    def at_step(self, step: float) -> PatchGrid:
        """The grid over the same area with cells of another side."""
        rows, columns = (int(np.ceil(num * self.step / step)) for num in self.shape)
        return replace(self, step=step, shape=(rows, columns))

    def cells(self, points: Floats) -> Array:
        """Row and column ``(..., 2)`` of points ``(..., 3)``, fractional."""
        local = np.asarray(points, np.float64) - self.origin
        return np.stack([local @ self.first, local @ self.second], axis=-1) / self.step

    def rise(self, points: Array) -> Array:
        """Height ``(...)`` of points ``(..., 3)`` over the grid."""
        return np.asarray((points - self.origin) @ self.axis)

    def box_of(self, points: Array) -> Box:
        """The box about those of points ``(N, 3)`` that lie above or below the cells."""
        own = points[in_frame(self.cells(points), *np.array(self.shape) - 1)]
        return tuple(own.min(axis=0).tolist()), tuple(own.max(axis=0).tolist())

    def points(self, patch: Patch) -> Array:
        """Points ``(H, W, 3)`` of a patch over all cells."""
        return self.lifted(np.moveaxis(np.indices(self.shape), 0, -1), patch)

    def lifted(self, cells: Floats | NDArray[np.int64], patch: Patch) -> Array:
        """Points ``(..., 3)`` of a patch over fractional cells ``(..., 2)``."""
        base = self.origin + self.step * (
            cells[..., :1] * self.first + cells[..., 1:] * self.second
        )
        rise = -patch.height(base) / (self.axis @ patch.normal)
        return np.asarray(base + rise[..., None] * self.axis)


@dataclass(frozen=True)
class SteppedPatches:
    """Patches of about one normal, and the cells of a grid where the cameras see each.

    Attributes
    ----------
    patches : by number.
    grid : of the labels.
    labels : (H, W) int64, number of the patch, ``NO_PATCH`` where none is shown.
    shown : (H, W) bool, cells where the views show the patch; next to them its label is extended.
    beside : (G, H, W), signed distance in cells to the cells that are not below each patch,
        negative inside; its border lies between cells.
    """

    patches: tuple[Patch, ...]
    grid: PatchGrid
    labels: NDArray[np.int64]
    shown: Mask
    beside: Image

    def values(self, points: Floats) -> Array:
        """Signed distance ``(N,)`` of points, positive in the free space above the patches.

        Space is free above a patch's own cells, in the direction of the axis. Above cells without a
        patch it is unknown, and the value is negative. The maximum of this and of another shape's
        signed distance is that shape, carved.
        """
        points = np.asarray(points, np.float64)
        cells = np.moveaxis(self.grid.cells(points), -1, 0)
        solid = self._interpolated(self._without_patch, cells)
        for patch, beside in self._borders:
            across = self._interpolated(beside, cells)
            solid = np.minimum(solid, np.maximum(across, patch.height(points)))
        return solid

    @cached_property
    def _without_patch(self) -> Image:
        """Distance to the cells that show no patch."""
        return self._smoothly_beside(self.labels == NO_PATCH)

    @cached_property
    def _borders(self) -> list[tuple[Patch, Image]]:
        """The patches that cells show, with the distance to the cells that are not below each."""
        return [
            (patch, self.grid.step * self.beside[number])
            for number, patch in enumerate(self.patches)
            if (self.labels == number).any()
        ]

    def not_below(self, number: int) -> Mask:
        """Cells (H, W) of a patch, of those above it, and of none.

        A patch continues below those that stand on it: it has no border inside the solid.
        """
        heights = np.stack([self.grid.rise(self.grid.points(patch)) for patch in self.patches])
        at_label = np.take_along_axis(heights, np.maximum(self.labels, 0)[None], axis=0)[0]
        return np.asarray((self.labels == NO_PATCH) | (at_label >= heights[number]))

    def under(self, points: Floats) -> Array:
        """Signed distance ``(N,)`` of points to the solid right under the patches, negative in it.

        It is as deep as borders of patches are uncertain.
        """
        points = np.asarray(points, np.float64)
        cells = np.moveaxis(self.grid.cells(points), -1, 0)
        depth, found = TOL.min_radius_cells * self.grid.step, np.full(len(points), np.inf)
        for patch, beside in self._borders:
            height = patch.height(points)
            within = np.maximum(
                self._interpolated(beside, cells), np.maximum(height, -height - depth)
            )
            found = np.minimum(found, within)
        return found

    def solid(self, points: Floats) -> Array:
        """Signed distance ``(N,)`` of points to the solid on the lowest patch, negative inside.

        The solid below each patch is assumed to reach down to the lowest patch; inf more than two
        cells beside it.
        """
        points = np.asarray(points, np.float64)
        found = np.full(len(points), np.inf)
        cells = np.moveaxis(self.grid.cells(points), -1, 0)
        nearest = np.clip(np.rint(cells), 0, np.array(self.labels.shape)[:, None] - 1).astype(int)
        lowest, *standing = self._by_height
        for patch, beside in standing:
            near = np.flatnonzero(beside[tuple(nearest)] < 2 * self.grid.step)
            across = self._interpolated(beside, cells[:, near])
            above, under = patch.height(points[near]), lowest[0].height(points[near])
            found[near] = np.minimum(found[near], np.maximum(across, np.maximum(above, -under)))
        return found

    @cached_property
    def _by_height(self) -> list[tuple[Patch, Image]]:
        """The patches, the lowest first, with the distance to the cells shown not below each."""
        rise = [float(np.median(self.grid.rise(self.grid.points(own)))) for own in self.patches]
        shown = self._smoothly_beside(self.shown)
        return [
            (self.patches[number], np.maximum(shown, self.grid.step * self.beside[number]))
            for number in np.argsort(rise, kind="stable")
        ]

    def _smoothly_beside(self, inside: Mask) -> Image:
        """Signed distance (H, W) to a set of cells, world units, negative inside."""
        return np.asarray(smoothly_beside(inside) * self.grid.step, np.float32)

    def _interpolated(self, image: Image, cells: Array) -> Array:
        """Values at fractional cells ``(2, N)``; those of the border beyond it."""
        found = ndimage.map_coordinates(image, cells, order=1, mode="nearest")
        return np.asarray(found, np.float64)


def free_spaces(groups: Sequence[SteppedPatches]) -> list[SignedDistance]:
    """Signed distances of points (N, 3), positive in the free space above each group of patches.

    A wall whose border lies some cells too low would cut grooves under the patch at its foot: what
    lies right under the patches of other groups is not free.
    """

    def free(group: SteppedPatches, points: Array) -> Array:
        below = [other.under(points) for other in groups if other is not group]
        return np.asarray(np.minimum.reduce([group.values(points), *below]))

    return [partial(free, group) for group in groups]


def find_patches(seeds: Seeds) -> tuple[Patch, ...]:
    """Planes through seeds whose normals agree with them, the largest number of seeds first.

    Parameters
    ----------
    seeds : sparse points on the part with normals from the phases.

    Returns
    -------
    Patches without common seeds. Points among those of a larger patch but below it are mirror
    images and not a separate patch.
    """
    points, normals = seeds.points_in_world, seeds.normals_in_world
    sigma = np.maximum(seeds.sigma, 1e-12)
    rng = np.random.default_rng(0)
    left: Mask = np.asarray(np.isfinite(normals).all(axis=1) & np.isfinite(points).all(axis=1))
    agree = np.cos(np.radians(TOL.normal_deg))
    patches: list[Patch] = []
    while left.sum() >= TOL.min_points:
        index = np.flatnonzero(left)
        triples = index[rng.integers(0, len(index), (TOL.num_trials, 3))]
        a, b, c = np.moveaxis(points[triples], 1, 0)
        across = np.cross(b - a, c - a)
        length = np.linalg.norm(across, axis=1)
        mean = normals[triples].sum(axis=1)
        across *= np.sign((across * mean).sum(axis=1) / np.maximum(length, 1e-300))[:, None]
        trial = across / np.maximum(length, 1e-300)[:, None]
        aligned = (trial * mean).sum(axis=1) > agree * np.linalg.norm(mean, axis=1)
        # A plane through three points of one mark turns with their noise.
        wide = length > (TOL.sigmas * sigma[triples].max(axis=1)) ** 2
        usable = wide & aligned & (length > 0)
        if not usable.any():
            break
        trial, a = trial[usable], a[usable]
        distance = np.abs(points[index] @ trial.T - (a * trial).sum(axis=1))
        inlier = distance < TOL.sigmas * sigma[index, None]
        inlier &= normals[index] @ trial.T > agree
        members = index[inlier[:, int(inlier.sum(axis=0).argmax())]]
        patch = None
        for _ in range(5):
            if len(members) < TOL.min_points:
                break
            patch = _fitted(seeds, members)
            near = np.abs(patch.height(points[index])) < TOL.sigmas * sigma[index]
            members = index[near & (normals[index] @ patch.normal > agree)]
        if patch is None or len(members) < TOL.min_points:
            break
        patches.append(Patch(patch.normal, patch.offset, members))
        left[members] = False
    return tuple(_without_interlopers(patches, points))


def _fitted(seeds: Seeds, members: NDArray[np.int64]) -> Patch:
    """The plane of most likelihood for the places and the normals of some seeds."""
    points, normals = seeds.points_in_world[members], seeds.normals_in_world[members]
    weight = 1 / np.maximum(seeds.sigma[members], 1e-12) ** 2
    center = weight @ points / weight.sum()
    mean = normals.mean(axis=0)
    mean /= np.linalg.norm(mean)
    normal = mean
    for _ in range(4):
        tangents = np.linalg.svd(normal[None])[2][1:]
        certain = 1 / np.radians(TOL.min_normal_sigma_deg) ** 2
        along = (points - center) @ tangents.T
        matrix = (along * weight[:, None]).T @ along + certain * np.eye(2)
        right = -(along * weight[:, None]).T @ ((points - center) @ normal)
        right += certain * (tangents @ (mean - normal))
        normal = normal + np.linalg.solve(matrix, right) @ tangents
        normal /= np.linalg.norm(normal)
    return Patch(normal, float(normal @ center), members)


def _without_interlopers(patches: Sequence[Patch], points: Array) -> list[Patch]:
    """Patches that are no mirror images in a larger one of like normal.

    What a patch mirrors lies behind it, sideways within its points and scattered among them. A
    patch below that goes on beside the one above lies around its points, the floor of a recess
    apart.
    """
    kept: list[Patch] = []
    for patch in patches:
        mirrors = [
            other
            for other in kept
            if patch.normal @ other.normal > np.cos(np.radians(CreaseTolerances.crease_deg))
            and np.median(other.height(points[patch.members])) < 0
        ]
        if mirrors:
            tangents = np.linalg.svd(patch.normal[None])[2][1:]
            own = points[patch.members] @ tangents.T
            others = np.concatenate([points[other.members] for other in mirrors]) @ tangents.T
            within = Delaunay(others, qhull_options="QJ").find_simplex(own) >= 0
            tree = cKDTree(np.concatenate([own, others]))
            num = min(TOL.min_points + 1, len(own) + len(others))
            near = np.atleast_2d(tree.query(own, num)[1])
            if np.mean(within) > 0.5 and np.mean(near[:, 1:] < len(own)) < 0.5:
                continue
        kept.append(patch)
    return kept


@dataclass(frozen=True)
class PatchGroup:
    """Parallel patches over a grid, and what the views show on them, whatever the surface is.

    Attributes
    ----------
    patches, grid : as of :class:`SteppedPatches`.
    scene : the views.
    to_points : (G, H, W) distance in cells to the points of each patch.
    """

    patches: tuple[Patch, ...]
    grid: PatchGrid
    scene: PatchScene
    to_points: Array

    @cached_property
    def places(self) -> list[Array]:
        """Points ``(H, W, 3)`` of each patch over the cells."""
        return [self.grid.points(patch) for patch in self.patches]

    @cached_property
    def rise(self) -> Array:
        """(G, H, W) of each patch over the grid."""
        return np.stack([self.grid.rise(place) for place in self.places])

    @cached_property
    def losses(self) -> list[Image]:
        """Loss (K, H, W) of the rows on each patch."""
        return [self.scene.losses_on(*own) for own in zip(self.places, self.patches, strict=True)]

    @cached_property
    def near_points(self) -> Mask:
        """(G, H, W) bool, where edges may be those of the printed marks of a patch."""
        return np.asarray(self.to_points < 0.5 * TOL.mark_px)

    @cached_property
    def unhidden(self) -> list[PatchEvidence]:
        """Evidence for each patch as if no other hid it."""
        return [self.evidence(number, None) for number in range(len(self.patches))]

    def evidence(self, number: int, labels: NDArray[np.int64] | None) -> PatchEvidence:
        """Evidence for a patch that the others hide where the labels (H, W) are theirs."""
        patch, places, maps = self.patches[number], self.places[number], self.scene.maps
        hidden = None
        if labels is not None:
            hidden = _hidden(number, self.patches, places, self.grid, labels, maps)
        near = self.near_points[number]
        return patch_evidence(places, patch, self.scene, self.losses[number], near, hidden)


def patch_groups(
    patches: Sequence[Patch], seeds: Seeds, scene: PatchScene
) -> tuple[PatchGroup, ...]:
    """Groups of parallel patches, over grids of what the views show.

    Parameters
    ----------
    patches : from :func:`find_patches`.
    seeds : their members.
    scene : the views.
    """
    found = []
    for group in _grouped(patches):
        points = seeds.points_in_world[np.concatenate([patch.members for patch in group])]
        grid = _grid_over(group, points, scene.maps, _gsd(points, scene.maps))
        if grid is not None:
            cells = [grid.cells(seeds.points_in_world[patch.members]) for patch in group]
            to_points = np.stack([_distance_to(own, grid.shape) for own in cells])
            found.append(PatchGroup(tuple(group), grid, scene, to_points))
    return tuple(found)


def stepped_patches(
    groups: Sequence[PatchGroup], *, surface: RayScene | None = None, is_refined: bool = False
) -> tuple[SteppedPatches, ...]:
    """The patches of each group with their extents, where a surface does not explain more phases.

    Parameters
    ----------
    groups : from :func:`patch_groups`.
    surface : what the patches carve; it remains where fewer views contradict it. None: unknown.
    is_refined : the surface has the object's normals, so where more views contradict it than a
        patch, this speaks for the patch; of a hull it does not.
    """
    found = []
    for group in groups:
        labels, shown = _labels(group, surface, is_refined)
        if (labels != NO_PATCH).any():
            num, grid = len(group.patches), group.grid
            not_drawn = np.zeros((num, *grid.shape), np.float32)
            steps = SteppedPatches(group.patches, grid, labels, shown, not_drawn)
            beside = [_border(steps, number, group.scene) for number in range(num)]
            found.append(replace(steps, beside=np.stack(beside)))
    return tuple(found)


def _border(steps: SteppedPatches, number: int, scene: PatchScene) -> Image:
    """Signed distance (H, W) in cells to the border of a patch with lower ones, negative inside."""
    inside, own = steps.not_below(number), steps.labels == number
    return border_of_steps(inside, own, steps.patches[number], steps.grid, scene)


def border_of_steps(
    inside: Mask,
    own: Mask,
    patch: Patch,
    grid: PatchGrid,
    scene: PatchScene,
) -> Image:
    """Signed distance (H, W) in cells to the border of a region on a patch, negative inside.

    Labels also follow lines of polarization, which the smoothing of phases moves outwards. The
    border is the nearest intensity edge that the views show together.

    Parameters
    ----------
    inside : (H, W) bool, the region.
    own : (H, W) bool, cells where the border may move.
    patch, grid : of the region.
    scene : the views.
    """
    is_border = inside & ndimage.binary_dilation(~inside)
    if not (is_border & own).any():
        return smoothly_beside(inside).astype(np.float32)
    nearest = ndimage.distance_transform_edt(
        ~is_border, return_distances=False, return_indices=True
    )
    reach = SilhouetteTolerances.edge_reach_px + 1
    along = np.arange(-reach, reach + SPACING, SPACING)

    def across(curve: Array, normals: Array) -> tuple[Array, Array]:
        last = np.array(grid.shape) - 1
        cell = np.clip(np.rint(curve), 0, last).astype(np.int64)
        is_own = own[tuple(nearest[:, cell[:, 0], cell[:, 1]])] & in_frame(curve, *last)
        places = grid.lifted(curve[:, None] + normals[:, None] * along[:, None], patch)
        steepness, num_views = np.zeros(places.shape[:2]), np.zeros(len(curve))
        for phase_map, images in zip(scene.maps, scene.features, strict=True):
            xy, seen = _seen(places, patch, phase_map)
            values = sample_image(np.asarray(images), xy)
            shown = is_own & np.all(seen & (values[..., 3] == 1), axis=1)  # and no printed mark
            if shown.any():
                slope = step_slope(values[shown, :, 0]) / SPACING
                steepness[shown] += slope / max(robust_deviation(slope), TOL.dark)
                num_views += shown
        found, height = nearest_steps(steepness / np.maximum(num_views[:, None], 1), along, 1.0)
        return found, np.where(is_own, np.clip(height - 1, 0, 1), np.nan)

    return drawn_border(inside, across).astype(np.float32)


def _grouped(patches: Sequence[Patch]) -> list[list[Patch]]:
    groups: list[list[Patch]] = []
    for patch in patches:
        for group in groups:
            if patch.normal @ group[0].normal > np.cos(np.radians(CreaseTolerances.crease_deg)):
                group.append(patch)
                break
        else:
            groups.append([patch])
    return groups


def _gsd(points: Array, maps: Sequence[PhaseMap]) -> float:
    """Length that a pixel covers at the points, median over the views."""
    center = np.median(points, axis=0)
    return float(
        np.median(
            [
                np.linalg.norm(m.view.center_in_world - center) / m.view.camera.mean_focal_px
                for m in maps
            ]
        )
    )


def _grid_over(
    group: Sequence[Patch],
    points: Array,
    maps: Sequence[PhaseMap],
    gsd: float,
) -> PatchGrid | None:
    """A grid over all that the views' regions show in the plane of the group's largest patch."""
    patch = group[0]
    tangents = np.linalg.svd(patch.normal[None])[2][1:]
    first, second = tangents[0], np.cross(patch.normal, tangents[0])
    center = points.mean(axis=0)
    low, high = np.full((len(maps), 2), np.nan), np.full((len(maps), 2), np.nan)
    for k, phase_map in enumerate(maps):
        rows, cols = np.nonzero(phase_map.region.inside[::4, ::4])
        if not len(rows):
            continue
        xy = np.stack([4.0 * cols + 0.5, 4.0 * rows + 0.5], axis=1)
        rays = phase_map.view.camera.rays(xy) @ phase_map.view.cam_from_world.rotation
        origin = phase_map.view.center_in_world
        with np.errstate(divide="ignore", invalid="ignore"):
            distance = -patch.height(origin) / (rays @ patch.normal)
        hit = np.isfinite(distance) & (distance > 0) & (rays @ patch.normal < -MIN_FACING_COSINE)
        if hit.any():
            local = origin + distance[hit, None] * rays[hit] - center
            place = np.stack([local @ first, local @ second], axis=1)
            low[k], high[k] = place.min(axis=0), place.max(axis=0)
    if np.isfinite(low).all(axis=1).sum() < 2:
        return None
    # A region may reach the horizon in one view: cells that half of the views show are enough.
    own = np.stack([(points - center) @ first, (points - center) @ second], axis=1)
    margin = TOL.min_radius_cells * gsd
    start = np.minimum(np.nanmedian(low, axis=0), own.min(axis=0)) - margin
    size = np.maximum(np.nanmedian(high, axis=0), own.max(axis=0)) + margin - start
    step = max(gsd, float(np.sqrt(np.prod(size) / TOL.max_cells)))
    rows_cols = np.ceil(size / step).astype(np.int64) + 1
    origin = center + start[0] * first + start[1] * second
    return PatchGrid(
        origin, first, second, patch.normal, step, (int(rows_cols[0]), int(rows_cols[1]))
    )


@dataclass(frozen=True)
class PatchScene:
    """Phase maps, the model of their rows, and the images (H, W, 4) whose edges show borders.

    The images may be on disk: ``np.asarray`` converts them to arrays.
    """

    maps: Sequence[PhaseMap]
    angle_model: AngleModel
    tilt_aware: bool
    features: Sequence[ArrayLike]

    def of(self, kept: Mask) -> PatchScene:
        """The same for some of the views, ``(K,)`` bool."""
        maps, features = list(compress(self.maps, kept)), list(compress(self.features, kept))
        return replace(self, maps=maps, features=features)

    def rows(self, points: Array) -> Rows:
        """Rows of points ``(N, 3)``."""
        return gather_rows(self.angle_model, points, self.maps, tilt_aware=self.tilt_aware)

    def losses(self, points: Array, normals: Floats) -> Image:
        """Loss (K, N) of the rows of points, as :func:`row_losses`, under the light that fits.

        A glossy plate shows diffuse light where it mirrors something dark, such as a wall on it.
        """

        def of_view(one: PhaseMap) -> Image:
            measured, other = gather_rows_under(
                (AS_MEASURED, OTHER_LIGHT),
                self.angle_model,
                points,
                [one],
                tilt_aware=self.tilt_aware,
            )
            loss, cosine = row_losses(measured, normals)
            may_be_other = _may_be_diffuse(one, points, cosine)
            return np.where(may_be_other, np.fmin(loss, row_losses(other, normals)[0]), loss)

        # Threads, as sampling images releases Python's lock; each holds one view's rows.
        with ThreadPoolExecutor(default_num_workers()) as pool:
            return np.concatenate(list(pool.map(of_view, self.maps)))

    def losses_on(self, places: Array, patch: Patch) -> Image:
        """Loss (K, H, W) of the rows of points ``(H, W, 3)`` on a patch."""
        losses = self.losses(places.reshape(-1, 3), patch.normal[:, None])
        return losses.reshape(-1, *places.shape[:2])


def patch_scene(
    maps: Sequence[PhaseMap],
    angle_model: AngleModel,
    *,
    tilt_aware: bool = True,
    folder: Path | None = None,
) -> PatchScene:
    """The scene for planar patches, from the views' phase maps; stored in a folder or in memory.

    ``angle_model`` and ``tilt_aware`` are as in :func:`polmvs.normals.rows.gather_rows`.
    """

    def features_of(one: PhaseMap) -> ArrayLike:
        path = folder and folder / f"{one.view.name}.features.npy"
        return kept_array(_features(one), path)

    with ThreadPoolExecutor(default_num_workers()) as pool:
        features = list(pool.map(features_of, maps))
    return PatchScene(maps, angle_model, tilt_aware, features)


def _may_be_diffuse(phase_map: PhaseMap, points: Array, cosine: Floats) -> Mask:
    """Whether the DoLP that a view shows at points (N, 3) is possible for diffuse light.

    ``cosine`` (..., N) is that of the angle between normal and direction to the camera.
    """
    xy = phase_map.view.project(points)
    axial = sample_image(phase_map.samples[..., :2], xy)
    bound = fresnel_dolp(np.clip(cosine, 0, 1), Light.DIFFUSE, LightMixtureTolerances.max_ior)
    return np.asarray(lengths(axial) < bound + LightMixtureTolerances.dolp_margin)


@dataclass(frozen=True)
class PatchEvidence:
    """Evidence of the views for a patch at the cells of a grid.

    ``jump`` (H, W): intensity edges in units of noise that a share of the views exceeds;
    ``num_phases`` (H, W): number of views with a phase there;
    ``misfit`` (H, W): sum of their robust losses, about the number of views that contradict it;
    ``possible`` (H, W): whether the views show the part there.
    """

    jump: Image
    num_phases: Image
    misfit: Image
    possible: Mask


def _labels(
    group: PatchGroup, surface: RayScene | None, is_refined: bool
) -> tuple[NDArray[np.int64], Mask]:
    """Number of the patch at each cell, ``NO_PATCH`` where there is none, and where it is shown."""
    grid, num, rise = group.grid, len(group.patches), group.rise
    of_surface = _surface_misfit(grid, rise.max(axis=0), group.scene, surface)
    labels, shown = np.full(grid.shape, NO_PATCH), np.zeros(grid.shape, np.bool_)
    # Occlusion between patches needs labels: a second pass uses those of the first.
    for count in range(min(num, 2)):
        of_patches = group.unhidden
        if count:
            of_patches = [group.evidence(number, labels) for number in range(num)]
        possible = np.stack([evidence.possible for evidence in of_patches])
        excess = _excess(group, of_patches, possible, of_surface, is_refined)
        claims_of = partial(_claim, group.to_points)
        with ThreadPoolExecutor(default_num_workers()) as pool:
            claims = np.stack(list(pool.map(claims_of, range(num), of_patches, excess)))
        # The other walks end on the refined surface. Without one, a cell far from few points has a
        # small probability of reaching them, but belongs to the patch if no other can be there.
        total = 1.0 if is_refined else claims.sum(axis=0)
        claimed = (claims.max(axis=0) > 0.5 * total) & (claims.sum(axis=0) > TOL.min_total)
        labels = np.where(claimed, claims.argmax(axis=0), NO_PATCH)
        labels = _without_small(labels, num)
        # The lowest patch ends where others stand on it; there their own borders count.
        for number in np.argsort(np.median(rise.reshape(num, -1), axis=1))[1:]:
            labels = snapped_border(
                labels, int(number), of_patches[number].jump, TOL.min_radius_cells, TOL.line_steps
            )
        # By something that the patches do not explain.
        fits = possible & (excess < 1)
        taken = possible.any(axis=0) & ~fits.any(axis=0)
        taken = ndimage.binary_opening(taken, iterations=2)
        labels = np.where(taken, NO_PATCH, labels)
        shown = labels != NO_PATCH
        labels = _continued(labels, fits | ~possible.any(axis=0), taken)
    return np.asarray(labels, np.int64), np.asarray(shown, np.bool_)


def _excess(
    group: PatchGroup,
    of_patches: Sequence[PatchEvidence],
    possible: Mask,
    of_surface: Image,
    is_refined: bool,
) -> Array:
    """How many views more contradict each patch (G, H, W) than what else may be there.

    That is a refined surface. Over a hull it is also a parallel patch, except near points of the
    patch itself, whose print has phases of its own, or what contradicts half of the views.
    ``possible`` (G, H, W) are the cells where views show a patch; ``of_surface`` (H, W) contradict
    the given surface, NaN where there is none.
    """
    misfit = np.stack([one.misfit for one in of_patches]).astype(np.float64)
    num_phases = np.stack([one.num_phases for one in of_patches])
    # Patches are seen by different numbers of views.
    share = np.where(possible, misfit / np.maximum(num_phases, 1), np.nan)
    normals = np.stack([patch.normal for patch in group.patches])
    parallel = normals @ normals.T > np.cos(np.radians(TOL.normal_deg))
    np.fill_diagonal(parallel, False)
    others = np.stack([np.fmin.reduce(share[own], axis=0, initial=MAX_COST) for own in parallel])
    others[group.near_points] = MAX_COST
    # Normals of a hull are not those of the object: it cannot speak for a patch.
    against = np.maximum(misfit - np.fmin(of_surface, others * num_phases), 0)
    if is_refined:
        against = np.where(np.isnan(of_surface), against, misfit - of_surface)
    return np.asarray(against)


def snapped_border(
    labels: NDArray[np.int64], number: int, jump: Array, reach: float, line_steps: float
) -> NDArray[np.int64]:
    """Labels (H, W) with the border of one patch moved to the lines near it.

    It is the minimum cut in a band of ``reach`` cells on both sides of the border, through cells
    that a walk hardly crosses. It follows a line around its corners, which a walk rounds off.
    """
    own = labels == number
    core = ndimage.distance_transform_edt(own) > reach
    rest = ndimage.distance_transform_edt(~own) > reach
    if not core.any() or not rest.any():
        return labels
    band = ~core & ~rest
    num = int(band.sum())
    node = np.where(core, num, num + 1)
    node[band] = np.arange(num)
    steps = [_steps_between(jump, *direction) for direction in (*BESIDE, *ACROSS)]
    tails, heads, between = (np.concatenate(part) for part in zip(*steps, strict=True))
    of_direction = [1.0] * len(BESIDE) + [np.sqrt(0.5)] * len(ACROSS)
    length = np.repeat(of_direction, [len(step[0]) for step in steps])
    ends = node.ravel()[np.stack([tails, heads])]
    inner = ends[0] != ends[1]
    # It falls so slowly that the middle of a wide line still outweighs a short cut.
    weight = length / (1 + between / line_steps)
    capacity = np.rint(CUT_UNIT * weight[inner]).astype(np.int32)  # integers
    pairs = np.concatenate([ends[:, inner], ends[::-1, inner]], axis=1)
    both = np.concatenate([capacity, capacity])
    graph = sparse.csr_matrix((both, (pairs[0], pairs[1])), shape=(num + 2, num + 2))
    left = graph - maximum_flow(graph, num, num + 1).flow
    left.data[left.data < 0] = 0
    left.eliminate_zeros()
    is_reached = np.zeros(num + 2, np.bool_)
    is_reached[breadth_first_order(left, num, return_predecessors=False)] = True
    inside = is_reached[node]
    others = np.where(own, NO_PATCH, labels)
    nearest = ndimage.distance_transform_edt(own, return_distances=False, return_indices=True)
    given_back = others[tuple(nearest)]
    return np.where(inside, number, np.where(own, given_back, labels))


def _continued(labels: NDArray[np.int64], allowed: Mask, taken: Mask) -> NDArray[np.int64]:
    """Labels extended to free cells nearby, over cells where they are ``allowed`` (G, H, W).

    Next to a patch, where the views show no part, a label cannot carve wrongly; but the given
    surface may have a margin there as wide as the uncertainty of the silhouettes.
    """
    known = labels != NO_PATCH
    if not known.any():
        return labels
    distance, nearest = ndimage.distance_transform_edt(~known, return_indices=True)
    carried = labels[tuple(nearest)]
    free = np.take_along_axis(allowed, carried[None], axis=0)[0] & ~taken
    near = free & (distance <= TOL.min_radius_cells)
    return np.where(ndimage.binary_propagation(known, mask=known | near), carried, NO_PATCH)


def _features(phase_map: PhaseMap) -> Image:
    """Images (H, W, 4): root of intensity, polarization (2), and 1 off printed marks.

    The first three show borders by their edges. A mark is smaller than ``mark_px``, brighter than
    its surroundings, and less polarized.
    """
    intensity = np.asarray(phase_map.intensity, np.float32)
    scale = phase_map.view.camera.mean_focal_px / REFERENCE_FOCAL_PX
    size = 2 * round(0.5 * TOL.mark_px * scale) + 1
    about = cv2.morphologyEx(
        cv2.GaussianBlur(intensity, (0, 0), TOL.smoothing_px),
        cv2.MORPH_OPEN,
        cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size)),
    )
    dolp = np.hypot(phase_map.samples[..., 0], phase_map.samples[..., 1])
    dull = phase_map.lowest_dolp < 255 * SeedTolerances.max_dolp_share * dolp
    mark = dull & (intensity > TOL.mark_contrast * about + TOL.dark)
    kernel = np.ones((2 * round(2 * TOL.smoothing_px) + 1,) * 2, np.uint8)  # its smoothed outline
    on_mark = cv2.dilate(mark.astype(np.uint8), kernel)
    # The root has uniform photon noise; an edge that is smoothed after it keeps its position.
    root = cv2.GaussianBlur(np.sqrt(np.maximum(intensity, 0)), (0, 0), TOL.smoothing_px)
    samples = phase_map.samples[..., :2]
    return np.dstack([root, samples, 1 - on_mark]).astype(np.float32)


def row_losses(rows: Rows, normals: Floats) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Loss in [0, 1] of each row (K, N), NaN where it is not used, and cosines to the views.

    A row is used if it would contradict at least half of all phases; others agree with anything.

    Parameters
    ----------
    rows : of N points.
    normals : (3, 1) or (3, N).
    """
    normals = np.asarray(normals, np.float32)
    cosine = -(rows.rays * normals[:, None]).sum(axis=0)
    residual = (rows.rows * normals[:, None]).sum(axis=0)
    with np.errstate(invalid="ignore"):
        # Half of what a curved mesh leaves unexplained: a plane has no discretization error.
        floor = np.float32((0.5 * TermTolerances.row_sigma) ** 2)
        variance = (1 - cosine**2) * np.square(rows.sigma) + floor
        z2 = np.square(residual) / (variance * np.float32(TOL.sigmas**2))
        loss = z2 / (1 + z2)
    # The median residual of a random phase is sin 45 deg.
    informative = rows.sigma < np.sqrt(0.5) / TOL.sigmas
    counts = informative & (cosine > MIN_FACING_COSINE)
    return np.where(counts, loss, np.nan).astype(np.float32), cosine


def patch_evidence(
    places: Array,
    patch: Patch,
    scene: PatchScene,
    losses: Image,
    near_points: Mask,
    hidden: Sequence[Mask] | None = None,
) -> PatchEvidence:
    """Evidence of the views for a patch at points ``(H, W, 3)`` on it.

    Parameters
    ----------
    places, patch : the patch over a grid.
    scene : the views.
    losses : (K, H, W) of :meth:`PatchScene.losses_on`.
    near_points : (H, W) bool, where edges may be those of printed marks.
    hidden : for each view, points ``(H, W)`` that it does not see; None: it sees all.
    """
    shape = places.shape[:2]
    own, jumps = np.full((2, *losses.shape), np.nan, np.float32)
    inside, num_seen, num_marks = np.zeros((3, *shape))

    def of_view(k: int) -> tuple[Mask, Mask, Mask]:
        xy, seen = _seen(places, patch, scene.maps[k])
        if hidden is not None:
            seen &= ~hidden[k]
        shown = seen & scene.maps[k].shows_surface(xy)
        own[k] = np.where(shown, losses[k], np.nan)
        jumps[k], marks = _line_steps(scene.features[k], xy, shown)
        return seen, shown, marks

    with ThreadPoolExecutor(default_num_workers()) as pool:
        for seen, shown, marks in pool.map(of_view, range(len(scene.maps))):
            num_seen += seen
            inside += shown
            num_marks += marks
    # A print on the patch is a mark in all views; a print on a wall beside it has another position
    # in each.
    printed = near_points & (num_marks > TOL.mark_share * inside)
    jumps[:, printed] = np.nan
    possible = (num_seen >= 2) & (inside >= TOL.min_share * num_seen)
    return PatchEvidence(
        jump=_shared_lines(jumps, TOL.view_share),
        num_phases=np.isfinite(own).sum(axis=0).astype(np.float32),
        misfit=np.nansum(own, axis=0),
        possible=possible,
    )


def patch_lines(places: Array, patch: Patch, scene: PatchScene, view_share: float) -> Image:
    """Edges (H, W) in units of noise that a share of the views shows at points (H, W, 3)."""

    def of_view(phase_map: PhaseMap, images: ArrayLike) -> Image:
        return _line_steps(images, *_seen(places, patch, phase_map))[0]

    with ThreadPoolExecutor(default_num_workers()) as pool:
        jumps = np.stack(list(pool.map(of_view, scene.maps, scene.features)))
    return _shared_lines(jumps, view_share)


def _seen(places: Array, patch: Patch, phase_map: PhaseMap) -> tuple[Image, Mask]:
    """Pixels (H, W, 2) of points on a patch, and whether the view can see them."""
    view = phase_map.view
    xy = np.asarray(view.camera.project(view.cam_from_world * places))
    seen = in_frame(xy, view.camera.width, view.camera.height, 1)
    return xy.astype(np.float32), np.asarray(seen & view.faces(places, patch.normal))


def _line_steps(images: ArrayLike, xy: Image, shown: Mask) -> tuple[Image, Mask]:
    """Edges (H, W) of one view's images, NaN where it shows nothing, and where it shows a mark."""
    values = sample_image(np.asarray(images), xy)
    steps = np.where(shown, _steps(values[..., :3], shown), np.nan)
    return steps.astype(np.float32), np.asarray(shown & (values[..., 3] < 1))


def _shared_lines(jumps: Image, view_share: float) -> Image:
    """Edges (H, W) that a share of the views (K, H, W) exceeds."""
    count = np.isfinite(jumps).sum(axis=0)
    ordered = -np.sort(-np.nan_to_num(jumps, nan=-1.0), axis=0)
    rank = np.floor(view_share * np.maximum(count - 1, 0)).astype(np.int64)
    jump = np.take_along_axis(ordered, rank[None], axis=0)[0]
    return np.asarray(np.maximum(jump, 0), np.float32)


def median_loss(losses: Image) -> Image:
    """Median (H, W) over the first axis without NaN; 1 where all are."""
    count = np.isfinite(losses).sum(axis=0)
    ordered = np.sort(np.where(np.isfinite(losses), losses, 2.0), axis=0)
    middle = np.take_along_axis(ordered, np.maximum((count - 1) // 2, 0)[None], axis=0)[0]
    return np.where(count > 0, middle, 1.0).astype(np.float32)


def _steps(values: Image, shown: Mask) -> Image:
    """Edges (H, W) of images (H, W, C) over the cells, each in units of its own noise."""
    total = np.zeros(shown.shape, np.float32)
    well = ndimage.binary_erosion(shown, border_value=0)
    if not well.any():
        return total
    for channel in np.moveaxis(values, -1, 0):
        step = np.hypot(*np.gradient(channel))
        scale = max(robust_deviation(step[well]), TOL.dark)
        total = np.maximum(total, np.where(well, step / scale, 0)).astype(np.float32)
    return total


def _surface_misfit(
    grid: PatchGrid, top: Array, scene: PatchScene, surface: RayScene | None
) -> Image:
    """Sum of the losses (H, W) of the phases on a surface above the cells; NaN without one."""
    misfit = np.full(grid.shape, np.nan, np.float32)
    if surface is None:
        return misfit
    rows, cols = np.indices(grid.shape)
    far = float(max(grid.shape) * grid.step)
    start = grid.origin + grid.step * (rows[..., None] * grid.first + cols[..., None] * grid.second)
    start = (start + (top[..., None] + far) * grid.axis).reshape(-1, 3)
    hits = surface.cast(start, np.broadcast_to(-grid.axis, start.shape))
    hit = np.isfinite(hits.distance)
    points = start[hit] - np.asarray(hits.distance, np.float64)[hit, None] * grid.axis
    normals = surface.mesh.face_normals[hits.face[hit]]
    losses = scene.losses(points, normals.T)
    seen = np.zeros(losses.shape, np.bool_)
    for own, phase_map in zip(seen, scene.maps, strict=True):
        center = phase_map.view.center_in_world
        own[visible_points(surface, center, points, normals, min_cosine=MIN_FACING_COSINE)[0]] = 1
    misfit[np.reshape(hit, grid.shape)] = np.nansum(losses, axis=0, where=seen)
    return misfit


def _hidden(
    number: int,
    group: Sequence[Patch],
    places: Array,
    grid: PatchGrid,
    labels: NDArray[np.int64],
    maps: Sequence[PhaseMap],
) -> list[Mask]:
    """For each view, the cells (H, W) of a patch that other labelled patches of the group hide."""
    hidden = []
    size = np.array(grid.shape)
    for phase_map in maps:
        covered = np.zeros(grid.shape, np.bool_)
        center = phase_map.view.center_in_world
        away = places - center
        for other, patch in enumerate(group):
            if other == number or not (labels == other).any():
                continue
            with np.errstate(divide="ignore", invalid="ignore"):
                share = -patch.height(center) / (away @ patch.normal)
            between = (share > 0) & (share < 1)
            meeting = center + np.where(between, share, 0.0)[..., None] * away
            cell = np.rint(grid.cells(meeting)).astype(np.int64)
            on_grid = between & in_frame(cell, *(size - 1))
            cell = np.clip(cell, 0, size - 1)
            covered |= on_grid & (labels[cell[..., 0], cell[..., 1]] == other)
        hidden.append(covered)
    return hidden


def _claim(to_points: Array, number: int, evidence: PatchEvidence, excess: Array) -> Array:
    """Probability (H, W) that a walk from a cell, hampered by lines, ends on a patch.

    It ends on points of the patch or of others, or where ``excess`` (H, W) is beyond one view: on
    the given surface if it is positive, on the patch if it is negative. ``to_points`` (G, H, W) are
    the distances in cells to the points of each patch.
    """
    possible, own = evidence.possible, to_points[number]
    others = np.delete(to_points, number, axis=0).min(axis=0, initial=np.inf)
    starts = (own < TOL.seed_cells) & (own < others) & possible
    ends = (others < TOL.seed_cells) & (others < own) & possible
    if not starts.any():
        return np.zeros(own.shape)
    adjacency, degree = _walk(evidence.jump.astype(np.float64))
    # A walk may end on any point that it passes, so a single false point does not decide.
    ending = TOL.seed_weight * (starts | ends).ravel()
    contradicted = TOL.end_weight * np.clip(excess.ravel() - 1, 0, 1)
    supported = TOL.end_weight * np.clip(-excess.ravel() - 1, 0, 1)
    free = np.flatnonzero(possible)
    right = TOL.seed_weight * starts.ravel() + supported
    total = degree + ending + contradicted + supported + 1e-9
    claim = np.zeros(starts.size)
    claim[free] = _solved(adjacency[free][:, free], total[free], right[free])
    return np.asarray(claim.reshape(own.shape))


def _steps_between(
    jump: Array, down: int, right: int
) -> tuple[NDArray[np.int64], NDArray[np.int64], Array]:
    """Neighbours (E,) and (E,) in a direction, and the edge of the image (E,) between them."""
    cells = np.arange(jump.size).reshape(jump.shape)
    rows, cols = jump.shape[0] - down, jump.shape[1] - abs(right)
    tails = cells[:rows, max(-right, 0) :][:, :cols].ravel()
    heads = cells[down:, max(right, 0) :][:, :cols].ravel()
    # The edge is where both cells show it, not on either side of them.
    return tails, heads, 0.5 * (jump.ravel()[tails] + jump.ravel()[heads])


def _walk(jump: Array) -> tuple[sparse.csr_array, Array]:
    """Weights of moves between neighbouring cells ``(H W, H W)``, and their sums."""
    steps = [_steps_between(jump, *direction) for direction in BESIDE]
    tails, heads, between = (np.concatenate(part) for part in zip(*steps, strict=True))
    weight = geman_mcclure_weights(between, TOL.line_steps**2)
    pairs = (np.concatenate([tails, heads]), np.concatenate([heads, tails]))
    both = np.concatenate([weight, weight])
    adjacency = sparse.coo_array((both, pairs), shape=(jump.size, jump.size)).tocsr()
    return adjacency, np.asarray(adjacency.sum(axis=1)).ravel()


def _solved(adjacency: sparse.csr_array, degree: Array, right: Array) -> Array:
    """Solution of ``(diag(degree) - adjacency) x = right``."""
    factors = splu(
        sparse.csc_array(sparse.diags_array(degree) - adjacency),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    return np.asarray(factors.solve(right))


def _distance_to(cells: Array, shape: tuple[int, int]) -> Array:
    """Distance (H, W) in cells to the nearest of some points, fractional cells ``(M, 2)``."""
    mask = np.ones(shape, np.bool_)
    place = np.rint(cells).astype(np.int64)
    place = place[((place >= 0) & (place < shape)).all(axis=1)]
    mask[tuple(place.T)] = False
    if mask.all():
        return np.full(shape, np.inf)
    return np.asarray(ndimage.distance_transform_edt(mask), np.float64)


def _without_small(labels: NDArray[np.int64], num_patches: int) -> NDArray[np.int64]:
    """Labels in which pieces smaller than a disc of ``min_radius_cells`` become ``NO_PATCH``."""
    least = np.pi * TOL.min_radius_cells**2
    kept = labels.copy()
    for number in range(num_patches):
        pieces, num = ndimage.label(labels == number)
        if num:
            small = np.bincount(pieces.ravel()) < least
            small[0] = False
            kept[small[pieces]] = NO_PATCH
    return kept
