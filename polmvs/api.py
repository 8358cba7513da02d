"""The public API, as ``polmvs.NAME``, for notebooks and scripts.

Functions take paths and options by name. Results read their files when an attribute is used. The
modules behind a function are imported when it is called.
"""

from __future__ import annotations

import logging
import tempfile
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from difflib import get_close_matches
from functools import cached_property
from os import PathLike, fspath
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Image, Mask
from polmvs.camera import Camera, PinholeCamera
from polmvs.config import (
    CaptureOptions,
    Estimator,
    OptionGroup,
    Options,
    PlaneOptions,
    RunOptions,
    describe_fields,
    groups_of,
    options_from_plain,
)
from polmvs.errors import DataError, OptionError
from polmvs.io.array_captures import Frame, Frames, are_frames, write_frames
from polmvs.io.clouds import Cloud, Mesh, mesh_to_open3d, read_cloud, read_mesh, to_open3d
from polmvs.io.folders import new_folder
from polmvs.parallel import OnProgress, no_progress
from polmvs.polarization.kinds import COMPARED_MODELS, AngleModel, Light
from polmvs.scene import find_name
from polmvs.simulation.options import LightName, MaterialName, Simulation, SimulationRun

if TYPE_CHECKING:  # heavy
    import open3d
    import pycolmap

    from polmvs.evaluation.comparison import Comparison, ModelFigures
    from polmvs.evaluation.trust import Trust
    from polmvs.normals.single_view.plane import PlaneEstimate
    from polmvs.pipeline.record import Record
    from polmvs.pipeline.run_folder import RunFolder
    from polmvs.pipeline.runner import Job, Monitor
    from polmvs.polarization.stokes import Stokes
    from polmvs.scene import SparseModel, View
    from polmvs.simulation.capture import SimulatedCapture
    from polmvs.surface.dense_view import DenseView

PathArg = str | PathLike[str]
T = TypeVar("T")
Groups = TypeVar("Groups", Options, Simulation)
Group = TypeVar("Group", bound=OptionGroup)

logger = logging.getLogger(__name__)


# One image


def read_stokes(
    image: PathArg | Frame, *, options: CaptureOptions | None = None, **changes: Any
) -> Stokes:
    """Stokes images of one raw image, with their noise.

    Parameters
    ----------
    image : raw mosaic of a polarization camera, a file or an array (H, W) as its SDK gives it; or
        a dictionary of images by polarizer angle in degrees, or Stokes images (3, H, W).
    options : how to read the image; defaults if None.
    **changes : single options by name instead, such as ``pattern=(90, 45, 135, 0)``.

    Returns
    -------
    ``s0``, ``s1``, ``s2`` (H, W) with ``sigma`` and ``valid``, and what is derived from them:
    ``aolp``, ``dolp``, ``sigma_aolp`` and ``phase(light)``.

    Raises
    ------
    DataError
        The file is missing or unusable.
    OptionError
        An option is unusable or unknown.
    """
    from polmvs.normals.single_view.pixels import load_stokes
    from polmvs.polarization.capture import open_capture

    chosen = _changed(_given(CaptureOptions, options), changes)
    if isinstance(image, str | PathLike):
        return load_stokes(Path(image), chosen)
    with tempfile.TemporaryDirectory() as folder:
        kind = write_frames({"frame": image}, Path(folder))
        capture = open_capture(folder, replace(chosen, kind=kind))
        return capture.load(capture.names[0])


def aolp_colors(stokes: Stokes, *, hue: bool = False) -> NDArray[np.uint8]:
    """The angle of linear polarization as colours, fainter where the DoLP is below 0.5.

    Parameters
    ----------
    stokes : from :func:`read_stokes`.
    hue : hue on black, as the viewers of cameras and ``polmvs inspect`` show it; else the colours
        of the report: perceptually uniform, twice round the colour wheel, on grey.

    Returns
    -------
    (H, W, 3) uint8, red, green, blue.
    """
    from polmvs.polarization.inspection import SHOWN_DOLP, aolp_picture
    from polmvs.report.pictures import angle_picture

    if hue:
        return np.ascontiguousarray(aolp_picture(stokes)[..., ::-1])
    aolp = np.where(stokes.valid, stokes.aolp, np.nan)
    return angle_picture(aolp, strength=stokes.dolp / SHOWN_DOLP)


def dolp_colors(stokes: Stokes) -> NDArray[np.uint8]:
    """The degree of linear polarization, 0 to 1, as colours (H, W, 3) uint8, as in the report."""
    from polmvs.report.pictures import scalar_picture

    return scalar_picture(np.where(stokes.valid, stokes.dolp, np.nan), 0, 1)


def plane_normal(
    stokes: Stokes,
    camera: Camera | Sequence[float],
    *,
    model: AngleModel | str = AngleModel.PPA,
    light: Light | str = Light.SPECULAR,
    mask: Mask | None = None,
    estimator: Estimator | str = Estimator.ROBUST,
    **changes: Any,
) -> PlaneEstimate:
    """Normal of a plane that one view shows.

    Parameters
    ----------
    stokes : of the view, from :func:`read_stokes`.
    camera : of the polarization images, or ``fx, fy, cx, cy`` of a pinhole camera, px, COLMAP's
        convention.
    model : angle model.
    light : kind of light that dominates on the plane.
    mask : (H, W) bool, True on the plane; None: all polarized pixels show the plane.
    estimator : weighted robust, or the paper's eigenvector.
    **changes : further options of ``polmvs plane`` by name: ``min_dolp``, ``min_intensity``,
        ``drop_clipped``, ``polygon``.

    Returns
    -------
    ``normal`` (3,), camera frame, facing the camera; its ``covariance`` (3, 3); ``valid``, whether
    the pixels determine it; and its phase residual.

    Raises
    ------
    DataError
        Too few usable pixels.
    OptionError
        An option is unusable or unknown.
    """
    from polmvs.normals.single_view.measurement import select_pixels
    from polmvs.normals.single_view.pixels import PlaneView

    given = {"model": model, "light": light, "estimator": estimator}
    options = _changed(PlaneOptions(), given | changes)
    inside = None if mask is None else np.asarray(mask, np.bool_)
    used = select_pixels(stokes, options, "these Stokes images", inside)
    view = PlaneView(stokes=stokes, mask=used, light=options.light)
    robust = options.estimator is Estimator.ROBUST
    return view.plane(options.model, _camera(stokes, camera), robust=robust)


def _camera(stokes: Stokes, given: Camera | Sequence[float]) -> Camera:
    """A camera of the size of the images."""
    height, width = stokes.shape
    if not isinstance(given, Sequence):
        if (given.width, given.height) != (width, height):
            raise OptionError(
                f"is of {given.width}x{given.height} px, the polarization images of "
                f"{width}x{height} px.",
                field="camera",
            )
        return given
    values = [float(value) for value in given]
    if len(values) != 4 or not min(values) > 0:
        raise OptionError(
            f"needs four positive numbers fx, fy, cx, cy, not {values}.", field="camera"
        )
    fx, fy, cx, cy = values
    return PinholeCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)


# Sparse points


@dataclass(frozen=True, kw_only=True, eq=False)
class TrackNormals:
    """Normals of the sparse points of a COLMAP model.

    Attributes
    ----------
    point3D_ids : (T,) int64, of the COLMAP model.
    points : (T, 3) float64, world.
    normals : (T, 3) float64, unit, world, facing the cameras; NaN where not valid.
    valid : (T,) bool, True where the views determine a normal.
    sigma_deg : (T,) larger standard deviation of the normal, degrees.
    residual : (T,) sine of the angle between normal and planes of incidence.
    num_views : (T,) int64, views that see the point.
    angle_model : angle model of the normals.
    """

    point3D_ids: NDArray[np.int64]
    points: Array
    normals: Array
    valid: Mask
    sigma_deg: Array
    residual: Array
    num_views: NDArray[np.int64]
    angle_model: AngleModel

    def point_cloud(self) -> open3d.geometry.PointCloud:
        """The points with a normal."""
        cloud = Cloud(points=self.points[self.valid], normals=self.normals[self.valid])
        return to_open3d(cloud).to_legacy()


def track_normals(
    capture: PathArg,
    sparse: PathArg | pycolmap.Reconstruction,
    *,
    model: AngleModel | str = AngleModel.PPA,
    options: Options | None = None,
    workers: int | None = 1,
    **changes: Any,
) -> TrackNormals:
    """Normals of the sparse points of a COLMAP model, from the phases of all views.

    Parameters
    ----------
    capture : folder of the raw images.
    sparse : folder of a COLMAP model of the same images, or the model itself.
    model : angle model.
    options : of all stages; only ``capture``, ``region`` and ``normals`` count. Defaults if None.
    workers : processes, as in :func:`reconstruct`.
    **changes : single options by name, such as ``min_dolp=0.2``.

    Raises
    ------
    DataError, OptionError
        The input or an option is unusable.
    """
    from polmvs.colmap.models import write_model
    from polmvs.parallel import Workers
    from polmvs.pipeline.run_folder import RunFolder
    from polmvs.pipeline.stages.maps import build_maps, tilt_maps
    from polmvs.pipeline.stages.normals import load_track_normals, solve_track_normals
    from polmvs.polarization.capture import open_capture

    angle_model = _angle_model(model, "model")
    options, num = change_options(options, changes), _run_options(workers).workers
    opened = open_capture(capture, options.capture)
    fitted = _fitted(opened, sparse)
    with (
        tempfile.TemporaryDirectory(prefix="polmvs-") as scratch,
        _lost_workers_told(num),
        Workers(num) as pool,
    ):
        folder = RunFolder(Path(scratch))
        write_model(fitted, folder.sparse)
        build_maps(opened, folder, options.region, workers=pool)
        if angle_model is AngleModel.TILTED:
            tilt_maps(folder, workers=pool)
        solve_track_normals(angle_model, folder, options.normals)
        estimate = load_track_normals(folder, angle_model)
    tracks = fitted.tracks
    return TrackNormals(
        point3D_ids=tracks.point3D_ids,
        points=tracks.points_in_world,
        normals=estimate.normals,
        valid=estimate.valid,
        sigma_deg=estimate.sigma_deg,
        residual=estimate.residual,
        num_views=estimate.num_rows,
        angle_model=angle_model,
    )


def _fitted(capture: Any, sparse: Any) -> SparseModel:
    """A sparse model with the names and the image size of a capture."""
    from polmvs.colmap.models import match_model_to_capture, model_from_reconstruction, read_model
    from polmvs.pipeline.stages.images import image_names

    if isinstance(sparse, str | PathLike):
        model, source = read_model(sparse), str(sparse)
    else:
        model, source = model_from_reconstruction(sparse), "the sparse model"
    names = list(image_names(capture))
    return match_model_to_capture(model, names, capture.width, capture.height, source=source)


# Whole captures


@dataclass(frozen=True, kw_only=True, eq=False)
class Reconstruction:
    """Result of one angle model in a run; its files are read when an attribute is used.

    Attributes
    ----------
    folder : folder of the run.
    angle_model : angle model of this result.
    """

    folder: Path
    angle_model: AngleModel

    def __repr__(self) -> str:
        """Folder, angle model and size of the result."""
        return f"Reconstruction({str(self.folder)!r}, {self.angle_model}: {self._dense})"

    @property
    def view_names(self) -> tuple[str, ...]:
        """Names of the views, as in the sparse model."""
        return tuple(self._views)

    @property
    def is_metric(self) -> bool:
        """Whether the unit is metres, by a given reference."""
        from polmvs.pipeline.stages.poses import PosesResult

        return self.record.result(PosesResult).is_metric

    @property
    def trust(self) -> Trust | None:
        """Quality checks without ground truth; None if no stage measured them."""
        from polmvs.evaluation.trust import Trust

        return self.record.find(Trust, self.angle_model)

    @cached_property
    def record(self) -> Record:
        """The record of the run: its options, and its stages with their results."""
        from polmvs.pipeline.runner import load_record

        return load_record(self._run_folder)

    @cached_property
    def cloud(self) -> Cloud:
        """The dense cloud as arrays, with ``kind``, ``sigma``, ``sigma_deg`` and ``num_views``."""
        return read_cloud(self._run_folder.cloud(self.angle_model))

    def point_cloud(self, *, surroundings: bool = False) -> open3d.geometry.PointCloud:
        """The dense cloud.

        Parameters
        ----------
        surroundings : include the points of the surroundings, whose normals are zero.
        """
        from polmvs.scene import PointKind

        cloud = self.cloud
        if not surroundings:
            cloud = cloud.only(cloud.are(PointKind.SURFACE))
        return to_open3d(cloud).to_legacy()

    def mesh(self) -> open3d.geometry.TriangleMesh:
        """The Poisson mesh of the polarized surfaces.

        Raises
        ------
        DataError
            The run made no mesh: its options exclude it, or the cloud has too few points.
        """
        path = self._run_folder.mesh(self.angle_model)
        if not path.is_file():
            raise DataError(path, "no mesh was made; reconstruct with `export.mesh` does it.")
        return mesh_to_open3d(read_mesh(path))

    def depth_map(self, name: str) -> Image:
        """Depth (H, W) float32 of a view's pixels along the optical axis, in the model's unit.

        NaN where unknown. Pixels are those of the polarization images, not undistorted.

        Parameters
        ----------
        name : of the view; without folder and suffix is enough where one view has that name.

        Raises
        ------
        KeyError
            There is no such view, or more than one.
        """
        depth, _ = self._maps(name)
        return np.where(depth > 0, depth, np.float32(np.nan))

    def normal_map(self, name: str) -> Image:
        """Unit normals (H, W, 3) float32 of a view's pixels, camera frame; NaN where unknown.

        Parameters
        ----------
        name : of the view; without folder and suffix is enough where one view has that name.

        Raises
        ------
        KeyError
            There is no such view, or more than one.
        """
        depth, normals = self._maps(name)
        return np.where((depth > 0)[..., None], normals, np.float32(np.nan))

    @cached_property
    def metrics(self) -> ModelFigures:
        """Metrics of the result against its images and, if there is one, the ground truth."""
        from polmvs.pipeline.jobs import measure

        return measure(self._run_folder, (self.angle_model,)).models[self.angle_model]

    @cached_property
    def sparse_model(self) -> pycolmap.Reconstruction:
        """The poses and sparse points."""
        from polmvs.colmap.models import read_reconstruction

        return read_reconstruction(self._run_folder.sparse)

    @property
    def _run_folder(self) -> RunFolder:
        from polmvs.pipeline.run_folder import RunFolder

        return RunFolder(self.folder)

    @property
    def _dense(self) -> Any:
        from polmvs.pipeline.stages.densify import DensifyResult

        return self.record.result(DensifyResult, self.angle_model)

    @cached_property
    def _views(self) -> Mapping[str, View]:
        from polmvs.pipeline.stages.maps import posed_views

        return {view.name: view for view in posed_views(self._run_folder)}

    def _maps(self, name: str) -> tuple[Image, Image]:
        """Depth, 0 where unknown, and normals of a view."""
        from polmvs.surface.dense_view import find_dense_view
        from polmvs.surface.map_export import sensor_maps

        view = self._view(name)
        dense: DenseView | None = find_dense_view(
            self._run_folder.views(self.angle_model) / view.name
        )
        if dense is None:
            shape = (view.camera.height, view.camera.width)
            return np.zeros(shape, np.float32), np.zeros((*shape, 3), np.float32)
        maps = sensor_maps(dense, view)
        return maps.depth, maps.normals

    def _view(self, name: str) -> View:
        found = find_name(name, self._views)
        if found is None:
            raise KeyError(f"{name!r} is no view of {self.folder}; there are {list(self._views)}")
        return self._views[found]


@dataclass(frozen=True, kw_only=True, eq=False)
class RunResult:
    """A run of one or more angle models on the same poses, seeds and region.

    Attributes
    ----------
    folder : of the run.
    models : results by angle model.
    """

    folder: Path
    models: Mapping[AngleModel, Reconstruction] = field(repr=False)

    def __getitem__(self, model: AngleModel | str) -> Reconstruction:
        """The result of an angle model; KeyError if the run has none of it."""
        found = self.models.get(_angle_model(model, "model"))
        if found is None:
            raise KeyError(f"{self.folder} has no cloud of {model!r}, but of {list(self.models)}")
        return found

    @cached_property
    def metrics(self) -> Comparison:
        """Figures of all models, as in ``metrics.json``."""
        from polmvs.evaluation.comparison import read_comparison
        from polmvs.pipeline.jobs import measure
        from polmvs.pipeline.run_folder import RunFolder

        run_folder = RunFolder(self.folder)
        if run_folder.metrics.is_file():
            comparison = read_comparison(run_folder.metrics)
            if set(comparison.models) == set(self.models):
                return comparison
        return measure(run_folder, tuple(self.models))

    def table(self) -> str:
        """The metrics as a Markdown table with one column for each model."""
        return self.metrics.table()


def reconstruct(
    capture: PathArg | Frames,
    out: PathArg,
    model: AngleModel | str = AngleModel.PPA,
    *,
    options: Options | None = None,
    overwrite: bool = False,
    resume: bool = False,
    workers: int | None = 1,
    scheduler: str | None = None,
    monitor: Monitor | None = None,
    **changes: Any,
) -> Reconstruction:
    """Reconstruct a capture with one angle model.

    Parameters
    ----------
    capture : folder of the raw images; or frames as :func:`read_stokes` takes them, by name or in
        order. Frames are stored beside the run, in ``OUT_frames``.
    out : run folder, a new one.
    model : angle model.
    options : of all stages; defaults where None.
    overwrite, resume : delete an earlier run in ``out`` first, or continue it.
    workers : number of processes; None: one for each core. Each process runs the script again, so
        with more than one the script needs ``if __name__ == "__main__":``.
    scheduler : address of a Dask scheduler, whose workers do the per-view work instead.
    monitor : receives the progress of the run, if given.
    **changes : single options by name, such as ``intrinsics=(fx, fy, cx, cy)``.

    Raises
    ------
    DataError, OptionError
        The input or an option is unusable; errors name options as ``group.name``.
    """
    from polmvs.pipeline import jobs

    angle_model = _angle_model(model, "model")
    run = _run_options(workers, overwrite=overwrite, resume=resume, scheduler=scheduler)
    job = _job(capture, out, options, changes, run, monitor)
    with _lost_workers_told(job.run_options.workers):
        outcome = jobs.reconstruct(job, angle_model)
    _warn_if_empty(outcome.empty)
    return Reconstruction(folder=outcome.run_folder.root, angle_model=angle_model)


def compare(
    capture: PathArg | Frames,
    out: PathArg,
    models: AngleModel | str | Sequence[AngleModel | str] = COMPARED_MODELS,
    *,
    options: Options | None = None,
    overwrite: bool = False,
    resume: bool = False,
    workers: int | None = 1,
    scheduler: str | None = None,
    monitor: Monitor | None = None,
    **changes: Any,
) -> RunResult:
    """Reconstruct a capture with several angle models on the same poses and seeds, and measure.

    Parameters
    ----------
    models : angle models, one or more.
    capture, out, options, overwrite, resume, workers, scheduler, monitor, **changes : see
        :func:`reconstruct`; ``gt`` is the folder of the ground truth.

    Raises
    ------
    DataError, OptionError
        As :func:`reconstruct`.
    """
    from polmvs.pipeline import jobs

    given = (models,) if isinstance(models, str) else models
    chosen = tuple(dict.fromkeys(_angle_model(model, "models") for model in given))
    if not chosen:
        raise OptionError("needs one angle model or more.", field="models")
    run = _run_options(workers, overwrite=overwrite, resume=resume, scheduler=scheduler)
    job = _job(capture, out, options, changes, run, monitor)
    with _lost_workers_told(job.run_options.workers):
        outcome = jobs.compare(job, chosen)
    _warn_if_empty(outcome.empty)
    return _run_result(outcome.run_folder.root, chosen)


def simulate(
    mesh: PathArg | Mesh,
    out: PathArg,
    *,
    material: MaterialName | str | None = None,
    light: LightName | str | None = None,
    cameras: PathArg | None = None,
    options: Simulation | None = None,
    overwrite: bool = False,
    resume: bool = False,
    on_progress: OnProgress = no_progress,
    **changes: Any,
) -> SimulatedCapture:
    """Render a capture of a mesh with its ground truth.

    Parameters
    ----------
    mesh : PLY, OBJ, STL or GLB file, a built-in shape's name, or a mesh in metres.
    out : folder of the capture.
    material, light : presets.
    cameras : COLMAP model or file of poses in metres, instead of a path.
    options : all options; defaults where None.
    overwrite, resume : delete an earlier capture in ``out`` first, or continue it.
    on_progress : called with 1 after each view.
    **changes : single options by their names, as on the command line: ``views=20``.

    Raises
    ------
    DataError
        The mesh or another file is unusable, or the folder holds something else.
    OptionError
        An option is unusable, or Mitsuba is not installed.
    """
    from polmvs.simulation.capture import simulate_capture

    named = {"material": material, "light": light, "cameras": cameras}
    given = {name: value for name, value in named.items() if value is not None}
    run = SimulationRun(overwrite=overwrite, resume=resume)
    source = mesh if isinstance(mesh, Mesh) else str(mesh)
    chosen = _with_changes(_given(Simulation, options), {**given, **changes})
    return simulate_capture(source, Path(out), chosen, run, on_progress=on_progress)


def open_run(folder: PathArg) -> RunResult:
    """The results of an earlier run.

    Raises
    ------
    DataError
        The folder holds no run, one of another version, or no dense cloud.
    """
    from polmvs.pipeline.run_folder import RunFolder
    from polmvs.pipeline.runner import dense_models, load_record

    root = Path(folder)
    models = dense_models(load_record(RunFolder(root)))
    if not models:
        raise DataError(root, "holds a run without a dense cloud. Go on with it: `run.resume`.")
    return _run_result(root, models)


def _run_result(root: Path, models: Sequence[AngleModel]) -> RunResult:
    return RunResult(
        folder=root,
        models={model: Reconstruction(folder=root, angle_model=model) for model in models},
    )


def _warn_if_empty(why: str | None) -> None:
    if why is not None:
        logger.warning("%s", why)


def _job(
    capture: PathArg | Frames,
    out: PathArg,
    options: Options | None,
    changes: Mapping[str, Any],
    run: RunOptions,
    monitor: Monitor | None,
) -> Job:
    from polmvs.pipeline.data_set_import import as_capture
    from polmvs.pipeline.record import read_options
    from polmvs.pipeline.run_folder import RunFolder
    from polmvs.pipeline.runner import Job

    for name, path in (("capture", capture), ("out", out)):
        # An empty one would be the current directory.
        if isinstance(path, str | PathLike) and not fspath(path):
            raise ValueError(f"{name}={path!r} is no path.")
    if run.resume and options is None:  # the options of the run, as on the command line
        options = options_from_plain(read_options(RunFolder(Path(out))), str(out))
    chosen = change_options(options, changes)
    if not isinstance(capture, str | PathLike):
        capture, chosen = _kept_frames(capture, Path(out), chosen, overwrite=run.overwrite)
    place, chosen = as_capture(Path(capture), Path(out), chosen)
    return Job(capture=place, out=Path(out), options=chosen, run_options=run, monitor=monitor)


def _kept_frames(
    frames: Frames, out: Path, options: Options, *, overwrite: bool
) -> tuple[Path, Options]:
    """Store frames as a capture beside the run; return it with the options to read it.

    Only ``overwrite`` replaces existing frames: a run that is continued has the same frames.
    """
    if not are_frames(frames):
        raise OptionError("needs a folder, or frames by name or in order.", field="capture")
    folder = out.absolute().with_name(f"{out.name}_frames")
    with tempfile.TemporaryDirectory() as checked:  # before anything is replaced
        kind = write_frames(frames, Path(checked))
    if overwrite or not folder.exists():
        with new_folder(folder, overwrite=overwrite) as new:
            write_frames(frames, new)
    return folder, replace(options, capture=replace(options.capture, kind=kind))


def _run_options(workers: int | None, **given: Any) -> RunOptions:
    """Execution options of a run; ``workers`` None: one process for each core."""
    return RunOptions(**given) if workers is None else RunOptions(workers=workers, **given)


@contextmanager
def _lost_workers_told(num: int) -> Iterator[None]:
    """Raise an OptionError with the remedy if any of ``num`` processes ends before its work."""
    from concurrent.futures.process import BrokenProcessPool

    try:
        yield
    except BrokenProcessPool as error:
        raise OptionError(
            f"is {num}, but the worker processes ended: memory ran out, or the script lacks "
            "'if __name__ == \"__main__\":' before what it does. Give that, or 1.",
            field="run.workers",
        ) from error


# Options by name


def change_options(options: Options | None, changes: Mapping[str, Any]) -> Options:
    """Options with some of them changed.

    Parameters
    ----------
    options : to start from; defaults if None.
    changes : values by option name; no two groups share a name.

    Raises
    ------
    OptionError
        A name is unknown, or a value is unusable.
    """
    return _with_changes(_given(Options, options), changes)


def _with_changes(options: Groups, changes: Mapping[str, Any]) -> Groups:
    """Groups of options with some of them changed."""
    group_of = {
        info.name: group
        for group, cls in groups_of(type(options)).items()
        for info in describe_fields(cls)
    }
    by_group: dict[str, dict[str, Any]] = {}
    for name, value in changes.items():
        if name not in group_of:
            raise _unknown(name, group_of)
        by_group.setdefault(group_of[name], {})[name] = value
    changed: dict[str, Any] = {
        group: _changed(getattr(options, group), new) for group, new in by_group.items()
    }
    return replace(options, **changed)


def _given(cls: type[T], options: T | None) -> T:
    """Options that a caller gave, or the defaults; OptionError for another type."""
    if options is not None and not isinstance(options, cls):
        raise OptionError(
            f"must be {cls.__name__}, not {type(options).__name__}; single options are given by "
            "their names.",
            field="options",
        )
    return cls() if options is None else options


def _changed(group: Group, changes: Mapping[str, Any]) -> Group:
    """A group of options with some of them changed."""
    known = [info.name for info in describe_fields(type(group))]
    for name in changes:
        if name not in known:
            raise _unknown(name, known)
    return type(group)(**{**vars(group), **changes})


def _unknown(name: str, known: Iterable[str]) -> OptionError:
    close = get_close_matches(name, list(known), n=1)
    return OptionError(
        f"there is no option {name!r}" + (f"; is it {close[0]!r}?" if close else ".")
    )


def _angle_model(value: AngleModel | str, name: str) -> AngleModel:
    try:
        return AngleModel(value)
    except ValueError as error:
        choices = ", ".join(AngleModel)
        raise OptionError(f"must be one of {choices}, not {value!r}.", field=name) from error
