"""Specular or diffuse: which reflection dominates the polarisation of each part of a region.

The two differ by a quarter turn of the phase, so the wrong choice puts every plane of incidence
at a right angle to the true one. One view cannot tell; three or more can, because wrong planes of
incidence do not meet in one normal. Every sparse point on a part votes with the likelihoods of
its two best normals; the degree of polarisation has a say where points are few (specular light is
polarised up to wholly, diffuse light of a smooth dielectric hardly over 0.4).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from polmvs.camera import sample_image
from polmvs.config import AngleModel, NormalOptions
from polmvs.normals.estimator import NormalEstimate
from polmvs.normals.tracks import inside_shares, normals_from_windows, window_map
from polmvs.polarization.phase_map import PhaseMap, turned
from polmvs.scene import Tracks, some_tracks

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

MIN_ROWS = 3  # of a track that votes
MAX_ROW_COST = 4.0  # of one row, so that a single one cannot outvote the others
DIFFUSE_DOLP = 0.4  # largest DoLP of diffuse light from a smooth dielectric of ior 1.5
DOLP_VOTES = 20.0  # log-likelihood that a clearly higher DoLP is worth


def find_diffuse(tracks: Tracks, maps: Sequence[PhaseMap]) -> list[Mask]:
    """Pixels of each view whose light is diffuse-dominant.

    Every connected part of a view's region is decided as a whole, by the points that project
    into it. Parts without points go with the majority of the capture.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``.
    maps : phase maps built under the assumption of specular light.

    Returns
    -------
    One ``(H, W)`` bool mask for each map.
    """
    options = NormalOptions()
    tracks = some_tracks(tracks, inside_shares(tracks, maps, margin_px=1) > 0)
    windows = [window_map(phase_map, options.window_px) for phase_map in maps]
    opposite = [turned(m, np.ones(m.region.inside.shape, bool)) for m in windows]
    specular = normals_from_windows(AngleModel.PPA, tracks, windows, options.estimator)
    diffuse = normals_from_windows(AngleModel.PPA, tracks, opposite, options.estimator)
    votes, voting = specular_votes(specular, diffuse)
    overall = float(votes[voting].sum()) + _dolp_votes(maps)
    return [_diffuse_parts(m, tracks, votes, voting, overall) for m in maps]


def specular_votes(specular: NormalEstimate, diffuse: NormalEstimate) -> tuple[Array, Mask]:
    """Log-likelihood of specular over diffuse light for each track, and which tracks have a say.

    Parameters
    ----------
    specular, diffuse : normals of the same tracks from rows under either assumption.
    """
    # The robust weight is 1 / (1 + z^2 / c^2): minus its logarithm is the row's Cauchy cost.
    cost = [
        np.minimum(-np.log(np.maximum(e.row_weights, 1e-6)), MAX_ROW_COST)
        for e in (specular, diffuse)
    ]
    compared = (specular.row_weights > 0) & (diffuse.row_weights > 0)
    votes = ((cost[1] - cost[0]) * compared).sum(axis=0)
    voting = (
        specular.valid
        & diffuse.valid
        & (np.maximum(specular.num_rows, diffuse.num_rows) >= MIN_ROWS)
    )
    return np.asarray(votes, np.float64), voting


def _dolp_votes(maps: Sequence[PhaseMap]) -> float:
    """What the highest degrees of polarisation of the capture speak for."""
    highest = []
    for phase_map in maps:
        reliable = phase_map.region.reliable
        if reliable.any():
            axial = phase_map.samples[reliable][:, :2]
            highest.append(float(np.percentile(np.linalg.norm(axial, axis=-1), 90)))
    if not highest:
        return 0.0
    excess = (max(highest) - DIFFUSE_DOLP) / DIFFUSE_DOLP
    return float(np.clip(excess, -1, 1) * DOLP_VOTES)


def _diffuse_parts(
    phase_map: PhaseMap, tracks: Tracks, votes: Array, voting: Mask, overall: float
) -> Mask:
    """Connected parts of the view's region that their points, or the majority, call diffuse."""
    inside = phase_map.region.inside
    num, labels = cv2.connectedComponents(inside.astype(np.uint8), connectivity=4)
    in_cam = phase_map.view.cam_from_world * tracks.points_in_world[voting]
    xy = phase_map.view.camera.project(in_cam)
    part = sample_image(labels.astype(np.float32), xy, nearest=True).astype(np.int64)
    specular = np.bincount(part, votes[voting], minlength=num)
    count = np.bincount(part, minlength=num)
    # A part of its own mind needs several points; else it follows the capture.
    verdict = np.where(count >= MIN_ROWS, specular, overall)
    verdict = verdict + np.sign(overall) * 1e-9
    return np.asarray((verdict < 0)[labels] & inside)
