"""Cameras from calibration files: OpenCV's, ROS's, Kalibr's, COLMAP's lines, in COLMAP's models.

The pixel origin of OpenCV, ROS and Kalibr is the centre of the first pixel, that of COLMAP the
corner of the image, so half a pixel is added to their principal points. A camera of the full mosaic
is scaled to the polarization images exactly, since scaling is multiplication in COLMAP's
convention.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from polmvs.camera import PinholeCamera, xy_from_opencv
from polmvs.errors import MAX_QUOTED, DataError, as_data_error
from polmvs.io.images import write_bytes
from polmvs.io.plain_files import read_text
from polmvs.io.typed_json import parse_json

# Parameters that scale with the image come first; all others are distortion.
COLMAP_MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fx", "fy", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4"),
    "FULL_OPENCV": ("fx", "fy", "cx", "cy", "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
    "FOV": ("fx", "fy", "cx", "cy", "omega"),
}
LENGTHS = frozenset({"f", "fx", "fy", "cx", "cy"})
MAX_ASPECT_CHANGE = 0.01  # of the image's sides, above which a file is of another crop (rounding)
MAX_BYTES = 1 << 20
MAX_DEPTH = 4  # of lists in a matrix
_MATRIX_KEYS = ("camera_matrix", "cameraMatrix", "K", "intrinsic_matrix", "Camera_Matrix", "mtx")
_DISTORTION_KEYS = (
    "distortion_coefficients", "dist_coeffs", "distCoeffs", "distortion_coeffs", "D", "dist",
    "Distortion_Coefficients",
)  # fmt: skip
_WIDTH_KEYS = ("image_width", "image_Width", "width", "imageWidth")
_HEIGHT_KEYS = ("image_height", "image_Height", "height", "imageHeight")


@dataclass(frozen=True, kw_only=True)
class Intrinsics:
    """A camera in one of COLMAP's models, in COLMAP's pixel convention.

    Attributes
    ----------
    model : a key of ``COLMAP_MODELS``.
    width, height : of its images, px.
    params : in the order of ``COLMAP_MODELS[model]``.
    """

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    def scaled_to(self, width: int, height: int) -> Intrinsics:
        """The camera of the same images at another size.

        Raises
        ------
        ValueError
            The aspect ratios differ, as after a crop.
        """
        scale = width / self.width
        if abs(height / self.height / scale - 1) > MAX_ASPECT_CHANGE:
            raise ValueError(
                f"it is of {self.width}x{self.height} px images, which {width}x{height} px are not "
                "a scaled size of"
            )
        names = COLMAP_MODELS[self.model]
        params = tuple(
            value * scale if name in LENGTHS else value
            for name, value in zip(names, self.params, strict=True)
        )
        return Intrinsics(model=self.model, width=width, height=height, params=params)

    @property
    def pinhole(self) -> PinholeCamera:
        """The camera without distortion."""
        named = dict(zip(COLMAP_MODELS[self.model], self.params, strict=True))
        focal = named.get("f", 0.0)
        return PinholeCamera(
            width=self.width,
            height=self.height,
            fx=named.get("fx", focal),
            fy=named.get("fy", focal),
            cx=named["cx"],
            cy=named["cy"],
        )

    @property
    def line(self) -> str:
        """The camera as a line of COLMAP's ``cameras.txt``."""
        numbers = " ".join(repr(float(value)) for value in self.params)
        return f"1 {self.model} {self.width} {self.height} {numbers}"


def read_intrinsics(path: Path) -> Intrinsics:
    """Read a camera from a calibration file; its format is recognized from its content.

    OpenCV (YAML or JSON with ``camera_matrix`` and ``distortion_coefficients``), ROS
    ``camera_info``, Kalibr's camchain (its first camera), a line or a ``cameras.txt`` of COLMAP
    (one camera), or :func:`write_intrinsics`'s.

    Raises
    ------
    DataError
        The file is missing or of another kind, or COLMAP does not have its camera model.
    """
    try:
        with as_data_error(path, "read"):
            if path.stat().st_size > MAX_BYTES:
                raise DataError(path, "is too large for a calibration file.")
            text = read_text(path)
    except ValueError as error:
        raise DataError(
            path, "is no text file; give YAML, JSON or a COLMAP camera line."
        ) from error
    if any(name in text.split() for name in COLMAP_MODELS):
        return _from_colmap(path, text)
    content = _parse(path, text)
    if not isinstance(content, Mapping):
        raise DataError(path, "holds no camera: no OpenCV, ROS, Kalibr or COLMAP calibration.")
    cameras = [v for key, v in content.items() if isinstance(key, str) and key.startswith("cam")]
    kalibr = [c for c in cameras if isinstance(c, Mapping) and "intrinsics" in c]
    if kalibr:
        return _from_kalibr(path, kalibr[0])
    return _from_opencv(path, content)


def write_intrinsics(path: Path, intrinsics: Intrinsics, comment: str = "") -> None:
    """Write a camera as a ``cameras.txt`` of COLMAP, whole or not at all.

    Raises
    ------
    DataError
        The system refuses.
    """
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    lines += [f"# {line}" for line in comment.splitlines()]
    write_bytes(path, ("\n".join([*lines, intrinsics.line]) + "\n").encode())


def from_opencv_matrix(
    matrix: Any, distortion: Any, width: int, height: int, *, fisheye: bool = False
) -> Intrinsics:
    """COLMAP's camera of OpenCV's matrix and distortion coefficients.

    Parameters
    ----------
    matrix : (3, 3) nested sequences, OpenCV's pixel origin.
    distortion : (N,), ``k1, k2, p1, p2, k3, k4, k5, k6`` without zeros at the end; for a fisheye
        lens ``k1 .. k4``.

    Raises
    ------
    ValueError
        COLMAP does not have the camera model.
    """
    fx, fy = float(matrix[0][0]), float(matrix[1][1])
    if abs(float(matrix[0][1])) > 1e-9 * abs(fx):
        raise ValueError("its axes are skewed, which COLMAP's cameras are not")
    center = xy_from_opencv(np.array([float(matrix[0][2]), float(matrix[1][2])]))
    lengths = (fx, fy, float(center[0]), float(center[1]))
    k = [float(value) for value in distortion]
    if fisheye:
        return _camera("OPENCV_FISHEYE", width, height, (*lengths, *(k + [0.0] * 4)[:4]))
    while k and k[-1] == 0:
        k.pop()
    if len(k) > 8:
        raise ValueError(f"its {len(k)} distortion coefficients are more than COLMAP's 8")
    if not k:
        return _camera("PINHOLE", width, height, lengths)
    k += [0.0] * (8 - len(k))
    model = "OPENCV" if not any(k[4:]) else "FULL_OPENCV"
    return _camera(model, width, height, (*lengths, *k[: len(COLMAP_MODELS[model]) - 4]))


def _camera(model: str, width: int, height: int, params: tuple[float, ...]) -> Intrinsics:
    """A checked camera.

    Raises
    ------
    ValueError
        Its numbers are no camera's.
    """
    names = COLMAP_MODELS[model]
    if len(params) != len(names):
        raise ValueError(f"{model} has {len(names)} parameters, not {len(params)}")
    if not all(map(math.isfinite, params)) or not 0 < width < 1 << 16 or not 0 < height < 1 << 16:
        raise ValueError("its numbers are not finite, or its size is none")
    values = dict(zip(names, params, strict=True))
    if min(values[name] for name in ("f", "fx", "fy") if name in values) <= 0:
        raise ValueError("its focal lengths must be positive")
    if not (0 <= values["cx"] <= width and 0 <= values["cy"] <= height):
        raise ValueError(
            f"its principal point {values['cx']:g},{values['cy']:g} lies outside of "
            f"{width}x{height} px"
        )
    return Intrinsics(model=model, width=width, height=height, params=params)


def _parse(path: Path, text: str) -> Any:
    """JSON, YAML, or OpenCV's dialect of YAML."""
    try:
        if text.lstrip().startswith(("{", "[")):
            return parse_json(text)
        if text.startswith("%YAML"):
            text = text.partition("\n")[2]
        return yaml.safe_load(text.replace("!!opencv-matrix", ""))
    except (ValueError, RecursionError, yaml.YAMLError) as error:
        raise DataError(path, "is neither JSON nor YAML, nor a COLMAP camera line.") from error


def _from_colmap(path: Path, text: str) -> Intrinsics:
    """The only camera of COLMAP's lines, with or without its number."""
    lines = [line.split() for line in text.splitlines() if line.strip() and line.strip()[0] != "#"]
    if len(lines) != 1:
        raise DataError(path, f"has {len(lines)} camera lines; one camera of all images is read.")
    words = lines[0]
    start = 0 if words[0] in COLMAP_MODELS else 1
    try:
        model, width, height = words[start], int(words[start + 1]), int(words[start + 2])
        params = tuple(float(word) for word in words[start + 3 :])
        return _camera(model, width, height, params)
    except (ValueError, IndexError, KeyError) as error:
        raise DataError(path, f"is no camera line of COLMAP: {error}.") from error


def _from_kalibr(path: Path, camera: Mapping[str, Any]) -> Intrinsics:
    """The first camera of a camchain."""
    model, lens = _word(camera, "camera_model"), _word(camera, "distortion_model") or "none"
    try:
        if model != "pinhole":
            raise ValueError(f"its camera model {model!r} is none of COLMAP's")
        fx, fy, cx, cy = (float(value) for value in camera["intrinsics"])
        width, height = (int(value) for value in camera["resolution"])
        k = [float(value) for value in camera.get("distortion_coeffs", [])]
        matrix = [[fx, 0, cx], [0, fy, cy], [0, 0, 1]]
        if lens == "fov":
            plain = from_opencv_matrix(matrix, [], width, height)
            return _camera("FOV", width, height, (*plain.params, k[0]))
        if lens not in ("radtan", "equidistant", "none"):
            raise ValueError(f"its distortion model {lens!r} is none of COLMAP's")
        return from_opencv_matrix(matrix, k, width, height, fisheye=lens == "equidistant")
    except (ValueError, TypeError, KeyError, IndexError, OverflowError) as error:
        raise DataError(path, f"its Kalibr camera cannot be used: {error}.") from error


def _from_opencv(path: Path, content: Mapping[str, Any]) -> Intrinsics:
    """A camera of OpenCV or ROS."""
    try:
        matrix = _numbers(_first(content, _MATRIX_KEYS))
        if len(matrix) != 9:
            raise ValueError("its camera matrix needs 9 numbers")
        distortion: Any = []
        if any(key in content for key in _DISTORTION_KEYS):
            distortion = _numbers(_first(content, _DISTORTION_KEYS))
        size = content.get("image_size", content.get("img_size"))
        if isinstance(size, list) and len(size) == 2:
            width, height = int(size[0]), int(size[1])
        else:
            width, height = int(_first(content, _WIDTH_KEYS)), int(_first(content, _HEIGHT_KEYS))
        lens = _word(content, "distortion_model") or _word(content, "camera_model")
        rows = [matrix[:3], matrix[3:6], matrix[6:]]
        fisheye = lens in ("equidistant", "fisheye")
        return from_opencv_matrix(rows, distortion, width, height, fisheye=fisheye)
    except (ValueError, TypeError, KeyError, IndexError, OverflowError) as error:
        reason = f"lacks {error}" if isinstance(error, KeyError) else str(error)
        raise DataError(path, f"holds no camera that can be used: {reason}.") from error


def _word(content: Mapping[str, Any], key: str) -> str:
    """A text; nothing else is shown, as YAML's aliases can make little text of any length."""
    value = content.get(key)
    return value[:MAX_QUOTED] if isinstance(value, str) else ""


def _first(content: Mapping[str, Any], keys: tuple[str, ...]) -> Any:
    for key in keys:
        if key in content:
            return content[key]
    raise KeyError(keys[0])


def _numbers(value: Any, depth: int = 0) -> list[float]:
    """Numbers of a matrix: nested lists, or a mapping with ``data``."""
    if isinstance(value, Mapping):
        value = value["data"]
    if depth > MAX_DEPTH:  # YAML's may hold themselves
        raise ValueError("its matrix is nested too deeply")
    flat: list[float] = []
    for item in value:
        flat.extend(_numbers(item, depth + 1) if isinstance(item, list) else [float(item)])
        if len(flat) > 64:
            raise ValueError("its matrix has too many numbers")
    return flat
