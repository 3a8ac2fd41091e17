"""Signal heads that are switched from stage to stage, second by second: whatever the wish, never without clearance."""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush
from itertools import count

import numpy as np

from utn_sumo import clearances
from utn_sumo.clearances import Phases, Times
from utn_sumo.contract import Bools, Floats, Ints, Network, View
from utn_sumo.plant.inside import MOST_HOLD_S, Areas, Inside

MOST_PATIENCE_S = 150.0
"""Who has waited so long without green is served next, whatever is wished."""
LONGEST_RED_S = 180.0
"""Where least greens and clearances are long it comes next sooner: nobody is to wait longer than this."""
LOOK_S = 5.0
"""Time between two looks at who waits."""
HOLD_S = 1.0
"""By which a stage begins later as long as somebody is amid the junction."""


class Heads:
    """The signals of a network: the stage of each junction, or the clearance on the way to it."""

    def __init__(self, network: Network, show: Callable[[int, str], None], areas: Areas | None = None):
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
        self._needs = np.hstack([network.serves, _walks(network)])
        """(S, M + walks) which turns and which letters of pedestrians each stage has green for."""
        self._junction = network.stage_junction[self._needs.argmax(axis=0)]
        """(M + walks,) whose stages these are."""
        held_s = np.zeros(len(network.junctions))
        if self._inside is not None:
            held_s += MOST_HOLD_S * self._inside.may_hold()
        least_s = _patience_s(network, held_s[network.stage_junction])
        self._patience_s = np.where(self._needs, least_s[:, None], np.inf).min(axis=0)
        """(M + walks,) how long somebody may wait for each."""
        self._since_s = np.zeros(self._needs.shape[1])
        """(M + walks,) since when somebody has been waiting for each, without green meanwhile."""
        self._stood = np.zeros(self._needs.shape[1], dtype=np.bool_)
        """(M + walks,) whether somebody stood before each at the last look: who creeps on for a moment waits still."""
        self._look_s = 0.0
        """When it is looked again who waits."""
        self._overdue: list[int] = []
        """Stages for who has waited too long, for the longest last."""
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
            if opens and self._inside is not None and self._inside.holds(index, now_s):
                self.begin_s[index] += HOLD_S
                self._ready_s[index] += HOLD_S
                heappush(self._due, (now_s + HOLD_S, index, next(self._numbers), letters, True))
                continue
            self._show(index, letters)
        self.next_s = self._due[0][0] if self._due else np.inf

    def free(self, now_s: float) -> Bools:
        """(J,) junctions whose stage has had its least green: they may go on to another."""
        return np.asarray(now_s >= self._ready_s)

    def patient(self, wish: Ints, view: View) -> Ints:
        """(J,) the wish, but where somebody has waited for too long: whom the longest, is served next."""
        if view.time_s >= self._look_s:
            self._overdue = self._late(view)
            self._look_s = view.time_s + LOOK_S
        if not self._overdue:
            return wish
        kept = wish.copy()
        for stage in self._overdue:
            kept[self.network.stages[stage].junction] = stage
        return kept

    def _late(self, view: View) -> list[int]:
        """Stages for who has waited too long: of those that serve them, the one that most others wait for too."""
        turn_group, present = self.network.turn_group, view.stage[self._junction]
        waits = np.ones(len(self._since_s), dtype=np.bool_)
        # Pedestrians, whom no detector sees, may always be waiting.
        waits[: len(turn_group)] = view.waiting_veh[turn_group] > 0
        self._stood, waits = waits, waits | self._stood
        waits &= ~self._needs[present, np.arange(len(waits))]
        self._since_s[~waits] = view.time_s
        late = np.flatnonzero(self._since_s + self._patience_s <= view.time_s)
        if not len(late):
            return []
        called = self._needs @ waits.astype(np.int64)
        longest_last = sorted(late.tolist(), key=lambda who: -self._since_s[who])
        return [int(np.argmax(np.where(self._needs[:, who], called, -1))) for who in longest_last]

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
            self._inside.leads(index, first, stage, at_s)
        self.stage[index], self.begin_s[index] = stage, at_s
        self._ready_s[index] = at_s + self.network.stages[stage].least_green_s
        self.next_s = now_s
        self.advance(now_s)


def _patience_s(network: Network, held_s: Floats) -> Floats:
    """(S,) how long somebody may wait for each stage until it comes next.

    All others of its junction may have to be shown before, each `held_s` (S,) later than its clearance is over, and
    there is time between two looks.
    """
    until_next_s = network.least_green_s + network.clearance_s + held_s
    others_s = np.bincount(network.stage_junction, until_next_s)[network.stage_junction] - until_next_s
    return np.asarray(np.clip(LONGEST_RED_S - LOOK_S - others_s, LOOK_S, MOST_PATIENCE_S))


def _walks(network: Network) -> Bools:
    """(S, walks) which letters that are no vehicles' each stage has green for."""
    walks = [(index, letter) for index, junction in enumerate(network.junctions) for letter in junction.without_yellow]
    green = [
        [stage.junction == index and stage.state[letter] in clearances.GREEN for index, letter in walks]
        for stage in network.stages
    ]
    return np.reshape(np.array(green, dtype=np.bool_), (len(network.stages), len(walks)))
