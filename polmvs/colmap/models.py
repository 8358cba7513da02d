"""Reading and writing of COLMAP's sparse models, and their fit to a capture.

A user's model is never modified; the written model is the used one. The rest of the package uses
:class:`polmvs.scene.SparseModel` and no type of pycolmap.

Binary files have no end marker, and pycolmap 4.2 reads a truncated file without an error: it
repeats the last record, or runs forever if that is a point. So the records are checked first: they
must fill the file to its last byte. This test is cheap and reliable, half a second for a million
points.
"""

from __future__ import annotations

import logging
import mmap
import re
import struct
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from os import PathLike
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray

from polmvs.arrays import Array
from polmvs.camera import MAX_SIDE, Camera
from polmvs.colmap.cameras import (
    camera_from_colmap,
    camera_to_colmap,
    quiet_colmap,
    rescaled_camera,
)
from polmvs.errors import MAX_QUOTED, DataError, as_data_error
from polmvs.geometry import RigidTransform, nearest_rotation
from polmvs.io.folders import new_folder, require_unicode
from polmvs.io.plain_files import open_plain, require_plain
from polmvs.scene import MAX_COORDINATE, SparseModel, Tracks, View, match_names, short_list

PathArg = str | PathLike[str]

logger = logging.getLogger(__name__)

MAX_PARAM = 1e9  # of a camera's parameters; a guess as well
MODEL_FILES = ("cameras", "images", "points3D")  # rigs and frames came with COLMAP 3.12


def read_model(path: PathArg) -> SparseModel:
    """Read a COLMAP model, binary or text, of three or of five files.

    Parameters
    ----------
    path : the model's folder or a parent, see :func:`find_model`.

    Raises
    ------
    DataError
        The model is missing, damaged or without a registered image.
    """
    folder = find_model(path)
    with _as_data_error(folder):
        reconstruction = _open(folder)
        keypoints = None
        if _model_suffix(folder) == ".bin":
            keypoints = _stored_keypoints(folder / "images.bin")
        sparse_model = model_from_reconstruction(reconstruction, stored=keypoints)
    _require_sound(folder, sparse_model.views, sparse_model.tracks)
    return sparse_model


def read_views(path: PathArg) -> tuple[View, ...]:
    """The views of a COLMAP model, sorted by name, without its points.

    Raises
    ------
    DataError
        As :func:`read_model`.
    """
    folder = find_model(path)
    with _as_data_error(folder):
        reconstruction = _open(folder)
        views = _views(reconstruction, registered(reconstruction))
    _require_sound(folder, views)
    return views


def _require_sound(folder: Path, views: Sequence[View], tracks: Tracks | None = None) -> None:
    """Refuse a model without views or with implausible numbers."""
    if not views:
        raise DataError(
            folder, "has no registered image. Run COLMAP again or leave out `sfm.sparse`."
        )
    if (reason := _unsound(views, tracks)) is not None:
        raise DataError(folder, f"is no sound COLMAP model ({reason}). Export it again.")


def _unsound(views: Iterable[View], tracks: Tracks | None) -> str | None:
    """The reason why the numbers of a model are implausible; None if they are plausible."""
    for view in views:
        camera, pose = view.camera, view.cam_from_world
        sides = (camera.width, camera.height)
        if not (min(sides) > 0 and max(sides) <= MAX_SIDE):
            return f"the camera of {view.name} is {sides[0]}x{sides[1]} px"
        params = camera_to_colmap(camera).params
        if not (np.abs(params) <= MAX_PARAM).all() or not camera.mean_focal_px > 0:
            return f"the camera of {view.name} is none"
        if nearest_rotation(pose.rotation) is None:
            return f"the pose of {view.name} is none"
        if not (np.abs(pose.translation) <= MAX_COORDINATE).all():
            return f"the place of {view.name} is not finite or absurd"
    if tracks is not None and not (np.abs(tracks.points_in_world) <= MAX_COORDINATE).all():
        return "a point is not finite or absurd"
    if tracks is not None and not (np.abs(tracks.obs_xy) <= MAX_SIDE).all():
        return "a keypoint is not finite or far from its image"
    return None


def read_reconstruction(path: PathArg) -> pycolmap.Reconstruction:
    """Read a COLMAP model as pycolmap's type, for users of pycolmap.

    Raises
    ------
    DataError
        The model is missing or damaged.
    """
    folder = find_model(path)
    with _as_data_error(folder):
        return _open(folder)


def _open(folder: Path) -> pycolmap.Reconstruction:
    for path in folder.iterdir():
        if path.stem in (*MODEL_FILES, "rigs", "frames"):
            with as_data_error(path, "read"):
                require_plain(path)
    if _model_suffix(folder) == ".bin":
        check_binary_model(folder)
    with quiet_colmap():
        return pycolmap.Reconstruction(str(folder))


@contextmanager
def _as_data_error(folder: Path) -> Iterator[None]:
    """Turn pycolmap's errors about a damaged model into one line."""
    try:
        yield
    except (ValueError, IndexError, KeyError, RuntimeError, MemoryError, OverflowError) as error:
        # COLMAP's own words, shortened and without the place in its source.
        reason = re.sub(r"\[[\w.]+:\d+\]", "", " ".join(str(error).split()))[:MAX_QUOTED].strip()
        raise DataError(
            folder, f"is no sound COLMAP model ({reason or 'no reason given'}). Export it again."
        ) from error


def find_model(path: PathArg) -> Path:
    """Folder of a COLMAP model: the given one, or its ``0``, ``sparse`` or ``sparse/0``.

    Raises
    ------
    DataError
        There is no such folder, or no complete model in it.
    """
    root = Path(path)
    require_unicode(root)
    if not root.is_dir():
        raise DataError(root, "is no folder." if root.exists() else "no such folder.")
    for folder in (root, root / "0", root / "sparse", root / "sparse" / "0"):
        if _model_suffix(folder) is not None:
            if folder.name == "0" and (folder.parent / "1").is_dir():
                logger.warning("%s: holds several models; 0 is used.", folder.parent)
            return folder
    raise DataError(
        root,
        "holds no COLMAP model. Its cameras, images and points3D files (.bin or .txt) are "
        "expected in it, in 0/, in sparse/ or in sparse/0/.",
    )


def _model_suffix(folder: Path) -> str | None:
    """``.bin`` or ``.txt``, the format that is complete in the folder."""
    for suffix in (".bin", ".txt"):
        if all((folder / f"{name}{suffix}").is_file() for name in MODEL_FILES):
            return suffix
    return None


def model_from_reconstruction(
    reconstruction: pycolmap.Reconstruction,
    names: Iterable[str] = (),
    *,
    stored: Mapping[int, NDArray[np.void]] | None = None,
) -> SparseModel:
    """The registered part of a reconstruction.

    Parameters
    ----------
    reconstruction : with any rigs and camera models.
    names : of all images of the capture, in addition to the reconstruction's own.
    stored : keypoints with a point by image id, if its binary file was already read.
    """
    images = registered(reconstruction)
    views = _views(reconstruction, images)
    known = {str(image.name) for image in reconstruction.images.values()} | set(names)
    return SparseModel(
        views=views,
        tracks=_tracks(reconstruction, images, stored),
        unregistered=tuple(sorted(known - {view.name for view in views})),
    )


def registered(reconstruction: pycolmap.Reconstruction) -> list[pycolmap.Image]:
    """Images with a pose, sorted by name."""
    images = [reconstruction.image(i) for i in reconstruction.reg_image_ids()]
    return sorted(images, key=lambda image: str(image.name))


def _views(
    reconstruction: pycolmap.Reconstruction, images: Iterable[pycolmap.Image]
) -> tuple[View, ...]:
    """The posed images as views, in their order."""
    cameras = {i: camera_from_colmap(c) for i, c in reconstruction.cameras.items()}
    return tuple(
        View(
            name=str(image.name),
            camera=cameras[image.camera_id],
            cam_from_world=_rigid_transform(image.cam_from_world()),
        )
        for image in images
    )


def _rigid_transform(transform: pycolmap.Rigid3d) -> RigidTransform:
    matrix = np.array(transform.matrix(), np.float64)
    return RigidTransform(matrix[:, :3].copy(), matrix[:, 3].copy())


def _tracks(
    reconstruction: pycolmap.Reconstruction,
    images: Sequence[pycolmap.Image],
    stored: Mapping[int, NDArray[np.void]] | None = None,
) -> Tracks:
    """Sparse points by id, and their observations in ``images``, view by view.

    Parameters
    ----------
    stored : keypoints of each image that have a point, with rows of ``KEYPOINT``; None: they are
        taken from pycolmap, which hands them over one by one, 1 to 3 microseconds each.
    """
    points = sorted(reconstruction.points3D.items())
    ids = np.array([i for i, _ in points], np.int64)
    seen = [_keypoints(i) if stored is None else stored[i.image_id] for i in images]
    joined = np.concatenate([np.zeros(0, KEYPOINT), *seen])
    obs_ids = joined["point3D_id"].astype(np.int64)
    if not np.isin(obs_ids, ids).all():
        raise ValueError("keypoints observe points that are missing")
    return Tracks(
        point3D_ids=ids,
        points_in_world=np.array([p.xyz for _, p in points], np.float64).reshape(-1, 3),
        colors=np.array([p.color for _, p in points], np.uint8).reshape(-1, 3),
        errors=np.array([p.error for _, p in points], np.float64),
        obs_track=np.searchsorted(ids, obs_ids),
        obs_view=np.repeat(np.arange(len(seen)), [len(view) for view in seen]),
        obs_xy=joined["xy"].astype(np.float64),
    )


def _keypoints(image: pycolmap.Image) -> NDArray[np.void]:
    """Keypoints of an image that have a point."""
    seen = image.get_observation_points2D()
    return np.array([(point.xy, point.point3D_id) for point in seen], KEYPOINT)


def _stored_keypoints(path: Path) -> dict[int, NDArray[np.void]]:
    """Keypoints that have a point of each image by its id, of a file that was checked."""
    keypoints = {}
    with _mapped(path) as data:
        position = COUNT.size
        for _ in range(COUNT.unpack_from(data)[0]):
            image_id, start, num_points = _image_keypoints(data, position)
            stored = np.frombuffer(data, KEYPOINT, num_points, start)
            keypoints[image_id] = stored[stored["point3D_id"] != NO_POINT].copy()
            del stored  # or the file could not be closed
            position = start + num_points * KEYPOINT.itemsize
    return keypoints


def match_model_to_capture(
    sparse_model: SparseModel,
    names: Sequence[str],
    width: int,
    height: int,
    *,
    source: PathArg = "sparse model",
) -> SparseModel:
    """Fit a model to a capture: its names, and the size of its polarization images.

    Images are matched by name, else by name without folder and suffix if that is unambiguous.
    Views that the capture lacks are dropped, and tracks without a remaining view. Cameras of
    another size with the same aspect ratio are rescaled together with their observations; those of
    the raw mosaic, which has exactly twice the size, get ``K / 2``.

    Parameters
    ----------
    sparse_model : as read.
    names : of the capture's images.
    width, height : of the polarization images, px.
    source : origin of the model, for messages.

    Returns
    -------
    SparseModel
        Views have the capture's names; ``unregistered`` are the capture's images without a pose.

    Raises
    ------
    DataError
        No image matches, or a camera has another aspect ratio.
    """
    model_names = [view.name for view in sparse_model.views]
    matched = require_matches(model_names, names, source)
    kept = [i for i, name in enumerate(model_names) if name in matched]
    if dropped := [name for name in model_names if name not in matched]:
        logger.warning(
            "%s: %d views are not in the capture and are left out: %s.",
            source,
            len(dropped),
            short_list(dropped),
        )
    kept.sort(key=lambda i: matched[model_names[i]])
    views = []
    scales = np.ones((len(sparse_model.views), 2))
    for i in kept:
        camera = sparse_model.views[i].camera
        fitted = _fit_camera(camera, width, height, source)
        scales[i] = fitted.width / camera.width, fitted.height / camera.height
        views.append(replace(sparse_model.views[i], name=matched[model_names[i]], camera=fitted))
    if (scales != 1).any():
        logger.info("%s: cameras are rescaled to %dx%d px.", source, width, height)
    registered = {view.name for view in views}
    return SparseModel(
        views=tuple(views),
        tracks=_select_tracks(sparse_model.tracks, kept, scales),
        unregistered=tuple(sorted(set(names) - registered)),
    )


def require_matches(
    model_names: Sequence[str], names: Sequence[str], source: PathArg
) -> dict[str, str]:
    """The capture's name of each of the model's images that has one; see :func:`match_names`.

    Raises
    ------
    DataError
        No image has one.
    """
    matched = match_names(model_names, names)
    if not matched:
        raise DataError(
            source,
            f"its images are named like {model_names[0]!r} but the capture's like "
            f"{min(names)!r}; none match. Give the model of this capture.",
        )
    if any(name != other for name, other in matched.items()):
        logger.warning("%s: images are matched by name without folder and suffix.", source)
    return matched


def _fit_camera(camera: Camera, width: int, height: int, source: PathArg) -> Camera:
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
    return rescaled_camera(camera, width, height)


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


def write_model(sparse_model: SparseModel, folder: str | PathLike[str]) -> None:
    """Write a model as COLMAP binary, whole or not at all; an existing folder is replaced.

    Keypoints without a track and images without a pose are not part of a :class:`SparseModel`
    and are not written. Each view becomes an image with its own frame.
    """
    write_reconstruction(_reconstruction(sparse_model), folder)


def write_reconstruction(reconstruction: pycolmap.Reconstruction, folder: PathArg) -> None:
    """Write a reconstruction as COLMAP binary, whole or not at all."""
    with new_folder(folder, overwrite=True) as root:
        reconstruction.write_binary(str(root))


def reconstruction_of_views(
    views: Sequence[View], *, single_camera: bool = False
) -> pycolmap.Reconstruction:
    """Posed views without points; ids of images and cameras count from 1 in their order.

    Parameters
    ----------
    single_camera : all views share the camera of the first; else each has its own.
    """
    camera_ids = [1] * len(views) if single_camera else range(1, len(views) + 1)
    return _posed(views, camera_ids, [np.zeros((0, 2))] * len(views))


def _posed(
    views: Sequence[View], camera_ids: Sequence[int], keypoints: Sequence[Array]
) -> pycolmap.Reconstruction:
    """Posed images with keypoints; views with one camera id share the first one's camera."""
    reconstruction = pycolmap.Reconstruction()
    of_views = zip(views, camera_ids, keypoints, strict=True)
    for image_id, (view, camera_id, points) in enumerate(of_views, start=1):
        if not reconstruction.exists_camera(camera_id):
            camera = camera_to_colmap(view.camera)
            camera.camera_id = camera_id
            reconstruction.add_camera_with_trivial_rig(camera)
        image = pycolmap.Image(
            name=view.name, keypoints=points, camera_id=camera_id, image_id=image_id
        )
        pose = np.column_stack([view.cam_from_world.rotation, view.cam_from_world.translation])
        reconstruction.add_image_with_trivial_frame(image, pycolmap.Rigid3d(pose))
    return reconstruction


def _reconstruction(sparse_model: SparseModel) -> pycolmap.Reconstruction:
    """The model in pycolmap's types; ids of points are kept."""
    views, tracks = sparse_model.views, sparse_model.tracks
    observations = tracks.of_views(len(views))
    cameras = list(dict.fromkeys(view.camera for view in views))
    camera_ids = [cameras.index(view.camera) + 1 for view in views]
    reconstruction = _posed(views, camera_ids, [tracks.obs_xy[own] for own in observations])
    # Index of an observation among those of its image.
    point2D_idx = np.empty(len(tracks.obs_view), np.int64)
    for own in observations:
        point2D_idx[own] = np.arange(len(own))
    for index, (point3D_id, own) in enumerate(
        zip(tracks.point3D_ids, tracks.of_tracks(), strict=True)
    ):
        track = pycolmap.Track()
        # Plain numbers, handed over one by one, take two thirds of the time of a list of elements.
        image_ids, indices = (tracks.obs_view[own] + 1).tolist(), point2D_idx[own].tolist()
        for image_id, point2D_index in zip(image_ids, indices, strict=True):
            track.add_element(image_id, point2D_index)
        point = pycolmap.Point3D(
            xyz=tracks.points_in_world[index],
            color=tracks.colors[index],
            error=float(tracks.errors[index]),
            track=track,
        )
        reconstruction.add_point3D_with_id(int(point3D_id), point)
    return reconstruction


# Records of the binary files, from COLMAP's reconstruction_io_binary.cc. A pose is a quaternion and
# a translation.
COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
RIG = struct.Struct("<II")  # id, number of sensors; then the sensors, all but the first with poses
SENSOR = struct.Struct("<ii")  # type, id
HAS_POSE = struct.Struct("<B")
POSE = struct.Struct("<7d")
FRAME = struct.Struct("<II7dI")  # id, rig, pose, number of data; then the data
DATUM = struct.Struct("<iiQ")  # sensor, id
IMAGE = struct.Struct("<I7dI")  # id, pose, camera; then the name, and the keypoints
KEYPOINT = np.dtype([("xy", "<f8", 2), ("point3D_id", "<u8")])
NO_POINT = np.uint64(2**64 - 1)
POINT = struct.Struct("<Q3d3Bd")  # id, place, colour, error; then the track
TRACK_ELEMENT = struct.Struct("<II")  # image, keypoint

Reader = Callable[[mmap.mmap, int], int]


def check_binary_model(folder: Path) -> None:
    """Refuse a binary model of which a file is truncated or has another format.

    Missing files are ignored.

    Raises
    ------
    DataError
        A file is damaged; the message names it.
    """
    readers: dict[str, Reader] = {
        "cameras": _camera_end,
        "rigs": _rig_end,
        "frames": _frame_end,
        "images": _image_end,
        "points3D": _point_end,
    }
    for name, reader in readers.items():
        path = folder / f"{name}.bin"
        if path.is_file():
            _check_file(path, reader)


def _check_file(path: Path, record_end: Reader) -> None:
    """Whether the announced records fill the file."""
    try:
        with as_data_error(path, "read"), _mapped(path) as data:
            position = COUNT.size
            for _ in range(COUNT.unpack_from(data)[0]):
                position = record_end(data, position)
            complete = position == len(data)
    # An empty file, a record past the end, no such model, a length that no file has.
    except (ValueError, OverflowError, IndexError, struct.error):
        complete = False
    if not complete:
        raise DataError(path, "is truncated or no file of COLMAP's. Export the model again.")


@contextmanager
def _mapped(path: Path) -> Iterator[mmap.mmap]:
    """The bytes of a file."""
    with (
        open_plain(path) as file,
        mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
    ):
        yield data


def _camera_end(data: mmap.mmap, start: int) -> int:
    _, model_id, _, _ = CAMERA.unpack_from(data, start)
    # ValueError where pycolmap does not know the model.
    camera_model = pycolmap.CameraModelId(model_id)
    params = pycolmap.Camera.create_from_model_id(1, camera_model, 1.0, 1, 1).params
    return start + CAMERA.size + params.nbytes


def _rig_end(data: mmap.mmap, start: int) -> int:
    _, num_sensors = RIG.unpack_from(data, start)
    end = start + RIG.size + (SENSOR.size if num_sensors else 0)
    for _ in range(num_sensors - 1):
        (has_pose,) = HAS_POSE.unpack_from(data, end + SENSOR.size)
        end += SENSOR.size + HAS_POSE.size + (POSE.size if has_pose else 0)
    return end


def _frame_end(data: mmap.mmap, start: int) -> int:
    num_data = FRAME.unpack_from(data, start)[-1]
    return int(start + FRAME.size + num_data * DATUM.size)


def _image_end(data: mmap.mmap, start: int) -> int:
    _, first, num_points = _image_keypoints(data, start)
    return int(first + num_points * KEYPOINT.itemsize)


def _image_keypoints(data: mmap.mmap, start: int) -> tuple[int, int, int]:
    """Id of an image, where its keypoints begin, and how many there are."""
    image_id = IMAGE.unpack_from(data, start)[0]
    name_end = data.find(b"\0", start + IMAGE.size)
    if name_end < 0:
        raise ValueError("name without end")
    (num_points,) = COUNT.unpack_from(data, name_end + 1)
    return image_id, name_end + 1 + COUNT.size, num_points


def _point_end(data: mmap.mmap, start: int) -> int:
    (length,) = COUNT.unpack_from(data, start + POINT.size)
    return int(start + POINT.size + COUNT.size + length * TRACK_ELEMENT.size)
