"""Splits by queues and by pressure: who is before a stage gets it green, who is behind it takes it away."""

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
from utn_controllers.cyclic import CyclicMaxPressure, Proportional
from utn_controllers.tuc import TUC
from utn_sumo import controllers, signals
from utn_sumo.contract import EXIT, Forecast, Network, State
from utn_sumo.errors import SettingError
from utn_sumo.testing import HARD, random_forecast, random_state

seeds = st.integers(0, 2**31)
StreetOf = Callable[[Callable[[Path], Any]], Network]
EVERY = [
    (TUC, {}),
    (Proportional, {"count": "queue"}),
    (Proportional, {"count": "vehicles"}),
    *(
        (CyclicMaxPressure, {"count": count, "per": per})
        for count in ("queue", "vehicles")
        for per in ("lane", "storage")
    ),
    (CyclicMaxPressure, {"per": "none"}),
]
every = pytest.mark.parametrize(("kind", "settings"), EVERY)


def nobody(network: Network) -> State:
    state, _ = HARD["empty"](network, np.random.default_rng(1), 1)
    return replace(state, fraction=network.fraction)


def nobody_comes(network: Network) -> Forecast:
    return Forecast(np.zeros((1, len(network.links))))


def stage_of(network: Network, link: int) -> int:
    """The stage of a link that has one stage."""
    (stage,) = np.flatnonzero(network.serves[:, network.turn_link == link].any(axis=1))
    return int(stage)


def with_more(network: Network, state: State, turn: int, veh: float) -> State:
    """Vehicles more before a turn, all of them queued, and all on their way over it."""
    x, q = state.x_veh.copy(), state.q_veh.copy()
    x[network.turn_link[turn]] += veh
    q[turn] += veh
    return replace(state, x_veh=x, q_veh=q)


@every
@given(seed=seeds, case=st.sampled_from(sorted(HARD)))
def test_every_state_has_greens_that_fill_the_cycles(
    utn17: Network, kind: Any, settings: Any, seed: int, case: str
) -> None:
    state, forecast = HARD[case](utn17, np.random.default_rng(seed), 1)
    plan = kind(utn17, **settings).plan(state, forecast)
    signals.admit(plan, utn17)
    assert np.bincount(utn17.stage_junction, plan.green_s) == pytest.approx(utn17.green_budget_s)
    assert (plan.green_s >= utn17.min_green_s - 1e-6).all()


@every
@given(seed=seeds, veh=st.floats(0, 60))
def test_who_waits_in_greater_number_never_has_less_green(
    utn17: Network, kind: Any, settings: Any, seed: int, veh: float
) -> None:
    rng = np.random.default_rng(seed)
    state, forecast = random_state(utn17, rng), random_forecast(utn17, rng, 1)
    controller = kind(utn17, **settings)
    turn = seed % len(utn17.turns)
    stage = stage_of(utn17, utn17.turn_link[turn])
    more = controller.plan(with_more(utn17, state, turn, veh), forecast).green_s
    assert more[stage] >= controller.plan(state, forecast).green_s[stage] - 1e-6


@given(seed=seeds, scale=st.floats(0.01, 100))
def test_traffic_tenfold_everywhere_is_shared_out_alike(utn17: Network, seed: int, scale: float) -> None:
    rng = np.random.default_rng(seed)
    state, forecast = random_state(utn17, rng), random_forecast(utn17, rng, 1)
    scaled = replace(
        state,
        x_veh=scale * state.x_veh,
        q_veh=scale * state.q_veh,
        source_queue_veh=scale * state.source_queue_veh,
    )
    for kind in (Proportional, CyclicMaxPressure):
        for count in ("queue", "vehicles"):
            once, again = (kind(utn17, count=count).plan(each, forecast).green_s for each in (state, scaled))
            assert again == pytest.approx(once)


@every
def test_where_nobody_is_nor_is_expected_the_cycle_is_shared_out_equally(
    utn17: Network, kind: Any, settings: Any
) -> None:
    plan = kind(utn17, **settings).plan(nobody(utn17), nobody_comes(utn17))
    assert signals.admit(plan, utn17).green_s == pytest.approx(utn17.equal_split().green_s, abs=1)


@every
def test_who_waits_outside_counts_as_before_the_stage(utn17: Network, kind: Any, settings: Any) -> None:
    outside = np.zeros(len(utn17.links))
    outside[0] = 30
    state = replace(nobody(utn17), source_queue_veh=outside)
    green_s = kind(utn17, **settings).plan(state, nobody_comes(utn17)).green_s
    stage = stage_of(utn17, 0)
    assert green_s[stage] > utn17.equal_split().green_s[stage] + 5


@pytest.mark.parametrize("settings", [settings for kind, settings in EVERY if kind is CyclicMaxPressure])
def test_a_full_link_ahead_takes_green_away(utn17: Network, settings: Any) -> None:
    """Before both stages of J4 stands the same; what turns from the first into link 11 is more than from the second."""
    controller = CyclicMaxPressure(utn17, **settings)
    first, second = (utn17.link_index(name) for name in ("8", "9"))
    ahead = utn17.link_index("11")
    state = nobody(utn17)
    x = state.x_veh.copy()
    x[[first, second]] = 60
    free = replace(state, x_veh=x, q_veh=utn17.fraction * x[utn17.turn_link])
    x = x.copy()
    x[ahead] = 80
    full = replace(free, x_veh=x, q_veh=utn17.fraction * x[utn17.turn_link])
    first, second = stage_of(utn17, first), stage_of(utn17, second)
    before, after = controller.worth(free), controller.worth(full)
    assert after[first] < before[first]
    assert after[second] < before[second]
    assert before[first] == pytest.approx(before[second], rel=0.2)
    assert after[first] < 0.8 * after[second]


def test_pressure_by_hand(utn17: Network) -> None:
    """30 vehicles on link 8, 10 on link 11 behind .7 of it, two lanes, 0.87 veh/s; exits hold nobody."""
    state = nobody(utn17)
    x = state.x_veh.copy()
    x[utn17.link_index("8")], x[utn17.link_index("11")] = 30, 10
    turns = np.flatnonzero(utn17.turn_link == utn17.link_index("8"))
    flow = float(utn17.saturation_flow_veh_s[utn17.link_index("8")])
    # Of link 11 one group of two lanes; before, 30 / 2; behind, where link 11's turns share it whole, 10 / 2.
    expected = sum(
        flow * utn17.fraction[turn] * (15 - (5 if utn17.turn_next[turn] != EXIT else 0)) for turn in turns.tolist()
    )
    stage = stage_of(utn17, utn17.link_index("8"))
    assert CyclicMaxPressure(utn17).worth(replace(state, x_veh=x))[stage] == pytest.approx(expected)


def test_of_lane_groups_of_one_stage_the_fullest_counts(street_of: StreetOf) -> None:
    net = street_of(odd_nets.turning_pockets)
    controller = Proportional(net, count="queue")
    link = next(z for z in range(len(net.links)) if np.unique(net.turn_group[net.turn_link == z]).size > 1)
    turns = np.flatnonzero(net.turn_link == link)
    stages = [s for s in range(len(net.stages)) if set(turns.tolist()) <= set(net.stages[s].turns)]
    assert stages
    lanes = np.array([len(net.groups[net.turn_group[turn]].lanes) for turn in turns])
    a, b = next(
        (a, b)
        for a in range(len(turns))
        for b in range(len(turns))
        if net.turn_group[turns[a]] != net.turn_group[turns[b]]
    )
    q = np.zeros(len(net.turns))
    q[turns[a]], q[turns[b]] = 6 * lanes[a], 4 * lanes[b]
    worth = controller.worth(replace(nobody(net), q_veh=q))
    assert worth[stages[0]] == pytest.approx(6)


@pytest.mark.parametrize(
    ("kind", "settings", "complaint"),
    [
        (Proportional, {"count": "cars"}, "count"),
        (CyclicMaxPressure, {"per": "mile"}, "per"),
        (TUC, {"r": 0}, "r"),
        (TUC, {"r": float("nan")}, "r"),
    ],
)
def test_a_wrong_setting_is_named(utn17: Network, kind: Any, settings: Any, complaint: str) -> None:
    with pytest.raises(SettingError, match=f"setting '{complaint}'"):
        controllers.made("own", kind, settings, utn17)


@pytest.mark.parametrize("kind", [TUC, Proportional, CyclicMaxPressure])
def test_a_part_with_a_stage_that_serves_everybody_is_planned(utn17: Network, kind: Any) -> None:
    """A junction with one stage has nothing to share out; one whose stages serve nobody is shared out equally."""
    part = utn17.part(3)
    whole = replace(part.stages[0], turns=tuple(range(len(part.turns))))
    idle = replace(part.stages[1], turns=())
    net = replace(part, stages=(whole, idle))
    state, forecast = HARD["full"](net, np.random.default_rng(2), 1)
    green_s = kind(net).plan(state, forecast).green_s
    assert np.isfinite(green_s).all()
    assert green_s.sum() == pytest.approx(net.green_budget_s[0])
    alone = replace(part, stages=(whole,), junctions=(replace(part.junctions[0], stages=(0,)),))
    assert kind(alone).plan(state, forecast).green_s == pytest.approx(alone.green_budget_s)


def test_who_has_green_in_every_stage_needs_no_share(utn17: Network) -> None:
    part = utn17.part(3)
    always = tuple(replace(stage, turns=tuple(sorted({0, *stage.turns}))) for stage in part.stages)
    net = replace(part, stages=always)
    controller, forecast = Proportional(net, count="queue"), nobody_comes(net)
    state = replace(nobody(net), q_veh=np.full(len(net.turns), 10.0))
    once, again = (controller.plan(each, forecast).green_s for each in (state, with_more(net, state, 0, 50)))
    assert again == pytest.approx(once)
    other = int(np.flatnonzero(net.serves.sum(axis=0) == 1)[-1])
    assert controller.plan(with_more(net, state, other, 5), forecast).green_s != pytest.approx(once)
