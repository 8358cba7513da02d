"""Which other views help a view: those that see its places, from directions far apart."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from polmvs.geometry import unit_or_zero
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import Seeds
from polmvs.surface.pixel_graph import visible_seeds

MAX_PLACES = 64  # of a view's seeds, spread evenly, that the choice is made for


def choose_neighbors(maps: Sequence[PhaseMap], seeds: Seeds, max_neighbors: int) -> list[list[int]]:
    """For each view, itself first, then others, the most helpful first.

    One after the other the view is taken that sees most of the view's seeds under the greatest
    angles to all views taken before: planes of incidence determine a normal where they cross
    each other at wide angles, and of a dense ring of views the nearest ones say the same.

    Parameters
    ----------
    maps : phase maps of the views.
    seeds : places on the surface. A view that sees none is helped by those that see any.
    max_neighbors : others per view.
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
