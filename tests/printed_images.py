"""Intensity images of a printed capture, small, unordered and with their true cameras."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from polmvs.camera import PinholeCamera
from polmvs.io.images import write_png
from polmvs.scene import View
from polmvs.synthetic.captures import add_noise, quantize
from polmvs.synthetic.printed import PrintedScene, orbit_views, render_printed_mosaic
from polmvs.synthetic.surfaces import Group, Plane, Sphere

CAMERA = PinholeCamera(width=300, height=250, fx=218.0, fy=218.0, cx=151.0, cy=126.0)
INTRINSICS = (218.0, 218.0, 151.0, 126.0)


def printed_scene() -> PrintedScene:
    bumps = [Sphere((x, y, -0.06), 0.12) for x in (-0.24, 0.24) for y in (-0.22, 0.22)]
    return PrintedScene(
        part=Plane((0.0, 0.0, 0.01), (0.0, 0.0, 1.0), (0.12, 0.10)),
        surroundings=Group((Plane((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)), *bumps)),
        labels=np.array([(x, y, 0.01) for x in (-0.08, 0.08) for y in (-0.06, 0.06)]),
        label_radius=0.015,
        texel=0.003,
    )


def write_printed_images(folder: Path, num_views: int, *, seed: int = 0) -> list[View]:
    """Write 8-bit intensity images into an existing folder; their views, by name."""
    views = orbit_views(num_views, CAMERA, seed=seed)
    for view, mosaic in zip(views, noisy_mosaics(views, seed), strict=True):
        cells = mosaic.reshape(CAMERA.height, 2, CAMERA.width, 2)
        write_png(folder / view.name, quantize(2 * cells.mean(axis=(1, 3))))
    return views


def write_printed_capture(folder: Path, num_views: int, *, seed: int = 0) -> None:
    """Write raw mosaics into an existing folder."""
    views = orbit_views(num_views, CAMERA, seed=seed)
    for view, mosaic in zip(views, noisy_mosaics(views, seed), strict=True):
        write_png(folder / view.name, quantize(mosaic))


def noisy_mosaics(views: list[View], seed: int) -> Iterator[np.ndarray]:
    scene, rng = printed_scene(), np.random.default_rng(seed)
    return (add_noise(render_printed_mosaic(view, scene), rng=rng) for view in views)
