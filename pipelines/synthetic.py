"""Make a capture with printed texture and true cameras, of any number of views.

    python pipelines/synthetic.py CAPTURE --views 282

A black glossy board or dome with printed labels on a printed table, raw mosaics with photon noise
of 8 bits, seen from all around by a sensor of tilted polarizers; names in random order. Beside
them, as for any capture with truth, ``gt/cameras.json``, and with ``--maps`` depth, normals and
masks. Its SfM is known to the last digit, so that pairs, mappers and growth can be measured.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from enum import StrEnum
from functools import partial
from pathlib import Path

import numpy as np

from polmvs.camera import PinholeCamera
from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.flags import Command
from polmvs.cli.running import run
from polmvs.cli.terminal import Terminal
from polmvs.config import OptionGroup, default_num_workers, option
from polmvs.io.folders import new_folder
from polmvs.io.ground_truth import DEPTH_UNIT_M
from polmvs.io.images import write_bytes, write_png
from polmvs.parallel import Workers
from polmvs.scene import View
from polmvs.synthetic.captures import add_noise, quantize
from polmvs.synthetic.printed import (
    PrintedScene,
    orbit_views,
    render_printed_mosaic,
    render_printed_truth,
)
from polmvs.synthetic.surfaces import Group, Plane, Sphere


class Part(StrEnum):
    """Shape of the part."""

    BOARD = "board"
    DOME = "dome"


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    capture: Path = option(MISSING, "folder to write, a new one", positional=True)
    part: Part = option(Part.BOARD, "shape of the part")
    views: int = option(100, "how many views", least=2)
    width: int = option(612, "of the half-size images, px; their height is 5/6 of it", least=48)
    ordered: bool = option(False, "names follow the orbit")
    maps: bool = option(False, "write depth, normals and masks as well")
    seed: int = option(0, "of print, places, names and noise", least=0)
    workers: int = option(default_num_workers(), "processes to share the views among", least=1)


def scene_of(part: Part, seed: int = 0) -> PrintedScene:
    """A board of 240 x 200 mm, or a dome of 180 mm across, labelled, on a printed bumpy table."""
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
    """A lens of 69 degrees across, its principal point half a percent off the centre."""
    height = round(width * 5 / 12) * 2
    focal = 0.727 * width
    return PinholeCamera(
        width=width, height=height, fx=focal, fy=focal, cx=0.5025 * width, cy=0.507 * height
    )


def _make(call: Call, terminal: Terminal) -> int:
    given = call.get(Arguments)
    camera = camera_of(given.width)
    views = orbit_views(given.views, camera, seed=given.seed, ordered=given.ordered)
    with new_folder(given.capture) as folder, Workers(given.workers) as workers:
        (folder / "raw").mkdir()
        (folder / "gt").mkdir()
        write_bytes(folder / "gt" / "cameras.json", _cameras(camera, views).encode())
        work = partial(_write_view, folder, scene_of(given.part, given.seed), given.maps)
        seeds = range(given.seed, given.seed + len(views))
        with terminal.stage("views", len(views)) as progress:
            for _ in workers.map(work, views, seeds):
                progress(1)
    intrinsics = f"{camera.fx:.10g},{camera.fy:.10g},{camera.cx:.10g},{camera.cy:.10g}"
    terminal.show(
        f"{given.capture}: {len(views)} views; --intrinsics {intrinsics}",
        {"capture": given.capture, "views": len(views), "intrinsics": intrinsics},
    )
    return 0


def _cameras(camera: PinholeCamera, views: Sequence[View]) -> str:
    """The content of ``cameras.json``; see :mod:`polmvs.io.ground_truth`."""
    matrix = [[camera.fx, 0.0, camera.cx], [0.0, camera.fy, camera.cy], [0.0, 0.0, 1.0]]
    images = {
        view.name: {
            "K": matrix,
            "cam_from_world": np.column_stack(
                [view.cam_from_world.rotation, view.cam_from_world.translation]
            ).tolist(),
        }
        for view in views
    }
    return json.dumps({"width": camera.width, "height": camera.height, "images": images}, indent=1)


def _write_view(folder: Path, scene: PrintedScene, maps: bool, view: View, seed: int) -> None:
    mosaic = render_printed_mosaic(view, scene)
    noisy = add_noise(mosaic, rng=np.random.default_rng(seed))
    write_png(folder / "raw" / view.name, quantize(noisy))
    if not maps:
        return
    part, depth = render_printed_truth(view, scene)
    seen = part.mask & (part.depth <= depth + 1e-9)
    stem = folder / "gt" / Path(view.name).stem
    encoded = np.rint(np.nan_to_num(depth, posinf=0) / DEPTH_UNIT_M)
    write_png(f"{stem}_depth.png", encoded.astype(np.uint16))
    write_png(f"{stem}_mask.png", np.where(seen, 255, 0).astype(np.uint8))
    normals = np.rint((np.where(seen[..., None], part.normals_in_cam, 0) + 1) * 32767.5)
    write_png(f"{stem}_normal.png", normals.astype(np.uint16)[..., ::-1].copy())


COMMAND = Command(
    help_text="make a capture with printed texture and true cameras",
    run=_make,
    groups=(Arguments, TerminalOptions),
)


def main(argv: Sequence[str] | None = None) -> int:
    """Run the script; the exit status."""
    return run((COMMAND,), "synthetic.py", argv)


if __name__ == "__main__":
    raise SystemExit(main())
