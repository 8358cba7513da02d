"""Contours of phase, along which a surface keeps its range, as in the paper.

A row ``m`` is a tangent of the surface. Under PPA it is perpendicular to the ray, so a point moved
along it keeps its distance to the camera centre: the contour is an iso-range curve. Under OPA it
has no z component and the contour is an iso-depth curve (Cui et al. 2017). Both need one view
and no normal. The curves are traced in the image; the constant quantity is applied afterwards, so
it does not drift (:mod:`polmvs.surface.propagation`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from polmvs.camera import sample_image
from polmvs.polarization.angle_models import rows_from_axial
from polmvs.polarization.kinds import AngleModel

Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]


@dataclass(frozen=True, kw_only=True)
class ContourTolerances:
    """Tolerances of the tracing of contours.

    Attributes
    ----------
    min_dolp : smoothed; contours stop below it. Guess; without it F at 1 mm of OPA on the bundled
        capture is 33.0 and not 35.4 %.
    min_coherence : of neighbouring directions: a contour stops in an incoherent field.
        Derived: cosine of half a right angle.
    meeting_px : distance at which the two halves of a closed curve end. Guess.
    """

    min_dolp: float = 0.05
    min_coherence: float = 0.7
    meeting_px: float = 2.0


TOL = ContourTolerances()


@dataclass(frozen=True)
class Contours:
    """Traced curves as one list of nodes.

    Attributes
    ----------
    xy : (N, 2) float32, image coordinates.
    curve : (N,) int, index of the curve a node belongs to.
    arc_px : (N,) float32, signed length from the curve's seed; nodes of a curve are ordered by it.
    """

    xy: NDArray[np.float32]
    curve: NDArray[np.int64]
    arc_px: NDArray[np.float32]


def direction_field(angle_model: AngleModel, samples: Image, rays: Image, passable: Mask) -> Image:
    """Direction of the contour at every pixel, as an axial image that can be interpolated.

    Parameters
    ----------
    angle_model : OPA or PPA.
    samples : (H, W, 3), phase map samples.
    rays : (H, W, 3), unit rays of the pixels; their derivatives carry any camera model.
    passable : (H, W) bool, pixels on which a contour may run.

    Returns
    -------
    (H, W, 2) float32: cos and sin of twice the direction's angle in the image (x right, y
    down); 0 where not passable.
    """
    row = rows_from_axial(angle_model, samples[..., 0], samples[..., 1], rays)
    along = row - (row * rays).sum(axis=-1, keepdims=True) * rays  # the ray's own motion
    ray_dy, ray_dx = np.gradient(rays, axis=(0, 1))
    # Solve [ray_dx ray_dy] e = along in the plane perpendicular to the ray.
    xx, yy = (ray_dx**2).sum(-1), (ray_dy**2).sum(-1)
    xy = (ray_dx * ray_dy).sum(-1)
    bx, by = (ray_dx * along).sum(-1), (ray_dy * along).sum(-1)
    ex, ey = yy * bx - xy * by, xx * by - xy * bx
    square = ex * ex + ey * ey
    with np.errstate(divide="ignore", invalid="ignore"):
        axial = np.stack([(ex * ex - ey * ey) / square, 2 * ex * ey / square], axis=-1)
    axial[~(passable & np.isfinite(axial).all(axis=-1))] = 0
    return np.asarray(axial, np.float32)


def trace_contours(
    field: Image,
    seeds_xy: Floats,
    *,
    step_px: float,
    keep_every: int = 1,
    claims: NDArray[np.int32] | None = None,
    first_curve: int = 0,
) -> Contours:
    """Trace contours both ways from all seeds in lock step (midpoint rule).

    A contour ends where the field ends (region edge, crease, weak polarization, clipped pixels),
    where neighbouring directions disagree, or where it closes. A contour without an end is cut
    where each half is as long as the image's border.

    Parameters
    ----------
    field : (H, W, 2), from :func:`direction_field`.
    seeds_xy : (S, 2), image coordinates.
    step_px : step length, px.
    keep_every : number of steps between kept nodes.
    claims : cells of the image, each owned by the first curve that entered it (-1: free), over
        the extent of the field; a curve ends in a cell of another. Updated in place.
    first_curve : index of the first seed's curve.
    """
    seeds = np.asarray(seeds_xy, np.float32).reshape(-1, 2)
    start = sample_image(field, seeds)
    angle = _angle(start)
    forward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    curve = np.flatnonzero(np.linalg.norm(start, axis=-1) > TOL.min_coherence)
    nodes, owners = [seeds[curve]], [curve]
    arcs = [np.zeros(len(curve), np.float32)]
    # Both halves of a curve side by side, (2, S, 2): a closed curve ends where they meet.
    position = np.stack([seeds[curve]] * 2)
    heading = np.stack([forward, -forward])[:, curve]
    alive = np.ones(position.shape[:2], bool)
    check_every = max(keep_every // 2, 1)
    border_px = 2 * sum(field.shape[:2])
    for index in range(1, int(border_px / step_px) + 1):
        if not len(curve):
            break
        middle_heading, ok = _heading(field, position + 0.5 * step_px * heading, heading)
        position = np.where(alive[..., None], position + step_px * middle_heading, position)
        heading, still_ok = _heading(field, position, middle_heading)
        alive &= ok & still_ok
        if index * step_px > 2 * TOL.meeting_px:
            gap = ((position[0] - position[1]) ** 2).sum(axis=-1)
            alive &= (gap > TOL.meeting_px**2) | ~alive.all(axis=0)
        if claims is not None and index % check_every == 0:
            alive &= _claim(claims, field.shape, position, curve + first_curve)
        if index % keep_every == 0:
            for half, way in enumerate((1, -1)):
                nodes.append(position[half][alive[half]])
                owners.append(curve[alive[half]])
                arcs.append(np.full(len(nodes[-1]), way * index * step_px, np.float32))
        going = alive.any(axis=0)
        if not going.all():
            position, heading, alive = position[:, going], heading[:, going], alive[:, going]
            curve = curve[going]
    xy, owner, arc = np.concatenate(nodes), np.concatenate(owners), np.concatenate(arcs)
    order = np.lexsort((arc, owner))
    return Contours(xy[order], owner[order] + first_curve, arc[order])


def _angle(axial: Image) -> NDArray[np.float32]:
    return np.asarray(0.5 * np.arctan2(axial[..., 1], axial[..., 0]), np.float32)


def _heading(field: Image, xy: Floats, previous: Floats) -> tuple[Image, Mask]:
    """Unit direction of the field nearest to the previous one, and where the field is coherent."""
    axial = sample_image(field, xy)
    angle = _angle(axial)
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    dot = (heading * previous).sum(axis=-1)
    heading *= np.where(dot < 0, -1, 1)[..., None].astype(np.float32)
    coherent = (axial**2).sum(axis=-1) > TOL.min_coherence**2
    return heading, coherent & (np.abs(dot) > TOL.min_coherence)


def _cells(claims: NDArray[np.int32], shape: tuple[int, ...], xy: Floats) -> tuple[Any, Any]:
    """Row and column of the claim cells of image coordinates."""
    rows, cols = claims.shape
    row = (xy[..., 1] * np.float32(rows / shape[0])).astype(np.int64)
    col = (xy[..., 0] * np.float32(cols / shape[1])).astype(np.int64)
    return np.clip(row, 0, rows - 1), np.clip(col, 0, cols - 1)


def _claim(
    claims: NDArray[np.int32], shape: tuple[int, ...], xy: Floats, curve: NDArray[np.int64]
) -> Mask:
    """Claim the cells of positions (2, S, 2) for their curves; False where another owns it."""
    row, col = _cells(claims, shape, xy)
    mine = np.broadcast_to(curve, row.shape).astype(np.int32)
    free = claims[row, col] < 0
    claims[row[free], col[free]] = mine[free]
    return np.asarray(claims[row, col] == mine)


def cover_with_contours(
    field: Image,
    seeds_xy: Floats,
    inside: Mask,
    *,
    spacing_px: float,
    step_px: float,
) -> Contours:
    """Contours from the seeds, then between them until the region is covered.

    The seeds' contours come first, then rounds from free pixels with decreasing spacing. A new
    curve ends where it meets an earlier one. Pixels of the region that no contour can reach
    (frontal spots, marks) become curves of a single node.

    Parameters
    ----------
    field : (H, W, 2), from :func:`direction_field`.
    seeds_xy : (S, 2), image coordinates.
    inside : (H, W) bool, the region to cover.
    spacing_px : distance between contours, and between the nodes kept of each.
    step_px : step length, px.
    """
    height, width = field.shape[:2]
    keep_every = max(round(spacing_px / step_px), 1)
    cell_px = 0.7 * spacing_px
    claims = np.full((max(int(height / cell_px), 1), max(int(width / cell_px), 1)), -1, np.int32)
    candidates = [np.asarray(seeds_xy, np.float32).reshape(-1, 2)]
    candidates += [_lattice(width, height, spacing_px * scale) for scale in (16, 4, 1)]
    parts, num_curves = [], 0
    for places in candidates:
        free = claims[_cells(claims, field.shape, places)] < 0
        free &= (
            np.linalg.norm(sample_image(field, places, nearest=True), axis=-1) > TOL.min_coherence
        )
        parts.append(
            trace_contours(
                field,
                places[free],
                step_px=step_px,
                keep_every=keep_every,
                claims=claims,
                first_curve=num_curves,
            )
        )
        num_curves += int(free.sum())
    lone = candidates[-1]
    lone = lone[sample_image(inside.astype(np.float32), lone, nearest=True) > 0]
    traced = np.concatenate([p.xy for p in parts])
    if len(traced) and len(lone):
        lone = lone[cKDTree(traced).query(lone)[0] > 0.7 * spacing_px]
    curve = num_curves + np.arange(len(lone))
    parts.append(Contours(lone, curve, np.zeros(len(lone), np.float32)))
    return Contours(
        np.concatenate([p.xy for p in parts]),
        np.concatenate([p.curve for p in parts]),
        np.concatenate([p.arc_px for p in parts]),
    )


def _lattice(width: int, height: int, spacing: float) -> NDArray[np.float32]:
    x = np.arange(spacing / 2, width, spacing)
    y = np.arange(spacing / 2, height, spacing)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float32)
