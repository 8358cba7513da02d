"""Stage ``poses``: the COLMAP model of the run, by SfM or from a given model, in its frame."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from polmvs.colmap.models import match_model_to_capture, read_model, write_model
from polmvs.colmap.sfm import NoModelError, run_sfm
from polmvs.colmap.sfm_failure import why_no_model
from polmvs.config import ReferenceOptions, SfmOptions
from polmvs.errors import DataError
from polmvs.io.clouds import preload
from polmvs.io.images import read_gray
from polmvs.pipeline.monitor import OnProgress, no_progress
from polmvs.pipeline.run_folder import replace_folder, scratch
from polmvs.pipeline.stages.images import image_names
from polmvs.polarization.capture import Capture
from polmvs.poses.metric_frame import metric_frame, transform_model
from polmvs.scene import SparseModel, short_list

logger = logging.getLogger(__name__)

NUM_SFM_STEPS = 4  # that run_sfm reports


@dataclass(frozen=True, kw_only=True)
class MetricFrameResult:
    """The metric frame that the model was brought into.

    Attributes
    ----------
    source : ``reference``, ``aruco`` or ``scale``.
    scale : metres per unit of the model before.
    relative_sigma : standard deviation of the scale as a share of it; None where unknown.
    rms_residual : of what the frame was found by; see :class:`polmvs.poses.metric_frame.Frame`.
    num_used : cameras, views or ends that it was found by.
    dropped : names of those that were left out.
    checked_by : scales of the other sources that agree, by source.
    rotation, translation : of the similarity from the model before, row by row, m.
    """

    source: str
    scale: float
    relative_sigma: float | None
    rms_residual: float | None
    num_used: int
    dropped: tuple[str, ...]
    checked_by: dict[str, float]
    rotation: tuple[tuple[float, float, float], ...]
    translation: tuple[float, float, float]


@dataclass(frozen=True, kw_only=True)
class PosesResult:
    """What the stage found.

    Attributes
    ----------
    num_views : images with a pose.
    unregistered : names of those without.
    num_tracks : sparse points.
    frame : the metric frame; None where the model stays in its own.
    """

    num_views: int
    unregistered: tuple[str, ...]
    num_tracks: int
    frame: MetricFrameResult | None

    @property
    def is_metric(self) -> bool:
        """Whether the unit is the metre by a source that was given."""
        return self.frame is not None

    def __str__(self) -> str:
        total = self.num_views + len(self.unregistered)
        return f"{self.num_views} of {total} views, {self.num_tracks:,} sparse points"


def find_poses(
    images: Path,
    names: Sequence[str],
    target: Path,
    options: SfmOptions | None = None,
    reference: ReferenceOptions | None = None,
    *,
    on_progress: OnProgress = no_progress,
) -> PosesResult:
    """Run SfM on images, and bring its model into the metric frame that is asked for.

    Parameters
    ----------
    images : folder of 8-bit intensity images.
    names : of the images in it.
    target : folder of the COLMAP model, whole or not at all.
    options, reference : defaults where None.

    Raises
    ------
    DataError, OptionError
        No model comes out, or the options do not fit the images.
    """

    def on_step(name: str) -> None:
        if name == "mapping":  # on one core: the other can load what the next stages need
            preload()
        on_progress(1)

    with scratch(target) as folder:
        options, work = options or SfmOptions(), folder / "work"
        try:
            model = run_sfm(images, names, work, folder / "sparse", options, on_step)
        except NoModelError as error:
            reason = why_no_model(work / "database.db", options)
            raise DataError(images, f"SfM finds no model: {reason}") from error
        frame = _take_frame(model, images, reference, folder / "sparse")
        replace_folder(folder / "sparse", target)
    return _result(model, images, frame)


def fit_model(capture: Capture, source: Path) -> SparseModel:
    """An existing COLMAP model, fitted to the capture's image names and size.

    Raises
    ------
    DataError
        It is missing, damaged or of other images.
    """
    names = list(image_names(capture))
    return match_model_to_capture(
        read_model(source), names, capture.width, capture.height, source=source
    )


def take_poses(
    model: SparseModel,
    source: Path,
    images: Path,
    target: Path,
    reference: ReferenceOptions | None = None,
) -> PosesResult:
    """Write an existing model that was fitted to the capture; the original is not touched.

    Parameters
    ----------
    model : from :func:`fit_model`.
    source : where it was read, for messages.
    images : folder of the intensity images, in which markers are looked for.
    target : folder of the COLMAP model, whole or not at all.
    reference : defaults where None.
    """
    with scratch(target) as folder:
        write_model(model, folder / "sparse")
        frame = _take_frame(model, images, reference, folder / "sparse")
        replace_folder(folder / "sparse", target)
    return _result(model, source, frame)


def _take_frame(
    model: SparseModel, images: Path, options: ReferenceOptions | None, target: Path
) -> MetricFrameResult | None:
    """Rewrite a model in the metric frame that the options give; without one it stays."""
    frame = metric_frame(
        model, options or ReferenceOptions(), lambda name: read_gray(images / name)
    )
    if frame is None:
        return None
    similarity = frame.metric_from_world
    write_model(transform_model(model, similarity), target)
    rows = np.asarray(similarity.rotation, np.float64).tolist()
    x, y, z = map(float, similarity.translation)
    return MetricFrameResult(
        source=frame.source,
        scale=frame.scale,
        relative_sigma=frame.relative_sigma,
        rms_residual=frame.rms_residual,
        num_used=frame.num_used,
        dropped=tuple(frame.dropped),
        checked_by=dict(frame.checked_by),
        rotation=tuple((a, b, c) for a, b, c in rows),
        translation=(x, y, z),
    )


def _result(model: SparseModel, source: Path, frame: MetricFrameResult | None) -> PosesResult:
    num_views, num_missing = len(model.views), len(model.unregistered)
    if num_missing >= num_views:
        logger.warning(
            "%s: only %d of %d views have a pose; without one are %s.",
            source,
            num_views,
            num_views + num_missing,
            short_list(model.unregistered),
        )
    return PosesResult(
        num_views=num_views,
        unregistered=model.unregistered,
        num_tracks=len(model.tracks.point3D_ids),
        frame=frame,
    )
