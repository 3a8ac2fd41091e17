"""The model as plant: it is the model, it loses nobody, and it shows of a plan what signals can."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo.contract import EXIT, Floats, Forecast, Network, Plan
from utn_sumo.errors import PlantError
from utn_sumo.fitted import Fitted, fit_s
from utn_sumo.model import LinkModel, ModelState, green_windows
from utn_sumo.plant.macroscopic import MacroscopicPlant, Misfits, showable_s
from utn_sumo.signals import admit

SEEDS = st.integers(0, 2**32 - 1)
STEPS = 12


def some_demand(network: Network, rng: np.random.Generator) -> Floats:
    return rng.uniform(0, 60, (STEPS, len(network.links))) * network.is_source


def some_greens(network: Network, rng: np.random.Generator) -> Floats:
    """Too much for some cycles, too little for others, and some stages with none."""
    return rng.uniform(-20, 80, (STEPS, len(network.stages))).clip(0)


@given(seed=SEEDS)
def test_nobody_is_lost_whatever_the_greens(utn17: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    demand = some_demand(utn17, rng)
    plant, gone = MacroscopicPlant(utn17, demand), 0.0
    for step, green in enumerate(some_greens(utn17, rng)):
        before = plant.state
        passed = plant.run(Plan(green))
        gone += passed.state.turned_veh[utn17.turn_next == EXIT].sum()
        there = passed.state.x_veh.sum() + passed.state.source_queue_veh.sum()
        assert there + gone == pytest.approx(demand[: step + 1].sum())
        left = np.bincount(utn17.turn_link, passed.state.turned_veh)
        assert passed.state.x_veh == pytest.approx(before.x_veh + passed.entered_veh.sum(axis=0) - left, abs=1e-9)
        assert (passed.state.x_veh <= utn17.storage_veh + 1e-9).all()
        assert (passed.max_x_veh >= passed.state.x_veh).all()


def test_it_is_the_model_in_open_loop_with_the_green_where_it_stands(utn17_long: Network) -> None:
    rng = np.random.default_rng(4)
    demand, green = some_demand(utn17_long, rng), utn17_long.equal_split().green_s
    model = LinkModel(utn17_long, 10.0)
    nobody = np.zeros(len(utn17_long.links))
    state = ModelState(nobody, np.zeros(len(utn17_long.turns)), nobody, (nobody,) * model.lags)
    windows = green_windows(utn17_long, green, 10.0)
    plant, spent = MacroscopicPlant(utn17_long, demand), 0.0
    for step in range(STEPS):
        passed = plant.run(Plan(green))
        spent = 0.0
        for shown, end in zip(windows.shown_s, windows.end_s, strict=True):
            state, _ = model.step(state, shown, demand[step] / 12, utn17_long.fraction, end)
            spent += (state.x_veh.sum() + state.source_queue_veh.sum()) * 10 / 3600
        assert passed.state.x_veh == pytest.approx(state.x_veh, abs=1e-12)
        assert passed.state.q_veh == pytest.approx(state.q_veh, abs=1e-12)
        assert np.array(state.past_inflow_veh) == pytest.approx(passed.state.past_inflow_veh[: model.lags])
        assert passed.time_spent_veh_h == pytest.approx(spent)
    assert plant.state.time_s == STEPS * 120


def test_a_plant_goes_on_from_the_state_of_another(utn17: Network) -> None:
    rng = np.random.default_rng(5)
    demand, greens = some_demand(utn17, rng), some_greens(utn17, rng)
    whole = MacroscopicPlant(utn17, demand)
    states = [whole.run(Plan(green)).state for green in greens]
    second = MacroscopicPlant(utn17, demand[6:], states[5])
    for green in greens[6:]:
        second.run(Plan(green))
    assert second.state.x_veh == pytest.approx(states[-1].x_veh)
    assert second.state.cycle == STEPS


def test_beyond_its_demand_there_is_nothing_to_run(utn17: Network) -> None:
    plant = MacroscopicPlant(utn17, np.zeros((1, 17)))
    plant.run(utn17.equal_split())
    with pytest.raises(PlantError, match="1 control steps"):
        plant.run(utn17.equal_split())


def test_overfull_greens_are_scaled_down_and_the_others_stay(utn17: Network) -> None:
    green = utn17.equal_split().green_s
    first, second = (list(utn17.junctions[index].stages) for index in (0, 1))
    green[first] = [100.0, 60.0, 50.0]
    green[second] = [30.0, 5.0]
    shown = MacroscopicPlant(utn17, np.ones((1, 17))).run(Plan(green)).green_s
    assert shown[first] == pytest.approx([50, 30, 25])
    assert shown[second] == pytest.approx([30, 5])
    rest = np.setdiff1d(np.arange(17), first)
    assert shown[rest] == pytest.approx(green[rest])
    assert showable_s(utn17, np.zeros(17)) == pytest.approx(0)


def test_each_misfit_is_told_by_junction(utn17: Network) -> None:
    green = utn17.equal_split().green_s
    assert not Misfits.of(utn17, green).any.any()
    changes = {0: (1.0, 0.0, 0.0), 1: (-1.0, 0.0), 2: (-50.0, 50.0), 3: (5e-4, 5e-4)}
    for junction, change in changes.items():
        green[list(utn17.junctions[junction].stages)] += change
    found = Misfits.of(utn17, green)
    places = [np.flatnonzero(each).tolist() for each in (found.overfull, found.unfilled, found.short, found.any)]
    assert places == [[0], [1], [2], [0, 1, 2]]


def test_red_for_the_rest_of_the_cycle_is_paid_for(utn17: Network) -> None:
    demand = np.tile(25.0 * utn17.is_source, (STEPS, 1))
    spent = []
    for share in (1.0, 0.5):
        plant = MacroscopicPlant(utn17, demand)
        green = share * utn17.equal_split().green_s
        spent.append(sum(plant.run(Plan(green)).time_spent_veh_h for _ in range(STEPS)))
    assert spent[1] > 1.2 * spent[0]


@given(seed=SEEDS)
def test_a_fitted_wish_fills_its_cycles_in_its_own_proportions(utn17: Network, seed: int) -> None:
    for wish in some_greens(utn17, np.random.default_rng(seed)):
        fitted = fit_s(utn17, wish)
        admit(Plan(fitted), utn17)
        for junction, budget in zip(utn17.junctions, utn17.green_budget_s, strict=True):
            stages = list(junction.stages)
            free = fitted[stages] > utn17.min_green_s[stages] + 1e-6
            assert fitted[stages].sum() == pytest.approx(budget)
            share = wish[stages][free] / fitted[stages][free]
            assert share == pytest.approx(share.max(), abs=1e-4)


def test_fitted_asks_the_controller_that_it_is_told(utn17: Network) -> None:
    demand = np.tile(25.0 * utn17.is_source, (1, 1))
    fitted = Fitted(utn17, "dmpc", {"horizon": 2, "cost": "paper", "constraints": "dropped"})
    assert fitted.horizon == 2
    plan = fitted.plan(MacroscopicPlant(utn17, demand).state, Forecast(np.tile(demand, (2, 1))))
    assert plan.ahead_s is not None
    for green in (plan.green_s, *plan.ahead_s):
        admit(Plan(green), utn17)
