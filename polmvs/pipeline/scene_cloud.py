"""The cloud of a whole scene: the polarised surfaces and their surroundings, told apart by kind."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from polmvs.colmap.dense_workspace import (
    DenseWorkspace,
    open_dense_workspace,
    require_matching_images,
    require_same_frame,
)
from polmvs.colmap.filling import previous_backups
from polmvs.colmap.models import read_model
from polmvs.config import FusionOptions, Surroundings
from polmvs.io.clouds import Cloud
from polmvs.io.images import read_gray
from polmvs.parallel import Workers
from polmvs.pipeline.run_folder import RunFolder
from polmvs.polarization.capture import DISPLAY_GAMMA
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import PointKind
from polmvs.surface.fusion import FusedCloud
from polmvs.surface.kept_depth import kept_cloud
from polmvs.surface.surroundings import SparseSurroundings, sparse_surroundings, stereo_surroundings

logger = logging.getLogger(__name__)

T = TypeVar("T", bound=np.generic)


def surface_cloud(cloud: FusedCloud, kind: PointKind = PointKind.SURFACE) -> Cloud:
    """A fused cloud as it is written, with grey colours as in COLMAP's images.

    The brightest 1 % are white.
    """
    white = float(np.percentile(cloud.intensity, 99)) if len(cloud.intensity) else 1.0
    share = np.clip(cloud.intensity / max(white, 1e-9), 0, 1) ** (1 / DISPLAY_GAMMA)
    grey = np.rint(255 * share).astype(np.uint8)
    return Cloud(
        points=cloud.points,
        normals=cloud.normals,
        colors=np.repeat(grey[:, None], 3, axis=1),
        scalars={
            "num_views": cloud.num_views,
            "sigma": cloud.sigma,
            "sigma_deg": cloud.sigma_deg,
            "kind": np.full(len(cloud.points), kind, np.float32),
        },
    )


def open_given(workspace: RunFolder, options: FusionOptions) -> DenseWorkspace | None:
    """The COLMAP workspace of the options, found to be of the run's images and model.

    Raises
    ------
    DataError
        It is unusable, or not of these.
    """
    if options.workspace is None:
        return None
    given = open_checked(options.workspace, workspace)
    if backups := previous_backups(given):
        logger.warning(
            "%s: was filled before, and what filled it counts as COLMAP's; the maps from before "
            "are in %s.",
            given.folder,
            backups[0].name,
        )
    return given


def open_checked(folder: Path, workspace: RunFolder) -> DenseWorkspace:
    """A user's COLMAP workspace, found to be of the run's images and model.

    Raises
    ------
    DataError
        It is unusable, or not of these.
    """
    given, model = open_dense_workspace(folder), read_model(workspace.sparse)
    require_same_frame(given, model)
    require_matching_images(given, model, lambda name: read_gray(workspace.images / name))
    return given


def surroundings_cloud(
    workspace: RunFolder,
    surface: FusedCloud,
    maps: Sequence[PhaseMap],
    options: FusionOptions,
    given: DenseWorkspace | None,
    folder: Path,
    *,
    workers: Workers,
) -> Cloud:
    """Points of the scene beside its polarised parts, of the kind that the options ask for.

    Parameters
    ----------
    workspace : with the sparse model.
    surface : of the polarised parts; what COLMAP saw there is left out.
    maps : of all views.
    given : the user's COLMAP workspace, if there is one; its points are the surroundings.
    folder : for what is kept on disk meanwhile.
    """
    if given is not None:
        return surface_cloud(kept_cloud(given, surface.points), PointKind.COLMAP)
    model = read_model(workspace.sparse)
    if options.surroundings is Surroundings.STEREO:
        return surface_cloud(
            stereo_surroundings(model.tracks, maps, folder, workers=workers), PointKind.STEREO
        )
    if options.surroundings is Surroundings.SPARSE:
        return _sparse_cloud(sparse_surroundings(model.tracks, maps))
    return surface_cloud(surface[np.zeros(len(surface.points), np.bool_)])


def _sparse_cloud(sparse: SparseSurroundings) -> Cloud:
    """Sparse points as they are written; they have no normals, which is zero in a PLY file."""
    num = len(sparse.points)
    unknown = np.full(num, np.nan)
    return Cloud(
        points=sparse.points,
        normals=np.zeros((num, 3)),
        colors=sparse.colors,
        scalars={
            "num_views": sparse.num_views,
            "sigma": unknown,
            "sigma_deg": unknown,
            "kind": np.full(num, PointKind.SPARSE, np.float32),
        },
    )


def join_clouds(first: Cloud, second: Cloud) -> Cloud:
    """The points of two clouds with the same columns."""
    return Cloud(
        points=np.concatenate([first.points, second.points]),
        normals=_joined(first.normals, second.normals),
        colors=_joined(first.colors, second.colors),
        scalars={
            name: np.concatenate([values, second.scalars[name]])
            for name, values in first.scalars.items()
        },
    )


def _joined(first: NDArray[T] | None, second: NDArray[T] | None) -> NDArray[T] | None:
    return None if first is None or second is None else np.concatenate([first, second])
