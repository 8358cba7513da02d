"""Several planes in one phase map: RANSAC on pairs of rows, then the robust estimator.

The search runs on averages over blocks of pixels: their noise is low enough for a normal from two
rows. After a plane is found, the remaining blocks are searched again. Finally each block is
assigned to the plane that best explains it and its neighbours.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Floats, Mask
from polmvs.normals.single_view.plane import (
    PlaneEstimate,
    PlaneTolerances,
    phase_errors,
    phase_residuals,
    plane_normal,
    stack_samples,
)
from polmvs.polarization.angle_models import rows_from_axial
from polmvs.polarization.kinds import AngleModel

BLOCK_PX = 4


@dataclass(frozen=True, kw_only=True)
class PlaneSearchTolerances:
    """Tolerances of the search for planes.

    Attributes
    ----------
    num_hypotheses : pairs of rows per plane. Guess.
    num_scored : blocks for their scores. Guess; time only.
    num_refined : best hypotheses that are refined. Guess.
    coherence_blocks : side of the window in which most blocks must agree. Guess.
    coherent_share : of that window. Derived: the majority, with a margin.
    model_sigma : rad; error of a block's phase that does not average out. Guess.
    min_share : least support of a plane, share of the mask. Guess.
    max_planes : largest number of planes. Guess; time only.
    max_residual_deg : of a block that supports a plane, beyond three times its noise. Guess.
    min_angle_deg : between the normals of two planes; with less they are the same plane under light
        that the model does not explain. Guess.
    """

    num_hypotheses: int = 400
    num_scored: int = 2000
    num_refined: int = 8
    coherence_blocks: int = 5
    coherent_share: float = 0.6
    model_sigma: float = 0.01
    min_share: float = 0.04
    max_planes: int = 8
    max_residual_deg: float = 3.0
    min_angle_deg: float = 5.0


TOL = PlaneSearchTolerances()


@dataclass(frozen=True, kw_only=True, eq=False)
class FoundPlane:
    """One of the planes of a view.

    Attributes
    ----------
    estimate : normal and quality, from the pixels of ``mask``.
    mask : (H, W) bool, its pixels; several areas if there are parallel planes.
    """

    estimate: PlaneEstimate
    mask: Mask


@dataclass(frozen=True, eq=False)
class _Blocks:
    """Averages over blocks; (H', W') maps of what counts, arrays of the blocks that do.

    ``limit`` (H', W') is the residual of a block that supports a plane, ``min_blocks`` the least
    support there is.
    """

    angle_model: AngleModel
    known: Mask
    axial: Floats
    rays: Floats
    sigma: Floats

    @cached_property
    def limit(self) -> Array:
        limit = np.zeros(self.known.shape)
        limit[self.known] = np.hypot(np.radians(TOL.max_residual_deg), 3 * self.sigma)
        return limit

    @cached_property
    def min_blocks(self) -> int:
        share = int(TOL.min_share * np.count_nonzero(self.known))
        return max(share, TOL.coherence_blocks**2)

    def residuals(self, normal: Floats) -> Floats:
        """Size of the phase residual (H', W'), infinite where nothing is known."""
        residuals = np.full(self.known.shape, np.inf)
        residuals[self.known] = np.abs(
            phase_residuals(self.angle_model, normal, self.axial, self.rays)
        )
        return residuals

    def refine(self, inside: Mask, normal: Floats | None = None) -> PlaneEstimate:
        """Robust normal of the blocks of a map."""
        some = inside[self.known]
        return plane_normal(
            self.angle_model,
            self.axial[:, some],
            self.rays[:, some],
            self.sigma[some],
            initial_normal=normal,
        )


def find_planes(
    angle_model: AngleModel,
    axial: Floats,
    rays: Floats,
    sigma: Floats,
    mask: Mask,
    *,
    seed: int = 0,
) -> list[FoundPlane]:
    """Find the planes of a view, the largest support first.

    Parameters
    ----------
    angle_model : PPA or tilted; OPA gives only the azimuth of a plane.
    axial : (2, H, W), ``(cos 2 phase, sin 2 phase)`` times any positive number.
    rays : (3, H, W), unit, camera frame.
    sigma : (H, W), standard deviation of the phase, rad.
    mask : (H, W) bool, pixels to explain.
    seed : of the random pairs.

    Returns
    -------
    Planes with disjoint masks; none if no plane explains anything.
    """
    if axial.shape != (2, *mask.shape) or rays.shape != (3, *mask.shape):
        raise ValueError(f"{axial.shape=}, {rays.shape=}, {mask.shape=}.")
    blocks = _average(angle_model, axial, rays, sigma, mask)
    rng = np.random.default_rng(seed)
    left = blocks.known.copy()
    normals: list[Array] = []
    apart = np.cos(np.radians(TOL.min_angle_deg))
    while len(normals) < TOL.max_planes and np.count_nonzero(left) >= blocks.min_blocks:
        normal, support = _best_plane(blocks, left, rng)
        if np.count_nonzero(support) < blocks.min_blocks:
            break
        left &= ~support
        if all(abs(float(normal @ other)) < apart for other in normals):
            normals.append(normal)
    labels = _assign(blocks, normals)
    grown = labels.repeat(BLOCK_PX, axis=0).repeat(BLOCK_PX, axis=1)
    full = np.full(mask.shape, -1, np.int64)
    full[: grown.shape[0], : grown.shape[1]] = grown
    found = []
    for index in range(labels.max() + 1):  # again from all pixels
        inside = mask & (full == index)
        if inside.any():
            estimate = plane_normal(angle_model, axial[:, inside], rays[:, inside], sigma[inside])
            found.append(FoundPlane(estimate=estimate, mask=inside))
    return sorted(found, key=lambda plane: -plane.estimate.num_pixels)


def _average(
    angle_model: AngleModel,
    axial: Floats,
    rays: Floats,
    sigma: Floats,
    mask: Mask,
) -> _Blocks:
    """Average a phase map over blocks, weighted by precision; half a block has to be known."""
    length = np.hypot(axial[0], axial[1])
    usable = mask & (length > 0) & (sigma > 0) & np.isfinite(length + sigma)
    with np.errstate(divide="ignore", invalid="ignore"):
        weight = np.where(usable, 1 / np.square(sigma, dtype=np.float64), 0)
        unit = np.where(usable, axial / length, 0)
    count, total = _block_sums(usable), _block_sums(weight)
    known = count >= 0.5 * BLOCK_PX**2
    total = total[known]
    means = np.stack([_block_sums(weight * u)[known] for u in unit]) / total
    mean_rays = np.stack([_block_sums(np.where(usable, r, 0))[known] for r in rays])
    mean_rays /= np.sqrt((mean_rays * mean_rays).sum(axis=0))
    deviations = np.sqrt(1 / total + TOL.model_sigma**2)
    return _Blocks(angle_model, known, means, mean_rays, deviations)


def _block_sums(image: NDArray[Any]) -> Array:
    """Sums over blocks, the rest at the far sides left out."""
    rows, cols = image.shape[0] // BLOCK_PX, image.shape[1] // BLOCK_PX
    whole = image[: rows * BLOCK_PX, : cols * BLOCK_PX].reshape(rows, BLOCK_PX, cols, BLOCK_PX)
    return np.asarray(whole.sum(axis=(1, 3), dtype=np.float64))


def _best_plane(blocks: _Blocks, left: Mask, rng: np.random.Generator) -> tuple[Array, Mask]:
    """The best hypothesis about the blocks left, refined, and its coherent support."""
    best, support = np.full(3, np.nan), np.zeros_like(left)
    for hypothesis in _hypotheses(blocks, left, rng):
        normal: Array = hypothesis
        inside = _coherent(blocks, blocks.residuals(normal) < blocks.limit, left)
        for _ in range(4):
            if np.count_nonzero(inside) < blocks.min_blocks // 2:
                break
            normal = blocks.refine(inside, normal).normal
            inside = _coherent(blocks, blocks.residuals(normal) < blocks.limit, left)
        if np.count_nonzero(inside) > np.count_nonzero(support):
            best, support = normal, inside
    return best, support


def _hypotheses(blocks: _Blocks, left: Mask, rng: np.random.Generator) -> list[Array]:
    """Normals of pairs of rows near each other, those first that most blocks agree with."""
    rows = np.full((*left.shape, 3), np.nan)
    rows[blocks.known] = rows_from_axial(
        blocks.angle_model, blocks.axial[0], blocks.axial[1], blocks.rays.T
    )
    height, width = left.shape
    where = np.argwhere(left)
    first = where[rng.integers(len(where), size=TOL.num_hypotheses)]
    # Up to the side of the least plane there is.
    reach = np.geomspace(4, np.sqrt(blocks.min_blocks), TOL.num_hypotheses)[:, None]
    second = first + np.rint(rng.uniform(-1, 1, first.shape) * reach).astype(np.int64)
    second = np.clip(second, 0, [height - 1, width - 1])
    normals = np.cross(rows[tuple(first.T)], rows[tuple(second.T)])
    length = np.linalg.norm(normals, axis=1)
    # The sine of the angle between two rows is twice their conditioning.
    usable = left[tuple(second.T)] & (length > 2 * PlaneTolerances.min_conditioning)
    normals = normals[usable] / length[usable, None]
    some = left[blocks.known]
    samples = stack_samples(
        blocks.angle_model, blocks.axial[:, some], blocks.rays[:, some], blocks.sigma[some]
    )
    step = max(1, samples.shape[1] // TOL.num_scored)
    limits = blocks.limit[left][::step]
    scores = [
        np.count_nonzero(np.abs(phase_errors(normal, samples[:, ::step])) < limits)
        for normal in normals
    ]
    return list(normals[np.argsort(scores)[::-1][: TOL.num_refined]])


def _coherent(blocks: _Blocks, agree: Mask, left: Mask) -> Mask:
    """Blocks left in whose neighbourhood most agree, in areas of half a plane or more."""
    window = (TOL.coherence_blocks, TOL.coherence_blocks)
    agreeing = cv2.blur((agree & left).astype(np.float32), window)
    present = cv2.blur(left.astype(np.float32), window)
    inside = left & (agreeing > TOL.coherent_share * present)
    num, labels, stats, _ = cv2.connectedComponentsWithStats(
        inside.astype(np.uint8), connectivity=4
    )
    keep = stats[:, cv2.CC_STAT_AREA] >= blocks.min_blocks // 2
    keep[0] = False
    return np.asarray(keep[labels]) if num > 1 else np.zeros_like(inside)


def _assign(blocks: _Blocks, normals: Sequence[Array]) -> NDArray[np.int64]:
    """Number of the plane of each block (H', W'), -1 for none."""
    labels = np.full(blocks.known.shape, -1, np.int64)
    if not normals:
        return labels
    for _ in range(2):
        residuals = np.stack([blocks.residuals(normal) for normal in normals])
        smooth = [_mean_where(blocks, np.minimum(r, 2 * blocks.limit)) for r in residuals]
        nearest = np.argmin(smooth, axis=0)
        labels[:] = -1
        refined = []
        for index, normal in enumerate(normals):
            agree = (residuals[index] < blocks.limit) & (nearest == index)
            inside = _coherent(blocks, agree, blocks.known)
            inside &= nearest == index
            labels[inside] = index
            enough = np.count_nonzero(inside) >= blocks.min_blocks
            refined.append(blocks.refine(inside, normal).normal if enough else normal)
        normals = refined
    return labels


def _mean_where(blocks: _Blocks, image: Floats) -> Floats:
    """Mean over the known blocks of a window."""
    known, window = blocks.known, (TOL.coherence_blocks,) * 2
    total = cv2.blur(np.where(known, image, 0).astype(np.float32), window)
    return np.asarray(total / np.maximum(cv2.blur(known.astype(np.float32), window), 1e-6))
