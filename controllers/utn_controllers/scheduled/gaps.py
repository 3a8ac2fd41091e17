"""Who has green and must give way to what comes towards him: he goes in its gaps.

While the queue towards him goes there are none. Then the fewer come the more there are, as with Poisson traffic in
which each gap must last some time (the Highway Capacity Manual's permitted turns), so that a green is worth most when
it has lasted. Behind who waits stand all on his lane. A lane goes until somebody comes to the front who finds no gap,
and again when he has found one; whether it goes at present shows in who has gone since the last look.

Where another stage of the junction has a lane set to itself, yielding.py has learnt what it does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from utn_controllers.scheduled.flows import Gone
from utn_controllers.scheduled.standstill import Shown
from utn_controllers.scheduled.streams import Streams
from utn_sumo.clearances import GIVES_WAY, HAS_WAY
from utn_sumo.compiling import compiled, inlined
from utn_sumo.contract import Bools, Floats, Ints, Network

GAP_S = 4.0
"""How long there must be nobody: what drivers take, and SUMO's."""
START_S = 2.0
"""From a green's begin until who goes says whether a lane does: the first is counted when his back has gone by."""


class Gaps(NamedTuple):
    """Who waits for gaps in stages (S), by streams of a junction."""

    waiting: Floats
    """(S, most streams of a junction) share of its lane set that waits for gaps: 0 where nobody does."""
    stops: Floats
    """(S, most streams of a junction) of those the ones that come to the front of a lane in a bin while it goes."""
    foes: Ints
    """(S, most streams of a junction, most foes + 1) streams of the junction in whose gaps it goes, then -1."""
    some: Bools
    """(S,) whether anybody waits for gaps."""
    per_veh: float
    """By what power of e fewer go for each vehicle in a bin that comes towards them."""


class Giving:
    """Keeps which share of each lane set waits for gaps."""

    def __init__(self, network: Network, streams: Streams, learnt: Bools, bin_s: float, discharge: float):
        """But for the lane sets whose discharge in a stage is `learnt` (S, L); `discharge` over saturation flow."""
        self._streams = streams
        lanes = np.array([len(each.lanes) for each in network.lane_sets])
        self._lane_veh = discharge * network.set_saturation_flow_veh_s * bin_s / lanes
        """(L,) vehicles that leave each lane in a bin while it goes."""
        self._waits = np.zeros((len(streams.stage), len(streams.way_stream)), dtype=np.bool_)
        """(S, V) signalled ways that wait for gaps in a stage."""
        foes: dict[tuple[int, int], set[int]] = {}
        self._first_way = np.searchsorted(streams.way_stream, streams.first)
        """(J + 1,) where the junctions' ways begin."""
        for row, stage in enumerate(streams.stage):
            junction = network.stage_junction[stage]
            for way in range(*self._first_way[junction : junction + 2]):
                stream = streams.way_stream[way]
                if streams.serves[row, stream] and not learnt[row, streams.lane_set[stream]]:
                    own = _foes(network, streams, row, int(stage), way)
                    self._waits[row, way] = len(own) > 0
                    foes.setdefault((row, int(streams.lane_set[stream])), set()).update(own)
        most = max((len(own) for own in foes.values()), default=0)
        shape = len(streams.stage), int(np.diff(streams.first).max(initial=0))
        self.gaps = Gaps(
            np.zeros(shape),
            np.zeros(shape),
            np.full((*shape, most + 1), -1),
            np.zeros(shape[0], dtype=np.bool_),
            GAP_S / bin_s,
        )
        self.is_needed = bool(self._waits.any())
        """Whether anybody waits for gaps."""
        for row, stage in enumerate(streams.stage):
            first, last = streams.first[network.stage_junction[stage] :][:2]
            for stream in first + np.flatnonzero(streams.serves[row, first:last]):
                found = sorted(foes.get((row, int(streams.lane_set[stream])), ()))
                self.gaps.foes[row, stream - first, : len(found)] = np.array(found, dtype=np.int64) - first

    def take_up(self, of_set: Floats) -> None:
        """Go by these shares (V,) that signalled ways have of their lane sets' traffic from now on."""
        streams = self._streams
        for junction, (first, last) in enumerate(zip(streams.first[:-1], streams.first[1:], strict=True)):
            ways = slice(*self._first_way[junction : junction + 2])
            alike = streams.lane_set[first:last, None] == streams.lane_set[streams.way_stream[ways]]
            for row in range(*streams.first_stage[junction : junction + 2]):
                own = alike @ (of_set[ways] * self._waits[row, ways]) * streams.serves[row, first:last]
                self.gaps.waiting[row, : last - first] = own
                lane_veh = self._lane_veh[streams.lane_set[first:last]]
                self.gaps.stops[row, : last - first] = np.minimum(own * lane_veh, 1.0)
                self.gaps.some[row] = (own > 0).any()

    def look(self, view: Shown, asked: Bools, present: Ints, gone: Gone) -> Floats:
        """(N,) share of their lanes that go at present, by who has `gone` before the junctions `asked` (J,).

        `present` (J,) is the row of each junction's stage.
        """
        streams = self._streams
        return np.asarray(
            _going(
                view.time_s, asked, present, view.begin_s, gone.share, gone.queued, gone.since_s, streams.first,
                streams.lane_set, self.gaps.waiting,
            )
        )  # fmt: skip


@compiled
def _going(
    time_s: float, asked: Bools, present: Ints, begin_s: Floats, gone: Floats, queued: Bools, since_s: Floats,
    first: Ints, stream_set: Ints, waiting: Floats,
) -> Floats:  # fmt: skip
    pace = np.ones(len(stream_set))
    for junction in range(len(asked)):
        if asked[junction]:
            for stream in range(first[junction], first[junction + 1]):
                lane_set = stream_set[stream]
                is_told = queued[lane_set] and time_s - since_s[lane_set] >= begin_s[junction] + START_S
                if is_told and waiting[present[junction], stream - first[junction]] > 0:
                    pace[stream] = min(gone[lane_set], 1.0)
    return pace


def _foes(network: Network, streams: Streams, row: int, stage: int, way: int) -> set[int]:
    """Streams that have way in a stage over a signalled way that must give it."""
    shown = network.stages[stage]
    conflicts = network.junctions[shown.junction].conflicts
    giving = [letter for letter in streams.way_letters[way] if shown.state[letter] == GIVES_WAY]
    others = range(streams.first[shown.junction], streams.first[shown.junction + 1]) if giving else ()
    return {
        stream
        for stream in others
        if streams.serves[row, stream]
        for other in streams.letters[stream]
        if shown.state[other] == HAS_WAY and any(conflicts[letter][other] for letter in giving)
    }


@inlined
def opens_at(row: int, gaps: Gaps, pace: Floats) -> None:
    """Sets the `pace` (n,) of `let_go` as the green of a stage, the `row`, begins: who is in front may wait already."""
    for stream in range(len(pace)):
        pace[stream] = 1 - gaps.waiting[row, stream]


@compiled
def let_go(
    row: int, bin_: int, veh: Floats, come: Floats, most: Floats, moves: Floats, going: Ints, gaps: Gaps,
    pace: Floats, want: Floats,
) -> None:  # fmt: skip
    """Brings the vehicles `veh` (n,) of those who have green in a stage, the `row`, up to the end of a bin.

    `pace` (n,) is the share of their lanes that those have who wait for gaps, in front of which nobody does, kept from
    bin to bin of a green; `want` (n,) is room for who would go.
    """
    place = 0
    while going[row, place] >= 0:
        stream = going[row, place]
        veh[stream] += come[stream, bin_]
        want[stream] = min(veh[stream], moves[row, stream] * most[stream] * pace[stream])
        place += 1
    place = 0
    while going[row, place] >= 0:
        stream = going[row, place]
        if gaps.waiting[row, stream] > 0:
            towards, foe = 0.0, 0
            while gaps.foes[row, stream, foe] >= 0:
                towards += want[gaps.foes[row, stream, foe]]
                foe += 1
            found, before = np.exp(-gaps.per_veh * towards), pace[stream]
            pace[stream] += (1 - before) * found - before * gaps.stops[row, stream] * (1 - found)
            leaves = moves[row, stream] * most[stream] * (before + pace[stream]) / 2
            veh[stream] = max(veh[stream] - leaves, 0.0)
        else:
            veh[stream] -= want[stream]
        place += 1
