"""The model run open loop over recorded runs: predictions from every control step, several steps ahead.

`observe` follows the runs with the model and corrects it at the end of every control step by what was counted, as an
observer does: x is the count, the inflow of the step is brought to the count of the entry loops but keeps the model's
timing, and who is neither on the way nor gone is queued. `roll` then predicts from those states with the greens that
were really applied. Both take the model step by step; a step of the whole cycle is the plain model of SPEC 2.

Arrays have the control step first, then the run (see `Log.stack`), then link, turn or stage.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from utn_sumo.contract import Floats, Ints, Network
from utn_sumo.model import LinkModel, ModelState, StepFlows, green_windows
from utn_sumo.recording import Log


@dataclass(frozen=True)
class Prediction:
    """Open-loop predictions from the starts k = 1 ... K - H: arrays (H, starts, runs, Z)."""

    starts: Ints
    x_veh: Floats
    """Vehicles at the end of each step ahead."""
    queue_veh: Floats
    inflow_veh: Floats
    """Vehicles that enter within each step ahead."""


def observe(model: LinkModel, log: Log) -> list[ModelState]:
    """The model's state at the start of every control step of the runs, from nothing later than that."""
    network = model.network
    windows = np.moveaxis(green_windows(network, log.green_s, model.step_s), -2, 1)
    steps = windows.shape[1]
    none = np.zeros_like(log.x_veh[0])
    state = ModelState(none, np.zeros_like(log.q_veh[0]), none, (none,) * model.lags)
    states = []
    for k in range(len(log.green_s)):
        states.append(state)
        inflows = []
        ahead = state
        demand = network.is_source * log.entered_veh[k] / steps
        for window in windows[k]:
            ahead, flows = model.step(ahead, window, demand, network.fraction)
            inflows.append(flows.inflow_veh)
        if k + 1 < len(log.green_s):
            past = _counted(np.array(inflows), log.entered_veh[k])
            state = _correct(model, log, k + 1, ahead.q_veh, (*past[::-1], *state.past_inflow_veh)[: model.lags])
    return states


def _counted(inflow_veh: Floats, entered_veh: Floats) -> Floats:
    """(steps, runs, Z) the model's inflows, brought to what was counted over the control step."""
    total = inflow_veh.sum(axis=0)
    return np.asarray(inflow_veh * np.where(total > 0, entered_veh / np.maximum(total, 1e-9), 1.0))


def _correct(model: LinkModel, log: Log, k: int, split_veh: Floats, past: tuple[Floats, ...]) -> ModelState:
    """The state at the start of step k: counts, and queues split by turn as the model's are."""
    x = log.x_veh[k]
    share = model.on_the_way(model.delay_s(log.q_veh[k] @ model.leaves.T))
    moving = np.sum([share[lag] * past[lag - 1] for lag in range(1, model.lags)], axis=0)
    queue = np.clip(x - moving, 0.0, x)
    split = np.maximum(split_veh, 1e-6)
    split = split / (split @ model.leaves.T @ model.leaves)
    return ModelState(x, split * (queue @ model.leaves), log.source_queue_veh[k], past)


def roll(model: LinkModel, log: Log, states: list[ModelState], demand_veh: Floats, horizon: int) -> Prediction:
    """Predict `horizon` control steps from every start under the greens of the log.

    `demand_veh` (K, runs, Z) is what wants to enter each source link in each control step, known or forecast.
    """
    windows = np.moveaxis(green_windows(model.network, log.green_s, model.step_s), -2, 1)
    starts = np.arange(1, len(log.green_s) - horizon + 1)
    state = ModelState(
        np.array([states[k].x_veh for k in starts]),
        np.array([states[k].q_veh for k in starts]),
        np.array([states[k].source_queue_veh for k in starts]),
        tuple(np.array([states[k].past_inflow_veh[lag] for k in starts]) for lag in range(model.lags)),
    )
    x, queue, inflow = [], [], []
    for ahead in range(horizon):
        entered: Floats = np.zeros_like(state.x_veh)
        for step in range(windows.shape[1]):
            demand = demand_veh[starts + ahead] / windows.shape[1]
            flows: StepFlows
            state, flows = model.step(state, windows[starts + ahead, step], demand, model.network.fraction)
            entered = entered + flows.inflow_veh
        x.append(state.x_veh)
        queue.append(state.q_veh @ model.leaves.T)
        inflow.append(entered)
    return Prediction(starts, np.array(x), np.array(queue), np.array(inflow))


def known_demand_veh(network: Network, log: Log) -> Floats:
    """(K, runs, Z) vehicles that really wanted to enter each source link in each control step."""
    before = np.concatenate([np.zeros_like(log.true_waiting_veh[:1]), log.true_waiting_veh[:-1]])
    return np.asarray((log.entered_veh + log.true_waiting_veh - before) * network.is_source)
