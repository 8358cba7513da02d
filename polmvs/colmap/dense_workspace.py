"""COLMAP's dense workspace: a folder of undistorted images, their model, depth and normal maps.

``images/``, ``sparse/`` (pinhole cameras), ``stereo/depth_maps/``, ``stereo/normal_maps/`` with
``<image>.geometric.bin`` or ``<image>.photometric.bin``, ``stereo/fusion.cfg`` and
``stereo/patch-match.cfg``. COLMAP's fusion and its GUI read it, and OpenMVS.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from os import PathLike
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from polmvs.camera import PinholeCamera
from polmvs.colmap.maps import (
    DepthNormals,
    check_depth_map,
    check_normal_map,
    read_depth_map,
    read_normal_map,
)
from polmvs.colmap.models import read_model
from polmvs.colmap.sparse_model import short_list, write_model
from polmvs.colmap.undistort import undistorted_model, warp_dense_view, warp_image
from polmvs.colmap.workspace_layout import (
    DEPTH_MAPS,
    FUSION_FILE,
    GEOMETRIC,
    GRAPHS,
    IMAGES,
    NORMAL_MAPS,
    PATCH_MATCH_FILE,
    PHOTOMETRIC,
    SPARSE,
    STEREO,
    map_files,
    member,
    new_folder,
    write_lines,
    write_maps,
)
from polmvs.errors import DataError
from polmvs.io.images import read_gray, write_png
from polmvs.scene import SparseModel, Tracks, View
from polmvs.surface.dense_view import DenseView

PathArg = str | PathLike[str]
ImageLoader = Callable[[str], NDArray[np.uint8]]
DenseLoader = Callable[[str], DenseView | None]

NUM_SOURCES = 20  # as many as COLMAP's own undistorter asks for


@dataclass(frozen=True, kw_only=True)
class WorkspaceView:
    """One view of a dense workspace.

    Attributes
    ----------
    view : name, undistorted camera and pose.
    image : undistorted image.
    depth, normals : map files of one kind, geometric if there are such; None where either map
        is missing.
    """

    view: View
    image: Path
    depth: Path | None
    normals: Path | None

    @property
    def camera(self) -> PinholeCamera:
        """The undistorted camera."""
        assert isinstance(self.view.camera, PinholeCamera)  # checked on opening
        return self.view.camera

    def load_maps(self) -> DepthNormals | None:
        """Depth and normals in the camera frame, None where the view has none.

        Raises
        ------
        DataError
            A map is damaged.
        """
        if self.depth is None or self.normals is None:
            return None
        depth = read_depth_map(self.depth, self.camera)
        return DepthNormals(depth, read_normal_map(self.normals, self.camera))

    def load_image(self) -> NDArray[np.uint8]:
        """The undistorted image in grey, ``(H, W)`` uint8.

        Raises
        ------
        DataError
            It is no image or of another size than the camera.
        """
        gray = read_gray(self.image)
        if gray.shape != (self.camera.height, self.camera.width):
            raise DataError(
                self.image,
                f"is {gray.shape[1]}x{gray.shape[0]} px but its camera {self.camera.width}x"
                f"{self.camera.height} px. Undistort the images again.",
            )
        return gray


@dataclass(frozen=True, kw_only=True)
class DenseWorkspace:
    """A dense workspace on disk, checked as a whole, loaded one view at a time.

    Attributes
    ----------
    folder : of the workspace.
    views : registered images, sorted by name.
    tracks : sparse points, with observations in undistorted pixels.
    """

    folder: Path
    views: tuple[WorkspaceView, ...]
    tracks: Tracks

    @property
    def stereo(self) -> Path:
        """Folder of the maps."""
        return self.folder / STEREO

    @property
    def without_maps(self) -> tuple[str, ...]:
        """Names of the views that have no depth map or no normal map."""
        return tuple(item.view.name for item in self.views if item.depth is None)


def open_dense_workspace(folder: PathArg) -> DenseWorkspace:
    """Open a dense workspace of COLMAP's or ours, and check what can be checked without loading.

    Views without maps are fine, see :attr:`DenseWorkspace.without_maps`.

    Raises
    ------
    DataError
        There is no stereo folder, the model or an image is missing, a camera is distorted, or a
        map is truncated or of another size than its camera.
    """
    root = Path(folder)
    if not root.is_dir():
        raise DataError(root, "is no folder." if root.exists() else "no such folder.")
    if not (root / STEREO).is_dir():
        raise DataError(root, "has no stereo folder. Give what COLMAP's image_undistorter wrote.")
    model = read_model(root / SPARSE)
    missing = [v.name for v in model.views if not member(root / IMAGES, v.name).is_file()]
    if missing:
        raise DataError(
            root / IMAGES,
            f"lacks {len(missing)} of the model's {len(model.views)} images: "
            f"{short_list(missing)}. Run COLMAP's image_undistorter again.",
        )
    views = tuple(_open_view(root, view) for view in model.views)
    return DenseWorkspace(folder=root, views=views, tracks=model.tracks)


def _open_view(root: Path, view: View) -> WorkspaceView:
    """Find and check the maps of a view."""
    if not isinstance(view.camera, PinholeCamera):
        raise DataError(
            root / SPARSE,
            f"the camera of {view.name} has distortion; a dense workspace has pinhole cameras. "
            "Give what COLMAP's image_undistorter wrote.",
        )
    image = member(root / IMAGES, view.name)
    for kind in (GEOMETRIC, PHOTOMETRIC):
        depth, normals = map_files(root / STEREO, view.name, kind)
        if depth.is_file() and normals.is_file():
            check_depth_map(depth, view.camera)
            check_normal_map(normals, view.camera)
            return WorkspaceView(view=view, image=image, depth=depth, normals=normals)
    return WorkspaceView(view=view, image=image, depth=None, normals=None)


def write_dense_workspace(
    folder: PathArg,
    model: SparseModel,
    load_image: ImageLoader,
    load_dense: DenseLoader,
    *,
    blank_pixels: float = 0.0,
    max_image_size: int | None = None,
) -> None:
    """Write a dense workspace, whole or not at all; one view is in memory at a time.

    Parameters
    ----------
    folder : to make; it may exist if it is empty.
    model : of the sensor's pixels.
    load_image : gives an image's (H, W) uint8 intensity by name.
    load_dense : gives an image's dense result by name, None for a view without; such a view has
        no maps and is not in ``fusion.cfg``.
    blank_pixels, max_image_size : see :func:`polmvs.colmap.undistort.undistorted_camera`.

    Raises
    ------
    DataError
        The folder is in use or cannot be written, or an image's name leads out of it.
    """
    undistorted = undistorted_model(model, blank_pixels=blank_pixels, max_image_size=max_image_size)
    with new_folder(folder) as root:
        stereo = root / STEREO
        for name in (DEPTH_MAPS, NORMAL_MAPS, GRAPHS):
            (stereo / name).mkdir(parents=True)
        write_model(undistorted, root / SPARSE)
        fused = []
        for view, target in zip(model.views, undistorted.views, strict=True):
            assert isinstance(target.camera, PinholeCamera)
            image, _ = warp_image(load_image(view.name), view.camera, target.camera)
            path = member(root / IMAGES, view.name)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, np.rint(image).astype(np.uint8))
            dense = load_dense(view.name)
            if dense is not None:
                write_maps(stereo, view.name, warp_dense_view(dense, view, target.camera))
                fused.append(view.name)
        write_lines(stereo / FUSION_FILE, fused)
        write_lines(stereo / PATCH_MATCH_FILE, _patch_match_lines(undistorted))


def source_order(model: SparseModel) -> list[list[int]]:
    """For each view the other views, by shared sparse points and then by nearness."""
    tracks, num_views = model.tracks, len(model.views)
    seen = sparse.csr_matrix(
        (np.ones(len(tracks.obs_view)), (tracks.obs_view, tracks.obs_track)),
        shape=(num_views, len(tracks.point3D_ids)),
    )
    seen.data[:] = 1  # a view that observes a point twice shares it once
    shared = (seen @ seen.T).toarray()
    centers = np.array([view.center_in_world for view in model.views])
    orders = []
    for index in range(num_views):
        distance = np.linalg.norm(centers - centers[index], axis=1)
        order = np.lexsort((distance, -shared[index]))
        orders.append([int(other) for other in order if other != index])
    return orders


def _patch_match_lines(model: SparseModel) -> list[str]:
    """An image and its sources in turn; the names outright, which is all that OpenMVS reads."""
    names = [view.name for view in model.views]
    lines = []
    for name, order in zip(names, source_order(model), strict=True):
        # A name with a comma cannot be listed.
        sources = [names[other] for other in order if "," not in names[other]][:NUM_SOURCES]
        if sources:
            lines += [name, ", ".join(sources)]
    return lines
