"""Signal heads that are switched from stage to stage, second by second: whatever the wish, never without clearance."""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count

import numpy as np

from utn_sumo import clearances
from utn_sumo.clearances import Phases, Times
from utn_sumo.contract import Bools, Floats, Ints, Network, Stage, View

MOST_PATIENCE_S = 150.0
"""A stage that somebody has waited for so long comes next, whatever is wished."""
LONGEST_RED_S = 180.0
"""Where least greens and clearances are long it comes next sooner: nobody is to wait longer than this."""
LOOK_S = 5.0
"""Time between two looks at who waits."""


class Heads:
    """The signals of a network: the stage of each junction, or the clearance on the way to it."""

    def __init__(self, network: Network, show: Callable[[int, str], None]):
        """`show` puts letters on the signals of a junction."""
        self.network = network
        self._show = show
        self.stage: Ints = np.array([junction.stages[0] for junction in network.junctions], dtype=np.int64)
        """(J,) stage that each junction shows, or is on its way to."""
        self.begin_s = np.zeros(len(network.junctions))
        """(J,) when it began, or will."""
        self._ready_s = self.network.least_green_s[self.stage]
        """(J,) when it has had its least green."""
        self._ways: dict[tuple[int, int], Phases] = {}
        self._times = [Times.of(network, junction) for junction in network.junctions]
        self._patience_s = _patience_s(network)
        self._called_s = np.zeros(len(network.stages))
        """(S,) since when somebody has been waiting for each stage."""
        self._look_s = 0.0
        """When it is looked again who waits."""
        self._overdue: list[int] = []
        """Stages that somebody has waited for too long, the longest last."""
        self._due: list[tuple[float, int, int, str]] = []
        """A heap of (time, junction, number, letters) still to be shown."""
        self._numbers = count()
        self.next_s = np.inf
        """When the next letters are due."""
        self._served = np.sign(network.serves.astype(float) @ _turn_groups(network))
        """(S, G) 1 where a stage lets a lane group go."""
        self._walked = np.array([_is_walked(network, stage) for stage in network.stages])
        """(S,) stages in which pedestrians go, whom no detector sees."""

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
            _, index, _, letters = heappop(self._due)
            self._show(index, letters)
        self.next_s = self._due[0][0] if self._due else np.inf

    def free(self, now_s: float) -> Bools:
        """(J,) junctions whose stage has had its least green: they may go on to another."""
        return np.asarray(now_s >= self._ready_s)

    def patient(self, wish: Ints, view: View) -> Ints:
        """(J,) the wish, but for stages that somebody has waited for too long: these come next, the longest first."""
        if view.time_s >= self._look_s:
            called = self._walked | (self._served @ view.waiting_veh > 0)
            called[view.stage] = False
            self._called_s[~called] = view.time_s
            late = np.flatnonzero(self._called_s + self._patience_s <= view.time_s)
            self._overdue = sorted(late.tolist(), key=lambda stage: -self._called_s[stage])
            self._look_s = view.time_s + LOOK_S
        if not self._overdue:
            return wish
        kept = wish.copy()
        for stage in self._overdue:
            kept[self.network.stages[stage].junction] = stage
        return kept

    def switch(self, index: int, stage: int, now_s: float) -> None:
        """Lead a junction that is free to another of its stages."""
        first = int(self.stage[index])
        if (first, stage) not in self._ways:
            junction = self.network.junctions[index]
            self._ways[first, stage] = clearances.between(self.network, junction, self._times[index], first, stage)
        at_s = now_s
        for state, seconds in self._ways[first, stage]:
            heappush(self._due, (at_s, index, next(self._numbers), state))
            at_s += seconds
        heappush(self._due, (at_s, index, next(self._numbers), self.network.stages[stage].state))
        self.stage[index], self.begin_s[index] = stage, at_s
        self._ready_s[index] = at_s + self.network.stages[stage].least_green_s
        self.next_s = now_s
        self.advance(now_s)


def _patience_s(network: Network) -> Floats:
    """(S,) how long somebody may wait for each stage until it comes next.

    All others of its junction may have to be shown before, and there is time between two looks.
    """
    until_next_s = network.least_green_s + network.clearance_s
    others_s = np.bincount(network.stage_junction, until_next_s)[network.stage_junction] - until_next_s
    return np.asarray(np.clip(LONGEST_RED_S - LOOK_S - others_s, LOOK_S, MOST_PATIENCE_S))


def _turn_groups(network: Network) -> Floats:
    """(M, G) 1 where a turn queues in a lane group."""
    return np.equal.outer(network.turn_group, np.arange(len(network.groups))).astype(float)


def _is_walked(network: Network, stage: Stage) -> bool:
    """Whether a stage has green for letters that are no vehicles'."""
    letters = network.junctions[stage.junction].without_yellow
    return any(stage.state[letter] in clearances.GREEN for letter in letters)
