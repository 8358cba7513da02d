"""Poses of a COLMAP model in the world of the truth, to run the experiments with."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from polmvs.colmap.models import match_model_to_capture, read_model
from polmvs.errors import DataError
from polmvs.geometry import RigidTransform, SimilarityTransform
from polmvs.io.ground_truth import GroundTruth
from polmvs.polarization.capture import Capture
from polmvs.poses.alignment import AlignmentReport, align_to_truth
from polmvs.scene import View, short_list


def estimated_views(
    sparse: Path, capture: Capture, truth: GroundTruth, names: Sequence[str]
) -> tuple[list[View], AlignmentReport]:
    """Views of a COLMAP model in the world of the truth, aligned by the camera centres.

    Parameters
    ----------
    truth : of which the cameras are used.
    names : of the truth's images that the capture has; views come in their order.

    Raises
    ------
    DataError
        The model is of other images, or some of its poses are wrong.
    """
    model = match_model_to_capture(
        read_model(sparse), names, capture.width, capture.height, source=sparse
    )
    truth_from_world, report = align_to_truth(model.views, truth)
    if report.dropped:
        raise DataError(
            sparse,
            f"poses of {short_list(report.dropped)} do not match the true ones; give a model "
            "of this capture without wrongly registered images.",
        )
    views = [_in_truth(view, truth_from_world) for view in model.views]
    return sorted(views, key=lambda view: names.index(view.name)), report


def _in_truth(view: View, truth_from_world: SimilarityTransform) -> View:
    """A view of the estimated world in the true one; its camera frame is scaled to metres."""
    rotation = view.cam_from_world.rotation @ truth_from_world.rotation.T
    translation = truth_from_world.scale * view.cam_from_world.translation
    shifted = translation - rotation @ truth_from_world.translation
    return replace(view, cam_from_world=RigidTransform(rotation, shifted))
