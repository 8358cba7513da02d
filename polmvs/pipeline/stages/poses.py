"""Stage ``poses``: the COLMAP model of the run, in the metric frame of the options."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import block_diag

from polmvs.colmap.models import read_model, write_model
from polmvs.config import ReferenceOptions
from polmvs.errors import OptionError
from polmvs.io.arrays import map_array, save_array
from polmvs.io.images import read_bytes, read_gray, write_bytes
from polmvs.pipeline.run_folder import (
    CAMERA_MODES,
    POSE_COVARIANCES,
    RunFolder,
    replace_folder,
    scratch,
)
from polmvs.poses.metric_frame import Frame, metric_frame, transform_model
from polmvs.scene import match_names, without_views


@dataclass(frozen=True, kw_only=True)
class MetricFrameResult:
    """The metric frame of the model.

    Attributes
    ----------
    source : ``reference``, ``aruco`` or ``scale``.
    scale : metres per unit of the model from SfM.
    relative_sigma : relative standard deviation of the scale; None if unknown.
    rms_residual : residual of the source; see :class:`polmvs.poses.metric_frame.Frame`.
    num_used : number of cameras, views or end points used.
    dropped : names of those that were left out.
    checked_by : scales of the other sources, which agree, by source.
    rotation, translation : of the similarity from the model of SfM, row by row, m.
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
    """Result of the stage.

    Attributes
    ----------
    num_views : images with a pose.
    unregistered : names of images without a pose.
    num_tracks : sparse points.
    frame : the metric frame; None if the model keeps its own frame.
    """

    num_views: int
    unregistered: tuple[str, ...]
    num_tracks: int
    frame: MetricFrameResult | None

    @property
    def is_metric(self) -> bool:
        """Whether the unit is the metre, by a given source."""
        return self.frame is not None

    def __str__(self) -> str:
        total = self.num_views + len(self.unregistered)
        return f"{self.num_views} of {total} views, {self.num_tracks:,} sparse points"


def place_model(
    run_folder: RunFolder,
    names: Iterable[str],
    reference: ReferenceOptions,
    without: Sequence[str],
) -> PosesResult:
    """Transform the model of SfM, or a given one, to the metric frame of the options.

    Parameters
    ----------
    run_folder : with the images, in which markers are searched, and the model of SfM in its own
        frame; the model, the camera's modes and the poses' covariances are written there.
    names : names of the images.
    reference : sources of the frame.
    without : names of images to remove from the model, with or without suffix.

    Raises
    ------
    DataError, OptionError
        A source of the frame, or a name, is unusable; the model of SfM is kept.
    """
    source, names = run_folder.sfm, tuple(names)
    model = read_model(source)
    modes = load_floats(source / CAMERA_MODES)
    covariances = load_floats(source / POSE_COVARIANCES)
    if without:
        named = match_names(without, names)
        for name in without:
            if name not in named:
                raise OptionError(f"{name!r} is no image of the capture.", field="sfm.without")
        model, kept, points = without_views(model, set(named.values()))
        modes = modes[:, points]
        covariances = covariances[kept] if len(covariances) else covariances
    frame = metric_frame(model, reference, lambda name: read_gray(run_folder.images / name))
    if frame is not None:
        similarity = frame.metric_from_world
        model = transform_model(model, similarity)
        rotation = np.asarray(similarity.rotation)
        modes = similarity.scale * modes @ rotation.T
        both = block_diag(rotation, similarity.scale * rotation)
        covariances = both @ covariances @ both.T
    with scratch(run_folder.sparse) as folder:
        if frame is None and not without:  # bit for bit what SfM wrote
            (folder / "sparse").mkdir()
            for file in source.glob("*.bin"):
                write_bytes(folder / "sparse" / file.name, read_bytes(file))
        else:
            write_model(model, folder / "sparse")
        replace_folder(folder / "sparse", run_folder.sparse)
    run_folder.camera_modes.parent.mkdir(exist_ok=True)
    save_array(run_folder.camera_modes, modes)
    save_array(run_folder.pose_covariances, covariances)
    return PosesResult(
        num_views=len(model.views),
        unregistered=tuple(sorted(set(names) - {view.name for view in model.views})),
        num_tracks=len(model.tracks.point3D_ids),
        frame=None if frame is None else _frame_result(frame),
    )


def load_floats(source: Path) -> NDArray[np.float64]:
    """The camera's modes (K, T, 3) at the sparse points, or the covariances of the poses.

    Those are (V, 6, 6), sorted by name; K or V is 0 where nothing is known.
    """
    return np.asarray(map_array(source), np.float64)


def _frame_result(frame: Frame) -> MetricFrameResult:
    similarity = frame.metric_from_world
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
