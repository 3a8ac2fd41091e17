"""Short roads within junctions: which roads these are, who waits for them, who has to be let out first."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from xml.etree import ElementTree as ET

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.unit.test_inside import Traffic
from tests.unit.views import scene
from utn_controllers.scheduled.execution import Scheduled
from utn_controllers.scheduled.streams import Streams
from utn_controllers.scheduled.within import Within
from utn_sumo.clearances import GREEN
from utn_sumo.contract import Network
from utn_sumo.detectors import ids, write
from utn_sumo.plant.heads import Heads
from utn_sumo.plant.inside import MOST_HOLD_S, Inside

StreetOf = Callable[[Callable[[Path], Path]], Network]


def within(network: Network) -> set[str]:
    return {network.links[link].id for link in np.flatnonzero(network.within)}


def turn(network: Network, start: str, end: str) -> int:
    ways = [(network.links[each.link].id, each.to_edge) for each in network.turns]
    return ways.index((start, end))


@pytest.mark.parametrize("signals", ["JJ", "JK"])
@pytest.mark.parametrize(("apart_m", "is_short"), [(14, True), (20, True), (40, False)])
def test_short_roads_between_nodes_with_signals_are_within_a_junction(
    *, apart_m: float, is_short: bool, signals: str, street_of: StreetOf
) -> None:
    network = street_of(lambda folder: odd_nets.carriageways(folder, apart_m, signals=signals))
    assert within(network) == ({"a-b", "b-a"} if is_short else set())


@pytest.mark.parametrize("make", [odd_nets.plain, odd_nets.joined, odd_nets.side_streets])
def test_other_roads_are_not(street_of: StreetOf, make: Callable[[Path], Path]) -> None:
    assert not within(street_of(make))


def test_who_turns_onto_such_a_road_is_watched_where_it_is_of_use(street_of: StreetOf, tmp_path: Path) -> None:
    network = street_of(odd_nets.carriageways)
    named = ids(network).amid
    wanted = {name for start, end in (("W-a", "a-b"), ("E-b", "b-a")) for name in named[turn(network, start, end)]}
    assert len(wanted) == 2
    for within_step in (False, True):
        write(network, tmp_path / "own.add.xml", 60, within_step=within_step)
        made = {each.attrib["id"] for each in ET.parse(tmp_path / "own.add.xml").getroot()}
        assert (wanted <= made) == within_step == (not wanted.isdisjoint(made))


def test_left_turns_wait_in_vain_for_as_long_as_the_road_within_has_red(street_of: StreetOf) -> None:
    network = street_of(odd_nets.carriageways)
    execution = Scheduled(network)
    streams, gaps = execution._streams, execution._giving.gaps
    link = {each.id: index for index, each in enumerate(network.links)}
    onward = np.isin(streams.link, (link["a-b"], link["b-a"]))
    turning = np.isin(streams.link, (link["W-a"], link["E-b"])) & np.isin(
        streams.next_link, np.flatnonzero(network.within)
    )
    assert turning.any()
    for row in range(len(streams.stage)):
        # By the main road's green they come in, by the street's they get out; who comes along the street goes through.
        assert gaps.shut[row, turning].all() == streams.serves[row, turning].all() != streams.serves[row, onward].all()
        assert not gaps.shut[row, np.isin(streams.link, (link["S-a"], link["N-b"]))].any()


def test_before_another_signal_they_wait_in_vain_as_long_as_it_shows_red(street_of: StreetOf) -> None:
    network = street_of(lambda folder: odd_nets.carriageways(folder, signals="JK"))
    execution, link = Scheduled(network), {each.id: index for index, each in enumerate(network.links)}
    streams, gaps = execution._streams, execution._giving.gaps
    near, far = (int(network.link_junction[link[each]]) for each in ("W-a", "a-b"))
    turning = (streams.link == link["W-a"]) & (streams.next_link == link["a-b"])
    onward, row = streams.link == link["a-b"], np.argsort(streams.stage)
    for stage in (*network.junctions[far].stages, *network.junctions[far].stages):
        shown = np.array([each.stages[0] for each in network.junctions])
        shown[far] = stage
        execution.wish(scene(network, stage=shown))
        for own in network.junctions[near].stages:
            if streams.serves[row[own], turning].all():
                shut = gaps.shut[row[own], turning[streams.first[near] : streams.first[near + 1]].nonzero()[0]]
                assert shut.all() == shut.any() != streams.serves[row[stage], onward].any()


@pytest.mark.parametrize(("free", "amid_veh", "near_veh"), [(True, 1, 0), (True, 0, 1), (True, 0, 0), (False, 1, 0)])
def test_who_stands_amid_the_junction_is_of_the_queue_before_the_road_within(
    *, free: bool, amid_veh: int, near_veh: int, street_of: StreetOf
) -> None:
    network = street_of(odd_nets.carriageways)
    streams, link = Streams(network), {each.id: index for index, each in enumerate(network.links)}
    known, shares = Within(network, streams), streams.shares(network.fraction)
    amid, near = np.zeros(len(network.turns)), np.zeros(len(network.lane_sets))
    amid[turn(network, "W-a", "a-b")] = amid_veh
    near[network.set_link == link["a-b"]] = near_veh
    own = streams.link == link["a-b"]
    stand, held = near_veh * own * shares.of_link, np.ones(len(network.groups))
    known.look(replace(scene(network), amid_veh=amid, free=np.array([free])), near, shares.of_link, stand, held)
    seen = free * (amid_veh + near_veh)
    assert stand.sum() == stand[own].sum() == pytest.approx(seen)
    assert set(network.group_link[held > 1].tolist()) == ({link["a-b"]} if seen else set())
    # One takes all the room there is for whoever comes next, from whichever road; amid the junction only behind him.
    behind = ({"W-a"} if amid_veh else {"W-a", "S-a"}) if seen else set()
    assert {network.links[each].id for each in streams.link[known.before]} == behind


@pytest.mark.parametrize(("standing", "holds"), [(0, False), (1, False), (2, True)])
def test_several_who_stand_there_get_out_before_anybody_comes_in(
    standing: int, holds: bool, street_of: StreetOf
) -> None:
    network = street_of(odd_nets.carriageways)
    shown, traffic = [], Traffic()
    for start, end in (("W-a", "a-b"), ("E-b", "b-a"))[:standing]:
        traffic.standing_veh[turn(network, start, end)] = 1.0
    heads = Heads(network, lambda _, letters: shown.append(letters), traffic)
    street, main = sorted(network.junctions[0].stages, key=lambda each: _green(network, each, "W-a"))
    heads.start(0.0)
    if heads.stage[0] != main:
        heads.switch(0, main, 100.0)
        heads.advance(150.0)
    heads.switch(0, street, 200.0)
    opens_s = float(heads.begin_s[0])
    heads.advance(opens_s)
    full = network.stages[street].state
    out = "".join(
        letter if not turns or network.within[network.turns[turns[0]].link] or letter not in GREEN else "r"
        for letter, turns in zip(full, network.junctions[0].signal_turns, strict=True)
    )
    assert out != full
    assert shown[-1] == (out if holds else full)
    # No longer than for others who are left amid a junction, and no longer than they stand there.
    traffic.standing_veh.clear()
    heads.advance(opens_s + 1)
    assert shown[-1] == full
    assert heads.begin_s[0] == opens_s + holds
    assert opens_s + MOST_HOLD_S > heads.begin_s[0]


def _green(network: Network, stage: int, link: str) -> bool:
    return any(network.links[network.turns[each].link].id == link for each in network.stages[stage].turns)


def _one_by_one(folder: Path) -> Path:
    """Carriageways apart of which one has red first: the other one keeps its green until the whole street has its."""
    case = odd_nets.carriageways(folder)
    phases = [(20, "rrrrGGGGrrGGGGrr"), (3, "rrrryyyyrrGGGGrr"), (10, "GgGGrrrrrrGGGGrr")]
    phases += [(3, "GgGGrrrrrryyyyrr"), (20, "GgGGrrrrGGrrrrGg"), (3, "yyyyrrrryyrrrryy")]
    odd_nets.retime(next(folder.glob("*.net.xml")), odd_nets.tl_logic("J", tuple(phases)))
    return case


def test_nobody_loses_his_green_without_yellow_while_others_get_out(street_of: StreetOf) -> None:
    network = street_of(_one_by_one)
    traffic, shown, later_s = Traffic(), [], []
    traffic.standing_veh.update(dict.fromkeys(range(len(network.turns)), 1.0))
    heads = Heads(network, lambda _, letters: shown.append(letters), traffic)
    heads.start(0.0)
    stages = network.junctions[0].stages
    assert len(stages) == 3
    for number, stage in enumerate([*stages[1:], *stages, *stages[::-1], stages[0]], start=1):
        if stage != heads.stage[0]:
            heads.switch(0, stage, 100.0 * number)
            opens_s = heads.begin_s[0]
            for second in range(99):
                heads.advance(100.0 * number + second)
            later_s.append(heads.begin_s[0] - opens_s)
    assert max(later_s) == MOST_HOLD_S
    for before, after in pairwise(shown):
        assert not [
            letter for letter, (was, now) in enumerate(zip(before, after, strict=True)) if was + now in ("Gr", "gr")
        ]


def test_who_has_been_let_in_keeps_his_green_whoever_stands_there_a_second_later(street_of: StreetOf) -> None:
    network = street_of(odd_nets.carriageways)
    traffic = Traffic()
    inside = Inside(network, traffic)
    street, main = sorted(network.junctions[0].stages, key=lambda each: _green(network, each, "W-a"))
    inside.leads(0, main, street, "r" * len(network.stages[street].state), 23.0)
    shown = []
    for standing_veh in (0.0, 2.0, 0.0):
        traffic.standing_veh[turn(network, "W-a", "a-b")] = standing_veh
        shown.append({letter for letter, each in enumerate(inside.meanwhile(0)) if each in GREEN})
    assert len(shown[0]) > 0
    # Without yellow nobody's ends; those who stand there are let out besides.
    assert shown[0] < shown[1] == shown[2]
