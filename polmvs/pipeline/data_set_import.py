"""Import of a public set for ``reconstruct``: images, a COLMAP model of its poses, masks.

:func:`import_data_set` imports a set. ``reconstruct`` and ``inspect`` call :func:`as_capture` with
any folder.
"""

from __future__ import annotations

import logging
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from polmvs.colmap.cameras import ColmapCamera
from polmvs.colmap.sfm import triangulate_views
from polmvs.config import (
    CaptureKind,
    CaptureOptions,
    Options,
    to_plain,
)
from polmvs.errors import DataError, OptionError, as_data_error
from polmvs.io.arrays import save_array
from polmvs.io.data_sets import (
    DataSet,
    DataSetKind,
    load_converted,
    read_data_set,
    read_set_mask,
    recognise_data_set,
)
from polmvs.io.images import write_bytes, write_mask
from polmvs.io.typed_json import from_json, parse_json, write_json
from polmvs.parallel import Workers
from polmvs.pipeline.stages.images import image_names, write_images
from polmvs.polarization.capture import Capture, open_capture
from polmvs.polarization.kinds import Light
from polmvs.scene import View, stem_of

logger = logging.getLogger(__name__)

IMPORT_FILE = "import.json"  # file that marks an import and names its source
SAME_CAMERA = 1e-6  # relative difference by the rounding of a set's matrices


@dataclass(frozen=True, kw_only=True)
class _Made:
    """Source of an import."""

    folder: Path
    kind: DataSetKind


@dataclass(frozen=True, kw_only=True)
class ImportedSet:
    """An imported set; missing paths are None.

    Attributes
    ----------
    data_set : description of the set.
    capture : folder of the images.
    options_file : TOML file of the capture's options.
    sparse : COLMAP model, for ``sfm.sparse``.
    masks : folder, for ``region.mask``.
    num_points : of the model, if it was triangulated here.
    light : for ``region.light``.
    options : of the capture, as in the file.
    """

    data_set: DataSet
    capture: Path
    options_file: Path
    sparse: Path | None
    masks: Path | None
    num_points: int | None
    light: Light | None
    options: CaptureOptions


def import_data_set(folder: Path, out: Path, options: CaptureOptions | None = None) -> ImportedSet:
    """Read a public set and write the input of ``reconstruct``.

    Parameters
    ----------
    folder : the set, which is not changed; images in the form of a capture stay there.
    out : folder to create.
    options : of the capture; values other than the defaults take precedence over the layout.

    Raises
    ------
    DataError
        The set is incomplete or damaged.
    OptionError
        ``out`` exists.
    """
    if out.exists():
        raise OptionError(f"{out}: exists. Give another folder.")
    data_set = read_data_set(folder, options)
    with as_data_error(out, "made"):
        out.mkdir(parents=True)
    try:
        imported = _import(data_set, out)
        write_json(out / IMPORT_FILE, _Made(folder=folder.absolute(), kind=data_set.kind))
        return imported
    except BaseException:
        shutil.rmtree(out, ignore_errors=True)
        raise


def as_capture(folder: Path, out: Path, options: Options) -> tuple[Path, Options]:
    """A capture and its options; for a public set those of its import, which is made or reused.

    Parameters
    ----------
    folder : a capture, or a public set.
    out : of the run; the import lies beside it, ``OUT_import``.
    options : from the user. If they give poses, those of the set are ignored.

    Raises
    ------
    DataError
        The set is incomplete, or ``OUT_import`` is not an import of it.
    """
    kind = recognise_data_set(folder) if folder.is_dir() else None
    place = out.absolute().with_name(f"{out.name}_import")
    given = options.sfm.sparse
    # A run that goes on has the import's model from its record.
    of_import = given is not None and place in given.absolute().parents
    if kind is None or (given is not None and not of_import):
        return folder, options
    if place.exists():
        imported = _found_import(folder, place, options.capture)
    else:
        imported = import_data_set(folder, place, options.capture)
    logger.warning(
        "%s is a set in the layout of %s: its cameras%s are used; the import is %s.",
        folder,
        kind,
        " and masks" if imported.masks is not None else "",
        place,
    )
    region = options.region
    if region.mask is None and imported.masks is not None:
        region = replace(region, mask=imported.masks)
    if region.light is None and imported.light is not None:
        region = replace(region, light=imported.light)
    sfm = replace(options.sfm, sparse=imported.sparse)
    changed = replace(options, capture=imported.options, sfm=sfm, region=region)
    return imported.capture, changed


def _found_import(folder: Path, place: Path, options: CaptureOptions) -> ImportedSet:
    """Existing import, if it is of this set."""
    path = place / IMPORT_FILE
    try:
        made = from_json(_Made, parse_json(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise DataError(place, f"is in the way of the import of {folder}: remove it.") from error
    data_set = read_data_set(folder, options)
    if made.folder != folder.absolute() or made.kind is not data_set.kind:
        raise DataError(place, f"is the import of {made.folder}, not of {folder}: remove it.")
    return _described(data_set, place, None)


def _described(data_set: DataSet, out: Path, num_points: int | None) -> ImportedSet:
    """Description of the import of a set in a folder."""
    options = data_set.options
    if data_set.capture is None:
        options = replace(options, kind=CaptureKind.STOKES)
    return ImportedSet(
        data_set=data_set,
        capture=data_set.capture or out / "capture",
        options_file=out / "capture.toml",
        sparse=out / "sparse" if data_set.cameras else data_set.sparse,
        masks=out / "masks" if data_set.masks else None,
        num_points=num_points,
        light=data_set.light,
        options=options,
    )


def _import(data_set: DataSet, out: Path) -> ImportedSet:
    planned = _described(data_set, out, None)
    options, place = planned.options, planned.capture
    if data_set.capture is None:
        _convert(data_set, place)
    capture = open_capture(place, options)
    missing = {stem_of(name) for name in image_names(capture)} ^ set(data_set.names)
    if missing:
        raise DataError(data_set.folder, f"the image {min(missing)!r} is not whole.")
    num_points = _triangulate(data_set, capture, out) if data_set.cameras else None
    if planned.masks is not None:
        planned.masks.mkdir()
        for stem in data_set.names:
            _write_mask(data_set, stem, planned.masks, capture)
    write_bytes(planned.options_file, _toml(options).encode())
    return replace(planned, num_points=num_points)


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
        camera = ColmapCamera(**vars(intrinsics))
        views.append(View(name=name, camera=camera, cam_from_world=pose))
    images, work = out / "images", out / "work"
    write_images(capture, images, workers=Workers())
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
    write_mask(folder / f"{stem}.png", np.asarray(blocks.all(axis=(1, 3))))


def _toml(options: CaptureOptions) -> str:
    """The options that differ from the defaults as a table for ``--config``."""
    default = to_plain(CaptureOptions())
    lines = ["[capture]"]
    for name, value in to_plain(options).items():
        if value != default[name]:
            text = str(value).lower() if isinstance(value, bool) else repr(value)
            lines.append(f"{name} = {text}")
    return "\n".join(lines) + "\n"
