"""Where the pictures are taken from: paths about the object, or poses that are given."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import Camera
from polmvs.scene import View
from polmvs.simulation.options import PathName, PathOptions
from polmvs.synthetic.captures import direction, look_at, rolled

Array = NDArray[np.float64]

GOLDEN_ANGLE = np.pi * (3 - np.sqrt(5))


def camera_views(
    options: PathOptions, camera: Camera, target: Array, distance: float, seed: int
) -> list[View]:
    """Posed views, names ``000.png`` on.

    Parameters
    ----------
    camera : of the polarization images.
    target : (3,), what the cameras look at, metres, world.
    distance : from it, metres.
    seed : of random places and rolls.
    """
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
