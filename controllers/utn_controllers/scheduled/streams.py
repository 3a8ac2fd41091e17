"""Streams: what queues in one lane set, goes to one next link, and has green in the same stages."""

from __future__ import annotations

from itertools import combinations
from typing import NamedTuple

import numpy as np

from utn_sumo.clearances import GREEN
from utn_sumo.compiling import compiled
from utn_sumo.contract import Bools, Floats, Ints, LaneSet, Network

ROUNDS = 20
"""Over the turns that have a choice of lanes: after so many the lanes' loads are as even as they get."""


RESERVED = 0.05
"""Of what a lane for all has of traffic that one for buses has."""


class Shares(NamedTuple):
    """Of traffic."""

    of_link: Floats
    """(N,) that each stream has of its link's."""
    of_set: Floats
    """(N,) of its lane set's."""
    way_of_set: Floats
    """(V,) that each way with a signal has of its lane set's."""
    set_of_link: Floats
    """(L,) that each lane set has of its link's."""


class Streams:
    """The streams of a network (N), one junction's after the other's, and its stages (S) in the same order.

    Turns that no signal stops are in none.
    """

    def __init__(self, network: Network):
        stages = [stage for junction in network.junctions for stage in junction.stages]
        self.stage = np.array(stages, dtype=np.int64)
        """(S,) the network's stage of each row."""
        self.first_stage = np.cumsum([0, *(len(junction.stages) for junction in network.junctions)])
        """(J + 1,) rows where the junctions' stages begin."""
        self._lanes = np.array([_taken(lane_set) for lane_set in network.lane_sets])
        """(L,) by which those share traffic that has the choice."""
        ways = [
            (lane_set, turn, letters)
            for lane_set, each in enumerate(network.lane_sets)
            for turn, letters in zip(each.turns, each.letters, strict=True)
        ]
        self._way_set = np.array([lane_set for lane_set, _, _ in ways], dtype=np.int64)
        self._way_turn = np.array([turn for _, turn, _ in ways], dtype=np.int64)
        """(W,) lane set and turn of each way from the one to the other."""
        self._choices = _choices(self._way_turn)
        """(C, 2) ways between which a turn has the choice."""
        junction = network.link_junction[network.set_link[self._way_set]]
        signalled = np.flatnonzero([len(letters) > 0 for _, _, letters in ways])
        self._signalled = signalled[np.argsort(junction[signalled], kind="stable")]
        """Ways with a signal, in the order of their streams."""
        place: dict[tuple[int, int, bytes], int] = {}
        own: list[set[int]] = []
        serving: list[Bools] = []
        of_way = []
        for way in self._signalled:
            lane_set, turn, letters = ways[way]
            own_rows = range(*self.first_stage[junction[way] : junction[way] + 2])
            serves = _serves(network, self.stage, own_rows, letters)
            stream = place.setdefault((lane_set, int(network.turn_next[turn]), serves.tobytes()), len(place))
            if stream == len(own):
                own.append(set())
                serving.append(serves)
            own[stream] |= set(letters)
            of_way.append(stream)
        self.way_stream = np.array(of_way, dtype=np.int64)
        """(V,) stream of each way with a signal."""
        self.way_letters = [ways[way][2] for way in self._signalled]
        """(V,) the letters of its junction that it has green by."""
        one = self._signalled[np.unique(self.way_stream, return_index=True)[1]]
        self.lane_set = self._way_set[one]
        """(N,) lane set that each queues in."""
        self.group = network.set_group[self.lane_set]
        """(N,) lane group that this is of."""
        self.link = network.set_link[self.lane_set]
        """(N,)"""
        self.next_link = network.turn_next[self._way_turn[one]]
        """(N,) link that each feeds, or EXIT."""
        self.first = np.searchsorted(junction[one], np.arange(len(network.junctions) + 1))
        """(J + 1,) where the junctions' streams begin."""
        self.serves: Bools = np.array(serving, dtype=np.bool_).reshape(len(one), len(stages)).T
        """(S, N) whether a stage gives a stream green."""
        self.letters = [tuple(sorted(each)) for each in own]
        """(N,) the letters of its junction that each has green by."""

    @property
    def way_turn(self) -> Ints:
        """(V,) the turn of each way with a signal."""
        return self._way_turn[self._signalled]

    def shares(self, fraction: Floats) -> Shares:
        """The shares of traffic by the turning fractions (M,): who has a choice of lanes takes the emptier ones."""
        sets = len(self._lanes)
        of_way = _spread(self._way_set, self._way_turn, self._choices, fraction, self._lanes)
        load = np.bincount(self._way_set, of_way, sets).astype(float)
        signalled = of_way[self._signalled]
        of_link = np.bincount(self.way_stream, signalled, len(self.link)).astype(float)
        least = np.maximum(load, 1e-9)
        way_of_set = signalled / least[self.lane_set[self.way_stream]]
        return Shares(of_link, of_link / least[self.lane_set], way_of_set, load)


def _taken(lane_set: LaneSet) -> float:
    return len(lane_set.lanes) * (RESERVED if lane_set.is_reserved else 1.0)


def _choices(way_turn: Ints) -> Ints:
    """(C, 2) pairs of ways of one turn, by the turns (W,) of all."""
    by_turn: dict[int, list[int]] = {}
    for way, turn in enumerate(way_turn.tolist()):
        by_turn.setdefault(turn, []).append(way)
    pairs = [pair for each in by_turn.values() for pair in combinations(each, 2)]
    return np.array(pairs, dtype=np.int64).reshape(-1, 2)


def _serves(network: Network, stages: Ints, rows: range, letters: tuple[int, ...]) -> Bools:
    """(S,) stages, of those of a junction in its `rows`, that show one of these letters green."""
    serves = np.zeros(len(stages), dtype=np.bool_)
    for row in rows:
        state = network.stages[stages[row]].state
        serves[row] = any(state[letter] in GREEN for letter in letters)
    return serves


@compiled
def _spread(way_set: Ints, way_turn: Ints, choices: Ints, fraction: Floats, lanes: Floats) -> Floats:
    """(W,) share of its link's traffic on each way, of lane sets (W,) to turns (W,), so that lanes have even loads."""
    ways = np.zeros(len(fraction))
    for turn in way_turn:
        ways[turn] += 1
    share, load = np.empty(len(way_set)), np.zeros(len(lanes))
    for way, turn in enumerate(way_turn):
        share[way] = fraction[turn] / ways[turn]
        load[way_set[way]] += share[way]
    for _ in range(ROUNDS if len(choices) else 0):
        for choice in range(len(choices)):
            one, other = choices[choice]
            here, there = way_set[one], way_set[other]
            more = (load[here] / lanes[here] - load[there] / lanes[there]) / (1 / lanes[here] + 1 / lanes[there])
            moved = min(max(more, -share[other]), share[one])
            share[one] -= moved
            share[other] += moved
            load[here] -= moved
            load[there] += moved
    return share
