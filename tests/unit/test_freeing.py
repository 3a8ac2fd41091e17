"""Who stands amid a junction long into the next green has red for all at last, unless others would wait too long."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable
from itertools import groupby, pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.unit.test_clearances import written
from tests.unit.test_inside import Traffic, _turns_with
from tests.unit.views import scene
from utn_sumo import monitor
from utn_sumo.contract import Network
from utn_sumo.plant.freeing import MOST_STANDING_S, MOST_STOPPED_S
from utn_sumo.plant.heads import Heads
from utn_sumo.plant.inside import MOST_HOLD_S
from utn_sumo.plant.patience import LONGEST_RED_S, LOOK_S

StreetOf = Callable[[Callable[[Path], Any]], Network]


def _goes_straight_on(network: Network, turn: int) -> bool:
    """From the south to the north, say: roads are named after where they come from and lead to."""
    own = network.turns[turn]
    ends = {network.links[own.link].edges[-1][0], own.to_edge.split("-")[1][0]}
    return ends in ({"n", "s"}, {"E", "W"})


def _closing(letters: str) -> str:
    return letters.replace("G", "y").replace("g", "y")


class Stuck:
    """A crossroads of two stages, single lanes: somebody who goes straight on stands amid it as the green changes."""

    def __init__(self, network: Network):
        self.network = network
        self.first, self.then = network.junctions[0].stages
        self.turn = next(turn for turn in _turns_with(network, self.first, "G") if _goes_straight_on(network, turn))
        self.traffic = Traffic()
        self.traffic.coming_veh = defaultdict(float, dict.fromkeys(range(len(network.groups)), 1.0))
        self.now_s = 0.0
        self.others_wait = False
        self.shown: list[tuple[float, str]] = []
        self.heads = Heads(network, lambda _, letters: self.shown.append((self.now_s, letters)), self.traffic)
        self.heads.start(0.0)

    def stands(self, until_s: float = np.inf) -> None:
        veh = float(self.now_s < until_s)
        self.traffic.inside_veh[self.turn] = self.traffic.standing_veh[self.turn] = veh

    def change(self, then: int, gone_s: float = np.inf) -> list[tuple[str, float]]:
        """Go to another stage; what is shown and how long until it begins. He is gone `gone_s` after clearance."""
        self.now_s, self.shown = self.now_s + 60.0, []
        if not self.others_wait:
            self.heads.patience.look(scene(self.network, self.now_s))
        self.stands()
        self.heads.switch(0, then, self.now_s)
        planned_s = float(self.heads.begin_s[0])
        while self.now_s < planned_s + 60.0:
            self.now_s += 1.0
            self.stands(planned_s + gone_s)
            self.heads.advance(self.now_s)
        self.late_s = float(self.heads.begin_s[0]) - planned_s
        seconds = [(letters, s) for s, letters in self.shown]
        ends = [*(s for _, s in seconds[1:]), seconds[-1][1]]
        spans = [(letters, end - s) for (letters, s), end in zip(seconds, ends, strict=True)]
        return [(letters, sum(s for _, s in own)) for letters, own in groupby(spans, key=lambda span: span[0])]

    @property
    def state(self) -> str:
        return self.network.stages[self.then].state


@pytest.fixture
def stuck(street_of: StreetOf) -> Stuck:
    return Stuck(street_of(odd_nets.plain))


def test_who_still_stands_there_gets_yellow_and_red_for_those_who_pass_him_until_he_is_out(stuck: Stuck) -> None:
    yellow_s = 3.0
    shown = stuck.change(stuck.then, gone_s=MOST_HOLD_S + MOST_STANDING_S + yellow_s + 2)
    meanwhile, closing, red, stage = shown[-4:]
    assert stage[0] == stuck.state
    assert set(meanwhile[0]) >= {"G", "r"}
    assert meanwhile[1] == MOST_HOLD_S + MOST_STANDING_S
    assert closing == (meanwhile[0].replace("G", "y"), yellow_s)
    assert red == ("r" * len(stuck.state), 2.0)
    assert stuck.late_s == MOST_HOLD_S + MOST_STANDING_S + yellow_s + 2


def test_who_gets_out_before_stops_nobody(stuck: Stuck) -> None:
    for gone_s in (1.0, MOST_HOLD_S - 1, MOST_HOLD_S, MOST_HOLD_S + MOST_STANDING_S):
        shown = stuck.change(stuck.then, gone_s=gone_s)
        meanwhile = shown[-2][0]
        assert "G" in meanwhile
        assert stuck.late_s == gone_s
        # Whoever has green has it until the whole stage does.
        assert all(
            b in "Gg"
            for was, becomes in pairwise([meanwhile, *(letters for letters, _ in shown[-1:])])
            for a, b in zip(was, becomes, strict=True)
            if a in "Gg"
        )
        stuck.traffic.inside_veh.clear()
        stuck.change(stuck.first, gone_s=-60.0)


def test_yellow_is_shown_to_its_end_when_he_gets_out_meanwhile(stuck: Stuck) -> None:
    shown = stuck.change(stuck.then, gone_s=MOST_HOLD_S + MOST_STANDING_S + 1)
    assert [seconds for letters, seconds in shown if "y" in letters and "g" not in letters][-1] == 3.0
    assert shown[-1][0] == stuck.state


def test_whom_red_for_all_does_not_help_it_is_not_shown_for_again_before_he_is_gone(stuck: Stuck) -> None:
    longest_s = MOST_HOLD_S + MOST_STANDING_S + 3.0 + MOST_STOPPED_S
    for gone_s, late_s in ((np.inf, longest_s), (np.inf, MOST_HOLD_S), (2.0, 2.0), (np.inf, longest_s)):
        stuck.change(stuck.then, gone_s=gone_s)
        assert stuck.late_s == late_s
        stuck.change(stuck.first, gone_s=gone_s)


def test_whom_the_road_ahead_stops_nobody_is_stopped_for(stuck: Stuck) -> None:
    stuck.traffic.taken.add(stuck.turn)
    stuck.change(stuck.then)
    assert stuck.late_s == 0.0


@pytest.mark.parametrize("waited_s", [60.0, LONGEST_RED_S - 40.0])
def test_where_others_have_waited_for_long_it_is_not_done(stuck: Stuck, waited_s: float) -> None:
    for time_s in np.arange(0.0, waited_s, LOOK_S):
        stuck.heads.patience.look(scene(stuck.network, float(time_s), veh=1.0))
    stuck.now_s, stuck.others_wait = waited_s - 60.0, True
    stuck.change(stuck.then)
    assert (stuck.late_s > MOST_HOLD_S) == (waited_s < LONGEST_RED_S / 2)


@pytest.mark.parametrize("make", [odd_nets.plain, odd_nets.two_lanes, odd_nets.pedestrians])
def test_the_monitor_has_nothing_to_say_whoever_stands_there(
    street_of: StreetOf, tmp_path: Path, make: Callable[[Path], Any]
) -> None:
    network, rng, traffic, now_s = street_of(make), np.random.default_rng(1), Traffic(), 0
    shown: list[tuple[float, str, str]] = []
    heads = Heads(network, lambda index, state: shown.append((now_s, network.junctions[index].id, state)), traffic)
    traffic.coming_veh = defaultdict(float, dict.fromkeys(range(len(network.groups)), 1.0))
    heads.start(0.0)
    for now_s in range(2400):
        if now_s % 15 == 0:
            standing = rng.uniform(size=len(network.turns)) < 0.1
            traffic.standing_veh = traffic.inside_veh = defaultdict(float, enumerate(standing.astype(float).tolist()))
            heads.patience.look(scene(network, float(now_s)))
        heads.advance(now_s)
        for index in np.flatnonzero(heads.free(now_s)):
            wish = int(rng.choice(network.junctions[index].stages))
            if wish != heads.stage[index]:
                heads.switch(int(index), wish, now_s)
    # At times those who have green before the whole stage does have yellow.
    stages = {stage.state for stage in network.stages}
    ended = {before for (*_, before), (*_, closing) in pairwise(shown) if closing == _closing(before) != before}
    assert ended - stages
    assert monitor.watch(network, written(tmp_path, shown), 2400, in_order=False).reasons == []
