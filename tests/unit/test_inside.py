"""Who waits amid a junction is let out before the next road's green."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.unit.views import allowed, scene
from utn_sumo.contract import Network
from utn_sumo.plant.heads import Heads
from utn_sumo.plant.inside import MOST_HOLD_S, Inside
from utn_sumo.plant.patience import LONGEST_RED_S, LOOK_S

StreetOf = Callable[[Callable[[Path], Any]], Network]


class Traffic:
    """Detectors of which it is said what they see; nobody is anywhere unless it is."""

    def __init__(self) -> None:
        self.inside_veh: dict[int, float] = defaultdict(float)
        self.standing_veh: dict[int, float] = defaultdict(float)
        self.coming_veh: dict[int, float] = defaultdict(float)
        self.pressing = False
        self.taken: set[int] = set()

    def pressed(self, junction: int, letters: str) -> bool:
        assert junction >= 0
        assert "G" in letters
        return self.pressing

    def amid_veh(self, turn: int) -> float:
        return self.inside_veh[turn]

    def standing_amid_veh(self, turn: int) -> float:
        return self.standing_veh[turn]

    def is_taken(self, turn: int) -> bool:
        return turn in self.taken

    def close_veh(self, group: int) -> float:
        return self.coming_veh[group]


def _turns_with(network: Network, stage: int, letters: str) -> list[int]:
    """Turns of the first junction that have one of these letters in a stage."""
    shown = zip(network.stages[stage].state, network.junctions[0].signal_turns, strict=True)
    return [turn for letter, turns in shown for turn in turns if letter in letters]


def _lead(inside: Inside, first: int, then: int) -> None:
    """The first junction goes to another stage, which would begin at 23 s after all have had red."""
    inside.leads(0, first, then, "r" * len(inside._network.stages[then].state), 23.0)


class Crossing:
    """A junction with two roads whose left turns give way in one stage and are alone in the next."""

    def __init__(self, network: Network):
        self.network = network
        stages = [network.stages[stage].state for stage in network.junctions[0].stages]
        places = [place for place, state in enumerate(stages) if "g" in state]
        count = len(stages)
        self.through, self.across = (network.junctions[0].stages[place] for place in places[:2])
        self.alone = network.junctions[0].stages[(places[0] + 1) % count]
        self.traffic = Traffic()
        self.inside = Inside(network, self.traffic)
        self.turning, self.next_turning = (_turns_with(network, stage, "g") for stage in (self.through, self.across))

    def full(self) -> Traffic:
        """Two of the one road amid the junction, and one of the other one close to it."""
        self.traffic.inside_veh[self.turning[0]] = 2.0
        self.traffic.coming_veh[self.network.turns[self.next_turning[0]].group] = 1.0
        return self.traffic


@pytest.fixture
def crossing(street_of: StreetOf) -> Crossing:
    return Crossing(street_of(odd_nets.actuated_left_turns))


def test_the_red_lasts_as_long_as_two_are_inside_and_others_would_come_in(crossing: Crossing) -> None:
    traffic = crossing.full()
    _lead(crossing.inside, crossing.through, crossing.across)
    assert crossing.inside.holds(0, 23.0)
    # Who stands there for good does not end it never.
    assert crossing.inside.holds(0, 23.0 + MOST_HOLD_S - 1)
    assert not crossing.inside.holds(0, 23.0 + MOST_HOLD_S)
    traffic.inside_veh.clear()
    assert not crossing.inside.holds(0, 24.0)


def test_nobody_is_held_where_no_turns_of_the_next_road_are_close(crossing: Crossing) -> None:
    traffic = crossing.full()
    traffic.coming_veh.clear()
    traffic.coming_veh[crossing.network.turns[crossing.turning[0]].group] = 1.0
    _lead(crossing.inside, crossing.through, crossing.across)
    assert not crossing.inside.holds(0, 23.0)


def test_nobody_is_held_for_one_vehicle_wherever_it_waits(crossing: Crossing) -> None:
    traffic = crossing.full()
    _lead(crossing.inside, crossing.through, crossing.across)
    for turns_veh in ((1.0, 0.0), (0.0, 1.0), (1.0, 1.0)):
        for turn, veh in zip(crossing.turning, turns_veh, strict=True):
            traffic.inside_veh[turn] = veh
        assert crossing.inside.holds(0, 23.0) == (sum(turns_veh) > 1.0)


def test_before_two_lanes_abreast_it_lasts_for_one_vehicle_too(crossing: Crossing) -> None:
    network, group = crossing.network, crossing.network.turns[crossing.next_turning[0]].group
    wide = tuple(replace(each, lanes=(*each.lanes, 9)) if each.group == group else each for each in network.lane_sets)
    inside = Inside(replace(network, lane_sets=wide), crossing.full())
    crossing.traffic.inside_veh[crossing.turning[0]] = 1.0
    _lead(inside, crossing.through, crossing.across)
    assert inside.holds(0, 23.0)


def test_the_red_lasts_before_the_next_road_s_own_stage_for_turns_too(crossing: Crossing) -> None:
    stages = crossing.network.junctions[0].stages
    own = stages[(stages.index(crossing.across) + 1) % len(stages)]
    crossing.full()
    _lead(crossing.inside, crossing.through, own)
    assert crossing.inside.holds(0, 23.0)


def test_to_the_turns_own_stage_it_is_the_nets_clearance(crossing: Crossing) -> None:
    crossing.full()
    _lead(crossing.inside, crossing.through, crossing.alone)
    assert not crossing.inside.holds(0, 23.0)


def test_nobody_is_held_for_those_who_go_or_wait_in_the_next_stage_too(crossing: Crossing) -> None:
    crossing.full()
    _lead(crossing.inside, crossing.across, crossing.through)
    assert not crossing.inside.holds(0, 23.0)


def test_a_stage_that_is_held_begins_later_and_has_its_least_green_all_the_same(crossing: Crossing) -> None:
    shown: list[tuple[int, str]] = []
    now = 0
    network = crossing.network
    heads = Heads(network, lambda _, letters: shown.append((now, letters)), crossing.full())
    heads.start(0.0)
    if heads.stage[0] != crossing.through:
        heads.switch(0, crossing.through, 10.0)
        heads.advance(60.0)
    now = 100
    heads.switch(0, crossing.across, 100.0)
    planned_s = heads.begin_s[0]
    for now in range(101, 120):
        heads.advance(now)
    state = network.stages[crossing.across].state
    assert heads.begin_s[0] == planned_s + MOST_HOLD_S
    held = {letters for second, letters in shown if planned_s <= second < heads.begin_s[0]}
    assert held == {heads._inside.meanwhile(0)}  # type: ignore[union-attr]
    assert [second for second, letters in shown if letters == state] == [heads.begin_s[0]]
    least_s = network.stages[crossing.across].least_green_s
    assert [bool(heads.free(heads.begin_s[0] + late_s)[0]) for late_s in (least_s - 1, least_s)] == [False, True]


def _full(network: Network) -> tuple[Inside, Traffic, int, int]:
    """Two turns amid a crossroads of two stages that found no gap, and everybody close to it."""
    first, then = network.junctions[0].stages
    traffic = Traffic()
    traffic.inside_veh[_turns_with(network, first, "g")[0]] = 2.0
    traffic.coming_veh = defaultdict(float, dict.fromkeys(range(len(network.groups)), 1.0))
    return Inside(network, traffic), traffic, first, then


def test_all_others_of_the_next_green_have_it_while_turns_wait_for_those_inside(street_of: StreetOf) -> None:
    network = street_of(odd_nets.plain)
    inside, traffic, first, then = _full(network)
    _lead(inside, first, then)
    assert inside.holds(0, 23.0)
    state, turning = network.stages[then].state, set(_turns_with(network, then, "g"))
    closed = {letter for letter, turns in enumerate(network.junctions[0].signal_turns) if turning & set(turns)}
    assert closed
    assert inside.meanwhile(0) == "".join("r" if i in closed else shown for i, shown in enumerate(state))
    assert "G" in inside.meanwhile(0)
    # Who has had green all along keeps it: without yellow nobody's ends.
    inside = Inside(network, traffic)
    inside.leads(0, first, then, state, 23.0)
    assert inside.meanwhile(0) == state


def test_nobody_has_green_while_turns_from_lanes_of_their_own_are_let_out(crossing: Crossing) -> None:
    traffic = crossing.full()
    _lead(crossing.inside, crossing.through, crossing.across)
    assert crossing.inside.holds(0, 23.0)
    assert set(crossing.inside.meanwhile(0)) == {"r"}
    # They give way to all of the next road, and nobody is behind them who is in its way.
    traffic.inside_veh.clear()
    assert "G" in crossing.inside.meanwhile(0)


def test_a_clearance_that_ends_with_yellow_is_drawn_out_as_red(crossing: Crossing) -> None:
    crossing.full()
    letters = len(crossing.network.stages[crossing.across].state)
    crossing.inside.leads(0, crossing.through, crossing.across, "y" * letters, 23.0)
    assert crossing.inside.holds(0, 23.0)
    assert crossing.inside.meanwhile(0) == "r" * letters


def _straight_on_two_lanes(network: Network, stage: int) -> int:
    """The first turn that goes straight on from two lanes, a letter each."""
    straight = _turns_with(network, stage, "G")
    return next(turn for turn in straight if straight.count(turn) == 2)


@pytest.mark.parametrize(
    ("make", "stands"),
    [
        (odd_nets.plain, lambda network, stage: _turns_with(network, stage, "g")[0]),
        (odd_nets.two_lanes, _straight_on_two_lanes),
    ],
    ids=["turning", "straight on, two lanes abreast"],
)
def test_nobody_comes_in_while_more_than_two_stand_amid_the_junction(
    street_of: StreetOf, make: Callable[[Path], Any], stands: Callable[[Network, int], int]
) -> None:
    network = street_of(make)
    inside, traffic, first, then = _full(network)
    turning, next_turning = (stands(network, stage) for stage in (first, then))
    for standing in (0.0, 2.0, 3.0):
        traffic.standing_veh = defaultdict(float, {turning: standing})
        _lead(inside, first, then)
        assert inside.holds(0, 23.0)
        assert ("G" in inside.meanwhile(0)) == (standing <= 2)
    # Who has green in the next stage is in nobody's way.
    traffic.standing_veh = defaultdict(float, {next_turning: 3.0})
    assert "G" in inside.meanwhile(0)
    # Whose green has begun keeps it, whoever stands there now: there is no yellow.
    traffic.standing_veh = defaultdict(float, {turning: 3.0})
    assert "G" in inside.meanwhile(0)


def test_where_reds_may_be_drawn_out_who_waits_is_served_sooner(crossing: Crossing) -> None:
    network = crossing.network
    stages = tuple(replace(stage, least_green_s=30.0) for stage in network.stages)
    slow = replace(network, stages=stages)
    wish, waited_s = np.array([crossing.alone]), []
    for areas in (None, crossing.traffic):
        heads = Heads(slow, lambda index, letters: None, areas)
        for time_s in np.arange(0.0, LONGEST_RED_S, LOOK_S):
            if allowed(heads.patience, wish, scene(slow, float(time_s), veh=1.0)) != wish:
                waited_s.append(time_s)
                break
    # There and back.
    assert waited_s[0] - waited_s[1] == pytest.approx(2 * MOST_HOLD_S, abs=LOOK_S)


class Walked:
    """A crossroads of two stages whose turns give way to people on the crossings at their exits."""

    def __init__(self, network: Network):
        self.network = network
        self.first, self.then = network.junctions[0].stages
        self.traffic = Traffic()
        self.traffic.pressing = True
        self.inside = Inside(network, self.traffic)
        self.late = _turns_with(network, self.first, "gG")

    def holds_for(self, turn: int, *groups: int) -> bool:
        """Somebody is still amid the junction when the next road's green is to begin, others are close on these."""
        self.traffic.inside_veh = defaultdict(float, {turn: 1.0})
        self.traffic.coming_veh = defaultdict(float, dict.fromkeys(groups, 1.0))
        _lead(self.inside, self.first, self.then)
        return self.inside.holds(0, 23.0)


@pytest.fixture
def walked(street_of: StreetOf) -> Walked:
    return Walked(street_of(odd_nets.pedestrians))


def test_where_people_walk_one_who_is_inside_holds_those_who_would_come_into_its_way(walked: Walked) -> None:
    network = walked.network
    groups = range(len(network.groups))
    assert len(walked.late) > len(_turns_with(network, walked.first, "g"))
    for turn in walked.late:
        street = network.turns[turn].to_edge
        joins = {
            network.turns[other].group
            for other in _turns_with(network, walked.then, "gG")
            if network.turns[other].to_edge == street
        }
        assert joins
        assert joins <= {group for group in groups if walked.holds_for(turn, group)}
        assert not walked.holds_for(turn, network.turns[turn].group)
        # Here too the red ends at last.
        assert walked.holds_for(turn, *joins)
        assert walked.inside.holds(0, 23.0 + MOST_HOLD_S - 1)
        assert not walked.inside.holds(0, 23.0 + MOST_HOLD_S)


def test_who_walks_waits_for_those_inside_and_who_drives_on_does_not(walked: Walked) -> None:
    junction, state = walked.network.junctions[0], walked.network.stages[walked.then].state
    assert walked.holds_for(walked.late[0], *range(len(walked.network.groups)))
    meanwhile = walked.inside.meanwhile(0)
    walking = {letter for letter in junction.crossings if state[letter] in "gG"}
    assert walking
    assert {meanwhile[letter] for letter in walking} == {"r"}
    driving = [letter for letter, shown in enumerate(state) if shown == "G" and letter not in junction.crossings]
    assert driving
    assert {meanwhile[letter] for letter in driving} == {"G"}


def test_nobody_is_held_for_one_who_has_left_or_has_green_in_the_next_stage(walked: Walked) -> None:
    everybody = range(len(walked.network.groups))
    assert walked.holds_for(walked.late[0], *everybody)
    walked.traffic.inside_veh = defaultdict(float)
    assert not walked.inside.holds(0, 23.0)
    for next_turn in _turns_with(walked.network, walked.then, "gG"):
        assert not walked.holds_for(next_turn, *everybody)


def test_nobody_is_held_where_people_could_walk_and_none_is_about_to(walked: Walked) -> None:
    everybody = defaultdict(float, dict.fromkeys(range(len(walked.network.groups)), 1.0))
    walked.traffic.inside_veh, walked.traffic.coming_veh = defaultdict(float, {walked.late[0]: 1.0}), everybody
    for pressing in (False, True, False):
        walked.traffic.pressing = pressing
        _lead(walked.inside, walked.first, walked.then)
        assert walked.inside.holds(0, 23.0) == pressing
    # Who goes straight on from a lane that turns share is waited for all the same.
    walked.traffic.inside_veh = defaultdict(float, {_straight_on(walked.network, walked.first): 1.0})
    _lead(walked.inside, walked.first, walked.then)
    assert walked.inside.holds(0, 23.0)


def _straight_on(network: Network, stage: int) -> int:
    """A turn of the first junction that has way in a stage and crosses more streams than any other one."""
    junction, state = network.junctions[0], network.stages[stage].state
    letters = [i for i, turns in enumerate(junction.signal_turns) if turns and state[i] == "G"]
    crossed = {letter: int(np.sum(junction.conflicts[letter])) for letter in letters}
    return junction.signal_turns[max(letters, key=crossed.__getitem__)][0]


def test_who_may_be_behind_a_turn_that_shares_its_lane_has_those_wait_who_would_turn_into_its_way(
    street_of: StreetOf,
) -> None:
    network = street_of(odd_nets.plain)
    first, then = network.junctions[0].stages
    ahead = _straight_on(network, first)
    left = next(
        turn for turn in _turns_with(network, first, "g") if network.turns[turn].link == network.turns[ahead].link
    )
    assert set(network.turns[ahead].from_lanes) & set(network.turns[left].from_lanes)
    turning = {network.turns[turn].group for turn in _turns_with(network, then, "g")}
    traffic = Traffic()
    inside = Inside(network, traffic)
    # One turn alone can be passed by those of the next road.
    for turn, is_held in ((ahead, True), (left, False)):
        traffic.inside_veh = defaultdict(float, {turn: 1.0})
        for groups in (turning, set[int]()):
            traffic.coming_veh = defaultdict(float, dict.fromkeys(groups, 1.0))
            _lead(inside, first, then)
            assert inside.holds(0, 23.0) == (is_held and len(groups) > 0)
            assert not inside.holds(0, 23.0 + MOST_HOLD_S)
    everybody = defaultdict(float, dict.fromkeys(range(len(network.groups)), 1.0))
    traffic.inside_veh, traffic.coming_veh = defaultdict(float, {ahead: 1.0}), everybody
    _lead(inside, first, then)
    assert inside.holds(0, 23.0)
    # Whom the road ahead stops nobody waits for.
    traffic.taken = {ahead}
    assert not inside.holds(0, 23.0)
    traffic.taken.clear()
    traffic.inside_veh = defaultdict(float)
    assert not inside.holds(0, 24.0)
    # Nor who has green in the next stage too.
    traffic.inside_veh = defaultdict(float, {ahead: 1.0})
    _lead(inside, then, first)
    assert not inside.holds(0, 23.0)
    # Where nobody would be stopped all have green at once.
    inside = Inside(network, traffic)
    inside.leads(0, first, then, network.stages[then].state, 23.0)
    assert not inside.holds(0, 23.0)


def test_two_turns_that_found_no_gap_have_those_of_the_other_road_wait_in_the_net_s_own_order_too(
    street_of: StreetOf,
) -> None:
    network = street_of(odd_nets.plain)
    first, then = network.junctions[0].stages
    traffic = Traffic()
    inside = Inside(network, traffic)
    traffic.coming_veh = defaultdict(float, dict.fromkeys(range(len(network.groups)), 1.0))
    for veh in (1.0, 2.0):
        traffic.inside_veh = defaultdict(float, {_turns_with(network, first, "g")[0]: veh})
        _lead(inside, first, then)
        assert inside.holds(0, 23.0) == (veh > 1)


def test_where_no_turn_gives_way_nobody_is_ever_waited_for(utn17: Network) -> None:
    traffic = Traffic()
    traffic.inside_veh = traffic.standing_veh = traffic.coming_veh = defaultdict(lambda: 1.0)
    inside = Inside(utn17, traffic)
    assert not inside.may_hold().any()
    for index, junction in enumerate(utn17.junctions):
        for first in junction.stages:
            for then in junction.stages:
                inside.leads(index, first, then, utn17.stages[first].state, 10.0)
                assert not inside.holds(index, 10.0)
