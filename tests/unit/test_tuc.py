"""TUC's regulator: the Riccati equation's, of a model that conserves vehicles, and stable by what greens can reach."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import solve_discrete_are

from utn_controllers import splits
from utn_controllers.tuc import TUC, regulator, store_and_forward
from utn_sumo.contract import EXIT, Floats, Network
from utn_sumo.testing import random_forecast, random_state

seeds = st.integers(0, 2**31)
rs = st.sampled_from([1e-6, 1e-4, 1e-2, 1.0])


def by_riccati(moved: Floats, weight: Floats, r: float, keep: float) -> Floats:
    """The gain of x(k+1) = keep x(k) + moved u(k) by scipy's solver."""
    state, control = keep * np.eye(len(moved)), r * np.eye(moved.shape[1])
    p = solve_discrete_are(state, moved, np.diag(weight), control)
    return np.asarray(np.linalg.solve(control + moved.T @ p @ moved, moved.T @ p @ state))


@pytest.mark.parametrize("r", [1e-4, 1e-2, 1.0])
def test_the_gain_is_that_of_the_riccati_equation(r: float) -> None:
    """A model whose whole state the greens reach has scipy's gain."""
    rng = np.random.default_rng(3)
    moved, weight = rng.normal(size=(5, 7)), rng.uniform(0.5, 2, 5)
    assert regulator(moved, weight, r) == pytest.approx(by_riccati(moved, weight, r, 1.0), abs=1e-7)


def test_what_is_out_of_reach_changes_nothing_of_it(utn17: Network) -> None:
    """Where a share of x vanishes in each step the Riccati equation is soluble; the smaller that, the nearer ours."""
    moved, weight = store_and_forward(utn17), 1 / utn17.storage_veh
    ours = regulator(moved, weight, 1e-2)
    off = [np.abs(by_riccati(moved, weight, 1e-2, keep) - ours).max() for keep in (0.99, 0.999, 0.9999)]
    assert off[0] > off[1] > off[2]
    assert off[2] < 1e-3 * np.abs(ours).max()


def test_the_model_moves_vehicles_from_link_to_link(utn17: Network) -> None:
    """A second more for link 8 and less for link 9: at saturation flow from it, .7 of that into link 11."""
    eight, nine, eleven = (utn17.link_index(name) for name in ("8", "9", "11"))
    second = np.zeros(len(utn17.stages))
    (first,), (other,) = (
        np.flatnonzero(utn17.serves[:, np.flatnonzero(utn17.turn_link == z)[0]]) for z in (eight, nine)
    )
    second[first], second[other] = 1, -1
    change = store_and_forward(utn17) @ second
    flow = utn17.saturation_flow_veh_s[[eight, nine]]
    assert change[[eight, nine]] == pytest.approx([-flow[0], flow[1]])
    into = [
        sum(turn.fraction for turn in utn17.turns if (turn.link, turn.next_link) == (z, eleven)) for z in (eight, nine)
    ]
    assert change[eleven] == pytest.approx(into[0] * flow[0] - into[1] * flow[1])
    assert np.flatnonzero(np.abs(change) > 1e-12).tolist() == sorted([eight, nine, eleven])
    assert (utn17.turn_next == EXIT).any()


@given(seed=seeds)
def test_nominal_greens_saturate_the_stages_of_a_junction_alike(utn17: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    state, forecast = random_state(utn17, rng), random_forecast(utn17, rng, 1)
    green_s = TUC(utn17).nominal_s(state, forecast)
    onward = np.zeros((len(utn17.links), len(utn17.links)))
    for turn, fraction in zip(utn17.turns, state.fraction.tolist(), strict=True):
        if turn.next_link != EXIT:
            onward[turn.next_link, turn.link] += fraction
    flow = np.linalg.solve(np.eye(len(onward)) - onward, forecast.demand_veh[0])
    load = np.zeros(len(green_s))
    for link, served in enumerate(flow / utn17.saturation_flow_veh_s):
        load[utn17.serves[:, utn17.turn_link == link].any(axis=1)] = served
    for junction in utn17.junctions:
        stages = np.array(junction.stages)
        degree, above = load[stages] / green_s[stages], green_s[stages] > utn17.min_green_s[stages] + 1e-6
        assert degree[above] == pytest.approx(degree[above].max(initial=0.0), rel=1e-3)
        assert (degree[~above] <= degree.max() * (1 + 1e-3)).all()


@given(seed=seeds, r=rs)
def test_what_greens_can_reach_is_brought_to_the_least(utn17: Network, seed: int, r: float) -> None:
    """The model in closed loop, its greens kept within their leasts, comes to where no greens would better it."""
    controller = TUC(utn17, r=r)
    rng = np.random.default_rng(seed)
    moved, forecast = store_and_forward(utn17), random_forecast(utn17, rng, 1)
    nominal_s, start = utn17.equal_split().green_s, random_state(utn17, rng).x_veh
    x, costs = start, []
    state = random_state(utn17, rng)
    for _ in range(400):
        green_s = nominal_s - controller.gain @ x
        x = x + moved @ (splits.nearest(utn17, green_s) - nominal_s)
        costs.append(float(x @ (x / utn17.storage_veh)))
    assert np.abs(moved.T @ (x / utn17.storage_veh)).max() < 1e-3
    assert costs[-1] <= start @ (start / utn17.storage_veh) + 1e-9
    assert np.isfinite(controller.plan(state, forecast).green_s).all()


@given(r=rs)
def test_no_mode_of_the_closed_loop_grows(utn17: Network, r: float) -> None:
    moved = store_and_forward(utn17)
    loop = np.eye(len(moved)) - moved @ regulator(moved, 1 / utn17.storage_veh, r)
    sizes = np.sort(np.abs(np.linalg.eigvals(loop)))
    # Nine greens are free at 17 stages of 8 junctions: as many modes decay, and the others stay as they are.
    assert (sizes[:9] < 0.99).all()
    assert sizes[9:] == pytest.approx(1.0)


def test_the_regulator_s_greens_fill_the_cycles_by_themselves(utn17: Network) -> None:
    gain = TUC(utn17).gain
    sums = [np.bincount(utn17.stage_junction, column) for column in gain.T]
    assert np.abs(sums).max() < 1e-9
