"""Whole captures of printed scenes, with true cameras and a true sparse model."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum
from functools import partial
from pathlib import Path

import numpy as np

from polmvs.camera import PinholeCamera, in_image
from polmvs.io.folders import new_folder
from polmvs.io.ground_truth import write_true_maps, write_views
from polmvs.io.images import write_png
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.scene import SparseModel, Tracks, View
from polmvs.synthetic.captures import add_noise, quantize
from polmvs.synthetic.printed import PrintedScene, render_printed_mosaic, render_printed_truth
from polmvs.synthetic.surfaces import Group, Plane, Sphere

SAME_PLACE = 1e-4  # relative difference of the ranges of a point and of the surface in its view


class Part(StrEnum):
    """Shape of the part."""

    BOARD = "board"
    DOME = "dome"


def scene_of(part: Part, seed: int = 0) -> PrintedScene:
    """A board of 240 x 200 mm, or a dome of 180 mm, with labels, on a printed bumpy table."""
    corners = [(x, y) for x in (-0.24, 0.24) for y in (-0.22, 0.22)]
    bumps = [Sphere((x, y, -0.06), 0.12) for x, y in corners]
    surroundings = Group((Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), *bumps))
    if part is Part.BOARD:
        top = 0.01
        shape: Plane | Sphere = Plane((0.0, 0.0, top), (0.0, 0.0, 1.0), (0.12, 0.10))
        labels = np.array([(x, y, top) for x in (-0.08, 0.0, 0.08) for y in (-0.06, 0.06)])
    else:
        radius, sunk = 0.12, 0.08
        shape = Sphere((0.0, 0.0, -sunk), radius)
        tilts = np.radians([0, 18, 18, 18, 34, 34, 34])
        turns = np.radians([0, 0, 120, 240, 60, 180, 300])
        labels = radius * np.stack(
            [np.sin(tilts) * np.cos(turns), np.sin(tilts) * np.sin(turns), np.cos(tilts)], axis=-1
        ) - [0, 0, sunk]
    return PrintedScene(
        part=shape,
        surroundings=surroundings,
        labels=labels,
        label_radius=0.012,
        texel=0.0025,
        seed=seed,
    )


def camera_of(width: int) -> PinholeCamera:
    """A camera with 69 degrees field of view, its principal point half a percent off the centre."""
    height = round(width * 5 / 12) * 2
    focal = 0.727 * width
    return PinholeCamera(
        width=width, height=height, fx=focal, fy=focal, cx=0.5025 * width, cy=0.507 * height
    )


def write_printed_capture(
    target: Path,
    views: Sequence[View],
    scene: PrintedScene,
    *,
    maps: bool = False,
    workers: Workers | None = None,
    on_progress: OnProgress = no_progress,
) -> None:
    """Write raw mosaics of 8 bits with photon noise, and ``gt/`` as :mod:`polmvs.io.ground_truth`.

    Parameters
    ----------
    target : folder, whole or not at all.
    views : of one camera, by name, metres; see :func:`polmvs.synthetic.printed.orbit_views`.
    scene : its seed is that of the noise as well.
    maps : write depth, normals and masks as well.

    Raises
    ------
    DataError
        The folder exists and is not empty, or the system refuses.
    """
    with new_folder(target) as folder:
        (folder / "raw").mkdir()
        (folder / "gt").mkdir()
        write_views(folder / "gt" / "cameras.json", views)
        work = partial(_write_view, folder, scene, maps)
        seeds = range(scene.seed, scene.seed + len(views))
        for _ in (workers or Workers()).map(work, views, seeds):
            on_progress(1)


def printed_model(
    scene: PrintedScene, views: Sequence[View], num_points: int = 2000
) -> SparseModel:
    """A sparse model with the true cameras and points on labels and surroundings.

    It replaces SfM to evaluate the later stages alone.
    """
    rng = np.random.default_rng(scene.seed)
    labels = np.asarray(scene.labels, np.float64).reshape(-1, 3)
    spread = np.concatenate(
        [
            labels[rng.integers(len(labels), size=num_points // 2)]
            + rng.uniform(-0.6, 0.6, (num_points // 2, 3)) * scene.label_radius,
            rng.uniform(-0.3, 0.3, (num_points - num_points // 2, 3)),
        ]
    )
    above = np.column_stack([spread[:, :2], np.ones(len(spread))])
    down = np.broadcast_to([0.0, 0.0, -1.0], above.shape)
    points = above + scene.all_surfaces.intersect(above, down)[0][:, None] * down
    obs_track, obs_view, obs_xy = [], [], []
    for index, view in enumerate(views):
        xy = view.project(points)
        rays = points - view.center_in_world
        distance = np.linalg.norm(rays, axis=-1)
        seen_at, _ = scene.all_surfaces.intersect(view.center_in_world, rays / distance[:, None])
        seen = in_image(view.camera, xy) & (np.abs(seen_at / distance - 1) < SAME_PLACE)
        obs_track.append(np.flatnonzero(seen))
        obs_view.append(np.full(seen.sum(), index))
        obs_xy.append(xy[seen])
    tracks = Tracks(
        point3D_ids=np.arange(1, len(points) + 1),
        points_in_world=points,
        colors=np.full((len(points), 3), 128, np.uint8),
        errors=np.full(len(points), 0.3),
        obs_track=np.concatenate(obs_track),
        obs_view=np.concatenate(obs_view),
        obs_xy=np.concatenate(obs_xy),
    )
    return SparseModel(views=tuple(views), tracks=tracks, unregistered=())


def _write_view(folder: Path, scene: PrintedScene, maps: bool, view: View, seed: int) -> None:
    mosaic = render_printed_mosaic(view, scene)
    noisy = add_noise(mosaic, rng=np.random.default_rng(seed))
    write_png(folder / "raw" / view.name, quantize(noisy))
    if not maps:
        return
    part, depth = render_printed_truth(view, scene)
    seen = part.mask & (part.depth <= depth + 1e-9)
    write_true_maps(folder / "gt" / Path(view.name).stem, depth, part.normals_in_cam, seen)
