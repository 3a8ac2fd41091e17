"""Long queues that go in turn: where, when, and in which order."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.integration import odd_nets
from tests.unit.test_scheduled import Crossing
from utn_controllers.scheduled.rounds import FAR_BEYOND, Rounds, have_rounds, in_turn
from utn_controllers.scheduled.streams import Streams
from utn_sumo.contract import Bools, Network

Make = Callable[[Path], Path]


def any_order(network: Network) -> Bools:
    counts = [len(junction.stages) for junction in network.junctions]
    return np.ones((sum(counts), max(counts)), dtype=np.bool_)


class TestWhere:
    @pytest.mark.parametrize(
        ("make", "rounds"),
        [
            (odd_nets.arm_by_arm, True),
            # Two stages; left turns in the gaps of a stage and in one of their own.
            (odd_nets.two_lanes, False),
            (odd_nets.actuated_left_turns, False),
        ],
    )
    def test_it_is_where_each_of_many_roads_has_a_stage_of_its_own(
        self, make: Make, rounds: bool, street_of: Callable[[Make], Network]
    ) -> None:
        network = street_of(make)
        assert have_rounds(Streams(network), any_order(network)).any() == rounds

    @pytest.mark.parametrize(("links", "rounds"), [([0, 1, 2, 3, 4], True), ([0, 1, 2, 3, 0], False)])
    def test_it_is_not_where_a_road_s_left_turn_has_a_stage_of_its_own(self, links: list[int], rounds: bool) -> None:
        bounds = np.array([0, 5])
        serves = np.eye(5, dtype=np.bool_)
        streams: Any = SimpleNamespace(first=bounds, first_stage=bounds, serves=serves, link=np.array(links))
        assert have_rounds(streams, np.ones((5, 5), dtype=np.bool_)).tolist() == [rounds]

    def test_it_is_not_where_the_order_is_given(self, street_of: Callable[[Make], Network]) -> None:
        network = street_of(odd_nets.arm_by_arm)
        given_order = np.roll(np.eye(4, dtype=np.bool_), 1, axis=1)
        assert not have_rounds(Streams(network), given_order).any()

    def test_it_is_when_far_more_are_there_than_can_go(self, street_of: Callable[[Make], Network]) -> None:
        network = street_of(odd_nets.arm_by_arm)
        rounds = Rounds(Streams(network), any_order(network), np.array([40]))
        for times, far in ((0.0, False), (0.99, False), (1.01, True), (9.0, True)):
            found = rounds.look(100 * times, np.array([2]), np.array([40 * FAR_BEYOND * times]))
            assert found.tolist() == [far]
            assert rounds.shown_s.tolist() == [-np.inf, -np.inf, 100 * times, -np.inf]


class TestOrder:
    @given(data=st.data())
    def test_who_is_called_has_green_once_in_the_order_of_last_time_and_nobody_else(self, data: st.DataObject) -> None:
        stages = data.draw(st.integers(1, 6))
        many: Any = st.lists(st.booleans(), min_size=stages, max_size=stages)
        called = np.array(data.draw(many))
        times = st.lists(st.integers(0, 3), min_size=stages, max_size=stages)
        shown_s = np.array(data.draw(times), dtype=float)
        present = data.draw(st.integers(0, stages - 1))
        called[present] = True
        follows = in_turn(called, present, shown_s)
        order, stage = [], present
        for _ in range(called.sum()):
            (after,) = np.flatnonzero(follows[stage])
            order.append(stage := int(after))
        assert order[-1] == present
        assert sorted(order) == np.flatnonzero(called).tolist()
        assert not follows[~called].any()
        assert (np.diff(shown_s[order[:-1]]) >= 0).all()

    def test_a_schedule_goes_by_turns_to_a_queue_that_is_shorter(self) -> None:
        crossing, stand = Crossing((2,) * 4, (2,) * 4), [0.0, 9.0, 18.0, 12.0]
        assert crossing.decide(stand, most=[1.0, 1.0, 3.0, 1.0])[0] == 2
        for first in (1, 2, 3):
            shown_s = [80.0, 60.0, 50.0, 40.0]
            shown_s[first] = 10.0
            assert crossing.decide(stand, most=[1.0, 1.0, 3.0, 1.0], shown_s=shown_s)[0] == first
        # Not to a stage that nobody needs.
        assert crossing.decide([0.0, 0.0, 18.0, 12.0], shown_s=[80.0, 10.0, 50.0, 60.0])[0] == 2
