"""Stage ``box``: check that the crop box holds part of the scene.

It runs as soon as the poses are known, before the surface is made.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from polmvs.colmap.models import read_model
from polmvs.config import CropOptions
from polmvs.io.images import read_gray
from polmvs.pipeline.run_folder import RunFolder
from polmvs.poses.crop_box import CropBox, crop_box
from polmvs.scene import View

logger = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class BoxResult:
    """Result of the stage.

    Attributes
    ----------
    num_points : sparse points in the box.
    num_all : sparse points of the model.
    """

    num_points: int
    num_all: int

    def __str__(self) -> str:
        return f"{self.num_points:,} of {self.num_all:,} sparse points in the box"


def find_box(
    folder: RunFolder, views: Sequence[View], crop: CropOptions, aruco: str | None
) -> CropBox | None:
    """The box of the options in the world of a run, whose images show the markers."""
    return crop_box(crop, aruco, views, lambda name: read_gray(folder.images / name))


def check_box(folder: RunFolder, crop: CropOptions, aruco: str | None) -> BoxResult:
    """Check a box against the sparse points.

    Parameters
    ----------
    folder : of a run with images and model.
    crop, aruco : the box, and the markers (``DICT:SIZE``) that it may be relative to.

    Raises
    ------
    OptionError
        No camera sees the box, or its marker is not found.
    """
    model = read_model(folder.sparse)
    box = find_box(folder, model.views, crop, aruco)
    assert box is not None  # else the stage is not wanted
    points = model.tracks.points_in_world
    centers = np.array([view.center_in_world for view in model.views])
    kept = box.require_possible(points, centers)
    if not kept.any():
        logger.warning(
            "`crop.box` holds no sparse point: it may hold a surface without marks, or nothing."
        )
    return BoxResult(num_points=int(kept.sum()), num_all=len(points))
