"""The commands: the arguments and options of each, and the path of its function.

This module does not import the functions, so that ``--help`` is quick.
"""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from enum import StrEnum
from pathlib import Path

from polmvs.cli.call import FileOptions, RecordingOptions, TerminalOptions
from polmvs.cli.flags import Command
from polmvs.config import (
    CaptureOptions,
    CropOptions,
    EvaluationOptions,
    Experiment,
    ExperimentOptions,
    ExportFormat,
    ExportOptions,
    FusionOptions,
    NormalOptions,
    OptionGroup,
    PlaneOptions,
    PropagationOptions,
    ReferenceOptions,
    RegionOptions,
    RunOptions,
    SfmOptions,
    default_num_workers,
    groups_of,
    option,
)
from polmvs.polarization.kinds import COMPARED_MODELS, AngleModel
from polmvs.simulation.options import PlanOptions, Simulation, SimulationRun

ABOUT = "Dense clouds of glossy, textureless surfaces from polarization cameras."
DEMO_OUT = Path("polmvs-demo")

CAPTURE_HELP = "folder of raw polarizer mosaics, in it or in its raw/"
OUT_HELP = "folder of the results"


@dataclass(frozen=True, kw_only=True)
class JobArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    capture: Path = option(MISSING, CAPTURE_HELP, positional=True)
    out: Path = option(MISSING, OUT_HELP, positional=True)


@dataclass(frozen=True, kw_only=True)
class DemoArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    out: Path = option(DEMO_OUT, OUT_HELP, positional=True)


@dataclass(frozen=True, kw_only=True)
class ModelChoice(OptionGroup, group="model", in_files=False):
    """Which model."""

    model: AngleModel = option(AngleModel.PPA, "relation of measured angle and normal")


@dataclass(frozen=True, kw_only=True)
class ComparedModels(OptionGroup, group="models", in_files=False):
    """Which models."""

    models: tuple[AngleModel, ...] = option(
        COMPARED_MODELS,
        f"what to compare, of {', '.join(AngleModel)}",
        metavar="MODEL,...",
    )


@dataclass(frozen=True, kw_only=True)
class ReportChoice(OptionGroup, group="report", in_files=False):
    """What is written beside the results."""

    report: bool = option(True, "OUT/report.html, a page that shows them all")


@dataclass(frozen=True, kw_only=True)
class BatchArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    list_file: Path = option(
        MISSING,
        "TOML or CSV file of captures: 'folder' is that of one, 'name' that of its results, "
        "'model' as the flag; options as tables in TOML ([[captures]], [captures.sfm]), as "
        "columns in CSV (sfm.intrinsics); flags are for what it leaves open",
        positional=True,
        metavar="LIST",
    )
    out: Path = option(MISSING, "folder of the results, OUT/NAME for each capture", positional=True)


@dataclass(frozen=True, kw_only=True)
class FolderArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    out: Path = option(MISSING, "folder of a finished run", positional=True)


@dataclass(frozen=True, kw_only=True)
class RenderArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    picture: Path = option(MISSING, "PNG file of the picture", positional=True)
    files: tuple[Path, ...] = option(
        MISSING, "PLY files of clouds or meshes in one frame, a column each", positional=True
    )
    labels: tuple[str, ...] = option((), "a text for each column", metavar="TEXT,...")
    elevations: tuple[float, ...] = option(
        (35.0, 4.0),
        "over the part's mean plane, degrees, a row each",
        least=-90,
        most=90,
        metavar="DEG,...",
    )
    azimuths: tuple[float, ...] = option(
        (40.0,),
        "from the part's longest direction, degrees; each with every elevation",
        metavar="DEG,...",
    )
    size: tuple[int, int] = option(
        (640, 400), "of each panel, px", least=16, most=8192, metavar="WIDTH,HEIGHT"
    )
    plain: bool = option(False, "shade by the normals alone, without the surfaces' own grey")
    part: bool = option(False, "show the surface alone, without points of the surroundings")
    overwrite: bool = option(False, "replace an existing PICTURE")

    def check(self) -> None:
        """A text for each column, or none."""
        fits = len(self.labels) in (0, len(self.files))
        self.require(fits, "labels", "needs one text for each FILE", self.labels)


@dataclass(frozen=True, kw_only=True)
class EvaluateArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    cloud: Path = option(MISSING, "PLY file of points, if possible with normals", positional=True)
    gt: Path = option(MISSING, "ground truth", metavar="DIR")
    sparse: Path = option(
        MISSING,
        "COLMAP model in whose frame the cloud is; its cameras align it with the truth",
        metavar="DIR",
    )


class LengthUnit(StrEnum):
    """Unit of a reference's coordinates."""

    UM = "um"
    MM = "mm"
    CM = "cm"
    M = "m"
    INCH = "inch"


@dataclass(frozen=True, kw_only=True)
class DeviationArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    result: Path = option(MISSING, "folder of a finished run, or PLY of a cloud", positional=True)
    reference: Path = option(
        MISSING,
        "mesh of the part (STL, OBJ, GLB, PLY), a scan (PLY with normals), or another run",
        positional=True,
    )
    out: Path | None = option(
        None, "new folder for a coloured cloud, a picture, a histogram and the figures as JSON"
    )
    report: bool = option(
        False, "of a run: keep the same in RUN/deviation, and show it in RUN/report.html"
    )
    unit: LengthUnit | None = option(
        None, "of the reference; by default that in which it is as large as the result"
    )
    aligned: bool = option(
        False, "the result lies in the reference's frame; without it, it is laid"
    )
    metric: bool = option(
        False, "the result is in metres, where nothing says so: a cloud, or a run with metric poses"
    )
    tolerance: float | None = option(
        None,
        "distance that is allowed either way, mm; the exit status is 4 where it is not kept",
        above=0,
    )
    least_share: float = option(
        0.99, "share of the points that must keep to the tolerance", above=0, most=1
    )
    model: AngleModel | None = option(
        None, "whose surface of a run; by default that of PPA, else of the only cloud"
    )


@dataclass(frozen=True, kw_only=True)
class MeshArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    cloud: Path = option(MISSING, "PLY file of points with normals", positional=True)
    mesh: Path = option(MISSING, "file of the mesh: .ply, .obj, .stl or .glb", positional=True)
    overwrite: bool = option(False, "replace an existing MESH")


@dataclass(frozen=True, kw_only=True)
class ExportArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    run: Path = option(MISSING, "folder of a finished run", positional=True)
    target: Path = option(MISSING, "file to write, of posed images a folder", positional=True)
    overwrite: bool = option(False, "replace an existing TARGET")
    format: ExportFormat | None = option(
        None, "by default told by the end of TARGET's name, .ply a mesh"
    )
    model: AngleModel | None = option(
        None, "whose surface; by default that of PPA, else of the only cloud"
    )
    texture: bool = option(
        False, "a texture instead of a colour for each vertex; obj and glb (extra 'texture')"
    )
    texture_px: int | None = option(
        None,
        "sides of the texture, px; by default a texel is as large as a pixel on the part",
        least=64,
        most=16384,
    )
    colors: bool = option(
        True, "colours of a mesh, from the views that see a place best, without highlights"
    )
    part: bool = option(False, "of a cloud the polarized surface alone, without its surroundings")

    def check(self) -> None:
        """A texture has colours, and a size is one of a texture."""
        self.require(self.colors or not self.texture, "texture", "needs `arguments.colors`")
        sized = self.texture or self.texture_px is None
        self.require(sized, "texture_px", "is of a texture; give `arguments.texture`")


@dataclass(frozen=True, kw_only=True)
class PlaneArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    image: Path = option(MISSING, "raw polarizer mosaic", positional=True)


@dataclass(frozen=True, kw_only=True)
class ExperimentArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    name: Experiment = option(MISSING, ", ".join(Experiment), positional=True)
    capture: Path = option(
        MISSING,
        f"{CAPTURE_HELP}, or in the layout of the authors' demo (images/, cams/)",
        positional=True,
    )
    out: Path = option(MISSING, OUT_HELP, positional=True)


@dataclass(frozen=True, kw_only=True)
class ExperimentRun(OptionGroup, group="run", in_files=False):
    """How the experiment is carried out; nothing here changes its result."""

    overwrite: bool = option(False, "replace earlier results of NAME in OUT")
    workers: int = option(default_num_workers(), "processes to share the views among", least=1)


@dataclass(frozen=True, kw_only=True)
class SimulateArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    mesh: str = option(
        MISSING,
        "PLY, OBJ, STL or GLB file of the object, or a built-in shape: plane, sphere, ellipsoid, "
        "dome, box (on a plate), mug, vase, knot",
        positional=True,
    )
    out: Path = option(MISSING, "folder of the capture", positional=True)


@dataclass(frozen=True, kw_only=True)
class PlanArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    mesh: str = option(MISSING, "as of 'polmvs simulate'", positional=True)
    out: Path = option(
        Path("polmvs-plan"), "folder of plan.md, plan.png and the trials", positional=True
    )


class CalibrationKind(StrEnum):
    """Kind of calibration."""

    CAMERA = "camera"
    POLARIZERS = "polarizers"


@dataclass(frozen=True, kw_only=True)
class InspectArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    capture: Path = option(MISSING, CAPTURE_HELP, positional=True)
    sheet: Path | None = option(
        None, "PNG to write: intensity, AoLP and DoLP of up to eight views", metavar="PNG"
    )


@dataclass(frozen=True, kw_only=True)
class ImportArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    folder: Path = option(MISSING, "folder of one object or scene", positional=True, metavar="SET")
    out: Path = option(MISSING, "folder to make", positional=True)


@dataclass(frozen=True, kw_only=True)
class CalibrateArguments(OptionGroup, group="arguments", in_files=False):
    """Arguments."""

    kind: CalibrationKind = option(MISSING, ", ".join(CalibrationKind), positional=True)
    capture: Path = option(
        MISSING,
        "camera: capture of a board; polarizers: folder with unpolarized/, polarized/ (files "
        "named by the polarizer's angle, 045_01.png) and dark/",
        positional=True,
    )
    out: Path = option(
        MISSING, "file to write: .txt of a camera, .toml of polarizers", positional=True
    )
    overwrite: bool = option(False, "replace an existing OUT")


@dataclass(frozen=True, kw_only=True)
class BoardOptions(OptionGroup, group="board"):
    """The board of 'calibrate camera'."""

    cols: int | None = option(None, "squares from left to right", least=3)
    rows: int | None = option(None, "squares from top to bottom", least=3)
    square: float = option(1.0, "side of a square, in any unit", above=0)
    dictionary: str | None = option(
        None, "of a ChArUco board's markers, such as DICT_4X4_50; without it a checkerboard"
    )
    marker: float | None = option(
        None, "side of a marker, in the unit of a square; by default three quarters", above=0
    )


@dataclass(frozen=True, kw_only=True)
class PolarizerFrames(OptionGroup, group="polarizers"):
    """The frames of 'calibrate polarizers'."""

    per_sample: bool = option(
        False, "a value for each sample instead of each channel; needs tens of frames"
    )


# Groups of options in the order of the stages.
TO_POSES = (CaptureOptions, SfmOptions, ReferenceOptions)
TO_NORMALS = (*TO_POSES, RegionOptions, NormalOptions)
TO_CLOUD = (*TO_NORMALS, PropagationOptions, FusionOptions, CropOptions)
SHOWN = (ReportChoice, RecordingOptions)
SIMULATION = tuple(groups_of(Simulation).values())
EXECUTION = (RunOptions, FileOptions, TerminalOptions)

COMMANDS = (
    Command(
        name="demo",
        help_text="compare OPA and PPA on the bundled capture of a glossy board",
        run="polmvs.cli.jobs:demo",
        groups=(DemoArguments, *SHOWN, RunOptions, TerminalOptions),
    ),
    Command(
        name="reconstruct",
        help_text="capture in, dense cloud of one model out",
        run="polmvs.cli.jobs:reconstruct",
        groups=(JobArguments, ModelChoice, *TO_CLOUD, ExportOptions, *SHOWN, *EXECUTION),
    ),
    Command(
        name="compare",
        help_text="dense clouds of several models on the same poses, seeds and region, and figures "
        "that tell them apart",
        run="polmvs.cli.jobs:compare",
        groups=(JobArguments, ComparedModels, *TO_CLOUD, EvaluationOptions, *SHOWN, *EXECUTION),
    ),
    Command(
        name="batch",
        help_text="'reconstruct' for many captures side by side, and one table of what came out",
        run="polmvs.cli.jobs:batch",
        groups=(BatchArguments, ModelChoice, *TO_CLOUD, ExportOptions, *EXECUTION),
    ),
    Command(
        name="evaluate",
        help_text="measure a cloud against ground truth",
        run="polmvs.cli.clouds:evaluate",
        groups=(EvaluateArguments, TerminalOptions),
    ),
    Command(
        name="deviation",
        help_text="how far a part is from its drawing, a scan or another run of it, and whether "
        "that is within a tolerance",
        run="polmvs.cli.deviations:deviation",
        groups=(DeviationArguments, TerminalOptions),
    ),
    Command(
        name="sfm",
        help_text="the first stages alone: images and poses",
        run="polmvs.cli.jobs:sfm",
        groups=(JobArguments, *TO_POSES, *EXECUTION),
    ),
    Command(
        name="normals",
        help_text="normals of the sparse points, after 'sfm'",
        run="polmvs.cli.jobs:normals",
        groups=(JobArguments, ModelChoice, RegionOptions, NormalOptions, *EXECUTION),
        earlier=TO_POSES,
    ),
    Command(
        name="densify",
        help_text="the dense cloud, after 'normals'",
        run="polmvs.cli.jobs:densify",
        groups=(
            *(JobArguments, ModelChoice, PropagationOptions, FusionOptions, CropOptions),
            *EXECUTION,
        ),
        earlier=TO_NORMALS,
    ),
    Command(
        name="finish",
        help_text="mesh and COLMAP dense workspace, after 'densify'",
        run="polmvs.cli.jobs:finish",
        groups=(JobArguments, ModelChoice, ExportOptions, *EXECUTION),
        earlier=TO_CLOUD,
    ),
    Command(
        name="export",
        help_text="mesh, cloud or posed images of a finished run as other programs read them",
        run="polmvs.cli.exports:export",
        groups=(ExportArguments, CropOptions, TerminalOptions),
        more="Formats: meshes ply, obj (with its .mtl), stl, glb; clouds cloud-ply, xyz, las, laz; "
        "posed images, each in a folder: nerfstudio (transforms.json, for gsplat as well), neus "
        "(cameras.npz, for IDR as well), metashape, realityscan, bundler. OpenMVS and COLMAP read "
        "OUT/dense as it is.",
    ),
    Command(
        name="mesh",
        help_text="Poisson mesh of a cloud with normals",
        run="polmvs.cli.clouds:mesh",
        groups=(MeshArguments, TerminalOptions),
    ),
    Command(
        name="report",
        help_text="the page that shows a finished run, OUT/report.html, anew",
        run="polmvs.cli.pages:report",
        groups=(FolderArguments, RecordingOptions, TerminalOptions),
    ),
    Command(
        name="view",
        help_text="clouds and meshes of a finished run in Open3D's viewer",
        run="polmvs.cli.pages:view",
        groups=(FolderArguments, TerminalOptions),
    ),
    Command(
        name="render",
        help_text="still picture of clouds and meshes, without a display",
        run="polmvs.cli.pages:render",
        groups=(RenderArguments, TerminalOptions),
    ),
    Command(
        name="plane",
        help_text="normals of planes in one raw image, and which model fits it",
        run="polmvs.cli.plane:plane",
        groups=(PlaneArguments, PlaneOptions, CaptureOptions, FileOptions, TerminalOptions),
    ),
    Command(
        name="inspect",
        help_text="what a capture's files are, how they are exposed, and pictures of them",
        run="polmvs.cli.captures:inspect",
        groups=(InspectArguments, CaptureOptions, FileOptions, TerminalOptions),
    ),
    Command(
        name="import",
        help_text="make a public set with cameras (ppa4p3d, PISR, PANDORA, NeRSP, SMVP3D, MVAS, "
        "NeuS, TransPIR) ready for 'reconstruct', which does it by itself as well",
        run="polmvs.cli.captures:import_set",
        groups=(ImportArguments, CaptureOptions, FileOptions, TerminalOptions),
    ),
    Command(
        name="calibrate",
        help_text="a camera's intrinsics from a board, or its polarizers from frames of a lamp",
        run="polmvs.cli.captures:calibrate",
        groups=(
            CalibrateArguments,
            BoardOptions,
            PolarizerFrames,
            CaptureOptions,
            FileOptions,
            TerminalOptions,
        ),
    ),
    Command(
        name="experiment",
        help_text="the paper's experiments: OPA, PPA and tilted side by side on a capture with "
        "truth",
        run="polmvs.cli.experiment:experiment",
        groups=(
            ExperimentArguments,
            ExperimentOptions,
            CaptureOptions,
            RegionOptions,
            ExperimentRun,
            FileOptions,
            TerminalOptions,
        ),
        more="phase: error of the phases that the models predict from true normals; plane: normal "
        "of a planar region from one view; tracks: normals of surface points from K views; "
        "contours: contours traced from seeds on the part's edge. The model 'tilted' is exact "
        "for a lens that is not telecentric on the image side.",
    ),
    Command(
        name="simulate",
        help_text="rendered capture of a mesh with ground truth: any material, light, path, camera",
        run="polmvs.cli.simulation:simulate",
        groups=(SimulateArguments, *SIMULATION, SimulationRun, FileOptions, TerminalOptions),
    ),
    Command(
        name="plan",
        help_text="how many views under which light a part needs, from small simulations of it",
        run="polmvs.cli.simulation:plan",
        groups=(PlanArguments, PlanOptions, *SIMULATION, FileOptions, TerminalOptions),
        more="The light, number of views and image size of the single simulations are those of "
        "the group 'plan'. Finished trials are kept in OUT and not done again.",
    ),
    Command(
        name="doctor",
        help_text="versions, cores and memory of this machine, and a self-test of a few seconds",
        run="polmvs.cli.doctor:doctor",
        groups=(TerminalOptions,),
    ),
)
