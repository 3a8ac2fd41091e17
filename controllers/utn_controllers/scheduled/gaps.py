"""Who has green and must give way to what comes towards him: he goes in its gaps.

While the queue towards him goes there are none. Then the fewer come the more there are, as with Poisson traffic in
which each gap must last some time (the Highway Capacity Manual's permitted turns), so that a green is worth most when
it has lasted. Behind who waits stand all on his lane: it goes by as much faster as fewer of it wait.

Where another stage of the junction has a lane set to itself, yielding.py has learnt what it does.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.clearances import GIVES_WAY, HAS_WAY
from utn_sumo.compiling import compiled
from utn_sumo.contract import Bools, Floats, Ints, Network

GAP_S = 4.0
"""How long there must be nobody: what drivers take, and SUMO's."""


class Gaps(NamedTuple):
    """Who waits for gaps in stages (S), by streams of a junction."""

    waiting: Floats
    """(S, most streams of a junction) share of its lane set that waits for gaps: 0 where nobody does."""
    foes: Ints
    """(S, most streams of a junction, most foes + 1) streams of the junction in whose gaps it goes, then -1."""
    some: Bools
    """(S,) whether anybody waits for gaps."""
    per_veh: float
    """By what power of e fewer go for each vehicle in a bin that comes towards them."""


class Giving:
    """Keeps which share of each lane set waits for gaps."""

    def __init__(self, network: Network, streams: Streams, learnt: Bools, bin_s: float, most: int):
        """But for lane sets whose discharge in a stage is `learnt` (S, L). No junction has more than `most` streams."""
        self._streams = streams
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
        shape, most_foes = (len(streams.stage), most), max((len(own) for own in foes.values()), default=0)
        self.gaps = Gaps(
            np.zeros(shape), np.full((*shape, most_foes + 1), -1), np.zeros(shape[0], dtype=np.bool_), GAP_S / bin_s
        )
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
                self.gaps.some[row] = (own > 0).any()


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


@compiled
def let_go(
    row: int, bin_: int, veh: Floats, come: Floats, most: Floats, moves: Floats, going: Ints, gaps: Gaps,
    pace: Floats, want: Floats,
) -> None:  # fmt: skip
    """Brings the vehicles `veh` (n,) of those who have green in a stage, the `row`, up to the end of a bin.

    `pace` (n,) is which share of their discharge those have who wait for gaps, kept from bin to bin of a green: 1
    before its first; `want` (n,) is room for who would go.
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
            pace[stream] = min(np.exp(-gaps.per_veh * towards) / gaps.waiting[row, stream], 1.0)
            veh[stream] = max(veh[stream] - moves[row, stream] * most[stream] * pace[stream], 0.0)
        else:
            veh[stream] -= want[stream]
        place += 1
