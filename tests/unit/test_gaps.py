"""Who gives way goes in the gaps of what comes towards him; lanes part where somebody does; loads are even."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import sumolib
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from tests.integration import odd_nets
from tests.unit.views import by_the_line, scene
from utn_controllers.scheduled.execution import Scheduled
from utn_controllers.scheduled.gaps import AMID_VEH, GAP_S, HEADWAY_S, Gaps, Giving, clear, headways, let_go
from utn_controllers.scheduled.streams import Streams
from utn_sumo.clearances import GIVES_WAY
from utn_sumo.contract import EXIT, Floats, Network
from utn_sumo.network import load
from utn_sumo.network.lanes import lane_sets, unevenness

Make = Callable[[Path], Any]
StreetOf = Callable[[Make], Network]
BINS, BIN_S = 12, 2.0


def queues(
    waiting: float,
    towards_veh: float,
    come_veh: float = 0.0,
    *,
    beside: bool = False,
    shut: bool = False,
    flowing: float = 1.0,
    gap_s: float = GAP_S,
) -> list[float]:
    """What is left in each bin of a green of ten vehicles that give way to a queue and to who comes towards them.

    Whether there are lanes `beside` theirs, of which the share `flowing` has nobody who waits in front, and whether he
    waits in vain.
    """
    gaps = Gaps(
        np.array([[waiting, 0.0]]),
        np.array([[[1, -1], [-1, -1]]]),
        np.full((1, 2), 2.0),
        np.array([True]),
        np.array([[beside, False]]),
        np.zeros((1, 2), dtype=bool),
        np.array([[shut, False]]),
        np.ones((1, 2)),
        np.ones((1, 2)),
        np.full((1, 2), gap_s),
        BIN_S,
    )
    veh, come = np.array([10.0, towards_veh]), np.zeros((2, BINS))
    come[1] = come_veh
    pace, free, left, kept = np.ones(2), np.array([flowing, 1.0]), [], np.zeros((3, 2))
    for bin_ in range(BINS):
        let_go(0, bin_, veh, come, np.ones(2), np.ones((1, 2)), np.array([[0, 1, -1]]), gaps, pace, free, *kept)
        left.append(float(veh[0]))
    return left


def facing(waiting: tuple[float, float], queued_veh: float, *, has_room: bool = True) -> tuple[Floats, Floats]:
    """Of two roads of one lane that face each other: who goes in each bin of a green, and who stands amid at its end.

    Twenty vehicles stand on the first and `queued_veh` on the second, of which these shares wait for gaps.
    """
    gaps = Gaps(
        np.array([waiting]), np.array([[[1, -1], [0, -1]]]), np.ones((1, 2)), np.array([True]),
        np.zeros((1, 2), dtype=bool), np.full((1, 2), has_room), np.zeros((1, 2), dtype=bool),
        *np.ones((2, 1, 2)), np.full((1, 2), GAP_S), BIN_S,
    )  # fmt: skip
    veh, come, going = np.array([20.0, queued_veh]), np.zeros((2, BINS)), np.array([[0, 1, -1]])
    pace, free, to_come, *kept = np.ones((5, 2))
    stood = [veh.copy()]
    for bin_ in range(BINS):
        let_go(0, bin_, veh, come, np.ones(2), np.ones((1, 2)), going, gaps, pace, free, to_come, *kept)
        stood.append(veh.copy())
    amid = np.zeros(2)
    clear(0, np.full(2, 10.0), np.ones(2), going, gaps, pace, to_come, amid)
    return -np.diff(stood, axis=0), amid


@given(one=st.floats(0.1, 0.9), other=st.floats(0.1, 0.9))
def test_two_single_lanes_go_until_somebody_waits_then_both_have_what_one_lane_discharges(
    one: float, other: float
) -> None:
    goes, amid = facing((one, other), 20.0)
    assert goes[0] == pytest.approx(np.ones(2))
    assert 0.85 < goes[-1].sum() < 1.35
    # That lane goes the more of which fewer wait.
    assert (goes[-1, 0] - goes[-1, 1]) * (other - one) >= -1e-9
    # Who does not go stands amid it as the green ends.
    assert amid == pytest.approx(1 - goes[-1], abs=0.01)


def test_nobody_is_thought_to_stand_amid_it_before_few_who_come_towards_him() -> None:
    goes, amid = facing((0.3, 0.3), 0.5)
    assert (goes[2:6, 0] > 0.9).all()
    assert amid[0] == 0


def test_before_full_roads_they_find_gaps_as_in_what_comes_at_random() -> None:
    assert facing((0.3, 0.3), 20.0, has_room=False)[0][0, 0] < 1


def test_with_nobody_towards_him_he_goes_as_if_he_had_way() -> None:
    assert queues(1.0, 0.0) == pytest.approx(np.maximum(10.0 - np.arange(1, BINS + 1), 0.0))


@given(share=st.floats(0.05, 1.0), more=st.floats(0.0, 0.5), towards=st.floats(0.0, 5.0))
def test_before_a_road_within_the_junction_that_has_red_a_lane_goes_up_to_the_first_who_takes_it(
    share: float, more: float, towards: float
) -> None:
    left = queues(share, towards, shut=True)
    # It is no matter who comes towards them, and the sooner one takes that road the fewer go.
    assert left == pytest.approx(queues(share, 0.0, shut=True))
    assert left[0] == pytest.approx(9.0)
    assert left[-1] <= queues(min(share + more, 1.0), towards, shut=True)[-1] + 1e-9
    assert queues(1.0, towards, shut=True)[-1] == pytest.approx(9.0)


def test_hardly_anybody_goes_until_the_queue_towards_him_has() -> None:
    left = -np.diff([10.0, *queues(1.0, 6.0)])
    assert (left[:6] < 0.2).all()
    assert (left[6:] > 0.9).all()


def test_a_lane_with_others_beside_it_goes_until_one_who_finds_no_gap_comes_to_its_front() -> None:
    share = 0.2
    left = -np.diff([10.0, *queues(share, 12.0, beside=True)])
    # The first goes for sure, each after him if nobody before him waits there.
    assert left[:3] == pytest.approx([1.0, 1 - share, (1 - share) ** (2 - share)])
    assert (np.diff(left) < 0).all()


def test_where_such_a_lane_stands_nobody_goes_as_long_as_there_is_a_queue_towards_it() -> None:
    for share in (0.05, 0.5, 1.0):
        left = -np.diff([10.0, *queues(share, 6.0, beside=True, flowing=0.0)])
        assert left[:6] == pytest.approx(np.zeros(6))
        assert left[-1] == pytest.approx(1.0)


def test_lanes_without_others_beside_them_go_on_average_however_they_have_gone() -> None:
    assert queues(0.2, 6.0, flowing=0.0) == queues(0.2, 6.0)


@pytest.mark.parametrize("rate_veh_s", [0.02, 0.1, 0.3, 0.6])
def test_who_waits_does_so_until_the_first_gap_that_lasts(rate_veh_s: float) -> None:
    rng, waits_s = np.random.default_rng(1), []
    for _ in range(5000):
        waited_s = 0.0
        while (gap_s := rng.exponential(1 / rate_veh_s)) < GAP_S:
            waited_s += gap_s
        waits_s.append(waited_s)
    assert headways(rate_veh_s * GAP_S, GAP_S) * HEADWAY_S == pytest.approx(np.mean(waits_s), rel=0.1)


def test_nobody_waits_without_oncoming_traffic_and_for_ever_where_it_never_ends() -> None:
    assert headways(0.0, GAP_S) == 0
    assert headways(1e3, GAP_S) == np.inf


@given(pace=st.floats(0.0, 1.0), to_come=st.floats(0.0, 1.0), queued_veh=st.floats(0.0, 9.0), lanes=st.integers(1, 3))
def test_two_of_a_lane_that_stands_for_a_gap_go_as_its_green_ends_and_none_of_one_that_goes_or_has_stood(
    pace: float, to_come: float, queued_veh: float, lanes: int
) -> None:
    gaps = Gaps(
        np.array([[0.3, 0.0]]), np.array([[[1, -1], [-1, -1]]]), np.full((1, 2), 2.0), np.array([True]),
        *np.zeros((3, 1, 2), dtype=bool), np.ones((1, 2)), np.ones((1, 2)), np.full((1, 2), GAP_S), BIN_S,
    )  # fmt: skip
    veh, amid, going = np.array([queued_veh, 5.0]), np.ones(2), np.array([[0, 1, -1]])
    clear(0, veh, np.full(2, float(lanes)), going, gaps, np.array([pace, 0.0]), np.array([to_come, 1.0]), amid)
    assert amid[0] == pytest.approx(min(2 * lanes * max(to_come - pace, 0.0), queued_veh))
    assert (amid[1], veh[1]) == (0, 5)
    assert veh[0] + amid[0] == pytest.approx(queued_veh)


@given(come=st.floats(0.0, 1.0), more=st.floats(0.01, 0.5), share=st.floats(0.1, 0.9))
def test_the_more_come_towards_him_the_fewer_go_and_the_more_of_a_lane_waits(
    come: float, more: float, share: float
) -> None:
    assert queues(1.0, 0.0, come)[-1] <= queues(1.0, 0.0, come + more)[-1]
    assert queues(share, 0.0, come)[-1] <= queues(1.0, 0.0, come)[-1] + 1e-9


def test_left_turns_without_a_stage_of_their_own_wait_for_who_comes_straight_on(street_of: StreetOf) -> None:
    network = street_of(odd_nets.plain)
    execution = Scheduled(network)
    gaps, streams = execution._giving.gaps, execution._streams
    for row, stage in enumerate(streams.stage):
        shown = network.stages[stage]
        first = streams.first[shown.junction]
        for stream in np.flatnonzero(streams.serves[row]):
            of_set = np.flatnonzero(streams.serves[row] & (streams.lane_set == streams.lane_set[stream]))
            gives = any(shown.state[letter] == GIVES_WAY for each in of_set for letter in streams.letters[each])
            if gaps.waiting[row, stream - first] > 0:
                assert gives
                foes = gaps.foes[row, stream - first]
                assert all(streams.link[first + foe] != streams.link[stream] for foe in foes[foes >= 0])
    assert gaps.some.any()


@given(share=st.floats(0.1, 1.0), come=st.floats(0.05, 0.5), gap_s=st.floats(4.0, 9.0), beside=st.booleans())
def test_the_farther_it_is_across_the_junction_the_fewer_find_a_gap(
    share: float, come: float, gap_s: float, beside: bool
) -> None:
    near, far = (queues(share, 3.0, come, beside=beside, gap_s=each) for each in (gap_s, gap_s + 1))
    assert all(a <= b + 1e-9 for a, b in zip(near, far, strict=True))
    assert near[-1] < far[-1] or far[-1] == pytest.approx(0.0, abs=1e-6)


def across(radius_m: int) -> Make:
    """A crossroads whose corners are so round."""

    def make(folder: Path) -> Path:
        streets = odd_nets.row("C")
        streets.parts["nodes"][0].set("radius", str(radius_m))
        return streets.net(folder, odd_nets.NO_TURNAROUNDS)

    return make


def test_who_has_farther_to_go_across_the_junction_needs_a_longer_gap(tmp_path: Path) -> None:
    gaps_s = []
    for radius_m in (4, 20):
        (folder := tmp_path / str(radius_m)).mkdir()
        file = across(radius_m)(folder)
        gaps = Scheduled(network := load(str(file)))._giving.gaps
        # As far as from where left turns wait amid the junction to its end.
        net = sumolib.net.readNet(str(file), withInternal=True)
        for turn in network.turns:
            lane = net.getLane(turn.via_lanes[0])
            onward = [each.getViaLaneID() for each in lane.getOutgoing() if each.getViaLaneID()]
            assert turn.crossing_m == pytest.approx(
                sum(net.getLane(each).getLength() for each in onward or [lane.getID()])
            )
        (gap_s,) = set(gaps.gap_s[gaps.waiting > 0].round(6))
        gaps_s.append(gap_s)
    assert gaps_s[0] == GAP_S
    assert gaps_s[1] > GAP_S + 1


def test_nobody_waits_for_gaps_on_lanes_from_which_hardly_anybody_turns(street_of: StreetOf) -> None:
    network = street_of(odd_nets.plain)
    streams = Streams(network)
    none = np.zeros((len(streams.stage), len(network.lane_sets)), dtype=bool)
    held = np.zeros((len(streams.stage), int(np.diff(streams.first).max())), dtype=bool)
    giving = Giving(network, streams, none, 2.0, held, np.array([4]))
    for share, waits in ((0.3, True), (0.02, True), (0.002, False)):
        shares = streams.shares(network.fraction)
        of_set = shares.way_of_set
        giving.take_up(shares._replace(way_of_set=np.where(of_set < 1, share, of_set)))
        assert (giving.gaps.waiting > 0).any() == giving.gaps.some.any() == waits


def test_nobody_counts_as_gone_with_his_green_where_he_goes_on_while_who_walks_is_cleared(street_of: StreetOf) -> None:
    for make, goes_on in ((odd_nets.pedestrians, True), (odd_nets.plain, False)):
        gaps = Scheduled(street_of(make))._giving.gaps
        assert (gaps.waiting > 0).any()
        assert (gaps.amid_veh[gaps.waiting > 0] == (0.0 if goes_on else AMID_VEH)).all()


@pytest.mark.parametrize(
    ("cycle_lost_bins", "left_share", "full"), [(8, 0.2, False), (7, 0.2, False), (7, 0.9, False), (7, 0.9, True)]
)
def test_how_a_lane_goes_is_seen_in_the_green_that_it_has_and_forgotten_with_it(
    cycle_lost_bins: int, left_share: float, full: bool, street_of: StreetOf
) -> None:
    network = street_of(odd_nets.two_lanes)
    streams, stages = Streams(network), network.junctions[0].stages
    learnt, held = (np.zeros((len(stages), count), dtype=bool) for count in (len(network.lane_sets), len(streams.link)))
    giving = Giving(network, streams, learnt, 2.0, held, np.array([cycle_lost_bins]))
    shares = streams.shares(network.fraction)
    giving.take_up(shares._replace(way_of_set=np.where(shares.way_of_set < 1, left_share, shares.way_of_set)))
    rows, everywhere = np.argsort(streams.stage), np.ones(1, dtype=bool)
    waiting, seen = by_the_line(np.full(len(network.lane_sets), 5.0)), []
    stands = int(streams.lane_set[np.flatnonzero(giving.gaps.waiting[rows[stages[0]]] > 0)[0]])
    left, nobody = np.zeros(len(network.lane_sets)), np.zeros(len(streams.link), dtype=bool)
    x_veh, left_ends = network.storage_veh * full, []
    for time_s in np.arange(0.0, 42.0, 2.0):
        stage, begin_s = (stages[0], 0.0) if time_s < 30 else (stages[1], 30.0)
        left += np.where(np.arange(len(left)) == stands, 0.0, 2.0)
        now = replace(scene(network, float(time_s), np.array([stage])), begin_s=np.array([begin_s]), left_veh=left)
        giving.look(replace(now, x_veh=x_veh), everywhere, rows[now.stage], waiting, nobody)
        shown = giving.gaps.flowing[rows[stage], : len(streams.link)]
        assert (shown[streams.lane_set != stands] == 1).all()
        seen.append(float(shown[streams.lane_set == stands][0]))
        # Who waits there has left it: nobody more goes as this green ends, where that counts.
        to_come, waits = giving.gaps.to_come[rows[stage]], giving.gaps.waiting[rows[stage]] > 0
        counts = waits & (cycle_lost_bins >= 4 * len(stages) or left_share > 0.75)
        assert (to_come[~counts] == 1).all()
        if full or left_share < 0.75:
            assert (to_come == np.where(counts, shown, 1)).all()
        left_ends.append(to_come[counts].min(initial=1.0))
    assert seen[:3] == [1.0, 1.0, 1.0]
    # Most of a lane waits until the queue that comes has gone by, and that it stands says nothing of what it will do
    # then: but on a full road it has no time for that.
    assert seen[14] == 1 if left_share > 0.75 and not full else seen[14] < 0.1
    assert left_ends[14] < 0.1 or not counts.any()
    assert seen[16:18] == [1.0, 1.0]


def two_signals(folder: Path) -> Path:
    """Single lanes, two junctions with a road between them."""
    return odd_nets.row("AB").net(folder, odd_nets.NO_TURNAROUNDS)


@pytest.mark.parametrize(("make", "alone"), [(two_signals, True), (odd_nets.two_lanes, False)])
def test_single_lanes_face_each_other_as_long_as_the_roads_that_they_lead_onto_have_room(
    make: Make, alone: bool, street_of: StreetOf
) -> None:
    network = street_of(make)
    streams, giving = Streams(network), Scheduled(network)._giving
    everywhere, nobody = np.ones(len(network.junctions), dtype=bool), np.zeros(len(streams.link), dtype=bool)
    queues_veh = by_the_line(np.zeros(len(network.lane_sets)))
    for full in (np.zeros(len(network.links), dtype=bool), *np.eye(len(network.links), dtype=bool)):
        view = replace(scene(network, 10.0), x_veh=network.storage_veh * full)
        giving.look(view, everywhere, streams.first_stage[:-1], queues_veh, nobody)
        onto_full = np.isin(
            streams.lane_set,
            streams.lane_set[(streams.next_link != EXIT) & full[np.maximum(streams.next_link, 0)]],
        )
        for row, stream in zip(*streams.serves.nonzero(), strict=True):
            place = stream - streams.first[network.stage_junction[streams.stage[row]]]
            assert giving.gaps.facing[row, place] == (alone and not onto_full[stream])


def sets_of(ways: dict[int, dict[int, set[int]]], states: list[str], **share: float) -> list[tuple[int, ...]]:
    """The lanes of each set, where all turns not named (`to8=0.6`) share the rest of the traffic alike."""
    turns = {turn for own in ways.values() for turn in own}
    named = {int(name[2:]): value for name, value in share.items()}
    rest = (1 - sum(named.values())) / max(len(turns - named.keys()), 1)
    return [lanes for lanes, _ in lane_sets(ways, states, {turn: named.get(turn, rest) for turn in turns})]


def test_lanes_part_where_somebody_gives_way_and_else_not() -> None:
    ways = {0: {7: {0}, 8: {1}}, 1: {8: {2}}, 2: {8: {3}, 9: {4}}}
    whole = {7: {0}, 8: {1, 2, 3}, 9: {4}}
    assert lane_sets(ways, ["GGGGG", "rrrrr"], dict.fromkeys(whole, 1 / 3)) == [((0, 1, 2), whole)]
    assert sets_of(ways, ["GGGGg", "rrrrr"]) == [(0,), (1,), (2,)]
    alike = {0: {8: {0}}, 1: {8: {1}}, 2: {8: {2}, 9: {3}}}
    assert sets_of(alike, ["GGGg", "rrrr"]) == [(0, 1), (2,)]


def test_lanes_part_where_one_stands_behind_who_has_red_while_another_goes() -> None:
    ways = {0: {7: {0}, 8: {1}}, 1: {8: {2}, 9: {3}}}
    assert sets_of(ways, ["GGGr", "rrrG"]) == [(0,), (1,)]
    for alike in (["GGGG", "rrrr"], ["GGGG", "Grrr"], ["GGGG", "GrrG"]):
        assert sets_of(ways, alike) == [(0, 1)]
    # Or one has red while another goes.
    assert sets_of(ways, ["GGGG", "rrGG"]) == [(0,), (1,)]


def test_lanes_part_where_one_has_much_more_to_let_go_than_others() -> None:
    ways = {0: {7: {0}, 8: {1}}, 1: {8: {2}}, 2: {8: {3}, 9: {4}}}
    assert sets_of(ways, ["GGGGG", "rrrrr"], to9=0.38) == [(0, 1, 2)]
    assert sets_of(ways, ["GGGGG", "rrrrr"], to9=0.42) == [(0,), (1,), (2,)]
    # Lanes alike stay together, and hardly anybody takes those for buses.
    alike = {0: {8: {0}}, 1: {8: {1}}, 2: {9: {2}}}
    assert sets_of(alike, ["GGG", "rrr"], to9=0.5) == [(0, 1), (2,)]
    assert lane_sets(alike, ["GGG", "rrr"], {8: 0.5, 9: 0.5}, {0}) == [((0,), {8: {0}}), ((1, 2), {8: {1}, 9: {2}})]


def test_lanes_part_at_a_junction_of_many_stages() -> None:
    ways = {0: {7: {0}, 8: {1}}, 1: {8: {2}}}
    assert sets_of(ways, ["GGG", "rrr", "rrr"]) == [(0, 1)]
    assert sets_of(ways, ["GGG", "rrr", "rrr", "rrr"]) == [(0,), (1,)]


@given(
    st.lists(st.tuples(st.integers(0, 3), st.integers(1, 4), st.floats(0.01, 1.0)), min_size=1, max_size=5),
)
def test_how_uneven_lanes_are_is_what_is_left_when_all_share_as_well_as_they_can(
    turns: list[tuple[int, int, float]],
) -> None:
    share = {turn: veh for turn, (_, _, veh) in enumerate(turns)}
    ways = {
        lane: {turn: {turn} for turn, (begin, count, _) in enumerate(turns) if begin <= lane < begin + count}
        for lane in range(max(begin + count for begin, count, _ in turns))
    }
    taken = [(lane, turn) for lane, own in ways.items() for turn in own]
    # The least of the fullest lane's load, by how much of each turn takes each lane, and that load.
    load = np.array([[float(lane == each) for each, _ in taken] + [-1.0] for lane in ways])
    whole = np.array([[float(turn == each) for _, each in taken] + [0.0] for turn in share])
    least = linprog(
        [0.0] * len(taken) + [1.0], A_ub=load, b_ub=np.zeros(len(ways)), A_eq=whole, b_eq=list(share.values())
    ).fun
    assert unevenness(ways, share) == pytest.approx(least / (sum(share.values()) / len(ways)))


def test_lanes_for_buses_are_sets_of_their_own_that_hardly_anybody_takes(street_of: StreetOf) -> None:
    alike = {0: {8: {0}}, 1: {8: {1}}, 2: {8: {2}}}
    assert [lanes for lanes, _ in lane_sets(alike, ["GGG", "rrr"], {8: 1.0}, {0})] == [(0,), (1, 2)]
    network = street_of(odd_nets.bus_lanes)
    streams = Streams(network)
    share = streams.shares(network.fraction).set_of_link
    reserved = np.array([each.is_reserved for each in network.lane_sets])
    assert reserved.sum() == len(network.links)
    assert (share[reserved] < 0.1).all()
    assert np.bincount(network.set_link, share) == pytest.approx(np.ones(len(network.links)))


def test_who_has_a_choice_of_lanes_takes_the_emptier_ones(street_of: StreetOf) -> None:
    network = street_of(odd_nets.plain)
    streams = Streams(network)
    shares = streams.shares(network.fraction)
    by_link = np.bincount(network.set_link, shares.set_of_link, len(network.links))
    assert by_link == pytest.approx(1.0)
    assert np.bincount(streams.lane_set, shares.of_set)[np.unique(streams.lane_set)] == pytest.approx(1.0)
