"""Who waits amid a junction: turns let in on a green that gives way, for whom no gap has come when it ends.

The net's own programme gives them a stage of their own then. Where that one is left out, the next road's green finds
them in its way, its own turns come to stand beside them, and when those of all roads wait for each other nobody ever
moves again. So while the lane-area detectors amid the junction see several, and turns that are to give way in the next
green are about to come in, the red before it lasts.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from utn_sumo.clearances import GIVES_WAY, GREEN, HAS_WAY, following
from utn_sumo.contract import Bools, Junction, Network

MOST_HOLD_S = 7.0
"""Longer the red is not drawn out: who is still there does not get away by it."""
ALONE_VEH = 1.0
"""Nobody is held for one vehicle: others can turn beside it, and it goes as soon as they do."""


class Areas(Protocol):
    """What it takes to know who waits (plant.eyes)."""

    def amid_veh(self, turn: int) -> float: ...
    def close_veh(self, group: int) -> float: ...


@dataclass(frozen=True)
class Turning:
    """A signal letter that gives way to oncoming traffic in some stage."""

    letter: int
    turns: tuple[int, ...]
    groups: tuple[int, ...]
    """Lane groups from which it comes in."""
    oncoming: tuple[int, ...]
    """Letters that it gives way to."""


@dataclass(frozen=True)
class Way:
    """From one stage to another one."""

    left: tuple[int, ...]
    """Turns that may still be amid the junction, and whom the next stage does not let out."""
    coming: tuple[int, ...]
    """Lane groups of turns that give way in it."""
    until_s: float
    """It begins no later."""


class Inside:
    """Knows who may wait amid each junction, and how long others have to wait for them."""

    def __init__(self, network: Network, areas: Areas):
        self._network = network
        self._areas = areas
        self._turnings = [_turnings(network, junction) for junction in network.junctions]
        self._ways: dict[int, Way] = {}
        """On which each junction came to its present stage."""

    def may_hold(self) -> Bools:
        """(J,) junctions in which somebody may be left."""
        return np.array([len(each) > 0 for each in self._turnings], dtype=np.bool_)

    def leads(self, index: int, first: int, then: int, opens_s: float) -> None:
        """A junction goes from its stage `first` to `then`, which is to begin at `opens_s`."""
        becomes = self._network.stages[then].state
        left = [
            turn
            for each in self._turnings[index]
            if not any(becomes[letter] in GREEN for letter in (each.letter, *each.oncoming))
            for turn in each.turns
        ]
        coming = [group for each in self._turnings[index] if becomes[each.letter] == GIVES_WAY for group in each.groups]
        # To the stage that follows it is the net's own clearance, to the second.
        is_own = then == following(self._network.junctions[index], first)
        self._ways[index] = Way(() if is_own else tuple(left), tuple(coming), opens_s + MOST_HOLD_S)

    def holds(self, index: int, now_s: float) -> bool:
        """Whether the stage that a junction is led to has to wait for somebody."""
        way = self._ways[index]
        return (
            now_s < way.until_s
            and sum(self._areas.amid_veh(turn) for turn in way.left) > ALONE_VEH
            and any(self._areas.close_veh(group) > 0 for group in way.coming)
        )


def _turnings(network: Network, junction: Junction) -> list[Turning]:
    """Those of a junction, by letter."""
    states = [network.stages[stage].state for stage in junction.stages]
    found = []
    for letter, turns in enumerate(junction.signal_turns):
        oncoming = {
            other
            for state in states
            if state[letter] == GIVES_WAY
            for other, has in enumerate(state)
            if has == HAS_WAY and junction.conflicts[letter][other] and junction.signal_turns[other]
        }
        if turns and oncoming:
            groups = {network.turns[turn].group for turn in turns}
            found.append(Turning(letter, turns, tuple(sorted(groups)), tuple(sorted(oncoming))))
    return found
