"""What polarizer calibration does to the AoLP of a rendered ball, seen by a faulty sensor.

    python pipelines/calibration.py FIGURE.png

The sensor's channels differ by 2 % in gain and 1 degree in angle (standard deviations) and have an
extinction ratio of 50:1; its samples differ from their channel by a fifth of that. It is calibrated
from 30 frames each of darkness, of a uniform source, and of that source behind a polarizer at eight
angles, with photon and read noise; then it sees the ball once, 12 bits. Without a calibration, its
gains are those of unpolarized light.
"""

from __future__ import annotations

import tempfile
from dataclasses import MISSING, dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.camera import PinholeCamera
from polmvs.cli.call import Call, TerminalOptions
from polmvs.cli.running import script
from polmvs.cli.terminal import Terminal
from polmvs.config import CaptureOptions, OptionGroup, option
from polmvs.polarization.calibration import measure_response, write_calibration
from polmvs.polarization.capture import open_capture
from polmvs.polarization.stokes import axial_difference
from polmvs.synthetic.captures import render_view, ring_of_views
from polmvs.synthetic.sensor import FaultySensor, faulty_sensor
from polmvs.synthetic.surfaces import Sphere

PATTERN = CaptureOptions.pattern
POLARIZER_DEG = (0, 20, 45, 70, 90, 110, 135, 160)
NUM_FRAMES = 30
CAMERA = PinholeCamera(width=306, height=256, fx=280, fy=280, cx=153, cy=128)
SEED = 1
MIN_DOLP = 0.05
BANDS = (0.05, 0.1, 0.2, 0.4, 1.0)  # of DoLP, whose errors are told apart


@dataclass(frozen=True, kw_only=True)
class Arguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    figure: Path = option(MISSING, "PNG to write", positional=True)


def _calibration(call: Call, terminal: Terminal) -> int:
    errors, dolp = measure()
    lines = []
    for name, error in errors.items():
        bands = "  ".join(
            f"{low:g}-{high:g}: {_rms(error[(dolp >= low) & (dolp < high)]):.2f}"
            for low, high in pairwise(BANDS)
        )
        lines.append(f"{name:<12} rms AoLP error, deg, by DoLP  {bands}  all: {_rms(error):.2f}")
    draw(call.get(Arguments).figure, errors)
    terminal.show("\n".join(lines), {name: _rms(error) for name, error in errors.items()})
    return 0


def measure() -> tuple[dict[str, Array], Array]:
    """Signed AoLP errors (H, W) in degrees, NaN off the ball, and the true DoLP (H, W)."""
    rng = np.random.default_rng(SEED)
    shape = (2 * CAMERA.height, 2 * CAMERA.width)
    view = ring_of_views(1, CAMERA, distance=0.5)[0]
    ball = Sphere(center=np.zeros(3), radius=0.17)
    truth = render_view(view, ball)
    twice = {
        name: 2 * getattr(CAMERA, name) for name in ("width", "height", "fx", "fy", "cx", "cy")
    }
    full = PinholeCamera(**twice)
    i0, i45, i90, i135 = render_view(
        replace(view, camera=full), ball, s0=0.9, background=0.9
    ).intensities
    light = np.stack([0.5 * (i0 + i45 + i90 + i135), i0 - i90, i45 - i135])
    faulty = faulty_sensor(shape, rng, sample_share=0.2)
    ideal = faulty_sensor(shape, rng, gain_sigma=0, angle_sigma_deg=0, extinction_ratio=1e9, dark=0)
    shown = cv2.erode(truth.mask.astype(np.uint8), np.ones((5, 5), np.uint8)) > 0
    shown &= np.nan_to_num(truth.dolp) > MIN_DOLP
    errors = {}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "sensor.toml"
        write_calibration(path, _response(faulty, shape, rng))
        given = CaptureOptions(full_scale=4095)
        for name, sensor, options in (
            ("as recorded", faulty, given),
            ("gains found", faulty, given),
            ("calibrated", faulty, replace(given, calibration=path)),
            ("ideal sensor", ideal, given),
        ):
            samples = sensor.expose(light, np.random.default_rng(SEED))
            capture = Path(folder) / name
            capture.mkdir()
            deep = np.clip(np.rint(samples * 4095), 0, 4095).astype(np.uint16)
            cv2.imwrite(str(capture / "ball.png"), deep)
            opened = open_capture(capture, options)
            if name == "as recorded":
                opened = replace(opened, gains=())
            stokes = opened.load("ball.png")
            error = np.degrees(axial_difference(stokes.aolp, np.nan_to_num(truth.aolp)))
            errors[name] = np.where(shown, error, np.nan)
    return errors, np.nan_to_num(truth.dolp)


def _response(sensor: FaultySensor, shape: tuple[int, int], rng: np.random.Generator) -> Any:
    """Calibrate each sample of the sensor."""

    def frames(s0: float, dolp: float = 0.0, angle: float = 0.0) -> list[NDArray[np.float32]]:
        turn = 2 * np.radians(angle)
        light = s0 * np.array([1.0, dolp * np.cos(turn), dolp * np.sin(turn)])
        whole = np.broadcast_to(light[:, None, None], (3, *shape))
        mean = np.mean([sensor.expose(whole, rng) for _ in range(NUM_FRAMES)], axis=0)
        return [np.asarray(mean, np.float32)]

    return measure_response(
        PATTERN,
        unpolarized=frames(1.4),
        polarized=[(angle, frame) for angle in POLARIZER_DEG for frame in frames(0.9, 1.0, angle)],
        dark=frames(0.0),
        per_sample=True,
    )


def draw(path: Path, errors: dict[str, Array]) -> None:
    """Write the figure: maps of the error without and with calibration, and its distributions."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(10, 3.4), layout="constrained")
    axes = figure.subplots(1, 3, width_ratios=(1, 1, 1.1))
    for axis, name in zip(axes, ("as recorded", "calibrated"), strict=False):
        image = axis.imshow(errors[name], cmap="RdBu", vmin=-3, vmax=3, interpolation="nearest")
        axis.set_title(f"{name}: {_rms(errors[name]):.2f} deg rms")
        axis.set_axis_off()
    figure.colorbar(image, ax=axes[:2], label="AoLP error, deg", shrink=0.8)
    bins = np.linspace(-4, 4, 81)
    colours = ("#D55E00", "#009E73", "#0072B2", "#666666")
    for name, colour in zip(errors, colours, strict=True):
        values = errors[name][np.isfinite(errors[name])]
        style = "--" if name == "ideal sensor" else "-"
        axes[2].hist(
            values, bins, density=True, histtype="step", color=colour, label=name, linestyle=style
        )
    axes[2].set_xlabel("AoLP error, deg")
    axes[2].set_yticks([])
    axes[2].legend(frameon=False)
    FigureCanvasAgg(figure).print_figure(path, dpi=110)


def _rms(error: Array) -> float:
    known = error[np.isfinite(error)]
    return float(np.sqrt(np.mean(known**2))) if known.size else float("nan")


main = script(__file__, __doc__, _calibration, (Arguments, TerminalOptions))

if __name__ == "__main__":
    raise SystemExit(main())
