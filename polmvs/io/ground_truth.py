"""Reader of rendered ground truth: cameras, depth, normals and masks of a capture.

The layout is that of ``gt/`` in the bundled capture: ``cameras.json`` with ``width``, ``height``
and, for each image, ``K`` of the half-size polarization image (COLMAP's pixel convention) and
``cam_from_world`` (3x4, metres); beside it ``STEM_depth.png`` (uint16 in 20 um, or in the
``depth_unit_m`` of ``cameras.json``; 0 = nothing),
``STEM_normal.png`` (16-bit RGB, camera frame, ``n = value / 32767.5 - 1``) and ``STEM_mask.png``
(not 0 on the part). Of images with distortion the maps are of the same pixels, ``K`` is the camera
without its distortion, and ``plane_xy.npy``, (H, W, 2), has ``(x / z, y / z)`` of the rays through
the pixels' centres.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from polmvs.arrays import Array, Mask
from polmvs.camera import MAX_SIDE, PinholeCamera, pixel_centers
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform, nearest_rotation, unit
from polmvs.io.image_size import PNG_SIGNATURE
from polmvs.io.images import decode_image, read_bytes, write_mask, write_png
from polmvs.io.plain_files import read_text
from polmvs.io.raw_formats import read_npy
from polmvs.io.typed_json import parse_json, write_json
from polmvs.neighbors import in_cells_beside, voxel_representatives
from polmvs.scene import View, find_name, stem_of

DEPTH_UNIT_M = 20e-6
PART_SPACING_M = 0.0005
OTHER_SPACING_M = 0.002
NEAR_PART_M = 0.01  # other surfaces this near to the part are sampled as finely
MAX_RELATIVE_BEND = 0.005  # second difference of inverse depth above which depth is discontinuous
_REMEDY = "copy the ground truth again"


@dataclass(frozen=True, kw_only=True)
class TrueSurfacePoints:
    """A sampling of every true surface of the scene.

    Attributes
    ----------
    points : (N, 3) float64, world, m
    normals : (N, 3) float32, world, unit, towards the cameras; NaN off the part
    is_part : (N,) bool, whether the point lies on the part
    spacing_m : distance between neighbouring points of the part, m
    """

    points: Array
    normals: NDArray[np.float32]
    is_part: Mask
    spacing_m: float


@dataclass(frozen=True, kw_only=True)
class GroundTruth:
    """True cameras and maps of a capture; the maps are read from disk when they are used.

    Attributes
    ----------
    folder : folder of ``cameras.json``.
    views : posed true cameras by image name, of the half-size images, metres.
    depth_unit_m : of the depth maps' samples.
    """

    folder: Path
    views: Mapping[str, View]
    depth_unit_m: float = DEPTH_UNIT_M
    _surfaces: dict[tuple[float, float], TrueSurfacePoints] = field(
        default_factory=dict, init=False, repr=False, compare=False
    )

    @property
    def cameras(self) -> Path:
        """File of the cameras, for messages."""
        return self.folder / "cameras.json"

    def rays(self, name: str) -> Array:
        """Unit rays ``(H, W, 3)`` through the pixels' centres, camera frame.

        Raises
        ------
        DataError
            The file of the rays of a distorted lens is of another size.
        """
        camera = self.views[name].camera
        path = self.folder / "plane_xy.npy"
        if not path.is_file():
            return camera.rays(pixel_centers(camera.width, camera.height))
        plane = read_npy(path, read_bytes(path))
        if plane.shape != (camera.height, camera.width, 2) or not np.isfinite(plane).all():
            raise DataError(path, f"holds no rays of {camera.width}x{camera.height} px; {_REMEDY}.")
        return unit(np.concatenate([plane, np.ones((*plane.shape[:2], 1))], axis=-1))

    @property
    def names(self) -> tuple[str, ...]:
        """Image names in the file's order."""
        return tuple(self.views)

    def find(self, name: str) -> View | None:
        """True view of an image by its name, else the only one with the same stem."""
        found = find_name(name, self.views)
        return None if found is None else self.views[found]

    def mask(self, name: str) -> Mask:
        """Whether each pixel shows the part, ``(H, W)``."""
        return np.asarray(self._image(name, "mask", np.uint8, 2).astype(np.bool_))

    def depth(self, name: str) -> NDArray[np.float32]:
        """Depth z of the whole scene, ``(H, W)`` float32, m; NaN where there is nothing."""
        depth = self._image(name, "depth", np.uint16, 2).astype(np.float32)
        depth[depth == 0] = np.nan
        depth *= np.float32(self.depth_unit_m)
        return depth

    def normals(self, name: str) -> NDArray[np.float32]:
        """Unit normals of the part, ``(H, W, 3)`` float32, camera frame; NaN off the part."""
        encoded = self._image(name, "normal", np.uint16, 3)[..., ::-1]
        normals = encoded.astype(np.float32) / np.float32(32767.5) - np.float32(1)
        normals /= np.maximum(np.linalg.norm(normals, axis=-1, keepdims=True), np.float32(1e-6))
        normals[~self.mask(name)] = np.nan
        return normals

    def surface_points(
        self, spacing_m: float = PART_SPACING_M, other_spacing_m: float = OTHER_SPACING_M
    ) -> TrueSurfacePoints:
        """Sample all surfaces that the views see: their back-projected depth pixels, thinned.

        Parameters
        ----------
        spacing_m : voxel side of the part and of surfaces within about 10 mm of it, m.
        other_spacing_m : voxel side of the rest of the scene, m.

        Returns
        -------
        TrueSurfacePoints
            Pixels of the part next to a depth discontinuity are left out. Points are not denser
            than the pixels of all views; they are kept in memory for the next call.

        Raises
        ------
        DataError
            No pixel of any view lies on the part.
        """
        key = (spacing_m, other_spacing_m)
        if key not in self._surfaces:
            self._surfaces[key] = _sample_surfaces(self, *key)
        return self._surfaces[key]

    def _image(
        self, name: str, kind: str, dtype: type[np.generic], num_dims: int
    ) -> NDArray[np.generic]:
        """Read one map and check it against the camera."""
        path = _map_path(self.folder, name, kind)
        image = _read_png(path)
        camera = self.views[name].camera
        if image.shape[:2] != (camera.height, camera.width):
            raise DataError(
                path,
                f"is {image.shape[1]}x{image.shape[0]} px but cameras.json says "
                f"{camera.width}x{camera.height}; {_REMEDY}.",
            )
        if image.ndim != num_dims or image.dtype != dtype:
            channels = 1 if num_dims == 2 else 3
            bits = 8 * np.dtype(dtype).itemsize
            raise DataError(path, f"must be a {bits}-bit PNG of {channels} channel(s); {_REMEDY}.")
        return image


def open_ground_truth(folder: str | Path) -> GroundTruth:
    """Open the ground truth of a capture.

    Parameters
    ----------
    folder : the folder with ``cameras.json``, or the capture's folder that has it in ``gt/``.

    Raises
    ------
    DataError
        The folder, ``cameras.json`` or a map is missing, or ``cameras.json`` is malformed.
    """
    root = Path(folder)
    if not root.is_dir():
        raise DataError(root, "no such folder; give a capture's folder or its gt/ folder.")
    if not (root / "cameras.json").is_file() and (root / "gt").is_dir():
        root = root / "gt"
    cameras_path = root / "cameras.json"
    if not cameras_path.is_file():
        raise DataError(cameras_path, "missing; give a folder with ground truth.")
    views, depth_unit_m = _read_cameras(cameras_path)
    truth = GroundTruth(folder=root, views=views, depth_unit_m=depth_unit_m)
    for name in truth.names:
        for kind in ("depth", "normal", "mask"):
            path = _map_path(root, name, kind)
            if not path.is_file():
                raise DataError(path, f"missing, but cameras.json lists {name}; {_REMEDY}.")
    return truth


def _map_path(folder: Path, name: str, kind: str) -> Path:
    return folder / f"{stem_of(name)}_{kind}.png"


def _read_png(path: Path) -> NDArray[np.generic]:
    """Decode a PNG as stored (colour as BGR); a truncated one is an error, not a grey area."""
    data = read_bytes(path)
    if not data.startswith(PNG_SIGNATURE):
        raise DataError(path, f"is no PNG image; {_REMEDY}.")
    return decode_image(path, data)


def read_views(path: Path) -> dict[str, View]:
    """Views by image name of a ``cameras.json``; DataError where it is malformed."""
    return _read_cameras(path)[0]


def _read_cameras(path: Path) -> tuple[dict[str, View], float]:
    """Views by image name, and the unit of depth, m."""
    try:
        content = parse_json(read_text(path))
    except (OSError, ValueError) as error:
        raise DataError(path, f"cannot be read as JSON ({error}); {_REMEDY}.") from error
    try:
        width, height = int(content["width"]), int(content["height"])
        images = dict(content["images"])
        unit = float(content.get("depth_unit_m", DEPTH_UNIT_M))
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise DataError(path, f"needs integer width, height and images; {_REMEDY}.") from error
    if not images or min(width, height) <= 0 or max(width, height) > MAX_SIDE:
        raise DataError(path, f"lists no image or no size; {_REMEDY}.")
    if not 0 < unit < np.inf:
        raise DataError(path, f"has a depth_unit_m of {unit}; {_REMEDY}.")
    views = {name: _parse_view(path, name, entry, width, height) for name, entry in images.items()}
    return views, unit


def depth_unit(farthest_m: float) -> float:
    """Unit of depth maps, m: the usual one, or one with which 16 bits reach this depth."""
    return max(DEPTH_UNIT_M, farthest_m / np.iinfo(np.uint16).max)


def write_views(path: Path, views: Sequence[View], *, depth_unit_m: float = DEPTH_UNIT_M) -> None:
    """Write a ``cameras.json`` of views of pinhole cameras of one size.

    Raises
    ------
    DataError
        The system refuses.
    """
    images = {}
    for view in views:
        assert isinstance(view.camera, PinholeCamera)
        pose = view.cam_from_world
        images[view.name] = {
            "K": view.camera.K.tolist(),
            "cam_from_world": np.column_stack([pose.rotation, pose.translation]).tolist(),
        }
    size = {"width": views[0].camera.width, "height": views[0].camera.height}
    unit = {} if depth_unit_m == DEPTH_UNIT_M else {"depth_unit_m": depth_unit_m}
    write_json(path, {**size, **unit, "images": images})


def _parse_view(path: Path, name: str, entry: Any, width: int, height: int) -> View:
    try:
        K = np.array(entry["K"], np.float64)
        pose = np.array(entry["cam_from_world"], np.float64)
    except (KeyError, TypeError, ValueError) as error:
        raise DataError(path, f"{name} needs numbers K and cam_from_world; {_REMEDY}.") from error
    if K.shape != (3, 3) or not np.isfinite(K).all() or min(K[0, 0], K[1, 1]) <= 0:
        raise DataError(path, f"K of {name} must be 3x3 with positive focal lengths; {_REMEDY}.")
    if np.abs(K - [[K[0, 0], 0, K[0, 2]], [0, K[1, 1], K[1, 2]], [0, 0, 1]]).max() > 1e-9:
        raise DataError(path, f"K of {name} must be without skew; {_REMEDY}.")
    rotation = nearest_rotation(pose[:, :3]) if pose.shape == (3, 4) else None
    if rotation is None or not np.isfinite(pose).all():
        raise DataError(path, f"cam_from_world of {name} must be a 3x4 rigid motion; {_REMEDY}.")
    camera = PinholeCamera(
        width=width, height=height, fx=K[0, 0], fy=K[1, 1], cx=K[0, 2], cy=K[1, 2]
    )
    return View(name=name, camera=camera, cam_from_world=RigidTransform(rotation, pose[:, 3]))


def _sample_surfaces(
    truth: GroundTruth, spacing_m: float, other_spacing_m: float
) -> TrueSurfacePoints:
    """Back-project every view; thin finely on and near the part, coarsely elsewhere."""
    if not 0 < spacing_m <= other_spacing_m:
        raise ValueError(f"{spacing_m=}, {other_spacing_m=} but expected 0 < spacing <= other.")
    parts = [_back_project(truth, name, part=True) for name in truth.names]
    part = np.concatenate([np.zeros((0, 3)), *(points for points, _ in parts)])
    if len(part) == 0:
        raise DataError(truth.folder, f"no mask shows the part; {_REMEDY}.")
    normals = np.concatenate([normals for _, normals in parts])
    kept = voxel_representatives(part, spacing_m)
    part, normals = part[kept], normals[kept]
    del parts
    anchors = _thinned(part, NEAR_PART_M)
    fine, coarse = np.zeros((0, 3)), np.zeros((0, 3))
    for name in truth.names:  # one view at a time, thinned as it comes: the rest is large
        other = _back_project(truth, name, part=False)[0]
        near = in_cells_beside(other, anchors, NEAR_PART_M)
        fine = np.concatenate([fine, other[near]])
        coarse = _thinned(np.concatenate([coarse, other[~near]]), other_spacing_m)
    fine = _thinned(fine, spacing_m)
    num_other = len(fine) + len(coarse)
    return TrueSurfacePoints(
        points=np.concatenate([part, fine, coarse]),
        normals=np.concatenate([normals, np.full((num_other, 3), np.nan, np.float32)]),
        is_part=np.arange(len(part) + num_other) < len(part),
        spacing_m=spacing_m,
    )


def _thinned(points: Array, spacing_m: float) -> Array:
    return points[voxel_representatives(points, spacing_m)]


def _back_project(
    truth: GroundTruth, name: str, *, part: bool
) -> tuple[Array, NDArray[np.float32]]:
    """World points of one view's part with their normals, or of all else it sees (no normals)."""
    view = truth.views[name]
    depth, mask = truth.depth(name).astype(np.float64), truth.mask(name)
    wanted = np.isfinite(depth) & (mask & _is_smooth(depth) if part else ~mask)
    rays = truth.rays(name)[wanted]
    in_cam = rays * (depth[wanted] / rays[..., 2])[:, None]
    points = np.asarray(view.cam_from_world.inverse() * in_cam, np.float64)
    if not part:
        return points, np.zeros((0, 3), np.float32)
    normals = truth.normals(name)[wanted] @ view.cam_from_world.rotation.astype(np.float32)
    return points, np.asarray(normals, np.float32)


def _is_smooth(depth: Array) -> Mask:
    """Whether a pixel's 3x3 neighbours continue its surface; inverse depth is linear on a plane."""
    inverse = 1.0 / np.where(np.isfinite(depth), depth, np.inf)
    padded = np.pad(inverse, 1, mode="reflect", reflect_type="odd")
    height, width = depth.shape
    bend = np.zeros_like(inverse)
    for row, col in ((0, 1), (1, 0), (1, 1), (1, -1)):
        ahead = padded[1 + row : 1 + row + height, 1 + col : 1 + col + width]
        behind = padded[1 - row : 1 - row + height, 1 - col : 1 - col + width]
        np.maximum(bend, np.abs(ahead + behind - 2.0 * inverse), out=bend)
    return np.asarray(bend < MAX_RELATIVE_BEND * inverse, np.bool_)


def write_true_maps(
    stem: Path,
    depth: Array,
    normals_in_cam: Array,
    mask: Mask,
    *,
    depth_unit_m: float = DEPTH_UNIT_M,
) -> None:
    """Write the maps of one view, ``STEM_depth.png``, ``STEM_mask.png`` and ``STEM_normal.png``.

    Parameters
    ----------
    depth : (H, W), m; depths too large for 16 bits become unknown.
    normals_in_cam : (H, W, 3), of the part.
    mask : (H, W), where the part is seen.
    depth_unit_m : as in ``cameras.json``.

    Raises
    ------
    DataError
        The system refuses.
    """
    encoded = np.rint(depth / depth_unit_m)
    encoded = np.where(encoded <= np.iinfo(np.uint16).max, encoded, 0)
    write_png(f"{stem}_depth.png", encoded.astype(np.uint16))
    write_mask(f"{stem}_mask.png", mask)
    coded = np.rint((np.where(mask[..., None], normals_in_cam, 0) + 1) * 32767.5)
    write_png(f"{stem}_normal.png", np.ascontiguousarray(coded.astype(np.uint16)[..., ::-1]))
