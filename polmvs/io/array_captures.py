"""Frames in memory, written as the files of a capture."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import ArrayLike, NDArray

from polmvs.config import CaptureKind
from polmvs.errors import OptionError
from polmvs.io.arrays import save_array
from polmvs.scene import stem_of

# A raw mosaic (H, W); Stokes images (3, H, W) or (H, W, 3) in floats; or an image for each
# polarizer angle, by the angle in degrees.
Frame: TypeAlias = ArrayLike | Mapping[float, ArrayLike]
Frames: TypeAlias = Mapping[str, Frame] | Sequence[Frame]


def are_frames(value: Any) -> bool:
    """Whether a value is a collection of frames, by name or in order."""
    if isinstance(value, Mapping):
        return bool(value) and all(isinstance(key, str) for key in value)
    return isinstance(value, Sequence) and not isinstance(value, str | bytes)


def write_frames(frames: Frames, folder: Path) -> CaptureKind:
    """Write frames losslessly into an existing folder, as a capture.

    Parameters
    ----------
    frames : by name, or in order: ``000``, ``001`` and so on.

    Returns
    -------
    The kind of the files; all frames must be of one kind.

    Raises
    ------
    OptionError
        A frame, its name or its angles are invalid, or two frames differ in kind.
    """
    named = frames
    if not isinstance(named, Mapping):
        digits = max(3, len(str(len(named))))
        named = {f"{number:0{digits}d}": frame for number, frame in enumerate(named)}
    kinds = {name: _write_frame(folder, name, frame) for name, frame in named.items()}
    first = next(iter(kinds.values()), None)
    if first is None:
        raise OptionError("no frames are given.")
    for name, kind in kinds.items():
        if kind is not first:
            raise OptionError(f"frame {name!r} holds {kind} images, the first one {first}.")
    return first


def _write_frame(folder: Path, name: str, frame: Frame) -> CaptureKind:
    stem = stem_of(name) if "." in name else name
    if not stem or Path(stem).name != stem:
        raise OptionError(f"{name!r} is no name of a frame: it becomes a file's.")
    if isinstance(frame, Mapping):
        for angle, image in frame.items():
            save_array(folder / f"{stem}_{float(angle):03g}.npy", _numbers(name, image))
        return CaptureKind.ANGLES
    array = _numbers(name, frame)
    if array.ndim == 2:
        save_array(folder / f"{stem}.npy", array)
        return CaptureKind.MOSAIC
    if array.ndim == 3 and 3 in (array.shape[0], array.shape[2]) and array.dtype.kind == "f":
        save_array(folder / f"{stem}.npy", array)
        return CaptureKind.STOKES
    raise OptionError(
        f"frame {name!r} is {array.dtype} {array.shape}; a raw mosaic (H, W), Stokes images "
        "(3, H, W) in floats, or a dictionary of images by polarizer angle is expected."
    )


def _numbers(name: str, image: ArrayLike) -> NDArray[Any]:
    array = np.asarray(image)
    if array.dtype.kind not in "uif" or array.ndim not in (2, 3) or not array.size:
        raise OptionError(f"frame {name!r} is {array.dtype} {array.shape}, no image.")
    return np.ascontiguousarray(array)
