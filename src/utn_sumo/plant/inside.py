"""Who waits amid a junction: turns let in on a green that gives way, for whom no gap has come when it ends.

The net's own programme gives them a stage of their own then. Where that one is left out, the next road's green finds
them in its way, its own turns come to stand beside them, and when those of all roads wait for each other nobody ever
moves again. So the red before such a green lasts until they can have gone. That costs time at every change of stages
and is seldom needed: it is done where a green has been seen once that nobody could use.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from utn_sumo.clearances import GREEN, following
from utn_sumo.contract import Floats, Junction, Network, View

GIVES_WAY, HAS_WAY = "g", "G"
CROSSING_S = 2.5
"""From the stop line until the last of the oncoming traffic is past."""
FOLLOWING_S = 1.5
"""Until each of those who wait has gone after it."""
MOST_VEH = 3.0
"""That wait before one road's stop line and amid the junction."""
MOST_HOLD_S = 6.0
"""Longer the red is not drawn out: who is still there does not get away by it."""
UNUSED_LOOKS = 2
"""As often in a row nobody has used a green before which somebody stands, and somebody is in the way."""


class Loops(Protocol):
    """What it takes to know who waits (plant.eyes)."""

    def gap_one_s(self, group: int) -> float: ...
    def left_one_veh(self, group: int, time_s: float) -> float: ...


@dataclass(frozen=True)
class Turning:
    """A turn that gives way in a stage, from lanes of its own."""

    letter: int
    groups: tuple[int, ...]
    oncoming: tuple[int, ...]
    """Letters that it gives way to."""
    oncoming_groups: tuple[int, ...]


class Inside:
    """Knows who may wait amid each junction, and how long others have to wait for them."""

    def __init__(self, network: Network, loops: Loops):
        self._network = network
        self._loops = loops
        self._turnings: dict[int, tuple[Turning, ...]] = {}
        """Of each stage, as they are asked for."""
        self._before_veh: dict[int, float] = {}
        """By lane group who had left it when its junction's green began."""
        self._way: dict[int, tuple[Turning, ...]] = {}
        """Who may be left behind on the way to each junction's present stage."""
        self._until_s: dict[int, float] = {}
        self._veh: dict[int, float] = {}
        """How many had come in when it opened."""
        self._unused: dict[int, int] = {}
        """How often in a row nobody had used its green when each junction was looked at."""
        self._left_veh: Floats | None = None
        self._looked_s = 0.0
        self.blocked: set[int] = set()
        """Junctions in which somebody has been in the way."""

    def leads(self, index: int, first: int, then: int, opens_s: float) -> None:
        """A junction goes from its stage `first` to `then`, which is to begin at `opens_s`."""
        becomes = self._network.stages[then].state
        follows = following(self._network.junctions[index], first)
        # To the stage that follows it is the net's own clearance, to the second.
        self._way[index] = tuple(
            each
            for each in self._of(index, first)
            if then != follows and not any(becomes[letter] in GREEN for letter in (each.letter, *each.oncoming))
        )
        self._until_s[index] = opens_s + MOST_HOLD_S

    def holds(self, index: int, now_s: float) -> bool:
        """Whether the stage that a junction is led to has to wait for somebody."""
        came = [(each, self._entered_veh(each, now_s)) for each in self._way.get(index, ())]
        self._veh[index] = max((veh for _, veh in came), default=0.0)
        if index not in self.blocked or now_s >= self._until_s[index]:
            return False
        return any(veh > 0 and self._gap_s(each) < CROSSING_S + FOLLOWING_S * min(veh, MOST_VEH) for each, veh in came)

    def opens(self, index: int, stage: int, now_s: float) -> None:
        """A junction's stage begins."""
        for each in self._of(index, stage):
            for group in each.groups:
                self._before_veh[group] = self._loops.left_one_veh(group, now_s)

    def look(self, view: View) -> bool:
        """Whether somebody has been found in the way of a green, in a junction where nobody had been before."""
        asked = [index for index, way in self._way.items() if way and index not in self.blocked]
        if not asked:
            return False
        for index in asked:
            self._unused[index] = self._unused.get(index, 0) + 1 if self._is_unused(index, view) else 0
        self._left_veh, self._looked_s = view.left_veh.copy(), view.time_s
        found = [index for index in asked if self._unused[index] >= UNUSED_LOOKS]
        self.blocked.update(found)
        return bool(found)

    def _is_unused(self, index: int, view: View) -> bool:
        """Whether somebody stands before a green that nobody has used since the last look, and turns had come in."""
        if self._left_veh is None or self._looked_s <= view.begin_s[index] or self._veh.get(index, 0.0) <= 0:
            return False
        state = self._network.stages[view.stage[index]].state
        has_way = [letter for letter, shown in enumerate(state) if shown == HAS_WAY]
        groups = self._groups(self._network.junctions[index], has_way)
        return any(view.waiting_veh[group] >= 1 and view.left_veh[group] == self._left_veh[group] for group in groups)

    def _entered_veh(self, each: Turning, now_s: float) -> float:
        """Who has come in since the green began."""
        left = self._loops.left_one_veh
        return sum(left(group, now_s) - self._before_veh.get(group, 0.0) for group in each.groups)

    def _gap_s(self, each: Turning) -> float:
        """Since the last of the oncoming traffic."""
        return min(self._loops.gap_one_s(group) for group in each.oncoming_groups)

    def _of(self, index: int, stage: int) -> tuple[Turning, ...]:
        if stage not in self._turnings:
            self._turnings[stage] = tuple(
                self._found(self._network.junctions[index], self._network.stages[stage].state)
            )
        return self._turnings[stage]

    def _found(self, junction: Junction, state: str) -> list[Turning]:
        """The turnings of a stage."""
        found = []
        for letter, shown in enumerate(state):
            groups = self._groups(junction, [letter])
            if shown != GIVES_WAY or not groups:
                continue
            others = [
                other
                for other, turns in enumerate(junction.signal_turns)
                if any(self._network.turns[turn].group in groups for turn in turns)
            ]
            oncoming = [
                other for other, has in enumerate(state) if has == HAS_WAY and junction.conflicts[letter][other]
            ]
            oncoming_groups = self._groups(junction, oncoming)
            # In a lane that others share nobody is left behind alone: they stand behind him, and are seen.
            if oncoming_groups and all(state[other] == GIVES_WAY for other in others):
                found.append(Turning(letter, groups, tuple(oncoming), oncoming_groups))
        return found

    def _groups(self, junction: Junction, letters: list[int]) -> tuple[int, ...]:
        """Lane groups of letters."""
        turns = (turn for letter in letters for turn in junction.signal_turns[letter])
        return tuple(sorted({self._network.turns[turn].group for turn in turns}))
