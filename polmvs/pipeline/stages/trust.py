"""Stage ``trust_MODEL``: what a reconstruction says about itself, and what of it is not normal."""

from __future__ import annotations

import logging
from pathlib import Path

from polmvs.config import AngleModel
from polmvs.evaluation.trust import Trust, measure_trust
from polmvs.io.clouds import read_cloud
from polmvs.pipeline.stages.maps import open_maps
from polmvs.scene import PointKind

logger = logging.getLogger(__name__)


def find_trust(
    model: AngleModel, *, sparse: Path, maps: Path, sparse_cloud: Path, cloud: Path
) -> Trust:
    """Measure a dense cloud against its capture, and warn of what is not normal.

    Parameters
    ----------
    model : angle model.
    sparse : folder of the COLMAP model.
    maps : folder of the phase maps for ``model``.
    sparse_cloud, cloud : PLY of the sparse points with normals and of the dense cloud.
    """
    dense = read_cloud(cloud)
    trust = measure_trust(model, dense, read_cloud(sparse_cloud), open_maps(sparse, maps, model))
    if (dense.scalars["kind"] == PointKind.SURFACE).any():  # else the job says what is missing
        for doubt in trust.doubts():
            logger.warning("%s: not normal: %s.", model, doubt)
    return trust
