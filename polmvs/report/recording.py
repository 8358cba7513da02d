"""A recording of a finished run for the Rerun viewer, on a timeline of stages.

The timeline ``stage`` counts the stages of a run in their order; ``log/stages`` names them. The
surface of all views has a step for its hull and for each level of its refinement. Rerun is an
extra, imported when a recording is made.
"""

from __future__ import annotations

import os
from collections.abc import Sequence
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import Camera, PinholeCamera
from polmvs.colmap.models import read_model
from polmvs.errors import DataError, OptionError, as_data_error
from polmvs.io.clouds import Cloud, Mesh, read_cloud, read_mesh
from polmvs.io.images import read_gray
from polmvs.parallel import OnProgress, no_progress
from polmvs.pipeline.record import Record
from polmvs.pipeline.run_folder import SURFACE_MESH, RunFolder, surface_levels
from polmvs.pipeline.runner import dense_models, load_record
from polmvs.pipeline.stages.densify import DensifyResult
from polmvs.pipeline.stages.maps import open_maps
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.polarization.inspection import SHOWN_DOLP
from polmvs.polarization.kinds import AngleModel
from polmvs.report.layers import KIND_COLORS
from polmvs.report.pictures import QUALITY, angle_picture
from polmvs.report.rendering import SURFACE
from polmvs.scene import PointKind, View

SUFFIX = ".rrd"
TIMELINE = "stage"
STAGES = "log/stages"
PIXEL_POINTS = 1.5  # radius of a point on the screen, px


def require_rerun(path: Path) -> None:
    """Check the conditions of a recording before a long run.

    Raises
    ------
    OptionError
        The extra is not installed, or the file has another ending.
    """
    if find_spec("rerun") is None:
        raise OptionError(
            "needs the extra 'rerun': pip install '.[rerun]'.", field="recording.rerun"
        )
    if path.suffix != SUFFIX:
        raise OptionError(f"must end with {SUFFIX}, not {path.name!r}.", field="recording.rerun")


def num_recorded_steps(run_folder: RunFolder) -> int:
    """Number of steps that :func:`write_recording` reports."""
    record = load_record(run_folder)
    found = record.find(PosesResult)
    return (found.num_views if found is not None else 0) + len(dense_models(record))


def write_recording(
    run_folder: RunFolder, path: Path, *, on_progress: OnProgress = no_progress
) -> None:
    """Record a finished run.

    Parameters
    ----------
    run_folder : with poses, and results of further stages.
    path : file to write, ``.rrd``; replaced whole.
    on_progress : called with 1 for each view and for each angle model.

    Raises
    ------
    DataError
        The folder holds no such run, or a file cannot be read or written.
    OptionError
        Rerun is not installed, or the file has another ending.
    """
    require_rerun(path)
    record = load_record(run_folder)
    if record.find(PosesResult) is None:
        raise DataError(run_folder.root, "has no poses to record. Run 'polmvs sfm' first.")
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with as_data_error(path, "written"):
            path.parent.mkdir(parents=True, exist_ok=True)
            _Recorder(run_folder, record, temporary).write(on_progress)
            os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


class _Recorder:
    """Writes one recording."""

    def __init__(self, run_folder: RunFolder, record: Record, path: Path) -> None:
        import rerun

        self.rerun: Any = rerun
        self.folder = run_folder
        self.record = record
        self.stream: Any = rerun.RecordingStream("polmvs")
        self.stream.save(str(path))
        self.stream.set_log_time_enabled(False)  # the stages are its time
        self.model = read_model(run_folder.sparse)
        self.step = -1

    def write(self, on_progress: OnProgress) -> None:
        """Write all, in the order of the stages."""
        log, rr = self.stream.log, self.rerun
        log("world", rr.ViewCoordinates.RDF, static=True)  # as COLMAP's first camera
        self.begin("images", f"{len(self.model.views)} images")
        for view in self.model.views:
            image = read_gray(self.folder.images / view.name)
            log(f"{self.entity(view)}/image", rr.Image(image).compress(jpeg_quality=QUALITY))
        self.begin("poses", str(self.record.result(PosesResult)))
        for view in self.model.views:
            self.camera(view)
        tracks = self.model.tracks
        points = rr.Points3D(tracks.points_in_world, colors=tracks.colors, radii=_radius(rr))
        log("world/sparse", points)
        models = dense_models(self.record)
        first = next(iter(models), None)
        if first is not None:
            self.begin("maps", "phases of the polarized regions")
            self.phases(first, on_progress)
        for model in models:
            self.normals(model)
            self.surface(model)
            on_progress(1)
        self.stream.flush()
        self.stream.disconnect()

    def entity(self, view: View) -> str:
        """Path of a view in the recording."""
        return str(self.rerun.new_entity_path(["world", "cameras", view.name]))

    def begin(self, name: str, summary: str) -> None:
        """A step of the timeline."""
        self.step += 1
        self.stream.set_time(TIMELINE, sequence=self.step)
        self.stream.log(STAGES, self.rerun.TextLog(f"{name}: {summary}"))

    def camera(self, view: View) -> None:
        """Pose and lens of a view; a lens that distorts is drawn without its distortion."""
        rr, pose, camera = self.rerun, view.cam_from_world, view.camera
        center, focal = _principal_point(camera)
        self.stream.log(
            self.entity(view),
            rr.Transform3D(translation=view.center_in_world, mat3x3=pose.rotation.T),
            rr.Pinhole(
                resolution=[camera.width, camera.height],
                focal_length=focal,
                principal_point=center,
                camera_xyz=rr.ViewCoordinates.RDF,
            ),
        )

    def phases(self, model: AngleModel, on_progress: OnProgress) -> None:
        """Phase maps in cyclic colours."""
        maps = open_maps(self.folder, model)
        for phase_map in maps:
            cos2, sin2 = phase_map.samples[..., 0], phase_map.samples[..., 1]
            phase = np.where(phase_map.samples[..., 2] > 0, 0.5 * np.arctan2(sin2, cos2), np.nan)
            picture = angle_picture(phase, strength=np.hypot(cos2, sin2) / SHOWN_DOLP)
            image = self.rerun.Image(picture).compress(jpeg_quality=QUALITY)
            self.stream.log(f"{self.entity(phase_map.view)}/phase", image)
            on_progress(1)

    def normals(self, model: AngleModel) -> None:
        """Normals of the sparse points, as short lines."""
        path = self.folder.sparse_cloud(model)
        if not path.is_file():
            return
        cloud = read_cloud(path)
        assert cloud.normals is not None
        valid = np.isfinite(cloud.normals).all(axis=1) & (cloud.scalars["valid"] > 0)
        self.begin(f"normals_{model}", f"{int(valid.sum())} sparse points with a normal")
        arrows = self.rerun.Arrows3D(
            origins=cloud.points[valid], vectors=self.length() * cloud.normals[valid]
        )
        self.stream.log(f"world/{model}/normals", arrows)

    def surface(self, model: AngleModel) -> None:
        """The surface as it refines, the cloud, and the mesh."""
        views = self.folder.views(model)
        for number, mesh in enumerate(map(read_mesh, surface_levels(views))):
            name = "hull of the silhouettes" if number == 0 else f"after level {number}"
            self.begin(f"surface_{model}", f"{name}, {len(mesh.triangles)} triangles")
            self.mesh(f"world/{model}/surface", mesh)
        if (views / SURFACE_MESH).is_file():
            mesh = read_mesh(views / SURFACE_MESH)
            self.begin(f"surface_{model}", f"supported, {len(mesh.triangles)} triangles")
            self.mesh(f"world/{model}/surface", mesh)
        self.begin(f"densify_{model}", str(self.record.result(DensifyResult, model)))
        self.cloud(model, read_cloud(self.folder.cloud(model)))
        if self.folder.mesh(model).is_file():
            mesh = read_mesh(self.folder.mesh(model))
            self.begin(f"mesh_{model}", f"{len(mesh.triangles)} triangles")
            self.mesh(f"world/{model}/mesh", mesh)

    def cloud(self, model: AngleModel, cloud: Cloud) -> None:
        """A cloud in its own grey, and by the kind of its points."""
        rr = self.rerun
        kinds = np.asarray(cloud.scalars.get("kind", np.zeros(len(cloud.points))), np.int64)
        palette = np.array([[int(c[i : i + 2], 16) for i in (1, 3, 5)] for c in KIND_COLORS])
        colors = {"cloud": cloud.colors, "kind": palette[np.clip(kinds, 0, len(PointKind) - 1)]}
        for name, color in colors.items():
            points = rr.Points3D(cloud.points, colors=color, radii=_radius(rr))
            self.stream.log(f"world/{model}/{name}", points)

    def mesh(self, entity: str, mesh: Mesh) -> None:
        """A mesh at the present step."""
        colors = mesh.colors
        if colors is None:
            colors = np.full((len(mesh.vertices), 3), SURFACE, np.uint8)
        self.stream.log(
            entity,
            self.rerun.Mesh3D(
                vertex_positions=mesh.vertices,
                triangle_indices=mesh.triangles,
                vertex_normals=mesh.normals,
                vertex_colors=colors,
            ),
        )

    def length(self) -> float:
        """Drawn length of a normal: a fortieth of the cameras' median distance."""
        points = self.model.tracks.points_in_world
        middle = np.median(points, axis=0) if len(points) else np.zeros(3)
        centers = np.array([view.center_in_world for view in self.model.views])
        return float(np.median(np.linalg.norm(centers - middle, axis=1))) / 40


def _principal_point(camera: Camera) -> tuple[Sequence[float], Sequence[float]]:
    """Principal point and focal lengths, px."""
    if isinstance(camera, PinholeCamera):
        return (camera.cx, camera.cy), (camera.fx, camera.fy)
    ahead: NDArray[np.float64] = np.asarray(camera.project(np.array([0.0, 0.0, 1.0])))
    return ahead.tolist(), (camera.mean_focal_px, camera.mean_focal_px)


def _radius(rerun: Any) -> Any:
    return rerun.Radius.ui_points(PIXEL_POINTS)
