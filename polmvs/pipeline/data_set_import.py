"""A public set made ready for ``reconstruct``: images, a COLMAP model of its poses, masks."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from polmvs.colmap.cameras import ColmapCamera
from polmvs.colmap.sfm import triangulate_views
from polmvs.config import BayerOrder, CaptureKind, CaptureOptions, Light, to_plain
from polmvs.errors import DataError, OptionError
from polmvs.io.arrays import save_array
from polmvs.io.data_sets import DataSet, load_converted, read_data_set, read_set_mask
from polmvs.io.images import write_bytes, write_png
from polmvs.pipeline.stages.images import image_names, write_images
from polmvs.polarization.capture import Capture, open_capture
from polmvs.scene import View, stem_of

SAME_CAMERA = 1e-6  # relative difference by the rounding of a set's matrices


@dataclass(frozen=True, kw_only=True)
class ImportedSet:
    """What a set became; paths that it lacks are None.

    Attributes
    ----------
    data_set : as it was read.
    capture : folder to give as CAPTURE.
    options_file : TOML file to give as ``--config``.
    sparse : COLMAP model to give as ``--sparse``.
    masks : folder to give as ``--mask``.
    num_points : of the model where it was triangulated here.
    light : to give as ``--light``.
    """

    data_set: DataSet
    capture: Path
    options_file: Path
    sparse: Path | None
    masks: Path | None
    num_points: int | None
    light: Light | None


def import_data_set(folder: Path, out: Path, *, bayer: BayerOrder = BayerOrder.RGGB) -> ImportedSet:
    """Read a public set and write what ``reconstruct`` takes beside it.

    Parameters
    ----------
    folder : the set, which is not changed; images that a capture is read from stay there.
    out : folder to make.
    bayer : colours of raw colour mosaics.

    Raises
    ------
    DataError
        The set is incomplete or damaged.
    OptionError
        ``out`` exists.
    """
    if out.exists():
        raise OptionError(f"{out}: exists. Give another folder.")
    data_set = read_data_set(folder, bayer)
    out.mkdir(parents=True)
    try:
        return _import(data_set, out)
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)
        raise


def _import(data_set: DataSet, out: Path) -> ImportedSet:
    options, place = data_set.options, data_set.capture
    if place is None:
        place = out / "capture"
        _convert(data_set, place)
        options = replace(options, kind=CaptureKind.STOKES)
    capture = open_capture(place, options)
    missing = {stem_of(name) for name in image_names(capture)} ^ set(data_set.names)
    if missing:
        raise DataError(data_set.folder, f"the image {min(missing)!r} is not whole.")
    sparse, num_points = data_set.sparse, None
    if data_set.cameras:
        sparse = out / "sparse"
        num_points = _triangulate(data_set, capture, out)
    masks = None
    if data_set.masks:
        masks = out / "masks"
        masks.mkdir()
        for stem in data_set.names:
            _write_mask(data_set, stem, masks, capture)
    options_file = out / "capture.toml"
    write_bytes(options_file, _toml(options).encode())
    return ImportedSet(
        data_set=data_set,
        capture=place,
        options_file=options_file,
        sparse=sparse,
        masks=masks,
        num_points=num_points,
        light=data_set.light,
    )


def _convert(data_set: DataSet, place: Path) -> None:
    """Stokes images of a set in folders by parameter."""
    for name in ("s0", "s1", "s2"):
        (place / name).mkdir(parents=True)
    for stem in data_set.names:
        planes = load_converted(data_set, stem)
        for name, plane in zip(("s0", "s1", "s2"), planes, strict=True):
            save_array(place / name / f"{stem}.npy", np.asarray(plane, np.float32))


def _triangulate(data_set: DataSet, capture: Capture, out: Path) -> int:
    """Write ``sparse/`` with the given poses and points triangulated from matches."""
    views = []
    first = data_set.cameras[0].intrinsics
    for name, intrinsics, pose in data_set.cameras:
        if first.model == intrinsics.model and np.allclose(
            first.params, intrinsics.params, rtol=SAME_CAMERA
        ):
            intrinsics = first
        if (intrinsics.width, intrinsics.height) != (capture.width, capture.height):
            raise DataError(
                data_set.folder,
                f"its cameras are of {intrinsics.width}x{intrinsics.height} px, the polarization "
                f"images {capture.width}x{capture.height} px.",
            )
        camera = ColmapCamera(
            model=intrinsics.model,
            width=intrinsics.width,
            height=intrinsics.height,
            params=intrinsics.params,
        )
        views.append(View(name=name, camera=camera, cam_from_world=pose))
    images, work = out / "images", out / "work"
    write_images(capture, images)
    model = triangulate_views(images, views, work, out / "sparse")
    shutil.rmtree(work)
    return len(model.tracks.point3D_ids)


def _write_mask(data_set: DataSet, stem: str, folder: Path, capture: Capture) -> None:
    """A mask at the size of the polarization images."""
    path = data_set.masks.get(stem)
    if path is None:
        raise DataError(data_set.folder, f"has no mask of {stem}, as it has of other images.")
    mask = read_set_mask(path)
    step_y, step_x = mask.shape[0] / capture.height, mask.shape[1] / capture.width
    if step_y != step_x or step_x != int(step_x):
        raise DataError(
            path,
            f"is {mask.shape[1]}x{mask.shape[0]} px, the polarization images "
            f"{capture.width}x{capture.height} px.",
        )
    step = int(step_x)
    # On the part where all of the finer mask's pixels are.
    blocks = mask.reshape(capture.height, step, capture.width, step)
    write_png(folder / f"{stem}.png", np.where(blocks.all(axis=(1, 3)), 255, 0).astype(np.uint8))


def _toml(options: CaptureOptions) -> str:
    """The options that differ from the defaults as a table for ``--config``."""
    default = to_plain(CaptureOptions())
    lines = ["[capture]"]
    for name, value in to_plain(options).items():
        if value != default[name]:
            text = str(value).lower() if isinstance(value, bool) else repr(value)
            lines.append(f"{name} = {text}")
    return "\n".join(lines) + "\n"
