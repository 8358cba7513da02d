"""What is done with a sparse model once it is read: fitted to a capture, and written.

A user's model is never modified; what is written is the model as it is used.
"""

from __future__ import annotations

import logging
import os
import shutil
import tempfile
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from os import PathLike
from pathlib import Path, PurePosixPath

import numpy as np
from numpy.typing import NDArray

from polmvs.camera import Camera, PinholeCamera
from polmvs.colmap.models import ColmapCamera, camera_to_colmap, pycolmap
from polmvs.errors import DataError
from polmvs.scene import SparseModel, Tracks

logger = logging.getLogger(__name__)

MAX_NAMES_SHOWN = 5


def match_model_to_capture(
    model: SparseModel,
    names: Sequence[str],
    width: int,
    height: int,
    *,
    source: str | PathLike[str] = "sparse model",
) -> SparseModel:
    """Fit a model to a capture: its names, and the size of its polarization images.

    Images are matched by name, else by name without folders and suffix where that is unambiguous.
    Views that the capture lacks are dropped, and tracks that no view is left of. Cameras of
    another size with the same aspect ratio are rescaled together with their observations; those
    of the raw mosaic, which has exactly twice the size, thus get ``K / 2``.

    Parameters
    ----------
    model : as read.
    names : of the capture's images.
    width, height : of the polarization images, px.
    source : where the model came from, for messages.

    Returns
    -------
    SparseModel
        Views have the capture's names; ``unregistered`` are the capture's images without a pose.

    Raises
    ------
    DataError
        No image matches, or a camera has another aspect ratio.
    """
    new_names = matching_names([view.name for view in model.views], names, source)
    kept = [i for i, name in enumerate(new_names) if name is not None]
    dropped = [model.views[i].name for i, name in enumerate(new_names) if name is None]
    if dropped:
        logger.warning(
            "%s: %d views are not in the capture and are left out: %s.",
            source,
            len(dropped),
            short_list(dropped),
        )
    kept.sort(key=lambda i: str(new_names[i]))
    views = []
    scales = np.ones((len(model.views), 2))
    for i in kept:
        camera = model.views[i].camera
        fitted = _fit_camera(camera, width, height, source)
        scales[i] = fitted.width / camera.width, fitted.height / camera.height
        views.append(replace(model.views[i], name=str(new_names[i]), camera=fitted))
    if (scales != 1).any():
        logger.info("%s: cameras are rescaled to %dx%d px.", source, width, height)
    registered = {view.name for view in views}
    return SparseModel(
        views=tuple(views),
        tracks=_select_tracks(model.tracks, kept, scales),
        unregistered=tuple(sorted(set(names) - registered)),
    )


def short_list(names: Sequence[str]) -> str:
    """The first few names, and how many more there are."""
    more = len(names) - MAX_NAMES_SHOWN
    return ", ".join(names[:MAX_NAMES_SHOWN]) + (f" and {more} more" if more > 0 else "")


def matching_names(
    model_names: Sequence[str], names: Sequence[str], source: str | PathLike[str]
) -> list[str | None]:
    """The capture's name of each of the model's images, None where it has none."""
    available = set(names)
    exact = [name if name in available else None for name in model_names]
    if any(exact):
        return exact
    by_stem = _unique_stems(names)
    model_stems = _unique_stems(model_names)
    matched = [
        by_stem.get(_stem(name)) if _stem(name) in model_stems else None for name in model_names
    ]
    if not any(matched):
        raise DataError(
            source,
            f"its images are named like {model_names[0]!r} but the capture's like "
            f"{sorted(names)[0]!r}; none match. Give the model of this capture.",
        )
    logger.warning("%s: images are matched by name without folder and suffix.", source)
    return matched


def _stem(name: str) -> str:
    return PurePosixPath(name).stem


def _unique_stems(names: Sequence[str]) -> dict[str, str]:
    """Name of each stem that occurs once."""
    count = Counter(_stem(name) for name in names)
    return {_stem(name): name for name in names if count[_stem(name)] == 1}


def _fit_camera(camera: Camera, width: int, height: int, source: str | PathLike[str]) -> Camera:
    """The camera at the polarization images' size."""
    if (camera.width, camera.height) == (width, height):
        return camera
    # Tools that resize round each side to a pixel of their own.
    if abs(camera.width * height / width - camera.height) > max(1.0, height / width):
        raise DataError(
            source,
            f"its camera is {camera.width}x{camera.height} px, the polarization images are "
            f"{width}x{height} px: another aspect ratio. Give the model of this capture.",
        )
    if isinstance(camera, ColmapCamera):
        return camera.rescaled(width, height)
    if not isinstance(camera, PinholeCamera):
        raise TypeError(f"{type(camera).__name__} cannot be rescaled.")
    x, y = width / camera.width, height / camera.height
    return PinholeCamera(
        width=width,
        height=height,
        fx=camera.fx * x,
        fy=camera.fy * y,
        cx=camera.cx * x,
        cy=camera.cy * y,
    )


def _select_tracks(tracks: Tracks, kept: Sequence[int], scales: NDArray[np.float64]) -> Tracks:
    """Observations in the kept views and the tracks that have any, in the new pixels."""
    new_view = np.full(len(scales), -1)
    new_view[list(kept)] = np.arange(len(kept))
    obs = np.flatnonzero(new_view[tracks.obs_view] >= 0)
    used = np.zeros(len(tracks.point3D_ids), bool)
    used[tracks.obs_track[obs]] = True
    mean_scale = float(scales[list(kept)].mean())
    return Tracks(
        point3D_ids=tracks.point3D_ids[used],
        points_in_world=tracks.points_in_world[used],
        colors=tracks.colors[used],
        errors=tracks.errors[used] * mean_scale,
        obs_track=(np.cumsum(used) - 1)[tracks.obs_track[obs]],
        obs_view=new_view[tracks.obs_view[obs]],
        obs_xy=tracks.obs_xy[obs] * scales[tracks.obs_view[obs]],
    )


def write_model(model: SparseModel, folder: str | PathLike[str]) -> None:
    """Write a model as COLMAP binary, whole or not at all; a folder of that name is replaced.

    Keypoints without a track and images without a pose are not part of a :class:`SparseModel`
    and are not written. Each view becomes an image with its own frame.
    """
    write_reconstruction(_reconstruction(model), folder)


def write_reconstruction(
    reconstruction: pycolmap.Reconstruction, folder: str | PathLike[str]
) -> None:
    """Write a reconstruction as COLMAP binary, whole or not at all."""
    target = Path(folder)
    target.parent.mkdir(parents=True, exist_ok=True)
    temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    try:
        temporary.chmod(0o777 & ~_umask())
        reconstruction.write_binary(str(temporary))
        if target.exists():
            shutil.rmtree(target)
        temporary.rename(target)
    except BaseException:
        shutil.rmtree(temporary, ignore_errors=True)
        raise


def _umask() -> int:
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _reconstruction(model: SparseModel) -> pycolmap.Reconstruction:
    """The model in pycolmap's types; ids of points are kept."""
    reconstruction = pycolmap.Reconstruction()
    cameras = list(dict.fromkeys(view.camera for view in model.views))
    for index, camera in enumerate(cameras):
        colmap_camera = camera_to_colmap(camera)
        colmap_camera.camera_id = index + 1
        reconstruction.add_camera_with_trivial_rig(colmap_camera)
    tracks = model.tracks
    # Index of an observation among those of its image.
    order = np.argsort(tracks.obs_view, kind="stable")
    starts = np.searchsorted(tracks.obs_view[order], np.arange(len(model.views) + 1))
    point2D_idx = np.empty(len(order), np.int64)
    for index, view in enumerate(model.views):
        own = order[starts[index] : starts[index + 1]]
        point2D_idx[own] = np.arange(len(own))
        image = pycolmap.Image(
            name=view.name,
            keypoints=tracks.obs_xy[own],
            camera_id=cameras.index(view.camera) + 1,
            image_id=index + 1,
        )
        pose = view.cam_from_world
        matrix = np.column_stack([pose.rotation, pose.translation])
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(matrix))
    _add_points(reconstruction, tracks, point2D_idx)
    return reconstruction


def _add_points(
    reconstruction: pycolmap.Reconstruction, tracks: Tracks, point2D_idx: NDArray[np.int64]
) -> None:
    """Add all tracks; ``point2D_idx`` is each observation's index in its image."""
    order = np.argsort(tracks.obs_track, kind="stable")
    starts = np.searchsorted(tracks.obs_track[order], np.arange(len(tracks.point3D_ids) + 1))
    for index, point3D_id in enumerate(tracks.point3D_ids):
        own = order[starts[index] : starts[index + 1]].tolist()
        elements = [
            pycolmap.TrackElement(int(tracks.obs_view[i]) + 1, int(point2D_idx[i])) for i in own
        ]
        point = pycolmap.Point3D(
            xyz=tracks.points_in_world[index],
            color=tracks.colors[index],
            error=float(tracks.errors[index]),
            track=pycolmap.Track(elements),
        )
        reconstruction.add_point3D_with_id(int(point3D_id), point)
