"""Camera poses: paths about the object, or given poses."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from polmvs.arrays import Array
from polmvs.camera import Camera
from polmvs.colmap.models import read_views as read_model_views
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform
from polmvs.io.plain_files import read_rows
from polmvs.scene import View, stem_of
from polmvs.simulation.options import PathName, PathOptions
from polmvs.synthetic.captures import direction, look_at, rolled

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def camera_views(
    options: PathOptions, camera: Camera, target: Array, distance: float, seed: int
) -> list[View]:
    """Posed views, names ``000.png`` on.

    Parameters
    ----------
    camera : of the polarization images.
    target : (3,), point at which the cameras look, metres, world.
    distance : from the target, metres.
    seed : of random positions and rolls.

    Raises
    ------
    DataError
        A file of poses is unusable.
    """
    if options.cameras is not None:
        return given_views(options.cameras, camera)
    rng = np.random.default_rng([seed, 2])
    num = options.views
    low, high = np.radians(options.elevation)
    share = (np.arange(num) + 0.5) / num
    around = 2 * np.pi * np.arange(num) / num
    lengths = np.full(num, distance)
    match options.path:
        case PathName.RING:
            azimuths, elevations = around, np.full(num, 0.5 * (low + high))
        case PathName.SPIRAL:
            azimuths, elevations = 2 * around, low + (high - low) * share
        case PathName.ARC:
            first, last = np.radians(options.azimuth)
            azimuths = np.linspace(first, last, num)
            elevations = np.full(num, 0.5 * (low + high))
        case PathName.DOME:
            # Neighbours in azimuth take turns in elevation, evenly over the dome's area.
            azimuths = around
            order = np.argsort(np.argsort(np.mod(np.arange(num) * GOLDEN_ANGLE, 2 * np.pi)))
            level = (order + 0.5) / num
            elevations = np.arcsin(np.sin(low) + (np.sin(high) - np.sin(low)) * level)
        case PathName.RANDOM:
            azimuths = rng.uniform(0, 2 * np.pi, num)
            elevations = np.arcsin(rng.uniform(np.sin(low), np.sin(high), num))
            lengths = distance * rng.uniform(0.85, 1.15, num)
    rolls = np.radians(options.roll) * rng.normal(size=num)
    digits = max(3, len(str(num - 1)))
    views = []
    for index in range(num):
        center = target + lengths[index] * direction(azimuths[index], elevations[index])
        up = (0, 0, 1) if abs(elevations[index]) < np.radians(89.5) else (1, 0, 0)
        pose = rolled(look_at(center, target, up), rolls[index])
        views.append(View(name=f"{index:0{digits}d}.png", camera=camera, cam_from_world=pose))
    return views


def given_views(path: Path, camera: Camera) -> list[View]:
    """Views with given poses, metres, sorted by name, and one camera.

    Parameters
    ----------
    path : folder of a COLMAP model, or a text file with lines ``name qw qx qy qz tx ty tz``.

    Raises
    ------
    DataError
        It is missing, malformed, or has a name twice.
    """
    if path.is_dir():
        found = {view.name: view.cam_from_world for view in read_model_views(path)}
    else:
        found = _read_trajectory(path)
    views = {}
    for name, pose in found.items():
        stored = f"{stem_of(name)}.png"
        if stored in views:
            raise DataError(path, f"has two poses of {stored}.")
        views[stored] = View(name=stored, camera=camera, cam_from_world=pose)
    return [views[name] for name in sorted(views)]


def _read_trajectory(path: Path) -> dict[str, RigidTransform]:
    poses: dict[str, RigidTransform] = {}
    for number, words in read_rows(path):
        try:
            w, x, y, z, *translation = map(float, words[1:])
        except ValueError:
            translation = []
        norm = np.sqrt(w * w + x * x + y * y + z * z) if translation else np.nan
        if len(translation) != 3 or not np.isfinite([norm, *translation]).all() or norm < 1e-6:
            raise DataError(path, f"line {number} needs: name qw qx qy qz tx ty tz.")
        rotation = Rotation.from_quat(np.array([x, y, z, w]) / norm).as_matrix()
        if words[0] in poses:
            raise DataError(path, f"has two poses of {words[0]}.")
        poses[words[0]] = RigidTransform(rotation, np.array(translation))
    if not poses:
        raise DataError(path, "has no poses; lines are: name qw qx qy qz tx ty tz.")
    return poses
