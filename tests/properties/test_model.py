"""The macroscopic model of SPEC 2 keeps its promises whatever the greens, the demand and the state."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo.contract import EXIT, Floats, Network
from utn_sumo.model import CasadiOperations, LinkModel, ModelState

SEEDS = st.integers(0, 2**32 - 1)
STEPS_S = st.sampled_from([10.0, 60.0, 120.0])
LONG_GREEN_S = 120.0


@pytest.fixture(params=["utn17", "utn17-long"], scope="module")
def net(request: pytest.FixtureRequest, utn17: Network, utn17_long: Network) -> Network:
    return utn17 if request.param == "utn17" else utn17_long


@pytest.fixture(scope="module")
def model_of(net: Network) -> Callable[[float], LinkModel]:
    return cache(lambda step_s: LinkModel(net, step_s))


def levels(rng: np.random.Generator, count: int) -> Floats:
    """Numbers from 0 to 1, both ends among them."""
    return np.clip(rng.uniform(-0.3, 1.3, count), 0, 1)


def some_state(model: LinkModel, rng: np.random.Generator) -> ModelState:
    net = model.network
    links, turns = len(net.links), len(net.turns)
    x = levels(rng, links) * net.storage_veh
    weight = levels(rng, turns) + 1e-3
    share = weight / (model.leaves @ weight)[net.turn_link]
    return ModelState(
        x_veh=x,
        q_veh=share * (levels(rng, links) * x)[net.turn_link],
        source_queue_veh=net.is_source * levels(rng, links) * 50,
        past_inflow_veh=tuple(levels(rng, links) * model.step_s for _ in range(model.lags)),
    )


def some_inputs(model: LinkModel, rng: np.random.Generator) -> tuple[Floats, Floats, Floats]:
    """Greens, demand and turning fractions of one step."""
    net = model.network
    weight = levels(rng, len(net.turns)) + 1e-2
    fraction = weight / (model.leaves @ weight)[net.turn_link]
    demand = net.is_source * levels(rng, len(net.links)) * model.step_s
    return levels(rng, len(net.stages)) * model.step_s, demand, fraction


def some_ends(model: LinkModel, rng: np.random.Generator, green: Floats) -> Floats:
    """Ends of the turns' greens, anywhere in the step that leaves them their length."""
    shown = np.minimum(green @ model.network.serves, model.step_s)
    return shown + levels(rng, len(shown)) * (model.step_s - shown)


def quiet_state(model: LinkModel, x: Floats | None = None, q: Floats | None = None) -> ModelState:
    nothing = np.zeros(len(model.network.links))
    q = np.zeros(len(model.network.turns)) if q is None else q
    x = model.leaves @ q if x is None else x
    return ModelState(x, q, nothing, (nothing,) * model.lags)


@given(seed=SEEDS, step_s=STEPS_S)
def test_vehicles_are_conserved(model_of: Callable[[float], LinkModel], seed: int, step_s: float) -> None:
    model, rng = model_of(step_s), np.random.default_rng(seed)
    before = some_state(model, rng)
    green, demand, fraction = some_inputs(model, rng)
    after, flows = model.step(before, green, demand, fraction, some_ends(model, rng, green))
    left = model.leaves @ flows.leaving_veh
    assert after.x_veh == pytest.approx(before.x_veh + flows.inflow_veh - left, abs=1e-9)
    gone = flows.leaving_veh[model.network.turn_next == EXIT].sum()
    there = (before.x_veh + before.source_queue_veh).sum()
    assert (after.x_veh + after.source_queue_veh).sum() == pytest.approx(there + demand.sum() - gone, abs=1e-8)


@given(seed=SEEDS, step_s=STEPS_S)
def test_queues_fit_on_their_links_and_links_within_their_storage_for_ever(
    model_of: Callable[[float], LinkModel], seed: int, step_s: float
) -> None:
    model, rng = model_of(step_s), np.random.default_rng(seed)
    state = some_state(model, rng)
    for _ in range(20):
        green, *others = some_inputs(model, rng)
        state, flows = model.step(state, green, *others, some_ends(model, rng, green))
        assert flows.leaving_veh.min() >= 0
        assert state.source_queue_veh.min() >= -1e-9
        assert state.q_veh.min() >= 0
        assert (model.leaves @ state.q_veh <= state.x_veh + 1e-9).all()
        assert (state.x_veh <= model.network.storage_veh + 1e-9).all()


@given(seed=SEEDS)
def test_a_disturbance_is_taken_as_far_as_it_fits(model_of: Callable[[float], LinkModel], seed: int) -> None:
    model, rng = model_of(120.0), np.random.default_rng(seed)
    state, wish = some_state(model, rng), rng.normal(0, 60, len(model.network.links))
    after = model.disturbed(state, wish)
    queue, change = model.by_link(state.q_veh), after.x_veh - state.x_veh
    assert (after.x_veh >= queue - 1e-9).all()
    assert (after.x_veh <= model.network.storage_veh + 1e-9).all()
    assert (change * wish >= -1e-9).all()
    assert (np.abs(change) <= np.abs(wish) + 1e-9).all()
    fits = (state.x_veh + wish <= model.network.storage_veh) & (state.x_veh + wish >= queue)
    assert change[fits] == pytest.approx(wish[fits])


@given(seed=SEEDS, step_s=STEPS_S)
def test_one_more_sweep_changes_nothing(model_of: Callable[[float], LinkModel], seed: int, step_s: float) -> None:
    model, rng = model_of(step_s), np.random.default_rng(seed)
    state = some_state(model, rng)
    green, demand, _ = some_inputs(model, rng)
    ends = some_ends(model, rng, green)
    longer = LinkModel(model.network, step_s)
    longer.sweeps = model.sweeps + 1
    (after, flows), (again, flows_again) = (
        each.step(state, green, demand, model.network.fraction, ends) for each in (model, longer)
    )
    assert flows.inflow_veh == pytest.approx(flows_again.inflow_veh, abs=1e-9)
    assert flows.leaving_veh == pytest.approx(flows_again.leaving_veh, abs=1e-9)
    assert after.q_veh == pytest.approx(again.q_veh, abs=1e-9)


def casadi_step(net: Network, step_s: float) -> Any:
    import casadi as ca

    model = LinkModel(net, step_s, CasadiOperations())
    links, turns = len(net.links), len(net.turns)
    sizes = [links, turns, links, *[links] * model.lags, len(net.stages), links, turns, turns]
    symbols = [ca.SX.sym(f"p{position}", size) for position, size in enumerate(sizes)]
    x, q, waiting, *past = symbols[:-4]
    after, flows = model.step(ModelState(x, q, waiting, tuple(past)), *symbols[-4:])
    results = [after.x_veh, after.q_veh, after.source_queue_veh, *after.past_inflow_veh]
    return ca.Function("step", symbols, [*results, flows.leaving_veh, flows.inflow_veh, flows.arriving_veh])


@pytest.fixture(scope="module")
def symbolic_of(net: Network) -> Callable[[float], Any]:
    return cache(lambda step_s: casadi_step(net, step_s))


@given(seed=SEEDS, step_s=STEPS_S)
def test_casadi_and_numpy_agree(
    model_of: Callable[[float], LinkModel], symbolic_of: Callable[[float], Any], seed: int, step_s: float
) -> None:
    model, rng = model_of(step_s), np.random.default_rng(seed)
    state, inputs = some_state(model, rng), some_inputs(model, rng)
    inputs = (*inputs, some_ends(model, rng, inputs[0]))
    after, flows = model.step(state, *inputs)
    numbers = [after.x_veh, after.q_veh, after.source_queue_veh, *after.past_inflow_veh]
    numbers += [flows.leaving_veh, flows.inflow_veh, flows.arriving_veh]
    given_ = [state.x_veh, state.q_veh, state.source_queue_veh, *state.past_inflow_veh, *inputs]
    for number, symbolic in zip(numbers, symbolic_of(step_s)(*given_), strict=True):
        assert np.asarray(symbolic).ravel() == pytest.approx(number, abs=1e-9)


def test_an_unsaturated_turn_lets_all_go_that_is_queued_or_arrives(utn17: Network) -> None:
    model = LinkModel(utn17, 120)
    q = 2 * utn17.fraction
    greens = np.full(len(utn17.stages), LONG_GREEN_S)
    after, flows = model.step(quiet_state(model, q=q), greens, 5.0 * utn17.is_source, utn17.fraction)
    assert flows.leaving_veh == pytest.approx(q + utn17.fraction * flows.arriving_veh[utn17.turn_link])
    assert after.q_veh == pytest.approx(0)


def test_a_saturated_turn_discharges_its_share_of_saturation_flow_times_green(utn17: Network) -> None:
    model = LinkModel(utn17, 120)
    q = 60 * utn17.fraction
    _, flows = model.step(quiet_state(model, q=q), np.full(len(utn17.stages), 20.0), np.zeros(17), utn17.fraction)
    assert flows.leaving_veh == pytest.approx(utn17.fraction * 0.435 * 2 * 20)


def test_a_full_link_takes_no_more_than_its_room_shared_by_turning_fractions(utn17: Network) -> None:
    model = LinkModel(utn17, 120)
    link = utn17.link_index("10")
    room = 6.0
    feeding = utn17.turn_next == link
    q = np.where(feeding, 30.0, 0.0)
    x = model.leaves @ q
    x[link] = utn17.storage_veh[link] - room
    greens = np.full(len(utn17.stages), LONG_GREEN_S)
    after, flows = model.step(quiet_state(model, x, q), greens, np.zeros(17), utn17.fraction)
    # SPEC 1: links 1, 2, 3 send 0.7, 0.4, 0.8 of their traffic to link 10.
    assert flows.leaving_veh[feeding] == pytest.approx(room * np.array([0.7, 0.4, 0.8]) / 1.9)
    assert after.x_veh[link] <= utn17.storage_veh[link]


def test_traffic_that_finds_a_source_link_full_waits_outside(utn17: Network) -> None:
    model = LinkModel(utn17, 120)
    x = utn17.storage_veh - 4
    after, _ = model.step(quiet_state(model, x), np.zeros(17), 10.0 * utn17.is_source, utn17.fraction)
    assert after.x_veh == pytest.approx(x + 4 * utn17.is_source)
    assert after.source_queue_veh == pytest.approx(6 * utn17.is_source)


def test_demand_enters_at_sources_alone(utn17: Network) -> None:
    model = LinkModel(utn17, 120)
    after, flows = model.step(quiet_state(model), np.zeros(17), np.full(17, 10.0), utn17.fraction)
    assert flows.inflow_veh == pytest.approx(10 * utn17.is_source)
    assert after.source_queue_veh == pytest.approx(0)


def test_who_reaches_the_queue_after_the_green_waits_for_the_next(utn17: Network) -> None:
    model = LinkModel(utn17, 120)
    greens, demand = np.full(len(utn17.stages), 30.0), 12.0 * utn17.is_source
    ends = np.full(len(utn17.turns), 30.0)
    early, late = (
        model.step(quiet_state(model), greens, demand, utn17.fraction, end)[0] for end in (ends, ends + 90.0)
    )
    # In free traffic an arrival every ten seconds is 36 s on the way: none of it is there before the early green ends.
    assert model.leaves @ early.q_veh == pytest.approx(demand * (1 - utn17.free_time_s / 120))
    assert model.leaves @ late.q_veh == pytest.approx(0, abs=1e-9)


def test_a_full_link_takes_up_what_its_early_green_lets_out(utn17: Network) -> None:
    model = LinkModel(utn17, 120)
    link = utn17.link_index("10")
    feeding, own = utn17.turn_next == link, utn17.turn_link == link
    q = np.where(feeding, 30.0, np.where(own, 50.0, 0.0))
    x = model.leaves @ q
    x[link] = utn17.storage_veh[link]
    greens = np.full(len(utn17.stages), 40.0)
    inflow = []
    for end in (40.0, 120.0):
        ends = np.where(own, end, 60.0)
        after, flows = model.step(quiet_state(model, x, q), greens, np.zeros(17), utn17.fraction, ends)
        assert after.x_veh[link] <= utn17.storage_veh[link] + 1e-9
        inflow.append(flows.inflow_veh[link])
    # A green from the step's start opens room at the entry in time, one at its end does not.
    assert inflow[0] == pytest.approx((model.leaves @ flows.leaving_veh)[link])
    assert inflow[1] == 0


@given(seed=SEEDS)
def test_traffic_arrives_after_a_constant_delay_as_in_spec_2_5(
    model_of: Callable[[float], LinkModel], net: Network, seed: int
) -> None:
    model, rng = model_of(120.0), np.random.default_rng(seed)
    state, inflow, arriving = quiet_state(model), [], []
    greens = np.full(len(net.stages), LONG_GREEN_S)
    for _ in range(12):
        state, flows = model.step(state, greens, net.is_source * rng.integers(0, 20, len(net.links)), net.fraction)
        inflow.append(flows.inflow_veh)
        arriving.append(flows.arriving_veh)
        assert state.q_veh == pytest.approx(0, abs=1e-9)
    steps, rest = np.divmod(net.free_time_s / 120, 1)
    past = np.array(inflow)
    delay = int(steps[0])
    assert set(steps) == {delay}
    for step in range(delay + 1, 12):
        expected = (1 - rest) * past[step - delay] + rest * past[step - delay - 1]
        assert arriving[step] == pytest.approx(expected, abs=1e-9)


@pytest.mark.parametrize("step_s", [10.0, 60.0])
def test_traffic_crosses_an_empty_link_in_its_free_travel_time(net: Network, step_s: float) -> None:
    model = LinkModel(net, step_s)
    state, arriving = quiet_state(model), []
    for step in range(model.lags + 2):
        demand = 10.0 * net.is_source * (step == 0)
        state, flows = model.step(state, np.zeros(len(net.stages)), demand, net.fraction)
        arriving.append(flows.arriving_veh)
    reached = np.array(arriving)[:, net.is_source]
    assert reached.sum(axis=0) == pytest.approx(10)
    whole = (net.free_time_s[net.is_source] // step_s).astype(int)
    late = np.take_along_axis(reached, np.stack([whole, whole + 1]), axis=0)
    assert late.sum(axis=0) == pytest.approx(10)


def test_the_tail_of_a_longer_queue_is_reached_sooner(net: Network) -> None:
    model = LinkModel(net, 10)
    delays = [model.delay_s(share * net.storage_veh) for share in (0.0, 0.5, 1.0, 1.1)]
    assert delays[0] == pytest.approx(net.free_time_s)
    assert all((later <= earlier).all() for earlier, later in pairwise(delays))
    assert delays[-1] == pytest.approx(0)


def test_a_link_that_nobody_turns_to_stays_empty(utn17: Network) -> None:
    model = LinkModel(utn17, 120)
    link = utn17.link_index("11")
    to_link = utn17.turn_next == link
    avoiding = np.isin(utn17.turn_link, utn17.turn_link[to_link])
    fraction = np.where(avoiding, ~to_link, utn17.fraction)
    state = quiet_state(model)
    for _ in range(3):
        greens = np.full(len(utn17.stages), LONG_GREEN_S)
        state, _ = model.step(state, greens, 10.0 * utn17.is_source, fraction)
    assert state.x_veh[link] == 0
    assert np.isfinite(state.x_veh).all()
