"""Check of the angle convention of the polarization against the planes of incidence of many views.

Three wrong settings mirror all phases or turn them by 45 degrees: an order of the polarizers that
is wrong but still pairs perpendicular ones, clockwise angles, and another zero direction. Neither
the sums of the samples nor a single view shows such an error. Many views do: with wrong angles, the
planes of incidence of a point do not intersect in one normal. (A rotation by 90 degrees is
equivalent to the other kind of light.)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from polmvs.arrays import Array
from polmvs.config import (
    CaptureKind,
    CaptureOptions,
    NormalOptions,
)
from polmvs.fitting import BEYOND_CHANCE
from polmvs.normals.mixture_estimator import solve_mixture
from polmvs.normals.observations import gather_observations_under
from polmvs.normals.rows import AS_MEASURED, Reading
from polmvs.normals.tracks import evenly_chosen, matched_views, tracks_on_parts
from polmvs.polarization.kinds import AngleModel
from polmvs.polarization.phase_map import PhaseMap
from polmvs.scene import Tracks, some_tracks

MIRRORED: Reading = ((1, 0), (0, -1))
TURNED: Reading = ((0, 1), (-1, 0))  # by 45 degrees
TURNED_MIRRORED: Reading = ((0, 1), (1, 0))
CHANGES = (MIRRORED, TURNED, TURNED_MIRRORED)


@dataclass(frozen=True, kw_only=True)
class VoteTolerances:
    """Tolerances of the decision for another setting of angles or of light than the given one.

    Attributes
    ----------
    max_points : points that vote on angles. Guess: more cost time only.
    min_rows : of a point that votes on angles. Derived: three rows determine a normal and leave one
        to check it.
    min_votes : least number of votes. Guess.
    min_share : least share of them for the other setting. Guess.
    min_gain : least mean vote on angles, log-likelihood of a row. Guess: noise alone gives a few
        hundredths.
    """

    max_points: int = 400
    min_rows: int = 4
    min_votes: int = 8
    min_share: float = 0.7
    min_gain: float = 0.2


TOL = VoteTolerances()


@dataclass(frozen=True, kw_only=True)
class AxesCheck:
    """Angle convention that the planes of incidence show.

    Attributes
    ----------
    num_votes : sparse points that vote.
    share : share of them for the best of the other conventions.
    change : that convention; None if the given one is right or the vote is unclear.
    """

    num_votes: int
    share: float
    change: Reading | None

    def message(self, options: CaptureOptions, kind: CaptureKind) -> str:
        """One line for the user.

        Parameters
        ----------
        options : of the opened capture.
        kind : of its files.
        """
        begin = (
            f"under other angles the planes of incidence of all views meet better for "
            f"{100 * self.share:.0f} % of the {self.num_votes} sparse points on the part"
        )
        assert self.change is not None
        # Of two settings that can be wrong, the one that was changed is the likely one.
        if kind is CaptureKind.MOSAIC and not (options.clockwise or options.zero_deg):
            given = ",".join(map(str, options.pattern))
            likely = ",".join(map(str, changed_pattern(options.pattern, self.change)))
            return (
                f"`capture.pattern` {given} does not fit: {begin}. Give `capture.pattern` {likely}"
            )
        mirrored = self.change in (MIRRORED, TURNED_MIRRORED)
        name = "clockwise" if mirrored else "zero_deg"
        hint = "the other way round" if mirrored else "45 degrees more or less"
        return f"`capture.{name}` does not fit: {begin}. Give `capture.{name}` {hint}"


def check_axes(tracks: Tracks, maps: Sequence[PhaseMap]) -> AxesCheck:
    """Let the sparse points vote on the angle convention.

    Parameters
    ----------
    tracks : sparse points; ``obs_view`` counts in ``maps``.
    maps : phase maps of the views.
    """
    on_parts = tracks_on_parts(tracks, maps)
    chosen = evenly_chosen(len(on_parts.points_in_world), TOL.max_points)
    some, options = some_tracks(on_parts, chosen), NormalOptions()
    # Under both kinds of light, which a rotation of all angles by 90 degrees exchanges.
    ways = (AS_MEASURED, *CHANGES)
    readings = [r for (a, b), (c, d) in ways for r in (((a, b), (c, d)), ((-a, -b), (-c, -d)))]
    observed = gather_observations_under(
        readings, AngleModel.PPA, some.points_in_world, maps, window_px=options.window_px
    )
    matched = matched_views(some, len(maps))
    num_rows = (matched & np.isfinite(observed[0].turn_variances[0])).sum(axis=0)
    found = np.stack([solve_mixture(one, matched).log_likelihood for one in observed])
    found /= np.maximum(num_rows, 1)
    likelihoods = np.maximum(found[::2], found[1::2])  # (conventions, N), of a row
    given, *changed = likelihoods
    # A point that no convention explains does not vote.
    voting = (num_rows >= TOL.min_rows) & (np.max(likelihoods, axis=0) > TOL.min_gain)
    best = AxesCheck(num_votes=int(voting.sum()), share=0.0, change=None)
    most = TOL.min_gain
    for change, likelihood in zip(CHANGES, changed, strict=True):
        votes = (likelihood - given)[voting]
        if is_clear(votes) and votes.mean() > most:
            share = float(np.mean(votes > 0))
            best, most = AxesCheck(num_votes=len(votes), share=share, change=change), votes.mean()
    return best


def is_clear(votes: Array) -> bool:
    """Whether the votes (N,) of points are clearly for another setting: most, and strongly.

    Strongly means: not by chance, in standard errors of the mean. Right settings of nine captures
    had -2.3 to -46. Points on one surface see the same light, so their votes are not independent,
    and the limit remains a guess.
    """
    if len(votes) < TOL.min_votes:
        return False
    error = float(votes.std(ddof=1)) / np.sqrt(len(votes))
    return bool(votes.mean() > BEYOND_CHANCE * error and np.mean(votes > 0) > TOL.min_share)


def changed_pattern(
    pattern: tuple[int, int, int, int], change: Reading
) -> tuple[int, int, int, int]:
    """The order of polarizers that gives the changed Stokes parameters.

    Two orders differ by a rotation of all angles by 90 degrees, which is equivalent to the other
    kind of light. The sensors' usual order is preferred, else the one nearer to the given order.
    """
    (a, b), (c, d) = change
    # The place of the polarizer at angle x measures s0 + cos 2x s1 + sin 2x s2 in the given Stokes
    # parameters, and the same in the right ones.
    found = []
    for sign in (1, -1):
        places = []
        for angle in pattern:
            x, y = round(np.cos(2 * np.radians(angle))), round(np.sin(2 * np.radians(angle)))
            new = sign * (a * x + b * y), sign * (c * x + d * y)
            places.append(int(np.degrees(np.arctan2(new[1], new[0])) / 2 % 180))
        found.append((places[0], places[1], places[2], places[3]))
    usual = CaptureOptions().pattern
    if usual in found:
        return usual
    return max(found, key=lambda p: sum(x == y for x, y in zip(p, pattern, strict=True)))
