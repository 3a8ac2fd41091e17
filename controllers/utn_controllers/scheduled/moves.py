"""What moves at a junction in each bin of a stage, and of the clearance from any stage to any other.

Queues of those who speed up slowly start later than others: the first seconds of their green are clearance, too.

Many a clearance is no red for all: vehicles go on while who walks is cleared, a stream that the next stage serves too
keeps its green, another has it a little before its stage.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from utn_controllers.scheduled.calling import Calling
from utn_controllers.scheduled.gaps import Gaps
from utn_controllers.scheduled.streams import Streams
from utn_sumo import clearances
from utn_sumo.clearances import GREEN, Phases, Times
from utn_sumo.contract import CAR_ACCELERATION_M_S2, Bools, Floats, Ints, Network

STARTING_S_M_S2 = 50 / 3.6 / 2
"""Who starts is behind those who drive 50 km/h on by half of the time that it takes to speed up to that."""
ROLLING = 0.5
"""Of those who come from another junction, in platoons that green waits for: they do not start at the line."""
LEAST_BINS, MOST_BINS = 0.25, 5.0
"""What starting takes is nothing where it is less, as for cars with some trucks among them, and never more: schedules
have to reach the stages behind it."""


class Rules(NamedTuple):
    """What junctions (J) may show, by stages (S), and what moves then, by rows (R) of which the first are the stages'.

    Junctions' stages are those of Streams, their streams (A) those of Calling.
    """

    stages: Ints
    """(S,) the network's stage of each row."""
    first_stage: Ints
    """(J + 1,) rows where the junctions' stages begin."""
    first: Ints
    """(J + 1,) where the junctions' streams begin."""
    follows: Bools
    """(S, most stages of a junction) whether its junction's nth may come after a stage."""
    moves: Floats
    """(R, most streams of a junction) share of its discharge that each has."""
    going: Ints
    """(R, most streams of a junction + 1) those that move in a stage, or in the clearance that begins in a row, then
    -1."""
    clearing: Ints
    """(S, most stages of a junction) row of the first bin of the clearance to its junction's nth, -1 if all is red."""
    clearance: Ints
    """(S, most stages of a junction) bins of that clearance: one or more."""
    least: Ints
    """(S,) bins of green, one or more."""
    ahead: Ints
    """(J,) bins that a schedule has."""
    gaps: Gaps


class Moves:
    """Which share of its discharge each stream of a junction has, by bins, in rows (R): the stages', clearances'."""

    def __init__(self, network: Network, streams: Streams | Calling, bin_s: int, alone: Bools):
        """`alone` (J,) are those of `are_alone`: all who come to them start at the line."""
        sizes, most = np.diff(streams.first), int(np.diff(streams.first_stage).max(initial=1))
        owner = network.stage_junction[streams.stage]
        starting_bins = STARTING_S_M_S2 * (1 / network.acceleration_m_s2 - 1 / CAR_ACCELERATION_M_S2) / bin_s
        rows = [
            serves[streams.first[j] : streams.first[j + 1]] for j, serves in zip(owner, streams.serves, strict=True)
        ]
        after = [-1] * len(rows)
        self.row = np.full((len(owner), most), -1)
        """(S, most stages of a junction) where the clearance from a stage to its junction's nth begins, -1: all red."""
        self.bins = np.ones((len(owner), most), dtype=np.int64)
        """(S, most stages of a junction) its bins."""
        self.cleared_bins = self.bins.copy()
        """(S, most stages of a junction) those without who starts slowly."""
        for index, junction in enumerate(network.junctions):
            letters = streams.letters[streams.first[index] : streams.first[index + 1]]
            times = Times.of(network, junction)
            late_bins = starting_bins * (1.0 if alone[index] else 1 - ROLLING)
            for row, first in enumerate(junction.stages, start=streams.first_stage[index]):
                known: dict[bytes, int] = {}
                for place, then in enumerate(junction.stages):
                    if first != then:
                        phases = clearances.between(network, junction, times, first, then)
                        shares = _shares(phases, letters, bin_s)
                        self.cleared_bins[row, place] = len(shares)
                        own = rows[streams.first_stage[index] + place]
                        shares = np.concatenate([shares, _starting(own, rows[row], late_bins)])
                        self.bins[row, place] = len(shares)
                        if shares.any():
                            self.row[row, place] = known.setdefault(shares.tobytes(), len(rows))
                            if self.row[row, place] == len(rows):
                                rows.extend(shares)
                                after.extend([row] * len(shares))
        self.share = np.zeros((len(rows), int(sizes.max(initial=0))))
        """(R, most streams of a junction)."""
        for number, row in enumerate(rows):
            self.share[number, : len(row)] = row
        self.after = np.array(after, dtype=np.int64)
        """(R,) row of the stage that a bin of a clearance follows, -1 in rows of stages."""
        self.held = np.zeros((len(owner), self.share.shape[1]), dtype=np.bool_)
        """(S, most streams of a junction) those that still move in the first bin of some clearance from a stage."""
        for begins in self.row.T:
            self.held |= (begins >= 0)[:, None] & (self.share[begins] > 0)
        self.going = going(self.share, len(owner), self.row, self.bins)
        """(R, most streams of a junction + 1) as in `Rules`."""


def _starting(own: Bools, before: Bools, bins: float) -> Floats:
    """(bins, streams) share of each bin that those have who start in it, and lose so many `bins` by that.

    They are the stage's `own` (streams,); who had green `before` (streams,) goes on.
    """
    bins = min(bins, MOST_BINS)
    many = max(math.ceil(bins - LEAST_BINS), 0)
    going_on = own & before
    return np.tile(np.where(going_on, 1.0, own * max(1 - bins / max(many, 1), 0.0)), (many, 1))


def going(share: Floats, stages: int, row: Ints, bins: Ints) -> Ints:
    """(R, most streams + 1) `Rules.going`, by who moves in each row (R, most streams), of which first are the stages'.

    `row` and `bins` (S, most stages) are those of the clearances.
    """
    who = np.full((len(share), share.shape[1] + 1), -1)
    cleared = row >= 0
    begin = np.append(np.arange(stages), row[cleared])
    end = begin + np.append(np.ones(stages, dtype=np.int64), bins[cleared])
    for first, last in zip(begin, end, strict=True):
        streams = np.flatnonzero(share[first:last].any(axis=0))
        who[first, : len(streams)] = streams
    return who


def _shares(phases: Phases, letters: list[tuple[int, ...]], bin_s: int) -> Floats:
    """(bins, streams) share of each bin of a clearance in which the streams with these letters have green."""
    states = [state for state, seconds in phases for _ in range(round(seconds))]
    bins = max(int(len(states) / bin_s + 0.5), 1)
    # Short ones are rounded up: what they end with goes on.
    states = [*states, *states[-1:] * (bins * bin_s)][: bins * bin_s]
    green = [[bool(own) and all(state[letter] in GREEN for letter in own) for own in letters] for state in states]
    if not green:
        return np.zeros((bins, len(letters)))
    return np.asarray(np.reshape(green, (bins, bin_s, len(letters))).mean(axis=1))
