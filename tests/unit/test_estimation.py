"""Detector counts become a state that conserves vehicles, stays within what the road can hold, and does not drift."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo.contract import EXIT, Floats, Measurement, Network, State
from utn_sumo.detectors import Miscount
from utn_sumo.estimation import Estimator

SEEDS = st.integers(0, 2**32 - 1)
WATCHED_M = 200
LOOP_ERROR = 0.02
FREE_COVER_S = 1.1
"""Time that a vehicle in free traffic covers a loop."""
ANY = 12.0
"""Vehicles a step where the number does not matter."""


@pytest.fixture(params=["utn17", "utn17-long"], scope="module")
def net(request: pytest.FixtureRequest, utn17: Network, utn17_long: Network) -> Network:
    return utn17 if request.param == "utn17" else utn17_long


def each(net: Network, value: float) -> Floats:
    """The same number for every link."""
    return np.full(len(net.links), value)


def over_step(net: Network, entered_veh: Floats) -> Floats:
    """(P, Z) samples of traffic that enters evenly."""
    return np.tile(entered_veh / net.samples, (net.samples, 1))


def occupancy(net: Network, entered_veh: Floats, cover_s: Floats | float) -> Floats:
    """Of the entry loops, when each vehicle covers them for so long."""
    lanes = np.array([len(net.edge_lanes[link.edges[0]]) for link in net.links])
    return np.asarray(np.minimum(entered_veh * cover_s / (lanes * net.control_step_s), 1.0))


def counted(net: Network, *, entered: Floats | None = None, **readings: Floats) -> Measurement:
    """A measurement of traffic that enters freely, by sample (P, Z) or evenly (Z,); what is not given is zero."""
    links = each(net, 0.0)
    entered = links if entered is None else entered
    samples = entered if entered.ndim == 2 else over_step(net, entered)
    rest = dict.fromkeys(("queue_veh", "seen_veh", "beside_veh", "uncounted_veh", "stop_line_occupancy"), links)
    rest["group_queue_veh"] = np.zeros(len(net.groups))
    # One lane group a link.
    rest["group_seen_veh"] = np.asarray(readings.get("seen_veh", links))[net.group_link]
    covered = occupancy(net, samples.sum(axis=0), FREE_COVER_S)
    every = {**rest, "entered_veh": samples, "entry_occupancy": covered, "turned_veh": np.zeros(len(net.turns))}
    return Measurement(time_s=120.0, **{**every, **readings})


def by_link(net: Network, by_turn: Floats) -> Floats:
    return np.bincount(net.turn_link, by_turn, minlength=len(net.links)).astype(float)


def spread(net: Network, by_link: Floats) -> Floats:
    """Counts by link, spread over the turns by their fractions."""
    return net.fraction * by_link[net.turn_link]


def nobody(net: Network) -> Floats:
    """A forecast of no demand."""
    return each(net, 0.0)


def some_counts(net: Network, rng: np.random.Generator) -> Measurement:
    def counts(most: int, *shape: int) -> Floats:
        every = rng.integers(0, most, (*shape, len(net.links))).astype(float)
        return np.asarray(every * rng.integers(0, 2, len(net.links)))

    seen = np.minimum(counts(130), net.storage_veh)
    return counted(
        net,
        entered=counts(6, net.samples),
        turned_veh=np.floor(40 * rng.random(len(net.turns))) * (rng.random(len(net.turns)) > 0.3),
        seen_veh=seen,
        queue_veh=np.floor(1.2 * seen * rng.random(len(net.links))),
        entry_occupancy=rng.uniform(0.01, 1, len(net.links)),
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
    assert state.fraction.min() >= 0
    assert by_link(net, state.fraction) == pytest.approx(1)


class TestWhateverWasCounted:
    @given(seed=SEEDS, loop_error=st.sampled_from([0.0, 0.02, 0.2]))
    def test_the_state_stays_within_its_bounds(self, net: Network, seed: int, loop_error: float) -> None:
        rng, estimator = np.random.default_rng(seed), Estimator(net, net, loop_error)
        for _ in range(6):
            seen = some_counts(net, rng)
            assert_within_bounds(net, seen, estimator.update(seen, rng.uniform(0, 40, 17) * net.is_source))

    def test_the_state_of_an_empty_network_is_within_them_too(self, net: Network) -> None:
        assert_within_bounds(net, counted(net), Estimator(net, net).initial())

    def test_a_state_once_given_out_does_not_change(self, utn17: Network) -> None:
        estimator = Estimator(utn17, utn17, LOOP_ERROR)
        state = estimator.initial()
        before = {name: np.copy(value) for name, value in vars(state).items()}
        for _ in range(3):
            turned = spread(utn17, each(utn17, 5.0))
            estimator.update(counted(utn17, entered=each(utn17, 9.0), turned_veh=turned), each(utn17, 30.0))
        for name, value in before.items():
            np.testing.assert_array_equal(getattr(state, name), value)

    def test_loops_that_tell_no_occupancy_do_no_harm(self, utn17: Network) -> None:
        estimator = Estimator(utn17, utn17)
        for _ in range(3):
            seen = counted(utn17, entered=each(utn17, ANY), entry_occupancy=each(utn17, 0.0))
            state = estimator.update(seen, each(utn17, ANY + 1))
        assert not state.source_queue_veh.any()


class TestExactLoops:
    """loop_error = 0: counts are believed to the last vehicle."""

    @given(seed=SEEDS)
    def test_vehicles_are_counted_in_and_out(self, net: Network, seed: int) -> None:
        rng, estimator = np.random.default_rng(seed), Estimator(net, net)
        before = estimator.initial()
        for _ in range(6):
            entered = rng.integers(0, 8, 17).astype(float)
            left = np.minimum(rng.integers(0, 8, 17), before.x_veh)
            after = estimator.update(counted(net, entered=entered, turned_veh=spread(net, left)), nobody(net))
            assert after.x_veh == pytest.approx(before.x_veh + entered - left)
            before = after

    @given(seed=SEEDS)
    def test_the_count_stays_exact_for_hours_whatever_else_is_seen(self, net: Network, seed: int) -> None:
        rng, estimator = np.random.default_rng(seed), Estimator(net, net)
        true_veh = each(net, 0.0)
        for _ in range(120):
            entered = np.floor(rng.uniform(0, 2.1, (net.samples, 17)))
            left = np.floor(rng.uniform(0, 1, 17) * np.minimum(true_veh, 30.0))
            true_veh = true_veh + entered.sum(axis=0) - left
            hidden = np.minimum(0.3 * net.storage_veh * rng.uniform(0, 1, 17), true_veh)
            seen = counted(net, entered=entered, turned_veh=spread(net, left), seen_veh=true_veh - hidden)
            assert estimator.update(seen, nobody(net)).x_veh == pytest.approx(true_veh)

    def test_a_miscount_is_mended_by_what_the_lane_area_detectors_see(self, utn17: Network) -> None:
        estimator = Estimator(utn17, utn17)
        lost = estimator.update(counted(utn17, turned_veh=spread(utn17, each(utn17, 5.0))), nobody(utn17))
        assert lost.x_veh.tolist() == [0] * 17
        found = estimator.update(counted(utn17, seen_veh=each(utn17, 12.0)), nobody(utn17))
        assert found.x_veh.tolist() == [12] * 17
        ghosts = estimator.update(counted(utn17, entered=each(utn17, 500.0)), nobody(utn17))
        assert (ghosts.x_veh < utn17.storage_veh).all()


class FreeRoad:
    """Traffic that comes at a constant rate and nothing holds up; loops at the exit count a share `more` too many."""

    rate_veh = 25.0

    def __init__(self, net: Network, more: float, loop_error: float):
        self.net = net
        self.more = more
        self.estimator = Estimator(net, net, loop_error)
        self.seen_veh = self.rate_veh / net.control_step_s * WATCHED_M / free_speed_m_s(net)
        self.x_veh = self.rate_veh / net.control_step_s * net.free_time_s
        self._step(self.rate_veh - self.x_veh, self.seen_veh)

    def drive(self, steps: int) -> Floats:
        """(steps, Z) errors of the estimate while as many leave as enter."""
        through = each(self.net, self.rate_veh)
        return np.array([self._step(through, self.seen_veh) - self.x_veh for _ in range(steps)])

    def jam(self, steps: int) -> Floats:
        """(steps, Z) errors while as many leave as enter, after a step in which nobody left."""
        # More than half of what the view holds: of those behind it nothing can be said.
        through, view = each(self.net, self.rate_veh), each(self.net, 30.0)
        first = self._step(each(self.net, 0.0), view) - self.x_veh - self.rate_veh
        rest = [self._step(through, view) - self.x_veh - self.rate_veh for _ in range(steps - 1)]
        return np.array([first, *rest])

    def _step(self, left_veh: Floats, seen_veh: Floats) -> Floats:
        turned = spread(self.net, (1 + self.more) * left_veh)
        seen = counted(self.net, entered=each(self.net, self.rate_veh), turned_veh=turned, seen_veh=seen_veh)
        return self.estimator.update(seen, nobody(self.net)).x_veh


def free_speed_m_s(net: Network) -> Floats:
    return np.array([link.free_speed_m_s for link in net.links])


class TestMiscountingLoops:
    """loop_error > 0: counts are held against what can be seen."""

    @pytest.mark.parametrize("more", [-0.05, -0.02, 0.0, 0.02, 0.05])
    def test_a_count_of_free_traffic_does_not_drift(self, utn17: Network, more: float) -> None:
        errors = np.abs(FreeRoad(utn17, more, LOOP_ERROR).drive(120))
        assert errors.max() <= 1.5
        assert errors[-30:].max() <= 0.2

    @pytest.mark.parametrize("more", [-0.05, 0.05])
    def test_plain_counting_of_the_same_traffic_drifts_until_the_road_itself_ends_it(
        self, utn17: Network, more: float
    ) -> None:
        assert np.abs(FreeRoad(utn17, more, 0.0).drive(120))[-1].min() > 3

    @pytest.mark.parametrize("more", [-0.05, -0.02, 0.02, 0.05])
    def test_what_free_traffic_taught_of_the_loops_holds_through_a_jam(self, utn17: Network, more: float) -> None:
        learned, unlearned = FreeRoad(utn17, more, LOOP_ERROR), FreeRoad(utn17, more, 0.0)
        learned.drive(60)
        assert np.abs(learned.jam(12)).max() <= 0.25 * np.abs(unlearned.jam(12)[-1]).min()

    @given(seed=SEEDS)
    def test_a_loop_error_that_is_not_there_costs_little(self, utn17: Network, seed: int) -> None:
        rng = np.random.default_rng(seed)
        road = FreeRoad(utn17, 0.0, LOOP_ERROR)
        road.seen_veh = road.seen_veh + rng.uniform(-1, 1, 17)
        assert np.abs(road.drive(30)).max() <= 1.5


class TestDisturbance:
    """Vehicles come onto the links amid them, where no loop counts them."""

    def drive(self, net: Network, told_veh: float, steps: int = 60) -> State:
        estimator, coming_veh = Estimator(net, net, 0.0, told_veh), np.linspace(0, 4, 17)
        per_m = FreeRoad.rate_veh / net.control_step_s / free_speed_m_s(net)
        seen = per_m * WATCHED_M + 1.0
        state = estimator.initial()
        for _ in range(steps):
            leaving = spread(net, FreeRoad.rate_veh + coming_veh)
            entered = each(net, FreeRoad.rate_veh)
            state = estimator.update(counted(net, entered=entered, turned_veh=leaving, seen_veh=seen), nobody(net))
        return state

    def test_it_is_found_where_the_road_is_seen_to_hold_more_than_was_counted(self, utn17: Network) -> None:
        state = self.drive(utn17, 2.0)
        assert state.disturbance_veh == pytest.approx(np.linspace(0, 4, 17), abs=0.2)

    def test_where_there_is_none_to_be_none_is_found(self, utn17: Network) -> None:
        assert not self.drive(utn17, 0.0, 5).disturbance_veh.any()


def test_a_crowded_view_corrects_no_count(utn17: Network) -> None:
    states = []
    for loop_error in (0.0, LOOP_ERROR):
        estimator = Estimator(utn17, utn17, loop_error)
        states.append(
            estimator.update(counted(utn17, entered=each(utn17, 60.0), seen_veh=each(utn17, 30.0)), nobody(utn17))
        )
    np.testing.assert_allclose(states[1].x_veh, states[0].x_veh)


class TestQueues:
    def test_a_view_full_of_standing_traffic_means_a_queue_beyond_it(self, utn17: Network) -> None:
        full = counted(utn17, entered=each(utn17, 90.0), seen_veh=each(utn17, 52.0), queue_veh=each(utn17, 50.0))
        state = Estimator(utn17, utn17).update(full, nobody(utn17))
        assert by_link(utn17, state.q_veh) == pytest.approx(90 - 2)

    def test_queued_traffic_is_split_by_where_it_wants_to_go(self, utn17: Network) -> None:
        queue = each(utn17, 20.0)
        standing = counted(utn17, entered=queue, seen_veh=queue, queue_veh=queue)
        state = Estimator(utn17, utn17).update(standing, nobody(utn17))
        assert state.q_veh == pytest.approx(20 * utn17.fraction)

    def test_it_is_split_as_the_calibrated_network_turns(self, utn17: Network) -> None:
        known = turning(utn17, shifted(utn17, 0.1))
        queue = each(utn17, 20.0)
        standing = counted(utn17, entered=queue, seen_veh=queue, queue_veh=queue)
        state = Estimator(utn17, known).update(standing, nobody(utn17))
        assert state.q_veh == pytest.approx(20 * known.fraction)

    def test_who_is_left_in_a_queue_turns_like_any_other(self, utn17: Network) -> None:
        estimator = Estimator(utn17, utn17)
        queue = each(utn17, 20.0)
        before = estimator.update(counted(utn17, entered=queue, seen_veh=queue, queue_veh=queue), nobody(utn17))
        gone = np.where(utn17.turn_next == EXIT, before.q_veh, 0)
        rest = queue - by_link(utn17, gone)
        after = estimator.update(counted(utn17, turned_veh=gone, seen_veh=rest, queue_veh=rest), nobody(utn17))
        # That those at the front happened to leave the network says nothing about those behind them.
        assert after.q_veh == pytest.approx(after.fraction * rest[utn17.turn_link])

    def test_a_turn_whose_own_signal_served_it_is_no_longer_queued(self, utn17: Network) -> None:
        link = utn17.link_index("4")
        onward, leaving = (int(turn) for turn in np.flatnonzero(utn17.turn_link == link))
        first, second = utn17.junctions[1].stages
        apart = list(utn17.stages)
        apart[first] = dataclasses.replace(apart[first], turns=(onward,))
        apart[second] = dataclasses.replace(apart[second], turns=(leaving, *apart[second].turns))
        net = dataclasses.replace(utn17, stages=tuple(apart))
        estimator = Estimator(net, net)
        queue = each(net, 20.0)
        before = estimator.update(counted(net, entered=queue, seen_veh=queue, queue_veh=queue), nobody(net))
        gone = np.where(np.arange(len(net.turns)) == leaving, before.q_veh, 0)
        rest = queue - by_link(net, gone)
        after = estimator.update(counted(net, turned_veh=gone, seen_veh=rest, queue_veh=rest), nobody(net))
        assert after.q_veh[leaving] == pytest.approx(0, abs=1e-6)
        assert after.q_veh[onward] == pytest.approx(before.q_veh[onward])


def shifted(net: Network, share: float) -> Floats:
    """Turning fractions of which the largest of each link has given `share` to the smallest."""
    fraction = net.fraction.copy()
    for link in range(len(net.links)):
        turns = np.flatnonzero(net.turn_link == link)
        order = turns[np.argsort(fraction[turns])]
        fraction[[order[0], order[-1]]] += np.array([share, -share])
    return fraction


def turning(net: Network, fraction: Floats) -> Network:
    """The network with these turning fractions."""
    turns = tuple(
        dataclasses.replace(turn, fraction=float(value)) for turn, value in zip(net.turns, fraction, strict=True)
    )
    return dataclasses.replace(net, turns=turns)


class TestTurning:
    def test_before_anything_is_seen_the_known_fractions_hold(self, net: Network) -> None:
        known = turning(net, shifted(net, 0.15))
        assert Estimator(net, known).initial().fraction == pytest.approx(known.fraction)

    @pytest.mark.parametrize("earlier_steps", [0, 60])
    def test_fractions_follow_a_change(self, utn17: Network, earlier_steps: int) -> None:
        changed, estimator = shifted(utn17, 0.2), Estimator(utn17, utn17)
        busy = each(utn17, 40.0)
        for _ in range(earlier_steps):
            estimator.update(counted(utn17, entered=busy, turned_veh=spread(utn17, busy)), nobody(utn17))
        errors = []
        for _ in range(60):
            turned = changed * busy[utn17.turn_link]
            state = estimator.update(counted(utn17, entered=busy, turned_veh=turned), nobody(utn17))
            errors.append(np.abs(state.fraction - changed).max())
        assert errors[0] > 0.15
        assert (np.diff(errors) < 0).all()
        assert errors[-1] <= 0.05

    @given(seed=SEEDS)
    def test_fractions_follow_a_change_that_chance_blurs(self, utn17: Network, seed: int) -> None:
        rng, changed, estimator = np.random.default_rng(seed), shifted(utn17, 0.2), Estimator(utn17, utn17)
        for _ in range(60):
            turned = rng.poisson(40 * changed).astype(float)
            state = estimator.update(counted(utn17, turned_veh=turned), nobody(utn17))
        error = np.abs(state.fraction - changed)
        assert np.sqrt(np.mean(error**2)) <= 0.05
        assert error.max() < np.abs(utn17.fraction - changed).max() / 2

    @given(vehicles=st.integers(1, 10), turn=st.integers(0, 100))
    def test_a_few_vehicles_hardly_move_them(self, net: Network, vehicles: int, turn: int) -> None:
        turned = np.zeros(len(net.turns))
        turned[turn % len(net.turns)] = vehicles
        state = Estimator(net, net).update(counted(net, turned_veh=turned), nobody(net))
        assert np.abs(state.fraction - net.fraction).max() <= 0.05
        elsewhere = net.turn_link != net.turn_link[turn % len(net.turns)]
        assert state.fraction[elsewhere] == pytest.approx(net.fraction[elsewhere])

    def test_chance_alone_keeps_them_near_the_known_ones(self, net: Network) -> None:
        rng, estimator = np.random.default_rng(7), Estimator(net, net)
        for _ in range(120):
            turned = rng.poisson(15 * net.fraction).astype(float)
            state = estimator.update(counted(net, turned_veh=turned), nobody(net))
        assert np.abs(state.fraction - net.fraction).max() <= 0.05

    def test_what_was_seen_is_forgotten_when_nobody_comes_any_more(self, utn17: Network) -> None:
        estimator = Estimator(utn17, utn17)
        turned = 40 * shifted(utn17, 0.2)
        estimator.update(counted(utn17, turned_veh=turned), nobody(utn17))
        for _ in range(200):
            state = estimator.update(counted(utn17), nobody(utn17))
        assert state.fraction == pytest.approx(utn17.fraction, abs=0.001)


class AtTheEdge:
    """An estimator that has seen its links in free traffic, in which each vehicle covers the loops for so long."""

    def __init__(self, net: Network, free_cover_s: float = FREE_COVER_S):
        self.net = net
        self.estimator = Estimator(net, net)
        self._x_veh = each(net, 0.0)
        for _ in range(5):
            self.step(entered=ANY, cover_s=free_cover_s, expected=ANY)

    def step(self, *, entered: float, cover_s: float, expected: float, x: float = 0.0) -> Floats:
        """Who waits outside after a step that leaves `x` vehicles on each link."""
        net = self.net
        enter = each(net, entered)
        left = np.maximum(self._x_veh + enter - x, 0)
        seen = counted(
            net,
            entered=enter,
            turned_veh=spread(net, left),
            seen_veh=np.minimum(each(net, x), WATCHED_M / 4),
            entry_occupancy=occupancy(net, np.maximum(enter, 1.0), cover_s),
        )
        state = self.estimator.update(seen, each(net, expected))
        self._x_veh = state.x_veh
        return state.source_queue_veh


@pytest.fixture
def edge(utn17: Network) -> AtTheEdge:
    return AtTheEdge(utn17)


STANDING_S = 60.0
"""Time that a vehicle stands on the loops when the link is full up to them."""


class TestWhoWaitsOutside:
    def test_expected_traffic_that_finds_the_entry_covered_waits(self, utn17: Network, edge: AtTheEdge) -> None:
        first = edge.step(entered=5, cover_s=3 * FREE_COVER_S, expected=20)
        assert first == pytest.approx(15 * utn17.is_source)
        second = edge.step(entered=8, cover_s=3 * FREE_COVER_S, expected=20)
        assert second == pytest.approx(27 * utn17.is_source)

    def test_it_waits_though_the_link_itself_is_far_from_full(self, utn17: Network, edge: AtTheEdge) -> None:
        # One lane may be full to its entry while the other is empty.
        x = 0.2 * utn17.storage_veh.min()
        waiting = edge.step(entered=5, cover_s=3 * FREE_COVER_S, expected=20, x=x)
        assert waiting == pytest.approx(15 * utn17.is_source)

    def test_those_who_waited_get_in_when_more_enter_than_were_expected(self, utn17: Network, edge: AtTheEdge) -> None:
        edge.step(entered=0, cover_s=STANDING_S, expected=30)
        assert edge.step(entered=25, cover_s=2 * FREE_COVER_S, expected=15)[utn17.is_source] == pytest.approx(20)
        assert edge.step(entered=45, cover_s=2 * FREE_COVER_S, expected=15).tolist() == [0] * 17

    def test_nobody_waits_where_traffic_enters_freely_however_few_came(self, utn17: Network, edge: AtTheEdge) -> None:
        for entered in (1, 5, 0):
            assert edge.step(entered=entered, cover_s=FREE_COVER_S, expected=30).tolist() == [0] * 17
        half_full = 0.6 * utn17.storage_veh.min()
        for _ in range(20):
            assert edge.step(entered=24, cover_s=FREE_COVER_S, expected=30, x=half_full).tolist() == [0] * 17

    def test_the_queue_is_gone_when_traffic_enters_freely_again(self, edge: AtTheEdge) -> None:
        assert edge.step(entered=2, cover_s=STANDING_S, expected=40).any()
        assert edge.step(entered=ANY, cover_s=FREE_COVER_S, expected=ANY + 3).tolist() == [0] * 17

    @pytest.mark.parametrize("occupied", [0.0, 0.05, 1.0])
    def test_everybody_waits_outside_a_full_link_into_which_nobody_gets(
        self, utn17: Network, edge: AtTheEdge, occupied: float
    ) -> None:
        full = 0.7 * utn17.storage_veh.min()
        edge.step(entered=full, cover_s=FREE_COVER_S, expected=full, x=full)
        shut = counted(utn17, seen_veh=each(utn17, 50.0), entry_occupancy=each(utn17, occupied))
        for step in (1, 2, 3):
            waiting = edge.estimator.update(shut, each(utn17, 20.0)).source_queue_veh
            assert waiting == pytest.approx(20 * step * utn17.is_source)

    def test_a_jam_that_lasts_is_not_taken_for_free_traffic(self, utn17: Network, edge: AtTheEdge) -> None:
        full = 0.7 * utn17.storage_veh.min()
        edge.step(entered=full, cover_s=FREE_COVER_S, expected=full, x=full)
        for step in range(1, 61):
            waiting = edge.step(entered=10, cover_s=3 * FREE_COVER_S, expected=15, x=full)
            assert waiting == pytest.approx(5 * step * utn17.is_source)

    @given(
        entered=st.integers(0, 40), expected=st.integers(0, 40), cover_s=st.tuples(st.floats(0.5, 9), st.floats(0.5, 9))
    )
    def test_the_longer_the_loops_are_covered_the_more_wait(
        self, utn17: Network, entered: int, expected: int, cover_s: tuple[float, float]
    ) -> None:
        few, many = (
            AtTheEdge(utn17).step(entered=entered, cover_s=cover, expected=expected) for cover in sorted(cover_s)
        )
        assert (few <= many + 1e-9).all()
        assert many.max() <= max(expected - entered, 0) + 1e-9

    def test_how_long_free_traffic_covers_a_loop_is_learned(self, utn17: Network) -> None:
        slow = AtTheEdge(utn17, free_cover_s=3 * FREE_COVER_S)
        assert slow.step(entered=5, cover_s=3 * FREE_COVER_S, expected=20).tolist() == [0] * 17
        assert slow.step(entered=5, cover_s=6 * FREE_COVER_S, expected=20) == pytest.approx(15 * utn17.is_source)


class TestPastInflows:
    def test_samples_are_kept_newest_first(self, net: Network) -> None:
        estimator = Estimator(net, net)
        numbers = np.arange(3 * net.samples, dtype=float)
        for step in range(3):
            samples = numbers[step * net.samples : (step + 1) * net.samples]
            state = estimator.update(counted(net, entered=np.tile(samples[:, None], 17)), nobody(net))
        assert state.past_inflow_veh.shape == (net.delay_samples, 17)
        for link in range(17):
            assert state.past_inflow_veh[:, link].tolist() == numbers[::-1][: net.delay_samples].tolist()

    def test_they_reach_back_as_far_as_the_model_needs(self, utn17: Network) -> None:
        links = tuple(dataclasses.replace(link, free_speed_m_s=link.free_speed_m_s / 3) for link in utn17.links)
        known = dataclasses.replace(utn17, links=links)
        assert known.delay_samples > utn17.delay_samples
        estimator = Estimator(utn17, known)
        for state in (estimator.initial(), estimator.update(counted(utn17), nobody(utn17))):
            assert state.past_inflow_veh.shape == (known.delay_samples, 17)


class TestMiscount:
    @given(seed=SEEDS)
    def test_loops_without_error_count_what_there_is(self, net: Network, seed: int) -> None:
        seen = some_counts(net, np.random.default_rng(seed))
        distorted = Miscount(net, 0.0, seed).distort(seen)
        for name, value in vars(seen).items():
            np.testing.assert_array_equal(getattr(distorted, name), value)

    @given(seed=st.integers(0, 2**31 - 1))
    def test_the_same_seed_makes_the_same_mistakes_and_another_one_others(self, utn17: Network, seed: int) -> None:
        def run(seed: int) -> list[Floats]:
            rng, loops = np.random.default_rng(0), Miscount(utn17, 0.05, seed)
            distorted = [loops.distort(some_counts(utn17, rng)) for _ in range(4)]
            return [count for seen in distorted for count in (seen.entered_veh, seen.turned_veh)]

        for first, second in zip(run(seed), run(seed), strict=True):
            np.testing.assert_array_equal(first, second)
        assert any((first != other).any() for first, other in zip(run(seed), run(seed + 1), strict=True))

    @given(seed=SEEDS, loop_error=st.floats(0, 0.2))
    def test_counts_stay_counts_and_nothing_else_is_touched(self, net: Network, seed: int, loop_error: float) -> None:
        seen = some_counts(net, np.random.default_rng(seed))
        before = {name: np.copy(value) for name, value in vars(seen).items()}
        distorted = Miscount(net, loop_error, seed % 2**31).distort(seen)
        for name in ("entered_veh", "turned_veh"):
            count = getattr(distorted, name)
            assert count.shape == before[name].shape
            assert (count >= 0).all()
            assert (count <= 2 * before[name]).all()
            assert (count == np.round(count)).all()
        for name in set(before) - {"entered_veh", "turned_veh"}:
            np.testing.assert_array_equal(getattr(distorted, name), before[name])
        for name, value in before.items():
            np.testing.assert_array_equal(getattr(seen, name), value, err_msg="the true measurement was changed")

    def test_the_shares_spread_as_asked_and_neither_way_more(self, utn17: Network) -> None:
        shares = np.array([share_of(utn17, Miscount(utn17, LOOP_ERROR, seed)) for seed in range(200)])
        deviation = LOOP_ERROR / np.sqrt(shares.size)
        assert abs(shares.mean()) <= 3 * deviation
        assert shares.std() == pytest.approx(LOOP_ERROR, rel=0.03)

    def test_a_loop_keeps_its_share_for_the_whole_run(self, utn17: Network) -> None:
        loops = Miscount(utn17, LOOP_ERROR, 3)
        assert share_of(utn17, loops) == pytest.approx(share_of(utn17, loops), abs=0.003)

    def test_each_loop_only_misses_or_only_counts_twice(self, utn17: Network) -> None:
        loops = Miscount(utn17, 0.2, 5)
        entered, turned = each(utn17, 24.0), np.full(len(utn17.turns), 24.0)
        wrong = []
        for _ in range(50):
            seen = loops.distort(counted(utn17, entered=entered, turned_veh=turned))
            wrong.append(np.concatenate([seen.entered_veh.sum(axis=0) - entered, seen.turned_veh - turned]))
        assert ((np.array(wrong) >= 0).all(axis=0) | (np.array(wrong) <= 0).all(axis=0)).all()


def share_of(net: Network, loops: Miscount) -> Floats:
    """By how much each loop of all counts too much, over very many vehicles."""
    many = 120_000.0
    seen = loops.distort(counted(net, entered=each(net, many), turned_veh=np.full(len(net.turns), many)))
    return np.concatenate([seen.entered_veh.sum(axis=0), seen.turned_veh]) / many - 1
