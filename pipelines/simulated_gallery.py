"""Pictures of the presets of materials under those of light: intensity, AoLP and DoLP.

    python pipelines/simulated_gallery.py WORK docs/images

Renders one view of each and writes ``simulated_LIGHT.jpg``, a row for each material, into the
second folder.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import CaptureOptions, OptionGroup, option
from polmvs.io.images import write_bytes
from polmvs.polarization.capture import open_capture
from polmvs.polarization.inspection import aolp_picture, dolp_picture, intensity_picture
from polmvs.simulation.capture import simulate_capture
from polmvs.simulation.options import (
    LightingOptions,
    LightName,
    MaterialName,
    ObjectOptions,
    PathName,
    PathOptions,
    RenderingOptions,
    SensorOptions,
    Simulation,
    SimulationRun,
)

Picture = NDArray[np.uint8]

LIGHTS = tuple(light for light in LightName if light is not LightName.FILE)
QUALITY = 82  # of the JPEG files
CAPTION = 16  # px


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    work: Path = option(MISSING, "folder of the captures", positional=True)
    pictures: Path = option(MISSING, "folder of the pictures", positional=True)
    shape: str = option("mug", "file or built-in shape")
    lights: tuple[LightName, ...] = option(LIGHTS, "presets")
    image_size: tuple[int, int] = option((400, 336), "of the mosaics, px", metavar="WIDTH,HEIGHT")


def _render(call: Call, terminal: Terminal) -> int:
    arguments = call.get(Arguments)
    with terminal.stage("views", len(arguments.lights) * len(MaterialName)) as on_progress:
        for light in arguments.lights:
            rows = []
            for material in MaterialName:
                rows.append(_row(arguments, light, material))
                on_progress(1)
            _, data = cv2.imencode(
                ".jpg", np.concatenate(rows), [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
            )
            path = arguments.pictures / f"simulated_{light}.jpg"
            write_bytes(path, data.tobytes())
            terminal.say(str(path))
    return 0


def _row(arguments: Arguments, light: LightName, material: MaterialName) -> Picture:
    folder = arguments.work / f"{light}_{material}"
    simulation = Simulation(
        object=ObjectOptions(material=material, marks=5),
        lighting=LightingOptions(light=light),
        path=PathOptions(path=PathName.ARC, views=1, elevation=(38, 38), azimuth=(-35, -35)),
        sensor=SensorOptions(image_size=arguments.image_size, field_of_view=45),
        rendering=RenderingOptions(max_samples=64, directions=128),
    )
    simulate_capture(arguments.shape, folder, simulation, SimulationRun(resume=True))
    capture = open_capture(folder, CaptureOptions(full_scale=255))
    stokes = capture.load(capture.names[0])
    white = float(np.percentile(stokes.s0, 99.5))
    pictures = [intensity_picture(stokes, white), aolp_picture(stokes), dolp_picture(stokes)]
    row = np.concatenate(pictures, axis=1)
    caption = np.full((CAPTION, row.shape[1], 3), 255, np.uint8)
    face, colour = cv2.FONT_HERSHEY_SIMPLEX, (0, 0, 0)
    cv2.putText(caption, f"{material}, {light}", (3, 12), face, 0.4, colour, 1, cv2.LINE_AA)
    return np.concatenate([caption, row])


main = script(__file__, __doc__, _render, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
