"""Signal heads that are switched from stage to stage, second by second: whatever the wish, never without clearance."""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count

import numpy as np

from utn_sumo import clearances
from utn_sumo.clearances import Phases, Times
from utn_sumo.contract import Bools, Ints, Network
from utn_sumo.plant.freeing import Freeing
from utn_sumo.plant.inside import MOST_HOLD_S, Areas, Inside
from utn_sumo.plant.patience import LONGEST_RED_S, Patience

HOLD_S = 1.0
"""By which a stage begins later for some as long as somebody is amid the junction."""


class Heads:
    """The signals of a network: the stage of each junction, or the clearance on the way to it."""

    def __init__(
        self,
        network: Network,
        show: Callable[[int, str], None],
        areas: Areas | None = None,
        longest_red_s: float = LONGEST_RED_S,
    ):
        """`show` puts letters on the signals of a junction; without `areas` nobody is waited for amid it."""
        self.network = network
        self._show = show
        self._inside = None if areas is None else Inside(network, areas)
        self.stage: Ints = np.array([junction.stages[0] for junction in network.junctions], dtype=np.int64)
        """(J,) stage that each junction shows, or is on its way to."""
        self.begin_s = np.zeros(len(network.junctions))
        """(J,) when it began, or will."""
        self._ready_s = self.network.least_green_s[self.stage]
        """(J,) when it has had its least green."""
        self._ways: dict[tuple[int, int], Phases] = {}
        self._times = [Times.of(network, junction) for junction in network.junctions]
        held_s = np.zeros(len(network.junctions))
        if self._inside is not None:
            held_s += MOST_HOLD_S * self._inside.may_hold()
            yellow_s = [times.yellow_s for times in self._times]
            self._freeing = Freeing(self._inside, yellow_s, network.least_green_s)
        self.patience = Patience(network, held_s, longest_red_s)
        self._due: list[tuple[float, int, int, str, bool]] = []
        """A heap of (time, junction, number, letters, whether its stage begins with them) still to be shown."""
        self._numbers = count()
        self.next_s = np.inf
        """When the next letters are due."""

    def start(self, now_s: float) -> None:
        """Show every junction's first stage."""
        self.begin_s[:] = now_s
        self._ready_s = now_s + self.network.least_green_s[self.stage]
        for index, stage in enumerate(self.stage):
            self._show(index, self.network.stages[stage].state)

    def advance(self, now_s: float) -> None:
        """Show the letters that are due by now."""
        if now_s < self.next_s:
            return
        while self._due and self._due[0][0] <= now_s:
            _, index, _, letters, opens = heappop(self._due)
            waits = self._waits(index, now_s) if opens else None
            if waits is not None:
                self._show(index, waits)
                self.begin_s[index] += HOLD_S
                self._ready_s[index] += HOLD_S
                heappush(self._due, (now_s + HOLD_S, index, next(self._numbers), letters, True))
                continue
            self._show(index, letters)
        self.next_s = self._due[0][0] if self._due else np.inf

    def _waits(self, index: int, now_s: float) -> str | None:
        """Letters of a junction while its stage has to wait for somebody amid it."""
        if self._inside is None:
            return None
        if self._inside.holds(index, now_s):
            return self._inside.meanwhile(index)
        return self._freeing.shows(index, now_s)

    def free(self, now_s: float) -> Bools:
        """(J,) junctions whose stage has had its least green: they may go on to another."""
        return now_s >= self._ready_s

    def switch(self, index: int, stage: int, now_s: float) -> None:
        """Lead a junction that is free to another of its stages."""
        first = int(self.stage[index])
        if (first, stage) not in self._ways:
            junction = self.network.junctions[index]
            self._ways[first, stage] = clearances.between(self.network, junction, self._times[index], first, stage)
        at_s = now_s
        for state, seconds in self._ways[first, stage]:
            heappush(self._due, (at_s, index, next(self._numbers), state, False))
            at_s += seconds
        heappush(self._due, (at_s, index, next(self._numbers), self.network.stages[stage].state, True))
        if self._inside is not None:
            phases = self._ways[first, stage]
            cleared = phases[-1][0] if phases else self.network.stages[first].state
            self._inside.leads(index, first, stage, cleared, at_s)
            self._freeing.leads(index, stage, self.patience.spares(index, now_s, self._freeing.longest_s))
        self.stage[index], self.begin_s[index] = stage, at_s
        self._ready_s[index] = at_s + self.network.stages[stage].least_green_s
        self.next_s = now_s
        self.advance(now_s)
