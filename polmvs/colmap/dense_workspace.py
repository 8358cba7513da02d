"""COLMAP's dense workspace: a folder of undistorted images, their model, depth and normal maps.

``images/``, ``sparse/`` (pinhole cameras), ``stereo/depth_maps/``, ``stereo/normal_maps/`` with
``<image>.geometric.bin`` or ``<image>.photometric.bin``, ``stereo/fusion.cfg`` and
``stereo/patch-match.cfg``. COLMAP's fusion, its GUI and OpenMVS read it. A workspace from a user
must belong to the capture: it must have the same frame and images.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from os import PathLike
from pathlib import Path, PurePosixPath
from typing import NamedTuple

import cv2
import numpy as np
import pycolmap
from numpy.typing import NDArray
from scipy import sparse

from polmvs.arrays import Array
from polmvs.camera import PinholeCamera
from polmvs.colmap.cameras import rescaled_camera
from polmvs.colmap.maps import (
    DepthNormals,
    check_depth_map,
    check_normal_map,
    read_depth_map,
    read_normal_map,
    write_depth_map,
    write_normal_map,
)
from polmvs.colmap.models import read_model, require_matches, write_model
from polmvs.colmap.undistort import undistorted_model, warp_image
from polmvs.errors import DataError
from polmvs.geometry import SimilarityTransform, align_points, rotation_angle
from polmvs.io.folders import new_folder
from polmvs.io.images import read_gray, write_bytes, write_png
from polmvs.scene import KEYPOINT_SIGMA_PX, SparseModel, Tracks, View, short_list

PathArg = str | PathLike[str]
Gray = NDArray[np.float32]
ImageLoader = Callable[[str], NDArray[np.uint8]]
# Maps of a view at the pixels of its undistorted camera, None for none.
MapsLoader = Callable[[View, PinholeCamera], DepthNormals | None]

IMAGES, SPARSE, STEREO = "images", "sparse", "stereo"
DEPTH_MAPS, NORMAL_MAPS, GRAPHS = "depth_maps", "normal_maps", "consistency_graphs"
FUSION_FILE, PATCH_MATCH_FILE = "fusion.cfg", "patch-match.cfg"
GEOMETRIC, PHOTOMETRIC = "geometric", "photometric"
FUSED_NORMAL_DEG = pycolmap.StereoFusionOptions().max_normal_error  # between views
NUM_SOURCES = 20  # as many as COLMAP's own undistorter asks for


@dataclass(frozen=True, kw_only=True)
class MatchTolerances:
    """Tolerances of the frame and the images of a workspace.

    Attributes
    ----------
    max_pose_error_px : displacement of a point of the scene by a pose difference; derived: the
        error of a keypoint, and the rounding of models in text files.
    min_correlation : of the local contrast of two images; derived: each then explains half of the
        variance of the other. Images of different scenes explain nothing, the same image nearly
        all, at any exposure.
    max_compared_px : longest side of the compared images; a guess, bounds the time.
    max_compared_views : spread over the workspace; a guess, bounds the time.
    fine_sigma_px, coarse_sigma_px : band of the contrast, compared pixels; a guess: from the
        resolution of the reduced image to a thirtieth of the image.
    dark_level : grey levels added before the logarithm; a guess: below it are noise and differences
        of gamma curves.
    min_common_share : of the compared image that both must show; a guess.
    """

    max_pose_error_px: float = KEYPOINT_SIGMA_PX
    min_correlation: float = float(np.sqrt(0.5))
    max_compared_px: int = 256
    max_compared_views: int = 6
    fine_sigma_px: float = 1.0
    coarse_sigma_px: float = 8.0
    dark_level: float = 4.0
    min_common_share: float = 0.25


TOL = MatchTolerances()


@dataclass(frozen=True, kw_only=True)
class WorkspaceView:
    """One view of a dense workspace.

    Attributes
    ----------
    view : name, undistorted camera and pose.
    image : undistorted image.
    depth, normals : map files of one kind, geometric if available; None if either map is missing.
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
        """Depth and normals in the camera frame; None if the view has none.

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
            The file is not an image or has another size than the camera.
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


def open_dense_workspace(folder: PathArg) -> DenseWorkspace:
    """Open a dense workspace and check it without loading the maps.

    Views without maps are allowed.

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
    sparse_model = read_model(root / SPARSE)
    missing = [v.name for v in sparse_model.views if not member(root / IMAGES, v.name).is_file()]
    if missing:
        raise DataError(
            root / IMAGES,
            f"lacks {len(missing)} of the model's {len(sparse_model.views)} images: "
            f"{short_list(missing)}. Run COLMAP's image_undistorter again.",
        )
    views = tuple(_open_view(root, view) for view in sparse_model.views)
    return DenseWorkspace(folder=root, views=views, tracks=sparse_model.tracks)


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
    sparse_model: SparseModel,
    load_image: ImageLoader,
    load_maps: MapsLoader,
    *,
    blank_pixels: float = 0.0,
    max_image_size: int | None = None,
) -> None:
    """Write a dense workspace, whole or not at all; one view is in memory at a time.

    Parameters
    ----------
    folder : to make; it may exist if it is empty.
    sparse_model : of the sensor's pixels.
    load_image : gives an image's (H, W) uint8 intensity by name.
    load_maps : gives a view's depth and normals at the pixels of its undistorted camera, None for
        a view without; such a view has no maps and is not in ``fusion.cfg``.
    blank_pixels, max_image_size : see :func:`polmvs.colmap.undistort.undistorted_camera`.

    Raises
    ------
    DataError
        The folder is in use or cannot be written, or an image's name leads out of it.
    """
    undistorted = undistorted_model(
        sparse_model, blank_pixels=blank_pixels, max_image_size=max_image_size
    )
    with new_folder(folder) as root:
        stereo = root / STEREO
        for name in (DEPTH_MAPS, NORMAL_MAPS, GRAPHS):
            (stereo / name).mkdir(parents=True)
        write_model(undistorted, root / SPARSE)
        fused = []
        for view, target in zip(sparse_model.views, undistorted.views, strict=True):
            assert isinstance(target.camera, PinholeCamera)
            image, _ = warp_image(load_image(view.name), view.camera, target.camera)
            path = member(root / IMAGES, view.name)
            path.parent.mkdir(parents=True, exist_ok=True)
            write_png(path, np.rint(image).astype(np.uint8))
            maps = load_maps(view, target.camera)
            if maps is not None:
                write_maps(stereo, view.name, maps)
                fused.append(view.name)
        write_lines(stereo / FUSION_FILE, fused)
        write_lines(stereo / PATCH_MATCH_FILE, _patch_match_lines(undistorted))


def source_order(sparse_model: SparseModel) -> list[list[int]]:
    """Other views of each view, ordered by common sparse points and then by distance."""
    tracks, num_views = sparse_model.tracks, len(sparse_model.views)
    seen = sparse.csr_matrix(
        (np.ones(len(tracks.obs_view)), (tracks.obs_view, tracks.obs_track)),
        shape=(num_views, len(tracks.point3D_ids)),
    )
    seen.data[:] = 1  # a view that observes a point twice shares it once
    shared = (seen @ seen.T).toarray()
    centers = np.array([view.center_in_world for view in sparse_model.views])
    orders = []
    for index in range(num_views):
        distance = np.linalg.norm(centers - centers[index], axis=1)
        order = np.lexsort((distance, -shared[index]))
        orders.append([int(other) for other in order if other != index])
    return orders


def _patch_match_lines(sparse_model: SparseModel) -> list[str]:
    """An image and its sources in turn; the names outright, which is all that OpenMVS reads."""
    names = [view.name for view in sparse_model.views]
    lines = []
    for name, order in zip(names, source_order(sparse_model), strict=True):
        # A name with a comma cannot be listed.
        sources = [names[other] for other in order if "," not in names[other]][:NUM_SOURCES]
        if sources:
            lines += [name, ", ".join(sources)]
    return lines


def member(folder: Path, name: str) -> Path:
    """Path of an image's file in a folder; the name may have sub-folders.

    Names come with a model from any source, so they must not lead out of the folder.
    """
    relative = PurePosixPath(name)
    if relative.is_absolute() or ".." in relative.parts or not relative.parts:
        raise DataError(folder, f"{name!r} is no name of an image in it. Rename it in the model.")
    return folder / relative


def map_files(stereo: Path, name: str, kind: str = GEOMETRIC) -> tuple[Path, Path]:
    """Depth and normal map of an image in a stereo folder, whether they exist or not."""
    file = f"{name}.{kind}.bin"
    return member(stereo / DEPTH_MAPS, file), member(stereo / NORMAL_MAPS, file)


def write_maps(stereo: Path, name: str, maps: DepthNormals) -> None:
    """Write the geometric maps of an image into a stereo folder."""
    depth, normals = map_files(stereo, name)
    for path in (depth, normals):
        path.parent.mkdir(parents=True, exist_ok=True)
    write_depth_map(depth, maps.depth)
    write_normal_map(normals, maps.normals)


def write_lines(path: Path, lines: Sequence[str]) -> None:
    """Write a text file whole or not at all."""
    write_bytes(path, "".join(f"{line}\n" for line in lines).encode())


class CommonView(NamedTuple):
    """A view of the workspace and the same view of the capture's model."""

    item: WorkspaceView
    view: View


def common_views(workspace: DenseWorkspace, sparse_model: SparseModel) -> list[CommonView]:
    """Views of the workspace and of the model with the same name, else the same stem.

    Raises
    ------
    DataError
        There are none.
    """
    by_name = {view.name: view for view in sparse_model.views}
    names = [item.view.name for item in workspace.views]
    matched = require_matches(names, list(by_name), workspace.folder)
    return [
        CommonView(item, by_name[matched[item.view.name]])
        for item in workspace.views
        if item.view.name in matched
    ]


def require_same_frame(
    workspace: DenseWorkspace,
    sparse_model: SparseModel,
) -> None:
    """Refuse a workspace whose poses differ from those of the capture's model.

    Views of the same name must agree in centre and rotation: a point at the scene's distance must
    move by less than ``max_pose_error_px`` in the workspace's image.

    Raises
    ------
    DataError
        They differ, or there is no common view. The message names the worst view, and says whether
        the two agree after a similarity.
    """
    pairs = common_views(workspace, sparse_model)
    distances = _scene_distances(pairs, workspace)
    errors = _pose_errors_px(pairs, distances, None)
    worst = int(errors.argmax())
    if errors[worst] <= TOL.max_pose_error_px:
        return
    hint = _after_similarity(pairs, distances, TOL.max_pose_error_px)
    raise DataError(
        workspace.folder,
        f"its poses are in another frame than those of the capture's model: the scene lies "
        f"{errors[worst]:.3g} px apart in {pairs[worst].item.view.name}, the worst of "
        f"{len(pairs)} views{hint}. "
        "Give the model that the workspace was made from as `sfm.sparse`, without "
        "`reference.reference`, `reference.aruco` and `reference.scale`.",
    )


def _after_similarity(pairs: Sequence[CommonView], distances: Array, max_error_px: float) -> str:
    """Part of the message: agreement of the two models after a similarity."""
    ours = np.array([pair.view.center_in_world for pair in pairs])
    theirs = np.array([pair.item.view.center_in_world for pair in pairs])
    try:
        theirs_from_ours = align_points(ours, theirs)
    except ValueError:  # too few views, or all on a line
        return ""
    errors = _pose_errors_px(pairs, distances, theirs_from_ours)
    if not errors.max() <= max_error_px:
        return f" (after a similarity still {errors.max():.3g} px)"
    turn = rotation_angle(theirs_from_ours.rotation, np.eye(3))
    return (
        f"; they agree after a similarity (scale {theirs_from_ours.scale:.6g}, rotation "
        f"{np.degrees(turn):.3g} degrees)"
    )


def _pose_errors_px(
    pairs: Sequence[CommonView], distances: Array, theirs_from_ours: SimilarityTransform | None
) -> Array:
    """Shift (N,) of the scene between the two poses of each view, pixels of the workspace."""
    errors = np.empty(len(pairs))
    for i, (item, view) in enumerate(pairs):
        center, rotation = view.center_in_world, view.cam_from_world.rotation
        if theirs_from_ours is not None:
            center = theirs_from_ours * center
            rotation = rotation @ theirs_from_ours.rotation.T
        shift = np.linalg.norm(item.view.center_in_world - center) / distances[i]
        turn = rotation_angle(item.view.cam_from_world.rotation, rotation)
        errors[i] = (shift + turn) * item.camera.mean_focal_px
    return errors


def _scene_distances(pairs: Sequence[CommonView], workspace: DenseWorkspace) -> Array:
    """Median distance (N,) from each view of the workspace to the points it observes."""
    tracks = workspace.tracks
    names = [item.view.name for item in workspace.views]
    own = dict(zip(names, tracks.of_views(len(names)), strict=True))
    centers = np.array([pair.item.view.center_in_world for pair in pairs])
    distances = np.full(len(pairs), np.nan)
    for i, pair in enumerate(pairs):
        seen = tracks.obs_track[own[pair.item.view.name]]
        if len(seen):
            distances[i] = np.median(pair.item.view.ranges(tracks.points_in_world[seen]))
    # A view without points: as far as the others, or as the cameras are from each other.
    spread = max(float(np.linalg.norm(np.ptp(centers, axis=0))), 1e-9)
    known = distances[np.isfinite(distances)]
    return np.where(np.isfinite(distances), distances, np.median(known) if len(known) else spread)


def require_matching_images(
    workspace: DenseWorkspace,
    sparse_model: SparseModel,
    load_image: ImageLoader,
) -> float:
    """Refuse a workspace whose undistorted images differ from those of the capture.

    The capture's intensity images are warped to the workspace's cameras, of any size, and the local
    contrast of both is compared in a few views.

    Parameters
    ----------
    workspace, sparse_model : of the same frame, see :func:`require_same_frame`.
    load_image : gives an image of the capture, (H, W) uint8, by its name in the model.

    Returns
    -------
    The lowest correlation.

    Raises
    ------
    DataError
        An image does not match, or there is no common view.
    """
    pairs = common_views(workspace, sparse_model)
    step = -(-len(pairs) // TOL.max_compared_views)
    lowest = 1.0
    for item, view in pairs[::step]:
        correlation = image_correlation(item.load_image(), item.camera, load_image(view.name), view)
        if not correlation >= TOL.min_correlation:
            raise DataError(
                item.image,
                "undistorted images do not match the polarization images (correlation "
                f"{correlation:.2f} with {view.name}, {TOL.min_correlation:.2f} is "
                "expected). "
                "Undistort the images of this capture with its own model.",
            )
        lowest = min(lowest, correlation)
    return lowest


def image_correlation(
    undistorted: NDArray[np.uint8],
    camera: PinholeCamera,
    image: NDArray[np.uint8],
    view: View,
) -> float:
    """Correlation of the local contrast of an undistorted image and one of the sensor.

    In the logarithm of the image, a gamma is a factor and an exposure an offset; a band-passed
    image is independent of both.

    Parameters
    ----------
    undistorted : (H, W), of ``camera``.
    image : (h, w), of ``view.camera``, which has the same pose.

    Returns
    -------
    From -1 to 1; 0 where the two have too few pixels in common or no contrast.
    """
    share = min(1.0, TOL.max_compared_px / max(camera.width, camera.height))
    size = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    compared = rescaled_camera(camera, *size)
    assert isinstance(compared, PinholeCamera)  # it was one
    shrunk = cv2.resize(_log(undistorted), size, interpolation=cv2.INTER_AREA)
    # A pixel of the comparison covers many of the sensor's: average before sampling.
    ratio = view.camera.mean_focal_px / (camera.mean_focal_px * share)
    smooth = cv2.GaussianBlur(_log(image), (0, 0), max(0.5 * ratio, 0.1))
    warped, mask = warp_image(smooth, view.camera, compared)
    if np.count_nonzero(mask) < TOL.min_common_share * mask.size:
        return 0.0
    one = _contrast(np.asarray(shrunk, np.float32), mask)
    two = _contrast(warped, mask)
    norm = float(np.sqrt((one**2).sum() * (two**2).sum()))
    return float((one * two).sum() / norm) if norm > 0 else 0.0


def _log(image: NDArray[np.uint8]) -> Gray:
    return np.asarray(np.log(image.astype(np.float32) + np.float32(TOL.dark_level)))


def _contrast(image: Gray, mask: NDArray[np.bool_]) -> Array:
    """Band-passed image at the pixels of the mask (N,), blurred within the mask only."""
    sigmas = (TOL.fine_sigma_px, TOL.coarse_sigma_px)
    fine, coarse = (_masked_blur(image, mask, sigma) for sigma in sigmas)
    band = (fine - coarse)[mask].astype(np.float64)
    return np.asarray(band - band.mean(), np.float64)


def _masked_blur(image: Gray, mask: NDArray[np.bool_], sigma: float) -> Gray:
    weight = mask.astype(np.float32)
    total = cv2.GaussianBlur(image * weight, (0, 0), sigma)
    return np.asarray(total / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6), np.float32)
