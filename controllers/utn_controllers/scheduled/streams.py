"""Streams: what queues in one lane group, goes to one next link, and has green in the same stages."""

from __future__ import annotations

import numpy as np

from utn_sumo.contract import Floats, Network


class Streams:
    """The streams of a network (N), one junction's after the other's, and its stages (S) in the same order.

    Turns that no signal stops are in none.
    """

    def __init__(self, network: Network):
        self._turn_group = network.turn_group
        stages = [stage for junction in network.junctions for stage in junction.stages]
        self.stage = np.array(stages, dtype=np.int64)
        """(S,) the network's stage of each row."""
        self.first_stage = np.cumsum([0, *(len(junction.stages) for junction in network.junctions)])
        """(J + 1,) rows where the junctions' stages begin."""
        place: dict[tuple[int, int, int, bytes], int] = {}
        turn_junction = network.link_junction[network.turn_link]
        signalled = np.flatnonzero(~network.unsignalled)
        self._turns = signalled[np.argsort(turn_junction[signalled], kind="stable")]
        of_turn = []
        for turn in self._turns:
            key = (
                int(turn_junction[turn]),
                int(network.turn_group[turn]),
                int(network.turn_next[turn]),
                network.serves[:, turn].tobytes(),
            )
            of_turn.append(place.setdefault(key, len(place)))
        self._of_turn = np.array(of_turn, dtype=np.int64)
        one = self._turns[np.unique(self._of_turn, return_index=True)[1]]
        self.group = network.turn_group[one]
        """(N,) lane group that each queues in."""
        self.link = network.turn_link[one]
        """(N,)"""
        self.next_link = network.turn_next[one]
        """(N,) link that each feeds, or EXIT."""
        self.first = np.searchsorted(turn_junction[one], np.arange(len(network.junctions) + 1))
        """(J + 1,) where the junctions' streams begin."""
        self.serves = network.serves[np.ix_(self.stage, one)]
        """(S, N) whether a stage gives a stream green."""
        letters: list[set[int]] = [set() for _ in one]
        stream_of = dict(zip(self._turns.tolist(), of_turn, strict=True))
        for junction in network.junctions:
            for letter, turns in enumerate(junction.signal_turns):
                for turn in turns:
                    letters[stream_of[turn]].add(letter)
        self.letters = [tuple(sorted(own)) for own in letters]
        """(N,) the letters of its junction that each has green by."""

    def shares(self, fraction: Floats) -> tuple[Floats, Floats]:
        """(N,) each stream's share of its link's traffic, and of its lane group's, by the turning fractions (M,)."""
        of_link = np.bincount(self._of_turn, fraction[self._turns], len(self.link)).astype(float)
        of_group = np.bincount(self._turn_group, fraction)[self.group]
        return of_link, of_link / np.maximum(of_group, 1e-9)
