"""Who waits amid a junction: known where a green was of no use, let out before the next road's green."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.unit.views import scene
from utn_sumo.contract import Network
from utn_sumo.plant.heads import LONGEST_RED_S, LOOK_S, Heads
from utn_sumo.plant.inside import CROSSING_S, FOLLOWING_S, MOST_HOLD_S, UNUSED_LOOKS, Inside

StreetOf = Callable[[Callable[[Path], Any]], Network]


class Traffic:
    """Loops of which it is said what they see; nobody has ever come unless it is."""

    def __init__(self) -> None:
        self.gap_s: dict[int, float] = defaultdict(lambda: 1000.0)
        self.left_veh: dict[int, float] = defaultdict(float)

    def gap_one_s(self, group: int) -> float:
        return self.gap_s[group]

    def left_one_veh(self, group: int, time_s: float) -> float:
        return self.left_veh[group]


class Crossing:
    """A junction whose left turns give way in the stage `through`, are alone in the next, and red in `across`."""

    def __init__(self, network: Network):
        self.network = network
        stages = [network.stages[stage].state for stage in network.junctions[0].stages]
        place = next(place for place, state in enumerate(stages) if "g" in state)
        self.through, self.alone, self.across = (
            network.junctions[0].stages[(place + step) % len(stages)] for step in range(3)
        )
        self.loops = Traffic()
        self.inside = Inside(network, self.loops)
        shown = network.stages[self.through].state
        self.turning, self.oncoming = (
            sorted(
                {
                    network.turns[turn].group
                    for letter, turns in zip(shown, network.junctions[0].signal_turns, strict=True)
                    for turn in turns
                    if letter == has
                }
            )
            for has in "gG"
        )

    def change(self, then: int, *, came: float = 2.0, gap_s: float = 0.5) -> None:
        """The stage `through`, in which so many came in from every turning lane, and the way to the next."""
        self.inside.opens(0, self.through, 0.0)
        for group in self.turning:
            self.loops.left_veh[group] += came
        for group in self.oncoming:
            self.loops.gap_s[group] = gap_s
        self.inside.leads(0, self.through, then, 23.0)

    def stand(self, looks: int, left_veh: float = 0.0) -> bool:
        """Whether somebody is found in the way, if all stand before `across`, so many leaving between two looks."""
        self.inside.holds(0, 23.0)
        found = []
        for look in range(looks + 1):
            view = scene(self.network, 25.0 + LOOK_S * look, np.array([self.across]), veh=1.0)
            view = replace(view, begin_s=np.array([23.0]), left_veh=view.left_veh + look * left_veh)
            found.append(self.inside.look(view))
        return any(found)


@pytest.fixture
def crossing(street_of: StreetOf) -> Crossing:
    return Crossing(street_of(odd_nets.actuated_left_turns))


def test_a_green_that_nobody_uses_twice_in_a_row_has_somebody_in_its_way(crossing: Crossing) -> None:
    crossing.change(crossing.across)
    assert not crossing.stand(UNUSED_LOOKS - 1)
    crossing.change(crossing.across)
    assert crossing.stand(UNUSED_LOOKS)
    assert crossing.inside.blocked == {0}


def test_nobody_is_in_the_way_where_traffic_moves_or_nobody_came_in(crossing: Crossing) -> None:
    crossing.change(crossing.across)
    assert not crossing.stand(4 * UNUSED_LOOKS, left_veh=1.0)
    crossing.change(crossing.across, came=0.0)
    assert not crossing.stand(4 * UNUSED_LOOKS)


def test_to_the_turns_own_stage_it_is_the_nets_clearance(crossing: Crossing) -> None:
    crossing.inside.blocked.add(0)
    crossing.change(crossing.alone)
    assert not crossing.inside.holds(0, 23.0)


def test_nothing_is_held_before_somebody_has_been_in_the_way(crossing: Crossing) -> None:
    crossing.change(crossing.across)
    assert not crossing.inside.holds(0, 23.0)


@pytest.mark.parametrize("came", [1, 2, 3, 9])
def test_the_red_lasts_until_those_inside_can_have_gone(came: int, crossing: Crossing) -> None:
    crossing.inside.blocked.add(0)
    needed_s = CROSSING_S + FOLLOWING_S * min(came, 3)
    for gap_s in (needed_s - 0.1, needed_s):
        crossing.change(crossing.across, came=came, gap_s=gap_s)
        assert crossing.inside.holds(0, 23.0) == (gap_s < needed_s)
    crossing.change(crossing.across, came=came, gap_s=0.0)
    # Oncoming traffic that stands on its loops does not end it never.
    assert crossing.inside.holds(0, 23.0 + MOST_HOLD_S - 1)
    assert not crossing.inside.holds(0, 23.0 + MOST_HOLD_S)


def test_nobody_is_held_for_those_who_have_gone_or_were_never_there(crossing: Crossing) -> None:
    crossing.inside.blocked.add(0)
    crossing.change(crossing.across, came=0.0)
    assert not crossing.inside.holds(0, 23.0)
    crossing.change(crossing.across, came=3.0, gap_s=30.0)
    assert not crossing.inside.holds(0, 23.0)


def test_a_stage_that_is_held_begins_later_and_has_its_least_green_all_the_same(crossing: Crossing) -> None:
    shown: list[tuple[int, str]] = []
    now = 0
    network = crossing.network
    heads = Heads(network, lambda _, letters: shown.append((now, letters)), crossing.loops)
    assert heads._inside is not None
    heads.start(0.0)
    if heads.stage[0] != crossing.through:
        heads.switch(0, crossing.through, 10.0)
        heads.advance(60.0)
    heads._inside.blocked.add(0)
    for group in crossing.turning:
        crossing.loops.left_veh[group] += 1
    for group in crossing.oncoming:
        crossing.loops.gap_s[group] = 0.0
    now = 100
    heads.switch(0, crossing.across, 100.0)
    planned_s = heads.begin_s[0]
    for now in range(101, 120):
        heads.advance(now)
    state = network.stages[crossing.across].state
    assert heads.begin_s[0] == planned_s + MOST_HOLD_S
    assert [second for second, letters in shown if letters == state] == [heads.begin_s[0]]
    least_s = network.stages[crossing.across].least_green_s
    assert [bool(heads.free(heads.begin_s[0] + late_s)[0]) for late_s in (least_s - 1, least_s)] == [False, True]


def test_where_reds_are_drawn_out_who_waits_is_served_sooner(crossing: Crossing) -> None:
    network = crossing.network
    stages = tuple(replace(stage, least_green_s=30.0) for stage in network.stages)
    slow = replace(network, stages=stages)
    waited_s = []
    for blocked in (False, True):
        heads = Heads(slow, lambda index, letters: None, crossing.loops)
        assert heads._inside is not None
        heads._inside.blocked.update([0] if blocked else [])
        heads._patience_s = heads._patience()
        for time_s in np.arange(0.0, LONGEST_RED_S, LOOK_S):
            view = scene(slow, float(time_s), veh=1.0)
            if (heads.patient(view.stage, view) != view.stage).any():
                waited_s.append(time_s)
                break
    others = len(network.junctions[0].stages) - 1
    assert waited_s[0] - waited_s[1] == pytest.approx(others * MOST_HOLD_S, abs=LOOK_S)


def test_where_no_turn_gives_way_nobody_is_ever_waited_for(utn17: Network) -> None:
    loops = Traffic()
    loops.gap_s = defaultdict(float)
    inside = Inside(utn17, loops)
    inside.blocked.update(range(len(utn17.junctions)))
    for index, junction in enumerate(utn17.junctions):
        for first in junction.stages:
            for then in junction.stages:
                inside.opens(index, first, 0.0)
                inside.leads(index, first, then, 10.0)
                assert not inside.holds(index, 10.0)
