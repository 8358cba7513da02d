"""Options of every stage: typed, checked, in one place.

Each stage takes its own frozen dataclass. The command line makes its flags from the fields
(``option`` carries the help text), and the run writes the resolved values into ``run.json``.
"""

from __future__ import annotations

import math
import os
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from polmvs.choices import AngleModel as AngleModel
from polmvs.choices import BayerOrder as BayerOrder
from polmvs.choices import CaptureKind as CaptureKind
from polmvs.choices import Channel as Channel
from polmvs.choices import Contour as Contour
from polmvs.choices import Estimator as Estimator
from polmvs.choices import Light as Light
from polmvs.choices import Method as Method
from polmvs.choices import Packing as Packing
from polmvs.choices import Resolution as Resolution
from polmvs.choices import Surroundings as Surroundings
from polmvs.errors import OptionError

MAX_DEFAULT_WORKERS = 8  # each holds a few hundred MB


def option(default: Any, help_text: str) -> Any:
    """A dataclass field with its help text, which names the unit."""
    return field(default=default, metadata={"help": help_text})


def default_num_workers() -> int:
    """One process for each core that this one may use, at most ``MAX_DEFAULT_WORKERS``."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, min(cores or 1, MAX_DEFAULT_WORKERS))


def _require(holds: bool, message: str) -> None:
    if not holds:
        raise OptionError(message)


@dataclass(frozen=True, kw_only=True)
class CaptureOptions:
    """What a capture's files hold, and how they become polarization images."""

    pattern: tuple[int, int, int, int] = option(
        (90, 45, 135, 0), "polarizer angles of a 2x2 cell in degrees, row by row"
    )
    gamma: float = option(1.0, "encoding gamma: linear = (raw / full scale) ** (1 / gamma)")
    saturation: float = option(0.98, "share of full scale from which a sample counts as clipped")
    darkness: float = option(0.004, "share of full scale under which a pixel counts as dark")
    full_scale: float | None = option(
        None, "value of a saturated sample; by default decided from the samples of all files"
    )
    kind: CaptureKind | None = option(
        None,
        "what the files hold: raw mosaics, an image for each polarizer angle, Stokes images, or "
        "angle and degree of polarization; by default told by their names",
    )
    naming: str | None = option(
        None,
        "file names below CAPTURE, with {view} and where they apply {angle} (degrees), {index}, "
        "{stokes} (s0 s1 s2), {map} (aolp dolp intensity), {exposure} (seconds, or with ms or "
        "us), {any}: for example '{view}/I{angle}.tif'",
    )
    angles: tuple[float, ...] | None = option(
        None, "polarizer angles in degrees of the images of a view, in the order of {index}"
    )
    bayer: BayerOrder | None = option(
        None, "colours of a colour sensor's 2x2 blocks of polarizers, row by row"
    )
    channel: Channel = option(
        Channel.COMBINED, "one colour of a colour capture, or all, weighted by their noise"
    )
    resolution: Resolution = option(
        Resolution.HALF, "size of a mosaic's polarization images: half or all of its own"
    )
    clockwise: bool = option(
        False, "angles of polarizers, Stokes or AoLP images are counted clockwise as displayed"
    )
    zero_deg: float = option(
        0.0, "direction that angles are counted from, degrees anticlockwise from +x as displayed"
    )
    calibration: Path | None = option(
        None, "TOML file of 'polmvs calibrate polarizers': gains, angles, dark frame, flat field"
    )
    width: int | None = option(None, "width of .raw and .bin dumps, px")
    height: int | None = option(None, "height of .raw and .bin dumps, px")
    packing: Packing | None = option(
        None, "how dumps hold their samples; by default told by their length where only one fits"
    )

    def __post_init__(self) -> None:
        _require(
            sorted(self.pattern) == [0, 45, 90, 135],
            f"--pattern needs each of 0, 45, 90, 135 once, not {self.pattern}.",
        )
        _require(0.1 <= self.gamma <= 10, f"--gamma must lie in 0.1 to 10, not {self.gamma}.")
        _require(
            0 < self.saturation <= 1, f"--saturation must lie in 0 to 1, not {self.saturation}"
        )
        _require(0 <= self.darkness < 0.5, f"--darkness must lie in 0 to 0.5, not {self.darkness}.")
        _require(
            self.full_scale is None or 0 < self.full_scale < math.inf,
            f"--full-scale must be positive, not {self.full_scale}.",
        )
        _require(
            self.naming is None or "{view}" in self.naming,
            f"--naming needs {{view}}, not {self.naming!r}.",
        )
        _require(
            self.angles is None or len({angle % 180 for angle in self.angles}) >= 3,
            f"--angles needs three or more different angles, not {self.angles}.",
        )
        for name, side in (("--width", self.width), ("--height", self.height)):
            _require(side is None or 0 < side < 1 << 16, f"{name} must be positive, not {side}.")


@dataclass(frozen=True, kw_only=True)
class SfmOptions:
    """Where poses come from."""

    intrinsics: tuple[float, ...] | None = option(
        None, "fx,fy,cx,cy of the half-size polarization images, px, COLMAP's convention"
    )
    camera_model: str = option(
        "SIMPLE_RADIAL", "COLMAP camera model to estimate where no intrinsics are given"
    )
    sparse: Path | None = option(None, "existing COLMAP model to use instead of running SfM")
    single_camera: bool = option(True, "all images share one camera")
    seed: int = option(0, "random seed of SfM")

    def __post_init__(self) -> None:
        if self.intrinsics is not None:
            _require(
                len(self.intrinsics) == 4 and min(self.intrinsics) > 0,
                f"--intrinsics needs four positive numbers fx,fy,cx,cy, not {self.intrinsics}.",
            )


@dataclass(frozen=True, kw_only=True)
class RegionOptions:
    """Where the part is and which phase its light shows."""

    light: Light | None = option(
        None, "reflection that dominates the polarisation; by default decided for each part"
    )
    min_dolp: float = option(0.1, "DoLP from which a pixel's phase is used on its own")
    mask: Path | None = option(
        None,
        "folder of masks, STEM.png or STEM_mask.png for each image, of the size of the "
        "polarization images, not 0 on the part; without it the part is found",
    )

    def __post_init__(self) -> None:
        _require(0 < self.min_dolp < 1, f"--min-dolp must lie in 0 to 1, not {self.min_dolp}.")


@dataclass(frozen=True, kw_only=True)
class NormalOptions:
    """How normals are solved from phase angles."""

    estimator: Estimator = option(Estimator.ROBUST, "weighted robust, or the paper's eigenvector")
    window_px: int = option(17, "side of the window of rows about a track's point, px")
    unseeded: bool = option(True, "place parts without a sparse point by their outlines")
    tilt_aware_weights: bool = option(
        True,
        "OPA and PPA: rows of oblique rays count less, by the turn that a tilt of the polarizers "
        "would give their phase; without it the models are pure",
    )

    def __post_init__(self) -> None:
        _require(
            self.window_px >= 1 and self.window_px % 2 == 1,
            f"--window-px must be odd and positive, not {self.window_px}.",
        )


@dataclass(frozen=True, kw_only=True)
class PropagationOptions:
    """How ranges spread from the seeds over the polarised region."""

    method: Method = option(
        Method.INTEGRATE,
        "'integrate': multi-view normals over the region's pixels, coarse to fine; 'contour': "
        "along phase contours, as in the paper",
    )
    contour: Contour = option(
        Contour.TANGENT,
        "contours: 'tangent' (iso-range under PPA, one view) or 'normals' (multi-view normals "
        "along the iso-depth paths, as in the paper)",
    )
    step_px: float = option(0.5, "step of the contours, px")
    spacing_px: float = option(6.0, "distance between contours and between their nodes, px")
    stride_px: int = option(2, "distance between the dense points of one view, px")
    num_rounds: int = option(
        6, "rounds of normals and ranges; of integrate on its coarsest lattice, two finer follow"
    )
    bending: float = option(
        0.002,
        "standard deviation, as a share of the distance, of the smooth bending of a surface by "
        "errors of the camera model, which the seeds correct; 0: none",
    )
    max_neighbors: int = option(15, "other views that give rows to one view")

    def __post_init__(self) -> None:
        _require(0.05 <= self.step_px <= 4, f"--step-px must lie in 0.05 to 4, not {self.step_px}.")
        _require(
            self.step_px <= self.spacing_px <= 64,
            f"--spacing-px must lie in {self.step_px} to 64, not {self.spacing_px}.",
        )
        _require(1 <= self.stride_px <= 16, f"--stride-px must lie in 1 to 16: {self.stride_px}.")
        _require(
            1 <= self.num_rounds <= 20, f"--num-rounds must lie in 1 to 20: {self.num_rounds}."
        )
        _require(0 <= self.bending <= 0.1, f"--bending must lie in 0 to 0.1, not {self.bending}.")
        _require(
            self.max_neighbors >= 1, f"--max-neighbors must be 1 or more: {self.max_neighbors}."
        )


@dataclass(frozen=True, kw_only=True)
class FusionOptions:
    """How the views' points become one cloud."""

    min_views: int = option(2, "views that must agree on a point, its own included")
    max_range_difference_px: float = option(
        2.0, "disagreement of two views' distances, in footprints of a pixel"
    )
    max_normal_difference_deg: float = option(15.0, "disagreement of two views' normals, degrees")
    voxel_px: float = option(
        0.5, "edge of the merging voxel, in footprints of a pixel; 0: no merging"
    )
    voxel: float | None = option(
        None, "edge of the merging voxel in units of the model, instead of --voxel-px; 0: none"
    )
    surroundings: Surroundings = option(
        Surroundings.SPARSE,
        "what the cloud holds beside the polarised parts: nothing, the sparse points, or points "
        "of OpenCV's stereo",
    )
    workspace: Path | None = option(
        None,
        "COLMAP dense workspace of the same images: its depth maps are kept, their holes filled, "
        "and its points are the surroundings",
    )

    def __post_init__(self) -> None:
        _require(self.min_views >= 1, f"--min-views must be 1 or more, not {self.min_views}.")
        _require(self.max_range_difference_px > 0, "--max-range-difference-px must be positive.")
        _require(
            0 < self.max_normal_difference_deg <= 90,
            "--max-normal-difference-deg must lie in 0 to 90.",
        )
        _require(self.voxel_px >= 0, "--voxel-px must not be negative.")
        _require(self.voxel is None or self.voxel >= 0, "--voxel must not be negative.")


@dataclass(frozen=True, kw_only=True)
class ExportOptions:
    """What is made of a dense cloud."""

    mesh: bool = option(True, "a Poisson mesh, where the cloud supports it")
    colmap: bool = option(True, "a COLMAP dense workspace with depth and normal maps")
    in_place: bool = option(
        False, "fill --workspace itself, after a backup, and not a copy of it in OUT"
    )


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions:
    """What the results are measured against."""

    gt: Path | None = option(
        None, "folder of the ground truth (cameras.json and maps), or the capture's that has gt/"
    )


def _is_positive(value: str | float) -> bool:
    """Whether a number, or its text, is finite and positive."""
    try:
        return 0 < float(value) < math.inf
    except ValueError:
        return False


@dataclass(frozen=True, kw_only=True)
class ReferenceOptions:
    """What gives the reconstruction its metric scale and frame; nothing does by default."""

    reference: Path | None = option(
        None,
        "known camera centres in metres: .json (image name to center or cam_from_world) or .txt "
        "(lines: name x y z); they fix scale, rotation and origin",
    )
    aruco: str | None = option(
        None,
        "DICT:SIZE of printed markers in the scene, such as DICT_4X4_50:0.05, SIZE the side of "
        "the black square in metres; fixes the scale",
    )
    scale: tuple[str, str, float] | None = field(
        default=None,
        metadata={
            "help": "distance in metres between two images' cameras or sparse points (ids)",
            "metavar": ("A", "B", "DISTANCE"),
        },
    )

    def __post_init__(self) -> None:
        if self.aruco is not None:
            name, _, size = self.aruco.rpartition(":")
            _require(
                bool(name) and _is_positive(size),
                "--aruco needs DICT:SIZE with a positive size in metres, such as "
                f"DICT_4X4_50:0.05, not {self.aruco}.",
            )
        if self.scale is not None:
            first, second, distance = self.scale
            _require(first != second, f"--scale needs two different ends, not {first} twice.")
            _require(_is_positive(distance), f"--scale needs a positive distance, not {distance}.")


@dataclass(frozen=True, kw_only=True)
class Options:
    """All that decides the result of a run, by stage."""

    capture: CaptureOptions = field(default_factory=CaptureOptions)
    sfm: SfmOptions = field(default_factory=SfmOptions)
    reference: ReferenceOptions = field(default_factory=ReferenceOptions)
    region: RegionOptions = field(default_factory=RegionOptions)
    normals: NormalOptions = field(default_factory=NormalOptions)
    propagation: PropagationOptions = field(default_factory=PropagationOptions)
    fusion: FusionOptions = field(default_factory=FusionOptions)
    export: ExportOptions = field(default_factory=ExportOptions)
    evaluation: EvaluationOptions = field(default_factory=EvaluationOptions)


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How a run is carried out; nothing here changes its result."""

    overwrite: bool = option(False, "delete an earlier run's results in OUT first")
    resume: bool = option(False, "go on with the run in OUT at its first unfinished stage")
    workers: int = option(default_num_workers(), "processes to share the views among")

    def __post_init__(self) -> None:
        _require(
            not (self.overwrite and self.resume), "--overwrite and --resume exclude each other."
        )
        _require(self.workers >= 1, f"--workers must be 1 or more, not {self.workers}.")
