"""Greens that end early: a plan's greens are upper bounds, and what a stage does not use later ones of its cycle may.

Every stage has a time in the cycle by which it ends at the latest, where the plan has its end. It ends before that
when nobody has come over its stop line for a while and somebody is before another stage, and the next one begins
earlier with its own end where it was. So no cycle lasts longer than the plan's, whatever was used of it.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from utn_sumo.callers import served
from utn_sumo.contract import Ints, Junction, Network, Plan, State, View


class ActuatedSettings(BaseModel):
    """Settings of the execution `actuated`."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)

    gap_s: float = Field(2.0, gt=0, le=60)
    """Time without a vehicle at the stop line that ends a green [s]. Of 1.5, 2, 2.5, 3 and 4 the one with least delay
    on `utn17`; SUMO's own actuated signals have 3 s, but from loops 2 s before the stop line."""


@dataclass(frozen=True)
class _Way:
    """From one stage to another one of its junction."""

    stage: int
    callers: tuple[int, ...]
    """People, bicycles and trams whom it serves and the first stage does not."""
    calls: tuple[int, ...]
    """Lane groups that need it: the first stage has no protected green for them."""
    serves: tuple[int, ...]
    """All lane groups that it serves."""
    dry: tuple[int, ...]
    """Lane groups that lose their green, or its protection: nobody must come on these."""


class Actuated:
    """Ends greens early when nobody comes: the plan's greens are upper bounds, in the order of its stages."""

    Settings = ActuatedSettings

    def __init__(self, network: Network, **settings: float):
        self.every_s = 1.0
        self.gap_s = ActuatedSettings(**settings).gap_s
        self.network = network
        self._ways: dict[int, tuple[_Way, ...]] = {}
        self._place: dict[int, int] = {}
        """Of each stage its place in the cycle."""
        for junction in network.junctions:
            self._ways |= _ways(network, junction)
            self._place |= {stage: place for place, stage in enumerate(junction.stages)}
        self._stage = [junction.stages[0] for junction in network.junctions]
        """Of each junction the stage last seen."""
        self._cycle_s = [0.0] * len(network.junctions)
        """When its cycle began, and later by what it has rested."""
        self._wake_s = [0.0] * len(network.junctions)
        """Until when nothing can change."""
        self._end_s: list[float] = []
        """Of each stage by when in the cycle it ends."""

    def begin(self, plan: Plan, state: State) -> None:  # noqa: ARG002 - what is to be seen now says more
        """Take up the ends of a new plan's stages, in the cycle that is under way."""
        self._end_s = (self.network.since_cycle_start_s(plan.green_s) + plan.green_s).tolist()
        self._wake_s = [0.0] * len(self._wake_s)

    def wish(self, view: View) -> Ints:
        """(J,) the present stages, but the next one where a green is over."""
        wish, now_s, stages, wake_s = view.stage, view.time_s, view.stage.tolist(), self._wake_s
        for index in view.free.nonzero()[0].tolist():
            present = stages[index]
            if present != self._stage[index]:
                if self._place[present] <= self._place[self._stage[index]]:
                    self._cycle_s[index] = float(view.begin_s[index])
                self._stage[index] = present
            elif now_s < wake_s[index]:
                continue
            then, wake_s[index] = self._next(view, index, present)
            if then != present:
                # Mostly nothing changes, and the present stages themselves say so.
                wish = wish.copy() if wish is view.stage else wish
                wish[index] = then
        return wish

    def _next(self, view: View, index: int, present: int) -> tuple[int, float]:
        """The stage that a junction is to show, and until when that can't change."""
        end_s = self._cycle_s[index] + self._end_s[present]
        late = view.time_s >= end_s
        for way in self._ways[present]:
            if any(view.calling[caller] > 0 for caller in way.callers):
                break
            if any(view.near_one_veh(group) > 0 for group in (way.serves if late else way.calls)):
                break
        else:
            # With nobody elsewhere the cycle's time stands still.
            self._cycle_s[index] += self.every_s
            return present, 0.0
        if not late:
            for group in way.dry:
                gap_s = view.gap_one_s(group)
                if gap_s < self.gap_s:
                    return present, min(view.time_s + self.gap_s - gap_s, end_s)
        return way.stage, 0.0


def _ways(network: Network, junction: Junction) -> dict[int, tuple[_Way, ...]]:
    """Of each stage the ways to the others, in the order of the cycle."""
    stages = junction.stages
    serves = {stage: _groups(network, network.stages[stage].turns) for stage in stages}
    called = served(network)
    protected = {stage: _groups(network, _protected(network, junction, stage)) for stage in stages}

    def way(first: int, then: int) -> _Way:
        item = network.stages[then]
        held = {turn for turns in item.held for turn in turns}
        everyone = serves[then] | _groups(network, held)
        return _Way(
            then,
            tuple(np.flatnonzero(called[then] & ~called[first]).tolist()),
            tuple(sorted(everyone - protected[first])),
            tuple(sorted(everyone)),
            tuple(sorted(serves[first] - protected[then])),
        )

    return {
        first: tuple(way(first, then) for then in (*stages[place + 1 :], *stages[:place]))
        for place, first in enumerate(stages)
    }


def _groups(network: Network, turns: Iterable[int]) -> set[int]:
    """Lane groups of turns."""
    return {network.turns[turn].group for turn in turns}


def _protected(network: Network, junction: Junction, stage: int) -> set[int]:
    """Turns that need yield to nobody in a stage."""
    letters = zip(network.stages[stage].state, junction.signal_turns, strict=True)
    return {turn for letter, turns in letters if letter == "G" for turn in turns}
