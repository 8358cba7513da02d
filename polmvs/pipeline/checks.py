"""Checks before a run begins: the input is usable, and separate from the output."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace
from hashlib import blake2b, file_digest
from pathlib import Path

import numpy as np

from polmvs.camera import PinholeCamera
from polmvs.colmap.database import check_database
from polmvs.colmap.dense_workspace import open_dense_workspace, require_same_frame
from polmvs.colmap.learned_features import learned_features
from polmvs.colmap.pairs import read_pairs
from polmvs.colmap.sfm import check_camera, check_intrinsics
from polmvs.config import Options, ReferenceOptions, SfmOptions, get_option, option_paths
from polmvs.errors import DataError, OptionError, as_data_error
from polmvs.io.folders import resolved
from polmvs.io.ground_truth import GroundTruth, open_ground_truth
from polmvs.io.images import read_mask
from polmvs.io.plain_files import open_plain
from polmvs.pipeline.record import CaptureIdentity, Record
from polmvs.pipeline.run_folder import RunFolder, files_in
from polmvs.pipeline.stages.images import image_names
from polmvs.pipeline.stages.maps import find_mask
from polmvs.pipeline.stages.sfm import fit_model
from polmvs.polarization.capture import Capture
from polmvs.poses.alignment import MIN_CAMERAS
from polmvs.poses.image_check import ImageMatches, matches_of, require_cameras_of_images
from polmvs.poses.markers import parse_marker_option
from polmvs.poses.metric_frame import frame_from_distance, read_centers
from polmvs.scene import SparseModel, find_name, match_names, short_list

MAX_CAMERA_DIFFERENCE = 0.01  # of the focal length, between equivalent options; a guess


def inputs_of(options: Options) -> dict[str, Path]:
    """Input files and folders other than the capture, by their option."""
    named = {path: get_option(options, path) for path in option_paths()}
    named["sfm.pairs"] = options.sfm.pairs_file
    return {path: value for path, value in named.items() if isinstance(value, Path)}


def digest_of(path: Path) -> str:
    """Digest of the content of a file, or of all files in a folder.

    Raises
    ------
    DataError
        It cannot be read.
    """
    digest = blake2b(digest_size=8)
    with as_data_error(path, "read"):
        for file in [path] if path.is_file() else sorted(files_in(path)):
            digest.update(file.relative_to(path).as_posix().encode(errors="surrogateescape"))
            with open_plain(file) as stream:
                digest.update(file_digest(stream, blake2b).digest())
    return digest.hexdigest()


def require_apart(
    run_folder: RunFolder, *, capture: Path, others: Sequence[Path], written: Iterable[str]
) -> None:
    """Refuse a run folder whose results would mix with the input or delete it.

    Parameters
    ----------
    capture : folder of the raw mosaics.
    others : further input files and folders.
    written : names that a run may write in its folder.

    Raises
    ------
    OptionError
        The run folder is the capture's, or input is in the place of results.
    """
    root = resolved(run_folder.root)
    if root in (resolved(capture), resolved(capture / "raw")):
        raise OptionError(f"{run_folder.root}: OUT is the capture's own folder. Give another OUT.")
    places = [root / name for name in written]
    for path in (capture, *others):
        for real in _real_places(path):
            if any(real == place or place in real.parents for place in places):
                raise OptionError(f"{path}: lies where OUT's results go. Give another OUT.")


def _real_places(path: Path) -> list[Path]:
    """Real paths of an input and of the targets of links in it."""
    try:
        links = [entry for entry in path.iterdir() if entry.is_symlink()] if path.is_dir() else []
        return [entry.resolve() for entry in (path, *links)]
    except (OSError, RuntimeError) as error:  # a circle of links
        raise DataError(path, f"cannot be followed ({error}).") from error


def identity_of(capture: Capture) -> CaptureIdentity:
    """Identity of this capture."""
    return CaptureIdentity(
        folder=capture.folder.absolute(),
        width=capture.width,
        height=capture.height,
        digests={_path_in(path, capture.folder): digest_of(path) for path in capture.paths},
    )


def _path_in(path: Path, folder: Path) -> str:
    """Path of a file in a capture's folder; names alone repeat in folders by angle."""
    return path.relative_to(folder).as_posix() if path.is_relative_to(folder) else str(path)


def require_same_capture(record: Record, identity: CaptureIdentity, run_folder: RunFolder) -> None:
    """Refuse finished stages of another capture.

    Raises
    ------
    DataError
        They are of another capture.
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
    """Check all input that can be checked before the work begins.

    Returns
    -------
    The model of ``options.sfm.sparse``, fitted to the capture; None without it.

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
    _check_counts(options, num_images)
    if options.region.mask is not None:
        _check_masks(capture, options.region.mask)
    if options.sfm.feature_masks is not None:
        _check_masks(capture, options.sfm.feature_masks)
    matches = matches_of(capture, image_names(capture))
    if options.evaluation.gt is not None:
        require_truth_of_capture(open_ground_truth(options.evaluation.gt), capture, matches)
    _check_references(capture, options.reference)
    if options.crop.box_marker is not None and options.reference.aruco is None:
        raise OptionError("needs `reference.aruco`, the markers.", field="crop.box_marker")
    if options.export.in_place and options.fusion.workspace is None:
        raise OptionError("needs a `fusion.workspace` to fill.", field="export.in_place")
    _check_camera_options(options.sfm)
    dense = open_dense_workspace(options.fusion.workspace) if options.fusion.workspace else None
    if options.sfm.sparse is not None:
        model = fit_model(capture, options.sfm.sparse)
        if dense is None:  # images of a workspace are compared by themselves
            remedy = "Give `sfm.sparse` of this capture, or leave it out."
            require_cameras_of_images(model.views, matches, options.sfm.sparse, remedy)
        _check_same_camera(options.sfm, model, capture)
        if options.reference.scale is not None:
            frame_from_distance(model, *options.reference.scale)
        if dense is not None and options.reference == ReferenceOptions():
            require_same_frame(dense, model)
        return model
    learned_features(options.sfm)
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


def require_truth_of_capture(truth: GroundTruth, capture: Capture, matches: ImageMatches) -> None:
    """Refuse ground truth of another capture, by its names, image size and cameras.

    Parameters
    ----------
    matches : between the images of the capture.

    Raises
    ------
    DataError
        It is of another capture.
    """
    names = image_names(capture)
    matched = match_names(list(names), truth.names)
    if len(matched) < MIN_CAMERAS:
        raise DataError(
            truth.cameras,
            f"knows {len(matched)} of the {len(names)} images by name, {MIN_CAMERAS} are needed; "
            f"its names are like {truth.names[0]!r}, the images' like {next(iter(names))!r}. Give "
            "the ground truth of this capture.",
        )
    views = [replace(truth.views[other], name=name) for name, other in matched.items()]
    camera = views[0].camera
    if (camera.width, camera.height) != (capture.width, capture.height):
        raise DataError(
            truth.cameras,
            f"is of {camera.width}x{camera.height} px, the polarization images are "
            f"{capture.width}x{capture.height} px. Give the ground truth of this capture.",
        )
    remedy = "Give the ground truth of this capture."
    require_cameras_of_images(views, matches, truth.cameras, remedy)


def _check_counts(options: Options, num_images: int) -> None:
    """Views that must agree cannot be more than there are."""
    if options.fusion.min_views > num_images:
        raise OptionError(
            f"asks for points that {options.fusion.min_views} views confirm; the capture has "
            f"{num_images}. Give {num_images} at most, better {min(2, num_images)}.",
            field="fusion.min_views",
        )


def _check_masks(capture: Capture, folder: Path) -> None:
    """Every image has a mask of its size, and some show the part."""
    masks = [find_mask(folder, image) for image in image_names(capture)]
    shown = [read_mask(path, (capture.height, capture.width)).any() for path in masks]
    if not any(shown):
        raise DataError(
            masks[0],
            "and all other masks are 0 everywhere; they must not be 0 on the part.",
        )


def _check_references(capture: Capture, options: ReferenceOptions) -> None:
    """Check the sources of a metric frame as far as possible before SfM."""
    if options.aruco is not None:
        parse_marker_option(options.aruco)
    names = list(image_names(capture))
    if options.reference is not None:
        centers = read_centers(options.reference)
        num = len(match_names(names, centers))
        if num < MIN_CAMERAS:
            raise DataError(
                options.reference,
                f"knows {num} of the {len(names)} images by name, {MIN_CAMERAS} are needed; its "
                f"names are like {next(iter(centers))!r}, the images' like {names[0]!r}.",
            )
    for end in options.scale[:2] if options.scale is not None else ():
        # A number may be a sparse point's id, which only a model tells.
        if find_name(end, names) is None and not end.isdecimal():
            raise OptionError(
                f"names {end}, which is neither an image (such as {short_list(names[:2])}) nor "
                "the id of a sparse point.",
                field="reference.scale",
            )


def _check_camera_options(options: SfmOptions) -> None:
    """A camera model is estimated only where no camera is given."""
    if options.camera_model == SfmOptions().camera_model:
        return
    for name in ("intrinsics", "camera", "sparse"):
        if getattr(options, name) is not None:
            raise OptionError(
                f"has no effect beside `sfm.{name}`, which brings its own. Leave one of them out.",
                field="sfm.camera_model",
            )


def _check_same_camera(options: SfmOptions, model: SparseModel, capture: Capture) -> None:
    """A camera beside a model, which brings its own, must be the same."""
    if options.intrinsics is not None:
        name, (fx, fy, cx, cy) = "intrinsics", options.intrinsics
        given = PinholeCamera(
            width=capture.width, height=capture.height, fx=fx, fy=fy, cx=cx, cy=cy
        )
    elif options.camera is not None:
        name = "camera"
        given = check_camera(options.camera, capture.width, capture.height).pinhole
    else:
        return
    for view in model.views:
        used = view.camera.mean_focal_px
        center = view.camera.project(np.array([0.0, 0.0, 1.0]))
        apart = (used - given.mean_focal_px, center[0] - given.cx, center[1] - given.cy)
        if max(map(abs, apart)) > MAX_CAMERA_DIFFERENCE * used:
            raise OptionError(
                f"has focal length {given.mean_focal_px:.1f} and principal point "
                f"{given.cx:.1f},{given.cy:.1f}; the model of `sfm.sparse`, whose camera is used, "
                f"{used:.1f} and {center[0]:.1f},{center[1]:.1f}. Leave `sfm.{name}` out, or "
                "correct it.",
                field=f"sfm.{name}",
            )
