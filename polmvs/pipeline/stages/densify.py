"""Stage ``densify_MODEL``: the dense cloud of a scene, and the dense depth of its views.

The cloud holds the polarized surfaces and their surroundings; ``kind`` distinguishes them.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.dense_workspace import (
    DenseWorkspace,
    open_dense_workspace,
    require_matching_images,
    require_same_frame,
)
from polmvs.colmap.filling import previous_backups
from polmvs.colmap.models import read_model
from polmvs.config import FusionOptions, Method, Options, PropagationOptions, Surroundings
from polmvs.geometry import points_on_rays
from polmvs.io.arrays import map_array, save_array
from polmvs.io.clouds import Cloud, Mesh, read_mesh, write_cloud, write_mesh
from polmvs.io.images import read_gray
from polmvs.parallel import OnProgress, Workers, no_progress
from polmvs.pipeline.run_folder import (
    SURFACE_LEVELS,
    SURFACE_MESH,
    RunFolder,
    replace_folder,
    scratch,
)
from polmvs.pipeline.stages.box import find_box
from polmvs.pipeline.stages.maps import open_maps, posed_views
from polmvs.pipeline.stages.poses import load_floats
from polmvs.pipeline.stages.seeds import load_points, load_seeds
from polmvs.pipeline.stages.silhouettes import open_surface_views
from polmvs.polarization.capture import DISPLAY_GAMMA
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.poses.crop_box import CropBox
from polmvs.scene import PointKind, Seeds, Tracks, View
from polmvs.surface.camera_sigma import CameraModes, widen_by_poses
from polmvs.surface.dense_view import DenseView, find_dense_view, store_dense_view
from polmvs.surface.fusion import FusedCloud, fuse, hidden_by, no_points
from polmvs.surface.global_surface import (
    SparsePoints,
    SurfacePoints,
    Undetermined,
    num_surface_steps,
    reconstruct_surface,
    render_view,
    supported_mesh,
    surface_points,
)
from polmvs.surface.kept_depth import kept_cloud
from polmvs.surface.mesh_geometry import RayScene
from polmvs.surface.observations import Looking
from polmvs.surface.propagation import propagate
from polmvs.surface.surroundings import SparseSurroundings, sparse_surroundings, stereo_surroundings

logger = logging.getLogger(__name__)

T = TypeVar("T", bound=np.generic)

# Options that a method ignores.
UNUSED: Mapping[Method, tuple[str, ...]] = {
    Method.SURFACE: (
        "propagation.contour",
        "propagation.step_px",
        "propagation.spacing_px",
        "propagation.num_rounds",
        "propagation.bending",
        "propagation.max_neighbors",
        "fusion.max_range_difference_px",
        "fusion.max_normal_difference_deg",
    ),
    Method.CONTOUR: ("fusion.inferred",),
}

OUTSIDE = "{name}.outside.npy"  # among dense views: pixels that show nothing within the box
# Of points that are not to be merged, in GSD (length of a pixel at the surface).
FINEST_SPACING_PX = 0.25


@dataclass(frozen=True, kw_only=True)
class DensifyResult:
    """Result of the stage.

    Attributes
    ----------
    num_points : points of the cloud on polarized surfaces.
    num_surroundings : points of the cloud in the surroundings.
    method : method of the points: view by view if there is no surface of all views.
    tilt_share : share of the rotation by tilted polarizers that the surface of all views corrects;
        None with the other methods.
    left_out : names of inconsistent views, which the surface does not use.
    is_bounded : silhouettes bound the surface of all views; otherwise it is that of an open scene.
    is_vessel : the surface of all views was open at the top from the start.
    contradicted_share : share of the surface of all views that its phases contradict; None with the
        other methods.
    """

    num_points: int
    num_surroundings: int
    method: Method
    tilt_share: float | None
    left_out: tuple[str, ...] = ()
    is_bounded: bool = True
    is_vessel: bool = False
    contradicted_share: float | None = None

    def __str__(self) -> str:
        return f"{self.num_points:,} points, and {self.num_surroundings:,} of the surroundings"


@dataclass(frozen=True, kw_only=True)
class _Inputs:
    """Input of both methods of making a surface."""

    model: AngleModel
    maps: Sequence[PhaseMap]
    seeds: Seeds
    options: Options
    workers: Workers
    on_progress: OnProgress

    @property
    def tilt_aware(self) -> bool:
        return self.options.normals.tilt_aware_weights and not self.model.is_textbook

    @property
    def views(self) -> list[View]:
        return [phase_map.view for phase_map in self.maps]


@dataclass(frozen=True, kw_only=True)
class _Surface:
    """Polarized surfaces and their making; ``points`` belong to a surface of all views."""

    cloud: FusedCloud
    method: Method
    points: SurfacePoints | None = None
    tilt_share: float | None = None
    left_out: tuple[str, ...] = ()
    is_bounded: bool = True
    is_vessel: bool = False
    contradicted_share: float | None = None


def densify(
    model: AngleModel,
    folder: RunFolder,
    options: Options,
    *,
    workers: Workers | None = None,
    on_progress: OnProgress = no_progress,
) -> DensifyResult:
    """One dense cloud, and the depth and normals of every view.

    With the method ``surface``, both come from one mesh of all views if silhouettes bound the
    objects. Otherwise, the surface spreads from the seeds over the region of every view, and the
    views are fused; without a region or seeds it has no points.

    Parameters
    ----------
    model : angle model; a textbook model ignores the polarizers' tilt.
    folder : of a run with images, model, phase maps, normals of the tracks, and seeds; the cloud
        and the dense views of ``model`` are written there.
    options : of the run.

    Raises
    ------
    DataError
        An input is unusable, or the COLMAP workspace of the options is not of these images.
    """
    given = _Inputs(
        model=model,
        maps=open_maps(folder, model),
        seeds=load_seeds(folder, model),
        options=options,
        workers=workers or Workers(),
        on_progress=on_progress,
    )
    workspace = _open_given(options.fusion, folder)
    sparse = read_model(folder.sparse)
    box = find_box(folder, given.views, options.crop, options.reference.aruco)
    if box is not None:
        centers = np.array([view.center_in_world for view in given.views])
        box.require_possible(sparse.tracks.points_in_world, centers)
    with scratch(folder.views(model)) as kept, given.workers.stopped_on_error():
        new_views = kept / "views"
        new_views.mkdir()
        found = None
        if options.propagation.method is Method.SURFACE:
            found = _global_surface(given, folder, sparse.tracks, new_views, kept / "kept")
        if found is None:
            found = _dense_surface(given, kept, new_views)
        modes = CameraModes(sparse.tracks.points_in_world, load_floats(folder.camera_modes))
        modes.widen_stored(given.views, new_views)
        widen_by_poses(sparse.views, load_floats(folder.pose_covariances), new_views)
        surface = surface_cloud(modes.widened(found.cloud))
        if found.points is not None:
            surface.scalars["kind"][found.points.inferred] = PointKind.INFERRED
            surface = replace(surface, scalars={**surface.scalars, **found.points.scalars()})
        around = surroundings_cloud(sparse.tracks, found.cloud, given, workspace, kept / "around")
        if box is not None:
            surface = _crop_surface(surface, box)
            around = around.only(box.contains(around.points))
            crop_views(new_views, given.views, box)
        replace_folder(new_views, folder.views(model))
    write_cloud(folder.cloud(model), _join_clouds(surface, around))
    for sentence in unused_options(found.method, options.propagation, options.fusion):
        logger.warning("%s.", sentence)
    return DensifyResult(
        num_points=len(surface.points),
        num_surroundings=len(around.points),
        method=found.method,
        tilt_share=found.tilt_share,
        left_out=found.left_out,
        is_bounded=found.is_bounded,
        is_vessel=found.is_vessel,
        contradicted_share=found.contradicted_share,
    )


def _crop_surface(surface: Cloud, box: CropBox) -> Cloud:
    inside = box.require_some(surface.points)
    if not inside.all():
        logger.warning(
            "`crop.box` leaves out %.0f %% of the surface; figures against a ground truth "
            "count that as missing.",
            100 * (1 - inside.mean()),
        )
    return surface.only(inside)


def crop_views(folder: Path, views: Sequence[View], box: CropBox) -> None:
    """Crop stored views, and the mesh beside them, to a box.

    ``OUTSIDE`` then has the pixels (H, W) that show what is outside the box: their rays miss it, or
    their surface is outside. In a view without a surface these are all pixels.
    """
    for view in views:
        dense = find_dense_view(folder / view.name)
        outside = folder / OUTSIDE.format(name=view.name)
        if dense is None:
            save_array(outside, np.ones((view.camera.height, view.camera.width), np.bool_))
            continue
        rays = view.rays_in_world(dense.lattice_xy())
        points = points_on_rays(view.center_in_world, rays, dense.range_map.astype(np.float64))
        kept = box.contains(points)
        cut = dense.known & ~kept
        misses = box.misses(view)
        rows, cols = (
            np.minimum(np.arange(side) // dense.stride_px, most - 1)
            for side, most in zip(misses.shape, cut.shape, strict=True)
        )
        save_array(outside, misses | cut[rows[:, None], cols])
        store_dense_view(dense.only(kept), folder / view.name)
    if (folder / SURFACE_MESH).is_file():
        mesh = read_mesh(folder / SURFACE_MESH)
        write_mesh(folder / SURFACE_MESH, mesh.only(box.contains(mesh.vertices)))


def unused_options(
    method: Method, propagation: PropagationOptions, fusion: FusionOptions
) -> list[str]:
    """Sentences about options that are not the defaults and that a method ignores."""
    groups = {"propagation": propagation, "fusion": fusion}

    def is_given(path: str) -> bool:
        group, _, name = path.partition(".")
        return bool(getattr(groups[group], name) != getattr(type(groups[group]), name))

    given = [f"`{path}`" for path in UNUSED[method] if is_given(path)]
    sentences = []
    if given:
        are = "is" if len(given) == 1 else "are"
        sentences.append(f"{', '.join(given)} {are} not used by the method {method}")
    if method is Method.SURFACE and is_given("propagation.stride_px"):
        sentences.append(
            "`propagation.stride_px` spaces the views' depth maps alone by the method surface; its "
            "cloud is thinned by `fusion.voxel_px` or `fusion.voxel`"
        )
    if fusion.voxel is not None and is_given("fusion.voxel_px"):
        sentences.append("`fusion.voxel_px` is not used where `fusion.voxel` is given")
    return sentences


def _global_surface(
    given: _Inputs, folder: RunFolder, tracks: Tracks, views: Path, kept: Path
) -> _Surface | None:
    """The surface of all views; None where silhouettes do not bound the objects.

    Its mesh and its depth in each view go to ``views``, what it is made from meanwhile to ``kept``,
    a new folder.
    """
    maps, model, options = given.maps, given.model, given.options
    fusion, stride_px = options.fusion, options.propagation.stride_px
    kept.mkdir()
    surface = reconstruct_surface(
        Looking(
            angle_model=model.formula,
            tilt_aware=given.tilt_aware,
            light=options.region.light,
        ),
        open_surface_views(folder, maps, folder=kept),
        SparsePoints(
            given.seeds,
            sparse_surroundings(tracks, maps).points,
            None if options.region.mask else load_points(folder, model, tracks, given.views),
        ),
        min_views=fusion.min_views,
        on_progress=given.on_progress,
        folder=kept,
    )
    if isinstance(surface, Undetermined):
        logger.warning(
            "%s: no surface from all views, for %s; contours carry the seeds' ranges in each view.",
            model,
            surface.reason,
        )
        return None
    if not fusion.inferred:
        surface = surface.shown()
    for sentence in surface.contradictions.warnings():
        logger.warning("%s: %s.", model, sentence)
    scene = RayScene(surface.mesh)
    for phase_map, left_out in zip(maps, surface.left_out, strict=True):
        dense = None
        if not left_out:
            dense = render_view(surface, scene, phase_map.view, stride_px)
        if dense is not None:
            store_dense_view(dense, views / phase_map.view.name)
        given.on_progress(1)
    spacing = fusion.voxel if fusion.voxel is not None else fusion.voxel_px * surface.gsd
    believed = list(compress(maps, ~surface.left_out))
    points = surface_points(surface, believed, spacing or FINEST_SPACING_PX * surface.gsd)
    write_mesh(views / SURFACE_MESH, supported_mesh(surface))
    for number, mesh in enumerate(surface.levels):
        faces = mesh.faces.astype(np.int32)
        whole = Mesh(vertices=mesh.vertices, normals=mesh.vertex_normals, triangles=faces)
        write_mesh(views / SURFACE_LEVELS.format(number=number), whole)
    return _Surface(
        cloud=points.cloud,
        method=Method.SURFACE,
        points=points,
        tilt_share=surface.tilt_share,
        left_out=tuple(view.name for view in compress(given.views, surface.left_out)),
        is_bounded=surface.is_bounded,
        is_vessel=surface.is_vessel,
        contradicted_share=surface.contradictions.contradicted_share,
    )


def _dense_surface(given: _Inputs, folder: Path, views: Path) -> _Surface:
    """The fused surfaces of views one by one; what each view confirms of them goes to ``views``."""
    maps, options = given.maps, given.options.propagation
    num_inside = sum(int(phase_map.region.inside.sum()) for phase_map in maps)
    if num_inside == 0 or len(given.seeds.sigma) == 0:
        return _Surface(cloud=no_points(), method=Method.CONTOUR)
    dense = propagate(
        given.model.formula,
        maps,
        given.seeds,
        options,
        folder,
        tilt_aware=given.tilt_aware,
        workers=given.workers,
        on_progress=given.on_progress,
    )
    confirmed: dict[int, NDArray[np.bool_]] = {}
    cloud = fuse(
        maps,
        dense,
        given.options.fusion,
        max_neighbors=options.max_neighbors,
        workers=given.workers,
        on_progress=given.on_progress,
        on_confirmed=confirmed.__setitem__,
    )
    for index, points in confirmed.items():
        dense_view, view = dense[index], maps[index].view
        assert dense_view is not None  # has points
        seen = points & ~hidden_by(dense_view, view, cloud.points, cloud.normals)
        store_dense_view(dense_view.only(seen), views / view.name)
    return _Surface(cloud=cloud, method=Method.CONTOUR)


def num_densify_steps(num_views: int, options: PropagationOptions) -> int:
    """Number of steps that :func:`densify` reports."""
    if options.method is Method.SURFACE:
        return num_surface_steps(num_views)
    return (options.num_rounds + 2) * num_views


def open_dense_views(folder: RunFolder, model: AngleModel) -> list[DenseView | None]:
    """Dense results of all posed views of a run; None for a view without one."""
    return [find_dense_view(folder.views(model) / view.name) for view in posed_views(folder)]


def open_outside(folder: RunFolder, model: AngleModel) -> dict[str, NDArray[np.bool_]]:
    """Masks (H, W) by view of pixels that show something outside a box; none without a box."""
    names = [view.name for view in posed_views(folder)]
    paths = {name: folder.views(model) / OUTSIDE.format(name=name) for name in names}
    return {n: map_array(path, np.bool_) for n, path in paths.items() if path.is_file()}


def open_checked(workspace: Path, folder: RunFolder) -> DenseWorkspace:
    """A user's COLMAP workspace, after a check that it has the run's images and model.

    Raises
    ------
    DataError
        It is unusable, or of other images or another model.
    """
    given, model = open_dense_workspace(workspace), read_model(folder.sparse)
    require_same_frame(given, model)
    require_matching_images(given, model, lambda name: read_gray(folder.images / name))
    return given


def _open_given(options: FusionOptions, folder: RunFolder) -> DenseWorkspace | None:
    """The COLMAP workspace of the options, if they name one."""
    if options.workspace is None:
        return None
    given = open_checked(options.workspace, folder)
    if backups := previous_backups(given):
        logger.warning(
            "%s: was filled before, and what filled it counts as COLMAP's; the maps from before "
            "are in %s.",
            given.folder,
            backups[0].name,
        )
    return given


def surface_cloud(cloud: FusedCloud, kind: PointKind = PointKind.SURFACE) -> Cloud:
    """A fused cloud for writing, with grey colours as in COLMAP's images.

    The brightest 1 % are white.
    """
    white = float(np.percentile(cloud.intensity, 99)) if len(cloud.intensity) else 1.0
    share = np.clip(cloud.intensity / max(white, 1e-9), 0, 1) ** (1 / DISPLAY_GAMMA)
    grey = np.rint(255 * share).astype(np.uint8)
    return Cloud(
        points=cloud.points,
        normals=cloud.normals,
        colors=np.repeat(grey[:, None], 3, axis=1),
        scalars={
            "num_views": cloud.num_views,
            "sigma": cloud.sigma,
            "sigma_deg": cloud.sigma_deg,
            "kind": np.full(len(cloud.points), kind, np.float32),
        },
    )


def surroundings_cloud(
    tracks: Tracks,
    surface: FusedCloud,
    given: _Inputs,
    workspace: DenseWorkspace | None,
    folder: Path,
) -> Cloud:
    """Points of the surroundings, of the kind that the options select.

    Parameters
    ----------
    tracks : of the COLMAP model.
    surface : of the polarized parts; COLMAP's points on it are left out.
    workspace : the user's COLMAP workspace, if there is one; its points are the surroundings.
    folder : for temporary files.
    """
    if workspace is not None:
        return surface_cloud(kept_cloud(workspace, surface.points), PointKind.COLMAP)
    maps, wanted = given.maps, given.options.fusion.surroundings
    if wanted is Surroundings.STEREO:
        found = stereo_surroundings(tracks, maps, folder, workers=given.workers)
        if len(found.points):
            return surface_cloud(found, PointKind.STEREO)
        logger.warning(
            "`fusion.surroundings` stereo finds no points: too few views lie near enough to each "
            "other to be matched and confirmed. The sparse points are kept; record more views."
        )
    if wanted is not Surroundings.NONE:
        return sparse_part(sparse_surroundings(tracks, maps))
    return surface_cloud(surface[np.zeros(len(surface.points), np.bool_)])


def sparse_part(sparse: SparseSurroundings) -> Cloud:
    """Sparse points for writing; their normals are zero, as they have none."""
    num = len(sparse.points)
    unknown = np.full(num, np.nan)
    return Cloud(
        points=sparse.points,
        normals=np.zeros((num, 3)),
        colors=sparse.colors,
        scalars={
            "num_views": sparse.num_views,
            "sigma": unknown,
            "sigma_deg": unknown,
            "kind": np.full(num, PointKind.SPARSE, np.float32),
        },
    )


def _join_clouds(first: Cloud, second: Cloud) -> Cloud:
    """The points of two clouds; scalars that one lacks are NaN there."""
    return Cloud(
        points=np.concatenate([first.points, second.points]),
        normals=_joined(first.normals, second.normals),
        colors=_joined(first.colors, second.colors),
        scalars={
            name: np.concatenate(
                [
                    cloud.scalars.get(name, np.full(len(cloud.points), np.nan, np.float32))
                    for cloud in (first, second)
                ]
            )
            for name in {**first.scalars, **second.scalars}
        },
    )


def _joined(first: NDArray[T] | None, second: NDArray[T] | None) -> NDArray[T] | None:
    return None if first is None or second is None else np.concatenate([first, second])
