"""The model follows and predicts recorded runs; green windows say when each stage is open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from utn_sumo.contract import Floats, Network
from utn_sumo.mismatch import errors, rmse, summary
from utn_sumo.model import LinkModel, ModelState, green_windows
from utn_sumo.recording import Log
from utn_sumo.rollout import Outside, known_fraction, observe, predict, starts

STEPS = 14


def simulated(network: Network, seed: int) -> Log:
    """A run in which the plant is the model itself, with the equal split: counts are exact, queues are the model's."""
    rng = np.random.default_rng(seed)
    model = LinkModel(network, network.sample_s)
    green = network.equal_split().green_s
    windows = green_windows(network, green, model.step_s)
    links, turns = len(network.links), len(network.turns)
    states, entered, turned, after = [], [], [], []
    state = ModelState(np.zeros(links), np.zeros(turns), np.zeros(links), (np.zeros(links),) * model.lags)
    for _ in range(STEPS):
        states.append(state)
        demand = rng.uniform(5, 30, links) * network.is_source
        inflow, leaving = [], np.zeros(turns)
        for shown, end in zip(windows.shown_s, windows.end_s, strict=True):
            state, flows = model.step(state, shown, demand / len(windows.shown_s), network.fraction, end)
            inflow.append(flows.inflow_veh)
            leaving = leaving + flows.leaving_veh
        entered.append(np.array(inflow))
        turned.append(leaving)
        after.append(state)
    one = {
        "x_veh": [s.x_veh for s in states],
        "q_veh": [s.q_veh for s in states],
        "source_queue_veh": [s.source_queue_veh for s in states],
        "fraction": [network.fraction] * STEPS,
        "green_s": [green] * STEPS,
        "forecast_disturbance_veh": [np.zeros(links)] * STEPS,
        "forecast_veh": [rows.sum(axis=0) for rows in entered],
        "entered_by_sample_veh": entered,
        "turned_veh": turned,
        "true_x_veh": [s.x_veh for s in after],
        "true_queue_veh": [model.by_link(s.q_veh) for s in after],
        "true_waiting_veh": [s.source_queue_veh for s in after],
    }
    return Log(**{name: np.array(rows)[:, None] for name, rows in one.items()})


def test_where_the_plant_is_the_model_prediction_is_all_but_exact(utn17: Network) -> None:
    log = Log.stack([simulated(utn17, seed) for seed in (1, 2)])
    at = starts(log, 3)
    true_x = log.true_x_veh[at + np.arange(3)[:, None]]
    persistence = log.x_veh[at] - true_x
    assert np.sqrt(np.mean((predicted(utn17, log, 3) - true_x) ** 2)) < 0.1 * np.sqrt(np.mean(persistence**2))


def predicted(network: Network, log: Log, horizon: int, step_s: float = 10.0) -> Floats:
    fraction = np.array([log.fraction[starts(log, horizon)]] * horizon)
    model = LinkModel(network, step_s)
    return predict(model, log, horizon, outside=Outside.known(network, log), fraction=fraction).x_veh


def test_a_step_of_the_whole_cycle_knows_where_the_green_stands(utn17: Network) -> None:
    log = Log.stack([simulated(utn17, seed) for seed in (1, 2)])
    true_x = log.true_x_veh[starts(log, 3) + np.arange(3)[:, None]]
    error = predicted(utn17, log, 3, 120.0) - true_x
    persistence = log.x_veh[starts(log, 3)] - true_x
    assert np.sqrt(np.mean(error**2)) < 0.4 * np.sqrt(np.mean(persistence**2))
    assert abs(error.mean()) < 1.0


def test_runs_side_by_side_are_predicted_as_each_alone(utn17: Network) -> None:
    logs = [simulated(utn17, seed) for seed in (3, 4)]
    both = Log.stack(logs)
    apart = np.concatenate([predicted(utn17, log, 2) for log in logs], axis=2)
    assert predicted(utn17, both, 2) == pytest.approx(apart, abs=1e-9)


def test_observed_states_hold_the_counted_vehicles_and_no_more_queue_than_vehicles(utn17: Network) -> None:
    log, model = simulated(utn17, 5), LinkModel(utn17, 10.0)
    at = starts(log, 1)
    state = observe(model, log, at, log.source_queue_veh)
    assert np.asarray(state.x_veh) == pytest.approx(log.x_veh[at])
    assert (model.by_link(state.q_veh) <= log.x_veh[at] + 1e-9).all()
    assert np.min(state.q_veh) >= 0
    # The past is what was counted, newest first: three samples back from the start of the fourth step.
    assert state.past_inflow_veh[2][2] == pytest.approx(log.entered_by_sample_veh[2, :, -3])
    assert len(state.past_inflow_veh) == model.lags


def test_nothing_later_than_its_start_is_known_to_a_prediction(utn17: Network) -> None:
    log, model = simulated(utn17, 9), LinkModel(utn17, 120.0)
    k = 6
    later = replace(
        log,
        entered_by_sample_veh=np.where(np.arange(STEPS)[:, None, None, None] >= k, 0, log.entered_by_sample_veh),
        turned_veh=np.where(np.arange(STEPS)[:, None, None] >= k, 0, log.turned_veh),
    )
    states = [observe(model, each, np.array([k]), each.source_queue_veh) for each in (log, later)]
    assert states[0].q_veh == pytest.approx(states[1].q_veh)
    assert np.array(states[0].past_inflow_veh) == pytest.approx(np.array(states[1].past_inflow_veh))


def test_known_turning_is_how_each_step_really_turned(utn17: Network) -> None:
    log = simulated(utn17, 5)
    share = known_fraction(utn17, log)
    assert share == pytest.approx(np.broadcast_to(utn17.fraction, share.shape), abs=1e-9)
    assert np.allclose(np.bincount(utn17.turn_link, share[3, 0]), 1)


def test_the_summary_divides_by_the_references(utn17: Network) -> None:
    log = Log.stack([simulated(utn17, seed) for seed in (6, 7, 8)])
    found = errors(utn17, log, 120.0, 4)
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
    assert windows.shown_s.min() >= 0
    assert windows.shown_s.max() <= step_s + 1e-9
    assert windows.shown_s.sum(axis=1) == pytest.approx(green)
    by_turn = windows.shown_s @ utn17.serves
    assert ((windows.end_s > 0) == (by_turn > 0)).all()
    assert (by_turn <= windows.end_s + 1e-9).all()
    assert windows.end_s.max() <= step_s + 1e-9


@pytest.mark.parametrize(("cycle_s", "offset_s"), [(60.0, 0.0), (60.0, 25.0), (40.0, 10.0)])
def test_a_shorter_cycle_shows_its_greens_again_and_again(utn17: Network, cycle_s: float, offset_s: float) -> None:
    short = replace(utn17.junctions[3], cycle_s=cycle_s, offset_s=offset_s)
    network = replace(utn17, junctions=(*utn17.junctions[:3], short, *utn17.junctions[4:]))
    green = network.equal_split().green_s
    stages = list(short.stages)
    green[stages] = [(cycle_s - 10) / 2] * 2
    total = green_windows(network, green, 10.0).shown_s.sum(axis=0)
    assert total[stages] == pytest.approx(green[stages] * 120 / cycle_s)


def test_before_the_green_and_its_lag_nothing_is_open(utn17: Network) -> None:
    green = utn17.equal_split().green_s
    windows = green_windows(utn17, green, 1.0).shown_s
    lag = round(utn17.startup_lag_s)
    first, second = utn17.junctions[1].stages
    assert np.flatnonzero(windows[:, first]).tolist() == list(range(lag, lag + 55))
    assert np.flatnonzero(windows[:, second]).tolist() == sorted((60 + lag + s) % 120 for s in range(55))
