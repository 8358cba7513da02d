"""Contours of one view: curves of constant distance (PPA) or depth (OPA), traced from phase only.

A row ``m`` is a tangent of the surface. Under PPA it is perpendicular to the ray, so a point moved
along it keeps its distance to the camera centre: the contour is an iso-range curve. Under OPA it
has no z component and the contour is an iso-depth curve (Cui et al. 2017). Both need one view and
no normal. The curves are traced in the image; what stays constant along them is applied
afterwards, so nothing drifts.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.config import Model
from polmvs.models import rows_from_axial

Floats = NDArray[np.floating]
Image = NDArray[np.float32]
Mask = NDArray[np.bool_]

MIN_COHERENCE = 0.7  # of neighbouring directions; a contour stops in an incoherent field
MEETING_PX = 2.0  # the two halves of a closed curve end this close to each other


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


def direction_field(model: Model, samples: Image, rays: Image, passable: Mask) -> Image:
    """Direction of the contour at every pixel, as an axial image that can be interpolated.

    Parameters
    ----------
    model : OPA or PPA.
    samples : (H, W, 3), phase map samples.
    rays : (H, W, 3), unit rays of the pixels; their derivatives carry any camera model.
    passable : (H, W) bool, pixels that a contour may cross.

    Returns
    -------
    (H, W, 2) float32: cos and sin of twice the direction's angle in the image (x right, y
    down); 0 where not passable.
    """
    row = rows_from_axial(model, samples[..., 0], samples[..., 1], rays)
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
    step_px: float = 0.5,
    max_length_px: float = 2000.0,
    keep_every: int = 1,
    blocked: Mask | None = None,
) -> Contours:
    """Trace contours both ways from all seeds in lock step (midpoint rule).

    Parameters
    ----------
    field : (H, W, 2), from :func:`direction_field`; several views may be stacked in one image.
    seeds_xy : (S, 2), image coordinates.
    step_px : step length, px.
    max_length_px : of each half of a curve.
    keep_every : nodes kept, in steps.
    blocked : (H, W) bool, pixels where a curve ends (other curves are near).
    """
    seeds = np.asarray(seeds_xy, np.float32)
    angle = _angle(sample_image(field, seeds))
    forward = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    start_ok = np.linalg.norm(sample_image(field, seeds), axis=-1) > MIN_COHERENCE
    curve = np.flatnonzero(start_ok)
    nodes, owners = [seeds[curve]], [curve]
    arcs = [np.zeros(len(curve), np.float32)]
    # Both halves of a curve side by side, (2, S, 2): a closed curve ends where they meet.
    position = np.stack([seeds[curve]] * 2)
    heading = np.stack([forward, -forward])[:, curve]
    alive = np.ones(position.shape[:2], bool)
    for index in range(1, int(max_length_px / step_px) + 1):
        if not len(curve):
            break
        middle_heading, ok = _heading(field, position + 0.5 * step_px * heading, heading)
        position = np.where(alive[..., None], position + step_px * middle_heading, position)
        heading, still_ok = _heading(field, position, middle_heading)
        alive &= ok & still_ok
        if blocked is not None:
            alive &= ~_lookup(blocked, position)
        if index * step_px > 4:
            gap = ((position[0] - position[1]) ** 2).sum(axis=-1)
            alive &= (gap > MEETING_PX**2) | ~alive.all(axis=0)
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
    return Contours(xy[order], owner[order], arc[order])


def _angle(axial: Image) -> NDArray[np.float32]:
    return np.asarray(0.5 * np.arctan2(axial[..., 1], axial[..., 0]), np.float32)


def _heading(field: Image, xy: Image, previous: Image) -> tuple[Image, Mask]:
    """Unit direction of the field nearest to the previous one, and where the field is coherent."""
    axial = sample_image(field, xy)
    angle = _angle(axial)
    heading = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    dot = (heading * previous).sum(axis=-1)
    heading *= np.where(dot < 0, -1, 1)[..., None].astype(np.float32)
    coherent = (axial**2).sum(axis=-1) > MIN_COHERENCE**2
    return heading, coherent & (np.abs(dot) > MIN_COHERENCE)


def _lookup(mask: Mask, xy: Image) -> Mask:
    height, width = mask.shape
    col = np.clip(xy[..., 0].astype(np.int64), 0, width - 1)
    row = np.clip(xy[..., 1].astype(np.int64), 0, height - 1)
    return mask[row, col]


def cover_with_contours(
    field: Image,
    seeds_xy: Floats,
    inside: Mask,
    *,
    spacing_px: float,
    step_px: float = 0.5,
    keep_every: int = 8,
) -> Contours:
    """Contours from the seeds, then sideways of them until the region is covered.

    First the seeds' own contours, then in rounds from free places ever closer together; a new
    curve ends where it comes within half the spacing of an earlier one. Places of the region
    that no contour can reach (frontal spots, marks) become curves of a single node.
    """
    height, width = field.shape[:2]
    passable = (field**2).sum(axis=-1) > MIN_COHERENCE**2
    blocked = np.zeros((height, width), bool)
    spacings = spacing_px * 2.0 ** np.arange(4, -1, -1)
    candidates = [np.asarray(seeds_xy, np.float32).reshape(-1, 2)]
    candidates += [_lattice(width, height, s) for s in spacings]
    parts, num_curves = [], 0
    for places in candidates:
        free = ~_lookup(blocked, places) & _lookup(passable, places)
        traced = trace_contours(
            field, places[free], step_px=step_px, keep_every=keep_every, blocked=blocked
        )
        parts.append(Contours(traced.xy, traced.curve + num_curves, traced.arc_px))
        num_curves += int(free.sum())
        blocked |= _near_nodes(traced.xy, (height, width), 0.5 * spacing_px)
    lone = candidates[-1]
    lone = lone[~_lookup(blocked, lone) & _lookup(inside, lone)]
    parts.append(Contours(lone, num_curves + np.arange(len(lone)), np.zeros(len(lone), np.float32)))
    return Contours(
        np.concatenate([p.xy for p in parts]),
        np.concatenate([p.curve for p in parts]),
        np.concatenate([p.arc_px for p in parts]),
    )


def _lattice(width: int, height: int, spacing: float) -> NDArray[np.float32]:
    x = np.arange(spacing / 2, width, spacing)
    y = np.arange(spacing / 2, height, spacing)
    return np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2).astype(np.float32)


def _near_nodes(xy: Image, shape: tuple[int, int], radius_px: float) -> Mask:
    """Pixels within a radius of any node."""
    marked = np.zeros(shape, np.uint8)
    col = np.clip(xy[:, 0].astype(np.int64), 0, shape[1] - 1)
    row = np.clip(xy[:, 1].astype(np.int64), 0, shape[0] - 1)
    marked[row, col] = 1
    size = 2 * max(round(radius_px), 1) + 1
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (size, size))
    return np.asarray(cv2.dilate(marked, kernel) > 0)
