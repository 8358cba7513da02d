"""Export of a finished run for other programs: mesh, cloud, or posed images."""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.camera import pixel_centers
from polmvs.colmap.camera_exports import CAMERA_FORMATS, CameraExport
from polmvs.colmap.dense_workspace import open_dense_workspace
from polmvs.colmap.models import read_model
from polmvs.config import Channel, CropOptions, ExportFormat
from polmvs.errors import DataError, OptionError, PolmvsError
from polmvs.io.cloud_files import write_cloud_file
from polmvs.io.clouds import Cloud, Mesh, read_cloud, read_mesh
from polmvs.io.folders import new_folder
from polmvs.io.images import read_gray
from polmvs.io.mesh_files import MESH_FORMATS, Texture, mesh_format_of, write_mesh_file
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.runner import dense_models, load_record, load_run
from polmvs.pipeline.stages.box import find_box
from polmvs.pipeline.stages.images import image_names
from polmvs.pipeline.stages.poses import PosesResult
from polmvs.polarization.capture import DISPLAY_GAMMA, Capture, open_capture
from polmvs.polarization.kinds import AngleModel
from polmvs.poses.crop_box import CropBox
from polmvs.scene import PointKind, SparseModel, View
from polmvs.surface.coloring import paint_texture, surface_colors, texture_size
from polmvs.surface.mesh_geometry import RayScene, TriangleMesh

logger = logging.getLogger(__name__)


CLOUDS = {
    ExportFormat.CLOUD_PLY: "ply",
    ExportFormat.XYZ: "xyz",
    ExportFormat.LAS: "las",
    ExportFormat.LAZ: "laz",
}
MESHES = (ExportFormat.PLY, ExportFormat.OBJ, ExportFormat.STL, ExportFormat.GLB)


@dataclass(frozen=True, kw_only=True)
class ExportRequest:
    """Request for an export.

    Attributes
    ----------
    target : file, or folder for posed images.
    form : of it, see :func:`export_format`.
    model : whose surface; None: PPA's, else that of the only cloud.
    texture : of a mesh: a texture instead of a colour for each vertex.
    texture_px : sides of the texture; None: a texel has the size of a pixel on the part.
    colors : of a mesh: without, it has none.
    part : of a cloud: the polarized surface alone, without its surroundings.
    crop : of a mesh or cloud: what lies within its box.
    overwrite : replace what is there.
    """

    target: Path
    form: ExportFormat
    model: AngleModel | None = None
    texture: bool = False
    texture_px: int | None = None
    colors: bool = True
    part: bool = False
    crop: CropOptions = CropOptions()
    overwrite: bool = False

    def check(self) -> None:
        """Raise OptionError if the format cannot hold the requested data or the target exists."""
        if self.crop.box is not None and self.form not in (*MESHES, *CLOUDS):
            raise OptionError("is of a mesh or a cloud.", field="crop.box")
        if self.texture and self.form not in MESHES:
            raise OptionError("is of a mesh.", field="arguments.texture")
        if self.texture and not MESH_FORMATS[f".{self.form}"].texture:
            raise OptionError(
                f"cannot be held by {self.form}; name an .obj or .glb.", field="arguments.texture"
            )
        if self.target.exists() and not self.overwrite:
            raise OptionError(f"{self.target}: exists. Give `arguments.overwrite` to replace it.")


@dataclass(frozen=True, kw_only=True)
class Exported:
    """Files and content of an export.

    Attributes
    ----------
    files : written files, or the folder.
    num_points, num_triangles, num_views : of the export; 0 if it has none.
    texture_px : side of the texture; 0 without one.
    is_metric : whether its unit is the metre; else it is the model's.
    """

    files: tuple[Path, ...]
    num_points: int = 0
    num_triangles: int = 0
    num_views: int = 0
    texture_px: int = 0
    is_metric: bool = False


def export_format(target: Path, given: ExportFormat | None) -> ExportFormat:
    """The format of the options, or of a file's suffix.

    Raises
    ------
    OptionError
        The suffix is unknown, or contradicts the format.
    """
    suffix = target.suffix.lower()
    if given is None:
        named = {**{f".{f}": f for f in MESHES}, ".xyz": ExportFormat.XYZ}
        named |= {".las": ExportFormat.LAS, ".laz": ExportFormat.LAZ}
        if suffix not in named:
            raise OptionError(
                f"{target}: its name says no format. End it in {', '.join(named)}, or give "
                f"`arguments.format`, one of {', '.join(ExportFormat)}."
            )
        return named[suffix]
    expected = f".{CLOUDS.get(given, given)}"
    if given in (*MESHES, *CLOUDS) and suffix != expected:
        raise OptionError(f"{target}: the name of a file of {given} ends in {expected}.")
    return given


def export_run(run_folder: RunFolder, wanted: ExportRequest) -> Exported:
    """Write a mesh, a cloud or posed images of a finished run.

    Raises
    ------
    DataError, OptionError, PolmvsError
        The run lacks the data, the target exists, or a library is missing.
    """
    record = load_record(run_folder)
    model = surface_of(run_folder, dense_models(record), wanted.model)
    wanted.check()
    if wanted.form in CLOUDS:
        exported = _export_cloud(run_folder, model, wanted)
    elif wanted.form in MESHES:
        exported = _export_mesh(run_folder, model, wanted)
    else:
        exported = _export_cameras(run_folder, model, wanted)
    return replace(exported, is_metric=record.result(PosesResult).is_metric)


def _export_cloud(run_folder: RunFolder, model: AngleModel, wanted: ExportRequest) -> Exported:
    cloud = read_cloud(run_folder.cloud(model))
    cloud = part_of(cloud) if wanted.part else cloud
    if (box := _box_of_run(run_folder, wanted.crop)) is not None:
        cloud = cloud.only(box.require_some(cloud.points))
    write_cloud_file(wanted.target, cloud, CLOUDS[wanted.form])
    return Exported(files=(wanted.target,), num_points=len(cloud.points))


def _export_mesh(run_folder: RunFolder, model: AngleModel, wanted: ExportRequest) -> Exported:
    mesh_format_of(wanted.target)
    mesh = read_mesh(_existing(run_folder.mesh(model), "mesh"))
    if (box := _box_of_run(run_folder, wanted.crop)) is not None:
        mesh = mesh.only(box.require_some(mesh.vertices))
        if not len(mesh.triangles):
            raise OptionError("holds no whole triangle of the mesh.", field="crop.box")
    texture: Texture | None = None
    if not (MESH_FORMATS[f".{wanted.form}"].colors and wanted.colors):
        mesh = replace(mesh, colors=None)
    elif wanted.texture:
        mesh, texture = _Painter(run_folder, mesh).textured(wanted.texture_px)
    else:
        colors = _Painter(run_folder, mesh).colors_of(mesh.vertices, mesh.normals)
        mesh = replace(mesh, colors=colors)
    return Exported(
        files=write_mesh_file(wanted.target, mesh, texture),
        num_points=len(mesh.vertices),
        num_triangles=len(mesh.triangles),
        texture_px=0 if texture is None else texture.image.shape[0],
    )


def surface_of(
    run_folder: RunFolder, there: tuple[AngleModel, ...], model: AngleModel | None
) -> AngleModel:
    """The requested angle model, among those of the run.

    Raises
    ------
    DataError, OptionError
        The run has no surface, or not that one.
    """
    if not there:
        raise DataError(run_folder.root, "has no dense cloud. Run 'polmvs densify' first.")
    if model is None:
        return AngleModel.PPA if AngleModel.PPA in there else there[0]
    if model not in there:
        raise OptionError(
            f"is {model}; {run_folder.root} has {', '.join(there)}.", field="arguments.model"
        )
    return model


def _box_of_run(run_folder: RunFolder, crop: CropOptions) -> CropBox | None:
    """The box that is asked for, in the world of a finished run."""
    if crop.box is None:
        return None
    _, options = load_run(run_folder)
    views = read_model(run_folder.sparse).views
    return find_box(run_folder, views, crop, options.reference.aruco)


def _existing(path: Path, what: str) -> Path:
    if not path.exists():
        raise DataError(path, f"the run has no {what}. Make it by 'polmvs finish CAPTURE OUT'.")
    return path


def part_of(cloud: Cloud) -> Cloud:
    """The points of a cloud on the part, without its surroundings."""
    return cloud.only(cloud.are(PointKind.SURFACE, PointKind.INFERRED))


def _export_cameras(run_folder: RunFolder, model: AngleModel, wanted: ExportRequest) -> Exported:
    workspace = open_dense_workspace(_existing(run_folder.dense(model), "COLMAP workspace"))
    mesh = read_mesh(_existing(run_folder.mesh(model), "mesh"))
    scene = RayScene(TriangleMesh.of(mesh))

    def mask(view: View) -> NDArray[np.bool_]:
        camera = view.camera
        rays = view.rays_in_world(pixel_centers(camera.width, camera.height).reshape(-1, 2))
        hits = scene.cast(view.center_in_world, rays)
        return (hits.face >= 0).reshape(camera.height, camera.width)

    export = CameraExport(
        workspace=workspace,
        cloud=read_cloud(run_folder.cloud(model)),
        mask=mask,
        part=mesh.vertices,
    )
    with new_folder(wanted.target, overwrite=wanted.overwrite) as folder:
        CAMERA_FORMATS[wanted.form](export, folder)
    return Exported(files=(wanted.target,), num_views=len(workspace.views))


class _Painter:
    """Colours of a mesh from the views of its run."""

    def __init__(self, run_folder: RunFolder, mesh: Mesh) -> None:
        self.mesh = TriangleMesh.of(mesh)
        self.scene = RayScene(self.mesh)
        self.model: SparseModel = read_model(run_folder.sparse)
        self.images = run_folder.images
        record, options = load_run(run_folder)
        self.capture: Capture | None = None
        if record.capture is not None:
            try:
                self.capture = open_capture(record.capture.folder, options.capture)
                self.raw = image_names(self.capture)
            except PolmvsError as error:
                logger.warning(
                    "colours are those of the run's images, grey and with highlights: %s", error
                )
        self.white = 1.0 if self.capture is None else self.capture.exposure()

    def colors_of(self, points: Array, normals: Array) -> NDArray[np.uint8]:
        """Colours (N, 3) of places on the mesh."""
        return surface_colors(
            points, normals, self.model.views, self._load, self.scene, white=self.white
        )

    def textured(self, size_px: int | None) -> tuple[Mesh, Texture]:
        """The mesh with a vertex for each side of a seam, and its texture."""
        try:
            import xatlas
        except ImportError as error:
            raise PolmvsError(
                "a texture needs a library, in the clone: pip install '.[texture]'."
            ) from error
        old = self.mesh
        came_from, faces, uv = xatlas.parametrize(
            np.ascontiguousarray(old.vertices - old.vertices.mean(axis=0), np.float32),
            np.ascontiguousarray(old.faces, np.uint32),
            np.ascontiguousarray(old.vertex_normals, np.float32),
        )
        # Of a vertex on a seam each side keeps the normal of the whole.
        split = TriangleMesh(old.vertices[came_from], faces.astype(np.int64))
        split.__dict__["vertex_normals"] = old.vertex_normals[came_from]
        size = size_px or texture_size(old, self._texel())
        texture = paint_texture(split, np.asarray(uv, np.float64), self.colors_of, size)
        mesh = Mesh(
            vertices=split.vertices,
            normals=split.vertex_normals,
            triangles=faces.astype(np.int32),
        )
        return mesh, texture

    def _texel(self) -> float:
        """Size of a pixel on the part, as the nearest views have it."""
        center = np.median(self.mesh.vertices, axis=0)
        sizes = [
            float(np.linalg.norm(view.center_in_world - center)) / view.camera.mean_focal_px
            for view in self.model.views
        ]
        return float(np.median(sizes))

    def _load(self, view: View) -> NDArray[np.float32]:
        """Linear intensities of a view without what is polarized; NaN where it is clipped."""
        if self.capture is None or view.name not in self.raw:
            gray = read_gray(self.images / view.name)
            return np.asarray((gray / 255) ** DISPLAY_GAMMA, np.float32)
        return unpolarized_image(self.capture, self.raw[view.name])


def unpolarized_image(capture: Capture, name: str) -> NDArray[np.float32]:
    """Linear intensities of the unpolarized light of a raw image; NaN where clipped.

    Returns
    -------
    (H, W), or (H, W, 3) red, green, blue for a colour camera, unless the capture's options select
    one of its colours.
    """
    channels: tuple[Channel, ...] = (capture.options.channel,)
    if capture.has_colors and capture.options.channel is Channel.COMBINED:
        channels = (Channel.RED, Channel.GREEN, Channel.BLUE)
    planes = []
    for channel in channels:
        one = replace(capture, options=replace(capture.options, channel=channel))
        stokes = one.load(name)
        plane = np.maximum(stokes.s0 - np.hypot(stokes.s1, stokes.s2), 0)
        dark = stokes.s0 < 2 * capture.options.darkness
        planes.append(np.where(stokes.valid | dark, plane, np.nan))
    return np.asarray(np.stack(planes, axis=-1) if len(planes) > 1 else planes[0], np.float32)
