"""What must hold before a run begins: that the input is usable, and apart from the output."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path

from polmvs.colmap.database import check_database
from polmvs.colmap.dense_workspace import open_dense_workspace, require_same_frame
from polmvs.colmap.pairs import read_pairs
from polmvs.colmap.sfm import check_camera, check_intrinsics
from polmvs.config import Options, ReferenceOptions
from polmvs.errors import DataError, OptionError
from polmvs.io.ground_truth import open_ground_truth
from polmvs.io.images import read_mask
from polmvs.pipeline.record import CaptureIdentity, Record
from polmvs.pipeline.run_folder import RunFolder
from polmvs.pipeline.stages.images import image_names
from polmvs.pipeline.stages.maps import find_mask
from polmvs.pipeline.stages.poses import fit_model
from polmvs.polarization.capture import Capture
from polmvs.poses.metric_frame import check_reference
from polmvs.scene import SparseModel


def inputs_of(options: Options) -> list[Path]:
    """Files and folders that are read beside the capture."""
    paths = (
        options.sfm.sparse,
        options.sfm.camera,
        options.sfm.database,
        options.sfm.pairs_file,
        options.capture.calibration,
        options.reference.reference,
        options.region.mask,
        options.fusion.workspace,
        options.evaluation.gt,
    )
    return [path for path in paths if path is not None]


def require_apart(
    run_folder: RunFolder, *, capture: Path, others: Sequence[Path], written: Iterable[str]
) -> None:
    """Refuse a run folder whose results would be mixed with the input, or delete it.

    Parameters
    ----------
    capture : folder of the raw mosaics.
    others : further files and folders that are read.
    written : names of what a run may write in its folder.

    Raises
    ------
    OptionError
        The run folder is the capture's, or the input lies where results go.
    """
    root = run_folder.root.resolve()
    if root in (capture.resolve(), (capture / "raw").resolve()):
        raise OptionError(f"{run_folder.root}: OUT is the capture's own folder. Give another OUT.")
    places = [root / name for name in written]
    for path in (capture, *others):
        resolved = path.resolve()
        if any(resolved == place or place in resolved.parents for place in places):
            raise OptionError(f"{path}: lies where OUT's results go. Give another OUT.")


def identity_of(capture: Capture) -> CaptureIdentity:
    """What tells this capture from another one."""
    return CaptureIdentity(
        folder=capture.folder.absolute(),
        width=capture.width,
        height=capture.height,
        bytes={path.name: path.stat().st_size for path in capture.paths},
    )


def require_same_capture(record: Record, identity: CaptureIdentity, run_folder: RunFolder) -> None:
    """Finished stages must be of this capture.

    Raises
    ------
    DataError
        They are of another one.
    """
    before = record.capture
    if record.stages and (before is None or not before.is_same(identity)):
        folder = before.folder if before is not None else "unknown"
        raise DataError(
            run_folder.root,
            f"holds a run of another capture ({folder}), or its images have changed. Give another "
            "OUT, or `run.overwrite`.",
        )


def check_input(capture: Capture, options: Options, min_images: int) -> SparseModel | None:
    """All that can be known to be wrong before the work begins.

    Returns
    -------
    The model of ``options.sfm.sparse``, fitted to the capture; None where it names none.

    Raises
    ------
    DataError, OptionError
        The input or an option is unusable.
    """
    num_images = len(image_names(capture))
    if num_images < min_images:
        raise DataError(
            capture.folder,
            f"holds {num_images} image{'s' * (num_images != 1)}; {min_images} or more are needed, "
            "better ten: views of the part from all around.",
        )
    if options.region.mask is not None:
        for image in image_names(capture):
            read_mask(find_mask(options.region.mask, image), (capture.height, capture.width))
    if options.evaluation.gt is not None:
        open_ground_truth(options.evaluation.gt)
    check_reference(options.reference)
    if options.export.in_place and options.fusion.workspace is None:
        raise OptionError("needs a `fusion.workspace` to fill.", field="export.in_place")
    dense = open_dense_workspace(options.fusion.workspace) if options.fusion.workspace else None
    if options.sfm.sparse is not None:
        model = fit_model(capture, options.sfm.sparse)
        if dense is not None and options.reference == ReferenceOptions():
            require_same_frame(dense, model)
        return model
    if options.sfm.intrinsics is not None:
        check_intrinsics(options.sfm.intrinsics, capture.width, capture.height)
    if options.sfm.camera is not None:
        check_camera(options.sfm.camera, capture.width, capture.height)
    names = list(image_names(capture))
    if options.sfm.database is not None:
        given = check_database(options.sfm.database, names, capture.width, capture.height)
        names = list(given.ids)
    if options.sfm.pairs_file is not None:
        read_pairs(options.sfm.pairs_file, names)
    return None
