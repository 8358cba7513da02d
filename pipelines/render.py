"""Render point clouds side by side to a PNG, from the same virtual camera, without a display."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import PinholeCamera
from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.flags import Command
from polmvs.cli.running import run
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, option
from polmvs.geometry import RigidTransform
from polmvs.io.clouds import Cloud, read_cloud
from polmvs.io.images import write_png

Array = NDArray[np.float64]

BACKGROUND = 255
NORMAL_SHADING = 0.85  # share of the brightness that follows the angle of the normal


def render(cloud: Cloud, camera: PinholeCamera, pose: RigidTransform, radius_px: int) -> Array:
    """Shaded splats with a depth buffer, ``(H, W)`` uint8: bright where the normal faces us."""
    in_cam = pose * cloud.points
    xy = camera.project(in_cam)
    shade = np.full(len(in_cam), 0.6)
    order = np.argsort(-in_cam[:, 2])  # far points first, near ones over them
    if cloud.normals is not None:
        normals_in_cam = cloud.normals @ pose.rotation.T
        facing = normals_in_cam @ np.array([-0.4, -0.5, -0.77])
        shade = 1 - NORMAL_SHADING * (1 - np.clip(facing, 0, 1))
        order = order[((normals_in_cam * in_cam).sum(axis=-1) < 0)[order]]  # no back faces
    image = np.full((camera.height, camera.width), BACKGROUND, np.uint8)
    offsets = range(-radius_px, radius_px + 1)
    pixels = np.floor(np.nan_to_num(xy[order], nan=-100.0)).astype(np.int64)
    values = (230 * shade[order]).astype(np.uint8)
    for dy in offsets:
        for dx in offsets:
            col, row = pixels[:, 0] + dx, pixels[:, 1] + dy
            ok = (col >= 0) & (row >= 0) & (col < camera.width) & (row < camera.height)
            image[row[ok], col[ok]] = values[ok]
    return np.asarray(image)


def oblique_pose(cloud: Cloud, elevation_deg: float, azimuth_deg: float) -> RigidTransform:
    """A camera that sees the whole of a cloud from a given side of its mean plane."""
    center = np.median(cloud.points, axis=0)
    spread = cloud.points - center
    near = np.linalg.norm(spread, axis=1) < 3 * np.median(np.linalg.norm(spread, axis=1))
    axes = np.linalg.svd(spread[near], full_matrices=False)[2]
    up = axes[2]
    if cloud.normals is not None and (cloud.normals @ up).mean() < 0:
        up = -up
    across = np.cross(up, axes[0])
    turn, lift = np.radians(azimuth_deg), np.radians(elevation_deg)
    side = np.cos(turn) * axes[0] + np.sin(turn) * across
    size = np.percentile(np.linalg.norm(spread[near], axis=1), 99)
    eye = center + 3.4 * size * (np.cos(lift) * side + np.sin(lift) * up)
    forward = (center - eye) / np.linalg.norm(center - eye)
    right = np.cross(forward, up)
    right /= np.linalg.norm(right)
    rotation = np.array([right, np.cross(forward, right), forward])
    return RigidTransform(rotation, -rotation @ eye)


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    clouds: tuple[Path, ...] = option(
        MISSING, "PLY files of one frame", positional=True, metavar="CLOUD.ply"
    )
    out: Path = option(MISSING, "PNG to write")
    labels: tuple[str, ...] = option((), "one for each cloud", metavar="NAME,...")
    elevations: tuple[float, ...] = option((35.0, 4.0), "degrees")
    azimuth: float = option(40.0, "degrees")


def _render(call: Call, terminal: Terminal) -> int:
    """Render clouds from the last one's oblique views, one column each."""
    given = call.get(Arguments)
    clouds = [read_cloud(path) for path in given.clouds]
    camera = PinholeCamera(width=640, height=400, fx=620, fy=620, cx=320, cy=200)
    rows = []
    for elevation in given.elevations:
        pose = oblique_pose(clouds[-1], elevation, given.azimuth)
        rows.append(np.hstack([render(c, camera, pose, 2) for c in clouds]))
    picture = np.vstack(rows)
    for i, label in enumerate(given.labels):
        place = (camera.width * i + 16, 34)
        cv2.putText(picture, label, place, cv2.FONT_HERSHEY_SIMPLEX, 0.9, 0, 2, cv2.LINE_AA)
    write_png(given.out, picture)
    return 0


COMMAND = Command(
    help_text="render point clouds side by side to a PNG, from the same virtual camera",
    run=_render,
    groups=(Arguments, TerminalOptions),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    return run((COMMAND,), "render.py", argv)


if __name__ == "__main__":
    raise SystemExit(main())
