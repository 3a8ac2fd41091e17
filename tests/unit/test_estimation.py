"""Detector counts become a state that conserves vehicles and stays within what the road can hold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo.contract import EXIT, Floats, Measurement, Network, State
from utn_sumo.estimation import SURELY_BLOCKED_SHARE, CountingEstimator

SEEDS = st.integers(0, 2**32 - 1)
WATCHED_M = 200


@pytest.fixture(params=["utn17", "utn17-long"], scope="module")
def net(request: pytest.FixtureRequest, utn17: Network, utn17_long: Network) -> Network:
    return utn17 if request.param == "utn17" else utn17_long


def counted(net: Network, **counts: Floats) -> Measurement:
    """A measurement in which whatever is not given is zero."""
    links = np.zeros(len(net.links))
    by_link = ("entered_veh", "queue_veh", "seen_veh", "entry_occupancy", "stop_line_occupancy")
    every = dict.fromkeys(by_link, links)
    return Measurement(time_s=120.0, **{**every, "turned_veh": np.zeros(len(net.turns)), **counts})


def by_link(net: Network, by_turn: Floats) -> Floats:
    return np.bincount(net.turn_link, by_turn, minlength=len(net.links))


def spread(net: Network, by_link: Floats) -> Floats:
    """Counts by link, spread over the turns by their fractions."""
    return net.fraction * by_link[net.turn_link]


def some_counts(net: Network, rng: np.random.Generator) -> Measurement:
    def counts(most: int) -> Floats:
        return rng.integers(0, most, len(net.links)) * rng.integers(0, 2, len(net.links)).astype(float)

    seen = np.minimum(counts(130), net.storage_veh)
    return counted(
        net,
        entered_veh=counts(60),
        turned_veh=rng.integers(0, 40, len(net.turns)) * (rng.random(len(net.turns)) > 0.3),
        seen_veh=seen,
        queue_veh=np.floor(1.2 * seen * rng.random(len(net.links))),
    )


def assert_within_bounds(net: Network, seen: Measurement, state: State) -> None:
    queue = by_link(net, state.q_veh)
    assert state.q_veh.min() >= 0
    assert (queue <= state.x_veh + 1e-9).all()
    assert (state.x_veh >= seen.seen_veh - 1e-9).all()
    unseen_share = 1 - WATCHED_M / np.array([link.length_m for link in net.links])
    assert (state.x_veh <= seen.seen_veh + unseen_share * net.storage_veh + 1e-9).all()
    assert (queue >= np.minimum(seen.queue_veh, state.x_veh) - 1e-6).all()
    assert state.source_queue_veh.min() >= 0
    assert (state.source_queue_veh[~net.is_source] == 0).all()
    assert state.turned_veh == pytest.approx(seen.turned_veh)


@given(seed=SEEDS)
def test_the_state_stays_within_its_bounds_whatever_was_counted(net: Network, seed: int) -> None:
    rng, estimator = np.random.default_rng(seed), CountingEstimator(net)
    for _ in range(6):
        seen = some_counts(net, rng)
        assert_within_bounds(net, seen, estimator.update(seen, rng.uniform(0, 40, 17) * net.is_source))


@given(seed=SEEDS)
def test_vehicles_are_counted_in_and_out(net: Network, seed: int) -> None:
    rng, estimator = np.random.default_rng(seed), CountingEstimator(net)
    before = estimator.initial()
    for _ in range(6):
        entered = rng.integers(0, 8, 17).astype(float)
        left = np.minimum(rng.integers(0, 8, 17), before.x_veh)
        after = estimator.update(counted(net, entered_veh=entered, turned_veh=spread(net, left)), np.zeros(17))
        assert after.x_veh == pytest.approx(before.x_veh + entered - left)
        before = after


def test_a_miscount_is_mended_by_what_the_lane_area_detectors_see(utn17: Network) -> None:
    estimator = CountingEstimator(utn17)
    lost = estimator.update(counted(utn17, turned_veh=spread(utn17, np.full(17, 5.0))), np.zeros(17))
    assert lost.x_veh.tolist() == [0] * 17
    found = estimator.update(counted(utn17, seen_veh=np.full(17, 12.0)), np.zeros(17))
    assert found.x_veh.tolist() == [12] * 17
    ghosts = estimator.update(counted(utn17, entered_veh=np.full(17, 500.0)), np.zeros(17))
    assert (ghosts.x_veh < utn17.storage_veh).all()


def test_a_view_full_of_standing_traffic_means_a_queue_beyond_it(utn17: Network) -> None:
    estimator = CountingEstimator(utn17)
    full = counted(utn17, entered_veh=np.full(17, 90.0), seen_veh=np.full(17, 52.0), queue_veh=np.full(17, 50.0))
    assert by_link(utn17, estimator.update(full, np.zeros(17)).q_veh) == pytest.approx(90 - 2)


def test_queued_traffic_is_split_by_where_it_wants_to_go(utn17: Network) -> None:
    estimator = CountingEstimator(utn17)
    queue = np.full(17, 20.0)
    state = estimator.update(counted(utn17, entered_veh=queue, seen_veh=queue, queue_veh=queue), np.zeros(17))
    assert state.q_veh == pytest.approx(20 * utn17.fraction)


def test_who_was_served_is_no_longer_queued(utn17: Network) -> None:
    estimator = CountingEstimator(utn17)
    queue = np.full(17, 20.0)
    estimator.update(counted(utn17, entered_veh=queue, seen_veh=queue, queue_veh=queue), np.zeros(17))
    exits = utn17.turn_next == EXIT
    gone = np.where(exits, 20 * utn17.fraction, 0)
    rest = queue - by_link(utn17, gone)
    seen = counted(utn17, turned_veh=gone, seen_veh=rest, queue_veh=rest)
    state = estimator.update(seen, np.zeros(17))
    assert state.q_veh[exits] == pytest.approx(0, abs=1e-6)
    assert state.q_veh[~exits] == pytest.approx(20 * utn17.fraction[~exits])


def test_expected_traffic_that_does_not_enter_a_full_source_link_waits_outside(utn17: Network) -> None:
    estimator = CountingEstimator(utn17)
    x = np.ceil(SURELY_BLOCKED_SHARE * utn17.storage_veh)
    expected = 15.0 * utn17.is_source
    first = estimator.update(counted(utn17, entered_veh=x, seen_veh=x), expected + x)
    assert first.source_queue_veh == pytest.approx(15 * utn17.is_source)
    second = estimator.update(counted(utn17, seen_veh=x), expected)
    assert second.source_queue_veh == pytest.approx(30 * utn17.is_source)
    third = estimator.update(counted(utn17, turned_veh=spread(utn17, x - 2), seen_veh=np.full(17, 2.0)), expected)
    assert third.source_queue_veh.tolist() == [0] * 17


def test_nobody_waits_outside_a_link_with_plenty_of_room(utn17: Network) -> None:
    state = CountingEstimator(utn17).update(counted(utn17), np.full(17, 30.0))
    assert state.source_queue_veh.tolist() == [0] * 17


def test_past_inflows_are_kept_newest_first(net: Network) -> None:
    estimator = CountingEstimator(net)
    for count in range(1, 6):
        state = estimator.update(counted(net, entered_veh=np.full(17, float(count))), np.zeros(17))
    assert state.past_inflow_veh[:, 0].tolist() == [5, 4, 3, 2][: net.delay_steps]


def test_a_state_once_given_out_does_not_change(utn17: Network) -> None:
    estimator = CountingEstimator(utn17)
    state = estimator.initial()
    estimator.update(counted(utn17, entered_veh=np.full(17, 9.0)), np.zeros(17))
    assert state.x_veh.sum() == 0
    assert state.past_inflow_veh.sum() == 0
