"""Which streams conflict is the net's right of way; what signals must show between them is the net's own programme."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import partial
from itertools import accumulate
from pathlib import Path
from typing import Any
from xml.etree import ElementTree as ET

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.integration.odd_nets import DARK, NO_TURNAROUNDS, retime, row, tl_logic
from utn_sumo import monitor, signals
from utn_sumo.contract import Network, Plan
from utn_sumo.testing import random_greens

Make = Callable[[Path], Any]
StreetOf = Callable[[Make], Network]
Phases = Iterable[tuple[float, str]]

RIGHT, AHEAD, LEFT = range(3)
NORTH, EAST, SOUTH, WEST = (3 * arm for arm in range(4))
"""The letters of an arm of a crossroads of single lanes are its right turn, ahead, and left turn."""
NORTHERN = 12
"""The crossing of the northern arm; the eastern, the southern, the western follow."""


def conflicting(net: Network) -> set[frozenset[int]]:
    matrix = np.array(net.junctions[0].conflicts)
    assert (matrix == matrix.T).all()
    return {frozenset((int(a), int(b))) for a, b in np.argwhere(matrix)}


def plain(folder: Path) -> Path:
    return row("C").net(folder, NO_TURNAROUNDS)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        (NORTH + AHEAD, EAST + AHEAD),
        (NORTH + AHEAD, WEST + AHEAD),
        (NORTH + LEFT, SOUTH + AHEAD),
        (NORTH + LEFT, EAST + LEFT),
        (NORTH + RIGHT, EAST + AHEAD),
        (NORTH + RIGHT, SOUTH + LEFT),
    ],
    ids=["across", "across from the west", "left across oncoming", "lefts", "into one lane", "left into one lane"],
)
def test_streams_that_cross_or_come_from_two_roads_into_one_lane_conflict(
    street_of: StreetOf, one: int, other: int
) -> None:
    assert frozenset((one, other)) in conflicting(street_of(plain))


def test_oncoming_streams_and_those_of_one_road_are_at_peace(street_of: StreetOf) -> None:
    found = conflicting(street_of(plain))
    for arm in (NORTH, EAST, SOUTH, WEST):
        assert not {pair for pair in found if pair <= {arm, arm + 1, arm + 2}}
    assert frozenset((NORTH + AHEAD, SOUTH + AHEAD)) not in found
    assert frozenset((NORTH + RIGHT, SOUTH + RIGHT)) not in found


def test_of_left_turns_that_meet_in_a_stage_of_theirs_the_second_by_the_right_of_way_gives_way(
    street_of: StreetOf,
) -> None:
    net = street_of(odd_nets.lefts_that_meet)
    north, south = NORTH + LEFT, SOUTH + LEFT
    assert frozenset((north, south)) in conflicting(net)
    assert net.junctions[0].made_to_yield == (north,)
    (stage,) = (stage for stage in net.stages if stage.state[NORTH + AHEAD] == "r" and stage.state[north] in "Gg")
    assert (stage.state[north], stage.state[south]) == ("g", "G")
    assert not signals.refused(net)


def test_left_turns_that_pass_each_other_keep_their_protected_greens(street_of: StreetOf) -> None:
    net = street_of(odd_nets.turning_pockets)
    assert net.junctions[0].made_to_yield == ()
    assert any(stage.state.count("G") == 2 for stage in net.stages)


def both_roads_at_once(folder: Path) -> Path:
    clears = [(3, "yyyyyyyyyyyy"), (30, "rrrGGgrrrGGg"), (3, "rrryyyrrryyy"), (2, DARK)]
    return retime(plain(folder), tl_logic("C", [(30, "GGgGGgGGgGGg"), *clears]))


def test_who_drives_straight_across_another_road_is_not_made_to_give_way(street_of: StreetOf) -> None:
    net = street_of(both_roads_at_once)
    ahead = [arm + AHEAD for arm in (NORTH, EAST, SOUTH, WEST)]
    assert [net.stages[0].state[letter] for letter in ahead] == ["G"] * 4
    assert "are both green" in signals.refused(net)["C"]


def main_road_turning(folder: Path) -> Path:
    """The main road turns right from the west to the south, where the north's traffic joins it."""
    drawn = row("C", priority=1)
    for edge in drawn.parts["edges"]:
        if edge.get("id") in ("W-C", "C-sC"):
            edge.set("priority", "9")
    phases = [(30, "GGgrrrrrrGrr"), (3, "yyyrrrrrryrr"), (30, "rrrGGgrrrrrr"), (3, "rrryyyrrrrrr"), (2, DARK)]
    return retime(drawn.net(folder, NO_TURNAROUNDS), tl_logic("C", phases))


def test_who_joins_a_main_road_that_has_green_with_him_gives_way_though_he_drives_straight_on(
    street_of: StreetOf,
) -> None:
    net = street_of(main_road_turning)
    joins, main = NORTH + AHEAD, WEST + RIGHT
    assert frozenset((joins, main)) in conflicting(net)
    assert joins in net.junctions[0].made_to_yield
    assert main not in net.junctions[0].made_to_yield


def narrowing(folder: Path) -> Path:
    """Two lanes from the west lead ahead into one, each with a letter of its own."""
    drawn = row("C").without("W-C")
    drawn.one_way("W", "C", lanes=2)
    for lane in (0, 1):
        drawn.connection("W-C", "C-E", fromLane=lane, toLane=0)
    return drawn.net(folder, NO_TURNAROUNDS)


def test_lanes_of_one_road_that_lead_into_one_lane_are_at_peace(street_of: StreetOf) -> None:
    net = street_of(narrowing)
    (turn,) = (index for index, turn in enumerate(net.turns) if net.links[turn.link].id == "W-C")
    letters = [letter for letter, turns in enumerate(net.junctions[0].signal_turns) if turn in turns]
    assert len(letters) == 2
    assert frozenset(letters) not in conflicting(net)
    # Either still conflicts with who comes from elsewhere.
    (across,) = (
        letter
        for letter, turns in enumerate(net.junctions[0].signal_turns)
        for index in turns
        if (net.links[net.turns[index].link].id, net.turns[index].to_edge) == ("nC-C", "C-sC")
    )
    assert {frozenset((across, letter)) for letter in letters} <= conflicting(net)


def weaving(folder: Path, *, who_waits: bool) -> Path:
    """Ahead is a fork, to whose left road the west's right lane leads, and the left one to the right: they cross.

    Both go straight on, and whether either waits for the other is told, as in nets of old netconverts and wide forks.
    """
    drawn = row("C").without("W-C")
    drawn.one_way("W", "C", lanes=2)
    drawn.node("F", 200, 60)
    drawn.one_way("C", "F")
    drawn.connection("W-C", "C-F", fromLane=0, toLane=0)
    drawn.connection("W-C", "C-E", fromLane=1, toLane=0)
    clears = [(3, "rrrryyyyrrrryy"), (27, "GGggrrrrGGGgrr"), (3, "yyyyrrrryyyyrr")]
    net = retime(drawn.net(folder, NO_TURNAROUNDS), tl_logic("C", [(27, "rrrrggggrrrrGG"), *clears]))
    tree = ET.parse(net)
    (fork,) = (each for each in tree.iter("connection") if each.get("from") == "W-C" and each.get("to") == "C-F")
    fork.set("dir", "s")
    if not who_waits:
        (request,) = (each for each in tree.iter("request") if each.get("index") == str(TO_FORK))
        # Letters count from the right.
        bits = list(request.attrib["response"])
        assert bits[-1 - BESIDE] == "1"
        bits[-1 - BESIDE] = "0"
        request.set("response", "".join(bits))
    tree.write(net)
    return net


TO_FORK, BESIDE = 12, 13


@pytest.mark.parametrize("who_waits", [True, False])
def test_lanes_of_one_road_that_cross_and_have_green_together_are_controlled(
    street_of: StreetOf, who_waits: bool
) -> None:
    net = street_of(partial(weaving, who_waits=who_waits))
    assert not signals.refused(net)
    assert net.junctions[0].made_to_yield == ((TO_FORK,) if who_waits else ())
    (shown,) = (stage.state for stage in net.stages if stage.state[BESIDE] == "G")
    assert shown[TO_FORK] == ("g" if who_waits else "G")
    assert {frozenset((NORTH + AHEAD, letter)) for letter in (TO_FORK, BESIDE)} <= conflicting(net)


@pytest.mark.parametrize("stream", [NORTH + RIGHT, NORTH + AHEAD, NORTH + LEFT, SOUTH + AHEAD])
def test_who_comes_over_a_crossing_straight_or_from_its_own_street_conflicts_with_it(
    street_of: StreetOf, stream: int
) -> None:
    assert frozenset((stream, NORTHERN)) in conflicting(street_of(odd_nets.pedestrians))


@pytest.mark.parametrize("stream", [EAST + RIGHT, WEST + LEFT])
def test_who_turns_onto_a_crossings_street_gives_way_and_is_at_peace_with_it(street_of: StreetOf, stream: int) -> None:
    assert frozenset((stream, NORTHERN)) not in conflicting(street_of(odd_nets.pedestrians))


def test_who_goes_elsewhere_is_at_peace_with_a_crossing(street_of: StreetOf) -> None:
    found = conflicting(street_of(odd_nets.pedestrians))
    with_it = {next(iter(pair - {NORTHERN})) for pair in found if NORTHERN in pair}
    assert with_it == {NORTH + RIGHT, NORTH + AHEAD, NORTH + LEFT, SOUTH + AHEAD}


def test_crossings_need_no_yellow_and_streams_do(street_of: StreetOf) -> None:
    assert street_of(odd_nets.pedestrians).junctions[0].without_yellow == tuple(range(NORTHERN, NORTHERN + 4))
    assert street_of(plain).junctions[0].without_yellow == ()


def test_letters_without_a_stream_conflict_with_nobody_and_need_no_yellow(street_of: StreetOf) -> None:
    junction = street_of(odd_nets.letters_without_a_stream).junctions[0]
    assert junction.without_yellow == (3,)
    assert not any(junction.conflicts[3])
    assert junction.signal_turns[3] == ()


@pytest.fixture(scope="module")
def record(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("record") / "signals.xml"


def judged(net: Network, record: Path, shown: Phases, junction: int = 0) -> list[str]:
    """What the monitor has against a junction that shows this from 0 s on; the others are not looked at."""
    phases, name = list(shown), net.junctions[junction].id
    starts = accumulate((seconds for seconds, _ in phases), initial=0)
    lines = [
        f'<tlsState time="{at}" id="{name}" state="{state}"/>' for at, (_, state) in zip(starts, phases, strict=False)
    ]
    record.write_text(f"<tlsStates>{''.join(lines)}</tlsStates>", encoding="utf-8")
    verdict = monitor.watch(net, record, sum(seconds for seconds, _ in phases))
    return [reason for reason in verdict.reasons if reason.startswith(f"{name} at ")]


def timed(*phases: tuple[float, str]) -> Make:
    """A crossroads with this programme."""
    return lambda folder: retime(row("C").net(folder, NO_TURNAROUNDS), tl_logic("C", phases))


FIRST_LEFT, AHEADS = "rrGrrrrrrrrr", "GGgrrrGGgrrr"
PERMISSIVE = timed(
    *((20, AHEADS), (3, "GGyrrrGGyrrr"), (12, "GGrrrrGGrrrr"), (3, "yyrrrryyrrrr"), (2, DARK)),
    *((20, "rrrGGgrrrGGg"), (3, "rrryyyrrryyy"), (2, DARK)),
)
PROTECTED = timed(
    *((12, FIRST_LEFT), (3, "rryrrrrrrrrr"), (2, DARK), (20, "GGrrrrGGrrrr"), (3, "yyrrrryyrrrr"), (2, DARK)),
    *((20, "rrrGGgrrrGGg"), (3, "rrryyyrrryyy"), (2, DARK)),
)


def test_a_green_that_yielded_may_be_cleared_beside_a_protected_one(street_of: StreetOf, record: Path) -> None:
    net = street_of(PERMISSIVE)
    assert judged(net, record, [(20, AHEADS), (3, "GGyrrrGGyrrr"), (20, "GGrrrrGGrrrr")]) == []


def test_a_protected_green_is_not_cleared_beside_another(street_of: StreetOf, record: Path) -> None:
    net = street_of(PROTECTED)
    (reason, *_) = judged(net, record, [(20, FIRST_LEFT), (3, "GGyrrrGGrrrr"), (20, "GGrrrrGGrrrr")])
    assert "conflict and are open together" in reason


def test_a_protected_green_that_began_to_yield_may_be_cleared_beside_another(street_of: StreetOf, record: Path) -> None:
    shown = [(20, FIRST_LEFT), (6, "rrgrrrrrrrrr"), (3, "GGyrrrGGrrrr"), (20, "GGrrrrGGrrrr")]
    assert not [reason for reason in judged(street_of(PERMISSIVE), record, shown) if "conflict" in reason]


def test_a_protected_green_beside_one_that_yields_is_safe_and_beside_a_protected_one_is_not(
    street_of: StreetOf, record: Path
) -> None:
    net = street_of(PERMISSIVE)
    assert judged(net, record, [(30, AHEADS)]) == []
    assert len(judged(net, record, [(30, "GGGrrrGGGrrr")])) == 30


UNEQUAL = timed(
    *((25, "GGgrrrGGgrrr"), (3, "yyyrrryyyrrr"), (1, DARK)),
    *((25, "rrrGGgrrrGGg"), (4, "rrryyyrrryyy"), (5, DARK)),
)
"""Who leaves towards the other street is cleared for 4 s, who comes from it for 9 s."""


@pytest.mark.parametrize(
    ("first_s", "second_s", "reason"),
    [
        ((3, 1), (4, 5), ""),
        ((3, 0), (4, 6), "too soon"),
        ((3, 2), (4, 4), "too soon"),
        ((3, 5), (4, 1), "too soon"),
        ((2, 2), (4, 5), "too little yellow"),
        ((4, 0), (4, 5), ""),
        ((4, 0), (3, 6), "too little yellow"),
    ],
    ids=["as the net", "short the first", "short the second", "exchanged", "yellow", "more yellow", "yellow exchanged"],
)
def test_each_change_of_stages_has_the_clearance_that_the_net_gives_it(
    street_of: StreetOf, record: Path, first_s: tuple[int, int], second_s: tuple[int, int], reason: str
) -> None:
    cycle = [
        *((20, "GGgrrrGGgrrr"), (first_s[0], "yyyrrryyyrrr"), (first_s[1], DARK)),
        *((20, "rrrGGgrrrGGg"), (second_s[0], "rrryyyrrryyy"), (second_s[1], DARK)),
    ]
    found = judged(street_of(UNEQUAL), record, [phase for phase in 2 * cycle if phase[0]])
    assert all(reason in line for line in found)
    assert bool(found) == bool(reason)


def test_the_rules_are_read_off_the_programme_at_its_shortest(street_of: StreetOf) -> None:
    """North is green in both of two stages and between them, south in the first only."""
    net = street_of(odd_nets.lagging_green)
    rules = monitor._Rules.of(net, net.junctions[0])
    assert net.min_green_s.tolist() == [10, 10, 10]
    north, south, east = NORTH + AHEAD, SOUTH + AHEAD, EAST + AHEAD
    assert (rules.green_s[north], rules.green_s[south], rules.green_s[east]) == (25, 10, 10)
    assert set(rules.yellow_s) == {3}
    # From the end of one to the begin of another, least stages between: 3 + 2, and 3 + 2 + 10 + 3 + 2.
    assert (rules.between_s[north][east], rules.between_s[south][east], rules.between_s[east][north]) == (5, 20, 5)


def test_a_green_that_goes_round_the_cycle_has_its_least_over_both_its_parts(street_of: StreetOf) -> None:
    turned = timed(
        *((12, "GGGrrrrrrrrr"), (3, "yyyrrrrrrrrr"), (2, DARK), (20, "rrrGGgrrrGGg"), (3, "rrryyyrrryyy")),
        *((15, "GGgrrrGGgrrr"), (3, "GGgrrryyyrrr"), (2, "GGgrrrrrrrrr")),
    )
    net = street_of(turned)
    rules = monitor._Rules.of(net, net.junctions[0])
    assert rules.green_s[NORTH + AHEAD] == 10 + 3 + 2 + 10
    assert rules.green_s[SOUTH + AHEAD] == 10


SHOWN_NETS = [
    odd_nets.plain,
    odd_nets.pedestrians,
    odd_nets.protected_crossings,
    odd_nets.turning_pockets,
    odd_nets.right_on_red,
    odd_nets.leading_green,
    odd_nets.lagging_green,
    odd_nets.yellow_forgotten,
    odd_nets.green_too_soon,
    odd_nets.red_and_amber,
    odd_nets.green_beside_amber,
    odd_nets.joined,
    odd_nets.short_greens,
]


@pytest.mark.parametrize("make", SHOWN_NETS, ids=lambda make: make.__name__)
@given(seed=st.integers(0, 2**32 - 1))
def test_whatever_plan_is_admitted_is_safe_on_any_net(street_of: StreetOf, record: Path, make: Make, seed: int) -> None:
    net = street_of(make)
    green_s = signals.admit(Plan(random_greens(net, np.random.default_rng(seed))), net).green_s
    for index in range(len(net.junctions)):
        cycle = [(seconds, state) for state, seconds in signals.cycle_phases(net, index, green_s)]
        assert judged(net, record, 3 * cycle, index) == []


@pytest.mark.parametrize("make", SHOWN_NETS, ids=lambda make: make.__name__)
def test_a_plan_with_a_second_less_of_any_least_green_or_yellow_is_unsafe(
    street_of: StreetOf, record: Path, make: Make
) -> None:
    net = street_of(make)
    for index, junction in enumerate(net.junctions):
        cycle = [(seconds, state) for state, seconds in signals.cycle_phases(net, index, net.min_green_s)]
        ends = {  # Where somebody's green ends with the stage, or somebody's yellow with this part of a clearance.
            place
            for place, (_, state) in enumerate(cycle)
            for was, now in zip(state, cycle[(place + 1) % len(cycle)][1], strict=True)
            if (was in "yY" and now not in "yY") or (was in "Gg" and now not in "Gg")
        }
        assert judged(net, record, 3 * cycle, index) == []
        for place in sorted(ends):
            seconds, state = cycle[place]
            short = [(seconds - 1, state) if at == place else phase for at, phase in enumerate(cycle)]
            assert judged(net, record, [phase for phase in [*cycle, *short, *cycle] if phase[0]], index), (
                junction.id,
                cycle[place],
            )
