"""Errors of the measured phase on a part whose true normals are known."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import PurePosixPath

import numpy as np
from numpy.typing import NDArray

from polmvs.config import AngleModel
from polmvs.evaluation.metrics import AngleStats
from polmvs.evaluation.truth_errors import phase_errors_on_part
from polmvs.io.ground_truth import GroundTruth
from polmvs.polarization.angle_models import correct_stokes
from polmvs.polarization.capture import Capture
from polmvs.polarization.phase_map import PhaseMap, as_tilted, view_rays

Image = NDArray[np.float32]
Load = Callable[[str], tuple[Image, Image]]  # phase and DoLP (H, W) of an image, by its name


class LazyPhases(Mapping[str, Image]):
    """Phase of images by name, with their DoLP in ``dolps``; one image is held at a time.

    Parameters
    ----------
    names : of the images.
    load : gives phase and DoLP (H, W) of an image.
    """

    def __init__(self, names: Sequence[str], load: Load) -> None:
        self.names = tuple(names)
        self.load = load
        self.dolps: dict[str, Image] = {}

    def __getitem__(self, name: str) -> Image:
        """Phase (H, W), rad, NaN where there is none; its DoLP is then in ``dolps``."""
        phase, dolp = self.load(name)
        self.dolps.clear()
        self.dolps[name] = dolp
        return phase

    def __iter__(self) -> Iterator[str]:
        return iter(self.names)

    def __len__(self) -> int:
        return len(self.names)


def phase_errors(
    capture: Capture, maps: Sequence[PhaseMap], truth: GroundTruth
) -> dict[str, dict[AngleModel, AngleStats]]:
    """Errors of the measured phase on the part, under each model with the true normals.

    Parameters
    ----------
    capture : whose single pixels are measured too.
    maps : phase maps, as OPA and PPA use them.
    truth : with the true normals.

    Returns
    -------
    ``maps``: of the phase maps, which the geometry uses. ``pixels``: of the single pixels of the
    capture, those neither clipped nor dark.
    """
    stored = {stem_of(phase_map.view.name): phase_map for phase_map in maps}
    raw = {stem_of(name): name for name in capture.names}

    def of_map(name: str) -> tuple[Image, Image]:
        return _of_map(stored[stem_of(name)])

    def of_pixels(name: str, *, tilted: bool) -> tuple[Image, Image]:
        phase_map = stored[stem_of(name)]
        stokes = capture.load(raw[stem_of(name)])
        if tilted:
            rays = view_rays(phase_map.view)
            stokes = correct_stokes(stokes, rays, diffuse=phase_map.diffuse)
        turn = np.where(phase_map.diffuse, np.float32(0), np.float32(np.pi / 2))
        return np.where(stokes.valid, stokes.aolp + turn, np.float32(np.nan)), stokes.dolp

    sources: dict[str, tuple[Load, Load]] = {
        "maps": (of_map, lambda name: _of_map(as_tilted(stored[stem_of(name)]))),
        "pixels": (partial(of_pixels, tilted=False), partial(of_pixels, tilted=True)),
    }
    names = [name for name in truth.names if stem_of(name) in stored]
    errors = {}
    for source, (measured, as_ppa) in sources.items():
        phases, ppa_phases = LazyPhases(names, measured), LazyPhases(names, as_ppa)
        errors[source] = phase_errors_on_part(phases, phases.dolps, truth)
        # The corrected phase is one that PPA predicts.
        of_tilted = phase_errors_on_part(ppa_phases, ppa_phases.dolps, truth)[AngleModel.PPA]
        errors[source][AngleModel.TILTED] = of_tilted
    return errors


def _of_map(phase_map: PhaseMap) -> tuple[Image, Image]:
    """Phase, NaN where there is none, and DoLP of a phase map."""
    cos, sin, precision = np.moveaxis(phase_map.samples, -1, 0)
    phase = np.where(precision > 0, 0.5 * np.arctan2(sin, cos), np.nan)
    return phase.astype(np.float32), np.hypot(cos, sin)


def stem_of(name: str) -> str:
    """Name of an image without folder and suffix."""
    return PurePosixPath(name).stem
