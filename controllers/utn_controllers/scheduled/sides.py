"""Who waits on side roads: streams after those of motor traffic, for whom a junction keeps gaps in what it lets go.

At a node without signals behind a junction they wait for gaps in what that lets onto their main road. A stage that lets
little onto it makes one, a little later. Whether that is what they wait for is seen: how many of them go by then, and
otherwise.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np

from utn_controllers.scheduled.streams import Streams
from utn_sumo.clearances import GREEN
from utn_sumo.compiling import compiled
from utn_sumo.contract import Bools, Floats, Ints, Network

FEW = 0.3
"""A stage that lets so much of the traffic onto their main road, or less, makes gaps."""
PRIOR_BINS = 30.0
"""Of somebody waiting, over which they are thought to go as often by either until something else is seen."""
FORGET_BINS = 450.0
"""Of somebody waiting, over how many what was seen is forgotten."""
LEAST, MOST = 0.2, 0.6
"""By how much fewer go otherwise, in shares, than in gaps: where it is less they wait for something else, where it is
more for nothing else."""


class Seen(Protocol):
    """What of a View is looked at here."""

    def side_standing_veh(self, roads: Bools) -> Floats: ...

    def side_left_veh(self, roads: Bools) -> Floats: ...


class Sides:
    """The streams of those on side roads (E), one a junction and choice of stages that make gaps."""

    def __init__(self, network: Network, streams: Streams, bin_s: int):
        serves = {way: _makes_gaps(network, streams, *way) for way in _ways(network)}
        places: dict[tuple[int, bytes], int] = {}
        pairs = []
        for road, side in enumerate(network.side_roads):
            for junction, to_edge, after_s in side.behind:
                own = serves[junction, to_edge]
                rows = own[slice(*streams.first_stage[junction : junction + 2])]
                if rows.any() and not rows.all():
                    stream = places.setdefault((junction, own.tobytes()), len(places))
                    # Let go by all signals that they wait for, or by none.
                    pairs.append((stream, road, junction, round(after_s / bin_s) + 1, 1 / len(side.behind)))
        columns = list(zip(*pairs, strict=True)) or [()] * 5
        self._stream, self._road, self._junction, self._late = (np.array(c, dtype=np.int64) for c in columns[:4])
        """(P,) each side road with each stream that it is part of, and after how many bins stages are seen there."""
        self._share = np.array(columns[4], dtype=np.float64)
        """(P,) what somebody counts."""
        self.junction = np.array([junction for junction, _ in places], dtype=np.int64)
        """(E,)."""
        kept = [np.frombuffer(own, dtype=np.bool_) for _, own in places]
        self.serves = np.reshape(np.array(kept, dtype=np.bool_), (len(places), len(streams.stage))).T
        """(S, E) whether a stage makes gaps for a stream."""
        lanes = np.array([len(network.edge_lanes[side.edge]) for side in network.side_roads], dtype=np.float64)
        self.most = np.bincount(self._stream, lanes[self._road], len(places)).astype(np.float64)
        """(E,) who go in a bin: one a lane."""
        self._shown = np.full((int(self._late.max(initial=0)) + 1, len(network.junctions)), -1)
        """(bins, J) rows of the stages shown, -1 before the run; the latest takes the place of the oldest."""
        self._now = 0
        """Place of the latest."""
        self._waited = np.zeros((len(pairs), 2))
        """(P, 2) bins in which somebody waited, without gaps from the junction and with them."""
        self._gone = np.zeros((len(pairs), 2))
        """(P, 2) who went in these."""
        self._own = np.isin(np.arange(len(network.side_roads)), self._road)
        """(R,) side roads of which it depends on signals whether somebody waits."""
        self._before = np.zeros(len(network.side_roads)), np.zeros(len(network.side_roads))
        """(R,) who stood a bin ago, and had left by then where anybody stood."""
        # Have the machine code made now, not when somebody comes.
        self._waiting(*self._before, self._before[0])

    def __len__(self) -> int:
        return len(self.junction)

    def look(self, view: Seen, present: Ints) -> Floats:
        """(E,) vehicles that wait for gaps; `present` are the rows (J,) of the stages shown. A bin has gone by."""
        if not len(self):
            return np.zeros(0)
        self._now = (self._now + 1) % len(self._shown)
        self._shown[self._now] = present
        stood, had_left = self._before
        stand = view.side_standing_veh(self._own)
        asked = (stand > 0) | (stood > 0)
        if not asked.any():
            return np.zeros(len(self))
        left = view.side_left_veh(asked)
        self._before = stand, left
        return self._waiting(stand, stood, left - had_left)

    def _waiting(self, stand: Floats, stood: Floats, gone: Floats) -> Floats:
        veh: Floats = _waiting(
            stand, stood, gone, self._shown, self._now, self.serves, self._stream, self._road, self._junction,
            self._late, self._share, self._waited, self._gone, len(self),
        )  # fmt: skip
        return veh


def _ways(network: Network) -> list[tuple[int, str]]:
    """Junctions and the edges behind them on which side roads end."""
    return sorted({(junction, edge) for side in network.side_roads for junction, edge, _ in side.behind})


def _makes_gaps(network: Network, streams: Streams, junction: int, to_edge: str) -> Bools:
    """(S,) whether a stage lets few onto the edge."""
    own = network.junctions[junction]
    flow = {
        turn: network.turns[turn].fraction * network.links[network.turns[turn].link].lanes
        for turn in network.turns_of[junction].tolist()
        if network.turns[turn].to_edge == to_edge
    }
    few = np.zeros(len(streams.stage), dtype=np.bool_)
    for row in range(*streams.first_stage[junction : junction + 2]):
        state = network.stages[streams.stage[row]].state
        shown = zip(state, own.signal_turns, strict=True)
        green = {turn for letter, turns in shown if letter in GREEN for turn in turns}
        few[row] = sum(flow[turn] for turn in sorted(flow.keys() & green)) <= FEW * sum(flow.values())
    return few


@compiled
def _waiting(
    stand: Floats, stood: Floats, gone: Floats, shown: Ints, now: int, serves: Bools, stream: Ints, road: Ints,
    junction: Ints, late: Ints, share: Floats, waited: Floats, went: Floats, streams: int,
) -> Floats:  # fmt: skip
    veh = np.zeros(streams)
    for pair in range(len(stream)):
        own, row = road[pair], shown[now - late[pair], junction[pair]]
        if stood[own] > 0 and row >= 0:
            with_gaps = int(serves[row, stream[pair]])
            for kind in range(2):
                waited[pair, kind] *= 1 - 1 / FORGET_BINS
                went[pair, kind] *= 1 - 1 / FORGET_BINS
            waited[pair, with_gaps] += 1
            went[pair, with_gaps] += gone[own]
        if stand[own] > 0:
            usual = went[pair].sum() / max(waited[pair].sum(), 1.0)
            often = (went[pair] + PRIOR_BINS * usual) / (waited[pair] + PRIOR_BINS)
            if often[1] > 0:
                fewer = 1 - often[0] / often[1]
                veh[stream[pair]] += share[pair] * stand[own] * min(max((fewer - LEAST) / (MOST - LEAST), 0.0), 1.0)
    return veh
