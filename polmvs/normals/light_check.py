"""Check of the kind of light that a user states against the planes of incidence."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from polmvs.normals.axes_check import is_clear
from polmvs.normals.light import track_votes
from polmvs.normals.tracks import tracks_on_parts
from polmvs.polarization.kinds import Light
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import Tracks


@dataclass(frozen=True, kw_only=True)
class LightCheck:
    """Votes of the sparse points on the polarized surfaces for the kind of light.

    Attributes
    ----------
    given : by the user.
    num_votes : sparse points that vote.
    share : share of them that vote for the other kind of light.
    contradicted : whether the vote against the given light is clear.
    """

    given: Light
    num_votes: int
    share: float
    contradicted: bool

    @property
    def message(self) -> str:
        """One line for the user about the contradiction."""
        other = Light.DIFFUSE if self.given is Light.SPECULAR else Light.SPECULAR
        return (
            f"`region.light` {self.given} does not fit: under {other} light the planes of "
            f"incidence of all views meet better for {100 * self.share:.0f} % of the "
            f"{self.num_votes} sparse points on the part. Give `region.light` {other}, or leave it "
            "out"
        )


def check_light(tracks: Tracks, maps: Sequence[PhaseMap], given: Light) -> LightCheck:
    """Compare the light that a user gave with the votes of the sparse points.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``.
    maps : phase maps of the views.
    """
    votes, voting = track_votes(tracks_on_parts(tracks, maps), maps)
    votes = votes[voting] if given is Light.SPECULAR else -votes[voting]
    num = len(votes)
    contradicted = is_clear(-votes)
    share = float(np.mean(votes < 0)) if num else 0.0
    return LightCheck(given=given, num_votes=num, share=share, contradicted=contradicted)
