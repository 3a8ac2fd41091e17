"""Who gives way goes in the gaps of what comes towards him; lanes part where somebody does; loads are even."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.unit.views import by_the_line, scene
from utn_controllers.scheduled.execution import Scheduled
from utn_controllers.scheduled.flows import Flows
from utn_controllers.scheduled.gaps import Gaps, let_go, opens_at
from utn_controllers.scheduled.streams import Streams
from utn_sumo.clearances import GIVES_WAY
from utn_sumo.contract import Floats, Network
from utn_sumo.network.lanes import lane_sets

Make = Callable[[Path], Any]
StreetOf = Callable[[Make], Network]
BINS = 12


def green(waiting: float) -> Gaps:
    """A stage in which the first stream, of one lane from which a vehicle leaves in a bin, gives way to the second."""
    waits = np.array([[waiting, 0.0]])
    return Gaps(waits, waits, np.array([[[1, -1], [-1, -1]]]), np.array([True]), 2.0)


def queues(waiting: float, towards_veh: float, come_veh: float = 0.0, goes_now: float | None = None) -> list[float]:
    """What is left in each bin of a green of ten vehicles that give way to a queue and to who comes towards them.

    As it begins, or of one in which `goes_now` of the lane does.
    """
    gaps = green(waiting)
    veh, come = np.array([10.0, towards_veh]), np.zeros((2, BINS))
    come[1] = come_veh
    pace, want, left = np.ones(2), np.zeros(2), []
    if goes_now is None:
        opens_at(0, gaps, pace)
    else:
        pace[0] = goes_now
    for bin_ in range(BINS):
        let_go(0, bin_, veh, come, np.ones(2), np.ones((1, 2)), np.array([[0, 1, -1]]), gaps, pace, want)
        left.append(float(veh[0]))
    return left


def test_with_nobody_towards_him_he_goes_as_if_he_had_way() -> None:
    assert queues(1.0, 0.0, goes_now=1.0) == pytest.approx(np.maximum(10.0 - np.arange(1, BINS + 1), 0.0))


def test_hardly_anybody_goes_until_the_queue_towards_him_has() -> None:
    left = -np.diff([10.0, *queues(1.0, 6.0)])
    assert (left[:6] < 0.2).all()
    assert (left[7:] > 0.9).all()


@given(come=st.floats(0.0, 1.0), more=st.floats(0.01, 0.5), share=st.floats(0.1, 0.9))
def test_the_more_come_towards_him_the_fewer_go_and_the_more_of_a_lane_waits(
    come: float, more: float, share: float
) -> None:
    assert queues(1.0, 0.0, come)[-1] <= queues(1.0, 0.0, come + more)[-1]
    assert queues(share, 0.0, come)[-1] <= queues(1.0, 0.0, come)[-1] + 1e-9


@given(share=st.floats(0.1, 1.0), come=st.floats(0.1, 1.0))
def test_a_lane_in_front_of_which_somebody_waits_lets_fewer_go_than_one_that_goes_but_soon_as_many(
    share: float, come: float
) -> None:
    # As long as the queue lasts.
    stands, goes = (-np.diff([10.0, *queues(share, 0.0, come, goes_now)])[:8] for goes_now in (0.0, 1.0))
    assert (stands <= goes).all()
    assert (np.diff(goes - stands) <= 0).all()
    assert goes[0] - stands[0] > 2 * (goes[-1] - stands[-1])


@pytest.mark.parametrize("share", [0.15, 0.4, 1.0])
@pytest.mark.parametrize("come", [0.3, 0.7])
def test_as_many_go_as_on_average_where_each_finds_his_gap_by_chance(share: float, come: float) -> None:
    """Beside lanes of vehicles of which some wait for gaps, drawn one by one."""
    rng, lanes = np.random.default_rng(7), 20_000
    found, stands, gone = np.exp(-2.0 * come), np.zeros(lanes, dtype=bool), np.zeros(lanes)
    for _ in range(BINS):
        # Who waits in front has found his gap some time in the bin; of those who come there some find none.
        freed = stands & (rng.random(lanes) < found)
        stopped = ~stands & (rng.random(lanes) < share) & (rng.random(lanes) >= found)
        gone += np.where(stands, 0.5 * freed, 1.0 - 0.5 * stopped)
        stands = (stands & ~freed) | stopped
    assert 10.0 - queues(share, 0.0, come, goes_now=1.0)[-1] == pytest.approx(min(gone.mean(), 10.0), rel=0.02)


def test_whether_a_lane_goes_shows_in_who_has_gone(street_of: StreetOf) -> None:
    network = street_of(odd_nets.plain)
    execution = Scheduled(network)
    giving, streams, flows = execution._giving, execution._streams, Flows(network)
    present = np.array([streams.first_stage[junction] for junction in range(len(network.junctions))])
    asked = np.ones(len(network.junctions), dtype=np.bool_)
    waits = giving.gaps.waiting[present[0], : streams.first[1]] > 0
    assert waits.any()

    def paces(gone: float, begin_s: float = 0.0, veh: float = 8.0) -> Floats:
        """A decision after one at which there was a queue, with such a share of the saturation flow gone since."""
        queue = by_the_line(np.full(len(network.lane_sets), veh))
        for now_s, share in ((20.0, 0.0), (22.0, gone)):
            view = scene(network, now_s)
            view.begin_s[:] = begin_s
            view = replace(view, left_veh=2.0 * share * network.set_saturation_flow_veh_s)
            pace = giving.look(view, asked, present, flows.look(view, asked, queue))
            flows._before_veh[:] = 0.0
        return np.asarray(pace[: streams.first[1]])

    for gone in (0.0, 0.5, 1.0, 2.0):
        assert paces(gone)[waits] == pytest.approx(min(gone, 1.0))
        assert (paces(gone)[~waits] == 1.0).all()
    # As a green begins nobody can have gone yet, and where nobody is nobody stands.
    assert (paces(0.0, begin_s=19.0) == 1.0).all()
    assert (paces(0.0, veh=0.0) == 1.0).all()


def test_who_has_gone_is_counted_from_look_to_look(street_of: StreetOf) -> None:
    network = street_of(odd_nets.plain)
    flows, sets = Flows(network), len(network.lane_sets)
    asked = np.ones(len(network.junctions), dtype=np.bool_)
    queue, nobody = (by_the_line(np.full(sets, veh)) for veh in (3.0, 0.0))

    def look(now_s: float, gone_s: float, zone: Floats, is_asked: bool = True) -> tuple[float, bool, float, float]:
        """After so many seconds of saturation flow; all lane sets are alike."""
        view = replace(scene(network, now_s), left_veh=gone_s * network.set_saturation_flow_veh_s)
        found = flows.look(view, asked & is_asked, zone)
        assert all(np.allclose(each, each[0]) for each in found)
        return float(found.share[0]), bool(found.queued[0]), float(found.since_s[0]), float(found.idle_s[0])

    assert look(10.0, 4.0, queue) == pytest.approx((0.4, False, 10.0, 0.0))
    assert look(12.0, 5.0, queue, is_asked=False) == pytest.approx((0.0, True, 0.0, 0.0))
    assert look(14.0, 6.0, queue) == pytest.approx((0.5, True, 4.0, 0.0))
    assert look(16.0, 6.0, queue) == pytest.approx((0.0, True, 2.0, 2.0))
    assert look(18.0, 6.0, queue) == pytest.approx((0.0, True, 2.0, 4.0))
    assert look(20.0, 6.0, nobody) == pytest.approx((0.0, True, 2.0, 0.0))
    assert look(22.0, 7.0, queue) == pytest.approx((0.5, False, 2.0, 0.0))


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


def test_lanes_part_where_somebody_gives_way_and_else_not() -> None:
    ways = {0: {7: {0}, 8: {1}}, 1: {8: {2}}, 2: {8: {3}, 9: {4}}}
    assert lane_sets(ways, ["GGGGG", "rrrrr"]) == [((0, 1, 2), {7: {0}, 8: {1, 2, 3}, 9: {4}})]
    assert [lanes for lanes, _ in lane_sets(ways, ["GGGGg", "rrrrr"])] == [(0,), (1,), (2,)]
    alike = {0: {8: {0}}, 1: {8: {1}}, 2: {8: {2}, 9: {3}}}
    assert [lanes for lanes, _ in lane_sets(alike, ["GGGg", "rrrr"])] == [(0, 1), (2,)]


def test_who_has_a_choice_of_lanes_takes_the_emptier_ones(street_of: StreetOf) -> None:
    network = street_of(odd_nets.plain)
    streams = Streams(network)
    shares = streams.shares(network.fraction)
    by_link = np.bincount(network.set_link, shares.set_of_link, len(network.links))
    assert by_link == pytest.approx(1.0)
    assert np.bincount(streams.lane_set, shares.of_set)[np.unique(streams.lane_set)] == pytest.approx(1.0)
