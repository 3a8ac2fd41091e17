"""The model follows and predicts recorded runs; green windows say when each stage is open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo.contract import Floats, Network
from utn_sumo.mismatch import errors, rmse, summary
from utn_sumo.model import LinkModel, green_windows
from utn_sumo.recording import Log
from utn_sumo.rollout import known_demand_veh, observe, roll

STEPS = 14


def simulated(network: Network, seed: int, step_s: float = 10.0) -> Log:
    """A run in which the plant is the model itself, with the equal split: counts are exact, queues are the model's."""
    rng = np.random.default_rng(seed)
    model = LinkModel(network, step_s)
    green = network.equal_split().green_s
    windows = green_windows(network, green, step_s)
    links, turns = len(network.links), len(network.turns)
    states, entered, turned, after = [], [], [], []
    from utn_sumo.model import ModelState

    state = ModelState(np.zeros(links), np.zeros(turns), np.zeros(links), (np.zeros(links),) * model.lags)
    for _ in range(STEPS):
        states.append(state)
        demand = rng.uniform(5, 30, links) * network.is_source
        inflow, leaving = np.zeros(links), np.zeros(turns)
        for window in windows:
            state, flows = model.step(state, window, demand / len(windows), network.fraction)
            inflow, leaving = inflow + flows.inflow_veh, leaving + flows.leaving_veh
        entered.append(inflow)
        turned.append(leaving)
        after.append(state)
    one = {
        "x_veh": [s.x_veh for s in states],
        "q_veh": [s.q_veh for s in states],
        "source_queue_veh": [s.source_queue_veh for s in states],
        "green_s": [green] * STEPS,
        "forecast_veh": entered,
        "entered_veh": entered,
        "turned_veh": turned,
        "true_x_veh": [s.x_veh for s in after],
        "true_queue_veh": [s.q_veh @ model.leaves.T for s in after],
        "true_waiting_veh": [s.source_queue_veh for s in after],
    }
    return Log(**{name: np.array(rows)[:, None] for name, rows in one.items()})


def test_where_the_plant_is_the_model_prediction_is_all_but_exact(utn17: Network) -> None:
    log = Log.stack([simulated(utn17, seed) for seed in (1, 2)])
    model = LinkModel(utn17, 10.0)
    prediction = roll(model, log, observe(model, log), known_demand_veh(utn17, log), 3)
    true_x = log.true_x_veh[prediction.starts + np.arange(3)[:, None]]
    persistence = log.x_veh[prediction.starts] - true_x
    assert np.sqrt(np.mean((prediction.x_veh - true_x) ** 2)) < 0.15 * np.sqrt(np.mean(persistence**2))


def test_runs_side_by_side_are_predicted_as_each_alone(utn17: Network) -> None:
    logs = [simulated(utn17, seed) for seed in (3, 4)]
    both = Log.stack(logs)
    model = LinkModel(utn17, 10.0)

    def predicted(log: Log) -> Floats:
        return roll(model, log, observe(model, log), known_demand_veh(utn17, log), 2).x_veh

    apart = np.concatenate([predicted(log) for log in logs], axis=2)
    assert predicted(both) == pytest.approx(apart, abs=1e-9)


def test_observed_states_hold_the_counted_vehicles_and_no_more_queue_than_vehicles(utn17: Network) -> None:
    log = simulated(utn17, 5)
    for k, state in enumerate(observe(LinkModel(utn17, 10.0), log)):
        queue = np.asarray(state.q_veh) @ LinkModel(utn17, 10.0).leaves.T
        assert np.asarray(state.x_veh) == pytest.approx(log.x_veh[k])
        assert (queue <= log.x_veh[k] + 1e-9).all()
        assert np.min(state.q_veh) >= 0


def test_the_summary_divides_by_the_references(utn17: Network) -> None:
    log = Log.stack([simulated(utn17, seed) for seed in (6, 7, 8)])
    found = errors(utn17, log, 120.0, 4, "known")
    floor = np.full((4, 17), 2.0)
    result = summary(utn17, found, floor)
    mean = rmse(found.x_veh).mean(axis=1)
    assert result["rmse_veh"] == pytest.approx(mean)
    assert result["rmse_over_persistence"] == pytest.approx(mean / rmse(found.persistence_veh).mean(axis=1))
    assert result["rmse_over_floor"] == pytest.approx(mean / 2)
    assert set(result["links"]) == {link.id for link in utn17.links}
    assert result["links"]["3"]["rmse_veh"] == pytest.approx(rmse(found.x_veh)[:, 2])


@given(seed=st.integers(0, 2**32 - 1), step_s=st.sampled_from([5.0, 10.0, 40.0, 120.0]))
def test_windows_add_up_to_the_greens(utn17: Network, seed: int, step_s: float) -> None:
    rng = np.random.default_rng(seed)
    green = rng.uniform(10, 40, (3, len(utn17.stages)))
    for junction in utn17.junctions:
        stages = list(junction.stages)
        clearance = sum(utn17.stages[s].clearance_s for s in stages)
        green[:, stages] *= (junction.cycle_s - clearance) / green[:, stages].sum(axis=1, keepdims=True)
    windows = green_windows(utn17, green, step_s)
    assert windows.min() >= 0
    assert windows.max() <= step_s + 1e-9
    assert windows.sum(axis=1) == pytest.approx(green)


@pytest.mark.parametrize(("cycle_s", "offset_s"), [(60.0, 0.0), (60.0, 25.0), (40.0, 10.0)])
def test_a_shorter_cycle_shows_its_greens_again_and_again(utn17: Network, cycle_s: float, offset_s: float) -> None:
    short = replace(utn17.junctions[3], cycle_s=cycle_s, offset_s=offset_s)
    network = replace(utn17, junctions=(*utn17.junctions[:3], short, *utn17.junctions[4:]))
    green = network.equal_split().green_s
    stages = list(short.stages)
    green[stages] = [(cycle_s - 10) / 2] * 2
    total = green_windows(network, green, 10.0).sum(axis=0)
    assert total[stages] == pytest.approx(green[stages] * 120 / cycle_s)


def test_before_the_green_and_its_lag_nothing_is_open(utn17: Network) -> None:
    green = utn17.equal_split().green_s
    windows = green_windows(utn17, green, 1.0)
    lag = round(utn17.startup_lag_s)
    first, second = utn17.junctions[1].stages
    assert np.flatnonzero(windows[:, first]).tolist() == list(range(lag, lag + 55))
    assert np.flatnonzero(windows[:, second]).tolist() == sorted((60 + lag + s) % 120 for s in range(55))
