"""A lane group is one queue with a saturation flow of its own, in the model and in what the estimator makes of it."""

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
from utn_sumo.contract import EXIT, Floats, Measurement, Network, State
from utn_sumo.estimation import Estimator
from utn_sumo.model import LinkModel, ModelState
from utn_sumo.testing import random_split

StreetOf = Callable[[Callable[[Path], Any]], Network]
SEEDS = st.integers(0, 2**32 - 1)
STEP_S = 60.0


@pytest.fixture(scope="module")
def pockets(street_of: StreetOf) -> Network:
    """A crossroads whose left turns have lanes of their own."""
    return street_of(odd_nets.turning_pockets)


@pytest.fixture(scope="module")
def sides(street_of: StreetOf) -> Network:
    """Two crossroads and two side roads between them."""
    return street_of(odd_nets.side_streets)


def turns_of(net: Network, link: str) -> dict[str, int]:
    index = net.link_index(link)
    return {turn.to_edge: place for place, turn in enumerate(net.turns) if turn.link == index}


def with_queues(model: LinkModel, queue_veh: dict[int, float]) -> ModelState:
    """So many queued by turn, and nobody else."""
    q = np.zeros(len(model.network.turns))
    for turn, veh in queue_veh.items():
        q[turn] = veh
    nothing = np.zeros(len(model.network.links))
    return ModelState(model.by_link(q), q, nothing, (nothing,) * model.lags)


def leaving(net: Network, queue_veh: dict[int, float], green_s: float, fraction: Floats | None = None) -> Floats:
    model, nobody = LinkModel(net, STEP_S), np.zeros(len(net.links))
    greens = np.zeros(len(net.stages))
    _, flows = model.step(
        with_queues(model, queue_veh), greens, nobody, net.fraction if fraction is None else fraction, held_s=green_s
    )
    return np.asarray(flows.leaving_veh)


def test_a_pockets_queue_leaves_with_the_pockets_saturation_flow_alone(pockets: Network) -> None:
    turns = turns_of(pockets, "pW-C")
    left, ahead = turns["C-nC"], turns["C-E"]
    lane_veh_s = pockets.saturation_flow_veh_s[pockets.link_index("pW-C")] / 2
    gone = leaving(pockets, {left: 15.0, ahead: 5.0}, 20.0)
    assert gone[left] == pytest.approx(20 * lane_veh_s)
    # Ahead and right share the other lane as they share its traffic.
    assert gone[ahead] == pytest.approx(20 * lane_veh_s / 2)


def test_how_many_wait_in_the_pocket_does_not_slow_the_lane_beside_it(pockets: Network) -> None:
    turns = turns_of(pockets, "pW-C")
    left, beside = turns["C-nC"], [turns["C-E"], turns["C-sC"]]
    alone, crowded = (leaving(pockets, {left: veh, beside[0]: 5.0}, 20.0)[beside] for veh in (0.0, 15.0))
    assert crowded == pytest.approx(alone)


@given(seed=SEEDS)
def test_the_turns_of_a_group_share_its_saturation_flow_as_they_share_its_traffic(pockets: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    model, fraction = LinkModel(pockets, STEP_S), random_split(pockets, rng)
    green_s = rng.uniform(0, STEP_S, len(pockets.groups))
    through = model.saturated_veh(green_s[pockets.turn_group], fraction)
    by_group = np.bincount(pockets.turn_group, through)
    assert by_group == pytest.approx(pockets.group_saturation_flow_veh_s * green_s)
    in_group = np.bincount(pockets.turn_group, fraction)[pockets.turn_group]
    assert through * in_group == pytest.approx(fraction * by_group[pockets.turn_group])


@given(seed=SEEDS)
def test_where_a_link_is_one_group_its_turns_have_their_share_of_the_link(utn17: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    model, fraction = LinkModel(utn17, STEP_S), random_split(utn17, rng)
    green_s = rng.uniform(0, STEP_S, len(utn17.turns))
    assert len(utn17.groups) == len(utn17.links)
    expected = fraction * utn17.saturation_flow_veh_s[utn17.turn_link] * green_s
    assert model.saturated_veh(green_s, fraction) == pytest.approx(expected)


@pytest.mark.parametrize("unused", ["C-nC", "C-E"])
def test_turns_that_nobody_takes_let_nobody_out_and_take_nothing_from_the_others(pockets: Network, unused: str) -> None:
    turns = turns_of(pockets, "pW-C")
    own = list(turns.values())
    fraction = pockets.fraction.copy()
    fraction[turns[unused]] = 0.0
    fraction[own] /= fraction[own].sum()
    gone = leaving(pockets, dict.fromkeys(own, 5.0), 10.0, fraction)
    assert np.isfinite(gone).all()
    assert gone[turns[unused]] == 0
    lane_veh = 10 * pockets.saturation_flow_veh_s[pockets.link_index("pW-C")] / 2
    by_group = np.bincount(pockets.turn_group, gone)
    groups = {pockets.turns[turn].group for turn in own if fraction[turn] > 0}
    assert by_group[sorted(groups)] == pytest.approx(lane_veh)


def counted(net: Network, **readings: Floats) -> Measurement:
    """What is not given is zero."""
    links, samples = np.zeros(len(net.links)), np.zeros((net.samples, len(net.links)))
    nothing: dict[str, Any] = dict.fromkeys(
        ("queue_veh", "seen_veh", "beside_veh", "uncounted_veh", "entry_occupancy", "stop_line_occupancy"), links
    )
    nothing |= {"entered_veh": samples, "turned_veh": np.zeros(len(net.turns))}
    return Measurement(
        time_s=0.0,
        **{
            **nothing,
            "group_queue_veh": np.zeros(len(net.groups)),
            "group_seen_veh": np.zeros(len(net.groups)),
            **readings,
        },
    )


def estimated(net: Network, *seen: Measurement) -> State:
    estimator = Estimator(net, net)
    for each in seen:
        state = estimator.update(each, np.zeros(len(net.links)))
    return state


def standing(net: Network, by_group: Floats) -> dict[str, Floats]:
    """Readings of so many who stand on the lanes of each group, all in view."""
    by_link = np.bincount(net.group_link, by_group, len(net.links))
    return {"group_queue_veh": by_group, "group_seen_veh": by_group, "queue_veh": by_link, "seen_veh": by_link}


@given(seed=SEEDS)
def test_who_stands_on_the_lanes_of_a_group_is_queued_for_its_turns(pockets: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    by_group = rng.integers(0, 6, len(pockets.groups)).astype(float)
    state = estimated(pockets, counted(pockets, **standing(pockets, by_group)))
    assert np.bincount(pockets.turn_group, state.q_veh) == pytest.approx(by_group)


def test_a_full_pocket_leaves_the_queue_of_the_lane_beside_it_as_it_is(pockets: Network) -> None:
    by_group = np.zeros(len(pockets.groups))
    turns = turns_of(pockets, "pW-C")
    by_group[pockets.turns[turns["C-nC"]].group] = 6.0
    state = estimated(pockets, counted(pockets, **standing(pockets, by_group)))
    assert state.q_veh[turns["C-nC"]] == pytest.approx(6)
    assert state.q_veh[[turns["C-E"], turns["C-sC"]]] == pytest.approx(0)


def test_who_stands_before_the_lanes_part_is_shared_out_as_the_traffic(pockets: Network) -> None:
    readings = standing(pockets, np.zeros(len(pockets.groups)))
    index, turns = pockets.link_index("pW-C"), turns_of(pockets, "pW-C")
    many = np.zeros(len(pockets.links))
    many[index] = 9.0
    state = estimated(pockets, counted(pockets, **{**readings, "queue_veh": many, "seen_veh": many}))
    assert state.q_veh[list(turns.values())] == pytest.approx(9 * pockets.fraction[list(turns.values())], rel=1e-6)


@given(seed=SEEDS)
def test_whatever_stands_where_queues_are_what_is_seen_and_within_x(pockets: Network, seed: int) -> None:
    rng, estimator = np.random.default_rng(seed), Estimator(pockets, pockets)
    for _ in range(5):
        by_group = rng.integers(0, 12, len(pockets.groups)) * rng.integers(0, 2, len(pockets.groups)).astype(float)
        readings = standing(pockets, by_group)
        before = rng.integers(0, 10, len(pockets.links))
        readings["queue_veh"] = readings["queue_veh"] + before
        readings["seen_veh"] = readings["queue_veh"] + rng.integers(0, 5, len(pockets.links))
        turned = rng.integers(0, 9, len(pockets.turns)).astype(float)
        state = estimator.update(counted(pockets, turned_veh=turned, **readings), np.zeros(len(pockets.links)))
        queue = np.bincount(pockets.turn_link, state.q_veh)
        assert state.q_veh.min() >= 0
        assert (queue <= state.x_veh + 1e-9).all()
        assert (queue >= np.minimum(readings["queue_veh"], state.x_veh) - 1e-6).all()
        fits = queue >= readings["queue_veh"] - 1e-6
        by_turn_group = np.bincount(pockets.turn_group, state.q_veh)
        assert (by_turn_group >= by_group - 1e-6)[fits[pockets.group_link]].all()


@given(seed=SEEDS)
def test_who_comes_and_goes_at_side_roads_is_counted_in_and_out(sides: Network, seed: int) -> None:
    rng, estimator = np.random.default_rng(seed), Estimator(sides, sides)
    links = len(sides.links)
    has_sides = np.array([bool(link.joining) for link in sides.links])
    assert has_sides.sum() == 2
    true_veh = np.zeros(links)
    for _ in range(30):
        entered = np.floor(rng.uniform(0, 2.1, (sides.samples, links)))
        left = np.floor(rng.uniform(0, 1, links) * true_veh)
        beside = has_sides * np.maximum(rng.integers(-5, 9, links), left - true_veh)
        true_veh = true_veh + entered.sum(axis=0) + beside - left
        seen = counted(
            sides,
            entered_veh=entered,
            beside_veh=beside,
            turned_veh=sides.fraction * left[sides.turn_link],
            # Only the links with side roads are longer than what is watched of them.
            seen_veh=true_veh - has_sides * np.minimum(0.3 * sides.storage_veh * rng.uniform(0, 1, links), true_veh),
        )
        state = estimator.update(seen, np.zeros(links))
        assert state.x_veh == pytest.approx(true_veh)
        assert state.disturbance_veh == pytest.approx(beside)


def test_who_parts_onto_another_link_amid_it_is_in_one_place_only(sides: Network) -> None:
    """One side's loop may be where another link's traffic comes on: what one loses the other has."""
    there, back = sides.link_index("u-B"), sides.link_index("t-A")
    start = np.zeros((sides.samples, len(sides.links)))
    start[0, [there, back]] = 10.0
    over = np.zeros(len(sides.links))
    over[there], over[back] = -4.0, 4.0
    first = counted(sides, entered_veh=start)
    states = estimated(sides, first), estimated(sides, first, counted(sides, beside_veh=over))
    assert [state.x_veh[[there, back]].tolist() for state in states] == [[10, 10], [6, 14]]


def test_who_came_on_amid_a_link_is_there_though_not_in_view_and_no_ghost_for_long(sides: Network) -> None:
    estimator, nobody = Estimator(sides, sides, disturbance_veh=4.0), np.zeros(len(sides.links))
    index, beside = sides.link_index("u-B"), nobody.copy()
    beside[index] = 20.0
    assert estimator.update(counted(sides, beside_veh=beside), nobody).x_veh[index] > 15
    for _ in range(3):
        state = estimator.update(counted(sides), nobody)
    assert state.x_veh[index] < 2


def test_side_roads_mend_with_what_is_seen_where_loops_miscount(sides: Network) -> None:
    estimator, links = Estimator(sides, sides, loop_error=0.05), np.zeros(len(sides.links))
    has_sides = np.array([bool(link.joining) for link in sides.links])
    for _ in range(40):
        # Ten come on beside, ten leave by their turns, and one loop in ten misses one.
        left = 10.0 * has_sides
        seen = counted(
            sides, beside_veh=0.9 * left, turned_veh=sides.fraction * left[sides.turn_link], seen_veh=6.0 * has_sides
        )
        state = estimator.update(seen, links)
    assert state.x_veh[has_sides] == pytest.approx(6, abs=1)


@given(seed=SEEDS)
def test_with_groups_vehicles_are_conserved_and_fit(pockets: Network, seed: int) -> None:
    rng, net = np.random.default_rng(seed), pockets
    model = LinkModel(net, STEP_S)
    x = rng.uniform(0, 1, len(net.links)) * net.storage_veh
    nothing = np.zeros(len(net.links))
    split = random_split(net, rng)
    state = ModelState(x, split * x[net.turn_link], nothing, (nothing,) * model.lags)
    for _ in range(6):
        demand, fraction = 30 * rng.random(len(net.links)) * net.is_source, random_split(net, rng)
        greens = rng.uniform(0, STEP_S, len(net.stages))
        before = (state.x_veh + state.source_queue_veh).sum()
        state, flows = model.step(state, greens, demand, fraction)
        gone = flows.leaving_veh[net.turn_next == EXIT].sum()
        assert (state.x_veh + state.source_queue_veh).sum() == pytest.approx(before + demand.sum() - gone)
        assert state.q_veh.min() >= -1e-9
        assert (model.by_link(state.q_veh) <= state.x_veh + 1e-9).all()
        assert (state.x_veh <= net.storage_veh + 1e-9).all()


def test_a_lane_that_no_turn_uses_gives_nothing(utn17: Network) -> None:
    narrow = replace(utn17, lane_sets=tuple(replace(each, lanes=each.lanes[:1]) for each in utn17.lane_sets))
    assert narrow.group_saturation_flow_veh_s == pytest.approx(utn17.group_saturation_flow_veh_s / 2)
