"""Public multi-view polarization sets, recognized by the names of their files and folders.

====================  ===========================================================================
``ppa4p3d``           ``images/`` raw mosaics with gamma 0.5, ``cams/`` MVSNet texts
``PISR``              ``raw/`` colour mosaics as ``.npy``, or ``aop/ dop/ image/``; ``mask/``;
                      ``intrinsics.npz``, ``cameras_sphere.npz``, ``gamma<value>.txt``
``PANDORA``           ``images_stokes/NAME_{s0,s0p1,s0p2}.hdr`` with s1 = s0p1 - s0, s2 = s0p2 - s0,
                      or ``images_raw/`` dumps of Mono12p; ``mask/``; ``sparse/0``
``NeRSP``, SMVP3D     ``s0/ s1/ s2/`` arrays; ``cameras.npz``; masks in the alpha of
                      ``input_azimuth_maps/``, or in ``mask/``
``NeuS``              cameras as below beside any capture: mosaics, an image for each polarizer
                      angle (``raw/NAME_045.png``), Stokes images; ``mask/`` or ``masks/``
``TransPIR``          ``I-00/ I-45/ I-90/ I-135/``, or ``s0/ s1/ s2/`` with ``I-sum/``;
                      ``cameras_new.npz``; ``masks/NAME_pseudo.png``
``MVAS``              ``input_azimuth_maps/`` (16 bit, pi a full scale, clockwise), ``mask/`` or
                      alpha, ``sparse/0``
====================  ===========================================================================

``cameras.npz``, ``cameras_sphere.npz`` and ``cameras_new.npz`` are those of IDR and NeuS:
``world_mat_<i or name>`` is the projection ``K [R t]`` (4x4) with the pixel origin at the centre of
the first pixel.

:class:`DataSet` describes a set. :func:`load_converted` converts images that are not in the form of
a capture (PANDORA's images, azimuth maps) to Stokes images.
"""

from __future__ import annotations

import re
import zipfile
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import rq

from polmvs.arrays import Array, Image, Mask
from polmvs.camera import PinholeCamera
from polmvs.config import (
    BayerOrder,
    CaptureKind,
    CaptureOptions,
    Packing,
    Resolution,
    describe_fields,
)
from polmvs.errors import DataError, as_data_error
from polmvs.geometry import RigidTransform, nearest_rotation
from polmvs.io.capture_files import find_capture
from polmvs.io.images import decode_image, read_bytes
from polmvs.io.intrinsics import Intrinsics, from_opencv_matrix
from polmvs.io.layouts import is_author_layout, read_author_views
from polmvs.io.plain_files import open_plain
from polmvs.io.raw_formats import read_npy, read_raw
from polmvs.polarization.kinds import Light
from polmvs.scene import stem_of

BAYER = BayerOrder.RGGB  # of raw colour mosaics, by default
CAMERA_FILES = ("cameras.npz", "cameras_sphere.npz", "cameras_new.npz")
PANDORA_SIZE = (2448, 2048)  # of its dumps, px
MAX_NPZ_BYTES = 1 << 28


class DataSetKind(StrEnum):
    """Kind of layout of a set."""

    PPA4P3D = "ppa4p3d"
    PISR = "PISR"
    PANDORA = "PANDORA"
    NERSP = "NeRSP"
    MVAS = "MVAS"
    TRANSPIR = "TransPIR"
    NEUS = "NeuS"


class PosedImage(NamedTuple):
    """A camera of a set.

    Attributes
    ----------
    name : of the image, a stem with ``.png``, as in COLMAP models.
    intrinsics : of the polarization images.
    cam_from_world : in the set's world.
    """

    name: str
    intrinsics: Intrinsics
    cam_from_world: RigidTransform


@dataclass(frozen=True, kw_only=True)
class DataSet:
    """A public set as a capture.

    Attributes
    ----------
    kind : kind of layout.
    folder : as given.
    capture : folder of the capture; None if :func:`load_converted` must first make its Stokes
        images.
    options : how to read it.
    names : stems of the images, sorted.
    cameras : given poses; empty if ``sparse`` has them.
    sparse : COLMAP model of the set, if it has one.
    masks : file of the mask by stem; the alpha channel if it has one, else pixels that are not
        black.
    light : kind of light of the angles, if the set states it.
    """

    kind: DataSetKind
    folder: Path
    capture: Path | None
    options: CaptureOptions
    names: tuple[str, ...]
    cameras: tuple[PosedImage, ...] = ()
    sparse: Path | None = None
    masks: Mapping[str, Path] = field(default_factory=dict)
    light: Light | None = None


def recognise_data_set(folder: Path) -> DataSetKind | None:
    """Kind of layout of a folder; None if unknown."""

    def has(*names: str) -> bool:
        return all((folder / name).exists() for name in names)

    if is_author_layout(folder):
        return DataSetKind.PPA4P3D
    pisr = has("cameras_sphere.npz", "intrinsics.npz")
    if pisr and (has("raw") or has("aop", "dop")):
        return DataSetKind.PISR
    if has("images_stokes") or has("images_raw", "sparse"):
        return DataSetKind.PANDORA
    posed = any(has(name) for name in CAMERA_FILES)
    if has("cameras_new.npz", "I-sum") and (has("I-00") or has("s0")):
        return DataSetKind.TRANSPIR
    if has("s0", "s1", "s2") and (posed or has("input_azimuth_maps")):
        return DataSetKind.NERSP
    if has("input_azimuth_maps"):
        return DataSetKind.MVAS
    return DataSetKind.NEUS if posed else None


def read_data_set(folder: Path, options: CaptureOptions | None = None) -> DataSet:
    """Describe a public set.

    Parameters
    ----------
    folder : of one object or scene.
    options : values other than the defaults take precedence over those of the layout. No set states
        ``bayer``, the colours of raw colour mosaics: by default RGGB.

    Raises
    ------
    DataError
        The layout is unknown, or a file of it is missing or damaged.
    """
    if not folder.is_dir():
        raise DataError(folder, "no such folder.")
    kind = recognise_data_set(folder)
    readers = {
        DataSetKind.PPA4P3D: _read_ppa4p3d,
        DataSetKind.PISR: _read_pisr,
        DataSetKind.PANDORA: _read_pandora,
        DataSetKind.NERSP: _read_nersp,
        DataSetKind.MVAS: _read_mvas,
        DataSetKind.TRANSPIR: _read_neus,
        DataSetKind.NEUS: _read_neus,
    }
    if kind is None:
        known = ", ".join(DataSetKind)
        raise DataError(folder, f"has the layout of no set that is known ({known}).")
    given = options or CaptureOptions()
    found = readers[kind](folder, given)
    return replace(found, options=_overridden(found.options, given))


def _overridden(options: CaptureOptions, given: CaptureOptions) -> CaptureOptions:
    """Options with those of others that are not the defaults."""
    default = CaptureOptions()
    names = [info.name for info in describe_fields(CaptureOptions)]
    changed = {n: getattr(given, n) for n in names if getattr(given, n) != getattr(default, n)}
    return replace(options, **changed)


def load_converted(data_set: DataSet, stem: str) -> tuple[Image, Image, Image]:
    """Stokes images s0, s1, s2 ``(H, W)`` or ``(H, W, 3)`` of an image of PANDORA or MVAS.

    For an azimuth map the light is assumed fully polarized in the mask and unpolarized outside; s0
    is the intensity image of the same name and size if there is one, else 1.

    Raises
    ------
    DataError
        A file is missing or damaged.
    """
    if data_set.capture is not None:
        raise ValueError(f"{data_set.kind} is read as it is, from {data_set.capture}.")
    if data_set.kind is DataSetKind.PANDORA:
        place = data_set.folder / "images_stokes"
        planes = [
            np.asarray(read_raw(place / f"{stem}_{name}.hdr").samples, np.float32)
            for name in ("s0", "s0p1", "s0p2")
        ]
        if len({plane.shape for plane in planes}) != 1:
            raise DataError(place / f"{stem}_s0.hdr", "its three images differ in size.")
        return planes[0], planes[1] - planes[0], planes[2] - planes[0]
    return _from_azimuth(data_set, stem)


def read_set_mask(path: Path) -> Mask:
    """A mask (H, W): alpha not 0; without alpha, any channel not 0.

    Raises
    ------
    DataError
        The file is missing or damaged.
    """
    image = decode_image(path, read_bytes(path))
    if image.ndim == 2:
        return np.asarray(image != 0)
    if image.shape[2] == 4:
        return np.asarray(image[..., 3] != 0)
    return np.asarray((image != 0).any(axis=-1))


def _read_ppa4p3d(folder: Path, given: CaptureOptions) -> DataSet:
    images = _files(folder / "images", (".png",))
    width, height = _size_of(next(iter(images.values())))
    cameras = []
    names = [f"{stem}.png" for stem in images]
    for view in read_author_views(folder, names, width // 2, height // 2).values():
        assert isinstance(view.camera, PinholeCamera)
        camera = view.camera
        intrinsics = Intrinsics(
            model="PINHOLE",
            width=camera.width,
            height=camera.height,
            params=(camera.fx, camera.fy, camera.cx, camera.cy),
        )
        cameras.append(PosedImage(view.name, intrinsics, view.cam_from_world))
    return DataSet(
        kind=DataSetKind.PPA4P3D,
        folder=folder,
        capture=folder / "images",
        options=CaptureOptions(gamma=0.5),
        names=tuple(images),
        cameras=tuple(cameras),
    )


def _read_pisr(folder: Path, given: CaptureOptions) -> DataSet:
    raw = (folder / "raw").is_dir()
    images = _files(folder / ("raw" if raw else "aop"), (".npy",))
    gamma = 1.0
    for path in sorted(folder.glob("gamma*.txt")):
        match = re.fullmatch(r"gamma(\d+(?:\.\d+)?)", path.stem)
        if match is None:
            raise DataError(path, "names no gamma; gamma0.5.txt is expected.")
        gamma = float(match[1])
    path = folder / "intrinsics.npz"
    lens = read_npz(path)
    width, height = _size_of(next(iter(images.values())))
    if raw:
        width, height = width // 2, height // 2
    try:
        matrix = _matrix(lens["camera_matrix"], (3, 3))
        distortion = np.ravel(lens["dist_coeffs"]).astype(np.float64)
        intrinsics = from_opencv_matrix(matrix, distortion, width, height)
    except (KeyError, ValueError) as error:
        raise DataError(path, f"holds no camera that can be used: {error}.") from error
    cameras = [
        camera._replace(intrinsics=intrinsics)
        for camera in _read_world_mats(folder / "cameras_sphere.npz", tuple(images), width, height)
    ]
    options = CaptureOptions(kind=CaptureKind.AOLP)
    if raw:
        options = CaptureOptions(gamma=gamma, bayer=given.bayer or BAYER, full_scale=4095)
    return DataSet(
        kind=DataSetKind.PISR,
        folder=folder,
        capture=folder / "raw" if raw else folder,
        options=options,
        names=tuple(images),
        cameras=tuple(cameras),
        masks=_files(folder / "mask", (".png",), needed=False),
    )


def _read_pandora(folder: Path, given: CaptureOptions) -> DataSet:
    stokes = (folder / "images_stokes").is_dir()
    if stokes:
        found = _files(folder / "images_stokes", (".hdr", ".exr"))
        names = sorted({stem[: -len("_s0")] for stem in found if stem.endswith("_s0")})
        for name in names:
            for part in ("s0p1", "s0p2"):
                if f"{name}_{part}" not in found:
                    raise DataError(folder / "images_stokes", f"lacks {name}_{part}.hdr.")
    else:
        names = sorted(_files(folder / "images_raw", (".raw",)))
    if not names:
        raise DataError(folder / "images_stokes", "holds no NAME_s0.hdr.")
    options = CaptureOptions(full_scale=1.0)
    if not stokes:
        options = CaptureOptions(
            width=PANDORA_SIZE[0], height=PANDORA_SIZE[1], packing=Packing.MONO12P,
            bayer=given.bayer or BAYER, full_scale=4095,
        )  # fmt: skip
    return DataSet(
        kind=DataSetKind.PANDORA,
        folder=folder,
        capture=None if stokes else folder / "images_raw",
        options=options,
        names=tuple(names),
        sparse=_sparse_of(folder),
        masks=_files(folder / "mask", (".png",), needed=False),
    )


def _read_nersp(folder: Path, given: CaptureOptions) -> DataSet:
    images = _files(folder / "s0", (".npy",))
    width, height = _size_of(next(iter(images.values())))
    return DataSet(
        kind=DataSetKind.NERSP,
        folder=folder,
        capture=folder,
        options=CaptureOptions(kind=CaptureKind.STOKES),
        names=tuple(images),
        cameras=_read_world_mats(_camera_file(folder), tuple(images), width, height),
        masks=_files(folder / "input_azimuth_maps", (".png",), needed=False) or _masks_of(folder),
    )


def _read_neus(folder: Path, given: CaptureOptions) -> DataSet:
    """Cameras of IDR and NeuS beside any capture."""
    stokes = all((folder / name).is_dir() for name in ("s0", "s1", "s2"))
    kind = given.kind or (CaptureKind.STOKES if stokes else None)
    files = find_capture(folder, kind=kind, naming=given.naming, angles=given.angles)
    stems = tuple(stem_of(view.name) for view in files.views)
    width, height = _size_of(files.paths[0])
    if files.kind is CaptureKind.MOSAIC and given.resolution is Resolution.HALF:
        width, height = width // 2, height // 2
    cameras = _read_world_mats(_camera_file(folder), stems, width, height)
    masks = _masks_of(folder)
    return DataSet(
        kind=recognise_data_set(folder) or DataSetKind.NEUS,
        folder=folder,
        capture=folder,
        options=CaptureOptions(kind=files.kind),
        names=stems,
        cameras=cameras,
        # Some sets have masks of a few images only.
        masks=masks if set(stems) <= masks.keys() else {},
    )


def _camera_file(folder: Path) -> Path:
    """The first of the files of cameras that a set has; the first name where it has none."""
    places = [folder / name for name in CAMERA_FILES]
    return next((place for place in places if place.is_file()), places[0])


def _masks_of(folder: Path) -> dict[str, Path]:
    """Masks by the stem of their image, which a word may follow: ``000_pseudo.png``."""
    for name in ("mask", "masks"):
        found = _files(folder / name, (".png",), needed=False)
        if found:
            return {re.sub(r"_(pseudo|mask)$", "", stem): path for stem, path in found.items()}
    return {}


def _read_mvas(folder: Path, given: CaptureOptions) -> DataSet:
    images = _files(folder / "input_azimuth_maps", (".png",))
    masks = _files(folder / "mask", (".png",), needed=False)
    return DataSet(
        kind=DataSetKind.MVAS,
        folder=folder,
        capture=None,
        # Azimuths of normals, clockwise from +x: the phase of diffuse light.
        options=CaptureOptions(clockwise=True, full_scale=1.0),
        names=tuple(images),
        sparse=_sparse_of(folder),
        masks=masks or images,
        light=Light.DIFFUSE,
    )


def _from_azimuth(data_set: DataSet, stem: str) -> tuple[Image, Image, Image]:
    path = data_set.folder / "input_azimuth_maps" / f"{stem}.png"
    image = decode_image(path, read_bytes(path))
    plane = image if image.ndim == 2 else image[..., 0]
    if plane.dtype not in (np.uint8, np.uint16):
        raise DataError(path, "is no 8- or 16-bit azimuth map.")
    angle = np.asarray(plane * (np.pi / np.iinfo(plane.dtype).max), np.float32)
    mask = read_set_mask(data_set.masks.get(stem, path))
    if mask.shape != angle.shape:
        raise DataError(data_set.masks[stem], f"is not of the size of {path.name}.")
    s0 = np.ones(angle.shape, np.float32)
    for place in ("image", "images", "images_SfM"):
        for suffix in (".png", ".jpg"):
            shown = data_set.folder / place / f"{stem}{suffix}"
            if shown.is_file():
                samples = read_raw(shown).samples
                if samples.shape[:2] == angle.shape:
                    gray = samples if samples.ndim == 2 else samples.mean(axis=-1)
                    s0 = np.asarray(gray / np.iinfo(samples.dtype).max, np.float32)
                    # An unlit pixel has no phase; these maps give one all the same.
                    s0 = np.maximum(s0, np.float32(0.02))
    polarized = np.where(mask, s0, 0).astype(np.float32)
    return s0, polarized * np.cos(2 * angle), polarized * np.sin(2 * angle)


def _files(folder: Path, suffixes: tuple[str, ...], *, needed: bool = True) -> dict[str, Path]:
    """Files of a folder by stem, sorted."""
    if not folder.is_dir():
        if needed:
            raise DataError(folder, "no such folder in the set.")
        return {}
    found = {p.stem: p for p in sorted(folder.iterdir()) if p.suffix.lower() in suffixes}
    if needed and not found:
        raise DataError(folder, f"holds no file of {', '.join(suffixes)}.")
    return found


def _sparse_of(folder: Path) -> Path | None:
    """The COLMAP model of a set."""
    for place in (folder / "sparse" / "0", folder / "sparse"):
        if any((place / f"cameras{suffix}").is_file() for suffix in (".bin", ".txt")):
            return place
    return None


def _size_of(path: Path) -> tuple[int, int]:
    header = read_raw(path).header
    return header.width, header.height


def read_npz(path: Path) -> dict[str, NDArray[Any]]:
    """Arrays of numbers by name.

    Raises
    ------
    DataError
        The file is missing, damaged or too large.
    """
    try:
        with (
            as_data_error(path, "read"),
            open_plain(path) as file,
            zipfile.ZipFile(file) as content,
        ):
            members = content.infolist()
            # What a member says of its size is all that is read of it.
            if sum(member.file_size for member in members) > MAX_NPZ_BYTES:
                raise DataError(path, "is too large for cameras.")
            return {
                member.filename.removesuffix(".npy"): read_npy(path, content.read(member))
                for member in members
            }
    except DataError:
        raise
    except Exception as error:  # zipfile and NumPy's header parser raise many kinds
        raise DataError(path, "is no readable .npz of cameras; copy the set again.") from error


def _read_world_mats(
    path: Path, stems: tuple[str, ...], width: int, height: int
) -> tuple[PosedImage, ...]:
    """Cameras of IDR and NeuS, by name or by place in the order of names."""
    content = read_npz(path)
    cameras = []
    for index, stem in enumerate(stems):
        keys = [f"world_mat_{stem}", f"world_mat_{index}"]
        key = next((key for key in keys if key in content), None)
        if key is None:
            raise DataError(path, f"has no {keys[0]} and no {keys[1]}.")
        try:
            matrix, pose = _decompose(_matrix(content[key], (4, 4), (3, 4))[:3])
            matrix = _at_size(_without_skew(matrix), width, height)
            intrinsics = from_opencv_matrix(matrix, [], width, height)
        except ValueError as error:
            raise DataError(path, f"{key} is no camera: {error}.") from error
        cameras.append(PosedImage(f"{stem}.png", intrinsics, pose))
    return tuple(cameras)


def _decompose(projection: Array) -> tuple[Array, RigidTransform]:
    """``K [R t]`` into its parts; K has a positive diagonal and a last element of 1."""
    if not np.isfinite(projection).all() or abs(np.linalg.det(projection[:, :3])) < 1e-12:
        raise ValueError("it is singular")
    scaled = projection * np.sign(np.linalg.det(projection[:, :3]))
    matrix, rotation = rq(scaled[:, :3])
    signs = np.diag(np.sign(np.diag(matrix)))
    matrix, rotation = matrix @ signs, signs @ rotation
    nearest = nearest_rotation(rotation)
    if nearest is None:
        raise ValueError("it holds no rotation")
    translation = np.linalg.solve(matrix, scaled[:, 3])
    return matrix / matrix[2, 2], RigidTransform(nearest, translation)


def _at_size(matrix: Array, width: int, height: int) -> Array:
    """A calibration matrix, pixels counted from the centre of the first, of images of a size.

    One that is of the mosaics, whose sides are twice as long, has its principal point at the
    images' lower right corner.
    """
    center = matrix[:2, 2] + 0.5
    middle = 0.5 * np.array([width, height])
    if np.linalg.norm(0.5 * center - middle) >= np.linalg.norm(center - middle):
        return matrix
    halved = 0.5 * matrix
    halved[:2, 2] = 0.5 * center - 0.5
    halved[2] = matrix[2]
    return halved


def _without_skew(matrix: Array) -> Array:
    """A calibration matrix without the skew that rounding leaves."""
    if abs(matrix[0, 1]) > 1e-3 * matrix[0, 0]:
        raise ValueError(f"its axes are skewed by {matrix[0, 1]:.3g} px")
    return np.array([[matrix[0, 0], 0, matrix[0, 2]], [0, matrix[1, 1], matrix[1, 2]], [0, 0, 1.0]])


def _matrix(values: NDArray[Any], *shapes: tuple[int, int]) -> Array:
    if values.shape not in shapes or values.dtype.kind not in "fiu":
        raise ValueError(f"it is {values.shape}, not {shapes[0]}")
    return np.asarray(values, np.float64)
