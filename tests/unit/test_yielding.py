"""Left turns that give way: as slow as they have been of late, and a stage of their own when they need it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.integration import odd_nets
from tests.unit.views import by_the_line, scene
from utn_controllers.scheduled.ending import are_alone
from utn_controllers.scheduled.execution import Scheduled
from utn_controllers.scheduled.moves import Moves
from utn_controllers.scheduled.streams import Streams
from utn_controllers.scheduled.yielding import BLOCKED_S, LEAST_SHARE, Yielding
from utn_sumo.contract import Floats, Network

Make = Callable[[Path], Any]
StreetOf = Callable[[Make], Network]
QUEUE_VEH = 8.0


def left_turns(network: Network) -> list[int]:
    """Lane groups that give way in one stage and have another one to themselves."""
    streams = Streams(network)
    moves = Moves(network, streams, 2, are_alone(network, streams))
    return np.flatnonzero(Yielding(network, streams, moves).learnt.any(axis=0)).tolist()


def through_stage(network: Network, group: int) -> int:
    """The stage in which it gives way."""
    return next(
        s for s, stage in enumerate(network.stages) if "g" in stage.state and turns_of(network, group) & {*stage.turns}
    )


def turns_of(network: Network, group: int) -> set[int]:
    return set(np.flatnonzero(network.turn_group == group).tolist())


def single_lanes(folder: Path, *greens: str) -> Path:
    """All turns of a road have one lane; north and south have these stages, east and west one."""
    shown = (
        phase
        for green in greens
        for phase in ((20, green), (3, green.replace("G", "y").replace("g", "y")), (2, odd_nets.DARK))
    )
    net = odd_nets.row("C").net(folder, odd_nets.NO_TURNAROUNDS)
    odd_nets.retime(net, odd_nets.tl_logic("C", (*shown, *odd_nets.TWO_STAGES[3:])))
    return odd_nets.case(folder, odd_nets.traffic("C"))


def arrows_and_arms(folder: Path) -> Path:
    """Left turns from north and south have arrows, as netconvert has it; then the north, and the south, alone."""
    return single_lanes(folder, odd_nets.NORTH_SOUTH, "rrGrrrrrGrrr", "GGGrrrrrrrrr", "rrrrrrGGGrrr")


def an_arrow_for_a_shared_lane(folder: Path) -> Path:
    """Left turns from the north have an arrow: others may stand before it."""
    return single_lanes(folder, odd_nets.NORTH_SOUTH, "rrGrrrrrrrrr")


def parts_of_a_lane(folder: Path) -> Path:
    """A stage for all but left turns, one for right turns alone and one for left turns from the north alone."""
    return single_lanes(folder, "GGrrrrGGrrrr", "GrrrrrGrrrrr", "rrGrrrrrrrrr")


@pytest.fixture
def arrows(street_of: StreetOf) -> Network:
    return street_of(odd_nets.actuated_left_turns)


def test_left_turns_in_pockets_with_arrows_give_way_and_have_a_stage_of_their_own(arrows: Network) -> None:
    groups = left_turns(arrows)
    assert len(groups) == 4
    assert all(len(arrows.groups[group].lanes) == 1 for group in groups)


def among_people(folder: Path) -> Path:
    """Two lanes a road, left turns from the inner one in gaps of their opposites, and people walk meanwhile."""
    odd_nets.row("C", lanes=2).net(folder, odd_nets.NO_TURNAROUNDS, "--sidewalks.guess", "--crossings.guess")
    return odd_nets.case(folder, odd_nets.traffic("C") + odd_nets.walkers("W-C", "C-E"))


def beside_people(folder: Path) -> Path:
    """The same, but whoever walks has green for himself."""
    case = among_people(folder)
    phases = [
        phase
        for green in ("gGGgrrrrgGGgrrrr", "rrrrgGGgrrrrgGGg")
        for phase in ((20, green + "rrrr"), (3, green.replace("G", "y").replace("g", "y") + "rrrr"))
    ]
    logic = odd_nets.tl_logic("C", [*phases, (10, "r" * 16 + "GGGG"), (5, "r" * 20)])
    odd_nets.retime(next(folder.glob("*.net.xml")), logic)
    return case


@pytest.mark.parametrize("make", [odd_nets.plain, odd_nets.pedestrians, odd_nets.two_lanes, beside_people])
def test_who_never_has_a_stage_alone_is_left_as_it_is(make: Make, street_of: StreetOf) -> None:
    assert left_turns(street_of(make)) == []


def test_on_a_road_of_one_lane_a_stage_for_a_part_of_it_is_none_to_itself(street_of: StreetOf) -> None:
    assert left_turns(street_of(an_arrow_for_a_shared_lane)) == []
    network = street_of(arrows_and_arms)
    assert sorted(network.group_link[left_turns(network)].tolist()) == sorted(
        network.link_index(link) for link in ("nC-C", "sC-C")
    )


def an_arrow_for_a_shared_lane_of_two(folder: Path) -> Path:
    """Left turns from north and south have an arrow, those who go on from the same lane have none."""
    net = odd_nets.row("C", lanes=2).net(folder, odd_nets.NO_TURNAROUNDS)
    greens = ("gGGgrrrrgGGgrrrr", "rrrGrrrrrrrGrrrr", "rrrrgGGgrrrrgGGg")
    odd_nets.retime(
        net,
        odd_nets.tl_logic(
            "C",
            [phase for state in greens for phase in ((20, state), (3, state.replace("G", "y").replace("g", "y")))],
        ),
    )
    return odd_nets.case(folder, odd_nets.traffic("C"))


def test_in_a_stage_for_a_part_of_a_lane_beside_others_it_has_what_it_had_of_late(street_of: StreetOf) -> None:
    network = street_of(an_arrow_for_a_shared_lane_of_two)
    streams = Streams(network)
    all_moves = Moves(network, streams, 2, are_alone(network, streams))
    learning, moves = Yielding(network, streams, all_moves), all_moves.share
    arrow = next(row for row, stage in enumerate(streams.stage) if "g" not in network.stages[stage].state)
    turning = np.flatnonzero(streams.serves[arrow])
    assert len(turning) == 2
    assert learning.learnt[arrow, streams.lane_set[turning]].all()
    queue = by_the_line(np.full(len(network.lane_sets), QUEUE_VEH))
    # In each green somebody goes for some seconds, then the next has red.
    left_veh = np.zeros(len(network.lane_sets))
    for green in range(10):
        for second in (0, 3, 6, 9):
            left_veh += network.set_saturation_flow_veh_s * (3 if second == 6 else 0)
            view = replace(
                scene(network, 60.0 * green + second), begin_s=np.array([60.0 * green]), left_veh=left_veh.copy()
            )
            learning.look(view, np.array([True]), np.array([arrow]), queue)
    assert (moves[arrow, turning] < 0.8).all()
    assert (moves[arrow, turning] > 0.2).all()


def test_left_turns_among_people_have_what_they_had_on_average_also_while_who_walks_is_cleared(
    street_of: StreetOf,
) -> None:
    network = street_of(among_people)
    streams = Streams(network)
    all_moves = Moves(network, streams, 2, are_alone(network, streams))
    learning, moves = Yielding(network, streams, all_moves), all_moves.share
    rows, sets = learning.learnt.nonzero()
    # Of each road the inner of two lanes.
    assert sorted(network.set_link[sets].tolist()) == list(range(4))
    # Nobody is thought to wait for gaps besides.
    assert not Scheduled(network)._giving.gaps.some.any()
    row, lane_set = int(rows[0]), int(sets[0])
    own = np.flatnonzero((streams.lane_set == lane_set) & streams.serves[row])[0]
    cleared = np.flatnonzero((all_moves.after == row) & (moves[:, own] > 0))
    assert len(cleared) > 0
    before = moves[cleared].copy()
    queue = by_the_line(np.full(len(network.lane_sets), QUEUE_VEH))
    left_veh, shares = np.zeros(len(network.lane_sets)), []
    # Nobody goes for some seconds, then a few at once: on average 0.3 of the discharge.
    for second in range(0, 600, 2):
        view = replace(scene(network, float(second)), left_veh=left_veh.copy())
        learning.look(view, np.array([True]), np.array([row]), queue)
        shares.append(float(moves[row, own]))
        left_veh[lane_set] += 10 * 0.3 * network.set_saturation_flow_veh_s[lane_set] * (second % 10 == 8)
    assert shares[0] == 1.0
    # It is forgotten a little meanwhile.
    late = np.array(shares[250:])
    assert 0.3 < late.min() < late.max() < 0.45
    assert np.ptp(late) < 0.05
    assert moves[cleared, own] == pytest.approx(before[:, own] * shares[-1])
    others = np.flatnonzero(~np.isin(np.arange(moves.shape[1]), own) & ~learning.learnt[row, streams.lane_set])
    assert (moves[cleared][:, others] == before[:, others]).all()


@pytest.mark.parametrize("flow", [0.0, 0.3, 1.0])
def test_its_share_is_what_has_gone_of_late_and_is_forgotten(flow: float, arrows: Network) -> None:
    streams = Streams(arrows)
    all_moves = Moves(arrows, streams, 2, are_alone(arrows, streams))
    learning, group, moves = Yielding(arrows, streams, all_moves), left_turns(arrows)[0], all_moves.share
    stage = through_stage(arrows, group)
    row, junction = np.array([streams.stage.tolist().index(stage)]), np.array([True])
    present = np.where(np.arange(len(arrows.junctions)) == arrows.stages[stage].junction, row, 0)
    saturated_veh_s = arrows.group_saturation_flow_veh_s

    def look(now_s: float, zone: Floats) -> None:
        view = replace(scene(arrows, now_s), left_veh=flow * saturated_veh_s * now_s)
        learning.look(view, np.broadcast_to(junction, len(arrows.junctions)), present, zone)

    queue = by_the_line(np.full(len(arrows.groups), QUEUE_VEH))
    for now_s in np.arange(0.0, 200.0, 2.0):
        look(now_s, queue)
    share = learning._share[row[0], group]
    assert share == pytest.approx(max(flow, LEAST_SHARE), abs=0.05)
    own = np.flatnonzero((streams.group == group) & streams.serves[row[0]])
    first = streams.first[arrows.stages[stage].junction]
    assert (moves[row[0], own - first] == share).all()
    # In the stage of its own it goes as fast as ever.
    assert (learning._share[np.arange(len(streams.stage)) != row[0], group] == 1.0).all()
    for now_s in np.arange(200.0, 20_000.0, 100.0):
        look(now_s, np.zeros_like(queue))
    assert learning._share[row[0], group] > 0.95


@pytest.mark.parametrize(("goes", "changes"), [(False, True), (True, False)])
def test_who_finds_no_gap_gets_the_stage_of_their_own(goes: bool, changes: bool, arrows: Network) -> None:
    group = left_turns(arrows)[0]
    stage = through_stage(arrows, group)
    junction = arrows.stages[stage].junction
    served = arrows.turn_group[list(arrows.stages[stage].turns)]
    # They have a queue that does not end, and nobody else is there.
    near_veh = np.zeros(len(arrows.groups))
    near_veh[np.intersect1d(served, left_turns(arrows))] = QUEUE_VEH
    shown = np.array([each.stages[0] for each in arrows.junctions])
    shown[junction] = stage
    flow_veh_s = arrows.group_saturation_flow_veh_s * np.where(
        np.isin(np.arange(len(near_veh)), left_turns(arrows)), goes, 1
    )
    execution, wishes = Scheduled(arrows), []
    for now_s in np.arange(0.0, 120.0, 2.0):
        view = replace(scene(arrows, now_s, shown), set_zone_veh=by_the_line(near_veh), left_veh=flow_veh_s * now_s)
        wishes.append(int(execution.wish(view)[junction]))
    assert wishes[0] == stage
    assert (wishes[-1] != stage) == changes
    own = [
        s
        for s in arrows.junctions[junction].stages
        if s != stage and turns_of(arrows, group) & {*arrows.stages[s].turns}
    ]
    assert wishes[-1] in ([*own] if changes else [stage])


def test_a_green_for_a_part_of_a_queue_is_of_no_use_from_when_nobody_of_it_goes_until_somebody_has(
    street_of: StreetOf,
) -> None:
    network = street_of(an_arrow_for_a_shared_lane)
    streams = Streams(network)
    all_moves = Moves(network, streams, 2, are_alone(network, streams))
    learning, moves = Yielding(network, streams, all_moves), all_moves.share
    arrow = next(row for row, stage in enumerate(streams.stage) if "g" not in network.stages[stage].state)
    turning = np.flatnonzero(streams.serves[arrow])
    lane_set = streams.lane_set[turning[0]]
    own = turning[streams.lane_set[turning] == lane_set]
    queue = by_the_line(np.full(len(network.groups), QUEUE_VEH))
    left_veh = np.zeros(len(network.lane_sets))

    def look(now_s: float, row: int) -> None:
        view = replace(scene(network, now_s), left_veh=left_veh.copy())
        learning.look(view, np.array([True]), np.array([row]), queue)

    for now_s in np.arange(0.0, BLOCKED_S, 2.0):
        look(now_s, arrow)
        assert (moves[arrow, own] == 1).all()
    for now_s in np.arange(BLOCKED_S, 3 * BLOCKED_S, 2.0):
        look(now_s, arrow)
        assert (moves[arrow, own] == LEAST_SHARE).all()
    # In another stage, in which nobody goes either, that is still so.
    look(3 * BLOCKED_S, 1 - arrow)
    assert (moves[arrow, own] == LEAST_SHARE).all()
    left_veh[lane_set] += 1
    look(3 * BLOCKED_S + 2, 1 - arrow)
    assert (moves[arrow, own] == 1).all()


def test_short_greens_in_which_nobody_goes_add_up_for_all_stages_that_serve_no_more(street_of: StreetOf) -> None:
    network = street_of(parts_of_a_lane)
    streams = Streams(network)
    all_moves = Moves(network, streams, 2, are_alone(network, streams))
    learning, moves = Yielding(network, streams, all_moves), all_moves.share
    shown = [network.stages[stage].state for stage in streams.stage]
    most, right, left = (shown.index(each) for each in ("GGrrrrGGrrrr", "GrrrrrGrrrrr", "rrGrrrrrrrrr"))
    across = shown.index(odd_nets.EAST_WEST)
    queue = by_the_line(np.full(len(network.groups), QUEUE_VEH))
    left_veh = np.zeros(len(network.lane_sets))
    green_s = 0.8 * BLOCKED_S

    def look(row: int, begin_s: float) -> list[bool]:
        """Of which of the three stages it is thought, after this green, that all go who have green in it."""
        view = replace(scene(network, begin_s + green_s), begin_s=np.array([begin_s]), left_veh=left_veh.copy())
        learning.look(view, np.array([True]), np.array([row]), queue)
        return [bool((moves[each, streams.serves[each]] == 1).all()) for each in (most, right, left)]

    assert look(most, 0.0) == [True, True, True]
    assert look(across, 10.0) == [True, True, True]
    assert look(most, 20.0) == [False, False, True]
    left_veh += 1
    assert look(left, 30.0) == [True, True, True]
    # Who does not go with right turns alone may go with those who go ahead too.
    assert look(right, 40.0) == [True, True, True]
    assert look(right, 50.0) == [True, False, True]
