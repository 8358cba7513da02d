"""Stage ``sfm``: the COLMAP model of the run in its own frame, by SfM or from a given model."""

from __future__ import annotations

import logging
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Thread

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.camera_uncertainty import CameraUncertainty, camera_uncertainty, pose_uncertainty
from polmvs.colmap.database import NoRoomError
from polmvs.colmap.models import match_model_to_capture, read_model, write_model
from polmvs.colmap.sfm import NoModelError, SfmTolerances, run_sfm
from polmvs.colmap.sfm_failure import why_no_model
from polmvs.colmap.trial_adjustment import Complaint, try_cameras
from polmvs.config import PropagationOptions, SfmOptions
from polmvs.errors import MAX_QUOTED, DataError
from polmvs.io.arrays import save_array
from polmvs.io.clouds import preload
from polmvs.parallel import OnProgress, OnStep, no_progress
from polmvs.pipeline.run_folder import CAMERA_MODES, POSE_COVARIANCES, replace_folder, scratch
from polmvs.pipeline.stages.images import image_names
from polmvs.pipeline.stages.maps import find_mask
from polmvs.polarization.capture import Capture
from polmvs.scene import SparseModel, short_list
from polmvs.separate import CrashError, run_separately

logger = logging.getLogger(__name__)

# Messages of SQLite and of the system in the last output of COLMAP's process.
FULL_DISK = re.compile("disk I/O error|database or disk is full|No space left|readonly database")
CANNOT_WRITE = "cannot be written: is the disk full?"
NUM_SFM_STEPS = 4  # that run_sfm reports
# Of views: under it most points of a surface are seen by two or three views, of which none can be
# told to be wrong. Derived: as few as those whose tracks of two views SfM needs.
FEW_VIEWS = SfmTolerances.max_images_two_view_tracks
# Of the distance. The surfaces allow their shape to bend by that much by errors of the camera.
LARGE_BENDING = PropagationOptions.bending


@dataclass(frozen=True, kw_only=True)
class SfmResult:
    """Result of the stage.

    Attributes
    ----------
    num_views : images with a pose.
    num_points : sparse points.
    focal_sigma : relative standard deviation of the estimated focal length; None if the camera was
        given or the deviation is unknown.
    bending : median shift of the sparse points by the uncertainty of the estimated camera,
        relative to their distance; None likewise.
    complaints : contradictions between given cameras and the matches.
    """

    num_views: int
    num_points: int
    focal_sigma: float | None = None
    bending: float | None = None
    complaints: tuple[Complaint, ...] = ()

    def __str__(self) -> str:
        text = f"{self.num_views} views, {self.num_points:,} sparse points"
        if self.focal_sigma is None:
            return text
        return text + f", focal length +-{100 * self.focal_sigma:.2g} %"


def find_model(
    images: Path,
    names: Sequence[str],
    target: Path,
    options: SfmOptions | None = None,
    *,
    on_progress: OnProgress = no_progress,
) -> SfmResult:
    """Run SfM on images.

    Parameters
    ----------
    images : folder of 8-bit intensity images.
    names : names of the images in it.
    target : folder of the COLMAP model, written whole or not at all, with ``CAMERA_MODES`` and
        ``POSE_COVARIANCES`` (see :mod:`polmvs.colmap.camera_uncertainty`).
    options : defaults if None.

    Raises
    ------
    DataError, OptionError
        SfM finds no model, or the options do not fit the images.
    """
    options = options or SfmOptions()
    known = options.known_camera
    if options.camera_model != SfmOptions.camera_model and known is not None:
        logger.warning("`sfm.camera_model` is not used where the camera is given.")
    with scratch(target) as folder:
        new = folder / "sparse"
        model = _find_apart(images, names, folder / "work", new, options, on_progress)
        found = camera_uncertainty(new) if known is None else None
        _store_uncertainty(new, model, found, pose_uncertainty(new))
        replace_folder(new, target)
    _warn_of_missing(model, images)
    _warn_of_few(len(model.views))
    if known is not None:
        remedy = "Leave it out, or give a camera that fits."
        return replace(_result(model), complaints=_warn_of_cameras(target, f"`{known}`", remedy))
    if found is None:
        return _result(model)
    bending = _bending(model, found.modes)
    if not bending < LARGE_BENDING:
        logger.warning(
            "the %d views do not fix the camera: its focal length is known to %.2g %%, which moves "
            "the surface by %.2g %% of its distance while all images fit. The stated deviations "
            "hold it. Give `sfm.intrinsics` or `sfm.camera`, or record more views, some of them "
            "turned by 90 degrees.",
            len(model.views),
            100 * found.focal,
            100 * bending,
        )
    return _result(model, focal_sigma=found.focal, bending=bending)


def _find_apart(
    images: Path,
    names: Sequence[str],
    work: Path,
    new: Path,
    options: SfmOptions,
    on_progress: OnProgress,
) -> SparseModel:
    """SfM in a process of its own, since COLMAP ends it if it cannot write its database."""
    masks = None
    if (given := options.feature_masks) is not None:
        masks = {name: find_mask(given, name) for name in names}
    loading: list[Thread] = []

    def on_step(name: str) -> None:
        if name == "mapping":  # on one core: the other can load what the next stages need
            loading.append(preload())
        on_progress(1)

    try:
        model = run_separately(
            _run_sfm, images, names, work, new, options, masks, on_message=on_step
        )
    except NoRoomError as error:
        raise DataError(new.parent.parent, CANNOT_WRITE) from error
    except CrashError as error:
        if FULL_DISK.search(error.said):
            raise DataError(new.parent.parent, CANNOT_WRITE) from error
        if options.database is not None:
            raise DataError(options.database, f"is not usable: {error}") from error
        raise
    except NoModelError as error:
        reason = why_no_model(work / "database.db", options)
        raise DataError(images, f"SfM finds no model: {reason}") from error
    for thread in loading:
        thread.join()
    return model


def _run_sfm(
    images: Path,
    names: Sequence[str],
    work: Path,
    new: Path,
    options: SfmOptions,
    masks: Mapping[str, Path] | None,
    on_step: OnStep,
) -> SparseModel:
    """SfM; COLMAP's errors about an unusable folder become errors of that folder."""
    try:
        return run_sfm(images, names, work, new, options, on_step, masks=masks)
    except RuntimeError as error:
        said = " ".join(str(error).split())[:MAX_QUOTED]
        raise DataError(new.parent.parent, f"{CANNOT_WRITE} COLMAP says: {said}") from error


def fit_model(capture: Capture, source: Path) -> SparseModel:
    """An existing COLMAP model, fitted to the capture's image names and size.

    Raises
    ------
    DataError
        The model is missing, damaged or of other images.
    """
    names = list(image_names(capture))
    return match_model_to_capture(
        read_model(source), names, capture.width, capture.height, source=source
    )


def take_model(model: SparseModel, source: Path, target: Path) -> SfmResult:
    """Write an existing model that was fitted to the capture; the original stays unchanged.

    Parameters
    ----------
    model : from :func:`fit_model`.
    source : folder it was read from, for messages.
    target : folder of the COLMAP model, written whole or not at all.
    """
    with scratch(target) as folder:
        write_model(model, folder / "sparse")
        _store_uncertainty(folder / "sparse", model, None, None)
        replace_folder(folder / "sparse", target)
    _warn_of_missing(model, source)
    _warn_of_few(len(model.views))
    remedy = "Adjust the model with its camera free, or leave `sfm.sparse` out."
    return replace(_result(model), complaints=_warn_of_cameras(target, str(source), remedy))


def _store_uncertainty(
    folder: Path,
    model: SparseModel,
    camera: CameraUncertainty | None,
    covariances: NDArray[np.float64] | None,
) -> None:
    """Store the uncertain modes of an adjustment beside its model; empty arrays if unknown."""
    modes = np.zeros((0, len(model.tracks.point3D_ids), 3)) if camera is None else camera.modes
    save_array(folder / CAMERA_MODES, modes)
    save_array(
        folder / POSE_COVARIANCES, np.zeros((0, 6, 6)) if covariances is None else covariances
    )


def _bending(model: SparseModel, modes: NDArray[np.float64]) -> float:
    """Median shift of the sparse points by the modes, share of their distance."""
    if modes.size == 0:
        return 0.0
    moved = np.sqrt(np.square(modes).sum(axis=(0, 2)))
    points = model.tracks.points_in_world
    distance = np.min([view.ranges(points) for view in model.views], axis=0)
    return float(np.median(moved / distance))


def _result(
    model: SparseModel, *, focal_sigma: float | None = None, bending: float | None = None
) -> SfmResult:
    return SfmResult(
        num_views=len(model.views),
        num_points=len(model.tracks.point3D_ids),
        focal_sigma=focal_sigma,
        bending=bending,
    )


def _warn_of_missing(model: SparseModel, source: Path) -> None:
    num_views, num_missing = len(model.views), len(model.unregistered)
    if num_missing >= num_views:
        logger.warning(
            "%s: only %d of %d views have a pose; without one are %s.",
            source,
            num_views,
            num_views + num_missing,
            short_list(model.unregistered),
        )


def _warn_of_cameras(model: Path, given: str, remedy: str) -> tuple[Complaint, ...]:
    """Warn of given cameras that do not fit the matches, and name those that do."""
    trial = try_cameras(model)
    complaints = () if trial is None else trial.complaints
    for complaint in complaints:
        assert trial is not None
        logger.warning(
            "%s: %s (%.1f px off; %.1f px with what fits). Normals follow the cameras. %s",
            given,
            complaint.text,
            trial.error_px,
            trial.fitting_error_px,
            remedy,
        )
    return tuple(replace(one, text=f"{given}: {one.text}") for one in complaints)


def _warn_of_few(num_views: int) -> None:
    if num_views < FEW_VIEWS:
        logger.warning(
            "%d views carry little: a normal takes two planes of incidence and has %s to check "
            "it, a reflection in one view passes unnoticed, and parts without sparse points can "
            "hardly be placed. Record ten or more, from all around.",
            num_views,
            "one more" if num_views == 3 else "two more" if num_views == 4 else "none",
        )
