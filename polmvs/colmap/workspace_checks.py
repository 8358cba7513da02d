"""Whether a dense workspace belongs to a capture: the same frame, the same images."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import PinholeCamera
from polmvs.colmap.dense_workspace import DenseWorkspace, ImageLoader, WorkspaceView
from polmvs.colmap.models import camera_from_colmap, camera_to_colmap
from polmvs.colmap.sparse_model import matching_names as matching_names
from polmvs.colmap.undistort import warp_image
from polmvs.errors import DataError
from polmvs.geometry import SimilarityTransform, align_points
from polmvs.scene import SparseModel, View

Array = NDArray[np.float64]
Gray = NDArray[np.float32]

# Poses that move a point of the scene by less than half a pixel are the same: depth could not
# tell them apart, and models that went through text files differ by their rounding.
MAX_POSE_ERROR_PX = 0.5
# From here each image explains half of the variance of the other one's local contrast. Images of
# other things explain nothing; the same image explains nearly all of it, whatever its exposure.
MIN_CORRELATION = float(np.sqrt(0.5))
MAX_COMPARED_PX = 256  # longest side of the compared images
MAX_COMPARED_VIEWS = 8  # spread over the workspace
FINE_SIGMA_PX, COARSE_SIGMA_PX = 1.0, 8.0  # band of the contrast, compared pixels
DARK_LEVEL = 4.0  # grey levels; under it lies noise and what gamma curves treat differently
MIN_COMMON_SHARE = 0.25  # of the compared image that both must show


class CommonView(NamedTuple):
    """A view of the workspace and the same of the capture's model."""

    item: WorkspaceView
    view: View


def common_views(workspace: DenseWorkspace, model: SparseModel) -> list[CommonView]:
    """Views of the workspace and of the model with the same name, else the same stem.

    Raises
    ------
    DataError
        There are none.
    """
    by_name = {view.name: view for view in model.views}
    names = [item.view.name for item in workspace.views]
    matched = matching_names(names, list(by_name), workspace.folder)
    return [
        CommonView(item, by_name[name])
        for item, name in zip(workspace.views, matched, strict=True)
        if name is not None
    ]


def require_same_frame(
    workspace: DenseWorkspace, model: SparseModel, *, max_error_px: float = MAX_POSE_ERROR_PX
) -> None:
    """Refuse a workspace whose poses are not those of the capture's model.

    Views of the same name must agree in centre and rotation so well that a point at the scene's
    distance moves by less than ``max_error_px`` in the workspace's image.

    Raises
    ------
    DataError
        They differ, or no view is common. The message names the worst view, and says whether the
        two agree after a similarity.
    """
    pairs = common_views(workspace, model)
    distances = _scene_distances(pairs, workspace)
    errors = _pose_errors_px(pairs, distances, None)
    worst = int(errors.argmax())
    if errors[worst] <= max_error_px:
        return
    raise DataError(
        workspace.folder,
        f"its poses are in another frame than those of the capture's model: the scene lies "
        f"{errors[worst]:.3g} px apart in {pairs[worst].item.view.name}, the worst of "
        f"{len(pairs)} views{_after_similarity(pairs, distances, max_error_px)}. "
        "Give the model that the workspace was made from as --sparse, without --reference, --aruco "
        "and --scale.",
    )


def _after_similarity(pairs: Sequence[CommonView], distances: Array, max_error_px: float) -> str:
    """What to say of the two models after a similarity."""
    ours = np.array([pair.view.center_in_world for pair in pairs])
    theirs = np.array([pair.item.view.center_in_world for pair in pairs])
    try:
        theirs_from_ours = align_points(ours, theirs)
    except ValueError:  # too few views, or all on a line
        return ""
    errors = _pose_errors_px(pairs, distances, theirs_from_ours)
    if not errors.max() <= max_error_px:
        return f" (after a similarity still {errors.max():.3g} px)"
    cosine = np.clip((np.trace(theirs_from_ours.rotation) - 1) / 2, -1, 1)
    return (
        f"; they agree after a similarity (scale {theirs_from_ours.scale:.6g}, rotation "
        f"{np.degrees(np.arccos(cosine)):.3g} degrees)"
    )


def _pose_errors_px(
    pairs: Sequence[CommonView], distances: Array, theirs_from_ours: SimilarityTransform | None
) -> Array:
    """By how many pixels of the workspace (N,) the scene moves between two poses of each view."""
    errors = np.empty(len(pairs))
    for i, (item, view) in enumerate(pairs):
        center, rotation = view.center_in_world, view.cam_from_world.rotation
        if theirs_from_ours is not None:
            center = theirs_from_ours * center
            rotation = rotation @ theirs_from_ours.rotation.T
        shift = np.linalg.norm(item.view.center_in_world - center) / distances[i]
        difference = item.view.cam_from_world.rotation - rotation
        # |R - S| (Frobenius) is 2 sqrt(2) sin(angle / 2), exact for small angles too.
        turn = 2 * np.arcsin(np.clip(np.linalg.norm(difference) / np.sqrt(8), 0, 1))
        errors[i] = (shift + turn) * item.camera.mean_focal_px
    return errors


def _scene_distances(pairs: Sequence[CommonView], workspace: DenseWorkspace) -> Array:
    """Median distance (N,) from each view of the workspace to the points it observes."""
    tracks = workspace.tracks
    index = {item.view.name: i for i, item in enumerate(workspace.views)}
    centers = np.array([pair.item.view.center_in_world for pair in pairs])
    distances = np.full(len(pairs), np.nan)
    for i, pair in enumerate(pairs):
        seen = tracks.obs_track[tracks.obs_view == index[pair.item.view.name]]
        if len(seen):
            offsets = tracks.points_in_world[seen] - centers[i]
            distances[i] = np.median(np.linalg.norm(offsets, axis=1))
    # A view without points: as far as the others, or as the cameras are from each other.
    spread = max(float(np.linalg.norm(np.ptp(centers, axis=0))), 1e-9)
    known = distances[np.isfinite(distances)]
    return np.where(np.isfinite(distances), distances, np.median(known) if len(known) else spread)


def require_matching_images(
    workspace: DenseWorkspace,
    model: SparseModel,
    load_image: ImageLoader,
    *,
    min_correlation: float = MIN_CORRELATION,
) -> float:
    """Refuse a workspace whose undistorted images do not show what the capture shows.

    The capture's intensity images are warped to the workspace's cameras, whatever their size, and
    the local contrast of both is compared, over at most 8 views.

    Parameters
    ----------
    workspace, model : of the same frame, see :func:`require_same_frame`.
    load_image : gives an image of the capture, (H, W) uint8, by its name in the model.
    min_correlation : that every view must reach.

    Returns
    -------
    The lowest correlation.

    Raises
    ------
    DataError
        An image does not match, or no view is common.
    """
    pairs = common_views(workspace, model)
    step = -(-len(pairs) // MAX_COMPARED_VIEWS)
    lowest = 1.0
    for item, view in pairs[::step]:
        correlation = image_correlation(item.load_image(), item.camera, load_image(view.name), view)
        if not correlation >= min_correlation:
            raise DataError(
                item.image,
                f"undistorted images do not match the polarization images (correlation "
                f"{correlation:.2f} with {view.name}, {min_correlation:g} is expected). "
                "Undistort the images of this capture with its own model.",
            )
        lowest = min(lowest, correlation)
    return lowest


def image_correlation(
    undistorted: NDArray[np.uint8], camera: PinholeCamera, image: NDArray[np.uint8], view: View
) -> float:
    """Correlation of the local contrast of an undistorted image and one of the sensor.

    In the logarithm of the image a gamma is a factor and an exposure an offset; a band of it is
    blind to both.

    Parameters
    ----------
    undistorted : (H, W), of ``camera``.
    image : (h, w), of ``view.camera``, which has the same pose.

    Returns
    -------
    From -1 to 1; 0 where the two have too few pixels in common or no contrast.
    """
    share = min(1.0, MAX_COMPARED_PX / max(camera.width, camera.height))
    size = max(1, round(camera.width * share)), max(1, round(camera.height * share))
    shrunk = cv2.resize(_log(undistorted), size, interpolation=cv2.INTER_AREA)
    # A pixel of the comparison covers many of the sensor's: average before sampling.
    ratio = view.camera.mean_focal_px / (camera.mean_focal_px * share)
    smooth = cv2.GaussianBlur(_log(image), (0, 0), max(0.5 * ratio, 0.1))
    warped, mask = warp_image(smooth, view.camera, _rescaled(camera, *size))
    if np.count_nonzero(mask) < MIN_COMMON_SHARE * mask.size:
        return 0.0
    one, two = _contrast(np.asarray(shrunk, np.float32), mask), _contrast(warped, mask)
    norm = float(np.sqrt((one**2).sum() * (two**2).sum()))
    return float((one * two).sum() / norm) if norm > 0 else 0.0


def _log(image: NDArray[np.uint8]) -> Gray:
    return np.asarray(np.log(image.astype(np.float32) + np.float32(DARK_LEVEL)))


def _contrast(image: Gray, mask: NDArray[np.bool_]) -> Array:
    """Band-passed image at the pixels of the mask (N,), blurred within the mask only."""
    fine, coarse = (_masked_blur(image, mask, s) for s in (FINE_SIGMA_PX, COARSE_SIGMA_PX))
    band = (fine - coarse)[mask].astype(np.float64)
    return np.asarray(band - band.mean(), np.float64)


def _masked_blur(image: Gray, mask: NDArray[np.bool_], sigma: float) -> Gray:
    weight = mask.astype(np.float32)
    total = cv2.GaussianBlur(image * weight, (0, 0), sigma)
    return np.asarray(total / np.maximum(cv2.GaussianBlur(weight, (0, 0), sigma), 1e-6), np.float32)


def _rescaled(camera: PinholeCamera, width: int, height: int) -> PinholeCamera:
    resized = camera_to_colmap(camera)
    resized.rescale(width, height)
    result = camera_from_colmap(resized)
    assert isinstance(result, PinholeCamera)  # it was one
    return result
