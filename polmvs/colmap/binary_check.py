"""Walk through COLMAP's binary files, which say nowhere that they are complete.

pycolmap 4.2 reads a file that ends early without a word: it repeats the last record, or runs
forever where that one is a point. Records that must follow each other to the file's last byte
are a cheap and sharp test: half a second for a million points.
"""

from __future__ import annotations

import mmap
import struct
from collections.abc import Callable
from pathlib import Path

from polmvs.errors import DataError

COUNT = struct.Struct("<Q")
CAMERA = struct.Struct("<IiQQ")  # id, model, width, height; then the parameters
RIG = struct.Struct("<II")  # id, number of sensors
SENSOR_BYTES = 8  # type, id
POSE_BYTES = 56  # quaternion, translation
FRAME_BYTES = 8 + POSE_BYTES  # id, rig, pose; then the number of data
DATUM_BYTES = 16  # sensor, id
IMAGE_HEAD_BYTES = 4 + POSE_BYTES + 4  # id, pose, camera; then the name
KEYPOINT_BYTES = 24
POINT_HEAD_BYTES = 8 + 24 + 3 + 8  # id, place, colour, error; then the length of the track
TRACK_ELEMENT_BYTES = 8
INT = struct.Struct("<I")

Reader = Callable[[mmap.mmap, int], int]


def check_binary_model(folder: Path, num_params: Callable[[int], int]) -> None:
    """Refuse a binary model of which a file is truncated or has another format.

    Parameters
    ----------
    folder : of the model; files that it lacks are passed over.
    num_params : number of parameters of the camera model with this id; ValueError for none.

    Raises
    ------
    DataError
        Names the file at fault.
    """

    def camera_end(data: mmap.mmap, start: int) -> int:
        _, model, _, _ = CAMERA.unpack_from(data, start)
        return start + CAMERA.size + 8 * num_params(model)

    readers: dict[str, Reader] = {
        "cameras": camera_end,
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
        with (
            path.open("rb") as file,
            mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data,
        ):
            position = COUNT.size
            for _ in range(COUNT.unpack_from(data)[0]):
                position = record_end(data, position)
            complete = position == len(data)
    except OSError as error:
        raise DataError(path, f"cannot be read: {error.strerror or error}.") from error
    except (ValueError, struct.error):  # an empty file, a record past the end, no such model
        complete = False
    if not complete:
        raise DataError(path, "is truncated or no file of COLMAP's. Export the model again.")


def _rig_end(data: mmap.mmap, start: int) -> int:
    _, num_sensors = RIG.unpack_from(data, start)
    end = start + RIG.size + (SENSOR_BYTES if num_sensors else 0)
    for _ in range(num_sensors - 1):
        (has_pose,) = struct.unpack_from("<B", data, end + SENSOR_BYTES)
        end += SENSOR_BYTES + 1 + (POSE_BYTES if has_pose else 0)
    return end


def _frame_end(data: mmap.mmap, start: int) -> int:
    (num_data,) = INT.unpack_from(data, start + FRAME_BYTES)
    return int(start + FRAME_BYTES + INT.size + num_data * DATUM_BYTES)


def _image_end(data: mmap.mmap, start: int) -> int:
    name_end = data.find(b"\0", start + IMAGE_HEAD_BYTES)
    if name_end < 0:
        raise ValueError("name without end")
    (num_points,) = COUNT.unpack_from(data, name_end + 1)
    return int(name_end + 1 + COUNT.size + num_points * KEYPOINT_BYTES)


def _point_end(data: mmap.mmap, start: int) -> int:
    (length,) = COUNT.unpack_from(data, start + POINT_HEAD_BYTES)
    return int(start + POINT_HEAD_BYTES + COUNT.size + length * TRACK_ELEMENT_BYTES)
