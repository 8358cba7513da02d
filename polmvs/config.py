"""Options of every stage and command: typed, checked, in one place.

Each stage takes its own frozen dataclass, a *group*. Flags, TOML keys, help, the record in
``run.json`` and the messages all come from the groups' fields (:func:`option` carries the help and
the range). An option is named by its path ``group.field`` such as ``propagation.step_px``, in
messages between backquotes; only the command line knows flags.

This module is light, so that ``--help`` is: it imports neither NumPy nor anything of this package
but the errors and the names of angle models. msgspec, which checks and converts values, is
imported when it is needed.
"""

from __future__ import annotations

import dataclasses
import functools
import math
import os
import re
import sys
import types
import typing
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any, ClassVar, TypeVar

from polmvs.errors import OptionError
from polmvs.polarization.kinds import FORMULAS, AngleModel, Light

MAX_PIXELS = 1 << 27  # of an image: four times the largest polarization sensors, a guess
MAX_DEFAULT_WORKERS = 8  # each holds a few hundred MB

T = TypeVar("T")


class Method(StrEnum):
    """Method that makes the surface from the phases."""

    SURFACE = "surface"
    CONTOUR = "contour"


class Contour(StrEnum):
    """Method of tracing a PPA contour."""

    TANGENT = "tangent"
    NORMALS = "normals"


class Surroundings(StrEnum):
    """Points of a cloud around the polarized parts."""

    NONE = "none"
    SPARSE = "sparse"
    STEREO = "stereo"


class Estimator(StrEnum):
    """Estimator of a normal from its rows."""

    ROBUST = "robust"
    ALGEBRAIC = "algebraic"


class Experiment(StrEnum):
    """The paper's experiments."""

    PHASE = "phase"
    PLANE = "plane"
    TRACKS = "tracks"
    CONTOURS = "contours"


class Poses(StrEnum):
    """Poses of an experiment."""

    TRUE = "true"
    SFM = "sfm"


class Selection(StrEnum):
    """Choice of the K views of a point in the experiment on tracks."""

    RANDOM = "random"
    ANGLE = "angle"


class PairChoice(StrEnum):
    """Choice of the image pairs that SfM matches, unless a list is given."""

    EXHAUSTIVE = "exhaustive"
    RETRIEVAL = "retrieval"
    SEQUENTIAL = "sequential"


class Mapper(StrEnum):
    """Mapper of SfM."""

    INCREMENTAL = "incremental"
    GLOBAL = "global"


class Packing(StrEnum):
    """Packing of the samples in a dump without a header."""

    MONO8 = "mono8"
    MONO16 = "mono16"
    MONO10P = "mono10p"
    MONO12P = "mono12p"
    MONO10PACKED = "mono10packed"
    MONO12PACKED = "mono12packed"


class ExportFormat(StrEnum):
    """Format of an exported run."""

    PLY = "ply"
    OBJ = "obj"
    STL = "stl"
    GLB = "glb"
    CLOUD_PLY = "cloud-ply"
    XYZ = "xyz"
    LAS = "las"
    LAZ = "laz"
    NERFSTUDIO = "nerfstudio"
    NEUS = "neus"
    METASHAPE = "metashape"
    REALITYSCAN = "realityscan"
    BUNDLER = "bundler"


class CaptureKind(StrEnum):
    """Kind of the files of a capture."""

    MOSAIC = "mosaic"
    ANGLES = "angles"
    STOKES = "stokes"
    AOLP = "aolp"


class BayerOrder(StrEnum):
    """Colours of the 2x2 blocks of polarizers of a colour sensor, row by row."""

    RGGB = "rggb"
    GRBG = "grbg"
    GBRG = "gbrg"
    BGGR = "bggr"


class Channel(StrEnum):
    """Colour channel of the Stokes images."""

    COMBINED = "combined"
    RED = "red"
    GREEN = "green"
    BLUE = "blue"


class Resolution(StrEnum):
    """Size of the polarization images of a mosaic."""

    HALF = "half"
    FULL = "full"


def option(
    default: Any,
    help_text: str,
    *,
    positional: bool = False,
    least: float | None = None,
    most: float | None = None,
    above: float | None = None,
    below: float | None = None,
    metavar: str | tuple[str, ...] | None = None,
) -> Any:
    """A field of a group of options.

    Parameters
    ----------
    default : its value where none is given; ``dataclasses.MISSING`` where one must be.
    help_text : what it means, with the unit. Other options are named as in messages.
    positional : on the command line it is an argument and has no flag.
    least, most, above, below : the range of a number, its ends included or not.
    metavar : name of the value in the help; several for a mixed tuple.
    """
    return field(
        default=default,
        metadata={
            "help": help_text,
            "range": Range(least=least, most=most, above=above, below=below),
            "metavar": metavar,
            "positional": positional,
        },
    )


@dataclass(frozen=True, kw_only=True)
class Range:
    """Range of an option's numbers; None: no limit on that side.

    Attributes
    ----------
    least, most : ends that belong to it.
    above, below : ends that do not.
    """

    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None

    def __contains__(self, value: float) -> bool:
        """Whether a number is one of these."""
        return (
            abs(value) <= sys.float_info.max  # not NaN, and no integer beyond all floats
            and (self.least is None or value >= self.least)
            and (self.most is None or value <= self.most)
            and (self.above is None or value > self.above)
            and (self.below is None or value < self.below)
        )

    def __str__(self) -> str:
        """The condition, as messages have it after "must"."""
        low = self.least if self.above is None else self.above
        high = self.most if self.below is None else self.below
        if low is not None and high is not None:
            names = ", ends excluded" if self.above is not None and self.below is not None else ""
            return f"lie in {low:g} to {high:g}{names}"
        if self.least is not None:
            return f"be {self.least:g} or more"
        if self.above is not None:
            return "be positive" if self.above == 0 else f"be over {self.above:g}"
        if high is not None:
            return f"be {high:g} or less" if self.below is None else f"be under {high:g}"
        return "be a finite number"


class OptionGroup:
    """Base of the groups: checks every field when an object is made.

    A subclass names its group as a class keyword, ``class SfmOptions(OptionGroup, group="sfm")``,
    and adds its own conditions in ``check``.

    Attributes
    ----------
    group : name of the group, in paths, TOML files and ``run.json``.
    in_files : whether a TOML file of options may have a table of it.
    """

    group: ClassVar[str] = ""
    in_files: ClassVar[bool] = True

    def __init_subclass__(cls, *, group: str, in_files: bool = True, **kwargs: Any) -> None:
        super().__init_subclass__(**kwargs)
        cls.group = group
        cls.in_files = in_files

    def __post_init__(self) -> None:
        """Convert the values to their fields' types by :func:`convert_value` and check them.

        Raises
        ------
        OptionError
            A value is of the wrong type, out of its range, or contradicts another one.
        """
        for info in describe_fields(type(self)):
            value = convert_value(info, getattr(self, info.name))
            object.__setattr__(self, info.name, value)
            for number in _numbers(value):
                self.require(number in info.range, info.name, f"must {info.range}", value)
        self.check()

    def check(self) -> None:
        """Raise OptionError where values contradict each other; nothing by default."""

    def require(self, holds: bool, name: str, reason: str, *value: Any) -> None:
        """Raise OptionError for a field unless something holds.

        Parameters
        ----------
        holds : what must be true.
        name : of the field.
        reason : what must hold, as a sentence without the option's name and without its end.
        value : what was given instead, if it helps.
        """
        if not holds:
            given = f", not {show_value(value[0])}" if value else ""
            raise OptionError(f"{reason}{given}.", field=f"{self.group}.{name}")


def _numbers(value: Any) -> Iterator[float]:
    """A value that is a number, or those in a tuple."""
    if isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield value


def default_num_workers() -> int:
    """One process for each core that this one may use, at most ``MAX_DEFAULT_WORKERS``."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return max(1, min(cores or 1, MAX_DEFAULT_WORKERS))


@dataclass(frozen=True, kw_only=True)
class CaptureOptions(OptionGroup, group="capture"):
    """What a capture's files hold, and how they become polarization images."""

    pattern: tuple[int, int, int, int] = option(
        (90, 45, 135, 0), "polarizer angles of a 2x2 cell in degrees, row by row"
    )
    gamma: float = option(
        1.0, "encoding gamma: linear = (raw / full scale) ** (1 / gamma)", least=0.1, most=10
    )
    saturation: float = option(
        0.98, "share of full scale from which a sample counts as clipped", above=0, most=1
    )
    darkness: float = option(
        0.004, "share of full scale under which a pixel counts as dark", least=0, below=0.5
    )
    full_scale: float | None = option(
        None,
        "value of a saturated sample; by default decided from the samples of all files",
        above=0,
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
    equalize: bool = option(
        False,
        "images of a view behind different polarizer angles differ in exposure: divide them by the "
        "gains that unpolarized places show",
    )
    calibration: Path | None = option(
        None, "TOML file of 'polmvs calibrate polarizers': gains, angles, dark frame, flat field"
    )
    width: int | None = option(None, "width of .raw and .bin dumps, px", least=1, below=1 << 16)
    height: int | None = option(None, "height of .raw and .bin dumps, px", least=1, below=1 << 16)
    packing: Packing | None = option(
        None, "how dumps hold their samples; by default told by their length where only one fits"
    )

    max_pixels: int = option(
        MAX_PIXELS,
        "most pixels of an image, as its header says; a larger one is refused before it is decoded",
        least=1,
    )

    def check(self) -> None:
        """Each angle of a pattern occurs once, names distinguish views, angles are enough."""
        needed = sorted(self.pattern) == [0, 45, 90, 135]
        self.require(needed, "pattern", "needs each of 0, 45, 90, 135 once", self.pattern)
        named = self.naming is None or "{view}" in self.naming
        self.require(named, "naming", "needs {view}", self.naming)
        enough = self.angles is None or len({angle % 180 for angle in self.angles}) >= 3
        self.require(enough, "angles", "needs three or more different angles", self.angles)


@dataclass(frozen=True, kw_only=True)
class SfmOptions(OptionGroup, group="sfm"):
    """Where poses come from."""

    intrinsics: tuple[float, ...] | None = option(
        None,
        "fx,fy,cx,cy of the half-size polarization images, px, COLMAP's convention",
        metavar="FX,FY,CX,CY",
    )
    camera: Path | None = option(
        None,
        "file of a calibrated camera of the mosaics or the polarization images: OpenCV, ROS or "
        "Kalibr (YAML, JSON), or a camera line of COLMAP",
    )
    camera_model: str = option(
        "SIMPLE_RADIAL", "COLMAP camera model to estimate where no intrinsics are given"
    )
    sparse: Path | None = option(None, "existing COLMAP model to use instead of running SfM")
    single_camera: bool = option(True, "all images share one camera")
    pairs: str | None = option(
        None,
        "which images are matched: 'exhaustive', all with all; 'retrieval', each with those most "
        "similar to it, and with its neighbours where names count up; 'sequential', each with "
        "those after it by name; or a text file with two names on each line; by default all of up "
        "to 40, retrieval of more",
        metavar="exhaustive|retrieval|sequential|FILE",
    )
    database: Path | None = option(
        None,
        "COLMAP database of the same images at the size of the polarization images: its features, "
        "and where it has any its matches, are used instead of new ones, and its cameras unless "
        "`sfm.intrinsics` or `sfm.camera` are given; it is not changed",
    )
    mapper: Mapper = option(
        Mapper.INCREMENTAL,
        "'incremental': images one after the other; 'global': all at once, in less time where they "
        "are many",
    )
    seed: int = option(0, "random seed of SfM")
    static_background: bool = option(
        True,
        "find a background that stands still while the part turns on a table, and leave its "
        "features out",
    )
    feature_masks: Path | None = option(
        None,
        "folder of masks, NAME.png of each image: SfM takes features inside them alone; "
        "for a part that turns before a background, where `sfm.static_background` does not help",
    )
    aliked: Path | None = option(
        None,
        "weights of ALIKED-N16ROT, an ONNX file: learned features instead of SIFT; needs "
        "`sfm.lightglue` and a pycolmap that was built with ONNX",
    )
    lightglue: Path | None = option(
        None, "weights of LightGlue for ALIKED, an ONNX file: matches the features of `sfm.aliked`"
    )
    without: tuple[str, ...] = option(
        (),
        "images to take out of the model; a run adds those whose pose its surface contradicts",
        metavar="NAME,...",
    )

    def check(self) -> None:
        """Intrinsics are valid, and options of SfM are not given with a model."""
        _require_intrinsics(self, self.intrinsics)
        once = self.intrinsics is None or self.camera is None
        self.require(once, "camera", "and `sfm.intrinsics` exclude each other")
        if self.sparse is not None:
            reason = "is for SfM, in whose place a COLMAP model is given with `sfm.sparse`"
            self.require(self.pairs is None, "pairs", reason)
            self.require(self.database is None, "database", reason)
            self.require(self.mapper is Mapper.INCREMENTAL, "mapper", reason)
            self.require(self.feature_masks is None, "feature_masks", reason)
            self.require(self.aliked is None, "aliked", reason)
        both = (self.aliked is None) == (self.lightglue is None)
        missing, given = ("lightglue", "aliked") if self.aliked else ("aliked", "lightglue")
        self.require(both, given, f"needs `sfm.{missing}` as well")
        once = self.database is None or self.aliked is None
        self.require(once, "aliked", "and `sfm.database`, which has features, exclude each other")
        once = self.database is None or self.feature_masks is None
        self.require(
            once, "feature_masks", "and `sfm.database`, which has features, exclude each other"
        )
        if self.pairs_file is not None:  # a run may go on from another folder
            object.__setattr__(self, "pairs", str(self.pairs_file.absolute()))

    @property
    def known_camera(self) -> str | None:
        """Option that gives the camera; None if the camera is estimated."""
        given = "sfm.camera" if self.camera is not None else None
        return given if self.intrinsics is None else "sfm.intrinsics"

    @property
    def pairs_file(self) -> Path | None:
        """The list of pairs, if ``pairs`` names one."""
        is_file = self.pairs is not None and self.pairs not in set(PairChoice)
        return Path(self.pairs or "") if is_file else None


def _require_intrinsics(options: OptionGroup, given: tuple[float, ...] | None) -> None:
    if given is not None:
        positive = len(given) == 4 and min(given) > 0
        options.require(positive, "intrinsics", "needs four positive numbers fx,fy,cx,cy", given)


@dataclass(frozen=True, kw_only=True)
class RegionOptions(OptionGroup, group="region"):
    """Where the part is and which phase its light shows."""

    light: Light | None = option(
        None, "reflection that dominates the polarization; by default decided for each part"
    )
    min_dolp: float = option(
        0.1, "DoLP from which a pixel's phase is used on its own", above=0, below=1
    )
    mask: Path | None = option(
        None,
        "folder of masks, STEM.png or STEM_mask.png for each image, of the size of the "
        "polarization images, not 0 on the part; without it the part is found",
    )


@dataclass(frozen=True, kw_only=True)
class NormalOptions(OptionGroup, group="normals"):
    """How normals are solved from phase angles."""

    estimator: Estimator = option(Estimator.ROBUST, "weighted robust, or the paper's eigenvector")
    window_px: int = option(17, "side of the window of rows about a track's point, px", least=1)
    tilt_aware_weights: bool = option(
        True,
        "what OPA and PPA leave out is made up for: their rows count less the further a tilt of "
        "the polarizers would turn the phases, OPA's also the further perspective turns them, and "
        "the surface of all views takes back the share of the tilt that its phases show; without "
        "it the models are pure",
    )

    def check(self) -> None:
        """The window has a centre pixel."""
        self.require(self.window_px % 2 == 1, "window_px", "must be odd", self.window_px)


@dataclass(frozen=True, kw_only=True)
class PropagationOptions(OptionGroup, group="propagation"):
    """How ranges spread from the seeds over the polarized region."""

    method: Method = option(
        Method.SURFACE,
        "'surface': one mesh that all views agree on, from their silhouettes and phases; "
        "'contour': view by view along phase contours, as in the paper",
    )
    contour: Contour = option(
        Contour.TANGENT,
        "contours: 'tangent' (iso-range under PPA, one view) or 'normals' (multi-view normals "
        "along the iso-depth paths, as in the paper)",
    )
    step_px: float = option(0.5, "step of the contours, px", least=0.05, most=4)
    spacing_px: float = option(
        6.0, "distance between contours and between their nodes, px", least=0.05, most=64
    )
    stride_px: int = option(
        2, "distance between the dense points of one view, px", least=1, most=16
    )
    num_rounds: int = option(6, "rounds of normals and ranges", least=1, most=20)
    bending: float = option(
        0.002,
        "standard deviation, as a share of the distance, of the smooth bending of a surface by "
        "errors of the camera model, which the seeds correct; 0: none",
        least=0,
        most=0.1,
    )
    max_neighbors: int = option(15, "other views that give rows to one view", least=1)

    def check(self) -> None:
        """The spacing of contours is not smaller than their step."""
        wide = self.spacing_px >= self.step_px
        reason = "must be as long as `propagation.step_px` or longer"
        self.require(wide, "spacing_px", reason, self.spacing_px)


@dataclass(frozen=True, kw_only=True)
class FusionOptions(OptionGroup, group="fusion"):
    """How the views' points become one cloud."""

    min_views: int = option(2, "views that must agree on a point, its own included", least=1)
    max_range_difference_px: float = option(
        2.0,
        "disagreement of two views' distances, in GSD (length of a pixel at the surface)",
        above=0,
    )
    max_normal_difference_deg: float = option(
        15.0, "disagreement of two views' normals, degrees", above=0, most=90
    )
    voxel_px: float = option(
        0.5,
        "edge of the merging voxel, in GSD (length of a pixel at the surface); 0: no merging",
        least=0,
    )
    voxel: float | None = option(
        None,
        "edge of the merging voxel in units of the model, instead of `fusion.voxel_px`; 0: none",
        least=0,
    )
    inferred: bool = option(
        True,
        "keep surface that no phase shows: the inner walls of a cavity, inferred from its opening",
    )
    surroundings: Surroundings = option(
        Surroundings.SPARSE,
        "what the cloud holds beside the polarized parts: nothing, the sparse points, or points "
        "of OpenCV's stereo",
    )
    workspace: Path | None = option(
        None,
        "COLMAP dense workspace of the same images: its depth maps are kept, their holes filled, "
        "and its points are the surroundings",
    )


@dataclass(frozen=True, kw_only=True)
class CropOptions(OptionGroup, group="crop"):
    """What of the scene is kept."""

    box: tuple[float, float, float, float, float, float] | None = option(
        None,
        "two opposite corners, in the frame and unit of the model: what of cloud, mesh and maps "
        "lies outside is left out; the report's 3D view gives the text",
        metavar="X,Y,Z,X,Y,Z",
    )
    box_marker: int | None = option(
        None,
        "id of an ArUco marker in whose frame the box is: origin in its middle, x to "
        "its right, y to its top, z out of it, metres",
        least=0,
        metavar="ID",
    )

    def check(self) -> None:
        """A box has three sides, and a marker needs a box."""
        if self.box is not None:
            sides = [
                abs(first - second)
                for first, second in zip(self.box[:3], self.box[3:], strict=True)
            ]
            self.require(min(sides) > 0, "box", "needs corners that differ in x, y and z", self.box)
        self.require(
            self.box_marker is None or self.box is not None, "box_marker", "needs `crop.box`"
        )


@dataclass(frozen=True, kw_only=True)
class ExportOptions(OptionGroup, group="export"):
    """What is made of a dense cloud."""

    mesh: bool = option(True, "a Poisson mesh, where the cloud supports it")
    colmap: bool = option(True, "a COLMAP dense workspace with depth and normal maps")
    in_place: bool = option(
        False, "fill `fusion.workspace` itself, after a backup, and not a copy of it in OUT"
    )


@dataclass(frozen=True, kw_only=True)
class EvaluationOptions(OptionGroup, group="evaluation"):
    """What the results are measured against."""

    gt: Path | None = option(
        None,
        "folder of the ground truth (cameras.json and maps), or the capture's that has gt/",
    )


def _is_positive(value: str | float) -> bool:
    """Whether a number, or its text, is finite and positive."""
    try:
        return 0 < float(value) < math.inf
    except ValueError:
        return False


@dataclass(frozen=True, kw_only=True)
class ReferenceOptions(OptionGroup, group="reference"):
    """What gives metric scale and frame; by default nothing does."""

    reference: Path | None = option(
        None,
        "known camera centres in metres: .json (image name to center or cam_from_world) or .txt "
        "(lines: name x y z); they fix scale, rotation and origin",
    )
    aruco: str | None = option(
        None,
        "DICT:SIZE of printed markers in the scene, such as DICT_4X4_50:0.05, SIZE the side of "
        "the black square in metres; fixes the scale",
        metavar="DICT:SIZE",
    )
    scale: tuple[str, str, float] | None = option(
        None,
        "distance in metres between two images' cameras or sparse points (ids)",
        metavar=("A", "B", "DISTANCE"),
    )

    def check(self) -> None:
        """A marker has a positive size, and a distance two different ends."""
        if self.aruco is not None:
            name, _, size = self.aruco.rpartition(":")
            reason = "needs DICT:SIZE with a positive size in metres, such as DICT_4X4_50:0.05"
            self.require(bool(name) and _is_positive(size), "aruco", reason, self.aruco)
        if self.scale is not None:
            first, second, distance = self.scale
            self.require(first != second, "scale", f"needs two different ends, not {first} twice")
            self.require(_is_positive(distance), "scale", "needs a positive distance", distance)


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
    crop: CropOptions = field(default_factory=CropOptions)
    export: ExportOptions = field(default_factory=ExportOptions)
    evaluation: EvaluationOptions = field(default_factory=EvaluationOptions)

    def __post_init__(self) -> None:
        """Raise OptionError for a value that is not the group expected in its place."""
        for name, cls in groups_of(type(self)).items():
            group = getattr(self, name)
            if not isinstance(group, cls):
                raise OptionError(f"must be {cls.__name__}, not {group!r}.", field=name)


@dataclass(frozen=True, kw_only=True)
class RunOptions(OptionGroup, group="run", in_files=False):
    """How a run is carried out; nothing here changes its result."""

    overwrite: bool = option(False, "delete an earlier run's results in OUT first")
    resume: bool = option(False, "go on with the run in OUT at its first unfinished stage")
    workers: int = option(default_num_workers(), "processes to share the views among", least=1)
    scheduler: str | None = option(
        None,
        "address of a dask.distributed scheduler, such as tcp://10.0.0.1:8786, whose workers share "
        "the views instead of processes here; they must have the same versions, and CAPTURE and "
        "OUT on storage that they see under the same path. Scheduler and workers are trusted: what "
        "they send is run here, and what is sent there is run there",
        metavar="ADDRESS",
    )
    tls_ca: Path | None = option(
        None, "certificate (PEM) that those of a scheduler at tls://... are signed by"
    )
    tls_cert: Path | None = option(None, "certificate of this program for the scheduler (PEM)")
    tls_key: Path | None = option(None, "key of that certificate (PEM)")
    memory: float | None = option(
        None,
        "GB of memory for this process and those that share the views with it: fewer of them and "
        "smaller tiles are used where they need more; a stage that takes more is told",
        above=0,
    )

    def check(self) -> None:
        """Not both."""
        both = self.overwrite and self.resume
        self.require(not both, "overwrite", "and `run.resume` exclude each other")
        given = [path is not None for path in (self.tls_ca, self.tls_cert, self.tls_key)]
        self.require(all(given) == any(given), "tls_ca", "needs `run.tls_cert` and `run.tls_key`")
        encrypted = self.scheduler is not None and self.scheduler.startswith("tls://")
        self.require(encrypted or not any(given), "tls_ca", "needs `run.scheduler` at tls://...")


@dataclass(frozen=True, kw_only=True)
class PlaneOptions(OptionGroup, group="plane"):
    """Which pixels count as a plane, and how its normal is solved."""

    model: AngleModel = option(
        AngleModel.PPA,
        "angle and normal; 'tilted' is exact for a lens that is not telecentric on the image side",
    )
    light: Light = option(Light.SPECULAR, "reflection that dominates the polarization")
    estimator: Estimator = option(Estimator.ROBUST, "weighted robust, or the paper's eigenvector")
    intrinsics: tuple[float, ...] | None = option(
        None,
        "of the half-size polarization image, px, COLMAP's convention; without them centred, with "
        "a focal length of the image's width, which the output says",
        metavar="FX,FY,CX,CY",
    )
    mask: Path | None = option(None, "half-size image, not 0 on the plane")
    polygon: tuple[tuple[float, float], ...] | None = option(
        None, "corners about the plane, half-size px; without it all valid pixels", metavar="X,Y"
    )
    min_dolp: float = option(
        0.1, "degree of polarization from which a pixel counts", above=0, below=1
    )
    min_intensity: float = option(
        0.5,
        "share of the pixels' median intensity from which one counts: where something dark is "
        "reflected, other light shows; 0: all",
        least=0,
        below=1,
    )
    drop_clipped: bool = option(
        False, "leave saturated pixels out; a plane at one exposure loses its brightest part"
    )
    estimate_focal: bool = option(
        False,
        "estimate the focal length from the plane (tilted model); used where `plane.intrinsics` "
        "are not given",
    )
    find_planes: bool = option(False, "find all planes in view")

    def check(self) -> None:
        """Only one of mask and polygon is given, and the model can find planes."""
        _require_intrinsics(self, self.intrinsics)
        models = f"must be {', '.join(FORMULAS)}: of one plane they are the published models"
        self.require(not self.model.is_textbook, "model", models, self.model)
        one = self.mask is None or self.polygon is None
        self.require(one, "polygon", "and `plane.mask` exclude each other")
        if self.polygon is not None:
            self.require(
                len(self.polygon) >= 3, "polygon", "needs three corners or more", self.polygon
            )
        apart = not self.find_planes or self.model is not AngleModel.OPA
        reason = "needs `plane.model` ppa or tilted: under OPA planes are lines"
        self.require(apart, "find_planes", reason)


@dataclass(frozen=True, kw_only=True)
class ExperimentOptions(OptionGroup, group="experiment"):
    """What the paper's experiments measure."""

    gt: Path | None = option(None, "ground truth; without it that of CAPTURE")
    poses: Poses = option(Poses.TRUE, "whose poses are used")
    sparse: Path | None = option(None, "COLMAP model of the poses of `experiment.poses` sfm")
    blur_px: float = option(
        # The paper blurs its images and does not say how much; ours are half as wide.
        1.5,
        "deviation of the Gaussian blur before phase and DoLP, px; 0: none",
        least=0,
        most=20,
    )
    views: tuple[str, ...] | None = option(
        None,
        "images that contours are traced in and that figures show; without it all, and a few",
        metavar="NAME,...",
    )
    planar_deg: float = option(
        5.0,
        "plane: spread of the true normals of a planar region, degrees",
        least=0.01,
        most=90,
    )
    num_points: int = option(10_000, "tracks: surface points", least=10, below=1e7)
    k: tuple[int, ...] | None = option(
        None, "tracks: numbers of views; without it 2 to 20, as far as the capture goes"
    )
    select: Selection = option(Selection.RANDOM, "tracks: how the K views of a point are chosen")
    seed: int = option(0, "tracks: random seed", least=0)
    num_seeds: int = option(20, "contours: seeds along the edge in each view", least=1, below=1e7)
    step_px: float = option(0.5, "contours: step of the tracing, px", least=0.05, most=4)

    def check(self) -> None:
        """Estimated poses need a model."""
        agree = (self.poses is Poses.SFM) == (self.sparse is not None)
        self.require(agree, "poses", "sfm and `experiment.sparse` go together")


# The fields of groups, and values as JSON and TOML have them


@dataclass(frozen=True, kw_only=True)
class FieldInfo:
    """One field of a group of options.

    Attributes
    ----------
    group, name : its path is ``group.name``.
    kind : its type without ``None``: a class, or ``tuple[...]``.
    default : its default value.
    help_text : what it means, with the unit.
    range : which numbers it takes.
    metavar : name of its value, or of a mixed tuple's elements, if it has any.
    flag : on the command line.
    positional : it has none, it is an argument.
    """

    group: str
    name: str
    kind: Any
    default: Any
    help_text: str
    range: Range
    metavar: str | tuple[str, ...] | None
    flag: str
    positional: bool

    @property
    def path(self) -> str:
        """Name of the option in messages."""
        return f"{self.group}.{self.name}"


def describe_fields(cls: type) -> tuple[FieldInfo, ...]:
    """Fields of a group of options in order; one without a default is required."""
    key: Any = cls
    return _described(key)


@functools.cache
def _described(cls: Any) -> tuple[FieldInfo, ...]:
    hints = typing.get_type_hints(cls)
    return tuple(
        FieldInfo(
            group=getattr(cls, "group", ""),
            name=f.name,
            kind=_without_none(hints[f.name]),
            default=f.default,
            help_text=f.metadata.get("help", ""),
            range=f.metadata.get("range", Range()),
            metavar=f.metadata.get("metavar"),
            flag="--" + f.name.replace("_", "-"),
            positional=f.metadata.get("positional", False),
        )
        for f in fields(cls)
    )


def groups_of(cls: type) -> Mapping[str, type[OptionGroup]]:
    """Groups of options by name, of a class that holds some, such as :class:`Options`."""
    return typing.get_type_hints(cls)


def option_paths(cls: type = Options) -> tuple[str, ...]:
    """Paths of all options of :class:`Options` or of one group, in order."""
    groups = (cls,) if issubclass(cls, OptionGroup) else groups_of(cls).values()
    return tuple(info.path for group in groups for info in describe_fields(group))


def get_option(options: Options, path: str) -> Any:
    """Value of the option of a path such as ``"sfm.seed"``; KeyError if there is none."""
    group, name = _split(path)
    return getattr(getattr(options, group), name)


def replace_option(options: Options, path: str, value: Any) -> Options:
    """The options with one of another value, checked; KeyError if there is no such path."""
    group, name = _split(path)
    changed = dataclasses.replace(getattr(options, group), **{name: value})
    return dataclasses.replace(options, **{group: changed})


def plain_options(options: Options, paths: Iterable[str]) -> dict[str, Any]:
    """Some options by path, in terms of JSON; the name of a group stands for all that it has."""
    groups = groups_of(Options)
    whole = {name: option_paths(cls) for name, cls in groups.items()}
    every = [path for given in paths for path in whole.get(given, (given,))]
    return {path: to_plain(get_option(options, path)) for path in every}


def with_absolute_paths(options: Options) -> Options:
    """The same files and folders, named so that another process finds them."""
    for path in option_paths():
        value = get_option(options, path)
        if isinstance(value, Path):
            options = replace_option(options, path, value.absolute())
    return options


def _split(path: str) -> tuple[str, str]:
    if path not in option_paths(Options):
        raise KeyError(path)
    group, _, name = path.partition(".")
    return group, name


def to_plain(value: Any) -> Any:
    """A value, or a whole dataclass, in terms of JSON; NaN and infinity become None."""
    if is_dataclass(value) and not isinstance(value, type):
        return {f.name: to_plain(getattr(value, f.name)) for f in fields(value)}
    if isinstance(value, Mapping):
        return {str(key): to_plain(item) for key, item in value.items()}
    if isinstance(value, tuple | list):
        return [to_plain(item) for item in value]
    if isinstance(value, StrEnum):
        return value.value
    if isinstance(value, Path):
        return str(value.absolute())  # a run may go on from another folder
    if hasattr(value, "item"):  # a NumPy scalar
        return to_plain(value.item())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def show_value(value: Any) -> str:
    """A value as messages and the help show it, as a flag takes it."""
    if isinstance(value, tuple | list):
        parts = [show_value(item) for item in value]
        nested = any(isinstance(item, tuple | list) for item in value)
        return (" " if nested else ",").join(parts)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:.15g}"
    return "none" if value is None else str(value)


def from_plain(cls: type[T], values: Mapping[str, Any], source: str = "") -> T:
    """A group of options from JSON or TOML values; fields that are not named keep their default.

    Parameters
    ----------
    cls : the group's class.
    values : by field name.
    source : what the values come from, for messages: a file.

    Raises
    ------
    OptionError
        A name is unknown, or a value is of the wrong type or out of range. Where there is a
        source, the message names it, table and key, and carries no ``field``: what is at fault is
        no flag.
    """
    converted = values_from_plain(cls, values, source)
    try:
        return cls(**converted)
    except OptionError as error:
        raise in_table(error, source) from error


def values_from_plain(cls: type, values: Mapping[str, Any], source: str = "") -> dict[str, Any]:
    """Values of some fields from JSON or TOML, in the fields' types; ranges are not checked.

    Raises
    ------
    OptionError
        A name is unknown, or a value is of the wrong type.
    """
    infos = {info.name: info for info in describe_fields(cls)}
    converted = {}
    for name, value in values.items():
        if name not in infos:
            begin = _table(getattr(cls, "group", ""), source)
            raise OptionError(f"{begin} has an unknown key {name!r}{_near(name, infos)}")
        try:
            converted[name] = convert_value(infos[name], value)
        except OptionError as error:
            raise in_table(error, source) from error
    return converted


def convert_value(info: FieldInfo, value: Any) -> Any:
    """A value in the type of its field; its range is not checked.

    Text that names an enum's member or a path becomes that, a list a tuple, an integer a float
    where one must be, and NumPy's numbers and arrays become Python's. Nothing is rounded.

    Raises
    ------
    OptionError
        The value is of another type.
    """
    if type(value) is info.kind:
        return value
    if value is None:
        if info.default is not None:
            raise OptionError("cannot be none.", field=info.path)
        return None
    if isinstance(info.kind, type) and issubclass(info.kind, StrEnum):
        if not isinstance(value, str) or value not in set(info.kind):
            choices = ", ".join(info.kind)
            raise OptionError(
                f"must be one of {choices}, not {show_value(value)}.", field=info.path
            )
        return info.kind(value)
    import msgspec  # not for --help, nor for a 'polmvs doctor' that says it is missing

    try:
        return msgspec.convert(_as_python(value), info.kind, dec_hook=_decode)
    except msgspec.ValidationError as error:
        expected = str(error).partition(" - at ")[0].replace("`", "")
        raise OptionError(f"cannot be {value!r}: {expected}.", field=info.path) from error


def in_table(error: OptionError, source: str) -> OptionError:
    """The error of an option from a file: it names key and table instead of a flag.

    Parameters
    ----------
    error : of an option.
    source : the file; where it is empty, the error stays as it is.
    """
    if error.field is None or not source:
        return error
    group, _, name = error.field.partition(".")
    reason = re.sub(r"`(\w+)\.(\w+)`", r"[\1] \2", error.reason)
    return OptionError(f"{_table(group, source)} {name} {reason}")


def _table(group: str, source: str) -> str:
    return f"{source}: [{group}]" if source else f"[{group}]"


def options_from_plain(plain: Mapping[str, Any], source: str = "") -> Options:
    """All options from JSON or TOML tables by group; missing options keep their defaults.

    Raises
    ------
    OptionError
        As :func:`from_plain`; also for an unknown table.
    """
    groups = groups_of(Options)
    for name in plain:
        require_table(name, plain[name], groups, source)
    made: dict[str, Any] = {
        name: from_plain(cls, plain.get(name, {}), source) for name, cls in groups.items()
    }
    return Options(**made)


def require_table(name: str, table: Any, known: Iterable[str], source: str) -> None:
    """Raise OptionError unless this is a table of options with a known name."""
    begin = f"{source}: " if source else ""
    names = tuple(known)
    if name not in names:
        what = "unknown table" if isinstance(table, Mapping) else "a key outside the tables,"
        raise OptionError(f"{begin}{what} {name!r}{_near(name, names)}")
    if not isinstance(table, Mapping):
        raise OptionError(f"{begin}{name!r} must be a table, [{name}].")


def _as_python(value: Any) -> Any:
    """Text for a path, and NumPy's numbers and arrays as Python's, in lists too."""
    if isinstance(value, tuple | list):
        return [_as_python(item) for item in value]
    if isinstance(value, os.PathLike):
        return os.fspath(value)
    return value.tolist() if hasattr(value, "tolist") else value


def _decode(kind: Any, value: Any) -> Any:
    """Convert types that msgspec does not support."""
    if kind is Path:
        if not isinstance(value, str):
            raise ValueError("Expected a path")
        return Path(value)
    raise NotImplementedError(f"no option is of type {kind}")


def _near(name: str, known: Iterable[str]) -> str:
    """The name that was probably meant, or all names."""
    import difflib

    names = tuple(known)
    close = difflib.get_close_matches(name, names, n=1)
    return f"; did you mean {close[0]!r}?" if close else f"; known are {', '.join(names)}."


def _without_none(hint: Any) -> Any:
    """``X`` of ``X | None``."""
    if typing.get_origin(hint) in (types.UnionType, typing.Union):
        return next(arg for arg in typing.get_args(hint) if arg is not type(None))
    return hint
