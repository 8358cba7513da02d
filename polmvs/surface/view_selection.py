"""Selection of the views that see another view's points from widely different directions."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from polmvs.geometry import unit_or_zero
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import Seeds
from polmvs.surface.pixel_graph import visible_seeds

MAX_PLACES = 64  # largest number of a view's seeds, spread evenly, for the choice


def choose_neighbors(maps: Sequence[PhaseMap], seeds: Seeds, max_neighbors: int) -> list[list[int]]:
    """For each view itself, then the others, the most useful first.

    The choice is greedy: the next view sees most of the view's seeds under the largest angles to
    all views chosen before. Planes of incidence determine a normal if they intersect at large
    angles; the nearest views of a dense ring are redundant.

    Parameters
    ----------
    maps : phase maps of the views.
    seeds : points on the surface. A view that sees none gets views that see any.
    max_neighbors : largest number of others for each view.
    """
    seen = np.array([visible_seeds(m, seeds)[0] for m in maps], bool).reshape(len(maps), -1)
    centers = np.array([m.view.center_in_world for m in maps])
    to_camera = unit_or_zero(centers[:, None] - seeds.points_in_world)
    neighbors = []
    for k in range(len(maps)):
        places = np.flatnonzero(seen[k] if seen[k].any() else seen.any(axis=0))
        places = places[:: max(1, len(places) // MAX_PLACES)]
        directions, shows = to_camera[:, places], seen[:, places]
        chosen = [k]
        gap = np.full(shows.shape, np.inf)
        for _ in range(min(max_neighbors, len(maps) - 1)):
            apart = 1 - (directions * directions[chosen[-1]]).sum(axis=-1)
            gap = np.minimum(gap, apart)
            score = (gap * shows).sum(axis=1)
            score[chosen] = -np.inf
            chosen.append(int(score.argmax()))
        neighbors.append(chosen)
    return neighbors
